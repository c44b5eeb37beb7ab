"""Exchange areas between all pairs of convex pieces, as kernels: the tree of pairs and its leaves.

A stripe of receivers goes down the tree of pieces once.  At each pair of nodes facing and horizon, the
sides of the occluders' planes, a shaft and the crossings of an occluder's plane settle what they can for
all pairs below; what is left of the occluders is handed down.  A single pair is then clear (quadrature
chosen by distance, or the closed form), hidden, or seen in part: the sender is cut exactly at the points of
a rule that is refined until the wanted error is met.  Long candidate lists are left to rays, unsifted where few pairs
lie below them.
"""

from __future__ import annotations

import math

from numba import njit

from radiosity.form_factors._pairs import (
    _INV_PI,
    _PLAIN,
    CLEARS,
    FAR_SHARE,
    HIDES,
    POINT_RULE,
    _axis_verdict,
    _heights,
    _span,
    crossings,
    open_exchange,
    partial_share,
    verdict,
)
from radiosity.form_factors._refine import refined_exchange
from workbench.culling.plane_vertex import outside_planes
from workbench.culling.shaft import box_shaft
from workbench.culling.tally import CLEAR, CLOSED, COMPLEX, DARK, EMPTY, HORIZON, LINK, SHAFT, SHAFT_CULL, SHAFT_TEST

BINS = 80
"""Bins of a stripe's errors, a factor of two wide."""
FIRST_BIN = -64
"""Power of two below which all errors share the first bin."""

SIFTED = 1
"""Most occluders for each pair of pieces below a pair of nodes that are sifted for it: 23,057 polygons took 16 and 4.5
times as long with all and with 8."""
LONG = 192
"""Candidates of a pair beyond which rays decide without a look at each."""

RAY_DOUBT = 0.1
"""Error of a share that rays find at first sight."""


