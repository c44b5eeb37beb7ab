"""One pair of convex pieces to a wanted error, as kernels: both ends are cut where the pair's error is made.

A cell is a part of each end.  Occluders that no longer come between its parts are dropped, so that most cells
are soon clear (a closed form) or hidden; of the rest the part that is seen is cut exactly at the points of a
rule.  What two rules on those points differ by tells the error of the quadrature, but not what all points miss:
a rim, a slot, a thin layer.  That can be only where what is seen changes its form inside the cell (the EV events of
D. Lischinski, F. Tampieri and D. P. Greenberg, "Discontinuity meshing for accurate radiosity", 1992), or where the
cell is wide beside its distance; there a share of all that the cell may exchange counts as error, until the cell
has been cut along its events.  Where the occluders are too many to cut by, the larger end is halved first: each half
has fewer before it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from radiosity.form_factors._contour import contour_integral_in
from radiosity.form_factors._pairs import _PLAIN, CLEARS, HIDES, _axis_verdict, _heights, crossings, seen_share, verdict
from radiosity.form_factors._ray_shares import MOST_RAYS
from radiosity.form_factors._sampling import RADON_POINTS, RADON_WEIGHTS
from radiosity.form_factors.analytic import _clip_pair
from workbench.culling.tally import CLOSED, COMPLEX, DARK, SHAFT_CULL, SHAFT_TEST
from workbench.geometry.lambert import lambert_piece
from workbench.geometry.planes import clip_by_plane, newell_normal

ROWS = 128
"""Most cells that wait to be halved."""
MOST_CELLS = 50_000
"""Cells of a pair after which what is left counts as doubt."""
SHORT = 48
"""Candidates of a cell that are cut at once; of a longer list the larger end is halved first."""
REFINING_RAYS = 64 * MOST_RAYS
"""Most rays of a pair that is refined: where they are enough, and candidates are many, they take less time."""

CLOSE = 1.0
"""Height over the other end, in radii of a cell, below which the closed form of the cell is worth its time."""
UNSEEN = 0.03
"""Share of a cell's open exchange that the points of its rule may miss where what is seen changes its form and they do
not."""
FEW, VARIED = 4, 0.15
"""Part of it that they may miss where they differ: half behind few candidates, less of more, whose events are many."""

PARTS = 64
"""Most parts into which an end is cut beforehand, along what touches it."""
TOUCHING = 0.02
"""Height over an end, in its own extents, up to which an occluder casts a sharp shadow on it."""

THIN, MOST_LAYERS = 0.3, 10
"""Distance of the ends, in extents of one, below which a penumbra is a thin layer; most cuts on either side of it."""

CORNERS = 8
"""Most corners of a cell's ends."""
SPARE = 2 * CORNERS * ROWS
"""Row of one end beside all cells."""
EVEN = 0.1
"""Part of a cell's height that a cut along an event must leave on either side; else it is halved."""

_A = RADON_POINTS[1, 1]
_LOW = np.array([1.0 - 0.25 / (1 - 3 * _A) ** 2, *[0.25 / (1 - 3 * _A) ** 2 / 3] * 3, 0.0, 0.0, 0.0])
"""The rule of four of Radon's points that is exact to the second degree."""


def cell_workspace(occluders, room):
    """Scratch of one thread: cells' corners, numbers, allowed errors, candidates, a plane; parts of an end.

    ``room`` is the number of corners that a part may have.
    """
    return (
        np.empty((2 * CORNERS * ROWS + CORNERS, 3)),
        np.empty((ROWS, 4), dtype=np.int64),
        np.empty(ROWS),
        np.empty(32 * (occluders + 1) + 4096, dtype=np.int64),
        np.empty(4),
        np.empty((PARTS + 1, room, 3)),
        np.empty(PARTS, dtype=np.int64),
    )


