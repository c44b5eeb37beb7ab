"""Scenes that break a plane-vertex check or a rayID, each with its right answer.

Named after the entries of a list of known failures: 1.x the plane-vertex check, 3.x the rayID
mailbox, 5.x adaptive sampling of lights.  Expected numbers are similar triangles unless noted.
"""

from __future__ import annotations

import numpy as np
import pytest
from broken_kernels import break_kernel
from instrument_scenes import FAR, UNIT_SQUARE_LIGHT, geometry_of, nasty_polygons, polygon_samples, rectangle, truth

from workbench.accel import voxel_grid
from workbench.accel.brute import BruteForce
from workbench.accel.voxel_grid import RAY_ID_LIMIT, RayIDs, VoxelGrid
from workbench.errors import InputError
from workbench.geometry.polygons import convex_pieces
from workbench.shadow import woo
from workbench.shadow.linear import linear_irradiance, visible_linear_irradiance
from workbench.shadow.woo import (
    adaptive_linear_occlusion,
    irradiance_weights,
    light_occlusion,
    soft_shadow_kludge,
)

LINE = np.array([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]])
ORIGIN = np.zeros((1, 3))


def midpoints(count: int) -> np.ndarray:
    return (np.arange(count) + 0.5) / count


def square_samples(light, count: int, points: int = 1) -> np.ndarray:
    """Midpoints of count x count cells of a parallelogram light, (points, count^2, 3)."""
    a, b = (x.ravel() for x in np.meshgrid(midpoints(count), midpoints(count)))
    light = np.asarray(light, float)
    flat = light[0] + a[:, None] * (light[1] - light[0]) + b[:, None] * (light[3] - light[0])
    return np.tile(flat, (points, 1, 1))


def line_midpoints(ends, count: int, points: int = 1) -> np.ndarray:
    ends = np.asarray(ends, float)
    return np.tile(ends[0] + midpoints(count)[:, None] * (ends[1] - ends[0]), (points, 1, 1))


def occlusion_with_and_without(grid, points, light, samples, **options):
    """Both loops; asserts that they agree bit for bit and returns the culling one."""
    plain = light_occlusion(grid, points, light, samples, check=False, **options)
    found = light_occlusion(grid, points, light, samples, **options)
    assert (found.transmitted == plain.transmitted).all()
    assert np.isfinite(found.occlusion).all()
    return found


def pyramid_culls(grid, point, light, polygon: int = 0) -> bool:
    """Whether the planes of one point's light pyramid set a polygon aside."""
    planes = np.empty((len(light), 4))
    reach = np.abs(grid.geometry.corners).max() + np.abs(light).max()
    light, point = np.asarray(light, float), np.asarray(point, float)[None]
    used = woo._light_planes(point, 0, light, reach, woo.MARGIN, planes)
    return voxel_grid._outside_a_plane(grid.objects, polygon, point, 0, planes[:used], False)


# --- 1: the plane-vertex check ----------------------------------------------------------------------


@pytest.mark.parametrize("light", [UNIT_SQUARE_LIGHT, UNIT_SQUARE_LIGHT[::-1]], ids=["as given", "reversed"])
def test_1_1_area_light_winding_reversed(light, monkeypatch):
    # A square of side 1.5 at half height covers the light from x = 0: E = 0.
    grid = VoxelGrid(geometry_of([rectangle(-0.75, 0.75, -0.75, 0.75, 1)]))
    samples = square_samples(UNIT_SQUARE_LIGHT, 8)
    assert occlusion_with_and_without(grid, ORIGIN, light, samples).occlusion == 1.0
    # From x = 1.5 the square hides the light's x < 0: half of it.
    aside = occlusion_with_and_without(grid, [[1.5, 0, 0]], light, samples)
    assert aside.occlusion == 0.5
    # A square inside the pyramid hides |s| < 0.2: 4 x 4 of the samples.
    grid = VoxelGrid(geometry_of([rectangle(-0.1, 0.1, -0.1, 0.1, 1)]))
    assert occlusion_with_and_without(grid, ORIGIN, light, samples).occlusion == 0.25
    # With the winding trusted, one of the two windings loses it.
    break_kernel(monkeypatch, woo, "_light_planes", "if side > 0.0:", "if False:")
    assert {light_occlusion(grid, ORIGIN, c, samples).occlusion.item() for c in (light, light[::-1])} == {0.0, 0.25}


