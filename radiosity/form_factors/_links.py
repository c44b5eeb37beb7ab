"""Form factors from elements to one patch, as kernels: settle, cut, or leave to rays.

For each group of receivers (the elements of one patch): facing and horizon, then a shaft to the
sender whose surviving candidates go down to the elements, then at each point the light pyramid.
No candidate left: closed form.  A few: the sender is cut exactly.  Many: the element is flagged
and rays scale its closed form (:mod:`radiosity.form_factors.bundle`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from radiosity.form_factors._sampling import place_on_pieces
from radiosity.form_factors.analytic import pair_exchange
from radiosity.patches import PatchMesh
from workbench.accel.box_tree import BoxTree, boxes_meeting_planes
from workbench.culling.plane_vertex import light_pyramid, outside_planes
from workbench.culling.shaft import MAX_SHAFT_PLANES, box_shaft
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
    LINK,
    OVERFLOW,
    PIECES,
    SHAFT,
    SHAFT_CULL,
    SHAFT_TEST,
)
from workbench.geometry.flat import Geometry
from workbench.geometry.lambert import lambert_piece
from workbench.geometry.planes import newell_normal
from workbench.shadow.area import MAX_CORNERS, MAX_PIECES, visible_share

SAMPLES = 16
"""Samples that stand for a cluster of facets from afar."""
POINTS = 4
"""Points at which a cluster of facets receives."""
CLUSTER_FAR = 2.0
"""Distance, in extents of a cluster, beyond which its samples stand for it."""
MAX_CELLS = 131072
"""Cells of one element after which halving ends, whatever the wanted error: the doubt is stated."""
MAX_CANDIDATES = 192
"""Longest candidate list handed down to a group; beyond it each point asks the tree itself."""

NEEDS_RAYS = -1.0

_GAUSS = 0.5 / math.sqrt(3.0)


class OccluderArrays(NamedTuple):
    """What the kernels read of a geometry and its box tree."""

    corners: np.ndarray
    piece_start: np.ndarray
    piece_polygon: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    bounds: np.ndarray
    through: np.ndarray
    low: np.ndarray
    high: np.ndarray
    skip: np.ndarray
    first: np.ndarray
    count: np.ndarray
    order: np.ndarray
    slack: float


class MeshArrays(NamedTuple):
    """What the kernels read of a patch mesh."""

    corners: np.ndarray
    piece_start: np.ndarray
    element_piece: np.ndarray
    piece_normal: np.ndarray
    normal: np.ndarray
    area: np.ndarray
    centroid: np.ndarray
    size: np.ndarray
    polygon: np.ndarray
    patch_start: np.ndarray
    sender_corners: np.ndarray
    sender_start: np.ndarray
    sender_normal: np.ndarray
    patch_sender: np.ndarray
    patch_polygon: np.ndarray
    patch_bounds: np.ndarray
    patch_normal: np.ndarray
    patch_area: np.ndarray
    element_bounds: np.ndarray
    samples: np.ndarray
    sample_normals: np.ndarray
    points: np.ndarray
    point_normals: np.ndarray


class Workspace(NamedTuple):
    """Scratch of one thread."""

    planes: np.ndarray
    shaft: np.ndarray
    found: np.ndarray
    near: np.ndarray
    box: np.ndarray
    picked: np.ndarray
    boxes: np.ndarray
    sizes: np.ndarray
    weights: np.ndarray
    cut: np.ndarray
    pair: np.ndarray
    cells: np.ndarray
    points: np.ndarray
    state: np.ndarray


def occluder_arrays(geometry: Geometry, tree: BoxTree) -> OccluderArrays:
    """Gather the arrays of a geometry for the kernels."""
    return OccluderArrays(
        geometry.corners,
        geometry.piece_start,
        geometry.piece_polygon,
        geometry.piece_normal,
        np.einsum("ij,ij->i", geometry.piece_normal, geometry.corners[geometry.piece_start[:-1]]),
        geometry.piece_bounds,
        np.ascontiguousarray(geometry.polygon_transmittance[geometry.piece_polygon]),
        tree.low,
        tree.high,
        tree.skip,
        tree.first,
        tree.count,
        tree.order,
        geometry.slack,
    )


def _cluster_samples(
    corners: np.ndarray,
    starts: np.ndarray,
    normals: np.ndarray,
    owner: np.ndarray,
    areas: np.ndarray,
    polygon: np.ndarray,
    count: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (n, count, 3) that stand for equal parts of each cluster's area.

    ``owner`` (n + 1,) gives the pieces of each; flat ones (``polygon`` not -1) stay zero.
    """
    points = np.zeros((len(areas), count, 3))
    directions = np.zeros_like(points)
    for i in np.flatnonzero(polygon < 0).tolist():
        for k in range(count):
            u, v = (k + 0.5) / count, (k * 0.6180339887498949 + 0.5) % 1.0
            piece = place_on_pieces(corners, starts, owner[i], owner[i + 1], areas[i], u, v, points[i, k])
            directions[i, k] = normals[piece]
    return points, directions