@njit(**_PLAIN)
def _middle_plane(cells, source, size):
    """Plane (unnormalised normal, offset) that halves a polygon across where it is longest."""
    farthest = -1.0
    first = second = source
    for i in range(source, source + size):
        for j in range(i + 1, source + size):
            x, y, z = cells[j, 0] - cells[i, 0], cells[j, 1] - cells[i, 1], cells[j, 2] - cells[i, 2]
            square = x * x + y * y + z * z
            if square > farthest:
                farthest, first, second = square, i, j
    nx, ny, nz = (
        cells[second, 0] - cells[first, 0], cells[second, 1] - cells[first, 1], cells[second, 2] - cells[first, 2]
    )  # fmt: skip
    mx, my, mz = (
        0.5 * (cells[second, 0] + cells[first, 0]),
        0.5 * (cells[second, 1] + cells[first, 1]),
        0.5 * (cells[second, 2] + cells[first, 2]),
    )
    return nx, ny, nz, nx * mx + ny * my + nz * mz


@njit(**_PLAIN)
def _split(cells, source, size, nx, ny, nz, d, first, second):
    """Cut the polygon at row ``source`` by a plane, to the rows ``first`` and ``second``; corners of both parts.

    One that would get too many corners is cut along a diagonal instead.
    """
    polygon = cells[source : source + size]
    front = clip_by_plane(polygon, size, nx, ny, nz, d, 0.0, cells[first : first + CORNERS])
    back = clip_by_plane(polygon, size, -nx, -ny, -nz, -d, 0.0, cells[second : second + CORNERS])
    if front >= 0 and back >= 0:
        return front, back
    middle = size // 2
    for k in range(middle + 1):
        for axis in range(3):
            cells[first + k, axis] = cells[source + k, axis]
    for k in range(middle, size + 1):
        for axis in range(3):
            cells[second + k - middle, axis] = cells[source + (k if k < size else 0), axis]
    return middle + 1, size - middle + 1


@njit(**_PLAIN)
def _area(cells, source, size):
    """Area of a convex polygon."""
    x, y, z = newell_normal(cells, source, source + size)
    return math.sqrt(x * x + y * y + z * z)


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
    s0, t0 = 2 * CORNERS * row, 2 * CORNERS * row + CORNERS
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
def _depth(cells, s0, s1, nx, ny, nz, d, tiny):
    """Part of the height of a polygon over a plane that lies on its shorter side; 0 if it is not cut."""
    lo, hi = _heights(nx, ny, nz, d, cells, s0, s1)
    if lo >= -tiny or hi <= tiny:
        return 0.0
    return min(hi, -lo) / (hi - lo)


@njit(**_PLAIN)
def _beside(cells, s0, s1, nx, ny, nz, ux, uy, uz, vx, vy, vz, px, py, pz):
    """Whether a polygon lies beside the cone from (px, py, pz) between u and v, in whose plane n stands."""
    wx, wy, wz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
    sign = 1.0 if wx * vx + wy * vy + wz * vz > 0.0 else -1.0
    outside = True
    for i in range(s0, s1):
        if sign * (wx * (cells[i, 0] - px) + wy * (cells[i, 1] - py) + wz * (cells[i, 2] - pz)) > 0.0:
            outside = False
            break
    return outside


@njit(**_PLAIN)
def _most_hidden(cells, row, numbers, nt, k, flow, fhigh, klow, khigh):
    """Most of a cell's other end that a candidate may hide from any point of the cell, as a share: by solid angles."""
    s0, t0 = 2 * CORNERS * row, 2 * CORNERS * row + CORNERS
    sx, sy, sz, sr = _ball(cells, s0, numbers[row, 0])
    tx, ty, tz, _ = _ball(cells, t0, numbers[row, 1])
    gx = max(klow[k, 0] - sx, 0.0, sx - khigh[k, 0])
    gy = max(klow[k, 1] - sy, 0.0, sy - khigh[k, 1])
    gz = max(klow[k, 2] - sz, 0.0, sz - khigh[k, 2])
    gap = math.sqrt(gx * gx + gy * gy + gz * gz) - sr
    if gap <= 0.0:
        return 1.0
    dx, dy, dz = sx - tx, sy - ty, sz - tz
    square = dx * dx + dy * dy + dz * dz
    height = max(nt[0] * dx + nt[1] * dy + nt[2] * dz, 0.0)
    # area / gap^2 of the candidate over area cos / distance^2 of the end.
    width = (fhigh[k, 0] - flow[k, 0]) * (fhigh[k, 1] - flow[k, 1])
    seen = gap * gap * _area(cells, t0, numbers[row, 1]) * height
    return min(1.0, width * square * math.sqrt(square) / seen) if seen > 0.0 else 1.0


