"""Is automatic choice within 1.5 times of the best hand-tuned setting?  A table over scenes.

    python tests/speed/bench_auto.py [-o out/auto] [--repeats 3] [SCENE ...]

Solves every scene to errors of 0.1 and 0.05, and with meshes set by hand, and reads irradiance at 128
points; the reference is a solve of 3,000 elements gathered to 0.3 %.  The ratio compares medians of
interleaved runs, in processor seconds too: other work on the machine disturbs them less.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import workbench
from radiosity.report.speed_accuracy import Point, auto_ratios, measure, points_of, write_runs
from radiosity.report.techniques import Reference, problem_for
from workbench.errors import WorkbenchError
from workbench.scene.load import built_in_scenes
from workbench.study.result import format_table

PLAN = [
    ("auto", (0.1, 0.05)),
    ("matrix+gather", (16, 50, 150, 400)),
    ("progressive+gather", (16, 50, 150, 400)),
    ("hierarchical+gather", (100, 200, 400, 800)),
]


def rows_of(scene: str, folder: Path, repeats: int) -> list[dict]:
    problem = problem_for("solve", workbench.load(scene), points=128)
    small = problem.geometry.polygon_count <= 2000
    fine = problem._solved({"method": "matrix" if small else "progressive", "elements": 3000, "tolerance": 2e-3}, 1)
    judge = Reference("3,000 elements", problem._gathered(fine, 0.003, 1)[0], 0.0, 0.003)
    runs, notes = measure(problem, judge, PLAN, repeats=repeats, limit=20.0)
    folder.mkdir(parents=True, exist_ok=True)
    write_runs(folder / f"{Path(scene).stem}.csv", runs)
    for note in notes:
        print(note)
    points = points_of(runs)
    by_cpu = auto_ratios([Point(**{**vars(p), "seconds": p.cpu_seconds}) for p in points])
    return [
        {
            "scene": Path(scene).stem, "asked": point.value, "reached": point.error, "stated": point.stated,
            "seconds": point.seconds, "times_best": ratio, "cpu_times_best": cpu,
        }
        for (point, ratio), (_, cpu) in zip(auto_ratios(points), by_cpu, strict=True)
    ]  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=list(built_in_scenes()))
    parser.add_argument("-o", type=Path, default=Path("out/auto"))
    parser.add_argument("--repeats", type=int, default=3)
    asked = parser.parse_args()
    table = []
    for name in asked.scenes:
        try:
            table += rows_of(name, asked.o, asked.repeats)
        except WorkbenchError as problem_found:
            print(f"{name} is left out: {problem_found}")
            continue
        print(format_table(table), flush=True)
