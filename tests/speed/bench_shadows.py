"""Seconds at equal measured error: our shadows, stratified rays through embreex, and Mitsuba 3.

Run with ``python tests/speed/bench_shadows.py [-o DIR]``; ``pip install .[peers]`` brings Mitsuba, whose
``llvm`` variant needs LLVM's shared library.

A tilted torus of 20,736 triangles floats over a 3 x 3 floor, a quad light of side 1 hangs at height 2.4,
and the irradiance is wanted at 512 x 512 points of the floor, about half of them in penumbra.  Every
method runs over the same triangles on the same number of threads, warm, scene already built.  Repeats
are interleaved with a new seed each, so that drift of the machine hits all methods alike; what takes
long runs once.  The error is the root mean square over a random subset of the points against exact
cuts there, relative to the mean; the exact cuts are themselves checked by many rays at some points.
Seconds to reach an error lie on the measured error-against-seconds line; beyond its finest setting they
grow with the rays, at the measured slope (marked ~).  Processor seconds stand beside wall-clock seconds:
they tell how much a busy machine distorts the latter (one has been seen to keep both threads of Mitsuba
on one core).  The office, all polygons, asks how exact cutting pays.
"""

from __future__ import annotations

import argparse
import functools
import math
import os
import statistics
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import workbench
from workbench.geometry.flat import Geometry
from workbench.geometry.splines import tessellate, torus
from workbench.scene.library import diffuse
from workbench.scene.model import Scene, Surface
from workbench.shadow.occlusion import AreaLight, Shader

UP = np.array([0.0, 0.0, 1.0])
HEIGHT = 2.4
OFFSET = 1e-5
"""Lifts origins of the rivals' rays off the floor; the torus floats 0.2 above it."""
BLOCK_RAYS = 1 << 16
"""Rays a block of the embreex rival: of 2^14 to 2^20, as fast as any here."""
TARGETS = (0.01, 0.001)
OURS = "auto"


@dataclass
class Case:
    """One method with one setting: ``run(seed)`` gives irradiance (n,) and a number of rays."""

    method: str
    setting: str
    run: Callable[[int], tuple[np.ndarray, int]]
    times: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    rays: int = 0
    scale: float = 1.0

    @property
    def seconds(self) -> float:
        return statistics.median(self.times) * self.scale

    @property
    def processor_seconds(self) -> float:
        return statistics.median(self.processor) * self.scale

    @property
    def error(self) -> float:
        return statistics.median(self.errors)


def torus_over_floor() -> Scene:
    """The torus and the floor, which comes last."""
    grey = diffuse("grey", 0.5)
    vertices, faces, _ = tessellate(torus(0.5, 0.2), 144, 72)
    c, s = math.cos(0.5), math.sin(0.5)
    vertices = vertices @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T + [0, 0, 0.65]
    floor = np.array([[-1.5, -1.5, 0], [1.5, -1.5, 0], [1.5, 1.5, 0], [-1.5, 1.5, 0]])
    surfaces = (Surface.from_mesh("torus", grey, vertices, faces), Surface.from_polygons("floor", grey, [floor]))
    return Scene("torus over a floor", surfaces, bands=1)


def grid(low: np.ndarray, high: np.ndarray, count: int) -> np.ndarray:
    """Centres (count^2, 3) of the cells of a rectangle parallel to the floor."""
    x, y = (low[axis] + (np.arange(count) + 0.5) / count * (high[axis] - low[axis]) for axis in (0, 1))
    return np.stack([*(a.ravel() for a in np.meshgrid(x, y)), np.full(count * count, low[2])], axis=1)


