"""Irradiance at 1,000 surface points of the Cornell box to 1 %: ours, Mitsuba 3 and Radiance, in one run.

    python tests/speed/sensor_reference.py cornell-box      # once: the converged reference
    python tests/speed/bench_sensors.py [--scene cornell-box] [--rivals mitsuba,radiance] [--cold]

Errors are RMS over the points and bands, relative to the mean.  Ours are against the converged
reference (its own noise cancelled); rivals are given theirs from two runs with different seeds, which
leaves out any bias that they have.  For each engine the cheapest setting that reaches 1 % counts.
With ``--cold`` whole processes are timed too, from the shell's view: imports, scene, set-up, answer.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from sensor_reference import reference, rms_error, surface_points

import radiosity
import workbench
from radiosity.rivals.base import black_lamps
from radiosity.sensors import SOLVE_SHARE, left_for_sampling

TARGET = 0.01


def _busy() -> float:
    """Processor seconds of this process and of those it ran."""
    return sum(os.times()[:4])


def _timed(work: Callable[[], np.ndarray]) -> tuple[np.ndarray, float, float]:
    wall, busy = time.perf_counter(), _busy()
    values = work()
    return values, time.perf_counter() - wall, _busy() - busy


def _show(name: str, error: float, wall: float, busy: float, note: str = "") -> None:
    print(f"{name:44s} error {error:7.3%}  wall {wall:7.2f} s  processor {busy:7.2f} s  {note}", flush=True)


def _ours(scene: workbench.Scene, points, normals, own, runs, mesh: tuple[int, float] | None):
    """Error and seconds of a solve and sensors: with so many elements and form factors so good, or by the error."""
    spent: dict[str, float] = {}

    def work() -> np.ndarray:
        start = time.perf_counter()
        if mesh is None:
            solution = radiosity.solve(scene, error=SOLVE_SHARE * TARGET)
        else:
            solution = radiosity.solve(scene, elements=mesh[0], form_factor_error=mesh[1], tolerance=TARGET)
        spent["solve"] = time.perf_counter() - start
        left = left_for_sampling(solution, TARGET)
        found = solution.irradiance(points, normals, own_polygon=own, error=left)
        spent["sensors"] = time.perf_counter() - start - spent["solve"]
        spent["elements"] = solution.mesh.element_count
        return found.irradiance

    values, wall, busy = _timed(work)
    error, resolution = rms_error(values, runs)
    name = "ours, --error" if mesh is None else f"ours, {spent['elements']:.0f} elements"
    note = f"(solve {spent['solve']:.2f}, sensors {spent['sensors']:.2f}; seen to {resolution:.2%})"
    _show(name, error, wall, busy, note)
    return error, wall, busy


def _rival(name: str, ask: Callable[[int, int], np.ndarray], samples: list[int]):
    """Raise the samples until two runs agree to the target: error, seconds and samples of the run that does."""
    for count in samples:
        first, wall, busy = _timed(lambda count=count: ask(count, 1))
        second, *again = _timed(lambda count=count: ask(count, 2))
        wall, busy = min(wall, again[0]), min(busy, again[1])
        share = np.sqrt(((first - second) ** 2).mean(axis=0) / 2) / first.mean(axis=0)
        error = float(np.sqrt((share**2).mean()))
        _show(f"{name}, {count}", error, wall, busy)
        if error <= TARGET:
            return error, wall, busy, count
    return None


COLD_RIVAL = """
import sys
import numpy as np, workbench
sys.path.insert(0, {here!r})
from sensor_reference import surface_points
from radiosity.rivals.{module} import {rival}
from radiosity.rivals.base import black_lamps
scene = {scene}
points, normals, _ = surface_points(workbench.load({name!r}))
values = {rival}(scene{options}).irradiance(points, normals, samples={samples})
np.savetxt({out!r}, values, delimiter=",")
"""


def _cold(name: str, points: np.ndarray, normals: np.ndarray, elements: int | None, samples: dict[str, int]) -> None:
    """Whole processes, from the shell's view: what a user asks, and the mesh that is best by hand."""
    here = str(Path(__file__).parent)
    with tempfile.TemporaryDirectory() as folder:
        np.savetxt(Path(folder) / "points.txt", np.column_stack([points, normals]), fmt="%.17g")
        program = [sys.executable, "-c", "from radiosity.cli import main; main()"]
        command = [
            *program, "irradiance", name, "--points", f"{folder}/points.txt", "-o", f"{folder}/out.csv",
            "--error", str(TARGET),
        ]  # fmt: skip
        jobs = {"ours": command}
        if elements is not None:
            jobs[f"ours, {elements} elements"] = [*command, "--elements", str(elements)]
        for rival, module, scene, options in (
            ("Mitsuba", "mitsuba", f"workbench.load({name!r})", ", sampler='stratified'"),
            ("Radiance", "radiance", f"black_lamps(workbench.load({name!r}))", ""),
        ):
            if rival in samples:
                code = COLD_RIVAL.format(
                    here=here, module=module, rival=rival, scene=scene, name=name, samples=samples[rival],
                    options=options, out=f"{folder}/{module}.csv",
                )  # fmt: skip
                jobs[rival] = [sys.executable, "-c", code]
        # Compiled modules of ours may be kept, as those of the rivals are.
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
        seconds: dict[str, list[float]] = {key: [] for key in jobs}
        for _ in range(3):
            for key, job in jobs.items():
                start = time.perf_counter()
                subprocess.run(job, check=True, capture_output=True, env=environment)
                seconds[key].append(time.perf_counter() - start)
        for key, values in seconds.items():
            ratio = min(values) / min(seconds["ours"])
            print(f"whole process, {key:20s} {min(values):7.2f} s  ({ratio:.1f} times ours)", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scene", default="cornell-box")
    parser.add_argument("--cold", action="store_true", help="time whole processes too")
    parser.add_argument("--rivals", default="mitsuba,radiance", help="which of them; empty for ours only")
    options = parser.parse_args()
    scene = workbench.load(options.scene)
    points, normals, own = surface_points(scene)
    runs = reference(options.scene)
    if len(runs) < 2:
        parser.error(f"no reference yet; run python tests/speed/sensor_reference.py {options.scene} first")
    # Kernels warm: a small question first.
    radiosity.solve(scene, elements=100).irradiance(points[:50], normals[:50], own_polygon=own[:50])
    meshes: list[tuple[int, float] | None] = [(230, 0.1), (300, 0.05), (500, 0.02), None]
    results = {mesh: _ours(scene, points, normals, own, runs, mesh) for mesh in meshes}
    good = {mesh: value for mesh, value in results.items() if value[0] <= TARGET}
    if not good:
        parser.exit(1, "none of ours reached the target\n")
    best = min(good, key=lambda mesh: good[mesh][2])
    from radiosity.rivals.mitsuba import Mitsuba
    from radiosity.rivals.radiance import Radiance

    samples: dict[str, int] = {}
    makers = {
        "mitsuba": ("Mitsuba", lambda: Mitsuba(scene, sampler="stratified"), [k * k for k in (40, 45, 48, 56, 64, 96)]),
        "radiance": ("Radiance", lambda: Radiance(black_lamps(scene)), [1024, 1280, 2048, 4096]),
    }
    for key in filter(None, options.rivals.split(",")):
        name, make, counts = makers[key]
        engine = make()
        engine.irradiance(points[:10], normals[:10], samples=16)  # its kernels warm too
        value = _rival(
            name, lambda n, seed, engine=engine: engine.irradiance(points, normals, samples=n, seed=seed), counts
        )
        if value is not None:
            samples[name] = value[3]
            for mesh in dict.fromkeys([best, None]):  # beside the rival, whatever else the machine does
                again = [_ours(scene, points, normals, own, runs, mesh) for _ in range(3)]
                wall, busy = (min(row[k] for row in again) for k in (1, 2))
                text = f"{name} takes {value[1] / wall:.1f} times our wall seconds, {value[2] / busy:.1f} times"
                print(f"{text} the processor's", flush=True)
    if options.cold:
        _cold(options.scene, points, normals, None if best is None else best[0], samples)


if __name__ == "__main__":
    main()
