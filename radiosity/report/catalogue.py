"""The catalogue of scenes on which techniques of light transport fail: shadows, form factors, solves and rays."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radiosity.report.catalogue_pictures import gather_entries, picture_entries
from radiosity.report.failures import STATED, Failure, contour_factor, point_irradiance, spread_of
from radiosity.rivals import open_rival
from workbench.geometry.flat import Geometry
from workbench.scene.library import box_surface, diffuse, sphere_surface, unit_cube
from workbench.scene.model import Light, Material, Scene, Surface

__all__ = ["CATALOGUE"]

FloatArray = NDArray[np.float64]


# ---- shadows at a point -----------------------------------------------------------------------------


def _square(half: float, z: float, x: float = 0.0, y: float = 0.0, down: bool = False) -> FloatArray:
    return _rectangle(x - half, x + half, y - half, y + half, z, down)


def _rectangle(x0: float, x1: float, y0: float, y1: float, z: float, down: bool = False) -> FloatArray:
    ring = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]], dtype=float)
    return ring[::-1].copy() if down else ring


LIGHT = _square(0.5, 2.0, down=True)
"""A unit square of radiance 1, two above the point."""
SHADOW_METHODS = (
    "adaptive", "auto", "camera", "camera-optimised", "exact", "rays", "rays+plane-vertex", "shaft",
)  # fmt: skip
SAMPLES = 1024


def _lit_scene(
    lights: list[FloatArray], occluders: Sequence[FloatArray | Surface], pane: float = 0.0, floor: bool = False,
    glow_both: bool = False,
) -> Scene:  # fmt: skip
    """Lights of radiance 1, black occluders (or panes of a transmittance), perhaps a floor at z = 0."""
    lamp = replace(diffuse("lamp", 0.0, math.pi), two_sided=glow_both)
    black: Material = replace(diffuse("black", 0.0), transmittance=np.array([pane]))
    surfaces = [Surface.from_polygons(f"lamp {i}", lamp, [ring]) for i, ring in enumerate(lights)]
    for i, item in enumerate(occluders):
        if isinstance(item, Surface):
            surfaces.append(item)
        else:
            surfaces.append(Surface.from_polygons(f"occluder {i}", black, [item]))
    if floor:
        surfaces.append(Surface.from_polygons("floor", diffuse("floor", 0.0), [_square(4.0, 0.0)]))
    return Scene("failure", tuple(surfaces), background=np.zeros(1), bands=1)


def _moved(scene: Scene, scale: float, shift: ArrayLike) -> Scene:
    surfaces = tuple(replace(s, vertices=s.vertices * scale + np.asarray(shift, dtype=float)) for s in scene.surfaces)
    return replace(scene, surfaces=surfaces)


def _shadow(scene: Scene, method: str, point: ArrayLike) -> tuple[float, float]:
    from workbench.shadow.lights import lights_of_scene
    from workbench.shadow.occlusion import estimate

    geometry = Geometry.from_scene(scene)
    own = scene.surfaces[-1].name == "floor"
    found = estimate(
        np.asarray(point, dtype=float)[None], [[0.0, 0.0, 1.0]], lights_of_scene(scene, geometry), geometry, method,
        error=0.002, samples=SAMPLES, seed=1, own_polygon=geometry.polygon_count - 1 if own else -1, workers=1,
    )  # fmt: skip
    return float(found.irradiance[0, 0]), float(found.standard_error[0, 0])


def _rival_shadow(scene: Scene, rival: str, point: ArrayLike) -> tuple[float, float]:
    opened = open_rival(rival, scene)
    place = np.asarray(point, dtype=float)[None]
    return spread_of(
        lambda seed: float(
            opened.irradiance(place, [[0.0, 0.0, 1.0]], samples=SAMPLES, seed=seed, direct_only=True)[0, 0]
        )
    )


def _shadows(
    name: str, group: str, about: str, scene: Scene, expected: float, *, relative_to: float | None = None,
    point: ArrayLike = (0.0, 0.0, 0.0), disclaimed: Mapping[str, str] | None = None,
) -> Failure:  # fmt: skip
    tolerance = 0.005 * (expected if relative_to is None else relative_to)
    techniques = {method: partial(_shadow, scene, method, point) for method in SHADOW_METHODS}
    techniques |= {rival: partial(_rival_shadow, scene, rival, point) for rival in ("mitsuba", "radiance", "trimesh")}
    return Failure(name, group, about, expected, tolerance, techniques, disclaimed or {})


def _lined(scene: Scene, first: ArrayLike, second: ArrayLike) -> Scene:
    """The scene with an isotropic linear light of radiant intensity 1 a length."""
    line = Light("line", "linear", np.ones(1), position=np.asarray(first, float), end=np.asarray(second, float))
    return replace(scene, lights=(line,))


def _line_irradiance(ends: Sequence[float], height: float) -> float:
    """Irradiance straight below a line along x at that height: the integral of h dx / (x^2 + h^2)^(3/2)."""
    first, second = (x / (height * math.hypot(x, height)) for x in ends)
    return second - first


def _shadow_entries() -> list[Failure]:
    whole = point_irradiance(LIGHT)
    half = point_irradiance(_rectangle(0.0, 0.5, -0.5, 0.5, 2.0))
    ell = np.array([[-1, -1, 2], [-1, 1, 2], [0, 1, 2], [0, 0, 2], [1, 0, 2], [1, -1, 2.0]])
    slats = [_rectangle(x, x + 0.5 / 32, -1, 1, 1.0) for x in np.arange(16) / 32 - 0.25]
    seen = sum(point_irradiance(_rectangle(x, x + 1 / 32, -0.5, 0.5, 2.0)) for x in np.arange(16) / 16 - 0.5 + 1 / 32)
    upright = np.array([[1, 0.5, 1], [1, 0.5, -1], [1, -0.5, -1], [1, -0.5, 1.0]])
    side = np.array([[0.2, -0.1, 0.8], [0.3, -0.1, 1.2], [0.3, 0.1, 1.2], [0.2, 0.1, 0.8]])
    glow = np.array([[1e-4, 1, 0], [1e-4, 1, 2], [1e-4, -1, 2], [1e-4, -1, 0.0]])[::-1].copy()
    box = box_surface("box", diffuse("box", 0.0), [-0.3, -0.3, 0.0], [0.3, 0.3, 0.6], omit=["-z"])
    triangles = [np.array(t, dtype=float) for t in (
        [[-0.4, -0.4, 1], [0.4, -0.4, 1], [0.4, 0.4, 1]], [[-0.4, -0.4, 1], [0.4, 0.4, 1], [-0.4, 0.4, 1]],
    )]  # fmt: skip
    low = 1e-6
    # d^2 times the integral of r^-4 over x in 1..2, |y| < 1/2, by the midpoint rule on 400 x 400 cells (to 1e-6).
    x, y = np.meshgrid(1 + (np.arange(400) + 0.5) / 400, (np.arange(400) + 0.5) / 400 - 0.5)
    grazing = low**2 * float(((x * x + y * y) ** -2).mean())
    gap = _rectangle(0.0, 0.02, -0.5, 0.5, 2.0)
    sliver = _rectangle(0.0, 2.0**-13, -0.5, 0.5, 2.0, down=True)
    plain = _lit_scene([LIGHT], [_square(0.1, 1.0, 3.0)])
    hidden = point_irradiance(_square(0.1, 2.0, 0.2, 0.14))
    strip = point_irradiance(_rectangle(0.22, 0.24, -0.5, 0.5, 2.0))
    tilted = np.array([[0, 0, 0], [1, 0, 1], [1, 1, 1], [0, 1, 0.0]])[::-1].copy()  # seen from within its plane
    # Walls of a box in unequal parts, so that corners of one lie inside edges of the next.
    patched = [np.array([a, b, [*b[:2], 0.6], [*a[:2], 0.6]]) for a, b in (
        ([-0.3, -0.3, 0], [0.1, -0.3, 0]), ([0.1, -0.3, 0], [0.3, -0.3, 0]), ([0.3, -0.3, 0], [0.3, 0.3, 0]),
        ([0.3, 0.3, 0], [-0.3, 0.3, 0]), ([-0.3, 0.3, 0], [-0.3, -0.3, 0.0]),
    )]  # fmt: skip
    patched += [_rectangle(-0.3, 0.3, low_y, high_y, 0.6) for low_y, high_y in ((-0.3, -0.13), (-0.13, 0.3))]
    entries = [
        _shadows("wall inside the pyramid", "grazing pyramids", "planes with the wrong side up cull what blocks",
                 _lit_scene([LIGHT], [_square(0.6, 1.0)]), 0.0, relative_to=whole),
        _shadows("behind and beyond", "grazing pyramids", "planes have no ends: kept must not mean blocked",
                 _lit_scene([LIGHT], [_square(2.0, -0.5), _square(2.0, 2.5)]), whole),
        _shadows("past a corner", "grazing pyramids", "outside the pyramid, yet outside no single plane of it",
                 _lit_scene([LIGHT], [np.array([[0.6, -0.08, 1], [0.6, 0.6, 1], [-0.08, 0.6, 1.0]])]), whole),
        _shadows("in a side of the pyramid", "grazing pyramids", "a polygon in a plane of the pyramid hides nothing",
                 _lit_scene([LIGHT], [side]), whole),
        _shadows("in the light's plane", "grazing pyramids", "a flat pyramid: zero planes, not a number",
                 _lit_scene([_rectangle(1, 2, -0.5, 0.5, 0.0)], [_square(0.1, 1.0, 3.0)]), 0.0, relative_to=whole),
        _shadows("a millionth below the light's plane", "grazing pyramids", "almost flat: cosines of 1e-6 at both ends",
                 _lit_scene([_rectangle(1, 2, -0.5, 0.5, low, down=True)], [_square(0.1, 1.0, 3.0)]), grazing),
        _shadows("light across the horizon", "grazing pyramids", "what lies below the horizon gives nothing",
                 _lit_scene([upright], [_square(0.1, 1.0, 3.0)]),
                 point_irradiance(np.array([[1, -0.5, 1], [1, -0.5, 0], [1, 0.5, 0], [1, 0.5, 1.0]]))),
        _shadows("a step from a glowing wall", "touching patches", "samples of the wall blow up as 1 / d^2: 1e-4 away",
                 _lit_scene([glow], [_square(0.1, 1.0, -3.0)]), point_irradiance(glow)),
        _shadows("concave light, one arm hidden", "concave lights", "planes through inner edges cut off its own arm",
                 _lit_scene([ell], [_rectangle(-0.5, 0, 0, 0.5, 1.0)]),
                 point_irradiance(_rectangle(-1, 1, -1, 0, 2.0))),
        _shadows("two lights, one hidden", "mailboxes", "a polygon culled for one light is skipped for the next",
                 _lit_scene([_square(0.3, 2.0, -1.5, down=True), _square(0.3, 2.0, 1.5, down=True)],
                            [_square(0.4, 1.0, 0.75)]),
                 point_irradiance(_square(0.3, 2.0, -1.5))),
        _shadows("coincident occluders", "union, not product", "two halves that are the same leave a half, no quarter",
                 _lit_scene([LIGHT], [_rectangle(-1, 0, -1, 1, 1.0), _rectangle(-1, 0, -1, 1, 1.0)]), half),
        _shadows("one occluder behind another", "union, not product", "pictures that count fragments count both",
                 _lit_scene([LIGHT], [_rectangle(-1, 0, -1, 1, 1.0), _rectangle(-1, -0.1, -1, 1, 1.2)]), half),
        _shadows("three panes", "union, not product", "what passes multiplies: (1/2)^3",
                 _lit_scene([LIGHT], [_square(2, z) for z in (0.5, 1.0, 1.5)], pane=0.5), whole / 8),
        _shadows("shared edge", "leaks", "rays along the edge of two triangles slip through or count twice",
                 _lit_scene([LIGHT], triangles), 0.0, relative_to=whole),
        _shadows("closed box", "leaks", "no light enters a closed box",
                 _lit_scene([LIGHT], [box], floor=True), 0.0, relative_to=whole),
        _shadows("contact shadow", "leaks", "an offset larger than the gap of 1e-5 jumps over the occluder",
                 _lit_scene([LIGHT], [_square(0.5, 1e-5)], floor=True), 0.0, relative_to=whole),
        _shadows("occluder before the eye", "aliasing cameras", "a near plane that cuts it off",
                 _lit_scene([LIGHT], [_square(1e-3, 1e-4)]), 0.0, relative_to=whole),
        _shadows("fence", "aliasing cameras", "slats as wide as a pixel: all or nothing",
                 _lit_scene([LIGHT], slats), seen,
                 disclaimed={"adaptive": "corners that agree are believed, so small shadows are missed"}),
        _shadows("equal areas, unequal light", "aliasing cameras", "half the pixels are not half the light",
                 _lit_scene([_rectangle(0, 1, -0.5, 0.5, 0.5, down=True)], [_rectangle(0.25, 0.5, -0.25, 0.25, 0.25)]),
                 point_irradiance(_rectangle(0, 0.5, -0.5, 0.5, 0.5))),
        _shadows("lit gap", "missed small shadows", "corners in two shadows, a gap of a fiftieth between them",
                 _lit_scene([LIGHT], [_rectangle(-1, 0, -1, 1, 1.0), _rectangle(0.01, 1, -1, 1, 1.0)]),
                 point_irradiance(gap)),
        _shadows("small shadow", "missed small shadows", "a twenty-fifth of the light hidden between the first samples",
                 _lit_scene([LIGHT], [_square(0.05, 1.0, 0.1, 0.07)]), whole - hidden, relative_to=hidden),
        _shadows("a light wound the other way", "grazing pyramids", "every plane's normal turns round with the light",
                 _lit_scene([LIGHT[::-1]], [_square(0.6, 1.0)], glow_both=True), 0.0, relative_to=whole),
        _shadows("a millionth from a glowing wall", "touching patches", "planes through the point and an edge are one",
                 _lit_scene([np.array([[0.5, 1, 0], [0.5, 1, 2], [0.5, -1, 2], [0.5, -1, 0.0]])[::-1]], []),
                 point_irradiance(np.array([[1e-6, 1, 0], [1e-6, 1, 2], [1e-6, -1, 2], [1e-6, -1, 0.0]])),
                 point=(0.5 - 1e-6, 0.0, 0.0)),
        _shadows("behind the light", "grazing pyramids", "the back of a light is black",
                 _lit_scene([LIGHT[::-1]], [_square(0.1, 1.0, 3.0)]), 0.0, relative_to=whole),
        _shadows("a line through the point", "grazing pyramids", "the point and a linear light span no plane",
                 _lined(_lit_scene([], [_square(0.5, 0.5)]), [0, 0, 1], [0, 0, 2]), 0.0, relative_to=0.5),
        _shadows("half a line hidden", "grazing pyramids", "equal weights along a line: 12 % off where it ends",
                 _lined(_lit_scene([], [_rectangle(0, 9, -1, 1, 1.0)]), [-0.5, 0, 2], [1.5, 0, 2]),
                 _line_irradiance((-0.5, 0.0), 2.0)),
        _shadows("complementary halves", "union, not product", "two halves that leave nothing, no quarter",
                 _lit_scene([LIGHT], [_rectangle(-1, 0, -1, 1, 1.0), _rectangle(0, 1, -1, 1, 1.2)]), 0.0,
                 relative_to=whole),
        _shadows("crossed halves", "union, not product", "a quarter of the light is left",
                 _lit_scene([LIGHT], [_rectangle(-1, 0, -1, 1, 1.0), _rectangle(-1, 1, -1, 0, 1.0)]),
                 point_irradiance(_rectangle(0, 0.5, 0, 0.5, 2.0))),
        _shadows("ten panes", "union, not product", "what passes multiplies: 0.9^10",
                 _lit_scene([LIGHT], [_square(2, z) for z in np.linspace(0.2, 1.8, 10)], pane=0.9), whole * 0.9**10),
        _shadows("a folded pane", "mailboxes", "one surface met twice: tested once hides its second crossing",
                 _lit_scene([LIGHT], [Surface.from_polygons("fold", replace(
                     diffuse("pane", 0.0), transmittance=np.array([0.5])), [_square(2, 0.9), _square(2, 1.1)])]),
                 whole / 4),
        _shadows("a lamp in its housing", "aliasing cameras", "a far plane at the light draws the housing, too",
                 _lit_scene([LIGHT], [box_surface("housing", diffuse("black", 0.0), [-0.51, -0.51, 2.0],
                                                  [0.51, 0.51, 2.2], omit=["-z"])]), whole),
        _shadows("a triangular light", "aliasing cameras", "a picture of its bounding rectangle counts twice its area",
                 _lit_scene([LIGHT[:3]], [_rectangle(-1, 0, -1, 1, 1.0)]),
                 point_irradiance(np.array([[0, 0.5, 2], [0.5, 0.5, 2], [0.5, -0.5, 2], [0, 0, 2.0]]))),
        _shadows("a strip on a line", "missed small shadows", "ends and middle agree that nothing is in the way",
                 _lined(_lit_scene([], [_rectangle(-0.2, -0.05, -1, 1, 1.0)]), [-0.5, 0, 2], [0.5, 0, 2]),
                 _line_irradiance((-0.5, 0.5), 2.0) - _line_irradiance((-0.4, -0.1), 2.0)),
        _shadows("a strip narrower than a pixel", "missed small shadows", "a fiftieth of the light hidden by a strip",
                 _lit_scene([LIGHT], [_rectangle(0.11, 0.12, -1, 1, 1.0)]), whole - strip, relative_to=strip),
        _shadows("a pane of two triangles", "leaks", "rays along the edge that they share pass none, or both",
                 _lit_scene([LIGHT], [Surface.from_polygons("pane", replace(
                     diffuse("pane", 0.0), transmittance=np.array([0.5])), [t * [2, 2, 1] for t in triangles])]),
                 whole / 2),
        _shadows("a closed box with T-junctions", "leaks", "cracks where edges of walls do not match",
                 _lit_scene([LIGHT], patched, floor=True), 0.0, relative_to=whole),
        _shadows("in a corner of the light", "grazing pyramids", "planes through the point and two edges vanish",
                 _lit_scene([tilted], [_square(0.1, 1.0, -3.0)]), 0.0, relative_to=whole),
        _shadows("sliver light", "slivers", "a light 2^-13 wide: areas and normals near rounding",
                 _lit_scene([sliver], [_square(0.1, 1.0, 3.0)]), point_irradiance(sliver)),
    ]  # fmt: skip
    for name, scale, shift in (
        ("moved by 1e5", 1.0, [1e5, -1e5, 1e5]), ("moved by 1e6", 1.0, [1e6, 1e6, -1e6]),
        ("scaled by 1e-6", 1e-6, [0, 0, 0]), ("scaled by 1e6", 1e6, [0, 0, 0]),
    ):  # fmt: skip
        about = "float32 is 1/16 coarse at 1e6" if scale == 1.0 else "offsets that are lengths, not shares"
        group = "float32 far from the origin"
        blocked = _lit_scene([LIGHT], [_rectangle(-1, 0, -1, 1, 1.0)])
        entries.append(
            _shadows(name, group, about, _moved(blocked, scale, shift), half, point=np.asarray(shift, float))
        )
        if name == "moved by 1e6":
            in_line = _lined(_moved(_lit_scene([], [_square(0.5, 0.5)]), 1.0, shift), *(
                np.asarray(shift) + [0, 0, z] for z in (1.0, 2.0)
            ))  # fmt: skip
            entries.append(
                _shadows("a line through the point, moved by 1e6", group, "the noise of 1e6 makes a plane of none",
                         in_line, 0.0, relative_to=0.5, point=np.asarray(shift, float))
            )  # fmt: skip
        if name == "moved by 1e5":
            entries.append(
                _shadows("nothing in the way, moved by 1e5", group, "a surface that shadows itself",
                         _moved(plain, scale, shift), whole, point=np.asarray(shift, float))
            )  # fmt: skip
    return entries


# ---- form factors ----------------------------------------------------------------------------------


FACTOR_TECHNIQUES = ("view factors", "bundle", "bundle to 1e-6", "hemicube", "hemisphere rays")
FEW_POLYGONS = 8
"""Scenes of more are asked only of what finds the one form factor that is judged, not all pairs."""
NO_HIT = 7.0
"""n rays without a hit say that F is below this / n; of a thousand such words one is wrong, exp(-7)."""
OPPOSITE = 0.19982489569838746
"""Unit squares opposite each other at distance 1 (Howell C-11)."""


def _factor(scene: Scene, technique: str) -> tuple[float, float]:
    """F from the first polygon to the second, and its stated error."""
    from radiosity.form_factors.bundle import ReceiverBundles
    from radiosity.form_factors.matrix import view_factors
    from radiosity.patches import build_mesh
    from radiosity.report.techniques import problem_for
    from radiosity.solvers.solve import _settings

    if technique.startswith("view factors"):
        error = float(technique.split(" to ")[1]) if " to " in technique else 0.001
        found = view_factors(scene, error=error, workers=1, seed=1)
        order = np.argsort(build_mesh(scene, Geometry.from_scene(scene), split=1, cluster=False).element_polygon)
        doubt = found.standard_error
        spread = doubt if isinstance(doubt, np.ndarray) else doubt.toarray()
        return float(found.dense()[order[0], order[1]]), float(spread[order[0], order[1]])
    if technique.startswith("bundle"):
        geometry = Geometry.from_scene(scene)
        mesh = build_mesh(scene, geometry, split=1, cluster=False)
        error = 1e-6 if technique.endswith("1e-6") else 0.01
        bundles = ReceiverBundles(geometry, mesh, _settings(error, 16, 1, mesh.patch_count), 1)
        try:
            columns = bundles.columns(np.array([int(np.argmax(mesh.patch_polygon == 1))]))
        finally:
            bundles.close()
        row = int(np.argmax(mesh.element_polygon == 0))
        return float(columns.factor[0, row]), float(columns.spread[0, row]) + error * abs(float(columns.factor[0, row]))
    ask = problem_for("viewfactors", scene, workers=1).technique("hemicube" if technique == "hemicube" else "rays").ask
    count = 64 if technique == "hemicube" else 16384
    runs = [float(ask(count, seed).values[0, 1]) for seed in range(4)]
    # A hemicube's pixels are this coarse.
    least = 5.1e-4 if technique == "hemicube" else NO_HIT / (4 * count) / STATED
    return float(np.mean(runs)), float(np.std(runs, ddof=1)) / 2.0 + least


def _rival_factor(scene: Scene, rival: str) -> tuple[float, float]:
    opened = open_rival(rival, scene)
    if rival == "pyviewfactor":  # has no chance in it; its user would compare two numbers of elements
        fine, coarse = (float(opened.view_factors(samples=n)[0, 1]) for n in (64, 16))
        return fine, abs(fine - coarse) / STATED
    value, doubt = spread_of(lambda seed: float(opened.view_factors(samples=16384, seed=seed)[0, 1]))
    return value, doubt + NO_HIT / (4 * 16384) / STATED


def _pair(
    name: str, group: str, about: str, rings: list[FloatArray], expected: float, share: float = 0.01,
    own: Sequence[str] | None = None,
) -> Failure:  # fmt: skip
    surfaces = tuple(Surface.from_polygons(f"s{i}", diffuse("s", 0.5), [ring]) for i, ring in enumerate(rings))
    scene = replace(unit_cube(0.5, 1.0), surfaces=surfaces, closed=False)
    few = len(rings) <= FEW_POLYGONS
    chosen = own if own is not None else FACTOR_TECHNIQUES if few else FACTOR_TECHNIQUES[:3]
    techniques = {technique: partial(_factor, scene, technique) for technique in chosen}
    if few:
        techniques |= {rival: partial(_rival_factor, scene, rival) for rival in ("pyviewfactor", "trimesh")}
    return Failure(name, group, about, expected, share * expected if expected else 1e-12, techniques)


def _factor_entries() -> list[Failure]:
    floor = _square(0.5, 0.0, 0.5, 0.5)
    ceiling = _square(0.5, 1.0, 0.5, 0.5, down=True)

    def hinged(degrees: float, lift: float = 0.0) -> FloatArray:
        a = math.radians(degrees)
        ring = np.array([[0, 0, 0], [0, 1, 0], [math.cos(a), 1, math.sin(a)], [math.cos(a), 0, math.sin(a)]])
        return ring + [0.0, 0.0, lift]

    far = _square(0.5, 1e4, 0.5, 0.5, down=True)
    sliver = _rectangle(0.0, 2.0**-13, 0.0, 1.0, 0.0)
    beside = np.array([[2, 0, -1], [2, 1, -1], [2, 1, 1], [2, 0, 1.0]])[::-1].copy()
    seen = np.array([[2, 0, 0], [2, 1, 0], [2, 1, 1], [2, 0, 1.0]])
    wall = _rectangle(-9, 0.5, -9, 9, 0.5)
    half_floor, half_wall = floor * [1, 0.5, 1], hinged(90.0) * [1, 0.5, 1]
    low, high = 0.495, 0.505
    hole = [_rectangle(-9, low, -9, 9, 0.5), _rectangle(high, 9, -9, 9, 0.5), _rectangle(low, high, -9, low, 0.5),
            _rectangle(low, high, high, 9, 0.5)]  # fmt: skip
    across = np.array([[-1, 0.5, -1], [2, 0.5, -1], [2, 0.5, 2], [-1, 0.5, 2.0]])
    turn = np.array([[0.5, -math.sqrt(0.5), 0.5], [0.5, math.sqrt(0.5), 0.5], [-math.sqrt(0.5), 0, math.sqrt(0.5)]])
    # Exact numbers of occluded pairs: the integrals of Lambert's formula over what is visible, piece by piece.
    entries = [
        _pair("touching squares", "touching patches", "the kernel is singular along the edge they share",
              [floor, hinged(90.0)], contour_factor(floor, hinged(90.0))),
        _pair("one-degree wedge", "touching patches", "centre to centre gives thousands where the most is 1",
              [floor, hinged(1.0)], contour_factor(floor, hinged(1.0))),
        _pair("gap of a millionth", "touching patches", "nearly touching is nearly singular",
              [floor, hinged(90.0, 1e-6)], contour_factor(floor, hinged(90.0, 1e-6))),
        _pair("ten thousand apart", "slivers", "closed forms subtract large numbers: 1 / (pi 1e8)",
              [floor, far], 1.0 / (math.pi * 1e8)),
        _pair("sliver and square", "slivers", "a polygon 2^-13 wide sees a square",
              [sliver, ceiling], contour_factor(sliver, ceiling)),
        _pair("across the horizon", "grazing pyramids", "what lies below the horizon counts as negative",
              [floor, beside], contour_factor(floor, seen)),
        _pair("in one plane", "grazing pyramids", "squares in one plane see nothing of each other",
              [floor, _square(0.5, 0.0, 2.5, 0.5)], 0.0),
        _pair("half a wall between", "missed small shadows", "one ray decides for all: all or nothing",
              [floor, ceiling, wall], OPPOSITE / 2),
        _pair("a square just past the plane from the middle", "grazing pyramids",
              "outside the pyramid from the patch's centre, yet in the way of its corner",
              [floor, ceiling, _rectangle(0.875, 1.0, 0.875, 1.0, 0.125)], 0.198741982196586, 0.001),
        _pair("touching squares and a wall across", "touching patches", "the shaft of two boxes that touch is empty",
              [floor, hinged(90.0), across],
              contour_factor(half_floor, half_wall)),
        _pair("a neighbour in the same plane", "touching patches", "a patch's own plane hides it",
              [floor, ceiling, _square(0.5, 0.0, 1.5, 0.5), _square(0.5, 1.0, 1.5, 0.5, down=True)], OPPOSITE),
        _pair("a square between two squares", "missed small shadows", "one segment between the centres: all or nothing",
              [floor, ceiling, _square(0.125, 0.5, 0.5, 0.5)], 0.169474204911786),
        _pair("121 squares between", "missed small shadows", "one candidate that the shaft loses",
              [floor, ceiling, *(_square(0.05, 0.5, 0.5 + i / 4, 0.5 + j / 4) for i in range(-5, 6)
                                 for j in range(-5, 6))], 0.169046528770529),
        _pair("a rim of a twentieth", "missed small shadows", "a sliver left visible that no point of a rule sees",
              [floor, ceiling, _square(0.45, 0.5, 0.5, 0.5)], 0.004953310017505),
        _pair("a rim of an eighth", "missed small shadows", "whole polygons that see each other past a wide rim alone",
              [floor, ceiling, _square(0.375, 0.5, 0.5, 0.5)], 0.029483544914760,
              own=(*FACTOR_TECHNIQUES, "view factors to 0.01")),
        _pair("squares turned by 45 degrees", "missed small shadows", "a shaft of boxes far wider than what they hold",
              [ring @ turn.T for ring in (floor, ceiling, _square(0.125, 0.5, 0.5, 0.5))], 0.169474204911786),
        _pair("through a hole of a hundredth", "missed small shadows", "the only way is a hole in a wall",
              [floor, ceiling, *hole], 5.51668991e-5),
        _pair("smaller than a pixel", "aliasing cameras", "a hemicube's pixel is 16 times as large",
              [_square(1e-4, 0.0), _square(0.005, 1.0, down=True)],
              contour_factor(_square(1e-4, 0.0), _square(0.005, 1.0, down=True))),
        _pair("a whole wall between", "leaks", "a wall that contains both ends of the shaft",
              [floor, ceiling, _square(9.0, 0.5)], 0.0),
    ]  # fmt: skip
    # Of wedges with a wall across, half sees half.
    half = np.array([1.0, 0.5, 1.0])
    entries += [
        _pair(f"a wall across a wedge of {degrees} degree{'s' * (degrees > 1)}", "touching patches",
              "all light passes near the hinge, where a rule has few points: to 1e-4",
              [floor, hinged(degrees), across], contour_factor(floor * half, hinged(degrees) * half), 1e-4,
              own=("view factors", "view factors to 0.0001", "bundle", "bundle to 1e-6", "hemisphere rays"))
        for degrees in (1, 2, 5)
    ]  # fmt: skip
    return entries


def _row(scene: Scene, technique: str, columns: Sequence[int] | None, row: int = 0) -> tuple[float, float]:
    """The sum of a row of form factors over some columns (all: ``None``) in the scene's order, and its stated error."""
    from radiosity.form_factors.matrix import view_factors
    from radiosity.patches import build_mesh
    from radiosity.report.techniques import problem_for

    if technique == "view factors":
        found = view_factors(scene, error=0.001, workers=1, seed=1)
        order = np.argsort(build_mesh(scene, Geometry.from_scene(scene), split=1, cluster=False).element_polygon)
        values = found.dense()[np.ix_(order, order)][row]
        doubt = found.standard_error
        spread = (doubt if isinstance(doubt, np.ndarray) else doubt.toarray())[np.ix_(order, order)][row]
    else:
        ask = problem_for("viewfactors", scene, workers=1).technique(technique).ask
        count = {"bundle": 0.01, "hemicube": 64, "rays": 16384}[technique]
        runs = np.stack([ask(count, seed).values[row] for seed in range(4)])
        values, spread = runs.mean(axis=0), runs.std(axis=0, ddof=1) / 2.0
        if technique == "bundle":  # says its error by its setting
            spread = np.full_like(values, 0.01 * values.max())
    chosen = slice(None) if columns is None else list(columns)
    return float(values[chosen].sum()), float(np.sqrt((spread[chosen] ** 2).sum()))


