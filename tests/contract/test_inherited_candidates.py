"""The law of cullers, for hierarchical links: lists handed down from pair to pair may only save work.

The candidates of a pair of parts come from those of the whole pair, again and again; brute force looks
for a ray between the parts that a polygon outside their list blocks.
"""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from radiosity_scenes import polygon_scene
from test_link_cullers import some_polygons

from radiosity.form_factors import _links
from radiosity.hierarchy import Hierarchy
from radiosity.solvers._pairs import _ahead, _turned_away, candidates
from workbench.accel.box_tree import BoxTree
from workbench.accel.brute import BruteForce
from workbench.culling.tally import new_tally
from workbench.geometry.flat import Geometry


class Nodes:
    """The tree over some polygons, two levels of parts made below each."""

    def __init__(self, polygons):
        self.scene = polygon_scene(*polygons)
        self.geometry = Geometry.from_scene(self.scene)
        self.tree = Hierarchy(self.scene, self.geometry)
        self.tree.open(self.tree.leaves())
        self.tree.open(self.tree.leaves())
        self.occluders = _links.occluder_arrays(self.geometry, BoxTree.build(self.geometry))
        self.found = np.empty(_links.MAX_CANDIDATES, dtype=np.int64)
        self.planes = np.empty((40, 4))

    def ahead(self, a, b):
        arrays, slack = self.tree.arrays, self.occluders.slack
        return _ahead(a, b, arrays, slack) and _ahead(b, a, arrays, slack)

    def candidates(self, a, b, given=None):
        listed = np.zeros(_links.MAX_CANDIDATES, dtype=np.int64)
        many = -1
        if given is not None:
            listed[: len(given)], many = given, len(given)
        count = candidates(a, b, self.tree.arrays, self.occluders, listed, many, self.found, self.planes, new_tally())
        assert count >= 0
        return self.found[:count].copy()

    def ring(self, node):
        arrays = self.tree.arrays
        piece = arrays.piece0[node]
        return arrays.corners[arrays.starts[piece] : arrays.starts[piece + 1]]

    def parts(self, node):
        arrays = self.tree.arrays
        return range(arrays.child[node], arrays.child[node] + arrays.children[node])

    def segments(self, rng, a, b, count):
        ends = []
        for node in (a, b):
            ring = self.ring(node)
            share = rng.exponential(size=(count, len(ring)))
            share[rng.random(count) < 0.2, 2:] *= 1e-3  # near an edge, now and then
            ends.append((share / share.sum(axis=1)[:, None]) @ ring)
        along = ends[1] - ends[0]
        facing = along @ self.tree.arrays.normal[a] > 1e-8
        facing &= along @ self.tree.arrays.normal[b] < -1e-8
        return ends[0][facing], along[facing]


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_inherited_lists_contain_every_blocker(seed):
    rng = np.random.default_rng(seed)
    nodes = Nodes(some_polygons(rng))
    arrays = nodes.tree.arrays
    polygons = nodes.geometry.piece_polygon
    single = np.flatnonzero((arrays.flat == 1) & (arrays.area > 0) & (arrays.piece1 - arrays.piece0 == 1))
    roots = [int(n) for n in single if n < nodes.tree.node_count and arrays.flat[arrays.parent[n]] == 0]
    centre = nodes.geometry.bounds.mean(axis=0)
    for _ in range(12):
        a, b = rng.choice(roots, 2, replace=False)
        listed = None
        # Down the tree, one end at a time, the list always taken from the pair above.
        for _ in range(4):
            if arrays.polygon[a] == arrays.polygon[b]:
                break
            origins, along = nodes.segments(rng, a, b, 60)
            if not nodes.ahead(a, b):
                assert len(origins) == 0
                break
            before, listed = listed, nodes.candidates(a, b, listed)
            assert before is None or set(listed) <= set(before)
            kept = {*polygons[listed].tolist(), int(arrays.polygon[a]), int(arrays.polygon[b])}
            dropped = [nodes.geometry.piece(i) for i in range(nodes.geometry.piece_count) if polygons[i] not in kept]
            if dropped and len(origins):
                tracer = BruteForce(Geometry.from_scene(polygon_scene(*[ring - centre for ring in dropped])))
                # Ends a hair off the surfaces: touching blocks nothing.
                assert not tracer.occluded(origins - centre + 1e-5 * along, along, 1 - 2e-5).any()
            if rng.random() < 0.5 and arrays.children[a]:
                a = int(rng.choice(nodes.parts(a)))
            elif arrays.children[b]:
                b = int(rng.choice(nodes.parts(b)))


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_clusters_that_turn_away_exchange_nothing(seed):
    rng = np.random.default_rng(seed)
    nodes = Nodes(some_polygons(rng))
    arrays = nodes.tree.arrays
    clusters = [n for n in range(nodes.tree.node_count) if arrays.flat[n] == 0]
    for a in clusters:
        for b in range(0, nodes.tree.node_count, 3):
            if a == b or not _turned_away(a, b, arrays):
                continue
            for p in range(arrays.piece0[a], arrays.piece1[a]):
                start = arrays.corners[arrays.starts[p] : arrays.starts[p + 1]]
                for q in range(arrays.piece0[b], arrays.piece1[b]):
                    end = arrays.corners[arrays.starts[q] : arrays.starts[q + 1]]
                    height = (end[None] - start[:, None]) @ arrays.piece_normal[p]
                    assert height.max() <= 1e-9 * (1.0 + np.abs(end).max())
