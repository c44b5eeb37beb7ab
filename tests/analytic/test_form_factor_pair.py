"""``radiosity.form_factor``: one pair of polygons behind occluders, against truths, strips and brute force."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_scenes import rectangle
from radiosity_scenes import each_truth, polygon_scene, truth

import radiosity
from radiosity.form_factors._contour import contour_integral
from radiosity.form_factors.analytic import crossed_strings, polygon_to_polygon
from workbench.accel.brute import BruteForce
from workbench.errors import InputError
from workbench.geometry.flat import Geometry

LOWER = rectangle(-0.5, 0.5, -0.5, 0.5, 0.0)
UPPER = rectangle(-0.5, 0.5, -0.5, 0.5, 1.0)[::-1]
C11 = 0.19982489569838746
"""Howell C-11: unit squares a unit apart."""


def occluders_of(geometry):
    if "hole" in geometry:
        return [[rectangle(-9, 9, -9, 9, 0.5), np.array(geometry["hole"])]]
    if isinstance(geometry.get("occluder"), list):
        return [geometry["occluder"]]
    return []


@each_truth("", "P1")
@pytest.mark.parametrize("error", [1e-6, 1e-9])
def test_truths(name, error):
    case = truth(name)
    geometry = case["geometry"]
    if isinstance(geometry.get("occluders"), str):
        pytest.skip("occluders told in words: see the test of failure mode 2.1")
    value = case["value"][0] if isinstance(case["value"], list) else case["value"]
    second = [geometry["P2"], geometry["hole_in_P2"]] if "hole_in_P2" in geometry else geometry["P2"]
    found = radiosity.form_factor(geometry["P1"], second, occluders_of(geometry), error=error)
    assert abs(found - value) <= error
    assert abs(found - value) <= 3 * found.error + 1e-13
    assert (value == 0) == (found == 0)  # failure modes 7.6 and 7.8: exactly nothing, and never nothing of a sliver
    back = radiosity.form_factor(second, geometry["P1"], occluders_of(geometry), error=error)
    areas = [_area(p) for p in (geometry["P1"], second)]
    assert abs(back * areas[1] - found * areas[0]) <= error * (areas[0] + areas[1])


def _area(polygon):
    rings = polygon if np.ndim(polygon[0]) == 2 else [polygon]
    areas = []
    for ring in rings:
        ring = np.asarray(ring, float) - ring[0]
        areas.append(np.linalg.norm(0.5 * np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0)))
    return areas[0] - sum(areas[1:])


def test_shaft_candidates():
    # Failure mode 2.1: 121 small squares, of which 25 hide something.  Joined or not, they are cut exactly.
    squares = [
        rectangle(i / 4 - 0.05, i / 4 + 0.05, j / 4 - 0.05, j / 4 + 0.05, 0.5)
        for i in range(-5, 6)
        for j in range(-5, 6)
    ]
    found = radiosity.form_factor(LOWER, UPPER, squares, error=1e-8)
    assert found == pytest.approx(0.16904652877052923, abs=1e-8)


@each_truth("occ/strips/")
def test_strips_are_the_limit_of_long_quads(name):
    # Two-dimensional truth: the end of strips 2,000 gaps long lets a share of about half a gap in 2,000 escape.
    case = truth(name)
    geometry = case["geometry"]

    def strip(ends, length):
        (ax, az), (bx, bz) = ends
        return np.array([[ax, -length / 2, az], [bx, -length / 2, bz], [bx, length / 2, bz], [ax, length / 2, az]])

    values = []
    for length in (1000.0, 2000.0):
        lower, upper, between = (strip(geometry[key], length) for key in ("lower", "upper", "occluder"))
        values.append(radiosity.form_factor(lower, upper[::-1], [between], error=1e-6))
    assert abs(values[1] - case["value"]) < 4e-4
    # The error of the ends falls as 1 / length: extrapolated it is gone.
    assert 2 * values[1] - values[0] == pytest.approx(case["value"], abs=5e-6)


def test_strips_between_which_nothing_stands():
    long = 2000.0
    lower, upper = rectangle(0, 1, -long / 2, long / 2, 0), rectangle(0, 1, -long / 2, long / 2, 2)[::-1]
    assert radiosity.form_factor(lower, upper) == pytest.approx(
        crossed_strings([[0, 0], [1, 0]], [[0, 2], [1, 2]]), abs=1e-3
    )


@pytest.mark.parametrize("half", [0.499, 0.4999, 0.5, 0.51])
def test_slivers_of_a_nearly_full_wall(half):
    # Failure mode 7.8: however thin the visible rim, it is found; a wall of the squares' size hides all.
    found = radiosity.form_factor(LOWER, UPPER, [rectangle(-half, half, -half, half, 0.5)], error=1e-7)
    if half >= 0.5:
        assert found == 0
    else:
        # Thin rim of width w = 0.5 - half, four sides of length 1: the kernel is nearly constant across it.
        assert 0 < found < 4 * (1 - 2 * half) ** 1.5
        finer = radiosity.form_factor(LOWER, UPPER, [rectangle(-half, half, -half, half, 0.5)], error=1e-12)
        assert abs(found - finer) <= max(3 * found.error, 1e-12)


def test_joined_parts_split_parts_and_coincident_parts_hide_alike():
    # Failure mode 4.8: the union hides, not the product.
    whole = radiosity.form_factor(LOWER, UPPER, [rectangle(-0.3, 0.3, -0.3, 0.3, 0.5)], error=1e-8)
    split = [rectangle(-0.3, 0.1, -0.3, 0.3, 0.5), rectangle(0.1, 0.3, -0.3, 0.3, 0.5)]
    twice = [rectangle(-0.3, 0.3, -0.3, 0.3, 0.5), rectangle(-0.3, 0.2, -0.3, 0.3, 0.5)[::-1]]
    apart = [rectangle(-0.3, 0.3, -0.3, 0.3, 0.5), rectangle(-0.28, 0.28, -0.28, 0.28, 0.49)]
    for occluders in (split, twice):
        assert radiosity.form_factor(LOWER, UPPER, occluders, error=1e-8) == pytest.approx(whole, abs=2e-8)
    assert radiosity.form_factor(LOWER, UPPER, apart, error=1e-8) < whole + 1e-8


@pytest.mark.parametrize("shift", [0.0, 1e3, 1e5])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_anywhere_and_at_any_scale(shift, scale):
    # Failure modes 4.10 and 4.11.
    blocker = rectangle(-0.125, 0.125, -0.125, 0.125, 0.5)
    moved = [scale * (polygon + shift) for polygon in (LOWER, UPPER, blocker)]
    found = radiosity.form_factor(moved[0], moved[1], [moved[2]], error=1e-7)
    assert found == pytest.approx(0.16947420491178622, abs=1e-7 + 1e-14 * shift)


def test_what_lies_beside_behind_or_in_the_planes_hides_nothing():
    outside = [
        rectangle(-5, 5, -5, 5, -0.5),
        rectangle(-5, 5, -5, 5, 1.5),
        rectangle(0.6, 2, -1, 1, 0.5),
        rectangle(-0.2, 0.2, -0.2, 0.2, 0.0),
        rectangle(-0.2, 0.2, -0.2, 0.2, 1.0),
        np.array([[0.5, -0.5, 0], [0.5, 0.5, 0], [0.5, 0.5, 1], [0.5, -0.5, 1]]),
    ]
    assert radiosity.form_factor(LOWER, UPPER, outside) == pytest.approx(C11, abs=1e-9)


def test_concave_polygon_with_holes_behind_an_occluder():
    # The frame is its outline less its hole, and what is hidden of either adds up the same way.
    blocker = [np.array([[-0.4, -0.1, 0.4], [0.3, -0.2, 0.5], [0.2, 0.3, 0.45]])]
    hole = rectangle(-0.2, 0.25, -0.3, 0.1, 1.0)
    frame = radiosity.form_factor(LOWER, [UPPER, hole], blocker, error=1e-8)
    parts = [radiosity.form_factor(LOWER, p, blocker, error=1e-8) for p in (UPPER, hole[::-1])]
    assert frame == pytest.approx(parts[0] - parts[1], abs=3e-8)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1))
def test_agrees_with_rays(seed):
    # The law: no blocker may be dropped, none invented.  Random polygons between and beside random ends.
    rng = np.random.default_rng(seed)

    def polygon(centre, size):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        angle = np.sort(rng.random(rng.integers(3, 6))) * 2 * np.pi
        return centre + size * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) @ turn

    def usable(p):
        return np.linalg.norm(np.cross(p - p[0], np.roll(p, -1, axis=0) - p[0]).sum(axis=0)) > 0.1 * np.ptp(p) ** 2

    first, second = polygon(np.zeros(3), 1.0), polygon(np.array([0, 0, 2.0]), 1.0)
    blockers = [
        polygon(rng.uniform(-1, 1, 3) * [1, 1, 0.8] + [0, 0, 1], rng.uniform(0.2, 1)) for _ in range(rng.integers(1, 5))
    ]
    if not all(usable(p) for p in (first, second, *blockers)):
        return
    normals = []
    for p in (first, second):
        vector = np.cross(p - p[0], np.roll(p, -1, axis=0) - p[0]).sum(axis=0)
        normals.append(vector / np.linalg.norm(vector))
    if normals[0] @ [0, 0, 1] < 0:
        first, normals[0] = first[::-1], -normals[0]
    if normals[1] @ [0, 0, 1] > 0:
        second, normals[1] = second[::-1], -normals[1]
    found = radiosity.form_factor(first, second, blockers, error=1e-5)
    count = 20000
    fan = np.array([[first[0], first[k], first[k + 1]] for k in range(1, len(first) - 1)])
    size = np.linalg.norm(np.cross(fan[:, 1] - fan[:, 0], fan[:, 2] - fan[:, 0]), axis=1)
    chosen = fan[rng.choice(len(fan), count, p=size / size.sum())]
    s, t = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    start = (1 - s) * chosen[:, 0] + s * (1 - t) * chosen[:, 1] + s * t * chosen[:, 2]
    sphere = rng.normal(size=(count, 3))
    along = normals[0] + sphere / np.linalg.norm(sphere, axis=1)[:, None]
    tracer = BruteForce(Geometry.from_scene(polygon_scene(second, *blockers)))
    hits = tracer.closest_hit(start + 1e-9 * normals[0], along, np.inf)
    share = float(((hits.polygon == 0) & (along @ normals[1] < 0)).mean())
    assert abs(found - share) < 5 * math.sqrt(max(share, found) / count) + 5 / count
    assert found <= polygon_to_polygon(first, second) + 1e-5


def test_it_is_a_float_that_can_be_copied():
    found = radiosity.form_factor(LOWER, UPPER, error=1e-6)
    assert isinstance(found, float) and found == pytest.approx(C11) and found.error < 1e-6
    assert copy.deepcopy(found).error == found.error


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        ((LOWER[:2], UPPER), "polygon_a"),
        ((LOWER, [[0, 0], [1, 1]]), "polygon_b"),
        ((LOWER, UPPER * [1, 0, 0]), "polygon_b"),
        ((LOWER, UPPER, [LOWER, np.zeros((3, 3))]), r"occluders\[1\]"),
        ((LOWER, UPPER, [], 0.0), "error"),
        ((LOWER, UPPER, [], math.nan), "error"),
    ],
)
def test_bad_input_is_refused(arguments, wanted):
    with pytest.raises(InputError, match=wanted):
        radiosity.form_factor(*arguments)


def _upright(axis):
    """A wall from the lower to the upper unit square through their middle, across ``axis``."""
    wall = np.array([[0, -9, 0], [0, 9, 0], [0, 9, 1], [0, -9, 1]], dtype=float)
    return wall if axis == 0 else wall[:, [1, 0, 2]]


def test_walls_that_touch_both_polygons():
    # What stays on one side of the wall is the closed form of the halves, or of the quarters of crossing walls.
    half = polygon_to_polygon(rectangle(-0.5, 0, -0.5, 0.5, 0), rectangle(-0.5, 0, -0.5, 0.5, 1)[::-1])
    quarter = polygon_to_polygon(rectangle(-0.5, 0, -0.5, 0, 0), rectangle(-0.5, 0, -0.5, 0, 1)[::-1])
    for walls, exact in (([_upright(0)], half), ([_upright(0), _upright(1)], quarter)):
        found = radiosity.form_factor(LOWER, UPPER, walls, error=1e-6)
        assert abs(found - exact) <= found.error <= 1e-6
    slope = np.array([[-0.5, -9, 0], [0.5, -9, 1], [0.5, 9, 1], [-0.5, 9, 0]])
    assert radiosity.form_factor(LOWER, UPPER, [slope]) == 0


@pytest.mark.parametrize("degrees", [1e-3, 0.1, 1, 90, 179, 179.999])
def test_a_wall_across_a_wedge(degrees):
    # Penumbrae beside the wall are as thin as the wedge: what is hidden counts, not what cells see.
    angle = math.radians(degrees)
    floor = rectangle(0, 1, 0, 1, 0)
    leaf = np.array(
        [[0, 0, 0], [0, 1, 0], [math.cos(angle), 1, math.sin(angle)], [math.cos(angle), 0, math.sin(angle)]]
    )
    wall = np.array([[-9, 0.5, -9], [9, 0.5, -9], [9, 0.5, 9], [-9, 0.5, 9]])
    exact = polygon_to_polygon(floor * [1, 0.5, 1], leaf * [1, 0.5, 1])
    found = radiosity.form_factor(floor, leaf, [wall], error=1e-6)
    assert abs(found - exact) <= found.error <= 1e-6


@pytest.mark.parametrize("scale, shift", [(1e-3, 0.0), (1e6, 0.0), (1.0, 1e6)])
def test_scale_and_place_change_nothing(scale, shift):
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    occluder = rectangle(-0.25, 0.25, -0.25, 0.25, 0.5)
    plain = radiosity.form_factor(LOWER, UPPER, [occluder], error=1e-9)
    moved = [polygon @ turn.T * scale + shift for polygon in (LOWER, UPPER, occluder)]
    found = radiosity.form_factor(moved[0], moved[1], [moved[2]], error=1e-6)
    assert abs(found - plain) <= found.error <= 1e-6


def test_edges_that_clipping_leaves_in_a_common_corner_add_nothing():
    """A ceiling's triangle and a wall's that touch in one corner, each cut there by the other's plane.

    Slivers of 1e-10 are far from each other for their length and near for the pair: their distance is lost in the
    pair's.  Moved apart by 1e-7 the same two exchange the same.
    """
    ceiling = np.array([[0.53, 0.0, 2.65], [0.53 + 7.5e-11, 0.0, 2.65], [0.53, -2.0, 2.65], [-0.32, -2.0, 2.65]])
    wall = np.array([[0.53 + 8e-10, 0.0, 2.65], [0.0, 0.0, 0.0], [0.53 + 1e-9, 0.0, -0.35], [0.53 + 1e-9, 0.0, 2.65]])
    found, rounding = contour_integral(ceiling, 4, wall, 4, 1e-9)
    apart, _ = contour_integral(ceiling + [0, 0, 1e-7], 4, wall, 4, 1e-9)
    assert found == pytest.approx(apart, rel=1e-5) and 0.0 < found < 0.03 and rounding < 1e-12