def mesh_arrays(mesh: PatchMesh) -> MeshArrays:
    """Gather the arrays of a mesh for the kernels."""
    return MeshArrays(
        mesh.corners,
        mesh.piece_start,
        mesh.element_piece,
        mesh.piece_normal,
        mesh.element_normal,
        mesh.element_area,
        mesh.element_centroid,
        mesh.element_size,
        mesh.element_polygon,
        mesh.patch_start,
        mesh.sender_corners,
        mesh.sender_start,
        mesh.sender_normal,
        mesh.patch_sender,
        mesh.patch_polygon,
        mesh.patch_bounds,
        mesh.patch_normal,
        mesh.patch_area,
        mesh.element_bounds,
        *_cluster_samples(
            mesh.sender_corners,
            mesh.sender_start,
            mesh.sender_normal,
            mesh.patch_sender,
            mesh.patch_area,
            mesh.patch_polygon,
            SAMPLES,
        ),
        *_cluster_samples(
            mesh.corners,
            mesh.piece_start,
            mesh.piece_normal,
            mesh.element_piece,
            mesh.element_area,
            mesh.element_polygon,
            POINTS,
        ),
    )


def workspace(max_corners: int) -> Workspace:
    """Scratch arrays for one thread; ``max_corners`` is the longest sender or element ring."""
    room = max(MAX_CORNERS, 2 * max_corners + 4)
    return Workspace(
        planes=np.empty((room + 2, 4)),
        shaft=np.empty((MAX_SHAFT_PLANES, 4)),
        found=np.empty(MAX_CANDIDATES, dtype=np.int64),
        near=np.empty(MAX_CANDIDATES, dtype=np.int64),
        box=np.empty((2, 3)),
        picked=np.empty(MAX_CANDIDATES, dtype=np.int64),
        boxes=np.empty((2, MAX_PIECES, MAX_CORNERS, 3)),
        sizes=np.zeros((2, MAX_PIECES), dtype=np.int64),
        weights=np.empty((2, MAX_PIECES)),
        cut=np.empty((4, MAX_CORNERS, 3)),
        pair=np.empty((4, room, 3)),
        cells=np.empty((80, 4, 3)),
        points=np.empty((4, 4)),
        state=np.empty((80, 5)),
    )


@njit(nogil=True, cache=True)
def open_share(x, y, z, nx, ny, nz, corners, s0, s1, normals, s, slack):
    """Lambert's formula for one sender piece; 0 from behind or in its plane."""
    mx, my, mz = normals[s, 0], normals[s, 1], normals[s, 2]
    height = mx * (x - corners[s0, 0]) + my * (y - corners[s0, 1]) + mz * (z - corners[s0, 2])
    if height <= 1e-3 * slack:
        return 0.0
    return lambert_piece(x, y, z, nx, ny, nz, corners, s0, s1)


@njit(nogil=True, cache=True)
def _pick(candidates, many, own, other, piece_polygon, corners, starts, planes, used, slack, limit, picked, tally):
    """Candidates that cross the pyramid, at most ``limit + 1``; own polygons are out by identity."""
    kept = 0
    for c in range(many):
        piece = candidates[c]
        if piece_polygon[piece] == own or piece_polygon[piece] == other:
            continue
        tally[CHECK] += 1
        if outside_planes(corners, starts[piece], starts[piece + 1], planes, used, slack):
            tally[CULL] += 1
            continue
        picked[kept] = piece
        kept += 1
        if kept > limit:
            break
    return kept


@njit(nogil=True, cache=True)
def _point_share(
    x, y, z, nx, ny, nz, own, other, t0, t1, sender_corners, sender_start, sender_normal, corners, starts,
    piece_polygon, through, slack, found, count, limit, planes, picked, boxes, sizes, weights, cut, tally,
):  # fmt: skip
    """Visible and open form factor from a point to the sender pieces ``t0..t1``.

    The visible one is ``NEEDS_RAYS`` if too many candidates remain.
    ``found[:count]`` are the group's candidates, of which at most ``limit`` may cross the pyramid.
    The arrays come one by one: handing on tuples of arrays costs more than the work done here.
    """
    total = whole = 0.0
    for s in range(t0, t1):
        s0, s1 = sender_start[s], sender_start[s + 1]
        share = open_share(x, y, z, nx, ny, nz, sender_corners, s0, s1, sender_normal, s, slack)
        if share <= 0.0:
            continue
        tally[CLOSED] += 1
        whole += share
        used = light_pyramid(x, y, z, nx, ny, nz, sender_corners, s0, s1, sender_normal[s], 2.0 * slack, planes)
        kept = _pick(
            found, count, own, other, piece_polygon, corners, starts, planes, used, slack, limit, picked, tally
        )  # fmt: skip
        if kept == 0:
            tally[CLEAR] += 1
            total += share
            continue
        pieces = -1
        visible = 0.0
        if kept <= limit:
            visible, pieces = visible_share(
                x, y, z, nx, ny, nz, sender_corners, s0, s1, sender_normal[s], corners, starts, through, picked, kept,
                boxes, sizes, weights, cut,
            )  # fmt: skip
            tally[CUT] += 1
            if pieces < 0:
                tally[OVERFLOW] += 1
        if pieces < 0:
            tally[COMPLEX] += 1
            return NEEDS_RAYS, whole
        tally[PIECES] += pieces
        if pieces == 0:
            tally[DARK] += 1
        total += min(visible, share)
    return total, whole


