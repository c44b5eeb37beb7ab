"""Closed forms for what leaves one polygon and reaches a point or another polygon, unoccluded."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from radiosity.form_factors._contour import contour_integral
from workbench.arrays import as_points, as_unit_vectors
from workbench.errors import InputError
from workbench.geometry.lambert import lambert_piece
from workbench.geometry.planes import clip_by_plane
from workbench.geometry.polygons import check_polygon, convex_pieces, vector_area

__all__ = ["crossed_strings", "pair_exchange", "point_to_polygon", "polygon_to_polygon"]

FloatArray = NDArray[np.float64]

ON_PLANE = 1e-13
"""A corner this close to a plane, as a share of the pair's size, counts as on it."""

_MAX_CORNERS = 64


def _as_pieces(polygon: ArrayLike, holes: Sequence[ArrayLike], name: str) -> tuple[list[FloatArray], FloatArray, float]:
    """Convex pieces, unit normal and area of a polygon with holes given by a caller."""
    outer = as_points(polygon, name)
    rings = [outer]
    normal = vector_area(outer)
    for hole in holes:
        ring = as_points(hole, f"{name} hole")
        # Holes run against the outer ring, whichever way the caller wrote them.
        rings.append(ring[::-1].copy() if vector_area(ring) @ normal > 0 else ring)
    problem = check_polygon(rings)
    if problem:
        raise InputError(f"{name}: found {problem}, expected a planar polygon with an area")
    vector = vector_area(rings)
    area = float(np.linalg.norm(vector))
    return convex_pieces(rings), vector / area, area


@njit(nogil=True, cache=True)
def _point_to_piece(points, normals, piece, nx, ny, nz, reach, out):
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        height = (x - piece[0, 0]) * nx + (y - piece[0, 1]) * ny + (z - piece[0, 2]) * nz
        if height > 1e-15 * reach:
            share = lambert_piece(x, y, z, normals[i, 0], normals[i, 1], normals[i, 2], piece, 0, piece.shape[0])
            out[i] += max(share, 0.0)


def point_to_polygon(
    points: ArrayLike, normals: ArrayLike, polygon: ArrayLike, holes: Sequence[ArrayLike] = ()
) -> FloatArray:
    """Form factor from points (differential elements) to a polygon, unoccluded.

    Lambert's formula over the part of the polygon above each point's horizon; zero for points
    behind or in the polygon's plane.

    Parameters
    ----------
    points, normals : (n, 3) float
        Receiving points and their normals (any length but zero).
    polygon : (m, 3) float
        Planar simple polygon, convex or not, counter-clockwise seen from its emitting side.
    holes : sequence of (m, 3) float
        Rings cut out of the polygon, in either direction.

    Returns
    -------
    (n,) float
        Form factor F_d1-2. [dimensionless, 0..1]

    Raises
    ------
    InputError
        If an array has another shape, or the polygon has no area, is not planar or crosses itself.

    Notes
    -----
    Lambert (1760); Baum, Rushmeier and Winget (1989), eq. 10.
    """
    points = as_points(points)
    normals = as_unit_vectors(normals)
    if len(normals) != len(points):
        raise InputError(f"normals: found {len(normals)} rows for {len(points)} points")
    pieces, normal, _ = _as_pieces(polygon, holes, "polygon")
    out = np.zeros(len(points))
    reach = float(max(np.abs(points).max(initial=0.0), max(np.abs(piece).max() for piece in pieces)))
    for piece in pieces:
        _point_to_piece(points, normals, piece, normal[0], normal[1], normal[2], reach, out)
    return np.minimum(out, 1.0)


