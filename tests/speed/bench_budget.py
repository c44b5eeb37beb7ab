"""Does ``budget_seconds`` give its answer in about that time?  A table over the built-in scenes.

python tests/speed/bench_budget.py [--seconds 1,4] [SCENE ...]
"""

from __future__ import annotations

import argparse
import time

import radiosity
import workbench
from workbench.scene.load import built_in_scenes


def main() -> None:
    """A row a scene and budget: seconds taken, error reached, why it stopped."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=list(built_in_scenes()))
    parser.add_argument("--seconds", default="1,4")
    asked = parser.parse_args()
    print(f"{'scene':20s} {'budget':>6s} {'wall s':>7s} {'cpu s':>7s} {'estimate':>9s} elements meshes  stop")
    for name in asked.scenes:
        scene = workbench.load(name)
        radiosity.solve(scene, budget_seconds=0.1)  # its kernels are loaded then
        for budget in (float(word) for word in asked.seconds.split(",")):
            wall, busy = time.perf_counter(), time.process_time()
            solution = radiosity.solve(scene, budget_seconds=budget)
            wall, busy = time.perf_counter() - wall, time.process_time() - busy
            record = solution.record
            print(
                f"{name:20s} {budget:6g} {wall:7.2f} {busy:7.2f} {record.errors['estimate']['total']:9.1e}"
                f" {solution.mesh.element_count:8d} {len(record.results['levels']):6d}  {record.choices['stop']}",
                flush=True,
            )


if __name__ == "__main__":
    main()
