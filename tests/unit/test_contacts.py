"""Contact lines: where they are found, how cells are cut, and that no element ends up half under a box."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import radiosity
from radiosity import patches
from radiosity.patches import build_mesh
from workbench.geometry.contacts import contact_lines, cut_along
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import vector_area
from workbench.scene.library import box_surface, diffuse
from workbench.scene.model import Scene, Surface

FLOOR = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0.0]])


def scene_of(*others, floor=FLOOR):
    return Scene("contacts", (Surface.from_polygons("floor", diffuse("grey", 0.5, bands=1), [floor]), *others), bands=1)


def box(low, high, **options):
    return box_surface("box", diffuse("grey", 0.5, bands=1), low, high, **options)


def floor_lines(scene, near=0.05):
    return contact_lines(Geometry.from_scene(scene), near).get(0, np.empty((0, 2, 3)))


def total_length(lines):
    ends = np.unique(np.round(np.sort(lines.reshape(-1, 6).reshape(-1, 2, 3), axis=1), 9), axis=0)
    return sum(math.dist(*pair) for pair in {tuple(sorted(map(tuple, pair))) for pair in ends.tolist()})


@pytest.mark.parametrize("omit", [(), ("-z",)])
@pytest.mark.parametrize("height", [0.0, 0.02, -0.02])
def test_a_box_on_the_floor_leaves_its_outline(omit, height):
    lines = floor_lines(scene_of(box([1, 1, height], [2, 3, 1], omit=omit)))
    assert (lines[..., 2] == 0).all()
    assert total_length(lines) == pytest.approx(6.0)


def test_what_crosses_the_floor_leaves_its_section():
    assert total_length(floor_lines(scene_of(box([1, 1, -1], [2, 3, 1])))) == pytest.approx(6.0)
    blade = Surface.from_polygons("blade", diffuse("grey", 0.5, bands=1), [[[1, 1, -1], [1, 3, -1], [1, 2, 1]]])
    assert total_length(floor_lines(scene_of(blade))) == pytest.approx(1.0)


def test_walls_at_the_rim_and_boxes_in_the_air_leave_nothing():
    wall = Surface.from_polygons("wall", diffuse("grey", 0.5, bands=1), [[[0, 0, 0], [0, 4, 0], [0, 4, 3], [0, 0, 3]]])
    assert len(floor_lines(scene_of(wall, box([1, 1, 0.2], [2, 3, 1])))) == 0
    assert len(contact_lines(Geometry.from_scene(scene_of(box([1, 1, 0], [1.1, 1.1, 0.1]))), 0.05, least=0.2)) == 0


def area(parts):
    return [sum(float(np.linalg.norm(vector_area(piece))) for piece in part) for part in parts]


def test_cells_are_cut_by_loops_and_by_lines_that_cross_them():
    up, square = np.array([0, 0, 1.0]), FLOOR
    across = np.array([[[1, -1, 0], [1, 5, 0.0]]])
    assert sorted(area(cut_along([square], up, across))) == pytest.approx([4, 12])
    loop = np.array([[[1, 1, 0], [2, 1, 0]], [[2, 1, 0], [2, 3, 0]], [[2, 3, 0], [1, 3, 0]], [[1, 3, 0], [1, 1, 0.0]]])
    assert sorted(area(cut_along([square], up, loop))) == pytest.approx([2, 14])
    ends_inside = np.array([[[1, -1, 0], [1, 2, 0.0]]])
    assert area(cut_along([square], up, ends_inside)) == [16]
    sliver = np.array([[[0.01, -1, 0], [0.01, 5, 0.0]]])
    assert area(cut_along([square], up, sliver)) == [16]
    along_the_rim = np.array([[[0, 0, 0], [0, 4, 0.0]], [[0, 4, 0], [4, 4, 0]]])
    assert area(cut_along([square], up, along_the_rim)) == [16]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(*[st.integers(-1, 9)] * 4), min_size=1, max_size=8),
    st.sampled_from([1e-3, 1.0, 1e5]),
    st.floats(0, 6),
)
def test_parts_tile_the_cell_in_any_place(lines, size, turn):
    cos, sin = math.cos(turn), math.sin(turn)
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
    cell = (FLOOR @ rotation.T + [3, 4, 5]) * size
    normal = rotation @ np.array([0, 0, 1.0])
    segments = np.array([[[a / 2, b / 2, 0], [c / 2, d / 2, 0]] for a, b, c, d in lines], dtype=float)
    parts = cut_along([cell], normal, (segments @ rotation.T + [3, 4, 5]) * size)
    assert sum(area(parts)) == pytest.approx(16 * size**2, rel=1e-7)
    for part in parts:
        assert all(vector_area(piece) @ normal > 0 for piece in part)
    assert all(found > 0.01 * 16 * size**2 for found in area(parts))


def test_no_element_is_half_under_a_box():
    """Every element of the floor lies under the box or beside it, and the cells at its foot are no smaller for it."""
    scene = scene_of(box([1.1, 1.2, 0], [2.3, 2.9, 1], omit=("-z",)))
    geometry = Geometry.from_scene(scene)
    mesh = build_mesh(scene, geometry, max_edge=0.5)
    floor = np.flatnonzero(mesh.element_polygon == 0)
    assert mesh.element_area[floor].sum() == pytest.approx(16)
    under = 0.0
    for e in floor:
        points = np.concatenate(
            [
                mesh.corners[mesh.piece_start[p] : mesh.piece_start[p + 1]]
                for p in np.flatnonzero(mesh.piece_element == e)
            ]
        )
        eps = 1e-6
        inside = ((points[:, :2] >= [1.1 - eps, 1.2 - eps]) & (points[:, :2] <= [2.3 + eps, 2.9 + eps])).all()
        outside = (
            not ((points[:, :2] > [1.1 + eps, 1.2 + eps]) & (points[:, :2] < [2.3 - eps, 2.9 - eps])).all(axis=1).any()
        )
        assert inside or outside
        under += mesh.element_area[e] * inside
    assert under == pytest.approx(1.2 * 1.7, rel=0.02)
    # Asked for whole polygons, the mesh has whole polygons.
    assert build_mesh(scene, geometry).element_count == geometry.polygon_count


def test_the_floor_round_a_box_keeps_its_light(monkeypatch):
    """A black box on a floor under a roof and an open horizon: what the roof gets from the floor.

    A coarse mesh whose elements lie half under the box is three times as far from a fine one.
    """
    scene = Scene(
        "contact",
        (
            Surface.from_polygons("floor", diffuse("white", 0.8, bands=1), [FLOOR]),
            box_surface("box", diffuse("black", 0.0, bands=1), [1.1, 1.2, 0], [2.3, 2.9, 0.1], omit=("-z",)),
            Surface.from_polygons("roof", diffuse("grey", 0.5, bands=1), [FLOOR[::-1] + [0, 0, 2]]),
        ),
        background=np.ones(1),
        bands=1,
    )
    points, normals = [[2, 2, 2 - 1e-6], [1, 1, 2 - 1e-6]], [[0, 0, -1.0]] * 2

    def indirect(elements):
        solution = radiosity.solve(scene, elements=elements, tolerance=1e-3)
        return solution.irradiance(points, normals, error=1e-3).indirect[:, 0]

    fine, coarse = indirect(900), indirect(24)
    monkeypatch.setattr(patches, "contact_lines", lambda *_: {})
    uncut = indirect(24)
    assert np.abs(coarse / fine - 1).max() < 0.035
    assert np.abs(uncut / fine - 1).min() > 0.06
