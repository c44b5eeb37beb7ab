"""Four test pictures in the spirit of Woo's Figures 6 to 9, all of rational B-spline surfaces.

A. Woo, "Efficient Shadow Computations in Ray Tracing" (IEEE CG&A 13(5), 1993), names them: pots
and a chair under two lights, a desk under one, spheres under three, tori under one linear light;
"each surface is mirror reflective", everything is tessellated into triangles, so that surface and
polygon differ.  The shapes, colours and lights here are our own: the paper gives none.  Textures
are fine enough to alias, one reason that the paper gives for subpixel samples.  Point lights do not
fall off with distance, as was usual then.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.errors import OptionError
from workbench.geometry.splines import (
    RationalSurface,
    clamped_knots,
    facet_error,
    surface_of_revolution,
    tessellate,
    torus,
)
from workbench.render.textures import Checker, Noise, Texture
from workbench.render.trace import TraceOptions, Tracer
from workbench.scene.library import transformed
from workbench.scene.model import Camera, Light, Material, Scene, Surface

__all__ = ["PICTURES", "TestPicture", "test_picture"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class TestPicture:
    """A scene with the textures and settings that make the picture."""

    __test__ = False  # not a test class, whatever its name

    scene: Scene
    textures: Mapping[str, Texture]
    options: TraceOptions

    def tracer(self, workers: int = 1) -> Tracer:
        """The scene ready to be traced."""
        return Tracer(self.scene, self.options, textures=self.textures, workers=workers)


def _material(name: str, colour: ArrayLike, mirror: float, exponent: float = 60.0, **more) -> Material:
    return Material(
        name=name,
        reflectance=np.asarray(colour, dtype=np.float64),
        emission=np.zeros(3),
        specular=np.full(3, mirror),
        exponent=exponent,
        transmittance=np.full(3, more.pop("transmittance", 0.0)),
        **more,
    )


def _moved(surface: Surface, at: ArrayLike, *, turn_deg: float = 0.0, tilt_deg: float = 0.0, scale: float = 1.0):
    """The surface scaled, tilted about the x axis, turned about the z axis, then put in its place."""
    a, b = math.radians(turn_deg), math.radians(tilt_deg)
    turn = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
    tilt = np.array([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
    matrix = np.eye(4)
    matrix[:3, :3] = scale * turn @ tilt
    matrix[:3, 3] = at
    return transformed(surface, matrix)


def _mesh(name: str, material: Material, spline: RationalSurface, u: int, v: int) -> Surface:
    vertices, faces, normals = tessellate(spline, u, v)
    return Surface.from_mesh(
        name, material, vertices, faces, vertex_normals=normals, facet_error=facet_error(spline, u, v)
    )


def _lathe(name: str, material: Material, profile: ArrayLike, u: int = 48, v: int = 40) -> Surface:
    return _mesh(name, material, surface_of_revolution(profile), u, v)


def _patch(name: str, material: Material, control: ArrayLike, u: int = 1, v: int = 1) -> Surface:
    """A non-rational patch of control points (n, m, 3), of degree 3 or less."""
    points = np.asarray(control, dtype=np.float64)
    degree = min(3, points.shape[0] - 1), min(3, points.shape[1] - 1)
    knots = clamped_knots(points.shape[0], degree[0]), clamped_knots(points.shape[1], degree[1])
    return _mesh(name, material, RationalSurface(degree, knots, points, np.ones(points.shape[:2])), u, v)


def _sheet(
    name: str, material: Material, corner: ArrayLike, along: ArrayLike, across: ArrayLike, cells: int
) -> Surface:
    """A flat patch; its front is the side of ``along`` x ``across``."""
    c, a, b = (np.asarray(vector, dtype=np.float64) for vector in (corner, along, across))
    return _patch(name, material, [[c, c + b], [c + a, c + a + b]], cells, cells)


def _slab(name: str, material: Material, low: ArrayLike, high: ArrayLike) -> list[Surface]:
    """A block as six flat patches; each is a surface of its own, as in a modeller of splines."""
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    size = high - low
    sides = []
    for axis in range(3):
        u, v = np.zeros(3), np.zeros(3)
        u[(axis + 1) % 3], v[(axis + 2) % 3] = size[(axis + 1) % 3], size[(axis + 2) % 3]
        top = low.copy()
        top[axis] = high[axis]
        sides.append(_sheet(f"{name} {'xyz'[axis]}+", material, top, u, v, 2))
        sides.append(_sheet(f"{name} {'xyz'[axis]}-", material, low, v, u, 2))
    return sides


def _room(floor: Material, walls: Material, low: ArrayLike, high: ArrayLike) -> list[Surface]:
    """Floor, ceiling and four walls of a room, each a flat patch that fronts inward.

    Rooms are closed, so that every reflected ray meets something, down to the last depth.
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    x, y, z = np.diag(high - low)
    return [
        _sheet("floor", floor, low, x, y, 12),
        _sheet("ceiling", walls, low + z, y, x, 12),
        _sheet("left wall", walls, low, y, z, 12),
        _sheet("right wall", walls, low + x, z, y, 12),
        _sheet("near wall", walls, low, z, x, 12),
        _sheet("far wall", walls, low + y, x, z, 12),
    ]


