"""The command line ``radiosity``.

Exit codes: 0 done, 1 ``doctor`` found something essential missing, 2 bad input (one line on
standard error), 130 stopped by Ctrl-C (the solution so far is saved and usable).

Only ``click`` is imported here; everything heavy is imported by the command that needs it.
"""

from __future__ import annotations

import math
import os
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from radiosity.chart_command import chart
from radiosity.explain_command import explain
from radiosity.irradiance_command import irradiance
from radiosity.render_command import render
from radiosity.reproduce import REPRODUCTIONS
from radiosity.shadow_command import shadow
from radiosity.stability_command import stability
from radiosity.stopping import INTERRUPTED, solve_progress
from radiosity.viewfactors_command import viewfactors
from workbench.errors import InputError, OptionError, WorkbenchError

if TYPE_CHECKING:
    from radiosity.solvers.solution import Solution

__all__ = ["main"]

BAD_INPUT = 2
_GIVEN = click.core.ParameterSource.COMMANDLINE


class _Program(click.Group):
    """A group that reports every foreseen error in one line, with exit code 2."""

    def main(self, args: Sequence[str] | None = None, **options: Any) -> Any:  # type: ignore[override]
        options["standalone_mode"] = False
        try:
            code = super().main(args=args, **options)
        except click.exceptions.NoArgsIsHelpError as error:
            click.echo(error.format_message())
            code = 0
        except click.UsageError as error:
            command = error.ctx.command_path if error.ctx is not None else "radiosity"
            _complain(f"{error.format_message().rstrip('.')}; see '{command} --help'")
            code = BAD_INPUT
        except (click.ClickException, WorkbenchError) as error:
            _complain(error.format_message() if isinstance(error, click.ClickException) else str(error))
            code = BAD_INPUT
        except (click.Abort, KeyboardInterrupt):
            _complain("stopped; nothing more was written")
            code = INTERRUPTED
        except MemoryError:
            _complain("out of memory; ask for fewer --elements or a larger --max-edge")
            code = BAD_INPUT
        sys.exit(code if isinstance(code, int) else 0)


def _complain(message: str) -> None:
    click.echo("radiosity: " + " ".join(message.split()), err=True)


def _finite(context: click.Context, parameter: click.Parameter, value: float | None) -> float | None:
    """Refuse nan and inf, which pass click's range checks."""
    if value is not None and not math.isfinite(value):
        raise click.BadParameter(f"{value} is not a finite number.", ctx=context, param=parameter)
    return value


@click.group(cls=_Program, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="radiosity-workbench", prog_name="radiosity")
def main() -> None:
    """Solve scenes for radiosity, look at the solutions, check the machine."""


# ---- solve ------------------------------------------------------------------------------------


