"""The command ``radiosity shadow``: its table, its files, and what it refuses."""

from __future__ import annotations

import csv
import json
import re

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from radiosity import cli
from radiosity.surface_grid import read_points, surface_grid
from workbench.errors import InputError
from workbench.geometry.flat import Geometry
from workbench.scene.load import load

SCENE = """\
schema = 1
[materials.grey]
reflectance = [0.5, 0.5, 0.5]
[materials.lamp]
reflectance = 0.0
emission = [3.0, 2.0, 1.0]
[[surface]]
name = "floor"
material = "grey"
polygon = [[-1.5, -1.5, 0.0], [1.5, -1.5, 0.0], [1.5, 1.5, 0.0], [-1.5, 1.5, 0.0]]
[[surface]]
name = "shade"
material = "grey"
polygon = [[-0.2, -0.2, 1.0], [0.2, -0.2, 1.0], [0.2, 0.2, 1.0], [-0.2, 0.2, 1.0]]
[[surface]]
name = "lamp"
material = "lamp"
polygon = [[-0.5, -0.5, 2.0], [-0.5, 0.5, 2.0], [0.5, 0.5, 2.0], [0.5, -0.5, 2.0]]
"""
ALL = "adaptive,auto,camera,camera-optimised,exact,rays,rays+plane-vertex,shaft"


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "shade.toml"
    path.write_text(SCENE)
    return path


def run(*arguments):
    return CliRunner().invoke(cli.main, ["shadow", *(str(argument) for argument in arguments)])