@njit(nogil=True, cache=True)
def _cell_points(cell, quad, out):
    """Rows (x, y, z, weight) of a quad's 2 x 2 Gauss rule or a triangle's 3-point rule; their number."""
    if quad:
        for k in range(4):
            u = 0.5 + (_GAUSS if k & 1 else -_GAUSS)
            v = 0.5 + (_GAUSS if k & 2 else -_GAUSS)
            w0, w1, w2, w3 = (1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v
            for axis in range(3):
                out[k, axis] = w0 * cell[0, axis] + w1 * cell[1, axis] + w2 * cell[2, axis] + w3 * cell[3, axis]
            ax = (1 - v) * (cell[1, 0] - cell[0, 0]) + v * (cell[2, 0] - cell[3, 0])
            ay = (1 - v) * (cell[1, 1] - cell[0, 1]) + v * (cell[2, 1] - cell[3, 1])
            az = (1 - v) * (cell[1, 2] - cell[0, 2]) + v * (cell[2, 2] - cell[3, 2])
            bx = (1 - u) * (cell[3, 0] - cell[0, 0]) + u * (cell[2, 0] - cell[1, 0])
            by = (1 - u) * (cell[3, 1] - cell[0, 1]) + u * (cell[2, 1] - cell[1, 1])
            bz = (1 - u) * (cell[3, 2] - cell[0, 2]) + u * (cell[2, 2] - cell[1, 2])
            jx, jy, jz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            out[k, 3] = 0.25 * math.sqrt(jx * jx + jy * jy + jz * jz)
        return 4
    ax, ay, az = cell[1, 0] - cell[0, 0], cell[1, 1] - cell[0, 1], cell[1, 2] - cell[0, 2]
    bx, by, bz = cell[2, 0] - cell[0, 0], cell[2, 1] - cell[0, 1], cell[2, 2] - cell[0, 2]
    jx, jy, jz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    area = 0.5 * math.sqrt(jx * jx + jy * jy + jz * jz)
    for k in range(3):
        u = 2.0 / 3.0 if k == 1 else 1.0 / 6.0
        v = 2.0 / 3.0 if k == 2 else 1.0 / 6.0
        out[k, 0] = cell[0, 0] + u * ax + v * bx
        out[k, 1] = cell[0, 1] + u * ay + v * by
        out[k, 2] = cell[0, 2] + u * az + v * bz
        out[k, 3] = area / 3.0
    return 3


@njit(nogil=True, cache=True)
def _cell_integral(
    cell, quad, nx, ny, nz, own, other, t0, t1, sender_corners, sender_start, sender_normal, corners, starts,
    piece_polygon, through, slack, found, count, limit, points, planes, picked, boxes, sizes, weights, cut, tally,
):  # fmt: skip
    """Integrals of the visible and the open form factor over a cell; least and most visible share.

    The visible integral is ``NEEDS_RAYS`` if a point needs them.
    """
    total = whole = 0.0
    least, most = math.inf, 0.0
    for k in range(_cell_points(cell, quad, points)):
        share, clear = _point_share(
            points[k, 0], points[k, 1], points[k, 2], nx, ny, nz, own, other, t0, t1, sender_corners, sender_start,
            sender_normal, corners, starts, piece_polygon, through, slack, found, count, limit, planes, picked, boxes,
            sizes, weights, cut, tally,
        )  # fmt: skip
        if share < 0.0:
            return NEEDS_RAYS, 0.0, 0.0, 0.0
        total += points[k, 3] * share
        whole += points[k, 3] * clear
        least, most = min(least, share), max(most, share)
    return total, whole, least, most


@njit(nogil=True, cache=True)
def _child(cell, quad, k, out):
    """Quarter ``k`` of a cell."""
    if quad:
        for axis in range(3):
            a, b, c, d = cell[0, axis], cell[1, axis], cell[2, axis], cell[3, axis]
            ab, bc, cd, da = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + d), 0.5 * (d + a)
            m = 0.25 * (a + b + c + d)
            if k == 0:
                out[0, axis], out[1, axis], out[2, axis], out[3, axis] = a, ab, m, da
            elif k == 1:
                out[0, axis], out[1, axis], out[2, axis], out[3, axis] = ab, b, bc, m
            elif k == 2:
                out[0, axis], out[1, axis], out[2, axis], out[3, axis] = m, bc, c, cd
            else:
                out[0, axis], out[1, axis], out[2, axis], out[3, axis] = da, m, cd, d
        return
    for axis in range(3):
        a, b, c = cell[0, axis], cell[1, axis], cell[2, axis]
        ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
        if k == 0:
            out[0, axis], out[1, axis], out[2, axis] = a, ab, ca
        elif k == 1:
            out[0, axis], out[1, axis], out[2, axis] = ab, b, bc
        elif k == 2:
            out[0, axis], out[1, axis], out[2, axis] = ca, bc, c
        else:
            out[0, axis], out[1, axis], out[2, axis] = ab, bc, ca


@njit(nogil=True, cache=True)
def _cell_area(cell, quad):
    """Area of a planar cell."""
    x, y, z = newell_normal(cell, 0, 4 if quad else 3)
    return math.sqrt(x * x + y * y + z * z)


@njit(nogil=True, cache=True)
def _first_cell(corners, a, b, k, out):
    """Cell ``k`` of a convex ring: the quad itself, or triangle ``k`` of its fan."""
    if b - a == 4:
        for i in range(4):
            for axis in range(3):
                out[i, axis] = corners[a + i, axis]
        return True
    for axis in range(3):
        out[0, axis] = corners[a, axis]
        out[1, axis] = corners[a + k + 1, axis]
        out[2, axis] = corners[a + k + 2, axis]
        out[3, axis] = corners[a, axis]
    return False


