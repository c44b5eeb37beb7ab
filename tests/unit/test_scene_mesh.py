"""Mesh files: quads kept, materials, fronts, light for files without, and one-line faults."""

from __future__ import annotations

import gzip
import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from workbench.errors import SceneError
from workbench.geometry.polygons import vector_area
from workbench.scene.library import box_surface, closed_scene_gaps, diffuse
from workbench.scene.mesh import load_scene, read_mesh

EXTERNAL = Path(__file__).resolve().parents[2] / ".." / "shared" / "scenes-external"


def area(surface):
    return sum(np.linalg.norm(vector_area(rings)) for rings in surface.faces())


def volume(surface):
    return sum(float(rings[0][0] @ vector_area(rings)) for rings in surface.faces()) / 3


def sizes(surface):
    return np.diff(surface.ring_offsets).tolist()


def obj(tmp_path, text, mtl=None, name="mesh.obj"):
    if mtl is not None:
        (tmp_path / "mesh.mtl").write_text(mtl)
        text = "mtllib mesh.mtl\n" + text
    path = tmp_path / name
    path.write_text(text)
    return path


def cube_obj(inward=False, flipped=()):
    """A unit cube of six quads; the faces in ``flipped`` run the wrong way."""
    cube = box_surface("cube", diffuse("m", 0.5), [0, 0, 0], [1, 1, 1], inward=inward)
    lines = [f"v {x:g} {y:g} {z:g}" for x, y, z in cube.vertices]
    for index, ring in enumerate(cube.ring_vertices.reshape(-1, 4) + 1):
        lines.append("f " + " ".join(map(str, ring[::-1] if index in flipped else ring)))
    return "\n".join(lines) + "\n"


# ---------------------------------------------------------------------------------------------
# OBJ


def test_quads_and_concave_polygons_stay_whole(tmp_path):
    square = "v 0 0 {z}\nv 2 0 {z}\nv 2 2 {z}\nv 0 2 {z}\nv 1 0.5 {z}\n"
    text = (
        square.format(z=0) + "f -5 -4 -3 -2\n"  # a quad
        + square.format(z=1) + "f -5 -1 -4 -3 -2\n"  # concave at the last vertex
        + square.format(z=2) + "f -5 -4 -3\n"
    )  # fmt: skip
    mesh = read_mesh(obj(tmp_path, text))
    (surface,) = mesh.surfaces
    assert sizes(surface) == [4, 5, 3]
    assert area(surface) == pytest.approx(4 + 3.5 + 2)
    assert mesh.notes == ()


def test_negative_indices_count_back_from_the_statement(tmp_path):
    text = "".join(
        f"v 0 0 {z}\nv 1 0 {z}\nv 1 1 {z}\nv 0 1 {z}\ng {name}\nf -4 -3 -2 -1\n" for z, name in enumerate("abc")
    )
    surfaces = read_mesh(obj(tmp_path, text)).surfaces
    assert [surface.name for surface in surfaces] == ["a", "b", "c"]
    for z, surface in enumerate(surfaces):
        assert surface.vertices.tolist() == [[0, 0, z], [1, 0, z], [1, 1, z], [0, 1, z]]


def test_materials_of_obj(tmp_path):
    text = cube_obj() + "usemtl lamp\nf 1 2 3\nusemtl mirror\nf 1 2 4\nusemtl glass\nf 1 3 4\nusemtl thin\nf 2 3 4\n"
    mtl = """
newmtl lamp
Kd 0.1 0.2 0.3
Ke 17 12 4
newmtl mirror
Kd 0.1 0.1 0.1
Ks 0.95 0.5 0.5
Ns 400
illum 5
newmtl glass
Kd 0 0 0
Ks 0.2 0.2 0.2
Tf 0.7 0.8 0.9
Ni 1.5
illum 7
newmtl thin
Kd 0.8 0.4 0.2
Ks 0.1 0.1 0.1
Ns 20
d 0.5
"""
    found = {surface.name: surface.material for surface in read_mesh(obj(tmp_path, text, mtl)).surfaces}
    assert list(found) == ["mesh", "lamp", "mirror", "glass", "thin"]
    assert found["mesh"].reflectance.tolist() == [0.5, 0.5, 0.5]
    assert found["lamp"].reflectance.tolist() == [0.1, 0.2, 0.3]
    assert found["lamp"].emission.tolist() == [17, 12, 4]
    # 0.95 + 0.1 exceeds 1: the mirror gives way.
    assert found["mirror"].specular == pytest.approx([0.9, 0.5, 0.5])
    assert found["mirror"].exponent == math.inf
    assert found["glass"].transmittance == pytest.approx([0.7, 0.8, 0.9])
    assert found["glass"].specular == pytest.approx([0.2, 0.2, 0.1])
    assert found["glass"].ior == 1.5
    assert found["thin"].reflectance == pytest.approx([0.4, 0.2, 0.1])
    assert found["thin"].transmittance == pytest.approx([0.5] * 3)
    assert found["thin"].exponent == 20


