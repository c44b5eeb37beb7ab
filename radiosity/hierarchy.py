"""The tree of hierarchical radiosity: clusters, surfaces, patches and elements as flat arrays.

P. Hanrahan, D. Salzman and L. Aupperle, "A rapid hierarchical radiosity algorithm" (SIGGRAPH 1991),
divide each polygon into a quadtree, lazily: a part exists only once a link was refined to it.
B. Smits, J. Arvo and D. Greenberg, "A clustering algorithm for radiosity in complex environments"
(SIGGRAPH 1994), put a tree of boxes above the polygons, so that many of them need not meet pair by
pair.  Here the boxes are split by place and by direction, whichever varies more, so that clusters
near the polygons face one way.

Every node owns a run of convex pieces, quads and triangles; the pieces of a cluster are those of
all polygons below it.  Children have larger numbers than their parents, and lie side by side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from radiosity.form_factors._sampling import place_on_pieces
from radiosity.patches import PatchMesh, small_facets
from workbench.geometry.flat import Geometry
from workbench.scene.model import Scene

__all__ = ["NODE_SAMPLES", "Hierarchy", "TreeArrays", "place_on_node"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NODE_SAMPLES = 8
"""Points that stand for equal parts of a node that is not a single quad or triangle."""
SLENDER = 1.6
"""Ratio of a quad's sides from which it is halved across the longer one, not quartered."""
_NORMAL_WEIGHT = 0.6
"""Weight of a spread of normals (at most 2) against one of places (at most 1) when a cluster is split."""


class TreeArrays(NamedTuple):
    """What kernels read of the tree; arrays are longer than what is in use."""

    parent: np.ndarray
    child: np.ndarray
    children: np.ndarray
    piece0: np.ndarray
    piece1: np.ndarray
    area: np.ndarray
    centroid: np.ndarray
    normal: np.ndarray
    cone: np.ndarray
    flat: np.ndarray
    low: np.ndarray
    high: np.ndarray
    size: np.ndarray
    polygon: np.ndarray
    surface: np.ndarray
    side: np.ndarray
    sample: np.ndarray
    opened: np.ndarray
    corners: np.ndarray
    starts: np.ndarray
    piece_normal: np.ndarray
    upto: np.ndarray
    samples: np.ndarray
    sample_normals: np.ndarray


@njit(nogil=True, cache=True)
def _binary_tree(features, order, start, stop, child):
    """Median splits of items by their most widely spread feature; returns the number of nodes.

    Rows of ``features`` hold place and weighted normal.  Node ``k`` covers ``order[start[k]:stop[k]]``
    and has the children ``child[k]`` and ``child[k] + 1``; one item makes a leaf (``child`` -1).
    """
    n = order.shape[0]
    start[0], stop[0] = 0, n
    used = 1
    node = 0
    while node < used:
        a, b = start[node], stop[node]
        child[node] = -1
        if b - a > 1:
            widest, best = 0, -1.0
            longest = 0.0
            for f in range(6):
                low = high = features[order[a], f]
                for i in range(a + 1, b):
                    value = features[order[i], f]
                    low, high = min(low, value), max(high, value)
                spread = high - low
                if f < 3:
                    longest = max(longest, spread)
                elif longest > 0.0:
                    # Places are measured by the longest side of the node's own box.
                    spread *= longest
                if spread > best:
                    widest, best = f, spread
            keys = np.empty(b - a)
            for i in range(a, b):
                keys[i - a] = features[order[i], widest]
            rank = np.argsort(keys, kind="mergesort")
            inside = order[a:b].copy()
            for i in range(b - a):
                order[a + i] = inside[rank[i]]
            middle = (a + b) // 2
            child[node] = used
            start[used], stop[used] = a, middle
            start[used + 1], stop[used + 1] = middle, b
            used += 2
        node += 1
    return used


@njit(nogil=True, cache=True)
def _describe_pieces(first, last, corners, starts, area, centroid, low, high):
    """Area, centroid and box of the pieces ``first..last``."""
    for p in range(first, last):
        a, b = starts[p], starts[p + 1]
        total = 0.0
        for axis in range(3):
            centroid[p, axis] = 0.0
            low[p, axis] = high[p, axis] = corners[a, axis]
            for k in range(a, b):
                low[p, axis] = min(low[p, axis], corners[k, axis])
                high[p, axis] = max(high[p, axis], corners[k, axis])
        for k in range(a + 1, b - 1):
            ux, uy, uz = corners[k, 0] - corners[a, 0], corners[k, 1] - corners[a, 1], corners[k, 2] - corners[a, 2]
            vx, vy, vz = (
                corners[k + 1, 0] - corners[a, 0],
                corners[k + 1, 1] - corners[a, 1],
                corners[k + 1, 2] - corners[a, 2],
            )
            cx, cy, cz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            part = 0.5 * math.sqrt(cx * cx + cy * cy + cz * cz)
            total += part
            for axis in range(3):
                centroid[p, axis] += part * (corners[a, axis] + corners[k, axis] + corners[k + 1, axis]) / 3.0
        area[p] = total
        for axis in range(3):
            centroid[p, axis] = centroid[p, axis] / total if total > 0.0 else corners[a, axis]


