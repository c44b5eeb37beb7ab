"""The command ``radiosity render``: pictures from a solution, and of direct light alone.

Only ``click`` is imported at the top; everything heavy is imported when the command runs.
"""

from __future__ import annotations

import json
import math
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from radiosity.stopping import INTERRUPTED, solve_progress
from workbench.errors import InputError, OptionError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from radiosity.gather import Picture
    from radiosity.solvers.solution import Solution
    from workbench.record import RunRecord
    from workbench.scene.model import Camera, Scene

__all__ = ["render", "solve_for"]

SOLVE_ERROR = 2.0
"""Error of the solve, as a multiple of the picture's: the gather refines what it reads."""
FEW_POLYGONS = 2000
"""Scenes of more are tessellated, and one mesh by a rule costs a fifth of two that tell their error (measured)."""
QUICK_ERROR = 0.1
ROUGH_PIXELS = 120_000
"""Pixels of the rough picture that stands in until the real one is drawn."""
WRITE_EVERY = 2.0
"""Least time between two pictures of one that is being drawn. [s]"""


class _Numbers(click.ParamType):
    """Three numbers with commas between."""

    name = "X,Y,Z"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in value.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
            self.fail(f"found {value!r}, expected three numbers such as 1,0,2.5", param, ctx)
        return numbers


class _Size(click.ParamType):
    """A width and a height in pixels, such as 640x480."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        width, _, height = value.partition("x")
        if not (width.isdigit() and height.isdigit() and 1 <= int(width) <= 16384 and 1 <= int(height) <= 16384):
            self.fail(f"found {value!r}, expected two numbers from 1 to 16384 such as 640x480", param, ctx)
        return int(width), int(height)


def _finite(context: click.Context, parameter: click.Parameter, value: float | None) -> float | None:
    """Refuse nan and inf, which pass click's range checks."""
    if value is not None and not math.isfinite(value):
        raise click.BadParameter(f"{value} is not a finite number.", ctx=context, param=parameter)
    return value


_DIRECT_ONLY = (
    "sampling", "side", "components", "whole_tree", "normal_angle", "shared_boundary", "threshold", "level", "depth",
    "shadow_error", "light_samples", "bundle", "falloff",
)  # fmt: skip
_GATHER_ONLY = ("solution_path", "error", "quick", "gather_rays", "show_samples", "resume", "denoise")


