"""Exchange areas of single pairs of convex pieces, as kernels: what a point sees past occluders, and rules over points.

A pair is clear (quadrature chosen by distance, or the closed form) or seen in part: one end is cut exactly by the
occluders at the points of a rule on the other.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numba.core.cpu import CPUTargetOptions

from radiosity.form_factors._contour import CONTOUR_ROWS, contour_integral_in
from radiosity.form_factors.analytic import _clip_pair
from workbench.culling.tally import CLOSED, CUT, OVERFLOW, PIECES
from workbench.geometry.lambert import lambert_piece

MAX_CUT = 128
"""Longest candidate list of a pair that is cut exactly."""
MAX_FRAGMENTS = 512
"""Visible fragments of a sender after which a pair is left to rays."""
ROOM = 24
"""Corners that a fragment may have."""

FAR_SHARE = 0.3
"""Part of the wanted error of a visible share that the kernel at centroids may take."""

_INV_PI = 1.0 / math.pi

_PLAIN: dict[str, Any] = {"nogil": True, "cache": True}
if hasattr(CPUTargetOptions, "_nrt"):
    _PLAIN["_nrt"] = False
"""Kernels that allocate nothing and so need not count references: counting those of the many arrays that they
hand on takes longer than all their arithmetic (1.8 to 2 times the processor time of a matrix in all), and
threads would fight over the counts.  numba has no documented way to leave it out; a numba without this option
compiles the same kernels, slower ones."""


def pair_workspace(max_corners, fragments=MAX_FRAGMENTS):
    """Scratch of one thread: fragments, their sizes and weights, crossings, a clipped pair, kept occluders."""
    room = max(ROOM, 2 * max_corners + 6)
    return (
        np.empty((fragments + 2, room, 3)),
        np.empty(fragments + 2, dtype=np.int64),
        np.empty(fragments + 2),
        np.empty((4 * room * room, 2)),
        np.empty((4, 2 * room, 3)),
        np.empty(MAX_CUT, dtype=np.int64),
        np.empty((CONTOUR_ROWS, 3)),
        np.empty(5),
    )


@njit(**_PLAIN)
def subtract(corners, k0, k1, nx, ny, nz, d, through, x, y, z, fragments, sizes, weights, count, near):
    """Take from the fragments (relative to (x, y, z)) what one convex occluder hides from that point.

    The hidden part of space is convex: inside the cone of the occluder's edges and beyond its plane, so
    neither the occluder nor the sender needs to be cut by the other's plane first.  Returns the new
    number of fragments, -1 if there is no room.
    """
    height = nx * x + ny * y + nz * z - d
    if abs(height) <= near:
        return count
    sign = 1.0 if height > 0.0 else -1.0
    capacity = fragments.shape[0] - 2
    spare = capacity + 1
    room = fragments.shape[1]
    done = 0
    while done < count:
        size = sizes[done]
        # First look: wholly outside one plane means untouched.
        untouched = True
        cuts = False
        for i in range(size):
            if (
                -sign * (nx * fragments[done, i, 0] + ny * fragments[done, i, 1] + nz * fragments[done, i, 2])
                - abs(height)
                > near
            ):
                untouched = False
            else:
                cuts = True
        k = k0
        while not untouched and k < k1:
            m = k + 1 if k + 1 < k1 else k0
            ax, ay, az = corners[k, 0] - x, corners[k, 1] - y, corners[k, 2] - z
            bx, by, bz = corners[m, 0] - x, corners[m, 1] - y, corners[m, 2] - z
            px, py, pz = sign * (az * by - ay * bz), sign * (ax * bz - az * bx), sign * (ay * bx - ax * by)
            tiny = near * (abs(px) + abs(py) + abs(pz))
            outside = True
            for i in range(size):
                if px * fragments[done, i, 0] + py * fragments[done, i, 1] + pz * fragments[done, i, 2] > tiny:
                    outside = False
                    break
            untouched = outside
            k += 1
        if untouched:
            done += 1
            continue
        # Cut off, plane by plane, what lies outside; the rest is hidden.
        k = k0 - 1 if cuts else k0
        while k < k1 and size > 0:
            if k < k0:
                px, py, pz, off, tiny = -sign * nx, -sign * ny, -sign * nz, -abs(height), near
            else:
                m = k + 1 if k + 1 < k1 else k0
                ax, ay, az = corners[k, 0] - x, corners[k, 1] - y, corners[k, 2] - z
                bx, by, bz = corners[m, 0] - x, corners[m, 1] - y, corners[m, 2] - z
                px, py, pz = sign * (az * by - ay * bz), sign * (ax * bz - az * bx), sign * (ay * bx - ax * by)
                off = 0.0
                tiny = near * (abs(px) + abs(py) + abs(pz))
            k += 1
            any_out = False
            for i in range(size):
                if px * fragments[done, i, 0] + py * fragments[done, i, 1] + pz * fragments[done, i, 2] + off < -tiny:
                    any_out = True
                    break
            if not any_out:
                continue
            if count == capacity or size + 2 > room:
                return -1
            # Inside part to the scratch row, outside part to a new fragment.
            ins = outs = 0
            in_any = out_any = False
            qx, qy, qz = fragments[done, size - 1, 0], fragments[done, size - 1, 1], fragments[done, size - 1, 2]
            dq = px * qx + py * qy + pz * qz + off
            if abs(dq) <= tiny:
                dq = 0.0
            for i in range(size):
                cx, cy, cz = fragments[done, i, 0], fragments[done, i, 1], fragments[done, i, 2]
                dc = px * cx + py * cy + pz * cz + off
                if abs(dc) <= tiny:
                    dc = 0.0
                if (dq > 0.0 and dc < 0.0) or (dq < 0.0 and dc > 0.0):
                    t = dq / (dq - dc)
                    ex, ey, ez = qx + t * (cx - qx), qy + t * (cy - qy), qz + t * (cz - qz)
                    fragments[spare, ins, 0], fragments[spare, ins, 1], fragments[spare, ins, 2] = ex, ey, ez
                    fragments[count, outs, 0], fragments[count, outs, 1], fragments[count, outs, 2] = ex, ey, ez
                    ins += 1
                    outs += 1
                if dc >= 0.0:
                    fragments[spare, ins, 0], fragments[spare, ins, 1], fragments[spare, ins, 2] = cx, cy, cz
                    ins += 1
                    in_any = in_any or dc > 0.0
                if dc <= 0.0:
                    fragments[count, outs, 0], fragments[count, outs, 1], fragments[count, outs, 2] = cx, cy, cz
                    outs += 1
                    out_any = out_any or dc < 0.0
                qx, qy, qz, dq = cx, cy, cz, dc
            if out_any and outs >= 3:
                sizes[count] = outs
                weights[count] = weights[done]
                count += 1
            size = ins if in_any and ins >= 3 else 0
            for i in range(size):
                fragments[done, i, 0], fragments[done, i, 1], fragments[done, i, 2] = (
                    fragments[spare, i, 0],
                    fragments[spare, i, 1],
                    fragments[spare, i, 2],
                )
        if through > 0.0 and size > 0:
            sizes[done] = size
            weights[done] *= through
            done += 1
            continue
        # The hidden rest gives its row to the last fragment.  That one is new (it lay outside this occluder)
        # or not yet looked at; new ones are looked at again, which finds them untouched.
        count -= 1
        if done != count:
            for i in range(sizes[count]):
                fragments[done, i, 0], fragments[done, i, 1], fragments[done, i, 2] = (
                    fragments[count, i, 0],
                    fragments[count, i, 1],
                    fragments[count, i, 2],
                )
            sizes[done] = sizes[count]
            weights[done] = weights[count]
    return count


@njit(**_PLAIN)
def _fragment_flux(fragments, row, count, nx, ny, nz, mx, my, mz):
    """Form factor from the origin to a small far fragment with normal m: the kernel at its parts' centroids."""
    ax, ay, az = fragments[row, 0, 0], fragments[row, 0, 1], fragments[row, 0, 2]
    total = 0.0
    for k in range(1, count - 1):
        bx, by, bz = fragments[row, k, 0], fragments[row, k, 1], fragments[row, k, 2]
        cx, cy, cz = fragments[row, k + 1, 0], fragments[row, k + 1, 1], fragments[row, k + 1, 2]
        ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
        twice = mx * (uy * vz - uz * vy) + my * (uz * vx - ux * vz) + mz * (ux * vy - uy * vx)
        gx, gy, gz = (ax + bx + cx) / 3.0, (ay + by + cy) / 3.0, (az + bz + cz) / 3.0
        square = gx * gx + gy * gy + gz * gz
        total -= twice * (nx * gx + ny * gy + nz * gz) * (mx * gx + my * gy + mz * gz) / (square * square)
    return 0.5 * _INV_PI * total