def test_a_texture_counts_with_its_mean_and_a_missing_one_not_at_all(tmp_path):
    # Half of the picture white, half black: the linear mean is 0.5; sRGB 188 is 0.503 linear.
    pixels = np.zeros((4, 4, 3), dtype=np.uint8)
    pixels[:2] = 255
    Image.fromarray(pixels).save(tmp_path / "half.png")
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\nusemtl b\nf 3 2 1\n"
    mesh = read_mesh(obj(tmp_path, text, "newmtl a\nKd 0.8 0.8 0.4\nmap_Kd half.png\nnewmtl b\nmap_Kd none.png\n"))
    first, second = (surface.material for surface in mesh.surfaces)
    assert first.reflectance == pytest.approx([0.4, 0.4, 0.2])
    assert second.reflectance.tolist() == [0.5, 0.5, 0.5]
    assert "textures that are missing or unreadable were left out (1)" in mesh.notes


def test_a_broken_texture_is_left_out(tmp_path):
    whole = tmp_path / "whole.png"
    Image.fromarray(np.full((64, 64, 3), 255, dtype=np.uint8)).save(whole)
    (tmp_path / "cut.png").write_bytes(whole.read_bytes()[:60])
    mesh = read_mesh(obj(tmp_path, "usemtl a\n" + cube_obj(), "newmtl a\nKd 0.8 0.8 0.4\nmap_Kd cut.png\n"))
    assert mesh.surfaces[0].material.reflectance.tolist() == [0.8, 0.8, 0.4]
    assert mesh.notes == ("textures that are missing or unreadable were left out (1)",)


def test_a_missing_material_file_is_a_note(tmp_path):
    mesh = read_mesh(obj(tmp_path, "mtllib none.mtl\nusemtl x\n" + cube_obj()))
    assert mesh.surfaces[0].material.reflectance.tolist() == [0.5, 0.5, 0.5]
    assert any("'none.mtl' is missing" in note for note in mesh.notes)


def test_white_is_read_as_the_whitest_paint(tmp_path):
    mesh = read_mesh(obj(tmp_path, "usemtl w\n" + cube_obj(), "newmtl w\nKd 1 1 0.5\n"))
    assert mesh.surfaces[0].material.reflectance.tolist() == [0.99, 0.99, 0.5]
    assert any("0.99" in note for note in mesh.notes)


def test_names_prefer_the_material_that_no_other_part_has(tmp_path):
    text = (
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\no chair\nusemtl wood\nf 1 2 3\nusemtl felt\nf 1 2 4\n"
        "o desk\nusemtl wood\nf 1 3 4\ng top\nusemtl steel\nf 2 3 4\n"
    )
    names = [surface.name for surface in read_mesh(obj(tmp_path, text)).surfaces]
    assert names == ["chair/wood", "felt", "desk", "steel"]


def _room(tmp_path, text, mtl):
    """Reflectance and emission of the first band by surface, and the notes."""
    mesh = read_mesh(obj(tmp_path, text, mtl))
    values = {s.name: (s.material.reflectance[0], s.material.emission[0]) for s in mesh.surfaces}
    return values, mesh.notes


ROOM = "usemtl wall\n" + cube_obj(inward=True) + "v .2 .2 .9\nv .8 .2 .9\nv .8 .8 .9\nusemtl lamp\nf 9 11 10\n"
PAINT = "newmtl wall\nKd 0.7 0.7 0.7\nnewmtl lamp\nKd 0 0 0\nKe 9 9 9\n"


