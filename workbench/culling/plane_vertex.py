"""The plane-vertex check: a polygon wholly outside one plane of a bundle cannot block it.

Source: A. Woo, "Efficient Shadow Computations in Ray Tracing" (IEEE CG&A 1993), Figures 3 and 5.
The bundle is every segment from one point to a convex sender: the light pyramid.  Its planes are
the E planes through the point and each edge of the sender, to which two more belong: the
receiver's tangent plane and the sender's own plane.  Signs come from the sender's centroid, never
from its winding.  A bundle whose rays do not share an origin needs a shaft instead.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

__all__ = ["CHECK_SLACK", "light_pyramid", "outside_planes", "plane_workspace"]

CHECK_SLACK = 1e-12
"""Distance, as a share of the scene's size, by which every vertex must lie outside to be culled."""


@njit(nogil=True, cache=True)
def light_pyramid(x, y, z, nx, ny, nz, sender, s0, s1, sender_normal, inset, planes):
    """Planes of the pyramid from (x, y, z) to the convex sender ``sender[s0:s1]``.

    Rows (nx, ny, nz, d) of ``planes`` hold unit normals pointing inward, ``n . x >= d`` inside: one
    a sender's edge, the receiver's tangent plane and the sender's plane.  A degenerate plane (the
    edge seen end on) is left out.  With ``inset`` above zero every plane moves inward by it, which
    drops polygons that only touch the pyramid from outside: right for irradiance (they hide a null
    set), wrong for single rays along an edge.  Returns the number of planes.
    """
    cx = cy = cz = 0.0
    count = s1 - s0
    for i in range(s0, s1):
        cx += (sender[i, 0] - x) / count
        cy += (sender[i, 1] - y) / count
        cz += (sender[i, 2] - z) / count
    used = 0
    for i in range(s0, s1):
        j = i + 1 if i + 1 < s1 else s0
        ax, ay, az = sender[i, 0] - x, sender[i, 1] - y, sender[i, 2] - z
        ex, ey, ez = sender[j, 0] - sender[i, 0], sender[j, 1] - sender[i, 1], sender[j, 2] - sender[i, 2]
        px = ay * ez - az * ey
        py = az * ex - ax * ez
        pz = ax * ey - ay * ex
        length = math.sqrt(px * px + py * py + pz * pz)
        side = px * cx + py * cy + pz * cz
        span = math.sqrt((ax * ax + ay * ay + az * az) * (ex * ex + ey * ey + ez * ez))
        # Too flat to trust its direction or its side: such a plane culls nothing.
        if length <= 1e-9 * span or abs(side) <= 1e-9 * length * math.sqrt(cx * cx + cy * cy + cz * cz):
            continue
        if side < 0.0:
            length = -length
        px, py, pz = px / length, py / length, pz / length
        planes[used, 0], planes[used, 1], planes[used, 2] = px, py, pz
        planes[used, 3] = px * x + py * y + pz * z + inset
        used += 1
    planes[used, 0], planes[used, 1], planes[used, 2] = nx, ny, nz
    planes[used, 3] = nx * x + ny * y + nz * z + inset
    used += 1
    mx, my, mz = sender_normal[0], sender_normal[1], sender_normal[2]
    planes[used, 0], planes[used, 1], planes[used, 2] = mx, my, mz
    planes[used, 3] = mx * sender[s0, 0] + my * sender[s0, 1] + mz * sender[s0, 2] + inset
    return used + 1


@njit(nogil=True, cache=True)
def outside_planes(corners, start, stop, planes, used, slack):
    """Whether every vertex of ``corners[start:stop]`` lies outside one and the same plane.

    Outside means ``n . x < d - slack``: a polygon that only touches the bundle is kept.
    """
    for k in range(used):
        nx, ny, nz = planes[k, 0], planes[k, 1], planes[k, 2]
        limit = planes[k, 3] - slack
        outside = True
        for i in range(start, stop):
            if nx * corners[i, 0] + ny * corners[i, 1] + nz * corners[i, 2] >= limit:
                outside = False
                break
        if outside:
            return True
    return False


def plane_workspace(max_corners: int = 64) -> np.ndarray:
    """Scratch rows for :func:`light_pyramid`."""
    return np.empty((max_corners + 2, 4))
