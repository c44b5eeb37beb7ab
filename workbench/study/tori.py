"""Woo's tori again: the plane-vertex check on soft shadows from a point light's two-unit line.

Source: A. Woo, "Efficient Shadow Computations in Ray Tracing" (IEEE CG&A 13(5), 1993), "Testing and
results": tori tessellated into triangles, l = 1 light, K = 8 rays to a line from the light P to
P + 2 N where the first ray to P is blocked.  He reports 8.5 % of the overall time saved and
1,369,790 tests avoided, and about 2 % for the adaptive line of 3 to 17 rays.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from workbench.accel.base import NO_POLYGON
from workbench.accel.voxel_grid import VoxelGrid
from workbench.geometry.flat import Geometry
from workbench.geometry.splines import tessellate, torus
from workbench.record import RunRecord
from workbench.render.camera import PinholeRays
from workbench.scene.library import diffuse
from workbench.scene.model import Camera, Scene, Surface
from workbench.shadow.woo import LightOcclusion, adaptive_linear_occlusion, light_occlusion
from workbench.study.result import StudyResult, interleaved

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["FirstHits", "first_hits", "tori_scene", "tori_study"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LIGHT = np.array([-7.0, -6.0, 15.0])
"""The point light P of the tori scene."""

LINE_LENGTH = 2.0
RAYS = 8

PAPER_SAVED = {"kludge, K = 8": 8.5, "kludge, 3 to 17": 2.0}
"""Woo's percentages of overall time."""
PAPER_AVOIDED = 1_369_790

_LOOPS = {False: ": Figure 2, plain", True: ": Figure 4, check"}
_PARTS = ("bundle", "shadow", "overall")

# Centre, axis, radius of the ring: five tori that stand, lie and lean over the floor.
_TORI = (
    ((0.0, 0.0, 3.6), (0.3, -0.2, 1.0), 3.0),
    ((4.5, 4.0, 4.0), (1.0, 0.3, 0.1), 3.0),
    ((-4.5, 4.5, 2.5), (-0.2, 0.9, 0.4), 2.6),
    ((4.5, -4.0, 1.2), (0.0, 0.1, 1.0), 2.6),
    ((-4.5, -3.5, 2.2), (-0.5, 0.2, 0.7), 2.2),
)


def tori_scene(segments: int = 48, sides: int = 24, *, width: int = 640, height: int = 480) -> Scene:
    """Five rational B-spline tori over a floor: ``10 segments sides + 1`` polygons.

    Parameters
    ----------
    segments, sides : int
        Steps around the ring and the tube of each torus, multiples of 4.
    width, height : int
        Of the camera's picture. [pixels]
    """
    paint = diffuse("paint", 0.6)
    floor = np.array([[-16.0, -16, 0], [16, -16, 0], [16, 16, 0], [-16, 16, 0]])
    surfaces = [Surface.from_polygons("floor", paint, [floor])]
    for index, (centre, axis, radius) in enumerate(_TORI):
        exact = torus(radius, 0.3 * radius)
        up = np.asarray(axis) / np.linalg.norm(axis)
        across = np.cross(up, [0.0, 0.6, 0.8])
        across /= np.linalg.norm(across)
        turn = np.stack([across, np.cross(up, across), up])
        vertices, faces, normals = tessellate(
            replace(exact, control=exact.control @ turn + np.asarray(centre)), segments, sides
        )
        surfaces.append(Surface.from_mesh(f"torus {index}", paint, vertices, faces, vertex_normals=normals))
    camera = Camera(
        eye=np.array([2.0, -21.0, 15.0]),
        look_at=np.array([0.5, 0.0, 1.5]),
        up=np.array([0.0, 0.0, 1.0]),
        fov_deg=38.0,
        width=width,
        height=height,
    )
    return Scene("tori", tuple(surfaces), background=np.zeros(1), bands=1, camera=camera)


@dataclass(frozen=True)
class FirstHits:
    """What the camera sees and the light may reach.

    Parameters
    ----------
    pixel : (n,) int
        Index of each point's pixel, row after row.
    points, normals : (n, 3) float
        Normals of the facets, turned toward the eye.
    skip : (n, 2) int
        Each point's own polygon, and -1.
    """

    pixel: IntArray
    points: FloatArray
    normals: FloatArray
    skip: IntArray