@njit(**_PLAIN)
def _one_pair(
    i, j, straddle, begin, many, arena, limit, error, share_error, floor, first, levels, missed, reach, corners, start,
    normal, offset, centroid, area, radius, low, high, group, rules, rule_starts, fine, fine_start, kc, ks, kn, kd, kg,
    through, frame, flat, flow, fhigh, slack, fragments, sizes, weights, points, pair, kept, contour, sums, tally,
):  # fmt: skip
    """Exchange area of a pair, its error, and 1 if rays must scale it."""
    used = 0
    overflow = False
    loose = first == 0
    cx, cy, cz = centroid[i, 0], centroid[i, 1], centroid[i, 2]
    dx, dy, dz = centroid[j, 0] - cx, centroid[j, 1] - cy, centroid[j, 2] - cz
    square = dx * dx + dy * dy + dz * dz
    ra, rb = radius[i] + slack, radius[j] + slack
    if many > max(LONG, limit):
        overflow = True
        many = 0
    for c in range(begin, begin + many):
        k = arena[c]
        if kg[k] == group[i] or kg[k] == group[j]:
            continue
        tally[SHAFT_TEST] += 1
        # The balls round both pieces settle most occluders.
        ha = kn[k, 0] * cx + kn[k, 1] * cy + kn[k, 2] * cz - kd[k]
        hb = ha + kn[k, 0] * dx + kn[k, 1] * dy + kn[k, 2] * dz
        what = -1
        if abs(ha) > ra and abs(hb) > rb:
            if ha * hb > 0.0:
                tally[SHAFT_CULL] += 1
                continue
            what = _axis_verdict(
                ha, hb, cx, cy, cz, dx, dy, dz, square, max(ra, rb), flat, ks[k], ks[k + 1], flow, fhigh, frame, k
            )
        if what == CLEARS:
            tally[SHAFT_CULL] += 1
            continue
        if what == HIDES and through[k] == 0.0:
            tally[DARK] += 1
            return 0.0, 0.0, 0
        # Behind the plane of either end.
        _, above = _heights(normal[i, 0], normal[i, 1], normal[i, 2], offset[i], kc, ks[k], ks[k + 1])
        if above > slack:
            _, above = _heights(normal[j, 0], normal[j, 1], normal[j, 2], offset[j], kc, ks[k], ks[k + 1])
        if above <= slack:
            tally[SHAFT_CULL] += 1
            continue
        if loose:
            # One cut costs no more than a closer look.
            if used >= limit:
                overflow = True
            else:
                kept[used] = k
                used += 1
            continue
        ka, kb = _heights(kn[k, 0], kn[k, 1], kn[k, 2], kd[k], corners, start[i], start[i + 1])
        la, lb = _heights(kn[k, 0], kn[k, 1], kn[k, 2], kd[k], corners, start[j], start[j + 1])
        if (ka >= -slack and la >= -slack) or (kb <= slack and lb <= slack):
            tally[SHAFT_CULL] += 1
            continue
        many_crossings, separates = crossings(
            corners, start[i], start[i + 1], corners, start[j], start[j + 1], kn[k, 0], kn[k, 1], kn[k, 2], kd[k],
            frame[k, 0], frame[k, 1], frame[k, 2], frame[k, 3], frame[k, 4], frame[k, 5], frame[k, 6], frame[k, 7],
            frame[k, 8], slack, points,
        )  # fmt: skip
        what = verdict(points, many_crossings, separates, flat, ks[k], ks[k + 1], flow, fhigh, k, slack)
        if what == CLEARS:
            tally[SHAFT_CULL] += 1
            continue
        if what == HIDES and through[k] == 0.0:
            tally[DARK] += 1
            return 0.0, 0.0, 0
        if used >= limit:
            overflow = True
        else:
            kept[used] = k
            used += 1
    value, doubt = open_exchange(
        i, j, straddle, corners, start, normal, offset, centroid, area, radius, low, high, rules, rule_starts,
        fine, fine_start, reach, error, pair, contour, tally,
    )  # fmt: skip
    if value <= 0.0:
        return 0.0, doubt, 0
    tally[LINK] += 1
    if used == 0 and not overflow:
        tally[CLEAR] += 1
        return value, doubt, 0
    tally[COMPLEX] += 1
    if overflow:
        return value, doubt, 1
    s, t = (i, j) if radius[i] <= radius[j] else (j, i)
    goal = share_error * (1.0 + floor * min(area[i], area[j]) / value)
    # Of small polygons far away the kernel at a fragment's centroid tells its share as well as Lambert's formula.
    far = not straddle and POINT_RULE * radius[t] * radius[t] < FAR_SHARE * goal * square
    share, uncertain = partial_share(
        s, t, far, goal, first, levels, missed, rules, rule_starts, corners, start, normal, kc, ks, kn, kd, through,
        kept, used, fragments, sizes, weights, sums, tally,
    )  # fmt: skip
    if uncertain == 1.0:
        # No point of the smaller sees the other at all (their planes cut both near an edge): look back.
        share, uncertain = partial_share(
            t, s, False, goal, first, levels, missed, rules, rule_starts, corners, start, normal, kc, ks, kn, kd,
            through, kept, used, fragments, sizes, weights, sums, tally,
        )  # fmt: skip
        if uncertain == 1.0 and share == 0.0:
            share, uncertain = 0.5, 0.5
    if share < 0.0:
        return value, doubt, 1
    return value * share, doubt * share + value * uncertain, 0


@njit(**_PLAIN)
def _box_corners(low, high, node, out, row):
    """The eight corners of a node's box; flat boxes give four."""
    count = row
    for c in range(8):
        skip = False
        for axis in range(3):
            if c >> axis & 1 and high[node, axis] == low[node, axis]:
                skip = True
        if skip:
            continue
        for axis in range(3):
            out[count, axis] = high[node, axis] if c >> axis & 1 else low[node, axis]
        count += 1
    return count


