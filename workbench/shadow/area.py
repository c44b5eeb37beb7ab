"""Exact soft shadows: a polygonal sender cut by its occluders, summed with Lambert's formula.

From a point, the sender's polygon is split by the planes through the point and each candidate's
edges; what lies inside a candidate's cone is hidden (or dimmed, where the candidate lets light
through), what is left are convex visible pieces over which Lambert's formula is exact.  Pieces,
not factors, are multiplied, so overlapping, touching and coincident occluders count as their
union.  Cf. T. Nishita and E. Nakamae, "Continuous tone representation of three-dimensional
objects taking account of shadows and interreflection" (SIGGRAPH 1985).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from workbench.geometry.lambert import lambert_piece
from workbench.geometry.planes import clip_by_plane

__all__ = ["MAX_CORNERS", "MAX_PIECES", "cut_workspace", "visible_share"]

MAX_PIECES = 160
"""Visible pieces after which an exact cut is given up for rays."""
MAX_CORNERS = 28
"""Corners that a piece or a clipped candidate may have before the cut is given up."""

_TOUCH = 1e-12


def cut_workspace() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Scratch arrays for :func:`visible_share`; one set a thread."""
    return (
        np.empty((2, MAX_PIECES, MAX_CORNERS, 3)),
        np.zeros((2, MAX_PIECES), dtype=np.int64),
        np.empty((2, MAX_PIECES)),
        np.empty((4, MAX_CORNERS, 3)),
    )


@njit(nogil=True, cache=True)
def _cone_planes(occluder, count, reach, planes):
    """Planes through the origin and each edge, unit normals pointing into the cone.

    Returns their number; 0 for an occluder seen edge on, whose cone is flat and hides nothing.
    """
    cx = cy = cz = 0.0
    for i in range(count):
        cx += occluder[i, 0]
        cy += occluder[i, 1]
        cz += occluder[i, 2]
    flat = 1e-14 * count * reach
    used = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        ax, ay, az = occluder[i, 0], occluder[i, 1], occluder[i, 2]
        ex, ey, ez = occluder[j, 0] - ax, occluder[j, 1] - ay, occluder[j, 2] - az
        qx = ay * ez - az * ey
        qy = az * ex - ax * ez
        qz = ax * ey - ay * ex
        length = math.sqrt(qx * qx + qy * qy + qz * qz)
        if length == 0.0:
            continue  # an edge seen end on bounds nothing
        inside = (qx * cx + qy * cy + qz * cz) / length
        if abs(inside) <= flat:
            return 0
        if inside < 0.0:
            length = -length
        planes[used, 0], planes[used, 1], planes[used, 2] = qx / length, qy / length, qz / length
        used += 1
    return used


