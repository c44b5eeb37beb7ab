"""The law of cullers, for form factors: shafts, pyramids and certificates of darkness may only save work.

Each dropped polygon is put before brute force, and form factors with culling equal those for which every
polygon was a candidate.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_scenes import nasty_polygons, rectangle
from radiosity_scenes import all_columns, polygon_scene, tight

from radiosity.form_factors import _links
from radiosity.form_factors.analytic import polygon_to_polygon
from radiosity.patches import build_mesh
from workbench.accel.box_tree import BoxTree
from workbench.accel.brute import BruteForce
from workbench.culling.tally import new_tally
from workbench.geometry.flat import Geometry


def lattice_polygons(rng, count):
    """Rectangles and triangles on a coarse lattice: flat boxes, touching, coplanar and crossing ones."""
    polygons = []
    while len(polygons) < count:
        axis, low = rng.integers(0, 3), rng.integers(-2, 3, 3) / 2.0
        polygon = np.tile(low, (4, 1))
        size = rng.integers(1, 5, 2) / 2.0
        polygon[[1, 2], (axis + 1) % 3] += size[0]
        polygon[[2, 3], (axis + 2) % 3] += size[1]
        if rng.random() < 0.3:
            polygon[2, axis] += 0.5
            polygon = polygon[:3]
        polygons.append(polygon if rng.random() < 0.5 else polygon[::-1].copy())
    return polygons


def some_polygons(rng):
    """Random polygons, one element and one patch each; sometimes far from the origin."""
    if rng.random() < 0.5:
        polygons = lattice_polygons(rng, rng.integers(3, 10))
    else:
        polygons = nasty_polygons(rng, rng.integers(3, 10), np.zeros((1, 3)))
        polygons = [p for p in polygons if np.abs(p).max() < 30.0] + lattice_polygons(rng, 2)
    if rng.random() < 0.3:
        polygons = [p + [1e5, -2e5, 1e5] for p in polygons]
    if rng.random() < 0.2:
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        polygons = [p @ turn.T for p in polygons]
    return polygons


class Setup:
    """A scene flattened for the kernels, one element a polygon."""

    def __init__(self, polygons):
        self.scene = polygon_scene(*polygons)
        self.geometry = Geometry.from_scene(self.scene)
        self.mesh = build_mesh(self.scene, self.geometry)
        self.occluders = _links.occluder_arrays(self.geometry, BoxTree.build(self.geometry))
        self.arrays = _links.mesh_arrays(self.mesh)
        self.work = _links.workspace(4)
        self.tally = new_tally()

    def ring(self, element):
        a, b = self.mesh.piece_start[self.mesh.element_piece[element] : self.mesh.element_piece[element] + 2]
        return self.mesh.corners[a:b]

    def candidates(self, receiver, sender):
        """What the group's shaft leaves; ``None`` where facing settles the pair before."""
        m = self.arrays
        if not (
            _links._group_faces(receiver, sender, m, self.occluders.slack)
            and _links._group_faces(sender, receiver, m, self.occluders.slack)
        ):
            return None
        count = _links._shaft_candidates(
            m.patch_bounds[receiver], True, m.patch_normal[receiver], self.ring(receiver)[0], m.polygon[receiver],
            receiver, sender, self.occluders, m, self.work.found, self.work, self.tally,
        )  # fmt: skip
        assert count >= 0
        return self.work.found[:count].copy()

    def off_the_planes_of(self, *elements):
        """Pieces but those that lie in an element's plane: over or under it is a matter of rounding."""
        keep = np.ones(self.geometry.piece_count, dtype=bool)
        for element in elements:
            for i in range(self.geometry.piece_count):
                height = (self.geometry.piece(i) - self.ring(element)[0]) @ self.mesh.element_normal[element]
                keep[i] &= np.abs(height).max() > 1e-8
        return np.flatnonzero(keep)

    def point_share(self, point, receiver, sender, found):
        m, g, w = self.arrays, self.occluders, self.work
        visible, _ = _links._point_share(
            *point, *m.normal[receiver], m.polygon[receiver], m.patch_polygon[sender], m.patch_sender[sender],
            m.patch_sender[sender + 1], m.sender_corners, m.sender_start, m.sender_normal, g.corners, g.piece_start,
            g.piece_polygon, g.through, g.slack, found, len(found), len(found) + 1, w.planes, w.picked, w.boxes,
            w.sizes, w.weights, w.cut, self.tally,
        )  # fmt: skip
        return visible

    def segments(self, rng, receiver, sender, count):
        """Segments between random points of two elements that face each other along them."""
        ends = []
        for element in (receiver, sender):
            ring = self.ring(element)
            share = rng.exponential(size=(count, len(ring)))
            share[rng.random(count) < 0.2, 2:] *= 1e-3  # near an edge, now and then
            ends.append((share / share.sum(axis=1)[:, None]) @ ring)
        along = ends[1] - ends[0]
        # Above each other's plane by more than the rounding of coordinates of 1e5.
        facing = along @ self.mesh.element_normal[receiver] > 1e-8
        facing &= along @ self.mesh.element_normal[sender] < -1e-8
        return ends[0][facing], along[facing]