@njit(nogil=True, cache=True)
def pair_exchange(corners_p, p0, p1, np_normal, corners_q, q0, q1, nq_normal, tolerance, work):
    """Exchange area ``A_P F_PQ`` of two convex polygons, each clipped by the other's plane.

    ``corners_p[p0:p1]`` and ``corners_q[q0:q1]`` are the corners, ``*_normal`` (3,) the unit normals,
    ``tolerance`` is absolute, ``work`` is a (4, m, 3) scratch array.  Returns -1 if ``work`` is too
    small.
    """
    # All coordinates relative to one corner, so that far-away pairs lose no digits.
    ox, oy, oz = corners_q[q0, 0], corners_q[q0, 1], corners_q[q0, 2]
    size = 0.0
    a, b, c, d = work[0], work[1], work[2], work[3]
    m = p1 - p0
    k = q1 - q0
    if m > a.shape[0] or k > b.shape[0]:
        return -1.0
    for i in range(m):
        a[i, 0], a[i, 1], a[i, 2] = corners_p[p0 + i, 0] - ox, corners_p[p0 + i, 1] - oy, corners_p[p0 + i, 2] - oz
        size = max(size, abs(a[i, 0]), abs(a[i, 1]), abs(a[i, 2]))
    for i in range(k):
        b[i, 0], b[i, 1], b[i, 2] = corners_q[q0 + i, 0] - ox, corners_q[q0 + i, 1] - oy, corners_q[q0 + i, 2] - oz
        size = max(size, abs(b[i, 0]), abs(b[i, 1]), abs(b[i, 2]))
    near = 1e-13 * size
    height = np_normal[0] * a[0, 0] + np_normal[1] * a[0, 1] + np_normal[2] * a[0, 2]
    m2 = clip_by_plane(a, m, nq_normal[0], nq_normal[1], nq_normal[2], 0.0, near, c)
    if m2 <= 0:
        return 0.0 if m2 == 0 else -1.0
    k2 = clip_by_plane(b, k, np_normal[0], np_normal[1], np_normal[2], height, near, d)
    if k2 <= 0:
        return 0.0 if k2 == 0 else -1.0
    return contour_integral(c, m2, d, k2, tolerance)


def polygon_to_polygon(
    sender: ArrayLike,
    receiver: ArrayLike,
    *,
    sender_holes: Sequence[ArrayLike] = (),
    receiver_holes: Sequence[ArrayLike] = (),
    error: float = 1e-11,
) -> float:
    """Form factor F from one polygon to another, unoccluded: the share of what leaves ``sender``.

    Right for touching and nearly touching pairs, far pairs (no cancellation), slivers, concave
    polygons, and pairs that cut each other's horizon.

    Parameters
    ----------
    sender, receiver : (m, 3) float
        Planar simple polygons, counter-clockwise from the sides that exchange light.
    sender_holes, receiver_holes : sequence of (m, 3) float
        Rings cut out.
    error : float
        Wanted error, relative to the larger of F and the polygons' smallest possible exchange;
        rounding limits it to about 1e-13.

    Returns
    -------
    float
        F_sender-receiver. [dimensionless, 0..1]

    Raises
    ------
    InputError
        If a polygon has no area, is not planar or crosses itself, or ``error`` is not positive.

    Notes
    -----
    Contour double integral (E. M. Sparrow 1963) over the convex pieces, see
    :mod:`radiosity.form_factors._contour`; reciprocity ``A_1 F_12 = A_2 F_21`` holds exactly.
    """
    if not error > 0:
        raise InputError(f"error: found {error!r}, expected a positive number such as 1e-9")
    pieces_p, normal_p, area_p = _as_pieces(sender, sender_holes, "sender")
    pieces_q, normal_q, _ = _as_pieces(receiver, receiver_holes, "receiver")
    work = np.empty((4, _MAX_CORNERS, 3))
    while max(len(piece) for piece in pieces_p + pieces_q) * 2 > work.shape[1]:
        work = np.empty((4, work.shape[1] * 2, 3))

    def exchange(tolerance: float) -> float:
        return math.fsum(
            pair_exchange(p, 0, len(p), normal_p, q, 0, len(q), normal_q, tolerance, work)
            for p in pieces_p
            for q in pieces_q
        )

    pairs = len(pieces_p) * len(pieces_q)
    rough = exchange(1e-6 * area_p)
    if rough == 0.0:
        return 0.0
    fine = exchange(max(error * rough / pairs, 1e-300))
    return min(fine / area_p, 1.0)


def crossed_strings(first: ArrayLike, second: ArrayLike) -> float:
    """Form factor between two infinitely long strips, by Hottel's crossed strings.

    Parameters
    ----------
    first, second : (2, 2) float
        End points of each strip in its cross-section, such that ``first[0]-second[1]`` and
        ``first[1]-second[0]`` do not cross each other (the uncrossed strings).

    Returns
    -------
    float
        F_first-second of strips that see each other whole. [dimensionless]

    Notes
    -----
    H. C. Hottel and A. F. Sarofim, Radiative Transfer (1967), ch. 2.
    """
    a, b = (np.asarray(s, dtype=np.float64) for s in (first, second))
    if a.shape != (2, 2) or b.shape != (2, 2):
        raise InputError(f"strips: found shapes {a.shape} and {b.shape}, expected (2, 2) each")
    length = float(np.hypot(*(a[1] - a[0])))
    if not length > 0:
        raise InputError("first: found a strip of width zero, expected a positive width")
    strings = [float(np.hypot(*(a[i] - b[j]))) for i in (0, 1) for j in (0, 1)]
    direct, crossed = sorted([strings[0] + strings[3], strings[1] + strings[2]])
    return (crossed - direct) / (2.0 * length)
