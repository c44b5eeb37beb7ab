"""The accuracy knob: what is asked, what is estimated, and what the error really is."""

from __future__ import annotations

import math

import numpy as np
import pytest
from accuracy_cases import accuracy_cases
from radiosity_scenes import cube_with_emitter

import radiosity
from radiosity.accuracy import _patches_as_elements, surface_points
from radiosity.patches import build_mesh
from radiosity.solvers.solve import begin, solve_by_matrix
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.scene.library import box_surface, diffuse, unit_cube
from workbench.scene.model import Scene, Sky, Surface
from workbench.shadow.occlusion import Shader

CASES = {case.name: case for case in accuracy_cases()}
SLOW = ("bowl", "sphere", "two-surface")
"""Of many facets: in tests/speed/bench_accuracy.py only."""
NEGLIGIBLE = 0.01
"""Share of the asked error below which estimate and error are both as good as nothing."""


@pytest.mark.parametrize("error", [0.05, 0.01])
@pytest.mark.parametrize("name", [name for name in sorted(CASES) if not any(word in name for word in SLOW)])
def test_error_lies_below_what_was_asked_and_the_estimate_near_it(name, error):
    case = CASES[name]
    solution = radiosity.solve(case.scene, error=error, **case.options)
    estimate, actual = solution.record.errors["estimate"]["total"], case.actual(solution)
    assert solution.record.results["target_reached"] and solution.converged
    assert actual < error
    both_small = max(actual, estimate) < NEGLIGIBLE * error
    # Where nothing casts a shadow the error falls faster than is taken for granted.
    assert both_small or estimate / 7 < actual < 3.5 * estimate


def test_a_smaller_error_needs_a_finer_mesh_and_gets_it():
    """Mean radiosity of the sides by the continuous equation: truth `rad/cube-continuous/black-emitter/rho=0.5`."""
    counts, stated, off = [], [], []
    for error in (0.1, 0.01, 0.0005):
        solution = radiosity.solve(cube_with_emitter(0.0, 0.5), error=error)
        sides = np.abs(solution.mesh.element_normal[:, 2]) < 0.5
        area = solution.mesh.element_area[sides]
        counts.append(solution.mesh.element_count)
        stated.append(solution.record.errors["estimate"]["total"])
        off.append(abs(area @ solution.radiosity[sides, 0] / area.sum() / 0.16399246 - 1.0))
        assert stated[-1] <= error and off[-1] < error
    assert counts == sorted(counts) and counts[0] < counts[-1]
    assert stated[-1] < stated[0] and off[-1] < off[0]


def test_parts_add_up_and_levels_tell_the_story():
    record = radiosity.solve(cube_with_emitter(0.5, 0.5), error=0.0005).record
    estimate = record.errors["estimate"]
    parts = ("meshing", "form_factors", "visibility", "convergence")
    assert estimate["total"] == pytest.approx(sum(estimate[name] for name in parts), rel=1e-12)
    levels = record.results["levels"]
    assert len(levels) > 1 and all(level["coarse_like"] < level["like"] for level in levels)
    assert [level["elements"] for level in levels] == sorted({level["elements"] for level in levels})
    assert levels[-1]["total"] == estimate["total"] <= 0.0005
    assert record.settings["error"] == 0.0005 and "below the target" in record.choices["stop"]


def test_the_patches_of_a_mesh_are_solved_as_a_mesh_of_their_own_would_be():
    scene = cube_with_emitter(0.5, 0.9)
    shader = Shader(Geometry.from_scene(scene))

    def solved(edge):
        record = begin(scene, method="matrix", max_edge=edge, form_factor_error=1e-4)
        mesh = build_mesh(scene, shader.geometry, max_edge=edge, split=2, cluster=False)
        patches = _patches_as_elements(mesh)
        return *solve_by_matrix(scene, shader, mesh, record, coarse_mesh=patches), patches

    fine, coarse, patches = solved(0.25)
    alone, _, _ = solved(0.5)
    for name in ("element_area", "element_centroid", "element_normal", "element_size", "element_polygon"):
        np.testing.assert_allclose(getattr(patches, name), getattr(alone.mesh, name), atol=1e-12)
    assert fine.mesh.element_count == 96 and coarse.mesh.element_count == 24
    np.testing.assert_allclose(coarse.element_irradiance, alone.element_irradiance, rtol=3e-4)
    assert abs(coarse.record.errors["energy_imbalance"]) < 1e-12


