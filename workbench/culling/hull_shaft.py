"""Polygon-hull shafts: the convex hull of a receiver and a sender, the tighter sibling of box shafts.

Source: E. A. Haines and J. R. Wallace, "Shaft culling for efficient ray-traced radiosity"
(Eurographics Workshop on Rendering 1991).  Where box shafts link boxes, a hull shaft links the
convex polygons themselves: its planes pass through an edge of one and a vertex of the other, or
are a polygon's own plane, and have every vertex of both on one side.  The box round both comes
first: it settles most pieces cheaply and is all that is left where no plane supports.

Every plane is moved out to the lowest vertex as computed, so a half-space contains the hull
whatever rounding did to its direction: flat, coplanar, overlapping and degenerate ends cost
candidates, never blockers.  Candidates are lists of pieces that are handed down: the shaft of a
part lies inside the shaft of the whole, so its candidates are among the whole's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from workbench.accel.box_tree import BoxTree, boxes_meeting_planes
from workbench.arrays import as_points
from workbench.counters import Counters
from workbench.culling import shaft
from workbench.culling.plane_vertex import outside_planes
from workbench.errors import InputError
from workbench.geometry.flat import Geometry

__all__ = ["SHAFT_ULPS", "hull_room", "hull_shaft", "shaft_candidates", "shaft_planes", "split_candidates"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SHAFT_ULPS = 64.0
"""Units in the last place of the largest coordinate by which a culled piece must lie outside."""

_EPSILON = float(np.finfo(np.float64).eps)


def hull_room(receiver_corners: int, sender_corners: int) -> int:
    """Rows that :func:`hull_shaft` fills at most: box, both polygons' planes, two an edge."""
    return 6 + 4 + 2 * (receiver_corners + sender_corners)


@njit(nogil=True, cache=True)
def _add(nx, ny, nz, d, used, planes):
    # Parallel edges find one plane twice, up to rounding; the first will do.
    for k in range(6, used):
        ax, ay, az = planes[k, 0] - nx, planes[k, 1] - ny, planes[k, 2] - nz
        if ax * ax + ay * ay + az * az <= 1e-24:
            return used
    if used == planes.shape[0]:  # no room: one plane less only costs candidates
        return used
    planes[used, 0], planes[used, 1], planes[used, 2], planes[used, 3] = nx, ny, nz, d
    return used + 1


@njit(nogil=True, cache=True)
def _support(nx, ny, nz, x, y, z, a, a0, a1, b, b0, b1, size, used, planes):
    # Adds the plane through (x, y, z) with unit normal n if it supports the hull.
    lowest = highest = 0.0
    for i in range(a0, a1):
        off = nx * (a[i, 0] - x) + ny * (a[i, 1] - y) + nz * (a[i, 2] - z)
        lowest, highest = min(lowest, off), max(highest, off)
    for i in range(b0, b1):
        off = nx * (b[i, 0] - x) + ny * (b[i, 1] - y) + nz * (b[i, 2] - z)
        lowest, highest = min(lowest, off), max(highest, off)
    near = 1e-12 * size
    base = nx * x + ny * y + nz * z
    if lowest >= -near:
        used = _add(nx, ny, nz, base + lowest, used, planes)
    if highest <= near:  # the other side, or both of a flat hull
        used = _add(-nx, -ny, -nz, -(base + highest), used, planes)
    return used


@njit(nogil=True, cache=True)
def _edge_planes(a, a0, a1, b, b0, b1, size, used, planes):
    # Supporting planes through each edge of a and a vertex of b.
    for i in range(a0, a1):
        j = i + 1 if i + 1 < a1 else a0
        ex, ey, ez = a[j, 0] - a[i, 0], a[j, 1] - a[i, 1], a[j, 2] - a[i, 2]
        edge = math.sqrt(ex * ex + ey * ey + ez * ez)
        for k in range(b0, b1):
            vx, vy, vz = b[k, 0] - a[i, 0], b[k, 1] - a[i, 1], b[k, 2] - a[i, 2]
            nx, ny, nz = ey * vz - ez * vy, ez * vx - ex * vz, ex * vy - ey * vx
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            # A vertex in line with the edge, or no edge at all, gives no plane.
            if not length > 1e-12 * edge * size:
                continue
            used = _support(
                nx / length, ny / length, nz / length, a[i, 0], a[i, 1], a[i, 2],
                a, a0, a1, b, b0, b1, size, used, planes,
            )  # fmt: skip
    return used


