"""The exchange area of two convex polygons that see each other whole, as kernels.

The double contour integral is exact to rounding for nearly every pair:

``A_1 F_12 = 1/(2 pi) | sum_ij  (e_i . f_j)  int_0^1 int_0^1 ln r  ds dt |`` over the edges ``e_i`` of
one polygon and ``f_j`` of the other (E. M. Sparrow 1963; J. R. Howell's catalogue, eq. 5-42).

* Edges well apart: a product Gauss rule on ``ln(r^2 / r0^2) / 2`` written with ``log1p``, so that
  the common ``ln r0`` (which cancels round any closed contour) never costs digits.
* Edges close together or touching: the inner integral in closed form, the outer one by an
  adaptive Gauss-Kronrod rule, which halves its way down to the logarithmic end points.

Long slender pairs side by side are the exception: their edges' terms cancel nearly whole.  For them
Lambert's formula is integrated over one of the two, all of whose terms are positive.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from workbench.geometry.lambert import lambert_piece
from workbench.geometry.planes import newell_normal

_X12, _W12 = np.polynomial.legendre.leggauss(12)
_X12, _W12 = 0.5 * (_X12 + 1.0), 0.5 * _W12
_X6, _W6 = np.polynomial.legendre.leggauss(6)
_X6, _W6 = 0.5 * (_X6 + 1.0), 0.5 * _W6

# Gauss-Kronrod (7, 15) on [-1, 1]: positive nodes, Kronrod weights, Gauss weights (QUADPACK, 1983).
_GK_X = np.array(
    [
        0.991455371120812639206854697526329,
        0.949107912342758524526189684047851,
        0.864864423359769072789712788640926,
        0.741531185599394439863864773280788,
        0.586087235467691130294144691293834,
        0.405845151377397166906606412076961,
        0.207784955007898467600689403773245,
        0.0,
    ]
)
_GK_K = np.array(
    [
        0.022935322010529224963732008058970,
        0.063092092629978553290700663189204,
        0.104790010322250183839876322541518,
        0.140653259715525918745189590510238,
        0.169004726639267902826583426598550,
        0.190350578064785409913256402421014,
        0.204432940075298892414161999234649,
        0.209482141084727828012999174891714,
    ]
)
_GK_G = np.array(
    [
        0.0,
        0.129484966168869693270611432679082,
        0.0,
        0.279705391489276667901467771423780,
        0.0,
        0.381830050505118944950369775488975,
        0.0,
        0.417959183673469387755102040816327,
    ]
)

_DEPTH = 60
CONTOUR_ROWS = _DEPTH + 2

_FAR_ROUNDING = 4e-16
_NEAR_ROUNDING = 1e-15
"""Rounding error of an edge pair's term as a share of its parts, by the rule used; measured on slender plates."""
_INTERVALS = 1000
"""Most intervals into which an edge is halved."""

_X8, _W8 = np.polynomial.legendre.leggauss(8)
_X8, _W8 = 0.5 * (_X8 + 1.0), 0.5 * _W8
_CELLS = 4000
"""Most cells into which an area is halved."""


@njit(nogil=True, cache=True)
def _inner(yx, yy, yz, ax, ay, az, ux, uy, uz, length, log_r0):
    """Integral of ``ln(|x - y| / r0)`` over the edge from a, direction u, in closed form."""
    wx, wy, wz = yx - ax, yy - ay, yz - az
    p = wx * ux + wy * uy + wz * uz
    cx, cy, cz = wy * uz - wz * uy, wz * ux - wx * uz, wx * uy - wy * ux
    d = math.sqrt(cx * cx + cy * cy + cz * cz)
    s1, s0 = length - p, -p
    total = -length * (1.0 + log_r0)
    q1, q0 = s1 * s1 + d * d, s0 * s0 + d * d
    if q1 > 0.0:
        total += 0.5 * s1 * math.log(q1)
    if q0 > 0.0:
        total -= 0.5 * s0 * math.log(q0)
    if d > 0.0:
        total += d * math.atan2(d * length, d * d + s0 * s1)
    return total


