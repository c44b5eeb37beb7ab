"""The command ``radiosity stability``: the catalogue of failures, every technique, and what became of each.

Only ``click`` is imported at the top; everything heavy is imported when the command runs.
"""

from __future__ import annotations

import csv
import io
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from workbench.errors import InputError, OptionError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from radiosity.report.failures import Cell, Failure

__all__ = ["draw_matrix", "run_catalogue", "stability"]

VERDICTS = {
    "right": "#7fc97f", "degrades": "#fdd49e", "refuses": "#9ecae1", "disclaims": "#bdbdbd", "wrong": "#d7301f",
}  # fmt: skip
"""Verdicts with the colours of their cells."""


@click.command()
@click.option("-o", "--output", "directory", type=click.Path(path_type=Path), metavar="DIR", help="Write files here.")
@click.option("--only", metavar="NAME", help="Entries, groups or techniques whose name holds NAME.")
@click.option("--list", "listing", is_flag=True, help="List the catalogue and run nothing.")
def stability(directory: Path | None, only: str | None, listing: bool) -> None:
    """Run every technique on the scenes where such techniques fail.

    Prints a matrix of failures by techniques.  A cell is "right"; or "degrades", with its relative error,
    where the technique's own stated error covers it; or "refuses", with a reason; or "disclaims", where
    its documentation names the case; or "WRONG".  DIR gets stability.csv, stability.png and
    record.json.  The exit code is 1 if any cell is wrong.
    """
    from radiosity.report.catalogue import CATALOGUE
    from workbench.record import check_folder

    chosen = _chosen(CATALOGUE, only)
    if listing:
        for entry, _ in chosen:
            click.echo(f"{entry.group:30s} {entry.name:36s} {entry.about}")
        return
    check_folder(directory)
    chosen, notes = _present(chosen)
    from workbench.record import RunRecord
    from workbench.study.result import format_table

    record = RunRecord("stability", settings={"only": only})
    with record.stage("catalogue"):
        matrix = run_catalogue(chosen)
    click.echo(format_table(_rows(chosen, matrix)))
    click.echo()
    for line in (*_reasons(chosen, matrix), *notes):
        click.echo(line)
    counts, theirs = _counts(matrix)
    click.echo(", ".join(f"{count} {verdict}" for verdict, count in counts.items()))
    if any(theirs.values()):
        click.echo("rivals: " + ", ".join(f"{count} {verdict}" for verdict, count in theirs.items()))
    if directory is not None:
        record.results = {"counts": counts, "rivals": theirs, "notes": notes, "cells": _table(chosen, matrix)}
        _write(directory, chosen, matrix, record)
    if counts["wrong"]:
        raise SystemExit(1)


def _chosen(catalogue: Sequence[Failure], only: str | None) -> list[tuple[Failure, list[str]]]:
    """Entries and the techniques to run on each."""
    chosen = []
    for entry in catalogue:
        whole = only is None or only in entry.name or only in entry.group
        techniques = [name for name in entry.techniques if whole or only == name]
        if techniques:
            chosen.append((entry, techniques))
    if not chosen:
        raise OptionError(f"--only: found {only!r}, expected part of a name that 'radiosity stability --list' shows")
    return chosen


def _present(chosen: list[tuple[Failure, list[str]]]) -> tuple[list[tuple[Failure, list[str]]], list[str]]:
    """The same without rivals that cannot run here, and why each cannot."""
    from radiosity.rivals import RIVALS, absent

    asked = [name for name in RIVALS if any(name in techniques for _, techniques in chosen)]
    missing = {name: reason for name in asked if (reason := absent(name)) is not None}
    left = [(entry, [name for name in techniques if name not in missing]) for entry, techniques in chosen]
    notes = [f"{name} is left out: {reason}" for name, reason in missing.items()]
    if not any(techniques for _, techniques in left):
        raise InputError("stability: found no technique that can run; " + "; ".join(notes))
    return [(entry, techniques) for entry, techniques in left if techniques], notes


def _counts(matrix: Mapping[tuple[str, str], Cell]) -> tuple[dict[str, int], dict[str, int]]:
    """Cells by verdict: of our own techniques, and of rivals."""
    from radiosity.rivals import RIVALS

    ours, theirs = ([c for (_, name), c in matrix.items() if (name in RIVALS) == rival] for rival in (False, True))
    counts = [
        {verdict: sum(cell.verdict == verdict for cell in cells) for verdict in VERDICTS} for cells in (ours, theirs)
    ]
    return counts[0], counts[1]