def _enclosed(
    name: str, group: str, about: str, scene: Scene, columns: Sequence[int] | None, expected: float, row: int = 0
) -> Failure:
    techniques: dict[str, Callable[[], tuple[float, float]]] = {
        technique: partial(_row, scene, technique, columns, row)
        for technique in ("view factors", "bundle", "hemicube", "rays")
    }
    # The name under which these rays stand elsewhere in the catalogue.
    techniques["hemisphere rays"] = techniques.pop("rays")
    return Failure(name, group, about, expected, 0.01 * max(expected, 0.1), techniques)


def _enclosure_entries() -> list[Failure]:
    cube = unit_cube(0.5, 1.0)
    # An L of unit squares: floor, ceiling and six walls; walls round the inner corner hide one another.
    plan = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2.0]])
    walls = [
        np.array([[*a, 0], [*a, 1], [*b, 1], [*b, 0.0]]) for a, b in zip(plan, np.roll(plan, -1, axis=0), strict=True)
    ]
    floors = [np.column_stack([plan, np.zeros(6)]), np.column_stack([plan, np.ones(6)])[::-1]]
    room = tuple(Surface.from_polygons(f"s{i}", diffuse("s", 0.5), [ring]) for i, ring in enumerate([*walls, *floors]))
    ell = replace(cube, surfaces=room)
    tip = 0.4 * np.vstack([np.eye(3), -np.eye(3)]) + 0.5
    faces = [tip[[a, b, c]] for a in (0, 3) for b in (1, 4) for c in (2, 5)]
    faces = [f if np.cross(f[1] - f[0], f[2] - f[0]) @ (f.mean(axis=0) - 0.5) > 0 else f[::-1] for f in faces]
    body = Surface.from_polygons("body", diffuse("body", 0.5), faces)
    octahedron = replace(cube, surfaces=(*cube.surfaces, body))
    area = 4.0 * math.sqrt(3.0) * 0.4**2
    return [
        _enclosed("a row of a cube", "reflectance near 1", "a hemicube's shares must sum to 1", cube, None, 1.0),
        _enclosed("a row of an L", "leaks", "rows above 1 where a room hides part of itself", ell, None, 1.0),
        _enclosed("round the corner of an L", "leaks", "walls that a corner hides from each other", ell, [4], 0.0, 1),
        # By symmetry a sixth of what leaves the body arrives at each face: F = A_body / (6 A_face).
        _enclosed("a body in a box", "touching patches", "what a face loses to a body with edges toward it",
                  octahedron, range(6, 14), area / 6.0),
    ]  # fmt: skip


