"""The command ``radiosity shadow``: one question to a scene by several methods, and what each cost.

Only ``click`` is imported at the top; everything heavy is imported when the command runs.
"""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from workbench.errors import InputError, OptionError

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from radiosity.surface_grid import Sensors
    from workbench.geometry.flat import Geometry
    from workbench.scene.model import Scene
    from workbench.shadow.occlusion import OcclusionEstimate

__all__ = ["GridSize", "shadow"]

CONVERGED = 4096
"""Rays a point of the run that stands in for an exact one."""
SAMPLED = ("adaptive", "camera", "camera-optimised", "rays", "rays+plane-vertex", "shaft")
"""Methods whose error falls with the number of samples."""
STATES = (("not in shadow", "#f0e442"), ("in shadow", "#3b3b58"), ("complex", "#56b4e9"))
"""The occlusion states, in their order, with colours that the colour-blind can tell apart."""


class GridSize(click.ParamType):
    """A number of points along two sides, such as 32x24."""

    name = "NxM"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", value)
        sides = (int(match[1]), int(match[2])) if match else (0, 0)
        if not all(1 <= side <= 4096 for side in sides):
            self.fail(f"found {value!r}, expected two numbers from 1 to 4096 such as 32x32", param, ctx)
        return sides


class _Counts(click.ParamType):
    """One number or several in rising order, such as 4,16,64."""

    name = "K,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        parts = str(value).split(",")
        counts = tuple(int(part) for part in parts if re.fullmatch(r"[0-9]{1,7}", part))
        if len(counts) < len(parts) or not 1 <= counts[0] <= counts[-1] <= 1 << 20 or sorted(set(counts)) != [*counts]:
            self.fail(f"found {value!r}, expected numbers from 1 to {1 << 20} in rising order: 4,16,64", param, ctx)
        return counts


