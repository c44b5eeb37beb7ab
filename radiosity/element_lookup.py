"""Which element lies at a point of a polygon, and what its radiosity is there.

Pictures and sensors read a solution at the hits of rays: tracer's polygon and point in, element
out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from radiosity.patches import PatchMesh
from workbench.errors import InputError
from workbench.geometry.flat import Geometry

__all__ = ["ElementLookup", "bounding_rectangle", "element_gradients", "search_list"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

PAD = 1e-5
"""Share of the scene's size by which boxes are widened: what float32 leaves of a hit."""
SHORT = 8
"""Longest list of pieces in a cell that is searched without a tree."""
CELLS = 16
"""Cells a piece at most."""
_LEAF = 4


@njit(nogil=True, cache=True)
def _build_trees(starts, stops, low, high, pad, order, boxes, links, root):
    """Median-split trees in preorder, one over ``order[starts[t]:stops[t]]`` each; the number of nodes."""
    made = 0
    ranges = np.empty((128, 3), dtype=np.int64)
    for t in range(starts.shape[0]):
        root[t] = made
        ranges[0, 0], ranges[0, 1], ranges[0, 2] = starts[t], stops[t], -1
        top = 0
        while top >= 0:
            start, stop, done = ranges[top, 0], ranges[top, 1], ranges[top, 2]
            top -= 1
            if done >= 0:  # the subtree that began at node ``done`` is complete
                links[done, 0] = made
                continue
            node = made
            made += 1
            longest, along = -1.0, 0
            for axis in range(3):
                least, most = np.inf, -np.inf
                for i in range(start, stop):
                    least, most = min(least, low[order[i], axis]), max(most, high[order[i], axis])
                boxes[node, axis], boxes[node, 3 + axis] = least - pad, most + pad
                if most - least > longest:
                    longest, along = most - least, axis
            links[node, 1] = start
            top += 1
            ranges[top, 0], ranges[top, 1], ranges[top, 2] = 0, 0, node
            if stop - start <= _LEAF:
                links[node, 2] = stop - start
                continue
            links[node, 2] = 0
            inside = order[start:stop].copy()
            key = np.empty(stop - start)
            for i in range(stop - start):
                key[i] = low[inside[i], along] + high[inside[i], along]
            order[start:stop] = inside[np.argsort(key, kind="mergesort")]
            middle = (start + stop) // 2
            top += 1
            ranges[top, 0], ranges[top, 1], ranges[top, 2] = middle, stop, -1
            top += 1
            ranges[top, 0], ranges[top, 1], ranges[top, 2] = start, middle, -1
    return made


@njit(nogil=True, cache=True)
def _inward_edges(corners, starts, normals, edges):
    """For each corner the inward unit normal of the edge that it begins, and its level (k, 4)."""
    for p in range(starts.shape[0] - 1):
        a, b = starts[p], starts[p + 1]
        for i in range(a, b):
            j = i + 1 if i + 1 < b else a
            ex, ey, ez = corners[j, 0] - corners[i, 0], corners[j, 1] - corners[i, 1], corners[j, 2] - corners[i, 2]
            qx = normals[p, 1] * ez - normals[p, 2] * ey
            qy = normals[p, 2] * ex - normals[p, 0] * ez
            qz = normals[p, 0] * ey - normals[p, 1] * ex
            length = np.sqrt(qx * qx + qy * qy + qz * qz)
            if length == 0.0:  # two corners in one place bound nothing
                edges[i, 0] = edges[i, 1] = edges[i, 2] = 0.0
                edges[i, 3] = -np.inf
                continue
            edges[i, 0], edges[i, 1], edges[i, 2] = qx / length, qy / length, qz / length
            edges[i, 3] = (qx * corners[i, 0] + qy * corners[i, 1] + qz * corners[i, 2]) / length


@njit(nogil=True, cache=True)
def _depth(x, y, z, a, b, edges):
    """How far inside a convex piece a point of its plane lies; negative outside."""
    least = np.inf
    for i in range(a, b):
        least = min(least, edges[i, 0] * x + edges[i, 1] * y + edges[i, 2] * z - edges[i, 3])
    return least


