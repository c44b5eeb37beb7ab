"""Error against seconds: run techniques over their settings, keep a record that grows, chart it.

A record is a CSV file with one row a run.  Runs already in it are not run again, so a chart resumes
after an interruption and takes up new techniques and settings at their own cost.
"""

from __future__ import annotations

import csv
import gc
import hashlib
import io
import itertools
import math
import random
import resource
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numba.core import event

from radiosity.report.compiling import Compiling
from radiosity.report.metrics import at_error, frontier, relative_rms, slope
from radiosity.report.techniques import Problem, Reference, Technique
from radiosity.rivals import TITLES
from workbench.errors import InputError
from workbench.record import write_text_atomically
from workbench.scene.model import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

__all__ = [
    "COUNTS", "Comparison", "Point", "Run", "apart", "auto_ratios", "compare", "counted", "draw_chart", "measure",
    "points_of", "ranking", "read_runs", "scene_digest", "seconds_to", "write_runs",
]  # fmt: skip

COUNTS = (
    "rays", "tests", "voxels_stepped", "plane_vertex_checks", "shaft_tests", "closed_forms", "exact_cuts",
    "camera_polygons", "links", "shots",
)  # fmt: skip
"""Counts of work that a record keeps; ``tests`` are all tests of rays against polygons, boxes and spheres."""
ERRORS = (0.1, 0.03, 0.01, 0.003, 0.001)
"""Errors to which :func:`seconds_to` tells the seconds."""
SHORT = 0.1
"""A run of fewer seconds is short: its seconds are those of :data:`MORE` times as many runs."""
MORE = 5
SAME = 1.05
"""Medians that differ by less are the same: where things lie in memory moves the seconds of a process by so much
(T. Mytkowicz, A. Diwan, M. Hauswirth, P. F. Sweeney 2009), which no repeat within the process shows."""
MOST_COMPILED = 3
"""Times that one run is tried until nothing is compiled in it; what is compiled once is kept."""
LONE = 1.25
"""The same of a single run, whose spread nobody knows."""
_TESTS = ("polygon_tests", "box_tests", "bounding_sphere_tests", "sphere_tests")


@dataclass(frozen=True)
class Run:
    """One run: a row of the record.

    Parameters
    ----------
    method, kind, key : str
        Technique, its kind (ours, auto, rival) and what its setting is called.
    value : float
        The setting.
    seed, repeat : int
    seconds, cpu_seconds : float
        Wall-clock and processor time, all threads and child processes.
    prepare_seconds : float
        To load the scene into the technique, once; not part of ``seconds``.
    memory_MB : float
        Most memory that the run took beyond what was in use before; 0 where the system does not tell.
    error, error_standard_error : float
        See :func:`radiosity.report.metrics.relative_rms`.
    stated_error : float
        What the technique itself says; nan if it says nothing.
    rays ... shots : int
        See :data:`COUNTS`.
    """

    method: str
    kind: str
    key: str
    value: float
    seed: int
    repeat: int
    seconds: float
    cpu_seconds: float
    prepare_seconds: float
    memory_MB: float
    error: float
    error_standard_error: float
    stated_error: float
    rays: int = 0
    tests: int = 0
    voxels_stepped: int = 0
    plane_vertex_checks: int = 0
    shaft_tests: int = 0
    closed_forms: int = 0
    exact_cuts: int = 0
    camera_polygons: int = 0
    links: int = 0
    shots: int = 0

    @property
    def place(self) -> tuple[str, float, int, int]:
        """What tells runs of one record apart."""
        return self.method, self.value, self.seed, self.repeat


@dataclass(frozen=True)
class Point:
    """All runs of one technique at one setting, summed up.

    ``seconds`` is the median, ``quick`` and ``slow`` its spread: the fastest and the slowest run, of eight
    runs and more without the outermost eighth at each end.  ``error`` is the root mean square over the
    seeds, ``doubt`` its standard error.
    """

    method: str
    kind: str
    key: str
    value: float
    seconds: float
    quick: float
    slow: float
    cpu_seconds: float
    memory_MB: float
    error: float
    doubt: float
    stated: float
    runs: int
    counts: dict[str, int]