@pytest.mark.parametrize("shift", [0.0, 1e6, 1e6 + 0.1])
@pytest.mark.parametrize("tilt", [(0.0, 0.0, 1.0), (0.3, -0.7, 0.2)])
def test_1_2_linear_light_in_line_with_the_point(shift, tilt):
    # The light triangle is degenerate; the square across the line blocks all of it.
    axis = np.asarray(tilt) / np.linalg.norm(tilt)
    u, v = np.linalg.svd(axis[None])[2][1:]
    corners = [0.5 * axis + 0.5 * (a * u + b * v) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    for rounding in (np.float64, np.float32):
        moved = (np.array([*corners, axis, 2 * axis, 0 * axis]) + shift).astype(rounding).astype(float)
        grid = VoxelGrid(geometry_of([moved[:4]] if shift < 1e5 else [moved[:3], moved[[0, 2, 3]]]))
        light, point = moved[4:6], moved[6:]
        found = occlusion_with_and_without(grid, point, light, line_midpoints(light, 6))
        assert found.occlusion == 1.0
        assert found.counters["plane_vertex_culls"] == 0


@pytest.mark.parametrize("z", [-0.5, 2.5], ids=["behind the point", "beyond the light"])
def test_1_3_occluder_in_the_plane_but_not_in_the_triangle(z):
    # Kept by the plane, which is no triangle; the ends of the rays decide: nothing is blocked.
    grid = VoxelGrid(geometry_of([rectangle(-5, 5, -5, 5, z)]))
    found = occlusion_with_and_without(grid, ORIGIN, LINE, line_midpoints(LINE, 6))
    assert found.occlusion == 0.0
    area = occlusion_with_and_without(grid, ORIGIN, UNIT_SQUARE_LIGHT, square_samples(UNIT_SQUARE_LIGHT, 3))
    assert area.occlusion == 0.0


def test_1_4_concave_light_is_refused_and_its_parts_are_right():
    concave = np.array([[-1, -1, 2], [1, -1, 2], [1, 0, 2], [0, 0, 2], [0, 1, 2], [-1, 1, 2]], float)
    # The square 1/8..7/8, -7/8..-1/8 of the light's arm, halved towards S.
    occluder = np.array([[-3, -3, 16], [3, -3, 16], [3, 3, 16], [-3, 3, 16]]) / 16.0
    point = np.array([[-0.5, 0.5, 0.0]])
    grid = VoxelGrid(geometry_of([occluder]))
    with pytest.raises(InputError, match="convex parts"):
        light_occlusion(grid, point, concave, square_samples(concave[:4], 2))
    # The plane of its reflex edge has the whole occluder on one side, yet it hides a part of the light.
    assert pyramid_culls(grid, point[0], concave[3:5])
    irradiance = 0.0
    for part in convex_pieces([concave]):
        # Midpoints of a triangle's fine lattice.
        n = 96
        i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(n)))
        up = i + j < n
        shares = [(i[up] + 1 / 3, j[up] + 1 / 3), (i[i + j < n - 1] + 2 / 3, j[i + j < n - 1] + 2 / 3)]
        a, b = np.concatenate([s[0] for s in shares]) / n, np.concatenate([s[1] for s in shares]) / n
        samples = (part[0] + a[:, None] * (part[1] - part[0]) + b[:, None] * (part[2] - part[0]))[None]
        found = occlusion_with_and_without(grid, point, part, samples)
        x, y = samples[0, :, 0], samples[0, :, 1]
        inside = 0.375 - np.maximum(np.abs(x - 0.5), np.abs(y + 0.5))
        clear_cut = np.abs(inside) > 1e-9
        assert ((found.transmitted[0, :, 0] == 0.0) == (inside > 0.0))[clear_cut].all()
        area = 0.5 * np.linalg.norm(np.cross(part[1] - part[0], part[2] - part[0]))
        weights = irradiance_weights(point, [0, 0, 1], samples, light_normal=[0, 0, -1])
        irradiance += (weights * found.transmitted[:, :, 0]).sum() * area / n**2
    # Lambert's formula over the light less the square: 0.43490509657; culled: 0.49737929846.
    assert irradiance == pytest.approx(0.43490509657, rel=2e-3)