@njit(**_PLAIN)
def _distance(x, y, z, nx, ny, nz, d, corners, a, b):
    """Lower bound on the distance of a point from a convex polygon whose plane has the normal n."""
    off = 0.0
    for i in range(a, b):
        m = i + 1 if i + 1 < b else a
        ex, ey, ez = corners[m, 0] - corners[i, 0], corners[m, 1] - corners[i, 1], corners[m, 2] - corners[i, 2]
        px, py, pz = ey * nz - ez * ny, ez * nx - ex * nz, ex * ny - ey * nx
        length = math.sqrt(px * px + py * py + pz * pz)
        if length > 0.0:
            beyond = px * (x - corners[i, 0]) + py * (y - corners[i, 1]) + pz * (z - corners[i, 2])
            off = max(off, beyond / length)
    height = nx * x + ny * y + nz * z - d
    return math.sqrt(height * height + off * off)


@njit(**_PLAIN)
def _event(cells, row, numbers, nt, arena, kc, ks, kn, kd, flow, fhigh, klow, khigh, slack, plane):
    """The plane in which what a cell's end sees of the other changes its form that matters most to the cell.

    An edge of a candidate with a corner of the other end, an edge of that with a corner of the candidate, a
    candidate's own plane (the EV events of discontinuity meshing).  Returns the part of the cell's height that
    lies on the shorter side, 0 if no such plane cuts it, and the share of what is seen that the points of the
    cell's rule may miss for it.
    """
    s0, t0 = 2 * CORNERS * row, 2 * CORNERS * row + CORNERS
    s1, t1 = s0 + numbers[row, 0], t0 + numbers[row, 1]
    depth = missed = 0.0
    x, y, z, radius = _ball(cells, s0, numbers[row, 0])
    height = nt[0] * cells[t0, 0] + nt[1] * cells[t0, 1] + nt[2] * cells[t0, 2]
    near = _distance(x, y, z, nt[0], nt[1], nt[2], height, cells, t0, t1) < radius
    for c in range(numbers[row, 2], numbers[row, 2] + numbers[row, 3]):
        k = arena[c]
        most = _most_hidden(cells, row, numbers, nt, k, flow, fhigh, klow, khigh)
        if most * UNSEEN <= missed:
            continue
        best = 0.0
        lo, hi = _heights(kn[k, 0], kn[k, 1], kn[k, 2], kd[k], cells, t0, t1)
        if lo < 0.0 and hi > 0.0:
            best = _depth(cells, s0, s1, kn[k, 0], kn[k, 1], kn[k, 2], kd[k], slack)
            if best > 0.0 and min(best, UNSEEN) * most > missed:
                depth, missed = best, min(best, UNSEEN) * most
                plane[0], plane[1], plane[2], plane[3] = kn[k, 0], kn[k, 1], kn[k, 2], kd[k]
        for edge in range(2):
            # Edges of the candidate with corners of the other end, then the other way round.
            e0, e1 = (ks[k], ks[k + 1]) if edge == 0 else (t0, t1)
            p0, p1 = (t0, t1) if edge == 0 else (ks[k], ks[k + 1])
            edges, apexes = (kc, cells) if edge == 0 else (cells, kc)
            for p in range(p0, p1):
                px, py, pz = apexes[p, 0], apexes[p, 1], apexes[p, 2]
                for e in range(e0, e1):
                    m = e + 1 if e + 1 < e1 else e0
                    ux, uy, uz = edges[e, 0] - px, edges[e, 1] - py, edges[e, 2] - pz
                    vx, vy, vz = edges[m, 0] - px, edges[m, 1] - py, edges[m, 2] - pz
                    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
                    square = nx * nx + ny * ny + nz * nz
                    if square <= 1e-24 * (ux * ux + uy * uy + uz * uz) * (vx * vx + vy * vy + vz * vz):
                        continue
                    d = nx * px + ny * py + nz * pz
                    cut = _depth(cells, s0, s1, nx, ny, nz, d, slack * math.sqrt(square))
                    if cut <= best:
                        continue
                    if edge == 1:
                        # Seen through the candidate's corner the edge lies on the other side.
                        ux, uy, uz, vx, vy, vz = -ux, -uy, -uz, -vx, -vy, -vz
                    if _beside(cells, s0, s1, nx, ny, nz, ux, uy, uz, vx, vy, vz, px, py, pz) or _beside(
                        cells, s0, s1, nx, ny, nz, vx, vy, vz, ux, uy, uz, px, py, pz
                    ):
                        continue
                    best = cut
                    if min(best, UNSEEN) * most >= missed:
                        depth, missed = best, min(best, UNSEEN) * most
                        plane[0], plane[1], plane[2], plane[3] = nx, ny, nz, d
        # So near both, the rule is coarse even where the form stays.
        if (
            near
            and most * UNSEEN > missed
            and _distance(x, y, z, kn[k, 0], kn[k, 1], kn[k, 2], kd[k], kc, ks[k], ks[k + 1]) < radius
        ):
            missed = most * UNSEEN
    return depth, missed


