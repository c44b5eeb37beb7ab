"""Occluders with no more polygons than they need: neighbours in one plane are joined.

What a plane figure hides does not depend on how it was cut up, so the facets of a wall count as one
polygon when they block.  Joining changes no answer, only the length of the candidate lists.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from workbench.errors import InputError
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import convex_pieces, is_convex, plane_basis

__all__ = ["Occluders", "join_coplanar"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SAME_PLANE = 1e-10
"""Distance, as a share of the scene's size, within which polygons lie in one plane."""


@dataclass(frozen=True)
class Occluders:
    """Convex pieces that block, and the plane group of every polygon.

    Parameters
    ----------
    corners : (k, 3) float
        Corners of the pieces, counter-clockwise about their normals.
    start : (p + 1,) int
        Piece ``i`` has corners ``start[i]:start[i + 1]``.
    normal : (p, 3) float
        Unit normals; which side they point to says nothing.
    offset : (p,) float
        ``n . x`` on the piece.
    group : (p,) int
        Plane group: all that lies in one plane and lets the same share of light pass.
    through : (p,) float
        Transmittance; 0 blocks.
    polygon_group : (q,) int
        Plane group of each polygon of the geometry.
    slack : float
        Distance that counts as touching. [scene lengths]
    """

    corners: FloatArray
    start: IntArray
    normal: FloatArray
    offset: FloatArray
    group: IntArray
    through: FloatArray
    polygon_group: IntArray
    slack: float

    @property
    def count(self) -> int:
        """Number of pieces."""
        return len(self.offset)


def _plane_groups(geometry: Geometry) -> IntArray:
    """Group (q,) of each polygon: one plane, one transmittance."""
    if geometry.polygon_count == 0:
        return np.empty(0, np.int64)
    centre = geometry.bounds.mean(axis=0)
    first = geometry.piece_start[geometry.polygon_piece_start[:-1]]
    normal = geometry.polygon_normal.copy()
    # One sign for both sides of a plane: the largest component is positive.
    axis = np.argmax(np.abs(normal) + [2e-9, 1e-9, 0.0], axis=1)
    normal *= np.where(normal[np.arange(len(normal)), axis] < 0, -1.0, 1.0)[:, None]
    offset = np.einsum("ij,ij->i", normal, geometry.corners[first] - centre) / geometry.size
    # Neighbouring cells of this grid are never compared: then a plane is two groups, which costs and never errs.
    key = np.column_stack([np.round(normal / 1e-8), np.round(offset / 1e-8 + 0.237), geometry.polygon_transmittance])
    group = np.unique(key, axis=0, return_inverse=True)[1].ravel().astype(np.int64)
    # A group takes in what lies in the plane of its largest polygon, to rounding.
    order = np.lexsort((-geometry.polygon_area, group))
    lead = order[np.searchsorted(group[order], np.arange(group.max() + 1))]
    piece_polygon = np.repeat(geometry.piece_polygon, np.diff(geometry.piece_start))
    head = lead[group[piece_polygon]]
    off = np.abs(np.einsum("ij,ij->i", geometry.polygon_normal[head], geometry.corners - geometry.corners[first[head]]))
    stray = np.zeros(geometry.polygon_count, dtype=bool)
    allowed = max(SAME_PLANE * geometry.size, geometry.slack)
    np.logical_or.at(stray, piece_polygon, off > allowed)
    group[stray] = group.max() + 1 + np.arange(int(stray.sum()))
    return np.unique(group, return_inverse=True)[1].ravel().astype(np.int64)


