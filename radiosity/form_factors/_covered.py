"""Which pieces something stands on: another polygon ends on their inside, or lies on them face to face."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from workbench.geometry.planes import clip_by_plane


@njit(nogil=True, cache=True)
def _inside_length(ring, count, nx, ny, nz, ax, ay, az, bx, by, bz, margin):
    """Length of the part of a segment in the plane of a convex ring that lies further than ``margin`` inside."""
    low, high = 0.0, 1.0
    for k in range(count):
        m = k + 1 if k + 1 < count else 0
        ex, ey, ez = ring[m, 0] - ring[k, 0], ring[m, 1] - ring[k, 1], ring[m, 2] - ring[k, 2]
        px, py, pz = ny * ez - nz * ey, nz * ex - nx * ez, nx * ey - ny * ex
        length = math.sqrt(px * px + py * py + pz * pz)
        if length == 0.0:
            continue
        ha = (px * (ax - ring[k, 0]) + py * (ay - ring[k, 1]) + pz * (az - ring[k, 2])) / length - margin
        hb = (px * (bx - ring[k, 0]) + py * (by - ring[k, 1]) + pz * (bz - ring[k, 2])) / length - margin
        if ha <= 0.0 and hb <= 0.0:
            return 0.0
        if ha * hb < 0.0:
            t = ha / (ha - hb)
            if ha < 0.0:
                low = max(low, t)
            else:
                high = min(high, t)
    return max(high - low, 0.0) * math.sqrt((bx - ax) ** 2 + (by - ay) ** 2 + (bz - az) ** 2)


@njit(nogil=True, cache=True)
def _stands_on(ring, count, nx, ny, nz, corners, a, b, slack):
    """Whether the convex ``corners[a:b]`` meets the inside of a convex ring along a line."""
    d = nx * ring[0, 0] + ny * ring[0, 1] + nz * ring[0, 2]
    found = 0
    first, last = np.empty(3), np.empty(3)
    widest = 0.0
    for k in range(a, b):
        m = k + 1 if k + 1 < b else a
        hk = nx * corners[k, 0] + ny * corners[k, 1] + nz * corners[k, 2] - d
        hm = nx * corners[m, 0] + ny * corners[m, 1] + nz * corners[m, 2] - d
        if abs(hk) <= slack:
            t = 0.0
        elif abs(hm) > slack and hk * hm < 0.0:
            t = hk / (hk - hm)
        else:
            continue
        square = 0.0
        for axis in range(3):
            at = corners[k, axis] + t * (corners[m, axis] - corners[k, axis])
            if found == 0:
                first[axis] = at
            square += (at - first[axis]) ** 2
        if found == 0 or square > widest:
            widest = square
            for axis in range(3):
                last[axis] = corners[k, axis] + t * (corners[m, axis] - corners[k, axis])
        found += 1
    if found < 2:
        return False
    return (
        _inside_length(ring, count, nx, ny, nz, first[0], first[1], first[2], last[0], last[1], last[2], 8.0 * slack)
        > 8.0 * slack
    )


@njit(nogil=True, cache=True)
def _lies_on(ring, count, nx, ny, nz, corners, a, b, slack, one, two):
    """Whether the convex ``corners[a:b]`` in the plane of a convex ring covers a part of it."""
    left = b - a
    for k in range(left):
        for axis in range(3):
            one[k, axis] = corners[a + k, axis]
    for k in range(count):
        m = k + 1 if k + 1 < count else 0
        ex, ey, ez = ring[m, 0] - ring[k, 0], ring[m, 1] - ring[k, 1], ring[m, 2] - ring[k, 2]
        px, py, pz = ny * ez - nz * ey, nz * ex - nx * ez, nx * ey - ny * ex
        length = math.sqrt(px * px + py * py + pz * pz)
        if length == 0.0:
            continue
        px, py, pz = px / length, py / length, pz / length
        d = px * ring[k, 0] + py * ring[k, 1] + pz * ring[k, 2]
        left = clip_by_plane(one, left, px, py, pz, d + 8.0 * slack, slack, two)
        if left <= 0:
            return left < 0
        one, two = two, one
    return True


@njit(nogil=True, cache=True)
def covered_pieces(
    asked, corners, start, normal, low, high, group, side, polygon, kc, ks, kg, klow, khigh, slack, out
):  # fmt: skip
    """Set ``out`` for each piece of ``asked`` that an occluder or a piece of the other facing touches inside."""
    longest = 0
    for i in range(start.shape[0] - 1):
        longest = max(longest, start[i + 1] - start[i])
    one, two = np.empty((2 * longest + 2, 3)), np.empty((2 * longest + 2, 3))
    for p in range(asked.shape[0]):
        i = asked[p]
        ring, count = corners[start[i] : start[i + 1]], start[i + 1] - start[i]
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        for k in range(ks.shape[0] - 1):
            if kg[k] == group[i]:
                continue
            apart = False
            for axis in range(3):
                if klow[k, axis] > high[i, axis] + slack or khigh[k, axis] < low[i, axis] - slack:
                    apart = True
            if not apart and _stands_on(ring, count, nx, ny, nz, kc, ks[k], ks[k + 1], slack):
                out[p] = True
                break
        if out[p]:
            continue
        for j in range(start.shape[0] - 1):
            if group[j] != group[i] or side[j] == side[i] or polygon[j] == polygon[i]:
                continue
            apart = False
            for axis in range(3):
                if low[j, axis] > high[i, axis] + slack or high[j, axis] < low[i, axis] - slack:
                    apart = True
            if not apart and _lies_on(ring, count, nx, ny, nz, corners, start[j], start[j + 1], slack, one, two):
                out[p] = True
                break