def test_one_table_one_figure_one_record(scene, tmp_path):
    out = tmp_path / "out"
    result = run(scene, "--grid", "12x10", "--method", ALL, "--samples", 64, "--workers", 1, "-o", out)
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in out.iterdir()) == ["record.json", "shadow.csv", "shadow.png"]
    with (out / "shadow.csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert ",".join(rows) == ALL
    for method, row in rows.items():
        assert method in result.stdout
        assert row["error"] == "" if method == "exact" else float(row["error"]) < 0.1
        assert float(row["stated_error"]) < 0.15
    assert float(rows["auto"]["error"]) < 1e-12
    counted = rows["rays+plane-vertex"]
    assert int(counted["rays"]) == 120 * 64
    # Two polygons of the scene can be met, and no ray tests one twice.
    assert 0 < int(counted["tests"]) + int(counted["avoided"]) <= 2 * 120 * 64
    assert 0 < float(counted["hit_rate"]) < 1
    assert rows["rays"]["tests"] == ""  # Embree does not count
    record = json.loads((out / "record.json").read_text())
    assert record["choices"]["reference"] == "exact cuts"
    assert record["results"]["mean_irradiance_W_m2"][0] == pytest.approx(
        3 * record["results"]["mean_irradiance_W_m2"][2]
    )
    with Image.open(out / "shadow.png") as picture:
        assert min(picture.size) > 300
        assert np.asarray(picture.convert("L")).std() > 10  # something is drawn


def test_several_numbers_of_samples_give_a_row_each_and_the_slope_of_the_error(scene, tmp_path):
    result = run(scene, "--grid", "24x20", "--method", "rays,auto", "--samples", "4,16,64,256,1024", "-o", tmp_path)
    assert result.exit_code == 0, result.output
    with (tmp_path / "shadow.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["method"], row["samples"]) for row in rows] == [
        *(("rays", count) for count in ("4", "16", "64", "256", "1024")),
        ("auto", ""),
    ]
    errors = [float(row["error"]) for row in rows[:5]]
    assert errors == sorted(errors, reverse=True)
    # A lattice cut by straight edges: about -3/4, where independent samples have -1/2.
    notes = json.loads((tmp_path / "record.json").read_text())["results"]["notes"]
    slope = float(re.fullmatch(r"rays: the error falls as samples\^(-[0-9.]+)", notes[0])[1])
    assert -1.0 < slope < -0.6
    assert notes[0] in result.stdout
    with Image.open(tmp_path / "shadow.png") as picture:
        assert picture.size[0] > 1500  # a fourth panel


def test_exact_irradiance_points_from_a_file(scene, tmp_path):
    points = tmp_path / "points.csv"
    points.write_text("x,y,z,nx,ny,nz\n0,0,0,0,0,2\n1.5,0,0,0,0,1\n\n0,0,0,0,0,-1\n")
    result = run(scene, "--points", points, "--method", "exact", "--json", "-")
    record = json.loads(result.stdout)
    # shadow/square/row-a=0.4: 0.07891872805 and 0.10261467505 for radiance 1; the third point looks down.
    wanted = (0.07891872804788831 + 0.10261467505329237 + 0.0) / 3 * np.array([3.0, 2.0, 1.0]) / np.pi
    np.testing.assert_allclose(record["results"]["mean_irradiance_W_m2"], wanted, rtol=1e-9)
    assert "exact" in result.stderr


@pytest.mark.parametrize("name", ["cornell-box", "office", "sculpture-room"])
def test_built_in_scenes(name):
    result = run(name, "--grid", "6x6", "--samples", 16, "--method", "auto,rays")
    assert result.exit_code == 0, result.output
    assert "'floor'" in result.stdout


def test_the_grid_lies_on_the_polygons_and_not_in_holes():
    scene = load("cornell-box")
    geometry = Geometry.from_scene(scene)
    sensors = surface_grid(scene, geometry, None, (20, 30))
    assert sensors.shape == (30, 20)
    assert (np.asarray(geometry.surface_name)[geometry.polygon_surface[sensors.own]] == "floor").all()
    # The two blocks stand on holes of the floor.
    assert 0.6 * 600 < len(sensors.points) < 0.9 * 600
    np.testing.assert_allclose(sensors.normals @ [0, 1, 0], 1.0)
    wall = surface_grid(scene, geometry, "back wall", (5, 5))
    assert len(wall.points) == 25
    assert np.abs((wall.points - wall.points[0]) @ wall.normals[0]).max() < 1e-12


def test_answers_do_not_depend_on_workers(scene, tmp_path):
    tables = []
    for workers in (1, 2):
        run(scene, "--method", "auto,rays", "--workers", workers, "-o", tmp_path / str(workers))
        with (tmp_path / str(workers) / "shadow.csv").open() as file:
            tables.append([{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)])
    assert tables[0] == tables[1]


@pytest.mark.parametrize(
    ("arguments", "pattern"),
    [
        (["--method", "magic"], "--method: found 'magic', expected one or more of adaptive, auto"),
        (["--light", "sun"], "--light: found 'sun', expected one of lamp"),
        (["--surface", "roof"], "--surface: found 'roof', expected one of floor, lamp, shade"),
        (["--grid", "3"], "found '3', expected two numbers"),
        (["--grid", "0x5"], "expected two numbers from 1 to 4096"),
        (["--points", "absent.csv"], "absent.csv: cannot be read"),
        (["--points", "absent.csv", "--grid", "3x3"], "found --grid or --surface as well"),
        (["--samples", "0"], "--samples"),
        (["--samples", "16,4"], "in rising order"),
        (["--samples", "4,,16"], "found '4,,16', expected numbers from 1"),
        (["--error", "2"], "--error"),
        (["-o", "/proc/none"], "give another folder"),
    ],
)
def test_bad_input_ends_with_code_2_and_one_line(scene, arguments, pattern):
    result = run(scene, *arguments)
    assert result.exit_code == 2
    assert pattern in result.stderr
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        ("1,2,3\n", "line 1: found '1,2,3', expected six numbers"),
        ("x,y,z,nx,ny,nz\n1,2,3,0,0,nan\n", "line 2"),
        ("1,2,3,0,0,0\n", "normal of length zero"),
        ("x,y,z,nx,ny,nz\n", "found no points"),
    ],
)
def test_bad_points_name_their_line(tmp_path, text, pattern):
    path = tmp_path / "points.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=pattern):
        read_points(path)
