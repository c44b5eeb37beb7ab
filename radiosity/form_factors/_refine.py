"""One pair of convex pieces to a wanted error, as kernels: both ends are halved where the pair's error is made.

A cell is a part of each end.  Occluders that no longer come between its parts are dropped, so that most cells
are soon clear (a closed form) or hidden; of the rest the part that is seen is cut exactly at the points of a
rule, and halved until the halves agree with the whole.  Where the occluders are too many to cut by, the larger
end is halved first: each half has fewer before it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from radiosity.form_factors._contour import contour_integral_in
from radiosity.form_factors._links import _cell_points
from radiosity.form_factors._pairs import _PLAIN, CLEARS, HIDES, _axis_verdict, _heights, crossings, seen_share, verdict
from radiosity.form_factors.analytic import _clip_pair
from workbench.culling.tally import CLOSED, COMPLEX, DARK, SHAFT_CULL, SHAFT_TEST
from workbench.geometry.lambert import lambert_piece
from workbench.geometry.planes import clip_by_plane

ROWS = 128
"""Most cells that wait to be halved."""
MOST_CELLS = 50_000
"""Cells of a pair after which what is left counts as doubt."""
SHORT = 48
"""Candidates of a cell that are cut at once; of a longer list the larger end is halved first."""

CLOSE = 1.0
"""Height over the other end, in radii of a cell, below which the closed form of the cell is worth its time."""
NARROW = 1.0
"""Width of a shadow, in radii of a cell, below which the cell's points may miss it."""

UNSEEN = 0.1
"""Share of a cell's open exchange that its points may miss where they see nothing, and nothing proves it dark."""

PARTS = 64
"""Most parts into which an end is cut beforehand, along what touches it."""
TOUCHING = 0.02
"""Height over an end, in its own extents, up to which an occluder casts a sharp shadow on it."""

THIN, MOST_LAYERS = 0.3, 10
"""Distance of the ends, in extents of one, below which a penumbra is a thin layer; most cuts on either side of it."""

UNKNOWN, ROUGH, EXACT = -1, 0, 1


def cell_workspace(occluders, room):
    """Scratch of one thread: cells' corners (eight rows each), numbers, values, candidates, a rule; parts of an end.

    ``room`` is the number of corners that a part may have.
    """
    return (
        np.empty((8 * ROWS, 3)),
        np.empty((ROWS, 6), dtype=np.int64),
        np.empty((ROWS, 4)),
        np.empty(32 * (occluders + 1) + 4096, dtype=np.int64),
        np.empty((4, 4)),
        np.empty((PARTS + 1, room, 3)),
        np.empty(PARTS, dtype=np.int64),
    )


@njit(**_PLAIN)
def _halve(cells, source, size, short, first, second):
    """Halve the polygon of three or four corners at row ``source``, to the rows ``first`` and ``second``.

    Across its longer sides, or, of four, across its ``short`` ones.

    Returns the number of corners of both halves.
    """
    if size == 3:
        longest, turn = -1.0, 0
        for k in range(3):
            a, b = source + k, source + (k + 1) % 3
            x, y, z = cells[b, 0] - cells[a, 0], cells[b, 1] - cells[a, 1], cells[b, 2] - cells[a, 2]
            square = x * x + y * y + z * z
            if square > longest:
                longest, turn = square, k
        a, b, c = source + turn, source + (turn + 1) % 3, source + (turn + 2) % 3
        for axis in range(3):
            p, q, r = cells[a, axis], cells[b, axis], cells[c, axis]
            m = 0.5 * (p + q)
            cells[first, axis], cells[first + 1, axis], cells[first + 2, axis] = p, m, r
            cells[second, axis], cells[second + 1, axis], cells[second + 2, axis] = m, q, r
        return 3
    along = across = 0.0
    for axis in range(3):
        p, q, r, s = cells[source, axis], cells[source + 1, axis], cells[source + 2, axis], cells[source + 3, axis]
        along += (q + r - p - s) ** 2
        across += (r + s - p - q) ** 2
    for axis in range(3):
        p, q, r, s = cells[source, axis], cells[source + 1, axis], cells[source + 2, axis], cells[source + 3, axis]
        if (along >= across) != short:
            m, n = 0.5 * (p + q), 0.5 * (r + s)
            cells[first, axis], cells[first + 1, axis], cells[first + 2, axis], cells[first + 3, axis] = p, m, n, s
            cells[second, axis], cells[second + 1, axis], cells[second + 2, axis], cells[second + 3, axis] = m, q, r, n
        else:
            m, n = 0.5 * (q + r), 0.5 * (s + p)
            cells[first, axis], cells[first + 1, axis], cells[first + 2, axis], cells[first + 3, axis] = p, q, m, n
            cells[second, axis], cells[second + 1, axis], cells[second + 2, axis], cells[second + 3, axis] = n, m, r, s
    return 4