# ---- solves -----------------------------------------------------------------------------------------


SOLVERS = ("matrix", "progressive", "directional", "hierarchical", "direct")


def _solve(scene: Scene, method: str, read: Callable[[Any], float], options: dict[str, Any]) -> tuple[float, float]:
    from radiosity.solvers.solve import solve

    if method == "directional":
        method, options = "progressive", options | {"bundles": "directional", "rays": 256}
    solution = solve(scene, method=method, seed=1, **options)
    stated = [v for k, v in solution.record.errors.items() if isinstance(v, float) and ("bound" in k or "rms" in k)]
    value = read(solution)
    return value, float(np.sqrt(np.square(stated).sum())) * abs(value)


def _solved(
    name: str, about: str, scene: Scene, expected: float, read: Callable[[Any], float], share: float = 0.01,
    group: str = "reflectance near 1", solvers: Sequence[str] = SOLVERS,
    disclaimed: Mapping[str, str] | None = None, **options: Any,
) -> Failure:  # fmt: skip
    techniques = {method: partial(_solve, scene, method, read, options) for method in solvers}
    return Failure(name, group, about, expected, share * max(abs(expected), 1e-12), techniques, disclaimed or {})


def _mean_radiosity(solution: Any) -> float:
    area = solution.mesh.element_area
    return float(area @ solution.radiosity[:, 0] / area.sum())


