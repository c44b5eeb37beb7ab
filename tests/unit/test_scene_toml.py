"""The TOML scene format: what it makes, and that every fault is one clear line."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from workbench.errors import SceneError
from workbench.geometry.polygons import vector_area
from workbench.scene.toml import load_scene

START = "schema = 1\n[materials.grey]\nreflectance = 0.5\n"
SQUARE = "[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]"


def scene_of(tmp_path, text, name="scene.toml"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return load_scene(path)


def surface_of(tmp_path, shape):
    return scene_of(tmp_path, f'{START}[[surface]]\nname = "s"\nmaterial = "grey"\n{shape}\n').surfaces[0]


def area(surface):
    return sum(np.linalg.norm(vector_area(rings)) for rings in surface.faces())


# ---------------------------------------------------------------------------------------------
# What it makes


def test_one_of_each_record(tmp_path):
    scene = scene_of(
        tmp_path,
        """
schema = 1
name = "all"
description = "one of each"
background = [0.1, 0.2, 0.3]
closed = true

[camera]
eye = [0, -3, 1]
look_at = [0, 0, 1]
fov = 40
width = 320
height = 200

[materials.glossy]
reflectance = [0.2, 0.3, 0.4]
specular = 0.5
exponent = 30
transmittance = [0.1, 0, 0.1]
ior = 1.5
two_sided = true

[[surface]]
name = "floor"
material = "glossy"
polygon = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]

[[light]]
name = "bulb"
type = "point"
position = [0, 0, 2]
intensity = [1, 2, 3]

[[light]]
name = "lamp"
type = "spot"
position = [0, 0, 2]
direction = [0, 0, -2]
intensity = 5
cone_deg = 30
exponent = 4

[[light]]
name = "sun"
type = "directional"
direction = [0, 3, -4]
irradiance = 800

[[light]]
name = "tube"
type = "linear"
position = [0, 0, 2]
end = [1, 0, 2]
intensity = 7
lambertian = true

