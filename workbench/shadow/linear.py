"""Linear lights in closed form: irradiance of a segment, whole or behind polygons, without rays.

The irradiance at a point is the integral of cos / r^2 along the light, times, for a Lambertian
line, the sine of the angle to its axis.  With ends a, b relative to the point and c their heights
over the receiver's plane, the isotropic segment of length l gives

    E = I l (c_a / |a| + c_b / |b|) / (|a| |b| + a . b),

a sum of terms that never cancel once the segment is clipped at the horizon (cf. K. Picott,
"Extensions of the Linear and Area Lighting Models", CG&A 1992; P. Poulin and J. Amanatides,
"Shading and Shadowing with Linear Light Sources", Eurographics 1990).

Occluders are exact too: a convex polygon cuts the light triangle (the point and both ends) in a
segment, whose shadow on the light is an interval.  What the union of these intervals leaves is
summed in closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from workbench.accel._intersect import END_ULPS, Objects, object_crossing, objects_of, ray_frame, ray_limits
from workbench.accel.base import as_skip_polygons
from workbench.accel.voxel_grid import blocks, share_out
from workbench.arrays import as_points, as_unit_vectors
from workbench.errors import InputError
from workbench.geometry.flat import Geometry

__all__ = ["LinearVisibility", "linear_irradiance", "visible_linear_irradiance"]

FloatArray = NDArray[np.float64]

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
_IN_LINE = 1e-14
_EPSILON = float(np.finfo(np.float64).eps)


@njit(nogil=True, cache=True)
def _isotropic(ax, ay, az, bx, by, bz, ca, cb, length):
    ra, rb = math.sqrt(ax * ax + ay * ay + az * az), math.sqrt(bx * bx + by * by + bz * bz)
    if ra == 0.0 or rb == 0.0:
        return math.inf
    dot = ax * bx + ay * by + az * bz
    if dot >= 0.0:
        below = ra * rb + dot
    else:  # the point is beside the light: |a| |b| + a . b would cancel
        px, py, pz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        below = (px * px + py * py + pz * pz) / (ra * rb - dot)
        if below == 0.0:
            return math.inf
    return length * (ca / ra + cb / rb) / below


@njit(nogil=True, cache=True)
def _lambertian_beside(h, va, vb, ca, cb, length):
    # The foot of the point's perpendicular lies on the segment: va <= 0 <= vb, terms add up.
    aa, bb = h * h + va * va, h * h + vb * vb
    whole = (math.atan2(vb, h) - math.atan2(va, h) + h * vb / bb - h * va / aa) / (2.0 * h * h)
    tilt = h * (vb * vb - va * va) / (2.0 * aa * bb)
    # Parts of the whole that belong to each end when height runs linearly from ca to cb.
    at_b = (tilt - va * whole) / length
    at_a = (vb * whole - tilt) / length
    return ca * at_a + cb * at_b


@njit(nogil=True, cache=True)
def _lambertian_aside(h, va, vb, ca, cb, length):
    # The foot lies outside: the closed form cancels, a Gauss rule over stretches no longer than
    # their distance is exact to rounding (its error falls as 4^-24).
    if vb < 0.0:
        va, vb, ca, cb = -vb, -va, cb, ca
    total = 0.0
    lower = va
    while lower < vb:
        upper = min(vb, lower + math.sqrt(h * h + lower * lower))
        if not upper > lower:
            break
        half, middle = 0.5 * (upper - lower), 0.5 * (upper + lower)
        for i in range(_NODES.shape[0]):
            v = middle + half * _NODES[i]
            share = (v - va) / length
            square = h * h + v * v
            total += half * _WEIGHTS[i] * h * ((1.0 - share) * ca + share * cb) / (square * square)
        lower = upper
    return total


@njit(nogil=True, cache=True)
def _stretch(point, normal, start, end, s0, s1, lambertian):
    """Irradiance from the part s0..s1 of a segment of unit intensity per length."""
    lx, ly, lz = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    ox, oy, oz = start[0] - point[0], start[1] - point[1], start[2] - point[2]
    c0 = ox * normal[0] + oy * normal[1] + oz * normal[2]
    rise = lx * normal[0] + ly * normal[1] + lz * normal[2]
    ca, cb = c0 + s0 * rise, c0 + s1 * rise
    if ca <= 0.0 and cb <= 0.0:
        return 0.0
    if ca < 0.0:
        s0, ca = min(max(-c0 / rise, s0), s1), 0.0
    elif cb < 0.0:
        s1, cb = min(max(-c0 / rise, s0), s1), 0.0
    whole = math.sqrt(lx * lx + ly * ly + lz * lz)
    length = whole * (s1 - s0)
    if length <= 0.0:
        return 0.0
    ax, ay, az = ox + s0 * lx, oy + s0 * ly, oz + s0 * lz
    bx, by, bz = ox + s1 * lx, oy + s1 * ly, oz + s1 * lz
    if not lambertian:
        return _isotropic(ax, ay, az, bx, by, bz, ca, cb, length)
    px, py, pz = oy * lz - oz * ly, oz * lx - ox * lz, ox * ly - oy * lx
    h = math.sqrt(px * px + py * py + pz * pz) / whole
    va = (ax * lx + ay * ly + az * lz) / whole
    vb = va + length
    if va < 0.0 < vb:
        return _lambertian_beside(h, va, vb, ca, cb, length) if h > 0.0 else math.inf
    return _lambertian_aside(h, va, vb, ca, cb, length)


@njit(nogil=True, cache=True)
def _irradiance(points, normals, start, end, lambertian, out):
    for row in range(points.shape[0]):
        out[row] = _stretch(points[row], normals[row], start, end, 0.0, 1.0, lambertian)


@njit(nogil=True, cache=True)
def _shadow(objects, piece, px, py, pz, a, b, normal, square, ra, rb, tolerance, interval):
    """Interval of the light, ``[0..1]``, that one piece hides from a point; False if none.

    ``a`` and ``b`` are the light's ends relative to the point, ``ra`` and ``rb`` their distances,
    ``normal`` is a x b and ``square`` its squared length.  Corners on the light's plane count as
    met, so pieces that share an edge or a corner leave no gap between their shadows.  What lies
    within ``tolerance`` of the point or of the light is rounding.
    """
    first, stop = objects.piece_start[piece], objects.piece_start[piece + 1]
    corners = objects.corners
    # Up to two ends of the cut, as shares (alpha, beta): q = alpha a + beta b.
    a0 = b0 = a1 = b1 = 0.0
    found = 0
    above = below = False
    qx, qy, qz = corners[stop - 1, 0] - px, corners[stop - 1, 1] - py, corners[stop - 1, 2] - pz
    dq = normal[0] * qx + normal[1] * qy + normal[2] * qz
    for corner in range(first, stop):
        cx, cy, cz = corners[corner, 0] - px, corners[corner, 1] - py, corners[corner, 2] - pz
        dc = normal[0] * cx + normal[1] * cy + normal[2] * cz
        above, below = above or dc > 0.0, below or dc < 0.0
        crosses = (dq < 0.0 < dc) or (dc < 0.0 < dq)
        if crosses or dc == 0.0:
            if crosses:
                gx = (dq * cx - dc * qx) / (dq - dc)
                gy = (dq * cy - dc * qy) / (dq - dc)
                gz = (dq * cz - dc * qz) / (dq - dc)
            else:
                gx, gy, gz = cx, cy, cz
            # alpha = (q x b) . n / n^2, beta = (a x q) . n / n^2
            alpha = (gy * b[2] - gz * b[1]) * normal[0] + (gz * b[0] - gx * b[2]) * normal[1]
            alpha = (alpha + (gx * b[1] - gy * b[0]) * normal[2]) / square
            beta = (a[1] * gz - a[2] * gy) * normal[0] + (a[2] * gx - a[0] * gz) * normal[1]
            beta = (beta + (a[0] * gy - a[1] * gx) * normal[2]) / square
            # A third point can only be one of a row of corners on the plane: keep the widest pair.
            if found == 0:
                a0, b0 = alpha, beta
            elif found == 1:
                a1, b1 = alpha, beta
            else:
                old = (a1 - a0) ** 2 + (b1 - b0) ** 2
                from0 = (alpha - a0) ** 2 + (beta - b0) ** 2
                from1 = (alpha - a1) ** 2 + (beta - b1) ** 2
                if from0 >= from1 and from0 > old:
                    a1, b1 = alpha, beta
                elif from1 > old:
                    a0, b0 = alpha, beta
            found += 1
        qx, qy, qz, dq = cx, cy, cz, dc
    if found < 2 or not (above or below):
        return False  # not met, met in a corner, or lying in the plane: edge on, it hides nothing
    # Clip the cut to the light triangle: alpha > 0, beta > 0, 0 < alpha + beta < 1.
    lower, upper = 0.0, 1.0
    # An end clipped by alpha = 0 or beta = 0 is an end of the light, s = 1 or 0, to the last digit;
    # one that was not clipped keeps its digits: the neighbour's shadow begins there.
    s0 = s1 = -1.0
    for side in range(4):
        if side == 0:
            f0, f1 = a0, a1
        elif side == 1:
            f0, f1 = b0, b1
        elif side == 2:
            f0, f1 = a0 * ra + b0 * rb - tolerance, a1 * ra + b1 * rb - tolerance
        else:
            f0 = (1.0 - a0 - b0) * max(ra, rb) - tolerance
            f1 = (1.0 - a1 - b1) * max(ra, rb) - tolerance
        if f0 < 0.0 and f1 < 0.0:
            return False
        end = 1.0 - side if side < 2 else -1.0
        if f0 < 0.0 and f0 / (f0 - f1) > lower:
            lower, s0 = f0 / (f0 - f1), end
        elif f1 < 0.0 and f0 / (f0 - f1) < upper:
            upper, s1 = f0 / (f0 - f1), end
    if not lower < upper:
        return False
    if s0 < 0.0:
        fa, fb = (a0, b0) if lower == 0.0 else (a0 + lower * (a1 - a0), b0 + lower * (b1 - b0))
        s0 = min(max(fb / (fa + fb), 0.0), 1.0)
    if s1 < 0.0:
        fa, fb = (a1, b1) if upper == 1.0 else (a0 + upper * (a1 - a0), b0 + upper * (b1 - b0))
        s1 = min(max(fb / (fa + fb), 0.0), 1.0)
    interval[0], interval[1] = min(s0, s1), max(s0, s1)
    return True


@njit(nogil=True, cache=True)
def _in_line(objects, pieces, skip, row, point, a, b, intervals):
    # The point lies on the light's line: one ray, and each crossing hides what is behind it.
    origin, direction = np.empty((1, 3)), np.empty((1, 3))
    ra = rb = 0.0
    for k in range(3):
        origin[0, k] = point[k]
        ra, rb = ra + a[k] * a[k], rb + b[k] * b[k]
    ra, rb = math.sqrt(ra), math.sqrt(rb)
    for k in range(3):
        direction[0, k] = a[k] if ra > rb else b[k]
    frame = ray_frame(direction, 0)
    near, limit = ray_limits(objects, origin, direction, 0, 1.0, frame[2])
    found = 0
    for place in range(pieces.shape[0]):
        owner = objects.owner[pieces[place]]
        if owner == skip[row, 0] or owner == skip[row, 1]:
            continue
        t, crossings = object_crossing(objects, pieces[place], origin, direction, 0, frame, near, limit, False)
        if crossings == 0:
            continue
        # Distance t |far end| along the line, as a share s of the way from a to b.
        s = (t * max(ra, rb) - ra) / (rb - ra)
        intervals[found, 0] = min(max(s, 0.0), 1.0) if rb > ra else 0.0
        intervals[found, 1] = 1.0 if rb > ra else min(max(s, 0.0), 1.0)
        found += 1
    return found


@njit(nogil=True, cache=True)
def _visible(objects, pieces, points, normals, start, end, lambertian, skip, irradiance, visible, intervals):
    a, b, normal = np.empty(3), np.empty(3), np.empty(3)
    for row in range(points.shape[0]):
        point = points[row]
        aa = bb = 0.0
        for k in range(3):
            a[k], b[k] = start[k] - point[k], end[k] - point[k]
            aa, bb = aa + a[k] * a[k], bb + b[k] * b[k]
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            normal[k] = a[i] * b[j] - a[j] * b[i]
        largest = max(objects.reach, np.abs(point).max(), np.abs(start).max(), np.abs(end).max())
        tolerance = END_ULPS * _EPSILON * largest
        square = normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2
        found = 0
        if square <= _IN_LINE * _IN_LINE * aa * bb:
            found = _in_line(objects, pieces, skip, row, point, a, b, intervals)
        else:
            for place in range(pieces.shape[0]):
                owner = objects.owner[pieces[place]]
                if owner == skip[row, 0] or owner == skip[row, 1]:
                    continue
                found += _shadow(
                    objects, pieces[place], point[0], point[1], point[2], a, b, normal, square,
                    math.sqrt(aa), math.sqrt(bb), tolerance, intervals[found],
                )  # fmt: skip
        order = np.argsort(intervals[:found, 0])
        reached = 0.0
        irradiance[row] = visible[row] = 0.0
        for place in range(found + 1):
            until = 1.0 if place == found else intervals[order[place], 0]
            if until > reached:
                irradiance[row] += _stretch(point, normals[row], start, end, reached, until, lambertian)
                visible[row] += until - reached
            if place < found:
                reached = max(reached, intervals[order[place], 1])


@dataclass(frozen=True)
class LinearVisibility:
    """A linear light seen past its occluders.

    Parameters
    ----------
    irradiance : (n,) float
        From the visible part. [intensity per length / length: W m-2]
    unoccluded : (n,) float
        From the whole light, clipped at the horizon.
    visible_length : (n,) float
        Share of the light's length that is not hidden, below the horizon or not: what equal
        weights converge to. [0..1]
    """

    irradiance: FloatArray
    unoccluded: FloatArray
    visible_length: FloatArray


def _checked(points: ArrayLike, normals: ArrayLike, start: ArrayLike, end: ArrayLike):
    place = as_points(points)
    normal = as_unit_vectors(normals)
    if len(normal) not in (1, len(place)):
        raise InputError(f"normals: found {len(normal)} rows, expected {len(place)}")
    ends = as_points(start, "start"), as_points(end, "end")
    if len(ends[0]) != 1 or len(ends[1]) != 1 or (ends[0] == ends[1]).all():
        raise InputError("start and end: expected two different points, the ends of one light")
    return place, np.ascontiguousarray(np.broadcast_to(normal, place.shape)), ends[0][0], ends[1][0]


def linear_irradiance(
    points: ArrayLike,
    normals: ArrayLike,
    start: ArrayLike,
    end: ArrayLike,
    intensity: float = 1.0,
    *,
    lambertian: bool = False,
) -> FloatArray:
    """Irradiance (n,) from an unoccluded linear light, exact.

    Parameters
    ----------
    points, normals : (n, 3) float
        Receivers; the part of the light below a receiver's horizon gives nothing.
    start, end : (3,) float
        Ends of the light.
    intensity : float
        Radiant intensity per length across the axis. [W sr-1 m-1]
    lambertian : bool
        Whether intensity falls with the sine of the angle to the axis; otherwise it is the same
        in all directions.

    Returns
    -------
    (n,) float
        Irradiance [W m-2]; ``inf`` at a point on the light.

    Raises
    ------
    InputError
        If shapes do not agree, a value is not finite or the light has no length.
    """
    place, normal, first, last = _checked(points, normals, start, end)
    out = np.empty(len(place))
    _irradiance(place, normal, first, last, lambertian, out)
    return intensity * out


def visible_linear_irradiance(
    geometry: Geometry,
    points: ArrayLike,
    normals: ArrayLike,
    start: ArrayLike,
    end: ArrayLike,
    intensity: float = 1.0,
    *,
    lambertian: bool = False,
    skip_polygons: ArrayLike | None = None,
    pieces: ArrayLike | None = None,
    workers: int = 1,
) -> LinearVisibility:
    """Irradiance from the part of a linear light that no polygon hides, exact, without rays.

    All polygons block, whatever their transmittance.  A polygon seen edge on, lying in the plane
    of the point and the light, hides nothing.

    Parameters
    ----------
    geometry : Geometry
        Occluders.
    points, normals, start, end, intensity, lambertian
        As in :func:`linear_irradiance`.
    skip_polygons : (n, 2) int, optional
        Polygons that do not count for that point, -1 for none.
    pieces : (k,) int, optional
        Convex pieces that may block, where a culler has found them; by default all.
    workers : int
        Threads.  The answer does not depend on it.

    Raises
    ------
    InputError
        If shapes do not agree, a value is not finite or an index is out of range.
    """
    place, normal, first, last = _checked(points, normals, start, end)
    skip = as_skip_polygons(skip_polygons, len(place))
    objects: Objects = objects_of(geometry)
    chosen = np.arange(geometry.piece_count) if pieces is None else np.asarray(pieces)
    if chosen.ndim != 1 or (chosen.size and not np.issubdtype(chosen.dtype, np.integer)):
        raise InputError(f"pieces: found shape {chosen.shape} of {chosen.dtype}, expected (k,) integers")
    if chosen.size and not 0 <= chosen.min() <= chosen.max() < geometry.piece_count:
        raise InputError(f"pieces: found an index outside 0..{geometry.piece_count - 1}")
    chosen = np.ascontiguousarray(chosen, dtype=np.int64)
    irradiance, visible, whole = (np.empty(len(place)) for _ in range(3))
    _irradiance(place, normal, first, last, lambertian, whole)

    def work(worker: int) -> NDArray[np.int64]:
        intervals = np.empty((len(chosen) + 1, 2))
        for rows in blocks(len(place), worker, workers):
            _visible(
                objects, chosen, place[rows], normal[rows], first, last, lambertian, skip[rows],
                irradiance[rows], visible[rows], intervals,
            )  # fmt: skip
        return np.zeros(1, dtype=np.int64)

    share_out(workers, work)
    return LinearVisibility(intensity * irradiance, intensity * whole, visible)