# ---- the record -----------------------------------------------------------------------------------


def write_runs(path: Path, runs: Sequence[Run]) -> None:
    """Write the record, whole or not at all, in the order of techniques, settings, seeds and repeats."""
    table = io.StringIO()
    names = [f.name for f in fields(Run)]
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(names)
    for run in runs:
        cells = (getattr(run, name) for name in names)
        writer.writerow([f"{cell:.9g}" if isinstance(cell, float) else cell for cell in cells])
    write_text_atomically(path, table.getvalue())


def read_runs(path: Path) -> list[Run]:
    """Read a record.

    Raises
    ------
    InputError
        If the file is no such record.
    """
    kinds = {f.name: {"str": str, "float": float, "int": int}[str(f.type)] for f in fields(Run)}
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream))
        return [Run(**{name: kind(row[name]) for name, kind in kinds.items()}) for row in rows]
    except (OSError, KeyError, TypeError, ValueError, UnicodeDecodeError) as problem:
        raise InputError(f"{path}: found no record of runs ({problem}); give another folder, or remove it") from None


def scene_digest(scene: Scene) -> str:
    """A name for what a scene holds: surfaces, materials, lights, camera and background."""
    made = hashlib.sha256()

    def add(value: Any) -> None:
        if isinstance(value, np.ndarray):
            made.update(f"{value.dtype}{value.shape}".encode())
            made.update(np.ascontiguousarray(value).tobytes())
        elif isinstance(value, (tuple, list)):
            for item in value:
                add(item)
        elif hasattr(value, "__dataclass_fields__"):
            for f in fields(value):
                if f.name not in ("path", "notes"):
                    add(getattr(value, f.name))
        else:
            made.update(repr(value).encode())

    add(scene)
    return made.hexdigest()[:16]


# ---- running ----------------------------------------------------------------------------------------


class _Memory:
    """Most resident memory since the beginning of the block, beyond what was resident then. [MB]"""

    used = 0.0

    def __enter__(self) -> _Memory:
        self._before = self._read("VmRSS")
        try:
            Path("/proc/self/clear_refs").write_text("5")  # the high-water mark begins anew
            self._fresh = True
        except OSError:
            self._fresh = False
        return self

    def __exit__(self, *_: object) -> None:
        if self._fresh:
            self.used = max(0.0, self._read("VmHWM") - self._before)

    @staticmethod
    def _read(name: str) -> float:
        try:
            for line in Path("/proc/self/status").read_text().splitlines():
                if line.startswith(name):
                    return int(line.split()[1]) / 1024.0
        except OSError:
            pass
        return 0.0


def _processor_seconds() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def counted(counters: Mapping[str, int]) -> dict[str, int]:
    """The counts of a record, from counters by their names."""
    counts = {name: int(counters.get(name, 0)) for name in COUNTS if name != "tests"}
    counts["tests"] = sum(int(counters.get(name, 0)) for name in _TESTS)
    return counts


