"""Links of hierarchical radiosity as kernels: settle, measure, judge and finish whole frontiers of pairs.

A pair joins two nodes of the tree.  What is kept of it is the exchange area ``G = A_a F_ab = A_b F_ba``,
so reciprocity holds by construction, and by how much the form factor varies over each end.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from radiosity.form_factors._links import (
    MAX_CANDIDATES,
    _cell_points,
    _element_integral,
    _group_is_dark,
    _on_one_side,
    _point_share,
    _sampled_share,
    open_share,
)
from radiosity.form_factors._sampling import stream
from radiosity.form_factors.analytic import pair_exchange
from radiosity.hierarchy import NODE_SAMPLES, place_on_node
from workbench.accel.box_tree import boxes_meeting_planes
from workbench.culling.hull_shaft import hull_shaft
from workbench.culling.plane_vertex import outside_planes
from workbench.culling.shaft import box_shaft
from workbench.culling.tally import CLEAR as TALLY_CLEAR
from workbench.culling.tally import CLOSED, COMPLEX, DARK, EMPTY, HORIZON, LINK, SHAFT, SHAFT_CULL, SHAFT_TEST
from workbench.geometry.planes import clip_by_plane

UNSEEN, CLEAR, CUT, RAYS, NEAR = 0, 1, 2, 3, 4
"""What is known of a pair: nothing yet, NOT_INSHADOW, COMPLEX with a short list, COMPLEX left to rays, and
a cluster so near that its samples do not tell what it sends (also left to rays)."""

DROPPED = -1
"""A pair that exchanges nothing: behind a horizon, or INSHADOW."""

PART_OF_CLEAR, PART_OF_CUT = -2, -3
"""A pair not measured yet, of which the pair it is part of is known."""

KEPT = 64
"""Longest candidate list kept with a pair; where there are more, a part asks the box tree itself."""
CUTS = 40
"""Longest candidate list that is cut."""
SUMMED = 16
"""Pieces of a cluster that are seen one by one; with more, its samples stand for it."""
UNEVEN = 5.0
"""What an uneven sender counts against a receiver's own detail (measured on rooms)."""
AGREE, AGREE_RAYS, CLOSED_ERROR = 0.7, 0.95, 0.02
"""Ratio of the exchange areas that the rules of two ends find below which a closed form is asked, of all pairs and of
those left to rays; and its error.  Rules pass by what is close, so that many coarse links together lost a per cent."""
EDGE = 0.5
"""Least share of how much a form factor varies by shadows that a slope leaves: an edge is none."""
BENT = 0.5
"""Least that a form factor is taken to bend over a node, in squares of how much it varies."""
SHADOW_CORNERS = 12
"""Most corners of a quad's part in the shadow of a piece of the scene, with room to spare."""


@njit(nogil=True, cache=True)
def node_points(node, tree, cell, out):
    """Rows (x, y, z, weight, normal) that stand for a node; their number.

    The 2 x 2 Gauss rule of a quad, the 3-point rule of a triangle, else the node's samples.
    """
    row = tree.sample[node]
    if row >= 0:
        for k in range(NODE_SAMPLES):
            for axis in range(3):
                out[k, axis] = tree.samples[row, k, axis]
                out[k, 4 + axis] = tree.sample_normals[row, k, axis]
            out[k, 3] = tree.area[node] / NODE_SAMPLES
        return NODE_SAMPLES
    a, b = tree.starts[tree.piece0[node]], tree.starts[tree.piece0[node] + 1]
    for i in range(a, b):
        for axis in range(3):
            cell[i - a, axis] = tree.corners[i, axis]
    count = _cell_points(cell, b - a == 4, out)
    for k in range(count):
        for axis in range(3):
            out[k, 4 + axis] = tree.normal[node, axis]
    return count


@njit(nogil=True, cache=True)
def _view(x, y, z, nx, ny, nz, p0, p1, corners, starts, normals, slack):
    """Unoccluded form factor from a point to the pieces ``p0..p1``."""
    value = 0.0
    for p in range(p0, p1):
        value += max(open_share(x, y, z, nx, ny, nz, corners, starts[p], starts[p + 1], normals, p, slack), 0.0)
    return value


@njit(nogil=True, cache=True)
def _fit(points, count, values, mean, normal, shape):
    """Fit a plane to a function's ``values`` at points of a flat node; what it leaves.

    ``shape`` (4,) gets its slope relative to ``mean``, and a bend of 0.  At least :data:`BENT` of the square of
    what it varies, over its mean, is left: what falls as a power of the distance bends as much, and the points of
    a rule do not see all ways to bend.
    """
    # Two axes of the plane.
    thin = 0
    for axis in range(1, 3):
        if abs(normal[axis]) < abs(normal[thin]):
            thin = axis
    first, second = (thin + 1) % 3, (thin + 2) % 3
    length = math.sqrt(normal[first] ** 2 + normal[second] ** 2)
    e = np.zeros(3)
    e[first], e[second] = -normal[second] / length, normal[first] / length
    g = np.empty(3)
    g[0] = normal[1] * e[2] - normal[2] * e[1]
    g[1] = normal[2] * e[0] - normal[0] * e[2]
    g[2] = normal[0] * e[1] - normal[1] * e[0]
    weight = mu = mv = 0.0
    for k in range(count):
        w = points[k, 3]
        weight += w
        for axis in range(3):
            mu += w * points[k, axis] * e[axis]
            mv += w * points[k, axis] * g[axis]
    mu, mv = mu / weight, mv / weight
    uu = uv = vv = fu = fv = ff = 0.0
    for k in range(count):
        w, u, v = points[k, 3] / weight, -mu, -mv
        for axis in range(3):
            u += points[k, axis] * e[axis]
            v += points[k, axis] * g[axis]
        off = values[k] - mean
        uu, uv, vv = uu + w * u * u, uv + w * u * v, vv + w * v * v
        fu, fv, ff = fu + w * u * off, fv + w * v * off, ff + w * off * off
    shape[:] = 0.0
    det = uu * vv - uv * uv
    if mean <= 0.0 or det <= 1e-9 * uu * vv:
        return math.sqrt(ff)
    su, sv = (fu * vv - fv * uv) / det, (fv * uu - fu * uv) / det
    for axis in range(3):
        shape[axis] = (su * e[axis] + sv * g[axis]) / mean
    left = max(ff - su * fu - sv * fv, 0.0)
    return min(max(math.sqrt(left), BENT * ff / mean), math.sqrt(ff))