def _absorbed_share(solution: Any) -> float:
    return float(solution.book.absorbed[0] / solution.book.emitted[0])


def _solve_entries() -> list[Failure]:
    lamp = replace(unit_cube(0.5, 0.0).surfaces[5], material=diffuse("lamp", 0.0, 1.0))
    room = replace(unit_cube(0.5, 0.0), surfaces=(*unit_cube(0.5, 0.0).surfaces[:5], lamp))
    inside = box_surface("inside", diffuse("inside", 0.5, 1.0), [0, 0, 0], [1, 1, 1], inward=True)
    outside = box_surface("outside", diffuse("outside", 0.5), [-2, -2, -2], [3, 3, 3], inward=True)
    leak = Scene("box in a box", (inside, outside), background=np.zeros(1), bands=1, closed=True)

    def outer(solution: Any) -> float:
        return float(np.abs(solution.element_irradiance[solution.mesh.element_surface == 1]).max())

    across = contour_factor(_square(0.5, 0.0), _square(0.5, 1.0, down=True))
    beside = (1.0 - across) / 4.0
    # One element a face: the sides and the face across from the emitter see it, each other and nothing else:
    # s = rho (beside + (across + 2 beside) s + beside t), t = rho (across + 4 beside s).
    system = np.array([[1.0 - 0.5 * (across + 2.0 * beside), -0.5 * beside], [-2.0 * beside, 1.0]])
    opposite = float(np.linalg.solve(system, 0.5 * np.array([beside, across]))[1])

    def far(solution: Any) -> float:
        walls = Geometry.from_scene(room)
        corner = walls.corners[walls.piece_start[walls.polygon_piece_start[5]]]
        away = np.abs((solution.mesh.element_centroid - corner) @ walls.polygon_normal[5])
        area = solution.mesh.element_area * (away > 1.0 - 1e-6)
        return float(area @ solution.radiosity[:, 0] / area.sum())

    plates = (_square(0.5, 0.0), _square(0.5, 1.0, down=True))
    facing = replace(unit_cube(0.5, 1.0), closed=False, surfaces=tuple(
        Surface.from_polygons(f"plate {i}", diffuse("plate", 0.5, 1.0), [ring]) for i, ring in enumerate(plates)
    ))  # fmt: skip
    dim = box_surface("room", diffuse("room", 0.5, 1e-3), [0, 0, 0], [1, 1, 1], inward=True)
    bright = box_surface("yard", diffuse("yard", 0.5, 1.0), [-20, -20, -20], [21, 21, 21], inward=True)
    yard = Scene("yard", (dim, bright), background=np.zeros(1), bands=1, closed=True)

    def room_radiosity(solution: Any) -> float:
        inner = solution.mesh.element_surface == 0
        area = solution.mesh.element_area * inner
        return float(area @ solution.radiosity[:, 0] / area.sum())

    ball = sphere_surface("ball", diffuse("ball", 0.5, 1.0), [0.0, 0.0, 0.0], 1.0, facet_error=0.1, inward=True)
    sphere = replace(unit_cube(0.5, 1.0), surfaces=(ball,))
    return [
        _solved("one element a face", "errors of the mesh taken for errors of the solver", room, opposite, far,
                0.005, group="touching patches", max_edge=1.0,
                solvers=[solver for solver in SOLVERS if solver != "hierarchical"]),  # which makes elements of its own
        _solved("furnace of 0.999", "stopping at the last change leaves most of the light: e / (1 - rho) = 1000",
                unit_cube(0.999, 1.0), 1000.0, _mean_radiosity, elements=96),
        _solved("furnace in a sphere", "what facets of one surface send each other is left out",
                sphere, 2.0, _mean_radiosity, group="touching patches", elements=64),
        _solved("furnace of 0.5", "rows of form factors that do not sum to 1: e / (1 - rho) = 2",
                unit_cube(0.5, 1.0), 2.0, _mean_radiosity, elements=96),
        _solved("furnace moved by 1e5", "the same in float32", _moved(unit_cube(0.5, 1.0), 1.0, [1e5, 1e5, -1e5]), 2.0,
                _mean_radiosity, group="float32 far from the origin", elements=96),
        _solved("black walls", "nothing is reflected, so B is what is emitted, once", unit_cube(0.0, 1.0), 1.0,
                _mean_radiosity, 1e-6, elements=24),
        _solved("all that is emitted is absorbed", "power made or lost on the way", room, 1.0, _absorbed_share,
                elements=96),
        _solved("an open scene", "rows of an open scene made to sum to 1: light is invented", facing,
                1.0 / (1.0 - 0.5 * OPPOSITE), _mean_radiosity, 0.001, max_edge=1.0,
                solvers=[solver for solver in SOLVERS if solver != "hierarchical"]),
        _solved("a dim room on a bright yard", "the solve ends by the light of all while the room is still dark: 2e-3",
                yard, 2e-3, room_radiosity, 0.02, elements=200, disclaimed=dict.fromkeys(
                    ("progressive", "directional"), "the tolerance of shooting is a share of all light, wherever it is"
                )),
        _solved("box in a box", "light that leaves a closed box", leak, 0.0, outer, group="leaks", elements=96),
        _solved("reflectance 1 everywhere", "a closed scene that absorbs nothing has no answer", unit_cube(1.0, 1.0),
                math.inf, _mean_radiosity, elements=24),
    ]  # fmt: skip


