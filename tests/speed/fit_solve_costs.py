"""Fit the table by which ``solve(error=)`` chooses between the full matrix and links.

    python tests/speed/fit_solve_costs.py [SCENE ...]

Solves scenes by both methods with several numbers of elements, twice each, and writes the least processor
seconds' fit to ``radiosity/solve_costs.json``.  Without scenes: some built-in ones, and ``nff-spd/gears_2.nff``
of ``../shared/scenes-external`` (polygons in many pieces) where it is found.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import radiosity
import workbench
from radiosity.solve_costs import TABLE, features, fit
from workbench.geometry.flat import Geometry
from workbench.record import write_text_atomically

COUNTS = {"matrix": (30, 100, 300, 1000), "hierarchical": (100, 200, 400, 800)}
MANY = Path(__file__).resolve().parents[2].parent / "shared/scenes-external/nff-spd/gears_2.nff"


def main() -> None:
    names = sys.argv[1:] or ["cornell-box", "office", "daylight-office", *([str(MANY)] if MANY.exists() else [])]
    rows: dict[str, list] = {method: [] for method in COUNTS}
    for name in names:
        scene = workbench.load(name)
        geometry = Geometry.from_scene(scene)
        polygons, pieces = geometry.polygon_count, len(geometry.piece_start) - 1
        for method, counts in COUNTS.items():
            for count in counts:
                if method == "matrix" and pieces > 2000 and count > min(counts):
                    continue  # all of them have one element a polygon
                used = []
                for _ in range(2):
                    start = time.process_time()
                    found = radiosity.solve(scene, method=method, elements=count)
                    used.append(time.process_time() - start)
                made = found.mesh.element_count
                rows[method].append((features(method, polygons=polygons, pieces=pieces, elements=made), min(used)))
                print(f"{Path(name).stem:16s} {method:13s} {made:6d} elements {min(used):8.3f} s", flush=True)  # noqa: T201
    table = {
        method: {name: float(f"{seconds:.3g}") for name, seconds in fit(each).items()} for method, each in rows.items()
    }
    write_text_atomically(TABLE, json.dumps(table, indent=2) + "\n")
    print(table)  # noqa: T201


if __name__ == "__main__":
    main()
