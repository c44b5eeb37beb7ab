"""How fine a mesh has to be: numbers that are told before it is made, and what a run of meshes costs in all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import radiosity
import workbench
from radiosity.mesh_choice import Divisions, like_elements
from radiosity.patches import build_mesh
from workbench.geometry.flat import Geometry


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 500), st.floats(1e-6, 1e6), st.floats(1e-6, 1e6))
def test_equal_elements_are_as_good_as_their_number(count, area, light):
    assert like_elements(np.full(count, area), np.full(count, light)) == pytest.approx(count, rel=1e-9)


def test_what_is_small_or_dark_hardly_counts():
    large, light = np.full(10, 1.0), np.full(10, 2.0)
    alone = like_elements(large, light)
    assert like_elements(np.append(large, np.full(90, 1e-4)), np.append(light, np.full(90, 2.0))) == pytest.approx(
        alone, rel=0.01
    )
    assert like_elements(np.append(large, 5.0), np.append(light, 0.0)) == pytest.approx(alone * 1.5, rel=1e-9)
    assert like_elements(large, np.zeros(10)) == 0.0


@pytest.mark.parametrize("name", ["cornell-box", "office", "l-room", "daylight-office"])
@pytest.mark.parametrize("wanted", [1, 60, 400])
def test_the_mesh_is_as_fine_as_it_was_told_and_no_finer(name, wanted):
    scene = workbench.load(name)
    geometry = Geometry.from_scene(scene)
    told = Divisions(scene, geometry).least(wanted, 2.5)
    mesh = build_mesh(scene, geometry, elements=told, split=2, cluster=False)
    light = mesh.reflectance.mean(axis=1)
    fine = like_elements(mesh.element_area, light)
    coarse = like_elements(mesh.patch_area, mesh.patch_mean(mesh.reflectance).mean(axis=1))
    assert fine >= 2.0 * coarse
    # Lines along which things stand on a floor cut some elements more.
    assert mesh.element_count <= max(1.4 * wanted, 1.2 * geometry.polygon_count + 30)


@pytest.mark.parametrize("error", [0.1, 0.05, 0.02])
@pytest.mark.parametrize("name", ["cornell-box", "office", "l-room", "daylight-office", "hinged-blocker"])
def test_meshes_on_the_way_are_few_and_cost_less_than_the_last(name, error):
    """Counted, not timed: the seconds of a full matrix grow with the power 1.7 of its elements."""
    record = radiosity.solve(workbench.load(name), error=error).record
    work = [level["elements"] ** 1.7 for level in record.results["levels"]]
    assert record.results["target_reached"]
    assert len(work) <= 2 and sum(work[:-1]) < 0.7 * work[-1]
