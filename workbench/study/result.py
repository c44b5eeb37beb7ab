"""What a study leaves: one table, notes that explain it, one figure and the record of the run."""

from __future__ import annotations

import csv
import io
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from workbench.arrays import as_count
from workbench.errors import InputError
from workbench.record import RunRecord, write_text_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["StudyResult", "format_cell", "format_table", "interleaved", "write_study"]


@dataclass(frozen=True)
class StudyResult:
    """The outcome of one study.

    Parameters
    ----------
    name : str
        Base name of its files.
    title : str
        One line over the table.
    rows : list of dict
        The table, a row a dict, all with the same keys; a key names its unit.  ``None`` is a cell
        without a value.
    notes : list of str
        What to know when reading the table: settings, and why figures differ from a paper's.
    record : RunRecord
    draw : callable
        Draws the figure into an empty matplotlib figure, sets its size too.
    """

    name: str
    title: str
    rows: list[dict[str, Any]]
    notes: list[str]
    record: RunRecord
    draw: Callable[[Figure], None]


def interleaved(
    tasks: Mapping[str, Callable[[], Any]], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> tuple[dict[str, list[float]], dict[str, Any]]:
    """Run every task ``repeats`` times in turn, so that a busy machine slows all of them alike.

    Every other round runs backwards.  Compile kernels before: the first round counts.

    Returns
    -------
    seconds : dict of list of float
        Of each run, by the names of the tasks. [s]
    answers : dict
        What each task returned last.

    Raises
    ------
    InputError
        If ``repeats`` is less than 1.
    """
    repeats = as_count(repeats, "repeats")
    seconds: dict[str, list[float]] = {name: [] for name in tasks}
    answers: dict[str, Any] = {}
    for turn in range(repeats):
        for name in list(tasks)[:: 1 if turn % 2 == 0 else -1]:
            start = clock()
            answers[name] = tasks[name]()
            seconds[name].append(clock() - start)
    return seconds, answers


def format_cell(value: Any) -> str:
    """A value as a table shows it: numbers to three digits, nothing for ``None``."""
    if value is None:
        return ""
    if isinstance(value, (bool, str)):
        return str(value)
    if isinstance(value, (int, np.integer)):
        return f"{value:,}"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"


def format_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as aligned text: numbers to three digits, on the right."""
    if not rows:
        return ""
    names = list(rows[0])
    cells = [[format_cell(row[name]) for name in names] for row in rows]
    heads = [name.replace("_", " ") for name in names]
    widths = [max(len(head), *(len(line[i]) for line in cells)) for i, head in enumerate(heads)]
    text = [all(isinstance(row[name], (str, type(None))) for row in rows) for name in names]

    def line(parts: Sequence[str]) -> str:
        places = zip(parts, widths, text, strict=True)
        return "  ".join(part.ljust(width) if left else part.rjust(width) for part, width, left in places).rstrip()

    return "\n".join([line(heads), line(["-" * width for width in widths]), *(line(parts) for parts in cells)])


def write_study(result: StudyResult, directory: str | Path) -> list[Path]:
    """Write ``NAME.csv``, ``NAME.png`` and ``record.json`` into a folder, made if absent.

    Each file is whole or not there at all.

    Returns
    -------
    list of Path
        The files, in that order.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    folder = Path(directory)
    table = io.StringIO()
    writer = csv.DictWriter(table, list(result.rows[0]) if result.rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(result.rows)
    figure = Figure(layout="constrained")
    FigureCanvasAgg(figure)
    result.draw(figure)
    result.record.results |= {"title": result.title, "rows": result.rows, "notes": result.notes}
    files = [folder / f"{result.name}.csv", folder / f"{result.name}.png", folder / "record.json"]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_text_atomically(files[0], table.getvalue())
        beside = files[1].with_name(f".{files[1].name}.{os.getpid()}.part")
        try:
            figure.savefig(beside, format="png", dpi=110)
            beside.replace(files[1])
        finally:
            beside.unlink(missing_ok=True)
        result.record.write(files[2])
    except OSError as error:
        raise InputError(f"{folder}: cannot write here: {error.strerror or error}; give another folder") from None
    return files