def measure(
    problem: Problem,
    reference: Reference,
    plan: Sequence[tuple[str, Sequence[float] | None]],
    *,
    seeds: Sequence[int] = (0,),
    repeats: int = 3,
    limit: float = math.inf,
    longest: float | None = None,
    before: Iterable[Run] = (),
    save: Callable[[list[Run]], None] = lambda runs: None,
    report: Callable[[str], None] = lambda line: None,
) -> tuple[list[Run], list[str]]:
    """Run techniques over their settings, interleaved.

    Every technique runs its coarsest setting once in vain first: kernels are compiled and loaded
    then.  A run in which others had to be compiled is thrown away and done again.  In each round all settings of
    all techniques run one after the other, from the second round on in an order of chance (the same each time), so
    that a machine that slows down slows all alike and none always follows the same other.  Settings whose runs are
    short go on for :data:`MORE` times as many rounds: their spread is that of the machine's interruptions.  Garbage
    is collected before each run and not during it.

    Parameters
    ----------
    problem : Problem
    reference : Reference
    plan : sequence of (str, sequence of float or None)
        Techniques and their settings; ``None`` takes the technique's own.
    seeds : sequence of int
        A technique without chance runs with the first only.
    repeats : int
        Rounds with each seed; of 1, short runs have one, too.
    limit : float
        A setting whose first run took longer is not repeated. [s]
    longest : float, optional
        After a setting whose first run took longer, finer settings of the technique are left out; ``limit``
        by default. [s]
    before : iterable of Run
        Runs of an old record.
    save : callable
        Called with all runs after each one.
    report : callable
        Called with a line about each run, and about what is left out.

    Returns
    -------
    runs : list of Run
        Old and new ones, in the order of the plan.
    notes : list of str
        What was left out and why.
    """
    from workbench.errors import WorkbenchError

    known = {run.place: run for run in before}
    notes: list[str] = []
    judge = problem.judged(reference.values)
    variance = reference.variance
    if isinstance(variance, np.ndarray):
        variance = problem.judged(variance)
    made: dict[str, tuple[Technique, float]] = {}
    tasks: list[tuple[str, float]] = []
    for name, chosen in plan:
        start = time.perf_counter()
        try:
            technique = problem.technique(name)
            prepare = time.perf_counter() - start
            values = tuple(chosen) if chosen is not None else technique.values
            wanted = [(name, value, seed, r) for value in values for seed in seeds for r in range(repeats)]
            if not technique.seeded:
                wanted = [place for place in wanted if place[2] == seeds[0]]
            if any(place not in known for place in wanted):
                technique.ask(values[0], seeds[0])
        except WorkbenchError as problem_found:
            notes.append(f"{name} is left out: {problem_found}")
            report(notes[-1])
            continue
        made[name] = technique, prepare
        tasks += [(name, value) for value in values]
    finest: dict[str, int] = {}
    order = {name: [value for n, value in tasks if n == name] for name in made}
    longest = limit if longest is None else max(limit, longest)

    def run(place: tuple[str, float, int, int]) -> bool:
        """Run it unless its record is known; whether it could."""
        if place in known:
            return True
        name, value, seed, repeat = place
        technique, prepare = made[name]
        try:
            for _ in range(MOST_COMPILED):
                gc.collect()
                gc.disable()
                compiling = Compiling()
                with _Memory() as memory, event.install_listener("numba:compile", compiling):
                    used, start = _processor_seconds(), time.perf_counter()
                    answer = technique.ask(value, seed)
                    seconds, used = time.perf_counter() - start, _processor_seconds() - used
                gc.enable()
                if compiling.wall == 0.0:
                    break
                notes.append(
                    f"{name} at {technique.key} {value:g}: a run of {seconds:.2g} s was thrown away, in which kernels"
                    f" were compiled for {compiling.wall:.2g} s"
                )
                report(notes[-1])
            error, doubt = relative_rms(problem.judged(answer.values), judge, variance)
        except WorkbenchError as problem_found:
            notes.append(f"{name} at {technique.key} {value:g} is left out: {problem_found}")
            report(notes[-1])
            finest[name] = order[name].index(value) - 1
            return False
        finally:
            gc.enable()
        told = answer.stated() if callable(answer.stated) else answer.stated
        stated = math.nan if told is None else told
        known[place] = Run(
            name, technique.kind, technique.key, float(value), seed, repeat, seconds, used, prepare,
            memory.used, error, doubt, stated, **counted(answer.counters),
        )  # fmt: skip
        report(f"{name:20s} {technique.key} {value:<8g} seed {seed}: {seconds:8.3f} s, error {error:.2e}")
        save(list(known.values()))
        return True

    gc.collect()
    gc.freeze()  # what is there now stays: collecting before each run is quick then
    first = (seeds[0], 0)
    rounds = [(seed, repeat) for repeat in range(repeats * MORE if repeats > 1 else 1) for seed in seeds]
    for number, (seed, repeat) in enumerate(rounds):
        # Coarse to fine where settings may turn out too dear, then mixed.
        for name, value in tasks if number == 0 else random.Random(number).sample(tasks, len(tasks)):
            technique, _ = made[name]
            if (not technique.seeded and seed != seeds[0]) or order[name].index(value) > finest.get(name, 1 << 30):
                continue
            took = known[name, value, *first].seconds if number else 0.0
            if took > limit and longest > limit:
                continue
            if repeat >= repeats and min(known[name, value, seed, r].seconds for r in range(repeats)) >= SHORT:
                continue
            if not run((name, value, seed, repeat)):
                continue
            if number == 0 and known[name, value, *first].seconds > longest and order[name][-1] != value:
                finest[name] = order[name].index(value)
                left = order[name][finest[name] + 1 :]
                notes.append(
                    f"{name}: {technique.key} {', '.join(f'{v:g}' for v in left)} left out, since {value:g} took longer"
                    f" than {longest:g} s"
                )
                report(notes[-1])
    gc.unfreeze()
    runs = list(known.values())
    runs.sort(key=lambda run: (list(dict.fromkeys(r.method for r in known.values())).index(run.method), *run.place[1:]))
    return runs, notes


