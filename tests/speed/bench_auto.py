"""Is automatic choice within 1.5 times of the best hand-tuned setting?  A table over scenes.

    python tests/speed/bench_auto.py [-o out/auto] [--repeats 3] [SCENE ...]

Solves every scene to errors from 0.1 to 0.01, and with meshes set by hand, and reads irradiance at 128
points; the reference is a solve of 4,000 elements gathered to 0.2 %.  The ratios compare interleaved runs
at the error that ``auto`` made: seconds on the clock (median) and of the processor (the least of the
repeats: other work on the machine disturbs these least).  ``-`` where no setting by hand was as exact.
Without scenes: the built-in ones, and those of ``../shared/scenes-external`` where they are found.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import workbench
from radiosity.report.speed_accuracy import auto_ratios, measure, points_of, read_runs, write_runs
from radiosity.report.techniques import Reference, problem_for
from workbench.errors import WorkbenchError
from workbench.scene.load import built_in_scenes
from workbench.study.result import format_table

ERRORS = (0.1, 0.05, 0.02, 0.01)
PLAN = [
    ("auto", ERRORS),
    ("matrix+gather", (16, 50, 100, 200, 400, 800, 1600)),
    ("progressive+gather", (16, 50, 200, 800)),
    ("hierarchical+gather", (100, 200, 400, 800)),
]
EXTERNAL = (
    "cornell-mcguire/CornellBox-Original.obj", "cornell-mcguire/CornellBox-Sphere.obj", "radiance-room/room.rad",
    "nff-spd/gears_2.nff", "fish/fish.obj", "godot-room/room.glb",
)  # fmt: skip


def scenes() -> list[str]:
    """All scenes of the table that are there."""
    folder = Path(__file__).resolve().parents[2].parent / "shared/scenes-external"
    return [*built_in_scenes(), *(str(folder / name) for name in EXTERNAL if (folder / name).exists())]


def rows_of(scene: str, folder: Path, repeats: int, limit: float) -> list[dict]:
    problem = problem_for("solve", workbench.load(scene), points=128)
    small = problem.geometry.polygon_count <= 2000
    fine = problem._solved({"method": "matrix" if small else "progressive", "elements": 4000, "tolerance": 2e-3}, 1)
    judge = Reference("4,000 elements", problem._gathered(fine, 0.002, 1)[0], 0.0, 0.002)
    folder.mkdir(parents=True, exist_ok=True)
    record = folder / f"{Path(scene).stem}.csv"
    runs, notes = measure(problem, judge, PLAN, repeats=repeats, limit=limit)
    write_runs(record, runs)
    runs = read_runs(record)
    for note in notes:
        print(note)
    points = points_of(runs)
    least = {
        p: min(r.cpu_seconds for r in runs if (r.method, r.value) == p) for p in {(q.method, q.value) for q in points}
    }
    by_cpu = [dataclasses.replace(p, seconds=least[p.method, p.value]) for p in points]
    rows = []
    for (point, ratio), (used, cpu) in zip(auto_ratios(points), auto_ratios(by_cpu), strict=True):
        exact = [q for q in by_cpu if q.kind == "ours" and q.error <= point.error]
        best = min(exact, key=lambda q: q.seconds, default=None)
        rows.append({
            "scene": Path(scene).stem, "asked": point.value, "made": point.error, "stated": point.stated,
            "seconds": point.seconds, "cpu_seconds": used.seconds, "times_best": ratio, "cpu_times_best": cpu,
            "best": "-" if best is None else f"{best.method.partition('+')[0]} {best.value:g}",
        })  # fmt: skip
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=scenes())
    parser.add_argument("-o", type=Path, default=Path("out/auto"))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--limit", type=float, default=6.0, help="finer settings are left out after one of so long [s]")
    asked = parser.parse_args()
    table = []
    for name in asked.scenes:
        try:
            table += rows_of(name, asked.o, asked.repeats, asked.limit)
        except WorkbenchError as problem_found:
            print(f"{name} is left out: {problem_found}")
            continue
        print(format_table(table), flush=True)