@njit(**_PLAIN)
def _clear_value(cells, row, numbers, ns, allowed, contour, tally):
    """What the ends of a cell exchange with nothing between them, and the error of that."""
    s0, t0 = 2 * CORNERS * row, 2 * CORNERS * row + CORNERS
    size_s, size_t = numbers[row, 0], numbers[row, 1]
    tally[CLOSED] += 1
    sx, sy, sz, sr = _ball(cells, s0, size_s)
    tx, ty, tz, tr = _ball(cells, t0, size_t)
    gap = math.sqrt((tx - sx) ** 2 + (ty - sy) ** 2 + (tz - sz) ** 2) - tr
    if gap > 4.0 * sr:
        total = off = 0.0
        for part in range(1, size_s - 1):
            high = low = 0.0
            area = _part_area(cells, s0, part)
            for p in range(7):
                x, y, z = _part_point(cells, s0, part, p)
                value = max(lambert_piece(x, y, z, ns[0], ns[1], ns[2], cells, t0, t0 + size_t), 0.0)
                high += RADON_WEIGHTS[p] * value
                low += _LOW[p] * value
            total += area * high
            off += area * abs(high - low) * (sr / gap)
        if off <= 0.1 * allowed:
            return total, off
    value, rounding = contour_integral_in(
        cells[s0 : s0 + size_s], size_s, cells[t0 : t0 + size_t], size_t, 0.1 * allowed, contour
    )
    return value, rounding + 0.1 * allowed


@njit(**_PLAIN)
def _part_area(cells, s0, part):
    """Area of a triangle of a polygon's fan."""
    ax, ay, az = cells[s0, 0], cells[s0, 1], cells[s0, 2]
    b, c = s0 + part, s0 + part + 1
    ux, uy, uz = cells[b, 0] - ax, cells[b, 1] - ay, cells[b, 2] - az
    vx, vy, vz = cells[c, 0] - ax, cells[c, 1] - ay, cells[c, 2] - az
    px, py, pz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return 0.5 * math.sqrt(px * px + py * py + pz * pz)


@njit(**_PLAIN)
def _part_point(cells, s0, part, p):
    """A point of the rule on a triangle of a polygon's fan."""
    b, c = s0 + part, s0 + part + 1
    u, v = RADON_POINTS[p, 1], RADON_POINTS[p, 2]
    w = 1.0 - u - v
    return (
        w * cells[s0, 0] + u * cells[b, 0] + v * cells[c, 0],
        w * cells[s0, 1] + u * cells[b, 1] + v * cells[c, 1],
        w * cells[s0, 2] + u * cells[b, 2] + v * cells[c, 2],
    )