def _joined(rings: list[FloatArray], normal: FloatArray, size: float) -> list[FloatArray] | None:
    """Convex pieces of the union of convex rings in one plane; ``None`` if there is nothing to gain."""
    u, v = plane_basis(normal)
    origin = rings[0][0]
    off = np.concatenate(rings) - origin
    which = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    parts = shapely.polygons(shapely.linearrings(np.column_stack([off @ u, off @ v]), indices=which))
    # Neighbours mostly share whole edges: their union is found by dropping those, which overlaps make invalid.
    area = shapely.area(parts).sum()
    try:
        union = shapely.coverage_union_all(parts)
        joined = union.is_valid and abs(union.area - area) <= 1e-9 * area
    except shapely.errors.GEOSException:
        joined = False
    if not joined:
        union = shapely.union_all(parts, grid_size=1e-11 * size)
    tolerance = 1e-10 * size
    pieces: list[FloatArray] = []
    for part in shapely.get_parts(union):
        if part.geom_type != "Polygon" or part.area <= tolerance * part.length:
            continue
        part = shapely.geometry.polygon.orient(part.simplify(tolerance))
        loops = [np.asarray(part.exterior.coords)[:-1]]
        loops += [np.asarray(r.coords)[:-1] for r in part.interiors if shapely.Polygon(r).area > tolerance * r.length]
        solid = [origin + np.outer(loop[:, 0], u) + np.outer(loop[:, 1], v) for loop in loops]
        try:
            cut = convex_pieces(solid)
        except InputError:
            return None
        pieces += _grown(cut, normal) if len(cut) > 1 else cut
    return pieces if 0 < len(pieces) < len(rings) else None


def _grown(pieces: list[FloatArray], normal: FloatArray) -> list[FloatArray]:
    """Fewer convex pieces: neighbours are joined across an edge while the result stays convex.

    S. Hertel and K. Mehlhorn, "Fast triangulation of simple polygons" (FCT 1983).
    """
    rings: list[list[tuple[float, ...]] | None] = [[tuple(c) for c in piece] for piece in pieces]
    edges = {}
    for index, ring in enumerate(rings):
        assert ring is not None
        for i, corner in enumerate(ring):
            edges[corner, ring[(i + 1) % len(ring)]] = index
    owner = list(range(len(rings)))

    def root(i: int) -> int:
        while owner[i] != i:
            i = owner[i]
        return i

    for (a, b), index in list(edges.items()):
        if (b, a) not in edges:
            continue
        i, j = root(index), root(edges[b, a])
        one, two = rings[i], rings[j]
        if i == j or one is None or two is None:
            continue
        # one runs ... a b ..., two runs ... b a ...: walk one from b to a, then two from a to b.
        p, q = one.index(b), two.index(a)
        joined = one[p:] + one[:p] + (two[q:] + two[:q])[1:-1]
        if is_convex(np.asarray(joined), normal):
            rings[i], rings[j] = joined, None
            owner[j] = i
    return [np.asarray(ring) for ring in rings if ring is not None]


def join_coplanar(geometry: Geometry) -> Occluders:
    """The occluders of a geometry, facets of one plane joined into as few convex pieces as is easy.

    Parameters
    ----------
    geometry : Geometry
    """
    group = _plane_groups(geometry)
    by_group = np.argsort(group[geometry.piece_polygon], kind="stable")
    sorted_group = group[geometry.piece_polygon][by_group]
    bounds = np.searchsorted(sorted_group, np.arange(int(group.max(initial=-1)) + 2))
    rings: list[FloatArray] = []
    lead: list[int] = []
    for number in range(len(bounds) - 1):
        members = by_group[bounds[number] : bounds[number + 1]]
        pieces = [geometry.piece(i) for i in members.tolist()]
        if len(pieces) > 1:
            found = _joined(pieces, geometry.piece_normal[members[0]], geometry.size)
            pieces = pieces if found is None else found
            lead += [int(members[0])] * len(pieces) if found is not None else members.tolist()
        else:
            lead += members.tolist()
        rings += pieces
    source = np.asarray(lead, dtype=np.int64)
    start = np.concatenate([[0], np.cumsum([len(ring) for ring in rings])]).astype(np.int64)
    corners = np.ascontiguousarray(np.concatenate(rings)) if rings else np.empty((0, 3))
    normal = np.ascontiguousarray(geometry.piece_normal[source])
    polygon = geometry.piece_polygon[source]
    return Occluders(
        corners=corners,
        start=start,
        normal=normal,
        offset=np.einsum("ij,ij->i", normal, corners[start[:-1]]),
        group=group[polygon],
        through=np.ascontiguousarray(geometry.polygon_transmittance[polygon]),
        polygon_group=group,
        slack=geometry.slack,
    )