@njit(**_PLAIN)
def _load(target, t0, t1, x, y, z, fragments, sizes, weights):
    """Make the whole polygon, relative to (x, y, z), the only fragment; its reach."""
    reach = 0.0
    for i in range(t1 - t0):
        rx, ry, rz = target[t0 + i, 0] - x, target[t0 + i, 1] - y, target[t0 + i, 2] - z
        fragments[0, i, 0], fragments[0, i, 1], fragments[0, i, 2] = rx, ry, rz
        reach = max(reach, abs(rx), abs(ry), abs(rz))
    sizes[0] = t1 - t0
    weights[0] = 1.0
    return reach


@njit(**_PLAIN)
def _cut(
    x, y, z, reach, corners, start, normal, offset, through, kept, many, fragments, sizes, weights, tally
):  # fmt: skip
    """Take from the loaded polygon all that the occluders hide from (x, y, z); fragments left, -1 without room."""
    count = 1
    near = 1e-12 * reach
    for c in range(many):
        k = kept[c]
        count = subtract(
            corners, start[k], start[k + 1], normal[k, 0], normal[k, 1], normal[k, 2], offset[k], through[k], x, y, z,
            fragments, sizes, weights, count, near,
        )  # fmt: skip
        if count <= 0:
            break
    if count < 0:
        tally[OVERFLOW] += 1
        return -1
    tally[CUT] += 1
    tally[PIECES] += count
    return count


