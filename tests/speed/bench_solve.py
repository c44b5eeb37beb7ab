"""Seconds, rays and the share of Embree in a progressive solve of built-in scenes.

Run with ``python tests/speed/bench_solve.py [SCENE ...] [--repeats N]``.  The kernels are warmed first
by a small solve; repeats of the scenes are interleaved, so that drift of the machine hits all alike.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time

import radiosity
import workbench


def main() -> None:
    """Print one row a scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=["cornell-box", "cornell-box-closed", "office", "sculpture-room"])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--elements", type=int, default=2000)
    parser.add_argument("--tolerance", type=float, default=0.01)
    arguments = parser.parse_args()
    scenes = {name: workbench.load(name) for name in arguments.scenes}
    for scene in scenes.values():
        radiosity.solve(scene, elements=200)
    seconds: dict[str, list[float]] = {name: [] for name in scenes}
    last = {}
    for _ in range(arguments.repeats):
        for name, scene in scenes.items():
            start = time.perf_counter()
            last[name] = radiosity.solve(scene, elements=arguments.elements, tolerance=arguments.tolerance)
            seconds[name].append(time.perf_counter() - start)
    out = sys.stdout
    out.write(
        f"{'scene':20} {'elements':>8} {'patches':>8} {'shots':>6} {'rays':>9} {'exact cuts':>10} {'seconds':>8}"
        f" {'(min-max)':>13} {'form factors':>12} {'in Embree':>9}\n"
    )
    for name, solution in last.items():
        record, times = solution.record, seconds[name]
        threads = record.settings["workers"]
        embree = record.seconds["inside embree, summed over threads"] / threads
        out.write(
            f"{name:20} {solution.mesh.element_count:8} {solution.mesh.patch_count:8} {record.counters['shots']:6}"
            f" {record.counters['rays']:9} {record.counters['exact_cuts']:10} {statistics.median(times):8.2f}"
            f" {min(times):6.2f}-{max(times):6.2f} {record.seconds['form factors'] / times[-1]:12.0%}"
            f" {embree / times[-1]:9.1%}\n"
        )


if __name__ == "__main__":
    main()
