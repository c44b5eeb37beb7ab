"""The command ``radiosity``: what it leaves, what it refuses, and how it stops."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

import radiosity
from radiosity import cli, view

ROOT = Path(__file__).resolve().parents[2]

ROOM = """\
schema = 1
closed = true

[camera]
eye = [1.0, 0.1, 1.0]
look_at = [1.0, 2.0, 1.0]
up = [0.0, 0.0, 1.0]
fov = 70.0
width = 48
height = 40

[materials.wall]
reflectance = [0.7, 0.6, 0.5]

[materials.lamp]
reflectance = 0.0
emission = [10.0, 9.0, 8.0]

[[surface]]
name = "room"
material = "wall"
box = { min = [0.0, 0.0, 0.0], max = [2.0, 2.0, 2.0], inward = true }

[[surface]]
name = "block"
material = "wall"
box = { min = [0.5, 0.9, 0.3], max = [0.9, 1.3, 0.8] }

[[surface]]
name = "lamp"
material = "lamp"
polygon = [[0.7, 0.7, 1.9], [0.7, 1.3, 1.9], [1.3, 1.3, 1.9], [1.3, 0.7, 1.9]]
"""

FILES = ["preview.png", "record.json", "solution.npz", "solution.vtp"]


@pytest.fixture
def room(tmp_path):
    path = tmp_path / "room.toml"
    path.write_text(ROOM)
    return path


def run(*arguments):
    return CliRunner().invoke(cli.main, [str(argument) for argument in arguments])


def solve(scene, directory, *options):
    return run("solve", scene, "-o", directory, "--elements", 150, "--method", "progressive", *options)


def refused(result, pattern):
    """Exit code 2 and one line on standard error that fits ``pattern``."""
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1, result.stderr
    assert re.search(rf"^radiosity: .*{pattern}", result.stderr), result.stderr
    return True


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# ---- what it leaves


def test_solve_leaves_mesh_state_record_and_picture(room, tmp_path):
    out = tmp_path / "deep" / "out"
    result = solve(room, out, "--json", tmp_path / "copy.json", "--seed", 3, "--workers", 1)
    assert result.exit_code == 0, result.output
    assert names(out) == FILES
    for file in FILES:
        assert str(out / file) in result.stdout
    record = json.loads((out / "record.json").read_text())
    assert json.loads((tmp_path / "copy.json").read_text()) == record
    assert record["settings"]["seed"] == 3
    assert record["settings"]["camera"]["fov_deg"] == 70
    assert {"read scene", "save", "preview"} <= set(record["seconds"])
    assert record["errors"]["remaining_bound"] <= 0.01
    assert "room: converged" in result.stdout and "row sums" in result.stdout and "energy book" in result.stdout
    solution = radiosity.Solution.load(out)
    assert (solution.radiosity > 0).all()
    picture = np.asarray(Image.open(out / "preview.png"))
    assert picture.shape == (40, 48, 3)
    assert picture.mean() > 80
    # The walls reflect more red than blue, and so does the picture of them.
    assert picture[..., 0].mean() > picture[..., 2].mean() + 10


def test_the_record_on_standard_output_is_json_alone(room, tmp_path):
    result = solve(room, tmp_path / "out", "--json", "-", "--no-preview")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["counters"]["shots"] > 0
    assert "converged" in result.stderr
    assert names(tmp_path / "out") == FILES[1:]


def test_workers_do_not_change_the_answer(room, tmp_path):
    for workers in (1, 2):
        assert solve(room, tmp_path / f"{workers}", "--workers", workers, "--no-preview").exit_code == 0
    one, two = (radiosity.Solution.load(tmp_path / name) for name in "12")
    np.testing.assert_array_equal(one.radiosity, two.radiosity)


def test_ctrl_c_leaves_a_usable_solution_and_resume_goes_on(room, tmp_path, monkeypatch):
    out = tmp_path / "out"
    assert solve(room, tmp_path / "whole", "--tolerance", 1e-6, "--no-preview").exit_code == 0
    real, shots = radiosity.solve, []

    def interrupting(scene, *, progress, **options):
        def report(event):
            shots.append(event.shots)
            if event.shots > 0:
                signal.raise_signal(signal.SIGINT)
            progress(event)

        return real(scene, progress=report, **options)

    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(radiosity, "solve", interrupting)
    result = solve(room, out, "--tolerance", 1e-6)
    assert result.exit_code == 130
    assert f"radiosity solve {room} -o {out} --resume" in result.stderr
    assert signal.getsignal(signal.SIGINT) is before
    assert names(out) == FILES
    part = radiosity.Solution.load(out)
    assert not part.converged and part.stopped == "interrupted"

    monkeypatch.setattr(radiosity, "solve", real)
    before = {file.name: file.read_bytes() for file in out.iterdir()}
    assert refused(run("solve", "l-room", "-o", out, "--resume"), "found the solution of .*expected one of 'L-room'")
    assert before == {file.name: file.read_bytes() for file in out.iterdir()}
    result = run("solve", room, "-o", out, "--resume", "--tolerance", 1e-6)
    assert result.exit_code == 0, result.output
    done, whole = radiosity.Solution.load(out), radiosity.Solution.load(tmp_path / "whole")
    assert done.converged
    assert part.radiosity.sum() < done.radiosity.sum()
    np.testing.assert_allclose(done.radiosity, whole.radiosity, rtol=1e-5)


@pytest.mark.skipif(view.drawing_problem() is not None, reason=f"pyvista cannot draw: {view.drawing_problem()}")
def test_view_draws_a_field_of_a_solution(room, tmp_path):
    out = tmp_path / "out"
    assert solve(room, out, "--no-preview").exit_code == 0
    result = run("view", out, "--field", "irradiance_W_m2", "--screenshot", tmp_path / "shot.png")
    assert result.exit_code == 0, result.output
    picture = np.asarray(Image.open(tmp_path / "shot.png").convert("RGB"))
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100
    assert refused(run("view", out, "--field", "colour", "--screenshot", tmp_path / "s.png"), "found 'colour'")
    assert refused(run("view", tmp_path, "--screenshot", tmp_path / "s.png"), r"solution\.vtp: no such file")


def test_scenes_lists_names_that_solve_takes():
    result = run("scenes")
    assert result.exit_code == 0
    listed = [line.split()[0] for line in result.stdout.splitlines()]
    assert "cornell-box" in listed
    import workbench

    for name in listed:
        assert workbench.load(name).has_emitter


def test_doctor_finds_the_essentials_here_and_tells_what_is_missing(monkeypatch):
    result = run("doctor")
    assert result.exit_code == 0, result.output
    for name in ("embree", "numba", "threads", "memory", "off-screen GL"):
        assert name in result.stdout
    monkeypatch.setitem(sys.modules, "embreex", None)
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    result = run("doctor")
    assert result.exit_code == 1
    assert re.search(r"MISSING +embree .*\n +-> run 'pip install", result.stdout)


# ---- what it refuses


def edited(old, new):
    def write(folder):
        assert ROOM.count(old) >= 1
        path = folder / "bad.toml"
        path.write_text(ROOM.replace(old, new, 1))
        return path

    return write


def binary(suffix):
    def write(folder):
        path = folder / f"bad{suffix}"
        path.write_bytes(bytes(range(256)) * 8)
        return path

    return write


BAD_SCENES = {
    "missing file": (lambda folder: folder / "absent.toml", r"absent\.toml"),
    "unknown name": (lambda folder: "cornel-box", "cornell-box"),
    "binary junk as toml": (binary(".toml"), r"bad\.toml"),
    "binary junk as obj": (binary(".obj"), r"bad\.obj"),
    "binary junk as glb": (binary(".glb"), r"bad\.glb"),
    "binary junk as ply": (binary(".ply"), r"bad\.ply"),
    "unknown suffix": (binary(".xyz"), r"bad\.xyz"),
    "unknown key": (edited("reflectance = 0.0", "reflectence = 0.0"), "reflectence.*reflectance"),
    "non-planar polygon": (edited("[1.3, 0.7, 1.9]]", "[1.3, 0.7, 1.8]]"), "planar"),
    "zero-area polygon": (edited("[1.3, 1.3, 1.9], [1.3, 0.7, 1.9]]", "[0.7, 1.6, 1.9], [0.7, 1.9, 1.9]]"), "area"),
    "nan": (edited("min = [0.5,", "min = [nan,"), "nan|finite"),
    "reflectance above 1": (edited("[0.7, 0.6, 0.5]", "[0.7, 1.6, 0.5]"), r"reflectance.*1\.6"),
    "reflectance below 0": (edited("[0.7, 0.6, 0.5]", "[0.7, -0.6, 0.5]"), r"reflectance.*-0\.6"),
    "no emitter": (edited("emission = [10.0, 9.0, 8.0]", "emission = 0.0"), "emi"),
    "unreadable mesh": (
        edited("box = { min = [0.5, 0.9, 0.3], max = [0.9, 1.3, 0.8] }", 'mesh = "absent.obj"'),
        "absent",
    ),
    "camera along up": (edited("look_at = [1.0, 2.0, 1.0]", "look_at = [1.0, 0.1, 3.0]"), "up"),
}


@pytest.mark.parametrize("case", BAD_SCENES)
def test_a_bad_scene_is_refused_in_one_line(case, tmp_path):
    write, pattern = BAD_SCENES[case]
    scene = write(tmp_path)
    before = names(tmp_path)
    assert refused(solve(scene, tmp_path / "out"), pattern)
    assert names(tmp_path) == before  # no output folder, no half-written file


@pytest.mark.parametrize(
    ("options", "pattern"),
    [
        (["--rays", "-3"], "--rays.*-3"),
        (["--rays", "many"], "--rays.*many"),
        (["--elements", "0"], "--elements.*0"),
        (["--max-edge", "nan"], "--max-edge.*nan"),
        (["--max-edge", "-1"], "--max-edge.*-1"),
        (["--max-edge", "inf"], "--max-edge.*inf"),
        (["--tolerance", "0"], "--tolerance.*0"),
        (["--tolerance", "1.5"], r"--tolerance.*1\.5"),
        (["--workers", "0"], "--workers.*0"),
        (["--seed", "-1"], "--seed.*-1"),
        (["--method", "guess"], "--method.*guess"),
        (["--elements", "5", "--max-edge", "0.1"], "--elements and --max-edge.*leave one out"),
        (["--elemets", "5"], "--elemets.*--elements"),
        (["--elements", "100000000000"], "GiB"),
        (["--resume"], r"solution\.npz.*radiosity solve"),
    ],
)
def test_a_bad_option_is_refused_in_one_line(options, pattern, room, tmp_path):
    assert refused(run("solve", room, "-o", tmp_path / "out", *options), pattern)
    assert names(tmp_path) == ["room.toml"]


def test_missing_arguments_and_commands_are_refused(room):
    assert refused(run("solve"), "SCENE.*radiosity solve --help|SCENE.*--help")
    assert refused(run("solve", room), "--output")
    assert refused(run("slove"), "slove.*solve")


def test_an_output_that_cannot_be_written_is_refused_before_the_work(room, tmp_path, monkeypatch):
    def work(*arguments, **options):
        raise AssertionError("the work has begun")

    monkeypatch.setattr(radiosity, "solve", work)
    blocker = tmp_path / "file"
    blocker.write_text("kept")
    assert refused(solve(room, blocker / "out"), "file/out: cannot write here")
    assert refused(solve(room, blocker), "file: cannot write here")
    assert refused(solve(room, "/proc/radiosity"), "/proc/radiosity: cannot write here")
    assert refused(
        solve(room, tmp_path / "out", "--json", tmp_path / "absent" / "r.json"), r"r\.json: cannot be written"
    )
    assert refused(solve(room, tmp_path / "out", "--json", tmp_path), "found a folder")
    assert names(tmp_path) == ["file", "room.toml"]
    assert blocker.read_text() == "kept"


@pytest.mark.skipif(os.geteuid() == 0, reason="permissions do not bind the superuser")
def test_a_read_only_folder_is_refused(room, tmp_path):
    out = tmp_path / "out"
    out.mkdir(mode=0o555)
    assert refused(solve(room, out), "cannot write here: Permission denied")


def test_a_failed_solve_leaves_an_earlier_solution_alone(room, tmp_path):
    out = tmp_path / "out"
    assert solve(room, out).exit_code == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert refused(run("solve", room, "-o", out, "--elements", 10**11), "GiB")
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


# ---- the process


def program(*arguments, **options):
    return subprocess.run(
        [sys.executable, "-c", "from radiosity.cli import main; main()", *map(str, arguments)],
        capture_output=True,
        text=True,
        **options,
    )


def test_help_is_quick_and_imports_nothing_heavy():
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        result = program("--help")
        seconds.append(time.perf_counter() - start)
        assert result.returncode == 0 and "solve" in result.stdout
    assert min(seconds) < 0.5
    listing = "import sys, radiosity, workbench, radiosity.cli; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", listing], capture_output=True, text=True, check=True).stdout.split()
    assert not {"numpy", "numba", "scipy", "embreex", "trimesh", "pyvista", "matplotlib", "tqdm"} & set(loaded)


def test_the_process_ends_with_code_2_and_no_traceback(tmp_path):
    result = program("solve", tmp_path / "absent.toml", "-o", tmp_path / "out")
    assert result.returncode == 2
    assert result.stdout == "" and result.stderr.startswith("radiosity: ") and result.stderr.count("\n") == 1


def test_without_arguments_it_shows_its_help():
    result = run()
    assert result.exit_code == 0
    assert "doctor" in result.stdout


def test_the_readme_and_the_checks_run_the_same_commands():
    readme, checks = (ROOT / "README.md").read_text(), (ROOT / ".ci" / "run").read_text()
    commands = [line.strip() for line in readme.splitlines() if line.startswith("python3 -m venv")]
    assert len(commands) == 2
    solve_command, test_command = commands
    assert test_command in checks
    assert solve_command.split(" && ")[-1] in checks