def _leg(name: str, material: Material, at: ArrayLike, height: float, radius: float) -> Surface:
    profile = [(0.0, 0.0), (radius, 0.0), (0.8 * radius, 0.4 * height), (radius, 0.8 * height), (0.9 * radius, height)]
    return _moved(_lathe(name, material, profile, 24, 16), at)


def _point(name: str, position: ArrayLike, strength: float, colour: ArrayLike = (1.0, 1.0, 1.0)) -> Light:
    power = strength * np.asarray(colour, dtype=np.float64)
    return Light(name, "point", power, position=np.asarray(position, dtype=np.float64))


def _camera(eye: ArrayLike, look_at: ArrayLike, fov_deg: float, width: int, height: int) -> Camera:
    start, target = np.asarray(eye, dtype=np.float64), np.asarray(look_at, dtype=np.float64)
    return Camera(start, target, np.array([0.0, 0.0, 1.0]), fov_deg, width, height)


_POT = [(0, 0), (0.5, 0), (0.85, 0.25), (0.95, 0.75), (0.55, 1.1), (0.42, 1.3), (0.6, 1.5), (0.67, 1.57),
        (0.55, 1.52), (0.33, 1.3), (0.46, 1.1), (0.86, 0.75), (0.75, 0.2), (0.4, 0.08), (0, 0.08)]  # fmt: skip
_JUG = [(0, 0), (0.45, 0), (0.6, 0.15), (0.62, 0.6), (0.4, 1.2), (0.3, 1.6), (0.42, 1.9), (0.46, 1.92),
        (0.38, 1.86), (0.24, 1.6), (0.34, 1.2), (0.55, 0.6), (0.5, 0.15), (0.3, 0.08), (0, 0.08)]  # fmt: skip
_BOWL = [(0, 0), (0.35, 0), (0.4, 0.1), (0.8, 0.3), (0.95, 0.65), (1.0, 0.68), (0.9, 0.62), (0.72, 0.35), (0.3, 0.16),
         (0, 0.15)]  # fmt: skip


