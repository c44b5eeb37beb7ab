"""Why a solve does what it does: what the solver uses and leaves out, and what each decision saves.

Every saving is measured: the same question is asked again with one decision switched off, in interleaved
rounds.  The answers are compared with a better one, so that what a decision costs in accuracy stands
beside it.  A decision without which the same work is done, count by count, saves nothing here; it is
told as such and not timed against itself.  Processor time is bounded: work without a decision that takes
more than :data:`STOP` times as long is stopped and told as such, and what no time is left for is named.
"""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numba.core import event
from numpy.typing import NDArray

from radiosity.accuracy import solve, surface_points
from radiosity.form_factors.bundle import LinkSettings, ReceiverBundles
from radiosity.report.compiling import Compiling
from radiosity.report.metrics import relative_rms
from radiosity.sensors import Gatherer
from radiosity.solvers.solution import Solution
from radiosity.solvers.solve import _settings
from workbench.counters import Counters
from workbench.errors import WorkbenchError
from workbench.geometry.flat import Geometry
from workbench.scene.model import Scene
from workbench.shadow.lights import lights_of_scene
from workbench.shadow.occlusion import Shader

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Ablation", "Explanation", "draw_ablations", "explain"]

FloatArray = NDArray[np.float64]

PATCHES = 24
"""Patches whose form factors are found again with decisions switched off."""
POINTS = 512
"""Points at which shadows are found again."""
MOST_SAMPLES = 4096
"""Rays a point at which the search for as many as the error needs ends."""
MOST_DOUBLINGS = 2
STOP = 20.0
"""Times as long as the work itself after which work without a decision is stopped."""
BUDGET = 40.0
"""Processor seconds of all ablations, unless asked otherwise."""


@dataclass(frozen=True)
class Ablation:
    """One decision, and the same work without it.

    Parameters
    ----------
    part : str
        ``mesh``, ``form factors`` or ``shadows``.
    decision, without : str
        What is done, and what is done in its place.
    used, used_without : str
        What each of the two runs did, by its own record: never the same.
    seconds, seconds_without : tuple of float
        Of interleaved rounds, in their order.
    error, error_without : float
        Relative, against a better answer; nan where none is known.
    stopped : bool
        Whether the run without the decision was stopped: it takes longer than that.
    """

    part: str
    decision: str
    without: str
    used: str
    used_without: str
    seconds: tuple[float, ...]
    seconds_without: tuple[float, ...]
    error: float
    error_without: float
    stopped: bool = False

    @property
    def ratios(self) -> tuple[float, ...]:
        """How many times as long the work took without the decision, round by round."""
        return tuple(b / a for a, b in zip(self.seconds, self.seconds_without, strict=True))

    @property
    def ratio(self) -> float:
        """Their median."""
        return float(np.median(self.ratios))


@dataclass(frozen=True)
class _Outcome:
    """What a run answers, and what it did."""

    values: FloatArray
    used: str


def _did(counters: Mapping[str, int]) -> str:
    """The counts of a run that tell it from another."""
    names = ("rays", "exact_cuts", "closed_forms", "shaft_tests", "plane_vertex_checks", "links")
    return ", ".join(f"{counters.get(name, 0):,} {name.replace('_', ' ')}" for name in names if counters.get(name, 0))


class _Stopped(BaseException):
    """Raised where the time of a run is up; as Ctrl-C, no handler of errors takes it."""


class _Purse:
    """Processor seconds that are left."""

    def __init__(self, seconds: float, whole: _Purse | None = None) -> None:
        self.end = time.process_time() + seconds
        self.whole = whole

    def left(self, share: float = 1.0) -> float:
        """A share of what is left. [s]"""
        return max(0.0, share * (self.end - time.process_time()))

    def part(self, share: float) -> _Purse:
        """A purse of a share of what is left."""
        return _Purse(self.left(share), self)

    def give_back(self, seconds: float) -> None:
        """Count so many seconds that are past as not spent, here and in the purse that this one is part of."""
        self.end += seconds
        if self.whole is not None:
            self.whole.give_back(seconds)


