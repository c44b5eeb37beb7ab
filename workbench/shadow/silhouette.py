"""Visible shares past tessellated occluders: lines over the sender, cut by silhouette edges.

Seen from a point, every polygon covers a part of the sender's plane, and a place of the sender is
hidden where one layer or more cover it.  Along a line over the sender the number of layers changes
only where a projected edge crosses it: by one where the edge has one polygon, by two where both its
polygons lie on the same side (a silhouette), not at all where they lie on opposite sides.  The
count is therefore kept by the silhouettes alone, whatever the polygons are: closed or open, several
surfaces through one another (their union hides), wound as they come.  Between two changes the
irradiance along the line is a closed integral, so that a few lines across the sender give what
thousands of rays would.

Edges that can be no silhouette for any point of a tile are dropped for all of it, and of the rest
most for each group of neighbours in it.

Cf. S. Laine, T. Aila, U. Assarsson, J. Lehtinen and T. Akenine-Moller, "Soft shadow volumes for ray
tracing" (SIGGRAPH 2005), which counts layers over samples of the sender by silhouette edges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workbench.accel.box_tree import boxes_meeting_planes
from workbench.culling.shaft import MAX_SHAFT_PLANES, tile_shaft
from workbench.culling.tally import CLEAR, COMPLEX, DARK, EDGES, EMPTY, FITTED, LINES, SHAFT
from workbench.geometry.flat import Geometry
from workbench.geometry.planes import clip_by_plane
from workbench.sampling.sequences import hashed
from workbench.shadow._settle import STATE_CLEAR, STATE_COMPLEX, STATE_DARK, STATE_SAMPLED
from workbench.shadow._tile_fit import NODE_GAP, NODES, TERMS, cubic_at, cut_runs, fit_cubic, pick_nodes, quarter
from workbench.shadow.tiles import DIFFERENT

__all__ = [
    "BLUR",
    "FIT_NS",
    "LINE_NOISE",
    "MAX_LINES",
    "RAYED",
    "RAY_NS",
    "EdgeTable",
    "SenderFrame",
    "line_tiles",
    "sender_width",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LINE_NOISE = 0.17
"""Measured past tori, balls, leaves and fences: L lines, each crossed c times, leave an error of
LINE_NOISE c^1/2 L^-3/2 of a visible share."""
BEND_NOISE = 0.1
"""And as much of the root of the summed squares of its second differences from line to line."""
SURE = 1.5
"""Stated errors scatter: more lines are drawn where they exceed the allowed one by this."""
MAX_LINES = 1024
GROUP, PART = 64, 16
"""Neighbouring points that share a list of edges, and of those that do where the list is long."""
FEW = 40
"""Points of a region to which nothing is fitted."""
NODE_NOISE = 0.5
"""Error of the shares that are fitted, as a share of the allowed one."""
FIT_MARGIN = 1.0
"""Most by which a fit may be off, as a share of the allowed error."""
BLUR = 0.5
"""Share of the sender's width by which edges may move over it from one node of a fit to the next."""
CROWDED = 512
"""Edges that make a list long."""
RAY_NS, PIECE_NS, EDGE_NS, LOOSE_NS, LINE_NS = 90.0, 250.0, 8.0, 180.0, 80.0
"""Measured nanoseconds of a ray, of a piece met by the shaft of a tile with all that follows from it, and of what a
point looks at: an edge, a piece that reaches its height or the sender's plane, a line.  Only their ratios matter."""
RAYED, FIT_NS = 64, 1000.0
"""Points of a flat tile that get rays where a fit takes the others, about, and nanoseconds of each of these."""
CROSSINGS = 128
"""Most crossings of a line that are kept; a point with more is left to rays."""
NEAR = 1e-10
"""What lies closer to a point than this share of its distance from the sender's plane hides nothing."""
UNSURE = 2
"""Class of a piece that some points of a tile see from its front and some from its back."""
_SLOPE = 0.381966
"""Slope of the lines across the sender's frame: edges parallel to its sides must not run along them."""


@dataclass(frozen=True)
class EdgeTable:
    """The edges of all convex pieces, each with the pieces that share it.

    Corners at exactly the same place are one vertex.  An edge of more than two pieces has more
    than one row; pieces of no common edge (a crack, a T-junction) have a row each.

    Parameters
    ----------
    place : (v, 3) float
        Vertices.
    vertex, edge : (k,) int
        Vertex of each corner of the geometry, and the edge from it to the next corner of its piece.
    ends : (e, 2) int
        Vertices of each edge.
    piece : (e, 2) int
        Pieces on it, -1 for none.
    turn : (e, 2) int
        1 where the piece runs along the edge as ``ends`` does, -1 where against, 0 for none.
    """

    place: FloatArray
    vertex: NDArray[np.int32]
    edge: NDArray[np.int32]
    ends: NDArray[np.int32]
    piece: NDArray[np.int32]
    turn: NDArray[np.int32]

    @classmethod
    def build(cls, geometry: Geometry) -> EdgeTable:
        """Find the vertices and edges of a geometry."""
        corners, start = geometry.corners + 0.0, geometry.piece_start
        count = len(corners)
        order = np.lexsort(corners.T)
        ranked = corners[order]
        new = np.ones(count, dtype=bool)
        new[1:] = (ranked[1:] != ranked[:-1]).any(axis=1)
        vertex = np.empty(count, dtype=np.int64)
        vertex[order] = np.cumsum(new) - 1
        following = np.arange(1, count + 1)
        following[start[1:] - 1] = start[:-1]
        head = vertex[following]
        owner = np.repeat(np.arange(len(start) - 1), np.diff(start))
        low, high = np.minimum(vertex, head), np.maximum(vertex, head)
        turn = np.where(vertex < head, 1, -1)
        order = np.lexsort((owner, high, low))
        fresh = np.ones(count, dtype=bool)
        fresh[1:] = (low[order][1:] != low[order][:-1]) | (high[order][1:] != high[order][:-1])
        first = np.flatnonzero(fresh)
        rank = np.arange(count) - np.repeat(first, np.diff(np.append(first, count)))
        row = np.cumsum(rank % 2 == 0) - 1
        rows = int(row[-1]) + 1 if count else 0
        edge = np.empty(count, dtype=np.int64)
        edge[order] = row
        ends, piece, turns = np.zeros((rows, 2)), np.full((rows, 2), -1), np.zeros((rows, 2))
        ends[row, 0], ends[row, 1] = low[order], high[order]
        piece[row, rank % 2], turns[row, rank % 2] = owner[order], turn[order]
        return cls(
            np.ascontiguousarray(ranked[new]),
            *(a.astype(np.int32) for a in (vertex, edge, ends, piece, turns)),
        )