@njit(**_PLAIN)
def _ball(cells, source, size):
    """Centre of a cell's end and its radius about it."""
    x = y = z = square = 0.0
    for k in range(source, source + size):
        x, y, z = x + cells[k, 0] / size, y + cells[k, 1] / size, z + cells[k, 2] / size
    for k in range(source, source + size):
        square = max(square, (cells[k, 0] - x) ** 2 + (cells[k, 1] - y) ** 2 + (cells[k, 2] - z) ** 2)
    return x, y, z, math.sqrt(square)


@njit(**_PLAIN)
def _between(
    cells, row, numbers, arena, begin, many, free, kc, ks, kn, kd, through, frame, flat, flow, fhigh, slack, points,
    tally,
):  # fmt: skip
    """Candidates of ``arena[begin:begin + many]`` that come between the ends of a cell, put at ``free``.

    Returns their number, -1 if one hides all.
    """
    s0, t0 = 8 * row, 8 * row + 4
    s1, t1 = s0 + numbers[row, 0], t0 + numbers[row, 1]
    sx, sy, sz, sr = _ball(cells, s0, numbers[row, 0])
    tx, ty, tz, tr = _ball(cells, t0, numbers[row, 1])
    dx, dy, dz = tx - sx, ty - sy, tz - sz
    square = dx * dx + dy * dy + dz * dz
    ra, rb = sr + slack, tr + slack
    used = 0
    for c in range(begin, begin + many):
        k = arena[c]
        tally[SHAFT_TEST] += 1
        ha = kn[k, 0] * sx + kn[k, 1] * sy + kn[k, 2] * sz - kd[k]
        hb = ha + kn[k, 0] * dx + kn[k, 1] * dy + kn[k, 2] * dz
        what = -1
        if abs(ha) > ra and abs(hb) > rb:
            what = CLEARS
            if ha * hb < 0.0:
                what = _axis_verdict(
                    ha, hb, sx, sy, sz, dx, dy, dz, square, max(ra, rb), flat, ks[k], ks[k + 1], flow, fhigh, frame, k
                )
        if what == CLEARS:
            tally[SHAFT_CULL] += 1
            continue
        if what == HIDES and through[k] == 0.0:
            return -1
        ka, kb = _heights(kn[k, 0], kn[k, 1], kn[k, 2], kd[k], cells, s0, s1)
        la, lb = _heights(kn[k, 0], kn[k, 1], kn[k, 2], kd[k], cells, t0, t1)
        if (ka >= -slack and la >= -slack) or (kb <= slack and lb <= slack):
            tally[SHAFT_CULL] += 1
            continue
        crossed, separates = crossings(
            cells, s0, s1, cells, t0, t1, kn[k, 0], kn[k, 1], kn[k, 2], kd[k], frame[k, 0], frame[k, 1], frame[k, 2],
            frame[k, 3], frame[k, 4], frame[k, 5], frame[k, 6], frame[k, 7], frame[k, 8], slack, points,
        )  # fmt: skip
        what = verdict(points, crossed, separates, flat, ks[k], ks[k + 1], flow, fhigh, k, slack)
        if what == CLEARS:
            tally[SHAFT_CULL] += 1
            continue
        if what == HIDES and through[k] == 0.0:
            return -1
        arena[free + used] = k
        used += 1
    return used