@pytest.mark.parametrize(
    ("text", "mtl"),
    [
        (ROOM.replace("\n", "\r"), PAINT.replace("\n", "\r\n")),
        (ROOM, "\ufeff" + PAINT),
        (ROOM.replace("f 9 11 10", "f 9 \\\n11 10"), PAINT),
        (ROOM.replace("usemtl wall", "usemtl wall # grey"), PAINT.replace("Kd 0.7 0.7 0.7", "Kd 0.7 0.7 0.7 # grey")),
        (ROOM.replace("wall", "Wall #25"), PAINT.replace("wall", "Wall #25")),
        (ROOM.replace(" ", "\t"), PAINT.replace(" ", "\t")),
    ],
    ids=["old Mac", "byte order mark", "continued line", "comments", "a name with #", "tabs"],
)
def test_what_exporters_write_reads_the_same(tmp_path, text, mtl):
    values, notes = _room(tmp_path, text, mtl)
    assert list(values.values()) == [(0.7, 0.0), (0.0, 9.0)]
    assert notes == ()
    file = tmp_path / "mesh.obj"
    file.write_text("\ufeff" + file.read_text())
    assert [s.material.emission[0] for s in read_mesh(file).surfaces] == [0.0, 9.0]


@pytest.mark.parametrize("name", [r".\mesh.mtl", r"C:\Users\me\mesh.mtl", "mesh.mtl mesh.mtl"])
def test_material_files_are_found_by_names_from_windows(tmp_path, name):
    (tmp_path / "mesh.mtl").write_text(PAINT)
    mesh = read_mesh(obj(tmp_path, f"mtllib {name}\n" + ROOM))
    assert [s.material.reflectance[0] for s in mesh.surfaces] == [0.7, 0.0]


def test_a_material_that_no_file_defines_is_a_note(tmp_path):
    _, notes = _room(tmp_path, ROOM.replace("usemtl wall", "usemtl brick"), PAINT)
    assert notes == ("materials that no file defines are grey, reflectance 0.5 (1)",)


def test_transparency_and_glowing_textures_of_mtl(tmp_path):
    Image.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "red glow.png")
    mtl = PAINT.replace("Ke 9 9 9", "Ke 9 9 9\nmap_Ke -s 1 1 1 -clamp on red glow.png") + "Tr 0.25\n"
    lamp = read_mesh(obj(tmp_path, ROOM, mtl)).surfaces[1].material
    assert lamp.emission.tolist() == [9.0, 0.0, 0.0]
    assert lamp.transmittance.tolist() == [0.25] * 3


def test_faces_that_repeat_those_of_another_surface_are_dropped(tmp_path):
    # Two equal rooms in one place, as a copied object leaves them: each wall would be lit half and count twice.
    mesh = read_mesh(obj(tmp_path, "o one\n" + cube_obj() + "o two\n" + cube_obj().replace("v 0", "v -0")))
    assert [s.name for s in mesh.surfaces] == ["one"]
    assert mesh.notes == ("faces that repeat another were dropped (6)",)


