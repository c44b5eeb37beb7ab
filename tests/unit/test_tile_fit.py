"""Shares fitted over tiles: what the fit is, and that nothing small slips between its nodes."""

from __future__ import annotations

import numpy as np
import pytest
from broken_kernels import break_kernel
from instrument_scenes import UNIT_SQUARE_LIGHT, geometry_of
from test_silhouette import ball, torus_triangles

from workbench.shadow import occlusion, silhouette
from workbench.shadow._tile_fit import FEWEST, NODES, TERMS, cubic_at, cut_runs, fit_cubic, pick_nodes, quarter
from workbench.shadow.occlusion import AreaLight, OcclusionState, Shader

UP = np.array([0.0, 0.0, 1.0])
SQUARE = AreaLight(UNIT_SQUARE_LIGHT, np.ones(1))


def scratch():
    return (
        np.empty(NODES, np.int64), np.empty(NODES), np.empty((NODES, TERMS)), np.empty((TERMS, TERMS)), np.empty(TERMS),
        np.empty(NODES), np.empty(TERMS),
    )  # fmt: skip


def cubic(u, v):
    return 0.3 + 0.2 * u - 0.1 * v + 0.4 * u * v - 0.3 * v * v + 0.2 * u**3 - 0.5 * u * u * v + 0.1 * u * v * v


def test_a_cubic_is_met_at_every_point():
    rng = np.random.default_rng(0)
    flat = rng.uniform([3.0, -2.0], [5.0, -1.5], (200, 2))
    rows, frame, nodes = np.arange(200), np.empty((2, 2)), scratch()
    count = pick_nodes(flat, rows, 0, 200, frame, nodes)
    assert count >= FEWEST
    assert len(np.unique(nodes[0][:count])) == count
    values = cubic(*(flat - [4.0, -1.75]).T)
    nodes[5][:count] = values[nodes[0][:count]]
    assert fit_cubic(flat, frame, count, nodes) < 1e-10
    np.testing.assert_allclose([cubic_at(flat, i, frame, nodes) for i in range(200)], values, atol=1e-9)


def test_the_stated_error_is_that_of_leaving_one_out():
    rng = np.random.default_rng(1)
    flat = rng.uniform(-1.0, 1.0, (150, 2))
    frame, nodes = np.empty((2, 2)), scratch()
    count = pick_nodes(flat, np.arange(150), 0, 150, frame, nodes)
    chosen = nodes[0][:count].copy()
    values = np.abs(flat[:, 0] - 0.2) + 0.05 * rng.normal(size=150)
    nodes[5][:count] = values[chosen]
    stated = fit_cubic(flat, frame, count, nodes)
    u, v = ((flat[chosen] - frame[0]) / frame[1]).T
    basis = np.stack([u**i * v**j for i in range(4) for j in range(4 - i)], axis=1)
    square = 0.0
    for k in range(count):
        others = np.arange(count) != k
        gap = values[chosen[k]] - basis[k] @ np.linalg.lstsq(basis[others], values[chosen[others]], rcond=None)[0]
        leverage = basis[k] @ np.linalg.inv(basis.T @ basis) @ basis[k]
        square += gap**2 * (1.0 - leverage)  # each weighs as its own residual does
    assert stated == pytest.approx(np.sqrt(square / count), rel=1e-6)


def test_nothing_is_fitted_to_points_of_a_line_or_of_one_place():
    frame, nodes = np.empty((2, 2)), scratch()
    line = np.column_stack([np.linspace(0, 1, 90), np.zeros(90)])
    assert pick_nodes(line, np.arange(90), 0, 90, frame, nodes) == 0
    slanted = line + line[:, ::-1]
    assert pick_nodes(slanted, np.arange(90), 0, 90, frame, nodes) == 0