@njit(nogil=True, cache=True)
def _describe_nodes(count, tree, piece_area, piece_centroid, piece_low, piece_high):
    """Areas, centroids, boxes, mean normals and cones of static nodes, from the pieces upward."""
    for n in range(count - 1, -1, -1):
        area = 0.0
        c = np.zeros(3)
        m = np.zeros(3)
        for axis in range(3):
            tree.low[n, axis], tree.high[n, axis] = math.inf, -math.inf
        if tree.flat[n] == 1 or tree.children[n] == 0:
            for p in range(tree.piece0[n], tree.piece1[n]):
                area += piece_area[p]
                for axis in range(3):
                    c[axis] += piece_area[p] * piece_centroid[p, axis]
                    tree.low[n, axis] = min(tree.low[n, axis], piece_low[p, axis])
                    tree.high[n, axis] = max(tree.high[n, axis], piece_high[p, axis])
            m[:] = tree.normal[n]
            tree.cone[n] = 0.0
        else:
            for k in range(tree.child[n], tree.child[n] + tree.children[n]):
                area += tree.area[k]
                for axis in range(3):
                    c[axis] += tree.area[k] * tree.centroid[k, axis]
                    m[axis] += tree.area[k] * tree.normal[k, axis]
                    tree.low[n, axis] = min(tree.low[n, axis], tree.low[k, axis])
                    tree.high[n, axis] = max(tree.high[n, axis], tree.high[k, axis])
            length = math.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
            cone = 0.0
            if length > 1e-9 * area:
                for axis in range(3):
                    m[axis] /= length
                for k in range(tree.child[n], tree.child[n] + tree.children[n]):
                    cosine = m[0] * tree.normal[k, 0] + m[1] * tree.normal[k, 1] + m[2] * tree.normal[k, 2]
                    cone = max(cone, math.acos(min(max(cosine, -1.0), 1.0)) + tree.cone[k])
            else:
                cone = math.pi
                m[0], m[1], m[2] = 0.0, 0.0, 1.0
            tree.cone[n] = min(cone, math.pi)
        tree.area[n] = area
        square = 0.0
        for axis in range(3):
            tree.centroid[n, axis] = c[axis] / area if area > 0.0 else tree.low[n, axis]
            tree.normal[n, axis] = m[axis]
            side = tree.high[n, axis] - tree.low[n, axis]
            square += side * side
        tree.size[n] = math.sqrt(square)


@njit(nogil=True, cache=True)
def place_on_node(node, tree, u, v, out):
    """Point of a node at (u, v), uniform by area; returns its piece, found by the areas up to each."""
    low, high = tree.piece0[node], tree.piece1[node] - 1
    if low < high:
        before = tree.upto[low]
        goal = before + u * (tree.upto[high + 1] - before)
        while low < high:
            middle = (low + high) // 2
            if tree.upto[middle + 1] > goal:
                high = middle
            else:
                low = middle + 1
        own = tree.upto[low + 1] - tree.upto[low]
        u = min(max((goal - tree.upto[low]) / own, 0.0), 1.0) if own > 0.0 else 0.5
        return place_on_pieces(tree.corners, tree.starts, low, low + 1, own, u, v, out)
    return place_on_pieces(tree.corners, tree.starts, low, low + 1, tree.area[node], u, v, out)


@njit(nogil=True, cache=True)
def _sample_nodes(nodes, tree):
    """Points and normals that stand for equal parts of the area of each of ``nodes``."""
    for row in range(nodes.shape[0]):
        n = nodes[row]
        tree.sample[n] = row
        for k in range(NODE_SAMPLES):
            u, v = (k + 0.5) / NODE_SAMPLES, (k * 0.6180339887498949 + 0.5) % 1.0
            piece = place_on_node(n, tree, u, v, tree.samples[row, k])
            for axis in range(3):
                tree.sample_normals[row, k, axis] = tree.piece_normal[piece, axis]


@njit(nogil=True, cache=True)
def _quarter(corners, a, quad, k, out):
    """Quarter ``k`` of a quad or triangle ``corners[a:]``."""
    for axis in range(3):
        p, q, r = corners[a, axis], corners[a + 1, axis], corners[a + 2, axis]
        pq, qr = 0.5 * (p + q), 0.5 * (q + r)
        if quad:
            s = corners[a + 3, axis]
            rs, sp = 0.5 * (r + s), 0.5 * (s + p)
            m = 0.25 * (p + q + r + s)
            if k == 0:
                out[0, axis], out[1, axis], out[2, axis], out[3, axis] = p, pq, m, sp
            elif k == 1:
                out[0, axis], out[1, axis], out[2, axis], out[3, axis] = pq, q, qr, m
            elif k == 2:
                out[0, axis], out[1, axis], out[2, axis], out[3, axis] = m, qr, r, rs
            else:
                out[0, axis], out[1, axis], out[2, axis], out[3, axis] = sp, m, rs, s
        else:
            rp = 0.5 * (r + p)
            if k == 0:
                out[0, axis], out[1, axis], out[2, axis] = p, pq, rp
            elif k == 1:
                out[0, axis], out[1, axis], out[2, axis] = pq, q, qr
            elif k == 2:
                out[0, axis], out[1, axis], out[2, axis] = rp, qr, r
            else:
                out[0, axis], out[1, axis], out[2, axis] = qr, rp, pq