[[light]]
name = "panel"
type = "area"
polygon = [[0, 0, 2], [0, 1, 2], [1, 1, 2], [1, 0, 2]]
radiance = 2
""",
    )
    assert (scene.name, scene.bands, scene.closed) == ("all", 3, True)
    assert np.allclose(scene.background, [0.1, 0.2, 0.3])
    assert (scene.camera.fov_deg, scene.camera.width, scene.camera.height) == (40, 320, 200)
    assert scene.camera.up.tolist() == [0, 0, 1]
    floor, panel = scene.surfaces
    assert floor.material.reflectance.tolist() == [0.2, 0.3, 0.4]
    assert floor.material.specular.tolist() == [0.5, 0.5, 0.5]
    assert floor.material.transmittance.tolist() == [0.1, 0, 0.1]
    assert (floor.material.exponent, floor.material.ior, floor.material.two_sided) == (30, 1.5, True)
    assert panel.name == "panel"
    assert panel.material.emission == pytest.approx(np.full(3, 2 * math.pi))  # exitance = pi radiance
    assert not panel.material.reflectance.any()
    assert np.allclose(vector_area(panel.face(0)), [0, 0, -1])
    bulb, lamp, sun, tube = scene.lights
    assert (bulb.kind, bulb.power.tolist()) == ("point", [1, 2, 3])
    assert (lamp.kind, lamp.cone_deg, lamp.exponent) == ("spot", 30, 4)
    assert lamp.direction.tolist() == [0, 0, -1]
    assert (sun.kind, sun.power.tolist()) == ("directional", [800, 800, 800])
    assert np.allclose(sun.direction, [0, 0.6, -0.8])
    assert (tube.kind, tube.end.tolist(), tube.lambertian) == ("linear", [1, 0, 2], True)


@pytest.mark.parametrize(
    ("extra", "bands"),
    [
        ("", 1),
        ("background = [1, 2]", 2),
        ("bands = 4", 4),
        ("bands = 1", 1),
    ],
)
def test_bands_are_those_of_the_longest_list_unless_said(tmp_path, extra, bands):
    text = START.replace("\n", f"\n{extra}\n", 1)
    scene = scene_of(tmp_path, f'{text}[[surface]]\nname = "s"\nmaterial = "grey"\npolygon = {SQUARE}\n')
    assert scene.bands == bands
    assert scene.background.shape == scene.surfaces[0].material.reflectance.shape == (bands,)
    assert (scene.surfaces[0].material.reflectance == 0.5).all()


def test_a_hole_may_run_either_way(tmp_path):
    for hole in ("[[0.2, 0.2, 0], [0.2, 0.4, 0], [0.4, 0.2, 0]]", "[[0.2, 0.2, 0], [0.4, 0.2, 0], [0.2, 0.4, 0]]"):
        surface = surface_of(tmp_path, f"polygon = {SQUARE}\nholes = [{hole}]")
        assert len(surface.face(0)) == 2
        assert area(surface) == pytest.approx(0.98)


def test_steps_of_a_transform_are_applied_in_their_order(tmp_path):
    moved = surface_of(
        tmp_path,
        f"polygon = {SQUARE}\n"
        "transform = [{translate = [1, 0, 0]}, {rotate = {axis = [0, 0, 2], degrees = 90}}, {scale = [1, 1, 3]}]",
    )
    # (1, 1, 0) -> (2, 1, 0) -> (-1, 2, 0)
    assert moved.vertices[2].tolist() == [-1, 2, 0]
    turned_first = surface_of(
        tmp_path,
        f"polygon = {SQUARE}\ntransform = [{{rotate = {{axis = [0, 0, 1], degrees = 90}}}}, {{translate = [1, 0, 0]}}]",
    )
    assert turned_first.vertices[2].tolist() == [0, 1, 0]


def test_shapes_have_their_areas(tmp_path):
    assert area(surface_of(tmp_path, "box = {min = [0, 0, 0], max = [1, 2, 3], omit = ['-z']}")) == pytest.approx(20)
    ball = surface_of(tmp_path, "sphere = {center = [1, 2, 3], radius = 2, facet_error = 0.001}")
    assert area(ball) == pytest.approx(16 * math.pi, rel=0.003)
    assert ball.sphere.radius == 2
    scaled = surface_of(tmp_path, "sphere = {center = [0, 0, 0], radius = 1}\ntransform = [{scale = [1, 2, 1]}]")
    assert scaled.sphere is None
    knot = surface_of(tmp_path, "torus_knot = {segments = 60, sides = 8}")
    assert knot.face_count == 2 * 60 * 8
    assert knot.facet_error > 0
    both = surface_of(tmp_path, f"polygons = [{SQUARE}, [[0, 0, 1], [0, 1, 1], [1, 0, 1]]]")
    assert both.face_count == 2
    assert area(both) == pytest.approx(1.5)


def test_a_spline_with_weights_is_a_quarter_of_a_cylinder(tmp_path):
    half = math.sqrt(0.5)
    row = "[[1, 0, {z}], [1, 1, {z}, {w}], [0, 1, {z}]]"
    points = f"[{row.format(z=0, w=half)}, {row.format(z=2, w=half)}]"
    shape = f"spline = {{degree = [1, 2], points = {points}, segments = [1, 64], flip = FLIP}}"
    quarter = surface_of(tmp_path, shape.replace("FLIP", "true"))
    assert area(quarter) == pytest.approx(math.pi, rel=1e-3)
    assert np.allclose(np.hypot(quarter.vertices[:, 0], quarter.vertices[:, 1]), 1)
    assert np.allclose(quarter.vertex_normals[:, :2], quarter.vertices[:, :2])
    assert all(vector_area(rings) @ rings[0].mean(axis=0) > 0 for rings in quarter.faces())
    inside = surface_of(tmp_path, shape.replace("FLIP", "false"))
    assert all(vector_area(rings) @ rings[0].mean(axis=0) < 0 for rings in inside.faces())
    # The chord of 90/64 degrees misses the unit circle by 1 - cos(90/128 degrees).
    assert quarter.facet_error == pytest.approx(1 - math.cos(math.pi / 256), rel=0.3)


OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\ng a\nf 1 2 3 4\ng b\nf 1 2 5\n"


def test_a_mesh_brings_its_groups_and_may_be_given_a_material(tmp_path):
    (tmp_path / "m.obj").write_text(OBJ)
    own = scene_of(tmp_path, 'schema = 1\n[[surface]]\nname = "m"\nmesh = "m.obj"\n')
    assert [surface.name for surface in own.surfaces] == ["m/a", "m/b"]
    assert own.bands == 3
    one_band = scene_of(tmp_path, 'schema = 1\nbands = 1\n[[surface]]\nname = "m"\nmesh = "m.obj"\n')
    assert one_band.surfaces[0].material.reflectance.tolist() == [0.5]
    given_one = scene_of(
        tmp_path, START + '[[surface]]\nname = "m"\nmaterial = "grey"\nmesh = "m.obj"\ntransform = [{scale = 2}]\n'
    )
    assert given_one.bands == 1
    assert given_one.surfaces[0].material.name == "grey"
    assert area(given_one.surfaces[0]) == pytest.approx(4.0)


# ---------------------------------------------------------------------------------------------
# Faults


def one(shape):
    return f'{START}[[surface]]\nname = "s"\nmaterial = "grey"\n{shape}\n'


def lit(light):
    return f'{one(f"polygon = {SQUARE}")}[[light]]\nname = "l"\n{light}\n'


FAULTS = {
    "no schema": ("name = 'x'", "schema", "found nothing, expected 1"),
    "schema misspelt": ("shema = 1", "schema", "'shema' a misspelling"),
    "other schema": ("schema = 2", "schema", "found 2, expected 1"),
    "schema true": ("schema = true", "schema", "found True, expected 1"),
    "no surface": ("schema = 1", "surface", "at least one [[surface]]"),
    "unknown top key": ("schema = 1\ncloze = true", "cloze", "did you mean 'closed'?"),
    "unknown key far from all": ("schema = 1\nqqqq = true", "qqqq", "expected one of schema, name"),
    "unknown material key": (
        "schema = 1\n[materials.emission]\nreflectence = 1",
        "materials.emission.reflectence",
        "did you mean 'reflectance'?",
    ),
    "unknown surface key": (one("poligon = []"), "surface[0].poligon", "did you mean 'polygon'?"),
    "unknown shape key": (one("box = {min=[0,0,0], max=[1,1,1], inwards=true}"), "surface[0].box.inwards", "'inward'?"),
    "unknown step": (
        one(f"polygon = {SQUARE}\ntransform = [{{rotation = 1}}]"),
        "surface[0].transform[0].rotation",
        "'rotate'?",
    ),
    "unknown rotation key": (
        one(f"polygon = {SQUARE}\ntransform = [{{rotate = {{axis = [0,0,1], degree = 1}}}}]"),
        "surface[0].transform[0].rotate.degree",
        "did you mean 'degrees'?",
    ),
    "unknown camera key": (
        "schema = 1\n[camera]\neye=[0,0,0]\nlookat=[1,0,0]",
        "camera.lookat",
        "did you mean 'look_at'?",
    ),
    "odd key": ('schema = 1\n[materials."a b"]\nior = 0', "materials.'a b'.ior", "greater than 0"),
    "reflectance above 1": (
        "schema = 1\n[materials.m]\nreflectance = 1.1",
        "materials.m.reflectance",
        "found 1.1, expected 0..1",
    ),
    "reflectance below 0": (
        "schema = 1\n[materials.m]\nreflectance = [0.5, -0.1]",
        "materials.m.reflectance",
        "expected 0 or more",
    ),
    "reflectance nan": (
        "schema = 1\n[materials.m]\nreflectance = nan",
        "materials.m.reflectance",
        "found nan, expected a finite",
    ),
    "sum above 1": (
        "schema = 1\n[materials.m]\nreflectance = 0.7\nspecular = [0.1, 0.4]",
        "materials.m",
        "= 1.1, expected at most 1",
    ),
    "emission inf": (
        "schema = 1\n[materials.m]\nemission = inf",
        "materials.m.emission",
        "found inf, expected a finite",
    ),
    "emission text": (
        "schema = 1\n[materials.m]\nemission = 'much'",
        "materials.m.emission",
        "found 'much', expected a number",
    ),
    "emission empty": ("schema = 1\n[materials.m]\nemission = []", "materials.m.emission", "empty list"),
    "bands disagree": (
        "schema = 1\n[materials.m]\nemission = [1, 2]\nreflectance = [0.1, 0.2, 0.3]",
        "materials.m.emission",
        "found 2 values, expected 1 or 3",
    ),
    "bands against said": (
        "schema = 1\nbands = 2\nbackground = [1, 2, 3]",
        "background",
        "found 3 values, expected 1 or 2",
    ),
    "bands zero": ("schema = 1\nbands = 0", "bands", "found 0, expected 1 or more"),
    "not true or false": ("schema = 1\nclosed = 1", "closed", "found 1, expected true or false"),
    "materials a list": ("schema = 1\nmaterials = []", "materials", "expected a table"),
    "surface a table": ("schema = 1\n[surface]\nname = 's'", "surface", "expected a list"),
    "no name": (f"{START}[[surface]]\nmaterial = 'grey'\npolygon = {SQUARE}", "surface[0].name", "found nothing"),
    "name of two lines": (one(f"polygon = {SQUARE}").replace('"s"', '"s\\nt"'), "surface[0].name", "on one line"),
    "name twice": (
        one(f"polygon = {SQUARE}") + one(f"polygon = {SQUARE}").removeprefix(START),
        "surface[1].name",
        "first at surface[0]",
    ),
    "no material": (f"{START}[[surface]]\nname = 's'\npolygon = {SQUARE}", "surface[0].material", "found nothing"),
    "wrong material": (
        one(f"polygon = {SQUARE}").replace('"grey"', '"gray"'),
        "surface[0].material",
        "did you mean 'grey'?",
    ),
    "no shape": (one(""), "surface[0]", "found no shape, expected exactly one of polygon"),
    "two shapes": (
        one(f"polygon = {SQUARE}\nbox = {{min=[0,0,0], max=[1,1,1]}}"),
        "surface[0]",
        "found polygon and box",
    ),
    "holes alone": (one(f"box = {{min=[0,0,0], max=[1,1,1]}}\nholes = [{SQUARE}]"), "surface[0].holes", "beside box"),
    "two points": (one("polygon = [[0,0,0],[1,0,0]]"), "surface[0].polygon", "3 or more points"),
    "flat point": (
        one("polygon = [[0,0,0],[1,0,0],[1,1]]"),
        "surface[0].polygon",
        "point 2: found [1, 1], expected three",
    ),
    "nan point": (one("polygon = [[0,0,0],[1,0,0],[1,nan,0]]"), "surface[0].polygon", "point 2: found nan"),
    "point too far": (one("polygon = [[0,0,0],[1,0,0],[1,1e99,0]]"), "surface[0].polygon", "point 2: found 1e+99"),
    "text point": (one("polygon = [[0,0,0],[1,0,0],['a',1,0]]"), "surface[0].polygon", "found 'a', expected a number"),
    "true point": (one("polygon = [[0,0,0],[1,0,0],[true,1,0]]"), "surface[0].polygon", "found True"),
    "non-planar": (one("polygon = [[0,0,0],[1,0,0],[1,1,0.5],[0,1,0]]"), "surface[0].polygon", "non-planar"),
    "zero area": (one("polygon = [[0,0,0],[1,0,0],[2,0,0]]"), "surface[0].polygon", "zero area"),
    "bow tie": (one("polygon = [[0,0,0],[2,2,0],[2,0,0],[0,1,0]]"), "surface[0].polygon", "cross themselves"),
    "pentagram": (
        one("polygon = [[0,1,0],[0.59,-0.81,0],[-0.95,0.31,0],[0.95,0.31,0],[-0.59,-0.81,0]]"),
        "surface[0].polygon",
        "cross themselves",
    ),
    "hole outside": (one(f"polygon = {SQUARE}\nholes = [[[2,0,0],[3,0,0],[2,1,0]]]"), "surface[0].polygon", "cross"),
    "hole across the rim": (
        one(f"polygon = {SQUARE}\nholes = [[[0.5,0.5,0],[3,0.5,0],[0.5,0.6,0]]]"),
        "surface[0].polygon",
        "cross",
    ),
    "hole off the plane": (
        one(f"polygon = {SQUARE}\nholes = [[[0.2,0.2,1],[0.3,0.2,1],[0.2,0.3,1]]]"),
        "surface[0].polygon",
        "non-planar",
    ),
    "second polygon": (one(f"polygons = [{SQUARE}, [[0,0,0],[1,0,0],[2,0,0]]]"), "surface[0].polygons[1]", "zero area"),
    "flat box": (one("box = {min=[0,0,0], max=[1,1,0]}"), "surface[0].box", "expected min < max"),
    "box without max": (one("box = {min=[0,0,0]}"), "surface[0].box.max", "found nothing"),
    "box side": (
        one("box = {min=[0,0,0], max=[1,1,1], omit=['z']}"),
        "surface[0].box.omit[0]",
        "found 'z', expected '-x'",
    ),
    "sphere radius": (one("sphere = {center=[0,0,0], radius=0}"), "surface[0].sphere.radius", "greater than 0"),
    "sphere facets": (
        one("sphere = {center=[0,0,0], radius=1, facet_error=0}"),
        "surface[0].sphere.facet_error",
        "0.0001 or more",
    ),
    "knot": (one("torus_knot = {p=2, q=4}"), "surface[0].torus_knot", "common factor"),
    "knot segments": (one("torus_knot = {segments=1000000}"), "surface[0].torus_knot.segments", "4096 or less"),
    "spline degree": (
        one("spline = {degree=[3,1], points=[[[0,0,0],[1,0,0]],[[0,1,0],[1,1,0]]]}"),
        "surface[0].spline",
        "degree 3 with 2 points in u",
    ),
    "spline rows": (
        one("spline = {degree=[1,1], points=[[[0,0,0],[1,0,0]],[[0,1,0],[1,1,0],[2,1,0]]]}"),
        "surface[0].spline.points",
        "rows of equal length",
    ),
    "spline weight": (
        one("spline = {degree=[1,1], points=[[[0,0,0],[1,0,0,0]],[[0,1,0],[1,1,0]]]}"),
        "surface[0].spline",
        "weight that is not > 0",
    ),
    "spline knots": (
        one("spline = {degree=[1,1], knots=[[0,0,1,1],[0,1,0,1]], points=[[[0,0,0],[1,0,0]],[[0,1,0],[1,1,0]]]}"),
        "surface[0].spline",
        "decrease",
    ),
    "spline flat": (
        one("spline = {degree=[1,1], points=[[[0,0,0],[1,0,0]],[[2,0,0],[3,0,0]]]}"),
        "surface[0].spline",
        "zero area",
    ),
    "mesh missing": (one("mesh = 'none.obj'"), "surface[0].mesh", "none.obj: cannot be read (No such file"),
    "mesh kind": (one("mesh = 'none.xyz'"), "surface[0].mesh", "expected one of .glb, .gltf, .obj"),
    "scale zero": (
        one(f"polygon = {SQUARE}\ntransform = [{{scale = [1, 0, 1]}}]"),
        "surface[0].transform[0].scale",
        "found 0",
    ),
    "empty step": (
        one(f"polygon = {SQUARE}\ntransform = [{{}}]"),
        "surface[0].transform[0]",
        "exactly one of translate",
    ),
    "no axis": (
        one(f"polygon = {SQUARE}\ntransform = [{{rotate = {{axis=[0,0,0], degrees=1}}}}]"),
        "surface[0].transform[0].rotate.axis",
        "length zero",
    ),
    "scaled away": (
        one(f"polygon = {SQUARE}\ntransform = [{{scale = 1e40}}, {{scale = 1e40}}]"),
        "surface[0]",
        "beyond 1e+60",
    ),
    "light type": (lit("type = 'neon'"), "light[0].type", "found 'neon', expected one of area, directional"),
    "light without type": (lit("position = [0,0,0]"), "light[0].type", "found nothing"),
    "light key": (
        lit("type = 'point'\nposition = [0,0,0]\npower = 1"),
        "light[0].power",
        "expected one of name, type, position",
    ),
    "light without intensity": (lit("type = 'point'\nposition = [0,0,0]"), "light[0].intensity", "found nothing"),
    "light direction": (
        lit("type = 'directional'\nirradiance = 1\ndirection = [0,0,0]"),
        "light[0].direction",
        "length zero",
    ),
    "light cone": (
        lit("type = 'spot'\nposition=[0,0,0]\nintensity=1\ndirection=[0,0,1]\ncone_deg=120"),
        "light[0].cone_deg",
        "90",
    ),
    "line of no length": (
        lit("type = 'linear'\nposition=[0,0,0]\nend=[0,0,0]\nintensity=1"),
        "light[0].end",
        "same point",
    ),
    "area twice": (
        lit(f"type = 'area'\npolygon={SQUARE}\nradiance=1\nexitance=1"),
        "light[0]",
        "exactly one of radiance and exitance",
    ),
    "area flat": (lit("type = 'area'\npolygon=[[0,0,0],[1,0,0],[2,0,0]]\nradiance=1"), "light[0].polygon", "zero area"),
    "light named as a surface": (
        lit("type = 'point'\nposition=[0,0,0]\nintensity=1").replace('"l"', '"s"'),
        "surface[0].name",
        "first at light[0]",
    ),
    "camera at its aim": (
        "schema = 1\n[camera]\neye=[1,1,1]\nlook_at=[1,1,1]\n" + one(f"polygon = {SQUARE}").removeprefix("schema = 1"),
        "camera.look_at",
        "same point as eye",
    ),
    "camera up": (
        "schema = 1\n[camera]\neye=[1,1,1]\nlook_at=[1,1,0]\n" + one(f"polygon = {SQUARE}").removeprefix("schema = 1"),
        "camera.up",
        "along the line of sight",
    ),
    "camera fov": ("schema = 1\n[camera]\neye=[1,1,1]\nlook_at=[1,1,0]\nfov=180", "camera.fov", "less than 180"),
    "camera width": (
        "schema = 1\n[camera]\neye=[1,1,1]\nlook_at=[1,1,0]\nwidth=1.5",
        "camera.width",
        "found 1.5, expected a whole number",
    ),
}


def one_line(error, path):
    text = str(error.value if hasattr(error, "value") else error)
    assert "\n" not in text
    assert len(text) < 500
    assert text.startswith(str(path))
    assert "Traceback" not in text
    assert "pydantic" not in text
    return text


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_one_line_with_its_key(tmp_path, name):
    text, key, words = FAULTS[name]
    path = tmp_path / "scene.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    message = one_line(caught, path)
    assert caught.value.key == key, message
    assert words in message


@pytest.mark.parametrize(
    ("data", "line", "words"),
    [
        (b"", None, "empty file"),
        (b" \n\n", None, "empty file"),
        (b"schema = 1\nname = \n", 2, "no valid TOML"),
        (b"schema = 1\n\n[[surface]\n", 3, "no valid TOML"),
        (b"schema = 1\nname = 'x'\nname = 'y'\n", 3, "no valid TOML"),
        (b"schema = 1\nname = 'open\n", 2, "no valid TOML"),
        (b"schema = 1\nname = [1,\n2", 3, "no valid TOML"),
        (b"schema = 1\nname = '\xff\xfe'\n", 2, "byte 0xff, expected UTF-8"),
        (bytes(range(256)) * 10, 2, "byte 0x80, expected UTF-8"),
        (b"schema = " + b"[" * 5000, None, "nested too deep"),
        (b"schema = " + b"9" * 5000, None, "no valid TOML"),
    ],
)
def test_what_is_no_toml_is_named_with_its_line(tmp_path, data, line, words):
    path = tmp_path / "scene.toml"
    path.write_bytes(data)
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    assert words in one_line(caught, path)
    if line is not None:
        assert caught.value.line == line


def test_missing_file_and_folder(tmp_path):
    for path, words in ((tmp_path / "none.toml", "No such file"), (tmp_path, "Is a directory")):
        with pytest.raises(SceneError) as caught:
            load_scene(path)
        assert words in one_line(caught, path)


# ---------------------------------------------------------------------------------------------
# Nothing but SceneError, whatever comes

NUMBERS = st.one_of(
    st.integers(-3, 3),
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([1e308, -1e308, 1e-320, 1e60, 10**400]),
)
VALUES = st.recursive(
    st.one_of(NUMBERS, st.booleans(), st.text(max_size=5), st.lists(NUMBERS, min_size=3, max_size=3)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.dictionaries(st.sampled_from(["min", "max", "axis", "p", "x"]), inner, max_size=3),
    ),
    max_leaves=8,
)

COMPLETE = {
    "schema": 1,
    "background": [0.0, 1.0],
    "camera": {"eye": [0, 0, 1], "look_at": [1, 1, 0], "up": [0, 0, 1], "fov": 45, "width": 8, "height": 8},
    "materials": {"m": {"reflectance": [0.5, 0.2], "emission": 1, "specular": 0.1, "exponent": 5, "ior": 1.2}},
    "surface": [
        {"name": "a", "material": "m", "polygon": [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
         "holes": [[[0.2, 0.2, 0], [0.3, 0.2, 0], [0.2, 0.3, 0]]],
         "transform": [
             {"translate": [1, 2, 3]}, {"rotate": {"axis": [0, 0, 1], "degrees": 30}}, {"scale": [1, 2, -3]}]},
        {"name": "b", "material": "m", "box": {"min": [0, 0, 0], "max": [1, 1, 1], "omit": ["-z"]}},
        {"name": "c", "material": "m", "sphere": {"center": [0, 0, 0], "radius": 1, "facet_error": 0.2}},
        {"name": "d", "material": "m", "torus_knot": {"p": 2, "q": 3, "segments": 5, "sides": 3}},
        {"name": "e", "material": "m", "spline": {
            "degree": [1, 1], "points": [[[0, 0, 0], [1, 0, 0]], [[0, 1, 0], [1, 1, 0, 2]]], "segments": [2, 2],
            "knots": [[0, 0, 1, 1], [0, 0, 1, 1]]}},
    ],
    "light": [
        {"name": "f", "type": "spot", "position": [0, 0, 1], "direction": [0, 0, -1], "intensity": 1},
        {"name": "g", "type": "area", "polygon": [[0, 0, 0], [1, 0, 0], [1, 1, 0]], "exitance": [1, 2]},
        {"name": "h", "type": "linear", "position": [0, 0, 0], "end": [1, 0, 0], "intensity": 1},
    ],
}  # fmt: skip


def to_toml(value):
    """Inline TOML of nested dicts and lists, enough for the tests."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{to_toml(str(key))} = {to_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(to_toml(item) for item in value) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + "".join(f"\\U{ord(c):08x}" for c in value) + '"'
    if isinstance(value, float):
        return "nan" if math.isnan(value) else ("inf" if value > 0 else "-inf") if math.isinf(value) else repr(value)
    return str(value)


