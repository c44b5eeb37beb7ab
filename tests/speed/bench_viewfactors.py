"""View-factor matrices of a closed room with two boxes, all triangles: seconds, memory and error.

Run with ``python tests/speed/bench_viewfactors.py [--triangles N ...] [--errors E ...] [--no-peers]``.  Each
method runs in a process of its own, kernels warm, and pyViewFactor (extra ``peers``) in the same run.  L1 is
the mean over the rows of the sum of |F_ij - reference|.  The reference is ours at a far smaller error; its own
error is stated, and some of its rows are judged by rays (see the line below the table).
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from view_factor_scenes import closed_room, room_of


def _ours(triangles: int, error: float, workers: int):
    import radiosity

    # The same kernels, compiled or loaded: all levels of care have one signature.
    radiosity.view_factors(closed_room(2.0), error=error, workers=workers)
    scene = room_of(triangles)
    start, work = time.perf_counter(), time.process_time()
    found = radiosity.view_factors(scene, error=error, workers=workers)
    spent = time.perf_counter() - start, time.process_time() - work
    more = {"stated": found.record.errors["stated_row_error"], "found_sums": found.row_sums, "peak_MiB": _peak()}
    return found.dense(), spent, more


def _pyviewfactor(triangles: int, error: float, workers: int):
    import pyvista
    from pyviewfactor import compute_viewfactor_matrix

    def mesh(scene):
        corners = np.concatenate([surface.vertices[surface.ring_vertices] for surface in scene.surfaces])
        return pyvista.PolyData(corners, np.insert(np.arange(len(corners)), 3 * np.arange(len(corners) // 3), 3))

    small, large = mesh(closed_room(2.0)), mesh(room_of(triangles))
    compute_viewfactor_matrix(small, obstacles=small)
    start, work = time.perf_counter(), time.process_time()
    # Its F[i, j] goes from face j to face i.
    factor = np.ascontiguousarray(compute_viewfactor_matrix(large, obstacles=large).T)
    spent = time.perf_counter() - start, time.process_time() - work
    return factor, spent, {"found_sums": factor.sum(axis=1), "peak_MiB": _peak()}


def _peak() -> float:
    """Most memory of this process until now: comparing matrices comes after."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


METHODS = {"ours": _ours, "pyviewfactor": _pyviewfactor}


def _child(method: str, triangles: int, error: float, workers: int, path: str) -> None:
    factor, (seconds, work), more = METHODS[method](triangles, error, workers)
    np.save(path, factor)
    sums = more.pop("found_sums")
    json.dump(
        {
            "seconds": seconds,
            "processor": work,
            "row_sum_error": float(np.abs(factor.sum(axis=1) - 1).max()),
            "row_sum_error_as_found": float(np.abs(sums - 1).max()),
            **more,
        },
        sys.stdout,
    )


def _run(method: str, triangles: int, error: float, workers: int, folder: str):
    path = str(Path(folder) / f"{method}-{triangles}-{error:g}.npy")
    command = [sys.executable, __file__, "--child", method, path, "--triangles", str(triangles)]
    command += ["--errors", repr(error), "--workers", str(workers)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{method} failed: {done.stderr[-2000:]}")
    return np.load(path), json.loads(done.stdout.splitlines()[-1])


def _judge_by_rays(triangles: int, reference, rows: int, rays: int) -> tuple[float, float]:
    """Root mean square z of some rows against directional bundles, and their largest |z|."""
    from radiosity.form_factors.bundle import LinkSettings
    from radiosity.form_factors.directional import DirectionalBundles
    from radiosity.patches import build_mesh
    from workbench.geometry.flat import Geometry

    scene = room_of(triangles)
    geometry = Geometry.from_scene(scene)
    mesh = build_mesh(scene, geometry, split=1, cluster=False)
    finder = DirectionalBundles(geometry, mesh, LinkSettings(rays=max(1, rays // mesh.element_count)), 2)
    chosen = np.linspace(0, mesh.element_count - 1, rows).astype(int)
    columns = finder.columns(chosen)
    finder.close()
    # Entries with many hits only: there the scatter of the replicates is a standard error.
    wanted = reference[:, chosen].T
    weight = mesh.patch_area[chosen, None] / mesh.element_area[None] / rays
    z = ((columns.factor - wanted) / np.where(columns.spread > 0, columns.spread, 1))[columns.factor > 100 * weight]
    return float(np.sqrt((z**2).mean())), float(np.abs(z).max())


def main() -> None:
    """Print a row a size, method and error."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--triangles", type=int, nargs="+", default=[2016, 8112])
    parser.add_argument("--errors", type=float, nargs="+", default=[2e-2, 2e-3])
    parser.add_argument("--reference", type=float, default=3e-5, help="error of the reference")
    parser.add_argument("--reference-limit", type=int, default=3000, help="most triangles with a reference")
    parser.add_argument("--peer-limit", type=int, default=3000, help="most triangles for pyViewFactor")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=1, help="the fastest counts")
    parser.add_argument("--keep", help="folder for references, to use again")
    parser.add_argument("--child", nargs=2, metavar=("METHOD", "FILE"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        method, path = arguments.child
        _child(method, arguments.triangles[0], arguments.errors[0], arguments.workers, path)
        return
    out = sys.stdout
    out.write(
        f"{'triangles':>9}  {'method':24} {'seconds':>8} {'processor':>9} {'peak MiB':>8} {'L1':>9} {'stated':>8}"
        f" {'row sums off by':>15} {'as found':>9}\n"
    )
    for triangles in arguments.triangles:
        count = sum(surface.face_count for surface in room_of(triangles).surfaces)
        with tempfile.TemporaryDirectory() as folder:
            reference, about = None, ""
            if count <= arguments.reference_limit:
                kept = Path(arguments.keep or folder) / f"reference-{count}.npy"
                if not kept.exists():
                    factor, told = _run("ours", triangles, arguments.reference, arguments.workers, folder)
                    np.save(kept, factor)
                    about = f"; its stated L1 is {told['stated']:.1e}"
                reference = np.load(kept)
                rms, largest = _judge_by_rays(triangles, reference, 8, 4_000_000)
                about = (
                    f"reference: ours at error {arguments.reference:g}{about}; 8 columns against 4 million rays each:"
                )
                about += f" z rms {rms:.2f}, largest {largest:.1f}"
            jobs = [("ours", error) for error in arguments.errors]
            if not arguments.no_peers and count <= arguments.peer_limit:
                jobs.append(("pyviewfactor", 0.0))
            best: dict = {}
            for _ in range(arguments.repeats):
                for job in jobs:
                    factor, told = _run(job[0], triangles, job[1], arguments.workers, folder)
                    if job not in best or told["seconds"] < best[job][1]["seconds"]:
                        best[job] = factor, told
            for (method, error), (factor, told) in best.items():
                name = f"{method}, error {error:g}" if method == "ours" else method
                l1 = f"{np.abs(factor - reference).sum(axis=1).mean():.2e}" if reference is not None else ""
                stated = f"{told['stated']:.1e}" if "stated" in told else ""
                out.write(
                    f"{count:9}  {name:24} {told['seconds']:8.2f} {told['processor']:9.2f} {told['peak_MiB']:8.0f}"
                    f" {l1:>9} {stated:>8} {told['row_sum_error']:15.1e} {told['row_sum_error_as_found']:9.1e}\n"
                )
                out.flush()
            if about:
                out.write(f"{'':9}  {about}\n")


if __name__ == "__main__":
    main()
