"""The charts of README by one command, the table of seconds to an error, and the costs that are fitted to them.

    python tests/speed/bench_charts.py [-o out/charts] [--only NAME] [--docs] [--fit] [--against FOLDER]

Charts go on where they were interrupted; rivals that are not installed are left out with a reason.
Prints, and writes to summary.md, the seconds to each error.  ``--docs`` also draws the matrix of failures and
the explanation of README, and copies all figures to docs/; ``--fit`` writes
radiosity/report/cost_table.json from the records (``radiosity explain`` tells by it where the seconds of a
solve went; no choice is made by it) and prints how well it tells the seconds of the runs that it was fitted
to; ``--against`` compares with the charts of another folder: counts and errors exactly, and the order of the frontiers.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

from radiosity.report.cost_model import fit, write_table
from radiosity.report.speed_accuracy import COUNTS, read_runs
from radiosity.rivals import RIVALS, absent

# The scene, the question, what answers are judged by where the rival is absent, and the rest.
CHARTS = {
    "shadows-tori": ["woo-tori", "--what", "shadows", "--reference", "exact"],
    "viewfactors-l-room": ["l-room", "--what", "viewfactors", "--reference", "exact"],
    "solve-cornell": ["cornell-box", "--what", "solve", "--points", "1000", "--reference", "mitsuba:8192"],
    "solve-office": ["office", "--what", "solve", "--points", "1000", "--reference", "mitsuba"],
    "render-cornell": ["cornell-box", "--what", "render", "--reference", "mitsuba"],
    "picture-cornell": ["cornell-box", "--what", "picture", "--reference", "mitsuba"],
}
FIGURES = {
    "stability": ["stability"],
    "explain-cornell": ["explain", "cornell-box", "--error", "0.05", "--repeats", "5"],
}
"""The other figures of README that are drawn from measurements: NAME.png from the command."""
PROGRAM = [sys.executable, "-c", "from radiosity.cli import main; main()"]
LIMIT, LONGEST = "1", "8"
"""Seconds of a run beyond which it is not repeated, and after which finer settings of its technique are left out."""


def run(folder: Path, name: str, against: Path | None) -> int:
    arguments = list(CHARTS[name])
    rival = arguments[-1].partition(":")[0]
    if rival in RIVALS and (missing := absent(rival)) is not None:
        print(f"{name}: {rival} is left out: {missing}; the reference is a fine run of our own")
        arguments[-1] = "converged"
    if against is not None:
        arguments += ["--compare", str(against / name)]
    command = [*PROGRAM, "chart", *arguments, "--limit", LIMIT, "--longest", LONGEST, "-o", str(folder / name)]
    return subprocess.run(command, check=False).returncode


def draw_others(folder: Path) -> list[str]:
    """Draw the other figures and copy them to docs; names of those that failed."""
    failed = []
    for name, arguments in FIGURES.items():
        print(f"== {name}", flush=True)
        code = subprocess.run([*PROGRAM, *arguments, "-o", str(folder / name)], check=False).returncode
        failed += [name] if code != 0 else []
        shutil.copy(folder / name / f"{arguments[0]}.png", Path(f"docs/{name}.png"))
    return failed


def summary(folder: Path) -> str:
    """Seconds to an error, a table in Markdown over all charts of a folder."""
    rivals = list(RIVALS)
    lines = ["| question | error | ours | by | " + " | ".join(rivals) + " |", "| --- " * (4 + len(rivals)) + "|"]
    for name in CHARTS:
        record = folder / name / "record.json"
        if not record.exists():
            continue
        for row in json.loads(record.read_text())["results"].get("seconds to an error", []):
            cells = [name, f"{row['error_%']:g} %", _seconds(row["ours"]), row["by"] or ""]
            cells += [_seconds(row[rival]) if rival in row else "" for rival in rivals]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.2g}"


def fitted(folder: Path) -> None:
    runs: dict[str, list] = {}
    for name, arguments in CHARTS.items():
        record = folder / name / "records.csv"
        if record.exists():
            runs.setdefault(arguments[2], []).extend(read_runs(record))
    models = {what: fit(found) for what, found in runs.items() if len(found) >= 20}  # fewer tell nothing of ten counts
    write_table(models)
    for what, model in models.items():
        mine = [run for run in runs[what] if run.kind != "rival" and any(getattr(run, count) for count in COUNTS)]
        times = sorted(model.predict({**vars(run), "polygon_tests": run.tests}) / run.cpu_seconds for run in mine)
        low, middle, high = (times[round(share * (len(times) - 1))] for share in (0.1, 0.5, 0.9))
        spread = f"{middle:.2f}, of 80 % of {len(times)} runs {low:.2f} to {high:.2f}"
        print(f"{what}: processor seconds told over measured: {spread}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", type=Path, default=Path("out/charts"))
    parser.add_argument("--only", default="", help="charts whose name holds this")
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--against", type=Path)
    asked = parser.parse_args()
    failed = []
    for chart in CHARTS:
        if asked.only in chart:
            start = time.perf_counter()
            print(f"== {chart}", flush=True)
            if run(asked.o, chart, asked.against) != 0:
                failed.append(chart)
            print(f"== {chart}: {time.perf_counter() - start:.0f} s", flush=True)
            if asked.docs:
                shutil.copy(asked.o / chart / "chart.png", Path(f"docs/chart-{chart}.png"))
    if asked.docs and not asked.only:
        failed += draw_others(asked.o)
    table = summary(asked.o)
    (asked.o / "summary.md").write_text(table)
    print(table)
    if asked.fit:
        fitted(asked.o)
    if failed:
        sys.exit(f"failed or not reproduced: {', '.join(failed)}")