def test_budget_ends_the_refinement_and_says_what_was_reached():
    solution = radiosity.solve(cube_with_emitter(0.5, 0.5), budget_seconds=0.5)
    assert solution.converged and "time" in solution.record.choices["stop"]
    total = solution.record.errors["estimate"]["total"]
    assert math.isinf(total) or 0 < total < 1
    both = radiosity.solve(cube_with_emitter(0.5, 0.5), error=1e-6, budget_seconds=0.5)
    assert not both.converged and not both.record.results["target_reached"]


def test_a_given_mesh_is_kept():
    solution = radiosity.solve(cube_with_emitter(0.5, 0.5), error=1e-3, max_edge=0.25)
    assert solution.mesh.element_count == 96
    assert solution.record.errors["estimate"]["meshing"] == 0.0
    assert solution.record.errors["estimate"]["total"] <= 1e-3
    fine = radiosity.solve(cube_with_emitter(0.5, 0.5), max_edge=0.25, method="direct", form_factor_error=1e-8)
    off = (solution.element_irradiance - fine.element_irradiance) / fine.element_irradiance.mean()
    assert np.sqrt((off**2).mean()) < 1e-3


@pytest.mark.parametrize(("method", "error"), [("progressive", 0.01), ("hierarchical", 0.003)])
def test_an_interrupted_refinement_leaves_the_last_whole_mesh_and_goes_on_to_the_same(tmp_path, method, error):
    scene = cube_with_emitter(0.5, 0.5)
    options = {"error": error, "workers": 1, "method": method}
    whole = radiosity.solve(scene, **options)

    class KilledError(Exception):
        pass

    def die_in_the_second_mesh(unfinished):
        unfinished.save_state(tmp_path)
        if len(unfinished.record.results["levels"]) == 1:
            raise KilledError

    with pytest.raises(KilledError):
        radiosity.solve(scene, **options, checkpoint=die_in_the_second_mesh)
    resumed = radiosity.solve(scene, **options, resume=radiosity.Solution.load(tmp_path))
    assert (resumed.radiosity == whole.radiosity).all()
    assert resumed.record.errors["estimate"] == whole.record.errors["estimate"]

    def stop_in_the_second_mesh(event):
        if event.message.startswith("mesh 2"):
            raise KeyboardInterrupt

    part = radiosity.solve(scene, **options, progress=stop_in_the_second_mesh)
    assert part.stopped == "interrupted" and not part.converged
    assert part.mesh.element_count == whole.record.results["levels"][0]["elements"]
    assert (part.element_irradiance > 0).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"error": 0.0}, "error: found 0.0"),
        ({"error": 2.0}, "error: found 2.0"),
        ({"budget_seconds": -1.0}, "budget_seconds: found -1.0"),
        ({"budget_seconds": math.nan}, "budget_seconds: found nan"),
        ({"error": 0.1, "tolerance": 0.1}, "tolerance and error were both given"),
    ],
)
def test_bad_options(options, words):
    with pytest.raises(OptionError, match=words):
        radiosity.solve(unit_cube(0.5, 1.0), **options)


def test_surface_points_lie_on_the_surfaces_equally_many_an_area():
    mesh = radiosity.solve(cube_with_emitter(0.5, 0.5), elements=54).mesh
    points, normals, polygon = surface_points(mesh, 600, seed=3)
    on = np.isclose(np.abs(points - 0.5).max(axis=1), 0.5)
    assert on.all() and (np.einsum("ij,ij->i", points - 0.5, normals) < 0).all()
    # A sixth on each face, to the one point that stratification leaves open at either end.
    assert (np.abs(np.bincount(polygon) - 100) <= 2).all()


