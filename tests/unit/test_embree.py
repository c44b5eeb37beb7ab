"""The engine of solves: float32 inside, yet the same answers wherever the scene lies and however large it is."""

from __future__ import annotations

import numpy as np
import pytest
from instrument_scenes import box_triangles, geometry_of, rectangle

from workbench.accel.base import NO_POLYGON
from workbench.accel.brute import BruteForce
from workbench.accel.embree import BLOCK_RAYS, OFFSET, EmbreeAccelerator
from workbench.errors import InputError

SCENE = [rectangle(-1, 1, -1, 1, 1.0), rectangle(-0.25, 0.25, -0.25, 0.25, 0.5), rectangle(-3, 3, -3, 3, 2.0)]


def rays(count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.5, 1.5, (count, 3)) * [1, 1, 0.2], rng.normal(size=(count, 3)) * [0.5, 0.5, 1.0] + [0, 0, 1]


def far_from_edges(origins, directions):
    """Rays that pass every edge of SCENE by more than 1e-3: float32 decides the others."""
    keep = np.ones(len(origins), dtype=bool)
    for ring in SCENE:
        half = ring[2, 0]
        t = (ring[0, 2] - origins[:, 2]) / np.where(directions[:, 2] == 0, 1e-9, directions[:, 2])
        at = origins[:, :2] + t[:, None] * directions[:, :2]
        keep &= np.abs(np.abs(at).max(axis=1) - half) > 1e-3 * np.maximum(1.0, np.abs(t))
    return keep


@pytest.mark.parametrize("shift", [0.0, 1e3, 1e5, -3e6])
@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e3, 1e6])
def test_shift_and_scale_change_nothing(shift, scale):
    # Failure modes 4.10 and 4.11; coordinates hold the scene to 1e-16 shift, Embree to 1e-6 of its size.
    origins, directions = rays(3000)
    keep = far_from_edges(origins, directions) & (np.abs(directions[:, 2]) > 0.05)
    origins, directions = origins[keep], directions[keep]
    assert len(origins) > 2000
    nearest = BruteForce(geometry_of(SCENE)).closest_hit(origins, directions)
    placed = geometry_of([(ring + shift) * scale for ring in SCENE])
    tracer = EmbreeAccelerator(placed)
    hits = tracer.closest_hit((origins + shift) * scale, directions * scale)
    assert (hits.polygon == nearest.polygon).all()
    finite = np.isfinite(nearest.t)
    assert 500 < finite.sum() < len(finite)
    assert np.allclose(hits.t[finite], nearest.t[finite], rtol=1e-4, atol=2e-5)
    # In units of the direction, whatever its length.
    again = tracer.closest_hit((origins + shift) * scale, directions * scale * 7.0)
    assert np.allclose(again.t[finite] * 7.0, nearest.t[finite], rtol=1e-4, atol=2e-5)
    blocked = tracer.occluded((origins + shift) * scale, directions * scale, np.inf)
    assert (blocked == finite).all()
    limit = np.where(finite, nearest.t, 1.0)
    for share, wanted in ((0.99, False), (1.01, True)):
        found = tracer.occluded((origins + shift) * scale, directions * scale, share * limit)
        assert (found[finite] == wanted).all()


def test_a_box_moved_far_away_keeps_its_hits():
    # The fact behind re-centring: float32 at 100 sizes away gave 70 % false hits.
    triangles = box_triangles([0, 0, 0], [1, 1, 1], 4)
    rng = np.random.default_rng(4)
    origins, directions = rng.uniform(0.05, 0.95, (20_000, 3)), rng.normal(size=(20_000, 3))
    home = EmbreeAccelerator(geometry_of(triangles)).closest_hit(origins, directions)
    for shift in (1e2, 1e4, 1e6):
        away = EmbreeAccelerator(geometry_of(triangles + shift)).closest_hit(origins + shift, directions)
        assert np.isfinite(away.t).all()
        assert np.abs(away.t - home.t).max() < 1e-4


@pytest.mark.parametrize("count", [0, 1, BLOCK_RAYS - 1, BLOCK_RAYS, BLOCK_RAYS + 1, 2 * BLOCK_RAYS + 17])
@pytest.mark.parametrize("workers", [1, 2])
def test_blocks_and_workers_change_nothing(count, workers):
    origins, directions = rays(2 * BLOCK_RAYS + 17)
    whole = EmbreeAccelerator(geometry_of(SCENE)).closest_hit(origins, directions)
    tracer = EmbreeAccelerator(geometry_of(SCENE), workers=workers)
    hits = tracer.closest_hit(origins[:count], directions[:count])
    assert (hits.t == whole.t[:count]).all() and (hits.polygon == whole.polygon[:count]).all()
    far = np.full(count, np.inf)
    assert (tracer.occluded(origins[:count], directions[:count], far) == np.isfinite(whole.t[:count])).all()
    assert (far == np.inf).all()  # the caller's limits are not overwritten
    assert tracer.counters["rays"] == 2 * count
    assert tracer.counters["rays_hit"] == 2 * int(np.isfinite(whole.t[:count]).sum())


