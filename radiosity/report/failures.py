"""The catalogue of scenes on which techniques of light transport fail, and what is right on each.

Every entry is a small scene with one number that a formula gives, and the techniques that claim to
find it.  A technique is *right* within the entry's tolerance; it *degrades* where it is further off but
its own stated error says so; it *refuses* with a reason; it *disclaims* where it is further off and its
documentation names the case; anything else is *wrong silently*, which no technique may be.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.errors import WorkbenchError
from workbench.geometry.flat import Geometry
from workbench.scene.library import box_surface, diffuse, unit_cube
from workbench.scene.model import Material, Scene, Surface

__all__ = ["CATALOGUE", "Cell", "Failure", "contour_factor", "judge", "point_irradiance"]

FloatArray = NDArray[np.float64]

STATED = 4.0
"""A technique's stated error counts as said up to this many times: it is one standard error, or about."""


@dataclass(frozen=True)
class Failure:
    """One entry of the catalogue.

    Parameters
    ----------
    name, group : str
    about : str
        What breaks, and what a broken technique gives.
    expected : float
    tolerance : float
        Largest error that is still right, in the unit of ``expected``.
    techniques : dict
        Name to function; each returns the value and the error that the technique states (nan: none).
    disclaimed : dict
        Techniques whose documentation says that they do not handle this, and what it says.
    """

    name: str
    group: str
    about: str
    expected: float
    tolerance: float
    techniques: Mapping[str, Callable[[], tuple[float, float]]]
    disclaimed: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Cell:
    """What became of one technique on one entry.

    ``verdict`` is ``right``, ``degrades``, ``refuses``, ``disclaims`` or ``wrong``; ``error`` is signed, relative to
    the expected value (or absolute where that is 0), nan after a refusal; ``reason`` says why it refused
    or disclaims.
    """

    verdict: str
    error: float
    stated: float
    reason: str = ""


def judge(entry: Failure, technique: str) -> Cell:
    """Run one technique on one entry."""
    scale = abs(entry.expected) or 1.0
    try:
        value, stated = entry.techniques[technique]()
    except WorkbenchError as refused:
        return Cell("refuses", math.nan, math.nan, str(refused))
    off = value - entry.expected
    if not math.isfinite(off):
        return Cell("wrong", off, stated)
    if abs(off) <= entry.tolerance:
        verdict = "right"
    else:
        verdict = "degrades" if abs(off) <= STATED * stated + entry.tolerance else "wrong"
    if verdict == "wrong" and technique in entry.disclaimed:
        return Cell("disclaims", off / scale, stated / scale, entry.disclaimed[technique])
    return Cell(verdict, off / scale, stated / scale)


# ---- formulas ---------------------------------------------------------------------------------------


def point_irradiance(ring: ArrayLike, point: ArrayLike = (0, 0, 0), normal: ArrayLike = (0, 0, 1)) -> float:
    """Irradiance at a point from a polygon of radiance 1 wholly above its horizon (J. H. Lambert, 1760).

    Half the sum over the edges of the angle that each subtends times the cosine between the
    normal and the plane through the point and the edge.
    """
    toward = np.asarray(ring, dtype=float) - np.asarray(point, dtype=float)
    following = np.roll(toward, -1, axis=0)
    cross = np.cross(toward, following)
    length = np.linalg.norm(cross, axis=1)
    angle = np.arctan2(length, np.einsum("ij,ij->i", toward, following))
    cosine = cross @ np.asarray(normal, dtype=float) / np.where(length > 0, length, 1.0)
    return 0.5 * abs(float(angle @ cosine))