@pytest.mark.parametrize("error", [0.05, 0.01])
def test_a_box_that_stands_on_a_glowing_floor_takes_no_light_from_it(error):
    # Every surface sends 1 - rho + rho: everywhere 1 arrives, but under the box; what the floor emits there is lost.
    room = box_surface("room", diffuse("wall", 0.7, 0.3), [0, 0, 0], [1, 1, 1], inward=True)
    box = box_surface("box", diffuse("box", 0.5, 0.5), [0.3, 0.3, 0.0], [0.7, 0.7, 0.4])
    solution = radiosity.solve(Scene("furnace", (room, box), bands=1, closed=True), error=error)
    points, normals, polygon = surface_points(solution.mesh, 200, seed=5)
    under = (points[:, 2] == 0.0) & (np.abs(points[:, :2] - 0.5) < 0.2).all(axis=1)
    assert 0 < under.sum() < 15
    found = solution.irradiance(points[~under], normals[~under], own_polygon=polygon[~under], error=0.2 * error)
    assert np.sqrt(((found.irradiance - 1.0) ** 2).mean()) < 0.5 * error


@pytest.mark.parametrize("method", ["matrix", "hierarchical"])
@pytest.mark.parametrize(("side", "depth"), [(1.0, 1.0), (4.0, 1.0), (1.0, 5.0)])
def test_a_black_pit_under_the_sky_gets_what_its_opening_sends(side, depth, method):
    """One element a face is enough for points, and the means of these elements are right, too.

    Of a uniform sky the floor gets F from floor to opening (Howell C-11), the four walls share the rest.
    """
    pit = box_surface("pit", diffuse("black", 0.0), [0, 0, 0], [side, side, depth], inward=True, omit=["+z"])
    sky = Sky("uniform", np.zeros(1), horizontal_irradiance=np.ones(1))
    solution = radiosity.solve(Scene("pit", (pit,), bands=1, sky=sky), error=0.01, method=method)
    mesh = solution.mesh
    floor = mesh.element_normal[:, 2] > 0.5
    arrives = mesh.element_area * solution.element_irradiance[:, 0]
    opening = [[0, 0, depth], [0, side, depth], [side, side, depth], [side, 0, depth]]
    down = radiosity.form_factor([[0, 0, 0], [side, 0, 0], [side, side, 0], [0, side, 0]], opening)
    mean = side**2 / (side**2 + 4 * side * depth)
    assert mesh.element_count < 20
    assert arrives[floor].sum() / side**2 == pytest.approx(down, abs=0.01 * mean)
    assert arrives.sum() / mesh.element_area.sum() == pytest.approx(mean, rel=0.01)


def test_the_error_can_be_asked_for_where_it_matters():
    """A dim furnace in a bright yard: the wanted error is that of the dim points, relative to their own mean.

    Inside a closed box of emission e and reflectance rho the irradiance is e / (1 - rho) (conservation of energy),
    whatever the yard, a thousand times as large and bright, does.
    """
    inside = box_surface("furnace", diffuse("dim", 0.5, 1e-3, bands=1), [-1, -1, 0.1], [1, 1, 2.1], inward=True)
    yard = [[-40, -40, 0], [40, -40, 0], [40, 40, 0], [-40, 40, 0]]
    roof = [[-40, -40, 9], [-40, 40, 9], [40, 40, 9], [40, -40, 9]]
    scene = Scene(
        "yard",
        (
            inside,
            Surface.from_polygons("yard", diffuse("grey", 0.3, bands=1), [np.array(yard, dtype=float)]),
            Surface.from_polygons("roof", diffuse("bright", 0.3, 1.0, bands=1), [np.array(roof, dtype=float)]),
        ),
        bands=1,
    )
    points = np.array([[0, 0, 0.1 + 1e-6], [0.5, -0.3, 0.1 + 1e-6]])
    normals = np.tile([0, 0, 1.0], (2, 1))
    solution = radiosity.solve(scene, error=0.02, at=(points, normals))
    found = solution.irradiance(points, normals, error=0.005).irradiance
    assert np.abs(found / 2e-3 - 1).max() < 0.02
    # Without an error nothing is left unshot, wherever it would go.
    plain = radiosity.solve(scene, elements=400)
    dim = plain.mesh.element_surface == 0
    assert np.abs(plain.element_irradiance[dim] / 2e-3 - 1).max() < 0.02
    assert plain.record.choices["method"].startswith("matrix")
    assert "given points" in solution.record.errors["definition"]
    with pytest.raises(InputError, match="found 2 rows for"):
        radiosity.solve(scene, error=0.02, at=(points[:1], normals))
    with pytest.raises(OptionError, match="given mesh"):
        radiosity.solve(scene, error=0.02, at=(points, normals), elements=50)