# ---- summing up -------------------------------------------------------------------------------------


def points_of(runs: Sequence[Run]) -> list[Point]:
    """One point a technique and setting, in the order of the runs."""
    groups: dict[tuple[str, float], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.method, run.value), []).append(run)
    points = []
    for (method, value), mine in groups.items():
        seconds = sorted(run.seconds for run in mine)
        outer = len(seconds) // 8
        by_seed = {run.seed: run for run in mine}
        squares = [run.error**2 for run in by_seed.values()]
        error = math.sqrt(statistics.fmean(squares))
        inner = math.sqrt(sum(run.error_standard_error**2 for run in by_seed.values())) / len(by_seed)
        between = 0.0
        if len(squares) > 1 and error > 0:
            between = statistics.stdev(squares) / math.sqrt(len(squares)) / (2.0 * error)
        first = mine[0]
        counts = {name: round(statistics.fmean(getattr(run, name) for run in by_seed.values())) for name in COUNTS}
        points.append(
            Point(
                method,
                first.kind,
                first.key,
                value,
                statistics.median(seconds),
                seconds[outer],
                seconds[-1 - outer],
                statistics.median(run.cpu_seconds for run in mine),
                max(run.memory_MB for run in mine),
                # Less than its own doubt is not known of an error, when a reference has noise to take off.
                max(error, inner, between),
                max(inner, between),
                statistics.fmean(run.stated_error for run in by_seed.values()),
                len(mine),
                counts,
            )
        )
    return points


def auto_ratios(points: Sequence[Point]) -> list[tuple[Point, float | None]]:
    """For each automatic point: its seconds over those of our best hand-tuned ones at the same error.

    ``None`` where no hand-tuned point is as exact: automatic choice is on its own there.
    """
    tuned = [p for p in points if p.kind == "ours"]
    found = []
    for point in points:
        if point.kind == "auto":
            best = at_error([p.seconds for p in tuned], [p.error for p in tuned], point.error)
            found.append((point, point.seconds / best if best else None))
    return found


