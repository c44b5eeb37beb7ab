"""Are the standard errors of sampled shadows honest, and do the errors fall as they should?"""

from __future__ import annotations

import numpy as np
import pytest
from instrument_scenes import FAR, UNIT_SQUARE_LIGHT, geometry_of
from scipy import stats

from workbench.geometry.tessellation import sphere_mesh
from workbench.shadow.lights import LinearLight, SphereLight
from workbench.shadow.occlusion import AreaLight, Shader, estimate

UP = np.array([0.0, 0.0, 1.0])
SQUARE = AreaLight(UNIT_SQUARE_LIGHT, np.ones(1))
L_LIGHT = AreaLight(np.array([[-1, -1, 2], [-1, 1, 2], [0, 1, 2], [0, 0, 2], [1, 0, 2], [1, -1, 2.0]]), np.ones(1))


def scene(trial):
    """Points under a few triangles, from one large to twenty small ones."""
    rng = np.random.default_rng(trial)
    count, size = [(1, 0.8), (3, 0.4), (8, 0.25), (20, 0.12)][trial % 4]
    triangles = [
        rng.uniform([-0.8, -0.8, 0.3], [0.8, 0.8, 1.7]) + rng.uniform(-size, size, (3, 3)) for _ in range(count)
    ]
    triangles = [triangle.clip([-2, -2, 0.05], [2, 2, 1.95]) for triangle in triangles]
    points = np.column_stack([rng.uniform(-1.5, 1.5, (150, 2)), np.zeros(150)])
    return Shader(geometry_of(triangles), 1), points


def z_scores(method, light, samples, trials=12):
    """(error / standard error) of points in penumbra, one seed a trial."""
    scores = []
    for trial in range(trials):
        shader, points = scene(trial)
        exact = shader.estimate(points, UP, light, "exact")
        found = shader.estimate(points, UP, light, method, samples=samples, seed=100 + trial)
        share = exact.visible_share[:, 0] / np.where(exact.open_share[:, 0] > 0, exact.open_share[:, 0], 1)
        penumbra = (share > 1e-9) & (share < 1 - 1e-9)
        gap = found.irradiance - exact.irradiance
        scores.append((gap / np.maximum(found.standard_error, 1e-15))[penumbra, 0])
    return np.concatenate(scores)


@pytest.mark.parametrize("samples", [4, 16, 64, 256])
@pytest.mark.parametrize("method", ["rays", "rays+plane-vertex"])
@pytest.mark.parametrize("light", [SQUARE, L_LIGHT], ids=["square", "concave"])
def test_rays_are_not_over_confident(method, light, samples):
    z = z_scores(method, light, samples, 8 if method == "rays" else 4)
    assert len(z) > 200
    assert (np.abs(z) > 3).mean() < 0.02
    # Nor timid: from 16 rays on the errors are of the size that is stated.
    assert np.sqrt((z**2).mean()) < 1.2
    if samples >= 16 and light is SQUARE:
        assert np.sqrt((z**2).mean()) > 0.5


@pytest.mark.parametrize("samples", [16, 64])
@pytest.mark.parametrize("method", ["camera", "camera-optimised", "adaptive"])
def test_cameras_and_adaptive_samples_are_not_over_confident(method, samples):
    z = z_scores(method, SQUARE, samples, 8)
    assert (np.abs(z) > 3).mean() < 0.02
    assert np.sqrt((z**2).mean()) < 1.2


def test_cameras_state_about_the_error_that_they_make():
    for light in (SQUARE, L_LIGHT):
        z = z_scores("camera-optimised", light, 1024, 8)
        assert 0.3 < np.sqrt((z**2).mean()) < 1.2
        assert (np.abs(z) > 3).mean() < 0.02
    # A straight edge along the rows of pixels, as in most rooms: off by the same part of a pixel all along.
    edges = np.linspace(-0.9, 0.9, 40)
    gaps = []
    for edge in edges:
        shade = np.array([[-5, -5, 1], [edge, -5, 1], [edge, 5, 1], [-5, 5, 1.0]])
        shader, point = Shader(geometry_of([shade]), 1), [[0.0, 0.0, 0.0]]
        found = shader.estimate(point, UP, SQUARE, "camera", samples=64)
        exact = shader.estimate(point, UP, SQUARE, "exact")
        gaps.append((found.irradiance - exact.irradiance)[0, 0] / max(found.standard_error[0, 0], 1e-15))
    assert 0.3 < np.sqrt(np.mean(np.square(gaps))) < 1.5