@njit(nogil=True, cache=True)
def _element_integral(
    ring_corners, ring_start, p0, p1, nx, ny, nz, own, other, t0, t1, sender_corners, sender_start, sender_normal,
    corners, starts, piece_polygon, through, slack, found, count, limit, tolerance, levels, cells, state, points,
    planes, picked, boxes, sizes, weights, cut, tally,
):  # fmt: skip
    """Integral of the point form factor over an element, halving cells until ``tolerance`` is met.

    ``tolerance`` is absolute, on the integral; ``levels`` bounds the halvings.  Each cell is
    compared with its four quarters.  Returns the integrals of the visible and of the open form
    factor by the same points, the visible share where the open one was found worst (a mean over the
    cells, weighted by what quartering changed of it), and an error estimate of the first, which is
    ``NEEDS_RAYS`` if some point has too many candidates.
    """
    total = whole = error = worst = worst_seen = 0.0
    parent = cells[79]
    for piece in range(p0, p1):
        a, b = ring_start[piece], ring_start[piece + 1]
        fans = 1 if b - a == 4 else b - a - 2
        for k in range(fans):
            quad = _first_cell(ring_corners, a, b, k, cells[0])
            value, open_value, _, _ = _cell_integral(
                cells[0], quad, nx, ny, nz, own, other, t0, t1, sender_corners, sender_start, sender_normal, corners,
                starts, piece_polygon, through, slack, found, count, limit, points, planes, picked, boxes, sizes,
                weights, cut, tally,
            )  # fmt: skip
            if value < 0.0:
                return NEEDS_RAYS, 0.0, 0.0, 0.0
            if levels == 0:
                total += value
                whole += open_value
                continue
            # Row of state: value, tolerance, level, whether the cell lies beside a contrast.
            # Last, its open integral.
            state[0, 0], state[0, 1], state[0, 2], state[0, 3] = value, tolerance / fans, 0.0, 0.0
            state[0, 4] = open_value
            top = 0
            cells_made = 0
            while top >= 0:
                cells_made += 1
                value, allowed, level = state[top, 0], state[top, 1], state[top, 2]
                beside, open_value = state[top, 3] > 0.0, state[top, 4]
                # The cell's own row becomes its last quarter, so quarters are made from a copy.
                for i in range(4):
                    for axis in range(3):
                        parent[i, axis] = cells[top, i, axis]
                quarters = clear = most = 0.0
                least = math.inf
                for q in range(4):
                    _child(parent, quad, q, cells[top + q])
                    part, part_clear, low, high = _cell_integral(
                        cells[top + q], quad, nx, ny, nz, own, other, t0, t1, sender_corners, sender_start,
                        sender_normal, corners, starts, piece_polygon, through, slack, found, count, limit, points,
                        planes, picked, boxes, sizes, weights, cut, tally,
                    )  # fmt: skip
                    if part < 0.0:
                        return NEEDS_RAYS, 0.0, 0.0, 0.0
                    state[top + q, 0], state[top + q, 4] = part, part_clear
                    quarters += part
                    clear += part_clear
                    least, most = min(least, low), max(most, high)
                if beside or (value == 0.0 and quarters == 0.0):
                    # The cell may hide an edge along its rim: it is all dark (the umbra of a convex
                    # occluder is convex, so a lit sliver shows at a corner), or lies beside a contrast.
                    for c in range(4 if quad else 3):
                        for axis in range(3):
                            middle = 0.25 * (parent[0, axis] + parent[1, axis] + parent[2, axis] + parent[3, axis])
                            if not quad:
                                middle = (parent[0, axis] + parent[1, axis] + parent[2, axis]) / 3.0
                            points[0, axis] = parent[c, axis] + 1e-6 * (middle - parent[c, axis])
                        seen, _ = _point_share(
                            points[0, 0], points[0, 1], points[0, 2], nx, ny, nz, own, other, t0, t1, sender_corners,
                            sender_start, sender_normal, corners, starts, piece_polygon, through, slack, found, count,
                            limit, planes, picked, boxes, sizes, weights, cut, tally,
                        )  # fmt: skip
                        if seen < 0.0:
                            return NEEDS_RAYS, 0.0, 0.0, 0.0
                        least, most = min(least, seen), max(most, seen)
                difference = abs(quarters - value)
                contrast = most - least > 0.5 * most
                if contrast:
                    # A shadow edge lies between these points, and a rule and its quarters can place it
                    # alike and wrongly: by an eighth of the cell, say.
                    difference += 0.5 * (most - least) * _cell_area(parent, quad)
                if difference <= 4.0 * allowed or level + 1.0 >= levels or cells_made > MAX_CELLS:
                    total += quarters
                    whole += clear
                    if clear > 0.0:
                        change = abs(clear - open_value)
                        worst += change
                        worst_seen += change * (quarters / clear)
                    # Halving a smooth cell once more would take three quarters off, an edge's far less.
                    error += difference if contrast else 0.25 * difference
                    top -= 1
                else:
                    for q in range(4):
                        state[top + q, 1], state[top + q, 2] = 0.5 * allowed, level + 1.0
                        state[top + q, 3] = 1.0 if contrast else 0.0
                    top += 3
    share = worst_seen / worst if worst > 0.0 else (total / whole if whole > 0.0 else 0.0)
    return total, whole, share, error


