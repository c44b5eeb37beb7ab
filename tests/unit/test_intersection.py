"""The intersection routine against rational arithmetic: the judge is judged."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_scenes import box_triangles, geometry_of, rectangle

from workbench.accel.brute import BruteForce
from workbench.errors import InputError
from workbench.geometry.polygons import check_polygon


def _exact(values):
    return [Fraction(float(x)) for x in values]


def _cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def rational_hit(origin, direction, polygon):
    """t of the ray's crossing with a closed convex polygon, None for none or an edge-on polygon."""
    origin, direction = _exact(origin), _exact(direction)
    corners = [[x - o for x, o in zip(_exact(corner), origin, strict=True)] for corner in polygon]
    edge = [[y - x for x, y in zip(corners[0], corner, strict=True)] for corner in corners[1:3]]
    normal = _cross(*edge)
    slope = _dot(normal, direction)
    if slope == 0:
        return None
    sides = [_dot(direction, _cross(a, b)) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    if not (all(s >= 0 for s in sides) or all(s <= 0 for s in sides)):
        return None
    return _dot(normal, corners[0]) / slope


@settings(max_examples=80, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_hits_on_a_lattice_equal_rational_arithmetic(seed):
    # Lattice points: rays along edges, through corners, in planes and from surfaces, all exact.
    rng = np.random.default_rng(seed)
    polygons = []
    while len(polygons) < 6:
        polygon = rng.integers(-3, 4, (3, 3)).astype(float)
        if rng.random() < 0.5:
            polygon = np.array([polygon[0], polygon[1], polygon[1] + polygon[2] - polygon[0], polygon[2]])
        if check_polygon([polygon]) is None:
            polygons.append(polygon)
    origins = rng.integers(-4, 5, (25, 3)).astype(float)
    directions = rng.integers(-2, 3, (25, 3)) * rng.choice([0.5, 1.0, 4.0], (25, 1))
    directions[~directions.any(axis=1)] = [1.0, 0.0, 0.0]
    hits = BruteForce(geometry_of(polygons)).closest_hit(origins, directions)
    for row, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        met = [(t, i) for i, p in enumerate(polygons) if (t := rational_hit(origin, direction, p)) is not None]
        ahead = min(((t, i) for t, i in met if t > 0), default=None)
        if ahead is None:
            assert np.isinf(hits.t[row])
        else:
            assert hits.t[row] == pytest.approx(float(ahead[0]), rel=1e-14)
            # Two polygons may cross the ray in one point; rounding then picks either.
            tied = {i for t, i in met if t == ahead[0]}
            assert hits.polygon[row] in tied


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_random_hits_equal_rational_arithmetic(seed):
    rng = np.random.default_rng(seed)
    polygons = [rng.normal(size=(3, 3)) for _ in range(4)]
    polygons.append(np.array([polygons[0][0], polygons[0][1], polygons[0][1] + 2.0**-20 * rng.normal(size=3)]))
    origins, directions = rng.normal(size=(20, 3)) * 2, rng.normal(size=(20, 3))
    tracer = BruteForce(geometry_of(polygons))
    for polygon in polygons:
        alone = BruteForce(geometry_of([polygon])).closest_hit(origins, directions)
        for row in range(20):
            t = rational_hit(origins[row], directions[row], polygon)
            expected = float(t) if t is not None and t > 0 else np.inf
            assert alone.t[row] == pytest.approx(expected, rel=1e-9)
    assert (tracer.closest_hit(origins, directions).t <= alone.t).all()


@pytest.mark.parametrize("seed", range(12))
def test_watertight_when_stretched_a_million_times(seed):
    # A closed box of 108 triangles, turned, stretched into slivers and turned again: every ray from
    # inside is stopped, also those aimed at points of shared edges and at corners.
    rng = np.random.default_rng(seed)
    triangles = box_triangles([-1, -1, -1], [1, 1, 1], 3)
    turns = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2)]
    matrix = turns[0] @ np.diag(10.0 ** rng.uniform(-3, 3, 3)) @ turns[1]
    corners, place = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    moved = (corners @ matrix)[place.ravel()].reshape(triangles.shape)
    count = 3000
    origins = rng.uniform(-0.9, 0.9, (count, 3)) @ matrix
    chosen = triangles[rng.integers(0, len(triangles), count)]
    share = rng.random((count, 1)) * rng.choice([0.0, 1.0], (count, 1))
    directions = (chosen[:, 0] * (1 - share) + chosen[:, 1] * share) @ matrix - origins
    free = rng.random(count) < 0.4
    directions[free] = rng.normal(size=(free.sum(), 3))
    assert BruteForce(geometry_of(moved)).occluded(origins, directions, np.inf).all()


def test_spheres():
    # Unit sphere at z = 5: hits at 4 and 6, from inside 1, a tangent ray passes.
    tracer = BruteForce(geometry_of([rectangle(-1, 1, -1, 1, 9)]), spheres=[[0, 0, 5, 1], [3, 0, 5, 0.5]])
    origins = [[0, 0, 0], [0, 0, 5], [1, 0, 0], [3, 0, 0], [0, 0, 7], [0, 0, 8]]
    directions = [[0, 0, 2.0], [0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, -1], [0, 0, 1]]
    hits = tracer.closest_hit(origins, directions)
    assert hits.t.tolist() == [2.0, 1.0, 9.0, 4.5, 1.0, 1.0]
    assert hits.polygon.tolist() == [1, 1, 0, 2, 1, 0]  # numbered on from the only polygon
    assert not tracer.occluded([0, 0, 0], [0, 0, 1.0], 8.0, skip_polygons=[1, -1]).any()
    assert tracer.counters["sphere_tests"] > 0
    # A far-off origin costs no digits: 1e6 radii away, hit to 1e-9.
    far = tracer.closest_hit([0, 0, -1e6], [0, 0, 1.0]).t
    assert far == pytest.approx(1e6 + 4.0, abs=1e-9)
    for bad in ([[0, 0, 0, -1]], [[0, 0, 0]], [[0, 0, np.nan, 1]]):
        with pytest.raises(InputError, match="spheres"):
            BruteForce(geometry_of(), spheres=bad)


def test_transmittance_multiplies_bands_and_stops_at_opaque_surfaces():
    panes = [rectangle(-1, 1, -1, 1, z) for z in (1, 2)]
    tracer = BruteForce(geometry_of(panes, [rectangle(0, 1, -1, 1, 3)], transmittance=(0.5, 0.0), bands=3))
    through = tracer.transmitted([[-0.5, 0, 0], [0.5, 0, 0], [5, 0, 0]], [0, 0, 4.0])
    assert through.tolist() == [[0.25] * 3, [0.0] * 3, [1.0] * 3]
    assert tracer.occluded([-0.5, 0, 0], [0, 0, 4.0]).all()  # a transparent polygon still lies along the ray


def test_counts_every_test():
    tracer = BruteForce(geometry_of([rectangle(-1, 1, -1, 1, z) for z in (1, 2, 3)]), spheres=[[0, 0, 9, 1]])
    tracer.closest_hit(np.zeros((2, 3)), [0, 0, 1.0])
    assert dict(tracer.counters) == {"rays": 2, "rays_hit": 2, "polygon_tests": 6, "sphere_tests": 2}
    tracer.occluded(np.zeros((2, 3)), [0, 0, 1.0])  # z = 1 is met first and not inside 0 < t < 1
    assert tracer.counters["polygon_tests"] == 12
    tracer.occluded(np.zeros((1, 3)), [0, 0, 1.5])  # stops at the first
    assert tracer.counters["polygon_tests"] == 13
