"""The reproductions at tiny sizes: what they count, and what they leave; seconds are not asserted."""

from __future__ import annotations

import csv
import io
import json

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from radiosity import cli, reproduce
from workbench.accel.brute import BruteForce
from workbench.accel.voxel_grid import VoxelGrid
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.record import RunRecord
from workbench.render import rows as render_rows
from workbench.render.camera import PinholeRays
from workbench.shadow.woo import soft_shadow_kludge
from workbench.study import tori
from workbench.study.camera_table import PAPER_SECONDS, camera_study
from workbench.study.corner_samples import corner_hits, corner_study, spheres_scene
from workbench.study.hit_rates import METHODS, Setting, hit_rates, sweep
from workbench.study.result import StudyResult, format_table, interleaved, write_study
from workbench.study.tori import first_hits, tori_scene, tori_study

TINY_TORI = {"width": 48, "height": 36, "segments": 12, "sides": 8, "repeats": 1}


# ---- Woo's tori -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tori_result():
    return tori_study(**TINY_TORI)


def test_tori_check_trades_tests_for_checks_and_nothing_else(tori_result):
    rows = tori_result.rows
    assert [row["light"] for row in rows[::2]] == ["kludge, K = 8", "kludge, 3 to 17", "linear light, K = 8"]
    for plain, checked in zip(rows[::2], rows[1::2], strict=True):
        assert plain["avoided"] == plain["checks"] == plain["culls"] == 0
        assert checked["rays"] == plain["rays"] and checked["points"] == plain["points"]
        assert checked["tests"] + checked["avoided"] == plain["tests"]
        assert 0 < checked["culls"] <= checked["checks"]
        assert checked["avoided"] >= checked["culls"]
    # K = 8 rays a point, and 3 to 17 where the line is sampled adaptively.
    assert rows[0]["rays"] == 8 * rows[0]["points"]
    assert rows[4]["rays"] == 8 * rows[4]["points"]
    assert 3 * rows[2]["points"] <= rows[2]["rays"] <= 17 * rows[2]["points"]
    assert rows[0]["points"] == rows[2]["points"] < rows[4]["points"]


def test_tori_check_avoids_most_tests(tori_result):
    # No formula gives these: they are the counts of this scene and seed as first measured, with
    # room for the few tests that other rounding may move.
    avoided = [row["avoided"] / (row["avoided"] + row["tests"]) for row in tori_result.rows[1::2]]
    assert avoided == pytest.approx([0.519, 0.525, 0.627], abs=0.01)
    assert tori_result.rows[1]["saved_overall_%"] is not None
    assert tori_result.rows[1]["paper_overall_%"] == 8.5 and tori_result.rows[1]["paper_avoided"] == 1_369_790
    assert tori_result.rows[3]["paper_overall_%"] == 2.0


def test_tori_counts_are_those_of_the_kludge(tori_result):
    scene = tori_scene(12, 8, width=48, height=36)
    grid = VoxelGrid(Geometry.from_scene(scene))
    seen = first_hits(grid, scene.camera, tori.LIGHT[None])
    fractions = (np.arange(8) + np.random.default_rng(1).random((len(seen.points), 8))) / 8
    for check, row in zip((False, True), tori_result.rows[:2], strict=True):
        kludge = soft_shadow_kludge(
            grid, seen.points, seen.normals, tori.LIGHT, fractions, check=check, skip_polygons=seen.skip
        )
        assert kludge.counters["rays"] == len(seen.points) + row["rays"]
        assert kludge.counters["plane_vertex_checks"] == row["checks"]
        assert kludge.counters["tests_avoided"] == row["avoided"]


def test_first_hits_leave_out_what_faces_away():
    scene = tori_scene(12, 8, width=48, height=36)
    grid = VoxelGrid(Geometry.from_scene(scene))
    seen = first_hits(grid, scene.camera, tori.LIGHT[None])
    assert (np.einsum("ij,ij->i", seen.normals, tori.LIGHT - seen.points) > 0).all()
    below = first_hits(grid, scene.camera, np.array([[0.0, 0.0, -50.0]]))
    assert not (below.skip[:, 0] == 0).any()  # the floor sees nothing of a light below it
    assert (seen.skip[:, 0] == 0).any()