def contour_factor(first: ArrayLike, second: ArrayLike) -> float:
    """Form factor from one planar polygon to another that it sees whole, by the double contour integral.

    F = 1 / (2 pi A) times the sum over pairs of edges of their product by the mean logarithm of their
    distance (E. M. Sparrow 1963).  The inner integral is in closed form, the outer one by the
    double-exponential rule of H. Takahasi and M. Mori (1974), which endures logarithms at its ends.
    """
    p, q = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    step = np.arange(-48, 49) / 14.0
    place = 0.5 * (1.0 + np.tanh(0.5 * math.pi * np.sinh(step)))
    weight = 0.25 * math.pi * np.cosh(step) / np.cosh(0.5 * math.pi * np.sinh(step)) ** 2 / 14.0
    total = 0.0
    for a, b in zip(p, np.roll(p, -1, axis=0), strict=True):
        x = a + place[:, None] * (b - a)
        for c, d in zip(q, np.roll(q, -1, axis=0), strict=True):
            parallel = float((b - a) @ (d - c))
            if parallel != 0.0:
                total += parallel * float(weight @ _mean_logarithm(x, c, d))
    area = 0.5 * np.linalg.norm(np.cross(p, np.roll(p, -1, axis=0)).sum(axis=0))
    return abs(total) / (2.0 * math.pi * float(area))  # the sign tells which way round each ring runs


def _mean_logarithm(x: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    """Mean over the segment c d of the logarithm of the distance from each point x."""
    length = float(np.linalg.norm(d - c))
    along = (d - c) / length
    near = (c - x) @ along
    far = near + length
    aside = np.sqrt(np.maximum(((c - x) ** 2).sum(axis=1) - near**2, 0.0))

    def part(t: FloatArray) -> FloatArray:
        square = t * t + aside * aside
        log = 0.5 * np.log(np.where(square > 0, square, 1.0))
        return t * log - t + np.where(aside > 0, aside * np.arctan2(t, np.where(aside > 0, aside, 1.0)), 0.0)

    return np.asarray((part(far) - part(near)) / length)


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
    lights: list[FloatArray], occluders: Sequence[FloatArray | Surface], pane: float = 0.0, floor: bool = False
) -> Scene:
    """Lights of radiance 1, black occluders (or panes of a transmittance), perhaps a floor at z = 0."""
    lamp = diffuse("lamp", 0.0, math.pi)
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


def _shadows(
    name: str, group: str, about: str, scene: Scene, expected: float, *, relative_to: float | None = None,
    point: ArrayLike = (0.0, 0.0, 0.0), disclaimed: Mapping[str, str] | None = None,
) -> Failure:  # fmt: skip
    tolerance = 0.005 * (expected if relative_to is None else relative_to)
    techniques = {method: partial(_shadow, scene, method, point) for method in SHADOW_METHODS}
    return Failure(name, group, about, expected, tolerance, techniques, disclaimed or {})


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
        if name == "moved by 1e5":
            entries.append(
                _shadows("nothing in the way, moved by 1e5", group, "a surface that shadows itself",
                         _moved(plain, scale, shift), whole, point=np.asarray(shift, float))
            )  # fmt: skip
    return entries


# ---- form factors ----------------------------------------------------------------------------------


FACTOR_TECHNIQUES = ("view factors", "bundle", "bundle to 1e-6", "hemicube", "hemisphere rays")
OPPOSITE = 0.19982489569838746
"""Unit squares opposite each other at distance 1 (Howell C-11)."""


def _factor(scene: Scene, technique: str) -> tuple[float, float]:
    """F from the first polygon to the second, and its stated error."""
    from radiosity.form_factors.bundle import ReceiverBundles
    from radiosity.form_factors.matrix import view_factors
    from radiosity.patches import build_mesh
    from radiosity.report.techniques import problem_for
    from radiosity.solvers.solve import _settings

    if technique == "view factors":
        found = view_factors(scene, error=0.001, workers=1, seed=1)
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
    # A run without a hit says no more than that F is below about 3 / n; a hemicube's pixels are this coarse.
    least = 5.1e-4 if technique == "hemicube" else 3.0 / (4 * count) / STATED
    return float(np.mean(runs)), float(np.std(runs, ddof=1)) / 2.0 + least


