"""The catalogue's entries for sensors and pictures: near hits, corners, fireflies, silhouettes, leaks."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radiosity.report.failures import Failure, point_irradiance, spread_of
from radiosity.rivals import open_rival
from workbench.scene.library import box_surface, diffuse, unit_cube
from workbench.scene.model import Camera, Light, Scene, Surface

__all__ = ["gather_entries", "picture_entries"]

FloatArray = NDArray[np.float64]

GATHERS = ("auto+gather", "matrix+gather", "progressive+gather", "hierarchical+gather")
ERROR = 0.01
"""What solves, gathers and pictures are asked for."""
PICTURES = ("aliased picture", "adaptive picture", "atomic picture", "gathered picture")
RIVAL_SAMPLES = 1024


# ---- scenes -----------------------------------------------------------------------------------------


def _flat(name: str, reflectance: float, ring: ArrayLike, emission: float = 0.0) -> Surface:
    return Surface.from_polygons(name, diffuse(name, reflectance, emission), [np.asarray(ring, dtype=float)])


def _lit_wall(*others: Surface, camera: Camera | None = None) -> Scene:
    """A wall at x = 0 that light along -x makes send 1 [W m-2] all over, and a floor that it only grazes."""
    wall = _flat("wall", 0.5, [[0, -1, 0], [0, 1, 0], [0, 1, 1], [0, -1, 1]])
    floor = _flat("floor", 0.5 if camera is not None else 0.0, [[0, -1, 0], [2, -1, 0], [2, 1, 0], [0, 1, 0]])
    sun = Light("sun", "directional", np.array([2.0]), direction=np.array([-1.0, 0.0, 0.0]))
    return Scene("lit wall", (wall, floor, *others), lights=(sun,), camera=camera, background=np.zeros(1), bands=1)


def _wall_factor(point: ArrayLike, low: float = 0.0, high: float = 1.0) -> float:
    """Irradiance on a floor from the part of the wall between two heights, which sends 1: radiance 1 / pi."""
    ring = [[0, -1, low], [0, 1, low], [0, 1, high], [0, -1, high]]
    return point_irradiance(ring, point) / math.pi


# ---- sensors ----------------------------------------------------------------------------------------


def _sensor(scene: Scene, technique: str, point: ArrayLike, normal: ArrayLike) -> tuple[float, float]:
    from radiosity.accuracy import solve

    place, facing = np.asarray(point, dtype=float)[None], np.asarray(normal, dtype=float)[None]
    if technique in ("mitsuba", "radiance"):
        opened = open_rival(technique, scene)
        return spread_of(
            lambda seed: float(opened.irradiance(place, facing, samples=4 * RIVAL_SAMPLES, seed=seed)[0, 0])
        )
    if technique == "auto+gather":
        solution = solve(scene, error=ERROR, workers=1, seed=1)
    else:
        solution = solve(scene, method=technique.removesuffix("+gather"), elements=64, workers=1, seed=1)
    found = solution.irradiance(place, facing, error=ERROR, workers=1, seed=1)
    value = float(found.irradiance[0, 0])
    # What a solve to an error says of its mesh, and what the gather says of its rays.
    mesh = float(solution.record.errors["estimate"]["total"]) if technique == "auto+gather" else 0.0
    return value, math.hypot(float(found.standard_error[0, 0]), mesh * value)


def _sensors(
    name: str, group: str, about: str, scene: Scene, expected: float, point: ArrayLike, *,
    normal: ArrayLike = (0.0, 0.0, 1.0), relative_to: float | None = None,
    rivals: Sequence[str] = ("mitsuba", "radiance"),
) -> Failure:  # fmt: skip
    techniques = {technique: partial(_sensor, scene, technique, point, normal) for technique in (*GATHERS, *rivals)}
    # Asked is a root mean square over points: one of them may be off by twice as much.
    tolerance = 2.0 * ERROR * (expected if relative_to is None else relative_to)
    return Failure(name, group, about, expected, tolerance, techniques)


def gather_entries() -> list[Failure]:
    """Irradiance at one point, direct and reflected."""
    furnace = unit_cube(0.5, 1.0)
    plate = _flat("plate", 0.0, [[0.0, -1, 0.25], [0.0, 1, 0.25], [0.4, 1, 0.25], [0.4, -1, 0.25]])
    lamp = _flat("lamp", 0.0, [[-0.5, 0.5, 2], [0.5, 0.5, 2], [0.5, -0.5, 2], [-0.5, -0.5, 2]], math.pi)
    shade = _flat("shade", 0.0, [[-0.2, -0.2, 1], [0.2, -0.2, 1], [0.2, 0.2, 1], [-0.2, 0.2, 1]])
    floor = _flat("floor", 0.5, [[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]])
    dip = Scene("dip", (lamp, shade, floor), background=np.zeros(1), bands=1)
    whole = point_irradiance(lamp.vertices)
    hidden = point_irradiance(lamp.vertices * [0.8, 0.8, 1.0])
    inside = box_surface("inside", diffuse("inside", 0.5, 1.0), [0, 0, 0], [1, 1, 1], inward=True)
    outside = box_surface("outside", diffuse("outside", 0.5), [-2, -2, -2], [3, 3, 3], inward=True)
    boxes = Scene("box in a box", (inside, outside), background=np.zeros(1), bands=1, closed=True)
    faces = furnace.surfaces
    # Irradiance in the middle of the face across from a grey emitter, by Galerkin elements on graded meshes.
    half_lit = replace(
        furnace, surfaces=(*(replace(face, material=diffuse("wall", 0.5)) for face in faces[:5]), faces[5])
    )
    entries = [
        _sensors(f"{distance:g} from a lit wall", "near hits", "samples of its elements blow up as 1 / d^2, or miss it",
                 _lit_wall(), _wall_factor([distance, 0, 0]), [distance, 0, 0])
        for distance in (0.1, 1e-2, 1e-4)
    ]  # fmt: skip
    return [
        *entries,
        _sensors("in the corner of a furnace", "near hits", "rays that leave through the crack: e / (1 - rho) = 2",
                 furnace, 2.0, [1e-4, 1e-4, 0.0], rivals=("mitsuba",)),
        _sensors("under a plate, beside a lit wall", "near hits", "light read off an element that is half hidden",
                 _lit_wall(plate), _wall_factor([0.2, 0, 0], 0.0, 0.25), [0.2, 0.0, 0.0]),
        _sensors("the middle of the far face", "near hits", "an element's mean, or the mesh's, taken for the point",
                 half_lit, 0.395208818, [0.5, 0.5, 0.0], rivals=("mitsuba",)),
        _sensors("a dip between equal corners", "missed small shadows", "corners agree and the dip is not found",
                 dip, whole - hidden, [0, 0, 0]),
        _sensors("direct light once", "near hits", "light of the solution and of the shadow rays, both",
                 replace(dip, surfaces=(lamp, floor)), whole, [0, 0, 0]),
        _sensors("outside a closed box", "leaks", "light read off elements behind the wall", boxes, 0.0,
                 [0.5, 0.5, -1e-3], normal=(0.0, 0.0, 1.0), relative_to=2.0, rivals=("mitsuba",)),
    ]  # fmt: skip


# ---- pictures ---------------------------------------------------------------------------------------


def _drawn(scene: Scene, technique: str) -> tuple[FloatArray, float]:
    """Radiance (height, width) of a picture, and the relative error that it states."""
    from radiosity.accuracy import solve
    from radiosity.gather import GatherOptions, PictureGatherer
    from workbench.render.camera import PinholeRays
    from workbench.render.direct import render_direct

    assert scene.camera is not None
    if technique != "gathered picture":
        sampling = technique.removesuffix(" picture")
        return render_direct(scene, sampling=sampling, threshold=0.02, workers=1).picture.radiance[..., 0], math.nan
    solution = solve(scene, elements=64, workers=1, seed=1)
    gatherer = PictureGatherer(solution, GatherOptions(error=ERROR), workers=1, seed=1)
    picture = gatherer.draw(PinholeRays.from_camera(scene.camera))
    return picture.radiance[..., 0], picture.measured_error()


def _picture(scene: Scene, technique: str, read: Callable[[FloatArray], float]) -> tuple[float, float]:
    if technique in ("mitsuba", "radiance"):
        opened, camera = open_rival(technique, scene), scene.camera
        assert camera is not None
        return spread_of(lambda seed: read(opened.picture(camera, samples=RIVAL_SAMPLES, seed=seed)[..., 0]))
    radiance, stated = _drawn(scene, technique)
    value = read(radiance)
    return value, stated * abs(value)


def _pictures(
    name: str, group: str, about: str, scene: Scene, expected: float, read: Callable[[FloatArray], float],
    techniques: Sequence[str], tolerance: float, disclaimed: Mapping[str, str] | None = None,
) -> Failure:  # fmt: skip
    made = {technique: partial(_picture, scene, technique, read) for technique in techniques}
    return Failure(name, group, about, expected, tolerance, made, disclaimed or {})


def _penumbra(end: float, x: float, y: float) -> float:
    """Irradiance from the part with x from -1/2 to ``end`` of a unit square of radiance 1 at height 2."""
    ring = [[-0.5, 0.5, 2], [end, 0.5, 2], [end, -0.5, 2], [-0.5, -0.5, 2]]
    return point_irradiance(ring, [x, y, 0.0])


def picture_entries() -> list[Failure]:
    """One number of a small picture."""
    eye = Camera(np.array([0.05, 0.02, 2.0]), np.array([0.05, 0.02, 0.0]), np.array([0.0, 1.0, 0.0]), 40.0, 16, 16)
    ground = _flat("ground", 0.5, [[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
    square = _flat("square", 0.0, [[-0.3, -0.3, 0.5], [0.3, -0.3, 0.5], [0.3, 0.3, 0.5], [-0.3, 0.3, 0.5]])
    noon = Light("noon", "directional", np.array([2.0 * math.pi]), direction=np.array([0.0, 0.0, -1.0]))
    black = Scene("square", (ground, square), lights=(noon,), camera=eye, background=np.zeros(1), bands=1)
    seen = 4.0 * math.tan(math.radians(20.0))  # side of what the picture shows of the ground
    # The square stands in front of its own shadow: seen at distance 1.5, it covers as much as a square 2 / 1.5 as wide.
    share = (0.6 * 2.0 / 1.5 / seen) ** 2

    # Half a pixel wide, in the middle of one of 8 x 8 pixels: a sixteenth of a pixel in from each of its sides.
    wide = seen / 8 * (2.0 - 0.01) / 2.0
    place = np.array([0.05 + 0.5 * seen / 8, 0.02 + 0.5 * seen / 8, 0.0])
    dot = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]]) * 0.25 * wide
    middle_of_pixel = (place - eye.eye * [1, 1, 0]) * (2.0 - 0.01) / 2.0 + eye.eye * [1, 1, 0] + [0, 0, 0.01]
    few = replace(eye, width=8, height=8)
    speck = replace(black, surfaces=(ground, _flat("speck", 0.0, dot + middle_of_pixel)), camera=few)

    down = Camera(np.array([0.5, 0.0, 0.9]), np.array([0.5, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), 30.0, 12, 12)
    bright = _lit_wall(camera=down)
    # The middle of each pixel; light changes little across it.
    side = 2.0 * 0.9 * math.tan(math.radians(15.0))
    middle = (np.arange(12) + 0.5) / 12.0 * side - 0.5 * side
    truth = np.array([[0.5 * _wall_factor([0.5 + x, y, 0.0]) / math.pi for x in middle] for y in -middle])

    within = Camera(np.array([0.5, 0.5, 0.5]), np.array([1.0, 0.9, 0.95]), np.array([0.0, 0.0, 1.0]), 70.0, 12, 12)
    furnace = replace(unit_cube(0.5, 1.0), camera=within)
    inside = box_surface("inside", diffuse("inside", 0.5, 1.0), [0.4, 0.4, 0.4], [0.6, 0.6, 0.6], inward=True)
    corner = Camera(np.array([0.1, 0.1, 0.1]), np.array([0.5, 0.5, 0.5]), np.array([0.0, 0.0, 1.0]), 60.0, 12, 12)
    outside = box_surface("outside", diffuse("outside", 0.5), [0, 0, 0], [1, 1, 1], inward=True)
    shell = box_surface("shell", diffuse("shell", 0.5), [0.39, 0.39, 0.39], [0.61, 0.61, 0.61])
    boxes = Scene("box in a box", (inside, outside, shell), camera=corner, background=np.zeros(1), bands=1, closed=True)
    # Under a black half-plane: at x the part of the lamp with x' < -x is seen.
    under = Camera(np.array([0.0, 0.0, 0.9]), np.array([0.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), 50.0, 12, 12)
    lamp = _flat("lamp", 0.0, [[-0.5, 0.5, 2], [0.5, 0.5, 2], [0.5, -0.5, 2], [-0.5, -0.5, 2]], math.pi)
    half_plane = _flat("half-plane", 0.0, [[0, -9, 1], [9, -9, 1], [9, 9, 1], [0, 9, 1]])
    soft = Scene("penumbra", (lamp, half_plane, ground), camera=under, background=np.zeros(1), bands=1)
    reach = 0.9 * math.tan(math.radians(25.0))
    parts = ((np.arange(48) + 0.5) / 24.0 - 1.0) * reach
    seen_to = np.clip(-parts, -0.5 + 1e-9, 0.5)
    fine = np.array([[_penumbra(end, x, y) for x, end in zip(parts, seen_to, strict=True)] for y in -parts])
    penumbra = 0.5 / math.pi * fine.reshape(12, 4, 12, 4).mean(axis=(1, 3))

    panes = [replace(diffuse(f"pane {tau}", 0.0), transmittance=np.array([tau])) for tau in (0.5, 0.8)]
    sides = ([[-9, -9, 1], [0, -9, 1], [0, 9, 1], [-9, 9, 1]], [[0, -9, 1], [9, -9, 1], [9, 9, 1], [0, 9, 1]])
    tinted = replace(black, camera=under, surfaces=(ground, *(
        Surface.from_polygons(pane.name, pane, [np.asarray(ring, dtype=float)])
        for pane, ring in zip(panes, sides, strict=True)
    )))  # fmt: skip
    tints = np.repeat([[0.5, 0.8]], 6, axis=1)
    aside = np.abs(np.arange(12) - 5.5) > 1.0  # of the edge between them

    # The raised square is of the ground's own surface; slanting light takes its shadow 0.4 aside.
    sheet = Surface.from_polygons("sheet", diffuse("sheet", 0.5), [ground.vertices, square.vertices])
    slanted = replace(noon, direction=np.array([0.4, 0.0, -0.5]) / math.hypot(0.4, 0.5))
    fold = replace(black, surfaces=(sheet,), lights=(slanted,))
    dark = (0.7 - (0.05 + 0.25 * 2.0 / 1.5)) * 0.6  # what the square itself leaves to be seen of it
    folded = 0.5 / math.hypot(0.4, 0.5) * (1.0 - dark / seen**2)
    gathers = ("gathered picture", "mitsuba")
    near = (*gathers, "radiance")
    return [
        _pictures("a silhouette", "silhouettes", "a sample a pixel takes edge pixels for all or nothing", black,
                  1.0 - share, lambda picture: float(picture.mean()), (*PICTURES, "mitsuba", "radiance"), 0.003,
                  {"aliased picture": "one sample a pixel: edges are steps"}),
        _pictures("a square smaller than a pixel", "missed small shadows", "corners of the pixel agree", speck,
                  1.0 - 0.25 / 64, lambda picture: float(picture.mean()), (*PICTURES, "mitsuba", "radiance"), 0.001,
                  {"aliased picture": "one sample a pixel"} | dict.fromkeys(
                      ("adaptive picture", "atomic picture"), "a feature between agreeing corners is not known")),
        _pictures("a fold in one surface", "silhouettes", "corners on one and the same surface are taken for one plane",
                  fold, folded, lambda picture: float(picture.mean()), (*PICTURES, "mitsuba", "radiance"),
                  0.003, {"aliased picture": "one sample a pixel: edges are steps"}),
        _pictures("a penumbra", "silhouettes", "corners in part lit are believed to agree: rms of all pixels", soft,
                  0.0, lambda picture: float(np.sqrt(((picture - penumbra) ** 2).mean()) / penumbra.mean()), PICTURES,
                  0.02),
        _pictures("panes of two strengths", "union, not product", "equal states, but not equal light", tinted, 0.0,
                  lambda picture: float(np.abs(picture - tints)[:, aside].max()), PICTURES, 0.005),
        _pictures("a floor before a lit wall", "fireflies", "single pixels far too bright where rays hit the wall near",
                  bright, 1.0, lambda picture: float((picture / truth).max()), near, 0.03),
        _pictures("dark spots before a lit wall", "fireflies", "single pixels that no ray to the wall lights", bright,
                  1.0, lambda picture: float((picture / truth).min()), near, 0.03),
        _pictures("corners of a furnace", "dim corners", "corners darker than walls where e / (1 - rho) / pi is all",
                  furnace, 2.0 / math.pi, lambda picture: float(picture.min()), gathers, 0.01),
        _pictures("edges of a furnace", "dim corners", "corners brighter than walls", furnace, 2.0 / math.pi,
                  lambda picture: float(picture.max()), gathers, 0.01),
        _pictures("round a closed box", "leaks", "light of a closed box seen on the walls round it", boxes, 0.0,
                  lambda picture: float(picture.max()), gathers, 1e-9),
    ]  # fmt: skip
