"""Seconds of ``auto`` at scattered points: sensors on all surfaces, and what a picture first hits.

Run with ``python tests/speed/bench_shadow_points.py``.  Beside ``auto`` stand brute rays through our
own Embree at the number that meets about the same error, in the same run.  Errors are root mean
squares over a subset of the points against exact cuts, relative to their mean.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable

import numpy as np
from bench_shadows import HEIGHT, torus_over_floor

import workbench
from workbench.geometry.flat import Geometry
from workbench.shadow.occlusion import AreaLight, OcclusionEstimate, Shader

Points = tuple[np.ndarray, np.ndarray, np.ndarray]


def lamp_of(geometry: Geometry) -> AreaLight:
    """The first polygon that emits."""
    emits = np.array([np.any(np.asarray(material.emission) > 0) for material in geometry.surface_material])
    lamp = int(np.flatnonzero(emits[geometry.polygon_surface])[0])
    return AreaLight(geometry.piece(geometry.polygon_piece_start[lamp]), np.ones(1), lamp)


def scattered(geometry: Geometry, count: int) -> Points:
    """Random points of all surfaces, uniform by area."""
    rng = np.random.default_rng(0)
    polygon = rng.choice(geometry.polygon_count, count, p=geometry.polygon_area / geometry.polygon_area.sum())
    points = np.empty((count, 3))
    for row, index in enumerate(polygon):
        ring = geometry.piece(rng.integers(*geometry.polygon_piece_start[index : index + 2]))
        points[row] = rng.dirichlet(np.ones(len(ring))) @ ring
    return points, geometry.polygon_normal[polygon], polygon


def first_hits(shader: Shader, eye: np.ndarray, target: np.ndarray, up: np.ndarray, half: float, side: int) -> Points:
    """What a picture of ``side`` x ``side`` pixels sees, normals turned to the eye."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    across = half * (2.0 * (np.arange(side) + 0.5) / side - 1.0)
    x, y = np.meshgrid(across, across)
    rays = (forward + x[..., None] * right + y[..., None] * np.cross(right, forward)).reshape(-1, 3)
    hits = shader.tracer.closest_hit(np.broadcast_to(eye, rays.shape), rays)
    met = hits.polygon >= 0
    normals = shader.geometry.polygon_normal[hits.polygon[met]]
    normals = np.where((normals * rays[met]).sum(axis=1)[:, None] > 0, -normals, normals)
    return eye + hits.t[met, None] * rays[met], normals, hits.polygon[met]


def timed(run: Callable[[], OcclusionEstimate], repeats: int) -> tuple[float, float, OcclusionEstimate]:
    """Least wall-clock and processor milliseconds of some runs, the kernels loaded before."""
    found = run()
    wall, processor = [], []
    for _ in range(repeats):
        start, busy = time.perf_counter(), time.process_time()
        found = run()
        wall.append(time.perf_counter() - start)
        processor.append(time.process_time() - busy)
    return 1e3 * min(wall), 1e3 * min(processor), found


def main() -> None:
    """Print a row a case and method."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    cornell = Geometry.from_scene(workbench.load("cornell-box"))
    box = Shader(cornell, arguments.threads)
    torus = Shader(Geometry.from_scene(torus_over_floor()), arguments.threads)
    square = np.array([[-0.5, -0.5, HEIGHT], [-0.5, 0.5, HEIGHT], [0.5, 0.5, HEIGHT], [0.5, -0.5, HEIGHT]])
    middle, extent = cornell.bounds.mean(axis=0), np.ptp(cornell.bounds, axis=0)
    y, z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    cases = [
        ("Cornell box, 1,000 sensors", box, lamp_of(cornell), scattered(cornell, 1000)),
        (
            "Cornell box, picture of 256 x 256", box, lamp_of(cornell),
            first_hits(box, middle + 0.48 * extent * z, middle, y, 0.8, 256),
        ),
        (
            "torus of 20,736 triangles, picture of 256 x 256", torus, AreaLight(square, np.ones(1)),
            first_hits(torus, np.array([2.0, -2.0, 2.0]), np.array([0.0, 0.0, 0.5]), z, 0.45, 256),
        ),
    ]  # fmt: skip
    for name, shader, light, (points, normals, own) in cases:
        some = np.random.default_rng(1).choice(len(points), min(len(points), 500), replace=False)
        exact = shader.estimate(points[some], normals[some], light, "exact", own_polygon=own[some]).irradiance[:, 0]
        sys.stdout.write(f"{name}: {len(points)} points on {len(np.unique(own))} polygons\n")
        for label, options in (
            ("auto to 1 %", {"method": "auto", "error": 0.01}),
            ("auto to 0.1 %", {"method": "auto", "error": 0.001}),
            ("64 rays", {"method": "rays", "samples": 64}),
        ):
            wall, processor, found = timed(
                lambda o=options, p=points, n=normals, q=own, s=shader, e=light: s.estimate(
                    p, n, e, own_polygon=q, **o
                ),
                arguments.repeats,
            )
            error = np.sqrt(np.mean((found.irradiance[some, 0] - exact) ** 2)) / exact.mean()
            sys.stdout.write(f"  {label:14} {wall:8.1f} ms, processor {processor:8.1f} ms, error {error:.1e}\n")


if __name__ == "__main__":
    main()