@contextmanager
def _at_most(seconds: float, purse: _Purse) -> Iterator[Compiling]:
    """Stop the block once it took that much processor time, compiling left out: the purse gets that back.

    In a thread other than the main one nothing is stopped.
    """
    compiling = Compiling()
    limited = math.isfinite(seconds) and threading.current_thread() is threading.main_thread()
    end = time.process_time() + seconds
    over = False

    def stop(*_: object) -> None:
        if over:
            return
        left = end + compiling.so_far() - time.process_time()
        if left <= 0.0:
            raise _Stopped
        signal.setitimer(signal.ITIMER_PROF, max(left, 1e-3))

    with event.install_listener("numba:compile", compiling):
        if limited:
            before = signal.signal(signal.SIGPROF, stop)
            signal.setitimer(signal.ITIMER_PROF, max(seconds, 1e-3))
        try:
            yield compiling
        finally:
            over = True
            if limited:
                signal.setitimer(signal.ITIMER_PROF, 0.0)
                signal.signal(signal.SIGPROF, before)
            purse.give_back(compiling.processor)


def _ablate(
    found: Explanation, part: str, words: Mapping[str, tuple[str, str]], base: str,
    tasks: Mapping[str, Callable[[], _Outcome]], repeats: int, error: Callable[[FloatArray], float], purse: _Purse,
) -> None:  # fmt: skip
    """Run ``base`` and the task of each decision in interleaved rounds, and note what differs."""

    def timed(name: str, most: float = math.inf) -> tuple[float, float, _Outcome | None]:
        start, used = time.perf_counter(), time.process_time()
        try:
            with _at_most(most, purse) as compiling:
                answer: _Outcome | None = tasks[name]()
        except _Stopped:
            answer = None
        wall, processor = time.perf_counter() - start, time.process_time() - used
        return wall - compiling.wall, processor - compiling.processor, answer

    first, cost, answer = timed(base)
    assert answer is not None
    wrong = error(answer.values)
    seconds: dict[str, list[float]] = {base: [first]}
    ended: dict[str, _Outcome] = {}
    for name, (decision, without) in words.items():
        if purse.left() <= cost:
            found.facts.append(f"{part}: no time was left to do {without!r} in place of {decision!r}")
            continue
        try:
            took, used, other = timed(name, min(max(STOP * cost, 0.2), purse.left()))
        except WorkbenchError as problem:
            found.facts.append(f"{part}: {without!r} in place of {decision!r} is refused: {problem}")
            continue
        if other is None:
            found.ablations.append(
                Ablation(
                    part, decision, without, answer.used, "stopped", (first,), (took,), wrong, math.nan, stopped=True
                )
            )
        elif other.used == answer.used:
            found.facts.append(f"{part}: {decision!r} changes nothing here: {without!r} is the same work")
        else:
            seconds[name], ended[name] = [took], other
            cost += used
    for turn in range(1, repeats):
        if purse.left() < cost:
            break
        for name in list(seconds)[:: 1 if turn % 2 == 0 else -1]:
            seconds[name].append(timed(name)[0])
    for name, other in ended.items():
        found.ablations.append(
            Ablation(
                part, *words[name], answer.used, other.used, tuple(seconds[base]), tuple(seconds[name]), wrong,
                error(other.values),
            )
        )  # fmt: skip


@dataclass
class Explanation:
    """What :func:`explain` found: facts in words, ablations, and the solution that they are about."""

    solution: Solution
    facts: list[str] = field(default_factory=list)
    ablations: list[Ablation] = field(default_factory=list)