@main.command()
@click.argument("scene")
@click.option("-o", "--output", "directory", required=True, type=click.Path(path_type=Path), metavar="DIR")
@click.option("--elements", type=click.IntRange(min=1), metavar="N", help="Mesh into about N elements.")
@click.option(
    "--max-edge",
    type=click.FloatRange(min=0, min_open=True),
    callback=_finite,
    metavar="L",
    help="Mesh until no element's edge is longer than L scene lengths.",
)
@click.option(
    "--rays",
    type=click.IntRange(min=1),
    default=16,
    show_default=True,
    metavar="K",
    help="Rays from an element toward a patch that it sees in part.",
)
@click.option(
    "--tolerance",
    type=click.FloatRange(min=0, max=1, min_open=True, max_open=True),
    callback=_finite,
    default=0.01,
    show_default=True,
    metavar="T",
    help="Stop when the bound on the light still missing falls below this share.",
)
@click.option(
    "--method",
    type=click.Choice(["auto", "progressive", "direct", "matrix", "hierarchical"]),
    default="auto",
    show_default=True,
    help="Solver.",
)
@click.option(
    "--link-error",
    type=click.FloatRange(min=0, min_open=True),
    callback=_finite,
    metavar="E",
    help="Of hierarchical: what one link may be off, as a share of the mean irradiance.  [default: 0.001, or what"
    " --elements allows]",
)
@click.option(
    "--error",
    type=click.FloatRange(min=0, max=1, min_open=True, max_open=True),
    callback=_finite,
    metavar="E",
    help="Refine until the error of the irradiance (RMS over the surfaces / mean) is below E.",
)
@click.option(
    "--budget-seconds",
    type=click.FloatRange(min=0, min_open=True),
    callback=_finite,
    metavar="S",
    help="Do the best that fits into S seconds and say the error reached.",
)
@click.option(
    "--bundles",
    type=click.Choice(["receiver", "directional"]),
    default="receiver",
    show_default=True,
    help="Form factors from the receivers toward a patch, or by rays from the patch into its hemisphere.",
)
@click.option("--workers", type=click.IntRange(min=1), metavar="N", help="Threads.  [default: all cores]")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, metavar="S", help="Of the rays.")
@click.option("--json", "json_path", metavar="FILE", help="Write the run's record here too; - is standard output.")
@click.option("--resume", is_flag=True, help="Go on from the solution in DIR, with its options unless given anew.")
@click.option("--no-preview", is_flag=True, help="Draw no picture.")
def solve(
    scene: str,
    directory: Path,
    elements: int | None,
    max_edge: float | None,
    rays: int,
    tolerance: float,
    method: str,
    error: float | None,
    budget_seconds: float | None,
    link_error: float | None,
    bundles: str,
    workers: int | None,
    seed: int,
    json_path: str | None,
    resume: bool,
    no_preview: bool,
) -> None:
    """Solve SCENE and write the solution into DIR.

    SCENE is a scene file (TOML, OBJ, PLY, STL, GLB, ...) or the name of a built-in scene.  DIR gets
    solution.vtp (the mesh), solution.npz (the solver's state), record.json and preview.png.

    Ctrl-C saves what has been solved so far; pressed again it quits at once.
    """
    if elements is not None and max_edge is not None:
        raise OptionError("--elements and --max-edge: found both, expected one; leave one out")
    knob = error is not None or budget_seconds is not None
    if knob and click.get_current_context().get_parameter_source("tolerance") is _GIVEN:
        raise OptionError("--tolerance and --error: found both, expected one; the error decides the tolerance")
    import workbench

    start = time.perf_counter()
    loaded = workbench.load(scene)
    seconds_reading = time.perf_counter() - start
    for note in loaded.notes:
        click.echo(f"note: {note}", err=True)
    if loaded.camera is not None and not no_preview:
        from workbench.render.camera import PinholeRays

        PinholeRays.from_camera(loaded.camera)  # a camera that cannot see is better found before the solve
    with _writable(directory, None if json_path in (None, "-") else Path(str(json_path))):
        import radiosity

        options: dict[str, Any] = {
            "method": method,
            "link_error": link_error,
            "elements": elements,
            "max_edge": max_edge,
            "rays": rays,
            "tolerance": tolerance,
            "error": error,
            "budget_seconds": budget_seconds,
            "bundles": bundles,
            "seed": seed,
        }
        previous = None
        if resume:
            previous = radiosity.Solution.load(directory)
            if (solved := previous.record.settings["scene"]) != loaded.name:
                raise InputError(
                    f"{directory}: found the solution of {solved!r}, expected one of {loaded.name!r}; give that scene "
                    "or leave out --resume"
                )
            options |= _asked_before(previous.record.settings, options)
        if options["error"] is not None or options["budget_seconds"] is not None:
            del options["tolerance"]
        with solve_progress() as report:
            solution = radiosity.solve(
                loaded,
                workers=workers,
                progress=report,
                checkpoint=lambda unfinished: unfinished.save_state(directory),
                resume=previous,
                **options,
            )
        solution.record.seconds = {"read scene": seconds_reading} | solution.record.seconds
        _save(solution, directory, preview=not no_preview, json_path=json_path)
    names = ["solution.vtp", "solution.npz", "record.json"] + ([] if no_preview else ["preview.png"])
    click.echo(_summary(solution, [directory / name for name in names]), err=json_path == "-")
    if solution.stopped == "interrupted":
        again = shlex.join(["radiosity", "solve", scene, "-o", str(directory), "--resume"])
        _complain(f"stopped by Ctrl-C; go on with: {again}")
        raise SystemExit(INTERRUPTED)


