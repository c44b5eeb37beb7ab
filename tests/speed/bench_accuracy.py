"""Asked, estimated and actual error of solves on every scene whose irradiance is known.

python tests/speed/bench_accuracy.py [ERROR ...]
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from accuracy_cases import accuracy_cases

import radiosity

NEGLIGIBLE = 0.01
"""Share of the asked error below which estimate and error are both as good as nothing."""


def main() -> None:
    """Print the table, then how many errors were kept and how many estimates are within a factor of 3."""
    errors = [float(word) for word in sys.argv[1:]] or [0.05, 0.01, 0.001]
    print(f"{'case':44s} {'asked':>6s} {'estimate':>9s} {'actual':>9s} elements    links     rays seconds")
    rows = kept = near = 0
    for case in accuracy_cases():
        for error in errors:
            start = time.perf_counter()
            solution = radiosity.solve(case.scene, error=error, **case.options)
            seconds = time.perf_counter() - start
            estimate, actual = solution.record.errors["estimate"]["total"], case.actual(solution)
            counters = solution.record.counters
            rows, kept = rows + 1, kept + (actual < error)
            near += max(actual, estimate) < NEGLIGIBLE * error or estimate / 3 < actual < 3 * estimate
            print(
                f"{case.name:44s} {error:6g} {estimate:9.1e} {actual:9.1e} {solution.mesh.element_count:8d}"
                f" {counters['links']:8d} {counters['rays']:8d} {seconds:7.2f}",
                flush=True,
            )
    print(f"{kept} of {rows} errors below what was asked; {near} of {rows} estimates within a factor of 3")


if __name__ == "__main__":
    main()