@pytest.mark.parametrize("height", [0.0, 1e-6, 1e-3, 0.1])
def test_1_5_point_in_the_lights_plane(height):
    light = rectangle(-0.5, 0.5, -0.5, 0.5, 0)
    point = [[2.0, 0, height]]
    samples = square_samples(light, 6)
    grid = VoxelGrid(geometry_of([[[1, -1, -1], [1, 0, -1], [1, 0, 1], [1, -1, 1]]]))  # hides y < 0
    found = occlusion_with_and_without(grid, point, light, samples)
    assert found.occlusion == 0.5
    weights = irradiance_weights(point, [-1, 0, 0], samples, light_normal=[0, 0, 1])
    assert np.isfinite(weights).all() and (weights >= 0).all()
    assert weights.any() == (height > 0.0)
    weighted = occlusion_with_and_without(grid, point, light, samples, weights=weights)
    assert weighted.occlusion == pytest.approx(0.5 if height else 0.0)
    # E rises with height: 1.3554e-7, 1.3554e-4, 1.3475e-2 with an open view.
    expected = {0.0: 0.0, 1e-6: 1.355421456577e-7, 1e-3: 1.355420660172e-4, 0.1: 1.347494843942e-2}[height]
    fine = irradiance_weights(point, [-1, 0, 0], square_samples(light, 100), light_normal=[0, 0, 1])
    assert fine.mean() == pytest.approx(expected, rel=1e-3, abs=0.0)


@pytest.mark.parametrize("point", [[-0.5, 0.1, 2.0], [-0.5, -0.5, 2.0]], ids=["on an edge", "on a corner"])
def test_1_6_point_on_an_edge_or_corner_of_the_light(point):
    rng = np.random.default_rng(16)
    grid = VoxelGrid(geometry_of(nasty_polygons(rng, 30, np.array([point]))))
    found = occlusion_with_and_without(grid, [point], UNIT_SQUARE_LIGHT, square_samples(UNIT_SQUARE_LIGHT, 5))
    assert found.counters["rays"] == 25


def test_1_7_not_culled_yet_never_hit():
    # x + y >= 0.8 on the triangle, x + y <= 0.5 in the pyramid; outside no single plane.
    grid = VoxelGrid(geometry_of([[[1, -0.2, 1], [1, 1, 1], [-0.2, 1, 1]]]), resolution=1)
    found = occlusion_with_and_without(grid, ORIGIN, UNIT_SQUARE_LIGHT, square_samples(UNIT_SQUARE_LIGHT, 4))
    assert found.occlusion == 0.0
    counts = found.counters
    assert counts["plane_vertex_checks"] == 1 and counts["plane_vertex_culls"] == 0
    assert counts["polygon_tests"] == 16 and counts["rays_hit"] == 0