@njit(nogil=True, cache=True)
def _half(corners, a, along, k, out):
    """Half ``k`` of a quad, cut across its first side (``along``) or across its second."""
    for axis in range(3):
        p, q, r, s = corners[a, axis], corners[a + 1, axis], corners[a + 2, axis], corners[a + 3, axis]
        if along:
            pq, rs = 0.5 * (p + q), 0.5 * (r + s)
            if k == 0:
                out[0, axis], out[1, axis], out[2, axis], out[3, axis] = p, pq, rs, s
            else:
                out[0, axis], out[1, axis], out[2, axis], out[3, axis] = pq, q, r, rs
        else:
            qr, sp = 0.5 * (q + r), 0.5 * (s + p)
            if k == 0:
                out[0, axis], out[1, axis], out[2, axis], out[3, axis] = p, q, qr, sp
            else:
                out[0, axis], out[1, axis], out[2, axis], out[3, axis] = sp, qr, r, s


@njit(nogil=True, cache=True)
def _side(corners, i, j):
    x, y, z = corners[j, 0] - corners[i, 0], corners[j, 1] - corners[i, 1], corners[j, 2] - corners[i, 2]
    return math.sqrt(x * x + y * y + z * z)


@njit(nogil=True, cache=True)
def _split_cells(nodes, tree, node, piece):
    """Give each of ``nodes``, single quads or triangles, its children; the next free node and piece."""
    out = np.empty((4, 3))
    for i in range(nodes.shape[0]):
        n = nodes[i]
        p = tree.piece0[n]
        a, b = tree.starts[p], tree.starts[p + 1]
        quad = b - a == 4
        count = 4
        along = True
        if quad:
            first = max(_side(tree.corners, a, a + 1), _side(tree.corners, a + 2, a + 3))
            second = max(_side(tree.corners, a + 1, a + 2), _side(tree.corners, a + 3, a))
            if max(first, second) > SLENDER * min(first, second):
                count = 2
                along = first > second
        tree.child[n], tree.children[n] = node, count
        for k in range(count):
            if count == 4:
                _quarter(tree.corners, a, quad, k, out)
            else:
                _half(tree.corners, a, along, k, out)
            s = tree.starts[piece]
            size = b - a
            for axis in range(3):
                tree.low[node, axis] = tree.high[node, axis] = out[0, axis]
                for c in range(size):
                    tree.corners[s + c, axis] = out[c, axis]
                    tree.low[node, axis] = min(tree.low[node, axis], out[c, axis])
                    tree.high[node, axis] = max(tree.high[node, axis], out[c, axis])
                tree.piece_normal[piece, axis] = tree.piece_normal[p, axis]
                tree.normal[node, axis] = tree.normal[n, axis]
            tree.starts[piece + 1] = s + size
            total = 0.0
            cx = cy = cz = 0.0
            for t in range(size - 2):
                ux, uy, uz = out[t + 1, 0] - out[0, 0], out[t + 1, 1] - out[0, 1], out[t + 1, 2] - out[0, 2]
                vx, vy, vz = out[t + 2, 0] - out[0, 0], out[t + 2, 1] - out[0, 1], out[t + 2, 2] - out[0, 2]
                wx, wy, wz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
                part = 0.5 * math.sqrt(wx * wx + wy * wy + wz * wz)
                total += part
                cx += part * (out[0, 0] + out[t + 1, 0] + out[t + 2, 0]) / 3.0
                cy += part * (out[0, 1] + out[t + 1, 1] + out[t + 2, 1]) / 3.0
                cz += part * (out[0, 2] + out[t + 1, 2] + out[t + 2, 2]) / 3.0
            tree.area[node] = total
            tree.upto[piece + 1] = tree.upto[piece] + total
            tree.centroid[node, 0], tree.centroid[node, 1], tree.centroid[node, 2] = cx / total, cy / total, cz / total
            square = 0.0
            for c in range(size):
                off = 0.0
                for axis in range(3):
                    d = out[c, axis] - tree.centroid[node, axis]
                    off += d * d
                square = max(square, off)
            tree.size[node] = 2.0 * math.sqrt(square)
            tree.parent[node], tree.child[node], tree.children[node] = n, -1, 0
            tree.piece0[node], tree.piece1[node] = piece, piece + 1
            tree.cone[node], tree.flat[node], tree.opened[node], tree.sample[node] = 0.0, 1, 0, -1
            tree.polygon[node], tree.surface[node], tree.side[node] = tree.polygon[n], tree.surface[n], tree.side[n]
            node += 1
            piece += 1
    return node, piece


