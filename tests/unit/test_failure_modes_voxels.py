"""Scenes that break a voxel walk or an intersection test, each with its right answer.

Named after the entries 4.x of a list of known failures.
"""

from __future__ import annotations

import numpy as np
import pytest
from broken_kernels import break_kernel
from instrument_scenes import FAR, UNIT_SQUARE_LIGHT, box_triangles, geometry_of, rectangle, truth

from workbench.accel import _intersect
from workbench.accel.brute import BruteForce
from workbench.accel.embree import EmbreeAccelerator
from workbench.accel.voxel_grid import VoxelGrid
from workbench.shadow.linear import visible_linear_irradiance
from workbench.shadow.woo import irradiance_weights, light_occlusion

LINE = np.array([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]])
UNIT_VOXELS = {"resolution": 4, "bounds": [[0, 0, 0], [4, 4, 4]]}


def light_samples(count: int, light=UNIT_SQUARE_LIGHT) -> np.ndarray:
    middle = (np.arange(count) + 0.5) / count
    a, b = (x.ravel()[:, None] for x in np.meshgrid(middle, middle))
    return (light[0] + a * (light[1] - light[0]) + b * (light[3] - light[0]))[None]


def both(geometry, **options):
    return BruteForce(geometry), VoxelGrid(geometry, **options)


def test_4_1_ray_through_voxel_corners():
    triangle = [[2.5, 2.5, 2.75], [2.75, 2.5, 2.5], [2.5, 2.75, 2.5]]
    expected = 3.0 + 7.0 / 12.0  # the plane x + y + z = 7.75
    for tracer in both(geometry_of([triangle]), **UNIT_VOXELS):
        found = tracer.closest_hit([-1, -1, -1], [1, 1, 1.0])
        assert found.t == pytest.approx(expected, rel=1e-15)
        assert found.t == pytest.approx(truth("fail/voxel-diagonal"))
        # Every diagonal of the grid, both ways.
        for sign in np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).T.reshape(-1, 3):
            origin = np.where(sign > 0, -1.0, 5.0)
            crossed = tracer.occluded(origin, sign * 1.0, np.inf)
            assert crossed == (abs(sign.sum()) == 3)


def test_4_2_ray_in_voxel_faces_and_polygon_in_a_face():
    square = rectangle(1, 3, 1, 3, 2)
    grid = VoxelGrid(geometry_of([square]), **UNIT_VOXELS)
    for tracer in (BruteForce(geometry_of([square])), grid):
        hits = tracer.closest_hit([2, 2, -1], [0, 0, 1.0])
        assert np.isfinite(hits.t).sum() == 1 and hits.t == 3.0
        assert [1, hits.t.item()] == truth("fail/voxel-face-coplanar")
        assert tracer.closest_hit([2, 2, 5], [0, 0, -1.0]).t == 3.0
        assert not tracer.occluded([0, 0, -1], [0, 0, 1.0], np.inf).any()
    # The polygon is in the voxels on both its sides.
    holding = np.flatnonzero(np.diff(grid.cells.start))
    assert set(holding % 4) == {1, 2}
    assert grid.counters["voxels_stepped"] == 2 + 2 + 4  # two to the face from either side, all for the miss


def test_4_3_ray_in_the_plane_of_an_occluder():
    rng = np.random.default_rng(43)
    normal = np.array([0.3, -0.5, 0.8])
    u, v = np.linalg.svd(normal[None])[2][1:]
    for shift in (np.zeros(3), np.array([0.1, 0.7, -0.3])):
        polygon = np.array([shift + np.cos(a) * u + np.sin(a) * v for a in (0.1, 1.3, 3.0, 4.4)])
        inside = rng.uniform(-3, 3, (500, 2)), rng.normal(size=(500, 2))
        origins, directions = shift + inside[0] @ [u, v], inside[1] @ [u, v]
        first = None
        for tracer in both(geometry_of([polygon]), resolution=5):
            for _ in range(2):
                hits = tracer.closest_hit(origins, directions)
                assert not np.isnan(hits.t).any()
                first = hits if first is None else first
                assert (hits.t == first.t).all() and (hits.polygon == first.polygon).all()
        # Where rounding makes it a hit, the hit lies on the polygon, never far beyond.
        met = np.isfinite(first.t)
        points = origins[met] + first.t[met, None] * directions[met]
        assert (np.linalg.norm(points - shift, axis=1) < 1.0 + 1e-5).all()