@njit(nogil=True, cache=True)
def _own_plane(a, a0, a1, b, b0, b1, size, used, planes):
    # The plane of polygon a, from its longest triangle sum (Newell).
    nx = ny = nz = 0.0
    for i in range(a0 + 1, a1 - 1):
        ux, uy, uz = a[i, 0] - a[a0, 0], a[i, 1] - a[a0, 1], a[i, 2] - a[a0, 2]
        vx, vy, vz = a[i + 1, 0] - a[a0, 0], a[i + 1, 1] - a[a0, 1], a[i + 1, 2] - a[a0, 2]
        nx += uy * vz - uz * vy
        ny += uz * vx - ux * vz
        nz += ux * vy - uy * vx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    if not length > 0.0:
        return used
    return _support(
        nx / length, ny / length, nz / length, a[a0, 0], a[a0, 1], a[a0, 2],
        a, a0, a1, b, b0, b1, size, used, planes,
    )  # fmt: skip


@njit(nogil=True, cache=True)
def hull_shaft(a, a0, a1, b, b0, b1, planes):
    """Planes (nx, ny, nz, d), inside ``n . x >= d``, of the hull of two convex polygons; their number.

    The polygons are ``a[a0:a1]`` and ``b[b0:b1]``; a point or a segment will do.  The first six
    planes are the box round both.  ``planes`` has six rows or more, :func:`hull_room` for all.
    """
    size = 0.0
    for axis in range(3):
        low, high = a[a0, axis], a[a0, axis]
        for i in range(a0, a1):
            low, high = min(low, a[i, axis]), max(high, a[i, axis])
        for i in range(b0, b1):
            low, high = min(low, b[i, axis]), max(high, b[i, axis])
        size = max(size, high - low)
        for k in range(4):
            planes[2 * axis, k] = 0.0
            planes[2 * axis + 1, k] = 0.0
        planes[2 * axis, axis], planes[2 * axis, 3] = 1.0, low
        planes[2 * axis + 1, axis], planes[2 * axis + 1, 3] = -1.0, -high
    used = _own_plane(a, a0, a1, b, b0, b1, size, 6, planes)
    used = _own_plane(b, b0, b1, a, a0, a1, size, used, planes)
    used = _edge_planes(a, a0, a1, b, b0, b1, size, used, planes)
    return _edge_planes(b, b0, b1, a, a0, a1, size, used, planes)


@njit(nogil=True, cache=True)
def _keep(corners, starts, bounds, candidates, planes, used, slack, kept, tally):
    # Candidates not wholly outside one plane: by box first, then by vertices.
    count = 0
    for i in range(candidates.shape[0]):
        piece = candidates[i]
        tally[0] += 1
        outside = False
        for k in range(used):
            reach = 0.0
            for axis in range(3):
                n = planes[k, axis]
                reach += n * bounds[piece, 1 if n > 0.0 else 0, axis]
            if reach < planes[k, 3] - slack:
                outside = True
                break
        if outside or outside_planes(corners, starts[piece], starts[piece + 1], planes, used, slack):
            tally[1] += 1
            continue
        kept[count] = piece
        count += 1
    return count


def shaft_planes(receiver: ArrayLike, sender: ArrayLike, shape: str = "hull") -> FloatArray:
    """Planes of the shaft between two convex polygons, (k, 4) rows (nx, ny, nz, d).

    Inside is ``n . x >= d``, with unit normals.

    Parameters
    ----------
    receiver, sender : (n, 3) float
        Corners of two convex polygons; a box shaft takes any points.
    shape : "hull" or "box"
        The hull of the polygons, or the shaft of their bounding boxes.

    Raises
    ------
    InputError
        If an argument is out of its range.
    """
    ends = as_points(receiver, "receiver"), as_points(sender, "sender")
    if len(ends[0]) == 0 or len(ends[1]) == 0:
        raise InputError("receiver and sender: found no corners, expected one or more")
    if shape == "hull":
        planes = np.empty((hull_room(len(ends[0]), len(ends[1])), 4))
        used = hull_shaft(ends[0], 0, len(ends[0]), ends[1], 0, len(ends[1]), planes)
    elif shape == "box":
        planes = np.empty((shaft.MAX_SHAFT_PLANES, 4))
        low, high = [e.min(axis=0) for e in ends], [e.max(axis=0) for e in ends]
        used = shaft.box_shaft(low[0], high[0], low[1], high[1], planes)
    else:
        raise InputError(f"shape: found {shape!r}, expected 'hull' or 'box'")
    return planes[:used]