@njit(nogil=True, cache=True)
def _holds(node, tree, x, y, z, tolerance):
    """Whether a flat node of one piece holds a point of its plane."""
    p = tree.piece0[node]
    a, b = tree.starts[p], tree.starts[p + 1]
    nx, ny, nz = tree.normal[node, 0], tree.normal[node, 1], tree.normal[node, 2]
    last = b - 1
    for i in range(a, b):
        ex, ey, ez = (
            tree.corners[i, 0] - tree.corners[last, 0],
            tree.corners[i, 1] - tree.corners[last, 1],
            tree.corners[i, 2] - tree.corners[last, 2],
        )
        px, py, pz = x - tree.corners[last, 0], y - tree.corners[last, 1], z - tree.corners[last, 2]
        last = i
        inside = nx * (ey * pz - ez * py) + ny * (ez * px - ex * pz) + nz * (ex * py - ey * px)
        if inside < -tolerance * math.sqrt(ex * ex + ey * ey + ez * ez):
            return False
    return True


@njit(nogil=True, cache=True)
def _leaf_beyond(node, tree, x, y, z, tolerance):
    """The leaf of the same polygon that holds a point outside ``node``, -1 if there is none."""
    at = node
    while True:
        parent = tree.parent[at]
        if parent < 0 or tree.flat[parent] == 0:
            return -1
        # Of what is above, the first with a part that holds the point.
        found = -1
        for k in range(tree.child[parent], tree.child[parent] + tree.children[parent]):
            if k != at and _holds(k, tree, x, y, z, tolerance):
                found = k
                break
        at = parent
        if found >= 0:
            at = found
            break
    while tree.opened[at] == 1:
        found = -1
        for k in range(tree.child[at], tree.child[at] + tree.children[at]):
            if _holds(k, tree, x, y, z, tolerance):
                found = k
                break
        if found < 0:
            return -1
        at = found
    return at


@njit(nogil=True, cache=True)
def _coarser_neighbours(nodes, tree, blocked, found):
    """Leaves that must be opened before ``nodes`` are, or edges would meet more than two of a neighbour's.

    ``blocked`` tells which nodes have any.  Returns the number of entries of ``found``, which may repeat.
    """
    count = 0
    for i in range(nodes.shape[0]):
        n = nodes[i]
        blocked[i] = False
        if tree.flat[n] == 0 or tree.piece1[n] - tree.piece0[n] != 1:
            continue
        a, b = tree.starts[tree.piece0[n]], tree.starts[tree.piece0[n] + 1]
        nx, ny, nz = tree.normal[n, 0], tree.normal[n, 1], tree.normal[n, 2]
        last = b - 1
        for k in range(a, b):
            px, py, pz = tree.corners[last, 0], tree.corners[last, 1], tree.corners[last, 2]
            ex, ey, ez = tree.corners[k, 0] - px, tree.corners[k, 1] - py, tree.corners[k, 2] - pz
            last = k
            length = math.sqrt(ex * ex + ey * ey + ez * ez)
            if length == 0.0:
                continue
            # A step outward from the middle of the edge; corners run counter-clockwise about the normal.
            step = 1e-5
            x = px + 0.5 * ex + step * (ey * nz - ez * ny)
            y = py + 0.5 * ey + step * (ez * nx - ex * nz)
            z = pz + 0.5 * ez + step * (ex * ny - ey * nx)
            other = _leaf_beyond(n, tree, x, y, z, 1e-9 * length)
            if other < 0:
                continue
            # The neighbour's edge there is the one that runs closest to the point.
            p = tree.piece0[other]
            before = tree.starts[p + 1] - 1
            best, its = math.inf, 0.0
            for c in range(tree.starts[p], tree.starts[p + 1]):
                fx, fy, fz = (
                    tree.corners[c, 0] - tree.corners[before, 0],
                    tree.corners[c, 1] - tree.corners[before, 1],
                    tree.corners[c, 2] - tree.corners[before, 2],
                )
                qx, qy, qz = (
                    x - tree.corners[before, 0],
                    y - tree.corners[before, 1],
                    z - tree.corners[before, 2],
                )
                before = c
                side = math.sqrt(fx * fx + fy * fy + fz * fz)
                cx, cy, cz = fy * qz - fz * qy, fz * qx - fx * qz, fx * qy - fy * qx
                away = math.sqrt(cx * cx + cy * cy + cz * cz) / side
                if away < best:
                    best, its = away, side
            if its > 1.001 * length:
                blocked[i] = True
                found[count] = other
                count += 1
    return count


@njit(nogil=True, cache=True)
def _leaves(tree, found):
    """Nodes that are not opened below opened ones, in the order of the tree; their number."""
    stack = np.empty(4096, dtype=np.int64)
    stack[0] = 0
    top, count = 0, 0
    while top >= 0:
        n = stack[top]
        top -= 1
        if tree.opened[n] == 0:
            found[count] = n
            count += 1
            continue
        for k in range(tree.children[n] - 1, -1, -1):
            top += 1
            if top == stack.shape[0]:
                longer = np.empty(2 * top, dtype=np.int64)
                longer[:top] = stack
                stack = longer
            stack[top] = tree.child[n] + k
    return count