@pytest.mark.parametrize("turned", [False, True])
def test_1_8_vertex_on_a_plane_and_occluder_in_a_side_of_the_pyramid(turned):
    # In the side x = z / 4, and with two corners on it; both touch the pyramid in a null set.
    in_side = np.array([[0.25, -0.2, 1], [0.25, 0.2, 1], [0.375, 0.3, 1.5], [0.375, -0.3, 1.5]])
    touching = np.array([[0.25, -0.1, 1.0], [0.25, 0.1, 1.0], [0.6, 0.0, 1.0]])
    for polygon in (in_side, touching):
        grid = VoxelGrid(geometry_of([polygon[::-1] if turned else polygon]))
        samples = square_samples(UNIT_SQUARE_LIGHT, 5)
        assert occlusion_with_and_without(grid, ORIGIN, UNIT_SQUARE_LIGHT, samples).occlusion == 0.0
        # On the light's edge itself, and one unit in the last place to either side, either answer
        # will do, but it is the same with and without the check, and the same as brute force's.
        edge = np.array([[0.5, y, 2.0] for y in np.linspace(-0.5, 0.5, 11)])
        near = np.concatenate([edge, edge, edge])
        near[11:22, 0], near[22:, 0] = np.nextafter(0.5, 1.0), np.nextafter(0.5, 0.0)
        found = occlusion_with_and_without(grid, ORIGIN, UNIT_SQUARE_LIGHT, near[None])
        brute = BruteForce(grid.geometry).occluded(ORIGIN, near)
        assert ((found.transmitted.ravel() == 0.0) == brute).all()


def test_1_9_rays_that_do_not_share_the_point():
    # Two unit squares at distance 1; the occluder lies wholly outside the pyramid from the centre
    # of the lower one, yet hides part of the upper one from points below itself.
    light = rectangle(-0.5, 0.5, -0.5, 0.5, 1)
    grid = VoxelGrid(geometry_of([rectangle(0.375, 0.5, 0.375, 0.5, 0.125)]))
    assert pyramid_culls(grid, [0, 0, 0], light)
    points = np.array([[x, y, 0.0] for x in midpoints(20) - 0.5 for y in midpoints(20) - 0.5])
    jitter = np.random.default_rng(19).uniform(-0.5, 0.5, (2, 400, 400, 2)) / 20
    points[:, :2] += jitter[0, 0]
    samples = square_samples(light, 20, len(points))
    samples[:, :, :2] += jitter[1]
    found = occlusion_with_and_without(grid, points, light, samples)  # one pyramid a point
    assert found.occlusion[np.abs(points).max(axis=1) < 0.1].max() == 0.0
    assert found.occlusion.max() > 0.1
    # F12 is the mean over both squares of visible / (pi r^4): 0.19982490 open, 0.19874198 behind the
    # occluder, so it hides 0.54 % of the light; a cull by the centre's pyramid would make that 0.
    toward = samples - points[:, None]
    kernel = 1.0 / (np.pi * (toward**2).sum(axis=2) ** 2)
    assert kernel.mean() == pytest.approx(0.1998249, rel=2e-3)
    hidden = 1.0 - (kernel * found.transmitted[:, :, 0]).sum() / kernel.sum()
    assert hidden == pytest.approx(1.0 - 0.19874198 / 0.19982490, rel=0.25)


def test_1_10_bounding_boxes_cull_no_more_than_vertices():
    rng = np.random.default_rng(110)
    grid = VoxelGrid(geometry_of([rng.uniform(-1, 2, 3) + rng.uniform(-0.3, 0.3, (3, 3)) for _ in range(200)]))
    points = rng.uniform(-1, 1, (50, 3))
    samples = polygon_samples(rng, UNIT_SQUARE_LIGHT, 50, 8)
    vertices = occlusion_with_and_without(grid, points, UNIT_SQUARE_LIGHT, samples)
    boxes = occlusion_with_and_without(grid, points, UNIT_SQUARE_LIGHT, samples, boxes=True)
    assert (vertices.transmitted == boxes.transmitted).all()
    assert 0 < boxes.counters["plane_vertex_culls"] < vertices.counters["plane_vertex_culls"]
    assert boxes.counters["plane_vertex_checks"] == vertices.counters["plane_vertex_checks"]