@njit(nogil=True, cache=True)
def search_list(x, y, z, which, lists, order, boxes, links, starts, edges):
    """Piece of a list at a point: the one that it lies in, or the nearest by the distance to its edges."""
    found, best = -1, -np.inf
    root = lists[which, 2]
    if root >= 0:
        node, stop = root, links[root, 0]
        while node < stop:
            if (
                x < boxes[node, 0] or x > boxes[node, 3] or y < boxes[node, 1] or y > boxes[node, 4]
                or z < boxes[node, 2] or z > boxes[node, 5]
            ):  # fmt: skip
                node = links[node, 0]
                continue
            for i in range(links[node, 1], links[node, 1] + links[node, 2]):
                depth = _depth(x, y, z, starts[order[i]], starts[order[i] + 1], edges)
                if depth > best:
                    found, best = order[i], depth
                    if best >= 0.0:
                        return found
            node += 1
        if found >= 0:
            return found
    for i in range(lists[which, 0], lists[which, 1]):
        depth = _depth(x, y, z, starts[order[i]], starts[order[i] + 1], edges)
        if depth > best:
            found, best = order[i], depth
            if best >= 0.0:
                break
    return found


@njit(nogil=True, cache=True)
def _cell(x, y, z, group, frame, counts):
    """Cell of a group's grid at a point, the nearest one if it lies outside."""
    u = frame[group, 0] * x + frame[group, 1] * y + frame[group, 2] * z - frame[group, 3]
    v = frame[group, 4] * x + frame[group, 5] * y + frame[group, 6] * z - frame[group, 7]
    column = min(max(int(u), 0), counts[group, 1] - 1)
    row = min(max(int(v), 0), counts[group, 2] - 1)
    return counts[group, 0] + row * counts[group, 1] + column


@njit(nogil=True, cache=True)
def _fill_cells(group_start, order, corners, starts, frame, counts, cells, listed, pieces):
    """Count (``pieces`` empty) or list the pieces that overlap each cell; the number of entries."""
    total = 0
    for g in range(group_start.shape[0] - 1):
        for i in range(group_start[g], group_start[g + 1]):
            piece = order[i]
            low_u = low_v = np.inf
            high_u = high_v = -np.inf
            for c in range(starts[piece], starts[piece + 1]):
                x, y, z = corners[c, 0], corners[c, 1], corners[c, 2]
                u = frame[g, 0] * x + frame[g, 1] * y + frame[g, 2] * z - frame[g, 3]
                v = frame[g, 4] * x + frame[g, 5] * y + frame[g, 6] * z - frame[g, 7]
                low_u, high_u = min(low_u, u), max(high_u, u)
                low_v, high_v = min(low_v, v), max(high_v, v)
            # What only touches a cell is not in it: grids that follow the elements have one a cell.
            a0 = min(max(int(low_u + 1e-6), 0), counts[g, 1] - 1)
            a1 = min(max(int(high_u - 1e-6), a0), counts[g, 1] - 1)
            b0 = min(max(int(low_v + 1e-6), 0), counts[g, 2] - 1)
            b1 = min(max(int(high_v - 1e-6), b0), counts[g, 2] - 1)
            for b in range(b0, b1 + 1):
                for a in range(a0, a1 + 1):
                    cell = counts[g, 0] + b * counts[g, 1] + a
                    if pieces.shape[0]:
                        pieces[listed[cell] + cells[cell]] = piece
                    cells[cell] += 1
                    total += 1
    return total