def pairs(setup):
    for receiver in range(setup.mesh.element_count):
        for sender in range(setup.mesh.element_count):
            if receiver != sender:
                yield receiver, sender


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_shafts_drop_no_polygon_that_blocks_a_ray(seed):
    rng = np.random.default_rng(seed)
    setup = Setup(some_polygons(rng))
    for receiver, sender in pairs(setup):
        origins, along = setup.segments(rng, receiver, sender, 60)
        found = setup.candidates(receiver, sender)
        if found is None:
            # Facing settled it: no segment may leave both fronts by more than rounding.
            assert len(origins) == 0
            continue
        polygons = setup.geometry.piece_polygon
        kept = set(polygons[found].tolist()) | {
            setup.mesh.element_polygon[receiver],
            setup.mesh.element_polygon[sender],
        }
        dropped = [setup.geometry.piece(i) for i in range(setup.geometry.piece_count) if polygons[i] not in kept]
        if not dropped or len(origins) == 0:
            continue
        centre = setup.geometry.bounds.mean(axis=0)
        tracer = BruteForce(Geometry.from_scene(polygon_scene(*[ring - centre for ring in dropped])))
        # Ends a hair off the surfaces: touching blocks nothing.
        hit = tracer.occluded(origins - centre + 1e-5 * along, along, 1 - 2e-5)
        assert not hit.any()


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_form_factors_equal_those_with_every_polygon_a_candidate(seed):
    rng = np.random.default_rng(seed)
    polygons = some_polygons(rng)
    setup = Setup(polygons)
    rounding = 1e-10 * (1.0 + np.abs(setup.geometry.bounds).max() * 1e-3 / setup.geometry.size)
    for receiver, sender in pairs(setup):
        found = setup.candidates(receiver, sender)
        if found is None:
            found = np.empty(0, dtype=np.int64)
        everything = setup.off_the_planes_of(receiver, sender)
        found = np.intersect1d(found, everything)
        points = setup.segments(rng, receiver, sender, 6)[0]
        for point in points:
            culled = setup.point_share(point, receiver, sender, found)
            full = setup.point_share(point, receiver, sender, everything)
            if culled >= 0 and full >= 0:
                assert culled == pytest.approx(full, abs=rounding), (receiver, sender)


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_pair_declared_dark_lets_no_ray_pass(seed):
    rng = np.random.default_rng(seed)

    # Ends that face each other, blockers between them, all a bit irregular.
    def quad(z, half, tilt):
        ring = rectangle(-half, half, -half, half, 0.0) + half * rng.uniform(-0.3, 0.3, (4, 3)) * [1, 1, 0]
        turn = np.linalg.qr(np.eye(3) + tilt * rng.normal(size=(3, 3)))[0]
        return ring @ (turn * np.sign(np.diag(turn))).T + [*rng.uniform(-0.1, 0.1, 2), z]

    ends = [quad(0.0, rng.uniform(0.1, 0.6), 0.1), quad(1.0, rng.uniform(0.1, 0.6), 0.1)[::-1]]
    blockers = [quad(rng.uniform(0.2, 0.8), rng.uniform(0.2, 1.0), 0.2) for _ in range(rng.integers(1, 4))]
    if rng.random() < 0.2:
        ends, blockers = [e + 1e5 for e in ends], [b + 1e5 for b in blockers]
    blockers = [b[::-1] if rng.random() < 0.5 else b for b in blockers]
    setup = Setup([*ends, *blockers])
    found = setup.candidates(0, 1)
    g, m = setup.occluders, setup.arrays
    dark = _links._group_is_dark(
        g.corners, g.piece_start, g.through, found, len(found), m.sender_corners, m.sender_start[0], m.sender_start[1],
        m.sender_start[1], m.sender_start[2], g.slack,
    )  # fmt: skip
    shift = ends[0][0]
    tracer = BruteForce(Geometry.from_scene(polygon_scene(*[b - shift for b in blockers])))
    origins, along = setup.segments(rng, 0, 1, 400)
    blocked = tracer.occluded(origins - shift, along, 1.0)
    corner_rays = np.array([[p, q - p] for p in ends[0] for q in ends[1]])
    each = [
        BruteForce(Geometry.from_scene(polygon_scene(setup.geometry.piece(i) - shift))).occluded(
            corner_rays[:, 0] - shift, corner_rays[:, 1], 1.0
        )
        for i in range(2, setup.geometry.piece_count)
    ]
    if dark:
        assert blocked.all()
    else:
        # Nor is it declared too rarely: no convex piece meets every ray between corners.
        assert not any(one.all() for one in each)


