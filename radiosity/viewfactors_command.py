"""The command ``radiosity viewfactors``: the matrix of view factors of a scene, with obstruction."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from workbench.errors import InputError, OptionError

if TYPE_CHECKING:
    from radiosity.form_factors.matrix import ViewFactors

__all__ = ["viewfactors"]


def _finite(context: click.Context, parameter: click.Parameter, value: float | None) -> float | None:
    """Refuse nan and inf, which pass click's range checks."""
    if value is not None and not math.isfinite(value):
        raise click.BadParameter(f"{value} is not a finite number.", ctx=context, param=parameter)
    return value


def _check_writable(path: Path) -> None:
    """Find out before the work that a file can be written where it should be."""
    if path.is_dir():
        raise InputError(f"{path}: found a folder, expected a file name")
    probe = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        probe.touch()
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}; give another file") from None
    finally:
        probe.unlink(missing_ok=True)


@contextmanager
def _bar() -> Iterator[Any]:
    """A progress bar on a terminal; yields the function to call with the share done."""
    from tqdm import tqdm

    bar = tqdm(
        total=1.0,
        desc="exchange areas",
        disable=None,  # off where standard error is not a terminal
        bar_format="{desc} {percentage:3.0f}%|{bar}| {elapsed}, {remaining} left",
        leave=False,
    )
    try:
        yield lambda share: bar.update(max(0.0, share - bar.n))
    finally:
        bar.close()


@click.command()
@click.argument("scene")
@click.option(
    "-o", "--output", "path", required=True, type=click.Path(path_type=Path), metavar="FILE", help=".npz or .csv"
)
@click.option(
    "--by",
    type=click.Choice(["surface", "patch"]),
    default="patch",
    show_default=True,
    help="A row a surface (area-weighted over its polygons), or a row a polygon or element.",
)
@click.option(
    "--error",
    type=click.FloatRange(min=0, max=1, min_open=True, max_open=True),
    callback=_finite,
    default=1e-3,
    show_default=True,
    metavar="E",
    help="Wanted error: mean over the rows of the sum of |F - exact|.",
)
@click.option("--elements", type=click.IntRange(min=1), metavar="N", help="Divide the polygons into about N elements.")
@click.option(
    "--max-edge",
    type=click.FloatRange(min=0, min_open=True),
    callback=_finite,
    metavar="L",
    help="Divide the polygons until no edge is longer than L scene lengths.",
)
@click.option("--workers", type=click.IntRange(min=1), metavar="N", help="Threads.  [default: all cores]")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, metavar="S", help="Of the rays.")
@click.option("--json", "json_path", metavar="FILE", help="Write the run's record here; - is standard output.")
def viewfactors(
    scene: str,
    path: Path,
    by: str,
    error: float,
    elements: int | None,
    max_edge: float | None,
    workers: int | None,
    seed: int,
    json_path: str | None,
) -> None:
    """Find the view factors between all surfaces or patches of SCENE, with obstruction.

    FILE.npz gets F (row i: the share of what leaves i that reaches each j), standard_error, areas,
    names and row_sums as found; a matrix that is smaller sparse comes as F_data, F_indices, F_indptr
    (scipy.sparse.csr_array).  FILE.csv gets a line an entry that is not zero.

    A_i F_ij = A_j F_ji holds by construction.  If SCENE is declared closed, its rows are made to sum
    to 1 by a symmetric scaling, whose largest change is reported.
    """
    if elements is not None and max_edge is not None:
        raise OptionError("--elements and --max-edge: found both, expected one; leave one out")
    if path.suffix not in (".npz", ".csv"):
        raise InputError(f"{path}: found the suffix {path.suffix!r}, expected .npz or .csv")
    _check_writable(path)
    if json_path not in (None, "-"):
        _check_writable(Path(str(json_path)))
    import workbench

    start = time.perf_counter()
    loaded = workbench.load(scene)
    seconds_reading = time.perf_counter() - start
    for note in loaded.notes:
        click.echo(f"note: {note}", err=True)
    from radiosity.form_factors.matrix import view_factors

    with _bar() as report:
        found = view_factors(
            loaded,
            by=by,
            error=error,
            elements=elements,
            max_edge=max_edge,
            workers=workers,
            seed=seed,
            progress=report,
        )
    record = found.record
    record.seconds = {"read scene": seconds_reading} | record.seconds
    with record.stage("save"):
        found.save(path)
    if json_path is not None:
        record.write(json_path)
    click.echo("\n".join([*_summary(found), str(path)]), err=json_path == "-")


def _summary(found: ViewFactors) -> list[str]:
    """What was found, how good it is and what it took."""
    record, counts = found.record, found.record.counters
    sums, closed = record.errors["row_sum_as_found"], record.errors["row_sum"]
    form = "sparse" if found.sparse else "dense"
    if record.results["method"] == "hemisphere rays":
        predicted = record.results["predicted_seconds"]
        how = (
            f"{counts['rays']:,} rays from the rows, predicted to take {predicted['hemisphere rays']:.2g} s "
            f"where pairs of polygons take {predicted['pairs']:.2g} s"
        )
    else:
        how = (
            f"{counts['not_inshadow']:,} pairs clear, {counts['inshadow']:,} hidden by one occluder, "
            f"{counts['complex_shadow']:,} seen in part ({counts['exact_cuts']:,} exact cuts, {counts['rays']:,} rays)"
        )
    lines = [
        f"{record.settings['scene']}: {len(found.names)} x {len(found.names)} view factors, {form}; {how}",
        f"row sums as found: min {sums['min']:.6f}, mean {sums['mean']:.6f}, max {sums['max']:.6f}",
    ]
    if found.closure_correction > 0:
        lines.append(
            f"rows closed: min {closed['min']:.6f}, max {closed['max']:.6f}; "
            f"largest change of an entry {found.closure_correction:.2g}"
        )
    if record.results.get("covered_rows"):
        lines.append(f"rows that something covers in part, left as found: {record.results['covered_rows']}")
    lines.append(
        f"reciprocity error: {found.reciprocity:.2g}; stated error, mean of the rows: "
        f"{record.errors['stated_row_error']:.2g}"
    )
    asked, stated = record.settings["error"], record.errors["stated_row_error"]
    if stated > asked:
        lines.append(
            f"asked for {asked:g}, not reached: {stated:.2g}; divide large polygons by --max-edge, or ask for more"
        )
    lines.append("seconds: " + "; ".join(f"{stage} {spent:.2f}" for stage, spent in record.seconds.items()))
    return lines
