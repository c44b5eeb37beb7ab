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
        bounds = geometry.piece_bounds
        order = np.arange(len(bounds))
        centre = bounds.mean(axis=1)
        low: list[NDArray[np.float64]] = []
        high: list[NDArray[np.float64]] = []
        skip: list[int] = []
        first: list[int] = []
        count: list[int] = []
        # Preorder with an explicit stack; (start, stop) ranges of ``order``.
        stack = [(0, len(bounds), -1)] if len(bounds) else []
        while stack:
            start, stop, parent_done = stack.pop()
            if start < 0:  # marker: the subtree that began at node ``stop`` is complete
                skip[stop] = len(low)
                continue
            node = len(low)
            inside = order[start:stop]
            low.append(bounds[inside, 0].min(axis=0))
            high.append(bounds[inside, 1].max(axis=0))
            skip.append(-1)
            first.append(start)
            stack.append((-1, node, parent_done))
            if stop - start <= LEAF_SIZE:
                count.append(stop - start)
                continue
            count.append(0)
            middle = (start + stop) // 2
            axis = int(np.argmax(np.ptp(centre[inside], axis=0)))
            # A stable sort on (centre, index): the tree does not depend on the platform's sort.
            by_axis = inside[np.lexsort((inside, centre[inside, axis]))]
            order[start:stop] = by_axis
            stack.append((middle, stop, node))
            stack.append((start, middle, node))
        return cls(
            low=np.asarray(low).reshape(-1, 3),
            high=np.asarray(high).reshape(-1, 3),
            skip=np.asarray(skip, dtype=np.int64),
            first=np.asarray(first, dtype=np.int64),
            count=np.asarray(count, dtype=np.int64),
            order=order.astype(np.int64),
        )


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