def _asked_before(settings: dict[str, Any], options: dict[str, Any]) -> dict[str, Any]:
    """The options of the earlier run that this command line leaves open."""
    context = click.get_current_context()
    given = {name for name in options if context.get_parameter_source(name) is _GIVEN}
    if given & {"elements", "max_edge"}:  # one of the two stands for both
        given |= {"elements", "max_edge"}
    return {name: settings[name] for name in options if name not in given and name in settings}


def _save(solution: Solution, directory: Path, *, preview: bool, json_path: str | None) -> None:
    """Write the solution, then its picture, then the record that knows the seconds of both."""
    from radiosity.view import solution_camera, write_preview

    record = solution.record
    camera = solution_camera(solution)
    record.settings["camera"] = {
        "eye": camera.eye.tolist(),
        "look_at": camera.look_at.tolist(),
        "up": camera.up.tolist(),
        "fov_deg": float(camera.fov_deg),
        "width": camera.width,
        "height": camera.height,
    }
    try:
        with record.stage("save"):
            solution.save(directory)
    except OSError as error:
        raise InputError(f"{directory}: the solution cannot be written: {error.strerror or error}") from None
    if preview:
        with record.stage("preview"):
            write_preview(solution, directory / "preview.png", camera=camera)
    record.write(directory / "record.json")
    if json_path is not None:
        record.write(json_path)


@contextmanager
def _writable(directory: Path, json_path: Path | None) -> Iterator[None]:
    """Make sure, before the work, that its results can be written; undo what was made if it fails."""
    made: list[Path] = []
    try:
        for folder in [*reversed(directory.parents), directory]:
            if not folder.exists():
                folder.mkdir()
                made.append(folder)
        _probe(directory)
    except OSError as error:
        _remove(made)
        raise InputError(
            f"{directory}: cannot write here: {error.strerror or error}; give another folder with -o"
        ) from None
    try:
        if json_path is not None:
            if json_path.is_dir():
                raise InputError(f"{json_path}: found a folder, expected a file name for --json")
            try:
                _probe(json_path.parent)
            except OSError as error:
                raise InputError(
                    f"{json_path}: cannot be written: {error.strerror or error}; give another --json FILE"
                ) from None
        yield
    except BaseException:
        _remove(made)
        raise


def _probe(folder: Path) -> None:
    """Write an empty file into a folder and take it away again; ``OSError`` if that fails."""
    probe = folder / f".radiosity.{os.getpid()}.part"
    try:
        probe.touch()
    finally:
        probe.unlink(missing_ok=True)


def _remove(made: list[Path]) -> None:
    """Remove the folders that this run made, as far as they are empty."""
    for folder in reversed(made):
        try:
            folder.rmdir()
        except OSError:
            return


_ERRORS = {
    "estimate": "error of the irradiance, RMS over the surfaces / mean",
    "remaining_bound": "light still missing, at most this share",
    "energy_imbalance": "energy book off by",
    "row_sum": "row sums of form factors",
    "reciprocity": "reciprocity error",
}
"""How the summary calls the error estimates of a record."""


def _summary(solution: Solution, files: list[Path]) -> str:
    """The end of a solve in a few lines."""
    record = solution.record
    state = "converged" if solution.converged else f"not converged ({solution.stopped})"
    patches = len(set(solution.mesh.element_patch.tolist()))
    lines = [
        f"{solution.scene.name}: {state}; {len(solution.mesh.element_area)} elements, {patches} patches, "
        f"{record.counters['shots']} shots, {record.counters['rays']} rays"
    ]
    lines.append("seconds: " + "; ".join(f"{stage} {spent:.2f}" for stage, spent in record.seconds.items()))
    lines += [
        f"{_ERRORS.get(name, name.replace('_', ' '))}: {_short(value)}"
        for name, value in record.errors.items()
        if name != "definition"
    ]
    lines += [f"{path}" for path in files]
    return "\n".join(lines)


