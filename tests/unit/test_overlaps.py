"""Polygons that lie on others in one plane: what they hide is cut away, once and on the right side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import radiosity
import workbench
from workbench.geometry.flat import Geometry
from workbench.scene import overlaps
from workbench.scene.library import box_surface, diffuse, unit_cube
from workbench.scene.model import Scene, Surface
from workbench.scene.overlaps import without_overlaps

WALL = diffuse("wall", 0.5, 1.0)
ROOM = box_surface("room", WALL, [0, 0, 0], [2, 3, 4], inward=True)


def areas(scene):
    """Area and area-weighted normal of each surface."""
    geometry = Geometry.from_scene(scene)
    found = {}
    for surface, area, normal in zip(
        geometry.polygon_surface, geometry.polygon_area, geometry.polygon_normal, strict=True
    ):
        name = geometry.surface_name[surface]
        found.setdefault(name, np.zeros(4))
        found[name] += [area, *(area * normal)]
    return found


def on_face(number, low, high):
    """A rectangle on a face of the room, as that face turns; ``low`` and ``high`` are shares of its sides."""
    a, b, _, d = ROOM.face(number)[0]
    place = [a + u * (b - a) + v * (d - a) for u, v in ((low, low), (high, low), (high, high), (low, high))]
    return np.array(place)


@pytest.mark.parametrize("number", range(6))
@pytest.mark.parametrize("turn", [False, True])
def test_a_lamp_flush_with_a_face_leaves_a_hole_there(number, turn):
    rng = np.random.default_rng(number)
    spin = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    spin *= np.sign(np.linalg.det(spin))
    place = (lambda p: p @ spin.T + [5, -7, 3]) if turn else (lambda p: p)
    room = Surface.from_polygons("room", WALL, [place(ROOM.face(k)[0]) for k in range(6)])
    lamp = Surface.from_polygons("lamp", diffuse("lamp", 0, 1.0), [place(on_face(number, 0.2, 0.6))])
    before = areas(Scene("room", (room, lamp), bands=1))
    scene = without_overlaps(Scene("room", (room, lamp), bands=1))
    after = areas(scene)
    # The hole takes the lamp's area away, and leaves the rest facing as it did: normals sum to minus the lamp's.
    np.testing.assert_allclose(after["room"], before["room"] - before["lamp"], atol=1e-9)
    np.testing.assert_allclose(after["lamp"], before["lamp"], atol=1e-12)
    assert len(scene.notes) == 1 and "'room' was cut away" in scene.notes[0] and "'lamp'" in scene.notes[0]
    assert without_overlaps(scene) is scene


def test_of_equal_polygons_the_first_stays_and_empty_surfaces_go():
    again = Surface.from_polygons("again", WALL, [ROOM.face(2)[0]])
    scene = without_overlaps(Scene("room", (ROOM, again), bands=1))
    assert [s.name for s in scene.surfaces] == ["room"] and scene.surfaces[0] is ROOM


def test_what_turns_away_is_two_sided_or_lets_light_through_is_left_alone():
    scene = Scene("cube", (unit_cube(0.5, 1.0).surfaces[0],), bands=1)
    assert without_overlaps(scene) is scene
    back = Surface.from_polygons("back", WALL, [on_face(0, 0.2, 0.6)[::-1]])  # a box that stands on the floor
    pane = replace(WALL, name="pane", transmittance=np.array([0.5]), reflectance=np.array([0.1]))
    glass = Surface.from_polygons("glass", pane, [on_face(0, 0.2, 0.6)])
    beside = Surface.from_polygons("beside", WALL, [on_face(0, 0.2, 0.6) + 1e-3])
    for other in (back, glass, beside):
        scene = Scene("room", (ROOM, other), bands=1)
        assert without_overlaps(scene) is scene
    both = replace(WALL, name="both", two_sided=True)
    sheet = Surface.from_polygons("sheet", both, [on_face(0, 0.0, 1.0)])
    rug = Surface.from_polygons("rug", WALL, [on_face(0, 0.2, 0.6)])
    scene = Scene("sheet", (sheet, rug), bands=1)
    assert without_overlaps(scene) is scene  # from below one would see the hole
    turned = Surface.from_polygons("rug", both, [on_face(0, 0.2, 0.6)[::-1]])
    cut = areas(without_overlaps(Scene("room", (ROOM, turned), bands=1)))
    assert cut["room"][0] == pytest.approx(areas(Scene("room", (ROOM,), bands=1))["room"][0] - cut["rug"][0])


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([1e-6, 1.0, 1e6]), st.booleans())
def test_what_is_left_covers_the_plane_once(seed, scale, few):
    """Random triangles on a square: together they have the area of their union, found with a fine grid of points."""
    rng = np.random.default_rng(seed)
    square = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1.0]])
    triangles = []
    for _ in range(rng.integers(1, 5)):
        corners = np.column_stack([rng.random((3, 2)), np.ones(3)])
        if np.cross(corners[1] - corners[0], corners[2] - corners[0])[2] < 0:
            corners = corners[::-1]
        triangles.append(corners)
    surfaces = [Surface.from_polygons("square", WALL, [square * scale])]
    surfaces += [Surface.from_polygons(f"{k}", WALL, [t * scale]) for k, t in enumerate(triangles)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(overlaps, "FEW", 600 if few else 0)
        found = areas(without_overlaps(Scene("square", tuple(surfaces), bands=1)))
    whole = np.sum(list(found.values()), axis=0) / scale**2
    np.testing.assert_allclose(whole, [1, 0, 0, 1], atol=1e-6)


def test_a_furnace_papered_twice_stays_one():
    """Everything emits 1 and reflects half, so that 2 arrives everywhere: also where walls have pictures and copies."""
    pictures = [on_face(k, 0.1, 0.7) for k in range(6)] + [on_face(1, 0.3, 0.9), ROOM.face(4)[0]]
    scene = Scene("papered", (ROOM, Surface.from_polygons("pictures", WALL, pictures)), bands=1)
    for method in ("auto", "hierarchical", "progressive"):
        solution = radiosity.solve(scene, error=0.01, method=method)
        mean = float(solution.mean_irradiance[0])
        assert mean == pytest.approx(2.0, rel=0.01)
        assert solution.mesh.element_area.sum() == pytest.approx(2 * (2 * 3 + 3 * 4 + 2 * 4), rel=1e-9)
    factors = radiosity.view_factors(scene, by="surface", error=0.01)
    np.testing.assert_allclose(np.asarray(factors.matrix).sum(axis=1), 1.0, atol=0.01)


def test_a_file_is_cut_as_it_is_read(tmp_path):
    path = tmp_path / "flush.toml"
    path.write_text(
        """schema = 1
[materials.wall]
reflectance = 0.5
[materials.lamp]
reflectance = 0.0
emission = 1.0
[[surface]]
name = "room"
material = "wall"
box = { min = [0.0, 0.0, 0.0], max = [2.0, 2.0, 2.0], inward = true }
[[surface]]
name = "lamp"
material = "lamp"
polygon = [[0.7, 0.7, 2.0], [0.7, 1.3, 2.0], [1.3, 1.3, 2.0], [1.3, 0.7, 2.0]]
"""
    )
    scene = workbench.load(path)
    assert any("'room' was cut away" in note for note in scene.notes)
    assert areas(scene)["room"][0] == pytest.approx(24 - 0.36)
