"""Scenes with a known irradiance, on which the accuracy knob is judged: asked, estimated, actual."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from radiosity_scenes import cube_with_emitter, huge_plates, l_room, spherical_cap, truths

import radiosity
from radiosity.accuracy import surface_points
from radiosity.solvers.solution import Solution
from workbench.geometry.tessellation import sphere_mesh
from workbench.scene.library import diffuse, sphere_surface, unit_cube
from workbench.scene.model import Scene, Surface

POINTS = 200
FACETS = 0.02
"""Distance of facets from the spheres that they stand for, as a share of the radius."""
FACETS_OFF = 0.003
"""Most that facets change the mean irradiance of a sphere's parts, relative to the mean."""


@dataclass(frozen=True)
class AccuracyCase:
    """A scene, the options of its solve, and the actual error of a solution, RMS over mean."""

    name: str
    scene: Scene
    actual: Callable[[Solution], float]
    options: dict[str, Any] = field(default_factory=dict)


def _relative_rms(found, wanted, weight=None) -> float:
    weight = np.ones(len(wanted)) if weight is None else weight
    square = weight @ (np.asarray(found) - wanted) ** 2 / weight.sum()
    return float(np.sqrt(square) / (weight @ wanted / weight.sum()))


def _at_points(solution: Solution, wanted: float) -> float:
    """Against one irradiance everywhere."""
    points, normals, polygon = surface_points(solution.mesh, POINTS, seed=7)
    error = solution.record.errors["estimate"]["total"]
    found = solution.irradiance(points, normals, own_polygon=polygon, error=min(max(error, 1e-4), 0.1)).irradiance
    return _relative_rms(found[:, 0], np.full(POINTS, wanted))


def _furnace(rho: float) -> AccuracyCase:
    # Everything sends 1 / (1 - rho), so that is what arrives: substitution.
    wanted = 1.0 / (1.0 - rho)
    return AccuracyCase(f"rad/furnace/rho={rho:g}", unit_cube(rho, 1.0), lambda s: _at_points(s, wanted))


def _six_faces(name: str, case: dict) -> AccuracyCase:
    """One element a face: the truth is the solution of the 6 x 6 system."""
    rho_emitter, rho = case["geometry"]["rho_emitter"], case["geometry"]["rho_others"]
    emitter, opposite, side = case["value"][:3]

    def actual(solution: Solution) -> float:
        height = np.round(2 * solution.mesh.element_centroid[:, 2]).astype(int)
        wanted = np.choose(height, [0.0, side / rho, opposite / rho])
        known = np.ones(6, dtype=bool)
        if rho_emitter > 0:
            wanted[height == 0] = (emitter - 1.0) / rho_emitter
        else:
            known = height > 0  # what a black face sends says nothing of what it receives
        return _relative_rms(solution.element_irradiance[known, 0], wanted[known])

    return AccuracyCase(name, cube_with_emitter(rho_emitter, rho), actual, {"elements": 1})


def _continuous(name: str, case: dict) -> AccuracyCase:
    """The mean of each face, and the centre of the one opposite the emitter."""
    rho_emitter, rho = case["geometry"]["rho_emitter"], case["geometry"]["rho_others"]
    emitter, opposite, side, centre = case["value"]

    def actual(solution: Solution) -> float:
        mesh = solution.mesh
        height = mesh.element_centroid[:, 2]
        parts = [height == 1, (height > 0) & (height < 1)]
        wanted = [opposite / rho, side / rho]
        if rho_emitter > 0:
            parts.append(height == 0)
            wanted.append((emitter - 1.0) / rho_emitter)
        area = np.array([mesh.element_area[part].sum() for part in parts])
        found = [mesh.element_area[p] @ solution.element_irradiance[p, 0] / a for p, a in zip(parts, area, strict=True)]
        means = _relative_rms(np.array(found), np.array(wanted), area)
        here = solution.irradiance([[0.5, 0.5, 1.0]], [[0, 0, -1.0]], rays=65536).irradiance[0, 0]
        return max(means, abs(here - centre / rho) * rho / side)

    return AccuracyCase(name, cube_with_emitter(rho_emitter, rho), actual)


def _elements(
    name: str, scene: Scene, wanted: list[float], reflectance: list[float], emission: list[float]
) -> AccuracyCase:
    """One element a polygon, whose radiosity is known: the error of their irradiance."""
    arrives = (np.array(wanted) - emission) / np.array(reflectance)

    def actual(solution: Solution) -> float:
        order = np.argsort(solution.mesh.element_polygon)
        return _relative_rms(solution.element_irradiance[order, 0], arrives, solution.mesh.element_area[order])

    return AccuracyCase(name, scene, actual, {"elements": 1})


