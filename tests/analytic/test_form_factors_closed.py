"""Unoccluded form factors against closed forms written down here, in higher precision where they cancel.

Formulas: J. R. Howell, A Catalog of Radiation Heat Transfer Configuration Factors, C-11 to C-16 in the
form of J. R. Ehlert and T. F. Smith (1993), B-3, B-4, C-41; H. C. Hottel's crossed strings.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from radiosity.form_factors.analytic import crossed_strings, disk_to_disk, point_to_polygon, polygon_to_polygon
from workbench.errors import InputError
from workbench.geometry.lambert import lambert_piece

LONG = np.longdouble
PI = LONG("3.14159265358979323846264338327950288")
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
WALL = np.array([[0, 0, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1]], dtype=float)
"""Shares the edge x = 0, z = 0 with SQUARE and stands on it."""

needs_long_double = pytest.mark.skipif(
    np.finfo(LONG).eps > 2e-19, reason="the closed forms cancel: they need 80-bit long doubles as a reference"
)


def flat(x0, x1, y0, y1, z=0.0, *, up=True):
    """Rectangle parallel to z = 0."""
    ring = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]], dtype=float)
    return ring if up else ring[::-1].copy()


def upright(y0, y1, z0, z1, x=0.0):
    """Rectangle in the plane x, facing +x."""
    return np.array([[x, y0, z0], [x, y1, z0], [x, y1, z1], [x, y0, z1]], dtype=float)


def _corner_sum(x, y, eta, xi, term):
    total = magnitude = LONG(0)
    for i in range(2):
        for j in range(2):
            for k in range(2):
                for l in range(2):
                    value = term(x[i], y[j], eta[k], xi[l])
                    total += (-1) ** (i + j + k + l) * value
                    magnitude = max(magnitude, abs(value))
    area = 2 * PI * (x[1] - x[0]) * (y[1] - y[0])
    # The second value: how far rounding may have moved the first.
    return total / area, float(30 * np.finfo(LONG).eps * magnitude / area)


def parallel(first, second, z):
    """C-13: from x, y in ``first`` (x0, x1, y0, y1) to ``second`` in the parallel plane at z."""
    x, y, xi, eta = (np.array(pair, dtype=LONG) for pair in (first[:2], first[2:], second[:2], second[2:]))
    z = LONG(z)

    def term(x, y, eta, xi):
        a, b = x - xi, y - eta
        p, q = np.sqrt(a * a + z * z), np.sqrt(b * b + z * z)
        return b * p * np.arctan(b / p) + a * q * np.arctan(a / q) - z * z / 2 * np.log(a * a + b * b + z * z)

    return _corner_sum(x, y, eta, xi, term)


def perpendicular(first, second):
    """C-16: from ``first`` (x0, x1, y0, y1) in z = 0 to ``second`` (y0, y1, z0, z1) in x = 0."""
    x, y, eta, xi = (np.array(pair, dtype=LONG) for pair in (first[:2], first[2:], second[:2], second[2:]))

    def term(x, y, eta, xi):
        s, b = x * x + xi * xi, y - eta
        if s == 0:
            return b * b / 4 * np.log(b * b) if b else LONG(0)
        c = np.sqrt(s)
        return b * c * np.arctan(b / c) - (s - b * b) / 4 * np.log(s + b * b)

    return _corner_sum(x, y, eta, xi, term)


def opposed_rectangles(x, y):
    """C-11: aligned equal rectangles of sides x and y in units of their distance."""
    p, q = math.sqrt(1 + x * x), math.sqrt(1 + y * y)
    return (
        2 / (math.pi * x * y)
        * (
            math.log(p * q / math.sqrt(1 + x * x + y * y))
            + x * q * math.atan(x / q) + y * p * math.atan(y / p) - x * math.atan(x) - y * math.atan(y)
        )
    )  # fmt: skip


def hinged_rectangles(h, w):
    """C-14: perpendicular rectangles with a common edge of length 1; w is the sender's width, h the other's."""
    a, b, c = 1 + h * h + w * w, 1 + h * h, 1 + w * w
    r = h * h + w * w
    logs = math.log(c * b / a) + w * w * math.log(w * w * a / (c * r)) + h * h * math.log(h * h * a / (b * r))
    angles = w * math.atan(1 / w) + h * math.atan(1 / h) - math.sqrt(r) * math.atan(1 / math.sqrt(r))
    return (angles + logs / 4) / (math.pi * w)


def agree(found, wanted, rel):
    assert found == pytest.approx(float(wanted), rel=rel, abs=1e-300)


# Point to polygon


@pytest.mark.parametrize(
    ("a", "b", "c"), [(1, 1, 1), (0.5, 3, 2), (1e-3, 1, 1), (50, 0.1, 1), (1, 1, 1e-4), (1, 1, 1e4)]
)
def test_point_below_the_corner_of_a_parallel_rectangle(a, b, c):
    # B-3
    x, y = a / c, b / c
    wanted = (
        x / math.hypot(1, x) * math.atan(y / math.hypot(1, x)) + y / math.hypot(1, y) * math.atan(x / math.hypot(1, y))
    ) / (2 * math.pi)
    agree(point_to_polygon([0, 0, 0], [0, 0, 1], flat(0, a, 0, b, c))[0], wanted, 1e-12)


@pytest.mark.parametrize("distance", [2.0, 0.1, 1e-3, 1e-6])
def test_point_beside_a_wall_tends_to_one_half(distance):
    # B-4 for the wall y in (-1, 1), z in (0, 1): twice that of one side.
    d = distance
    wanted = (math.atan(1 / d) - d / math.hypot(1, d) * math.atan(1 / math.hypot(1, d))) / math.pi
    agree(point_to_polygon([d, 0, 0], [0, 0, 1], upright(-1, 1, 0, 1))[0], wanted, 1e-13)
    assert wanted < 0.5


def test_either_side_counts_unless_one_sided():
    above, below = flat(-1, 1, -1, 1, 1.0, up=True), flat(-1, 1, -1, 1, 1.0, up=False)
    both = [point_to_polygon([0.2, 0, 0], [0, 0, 1], ring)[0] for ring in (above, below)]
    assert both[0] == pytest.approx(both[1], rel=1e-15)
    assert point_to_polygon([0.2, 0, 0], [0, 0, 1], below, one_sided=True)[0] == both[1]
    assert point_to_polygon([0.2, 0, 0], [0, 0, 1], above, one_sided=True)[0] == 0.0


def test_both_directions_of_the_normal_share_a_wall_across_the_horizon():
    # The wall half above and half below: each half to the normal that faces it.
    wall = upright(-1, 1, -1, 1, x=-1.0)
    up, down = point_to_polygon([[0, 0, 0]] * 2, [[0, 0, 1], [0, 0, -1]], wall)
    half = point_to_polygon([0, 0, 0], [0, 0, 1], upright(-1, 1, 0, 1, x=-1.0))[0]
    assert up == pytest.approx(half, rel=1e-14) and down == pytest.approx(half, rel=1e-14)


def test_in_the_plane_is_zero_and_near_it_small_finite_and_monotone():
    heights = [0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3, 0.1]
    points = [[2.0, 0.1, height] for height in heights]
    values = point_to_polygon(points, [[-1, 0, 0]] * len(points), SQUARE)
    assert values[0] == 0.0
    assert np.isfinite(values).all() and (np.diff(values) >= 0).all()
    # Linear in the height while it is small.
    assert values[4] / values[3] == pytest.approx(1e3, rel=1e-5)


def test_concave_polygons_and_holes_are_sums_of_their_parts():
    ell = np.array([[-1, -1, 1], [1, -1, 1], [1, 0, 1], [0, 0, 1], [0, 1, 1], [-1, 1, 1]], dtype=float)
    points, normals = [[-0.5, 0.5, 0], [0.7, 0.9, 0.5]], [[0, 0, 1], [0.3, -0.5, 0.6]]
    whole = point_to_polygon(points, normals, flat(-1, 1, -1, 1, 1))
    cut = point_to_polygon(points, normals, flat(0, 1, 0, 1, 1))
    assert np.allclose(point_to_polygon(points, normals, ell), whole - cut, rtol=1e-13, atol=1e-16)
    for hole in (flat(0, 1, 0, 1, 1) * [0.5, 0.5, 1], flat(0, 1, 0, 1, 1, up=False) * [0.5, 0.5, 1]):
        ringed = point_to_polygon(points, normals, flat(-1, 1, -1, 1, 1), [hole])
        assert np.allclose(ringed, whole - point_to_polygon(points, normals, hole), rtol=1e-13, atol=1e-16)


@pytest.mark.parametrize("shift", [0.0, 1e3, 1e6])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_point_factor_keeps_under_shift_and_scale(shift, scale):
    # Failure modes 4.10 and 4.11; coordinates of 1e6 leave nine digits of a unit square.
    ring = flat(-0.5, 0.5, -0.5, 0.5, 2.0)
    wanted = point_to_polygon([0.25, 0, 0], [0, 0, 1], ring)[0]
    found = point_to_polygon((np.array([[0.25, 0, 0]]) + shift) * scale, [0, 0, 1], (ring + shift) * scale)[0]
    agree(found, wanted, 1e-14 + 1e-15 * shift)


def test_the_directions_above_a_point_add_up_to_one():
    # Five faces of a cube round the point, its sixth lies in its plane.
    point, normal = [0.3, -0.2, 0.0], [0, 0, 1]
    faces = [
        flat(-1, 1, -1, 1, 1), upright(-1, 1, 0, 1, -1), upright(-1, 1, 0, 1, 1),
        upright(-1, 1, 0, 1, -1)[:, [1, 0, 2]], upright(-1, 1, 0, 1, 1)[:, [1, 0, 2]], flat(-1, 1, -1, 1, 0),
    ]  # fmt: skip
    assert sum(point_to_polygon(point, normal, face)[0] for face in faces) == pytest.approx(1.0, abs=1e-14)


def test_lambert_moves_with_the_point_and_changes_sign_with_the_winding():
    rng = np.random.default_rng(5)
    for _ in range(50):
        triangle, point = rng.normal(size=(3, 3)), rng.normal(size=3)
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        rays = triangle - point
        one = lambert_piece(*point, *normal, triangle, 0, 3)
        assert lambert_piece(0.0, 0.0, 0.0, *normal, rays, 0, 3) == pytest.approx(one, rel=1e-14, abs=1e-17)
        assert lambert_piece(*point, *normal, triangle[::-1].copy(), 0, 3) == pytest.approx(-one, rel=1e-12, abs=1e-15)


def test_lambert_by_quadrature_of_the_kernel():
    nodes, weights = np.polynomial.legendre.leggauss(24)
    nodes, weights = (nodes + 1) / 2, weights / 2
    corner, u, v = np.array([0.4, -0.3, 1.0]), np.array([1.0, 0.2, 0.3]), np.array([-0.1, 0.8, 0.4])
    s, t = np.meshgrid(nodes, nodes)
    x = corner + s[..., None] * u + t[..., None] * v
    face = np.cross(u, v)
    normal = np.array([0.3, 0.1, 0.9]) / np.linalg.norm([0.3, 0.1, 0.9])
    kernel = np.abs(x @ face) * (x @ normal) / (math.pi * (x**2).sum(axis=2) ** 2)
    wanted = float(weights @ kernel @ weights)
    found = point_to_polygon([0, 0, 0], normal, [corner, corner + u, corner + u + v, corner + v])[0]
    agree(found, wanted, 1e-12)


@pytest.mark.parametrize(
    ("points", "normals", "polygon", "words"),
    [
        ([[0, 0, 0]], [[0, 0, 0]], SQUARE, "length zero"),
        ([[0, 0, 0]] * 2, [[0, 0, 1]], SQUARE, "1 rows for 2 points"),
        ([[0, 0, np.nan]], [[0, 0, 1]], SQUARE, "not finite"),
        ([[0, 0, 0]], [[0, 0, 1]], SQUARE[:2], "2 vertices"),
        ([[0, 0, 0]], [[0, 0, 1]], SQUARE * [1, 0, 1], "zero area"),
        ([[0, 0, 0]], [[0, 0, 1]], SQUARE + [[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0.1]], "non-planar"),
        ([[0, 0, 0]], [[0, 0, 1]], SQUARE[[0, 2, 1, 3]], "zero area|cross"),
    ],
)
def test_bad_points_and_polygons_get_one_line(points, normals, polygon, words):
    with pytest.raises(InputError, match=words) as caught:
        point_to_polygon(points, normals, polygon)
    assert "\n" not in str(caught.value)


# Polygon to polygon


@pytest.mark.parametrize(("x", "y"), [(1, 1), (2, 1), (0.3, 7), (100, 100), (1e3, 1e3), (100, 0.5)])
def test_opposed_rectangles(x, y):
    agree(polygon_to_polygon(flat(0, x, 0, y), flat(0, x, 0, y, 1, up=False)), opposed_rectangles(x, y), 2e-12)


@pytest.mark.parametrize("distance", [10.0, 1e2, 1e3, 1e4, 1e6])
def test_far_pairs_do_not_cancel(distance):
    # Failure mode 7.4: a series in 1/d^2, as the closed form itself loses all digits there.
    found = polygon_to_polygon(SQUARE, flat(0, 1, 0, 1, distance, up=False))
    # Mean of d^2 / (pi r^4) with r^2 = d^2 + u: 1 - 2 <u> / d^2 + 3 <u^2> / d^4, <u> = 1/3, <u^2> = 17/90.
    s = 1 / distance**2
    wanted = (1 - 2 * s / 3 + 17 * s * s / 30) * s / math.pi
    agree(found, wanted, max(3 * s**3, 1e-13))
    assert found > 0


@pytest.mark.parametrize(("h", "w"), [(1, 1), (3, 2), (0.01, 1), (1, 0.01), (1e-4, 1e-4), (50, 0.2)])
def test_rectangles_with_a_common_edge(h, w):
    sender, receiver = flat(0, w, 0, 1), upright(0, 1, 0, h)
    agree(polygon_to_polygon(sender, receiver), hinged_rectangles(h, w), 1e-11)


def test_a_gap_at_the_edge_is_continuous():
    # Failure mode 7.3.
    touching = polygon_to_polygon(SQUARE, WALL)
    last = touching
    for gap in (1e-9, 1e-6, 1e-3):
        value = polygon_to_polygon(flat(gap, 1, 0, 1), upright(0, 1, gap, 1))
        assert value < last
        assert touching - value < gap
        last = value


@needs_long_double
@settings(max_examples=80, deadline=None)
@given(
    size=st.tuples(*[st.floats(-1.5, 1.5)] * 4),
    move=st.tuples(*[st.floats(-2.0, 2.0)] * 2),
    height=st.floats(-2.0, 1.5),
)
def test_any_parallel_rectangles(size, move, height):
    a, b, c, d = (10.0**e for e in size)
    first, second = (0.0, a, 0.0, b), (move[0] * a, move[0] * a + c, move[1] * b, move[1] * b + d)
    wanted, doubt = parallel(first, second, 10.0**height)
    assume(doubt < 1e-11 * wanted)
    found = polygon_to_polygon(flat(*first), flat(*second, 10.0**height, up=False))
    agree(found, wanted, 1e-9)


@needs_long_double
@settings(max_examples=80, deadline=None)
@given(
    size=st.tuples(*[st.floats(-1.5, 1.5)] * 4),
    move=st.floats(-2.0, 2.0),
    gap=st.tuples(*[st.sampled_from([0.0, 1e-9, 1e-6, 1e-3, 0.3])] * 2),
)
def test_any_perpendicular_rectangles(size, move, gap):
    a, b, c, d = (10.0**e for e in size)
    first, second = (gap[0], gap[0] + a, 0.0, b), (move * b, move * b + c, gap[1], gap[1] + d)
    wanted, doubt = perpendicular(first, second)
    assume(doubt < 1e-11 * wanted)
    agree(polygon_to_polygon(flat(*first), upright(*second)), wanted, 1e-9)


@needs_long_double
@pytest.mark.parametrize(("length", "width"), [(100, 0.01), (1000, 0.1), (300, 1e-3), (10, 1e-3)])
def test_slender_plates_side_by_side(length, width):
    # Their edges' terms in the contour integral cancel to one part in 1e7 and beyond.
    wanted, doubt = parallel((0, length, 0, width), (0, length, 0, width), 1.0)
    assert doubt < 1e-9 * wanted
    agree(polygon_to_polygon(flat(0, length, 0, width), flat(0, length, 0, width, 1, up=False)), wanted, 1e-9 + doubt)


def test_slender_plates_approach_the_strips_of_crossed_strings():
    # Howell C-2: infinite strips of width 1 at distance 1, (sqrt(2) - 1); long plates lose their ends.
    strips = crossed_strings([[0, 0], [1, 0]], [[0, 1], [1, 1]])
    assert strips == pytest.approx(math.sqrt(2) - 1, rel=1e-15)
    ends = [strips - polygon_to_polygon(flat(0, n, 0, 1), flat(0, n, 0, 1, 1, up=False)) for n in (1e2, 1e3, 1e4)]
    assert ends[0] > ends[1] > ends[2] > 0
    assert ends[1] / ends[2] == pytest.approx(10, rel=0.01)


def test_one_degree_wedge_stays_below_one():
    # Failure mode 7.2; value from the double contour integral in 30 digits.
    for degrees, wanted in ((1.0, 0.9829971785746487), (0.1, 0.9982613916541436)):
        angle = math.radians(degrees)
        turned = np.array(
            [[0, 1, 0], [math.cos(angle), 1, math.sin(angle)], [math.cos(angle), 0, math.sin(angle)], [0, 0, 0]]
        )
        found = polygon_to_polygon(SQUARE, turned)
        agree(found, wanted, 1e-12)
        assert found <= 1.0
    assert polygon_to_polygon(SQUARE, flat(0, 1, 0, 1, 1e-9, up=False)) <= 1.0


def test_a_polygon_across_the_horizon_counts_only_above_it():
    # Failure mode 7.5: a wall from below to above the square's plane equals its upper part.
    wall, top = upright(0, 1, -0.5, 0.5, -0.5), upright(0, 1, 0, 0.5, -0.5)
    agree(polygon_to_polygon(SQUARE, wall), polygon_to_polygon(SQUARE, top), 1e-14)
    # Both across: each is clipped by the other's plane.
    first, second = flat(-1, 1, 0, 1), upright(0, 1, -1, 1)
    agree(polygon_to_polygon(first, second), 0.5 * hinged_rectangles(1, 1), 1e-12)
    agree(polygon_to_polygon(second, first), 0.5 * hinged_rectangles(1, 1), 1e-12)


@pytest.mark.parametrize(
    "receiver",
    [
        flat(0, 1, 0, 1, 1),  # back to front
        flat(0, 1, 0, 1, -1),  # behind
        flat(1, 2, 0, 1, 0),  # coplanar, touching
        flat(3, 4, 0, 1, 0, up=False),  # coplanar, turned over
        upright(0, 1, -1, 0, 0),  # below the shared edge
        upright(0, 1, 0, 1, 0)[::-1],  # stands on the edge, looks away
    ],
)
def test_what_cannot_see_each_other_exchanges_exactly_nothing(receiver):
    assert polygon_to_polygon(SQUARE, receiver) == 0.0
    assert polygon_to_polygon(receiver, SQUARE) == 0.0


def test_coplanar_neighbours_far_from_the_origin_exchange_nothing():
    turn = Rotation.from_rotvec([0.3, -0.7, 0.2]).as_matrix()
    move = np.array([1e4, -2e4, 3e3])
    first, second = SQUARE @ turn.T + move, flat(1, 2, 0, 1) @ turn.T + move
    assert polygon_to_polygon(first, second) < 1e-9


def _tilted_pair(rng):
    """A random convex polygon and triangle, any relation to each other."""
    angle = np.sort(rng.choice(24, rng.integers(3, 7), replace=False)) * (2 * np.pi / 24)
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))]) * rng.uniform(0.2, 2.0)
    triangle = rng.normal(size=(3, 3)) + rng.normal(size=3)
    return ring, triangle


@pytest.mark.parametrize("seed", range(40))
def test_reciprocity_shift_turn_and_scale(seed):
    rng = np.random.default_rng(seed)
    first, second = _tilted_pair(rng)
    area = [float(np.linalg.norm(0.5 * np.cross(r, np.roll(r, -1, axis=0)).sum(axis=0))) for r in (first, second)]
    there, back = polygon_to_polygon(first, second), polygon_to_polygon(second, first)
    assert area[0] * there == pytest.approx(area[1] * back, rel=1e-11, abs=1e-16)
    turn = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    moved = polygon_to_polygon(first @ turn.T * 1e3 + 2e3, second @ turn.T * 1e3 + 2e3)
    assert moved == pytest.approx(there, rel=1e-9, abs=1e-13)


@pytest.mark.parametrize("seed", range(12))
def test_against_lambert_over_the_receiver(seed):
    # Gauss points of the first polygon's triangles, each with the closed form of a point; smooth pairs only.
    rng = np.random.default_rng(100 + seed)
    heights = np.zeros(1)
    while not (heights > 0.5).all():  # wholly in front of each other
        first, second = _tilted_pair(rng)
        second = second * 0.7 + [0.0, 0.0, 4.0]
        face = np.cross(second[1] - second[0], second[2] - second[0])
        heights = np.append((first - second[0]) @ face / np.linalg.norm(face), second[:, 2])
    nodes, weights = np.polynomial.legendre.leggauss(16)
    nodes, weights = (nodes + 1) / 2, weights / 2
    u, v = (m.ravel() for m in np.meshgrid(nodes, nodes))
    w = np.outer(weights, weights).ravel()
    total = area = 0.0
    for k in range(1, len(first) - 1):
        a, e, f = first[0], first[k] - first[0], first[k + 1] - first[k]
        points = a + u[:, None] * e + (u * v)[:, None] * f
        part = float(np.linalg.norm(np.cross(e, f)))
        seen = point_to_polygon(points, np.tile([0, 0, 1.0], (len(points), 1)), second, one_sided=True)
        total += part * float((w * u) @ seen)
        area += 0.5 * part
    agree(polygon_to_polygon(first, second), total / area, 1e-9)


def test_concave_polygons_and_holes_add_up():
    lid = flat(0, 2, 0, 2, 1, up=False)
    ell = np.array([[0, 2, 1], [1, 2, 1], [1, 1, 1], [2, 1, 1], [2, 0, 1], [0, 0, 1]], dtype=float)
    floor = flat(0, 2, 0, 2)
    corner = polygon_to_polygon(floor, flat(1, 2, 1, 2, 1, up=False))
    agree(polygon_to_polygon(floor, ell), polygon_to_polygon(floor, lid) - corner, 1e-12)
    hole = flat(0.5, 1.5, 0.5, 1.5, 1)
    centre = polygon_to_polygon(floor, hole[::-1])
    for ring in (hole, hole[::-1]):
        agree(polygon_to_polygon(floor, lid, receiver_holes=[ring]), polygon_to_polygon(floor, lid) - centre, 1e-12)
    # From the frame: reciprocity, areas 3 and 4.
    framed = polygon_to_polygon(lid, floor, sender_holes=[hole])
    agree(3 * framed, 4 * (polygon_to_polygon(floor, lid) - centre), 1e-12)


@pytest.mark.parametrize("width", [1e-3, 2.0**-13, 1e-6, 1e-9])
def test_slivers_keep_reciprocity(width):
    # Failure mode 4.6.  In the limit a sliver sees what a line of points sees.  Coordinates of 1 hold a
    # width to 1e-16.
    sliver = np.array([[0, 0, 0], [1, 0, 0], [1, width, 0]])
    lid = flat(0, 1, 0, 1, 1, up=False)
    there, back = polygon_to_polygon(sliver, lid), polygon_to_polygon(lid, sliver)
    assert 0.5 * width * there == pytest.approx(back, rel=1e-9)
    nodes, weights = np.polynomial.legendre.leggauss(30)
    t = (nodes + 1) / 2
    points = np.column_stack([t, t * width / 2, 0 * t])
    line = float(weights @ (t * point_to_polygon(points, np.tile([0, 0, 1.0], (30, 1)), lid)))
    agree(there, line, 1e-10 + width**2 + 4e-16 / width)


def test_the_faces_of_a_cube_add_up_to_one():
    others = [flat(0, 1, 0, 1, 1, up=False), upright(0, 1, 0, 1), upright(0, 1, 0, 1, 1)[::-1]]
    others += [upright(0, 1, 0, 1)[::-1][:, [1, 0, 2]], upright(0, 1, 0, 1, 1)[:, [1, 0, 2]]]
    assert sum(polygon_to_polygon(SQUARE, other) for other in others) == pytest.approx(1.0, abs=1e-13)


def test_the_asked_error_is_kept():
    wanted = hinged_rectangles(1, 1)
    for error in (1e-3, 1e-6, 1e-9):
        agree(polygon_to_polygon(SQUARE, WALL, error=error), wanted, error)
    with pytest.raises(InputError, match="error: found 0"):
        polygon_to_polygon(SQUARE, WALL, error=0)


# Strips and disks


def test_crossed_strings_of_any_order_and_of_hinged_strips():
    # Howell C-5: two strips of equal width with a common edge at angle a, 1 - sin(a / 2).
    for degrees in (10, 60, 90, 150):
        angle = math.radians(degrees)
        first, second = [[0, 0], [1, 0]], [[0, 0], [math.cos(angle), math.sin(angle)]]
        agree(crossed_strings(first, second), 1 - math.sin(angle / 2), 1e-13)
    assert crossed_strings([[0, 0], [2, 0]], [[0, 1], [1, 1]]) == crossed_strings([[0, 0], [2, 0]], [[1, 1], [0, 1]])
    with pytest.raises(InputError, match="width zero"):
        crossed_strings([[0, 0], [0, 0]], [[0, 1], [1, 1]])
    with pytest.raises(InputError, match="shapes"):
        crossed_strings([[0, 0, 0], [1, 0, 0]], [[0, 1], [1, 1]])


def test_disks_keep_reciprocity_limits_and_digits():
    for one, two, distance in ((1.0, 0.5, 2.0), (0.1, 3.0, 1.0), (1.0, 1.0, 1e-3)):
        assert one**2 * disk_to_disk(one, two, distance) == pytest.approx(
            two**2 * disk_to_disk(two, one, distance), rel=1e-13
        )
    # A small disk below a large one sees sin^2 of its half-angle; far disks see pi r^2 / (pi d^2).
    agree(disk_to_disk(1e-4, 1.0, 1.0), 0.5, 1e-8)
    agree(disk_to_disk(1.0, 1.0, 1e6), 1e-12, 1e-11)
    # Equal touching disks: 1 - h / r + h^2 / (2 r^2).
    agree(disk_to_disk(1.0, 1.0, 1e-6), 1 - 1e-6 + 0.5e-12, 1e-13)
    with pytest.raises(InputError, match="distance"):
        disk_to_disk(1.0, 1.0, 0.0)


def test_disks_against_regular_polygons():
    # A polygon of n corners and the disk's area: both errors fall as 1 / n^2.
    wanted = disk_to_disk(1.0, 0.5, 2.0)
    errors = []
    for n in (32, 64):
        angle = np.arange(n) * (2 * np.pi / n)
        ring = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
        ring *= math.sqrt(2 * np.pi / n / math.sin(2 * np.pi / n))
        errors.append(abs(polygon_to_polygon(ring, (ring * 0.5 + [0, 0, 2.0])[::-1]) / wanted - 1))
    assert errors[1] < 1e-4 and errors[1] < errors[0] / 3