def _short(value: Any) -> str:
    """A number, or numbers, to three digits."""
    if isinstance(value, dict):
        return ", ".join(f"{name.replace('_', ' ')} {_short(item)}" for name, item in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(_short(item) for item in value)
    return f"{value:.3g}" if isinstance(value, float) else str(value)


# ---- reproduce --------------------------------------------------------------------------------


@main.command()
@click.argument("name", type=click.Choice(sorted(REPRODUCTIONS)), metavar="NAME")
@click.option("-o", "--output", "directory", type=click.Path(path_type=Path), metavar="DIR", help="Write files here.")
@click.option("--quick", is_flag=True, help="A small picture: a look at the shape of the result, not at its seconds.")
def reproduce(name: str, directory: Path | None, quick: bool) -> None:
    """Run an experiment of a paper again and print its figures beside ours.

    NAME is camera-table-1 (hardware cameras, Table 1), woo-corner-samples, woo-radiosity-bundles,
    woo-table-1 or woo-tori (Woo 1993).
    DIR gets NAME.csv, NAME.png and record.json.
    """
    from workbench.study.result import format_table, write_study

    if directory is None:
        result = REPRODUCTIONS[name](quick)
        files: list[Path] = []
    else:
        with _writable(directory, None):
            result = REPRODUCTIONS[name](quick)
            files = write_study(result, directory)
    click.echo("\n".join([result.title, "", format_table(result.rows), ""]))
    for note in result.notes:
        click.echo(click.wrap_text(f"- {note}", width=110, subsequent_indent="  "))
    for path in files:
        click.echo(str(path))


main.add_command(render)
main.add_command(shadow)
main.add_command(irradiance)
main.add_command(chart)
main.add_command(viewfactors)
main.add_command(stability)
main.add_command(explain)


# ---- view, scenes, doctor ---------------------------------------------------------------------


@main.command()
@click.argument("directory", type=click.Path(path_type=Path), metavar="DIR")
@click.option("--field", default="radiosity_W_m2", show_default=True, metavar="F", help="Cell array to show.")
@click.option("--screenshot", type=click.Path(path_type=Path), metavar="FILE.png", help="Draw into a file instead.")
def view(directory: Path, field: str, screenshot: Path | None) -> None:
    """Show the solution in DIR in a window, or draw it into a file.

    Fields: radiosity_W_m2, irradiance_W_m2, emission_W_m2, unshot_W_m2, reflectance, surface_id,
    patch_id, element_id.
    """
    from radiosity.view import show, write_screenshot

    if screenshot is None:
        show(directory, field=field)
    else:
        write_screenshot(directory, screenshot, field=field)
        click.echo(str(screenshot))


@main.command()
def scenes() -> None:
    """List the built-in scenes, which 'solve' takes by name."""
    from workbench.scene.load import built_in_scenes

    listed = built_in_scenes()
    if not listed:
        raise InputError(
            "found no built-in scenes; they lie in the folder scenes/ of the project's clone: run from there"
        )
    for name, about in listed.items():
        click.echo(f"{name:24s} {about}")


@main.command()
def doctor() -> None:
    """Check this machine and say what to install."""
    from radiosity.doctor import examine

    checks = examine()
    for check in checks:
        word = "ok" if check.good else "MISSING" if check.essential else "absent"
        click.echo(f"{word:8s}{check.name:14s} {check.found}")
        if check.advice:
            click.echo(f"{'':8s}{'':14s} -> {check.advice}")
    if not all(check.good for check in checks if check.essential):
        raise SystemExit(1)