def test_tori_scene_has_more_than_ten_thousand_triangles():
    assert Geometry.from_scene(tori_scene()).polygon_count == 11_521


# ---- corner samples -------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", [tori_scene(12, 8, width=20, height=15), spheres_scene(width=20, height=15)])
def test_rows_with_the_check_hit_what_single_rays_hit(scene):
    grid = VoxelGrid(Geometry.from_scene(scene))
    rays = PinholeRays.from_camera(scene.camera)
    plain, checked = corner_hits(grid, rays, check=False), corner_hits(grid, rays)
    y, x = np.meshgrid(np.arange(16.0), np.arange(21.0), indexing="ij")
    single = BruteForce(grid.geometry).closest_hit(rays.eye, rays.directions(x.ravel(), y.ravel()))
    for found in (plain, checked):
        assert found.hits.t.shape == (16, 21)
        assert (found.hits.t.ravel() == single.t).all()
        assert (found.hits.polygon.ravel() == single.polygon).all()
        assert found.counters["rays"] == 16 * 21
    before, after = plain.counters, checked.counters
    assert after["polygon_tests"] + after["tests_avoided"] == before["polygon_tests"]
    assert after["voxels_stepped"] == before["voxels_stepped"]
    assert after["tests_avoided"] >= after["plane_vertex_culls"] > 0


def test_rows_miss_polygons_when_the_margin_is_broken(monkeypatch):
    scene = tori_scene(12, 8, width=20, height=15)
    grid = VoxelGrid(Geometry.from_scene(scene))
    rays = PinholeRays.from_camera(scene.camera)
    plain = corner_hits(grid, rays, check=False)
    monkeypatch.setattr(render_rows, "MARGIN", -1e15)  # whatever crosses the plane counts as outside
    assert (corner_hits(grid, rays).hits.polygon != plain.hits.polygon).any()


def test_corner_study_counts():
    result = corner_study(width=32, height=24, repeats=1)
    for plain, checked in zip(result.rows[::2], result.rows[1::2], strict=True):
        assert plain["rays"] == checked["rays"] == 33 * 25
        assert checked["tests"] + checked["avoided"] == plain["tests"]
        assert checked["paper_overall_%"] == 5.0 and plain["paper_overall_%"] is None


# ---- hardware cameras -----------------------------------------------------------------------------


def test_the_growth_of_the_papers_seconds_is_linear():
    # The line through the first and the last of the three: (447 - 42) / (1024 - 16) s a ray.
    few, some, many = (PAPER_SECONDS["rays", side] for side in (4, 17, 32))
    slope = (many - few) / (32**2 - 4**2)
    start = few - 4**2 * slope
    assert (round(start, 1), round(slope, 3)) == (35.6, 0.402)
    assert start + 17**2 * slope == pytest.approx(some, rel=3e-3)


def test_camera_study_counts_and_errors():
    result = camera_study(width=16, height=12, ray_sides=(4, 32), camera_sides=(4, 32), repeats=1)
    table = {(row["method"], row["samples"]): row for row in result.rows}
    points = table["naive camera, software", "32x32"]["renders"]
    for method in ("voxel rays", "voxel rays, check", "embree rays", "naive camera, software"):
        few, many = table[method, "4x4"], table[method, "32x32"]
        assert many["rms_irradiance_share"] < 0.5 * few["rms_irradiance_share"]
        assert many["rms_irradiance_share"] < 0.01
    for samples in ("4x4", "32x32"):
        plain, checked, embree = (table[name, samples] for name in ("voxel rays", "voxel rays, check", "embree rays"))
        assert plain["rms_area_share"] == checked["rms_area_share"]
        # The same rays, but Embree's are in single precision and start a hair off the surface.
        assert embree["rms_area_share"] == pytest.approx(plain["rms_area_share"], rel=0.05)
        naive, optimised = (table[f"{mode} camera, software", samples] for mode in ("naive", "optimised"))
        assert naive["renders"] == points and 0 < optimised["renders"] < points
        assert optimised["rms_irradiance_share"] == pytest.approx(naive["rms_irradiance_share"], rel=1e-9)
    assert table["voxel rays", "32x32"]["paper_ratio"] == 447 / 96
    assert table["optimised camera, software", "32x32"]["ratio"] == 1.0
    assert result.record.errors["reference_uncertainty_rms_irradiance_share"] < 2e-3
    assert any("35.6 s + 0.402 s a ray" in note for note in result.notes)