def test_1_11_kludge_light_misses_the_outer_penumbra():
    # The half-plane z = 1, x > 0.5 from x = 0.8: P = (0, 0, 2) is seen, so the kludge reports 0,
    # but 0.5 z / (z - 1) < 0.8 blocks z > 8/3 on the line from 2 to 4: 2/3 of it.
    grid = VoxelGrid(geometry_of([rectangle(0.5, FAR, -FAR, FAR, 1)]))
    point = [[0.8, 0, 0]]
    kludge = soft_shadow_kludge(grid, point, [0, 0, 1], [0, 0, 2], midpoints(300))
    line = [[0, 0, 2], [0, 0, 4]]
    whole = occlusion_with_and_without(grid, point, line, line_midpoints(line, 300))
    assert kludge.occlusion == 0.0 and kludge.shots == 1
    assert whole.occlusion == pytest.approx(2 / 3)
    assert [whole.occlusion.item(), kludge.occlusion.item()] == pytest.approx(
        truth("fail/kludge-light-misses-outer-penumbra")
    )


def test_1_12_equal_weights_give_the_length_not_the_irradiance():
    # Half-plane z = 1, x > 0 and a line light above; the visible part is s < -x.
    grid = VoxelGrid(geometry_of([rectangle(0, FAR, -FAR, FAR, 1)]))
    point, normal = [[0.277, 0, 0]], [0, 0, 1]
    samples = line_midpoints(LINE, 20_000)
    exact = 1.0 - linear_irradiance(point, normal, LINE[0], [-0.277, 0, 2]) / linear_irradiance(point, normal, *LINE)
    equal = occlusion_with_and_without(grid, point, LINE, samples).occlusion.item()
    weights = irradiance_weights(point, normal, samples)
    weighted = occlusion_with_and_without(grid, point, LINE, samples, weights=weights).occlusion.item()
    assert equal == pytest.approx(0.777, abs=1e-4)
    assert weighted == pytest.approx(exact.item(), abs=1e-4)
    assert abs(equal - exact.item()) == pytest.approx(0.0217, abs=1e-4)


# --- 3: the rayID mailbox ---------------------------------------------------------------------------


def shadowed_points(count: int = 4):
    """A grid with points in the umbra of a square and lit ones, 6 rays each, and the right answer."""
    grid = VoxelGrid(geometry_of([rectangle(-0.75, 0.75, -0.75, 0.75, 1), rectangle(4, 5, 4, 5, 1)]))
    points = np.array([[0.1 * i + (5.0 if i % 2 else 0.0), 0, 0] for i in range(count)])
    return grid, points, square_samples(UNIT_SQUARE_LIGHT, 3, count), np.arange(count) % 2 == 0


@pytest.mark.parametrize("limit", [2**31 - 1, RAY_ID_LIMIT], ids=["32 bits", "64 bits"])
@pytest.mark.parametrize("rays_left", [0, 1, 8, 9, 10, 18])
def test_3_1_id_overflow(limit, rays_left):
    grid, points, samples, dark = shadowed_points()
    ids = RayIDs(grid.object_count, limit - rays_left, limit)
    # Stale ids as a long run leaves them: all newer than the rays after a wrap.
    ids.mailbox[:] = ids.touched[:] = limit - rays_left - 1
    found = light_occlusion(grid, points, UNIT_SQUARE_LIGHT, samples, ids=ids)
    assert (found.occlusion[:, 0] == dark).all()
    assert 1 <= ids.current <= limit
    line = adaptive_linear_occlusion(grid, points, LINE, ids=RayIDs(grid.object_count, limit - rays_left, limit))
    assert (line.occlusion[:, 0] == dark).all()


def test_3_2_ids_are_cleared_on_wrap(monkeypatch):
    grid, points, samples, dark = shadowed_points()
    ids = RayIDs(grid.object_count, 2**31 - 10, 2**31 - 1)
    light_occlusion(grid, points, UNIT_SQUARE_LIGHT, samples, ids=ids)
    # The first point had ids left; the second began again at 1.
    assert ids.current == 1 + 9 * 3
    assert ids.mailbox.max() < ids.current
    # Without the clearing, every stale id is newer than the rays: shadows vanish.
    break_kernel(monkeypatch, woo, "_light_loop", "mailbox[:] = 0", "mailbox[:] += 0")
    leaky = light_occlusion(
        grid, points, UNIT_SQUARE_LIGHT, samples, ids=RayIDs(grid.object_count, 2**31 - 10, 2**31 - 1)
    )  # fmt: skip
    assert (leaky.occlusion[:, 0] != dark).any()


