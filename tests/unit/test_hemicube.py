"""Hemicubes: delta form factors, what a point sees, and where they fail, numbered."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from workbench.counters import Counters
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.scene.model import Material, Scene, Surface
from workbench.shadow.hemicube import hemicube_deltas, hemicube_directions, hemicube_items

NOTHING = np.zeros(3)
BLACK = Material("black", NOTHING, NOTHING, NOTHING, np.inf, NOTHING)
UP = [0.0, 0.0, 1.0]


def geometry_of(*polygons) -> Geometry:
    polygons = [np.asarray(polygon, dtype=float) for polygon in polygons]
    return Geometry.from_scene(Scene("test", (Surface.from_polygons("all", BLACK, polygons),)))


def form_factors(point, normal, geometry, resolution=50, **options) -> np.ndarray:
    items = hemicube_items(point, normal, geometry, resolution=resolution, **options)[0]
    return np.bincount(items + 1, hemicube_deltas(resolution), minlength=geometry.polygon_count + 1)[1:]


def share(polygon, point=(0, 0, 0), normal=UP) -> float:
    """Form factor from a point to a polygon above its horizon, by Lambert's formula."""
    corners = np.asarray(polygon, dtype=float) - point
    normal = np.asarray(normal) / np.linalg.norm(normal)
    total = 0.0
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        across = np.cross(a, b)
        length = np.linalg.norm(across)
        if length > 0:
            total += np.arctan2(length, a @ b) * (across @ normal) / length
    return abs(total) / (2 * np.pi)


def square(x0, x1, y0, y1, z) -> list:
    return [[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]]


ROOM = (
    square(-1, 1, -1, 1, 1),  # above
    [[1, -1, 0], [1, 1, 0], [1, 1, 1], [1, -1, 1]],
    [[-1, 1, 0], [-1, -1, 0], [-1, -1, 1], [-1, 1, 1]],
    [[1, 1, 0], [-1, 1, 0], [-1, 1, 1], [1, 1, 1]],
    [[-1, -1, 0], [1, -1, 0], [1, -1, 1], [-1, -1, 1]],
)


def test_6_13_deltas_sum_to_one_as_the_faces_do():
    # Sums of midpoint deltas, and exact shares of the faces (they are the walls of ROOM).
    for resolution, total in ((16, 1.0021231811580404), (50, 1.0002168492032668), (100, 1.000054200312341)):
        deltas = hemicube_deltas(resolution)
        assert deltas.shape == (3 * resolution**2,)
        assert deltas.sum() == pytest.approx(total, rel=1e-12)
        assert hemicube_deltas(resolution, normalised=True).sum() == pytest.approx(1, rel=1e-14)
        top = deltas[: resolution**2].sum()
        sides = deltas[resolution**2 :].reshape(4, -1).sum(axis=1)
        assert top == pytest.approx(share(ROOM[0]), rel=0.4 / resolution**2)
        assert sides == pytest.approx(np.full(4, share(ROOM[1])), rel=2 / resolution**2)
    assert share(ROOM[0]) == pytest.approx(0.554126423979572, rel=1e-12)
    assert share(ROOM[1]) == pytest.approx(0.111468394005107, rel=1e-12)
    # The excess falls as 1 / resolution^2.
    excess = [hemicube_deltas(resolution).sum() - 1 for resolution in (50, 100)]
    assert excess[0] / excess[1] == pytest.approx(4, rel=0.01)


def test_6_13_each_wall_of_its_own_room_fills_one_face():
    items = hemicube_items([0, 0, 0], UP, geometry_of(*ROOM), resolution=50)[0]
    assert (items[:2500] == 0).all()
    for face, wall in enumerate((1, 3, 2, 4)):  # +x, +y, -x, -y in the frame of the hemicube
        found = np.unique(items[2500 + 1250 * face : 2500 + 1250 * (face + 1)])
        assert len(found) == 1 and 1 <= found[0] <= 4, wall
    sums = form_factors([0, 0, 0], UP, geometry_of(*ROOM))
    assert sums[1:] == pytest.approx(np.full(4, 0.111468394), rel=1e-3)


def test_6_14_a_patch_smaller_than_a_pixel_gets_nothing_or_too_much():
    delta = hemicube_deltas(50)[25 * 50 + 25]
    assert delta == pytest.approx(0.0005084819213914091, rel=1e-12)
    missed = square(-0.005, 0.005, -0.005, 0.005, 1)  # right above, between four pixels
    hit = square(0.015, 0.025, 0.015, 0.025, 1)  # over one pixel's centre
    assert share(missed) == pytest.approx(3.182992762255991e-05, rel=1e-9)
    assert form_factors([0, 0, 0], UP, geometry_of(missed))[0] == 0.0
    assert form_factors([0, 0, 0], UP, geometry_of(hit))[0] == delta  # 16 times too much
    # Turned at random the hemicubes are right on average.
    items = hemicube_items(np.zeros((2000, 3)), np.tile(UP, (2000, 1)), geometry_of(hit), resolution=50, seed=1)
    found = (items == 0) @ hemicube_deltas(50)
    assert set(np.round(found / delta, 1)) <= {0.0, 1.0}
    assert found.mean() < 0.3 * delta