@click.command()
@click.argument("scene", required=False)
@click.option(
    "-o", "--output", "path", required=True, type=click.Path(path_type=Path), metavar="IMAGE",
    help="A .png, .tif or .tiff through a tone curve, or .exr or .hdr with radiance as it is [W/(m2 sr)].",
)  # fmt: skip
@click.option(
    "--solution", "solution_path", type=click.Path(path_type=Path), metavar="DIR", help="Draw from this solution."
)
@click.option("--camera", "camera_name", metavar="NAME", help="One of the scene's [cameras.NAME].")
@click.option("--eye", type=_Numbers(), help="Draw from here.")
@click.option("--look-at", type=_Numbers(), help="Toward there.")
@click.option("--up", type=_Numbers(), help="What is up in the picture.")
@click.option("--fov", type=click.FloatRange(0, 180, min_open=True, max_open=True), metavar="DEG", help="Vertical.")
@click.option("--size", type=_Size(), help="[default: the camera's]")
@click.option("--width", type=click.IntRange(1, 16384), metavar="PIXELS", help="The height follows the camera's shape.")
@click.option(
    "--error", type=click.FloatRange(0, 1, min_open=True, max_open=True), callback=_finite, metavar="E",
    help="Relative error of a pixel, root mean square over the picture.  [default: 0.02]",
)  # fmt: skip
@click.option("--quick", is_flag=True, help=f"A fast look: the same as --error {QUICK_ERROR}.")
@click.option(
    "--gather-rays", type=click.IntRange(1, 65536), metavar="N", help="Of a hemisphere bundle.  [default: as E needs]"
)
@click.option(
    "--tone", type=click.Choice(["linear", "reinhard", "filmic"]), default="linear", show_default=True,
    help="Curve from radiance to the display, for .png and .tif.",
)  # fmt: skip
@click.option(
    "--exposure", type=float, callback=_finite, default=0.0, show_default=True, metavar="STOPS",
    help="Brighter by powers of two.",
)  # fmt: skip
@click.option(
    "--white", type=click.FloatRange(min=0, min_open=True), callback=_finite, metavar="L",
    help="Radiance shown as white by the linear curve.  [default: found from the picture]",
)  # fmt: skip
@click.option("--show-samples", is_flag=True, help="Also write IMAGE-samples.png: where each component was sampled.")
@click.option("--denoise", is_flag=True, help="Also write IMAGE-denoised, filtered by non-local means.")
@click.option("--resume", is_flag=True, help="Go on with a picture that was stopped.")
@click.option("--direct-only", is_flag=True, help="Without a solve: lights, shadows, mirrors and glass alone.")
@click.option(
    "--sampling", type=click.Choice(["aliased", "rows", "supersampled", "adaptive", "atomic"]), default="atomic",
    show_default=True,
    help="One ray a pixel; the same row by row with counted plane-vertex checks; a square of rays a pixel; adaptive "
    "sampling; atomic adaptive sampling.",
)  # fmt: skip
@click.option(
    "--side", type=click.IntRange(1, 64), default=4, show_default=True, help="Rays each way, if supersampled."
)
@click.option(
    "--atomic", "components", default="shadows,cast,reflection,refraction", show_default=True, metavar="LIST",
    help="What atomic adaptive sampling may assume.",
)  # fmt: skip
@click.option("--whole-tree", is_flag=True, help="Assume down the whole ray tree, not at its top only.")
@click.option(
    "--normal-angle", type=click.FloatRange(0, 180, min_open=True), callback=_finite, metavar="DEG",
    help="Assume nothing where normals differ by more than this.  [default: no such criterion]",
)  # fmt: skip
@click.option("--shared-boundary", is_flag=True, help="Also cut pixels on whose boundary a neighbour's samples differ.")
@click.option(
    "--threshold", type=click.FloatRange(min=-1, max=1), callback=_finite, default=0.06, show_default=True,
    metavar="T", help="Cut pixels whose corners differ by more than this share of white.",
)  # fmt: skip
@click.option("--level", type=click.IntRange(1, 8), default=3, show_default=True, help="Of subdivision; 3: 25 samples.")
@click.option("--depth", type=click.IntRange(0, 16), default=3, show_default=True, help="Reflections in a row.")
@click.option(
    "--shadow-error", type=click.FloatRange(0, 1, min_open=True, max_open=True), callback=_finite, default=0.02,
    show_default=True, metavar="E", help="Wanted error of a light's visible share, at a sample.",
)  # fmt: skip
@click.option(
    "--light-samples", type=click.IntRange(1, 4096), metavar="K",
    help="Rather take K shadow rays to each linear or area light, as in the papers.",
)  # fmt: skip
@click.option(
    "--bundle", type=click.IntRange(1, 4096), default=1, show_default=True, help="Rays of a fuzzy reflection."
)
@click.option(
    "--falloff/--no-falloff", default=None, help="Of point lights, by distance squared.  [default: no for .nff files]"
)
@click.option("--workers", type=click.IntRange(1, 1024), metavar="N", help="Threads.  [default: all cores]")
@click.option("--seed", type=click.IntRange(0, 2**62), default=0, show_default=True, metavar="S", help="Of the rays.")
@click.option("--json", "json_path", metavar="FILE", help="Write the run's record here; - is standard output.")
@click.pass_context
def render(context: click.Context, scene: str | None, path: Path, direct_only: bool, **given: Any) -> None:
    """Draw SCENE, a scene file or the name of a built-in scene, into IMAGE.

    Solves the scene first, as well as the picture needs, unless --solution gives a solution; then
    gathers the light of each pixel.  A rough picture stands in IMAGE after a few seconds and is
    replaced tile by tile; Ctrl-C leaves what is drawn, and --resume goes on from there.

    \b
    Only with --direct-only: --sampling, --side, --atomic, --whole-tree, --normal-angle,
    --shared-boundary, --threshold, --level, --depth, --shadow-error, --light-samples, --bundle,
    --falloff.
    """
    from workbench.render.image import check_picture_path

    misplaced = _GATHER_ONLY if direct_only else _DIRECT_ONLY
    default = click.core.ParameterSource.DEFAULT
    for parameter in context.command.params:
        if parameter.name in misplaced and context.get_parameter_source(parameter.name) is not default:
            other = "cannot be combined with" if direct_only else "belongs to"
            raise OptionError(f"{parameter.opts[-1]} {other} --direct-only; leave one of them out")
    if given["eye"] is not None and given["camera_name"] is not None:
        raise OptionError("--eye: found --camera as well, expected one of them; leave the other out")
    if given["size"] is not None and given["width"] is not None:
        raise OptionError("--width: found --size as well, expected one of them; leave the other out")
    if scene is None and given["solution_path"] is None:
        raise OptionError("SCENE: found none, expected a scene file or --solution DIR")
    check_picture_path(path, radiance=True)
    json_path = given["json_path"]
    if json_path not in (None, "-") and not Path(str(json_path)).parent.is_dir():
        raise InputError(f"{json_path}: found no such folder, expected one; give another --json FILE")
    if direct_only:
        _render_direct(scene or "", path, **given)
    else:
        _render_gathered(scene, path, **given)


