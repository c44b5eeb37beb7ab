"""Every accelerator answers the two questions of the interface as brute force does.

A new accelerator of general geometry is one line in ``EXACT`` (double precision, equal bit for
bit) or ``ROUNDED`` (float32 inside).
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_scenes import box_triangles, geometry_of, nasty_polygons, rectangle

from workbench.accel.base import NO_POLYGON, Accelerator
from workbench.accel.brute import BruteForce
from workbench.accel.embree import EmbreeAccelerator
from workbench.accel.voxel_grid import VoxelGrid
from workbench.errors import InputError

EXACT = {
    "brute": BruteForce,
    "voxel-grid": VoxelGrid,
    "voxel-grid without mailboxes": lambda geometry: VoxelGrid(geometry, mailboxes=False),
    "voxel-grid of one voxel": lambda geometry: VoxelGrid(geometry, resolution=1),
    "voxel-grid, fine": lambda geometry: VoxelGrid(geometry, resolution=(17, 9, 23)),
    "voxel-grid, two threads": lambda geometry: VoxelGrid(geometry, workers=2),
}
ROUNDED = {"embree": EmbreeAccelerator}

each_exact = pytest.mark.parametrize("make", EXACT.values(), ids=EXACT)
each = pytest.mark.parametrize("make", [*EXACT.values(), *ROUNDED.values()], ids=[*EXACT, *ROUNDED])


def _rays(rng, polygons, count):
    """Rays from anywhere to anywhere, to corners and edges, along axes and in planes of polygons."""
    corners = np.concatenate(polygons)
    origins = rng.uniform(-2.0, 3.0, (count, 3))
    targets = rng.uniform(-1.0, 2.0, (count, 3))
    near = corners[np.abs(corners).max(axis=1) < 50.0]
    if len(near):
        at_corner = rng.random(count) < 0.25
        targets[at_corner] = near[rng.integers(0, len(near), at_corner.sum())]
        from_corner = rng.random(count) < 0.2
        origins[from_corner] = near[rng.integers(0, len(near), from_corner.sum())]
        middle = rng.random(count) < 0.1
        two = near[rng.integers(0, len(near), (middle.sum(), 2))]
        targets[middle] = two.mean(axis=1)
    on_lattice = rng.random(count) < 0.2
    origins[on_lattice] = rng.integers(-8, 13, (on_lattice.sum(), 3)) / 4.0
    along_axis = rng.random(count) < 0.15
    targets[along_axis] = origins[along_axis] + np.eye(3)[rng.integers(0, 3, along_axis.sum())]
    for row in np.flatnonzero(rng.random(count) < 0.1):
        polygon = polygons[rng.integers(0, len(polygons))]
        origins[row], targets[row] = polygon[0] + rng.uniform(-2.0, 2.0, (2, 2)) @ (polygon[1:3] - polygon[0])
    directions = targets - origins
    still = ~directions.any(axis=1)
    directions[still] = [0.0, 0.0, 1.0]
    return origins, directions


@each
def test_is_an_accelerator_with_a_name(make):
    tracer = make(geometry_of([rectangle(0, 1, 0, 1, 0)]))
    assert isinstance(tracer, Accelerator)
    assert isinstance(tracer.name, str) and tracer.name


@each
def test_open_segment_in_units_of_the_direction(make):
    # The square z = 1 from the origin along (0, 0, 2): t = 1/2.
    tracer = make(geometry_of([rectangle(-1, 1, -1, 1, 1)]))
    hits = tracer.closest_hit([0.1, 0.2, 0], [[0, 0, 2.0], [0, 0, -2.0], [0, 0, 0.5], [5, 0, 1.0]])
    assert np.allclose(hits.t[[0, 2]], [0.5, 2.0], rtol=1e-6)
    assert np.isinf(hits.t[[1, 3]]).all()
    assert hits.polygon.tolist() == [0, NO_POLYGON, 0, NO_POLYGON]
    far = [0.4, 0.6, 10.0]
    assert tracer.occluded([[0.1, 0.2, 0]] * 3, [[0, 0, 2.0]] * 3, far).tolist() == [False, True, True]
    assert np.isfinite(tracer.closest_hit([[0.1, 0.2, 0]] * 3, [0, 0, 2.0], far).t).tolist() == [False, True, True]


@each
def test_counts_its_rays(make):
    tracer = make(geometry_of([rectangle(-1, 1, -1, 1, 1)]))
    tracer.closest_hit(np.zeros((5, 3)), [0, 0, 1.0])
    tracer.occluded(np.zeros((3, 3)), [0, 1.0, 0])
    assert tracer.counters["rays"] == 8
    assert tracer.counters["rays_hit"] == 5


@each
def test_an_empty_scene_and_no_rays(make):
    empty = make(geometry_of())
    assert np.isinf(empty.closest_hit([0, 0, 0], [0, 0, 1.0]).t).all()
    assert not empty.occluded([0, 0, 0], [0, 0, 1.0]).any()
    tracer = make(geometry_of([rectangle(-1, 1, -1, 1, 1)]))
    assert len(tracer.closest_hit(np.empty((0, 3)), np.empty((0, 3))).t) == 0


@each
@pytest.mark.parametrize(
    ("origins", "directions", "far", "words"),
    [
        ([[0, 0, 0]], [[0, 0, 0]], 1.0, "length zero"),
        ([[0, 0, np.nan]], [[0, 0, 1]], 1.0, "not finite"),
        ([[0, 0]], [[0, 0, 1]], 1.0, "shape"),
        ([[0, 0, 0]] * 2, [[0, 0, 1]] * 3, 1.0, "rows"),
        ([[0, 0, 0]], [[0, 0, 1]], -1.0, "negative"),
        ([[0, 0, 0]], [[0, 0, 1]], np.nan, "not a number"),
        ([[0, 0, 0]], [[0, 0, 1]], [1.0, 2.0], "far"),
    ],
)
def test_bad_rays_get_one_clear_line(make, origins, directions, far, words):
    tracer = make(geometry_of([rectangle(-1, 1, -1, 1, 1)]))
    for question in (tracer.closest_hit, tracer.occluded):
        with pytest.raises(InputError, match=words) as caught:
            question(origins, directions, far)
        assert "\n" not in str(caught.value)


@each_exact
def test_skips_polygons_by_identity(make):
    tracer = make(geometry_of([rectangle(-1, 1, -1, 1, z) for z in (1, 2, 3)]))
    skip = [[-1, -1], [0, -1], [1, 0], [2, -1]]
    hits = tracer.closest_hit(np.zeros((4, 3)), [0, 0, 1.0], skip_polygons=skip)
    assert hits.polygon.tolist() == [0, 1, 2, 0]
    assert hits.t.tolist() == [1.0, 2.0, 3.0, 1.0]
    blocked = tracer.occluded(np.zeros((4, 3)), [0, 0, 1.5], skip_polygons=skip)
    assert blocked.tolist() == [True, False, False, True]
    with pytest.raises(InputError, match="skip_polygons"):
        tracer.occluded([0, 0, 0], [0, 0, 1.0], skip_polygons=[[0.5, 1.0]])
    with pytest.raises(InputError, match="skip_polygons"):
        tracer.occluded([0, 0, 0], [0, 0, 1.0], skip_polygons=[[1, 2, 3]])


@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_exact_accelerators_equal_brute_force_bit_for_bit(seed):
    rng = np.random.default_rng(seed)
    polygons = nasty_polygons(rng, rng.integers(1, 25), np.zeros((1, 3)))
    geometry = geometry_of(polygons)
    origins, directions = _rays(rng, polygons, 60)
    skip = np.where(rng.random((60, 2)) < 0.2, rng.integers(0, len(polygons), (60, 2)), NO_POLYGON)
    far = rng.choice([0.5, 1.0, 1.5, np.inf], 60)
    brute = BruteForce(geometry)
    nearest = brute.closest_hit(origins, directions, far, skip)
    blocked = brute.occluded(origins, directions, far, skip)
    assert (blocked == (nearest.polygon >= 0)).all()
    for name, make in EXACT.items():
        tracer = make(geometry)
        hits = tracer.closest_hit(origins, directions, far, skip)
        assert (hits.t == nearest.t).all(), name
        assert (hits.polygon == nearest.polygon).all(), name
        assert (tracer.occluded(origins, directions, far, skip) == blocked).all(), name


@pytest.mark.parametrize("make", ROUNDED.values(), ids=ROUNDED)
@pytest.mark.parametrize("shift", [0.0, 1000.0])
def test_rounded_accelerators_agree_away_from_edges(make, shift):
    rng = np.random.default_rng(7)
    geometry = geometry_of(box_triangles([shift] * 3, [shift + 1.0] * 3, 3))
    origins = shift + rng.uniform(0.1, 0.9, (4000, 3))
    directions = rng.normal(size=(4000, 3))
    nearest = BruteForce(geometry).closest_hit(origins, directions)
    hits = make(geometry).closest_hit(origins, directions)
    assert np.isfinite(hits.t).all()
    assert np.allclose(hits.t, nearest.t, rtol=1e-4)
    # Polygons differ only where the ray passes within float32 rounding of an edge.
    assert (hits.polygon != nearest.polygon).mean() < 1e-3


@each
def test_closed_box_has_no_cracks(make):
    rng = np.random.default_rng(11)
    triangles = box_triangles([0, 0, 0], [1, 1, 1], 3)
    tracer = make(geometry_of(triangles))
    origins, directions = rng.uniform(0.05, 0.95, (20_000, 3)), rng.normal(size=(20_000, 3))
    assert tracer.occluded(origins, directions, np.inf).all()


@each_exact
def test_watertight_at_shared_edges_and_corners(make):
    # 20,000 rays aimed at points of shared edges and at corners of a closed box.
    rng = np.random.default_rng(12)
    triangles = box_triangles([-1, -2, 0.3], [0.7, 1, 1.9], 3)
    tracer = make(geometry_of(triangles))
    chosen = triangles[rng.integers(0, len(triangles), 20_000)]
    share = rng.random((20_000, 1)) * rng.choice([0.0, 1.0], (20_000, 1))
    targets = chosen[:, 0] * (1.0 - share) + chosen[:, 1] * share
    origins = np.array([-0.3, -0.4, 1.0]) + rng.uniform(-0.2, 0.2, (20_000, 3))
    hits = tracer.closest_hit(origins, targets - origins)
    assert np.isfinite(hits.t).all()
    assert np.allclose(hits.t, 1.0, rtol=1e-12)