def test_6_15_the_centre_of_a_touching_patch_is_not_its_mean():
    # Perpendicular unit squares that share an edge: F = 0.20004; from the centre of one it is
    # 0.19014, and the hemicube converges to that, not to F.
    wall = [[0, 0, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1]]
    centre = np.array([0.5, 0.5, 0])
    assert share(wall, centre) == pytest.approx(0.1901358823848066, rel=1e-12)
    errors = [abs(form_factors(centre, UP, geometry_of(wall), n)[0] - share(wall, centre)) for n in (10, 50, 250)]
    assert errors[2] < 1e-3 and errors[2] < errors[0] / 15  # as 1 / resolution
    # Subdividing the patch closes the gap: 16 x 16 cells leave 0.1 %.
    cells = (np.arange(16) + 0.5) / 16
    points = np.column_stack([np.repeat(cells, 16), np.tile(cells, 16), np.zeros(256)])
    items = hemicube_items(points, np.tile(UP, (256, 1)), geometry_of(wall), resolution=50)
    mean = ((items == 0) @ hemicube_deltas(50)).mean()
    assert mean == pytest.approx(0.20004377607540316, rel=2e-3)


def test_the_nearest_polygon_is_seen_as_rays_see_it():
    rng = np.random.default_rng(7)
    triangles = rng.uniform(-2, 2, (40, 1, 3)) + rng.normal(0, 0.8, (40, 3, 3))
    geometry = geometry_of(*triangles)
    points, normals = rng.uniform(-0.5, 0.5, (3, 3)), rng.normal(size=(3, 3))
    items = hemicube_items(points, normals, geometry, resolution=20, seed=3)
    # Directions in space: the frames are found again from the first side's own pixel rows.
    turns = _turns(normals, 3)
    local = hemicube_directions(20)
    for k in range(3):
        normal = normals[k] / np.linalg.norm(normals[k])
        frame = np.stack([turns[k], np.cross(normal, turns[k]), normal])
        assert np.array_equal(items[k], nearest(points[k], local @ frame, triangles))


def _turns(normals, seed):
    """The side directions that the random turn gives, as documented: plane_basis turned by an angle."""
    from workbench.geometry.polygons import plane_basis

    normals = normals / np.linalg.norm(normals, axis=1)[:, None]
    angle = 2 * np.pi * np.random.default_rng(seed).random((len(normals), 1))
    first = np.array([plane_basis(normal)[0] for normal in normals])
    return np.cos(angle) * first + np.sin(angle) * np.cross(normals, first)


def nearest(point, ways, triangles) -> np.ndarray:
    best, owner = np.full(len(ways), np.inf), np.full(len(ways), -1)
    for index, (a, b, c) in enumerate(triangles):
        p = np.cross(ways, c - a)
        det = p @ (b - a)
        u = (p @ (point - a)) / det
        q = np.cross(point - a, b - a)
        v, t = (ways @ q) / det, (q @ (c - a)) / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < best)
        best[hit], owner[hit] = t[hit], index
    return owner


def test_a_closed_room_is_seen_whole_and_form_factors_sum_to_one():
    ball = trimesh.creation.icosphere(subdivisions=3)
    geometry = Geometry.from_scene(Scene("s", (Surface.from_mesh("s", BLACK, ball.vertices, ball.faces),)))
    rng = np.random.default_rng(2)
    points, normals = rng.uniform(-0.5, 0.5, (20, 3)), rng.normal(size=(20, 3))
    counters = Counters()
    items = hemicube_items(points, normals, geometry, resolution=32, seed=5, counters=counters)
    assert (items >= 0).all()
    assert counters["camera_renders"] == 100
    assert counters["camera_polygons"] > 20 * 300
    again = hemicube_items(points, normals, geometry, resolution=32, seed=5, workers=1)
    assert np.array_equal(items, again)
    # A hemicube that leans sees out of the open room, and its lid as large as the closed form says.
    room, point, lean = geometry_of(*ROOM), [0.3, -0.2, 0.1], [0.2, 0.1, 1]
    found = form_factors(point, lean, room, 200)
    assert found[0] == pytest.approx(share(ROOM[0], point, lean), abs=2e-3)
    assert 0.9 < found.sum() < 0.999


def test_a_points_own_polygon_is_not_seen():
    floor, lid = square(-1, 1, -1, 1, 1e-6), square(-9, 9, -9, 9, 1)
    geometry = geometry_of(floor, lid)
    assert form_factors([0, 0, 0], UP, geometry)[0] > 0.99
    assert form_factors([0, 0, 0], UP, geometry, own_polygon=[0])[0] == 0.0
    assert form_factors([0, 0, 0], UP, geometry, own_polygon=[0])[1] == pytest.approx(share(lid), abs=2e-3)
    level = geometry_of(square(-1, 1, -1, 1, 0), lid)
    assert form_factors([0, 0, 0], UP, level)[0] == 0.0


def test_bad_input_is_refused():
    with pytest.raises(OptionError, match="resolution: found 7, expected an even number"):
        hemicube_deltas(7)
    with pytest.raises(InputError, match="normals: found 2 rows, expected 1"):
        hemicube_items([0, 0, 0], [UP, UP], geometry_of(*ROOM))
    with pytest.raises(InputError, match="own_polygon: found shape"):
        hemicube_items([0, 0, 0], UP, geometry_of(*ROOM), own_polygon=[1, 2])
    assert (hemicube_items([0, 0, 0], UP, geometry_of(), resolution=4) == -1).all()
