"""The Radiance reader: primitives, seams, materials, commands, sky, views, errors; Radiance itself as the judge."""

import math
import os
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import workbench
from workbench.accel.embree import EmbreeAccelerator
from workbench.errors import SceneError
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import vector_area
from workbench.scene.rad import read_rad

ROOM = Path(__file__).resolve().parents[2] / ".." / "shared" / "scenes-external" / "radiance-room"
WHITE = "void plastic white 0 0 5 .7 .6 .5 0 0\n"
SQUARE = "white polygon square 0 0 12  0 0 0  1 0 0  1 1 0  0 1 0\n"


def read(tmp_path, text, name="a.rad"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return read_rad(path)


def areas(scene):
    return [[float(np.linalg.norm(vector_area(rings))) for rings in surface.faces()] for surface in scene.surfaces]


def test_primitives_have_their_sizes_and_fronts(tmp_path):
    scene = read(tmp_path, WHITE + SQUARE + (
        "# a comment\nwhite sphere ball 0 0 4 1 2 3 .5 white bubble hollow 0 0 4 1 2 3 .5\n"
        "white cylinder pole 0 0 7 0 0 0 0 0 2 .25\nwhite tube pipe 0 0 7 0 0 0 0 0 2 .25\n"
        "white cone tip 0 0 8 0 0 0 0 0 2 1 0\nwhite ring disk 0 0 8 0 0 5 0 0 -2 0 1\n"
        "white ring annulus 0 0 8 0 0 5 0 0 1 1 .5\n"
    ))  # fmt: skip
    assert [s.name for s in scene.surfaces] == ["square", "ball", "hollow", "pole", "pipe", "tip", "disk", "annulus"]
    total = [sum(found) for found in areas(scene)]
    exact = [1, math.pi, math.pi, math.pi, math.pi, math.pi * math.sqrt(5), math.pi, 0.75 * math.pi]
    np.testing.assert_allclose(total, exact, rtol=0.01)
    np.testing.assert_allclose(total[-2:], exact[-2:], rtol=1e-12)  # rings keep their area
    disk = scene.surfaces[6].face(0)
    assert vector_area(disk) @ [0, 0, 1] < 0
    for name, outward in (("ball", 1), ("hollow", -1), ("pole", 1), ("pipe", -1)):
        surface = next(s for s in scene.surfaces if s.name == name)
        middle = np.array([1, 2, 3.0]) if surface.sphere else np.array([0, 0, 1.0])
        for rings in surface.faces():
            away = rings[0].mean(axis=0) - middle
            if surface.sphere is None:
                away[2] = 0
            assert outward * (vector_area(rings) @ away) > 0
    assert "facets" in scene.notes[0]


def test_materials(tmp_path):
    scene = read(tmp_path, (
        "void plastic p 0 0 5 .5 .4 .3 .1 .2 void metal m 0 0 5 .5 .4 .3 .9 0 void trans t 0 0 7 .8 .8 .8 0 0 .5 .25\n"
        "void glass g 0 0 3 .96 .96 .96 void mirror r 0 0 3 .9 .8 .7 void light l 0 0 3 10 20 30\n"
        "void glow w 0 0 4 1 2 3 0 void dielectric d 0 0 5 1 1 1 1.5 0 void alias q p\n"
        "void colorfunc pattern 2 a b 0 0 pattern plastic patterned 0 0 5 .2 .2 .2 0 0\n"
    ) + "".join(
        f"{m} polygon {m} 0 0 9 0 0 {i} 1 0 {i} 0 1 {i}\n" for i, m in enumerate([*"pmtgrlwdq", "patterned"])
    ))  # fmt: skip
    found = {surface.name: surface.material for surface in scene.surfaces}
    np.testing.assert_allclose(found["p"].reflectance, [0.45, 0.36, 0.27])
    np.testing.assert_allclose([*found["p"].specular, found["p"].exponent], [0.1, 0.1, 0.1, 48])
    np.testing.assert_allclose(found["m"].specular, [0.45, 0.36, 0.27])
    np.testing.assert_allclose([found["t"].reflectance[0], found["t"].transmittance[0]], [0.4, 0.1])
    # A single pane of transmissivity 0.96 passes 0.88 (Radiance's own example of clear glass).
    np.testing.assert_allclose(found["g"].transmittance, 0.88, atol=0.002)
    # Its manual's inverse of that law, from transmittance to transmissivity.
    passed = found["g"].transmittance[0]
    assert (math.sqrt(0.8402528435 + 0.0072522239 * passed**2) - 0.9166530661) / 0.0036261119 / passed == (
        pytest.approx(0.96, abs=1e-6)
    )
    assert found["g"].two_sided and found["p"].two_sided and not found["l"].two_sided
    np.testing.assert_allclose(found["r"].specular, [0.9, 0.8, 0.7])
    np.testing.assert_allclose(found["l"].emission, np.pi * np.array([10, 20, 30]))
    np.testing.assert_allclose(found["w"].emission, np.pi * np.array([1, 2, 3]))
    assert found["d"].ior == 1.5 and found["d"].transmittance[0] == pytest.approx(0.96)
    np.testing.assert_array_equal(found["q"].reflectance, found["p"].reflectance)
    assert any("patterns and textures" in note for note in scene.notes)
    assert any("scatters" in note for note in scene.notes)


@pytest.mark.parametrize("turned", [False, True])
def test_seams_become_holes(tmp_path, turned):
    hole = [(1, 1, 0), (1, 2, 0), (2, 2, 0), (2, 1, 0)]
    if turned:  # Radiance counts even and odd: a hole may run the same way as what surrounds it
        hole = [hole[0], *hole[:0:-1]]
    ring = [(0, 0, 0), *hole, hole[0], (0, 0, 0), (4, 0, 0), (4, 4, 0), (0, 4, 0)]
    text = f"white polygon wall 0 0 {3 * len(ring)} " + " ".join(f"{x} {y} {z}" for x, y, z in ring)
    scene = read(tmp_path, WHITE + text)
    (rings,) = scene.surfaces[0].faces()
    assert [len(r) for r in rings] == [4, 4]
    assert vector_area(rings)[2] == pytest.approx(15.0)
    hits = EmbreeAccelerator(Geometry.from_scene(scene)).occluded(
        np.array([[1.5, 1.5, 1], [3.0, 3.0, 1]]), np.array([[0, 0, -1.0]] * 2), np.full(2, 2.0)
    )
    assert hits.tolist() == [False, True]


def test_two_holes_and_an_island(tmp_path):
    # Outer 10 x 10; a hole 1..5 that holds an island 2..4, and a hole 6..8, all joined by seams.
    def square(a, b, back=False):
        ring = [(a, a), (b, a), (b, b), (a, b)]
        return [ring[0], *ring[:0:-1]] if back else ring

    island = [*square(2, 4), (2, 2)]
    first = [(1, 1), *island, *square(1, 5, back=True), (1, 1)]
    ring = [(0, 0), *first, (0, 0), (10, 0), (10, 10), *square(8, 9, back=True), (8, 8), (10, 10), (0, 10)]
    text = f"white polygon wall 0 0 {3 * len(ring)} " + " ".join(f"{x} {y} 0" for x, y in ring)
    (surface,) = read(tmp_path, WHITE + text).surfaces
    assert sum(vector_area(rings)[2] for rings in surface.faces()) == pytest.approx(100 - 16 + 4 - 1)
    assert sorted(len(rings) for rings in surface.faces()) == [1, 3]


def test_xform_arrays_iterations_mirrors_and_names(tmp_path):
    (tmp_path / "part.rad").write_text(SQUARE + "white sphere ball 0 0 4 0 0 0 1\n", encoding="utf-8")
    scene = read(tmp_path, WHITE + (
        "void plastic other 0 0 5 .1 .1 .1 0 0\n"
        "!xform -n row -a 2 -t 3 0 0 -a 2 -t 0 5 0 -i 1 -rz 90 part.rad\n"
        "!xform -m other -mx \\\n -t 0 0 7 ./part.rad  # mirrored\n!xform -n many -i 3 -t 1 0 0 part.rad\n"
    ))  # fmt: skip
    middle = {s.name: s.vertices.mean(axis=0) for s in scene.surfaces}
    for name, at in {
        "row.0.0.ball": [0, 0, 0], "row.1.0.ball": [0, 3, 0], "row.0.1.ball": [-5, 0, 0], "row.1.1.ball": [-5, 3, 0],
        "ball": [0, 0, 7], "many.ball": [3, 0, 0],
    }.items():  # fmt: skip
        np.testing.assert_allclose(middle[name], at, atol=1e-12)
    mirrored = next(s for s in scene.surfaces if s.name == "square")
    assert mirrored.material.name == "other"
    assert mirrored.vertices[:, 0].min() == -1 and vector_area(mirrored.face(0))[2] == pytest.approx(1.0)


def test_same_names_join_and_others_get_numbers(tmp_path):
    moved = SQUARE.replace("0 0 0  1 0 0  1 1 0  0 1 0", "0 0 1  1 0 1  1 1 1  0 1 1")
    scene = read(tmp_path, WHITE + SQUARE + moved + "white sphere s 0 0 4 0 0 0 1\n" + SQUARE)
    assert [(s.name, s.face_count) for s in scene.surfaces if s.sphere is None] == [("square", 2), ("square.2", 1)]


def test_genbox(tmp_path):
    scene = read(tmp_path, WHITE + "!genbox white b 1 2 3\n!genbox white room 4 4 4 -i\n")
    assert sum(sum(found) for found in areas(scene)) == pytest.approx(22 + 96)
    out = [s.face(0) for s in scene.surfaces[:6]]
    assert all(vector_area(rings) @ (rings[0].mean(axis=0) - [0.5, 1, 1.5]) > 0 for rings in out)
    inside = [s.face(0) for s in scene.surfaces[6:]]
    assert all(vector_area(rings) @ (rings[0].mean(axis=0) - [2, 2, 2]) < 0 for rings in inside)


def test_flat_and_crooked_polygons(tmp_path):
    scene = read(tmp_path, WHITE + (
        "white polygon line 0 0 9 0 0 0 1 0 0 2 0 0\nwhite polygon bent 0 0 12 0 0 0 1 0 0 1 1 .5 0 1 0\n"
    ))  # fmt: skip
    assert [(s.name, s.face_count) for s in scene.surfaces] == [("bent", 2)]
    assert any("without area" in note for note in scene.notes) and any("not planar" in note for note in scene.notes)


def test_sun_sky_and_ground(tmp_path):
    sky = (
        "void light sun 0 0 3 1e6 1e6 2e6 sun source sun 0 0 4 0 -1 1 .533\n"
        "void brightfunc skyfunc 2 skybr skybright.cal 0 3 2 9 1.4\n"
        "skyfunc glow sky 0 0 4 1 1 .5 0 sky source sky 0 0 4 0 0 1 180\n"
        "skyfunc glow ground 0 0 4 1 1 1 0 ground source ground 0 0 4 0 0 -1 180\n"
    )
    scene = read(tmp_path, sky + WHITE + SQUARE)
    (sun,) = scene.lights
    solid = math.pi * math.radians(0.533 / 2) ** 2
    np.testing.assert_allclose(sun.power, np.array([1, 1, 2]) * 1e6 * solid, rtol=1e-4)
    np.testing.assert_allclose(sun.direction, [0, math.sqrt(0.5), -math.sqrt(0.5)])
    assert scene.sky.kind == "overcast"
    np.testing.assert_allclose(scene.sky.zenith_radiance, [9, 9, 4.5])
    # The ground's radiance is 1.4: reflectance x horizontal irradiance (7/9 pi Lz) / pi.
    np.testing.assert_allclose(scene.sky.ground_reflectance * 7 / 9 * scene.sky.zenith_radiance, 1.4)
    everywhere = read(tmp_path, "void glow g 0 0 4 2 2 2 0 g source s 0 0 4 0 0 1 360\n" + WHITE + SQUARE)
    assert everywhere.sky is None and everywhere.background.tolist() == [2, 2, 2]


def test_materials_beside_views_and_mesh_of_toml(tmp_path):
    (tmp_path / "materials.rad").write_text(WHITE, encoding="utf-8")
    (tmp_path / "views").mkdir()
    view = "rvu -vtv -vp 0 0 5 -vd 0 0 -1 -vu 0 1 0 -vh 60 -vv 30 -vo 0 -va 0\n"
    (tmp_path / "views" / "top.vf").write_text(view, encoding="utf-8")
    (tmp_path / "fish.vf").write_text(view.replace("-vtv", "-vth"), encoding="utf-8")
    scene = read(tmp_path, SQUARE)
    assert any("materials.rad" in note for note in scene.notes) and any("views" in note for note in scene.notes)
    assert list(scene.cameras) == ["top"]
    assert (scene.camera.fov_deg, scene.camera.width) == (30, 512)
    assert scene.camera.height == round(512 * math.tan(math.radians(15)) / math.tan(math.radians(30)))
    assert workbench.load(tmp_path / "a.rad").has_emitter  # lit, as a mesh would be
    toml = tmp_path / "scene.toml"
    toml.write_text(
        'schema = 1\n[sky]\ntype = "overcast"\nhorizontal_irradiance = 1.0\n'
        '[[surface]]\nname = "room"\nmesh = "a.rad"\n',
        encoding="utf-8",
    )
    assert [s.material.name for s in workbench.load(toml).surfaces] == ["white"]


BROKEN = [
    (SQUARE, 1, "'white'"),
    (WHITE + SQUARE.replace("12", "13"), 2, "real argument 13"),
    (WHITE + SQUARE.replace("12", "11"), 2, "11 real arguments"),
    (WHITE + SQUARE.replace("12", "x"), 2, "'x'"),
    (WHITE.replace(".7", "1.7") + SQUARE, 1, "1.7"),
    (WHITE.replace(".7", "nan") + SQUARE, 1, "'nan'"),
    (WHITE + "white instance i 1 a.oct 0 0\n", 2, "'instance'"),
    ("void antimatter white 1 void 0 0\n" + SQUARE, 1, "'antimatter'"),
    (WHITE + "white sphere s 0 0 4 0 0 0 0\n", 2, "radius"),
    (WHITE + "white polygon p 0 0 12 0 0 0 2 2 0 2 0 0 0 1 0\n", 2, "cross"),
    (WHITE + "!gensky 6 21 12 -c\n", 2, "no command is run"),
    (WHITE + "!xform a.rad | sed s/a/b/\n", 2, "no command is run"),
    (WHITE + "!xform nowhere.rad\n", 2, "nowhere.rad"),
    (WHITE + "!xform -q 2 a.rad\n", 2, "'-q'"),
    (WHITE + "!xform -a 1000 -t 1 0 0 -a 1000 -t 0 1 0 a.rad\n", 2, "copies"),
    (WHITE + "!xform a.rad\n", 2, "deep"),
    (WHITE + "!genbox white b 1 2\n", 2, "genbox"),
    (WHITE, None, "no surface"),
    (WHITE + SQUARE + "white source s 0 0 4 0 0 1 90\n", 3, "angle 90"),
]


@pytest.mark.parametrize(("text", "line", "word"), BROKEN)
def test_broken_files_say_where(tmp_path, text, line, word):
    with pytest.raises(SceneError) as caught:
        read(tmp_path, text)
    message = str(caught.value)
    assert word in message and "\n" not in message and "a.rad" in message
    if line is not None:
        assert re.search(rf"line {line}\b", message)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 400), st.binary(max_size=8))
