"""Adaptive area lights: corners, then quadrants; against plain recursion, brute force and broken loops."""

from __future__ import annotations

import broken_kernels
import numpy as np
import pytest
from broken_kernels import break_kernel
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_scenes import FAR, UNIT_SQUARE_LIGHT, geometry_of, nasty_polygons, rectangle

from workbench.accel import voxel_grid
from workbench.accel.brute import BruteForce
from workbench.accel.voxel_grid import RAY_ID_LIMIT, RayIDs, VoxelGrid
from workbench.errors import InputError
from workbench.shadow import woo
from workbench.shadow.woo import adaptive_area_occlusion

SEEDS = st.integers(0, 2**32 - 1)
ORIGIN = np.zeros((1, 3))
KITE = np.array([[0, 0, 2], [1.5, 0.25, 2], [1, 1, 2], [0, 0.5, 2.0]])


def at(light, u, v):
    """Where lines that divide opposite edges in the ratios u and v meet."""
    near = light[0] + u * (light[1] - light[0])
    far = light[3] + u * (light[2] - light[3])
    return near + v * (far - near)


def plain(tracer, point, light, least, most):
    """Blocked share of the area and rays shot, by recursion with a memory of rays."""
    spans = 2**most
    seen: dict[tuple[int, int], float] = {}

    def blocked(i, j):
        if (i, j) not in seen:
            seen[i, j] = float(tracer.occluded(point, at(light, i / spans, j / spans) - point)[0])
        return seen[i, j]

    def area(corners):
        return np.linalg.norm(np.cross(corners[2] - corners[0], corners[3] - corners[1])) / 2

    def cell(i, j, size):
        places = [(i, j), (i + size, j), (i + size, j + size), (i, j + size)]
        values = [blocked(*place) for place in places]
        if len(set(values)) > 1 and size > 1:
            half = size // 2
            return sum(cell(i + a * half, j + b * half, half) for a in (0, 1) for b in (0, 1))
        return np.mean(values) * area([at(light, a / spans, b / spans) for a, b in places])

    step = spans // 2**least
    total = sum(cell(i, j, step) for i in range(0, spans, step) for j in range(0, spans, step))
    return total / area(light), len(seen)


def _random_case(seed):
    rng = np.random.default_rng(seed)
    light = KITE if rng.random() < 0.5 else rectangle(0, 1, 0, 1, 1.5)
    if rng.random() < 0.5:
        light = light[::-1].copy()
    if rng.random() < 0.5:
        light = light @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = rng.uniform(-0.5, 1.5, (6, 3))
    polygons = nasty_polygons(rng, rng.integers(1, 16), np.concatenate([points, light]))
    return VoxelGrid(geometry_of(polygons), resolution=int(rng.choice([1, 3, 6]))), points, light


def _check(seed: int) -> None:
    grid, points, light = _random_case(seed)
    tracer = BruteForce(grid.geometry)
    for levels in ((0, 3), (1, 2), (2, 2)):
        open_loop = adaptive_area_occlusion(grid, points, light, levels=levels, check=False)
        checked = adaptive_area_occlusion(grid, points, light, levels=levels)
        by_boxes = adaptive_area_occlusion(grid, points, light, levels=levels, boxes=True)
        for found in (checked, by_boxes):
            assert (found.occlusion == open_loop.occlusion).all() and (found.shots == open_loop.shots).all()
            before, after = open_loop.counters, found.counters
            assert after["polygon_tests"] + after["tests_avoided"] == before["polygon_tests"]
        for row, point in enumerate(points):
            share, shots = plain(tracer, point, light, *levels)
            assert open_loop.occlusion[row, 0] == pytest.approx(share, abs=1e-13)
            assert open_loop.shots[row] == shots
        assert (open_loop.shots >= (2 ** levels[0] + 1) ** 2).all()
        assert (open_loop.shots <= (2 ** levels[1] + 1) ** 2).all()


@settings(max_examples=60, deadline=None)
@given(seed=SEEDS)
def test_equals_plain_recursion_with_and_without_the_check(seed):
    _check(seed)


BROKEN = {
    "ids advance by the rays shot": (
        "_adaptive_area_loop",
        "current = first + rays\n",
        "current = first + shots[row]\n",
    ),
    "last id one too low": ("_adaptive_area_loop", "last = first + rays - 1", "last = first + shots[row]"),
    "quadrants of the wrong size": (
        "_adaptive_area_loop",
        "stack[depth, 2] = half",
        "stack[depth, 2] = max(half - 1, 1)",
    ),
    "a corner forgotten": ("_adaptive_area_loop", "for corner in range(1, 4):", "for corner in range(1, 3):"),
    "equal cells on a quad that is none": ("_cell_area", "u = (i + (", "u = (0 * i + ("),
    "plane's side taken the wrong way": ("_light_planes", "if side > 0.0:", "if side < 0.0:"),
}