@njit(nogil=True, cache=True)
def _clear_rule(
    corners, starts, p0, p1, normals, element, sender_corners, sender_start, sender_normal, t0, t1, slack, levels,
    cells, points,
):  # fmt: skip
    """Integral over an element of the unoccluded form factor to sender pieces ``t0..t1``.

    One rule a cell, on the whole element (``levels`` 0) or on its quarters (1).
    """
    nx, ny, nz = normals[element, 0], normals[element, 1], normals[element, 2]
    total = 0.0
    for piece in range(p0, p1):
        a, b = starts[piece], starts[piece + 1]
        for k in range(1 if b - a == 4 else b - a - 2):
            quad = _first_cell(corners, a, b, k, cells[0])
            for q in range(4 if levels else 1):
                if levels:
                    _child(cells[0], quad, q, cells[1])
                for i in range(_cell_points(cells[levels], quad, points)):
                    x, y, z = points[i, 0], points[i, 1], points[i, 2]
                    for s in range(t0, t1):
                        total += points[i, 3] * max(
                            open_share(
                                x, y, z, nx, ny, nz, sender_corners, sender_start[s], sender_start[s + 1],
                                sender_normal, s, slack,
                            ),
                            0.0,
                        )  # fmt: skip
    return total


@njit(nogil=True, cache=True)
def patch_extent(bounds, patch):
    """Longest side of a patch's box."""
    longest = 0.0
    for axis in range(3):
        longest = max(longest, bounds[patch, 1, axis] - bounds[patch, 0, axis])
    return longest


@njit(nogil=True, cache=True)
def _sampled_share(x, n, samples, sample_normals, patch_area):
    """Form factor from a point to a far cluster, by its samples.

    Each stands for an equal part of the area, as a disk (Wallace, Elmquist and Haines 1989, eq. 7).
    """
    count = samples.shape[0]
    part = patch_area / count
    total = 0.0
    for k in range(count):
        square = facing = backing = 0.0
        for axis in range(3):
            d = samples[k, axis] - x[axis]
            square += d * d
            facing += d * n[axis]
            backing -= d * sample_normals[k, axis]
        if facing > 0.0 and backing > 0.0:
            total += facing * backing * part / (square * (math.pi * square + part))
    return total


@njit(nogil=True, cache=True)
def _reverse_integral(
    corners, starts, p0, p1, normals, sender_corners, sender_start, sender_normal, t0, t1, samples, sample_normals,
    patch_area, far, slack,
):  # fmt: skip
    """Integral of the form factor over a large element, as seen from a cluster's points.

    From each sample of a far cluster, from each facet's centre of a near one, Lambert's formula over
    the element; reciprocity makes the sum the exchange area.
    """
    total = 0.0
    count = samples.shape[0] if far else t1 - t0
    for k in range(count):
        x = y = z = 0.0
        if far:
            part = patch_area / count
            x, y, z = samples[k, 0], samples[k, 1], samples[k, 2]
            nx, ny, nz = sample_normals[k, 0], sample_normals[k, 1], sample_normals[k, 2]
        else:
            s0, s1 = sender_start[t0 + k], sender_start[t0 + k + 1]
            for i in range(s0, s1):
                x += sender_corners[i, 0] / (s1 - s0)
                y += sender_corners[i, 1] / (s1 - s0)
                z += sender_corners[i, 2] / (s1 - s0)
            nx, ny, nz = sender_normal[t0 + k, 0], sender_normal[t0 + k, 1], sender_normal[t0 + k, 2]
            vx, vy, vz = newell_normal(sender_corners, s0, s1)
            part = math.sqrt(vx * vx + vy * vy + vz * vz)
        for piece in range(p0, p1):
            a, b = starts[piece], starts[piece + 1]
            total += part * max(open_share(x, y, z, nx, ny, nz, corners, a, b, normals, piece, slack), 0.0)
    return total


@njit(nogil=True, cache=True)
def _on_one_side(nx, ny, nz, d, rings, p0, p1, q0, q1, slack):
    """Whether two polygons of ``rings`` lie on the same side of a plane, touching it at most."""
    lowest, highest = math.inf, -math.inf
    for i in range(p0, p1):
        off = nx * rings[i, 0] + ny * rings[i, 1] + nz * rings[i, 2] - d
        lowest = min(lowest, off)
        highest = max(highest, off)
    for i in range(q0, q1):
        off = nx * rings[i, 0] + ny * rings[i, 1] + nz * rings[i, 2] - d
        lowest = min(lowest, off)
        highest = max(highest, off)
    return lowest >= -slack or highest <= slack