@njit(nogil=True, cache=True)
def _kronrod(lo, hi, bx, by, bz, ex, ey, ez, ax, ay, az, ux, uy, uz, length, log_r0):
    """(Kronrod, Gauss) values of the outer integral over the parameters lo..hi."""
    mid, half = 0.5 * (lo + hi), 0.5 * (hi - lo)
    kronrod = gauss = 0.0
    for k in range(8):
        for sign in range(2):
            if k == 7 and sign == 1:
                break
            t = mid + half * (_GK_X[k] if sign == 0 else -_GK_X[k])
            value = _inner(bx + t * ex, by + t * ey, bz + t * ez, ax, ay, az, ux, uy, uz, length, log_r0)
            kronrod += _GK_K[k] * value
            gauss += _GK_G[k] * value
    return kronrod * half, gauss * half


@njit(nogil=True, cache=True)
def _segment_distance(ax, ay, az, ex, ey, ez, bx, by, bz, fx, fy, fz):
    """A lower bound on the distance of two segments, from their midpoints and lengths."""
    mx = ax + 0.5 * ex - bx - 0.5 * fx
    my = ay + 0.5 * ey - by - 0.5 * fy
    mz = az + 0.5 * ez - bz - 0.5 * fz
    reach = 0.5 * (math.sqrt(ex * ex + ey * ey + ez * ez) + math.sqrt(fx * fx + fy * fy + fz * fz))
    return math.sqrt(mx * mx + my * my + mz * mz) - reach, reach


@njit(nogil=True, cache=True)
def contour_integral(p, np_, q, nq, tolerance):
    """``A_P F_PQ`` of two convex polygons, each wholly in front of the other's plane; its rounding error.

    ``p[:np_]`` and ``q[:nq]`` are corners; ``tolerance`` is absolute, on the result.
    """
    return contour_integral_in(p, np_, q, nq, tolerance, np.empty((CONTOUR_ROWS, 3)))