def _chosen_camera(
    scene: Scene, found: Camera, camera_name: str | None, eye: Any, look_at: Any, up: Any, fov: Any, size: Any,
    width: int | None,
) -> Camera:  # fmt: skip
    """The camera asked for; ``found`` gives what is not said."""
    import numpy as np

    camera = found
    if camera_name is not None:
        if camera_name not in scene.cameras:
            known = ", ".join(sorted(scene.cameras)) or "none: add [cameras.NAME] to the scene"
            raise OptionError(f"--camera: found {camera_name!r}, expected one of the scene's: {known}")
        camera = scene.cameras[camera_name]
    for name, value in (("eye", eye), ("look_at", look_at), ("up", up)):
        if value is not None:
            camera = replace(camera, **{name: np.array(value)})  # type: ignore[arg-type]
    if fov is not None:
        camera = replace(camera, fov_deg=fov)
    if size is not None:
        camera = replace(camera, width=size[0], height=size[1])
    elif width is not None:
        camera = replace(camera, width=width, height=max(1, round(width * camera.height / camera.width)))
    return camera


# ---- from a solution ----------------------------------------------------------------------------


def solve_for(scene: Scene, error: float, **options: Any) -> Solution:
    """A solution for a picture of an error: the gather refines what it reads, so a coarse one will do.

    ``options`` are those of :func:`radiosity.solve`.
    """
    import radiosity

    polygons = sum(surface.face_count for surface in scene.surfaces)
    if polygons <= FEW_POLYGONS:
        solution = radiosity.solve(scene, error=min(SOLVE_ERROR * error, 0.5), **options)
    else:
        elements = int(min(max(8.0 / error, 100), 4000))
        solution = radiosity.solve(scene, elements=elements, tolerance=min(0.25 * error, 0.05), **options)
        solution.record.choices["elements"] = f"by a rule, for {polygons} polygons are too many to compare meshes"
    return solution