@njit(nogil=True, cache=True, inline="always")
def _shaft_candidates(box, flat, normal, corner, own, group, patch, geo, mesh, found, work, tally):
    """Pieces that may come between a box of receivers and a patch; -1 if there are too many.

    ``normal`` and ``corner`` give the plane of ``flat`` receivers, ``own`` their polygon, ``group`` the
    patch to which they belong.
    """
    used = box_shaft(box[0], box[1], mesh.patch_bounds[patch, 0], mesh.patch_bounds[patch, 1], work.shaft)
    flat_sender = mesh.patch_polygon[patch] >= 0
    # A polygon behind or in the plane of either end blocks nothing between them.
    if flat:
        work.shaft[used, 0], work.shaft[used, 1], work.shaft[used, 2] = normal[0], normal[1], normal[2]
        work.shaft[used, 3] = normal[0] * corner[0] + normal[1] * corner[1] + normal[2] * corner[2]
        used += 1
    if flat_sender:
        n = mesh.patch_normal[patch]
        c = mesh.sender_corners[mesh.sender_start[mesh.patch_sender[patch]]]
        work.shaft[used, 0], work.shaft[used, 1], work.shaft[used, 2] = n[0], n[1], n[2]
        work.shaft[used, 3] = n[0] * c[0] + n[1] * c[1] + n[2] * c[2]
        used += 1
    # A polygon that only touches the shaft from outside (the floor between two walls) meets a
    # null set of segments: areas are integrated here, so the planes move inward by a hair.
    for k in range(used):
        work.shaft[k, 3] += 2.0 * geo.slack
    many = boxes_meeting_planes(
        geo.low, geo.high, geo.skip, geo.first, geo.count, geo.order, geo.bounds,
        work.shaft, used, geo.slack, found, tally,
    )  # fmt: skip
    kept = -1
    if many <= MAX_CANDIDATES:
        kept = 0
        for i in range(many):
            piece = found[i]
            polygon = geo.piece_polygon[piece]
            if (flat and polygon == own) or (flat_sender and polygon == mesh.patch_polygon[patch]):
                continue
            tally[SHAFT_TEST] += 1
            if outside_planes(
                geo.corners, geo.piece_start[piece], geo.piece_start[piece + 1], work.shaft, used, geo.slack
            ):
                tally[SHAFT_CULL] += 1
                continue
            # A wall that has both ends in front of it (or both behind) comes between neither.
            if flat and flat_sender and _on_one_side(
                geo.normal[piece, 0], geo.normal[piece, 1], geo.normal[piece, 2], geo.offset[piece],
                mesh.sender_corners, mesh.sender_start[mesh.patch_sender[group]],
                mesh.sender_start[mesh.patch_sender[group + 1]], mesh.sender_start[mesh.patch_sender[patch]],
                mesh.sender_start[mesh.patch_sender[patch + 1]], geo.slack,
            ):  # fmt: skip
                tally[SHAFT_CULL] += 1
                continue
            found[kept] = piece
            kept += 1
    return kept


@njit(nogil=True, cache=True, inline="always")
def _clear_factor(element, patch, gap, flat, flat_sender, geo, mesh, error, floor, closed_forms, work, tally):
    """Unoccluded form factor from an element to a patch, and the estimate of its error.

    Far pairs: the element's 2 x 2 rule, whose error falls with the fourth power of size over
    distance; nearer: 4 x 4; near and touching pairs (all, with ``closed_forms``): the closed form.
    A cluster of facets is a set of samples from afar, the sum over its facets from nearby; a flat
    element too large for that is integrated the other way round, from the cluster's points.  A
    cluster receives at its own samples.
    """
    area, size = mesh.area[element], mesh.size[element]
    reach = (0.05 / error) ** 0.25 * size
    value = doubt = 0.0
    tally[CLOSED] += 1
    closed = flat and flat_sender and (closed_forms or gap < 0.5 * reach)
    extent = 0.0 if flat_sender else patch_extent(mesh.patch_bounds, patch)
    far = not flat_sender and gap > CLUSTER_FAR * extent
    if flat and not flat_sender and size > 0.5 * gap and size > 0.5 * extent:
        value = _reverse_integral(
            mesh.corners, mesh.piece_start, mesh.element_piece[element], mesh.element_piece[element + 1],
            mesh.piece_normal, mesh.sender_corners, mesh.sender_start, mesh.sender_normal, mesh.patch_sender[patch],
            mesh.patch_sender[patch + 1], mesh.samples[patch], mesh.sample_normals[patch], mesh.patch_area[patch],
            far, geo.slack,
        )  # fmt: skip
        doubt = 0.05 * value
    elif far and flat:
        value = area * _sampled_share(
            mesh.centroid[element], mesh.normal[element], mesh.samples[patch], mesh.sample_normals[patch],
            mesh.patch_area[patch],
        )  # fmt: skip
        doubt = 0.05 * value
    elif not flat:
        for k in range(POINTS):
            x, n = mesh.points[element, k], mesh.point_normals[element, k]
            if far:
                value += _sampled_share(x, n, mesh.samples[patch], mesh.sample_normals[patch], mesh.patch_area[patch])
                continue
            for s in range(mesh.patch_sender[patch], mesh.patch_sender[patch + 1]):
                value += max(
                    open_share(
                        x[0], x[1], x[2], n[0], n[1], n[2], mesh.sender_corners, mesh.sender_start[s],
                        mesh.sender_start[s + 1], mesh.sender_normal, s, geo.slack,
                    ),
                    0.0,
                )  # fmt: skip
        value *= area / POINTS
        doubt = 0.1 * value
    elif not (closed and closed_forms):
        levels = 0 if closed or not flat_sender or gap >= reach else 1
        value = _clear_rule(
            mesh.corners, mesh.piece_start, mesh.element_piece[element], mesh.element_piece[element + 1], mesh.normal,
            element, mesh.sender_corners, mesh.sender_start, mesh.sender_normal, mesh.patch_sender[patch],
            mesh.patch_sender[patch + 1], geo.slack, levels, work.cells, work.points,
        )  # fmt: skip
        ratio = size / max(gap, 1e-3 * size) / (1.0 + levels)
        doubt = value * min(0.05 * ratio * ratio * ratio * ratio, 1.0)
    if closed:
        tolerance = 0.1 * (error * value + floor * area) + 1e-15 * area
        value = doubt = 0.0
        for piece in range(mesh.element_piece[element], mesh.element_piece[element + 1]):
            for s in range(mesh.patch_sender[patch], mesh.patch_sender[patch + 1]):
                value += pair_exchange(
                    mesh.corners, mesh.piece_start[piece], mesh.piece_start[piece + 1], mesh.normal[element],
                    mesh.sender_corners, mesh.sender_start[s], mesh.sender_start[s + 1], mesh.sender_normal[s],
                    tolerance, work.pair,
                )  # fmt: skip
    return value / area, doubt / area