@njit(nogil=True, cache=True)
def _flatten(shape, node, tree, breadth):
    """Flatten a shape until it is nowhere negative over its node; by how much."""
    least = 1.0 - max(shape[3], 0.0) * breadth
    square = shape[0] * shape[0] + shape[1] * shape[1] + shape[2] * shape[2]
    if square < (shape[3] * tree.size[node]) ** 2 and shape[3] > 0.0:
        # The lowest place may lie inside.
        least -= 0.25 * square / shape[3]
    p = tree.piece0[node]
    if tree.piece1[node] - p == 1:
        # The lowest place of an edge is a corner, or, of what bends upward, where it is level.
        last = tree.starts[p + 1] - 1
        for i in range(tree.starts[p], tree.starts[p + 1]):
            along = slope = length = 0.0
            for axis in range(3):
                side = tree.corners[i, axis] - tree.corners[last, axis]
                away = tree.corners[last, axis] - tree.centroid[node, axis]
                slope += side * shape[axis]
                along += side * away
                length += side * side
            t = 0.0
            if shape[3] > 0.0 and length > 0.0:
                t = min(max(-(0.5 * slope / shape[3] + along) / length, 0.0), 1.0)
            here = 1.0 - shape[3] * breadth
            for axis in range(3):
                away = tree.corners[last, axis] + t * (tree.corners[i, axis] - tree.corners[last, axis])
                away -= tree.centroid[node, axis]
                here += away * (shape[axis] + shape[3] * away)
            least = min(least, here)
            last = i
    else:
        reach = tree.size[node]
        least = min(least, 1.0 - math.sqrt(square) * reach + min(shape[3], 0.0) * (reach * reach - breadth))
    if least >= 0.0:
        return 0.0
    share = 1.0 / (1.0 - least)
    for row in range(4):
        shape[row] *= share
    return 1.0 - share


@njit(nogil=True, cache=True)
def _views(points, count, own, node, tree, slack, values, shape):
    """Unoccluded form factor from each point of ``own`` to a node: weighted mean, how much it varies, what is left.

    It varies by the standard deviation, or by what the middle of a single quad or triangle is off the mean:
    by symmetry the points of a rule may agree where the middle does not.  The ``shape`` (4,) is its relative
    slope and bend; of the square of the distance from the middle, less its mean, for a bend of 1; the last figure
    is what varies beside that.
    """
    p0, p1 = tree.piece0[node], tree.piece1[node]
    row = tree.sample[node]
    summed = tree.flat[node] == 1 or p1 - p0 <= SUMMED
    total = square = weight = 0.0
    for k in range(count):
        if summed:
            value = _view(
                points[k, 0], points[k, 1], points[k, 2], points[k, 4], points[k, 5], points[k, 6], p0, p1,
                tree.corners, tree.starts, tree.piece_normal, slack,
            )  # fmt: skip
        else:
            value = _sampled_share(
                points[k, 0:3], points[k, 4:7], tree.samples[row], tree.sample_normals[row], tree.area[node]
            )
        values[k] = value
        w = points[k, 3]
        total += w * value
        square += w * value * value
        weight += w
    mean = total / weight
    varies = math.sqrt(max(square / weight - mean * mean, 0.0))
    bends = middle = 0.0
    if summed and tree.sample[own] < 0:
        middle = _view(
            tree.centroid[own, 0], tree.centroid[own, 1], tree.centroid[own, 2], tree.normal[own, 0],
            tree.normal[own, 1], tree.normal[own, 2], p0, p1, tree.corners, tree.starts, tree.piece_normal, slack,
        )  # fmt: skip
        bends = abs(middle - mean)
    left = varies
    if tree.flat[own] == 1:
        left = _fit(points, count, values, mean, tree.normal[own], shape)
        if bends > 0.0 and mean > 0.0:
            shape[3] = (mean - middle) / (mean * _breadth(points, count))
        left = max(left, BENT * bends)
    else:
        shape[:] = 0.0
    return mean, max(varies, bends), left


@njit(nogil=True, cache=True)
def _breadth(points, count):
    """Mean square distance of weighed points from their middle."""
    weight = square = 0.0
    c = np.zeros(3)
    for k in range(count):
        weight += points[k, 3]
        for axis in range(3):
            c[axis] += points[k, 3] * points[k, axis]
    for k in range(count):
        for axis in range(3):
            square += points[k, 3] * (points[k, axis] - c[axis] / weight) ** 2
    return square / weight


@njit(nogil=True, cache=True)
def _ahead(node, other, tree, slack):
    """Whether any part of ``other`` may lie before the plane of a flat node."""
    nx, ny, nz = tree.normal[node, 0], tree.normal[node, 1], tree.normal[node, 2]
    s = tree.starts[tree.piece0[node]]
    d = nx * tree.corners[s, 0] + ny * tree.corners[s, 1] + nz * tree.corners[s, 2] + slack
    if tree.piece1[other] - tree.piece0[other] == 1:
        p = tree.piece0[other]
        for i in range(tree.starts[p], tree.starts[p + 1]):
            if nx * tree.corners[i, 0] + ny * tree.corners[i, 1] + nz * tree.corners[i, 2] > d:
                return True
        return False
    reach = nx * (tree.high[other, 0] if nx > 0.0 else tree.low[other, 0])
    reach += ny * (tree.high[other, 1] if ny > 0.0 else tree.low[other, 1])
    reach += nz * (tree.high[other, 2] if nz > 0.0 else tree.low[other, 2])
    return reach > d


