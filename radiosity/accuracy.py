"""The accuracy knob: ask for an error, get it, with its proof, from as small a mesh as will do.

The error of a solution is the area-weighted root mean square error of the irradiance over the
surfaces, divided by the area-weighted mean irradiance; the irradiance is what
``solution.irradiance(points, normals)`` answers, direct light found at the point and indirect light
gathered from the mesh.  It has four parts, each estimated on its own, and their sum is compared
with the target:

* *meshing*: the same points are asked under a mesh and a coarser one, and the difference is extrapolated
  (L. F. Richardson 1911) with the order at which it was seen to fall.  Of the full matrix the coarser mesh
  is that of its patches, whose form factors are sums of those of the elements: it costs nothing;
* *form factors* and *visibility*: the stated errors of what formulas and rays found, B F A by B F A;
* *convergence*: the bound residual / (1 - rho) on light that is still unshot.

Asked ``at`` given points, the error is that at these points, relative to the mean irradiance there.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radiosity.form_factors._sampling import place_on_pieces
from radiosity.mesh_choice import Divisions, like_elements
from radiosity.patches import TESSELLATED, PatchMesh, build_mesh
from radiosity.sensors import Gatherer
from radiosity.solve_costs import expected_seconds
from radiosity.solvers.solution import Checkpoint, Progress, ProgressEvent, Solution
from radiosity.solvers.solve import (
    MATRIX_POLYGONS,
    begin,
    most_matrix_elements,
    require_matrix_memory,
    solve_by_matrix,
)
from radiosity.solvers.solve import solve as solve_once
from workbench.arrays import as_fraction, as_places, as_positive
from workbench.counters import Counters
from workbench.errors import InputError, MemoryForecastError, OptionError
from workbench.geometry.flat import Geometry
from workbench.record import RunRecord
from workbench.scene.load import load
from workbench.scene.model import Scene
from workbench.shadow.occlusion import Shader

__all__ = ["ErrorEstimate", "solve", "surface_points"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LOOKS = ((0.02, 64, 32, 2), (0.005, 128, 128, 2), (0.002, 256, 128, 2), (0.0, 256, 256, 2), (0.0, 256, 1024, 4))
"""From so large an asked error on: points at which two meshes are compared, rays from each, and looks.

(Sampling moves the estimate by 15 % with the first; what two looks differ by is no part of it.  Where it hides
the difference, the next row is taken.)"""
LEAST_LOOKS, ROUGHLY = 64, 0.1
"""Least looks at given points, each by rays of its own; error to which their mean irradiance is found."""
MOST_DOUBT = 0.35
"""Share of the squared difference that may be sampling."""
ORDER = 0.9
"""Power of the number of elements with which the meshing error falls, until it has been seen to."""
SEEN_TARGET = 0.003
"""Asked error up to which an order that was not seen is taken for a standard deviation less."""
ORDERS = (0.5, 1.5)
"""Orders that are believed when seen."""
ORDER_SPREAD, SEEN_SPREAD, SEEN_ELEMENTS = 0.25, 0.3, 100
"""Standard deviation of the order from scene to scene, and of the logarithm of the ratio of two differences: larger
where the coarser one is of fewer elements than so many."""
ROOM_ERROR, ROOM_REFLECTANCE = 3.6, 0.55
"""Meshing error of a room of a reflectance of 1, times the number of elements to the power ``ORDER``: the first
guess (Cornell box); and a room's mean reflectance, where it is not known."""
PILOT, PILOT_SHARE, MOST_FIRST = 400, 0.16, 700
"""Where more elements are guessed to be needed, a mesh of this share of them is solved first: it costs little, and what
it tells is worth more than any guess.  And most elements of the first mesh."""
BUDGET_ELEMENTS = 64
"""Most elements of the first mesh where time is limited: it is solved whatever it takes."""
SAFE = 0.9
"""Share of the asked error below which the estimate must fall: it is one itself."""
MESHING_SHARE, GUESSED_SHARE = 0.8, 0.7
"""Share of the error that the mesh may take: one whose predecessor is known, and one that is guessed."""
FACTOR_SHARE, FACTOR_ELEMENTS, MOST_FACTOR_ERROR = 1.0, 500, 0.05
"""Error of the rows of form factors, over the asked error, up to so many elements; and the largest."""
LEAST_DIVIDED = 2.5
"""Least ratio of a mesh to its patches, see :meth:`Divisions.least`: with less, it cannot tell what it leaves."""
LEAST_GROWTH, MOST_STUCK = 1.3, 8
"""Growth below which a mesh counts as the same, and how often the number asked for is doubled then."""
AMPLE = 1.15
"""Growth beyond what the estimate asks for: another mesh costs more than a larger one."""
GROWTH, FIRST_GROWTH = (1.6, 8.0), 3
"""Least and largest growth of the number of elements from mesh to mesh; and that to a mesh which shows a difference."""
COST_POWER = 1.7
"""Power of the number of elements with which the seconds grow."""
GATHERED = 5.0
"""Number of elements times the sum of squared form factors from a point to them: 1 in a sphere, 3 to 6 in rooms."""
LINK_ORDER = 0.6
"""Order of hierarchical solves: links are found as well as elements are, and miss what falls slowly."""
FIRST_LINKS = 0.4
"""Link error of the first links, over the asked error (seen on rooms)."""
COARSER_BY, MOST_TRUSTED = 1.5, 3.0
"""Least ratio of the elements of links to those that they are compared with, where there are such; and the largest that
is trusted to make them better."""
LINKS_ERROR = 0.02
"""Larger scenes are solved by links, which are cheapest from so large an asked error on, and else by shooting."""
LINKS_CHEAPER = 0.75
"""Links, whose error is known less well, are taken where they are expected to cost so much less."""
MOST_LEVELS = 12
TWICE_ELEMENTS = 64
"""Meshes up to this size are solved twice, to see a difference."""
MOST_TRIES = 5
"""Solves of one given mesh, each with better form factors."""