def embreex_cases(triangles: np.ndarray, points: np.ndarray, counts: list[int], threads: int) -> list[Case]:
    """Brute force: stratified rays made by numpy in blocks, cos cos / r^2 weights, blocks over threads."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    mesh = TriangleMesh(scene, triangles.astype(np.float32))
    scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
    start = (points + OFFSET * UP).astype(np.float32)

    def run(side: int, seed: int) -> tuple[np.ndarray, int]:
        count = side * side
        step = max(1, BLOCK_RAYS // count)
        result = np.empty(len(points))
        cells = (np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)).astype(np.float32)

        def block(first: int) -> None:
            origin = start[first : first + step]
            rng = np.random.default_rng((seed, first))
            unit = (rng.random((len(origin), count, 2), dtype=np.float32) + cells) / np.float32(side) - np.float32(0.5)
            along = np.empty((len(origin), count, 3), np.float32)
            along[..., :2] = unit - origin[:, None, :2]
            along[..., 2] = HEIGHT - origin[:, None, 2]
            weight = along[..., 2] ** 2 / np.einsum("pki,pki->pk", along, along) ** 2
            rays = len(origin) * count
            clear = scene.run(
                np.repeat(origin, count, axis=0), along.reshape(rays, 3), dists=np.ones(rays, np.float32),
                query="OCCLUDED",
            )  # fmt: skip
            result[first : first + step] = np.where(np.asarray(clear).reshape(-1, count) == -1, weight, 0).mean(axis=1)

        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(block, range(0, len(points), step)))
        return result, len(points) * count

    run.__dict__["mesh"] = mesh  # Embree does not hold on to the mesh by itself
    sides = [round(math.sqrt(count)) for count in counts]
    return [Case("embreex, stratified", f"K={s * s}", lambda seed, s=s: run(s, seed)) for s in sides]


def mitsuba_cases(triangles: np.ndarray, points: np.ndarray, quick: bool, threads: int) -> list[Case]:
    """Direct light by Mitsuba: its multijitter in a compiled loop, and its samplers in one wavefront.

    The samplers of Mitsuba do not advance inside a compiled loop, so the loop writes out what its
    multijitter does (Kensler 2013) with Mitsuba's own permutation and random numbers.  Errors are
    those of the sampler itself, and the loop is faster as it keeps no ray in memory.
    """
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(threads)
    mesh = mi.Mesh("all", 3 * len(triangles), len(triangles))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(triangles.astype(np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.arange(3 * len(triangles), dtype=np.uint32))
    parameters.update()
    scene = mi.load_dict({"type": "scene", "mesh": mesh})
    start = (points + OFFSET * UP).astype(np.float32).T

    def arriving(origin: mi.Point3f, u: mi.Float, v: mi.Float) -> mi.Float:
        along = mi.Point3f(u - 0.5, v - 0.5, HEIGHT) - origin
        square = dr.squared_norm(along)
        ray = mi.Ray3f(origin, along)
        ray.maxt = mi.Float(1.0)
        return dr.select(scene.ray_test(ray), 0.0, along.z * along.z / (square * square))

    def looped(origin, key, rng, side: int, count: mi.UInt32) -> mi.Float:
        inverse = 1.0 / side

        def body(i, total, rng):
            y = i // side
            x = i - y * side
            across = mi.Float(mi.permute_kensler(x, side, key * 0x68BC21EB)) + rng.next_float32()
            up = mi.Float(mi.permute_kensler(y, side, key * 0x02E5BE93)) + rng.next_float32()
            u, v = (mi.Float(x) + up * inverse) * inverse, (mi.Float(y) + across * inverse) * inverse
            return i + 1, total + arriving(origin, u, v), rng

        return dr.while_loop((mi.UInt32(0), mi.Float(0.0), rng), lambda i, total, rng: i < count, body)[1]

    def loop(side: int, seed: int, many: int) -> tuple[np.ndarray, int]:
        origin = mi.Point3f(np.ascontiguousarray(start[:, :many]))
        lanes = dr.width(origin)
        key, _ = mi.sample_tea_32(dr.arange(mi.UInt32, lanes), mi.UInt32(seed))
        total = looped(origin, key, mi.PCG32(lanes, initstate=mi.UInt64(seed)), side, mi.UInt32(side * side))
        return np.array(total) / side**2, lanes * side**2

    def wavefront(name: str, wanted: int, seed: int, many: int) -> tuple[np.ndarray, int]:
        sampler = mi.load_dict({"type": name, "sample_count": wanted})
        count = sampler.sample_count()
        places = mi.Point3f(np.ascontiguousarray(start[:, :many]))
        lanes = min(many, start.shape[1])
        sampler.set_samples_per_wavefront(count)
        sampler.seed(seed, lanes * count)
        origin = dr.gather(mi.Point3f, places, dr.arange(mi.UInt32, lanes * count) // count)
        unit = sampler.next_2d()
        return np.array(dr.block_sum(arriving(origin, unit.x, unit.y), count)) / count, lanes * count

    everything = start.shape[1]
    cases = []
    for side in (4, 12, 24) if quick else (4, 12, 24, 48):
        loop(side, 1, 512)  # compiles: the kernel knows the side
        cases.append(Case("mitsuba, multijitter loop", f"K={side**2}", lambda s, k=side: loop(k, s, everything)))
    for name in ("multijitter", "stratified", "independent"):
        for count in (64, 256):
            wavefront(name, count, 1, 512)
            whole = functools.partial(wavefront, name, count, many=everything)
            cases.append(Case(f"mitsuba, {name} wave", f"K={count}", lambda seed, whole=whole: whole(seed=seed)))
    return cases


def our_cases(shader: Shader, points: np.ndarray, light: AreaLight, floor: int, tolerances: tuple) -> list[Case]:
    """Our ``auto`` at each tolerance, and ``shaft`` with some numbers of rays."""

    def run(seed: int, method: str, **options) -> tuple[np.ndarray, int]:
        found = shader.estimate(points, UP, light, method, seed=seed, own_polygon=floor, **options)
        return found.irradiance[:, 0], found.counters["rays"]

    return [Case(OURS, f"error={e:g}", lambda s, e=e: run(s, "auto", error=e)) for e in tolerances] + [
        Case("shaft", f"K={k}", lambda s, k=k: run(s, "shaft", samples=k)) for k in (16, 64, 256)
    ]


def measure(cases: list[Case], subset: np.ndarray, truth: np.ndarray, repeats: int, longest: float) -> None:
    """Time all cases, repeats interleaved; skip what would last over ``longest``, repeat only what is short."""
    skipped = set()
    for repeat in range(repeats):
        previous: dict[str, Case] = {}
        for case in cases:
            before = previous.get(case.method)
            if repeat == 0 and before is not None and (before.method in skipped or 4 * before.times[0] > longest):
                skipped.add(case.method)
                continue
            if repeat and (not case.times or case.times[0] > longest / 8):
                continue
            start, processor = time.perf_counter(), time.process_time()
            values, case.rays = case.run(repeat)
            case.times.append(time.perf_counter() - start)
            case.processor.append(time.process_time() - processor)
            case.errors.append(float(np.sqrt(np.mean((values[subset] - truth) ** 2)) / truth.mean()))
            previous[case.method] = case
    cases[:] = [case for case in cases if case.times]


def seconds_to(cases: list[Case], error: float, what: str) -> tuple[float, bool]:
    """Seconds to reach an error: between measured settings, or beyond them, and whether it is beyond.

    Between settings the log-log line joins neighbours.  Beyond the finest one its seconds grow with the
    rays, and the rays by the slope of error against rays over all settings, which no busy machine distorts.
    """
    order = sorted(cases, key=lambda case: case.error)
    x = np.log([max(case.error, 1e-12) for case in order])
    y = np.log([getattr(case, what) for case in order])
    at = math.log(error)
    if at < x[0]:
        if len(order) < 2:
            return math.nan, True
        slope = np.polyfit(x, np.log([case.rays for case in order]), 1)[0]
        return math.exp(y[0] + slope * (at - x[0])), True
    return math.exp(float(np.interp(at, x, y))), False


def table(cases: list[Case]) -> str:
    """One row a case; the last row of a method says what it needs for each target."""
    methods = list(dict.fromkeys(case.method for case in cases))
    ours = [case for case in cases if case.method == OURS]
    base = {(t, what): seconds_to(ours, t, what)[0] for t in TARGETS for what in ("seconds", "processor_seconds")}
    lines = [
        f"{'method':26} {'setting':12} {'rays':>11} {'seconds':>8} {'(min-max)':>15} {'processor':>9} {'error':>8}"
        f" | {'to 1 %':>16} {'ratio':>13} | {'to 0.1 %':>16} {'ratio':>13}"
    ]
    for method in methods:
        rows = [case for case in cases if case.method == method]
        for case in rows:
            span = f"({min(case.times) * case.scale:.2f}-{max(case.times) * case.scale:.2f})"
            line = (
                f"{method:26} {case.setting:12} {case.rays:11} {case.seconds:8.2f} {span:>15}"
                f" {case.processor_seconds:9.2f} {case.error:8.3%}"
            )
            if case is rows[-1]:
                for target in TARGETS:
                    wall, beyond = seconds_to(rows, target, "seconds")
                    busy, _ = seconds_to(rows, target, "processor_seconds")
                    mark = "~" if beyond else ""
                    needs = f"{mark}{wall:.2f} ({busy:.2f})"
                    ratio = f"{wall / base[target, 'seconds']:.1f} ({busy / base[target, 'processor_seconds']:.1f})"
                    line += f" | {needs:>16} {ratio:>13}"
            lines.append(line)
    lines.append("to 1 %, to 0.1 %: wall-clock (processor) seconds; ratio: the same over auto's; ~: beyond the runs")
    return "\n".join(lines)


def stages(shader: Shader, points: np.ndarray, light: AreaLight, floor: int, error: float, threads: int) -> str:
    """Where the seconds of ``auto`` go: its stages, and how much of the rays' is Embree."""
    inside = []
    embree = shader.tracer.blocked_raw

    def timed(origins: np.ndarray, directions: np.ndarray, far: np.ndarray) -> np.ndarray:
        start = time.perf_counter()
        answer = embree(origins, directions, far)
        inside.append((time.perf_counter() - start) / threads)
        return answer

    shader.tracer.blocked_raw = timed  # type: ignore[method-assign]
    try:
        found = shader.estimate(points, UP, light, "auto", error=error, own_polygon=floor)
    finally:
        del shader.tracer.blocked_raw
    parts = ", ".join(f"{name} {seconds:.2f}" for name, seconds in found.seconds.items())
    counted = ", ".join(
        f"{name} {found.counters[name]}" for name in ("rays", "sender_lines", "silhouette_edges", "exact_cuts")
    )
    return f"auto at error={error:g}: {parts} s, of it Embree {sum(inside):.2f} s; {counted}"