@click.command()
@click.argument("scene")
@click.option("--grid", type=GridSize(), help="Points on a flat surface.  [default: 32x32]")
@click.option("--surface", metavar="NAME", help="That surface.  [default: the largest that faces up]")
@click.option(
    "--points",
    "points_path",
    type=click.Path(path_type=Path),
    metavar="FILE.csv",
    help="Points from a file instead, a line each: x,y,z,nx,ny,nz.",
)
@click.option("--method", "methods", default="auto", show_default=True, metavar="A,B,...", help="Methods, see below.")
@click.option("--light", metavar="NAME", help="One light only.  [default: all]")
@click.option(
    "--samples",
    type=_Counts(),
    default=(64,),
    show_default="64",
    metavar="K,...",
    help="Rays a point and light, or pixels a picture; of several the errors are charted.",
)
@click.option(
    "--error",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    default=0.01,
    show_default=True,
    metavar="E",
    help="Relative error that 'auto' is to meet.",
)
@click.option("--seed", type=click.IntRange(0, 2**62), default=0, show_default=True, metavar="S", help="Of the rays.")
@click.option("--workers", type=click.IntRange(1, 1024), metavar="N", help="Threads.  [default: all cores]")
@click.option("-o", "--output", "directory", type=click.Path(path_type=Path), metavar="DIR", help="Write files here.")
@click.option("--json", "json_path", metavar="FILE", help="Write the run's record here; - is standard output.")
def shadow(
    scene: str,
    grid: tuple[int, int] | None,
    surface: str | None,
    points_path: Path | None,
    methods: str,
    light: str | None,
    samples: tuple[int, ...],
    error: float,
    seed: int,
    workers: int | None,
    directory: Path | None,
    json_path: str | None,
) -> None:
    """How much of the lights do points of SCENE see, and what does each method do to find out?

    SCENE is a scene file or the name of a built-in scene.  Prints a row a method: rays, intersection
    tests done and avoided, polygons checked and culled, seconds, the error against exact cuts (root
    mean square over the points, relative to their mean irradiance) and the error that the method
    itself states.  Several numbers of samples give a row each, the slope at which the error falls with
    them, and a chart of it.  DIR gets shadow.csv, shadow.png (irradiance, occlusion states, candidates) and
    record.json.

    Methods: adaptive, auto, camera, camera-optimised, exact, rays, rays+plane-vertex, shaft.
    """
    from workbench.record import RunRecord, check_folder

    if points_path is not None and (grid is not None or surface is not None):
        raise OptionError("--points: found --grid or --surface as well, expected one of them; leave the other out")
    for path in (directory, Path(json_path).parent if json_path not in (None, "-") else None):
        check_folder(path)
    if json_path not in (None, "-") and Path(str(json_path)).is_dir():
        raise OptionError(f"--json: found the folder {json_path}, expected a file name")
    record = RunRecord("shadow")
    with record.stage("read"):
        import workbench

        loaded = workbench.load(scene)
    for note in loaded.notes:
        click.echo(f"note: {note}", err=True)
    from workbench.shadow.occlusion import METHODS
    from workbench.study.result import StudyResult, format_table, write_study

    names = [name.strip() for name in methods.split(",")]
    for name in names:
        if name not in METHODS:
            raise OptionError(f"--method: found {name!r}, expected one or more of {', '.join(METHODS)}")
    with record.stage("prepare"):
        from radiosity.surface_grid import read_points, surface_grid
        from workbench.geometry.flat import Geometry

        geometry = Geometry.from_scene(loaded)
        lights = _chosen_lights(loaded, geometry, light)
        if points_path is not None:
            sensors = read_points(points_path)
        else:
            sensors = surface_grid(loaded, geometry, surface, grid or (32, 32))
    rows, found, reference = _run(geometry, lights, sensors, names, samples, error, seed, workers, record)
    record.settings = {
        "scene": scene, "surface": surface, "points": str(points_path) if points_path else None,
        "grid": list(grid) if grid else None, "methods": names, "light": light,
        "samples": list(samples), "error": error, "seed": seed, "workers": workers,
    }  # fmt: skip
    record.choices["reference"] = reference
    title = (
        f"{loaded.name}: {len(sensors.points)} points on {sensors.name}, {len(lights)} light(s), "
        f"{geometry.polygon_count} polygons; errors against {reference}"
    )
    slopes = _slopes(rows)
    notes = [f"{method}: the error falls as samples^{slope:.2f}" for method, slope in slopes.items()]
    result = StudyResult(
        "shadow", title, rows, notes, record, lambda figure: _draw(figure, loaded.name, sensors, found, rows, slopes)
    )
    to_error = json_path == "-"
    click.echo("\n".join([title, "", format_table(rows), *notes]), err=to_error)
    if directory is not None:
        for path in write_study(result, directory):
            click.echo(str(path), err=to_error)
    if json_path is not None:
        record.results |= {"title": title, "rows": rows}
        try:
            record.write(json_path)
        except OSError as problem:
            raise InputError(f"{json_path}: cannot be written: {problem.strerror or problem}") from None


# ---- lights -----------------------------------------------------------------------------------


def _chosen_lights(scene: Scene, geometry: Geometry, name: str | None) -> list[Any]:
    from workbench.shadow.lights import lights_of_scene

    lights = list(lights_of_scene(scene, geometry))
    if not lights:
        raise InputError(f"{scene.name}: found no light, expected a light or a surface with emission")
    if name is None:
        return lights
    # A surface of several faces is as many lights, named surface[0], surface[1]...
    chosen = [light for light in lights if name in (light.name, light.name.rpartition("[")[0])]
    if not chosen:
        known = sorted({light.name for light in lights})
        raise OptionError(f"--light: found {name!r}, expected one of {', '.join(known[:8])}{' ...' * (len(known) > 8)}")
    return chosen


# ---- the runs and their table -------------------------------------------------------------------


