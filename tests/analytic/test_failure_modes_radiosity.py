"""Failure modes 7 (form factors), 8 (progressive refinement) and 9.5 (energy), a test each, under their numbers.

Expected values are closed forms and double contour integrals, as told at each.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from radiosity_scenes import UNIT, cube_with_emitter, l_room, spherical_cap

import radiosity
from radiosity.solvers import progressive
from workbench.geometry.tessellation import sphere_mesh
from workbench.scene.library import box_surface, diffuse, sphere_surface, unit_cube
from workbench.scene.model import Scene, Surface

FLOOR = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
WALL = np.array([[0, 0, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1.0]])
LOW = FLOOR - [0.5, 0.5, 0.0]
HIGH = LOW[::-1] + [0, 0, 1.0]
FACING = 0.19982489569838746
"""Howell C-11: unit squares at distance 1."""
SHARED_EDGE = 0.20004377607540316
"""Howell C-14: perpendicular unit squares."""


def hinged(degrees):
    a = math.radians(degrees)
    return np.array([[0, 1, 0], [math.cos(a), 1, math.sin(a)], [math.cos(a), 0, math.sin(a)], [0, 0, 0]])


def middle(half):
    return np.array([[-half, -half, 0.5], [half, -half, 0.5], [half, half, 0.5], [-half, half, 0.5]])


def test_failure_mode_7_1_touching_patches():
    assert radiosity.form_factor(FLOOR, WALL) == pytest.approx(SHARED_EDGE, abs=1e-6)


def test_failure_mode_7_2_one_degree_wedge():
    for degrees, wanted in ((1.0, 0.9829971785746487), (0.1, 0.9982613916541436)):
        found = radiosity.form_factor(FLOOR, hinged(degrees))
        assert found <= 1.0 and found == pytest.approx(wanted, abs=1e-6)


def test_failure_mode_7_3_a_gap_changes_a_factor_continuously():
    off = 1e-6
    floor, wall = FLOOR * [1 - off, 1, 1] + [off, 0, 0], WALL * [1, 1, 1 - off] + [0, 0, off]
    found = radiosity.form_factor(floor, wall, error=1e-9)
    assert SHARED_EDGE - found == pytest.approx(5.07e-7, abs=2e-9)


def test_failure_mode_7_4_long_range():
    far = FLOOR[::-1] + [0, 0, 1e4]
    assert radiosity.form_factor(FLOOR, far, error=1e-12) == pytest.approx(3.1830988406173287e-09, rel=1e-3)


def test_failure_mode_7_5_a_polygon_across_the_horizon():
    across = np.array([[1.5, 0, -0.5], [1.5, 0, 0.5], [1.5, 1, 0.5], [1.5, 1, -0.5]])
    assert radiosity.form_factor(FLOOR, across) == pytest.approx(0.033752143402516935, abs=1e-6)


def test_failure_mode_7_6_coplanar_and_turned_away():
    assert radiosity.form_factor(FLOOR, FLOOR + [1, 0, 0]) == 0.0
    assert radiosity.form_factor(FLOOR, FLOOR + [0, 0, 1]) == 0.0


def test_failure_mode_7_7_half_hidden():
    # The middle of a segment lies left of the wall's edge as often as right of it.
    wall = np.array([[-9, -9, 0.5], [0, -9, 0.5], [0, 9, 0.5], [-9, 9, 0.5]])
    assert radiosity.form_factor(LOW, HIGH, [wall]) == pytest.approx(FACING / 2, abs=1e-6)
    polygons = zip("abc", (LOW, HIGH, wall), strict=True)
    scene = Scene("wall", tuple(Surface.from_polygons(n, diffuse(n, 0.5), [p]) for n, p in polygons), bands=1)
    assert radiosity.view_factors(scene, error=1e-3).dense()[0, 1] == pytest.approx(FACING / 2, abs=1e-3)


def test_failure_mode_7_8_a_thin_visible_rim():
    found = radiosity.form_factor(LOW, HIGH, [middle(0.45)])
    assert found == pytest.approx(0.00495331002, abs=1e-6)


def test_failure_mode_7_9_a_concave_enclosure_hides_part_of_itself():
    found = radiosity.view_factors(l_room(), by="surface", error=1e-3)
    factor = found.dense()
    assert np.abs(factor.sum(axis=1) - 1.0).max() < 1e-6
    assert factor[found.names.index("2"), found.names.index("5")] == 0.0
    sums = found.record.errors["row_sum_as_found"]
    assert 1 - 2e-3 < sums["min"] <= sums["max"] < 1 + 2e-3


def test_failure_mode_7_10_a_sphere_in_a_box():
    # All that leaves a convex body arrives at the box: F from the box is the ratio of areas, pi / 6 of a sphere.
    room = box_surface("room", diffuse("wall", 0.5), *UNIT, inward=True)
    ball = sphere_surface("ball", diffuse("ball", 0.5), [0.5, 0.5, 0.5], 0.5 - 1e-6, facet_error=0.01)
    found = radiosity.view_factors(Scene("ball", (room, ball), bands=1, closed=True), by="surface", error=0.01)
    ratio = found.areas[1] / found.areas[0]
    assert ratio == pytest.approx(math.pi / 6, rel=0.03)  # facets
    np.testing.assert_allclose(found.dense(), [[1 - ratio, ratio], [1, 0]], atol=0.01)


@pytest.mark.parametrize("method", ["progressive", "direct", "matrix", "hierarchical"])
def test_failure_mode_8_1_reflectance_near_1(method):
    # B = e / (1 - rho).
    solution = radiosity.solve(unit_cube(0.999, 1.0), elements=24, method=method, tolerance=1e-4)
    np.testing.assert_allclose(solution.radiosity, 1000.0, rtol=2e-3)


def test_failure_mode_8_2_far_fewer_shots_than_gathering_sweeps():
    # Gathering takes ln 1e-6 / ln 0.999 = 13,808 sweeps, of every element each.
    solution = radiosity.solve(unit_cube(0.999, 1.0), elements=24, method="progressive", tolerance=1e-6)
    assert solution.record.counters["shots"] < 0.01 * 13808


def test_failure_mode_8_3_wrong_row_sums_are_told_and_balanced():
    # Off by 5e-4 they would double the light of a furnace of 0.9995.
    solution = radiosity.solve(unit_cube(0.9995, 1.0), max_edge=0.5, method="matrix", form_factor_error=0.05)
    told = solution.record.errors["row_sum"]
    assert max(abs(told["min"] - 1), abs(told["max"] - 1)) > 5e-4
    np.testing.assert_allclose(solution.radiosity, 2000.0, rtol=0.02)


@pytest.mark.parametrize("method", ["progressive", "direct", "matrix", "hierarchical"])
def test_failure_modes_8_4_and_9_5_power_is_neither_made_nor_lost(method):
    # What is absorbed, sum A (1 - rho) E, was emitted: 1 over the floor of area 1.
    for rho_emitter, rho in ((0.0, 0.5), (0.5, 0.9)):
        solution = radiosity.solve(cube_with_emitter(rho_emitter, rho), elements=96, method=method, tolerance=1e-9)
        mesh = solution.mesh
        absorbed = mesh.element_area @ ((1.0 - mesh.reflectance) * solution.element_irradiance)
        assert absorbed[0] == pytest.approx(1.0, abs=1e-6)
        assert solution.book.imbalance(solution.unshot_power) < 1e-12


def test_failure_mode_8_5_the_book_balances_at_every_step(monkeypatch):
    monkeypatch.setattr(progressive, "CHECKPOINT_SECONDS", -1.0)
    monkeypatch.setattr(progressive, "CHECKPOINT_SHARE", math.inf)
    monkeypatch.setattr(progressive, "SOLVE_LIMIT", 0)  # shoot to the end
    seen = []

    def check(solution):
        seen.append(solution.record.counters["shots"])
        assert solution.book.imbalance(solution.unshot_power) < 1e-12

    radiosity.solve(cube_with_emitter(0.5, 0.9), elements=24, method="progressive", tolerance=1e-3, checkpoint=check)
    assert len(seen) > 5 and seen == sorted(seen)


def interrupted(scene):
    """The state before the first shot."""

    def stop(event):
        raise KeyboardInterrupt

    return radiosity.solve(scene, elements=6, method="progressive", tolerance=1e-12, progress=stop)


def test_failure_mode_8_6_no_ambient_light_in_the_solution():
    scene = cube_with_emitter(0.5, 0.5)
    solution = interrupted(scene)
    assert solution.stopped == "interrupted"
    np.testing.assert_array_equal(solution.radiosity, solution.mesh.emission)
    assert (solution.element_irradiance == 0).all()


def test_failure_mode_8_7_shooting_more_than_there_is():
    # A wall shoots 0.3 that it has not got: its unshot light turns negative, and the end stays the same.
    scene = cube_with_emitter(0.5, 0.5)
    whole = radiosity.solve(scene, elements=6, method="progressive", tolerance=1e-12)
    start = interrupted(scene)
    normal = start.mesh.element_normal
    wall = int(np.argmax(normal[:, 0]))
    beside = normal @ normal[wall]
    factor = np.select([beside > 0.5, beside < -0.5], [0.0, 1.0 - 4 * SHARED_EDGE], SHARED_EDGE)
    start.unshot[wall] -= 0.3
    progressive.receive(start, 0.3 * factor[:, None], np.array([0.3]))
    assert start.unshot[wall, 0] < 0
    rest = radiosity.solve(scene, elements=6, method="progressive", tolerance=1e-12, resume=start)
    np.testing.assert_allclose(rest.radiosity, whole.radiosity, rtol=1e-6)


@pytest.mark.parametrize("method", ["progressive", "hierarchical", "matrix"])
def test_failure_mode_8_8_a_curved_surface_sees_itself(method):
    # In a sphere F_ij = A_j / A, F_ii too: E = mean e / (1 - mean rho) everywhere.
    vertices, faces, _, _ = sphere_mesh([0, 0, 0], 1.0, 0.05)
    faces = faces[:, ::-1]
    upper = vertices[faces].mean(axis=1)[:, 2] > 0
    halves = (("upper", 1.0, faces[upper]), ("lower", 0.0, faces[~upper]))
    surfaces = tuple(Surface.from_mesh(name, diffuse(name, 0.5, e), vertices, f) for name, e, f in halves)
    solution = radiosity.solve(Scene("sphere", surfaces, bands=1, closed=True), error=0.05, method=method)
    mesh = solution.mesh
    share = mesh.element_area[mesh.element_surface == 0].sum() / mesh.element_area.sum()
    for half, emits in ((0, 1.0), (1, 0.0)):
        mine = mesh.element_surface == half
        mean = mesh.element_area[mine] @ solution.radiosity[mine, 0] / mesh.element_area[mine].sum()
        assert mean == pytest.approx(emits + 0.5 * share / (1.0 - 0.5), rel=0.02)


@pytest.mark.parametrize("method", ["progressive", "hierarchical", "matrix"])
def test_failure_mode_8_9_open_scenes_are_not_closed(method):
    # A bowl that is half a sphere sees half of itself: B = e / (1 - rho f).
    scene = Scene("bowl", (spherical_cap(0.5, 8, 16, diffuse("bowl", 0.8, 1.0)),), bands=1)
    solution = radiosity.solve(scene, error=0.05, method=method)
    mean = solution.mesh.element_area @ solution.radiosity[:, 0] / solution.mesh.element_area.sum()
    assert mean == pytest.approx(1.0 / (1.0 - 0.8 * 0.5), rel=0.02)
    assert solution.record.errors["row_sum"]["mean"] == pytest.approx(0.5, abs=0.02)


def test_failure_mode_8_10_errors_of_the_mesh_and_of_the_solver_told_apart():
    # The 6 x 6 system's own answer, by formula, and that of the continuous equation (double contour integrals).
    scene = cube_with_emitter(0.0, 0.5)
    factor = np.full((6, 6), SHARED_EDGE)
    for a in range(6):
        factor[a, [a, a ^ 1]] = 0.0, 1.0 - 4 * SHARED_EDGE
    rho = np.array([0.0, 0.5, 0.5, 0.5, 0.5, 0.5])
    uniform = np.linalg.solve(np.eye(6) - rho[:, None] * factor, [1.0, 0, 0, 0, 0, 0])
    coarse = radiosity.solve(scene, elements=1)
    height = np.round(2 * coarse.mesh.element_centroid[:, 2]).astype(int)
    np.testing.assert_allclose(coarse.radiosity[height == 1, 0], uniform[2], rtol=1e-6)
    assert uniform[2] == pytest.approx(0.16668, abs=5e-6)
    fine = radiosity.solve(scene, error=0.002)
    sides = np.abs(fine.mesh.element_normal[:, 2]) < 0.5
    area = fine.mesh.element_area[sides]
    assert area @ fine.radiosity[sides, 0] / area.sum() == pytest.approx(0.16399246, rel=0.004)