@pytest.mark.parametrize("first", [2**24 - 3, 2**24 + 1, 2**53 - 3, 2**53 + 1])
def test_3_3_ids_are_integers(first):
    # float32 holds integers to 2^24, float64 to 2^53: ids beyond would repeat.
    grid, points, samples, dark = shadowed_points()
    ids = RayIDs(grid.object_count, first)
    assert ids.mailbox.dtype == np.int64
    found = light_occlusion(grid, points, UNIT_SQUARE_LIGHT, samples, ids=ids)
    assert (found.occlusion[:, 0] == dark).all()
    assert ids.current == first + 36


def test_3_4_ids_not_advanced_between_two_lights():
    # The occluder lies outside the pyramid of light A and hides light B.
    light_a, light_b = UNIT_SQUARE_LIGHT + [4, 0, 0], UNIT_SQUARE_LIGHT
    occluder = rectangle(-0.75, 0.75, -0.75, 0.75, 1)
    grid = VoxelGrid(geometry_of([occluder]), resolution=1, bounds=[[-5, -5, -1], [5, 5, 3]])
    ids = RayIDs(grid.object_count)
    first = light_occlusion(grid, ORIGIN, light_a, square_samples(light_a, 3), ids=ids)
    assert first.occlusion == 0.0 and first.counters["plane_vertex_culls"] == 1
    before = ids.current
    second = light_occlusion(grid, ORIGIN, light_b, square_samples(light_b, 3), ids=ids)
    assert second.occlusion == 1.0
    assert (before, ids.current) == (10, 19)
    # Broken: the second light starts from the first one's m, and its occluder is skipped.
    ids.current = 1
    ids.mailbox[:] = 9
    assert light_occlusion(grid, ORIGIN, light_b, square_samples(light_b, 3), ids=ids).occlusion == 0.0


@pytest.mark.parametrize("workers", [2, 16])
def test_3_5_threads_do_not_share_a_mailbox(workers, monkeypatch):
    monkeypatch.setattr(voxel_grid, "BLOCK", 16)
    rng = np.random.default_rng(35)
    grid = VoxelGrid(geometry_of([rng.uniform(-1, 2, 3) + rng.uniform(-0.3, 0.3, (3, 3)) for _ in range(200)]))
    points = rng.uniform(-1, 1, (400, 3))
    samples = polygon_samples(rng, UNIT_SQUARE_LIGHT, 400, 8)
    one = light_occlusion(grid, points, UNIT_SQUARE_LIGHT, samples)
    many = light_occlusion(grid, points, UNIT_SQUARE_LIGHT, samples, workers=workers)
    assert (one.transmitted == many.transmitted).all()
    assert dict(one.counters) == dict(many.counters)
    with pytest.raises(InputError, match="one worker"):
        light_occlusion(
            grid, points, UNIT_SQUARE_LIGHT, samples, workers=workers, ids=RayIDs(grid.object_count)
        )  # fmt: skip


def test_3_6_hit_in_a_far_voxel_is_kept(monkeypatch):
    # A long polygon, listed in the ray's first voxels, is met late; a small one lies before it.
    long, small = [[0, -1, 0], [10, -1, 10], [10, 1, 10], [0, 1, 0]], [[2, -1, 3], [2.5, -1, 3], [2.2, 1, 3.2]]
    grid = VoxelGrid(geometry_of([long, small]), resolution=(8, 1, 8))
    origins = np.array([[2.2, 0.0, -1.0], [4.0, 0.0, 0.5], [9.5, 0, 0]])
    directions = np.array([[0, 0, 1.0], [1.0, 0.0, 2.0], [-0.2, 0, 1]])
    expected = BruteForce(grid.geometry).closest_hit(origins, directions)
    assert expected.polygon.tolist() == [0, 0, 0]
    found = grid.closest_hit(origins, directions)
    assert (found.t == expected.t).all() and (found.polygon == expected.polygon).all()
    # From the other side the small one is nearer.
    back = grid.closest_hit([2.2, 0.0, 12.0], [0, 0, -1.0])
    assert back.polygon == 1
    assert grid.counters["mailbox_skips"] > 0
    # Broken: the first hit found is taken for the nearest.
    rng = np.random.default_rng(36)
    crowd = VoxelGrid(geometry_of([rng.uniform(0, 1, (3, 3)) for _ in range(30)]), resolution=4)
    start, along = rng.uniform(-1, 2, (60, 3)), rng.normal(size=(60, 3))
    nearest = BruteForce(crowd.geometry).closest_hit(start, along)
    assert (crowd.closest_hit(start, along).t == nearest.t).all()
    break_kernel(monkeypatch, voxel_grid, "walk", "best <= exit_t", "best < math.inf")
    assert (crowd.closest_hit(start, along).t != nearest.t).any()


