"""Fit the table by which ``solve(error=)`` chooses between the full matrix and links.

    python tests/speed/fit_solve_costs.py [SCENE ...]

Solves scenes to several errors by both methods, a few times each, and writes the fit of the least processor seconds to
``radiosity/solve_costs.json``.  Without scenes: some built-in ones, and two of ``../shared/scenes-external`` where they
are found.  A minute on a quiet machine.
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path

import radiosity
import workbench
from radiosity.solve_costs import TABLE, features, fit
from workbench.geometry.flat import Geometry
from workbench.record import write_text_atomically

ERRORS = (0.1, 0.05, 0.02)
REPEATS = 3
EXTERNAL = Path(__file__).resolve().parents[2].parent / "shared/scenes-external"
SCENES = ("cornell-box", "cornell-box-closed", "l-room", "hinged-blocker", "daylight-office", "office")
MORE = ("radiance-room/room.rad", "cornell-mcguire/CornellBox-Original.obj")


def main() -> None:
    names = sys.argv[1:] or [*SCENES, *(str(EXTERNAL / name) for name in MORE if (EXTERNAL / name).exists())]
    rows: dict[str, list] = {"matrix": [], "hierarchical": []}
    for name in names:
        scene = workbench.load(name)
        geometry = Geometry.from_scene(scene)
        size = {"polygons": geometry.polygon_count, "pieces": len(geometry.piece_start) - 1}
        for error in ERRORS:
            least = dict.fromkeys(rows, math.inf)
            # The first of all runs loads the kernels, which the least of several leaves out; both methods in turn.
            for method in [*rows] * REPEATS:
                start = time.process_time()
                radiosity.solve(scene, error=error, method=method)
                least[method] = min(least[method], time.process_time() - start)
            for method, used in least.items():
                rows[method].append((features(method, error=error, **size), used))
                print(f"{Path(name).stem:20s} {method:13s} {error:6g} asked {used:8.3f} s", flush=True)  # noqa: T201
    table = {
        method: {name: float(f"{seconds:.3g}") for name, seconds in fit(each).items()} for method, each in rows.items()
    }
    write_text_atomically(TABLE, json.dumps(table, indent=2) + "\n")
    print(table)  # noqa: T201


if __name__ == "__main__":
    main()
