"""Gathering in closed form, as kernels: every element from every point, cut exactly by what hides it."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from radiosity.form_factors._links import NEEDS_RAYS, _child, _first_cell, _point_share, open_share
from workbench.accel.box_tree import boxes_meeting_planes
from workbench.culling.plane_vertex import light_pyramid, outside_planes
from workbench.culling.tally import CHECK, CLEAR, CLOSED, CULL, HORIZON
from workbench.shadow._settle import exact_points
from workbench.shadow.area import MAX_CORNERS, MAX_PIECES

MOST_CANDIDATES = 64
"""Longest candidate list of one point and one polygon; beyond it each piece asks the tree."""
PARTLY, WHOLLY = 0.3, 0.1
"""Share of a cell's contrast by which its mean may be off where only part of it is seen; where all is
seen, times (extent / distance)^2 (measured)."""
DEEPEST = 5
"""Most quarterings of a cell."""


@njit(nogil=True, cache=True)
def _add(linear, element, x, y, z, share, out):
    """Add a share of an element's radiosity, read at (x, y, z)."""
    for band in range(out.shape[0]):
        value = (
            linear[element, band, 0] * x + linear[element, band, 1] * y + linear[element, band, 2] * z
            + linear[element, band, 3]
        )  # fmt: skip
        out[band] += share * max(value, 0.0)


@njit(nogil=True, cache=True)
def _toward_the_weight(x, y, z, nx, ny, nz, mx, my, mz, cell, corners, extent, centre):
    """Move the ``centre`` (3,) of a cell to the mean place of what it sends to (x, y, z).

    The cell's covariance times the gradient of log(cos cos / r^4) at its centre: to first order the
    centroid by the kernel, at which a linear radiosity must be read.
    """
    dx, dy, dz = centre[0] - x, centre[1] - y, centre[2] - z
    square = dx * dx + dy * dy + dz * dz
    # Cells across a horizon have no smooth kernel: cosines are held off zero.
    above = max(nx * dx + ny * dy + nz * dz, 0.25 * extent)
    back = min(mx * dx + my * dy + mz * dz, -0.25 * extent)
    gx = nx / above + mx / back - 4.0 * dx / square
    gy = ny / above + my / back - 4.0 * dy / square
    gz = nz / above + mz / back - 4.0 * dz / square
    sx = sy = sz = 0.0
    for c in range(corners if corners == 3 else 2):
        d = c + 1 if c + 1 < corners else 0
        ex, ey, ez = cell[d, 0] - cell[c, 0], cell[d, 1] - cell[c, 1], cell[d, 2] - cell[c, 2]
        along = (ex * gx + ey * gy + ez * gz) / (36.0 if corners == 3 else 12.0)
        sx, sy, sz = sx + along * ex, sy + along * ey, sz + along * ez
    length = math.sqrt(sx * sx + sy * sy + sz * sz)
    share = min(1.0, 0.4 * extent / length) if length > 0.0 else 0.0
    centre[0] += share * sx
    centre[1] += share * sy
    centre[2] += share * sz


