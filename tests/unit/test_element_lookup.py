"""The element at a point: against its own definition, on grids, cut polygons, both sides and clusters."""

from __future__ import annotations

import numpy as np
import pytest

import workbench
from radiosity.element_lookup import ElementLookup, element_gradients
from radiosity.patches import build_mesh
from workbench.geometry.flat import Geometry
from workbench.scene.library import diffuse, torus_knot_mesh
from workbench.scene.model import Material, Scene, Surface


def _inside(mesh, piece, points, slack):
    ring = mesh.corners[mesh.piece_start[piece] : mesh.piece_start[piece + 1]]
    depth = np.full(len(points), np.inf)
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        inward = np.cross(mesh.piece_normal[piece], b - a)
        depth = np.minimum(depth, (points - a) @ inward / np.linalg.norm(inward))
    return depth >= -slack


def _random_points(mesh, elements, rng):
    """A point inside a piece of each element, and its piece."""
    piece = rng.integers(mesh.element_piece[elements], mesh.element_piece[elements + 1])
    first = mesh.piece_start[piece]
    fan = rng.integers(1, mesh.piece_start[piece + 1] - first - 1)
    a, b, c = mesh.corners[first], mesh.corners[first + fan], mesh.corners[first + fan + 1]
    u, v = rng.random((2, len(elements), 1))
    swap = u + v > 1
    return a + np.where(swap, 1 - u, u) * (b - a) + np.where(swap, 1 - v, v) * (c - a)


@pytest.mark.parametrize("options", [{"elements": 1500}, {"elements": 60}, {"max_edge": 0.02}], ids=str)
def test_every_point_of_the_cornell_box_finds_its_element(options):
    scene = workbench.load("cornell-box")
    geometry = Geometry.from_scene(scene)
    mesh = build_mesh(scene, geometry, **options)
    lookup = ElementLookup.build(geometry, mesh)
    rng = np.random.default_rng(1)
    element = rng.integers(0, mesh.element_count, 4000)
    points = _random_points(mesh, element, rng)
    found = lookup.elements(points, mesh.element_polygon[element], np.ones(len(points), dtype=bool))
    wrong = np.flatnonzero(found != element)
    # On an edge either neighbour is right.
    for i in wrong.tolist():
        pieces = range(mesh.element_piece[found[i]], mesh.element_piece[found[i] + 1])
        assert any(_inside(mesh, p, points[i : i + 1], 1e-9)[0] for p in pieces)
    assert len(wrong) < 10


def test_a_point_off_the_polygon_gets_a_piece_near_it():
    scene = workbench.load("cornell-box")
    geometry = Geometry.from_scene(scene)
    mesh = build_mesh(scene, geometry, elements=1500)
    lookup = ElementLookup.build(geometry, mesh)
    # A micrometre beyond the corner of the floor, and in the middle of a hole of it.
    points = np.array([[0.5528 + 1e-6, 0.0, -1e-6], [0.18, 0.0, 0.17]])
    found = lookup.elements(points, np.zeros(2, np.int64), np.ones(2, bool))
    assert (mesh.element_polygon[found] == 0).all()
    assert np.linalg.norm(mesh.element_centroid[found[0]] - points[0]) < mesh.element_size[found[0]]


def test_both_sides_of_a_two_sided_polygon_and_the_black_back():
    paint = diffuse("paint", 0.5)
    both = Material(**{**paint.__dict__, "name": "both", "two_sided": True})
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    scene = Scene(
        "two",
        (
            Surface.from_polygons("both", both, [square]),
            Surface.from_polygons("one", paint, [square + [0, 0, 1]]),
        ),
        bands=1,
    )
    geometry = Geometry.from_scene(scene)
    mesh = build_mesh(scene, geometry, max_edge=0.26)
    lookup = ElementLookup.build(geometry, mesh)
    points = np.array([[0.1, 0.6, 0.0], [0.1, 0.6, 1.0]])
    polygon = np.array([0, 1])
    front = lookup.elements(points, polygon, np.array([True, True]))
    back = lookup.elements(points, polygon, np.array([False, False]))
    assert mesh.element_side[front].tolist() == [1, 1] and mesh.element_polygon[front].tolist() == [0, 1]
    assert back[1] == -1 and mesh.element_side[back[0]] == -1 and mesh.element_polygon[back[0]] == 0
    assert np.allclose(mesh.element_centroid[back[0]][:2], mesh.element_centroid[front[0]][:2])


@pytest.mark.parametrize("two_sided", [False, True])
def test_facets_of_clusters_find_their_cluster(two_sided):
    vertices, faces = torus_knot_mesh(segments=60, sides=8)[:2]
    paint = diffuse("paint", 0.5)
    paint = Material(**{**paint.__dict__, "two_sided": two_sided})
    scene = Scene("knot", (Surface.from_mesh("knot", paint, vertices, faces),), bands=1)
    geometry = Geometry.from_scene(scene)
    mesh = build_mesh(scene, geometry, elements=200)
    assert (mesh.element_polygon == -1).any()
    lookup = ElementLookup.build(geometry, mesh)
    first = geometry.piece_start[:-1]
    middle = np.add.reduceat(geometry.corners, first) / np.diff(geometry.piece_start)[:, None]
    for side in (1, -1):
        found = lookup.elements(middle, geometry.piece_polygon, np.full(len(middle), side > 0))
        if side < 0 and not two_sided:
            assert (found == -1).all()
            continue
        assert (found >= 0).all() and (mesh.element_side[found] == side).all()
        owner = np.full(geometry.piece_count, -1)
        for piece in range(len(mesh.piece_element)):
            if mesh.element_side[mesh.piece_element[piece]] == side:
                ring = mesh.corners[mesh.piece_start[piece] : mesh.piece_start[piece + 1]]
                owner[np.argmin(np.abs(middle - ring.mean(axis=0)).sum(axis=1))] = mesh.piece_element[piece]
        assert (owner == found).all()


def test_a_linear_field_is_read_exactly_up_to_the_border():
    scene = workbench.load("cornell-box")
    geometry = Geometry.from_scene(scene)
    mesh = build_mesh(scene, geometry, elements=800)
    lookup = ElementLookup.build(geometry, mesh)
    slope, level = np.array([[1.0, -2.0, 0.5], [0.3, 0.2, 0.1]]), np.array([3.0, 1.0])
    gradient = element_gradients(mesh, lookup, mesh.element_centroid @ slope.T + level)
    # Only what lies in the element's plane can be found.
    normal = mesh.element_normal
    wanted = slope[None] - np.einsum("bk,ek,el->ebl", slope, normal, normal)
    # Inside elements have neighbours all round; a few cut slivers at holes have them in one line only.
    off = np.abs(gradient - wanted).max(axis=(1, 2))
    assert np.mean(off < 1e-6) > 0.97


def test_slopes_never_make_radiosity_negative():
    scene = workbench.load("cornell-box")
    geometry = Geometry.from_scene(scene)
    mesh = build_mesh(scene, geometry, elements=800)
    lookup = ElementLookup.build(geometry, mesh)
    rng = np.random.default_rng(2)
    value = rng.random((mesh.element_count, 1)) ** 8  # as rough as can be
    gradient = element_gradients(mesh, lookup, value)
    element = np.repeat(mesh.piece_element, np.diff(mesh.piece_start))
    corner = value[element] + np.einsum("kbl,kl->kb", gradient[element], mesh.corners - mesh.element_centroid[element])
    assert corner.min() > -1e-9