def seconds_to(points: Sequence[Point], errors: Sequence[float] = ERRORS) -> list[dict[str, Any]]:
    """Seconds on the frontier of our own techniques, and on each rival's, to some errors.

    Returns
    -------
    list of dict
        A row an error: ``error_%``, ``ours`` [s], ``by`` (the technique of the next more exact point), and the
        seconds of each rival; ``None`` where no point got there.
    """
    families = {"ours": [p for p in points if p.kind != "rival"]}
    for point in points:
        if point.kind == "rival":
            families.setdefault(point.method, []).append(point)
    rows = []
    for error in errors:
        found = {n: at_error([p.seconds for p in f], [p.error for p in f], error) for n, f in families.items()}
        exact = [p for p in families["ours"] if p.error <= error]
        best = min(exact, key=lambda p: p.seconds, default=None)
        by = f"{best.method} ({best.key} {best.value:g})" if best is not None else None
        rows.append({"error_%": 100.0 * error, "ours": found.pop("ours"), "by": by, **found})
    return rows


def apart(a: Point, b: Point) -> bool:
    """Whether one of the two is faster beyond doubt: their spreads do not overlap, nor are their medians the same."""
    if a.seconds > b.seconds:
        a, b = b, a
    return a.slow < b.quick and a.seconds * (SAME if min(a.runs, b.runs) > 1 else LONE) < b.seconds


def ranking(points: Sequence[Point]) -> list[tuple[Point, list[Point]]]:
    """What nothing beats beyond the spread of the seconds, from fast to exact.

    A point is beaten where another makes no larger error and is faster beyond doubt (:func:`apart`).

    Returns
    -------
    list of (Point, list of Point)
        Each point with those of the list that it is tied with: nothing can be said of their order.
    """
    kept = [p for p in points if not any(q.error <= p.error and q.seconds < p.seconds and apart(p, q) for q in points)]
    kept.sort(key=lambda p: (p.seconds, p.error))
    return [(p, [q for q in kept if q is not p and not apart(p, q)]) for p in kept]


@dataclass(frozen=True)
class Comparison:
    """Two records of the same question, from :func:`compare`.

    Parameters
    ----------
    runs : int
        Runs that both have.
    counts, errors : list of str
        Those of our own whose counts, or whose error (by more than a millionth of itself), differ.
    frontier : int
        Settings in the :func:`ranking` of either record that both have.
    swapped, ties : list of str
        Pairs of them that stand in another order of seconds: apart in both records, and tied in one or both.
    """

    runs: int
    counts: list[str]
    errors: list[str]
    frontier: int
    swapped: list[str]
    ties: list[str]


def compare(before: Sequence[Run], after: Sequence[Run]) -> Comparison:
    """Whether a chart was reproduced: all counts and errors of our own, and the order of the frontier.

    Two points that are tied in either record (not :func:`apart`) have no order that could change.
    """
    known = {run.place: run for run in before}
    both = [(known[run.place], run) for run in after if run.place in known]
    counts: list[str] = []
    errors: list[str] = []
    for old, new in both:
        if new.kind == "rival":
            continue
        name = f"{new.method} {new.key} {new.value:g} seed {new.seed}"
        changed = [f"{c} {getattr(old, c)} -> {getattr(new, c)}" for c in COUNTS if getattr(old, c) != getattr(new, c)]
        if changed:
            counts.append(f"{name}: {', '.join(changed)}")
        if not math.isclose(old.error, new.error, rel_tol=1e-6, abs_tol=1e-12):
            errors.append(f"{name}: {old.error:.3e} -> {new.error:.3e}")
    first, second = ({(p.method, p.value): p for p in points_of(runs)} for runs in (before, after))
    best: dict[tuple[str, float], None] = {}
    for record in (first, second):
        best |= dict.fromkeys((p.method, p.value) for p, _ in ranking(list(record.values())))
    chosen = [place for place in best if place in first and place in second]
    swapped: list[str] = []
    ties: list[str] = []
    for a, b in itertools.combinations(chosen, 2):
        if (first[a].seconds - first[b].seconds) * (second[a].seconds - second[b].seconds) < 0:
            told = all(apart(record[a], record[b]) for record in (first, second))
            (swapped if told else ties).append(f"{a[0]} {a[1]:g} and {b[0]} {b[1]:g}")
    return Comparison(len(both), counts, errors, len(chosen), swapped, ties)