def chart(cases: list[Case], side: int, threads: int, path: Path) -> None:
    """Error against seconds, both logarithmic."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 5.5), layout="constrained")
    for number, method in enumerate(dict.fromkeys(case.method for case in cases)):
        rows = [case for case in cases if case.method == method]
        if method == "exact":  # its error lies below any axis
            axes.axvline(rows[0].seconds, color=f"C{number}", linestyle="--", label="exact")
            continue
        axes.plot(
            [case.seconds for case in rows], [case.error for case in rows], "os^vDP*<>"[number % 9] + "-",
            color=f"C{number}", label=method, linewidth=2.5 if method == OURS else 1.2,
        )  # fmt: skip
    for target in TARGETS:
        axes.axhline(target, color="grey", linestyle=":", linewidth=1)
        axes.annotate(f"{target:.1%}", (0.95, target), xycoords=("axes fraction", "data"), va="bottom", color="grey")
    axes.set(xscale="log", yscale="log", xlabel=f"seconds, {threads} threads", ylabel="RMS error / mean irradiance")
    axes.set_title(f"Torus of 20,736 triangles over a floor of {side} x {side} points, quad light")
    axes.grid(True, which="major", alpha=0.3)
    axes.legend(fontsize=8, loc="lower left")
    figure.savefig(path, dpi=110)


def office(arguments: argparse.Namespace) -> str:
    """Rows of ``auto`` on the office's floor under one luminaire."""
    geometry = Geometry.from_scene(workbench.load("office"))
    names = np.array(geometry.surface_name)[geometry.polygon_surface]
    floor = int(np.flatnonzero(names == "floor")[0])
    emits = np.array([np.any(np.asarray(m.emission) > 0) for m in geometry.surface_material])
    lamp = int(np.flatnonzero(emits[geometry.polygon_surface])[0])
    light = AreaLight(geometry.piece(geometry.polygon_piece_start[lamp]), np.ones(1), lamp)
    corners = geometry.piece(geometry.polygon_piece_start[floor])
    points = grid(corners.min(axis=0), corners.max(axis=0), arguments.grid)
    shader = Shader(geometry, arguments.threads)
    subset = np.random.default_rng(2).choice(len(points), arguments.subset, replace=False)
    exact = shader.estimate(points[subset], UP, light, "exact", own_polygon=floor)
    truth = exact.irradiance[:, 0]
    cases = [case for case in our_cases(shader, points, light, floor, TARGETS) if case.method == OURS]
    for case in cases:
        case.run(99)
    measure(cases, subset, truth, arguments.repeats, arguments.longest)
    kinds = np.bincount(exact.state[:, 0], minlength=3) / len(subset)
    lines = [
        f"\noffice: {arguments.grid} x {arguments.grid} points of the floor, {names[lamp]}: {kinds[0]:.0%} lit,"
        f" {kinds[1]:.0%} dark, {kinds[2]:.0%} between; stated error of exact"
        f" {np.sqrt(np.mean(exact.standard_error**2)) / truth.mean():.1e}"
    ]
    for case in cases:
        lines.append(
            f"{case.method:26} {case.setting:12} {case.rays:11} {case.seconds:8.2f}"
            f" {f'({min(case.times):.2f}-{max(case.times):.2f})':>15} {case.processor_seconds:9.2f} {case.error:8.1e}"
        )
    lines.append(stages(shader, points, light, floor, TARGETS[1], arguments.threads))
    return "\n".join(lines)