def test_vertex_normals_split_vertices(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvn 0 0 2\nvn 0 1 0\nf 1//1 2//1 3//1\nf 1//2 4//2 2//2\n"
    (surface,) = read_mesh(obj(tmp_path, text)).surfaces
    assert len(surface.vertices) == 6
    # The normals given are those of the faces, but for their length.
    wanted = [vector_area(rings) / 0.5 for rings in surface.faces() for _ in rings[0]]
    assert np.allclose(surface.vertex_normals[surface.ring_vertices], wanted)
    some = text.replace("f 1//2 4//2 2//2", "f 1 4 2")
    assert read_mesh(obj(tmp_path, some)).surfaces[0].vertex_normals is None


def test_bent_empty_and_repeated_faces(tmp_path):
    text = (
        "v 0 0 0\nv 1 0 0\nv 1 1 0.3\nv 0 1 0\nv 2 0 0\nv 0 0 1\n"
        "f 1 2 3 4\n"  # not planar
        "f 1 2 5\n"  # on a line
        "f 1 2 2\n"  # a corner twice
        "f 1 2 6\nf 2 6 1\n"  # the same face again
        "f 1 6 2\n"  # its back: kept
    )
    mesh = read_mesh(obj(tmp_path, text))
    (surface,) = mesh.surfaces
    assert sizes(surface) == [3, 3, 3, 3]
    assert all(vector_area(rings)[2] >= 0 for rings in list(surface.faces())[:2])
    assert sorted(mesh.notes)[:3] == [
        "faces that are not planar were cut into triangles (1)",
        "faces that repeat another were dropped (1)",
        "faces without area were dropped (2)",
    ]


def test_a_flat_corner_in_a_bent_polygon_does_not_stop_it(tmp_path):
    text = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 1 0.5 0.2\nv 0 2 0\nf 1 2 3 4 5\n"
    (surface,) = read_mesh(obj(tmp_path, text)).surfaces
    assert sizes(surface) == [3, 3, 3]
    # Seen from above the three triangles cover the concave pentagon.
    assert sum(vector_area(rings)[2] for rings in surface.faces()) == pytest.approx(4 - 1.5)


def test_gzip_is_read_as_the_file_inside(tmp_path):
    path = tmp_path / "cube.obj.gz"
    path.write_bytes(gzip.compress(cube_obj().encode()))
    (surface,) = read_mesh(path).surfaces
    assert surface.name == "cube"
    assert sizes(surface) == [4] * 6


# ---------------------------------------------------------------------------------------------
# Fronts


@pytest.mark.parametrize("inward", [False, True])
def test_the_winding_stands_and_surfaces_are_one_sided(tmp_path, inward):
    mesh = read_mesh(obj(tmp_path, cube_obj(inward)))
    assert volume(mesh.surfaces[0]) == pytest.approx(-1 if inward else 1)
    assert not mesh.surfaces[0].material.two_sided
    assert mesh.notes == ()


@pytest.mark.parametrize(("inward", "flipped"), [(False, (2,)), (False, (0, 5)), (True, (1, 3))])
def test_a_closed_body_is_turned_to_agree_with_its_larger_part(tmp_path, inward, flipped):
    mesh = read_mesh(obj(tmp_path, cube_obj(inward, flipped)))
    (surface,) = mesh.surfaces
    assert volume(surface) == pytest.approx(-1 if inward else 1)
    assert closed_scene_gaps([surface]) == 0
    assert not surface.material.two_sided
    assert mesh.notes == (f"faces of 'mesh' were turned to agree with their neighbours ({len(flipped)})",)


def test_an_open_sheet_that_contradicts_itself_becomes_two_sided(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 0 0\nv 2 1 0\nf 1 2 3 4\nf 2 3 6 5\n"
    mesh = read_mesh(obj(tmp_path, text))
    assert mesh.surfaces[0].material.two_sided
    assert [vector_area(rings)[2] for rings in mesh.surfaces[0].faces()] == [1, -1]
    assert "two-sided (1)" in mesh.notes[0]


def test_a_moebius_strip_becomes_two_sided(tmp_path):
    count = 12
    turn = 2 * np.pi * np.arange(count) / count
    lines = []
    for t in turn:
        for side in (-0.3, 0.3):
            reach = 1 + side * math.cos(t / 2)
            lines.append(f"v {reach * math.cos(t)} {reach * math.sin(t)} {side * math.sin(t / 2)}")
    for i in range(count):
        a, b = 2 * i + 1, 2 * i + 2
        c, d = (a + 2, b + 2) if i + 1 < count else (2, 1)
        lines += [f"f {a} {c} {d}", f"f {a} {d} {b}"]
    assert read_mesh(obj(tmp_path, "\n".join(lines))).surfaces[0].material.two_sided


# ---------------------------------------------------------------------------------------------
# PLY, STL, glTF


@pytest.mark.parametrize("kind", ["ply", "stl", "glb"])
def test_a_sphere_is_the_same_from_each_format(tmp_path, kind):
    ball = trimesh.creation.icosphere(subdivisions=2)
    path = tmp_path / f"ball.{kind}"
    ball.export(path)
    (surface,) = read_mesh(path).surfaces
    assert surface.face_count == 320
    assert len(surface.vertices) == 162  # STL and glTF vertices are joined again
    assert closed_scene_gaps([surface]) == 0
    assert volume(surface) == pytest.approx(ball.volume, rel=1e-5)
    assert surface.material.reflectance.tolist() == [0.5, 0.5, 0.5]


def ply(kind, rings, points, extra=""):
    """A PLY file with a colour beside each vertex and a number beside each face."""
    order = ">" if "big" in kind else "<"
    head = (
        f"ply\nformat {kind} 1.0\ncomment by hand\nelement vertex {len(points)}\nproperty float x\nproperty float y\n"
        f"property double z\nproperty uchar red\nelement face {len(rings)}\n"
        "property list uchar int vertex_indices\nproperty short number\n" + extra + "end_header\n"
    )
    if kind == "ascii":
        rows = [f"{x:g} {y:g} {z:g} 200" for x, y, z in points]
        rows += [f"{len(ring)} {' '.join(map(str, ring))} 7" for ring in rings]
        return head.encode() + "\n".join(rows).encode()
    body = b"".join(struct.pack(order + "ffdB", *point, 200) for point in points)
    return head.encode() + body + b"".join(struct.pack(f"{order}B{len(r)}ih", len(r), *r, 7) for r in rings)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_polygons_of_ply_files_stay_whole(tmp_path, kind):
    # An L whose first corner does not see its last ones, so that a fan of triangles would have another area: 3.
    points = [[2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 2, 0], [0, 2, 0], [0, 0, 0], [3, 0, 0], [3, 1, 0]]
    (tmp_path / "l.ply").write_bytes(ply(kind, [[0, 1, 2, 3, 4, 5], [0, 6, 7, 1], [0, 6, 7, 1]], points))
    mesh = read_mesh(tmp_path / "l.ply")
    assert sizes(mesh.surfaces[0]) == [6, 4]
    assert area(mesh.surfaces[0]) == pytest.approx(4)
    assert mesh.notes == ("faces that repeat another were dropped (1)",)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data[:-1], "cut short"),
        (lambda data: data.replace(b"element vertex 3", b"element vertex 999999999999"), "cut short"),
        (lambda data: data.replace(b"element vertex 3", b"element vertex -3"), "line 4: found 'element vertex -3'"),
        (lambda data: data.replace(b"property float y", b"property half y"), "line 6: found 'property half y'"),
        (lambda data: data.replace(b"float x", b"float w"), "found no vertices with x, y and z"),
        (lambda data: data.replace(b"binary_little_endian", b"utf-8"), "line 2"),
        (lambda data: data[:-6] + struct.pack("<ih", 9, 7), "face 0: found the vertex indices"),
    ],
    ids=["short", "far too short", "negative", "type", "no x", "format", "index"],
)
def test_faults_of_ply_files_say_what_is_wrong(tmp_path, change, words):
    data = ply("binary_little_endian", [[0, 1, 2]], [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    (tmp_path / "bad.ply").write_bytes(change(data))
    with pytest.raises(SceneError, match=words) as caught:
        read_mesh(tmp_path / "bad.ply")
    assert "\n" not in str(caught.value)


def gltf_room(tmp_path, kind):
    """A cube as glTF with a lamp of strength 20, a spot light and a camera under a turned and moved node."""
    cube = trimesh.creation.box()
    cube.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(name="glow", emissiveFactor=[1.0, 0.5, 0.0])
    )
    files = trimesh.Scene(cube).export(file_type="gltf")
    table = json.loads(files.pop("model.gltf"))
    table["extensionsUsed"] = ["KHR_lights_punctual", "KHR_materials_emissive_strength"]
    table["materials"][0]["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": 20.0}}
    kinds = [
        {"type": "spot", "color": [1, 1, 0.5], "intensity": 8.0, "spot": {"outerConeAngle": math.pi / 6}},
        {"type": "directional", "name": "sun", "intensity": 3.0},
        {"type": "point"},
    ]
    table["extensions"] = {"KHR_lights_punctual": {"lights": kinds}}
    table["cameras"] = [{"type": "perspective", "perspective": {"yfov": math.pi / 3, "aspectRatio": 2.0}}]
    first = len(table["nodes"])
    table["nodes"] += [
        # A quarter turn about x takes -z, the way of lights and cameras, to +y; scale does not turn it.
        {"name": "above", "rotation": [math.sqrt(0.5), 0, 0, math.sqrt(0.5)], "translation": [1, 2, 3],
         "scale": [2, 2, 2], "children": [first + 1, first + 2, first + 3]},
        {"name": "lamp", "translation": [0, 0, -1], "extensions": {"KHR_lights_punctual": {"light": 0}}},
        {"extensions": {"KHR_lights_punctual": {"light": 1}}},
        {"name": "eye", "camera": 0, "extensions": {"KHR_lights_punctual": {"light": 2}}},
    ]  # fmt: skip
    table["scenes"][0]["nodes"].append(first)
    if kind == "gltf":
        for name, data in files.items():
            (tmp_path / name).write_bytes(data)
        (tmp_path / "room.gltf").write_text(json.dumps(table))
        return tmp_path / "room.gltf"
    # A .glb has one buffer: the parts of the others go behind each other.
    starts = np.cumsum([0, *(buffer["byteLength"] for buffer in table["buffers"])]).tolist()
    rest = b"".join(files[buffer["uri"]] for buffer in table["buffers"])
    for view in table["bufferViews"]:
        view["byteOffset"] = view.get("byteOffset", 0) + starts[view["buffer"]]
        view["buffer"] = 0
    table["buffers"] = [{"byteLength": starts[-1]}]
    text = json.dumps(table).encode()
    text += b" " * (-len(text) % 4)
    rest += bytes(-len(rest) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(rest), len(text), 0x4E4F534A)
    (tmp_path / "room.glb").write_bytes(head + text + struct.pack("<I4s", len(rest), b"BIN\0") + rest)
    return tmp_path / "room.glb"