@njit(nogil=True, cache=True)
def _turned_away(node, other, tree):
    """Whether every normal of a cluster points away from all of ``other``."""
    reach = tree.cone[node] + 0.5 * math.pi
    if reach >= math.pi:
        return False
    dx = dy = dz = radius = square = 0.0
    dx = 0.5 * (tree.low[other, 0] + tree.high[other, 0] - tree.low[node, 0] - tree.high[node, 0])
    dy = 0.5 * (tree.low[other, 1] + tree.high[other, 1] - tree.low[node, 1] - tree.high[node, 1])
    dz = 0.5 * (tree.low[other, 2] + tree.high[other, 2] - tree.low[node, 2] - tree.high[node, 2])
    square = dx * dx + dy * dy + dz * dz
    one = two = 0.0
    for axis in range(3):
        side = tree.high[node, axis] - tree.low[node, axis]
        one += side * side
        side = tree.high[other, axis] - tree.low[other, axis]
        two += side * side
    radius = 0.5 * (math.sqrt(one) + math.sqrt(two))
    if square <= radius * radius:
        return False
    distance = math.sqrt(square)
    cosine = (dx * tree.normal[node, 0] + dy * tree.normal[node, 1] + dz * tree.normal[node, 2]) / distance
    return math.acos(min(max(cosine, -1.0), 1.0)) > reach + math.asin(radius / distance) + 1e-9


@njit(nogil=True, cache=True)
def _gap(a, b, tree):
    """Distance of the boxes of two nodes."""
    square = 0.0
    for axis in range(3):
        off = max(tree.low[b, axis] - tree.high[a, axis], tree.low[a, axis] - tree.high[b, axis], 0.0)
        square += off * off
    return math.sqrt(square)


@njit(nogil=True, cache=True)
def _reach(node, other, tree):
    """Distance from the centroid of a node to the box of another."""
    square = 0.0
    for axis in range(3):
        c = tree.centroid[node, axis]
        off = max(tree.low[other, axis] - c, c - tree.high[other, axis], 0.0)
        square += off * off
    return math.sqrt(square)


@njit(nogil=True, cache=True)
def candidates(a, b, tree, geo, given, count, found, planes, tally):
    """Pieces that may come between two flat nodes, from ``given[:count]``; -1 if there are too many.

    With ``count`` below zero all polygons are asked, through the box tree.  The shaft is the hull of
    two single polygons (of the boxes of others), cut by both ends' own planes: what lies behind
    either blocks nothing.  Touching hides a null set, so the planes move inward by a hair.
    """
    pa, pb = tree.piece0[a], tree.piece0[b]
    a0, a1, b0, b1 = tree.starts[pa], tree.starts[pa + 1], tree.starts[pb], tree.starts[pb + 1]
    single = tree.piece1[a] == pa + 1 and tree.piece1[b] == pb + 1
    if single:
        used = hull_shaft(tree.corners, a0, a1, tree.corners, b0, b1, planes)
    else:
        used = box_shaft(tree.low[a], tree.high[a], tree.low[b], tree.high[b], planes)
    used = min(used, planes.shape[0] - 2)
    for end in range(2):
        node, s = (a, a0) if end == 0 else (b, b0)
        d = 0.0
        for axis in range(3):
            planes[used, axis] = tree.normal[node, axis]
            d += tree.normal[node, axis] * tree.corners[s, axis]
        planes[used, 3] = d
        used += 1
    for k in range(used):
        planes[k, 3] += 2.0 * geo.slack
    tally[SHAFT] += 1
    many = count
    if count < 0:
        many = boxes_meeting_planes(
            geo.low, geo.high, geo.skip, geo.first, geo.count, geo.order, geo.bounds, planes, used, geo.slack, found,
            tally,
        )  # fmt: skip
        if many > found.shape[0]:
            return -1
    kept = 0
    for i in range(many):
        piece = found[i] if count < 0 else given[i]
        polygon = geo.piece_polygon[piece]
        if polygon == tree.polygon[a] or polygon == tree.polygon[b]:
            continue
        tally[SHAFT_TEST] += 1
        if outside_planes(geo.corners, geo.piece_start[piece], geo.piece_start[piece + 1], planes, used, geo.slack):
            tally[SHAFT_CULL] += 1
            continue
        # A wall that has both ends in front of it (or both behind) comes between neither.
        if single and _on_one_side(
            geo.normal[piece, 0], geo.normal[piece, 1], geo.normal[piece, 2], geo.offset[piece], tree.corners, a0, a1,
            b0, b1, geo.slack,
        ):  # fmt: skip
            tally[SHAFT_CULL] += 1
            continue
        found[kept] = piece
        kept += 1
    if kept == 0:
        tally[EMPTY] += 1
    return kept


@njit(nogil=True, cache=True)
def _receives_at_a(a, b, area, bright):
    """Whether points on the first end measure visibility: where an error does more harm."""
    return bright[b] * math.sqrt(area[b]) >= bright[a] * math.sqrt(area[a])


NOT_SEEN = 2.0
"""No share: the points from which it was asked do not see the other node."""