@dataclass(frozen=True)
class ErrorEstimate:
    """The four parts of a solution's error, each a root mean square relative to the mean irradiance."""

    meshing: float
    form_factors: float
    visibility: float
    convergence: float

    @property
    def total(self) -> float:
        """Their sum: they may all have one sign."""
        return self.meshing + self.form_factors + self.visibility + self.convergence

    def as_dict(self) -> dict[str, float]:
        """By name, with the sum as ``total``."""
        parts = ("meshing", "form_factors", "visibility", "convergence")
        return {name: getattr(self, name) for name in parts} | {"total": self.total}


def surface_points(mesh: PatchMesh, count: int, seed: int = 0) -> tuple[FloatArray, FloatArray, IntArray]:
    """Points spread over the surfaces of a mesh, equally many an area.

    Parameters
    ----------
    mesh : PatchMesh
    count : int
    seed : int

    Returns
    -------
    points, normals : (count, 3) float
    polygon : (count,) int
        Polygon of the geometry that each lies on, -1 on clusters of facets.
    """
    rng = np.random.default_rng(seed)
    edges = np.cumsum(mesh.element_area)
    goal = (np.arange(count) + rng.random(count)) / count * edges[-1]
    element = np.minimum(np.searchsorted(edges, goal, side="right"), mesh.element_count - 1)
    uv = rng.random((count, 2))
    points, normals = np.empty((count, 3)), np.empty((count, 3))
    first = mesh.element_piece
    for i, e in enumerate(element.tolist()):
        piece = place_on_pieces(
            mesh.corners, mesh.piece_start, first[e], first[e + 1], mesh.element_area[e], uv[i, 0], uv[i, 1], points[i]
        )
        normals[i] = mesh.piece_normal[piece]
    return points, normals, mesh.element_polygon[element]