@dataclass(frozen=True)
class ElementLookup:
    """The element at any point of a geometry's polygons.

    Each side of a polygon with several pieces has a grid that follows its elements where they are
    alike; a cell with one piece is the answer, crowded ones have a small box tree.  So uniform grids are
    read at once and quadtree leaves of any size in the logarithm of their number.

    Parameters
    ----------
    root : (q, 2) int
        For the front (column 0) and the back (1) of each polygon: its group; -1 where no light
        leaves (the back of a one-sided surface); ``-2 - e`` where all of it is the element ``e``.
    frame : (g, 8) float
        Rows (a, b, c, d) twice: column and row of a point's cell are ``a x + b y + c z - d``.
    counts : (g, 3) int
        First cell, columns and rows.
    cells : (c,) int
        The piece of a cell, or ``-1 - i`` for the list ``i`` of pieces.
    lists : (l, 3) int
        List ``i`` is ``order[lists[i, 0]:lists[i, 1]]``; a long one has a tree from node ``lists[i, 2]``
        on, a short one has -1 there.
    order : (p,) int
        Pieces, list after list.
    boxes : (m, 6) float
        Lowest and highest corner of each node's box.
    links : (m, 3) int
        Node to go on with when this one is culled or done (preorder), and the first place in ``order``
        and the number of a leaf's pieces.
    edges : (k, 4) float
        Inward normal of the edge that each corner of the mesh begins, and its level.
    piece_start, piece_element
        Those of the mesh.
    piece_polygon : (p,) int
        Polygon of the geometry on which each piece of the mesh lies, also inside clusters.
    """

    root: IntArray
    frame: FloatArray
    counts: IntArray
    cells: IntArray
    lists: IntArray
    order: IntArray
    boxes: FloatArray
    links: IntArray
    edges: FloatArray
    piece_start: IntArray
    piece_element: IntArray
    piece_polygon: IntArray

    @classmethod
    def build(cls, geometry: Geometry, mesh: PatchMesh) -> ElementLookup:
        """Index the elements of a mesh by the polygons of its geometry.

        Raises
        ------
        InputError
            If the mesh is not one of this geometry.
        """
        owner = mesh.piece_element
        polygon, back = mesh.element_polygon[owner], (mesh.element_side[owner] < 0).astype(np.int64)
        if polygon.max(initial=-1) >= geometry.polygon_count:
            raise InputError(
                f"mesh: found an element of polygon {polygon.max()}, but the scene has {geometry.polygon_count};"
                " give the scene that the mesh was made from"
            )
        root = np.full((geometry.polygon_count, 2), -1, dtype=np.int64)
        flat = np.flatnonzero(polygon >= 0)
        key = polygon[flat] * 2 + back[flat]
        by_key = flat[np.argsort(key, kind="stable")]
        groups, first, many = np.unique(np.sort(key), return_index=True, return_counts=True)
        single = many == 1
        root[groups[single] // 2, groups[single] % 2] = -2 - owner[by_key[first[single]]]
        if len(flat) < len(owner):
            polygon = _clustered_facets(geometry, mesh, root)
        groups, first, many = groups[~single], first[~single], many[~single]
        root[groups // 2, groups % 2] = np.arange(len(groups))
        starts = mesh.piece_start
        pieces = [by_key[a : a + k] for a, k in zip(first.tolist(), many.tolist(), strict=True)]
        frame, counts = np.empty((len(groups), 8)), np.zeros((len(groups), 3), dtype=np.int64)
        low, high = np.minimum.reduceat(mesh.corners, starts[:-1]), np.maximum.reduceat(mesh.corners, starts[:-1])
        for g, inside in enumerate(pieces):
            frame[g], counts[g, 1:] = _grid_frame(mesh, inside)
        size = counts[:, 1] * counts[:, 2]
        counts[:, 0] = np.cumsum(size) - size
        members = np.concatenate(pieces) if pieces else np.empty(0, dtype=np.int64)
        group_start = np.concatenate([[0], np.cumsum(many)]).astype(np.int64)
        none = np.empty(0, dtype=np.int64)
        held = np.zeros(int(size.sum()), dtype=np.int64)
        total = _fill_cells(group_start, members, mesh.corners, starts, frame, counts, held, none, none)
        listed = np.cumsum(held) - held
        order = np.empty(total, dtype=np.int64)
        filled = np.zeros_like(held)
        _fill_cells(group_start, members, mesh.corners, starts, frame, counts, filled, listed, order)
        cells = np.zeros(len(held), dtype=np.int64)
        cells[held == 1] = order[listed[held == 1]]
        crowded, empty = np.flatnonzero(held > 1), np.flatnonzero(held == 0)
        # A cell that no piece overlaps (in a hole) asks all of its group.
        lonely = np.searchsorted(counts[:, 0], empty, side="right") - 1
        holes = np.unique(lonely)
        asked = [order[listed[c] : listed[c] + held[c]] for c in crowded.tolist()] + [pieces[g] for g in holes.tolist()]
        list_start = np.concatenate([[0], np.cumsum([len(each) for each in asked])]).astype(np.int64)
        listed_pieces = np.concatenate(asked).astype(np.int64) if asked else none
        cells[crowded] = -1 - np.arange(len(crowded))
        cells[empty] = -1 - len(crowded) - np.searchsorted(holes, lonely)
        lists = np.column_stack([list_start[:-1], list_start[1:], np.full(len(asked), -1)])
        long = np.flatnonzero(lists[:, 1] - lists[:, 0] > SHORT)
        room = 2 * int((lists[long, 1] - lists[long, 0]).sum())
        boxes, links, begin = np.empty((room, 6)), np.empty((room, 3), dtype=np.int64), np.empty(len(long), np.int64)
        made = _build_trees(
            lists[long, 0], lists[long, 1], low, high, PAD * geometry.size, listed_pieces, boxes, links, begin
        )
        lists[long, 2] = begin
        edges = np.empty((len(mesh.corners), 4))
        _inward_edges(mesh.corners, starts, mesh.piece_normal, edges)
        return cls(
            root, frame, counts, cells, lists, listed_pieces, boxes[:made], links[:made], edges, starts, owner, polygon
        )

    @property
    def lists_and_trees(self) -> tuple[IntArray, IntArray, FloatArray, IntArray, IntArray, FloatArray]:
        """What :func:`search_list` takes after the list's number."""
        return self.lists, self.order, self.boxes, self.links, self.piece_start, self.edges

    def elements(self, points: FloatArray, polygon: IntArray, front: NDArray[np.bool_]) -> IntArray:
        """Element (n,) at points of polygons, -1 where the side has none.

        Parameters
        ----------
        points : (n, 3) float
        polygon : (n,) int
            Polygon of the geometry on which each point lies, -1 for none.
        front : (n,) bool
            Whether the front is meant.
        """
        out = np.empty(len(points), dtype=np.int64)
        _locate_all(
            np.ascontiguousarray(points, dtype=np.float64), polygon, front, self.root, self.frame, self.counts,
            self.cells, *self.lists_and_trees, self.piece_element, out,
        )  # fmt: skip
        return out


def _plane_extent(mesh: PatchMesh, pieces: IntArray) -> tuple[FloatArray, FloatArray, IntArray]:
    """Axes (2, 3) in the plane of some pieces, along an edge of the first; their corners, and where each begins."""
    starts = mesh.piece_start
    first = mesh.corners[starts[pieces[0]] : starts[pieces[0] + 1]]
    sides = np.roll(first, -1, axis=0) - first
    u = sides[int(np.argmax((sides**2).sum(axis=1)))]
    u = u / np.linalg.norm(u)
    axes = np.stack([u, np.cross(mesh.piece_normal[pieces[0]], u)])
    sizes = starts[pieces + 1] - starts[pieces]
    begin = np.cumsum(sizes) - sizes
    return axes, mesh.corners[np.repeat(starts[pieces] - begin, sizes) + np.arange(sizes.sum())] @ axes.T, begin


def bounding_rectangle(mesh: PatchMesh, pieces: IntArray) -> FloatArray:
    """A rectangle (4, 3) round some pieces of one plane, in their direction."""
    axes, flat, _ = _plane_extent(mesh, pieces)
    low, high = flat.min(axis=0), flat.max(axis=0)
    corner = mesh.corners[mesh.piece_start[pieces[0]]]
    origin = corner - (corner @ axes.T) @ axes
    return np.stack(
        [
            origin + a * axes[0] + b * axes[1]
            for a, b in ((low[0], low[1]), (high[0], low[1]), tuple(high), (low[0], high[1]))
        ]
    )


def _grid_frame(mesh: PatchMesh, pieces: IntArray) -> tuple[FloatArray, tuple[int, int]]:
    """Frame (8,) and counts of the grid over some pieces of one plane, along an edge of the first."""
    (u, v), flat, begin = _plane_extent(mesh, pieces)
    span = np.maximum.reduceat(flat, begin) - np.minimum.reduceat(flat, begin)
    low, extent = flat.min(axis=0), np.ptp(flat, axis=0)
    extent = np.where(extent > 0, extent, 1.0)
    # As fine as the smallest piece, so that a grid or quadtree has one piece a cell, but not more cells
    # than four a piece: halved, which keeps to a quadtree's lines.
    least = np.maximum(span.min(axis=0), 1e-9 * extent)
    count = np.maximum(np.round(extent / least), 1.0)
    while count.prod() > CELLS * len(pieces) and (count > 1).any():
        count = np.maximum(np.round(0.5 * count), 1.0)
    count *= max(math.floor(math.sqrt(CELLS * len(pieces) / count.prod())), 1)
    scale = count / extent
    frame = np.concatenate([u * scale[0], [low[0] * scale[0]], v * scale[1], [low[1] * scale[1]]])
    return frame, (int(count[0]), int(count[1]))


@njit(nogil=True, cache=True)
def _locate_all(
    points, polygon, front, root, frame, counts, cells, lists, order, boxes, links, starts, edges, owner, out
):  # fmt: skip
    for i in range(points.shape[0]):
        out[i] = -1
        if polygon[i] < 0:
            continue
        group = root[polygon[i], 0 if front[i] else 1]
        if group <= -2:
            out[i] = -2 - group
        elif group >= 0:
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            piece = cells[_cell(x, y, z, group, frame, counts)]
            if piece < 0:
                piece = search_list(x, y, z, -1 - piece, lists, order, boxes, links, starts, edges)
            out[i] = owner[piece]


def _facet_keys(corners: FloatArray, starts: IntArray, chosen: IntArray, width: int) -> FloatArray:
    """A row for each piece that does not depend on the order of its corners: they are sorted."""
    sizes = np.diff(starts)[chosen]
    keys = np.zeros((len(chosen), width, 3))
    for size in np.unique(sizes).tolist():
        rows = np.flatnonzero(sizes == size)
        ring = corners[starts[chosen[rows]][:, None] + np.arange(size)]
        order = np.lexsort((ring[..., 2], ring[..., 1], ring[..., 0]), axis=1)
        keys[rows, :size] = np.take_along_axis(ring, order[..., None], axis=1)
        keys[rows, size:] = keys[rows, size - 1 : size]
    return keys.reshape(len(chosen), -1)


def _clustered_facets(geometry: Geometry, mesh: PatchMesh, root: IntArray) -> IntArray:
    """Fill ``root`` for the facets of clusters, whose pieces have the same corners; polygon of each piece."""
    owner = mesh.piece_element
    pieces = np.flatnonzero(mesh.element_polygon[owner] < 0)
    facets = np.flatnonzero((root[geometry.piece_polygon] == -1).all(axis=1))
    width = int(max(np.diff(mesh.piece_start)[pieces].max(), np.diff(geometry.piece_start)[facets].max()))
    keys = np.concatenate(
        [
            _facet_keys(mesh.corners, mesh.piece_start, pieces, width),
            _facet_keys(geometry.corners, geometry.piece_start, facets, width),
        ]
    )
    number = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
    own, theirs = number[: len(pieces)], number[len(pieces) :]
    for back in (0, 1):
        side = (mesh.element_side[owner[pieces]] < 0) == bool(back)
        element_of = np.full(int(number.max()) + 1, -1, dtype=np.int64)
        element_of[own[side]] = owner[pieces[side]]
        found = element_of[theirs]
        hit = found >= 0
        root[geometry.piece_polygon[facets[hit]], back] = -2 - found[hit]
    facet_of = np.full(int(number.max()) + 1, -1, dtype=np.int64)
    facet_of[theirs] = geometry.piece_polygon[facets]
    polygon = mesh.element_polygon[owner].copy()
    polygon[pieces] = facet_of[own]
    return polygon


@njit(nogil=True, cache=True)
def _gradients(
    corners, starts, element_piece, owner, normal, centroid, size, group_of, values, frame, counts, cells, lists,
    order, boxes, links, edges, out,
):  # fmt: skip
    bands = values.shape[1]
    right = np.empty((bands, 2))
    lowest, highest = np.empty(bands), np.empty(bands)
    near = np.empty(64, dtype=np.int64)
    for e in range(values.shape[0]):
        group = group_of[e]
        if group < 0:
            continue
        nx, ny, nz = normal[e, 0], normal[e, 1], normal[e, 2]
        # A frame of the element's plane.
        if abs(nx) <= abs(ny) and abs(nx) <= abs(nz):
            ux, uy, uz = 0.0, nz, -ny
        elif abs(ny) <= abs(nz):
            ux, uy, uz = -nz, 0.0, nx
        else:
            ux, uy, uz = ny, -nx, 0.0
        length = np.sqrt(ux * ux + uy * uy + uz * uz)
        ux, uy, uz = ux / length, uy / length, uz / length
        vx, vy, vz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
        # Neighbours lie a hair beyond the edges, at two places of each: halves differ beside smaller ones.
        step = 1e-3 * size[e]
        many = 0
        for piece in range(element_piece[e], element_piece[e + 1]):
            a, b = starts[piece], starts[piece + 1]
            for i in range(a, b):
                j = i + 1 if i + 1 < b else a
                for half in range(2):
                    s = 0.25 + 0.5 * half
                    x = corners[i, 0] + s * (corners[j, 0] - corners[i, 0]) - step * edges[i, 0]
                    y = corners[i, 1] + s * (corners[j, 1] - corners[i, 1]) - step * edges[i, 1]
                    z = corners[i, 2] + s * (corners[j, 2] - corners[i, 2]) - step * edges[i, 2]
                    found = cells[_cell(x, y, z, group, frame, counts)]
                    if found < 0:
                        found = search_list(x, y, z, -1 - found, lists, order, boxes, links, starts, edges)
                    if owner[found] == e or many == near.shape[0]:
                        continue
                    if _depth(x, y, z, starts[found], starts[found + 1], edges) < 0.0:
                        continue  # beyond the polygon's own edge
                    known = False
                    for k in range(many):
                        known = known or near[k] == owner[found]
                    if not known:
                        near[many] = owner[found]
                        many += 1
        if many == 0:
            continue
        # Weighted least squares of the differences to the neighbours, in the plane.
        m00 = m01 = m11 = 0.0
        for band in range(bands):
            right[band, 0] = right[band, 1] = 0.0
            lowest[band] = highest[band] = values[e, band]
        for k in range(many):
            other = near[k]
            dx, dy = centroid[other, 0] - centroid[e, 0], centroid[other, 1] - centroid[e, 1]
            dz = centroid[other, 2] - centroid[e, 2]
            du, dv = dx * ux + dy * uy + dz * uz, dx * vx + dy * vy + dz * vz
            square = du * du + dv * dv
            if square == 0.0:
                continue
            weight = 1.0 / square
            m00 += weight * du * du
            m01 += weight * du * dv
            m11 += weight * dv * dv
            for band in range(bands):
                difference = values[other, band] - values[e, band]
                right[band, 0] += weight * du * difference
                right[band, 1] += weight * dv * difference
                lowest[band] = min(lowest[band], values[other, band])
                highest[band] = max(highest[band], values[other, band])
        # Neighbours in one line leave the other direction open: it gets no slope.
        small = 1e-9 * (m00 + m11)
        m00 += small
        m11 += small
        determinant = m00 * m11 - m01 * m01
        if determinant <= 0.0:
            continue
        for band in range(bands):
            gu = (m11 * right[band, 0] - m01 * right[band, 1]) / determinant
            gv = (m00 * right[band, 1] - m01 * right[band, 0]) / determinant
            gx, gy, gz = gu * ux + gv * vx, gu * uy + gv * vy, gu * uz + gv * vz
            # No corner may leave the range of the neighbours by more than its width, nor fall below zero.
            span = highest[band] - lowest[band]
            top, bottom = highest[band] + span, max(lowest[band] - span, 0.0)
            share = 1.0
            for i in range(starts[element_piece[e]], starts[element_piece[e + 1]]):
                change = (
                    gx * (corners[i, 0] - centroid[e, 0])
                    + gy * (corners[i, 1] - centroid[e, 1])
                    + gz * (corners[i, 2] - centroid[e, 2])
                )
                if change > top - values[e, band]:
                    share = min(share, (top - values[e, band]) / change)
                elif change < bottom - values[e, band]:
                    share = min(share, (bottom - values[e, band]) / change)
            share = max(share, 0.0)
            out[e, band, 0], out[e, band, 1], out[e, band, 2] = share * gx, share * gy, share * gz


def element_gradients(mesh: PatchMesh, lookup: ElementLookup, values: FloatArray) -> FloatArray:
    """Slopes with which values of elements are read between their centres.

    A value at a point ``y`` of a flat element is ``values[e] + gradient[e] @ (y - centroid[e])``:
    the element keeps its mean, and a field that is linear over the polygon is met exactly, up to
    its borders.  The slope is the weighted least-squares fit to the neighbours that share an edge on
    the same polygon and side, held back where a corner would leave their range (as in finite
    volumes: T. J. Barth and D. C. Jespersen, "The design and application of upwind schemes on
    unstructured meshes", AIAA 89-0366, 1989).

    Parameters
    ----------
    mesh : PatchMesh
    lookup : ElementLookup
    values : (n, bands) float

    Returns
    -------
    (n, bands, 3) float
        Zero for elements alone on their polygon and for clusters of facets.
    """
    values = np.ascontiguousarray(values, dtype=np.float64)
    out = np.zeros((*values.shape, 3))
    polygon = np.maximum(mesh.element_polygon, 0)
    group = np.where(mesh.element_polygon >= 0, lookup.root[polygon, (mesh.element_side < 0).astype(np.int64)], -1)
    _gradients(
        mesh.corners, mesh.piece_start, mesh.element_piece, mesh.piece_element, mesh.element_normal,
        mesh.element_centroid, mesh.element_size, group, values, lookup.frame, lookup.counts, lookup.cells,
        lookup.lists, lookup.order, lookup.boxes, lookup.links, lookup.edges, out,
    )  # fmt: skip
    return out