def sender_width(ring: FloatArray, normal: FloatArray) -> float:
    """Least distance of parallel lines that a convex polygon lies between."""
    sides = np.roll(ring, -1, axis=0) - ring
    across = np.cross(normal, sides[np.linalg.norm(sides, axis=1) > 0.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return float(np.ptp(across @ ring.T, axis=1).min())


@dataclass(frozen=True)
class SenderFrame:
    """A geometry in the frame of a flat sender: x along the lines, y across them, z its normal.

    Parameters
    ----------
    origin : (3,) float
    axes : (3, 3) float
        Rows are the frame's axes.
    ring : (k, 2) float
        The sender's corners, counter-clockwise about its normal.
    place : (v, 3) float
        Vertices.
    plane : (p, 4) float
        Plane of each piece: normal and offset.
    height : (p, 2) float
        Lowest and highest z of each piece.
    width : float
        Least width of the sender.
    """

    origin: FloatArray
    axes: FloatArray
    ring: FloatArray
    place: FloatArray
    plane: FloatArray
    height: FloatArray
    width: float

    @classmethod
    def build(cls, geometry: Geometry, edges: EdgeTable, ring: FloatArray, normal: FloatArray) -> SenderFrame:
        """Turn a geometry into the frame of a convex sender with unit normal ``normal``."""
        sides = np.roll(ring, -1, axis=0) - ring
        along = sides[np.argmax(np.einsum("ij,ij->i", sides, sides))]
        along = along / np.linalg.norm(along)
        across = np.cross(normal, along)
        x = np.ptp(ring @ along) * along + _SLOPE * np.ptp(ring @ across) * across
        x /= np.linalg.norm(x)
        axes = np.stack([x, np.cross(normal, x), normal])
        place = np.ascontiguousarray((edges.place - ring[0]) @ axes.T)
        height = place[edges.vertex, 2]
        first = geometry.piece_start[:-1]
        facing = geometry.piece_normal @ axes.T
        offset = np.einsum("ij,ij->i", facing, place[edges.vertex[first]])
        return cls(
            np.ascontiguousarray(ring[0]),
            axes,
            np.ascontiguousarray(((ring - ring[0]) @ axes.T)[:, :2]),
            place,
            np.column_stack([facing, offset]),
            np.column_stack([np.minimum.reduceat(height, first), np.maximum.reduceat(height, first)])
            if len(first)
            else np.empty((0, 2)),
            sender_width(ring, normal),
        )


@njit(nogil=True, cache=True)
def _side(plane, box):
    """1 or -1 if all of a box lies in front of or behind a plane, UNSURE if not."""
    low = high = -plane[3]
    for axis in range(3):
        a, b = plane[axis] * box[0, axis], plane[axis] * box[1, axis]
        low += min(a, b)
        high += max(a, b)
    return 1 if low > 0.0 else (-1 if high < 0.0 else UNSURE)


@njit(nogil=True, cache=True)
def _reach(v, box, reach):
    """Where on the sender's plane a vertex may be seen from the points of a box: bounds of x, of y."""
    least = lowest = np.inf
    most = highest = -np.inf
    for i in range(2):
        r = box[i, 2] / (box[i, 2] - v[2])
        for j in range(2):
            x, y = v[0] * r + box[j, 0] * (1.0 - r), v[1] * r + box[j, 1] * (1.0 - r)
            least, most = min(least, x), max(most, x)
            lowest, highest = min(lowest, y), max(highest, y)
    reach[0], reach[1], reach[2], reach[3] = least, most, lowest, highest


@njit(nogil=True, cache=True)
def _clip_ring(ring, nx, ny, level, out):
    """The part of a convex ring where nx x + ny y >= level; its number of corners."""
    kept = 0
    last = ring.shape[0] - 1
    px, py = ring[last, 0], ring[last, 1]
    dp = nx * px + ny * py - level
    for i in range(ring.shape[0]):
        cx, cy = ring[i, 0], ring[i, 1]
        dc = nx * cx + ny * cy - level
        if (dp > 0.0 and dc < 0.0) or (dp < 0.0 and dc > 0.0):
            t = dp / (dp - dc)
            out[kept, 0], out[kept, 1] = px + t * (cx - px), py + t * (cy - py)
            kept += 1
        if dc >= 0.0:
            out[kept, 0], out[kept, 1] = cx, cy
            kept += 1
        px, py, dp = cx, cy, dc
    return kept


@njit(nogil=True, cache=True)
def _separated(ring, count, ax, ay, bx, by):
    """Whether a side of a counter-clockwise convex ring has all of the segment a-b outside it, or on it."""
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        ex, ey = ring[j, 0] - ring[i, 0], ring[j, 1] - ring[i, 1]
        if (
            ex * (ay - ring[i, 1]) - ey * (ax - ring[i, 0]) <= 0.0
            and ex * (by - ring[i, 1]) - ey * (bx - ring[i, 0]) <= 0.0
        ):
            return True
    return False


@njit(nogil=True, cache=True)
def _cross(ends, rise, count, lines, lit_box, left, right, before, onward, many, where, steps):
    """Enter the crossings of edges with the lines; False when a line has no room.

    ``ends`` (n, 4) are x and y of both ends, y counted in lines: line k lies at k.  ``rise`` (n,) is the
    change of layers in +x where the edge runs toward higher lines.  What passes left of all that is lit
    changes the layers that lines begin with: ``before`` of one line, ``onward`` of it and all above it.
    """
    for e in range(count):
        ax, at, bx, bt = ends[e, 0], ends[e, 1], ends[e, 2], ends[e, 3]
        change = rise[e]
        a = int(min(max(math.ceil(at), 0.0), lines))
        b = int(min(max(math.ceil(bt), 0.0), lines))
        if a == b:
            continue
        if a > b:
            a, b = b, a
            change = -change
        if ax <= lit_box[0, 0] and bx <= lit_box[0, 0]:
            onward[a] += change
            onward[b] -= change
            continue
        slope = (bx - ax) / (bt - at)
        for k in range(a, b):
            # From the nearer end: the other may be very far away.
            x = ax + (k - at) * slope if abs(k - at) <= abs(k - bt) else bx + (k - bt) * slope
            if x >= right[k]:
                continue
            if x <= left[k]:
                before[k] += change
                continue
            i = many[k]
            if i == where.shape[1]:
                return False
            while i > 0 and where[k, i - 1] > x:
                where[k, i], steps[k, i] = where[k, i - 1], steps[k, i - 1]
                i -= 1
            where[k, i], steps[k, i] = x, change
            many[k] += 1
    return True


@njit(nogil=True, cache=True)
def _along(p, q, c, alpha, beta):
    """Integral of (alpha + beta x) / (c^2 + x^2)^2 from p to q: the irradiance along a line, but for a factor."""
    square = c * c
    a, b = 1.0 / (square + p * p), 1.0 / (square + q * q)
    ratio = alpha / square
    angle = math.atan2(c * (q - p), square + p * q)
    return 0.5 * ((ratio * q - beta) * b - (ratio * p - beta) * a + ratio / c * angle)


@njit(nogil=True, cache=True)
def _sum_lines(lines, y0, dy, px, py, h, nx, ny, nz, left, right, before, many, where, steps, hidden):
    """Hidden share over all lines and its standard error; ``hidden`` is scratch (2, lines)."""
    whole = total = 0.0
    crossings = 0
    for k in range(lines):
        hidden[0, k] = hidden[1, k] = 0.0
        if right[k] <= left[k]:
            continue
        y = y0 + k * dy - py
        c = math.sqrt(y * y + h * h)
        alpha = ny * y - nz * h
        full = max(_along(left[k] - px, right[k] - px, c, alpha, nx), 0.0)
        crossings += many[k]
        layers = before[k]
        start = left[k]
        dark = 0.0
        for i in range(many[k]):
            after = layers + steps[k, i]
            if layers <= 0 and after > 0:
                start = where[k, i]
            elif layers > 0 and after <= 0:
                dark += _along(start - px, where[k, i] - px, c, alpha, nx)
            layers = after
        if layers > 0:
            dark = full if many[k] == 0 else dark + _along(start - px, right[k] - px, c, alpha, nx)
        dark = min(max(dark, 0.0), full)
        whole += full
        total += dark
        hidden[0, k] = full
        hidden[1, k] = dark / full if full > 0.0 else 0.0
    if whole <= 0.0:
        return 0.0, 0.0
    # A measured law: the more crossings, the more corners between the lines.
    square = LINE_NOISE * LINE_NOISE * crossings / lines**4
    # And how unevenly the share changes from line to line.
    if lines >= 3:
        spread = 0.0
        for k in range(1, lines - 1):
            bend = hidden[0, k] / whole * (hidden[1, k - 1] - 2.0 * hidden[1, k] + hidden[1, k + 1])
            spread += bend * bend
        square += BEND_NOISE * BEND_NOISE * spread * lines / (lines - 2.0)
    return min(total / whole, 1.0), max(math.sqrt(square), 0.1 / (lines * lines))


@njit(nogil=True, cache=True)
def _turned(axes, x, y, z):
    """A vector in a frame of three axes."""
    return (
        axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z,
        axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z,
        axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z,
    )


@njit(nogil=True, cache=True)
def _bounds(places, first, last, box):
    for axis in range(box.shape[1]):
        box[0, axis] = box[1, axis] = places[first, axis]
        for i in range(first + 1, last):
            box[0, axis] = min(box[0, axis], places[i, axis])
            box[1, axis] = max(box[1, axis], places[i, axis])


@njit(nogil=True, cache=True)
def _bounds_of(places, rows, a, b, first, box):
    """Bounds of the places of ``rows[a:b]``, which are numbered from ``first``."""
    for axis in range(3):
        low, high = np.inf, -np.inf
        for k in range(a, b):
            x = places[rows[k] - first, axis]
            low, high = min(low, x), max(high, x)
        box[0, axis], box[1, axis] = low, high


@njit(nogil=True, cache=True)
def _blurred(box, highest, ring_box, width):
    """Whether edges no nearer than ``highest`` are blurred over more than the distance of a region's nodes.

    From a point at height h an edge at height z moves over the sender z / (h - z) times as fast as the
    point does along it; what moves by less than the sender's width from node to node none of them can miss.
    """
    near = box[0, 2]
    gap = near - highest
    if gap <= 0.0:
        return False
    step = NODE_GAP * max(box[1, 0] - box[0, 0], box[1, 1] - box[0, 1])
    rise = NODE_GAP * (box[1, 2] - near)
    aside = 0.0
    for axis in range(2):
        aside = max(aside, box[1, axis] - ring_box[0, axis], ring_box[1, axis] - box[0, axis])
    return max(highest, 0.0) * (step + rise * aside / near) <= BLUR * width * gap


@njit(nogil=True, cache=True)
def _misses(a, b, place, box, ring_box, mark, vertex_mark, reach):
    """Whether no point of a box sees the edge a-b on a line's sender or left of it."""
    for v in (a, b):
        if vertex_mark[v] != mark:
            vertex_mark[v] = mark
            _reach(place[v], box, reach[v])
    return (
        min(reach[a, 0], reach[b, 0]) >= ring_box[1, 0]
        or min(reach[a, 2], reach[b, 2]) >= ring_box[1, 1]
        or max(reach[a, 3], reach[b, 3]) <= ring_box[0, 1]
    )


@njit(nogil=True, cache=True)
def _tile_edges(pieces, box, ring_box, table, frame, mark, marks, out):
    """Edges of ``pieces`` that may be silhouettes before or left of the sender for some point of a box.

    Their number; one more than there is room for when there was not enough.
    """
    starts, _, _, _, edge, ends, edge_piece, turn = table
    place = frame[3]
    piece_mark, piece_class, edge_mark, vertex_mark, reach = marks
    which, base_of, unsettled = out
    count = 0
    for p in pieces:
        for k in range(starts[p], starts[p + 1]):
            e = edge[k]
            if edge_mark[e] == mark:
                continue
            edge_mark[e] = mark
            base, unsure = 0, False
            q0 = q1 = -1
            for s in range(2):
                q = edge_piece[e, s]
                if q < 0 or piece_mark[q] != mark:
                    continue
                if piece_class[q] == UNSURE:
                    unsure = True
                    if s == 0:
                        q0 = q
                    else:
                        q1 = q
                else:
                    base -= turn[e, s] * piece_class[q]
            if (base == 0 and not unsure) or _misses(
                ends[e, 0], ends[e, 1], place, box, ring_box, mark, vertex_mark, reach
            ):
                continue
            if count == which.shape[0]:
                return count + 1
            which[count], base_of[count] = e, base
            unsettled[count, 0], unsettled[count, 1] = q0, q1
            count += 1
    return count


@njit(nogil=True, cache=True)
def _narrow(count, wide, box, ring_box, table, frame, mark, tile_mark, owned, marks, out):
    """Of the edges ``wide`` of a box those that matter to the points of a smaller one.

    Returns their number, and the greatest z of those that may be seen before the sender.
    """
    _, piece_polygon, _, _, _, ends, _, turn = table
    place, plane = frame[3], frame[4]
    piece_mark, piece_class, _, vertex_mark, _, reach = marks
    wide_edge, wide_base, wide_unsettled = wide
    which, base_of, unsettled = out
    kept = 0
    nearest = -np.inf
    for c in range(count):
        e = wide_edge[c]
        base, unsure = wide_base[c], False
        for s in range(2):
            q = wide_unsettled[c, s]
            unsettled[kept, s] = -1
            if q < 0:
                continue
            if piece_mark[q] != mark:
                piece_mark[q] = mark
                piece_class[q] = UNSURE if owned[piece_polygon[q]] == tile_mark else _side(plane[q], box)
            if piece_class[q] == UNSURE:
                unsure = True
                unsettled[kept, s] = q
            else:
                base -= turn[e, s] * piece_class[q]
        if (base == 0 and not unsure) or _misses(
            ends[e, 0], ends[e, 1], place, box, ring_box, mark, vertex_mark, reach
        ):
            continue
        which[kept], base_of[kept] = e, base
        kept += 1
        v, w = ends[e, 0], ends[e, 1]
        if max(reach[v, 1], reach[w, 1]) > ring_box[0, 0]:
            nearest = max(nearest, place[v, 2], place[w, 2])
    return kept, nearest


@njit(nogil=True, cache=True)
def _gather_edges(count, narrow, table, frame, mark, marks, out):
    """Copy edges with their vertices and unsettled pieces, numbered anew.

    Returns the numbers of edges that have none of these pieces, of vertices and of pieces.
    """
    _, _, _, _, _, ends, _, turn = table
    place, plane = frame[3], frame[4]
    piece_mark, _, piece_number, vertex_mark, vertex_number, _ = marks
    which, base_of, unsettled = narrow
    edge, vertices, pieces, planes = out
    spots = unsure = settled = 0
    for c in range(count):
        settled += unsettled[c, 0] < 0 and unsettled[c, 1] < 0
    # Edges whose pieces are settled come first: their change of layers is known.
    front, back = 0, settled
    for c in range(count):
        e = which[c]
        if unsettled[c, 0] < 0 and unsettled[c, 1] < 0:
            k = front
            front += 1
        else:
            k = back
            back += 1
        edge[k, 2] = base_of[c]
        for s in range(2):
            v = ends[e, s]
            if vertex_mark[v] != mark:
                vertex_mark[v], vertex_number[v] = mark, spots
                for axis in range(3):
                    vertices[axis, spots] = place[v, axis]
                spots += 1
            edge[k, s] = vertex_number[v]
            q = unsettled[c, s]
            edge[k, 3 + s] = edge[k, 5 + s] = 0
            if q < 0:
                continue
            if piece_mark[q] != mark:
                piece_mark[q], piece_number[q] = mark, unsure
                pieces[unsure] = q
                for i in range(4):
                    planes[i, unsure] = plane[q, i]
                unsure += 1
            edge[k, 3 + s], edge[k, 5 + s] = piece_number[q], -turn[e, s]
    return settled, spots, unsure


@njit(nogil=True, cache=True)
def _project(vertices, count, px, py, h, y0, dy, lines, over, line, row):
    """Where vertices lie on the sender's plane, seen from a point: x, and y counted in lines; the line above."""
    per = 1.0 / dy
    shift = (py - y0) * per
    for c in range(count):
        r = h / (h - vertices[2, c])
        over[c] = px + (vertices[0, c] - px) * r
        line[c] = (vertices[1, c] - py) * r * per + shift
    for c in range(count):
        row[c] = np.ceil(min(max(line[c], 0.0), lines))


@njit(nogil=True, cache=True)
def _face(planes, count, px, py, h, facing):
    """1 for each plane that a point lies in front of, -1 for others."""
    for c in range(count):
        off = planes[0, c] * px + planes[1, c] * py + planes[2, c] * h - planes[3, c]
        facing[c] = 1 if off > 0.0 else -1


@njit(nogil=True, cache=True)
def _lay_lines(ring, count, lines, y0, dy, left, right):
    """Where each line enters and leaves a convex ring."""
    for k in range(lines):
        left[k], right[k] = np.inf, -np.inf
    px, pt = ring[count - 1, 0], (ring[count - 1, 1] - y0) / dy
    for i in range(count):
        cx, ct = ring[i, 0], (ring[i, 1] - y0) / dy
        a, b = math.ceil(min(pt, ct)), math.ceil(max(pt, ct))
        for k in range(max(a, 0), min(b, lines)):
            x = px + (k - pt) / (ct - pt) * (cx - px)
            left[k], right[k] = min(left[k], x), max(right[k], x)
        px, pt = cx, ct


@njit(nogil=True, cache=True)
def _reaches(ring, count, ring_box, y0, dy, ax, at, bx, bt):
    """Whether the segment a-b meets the inside of a convex ring; ``at`` and ``bt`` count lines."""
    ay, by = y0 + at * dy, y0 + bt * dy
    if (
        max(ax, bx) <= ring_box[0, 0]
        or min(ax, bx) >= ring_box[1, 0]
        or max(ay, by) <= ring_box[0, 1]
        or min(ay, by) >= ring_box[1, 1]
    ):
        return False
    return not _separated(ring, count, ax, ay, bx, by)


@njit(nogil=True, cache=True)
def _inside(pieces, table, place, planes, used, slack, out):
    """Pieces that do not lie wholly outside one of the half-spaces ``n . x >= d``; their number."""
    starts, _, _, vertex, _, _, _, _ = table
    kept = 0
    for p in pieces:
        outside = False
        for k in range(used):
            outside = True
            for c in range(starts[p], starts[p + 1]):
                v = vertex[c]
                reach = planes[k, 0] * place[v, 0] + planes[k, 1] * place[v, 1] + planes[k, 2] * place[v, 2]
                if reach > planes[k, 3] - slack:
                    outside = False
                    break
            if outside:
                break
        if not outside:
            out[kept] = p
            kept += 1
    return kept


@njit(nogil=True, cache=True)
def _loose_ring(p, starts, vertex, place, top, cut, cut2):
    """Corners of a piece between the sender's plane and a height, in ``cut``; their number, -1 if too many."""
    count = starts[p + 1] - starts[p]
    if count > cut.shape[0]:
        return -1
    for k in range(count):
        v = vertex[starts[p] + k]
        for axis in range(3):
            cut[k, axis] = place[v, axis]
    count = clip_by_plane(cut, count, 0.0, 0.0, -1.0, -top, 0.0, cut2)
    return clip_by_plane(cut2, count, 0.0, 0.0, 1.0, 0.0, 0.0, cut) if count > 0 else count


@njit(nogil=True, cache=True)
def _look(
    px, py, h, nx, ny, nz, own, offset, fewest, most, allowed, ring, group, sizes, frame, table, loose, various,
    scratch, tally,
):  # fmt: skip
    """The hidden share of the sender from one point, and its error; what is certain of it comes first.

    Returns CLEAR or DARK where no silhouette lies before the sender, SAMPLED where some does, and
    COMPLEX where the lines could not be drawn.  ``group`` holds the edges to look at, ``sizes`` how many
    there are, ``loose`` the pieces that reach the sender's plane or the point's height.
    """
    starts, piece_polygon, _, vertex, _, _, _, _ = table
    _, _, _, place, plane, height = frame
    group_edge, group_vertex, group_piece, group_plane = group
    edges, settled, spots, unsure = sizes
    lit, lit_box, cut, cut2 = scratch[:4]
    left, right, before, onward, many, where, steps = scratch[4:11]
    hidden, over, line, row, facing, active, rise = scratch[11:]
    corners_lit = _clip_ring(ring, nx, ny, nx * px + ny * py + nz * h, lit)
    if corners_lit < 3:
        return STATE_COMPLEX, 0.0, 0.0
    _bounds(lit, 0, corners_lit, lit_box)
    if not lit_box[1, 1] > lit_box[0, 1]:
        return STATE_COMPLEX, 0.0, 0.0
    _face(group_plane, unsure, px, py, h, facing)
    if various:
        for c in range(unsure):
            if piece_polygon[group_piece[c]] == own:
                facing[c] = 0
    lines = fewest
    while True:
        dy = (lit_box[1, 1] - lit_box[0, 1]) / lines
        y0 = lit_box[0, 1] + offset * dy
        _lay_lines(lit, corners_lit, lines, y0, dy, left, right)
        for k in range(lines):
            before[k] = many[k] = onward[k] = 0
        onward[lines] = 0
        _project(group_vertex, spots, px, py, h, y0, dy, lines, over, line, row)
        # Of most edges nothing reaches the lines, or all lies right of what is lit.
        crossing = 0
        for c in range(edges):
            a, b = group_edge[c, 0], group_edge[c, 1]
            if row[a] == row[b] or (over[a] >= lit_box[1, 0] and over[b] >= lit_box[1, 0]):
                continue
            change = group_edge[c, 2]
            if c >= settled:
                change += group_edge[c, 5] * facing[group_edge[c, 3]] + group_edge[c, 6] * facing[group_edge[c, 4]]
                if change == 0:
                    continue
            active[crossing, 0], active[crossing, 1] = over[a], line[a]
            active[crossing, 2], active[crossing, 3] = over[b], line[b]
            rise[crossing] = change
            crossing += 1
        fits = _cross(active, rise, crossing, lines, lit_box, left, right, before, onward, many, where, steps)
        meets = False
        for p in loose:
            if piece_polygon[p] == own or height[p, 0] >= h:
                continue
            count = _loose_ring(p, starts, vertex, place, (1.0 - NEAR) * h, cut, cut2)
            fits = fits and count >= 0
            off = plane[p, 0] * px + plane[p, 1] * py + plane[p, 2] * h - plane[p, 3]
            change = -1 if off > 0.0 else 1
            for k in range(count):
                r = h / (h - cut[k, 2])
                cut2[k, 0] = px + (cut[k, 0] - px) * r
                cut2[k, 1] = (py + (cut[k, 1] - py) * r - y0) / dy
            for k in range(count):
                j = k + 1 if k + 1 < count else 0
                ax, at, bx, bt = cut2[k, 0], cut2[k, 1], cut2[j, 0], cut2[j, 1]
                meets = meets or _reaches(lit, corners_lit, lit_box, y0, dy, ax, at, bx, bt)
                active[k, 0], active[k, 1], active[k, 2], active[k, 3] = ax, at, bx, bt
                rise[k] = change
            fits = fits and _cross(active, rise, count, lines, lit_box, left, right, before, onward, many, where, steps)
        tally[EDGES] += edges
        if not fits:
            return STATE_COMPLEX, 0.0, 0.0
        uncut = True
        layers = 0
        for k in range(lines):
            layers += onward[k]
            before[k] += layers
            uncut = uncut and many[k] == 0
        meets = meets or not uncut
        if not meets:
            # Does a silhouette lie between the lines?
            for c in range(edges):
                a, b = group_edge[c, 0], group_edge[c, 1]
                change = (
                    group_edge[c, 2]
                    + group_edge[c, 5] * facing[group_edge[c, 3]]
                    + group_edge[c, 6] * facing[group_edge[c, 4]]
                )
                if change != 0 and _reaches(lit, corners_lit, lit_box, y0, dy, over[a], line[a], over[b], line[b]):
                    meets = True
                    break
            if not meets:
                hiding = 0
                for k in range(lines):
                    hiding += before[k] > 0
                if hiding == 0:
                    return STATE_CLEAR, 0.0, 0.0
                if hiding == lines:
                    return STATE_DARK, 1.0, 0.0
        dark, error = _sum_lines(lines, y0, dy, px, py, h, nx, ny, nz, left, right, before, many, where, steps, hidden)
        tally[LINES] += lines
        if lines == most or (error <= SURE * allowed and not uncut) or not meets:
            return STATE_SAMPLED, dark, error
        more = 4.0 if uncut else min(max((error / allowed) ** (2.0 / 3.0), 1.5), 4.0)
        lines = min(math.ceil(more * lines), most)


@njit(nogil=True, cache=True)
def line_tiles(chosen, tiles, sender, table, frame, tree, slack, fewest, most, allowed, worth, seed, limit, out, tally):
    """Visible shares of the points of ``chosen`` tiles whose state is COMPLEX, by lines.

    ``fewest`` lines are drawn, and more (up to ``most``) where the share's error is then above
    ``allowed``.  Where no silhouette lies before the sender a point is settled for certain, CLEAR or
    DARK; others become SAMPLED.  On a flat tile the share is smooth as far as the light blurs the
    nearest edge: there lines are drawn at some points, and where the share fitted to them foretells each
    of them it is taken for the others.  Left COMPLEX are points with panes before the sender, with a
    line of too many crossings, or with so many pieces or edges to look at that rays, which cost
    ``worth`` nanoseconds a point, would be cheaper.
    """
    points, normals, index, own, flat, tile_start, tile_bounds, tile_normal, tile_offset, tile_own = tiles
    corners, sender_low, sender_high, sender_normal, sender_own, width = sender
    _, piece_polygon, through, _, _, ends, _, _ = table
    origin, axes, ring, place, plane, height = frame
    low, high, skip, head, leaf, order, bounds = tree
    part, share, doubt, state, candidates = out

    pieces, polygons = through.shape[0], 0
    for p in range(pieces):
        polygons = max(polygons, piece_polygon[p] + 1)
    for i in range(own.shape[0]):
        polygons = max(polygons, own[i] + 1)
    # Marks say which tile or group has last looked at a piece, an edge, a vertex, a polygon.
    mark = 0
    owned = np.zeros(polygons, dtype=np.int64)
    tile_marks = (
        np.zeros(pieces, np.int64), np.zeros(pieces, np.int64), np.zeros(ends.shape[0], np.int64),
        np.zeros(place.shape[0], np.int64), np.empty((place.shape[0], 4)),
    )  # fmt: skip
    group_marks = (
        np.zeros(pieces, np.int64), np.zeros(pieces, np.int64), np.zeros(pieces, np.int64),
        np.zeros(place.shape[0], np.int64), np.zeros(place.shape[0], np.int64), tile_marks[4],
    )  # fmt: skip
    piece_mark, piece_class = tile_marks[0], tile_marks[1]
    room = int(min(max(worth / EDGE_NS, 1024.0), 32768.0))
    many_pieces = min(pieces, 4 * room)
    tile_room = min(ends.shape[0], 8 * room)
    tile_out = np.empty(tile_room, np.int64), np.empty(tile_room, np.int64), np.empty((tile_room, 2), np.int64)
    group_out = np.empty(tile_room, np.int64), np.empty(tile_room, np.int64), np.empty((tile_room + 1, 2), np.int64)
    group_room = min(room, ends.shape[0])
    group = (
        np.empty((group_room, 7), np.int64), np.empty((3, 2 * group_room)),
        np.empty(2 * group_room, np.int64), np.empty((4, 2 * group_room)),
    )  # fmt: skip
    planes = np.empty((MAX_SHAFT_PLANES, 4))
    found, loose, loose_here = np.empty((3, many_pieces), np.int64)
    box, ring_box = np.empty((2, 3)), np.empty((2, 2))
    scratch = (
        np.empty((ring.shape[0] + 1, 2)), np.empty((2, 2)), np.empty((64, 3)), np.empty((66, 3)), np.empty(most),
        np.empty(most), np.empty(most, np.int64), np.empty(most + 1, np.int64), np.empty(most, np.int64),
        np.empty((most, CROSSINGS)), np.empty((most, CROSSINGS), np.int64), np.empty((2, most)),
        np.empty(2 * group_room), np.empty(2 * group_room), np.empty(2 * group_room),
        np.zeros(2 * group_room + 1, np.int64), np.empty((group_room + 66, 4)),
        np.empty(group_room + 66, np.int64),
    )  # fmt: skip
    for axis in range(2):
        ring_box[0, axis], ring_box[1, axis] = ring[:, axis].min(), ring[:, axis].max()
    # The sender in its own frame, for shafts of regions.
    flat_normal, flat_up, flat_ring = np.zeros(3), np.array([0.0, 0.0, 1.0]), np.zeros((1, 3))
    flat_low, flat_high = np.zeros(3), np.zeros(3)
    flat_low[:2], flat_high[:2] = ring_box[0], ring_box[1]
    longest = 0
    for t in chosen:
        longest = max(longest, tile_start[t + 1] - tile_start[t])
    places = np.empty((longest, 3))
    # Rows of the points asked for, region after region, and the regions yet to be looked at.
    rows, spare = np.empty(longest, np.int64), np.empty(longest, np.int64)
    stack = np.empty((longest + 8, 2), np.int64)
    region = np.empty((2, 2))
    nodes = (
        np.empty(NODES, np.int64), np.empty(NODES), np.empty((NODES, TERMS)), np.empty((TERMS, TERMS)), np.empty(TERMS),
        np.empty(NODES), np.empty(TERMS),
    )  # fmt: skip
    node_row, node_value = nodes[0], nodes[5]
    node_lines = min(math.ceil(fewest * NODE_NOISE ** (-2.0 / 3.0)), most)

    for t in chosen:
        first, last = tile_start[t], tile_start[t + 1]
        mark += 1
        tile_mark = mark
        for i in range(first, last):
            places[i - first, 0], places[i - first, 1], places[i - first, 2] = _turned(
                axes, points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
            )
            if own[i] >= 0 and own[i] != tile_own[t]:
                owned[own[i]] = tile_mark
        _bounds(places, 0, last - first, box)
        asked = 0
        for i in range(first, last):
            if state[i] == STATE_COMPLEX:
                rows[asked] = i
                asked += 1
        if box[0, 2] <= 0.0 or asked == 0:
            continue
        various = tile_own[t] == DIFFERENT
        level = not various and (tile_normal[t, 0] != 0.0 or tile_normal[t, 1] != 0.0 or tile_normal[t, 2] != 0.0)
        price = worth * asked
        if level:
            price = min(price, worth * RAYED + FIT_NS * asked)
        budget = min(many_pieces, max(int(price / PIECE_NS), 64))
        used = tile_shaft(
            tile_bounds[t], tile_normal[t], tile_offset[t], sender_low, sender_high, sender_normal, corners, slack,
            planes,
        )  # fmt: skip
        tally[SHAFT] += 1
        met = boxes_meeting_planes(
            low, high, skip, head, leaf, order, bounds, planes, used, slack, found[:budget], tally
        )
        if met > budget:
            continue
        kept = apart = 0
        pane = False
        for c in range(met):
            p = found[c]
            if piece_polygon[p] == sender_own or piece_polygon[p] == tile_own[t]:
                continue
            if height[p, 1] <= slack or height[p, 0] >= box[1, 2]:
                continue
            pane = pane or through[p] > 0.0
            if height[p, 0] < -slack or height[p, 1] > (1.0 - NEAR) * box[0, 2]:
                loose[apart] = p
                apart += 1
                continue
            piece_mark[p] = mark
            piece_class[p] = UNSURE if owned[piece_polygon[p]] == tile_mark else _side(plane[p], box)
            found[kept] = p
            kept += 1
        if pane:
            continue
        if kept + apart == 0:
            tally[EMPTY] += 1
        tile_edges = _tile_edges(found[:kept], box, ring_box, table, frame, mark, tile_marks, tile_out)
        if tile_edges > tile_room:
            continue
        stack[0, 0], stack[0, 1] = 0, asked
        top = 0
        while top >= 0:
            a, b = stack[top, 0], stack[top, 1]
            top -= 1
            if not level and b - a > GROUP:
                top = cut_runs(a, b, GROUP, stack, top)
                continue
            mark += 1
            _bounds_of(places, rows, a, b, first, box)
            edges, highest = _narrow(
                tile_edges, tile_out, box, ring_box, table, frame, mark, tile_mark, owned, group_marks, group_out
            )
            close = 0
            if apart:
                used = tile_shaft(box, flat_normal, 0.0, flat_low, flat_high, flat_up, flat_ring, slack, planes)
                close = _inside(loose[:apart], table, place, planes, used, slack, loose_here)
            # Where no edge can pass before the sender all points see alike: one tells.
            smooth = level and close == 0
            alike = smooth and highest == -np.inf
            fitted = smooth and not alike and b - a > FEW
            looks = NODES / (b - a) if fitted else 1.0
            dear = edges > group_room or looks * (edges * EDGE_NS + close * LOOSE_NS + fewest * LINE_NS) > worth
            if fitted:
                count = 0
                if not dear and _blurred(box, highest, ring_box, width):
                    count = pick_nodes(flat, rows, a, b, region, nodes)
                if count == 0:
                    top = quarter(flat, rows, a, b, spare, stack, top)
                    continue
            elif not alike and (b - a > GROUP or ((dear or edges > CROWDED) and b - a > PART)):
                top = quarter(flat, rows, a, b, spare, stack, top) if level else cut_runs(a, b, PART, stack, top)
                continue
            elif dear:
                continue
            else:
                count = 1 if alike else b - a
            mark += 1
            settled, spots, unsure = _gather_edges(edges, group_out, table, frame, mark, group_marks, group)
            sizes = edges, settled, spots, unsure
            lit = dark = 0
            for k in range(count):
                i = node_row[k] if fitted else rows[a + k]
                if state[i] == STATE_COMPLEX:
                    nx, ny, nz = _turned(axes, normals[i, 0], normals[i, 1], normals[i, 2])
                    start = np.float64(hashed(index[i], seed) >> np.uint64(11)) * 2.0**-53  # of its lines, its own
                    seen, hidden, error = _look(
                        places[i - first, 0], places[i - first, 1], places[i - first, 2], nx, ny, nz, own[i],
                        start, node_lines if fitted else fewest, most,
                        NODE_NOISE * allowed if fitted else allowed, ring, group, sizes, frame, table,
                        loose_here[:close], various, scratch, tally,
                    )  # fmt: skip
                    if seen != STATE_COMPLEX:
                        state[i], share[i], doubt[i] = seen, (1.0 - hidden) * part[i], error * part[i]
                        candidates[i] = 0 if seen == STATE_CLEAR else limit + 1
                        tally[COMPLEX if seen == STATE_SAMPLED else CLEAR if seen == STATE_CLEAR else DARK] += 1
                lit += state[i] == STATE_CLEAR
                dark += state[i] == STATE_DARK
                if fitted:
                    node_value[k] = share[i] / part[i] if state[i] != STATE_COMPLEX else np.nan
            if alike and lit + dark == 1:
                i = rows[a]
                for k in range(a + 1, b):
                    j = rows[k]
                    if state[j] == STATE_COMPLEX:
                        state[j], candidates[j] = state[i], candidates[i]
                        share[j], doubt[j] = part[j] if lit else 0.0, 0.0
                        tally[CLEAR if lit else DARK] += 1
            elif fitted:
                # What all nodes agree on is made sure of at every point.
                off = np.inf if lit == count or dark == count else fit_cubic(flat, region, count, nodes)
                if not off <= FIT_MARGIN * allowed:
                    top = quarter(flat, rows, a, b, spare, stack, top)
                    continue
                for k in range(a, b):
                    i = rows[k]
                    if state[i] == STATE_COMPLEX:
                        state[i], candidates[i] = STATE_SAMPLED, limit + 1
                        share[i] = min(max(cubic_at(flat, i, region, nodes), 0.0), 1.0) * part[i]
                        doubt[i] = off * part[i]
                        tally[COMPLEX] += 1
                        tally[FITTED] += 1
