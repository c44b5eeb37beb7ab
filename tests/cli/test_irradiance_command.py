"""The command ``radiosity irradiance``: its table, its record, and what it refuses."""

from __future__ import annotations

import csv
import json
import math
import signal

import numpy as np
import pytest
from click.testing import CliRunner

import radiosity
from radiosity import cli
from radiosity.points_file import read_sensor_points
from workbench.errors import InputError

SCENE = """\
schema = 1
[materials.grey]
reflectance = 0.0
[[surface]]
name = "floor"
material = "grey"
polygon = [[-3, -3, 0.0], [3, -3, 0.0], [3, 3, 0.0], [-3, 3, 0.0]]
[[light]]
name = "lamp"
type = "area"
polygon = [[-0.5, -0.5, 2.0], [-0.5, 0.5, 2.0], [0.5, 0.5, 2.0], [0.5, -0.5, 2.0]]
radiance = [1.0, 2.0]
"""
# Exact: light/quad-row of the shared truths, x = 0 and 1.
QUAD_ROW = {0.0: 0.23083679773017077, 1.0: 0.1555774353085024}


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "points.csv").write_text("x,y,z,nx,ny,nz\n0,0,0,0,0,1\n1,0,0,0,0,1\n")
    runner = CliRunner()

    def invoke(*args):
        return runner.invoke(cli.main, ["irradiance", *args], standalone_mode=True)

    return invoke


def _rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_values_bands_and_units(run, tmp_path):
    result = run("scene.toml", "--points", "points.csv", "-o", "out.csv", "--json", "run.json", "--workers", "1")
    assert result.exit_code == 0, result.output
    assert "2 points: mean irradiance" in result.output
    rows = _rows(tmp_path / "out.csv")
    for row, exact in zip(rows, QUAD_ROW.values(), strict=True):
        assert float(row["irradiance_band1_W_m2"]) == pytest.approx(exact, rel=1e-6)
        assert float(row["direct_irradiance_band2_W_m2"]) == pytest.approx(2 * exact, rel=1e-6)
        assert float(row["indirect_irradiance_band1_W_m2"]) == 0.0
        assert float(row["standard_error_band1_W_m2"]) == 0.0
    assert float(rows[1]["x"]) == 1.0 and float(rows[1]["nz"]) == 1.0
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["command"] == "irradiance" and record["results"]["points"] == 2
    assert record["choices"]["gather"] == "none" and record["errors"]["standard_error_rms_of_mean"] == 0.0
    assert set(record["seconds"]) >= {"read", "solve", "prepare", "gather"}


def test_a_saved_solution_is_used(run, tmp_path):
    solved = CliRunner().invoke(
        cli.main, ["solve", "scene.toml", "-o", "solved", "--elements", "10", "--no-preview"], standalone_mode=True
    )
    assert solved.exit_code == 0, solved.output
    result = run(
        "scene.toml", "--points", "points.csv", "-o", "out.csv", "--solution", "solved", "--json", "-",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["choices"]["solution"] == "from solved"
    assert float(_rows(tmp_path / "out.csv")[0]["irradiance_band1_W_m2"]) == pytest.approx(QUAD_ROW[0.0], rel=1e-6)


def test_radiance_points_and_standard_output(run, tmp_path):
    (tmp_path / "points.txt").write_text("# workplane\n0 0 0 0 0 1\n\n1\t0 0  0 0 1\n")
    result = run("scene.toml", "--points", "points.txt", "-o", "-", "--elements", "4")
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    assert lines[0].startswith("x,y,z,nx,ny,nz,irradiance_band1_W_m2") and len(lines) == 3
    assert "2 points" in result.stderr


def test_points_that_see_nothing_are_told(run, tmp_path):
    (tmp_path / "points.csv").write_text("0,0,-1,0,0,1\n0,0,0,0,0,1\n")
    result = run("scene.toml", "--points", "points.csv", "-o", "out.csv")
    assert "1 points receive nothing" in result.output


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0,0,0,0,0,1\n1,2,3\n", "points.csv: line 2: found '1,2,3', expected six numbers"),
        ("0,0,0,0,0,1\n\n0,0,nan,0,0,1\n", "points.csv: line 3"),
        ("x,y,z,nx,ny,nz\n0,0,0,0,0,0\n", "points.csv: line 2: found a normal of length zero"),
        ("x,y,z\nx,y,z\n", "points.csv: line 2"),
        ("", "points.csv: found no points"),
    ],
)
def test_bad_points_are_named_by_file_and_line(run, tmp_path, text, message):
    (tmp_path / "points.csv").write_text(text)
    result = run("scene.toml", "--points", "points.csv", "-o", "out.csv")
    assert result.exit_code == 2 and message in result.output and result.output.count("\n") == 1
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-o", "missing/out.csv"], "found no folder missing"),
        (["-o", "."], "-o: found the folder ."),
        (["-o", "-", "--json", "-"], "found - for both"),
        (["-o", "out.csv", "--solution", "nowhere"], "expected a saved solution"),
        (["-o", "out.csv", "--solution", "nowhere", "--elements", "3"], "both given"),
        (["-o", "out.csv", "--error", "0"], "--error"),
    ],
)
def test_bad_options_end_in_one_line(run, options, message):
    result = run("scene.toml", "--points", "points.csv", *options)
    assert result.exit_code == 2 and message in result.output and result.output.count("\n") == 1


def test_a_failed_write_leaves_the_old_table(run, tmp_path, monkeypatch):
    (tmp_path / "out.csv").write_text("old\n")

    def interrupted(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("radiosity.sensors.Gatherer.irradiance", interrupted)
    result = run("scene.toml", "--points", "points.csv", "-o", "out.csv")
    assert result.exit_code == 130
    assert (tmp_path / "out.csv").read_text() == "old\n"
    assert not [path for path in tmp_path.iterdir() if ".part" in path.name]


@pytest.mark.parametrize("options", [["--error", "0.002"], ["--elements", "64"]])
def test_ctrl_c_in_the_solve_ends_in_one_line_and_writes_nothing(run, tmp_path, monkeypatch, options):
    solve, stopped = radiosity.solve, []

    def interrupting(scene, **more):
        def report(event):
            stopped.append(event)
            signal.raise_signal(signal.SIGINT)

        return solve(scene, progress=report, **more)

    monkeypatch.setattr(radiosity, "solve", interrupting)
    result = run("scene.toml", "--points", "points.csv", "-o", "out.csv", "--json", "run.json", *options)
    assert stopped and result.exit_code == 130
    assert result.output == "radiosity: stopped by Ctrl-C during the solve; nothing was written\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["points.csv", "scene.toml"]


def test_the_reader_takes_what_tools_write(tmp_path):
    path = tmp_path / "points"
    path.write_text('\ufeff"X";"Y";"Z";"NX";"NY";"NZ"\n1;2;3;0;0;1\n')
    assert read_sensor_points(path).tolist() == [[1, 2, 3, 0, 0, 1]]
    path.write_text("x [m], y [m], z, nx, ny, nz\n 1 , 2 , 3 , 0 , 0 , 1e0 \n")
    assert read_sensor_points(path).tolist() == [[1, 2, 3, 0, 0, 1]]
    path.write_text("1;2;drei;0;0;1")
    with pytest.raises(InputError, match="line 1"):
        read_sensor_points(path)
    path.write_text("1e-3 -2 +3 0 0 1")
    assert np.allclose(read_sensor_points(path), [[1e-3, -2, 3, 0, 0, 1]])
    assert math.isclose(read_sensor_points(path)[0, 0], 1e-3)