def test_cut_and_soiled_files_end_in_one_line(tmp_path, at, dirt):
    text = (WHITE + SQUARE + "!xform -t 1 0 0 b.rad\nvoid glow g 0 0 4 1 1 1 0\ng source s 0 0 4 0 0 1 180\n").encode()
    (tmp_path / "b.rad").write_text(SQUARE, encoding="utf-8")
    (tmp_path / "a.rad").write_bytes(text[:at] + dirt + text[at + 3 :])
    try:
        read_rad(tmp_path / "a.rad")
    except SceneError as error:
        assert "\n" not in str(error)


JUDGED = """
void plastic white 0 0 5 .7 .6 .5 0 0
white cylinder pole 0 0 7 0 0 0 1 2 3 .4
white cone cut 0 0 8 3 0 0 3 1 2 .2 .7
white ring annulus 0 0 8 -2 0 1 1 1 1 .5 1.2
white polygon wall 0 0 30 -4 -4 -1  -1 -3 -1  -1 -1 -1  1 -1 -1  1 -3 -1  -1 -3 -1  -4 -4 -1  -4 4 -1  4 4 -1  4 -4 -1
!xform -rx 20 -a 3 -t 0 0 1.5 -rz 30 -i 1 -s .5 -t 0 0 4 part.rad
!genbox white b .5 .6 .7
"""