@njit(nogil=True, cache=True)
def exact_gather(
    points, normals, own, rows, groups, rings, group_polygon, group_normal, group_pieces, group_start, mesh_corners,
    mesh_starts, mesh_normals, piece_element, linear, sloped, corners, starts, piece_polygon, through, low, high, skip,
    head, leaf, order, bounds, slack, limit, allowed, out, doubt, tally,
):  # fmt: skip
    """Irradiance of points ``rows`` by the pieces of the groups' elements, in closed form.

    A group is one side of a polygon: ``rings`` (g, 4, 3) a rectangle round it, ``group_pieces`` its
    pieces by ``group_start``.  The light pyramid to the rectangle finds what may hide any of them.
    ``linear`` is as in ``collect_hits``; elements in ``sloped`` are quartered where one place of a cell
    may stand for it by more than ``allowed`` (bands,) badly.
    ``out`` and ``doubt`` (points, bands) get irradiance and what crowded cuts leave open of it.
    """
    planes = np.empty((2 * MAX_CORNERS + 6, 4))
    found = np.empty(MOST_CANDIDATES, dtype=np.int64)
    picked = np.empty(MOST_CANDIDATES, dtype=np.int64)
    boxes = np.empty((2, MAX_PIECES, MAX_CORNERS, 3))
    sizes = np.zeros((2, MAX_PIECES), dtype=np.int64)
    weights = np.empty((2, MAX_PIECES))
    cut = np.empty((4, MAX_CORNERS, 3))
    cells = np.empty((3 * DEEPEST + 5, 4, 3))
    parent = np.empty((4, 3))
    depth = np.empty(3 * DEEPEST + 5, dtype=np.int64)
    cell_start = np.array([0, 4])
    cell_normal = np.empty((1, 3))
    one, share_of, doubt_of = np.empty(1, dtype=np.int64), np.zeros(points.shape[0]), np.zeros(points.shape[0])
    ring_start = np.array([0, 4])
    centre = np.empty(3)
    for row in range(rows.shape[0]):
        i = rows[row]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        for which in range(groups.shape[0]):
            g = groups[which]
            ring = rings[g]
            mx, my, mz = group_normal[g, 0], group_normal[g, 1], group_normal[g, 2]
            if mx * (x - ring[0, 0]) + my * (y - ring[0, 1]) + mz * (z - ring[0, 2]) <= slack:
                tally[HORIZON] += 1
                continue
            above = False
            for c in range(4):
                if nx * (ring[c, 0] - x) + ny * (ring[c, 1] - y) + nz * (ring[c, 2] - z) > 0.0:
                    above = True
                    break
            if not above:
                tally[HORIZON] += 1
                continue
            other = group_polygon[g]
            used = light_pyramid(
                x, y, z, nx, ny, nz, ring, ring_start[0], ring_start[1], group_normal[g], 2.0 * slack, planes
            )
            many = boxes_meeting_planes(low, high, skip, head, leaf, order, bounds, planes, used, slack, found, tally)
            count = -1
            if many <= MOST_CANDIDATES:
                count = 0
                for c in range(many):
                    piece = found[c]
                    if piece_polygon[piece] == own[i] or piece_polygon[piece] == other:
                        continue
                    tally[CHECK] += 1
                    if outside_planes(corners, starts[piece], starts[piece + 1], planes, used, slack):
                        tally[CULL] += 1
                        continue
                    found[count] = piece
                    count += 1
            for place in range(group_start[g], group_start[g + 1]):
                p = group_pieces[place]
                a, b = mesh_starts[p], mesh_starts[p + 1]
                element = piece_element[p]
                for k in range(1 if not sloped[element] or b - a == 4 else b - a - 2):
                    quad = True
                    top = -1
                    if sloped[element]:
                        quad = _first_cell(mesh_corners, a, b, k, cells[0])
                        depth[0], top = 0, 0
                    whole = extent = away = 0.0
                    n = 0
                    while True:
                        # A whole piece, or the cell on the top of the stack.
                        cx = cy = cz = 0.0
                        if top < 0:
                            for c in range(a, b):
                                cx += mesh_corners[c, 0] / (b - a)
                                cy += mesh_corners[c, 1] / (b - a)
                                cz += mesh_corners[c, 2] / (b - a)
                        else:
                            n = 4 if quad else 3
                            extent = 0.0
                            for c in range(n):
                                cx += cells[top, c, 0] / n
                                cy += cells[top, c, 1] / n
                                cz += cells[top, c, 2] / n
                            for axis in range(3):
                                extent = max(
                                    extent, abs(cells[top, 2, axis] - cells[top, 0, axis]),
                                    abs(cells[top, 3 if quad else 1, axis] - cells[top, 1 if quad else 0, axis]),
                                )  # fmt: skip
                            away = math.sqrt((cx - x) ** 2 + (cy - y) ** 2 + (cz - z) ** 2)
                            centre[0], centre[1], centre[2] = cx, cy, cz
                            _toward_the_weight(x, y, z, nx, ny, nz, mx, my, mz, cells[top], n, extent, centre)
                            cx, cy, cz = centre[0], centre[1], centre[2]
                        if count == 0:
                            tally[CLOSED] += 1
                            tally[CLEAR] += 1
                            if top < 0:
                                share = open_share(x, y, z, nx, ny, nz, mesh_corners, a, b, mesh_normals, p, slack)
                            else:
                                cell_normal[0] = group_normal[g]
                                share = open_share(
                                    x, y, z, nx, ny, nz, cells[top], 0, 4 if quad else 3, cell_normal, 0, slack
                                )
                            share = max(share, 0.0)
                            whole = share
                        elif count > 0 and top < 0:
                            share, whole = _point_share(
                                x, y, z, nx, ny, nz, own[i], other, p, p + 1, mesh_corners, mesh_starts, mesh_normals,
                                corners, starts, piece_polygon, through, slack, found, count, limit, planes, picked,
                                boxes, sizes, weights, cut, tally,
                            )  # fmt: skip
                        elif count > 0:
                            cell_normal[0] = group_normal[g]
                            cell_start[1] = 4 if quad else 3
                            share, whole = _point_share(
                                x, y, z, nx, ny, nz, own[i], other, 0, 1, cells[top], cell_start, cell_normal,
                                corners, starts, piece_polygon, through, slack, found, count, limit, planes, picked,
                                boxes, sizes, weights, cut, tally,
                            )  # fmt: skip
                        else:
                            share = NEEDS_RAYS
                        if top >= 0 and whole > 0.0 and share != 0.0 and depth[top] < DEEPEST:
                            lowest = math.inf
                            for c in range(n):
                                lowest = min(
                                    lowest,
                                    nx * (cells[top, c, 0] - x) + ny * (cells[top, c, 1] - y)
                                    + nz * (cells[top, c, 2] - z),
                                )  # fmt: skip
                            off = whole * extent
                            if share < 0.999 * whole or lowest < 0.0:
                                off *= PARTLY
                            else:
                                off *= min(WHOLLY * (extent / away) ** 2, PARTLY)
                            rough = False
                            for band in range(allowed.shape[0]):
                                slope = math.sqrt(
                                    linear[element, band, 0] ** 2 + linear[element, band, 1] ** 2
                                    + linear[element, band, 2] ** 2
                                )  # fmt: skip
                                rough = rough or off * slope > allowed[band]
                            if rough:
                                level = depth[top]
                                for c in range(4):
                                    for axis in range(3):
                                        parent[c, axis] = cells[top, c, axis]
                                for q in range(4):
                                    _child(parent, quad, q, cells[top + q])
                                    depth[top + q] = level + 1
                                top += 3
                                continue
                        if share < 0.0:
                            one[0] = i
                            if top < 0:
                                exact_points(
                                    one, points, normals, own, mesh_corners, a, b, group_normal[g], other, corners,
                                    starts, piece_polygon, through, low, high, skip, head, leaf, order, bounds, slack,
                                    share_of, doubt_of, tally,
                                )  # fmt: skip
                            else:
                                exact_points(
                                    one, points, normals, own, cells[top], 0, 4 if quad else 3, group_normal[g], other,
                                    corners, starts, piece_polygon, through, low, high, skip, head, leaf, order,
                                    bounds, slack, share_of, doubt_of, tally,
                                )  # fmt: skip
                            share = max(share_of[i], 0.0)
                            if doubt_of[i] > 0.0:
                                _add(linear, element, cx, cy, cz, doubt_of[i], doubt[i])
                        if share > 0.0:
                            _add(linear, element, cx, cy, cz, share, out[i])
                        top -= 1
                        if top < 0:
                            break