# ---- the figure -------------------------------------------------------------------------------------

_COLOURS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f3c8d", "#4d4d4d", "#80ba5a", "#a5694f",
    "#11a579", "#e73f74",
)  # fmt: skip
_MARKERS = "osD^vPX<>hp8"


def draw_chart(
    figure: Figure, points: Sequence[Point], *, title: str, label: str, floor: float = 0.0, noise: float = 0.0,
) -> None:  # fmt: skip
    """Error against seconds on logarithmic axes, into an empty figure.

    Ours are drawn in full lines, rivals in dashed ones with open markers, automatic choices as
    stars; the frontier of all is a broad grey line, and points that are tied with it (:func:`ranking`)
    have a grey ring.  Bars reach over the spread of the runs and over one standard error.  Below
    ``floor`` nothing can be told; ``noise`` is that of the reference, which has been taken off.
    """
    from matplotlib.container import ErrorbarContainer

    figure.set_size_inches(9.5, 6.2)
    axes = figure.subplots()
    axes.set_xscale("log")
    axes.set_yscale("log")
    shown = [p for p in points if p.seconds > 0]
    positive = [p.error for p in shown if p.error > 0]
    least = min(positive) if positive else 1e-6
    zero = max(least / 3.0, 1e-16)  # where points without any error are drawn

    def height(p: Point) -> float:
        return p.error if p.error > 0 else zero

    best = frontier([p.seconds for p in shown], [height(p) for p in shown])
    axes.plot(
        [shown[i].seconds for i in best], [height(shown[i]) for i in best], color="0.8", lw=9, zorder=1,
        solid_capstyle="round", solid_joinstyle="round", label="frontier: nothing is both faster and more exact",
    )  # fmt: skip
    drawn = {id(shown[i]) for i in best}
    tied = [p for p, _ in ranking(shown) if id(p) not in drawn]
    if tied:
        axes.plot(
            [p.seconds for p in tied], [height(p) for p in tied], ls="", marker="o", ms=17, mfc="none", mec="0.75",
            mew=2.5, zorder=1, label="as fast as the frontier, within the spread of the runs",
        )  # fmt: skip
    told: list[tuple[str, float, float, str]] = []
    for number, method in enumerate(dict.fromkeys(p.method for p in shown)):
        mine = [p for p in shown if p.method == method]
        kind = mine[0].kind
        # What chooses itself changes its ways between settings, and follows no power.
        steep = None if kind == "auto" else slope([p.seconds for p in mine], [p.error for p in mine])
        name = {
            "ours": method,
            "auto": f"{method} (chooses itself; numbers: error asked)",
            "rival": f"{TITLES.get(method, method)} (rival)",
        }[kind]
        text = name if steep is None else f"{name}, slope {steep:.2f}"
        colour = _COLOURS[number % len(_COLOURS)]
        marker = "*" if kind == "auto" else _MARKERS[number % len(_MARKERS)]
        x, y = [p.seconds for p in mine], [height(p) for p in mine]
        axes.errorbar(
            x, y,
            xerr=[[p.seconds - p.quick for p in mine], [p.slow - p.seconds for p in mine]],
            yerr=[[min(p.doubt, 0.9 * h) if p.error > 0 else 0.0 for p, h in zip(mine, y, strict=True)],
                  [p.doubt if p.error > 0 else 0.0 for p in mine]],
            color=colour, marker=marker, ms=14 if kind == "auto" else 7, mfc="none" if kind == "rival" else colour,
            mec="black" if kind == "auto" else colour, mew=0.8 if kind == "auto" else 1.4,
            ls="--" if kind == "rival" else "-", lw=1.4, elinewidth=0.8, capsize=2, label=text,
            zorder=4 if kind == "auto" else 3,
        )  # fmt: skip
        if kind == "auto":
            told += [(f"{p.value:g}", p.seconds, height(p), colour) for p in mine]
    if floor > 0:
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, 0.5 * floor), high)
        axes.axhspan(min(low, 0.5 * floor), floor, color="0.93", zorder=0, label="the reference tells nothing here")
    if noise > floor:
        axes.axhline(noise, color="0.5", lw=0.8, ls=":", label="noise of the reference, taken off")
    for share in (0.1, 0.01, 0.001):
        low, high = axes.get_ylim()
        if low < share < high:
            axes.axhline(share, color="0.75", lw=0.6, zorder=0)
            axes.annotate(
                f"{share:.0%}" if share >= 0.01 else f"{share:.1%}", (1.0, share), xycoords=("axes fraction", "data"),
                xytext=(-3, 2), textcoords="offset points", ha="right", fontsize=8, color="0.4",
            )  # fmt: skip
    if any(p.error == 0 for p in shown):
        axes.annotate(
            "no error at all", (1.0, zero), xycoords=("axes fraction", "data"), xytext=(-3, 4),
            textcoords="offset points", ha="right", fontsize=8, color="0.4",
        )  # fmt: skip
    _plain_ticks(axes.xaxis, *axes.get_xlim())
    axes.set_xlabel("seconds, median (bars: spread of the runs)")
    axes.set_ylabel(label)
    axes.set_title(title, fontsize=11)
    axes.grid(alpha=0.25, which="major")
    handles, texts = axes.get_legend_handles_labels()
    axes.legend(
        # Markers without bars, which would hide their form.
        [handle[0] if isinstance(handle, ErrorbarContainer) else handle for handle in handles], texts,
        fontsize=8, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False,
    )  # fmt: skip
    _tell(figure, axes, told, [(p.seconds, height(p)) for p in shown])