def test_radiance_hits_what_we_hit(tmp_path):
    """Distances along 4,000 rays by ``rtrace`` and by Embree in what the reader made of the same files."""
    pyradiance = pytest.importorskip("pyradiance", reason="pyradiance, of the peers extra, is not installed")
    part = "white polygon t 0 0 9 0 0 0 1 0 0 0 1 0\nwhite polygon u 0 0 12 1 1 0 2 1 0 2 2 1 1 2 1\n"
    (tmp_path / "part.rad").write_text(part, encoding="utf-8")
    text = JUDGED
    scene = read(tmp_path, text)
    (tmp_path / "flat.rad").write_text(_expanded(pyradiance, tmp_path, text), encoding="utf-8")
    octree = tmp_path / "a.oct"
    octree.write_bytes(pyradiance.oconv(tmp_path / "flat.rad", warning=False))
    rng = np.random.default_rng(3)
    origin = rng.normal(size=(4000, 3))
    origin *= 9 / np.linalg.norm(origin, axis=1)[:, None]
    toward = rng.uniform(-3, 3, (4000, 3)) - origin
    toward /= np.linalg.norm(toward, axis=1)[:, None]
    rays = np.column_stack([origin, toward]).astype("<f8")
    got = pyradiance.rtrace(
        rays.tobytes(), octree, header=False, inform="d", outform="d", outspec="L", params=["-ab", "0"]
    )
    theirs = np.frombuffer(got, "<f8")
    ours = EmbreeAccelerator(Geometry.from_scene(scene)).closest_hit(origin, toward).t
    theirs = np.where(theirs > 1e9, np.inf, theirs)
    same = np.isclose(ours, theirs, atol=0.02)  # facets of the round ones
    assert same.mean() > 0.99
    flat = np.isclose(ours, theirs, atol=1e-4)
    assert flat.mean() > 0.8