def distance_to_triangle(point, triangle):
    """From a point to the nearest place of a triangle."""
    a, b, c = triangle
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    inside, best = True, np.inf
    for p, q in ((a, b), (b, c), (c, a)):
        along = q - p
        inside &= np.cross(along, point - p) @ normal >= 0.0
        best = min(best, np.linalg.norm(p + np.clip((point - p) @ along / (along @ along), 0, 1) * along - point))
    return abs((point - a) @ normal) if inside else best


def skinny(rng, least):
    """A triangle 2^-8 to 2^-20 wide, turned at random, and a ray from 1 to 5 lengths away, nearly in its plane."""
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    width = 2.0 ** -rng.integers(8, 21)
    triangle = np.array([[0, 0, 0], [1, rng.uniform(-width, width), 0], [rng.uniform(0.2, 0.8), width, 0]])
    slope = 10.0 ** rng.uniform(least, -2)
    goal = np.array([rng.uniform(0, 1), rng.uniform(0, width), 0.0])
    along = np.array([1.0, rng.uniform(-2, 2) * width, slope])
    origin = goal - rng.uniform(1, 5) * along
    return triangle @ turn.T, turn @ origin, turn @ along


def test_4_5_skinny_triangles_nearly_parallel_to_the_ray():
    # Embree issues 387 and 423: hits far beyond the triangle. A hit must lie on it, to 1e-5 of its size.
    rng = np.random.default_rng(45)
    hits = 0
    for _ in range(150):
        triangle, origin, along = skinny(rng, -7)
        geometry = geometry_of([triangle])
        for tracer in [*both(geometry), EmbreeAccelerator(geometry)]:
            t = tracer.closest_hit(origin, along).t[0]
            if np.isfinite(t):
                hits += 1
                assert distance_to_triangle(origin + t * along, triangle) < 1e-5
    assert hits > 100


