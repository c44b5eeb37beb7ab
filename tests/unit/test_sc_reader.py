"""The reader of .sc files: meaning, bounds, errors, and what it makes of them for radiosity."""

import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from workbench.errors import SceneError
from workbench.geometry.polygons import vector_area
from workbench.render.camera import PinholeRays
from workbench.scene.sc import ScPolygon, ScSphere, load_scene, read_sc

ROOT = Path(__file__).resolve().parents[2]
OWN = ROOT / "scenes" / "sc"
SHARED = ROOT / ".." / "shared" / "sc-format"
SQUARE = "polygon 4  0 0 0  1 0 0  1 1 0  0 1 0\n"


def read(tmp_path, *texts):
    paths = []
    for index, text in enumerate(texts):
        paths.append(tmp_path / f"part{index}.sc")
        paths[-1].write_bytes(text.encode())
    return read_sc(paths)


def same(one, two):
    """Whether two scenes say the same, the names of their files aside."""
    assert (one.width, one.height, one.fov_deg) == (two.width, two.height, two.fov_deg)
    for name in ("world_to_eye", "background", "ambient"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    for name in ("lights", "materials", "primitives", "groups"):
        first, second = getattr(one, name), getattr(two, name)
        assert len(first) == len(second)
        for a, b in zip(first, second, strict=True):
            assert type(a) is type(b)
            for key in vars(a):
                if key != "line":
                    np.testing.assert_array_equal(getattr(a, key), getattr(b, key))


def test_state_of_an_empty_world(tmp_path):
    scene = read(tmp_path, "world")
    assert (scene.width, scene.height, scene.fov_deg) == (512, 512, 45.0)
    assert not scene.background.any() and not scene.ambient.any()
    np.testing.assert_array_equal(scene.world_to_eye, np.eye(4))
    assert scene.primitives == scene.groups == scene.lights == ()
    plain = scene.materials[0]
    assert (plain.kdr, plain.ksr, plain.e, plain.ktr, plain.eta) == (1, 0, 1, 0, 1)
    assert plain.color.tolist() == [1, 1, 1] and plain.emission.tolist() == [0, 0, 0]


@pytest.mark.parametrize("folder", [OWN, SHARED], ids=["own", "shared"])
def test_min_is_its_two_halves(folder):
    if not folder.is_dir():
        pytest.skip(f"{folder} is not here")
    whole = read_sc(folder / "min.sc")
    assert len(whole.primitives) == 2
    same(whole, read_sc([folder / "min.cam.sc", folder / "min.nocam.sc"]))


@pytest.mark.parametrize("folder", [OWN, SHARED], ids=["own", "shared"])
def test_room_has_the_assignment_s_count(folder):
    if not folder.is_dir():
        pytest.skip(f"{folder} is not here")
    scene = read_sc(folder / "room.sc")
    assert len(scene.primitives) == 2457
    assert any(isinstance(p, ScSphere) for p in scene.primitives)


def test_shared_files_differ_from_ours():
    if not SHARED.is_dir():
        pytest.skip(f"{SHARED} is not here")
    for path in SHARED.glob("*.sc"):
        assert path.read_text() != (OWN / path.name).read_text()


def test_make_room_writes_the_room_that_is_here(tmp_path):
    script = tmp_path / "make_room.py"
    script.write_text((OWN / "make_room.py").read_text())
    subprocess.run([sys.executable, str(script)], check=True)
    assert (tmp_path / "room.sc").read_text() == (OWN / "room.sc").read_text()


def test_table_bears_a_dodecahedron():
    """Twelve pentagons, 30 edges of one length each walked once both ways, normals outward."""
    scene = read_sc(OWN / "table.sc")
    faces = [p.vertices for p in scene.primitives if isinstance(p, ScPolygon) and len(p.vertices) == 5]
    assert len(faces) == 12
    corners = np.concatenate(faces)
    center = corners.mean(axis=0)
    edges = set()
    for face in faces:
        assert vector_area(face) @ (face.mean(axis=0) - center) > 0
        for a, b in zip(face, np.roll(face, -1, axis=0), strict=True):
            edges.add((tuple(np.round(a, 5)), tuple(np.round(b, 5))))
            assert np.linalg.norm(a - b) == pytest.approx(0.4796, abs=1e-6)
    assert len(edges) == 60
    assert all((b, a) in edges for a, b in edges)
    # It stands on the table top.
    assert corners[:, 1].min() == pytest.approx(1.0, abs=1e-4)


def test_the_transformation_written_last_acts_first(tmp_path):
    scene = read(tmp_path, f"world trans 1 0 0 rot z 90 scale 2 3 4 {SQUARE}")
    # (1, 0, 0): scaled to (2, 0, 0), turned to (0, 2, 0), moved to (1, 2, 0).
    np.testing.assert_allclose(scene.primitives[0].vertices, [[1, 0, 0], [1, 2, 0], [-2, 2, 0], [-2, 0, 0]], atol=1e-15)


@pytest.mark.parametrize(("axis", "given", "wanted"), [("x", (0, 1, 0), (0, 0, 1)), ("y", (0, 0, 1), (1, 0, 0)),
                                                       ("z", (1, 0, 0), (0, 1, 0))])  # fmt: skip
@pytest.mark.parametrize("degrees", [90, 30, -50])
def test_rotations_follow_the_right_hand(tmp_path, axis, given, wanted, degrees):
    scene = read(tmp_path, f"world rot {axis} {degrees} sphere {given[0]} {given[1]} {given[2]} 1")
    angle = math.radians(degrees)
    np.testing.assert_allclose(
        scene.primitives[0].center, math.cos(angle) * np.array(given) + math.sin(angle) * np.array(wanted), atol=1e-15
    )


def test_world_to_screen(tmp_path):
    """Eye at (0, 0, 5) looking down -z, 90 degrees high: at distance 5 the picture is 10 high, 20 wide."""
    scene = read(tmp_path, "size 40 20 persp 90 lookat 0 0 5  0 0 0  0 1 0 world")
    for point, pixel in [((0, 0, 0), (20, 10)), ((10, 5, 0), (40, 0)), ((-10, -5, 0), (0, 20)), ((1, 2, 3), (25, 0))]:
        xw, yw, zw, w = scene.world_to_screen @ [*point, 1]
        assert w == pytest.approx(5 - point[2])
        assert (xw / w, yw / w) == pytest.approx(pixel)
        assert zw / w == pytest.approx(1 - 1 / w)


def test_camera_transformations_multiply_in(tmp_path):
    """A turn about z written before lookat acts after it: it turns the picture."""
    plain = read(tmp_path, "lookat 1 2 3  0 0 0  0 1 0 world").world_to_eye
    turned = read(tmp_path, "rot z 90 lookat 1 2 3  0 0 0  0 1 0 world").world_to_eye
    quarter = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(turned @ [3, 1, 2, 1], quarter @ plain @ [3, 1, 2, 1], atol=1e-14)


def test_push_saves_matrix_and_material(tmp_path):
    scene = read(
        tmp_path,
        f"""world material a {{ kdr .5 }} material b {{ }} use a trans 1 0 0
        push trans 0 1 0 use b {SQUARE} pop {SQUARE}""",
    )
    inside, after = scene.primitives
    assert inside.vertices[0].tolist() == [1, 1, 0] and after.vertices[0].tolist() == [1, 0, 0]
    assert [scene.materials[p.material].name for p in (inside, after)] == ["b", "a"]
    assert (inside.group, after.group) == (0, -1)


def test_state_runs_on_from_file_to_file(tmp_path):
    scene = read(
        tmp_path, "size 8 4 world material a { ksr .25 } use a trans 1 2 3", "ambient .1 .2 .3", "sphere 0 0 0 1"
    )
    assert scene.primitives[0].center.tolist() == [1, 2, 3]
    assert scene.materials[scene.primitives[0].material].ksr == 0.25
    assert scene.ambient.tolist() == [0.1, 0.2, 0.3]


def test_a_material_defined_again_serves_later_uses_only(tmp_path):
    ball = "sphere 0 0 0 1"
    scene = read(tmp_path, f"world material a {{ kdr .1 }} use a {ball} material a {{ kdr .2 }} {ball} use a {ball}")
    assert [scene.materials[p.material].kdr for p in scene.primitives] == [0.1, 0.1, 0.2]


def test_lights_are_moved_by_the_matrix(tmp_path):
    scene = read(tmp_path, "world push trans 0 1 0 scale 2 2 2 light 1 1 1  .1 .2 .3 pop")
    assert scene.lights[0].position.tolist() == [2, 3, 2]
    assert scene.lights[0].radiance.tolist() == [0.1, 0.2, 0.3]


def test_layout_comments_and_number_forms_do_not_matter(tmp_path):
    plain = read(tmp_path, "size 4 3\nworld\nmaterial m { color 1 .5 0 }\nuse m\nsphere 1 -.5 .002 3\n")
    odd = read(
        tmp_path,
        "\ufeffsize 4 3 # a comment\r\nworld\r\n#use nothing\r\nmaterial m{color 1. 5.e-1 +0}use m # {\r\n"
        "sphere\t1\n-.5\n2.E-3 3#end",
    )
    same(plain, odd)


def test_reflection_keeps_fronts_and_spheres(tmp_path):
    scene = read(tmp_path, f"world scale -2 2 2 {SQUARE} sphere 1 0 0 1.5")
    square, sphere = scene.primitives
    # The front of the square looks along +z before and after a mirror in x.
    assert vector_area(square.vertices)[2] == pytest.approx(4)
    assert sphere.center.tolist() == [-2, 0, 0] and sphere.radius == pytest.approx(3)


def test_tree_of_groups(tmp_path):
    scene = read(
        tmp_path,
        f"""world {SQUARE}
        push push pop
          {SQUARE}
          push trans 5 0 0 {SQUARE} {SQUARE} pop
          push trans 0 7 0 {SQUARE} pop
        pop
        push sphere 0 0 9 1 pop""",
    )
    rows = [(g.parent, g.first_primitive, g.end_primitive, g.end_group) for g in scene.groups]
    assert rows == [(-1, 1, 5, 3), (0, 2, 4, 2), (0, 4, 5, 3), (-1, 5, 6, 4)]
    assert [p.group for p in scene.primitives] == [-1, 0, 1, 1, 2, 3]
    np.testing.assert_array_equal(scene.groups[0].bbox, [[0, 0, 0], [6, 8, 0]])
    np.testing.assert_array_equal(scene.groups[3].bbox, [[-1, -1, 8], [1, 1, 10]])
    assert scene.groups[3].bsphere_radius == 1


numbers = st.floats(-3, 3).map(lambda v: round(v, 3))


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(numbers, numbers, numbers), min_size=4, max_size=8),
       st.lists(st.floats(0.05, 4).map(lambda v: round(v, 3)), min_size=3, max_size=3))  # fmt: skip
