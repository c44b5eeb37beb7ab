"""The one intersection routine of the instrument, in double precision, as kernels.

Source: S. Woop, C. Benthin and I. Wald, "Watertight Ray/Triangle Intersection" (JCGT 2(1), 2013).
A corner's place in the plane across the ray depends on the corner and the ray alone, and an edge
function, a difference of two rounded products, has the right sign or is zero.  Zero counts as
inside, so no ray slips between polygons that share an edge or a corner.

Departures from the paper: convex polygons are fans of triangles; t of a triangle seen almost edge
on comes from its longest edge, so that a hit always lies within about 2^-23 of the polygon's size
from both the ray and the polygon; and for transparent polygons a zero is decided by moving the
ray a hair (the fill rule of rasterisers), so that a shared edge is crossed once, not twice.

Brute force and the voxel grid call the same routine: their answers agree bit for bit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from workbench.errors import InputError
from workbench.geometry.flat import Geometry

__all__ = ["Objects", "object_crossing", "objects_of", "ray_frame", "ray_limits"]

END_ULPS = 64.0
"""Crossings this near a ray's end, in units in the last place of the largest coordinate in the
scene, are rounding of the end: a point on an edge of the floor does not shadow itself."""

_EDGE_ON = 2.0**-26
_OFF_EDGE = 2.0**-24
_BEYOND = 2.0**-48
_EPSILON = float(np.finfo(np.float64).eps)


class Objects(NamedTuple):
    """What rays are tested against: convex pieces first, exact spheres after them.

    ``corners`` (k, 3) and ``piece_start`` (p + 1,) as in :class:`~workbench.geometry.flat.Geometry`;
    ``spheres`` (s, 4) hold centre and radius; ``owner`` (p + s,) is the polygon index to report;
    ``bounds`` (p + s, 2, 3); ``clear`` (p + s, bands) the transmittances, all zero if opaque;
    ``reach`` is the largest coordinate.
    """

    corners: NDArray[np.float64]
    piece_start: NDArray[np.int64]
    spheres: NDArray[np.float64]
    owner: NDArray[np.int64]
    bounds: NDArray[np.float64]
    clear: NDArray[np.float64]
    reach: float


def objects_of(geometry: Geometry, spheres: ArrayLike | None = None) -> Objects:
    """The pieces of a geometry and exact opaque spheres, rows (x, y, z, radius).

    Raises
    ------
    InputError
        If ``spheres`` is not an (n, 4) array of finite numbers with positive radii.
    """
    balls = np.empty((0, 4)) if spheres is None else np.atleast_2d(np.asarray(spheres, dtype=np.float64))
    if balls.ndim != 2 or balls.shape[1] != 4:
        raise InputError(f"spheres: found shape {balls.shape}, expected (n, 4) rows of centre and radius")
    if not (np.isfinite(balls).all() and (balls[:, 3] > 0.0).all()):
        raise InputError("spheres: found a value that is not finite or a radius that is not positive")
    radius = balls[:, 3:]
    materials = geometry.surface_material
    bands = materials[0].transmittance.size if materials else 1
    clear = np.zeros((geometry.piece_count + len(balls), bands))
    if materials:
        by_surface = np.stack([material.transmittance for material in materials])
        clear[: geometry.piece_count] = by_surface[geometry.polygon_surface[geometry.piece_polygon]]
    bounds = np.concatenate([geometry.piece_bounds, np.stack([balls[:, :3] - radius, balls[:, :3] + radius], axis=1)])
    return Objects(
        corners=np.ascontiguousarray(geometry.corners),
        piece_start=np.ascontiguousarray(geometry.piece_start),
        spheres=np.ascontiguousarray(balls),
        owner=np.concatenate([geometry.piece_polygon, geometry.polygon_count + np.arange(len(balls))]),
        bounds=bounds,
        clear=clear,
        reach=float(np.abs(bounds).max(initial=0.0)),
    )


@njit(nogil=True, cache=True)
def ray_frame(directions, ray):
    """Axes and shear that look along a ray: (kx, ky, kz, sx, sy, sz), kz its largest component."""
    x, y, z = abs(directions[ray, 0]), abs(directions[ray, 1]), abs(directions[ray, 2])
    kz = 2
    if x >= y and x >= z:
        kz = 0
    elif y >= z:
        kz = 1
    kx, ky = (kz + 1) % 3, (kz + 2) % 3
    along = directions[ray, kz]
    return kx, ky, kz, directions[ray, kx] / along, directions[ray, ky] / along, 1.0 / along


@njit(nogil=True, cache=True)
def ray_limits(objects, origins, directions, ray, far, kz):
    """The open interval of t that counts: END_ULPS of the coordinates inside both ends."""
    start = end = objects.reach
    for k in range(3):
        start = max(start, abs(origins[ray, k]))
        end = max(end, abs(origins[ray, k] + far * directions[ray, k])) if far < math.inf else 0.0
    ulp = END_ULPS * _EPSILON / abs(directions[ray, kz])
    return start * ulp, far - end * ulp


@njit(nogil=True, cache=True, inline="always")
def _tie(px, py, qx, qy):
    # Sign of the edge function of p-q at (e, e^2), e -> 0; it turns when the edge is turned.
    return py - qy if py != qy else qx - px


@njit(nogil=True, cache=True)
def _along_edge(px, py, pz, qx, qy, qz):
    # Depth of the point of the edge p-q that is nearest the ray; inf if the ray passes beyond the
    # edge's ends or beside it: rounding may make all edge functions zero for corners in a row.
    ex, ey = qx - px, qy - py
    square = ex * ex + ey * ey
    share = -(px * ex + py * ey) / square
    x, y = px + share * ex, py + share * ey
    if not -_BEYOND <= share <= 1.0 + _BEYOND or x * x + y * y > _OFF_EDGE * _OFF_EDGE * square:
        return math.inf
    return pz + min(max(share, 0.0), 1.0) * (qz - pz)


@njit(nogil=True, cache=True)
def _triangle_depth(ax, ay, az, bx, by, bz, cx, cy, cz, u, v, w, total):
    # Depth where the ray meets a triangle that its edge functions accept; inf if it does not.
    aa, bb, cc = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
    if abs(total) >= _EDGE_ON * max(aa, bb, cc):
        return (u * az + v * bz + w * cz) / total
    ab = (bx - ax) ** 2 + (by - ay) ** 2
    bc = (cx - bx) ** 2 + (cy - by) ** 2
    ca = (ax - cx) ** 2 + (ay - cy) ** 2
    if ab >= bc and ab >= ca:
        return _along_edge(ax, ay, az, bx, by, bz)
    if bc >= ca:
        return _along_edge(bx, by, bz, cx, cy, cz)
    return _along_edge(cx, cy, cz, ax, ay, az)


@njit(nogil=True, cache=True)
def _piece_crossing(objects, piece, origins, ray, frame, near, far, once):
    kx, ky, kz, sx, sy, sz = frame
    corners = objects.corners
    first, stop = objects.piece_start[piece], objects.piece_start[piece + 1]
    ox, oy, oz = origins[ray, kx], origins[ray, ky], origins[ray, kz]
    az = corners[first, kz] - oz
    ax, ay = corners[first, kx] - ox - sx * az, corners[first, ky] - oy - sy * az
    bz = corners[first + 1, kz] - oz
    bx, by = corners[first + 1, kx] - ox - sx * bz, corners[first + 1, ky] - oy - sy * bz
    w = bx * ay - by * ax
    best = math.inf
    for corner in range(first + 2, stop):
        cz = corners[corner, kz] - oz
        cx, cy = corners[corner, kx] - ox - sx * cz, corners[corner, ky] - oy - sy * cz
        u = cx * by - cy * bx
        v = ax * cy - ay * cx
        if once:
            su = u if u != 0.0 else _tie(cx, cy, bx, by)
            sv = v if v != 0.0 else _tie(ax, ay, cx, cy)
            sw = w if w != 0.0 else _tie(bx, by, ax, ay)
        else:
            su, sv, sw = u, v, w
        if (su >= 0.0 and sv >= 0.0 and sw >= 0.0) or (su <= 0.0 and sv <= 0.0 and sw <= 0.0):
            total = u + v + w
            if total != 0.0:  # zero: seen exactly edge on, it hides nothing
                depth = _triangle_depth(ax, ay, az, bx, by, bz, cx, cy, cz, u, v, w, total)
                t = sz * depth
                if depth < math.inf and near < t < far and t < best:
                    best = t
        bx, by, bz, w = cx, cy, cz, -v
    return best


@njit(nogil=True, cache=True)
def _sphere_crossing(objects, sphere, origins, directions, ray, near, far):
    # First crossing in (near, far) and how many there are; a tangent ray crosses nothing.
    # E. Haines et al., "Precision Improvements for Ray/Sphere Intersection" (Ray Tracing Gems, 2019).
    dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
    fx = origins[ray, 0] - objects.spheres[sphere, 0]
    fy = origins[ray, 1] - objects.spheres[sphere, 1]
    fz = origins[ray, 2] - objects.spheres[sphere, 2]
    radius = objects.spheres[sphere, 3]
    square = dx * dx + dy * dy + dz * dz
    ahead = -(fx * dx + fy * dy + fz * dz)
    share = ahead / square
    lx, ly, lz = fx + share * dx, fy + share * dy, fz + share * dz
    inside = radius * radius - (lx * lx + ly * ly + lz * lz)
    if not inside > 0.0:
        return math.inf, 0
    q = ahead + math.copysign(math.sqrt(square * inside), ahead)
    t1 = (fx * fx + fy * fy + fz * fz - radius * radius) / q
    t2 = q / square
    if t1 > t2:
        t1, t2 = t2, t1
    crossings = 0
    first = math.inf
    if near < t2 < far:
        crossings, first = 1, t2
    if near < t1 < far:
        crossings, first = crossings + 1, t1
    return first, crossings


@njit(nogil=True, cache=True)
def object_crossing(objects, index, origins, directions, ray, frame, near, far, once):
    """First crossing of one object with ``near < t < far``, ``inf`` if none, and the number of crossings.

    With ``once``, a ray through an edge or corner that polygons share crosses exactly one of them;
    without, at least one.
    """
    pieces = objects.piece_start.shape[0] - 1
    if index >= pieces:
        return _sphere_crossing(objects, index - pieces, origins, directions, ray, near, far)
    t = _piece_crossing(objects, index, origins, ray, frame, near, far, once)
    return t, 1 if t < math.inf else 0