def _pots(width: int, height: int) -> TestPicture:
    floor = _material("tiles", (0.75, 0.7, 0.62), 0.15)
    wall = _material("plaster", (0.7, 0.74, 0.78), 0.04, 10.0)
    clay = _material("clay", (0.72, 0.36, 0.22), 0.12, 30.0)
    glaze = _material("glaze", (0.2, 0.4, 0.62), 0.3, 120.0)
    cream = _material("cream glaze", (0.78, 0.74, 0.6), 0.2, 80.0)
    wood = _material("wood", (0.62, 0.42, 0.25), 0.1, 25.0)
    seat = [
        [(x, y, 0.95 + 0.08 * x * x + 0.05 * y * y) for y in (-0.75, -0.3, 0.3, 0.75)] for x in (-0.8, -0.3, 0.3, 0.8)
    ]
    back = [[(x, 0.78 + 0.1 * z - 0.25 * x * x, 0.9 + z) for z in (0.0, 0.5, 1.0, 1.5)] for x in (-0.8, -0.3, 0.3, 0.8)]
    chair = [
        _patch("seat", wood, seat, 16, 16),
        _patch("chair back", _both(wood), back, 16, 16),
        *(
            _leg(f"leg {i}", wood, (x, y, 0.0), 1.0, 0.09)
            for i, (x, y) in enumerate([(-0.65, -0.6), (0.65, -0.6), (-0.65, 0.62), (0.65, 0.62)])
        ),
    ]
    surfaces = [
        *_room(floor, wall, (-6, -9, 0), (6, 4, 7)),
        *(_moved(part, (1.6, 0.6, 0.0), turn_deg=-35.0, scale=1.25) for part in chair),
        _moved(_lathe("pot", clay, _POT), (-1.2, -0.6, 0.0), scale=1.1),
        _moved(_lathe("jug", glaze, _JUG), (-2.6, 0.9, 0.0), scale=1.3),
        _moved(_mesh("handle", glaze, torus(0.38, 0.07), 32, 16), (-3.2, 0.75, 1.45), turn_deg=10.0, tilt_deg=90.0),
        _moved(_lathe("bowl", cream, _BOWL), (0.1, -1.9, 0.0), scale=0.8),
        _moved(_lathe("small pot", clay, _POT), (-0.3, 1.7, 0.0), scale=0.75),
        _moved(_lathe("pot on chair", cream, _JUG, 40, 32), (1.6, 0.55, 1.22), scale=0.45),
    ]
    textures: dict[str, Texture] = {
        "floor": Checker(0.31, (0.95, 0.95, 0.95), (0.35, 0.32, 0.3), "xy", (0.013, 0.017, 0.0)),
        "far wall": Noise(0.08, 0.55, 1.0, 3, 2.5, seed=3),
        "seat": Noise(0.07, 0.4, 1.0, 2, 2.0, seed=5),
        "pot": Noise(0.12, (0.5, 0.4, 0.35), 1.0, 3, 2.5, seed=8),
        "small pot": Noise(0.1, (0.5, 0.4, 0.35), 1.0, 3, 2.5, seed=9),
    }
    lights = (
        _point("lamp", (-4.5, -5.0, 6.5), 1.7, (1.0, 0.95, 0.85)),
        _point("window", (5.0, -3.5, 4.5), 1.0, (0.8, 0.9, 1.0)),
    )
    scene = Scene(
        "pots and a chair", tuple(surfaces), lights, _camera((-0.6, -7.2, 3.4), (-0.3, 0.3, 1.0), 36.0, width, height),
        background=np.zeros(3),
    )  # fmt: skip
    return TestPicture(scene, textures, TraceOptions(falloff=False, ambient=0.12))


def _both(material: Material) -> Material:
    """The material on both sides of a sheet without thickness."""
    return Material(**{**material.__dict__, "two_sided": True})