# ---- hit rates ------------------------------------------------------------------------------------

SMALL = Setting(segments=24, rays=9, side=16)


@pytest.mark.parametrize("setting", [SMALL, Setting(segments=24, rays=4, side=16, lights=2, group=16, light_side=0.3)])
def test_all_methods_block_the_rays_that_brute_force_blocks(setting):
    arguments = setting.build()
    points = arguments["points"]
    brute = BruteForce(arguments["geometry"])
    blocked = []
    for samples in arguments["samples"]:
        origins = np.repeat(points, samples.shape[1], axis=0)
        skip = np.tile(arguments["skip_polygons"], (len(origins), 1))
        found = brute.occluded(origins, samples.reshape(-1, 3) - origins, skip_polygons=skip)
        blocked.append(found.reshape(len(points), -1))
    assert 0.1 < np.mean(blocked) < 0.9
    for method in METHODS:
        assert (hit_rates(method=method, **arguments).blocked == np.asarray(blocked)).all()


def test_hit_rates_count_what_the_check_saves():
    rows = {row["method"]: row for row in sweep(SMALL, "light_side", [0.25])}
    arguments = Setting(segments=24, rays=9, side=16, light_side=0.25).build()
    found = {method: hit_rates(method=method, **arguments) for method in METHODS}
    plain, checked = found["rayID"].counters, found["plane-vertex"].counters
    assert checked["polygon_tests"] + checked["tests_avoided"] == plain["polygon_tests"]
    assert found["shaft, plane-vertex"].counters["polygon_tests"] < found["shaft"].counters["polygon_tests"]
    assert found["shaft, plane-vertex"].culled_share > found["shaft"].culled_share > 0.5
    assert rows["plane-vertex"]["avoided_%"] == pytest.approx(
        100 * checked["tests_avoided"] / plain["polygon_tests"], rel=1e-12
    )
    assert rows["rayID"]["culled_%"] is None and rows["rayID"]["avoided_%"] is None


def test_the_shaft_of_one_point_and_an_upright_light_is_its_pyramid():
    # A box shaft from a point to an axis-aligned rectangle is the light pyramid itself, so the
    # check finds nothing more.
    alone = {row["method"]: row for row in sweep(SMALL, "group", [1])}
    assert alone["shaft, plane-vertex"]["tests_per_ray"] == alone["shaft"]["tests_per_ray"]
    assert alone["shaft, plane-vertex"]["culled_%"] == pytest.approx(alone["shaft"]["culled_%"], abs=1e-9)


def test_finer_grids_and_smaller_lights_change_the_hit_rate_as_they_should():
    coarse, fine = [row for row in sweep(SMALL, "resolution", [4, 32]) if row["method"] == "plane-vertex"]
    assert coarse["avoided_%"] > 2 * fine["avoided_%"] and coarse["tests_per_ray"] > fine["tests_per_ray"]
    small, large = [row for row in sweep(SMALL, "light_side", [0.125, 1.0]) if row["method"] == "plane-vertex"]
    assert small["culled_%"] > large["culled_%"] + 20


def test_hit_rates_refuse_what_they_cannot_count():
    arguments = SMALL.build()
    with pytest.raises(OptionError, match="rayID, plane-vertex, shaft"):
        hit_rates(method="beams", **arguments)
    with pytest.raises(InputError, match="below the horizon"):
        hit_rates(method="shaft", **(arguments | {"normals": [[0.0, 0.0, -1.0]] * len(arguments["points"])}))
    with pytest.raises(InputError, match="different lengths"):
        hit_rates(method="shaft", **(arguments | {"samples": []}))
    with pytest.raises(OptionError, match="square rays"):
        Setting(rays=8).build()


