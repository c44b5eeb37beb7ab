"""The command ``radiosity irradiance``: what arrives at sensors, with its error.

Only ``click`` is imported at the top; everything heavy is imported when the command runs.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from radiosity.stopping import INTERRUPTED
from workbench.errors import InputError, OptionError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from radiosity.sensors import IrradianceEstimate
    from radiosity.solvers.solution import Solution
    from workbench.record import RunRecord
    from workbench.scene.model import Scene

__all__ = ["irradiance"]

CHUNK = 65_536
"""Points gathered at once: memory stays bounded however many there are."""
UNSHOT_SHARE = 0.2
"""Share of it for light that a solve of given elements has not shot."""


@click.command()
@click.argument("scene")
@click.option(
    "--points",
    "points_path",
    required=True,
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Sensors, a line each: x,y,z,nx,ny,nz, with commas or spaces; a first line of names is fine.",
)
@click.option(
    "-o", "--output", "out_path", required=True, metavar="OUT.csv", help="Table of results; - is standard output."
)
@click.option(
    "--error",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    default=0.01,
    show_default=True,
    metavar="E",
    help="Wanted error over the points, relative to their mean irradiance.",
)
@click.option(
    "--solution", "directory", type=click.Path(path_type=Path), metavar="DIR", help="Use that solve of SCENE."
)
@click.option("--elements", type=click.IntRange(min=1), metavar="N", help="Otherwise solve with about N elements.")
@click.option("--workers", type=click.IntRange(min=1), metavar="N", help="Threads.  [default: all cores]")
@click.option(
    "--seed", type=click.IntRange(0, 2**31 - 1), default=0, show_default=True, metavar="S", help="Of the rays."
)
@click.option("--json", "json_path", metavar="FILE", help="Write the run's record here; - is standard output.")
def irradiance(
    scene: str,
    points_path: Path,
    out_path: str,
    error: float,
    directory: Path | None,
    elements: int | None,
    workers: int | None,
    seed: int,
    json_path: str | None,
) -> None:
    """Irradiance at the points of FILE in SCENE, all reflections included.

    SCENE is a scene file or the name of a built-in scene.  It is solved first, unless DIR holds its
    solution.  Direct light (lamps, sky) is found at each point exactly where it can be, indirect light
    is gathered from the solution.

    A point on a surface, or within rounding of it, counts as just before the side that it faces, and one on
    the line where two surfaces meet as just before both.

    OUT.csv repeats the points and adds, for each band, irradiance, its direct and indirect part and its
    standard error, in W/m2.  The standard error is what sampling leaves; the solution's own error is
    printed, and stands in the record.
    """
    from radiosity.startup import load_numba

    load_numba()
    import workbench
    from radiosity.points_file import read_sensor_points
    from workbench.record import RunRecord

    if out_path == "-" and json_path == "-":
        raise OptionError("--json: found - for both the table and the record; give one of them a file")
    for name, given in (("-o", out_path), ("--json", json_path)):
        if given not in (None, "-"):
            _check_target(name, Path(str(given)))
    if directory is not None and elements is not None:
        raise OptionError("--elements and --solution were both given; choose one of them")
    record = RunRecord(
        command="irradiance",
        settings={
            "scene": scene, "points": str(points_path), "error": error, "seed": seed, "elements": elements,
            "solution": None if directory is None else str(directory), "workers": workers,
        },
    )  # fmt: skip
    with record.stage("read"):
        rows = read_sensor_points(points_path)
        loaded = workbench.load(scene)
    for note in loaded.notes:
        click.echo(f"note: {note}", err=True)
    solution = _solution(loaded, directory, elements, rows, error, workers, seed, record)
    parts = _gather(solution, rows, error, workers, seed, record)
    text = _table(rows, parts)
    if out_path == "-":
        click.echo(text, nl=False)
    else:
        _write(out_path, text)
    summary = _summary(rows, parts, record, out_path)
    if json_path is not None:
        try:
            record.write(json_path)
        except OSError as problem:
            raise InputError(f"{json_path}: cannot be written: {problem.strerror or problem}") from None
    click.echo(summary, err="-" in (out_path, json_path))


def _check_target(option: str, path: Path) -> None:
    if path.is_dir():
        raise OptionError(f"{option}: found the folder {path}, expected a file name")
    if not path.parent.is_dir():
        raise InputError(f"{path}: found no folder {path.parent}, expected one; make it or give another {option}")


def _solution(
    scene: Scene,
    directory: Path | None,
    elements: int | None,
    rows: NDArray[np.float64],
    error: float,
    workers: int | None,
    seed: int,
    record: RunRecord,
) -> Solution:
    """The solution to gather from: a saved one, or one solved now."""
    import radiosity
    from radiosity.sensors import SOLVE_SHARE

    if directory is not None:
        with record.stage("read"):
            solution = radiosity.Solution.load(directory)
        solution.scene = scene
        record.choices["solution"] = f"from {directory}"
    else:
        with record.stage("solve"):
            if elements is None:
                solution = radiosity.solve(
                    scene, error=SOLVE_SHARE * error, at=(rows[:, :3], rows[:, 3:]), workers=workers, seed=seed
                )
            else:
                tolerance = min(0.01, UNSHOT_SHARE * error)
                solution = radiosity.solve(scene, elements=elements, tolerance=tolerance, workers=workers, seed=seed)
        if solution.stopped == "interrupted":  # its error is not known
            click.echo("radiosity: stopped by Ctrl-C during the solve; nothing was written", err=True)
            raise SystemExit(INTERRUPTED)
        record.counters.merge(solution.record.counters)
        record.choices["solution"] = f"solved with {solution.mesh.element_count} elements"
    record.errors["solution"] = solution.record.errors
    return solution


def _gather(
    solution: Solution,
    rows: NDArray[np.float64],
    error: float,
    workers: int | None,
    seed: int,
    record: RunRecord,
) -> list[IrradianceEstimate]:
    """The estimates of all points, in chunks."""
    from tqdm import tqdm

    from radiosity.sensors import Gatherer, left_for_sampling

    with record.stage("prepare"):
        gatherer = Gatherer(solution, workers=workers, seed=seed)
    parts = []
    share = record.settings["sampling_error"] = left_for_sampling(solution, error)
    with record.stage("gather"), tqdm(total=len(rows), unit="points", disable=None, leave=False) as bar:
        for first in range(0, len(rows), CHUNK):
            some = rows[first : first + CHUNK]
            parts.append(gatherer.irradiance(some[:, :3], some[:, 3:], error=share))
            record.counters.merge(parts[-1].counters)
            bar.update(len(some))
    record.results["sampling_error_reached"] = all(part.reached for part in parts)
    record.choices["gather"] = ", ".join(sorted({part.method for part in parts}))
    return parts


_COLUMNS = ("irradiance", "direct_irradiance", "indirect_irradiance", "standard_error")


def _stacked(parts: list[IrradianceEstimate]) -> NDArray[np.float64]:
    """Values (columns, n, bands) in the order of :data:`_COLUMNS`."""
    import numpy as np

    names = ("irradiance", "direct", "indirect", "standard_error")
    return np.stack([np.concatenate([getattr(part, name) for part in parts]) for name in names])


def _table(rows: NDArray[np.float64], parts: list[IrradianceEstimate]) -> str:
    values = _stacked(parts)
    bands = values.shape[2]
    names = [
        f"{column}_W_m2" if bands == 1 else f"{column}_band{band + 1}_W_m2"
        for column in _COLUMNS
        for band in range(bands)
    ]
    lines = [",".join(["x", "y", "z", "nx", "ny", "nz", *names])]
    flat = values.transpose(1, 0, 2).reshape(len(rows), -1)
    for point, row in zip(rows.tolist(), flat.tolist(), strict=True):
        lines.append(",".join([*(repr(value) for value in point), *(f"{value:.7g}" for value in row)]))
    return "\n".join(lines) + "\n"


def _write(path: str, text: str) -> None:
    from workbench.record import write_text_atomically

    try:
        write_text_atomically(path, text)
    except OSError as problem:
        raise InputError(f"{path}: cannot be written: {problem.strerror or problem}") from None


def _summary(
    rows: NDArray[np.float64],
    parts: list[IrradianceEstimate],
    record: RunRecord,
    out_path: str,
) -> str:
    """The end in a few lines; the record gets its figures."""
    values = _stacked(parts)
    mean, doubt = values[0].mean(axis=0), (values[3] ** 2).mean(axis=0) ** 0.5
    share = max((d / m for d, m in zip(doubt.tolist(), mean.tolist(), strict=True) if m > 0), default=0.0)
    dark = int((values[0] == 0.0).all(axis=1).sum())
    record.results.update(points=len(rows), mean_irradiance_W_m2=mean.tolist(), dark_points=dark)
    record.errors["standard_error_rms_of_mean"] = share
    lines = [
        f"{len(rows)} points: mean irradiance {', '.join(f'{value:.4g}' for value in mean)} W/m2, "
        f"standard error {share:.2g} of it by sampling ({record.choices['gather']})",
        "seconds: " + "; ".join(f"{stage} {spent:.2f}" for stage, spent in record.seconds.items()),
    ]
    estimate = record.errors["solution"].get("estimate")
    if estimate is not None:
        where = "these points" if record.settings["solution"] is None else "all surfaces"
        lines.insert(1, f"error of the solution: {estimate['total']:.2g} of the mean irradiance over {where}")
    if not record.results["sampling_error_reached"]:
        asked = record.settings["sampling_error"]
        lines.append(
            f"sampling did not come down to the {asked:.2g} that it was left: more rays a point than can be had, or"
            " views too crowded to be cut exactly"
        )
    if dark:
        lines.append(f"{dark} points receive nothing: behind or inside a surface, or turned away from all light")
    if out_path != "-":
        lines.append(out_path)
    return "\n".join(lines)