@njit(nogil=True, cache=True)
def box_distance(centroid, element, bounds, patch):
    """Distance from an element's centroid to the box round a patch."""
    square = 0.0
    for axis in range(3):
        value = centroid[element, axis]
        low, high = bounds[patch, 0, axis], bounds[patch, 1, axis]
        off = max(low - value, 0.0, value - high)
        square += off * off
    return math.sqrt(square)


@njit(nogil=True, cache=True)
def _group_faces(q, patch, mesh, slack):
    """Whether a flat group and a flat patch have points in front of each other's planes."""
    n = mesh.patch_normal[q]
    first = mesh.sender_start[mesh.patch_sender[q]]
    d = 0.0
    for axis in range(3):
        d += n[axis] * mesh.sender_corners[first, axis]
    in_front = False
    for i in range(mesh.sender_start[mesh.patch_sender[patch]], mesh.sender_start[mesh.patch_sender[patch + 1]]):
        c = mesh.sender_corners[i]
        if n[0] * c[0] + n[1] * c[1] + n[2] * c[2] > d + slack:
            in_front = True
            break
    return in_front


@njit(nogil=True, cache=True)
def _blocks_all(corners, a, b, ring_p, p0, p1, ring_q, q0, q1, slack):
    """Whether one convex piece meets every segment between two convex polygons.

    It is enough that it separates them and meets every segment between their corners: seen
    through the piece's plane, the crossing of any segment is a convex combination of those.
    """
    vx, vy, vz = newell_normal(corners, a, b)
    length = math.sqrt(vx * vx + vy * vy + vz * vz)
    if length == 0.0:
        return False
    nx, ny, nz = vx / length, vy / length, vz / length
    d = nx * corners[a, 0] + ny * corners[a, 1] + nz * corners[a, 2]
    side = 0.0
    for i in range(p0, p1):
        off = nx * ring_p[i, 0] + ny * ring_p[i, 1] + nz * ring_p[i, 2] - d
        if abs(off) <= slack or off * side < 0.0:
            return False
        side = off
    for j in range(q0, q1):
        off = nx * ring_q[j, 0] + ny * ring_q[j, 1] + nz * ring_q[j, 2] - d
        if abs(off) <= slack or off * side > 0.0:
            return False
    for i in range(p0, p1):
        px, py, pz = ring_p[i, 0], ring_p[i, 1], ring_p[i, 2]
        dp = abs(nx * px + ny * py + nz * pz - d)
        for j in range(q0, q1):
            qx, qy, qz = ring_q[j, 0], ring_q[j, 1], ring_q[j, 2]
            t = dp / (dp + abs(nx * qx + ny * qy + nz * qz - d))
            x, y, z = px + t * (qx - px), py + t * (qy - py), pz + t * (qz - pz)
            for k in range(a, b):
                m = k + 1 if k + 1 < b else a
                ex, ey, ez = corners[m, 0] - corners[k, 0], corners[m, 1] - corners[k, 1], corners[m, 2] - corners[k, 2]
                wx, wy, wz = x - corners[k, 0], y - corners[k, 1], z - corners[k, 2]
                turn = (ey * wz - ez * wy) * nx + (ez * wx - ex * wz) * ny + (ex * wy - ey * wx) * nz
                if turn < 0.0:
                    return False
    return True


@njit(nogil=True, cache=True)
def _group_is_dark(geo_corners, starts, through, found, count, rings, p0, p1, q0, q1, slack):
    """Whether some opaque candidate alone hides one convex polygon of ``rings`` from another."""
    for i in range(count):
        piece = found[i]
        if through[piece] == 0.0 and _blocks_all(
            geo_corners, starts[piece], starts[piece + 1], rings, p0, p1, rings, q0, q1, slack
        ):
            return True
    return False