@njit(**_PLAIN)
def seen_share(
    x, y, z, nx, ny, nz, target, t0, t1, corners, start, normal, offset, through, kept, many, fragments, sizes,
    weights, tally,
):  # fmt: skip
    """Form factor from a point to what it sees of a convex polygon past its occluders; -1 without room.

    ``kept[:many]`` are the occluders ``corners[start[k]:start[k + 1]]``.
    """
    reach = _load(target, t0, t1, x, y, z, fragments, sizes, weights)
    count = _cut(x, y, z, reach, corners, start, normal, offset, through, kept, many, fragments, sizes, weights, tally)
    if count < 0:
        return -1.0
    total = 0.0
    for f in range(count):
        total += weights[f] * max(lambert_piece(0.0, 0.0, 0.0, nx, ny, nz, fragments[f], 0, sizes[f]), 0.0)
    return total


@njit(**_PLAIN)
def crossings(a, a0, a1, b, b0, b1, nx, ny, nz, d, ox, oy, oz, ux, uy, uz, vx, vy, vz, slack, out):
    """Where the segments between the corners of two polygons cross a plane: rows (u, v) of ``out``.

    The crossing of any segment between the polygons lies in their convex hull.  Returns their number,
    and whether the plane separates the polygons (touching it at most).
    """
    count = 0
    separates = True
    side = 0.0
    for i in range(a0, a1):
        hx, hy, hz = a[i, 0] - ox, a[i, 1] - oy, a[i, 2] - oz
        ha = nx * a[i, 0] + ny * a[i, 1] + nz * a[i, 2] - d
        if abs(ha) <= slack:
            out[count, 0] = ux * hx + uy * hy + uz * hz
            out[count, 1] = vx * hx + vy * hy + vz * hz
            count += 1
            continue
        if ha * side < 0.0:
            separates = False
        side = ha
        # Where an edge of a itself crosses the plane, segments leave from the plane.
        m = i + 1 if i + 1 < a1 else a0
        hm = nx * a[m, 0] + ny * a[m, 1] + nz * a[m, 2] - d
        if abs(hm) > slack and ha * hm < 0.0:
            t = ha / (ha - hm)
            px, py, pz = hx + t * (a[m, 0] - a[i, 0]), hy + t * (a[m, 1] - a[i, 1]), hz + t * (a[m, 2] - a[i, 2])
            out[count, 0], out[count, 1] = ux * px + uy * py + uz * pz, vx * px + vy * py + vz * pz
            count += 1
        for j in range(b0, b1):
            hb = nx * b[j, 0] + ny * b[j, 1] + nz * b[j, 2] - d
            if abs(hb) <= slack or ha * hb > 0.0:
                continue
            t = ha / (ha - hb)
            px, py, pz = hx + t * (b[j, 0] - a[i, 0]), hy + t * (b[j, 1] - a[i, 1]), hz + t * (b[j, 2] - a[i, 2])
            out[count, 0], out[count, 1] = ux * px + uy * py + uz * pz, vx * px + vy * py + vz * pz
            count += 1
    for j in range(b0, b1):
        hb = nx * b[j, 0] + ny * b[j, 1] + nz * b[j, 2] - d
        hx, hy, hz = b[j, 0] - ox, b[j, 1] - oy, b[j, 2] - oz
        if abs(hb) <= slack:
            out[count, 0] = ux * hx + uy * hy + uz * hz
            out[count, 1] = vx * hx + vy * hy + vz * hz
            count += 1
            continue
        if hb * side > 0.0:
            separates = False
        m = j + 1 if j + 1 < b1 else b0
        hm = nx * b[m, 0] + ny * b[m, 1] + nz * b[m, 2] - d
        if abs(hm) > slack and hb * hm < 0.0:
            separates = False
            t = hb / (hb - hm)
            px, py, pz = hx + t * (b[m, 0] - b[j, 0]), hy + t * (b[m, 1] - b[j, 1]), hz + t * (b[m, 2] - b[j, 2])
            out[count, 0], out[count, 1] = ux * px + uy * py + uz * pz, vx * px + vy * py + vz * pz
            count += 1
    return count, separates


