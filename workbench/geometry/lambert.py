"""Lambert's formula: what share of a point's hemisphere a polygon fills, cosine-weighted.

A diffuse polygon of radiance ``L`` gives a point the irradiance ``pi L F`` where ``F`` is this
share, the form factor from the point (a differential element) to the polygon.

Source: J. H. Lambert, Photometria (1760); the vector form in D. R. Baum, H. E. Rushmeier and
J. M. Winget, "Improving radiosity solutions through the use of analytically determined
form-factors" (SIGGRAPH 1989), eq. 10.
"""

from __future__ import annotations

import math

from numba import njit

__all__ = ["lambert_piece"]

_HALF_OVER_PI = 0.5 / math.pi


@njit(nogil=True, cache=True, inline="always")
def _edge_term(ax, ay, az, bx, by, bz, nx, ny, nz):
    """Angle under which the edge a-b is seen from the origin, times its plane's normal along n."""
    ex, ey, ez = bx - ax, by - ay, bz - az
    # a x (b - a) equals a x b and keeps more digits when the edge is short and far away.
    cx = ay * ez - az * ey
    cy = az * ex - ax * ez
    cz = ax * ey - ay * ex
    square = cx * cx + cy * cy + cz * cz
    if square == 0.0:
        return 0.0
    length = math.sqrt(square)
    return math.atan2(length, ax * bx + ay * by + az * bz) * (cx * nx + cy * ny + cz * nz) / length


@njit(nogil=True, cache=True)
def lambert_piece(x, y, z, nx, ny, nz, corners, start, stop):
    """Share of the hemisphere at (x, y, z) about n that the convex ``corners[start:stop]`` fills.

    Counter-clockwise corners, seen from the point, count positive: a polygon that turns its back
    gives a negative share.  The part below the horizon is cut off.
    """
    total = 0.0
    has_exit = has_entry = False
    outx = outy = outz = inx = iny = inz = 0.0
    px, py, pz = corners[stop - 1, 0] - x, corners[stop - 1, 1] - y, corners[stop - 1, 2] - z
    dp = nx * px + ny * py + nz * pz
    for i in range(start, stop):
        cx, cy, cz = corners[i, 0] - x, corners[i, 1] - y, corners[i, 2] - z
        dc = nx * cx + ny * cy + nz * cz
        if dp >= 0.0:
            if dc >= 0.0:
                total += _edge_term(px, py, pz, cx, cy, cz, nx, ny, nz)
            else:
                t = dp / (dp - dc)
                outx, outy, outz = px + t * (cx - px), py + t * (cy - py), pz + t * (cz - pz)
                has_exit = True
                total += _edge_term(px, py, pz, outx, outy, outz, nx, ny, nz)
        elif dc >= 0.0:
            t = dp / (dp - dc)
            inx, iny, inz = px + t * (cx - px), py + t * (cy - py), pz + t * (cz - pz)
            has_entry = True
            total += _edge_term(inx, iny, inz, cx, cy, cz, nx, ny, nz)
        px, py, pz, dp = cx, cy, cz, dc
    if has_exit and has_entry:
        total += _edge_term(outx, outy, outz, inx, iny, inz, nx, ny, nz)
    return -total * _HALF_OVER_PI