def first_hits(grid: VoxelGrid, camera: Camera, toward: FloatArray) -> FirstHits:
    """Points behind the pixel centres of a picture, without those that face away from ``toward`` (k, 3).

    A facet faces away where none of the points of ``toward`` lies above it: no renderer asks for
    its shadow.
    """
    rays = PinholeRays.from_camera(camera)
    along = rays.row_directions(0, rays.height)
    hits = grid.closest_hit(rays.eye, along)
    pixel = np.flatnonzero(hits.polygon != NO_POLYGON)
    polygon, along = hits.polygon[pixel], along[pixel]
    points = rays.eye + hits.t[pixel, None] * along
    normals = grid.geometry.polygon_normal[polygon]
    normals = np.where(np.einsum("ij,ij->i", normals, along)[:, None] > 0.0, -normals, normals)
    heights = np.stack([np.einsum("ij,ij->i", normals, place - points) for place in toward])
    lit = (heights > 0.0).any(axis=0)
    skip = np.column_stack([polygon, np.full(len(polygon), NO_POLYGON)])
    return FirstHits(pixel[lit], points[lit], normals[lit], skip[lit])


def _percent(before: float, after: float) -> float:
    return 100.0 * (before - after) / before


def tori_study(
    *, width: int = 640, height: int = 480, segments: int = 48, sides: int = 24, repeats: int = 3, seed: int = 1
) -> StudyResult:
    """Run Woo's tori: Figure 2 against Figure 4, for his kludge, its adaptive form and a linear light.

    Parameters
    ----------
    width, height : int
        Of the picture, one ray a pixel. [pixels]
    segments, sides : int
        Of each torus.
    repeats : int
        Interleaved runs of each loop; the table has the medians.
    seed : int
        Of the stratified samples on the line.
    """
    record = RunRecord(
        "reproduce woo-tori",
        {
            "width": width,
            "height": height,
            "segments": segments,
            "sides": sides,
            "repeats": repeats,
            "seed": seed,
            "rays": RAYS,
            "line_length": LINE_LENGTH,
            "light": LIGHT.tolist(),
        },
    )
    with record.stage("scene and grid"):
        scene = tori_scene(segments, sides, width=width, height=height)
        geometry = Geometry.from_scene(scene)
        grid = VoxelGrid(geometry)
    assert scene.camera is not None
    fixed = np.stack([LIGHT, LIGHT + [LINE_LENGTH, 0.0, 0.0]])
    with record.stage("compile and sample"):
        seen = first_hits(grid, scene.camera, LIGHT[None])
        lines = np.stack([np.broadcast_to(LIGHT, seen.points.shape), LIGHT + LINE_LENGTH * seen.normals], axis=1)
        rng = np.random.default_rng(seed)
        share = (np.arange(RAYS) + rng.random((len(seen.points), RAYS))) / RAYS
        single = light_occlusion(grid, seen.points, lines, lines[:, :1], check=False, skip_polygons=seen.skip)
        hidden = np.flatnonzero(single.occlusion[:, 0] > 0.0)
        points, skip = seen.points[hidden], seen.skip[hidden]
        ends = lines[hidden]
        samples = ends[:, :1] + share[hidden, :, None] * (ends[:, 1:] - ends[:, :1])
        all_samples = fixed[0] + share[:, :, None] * (fixed[1] - fixed[0])
        few = slice(0, 1)  # one point is enough to compile the last loop before the clock runs
        adaptive_linear_occlusion(grid, points[few], ends[few], skip_polygons=skip[few])
    loops: dict[str, Any] = {}
    for check, loop in _LOOPS.items():
        loops["kludge, K = 8" + loop] = lambda check=check: light_occlusion(
            grid, points, ends, samples, check=check, skip_polygons=skip
        )
        loops["kludge, 3 to 17" + loop] = lambda check=check: adaptive_linear_occlusion(
            grid, points, ends, check=check, skip_polygons=skip
        )
        loops["linear light, K = 8" + loop] = lambda check=check: light_occlusion(
            grid, seen.points, fixed, all_samples, check=check, skip_polygons=seen.skip
        )
    loops["cast"] = lambda: first_hits(grid, scene.camera, LIGHT[None])
    loops["first shadow ray"] = lambda: light_occlusion(
        grid, seen.points, lines, lines[:, :1], check=False, skip_polygons=seen.skip
    )
    with record.stage("measure"):
        # One thread, and its own clock: other programs on the machine do not count.
        spent, answers = interleaved(loops, repeats, time.thread_time)
    cast, first = np.asarray(spent["cast"]), np.asarray(spent["first shadow ray"])
    rows: list[dict[str, Any]] = []
    ranges: list[str] = []
    for light in ("kludge, K = 8", "kludge, 3 to 17", "linear light, K = 8"):
        plain, checked = (np.asarray(spent[light + loop]) for loop in _LOOPS.values())
        before_bundle = first if light.startswith("kludge") else np.zeros_like(first)
        saved = 100.0 * (plain - checked) / (cast + before_bundle + plain)
        ranges.append(f"{light}: {saved.min():.1f} to {saved.max():.1f} %")
        for check, loop in _LOOPS.items():
            found: LightOcclusion = answers[light + loop]
            done = found.counters
            record.counters.merge(done)
            bundle = float(np.median(spent[light + loop]))
            shadow = float(np.median(before_bundle)) + bundle
            overall = float(np.median(cast)) + shadow
            row: dict[str, Any] = {
                "light": light,
                "loop": loop.removeprefix(": "),
                "points": len(found.shots),
                "rays": done["rays"],
                "tests": done["polygon_tests"],
                "avoided": done["tests_avoided"],
                "checks": done["plane_vertex_checks"],
                "culls": done["plane_vertex_culls"],
                "bundle_s": bundle,
                "shadow_s": shadow,
                "overall_s": overall,
                "saved_bundle_%": None,
                "saved_shadow_%": None,
                "saved_overall_%": None,
                "paper_overall_%": None,
                "paper_avoided": None,
            }
            if check:
                row |= {f"saved_{part}_%": _percent(rows[-1][f"{part}_s"], row[f"{part}_s"]) for part in _PARTS}
                row["paper_overall_%"] = PAPER_SAVED.get(light)
                row["paper_avoided"] = PAPER_AVOIDED if light == "kludge, K = 8" else None
            rows.append(row)
    shots = answers["kludge, 3 to 17" + _LOOPS[True]].shots
    brightness = np.zeros(width * height)
    toward = LIGHT - seen.points
    cosine = np.einsum("ij,ij->i", seen.normals, toward) / np.linalg.norm(toward, axis=1)
    soft = single.occlusion[:, 0].copy()
    soft[hidden] = answers["kludge, K = 8" + _LOOPS[True]].occlusion[:, 0]
    brightness[seen.pixel] = cosine * (1.0 - soft)
    notes = _notes(rows, ranges, len(hidden), geometry, grid, shots, cast, first, repeats)
    return StudyResult(
        "woo-tori",
        f"Woo's tori: {geometry.polygon_count:,} polygons, {width} x {height} eye rays, one light, K = 8",
        rows,
        notes,
        record,
        lambda figure: _draw(figure, rows, brightness.reshape(height, width), float(np.median(cast))),
    )