@njit(nogil=True, cache=True)
def _share_at(points, count, x, y, tree, geo, found, many, limit, work, values, tally):
    """Visible share of node ``y`` from points on ``x``: the share, the deviation and the mean of the form factor.

    The share is below zero if a point needs rays, and ``NOT_SEEN`` if no point sees the node at all.
    """
    seen = whole = square = weight = 0.0
    for k in range(count):
        value, clear = _point_share(
            points[k, 0], points[k, 1], points[k, 2], points[k, 4], points[k, 5], points[k, 6], tree.polygon[x],
            tree.polygon[y], tree.piece0[y], tree.piece1[y], tree.corners, tree.starts, tree.piece_normal, geo.corners,
            geo.piece_start, geo.piece_polygon, geo.through, geo.slack, found, many, limit, work.planes, work.picked,
            work.boxes, work.sizes, work.weights, work.cut, tally,
        )  # fmt: skip
        if value < 0.0:
            return -1.0, 0.0, 0.0
        values[k] = value
        w = points[k, 3]
        seen += w * value
        whole += w * clear
        square += w * value * value
        weight += w
    mean = seen / weight
    deviation = math.sqrt(max(square / weight - mean * mean, 0.0))
    return (seen / whole if whole > 0.0 else NOT_SEEN), deviation, mean


@njit(nogil=True, cache=True)
def _shadow(x, y, z, c0, c1, corners, nx, ny, nz, slack, ring, count, one, two, middle):
    """Area of the part of a flat ``ring[:count]`` that the piece ``c0..c1`` hides from a point; ``middle`` of it.

    The ring is clipped by the planes through the point and the piece's edges, and by the piece's own plane.
    """
    cx = cy = cz = 0.0
    for i in range(c0, c1):
        cx += corners[i, 0]
        cy += corners[i, 1]
        cz += corners[i, 2]
    cx, cy, cz = cx / (c1 - c0), cy / (c1 - c0), cz / (c1 - c0)
    d = nx * cx + ny * cy + nz * cz
    if nx * x + ny * y + nz * z > d:
        nx, ny, nz, d = -nx, -ny, -nz, -d
    used = clip_by_plane(ring, count, nx, ny, nz, d, slack, one)
    last = c1 - 1
    for i in range(c0, c1):
        if used < 3:
            return 0.0
        ax, ay, az = corners[last, 0] - x, corners[last, 1] - y, corners[last, 2] - z
        bx, by, bz = corners[i, 0] - x, corners[i, 1] - y, corners[i, 2] - z
        last = i
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        if length == 0.0:
            continue
        if nx * (cx - x) + ny * (cy - y) + nz * (cz - z) < 0.0:
            length = -length
        nx, ny, nz = nx / length, ny / length, nz / length
        used = clip_by_plane(one, used, nx, ny, nz, nx * x + ny * y + nz * z, slack, two)
        one, two = two, one
    if used < 3:
        return 0.0
    total = middle[0] = middle[1] = middle[2] = 0.0
    for i in range(1, used - 1):
        ux, uy, uz = one[i, 0] - one[0, 0], one[i, 1] - one[0, 1], one[i, 2] - one[0, 2]
        vx, vy, vz = one[i + 1, 0] - one[0, 0], one[i + 1, 1] - one[0, 1], one[i + 1, 2] - one[0, 2]
        wx, wy, wz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        part = 0.5 * math.sqrt(wx * wx + wy * wy + wz * wz)
        total += part
        for axis in range(3):
            middle[axis] += part * (one[0, axis] + one[i, axis] + one[i + 1, axis]) / 3.0
    if total <= 0.0:
        return 0.0
    for axis in range(3):
        middle[axis] /= total
    return total


@njit(nogil=True, cache=True)
def _hidden(x, y, tree, geo, found, many, rings, middle):
    """How much the view of node ``y`` varies over node ``x`` by shadows, as a share of the open one.

    The outlines of what lies between are projected from the middle of ``y`` onto ``x``: a shadow on a share s
    of it, of the depth d at its middle, is a deviation of d sqrt(s (1 - s)).  It finds what hides between points
    that agree: a thin shadow between lit corners, or a gap between dark ones.
    """
    area = shade = 0.0
    own, other, one, two = rings[0], rings[1], rings[2], rings[3]
    s0, s1 = tree.starts[tree.piece0[x]], tree.starts[tree.piece0[x] + 1]
    t0, t1 = tree.starts[tree.piece0[y]], tree.starts[tree.piece0[y] + 1]
    for axis in range(3):
        for i in range(s0, s1):
            own[i - s0, axis] = tree.corners[i, axis]
        for i in range(t0, t1):
            other[i - t0, axis] = tree.corners[i, axis]
    cx, cy, cz = tree.centroid[y, 0], tree.centroid[y, 1], tree.centroid[y, 2]
    for c in range(many):
        p = found[c]
        c0, c1 = geo.piece_start[p], geo.piece_start[p + 1]
        nx, ny, nz = geo.normal[p, 0], geo.normal[p, 1], geo.normal[p, 2]
        part = _shadow(cx, cy, cz, c0, c1, geo.corners, nx, ny, nz, geo.slack, own, s1 - s0, one, two, middle)
        if part > 0.0:
            depth = _shadow(
                middle[0], middle[1], middle[2], c0, c1, geo.corners, nx, ny, nz, geo.slack, other, t1 - t0, one, two,
                middle,
            )  # fmt: skip
            area += part
            shade += part * min(depth / tree.area[y], 1.0) * (1.0 - geo.through[p])
    if area <= 0.0:
        return 0.0
    share = min(area / tree.area[x], 1.0)
    return shade / area * math.sqrt(share * (1.0 - share))