CLEARS, HIDES, TOUCHES = 0, 1, 2


@njit(**_PLAIN)
def verdict(points, count, separates, flat, f0, f1, lows, highs, k, slack):
    """Whether an occluder in its plane's frame ``flat[f0:f1]`` clears, hides or touches all crossings."""
    if count == 0:
        return CLEARS
    ulow = vlow = math.inf
    uhigh = vhigh = -math.inf
    for i in range(count):
        u, v = points[i, 0], points[i, 1]
        ulow, uhigh = min(ulow, u), max(uhigh, u)
        vlow, vhigh = min(vlow, v), max(vhigh, v)
    if uhigh <= lows[k, 0] + slack or ulow >= highs[k, 0] - slack:
        return CLEARS
    if vhigh <= lows[k, 1] + slack or vlow >= highs[k, 1] - slack:
        return CLEARS
    inside_all = separates
    for e in range(f0, f1):
        m = e + 1 if e + 1 < f1 else f0
        eu, ev = flat[m, 0] - flat[e, 0], flat[m, 1] - flat[e, 1]
        tiny = slack * (abs(eu) + abs(ev))
        outside = True
        for i in range(count):
            turn = eu * (points[i, 1] - flat[e, 1]) - ev * (points[i, 0] - flat[e, 0])
            if turn > tiny:
                outside = False
            if turn < -tiny:
                inside_all = False
            if not outside and not inside_all:
                break
        if outside:
            return CLEARS
    return HIDES if inside_all else TOUCHES


