"""Is ``auto`` within 1.5 times of the best shadow method at equal error?  A table over scenes.

    python tests/speed/bench_shadow_methods.py [--repeats 3] [--grid 48 48] [SCENE ...]

Direct light at points of each scene's largest upward surface (and, ``--scattered N``, at random points
of all surfaces), by every method with several settings, interleaved; the reference is ``exact``.  A row
an error asked of ``auto``: what it made and stated, its seconds, and the ratio to the best of the other
methods at the error that it made, by the line between their settings; ``exact`` may be the best at any.
Seconds are of the processor, the least of the repeats: other work on the machine disturbs these least.
Without scenes: the built-in ones with lights, Woo's tori, the room of ``scenes/sc``, and those of
``../shared/scenes-external`` where they are found.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from bench_shadow_points import scattered

from radiosity.chart_command import _scene
from radiosity.report.speed_accuracy import Run, auto_ratios, measure, points_of
from radiosity.report.techniques import Shadows
from workbench.errors import WorkbenchError
from workbench.scene.load import built_in_scenes
from workbench.study.result import format_table

ERRORS = (0.1, 0.03, 0.01, 0.003, 0.001)
PLAN = [
    ("auto", ERRORS),
    ("exact", (1,)),
    ("shaft", (4, 16, 64, 256, 1024)),
    ("rays", (4, 16, 64, 256, 1024)),
    ("adaptive", (16, 64)),
    ("voxel+plane-vertex", (4, 16)),
    ("camera-optimised", (16, 64, 256, 1024)),
]
HERE = Path(__file__).resolve().parents[2]
EXTERNAL = ("cornell-mcguire/CornellBox-Sphere.obj", "godot-room/room.glb", "nff-spd/tree_11.nff")


def scenes() -> list[str]:
    """All scenes of the table that are there."""
    found = ["woo-tori", *built_in_scenes(), str(HERE / "scenes/sc/room.sc")]
    folder = HERE.parent / "shared/scenes-external"
    return found + [str(folder / name) for name in EXTERNAL if (folder / name).exists()]


def rows_of(name: str, grid: tuple[int, int], count: int, repeats: int, limit: float) -> list[dict]:
    problem = Shadows(_scene(name), grid=grid)
    if count:
        points, normals, own = scattered(problem.geometry, count)
        problem.sensors = dataclasses.replace(problem.sensors, points=points, normals=normals, own=own)
    runs, notes = measure(problem, problem.reference("exact"), PLAN, repeats=repeats, limit=limit)
    for note in notes:
        print(f"{name}: {note}")
    return ratios(name, runs, {"points": len(problem.sensors.points)})


def ratios(name: str, runs: list[Run], size: dict[str, int]) -> list[dict]:
    """A row an error asked of ``auto``, in the least processor seconds of the repeats."""
    points = [
        dataclasses.replace(
            p, seconds=min(r.cpu_seconds for r in runs if (r.method, r.value) == (p.method, p.value))
        )
        for p in points_of(runs)
    ]  # fmt: skip
    return [
        {
            "scene": Path(name).stem, **size, "asked": p.value, "made": p.error, "+-": p.doubt, "stated": p.stated,
            "ms": 1e3 * p.seconds, "times_best": ratio,
            "best": min((q for q in points if q.kind == "ours" and q.error <= p.error), key=lambda q: q.seconds).method
            if ratio
            else "auto",
        }
        for p, ratio in auto_ratios(points)
    ]  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=scenes())
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--grid", type=int, nargs=2, default=(48, 48))
    parser.add_argument("--scattered", type=int, default=0, metavar="N")
    parser.add_argument("--limit", type=float, default=1.0, help="leave out finer settings once a run took longer")
    asked = parser.parse_args()
    for name in asked.scenes:
        try:
            table = rows_of(name, asked.grid, asked.scattered, asked.repeats, asked.limit)
        except WorkbenchError as problem_found:
            print(f"{name} is left out: {problem_found}", flush=True)
            continue
        print(format_table(table), flush=True)
