"""Clipping of convex polygons by planes, as kernels on rows of corners."""

from __future__ import annotations

import numpy as np
from numba import njit

__all__ = ["clip_by_plane", "newell_normal"]


@njit(nogil=True, cache=True)
def clip_by_plane(source, count, nx, ny, nz, d, tolerance, target):
    """Keep the part of a convex polygon where ``n . x - d >= 0``.

    ``source[:count]`` holds the corners (3 columns); the kept corners go to ``target``.  A corner
    within ``tolerance`` of the plane counts as on it, so a polygon that only touches the plane
    from outside keeps nothing.  Returns the number of corners kept, 0 if no area is left, or -1
    if ``target`` is too short.
    """
    inside = False
    last = count - 1
    px, py, pz = source[last, 0], source[last, 1], source[last, 2]
    dp = nx * px + ny * py + nz * pz - d
    if abs(dp) <= tolerance:
        dp = 0.0
    kept = 0
    room = target.shape[0]
    for i in range(count):
        cx, cy, cz = source[i, 0], source[i, 1], source[i, 2]
        dc = nx * cx + ny * cy + nz * cz - d
        if abs(dc) <= tolerance:
            dc = 0.0
        if (dp > 0.0 and dc < 0.0) or (dp < 0.0 and dc > 0.0):
            if kept == room:
                return -1
            t = dp / (dp - dc)
            target[kept, 0] = px + t * (cx - px)
            target[kept, 1] = py + t * (cy - py)
            target[kept, 2] = pz + t * (cz - pz)
            kept += 1
        if dc >= 0.0:
            if kept == room:
                return -1
            target[kept, 0] = cx
            target[kept, 1] = cy
            target[kept, 2] = cz
            kept += 1
            if dc > 0.0:
                inside = True
        px, py, pz, dp = cx, cy, cz, dc
    return kept if inside and kept >= 3 else 0


@njit(nogil=True, cache=True)
def newell_normal(corners, start, stop):
    """Vector area (x, y, z) of the polygon ``corners[start:stop]``; its length is the area."""
    ox, oy, oz = corners[start, 0], corners[start, 1], corners[start, 2]
    sx = sy = sz = 0.0
    for i in range(start + 1, stop - 1):
        ax, ay, az = corners[i, 0] - ox, corners[i, 1] - oy, corners[i, 2] - oz
        bx, by, bz = corners[i + 1, 0] - ox, corners[i + 1, 1] - oy, corners[i + 1, 2] - oz
        sx += ay * bz - az * by
        sy += az * bx - ax * bz
        sz += ax * by - ay * bx
    return np.float64(0.5 * sx), np.float64(0.5 * sy), np.float64(0.5 * sz)
