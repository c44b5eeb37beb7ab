"""Closed forms for what leaves one polygon and reaches a point or another polygon, unoccluded."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from radiosity.form_factors._contour import area_integral, contour_integral
from workbench.arrays import as_points, as_unit_vectors
from workbench.errors import InputError
from workbench.geometry.lambert import lambert_piece
from workbench.geometry.planes import clip_by_plane
from workbench.geometry.polygons import check_polygon, convex_pieces, vector_area

__all__ = ["crossed_strings", "disk_to_disk", "pair_exchange", "point_to_polygon", "polygon_to_polygon"]

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
def _point_to_piece(points, normals, piece, nx, ny, nz, reach, one_sided, out):
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        height = (x - piece[0, 0]) * nx + (y - piece[0, 1]) * ny + (z - piece[0, 2]) * nz
        if height > 1e-15 * reach or (height < -1e-15 * reach and not one_sided):
            share = lambert_piece(x, y, z, normals[i, 0], normals[i, 1], normals[i, 2], piece, 0, piece.shape[0])
            # The formula's sign tells which side is seen.
            out[i] += max(share if height > 0.0 else -share, 0.0)


def point_to_polygon(
    points: ArrayLike,
    normals: ArrayLike,
    polygon: ArrayLike,
    holes: Sequence[ArrayLike] = (),
    *,
    one_sided: bool = False,
) -> FloatArray:
    """Form factor from points (differential elements) to a polygon, unoccluded.

    Lambert's formula over the part of the polygon above each point's horizon; zero for points
    in the polygon's plane.

    Parameters
    ----------
    points, normals : (n, 3) float
        Receiving points and their normals (any length but zero).
    polygon : (m, 3) float
        Planar simple polygon, convex or not, in either direction.
    holes : sequence of (m, 3) float
        Rings cut out of the polygon, in either direction.
    one_sided : bool
        Whether the polygon counts only for points in front of it, from where its corners run
        counter-clockwise.

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
        _point_to_piece(points, normals, piece, normal[0], normal[1], normal[2], reach, one_sided, out)
    return np.minimum(out, 1.0)


@njit(nogil=True, cache=True)
def _clip_pair(corners_p, p0, p1, np_normal, corners_q, q0, q1, nq_normal, work):
    """Clip two convex polygons, each by the other's plane, into ``work[2]`` and ``work[3]``.

    Returns the corners left of each; 0 if nothing is left, -1 if ``work`` is too small.
    """
    # All coordinates relative to one corner, so that far-away pairs lose no digits.
    ox, oy, oz = corners_q[q0, 0], corners_q[q0, 1], corners_q[q0, 2]
    size = 0.0
    a, b, c, d = work[0], work[1], work[2], work[3]
    m = p1 - p0
    k = q1 - q0
    if m > a.shape[0] or k > b.shape[0]:
        return -1, -1
    for i in range(m):
        a[i, 0], a[i, 1], a[i, 2] = corners_p[p0 + i, 0] - ox, corners_p[p0 + i, 1] - oy, corners_p[p0 + i, 2] - oz
        size = max(size, abs(a[i, 0]), abs(a[i, 1]), abs(a[i, 2]))
    for i in range(k):
        b[i, 0], b[i, 1], b[i, 2] = corners_q[q0 + i, 0] - ox, corners_q[q0 + i, 1] - oy, corners_q[q0 + i, 2] - oz
        size = max(size, abs(b[i, 0]), abs(b[i, 1]), abs(b[i, 2]))
    near = ON_PLANE * size
    height = np_normal[0] * a[0, 0] + np_normal[1] * a[0, 1] + np_normal[2] * a[0, 2]
    m2 = clip_by_plane(a, m, nq_normal[0], nq_normal[1], nq_normal[2], 0.0, near, c)
    k2 = clip_by_plane(b, k, np_normal[0], np_normal[1], np_normal[2], height, near, d)
    return m2, k2