@pytest.mark.parametrize(("name", "old", "new"), BROKEN.values(), ids=BROKEN)
def test_fails_on_a_broken_loop(monkeypatch, name, old, new):
    for key in ("_adaptive_area_loop", "_cell_area", "_light_planes"):
        callers = [] if key == "_adaptive_area_loop" else [(woo, "_adaptive_area_loop")]
        monkeypatch.setitem(broken_kernels._CALLERS, (woo, key), callers)
    break_kernel(monkeypatch, woo, name, old, new)
    with pytest.raises(AssertionError):
        for seed in range(60):
            _check(seed)


def test_an_edge_across_the_light():
    # A half-plane hides x > 0.25 of the unit square at the height 2: at the lattice's 1/8 and 1/4.
    grid = VoxelGrid(geometry_of([rectangle(0.125, FAR, -FAR, FAR, 1)]))
    found = adaptive_area_occlusion(grid, ORIGIN, UNIT_SQUARE_LIGHT, levels=(0, 4))
    # Samples on the edge count as blocked, which moves it by half a cell of 1/16.
    assert found.occlusion == pytest.approx(0.25 + 1 / 32, abs=1e-12)
    # 9 of 17 columns' worth: far fewer than the whole lattice.
    assert 60 < found.shots[0] < 120 and found.counters["rays"] == found.shots[0]
    for most, bound in ((2, 0.13), (5, 0.017)):
        shares = adaptive_area_occlusion(grid, np.array([[0.013, 0.02, 0]]), UNIT_SQUARE_LIGHT, levels=(0, most))
        # Seen from x the edge falls on the light at 0.25 - x.
        assert abs(shares.occlusion.item() - (0.25 + 0.013)) < bound
    lit = adaptive_area_occlusion(grid, [[-3, 0, 0]], UNIT_SQUARE_LIGHT)
    dark = adaptive_area_occlusion(grid, [[3, 0, 0]], UNIT_SQUARE_LIGHT)
    assert (lit.occlusion, lit.shots, dark.occlusion, dark.shots) == (0.0, 4, 1.0, 4)


def test_corners_that_agree_miss_what_lies_between():
    # A square that hides the middle quarter of the light's area (5.6 in one dimension more).
    grid = VoxelGrid(geometry_of([rectangle(-0.13, 0.13, -0.13, 0.13, 1)]))
    assert adaptive_area_occlusion(grid, ORIGIN, UNIT_SQUARE_LIGHT).occlusion == 0.0
    found = adaptive_area_occlusion(grid, ORIGIN, UNIT_SQUARE_LIGHT, levels=(1, 4))
    # Edges fall half-way between samples at 1/4, blocked, and 5/16: a side of 9/16.
    assert found.occlusion == pytest.approx(0.5625**2, abs=1e-12)


def test_transparent_occluders_workers_and_overflow(monkeypatch):
    rng = np.random.default_rng(2)
    polygons = [rng.uniform(-1, 1, (3, 3)) * [1, 1, 0.3] + [0, 0, 1] for _ in range(12)]
    grid = VoxelGrid(geometry_of(polygons[:6], polygons[6:], transmittance=(0.5, 0.0)), resolution=4)
    points = np.column_stack([rng.uniform(-1, 1, (60, 2)), np.zeros(60)])
    one = adaptive_area_occlusion(grid, points, UNIT_SQUARE_LIGHT)
    assert (one.occlusion == adaptive_area_occlusion(grid, points, UNIT_SQUARE_LIGHT, check=False).occlusion).all()
    assert set(np.unique(one.occlusion)) - {0.0, 1.0}
    monkeypatch.setattr(voxel_grid, "BLOCK", 7)
    several = adaptive_area_occlusion(grid, points, UNIT_SQUARE_LIGHT, workers=3)
    assert (several.occlusion == one.occlusion).all() and dict(several.counters) == dict(one.counters)
    # Ids that run out are cleared; K of them go for each point.
    ids = RayIDs(grid.object_count)
    ids.current = RAY_ID_LIMIT - 100
    late = adaptive_area_occlusion(grid, points, UNIT_SQUARE_LIGHT, ids=ids)
    assert (late.occlusion == one.occlusion).all()
    assert ids.current == 1 + 81 * 59


def test_bad_arguments_get_one_clear_line():
    grid = VoxelGrid(geometry_of([rectangle(0, 1, 0, 1, 1)]))
    with pytest.raises(InputError, match="found 3 corners, expected the four"):
        adaptive_area_occlusion(grid, ORIGIN, UNIT_SQUARE_LIGHT[:3])
    with pytest.raises(InputError, match="convex parts"):
        adaptive_area_occlusion(grid, ORIGIN, [[0, 0, 2], [1, 0, 2], [0.2, 0.2, 2], [0, 1, 2]])
    for levels in ((2, 1), (-1, 3), (0, 9)):
        with pytest.raises(InputError, match="levels"):
            adaptive_area_occlusion(grid, ORIGIN, UNIT_SQUARE_LIGHT, levels=levels)
    with pytest.raises(InputError, match="lies on a sample"):
        adaptive_area_occlusion(grid, [[0, 0, 2]], UNIT_SQUARE_LIGHT)
