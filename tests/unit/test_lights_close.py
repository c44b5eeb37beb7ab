"""Lights without surface send the flux that they have, however close to a wall or narrow they are."""

from __future__ import annotations

import math

import numpy as np
import pytest

import radiosity
from workbench.scene.library import box_surface, diffuse
from workbench.scene.model import Light, Scene, Surface

ONE = np.ones(1)
LENGTH = 1.97


def spot(half_angle, exponent=0.0):
    return Light(
        "lamp", "spot", ONE, position=np.array([1.03, 1.57, 2.0]), direction=np.array([0.0, 0.6, -0.8]),
        cone_deg=half_angle, exponent=exponent,
    )  # fmt: skip


def line(drop, lambertian=False):
    ends = np.array([[1.03, 1.57, 2.5 - drop], [1.03 + LENGTH, 1.57, 2.5 - drop]])
    return Light("lamp", "linear", ONE, position=ends[0], end=ends[1], lambertian=lambertian)


def point(drop):
    return Light("lamp", "point", ONE, position=np.array([2.03, 1.57, 2.5 - drop]))


# All of an isotropic light: 4 pi; half of it goes into the ceiling's own plane and is lost where the lamp lies in it.
# A cone of half-angle c with cos^n: 2 pi (1 - cos^(n + 1) c) / (n + 1).  A Lambertian line: pi^2 a length.
CASES = {
    "point, 1 mm": (point(0.001), 4 * math.pi, 1e-4),
    "point, 5 cm": (point(0.05), 4 * math.pi, 1e-4),
    "point, middle": (point(1.2), 4 * math.pi, 1e-4),
    "point on the ceiling": (point(0.0), 2 * math.pi, 5e-3),
    "line, 1 mm": (line(0.001), 4 * math.pi * LENGTH, 2e-3),
    "line, 5 cm": (line(0.05), 4 * math.pi * LENGTH, 2e-3),
    "line on the ceiling": (line(0.0), 2 * math.pi * LENGTH, 5e-3),
    "Lambertian line": (line(0.1, lambertian=True), math.pi**2 * LENGTH, 5e-3),
    "spot of 2 degrees": (spot(2), 2 * math.pi * (1 - math.cos(math.radians(2))), 0.02),
    "spot of 15 degrees": (spot(15), 2 * math.pi * (1 - math.cos(math.radians(15))), 0.01),
    "spot of 60 degrees": (spot(60), 2 * math.pi * (1 - math.cos(math.radians(60))), 0.01),
    "spot, cos^20": (spot(60, 20), 2 * math.pi * (1 - math.cos(math.radians(60)) ** 21) / 21, 0.01),
}


@pytest.mark.parametrize("away", [0.0, 1e4], ids=["here", "far from the origin"])
@pytest.mark.parametrize("case", CASES)
def test_all_the_flux_of_a_lamp_arrives(case, away):
    # Points on the elements alone found from none (a narrow spot) to 5/4 (a line near the ceiling) of it.
    light, flux, tolerance = CASES[case]
    moved = {name: getattr(light, name) + away for name in ("position", "end") if getattr(light, name) is not None}
    room = box_surface("room", diffuse("room", 0.0), np.full(3, away), np.array([4, 3, 2.5]) + away, inward=True)
    lamp = Light(**{**vars(light), **moved})
    scene = Scene("room", (room,), lights=(lamp,), bands=1, closed=True)
    solution = radiosity.solve(scene, elements=60, workers=1)
    arrived = solution.mesh.element_area @ solution.element_irradiance[:, 0]
    assert arrived == pytest.approx(flux, rel=max(tolerance, 1e-4 if away == 0.0 else 2e-3))


def test_a_shade_hides_its_part_of_a_close_lamp():
    # A square 1 cm above a lamp that hangs 5 cm below the ceiling hides what the solid angle of the square says.
    half, gap = 0.01, 0.01
    shade = box_surface("shade", diffuse("shade", 0.0), [2 - half, 1.5 - half, 2.46], [2 + half, 1.5 + half, 2.461])
    room = box_surface("room", diffuse("room", 0.0), [0, 0, 0], [4, 3, 2.5], inward=True)
    lamp = Light("lamp", "point", ONE, position=np.array([2.0, 1.5, 2.45]))
    scene = Scene("room", (room, shade), lights=(lamp,), bands=1)
    solution = radiosity.solve(scene, elements=100, workers=1)
    mesh = solution.mesh
    ceiling = (mesh.element_surface == 0) & (mesh.element_normal[:, 2] < 0)
    hidden = 4 * math.asin(half**2 / (half**2 + gap**2))  # of a square half as wide as it is far: 4 asin(1/2)
    ceiling_alone = 4 * math.pi - 4 * math.pi / 2 - _beside()
    arrived = mesh.element_area[ceiling] @ solution.element_irradiance[ceiling, 0]
    assert arrived == pytest.approx(ceiling_alone - hidden, rel=0.03)


def _beside():
    """What of the upper half of the light passes beside the ceiling: to the walls above the lamp's height."""
    corner = [2.0, 1.5, 0.05]

    def quarter(a, b, h):  # solid angle of an a x b rectangle from above its corner
        return math.atan(a * b / (h * math.sqrt(a * a + b * b + h * h)))

    return 2 * math.pi - 4 * quarter(*corner)


@pytest.mark.parametrize("elements", [6, 500])
def test_the_sun_shines_through_a_small_window(elements):
    # Four points of each element found no light at all on the six elements of this room.
    walls = box_surface("walls", diffuse("walls", 0.0), [0, 0, 0], [4, 3, 2.5], inward=True, omit=["+z"])
    ring = [[0, 0, 2.5], [0, 3, 2.5], [4, 3, 2.5], [4, 0, 2.5]]
    hole = [[1.1, 1.2, 2.5], [1.8, 1.2, 2.5], [1.8, 1.7, 2.5], [1.1, 1.7, 2.5]]
    roof = Surface.from_polygons("roof", diffuse("roof", 0.0), [[np.array(ring, float), np.array(hole)]])
    direction = np.array([0.31, 0.17, -1.0]) / np.linalg.norm([0.31, 0.17, -1.0])
    scene = Scene("room", (walls, roof), lights=(Light("sun", "directional", ONE, direction=direction),), bands=1)
    solution = radiosity.solve(scene, elements=elements, workers=1)
    arrived = solution.mesh.element_area @ solution.element_irradiance[:, 0]
    assert arrived == pytest.approx(0.7 * 0.5 * -direction[2], rel=0.02)