# ---- rays -------------------------------------------------------------------------------------------


TRACERS = ("brute", "voxel", "embree")


def _hit(scene: Scene, technique: str, origin: ArrayLike, direction: ArrayLike) -> tuple[float, float]:
    from workbench.accel.brute import BruteForce
    from workbench.accel.embree import EmbreeAccelerator
    from workbench.accel.voxel_grid import VoxelGrid

    geometry = Geometry.from_scene(scene)
    makers: dict[str, Callable[..., Any]] = {
        "brute": BruteForce, "voxel": partial(VoxelGrid, resolution=8), "embree": EmbreeAccelerator,
    }  # fmt: skip
    tracer = makers[technique](geometry)
    return float(tracer.closest_hit([origin], [direction]).t[0]), 0.0


def _threads(method: str) -> tuple[float, float]:
    """The largest difference between the answers of one thread and of four."""
    from workbench.shadow.lights import lights_of_scene
    from workbench.shadow.occlusion import estimate

    scene = _lit_scene([LIGHT], [_square(0.2, 1.0, x, y) for x in (-0.3, 0.3) for y in (-0.3, 0.3)])
    geometry = Geometry.from_scene(scene)
    points = np.stack([*np.meshgrid(np.linspace(-1, 1, 24), np.linspace(-1, 1, 24)), np.zeros((24, 24))], axis=-1)
    found = [
        estimate(
            points.reshape(-1, 3), [0.0, 0.0, 1.0], lights_of_scene(scene, geometry), geometry, method, error=0.01,
            samples=64, seed=1, workers=workers,
        ).irradiance for workers in (1, 4)
    ]  # fmt: skip
    return float(np.abs(found[0] - found[1]).max()), 0.0