@njit(**_PLAIN)
def _cell_value(
    row, allowed, ns, nt, cells, numbers, arena, kc, ks, kn, kd, through, fragments, sizes, weights, contour, tally,
):  # fmt: skip
    """What the ends of a cell exchange past its candidates, the error of that, how far the visible shares of its points
    lie apart, and whether there was room.
    """
    s0, t0 = 2 * CORNERS * row, 2 * CORNERS * row + CORNERS
    size_s, size_t = numbers[row, 0], numbers[row, 1]
    begin, many = numbers[row, 2], numbers[row, 3]
    tally[COMPLEX] += 1
    sx, sy, sz, sr = _ball(cells, s0, size_s)
    d = nt[0] * cells[t0, 0] + nt[1] * cells[t0, 1] + nt[2] * cells[t0, 2]
    # So close the rule does not know the whole well; what is hidden of it is smoother than what is seen.
    close = abs(nt[0] * sx + nt[1] * sy + nt[2] * sz - d) < CLOSE * sr
    total = off = 0.0
    least, most = 1.0, 0.0
    for part in range(1, size_s - 1):
        high = low = 0.0
        area = _part_area(cells, s0, part)
        for p in range(7):
            x, y, z = _part_point(cells, s0, part, p)
            if nt[0] * x + nt[1] * y + nt[2] * z <= d:
                continue
            share = seen_share(
                x, y, z, ns[0], ns[1], ns[2], cells, t0, t0 + size_t, kc, ks, kn, kd, through,
                arena[begin : begin + many], many, fragments, sizes, weights, tally,
            )  # fmt: skip
            if share < 0.0:
                return 0.0, 0.0, 0.0, False
            whole = lambert_piece(x, y, z, ns[0], ns[1], ns[2], cells, t0, t0 + size_t)
            if whole > 0.0:
                least, most = min(least, share / whole), max(most, share / whole)
            if close:
                share = max(whole - share, 0.0)
            high += RADON_WEIGHTS[p] * share
            low += _LOW[p] * share
        total += area * high
        off += area * abs(high - low)
    if close:
        clear, rounding = contour_integral_in(
            cells[s0 : s0 + size_s], size_s, cells[t0 : t0 + size_t], size_t, 0.1 * allowed, contour
        )
        return max(clear - total, 0.0), off + rounding + 0.1 * allowed, max(most - least, 0.0), True
    return total, off, max(most - least, 0.0), True


@njit(**_PLAIN)
def _copy(cells, numbers, values, source, target):
    """Copy a cell to another row."""
    for k in range(2 * CORNERS):
        for axis in range(3):
            cells[2 * CORNERS * target + k, axis] = cells[2 * CORNERS * source + k, axis]
    for k in range(numbers.shape[1]):
        numbers[target, k] = numbers[source, k]
    values[target] = values[source]