def test_bounds_enclose_under_non_uniform_scales(tmp_path_factory, moves, scale):
    """Failure mode 4.12: a bound carried along with the matrix would not enclose; ours is from the points."""
    text, depth = "world\n", 0
    for index, (x, y, z) in enumerate(moves):
        text += f"push trans {x} {y} {z} rot {'xyz'[index % 3]} {40 * x} sphere {y} {z} {x} {abs(x) + 0.1}\n"
        depth += 1
    text += f"scale {scale[0]} {scale[1]} {scale[2]} rot y 30 {SQUARE}" + "pop " * depth
    scene = read(tmp_path_factory.mktemp("sc"), text)
    assert len(scene.groups) == len(moves)
    for group in scene.groups:
        reaches = []
        for p in scene.primitives[group.first_primitive : group.end_primitive]:
            points, radius = (p.center[None], p.radius) if isinstance(p, ScSphere) else (p.vertices, 0.0)
            assert (points - radius >= group.bbox[0] - 1e-12).all() and (points + radius <= group.bbox[1] + 1e-12).all()
            reaches.append((np.linalg.norm(points - group.bsphere_center, axis=1) + radius).max())
        # Enclosing, and no larger than it must be about its centre.
        assert max(reaches) == pytest.approx(group.bsphere_radius, rel=1e-12)