@njit(**_PLAIN)
def _cell_value(
    row, allowed, ns, nt, cells, numbers, arena, rule, kc, ks, kn, kd, through, fragments, sizes, weights, contour,
    tally,
):  # fmt: skip
    """What the ends of a cell exchange past its candidates, the doubt of that or, if it is seen in part, what they
    would exchange without, and how it was found.
    """
    s0, t0 = 8 * row, 8 * row + 4
    size_s, size_t = numbers[row, 0], numbers[row, 1]
    begin, many = numbers[row, 2], numbers[row, 3]
    if many > SHORT:
        return 0.0, 0.0, UNKNOWN
    corners = _cell_points(cells[s0 : s0 + 4], size_s == 4, rule)
    total = 0.0
    if many == 0:
        tally[CLOSED] += 1
        sx, sy, sz, sr = _ball(cells, s0, size_s)
        tx, ty, tz, tr = _ball(cells, t0, size_t)
        gap = math.sqrt((tx - sx) ** 2 + (ty - sy) ** 2 + (tz - sz) ** 2) - tr
        if gap > 4.0 * sr:
            for p in range(corners):
                total += rule[p, 3] * max(
                    lambert_piece(rule[p, 0], rule[p, 1], rule[p, 2], ns[0], ns[1], ns[2], cells, t0, t0 + size_t), 0.0
                )
            # The rule's error falls with the fourth power, or the third on triangles.
            doubt = 0.1 * total * (sr / gap) ** size_s
            if doubt <= 0.1 * allowed:
                return total, doubt, EXACT
        value, rounding = contour_integral_in(
            cells[s0 : s0 + size_s], size_s, cells[t0 : t0 + size_t], size_t, 0.1 * allowed, contour
        )
        return value, rounding + 0.1 * allowed, EXACT
    tally[COMPLEX] += 1
    sx, sy, sz, sr = _ball(cells, s0, size_s)
    above = abs(nt[0] * (sx - cells[t0, 0]) + nt[1] * (sy - cells[t0, 1]) + nt[2] * (sz - cells[t0, 2]))
    d = nt[0] * cells[t0, 0] + nt[1] * cells[t0, 1] + nt[2] * cells[t0, 2]
    whole = 0.0
    for p in range(corners):
        if nt[0] * rule[p, 0] + nt[1] * rule[p, 1] + nt[2] * rule[p, 2] <= d:
            continue
        share = seen_share(
            rule[p, 0], rule[p, 1], rule[p, 2], ns[0], ns[1], ns[2], cells, t0, t0 + size_t, kc, ks, kn, kd, through,
            arena[begin : begin + many], many, fragments, sizes, weights, tally,
        )  # fmt: skip
        if share < 0.0:
            return 0.0, 0.0, UNKNOWN
        total += rule[p, 3] * share
        whole += rule[p, 3] * lambert_piece(
            rule[p, 0], rule[p, 1], rule[p, 2], ns[0], ns[1], ns[2], cells, t0, t0 + size_t
        )
    if above < CLOSE * sr:
        # So close the rule does not know the whole well; what is hidden of it is smoother than what is seen.
        clear, _ = contour_integral_in(
            cells[s0 : s0 + size_s], size_s, cells[t0 : t0 + size_t], size_t, 0.1 * allowed, contour
        )
        return max(clear - max(whole - total, 0.0), 0.0), clear, ROUGH
    return total, whole, ROUGH


@njit(**_PLAIN)
def _may_be_missed(row, allowed, cells, numbers, values, arena, flow, fhigh, klow, khigh):
    """Whether a candidate's shadow may lie between the points of a cell: narrower than it, with a narrow penumbra."""
    s0, t0 = 8 * row, 8 * row + 4
    sx, sy, sz, sr = _ball(cells, s0, numbers[row, 0])
    tx, ty, tz, tr = _ball(cells, t0, numbers[row, 1])
    far = math.sqrt((tx - sx) ** 2 + (ty - sy) ** 2 + (tz - sz) ** 2)
    # Over so much of a candidate's distance the penumbra of the cell's other end spreads.
    wide = min(2.0 * tr / far, 1.0) if far > 0.0 else 1.0
    for c in range(numbers[row, 2], numbers[row, 2] + numbers[row, 3]):
        k = arena[c]
        width = min(fhigh[k, 0] - flow[k, 0], fhigh[k, 1] - flow[k, 1])
        if width > NARROW * sr or values[row, 3] * width <= allowed * sr:
            continue
        gx = max(klow[k, 0] - sx, 0.0, sx - khigh[k, 0])
        gy = max(klow[k, 1] - sy, 0.0, sy - khigh[k, 1])
        gz = max(klow[k, 2] - sz, 0.0, sz - khigh[k, 2])
        if wide * math.sqrt(gx * gx + gy * gy + gz * gz) < NARROW * sr:
            return True
    return False


@njit(**_PLAIN)
def _move(cells, numbers, values, source, target):
    for k in range(8):
        for axis in range(3):
            cells[8 * target + k, axis] = cells[8 * source + k, axis]
    for k in range(numbers.shape[1]):
        numbers[target, k] = numbers[source, k]
    for k in range(values.shape[1]):
        values[target, k] = values[source, k]