def _bowl(name: str, case: dict) -> AccuracyCase:
    """A spherical cap of 40 x 80 facets: the rest of it gives the same irradiance everywhere.

    Facets are turned from the sphere by up to half their angle, which moves the irradiance at points by
    0.9 % root mean square, up here and down there: an error of the tessellation.  The mean is judged, and as it lies
    up to 0.13 % off the sphere's, by all form factors between the facets themselves.
    """
    fraction, rho = case["geometry"]["f"], case["geometry"]["rho"]
    scene = Scene("bowl", (spherical_cap(fraction, 40, 80, diffuse("bowl", rho, 1.0)),), bands=1)

    @cache
    def facets() -> float:
        fine = radiosity.solve(scene, method="matrix", elements=1, form_factor_error=1e-3)
        mean = float(fine.mean_irradiance[0])
        assert abs(mean / case["value"] - 1.0) < FACETS_OFF
        return mean

    return AccuracyCase(name, scene, lambda s: abs(float(s.mean_irradiance[0]) / facets() - 1.0))


def _means(solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Mean irradiance and area of each surface."""
    mesh = solution.mesh
    area = np.bincount(mesh.element_surface, mesh.element_area)
    return np.bincount(mesh.element_surface, mesh.element_area * solution.element_irradiance[:, 0]) / area, area


def _sphere(name: str, case: dict) -> AccuracyCase:
    """The inside of a sphere of facets, whose upper part emits: F_ij = A_j / A, up to the facets' angle.

    The facets' own answer, by a finer solve with better form factors, is the truth, once it lies near the sphere's.
    """
    (share, _), (rho_1, rho_2) = case["geometry"]["area_fractions"], case["geometry"]["rho"]
    emits = case["geometry"]["e"]
    vertices, faces, _, _ = sphere_mesh([0, 0, 0], 1.0, FACETS)
    faces = faces[:, ::-1]
    corners = vertices[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    order = np.argsort(-corners.mean(axis=1)[:, 2])
    count = int(np.searchsorted(np.cumsum(area[order]) / area.sum(), share)) + 1
    parts = zip(("upper", "lower"), (rho_1, rho_2), emits, (order[:count], order[count:]), strict=True)
    surfaces = tuple(Surface.from_mesh(n, diffuse(n, rho, e), vertices, faces[rows]) for n, rho, e, rows in parts)

    scene = Scene("sphere", surfaces, bands=1, closed=True)

    def actual(solution: Solution) -> float:
        fine, area = _means(radiosity.solve(scene, method="matrix", elements=4 * len(faces), form_factor_error=1e-4))
        share = area / area.sum()
        assert _relative_rms(fine, np.full(2, share @ emits / (1.0 - share @ [rho_1, rho_2])), area) < FACETS_OFF
        return _relative_rms(_means(solution)[0], fine, area)

    return AccuracyCase(name, scene, actual)


def _two_spheres(name: str, case: dict) -> AccuracyCase:
    """Concentric spheres of facets: each sees the inner one as large as its area says, up to the facets' angle."""
    radii, rho, emits = (np.array(case["geometry"][key]) for key in ("r", "rho", "e"))
    inner = sphere_surface("inner", diffuse("inner", rho[0], emits[0]), [0, 0, 0], radii[0], facet_error=FACETS)
    outer = sphere_surface(
        "outer", diffuse("outer", rho[1], emits[1]), [0, 0, 0], radii[1], facet_error=FACETS, inward=True
    )

    def actual(solution: Solution) -> float:
        found, area = _means(solution)
        factor = np.array([[0.0, 1.0], [area[0] / area[1], 1.0 - area[0] / area[1]]])
        return _relative_rms(found, factor @ np.linalg.solve(np.eye(2) - rho[:, None] * factor, emits), area)

    return AccuracyCase(name, Scene("spheres", (inner, outer), bands=1, closed=True), actual)


def accuracy_cases() -> list[AccuracyCase]:
    """All cases; those of the shared truths only where these are present."""
    cases = [_furnace(rho) for rho in (0.0, 0.8, 0.9, 0.99, 0.999)]
    for name, case in truths().items():
        if name.startswith("rad/cube-uniform/"):
            cases.append(_six_faces(name, case))
        elif name.startswith("rad/cube-continuous/"):
            cases.append(_continuous(name, case))
        elif name.startswith("rad/L-room/"):
            emitter = int(name.rpartition("-")[2]) - 1
            glow = [float(i == emitter) for i in range(8)]
            cases.append(_elements(name, l_room(emitter), case["value"], [0.5] * 8, glow))
        elif name.startswith("rad/infinite-plates/"):
            rho, emission = case["geometry"]["rho"], case["geometry"]["e"]
            cases.append(_elements(name, huge_plates(rho, emission), case["value"], rho, emission))
        elif name.startswith("rad/sphere/"):
            cases.append(_sphere(name, case))
        elif name.startswith("rad/two-surface/"):
            cases.append(_two_spheres(name, case))
        elif name.startswith("rad/bowl/"):
            cases.append(_bowl(name, case))
    return cases