def _skinny(technique: str) -> tuple[float, float]:
    """The largest distance of a hit from its triangle, in sizes of it; 0 beside it and 1e-4 deep as floats go."""
    rng = np.random.default_rng(45)
    worst = 0.0
    for _ in range(100):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        width = 2.0 ** -rng.integers(8, 14)
        corners = np.array([[0, 0, 0], [1, 0, 0], [rng.uniform(0.2, 0.8), width, 0]])
        along = np.array([1.0, rng.uniform(-2, 2) * width, 10.0 ** rng.uniform(-5, -2)])
        origin = np.array([rng.uniform(0, 1), rng.uniform(0, width), 0.0]) - rng.uniform(1, 5) * along
        t, _ = _hit(_lit_scene([], [corners @ turn.T]), technique, turn @ origin, turn @ along)
        if math.isfinite(t):
            met = origin + t * along
            inside = np.clip(met, [0.0, 0.0, 0.0], [1.0, width, 0.0])
            worst = max(worst, float(np.linalg.norm(met - inside)))
    return worst, 0.0


def _edge_on(technique: str) -> tuple[float, float]:
    """1 where a ray in the plane of a square meets neither the square nor, beyond it, the wall; else 0."""
    square, wall = _square(0.5, 0.0), np.array([[3.0, -1, -1], [3, 1, -1], [3, 1, 1], [3, -1, 1.0]])
    scene = _lit_scene([], [square, wall])
    found = [_hit(scene, technique, [-2.0, y, 0.0], [1.0, 0.0, 0.0])[0] for y in (0.0, 0.1, 0.5, -0.37) for _ in (0, 1)]
    # Nothing but an edge of the square (1.5, 2.5) or the wall behind can be met, and the same each time.
    fine = [min(abs(t - near) for near in (1.5, 2.5, 5.0)) < 1e-5 for t in found]
    return float(not all(fine) or found[::2] != found[1::2]), 0.0