@njit(nogil=True, cache=True)
def contour_integral_in(p, np_, q, nq, tolerance, stack):
    """:func:`contour_integral` with its scratch, (:data:`CONTOUR_ROWS`, 3)."""
    # r0: distance of the centroids; it only has to be of the right size.
    mx = my = mz = 0.0
    for i in range(np_):
        mx += p[i, 0] / np_
        my += p[i, 1] / np_
        mz += p[i, 2] / np_
    for j in range(nq):
        mx -= q[j, 0] / nq
        my -= q[j, 1] / nq
        mz -= q[j, 2] / nq
    square0 = mx * mx + my * my + mz * mz
    if square0 == 0.0:
        square0 = 1.0
    log_r0 = 0.5 * math.log(square0)
    share = 2.0 * math.pi * tolerance / (np_ * nq)
    total = rounding = 0.0
    for i in range(np_):
        a = p[i]
        b = p[(i + 1) % np_]
        ex, ey, ez = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        le = math.sqrt(ex * ex + ey * ey + ez * ez)
        for j in range(nq):
            c = q[j]
            d = q[(j + 1) % nq]
            fx, fy, fz = d[0] - c[0], d[1] - c[1], d[2] - c[2]
            lf = math.sqrt(fx * fx + fy * fy + fz * fz)
            dot = ex * fx + ey * fy + ez * fz
            if abs(dot) <= 1e-16 * le * lf or le == 0.0 or lf == 0.0:
                continue
            gap, reach = _segment_distance(a[0], a[1], a[2], ex, ey, ez, c[0], c[1], c[2], fx, fy, fz)
            if gap > 2.0 * reach:
                xs, ws = (_X6, _W6) if gap > 20.0 * reach else (_X12, _W12)
                value = 0.0
                for k in range(xs.size):
                    gx, gy, gz = a[0] + xs[k] * ex - c[0], a[1] + xs[k] * ey - c[1], a[2] + xs[k] * ez - c[2]
                    row = 0.0
                    for m in range(xs.size):
                        rx, ry, rz = gx - xs[m] * fx - mx, gy - xs[m] * fy - my, gz - xs[m] * fz - mz
                        # |m + r|^2 - |m|^2 without forming the large squares first.
                        excess = rx * (rx + 2.0 * mx) + ry * (ry + 2.0 * my) + rz * (rz + 2.0 * mz)
                        if excess > -0.5 * square0:
                            row += ws[m] * math.log1p(excess / square0)
                        else:  # edges far shorter than the way between the centroids, left by clipping in a corner
                            row += ws[m] * math.log(((rx + mx) ** 2 + (ry + my) ** 2 + (rz + mz) ** 2) / square0)
                    value += ws[k] * row
                total += 0.5 * dot * value
                rounding += _FAR_ROUNDING * abs(0.5 * dot * value)
                continue
            # Inner integral over the longer edge: its closed form is free of the singularity.
            if le >= lf:
                ax, ay, az, ux, uy, uz, length = a[0], a[1], a[2], ex / le, ey / le, ez / le, le
                bx, by, bz, gx, gy, gz, outer = c[0], c[1], c[2], fx, fy, fz, lf
            else:
                ax, ay, az, ux, uy, uz, length = c[0], c[1], c[2], fx / lf, fy / lf, fz / lf, lf
                bx, by, bz, gx, gy, gz, outer = a[0], a[1], a[2], ex, ey, ez, le
            cosine = dot / (le * lf)
            limit = share / (abs(cosine) * outer)
            # Rounding of the inner integral bounds what halving can still gain.
            noise = _NEAR_ROUNDING * length * (2.0 + abs(log_r0) + abs(math.log(length)))
            top = made = 0
            stack[0, 0], stack[0, 1], stack[0, 2] = 0.0, 1.0, 0.0
            value = 0.0
            while top >= 0:
                lo, hi, depth = stack[top, 0], stack[top, 1], stack[top, 2]
                top -= 1
                kronrod, gauss = _kronrod(lo, hi, bx, by, bz, gx, gy, gz, ax, ay, az, ux, uy, uz, length, log_r0)
                made += 1
                difference = abs(kronrod - gauss)
                if difference <= max(limit, noise) * (hi - lo) or depth >= _DEPTH - 1 or made >= _INTERVALS:
                    value += kronrod
                else:
                    mid = 0.5 * (lo + hi)
                    top += 1
                    stack[top, 0], stack[top, 1], stack[top, 2] = mid, hi, depth + 1.0
                    top += 1
                    stack[top, 0], stack[top, 1], stack[top, 2] = lo, mid, depth + 1.0
            total += cosine * outer * value
            rounding += noise * abs(cosine) * outer
    return abs(total) / (2.0 * math.pi), rounding / (2.0 * math.pi)