def _desk(width: int, height: int) -> TestPicture:
    oak = _material("oak", (0.66, 0.46, 0.28), 0.12, 40.0)
    wall = _material("wall paper", (0.72, 0.7, 0.6), 0.03, 10.0)
    carpet = _material("carpet", (0.36, 0.22, 0.24), 0.02, 5.0)
    brass = _material("brass", (0.5, 0.38, 0.14), 0.45, 150.0)
    shade = _both(_material("shade", (0.18, 0.42, 0.3), 0.2, 60.0))
    china = _material("china", (0.82, 0.82, 0.8), 0.18, 100.0)
    covers = [
        _material(f"cover {i}", c, 0.05) for i, c in enumerate([(0.6, 0.15, 0.12), (0.15, 0.25, 0.5), (0.2, 0.42, 0.2)])
    ]
    paper = _material("paper", (0.85, 0.84, 0.78), 0.02, 5.0)
    sheet = [[(x, y, 0.01 + 0.03 * math.sin(3 * x + y)) for y in (0.0, 0.25, 0.5, 0.75)] for x in (0.0, 0.2, 0.4, 0.55)]
    lamp_shade = [(0.62, 0.0), (0.5, 0.3), (0.28, 0.5), (0.1, 0.55), (0.0, 0.56)]
    lamp_foot = [(0, 0), (0.4, 0), (0.42, 0.06), (0.1, 0.12), (0.05, 0.3), (0.05, 1.4), (0.05, 1.8), (0, 1.8)]
    mug = [
        (0, 0),
        (0.2, 0),
        (0.24, 0.02),
        (0.24, 0.3),
        (0.25, 0.52),
        (0.23, 0.54),
        (0.21, 0.5),
        (0.2, 0.3),
        (0.2, 0.06),
        (0, 0.05),
    ]
    top = 2.0
    surfaces = [
        *_room(carpet, wall, (-6, -8, 0), (6, 2.2, 7)),
        *_slab("top", oak, (-2.4, -1.1, top - 0.12), (2.4, 1.3, top)),
        *_slab("drawers", oak, (-2.2, -1.0, 0.0), (-1.1, 1.2, top - 0.12)),
        *_slab("side", oak, (2.0, -1.0, 0.0), (2.2, 1.2, top - 0.12)),
        *(_moved(_mesh(f"knob {i}", brass, torus(0.09, 0.03), 24, 12), (-1.65, -1.03, z), tilt_deg=90.0)
          for i, z in enumerate((0.45, 1.0, 1.5))),
        _moved(_lathe("lamp foot", brass, lamp_foot), (1.5, 0.6, top)),
        _moved(_lathe("lamp shade", shade, lamp_shade, 48, 20), (1.5, 0.6, top + 1.4)),
        _moved(_lathe("mug", china, mug), (0.2, -0.2, top)),
        _moved(_mesh("mug handle", china, torus(0.16, 0.035), 32, 12), (0.46, -0.2, top + 0.28), tilt_deg=90.0),
        _moved(_patch("letter", paper, sheet, 16, 16), (0.75, -0.85, top + 0.03), turn_deg=15.0),
        *_slab("book 0", covers[0], (-1.9, 0.1, top), (-1.0, 0.9, top + 0.14)),
        *_slab("book 1", covers[1], (-1.8, 0.15, top + 0.14), (-0.95, 0.8, top + 0.26)),
        *_slab("book 2", covers[2], (-1.85, 0.05, top + 0.26), (-1.1, 0.75, top + 0.42)),
        _moved(_lathe("globe", china, _ball(0.42), 48, 32), (-1.4, 0.45, top + 0.42 + 0.42)),
    ]  # fmt: skip
    textures: dict[str, Texture] = {
        surface.name: Noise(0.05, (0.6, 0.55, 0.5), 1.0, 2, 2.0, seed=2)
        for surface in surfaces
        if surface.material is oak
    }
    textures["floor"] = Noise(0.06, 0.3, 1.0, 2, 3.0, seed=4)
    textures["far wall"] = Checker(0.11, 1.0, (0.72, 0.7, 0.66), "xz", (0.03, 0.0, 0.02))
    textures["globe"] = Noise(0.15, (0.25, 0.4, 0.75), (0.5, 0.8, 0.4), 4, 4.0, seed=7)
    scene = Scene(
        "a desk", tuple(surfaces), (_point("lamp", (2.8, -4.2, 5.6), 2.4),),
        _camera((1.0, -6.4, 4.4), (0.0, 0.0, 1.75), 36.0, width, height), background=np.zeros(3),
    )  # fmt: skip
    return TestPicture(scene, textures, TraceOptions(falloff=False, ambient=0.15))


def _ball(radius: float) -> FloatArray:
    """A profile that is close to a half circle, from the south pole to the north: seven points."""
    k = 0.2652  # a cubic Bezier's handle for an eighth of a circle is 4/3 tan(pi/16)
    r = radius
    s = math.sqrt(0.5) * r
    return np.array(
        [
            (0, -r),
            (k * r, -r),
            (s - k * s, -s - k * s),
            (r, -k * r),
            (r, k * r),
            (s - k * s, s + k * s),
            (k * r, r),
            (0, r),
        ]
    )