def _stretched(volumes: str) -> tuple[float, float]:
    """Share of rays whose hit bounding volumes change, of groups scaled unevenly, turned and sheared."""
    import tempfile
    from pathlib import Path

    from workbench.accel.group_volumes import GroupVolumes
    from workbench.scene.sc import read_sc

    ring = " ".join(f"{math.cos(a):.9f} {math.sin(a):.9f} 0" for a in np.arange(12) * math.pi / 6)
    groups = "".join(
        f"push trans {x} {y} {x - y} rot z 40 scale 3 .2 1 rot x 35 scale .4 1 2 polygon 12 {ring} pop\n"
        for x in range(-2, 3) for y in range(-2, 3)
    )  # fmt: skip
    text = f"size 8 8\npersp 40\nlookat 0 0 20 0 0 0 0 1 0\nworld\n{groups}"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stretched.sc"
        path.write_text(text)
        scene = read_sc(path)
    rng = np.random.default_rng(412)
    origins = rng.normal(size=(4000, 3)) * 8.0
    toward = rng.normal(size=(4000, 3)) * 2.0 - origins
    plain, bounded = (GroupVolumes(scene, chosen).closest_hit(origins, toward) for chosen in ("none", volumes))
    assert (plain.polygon >= 0).mean() > 0.1
    return float(((plain.polygon != bounded.polygon) | (plain.t != bounded.t)).mean()), 0.0