def _prices(rows: list[dict[str, Any]]) -> tuple[float, float]:
    """What an avoided test saved and what a check cost, fitted to the three pairs of loops. [ns]"""
    from scipy.optimize import nnls

    pairs = list(zip(rows[::2], rows[1::2], strict=True))
    counts = np.asarray([[after["avoided"], -after["checks"]] for _, after in pairs], dtype=np.float64)
    saved = np.asarray([before["bundle_s"] - after["bundle_s"] for before, after in pairs])
    test, check = nnls(counts, np.clip(saved, 0.0, None))[0] * 1e9
    return float(test), float(check)


def _notes(rows, ranges, hidden, geometry, grid, shots, cast, first, repeats) -> list[str]:
    four, adaptive = rows[1], rows[3]
    test, check = _prices(rows)
    return [
        f"Woo (1993): 8.5 % of the overall time and 1,369,790 tests avoided with K = 8, about 2 % with 3 to 17. "
        f"Here: {four['saved_overall_%']:.1f} % and {four['avoided']:,} tests; {adaptive['saved_overall_%']:.1f} %.",
        f"Of {rows[-1]['points']:,} points that face the light {hidden:,} are hidden from P and get a bundle. The grid "
        f"of {geometry.polygon_count:,} polygons has {' x '.join(map(str, grid.resolution))} voxels; Figure 2 makes "
        f"{rows[0]['tests'] / rows[0]['rays']:.1f} tests a ray.",
        f"Seconds are the processor time of one thread, medians of {repeats} interleaved runs. Cast rays took "
        f"{np.median(cast):.3g} s, first shadow rays {np.median(first):.3g} s. Overall saving in single runs: "
        f"{'; '.join(ranges)}.",
        "Shadow seconds are the first ray and the bundle; overall seconds add the cast rays. Woo's overall time also "
        "holds shading, mirror reflections to level 3 and up to 25 samples a pixel; ours holds none of these, so the "
        "bundle is a larger share of it and saves more of it. His avoided tests are those of all samples.",
        f"The adaptive bundle ends after 3 rays at {100.0 * float((shots == 3).mean()):.0f} % of the hidden points "
        f"(Woo: the majority). A cull then avoids {adaptive['avoided'] / adaptive['culls']:.1f} tests where it avoids "
        f"{four['avoided'] / four['culls']:.1f} with K = 8, and the bundle is a smaller share of the time.",
        f"The seconds saved fit {test:.0f} ns gained by an avoided test and {check:.0f} ns lost by a check: the check "
        "ends at the first vertex on the wrong side, the test is a watertight one in double precision. A machine or "
        "a test with another ratio of the two saves another share; the counts would stay.",
        "Woo's models, light, camera and grid are not in the paper: the tori, their size against the two-unit line "
        "and the view are ours.",
    ]