@pytest.mark.parametrize("kind", ["gltf", "glb"])
def test_lights_cameras_and_strength_of_gltf(tmp_path, kind):
    scene = load_scene(gltf_room(tmp_path, kind))
    assert scene.surfaces[0].face_count == 12
    assert scene.surfaces[0].material.emission.tolist() == [20.0, 10.0, 0.0]
    spot, sun, point = scene.lights
    assert (spot.name, spot.kind, spot.power.tolist()) == ("lamp", "spot", [8.0, 8.0, 4.0])
    assert np.allclose(spot.position, [1, 4, 3]) and np.allclose(spot.direction, [0, 1, 0])
    assert spot.cone_deg == pytest.approx(30)
    assert (sun.name, sun.kind, sun.power.tolist()) == ("sun", "directional", [3.0] * 3)
    assert (point.name, point.kind, point.power.tolist()) == ("eye", "point", [1.0] * 3)
    assert np.allclose(point.position, [1, 2, 3])
    camera = scene.cameras["eye"]
    assert scene.camera is camera and (camera.width, camera.height) == (1024, 512)
    assert camera.fov_deg == pytest.approx(60)
    assert np.allclose(camera.look_at - camera.eye, [0, 2, 0]) and np.allclose(camera.up, [0, 0, 2])