@njit(nogil=True, cache=True)
def shoot(
    patch, first, last, geo, mesh, limit, error, floor, levels, closed_forms, factor, spread, rays, work, tally
):  # fmt: skip
    """Form factors from the elements of the groups ``first..last`` to one patch.

    ``factor[e]`` gets the area-averaged form factor from element ``e`` to the patch, ``spread[e]`` the
    estimate of its quadrature error.  Where rays must decide, ``factor[e]`` is the *unoccluded* form
    factor and ``rays[e]`` is set.  The wanted error of a form factor F is ``error * F + floor``;
    ``closed_forms`` asks for the closed form of every unoccluded pair, not only of near ones.
    """
    flat_sender = mesh.patch_polygon[patch] >= 0
    for q in range(first, last):
        e0, e1 = mesh.patch_start[q], mesh.patch_start[q + 1]
        flat = mesh.patch_polygon[q] >= 0
        if q == patch and flat:
            continue
        if (flat and not _group_faces(q, patch, mesh, geo.slack)) or (
            flat_sender and not _group_faces(patch, q, mesh, geo.slack)
        ):
            tally[HORIZON] += e1 - e0
            continue
        # Shaft from the group to the patch; its candidates serve every element of the group.
        count = _shaft_candidates(
            mesh.patch_bounds[q], flat, mesh.patch_normal[q],
            mesh.sender_corners[mesh.sender_start[mesh.patch_sender[q]]], mesh.polygon[e0],
            q, patch, geo, mesh, work.found, work, tally,
        )  # fmt: skip
        tally[SHAFT] += 1
        if count == 0:
            tally[EMPTY] += 1
        if count > 0:
            # Both ends one convex polygon: one occluder may settle the whole group.
            u, v = mesh.patch_sender[q], mesh.patch_sender[patch]
            if (
                flat and flat_sender
                and mesh.patch_sender[q + 1] == u + 1 and mesh.patch_sender[patch + 1] == v + 1
                and _group_is_dark(
                    geo.corners, geo.piece_start, geo.through, work.found, count, mesh.sender_corners,
                    mesh.sender_start[u], mesh.sender_start[u + 1], mesh.sender_start[v], mesh.sender_start[v + 1],
                    geo.slack,
                )
            ):  # fmt: skip
                tally[DARK] += e1 - e0
                continue
        for e in range(e0, e1):
            gap = box_distance(mesh.centroid, e, mesh.patch_bounds, patch)
            area = mesh.area[e]
            open_factor, open_doubt = _clear_factor(
                e, patch, gap, flat, flat_sender, geo, mesh, error, floor, closed_forms, work, tally
            )
            if open_factor <= 0.0:
                tally[HORIZON] += 1
                continue
            tally[LINK] += 1
            if count == 0:
                factor[e] = open_factor
                spread[e] = open_doubt
                continue
            candidates, many = work.found, count
            if not (flat and flat_sender):
                # Facets of a cluster are candidates of its own shaft: rays see best which of them block.
                factor[e] = open_factor
                rays[e] = True
                tally[COMPLEX] += 1
                continue
            if count < 0 or count > 2 * limit:
                # Long list: the shaft of this element alone may be empty, or short enough to cut.
                for axis in range(3):
                    work.box[0, axis] = mesh.element_bounds[e, 0, axis]
                    work.box[1, axis] = mesh.element_bounds[e, 1, axis]
                many = _shaft_candidates(
                    work.box, True, mesh.normal[e], mesh.corners[mesh.piece_start[mesh.element_piece[e]]],
                    mesh.polygon[e], q, patch, geo, mesh, work.near, work, tally,
                )  # fmt: skip
                tally[SHAFT] += 1
                candidates = work.near
                if many == 0:
                    tally[EMPTY] += 1
                    factor[e] = open_factor
                    spread[e] = open_doubt
                    continue
                if many < 0 or many > 4 * limit:
                    factor[e] = open_factor
                    rays[e] = True
                    tally[COMPLEX] += 1
                    continue
            allowed = (error * open_factor + floor) * area
            depth = levels
            if open_factor < floor:
                depth = 0  # too faint to be worth a second look
            value, whole, local, doubt = _element_integral(
                mesh.corners, mesh.piece_start, mesh.element_piece[e], mesh.element_piece[e + 1], mesh.normal[e, 0],
                mesh.normal[e, 1], mesh.normal[e, 2], mesh.polygon[e], mesh.patch_polygon[patch],
                mesh.patch_sender[patch], mesh.patch_sender[patch + 1], mesh.sender_corners, mesh.sender_start,
                mesh.sender_normal, geo.corners, geo.piece_start, geo.piece_polygon, geo.through, geo.slack,
                candidates, many, limit, allowed, depth, work.cells, work.state, work.points, work.planes, work.picked,
                work.boxes, work.sizes, work.weights, work.cut, tally,
            )  # fmt: skip
            if value < 0.0 or whole <= 0.0:
                factor[e] = open_factor
                rays[e] = True
                continue
            # The open factor is known better than by these points.  What they miss of it (along an edge
            # that both polygons touch, say) is as visible as the cells where they miss most.
            missed = open_factor * area - whole
            if abs(missed) > 0.25 * open_factor * area:
                # Most of what is seen lies where no point does (planes that cross): rays find it.
                factor[e] = open_factor
                rays[e] = True
                continue
            share = min(max((value + missed * local) / (open_factor * area), 0.0), 1.0)
            factor[e] = open_factor * share
            spread[e] = doubt / area + 0.25 * abs(missed) / area * (1.0 - abs(2.0 * local - 1.0))
            if depth == 0:
                # One rule of four points and no second look: the doubt of four samples.
                spread[e] += 0.5 * open_factor * math.sqrt(share * max(1.0 - share, 0.0)) + share * open_doubt


@njit(nogil=True, cache=True)
def longest_ring(starts):
    """Largest number of corners among rings."""
    longest = 0
    for i in range(starts.shape[0] - 1):
        longest = max(longest, starts[i + 1] - starts[i])
    return longest
