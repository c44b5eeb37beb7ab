"""A small rasteriser in numba: convex polygons, seen from a point through a viewport in a plane.

A *viewport* is a parallelogram ``origin + u U + v V`` (0 <= u, v < 1) seen from the shading point S.
Every vertex P becomes homogeneous coordinates ``(x, y, w)`` with

    P - S = x U + y V + w (origin - S),

so that ``x / w`` and ``y / w`` are its place in the viewport and ``w`` is its depth: 0 at S, 1 in the
viewport's plane.  Polygons are drawn from their edges in these coordinates (Olano and Greer,
Triangle Scan Conversion Using 2D Homogeneous Coordinates, 1997), so no near plane exists and an
occluder close to S, or one that reaches behind it, needs no clipping.

Sample points are the centres of the pixels.  An edge that two polygons share belongs to exactly one
of them (half-open spans computed from the same number on both sides), so meshes neither leak nor
overlap.  Arithmetic is double throughout.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workbench.accel.box_tree import BoxTree, boxes_meeting_planes
from workbench.geometry.flat import Geometry

__all__ = [
    "BLOCKED",
    "FALLBACK",
    "FAR",
    "INSHADOW",
    "NOT_INSHADOW",
    "NOT_LIGHT",
    "RENDERED",
    "UNLIT",
    "VISIBLE",
    "Lamp",
    "Occluders",
    "draw_hemicubes",
    "emit_tiles",
    "measure_tiles",
    "occluders",
    "render_points",
]

FloatArray = NDArray[np.float64]

FAR = 1.0 - 1e-5
"""Depth of the far plane as a share of the light's: the light and its housing lie beyond it."""

NOT_LIGHT, VISIBLE, BLOCKED = 0, 1, 2
"""What a pixel of a camera's image shows."""

UNLIT, NOT_INSHADOW, INSHADOW, RENDERED, FALLBACK = 0, 1, 2, 3, 4
"""What became of a point; :class:`workbench.shadow.hardware_camera.CameraState` explains them."""

CHECKS, CULLS, BOX_TESTS, DRAWN = 0, 1, 2, 3
"""Columns of the counts that the kernels fill."""

_FLAT = 1e-9  # A viewport seen at a smaller sine than this is edge-on.
_WIDEST = 0.05  # Cosine of the widest angle (87 degrees) between a light's vertex and the camera's axis.


class Occluders(NamedTuple):
    """Convex polygons and the tree of boxes over them, as the kernels read them.

    ``blocks`` says which polygons may block.  ``tolerance`` is the distance from a polygon's plane
    within which a point counts as lying in it: the polygon is then seen edge-on and blocks nothing.
    """

    corners: FloatArray
    start: NDArray[np.int64]
    normal: FloatArray
    owner: NDArray[np.int64]
    bounds: FloatArray
    blocks: NDArray[np.bool_]
    low: FloatArray
    high: FloatArray
    skip: NDArray[np.int64]
    first: NDArray[np.int64]
    leaf: NDArray[np.int64]
    order: NDArray[np.int64]
    tolerance: float


class Lamp(NamedTuple):
    """A light as convex polygons; if ``planar``, with a basis of its plane and the dual basis."""

    corners: FloatArray
    start: NDArray[np.int64]
    normal: FloatArray
    planar: bool
    two_sided: bool
    origin: FloatArray
    basis: FloatArray
    dual: FloatArray


def occluders(
    geometry: Geometry,
    tree: BoxTree | None = None,
    *,
    extent: float = 0.0,
    ignore: NDArray[np.int64] | None = None,
) -> Occluders:
    """The convex pieces of a geometry under their tree (built if not given).

    ``extent`` is the size of what else stands in the scene (lights), for the tolerance; ``ignore``
    lists polygons that block nothing.
    """
    tree = BoxTree.build(geometry) if tree is None else tree
    blocks = np.ones(geometry.piece_count, np.bool_)
    if ignore is not None:
        blocks = ~np.isin(geometry.piece_polygon, ignore)
    count = geometry.piece_count
    largest = float(np.abs(geometry.corners).max()) if count else 0.0
    size = max(geometry.size if count else 0.0, extent)
    return Occluders(
        geometry.corners,
        geometry.piece_start,
        geometry.piece_normal,
        geometry.piece_polygon,
        geometry.piece_bounds,
        blocks,
        tree.low,
        tree.high,
        tree.skip,
        tree.first,
        tree.count,
        tree.order,
        1e-9 * size + 8 * float(np.finfo(float).eps) * largest,
    )