def test_normals_of_a_ply_file_are_kept(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=1)
    (tmp_path / "ball.ply").write_bytes(trimesh.exchange.ply.export_ply(ball, vertex_normal=True))
    (surface,) = read_mesh(tmp_path / "ball.ply").surfaces
    assert np.allclose(surface.vertex_normals, surface.vertices, atol=1e-6)
    (tmp_path / "bare.ply").write_bytes(trimesh.exchange.ply.export_ply(ball, vertex_normal=False))
    assert read_mesh(tmp_path / "bare.ply").surfaces[0].vertex_normals is None


def test_gltf_nodes_are_placed_and_materials_read(tmp_path):
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(
        uv=np.zeros((8, 2)),
        material=trimesh.visual.material.PBRMaterial(
            name="pane",
            baseColorFactor=[51, 102, 153, 51],
            emissiveFactor=[1, 0.5, 0],
            alphaMode="BLEND",
            doubleSided=True,
        ),
    )
    scene = trimesh.Scene()
    mirror = np.diag([-2.0, 1, 1, 1])
    mirror[:3, 3] = [5, 0, 0]
    scene.add_geometry(box, node_name="left", geom_name="box", transform=mirror)
    scene.add_geometry(trimesh.creation.box(), node_name="right", geom_name="plain")
    (tmp_path / "two.glb").write_bytes(scene.export(file_type="glb"))
    surfaces = {surface.name: surface for surface in read_mesh(tmp_path / "two.glb").surfaces}
    pane, plain = surfaces["pane"], surfaces["right"]
    assert pane.vertices.min(axis=0).tolist() == [4, -0.5, -0.5]
    assert pane.vertices.max(axis=0).tolist() == [6, 0.5, 0.5]
    assert volume(pane) == pytest.approx(2.0)  # a mirror image keeps its fronts outside
    assert volume(plain) == pytest.approx(1.0)
    # Alpha 0.2: four fifths pass, one fifth meets the colour.
    assert pane.material.transmittance == pytest.approx([0.8] * 3)
    assert pane.material.reflectance == pytest.approx([0.04, 0.08, 0.12])
    assert pane.material.emission == pytest.approx([1, 0.5, 0])
    assert pane.material.two_sided
    assert not plain.material.two_sided


# ---------------------------------------------------------------------------------------------
# A mesh as a scene


def test_a_mesh_without_light_is_lit_by_sky_and_sun(tmp_path):
    scene = load_scene(obj(tmp_path, cube_obj()))
    # A uniform sky of radiance L gives an open horizontal surface pi L.
    assert np.pi * scene.background == pytest.approx(np.ones(3))
    (sun,) = scene.lights
    assert sun.kind == "directional"
    assert np.linalg.norm(sun.direction) == pytest.approx(1.0)
    assert sun.direction[1] < 0 and sun.direction[2] < 0  # from above, whichever axis is up
    assert "uniform sky" in scene.notes[-1]
    assert (scene.bands, scene.camera, scene.closed) == (3, None, False)


