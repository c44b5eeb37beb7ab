"""Choosing a reader, and the built-in scenes: counts, areas, fronts and gaps."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import workbench
from workbench.errors import SceneError
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import vector_area
from workbench.scene import load as loading
from workbench.scene.library import closed_scene_gaps
from workbench.scene.load import built_in_scenes, load

SHARED = Path(__file__).resolve().parents[2] / ".." / "shared"
NAMES = [
    "cornell-box",
    "cornell-box-closed",
    "daylight-office",
    "furnace",
    "hinged-blocker",
    "l-room",
    "office",
    "sculpture-room",
]
SHELLS = {
    "office": [
        *("floor", "ceiling", "door", "whiteboard", "pin board"),
        *("south wall", "north wall", "west wall", "east wall"),
    ],
    "sculpture-room": ["walls", "ceiling", "floor"],
}


def area(surface):
    return sum(np.linalg.norm(vector_area(rings)) for rings in surface.faces())


def volume(surfaces):
    """By the divergence theorem: negative where a closed shell's fronts look inward."""
    return sum(float(rings[0][0] @ vector_area(rings)) for s in surfaces for rings in s.faces()) / 3


def by_name(scene):
    return {surface.name: surface for surface in scene.surfaces}


# ---------------------------------------------------------------------------------------------