@dataclass
class _Run:
    """What all meshes of one run share."""

    target: float
    seconds: float
    options: dict[str, Any]
    settings: dict[str, Any]
    start: float = field(default_factory=time.perf_counter)
    levels: list[dict[str, Any]] = field(default_factory=list)
    care: float = 1.0
    at: tuple[FloatArray, FloatArray] | None = None
    scale: float = 1.0
    guess: float = 1.0
    counters: Counters = field(default_factory=Counters)
    spent: dict[str, float] = field(default_factory=dict)
    choices: dict[str, str] = field(default_factory=dict)

    @property
    def left(self) -> float:
        """Seconds left of the budget."""
        return self.seconds - (time.perf_counter() - self.start)

    def points(self, mesh: PatchMesh, row: int) -> tuple[FloatArray, FloatArray, IntArray]:
        """Points, normals and own polygons at which meshes are compared, for a row of :data:`LOOKS`."""
        count = LOOKS[row][1]
        if self.at is None:
            return surface_points(mesh, count)
        # Few points are looked at several times, each time by other rays.
        pick = np.arange(len(self.at[0])) if len(self.at[0]) <= count else np.arange(count) * len(self.at[0]) // count
        pick = np.tile(pick, -(-LEAST_LOOKS // len(pick)))
        return self.at[0][pick], self.at[1][pick], np.full(len(pick), -1, dtype=np.int64)

    def measure(self, solution: Solution, gatherer: Gatherer) -> float:
        """The mean irradiance to which errors are relative; all parts of the error are scaled to it."""
        mean = float(solution.mean_irradiance.mean())
        if self.at is None:
            return mean
        found = gatherer.irradiance(*self.at, error=ROUGHLY)
        self.counters.merge(found.counters)
        here = float(found.irradiance.mean())
        self.scale = mean / here if here > 0 else 1.0
        return here if here > 0 else mean

    def add(self, solution: Solution) -> None:
        self.counters.merge(solution.record.counters)
        for name, value in solution.record.seconds.items():
            self.spent[name] = self.spent.get(name, 0.0) + value


def _relative_rms(difference: FloatArray, mean: float) -> float:
    return math.sqrt(float(np.mean(difference**2))) / mean if mean > 0 else 0.0


def _parts(solution: Solution, meshing: float | None, scale: float = 1.0) -> ErrorEstimate:
    """The error's parts; without a meshing error, those of the irradiance of the elements themselves.

    ``scale`` is the mean irradiance of the surfaces over that to which errors are relative.
    """
    errors, mesh = solution.record.errors, solution.mesh
    share = 1.0
    if meshing is not None:
        # A point reads what elements reflect.  Their errors are independent, so variances count, weighted
        # by the squares of what the point sees of each; those sum to GATHERED / n.
        reflected = float(mesh.element_area @ mesh.reflectance.mean(axis=1) / mesh.element_area.sum())
        share = reflected * math.sqrt(min(GATHERED / mesh.element_count, 1.0))
    share *= scale
    return ErrorEstimate(
        0.0 if meshing is None else meshing,
        share * float(errors.get("irradiance_form_factors_rms", 0.0)),
        share * float(errors.get("irradiance_visibility_rms", 0.0)),
        scale * float(errors.get("remaining_bound", 0.0)),
    )


class _OutOfTime(KeyboardInterrupt):
    """Ends a solver's work as Ctrl-C does."""


def _watched(progress: Progress | None, run: _Run, message: str, stoppable: bool) -> Progress:
    """The caller's progress function, told of the mesh; ends the solve when the budget is spent."""

    def report(event: ProgressEvent) -> None:
        if progress is not None:
            progress(ProgressEvent(event.shots, event.residual, event.tolerance, event.seconds, message))
        if stoppable and run.left < 0:
            raise _OutOfTime

    return report


def _like(solution: Solution) -> float:
    """How many elements alike leave as large an error as those of a solution."""
    mesh = solution.mesh
    like = like_elements(mesh.element_area, (mesh.reflectance * solution.element_irradiance).mean(axis=1))
    return like or float(mesh.element_count)  # nothing is reflected


def _order(levels: list[dict[str, Any]]) -> float:
    """The order at which the difference between meshes falls, as far as it can be told."""
    told = [level for level in levels if level["difference"] is not None]
    if len(told) < 2 or min(level["difference"] for level in told[-2:]) <= 0:
        return ORDER
    before, after = told[-2:]
    # The difference of two meshes is about the error of the coarser one.
    growth = after["coarse_like"] / before["coarse_like"]
    if growth < LEAST_GROWTH:
        return ORDER
    slope = math.log(before["difference"] / after["difference"]) / math.log(growth)
    # Of meshes that hardly differ the slope is known but roughly: what is known beforehand counts as much as it may.
    doubt = SEEN_SPREAD * math.sqrt(1.0 + SEEN_ELEMENTS / before["coarse_like"])
    known, seen = ORDER_SPREAD**-2, (doubt / math.log(growth)) ** -2
    return min(max((known * ORDER + seen * slope) / (known + seen), ORDERS[0]), ORDERS[1])


def solve(
    scene: Scene | str | Path,
    *,
    error: float | None = None,
    budget_seconds: float | None = None,
    at: tuple[ArrayLike, ArrayLike] | None = None,
    elements: int | None = None,
    max_edge: float | None = None,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
    resume: Solution | None = None,
    **options: Any,
) -> Solution:
    """Solve a scene for radiosity: to an error, within a time, or with options of one's own.

    Parameters
    ----------
    scene : Scene, str or Path
        From :func:`workbench.load` or built in code; or what that takes: a file, the name of a built-in scene.
    error : float, optional
        Wanted error, see :mod:`radiosity.accuracy`: root mean square over the surfaces, relative to
        the mean irradiance.  Meshes are refined until the estimate falls below it.  With ``elements``
        or ``max_edge`` the mesh is given, and the error is that of its elements' mean irradiance.
    budget_seconds : float, optional
        Instead or as well: stop refining when another mesh would not fit into this time.  The error
        reached stands in the record.
    at : (points, normals), optional
        Both (n, 3): the places that matter.  The error is then that of the irradiance there, relative to its mean
        there, instead of over all surfaces: a dim room beside a bright yard needs it.
    elements, max_edge, progress, checkpoint, resume, options
        As in :func:`radiosity.solvers.solve.solve`, which this calls.

    Returns
    -------
    Solution
        ``record.errors["estimate"]`` has the parts of the error and their sum, ``record.results["levels"]`` a row
        a mesh, ``record.choices`` what was chosen and why.

    Raises
    ------
    InputError, OptionError, MemoryForecastError
        As :func:`radiosity.solvers.solve.solve`.
    """
    scene = load(scene)
    fixed: dict[str, Any] = {"elements": elements, "max_edge": max_edge}
    if error is None and budget_seconds is None:
        return solve_once(scene, **fixed, progress=progress, checkpoint=checkpoint, resume=resume, **options)
    if error is not None:
        error = as_fraction(error, "error")
    if budget_seconds is not None:
        budget_seconds = as_positive(budget_seconds, "budget_seconds", "a positive number of seconds")
    for name in ("tolerance", "form_factor_error"):
        if options.pop(name, None) is not None:
            raise OptionError(f"{name} and error were both given; the error decides the {name.replace('_', ' ')}")
    places = None
    if at is not None:
        if elements is not None or max_edge is not None:
            raise OptionError("at and a given mesh were both given; choose one of them")
        if not isinstance(at, (tuple, list)) or len(at) != 2:
            raise InputError("at: expected a pair (points, normals)")
        places = as_places(*at)
    run = _Run(
        at=places,
        target=error if error is not None else 0.0,
        seconds=budget_seconds if budget_seconds is not None else math.inf,
        options=options,
        settings={"error": error, "budget_seconds": budget_seconds} | fixed,
    )
    if elements is not None or max_edge is not None:
        return _improve_factors(scene, run, fixed, progress)
    return _refine(scene, run, progress, checkpoint, resume)


def _finish(run: _Run, solution: Solution, estimate: ErrorEstimate, reason: str) -> Solution:
    """Write the whole run into the record of its last solution."""
    record = solution.record
    record.counters, record.seconds = run.counters, run.spent
    record.settings |= run.settings
    record.errors["estimate"] = estimate.as_dict()
    record.errors["definition"] = (
        "area-weighted RMS error of irradiance over the surfaces / mean irradiance"
        if run.at is None
        else f"RMS error of irradiance at {len(run.at[0])} given points / mean irradiance there"
    )
    record.results["levels"] = run.levels
    record.results.pop("level_irradiance", None)
    record.results.pop("rounds_seen", None)
    if solution.stopped != "interrupted":
        solution.refinement = None
    reached = run.target > 0 and estimate.total <= run.target
    record.results["target_reached"] = reached
    record.choices |= run.choices | {"stop": reason}
    solution.converged = solution.converged and (reached or run.target == 0.0)
    return solution


def _first_error(run: _Run) -> float:
    """Error by which the first mesh is chosen; without a target, a rough one."""
    return run.target if run.target > 0 else 0.1


def _look(gatherer: Gatherer, where: tuple[FloatArray, FloatArray, IntArray], row: int, run: _Run) -> FloatArray:
    """Indirect irradiance (looks, points, bands) at points, by the same rays for every solution."""
    _, _, rays, looks = LOOKS[row]
    points, normals, _ = where
    # In one call: each place has rays of its own.
    here, facing = (np.tile(each, (looks, 1)) for each in (points, normals))
    found = gatherer.indirect(here, facing, rays=rays, counters=run.counters, seed=1).indirect
    return found.reshape(looks, len(points), -1)


def _effort(run: _Run, elements: int) -> int:
    """Row of :data:`LOOKS` for the asked error, or for what so many elements may reach if that is more."""
    # A first mesh that is far too coarse needs no close look.
    wanted = max(run.target, _room_error(elements))
    return next(row for row, (error, *_) in enumerate(LOOKS) if wanted >= error)


def _difference(fine: FloatArray, coarse: FloatArray, mean: float) -> tuple[float, float]:
    """Root mean square over the points of what two solutions differ by, relative to the mean irradiance.

    Of looks (looks, points, bands) with other rays: noise has no part in the products of different looks.

    Returns
    -------
    difference : float
        One standard error high.
    share : float
        Share of its square that is that standard error.
    """
    if mean <= 0.0:
        return 0.0, 0.0
    off = fine - coarse
    looks = len(off)
    products = ((off.sum(axis=0) ** 2 - (off**2).sum(axis=0)) / (looks * (looks - 1))).mean(axis=1)
    doubt = float(products.std()) / math.sqrt(len(products))
    square = max(float(products.mean()), 0.0) + doubt
    return math.sqrt(square) / mean, doubt / square if square > 0 else 0.0


def _method(scene: Scene, run: _Run) -> str:
    """The solver for all meshes of a run."""
    asked = str(run.options.get("method", "auto"))
    if asked != "auto":
        return asked
    polygons = sum(surface.face_count for surface in scene.surfaces)
    rough = _first_error(run) >= LINKS_ERROR and run.options.get("bundles", "receiver") == "receiver"
    if polygons <= MATRIX_POLYGONS:
        run.choices["method"] = f"matrix: {polygons} polygons, all form factors at once up to {MATRIX_POLYGONS}"
        # Of rounded surfaces links are clusters, which say far more of their error than they make.
        rounded = any(surface.face_count >= TESSELLATED for surface in scene.surfaces)
        if rough and polygons and not rounded:
            pieces, error = len(Geometry.from_scene(scene).piece_start) - 1, _first_error(run)
            whole, links = (
                expected_seconds(each, polygons=polygons, pieces=pieces, error=error)
                for each in ("matrix", "hierarchical")
            )
            method = "hierarchical" if links < LINKS_CHEAPER * whole else "matrix"
            told = f"{whole:.2g} s expected of the full matrix, {links:.2g} s of links"
            run.choices["method"] = f"{method}: {polygons} polygons in {pieces} pieces, {told}"
            return method
        return "matrix"
    if rough:
        run.choices["method"] = f"hierarchical: {polygons} polygons, and no less than {LINKS_ERROR:g} asked"
        return "hierarchical"
    run.choices["method"] = f"progressive: {polygons} polygons, whose small facets are clustered"
    return "progressive"


def _room_error(elements: int, reflectance: float = ROOM_REFLECTANCE) -> float:
    """Meshing error of a room of so many elements, about."""
    return float(ROOM_ERROR * reflectance / elements**ORDER)


def _first_count(run: _Run, reflectance: float = ROOM_REFLECTANCE) -> int:
    """Number of elements of the first mesh."""
    guess = (_room_error(1, reflectance) / (GUESSED_SHARE * _first_error(run))) ** (1.0 / ORDER)
    run.guess = min(max(guess, 1.0), BUDGET_ELEMENTS if math.isfinite(run.seconds) else MOST_FIRST)
    return math.ceil(run.guess * (PILOT_SHARE if guess > PILOT else 1.0))


def _patches_as_elements(mesh: PatchMesh) -> PatchMesh:
    """The mesh whose elements are the patches of another, each a patch of its own."""
    n, first = mesh.patch_count, mesh.patch_start[:-1]
    piece_element = np.repeat(np.arange(n), np.diff(mesh.patch_sender)).astype(np.int64)
    centroid = mesh.patch_mean(mesh.element_centroid)
    away = np.linalg.norm(mesh.sender_corners - centroid[np.repeat(piece_element, np.diff(mesh.sender_start))], axis=1)
    return replace(
        mesh,
        corners=mesh.sender_corners,
        piece_start=mesh.sender_start,
        piece_element=piece_element,
        piece_normal=mesh.sender_normal,
        element_area=mesh.patch_area,
        element_normal=mesh.patch_normal,
        element_centroid=np.ascontiguousarray(centroid),
        element_size=2.0 * np.maximum.reduceat(away, mesh.sender_start[mesh.patch_sender[:-1]]),
        element_polygon=mesh.patch_polygon,
        element_surface=mesh.element_surface[first],
        element_side=mesh.element_side[first],
        element_patch=np.arange(n),
        reflectance=np.ascontiguousarray(mesh.reflectance[first]),
        emission=np.ascontiguousarray(mesh.emission[first]),
        patch_start=np.arange(n + 1),
    )


class _Patches:
    """Meshes solved with the full matrix, each compared with its own patches."""

    def __init__(self, scene: Scene, run: _Run, progress: Progress | None, checkpoint: Checkpoint | None) -> None:
        self.scene, self.run, self.progress, self.checkpoint = scene, run, progress, checkpoint
        self.gatherer: Gatherer | None = None
        record = begin(scene, **run.options | {"method": "matrix", "elements": 1})  # which checks both
        with record.stage("mesh"):
            self.shader = Shader(Geometry.from_scene(scene), record.settings["workers"])
            self.divisions = Divisions(scene, self.shader.geometry)
        run.spent |= record.seconds

    def first(self) -> int:
        """Number of elements of the first mesh."""
        return _first_count(self.run, self.divisions.reflectance)

    def solve(self, count: int, stoppable: bool) -> Solution:
        """Solve a mesh of about so many elements, and its patches."""
        run = self.run
        # The errors of more and smaller form factors cancel better; and no finer than this mesh can be right.
        expected = _room_error(count, self.divisions.reflectance)
        needed = max(run.target * math.sqrt(max(count / FACTOR_ELEMENTS, 1.0)), 0.5 * expected)
        factor_error = min(run.care * FACTOR_SHARE * needed, MOST_FACTOR_ERROR)
        asked = run.options | {"method": "matrix", "elements": count, "form_factor_error": factor_error}
        record = begin(self.scene, **asked)
        with record.stage("mesh"):
            mesh = self._divided(count)
            patches = _patches_as_elements(mesh)
        require_matrix_memory(mesh.element_count)
        watched = _watched(self.progress, run, f"mesh {len(run.levels) + 1}, about {count} elements", stoppable)
        solution, coarse = solve_by_matrix(self.scene, self.shader, mesh, record, coarse_mesh=patches, progress=watched)
        assert coarse is not None
        self.coarse = coarse
        return solution

    def _divided(self, count: int) -> PatchMesh:
        """A mesh of about so many elements, or of more, so that it is finer than its patches where it matters."""
        elements = self.divisions.least(count, LEAST_DIVIDED)
        return build_mesh(self.scene, self.shader.geometry, elements=elements, split=2, cluster=False)

    def compare(self, solution: Solution) -> tuple[float | None, float]:
        """What the mesh and its patches differ by, and how many elements alike these are as good as."""
        mesh, coarse = solution.mesh, self.coarse
        if not mesh.reflectance.any():
            return 0.0, 0.0
        if self.gatherer is None:
            self.gatherer = Gatherer(solution, shader=self.shader)
        else:
            self.gatherer = self.gatherer.reading(solution)
        other = self.gatherer.reading(coarse)
        mean = self.run.measure(solution, self.gatherer)
        for row in range(_effort(self.run, mesh.element_count), len(LOOKS)):
            where = self.run.points(mesh, row)
            seen = [_look(each, where, row, self.run) for each in (self.gatherer, other)]
            difference, doubt = _difference(seen[0], seen[1], mean)
            # Some more rays are cheaper than a finer mesh for nothing.
            if doubt <= MOST_DOUBT or difference <= 0.5 * self.run.target:
                break
        if self.run.at is None:
            difference = max(difference, _surface_difference(solution, coarse, mean))
        return difference, _like(coarse)

    def like(self, solution: Solution) -> float:
        """How many elements alike a mesh is as good as."""
        return _like(solution)

    def finer(self, solution: Solution, times: float) -> int:
        """Elements of a mesh with so many times more where it is divided: the rest is small."""
        members = np.diff(solution.mesh.patch_start)
        whole = int((members == 1).sum())
        return whole + math.ceil((solution.mesh.element_count - whole) * times)

    def keep(self, solution: Solution, count: int) -> None:
        """Let the caller save a whole mesh, from which a mesh of ``count`` elements follows."""
        if self.checkpoint is not None:
            solution.record.settings |= self.run.settings | {"elements": count}
            solution.record.results["levels"] = self.run.levels
            self.checkpoint(solution)


def _surface_difference(fine: Solution, coarse: Solution, mean: float) -> float:
    """Mean over the area of what the mean irradiance of the polygons differs by, relative to the mean irradiance.

    Points hardly feel what is wrong in the balance between surfaces that send each other much light.  Not
    squared: in narrow gaps elements are far off, where points find light afresh.
    """
    key = 2 * fine.mesh.element_polygon + (fine.mesh.element_side < 0)
    which, row = np.unique(key, return_inverse=True)
    off = fine.element_irradiance - coarse.element_irradiance[fine.mesh.element_patch]
    area = fine.mesh.element_area
    each = np.stack([np.bincount(row, area * band, len(which)) for band in off.T], axis=1)
    return float(np.sqrt((each**2).mean(axis=1)).sum() / area.sum() / mean) if mean > 0 else 0.0


class _Meshes:
    """Meshes solved by any other method, each compared with the one before."""

    def __init__(
        self,
        scene: Scene,
        run: _Run,
        method: str,
        progress: Progress | None,
        checkpoint: Checkpoint | None,
        resume: Solution | None,
    ) -> None:
        self.scene, self.run, self.method, self.progress, self.checkpoint = scene, run, method, progress, checkpoint
        self.unfinished = resume
        self.gatherer: Gatherer | None = None
        self.points: tuple[FloatArray, FloatArray, IntArray] | None = None
        self.take_up({} if resume is None else resume.record.results)

    def take_up(self, results: dict[str, Any]) -> None:
        """What a run that goes on has seen, from the results of its record."""
        stored = results.get("level_irradiance")
        self.seen: FloatArray | None = None if stored is None else np.asarray(stored)

    def put_by(self) -> dict[str, Any]:
        """The results from which :meth:`take_up` goes on."""
        return {"level_irradiance": None if self.seen is None else self.seen.tolist()}

    def _keeper(self, count: int) -> Checkpoint | None:
        """Saves an unfinished solve of ``count`` with what a run needs to go on, if it is to be saved."""
        save, run = self.checkpoint, self.run
        if save is None:
            return None

        def keep(solution: Solution) -> None:
            solution.record.settings |= run.settings | {"elements": count}
            solution.record.results |= {"levels": run.levels} | self.put_by()
            save(solution)

        return keep

    def first(self) -> int:
        """Number of elements of the first mesh, which shows nothing before there is another."""
        _first_count(self.run)
        return math.ceil(self.run.guess)

    def solve(self, count: int, stoppable: bool) -> Solution:
        """Solve a mesh of about so many elements."""
        run = self.run
        finest = max(run.target, 0.3 / count)
        unfinished, self.unfinished = self.unfinished, None
        asked = run.options | {
            "method": self.method,
            "elements": count,
            "tolerance": min(0.1 * finest, 0.01) / max(run.scale, 1.0),
            "form_factor_error": min(run.care * 2.0 * finest, 0.02),
        }
        if self.method == "hierarchical":
            # Links are found as well as their elements need; the points take direct light themselves.
            del asked["form_factor_error"]
            asked["direct_in_mesh"] = False
        return solve_once(
            self.scene,
            progress=_watched(self.progress, run, f"mesh {len(run.levels) + 1}, about {count} elements", stoppable),
            checkpoint=self._keeper(count),
            resume=unfinished,
            **asked,
        )

    def compare(self, solution: Solution) -> tuple[float | None, float]:
        """What the mesh and the one before differ by, and how many elements alike that is as good as."""
        reading, mean = self._reading(solution)
        seen = self._look(reading)
        before, self.seen = self.seen, seen
        if before is None:
            return None, 0.0
        return _difference(seen, before, mean)[0], self.run.levels[-1]["like"]

    def _reading(self, solution: Solution) -> tuple[Gatherer, float]:
        """What reads a solution, and the mean irradiance."""
        if self.gatherer is None:
            self.gatherer = Gatherer(solution, workers=self.run.options.get("workers"))
            # Of the coarsest mesh, so that they do not depend on where a resumed run begins.
            self.points = self.run.points(build_mesh(self.scene, self.gatherer.geometry), self._row())
        reading = self.gatherer.reading(solution)
        return reading, self.run.measure(solution, reading)

    def _look(self, reading: Gatherer) -> FloatArray:
        assert self.points is not None
        return _look(reading, self.points, self._row(), self.run)

    def _row(self) -> int:
        """Row of :data:`LOOKS`, one for all meshes: they are compared at the same points."""
        return _effort(self.run, BUDGET_ELEMENTS)

    def like(self, solution: Solution) -> float:
        """Its number of elements: clusters of facets come in steps of which their areas tell nothing."""
        return float(solution.mesh.element_count)

    def finer(self, solution: Solution, times: float) -> int:
        """Elements of a mesh with so many times more."""
        return math.ceil(solution.mesh.element_count * times)

    def keep(self, solution: Solution, count: int) -> None:
        """These methods save themselves within each mesh."""


@dataclass(eq=False)
class _Seen:
    """A solution of a round of links, or what was seen of it: indirect light at points, flux that surfaces reflect."""

    elements: int
    solution: Solution | None
    looks: FloatArray | None = None
    surfaces: FloatArray | None = None

    def as_dict(self) -> dict[str, Any]:
        """For the record of an unfinished solve."""
        assert self.looks is not None and self.surfaces is not None
        return {"elements": self.elements, "looks": self.looks.tolist(), "surfaces": self.surfaces.tolist()}


class _Links(_Meshes):
    """Links made finer and finer, each time going on from those that are there.

    The rounds in which links are refined are compared with the last one: no mesh is solved for that alone.
    The ``count`` of this class is the inverse of the link error.
    """

    def take_up(self, results: dict[str, Any]) -> None:
        """As of meshes: what was seen of rounds."""
        stored = results.get("rounds_seen", [])
        self.rounds = [_Seen(e["elements"], None, np.asarray(e["looks"]), np.asarray(e["surfaces"])) for e in stored]

    def put_by(self) -> dict[str, Any]:
        """As of meshes."""
        return {"rounds_seen": [self._seen(each).as_dict() for each in self.rounds]}

    def first(self) -> int:
        """Inverse of the first link error."""
        self.run.guess = 1.0 / (FIRST_LINKS * _first_error(self.run))
        return math.ceil(self.run.guess)

    def solve(self, count: int, stoppable: bool) -> Solution:
        """Refine until links are off by no more than the inverse of ``count``."""
        run = self.run
        unfinished, self.unfinished = self.unfinished, None
        solution = solve_once(
            self.scene,
            progress=_watched(self.progress, run, f"mesh {len(run.levels) + 1}, links to {1 / count:.2g}", stoppable),
            checkpoint=self._keeper(count),
            resume=unfinished,
            rounds=lambda each: self.rounds.append(_Seen(each.mesh.element_count, each)),
            method=self.method,
            link_error=1.0 / count,
            # Points take direct light themselves: elements resolve it for what they reflect.
            direct_in_mesh=any(surface.material.reflectance.any() for surface in self.scene.surfaces),
            tolerance=min(0.1 * run.target, 0.01) / max(run.scale, 1.0) if run.target > 0 else 0.001,
            **{name: value for name, value in run.options.items() if name != "method"},
        )
        if solution.stopped != "interrupted":
            # The last round's, solved to the end.
            self.rounds[-1:] = [_Seen(solution.mesh.element_count, solution)]
        # Counters and seconds of what is gone on from are those of this solve already.
        self.unfinished = replace(solution, record=RunRecord("solve", dict(solution.record.settings)))
        return solution

    def compare(self, solution: Solution) -> tuple[float | None, float]:
        """What the links and those of a round before differ by, and how many elements those are as good as."""
        n = solution.mesh.element_count
        # The first two rounds hold the light of emitters, and of what they lit.
        whole = self.rounds[0 if self.run.levels else 2 : -1]
        if not whole:
            return None, 0.0
        fewer = [each for each in whole if COARSER_BY * each.elements <= n]
        chosen = fewer[-1] if fewer else whole[0]
        # Later ones are compared with no coarser ones.
        self.rounds = self.rounds[self.rounds.index(chosen) :]
        levels = self.run.levels
        if n < LEAST_GROWTH * chosen.elements and not (levels and levels[-1]["difference"] is None):
            # Links alone were refined: that elements will do as they are is believed when told twice.
            return None, 0.0
        before, last = self._seen(chosen), self._seen(self.rounds[-1])
        assert before.looks is not None and last.looks is not None
        mean = self._reading(solution)[1]
        difference = _difference(last.looks, before.looks, mean)[0]
        if self.run.at is None:
            assert before.surfaces is not None and last.surfaces is not None
            off = np.sqrt(((last.surfaces - before.surfaces) ** 2).mean(axis=1)).sum()
            difference = max(difference, float(off / solution.mesh.element_area.sum()) / mean) if mean > 0 else 0.0
        return difference, max(float(before.elements), n / MOST_TRUSTED)

    def _seen(self, one: _Seen) -> _Seen:
        """What was seen of a round, looked at if it was not yet."""
        if one.looks is None:
            solution = one.solution
            assert solution is not None
            one.looks = self._look(self._reading(solution)[0])
            mesh = solution.mesh
            flux = mesh.element_area[:, None] * mesh.reflectance * solution.element_irradiance
            one.surfaces = np.stack([np.bincount(mesh.element_surface, band) for band in flux.T], axis=1)
        return one

    def finer(self, solution: Solution, times: float) -> int:
        """Inverse of a link error so many times smaller."""
        return math.ceil(times / solution.record.settings["link_error"])


def _refine(
    scene: Scene, run: _Run, progress: Progress | None, checkpoint: Checkpoint | None, resume: Solution | None
) -> Solution:
    """Solve finer and finer meshes until the estimate is below the target."""
    best: Solution | None = None
    estimate = ErrorEstimate(math.inf, 0.0, 0.0, 0.0)
    method = _method(scene, run)
    levels: _Patches | _Meshes
    if method == "matrix":
        levels = _Patches(scene, run, progress, checkpoint)
    else:
        # Of many facets clusters are made: by their number, since links would open them all.
        few = sum(surface.face_count for surface in scene.surfaces) <= MATRIX_POLYGONS
        kind = _Links if method == "hierarchical" and few else _Meshes
        levels = kind(scene, run, method, progress, checkpoint, resume)
    count = levels.first()
    if resume is not None:
        run.levels = list(resume.record.results.get("levels", []))
        count = int(resume.record.settings.get("elements") or count)
    stuck = 0
    while True:
        try:
            solution = levels.solve(count, best is not None)
        except MemoryForecastError as refusal:
            if best is None:
                raise
            return _finish(run, best, estimate, f"the next mesh does not fit in memory: {refusal}")
        run.add(solution)
        if solution.stopped == "interrupted":
            reason = "out of time" if run.left < 0 else "interrupted"
            if best is None:
                return _finish(run, solution, _parts(solution, math.inf), reason)
            best.stopped = best.stopped if run.left < 0 else "interrupted"
            return _finish(run, best, estimate, reason)
        n = solution.mesh.element_count
        same = run.levels and n < LEAST_GROWTH * run.levels[-1]["elements"]
        if same and not isinstance(levels, _Links):
            # Clusters of facets come in steps: as good as the same mesh tells nothing.
            if stuck >= MOST_STUCK:
                # Links with nothing left to refine know what they are off.
                left = solution.record.errors.get("link_error_estimate", {}).get("total", math.inf)
                return _finish(run, solution, _parts(solution, left, run.scale), "no finer mesh can be made")
            stuck, count = stuck + 1, 2 * count
            continue
        start = time.perf_counter()
        difference, coarse = levels.compare(solution)
        best, stuck = solution, 0
        like = levels.like(solution)
        run.levels.append({"elements": n, "like": like, "coarse_like": coarse, "difference": difference})
        order = _order(run.levels)
        if len(run.levels) == 1 and run.target <= SEEN_TARGET:
            order = ORDER - ORDER_SPREAD
        if method == "hierarchical":
            order = min(order, LINK_ORDER)
        meshing = math.inf
        if difference == 0.0:
            meshing = 0.0
        elif difference is not None:
            meshing = difference / (max(like / coarse, LEAST_GROWTH) ** order - 1.0)
        estimate = _parts(solution, meshing, run.scale)
        now = time.perf_counter()
        run.spent["error estimate"] = run.spent.get("error estimate", 0.0) + now - start
        run.levels[-1] |= {"seconds": now - run.start} | estimate.as_dict()
        if estimate.total <= SAFE * run.target:
            return _finish(run, solution, estimate, "the estimate is below the target")
        if len(run.levels) >= MOST_LEVELS:
            return _finish(run, solution, estimate, f"{MOST_LEVELS} meshes did not reach the target")
        want = FIRST_GROWTH if not math.isfinite(meshing) else GROWTH[1]
        if run.target > 0 and math.isfinite(meshing):
            want = (meshing / (MESHING_SHARE * run.target)) ** (1.0 / order) * AMPLE
            if estimate.form_factors > 0.3 * run.target:
                run.care *= max(0.2 * run.target / estimate.form_factors, 0.1)
        want = min(max(want, GROWTH[0]), GROWTH[1])
        took = run.levels[-1]["seconds"] - (run.levels[-2]["seconds"] if len(run.levels) > 1 else 0.0)
        fits = (max(run.left, 0.0) / max(took, 1e-3)) ** (1.0 / COST_POWER)
        if fits < GROWTH[0]:
            return _finish(run, solution, estimate, "another mesh would not fit into the time")
        count = levels.finer(solution, min(want, max(fits, GROWTH[0])))
        if len(run.levels) == 1 and count < run.guess <= fits * n:
            count = math.ceil(run.guess)  # one small mesh tells whether the guess was too high, but hardly by how much
        if method == "matrix" and count > most_matrix_elements():
            count = most_matrix_elements()
            if count < GROWTH[0] * n:
                return _finish(run, solution, estimate, "a finer mesh does not fit in memory")
        levels.keep(solution, count)


def _improve_factors(scene: Scene, run: _Run, fixed: dict[str, Any], progress: Progress | None) -> Solution:
    """Solve one given mesh with better and better form factors.

    What formulas state of their own error is a bound.  A small mesh is solved once more than that asks:
    the difference tells more.
    """
    asked = min(0.2 * run.target, 0.02) if run.target > 0 else 0.02
    best: Solution | None = None
    estimate = ErrorEstimate(0.0, math.inf, 0.0, 0.0)
    while True:
        message = f"form factors to {asked:.2g}"
        solution = solve_once(
            scene,
            form_factor_error=asked,
            tolerance=min(0.1 * (run.target or 0.1), 0.01),
            progress=_watched(progress, run, message, best is not None),
            **fixed,
            **run.options,
        )
        run.add(solution)
        if solution.stopped == "interrupted" and best is not None:
            return _finish(run, best, estimate, "out of time" if run.left < 0 else "interrupted")
        estimate = _parts(solution, None)
        small = solution.mesh.element_count <= TWICE_ELEMENTS
        if best is not None and solution.mesh.element_count == best.mesh.element_count:
            difference = _relative_rms(
                solution.element_irradiance - best.element_irradiance, float(solution.mean_irradiance.mean())
            )
            if difference < estimate.form_factors or estimate.form_factors == 0.0:
                estimate = replace(estimate, form_factors=difference)
        run.levels.append({"elements": solution.mesh.element_count, "form_factor_error": asked} | estimate.as_dict())
        first, best = best is None, solution
        if solution.stopped == "interrupted":
            return _finish(run, solution, estimate, "interrupted")
        if estimate.total <= run.target and not (first and small):
            return _finish(run, solution, estimate, "the estimate is below the target; the mesh was given")
        took = (time.perf_counter() - run.start) / len(run.levels)
        if len(run.levels) >= MOST_TRIES or run.left < 2.0 * took:
            return _finish(run, solution, estimate, "better form factors would take too long")
        factor = 0.7 * run.target / estimate.total if run.target > 0 and estimate.total > 0 else 0.25
        asked = max(asked * min(0.3, factor), 1e-8)