def _pair(name: str, group: str, about: str, rings: list[FloatArray], expected: float, share: float = 0.01) -> Failure:
    surfaces = tuple(Surface.from_polygons(f"s{i}", diffuse("s", 0.5), [ring]) for i, ring in enumerate(rings))
    scene = replace(unit_cube(0.5, 1.0), surfaces=surfaces, closed=False)
    techniques = {technique: partial(_factor, scene, technique) for technique in FACTOR_TECHNIQUES}
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
        _pair("a whole wall between", "leaks", "a wall that contains both ends of the shaft",
              [floor, ceiling, _square(9.0, 0.5)], 0.0),
    ]  # fmt: skip
    return entries


# ---- solves -----------------------------------------------------------------------------------------


SOLVERS = ("progressive", "hierarchical", "direct")


def _solve(scene: Scene, method: str, read: Callable[[Any], float], options: dict[str, Any]) -> tuple[float, float]:
    from radiosity.solvers.solve import solve

    solution = solve(scene, method=method, seed=1, **options)
    stated = [v for k, v in solution.record.errors.items() if isinstance(v, float) and ("bound" in k or "rms" in k)]
    value = read(solution)
    return value, float(np.sqrt(np.square(stated).sum())) * abs(value)


def _solved(
    name: str, about: str, scene: Scene, expected: float, read: Callable[[Any], float], share: float = 0.01,
    group: str = "reflectance near 1", **options: Any,
) -> Failure:  # fmt: skip
    techniques = {method: partial(_solve, scene, method, read, options) for method in SOLVERS}
    return Failure(name, group, about, expected, share * max(abs(expected), 1e-12), techniques)


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

    return [
        _solved("furnace of 0.999", "stopping at the last change leaves most of the light: e / (1 - rho) = 1000",
                unit_cube(0.999, 1.0), 1000.0, _mean_radiosity, elements=96),
        _solved("furnace of 0.5", "rows of form factors that do not sum to 1: e / (1 - rho) = 2",
                unit_cube(0.5, 1.0), 2.0, _mean_radiosity, elements=96),
        _solved("furnace moved by 1e5", "the same in float32", _moved(unit_cube(0.5, 1.0), 1.0, [1e5, 1e5, -1e5]), 2.0,
                _mean_radiosity, group="float32 far from the origin", elements=96),
        _solved("black walls", "nothing is reflected, so B is what is emitted, once", unit_cube(0.0, 1.0), 1.0,
                _mean_radiosity, 1e-6, elements=24),
        _solved("all that is emitted is absorbed", "power made or lost on the way", room, 1.0, _absorbed_share,
                elements=96),
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


def _overflow() -> tuple[float, float]:
    from workbench.accel.voxel_grid import RayIDs, VoxelGrid
    from workbench.shadow.woo import light_occlusion

    geometry = Geometry.from_scene(_lit_scene([LIGHT], [_square(0.6, 1.0)]))
    grid = VoxelGrid(geometry)
    # The fourth ray's id would pass the limit.
    ids = RayIDs(grid.object_count, first=97, limit=100)
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
    return [
        rays("through the corners of voxels", "voxel walks", "a tie between three faces skips a voxel", through, 2.5,
             [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]),
        rays("in the faces of voxels", "voxel walks", "two directions of zero, a polygon in a face of cells", faces,
             3.0, [0.0, 2.0, 1.5], [1.0, 0.0, 0.0]),
        rays("a ray far from the origin", "float32 far from the origin", "distances rounded to 1/128",
             _moved(through, 1.0, shift), 2.5, shift, [1.0, 1.0, 1.0]),
        Failure("ids run out", "mailboxes", "after the last id every polygon seems tested: no shadow", 1.0, 1e-12,
                {"voxel": _overflow}),
    ]  # fmt: skip


def _catalogue() -> tuple[Failure, ...]:
    entries = [*_shadow_entries(), *_factor_entries(), *_solve_entries(), *_ray_entries()]
    groups = list(dict.fromkeys(entry.group for entry in entries))
    return tuple(sorted(entries, key=lambda entry: groups.index(entry.group)))


CATALOGUE = _catalogue()
"""All entries, group by group."""