@pytest.mark.parametrize("flat", [np.random.default_rng(2).normal(size=(60, 2)), np.zeros((60, 2))])
def test_quarters_hold_every_point_once(flat):
    rows, spare, stack = np.arange(60)[::-1].copy(), np.empty(60, np.int64), np.empty((70, 2), np.int64)
    top = quarter(flat, rows, 10, 60, spare, stack, 2)
    assert sorted(rows[10:]) == list(range(50))
    ranges = sorted(map(tuple, stack[3 : top + 1].tolist()))
    assert len(ranges) > 1
    assert [a for a, _ in ranges] == [10, *(b for _, b in ranges[:-1])]
    assert ranges[-1][1] == 60
    assert cut_runs(0, 0, 5, stack, 3) == 3


@pytest.fixture(scope="module")
def floor():
    """A dense grid under a torus, a ball and crumbs, so close to the floor that their shadows are small and sharp."""
    parts = [torus_triangles(0.5, 0.2, 24, [0.0, 0.0, 0.9], 0.5), ball([-0.5, 0.5, 0.3], 0.05, 0.003)]
    crumbs = np.random.default_rng(4).uniform(-0.9, 0.9, (12, 2))
    parts += [ball([*crumb, 0.012], 0.008, 0.002) for crumb in crumbs]
    geometry = geometry_of(list(np.concatenate(parts)))
    x, y = np.meshgrid(*[(np.arange(112) + 0.5) / 56 - 1] * 2)
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    near = np.flatnonzero(np.linalg.norm(points[:, None, :2] - crumbs, axis=2).min(axis=1) < 0.03)
    spread = np.random.default_rng(3).choice(len(points), 900, replace=False)
    some = np.concatenate([spread, near])
    shader = Shader(geometry, 1)
    return shader, points, some, len(spread), shader.estimate(points[some], UP, SQUARE, "exact")


def held_to_exact(floor, error):
    shader, points, some, spread, exact = floor
    found = shader.estimate(points, UP, SQUARE, "auto", error=error)
    gap = (found.irradiance[some] - exact.irradiance)[:, 0]
    mean = exact.irradiance.mean()
    doubt = found.standard_error[some, 0]
    sure = found.state[some, 0] != OcclusionState.COMPLEX_SHADOW
    assert np.abs(gap[sure]).max(initial=0.0) <= 1e-6 * mean + exact.standard_error.max()
    z = gap[~sure] / doubt[~sure]
    assert (np.abs(z) > 3).mean() < 0.02
    # Nor is what lies between the nodes missed: every point under a crumb has its shadow.
    assert (np.abs(gap[spread:]) <= 6.0 * doubt[spread:] + 1e-6 * mean).all()
    gap, doubt, mean = gap[:spread], doubt[:spread], exact.irradiance[:spread].mean()
    return np.sqrt(np.mean(gap**2)) / mean, np.sqrt(np.mean(doubt**2)) / mean, found


@pytest.mark.parametrize("error", [0.015, 0.003])
def test_fits_meet_the_asked_error_and_state_their_own(floor, error):
    made, stated, found = held_to_exact(floor, error)
    assert found.counters["fitted_points"] > len(found.state) / 4
    assert made <= error
    assert 0.3 * stated < made < 1.3 * stated


def test_fits_to_rays_miss_no_small_shadow_either(floor, monkeypatch):
    monkeypatch.setattr(occlusion, "line_tiles", lambda *arguments: None)
    monkeypatch.setattr(occlusion, "CROWD_LIMIT", 0)
    made, _, found = held_to_exact(floor, 0.03)
    assert made <= 0.03
    assert 0 < found.counters["rays"] < 0.5 * (0.64 / (0.35 * 0.03)) ** (4 / 3) * len(found.state)
    monkeypatch.setattr(occlusion, "BLUR", 1e9)
    with pytest.raises(AssertionError):
        held_to_exact(floor, 0.03)


def test_a_fit_over_sharp_shadows_is_noticed(floor, monkeypatch):
    old = "return max(highest, 0.0) * (step + rise * aside / near) <= BLUR * width * gap"
    break_kernel(monkeypatch, silhouette, "_blurred", old, "return True")
    with pytest.raises(AssertionError):
        held_to_exact(floor, 0.03)