def run_catalogue(chosen: Sequence[tuple[Failure, Sequence[str]]]) -> dict[tuple[str, str], Cell]:
    """What became of each technique (second key) on each entry (first key)."""
    from tqdm import tqdm

    from radiosity.report.failures import judge

    tasks = [(entry, technique) for entry, techniques in chosen for technique in techniques]
    return {
        (entry.name, technique): judge(entry, technique) for entry, technique in tqdm(tasks, disable=None, leave=False)
    }


def _text(cell: Cell | None) -> str:
    if cell is None:
        return ""
    if cell.verdict in ("right", "refuses"):
        return cell.verdict
    size = abs(cell.error)
    error = f"{100 * size:.2g}%" if 100 * size < 99.5 else f"{100 * size:.0f}%" if math.isfinite(size) else f"{size}"
    return {"degrades": f"degrades {error}", "disclaims": f"disclaims {error}"}.get(cell.verdict, f"WRONG {error}")


def _rows(
    chosen: Sequence[tuple[Failure, Sequence[str]]], matrix: Mapping[tuple[str, str], Cell]
) -> list[dict[str, str]]:
    """The matrix in short: techniques that agree on an entry share its cell."""
    rows = []
    for entry, techniques in chosen:
        groups: dict[str, list[str]] = {}
        for technique in techniques:
            groups.setdefault(_text(matrix[entry.name, technique]), []).append(technique)
        most = max(groups, key=lambda text: (text == "right", len(groups[text])))
        rest = [f"{', '.join(names)}: {text}" for text, names in groups.items() if text != most]
        told = f"{'all' if len(groups) == 1 else len(groups[most])} {most}"
        rows.append({"group": entry.group, "failure": entry.name, "techniques": "; ".join([told, *rest])})
    return rows


def _reasons(chosen: Sequence[tuple[Failure, Sequence[str]]], matrix: Mapping[tuple[str, str], Cell]) -> list[str]:
    """Why techniques refused, each reason once."""
    found: dict[str, list[str]] = {}
    for entry, techniques in chosen:
        for technique in techniques:
            cell = matrix[entry.name, technique]
            if cell.reason:
                found.setdefault(f"{cell.verdict}: {cell.reason}", []).append(f"{technique} on {entry.name!r}")
    return [f"{reason} ({'; '.join(names)})" for reason, names in found.items()]


def _table(
    chosen: Sequence[tuple[Failure, Sequence[str]]], matrix: Mapping[tuple[str, str], Cell]
) -> list[dict[str, Any]]:
    return [
        {
            "group": entry.group, "failure": entry.name, "about": entry.about, "expected": entry.expected,
            "technique": technique, "verdict": cell.verdict, "relative_error": cell.error,
            "relative_stated_error": cell.stated, "reason": cell.reason,
        }
        for entry, techniques in chosen for technique in techniques for cell in [matrix[entry.name, technique]]
    ]  # fmt: skip