@njit(nogil=True, cache=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(nogil=True, cache=True)
def _invert(frame, g):
    """Rows of the map from P - S to (x, y, w); the determinant of the frame (origin, U, V)."""
    o, u, v = frame[0], frame[1], frame[2]
    g[0, 0], g[0, 1], g[0, 2] = v[1] * o[2] - v[2] * o[1], v[2] * o[0] - v[0] * o[2], v[0] * o[1] - v[1] * o[0]
    g[1, 0], g[1, 1], g[1, 2] = o[1] * u[2] - o[2] * u[1], o[2] * u[0] - o[0] * u[2], o[0] * u[1] - o[1] * u[0]
    g[2, 0], g[2, 1], g[2, 2] = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
    determinant = _dot(o, g[2])
    if determinant != 0.0:
        for i in range(3):
            for j in range(3):
                g[i, j] /= determinant
    return determinant


@njit(nogil=True, cache=True)
def _distance_to_frame(frame):
    """Distance from S, the origin of the frame's coordinates, to the viewport."""
    o, u, v = frame[0], frame[1], frame[2]
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    ou, ov = -_dot(o, u), -_dot(o, v)
    scale = uu * vv - uv * uv
    x, y = (ou * vv - ov * uv) / scale, (ov * uu - ou * uv) / scale
    best = np.inf
    if 0.0 <= x <= 1.0 and 0.0 <= y <= 1.0:
        best = 0.0
        for c in range(3):
            best += (o[c] + x * u[c] + y * v[c]) ** 2
    else:
        for side in range(4):
            if side < 2:  # v = 0 and v = 1
                fixed = float(side)
                t = min(1.0, max(0.0, (ou - fixed * uv) / uu))
                a, b = t, fixed
            else:
                fixed = float(side - 2)
                t = min(1.0, max(0.0, (ov - fixed * uv) / vv))
                a, b = fixed, t
            square = 0.0
            for c in range(3):
                square += (o[c] + a * u[c] + b * v[c]) ** 2
            best = min(best, square)
    return np.sqrt(best)


@njit(nogil=True, cache=True)
def _fit(s, n, lamp, tolerance, viewport, angle, shift_u, shift_v, frame, g, lit, lit_start):
    """Clip the light at the horizon of S and fit a viewport to what is left: it covers all of that.

    Fills ``frame`` (origin - S, U, V), ``g``, and the light's polygons relative to S (``lit``,
    ``lit_start``).  Returns the state, the number of polygons and the frame's determinant.
    """
    pieces = 0
    fill = 0
    flat = clipped = False
    lit_start[0] = 0
    for piece in range(len(lamp.start) - 1):
        first, last = lamp.start[piece], lamp.start[piece + 1]
        height = 0.0
        for c in range(3):
            height += lamp.normal[piece, c] * (s[c] - lamp.corners[first, c])
        if lamp.two_sided:
            height = abs(height)
        if height <= 0.0:
            continue
        if height <= tolerance:
            flat = True
            continue
        begin = fill
        for i in range(first, last):
            j = i + 1 if i + 1 < last else first
            above_i, above_j = 0.0, 0.0
            for c in range(3):
                above_i += n[c] * (lamp.corners[i, c] - s[c])
                above_j += n[c] * (lamp.corners[j, c] - s[c])
            if above_i > 0.0:
                for c in range(3):
                    lit[fill, c] = lamp.corners[i, c] - s[c]
                fill += 1
            if (above_i > 0.0) != (above_j > 0.0):
                clipped = True
                t = above_i / (above_i - above_j)
                for c in range(3):
                    lit[fill, c] = (1.0 - t) * (lamp.corners[i, c] - s[c]) + t * (lamp.corners[j, c] - s[c])
                fill += 1
        if fill - begin < 3:
            fill = begin
            continue
        pieces += 1
        lit_start[pieces] = fill
    if pieces == 0:
        return (FALLBACK if flat else UNLIT), 0, 0.0

    axis = np.zeros(3)
    b1, b2 = np.empty(3), np.empty(3)
    farthest = 1.0
    if lamp.planar:
        for c in range(3):
            axis[c] = lamp.origin[c] - s[c]
            b1[c], b2[c] = lamp.basis[0, c], lamp.basis[1, c]
    else:
        for i in range(fill):
            for c in range(3):
                axis[c] += lit[i, c]
        length = np.sqrt(_dot(axis, axis))
        if length == 0.0:
            return FALLBACK, 0, 0.0
        least = 0
        for c in range(3):
            axis[c] /= length
            if abs(axis[c]) < abs(axis[least]):
                least = c
        helper = np.zeros(3)
        helper[least] = 1.0
        for c in range(3):
            b1[c] = helper[(c + 1) % 3] * axis[(c + 2) % 3] - helper[(c + 2) % 3] * axis[(c + 1) % 3]
        length = np.sqrt(_dot(b1, b1))
        for c in range(3):
            b1[c] /= length
        for c in range(3):
            b2[c] = axis[(c + 1) % 3] * b1[(c + 2) % 3] - axis[(c + 2) % 3] * b1[(c + 1) % 3]
        farthest = 0.0
        for i in range(fill):
            depth = _dot(axis, lit[i])
            if depth < _WIDEST * np.sqrt(_dot(lit[i], lit[i])):
                return FALLBACK, 0, 0.0
            farthest = max(farthest, depth)
        for c in range(3):
            axis[c] *= farthest
    cosine, sine = np.cos(angle), np.sin(angle)
    low_u, low_v, high_u, high_v = np.inf, np.inf, -np.inf, -np.inf
    place = np.empty((3, 2))
    for i in range(fill):
        if lamp.planar:
            p, q = 0.0, 0.0
            for c in range(3):
                p += lamp.dual[0, c] * (lit[i, c] - axis[c])
                q += lamp.dual[1, c] * (lit[i, c] - axis[c])
        else:
            scale = farthest * farthest / _dot(axis, lit[i])
            p, q = scale * _dot(b1, lit[i]), scale * _dot(b2, lit[i])
        turned_u, turned_v = cosine * p + sine * q, cosine * q - sine * p
        low_u, high_u = min(low_u, turned_u), max(high_u, turned_u)
        low_v, high_v = min(low_v, turned_v), max(high_v, turned_v)
        if i < 3:
            place[i, 0], place[i, 1] = turned_u, turned_v
    width, height = high_u - low_u, high_v - low_v
    # How many of the first three corners lie in the upper half of the frame.
    upper_u = upper_v = 0
    for i in range(3):
        upper_u += 2.0 * place[i, 0] > low_u + high_u
        upper_v += 2.0 * place[i, 1] > low_v + high_v
    u0, v0 = low_u, low_v
    if shift_u != 0.0 or shift_v != 0.0:
        # A pixel wider than the light, which it covers wherever it is shifted.
        width, height = width * viewport / (viewport - 1.0), height * viewport / (viewport - 1.0)
        u0 += (shift_u - 0.5) * width / viewport
        v0 += (shift_v - 0.5) * height / viewport
    elif clipped and fill == 3:
        # A corner that the horizon cuts off: with its sides along the frame's, the cut would run through the
        # centres of the pixels on the diagonal, all in or all out.  Half a pixel more on the cut's side halves them.
        width, height = width * viewport / (viewport - 0.5), height * viewport / (viewport - 0.5)
        if upper_u > 1:
            u0 = high_u - width
        if upper_v > 1:
            v0 = high_v - height
    for c in range(3):
        along, across = cosine * b1[c] + sine * b2[c], cosine * b2[c] - sine * b1[c]
        frame[0, c] = axis[c] + u0 * along + v0 * across
        frame[1, c] = width * along
        frame[2, c] = height * across
    longest = np.sqrt(max(_dot(frame[1], frame[1]), _dot(frame[2], frame[2])))
    reach = np.sqrt(_dot(frame[0], frame[0])) + 2.0 * longest
    determinant = _invert(frame, g)
    area = np.sqrt(_dot(frame[1], frame[1]) * _dot(frame[2], frame[2]))
    if not abs(determinant) > _FLAT * area * reach or not area > 0.0:
        return FALLBACK, 0, 0.0
    if _distance_to_frame(frame) * viewport < longest:
        return FALLBACK, 0, 0.0  # The kernel cos cos / r^2 would be narrower than a pixel.
    return RENDERED, pieces, determinant


@njit(nogil=True, cache=True)
def _boxes(s, n, g, far, occ, candidates, counts):
    """Polygons whose boxes meet the pyramid of the viewport, above S's tangent plane, before ``far``.

    ``far`` (4,) is a vector and the value that its product with P - S must stay below; a value of 0
    means no far plane.
    """
    planes = np.empty((6, 4))
    for c in range(3):
        planes[0, c] = g[0, c]
        planes[1, c] = g[1, c]
        planes[2, c] = g[2, c] - g[0, c]
        planes[3, c] = g[2, c] - g[1, c]
        planes[4, c] = n[c]
        planes[5, c] = -far[c]
    used = 6 if far[3] > 0.0 else 5
    for k in range(used):
        length = np.sqrt(planes[k, 0] ** 2 + planes[k, 1] ** 2 + planes[k, 2] ** 2)
        for c in range(3):
            planes[k, c] /= length
        planes[k, 3] = _dot(planes[k], s) - (far[3] / length if k == 5 else 0.0)
    tally = np.zeros(1, np.int64)
    met = boxes_meeting_planes(
        occ.low, occ.high, occ.skip, occ.first, occ.leaf, occ.order, occ.bounds,
        planes, used, occ.tolerance, candidates, tally,
    )  # fmt: skip
    counts[BOX_TESTS] += tally[0]
    return met


@njit(nogil=True, cache=True)
def _gather(s, n, g, far, own, occ, width, height, window, every_size, candidates, boxes, large, counts):
    """Candidates that may block: the plane-vertex check of each polygon that :func:`_boxes` left.

    The planes are the four sides of the pyramid, the tangent plane at S and the far plane.  A polygon
    that only touches one is outside, for the centres of the pixels all lie inside.  Polygons that S
    lies in (seen edge-on) and those of ``own`` block nothing.

    Returns the number of polygons that may block, and of those that must be drawn: not the ones
    that lie between the centres of the pixels, unless ``every_size`` is true.  The latter are left
    in ``candidates`` with the pixels, [first, last) column and row, that they may cover in
    ``boxes``; ``large`` flags those whose bounding rectangle holds the ``window`` (low u, v, high u, v).
    """
    met = _boxes(s, n, g, far, occ, candidates, counts)
    blocking, drawn = 0, 0
    for k in range(met):
        piece = candidates[k]
        if not occ.blocks[piece] or occ.owner[piece] == own:
            continue
        counts[CHECKS] += 1
        first, last = occ.start[piece], occ.start[piece + 1]
        most_x, most_y, most_rx, most_ry, most_n = -np.inf, -np.inf, -np.inf, -np.inf, -np.inf
        nearest, low_w, low_u, low_v, high_u, high_v = np.inf, np.inf, np.inf, np.inf, -np.inf, -np.inf
        for i in range(first, last):
            d0 = occ.corners[i, 0] - s[0]
            d1 = occ.corners[i, 1] - s[1]
            d2 = occ.corners[i, 2] - s[2]
            x = g[0, 0] * d0 + g[0, 1] * d1 + g[0, 2] * d2
            y = g[1, 0] * d0 + g[1, 1] * d1 + g[1, 2] * d2
            w = g[2, 0] * d0 + g[2, 1] * d1 + g[2, 2] * d2
            most_x, most_y, low_w = max(most_x, x), max(most_y, y), min(low_w, w)
            most_rx, most_ry = max(most_rx, w - x), max(most_ry, w - y)
            most_n = max(most_n, n[0] * d0 + n[1] * d1 + n[2] * d2)
            nearest = min(nearest, far[0] * d0 + far[1] * d1 + far[2] * d2)
            if w > 0.0:
                u, v = x / w, y / w
                low_u, high_u, low_v, high_v = min(low_u, u), max(high_u, u), min(low_v, v), max(high_v, v)
        if min(most_x, most_y, most_rx, most_ry, most_n) <= 0.0 or (far[3] > 0.0 and nearest >= far[3]):
            counts[CULLS] += 1
            continue
        lift = 0.0
        for c in range(3):
            lift += occ.normal[piece, c] * (occ.corners[first, c] - s[c])
        if abs(lift) <= occ.tolerance:
            continue
        blocking += 1
        i0, i1, j0, j1 = 0, width, 0, height
        all_round = low_w <= 0.0
        if not all_round:
            # A hundredth of a pixel to spare: graphics hardware snaps vertices to 1/256 of one.
            i0 = int(min(float(width), max(0.0, np.ceil(low_u * width - 0.51))))
            i1 = int(min(float(width), max(0.0, np.floor(high_u * width - 0.49) + 1.0)))
            j0 = int(min(float(height), max(0.0, np.ceil(low_v * height - 0.51))))
            j1 = int(min(float(height), max(0.0, np.floor(high_v * height - 0.49) + 1.0)))
            if not every_size and (i0 >= i1 or j0 >= j1):
                continue
        candidates[drawn] = piece
        boxes[drawn, 0], boxes[drawn, 1], boxes[drawn, 2], boxes[drawn, 3] = i0, i1, j0, j1
        large[drawn] = all_round or (
            low_u <= window[0] and low_v <= window[1] and high_u >= window[2] and high_v >= window[3]
        )
        drawn += 1
    return blocking, drawn


@njit(nogil=True, cache=True)
def _every(s, own, occ, candidates):
    """All polygons but those that S lies in and its own, for the naive mode."""
    found = 0
    for piece in range(len(occ.owner)):
        lift = 0.0
        for c in range(3):
            lift += occ.normal[piece, c] * (occ.corners[occ.start[piece], c] - s[c])
        if occ.blocks[piece] and occ.owner[piece] != own and abs(lift) > occ.tolerance:
            candidates[found] = piece
            found += 1
    return found


@njit(nogil=True, cache=True)
def _set_up(corners, first, last, s, normal, frame, g, determinant, points, edges, plane):
    """Homogeneous vertices, oriented edges (a, b, c, 1/a) and plane of a polygon.

    Inside the polygon every ``a u + b v + c`` is positive and its depth is
    ``plane[3] / (plane[0] u + plane[1] v + plane[2])``, both terms positive.
    """
    count = last - first
    height = 0.0
    for c in range(3):
        height += normal[c] * (corners[first, c] - s[c])
    side = 1.0 if height > 0.0 else -1.0
    plane[0], plane[1], plane[2] = (
        side * _dot(normal, frame[1]),
        side * _dot(normal, frame[2]),
        side * _dot(normal, frame[0]),
    )
    plane[3] = abs(height)
    for i in range(count):
        d0 = corners[first + i, 0] - s[0]
        d1 = corners[first + i, 1] - s[1]
        d2 = corners[first + i, 2] - s[2]
        for k in range(3):
            points[i, k] = g[k, 0] * d0 + g[k, 1] * d1 + g[k, 2] * d2
    if determinant < 0.0:
        side = -side
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        x, y, w = points[i, 0], points[i, 1], points[i, 2]
        x2, y2, w2 = points[j, 0], points[j, 1], points[j, 2]
        a, b, c = side * (y * w2 - w * y2), side * (w * x2 - x * w2), side * (x * y2 - y * x2)
        if abs(a) <= 1e-18 * (abs(b) + abs(c)):
            a = 0.0
        edges[i, 0], edges[i, 1], edges[i, 2] = a, b, c
        edges[i, 3] = 1.0 / a if a != 0.0 else 0.0
    return count


@njit(nogil=True, cache=True)
def _rows(points, count, height, margin):
    """Rows [first, last) of pixels that a polygon may cover; all of them if it reaches behind S."""
    low, high = np.inf, -np.inf
    for i in range(count):
        if points[i, 2] <= 0.0:
            return 0, height
        v = points[i, 1] / points[i, 2]
        low, high = min(low, v), max(high, v)
    top = min(float(height), max(0.0, np.ceil(low * height - 0.5 - margin)))
    bottom = min(float(height), max(0.0, np.floor(high * height - 0.5 + margin) + 1.0))
    return int(top), int(bottom)


@njit(nogil=True, cache=True)
def _span(edges, count, v, width):
    """Pixels [first, last) of a row whose centres lie inside all the edges.

    The crossing of an edge is the same number for both polygons that share it; one takes the pixels
    below it and the other those from it on.
    """
    low, high = 0.0, 1.0
    for i in range(count):
        a = edges[i, 0]
        rest = edges[i, 1] * v + edges[i, 2]
        if a > 0.0:
            low = max(low, -rest * edges[i, 3])
        elif a < 0.0:
            high = min(high, -rest * edges[i, 3])
        elif rest < 0.0 or (rest == 0.0 and edges[i, 1] < 0.0):
            return 0, 0
    if not low < high:
        return 0, 0
    return int(np.ceil(low * width - 0.5)), int(np.ceil(high * width - 0.5))


@njit(nogil=True, cache=True)
def _widen(edges, count, width, height):
    """Push the edges out by half a pixel each way, so that every pixel touched is inside."""
    for i in range(count):
        edges[i, 2] += 0.5 * abs(edges[i, 0]) / width + 0.5 * abs(edges[i, 1]) / height


@njit(nogil=True, cache=True)
def _draw_light(lit, lit_start, lit_normal, pieces, frame, g, determinant, image, limit, points, edges, plane):
    """Draw the light's polygons: VISIBLE pixels, and in ``limit`` the depth where the light begins."""
    size = image.shape[0]
    origin = np.zeros(3)
    covered = 0
    for piece in range(pieces):
        first, last = lit_start[piece], lit_start[piece + 1]
        count = _set_up(lit, first, last, origin, lit_normal[piece], frame, g, determinant, points, edges, plane)
        top, bottom = _rows(points, count, size, 1e-9)
        for j in range(top, bottom):
            v = (j + 0.5) / size
            i0, i1 = _span(edges, count, v, size)
            for i in range(i0, i1):
                depth = FAR * plane[3] / (plane[0] * (i + 0.5) / size + plane[1] * v + plane[2])
                if image[j, i] == NOT_LIGHT:
                    image[j, i] = VISIBLE
                    limit[j, i] = depth
                    covered += 1
                elif depth < limit[j, i]:
                    limit[j, i] = depth
    return covered


@njit(nogil=True, cache=True)
def _any_visible(image, box):
    """Whether a rectangle of pixels shows any of the light."""
    for j in range(box[2], box[3]):
        for i in range(box[0], box[1]):
            if image[j, i] == VISIBLE:
                return True
    return False


@njit(nogil=True, cache=True)
def _draw_occluder(count, points, edges, plane, planar, conservative, image, limit):
    """Mark the light's pixels that a polygon blocks; how many were visible before."""
    size = image.shape[0]
    if conservative:
        _widen(edges, count, size, size)
    blocked = 0
    top, bottom = _rows(points, count, size, 0.5 if conservative else 1e-9)
    if planar and not conservative:
        # Before the far plane is one more half-plane: depth < FAR, linear in u and v.
        edges[count, 0], edges[count, 1] = FAR * plane[0], FAR * plane[1]
        edges[count, 2] = FAR * plane[2] - plane[3]
        edges[count, 3] = 1.0 / edges[count, 0] if edges[count, 0] != 0.0 else 0.0
        for j in range(top, bottom):
            i0, i1 = _span(edges, count + 1, (j + 0.5) / size, size)
            for i in range(i0, i1):
                if image[j, i] == VISIBLE:
                    image[j, i] = BLOCKED
                    blocked += 1
        return blocked
    for j in range(top, bottom):
        v = (j + 0.5) / size
        i0, i1 = _span(edges, count, v, size)
        for i in range(i0, i1):
            if image[j, i] == VISIBLE and (
                conservative or plane[3] < limit[j, i] * (plane[0] * (i + 0.5) / size + plane[1] * v + plane[2])
            ):
                image[j, i] = BLOCKED
                blocked += 1
    return blocked


@njit(nogil=True, cache=True)
def _hides_all(count, edges, plane, g, lit, vertices):
    """Whether one convex polygon stands, with room to spare, before every vertex of the light."""
    for i in range(vertices):
        x, y, w = _dot(g[0], lit[i]), _dot(g[1], lit[i]), _dot(g[2], lit[i])
        for k in range(count):
            value = edges[k, 0] * x + edges[k, 1] * y + edges[k, 2] * w
            if value <= 1e-12 * (abs(edges[k, 0] * x) + abs(edges[k, 1] * y) + abs(edges[k, 2] * w)):
                return False
        if not plane[3] < FAR * (plane[0] * x + plane[1] * y + plane[2] * w):
            return False
    return True


@njit(nogil=True, cache=True)
def _parts(here, before):
    """How much of a pixel's error a border between two pixels passes on to the visible share."""
    if here == before:
        return 0.0
    # The rim of the light moves both what is seen of it and all of it.
    return 1.0 if here != NOT_LIGHT and before != NOT_LIGHT else 0.5


@njit(nogil=True, cache=True)
def _measure(image, frame, n):
    """(light pixels, visible pixels, light weight, visible weight, error of the latter) of an image.

    A pixel weighs cos cos dA / r^2: the light's plane gives cos dA = (U x V) . d / (|d| pixels).

    The error: where a border between pixels runs on straight for r of them, the true edge lies anywhere
    within a pixel of it, by a root mean square of r / sqrt 12; runs are independent of each other.
    """
    size = image.shape[0]
    u, v, o = frame[1], frame[2], frame[0]
    flux = abs(
        (u[1] * v[2] - u[2] * v[1]) * o[0] + (u[2] * v[0] - u[0] * v[2]) * o[1] + (u[0] * v[1] - u[1] * v[0]) * o[2]
    ) / (size * size)
    light, visible = 0, 0
    light_weight, visible_weight, square_error = 0.0, 0.0, 0.0
    upright = np.zeros(size)
    above = np.zeros(size)
    for j in range(size):
        y = (j + 0.5) / size
        b0, b1, b2 = o[0] + y * v[0], o[1] + y * v[1], o[2] + y * v[2]
        level = last = 0.0
        for i in range(size):
            weight = 0.0
            if image[j, i] != NOT_LIGHT:
                x = (i + 0.5) / size
                d0, d1, d2 = b0 + x * u[0], b1 + x * u[1], b2 + x * u[2]
                square = d0 * d0 + d1 * d1 + d2 * d2
                weight = max(0.0, n[0] * d0 + n[1] * d1 + n[2] * d2) * flux / (square * square)
                light += 1
                light_weight += weight
                if image[j, i] == VISIBLE:
                    visible += 1
                    visible_weight += weight
            border = _parts(image[j, i], image[j, i - 1]) * max(weight, last) if i > 0 else 0.0
            if border == 0.0:
                square_error += upright[i] * upright[i]
                upright[i] = 0.0
            upright[i] += border
            border = _parts(image[j, i], image[j - 1, i]) * max(weight, above[i]) if j > 0 else 0.0
            if border == 0.0:
                square_error += level * level
                level = 0.0
            level += border
            last = above[i] = weight
        square_error += level * level
    for i in range(size):
        square_error += upright[i] * upright[i]
    return light, visible, light_weight, visible_weight, math.sqrt(square_error / 12.0)


@njit(nogil=True, cache=True)
def _lit_normals(lit, lit_start, pieces, normals):
    """Normals of the clipped light polygons, by Newell's sum, counter-clockwise."""
    for piece in range(pieces):
        first, last = lit_start[piece], lit_start[piece + 1]
        for c in range(3):
            normals[piece, c] = 0.0
        for i in range(first + 1, last - 1):
            for c in range(3):
                p, q = (c + 1) % 3, (c + 2) % 3
                normals[piece, c] += (lit[i, p] - lit[first, p]) * (lit[i + 1, q] - lit[first, q])
                normals[piece, c] -= (lit[i, q] - lit[first, q]) * (lit[i + 1, p] - lit[first, p])


@njit(nogil=True, cache=True)
def _longest(occ):
    """Most corners of a polygon."""
    longest = 4
    for i in range(len(occ.start) - 1):
        longest = max(longest, occ.start[i + 1] - occ.start[i])
    return longest


@njit(nogil=True, cache=True)
def _scratch(lamp, occ):
    """Work arrays of one thread: frame, g, light polygons and normals, vertices, edges, plane, candidates..."""
    longest = _longest(occ)
    for i in range(len(lamp.start) - 1):
        longest = max(longest, lamp.start[i + 1] - lamp.start[i] + 1)
    lamps = len(lamp.start)
    return (
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((len(lamp.corners) + 2 * lamps, 3)),
        np.empty(lamps + 1, np.int64),
        np.empty((lamps, 3)),
        np.empty((longest, 3)),
        np.empty((longest + 1, 4)),
        np.empty(4),
        np.empty(len(occ.owner), np.int64),
        np.empty((len(occ.owner), 4), np.int32),
        np.empty(len(occ.owner), np.bool_),
        np.empty(4),
        np.empty(4),
    )


@njit(nogil=True, cache=True)
def _far_plane(lamp, g, lit, lit_start, lit_normal, pieces, far):
    """Vector and value (4,) of a plane beyond which nothing blocks, as :func:`_boxes` reads them.

    Just before a flat light; otherwise across the mean normal of the parts of the light that face
    S, through the vertex farthest that way.
    """
    if lamp.planar:
        far[0], far[1], far[2], far[3] = g[2, 0], g[2, 1], g[2, 2], FAR
        return
    for c in range(3):
        far[c] = 0.0
        for piece in range(pieces):
            away = _dot(lit_normal[piece], lit[lit_start[piece]])
            far[c] += lit_normal[piece, c] if away > 0.0 else -lit_normal[piece, c]
    far[3] = 0.0
    for i in range(lit_start[pieces]):
        far[3] = max(far[3], far[0] * lit[i, 0] + far[1] * lit[i, 1] + far[2] * lit[i, 2])


@njit(nogil=True, cache=True)
def _prepare(s, n, own, lamp, occ, viewport, naive, every_size, sample, work, counts):
    """Fit the camera to one point and find what it must draw: state, light polygons, candidates.

    In the optimised mode a point without candidates is NOT_INSHADOW, and one whose whole light
    stands behind one convex polygon is INSHADOW; neither is rendered.
    """
    frame, g, lit, lit_start, lit_normal, points, edges, plane, candidates, boxes, large, window, far = work
    state, pieces, determinant = _fit(
        s, n, lamp, occ.tolerance, viewport, sample[0], sample[1], sample[2], frame, g, lit, lit_start
    )
    if state != RENDERED:
        return state, 0, 0, determinant
    _lit_normals(lit, lit_start, pieces, lit_normal)
    if naive:
        return RENDERED, pieces, _every(s, own, occ, candidates), determinant
    vertices = lit_start[pieces]
    window[0], window[1], window[2], window[3] = np.inf, np.inf, -np.inf, -np.inf
    for i in range(vertices):
        w = _dot(g[2], lit[i])
        for axis in range(2):
            place = _dot(g[axis], lit[i]) / w
            window[axis] = min(window[axis], place)
            window[2 + axis] = max(window[2 + axis], place)
    _far_plane(lamp, g, lit, lit_start, lit_normal, pieces, far)
    blocking, drawn = _gather(
        s, n, g, far, own, occ, viewport, viewport, window, every_size, candidates, boxes, large, counts
    )
    if blocking == 0:
        return NOT_INSHADOW, pieces, 0, determinant
    for k in range(drawn):
        if large[k]:
            p = candidates[k]
            count = _set_up(
                occ.corners,
                occ.start[p],
                occ.start[p + 1],
                s,
                occ.normal[p],
                frame,
                g,
                determinant,
                points,
                edges,
                plane,
            )
            if _hides_all(count, edges, plane, g, lit, vertices):
                return INSHADOW, pieces, 0, determinant
    return RENDERED, pieces, drawn, determinant


@njit(nogil=True, cache=True)
def render_points(
    points, normals, own, lamp, occ, viewport, naive, conservative, samples, state, pixels, weights, untouched, counts
):
    """Shadow cameras at a block of points, by this rasteriser.

    Fills ``state`` (m,), ``pixels`` (m, 2) light and visible, ``weights`` (m, 3) the same weighted
    by cos cos dA / r^2 and the error of the latter, ``untouched`` (m,) light pixels that no polygon touches (if
    ``conservative``) and adds to ``counts`` (4,).
    """
    work = _scratch(lamp, occ)
    frame, g, lit, lit_start, lit_normal, corners, edges, plane, candidates, boxes, _, _, _ = work
    image = np.empty((viewport, viewport), np.uint8)
    limit = np.empty((viewport, viewport))
    for m in range(len(points)):
        s, n = points[m], normals[m]
        state[m], pieces, found, determinant = _prepare(
            s, n, own[m], lamp, occ, viewport, naive, conservative, samples[m], work, counts
        )
        if state[m] != RENDERED:
            continue
        for touching in range(2 if conservative else 1):
            image[:] = NOT_LIGHT
            left = _draw_light(
                lit, lit_start, lit_normal, pieces, frame, g, determinant, image, limit, corners, edges, plane
            )
            for k in range(found):
                if not naive:
                    if left == 0:
                        break
                    if touching == 0 and not _any_visible(image, boxes[k]):
                        continue
                p = candidates[k]
                count = _set_up(
                    occ.corners, occ.start[p], occ.start[p + 1], s, occ.normal[p], frame, g, determinant,
                    corners, edges, plane,
                )  # fmt: skip
                left -= _draw_occluder(count, corners, edges, plane, lamp.planar, touching == 1, image, limit)
                if touching == 0:
                    counts[DRAWN] += 1
            if touching == 1:
                untouched[m] = left
            else:
                pixels[m, 0], pixels[m, 1], weights[m, 0], weights[m, 1], weights[m, 2] = _measure(image, frame, n)


@njit(nogil=True, cache=True)
def _clip(points, count, far, spare):
    """Clip a homogeneous polygon to the viewport and, if ``far`` is positive, to depths below it.

    Works between ``points`` and ``spare``, both (k, 3) with room for five more vertices; the answer
    is in ``points``.  The cone of the viewport has its apex at S, so all depths end up positive.
    """
    for side in range(5 if far > 0.0 else 4):
        fill = 0
        for i in range(count):
            j = i + 1 if i + 1 < count else 0
            if side == 0:
                a, b = points[i, 0], points[j, 0]
            elif side == 1:
                a, b = points[i, 2] - points[i, 0], points[j, 2] - points[j, 0]
            elif side == 2:
                a, b = points[i, 1], points[j, 1]
            elif side == 3:
                a, b = points[i, 2] - points[i, 1], points[j, 2] - points[j, 1]
            else:
                a, b = far - points[i, 2], far - points[j, 2]
            if a >= 0.0:
                for c in range(3):
                    spare[fill, c] = points[i, c]
                fill += 1
            if (a > 0.0 and b < 0.0) or (a < 0.0 and b > 0.0):
                t = a / (a - b)
                for c in range(3):
                    spare[fill, c] = (1.0 - t) * points[i, c] + t * points[j, c]
                fill += 1
        count = fill
        if count < 3:
            return 0
        for i in range(count):
            for c in range(3):
                points[i, c] = spare[i, c]
    return count


@njit(nogil=True, cache=True)
def _emit(points, count, column, row, viewport, atlas, out, fill):
    """Write a clipped polygon as a fan of triangles: atlas coordinates -1..1, and the depth."""
    for i in range(count):
        if not points[i, 2] > 0.0:
            return fill
    for i in range(1, count - 1):
        for corner in (0, i, i + 1):
            w = points[corner, 2]
            out[fill, 0] = 2.0 * (column + points[corner, 0] / w) * viewport / atlas - 1.0
            out[fill, 1] = 2.0 * (row + points[corner, 1] / w) * viewport / atlas - 1.0
            out[fill, 2] = w
            fill += 1
    return fill


@njit(nogil=True, cache=True)
def emit_tiles(
    first, points, normals, own, lamp, occ, viewport, atlas, naive, samples, state, tile_point, frames,
    light_triangles, triangles, counts,
):  # fmt: skip
    """What the graphics library must draw for the points from ``first`` on, tile by tile.

    Fits the cameras, culls, clips in double precision and writes the light's and the occluders'
    triangles, (k, 3) float32 vertices each, until the atlas or a buffer is full.  Returns the next
    point, the number of tiles, and of vertices in the two buffers.
    """
    work = _scratch(lamp, occ)
    frame, g, lit, lit_start, lit_normal, _, edges, plane, candidates, _, _, _, _ = work
    polygon, spare = np.empty((len(edges) + 6, 3)), np.empty((len(edges) + 6, 3))
    side = atlas // viewport
    tiles, light_fill, fill = 0, 0, 0
    worst = 3 * (len(edges) + 4)
    origin = np.zeros(3)
    before = counts.copy()
    for m in range(first, len(points)):
        s, n = points[m], normals[m]
        state[m], pieces, found, determinant = _prepare(
            s, n, own[m], lamp, occ, viewport, naive, False, samples[m], work, counts
        )
        if state[m] != RENDERED:
            before[:] = counts
            continue
        if (
            tiles == side * side
            or fill + found * worst > len(triangles)
            or light_fill + pieces * worst > len(light_triangles)
        ):
            counts[:] = before  # This point is prepared again in the next batch.
            return m, tiles, light_fill, fill
        column, row = tiles % side, tiles // side
        for piece in range(pieces):
            a, b = lit_start[piece], lit_start[piece + 1]
            count = _set_up(lit, a, b, origin, lit_normal[piece], frame, g, determinant, polygon, edges, plane)
            count = _clip(polygon, count, 0.0, spare)
            light_fill = _emit(polygon, count, column, row, viewport, atlas, light_triangles, light_fill)
        for k in range(found):
            p = candidates[k]
            count = _set_up(
                occ.corners, occ.start[p], occ.start[p + 1], s, occ.normal[p], frame, g, determinant,
                polygon, edges, plane,
            )  # fmt: skip
            counts[DRAWN] += 1
            count = _clip(polygon, count, FAR if lamp.planar else 0.0, spare)
            fill = _emit(polygon, count, column, row, viewport, atlas, triangles, fill)
        frames[tiles] = frame
        tile_point[tiles] = m
        tiles += 1
        before[:] = counts
    return len(points), tiles, light_fill, fill


@njit(nogil=True, cache=True)
def measure_tiles(picture, tiles, tile_point, frames, normals, viewport, pixels, weights):
    """Measure the tiles of an atlas, (atlas, atlas) uint8 of NOT_LIGHT, VISIBLE and BLOCKED."""
    side = picture.shape[1] // viewport
    for tile in range(tiles):
        column, row = tile % side, tile // side
        image = picture[row * viewport : (row + 1) * viewport, column * viewport : (column + 1) * viewport]
        m = tile_point[tile]
        pixels[m, 0], pixels[m, 1], weights[m, 0], weights[m, 1], weights[m, 2] = _measure(
            image, frames[tile], normals[m]
        )


@njit(nogil=True, cache=True)
def draw_hemicubes(points, normals, turns, own, occ, resolution, owners, counts):
    """Nearest polygon in every pixel of a hemicube at each point.

    ``turns`` (m, 3) are unit vectors across the normals that face the first side.  ``owners``
    (m, 3 resolution^2) int32 gets the owner of the nearest polygon, -1 where none is: the top face
    row by row, then the four sides, each from the horizon up.
    """
    longest = _longest(occ)
    corners, edges, plane = np.empty((longest, 3)), np.empty((longest + 1, 4)), np.empty(4)
    frame, g = np.empty((3, 3)), np.empty((3, 3))
    candidates, large = np.empty(len(occ.owner), np.int64), np.empty(len(occ.owner), np.bool_)
    boxes = np.empty((len(occ.owner), 4), np.int32)
    window, no_far = np.array([0.0, 0.0, 1.0, 1.0]), np.zeros(4)
    depth = np.empty((resolution, resolution))
    half = resolution // 2
    across = np.empty((4, 3))
    for m in range(len(points)):
        s, n = points[m], normals[m]
        for c in range(3):
            across[0, c] = turns[m, c]
        for c in range(3):
            across[1, c] = n[(c + 1) % 3] * across[0, (c + 2) % 3] - n[(c + 2) % 3] * across[0, (c + 1) % 3]
            across[2, c] = -across[0, c]
        for c in range(3):
            across[3, c] = -across[1, c]
        for face in range(5):
            for c in range(3):
                if face == 0:
                    frame[0, c] = n[c] - across[0, c] - across[1, c]
                    frame[1, c] = 2.0 * across[0, c]
                    frame[2, c] = 2.0 * across[1, c]
                else:
                    frame[0, c] = across[face - 1, c] - across[face % 4, c]
                    frame[1, c] = 2.0 * across[face % 4, c]
                    frame[2, c] = n[c]
            height = resolution if face == 0 else half
            begin = 0 if face == 0 else resolution * resolution + (face - 1) * half * resolution
            determinant = _invert(frame, g)
            depth[:] = np.inf
            owners[m, begin : begin + height * resolution] = -1
            _, drawn = _gather(
                s, n, g, no_far, own[m], occ, resolution, height, window, False, candidates, boxes, large, counts
            )
            for k in range(drawn):
                p = candidates[k]
                count = _set_up(
                    occ.corners, occ.start[p], occ.start[p + 1], s, occ.normal[p], frame, g, determinant,
                    corners, edges, plane,
                )  # fmt: skip
                counts[DRAWN] += 1
                top, bottom = _rows(corners, count, height, 1e-9)
                for j in range(top, bottom):
                    v = (j + 0.5) / height
                    i0, i1 = _span(edges, count, v, resolution)
                    for i in range(i0, i1):
                        slope = plane[0] * (i + 0.5) / resolution + plane[1] * v + plane[2]
                        if plane[3] < depth[j, i] * slope:
                            depth[j, i] = plane[3] / slope
                            owners[m, begin + j * resolution + i] = occ.owner[p]