def _sphere(name: str, material: Material, centre: ArrayLike, radius: float, segments: int = 64) -> Surface:
    """An exact sphere: a half circle of three rational spans, revolved."""
    w = math.sqrt(0.5)
    profile = [(0, -1), (1, -1), (1, 0), (1, 1), (0, 1)]
    knots = [0, 0, 0, 0.5, 0.5, 1, 1, 1]
    spline = surface_of_revolution(profile, degree=2, knots=knots, weights=[1, w, 1, w, 1])
    return _moved(_mesh(name, material, spline, segments, segments // 2), centre, scale=radius)


def _spheres(width: int, height: int) -> TestPicture:
    floor = _material("stone", (0.8, 0.78, 0.74), 0.12, 40.0)
    colours = [(0.3, 0.08, 0.07), (0.08, 0.2, 0.32), (0.28, 0.22, 0.06), (0.12, 0.26, 0.1), (0.2, 0.2, 0.22)]
    mirrors = [_material(f"mirror {i}", colour, 0.32, 200.0) for i, colour in enumerate(colours)]
    places = [(-1.7, 0.4, 1.0, 1.0), (0.6, 1.5, 1.25, 1.25), (1.9, -0.7, 0.75, 0.75), (-0.3, -1.2, 0.6, 0.6),
              (-2.7, -1.5, 0.45, 0.45), (3.4, 1.2, 0.9, 0.9), (0.9, -2.2, 0.35, 0.35)]  # fmt: skip
    wall = _material("wall", (0.42, 0.5, 0.58), 0.06, 15.0)
    surfaces = _room(floor, wall, (-9, -9, 0), (9, 9, 9.5))
    surfaces += [
        _sphere(f"sphere {i}", mirrors[i % len(mirrors)], place[:3], place[3]) for i, place in enumerate(places)
    ]
    textures: dict[str, Texture] = {"floor": Noise(0.06, (0.55, 0.5, 0.46), 1.0, 2, 3.0, seed=1)}
    lights = (
        _point("left", (-6.0, -5.0, 7.0), 1.1, (1.0, 0.95, 0.85)),
        _point("right", (5.5, -4.0, 6.0), 0.8, (0.85, 0.92, 1.0)),
        _point("behind", (0.5, 6.0, 8.0), 0.7),
    )
    scene = Scene(
        "mirror spheres", tuple(surfaces), lights, _camera((0.2, -6.6, 5.4), (0.3, 0.0, 0.45), 38.0, width, height),
        background=np.zeros(3),
    )  # fmt: skip
    return TestPicture(scene, textures, TraceOptions(falloff=False, ambient=0.1))


def _tori(width: int, height: int) -> TestPicture:
    floor = _material("slate", (0.62, 0.62, 0.66), 0.12, 30.0)
    metals = [
        _material(f"metal {i}", colour, 0.3, 90.0)
        for i, colour in enumerate([(0.6, 0.45, 0.15), (0.5, 0.2, 0.15), (0.25, 0.4, 0.5), (0.4, 0.45, 0.3)])
    ]
    wall = _material("wall", (0.45, 0.45, 0.5), 0.06, 15.0)
    surfaces = [
        *_room(floor, wall, (-9, -9, 0), (9, 9, 9)),
        _moved(_mesh("torus 0", metals[0], torus(1.0, 0.32), 96, 40), (-1.0, 0.0, 0.32)),
        _moved(_mesh("torus 1", metals[1], torus(0.9, 0.25), 96, 40), (0.1, 0.3, 1.1), turn_deg=25.0, tilt_deg=80.0),
        _moved(_mesh("torus 2", metals[2], torus(0.7, 0.24), 96, 40), (1.9, -0.5, 0.24)),
        _moved(_mesh("torus 3", metals[3], torus(0.6, 0.18), 96, 40), (1.9, -0.4, 0.8), turn_deg=-40.0, tilt_deg=65.0),
    ]
    textures: dict[str, Texture] = {
        "floor": Noise(0.07, (0.35, 0.35, 0.4), 1.0, 2, 3.0, seed=6),
        "torus 0": Checker(0.17, 1.0, 0.35, "xyz", (0.011, 0.013, 0.007)),
        "torus 2": Noise(0.09, 0.35, 1.0, 3, 3.0, seed=11),
    }
    light = Light(
        "tube", "linear", np.full(3, 30.0), position=np.array([-2.6, -2.5, 5.2]), end=np.array([-0.6, -3.0, 5.2])
    )
    scene = Scene(
        "tori", tuple(surfaces), (light,), _camera((0.4, -6.4, 3.6), (0.4, 0.1, 0.5), 34.0, width, height),
        background=np.zeros(3),
    )  # fmt: skip
    return TestPicture(scene, textures, TraceOptions(falloff=False, ambient=0.1, light_samples=8))


PICTURES: dict[str, Callable[[int, int], TestPicture]] = {
    "pots": _pots,
    "desk": _desk,
    "spheres": _spheres,
    "tori": _tori,
}
"""The pictures by name, in the order of Woo's Figures 6 to 9."""


def test_picture(name: str, width: int = 640, height: int = 480) -> TestPicture:
    """One of :data:`PICTURES`, 640 x 480 unless asked otherwise.

    Raises
    ------
    OptionError
        If there is no picture of that name.
    """
    if name not in PICTURES:
        raise OptionError(f"picture: found {name!r}, expected one of {', '.join(PICTURES)}")
    return PICTURES[name](width, height)


test_picture.__test__ = False  # type: ignore[attr-defined]
