"""Section 9 of the shared list of failure modes: the final gather at points."""

from __future__ import annotations

import numpy as np
import pytest
from radiosity_scenes import cube_with_emitter, truth

import radiosity
from radiosity.sensors import Gatherer
from workbench.scene.library import box_surface, diffuse
from workbench.scene.model import Scene, Surface


def _lit_wall(max_edge, values=None):
    """A wall of radiosity 1 that was reflected, not emitted, on elements of some size."""
    wall = np.array([[0.0, -1, 0], [0, 1, 0], [0, 1, 1], [0, -1, 1]])
    lamp = np.array([[50.0, 0, 0], [50, 0, 1], [50, 1, 0]])
    scene = Scene(
        "wall",
        (
            Surface.from_polygons("wall", diffuse("wall", 0.5), [wall]),
            Surface.from_polygons("lamp", diffuse("lamp", 0.0, 1.0), [lamp]),
        ),
        bands=1,
    )
    solution = radiosity.solve(scene, max_edge=max_edge, workers=1)
    mesh = solution.mesh
    solution.element_irradiance[:] = 0.0  # of nowhere: nothing can be found anew of this light
    solution.radiosity[:] = np.where(mesh.element_surface == 0, 1.0, mesh.emission[:, 0])[:, None]
    if values is not None:
        rows = mesh.element_surface == 0
        solution.radiosity[rows, 0] = values(mesh.element_centroid[rows])
    return solution


def test_9_1_a_point_near_a_corner_sees_half_a_wall():
    case = truth("fail/corner-gather")
    points = np.column_stack([case["geometry"]["d"], np.zeros(4), np.zeros(4)])
    for max_edge in (2.1, 0.25):
        found = Gatherer(_lit_wall(max_edge), workers=1).irradiance(points, [0, 0, 1], error=1e-3)
        assert found.method == "exact"
        assert found.indirect[:, 0] == pytest.approx(case["value"], rel=1e-12)
        assert (np.diff(found.indirect[:, 0]) > 0).all() and found.indirect.max() < 0.5
    # Rays stay finite, and close, however near the wall.
    rays = Gatherer(_lit_wall(0.25), workers=1).irradiance(points, [0, 0, 1], rays=4096)
    assert np.abs(rays.indirect[:, 0] - case["value"]).max() < 4 * rays.standard_error.max()
    assert rays.standard_error.max() < 1e-3


@pytest.mark.parametrize("rays", [None, 1024])
def test_9_2_no_steps_one_element_wide(rays):
    # The wall's radiosity rises with z: along a line at its foot the irradiance must rise as smoothly.
    solution = _lit_wall(0.25, values=lambda c: c[:, 2])
    height = np.linspace(0.02, 0.98, 49)
    points = np.column_stack([np.full(49, 0.02), np.zeros(49), height])
    found = Gatherer(solution, workers=1).irradiance(points, [-1, 0, 0], error=1e-4, rays=rays).indirect[:, 0]
    # At a fiftieth of the wall's height the wall fills the view: E is its radiosity at the point, nearly.
    middle = slice(10, 39)
    assert np.abs(found - height)[middle].max() < 0.01
    # With one value an element the differences would be 0 and, four times, 0.25.
    steps = np.diff(found[middle])
    assert steps.min() > 0.004 and steps.max() < 0.03


def test_9_3_the_centre_of_a_face_is_not_its_mean():
    wanted = 0.17914195
    solution = radiosity.solve(cube_with_emitter(0.0, 0.5), max_edge=1 / 8, tolerance=1e-5, workers=1)
    found = solution.irradiance([[0.5, 0.5, 1.0]], [[0, 0, -1]], error=1e-4, workers=1)
    assert 0.5 * found.irradiance[0, 0] == pytest.approx(wanted, rel=2e-3)
    top = solution.mesh.element_centroid[:, 2] == 1.0
    mean = solution.radiosity[top, 0].mean()
    assert mean < 0.9 * wanted


def test_9_4_direct_light_is_not_counted_twice():
    # rho = 0 under a quad light: E is the light's closed form; with rho = 0.5 on a floor that the
    # points do not see nothing may change.
    case = truth("light/quad-row")
    points = np.column_stack([case["geometry"]["x"], np.zeros(13), np.zeros(13)])
    light = np.array(case["geometry"]["light"], dtype=float)
    for rho in (0.0, 0.5):
        floor = box_surface("floor", diffuse("floor", rho), [-4, -4, -1], [4, 4, 0], omit=["-z"])
        lamp = Surface.from_polygons("lamp", diffuse("lamp", 0.0, np.pi), [light])
        solution = radiosity.solve(Scene("row", (floor, lamp), bands=1), elements=200, workers=1)
        found = solution.irradiance(points, [0, 0, 1], error=1e-3, workers=1)
        assert found.irradiance[:, 0] == pytest.approx(case["value"], rel=1e-9)


def test_closed_forms_and_rays_agree():
    # A box on the floor hides parts of walls: cut exactly by one, sampled by the other.
    room = box_surface("room", diffuse("wall", 0.7), [0, 0, 0], [1, 1, 1], inward=True, omit=["+z"])
    lamp = box_surface("lamp", diffuse("lamp", 0.5, 1.0), [0, 0, 0], [1, 1, 1], inward=True,
                       omit=["-x", "+x", "-y", "+y", "-z"])  # fmt: skip
    box = box_surface("box", diffuse("box", 0.5), [0.3, 0.35, 0.0], [0.6, 0.65, 0.45], omit=["-z"])
    solution = radiosity.solve(Scene("room", (room, lamp, box), bands=1, closed=True), elements=150, workers=1)
    rng = np.random.default_rng(8)
    points, normals = rng.uniform(0.02, 0.98, (24, 3)), rng.normal(size=(24, 3))
    points[:, 2] = 0.5 + 0.45 * rng.random(24)
    gatherer = Gatherer(solution, workers=1)
    exact = gatherer.irradiance(points, normals, error=1e-4)
    rays = gatherer.irradiance(points, normals, rays=4096)
    assert exact.method == "exact" and rays.method == "rays"
    z = (exact.indirect - rays.indirect) / np.hypot(rays.standard_error, exact.standard_error)
    assert np.sqrt((z**2).mean()) < 1.4
