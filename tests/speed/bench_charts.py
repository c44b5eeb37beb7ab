"""The charts of README, all by one command, and the table of costs that is fitted to them.

    python tests/speed/bench_charts.py [-o out/charts] [--only NAME] [--fit]

Charts go on where they were interrupted.  ``--fit`` writes radiosity/report/cost_table.json from their
records.  A quarter of an hour on two cores.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from radiosity.report.cost_model import fit, write_table
from radiosity.report.speed_accuracy import read_runs

CHARTS = {
    "shadows-tori": ["woo-tori", "--what", "shadows", "--limit", "4"],
    "shadows-cornell": ["cornell-box", "--what", "shadows"],
    "viewfactors-l-room": ["l-room", "--what", "viewfactors"],
    "solve-cornell": ["cornell-box", "--what", "solve", "--points", "192", "--reference", "mitsuba"],
    "solve-office": ["office", "--what", "solve", "--points", "96", "--reference", "mitsuba", "--limit", "4"],
    "render-cornell": ["cornell-box", "--what", "render"],
    "picture-cornell": ["cornell-box", "--what", "picture", "--width", "48", "--reference", "mitsuba"],
}


def run(folder: Path, only: str | None) -> None:
    for name, arguments in CHARTS.items():
        if only is None or only in name:
            print(f"== {name}", flush=True)
            command = [sys.executable, "-c", "from radiosity.cli import main; main()", "chart", *arguments]
            subprocess.run([*command, "--repeats", "3", "-o", str(folder / name)], check=True)


def fitted(folder: Path) -> None:
    runs: dict[str, list] = {}
    for name, arguments in CHARTS.items():
        record = folder / name / "records.csv"
        if record.exists():
            runs.setdefault(arguments[2], []).extend(read_runs(record))
    # A handful of runs tells nothing of ten counts.
    write_table({what: fit(found) for what, found in runs.items() if len(found) >= 20})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", type=Path, default=Path("out/charts"))
    parser.add_argument("--only")
    parser.add_argument("--fit", action="store_true")
    asked = parser.parse_args()
    if asked.fit:
        fitted(asked.o)
        sys.exit()
    run(asked.o, asked.only)