@njit(**_PLAIN)
def _fan(ring, count, part, ox, oy, oz, cells, target):
    """Part of a convex ring, whole if it has three or four corners, else a triangle of its fan; its corners."""
    if count <= 4:
        for k in range(count):
            cells[target + k, 0], cells[target + k, 1], cells[target + k, 2] = (
                ring[k, 0] + ox, ring[k, 1] + oy, ring[k, 2] + oz,
            )  # fmt: skip
        return count
    for k in range(3):
        c = 0 if k == 0 else part + k
        cells[target + k, 0], cells[target + k, 1], cells[target + k, 2] = (
            ring[c, 0] + ox, ring[c, 1] + oy, ring[c, 2] + oz,
        )  # fmt: skip
    return 3


@njit(**_PLAIN)
def _cut_parts(nx, ny, nz, d, klow, khigh, k, near, tiny, slack, parts, part_sizes, made):
    """Cut by a plane all parts that an occluder's box comes near to; their number."""
    for p in range(made):
        size = part_sizes[p]
        apart = False
        for axis in range(3):
            low, high = math.inf, -math.inf
            for i in range(size):
                low, high = min(low, parts[p, i, axis]), max(high, parts[p, i, axis])
            if klow[k, axis] > high + near or khigh[k, axis] < low - near:
                apart = True
        if apart or made == PARTS:
            continue
        lo, hi = _heights(nx, ny, nz, d, parts[p], 0, size)
        if lo >= -tiny or hi <= tiny:
            continue
        front = clip_by_plane(parts[p], size, nx, ny, nz, d, slack, parts[made])
        back = clip_by_plane(parts[p], size, -nx, -ny, -nz, -d, slack, parts[PARTS])
        if front < 3 or back < 3:
            continue
        part_sizes[made], part_sizes[p] = front, back
        for i in range(back):
            for axis in range(3):
                parts[p, i, axis] = parts[PARTS, i, axis]
        made += 1
    return made


@njit(**_PLAIN)
def _distance_along(ring, count, ox, oy, oz, nx, ny, nz, d, ns, nt, height_t):
    """Largest distance of the other end's plane from a ring, measured square to it along where a plane cuts it."""
    slope = nt[0] * ns[0] + nt[1] * ns[1] + nt[2] * ns[2]
    if abs(slope) < 0.1:
        return math.inf
    largest = math.inf
    for i in range(count):
        m = i + 1 if i + 1 < count else 0
        ax, ay, az = ring[i, 0] + ox, ring[i, 1] + oy, ring[i, 2] + oz
        bx, by, bz = ring[m, 0] + ox, ring[m, 1] + oy, ring[m, 2] + oz
        ha, hb = nx * ax + ny * ay + nz * az - d, nx * bx + ny * by + nz * bz - d
        if ha * hb >= 0.0:
            continue
        t = ha / (ha - hb)
        x, y, z = ax + t * (bx - ax), ay + t * (by - ay), az + t * (bz - az)
        off = abs((height_t - nt[0] * x - nt[1] * y - nt[2] * z) / slope)
        largest = off if largest == math.inf else max(largest, off)
    return largest


@njit(**_PLAIN)
def _cut_along_touching(
    ring, count, ox, oy, oz, ns, nt, height_t, kc, ks, kn, kd, klow, khigh, arena, begin, many, slack, parts, part_sizes
):  # fmt: skip
    """Convex parts of an end, cut by the planes of the occluders that touch it: there what is seen of it jumps.

    They go to ``parts[:n]``, in the frame of the occluders; returns n.
    """
    extent = 0.0
    for axis in range(3):
        o = ox if axis == 0 else oy if axis == 1 else oz
        low, high = math.inf, -math.inf
        for c in range(count):
            parts[0, c, axis] = ring[c, axis] + o
            low, high = min(low, parts[0, c, axis]), max(high, parts[0, c, axis])
        extent = max(extent, high - low)
    part_sizes[0] = count
    made = 1
    near = TOUCHING * extent
    d = ns[0] * parts[0, 0, 0] + ns[1] * parts[0, 0, 1] + ns[2] * parts[0, 0, 2]
    tiny = max(slack, 1e-6 * extent)
    for c in range(begin, begin + many):
        k = arena[c]
        lo, hi = _heights(ns[0], ns[1], ns[2], d, kc, ks[k], ks[k + 1])
        if lo > near or hi <= tiny:
            continue
        wide = _distance_along(ring, count, ox, oy, oz, kn[k, 0], kn[k, 1], kn[k, 2], kd[k], ns, nt, height_t)
        for layer in range(2 * MOST_LAYERS + 1):
            # The plane itself, then both sides of it.
            step = (layer + 1) // 2
            off = 0.0
            if layer > 0:
                off = wide * 4.0 ** (step - 1) * (1.0 if layer & 1 else -1.0)
                if not 1e-12 * extent < abs(off) < 0.5 * extent:
                    break
            if layer > 0 and wide > THIN * extent:
                break
            made = _cut_parts(
                kn[k, 0], kn[k, 1], kn[k, 2], kd[k] + off, klow, khigh, k, near + abs(off), tiny, slack, parts,
                part_sizes, made,
            )  # fmt: skip
    return made


