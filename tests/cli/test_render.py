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
    assert ("widest_feature_that_can_be_missed_pixels" in record["errors"]) == (sampling in ("adaptive", "atomic"))
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
    # In the middle of the square: 0.8 / pi, the light straight above, and 0.2 of the highlight's lobe beside it;
    # shown by the curve of sRGB (IEC 61966-2-1).
    assert abs(pixels[24, 24, 0] - 255 * (1.055 * (0.8 / np.pi) ** (1 / 2.4) - 0.055)) < 4
    assert render(path, "-o", out, "--direct-only", "--white", 1, "--falloff").exit_code == 0
    assert picture(out).max() < 255 * (1.055 * 0.06 ** (1 / 2.4) - 0.055)  # 1/16 of it, four lengths away


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--sampling", "atomic"], "belongs to --direct-only"),
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


CORNER = """
schema = 1
[camera]
eye = [1.0, 0.4, 1.0]
look_at = [1.0, 2.0, 0.8]
fov = 60
width = 16
height = 12
[cameras.above]
eye = [1.0, 1.0, 1.9]
look_at = [1.0, 1.01, 0.0]
up = [0, 1, 0]
width = 9
height = 9
[materials.wall]
reflectance = [0.7, 0.5, 0.3]
[materials.lamp]
reflectance = 0.1
emission = 9
[[surface]]
name = "room"
material = "wall"
box = { min = [0, 0, 0], max = [2, 2, 2], inward = true }
[[surface]]
name = "lamp"
material = "lamp"
polygon = [[0.7, 0.7, 1.99], [0.7, 1.3, 1.99], [1.3, 1.3, 1.99], [1.3, 0.7, 1.99]]
"""


@pytest.fixture
def corner(tmp_path):
    path = tmp_path / "corner.toml"
    path.write_text(CORNER)
    return path


def rgbe(path):
    """Radiance of a flat .hdr file (G. Ward, Graphics Gems II)."""
    head, _, rest = path.read_bytes().partition(b"\n\n")
    assert head.startswith(b"#?RADIANCE")
    size, _, data = rest.partition(b"\n")
    _, height, _, width = size.split()
    pixels = np.frombuffer(data, np.uint8).reshape(int(height), int(width), 4).astype(float)
    return (pixels[..., :3] + 0.5) * np.exp2(pixels[..., 3:] - 136)


def test_a_gathered_picture_in_every_format(corner, tmp_path):
    import OpenEXR

    solution = tmp_path / "solution"
    assert CliRunner().invoke(main, ["solve", str(corner), "-o", str(solution), "--elements", "80"]).exit_code == 0
    result = render(corner, "--solution", solution, "-o", tmp_path / "a.exr", "--quick", "--json", tmp_path / "r.json")
    assert result.exit_code == 0, result.output
    raw = OpenEXR.File(str(tmp_path / "a.exr")).channels()["RGB"].pixels
    assert raw.shape == (12, 16, 3) and raw.dtype == np.float32 and (raw > 0).all()
    record = json.loads((tmp_path / "r.json").read_text())
    assert record["settings"]["error"] == 0.1 and record["results"]["samples_per_pixel"]["indirect"] > 0
    result = render("--solution", solution, "-o", tmp_path / "a.hdr", "--quick")
    assert result.exit_code == 0, result.output
    np.testing.assert_allclose(rgbe(tmp_path / "a.hdr"), raw, rtol=0.02, atol=0.01 * raw.max())
    result = render("--solution", solution, "-o", tmp_path / "a.png", "--quick", "--white", float(raw.max()))
    assert result.exit_code == 0, result.output
    light = raw / raw.max()
    shown = 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    assert np.abs(picture(tmp_path / "a.png") - shown).max() <= 1  # sRGB, IEC 61966-2-1
    assert not list(tmp_path.glob(".*part*")) and not list(tmp_path.glob("*.resume.npz"))


def test_it_solves_by_itself_and_takes_cameras_by_name_and_by_place(corner, tmp_path):
    result = render(corner, "-o", tmp_path / "a.png", "--quick", "--camera", "above", "--show-samples")
    assert result.exit_code == 0, result.output
    assert picture(tmp_path / "a.png").shape == (9, 9, 3)
    assert (tmp_path / "a-samples.png").stat().st_size > 1000
    place = ["--eye", "1,1,1.9", "--look-at", "1,1.01,0", "--up", "0,1,0", "--fov", "45", "--size", "9x9"]
    assert render(corner, "-o", tmp_path / "b.png", "--quick", *place).exit_code == 0
    np.testing.assert_array_equal(picture(tmp_path / "a.png"), picture(tmp_path / "b.png"))
    assert render(corner, "-o", tmp_path / "c.png", "--quick", *place, "--exposure", "-1").exit_code == 0
    assert picture(tmp_path / "c.png").mean() < picture(tmp_path / "b.png").mean()


