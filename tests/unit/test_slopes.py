"""What slopes of radiosity send: in corners light is nearer to the truth than with one radiosity an element."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from radiosity_scenes import cube_with_emitter, each_truth, truths

import radiosity
import workbench
from radiosity.patches import build_mesh
from radiosity.solvers import direct
from radiosity.solvers._slopes import Slopes
from workbench.geometry.flat import Geometry


def _slopes(name: str, elements: int):
    scene = workbench.load(name)
    geometry = Geometry.from_scene(scene)
    mesh = build_mesh(scene, geometry, elements=elements, cluster=False)
    return mesh, Slopes(mesh, geometry, np.ones(mesh.element_count, dtype=bool), mesh.element_area)


@settings(max_examples=10, deadline=None)
@given(st.sampled_from(["cornell-box", "l-room"]), st.integers(150, 500), st.integers(0, 100))
def test_a_linear_field_has_its_slope(name, elements, seed):
    mesh, slopes = _slopes(name, elements)
    wanted = np.random.default_rng(seed).standard_normal(3)
    found = slopes.gradient((mesh.element_centroid @ wanted)[:, None])[:, 0]
    # Where neighbours lie on two sides at least: what is across the plane is no slope on it.
    flat = wanted - (mesh.element_normal @ wanted)[:, None] * mesh.element_normal
    whole = np.bincount(mesh.element_polygon)[mesh.element_polygon] >= 4
    off = np.abs(found - flat).max(axis=1)
    assert whole.any()
    assert np.mean(off[whole] < 1e-9) > 0.7
    assert (np.linalg.norm(found, axis=1) <= 1.5 * np.linalg.norm(wanted)).all()


@pytest.mark.parametrize("name", ["cornell-box", "l-room", "office"])
def test_slopes_send_no_light_of_their_own(name):
    mesh, slopes = _slopes(name, 300)
    light = np.random.default_rng(3).random((mesh.element_count, 2))
    sent = slopes.sent(light)
    assert 0.01 < np.abs(sent).max() < 1.0
    assert mesh.element_area @ sent == pytest.approx(np.zeros(2), abs=1e-12 * (mesh.element_area @ np.abs(sent)).max())
    assert slopes.sent(np.ones((mesh.element_count, 1))) == pytest.approx(np.zeros((mesh.element_count, 1)), abs=1e-12)


@each_truth("rad/cube-continuous", "rho_emitter")
def test_with_slopes_a_cube_is_nearer_to_its_truth(name, monkeypatch):
    case = truths()[name]
    grey = case["geometry"]["rho_emitter"]
    rho = case["geometry"]["rho_others"]
    _, opposite, side = case["value"][:3]

    def off() -> float:
        solution = radiosity.solve(cube_with_emitter(grey, rho), method="matrix", error=0.05)
        mesh, height = solution.mesh, solution.mesh.element_centroid[:, 2]
        parts = [height == 1, (height > 0) & (height < 1)]
        found = [mesh.element_area[p] @ solution.element_irradiance[p, 0] / mesh.element_area[p].sum() for p in parts]
        return float(np.abs(np.array(found) / [opposite / rho, side / rho] - 1.0).max())

    with_slopes = off()
    monkeypatch.setattr(direct, "Slopes", _Nothing)
    assert with_slopes < 0.6 * off()


class _Nothing:
    """Slopes that send nothing."""

    def __init__(self, *_) -> None:
        pass

    def sent(self, radiosity):
        return np.zeros_like(radiosity)