def main() -> None:
    """Print the tables, and draw the chart where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--grid", type=int, default=512, help="points along one side of the floor")
    parser.add_argument("--subset", type=int, default=4096, help="points at which errors are measured")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--longest", type=float, default=60.0, help="skip what takes more seconds; repeat up to 1/8")
    parser.add_argument("--quick", action="store_true", help="fewer rays, for a first look")
    parser.add_argument("-o", "--output", type=Path, help="folder for the chart")
    arguments = parser.parse_args()
    out = sys.stdout

    geometry = Geometry.from_scene(torus_over_floor())
    floor = geometry.polygon_count - 1
    light = AreaLight(
        np.array([[-0.5, -0.5, HEIGHT], [-0.5, 0.5, HEIGHT], [0.5, 0.5, HEIGHT], [0.5, -0.5, HEIGHT]]), np.ones(1)
    )
    points = grid(np.array([-1.5, -1.5, 0.0]), np.array([1.5, 1.5, 0.0]), arguments.grid)
    subset = np.random.default_rng(1).choice(len(points), min(arguments.subset, len(points)), replace=False)
    start = time.perf_counter()
    shader = Shader(geometry, arguments.threads)
    built = time.perf_counter() - start

    cases = our_cases(shader, points, light, floor, (0.1, 0.03, 0.01, 0.003, 0.001))
    triangles, _ = geometry.triangles
    cases[0].run(99)  # compiles or loads the kernels
    counts = [16, 64, 256] if arguments.quick else [16, 64, 256, 1024]
    cases += embreex_cases(triangles, points, counts, arguments.threads)
    try:
        cases += mitsuba_cases(triangles, points, arguments.quick, arguments.threads)
    except (ImportError, RuntimeError) as reason:
        out.write(f"without mitsuba: {reason}\n")

    shader.estimate(points[subset[:64]], UP, light, "exact", own_polygon=floor)
    start, processor = time.perf_counter(), time.process_time()
    exact = shader.estimate(points[subset], UP, light, "exact", own_polygon=floor)
    exact_seconds, exact_processor = time.perf_counter() - start, time.process_time() - processor
    truth = exact.irradiance[:, 0]
    stated = float(np.sqrt(np.mean(exact.standard_error**2)) / truth.mean())
    some = subset[:64]
    many, _ = embreex_cases(triangles, points[some], [65536], arguments.threads)[0].run(5)
    apart = float(np.sqrt(np.mean((many - truth[:64]) ** 2)) / truth.mean())
    share = exact.visible_share[:, 0] / exact.open_share[:, 0]
    penumbra = np.mean((share > 1e-3) & (share < 1 - 1e-3))
    out.write(
        f"{len(triangles) - 2} triangles and a floor, {len(points)} points, {arguments.threads} threads,"
        f" load {os.getloadavg()[0]:.1f}; {penumbra:.0%} of the points in penumbra, {np.mean(share <= 1e-3):.0%} dark\n"
        f"reference: exact cuts at {len(subset)} points, stated error {stated:.1e} of the mean;"
        f" 65,536 embreex rays at 64 of them differ by {apart:.1e}\n"
        f"scene made ready for ours in {built:.2f} s, not counted, nor are the rivals'\n\n"
    )
    measure(cases, subset, truth, arguments.repeats, arguments.longest)
    cases.insert(
        [case.method for case in cases].index("embreex, stratified"),
        Case(
            "exact", "subset", lambda seed: (truth, 0), [exact_seconds], [exact_processor], [stated],
            scale=len(points) / len(subset),
        ),
    )  # fmt: skip
    out.write(table(cases) + "\n\n")
    for error in TARGETS:
        out.write(stages(shader, points, light, floor, error, arguments.threads) + "\n")
    out.write(office(arguments) + "\n")
    if arguments.output:
        arguments.output.mkdir(parents=True, exist_ok=True)
        chart(cases, arguments.grid, arguments.threads, arguments.output / "shadows.png")
        out.write(f"chart: {arguments.output / 'shadows.png'}\n")


if __name__ == "__main__":
    main()