def test_3_7_folded_transparent_sheet_counts_twice():
    # One surface, folded over: two layers of transmittance 0.5 in the same voxels.
    sheet = [[[-1, -1, 1], [1, -1, 1], [1, 1, 1.2], [-1, 1, 1.2]], [[-1, -1, 1], [1, -1, 1], [1, 1, 1.4], [-1, 1, 1.4]]]
    grid = VoxelGrid(geometry_of(sheet, transmittance=0.5))
    samples = square_samples(UNIT_SQUARE_LIGHT, 4)
    found = occlusion_with_and_without(grid, ORIGIN, UNIT_SQUARE_LIGHT, samples)
    assert (found.transmitted == 0.25).all()


@pytest.mark.parametrize(("tau", "panes", "expected"), [(0.5, 3, 0.125), (0.9, 10, 0.3486784401)])
def test_3_7_transparent_panes(tau, panes, expected):
    # tau^m; 0.9^10 = 0.3486784401.
    stack = [rectangle(-2, 2, -2, 2, z) for z in np.linspace(0.3, 1.7, panes)]
    grid = VoxelGrid(geometry_of(stack, transmittance=tau))
    found = occlusion_with_and_without(grid, ORIGIN, UNIT_SQUARE_LIGHT, square_samples(UNIT_SQUARE_LIGHT, 4))
    assert np.allclose(1.0 - found.occlusion, expected, rtol=1e-14, atol=0.0)
    assert 1.0 - found.occlusion.item() == pytest.approx(truth(f"shadow/transparent-panes-{tau}-x{panes}"))


# --- 5: adaptive sampling of a linear light, transparency -------------------------------------------


def test_5_6_adaptive_linear_light_misses_a_gap():
    # An occluder between the samples: its shadow on the light is -0.4 < s < -0.1, 0.3 of it.
    geometry = geometry_of([rectangle(-0.2, -0.05, -FAR, FAR, 1)])
    grid = VoxelGrid(geometry)
    three = adaptive_linear_occlusion(grid, ORIGIN, LINE)
    assert three.occlusion == 0.0 and three.shots == 3
    assert [0.3, three.occlusion.item()] == pytest.approx(truth("fail/adaptive-linear-misses-gap"))
    # With all 17 at once the miss is below 1/16.
    assert abs(adaptive_linear_occlusion(grid, ORIGIN, LINE, levels=(4, 4)).occlusion.item() - 0.3) < 1 / 16
    exact = visible_linear_irradiance(geometry, ORIGIN, [0, 0, 1], *LINE)
    assert exact.visible_length == pytest.approx(0.7, abs=1e-15)


def test_5_9_transparent_occluders_multiply_and_do_not_count_as_blocked():
    # Ten panes of 0.9 in three bands; a binary count would report 0.
    stack = [rectangle(-2, 2, -2, 2, z) for z in np.linspace(0.3, 1.7, 10)]
    geometry = geometry_of(stack, transmittance=0.9, bands=3)
    found = adaptive_linear_occlusion(VoxelGrid(geometry), ORIGIN, LINE)
    assert np.allclose(1.0 - found.occlusion, 0.9**10, rtol=1e-14, atol=0.0)
    assert found.occlusion.shape == (1, 3) and found.shots == 3
