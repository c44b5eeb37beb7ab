"""Gathered pictures against Mitsuba 3's path integrator: seconds to equal error; what atomic sampling saves.

Run with ``python tests/speed/bench_gather.py [SCENE ...] [--size N] [--reference-seconds S]
[--references FOLDER] [--no-mitsuba] [--no-atomic]``; ``--reference-seconds`` is what a reference that is
not yet in the folder may take.

The error of a picture is the root mean square, over the pixels that show neither lamp nor background,
of the norm of its bands' error relative to that of the reference.  A reference has two independent
halves a and b: the mean of (x - a)(x - b) is the squared error of x without the noise of either.

Mitsuba's error falls with the square root of its seconds: its seconds to an error are those of a short
run, measured between ours, times the square of the ratio of errors.  Both use all cores; processor
seconds stand beside wall-clock ones.  Everything is compiled by small runs first.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import radiosity
import workbench
from radiosity.gather import GatherOptions, PictureGatherer
from radiosity.render_command import solve_for
from workbench.render.camera import PinholeRays

FloatArray = NDArray[np.float64]
SHORT_SAMPLES = 32


class Clock:
    """Wall-clock and processor seconds of a block."""

    def __enter__(self) -> Clock:
        self.start, self.cpu_start = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds = time.perf_counter() - self.start
        self.cpu = time.process_time() - self.cpu_start


class Judge:
    """The error of pictures against a reference in two halves."""

    def __init__(self, scene: Any, camera: Any, halves: tuple[FloatArray, FloatArray]) -> None:
        self.a, self.b = halves
        self.whole = 0.5 * (self.a + self.b)
        gatherer = PictureGatherer(radiosity.solve(scene, elements=100), GatherOptions(indirect=False))
        rays = PinholeRays.from_camera(camera)
        lamps = np.array([surface.material.emission.any() for surface in scene.surfaces] + [True])
        self.shown = np.ones(self.whole.shape[:2], dtype=bool)
        row, column = np.divmod(np.arange(self.shown.size), self.shown.shape[1])
        for dx in (0.02, 0.5, 0.98):
            for dy in (0.02, 0.5, 0.98):
                found = gatherer._tracer.trace(rays.eye, rays.directions(column + dx, row + dy))
                self.shown &= ~lamps[found.surface].reshape(self.shown.shape)

    def squares(self, picture: FloatArray) -> FloatArray:
        """Squared relative error of each pixel."""
        product = ((picture - self.a) * (picture - self.b)).sum(axis=2)
        return (product / np.maximum((self.whole**2).sum(axis=2), 1e-300))[self.shown]

    def error(self, picture: FloatArray) -> float:
        """Root mean square relative error."""
        return math.sqrt(max(float(self.squares(picture).mean()), 0.0))

    @property
    def noise(self) -> float:
        """Of the reference as a whole."""
        square = ((self.a - self.b) ** 2).sum(axis=2) / np.maximum((self.whole**2).sum(axis=2), 1e-300)
        return 0.5 * math.sqrt(float(square[self.shown].mean()))


def reference(path: Path, mitsuba: Any, camera: Any, seconds: float) -> tuple[FloatArray, FloatArray]:
    """Two independent halves by Mitsuba, kept in a file."""
    if path.is_file():
        with np.load(path) as stored:
            return stored["a"], stored["b"]
    sums, counts = [0.0, 0.0], [0, 0]
    start = time.perf_counter()
    number = 0
    while number < 2 or time.perf_counter() - start < seconds:
        sums[number % 2] = sums[number % 2] + mitsuba.picture(camera, samples=64, seed=1000 + number)
        counts[number % 2] += 1
        number += 1
    a, b = (total / count for total, count in zip(sums, counts, strict=True))
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, a=a, b=b)
    return np.asarray(a), np.asarray(b)


def ours(scene: Any, camera: Any, error: float, **options: Any) -> tuple[Any, Clock]:
    """A picture from nothing: solve, regather, gather."""
    with Clock() as clock:
        solution = solve_for(scene, error)
        gatherer = PictureGatherer(solution, GatherOptions(error=error, **options))
        picture = gatherer.draw(PinholeRays.from_camera(camera))
    return picture, clock


def against_mitsuba(name: str, size: int, folder: Path, seconds: float) -> None:
    """Print our errors and seconds, and how many times as long Mitsuba takes to the same error."""
    from radiosity.rivals.mitsuba import Mitsuba

    scene = workbench.load(name)
    camera = replace(scene.camera, width=size, height=size)
    mitsuba = Mitsuba(scene)
    judge = Judge(scene, camera, reference(folder / f"{name}-{size}.npz", mitsuba, camera, seconds))
    out = sys.stdout
    out.write(f"\n{name}, {size} x {size}; noise of the reference {judge.noise:.2%}\n")
    out.write(
        f"{'asked':>7} {'error':>7} {'ours s':>7} {'cpu s':>7} {'Mitsuba s':>10} {'cpu s':>8} {'ratio':>7} {'cpu':>7}"
        f"   of a run of s, error\n"
    )
    ours(scene, replace(camera, width=24, height=24), 0.02)
    mitsuba.picture(replace(camera, width=24, height=24), samples=4)
    for asked in (0.1, 0.02, 0.01):
        with Clock() as rival:
            theirs = mitsuba.picture(camera, samples=SHORT_SAMPLES, seed=7)
        picture, clock = ours(scene, camera, asked)
        with Clock() as again:
            other = mitsuba.picture(camera, samples=SHORT_SAMPLES, seed=8)
        short = math.sqrt(0.5 * (judge.error(theirs) ** 2 + judge.error(other) ** 2))
        error = judge.error(picture.radiance)
        wall, cpu = 0.5 * (rival.seconds + again.seconds), 0.5 * (rival.cpu + again.cpu)
        factor = (short / error) ** 2
        out.write(
            f"{asked:7.1%} {error:7.2%} {clock.seconds:7.2f} {clock.cpu:7.2f} {wall * factor:10.1f} {cpu * factor:8.1f}"
            f" {wall * factor / clock.seconds:7.1f} {cpu * factor / clock.cpu:7.1f}   {wall:.2f}, {short:.1%}\n"
        )
        out.flush()


def atomic_savings(name: str, size: int, error: float = 0.02) -> None:
    """Print rays and seconds of a gather with atomic sampling and of one without at equal error."""
    scene = workbench.load(name)
    camera = replace(scene.camera, width=size, height=size)
    rays = PinholeRays.from_camera(camera)
    solution = solve_for(scene, error)
    # The judge: every fragment gathered with many rays, from the same solution, in two halves.
    gatherer = PictureGatherer(solution, GatherOptions(error=error))

    def draw(seed: int, **options: Any) -> tuple[Any, Clock]:
        # The same regathered solution for all: only the gather differs.
        gatherer.options, gatherer.seed = GatherOptions(error=error, **options), seed
        with Clock() as clock:
            picture = gatherer.draw(rays)
        return picture, clock

    halves = [draw(seed, rays=512, atomic=False)[0].radiance for seed in (1, 2)]
    judge = Judge(scene, camera, (halves[0], halves[1]))

    def run(**options: Any) -> tuple[float, int, float, float]:
        picture, clock = draw(3, **options)
        return judge.error(picture.radiance), picture.counters["rays"], clock.seconds, clock.cpu

    run()
    wanted, shot, seconds, cpu = run()
    # Without: between the two numbers of rays whose errors lie on either side, by error ~ rays^-3/4.
    count, before = 8, None
    while True:
        found = run(rays=count, atomic=False)
        if found[0] <= wanted or count >= 4096:
            break
        before, count = found, 2 * count
    share = 1.0
    if before is not None and found[0] < wanted:
        share = math.log(before[0] / wanted) / math.log(before[0] / found[0])
    low = before or found
    between = [math.exp(math.log(low[k]) + share * (math.log(found[k]) - math.log(low[k]))) for k in (1, 2, 3)]
    sys.stdout.write(
        f"{name:16} {wanted:7.2%} {shot / 1e6:9.2f} {between[0] / 1e6:9.2f} {1 - shot / between[0]:7.0%} {seconds:8.2f}"
        f" {between[1]:8.2f} {1 - seconds / between[1]:7.0%} {1 - cpu / between[2]:7.0%}\n"
    )
    sys.stdout.flush()


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--reference-seconds", type=float, default=300.0)
    cache = Path.home() / ".cache" / "radiosity-workbench" / "references"
    parser.add_argument("--references", type=Path, default=cache)
    parser.add_argument("--no-mitsuba", action="store_true")
    parser.add_argument("--no-atomic", action="store_true")
    arguments = parser.parse_args()
    if not arguments.no_mitsuba:
        for name in arguments.scenes or ["cornell-box", "office"]:
            against_mitsuba(name, arguments.size, arguments.references, arguments.reference_seconds)
    if not arguments.no_atomic:
        sys.stdout.write(
            "\nThe same gather with atomic sampling and without, at equal error against one of every fragment\n"
            f"{'scene':16} {'error':>7} {'Mrays':>9} {'without':>9} {'saved':>7} {'s':>8} {'without':>8} {'saved':>7}"
            f" {'cpu':>7}\n"
        )
        for name in arguments.scenes or ["cornell-box", "office", "sculpture-room"]:
            atomic_savings(name, arguments.size)


if __name__ == "__main__":
    main()
