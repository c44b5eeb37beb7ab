"""A scene as flat arrays: whole meshes at once give what face by face does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trace_scenes import material, scene

from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import convex_pieces, is_convex, vector_area
from workbench.scene.model import Surface


def flat_quad(rng, concave):
    """A quad in a random plane: corners at growing angles about a middle, one pulled in to make it concave."""
    angle = np.sort(rng.uniform(0, 2 * np.pi, 4)) if rng.random() < 0.5 else np.arange(4) * np.pi / 2
    flat = np.column_stack([np.cos(angle), np.sin(angle)]) * rng.uniform(0.5, 2)
    if concave:
        flat = np.array([[1.0, 0.0], [0.1, 0.1], [0.0, 1.0], [-1.0, -1.0]]) * rng.uniform(0.5, 2)
    u, v = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
    return flat[:, :1] * u + flat[:, 1:] * v + rng.normal(size=3) * 10.0 ** rng.integers(0, 4)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 6), concave=st.booleans())
@settings(max_examples=40, deadline=None)
def test_quad_meshes_are_cut_as_their_faces_are(seed, count, concave):
    rng = np.random.default_rng(seed)
    quads = [flat_quad(rng, concave and i == 0) for i in range(count)]
    whole = Geometry.from_scene(scene([Surface.from_polygons("mesh", material(), quads)]))
    pieces = [convex_pieces([quad]) for quad in quads]
    np.testing.assert_array_equal(whole.corners, np.concatenate([corner for found in pieces for corner in found]))
    np.testing.assert_array_equal(whole.piece_polygon, np.repeat(np.arange(count), [len(found) for found in pieces]))
    np.testing.assert_allclose(whole.polygon_area, [np.linalg.norm(vector_area([quad])) for quad in quads], rtol=1e-12)
    assert whole.piece_count == count + (concave and len(pieces[0]) - 1)


@pytest.mark.parametrize(
    ("ring", "convex"),
    [
        ([(0, 0), (1, 0), (1, 1), (0, 1)], True),
        ([(0, 0), (1, 0), (2, 0), (0, 1)], True),  # a corner on an edge
        ([(0, 0), (1, 0), (0.2, 0.2), (0, 1)], False),
        ([(0, 1), (1, 1), (1, 0), (0, 0)], False),  # clockwise
        ([(np.cos(a), np.sin(a)) for a in 4 * np.pi / 5 * np.arange(5)], False),  # a pentagram turns twice
    ],
)
def test_convex_rings(ring, convex):
    corners = np.column_stack([np.asarray(ring, dtype=float), np.zeros(len(ring))])
    assert is_convex(corners, np.array([0.0, 0.0, 1.0])) == convex
