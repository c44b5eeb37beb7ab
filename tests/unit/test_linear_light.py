"""Linear lights in closed form: against quadrature, against shadows known by fractions, against rays."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_scenes import FAR, geometry_of, nasty_polygons, rectangle, truth

from workbench.accel.brute import BruteForce
from workbench.errors import InputError
from workbench.shadow.linear import linear_irradiance, visible_linear_irradiance

LINE = np.array([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]])
UP = np.array([0.0, 0.0, 1.0])
NODES, WEIGHTS = np.polynomial.legendre.leggauss(40)


def quadrature(point, normal, start, end, lambertian):
    """cos / r^2 (times sine) by Gauss rules that grow away from the foot of the perpendicular."""
    point, normal, start, end = (np.asarray(x, dtype=np.longdouble) for x in (point, normal, start, end))
    axis = end - start
    length = np.sqrt((axis**2).sum())
    foot = float(((point - start) * axis).sum() / length**2)
    cuts = {0.0, 1.0}
    rise0, rise1 = ((start - point) * normal).sum(), ((end - point) * normal).sum()
    if rise0 * rise1 < 0:
        cuts.add(float(rise0 / (rise0 - rise1)))
    for step in 2.0 ** np.arange(-24, 8):
        cuts |= {c for c in (foot - step, foot + step, foot) if 0.0 < c < 1.0}
    cuts = np.array(sorted(cuts), dtype=np.longdouble)
    total = np.longdouble(0)
    for lower, upper in pairwise(cuts):
        share = 0.5 * (lower + upper) + 0.5 * (upper - lower) * NODES.astype(np.longdouble)
        toward = start + share[:, None] * axis - point
        square = (toward**2).sum(axis=1)
        value = np.clip((toward * normal).sum(axis=1), 0, None) / square**1.5
        if lambertian:
            cosine = (toward * axis).sum(axis=1) / np.sqrt(square) / length
            value *= np.sqrt(np.clip(1 - cosine**2, 0, None))
        total += 0.5 * (upper - lower) * length * (WEIGHTS * value).sum()
    return float(total)


@pytest.mark.parametrize(("lambertian", "name"), [(False, "isotropic"), (True, "lambertian")])
def test_known_values(lambertian, name):
    # L1 = (-1, 1, 2), L2 = (3, 1, 2) over the origin: 0.48401280648 and 0.44052875388.
    found = linear_irradiance([0, 0, 0], UP, [-1, 1, 2], [3, 1, 2], lambertian=lambertian)
    assert found == pytest.approx({False: 0.48401280648045447, True: 0.4405287538798714}[lambertian], rel=1e-14)
    assert found == pytest.approx(truth(f"light/linear-{name}"), rel=1e-12)
    assert linear_irradiance([0, 0, 0], UP, [-1, 1, 2], [3, 1, 2], 2.5, lambertian=lambertian) == 2.5 * found


def test_a_long_line_overhead_gives_its_limit():
    # Infinite line at height h: isotropic 2 I / h, Lambertian pi I / (2 h).
    h, far = 0.75, 1e9
    ends = [-far, 0, h], [far, 0, h]
    assert linear_irradiance([0, 0, 0], UP, *ends) == pytest.approx(2 / h, rel=1e-12)
    assert linear_irradiance([0, 0, 0], UP, *ends, lambertian=True) == pytest.approx(np.pi / (2 * h), rel=1e-12)


@pytest.mark.parametrize("lambertian", [False, True])
@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_closed_form_equals_quadrature(lambertian, seed):
    rng = np.random.default_rng(seed)
    start, end = rng.uniform(-1, 1, (2, 3)) * 10.0 ** rng.uniform(-2, 1)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    kind = rng.integers(0, 3)
    if kind == 0:  # anywhere
        point = rng.uniform(-2, 2, 3)
    elif kind == 1:  # beside the light, close to it
        point = start + rng.random() * (end - start) + 10.0 ** rng.uniform(-4, 0) * rng.normal(size=3)
    else:  # nearly in line with it
        point = start + rng.choice([-1.0, 2.0]) * rng.random() * (end - start)
        point = point + 1e-3 * np.linalg.norm(end - start) * rng.normal(size=3)
    found = linear_irradiance(point, normal, start, end, lambertian=lambertian).item()
    expected = quadrature(point, normal, start, end, lambertian)
    whole = quadrature(point, (start - point) / np.linalg.norm(start - point), start, end, lambertian)
    # The input's own rounding: of the distance to the line, and of heights where light grazes.
    distance = np.linalg.norm(np.cross(point - start, end - start)) / np.linalg.norm(end - start)
    span = max(np.linalg.norm(start - point), np.linalg.norm(end - point))
    assert found == pytest.approx(expected, rel=1e-14 * (10 + span / distance), abs=1e-14 * abs(whole))
    assert found >= 0.0


def test_light_below_the_horizon_gives_nothing_and_one_across_it_its_upper_part():
    assert linear_irradiance([0, 0, 3], UP, *LINE) == 0.0
    upright = [1, 0, -1], [1, 0, 1]
    assert linear_irradiance([0, 0, 0], UP, *upright) == linear_irradiance([0, 0, 0], UP, [1, 0, 0], [1, 0, 1])
    # Vertical segment of height 1 at distance 1: 1/sqrt(1) - 1/sqrt(2).
    assert linear_irradiance([0, 0, 0], UP, *upright) == pytest.approx(1 - np.sqrt(0.5), rel=1e-15)


def test_in_line_with_the_light_and_on_it():
    # In line: the integral of 1 / r^2 from 1 to 2 is 1/2; a Lambertian line gives nothing there.
    ends = [0, 0, 1], [0, 0, 2]
    assert linear_irradiance([0, 0, 0], UP, *ends) == pytest.approx(0.5, rel=1e-15)
    assert linear_irradiance([0, 0, 0], UP, *ends, lambertian=True) == 0.0
    assert linear_irradiance([0, 0, 3], -UP, *ends) == pytest.approx(0.5, rel=1e-15)
    assert np.isinf(linear_irradiance([0, 0, 1.5], UP, *ends))
    # 1e-6 beside the line, where a Lambertian closed form loses all its digits to cancellation.
    for offset in (1e-3, 1e-6, 1e-9):
        near = linear_irradiance([offset, 0, 0], UP, *ends, lambertian=True)
        assert near == pytest.approx(offset * (1 - 1 / 4) / 2 * 1.0, rel=1e-5)  # h times the integral of 1 / v^3


def test_straight_edge():
    # Half-plane z = 1, x > 0 under the line: visible is s < -x.  Halves that meet in the light's
    # own plane y = 0 leave no gap there.
    x = np.array([-0.6, -0.5, -0.4, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    points = np.column_stack([x, 0 * x, 0 * x])
    whole = geometry_of([rectangle(0, FAR, -FAR, FAR, 1)])
    halves = geometry_of([rectangle(0, FAR, -FAR, 0, 1), rectangle(0, FAR, 0, FAR, 1)])
    for lambertian in (False, True):
        for geometry in (whole, halves):
            found = visible_linear_irradiance(geometry, points, UP, *LINE, lambertian=lambertian)
            for row, edge in enumerate(np.clip(-x, -0.5, 0.5)):
                expected = 0.0
                if edge > -0.5:
                    expected = linear_irradiance(points[row], UP, LINE[0], [edge, 0, 2], lambertian=lambertian).item()
                assert found.irradiance[row] == pytest.approx(expected, rel=1e-12, abs=0.0)
                assert found.visible_length[row] == pytest.approx(edge + 0.5, abs=1e-15)
    plain = visible_linear_irradiance(whole, points, UP, *LINE)
    assert plain.irradiance == pytest.approx(truth("shadow/straight-edge/linear-light"), rel=1e-12, abs=0.0)


@pytest.mark.parametrize("seed", range(8))
def test_union_of_shadows_equals_fractions(seed):
    # Rectangles across y = 0 at height z shadow the light from s0 to s1, by similar triangles, in
    # rational numbers; their union is summed there, overlaps, nested and touching ones included.
    rng = np.random.default_rng(seed)
    px = Fraction(int(rng.integers(-40, 41)), 64)
    rectangles, intervals = [], []
    for _ in range(12):
        x0, width = Fraction(int(rng.integers(-32, 32)), 64), Fraction(int(rng.integers(1, 9)), 64)
        z = Fraction(int(rng.integers(1, 127)), 64)
        if intervals and rng.random() < 0.3:  # begins where the last one ends
            x0 = rectangles[-1][1]
            z = rectangles[-1][2]
        rectangles.append((x0, x0 + width, z))
        intervals.append(sorted(px + (x - px) * 2 / z for x in (x0, x0 + width)))
    visible, reached = [], Fraction(-1, 2)
    for lower, upper in sorted(intervals):
        if min(lower, Fraction(1, 2)) > reached:
            visible.append((reached, min(lower, Fraction(1, 2))))
        reached = max(reached, upper)
    if reached < Fraction(1, 2):
        visible.append((reached, Fraction(1, 2)))
    geometry = geometry_of(
        [rectangle(float(a), float(b), -rng.uniform(0.1, 2), rng.uniform(0.1, 2), float(z)) for a, b, z in rectangles]
    )
    point = [float(px), 0, 0]
    for lambertian in (False, True):
        found = visible_linear_irradiance(geometry, point, UP, *LINE, lambertian=lambertian)
        expected = sum(
            linear_irradiance(point, UP, [float(a), 0, 2], [float(b), 0, 2], lambertian=lambertian).item()
            for a, b in visible
        )
        assert found.irradiance == pytest.approx(expected, rel=1e-12, abs=1e-15)
        assert found.visible_length == pytest.approx(float(sum(b - a for a, b in visible)), abs=1e-14)


@settings(max_examples=120, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_visible_length_agrees_with_rays(seed):
    rng = np.random.default_rng(seed)
    light = rng.uniform(-0.5, 1.5, (2, 3))
    points = rng.uniform(-0.5, 1.5, (5, 3))
    polygons = nasty_polygons(rng, rng.integers(1, 12), np.concatenate([points, light]))
    geometry = geometry_of(polygons)
    found = visible_linear_irradiance(geometry, points, rng.normal(size=(5, 3)), *light)
    rays = 400
    share = (np.arange(rays) + 0.5) / rays
    targets = light[0] + share[:, None] * (light[1] - light[0])
    origins = np.repeat(points, rays, axis=0)
    blocked = BruteForce(geometry).occluded(origins, np.tile(targets, (5, 1)) - origins).reshape(5, rays)
    # Each occluder's shadow has two ends, and each end is worth half a ray.
    assert (np.abs(found.visible_length - (~blocked).mean(axis=1)) <= (len(polygons) + 0.01) / rays).all()
    assert (found.irradiance <= found.unoccluded * (1 + 1e-12)).all()
    assert (found.irradiance >= 0.0).all()


@pytest.mark.parametrize("resolution", [3, 7])
def test_a_tessellated_wall_hides_all(resolution):
    # No gap between the shadows of triangles that share corners: exactly 0, for 500 points.
    rng = np.random.default_rng(resolution)
    steps = np.linspace(-4, 4, resolution + 1)
    x, y = np.meshgrid(steps, steps, indexing="ij")
    bump = np.stack([x, y, 1 + 0.2 * np.sin(3 * x + y)], axis=2)
    quads = [bump[:-1, :-1], bump[1:, :-1], bump[1:, 1:], bump[:-1, 1:]]
    corners = [q.reshape(-1, 3) for q in quads]
    triangles = [
        t
        for a, b, c, d in zip(*corners, strict=True)
        for t in (np.array([a, b, c]), np.array([a, c, d]))
    ]  # fmt: skip
    points = np.column_stack([rng.uniform(-1, 1, (500, 2)), np.zeros(500)])
    found = visible_linear_irradiance(geometry_of(triangles), points, UP, *LINE)
    assert not found.irradiance.any() and not found.visible_length.any()
    assert found.unoccluded.all()


def test_in_line_occluders():
    # From below, a square between point and light hides all; one that cuts the light, what is behind.
    ends = [0, 0, 1], [0, 0, 2]
    for z, expected in ((0.5, 0.0), (1.5, 1 - 1 / 1.5), (2.5, 0.5), (-0.5, 0.5)):
        square = geometry_of([rectangle(-0.5, 0.5, -0.5, 0.5, z)])
        for start, end in (ends, ends[::-1]):
            found = visible_linear_irradiance(square, [0, 0, 0], UP, start, end)
            assert found.irradiance == pytest.approx(expected, abs=1e-15)


def test_own_polygon_neighbours_and_choice_of_pieces():
    floor = [rectangle(-1, 0, -1, 1, 0), rectangle(0, 1, -1, 1, 0)]
    wall = rectangle(-1, 1, -1, 1, 1)
    # A point on the seam of two floor polygons, of which only one is skipped; in a slanting floor too.
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    for matrix in (np.eye(3), turn):
        normal, line = UP @ matrix, LINE @ matrix
        open_floor = geometry_of([p @ matrix for p in floor])
        point = np.array([[0, 0.3, 0.0], [0, -0.7, 0]]) @ matrix
        seen = visible_linear_irradiance(open_floor, point, normal, *line, skip_polygons=[0, -1])
        assert np.allclose(seen.irradiance, seen.unoccluded, rtol=1e-14)
        assert np.allclose(seen.unoccluded, linear_irradiance([[0, 0.3, 0], [0, -0.7, 0]], UP, *LINE))
    geometry = geometry_of([*floor, wall])
    assert visible_linear_irradiance(geometry, [0, 0, 0], UP, *LINE).irradiance == 0.0
    assert visible_linear_irradiance(geometry, [0, 0, 0], UP, *LINE, skip_polygons=[2, -1]).irradiance > 0.0
    assert visible_linear_irradiance(geometry, [0, 0, 0], UP, *LINE, pieces=[0, 1]).irradiance > 0.0
    # A ceiling in which the light is set does not hide it.
    ceiling = geometry_of([rectangle(-3, 3, -3, 3, 2)])
    lit = visible_linear_irradiance(ceiling, [0, 0, 0], UP, *LINE)
    assert lit.irradiance == lit.unoccluded


def test_workers_do_not_change_the_answer():
    rng = np.random.default_rng(9)
    geometry = geometry_of([rng.uniform(-1, 1, (3, 3)) + [0, 0, 1] for _ in range(20)])
    points = np.column_stack([rng.uniform(-1, 1, (9000, 2)), np.zeros(9000)])
    one = visible_linear_irradiance(geometry, points, UP, *LINE)
    two = visible_linear_irradiance(geometry, points, UP, *LINE, workers=2)
    assert (one.irradiance == two.irradiance).all()


def test_bad_arguments_get_one_clear_line():
    geometry = geometry_of([rectangle(0, 1, 0, 1, 1)])
    for arguments, words in (
        (([0, 0, 0], UP, LINE[0], LINE[0]), "two different points"),
        (([0, 0, np.inf], UP, *LINE), "finite"),
        (([0, 0, 0], [0, 0, 0], *LINE), "length zero"),
        (([[0, 0, 0]] * 3, [UP] * 2, *LINE), "normals"),
    ):
        with pytest.raises(InputError, match=words):
            linear_irradiance(*arguments)
        with pytest.raises(InputError, match=words):
            visible_linear_irradiance(geometry, *arguments)
    for pieces in ([1], [-1], [0.5], [[0]]):
        with pytest.raises(InputError, match="pieces"):
            visible_linear_irradiance(geometry, [0, 0, 0], UP, *LINE, pieces=pieces)