@pytest.mark.parametrize("shift", [0.0, 1e3, 1e5])
@pytest.mark.parametrize("turn", [0.0, 0.2, 0.7])
def test_sheets_of_two_polygons_back_to_back_anywhere(shift, turn):
    # Failure mode 4.10 for cullers: what lies in an end's plane blocks nothing, also where coordinates are
    # so large that the plane is known to 1e-11 of the sheet only.
    lower, upper = rectangle(0, 1, 0, 1, 0.0), rectangle(0.2, 1.4, 0.1, 1, 0.8)[::-1]
    beside = rectangle(1, 2, 0, 1, 0.0)
    c, s = np.cos(turn), np.sin(turn)
    frame = np.array([[c, -s, 0], [s * c, c * c, -s], [s * s, s * c, c]])
    rings = [ring @ frame.T + shift for ring in (lower, lower[::-1], upper, upper[::-1], beside)]
    columns, _, _ = all_columns(polygon_scene(*rings), tight(1e-4, levels=4))
    assert columns.factor[2, 0] == pytest.approx(polygon_to_polygon(lower, upper), rel=1e-5)
    assert columns.factor[0, 2] == pytest.approx(polygon_to_polygon(upper, lower), rel=1e-5)
    assert columns.factor[1].max() == columns.factor[3].max() == 0.0


def test_shafts_and_certificates_save_work():
    # Failure mode 2.1: 121 small squares between two unit squares, of which 25 meet the shaft.
    ends = [rectangle(-0.5, 0.5, -0.5, 0.5, 0.0), rectangle(-0.5, 0.5, -0.5, 0.5, 1.0)[::-1]]
    grid = [
        rectangle(i / 4 - 0.05, i / 4 + 0.05, j / 4 - 0.05, j / 4 + 0.05, 0.5)
        for i in range(-5, 6)
        for j in range(-5, 6)
    ]
    setup = Setup([*ends, *grid])
    assert len(setup.candidates(0, 1)) == 25
    for half, dark in ((0.6, True), (0.5, True), (0.45, False)):
        blocker = rectangle(-half, half, -half, half, 0.5)
        columns, _, bundles = all_columns(polygon_scene(*ends, blocker), tight(1e-3))
        # The whole wall settles the pair of ends for good; a smaller one is cut from the sender point by point.
        assert (bundles.counters["exact_cuts"] == 0) == dark
        assert (columns.factor[1, 0] == 0) == dark


@settings(max_examples=15, deadline=None, derandomize=True)  # statistics: the same scenes each time
@given(seed=st.integers(0, 2**32 - 1))
def test_whole_columns_agree_with_rays(seed):
    # The end of the chain: facing, shafts, certificates, cuts and quadrature together.  The form factor is the
    # chance that a cosine-distributed ray first meets the sender's front.
    rng = np.random.default_rng(seed)
    setup = Setup(some_polygons(rng)[:7])
    columns, mesh, _ = all_columns(setup.scene, tight(1e-3, levels=7))
    centre = setup.geometry.bounds.mean(axis=0)
    tracer = BruteForce(
        Geometry.from_scene(polygon_scene(*[setup.ring(e) - centre for e in range(mesh.element_count)]))
    )
    # Polygons in one plane may cover each other: which of them a ray meets first is a tie.
    offset = np.einsum("ij,ij->i", mesh.element_normal, mesh.element_centroid - centre)
    turned = np.sign(mesh.element_normal @ mesh.element_normal.T)
    alike = np.abs(mesh.element_normal @ mesh.element_normal.T) > 1 - 1e-6
    shared = (alike & (np.abs(offset - turned * offset[:, None]) < 1e-4)).sum(axis=1) > 1
    count = 4000
    for receiver in np.flatnonzero(~shared):
        ring, normal = setup.ring(receiver) - centre, mesh.element_normal[receiver]
        fan = np.array([[ring[0], ring[k], ring[k + 1]] for k in range(1, len(ring) - 1)])
        size = np.linalg.norm(np.cross(fan[:, 1] - fan[:, 0], fan[:, 2] - fan[:, 0]), axis=1)
        chosen = fan[rng.choice(len(fan), count, p=size / size.sum())]
        s, t = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
        start = (1 - s) * chosen[:, 0] + s * (1 - t) * chosen[:, 1] + s * t * chosen[:, 2]
        sphere = rng.normal(size=(count, 3))
        along = normal + sphere / np.linalg.norm(sphere, axis=1)[:, None]
        hits = tracer.closest_hit(start, along, np.inf, [[receiver, -1]])
        front = np.einsum("ij,ij->i", along, mesh.element_normal[hits.polygon]) < 0
        for sender in range(mesh.element_count):
            if receiver == sender or shared[sender]:
                continue
            share = float(((hits.polygon == sender) & front).mean())
            found, stated = columns.factor[sender, receiver], columns.spread[sender, receiver]
            error = 5 * np.sqrt(max(share, found) / count) + 10 / count + 3 * stated
            assert abs(found - share) < error, (receiver, sender)