def test_the_package_offers_load_and_version_and_stays_light():
    assert workbench.load is load
    assert workbench.__version__[0].isdigit()
    with pytest.raises(AttributeError, match="no attribute 'lod'"):
        workbench.lod  # noqa: B018
    code = "import workbench, sys; print(sorted({'numpy', 'scipy', 'pydantic', 'trimesh', 'numba'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_each_suffix_has_its_reader(tmp_path):
    for suffix in loading.SUFFIXES:
        with pytest.raises(SceneError, match=r"cannot be read|No such file") as caught:
            load(tmp_path / f"none{suffix.upper()}")
        assert str(caught.value).startswith(str(tmp_path))
    (tmp_path / "t.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert load(str(tmp_path / "t.obj")).surfaces[0].face_count == 1


def test_unknown_kinds_and_names_say_what_is_known(tmp_path):
    with pytest.raises(SceneError, match=r"scene\.blend: found an unknown kind of file, expected one of \.toml, \.obj"):
        load(tmp_path / "scene.blend")
    with pytest.raises(SceneError, match="found a folder, expected a scene file"):
        load(tmp_path)
    with pytest.raises(SceneError, match="did you mean 'cornell-box'"):
        load("cornel-box")
    with pytest.raises(SceneError, match="`radiosity scenes` lists"):
        load("zzzz")


def test_built_in_scenes_are_found_by_name_and_described():
    found = built_in_scenes()
    assert list(found) == NAMES
    for name, about in found.items():
        assert 20 < len(about) < 120, name
        assert load(name).path.name == f"{name}.toml"


def test_without_the_folder_there_are_no_built_in_scenes(monkeypatch, tmp_path):
    monkeypatch.setattr(loading, "_FOLDER", tmp_path / "absent")
    assert built_in_scenes() == {}
    with pytest.raises(SceneError, match="no such file and no built-in scene"):
        load("furnace")


# ---------------------------------------------------------------------------------------------
# The built-in scenes


@pytest.mark.parametrize("name", NAMES)
def test_every_built_in_scene_is_sound(name):
    scene = load(name)
    assert scene.has_emitter
    assert scene.notes == ()
    assert scene.camera is not None
    assert 300 <= scene.camera.width <= 800
    geometry = Geometry.from_scene(scene)
    # Convex pieces cover their polygons: nothing is lost in the cutting.
    corners = [geometry.piece(index) for index in range(min(geometry.piece_count, 2000))]
    pieces = np.zeros(geometry.polygon_count)
    np.add.at(pieces, geometry.piece_polygon[: len(corners)], [np.linalg.norm(vector_area(c)) for c in corners])
    whole = geometry.piece_polygon[len(corners) - 1] if len(corners) < geometry.piece_count else geometry.polygon_count
    assert pieces[:whole] == pytest.approx(geometry.polygon_area[:whole], rel=1e-9)
    eye = scene.camera.eye
    if scene.closed:
        assert (geometry.bounds[0] < eye).all()
        assert (eye < geometry.bounds[1]).all()


@pytest.mark.parametrize(("name", "faces"), [("furnace", 6), ("l-room", 8), ("cornell-box-closed", 18)])
def test_closed_scenes_are_watertight_and_look_inward(name, faces):
    scene = load(name)
    assert scene.closed
    assert sum(surface.face_count for surface in scene.surfaces) == faces
    assert closed_scene_gaps(scene.surfaces) == 0
    assert volume(scene.surfaces) < 0


@pytest.mark.parametrize("name", SHELLS)
def test_shells_of_furnished_rooms_are_watertight(name):
    scene = load(name)
    assert scene.closed
    surfaces = by_name(scene)
    shell = [surfaces.pop(part) for part in SHELLS[name]]
    assert closed_scene_gaps(shell) == 0
    low, high = Geometry.from_scene(scene).bounds
    assert volume(shell) == pytest.approx(-np.prod(high - low))
    inside = [surface.vertices for surface in surfaces.values()]
    assert (np.concatenate(inside)[:, 2] >= low[2]).all()
    # What stands in the room keeps off walls and ceiling.
    assert (np.concatenate(inside)[:, :2] > low[:2]).all()
    assert (np.concatenate(inside) < high).all()


def test_furnace_glows_everywhere():
    scene = load("furnace")
    assert scene.bands == 1
    (cube,) = scene.surfaces
    assert volume([cube]) == pytest.approx(-1)
    # B = e / (1 - rho)
    assert cube.material.emission / (1 - cube.material.reflectance) == pytest.approx(2.0)


def test_l_room_has_the_areas_of_its_plan():
    scene = load("l-room")
    assert [area(surface) for surface in scene.surfaces] == pytest.approx([9, 3, 6, 6, 3, 9, 5, 5])
    assert volume(scene.surfaces) == pytest.approx(-15)
    assert [surface.name for surface in scene.surfaces if surface.material.emission.any()] == ["x=3"]


def test_the_answer_written_into_the_l_room_is_the_truth():
    truth = SHARED / "truth" / "truth.json"
    if not truth.exists():
        pytest.skip("truth.json is not beside the repository")
    cases = {case["name"]: case for case in json.loads(truth.read_text())["cases"]}
    scene = load("l-room")
    assert [s.name for s in scene.surfaces[:2]] + [s.name for s in scene.surfaces[-2:]] == [
        "y=0",
        "x=3",
        "ceiling",
        "floor",
    ]
    table = scene.path.read_text().split("[W/m2]\n", 1)[1].splitlines()[:7]
    written = [float(line.split()[-1]) for line in table]
    wanted = cases["rad/L-room/emitter-surface-2"]["value"]
    assert written == pytest.approx(wanted[:7], rel=1e-15)


def test_cornell_boxes_hold_the_measured_geometry():
    box = by_name(load("cornell-box"))
    assert area(box["light"]) == pytest.approx(0.130 * 0.105)
    block = 0.5 * np.linalg.norm(np.cross([0.240 - 0.130, 0, 0.272 - 0.065], [0.290 - 0.082, 0, 0.114 - 0.225]))
    assert np.linalg.norm(vector_area(box["short block"].face(0))) == pytest.approx(block)
    assert len(box["floor"].face(0)) == 3
    assert not load("cornell-box").closed
    # Without the front, the box has four edges that nothing joins.
    assert closed_scene_gaps(load("cornell-box").surfaces) == 4
    assert set(by_name(load("cornell-box-closed"))) - set(box) == {"front wall"}


def test_cornell_vertices_are_those_of_the_measured_data():
    source = SHARED / "scenes-external" / "cornell-measured" / "cornell-box-measured.json"
    if not source.exists():
        pytest.skip("the measured data is not beside the repository")
    data = json.loads(source.read_text())
    for name in ("cornell-box", "cornell-box-closed"):
        found = np.concatenate([surface.vertices for surface in load(name).surfaces])
        wanted = np.concatenate([np.asarray(s["vertices"], dtype=float) for s in data["surfaces"]]) / 1000
        assert {tuple(p) for p in np.round(found, 6)} == {tuple(p) for p in np.round(wanted, 6)}
        surfaces = by_name(load(name))
        reference = data["linear_srgb_reference"]["reflectance_under_D65"]
        for surface, colour in (("floor", "white"), ("left wall", "red"), ("right wall", "green")):
            assert surfaces[surface].material.reflectance == pytest.approx(reference[colour], abs=6e-4)


def test_the_blocker_is_hinged_to_the_lower_plate():
    surfaces = by_name(load("hinged-blocker"))
    door = surfaces["door"]
    assert np.allclose(vector_area(surfaces["lower plate"].face(0)), [0, 0, 1])
    assert np.allclose(vector_area(surfaces["upper plate"].face(0)), [0, 0, -1])
    assert area(door) == pytest.approx(0.4)
    hinge = door.vertices[np.isclose(door.vertices[:, 2], 0)]
    assert np.allclose(hinge[:, 0], 0)
    assert door.vertices[:, 2].max() == pytest.approx(0.5 * np.sin(np.pi / 3))
    assert door.material.two_sided


def test_office_has_about_forty_surfaces_and_three_hanging_lamps():
    scene = load("office")
    assert len(scene.surfaces) == 42
    lamps = [surface for surface in scene.surfaces if surface.material.emission.any()]
    assert len(lamps) == 3
    for lamp in lamps:
        assert np.allclose(vector_area(lamp.face(0)), [0, 0, -0.36])
        assert (lamp.vertices[:, 2] == 2.9).all()
    for index in (1, 2, 3):
        surfaces = by_name(scene)
        assert closed_scene_gaps([surfaces[f"housing {index}"], surfaces[f"lamp {index}"]]) == 0


def test_office_furniture_does_not_overlap():
    """Boxes around separate pieces are apart or touch; parts of one piece only touch."""
    scene = load("office")
    solids = [s for s in scene.surfaces if s.name not in SHELLS["office"] and not s.material.emission.any()]
    for i, one in enumerate(solids):
        for other in solids[i + 1 :]:
            if one.name[:7] == other.name[:7] and one.name.startswith("chair"):
                continue  # a turned chair's own parts stand on each other within their bounding boxes
            low = np.maximum(one.vertices.min(axis=0), other.vertices.min(axis=0))
            high = np.minimum(one.vertices.max(axis=0), other.vertices.max(axis=0))
            assert (high - low).min() <= 1e-9, (one.name, other.name)


def test_sculpture_has_more_than_20000_triangles_and_stands_free():
    scene = load("sculpture-room")
    surfaces = by_name(scene)
    knot = surfaces["torus knot"]
    assert knot.face_count == 23_040
    assert closed_scene_gaps([knot]) == 0
    assert volume([knot]) > 0
    assert 0 < knot.facet_error < 0.002
    assert 0.005 < knot.vertices[:, 2].min() - surfaces["plinth"].vertices[:, 2].max() < 0.02
    assert closed_scene_gaps([surfaces["housing"], surfaces["lamp"]]) == 0
    assert np.allclose(vector_area(surfaces["lamp"].face(0)), [0, 0, -1])