def _render_gathered(
    scene_name: str | None, path: Path, *, solution_path: Path | None, error: float | None, quick: bool,
    gather_rays: int | None, tone: str, exposure: float, white: float | None, show_samples: bool, denoise: bool,
    resume: bool, workers: int | None, seed: int, json_path: str | None, camera_name: str | None, eye: Any,
    look_at: Any, up: Any, fov: Any, size: Any, width: int | None, **_: Any,
) -> None:  # fmt: skip
    if quick and error is not None:
        raise OptionError("--quick: found --error as well, expected one of them; leave the other out")
    wanted = QUICK_ERROR if quick else 0.02 if error is None else error
    if denoise:
        from radiosity.denoise import require_denoiser

        require_denoiser()
    from radiosity.gather import GatherOptions, Picture, PictureGatherer
    from radiosity.view import solution_camera
    from workbench.record import RunRecord
    from workbench.render.camera import PinholeRays

    record = RunRecord("render")
    begin = time.perf_counter()
    kept = path.with_name(path.name + ".resume.npz")
    kept_solution = path.with_name(path.name + ".solution")
    if resume and not (kept.is_file() or kept_solution.is_dir()):
        raise InputError(f"{kept}: not found, expected what a stopped picture leaves; draw without --resume")
    solution = _solution(scene_name, solution_path, wanted, workers, seed, record, kept_solution if resume else None)
    again = "give --resume to go on"
    if solution.stopped == "interrupted" and solution_path is None:
        _write_solution(kept_solution, solution)
        click.echo(f"radiosity: stopped during the solve; {kept_solution} holds it, {again}", err=True)
        raise SystemExit(INTERRUPTED)
    if solution.scene.bands not in (1, 3):
        raise InputError(f"{solution.scene.name}: found {solution.scene.bands} bands, expected 1 or 3 for a picture")
    found = solution_camera(solution)
    camera = _chosen_camera(solution.scene, found, camera_name, eye, look_at, up, fov, size, width)
    rays = PinholeRays.from_camera(camera)
    options = GatherOptions(error=wanted, rays=gather_rays)
    record.settings = {
        "scene": scene_name, "solution": str(solution_path) if solution_path else None, "error": wanted,
        "gather_rays": gather_rays, "tone": tone, "exposure": exposure, "workers": workers, "seed": seed,
        "camera": {"eye": camera.eye.tolist(), "look_at": camera.look_at.tolist(), "up": camera.up.tolist(),
                   "fov_deg": float(camera.fov_deg), "width": camera.width, "height": camera.height},
    }  # fmt: skip
    canvas = _Canvas(path, tone, exposure, white)
    identity = json.dumps(record.settings | {"elements": solution.mesh.element_count}, sort_keys=True)
    state = _read_state(kept, identity) if resume and kept.is_file() else None
    picture: Picture | None = None
    try:
        if state is None and camera.width * camera.height * (QUICK_ERROR / wanted) > ROUGH_PIXELS:
            with record.stage("rough picture"):
                canvas.rough(solution, camera, workers, seed)
            record.results["seconds_to_rough_picture"] = time.perf_counter() - begin
        with record.stage("regather"):
            gatherer = PictureGatherer(solution, options, workers=workers, seed=seed)
        picture = Picture(gatherer, rays)
        if state is not None:
            picture.resume(state)
            canvas.under = state["under"] if state["under"].size else None
        with record.stage("gather"):
            _draw(picture, canvas)
    except KeyboardInterrupt:
        if solution_path is None:
            _write_solution(kept_solution, solution)
        if picture is None or not (picture.drafted or canvas.under is not None):
            if solution_path is None:
                click.echo(f"radiosity: stopped before the picture; {kept_solution} holds the solve, {again}", err=True)
            raise SystemExit(INTERRUPTED) from None
        canvas.write(picture)
        _write_state(kept, identity, picture, canvas.under)
        done = len(picture.finished | picture.drafted)
        click.echo(
            f"radiosity: stopped after {done} of {len(picture.tiles)} tiles; {path} holds what is drawn, {again}",
            err=True,
        )
        raise SystemExit(INTERRUPTED) from None
    canvas.write(picture)
    _forget(kept, kept_solution)
    with record.stage("error estimate"):
        record.errors["picture_relative_rms"] = picture.measured_error()
    record.counters.merge(picture.counters)
    files = [path]
    if show_samples:
        files.append(_write_samples(picture, path))
    if denoise:
        files.append(canvas.write_denoised(picture, path))
    pixels = camera.width * camera.height
    record.results |= {
        "elements": solution.mesh.element_count,
        "elements_read": gatherer.elements_read,
        "samples_per_pixel": {name: float(count.mean()) for name, count in picture.samples.items()},
    }
    if json_path is not None:
        record.write(json_path)
    lines = [
        f"{solution.scene.name}: {camera.width} x {camera.height}, error of a pixel "
        f"{record.errors['picture_relative_rms']:.2g} where {wanted:g} was asked; "
        + ", ".join(f"{count.sum() / pixels:.3g} {name}" for name, count in picture.samples.items())
        + " samples a pixel",
        f"{record.counters['rays']:,} rays; read from {gatherer.elements_read} elements",
        "seconds: " + "; ".join(f"{stage} {spent:.2f}" for stage, spent in record.seconds.items()),
        *map(str, files),
    ]
    click.echo("\n".join(lines), err=json_path == "-")


