"""``radiosity render``: pictures of direct light, and what it refuses."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from radiosity.cli import main

ROOM = """
schema = 1
[camera]
eye = [0.0, -3.0, 1.0]
look_at = [0.0, 0.0, 0.5]
fov = 50
width = 40
height = 30
[materials.white]
reflectance = [0.8, 0.6, 0.4]
[materials.mirror]
reflectance = 0.1
specular = 0.6
[[surface]]
name = "floor"
material = "white"
polygon = [[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]]
[[surface]]
name = "ball"
material = "mirror"
sphere = { center = [0, 0, 0.5], radius = 0.4 }
[[light]]
type = "point"
name = "lamp"
intensity = 10
position = [1.0, -1.0, 3.0]
"""

NFF = """
v
from 0 -3 1
at 0 0 0
up 0 0 1
angle 45
hither 1
resolution 24 24
l 0 0 4
f 1 1 1 0.8 0.2 20 0 1
p 4
-1 -1 0
1 -1 0
1 1 0
-1 1 0
"""


def render(*arguments):
    return CliRunner().invoke(main, ["render", *map(str, arguments)])


@pytest.fixture
def room(tmp_path):
    path = tmp_path / "room.toml"
    path.write_text(ROOM)
    return path


def picture(path):
    return np.asarray(Image.open(path)).astype(int)


@pytest.mark.parametrize("sampling", ["aliased", "rows", "supersampled", "adaptive", "atomic"])
def test_a_picture_and_its_record(room, tmp_path, sampling):
    out = tmp_path / "room.png"
    result = render(room, "-o", out, "--direct-only", "--sampling", sampling, "--json", tmp_path / "r.json")
    assert result.exit_code == 0, result.output
    pixels = picture(out)
    assert pixels.shape == (30, 40, 3)
    assert pixels.max() > 200 and pixels.min() == 0
    assert pixels[..., 0].sum() > pixels[..., 2].sum()
    record = json.loads((tmp_path / "r.json").read_text())
    assert record["counters"]["cast_rays"] > 0 and record["counters"]["reflection_rays"] > 0
    assert record["settings"]["sampling"] == sampling
    assert (record["counters"].get("shadow_rays_saved", 0) > 0) == (sampling == "atomic")
    assert (record["counters"].get("plane_vertex_checks", 0) > 0) == (sampling == "rows")
    assert ("avoided by" in result.stdout) == (sampling == "rows")
    assert record["counters"]["cast_rays_hit"] > 0 and "see a surface" in result.stdout
    assert "white" in record["choices"]
    assert str(out) in result.stdout


def test_sampling_changes_little_and_workers_nothing(room, tmp_path):
    for name, more in (("a", ["--sampling", "adaptive"]), ("b", ["--workers", 1]), ("c", ["--workers", 2])):
        assert render(room, "-o", tmp_path / f"{name}.tiff", "--direct-only", "--white", 1.5, *more).exit_code == 0
    a, b, c = (picture(tmp_path / f"{name}.tiff") for name in "abc")
    np.testing.assert_array_equal(b, c)
    assert np.sqrt(((a - b) ** 2).mean()) < 4


def test_criteria_and_light_samples_reach_the_tracer(room, tmp_path):
    lamp = 'name = "panel"\nmaterial = "glow"\npolygon = [[-1, -1, 3], [-1, 1, 3], [1, 1, 3], [1, -1, 3]]'
    text = room.read_text().replace(
        "[materials.mirror]", "[materials.glow]\nreflectance = 0\nemission = 3\n[materials.mirror]"
    )
    room.write_text(text.replace("[[light]]", f"[[surface]]\n{lamp}\n[[light]]"))
    counts = {}
    for name, more in (
        ("plain", []),
        ("normals", ["--normal-angle", 2]),
        ("boundary", ["--shared-boundary"]),
        ("rays", ["--light-samples", 9]),
        ("error", ["--shadow-error", 0.1]),
    ):
        path = tmp_path / f"{name}.json"
        result = render(room, "-o", tmp_path / "x.png", "--direct-only", "--white", 1.5, "--json", path, *more)
        assert result.exit_code == 0, result.output
        record = json.loads(path.read_text())
        counts[name] = record["counters"] | {"samples": record["results"]["samples"]}
    assert counts["normals"]["cast_rays_saved"] <= counts["plain"]["cast_rays_saved"]
    assert counts["normals"]["shadow_rays_saved"] < counts["plain"]["shadow_rays_saved"]
    assert counts["boundary"]["samples"] > counts["plain"]["samples"]
    assert counts["rays"]["shadow_rays"] > 2 * counts["plain"]["shadow_rays"]


def test_nff_lights_do_not_fall_off_and_the_width_scales_both_sides(tmp_path):
    path = tmp_path / "square.nff"
    path.write_text(NFF)
    out = tmp_path / "square.png"
    assert render(path, "-o", out, "--direct-only", "--width", 48, "--white", 1, "--depth", 0).exit_code == 0
    pixels = picture(out)
    assert pixels.shape == (48, 48, 3)
    # In the middle of the square: 0.8 / pi, the light straight above, and 0.2 of the highlight's lobe beside it.
    assert abs(pixels[24, 24, 0] - 255 * 0.8 / np.pi) < 4
    assert render(path, "-o", out, "--direct-only", "--white", 1, "--falloff").exit_code == 0
    assert picture(out).max() < 20


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--sampling", "atomic"], "--direct-only"),
        (["--direct-only", "--atomic", "shadow"], "shadow"),
        (["--direct-only", "--level", "9"], "9"),
        (["--direct-only", "--threshold", "nan"], "nan"),
        (["--direct-only", "--normal-angle", "0"], "normal-angle"),
        (["--direct-only", "--shadow-error", "1"], "shadow-error"),
        (["--direct-only", "--side", "65"], "side"),
        (["--direct-only", "--json", "no/such/r.json"], "no such folder"),
    ],
)
def test_bad_options_end_in_one_line(room, tmp_path, arguments, words):
    result = render(room, "-o", tmp_path / "x.png", *arguments)
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1 and words in result.stderr
    assert not (tmp_path / "x.png").exists()


def test_a_scene_without_camera_or_a_strange_suffix_is_refused(room, tmp_path):
    lines = ROOM.splitlines()
    blind = tmp_path / "blind.toml"
    blind.write_text("\n".join(lines[:2] + lines[lines.index("[materials.white]") :]))
    for scene, out, words in (
        (blind, "x.png", "camera"),
        (room, "x.jpg", ".jpg"),
        (tmp_path / "none.toml", "x.png", "none"),
    ):
        result = render(scene, "-o", tmp_path / out, "--direct-only")
        assert result.exit_code == 2
        assert result.stderr.count("\n") == 1 and words in result.stderr