def test_concave_polygons_are_polygons(tmp_path):
    scene = read(tmp_path, "world polygon 5  0 0 0  2 0 0  2 2 0  1 .5 0  0 2 0")
    assert len(scene.primitives[0].vertices) == 5


BROKEN = [
    ("wrold", 1, "'wrold'"),
    ("World", 1, "'World'"),
    ("size 10", 1, "ends"),
    ("size 10 -4", 1, "'-4'"),
    ("size 1e2 4", 1, "whole number"),
    ("size 99999 4", 1, "8192"),
    ("size 10 10\npersp 180 world", 2, "'180'"),
    ("persp 1e999", 1, "number"),
    ("persp inf", 1, "'inf'"),
    ("ambient nan 0 0", 1, "'nan'"),
    ("ambient 0 0 0x10", 1, "'0x10'"),
    ("ambient 0 -1 0", 1, "from 0"),
    ("background 1 1 ٣", 1, "number"),
    ("lookat 0 0 0  0 0 0  0 1 0", 1, "same point"),
    ("lookat 0 0 0  0 1 0  0 2 0", 1, "up vector"),
    ("\n\nscale 1 0 1\nworld", 4, "inverted"),
    ("sphere 0 0 0 1", 1, "before 'world'"),
    ("push", 1, "before 'world'"),
    ("world\nsize 4 4", 2, "after 'world'"),
    ("world\npersp 20", 2, "after 'world'"),
    ("world\nworld", 2, "second 'world'"),
    ("world\npush\npush\npop\n", 2, "without its 'pop'"),
    ("world\npush\npop\npop\n", 4, "without its 'push'"),
    ("world\nuse clay", 2, "'clay'"),
    ("world\nmaterial { kdr 1 }", 2, "name"),
    ("world\nmaterial a kdr 1", 2, "'{'"),
    ("world\nmaterial a {\nkdr 1\n", 2, "closes"),
    ("world\nmaterial a {\nkd 1 }", 3, "'kd'"),
    ("world\nmaterial a {\ncolor 1 1 }", 3, "'}'"),
    ("world\nmaterial a { ksr -.5 }", 2, "ksr"),
    ("world\nmaterial a { eta 0 }", 2, "eta"),
    ("world\nlight 1 2 3", 2, "ends"),
    ("world\nrot w 30", 2, "'w'"),
    ("world\nrot x", 2, "ends"),
    ("world\nsphere 0 0 0 0", 2, "radius"),
    ("world\nsphere 0 0 0 -2", 2, "radius"),
    ("world\nscale 1 2 1\nsphere 0 0 0 1", 3, "similarity"),
    ("world\nscale 0 0 0\nsphere 0 0 0 1", 3, "similarity"),
    ("world\npolygon 2  0 0 0  1 0 0", 2, "vertices"),
    ("world\npolygon 4  0 0 0  1 0 0  1 1 0", 2, "ends"),
    ("world\npolygon 4  0 0 0  1 0 0  1 1 .2\n 0 1 0", 2, "non-planar"),
    ("world\npolygon 3  0 0 0  1 1 1  2 2 2", 2, "zero area"),
    ("world\npolygon 5  0 0 0  4 0 0  4 2 0  1 -1 0  0 2 0", 2, "cross"),
    ("world\nscale 1e60 1 1\nscale 1e60 1 1\n" + SQUARE, 4, "beyond"),
    ("world\nscale 1e-200 1e-200 1e-200\n" + SQUARE, 3, "zero area"),
    ("world\n\x00", 2, "expected one of"),
    ("world } ", 1, "'}'"),
    ("world\n" + "x" * 5000, 2, "..."),
]