def _solution(
    scene_name: str | None, solution_path: Path | None, error: float, workers: int | None, seed: int,
    record: RunRecord, kept: Path | None,
) -> Solution:  # fmt: skip
    """The solution to draw from: a saved one, or a new one that is as good as the picture needs.

    ``kept`` is the folder in which a stopped run left its solution, if this one resumes it.
    """
    if solution_path is not None:
        from radiosity.solvers.solution import Solution

        with record.stage("read"):
            solution = Solution.load(solution_path)
            if scene_name is not None:
                import workbench

                solution = replace(solution, scene=workbench.load(scene_name))
        return solution
    import workbench

    with record.stage("read"):
        scene = workbench.load(scene_name or "")
    for note in scene.notes:
        click.echo(f"note: {note}", err=True)
    previous = None
    if kept is not None and kept.is_dir():
        from radiosity.solvers.solution import Solution

        previous = Solution.load(kept)
        previous.scene = scene
        if previous.record.settings.get("picture_error") != error:
            raise InputError(f"{kept}: found another picture's; give the same options, or draw without --resume")
    if previous is not None and previous.stopped != "interrupted":
        return previous
    with record.stage("solve"), solve_progress() as report:
        solution = solve_for(
            scene, error, seed=seed, workers=workers or len(os.sched_getaffinity(0)), progress=report, resume=previous
        )
    solution.record.settings["picture_error"] = error
    record.counters.merge(solution.record.counters)
    record.choices |= {f"solve: {name}": text for name, text in solution.record.choices.items()}
    if "estimate" in solution.record.errors:
        record.errors["solution"] = solution.record.errors["estimate"]
    return solution


def _bar() -> Any:
    from tqdm import tqdm

    return tqdm(total=1.0, disable=None, bar_format="{desc} {percentage:3.0f}%|{bar}| {elapsed}, {remaining} left",
                leave=False)  # fmt: skip


def _draw(picture: Picture, canvas: _Canvas) -> None:
    """Draw a picture, and write it now and then."""
    last = time.perf_counter()
    with _bar() as bar:
        bar.set_description_str("gather")
        for done in picture.steps():
            bar.update(max(0.0, done - bar.n))
            if time.perf_counter() - last > WRITE_EVERY:
                canvas.write(picture)
                last = time.perf_counter()


class _Canvas:
    """The file that a picture is written to, again and again; ``under`` shows where nothing is drawn yet."""

    def __init__(self, path: Path, tone: str, exposure: float, white: float | None) -> None:
        self.path, self.tone, self.stops, self.white = path, tone, exposure, white
        self.under: NDArray | None = None

    def rough(self, solution: Solution, camera: Camera, workers: int | None, seed: int) -> None:
        """Draw a small picture fast, and write it in full size."""
        import numpy as np

        from radiosity.gather import GatherOptions, PictureGatherer
        from workbench.render.camera import PinholeRays

        shrink = max(1.0, math.sqrt(camera.width * camera.height / ROUGH_PIXELS))
        small = replace(
            camera, width=max(1, round(camera.width / shrink)), height=max(1, round(camera.height / shrink))
        )
        gatherer = PictureGatherer(solution, GatherOptions(error=QUICK_ERROR), workers=workers, seed=seed)
        found = gatherer.draw(PinholeRays.from_camera(small)).radiance
        rows = (np.arange(camera.height) * small.height) // camera.height
        columns = (np.arange(camera.width) * small.width) // camera.width
        self.under = found[rows][:, columns].astype(np.float32)
        self.show(self.under)

    def show(self, radiance: NDArray) -> None:
        """Write a whole picture."""
        self._write(radiance, self.path)

    def write(self, picture: Picture) -> None:
        """Write what is drawn, over what was there before."""
        self.show(self._composed(picture))

    def _composed(self, picture: Picture) -> NDArray:
        radiance = picture.radiance
        drawn = picture.drafted | picture.finished
        if self.under is None or len(drawn) == len(picture.tiles):
            return radiance
        radiance = radiance.copy()
        for number, (left, top, right, bottom) in enumerate(picture.tiles):
            if number not in drawn:
                radiance[top:bottom, left:right] = self.under[top:bottom, left:right]
        return radiance

    def _write(self, radiance: NDArray, path: Path) -> None:
        import numpy as np

        from workbench.render.image import (
            RADIANCE_SUFFIXES,
            Exposure,
            srgb_bytes,
            tone_mapped,
            write_picture,
            write_radiance,
        )

        colour = radiance if radiance.shape[2] == 3 else np.repeat(radiance, 3, axis=2)
        if path.suffix.lower() in RADIANCE_SUFFIXES:
            write_radiance(path, colour)
            return
        exposure = Exposure(colour, self.stops, self.white)
        write_picture(path, srgb_bytes(tone_mapped(colour, self.tone, exposure)))

    def write_denoised(self, picture: Picture, path: Path) -> Path:
        """Write the filtered picture beside the raw one."""
        from radiosity.denoise import denoised

        beside = path.with_name(f"{path.stem}-denoised{path.suffix}")
        self._write(denoised(picture.radiance), beside)
        return beside