def _draw(figure: Figure, rows: list[dict[str, Any]], picture: FloatArray, cast: float) -> None:
    figure.set_size_inches(13.0, 7.6)
    figure.suptitle("Woo's tori: rays to a two-unit line, plain (Figure 2) and with the plane-vertex check (Figure 4)")
    grid = figure.add_gridspec(2, 2, width_ratios=[1.0, 1.25])
    image = figure.add_subplot(grid[:, 0])
    image.imshow(picture, cmap="gray", vmin=0.0, vmax=1.0)
    image.set_title("The kludge's soft shadows, K = 8")
    image.axis("off")
    places = np.arange(len(rows))[::-1]
    labels = [f"{row['light']}\n{row['loop']}" for row in rows]
    counts = figure.add_subplot(grid[0, 1])
    left = np.zeros(len(rows))
    for key, name, colour in (
        ("tests", "intersection tests done", "tab:blue"),
        ("avoided", "tests avoided", "lightsteelblue"),
    ):
        width = np.asarray([row[key] for row in rows]) / 1e6
        counts.barh(places, width, left=left, color=colour, label=name)
        left += width
    checks = np.asarray([row["checks"] for row in rows]) / 1e6
    counts.plot(checks, places, "o", color="tab:red", label="plane-vertex checks")
    counts.set_xlabel("millions")
    counts.set_title("Counts")
    seconds = figure.add_subplot(grid[1, 1])
    left = np.zeros(len(rows))
    for width, name, colour in (
        (np.full(len(rows), cast), "cast rays", "tab:gray"),
        (np.asarray([row["shadow_s"] - row["bundle_s"] for row in rows]), "first shadow ray", "tab:olive"),
        (np.asarray([row["bundle_s"] for row in rows]), "bundle", "tab:orange"),
    ):
        seconds.barh(places, width, left=left, color=colour, label=name)
        left += width
    for place, end, row in zip(places, left, rows, strict=True):
        if row["saved_overall_%"] is not None:
            paper = row["paper_overall_%"]
            told = f"-{row['saved_overall_%']:.1f} %" + ("" if paper is None else f" (Woo: {paper:g} %)")
            seconds.text(end, place, f" {told}", va="center")
    seconds.set_xlim(0.0, 1.28 * left.max())
    seconds.set_xlabel("processor seconds")
    seconds.set_title("Seconds, and overall time saved")
    for axes in (counts, seconds):
        axes.set_yticks(places, labels, fontsize=8)
        axes.legend(fontsize=8)
        axes.grid(axis="x", alpha=0.3)
