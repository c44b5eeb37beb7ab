"""Rays to lights are unbiased, their densities honest, and spread-out sets the better ones."""

from __future__ import annotations

import math

import numpy as np
import pytest
from instrument_scenes import UNIT_SQUARE_LIGHT, rectangle, truth
from scipy import stats

from workbench.sampling.sequences import SEQUENCES, owen_sobol, point_set, shifted
from workbench.shadow.lights import (
    DiskLight,
    LinearLight,
    PolygonLight,
    SphereLight,
    equal_weights,
    visible_share,
)

UP = np.array([0.0, 0.0, 1.0])
ONE = np.ones(1)
FRAME = [rectangle(-1, 1, -1, 1, 2)[::-1], rectangle(-0.5, 0.25, -0.5, 0.5, 2)]
L_SHAPE = np.array([[-1, -1, 2], [-1, 1, 2], [0, 1, 2], [0, 0, 2], [1, 0, 2], [1, -1, 2.0]])
LIGHTS = {
    "linear": LinearLight("l", ONE, [-1, 1, 2], [3, 1, 2]),
    "lambertian line": LinearLight("l", ONE, [-1, 0.1, 0.5], [3, 0.1, 0.5], True),
    "square": PolygonLight("p", ONE, UNIT_SQUARE_LIGHT),
    "square by solid angle": PolygonLight("p", ONE, UNIT_SQUARE_LIGHT, by_solid_angle=True),
    "triangle": PolygonLight("t", ONE, UNIT_SQUARE_LIGHT[:3]),
    "L": PolygonLight("c", ONE, L_SHAPE),
    "L, two-sided": PolygonLight("c", ONE, L_SHAPE[::-1].copy(), two_sided=True),
    "frame": PolygonLight("f", ONE, FRAME),
    "frame by solid angle": PolygonLight("f", ONE, FRAME, by_solid_angle=True),
    "across the horizon": PolygonLight("h", ONE, [[1, -1, -1], [1, -1, 1], [1, 1, 1], [1, 1, -1]], two_sided=True),
    "disk": DiskLight("d", ONE, [0.2, 0, 2], 0.7, [0.1, 0.2, -1]),
    "disk across the horizon": DiskLight("d", ONE, [1, 0, 0.2], 0.7, [-1, 0.2, 0]),
    "sphere": SphereLight("s", ONE, [0.5, 0, 2], 0.6),
    "sphere across the horizon": SphereLight("s", ONE, [1, 0, 0.2], 0.6),
}
POINTS = np.array([[0.1, 0.05, 0.0], [-0.6, 0.4, 0.1], [0.3, -0.2, -0.2]])
POINT_NORMALS = np.array([[0, 0, 1], [0.3, 0.1, 1], [-0.2, 0.4, 0.9]])


@pytest.mark.parametrize("name", LIGHTS)
def test_independent_rays_agree_with_the_closed_form_within_their_standard_error(name):
    # z-scores of 200 estimates of 64 rays at three points: mean 0 and variance 1.
    light = LIGHTS[name]
    rng = np.random.default_rng(len(name))
    truths = light.unit_irradiance(POINTS, POINT_NORMALS)
    assert truths.all()
    for row in range(3):
        u = rng.random((200, 64, 2))
        rays = light.sample(np.tile(POINTS[row], (200, 1)), POINT_NORMALS[row], u)
        parts = 64 * rays.weights
        error = parts.std(axis=1, ddof=1) / 8.0
        # Sidak over 3 points of 14 lights: |z| of the mean below 4.
        z = (parts.mean() - truths[row]) / (parts.std() / math.sqrt(parts.size))
        assert abs(z) < 4.0, f"{parts.mean()} against {truths[row]}"
        scores = (parts.mean(axis=1) - truths[row]) / error
        assert 0.75 < np.sqrt(np.mean(scores**2)) < 1.4
        # The density is the samples' own: each weight times it is cosines and distance, no more.
        assert (rays.density > 0.0).all()


def _histogram_is_uniform(values, cells) -> None:
    counts = np.bincount(np.minimum((values * cells).astype(int), cells - 1).ravel(), minlength=cells)
    assert stats.chisquare(counts).pvalue > 0.01 / 8