def _run(
    geometry: Geometry, lights: list[Any], sensors: Sensors, methods: list[str], samples: tuple[int, ...], error: float,
    seed: int, workers: int | None, record: Any,
) -> tuple[list[dict[str, Any]], dict[str, OcclusionEstimate], str]:  # fmt: skip
    """Rows of the table, the estimates by method, and the name of the reference."""
    import numpy as np

    from workbench.shadow.occlusion import Shader

    shader = Shader(geometry, workers)

    def ask(method: str, count: int, several: slice = slice(None), seed: int = seed) -> OcclusionEstimate:
        return shader.estimate(
            sensors.points[several], sensors.normals[several], lights, method, error=error, samples=count, seed=seed,
            own_polygon=sensors.own[several],
        )  # fmt: skip

    found: dict[str, OcclusionEstimate] = {}
    runs: list[tuple[str, int | None, OcclusionEstimate, float]] = []
    for method in dict.fromkeys(methods):
        with record.stage("load kernels"):  # and compile them on a first run: no part of a method's seconds
            ask(method, samples[-1], slice(0, 2))
        for count in samples if method in SAMPLED else samples[-1:]:
            begin = time.perf_counter()
            with record.stage(method):
                found[method] = ask(method, count)
            runs.append((method, count if method in SAMPLED else None, found[method], time.perf_counter() - begin))
    from workbench.shadow.lights import LinearLight

    lines = any(isinstance(light, LinearLight) for light in lights)
    if lines and geometry.polygon_transmittance.any():
        name, method, count = f"{CONVERGED} rays", "rays", CONVERGED
    else:
        name, method, count = "exact cuts", "exact", 1
    if method == "exact" and "exact" in found:
        reference = found["exact"]
    else:
        with record.stage("reference"):
            reference = ask(method, count, seed=seed + 1)
    found["reference"] = reference
    mean = float(reference.irradiance.mean())
    rows: list[dict[str, Any]] = []
    for method, samples_here, estimate, seconds in runs:
        counted = estimate.counters
        record.counters.merge(counted)
        traced = counted["voxels_stepped"] > 0 or counted["polygon_tests"] > 0
        gap = estimate.irradiance - reference.irradiance
        rows.append(
            {
                "method": method,
                "samples": samples_here,
                "rays": counted["rays"],
                "tests": counted["polygon_tests"] if traced else None,
                "avoided": counted["tests_avoided"] if traced else None,
                "checks": counted["plane_vertex_checks"] + counted["shaft_tests"],
                "culled": counted["plane_vertex_culls"] + counted["shaft_culls"],
                "hit_rate": counted["rays_hit"] / counted["rays"] if traced and counted["rays"] else None,
                "seconds": seconds,
                "error": float(np.sqrt((gap**2).mean())) / mean if mean > 0 and estimate is not reference else None,
                "stated_error": float(np.sqrt((estimate.standard_error**2).mean())) / mean if mean > 0 else None,
            }
        )
    record.errors = {f"{row['method']}: rms error / mean irradiance": row["error"] for row in rows}
    record.results["mean_irradiance_W_m2"] = reference.irradiance.mean(axis=0).tolist()
    return rows, found, name