def test_4_5_a_sliver_beside_the_ray_neither_blocks_it_nor_hides_what_lies_behind():
    rng = np.random.default_rng(450)
    seen = 0
    for _ in range(300):
        triangle, origin, along = skinny(rng, -5)
        # A wall across the ray, beyond the triangle.
        side = np.linalg.svd(along[None])[2][1:]
        wall = [origin + 8 * along + a * side[0] + b * side[1] for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        origin = origin + rng.normal(size=3) * 10.0 ** rng.uniform(-4, -1)
        geometry = geometry_of([triangle], [np.array(wall)])
        brute, embree = BruteForce(geometry), EmbreeAccelerator(geometry)
        wanted, found = brute.closest_hit(origin, along), embree.closest_hit(origin, along)
        at = origin + (wanted.t[0] if wanted.polygon[0] == 0 else found.t[0]) * along
        if wanted.polygon[0] == 0 or found.polygon[0] == 0:
            # They may differ where the ray passes the rim, as single precision moves it.
            assert distance_to_triangle(at, triangle) < 1e-5
            continue
        seen += 1
        assert found.polygon[0] == wanted.polygon[0] == 1
        assert abs(found.t[0] - wanted.t[0]) < 1e-5
        assert not embree.occluded(origin, along, 6.5)[0]
    assert seen > 200


def test_4_3_exactly_edge_on_hides_nothing():
    for tracer in both(geometry_of([rectangle(0, 1, 0, 1, 0)])):
        assert not tracer.occluded([-1, 0.5, 0], [4, 0, 0.0]).any()
        assert not tracer.occluded([-1, -1, 0], [4, 4, 0.0]).any()


def shared_edge_rays():
    t = np.linspace(0.1, 0.9, 9)
    triangles = [[[0, 0, 1], [1, 0, 1], [1, 1, 1]], [[0, 0, 1], [1, 1, 1], [0, 1, 1.0]]]
    return triangles, np.column_stack([t, t, 0 * t]), np.array([0, 0, 2.0])


def test_4_4_ray_along_a_shared_edge():
    triangles, origins, along = shared_edge_rays()
    for tracer in both(geometry_of(triangles)):
        assert tracer.occluded(origins, along).all()  # opaque: no leak
    for tracer in both(geometry_of(triangles, transmittance=0.5)):
        assert (tracer.transmitted(origins, along) == 0.5).all()  # once, not twice, not never
    # Through the corner that four triangles share, from all sides.
    middle, ring = [0, 0, 1.0], [[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1.0]]
    fan = [[middle, ring[i], ring[(i + 1) % 4]] for i in range(4)]
    rng = np.random.default_rng(44)
    start = np.column_stack([rng.integers(-3, 4, (200, 2)) / 4.0, np.zeros(200)])
    for tracer in both(geometry_of(fan, transmittance=0.5)):
        assert (tracer.transmitted(start, (middle - start) * 2.0) == 0.5).all()


@pytest.mark.parametrize(
    ("old", "new", "transparent"),
    [
        (
            "(su >= 0.0 and sv >= 0.0 and sw >= 0.0) or (su <= 0.0 and sv <= 0.0 and sw <= 0.0)",
            "(su > 0.0 and sv > 0.0 and sw > 0.0) or (su < 0.0 and sv < 0.0 and sw < 0.0)",
            False,
        ),
        ("if once:", "if False:", True),
    ],
    ids=["strict test leaks", "no tie rule counts twice"],
)
def test_4_4_fails_on_a_broken_intersection(monkeypatch, old, new, transparent):
    triangles, origins, along = shared_edge_rays()
    tracer = BruteForce(geometry_of(triangles, transmittance=0.5 if transparent else 0.0))
    break_kernel(monkeypatch, _intersect, "_piece_crossing", old, new)
    through = tracer.transmitted(origins, along)
    assert not (through == (0.5 if transparent else 0.0)).all()


def test_4_6_slivers_are_finite_and_met():
    width = 2.0**-13
    sliver = [[0, 0, 1], [1, 0, 1], [1, width, 1]]
    for tracer in both(geometry_of([sliver])):
        x = np.linspace(0.05, 0.95, 19)
        inside = np.column_stack([x, 0.5 * width * x, 0 * x])
        hits = tracer.closest_hit(inside, [0.0, 0.0, 1.0])
        assert (hits.t == 1.0).all()
        beside = inside + [0, 0.6 * width, 0]
        assert not tracer.occluded(beside, [0.0, 0.0, 2.0]).any()
        # Nearly edge on: the hit lies on the sliver.
        flat = np.array([[-1.0, 0.25 * width, 1.0 - 1e-9]])
        along = np.array([[0.75, 0.25 * width, 1.0]]) - flat
        grazing = tracer.closest_hit(flat, along)
        assert grazing.t == pytest.approx(1.0, rel=1e-6)
    # The exact cut of a linear light by a sliver: the line light above it, seen from below.
    seen = visible_linear_irradiance(
        geometry_of([sliver]), [0.5, 0.1 * width, 0], [0, 0, 1], [0.0, 0.1 * width, 2], [1.0, 0.1 * width, 2]
    )  # fmt: skip
    # The sliver covers x > 0.1 in the plane y = 0.1 width at z = 1, hence s > -0.3 on the light: all.
    assert seen.irradiance == 0.0
    assert seen.unoccluded > 0.0


def test_4_7_closed_box_with_t_junctions_does_not_leak():
    # Faces split differently: some share corners, the floor's split meets the walls' edges midway.
    triangles = [*box_triangles([0, 0, 0], [1, 1, 1], 3)[: 3 * 18], *box_triangles([0, 0, 0], [1, 1, 1], 1)[6:]]
    rng = np.random.default_rng(47)
    origins, directions = rng.uniform(0.01, 0.99, (100_000, 3)), rng.normal(size=(100_000, 3))
    assert VoxelGrid(geometry_of(triangles)).occluded(origins, directions, np.inf).all()


def half_plane(z, along_y: bool = False, negative: bool = False):
    low, high = (-FAR, 0.0) if negative else (0.0, FAR)
    return rectangle(-FAR, FAR, low, high, z) if along_y else rectangle(low, high, -FAR, FAR, z)


@pytest.mark.parametrize(
    ("occluders", "visible"),
    [
        ([half_plane(1), half_plane(1.5)], 0.5),
        ([half_plane(1), half_plane(1)], 0.5),
        ([half_plane(1), half_plane(1.5, negative=True)], 0.0),
        ([half_plane(1), half_plane(1.5, along_y=True)], 0.25),
    ],
    ids=["same", "coincident", "complementary", "crossed"],
)
def test_4_8_overlapping_occluders_are_a_union(occluders, visible):
    geometry = geometry_of(occluders)
    samples = light_samples(8)
    weights = irradiance_weights([0, 0, 0], [0, 0, 1], samples, light_normal=[0, 0, -1])
    for check in (False, True):
        found = light_occlusion(
            VoxelGrid(geometry), [0, 0, 0], UNIT_SQUARE_LIGHT, samples, check=check, weights=weights
        )  # fmt: skip
        assert 1.0 - found.occlusion == pytest.approx(visible, abs=1e-14)
    if visible != 0.25:
        seen = visible_linear_irradiance(geometry, [0, 0, 0], [0, 0, 1], *LINE)
        assert seen.irradiance / seen.unoccluded == pytest.approx(visible, abs=1e-14)


@pytest.mark.parametrize("shift", [0.0, 1e3, 1e5])
def test_4_9_contact_shadow(shift):
    # A square 1e-5 above the floor covers the light; the floor itself, and its neighbour, do not.
    move = np.array([shift, shift, shift])
    floor = [rectangle(-3, 0, -3, 3, 0) + move, rectangle(0, 3, -3, 3, 0) + move]
    cover = rectangle(-0.25, 0.25, -0.25, 0.25, 1e-5) + move
    light, samples = UNIT_SQUARE_LIGHT + move, light_samples(4, UNIT_SQUARE_LIGHT + move)
    point = move[None] + [[0, 0, 0.0]]
    skip = [0, -1]  # the point lies on the seam of both halves of the floor
    for check in (False, True):
        dark = light_occlusion(
            VoxelGrid(geometry_of([*floor, cover])), point, light, samples, check=check, skip_polygons=skip
        )  # fmt: skip
        lit = light_occlusion(VoxelGrid(geometry_of(floor)), point, light, samples, check=check, skip_polygons=skip)
        assert dark.occlusion == 1.0 and lit.occlusion == 0.0


@pytest.mark.parametrize("shift", [1e3, 1e5, 1e6, 1e7])
def test_4_10_large_coordinates(shift):
    floor, square = rectangle(-3, 3, -3, 3, 0), rectangle(0, 0.75, -0.75, 0.75, 1)
    for move in (np.array([shift, 0, 0]), np.array([shift, -shift, shift])):
        light = UNIT_SQUARE_LIGHT + move
        grid = VoxelGrid(geometry_of([floor + move, square + move]))
        found = light_occlusion(grid, move[None], light, light_samples(4, light), skip_polygons=[0, -1])
        assert found.occlusion == 0.5


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_4_11_scale(scale):
    floor, square = rectangle(-3, 3, -3, 3, 0), rectangle(0, 0.75, -0.75, 0.75, 1)
    light = UNIT_SQUARE_LIGHT * scale
    grid = VoxelGrid(geometry_of([floor * scale, square * scale]))
    reference = VoxelGrid(geometry_of([floor, square]))
    found = light_occlusion(grid, [0, 0, 0], light, light_samples(4, light), skip_polygons=[0, -1])
    expected = light_occlusion(
        reference, [0, 0, 0], UNIT_SQUARE_LIGHT, light_samples(4), skip_polygons=[0, -1]
    )  # fmt: skip
    assert found.occlusion == expected.occlusion == 0.5
    assert dict(found.counters) == dict(expected.counters)