def _past_float32() -> tuple[float, float]:
    """Occluded share of a hidden light where ids have passed 2^24, which a float32 cannot tell apart."""
    return _overflow(first=2**24 - 3, limit=2**31 - 1)


def _overflow(first: int = 97, limit: int = 100) -> tuple[float, float]:
    from workbench.accel.voxel_grid import RayIDs, VoxelGrid
    from workbench.shadow.woo import light_occlusion

    geometry = Geometry.from_scene(_lit_scene([LIGHT], [_square(0.6, 1.0)]))
    grid = VoxelGrid(geometry)
    # The fourth ray's id would pass the limit.
    ids = RayIDs(grid.object_count, first=first, limit=limit)
    unit = (np.arange(16) + 0.5) / 16 - 0.5
    samples = np.column_stack([unit, unit, np.full(16, 2.0)])[None].repeat(8, axis=0)
    found = light_occlusion(grid, np.zeros((8, 3)), LIGHT, samples, ids=ids, skip_polygons=[0, -1])
    return float(found.occlusion.mean()), 0.0


def _ray_entries() -> list[Failure]:
    # The grid's cells are cubes of 1/8 of the box 0..4: corners lie on the diagonal.
    diagonal = np.array([[3.5, 2.0, 2.0], [2.0, 3.5, 2.0], [2.0, 2.0, 3.5]])
    frame = [_square(0.01, 0.0, 0.01, 3.99), _square(0.01, 4.0, 3.99, 0.01)]
    upright = np.array([[3.0, 1, 0], [3, 3, 0], [3, 3, 2], [3, 1, 2.0]])
    through = _lit_scene([], [*frame, diagonal])
    faces = _lit_scene([], [*frame, upright, _rectangle(0, 2, 0, 4, 1.0)])

    def rays(
        name: str, group: str, about: str, scene: Scene, expected: float, origin: ArrayLike, way: ArrayLike
    ) -> Any:
        techniques = {technique: partial(_hit, scene, technique, origin, way) for technique in TRACERS}
        return Failure(name, group, about, expected, 1e-5 * expected, techniques)

    shift = np.array([1e5, 1e5, 1e5])
    big = np.array([[0.5, 0, 0], [0.5, 4, 0], [3.9, 4, 4], [3.9, 0, 4.0]])  # from voxel to voxel, met at x = 2.2
    nearer = np.array([[2.0, 1.5, 1.5], [2.0, 2.5, 1.5], [2.0, 2.5, 2.5], [2.0, 1.5, 2.5]])
    spanning = _lit_scene([], [*frame, big, nearer])
    return [
        rays("a polygon through many voxels", "mailboxes", "tested far away, its nearer rival is lost", spanning, 2.0,
             [0.0, 2.0, 2.0], [1.0, 0.0, 0.0]),
        Failure("threads", "mailboxes", "threads that share a mailbox lose hits", 0.0, 0.0,
                {name: partial(_threads, name) for name in ("rays+plane-vertex", "adaptive", "rays", "shaft", "auto")}),
        Failure("skinny triangles", "slivers", "hits far off a triangle in whose plane the ray nearly lies", 0.0, 1e-4,
                {name: partial(_skinny, name) for name in TRACERS}),
        rays("through the corners of voxels", "voxel walks", "a tie between three faces skips a voxel", through, 2.5,
             [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]),
        rays("in the faces of voxels", "voxel walks", "two directions of zero, a polygon in a face of cells", faces,
             3.0, [0.0, 2.0, 1.5], [1.0, 0.0, 0.0]),
        rays("a ray far from the origin", "float32 far from the origin", "distances rounded to 1/128",
             _moved(through, 1.0, shift), 2.5, shift, [1.0, 1.0, 1.0]),
        Failure("a ray in the plane of a polygon", "voxel walks", "not a number, or another answer each time", 0.0, 0.0,
                {name: partial(_edge_on, name) for name in TRACERS}),
        Failure("stretched groups", "voxel walks", "bounding volumes that do not enclose what an uneven scale made",
                0.0, 0.0, {f"groups, {kind}": partial(_stretched, kind) for kind in ("bsphere", "bbox", "both")}),
        Failure("ids past 2^24", "mailboxes", "ids in single precision repeat: no shadow", 1.0, 1e-12,
                {"voxel": _past_float32}),
        Failure("ids run out", "mailboxes", "after the last id every polygon seems tested: no shadow", 1.0, 1e-12,
                {"voxel": _overflow}),
    ]  # fmt: skip


def _catalogue() -> tuple[Failure, ...]:
    entries = [
        *_shadow_entries(), *_factor_entries(), *_enclosure_entries(), *_solve_entries(), *gather_entries(),
        *picture_entries(), *_ray_entries(),
    ]  # fmt: skip
    groups = list(dict.fromkeys(entry.group for entry in entries))
    return tuple(sorted(entries, key=lambda entry: groups.index(entry.group)))


CATALOGUE = _catalogue()
"""All entries, group by group."""