def test_a_closed_room_without_light_is_lit_from_its_middle(tmp_path):
    scene = load_scene(obj(tmp_path, cube_obj(inward=True)))
    assert not scene.background.any()
    (light,) = scene.lights
    assert light.kind == "point"
    assert 4 * np.pi * light.power == pytest.approx(np.full(3, 6.0))  # 6 m2 of wall, 1 W/m2 on the mean
    assert (np.abs(light.position - 0.5) < 0.25).all()
    assert "no sky enters" in scene.notes[-1]
    assert load_scene(obj(tmp_path, cube_obj(inward=True))).lights[0].position.tolist() == light.position.tolist()


def test_the_light_of_a_closed_room_keeps_out_of_the_furniture(tmp_path):
    pillar = box_surface("pillar", diffuse("m", 0.5), [0.3, 0.3, 0.001], [0.7, 0.7, 0.999])
    lines = [f"v {x} {y} {z}" for x, y, z in pillar.vertices]
    lines += ["f " + " ".join(str(i + 9) for i in ring) for ring in pillar.ring_vertices.reshape(-1, 4)]
    scene = load_scene(obj(tmp_path, cube_obj(inward=True) + "\n".join(lines)))
    x, y, z = scene.lights[0].position
    assert 0 < z < 1
    assert 0.1 < max(abs(x - 0.5), abs(y - 0.5)) < 0.5
    assert max(abs(x - 0.5), abs(y - 0.5)) > 0.2  # outside the pillar


def test_a_file_with_a_lamp_is_left_alone(tmp_path):
    scene = load_scene(obj(tmp_path, "usemtl lamp\n" + cube_obj(), "newmtl lamp\nKd 0 0 0\nKe 1 1 1\n"))
    assert not scene.background.any()
    assert scene.lights == ()
    assert scene.notes == ()


# ---------------------------------------------------------------------------------------------
# Faults


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("v 0 0\n", 1, "expected three finite numbers"),
        ("v 0 0 x\n", 1, "could not convert"),
        ("\nv 0 nan 0\n", 2, "expected three finite numbers"),
        ("v 0 0 0\nf 1 2 3\n", 2, "the corner '2', expected indices of the 1 vertices"),
        ("v 0 0 0\nf 0 1 1\n", 2, "the corner '0'"),
        ("v 0 0 0\nf -2 1 1\n", 2, "the corner '-2'"),
        ("v 0 0 0\nf 1//1 1//1 1//1\n", 2, "0 normals"),
        ("v 0 0 0\nf a b c\n", 2, "the corner 'a', expected v, v/vt"),
        ("v 0 0 0\nv 1 0 0\nf 1 2\n", 3, "a face of 2 corners"),
        ("v 0 0 0\n", None, "found no face"),
        ("hello world\n", None, "found no face"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", None, "no face with an area"),
        ("v 0 0 0\nv 2 2 0\nv 2 0 0\nv 0 1 0\nf 1 2 3 4\n", None, "edges that cross"),
        ("v 0 0 \0\n", None, "binary data"),
        ("", None, "empty file"),
    ],
)
def test_faults_of_obj_name_the_line(tmp_path, text, line, words):
    path = obj(tmp_path, text)
    with pytest.raises(SceneError) as caught:
        read_mesh(path)
    message = str(caught.value)
    assert words in message
    assert message.startswith(str(path))
    assert "\n" not in message
    assert caught.value.line == line


@pytest.mark.parametrize(
    ("mtl", "words"),
    [
        ("newmtl a\nKd 1.2 0 0\n", "material 'a': found reflectance [1.2, 0.0, 0.0], expected numbers from 0 to 1"),
        ("newmtl a\nKd -0.1 0 0\n", "expected numbers from 0 to 1"),
        ("newmtl a\nKe nan 0 0\n", "expected one or three finite numbers"),
        ("newmtl a\nKe bright\n", "found ke 'bright', expected one or three finite numbers"),
        ("newmtl a\nKe 1 2\n", "expected one or three finite numbers"),
        ("newmtl a\nKe -1 0 0\n", "expected numbers of 0 or more"),
        ("newmtl a\nillum nan\n", "found illum 'nan'"),
        ("newmtl a\nd 2\n", "transmittance"),
    ],
)
def test_faults_of_materials_name_the_material(tmp_path, mtl, words):
    with pytest.raises(SceneError) as caught:
        read_mesh(obj(tmp_path, "usemtl a\n" + cube_obj(), mtl))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["junk.obj", "junk.ply", "junk.stl", "junk.glb", "junk.gltf", "junk.obj.gz"])