@njit(nogil=True, cache=True)
def _cell_rule(cell, nx, ny, nz, q, nq):
    """Integral of Lambert's formula for ``q[:nq]`` over a bilinear quad, by an 8 x 8 Gauss rule."""
    total = 0.0
    for i in range(8):
        u = _X8[i]
        for j in range(8):
            v = _X8[j]
            w0, w1, w2, w3 = (1.0 - u) * (1.0 - v), u * (1.0 - v), u * v, (1.0 - u) * v
            x = w0 * cell[0, 0] + w1 * cell[1, 0] + w2 * cell[2, 0] + w3 * cell[3, 0]
            y = w0 * cell[0, 1] + w1 * cell[1, 1] + w2 * cell[2, 1] + w3 * cell[3, 1]
            z = w0 * cell[0, 2] + w1 * cell[1, 2] + w2 * cell[2, 2] + w3 * cell[3, 2]
            ax = (1.0 - v) * (cell[1, 0] - cell[0, 0]) + v * (cell[2, 0] - cell[3, 0])
            ay = (1.0 - v) * (cell[1, 1] - cell[0, 1]) + v * (cell[2, 1] - cell[3, 1])
            az = (1.0 - v) * (cell[1, 2] - cell[0, 2]) + v * (cell[2, 2] - cell[3, 2])
            bx = (1.0 - u) * (cell[3, 0] - cell[0, 0]) + u * (cell[2, 0] - cell[1, 0])
            by = (1.0 - u) * (cell[3, 1] - cell[0, 1]) + u * (cell[2, 1] - cell[1, 1])
            bz = (1.0 - u) * (cell[3, 2] - cell[0, 2]) + u * (cell[2, 2] - cell[1, 2])
            area = (ay * bz - az * by) * nx + (az * bx - ax * bz) * ny + (ax * by - ay * bx) * nz
            total += _W8[i] * _W8[j] * area * max(lambert_piece(x, y, z, nx, ny, nz, q, 0, nq), 0.0)
    return total


@njit(nogil=True, cache=True)
def area_integral(p, np_, q, nq, tolerance):
    """``A_P F_PQ`` of two convex polygons by Lambert's formula over ``p``; its quadrature error.

    Arguments as in :func:`contour_integral`.  Cells are halved across their longer side until each
    agrees with its halves.
    """
    vx, vy, vz = newell_normal(p, 0, np_)
    area = math.sqrt(vx * vx + vy * vy + vz * vz)
    nx, ny, nz = vx / area, vy / area, vz / area
    cells = np.empty((_DEPTH + 2, 4, 3))
    state = np.empty((_DEPTH + 2, 2))
    total = error = 0.0
    made = 0
    fans = 1 if np_ == 4 else np_ - 2
    for k in range(fans):
        for axis in range(3):
            cells[0, 0, axis], cells[0, 1, axis], cells[0, 2, axis] = p[0, axis], p[k + 1, axis], p[k + 2, axis]
            # A triangle is a quad whose last corner falls on its first.
            cells[0, 3, axis] = p[3, axis] if fans == 1 and np_ == 4 else p[0, axis]
        state[0, 0], state[0, 1] = _cell_rule(cells[0], nx, ny, nz, q, nq), tolerance / fans
        top = 0
        while top >= 0:
            cell = cells[top].copy()
            value, allowed = state[top]
            along = across = 0.0
            for axis in range(3):
                d = cell[1, axis] + cell[2, axis] - cell[0, axis] - cell[3, axis]
                e = cell[2, axis] + cell[3, axis] - cell[0, axis] - cell[1, axis]
                along += d * d
                across += e * e
            for half in range(2):
                for axis in range(3):
                    a, b, c, d = cell[0, axis], cell[1, axis], cell[2, axis], cell[3, axis]
                    if along >= across:
                        ab, cd = 0.5 * (a + b), 0.5 * (c + d)
                        a, b, c, d = (a, ab, cd, d) if half == 0 else (ab, b, c, cd)
                    else:
                        bc, da = 0.5 * (b + c), 0.5 * (d + a)
                        a, b, c, d = (a, b, bc, da) if half == 0 else (da, bc, c, d)
                    cells[top + half, 0, axis], cells[top + half, 1, axis] = a, b
                    cells[top + half, 2, axis], cells[top + half, 3, axis] = c, d
                state[top + half, 0] = _cell_rule(cells[top + half], nx, ny, nz, q, nq)
            made += 1
            halves = state[top, 0] + state[top + 1, 0]
            difference = abs(halves - value)
            if difference <= max(allowed, 1e-15 * halves) or top >= _DEPTH - 1 or made >= _CELLS:
                total += halves
                error += difference
                top -= 1
            else:
                state[top, 1] = state[top + 1, 1] = 0.5 * allowed
                top += 1
    return total, error