@njit(**_PLAIN)
def _axis_verdict(ha, hb, cx, cy, cz, dx, dy, dz, square, larger, flat, f0, f1, lows, highs, frame, k):
    """:func:`verdict` for all segments between two balls on either side of the plane, or -1 where that is too wide.

    ``ha`` and ``hb`` are the heights of their centres, the first (cx, cy, cz), (dx, dy, dz) leads to the other.
    The segments cross within the larger radius of the axis, measured square to it.
    """
    t = ha / (ha - hb)
    px, py, pz = cx + t * dx - frame[k, 0], cy + t * dy - frame[k, 1], cz + t * dz - frame[k, 2]
    u = frame[k, 3] * px + frame[k, 4] * py + frame[k, 5] * pz
    v = frame[k, 6] * px + frame[k, 7] * py + frame[k, 8] * pz
    wide = larger * math.sqrt(square) / abs(ha - hb)
    if u + wide <= lows[k, 0] or u - wide >= highs[k, 0] or v + wide <= lows[k, 1] or v - wide >= highs[k, 1]:
        return CLEARS
    if u - wide < lows[k, 0] or u + wide > highs[k, 0] or v - wide < lows[k, 1] or v + wide > highs[k, 1]:
        return -1
    for e in range(f0, f1):
        m = e + 1 if e + 1 < f1 else f0
        eu, ev = flat[m, 0] - flat[e, 0], flat[m, 1] - flat[e, 1]
        turn = eu * (v - flat[e, 1]) - ev * (u - flat[e, 0])
        if turn < 0.0 or turn * turn < wide * wide * (eu * eu + ev * ev):
            return -1
    return HIDES


@njit(**_PLAIN)
def _span(normals, offsets, k, low, high, node):
    """Lowest and highest ``n . x - d`` of plane ``k`` over the box of a node."""
    lo = hi = -offsets[k]
    for axis in range(3):
        n = normals[k, axis]
        if n > 0.0:
            lo += n * low[node, axis]
            hi += n * high[node, axis]
        else:
            lo += n * high[node, axis]
            hi += n * low[node, axis]
    return lo, hi


@njit(**_PLAIN)
def _heights(nx, ny, nz, d, corners, a, b):
    """Lowest and highest ``n . x - d`` of corners."""
    lo, hi = math.inf, -math.inf
    for i in range(a, b):
        h = nx * corners[i, 0] + ny * corners[i, 1] + nz * corners[i, 2] - d
        lo, hi = min(lo, h), max(hi, h)
    return lo, hi