def _tell(
    figure: Figure, axes: Axes, told: Sequence[tuple[str, float, float, str]], marked: Sequence[tuple[float, float]]
) -> None:  # fmt: skip
    """Write texts beside points (x, y), in a colour, none over another or over a marked point.

    Points that lie on top of each other are told together, those for which there is no room not at all.
    """
    if not told:
        return
    figure.draw_without_rendering()  # the axes take their place
    scale = figure.dpi / 72.0
    at, marks = (axes.transData.transform(points) / scale for points in ([(x, y) for _, x, y, _ in told], marked))
    groups: list[list[int]] = []
    for i in range(len(told)):
        near = next((g for g in groups if math.dist(at[g[0]], at[i]) < 4.0 and told[g[0]][3] == told[i][3]), None)
        if near is None:
            groups.append([i])
        else:
            near.append(i)
    taken = [(x - 5.0, y - 5.0, x + 5.0, y + 5.0) for x, y in marks]
    taken.append((axes.bbox.x1 / scale, 0.0, math.inf, math.inf))  # the legend
    for group in groups:
        text, (x, y) = ", ".join(told[i][0] for i in group), at[group[0]]
        width, height = 5.5 * len(text), 8.0
        for right, up in ((7, 5), (7, -13), (-7 - width, 5), (-7 - width, -13), (8, -4), (-8 - width, -4)):
            box = (x + right, y + up, x + right + width, y + up + height)
            if not any(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken):
                taken.append(box)
                axes.annotate(
                    text, told[group[0]][1:3], xytext=(right, up), textcoords="offset points", fontsize=8,
                    color=told[group[0]][3],
                )  # fmt: skip
                break


def _plain_ticks(axis: Axis, low: float, high: float) -> None:
    """Seconds in plain numbers, with 2 and 5 between where decades are few."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    plain = FuncFormatter(lambda value, _: f"{value:g}")
    axis.set_major_formatter(plain)
    if high < 100.0 * low:
        axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
        axis.set_minor_formatter(plain)
    else:
        axis.set_minor_formatter(NullFormatter())
