"""The command ``raycast``: scene files in, a picture out.

Kept free of heavy imports at the top, so that ``raycast --help`` answers at once.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import click

__all__ = ["main"]


class _OneLineErrors(click.Command):
    """A command that ends bad input with one line on standard error and exit code 2."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        kwargs["standalone_mode"] = False
        try:
            sys.exit(super().main(*args, **kwargs))
        except click.ClickException as error:
            message = error.format_message()
        except click.Abort:
            click.echo("raycast: interrupted, no picture written", err=True)
            sys.exit(130)
        except MemoryError:
            message = "not enough memory for the picture; ask for a smaller one with --size"
        except Exception as error:
            from workbench.errors import WorkbenchError

            if not isinstance(error, WorkbenchError):
                raise
            message = str(error)
        click.echo(f"raycast: {' '.join(message.split())}", err=True)
        sys.exit(2)


class _Size(click.ParamType):
    """A picture size such as 640x480."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        match = re.fullmatch(r"([0-9]{1,4})x([0-9]{1,4})", value) if isinstance(value, str) else None
        size = (int(match[1]), int(match[2])) if match else (0, 0)
        if not all(1 <= side <= 8192 for side in size):
            self.fail(f"found {value!r}, expected two numbers from 1 to 8192 such as 640x480", param, ctx)
        return size


@click.command(cls=_OneLineErrors, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="radiosity-workbench", prog_name="raycast")
@click.argument("files", metavar="FILE.sc [FILE.sc ...]", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path),
    help="The picture, .tiff or .png.  [default: the last file's name with .tiff, in this folder]",
)  # fmt: skip
@click.option(
    "--volumes", type=click.Choice(["none", "bsphere", "bbox", "both"]), default="bbox", show_default=True,
    help="Bounding volumes of the groups to test; the picture does not depend on it.",
)  # fmt: skip
@click.option(
    "--accelerator", type=click.Choice(["groups", "voxels", "embree"]), default="groups", show_default=True,
    help="What finds the first surface: the scene's groups, a voxel grid, or Embree.",
)  # fmt: skip
@click.option("--size", type=_Size(), help="Picture size instead of the scene's own.")
@click.option("--workers", type=click.IntRange(1, 1024), help="Threads.  [default: all cores]")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write the run's record; - prints it.")
def main(
    files: tuple[Path, ...],
    output: Path | None,
    volumes: str,
    accelerator: str,
    size: tuple[int, int] | None,
    workers: int | None,
    json_path: Path | None,
) -> None:
    """Cast one ray through each pixel centre of a scene and write the picture.

    Several files are read in order into one scene, so a camera can stand in a file of its own:
    "raycast min.cam.sc min.nocam.sc" draws what "raycast min.sc" draws.

    The language of .sc files is a reconstruction, not that of the course of 1996, whose documentation is
    lost; the module workbench.scene.sc describes it.
    """
    from workbench.errors import InputError
    from workbench.record import RunRecord
    from workbench.render.image import check_picture_path, to_bytes, write_picture
    from workbench.scene.sc import read_sc

    # Everything that can be refused is refused before the work begins.
    output = check_picture_path(output or Path(f"{files[-1].stem}.tiff"))
    if json_path is not None and str(json_path) != "-" and (json_path.is_dir() or not json_path.parent.is_dir()):
        raise InputError(f"{json_path}: found no folder to write this file in, expected one; make it first")
    record = RunRecord("raycast")
    with record.stage("read"):
        scene = read_sc(files)
    with record.stage("prepare"):
        from workbench.render.raycast import RayCaster, average_tests

        caster = RayCaster(scene, volumes=volumes, accelerator=accelerator, size=size, workers=workers)
        # Two rays first: they load, or on the first run of all compile, the kernels.
        caster.trace(caster.rays.eye, caster.rays.directions([0.5, 1.5], 0.5))
    with record.stage("cast"):
        picture = _render(caster)
    with record.stage("write"):
        write_picture(output, to_bytes(picture.radiance))
    height, width = picture.primitive.shape
    record.settings = {
        "files": [str(path) for path in files],
        "output": str(output),
        "volumes": volumes if accelerator == "groups" else None,
        "accelerator": accelerator,
        "width": width,
        "height": height,
        "workers": caster.workers,
    }
    record.counters = picture.counters
    record.results = {"primitives": len(scene.primitives), "groups": len(scene.groups)}
    if accelerator != "embree":
        record.results["tests_per_ray"] = average_tests(picture.counters)
    to_screen = str(json_path) != "-"
    if to_screen:
        _report(record)
    if json_path is not None:
        try:
            record.write(json_path)
        except OSError as error:
            raise InputError(f"{json_path}: cannot be written ({error.strerror}); choose another place") from None


def _render(caster: Any) -> Any:
    """The picture, with a progress bar where someone looks on."""
    if not sys.stderr.isatty():
        return caster.render()
    from tqdm import tqdm

    with tqdm(total=100, unit="%", desc="casting", leave=False, bar_format="{desc} |{bar}| {n:.0f} %") as bar:
        return caster.render(lambda share: bar.update(100 * share - bar.n))


def _report(record: Any) -> None:
    """What the run did, for a reader."""
    settings, counters, seconds = record.settings, record.counters, record.seconds
    click.echo(f"picture  {settings['output']}")
    click.echo(f"size     {settings['width']} x {settings['height']}")
    click.echo(f"rays     {counters['rays']}, of which {counters['rays_hit']} hit")
    tests = record.results.get("tests_per_ray")
    if tests is None:
        click.echo("tests    not known: Embree does not count them")
    else:
        volumes = tests["bounding_spheres"] + tests["bounding_boxes"]
        click.echo(
            f"tests    {tests['sum']:.2f} per ray on average: spheres {tests['spheres']:.2f}, "
            f"polygons {tests['polygons']:.2f}, bounding volumes {volumes:.2f} "
            f"(spheres {tests['bounding_spheres']:.2f}, boxes {tests['bounding_boxes']:.2f})"
        )
    if counters["voxels_stepped"]:
        click.echo(f"voxels   {counters['voxels_stepped'] / counters['rays']:.2f} stepped per ray")
    stages = ", ".join(f"{name} {value:.2f}" for name, value in seconds.items())
    click.echo(f"seconds  {sum(seconds.values()):.2f} ({stages})")
    machine = record.machine
    click.echo(f"machine  {machine['processor']}, {machine['cores']} cores, {machine['system']}")