@pytest.mark.parametrize(("text", "line", "part"), BROKEN, ids=range(len(BROKEN)))
def test_errors_name_file_and_line(tmp_path, text, line, part):
    path = tmp_path / "broken.sc"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SceneError) as caught:
        read_sc(path)
    message = str(caught.value)
    assert message.startswith(f"{path}, line {line}: ") and part in message
    assert "\n" not in message and len(message) < 400


def test_errors_of_whole_files(tmp_path):
    with pytest.raises(SceneError, match=r"none\.sc: cannot be read"):
        read_sc(tmp_path / "none.sc")
    with pytest.raises(SceneError, match="cannot be read"):
        read_sc(tmp_path)
    with pytest.raises(SceneError, match="no scene file"):
        read_sc([])
    (tmp_path / "empty.sc").write_text("")
    with pytest.raises(SceneError, match=r"empty\.sc: found no 'world'"):
        read_sc(tmp_path / "empty.sc")
    (tmp_path / "latin.sc").write_bytes(b"size 4 4\n# caf\xe9\n")
    with pytest.raises(SceneError, match=r"latin.sc, line 2: found the byte 0xe9"):
        read_sc(tmp_path / "latin.sc")


def test_each_file_balances_on_its_own(tmp_path):
    with pytest.raises(SceneError, match=r"part0.sc, line 2: found a 'push'"):
        read(tmp_path, "world\npush\n", "pop")