@pytest.mark.parametrize("method", ["rays", "rays+plane-vertex", "adaptive"])
def test_linear_lights_are_not_over_confident(method):
    light = LinearLight("tube", np.ones(1), [-0.6, 0.1, 2.0], [0.6, -0.2, 2.0])
    z = z_scores(method, light, 32, 8)
    assert (np.abs(z) > 3).mean() < 0.02


def test_spheres_are_not_over_confident():
    light = SphereLight("ball", np.ones(1), [0.0, 0.0, 2.6], 0.5)
    z = z_scores("rays", light, 64, 8)
    assert (np.abs(z) > 3).mean() < 0.02


def test_many_seeds_at_one_point_spread_as_stated():
    # 200 points at one place have 200 streams of rays: their scatter is the error of each.
    shader, places = scene(1)
    exact = shader.estimate(places, UP, SQUARE, "exact")
    middle = int(np.argmin(np.abs(exact.visible_share / exact.open_share - 0.5)))
    points = np.repeat(places[middle : middle + 1], 200, axis=0)
    exact = shader.estimate(points[:1], UP, SQUARE, "exact")
    assert 0.1 < exact.visible_share[0, 0] / exact.open_share[0, 0] < 0.9
    found = shader.estimate(points, UP, SQUARE, "rays", samples=64)
    error = found.irradiance[:, 0] - exact.irradiance[0, 0]
    # Unbiased: the mean of 200 within 4 of its own standard errors.
    assert abs(error.mean()) < 4 * error.std(ddof=1) / np.sqrt(200)
    # Not over-confident by a chi-square test: the scatter may not exceed the mean stated variance.
    statistic = (error**2).sum() / (found.standard_error[:, 0] ** 2).mean()
    assert stats.chi2.sf(statistic, 200) > 1e-4
    assert len(np.unique(found.irradiance)) > 100


def test_error_falls_with_samples_faster_than_independent_ones():
    shader, points = scene(1)
    exact = shader.estimate(points, UP, SQUARE, "exact").irradiance
    counts = np.array([16, 64, 256, 1024])
    errors = [
        np.sqrt(np.mean((shader.estimate(points, UP, SQUARE, "rays", samples=int(k)).irradiance - exact) ** 2))
        for k in counts
    ]
    slope = np.polyfit(np.log(counts), np.log(errors), 1)[0]
    # Independent samples: -1/2.  A lattice cut by straight edges: about -3/4.
    assert -1.0 < slope < -0.6


def test_auto_states_the_error_that_it_makes():
    # Crowded points (a ball of 320 facets): fits and rays.
    vertices, faces, _, _ = sphere_mesh([0.1, 0.0, 1.0], 0.35, 0.02)
    shader = Shader(geometry_of(list(vertices[faces])), 1)
    x, y = np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-1, 1, 60))
    points = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    exact = shader.estimate(points, UP, SQUARE, "exact").irradiance
    for error in (0.03, 0.01, 0.003):
        found = shader.estimate(points, UP, SQUARE, "auto", error=error)
        made = np.sqrt(np.mean((found.irradiance - exact) ** 2))
        stated = np.sqrt(np.mean(found.standard_error**2))
        assert made <= error * exact.mean()
        assert 0.3 * stated < made < 1.2 * stated


@pytest.mark.parametrize("method", ["rays", "rays+plane-vertex"])
def test_few_rays_above_the_horizon_state_the_error_of_few(method):
    # A wall of light of which a fiftieth is above the floor: one or two rays of 64 count, and a shade over the upper
    # third of that hides more than half of the light.
    wall = np.array([[1, -1, -1], [1, -1, 0.02], [1, 1, 0.02], [1, 1, -1.0]])
    light = AreaLight(wall, np.ones(1))
    shade = np.array([[0.5, -FAR, 0.02 / 3], [0.5, FAR, 0.02 / 3], [0.5, FAR, 0.5], [0.5, -FAR, 0.5]])
    points = np.column_stack([np.zeros(200), np.linspace(-0.5, 0.5, 200), np.zeros(200)])
    geometry = geometry_of([shade])
    exact = estimate(points, [0, 0, 1.0], light, geometry, "exact", workers=1)
    found = estimate(points, [0, 0, 1.0], light, geometry, method, samples=64, workers=1)
    off = np.abs(found.irradiance - exact.irradiance) / found.standard_error
    assert (off > 4).mean() < 0.01