def explain(
    scene: Scene, *, error: float = 0.05, method: str = "auto", workers: int | None = None, seed: int = 0,
    repeats: int = 3, budget_seconds: float = BUDGET, report: Callable[[str], None] = lambda line: None,
) -> Explanation:  # fmt: skip
    """Solve a scene to an error, say how, and switch each decision off in turn.

    Parameters
    ----------
    scene : Scene
    error, method : float, str
        As in :func:`radiosity.solve`.
    workers : int, optional
    seed : int
    repeats : int
        Runs of each ablation, interleaved; fewer where the budget ends.
    budget_seconds : float
        Processor time of the ablations; the solve itself comes before.
    report : callable
        Called with a line before each part of the work.

    Raises
    ------
    InputError, OptionError, MemoryForecastError
        As :func:`radiosity.solve`.
    """
    report("solving ...")
    solution = solve(scene, error=error, method=method, workers=workers, seed=seed)
    found = Explanation(solution)
    geometry = Geometry.from_scene(scene)
    _mesh_facts(found, geometry, error)
    purse = _Purse(budget_seconds)
    if solution.record.settings["method"] in ("progressive", "direct"):  # of others, told with the meshes
        report("finding form factors with decisions switched off ...")
        _links(found, geometry, seed, repeats, purse.part(0.4))
    report("finding shadows with decisions switched off ...")
    points = surface_points(solution.mesh, POINTS, seed=3)
    _shadows(found, geometry, points, error, seed, repeats, workers, purse.part(0.4))
    report("solving other meshes ...")
    _meshes(found, points, error, seed, workers, repeats, purse)
    return found


# ---- what was done ----------------------------------------------------------------------------------


def _mesh_facts(found: Explanation, geometry: Geometry, error: float) -> None:
    solution, record = found.solution, found.solution.record
    mesh, estimate = solution.mesh, record.errors["estimate"]
    elements = np.bincount(mesh.element_surface, minlength=len(geometry.surface_name))
    sides = np.array([2 if material.two_sided else 1 for material in geometry.surface_material])
    polygons = np.bincount(geometry.polygon_surface, minlength=len(elements)) * sides
    whole = [name for name, e, p in zip(geometry.surface_name, elements, polygons, strict=True) if e == p]
    fewer = [name for name, e, p in zip(geometry.surface_name, elements, polygons, strict=True) if 0 < e < p]
    finest = np.argsort(-elements, kind="stable")[:3]
    method = record.choices.get("method", record.settings.get("method", ""))
    reached = "reached" if record.results["target_reached"] else "not reached"
    found.facts += [
        f"asked error {error:g}: {reached}, estimated {estimate['total']:.2g} (meshing {estimate['meshing']:.2g}, form"
        f" factors {estimate['form_factors']:.2g}, visibility {estimate['visibility']:.2g}, convergence"
        f" {estimate['convergence']:.2g}); stopped because {record.choices['stop']}",
        f"method: {method}",
        f"meshes tried: {', '.join(str(level['elements']) for level in record.results['levels'])} elements;"
        f" the last has {mesh.element_count:,} elements and {mesh.patch_count:,} shooting patches",
        f"most elements on {', '.join(f'{geometry.surface_name[i]!r} ({elements[i]})' for i in finest)}",
        f"surfaces not subdivided: {_listed(whole)}",
    ]
    spent = record.seconds
    whole_run = sum(spent.values())
    if whole_run > 0 and "error estimate" in spent:
        found.facts.append(f"the error estimate itself took {spent['error estimate'] / whole_run:.0%} of the seconds")
    if fewer:
        found.facts.append(f"surfaces with fewer elements than facets (clustered): {_listed(fewer)}")
    counts = record.counters
    checked = counts["shaft_tests"] + counts["plane_vertex_checks"]
    culled = counts["shaft_culls"] + counts["plane_vertex_culls"]
    found.facts.append(
        f"form factors: {counts['closed_forms']:,} closed forms, {counts['exact_cuts']:,} exact cuts,"
        f" {counts['rays']:,} rays; shafts and planes set aside {culled:,} of {checked:,} candidates"
        + (f" ({culled / checked:.0%})" if checked else "")
    )


def _listed(names: Sequence[str]) -> str:
    names = list(dict.fromkeys(names))
    if not names:
        return "none"
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


# ---- form factors -----------------------------------------------------------------------------------


