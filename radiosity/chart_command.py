"""The command ``radiosity chart``: error against seconds, technique by technique, rivals on the same axes.

Only ``click`` is imported at the top; everything heavy is imported when the command runs.
"""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from radiosity.shadow_command import GridSize
from workbench.errors import InputError, OptionError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from radiosity.report.speed_accuracy import Point, Run
    from radiosity.report.techniques import Problem, Reference
    from workbench.scene.model import Scene

__all__ = ["chart"]

WHAT = ("shadows", "viewfactors", "solve", "render", "picture")
LIMIT = 5.0
"""Seconds of a run after which finer settings of its technique are left out, unless asked otherwise."""


@click.command()
@click.argument("scene")
@click.option("--what", type=click.Choice(WHAT), default="shadows", show_default=True, help="The question, see below.")
@click.option("--methods", metavar="A,B,...", help="Techniques.  [default: all that can run here, rivals too]")
@click.option(
    "--sweep",
    "sweeps",
    multiple=True,
    metavar="KEY=V1,V2,...",
    help="Settings of a technique or of all that share KEY.",
)
@click.option(
    "--reference", metavar="R", help="exact, converged, RIVAL, RIVAL:SAMPLES or FILE.npy.  [default: as exact as known]"
)
@click.option(
    "--repeats",
    type=click.IntRange(1, 1000),
    default=3,
    show_default=True,
    metavar="N",
    help="Runs of each; five times as many where one takes less than 0.1 s.",
)
@click.option("--seeds", type=click.IntRange(1, 1000), default=1, show_default=True, metavar="N", help="Seeds, from 0.")
@click.option(
    "--limit",
    type=click.FloatRange(min=0, min_open=True),
    default=LIMIT,
    show_default=True,
    metavar="S",
    help="Leave out finer settings once a run took longer.  [seconds]",
)
@click.option(
    "--longest",
    type=click.FloatRange(min=0, min_open=True),
    metavar="S",
    help="Go on to runs of so long; those beyond --limit run once.  [seconds]",
)
@click.option("--grid", type=GridSize(), help="shadows: points on the surface.  [default: 48x48]")
@click.option("--surface", metavar="NAME", help="shadows: that surface.  [default: the largest that faces up]")
@click.option("--points", type=click.IntRange(2, 1 << 20), metavar="N", help="solve: points.  [default: 256]")
@click.option("--width", type=click.IntRange(4, 4096), metavar="PIXELS", help="render, picture: across.  [default: 96]")
@click.option("--workers", type=click.IntRange(1, 1024), metavar="N", help="Threads.  [default: all cores]")
@click.option("--compare", type=click.Path(path_type=Path), metavar="DIR", help="Another folder's chart of the same.")
@click.option("-o", "--output", "directory", type=click.Path(path_type=Path), required=True, metavar="DIR")
def chart(
    scene: str,
    what: str,
    methods: str | None,
    sweeps: tuple[str, ...],
    reference: str | None,
    repeats: int,
    seeds: int,
    limit: float,
    longest: float | None,
    grid: tuple[int, int] | None,
    surface: str | None,
    points: int | None,
    width: int | None,
    workers: int | None,
    compare: Path | None,
    directory: Path,
) -> None:
    """Chart error against seconds for techniques that answer one question to SCENE.

    SCENE is a scene file, the name of a built-in scene, or woo-tori (Woo 1993: five tori of 5,761
    polygons under a square light).  --what is

    \b
    shadows      direct light at a grid of points on a surface
    viewfactors  form factors between all polygons
    solve        light at points on all surfaces after all reflections
    render       a picture of the direct light
    picture      a picture of all the light

    DIR gets records.csv (a row a run), chart.svg, chart.png, report.html and record.json.  Runs that
    DIR already holds are not run again: an interrupted chart goes on, and new techniques or settings
    join an old record.  Rivals (mitsuba, radiance, pyviewfactor, trimesh) are left out with a reason
    where they are not installed.  Lamps reflect nothing, in all techniques.

    Seconds are medians, with the spread of the runs; medians whose spreads overlap, or that differ by
    less than 5 % (of single runs 25 %), are tied: nothing is said of their order.  --compare tells
    whether another chart was reproduced: all counts and errors of our own exactly, and the order of all
    on the frontier that are not tied.  The exit code is 1 if not.
    """
    from workbench.record import check_folder

    check_folder(directory)
    import workbench
    from radiosity.report.speed_accuracy import measure, read_runs, scene_digest, write_runs
    from radiosity.report.techniques import problem_for

    loaded = _scene(scene)
    for note in loaded.notes:
        click.echo(f"note: {note}", err=True)
    options: dict[str, Any] = {"workers": workers}
    given = {"grid": grid, "surface": surface, "points": points, "width": width}
    belongs = {"shadows": ("grid", "surface"), "solve": ("points",), "render": ("width",), "picture": ("width",)}.get(
        what, ()
    )
    for name, value in given.items():
        if value is not None:
            if name not in belongs:
                raise OptionError(f"--{name}: found it with --what {what}, which has none; leave it out")
            options[name] = value
    problem = problem_for(what, loaded, **options)
    names = _split(methods) if methods else list(problem.names())
    for name in names:
        if name not in problem.names():
            raise OptionError(f"--methods: found {name!r}, expected one or more of {', '.join(problem.names())}")
    chosen = _sweeps(sweeps)
    kind = reference or problem.default_reference
    told = {"scene": scene_digest(loaded), "what": what, "title": f"{loaded.name}: {problem.title}", "reference": kind}
    _same_record(directory, told)
    earlier = _earlier(compare, told) if compare is not None else None
    directory.mkdir(parents=True, exist_ok=True)
    if not (directory / "record.json").exists():  # at once: an interrupted chart goes on from its runs
        from workbench.record import RunRecord

        RunRecord("chart", settings=told | {"asked reference": kind}).write(directory / "record.json")
    judge = _reference(problem, kind, directory)
    record = directory / "records.csv"
    before = read_runs(record) if record.exists() else []
    plan = [(name, _values(problem, name, chosen)) for name in names]
    unused = set(chosen) - {key for name in names for key in (name, _key(problem, name))}
    if unused:
        raise OptionError(f"--sweep: found {sorted(unused)[0]!r}, expected a technique or one of its settings")
    runs, notes = measure(
        problem, judge, plan, seeds=range(seeds), repeats=repeats, limit=limit, longest=longest,
        before=before,
        save=lambda found: write_runs(record, found), report=lambda line: click.echo(line, err=True),
    )  # fmt: skip
    if not runs:
        raise InputError("chart: found no technique that can run; " + "; ".join(notes))
    write_runs(record, runs)
    settings = told | {
        "scene file": scene, "reference": judge.name, "asked reference": kind, "repeats": repeats,
        "seeds": seeds, "limit [s]": limit, "longest [s]": longest, "workers": problem.workers,
        "command": "radiosity chart",
    }  # fmt: skip
    for path in _write_report(directory, problem, judge, runs, notes, settings, workbench.__version__):
        click.echo(str(path))
    if earlier is not None and not _reproduced(earlier, runs):
        raise SystemExit(1)