@njit(nogil=True, cache=True)
def pair_exchange(corners_p, p0, p1, np_normal, corners_q, q0, q1, nq_normal, tolerance, work):
    """Exchange area ``A_P F_PQ`` of two convex polygons, each clipped by the other's plane.

    ``corners_p[p0:p1]`` and ``corners_q[q0:q1]`` are the corners, ``*_normal`` (3,) the unit normals,
    ``tolerance`` is absolute, ``work`` is a (4, m, 3) scratch array.  Returns -1 if ``work`` is too
    small.
    """
    m, k = _clip_pair(corners_p, p0, p1, np_normal, corners_q, q0, q1, nq_normal, work)
    if m < 0 or k < 0:
        return -1.0
    if m == 0 or k == 0:
        return 0.0
    return contour_integral(work[2], m, work[3], k, tolerance)[0]


@njit(nogil=True, cache=True)
def _best_exchange(p, np_normal, p_smaller, q, nq_normal, tolerance, work):
    """Exchange area by the contour integral, or by area if rounding spoils that; the error left."""
    m, k = _clip_pair(p, 0, p.shape[0], np_normal, q, 0, q.shape[0], nq_normal, work)
    if m <= 0 or k <= 0:
        return 0.0, 0.0
    value, rounding = contour_integral(work[2], m, work[3], k, tolerance)
    if rounding <= tolerance:
        return value, rounding
    # Lambert's formula keeps its digits best when the larger of the two is what a point sees.
    if p_smaller:
        other, error = area_integral(work[2], m, work[3], k, tolerance)
    else:
        other, error = area_integral(work[3], k, work[2], m, tolerance)
    # A rule can miss a narrow peak and not know it; the contour integral would tell.
    if error < rounding and abs(other - value) <= 4.0 * rounding:
        return other, error
    return value, rounding


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
    polygons, and pairs that cut each other's horizon.  Only fronts exchange light: back to front gives 0.

    Parameters
    ----------
    sender, receiver : (m, 3) float
        Planar simple polygons, counter-clockwise from the sides that exchange light.
    sender_holes, receiver_holes : sequence of (m, 3) float
        Rings cut out.
    error : float
        Wanted error, relative to F.  Rounding limits it to about 1e-13, and to 1e-9 for polygons a
        hundred thousand times as long as wide.

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
    pieces_q, normal_q, area_q = _as_pieces(receiver, receiver_holes, "receiver")
    work = np.empty((4, _MAX_CORNERS, 3))
    while max(len(piece) for piece in pieces_p + pieces_q) * 2 > work.shape[1]:
        work = np.empty((4, work.shape[1] * 2, 3))

    pairs = [(p, q) for p in pieces_p for q in pieces_q]

    def exchange(tolerance: float) -> float:
        return math.fsum(
            _best_exchange(p, normal_p, area_p <= area_q, q, normal_q, tolerance, work)[0] for p, q in pairs
        )

    # A rough value first, to turn the relative error into an absolute one.
    rough = exchange(1e-6 * min(area_p, area_q))
    if rough == 0.0:
        return 0.0
    fine = exchange(max(error * rough / len(pairs), 1e-300))
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


def disk_to_disk(radius_1: float, radius_2: float, distance: float) -> float:
    """Form factor between two parallel disks on one axis that face each other.

    Parameters
    ----------
    radius_1, radius_2 : float
        Of the sending and of the receiving disk. [scene lengths]
    distance : float
        Between their planes. [scene lengths]

    Returns
    -------
    float
        F_1-2. [dimensionless, 0..1]

    Raises
    ------
    InputError
        If a length is not positive.

    Notes
    -----
    J. R. Howell, A Catalog of Radiation Heat Transfer Configuration Factors, C-41, written without
    the difference of two nearly equal numbers that spoils it for far disks.
    """
    for name, value in (("radius_1", radius_1), ("radius_2", radius_2), ("distance", distance)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name}: found {value}, expected a positive length")
    one, two = radius_1 / distance, radius_2 / distance
    # C-41 is (x - root) / 2 with root = sqrt(x^2 - 4 (two / one)^2); here (x - root)(x + root) is divided
    # by x + root, and the root's factors are written as squares.
    x = (one * one + two * two + 1.0) / (one * one)
    root = math.sqrt(((one - two) ** 2 + 1.0) * ((one + two) ** 2 + 1.0)) / (one * one)
    return min(2.0 * (two / one) ** 2 / (x + root), 1.0)
