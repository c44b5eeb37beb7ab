"""Surfaces built in code: areas, orientations and facet errors against closed forms."""

import numpy as np
import pytest

from workbench.errors import InputError
from workbench.geometry.polygons import vector_area
from workbench.scene.library import (
    BOX_SIDES,
    box_surface,
    closed_scene_gaps,
    diffuse,
    quad_light_over_floor,
    sphere_surface,
    torus_knot_mesh,
    transformed,
    unit_cube,
)
from workbench.scene.model import Surface

GREY = diffuse("grey", 0.5)


def area(surface):
    return sum(np.linalg.norm(vector_area(rings)) for rings in surface.faces())


def volume(surface):
    """By the divergence theorem; positive where fronts look outward."""
    return sum(float(rings[0][0] @ vector_area(rings)) for rings in surface.faces()) / 3


def test_box_has_six_outward_quads():
    box = box_surface("box", GREY, [1, 2, 3], [2, 4, 6])
    assert box.face_count == 6
    assert area(box) == pytest.approx(2 * (2 + 3 + 6))
    assert volume(box) == pytest.approx(6.0)
    assert closed_scene_gaps([box]) == 0
    assert volume(box_surface("room", GREY, [1, 2, 3], [2, 4, 6], inward=True)) == pytest.approx(-6.0)


@pytest.mark.parametrize(("index", "side"), list(enumerate(BOX_SIDES)))
def test_each_named_side_lies_where_its_name_says(index, side):
    box = box_surface("one", GREY, [0, 0, 0], [1, 2, 3], omit=[s for s in BOX_SIDES if s != side])
    axis, sign = "xyz".index(side[1]), 1 if side[0] == "+" else -1
    normal = vector_area(box.face(0))
    assert normal[axis] * sign == pytest.approx(6 / (1, 2, 3)[axis])
    assert np.count_nonzero(normal) == 1
    assert (box.face(0)[0][:, axis] == (0 if sign < 0 else (1, 2, 3)[axis])).all()
    open_box = box_surface("open", GREY, [0, 0, 0], [1, 2, 3], omit=[side])
    assert open_box.face_count == 5
    assert closed_scene_gaps([open_box]) == 4
    assert closed_scene_gaps([open_box, box]) == 0
    assert index < 6


@pytest.mark.parametrize("wrong", [{"low": [0, 0, 1]}, {"omit": ["-w"]}, {"omit": BOX_SIDES}])
def test_wrong_boxes_are_refused(wrong):
    with pytest.raises(InputError, match=r"^box: found .* expected"):
        box_surface("box", GREY, **{"low": [0, 0, 0], "high": [1, 1, 1], **wrong})


def test_sphere_keeps_the_exact_sphere_and_states_its_error():
    ball = sphere_surface("ball", GREY, [1, 2, 3], 2.0, facet_error=0.005)
    assert ball.sphere.radius == 2.0
    assert closed_scene_gaps([ball]) == 0
    assert 0 < ball.facet_error <= 0.005 * 2.0
    # Facets lie between the spheres of radius r - error and r.
    low, high = (4 / 3 * np.pi * (2.0 - e) ** 3 for e in (ball.facet_error, 0.0))
    centred = transformed(
        ball, np.block([[np.eye(3), -np.array([[1], [2], [3]])], [np.zeros((1, 3)), np.ones((1, 1))]])
    )
    assert low < volume(centred) < high
    inside = sphere_surface("ball", GREY, [0, 0, 0], 1.0, inward=True)
    assert volume(inside) < 0
    assert np.einsum("ij,ij->i", inside.vertex_normals, inside.vertices).max() < 0


def test_transform_moves_everything_that_belongs_to_a_surface():
    ball = sphere_surface("ball", GREY, [1, 0, 0], 1.0)
    # Turn by 90 degrees about z, double, then lift by 5: (x, y, z) -> (-2y, 2x, 2z + 5).
    matrix = np.array([[0, -2, 0, 0], [2, 0, 0, 0], [0, 0, 2, 5], [0, 0, 0, 1.0]])
    moved = transformed(ball, matrix)
    assert np.allclose(moved.sphere.center, [0, 2, 5])
    assert moved.sphere.radius == pytest.approx(2.0)
    assert moved.facet_error == pytest.approx(2 * ball.facet_error)
    assert np.allclose(moved.vertices, moved.sphere.center + 2 * moved.vertex_normals)
    assert volume(moved) == pytest.approx(8 * volume(ball))


