"""The command ``raycast``: pictures, report, and one line for every kind of bad input."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from workbench.render.image import to_bytes
from workbench.render.raycast import RayCaster
from workbench.render.raycast_cli import main
from workbench.scene.sc import read_sc

OWN = Path(__file__).resolve().parents[2] / "scenes" / "sc"
SIZE = ["--size", "80x60"]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run the command in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(main, [str(a) for a in arguments])


def test_writes_the_picture_under_the_scene_s_name(run, tmp_path):
    result = run(OWN / "min.sc")
    assert result.exit_code == 0, result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["min.tiff"]
    with Image.open("min.tiff") as picture:
        assert (picture.format, picture.mode, picture.size) == ("TIFF", "RGB", (384, 288))
        pixels = np.asarray(picture)
    np.testing.assert_array_equal(pixels, to_bytes(RayCaster(read_sc(OWN / "min.sc")).render().radiance))


def test_reports_what_the_assignment_asks(run):
    result = run(OWN / "room.sc", *SIZE, "--volumes", "both", "--json", "run.json")
    assert result.exit_code == 0, result.stderr
    lines = dict(line.split(maxsplit=1) for line in result.stdout.splitlines())
    assert (lines["picture"], lines["size"]) == ("room.tiff", "80 x 60")
    assert lines["rays"].startswith("4800,")
    found = re.fullmatch(
        r"([\d.]+) per ray on average: spheres ([\d.]+), polygons ([\d.]+), bounding volumes ([\d.]+) "
        r"\(spheres ([\d.]+), boxes ([\d.]+)\)",
        lines["tests"],
    )
    total, spheres, polygons, volumes, balls, boxes = map(float, found.groups())
    assert total == pytest.approx(spheres + polygons + volumes, abs=0.02)
    assert volumes == pytest.approx(balls + boxes, abs=0.02) and min(spheres, polygons, balls, boxes) > 0
    assert re.match(r"[\d.]+ \(read [\d.]+, prepare [\d.]+, cast [\d.]+, write [\d.]+\)", lines["seconds"])
    record = json.loads(Path("run.json").read_text())
    assert lines["machine"].startswith(record["machine"]["processor"])
    assert record["results"]["tests_per_ray"]["sum"] == pytest.approx(total, abs=0.01)
    assert record["counters"]["rays"] == 4800
    assert record["settings"]["volumes"] == "both" and record["results"]["primitives"] == 2457


def test_two_files_are_one_scene(run):
    assert run(OWN / "min.cam.sc", OWN / "min.nocam.sc", "-o", "two.tiff").exit_code == 0
    assert run(OWN / "min.sc", "-o", "one.tiff").exit_code == 0
    assert Path("one.tiff").read_bytes() == Path("two.tiff").read_bytes()


def test_volumes_accelerators_and_workers_give_one_picture(run):
    pictures = []
    for index, options in enumerate(
        [["--volumes", v] for v in ("none", "bsphere", "bbox", "both")]
        + [["--accelerator", a] for a in ("voxels", "embree")]
        + [["--workers", "3"]]
    ):
        result = run(OWN / "table.sc", *SIZE, *options, "-o", f"{index}.tiff")
        assert result.exit_code == 0, result.stderr
        pictures.append(Path(f"{index}.tiff").read_bytes())
    assert all(picture == pictures[0] for picture in pictures)


def test_says_what_embree_does_not_count(run):
    result = run(OWN / "min.sc", *SIZE, "--accelerator", "embree")
    assert "tests    not known" in result.stdout
    assert "voxels " in run(OWN / "min.sc", *SIZE, "--accelerator", "voxels").stdout


def test_png_and_size(run):
    assert run(OWN / "new.sc", "--size", "31x17", "-o", "new.png").exit_code == 0
    with Image.open("new.png") as picture:
        assert (picture.format, picture.size) == ("PNG", (31, 17))


def test_record_alone_on_standard_output(run):
    result = run(OWN / "min.sc", *SIZE, "--json", "-")
    assert json.loads(result.stdout)["command"] == "raycast"


BAD = [
    (["missing.sc"], "missing.sc: cannot be read"),
    (["bad.sc"], "bad.sc, line 2: found 'shpere'"),
    (["bad.sc", "-o", "x.gif"], "x.gif: found the suffix '.gif'"),
    (["good.sc", "-o", "none/x.tiff"], "found no folder 'none'"),
    (["good.sc", "-o", "folder.tiff"], "folder.tiff: found a folder"),
    (["good.sc", "--json", "none/x.json"], "none/x.json: found no folder"),
    (["good.sc", "--size", "10"], "found '10'"),
    (["good.sc", "--size", "0x5"], "found '0x5'"),
    (["good.sc", "--size", "9000x5"], "8192"),
    (["good.sc", "--volumes", "all"], "'all'"),
    (["good.sc", "--accelerator", "kd"], "'kd'"),
    (["good.sc", "--workers", "0"], "0"),
    (["good.sc", "--frobnicate"], "--frobnicate"),
    ([], "Missing argument"),
]


@pytest.mark.parametrize(("arguments", "part"), BAD, ids=range(len(BAD)))
def test_bad_input_is_one_line_and_no_file(run, tmp_path, arguments, part):
    (tmp_path / "bad.sc").write_text("world\nshpere 0 0 0 1\n")
    (tmp_path / "good.sc").write_text("size 4 4 world sphere 0 0 -5 1")
    (tmp_path / "folder.tiff").mkdir()
    result = run(*arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.startswith("raycast: ") and result.stderr.count("\n") == 1 and part in result.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.sc", "folder.tiff", "good.sc"]


def test_a_failed_write_leaves_the_old_picture(run, tmp_path, monkeypatch):
    """The picture is written beside and renamed, so a full disk does not harm the one that is there."""
    Path("min.tiff").write_bytes(b"old")

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", full)
    result = run(OWN / "min.sc", *SIZE)
    assert result.exit_code == 2 and "No space left" in result.stderr
    assert Path("min.tiff").read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


def test_help_needs_no_numbers():
    """The command's module loads click alone, so that help is there at once."""
    code = (
        "import sys, workbench.render.raycast_cli; sys.exit(any(m in sys.modules for m in ('numpy', 'numba', 'PIL')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    result = CliRunner().invoke(main, ["--help"])
    assert result.exit_code == 0 and "FILE.sc" in result.stdout