def test_ctrl_c_leaves_what_is_drawn_and_resume_goes_on(corner, tmp_path, monkeypatch):
    from radiosity import gather

    monkeypatch.setattr(gather, "TILE", 8)
    out = tmp_path / "a.exr"
    whole = render(corner, "-o", tmp_path / "whole.exr", "--quick")
    assert whole.exit_code == 0, whole.output
    place = gather._Tile.place_nodes
    calls = []

    def stopped(self, nodes):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return place(self, nodes)

    monkeypatch.setattr(gather._Tile, "place_nodes", stopped)
    result = render(corner, "-o", out, "--quick")
    assert result.exit_code == 130 and "--resume" in result.stderr and out.exists()
    assert (tmp_path / "a.exr.resume.npz").exists()
    other = render(corner, "-o", out, "--error", 0.2, "--resume")
    assert other.exit_code == 2 and "another picture" in other.stderr
    monkeypatch.setattr(gather._Tile, "place_nodes", place)
    result = render(corner, "-o", out, "--quick", "--resume")
    assert result.exit_code == 0, result.output
    assert not (tmp_path / "a.exr.resume.npz").exists()
    import OpenEXR

    a, b = (OpenEXR.File(str(p)).channels()["RGB"].pixels for p in (out, tmp_path / "whole.exr"))
    np.testing.assert_allclose(a, b, rtol=0.1)


def test_ctrl_c_in_the_solve_leaves_it_and_resume_goes_on(corner, tmp_path, monkeypatch):
    import signal

    import radiosity

    solve, events = radiosity.solve, []

    def interrupting(scene, *, progress, **options):
        def report(event):
            events.append(event)
            if len(events) == 2:
                signal.raise_signal(signal.SIGINT)
            progress(event)

        return solve(scene, progress=report, **options)

    before = signal.getsignal(signal.SIGINT)
    out, kept = tmp_path / "a.exr", tmp_path / "a.exr.solution"
    monkeypatch.setattr(radiosity, "solve", interrupting)
    result = render(corner, "-o", out, "--quick")
    assert result.exit_code == 130 and "--resume" in result.stderr and not out.exists()
    assert signal.getsignal(signal.SIGINT) is before
    assert (radiosity.Solution.load(kept).radiosity >= 0).all()
    monkeypatch.setattr(radiosity, "solve", solve)
    other = render(corner, "-o", out, "--error", 0.2, "--resume")
    assert other.exit_code == 2 and "another picture" in other.stderr
    result = render(corner, "-o", out, "--quick", "--resume")
    assert result.exit_code == 0, result.output
    assert out.exists() and not kept.exists()


def test_the_picture_states_its_error(corner, tmp_path):
    # Against the same picture at a far smaller error.
    import OpenEXR

    found = {}
    for error in (0.2, 0.05, 0.01):
        out, record = tmp_path / f"{error}.exr", tmp_path / "r.json"
        result = render(corner, "-o", out, "--error", error, "--size", "32x24", "--json", record)
        assert result.exit_code == 0, result.output
        found[error] = (
            OpenEXR.File(str(out)).channels()["RGB"].pixels.astype(float),
            json.loads(record.read_text())["errors"]["picture_relative_rms"],
        )
    truth, _ = found.pop(0.01)
    for error, (picture, stated) in found.items():
        actual = np.sqrt(np.mean(((picture - truth) ** 2).sum(axis=2) / (truth**2).sum(axis=2)))
        assert actual / 3 < stated < 3 * max(actual, 0.3 * error)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--camera", "below"], "above"),
        (["--camera", "above", "--eye", "0,0,0"], "--camera"),
        (["--eye", "0,0"], "three numbers"),
        (["--size", "0x4"], "640x480"),
        (["--size", "4x4", "--width", "4"], "--size"),
        (["--error", "nan"], "nan"),
        (["--error", "1.5"], "1.5"),
        (["--quick", "--error", "0.1"], "--error"),
        (["--resume"], "not found"),
        (["--solution", "none"], "none"),
        (["--tone", "matte"], "matte"),
        (["--direct-only", "--quick"], "--direct-only"),
        (["--eye", "1,1,1", "--look-at", "1,1,1"], "camera"),
    ],
)
def test_bad_options_of_gathered_pictures_end_in_one_line(corner, tmp_path, arguments, words):
    result = render(corner, "-o", tmp_path / "x.png", *arguments)
    assert result.exit_code == 2, result.output
    assert result.stderr.count("\n") == 1 and words in result.stderr
    assert not list(tmp_path.glob("*x.png*"))


def test_without_a_scene_or_in_other_bands_there_is_no_picture(corner, tmp_path):
    result = render("-o", tmp_path / "x.png")
    assert result.exit_code == 2 and "SCENE" in result.stderr
    corner.write_text(CORNER.replace("[0.7, 0.5, 0.3]", "[0.7, 0.5, 0.3, 0.2]"))
    result = render(corner, "-o", tmp_path / "x.png", "--quick")
    assert result.exit_code == 2 and "4 bands" in result.stderr