def _expanded(pyradiance, folder, text):
    """The text with its commands run by Radiance's own programs."""
    programs = Path(pyradiance.__file__).parent / "bin"
    lines = []
    for line in text.splitlines():
        if not line.startswith("!"):
            lines.append(line)
            continue
        environment = os.environ | {"PATH": f"{programs}:{os.environ['PATH']}"}
        ran = subprocess.run(
            ["sh", "-c", line[1:]], cwd=folder, env=environment, capture_output=True, text=True, check=True
        )
        lines.append(ran.stdout)
    return "\n".join(lines)


def test_the_external_room(tmp_path):
    if not ROOM.exists():
        pytest.skip("the external scenes are not here")
    scene = read_rad(ROOM / "room.rad")
    assert len(scene.surfaces) == 18 and set(scene.cameras) == {"east", "external"}
    holed = [s.name for s in scene.surfaces if len(s.face(0)) == 2]
    assert holed == ["f_5_0", "f_19_0"]
    # The closed enclosure of SOURCES.md without its window: 148.644864 m2 less the glazing.
    names = {"f_3_0", "f_4_0", "f_10_0", "f_12_0", "f_13_0", "f_15_0", "f_17_0"}
    inside = sum(sum(a) for s, a in zip(scene.surfaces, areas(scene), strict=True) if s.name in names)
    assert inside + 6.096 * (2.4384 - 0.9144) == pytest.approx(148.644864, abs=1e-5)