@njit(nogil=True, cache=True)
def measure(
    first, last, a, b, state, offset, count, pool, bright, tree, geo, limit, exchange, vary_a, vary_b,
    bend_a, bend_b, shape_a, shape_b, doubt, new_count, new_pool, work, tally,
):  # fmt: skip
    """Measure the pairs ``first..last``: exchange area, variation of F over each end, doubt of the exchange.

    F varies over an end by ``vary``, of which the ``shape`` (4,), relative to F, leaves ``bend``.

    ``state``, ``offset``, ``count`` and the variations come from the pair that was split; the list of candidates is
    narrowed into ``new_pool``, of which the used length is returned, and ``new_count`` (-1: too many
    to keep).  Pairs left to rays get their unoccluded exchange area.
    """
    planes = np.empty((40, 4))
    pa, pb = np.empty((NODE_SAMPLES, 7)), np.empty((NODE_SAMPLES, 7))
    va, vb = np.empty(NODE_SAMPLES), np.empty(NODE_SAMPLES)
    sa, sb = np.empty(4), np.empty(4)
    cell = np.empty((4, 3))
    given = np.empty(MAX_CANDIDATES, dtype=np.int64)
    rings, middle = np.empty((4, SHADOW_CORNERS, 3)), np.empty(3)
    position = 0
    for i in range(first, last):
        x, y = a[i], b[i]
        new_count[i] = -1
        exchange[i] = doubt[i] = 0.0
        shape_a[i, :] = 0.0
        shape_b[i, :] = 0.0
        if x == y:
            # A cluster with itself: no more than a cap of a sphere whose normals spread as far.
            bound = 0.5 * (1.0 - math.cos(tree.cone[x]))
            exchange[i] = bound * tree.area[x]
            vary_a[i] = vary_b[i] = bend_a[i] = bend_b[i] = bound
            state[i] = RAYS
            continue
        if tree.area[x] <= 0.0 or tree.area[y] <= 0.0:
            # A piece beside a seam or collinear corners, of no area.
            state[i] = DROPPED
            continue
        flat_a, flat_b = tree.flat[x] == 1, tree.flat[y] == 1
        # A node's plane is exact: what only touches it exchanges nothing.
        if (
            (flat_a and not _ahead(x, y, tree, geo.slack)) or (flat_b and not _ahead(y, x, tree, geo.slack))
            or (not flat_a and _turned_away(x, y, tree)) or (not flat_b and _turned_away(y, x, tree))
        ):  # fmt: skip
            tally[HORIZON] += 1
            state[i] = DROPPED
            continue
        many = 0
        both = flat_a and flat_b
        single = both and tree.piece1[x] - tree.piece0[x] == 1 and tree.piece1[y] - tree.piece0[y] == 1
        if both and state[i] != PART_OF_CLEAR:
            known = count[i]
            for c in range(known):
                given[c] = pool[offset[i] + c]
            many = candidates(x, y, tree, geo, given, known, work.found, planes, tally)
            if (
                many > 0 and single
                and _group_is_dark(
                    geo.corners, geo.piece_start, geo.through, work.found, many, tree.corners,
                    tree.starts[tree.piece0[x]], tree.starts[tree.piece0[x] + 1], tree.starts[tree.piece0[y]],
                    tree.starts[tree.piece0[y] + 1], geo.slack,
                )
            ):  # fmt: skip
                tally[DARK] += 1
                state[i] = DROPPED
                continue
        tally[LINK] += 1
        tally[CLOSED] += 1
        na = node_points(x, tree, cell, pa)
        nb = node_points(y, tree, cell, pb)
        from_a, std_a, bent_a = _views(pa, na, x, y, tree, geo.slack, va, sa)
        from_b, std_b, bent_b = _views(pb, nb, y, x, tree, geo.slack, vb, sb)
        one, two = from_a * tree.area[x], from_b * tree.area[y]
        off = abs(one - two)
        # The rule whose values agree better among themselves is the better one; what the two rules
        # differ by is the other's.
        at_a = std_a * from_b <= std_b * from_a
        if at_a:
            value, off_a, off_b = one, 0.0, off
            doubt[i] = 0.5 * min(off, std_a * std_a * tree.area[x] / max(from_a, 1e-300))
            ratio = tree.size[x] / max(_reach(x, y, tree), 1e-3 * tree.size[x])
        else:
            value, off_a, off_b = two, off, 0.0
            doubt[i] = 0.5 * min(off, std_b * std_b * tree.area[y] / max(from_b, 1e-300))
            ratio = tree.size[y] / max(_reach(y, x, tree), 1e-3 * tree.size[y])
        # The error of a Gauss rule falls with the fourth power of size over distance.
        doubt[i] = max(doubt[i], value * min(0.05 * ratio * ratio * ratio * ratio, 0.3))
        # Rays tell a share alone, and are never finished.
        agree = AGREE if 0 <= many <= CUTS else AGREE_RAYS
        apart = both and min(one, two) < agree * max(one, two)
        if apart or (both and min(one, two) <= 0.0):
            # Close by, where the points of one end, or of both, pass the other by; or a sliver above a horizon.
            value = 0.0
            for p in range(tree.piece0[x], tree.piece1[x]):
                for q in range(tree.piece0[y], tree.piece1[y]):
                    value += pair_exchange(
                        tree.corners, tree.starts[p], tree.starts[p + 1], tree.piece_normal[p], tree.corners,
                        tree.starts[q], tree.starts[q + 1], tree.piece_normal[q],
                        CLOSED_ERROR * max(one, two) + 1e-15 * tree.area[x], work.pair,
                    )  # fmt: skip
            off_a, off_b = abs(one - value), abs(two - value)
            at_a = off_a <= off_b
            doubt[i] = CLOSED_ERROR * value
            if min(one, two) <= 0.0:
                std_a, bent_a = max(std_a, value / tree.area[x]), max(bent_a, value / tree.area[x])
                std_b, bent_b = max(std_b, value / tree.area[y]), max(bent_b, value / tree.area[y])
                off_a = off_b = doubt[i] = 0.0
        exchange[i] = value
        open_a, open_b = value / tree.area[x], value / tree.area[y]
        open_vary_a, open_vary_b = max(std_a, 0.5 * off_a / tree.area[x]), max(std_b, 0.5 * off_b / tree.area[y])
        open_bend_a, open_bend_b = max(bent_a, 0.5 * off_a / tree.area[x]), max(bent_b, 0.5 * off_b / tree.area[y])
        wide_a, wide_b = _breadth(pa, na), _breadth(pb, nb)
        open_bend_a = max(open_bend_a, _flatten(sa, x, tree, wide_a) * open_vary_a)
        open_bend_b = max(open_bend_b, _flatten(sb, y, tree, wide_b) * open_vary_b)
        vary_a[i], vary_b[i] = open_vary_a, open_vary_b
        bend_a[i], bend_b[i] = open_bend_a, open_bend_b
        for row in range(4):
            shape_a[i, row], shape_b[i, row] = sa[row], sb[row]
        if not both:
            gap = _gap(x, y, tree)
            extent = max(0.0 if flat_a else tree.size[x], 0.0 if flat_b else tree.size[y])
            if gap < 0.5 * extent:
                # Too near for samples to tell: anything from nothing to a full view may arrive.
                high = math.pi * gap * gap
                vary_a[i] = 0.5 if high <= tree.area[y] else 0.5 * tree.area[y] / high
                vary_b[i] = 0.5 if high <= tree.area[x] else 0.5 * tree.area[x] / high
                bend_a[i], bend_b[i] = vary_a[i], vary_b[i]
                shape_a[i, :] = 0.0
                shape_b[i, :] = 0.0
                state[i] = NEAR
            elif value == 0.0:
                state[i] = DROPPED
                continue
            else:
                state[i] = RAYS
            tally[COMPLEX] += 1
            continue
        if value <= 0.0:
            state[i] = DROPPED
            continue
        if many == 0:
            state[i] = CLEAR
            new_count[i] = 0
            tally[TALLY_CLEAR] += 1
            continue
        if 0 < many <= KEPT:
            for c in range(many):
                new_pool[position + c] = work.found[c]
            position += many
            new_count[i] = many
        if 0 < many <= CUTS:
            if not apart:
                at_a = _receives_at_a(x, y, tree.area, bright)
            share, seen = NOT_SEEN, 0.0
            for _ in range(2):
                if at_a:
                    share, deviation, seen = _share_at(
                        pa, na, x, y, tree, geo, work.found, many, limit, work, va, tally
                    )  # fmt: skip
                else:
                    share, deviation, seen = _share_at(
                        pb, nb, y, x, tree, geo, work.found, many, limit, work, vb, tally
                    )  # fmt: skip
                if share != NOT_SEEN:
                    break
                at_a = not at_a  # only a sliver lies above this end's horizon: the other end sees it
            if share == NOT_SEEN:
                # Slivers both ways: half of it, in doubt as a whole.
                share = 0.5
                deviation = open_a if at_a else open_b
            if share >= 0.0:
                share = min(share, 1.0)
                exchange[i] = value * share
                own, other = (open_a, open_b) if at_a else (open_b, open_a)
                area = tree.area[x] if at_a else tree.area[y]
                if single:
                    hidden_a = _hidden(x, y, tree, geo, work.found, many, rings, middle)
                    hidden_b = _hidden(y, x, tree, geo, work.found, many, rings, middle)
                else:
                    hidden_a = hidden_b = 0.0
                deviation = max(deviation, own * (hidden_a if at_a else hidden_b))
                state[i] = CUT
                doubt[i] = doubt[i] * share + 0.35 * deviation * area
                if share == 0.0:
                    # Dark at all points: what they miss is all there may be.
                    doubt[i] = value
                # The other end's visibility is taken to vary as much, relative to its form factor.
                spread = max(other * deviation / own, other * (hidden_b if at_a else hidden_a))
                if at_a:
                    bent = own * share
                    if seen > 0.0:
                        bend = sa[3]
                        bent = _fit(pa, na, va, seen, tree.normal[x], sa)
                        sa[3] = bend
                    vary_a[i], bend_a[i] = deviation, max(bent, EDGE * deviation)
                    vary_b[i], bend_b[i] = max(open_vary_b * share, spread), max(open_bend_b * share, spread)
                else:
                    bent = own * share
                    if seen > 0.0:
                        bend = sb[3]
                        bent = _fit(pb, nb, vb, seen, tree.normal[y], sb)
                        sb[3] = bend
                    vary_b[i], bend_b[i] = deviation, max(bent, EDGE * deviation)
                    vary_a[i], bend_a[i] = max(open_vary_a * share, spread), max(open_bend_a * share, spread)
                bend_a[i] = max(bend_a[i], _flatten(sa, x, tree, wide_a) * vary_a[i])
                bend_b[i] = max(bend_b[i], _flatten(sb, y, tree, wide_b) * vary_b[i])
                for row in range(4):
                    shape_a[i, row], shape_b[i, row] = sa[row], sb[row]
                continue
        state[i] = RAYS
        tally[COMPLEX] += 1
    return position