def test_mirrored_fronts_stay_fronts_and_stretched_spheres_lose_their_exact_record():
    ball = sphere_surface("ball", GREY, [0, 0, 0], 1.0)
    mirrored = transformed(ball, np.diag([-1.0, 1, 1, 1]))
    assert volume(mirrored) == pytest.approx(volume(ball))
    assert mirrored.sphere is not None
    for rings in mirrored.faces():
        assert vector_area(rings) @ rings[0].mean(axis=0) > 0
    stretched = transformed(ball, np.diag([1.0, 1, 3, 1]))
    assert stretched.sphere is None
    assert stretched.facet_error == pytest.approx(3 * ball.facet_error)
    # The normal of the ellipsoid x^2 + y^2 + z^2/9 = 1 is along (x, y, z/9).
    wanted = stretched.vertices / [1, 1, 9]
    wanted /= np.linalg.norm(wanted, axis=1)[:, None]
    assert np.allclose(stretched.vertex_normals, wanted)
    with pytest.raises(InputError, match="flattens"):
        transformed(ball, np.diag([1.0, 1, 0, 1]))


def test_mirror_image_keeps_holes_holes():
    outer = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]], dtype=float)
    hole = np.array([[1, 1, 0], [1, 2, 0], [3, 1, 0]], dtype=float)
    surface = Surface.from_polygons("s", GREY, [[outer, hole]])
    mirrored = transformed(surface, np.diag([-1.0, 1, 1, 1]))
    assert np.allclose(vector_area(mirrored.face(0)), [0, 0, 15])
    assert {tuple(p) for p in mirrored.face(0)[1]} == {(-1, 1, 0), (-1, 2, 0), (-3, 1, 0)}


def test_torus_knot_is_closed_outward_and_within_its_stated_error():
    vertices, faces, normals, error = torus_knot_mesh(2, 3, radius=1.0, tube=0.2, segments=240, sides=24)
    knot = Surface.from_mesh("knot", GREY, vertices, faces, vertex_normals=normals)
    assert knot.face_count == 2 * 240 * 24
    assert closed_scene_gaps([knot]) == 0
    # A tube that does not meet itself has area 2 pi r L and volume pi r^2 L (Pappus and Guldin).
    t = np.linspace(0, 2 * np.pi, 200_001)
    reach = 1 + 0.5 * np.cos(3 * t)
    line = np.column_stack([reach * np.cos(2 * t), reach * np.sin(2 * t), 0.5 * np.sin(3 * t)])
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    assert area(knot) == pytest.approx(2 * np.pi * 0.2 * length, rel=0.01)
    assert volume(knot) == pytest.approx(np.pi * 0.04 * length, rel=0.02)
    # The tube's own sagitta is the least that the error can be; the bend of the knot adds to it.
    assert 0.2 * (1 - np.cos(np.pi / 24)) < error < 0.02
    finer = torus_knot_mesh(2, 3, segments=480, sides=48)[3]
    assert finer == pytest.approx(error / 4, rel=0.1)


def test_torus_knot_refuses_what_is_no_knot():
    with pytest.raises(InputError, match="common factor"):
        torus_knot_mesh(2, 4)
    with pytest.raises(InputError, match="tube > 0"):
        torus_knot_mesh(tube=0.0)


def test_unit_cube_is_closed_and_looks_inward():
    cube = unit_cube(0.5, 1.0)
    assert cube.closed
    assert [surface.name for surface in cube.surfaces] == list(BOX_SIDES)
    assert closed_scene_gaps(cube.surfaces) == 0
    assert sum(volume(surface) for surface in cube.surfaces) == pytest.approx(-1.0)


def test_quad_light_looks_down_at_a_floor_that_looks_up():
    screen = box_surface("screen", GREY, [-0.1, -0.1, 1], [0.1, 0.1, 1.1])
    scene = quad_light_over_floor(screen)
    floor, light, occluder = scene.surfaces
    assert np.allclose(vector_area(floor.face(0)), [0, 0, 16])
    assert np.allclose(vector_area(light.face(0)), [0, 0, -1])
    assert light.material.emission == pytest.approx(np.pi)
    assert occluder is screen
    assert scene.has_emitter