@njit(nogil=True, cache=True)
def visible_share(
    x, y, z, nx, ny, nz, sender, s0, s1, sender_normal, corners, piece_start, through, candidates, count,
    boxes, sizes, weights, work,
):  # fmt: skip
    """Form factor from a point to the visible part of one convex sender.

    ``sender[s0:s1]`` are the sender's corners (counter-clockwise from its front) and
    ``sender_normal`` (3,) its unit normal; ``candidates[:count]`` are indices of convex pieces
    ``corners[piece_start[i]:piece_start[i + 1]]`` that may block, each letting ``through[i]`` pass.
    The last four arguments come from :func:`cut_workspace`.

    Returns ``(share, pieces)``: the form factor, and the number of visible pieces; ``pieces`` is -1
    when the cut was given up, and the share then means nothing.
    """
    mx, my, mz = -sender_normal[0], -sender_normal[1], -sender_normal[2]
    reach = 0.0
    current = 0
    n = s1 - s0
    if n > MAX_CORNERS:
        return 0.0, -1
    for i in range(n):
        rx, ry, rz = sender[s0 + i, 0] - x, sender[s0 + i, 1] - y, sender[s0 + i, 2] - z
        boxes[0, 0, i, 0], boxes[0, 0, i, 1], boxes[0, 0, i, 2] = rx, ry, rz
        reach = max(reach, abs(rx), abs(ry), abs(rz))
    height = mx * boxes[0, 0, 0, 0] + my * boxes[0, 0, 0, 1] + mz * boxes[0, 0, 0, 2]
    near = _TOUCH * reach
    if height <= 1e-15 * reach:
        return 0.0, 0  # in or behind the sender's plane
    sizes[0, 0] = n
    weights[0, 0] = 1.0
    pieces = 1
    relative, low, clipped, planes = work[0], work[1], work[2], work[3]

    for c in range(count):
        index = candidates[c]
        a, b = piece_start[index], piece_start[index + 1]
        m = b - a
        if m > MAX_CORNERS:
            return 0.0, -1
        lowest, highest = math.inf, -math.inf
        span = reach
        for i in range(m):
            relative[i, 0] = corners[a + i, 0] - x
            relative[i, 1] = corners[a + i, 1] - y
            relative[i, 2] = corners[a + i, 2] - z
            off = mx * relative[i, 0] + my * relative[i, 1] + mz * relative[i, 2]
            span = max(span, abs(relative[i, 0]), abs(relative[i, 1]), abs(relative[i, 2]))
            lowest = min(lowest, off)
            highest = max(highest, off)
        # Only what lies between the point and the sender's plane can block.
        blocker = relative
        if lowest < near or highest > height - near:
            m = clip_by_plane(relative, m, mx, my, mz, 0.0, near, low)
            if m > 0:
                m = clip_by_plane(low, m, -mx, -my, -mz, -height, near, clipped)
            if m < 0:
                return 0.0, -1
            blocker = clipped
        # Far corners round coarsely: flat is measured by how far this candidate reaches.
        used = _cone_planes(blocker, m, span, planes) if m > 0 else 0
        if used == 0:
            continue
        tau = through[index]
        other = 1 - current
        made = 0
        for p in range(pieces):
            size = sizes[current, p]
            box = boxes[current, p]
            # A piece outside one plane is untouched; this first look keeps it in one part.
            touched = True
            for k in range(used):
                qx, qy, qz = planes[k, 0], planes[k, 1], planes[k, 2]
                outside = True
                for i in range(size):
                    if qx * box[i, 0] + qy * box[i, 1] + qz * box[i, 2] > near:
                        outside = False
                        break
                if outside:
                    touched = False
                    break
            if not touched:
                if made == MAX_PIECES:
                    return 0.0, -1
                for i in range(size):
                    boxes[other, made, i, 0] = box[i, 0]
                    boxes[other, made, i, 1] = box[i, 1]
                    boxes[other, made, i, 2] = box[i, 2]
                sizes[other, made] = size
                weights[other, made] = weights[current, p]
                made += 1
                continue
            for k in range(used):
                qx, qy, qz = planes[k, 0], planes[k, 1], planes[k, 2]
                cuts = False
                for i in range(size):
                    if qx * box[i, 0] + qy * box[i, 1] + qz * box[i, 2] < -near:
                        cuts = True
                        break
                if not cuts:
                    continue
                if made == MAX_PIECES:
                    return 0.0, -1
                left = clip_by_plane(box, size, -qx, -qy, -qz, 0.0, near, boxes[other, made])
                if left < 0:
                    return 0.0, -1
                if left > 0:
                    sizes[other, made] = left
                    weights[other, made] = weights[current, p]
                    made += 1
                size = clip_by_plane(box, size, qx, qy, qz, 0.0, near, low)
                if size < 0:
                    return 0.0, -1
                if size == 0:
                    break
                for i in range(size):
                    box[i, 0], box[i, 1], box[i, 2] = low[i, 0], low[i, 1], low[i, 2]
            if size > 0 and tau > 0.0:
                if made == MAX_PIECES:
                    return 0.0, -1
                for i in range(size):
                    boxes[other, made, i, 0] = box[i, 0]
                    boxes[other, made, i, 1] = box[i, 1]
                    boxes[other, made, i, 2] = box[i, 2]
                sizes[other, made] = size
                weights[other, made] = weights[current, p] * tau
                made += 1
        current, pieces = other, made
        if pieces == 0:
            return 0.0, 0
    share = 0.0
    for p in range(pieces):
        share += weights[current, p] * max(
            lambert_piece(0.0, 0.0, 0.0, nx, ny, nz, boxes[current, p], 0, sizes[current, p]), 0.0
        )
    return share, pieces