@njit(**_PLAIN)
def node_candidates(
    a, b, arena, begin, many, node_low, node_high, node_group, plane_normal, plane_offset, kc, ks, kn, kd, kg, through,
    frame, flat, flow, fhigh, klow, khigh, slack, shaft, points, box, tally,
):  # fmt: skip
    """Occluders of ``arena[begin:begin + many]`` that may come between two nodes, put behind them.

    Returns their number, -1 if one hides all.
    """
    end = begin + many
    used = -1
    count = 0
    ga, gb = node_group[a], node_group[b]
    m = k2 = 0
    tally[SHAFT] += 1
    for c in range(begin, end):
        k = arena[c]
        if (ga >= 0 and kg[k] == ga) or (gb >= 0 and kg[k] == gb):
            continue
        tally[SHAFT_TEST] += 1
        apart = False
        for axis in range(3):
            if (
                klow[k, axis] > max(node_high[a, axis], node_high[b, axis]) + slack
                or khigh[k, axis] < min(node_low[a, axis], node_low[b, axis]) - slack
            ):
                apart = True
        if apart:
            tally[SHAFT_CULL] += 1
            continue
        alo, ahi = _span(kn, kd, k, node_low, node_high, a)
        blo, bhi = _span(kn, kd, k, node_low, node_high, b)
        if (alo >= -slack and blo >= -slack) or (ahi <= slack and bhi <= slack):
            tally[SHAFT_CULL] += 1
            continue
        # Behind the plane of either end.
        if ga >= 0:
            _, hi = _heights(
                plane_normal[a, 0], plane_normal[a, 1], plane_normal[a, 2], plane_offset[a], kc, ks[k], ks[k + 1]
            )
            if hi <= slack:
                tally[SHAFT_CULL] += 1
                continue
        if gb >= 0:
            _, hi = _heights(
                plane_normal[b, 0], plane_normal[b, 1], plane_normal[b, 2], plane_offset[b], kc, ks[k], ks[k + 1]
            )
            if hi <= slack:
                tally[SHAFT_CULL] += 1
                continue
        if used < 0:
            used = box_shaft(node_low[a], node_high[a], node_low[b], node_high[b], shaft)
            # What only touches the shaft from outside hides a null set.
            for p in range(used):
                shaft[p, 3] += 2.0 * slack
            m = _box_corners(node_low, node_high, a, box, 0)
            k2 = _box_corners(node_low, node_high, b, box, m)
        if outside_planes(kc, ks[k], ks[k + 1], shaft, used, slack):
            tally[SHAFT_CULL] += 1
            continue
        if (alo >= -slack and bhi <= slack) or (ahi <= slack and blo >= -slack):
            crossed, _ = crossings(
                box, 0, m, box, m, k2, kn[k, 0], kn[k, 1], kn[k, 2], kd[k], frame[k, 0], frame[k, 1], frame[k, 2],
                frame[k, 3], frame[k, 4], frame[k, 5], frame[k, 6], frame[k, 7], frame[k, 8], slack, points,
            )  # fmt: skip
            what = verdict(points, crossed, True, flat, ks[k], ks[k + 1], flow, fhigh, k, slack)
            if what == CLEARS:
                tally[SHAFT_CULL] += 1
                continue
            # A piece in the occluder's own plane is not hidden by it: a mixed node must keep off that plane.
            off_a = ga >= 0 or alo > slack or ahi < -slack
            off_b = gb >= 0 or blo > slack or bhi < -slack
            if what == HIDES and through[k] == 0.0 and off_a and off_b:
                return -1
        arena[end + count] = k
        count += 1
    if count == 0:
        tally[EMPTY] += 1
    return count