def _read_state(kept: Path, identity: str) -> dict[str, NDArray] | None:
    """What a stopped run left, if it was this picture's."""
    import numpy as np

    try:
        with np.load(kept, allow_pickle=False) as stored:
            state = {name: stored[name] for name in stored.files}
        known = str(state.pop("identity"))
    except (OSError, ValueError, KeyError) as problem:
        raise InputError(f"{kept}: cannot be read ({problem}); draw without --resume") from None
    if known != identity:
        raise InputError(f"{kept}: found another picture's; give the same scene and options, or draw without --resume")
    return state


def _forget(kept: Path, folder: Path) -> None:
    """Remove what a stopped run left."""
    kept.unlink(missing_ok=True)
    (folder / "solution.npz").unlink(missing_ok=True)
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def _write_solution(folder: Path, solution: Solution) -> None:
    try:
        folder.mkdir(exist_ok=True)
        solution.save_state(folder)
    except OSError as problem:
        raise InputError(f"{folder}: cannot be written: {problem.strerror or problem}") from None


def _write_state(kept: Path, identity: str, picture: Picture, under: NDArray | None) -> None:
    import numpy as np

    beside = kept.with_name(f".{kept.name}.{os.getpid()}.part.npz")
    try:
        under = np.zeros((0, 0, 0), dtype=np.float32) if under is None else under
        np.savez(beside, identity=identity, under=under, **picture.state())  # type: ignore[arg-type]
        beside.replace(kept)
    except OSError as problem:
        raise InputError(f"{kept}: cannot be written: {problem.strerror or problem}") from None
    finally:
        beside.unlink(missing_ok=True)


