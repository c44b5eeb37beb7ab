"""How seconds, memory and links of hierarchical solves grow with the number of elements.

Run with ``python tests/speed/bench_growth.py [--scene office] [--elements 1e3,1e4,1e5,1e6]``; sizes are solved
each in a process of its own, after one that warms the kernels.  The last column is the exponent p of
``seconds ~ (n log n)^p`` against the row before: 1 or less is growth no faster than n log n.

``python tests/speed/bench_growth.py --gather cornell-box`` measures instead, at 1,000 points and one
thread, the irradiance with direct light found at the points against the converged reference of
``sensor_reference.py``.  A hierarchical code of the nineties is on record with a median error of 0.8 %
in 0.33 s and 6.5 % RMS at shadow boundaries.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import time

import numpy as np

import workbench
from radiosity.solvers.hierarchical import solve_hierarchical
from workbench.geometry.flat import Geometry
from workbench.record import RunRecord


def one(name: str, elements: int, workers: int) -> dict[str, float]:
    """Solve once; what it took."""
    scene = workbench.load(name)
    geometry = Geometry.from_scene(scene)
    record = RunRecord(command="bench")
    wall, cpu = time.perf_counter(), time.process_time()
    solution = solve_hierarchical(scene, geometry, record, link_error=None, max_elements=elements, workers=workers)
    return {
        "elements": solution.mesh.element_count,
        "links": record.results["links"],
        "seconds": time.perf_counter() - wall,
        "cpu": time.process_time() - cpu,
        "gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "imbalance": record.errors["energy_imbalance"],
    }


def grow(name: str, sizes: list[int], workers: int) -> None:
    one(name, 200, workers)  # compiles
    out = sys.stdout
    out.write(f"{'elements':>9} {'links':>9} {'seconds':>8} {'cpu s':>8} {'peak GiB':>8} {'energy off':>10} {'p':>5}\n")
    before: dict[str, float] | None = None
    for size in sizes:
        command = [sys.executable, __file__, "--scene", name, "--one", str(size), "--workers", str(workers)]
        row = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        power = math.nan
        if before is not None:
            work = [r["elements"] * math.log(r["elements"]) for r in (before, row)]
            power = math.log(row["cpu"] / before["cpu"]) / math.log(work[1] / work[0])
        out.write(
            f"{row['elements']:9} {row['links']:9} {row['seconds']:8.2f} {row['cpu']:8.2f} {row['gib']:8.2f}"
            f" {row['imbalance']:10.1e} {power:5.2f}\n"
        )
        out.flush()
        before = row


def gathered(name: str, errors: list[float]) -> None:
    from sensor_reference import reference, rms_error, surface_points

    scene = workbench.load(name)
    geometry = Geometry.from_scene(scene)
    runs = reference(name)
    if len(runs) < 2:
        raise SystemExit(f"no reference for {name}; run 'python tests/speed/sensor_reference.py {name}' first")
    points, normals, polygon = surface_points(scene)
    mean = runs.mean(axis=0)
    lit = mean > 0.05 * mean.mean(axis=0)
    out = sys.stdout
    out.write(f"{'link error':>10} {'elements':>8} {'links':>8} {'cpu s':>7} {'RMS':>8} {'median':>8}\n")
    options = {"workers": 1, "direct_in_mesh": False}
    solve_hierarchical(scene, geometry, RunRecord(command="bench"), link_error=1e-2, **options)
    for error in errors:
        record = RunRecord(command="bench")
        start = time.process_time()
        solution = solve_hierarchical(scene, geometry, record, link_error=error, **options)
        seconds = time.process_time() - start
        found = solution.irradiance(points, normals, error=0.002, own_polygon=polygon, rays=2048).irradiance
        median = float(np.median((np.abs(found - mean) / np.where(lit, mean, 1.0))[lit]))
        out.write(
            f"{error:10.1e} {solution.mesh.element_count:8} {record.results['links']:8} {seconds:7.2f}"
            f" {rms_error(found, runs)[0]:8.2%} {median:8.2%}\n"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scene", default="office")
    parser.add_argument("--elements", default="1e3,1e4,1e5,1e6")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--one", type=int)
    parser.add_argument("--gather")
    parser.add_argument("--errors", default="5e-3,2e-3,1e-3,5e-4")
    options = parser.parse_args()
    if options.one:
        sys.stdout.write(json.dumps(one(options.scene, options.one, options.workers)))
    elif options.gather:
        gathered(options.gather, [float(e) for e in options.errors.split(",")])
    else:
        grow(options.scene, [int(float(n)) for n in options.elements.split(",")], options.workers)


if __name__ == "__main__":
    main()