@njit(nogil=True, cache=True)
def _spreads(nodes, tree, spread):
    """Mean square distance of the places of each of ``nodes`` from its centroid, by triangles."""
    for i in range(nodes.shape[0]):
        n = nodes[i]
        total = area = 0.0
        for p in range(tree.piece0[n], tree.piece1[n]):
            a, b = tree.starts[p], tree.starts[p + 1]
            for k in range(a + 1, b - 1):
                square = 0.0
                u, v = tree.corners[k] - tree.corners[a], tree.corners[k + 1] - tree.corners[a]
                c = np.cross(u, v)
                part = 0.5 * math.sqrt(c[0] * c[0] + c[1] * c[1] + c[2] * c[2])
                # Over a triangle: the mean over the middles of its edges.
                for axis in range(3):
                    here = tree.corners[a, axis] - tree.centroid[n, axis]
                    square += (here + 0.5 * u[axis]) ** 2 + (here + 0.5 * v[axis]) ** 2
                    square += (here + 0.5 * (u[axis] + v[axis])) ** 2
                total += part * square / 3.0
                area += part
        spread[i] = total / area if area > 0.0 else 0.0


def _ranges(first: IntArray, last: IntArray) -> IntArray:
    """All integers of the ranges ``first[i]:last[i]``, one after another."""
    counts = last - first
    return np.repeat(first - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())