@njit(**_PLAIN)
def _fan(ring, count, part, ox, oy, oz, cells, target):
    """Part of a convex ring, whole if it has few corners, else a triangle of its fan; its corners."""
    if count <= CORNERS:
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
    values, arena, plane, parts, part_sizes, tally,
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
    if root > SHORT:
        x, y, z, _ = _ball(pair[ring_s], 0, count_s)
        whole = _area(pair[ring_s], 0, count_s) * max(
            lambert_piece(x, y, z, ns[0], ns[1], ns[2], pair[ring_t], 0, count_t), 0.0
        )
        # Half of what may be seen is the most that one ray differs from the mean of all.
        if 0.25 * whole * whole < tolerance * tolerance * REFINING_RAYS:
            return 0.0, 0.0, False
    cuts = _cut_along_touching(
        pair[ring_s], count_s, ox, oy, oz, ns, nt, offset[t], kc, ks, kn, kd, klow, khigh, arena, 0, root, slack, parts,
        part_sizes,
    )  # fmt: skip
    fans_t = 1 if count_t <= CORNERS else count_t - 2
    cells_s = 0
    for cut in range(cuts):
        cells_s += 1 if part_sizes[cut] <= CORNERS else part_sizes[cut] - 2
    share = tolerance / math.sqrt(cells_s * fans_t)
    total = doubt = 0.0
    made = 0
    cut = part = 0
    for number in range(cells_s * fans_t):
        if number % fans_t == 0 and number > 0:
            part += 1
            if part >= (1 if part_sizes[cut] <= CORNERS else part_sizes[cut] - 2):
                cut, part = cut + 1, 0
        # Row -> corners of both ends, candidates (first and number); share of the error allowed.
        numbers[0, 0] = _fan(parts[cut], part_sizes[cut], part, 0.0, 0.0, 0.0, cells, 0)
        numbers[0, 1] = _fan(pair[ring_t], count_t, number % fans_t, ox, oy, oz, cells, CORNERS)
        numbers[0, 2], numbers[0, 3] = 0, root
        values[0] = share
        all_area = _area(cells, 0, numbers[0, 0])
        top = 0
        while top >= 0:
            made += 1
            free = numbers[top, 2] + numbers[top, 3]
            if free + numbers[top, 3] > arena.shape[0] or top + 2 > ROWS:
                return total, doubt, False
            left = _between(
                cells, top, numbers, arena, numbers[top, 2], numbers[top, 3], free, kc, ks, kn, kd, through, frame,
                flat, flow, fhigh, slack, points, tally,
            )  # fmt: skip
            if left < 0:
                tally[DARK] += 1
                top -= 1
                continue
            numbers[top, 2], numbers[top, 3] = free, left
            allowed = values[top]
            if left == 0:
                value, off = _clear_value(cells, top, numbers, ns, allowed, contour, tally)
                total, doubt = total + value, doubt + off
                top -= 1
                continue
            s0, t0 = 2 * CORNERS * top, 2 * CORNERS * top + CORNERS
            size_s, size_t = numbers[top, 0], numbers[top, 1]
            sx, sy, sz, sr = _ball(cells, s0, size_s)
            area = _area(cells, s0, size_s)
            if area <= 0.0:
                top -= 1
                continue
            whole = area * max(lambert_piece(sx, sy, sz, ns[0], ns[1], ns[2], cells, t0, t0 + size_t), 0.0)
            of_target = False
            event = 0.0
            error = math.inf
            last = made > MOST_CELLS
            if left > SHORT:
                _, _, _, tr = _ball(cells, t0, size_t)
                of_target = tr > sr
            else:
                event, missed = _event(
                    cells, top, numbers, nt, arena, kc, ks, kn, kd, flow, fhigh, klow, khigh, slack, plane
                )
                # Where its form changes the rule's points may miss a part of what is seen.
                missed *= whole
                if left > 1:
                    # Of several, most such planes change nothing that is seen, and no halving rids a cell of all.
                    missed *= math.sqrt(area / all_area)
                varied = VARIED if left > FEW else 0.5
                if varied * missed <= allowed or last:
                    value, error, apart, room = _cell_value(
                        top, allowed, ns, nt, cells, numbers, arena, kc, ks, kn, kd, through, fragments, sizes,
                        weights, contour, tally,
                    )  # fmt: skip
                    if not room:
                        error = math.inf
                    # Points that differ a little see the most of what there is; much, that it may be a step.
                    error = max(error, max(varied, 1.0 - 4.0 * apart, 3.0 * varied * apart) * missed)
            if error <= allowed or (last and error < math.inf):
                total, doubt = total + value, doubt + error
                top -= 1
                continue
            if last:
                return total, doubt, False
            _copy(cells, numbers, values, top, top + 1)
            first = t0 if of_target else s0
            size = size_t if of_target else size_s
            if event > EVEN:
                nx, ny, nz, d = plane[0], plane[1], plane[2], plane[3]
            else:
                nx, ny, nz, d = _middle_plane(cells, first, size)
            # The source is overwritten: it is read from the copy's row.
            one, two = _split(cells, first + 2 * CORNERS, size, nx, ny, nz, d, SPARE, first)
            for k in range(one):
                for axis in range(3):
                    cells[first + 2 * CORNERS + k, axis] = cells[SPARE + k, axis]
            column = 1 if of_target else 0
            numbers[top, column], numbers[top + 1, column] = two, one
            for half in range(2):
                row = top + half
                part_area = _area(cells, first + 2 * CORNERS * half, numbers[row, column])
                fraction = min(max(part_area / area, 0.02), 1.0) if not of_target else 0.5
                values[row] = allowed * math.sqrt(fraction)
            top += 1
            if one < 3:
                top -= 1
            elif two < 3:
                _copy(cells, numbers, values, top, top - 1)
                top -= 1
    return total, max(doubt, 1e-15 * total), True