def document(values):
    return "\n".join(f"{to_toml(key)} = {to_toml(item)}" for key, item in values.items())


def places(value, path=()):
    yield path
    if isinstance(value, (dict, list)):
        for key in list(value) if isinstance(value, dict) else range(len(value)):
            yield from places(value[key], (*path, key))


PLACES = [path for path in places(COMPLETE) if path]


def test_the_complete_scene_is_read(tmp_path):
    scene = scene_of(tmp_path, document(COMPLETE))
    assert len(scene.surfaces) == 6
    assert scene.bands == 2


@settings(max_examples=250, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(PLACES), VALUES)
def test_any_value_in_any_place_gives_a_scene_or_a_scene_error(tmp_path, place, value):
    values = copy.deepcopy(COMPLETE)
    inner = values
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    path = tmp_path / "scene.toml"
    path.write_text(document(values), encoding="utf-8")
    try:
        scene = load_scene(path)
    except SceneError as error:
        one_line(error, path)
    else:
        assert all(np.isfinite(surface.vertices).all() for surface in scene.surfaces)
        assert all(0 <= s.material.reflectance.min() <= s.material.reflectance.max() <= 1 for s in scene.surfaces)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 10_000), st.integers(0, 20), st.binary(max_size=6))
def test_any_damage_gives_a_scene_or_a_scene_error(tmp_path, start, length, junk):
    data = document(COMPLETE).encode()
    start %= len(data)
    path = tmp_path / "scene.toml"
    path.write_bytes(data[:start] + junk + data[start + length :])
    try:
        load_scene(path)
    except SceneError as error:
        one_line(error, path)
