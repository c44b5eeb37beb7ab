"""Values at corners: neighbours are joined, creases are kept."""

from __future__ import annotations

import itertools

import numpy as np

from radiosity.interpolation import corner_values
from radiosity.patches import build_mesh
from workbench.geometry.flat import Geometry
from workbench.scene.library import box_surface, diffuse
from workbench.scene.model import Scene, Surface


def meshed(surface, elements=None):
    scene = Scene("test", (surface,), bands=1)
    return build_mesh(scene, Geometry.from_scene(scene), elements=elements)


def test_corner_values_keep_creases_and_join_neighbours():
    mesh = meshed(box_surface("room", diffuse("grey", 0.5), [0, 0, 0], [1, 1, 1], inward=True), elements=24)
    # One value a face: a box edge is a crease, so each corner keeps the value of its own face.
    faces = mesh.element_polygon[:, None].astype(float)
    corner_element = np.repeat(mesh.piece_element, np.diff(mesh.piece_start))
    np.testing.assert_allclose(corner_values(mesh, faces), faces[corner_element], rtol=1e-14)
    # A value linear in position: inside a face four elements meet and their mean is exact there.
    linear = mesh.element_centroid[:, :1] + 2 * mesh.element_centroid[:, 1:2]
    middle = np.isclose(mesh.corners, 0.5).sum(axis=1) == 2
    assert middle.sum() == 6 * 4
    expected = mesh.corners[middle, :1] + 2 * mesh.corners[middle, 1:2]
    np.testing.assert_allclose(corner_values(mesh, linear)[middle], expected, rtol=1e-12)


def test_corner_values_join_the_facets_of_a_curved_surface():
    angle = np.radians(np.arange(0, 181, 10))
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    facets = [[[*a, 0], [*b, 0], [*b, 1], [*a, 1]] for a, b in itertools.pairwise(rim)]
    half = meshed(Surface.from_polygons("pipe", diffuse("grey", 0.5), [np.array(facet) for facet in facets]))
    values = corner_values(half, half.element_centroid[:, :1])
    top = np.isclose(half.corners[:, 0], 0, atol=1e-12)  # two facets meet at the crown, mirrored about x = 0
    assert top.sum() == 4
    np.testing.assert_allclose(values[top], 0, atol=1e-12)
