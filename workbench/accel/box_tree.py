"""A tree of bounding boxes over convex pieces, for shafts and light pyramids.

Rays go to Embree; this tree answers the other question: which pieces may meet a convex region.
Median split on the longest axis of the box centres; nodes in preorder.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workbench.geometry.flat import Geometry

__all__ = ["BoxTree", "boxes_meeting_planes"]

LEAF_SIZE = 4


@dataclass(frozen=True)
class BoxTree:
    """Nodes of the tree as arrays.

    Parameters
    ----------
    low, high : (m, 3) float
        Corners of each node's box.
    skip : (m,) int
        Node to go on with when this one is culled or done (preorder).
    first, count : (m,) int
        Range of ``order`` in a leaf; ``count`` is 0 in an inner node.
    order : (p,) int
        Piece indices, leaf after leaf.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    skip: NDArray[np.int64]
    first: NDArray[np.int64]
    count: NDArray[np.int64]
    order: NDArray[np.int64]

    @classmethod
    def build(cls, geometry: Geometry) -> BoxTree:
        """Build the tree over all convex pieces of a geometry."""
        return cls.over(geometry.piece_bounds)

    @classmethod
    def over(cls, bounds: NDArray[np.float64]) -> BoxTree:
        """Build the tree over boxes (p, 2, 3), each its low and its high corner."""
        count = len(bounds)
        order = np.arange(count)
        low, high = np.empty((2 * count, 3)), np.empty((2 * count, 3))
        skip, first, inside = (np.empty(2 * count, dtype=np.int64) for _ in range(3))
        used = _split_boxes(bounds, bounds.mean(axis=1), order, low, high, skip, first, inside) if count else 0
        return cls(
            low[:used].copy(), high[:used].copy(), skip[:used].copy(), first[:used].copy(), inside[:used].copy(), order
        )


@njit(nogil=True, cache=True)
def _split_boxes(bounds, centre, order, low, high, skip, first, count):
    """Fill the arrays of a tree (see :class:`BoxTree`) in preorder; the number of nodes."""
    # Ranges of ``order`` yet to be made into nodes; below zero, the node whose subtree is complete.
    stack = np.empty((256, 2), dtype=np.int64)
    stack[0, 0], stack[0, 1] = 0, order.shape[0]
    top = 0
    node = 0
    while top >= 0:
        start, stop = stack[top, 0], stack[top, 1]
        top -= 1
        if start < 0:
            skip[stop] = node
            continue
        axis, widest = 0, -1.0
        for k in range(3):
            low[node, k], high[node, k] = np.inf, -np.inf
            least, most = np.inf, -np.inf
            for i in range(start, stop):
                piece = order[i]
                low[node, k] = min(low[node, k], bounds[piece, 0, k])
                high[node, k] = max(high[node, k], bounds[piece, 1, k])
                least, most = min(least, centre[piece, k]), max(most, centre[piece, k])
            if most - least > widest:
                axis, widest = k, most - least
        first[node] = start
        top += 1
        stack[top, 0], stack[top, 1] = -1, node
        count[node] = 0
        if stop - start <= LEAF_SIZE:
            count[node] = stop - start
        else:
            # By centre, equal ones by number: the tree does not depend on the platform's sort.
            inside = np.sort(order[start:stop])
            keys = np.empty(stop - start)
            for i in range(stop - start):
                keys[i] = centre[inside[i], axis]
            rank = np.argsort(keys, kind="mergesort")
            for i in range(stop - start):
                order[start + i] = inside[rank[i]]
            middle = (start + stop) // 2
            stack[top + 1, 0], stack[top + 1, 1] = middle, stop
            stack[top + 2, 0], stack[top + 2, 1] = start, middle
            top += 2
        node += 1
    return node


@njit(nogil=True, cache=True)
def boxes_meeting_planes(low, high, skip, first, count, order, bounds, planes, used, slack, found, tally):
    """Pieces whose boxes are not wholly outside one of the half-spaces ``n . x >= d``.

    ``planes[:used]`` are rows (nx, ny, nz, d) with unit normals; ``slack`` widens each half-space.
    Indices go to ``found`` in the order of the tree; the return value is their number, which is
    larger than ``len(found)`` by one when there was no room (the list is then cut short).
    ``tally[0]`` counts box tests.
    """
    node = 0
    total = low.shape[0]
    hits = 0
    while node < total:
        outside = False
        tally[0] += 1
        for k in range(used):
            nx, ny, nz = planes[k, 0], planes[k, 1], planes[k, 2]
            reach = nx * (high[node, 0] if nx > 0.0 else low[node, 0])
            reach += ny * (high[node, 1] if ny > 0.0 else low[node, 1])
            reach += nz * (high[node, 2] if nz > 0.0 else low[node, 2])
            if reach < planes[k, 3] - slack:
                outside = True
                break
        if outside:
            node = skip[node]
            continue
        for i in range(first[node], first[node] + count[node]):
            piece = order[i]
            tally[0] += 1
            outside = False
            for k in range(used):
                nx, ny, nz = planes[k, 0], planes[k, 1], planes[k, 2]
                reach = nx * bounds[piece, 1 if nx > 0.0 else 0, 0]
                reach += ny * bounds[piece, 1 if ny > 0.0 else 0, 1]
                reach += nz * bounds[piece, 1 if nz > 0.0 else 0, 2]
                if reach < planes[k, 3] - slack:
                    outside = True
                    break
            if outside:
                continue
            if hits == found.shape[0]:
                return hits + 1
            found[hits] = piece
            hits += 1
        node += 1
    return hits