@njit(**_PLAIN, error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"})
def _kernel_sum(p, p0, p1, nx, ny, nz, q, q0, q1, mx, my, mz):
    """Product rule on the kernel cos cos / (pi r^2) between two sets of weighted points."""
    total = 0.0
    for i in range(p0, p1):
        x, y, z, w = p[i, 0], p[i, 1], p[i, 2], p[i, 3]
        row = 0.0
        for j in range(q0, q1):
            dx, dy, dz = q[j, 0] - x, q[j, 1] - y, q[j, 2] - z
            square = dx * dx + dy * dy + dz * dz
            row += q[j, 3] * (dx * nx + dy * ny + dz * nz) * -(dx * mx + dy * my + dz * mz) / (square * square)
        total += w * row
    return total * _INV_PI


@njit(**_PLAIN)
def _lambert_sum(p, p0, p1, nx, ny, nz, corners, c0, c1):
    """Rule on Lambert's formula for one convex polygon."""
    total = 0.0
    for i in range(p0, p1):
        total += p[i, 3] * lambert_piece(p[i, 0], p[i, 1], p[i, 2], nx, ny, nz, corners, c0, c1)
    return total


@njit(**_PLAIN)
def _gap(centroid, s, low, high, t):
    """Distance of the centroid of piece ``s`` from the box of piece ``t``."""
    square = 0.0
    for axis in range(3):
        off = max(low[t, axis] - centroid[s, axis], 0.0, centroid[s, axis] - high[t, axis])
        square += off * off
    return math.sqrt(square)


@njit(**_PLAIN)
def _clipped_sum(work, m, k, normal, i, j):
    """Exchange area of the clipped polygons ``work[2, :m]`` and ``work[3, :k]`` by three points a triangle.

    Also what they would exchange face to face, and the larger one's radius over their distance.
    """
    nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
    mx, my, mz = normal[j, 0], normal[j, 1], normal[j, 2]
    px = py = pz = qx = qy = qz = 0.0
    for c in range(m):
        px, py, pz = px + work[2, c, 0] / m, py + work[2, c, 1] / m, pz + work[2, c, 2] / m
    for c in range(k):
        qx, qy, qz = qx + work[3, c, 0] / k, qy + work[3, c, 1] / k, qz + work[3, c, 2] / k
    square = (px - qx) ** 2 + (py - qy) ** 2 + (pz - qz) ** 2
    largest = 0.0
    for c in range(m):
        largest = max(
            largest, (work[2, c, 0] - px) ** 2 + (work[2, c, 1] - py) ** 2 + (work[2, c, 2] - pz) ** 2
        )  # fmt: skip
    for c in range(k):
        largest = max(
            largest, (work[3, c, 0] - qx) ** 2 + (work[3, c, 1] - qy) ** 2 + (work[3, c, 2] - qz) ** 2
        )  # fmt: skip
    if largest >= square:
        return 0.0, 0.0, math.inf
    total = facing = 0.0
    for f in range(1, m - 1):
        # Cross products with the unit normal's direction: areas of the fan's triangles.
        ax, ay, az = work[2, f, 0] - work[2, 0, 0], work[2, f, 1] - work[2, 0, 1], work[2, f, 2] - work[2, 0, 2]
        bx, by, bz = (
            work[2, f + 1, 0] - work[2, 0, 0], work[2, f + 1, 1] - work[2, 0, 1], work[2, f + 1, 2] - work[2, 0, 2]
        )  # fmt: skip
        area_p = 0.5 * abs(nx * (ay * bz - az * by) + ny * (az * bx - ax * bz) + nz * (ax * by - ay * bx))
        for g in range(1, k - 1):
            cx, cy, cz = work[3, g, 0] - work[3, 0, 0], work[3, g, 1] - work[3, 0, 1], work[3, g, 2] - work[3, 0, 2]
            dx, dy, dz = (
                work[3, g + 1, 0] - work[3, 0, 0], work[3, g + 1, 1] - work[3, 0, 1], work[3, g + 1, 2] - work[3, 0, 2]
            )  # fmt: skip
            area_q = 0.5 * abs(mx * (cy * dz - cz * dy) + my * (cz * dx - cx * dz) + mz * (cx * dy - cy * dx))
            facing += area_p * area_q
            row = 0.0
            for s in range(3):
                u, v = (2.0 / 3.0 if s == 1 else 1.0 / 6.0), (2.0 / 3.0 if s == 2 else 1.0 / 6.0)
                x, y, z = (
                    work[2, 0, 0] + u * ax + v * bx, work[2, 0, 1] + u * ay + v * by, work[2, 0, 2] + u * az + v * bz
                )  # fmt: skip
                for t in range(3):
                    u, v = (2.0 / 3.0 if t == 1 else 1.0 / 6.0), (2.0 / 3.0 if t == 2 else 1.0 / 6.0)
                    ex = work[3, 0, 0] + u * cx + v * dx - x
                    ey = work[3, 0, 1] + u * cy + v * dy - y
                    ez = work[3, 0, 2] + u * cz + v * dz - z
                    r2 = ex * ex + ey * ey + ez * ez
                    row -= (ex * nx + ey * ny + ez * nz) * (ex * mx + ey * my + ez * mz) / (r2 * r2)
            total += area_p * area_q * row / 9.0
    return max(total, 0.0) * _INV_PI, facing * _INV_PI / square, math.sqrt(largest / square)


POINT_RULE, COARSE_RULE, FINE_RULE, LAMBERT_RULE = 0.45, 0.26, 0.065, 0.04
"""Relative errors of the rules at a distance of one radius, root mean square over the pairs of rooms in triangles;
they fall with its 2nd, 4th and (both others) 5.6th power."""


@njit(**_PLAIN)
def rule_doubt(value, facing, factor, power, ratio):
    """Estimate of a rule's error."""
    return factor * ratio**power * math.sqrt(max(value, 0.0) * max(facing, value))


@njit(**_PLAIN)
def open_exchange(
    i, j, straddle, corners, start, normal, offset, centroid, area, radius, low, high, rule, rule_start, fine,
    fine_start, reach, error, work, contour, tally,
):  # fmt: skip
    """Exchange area of two pieces that see each other whole, and the estimate of its error.

    Far apart: a product rule of a few points on the kernel; nearer: Lambert's formula over the smaller;
    near and touching: the closed form.  ``reach`` (4,) are the distances, in radii, from which each rule
    meets the wanted relative error ``error``.
    """
    tally[CLOSED] += 1
    if not straddle:
        dx, dy, dz = centroid[i, 0] - centroid[j, 0], centroid[i, 1] - centroid[j, 1], centroid[i, 2] - centroid[j, 2]
        square = dx * dx + dy * dy + dz * dz
        distance = math.sqrt(square)
        larger = max(radius[i], radius[j])
        # What the pair would exchange face to face: at grazing angles errors are larger than their share.
        facing = area[i] * area[j] * _INV_PI / square if square > 0.0 else 0.0
        if distance > reach[0] * larger:
            value = (
                area[i] * area[j] * (dx * normal[j, 0] + dy * normal[j, 1] + dz * normal[j, 2])
                * -(dx * normal[i, 0] + dy * normal[i, 1] + dz * normal[i, 2]) / (square * square) * _INV_PI
            )  # fmt: skip
            value = max(value, 0.0)
            return value, rule_doubt(value, facing, POINT_RULE, 2.0, larger / distance)
        if distance > reach[1] * larger:
            value = _kernel_sum(
                rule, rule_start[1, i], rule_start[1, i + 1], normal[i, 0], normal[i, 1], normal[i, 2],
                rule, rule_start[1, j], rule_start[1, j + 1], normal[j, 0], normal[j, 1], normal[j, 2],
            )  # fmt: skip
            return value, rule_doubt(value, facing, COARSE_RULE, 4.0, larger / distance)
        if distance > reach[2] * larger:
            value = _kernel_sum(
                fine, fine_start[i], fine_start[i + 1], normal[i, 0], normal[i, 1], normal[i, 2],
                fine, fine_start[j], fine_start[j + 1], normal[j, 0], normal[j, 1], normal[j, 2],
            )  # fmt: skip
            return value, rule_doubt(value, facing, FINE_RULE, 5.6, larger / distance)
        s, t = (i, j) if radius[i] <= radius[j] else (j, i)
        gap = _gap(centroid, s, low, high, t)
        if gap > reach[3] * radius[s]:
            value = _lambert_sum(
                fine, fine_start[s], fine_start[s + 1], normal[s, 0], normal[s, 1], normal[s, 2], corners, start[t],
                start[t + 1],
            )  # fmt: skip
            return value, rule_doubt(value, facing, LAMBERT_RULE, 5.6, radius[s] / gap)
    m, k = _clip_pair(
        corners, start[i], start[i + 1], normal[i], corners, start[j], start[j + 1], normal[j], work
    )  # fmt: skip
    if m <= 0 or k <= 0:
        return 0.0, 0.0
    smaller = min(area[i], area[j])
    if straddle:
        value, facing, ratio = _clipped_sum(work, m, k, normal, i, j)
        if ratio * reach[1] < 1.0:
            return value, rule_doubt(value, facing, COARSE_RULE, 4.0, ratio)
    value, rounding = contour_integral_in(work[2], m, work[3], k, 0.1 * error * smaller, contour)
    # Never above what one of them can send; a closer look where little is exchanged.
    if value < 0.3 * smaller:
        tolerance = max(0.5 * error * value, 1e-12 * smaller)
        if tolerance < 0.05 * error * smaller:
            value, rounding = contour_integral_in(work[2], m, work[3], k, tolerance, contour)
        return value, tolerance + rounding
    return min(value, smaller), 0.1 * error * smaller + rounding


@njit(**_PLAIN)
def _sampled(
    i, j, far, points, p0, p1, corners, start, normal, kc, ks, kn, kd, through, kept, many, fragments, sizes, weights,
    tally, sums,
):  # fmt: skip
    """Visible and open form factors of piece j, summed over points of piece i; whether there was room.

    ``sums``: visible, open, the least and largest visible share, and the number of points that see anything.
    """
    nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
    mx, my, mz = normal[j, 0], normal[j, 1], normal[j, 2]
    t0, t1 = start[j], start[j + 1]
    d = mx * corners[t0, 0] + my * corners[t0, 1] + mz * corners[t0, 2]
    seen = whole = 0.0
    least, most = math.inf, 0.0
    used = 0
    for p in range(p0, p1):
        x, y, z, w = points[p, 0], points[p, 1], points[p, 2], points[p, 3]
        if mx * x + my * y + mz * z - d <= 0.0:
            continue
        reach = _load(corners, t0, t1, x, y, z, fragments, sizes, weights)
        if far:
            clear = _fragment_flux(fragments, 0, t1 - t0, nx, ny, nz, mx, my, mz)
        else:
            clear = lambert_piece(0.0, 0.0, 0.0, nx, ny, nz, fragments[0], 0, t1 - t0)
        if clear <= 0.0:
            continue
        count = _cut(x, y, z, reach, kc, ks, kn, kd, through, kept, many, fragments, sizes, weights, tally)
        if count < 0:
            return False
        share = 0.0
        for f in range(count):
            if far:
                share += weights[f] * _fragment_flux(fragments, f, sizes[f], nx, ny, nz, mx, my, mz)
            else:
                share += weights[f] * max(lambert_piece(0.0, 0.0, 0.0, nx, ny, nz, fragments[f], 0, sizes[f]), 0.0)
        used += 1
        whole += w * clear
        seen += w * share
        part = share / clear
        least, most = min(least, part), max(most, part)
    sums[0], sums[1], sums[2], sums[3], sums[4] = seen, whole, least, most, used
    return True


@njit(**_PLAIN)
def partial_share(
    i, j, far, goal, first, levels, missed, rules, rule_starts, corners, start, normal, kc, ks, kn, kd, through, kept,
    many, fragments, sizes, weights, sums, tally,
):  # fmt: skip
    """Visible share of the exchange of two pieces and the estimate of its error; -1 if rays must tell.

    Points of ever finer rules on piece i, until two in a row agree to ``goal``; ``far`` as in the caller.  ``missed``
    over the points of the first rule is what they may miss of the share though they agree.
    """
    before, doubt = -1.0, 1.0
    share = 0.0
    for level in range(first, levels):
        if not _sampled(
            i, j, far, rules, rule_starts[level, i], rule_starts[level, i + 1], corners, start, normal, kc, ks, kn,
            kd, through, kept, many, fragments, sizes, weights, tally, sums,
        ):  # fmt: skip
            return -1.0, 1.0
        if sums[1] <= 0.0:
            before = -1.0
            continue
        share = min(sums[0] / sums[1], 1.0)
        spread = sums[3] - sums[2]
        points = rule_starts[level, i + 1] - rule_starts[level, i]
        # Both factors by comparison with ever finer rules, in rooms in triangles: their root mean square is kept.
        if points == 1:
            # Of small triangles in a room; they know nothing of a shadow's edge between their middle and their rim.
            doubt = 0.055 if share <= 0.0 or share >= 1.0 else 0.07
        elif before < 0.0:
            # Points below the other's horizon tell nothing.
            doubt = 0.2 * spread / math.sqrt(sums[4]) + missed / sums[4]
        else:
            doubt = 0.25 * abs(share - before) + 0.18 * spread / points + 0.015 / points
        if doubt <= goal:
            break
        before = share
    return share, doubt