def _write(
    directory: Path,
    chosen: Sequence[tuple[Failure, Sequence[str]]],
    matrix: Mapping[tuple[str, str], Cell],
    record: Any,
) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from workbench.record import write_text_atomically

    cells = _table(chosen, matrix)
    table = io.StringIO()
    writer = csv.DictWriter(table, list(cells[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(cells)
    figure = Figure()
    FigureCanvasAgg(figure)
    draw_matrix(figure, chosen, matrix)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        write_text_atomically(directory / "stability.csv", table.getvalue())
        beside = directory / f".stability.{os.getpid()}.part"
        figure.savefig(beside, format="png", dpi=100)
        beside.replace(directory / "stability.png")
        record.write(directory / "record.json")
    except OSError as error:
        raise InputError(f"{directory}: cannot write here: {error.strerror or error}; give another folder") from None
    for name in ("stability.csv", "stability.png", "record.json"):
        click.echo(str(directory / name))


def _families(
    chosen: Sequence[tuple[Failure, Sequence[str]]],
) -> list[tuple[list[str], list[tuple[Failure, Sequence[str]]]]]:
    """Techniques that answer the same questions, rivals last, and the entries that they answer."""
    from radiosity.rivals import RIVALS

    found: list[tuple[list[str], list[tuple[Failure, Sequence[str]]]]] = []
    for entry, techniques in chosen:
        own = [name for name in techniques if name not in RIVALS]
        joined = [family for family in found if set(family[0]) & set(own)]
        names = list(dict.fromkeys([*(name for family in joined for name in family[0]), *own]))
        entries = [item for family in joined for item in family[1]] + [(entry, techniques)]
        place = found.index(joined[0]) if joined else len(found)
        found = [family for family in found if family not in joined]
        found.insert(place, (names, entries))
    order = [entry.name for entry, _ in chosen]
    return [
        (
            names + [rival for rival in RIVALS if any(rival in techniques for _, techniques in entries)],
            sorted(entries, key=lambda item: order.index(item[0].name)),
        )
        for names, entries in found
    ]


ROW, COLUMN, LABELS, GROUPS, HEAD = 0.19, 0.42, 2.95, 1.75, 1.05
"""Inches of the figure: a row, a column, the names of failures, those of groups, and of techniques above a panel."""


def draw_matrix(
    figure: Figure, chosen: Sequence[tuple[Failure, Sequence[str]]], matrix: Mapping[tuple[str, str], Cell]
) -> None:
    """Failures down, techniques across, a coloured cell for each pair, into an empty figure.

    A panel for the techniques that answer the same questions, one below the other.
    """
    from matplotlib.patches import Patch

    families = _families(chosen)
    width = LABELS + GROUPS + COLUMN * max(len(names) for names, _ in families)
    height = 0.9 + sum(HEAD + ROW * len(entries) for _, entries in families)
    figure.set_size_inches(width, height)
    top = height - 0.3
    for names, entries in families:
        top -= HEAD
        size = (COLUMN * len(names), ROW * len(entries))
        axes = figure.add_axes((LABELS / width, (top - size[1]) / height, size[0] / width, size[1] / height))
        _draw_panel(axes, names, entries, matrix)
        top -= size[1]
    ours, theirs = (counts["wrong"] for counts in _counts(matrix))
    words = {
        "right": "right", "degrades": "degrades, and says so: error", "refuses": "refuses, with a reason",
        "disclaims": "disclaimed in its documentation: error",
        "wrong": f"wrong silently (ours {ours}, rivals {theirs})",
    }  # fmt: skip
    figure.legend(
        handles=[Patch(facecolor=VERDICTS[verdict], label=text) for verdict, text in words.items()],
        loc="lower left", bbox_to_anchor=(0.1 / width, 0.05 / height), ncols=3, fontsize=9, frameon=False,
    )  # fmt: skip
    figure.suptitle(
        "Where techniques of light transport fail, and what became of each", fontsize=11, y=1.0 - 0.1 / height
    )


def _draw_panel(
    axes: Axes, columns: list[str], entries: Sequence[tuple[Failure, Sequence[str]]],
    matrix: Mapping[tuple[str, str], Cell],
) -> None:  # fmt: skip
    from matplotlib.patches import Rectangle

    from radiosity.rivals import RIVALS

    before = None
    for row, (entry, techniques) in enumerate(entries):
        if entry.group != before:
            axes.axhline(row, color="0.35", lw=0.8)
            axes.text(len(columns) + 0.15, row + 0.5, entry.group, va="center", fontsize=8, color="0.3", style="italic")
            before = entry.group
        for technique in techniques:
            cell = matrix[entry.name, technique]
            column = columns.index(technique)
            colour = VERDICTS[cell.verdict]
            axes.add_patch(Rectangle((column, row), 1, 1, facecolor=colour, edgecolor="white", lw=1))
            if cell.verdict in ("degrades", "disclaims", "wrong") and math.isfinite(cell.error):
                size = 100 * abs(cell.error)
                text = f"{size:.2g}%" if size < 99.5 else f"{size:.0f}%" if size < 999.5 else ">999%"
                axes.text(column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=7)
    rivals = sum(name in RIVALS for name in columns)
    if 0 < rivals < len(columns):
        axes.axvline(len(columns) - rivals, color="0.35", lw=1.2)
    axes.set_xlim(0, len(columns))
    axes.set_ylim(len(entries), 0)
    axes.set_yticks([row + 0.5 for row in range(len(entries))], [entry.name for entry, _ in entries], fontsize=8)
    told = [f"{name} (rival)" if name in RIVALS else name for name in columns]
    axes.set_xticks([i + 0.5 for i in range(len(columns))], told, rotation=45, ha="left", rotation_mode="anchor")
    axes.tick_params(length=0, top=False, labeltop=True, labelbottom=False, pad=2, labelsize=8)
    for spine in axes.spines.values():
        spine.set_visible(False)
