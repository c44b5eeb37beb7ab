"""Shaft culling: which pieces may come between a group of receivers and a sender.

Source: E. A. Haines and J. R. Wallace, "Shaft culling for efficient ray-traced radiosity"
(Eurographics Workshop on Rendering 1991).  The shaft of two boxes is the convex hull of both: the
box round both, cut by planes that link an edge of one to an edge of the other.  A linking plane is
taken only when every corner of both boxes lies on its inner side, so overlapping, touching and
flat boxes need no case of their own: planes that would cut into the hull are never made.
"""

from __future__ import annotations

import math

from numba import njit

__all__ = ["MAX_SHAFT_PLANES", "box_shaft", "tile_shaft"]

MAX_SHAFT_PLANES = 6 + 12 + 2
"""Union box, linking planes, and the planes of a flat receiver and sender."""


@njit(nogil=True, cache=True)
def box_shaft(alow, ahigh, blow, bhigh, planes):
    """Planes (nx, ny, nz, d), inside ``n . x >= d``, of the shaft between two boxes; their number."""
    used = 0
    size = 0.0
    for axis in range(3):
        lo, hi = min(alow[axis], blow[axis]), max(ahigh[axis], bhigh[axis])
        size = max(size, hi - lo)
        for k in range(4):
            planes[used, k] = 0.0
            planes[used + 1, k] = 0.0
        planes[used, axis], planes[used, 3] = 1.0, lo
        planes[used + 1, axis], planes[used + 1, 3] = -1.0, -hi
        used += 2
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for c in range(4):
            # A corner of a and the same corner of b, seen along the axis.
            au, av = ahigh[u] if c & 1 else alow[u], ahigh[v] if c & 2 else alow[v]
            du, dv = (bhigh[u] if c & 1 else blow[u]) - au, (bhigh[v] if c & 2 else blow[v]) - av
            length = math.sqrt(du * du + dv * dv)
            # An axis-aligned link is a side of the union box, which is there already.
            if du == 0.0 or dv == 0.0 or length <= 1e-9 * size:
                continue
            pu, pv = -dv / length, du / length
            d = pu * au + pv * av
            lowest, highest = 0.0, 0.0
            for k in range(4):
                off_a = pu * (ahigh[u] if k & 1 else alow[u]) + pv * (ahigh[v] if k & 2 else alow[v]) - d
                off_b = pu * (bhigh[u] if k & 1 else blow[u]) + pv * (bhigh[v] if k & 2 else blow[v]) - d
                lowest = min(lowest, off_a, off_b)
                highest = max(highest, off_a, off_b)
            if lowest < -1e-12 * size and highest > 1e-12 * size:
                continue
            if lowest < -1e-12 * size:
                pu, pv, d = -pu, -pv, -d
                lowest = -highest
            for k in range(4):
                planes[used, k] = 0.0
            planes[used, u], planes[used, v] = pu, pv
            planes[used, 3] = d + min(lowest, 0.0)
            used += 1
    return used


@njit(nogil=True, cache=True)
def tile_shaft(bounds, normal, offset, sender_low, sender_high, sender_normal, ring, slack, planes):
    """Planes of the shaft from a tile of receivers to a flat sender; their number.

    ``bounds`` (2, 3) is the tile's box, ``normal`` (3,) and ``offset`` its plane (a zero normal for a
    tile that is not flat), ``ring`` (k, 3) are the sender's corners.  All planes move inward by twice
    ``slack``: irradiance is an integral, and what only touches the shaft hides a null set.
    """
    used = box_shaft(bounds[0], bounds[1], sender_low, sender_high, planes)
    if normal[0] != 0.0 or normal[1] != 0.0 or normal[2] != 0.0:
        planes[used, 0], planes[used, 1], planes[used, 2] = normal[0], normal[1], normal[2]
        planes[used, 3] = offset
        used += 1
    planes[used, 0], planes[used, 1], planes[used, 2] = sender_normal[0], sender_normal[1], sender_normal[2]
    planes[used, 3] = sender_normal[0] * ring[0, 0] + sender_normal[1] * ring[0, 1] + sender_normal[2] * ring[0, 2]
    used += 1
    for k in range(used):
        planes[k, 3] += 2.0 * slack
    return used