def _write_samples(picture: Picture, path: Path) -> Path:
    """A picture of where each component was sampled, and of the occlusion states of each light."""
    import numpy as np
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

    titles = {"camera": "rays from the eye", "direct": "places of direct light", "indirect": "hemisphere bundles"}
    lights = picture.owner.gatherer.lights[:6]
    many = len(titles) + len(lights)
    columns = min(3, many)
    rows = -(-many // columns)
    height, width = picture.radiance.shape[:2]
    figure = Figure(figsize=(4.6 * columns, 4.6 * rows * max(0.55, height / width)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, (name, title) in zip(axes, titles.items(), strict=False):
        count = picture.samples[name]
        shown = axis.imshow(np.log2(1.0 + count), cmap="viridis", interpolation="nearest")
        axis.set_title(f"{title}: {count.mean():.3g} a pixel")
        ticks = [0, *(k for k in (1, 4, 16, 64, 256) if k <= count.max())]
        bar = figure.colorbar(shown, ax=axis, shrink=0.8, ticks=[math.log2(1 + k) for k in ticks])
        bar.ax.set_yticklabels([str(k) for k in ticks])
    colours = ListedColormap(["#000000", "#f0e442", "#3b3b58", "#56b4e9"])
    for axis, light, number in zip(axes[len(titles) :], lights, range(len(lights)), strict=False):
        state = picture.states[..., number]
        shown = axis.imshow(state, cmap=colours, vmin=-1.5, vmax=2.5, interpolation="nearest")
        axis.set_title(f"states for {light.name}")
        bar = figure.colorbar(shown, ax=axis, shrink=0.8, ticks=[-1, 0, 1, 2])
        bar.ax.set_yticklabels(["edge", "not in shadow", "in shadow", "complex"])
    beside = path.with_name(f"{path.stem}-samples.png")
    try:
        figure.savefig(beside, dpi=110)
    except OSError as problem:
        raise InputError(f"{beside}: cannot be written: {problem.strerror or problem}") from None
    return beside


# ---- direct light alone -------------------------------------------------------------------------


def _render_direct(
    scene_name: str, path: Path, *, sampling: str, side: int, components: str, whole_tree: bool,
    normal_angle: float | None, shared_boundary: bool, threshold: float, level: int, depth: int, shadow_error: float,
    light_samples: int | None, bundle: int, falloff: bool | None, white: float | None, workers: int | None, seed: int,
    json_path: str | None, camera_name: str | None, eye: Any, look_at: Any, up: Any, fov: Any, size: Any,
    width: int | None, tone: str, exposure: float, **_: Any,
) -> None:  # fmt: skip
    import workbench
    from workbench.render.atomic import AtomicOptions
    from workbench.render.direct import render_direct
    from workbench.render.trace import TraceOptions

    chosen = tuple(name.strip() for name in components.split(",") if name.strip())
    atomic = AtomicOptions(chosen, whole_tree=whole_tree, similar=max(threshold, 0.0), normal_angle_deg=normal_angle)
    start = time.perf_counter()
    loaded = workbench.load(scene_name)
    seconds_reading = time.perf_counter() - start
    for note in loaded.notes:
        click.echo(f"note: {note}", err=True)
    if loaded.camera is not None:
        camera = _chosen_camera(loaded, loaded.camera, camera_name, eye, look_at, up, fov, size, width)
        loaded = replace(loaded, camera=camera)
    if loaded.sky is not None:
        click.echo(
            "note: the sky is seen but lights nothing with --direct-only; leave that out for its light", err=True
        )
    nff = loaded.path is not None and loaded.path.suffix.lower() == ".nff"
    options = TraceOptions(
        depth=depth,
        light_samples=light_samples,
        shadow_error=shadow_error,
        bundle=bundle,
        falloff=not nff if falloff is None else falloff,
        see_backs=False,
        seed=seed,
    )
    drawn = render_direct(
        loaded,
        sampling=sampling,
        options=options,
        atomic=atomic,
        threshold=threshold,
        level=level,
        shared_boundary=shared_boundary,
        side=side,
        white=white,
        workers=workers or os.cpu_count() or 1,
    )
    record = drawn.record
    record.seconds = {"read scene": seconds_reading} | record.seconds
    record.settings |= {"depth": depth, "light_samples": light_samples, "bundle": bundle, "seed": seed}
    record.settings |= {"shadow_error": shadow_error, "normal_angle_deg": normal_angle}
    record.settings |= {"falloff": options.falloff, "atomic": components, "whole_tree": whole_tree}
    record.settings |= {"scene": scene_name, "tone": tone, "exposure": exposure}
    _Canvas(path, tone, exposure, record.results["white_W_m2_sr"]).show(drawn.picture.radiance)
    if json_path is not None:
        record.write(json_path)
    counts = record.counters
    lines = [
        f"{loaded.name}: {drawn.pixels.shape[1]} x {drawn.pixels.shape[0]}, "
        f"{record.results['samples_per_pixel']:.3g} samples a pixel; of {record.results['samples']:,} samples "
        f"{counts['cast_rays_hit']:,} see a surface",
        f"{counts['rays']:,} rays: {counts['cast_rays']:,} cast, {counts['shadow_rays']:,} shadow, "
        f"{counts['reflection_rays']:,} reflected, {counts['refraction_rays']:,} refracted",
    ]
    if sampling == "atomic":
        lines.append(
            f"saved: {counts['cast_rays_saved']:,} cast, {counts['shadow_rays_saved']:,} shadow, "
            f"{counts['reflection_rays_saved']:,} reflected, {counts['refraction_rays_saved']:,} refracted"
        )
    if sampling == "rows":
        lines.append(
            f"cast rays row by row: {counts['polygon_tests']:,} polygon tests, {counts['tests_avoided']:,} avoided by "
            f"{counts['plane_vertex_checks']:,} plane-vertex checks; {record.results['first_pass_s']:.2f} s"
        )
    lines.append("seconds: " + "; ".join(f"{stage} {spent:.2f}" for stage, spent in record.seconds.items()))
    click.echo("\n".join([*lines, str(path)]), err=json_path == "-")
