"""Woo's proposal for radiosity, run: directional bundles with the plane-vertex check and without.

Source: A. Woo, "Efficient Shadow Computations in Ray Tracing" (IEEE CG&A 13(5), 1993): bundles of rays shot
from polygons in particular directions to find which polygons receive their power; "using the plane-vertex
check with respect to each bundle of rays, many polygons can be trivially rejected".  He gives no figures.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np

import workbench
from radiosity.form_factors.directional import Bundles, bundle_rays, instrument_bundles
from radiosity.patches import build_mesh
from workbench.accel.voxel_grid import VoxelGrid
from workbench.counters import Counters
from workbench.geometry.flat import Geometry
from workbench.record import RunRecord
from workbench.study.result import StudyResult, interleaved

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["bundles_study"]


def _trace(grid: VoxelGrid, shots: list[tuple[Bundles, int]], check: bool) -> tuple[Counters, list[np.ndarray]]:
    """Every patch's bundles through the grid: counts in all, and the polygons met."""
    counters, met = Counters(), []
    for made, own in shots:
        found = instrument_bundles(grid, made, own, check=check)
        counters.merge(found.counters)
        met.append(found.hits.polygon)
    return counters, met


def bundles_study(
    *,
    scene: str = "office",
    patches: int = 24,
    rays: tuple[int, ...] = (4, 16, 64),
    total: int = 16384,
    repeats: int = 3,
) -> StudyResult:
    """Shoot some patches of a scene in bundles of several sizes, with and without the check.

    Parameters
    ----------
    scene : str
    patches : int
        Spread over all patches of a mesh of one patch a polygon.
    rays : tuple of int
        Rays a bundle; the number of bundles is such that each patch shoots ``total`` rays in all.
    total : int
    repeats : int
        Interleaved runs; the table has the medians.
    """
    settings = {"scene": scene, "patches": patches, "rays": rays, "total": total, "repeats": repeats}
    record = RunRecord("reproduce woo-radiosity-bundles", settings)
    geometry = Geometry.from_scene(workbench.load(scene))
    mesh = build_mesh(workbench.load(scene), geometry, elements=1)
    grid = VoxelGrid(geometry)
    flat = np.flatnonzero(mesh.patch_polygon >= 0)
    chosen = flat[np.linspace(0, len(flat) - 1, min(patches, len(flat))).astype(int)].tolist()
    rows: list[dict[str, Any]] = []
    with record.stage("compile"):
        small = bundle_rays(mesh, chosen[0], bundles=4, rays=2)
        for check in (False, True):
            instrument_bundles(grid, small, int(mesh.patch_polygon[chosen[0]]), check=check)
    for count in rays:
        shots = [
            (bundle_rays(mesh, p, bundles=max(1, total // count), rays=count), int(mesh.patch_polygon[p]))
            for p in chosen
        ]
        tasks = {
            name: lambda shots=shots, check=check: _trace(grid, shots, check)
            for name, check in (("plain", False), ("check", True))
        }
        with record.stage("measure"):
            spent, answers = interleaved(tasks, repeats, time.thread_time)
        same = all((a == b).all() for a, b in zip(answers["plain"][1], answers["check"][1], strict=True))
        before = float(np.median(spent["plain"]))
        for name in ("plain", "check"):
            done = answers[name][0]
            record.counters.merge(done)
            seconds = float(np.median(spent[name]))
            rows.append(
                {
                    "rays_a_bundle": count,
                    "loop": name,
                    "bundles": done["bundles"],
                    "rays": done["rays"],
                    "tests_per_ray": done["polygon_tests"] / done["rays"],
                    "checks_per_bundle": done["plane_vertex_checks"] / done["bundles"],
                    "rejected_per_bundle": done["plane_vertex_culls"] / done["bundles"],
                    "tests_avoided_per_ray": done["tests_avoided"] / done["rays"],
                    "voxels_per_ray": done["voxels_stepped"] / done["rays"],
                    "seconds": seconds,
                    "saved_%": None if name == "plain" else 100.0 * (before - seconds) / before,
                    "same_hits": same,
                }
            )
    checked = rows[1::2]

    def each(value: Any) -> str:
        return ", ".join(f"{value(row):.0f} % ({row['rays_a_bundle']} rays a bundle)" for row in checked)

    plain = dict(zip([row["rays_a_bundle"] for row in rows[::2]], rows[::2], strict=True))
    fewer = each(lambda row: 100.0 * (1.0 - row["tests_per_ray"] / plain[row["rays_a_bundle"]]["tests_per_ray"]))
    rejected = each(lambda row: 100.0 * row["rejected_per_bundle"] / max(row["checks_per_bundle"], 1e-9))
    notes = [
        f"Scene {scene}: {geometry.polygon_count} polygons; {len(chosen)} patches shoot about {total:,} rays each into "
        "strata of equal cosine-weighted size, a bundle a stratum, all of its rays from one point.",
        f"The check leaves fewer intersection tests: {fewer}. Of the polygons checked it rejects {rejected}.",
        f"Time saved: {each(lambda row: row['saved_%'])}; processor seconds of one thread, medians of {repeats} "
        "interleaved runs. Wider bundles reject less; narrow ones check anew more often.",
        "The hits are the same with and without, bit for bit. Woo (1993) proposes this and gives no figures.",
    ]
    return StudyResult(
        "woo-radiosity-bundles",
        f"Directional bundles of {len(chosen)} patches ({scene}), with the plane-vertex check and without",
        rows,
        notes,
        record,
        lambda figure: _draw(figure, rows, scene),
    )


def _draw(figure: Figure, rows: list[dict[str, Any]], scene: str) -> None:
    figure.set_size_inches(11.0, 4.4)
    figure.suptitle(f"Directional bundles from patches ({scene}): plane-vertex check of each bundle against none")
    places = np.arange(len(rows))[::-1]
    labels = [f"{row['rays_a_bundle']} rays a bundle\n{row['loop']}" for row in rows]
    tests, seconds = figure.subplots(1, 2)
    done = np.asarray([row["tests_per_ray"] for row in rows])
    checks = np.asarray([row["checks_per_bundle"] / row["rays_a_bundle"] for row in rows])
    tests.barh(places, done, color="tab:blue", label="intersection tests")
    tests.barh(places, checks, left=done, color="tab:red", label="plane-vertex checks")
    tests.set_xlabel("a ray")
    tests.set_title("Counts")
    tests.set_xlim(0.0, 1.35 * float((done + checks).max()))
    tests.legend(fontsize=8)
    spent = np.asarray([row["seconds"] for row in rows])
    seconds.barh(places, spent, color="tab:orange")
    for place, row in zip(places, rows, strict=True):
        if row["saved_%"] is not None:
            seconds.text(row["seconds"], place, f" {-row['saved_%']:+.0f} %", va="center", fontsize=9)
    seconds.set_xlim(0.0, 1.25 * float(spent.max()))
    seconds.set_xlabel("processor seconds")
    seconds.set_title("Seconds, and change by the check")
    for axes in (tests, seconds):
        axes.set_yticks(places, labels, fontsize=8)
        axes.grid(axis="x", alpha=0.3)
