"""Reader of NFF, Eric Haines' Neutral File Format, in which the Standard Procedural Databases come.

Read are ``v`` (view), ``b`` (background), ``l`` (light), ``f`` (fill), ``c`` (cone or cylinder),
``s`` (sphere), ``p`` (polygon), ``pp`` (patch with normals) and ``#`` comments.  Line ends mean
nothing, so the eight numbers of ``c`` may stand on its own line or on the two below it, and ``b``
may stand before ``v``.  The reader asks that ``v`` and a fill come before the first object, as the
format wants.  A light without a colour is white, radiance 1.

The format's rules that matter here: polygons are one-sided, counter-clockwise seen from the front,
unless their fill lets light through (T > 0); a negative radius (both, for a cone) shows the inside
only; cones have no caps; ``angle`` spans the picture from its lower to its upper edge, which is how
the published counts of the databases use it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from workbench.errors import SceneError
from workbench.scene._tokens import LARGEST_SIDE, Words, read_text, ring_fault
from workbench.scene.library import cone_surface, sphere_surface
from workbench.scene.model import Camera, Light, Material, Scene, Surface

__all__ = [
    "NffCone",
    "NffFill",
    "NffLight",
    "NffPolygon",
    "NffScene",
    "NffSphere",
    "NffView",
    "load_scene",
    "read_nff",
]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class NffView:
    """The viewpoint: ``eye``, ``at``, ``up`` (3,), full ``angle_deg`` [degrees], ``hither``, pixels."""

    eye: FloatArray
    at: FloatArray
    up: FloatArray
    angle_deg: float
    hither: float
    width: int
    height: int


@dataclass(frozen=True)
class NffLight:
    """A point light: ``position`` (3,) and ``color`` (3,)."""

    position: FloatArray
    color: FloatArray


@dataclass(frozen=True)
class NffFill:
    """A fill: ``color`` (3,), ``kd``, ``ks``, Phong exponent ``shine``, transmittance ``t``, ``ior``."""

    color: FloatArray
    kd: float
    ks: float
    shine: float
    t: float
    ior: float


@dataclass(frozen=True)
class NffPolygon:
    """A polygon ``p``, or with unit ``normals`` (n, 3) a patch ``pp``; ``fill`` is an index."""

    vertices: FloatArray
    normals: FloatArray | None
    fill: int
    line: int


@dataclass(frozen=True)
class NffSphere:
    """A sphere; a negative ``radius`` shows the inside only."""

    center: FloatArray
    radius: float
    fill: int
    line: int


@dataclass(frozen=True)
class NffCone:
    """The side of a cone or cylinder, without caps; negative radii show the inside only."""

    base: FloatArray
    base_radius: float
    apex: FloatArray
    apex_radius: float
    fill: int
    line: int


@dataclass(frozen=True)
class NffScene:
    """Everything that an NFF file says, in its order."""

    view: NffView
    background: FloatArray
    lights: tuple[NffLight, ...]
    fills: tuple[NffFill, ...]
    objects: tuple[NffPolygon | NffSphere | NffCone, ...]
    path: Path


def _read_view(words: Words) -> NffView:
    line = words.line
    found: dict[str, FloatArray | float | tuple[int, int]] = {}
    while len(found) < 6:
        key = words.take("from, at, up, angle, hither or resolution")
        if key in found:
            words.fail(f"found {key!r} twice in one view, expected it once")
        if key in ("from", "at", "up"):
            found[key] = words.numbers(3, key)
        elif key == "angle":
            found[key] = words.number("the angle of view in degrees", 1e-3, 179.9)
        elif key == "hither":
            found[key] = words.number("the hither distance")
        elif key == "resolution":
            width = words.integer("the width", 1, LARGEST_SIDE)
            found[key] = (width, words.integer("the height", 1, LARGEST_SIDE))
        else:
            missing = [k for k in ("from", "at", "up", "angle", "hither", "resolution") if k not in found]
            words.unknown(key, f"{', '.join(missing)} of the view")
    eye, at, up = (np.asarray(found[key]) for key in ("from", "at", "up"))
    sight = at - eye
    across = np.linalg.norm(np.cross(sight, up))
    if not across > 1e-9 * np.linalg.norm(sight) * np.linalg.norm(up):
        words.fail("found from, at and up on one line, expected an up vector across the line of sight", line)
    width, height = found["resolution"]  # type: ignore[misc]
    return NffView(eye, at, up, float(found["angle"]), float(found["hither"]), width, height)  # type: ignore[arg-type]


def _read_polygon(words: Words, patch: bool, fill: int) -> NffPolygon:
    line = words.line
    count = words.integer("the number of vertices", 3, 10**6)
    rows = words.points(count, 6 if patch else 3, "vertex")
    vertices = np.ascontiguousarray(rows[:, :3])
    fault = ring_fault(vertices)
    if fault is not None:
        words.fail(f"found {fault}, expected a flat simple polygon", line)
    if not patch:
        return NffPolygon(vertices, None, fill, line)
    length = np.linalg.norm(rows[:, 3:], axis=1)
    if not (length > 0).all():
        words.fail(f"found a normal of length 0 at vertex {int(length.argmin()) + 1}, expected a direction", line)
    return NffPolygon(vertices, rows[:, 3:] / length[:, None], fill, line)


def _read_cone(words: Words, fill: int) -> NffCone:
    line = words.line
    base, base_radius = words.numbers(3, "the base of c"), words.number("the base radius of c")
    apex, apex_radius = words.numbers(3, "the apex of c"), words.number("the apex radius of c")
    if base_radius * apex_radius < 0 or (base_radius == 0 and apex_radius == 0):
        words.fail(
            f"found the radii {base_radius:g} and {apex_radius:g} of a cone, expected two of one sign and not both 0",
            line,
        )
    if not np.linalg.norm(apex - base) > 0:
        words.fail("found the same point for base and apex of a cone, expected two", line)
    return NffCone(base, base_radius, apex, apex_radius, fill, line)


def read_nff(path: str | Path) -> NffScene:
    """Read an NFF file; spheres, cones and cylinders stay exact.

    Raises
    ------
    SceneError
        If the file cannot be read or breaks a rule; the message names file and line.
    """
    words = Words(read_text(path), path)
    view: NffView | None = None
    background = np.zeros(3)
    lights: list[NffLight] = []
    fills: list[NffFill] = []
    objects: list[NffPolygon | NffSphere | NffCone] = []
    while words.peek() is not None:
        word = words.take("an entity")
        if word in ("c", "s", "p", "pp"):
            if view is None:
                words.fail(f"found {word!r} before the view, expected 'v' first; move the view up")
            if not fills:
                words.fail(f"found {word!r} before the first fill, expected 'f' first; add a fill")
        if word == "v":
            if view is not None:
                words.fail("found a second view 'v', expected one; remove it")
            view = _read_view(words)
        elif word == "b":
            background = words.numbers(3, "background", 0.0)
        elif word == "l":
            position = words.numbers(3, "the position of l")
            color = words.numbers(3, "the colour of l", 0.0) if words.next_is_number() else np.ones(3)
            lights.append(NffLight(position, color))
        elif word == "f":
            color = words.numbers(3, "the colour of f", 0.0)
            names = ("Kd", "Ks", "Shine", "T", "the index of refraction")
            fills.append(NffFill(color, *(words.number(f"{name} of f", 0.0) for name in names)))
        elif word == "s":
            line = words.line
            center, radius = words.numbers(3, "the centre of s"), words.number("the radius of s")
            if radius == 0:
                words.fail("found the radius 0 of a sphere, expected another number", line)
            objects.append(NffSphere(center, radius, len(fills) - 1, line))
        elif word == "c":
            objects.append(_read_cone(words, len(fills) - 1))
        elif word in ("p", "pp"):
            objects.append(_read_polygon(words, word == "pp", len(fills) - 1))
        else:
            words.unknown(word, "one of v, b, l, f, c, s, p, pp or a # comment")
    if view is None:
        words.fail("found no view, expected one; add 'v'")
    return NffScene(view, background, tuple(lights), tuple(fills), tuple(objects), words.path)


def _material(fill: NffFill, index: int, scene: NffScene, line: int) -> Material:
    for name, value in (("colour * Kd", fill.color.max() * fill.kd), ("Ks", fill.ks), ("T", fill.t)):
        if value > 1:
            raise SceneError(
                f"found {name} = {value:g} in the fill of this object, expected 0 to 1; lower it",
                path=scene.path,
                line=line,
            )
    reflectance = fill.color * fill.kd
    return Material(
        name=f"fill {index}",
        reflectance=reflectance,
        emission=np.zeros(3),
        specular=np.full(3, fill.ks),
        exponent=fill.shine,
        transmittance=np.minimum(fill.t, 1.0 - reflectance),
        # Opaque fills often give 0, which no ray ever meets.
        ior=fill.ior or 1.0,
        two_sided=fill.t > 0,
    )


def _patch_surface(name: str, material: Material, patches: list[NffPolygon]) -> Surface:
    """Patches as one smooth surface: vertices at the same place with the same normal are shared."""
    rows = np.concatenate([np.hstack([p.vertices, p.normals]) for p in patches if p.normals is not None])
    shared, index = np.unique(rows, axis=0, return_inverse=True)
    offsets = np.concatenate([[0], np.cumsum([len(patch.vertices) for patch in patches])]).astype(np.int64)
    return Surface(
        name=name,
        material=material,
        vertices=np.ascontiguousarray(shared[:, :3]),
        ring_vertices=index.reshape(-1).astype(np.int64),
        ring_offsets=offsets,
        face_rings=np.arange(len(patches) + 1, dtype=np.int64),
        vertex_normals=np.ascontiguousarray(shared[:, 3:]),
    )


def _round_surface(name: str, material: Material, thing: NffSphere | NffCone, facet_error: float) -> Surface:
    """A sphere, cone or cylinder as facets."""
    if isinstance(thing, NffSphere):
        return sphere_surface(
            name, material, thing.center, abs(thing.radius), facet_error=facet_error, inward=thing.radius < 0
        )
    return cone_surface(
        name,
        material,
        thing.base,
        abs(thing.base_radius),
        thing.apex,
        abs(thing.apex_radius),
        facet_error=facet_error,
        inward=min(thing.base_radius, thing.apex_radius) < 0,
    )


def load_scene(path: str | Path, *, facet_error: float = 0.02) -> Scene:
    """An NFF scene as the record that the renderers read.

    Polygons of one fill make a surface, patches of one fill another with vertex normals; each
    sphere, cone or cylinder makes its own, tessellated, with the facet error stated.  Reflectance
    is ``colour * Kd``, ``specular`` is ``Ks`` in every band, ``T`` the transmittance, cut where it and
    the reflectance exceed 1.  A light becomes a point light of radiant intensity ``colour`` [W/sr]; NFF
    says nothing of fall-off.  The hither plane is left out.

    Parameters
    ----------
    path : path
    facet_error : float
        Largest distance between a round object and its facets, as a share of its radius.

    Raises
    ------
    SceneError
        As :func:`read_nff`; also for a reflectance, ``Ks`` or ``T`` above 1.
    """
    source = read_nff(path)
    materials: dict[int, Material] = {}
    members: dict[tuple[int, str, int], list[NffPolygon | NffSphere | NffCone]] = {}
    for index, thing in enumerate(source.objects):
        if thing.fill not in materials:
            materials[thing.fill] = _material(source.fills[thing.fill], thing.fill, source, thing.line)
        if isinstance(thing, NffPolygon):
            key = (thing.fill, "polygons" if thing.normals is None else "patches", -1)
        else:
            key = (thing.fill, "sphere" if isinstance(thing, NffSphere) else "cone", index)
        members.setdefault(key, []).append(thing)
    surfaces = []
    for (fill, kind, index), found in members.items():
        material = materials[fill]
        name = f"{material.name}, {kind}" + (f" {index}" if index >= 0 else "")
        polygons = [thing for thing in found if isinstance(thing, NffPolygon)]
        if kind == "polygons":
            surfaces.append(Surface.from_polygons(name, material, [polygon.vertices for polygon in polygons]))
        elif kind == "patches":
            surfaces.append(_patch_surface(name, material, polygons))
        else:
            surfaces += [
                _round_surface(name, material, thing, facet_error)
                for thing in found
                if not isinstance(thing, NffPolygon)
            ]
    view = source.view
    return Scene(
        name=source.path.stem,
        surfaces=tuple(surfaces),
        lights=tuple(
            Light(f"light {index}", "point", light.color, position=light.position)
            for index, light in enumerate(source.lights)
        ),
        camera=Camera(view.eye, view.at, view.up, view.angle_deg, view.width, view.height),
        background=source.background,
        path=source.path,
        notes=(f"spheres, cones and cylinders are facets that lie within {facet_error:g} of their radius",)
        if any(not isinstance(thing, NffPolygon) for thing in source.objects)
        else (),
    )