# ---- what was asked ---------------------------------------------------------------------------------


def _scene(name: str) -> Scene:
    """A scene file, a built-in scene, or the scene of a study."""
    if name == "woo-tori":
        return tori_under_square_light()
    import workbench

    return workbench.load(name)


def tori_under_square_light() -> Scene:
    """Woo's tori with a square light of side 2 and radiance 100 in the place of his point light."""
    from dataclasses import replace

    import numpy as np

    from workbench.scene.library import diffuse
    from workbench.scene.model import Surface
    from workbench.study.tori import LIGHT, tori_scene

    scene = tori_scene()
    down = -LIGHT / np.linalg.norm(LIGHT)
    across = np.cross(down, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    along = np.cross(down, across)
    square = np.array([LIGHT + a * across + b * along for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    lamp = Surface.from_polygons("light", diffuse("light", 0.0, 100.0 * np.pi), [square])
    return replace(scene, surfaces=(*scene.surfaces, lamp), name="tori")


def _split(text: str) -> list[str]:
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def _sweeps(given: Sequence[str]) -> dict[str, tuple[float, ...]]:
    """Settings by technique or key."""
    found: dict[str, tuple[float, ...]] = {}
    for text in given:
        key, equals, values = text.partition("=")
        try:
            numbers = tuple(float(value) for value in values.split(","))
        except ValueError:
            numbers = ()
        if not equals or not numbers or not all(0 < number < 1e12 for number in numbers):
            raise OptionError(f"--sweep: found {text!r}, expected KEY=V1,V2,... with positive numbers")
        found[key.strip()] = numbers
    return found


def _key(problem: Problem, name: str) -> str:
    """What the setting of a technique is called, without making the technique where that is dear."""
    try:
        return problem.technique(name).key
    except InputError:
        return ""


def _values(problem: Problem, name: str, chosen: dict[str, tuple[float, ...]]) -> tuple[float, ...] | None:
    if name in chosen or not chosen:
        return chosen.get(name)
    return chosen.get(_key(problem, name))


# ---- the folder -------------------------------------------------------------------------------------


def _same_record(directory: Path, told: dict[str, Any]) -> None:
    """Refuse to add runs of one question to the record of another."""
    path = directory / "record.json"
    if not path.exists():
        if (directory / "records.csv").exists():
            raise InputError(f"{directory}: found records.csv without record.json; give another folder")
        return
    try:
        before = json.loads(path.read_text(encoding="utf-8"))["settings"]
        changed = [name for name, value in told.items() if name != "reference" and before[name] != value]
        changed += ["reference"] if before["asked reference"] != told["reference"] else []
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path}: found no record of a chart; give another folder") from None
    if changed:
        raise InputError(f"{directory}: holds a record with another {changed[0]}; give another folder with -o")


def _earlier(directory: Path, told: dict[str, Any]) -> list[Run]:
    """Runs of another folder, if it holds the same question."""
    from radiosity.report.speed_accuracy import read_runs

    if not (directory / "records.csv").exists():
        raise InputError(f"{directory}: found no records.csv; give the folder of a chart with --compare")
    _same_record(directory, told)
    return read_runs(directory / "records.csv")


def _reproduced(earlier: list[Run], runs: list[Run]) -> bool:
    """Say what differs between two records."""
    from radiosity.report.speed_accuracy import compare

    found = compare(earlier, runs)
    click.echo(f"compared: {found.runs} runs that both have")
    for what, differing in (("counts", found.counts), ("errors", found.errors)):
        click.echo(f"{what} of our own: {f'{len(differing)} differ' if differing else 'all equal'}")
        for line in differing:
            click.echo(f"- {line}")
    click.echo(
        f"order of the frontier ({found.frontier} settings): {len(found.swapped) or 'no'} pairs swapped,"
        f" {len(found.ties)} tied ones the other way round"
    )
    for line in (*found.swapped, *(f"{pair}: tied" for pair in found.ties)):
        click.echo(f"- {line}")
    return found.runs > 0 and not (found.counts or found.errors or found.swapped)


def _reference(problem: Problem, kind: str, directory: Path) -> Reference:
    """The reference, kept in the folder."""
    import numpy as np

    from radiosity.report.techniques import Reference

    kept = directory / "reference.npz"
    if kept.exists():
        with np.load(kept, allow_pickle=False) as stored:
            return Reference(str(stored["name"]), stored["values"], stored["variance"], float(stored["error"]))
    if kind.endswith(".npy"):
        try:
            judge = Reference(kind, np.load(kind, allow_pickle=False).astype(float))
        except (OSError, ValueError) as problem_found:
            raise InputError(f"{kind}: cannot be read as an array: {problem_found}") from None
    else:
        click.echo("finding the reference ...", err=True)
        judge = problem.reference(kind)
    beside = directory / f".reference.{os.getpid()}.part.npz"
    np.savez(beside, name=judge.name, values=judge.values, variance=np.asarray(judge.variance), error=judge.error)
    beside.replace(kept)
    return judge


def _write_report(
    directory: Path, problem: Problem, judge: Reference, runs: list[Any], notes: list[str], settings: dict[str, Any],
    version: str,
) -> list[Path]:  # fmt: skip
    """Chart, page and record."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from radiosity.report.page import html_page
    from radiosity.report.speed_accuracy import auto_ratios, draw_chart, points_of, ranking, seconds_to
    from workbench.record import RunRecord, write_text_atomically
    from workbench.study.result import format_table

    points = points_of(runs)
    record = RunRecord("chart", settings=settings)
    machine = record.machine
    title = f"{settings['title']}\nerror against {judge.name}; {machine['processor']}, {problem.workers} threads"
    floor = problem.floor(judge)
    figure = Figure(layout="constrained")
    FigureCanvasAgg(figure)
    draw_chart(figure, points, title=title, label=problem.error_label, floor=floor, noise=judge.error)
    drawn = io.StringIO()
    with rc_context({"svg.hashsalt": "radiosity", "svg.fonttype": "none"}):
        figure.savefig(drawn, format="svg", bbox_inches="tight", metadata={"Date": None})
    write_text_atomically(directory / "chart.svg", drawn.getvalue())
    beside = directory / f".chart.{os.getpid()}.part"
    figure.savefig(beside, format="png", dpi=110, bbox_inches="tight")
    beside.replace(directory / "chart.png")
    ratios = {(p.method, p.value): ratio for p, ratio in auto_ratios(points)}
    rows = [_row(point, ratios) for point in points]
    click.echo(f"{settings['title']}\nerrors against {judge.name}\n\n{format_table(rows)}\n")
    reached = seconds_to(points)
    click.echo(f"Seconds to an error, on the frontier of ours and of each rival:\n\n{format_table(reached)}\n")
    order = [_place(number, *place) for number, place in enumerate(ranking(points), 1)]
    click.echo(f"What nothing beats beyond the spread of the runs, from fast to exact:\n\n{format_table(order)}\n")
    for note in notes:
        click.echo(f"- {note}")
    tables = {
        "Seconds to an error": [{k: _text(v) for k, v in row.items()} for row in reached],
        "What nothing beats beyond the spread of the runs, from fast to exact": [
            {k: _text(v) for k, v in row.items()} for row in order
        ],
        "Settings and what they cost": [{k: _text(v) for k, v in row.items()} for row in rows],
    }
    facts = (
        settings
        | {f"machine: {k}": v for k, v in machine.items()}
        | {f"version: {k}": v for k, v in record.versions.items()}
    )
    facts["the reference tells errors from"] = f"{floor:.2g}"
    facts["noise of the reference, taken off" if floor < judge.error else "error of the reference"] = (
        f"{judge.error:.2g}"
    )
    page = html_page(settings["title"], drawn.getvalue(), tables, notes, facts)
    write_text_atomically(directory / "report.html", page)
    record.results = {"points": rows, "seconds to an error": reached, "frontier": order, "notes": notes}
    record.results |= {"reference error": judge.error, "reference floor": floor}
    record.write(directory / "record.json")
    return [directory / name for name in ("records.csv", "chart.svg", "chart.png", "report.html", "record.json")]


def _row(point: Point, ratios: dict[tuple[str, float], float | None]) -> dict[str, Any]:
    """A line of the table."""
    import math

    ratio = ratios.get((point.method, point.value))
    return {
        "method": point.method,
        "setting": f"{point.key} {point.value:g}",
        "seconds": point.seconds,
        "from": point.quick,
        "to": point.slow,
        "cpu_s": point.cpu_seconds,
        "error_%": 100.0 * point.error,
        "+-_%": 100.0 * point.doubt,
        "stated_%": None if math.isnan(point.stated) else 100.0 * point.stated,
        "rays": point.counts["rays"] or None,
        "tests": point.counts["tests"] or None,
        "checks": point.counts["plane_vertex_checks"] + point.counts["shaft_tests"] or None,
        "cuts": point.counts["exact_cuts"] or None,
        "MB": point.memory_MB,
        "/_best": ratio,
    }


def _place(number: int, point: Point, tied: list[Point]) -> dict[str, Any]:
    """A line of the frontier."""
    return {
        "place": number, "method": point.method, "setting": f"{point.key} {point.value:g}", "seconds": point.seconds,
        "from": point.quick, "to": point.slow, "runs": point.runs, "error_%": 100.0 * point.error,
        "tied with": ", ".join(f"{p.method} {p.value:g}" for p in tied),
    }  # fmt: skip


def _text(value: Any) -> str:
    from workbench.study.result import format_cell

    return format_cell(value)