def _slopes(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Of each method with errors at several numbers of samples, the slope of the error, both logarithmic."""
    import numpy as np

    slopes = {}
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = [(row["samples"], row["error"]) for row in rows if row["method"] == method and row["error"]]
        if len(mine) > 1:
            samples, errors = np.log(np.array(mine, dtype=float)).T
            slopes[method] = float(np.polyfit(samples, errors, 1)[0])
    return slopes


# ---- the figure ---------------------------------------------------------------------------------


def _draw(
    figure: Figure, name: str, sensors: Sensors, found: dict[str, OcclusionEstimate], rows: list[dict[str, Any]],
    slopes: dict[str, float],
) -> None:  # fmt: skip
    """Irradiance of the first method, states and candidates of the first that lists them, side by side.

    Beside them, where a method ran with several numbers of samples, its errors against these.
    """
    import numpy as np
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    method, first = next(iter(found.items()))
    listing = next((m for m, estimate in found.items() if (estimate.candidates >= 0).any()), None)
    # A light that a point does not face says nothing of its state; of several lights the worst counts.
    judge = listing if listing is not None else method
    state = np.ma.masked_array(found[judge].state.astype(float), mask=found[judge].open_share <= 0.0)
    lit, dark = (state == 0).all(axis=1), (state == 1).all(axis=1)
    shown = np.where(lit.filled(False), 0, np.where(dark.filled(True), 1, 2))
    spread = np.ptp(sensors.flat, axis=0)
    aspect = float(min(max(spread[1] / spread[0] if spread[0] > 0 else 1.0, 0.2), 1.5))  # height over width
    wide = aspect < 0.4
    panels = 4 if slopes else 3
    figure.set_size_inches(
        (8.0, 3 * (5.5 * aspect + 1.4) + 4.0 * (panels - 3)) if wide else (14.0 / 3 * panels, 3.6 * aspect + 1.9)
    )
    axes = figure.subplots(panels, 1) if wide else figure.subplots(1, panels)
    left, middle, right = axes[:3]
    figure.suptitle(f"{name}: {len(sensors.points)} points on {sensors.name}")

    picture = _show(left, sensors, first.irradiance.mean(axis=1), cmap="inferno", vmin=0.0)
    figure.colorbar(picture, ax=left, shrink=0.8, label="irradiance, mean of the bands [W m$^{-2}$]")
    left.set_title(f"Irradiance ({method})")
    colours = ListedColormap([colour for _, colour in STATES])
    _show(middle, sensors, shown, cmap=colours, vmin=-0.5, vmax=2.5)
    shares = [float((shown == k).mean()) for k in range(3)]
    middle.legend(
        handles=[
            Patch(facecolor=colour, edgecolor="black", label=f"{label}, {share:.0%}")
            for (label, colour), share in zip(STATES, shares, strict=True)
        ],
        loc="upper center",
        bbox_to_anchor=(0.5, -0.55 / (3.6 * aspect)),
        ncols=3,
        fontsize="small",
        frameon=False,
    )
    middle.set_title(f"Occlusion state ({judge})")
    if listing is not None:
        counts = np.where(found[listing].candidates > 0, found[listing].candidates, 0).sum(axis=1)
        label = "polygons left by the culls, all lights"
    else:
        counts = np.full(len(sensors.points), first.counters["rays"] / len(sensors.points))
        label = "rays a point"
    picture = _show(right, sensors, counts, cmap="viridis", vmin=0.0)
    figure.colorbar(picture, ax=right, shrink=0.8, label=label)
    right.set_title(f"Candidates ({listing})" if listing is not None else "Rays")
    if slopes:
        _chart_errors(axes[3], rows, slopes)


def _chart_errors(axes: Any, rows: list[dict[str, Any]], slopes: dict[str, float]) -> None:
    """Errors made (full) and stated (dashed) against samples, both logarithmic."""
    for number, (method, slope) in enumerate(slopes.items()):
        mine = [row for row in rows if row["method"] == method and row["error"]]
        counts = [row["samples"] for row in mine]
        axes.plot(counts, [row["error"] for row in mine], "os^vD*"[number % 6] + "-", color=f"C{number}",
                  label=f"{method}, slope {slope:.2f}")  # fmt: skip
        axes.plot(counts, [row["stated_error"] for row in mine], "--", color=f"C{number}", linewidth=1)
    axes.set(xscale="log", yscale="log", xlabel="rays a point and light, or pixels a picture",
             ylabel="RMS error / mean irradiance", title="Errors made (full) and stated (dashed)")  # fmt: skip
    axes.grid(True, which="both", alpha=0.3)
    axes.legend(fontsize="small")


def _show(axes: Any, sensors: Sensors, values: NDArray, **style: Any) -> Any:
    """A map of one value a point."""
    import numpy as np

    axes.set_xlabel(f"{sensors.labels[0]} [scene lengths]")
    axes.set_ylabel(f"{sensors.labels[1]} [scene lengths]")
    axes.set_aspect("equal")
    if sensors.shape is None or sensors.cells is None:
        return axes.scatter(*sensors.flat.T, c=values, s=24, edgecolors="grey", linewidths=0.3, **style)
    cells = np.full(sensors.shape[0] * sensors.shape[1], np.nan)
    cells[sensors.cells] = values
    return axes.imshow(
        cells.reshape(sensors.shape), origin="lower", extent=sensors.extent, interpolation="nearest", **style
    )