def _links(found: Explanation, geometry: Geometry, seed: int, repeats: int, purse: _Purse) -> None:
    """Form factors to some patches: the brightest ones and an even choice of the rest."""
    mesh, record = found.solution.mesh, found.solution.record
    power = np.add.reduceat((mesh.emission * mesh.element_area[:, None]).sum(axis=1), mesh.patch_start[:-1])
    bright = np.argsort(-power, kind="stable")[: PATCHES // 4]
    even = np.linspace(0, mesh.patch_count - 1, PATCHES - len(bright)).astype(np.int64)
    chosen = np.unique(np.concatenate([bright, even]))
    asked = float(record.choices["form_factor_error"])
    rays = int(record.settings["rays"])
    used = _settings(asked, rays, seed, mesh.patch_count)
    workers = int(record.settings["workers"])

    def columns(settings: LinkSettings) -> _Outcome:
        bundles = ReceiverBundles(geometry, mesh, settings, workers)
        try:
            return _Outcome(bundles.columns(chosen).factor, _did(bundles.counters))
        finally:
            bundles.close()

    variants = {
        "used": used,
        "cut": replace(used, candidates=0),
        "rays": replace(used, candidates=40),
        "closed": replace(used, closed_forms=not used.closed_forms),
        "floor": replace(used, floor=1e-9),
        "error": _settings(min(asked / 10, 1e-3), rays, seed, mesh.patch_count),
    }
    columns(used)
    fine = _settings(min(asked / 30, 3e-4), rays * 16, seed + 1, mesh.patch_count)
    better = _better(found, "form factors", [partial(columns, fine)], purse)

    def error(values: FloatArray) -> float:
        if better is None:
            return math.nan
        where = better > 0
        return relative_rms(values[where][:, None], better[where][:, None])[0]

    words = {
        "cut": ("short lists of candidates are cut exactly", "rays for all"),
        "rays": (f"more than {used.candidates} candidates get rays", "up to 40 are cut exactly"),
        "closed": ("closed forms for near pairs only", "closed forms for all that is clear")
        if not used.closed_forms
        else ("closed forms for all that is clear", "closed forms for near pairs only"),
        "floor": ("faint form factors get less care", "all get the same"),
        "error": (f"form factors to {asked:g}, as the error needs", f"form factors to {min(asked / 10, 1e-3):g}"),
    }
    tasks = {name: partial(columns, settings) for name, settings in variants.items()}
    _ablate(found, "form factors", words, "used", tasks, repeats, error, purse)


def _better(found: Explanation, part: str, tasks: Sequence[Callable[[], _Outcome]], purse: _Purse) -> FloatArray | None:
    """The first of some answers, best first, that takes less than a third of the time."""
    for task in tasks:
        try:
            with _at_most(purse.left(0.35), purse):
                return task().values
        except (_Stopped, WorkbenchError):
            continue
    found.facts.append(f"{part}: a better answer takes too long here; errors are not told")
    return None


# ---- shadows ----------------------------------------------------------------------------------------


def _shadows(
    found: Explanation, geometry: Geometry, where: tuple[Any, Any, Any], error: float, seed: int, repeats: int,
    workers: int | None, purse: _Purse,
) -> None:  # fmt: skip
    """Direct light at points: automatic, and with cullers, exact cuts or the smooth fit switched off."""
    scene = found.solution.scene
    lights = list(lights_of_scene(scene, geometry))
    if not lights:
        found.facts.append("lights: none but the background, which rays gather")
        return
    shader = Shader(geometry, workers)
    points, normals, own = where

    def ask(method: str, samples: int = 64) -> Any:
        return shader.estimate(
            points, normals, lights, method, error=error, samples=samples, seed=seed, own_polygon=own
        )  # fmt: skip

    exact = None
    while exact is None:
        try:
            with _at_most(purse.left(0.3), purse):
                exact = ask("exact").irradiance
        except _Stopped:
            if len(points) <= POINTS // 16:
                found.facts.append("shadows: exact cuts take too long here; nothing is told of them")
                return
            points, normals, own = points[::4], normals[::4], own[::4]
    if not exact.any():
        found.facts.append("lights: none reaches a surface directly")
        return

    def off(estimate: Any) -> float:
        return relative_rms(estimate.irradiance, exact)[0]

    automatic = ask("auto")
    goal = max(error, off(automatic))
    _light_facts(found, lights, automatic)

    def outcome(method: str, samples: int) -> _Outcome:
        estimate = ask(method, samples)
        return _Outcome(estimate.irradiance, _did(estimate.counters))

    tasks: dict[str, Callable[[], _Outcome]] = {
        "auto": partial(outcome, "auto", 64),
        "exact": partial(outcome, "exact", 64),
    }
    needed: dict[str, int] = {}
    for method in ("rays", "shaft"):
        samples = 4
        try:
            with _at_most(purse.left(0.2), purse):
                while samples < MOST_SAMPLES and off(ask(method, samples)) > goal:
                    samples *= 2
        except _Stopped:
            pass  # with so many it takes long enough to tell
        needed[method] = samples
        tasks[method] = partial(outcome, method, samples)
    words = {
        "rays": ("cullers settle what is clear or dark", f"{needed['rays']} rays at every point"),
        "shaft": (
            "as many rays as the error asks, where a fit needs them",
            f"{needed['shaft']} at every crowded point",
        ),
        "exact": ("rays where candidates are many", "exact cuts everywhere"),
    }
    _ablate(found, "shadows", words, "auto", tasks, repeats, lambda values: relative_rms(values, exact)[0], purse)


def _light_facts(found: Explanation, lights: Sequence[Any], estimate: Any) -> None:
    states = np.asarray(estimate.state)
    reached = np.asarray(estimate.open_share) > 0
    exact: list[str] = []
    sampled: list[str] = []
    for index, light in enumerate(lights):
        rays = (np.asarray(estimate.candidates)[:, index] > 12) & (states[:, index] == 2)
        (sampled if rays.any() else exact).append(light.name)
    count = max(int(reached.sum()), 1)
    clear, dark, rest = (float(((states == k) & reached).sum()) / count for k in range(3))
    found.facts += [
        f"lights without noise (closed forms and exact cuts): {_listed(exact)}; sampled where crowded:"
        f" {_listed(sampled)}",
        f"points that a light may reach: {clear:.0%} see it whole, {dark:.0%} not at all, {rest:.0%} in part; "
        f"{estimate.counters['rays'] / len(states):.2g} rays a point",
    ]


# ---- meshes -----------------------------------------------------------------------------------------


def _meshes(
    found: Explanation, where: tuple[Any, Any, Any], error: float, seed: int, workers: int | None, repeats: int,
    purse: _Purse,
) -> None:  # fmt: skip
    """A solve of that many elements and a gather from it, whole, with decisions switched off."""
    from radiosity.element_lookup import ElementLookup

    points, normals, polygons = where
    final = found.solution
    count, method = final.mesh.element_count, str(final.record.settings["method"])
    asked = float(final.record.settings["form_factor_error"] or 0.02)
    settings = {name: final.record.settings[name] for name in ("method", "rays", "tolerance", "seed")} | {
        "workers": workers, "form_factor_error": asked,
    }  # fmt: skip
    flat = polygons >= 0

    def solved(elements: int, other: dict[str, Any]) -> Solution:
        return solve(final.scene, elements=elements, **(settings | other))

    def said(solution: Solution, counters: Mapping[str, int], how: str) -> str:
        used, n = solution.record.settings, solution.mesh.element_count
        exactness = f"form factors to {used['form_factor_error']:g}"
        return f"{used['method']}, {n:,} elements, {exactness}, {how}; {_did(counters)}"

    def gathered(elements: int = count, **other: Any) -> _Outcome:
        solution = solved(elements, other)
        sensed = Gatherer(solution, workers=workers, seed=seed).irradiance(
            points, normals, own_polygon=polygons, error=0.3 * error
        )
        counters = Counters()
        counters.merge(solution.record.counters)
        counters.merge(sensed.counters)
        return _Outcome(sensed.irradiance[flat], said(solution, counters, "gathered"))

    def read(elements: int) -> _Outcome:
        solution = solved(elements, {})
        lookup = ElementLookup.build(Geometry.from_scene(solution.scene), solution.mesh)
        element = lookup.elements(points[flat], polygons[flat], np.ones(int(flat.sum()), dtype=bool))
        return _Outcome(solution.element_irradiance[element], said(solution, solution.record.counters, "read off"))

    finer = [partial(gathered, many * count, form_factor_error=asked / 10) for many in (4, 2)]
    better = _better(found, "mesh", finer, purse)

    def off(values: FloatArray) -> float:
        return relative_rms(values, better)[0] if better is not None else math.nan

    elements = count
    try:
        with _at_most(purse.left(0.3), purse):
            goal = max(error, off(gathered().values)) if better is not None else math.inf
            for _ in range(MOST_DOUBLINGS):
                if off(read(elements).values) <= goal:
                    break
                elements *= 2
    except _Stopped:
        pass  # of so many it takes long enough to tell
    tasks: dict[str, Callable[[], _Outcome]] = {
        "used": gathered, "finer": partial(gathered, 2 * count), "read": partial(read, elements),
    }  # fmt: skip
    words = {
        "finer": (f"about {count:,} elements are enough", f"about {2 * count:,} elements"),
        "read": ("direct light is found at the point", f"read off about {elements:,} elements"),
    }
    rest = purse.part(0.5)
    _ablate(found, "mesh", words, "used", tasks, repeats, off, rest)
    if method == "hierarchical":
        tasks["columns"] = partial(gathered, method="progressive", form_factor_error=min(2.0 * error, 0.02))
        words = {"columns": ("links, as coarse as the error allows", "column by column, from each receiver")}
        _ablate(found, "form factors", words, "used", tasks, repeats, off, purse)
    if method == "matrix":
        tasks["columns"] = partial(gathered, method="progressive", form_factor_error=min(2.0 * error, 0.02))
        tasks["better"] = partial(gathered, form_factor_error=asked / 10)
        words = {
            "columns": ("all form factors at once, pairs settled in groups", "column by column, from each receiver"),
            "better": (f"form factors to {asked:g}, as the error needs", f"form factors to {asked / 10:g}"),
        }
        _ablate(found, "form factors", words, "used", tasks, repeats, off, purse)


# ---- the figure -------------------------------------------------------------------------------------


def draw_ablations(figure: Figure, ablations: Sequence[Ablation], title: str) -> None:
    """How many times as long the work takes without each decision, into an empty figure."""
    figure.set_size_inches(10.0, 1.5 + 0.52 * len(ablations))
    axes = figure.subplots()
    colours = {"mesh": "#009e73", "form factors": "#0072b2", "shadows": "#e69f00"}
    ordered = sorted(ablations, key=lambda item: (list(colours).index(item.part), -item.ratio))
    place = np.arange(len(ordered))
    ratios = [item.ratio for item in ordered]
    bars = axes.barh(
        place, [r - 1.0 for r in ratios], left=1.0, color=[colours[item.part] for item in ordered], height=0.6
    )
    for bar, item in zip(bars, ordered, strict=True):
        bar.set(hatch="///" if item.stopped else None, edgecolor="white")
    axes.axvline(1.0, color="0.3", lw=0.8)
    axes.set_xscale("log")
    spread = [r for item in ordered for r in item.ratios]
    low, high = min(0.5, *spread), max(2.0, *spread)
    axes.set_xlim(low / 1.6, high * 40.0)
    for row, item in enumerate(ordered):
        least, most = min(item.ratios), max(item.ratios)
        axes.plot([least, most], [row, row], color="0.2", lw=1.2, marker="|", ms=6)
        text = f"more than x {item.ratio:,.0f}: stopped" if item.stopped else f"x {item.ratio:.2g}"
        if len(item.ratios) > 1:
            text += f" ({least:.2g} to {most:.2g})"
        if math.isfinite(item.error_without):
            text += f";  error {item.error:.2%} -> {item.error_without:.2%}"
        axes.text(max(most, 1.0) * 1.08, row, text, va="center", fontsize=8)
    axes.set_yticks(place, [f"{item.decision}\nwithout: {item.without}" for item in ordered], fontsize=8)
    axes.invert_yaxis()
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlabel("times as long without the decision (median and range of rounds; below 1 it does not pay here)")
    axes.set_title(title, fontsize=11)
    axes.grid(axis="x", alpha=0.25)
    handles = [figure_patch(colour, part) for part, colour in colours.items()]
    axes.legend(handles=handles, fontsize=8, loc="lower right")


def figure_patch(colour: str, label: str) -> Any:
    """A key of the legend."""
    from matplotlib.patches import Patch

    return Patch(facecolor=colour, label=label)