# ---- what a study leaves --------------------------------------------------------------------------


def test_interleaved_runs_turn_about():
    order: list[str] = []
    seconds, answers = interleaved({name: lambda name=name: order.append(name) or name for name in "ab"}, 3)
    assert order == ["a", "b", "b", "a", "a", "b"]
    assert answers == {"a": "a", "b": "b"} and [len(spent) for spent in seconds.values()] == [3, 3]
    with pytest.raises(InputError, match="repeats"):
        interleaved({}, 0)


def test_tables_align_numbers_on_the_right():
    rows = [{"loop": "plain", "tests": 1234567, "saved_%": None}, {"loop": "check", "tests": 8, "saved_%": 12.345}]
    assert format_table(rows).splitlines() == [
        "loop       tests  saved %",
        "-----  ---------  -------",
        "plain  1,234,567",
        "check          8     12.3",
    ]


def test_command_writes_table_figure_and_record(monkeypatch, tmp_path):
    monkeypatch.setitem(reproduce.REPRODUCTIONS, "woo-tori", lambda quick: tori_study(**TINY_TORI))
    out = tmp_path / "new" / "tori"
    done = CliRunner().invoke(cli.main, ["reproduce", "woo-tori", "-o", str(out), "--quick"])
    assert done.exit_code == 0, done.output
    assert sorted(path.name for path in out.iterdir()) == ["record.json", "woo-tori.csv", "woo-tori.png"]
    rows = list(csv.DictReader(io.StringIO((out / "woo-tori.csv").read_text())))
    record = json.loads((out / "record.json").read_text())
    assert [int(row["tests"]) for row in rows] == [row["tests"] for row in record["results"]["rows"]]
    assert record["settings"]["width"] == 48 and record["counters"]["tests_avoided"] > 0
    picture = np.asarray(Image.open(out / "woo-tori.png").convert("L"))
    assert picture.shape[0] > 400 and picture.std() > 20
    assert "1,369,790" in done.output and "Figure 4, check" in done.output


@pytest.mark.parametrize("name", sorted(reproduce.REPRODUCTIONS))
def test_figures_of_quick_runs_are_drawn(name, tmp_path, monkeypatch):
    tiny = {
        "camera-table-1": lambda: camera_study(width=8, height=6, repeats=1),
        "woo-corner-samples": lambda: corner_study(width=8, height=6, repeats=1),
        "woo-tori": lambda: tori_study(**TINY_TORI),
    }
    if name not in tiny:
        pytest.skip(f"{name} has tests of its own")
    files = write_study(tiny[name](), tmp_path)
    assert [path.name for path in files] == [f"{name}.csv", f"{name}.png", "record.json"]
    assert np.asarray(Image.open(files[1]).convert("L")).std() > 20


def test_command_refuses_an_unknown_name_and_an_unwritable_folder(tmp_path):
    done = CliRunner().invoke(cli.main, ["reproduce", "woo-chairs"])
    assert done.exit_code == 2 and "woo-tori" in done.output
    (tmp_path / "file").write_text("")
    result = StudyResult("name", "title", [{"a": 1}], [], RunRecord("test"), lambda figure: None)
    with pytest.raises(InputError, match="give another folder"):
        write_study(result, tmp_path / "file")


# ---- directional bundles --------------------------------------------------------------------------


def test_bundles_study_counts():
    from radiosity.report.directional_bundles import bundles_study

    result = bundles_study(patches=3, rays=(4, 16), total=512, repeats=1)
    for plain, checked in zip(result.rows[::2], result.rows[1::2], strict=True):
        assert plain["same_hits"] and checked["same_hits"]
        assert plain["rays"] == checked["rays"] == plain["bundles"] * plain["rays_a_bundle"]
        assert plain["checks_per_bundle"] == plain["rejected_per_bundle"] == 0
        assert 0 < checked["rejected_per_bundle"] <= checked["checks_per_bundle"]
        avoided = checked["tests_per_ray"] + checked["tests_avoided_per_ray"]
        assert checked["tests_per_ray"] < plain["tests_per_ray"] <= avoided * (1 + 1e-12)
