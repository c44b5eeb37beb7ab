"""The law of cullers for whole groups of pairs: what a node's candidates leave out blocks nothing.

Two judges: the same matrix with every occluder a candidate of every pair, and rays.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from radiosity_scenes import polygon_scene
from view_factor_scenes import closed_room

import radiosity
from radiosity.form_factors import matrix
from radiosity.form_factors.bundle import LinkSettings
from radiosity.form_factors.directional import RAYS_A_BUNDLE, DirectionalBundles
from radiosity.form_factors.matrix import _Care, _Elements, _Engine
from radiosity.patches import build_mesh
from workbench.geometry.coplanar import join_coplanar
from workbench.geometry.flat import Geometry
from workbench.scene.library import diffuse
from workbench.scene.model import Scene, Surface


def sheets(rng, count, lattice):
    """Rectangles cut into triangles, anywhere or on a coarse lattice (touching, coplanar, crossing)."""
    surfaces = []
    for number in range(count):
        if lattice:
            axis = rng.integers(0, 3)
            low = rng.integers(-2, 3, 3) / 2.0
            u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            u, v = u * rng.integers(1, 4) / 2.0, v * rng.integers(1, 4) / 2.0
        else:
            low = rng.uniform(-1, 1, 3)
            turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            u, v = turn[0] * rng.uniform(0.3, 2), turn[1] * rng.uniform(0.3, 2)
        if rng.random() < 0.5:
            u, v = v, u
        n = int(rng.integers(1, 4))
        triangles = []
        for i in range(n):
            for j in range(n):
                a, b, c, d = (low + (i + p) / n * u + (j + q) / n * v for p, q in ((0, 0), (1, 0), (1, 1), (0, 1)))
                triangles += [np.array([a, b, c]), np.array([a, c, d])]
        surfaces.append(Surface.from_polygons(f"sheet {number}", diffuse("paint", 0.5), triangles))
    return Scene("sheets", tuple(surfaces), bands=1)


def exchanges(scene, error=2e-2):
    geometry = Geometry.from_scene(scene)
    elements = _Elements.of_polygons(geometry)
    engine = _Engine(elements, geometry, _Care.for_error(error, elements.element_count), 0)
    found = {}
    owner = engine.pieces.owner.astype(np.int32)
    for node in engine.tree.stripes.tolist():
        i, j, value, doubt, *_ = engine.stripe(node, owner, np.ones(engine.pieces.count))
        found |= {(min(a, b), max(a, b)): (v, e) for a, b, v, e in zip(i, j, value, doubt, strict=True)}
    return found


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_groups_settle_only_what_single_pairs_would(seed):
    # With leaves of one piece and no tree to speak of above them every pair asks every occluder itself.
    rng = np.random.default_rng(seed)
    scene = sheets(rng, rng.integers(3, 8), rng.random() < 0.6)
    if rng.random() < 0.3:
        scene = Scene(
            "moved",
            tuple(
                Surface.from_polygons(s.name, s.material, [ring + [1e3, -2e3, 1e3] for (ring,) in s.faces()])
                for s in scene.surfaces
            ),
            bands=1,
        )
    grouped = exchanges(scene)
    with pytest.MonkeyPatch.context() as patch:
        # A node whose box is the whole scene's settles nothing.
        build = matrix._build_tree

        def flat(pieces):
            tree, order = build(pieces)
            tree.low[:], tree.high[:] = tree.low.min(axis=0) - 1, tree.high.max(axis=0) + 1
            tree.group[:] = -1
            return tree, order

        patch.setattr(matrix, "_build_tree", flat)
        alone = exchanges(scene)
    for pair in grouped.keys() | alone.keys():
        (one, doubt), (other, also) = grouped.get(pair, (0.0, 0.0)), alone.get(pair, (0.0, 0.0))
        # A candidate more may have a clear pair sampled: then the sample's stated error stands between them.
        assert abs(one - other) <= 3 * max(doubt, also) + 1e-9, pair


@settings(max_examples=12, deadline=None, derandomize=True)  # statistics: the same scenes each time
@given(seed=st.integers(0, 2**32 - 1))
def test_matrices_agree_with_rays(seed):
    rng = np.random.default_rng(seed)
    scene = sheets(rng, 6, False)
    found = radiosity.view_factors(scene, error=1e-3)
    geometry = Geometry.from_scene(scene)
    mesh = build_mesh(scene, geometry, split=1, cluster=False)
    bundles = DirectionalBundles(geometry, mesh, LinkSettings(rays=400), 2)
    columns = bundles.columns(np.arange(mesh.patch_count))
    bundles.close()
    stated = found.standard_error if not found.sparse else found.standard_error.toarray()
    off = np.abs(columns.factor.T - found.dense())
    # The scatter of few hits is no standard error: theirs is that of counts, of bundles that hit or miss together.
    weight = RAYS_A_BUNDLE * mesh.patch_area[None, :] / mesh.element_area[:, None] / (400 * mesh.element_count)
    noise = np.maximum(columns.spread.T, np.sqrt(found.dense() * weight) + weight)
    allowed = 5 * noise + 5 * stated
    assert (off <= allowed).all(), np.argwhere(off > allowed)[:3]


def test_joined_occluders_hide_what_their_parts_hide():
    # Coplanar triangles become one polygon; a floor with two holes becomes a few convex ones.
    scene = closed_room(0.6)
    geometry = Geometry.from_scene(scene)
    joined = join_coplanar(geometry)
    assert joined.count < 30 < geometry.piece_count
    area = 0.0
    for k in range(joined.count):
        ring = joined.corners[joined.start[k] : joined.start[k + 1]]
        area += np.linalg.norm(0.5 * np.cross(ring - ring[0], np.roll(ring, -1, axis=0) - ring[0]).sum(axis=0))
        assert np.abs(ring @ joined.normal[k] - joined.offset[k]).max() < 1e-9
    assert area == pytest.approx(geometry.polygon_area.sum(), rel=1e-9)


@pytest.mark.parametrize("second", ["beside", "over", "apart", "lifted", "clear"])
def test_joining_takes_only_what_lies_in_one_plane(second):
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    moved = {"beside": [1, 0, 0], "over": [0.5, 0, 0], "apart": [3, 0, 0], "lifted": [1, 0, 1e-6], "clear": [1, 0, 0]}
    scene = polygon_scene(square, square + moved[second])
    if second == "clear":
        glass = diffuse("glass", 0.0)
        glass = type(glass)(**{**glass.__dict__, "transmittance": np.array([0.5])})
        scene = Scene(
            "glass", (scene.surfaces[0], Surface.from_polygons("pane", glass, [square + moved[second]])), bands=1
        )
    joined = join_coplanar(Geometry.from_scene(scene))
    assert joined.count == (1 if second in ("beside", "over") else 2)
    assert len(np.unique(joined.group)) == (2 if second in ("lifted", "clear") else 1)
