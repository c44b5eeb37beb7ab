"""Woo's loops against brute force, against a plain transcription of his figures, and broken on purpose."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from broken_kernels import break_kernel
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_scenes import (
    UNIT_SQUARE_LIGHT,
    convex_light,
    geometry_of,
    line_samples,
    nasty_polygons,
    polygon_samples,
    rectangle,
)

from workbench.accel import voxel_grid
from workbench.accel.brute import BruteForce
from workbench.accel.voxel_grid import RayIDs, VoxelGrid
from workbench.errors import InputError
from workbench.shadow import woo
from workbench.shadow.woo import (
    MARGIN,
    adaptive_linear_occlusion,
    irradiance_weights,
    light_occlusion,
    soft_shadow_kludge,
)

SEEDS = st.integers(0, 2**32 - 1)
LINE = np.array([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]])


# --- the law: a culler changes counts, never answers ------------------------------------------------


def _random_case(seed: int, linear: bool, points: int = 6, rays: int = 5):
    """A grid of nasty polygons, points (some in line with the light, some in its plane), samples."""
    rng = np.random.default_rng(seed)
    light = rng.choice([0.0, 0.5, 1.0, 1.5], (2, 3)) if linear else convex_light(rng)
    if linear and (rng.random() < 0.5 or (light[0] == light[1]).all()):
        light = rng.uniform(-0.5, 1.5, (2, 3))
    if rng.random() < 0.5:
        light = light[::-1].copy()
    place = rng.uniform(-0.5, 1.5, (points, 3))
    on_lattice = rng.random(points) < 0.3
    place[on_lattice] = rng.integers(-2, 7, (on_lattice.sum(), 3)) / 4.0
    in_line = rng.random(points) < 0.2
    # On the light's line or plane, up to rounding: the normals there are noise.
    place[in_line] = light[0] + rng.uniform(-2.0, 3.0, (in_line.sum(), 1)) * (light[1] - light[0])
    polygons = nasty_polygons(rng, rng.integers(1, 16), np.concatenate([place, light]))
    sampler = line_samples if linear else polygon_samples
    samples = sampler(rng, light, points, rays)
    samples[(samples == place[:, None]).all(axis=2)] = light[0] + 0.375 * (light[1] - light[0])
    apart = (samples != place[:, None]).any(axis=2).all(axis=1)
    resolution = rng.choice([1, 3, 6])
    return VoxelGrid(geometry_of(polygons), resolution=int(resolution)), place[apart], light, samples[apart]


def _check_law(seed: int, linear: bool, margin: float = MARGIN) -> None:
    grid, points, light, samples = _random_case(seed, linear)
    rays = samples.shape[1]
    origins = np.repeat(points, rays, axis=0)
    blocked = BruteForce(grid.geometry).occluded(origins, samples.reshape(-1, 3) - origins)
    brute = np.where(blocked, 0.0, 1.0).reshape(len(points), rays, 1)
    plain = light_occlusion(grid, points, light, samples, check=False)
    by_vertices = light_occlusion(grid, points, light, samples, margin=margin)
    by_boxes = light_occlusion(grid, points, light, samples, boxes=True, margin=margin)
    for found in (plain, by_vertices, by_boxes):
        assert (found.transmitted == brute).all()
        assert (found.occlusion == 1.0 - brute.mean(axis=1)).all()
    before, vertices, boxes = plain.counters, by_vertices.counters, by_boxes.counters
    for after in (vertices, boxes):
        assert after["polygon_tests"] + after["tests_avoided"] == before["polygon_tests"]
        for same in ("rays", "rays_hit", "voxels_stepped", "mailbox_skips"):
            assert after[same] == before[same]
        assert after["plane_vertex_culls"] <= after["plane_vertex_checks"]
    assert before["plane_vertex_checks"] == before["tests_avoided"] == 0
    assert boxes["plane_vertex_culls"] <= vertices["plane_vertex_culls"]


@settings(max_examples=400, deadline=None)
@given(seed=SEEDS)
def test_linear_light_equals_brute_force_bit_for_bit(seed):
    _check_law(seed, linear=True)


@settings(max_examples=400, deadline=None)
@given(seed=SEEDS)
def test_area_light_equals_brute_force_bit_for_bit(seed):
    _check_law(seed, linear=False)


@settings(max_examples=200, deadline=None)
@given(seed=SEEDS)
def test_adaptive_linear_light_is_the_same_with_and_without_the_check(seed):
    grid, points, light, _ = _random_case(seed, linear=True)
    shots = light[0] + np.arange(17)[:, None] / 16 * (light[1] - light[0])
    points = points[(points[:, None] != shots).any(axis=2).all(axis=1)]
    plain = adaptive_linear_occlusion(grid, points, light, check=False)
    checked = adaptive_linear_occlusion(grid, points, light)
    assert (plain.occlusion == checked.occlusion).all()
    assert (plain.shots == checked.shots).all()
    assert (plain.shots >= 3).all() and (plain.shots <= 17).all()
    avoided = plain.counters["polygon_tests"] - checked.counters["polygon_tests"]
    assert avoided == checked.counters["tests_avoided"]


@settings(max_examples=100, deadline=None)
@given(seed=SEEDS)
def test_transparent_scenes_are_the_same_with_and_without_the_check(seed):
    grid, points, light, samples = _random_case(seed, linear=bool(seed % 2))
    rng = np.random.default_rng(seed)
    polygons = [grid.geometry.piece(i) for i in range(grid.geometry.piece_count)]
    half = len(polygons) // 2
    geometry = geometry_of(polygons[:half], polygons[half:], transmittance=(rng.uniform(0.1, 1.0), 0.0))
    panes = VoxelGrid(geometry, resolution=3)
    plain = light_occlusion(panes, points, light, samples, check=False)
    checked = light_occlusion(panes, points, light, samples)
    assert (plain.transmitted == checked.transmitted).all()
    origins = np.repeat(points, samples.shape[1], axis=0)
    brute = BruteForce(geometry).transmitted(origins, samples.reshape(-1, 3) - origins)
    # Brute force multiplies in another order.
    assert np.allclose(brute.ravel(), plain.transmitted.ravel(), rtol=1e-13, atol=0.0)


@pytest.mark.parametrize("linear", [True, False])
def test_one_and_several_threads_agree_bit_for_bit(linear, monkeypatch):
    monkeypatch.setattr(voxel_grid, "BLOCK", 7)
    grid, points, light, samples = _random_case(3, linear, points=100)
    one = light_occlusion(grid, points, light, samples)
    for workers in (2, 5):
        several = light_occlusion(grid, points, light, samples, workers=workers)
        assert (several.transmitted == one.transmitted).all()
        assert dict(several.counters) == dict(one.counters)


# --- each law fails when a sign, an epsilon or an id is wrong ---------------------------------------


def _breaks(law, seeds=range(150)) -> None:
    with pytest.raises(AssertionError):
        for seed in seeds:
            law(seed)


def test_law_fails_without_the_margin_of_rounding():
    # margin = 0: a light in line with S has a plane of pure noise, which culls.
    _breaks(lambda seed: _check_law(seed, linear=True, margin=0.0), range(2000))


@pytest.mark.parametrize("linear", [True, False])
def test_law_fails_with_a_margin_of_the_wrong_sign(linear):
    _breaks(lambda seed: _check_law(seed, linear, margin=-1e14))


BROKEN = {
    "plane's side taken the wrong way": ("_light_planes", "if side > 0.0:", "if side < 0.0:"),
    "winding trusted": ("_light_planes", "if side > 0.0:", "if False:"),
    "cross product with a wrong sign": ("_light_planes", "az * bx - ax * bz", "az * bx + ax * bz"),
    "culled polygons given m + K": ("_light_loop", "last = first + rays - 1", "last = first + rays"),
    "id not advanced by a ray": ("_light_loop", "current += 1", "current += i % 2"),
}


@pytest.mark.parametrize(("name", "old", "new"), BROKEN.values(), ids=BROKEN)
def test_law_fails_on_a_broken_loop(monkeypatch, name, old, new):
    break_kernel(monkeypatch, woo, name, old, new)
    _breaks(lambda seed: _check_law(seed, linear=False))


def test_law_fails_when_one_vertex_outside_is_enough(monkeypatch):
    break_kernel(monkeypatch, voxel_grid, "_outside_a_plane", "if not distance > margin:", "if distance > margin:")
    _breaks(lambda seed: _check_law(seed, linear=False))


def test_law_fails_when_adaptive_ids_advance_by_the_rays_shot(monkeypatch):
    # Woo: currRayID goes to m + 17 "regardless of how many shadow rays were actually shot".
    break_kernel(monkeypatch, woo, "_adaptive_loop", "current = first + rays\n", "current = first + shots[row]\n")
    _breaks(test_adaptive_linear_light_is_the_same_with_and_without_the_check.hypothesis.inner_test)


# --- counters: a plain transcription of Figures 2 and 4, in exact arithmetic ------------------------


class PlainWoo:
    """Figures 2 and 4 word for word, with rational numbers and the grid's own voxel lists."""

    def __init__(self, grid: VoxelGrid) -> None:
        cells = grid.cells
        self.low = [Fraction(float(x)) for x in cells.low]
        self.size = [Fraction(float(x)) for x in cells.size]
        self.resolution = [int(n) for n in cells.resolution]
        self.lists = [cells.items[a:b].tolist() for a, b in zip(cells.start[:-1], cells.start[1:], strict=True)]
        self.polygons = [self.exact(grid.geometry.piece(i)) for i in range(grid.geometry.piece_count)]
        self.ray_id = [0] * len(self.polygons)
        self.current = 1
        self.count = dict.fromkeys(voxel_grid.COUNTED, 0)
        self.tested: set[tuple[int, int]] = set()

    @staticmethod
    def exact(points):
        return [[Fraction(float(x)) for x in point] for point in points]

    @staticmethod
    def cross(a, b):
        return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]

    @staticmethod
    def dot(a, b):
        return sum(x * y for x, y in zip(a, b, strict=True))

    @staticmethod
    def minus(a, b):
        return [x - y for x, y in zip(a, b, strict=True)]

    def voxels(self, origin, direction):
        """Amanatides and Woo's walk: tMax and tDelta."""
        enter, leave = Fraction(0), Fraction(1)
        for o, d, low, size, n in zip(origin, direction, self.low, self.size, self.resolution, strict=True):
            near, far = sorted([(low - o) / d, (low + n * size - o) / d])
            enter, leave = max(enter, near), min(leave, far)
        if enter > leave:
            return
        cell, t_max, t_delta, step = [], [], [], []
        for o, d, low, size, n in zip(origin, direction, self.low, self.size, self.resolution, strict=True):
            i = min(max((o + enter * d - low) // size, 0), n - 1)
            cell.append(int(i))
            step.append(1 if d > 0 else -1)
            t_max.append((low + (i + (d > 0)) * size - o) / d)
            t_delta.append(abs(size / d))
        while True:
            self.count["voxels_stepped"] += 1
            yield (cell[0] * self.resolution[1] + cell[1]) * self.resolution[2] + cell[2]
            axis = t_max.index(min(t_max))
            if t_max[axis] >= leave:
                return
            cell[axis] += step[axis]
            t_max[axis] += t_delta[axis]

    def intersect(self, origin, direction, polygon) -> bool:
        corners = [self.minus(corner, origin) for corner in polygon]
        normal = self.cross(self.minus(corners[1], corners[0]), self.minus(corners[2], corners[0]))
        slope = self.dot(normal, direction)
        if slope == 0:
            return False
        t = self.dot(normal, corners[0]) / slope
        sides = [self.dot(direction, self.cross(a, b)) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
        return 0 < t < 1 and (all(s >= 0 for s in sides) or all(s <= 0 for s in sides))

    def planes(self, point, light):
        """Outward normals N and d = N . S; both ways for a linear light."""
        centre = [sum(axis) / len(light) for axis in zip(*light, strict=True)]
        found = []
        for a, b in zip(light, light[1:] + light[:1], strict=True):
            normal = self.cross(self.minus(point, a), self.minus(point, b))
            if len(light) == 2:
                back = [-x for x in normal]
                return [(normal, self.dot(normal, point)), (back, self.dot(back, point))]
            if self.dot(normal, centre) > self.dot(normal, point):
                normal = [-x for x in normal]
            found.append((normal, self.dot(normal, point)))
        return found

    def crosses(self, planes, polygon) -> bool:
        return not any(all(self.dot(normal, v) > d for v in polygon) for normal, d in planes)

    def shade(self, point, light, samples, check: bool) -> list[bool]:
        point, light = self.exact([point])[0], self.exact(light)
        rays = len(samples)
        m = self.current
        planes = self.planes(point, light)
        occluded = []
        for i, sample in enumerate(self.exact(samples)):
            self.count["rays"] += 1
            occluded.append(self.shadow_ray(point, self.minus(sample, point), i, m, rays, planes, check))
            self.count["rays_hit"] += occluded[-1]
            self.current += 1
        return occluded

    def shadow_ray(self, point, direction, i, m, rays, planes, check) -> bool:
        met = set()
        for voxel in self.voxels(point, direction):
            for obj in self.lists[voxel]:
                again, met = obj in met, met | {obj}
                if self.ray_id[obj] >= self.current:
                    self.count["mailbox_skips" if again else "tests_avoided"] += 1
                    continue
                if check and self.ray_id[obj] < m and i != rays - 1:
                    self.count["plane_vertex_checks"] += 1
                    if not self.crosses(planes, self.polygons[obj]):
                        self.count["plane_vertex_culls"] += 1
                        self.count["tests_avoided"] += 1
                        self.ray_id[obj] = m + rays - 1
                        continue
                self.ray_id[obj] = self.current
                self.count["polygon_tests"] += 1
                self.tested.add((self.current, obj))
                if self.intersect(point, direction, self.polygons[obj]):
                    return True
        return False


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("corners", [2, 3, 4])
@pytest.mark.parametrize("rays", [1, 5])
def test_counters_equal_a_plain_transcription_of_the_figures(seed, corners, rays):
    rng = np.random.default_rng(100 * corners + seed)
    polygons = [rng.uniform(0.0, 1.0, 3) + rng.uniform(-0.3, 0.3, (3, 3)) for _ in range(14)]
    grid = VoxelGrid(geometry_of(polygons), resolution=4)
    points = rng.uniform(-0.2, 1.2, (4, 3))
    # Two lights a point, from the same mailboxes.
    if corners == 2:
        lights = [rng.uniform(0.0, 1.0, (2, 3)) + [0, 0, 1.5] for _ in range(2)]
        samples = [line_samples(rng, light, 4, rays) for light in lights]
    else:
        ring = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)[:corners]
        lights = [ring @ np.linalg.qr(rng.normal(size=(3, 3)))[0] + [0, 0, 1.5], ring[::-1] + [0.3, 0.2, 1.7]]
        samples = [polygon_samples(rng, light, 4, rays) for light in lights]
    tests = {}
    for check in (False, True):
        plain, ids = PlainWoo(grid), RayIDs(grid.object_count)
        counted = dict.fromkeys(voxel_grid.COUNTED, 0)
        for row in range(len(points)):
            for light, targets in zip(lights, samples, strict=True):
                expected = plain.shade(points[row], light, targets[row], check)
                found = light_occlusion(grid, points[row], light, targets[row : row + 1], check=check, ids=ids)
                assert (found.transmitted[0, :, 0] == np.where(expected, 0.0, 1.0)).all()
                for name, count in found.counters.items():
                    counted[name] += count
        assert counted == plain.count
        assert ids.current == plain.current == 1 + 8 * rays
        assert ids.mailbox.tolist() == plain.ray_id
        tests[check] = plain.tested
    # "Tests avoided" are the tests of Figure 2 that Figure 4 does not make, and no others.
    assert tests[True] <= tests[False]
    assert len(tests[False] - tests[True]) == counted["tests_avoided"]
    if rays == 1:
        assert counted["plane_vertex_checks"] == 0  # i != K - 1 guards the only ray


def test_any_hit_order_saves_what_a_nearest_hit_search_would_add():
    rng = np.random.default_rng(5)
    polygons = [rng.uniform(0.0, 1.0, 3) + rng.uniform(-0.3, 0.3, (3, 3)) for _ in range(60)]
    grid = VoxelGrid(geometry_of(polygons))
    points = rng.uniform(0.0, 1.0, (50, 3))
    samples = line_samples(rng, LINE, 50, 6)
    found = light_occlusion(grid, points, LINE, samples, check=False, count_any_hit=True)
    origins = np.repeat(points, 6, axis=0)
    nearest = VoxelGrid(geometry_of(polygons))
    nearest.closest_hit(origins, samples.reshape(-1, 3) - origins, 1.0)
    saved = nearest.counters["polygon_tests"] - found.counters["polygon_tests"]
    assert found.counters["any_hit_tests_saved"] == saved > 0


def test_spheres_are_checked_tested_and_counted():
    rng = np.random.default_rng(6)
    balls = np.column_stack([rng.uniform(-1, 1, (30, 2)), rng.uniform(0.2, 1.8, 30), rng.uniform(0.02, 0.3, 30)])
    grid = VoxelGrid(geometry_of([rectangle(-3, 3, -3, 3, -0.5)]), spheres=balls)
    points = np.column_stack([rng.uniform(-1, 1, (80, 2)), np.zeros(80)])
    samples = polygon_samples(rng, UNIT_SQUARE_LIGHT, 80, 8)
    origins = np.repeat(points, 8, axis=0)
    blocked = BruteForce(grid.geometry, spheres=balls).occluded(origins, samples.reshape(-1, 3) - origins)
    plain = light_occlusion(grid, points, UNIT_SQUARE_LIGHT, samples, check=False)
    for boxes in (False, True):
        found = light_occlusion(grid, points, UNIT_SQUARE_LIGHT, samples, boxes=boxes)
        assert ((found.transmitted.ravel() == 0.0) == blocked).all()
        assert found.counters["plane_vertex_culls"] > 0
        done = found.counters["sphere_tests"] + found.counters["polygon_tests"] + found.counters["tests_avoided"]
        assert done == plain.counters["sphere_tests"] + plain.counters["polygon_tests"]


# --- weights ----------------------------------------------------------------------------------------


def test_weights_equal_their_formula():
    # One sample straight up at height 2, one at 45 degrees: cos / r^2 = 1/4 and cos 45 / 8.
    samples = np.array([[[0, 0, 2.0], [2, 0, 2.0]]])
    c = np.sqrt(0.5)
    assert np.allclose(irradiance_weights([0, 0, 0], [0, 0, 1], samples), [[0.25, c / 8]])
    lit = irradiance_weights([0, 0, 0], [0, 0, 1], samples, light_normal=[0, 0, -1])
    assert np.allclose(lit, [[0.25, c * c / 8]])
    along = irradiance_weights([0, 0, 0], [0, 0, 1], samples, light_axis=[1, 0, 0])
    assert np.allclose(along, [[0.25, c * c / 8]])
    assert not irradiance_weights([0, 0, 0], [0, 0, -1], samples).any()
    assert not irradiance_weights([0, 0, 0], [0, 0, 1], samples, light_normal=[0, 0, 1]).any()


def test_weighted_occlusion_is_the_weighted_mean_of_blocked_samples():
    grid = VoxelGrid(geometry_of([rectangle(0, 5, -5, 5, 1)]))  # hides the light's half x > 0 from the origin
    samples = np.array([[[-0.4, 0, 2], [-0.2, 0, 2], [0.1, 0, 2], [0.3, 0, 2.0]]])
    weights = np.array([[1.0, 2.0, 3.0, 4.0]])
    assert light_occlusion(grid, [0, 0, 0], LINE, samples, weights=weights).occlusion == pytest.approx(0.7)
    assert light_occlusion(grid, [0, 0, 0], LINE, samples).occlusion == 0.5
    assert light_occlusion(grid, [0, 0, 0], LINE, samples, weights=0 * weights).occlusion == 0.0


# --- the adaptive light and the kludge --------------------------------------------------------------


def test_adaptive_light_shoots_three_rays_where_they_agree_and_more_at_an_edge():
    # The half-plane x > 0 at half height: the shadow's edge on the light lies at s = -x.
    grid = VoxelGrid(geometry_of([rectangle(0, 50, -50, 50, 1)]))
    x = np.array([-0.7, -0.3, 0.06, 0.7])
    points = np.column_stack([x, 0 * x, 0 * x])
    found = adaptive_linear_occlusion(grid, points, LINE)
    # 3 where all agree; an edge is halved 3 more times: 3 + 3.
    assert found.shots.tolist() == [3, 6, 6, 3]
    exact = np.clip(0.5 + x, 0.0, 1.0)
    assert (np.abs(found.occlusion[:, 0] - exact) <= 1.0 / 32.0).all()  # half of the last stretch
    assert found.counters["rays"] == found.shots.sum()
    uniform = adaptive_linear_occlusion(grid, points, LINE, levels=(4, 4))
    assert (uniform.shots == 17).all()
    assert np.allclose(uniform.occlusion, found.occlusion)


def test_kludge_is_one_ray_where_the_light_is_seen():
    grid = VoxelGrid(geometry_of([rectangle(0.5, 50, -50, 50, 1)]))
    fractions = (np.arange(8) + 0.5) / 8
    points = np.array([[0.8, 0, 0], [1.2, 0, 0], [3.0, 0, 0.0]])
    found = soft_shadow_kludge(grid, points, [[0, 0, 1]] * 3, [0, 0, 2], fractions)
    assert found.shots.tolist() == [1, 9, 9]
    # From x the line is blocked where 0.5 z / (z - 1) < x: z > x / (x - 0.5).
    z = 2.0 + 2.0 * fractions
    expected = [0.0, (z > 1.2 / 0.7).mean(), (z > 3.0 / 2.5).mean()]
    assert found.occlusion[:, 0].tolist() == expected
    assert found.counters["rays"] == 19


# --- bad input --------------------------------------------------------------------------------------


def test_bad_arguments_get_one_clear_line():
    grid = VoxelGrid(geometry_of([rectangle(0, 5, -5, 5, 1)]))
    samples = np.array([[[0.0, 0, 2], [0.25, 0, 2]]])
    concave = [[-1, -1, 2], [1, -1, 2], [1, 0, 2], [0, 0, 2], [0, 1, 2], [-1, 1, 2]]
    cases = [
        ({"light": concave}, "convex parts"),
        ({"light": [[0, 0, 2], [0, 0, 2]]}, "no length"),
        ({"light": [[0, 0, 2]]}, "corners"),
        ({"samples": samples + [0, 0, 1e-6]}, "off the light"),
        ({"samples": samples[0]}, "expected"),
        ({"points": [0.25, 0, 2]}, "on its point"),
        ({"weights": "cosine"}, "equal"),
        ({"weights": [[1.0, -1.0]]}, "negative"),
        ({"workers": 0}, "workers"),
        ({"ids": RayIDs(7)}, "ids"),
        ({"ids": RayIDs(1, 1, 2)}, "rayID"),
        ({"points": [1e12, 0, 0]}, "origins"),
    ]
    for change, words in cases:
        arguments = {"points": [0, 0, 0], "light": LINE, "samples": samples} | change
        with pytest.raises(InputError, match=words) as caught:
            light_occlusion(grid, **arguments)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="linear light"):
        adaptive_linear_occlusion(grid, [0, 0, 0], UNIT_SQUARE_LIGHT)
    with pytest.raises(InputError, match="on a sample"):
        adaptive_linear_occlusion(grid, [0.25, 0, 2], LINE)
    with pytest.raises(InputError, match="levels"):
        adaptive_linear_occlusion(grid, [0, 0, 0], LINE, levels=(3, 2))
    with pytest.raises(InputError, match="fractions"):
        soft_shadow_kludge(grid, [0, 0, 0], [0, 0, 1], [0, 0, 2], [0.0, 1.5])
    with pytest.raises(InputError, match="length"):
        soft_shadow_kludge(grid, [0, 0, 0], [0, 0, 1], [0, 0, 2], [0.5], length=0.0)
    with pytest.raises(InputError, match="first"):
        RayIDs(1, 0)
