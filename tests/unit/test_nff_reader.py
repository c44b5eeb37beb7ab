"""The NFF reader: entities, traps, errors, and what it makes of them for the renderers."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from workbench.accel.embree import EmbreeAccelerator
from workbench.errors import InputError, SceneError
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import vector_area
from workbench.geometry.tessellation import cone_mesh, sphere_mesh
from workbench.render.camera import PinholeRays
from workbench.scene.nff import NffCone, NffPolygon, NffSphere, load_scene, read_nff

SPD = Path(__file__).resolve().parents[2] / ".." / "shared" / "scenes-external" / "nff-spd"
VIEW = "v\nfrom 1 2 9\nat 0 0 0\nup 0 1 0\nangle 30\nhither .1\nresolution 64 48\n"
FILL = "f .5 1 0 .8 .1 9 0 0\n"


def write(tmp_path, text):
    path = tmp_path / "a.nff"
    path.write_text(text, encoding="utf-8")
    return path


def test_every_entity(tmp_path):
    scene = read_nff(write(tmp_path, "# a comment\nb .1 .2 .3\n" + VIEW + "l 1 2 3\nl 4 5 6 .7 .8 .9\n" + FILL + (
        "s 1 2 3 4\nc 0 0 0 2 0 0 5 1\nc\n0 0 0 2\n0 0 5 0\n f 1 1 1 1 0 5 .5 1.5 s 0 0 0 -1 # inside\n"
        "p 3\n0 0 0\n1 0 0\n0 1 0\npp 3\n0 0 0 0 0 2\n1 0 0 0 1 1\n0 1 0 1 0 1\n")))  # fmt: skip
    view = scene.view
    assert [view.eye.tolist(), view.at.tolist(), view.up.tolist()] == [[1, 2, 9], [0, 0, 0], [0, 1, 0]]
    assert (view.angle_deg, view.hither, view.width, view.height) == (30, 0.1, 64, 48)
    assert scene.background.tolist() == [0.1, 0.2, 0.3]
    assert [light.color.tolist() for light in scene.lights] == [[1, 1, 1], [0.7, 0.8, 0.9]]
    assert (scene.fills[0].kd, scene.fills[0].ks, scene.fills[0].shine, scene.fills[1].t) == (0.8, 0.1, 9, 0.5)
    ball, cut, tip, inside, polygon, patch = scene.objects
    assert isinstance(ball, NffSphere) and ball.radius == 4
    assert isinstance(cut, NffCone) and (cut.base_radius, cut.apex_radius) == (2, 1)
    assert isinstance(tip, NffCone) and tip.apex.tolist() == [0, 0, 5] and tip.apex_radius == 0
    assert inside.radius == -1
    assert polygon.normals is None and [o.fill for o in scene.objects] == [0, 0, 0, 1, 1, 1]
    np.testing.assert_allclose(patch.normals, [[0, 0, 1], [0, 0.5**0.5, 0.5**0.5], [0.5**0.5, 0, 0.5**0.5]])


BROKEN = [
    ("q", 1, "'q'"),
    (VIEW + FILL + "tt 3", 9, "'tt'"),
    ("v\nfrom 1 2\nat 0 0 0", 3, "'at'"),
    ("v\nfrom 1 2 3\nfrom 1 2 3", 3, "twice"),
    ("v\nfrom 1 2 3\neye 1 2 3", 3, "'eye'"),
    ("v\nfrom 0 0 0\nat 0 0 0\nup 0 1 0\nangle 30\nhither 1\nresolution 4 4", 1, "on one line"),
    ("v\nfrom 0 0 0\nat 0 1 0\nup 0 1 0\nangle 30\nhither 1\nresolution 4 4", 1, "on one line"),
    ("v\nfrom 0 0 9\nat 0 1 0\nup 0 1 0\nangle 190", 5, "'190'"),
    (VIEW.replace("64", "0"), 7, "'0'"),
    (VIEW + VIEW, 8, "second view"),
    ("s 0 0 0 1", 1, "before the view"),
    (VIEW + "s 0 0 0 1", 8, "before the first fill"),
    (VIEW + FILL + "s 0 0 0", 9, "ends"),
    (VIEW + FILL + "s 0 0 0 0", 9, "radius 0"),
    (VIEW + FILL + "c 0 0 0 1 0 0 0 1", 9, "same point"),
    (VIEW + FILL + "c 0 0 0 0\n0 0 1 0", 9, "not both 0"),
    (VIEW + FILL + "c 0 0 0 1\n0 0 1 -1", 9, "one sign"),
    (VIEW + FILL + "p 2\n0 0 0\n1 1 1", 9, "vertices"),
    (VIEW + FILL + "p 4\n0 0 0\n1 0 0\n1 1 1\n0 1 0", 9, "non-planar"),
    (VIEW + FILL + "p 3\n0 0 0\n1 0 0\n1 1 x", 12, "'x'"),
    (VIEW + FILL + "pp 3\n0 0 0 0 0 1\n1 0 0 0 0 0\n1 1 0 0 0 1", 9, "normal of length 0 at vertex 2"),
    (VIEW + "f 1 1 1 .5 .5 3 0", 8, "ends"),
    (VIEW + "f 1 -1 1 .5 .5 3 0 0", 8, "from 0"),
    ("l 1 2 3 4 5\ns", 2, "'s'"),
    ("b 1 2 inf", 1, "'inf'"),
    ("# only a comment\n", 1, "no view"),
]


@pytest.mark.parametrize(("text", "line", "part"), BROKEN, ids=range(len(BROKEN)))
def test_errors_name_file_and_line(tmp_path, text, line, part):
    path = write(tmp_path, text)
    with pytest.raises(SceneError) as caught:
        read_nff(path)
    message = str(caught.value)
    assert message.startswith(f"{path}, line {line}: ") and part in message and "\n" not in message


WORDS = ["v", "b", "l", "f", "c", "s", "p", "pp", "from", "#", "\n", "0", "1", "-1", "2", "3", "1e300", "nan", "0 0 0",
         "1 0 0", "0 1 0", VIEW, FILL, "s 0 0 0 1", "c 0 0 0 1 0 0 1 1", "p 3 0 0 0 1 0 0 0 1 0", "1 1 1"]  # fmt: skip


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(words=st.lists(st.sampled_from(WORDS), max_size=30), start=st.sampled_from(["", VIEW + FILL]))
def test_fuzz_by_words(tmp_path, words, start):
    path = write(tmp_path, start + " ".join(words))
    try:
        load_scene(path)
    except SceneError as error:
        message = str(error)
        assert message.startswith(f"{path}, line ") and "\n" not in message and re.search(r"line \d+: ", message)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(noise=st.binary(max_size=20), where=st.integers(0, 200))
def test_fuzz_by_bytes(tmp_path, noise, where):
    good = (VIEW + FILL + "s 0 0 0 1\nc 0 0 0 1 0 0 1 1\np 3\n0 0 0\n1 0 0\n0 1 0\n").encode()
    path = tmp_path / "a.nff"
    path.write_bytes(good[:where] + noise + good[where + 3 :])
    try:
        read_nff(path)
    except SceneError as error:
        assert str(error).startswith(f"{path}, line ")


# What the renderers get.


@pytest.mark.parametrize("facet_error", [0.25, 0.05, 0.02, 0.004])
def test_sphere_mesh_keeps_its_facet_error(facet_error):
    vertices, faces, normals, distance = sphere_mesh((1, 2, 3), 2.0, facet_error)
    np.testing.assert_allclose(vertices, np.array([1, 2, 3]) + 2 * normals)
    corner = vertices[faces] - (1, 2, 3)
    vector = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    height = np.einsum("ij,ij->i", vector, corner[:, 0]) / np.linalg.norm(vector, axis=1)
    assert 2 - height.min() == pytest.approx(distance) and distance <= 2 * facet_error
    # Closed, fronts outside: the vector areas cancel and the volume nears 4/3 pi 8.
    np.testing.assert_allclose(vector.sum(axis=0), 0, atol=1e-12)
    volume = np.einsum("ij,ij->i", vector, corner[:, 0]).sum() / 3
    assert 4 / 3 * np.pi * (2 - distance) ** 3 < volume < 4 / 3 * np.pi * 8


@pytest.mark.parametrize(("r0", "r1"), [(2, 2), (2, 0.5), (2, 0), (0, 1)])
def test_cone_mesh_keeps_its_facet_error(r0, r1):
    base, axis = np.array([1.0, 2, 3]), np.array([2.0, -1, 2])
    vertices, faces, normals, distance = cone_mesh(base, r0, base + axis, r1, 0.02)
    assert distance <= 0.02 * max(r0, r1)
    unit = axis / 3
    for face in faces:
        ring = vertices[face]
        vector = vector_area(ring)
        # Flat, and its front away from the axis.
        assert np.abs((ring - ring[0]) @ vector).max() < 1e-12 * np.linalg.norm(vector) + 1e-12
        middle = ring.mean(axis=0) - base
        assert vector @ (middle - (middle @ unit) * unit) > 0
        # Points of the facet lie inside the cone by no more than the stated error.
        for weights in np.random.default_rng(1).dirichlet(np.ones(len(ring)), 20):
            point = weights @ ring - base
            along = point @ unit
            across = np.linalg.norm(point - along * unit)
            exact = r0 + (r1 - r0) * along / 3
            assert exact - distance - 1e-12 <= across <= exact + 1e-12
    # Normals stand square on the cone's lines, which run from circle to circle.
    around = (vertices - base) - np.outer((vertices - base) @ unit, unit)
    lean = np.arctan2(r0 - r1, 3)
    np.testing.assert_allclose(normals @ unit, np.sin(lean), atol=1e-12)
    assert (np.einsum("ij,ij->i", around, normals) >= -1e-12).all()


@pytest.mark.parametrize("call", [
    lambda: sphere_mesh((0, 0, 0), 0.0), lambda: sphere_mesh((0, 0, 0), 1.0, 0.0),
    lambda: cone_mesh((0, 0, 0), 1, (0, 0, 0), 1), lambda: cone_mesh((0, 0, 0), 0, (0, 0, 1), 0),
    lambda: cone_mesh((0, 0, 0), 1, (0, 0, 1), -1), lambda: cone_mesh((0, 0, 0), 1, (0, 0, 1), 1, 2.0),
])  # fmt: skip
def test_meshes_refuse_what_has_no_shape(call):
    with pytest.raises(InputError):
        call()


def test_scene_for_the_renderers(tmp_path):
    path = write(tmp_path, VIEW + "b .1 .2 .3\nl 1 2 3\n" + FILL + (
        "p 3 0 0 0 1 0 0 0 1 0\ns 0 0 0 -2\nc 0 0 0 1 0 0 1 1\nc 0 0 0 -1 0 0 1 -1\np 3 0 0 1 1 0 1 0 1 1\n"
        "pp 3 0 0 0 0 0 1 1 0 0 0 0 1 0 1 0 0 0 1\npp 3 1 0 0 0 0 1 1 1 0 0 0 1 0 1 0 0 0 1\n"
        "f 1 1 1 .2 0 5 .7 1.5\np 3 0 0 0 1 0 0 0 1 0"))  # fmt: skip
    scene = load_scene(path, facet_error=0.05)
    polygons, hollow, tube, bore, patches, glass = scene.surfaces
    assert polygons.face_count == 2 and patches.face_count == 2 and glass.face_count == 1
    # Two patches share an edge, so six corners are four vertices.
    assert len(patches.vertices) == 4 and patches.vertex_normals.shape == (4, 3)
    assert hollow.sphere.radius == 2
    for (ring,) in hollow.faces():
        assert vector_area(ring) @ ring[0] < 0
    for surface, sign in ((tube, 1), (bore, -1)):
        for (ring,) in surface.faces():
            assert sign * (vector_area(ring) @ (ring.mean(axis=0) * (1, 1, 0))) > 0
        assert surface.facet_error <= 0.05
    np.testing.assert_allclose(polygons.material.reflectance, [0.4, 0.8, 0])
    assert (polygons.material.two_sided, polygons.material.ior) == (False, 1)
    assert (glass.material.two_sided, glass.material.ior) == (True, 1.5)
    np.testing.assert_allclose(glass.material.transmittance, 0.7)
    camera = scene.camera
    assert (camera.fov_deg, camera.width, camera.height) == (30, 64, 48)
    assert scene.lights[0].kind == "point" and scene.background.tolist() == [0.1, 0.2, 0.3]


def test_a_pane_of_radiosity_keeps_no_more_than_arrives(tmp_path):
    path = write(tmp_path, VIEW + "f 1 .5 0 .8 .1 9 .5 1\ns 0 0 0 1\n")
    np.testing.assert_allclose(load_scene(path).surfaces[0].material.transmittance, [0.2, 0.5, 0.5])


def test_a_fill_brighter_than_white_is_an_error(tmp_path):
    path = write(tmp_path, VIEW + "f 2 1 1 .8 0 1 0 0\ns 0 0 0 1")
    with pytest.raises(SceneError, match=r"line 9: found colour \* Kd = 1.6"):
        load_scene(path)


# Objects as the databases' own readme and SOURCES.md list them.
COUNTS = {
    "tetra_6": ({"p": 4096}, 1),
    "tree_11": ({"c": 4095, "s": 4095, "p": 1}, 7),
    "teapot_12": ({"pp": 9120, "p": 144}, 2),
    "balls_4": ({"s": 7381, "p": 1}, 3),
    "gears_2": ({"p": 1169}, 5),
}


@pytest.mark.parametrize("name", COUNTS)
def test_standard_procedural_databases(name):
    if not SPD.is_dir():
        pytest.skip(f"{SPD} is not here")
    scene = read_nff(SPD / f"{name}.nff")
    found: dict[str, int] = {}
    for thing in scene.objects:
        kind = {NffCone: "c", NffSphere: "s"}.get(type(thing))
        kind = kind or ("p" if isinstance(thing, NffPolygon) and thing.normals is None else "pp")
        found[kind] = found.get(kind, 0) + 1
    assert (found, len(scene.lights)) == COUNTS[name]
    assert (scene.view.width, scene.view.height, scene.view.angle_deg) == (512, 512, 45)


def test_eye_rays_of_the_tetrahedra_hit_as_often_as_published():
    """513 x 513 rays through the pixel corners; the databases' readme says 49,788 hit, within about 10 %.

    The tetrahedra are closed, so the first hit of a ray is on a front and one-sidedness does not matter.
    """
    if not SPD.is_dir():
        pytest.skip(f"{SPD} is not here")
    scene = load_scene(SPD / "tetra_6.nff")
    rays = PinholeRays.from_camera(scene.camera)
    x, y = np.meshgrid(np.arange(513), np.arange(513))
    hits = EmbreeAccelerator(Geometry.from_scene(scene)).closest_hit([rays.eye], rays.directions(x, y))
    assert (hits.polygon >= 0).sum() == pytest.approx(49788, rel=0.01)
