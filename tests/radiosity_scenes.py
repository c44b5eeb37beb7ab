"""Scenes and shared truths for the tests of form factors and solvers."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from radiosity.form_factors.bundle import Columns, LinkSettings, ReceiverBundles
from radiosity.patches import PatchMesh, build_mesh
from workbench.geometry.flat import Geometry
from workbench.scene.library import box_surface, diffuse
from workbench.scene.model import Material, Scene, Surface

TRUTH = Path(__file__).resolve().parents[1] / ".." / "shared" / "truth" / "truth.json"

UNIT = ([0, 0, 0], [1, 1, 1])


@cache
def truths() -> dict[str, dict]:
    """The shared truths by name; none where the folder is absent."""
    if not TRUTH.exists():
        return {}
    return {case["name"]: case for case in json.loads(TRUTH.read_text())["cases"]}


def each_truth(prefix: str, key: str = ""):
    """Parametrize a test over the shared truths whose name begins so and whose geometry has ``key``."""
    found = [
        name for name, case in truths().items() if name.startswith(prefix) and (not key or key in case["geometry"])
    ]
    if not found and truths():
        raise ValueError(f"no shared truth begins with {prefix!r} and has {key!r}: the test would test nothing")
    if not found:
        reason = f"the shared truths are not beside this checkout ({TRUTH})"
        return pytest.mark.parametrize("name", [pytest.param(prefix, marks=pytest.mark.skip(reason=reason))])
    return pytest.mark.parametrize("name", found)


def truth(name: str) -> dict:
    """One shared truth; skips the test where the folder is absent."""
    if not truths():
        pytest.skip(f"the shared truths are not beside this checkout ({TRUTH})")
    return truths()[name]


def polygon_scene(*polygons, material: Material | None = None, closed: bool = False) -> Scene:
    """A scene of one surface a polygon; a polygon is a ring or a list of rings."""
    paint = material if material is not None else diffuse("paint", 0.5)
    return Scene(
        "polygons",
        tuple(Surface.from_polygons(f"polygon {i}", paint, [polygon]) for i, polygon in enumerate(polygons)),
        bands=len(paint.reflectance),
        closed=closed,
    )


def tight(error: float, **options) -> LinkSettings:
    """Settings that settle everything by closed forms and exact cuts, no rays."""
    values = {"error": error, "floor": 1e-2 * error, "candidates": 40, "levels": 14, "closed_forms": True}
    return LinkSettings(**{**values, **options})


def all_columns(scene: Scene, settings: LinkSettings, **mesh_options) -> tuple[Columns, PatchMesh, ReceiverBundles]:
    """Form factors from every element to every patch; row j of ``factor`` is the column of patch j."""
    geometry = Geometry.from_scene(scene)
    mesh = build_mesh(scene, geometry, **mesh_options)
    bundles = ReceiverBundles(geometry, mesh, settings)
    try:
        return bundles.columns(np.arange(mesh.patch_count)), mesh, bundles
    finally:
        bundles.close()


def cube_with_emitter(rho_emitter: float, rho_others: float) -> Scene:
    """The inside of the unit cube; the floor emits 1."""
    floor = box_surface(
        "floor", diffuse("glow", rho_emitter, 1.0), *UNIT, inward=True, omit=["-x", "+x", "-y", "+y", "+z"]
    )
    others = box_surface("others", diffuse("wall", rho_others), *UNIT, inward=True, omit=["-z"])
    return Scene("cube", (floor, others), bands=1, closed=True)


def spherical_cap(fraction: float, rings: int, sectors: int, material: Material) -> Surface:
    """The lower part of the unit sphere, seen from inside, with a share ``fraction`` of its area."""
    heights = np.cos(np.linspace(np.pi, np.arccos(2.0 * fraction - 1.0), rings + 1))
    around = np.arange(sectors + 1) * (2.0 * np.pi / sectors)
    around[-1] = 0.0

    def point(i: int, j: int) -> list[float]:
        radius = np.sqrt(max(1.0 - heights[i] ** 2, 0.0)) if i else 0.0
        return [radius * np.cos(around[j]), radius * np.sin(around[j]), heights[i]]

    faces = []
    for i in range(rings):
        for j in range(sectors):
            ring = [point(i + 1, j), point(i + 1, j + 1), point(i, j + 1), point(i, j)]
            faces.append(np.array(ring if i else ring[:3]))
    faces = [face[::-1] if np.cross(face[1] - face[0], face[2] - face[0]) @ face[0] > 0 else face for face in faces]
    return Surface.from_polygons("cap", material, faces)


def standing_box(*, bottom: bool = True) -> Scene:
    """A closed room with a box on its floor; with its bottom, box and floor cover each other."""
    room = box_surface("room", diffuse("wall", 0.7), *UNIT, inward=True, omit=["+z"])
    lamp = box_surface("lamp", diffuse("lamp", 0.5, 1.0), *UNIT, inward=True, omit=["-x", "+x", "-y", "+y", "-z"])
    box = box_surface("box", diffuse("box", 0.5), [0.3, 0.35, 0.0], [0.6, 0.65, 0.45], omit=[] if bottom else ["-z"])
    return Scene("room with a box", (room, lamp, box), bands=1, closed=True)


def l_room(emitter: int | None = None) -> Scene:
    """An L-shaped room of eight surfaces, one of which may emit 1."""
    plan = np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 3], [0, 3]], dtype=float)
    floor = np.column_stack([plan, np.zeros(6)])
    walls = []
    for i in range(6):
        (ax, ay), (bx, by) = plan[i], plan[(i + 1) % 6]
        walls.append(np.array([[ax, ay, 0], [ax, ay, 3], [bx, by, 3], [bx, by, 0]]))
    polygons = [*walls, (floor + [0, 0, 3])[::-1], floor]
    surfaces = tuple(
        Surface.from_polygons(str(i + 1), diffuse(str(i + 1), 0.5, float(i == emitter)), [polygon])
        for i, polygon in enumerate(polygons)
    )
    return Scene("L", surfaces, bands=1, closed=True)


def huge_plates(rho: tuple[float, float], emission: tuple[float, float], side: float = 1e7) -> Scene:
    """Two facing plates at distance 1, so wide that they lose but 2 / side of their light at the rim."""
    plate = np.array([[0, 0, 0], [side, 0, 0], [side, side, 0], [0, side, 0]])
    return Scene(
        "plates",
        (
            Surface.from_polygons("lower", diffuse("lower", rho[0], emission[0]), [plate]),
            Surface.from_polygons("upper", diffuse("upper", rho[1], emission[1]), [plate[::-1] + [0, 0, 1.0]]),
        ),
        bands=1,
    )