@njit(**_PLAIN)
def refined_exchange(
    i, j, begin, many, given, tolerance, corners, start, normal, offset, radius, group, kc, ks, kn, kd, kg, through,
    frame, flat, flow, fhigh, klow, khigh, slack, fragments, sizes, weights, points, pair, contour, cells, numbers,
    values, arena, rule, parts, part_sizes, tally,
):  # fmt: skip
    """Exchange area of two pieces behind the occluders ``given[begin:begin + many]`` and the estimate of its error.

    The third value tells whether what was found is all of it; if not, the candidates were too many.
    """
    m, n = _clip_pair(corners, start[i], start[i + 1], normal[i], corners, start[j], start[j + 1], normal[j], pair)
    if m <= 0 or n <= 0:
        return 0.0, 0.0, True
    ox, oy, oz = corners[start[j], 0], corners[start[j], 1], corners[start[j], 2]
    swapped = radius[j] < radius[i]
    s, t = (j, i) if swapped else (i, j)
    ring_s, ring_t = (3, 2) if swapped else (2, 3)
    count_s, count_t = (n, m) if swapped else (m, n)
    ns, nt = normal[s], normal[t]
    root = 0
    for c in range(begin, begin + many):
        k = given[c]
        if kg[k] == group[i] or kg[k] == group[j]:
            continue
        _, above = _heights(normal[i, 0], normal[i, 1], normal[i, 2], offset[i], kc, ks[k], ks[k + 1])
        if above > slack:
            _, above = _heights(normal[j, 0], normal[j, 1], normal[j, 2], offset[j], kc, ks[k], ks[k + 1])
        if above <= slack:
            continue
        if root == arena.shape[0]:
            return 0.0, 0.0, False
        arena[root] = k
        root += 1
    cuts = _cut_along_touching(
        pair[ring_s],
        count_s,
        ox,
        oy,
        oz,
        ns,
        nt,
        offset[t],
        kc,
        ks,
        kn,
        kd,
        klow,
        khigh,
        arena,
        0,
        root,
        slack,
        parts,
        part_sizes,
    )
    fans_t = 1 if count_t <= 4 else count_t - 2
    cells_s = 0
    for cut in range(cuts):
        cells_s += 1 if part_sizes[cut] <= 4 else part_sizes[cut] - 2
    share = tolerance / math.sqrt(cells_s * fans_t)
    total = doubt = 0.0
    made = 0
    cut = part = 0
    for number in range(cells_s * fans_t):
        if number % fans_t == 0 and number > 0:
            part += 1
            if part >= (1 if part_sizes[cut] <= 4 else part_sizes[cut] - 2):
                cut, part = cut + 1, 0
        numbers[0, 0] = _fan(parts[cut], part_sizes[cut], part, 0.0, 0.0, 0.0, cells, 0)
        numbers[0, 1] = _fan(pair[ring_t], count_t, number % fans_t, ox, oy, oz, cells, 4)
        # Row -> its candidates (first and number); value, share of the error allowed, error of what it came from.
        numbers[0, 2], numbers[0, 3], numbers[0, 4], numbers[0, 5] = 0, root, UNKNOWN, 0
        values[0, 0], values[0, 1], values[0, 2] = 0.0, share, math.inf
        if 2 * root > arena.shape[0]:
            return 0.0, 0.0, False
        left = _between(
            cells, 0, numbers, arena, 0, root, root, kc, ks, kn, kd, through, frame, flat, flow, fhigh, slack, points,
            tally,
        )  # fmt: skip
        if left < 0:
            tally[DARK] += 1
            continue
        numbers[0, 2], numbers[0, 3] = root, left
        value, off, state = _cell_value(
            0, share, ns, nt, cells, numbers, arena, rule, kc, ks, kn, kd, through, fragments, sizes, weights,
            contour, tally,
        )  # fmt: skip
        if state == EXACT:
            total, doubt = total + value, doubt + off
            continue
        values[0, 0], values[0, 3], numbers[0, 4] = value, off, state
        top = 0
        while top >= 0:
            made += 1
            if made > MOST_CELLS or top + 3 > ROWS:
                # No more: what waits counts as it is.
                for row in range(top + 1):
                    if numbers[row, 4] == UNKNOWN:
                        return total, doubt, False
                    total += values[row, 0]
                    doubt += min(values[row, 2], 0.5 * values[row, 3])
                break
            size_s, size_t = numbers[top, 0], numbers[top, 1]
            s0, t0 = 8 * top, 8 * top + 4
            of_target = False
            if numbers[top, 4] == UNKNOWN:
                _, _, _, rs = _ball(cells, s0, size_s)
                _, _, _, rt = _ball(cells, t0, size_t)
                of_target = rt > rs
            free = numbers[top, 2] + numbers[top, 3]
            if free + 2 * numbers[top, 3] > arena.shape[0]:
                return total, doubt, False
            for half in range(2):
                row = top + 1 + half
                for c in range(8):
                    for axis in range(3):
                        cells[8 * row + c, axis] = cells[s0 + c, axis]
                numbers[row, 0], numbers[row, 1] = size_s, size_t
                numbers[row, 5] = numbers[top, 5] + (0 if of_target else 1)
            shift = 4 if of_target else 0
            # A long cell may be smooth along and not across: the first look is across.
            depth = numbers[top, 5]
            _halve(
                cells, s0 + shift, size_t if of_target else size_s, not of_target and depth == 0, s0 + 8 + shift,
                s0 + 16 + shift,
            )  # fmt: skip
            allowed = values[top, 1] * 0.7071067811865476
            both = dim = 0.0
            rough = 0
            unknown = numbers[top, 4] == UNKNOWN
            for half in range(2):
                row = top + 1 + half
                left = _between(
                    cells, row, numbers, arena, numbers[top, 2], numbers[top, 3], free, kc, ks, kn, kd, through, frame,
                    flat, flow, fhigh, slack, points, tally,
                )  # fmt: skip
                if left < 0:
                    tally[DARK] += 1
                    numbers[row, 4], values[row, 0] = EXACT, 0.0
                    continue
                numbers[row, 2], numbers[row, 3] = free, left
                value, off, state = _cell_value(
                    row, allowed, ns, nt, cells, numbers, arena, rule, kc, ks, kn, kd, through, fragments, sizes,
                    weights, contour, tally,
                )  # fmt: skip
                free += left
                numbers[row, 4], values[row, 0], values[row, 3] = state, value, off
                if state == EXACT:
                    doubt += off
                unknown = unknown or state == UNKNOWN
                rough += state != EXACT
                both += value
                if state == ROUGH:
                    dim += off
            error = math.inf
            if not unknown:
                # Halves may agree with the whole by chance: at once no more than so much is gained.
                before = values[top, 2] if values[top, 2] < math.inf else 2.0 * max(both, values[top, 0])
                error = max(0.4 * abs(both - values[top, 0]), 0.15 * before)
                if both + values[top, 0] <= 0.0 and numbers[top, 3] == 1:
                    # No point sees past the one occluder that is left, and nothing proves that none can: a rim may
                    # lie open between them.  (Several may well hide all together, which no halving proves.)
                    error = UNSEEN * dim
                if rough == 0:
                    error = 0.0
            if rough == 0 or (
                error <= values[top, 1]
                and depth > 0
                and not _may_be_missed(top, values[top, 1], cells, numbers, values, arena, flow, fhigh, klow, khigh)
            ):
                total += both
                doubt += error
                top -= 1
                continue
            target = top
            for half in range(2):
                row = top + 1 + half
                if numbers[row, 4] == EXACT:
                    total += values[row, 0]
                    continue
                values[row, 1] = allowed
                values[row, 2] = error / rough
                if row != target:
                    _move(cells, numbers, values, row, target)
                target += 1
            top = target - 1
    return total, max(doubt, 1e-15 * total), True