@pytest.mark.parametrize(
    "data", [b"", b"\x00\xff" * 300, b"ply\nformat ascii 1.0\nelement vertex 3\n", b"{}", b"solid"]
)
def test_junk_is_one_line(tmp_path, name, data):
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    assert len(message) < 300


def test_missing_folder_and_unknown_kind(tmp_path):
    (tmp_path / "folder.ply").mkdir()
    for name, words in (
        ("none.ply", "No such file"),
        ("folder.ply", "Is a directory"),
        ("x.fbx", "expected one of .glb"),
    ):
        with pytest.raises(SceneError, match=words):
            read_mesh(tmp_path / name)


def _whole(kind):
    ball = trimesh.creation.icosphere(subdivisions=0)
    data = ball.export(file_type=kind)
    return data.encode() if isinstance(data, str) else data


WHOLE = {
    "obj": cube_obj().encode(),
    "ply": _whole("ply"),
    "stl": _whole("stl"),
    "glb": _whole("glb"),
    "obj.gz": gzip.compress(cube_obj().encode(), mtime=0),
}


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(sorted(WHOLE)), st.integers(0, 10_000), st.integers(0, 40), st.binary(max_size=8))
def test_any_damage_gives_a_mesh_or_a_scene_error(tmp_path, kind, start, length, junk):
    data = WHOLE[kind]
    start %= len(data)
    path = tmp_path / f"mesh.{kind}"
    path.write_bytes(data[:start] + junk + data[start + length :])
    try:
        scene = load_scene(path)
    except SceneError as error:
        assert "\n" not in str(error)
    else:
        assert all(np.isfinite(surface.vertices).all() and area(surface) > 0 for surface in scene.surfaces)


# ---------------------------------------------------------------------------------------------
# Files that others made


def external(name):
    path = EXTERNAL / name
    if not path.exists():
        pytest.skip(f"{path.name} is not beside the repository")
    return path


def test_cornell_box_of_quads():
    scene = load_scene(external("cornell-mcguire/CornellBox-Original.obj"))
    names = [surface.name for surface in scene.surfaces]
    assert names == ["floor", "ceiling", "backWall", "rightWall", "leftWall", "shortBox", "tallBox", "light"]
    # The left wall is not planar; each block repeats one side where its underside should be.
    assert [sizes(surface) for surface in scene.surfaces] == [[4]] * 4 + [[3, 3]] + [[4] * 5] * 2 + [[4]]
    assert scene.surfaces[-1].material.emission.tolist() == [17, 12, 4]
    assert not scene.background.any()
    assert not any(surface.material.two_sided for surface in scene.surfaces)
    assert np.allclose(vector_area(scene.surfaces[-1].face(0)), [0, -0.47 * 0.38, 0])


def test_cornell_box_of_spheres():
    scene = load_scene(external("cornell-mcguire/CornellBox-Sphere.obj"))
    assert sum(surface.face_count for surface in scene.surfaces) == 2188
    assert all(surface.vertex_normals is not None for surface in scene.surfaces)
    assert scene.notes == ()


def test_fish_is_a_closed_body_under_the_sky():
    scene = load_scene(external("fish/fish.obj"))
    (fish,) = scene.surfaces
    assert fish.face_count == 21568
    assert closed_scene_gaps([fish]) == 0
    assert volume(fish) > 0
    assert scene.background.any()


def test_godot_room_has_17_meshes_and_lets_the_sky_in():
    scene = load_scene(external("godot-room/room.glb"))
    assert len(scene.surfaces) == 17
    assert sum(surface.face_count for surface in scene.surfaces) == 63720
    room = next(surface for surface in scene.surfaces if surface.material.name == "Room")
    assert room.material.reflectance == pytest.approx([0.8] * 3)
    assert np.allclose([room.vertices.min(axis=0), room.vertices.max(axis=0)], [[-5, 0, -5], [5, 5, 5]])
    assert scene.background.any()


def test_game_level_without_its_textures():
    scene = load_scene(external("zdm2/zdm2.obj.gz"))
    assert len(scene.surfaces) == 84
    assert sum(surface.face_count for surface in scene.surfaces) == 70754 - 63
    assert "faces without area were dropped (63)" in scene.notes
    assert "textures that are missing or unreadable were left out (84)" in scene.notes
