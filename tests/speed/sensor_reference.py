"""A converged reference for irradiance at surface points: Mitsuba 3's paths, kept between runs.

    python tests/speed/sensor_reference.py cornell-box office --seeds 4

adds independent runs of 8,192 paths a point to ``~/.cache/radiosity-workbench`` (or the folder named
by ``RADIOSITY_CACHE``).  Because the runs are independent, an error against them can be found without
their own noise: the mean over pairs of runs a, b of (value - a)(value - b) is the mean square error.
With ``--error 0.01 0.003`` each scene is then solved to these errors and judged at its points.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import os
import time
from pathlib import Path

import numpy as np

import radiosity
import workbench
from radiosity.sensors import Gatherer
from workbench.geometry.flat import Geometry
from workbench.scene.model import Scene

POINTS, PATHS = 1000, 8192


def surface_points(scene: Scene, count: int = POINTS, seed: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random points of the fronts of all surfaces, even by area; their normals and polygons."""
    geometry = Geometry.from_scene(scene)
    triangles, piece = geometry.triangles
    a, b, c = triangles.transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    rng = np.random.default_rng(seed)
    t = rng.choice(len(area), count, p=area / area.sum())
    u, v = np.sqrt(rng.random(count))[:, None], rng.random(count)[:, None]
    points = (1 - u) * a[t] + u * (1 - v) * b[t] + u * v * c[t]
    polygon = geometry.piece_polygon[piece[t]]
    return points, geometry.polygon_normal[polygon], polygon


def _folder() -> Path:
    folder = Path(os.environ.get("RADIOSITY_CACHE", Path.home() / ".cache" / "radiosity-workbench"))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def reference(name: str, seeds: int = 0) -> np.ndarray:
    """Irradiance (runs, points, bands) by independent runs: those kept, and new ones up to ``seeds``."""
    scene = workbench.load(name)
    points, normals, _ = surface_points(scene)
    text = scene.path.read_bytes() if scene.path is not None else name.encode()
    key = hashlib.sha256(text + points.tobytes()).hexdigest()[:12]
    runs = []
    engine = None
    for seed in itertools.count():
        path = _folder() / f"{scene.name.replace(' ', '-')}-{key}-{PATHS}-{seed}.npy"
        if not path.exists():
            if seed >= seeds:
                break
            if engine is None:
                from radiosity.rivals.mitsuba import Mitsuba

                engine = Mitsuba(scene)
            start = time.perf_counter()
            values = engine.irradiance(points, normals, samples=PATHS, seed=1000 + seed)
            beside = path.with_name(f".{path.name}.{os.getpid()}.npy")
            np.save(beside, values)
            beside.replace(path)
            print(f"{path.name}: {time.perf_counter() - start:.1f} s", flush=True)  # noqa: T201
        runs.append(np.load(path))
    return np.stack(runs) if runs else np.empty((0, len(points), scene.bands))


def rms_error(values: np.ndarray, runs: np.ndarray) -> tuple[float, float]:
    """RMS error of ``values`` (n, bands) relative to the mean irradiance, and the resolution of that figure.

    All bands count alike, each relative to its own mean.  The noise of the runs cancels on the mean;
    what it leaves is the second number: errors smaller than that cannot be seen.
    """
    mean = runs.mean(axis=(0, 1))
    off = (values[None] - runs) / mean
    pairs = [off[a] * off[b] for a, b in itertools.combinations(range(len(runs)), 2)]
    square = np.mean(pairs, axis=0)
    # Points are independent, bands are not: one figure a point.
    each = square.mean(axis=1)
    doubt = each.std(ddof=1) / np.sqrt(len(each))
    return float(np.sqrt(max(each.mean(), 0.0))), float(np.sqrt(doubt))


def judged(name: str, error: float, runs: np.ndarray) -> str:
    """What a solve to an error, gathered at the points, is off by."""
    scene = workbench.load(name)
    points, normals, polygon = surface_points(scene)
    start = time.perf_counter()
    solution = radiosity.solve(scene, error=error)
    between = time.perf_counter()
    found = Gatherer(solution).irradiance(points, normals, own_polygon=polygon, error=0.5 * error)
    end = time.perf_counter()
    actual, seen_to = rms_error(found.irradiance, runs)
    estimate = solution.record.errors["estimate"]["total"]
    return (
        f"{name} --error {error:g}: estimate {estimate:.2%}, actual {actual:.2%} (seen to {seen_to:.2%}), "
        f"{solution.mesh.element_count} elements, solve {between - start:.1f} s, sensors {end - between:.1f} s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--error", type=float, nargs="+", default=[], help="solve to these, and tell what was reached")
    options = parser.parse_args()
    for name in options.scenes:
        runs = reference(name, options.seeds)
        spread = runs.std(axis=0, ddof=1) / np.sqrt(len(runs)) if len(runs) > 1 else np.zeros(runs.shape[1:])
        share = np.sqrt((spread**2).mean(axis=0)) / runs.mean(axis=(0, 1))
        print(f"{name}: {len(runs)} runs, standard error {share.max():.2%} of the mean a point", flush=True)  # noqa: T201
        for error in options.error:
            print(judged(name, error, runs), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