def shaft_candidates(
    geometry: Geometry,
    planes: ArrayLike,
    candidates: ArrayLike | None = None,
    *,
    tree: BoxTree | None = None,
    skip_polygons: Sequence[int] = (),
    counters: Counters | None = None,
) -> IntArray:
    """Pieces (k,) that may block a segment inside a shaft: none outside one of its planes.

    A piece is set aside only if all of it lies outside one plane, by more than rounding; that a
    piece's corners all lie outside the shaft says nothing (it may go right through).  The answer is
    in the order of ``candidates``.

    Parameters
    ----------
    geometry : Geometry
    planes : (k, 4) float
        From :func:`shaft_planes`.
    candidates : (m,) int, optional
        Pieces to choose from; by default all.
    tree : BoxTree, optional
        Finds the candidates where none are given: cheaper than to ask all pieces.  The answer is
        then in the order of the tree.
    skip_polygons : sequence of int
        The receiver's and the sender's own polygons, excluded by identity, never by distance.
    counters : Counters, optional
        Gets ``box_tests``, ``shaft_tests``, ``shaft_culls`` and ``shafts_empty``.

    Raises
    ------
    InputError
        If a shape does not fit or an index is out of range.
    """
    rows = np.ascontiguousarray(planes, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 4:
        raise InputError(f"planes: found shape {rows.shape}, expected (k, 4)")
    slack = SHAFT_ULPS * _EPSILON * max(float(np.abs(geometry.corners).max(initial=0.0)), _reach(rows))
    tally = np.zeros(2, dtype=np.int64)
    if candidates is None and tree is not None:
        found = np.empty(geometry.piece_count, dtype=np.int64)
        boxes = np.zeros(1, dtype=np.int64)
        many = boxes_meeting_planes(
            tree.low, tree.high, tree.skip, tree.first, tree.count, tree.order, geometry.piece_bounds,
            rows, len(rows), slack, found, boxes,
        )  # fmt: skip
        chosen = found[:many]
        if counters is not None:
            counters.add(box_tests=boxes[0])
    else:
        chosen = np.arange(geometry.piece_count) if candidates is None else np.asarray(candidates)
        if chosen.ndim != 1 or (chosen.size and not np.issubdtype(chosen.dtype, np.integer)):
            raise InputError(f"candidates: found shape {chosen.shape} of {chosen.dtype}, expected (m,) integers")
        if chosen.size and not 0 <= chosen.min() <= chosen.max() < geometry.piece_count:
            raise InputError(f"candidates: found an index outside 0..{geometry.piece_count - 1}")
        chosen = np.ascontiguousarray(chosen, dtype=np.int64)
    if len(skip_polygons):
        chosen = chosen[~np.isin(geometry.piece_polygon[chosen], skip_polygons)]
    kept = np.empty(len(chosen), dtype=np.int64)
    count = _keep(
        geometry.corners, geometry.piece_start, geometry.piece_bounds, chosen, rows, len(rows), slack, kept, tally
    )
    if counters is not None:
        counters.add(shaft_tests=tally[0], shaft_culls=tally[1], shafts_empty=int(count == 0))
    return kept[:count]


def _reach(planes: FloatArray) -> float:
    # The coordinates of the ends: the offset of an axis-aligned plane is one, of any other a mix.
    return float(np.abs(planes[:, 3]).max(initial=0.0))


def split_candidates(
    geometry: Geometry,
    parts: Sequence[ArrayLike],
    sender: ArrayLike,
    candidates: ArrayLike,
    *,
    shape: str = "hull",
    skip_polygons: Sequence[int] = (),
    counters: Counters | None = None,
) -> list[IntArray]:
    """Hand a receiver's candidates down to the parts it is split into.

    Each part has its own shaft to the sender and chooses from the whole's candidates only, so a
    hierarchy tests the geometry once, at its root.

    Parameters
    ----------
    geometry : Geometry
    parts : sequence of (n, 3) float
        Convex polygons (or, with ``shape="box"``, any points) that lie within the whole.
    sender : (n, 3) float
        The sender that the candidates were found for, or a part of it.
    candidates : (m,) int
        The whole's candidates, from :func:`shaft_candidates`.
    shape, skip_polygons, counters
        As in :func:`shaft_planes` and :func:`shaft_candidates`; ``shafts`` is counted too.

    Returns
    -------
    list of (k,) int
        One list a part, each a part of ``candidates`` in its order.

    Raises
    ------
    InputError
        If an argument is out of its range.
    """
    found = []
    for part in parts:
        if counters is not None:
            counters.add(shafts=1)
        found.append(
            shaft_candidates(
                geometry, shaft_planes(part, sender, shape), candidates, skip_polygons=skip_polygons, counters=counters
            )
        )
    return found
