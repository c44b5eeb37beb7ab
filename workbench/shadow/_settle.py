"""Kernels that settle the occlusion of points for one polygonal sender, cheap tests first.

Tile by tile a shaft, then point by point the light pyramid; what has no candidate is lit, what has a
few is cut exactly, what has many is left COMPLEX for rays.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from workbench.accel.box_tree import boxes_meeting_planes
from workbench.culling.plane_vertex import light_pyramid, outside_planes
from workbench.culling.shaft import MAX_SHAFT_PLANES, tile_shaft
from workbench.culling.tally import (
    CHECK,
    CLEAR,
    CLOSED,
    COMPLEX,
    CULL,
    CUT,
    DARK,
    EMPTY,
    HORIZON,
    OVERFLOW,
    PIECES,
    SHAFT,
    SHAFT_CULL,
    SHAFT_TEST,
)
from workbench.geometry.lambert import lambert_piece
from workbench.shadow.area import MAX_CORNERS, MAX_PIECES, visible_share

MAX_CANDIDATES = 256
"""Longest candidate list that a tile hands down."""
SPLIT_DEPTH = 7
"""Most halvings of a sender whose exact cut has too many pieces."""

LATER, PASSED = -2, -3
"""Counts of tiles whose points are left COMPLEX unseen, or not looked at."""
STATE_CLEAR, STATE_DARK, STATE_COMPLEX, STATE_EXACT, STATE_SAMPLED = 1, 2, 3, 4, 5


@njit(nogil=True, cache=True)
def tile_candidates(
    bounds_of, normal, offset, own, first, last, ring, sender_low, sender_high, sender_normal, sender_own, corners,
    starts, piece_polygon, low, high, skip, head, leaf, order, bounds, slack, lists, counts, tally,
):  # fmt: skip
    """Candidates of the shafts from tiles ``first..last`` to a sender; count -1 for a long list.

    ``normal`` (t, 3) and ``offset`` (t,) are the plane of each tile, or a zero normal for a tile
    that is not flat; ``ring`` (k, 3) are the sender's corners, ``own`` (t,) each tile's polygon.
    """
    planes = np.empty((MAX_SHAFT_PLANES, 4))
    found = np.empty(MAX_CANDIDATES, dtype=np.int64)
    for t in range(first, last):
        used = tile_shaft(
            bounds_of[t], normal[t], offset[t], sender_low, sender_high, sender_normal, ring, slack, planes
        )
        tally[SHAFT] += 1
        many = boxes_meeting_planes(low, high, skip, head, leaf, order, bounds, planes, used, slack, found, tally)
        if many > MAX_CANDIDATES:
            counts[t] = -1
            continue
        kept = 0
        for i in range(many):
            piece = found[i]
            if piece_polygon[piece] == own[t] or piece_polygon[piece] == sender_own:
                continue
            tally[SHAFT_TEST] += 1
            if outside_planes(corners, starts[piece], starts[piece + 1], planes, used, slack):
                tally[SHAFT_CULL] += 1
                continue
            lists[t, kept] = piece
            kept += 1
        counts[t] = kept
        if kept == 0:
            tally[EMPTY] += 1


@njit(nogil=True, cache=True)
def settle_points(
    points, normals, own, tile_start, first, last, sender, s0, s1, sender_normal, sender_own, corners, starts,
    piece_polygon, through, low, high, skip, head, leaf, order, bounds, slack, limit, lists, counts, share, open_share,
    state, candidates, tally,
):  # fmt: skip
    """Settle the points of tiles ``first..last`` for one convex sender piece, but those settled before.

    ``open_share`` gets the unoccluded form factor of each point, ``share`` the visible one where it
    is known, ``state`` CLEAR, DARK, EXACT or COMPLEX, ``candidates`` the number of pieces left after
    the culls.  At most ``limit`` are cut; ``limit + 1`` stands for that many or more.
    """
    planes = np.empty((64, 4))
    # Boxes that meet the pyramid: so many more than can be cut, and the point is for rays anyway.
    found = np.empty(4 * limit, dtype=np.int64)
    picked = np.empty(limit + 1, dtype=np.int64)
    boxes = np.empty((2, MAX_PIECES, MAX_CORNERS, 3))
    sizes = np.zeros((2, MAX_PIECES), dtype=np.int64)
    weights = np.empty((2, MAX_PIECES))
    cut = np.empty((4, MAX_CORNERS, 3))
    mx, my, mz = sender_normal[0], sender_normal[1], sender_normal[2]
    level = mx * sender[s0, 0] + my * sender[s0, 1] + mz * sender[s0, 2]
    for t in range(first, last):
        if counts[t] == PASSED:
            continue
        for i in range(tile_start[t], tile_start[t + 1]):
            if state[i] != 0 and state[i] != STATE_COMPLEX:
                continue
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
            value = 0.0
            if mx * x + my * y + mz * z - level > slack:
                value = lambert_piece(x, y, z, nx, ny, nz, sender, s0, s1)
                tally[CLOSED] += 1
            if value <= 0.0:
                tally[HORIZON] += 1
                open_share[i], share[i], state[i] = 0.0, 0.0, STATE_DARK
                candidates[i] = 0
                continue
            open_share[i], share[i], state[i] = value, value, STATE_CLEAR
            candidates[i] = 0
            if counts[t] == 0:
                tally[CLEAR] += 1
                continue
            if counts[t] == LATER:
                candidates[i], state[i] = limit + 1, STATE_COMPLEX
                continue
            used = light_pyramid(x, y, z, nx, ny, nz, sender, s0, s1, sender_normal, 2.0 * slack, planes)
            many = counts[t]
            if many < 0:
                many = boxes_meeting_planes(
                    low, high, skip, head, leaf, order, bounds, planes, used, slack, found, tally
                )
            kept = 0
            if counts[t] < 0 and many > found.shape[0]:
                kept = limit + 1
            else:
                for c in range(many):
                    piece = found[c] if counts[t] < 0 else lists[t, c]
                    if piece_polygon[piece] == own[i] or piece_polygon[piece] == sender_own:
                        continue
                    tally[CHECK] += 1
                    if outside_planes(corners, starts[piece], starts[piece + 1], planes, used, slack):
                        tally[CULL] += 1
                        continue
                    picked[kept] = piece
                    kept += 1
                    if kept > limit:
                        break
            candidates[i] = kept
            if kept == 0:
                tally[CLEAR] += 1
                continue
            pieces = -1
            if kept <= limit:
                visible, pieces = visible_share(
                    x, y, z, nx, ny, nz, sender, s0, s1, sender_normal, corners, starts, through, picked, kept,
                    boxes, sizes, weights, cut,
                )  # fmt: skip
                tally[CUT] += 1
                if pieces < 0:
                    tally[OVERFLOW] += 1
            if pieces < 0:
                tally[COMPLEX] += 1
                state[i] = STATE_COMPLEX
                continue
            tally[PIECES] += pieces
            share[i], state[i] = min(visible, value), STATE_EXACT
            if pieces == 0:
                tally[DARK] += 1
                state[i] = STATE_DARK


@njit(nogil=True, cache=True)
def exact_points(
    chosen, points, normals, own, sender, s0, s1, sender_normal, sender_own, corners, starts, piece_polygon, through,
    low, high, skip, head, leaf, order, bounds, slack, share, doubt, tally,
):  # fmt: skip
    """Cut the sender exactly at ``chosen`` points however many candidates there are.

    Where a cut would leave too many pieces the sender is quartered and each part cut by its own
    candidates; a part still too crowded after ``SPLIT_DEPTH`` quarterings counts half, its half is
    added to ``doubt``.
    """
    planes = np.empty((64, 4))
    found = np.empty(4096, dtype=np.int64)
    boxes = np.empty((2, MAX_PIECES, MAX_CORNERS, 3))
    sizes = np.zeros((2, MAX_PIECES), dtype=np.int64)
    weights = np.empty((2, MAX_PIECES))
    cut = np.empty((4, MAX_CORNERS, 3))
    stack = np.empty((3 * SPLIT_DEPTH + 8, 4, 3))
    depth = np.empty(3 * SPLIT_DEPTH + 8, dtype=np.int64)
    part = np.empty((4, 3))
    for row in range(chosen.shape[0]):
        i = chosen[row]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        total = unsure = 0.0
        # Triangles with a fourth corner equal to the third: one layout for quads and fans.
        for k in range(s0 + 1, s1 - 1):
            for axis in range(3):
                stack[0, 0, axis] = sender[s0, axis]
                stack[0, 1, axis] = sender[k, axis]
                stack[0, 2, axis] = sender[k + 1, axis]
            depth[0] = 0
            top = 0
            while top >= 0:
                for c in range(3):
                    for axis in range(3):
                        part[c, axis] = stack[top, c, axis]
                here = depth[top]
                top -= 1
                whole = lambert_piece(x, y, z, nx, ny, nz, part, 0, 3)
                tally[CLOSED] += 1
                if whole <= 0.0:
                    continue
                used = light_pyramid(x, y, z, nx, ny, nz, part, 0, 3, sender_normal, 2.0 * slack, planes)
                many = boxes_meeting_planes(
                    low, high, skip, head, leaf, order, bounds, planes, used, slack, found, tally
                )
                kept = 0
                if many <= found.shape[0]:
                    for c in range(many):
                        piece = found[c]
                        if piece_polygon[piece] == own[i] or piece_polygon[piece] == sender_own:
                            continue
                        tally[CHECK] += 1
                        if outside_planes(corners, starts[piece], starts[piece + 1], planes, used, slack):
                            tally[CULL] += 1
                            continue
                        found[kept] = piece
                        kept += 1
                if many <= found.shape[0] and kept == 0:
                    total += whole
                    continue
                pieces = -1
                if many <= found.shape[0] and kept <= 64:
                    visible, pieces = visible_share(
                        x, y, z, nx, ny, nz, part, 0, 3, sender_normal, corners, starts, through, found, kept,
                        boxes, sizes, weights, cut,
                    )  # fmt: skip
                    tally[CUT] += 1
                if pieces >= 0:
                    tally[PIECES] += pieces
                    total += min(visible, whole)
                    continue
                tally[OVERFLOW] += 1
                if here >= SPLIT_DEPTH:
                    total += 0.5 * whole
                    unsure += 0.5 * whole
                    continue
                for q in range(4):
                    top += 1
                    depth[top] = here + 1
                    for axis in range(3):
                        a, b, d = part[0, axis], part[1, axis], part[2, axis]
                        ab, bd, da = 0.5 * (a + b), 0.5 * (b + d), 0.5 * (d + a)
                        if q == 0:
                            stack[top, 0, axis], stack[top, 1, axis], stack[top, 2, axis] = a, ab, da
                        elif q == 1:
                            stack[top, 0, axis], stack[top, 1, axis], stack[top, 2, axis] = ab, b, bd
                        elif q == 2:
                            stack[top, 0, axis], stack[top, 1, axis], stack[top, 2, axis] = da, bd, d
                        else:
                            stack[top, 0, axis], stack[top, 1, axis], stack[top, 2, axis] = ab, bd, da
        share[i] = total
        doubt[i] = unsure


@njit(nogil=True, cache=True)
def smooth_sides(
    chosen, bounds_of, normal, offset, own, ring, sender_low, sender_high, sender_normal, sender_own, width,
    piece_polygon, low, high, skip, head, leaf, order, bounds, slack, sides,
):  # fmt: skip
    """Sides of squares, on each chosen tile, over which an edge moves across the sender by its width.

    From a point at height h above the sender's plane an edge at height z moves over the sender z / (h - z)
    times as fast as the point does along it, and faster where the point comes nearer to the sender's plane.
    No piece that may come before the sender lies higher than the box of one that meets the tile's shaft.
    """
    planes = np.empty((MAX_SHAFT_PLANES, 4))
    level = 0.0
    for axis in range(3):
        level += sender_normal[axis] * ring[0, axis]
    for row in range(chosen.shape[0]):
        t = chosen[row]
        sides[row] = 0.0
        if normal[t, 0] == 0.0 and normal[t, 1] == 0.0 and normal[t, 2] == 0.0:
            continue
        used = tile_shaft(
            bounds_of[t], normal[t], offset[t], sender_low, sender_high, sender_normal, ring, slack, planes
        )
        near, aside = -level, 0.0
        for axis in range(3):
            near += min(sender_normal[axis] * bounds_of[t, 0, axis], sender_normal[axis] * bounds_of[t, 1, axis])
            aside += max(bounds_of[t, 1, axis] - sender_low[axis], sender_high[axis] - bounds_of[t, 0, axis])
        top = 0.0
        node = 0
        while node < low.shape[0] and top < near:
            if _box_outside(low[node], high[node], planes, used, slack):
                node = skip[node]
                continue
            for i in range(head[node], head[node] + leaf[node]):
                p = order[i]
                if piece_polygon[p] == own[t] or piece_polygon[p] == sender_own:
                    continue
                if not _box_outside(bounds[p, 0], bounds[p, 1], planes, used, slack):
                    height = -level
                    for axis in range(3):
                        height += max(
                            sender_normal[axis] * bounds[p, 0, axis], sender_normal[axis] * bounds[p, 1, axis]
                        )
                    top = max(top, height)
            node += 1
        if top < near:
            tilt = 0.0
            for axis in range(3):
                tilt += normal[t, axis] * sender_normal[axis]
            rise = math.sqrt(max(1.0 - tilt * tilt, 0.0))
            sides[row] = width * (near - top) / (max(top, 1e-9 * near) * (1.0 + rise * aside / near))


@njit(nogil=True, cache=True)
def _box_outside(low, high, planes, used, slack):
    for k in range(used):
        reach = 0.0
        for axis in range(3):
            reach += planes[k, axis] * (high[axis] if planes[k, axis] > 0.0 else low[axis])
        if reach < planes[k, 3] - slack:
            return True
    return False