@njit(nogil=True, cache=True)
def pair_rays(
    pairs, counts, a, b, seed, tree, offset, centre, scale, starts, origins, directions, weights
):  # fmt: skip
    """Rays between random points of the two ends of each pair, in Embree's unit frame.

    Each carries the weight cos cos / r^2, bounded below the distance at which the ray's own share of
    the area would fill the view; pairs of points that do not face each other get no ray.
    Returns the number of rays; those of pair ``i`` are ``starts[i]:starts[i + 1]``.
    """
    p, q = np.empty(3), np.empty(3)
    # Generalised golden ratio in four dimensions (M. Roberts 2018).
    g = 1.1673039782614187
    row = 0
    for i in range(pairs.shape[0]):
        starts[i] = row
        x, y = a[pairs[i]], b[pairs[i]]
        h = stream(x, y, seed)
        s1 = np.float64(h & np.uint64(0xFFFF)) / 65536.0
        s2 = np.float64((h >> np.uint64(16)) & np.uint64(0xFFFF)) / 65536.0
        s3 = np.float64((h >> np.uint64(32)) & np.uint64(0xFFFF)) / 65536.0
        s4 = np.float64((h >> np.uint64(48)) & np.uint64(0xFFFF)) / 65536.0
        soft = min(tree.area[x], tree.area[y]) / (math.pi * counts[i])
        for k in range(counts[i]):
            t = k + 0.5
            own = place_on_node(x, tree, (s1 + t / g) % 1.0, (s2 + t / g**2) % 1.0, p)
            other = place_on_node(y, tree, (s3 + t / g**3) % 1.0, (s4 + t / g**4) % 1.0, q)
            n, m = tree.piece_normal[own], tree.piece_normal[other]
            dx, dy, dz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
            cx = dx * n[0] + dy * n[1] + dz * n[2]
            cy = -(dx * m[0] + dy * m[1] + dz * m[2])
            if cx <= 0.0 or cy <= 0.0:
                continue
            square = dx * dx + dy * dy + dz * dz
            weights[row] = cx * cy / (square * max(square, soft))
            sx, sy, sz = p[0] + offset * n[0], p[1] + offset * n[1], p[2] + offset * n[2]
            origins[row, 0] = (sx - centre[0]) * scale
            origins[row, 1] = (sy - centre[1]) * scale
            origins[row, 2] = (sz - centre[2]) * scale
            directions[row, 0] = (q[0] + offset * m[0] - sx) * scale
            directions[row, 1] = (q[1] + offset * m[1] - sy) * scale
            directions[row, 2] = (q[2] + offset * m[2] - sz) * scale
            row += 1
    starts[pairs.shape[0]] = row
    return row