@njit(**_PLAIN)
def stripe(
    top, node_first, node_last, node_left, node_right, node_low, node_high, node_group, plane_normal, plane_offset,
    corners, start, normal, offset, centroid, area, radius, low, high, group, rules, rule_starts, fine, fine_start,
    kc, ks, kn, kd, kg, through, frame, flat, flow, fhigh, klow, khigh, slack, error, share_error, floor, first,
    levels, missed, reach, limit, importance, fragments, sizes, weights, points, pair, kept, contour, sums, cells,
    numbers, values, short, plane, parts, part_sizes, shaft, box, arena, stack, out, spread, flagged, threshold, tally,
):  # fmt: skip
    """Exchange areas of the pieces of node ``top`` with all pieces that come after each.

    ``out`` and ``spread`` (rows of the node, pieces); ``flagged`` (m, 2) gets the pairs for rays, whose ``out``
    is the open exchange.  Returns the number of flagged pairs, or more than there is room for, and of pairs
    refined: those whose error times the ``importance`` of both pieces is above ``threshold``.
    """
    refined = 0
    base = node_first[top]
    flags = 0
    total = ks.shape[0] - 1
    for k in range(total):
        arena[k] = k
    # Rows of the stack: node a, node b, first and number of the candidates, whether both ends are settled.
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = top, 0, 0, total
    depth = 0
    while depth >= 0:
        a, b, begin, many = stack[depth, 0], stack[depth, 1], stack[depth, 2], stack[depth, 3]
        depth -= 1
        if node_last[b] <= node_first[a] + 1:
            continue
        ga, gb = node_group[a], node_group[b]
        pairs = (node_last[a] - node_first[a]) * (node_last[b] - node_first[b])
        if ga >= 0 and ga == gb:
            # One plane and, as groups are kept by side, one facing; two sides of a sheet never meet either.
            tally[HORIZON] += pairs
            continue
        if ga >= 0:
            lo, hi = _span(plane_normal, plane_offset, a, node_low, node_high, b)
            if hi <= slack:
                tally[HORIZON] += pairs
                continue
        if gb >= 0:
            lo, hi = _span(plane_normal, plane_offset, b, node_low, node_high, a)
            if hi <= slack:
                tally[HORIZON] += pairs
                continue
        end = begin + many
        # Where few pairs lie below, to go through so many costs more than it saves.
        if 0 < many <= SIFTED * pairs:
            count = node_candidates(
                a, b, arena, begin, many, node_low, node_high, node_group, plane_normal, plane_offset,
                kc, ks, kn, kd, kg, through, frame, flat, flow, fhigh, klow, khigh, slack, shaft, points, box, tally,
            )  # fmt: skip
            if count < 0:
                tally[DARK] += pairs
                continue
            begin, many = end, count
        leaf_a, leaf_b = node_left[a] < 0, node_left[b] < 0
        if not (leaf_a and leaf_b) and (many > 0 or ga < 0 or gb < 0 or pairs > 4096):
            wide_a = wide_b = 0.0
            for axis in range(3):
                wide_a = max(wide_a, node_high[a, axis] - node_low[a, axis])
                wide_b = max(wide_b, node_high[b, axis] - node_low[b, axis])
            if leaf_b or (not leaf_a and wide_a > wide_b):
                for side in range(2):
                    depth += 1
                    stack[depth, 0] = node_right[a] if side == 0 else node_left[a]
                    stack[depth, 1], stack[depth, 2], stack[depth, 3] = b, begin, many
            else:
                for side in range(2):
                    depth += 1
                    stack[depth, 1] = node_right[b] if side == 0 else node_left[b]
                    stack[depth, 0], stack[depth, 2], stack[depth, 3] = a, begin, many
            continue
        nearest = reach[0] if many == 0 else math.inf
        for i in range(node_first[a], node_last[a]):
            nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
            cx, cy, cz = centroid[i, 0], centroid[i, 1], centroid[i, 2]
            for j in range(max(node_first[b], i + 1), node_last[b]):
                mx, my, mz = normal[j, 0], normal[j, 1], normal[j, 2]
                dx, dy, dz = centroid[j, 0] - cx, centroid[j, 1] - cy, centroid[j, 2] - cz
                # Heights of the centroids over the other's plane, against radii: most pairs need no more.
                over_i, over_j = nx * dx + ny * dy + nz * dz, -(mx * dx + my * dy + mz * dz)
                if over_i <= -radius[j] or over_j <= -radius[i]:
                    tally[HORIZON] += 1
                    continue
                straddle = False
                if over_i < radius[j]:
                    lo, hi = _heights(nx, ny, nz, offset[i], corners, start[j], start[j + 1])
                    if hi <= slack:
                        tally[HORIZON] += 1
                        continue
                    straddle = lo < -slack
                if over_j < radius[i]:
                    lo, hi = _heights(mx, my, mz, offset[j], corners, start[i], start[i + 1])
                    if hi <= slack:
                        tally[HORIZON] += 1
                        continue
                    straddle = straddle or lo < -slack
                square = dx * dx + dy * dy + dz * dz
                limit_distance = nearest * max(radius[i], radius[j])
                rays = 0
                if not straddle and square > limit_distance * limit_distance:
                    # rule_doubt with one division and one root: most pairs end here.
                    inverse = 1.0 / square
                    facing = area[i] * area[j] * _INV_PI * inverse
                    cosines = over_i * over_j * inverse
                    larger = max(radius[i], radius[j])
                    value = facing * cosines
                    doubt = POINT_RULE * larger * larger * inverse * facing * math.sqrt(cosines)
                    tally[CLOSED] += 1
                    tally[CLEAR] += 1
                    tally[LINK] += 1
                else:
                    value, doubt, rays = _one_pair(
                        i, j, straddle, begin, many, arena, limit, error, share_error, floor, first, levels, missed,
                        reach, corners, start, normal, offset, centroid, area, radius, low, high, group, rules,
                        rule_starts, fine, fine_start, kc, ks, kn, kd, kg, through, frame, flat, flow, fhigh, slack,
                        fragments, sizes, weights, points, pair, kept, contour, sums, tally,
                    )  # fmt: skip
                weight = importance[i] + importance[j]
                if threshold < math.inf and weight * max(doubt, RAY_DOUBT * value * rays) > threshold:
                    refined += 1
                    better, off, whole = refined_exchange(
                        i, j, begin, many, arena, threshold / weight, corners, start, normal, offset, radius, group, kc,
                        ks, kn, kd, kg, through, frame, flat, flow, fhigh, klow, khigh, slack, fragments, sizes,
                        weights, points, pair, contour, cells, numbers, values, short, plane, parts, part_sizes, tally,
                    )  # fmt: skip
                    if whole:
                        value, doubt, rays = better, off, 0
                    elif rays == 0:
                        rays = 1
                        value, doubt = open_exchange(
                            i, j, straddle, corners, start, normal, offset, centroid, area, radius, low, high, rules,
                            rule_starts, fine, fine_start, reach, error, pair, contour, tally,
                        )  # fmt: skip
                out[i - base, j] = value
                spread[i - base, j] = doubt
                if rays:
                    if flags < flagged.shape[0]:
                        flagged[flags, 0], flagged[flags, 1] = i, j
                    flags += 1
    return flags, refined


@njit(**_PLAIN)
def count_pairs(spread, rows):
    """Number of places of ``spread[:rows]`` that are not 0."""
    count = 0
    for i in range(rows):
        for j in range(spread.shape[1]):
            if spread[i, j] != 0.0:
                count += 1
    return count


@njit(**_PLAIN)
def take_pairs(out, spread, rows, base, row_of, importance, first, second, values, errors, bins):
    """Move what is not 0 into lists, with the rows that each pair's pieces belong to, and leave zeros.

    ``bins`` (BINS, 2) gets the number and the sum of the errors, times the importance of their pieces.
    """
    count = 0
    for i in range(rows):
        for j in range(spread.shape[1]):
            if spread[i, j] != 0.0:
                first[count], second[count] = row_of[base + i], row_of[j]
                values[count], errors[count] = out[i, j], spread[i, j]
                weight = spread[i, j] * (importance[base + i] + importance[j])
                b = min(max(math.frexp(weight)[1] - FIRST_BIN, 0), BINS - 1)
                bins[b, 0] += 1.0
                bins[b, 1] += weight
                out[i, j] = spread[i, j] = 0.0
                count += 1
