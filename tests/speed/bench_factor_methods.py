"""Is ``auto`` within 1.5 times of the best way to view factors at equal error?  A table over scenes.

    python tests/speed/bench_factor_methods.py [--repeats 3] [--limit 2] [SCENE ...]

Form factors between all polygons of a scene by ``view_factors`` to several errors, and by receiver bundles, hemicubes
and hemisphere rays with settings by hand, interleaved.  The reference is exact cuts to 1e-6, and where polygons
are many 67 million rays, whose noise is taken off.  Rows as in ``bench_shadow_methods.py``: errors are
root mean squares over the pairs relative to the mean, seconds are of the processor, the least of the repeats.
Each method prepares itself in each run (flattens the scene, builds its trees), as ``auto`` does; with
``--prepared`` all but ``auto`` are prepared beforehand.  Two-sided surfaces count by their front, panes as opaque.
Without scenes: the built-in ones of up to 3,000 polygons, and those of ``../shared/scenes-external`` that are found.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from bench_shadow_methods import HERE, ratios

import workbench
from radiosity.report.speed_accuracy import measure
from radiosity.report.techniques import Answer, Reference, Technique, ViewFactors, _repeated
from workbench.errors import WorkbenchError
from workbench.scene.load import built_in_scenes
from workbench.scene.model import Scene
from workbench.study.result import format_table

PLAN = [
    ("auto", (0.1, 0.03, 0.01, 0.003, 0.001)),
    ("bundle", (0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 0.0001)),
    ("hemicube", (1, 4, 16, 64)),
    ("rays", (256, 1024, 4096, 16384, 65536)),
]
EXTERNAL = (
    "cornell-mcguire/CornellBox-Original.obj", "radiance-room/room.rad", "nff-spd/gears_2.nff",
    "cornell-mcguire/CornellBox-Sphere.obj",
)  # fmt: skip
MOST_POLYGONS = 3000
EXACT = 8
"""Polygons up to which the reference is exact; of more, the exact cuts to 1e-6 take minutes."""
MOST_RAYS = 1 << 26
"""Rays of the reference."""


def scenes() -> list[str]:
    """All scenes of the table that are there."""
    folder = HERE.parent / "shared/scenes-external"
    return [*built_in_scenes(), *(str(folder / name) for name in EXTERNAL if (folder / name).exists())]


def one_sided(scene: Scene) -> Scene:
    """The scene with every surface seen from its front alone, and opaque."""
    changed = [
        replace(s, material=replace(s.material, two_sided=False, transmittance=np.zeros_like(s.material.transmittance)))
        for s in scene.surfaces
    ]
    return replace(scene, surfaces=tuple(changed))


class Unprepared(ViewFactors):
    """View factors whose techniques prepare themselves in each run."""

    def technique(self, name: str) -> Technique:
        made = super().technique(name)

        def ask(value: float, seed: int) -> Answer:
            return ViewFactors(self.scene, workers=self.workers).technique(name).ask(value, seed)

        return made if name == "auto" else replace(made, ask=ask)


def reference(problem: ViewFactors) -> Reference:
    """Exact cuts, or rays."""
    polygons = problem.geometry.polygon_count
    if polygons <= EXACT:
        return problem.reference("exact")
    samples = 1 << max(10, (MOST_RAYS // polygons // 4).bit_length() - 1)
    ask = problem.technique("rays").ask
    return _repeated(lambda seed: ask(samples, seed).values, f"4 x {samples:,} rays a polygon")


def rows_of(name: str, repeats: int, limit: float, prepared: bool) -> list[dict]:
    problem = (ViewFactors if prepared else Unprepared)(one_sided(workbench.load(name)))
    polygons = problem.geometry.polygon_count
    if polygons > MOST_POLYGONS:
        print(f"{name}: {polygons:,} polygons are more than {MOST_POLYGONS:,}")
        return []
    judge = reference(problem)
    print(f"{name}: {polygons:,} polygons against {judge.name}, which tell errors from {problem.floor(judge):.1e}")
    runs, notes = measure(problem, judge, PLAN, repeats=repeats, limit=limit, longest=5.0 * limit)
    for note in notes:
        print(f"{name}: {note}")
    return ratios(name, runs, {"polygons": polygons})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=scenes())
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--limit", type=float, default=2.0, help="seconds of a run beyond which it is not repeated")
    parser.add_argument("--prepared", action="store_true", help="leave out what all but auto take to prepare")
    asked = parser.parse_args()
    for name in asked.scenes:
        try:
            table = rows_of(name, asked.repeats, asked.limit, asked.prepared)
        except WorkbenchError as problem_found:
            print(f"{name} is left out: {problem_found}", flush=True)
            continue
        print(format_table(table), flush=True)