@njit(nogil=True, cache=True)
def apply_rays(
    pairs, counts, a, b, whole, starts, weights, blocked, area, flat, exchange, vary_a, vary_b, bend_a, bend_b, doubt
):
    """Scale the unoccluded exchange areas ``whole`` of pairs by what their rays saw.

    Of clusters the rays tell the whole, too: the few samples that else stand for one miss what is near, and made rooms
    with furniture 1 % too dark.
    """
    for i in range(pairs.shape[0]):
        k = pairs[i]
        x, y = a[k], b[k]
        total = seen = square = 0.0
        for r in range(starts[i], starts[i + 1]):
            w = weights[r]
            total += w
            square += w * w
            if blocked[r] != 0:
                seen += w
        value = whole[i]
        if flat[x] == 0 or flat[y] == 0:
            value = min(area[x] * area[y] * total / (math.pi * counts[i]), area[x], area[y])
        if total <= 0.0:
            # No points of the two faced each other: a grazing glance at most, past occluders.  Dark rather than
            # a leak; in doubt whole.
            exchange[k] = 0.0
            doubt[k] = value if x != y else 0.0
            continue
        share = seen / total
        effective = total * total / square
        # Two pseudo-rays, one of each kind, so that agreeing rays still leave a doubt.
        safe = (share * effective + 1.0) / (effective + 2.0)
        exchange[k] = value * share
        # By the larger of both wholes: more rays for those alone that found much would leave too little on average.
        doubt[k] = max(value, whole[i]) * math.sqrt(safe * (1.0 - safe) / (effective + 2.0))
        partly = math.sqrt(share * (1.0 - share))
        seen = max(share, 1.0 / effective)
        one, two = 0.5 * value / area[x] * partly, 0.5 * value / area[y] * partly
        vary_a[k], bend_a[k] = max(vary_a[k] * seen, one), max(bend_a[k] * seen, one)
        vary_b[k], bend_b[k] = max(vary_b[k] * seen, two), max(bend_b[k] * seen, two)


@njit(nogil=True, cache=True)
def _contrast(sender, receiver, bright, uneven, received):
    """What a form factor that is off by itself alone puts in the wrong place, per unit of it.

    Where rows are balanced (``received`` is positive) it takes from all others what it adds: only what the
    sender is brighter or darker than they are counts.
    """
    if received[receiver] <= 0.0:
        return bright[sender]
    off = bright[sender] - received[receiver]
    return math.sqrt(off * off + uneven[sender] * uneven[sender])


@njit(nogil=True, cache=True)
def link_errors(
    a, b, vary_a, vary_b, bend_a, bend_b, doubt, area, shaped, bright, uneven, received, node_area, over, under, unsure,
    linear,
):  # fmt: skip
    """Errors of all links by receiving node: sums of squares (``linear`` 0) or of magnitudes (1).

    ``over`` and ``under`` are those over receivers and over senders, see :func:`judge`; ``unsure`` those of the
    form factors, of either sign, always squares.
    """
    for i in range(a.shape[0]):
        x, y = a[i], b[i]
        if node_area[x] <= 0.0 or node_area[y] <= 0.0:
            continue
        for end in range(2):
            one = _contrast(y, x, bright, uneven, received)
            if end == 0:
                own = bend_a[i] if shaped[x] else vary_a[i]
                far = bend_b[i]
            else:
                own = bend_b[i] if shaped[x] else vary_b[i]
                far = bend_a[i]
            own, far = one * own, uneven[y] * far * area[y] / area[x]
            off = one * doubt[i] / area[x]
            over[x] += own if linear else own * own
            under[x] += far if linear else far * far
            unsure[x] += off * off
            if x == y:
                break
            x, y = y, x