WORDS = [
    "size", "background", "ambient", "persp", "lookat", "world", "push", "pop", "trans", "scale", "rot", "material",
    "use", "light", "polygon", "sphere", "color", "kdr", "ksr", "e", "ktr", "eta", "emission", "{", "}", "x", "y", "z",
    "a", "0", "1", "2", "3", "4", "-1", ".5", "1e30", "-1e59", "1e-200", "1e400", "nan", "#", "\n", "\r\n", "\x0b",
    "0 0 0", "1 0 0", "0 1 0", "world", "use a", "material a { }", "1 1 1", "polygon 3  0 0 0  1 0 0  0 1 0",
    "sphere 0 0 0 1", "scale 2 2 2", "rot x 45", "_bounded_groups", "é",
]  # fmt: skip


def only_scene_errors(path, reader):
    """Read; whatever is wrong must come as one line that names the file, and a line where there is one."""
    try:
        reader(path)
    except SceneError as error:
        message = str(error)
        assert message.startswith(str(path)) and "\n" not in message
        assert re.search(r", line \d+: ", message) or "no 'world'" in message or "no view" in message


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(words=st.lists(st.sampled_from(WORDS), max_size=40), start=st.sampled_from(["", "world ", "world push "]))
def test_fuzz_by_words(tmp_path, words, start):
    path = tmp_path / "fuzz.sc"
    path.write_bytes((start + " ".join(words)).encode())
    only_scene_errors(path, load_scene)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_fuzz_by_damage(tmp_path, data):
    """Bytes of a good file cut, repeated, overwritten or dropped."""
    good = bytearray((OWN / "min.sc").read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        where = data.draw(st.integers(0, len(good) - 1))
        length = data.draw(st.integers(0, 30))
        change = data.draw(st.sampled_from(["cut", "drop", "repeat", "overwrite"]))
        if change == "cut":
            good = good[: where + 1]
        elif change == "drop":
            good[where : where + length] = b" "
        elif change == "repeat":
            good[where:where] = good[where : where + length]
        else:
            good[where : where + length] = data.draw(st.binary(max_size=6)) or b" "
    path = tmp_path / "fuzz.sc"
    path.write_bytes(bytes(good))
    only_scene_errors(path, read_sc)


def test_thousands_of_groups_inside_each_other(tmp_path):
    scene = read(tmp_path, "world\n" + "push sphere 0 0 0 1\n" * 3000 + "pop\n" * 3000)
    assert len(scene.groups) == 3000 and scene.groups[0].end_group == 3000


def test_scene_for_radiosity(tmp_path):
    path = tmp_path / "a.sc"
    path.write_text(f"""size 64 48 persp 30 background .1 .2 .3 lookat 1 2 9  0 0 0  0 1 0 world
        material wall {{ color .5 1 0 kdr .8 ksr .1 e 9 ktr .2 eta 1.5 }} material lamp {{ emission 1 2 3 }}
        light 1 2 3  4 5 6
        push use wall {SQUARE} use lamp {SQUARE} use wall {SQUARE} sphere 1 1 1 2 pop {SQUARE}""")
    scene = load_scene(path)
    assert [s.face_count for s in scene.surfaces] == [2, 1, 320, 1]
    wall, lamp, ball, _ = scene.surfaces
    np.testing.assert_allclose(wall.material.reflectance, [0.4, 0.8, 0])
    np.testing.assert_allclose(wall.material.specular, 0.1)
    assert (wall.material.exponent, wall.material.ior, wall.material.two_sided) == (9, 1.5, False)
    np.testing.assert_allclose(wall.material.transmittance, 0.2)
    np.testing.assert_allclose(lamp.material.emission, [1, 2, 3])
    np.testing.assert_allclose(scene.background, [0.1, 0.2, 0.3])
    assert [note.split()[0] for note in scene.notes] == ["spheres", "point"]
    light = scene.lights[0]
    assert (light.kind, light.position.tolist(), light.power.tolist()) == ("point", [1, 2, 3], [4, 5, 6])
    assert ball.sphere.radius == 2 and ball.sphere.center.tolist() == [1, 1, 1]
    np.testing.assert_allclose(np.linalg.norm(ball.vertices - 1, axis=1), 2)
    np.testing.assert_allclose(ball.vertices, 1 + 2 * ball.vertex_normals)
    # Each facet lies within the stated error of the sphere and shows its front outside.
    for (ring,) in ball.faces():
        vector = vector_area(ring)
        height = vector @ (ring[0] - 1) / np.linalg.norm(vector)
        assert 2 - ball.facet_error - 1e-12 <= height < 2
    assert ball.facet_error <= 0.04


@pytest.mark.parametrize("name", ["min", "table", "room", "new"])
def test_the_pinhole_camera_sends_the_same_rays(name):
    source = read_sc(OWN / f"{name}.sc")
    by_matrix = PinholeRays.from_matrix(source.world_to_eye, source.fov_deg, source.width, source.height)
    by_camera = PinholeRays.from_camera(load_scene(OWN / f"{name}.sc").camera)
    np.testing.assert_allclose(by_camera.eye, by_matrix.eye, atol=1e-12)
    x, y = np.array([0, 1.5, source.width]), np.array([0, source.height, 3.25])
    np.testing.assert_allclose(by_camera.directions(x, y), by_matrix.directions(x, y), atol=1e-13)


def test_what_radiosity_cannot_use_is_an_error(tmp_path):
    path = tmp_path / "a.sc"
    path.write_text("world\nmaterial bright { color 2 0 0 kdr .6 }\nuse bright\nsphere 0 0 0 1")
    with pytest.raises(SceneError, match=r"line 4: found color \* kdr = 1.2 in material 'bright'"):
        load_scene(path)
    path.write_text("scale 1 1 -1 world")
    with pytest.raises(SceneError, match="mirrors"):
        load_scene(path)


def test_a_pane_of_radiosity_keeps_no_more_than_arrives(tmp_path):
    # The sum of the shares may exceed 1 in the ray caster's formula, where radiosity would make light from nothing.
    path = tmp_path / "a.sc"
    path.write_text("world\nmaterial pane { color 1 .5 0 kdr .8 ktr .5 }\nuse pane\n" + SQUARE)
    pane = load_scene(path).surfaces[0].material
    np.testing.assert_allclose(pane.transmittance, [0.2, 0.5, 0.5])


def test_line_ends_of_old_macs(tmp_path):
    assert same(read(tmp_path, "world # ends here\rsphere 0 0 0 1"), read(tmp_path, "world\nsphere 0 0 0 1")) is None
