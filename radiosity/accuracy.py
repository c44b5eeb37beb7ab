"""The accuracy knob: ask for an error, get it, with its proof, from as small a mesh as will do.

The error of a solution is the area-weighted root mean square error of the irradiance over the
surfaces, divided by the area-weighted mean irradiance; the irradiance is what
``solution.irradiance(points, normals)`` answers, direct light found at the point and indirect light
gathered from the mesh.  It has four parts, each estimated on its own, and their sum is compared
with the target:

* *meshing*: the same points are asked under two meshes, and the difference is extrapolated
  (L. F. Richardson 1911) with the order at which it was seen to fall;
* *form factors* and *visibility*: the stated errors of what formulas and rays found, B F A by B F A;
* *convergence*: the bound residual / (1 - rho) on light that is still unshot.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radiosity.form_factors._sampling import place_on_pieces
from radiosity.patches import PatchMesh, build_mesh
from radiosity.sensors import Gatherer
from radiosity.solvers.solution import Checkpoint, Progress, ProgressEvent, Solution
from radiosity.solvers.solve import solve as solve_once
from workbench.counters import Counters
from workbench.errors import MemoryForecastError, OptionError
from workbench.scene.model import Scene

__all__ = ["ErrorEstimate", "solve", "surface_points"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

POINTS = 256
"""Points at which two meshes are compared."""
GATHER_RAYS = 1024
"""Rays a point for that comparison: the same rays each time, so that their own error cancels."""
NOISE, MOST_DRAWS = 0.004, 16
"""What one such comparison cannot tell from nothing, and the most that are averaged."""
ORDER = 0.9
"""Power of the number of elements with which the meshing error falls, until it has been seen to."""
ORDERS = (0.5, 1.5)
"""Orders that are believed when seen."""
FIRST_ELEMENTS = 1.5
"""Elements of the first mesh, over the asked error."""
LEAST_FIRST_ERROR = 0.001
BUDGET_ELEMENTS = 64
"""Most elements of the first mesh where time is limited: it is solved whatever it takes."""
MESHING_SHARE = 0.7
"""Share of the error that the mesh may take."""
LEAST_GROWTH, MOST_STUCK = 1.3, 8
"""Growth below which a mesh counts as the same, and how often the number asked for is doubled then."""
GROWTH = (2.5, 8.0)
"""Least and largest growth of the number of elements from mesh to mesh."""
COST_POWER = 1.7
"""Power of the number of elements with which the seconds grow."""
GATHERED = 5.0
"""Number of elements times the sum of squared form factors from a point to them: 1 in a sphere, 3 to 6 in rooms."""
MATRIX_POLYGONS = 2000
"""Scenes of at most so many polygons are solved with the full matrix."""
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
    seen: FloatArray | None = None
    counters: Counters = field(default_factory=Counters)
    spent: dict[str, float] = field(default_factory=dict)
    choices: dict[str, str] = field(default_factory=dict)

    @property
    def left(self) -> float:
        """Seconds left of the budget."""
        return self.seconds - (time.perf_counter() - self.start)

    def add(self, solution: Solution) -> None:
        self.counters.merge(solution.record.counters)
        for name, value in solution.record.seconds.items():
            self.spent[name] = self.spent.get(name, 0.0) + value


def _relative_rms(difference: FloatArray, mean: float) -> float:
    return math.sqrt(float(np.mean(difference**2))) / mean if mean > 0 else 0.0


def _parts(solution: Solution, meshing: float | None) -> ErrorEstimate:
    """The error's parts; without a meshing error, those of the irradiance of the elements themselves."""
    errors, mesh = solution.record.errors, solution.mesh
    share = 1.0
    if meshing is not None:
        # A point reads what elements reflect.  Their errors are independent, so variances count, weighted
        # by the squares of what the point sees of each; those sum to GATHERED / n.
        reflected = float(mesh.element_area @ mesh.reflectance.mean(axis=1) / mesh.element_area.sum())
        share = reflected * math.sqrt(min(GATHERED / mesh.element_count, 1.0))
    return ErrorEstimate(
        0.0 if meshing is None else meshing,
        share * float(errors.get("irradiance_form_factors_rms", 0.0)),
        share * float(errors.get("irradiance_visibility_rms", 0.0)),
        float(errors.get("remaining_bound", 0.0)),
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


def _order(levels: list[dict[str, Any]]) -> float:
    """The order at which the difference between meshes falls, as far as it can be told."""
    differences = [level["difference"] for level in levels if level["difference"] is not None]
    counts = [level["elements"] for level in levels]
    if len(differences) < 2 or min(differences[-2:]) <= 0:
        return ORDER
    # The difference of two meshes is about the error of the coarser one.
    slope = math.log(differences[-2] / differences[-1]) / math.log(counts[-2] / counts[-3])
    return min(max(slope, ORDERS[0]), ORDERS[1])


def solve(
    scene: Scene,
    *,
    error: float | None = None,
    budget_seconds: float | None = None,
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
    scene : Scene
        From :func:`workbench.load` or built in code.
    error : float, optional
        Wanted error, see :mod:`radiosity.accuracy`: root mean square over the surfaces, relative to
        the mean irradiance.  Meshes are refined until the estimate falls below it.  With ``elements``
        or ``max_edge`` the mesh is given, and the error is that of its elements' mean irradiance.
    budget_seconds : float, optional
        Instead or as well: stop refining when another mesh would not fit into this time.  The error
        reached stands in the record.
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
    fixed: dict[str, Any] = {"elements": elements, "max_edge": max_edge}
    if error is None and budget_seconds is None:
        return solve_once(scene, **fixed, progress=progress, checkpoint=checkpoint, resume=resume, **options)
    if error is not None and not 0 < error < 1:
        raise OptionError(f"error: found {error}, expected a number between 0 and 1")
    if budget_seconds is not None and not (math.isfinite(budget_seconds) and budget_seconds > 0):
        raise OptionError(f"budget_seconds: found {budget_seconds}, expected a positive number of seconds")
    for name in ("tolerance", "form_factor_error"):
        if options.pop(name, None) is not None:
            raise OptionError(f"{name} and error were both given; the error decides the {name.replace('_', ' ')}")
    run = _Run(
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
    record.errors["definition"] = "area-weighted RMS error of irradiance over the surfaces / mean irradiance"
    record.results["levels"] = run.levels
    record.results.pop("level_irradiance", None)
    reached = run.target > 0 and estimate.total <= run.target
    record.results["target_reached"] = reached
    record.choices |= run.choices | {"stop": reason}
    solution.converged = solution.converged and (reached or run.target == 0.0)
    return solution


def _first_error(run: _Run) -> float:
    """Error by which the first mesh is chosen; without a target, a rough one."""
    return run.target if run.target > 0 else 0.1


def _look(gatherer: Gatherer, where: tuple[FloatArray, FloatArray, IntArray], run: _Run) -> FloatArray:
    """Irradiance at the points, by the same rays for every mesh.

    Only what is gathered again at a few hits is drawn anew: for small targets the mean over several draws.
    """
    draws = min(max(round((NOISE / _first_error(run)) ** 2), 1), MOST_DRAWS)
    total = np.zeros((len(where[0]), gatherer.solution.mesh.bands))
    for seed in range(1, draws + 1):
        gatherer.seed = seed
        total += gatherer.irradiance(
            where[0], where[1], own_polygon=where[2], rays=GATHER_RAYS, error=max(_first_error(run), 1e-4)
        ).irradiance
    return total / draws


def _method(scene: Scene, run: _Run) -> str:
    """The solver for all meshes of a run."""
    asked = str(run.options.get("method", "auto"))
    if asked != "auto":
        return asked
    polygons = sum(surface.face_count for surface in scene.surfaces)
    if polygons <= MATRIX_POLYGONS:
        run.choices["method"] = f"matrix: {polygons} polygons, all form factors at once up to {MATRIX_POLYGONS}"
        return "matrix"
    run.choices["method"] = f"progressive: {polygons} polygons, whose small facets are clustered"
    return "progressive"


def _refine(
    scene: Scene, run: _Run, progress: Progress | None, checkpoint: Checkpoint | None, resume: Solution | None
) -> Solution:
    """Solve finer and finer meshes until two of them agree."""
    best: Solution | None = None
    gatherer: Gatherer | None = None
    where: tuple[FloatArray, FloatArray, IntArray] | None = None
    estimate = ErrorEstimate(math.inf, 0.0, 0.0, 0.0)
    count = max(16, round(FIRST_ELEMENTS / max(_first_error(run), LEAST_FIRST_ERROR)))
    if math.isfinite(run.seconds):
        count = min(count, BUDGET_ELEMENTS)
    method = _method(scene, run)
    stuck = 0
    unfinished = resume
    if resume is not None:
        run.levels = list(resume.record.results.get("levels", []))
        stored = resume.record.results.get("level_irradiance")
        run.seen = None if stored is None else np.asarray(stored)
        count = int(resume.record.settings.get("elements") or count)
    while True:
        # No finer than this mesh can be right.
        finest = max(run.target, 0.3 / count)
        options = run.options | {
            "method": method,
            "elements": count,
            "tolerance": min(0.1 * finest, 0.01),
            # Bundles state an error a form factor, the matrix one a row.
            "form_factor_error": min(0.5 * finest, 0.005) if method == "matrix" else min(2.0 * finest, 0.02),
        }
        message = f"mesh {len(run.levels) + 1}, about {count} elements"

        def keep(solution: Solution) -> None:
            assert checkpoint is not None
            solution.record.settings |= run.settings | {"elements": count}  # noqa: B023
            solution.record.results["levels"] = run.levels
            solution.record.results["level_irradiance"] = None if run.seen is None else run.seen.tolist()
            checkpoint(solution)

        try:
            solution = solve_once(
                scene,
                progress=_watched(progress, run, message, best is not None),
                checkpoint=None if checkpoint is None else keep,
                resume=unfinished,
                **options,
            )
        except MemoryForecastError as refusal:
            if best is None:
                raise
            return _finish(run, best, estimate, f"the next mesh does not fit in memory: {refusal}")
        unfinished = None
        run.add(solution)
        if solution.stopped == "interrupted":
            reason = "out of time" if run.left < 0 else "interrupted"
            if best is None:
                return _finish(run, solution, _parts(solution, math.inf), reason)
            best.stopped = best.stopped if run.left < 0 else "interrupted"
            return _finish(run, best, estimate, reason)
        n = solution.mesh.element_count
        if run.levels and n < LEAST_GROWTH * run.levels[-1]["elements"]:
            # Clusters of facets come in steps: as good as the same mesh tells nothing.
            if stuck >= MOST_STUCK:
                return _finish(run, solution, _parts(solution, math.inf), "no finer mesh can be made")
            stuck, count = stuck + 1, 2 * count
            continue
        begin = time.perf_counter()
        if gatherer is None:
            gatherer = Gatherer(solution, workers=run.options.get("workers"))
        else:
            gatherer = gatherer.reading(solution)
        if where is None:
            # Of the coarsest mesh, so that they do not depend on where a resumed run begins.
            where = surface_points(build_mesh(scene, gatherer.geometry), POINTS)
        seen = _look(gatherer, where, run)
        mean = float(solution.mean_irradiance.mean())
        difference = None if run.seen is None else _relative_rms(seen - run.seen, mean)
        run.seen = seen
        best, stuck = solution, 0
        run.levels.append({"elements": n, "difference": difference, "seconds": time.perf_counter() - run.start})
        order = _order(run.levels)
        meshing = math.inf
        if difference is not None:
            meshing = difference / ((n / run.levels[-2]["elements"]) ** order - 1.0)
        estimate = _parts(solution, meshing)
        run.levels[-1] |= estimate.as_dict()
        run.spent["error estimate"] = run.spent.get("error estimate", 0.0) + time.perf_counter() - begin
        if estimate.total <= run.target:
            return _finish(run, solution, estimate, "the estimate is below the target")
        if len(run.levels) >= MOST_LEVELS:
            return _finish(run, solution, estimate, f"{MOST_LEVELS} meshes did not reach the target")
        want = 3.0 if not math.isfinite(meshing) else GROWTH[1]
        if run.target > 0 and math.isfinite(meshing):
            want = (meshing / (MESHING_SHARE * run.target)) ** (1.0 / order) * 1.1
        want = min(max(want, GROWTH[0]), GROWTH[1])
        took = run.levels[-1]["seconds"] - (run.levels[-2]["seconds"] if len(run.levels) > 1 else 0.0)
        fits = (max(run.left, 0.0) / max(took, 1e-3)) ** (1.0 / COST_POWER)
        if fits < GROWTH[0]:
            return _finish(run, solution, estimate, "another mesh would not fit into the time")
        count = math.ceil(n * min(want, max(fits, GROWTH[0])))


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