class Hierarchy:
    """The tree over a scene, with parts made as they are asked for.

    A node is *opened* once it is looked at part by part; nodes that are not opened, below opened
    ones, are the *leaves*: the elements of the mesh.  All clusters of surfaces are open, and so are
    surfaces down to their polygons, except for the small facets of tessellated ones, which stay
    clustered until a link asks for more.

    Parameters
    ----------
    scene, geometry : Scene, Geometry
        A scene and its flattened form.
    """

    def __init__(self, scene: Scene, geometry: Geometry) -> None:
        self.scene, self.geometry = scene, geometry
        self.node_count = self.piece_count = 0
        self.leaf_count = 0
        self._build()

    # ---- the static part: from the scene down to the convex pieces of its polygons -------------

    def _build(self) -> None:
        geometry, scene = self.geometry, self.scene
        sides = [(s, sign) for s, f in enumerate(scene.surfaces) if f.face_count for sign in self._sides(s)]
        first_polygon = np.searchsorted(geometry.polygon_surface, np.arange(len(scene.surfaces) + 1))
        # Rows: place and direction of each polygon, seen from its front.
        place = self._polygon_centroids()
        top = []
        for s, sign in sides:
            own = slice(first_polygon[s], first_polygon[s + 1])
            weight = geometry.polygon_area[own][:, None]
            mean = (weight * geometry.polygon_normal[own]).sum(axis=0) / weight.sum()
            top.append([*(weight * place[own]).sum(axis=0) / weight.sum(), *(sign * _NORMAL_WEIGHT * mean)])
        parts = [self._subtree(np.asarray(top))]
        order, start, _, child = parts[0]
        parent = np.full(len(child), -1)
        inner = np.flatnonzero(child >= 0)
        parent[child[inner]] = parent[child[inner] + 1] = inner
        nodes = [np.column_stack([parent, child, np.where(child >= 0, 2, 0)])]
        leaf_of = {int(order[start[k]]): int(k) for k in np.flatnonzero(child < 0)}
        total = len(child)
        runs: list[tuple[int, int, IntArray]] = []  # surface, side, polygons in order
        span = np.zeros((total, 2), dtype=np.int64)  # positions in the sequence of all polygons
        spans, position = [span], 0
        surface_of = [np.full(total, -1)]
        side_of = [np.zeros(total, dtype=np.int64)]
        for item in order:
            s, sign = sides[item]
            members = np.arange(first_polygon[s], first_polygon[s + 1])
            features = np.column_stack([place[members], sign * _NORMAL_WEIGHT * geometry.polygon_normal[members]])
            order_s, start_s, stop_s, child_s = self._subtree(features)
            root = leaf_of[int(item)]
            # The subtree's root is the top tree's leaf; its other nodes follow the nodes so far.
            number = np.concatenate([[root], total + np.arange(len(child_s) - 1)]).astype(np.int64)
            child_global = np.where(child_s >= 0, number[np.maximum(child_s, 0)], -1)
            parent_s = np.empty(len(child_s), dtype=np.int64)
            inner = np.flatnonzero(child_s >= 0)
            parent_s[child_s[inner]] = parent_s[child_s[inner] + 1] = number[inner]
            many = np.where(child_s >= 0, 2, 0)
            nodes[0][root, 1:] = child_global[0], many[0]
            nodes.append(np.column_stack([parent_s[1:], child_global[1:], many[1:]]))
            bounds = np.column_stack([start_s, stop_s]) + position
            spans[0][root] = bounds[0]
            surface_of[0][root], side_of[0][root] = s, sign
            spans.append(bounds[1:])
            surface_of.append(np.full(len(child_s) - 1, s))
            side_of.append(np.full(len(child_s) - 1, sign))
            runs.append((s, sign, members[order_s]))
            total += len(child_s) - 1
            position += len(members)
        table, span = np.concatenate(nodes), np.concatenate(spans)
        # The top tree's inner nodes span what their children do.
        for k in range(len(parent) - 1, -1, -1):
            if child[k] >= 0:
                span[k] = span[child[k], 0], span[child[k] + 1, 1]
        polygons = np.concatenate([run for _, _, run in runs])
        signs = np.concatenate([np.full(len(run), sign) for _, sign, run in runs])
        corners, starts, owner = self._pieces(polygons, signs)
        piece_span = np.searchsorted(owner, np.arange(len(polygons) + 1))
        piece0, piece1 = piece_span[span[:, 0]], piece_span[span[:, 1]]
        single = span[:, 1] - span[:, 0] == 1
        polygon = np.where(single, polygons[span[:, 0]], -1)
        # Polygons of several pieces: a child each.
        several = np.flatnonzero(single & (piece1 - piece0 > 1))
        counts = piece1[several] - piece0[several]
        extra = int(counts.sum())
        table[several, 1] = total + np.cumsum(counts) - counts
        table[several, 2] = counts
        more = np.repeat(several, counts)
        pieces = _ranges(piece0[several], piece1[several])
        count = total + extra
        self._allocate(count, len(owner), len(corners))
        tree = self.arrays
        tree.parent[:count] = np.concatenate([table[:, 0], more])
        tree.child[:count] = np.concatenate([table[:, 1], np.full(extra, -1)])
        tree.children[:count] = np.concatenate([table[:, 2], np.zeros(extra, np.int64)])
        tree.piece0[:count] = np.concatenate([piece0, pieces])
        tree.piece1[:count] = np.concatenate([piece1, pieces + 1])
        tree.polygon[:count] = np.concatenate([polygon, polygon[more]])
        surface, side = np.concatenate(surface_of), np.concatenate(side_of)
        tree.surface[:count] = np.concatenate([surface, surface[more]])
        tree.side[:count] = np.concatenate([side, side[more]])
        tree.flat[:count] = tree.polygon[:count] >= 0
        tree.corners[: len(corners)] = corners
        tree.starts[: len(starts)] = starts
        flat = tree.polygon[:count] >= 0
        tree.normal[:count][flat] = (
            geometry.polygon_normal[tree.polygon[:count][flat]] * tree.side[:count][flat][:, None]
        )
        tree.piece_normal[: len(owner)] = geometry.polygon_normal[polygons[owner]] * signs[owner, None]
        area = np.empty(len(owner))
        centroid, low, high = np.empty((len(owner), 3)), np.empty((len(owner), 3)), np.empty((len(owner), 3))
        _describe_pieces(0, len(owner), corners, starts, area, centroid, low, high)
        tree.upto[1 : len(owner) + 1] = np.cumsum(area)
        _describe_nodes(count, tree, area, centroid, low, high)
        sampled = np.flatnonzero(tree.piece1[:count] - tree.piece0[:count] > 1)
        self._samples = np.zeros((max(len(sampled), 1), NODE_SAMPLES, 3))
        self._sample_normals = np.zeros_like(self._samples)
        self._fields["samples"], self._fields["sample_normals"] = self._samples, self._sample_normals
        self._refresh()
        _sample_nodes(sampled, self.arrays)
        self.node_count, self.piece_count, self._static = count, len(owner), count
        # What is open from the start: all above the surfaces, and all above a polygon worth an element.
        worth = np.ones(len(geometry.polygon_area), dtype=bool)
        for s, surface_record in enumerate(scene.surfaces):
            worth[first_polygon[s] + small_facets(surface_record, math.inf)] = False
        holds = np.concatenate([[0], np.cumsum(worth[polygons])])
        opened = np.zeros(count, dtype=bool)
        opened[:total] = ~single & ((surface < 0) | (holds[span[:, 1]] > holds[span[:, 0]]))
        tree = self.arrays
        tree.opened[:count] = opened
        self.leaf_count = len(self.leaves())

    def _sides(self, surface: int) -> tuple[int, ...]:
        return (1, -1) if self.scene.surfaces[surface].material.two_sided else (1,)

    def _polygon_centroids(self) -> FloatArray:
        """About the middle of each polygon: the mean of its pieces' boxes."""
        geometry = self.geometry
        middle = geometry.piece_bounds.mean(axis=1)
        first = geometry.polygon_piece_start[:-1]
        return np.add.reduceat(middle, first) / np.diff(geometry.polygon_piece_start)[:, None]

    @staticmethod
    def _subtree(features: FloatArray) -> tuple[IntArray, IntArray, IntArray, IntArray]:
        n = len(features)
        order = np.arange(n)
        start, stop, child = (np.empty(2 * n, dtype=np.int64) for _ in range(3))
        used = _binary_tree(np.ascontiguousarray(features), order, start, stop, child)
        return order, start[:used], stop[:used], child[:used]

    def _pieces(self, polygons: IntArray, signs: IntArray) -> tuple[FloatArray, IntArray, IntArray]:
        """Quads and triangles of polygons in order: corners, starts, and the place of each one's polygon."""
        geometry = self.geometry
        first, last = geometry.polygon_piece_start[polygons], geometry.polygon_piece_start[polygons + 1]
        pieces = _ranges(first, last)
        owner = np.repeat(np.arange(len(polygons)), last - first)
        sizes = geometry.piece_start[pieces + 1] - geometry.piece_start[pieces]
        # A piece of more corners becomes a fan of quads and a triangle.
        parts = np.where(sizes <= 4, 1, (sizes - 1) // 2)
        rows: list[IntArray] = []
        lengths: list[IntArray] = []
        if (parts == 1).all():
            index = _ranges(geometry.piece_start[pieces], geometry.piece_start[pieces + 1])
            lengths = [sizes]
        else:
            for piece in pieces.tolist():
                a, b = geometry.piece_start[piece : piece + 2].tolist()
                if b - a <= 4:
                    rows.append(np.arange(a, b))
                    lengths.append(np.asarray([b - a]))
                    continue
                for k in range(a + 1, b - 1, 2):
                    ring = [a, k, k + 1] + ([k + 2] if k + 2 < b else [])
                    rows.append(np.asarray(ring))
                    lengths.append(np.asarray([len(ring)]))
            index = np.concatenate(rows)
        size = np.concatenate(lengths)
        owner = np.repeat(owner, parts)
        starts = np.concatenate([[0], np.cumsum(size)]).astype(np.int64)
        corners = geometry.corners[index]
        back = np.flatnonzero(signs[owner] < 0)
        if len(back):
            # The back of a two-sided polygon runs the other way round.
            forward = _ranges(starts[back], starts[back + 1])
            place = np.repeat(starts[back] + starts[back + 1] - 1, size[back])
            corners[forward] = corners[place - forward]
        return np.ascontiguousarray(corners), starts, owner

    # ---- growth --------------------------------------------------------------------------------

    def _allocate(self, nodes: int, pieces: int, corners: int) -> None:
        room = nodes + max(nodes // 2, 1024)
        piece_room = pieces + max(pieces // 2, 1024)
        corner_room = corners + max(corners // 2, 4096)
        self._fields: dict[str, np.ndarray] = {
            name: np.zeros(room, dtype=np.int64)
            for name in ("parent", "child", "children", "piece0", "piece1", "polygon", "surface", "side")
        }
        self._fields |= {name: np.zeros(room) for name in ("area", "cone", "size")}
        self._fields |= {name: np.zeros((room, 3)) for name in ("centroid", "normal", "low", "high")}
        self._fields |= {name: np.zeros(room, dtype=np.uint8) for name in ("flat", "opened")}
        self._fields["sample"] = np.full(room, -1, dtype=np.int64)
        self._fields["corners"] = np.zeros((corner_room, 3))
        self._fields["starts"] = np.zeros(piece_room + 1, dtype=np.int64)
        self._fields["piece_normal"] = np.zeros((piece_room, 3))
        self._fields["upto"] = np.zeros(piece_room + 1)
        self._fields["samples"] = np.zeros((1, NODE_SAMPLES, 3))
        self._fields["sample_normals"] = np.zeros((1, NODE_SAMPLES, 3))
        self._refresh()

    def _refresh(self) -> None:
        self.arrays = TreeArrays(**self._fields)

    def _reserve(self, nodes: int) -> None:
        """Make room for ``nodes`` more cells."""
        corners = int(self.arrays.starts[self.piece_count])
        room = {
            "corners": corners + 4 * nodes,
            "starts": self.piece_count + nodes + 1,
            "piece_normal": self.piece_count + nodes,
            "upto": self.piece_count + nodes + 1,
        }
        for name, old in self._fields.items():
            wanted = room.get(name, self.node_count + nodes)
            if name not in ("samples", "sample_normals") and len(old) < wanted:
                fresh = np.zeros((wanted + wanted // 2, *old.shape[1:]), dtype=old.dtype)
                fresh[: len(old)] = old
                self._fields[name] = fresh
        self._refresh()

    def open(self, nodes: IntArray) -> None:
        """Open leaves (distinct), making the parts of those that are single quads or triangles."""
        tree = self.arrays
        whole = nodes[tree.children[nodes] == 0]
        if len(whole):
            self._reserve(4 * len(whole))
            self.node_count, self.piece_count = _split_cells(whole, self.arrays, self.node_count, self.piece_count)
        tree = self.arrays
        tree.opened[nodes] = 1
        self.leaf_count += int(tree.children[nodes].sum()) - len(nodes)

    @property
    def split(self) -> IntArray:
        """Single quads and triangles that were given parts, in the order in which that was done, (k,)."""
        tree = self.arrays
        cells = np.flatnonzero(tree.child[: self.node_count] >= self._static)
        return cells[np.argsort(tree.child[cells], kind="stable")]

    def restore(self, split: IntArray, opened: NDArray) -> None:
        """Make a fresh tree the one that had been split and opened so."""
        self._reserve(4 * len(split))
        self.node_count, self.piece_count = _split_cells(split, self.arrays, self.node_count, self.piece_count)
        self.arrays.opened[: self.node_count] = opened
        self.leaf_count = len(self.leaves())

    def open_balanced(self, nodes: IntArray, room: float = math.inf) -> NDArray[np.bool_]:
        """Open leaves (distinct), those first that may be taken from; keeps the quadtree of each polygon balanced.

        Balanced 2:1 (B. Von Herzen and A. Barr, "Accurate triangulations of deformed, intersecting surfaces",
        SIGGRAPH 1987): an edge meets at most two of a neighbour's.  Neighbours are opened as that asks.

        Parameters
        ----------
        nodes : (k,) int
            Leaves, the most wanted first.
        room : float
            Most leaves that may be added.

        Returns
        -------
        (k,) bool
            Which were opened: all, if there is room.
        """
        limit = self.leaf_count + room
        while True:
            # What must be opened before what: a layer waits for the one above it.
            layers = [nodes[self.arrays.opened[nodes] == 0]]
            seen = layers[0]
            while len(layers[-1]):
                layers.append(np.setdiff1d(self._blockers(layers[-1])[1], seen))
                seen = np.concatenate([seen, layers[-1]])
            count = self.leaf_count
            for layer in reversed(layers[:-1]):
                self._open_within(layer[~self._blockers(layer)[0]], limit)
            if self.leaf_count == count:
                # Pieces round a hole may each wait for the next one.
                self._open_within(layers[0], limit)
                return self.arrays.opened[nodes] == 1

    def _open_within(self, nodes: IntArray, limit: float) -> None:
        """Open as many of ``nodes`` as leave no more leaves than ``limit``."""
        tree = self.arrays
        parts = np.where(tree.children[nodes] > 0, tree.children[nodes], 4)
        self.open(nodes[np.cumsum(parts - 1) <= limit - self.leaf_count])

    def _blockers(self, nodes: IntArray) -> tuple[NDArray[np.bool_], IntArray]:
        """Whether each of ``nodes`` has neighbours to be opened before it, and these (distinct)."""
        blocked, found = np.zeros(len(nodes), dtype=bool), np.empty(4 * len(nodes), dtype=np.int64)
        return blocked, np.unique(found[: _coarser_neighbours(nodes, self.arrays, blocked, found)])

    def leaves(self) -> IntArray:
        """The leaves, surface by surface, within one in the order of the tree."""
        found = np.empty(self.node_count, dtype=np.int64)
        found = found[: _leaves(self.arrays, found)]
        return found[np.argsort(self.arrays.surface[found], kind="stable")]

    def longest_edges(self, nodes: IntArray) -> FloatArray:
        """Longest edge of single quads and triangles, longest side of the box of others, (n,)."""
        tree = self.arrays
        longest = (tree.high[nodes] - tree.low[nodes]).max(axis=1)
        single = np.flatnonzero(tree.piece1[nodes] - tree.piece0[nodes] == 1)
        first = tree.starts[tree.piece0[nodes[single]]]
        count = tree.starts[tree.piece0[nodes[single]] + 1] - first
        for k in range(4):
            here = np.minimum(k, count - 1)
            after = np.where(here + 1 < count, here + 1, 0)
            edge = np.linalg.norm(tree.corners[first + after] - tree.corners[first + here], axis=1)
            longest[single] = edge if k == 0 else np.maximum(longest[single], edge)
        return longest

    def spreads(self, nodes: IntArray) -> FloatArray:
        """Mean square distance (n,) of the places of nodes from their centroids."""
        spread = np.empty(len(nodes))
        _spreads(nodes, self.arrays, spread)
        return spread

    # ---- meshes --------------------------------------------------------------------------------

    def mesh(self, nodes: IntArray) -> PatchMesh:
        """Nodes, usually the leaves, as a mesh of elements that each shoot for themselves."""
        tree = self.arrays
        pieces = _ranges(tree.piece0[nodes], tree.piece1[nodes])
        counts = tree.piece1[nodes] - tree.piece0[nodes]
        owner = np.repeat(np.arange(len(nodes)), counts)
        corners = tree.corners[_ranges(tree.starts[pieces], tree.starts[pieces + 1])]
        sizes = tree.starts[pieces + 1] - tree.starts[pieces]
        piece_start = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        away = np.linalg.norm(corners - tree.centroid[nodes][np.repeat(owner, sizes)], axis=1)
        first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        materials = [surface.material for surface in self.scene.surfaces]
        surface = tree.surface[nodes]
        piece_normal = np.ascontiguousarray(tree.piece_normal[pieces])
        return PatchMesh(
            corners=np.ascontiguousarray(corners),
            piece_start=piece_start,
            piece_element=owner.astype(np.int64),
            piece_normal=piece_normal,
            element_area=tree.area[nodes],
            element_normal=np.ascontiguousarray(tree.normal[nodes]),
            element_centroid=np.ascontiguousarray(tree.centroid[nodes]),
            element_size=2.0 * np.maximum.reduceat(away, piece_start[first[:-1]]),
            element_polygon=np.where(tree.flat[nodes] == 1, tree.polygon[nodes], -1),
            element_surface=surface,
            element_side=tree.side[nodes],
            element_patch=np.arange(len(nodes)),
            reflectance=np.ascontiguousarray(np.stack([m.reflectance for m in materials])[surface]),
            emission=np.ascontiguousarray(np.stack([m.emission for m in materials])[surface]),
            patch_start=np.arange(len(nodes) + 1),
            sender_corners=np.ascontiguousarray(corners),
            sender_start=piece_start,
            sender_normal=piece_normal,
            patch_sender=first,
            patch_polygon=np.where(tree.flat[nodes] == 1, tree.polygon[nodes], -1),
            facet_error=max((s.facet_error for s in self.scene.surfaces), default=0.0),
        )
