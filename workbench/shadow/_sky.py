"""Skies as kernels: radiance by direction, and the irradiance from what occluders leave of the dome."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from workbench.accel.box_tree import boxes_meeting_planes
from workbench.culling.plane_vertex import outside_planes
from workbench.culling.tally import CHECK, CULL, CUT, OVERFLOW, PIECES
from workbench.geometry.lambert import lambert_piece
from workbench.geometry.planes import clip_by_plane
from workbench.shadow.area import MAX_CORNERS, MAX_PIECES, _cone_planes

DEEPEST = 3
"""Most quarterings of an octant of the dome whose cut has too many pieces or candidates."""
MOST_CANDIDATES = 48
"""Most pieces of occluders that cut one part of the dome."""
_NEAR = 1e-12
_MOST_CELLS = 4096

# Gauss-Legendre in [0, 1].
_X6 = 0.5 * (np.polynomial.legendre.leggauss(6)[0] + 1.0)
_W6 = 0.5 * np.polynomial.legendre.leggauss(6)[1]


@njit(nogil=True, cache=True)
def relative_radiance(x, y, z, law):
    """Radiance of a sky in a unit direction, in units of its zenith's; 0 below the horizon.

    ``law`` (12,) is up (3), sun (3), the parameters a to e of CIE S 011, and 0 for them, 1 for the
    traditional overcast sky or 2 for a uniform one.
    """
    sine = law[0] * x + law[1] * y + law[2] * z
    if sine <= 0.0:
        return 0.0
    if law[11] == 2.0:
        return 1.0
    if law[11] == 1.0:
        return (1.0 + 2.0 * sine) / 3.0
    a, b, c, d, e = law[6], law[7], law[8], law[9], law[10]
    value = (1.0 + a * math.exp(b / sine)) / (1.0 + a * math.exp(b))
    if c != 0.0:
        cosine = min(max(law[3] * x + law[4] * y + law[5] * z, -1.0), 1.0)
        zenith = min(max(law[0] * law[3] + law[1] * law[4] + law[2] * law[5], -1.0), 1.0)
        away, straight = math.acos(cosine), math.acos(zenith)
        far = math.exp(0.5 * math.pi * d)
        value *= 1.0 + c * (math.exp(d * away) - far) + e * cosine * cosine
        value /= 1.0 + c * (math.exp(d * straight) - far) + e * zenith * zenith
    return value


@njit(nogil=True, cache=True)
def relative_radiances(directions, law, out):
    """:func:`relative_radiance` of unit directions (n, 3)."""
    for i in range(directions.shape[0]):
        out[i] = relative_radiance(directions[i, 0], directions[i, 1], directions[i, 2], law)


@njit(nogil=True, cache=True)
def _rule(tri, nx, ny, nz, law):
    """Integral of radiance times cosine over the cone of a triangle, 6 x 6 points."""
    ux, uy, uz = tri[1, 0] - tri[0, 0], tri[1, 1] - tri[0, 1], tri[1, 2] - tri[0, 2]
    vx, vy, vz = tri[2, 0] - tri[0, 0], tri[2, 1] - tri[0, 1], tri[2, 2] - tri[0, 2]
    # |(y . N)| is the same all over the plane: the volume of corners.
    volume = abs(tri[0, 0] * (uy * vz - uz * vy) + tri[0, 1] * (uz * vx - ux * vz) + tri[0, 2] * (ux * vy - uy * vx))
    total = 0.0
    for i in range(6):
        s = _X6[i]
        for j in range(6):
            p, q = s * (1.0 - _X6[j]), s * _X6[j]
            x = tri[0, 0] + p * ux + q * vx
            y = tri[0, 1] + p * uy + q * vy
            z = tri[0, 2] + p * uz + q * vz
            length = math.sqrt(x * x + y * y + z * z)
            x, y, z = x / length, y / length, z / length
            weight = _W6[i] * _W6[j] * s * volume / (length * length * length)
            total += weight * (nx * x + ny * y + nz * z) * relative_radiance(x, y, z, law)
    return total


@njit(nogil=True, cache=True)
def dome_integral(ring, count, nx, ny, nz, law, tolerance, cells, state):
    """Irradiance from the part of a sky inside the cone of a convex ring about the origin.

    Triangles are quartered until each agrees with its quarters; ``tolerance`` is absolute, in units
    of the zenith's radiance.  ``cells`` (64, 3, 3) and ``state`` (64, 2) are scratch.
    """
    total = 0.0
    for k in range(1, count - 1):
        for axis in range(3):
            cells[0, 0, axis], cells[0, 1, axis], cells[0, 2, axis] = ring[0, axis], ring[k, axis], ring[k + 1, axis]
        state[0, 0], state[0, 1] = _rule(cells[0], nx, ny, nz, law), 0.0
        top, made = 0, 0
        while top >= 0:
            value, level = state[top, 0], state[top, 1]
            a0, a1, a2 = cells[top, 0, 0], cells[top, 0, 1], cells[top, 0, 2]
            b0, b1, b2 = cells[top, 1, 0], cells[top, 1, 1], cells[top, 1, 2]
            c0, c1, c2 = cells[top, 2, 0], cells[top, 2, 1], cells[top, 2, 2]
            quarters = 0.0
            for q in range(4):
                cell = cells[top + q]
                if q == 0:
                    cell[0, 0], cell[0, 1], cell[0, 2] = a0, a1, a2
                    cell[1, 0], cell[1, 1], cell[1, 2] = 0.5 * (a0 + b0), 0.5 * (a1 + b1), 0.5 * (a2 + b2)
                    cell[2, 0], cell[2, 1], cell[2, 2] = 0.5 * (a0 + c0), 0.5 * (a1 + c1), 0.5 * (a2 + c2)
                elif q == 1:
                    cell[0, 0], cell[0, 1], cell[0, 2] = 0.5 * (a0 + b0), 0.5 * (a1 + b1), 0.5 * (a2 + b2)
                    cell[1, 0], cell[1, 1], cell[1, 2] = b0, b1, b2
                    cell[2, 0], cell[2, 1], cell[2, 2] = 0.5 * (b0 + c0), 0.5 * (b1 + c1), 0.5 * (b2 + c2)
                elif q == 2:
                    cell[0, 0], cell[0, 1], cell[0, 2] = 0.5 * (a0 + c0), 0.5 * (a1 + c1), 0.5 * (a2 + c2)
                    cell[1, 0], cell[1, 1], cell[1, 2] = 0.5 * (b0 + c0), 0.5 * (b1 + c1), 0.5 * (b2 + c2)
                    cell[2, 0], cell[2, 1], cell[2, 2] = c0, c1, c2
                else:
                    cell[0, 0], cell[0, 1], cell[0, 2] = 0.5 * (a0 + b0), 0.5 * (a1 + b1), 0.5 * (a2 + b2)
                    cell[1, 0], cell[1, 1], cell[1, 2] = 0.5 * (b0 + c0), 0.5 * (b1 + c1), 0.5 * (b2 + c2)
                    cell[2, 0], cell[2, 1], cell[2, 2] = 0.5 * (a0 + c0), 0.5 * (a1 + c1), 0.5 * (a2 + c2)
                state[top + q, 0], state[top + q, 1] = _rule(cell, nx, ny, nz, law), level + 1.0
                quarters += state[top + q, 0]
            made += 1
            if abs(quarters - value) <= max(tolerance, 1e-14) or level >= 16.0 or made > _MOST_CELLS:
                total += quarters
                top -= 1
            else:
                top += 3
    return total


@njit(nogil=True, cache=True)
def _cut_cone(x, y, z, corners, starts, through, candidates, count, boxes, sizes, weights, work):
    """Cut the cone in ``boxes[0, 0]`` (its ``sizes`` and ``weights`` set) by occluders seen from a point.

    Returns which of the two buffers holds what is left, and the number of pieces, -1 if there are
    too many.  As :func:`workbench.shadow.area.visible_share`, with nothing behind the occluders.
    """
    current, pieces = 0, 1
    relative, low, planes = work[0], work[1], work[3]
    for c in range(count):
        index = candidates[c]
        a, m = starts[index], starts[index + 1] - starts[index]
        if m > MAX_CORNERS:
            return 0, -1
        span = 0.0
        for i in range(m):
            relative[i, 0], relative[i, 1] = corners[a + i, 0] - x, corners[a + i, 1] - y
            relative[i, 2] = corners[a + i, 2] - z
            span = max(span, abs(relative[i, 0]), abs(relative[i, 1]), abs(relative[i, 2]))
        used = _cone_planes(relative, m, span, planes)
        if used == 0:
            continue
        tau = through[index]
        other = 1 - current
        made = 0
        for p in range(pieces):
            size = sizes[current, p]
            box = boxes[current, p]
            touched = True
            for k in range(used):
                outside = True
                for i in range(size):
                    if planes[k, 0] * box[i, 0] + planes[k, 1] * box[i, 1] + planes[k, 2] * box[i, 2] > _NEAR:
                        outside = False
                        break
                if outside:
                    touched = False
                    break
            if not touched:
                if made == MAX_PIECES:
                    return 0, -1
                for i in range(size):
                    for axis in range(3):
                        boxes[other, made, i, axis] = box[i, axis]
                sizes[other, made], weights[other, made] = size, weights[current, p]
                made += 1
                continue
            for k in range(used):
                qx, qy, qz = planes[k, 0], planes[k, 1], planes[k, 2]
                cuts = False
                for i in range(size):
                    if qx * box[i, 0] + qy * box[i, 1] + qz * box[i, 2] < -_NEAR:
                        cuts = True
                        break
                if not cuts:
                    continue
                if made == MAX_PIECES:
                    return 0, -1
                left = clip_by_plane(box, size, -qx, -qy, -qz, 0.0, _NEAR, boxes[other, made])
                if left < 0:
                    return 0, -1
                if left > 0:
                    sizes[other, made], weights[other, made] = left, weights[current, p]
                    made += 1
                size = clip_by_plane(box, size, qx, qy, qz, 0.0, _NEAR, low)
                if size < 0:
                    return 0, -1
                if size == 0:
                    break
                for i in range(size):
                    for axis in range(3):
                        box[i, axis] = low[i, axis]
            if size > 0 and tau > 0.0:
                if made == MAX_PIECES:
                    return 0, -1
                for i in range(size):
                    for axis in range(3):
                        boxes[other, made, i, axis] = box[i, axis]
                sizes[other, made], weights[other, made] = size, weights[current, p] * tau
                made += 1
        current, pieces = other, made
        if pieces == 0:
            break
    return current, pieces


@njit(nogil=True, cache=True)
def sky_points(
    points, normals, own, first, last, law, ground, octants, corners, starts, piece_polygon, piece_normal, through, low,
    high, skip, head, leaf, order, bounds, slack, tolerance, out, tally,
):  # fmt: skip
    """Irradiance of points ``first..last`` from the open sky and the open ground, exactly.

    ``octants`` (8, 3, 3) are spherical triangles, those of the sky first; ``ground`` says whether
    the ground shines.  ``out`` (n, 2) gets the sky's part in units of the zenith's radiance, and the
    ground's form factor; NaN where the occluders are too many to cut.
    """
    planes = np.empty((4, 4))
    found = np.empty(MOST_CANDIDATES, dtype=np.int64)
    boxes = np.empty((2, MAX_PIECES, MAX_CORNERS, 3))
    sizes = np.zeros((2, MAX_PIECES), dtype=np.int64)
    weights = np.empty((2, MAX_PIECES))
    work = np.empty((4, MAX_CORNERS, 3))
    stack = np.empty((3 * DEEPEST + 5, 3, 3))
    depth = np.empty(3 * DEEPEST + 5, dtype=np.int64)
    part = np.empty((3, 3))
    cells, state = np.empty((64, 3, 3)), np.empty((64, 2))
    for i in range(first, last):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        out[i, 0] = out[i, 1] = 0.0
        for octant in range(8 if ground else 4):
            below = octant >= 4
            stack[0] = octants[octant]
            depth[0], top = 0, 0
            while top >= 0:
                part[:] = stack[top]
                here = depth[top]
                top -= 1
                # What lies below the receiver's horizon gives nothing.
                size = clip_by_plane(part, 3, nx, ny, nz, 0.0, _NEAR, boxes[0, 0])
                if size <= 0:
                    continue
                for k in range(3):
                    j = (k + 1) % 3
                    px = part[k, 1] * part[j, 2] - part[k, 2] * part[j, 1]
                    py = part[k, 2] * part[j, 0] - part[k, 0] * part[j, 2]
                    pz = part[k, 0] * part[j, 1] - part[k, 1] * part[j, 0]
                    length = math.sqrt(px * px + py * py + pz * pz)
                    planes[k, 0], planes[k, 1], planes[k, 2] = px / length, py / length, pz / length
                    planes[k, 3] = (px * x + py * y + pz * z) / length + 2.0 * slack
                planes[3, 0], planes[3, 1], planes[3, 2] = nx, ny, nz
                planes[3, 3] = nx * x + ny * y + nz * z + 2.0 * slack
                many = boxes_meeting_planes(low, high, skip, head, leaf, order, bounds, planes, 4, slack, found, tally)
                kept = 0
                for c in range(min(many, MOST_CANDIDATES)):
                    piece = found[c]
                    if piece_polygon[piece] == own[i]:
                        continue
                    tally[CHECK] += 1
                    if outside_planes(corners, starts[piece], starts[piece + 1], planes, 4, slack):
                        tally[CULL] += 1
                        continue
                    a = starts[piece]
                    # A polygon in whose plane the point lies hides nothing.
                    height = (
                        piece_normal[piece, 0] * (corners[a, 0] - x) + piece_normal[piece, 1] * (corners[a, 1] - y)
                        + piece_normal[piece, 2] * (corners[a, 2] - z)
                    )  # fmt: skip
                    if abs(height) <= slack:
                        continue
                    found[kept] = piece
                    kept += 1
                current, pieces = 0, -1
                if many <= MOST_CANDIDATES:
                    sizes[0, 0], weights[0, 0] = size, 1.0
                    tally[CUT] += 1
                    current, pieces = _cut_cone(
                        x, y, z, corners, starts, through, found, kept, boxes, sizes, weights, work
                    )
                if pieces < 0:
                    tally[OVERFLOW] += 1
                    if here >= DEEPEST:
                        out[i, 0] = out[i, 1] = math.nan
                        top = -1
                        break
                    for q in range(4):
                        top += 1
                        depth[top] = here + 1
                        for axis in range(3):
                            a, b, c = part[0, axis], part[1, axis], part[2, axis]
                            ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
                            if q == 0:
                                stack[top, 0, axis], stack[top, 1, axis], stack[top, 2, axis] = a, ab, ca
                            elif q == 1:
                                stack[top, 0, axis], stack[top, 1, axis], stack[top, 2, axis] = ab, b, bc
                            elif q == 2:
                                stack[top, 0, axis], stack[top, 1, axis], stack[top, 2, axis] = ca, bc, c
                            else:
                                stack[top, 0, axis], stack[top, 1, axis], stack[top, 2, axis] = ab, bc, ca
                    continue
                tally[PIECES] += pieces
                for p in range(pieces):
                    ring = boxes[current, p]
                    # Seen from the point the octants run clockwise or not: what counts is the size.
                    if below or law[11] == 2.0:
                        share = abs(lambert_piece(0.0, 0.0, 0.0, nx, ny, nz, ring, 0, sizes[current, p]))
                        if below:
                            out[i, 1] += weights[current, p] * share
                        else:
                            out[i, 0] += weights[current, p] * share * math.pi
                    else:
                        out[i, 0] += weights[current, p] * dome_integral(
                            ring, sizes[current, p], nx, ny, nz, law, tolerance, cells, state
                        )
            if math.isnan(out[i, 0]):
                break
