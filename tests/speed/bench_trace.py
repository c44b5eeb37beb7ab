"""Seconds of the tracer: Table 1's ratios, the check of rows, soft shadows against rays at equal error.

Run ``python tests/speed/bench_trace.py [table|rows|soft] ...``; all three by default, two minutes.
Processor seconds of one thread, the least of three interleaved runs, kernels warm.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np

import workbench
from workbench.accel.voxel_grid import VoxelGrid
from workbench.render.adaptive import adaptive, aliased
from workbench.render.atomic import AtomicOptions
from workbench.render.camera import PinholeRays
from workbench.render.pictures import PICTURES, test_picture
from workbench.render.rows import picture_by_rows
from workbench.render.trace import TraceOptions, Tracer
from workbench.study.result import format_table, interleaved

REPEATS = 3


def _least(tasks):
    for task in tasks.values():
        task()
    seconds, answers = interleaved(tasks, REPEATS, time.process_time)
    return {name: min(found) for name, found in seconds.items()}, answers


def table() -> None:
    """Woo's Table 1 by ratios: at most 2 against aliased on two pictures, 44 % saved on the spheres, 20 on each."""
    rows = []
    for name in PICTURES:
        tracer = test_picture(name, 640, 480).tracer()
        spent, _ = _least(
            {
                "aliased": lambda t=tracer: aliased(t),
                "adaptive": lambda t=tracer: adaptive(t),
                "atomic": lambda t=tracer: adaptive(t, atomic=AtomicOptions()),
                "whole tree": lambda t=tracer: adaptive(t, atomic=AtomicOptions(whole_tree=True)),
            }
        )
        rows.append(
            {"picture": name}
            | {f"{task}_s": value for task, value in spent.items()}
            | {
                "atomic/aliased": spent["atomic"] / spent["aliased"],
                "whole/aliased": spent["whole tree"] / spent["aliased"],
                "saved_%": 100 * (1 - spent["atomic"] / spent["adaptive"]),
                "whole_saved_%": 100 * (1 - spent["whole tree"] / spent["adaptive"]),
            }
        )
    sys.stdout.write(format_table(rows) + "\n\n")


def rows() -> None:
    """One ray a pixel in two passes a row: cast rays in voxels with and without the row's check."""
    found = []
    for name in PICTURES:
        tracer = test_picture(name, 640, 480).tracer()
        grid = VoxelGrid(tracer.geometry)
        passes: dict[bool, list[float]] = {True: [], False: []}
        for turn in range(REPEATS + 1):
            for check in passes:
                picture = picture_by_rows(tracer, check=check, rows=32, grid=grid)
                if turn:
                    passes[check].append(picture.first_pass_s)
                tests = picture.counters["polygon_tests"]
        with_check, without = min(passes[True]), min(passes[False])
        found.append(
            {"picture": name, "tests_unchecked": tests, "cast_s_checked": with_check, "cast_s_unchecked": without,
             "saved_%": 100 * (1 - with_check / without), "second_pass_s": picture.second_pass_s}
        )  # fmt: skip
    sys.stdout.write(format_table(found) + "\n\n")


def soft() -> None:
    """One ray a pixel under area lights: the shadow module against K rays a light, error against 4,096 rays."""
    found = []
    for scene in map(workbench.load, ("cornell-box", "office", "sculpture-room")):
        assert scene.camera is not None
        rays = PinholeRays.from_camera(replace(scene.camera, width=160, height=120))
        tracers = {"shadow module": Tracer(scene)}
        tracers |= {f"{k} rays": Tracer(scene, TraceOptions(light_samples=k)) for k in (16, 64, 256)}
        spent, pictures = _least(
            {name: lambda t=t, rays=rays: aliased(t, rays).radiance for name, t in tracers.items()}
        )
        truth = aliased(Tracer(scene, TraceOptions(light_samples=4096)), rays).radiance
        lamps = truth > 0.9 * truth.max()
        for name, picture in pictures.items():
            off = np.where(lamps, 0.0, picture - truth)
            error = np.sqrt((off**2).mean()) / truth[~lamps].mean()
            found.append({"scene": scene.name, "by": name, "cpu_s": spent[name], "RMS_error_%": 100 * error})
    sys.stdout.write(format_table(found) + "\n\n")


if __name__ == "__main__":
    chosen = sys.argv[1:] or ["table", "rows", "soft"]
    for name in chosen:
        {"table": table, "rows": rows, "soft": soft}[name]()