@njit(nogil=True, cache=True)
def judge(
    a, b, vary_a, vary_b, bend_a, bend_b, state, area, flat, size, shaped, bright, uneven, received, detail, bias,
    weight, share, can_split, error, verdict, need,
):  # fmt: skip
    """What to do with each pair: 0 keep, 1 split the first end, 2 the second.

    An end that receives has two errors: the form factor varies over it (``detail``: splitting it resolves
    that; over what is ``shaped`` only what the shape leaves counts), and radiosity and form factor both
    bend over the end that sends (``bias``: splitting the sender resolves that).  Errors of the links to one receiver
    add up, so with the sums T of all of them the mean square error over all surfaces is the sum over links of
    ``error * T * A / total``, and the root of each link's term is what is held below ``error``.
    ``share`` holds ``sqrt(A / total)``, ``weight`` that times what a receiver's own detail matters;
    ``bright`` and ``uneven`` the mean and the deviation of each node's radiosity, and ``received`` its irradiance
    where rows are balanced, in units of the mean irradiance.  What is uneven counts :data:`UNEVEN` times: it is of
    one sign (near corners both the form factor and the radiosity are large) and shifts means.
    """
    for i in range(a.shape[0]):
        verdict[i] = 0
        need[i] = 0.0
        if state[i] <= 0:
            continue
        x, y = a[i], b[i]
        own_a = _contrast(y, x, bright, uneven, received) * (bend_a[i] if shaped[x] else vary_a[i])
        own_b = _contrast(x, y, bright, uneven, received) * (bend_b[i] if shaped[y] else vary_b[i])
        far_a = UNEVEN * uneven[y] * bend_b[i] * area[y] / area[x]
        far_b = UNEVEN * uneven[x] * bend_a[i] * area[x] / area[y]
        need_a = max(
            math.sqrt(own_a * max(own_a, detail[x])) * weight[x], math.sqrt(far_b * max(far_b, bias[y])) * share[y]
        )  # fmt: skip
        need_b = max(
            math.sqrt(own_b * max(own_b, detail[y])) * weight[y], math.sqrt(far_a * max(far_a, bias[x])) * share[x]
        )  # fmt: skip
        need[i] = max(need_a, need_b)
        if need[i] <= error:
            continue
        if state[i] == NEAR:
            # Only parts of the cluster, the larger of two, can tell more.
            verdict[i] = 1 if flat[y] == 1 or (flat[x] == 0 and size[x] >= size[y]) else 2
            continue
        if need_a >= need_b:
            if can_split[x]:
                verdict[i] = 1
            elif need_b > error and can_split[y]:
                verdict[i] = 2
        elif can_split[y]:
            verdict[i] = 2
        elif need_a > error and can_split[x]:
            verdict[i] = 1


@njit(nogil=True, cache=True)
def tolerances(pairs, a, b, exchange, area, bright, uneven, received, weight, relative, floor, allowed):
    """Error of the exchange area that each pair may keep: ``relative`` if positive, else by ``floor``.

    ``floor`` bounds the error of the irradiance, weighed as in :func:`judge`.
    """
    for i in range(pairs.shape[0]):
        k = pairs[i]
        x, y = a[k], b[k]
        if relative > 0.0:
            allowed[i] = relative * exchange[k]
            continue
        one = _contrast(y, x, bright, uneven, received) * weight[x]
        two = _contrast(x, y, bright, uneven, received) * weight[y]
        allowed[i] = math.inf
        if one > 0.0:
            allowed[i] = floor * area[x] / one
        if two > 0.0:
            allowed[i] = min(allowed[i], floor * area[y] / two)


@njit(nogil=True, cache=True)
def finish(
    first, last, pairs, allowed, a, b, state, offset, count, pool, bright, tree, geo, limit, levels, exchange, doubt,
    work, tally,
):  # fmt: skip
    """Bring the exchange areas of kept pairs to their allowed errors: closed forms, and cells cut exactly."""
    given = np.empty(MAX_CANDIDATES, dtype=np.int64)
    for i in range(first, last):
        k = pairs[i]
        # What is dark at a few points is looked at once: it is off to one side only, and many add up.
        dark = exchange[k] == 0.0 and doubt[k] > 0.0
        if (doubt[k] <= allowed[i] and not dark) or (state[k] != CLEAR and state[k] != CUT):
            continue
        x, y = a[k], b[k]
        value = 0.0
        tally[CLOSED] += 1
        for p in range(tree.piece0[x], tree.piece1[x]):
            for q in range(tree.piece0[y], tree.piece1[y]):
                value += pair_exchange(
                    tree.corners, tree.starts[p], tree.starts[p + 1], tree.piece_normal[p], tree.corners,
                    tree.starts[q], tree.starts[q + 1], tree.piece_normal[q],
                    0.3 * allowed[i] + 1e-15 * tree.area[x], work.pair,
                )  # fmt: skip
        if state[k] == CLEAR:
            exchange[k] = value
            doubt[k] = 0.1 * allowed[i]
            continue
        many = count[k]
        for c in range(many):
            given[c] = pool[offset[k] + c]
        if not _receives_at_a(x, y, tree.area, bright):
            x, y = y, x
        found, whole, local, error = _element_integral(
            tree.corners, tree.starts, tree.piece0[x], tree.piece1[x], tree.normal[x, 0], tree.normal[x, 1],
            tree.normal[x, 2], tree.polygon[x], tree.polygon[y], tree.piece0[y], tree.piece1[y], tree.corners,
            tree.starts, tree.piece_normal, geo.corners, geo.piece_start, geo.piece_polygon, geo.through, geo.slack,
            given, many, limit, allowed[i], levels, work.cells, work.state, work.points, work.planes, work.picked,
            work.boxes, work.sizes, work.weights, work.cut, tally,
        )  # fmt: skip
        if found < 0.0 or whole <= 0.0 or value <= 0.0 or abs(value - whole) > 0.25 * value:
            # Too many pieces, or most of what is seen lies where no point does: rays find it.
            exchange[k] = value
            state[k] = RAYS
            continue
        # The open factor is known better than by these points; what they miss of it is as visible as
        # the cells where they miss most.
        missed = value - whole
        exchange[k] = min(max(found + missed * local, 0.0), value)
        doubt[k] = error + 0.25 * abs(missed) * (1.0 - abs(2.0 * local - 1.0))