def test_samples_are_spread_as_their_density_says():
    u = np.random.default_rng(3).random((1, 40_000, 2))
    origin = np.zeros((1, 3))
    line = LIGHTS["linear"].sample(origin, UP, u)
    _histogram_is_uniform((line.directions[0, :, 0] + 1) / 4, 40)
    # The L has area 3: one third in each of its squares, and uniform in each.
    ell = LIGHTS["L"].sample(origin, UP, u).directions[0]
    cells = (np.floor(ell[:, 0] * 4) + 4).astype(int) * 8 + (np.floor(ell[:, 1] * 4) + 4).astype(int)
    counts = np.bincount(cells, minlength=64).reshape(8, 8)
    assert not counts[4:, 4:].any()
    inside = np.concatenate([counts[:4].ravel(), counts[4:, :4].ravel()])
    assert stats.chisquare(inside).pvalue > 0.01 / 8
    # By solid angle: shares of the frame's four sides by their solid angles, (Omega) from the point.
    light = LIGHTS["frame by solid angle"]
    rays = light.sample(origin, UP, u)
    x, y = rays.directions[0, :, 0], rays.directions[0, :, 1]
    sides = [(-1, -0.5, -1, 1), (0.25, 1, -1, 1), (-0.5, 0.25, -1, -0.5), (-0.5, 0.25, 0.5, 1)]

    def solid_angle(x0, x1, y0, y1):
        corner = lambda a, b: math.atan(a * b / (2 * math.sqrt(a * a + b * b + 4)))  # noqa: E731
        return corner(x1, y1) - corner(x0, y1) - corner(x1, y0) + corner(x0, y0)

    counts = [((x >= a) & (x < b) & (y >= c) & (y < d)).sum() for a, b, c, d in sides]
    angles = np.array([solid_angle(*side) for side in sides])
    assert rays.density == pytest.approx(1.0 / angles.sum(), rel=1e-12)
    assert stats.chisquare(counts, angles / angles.sum() * 40_000).pvalue > 0.01 / 8
    # The sphere's cap: 1 - cos uniform up to 1 - sqrt(1 - R^2 / d^2).
    sphere = LIGHTS["sphere"]
    rays = sphere.sample(origin, UP, u)
    unit = rays.directions[0] / np.linalg.norm(rays.directions[0], axis=1)[:, None]
    square = 0.25 + 4
    height = 1 - math.sqrt(1 - 0.36 / square)
    _histogram_is_uniform((1 - unit @ (sphere.centre / math.sqrt(square))) / height, 40)
    assert rays.density == pytest.approx(1 / (2 * math.pi * height), rel=1e-9)


def _edge_rays(u):
    # Below a half-plane z = 1, x > 0: rays to x < -p_x pass.
    x = np.array([-0.3, 0.0, 0.25])
    points = np.column_stack([x, 0 * x, 0 * x])
    rays = LIGHTS["square"].sample(points, UP, u)
    crossing = points[:, None, 0] + 0.5 * rays.directions[..., 0]
    return points, rays, (crossing <= 0.0).astype(float)


def _edge_truth() -> np.ndarray:
    # Lambert's formula over what is left of the light, -0.5 < x < -p_x.
    points, _, _ = _edge_rays(np.zeros((1, 2)))
    left = [PolygonLight("left", ONE, rectangle(-0.5, -x, -0.5, 0.5, 2)[::-1]) for x in points[:, 0]]
    return np.array([light.unit_irradiance(point, UP).item() for light, point in zip(left, points, strict=True)])


def test_the_edge_truth_is_the_known_profile():
    profile = np.array(truth("shadow/straight-edge/profile"))
    assert math.pi * _edge_truth() == pytest.approx(profile[[6, 12, 17]], rel=1e-9)


def test_weighted_rays_find_the_irradiance_behind_an_edge_and_equal_ones_the_area():
    points, rays, passes = _edge_rays(owen_sobol(3, 4096, 5))
    expected = _edge_truth()
    open_light = LIGHTS["square"].unit_irradiance(points, UP)
    assert (rays.weights * passes).sum(axis=1) == pytest.approx(expected, rel=3e-3)
    assert open_light * visible_share(rays.weights, passes) == pytest.approx(expected, rel=3e-3)
    # Equal weights: the area fraction clip(0.5 - x, 0, 1), off by 0.01 to 0.03 of the open irradiance.
    area = visible_share(equal_weights(rays), passes)
    assert area == pytest.approx([0.8, 0.5, 0.25], abs=3e-3)
    assert np.abs(area - expected / open_light)[[0, 2]].min() > 0.01


def test_well_spread_sets_need_fewer_rays():
    # RMS error of the weighted share at three points behind the edge, 100 sets each of 16 and 256.
    points, _, _ = _edge_rays(np.zeros((1, 2)))
    expected = _edge_truth()
    open_light = LIGHTS["square"].unit_irradiance(points, UP)
    rng = np.random.default_rng(9)
    errors = {}
    for name in SEQUENCES:
        for count in (16, 256):
            found = []
            for _ in range(100):
                _, rays, passes = _edge_rays(point_set(name, count, rng))
                found.append(open_light * visible_share(rays.weights, passes) / expected - 1.0)
            errors[name, count] = float(np.sqrt(np.mean(np.square(found))))
    slope = {name: math.log(errors[name, 256] / errors[name, 16]) / math.log(16) for name in SEQUENCES}
    # Independent rays: error falls as K^-1/2.  Strata along the edge: K^-3/4 or better.
    assert slope["independent"] == pytest.approx(-0.5, abs=0.06)
    for name in SEQUENCES:
        if name != "independent":
            assert errors[name, 256] < 0.5 * errors["independent", 256], name
            # A whole column of a shared jitter crosses an edge that lies along it at once.
            assert slope[name] < -0.6 or name in ("n-rooks", "uniform-jitter"), name


def test_sets_of_their_own_make_the_errors_of_neighbouring_points_independent():
    # 400 copies of one point: the mean over them converges, which one set for all would not.
    count = 400
    points = np.zeros((count, 3))
    expected = _edge_truth()[1]
    base = point_set("r2", 16, 1)
    for u in (owen_sobol(count, 16, 2), shifted(base, count, 2)):
        rays = LIGHTS["square"].sample(points, UP, u)
        estimates = (rays.weights * (rays.directions[..., 0] <= 0.0)).sum(axis=1)
        error = estimates.std(ddof=1) / math.sqrt(count)
        assert abs(estimates.mean() - expected) < 4 * error
        assert estimates.std() > 0.0