@pytest.mark.parametrize("shift", [0.0, 1e4])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_ends_moved_by_the_offset_meet_neither_end(shift, scale):
    # From floor to lid of a closed box: neither end blocks, with the offset; a sheet close to an end still does.
    box = box_triangles([0, 0, 0], [1, 1, 1], 2)
    tracer = EmbreeAccelerator(geometry_of((box + shift) * scale))
    assert tracer.offset == pytest.approx(OFFSET * scale, rel=1e-9)
    rng = np.random.default_rng(6)
    low = np.column_stack([rng.uniform(0.01, 0.99, (20_000, 2)), np.zeros(20_000)])
    high = np.column_stack([rng.uniform(0.01, 0.99, (20_000, 2)), np.ones(20_000)])
    start, end = ((p + shift) * scale for p in (low, high))
    start = start + [0, 0, tracer.offset]
    end = end - [0, 0, tracer.offset]
    assert not tracer.occluded(start, end - start, 1.0).any()
    for height in (2e-5, 1 - 2e-5):
        sheet = rectangle(-1, 2, -1, 2, height)
        both = EmbreeAccelerator(geometry_of([*(box + shift) * scale, (sheet + shift) * scale]))
        assert both.occluded(start, end - start, 1.0).all()


def test_the_unit_frame_of_kernels_answers_the_same():
    tracer = EmbreeAccelerator(geometry_of([(ring + 50.0) * 3.0 for ring in SCENE]))
    origins, directions = rays(5000)
    origins = (origins + 50.0) * 3.0
    centre, scale = tracer.frame
    unit = ((origins - centre) * scale).astype(np.float32), (directions * 3.0 * scale).astype(np.float32)
    before = tracer.counters["rays"]
    found = tracer.blocked_raw(*unit, np.full(5000, np.inf, dtype=np.float32)) == 0
    nearest, first = tracer.nearest_raw(*unit), tracer.first_raw(*unit)
    assert tracer.counters["rays"] == before
    assert (found == tracer.occluded(origins, directions * 3.0, np.inf)).all()
    assert (nearest == tracer.closest_hit(origins, directions * 3.0).polygon).all() and (nearest == first).all()
    assert 0 < found.sum() < 5000


def test_doubtful_hits_are_looked_at_again_in_the_unit_frame_too():
    # Rays all but in the planes of tilted triangles: single precision takes many for hits that are none.
    rng = np.random.default_rng(5)
    rings = rng.uniform(-1, 1, (40, 3, 3))
    tracer = EmbreeAccelerator(geometry_of(list(rings)))
    which = rng.integers(0, 40, 20000)
    a, u, v = rings[which, 0], rings[which, 1] - rings[which, 0], rings[which, 2] - rings[which, 0]
    normal = np.cross(u, v)
    weight = rng.uniform(-1, 1, (4, 20000, 1))
    origins = a + weight[0] * u + weight[1] * v + 1e-7 * normal
    directions = weight[2] * u + weight[3] * v + 1e-7 * rng.normal(size=(20000, 1)) * normal
    centre, scale = tracer.frame
    unit = ((origins - centre) * scale).astype(np.float32), (directions * scale).astype(np.float32)
    first, nearest = tracer.first_raw(*unit), tracer.nearest_raw(*unit)
    again = tracer.closest_hit(unit[0].astype(float) / scale + centre, unit[1].astype(float) / scale).polygon
    assert (nearest != again).sum() > 50 and (first != again).sum() < 5


def test_polygons_with_many_corners_and_concave_ones_answer_with_their_own_number():
    ell = np.array([[0, 0, 1], [2, 0, 1], [2, 1, 1], [1, 1, 1], [1, 2, 1], [0, 2, 1.0]])
    tracer = EmbreeAccelerator(geometry_of([rectangle(5, 6, 5, 6, 1.0)], [ell]))
    at = np.array([[0.5, 0.5, 0], [1.7, 0.4, 0], [0.3, 1.8, 0], [1.5, 1.5, 0], [5.5, 5.5, 0]])
    hits = tracer.closest_hit(at, [0, 0, 1.0])
    assert hits.polygon.tolist() == [1, 1, 1, NO_POLYGON, 0]


def test_it_cannot_skip_by_identity_and_says_so():
    tracer = EmbreeAccelerator(geometry_of(SCENE))
    for question in (tracer.closest_hit, tracer.occluded):
        with pytest.raises(InputError, match="offset") as caught:
            question([0, 0, 0], [0, 0, 1.0], 1.0, [[0, -1]])
        assert "\n" not in str(caught.value)
    # Naming no polygon is fine.
    assert tracer.occluded([0, 0, 0], [0, 0, 1.0], 3.0, [[-1, -1]]).all()
