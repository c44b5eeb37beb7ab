"""Maps from the unit square to lights and hemispheres, each beside its density.

``square_to_X(u, ...)`` takes points ``(..., 2)`` of [0, 1)^2 to X and preserves area: uniform
points give samples of density ``X_density(samples, ...)``, per area or per solid angle.  All maps
are continuous but for seams, so well-spread points stay well spread.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.errors import InputError
from workbench.geometry.polygons import vector_area

__all__ = [
    "cap_density",
    "cosine_hemisphere_density",
    "disk_density",
    "polygon_density",
    "solid_angle",
    "spherical_triangle_density",
    "square_to_cap",
    "square_to_cosine_hemisphere",
    "square_to_disk",
    "square_to_polygon",
    "square_to_spherical_triangle",
    "square_to_triangle",
    "triangle_density",
]

FloatArray = NDArray[np.float64]

_ON_EDGE = 1e-12


def _square(u: ArrayLike) -> FloatArray:
    array = np.asarray(u, dtype=np.float64)
    if array.ndim < 1 or array.shape[-1] != 2 or not ((array >= 0.0) & (array <= 1.0)).all():
        raise InputError(f"u: found shape {array.shape}, expected (..., 2) values from 0 to 1")
    return array


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.einsum("...i,...i->...", a, b)


def _unit(a: FloatArray) -> FloatArray:
    length = np.sqrt(_dot(a, a))
    return a / np.where(length > 0.0, length, 1.0)[..., None]


def square_to_disk(u: ArrayLike) -> FloatArray:
    """Uniform points (..., 2) of the unit disk, squares to rings.

    Source: P. Shirley and K. Chiu, "A low distortion map between disk and square" (JGT 2(3), 1997).
    """
    offset = 2.0 * _square(u) - 1.0
    x, y = offset[..., 0], offset[..., 1]
    wide = np.abs(x) > np.abs(y)
    radius = np.where(wide, x, y)
    ratio = np.where(wide, y, x) / np.where(radius != 0.0, radius, 1.0)
    angle = np.where(wide, 0.25 * np.pi * ratio, 0.5 * np.pi - 0.25 * np.pi * ratio)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def disk_density(points: ArrayLike) -> FloatArray:
    """Density (...) of :func:`square_to_disk` at points (..., 2), per area: 1/pi on the disk."""
    place = np.asarray(points, dtype=np.float64)
    return np.where(_dot(place, place) <= 1.0 + _ON_EDGE, 1.0 / np.pi, 0.0)


def square_to_cosine_hemisphere(u: ArrayLike) -> FloatArray:
    """Unit directions (..., 3) about +z, as dense as the cosine to it (Malley's method)."""
    flat = square_to_disk(u)
    up = np.sqrt(np.clip(1.0 - _dot(flat, flat), 0.0, None))
    return np.concatenate([flat, up[..., None]], axis=-1)


def cosine_hemisphere_density(directions: ArrayLike) -> FloatArray:
    """Density (...) of :func:`square_to_cosine_hemisphere`, per solid angle: cos/pi. [1/sr]"""
    return np.clip(np.asarray(directions, dtype=np.float64)[..., 2], 0.0, None) / np.pi


def square_to_triangle(u: ArrayLike, corners: ArrayLike) -> FloatArray:
    """Uniform points (..., 3) of a triangle ``corners`` (3, 3); u = (0, .) is its first corner."""
    square, triangle = _square(u), np.asarray(corners, dtype=np.float64)
    root = np.sqrt(square[..., :1])
    across = square[..., 1:]
    return triangle[0] + root * ((1.0 - across) * (triangle[1] - triangle[0]) + across * (triangle[2] - triangle[0]))


def triangle_density(points: ArrayLike, corners: ArrayLike) -> FloatArray:
    """Density (...) of :func:`square_to_triangle`, per area; points (..., 3) lie in its plane."""
    return polygon_density(points, corners)


def _fan(corners: ArrayLike) -> tuple[FloatArray, FloatArray]:
    ring = np.asarray(corners, dtype=np.float64)
    if ring.ndim != 2 or ring.shape[1] != 3 or len(ring) < 3:
        raise InputError(f"corners: found shape {ring.shape}, expected (n, 3) with n of 3 or more")
    area = 0.5 * np.linalg.norm(np.cross(ring[1:-1] - ring[0], ring[2:] - ring[0]), axis=1)
    if not area.sum() > 0.0:
        raise InputError("corners: found a polygon of zero area")
    return ring, area


def square_to_polygon(u: ArrayLike, corners: ArrayLike) -> FloatArray:
    """Uniform points (..., 3) of a convex polygon (n, 3).

    A parallelogram is one affine map of the square.  Any other polygon is the fan of triangles from
    its first corner, each taking a strip of ``u[0]`` as wide as its share of the area.
    """
    square = _square(u)
    ring, area = _fan(corners)
    if len(ring) == 4:
        a, b, c = ring[1:] - ring[0]
        if np.abs(b - a - c).max() <= _ON_EDGE * np.abs(ring - ring[0]).max():
            return ring[0] + square[..., :1] * a + square[..., 1:] * c
    index, inner = _strips(square[..., 0], area)
    root, across = np.sqrt(inner)[..., None], square[..., 1:]
    return ring[0] + root * ((1.0 - across) * (ring[1:-1] - ring[0])[index] + across * (ring[2:] - ring[0])[index])


def _strips(u: FloatArray, sizes: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
    # Which of the strips of [0, 1), as wide as their shares, holds u, and where in it.
    upper = np.cumsum(sizes) / sizes.sum()
    index = np.minimum(np.searchsorted(upper, u, side="right"), len(sizes) - 1)
    lower = np.concatenate([[0.0], upper[:-1]])[index]
    width = (upper - np.concatenate([[0.0], upper[:-1]]))[index]
    return index, np.clip((u - lower) / np.where(width > 0.0, width, 1.0), 0.0, 1.0)


def polygon_density(points: ArrayLike, corners: ArrayLike) -> FloatArray:
    """Density (...) of :func:`square_to_polygon`, per area: 1/area inside, 0 outside.

    Points (..., 3) lie in the plane of the convex polygon (n, 3).
    """
    place = np.asarray(points, dtype=np.float64)
    ring, _ = _fan(corners)
    vector = vector_area(ring)
    area = float(np.linalg.norm(vector))
    size = np.abs(ring - ring[0]).max()
    inside = np.ones(place.shape[:-1], dtype=bool)
    for corner, following in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        inward = np.cross(vector / area, following - corner)
        inside &= (place - corner) @ inward >= -_ON_EDGE * size * np.linalg.norm(inward)
    return np.where(inside, 1.0 / area, 0.0)


def solid_angle(a: ArrayLike, b: ArrayLike, c: ArrayLike) -> FloatArray:
    """Solid angle (...) of spherical triangles with unit corners (..., 3), whatever their winding. [sr]

    Source: A. van Oosterom and J. Strackee, "The solid angle of a plane triangle" (IEEE Trans.
    Biomed. Eng. 30(2), 1983); the determinant is taken of edges, which keeps small ones exact.
    """
    a, b, c = (np.asarray(x, dtype=np.float64) for x in (a, b, c))
    volume = np.abs(_dot(a, np.cross(b - a, c - a)))
    return 2.0 * np.arctan2(volume, 1.0 + _dot(a, b) + _dot(b, c) + _dot(c, a))


def square_to_spherical_triangle(u: ArrayLike, a: ArrayLike, b: ArrayLike, c: ArrayLike) -> FloatArray:
    """Directions (..., 3), uniform by solid angle on spherical triangles with unit corners (..., 3).

    Source: J. Arvo, "Stratified sampling of spherical triangles" (SIGGRAPH 1995).  The corner c' on
    the side a-c that leaves the share u[0] of the solid angle is found by the half-angle form of
    :func:`solid_angle` instead of Arvo's sines and cosines of angles,

        tan(E/2) = k t / (1 + a.b + t b.d),  t = tan(s/2),  c' = a cos s + d sin s,  k = |a, b, d|,

    which keeps its digits on small triangles and slivers.
    """
    square = _square(u)
    a, b, c = (np.asarray(x, dtype=np.float64) for x in (a, b, c))
    side = c - a
    d = _unit(side - _dot(a, side)[..., None] * a)
    half = 0.5 * square[..., 0] * solid_angle(a, b, c)
    volume = np.abs(_dot(a, np.cross(b - a, d)))
    arc = 2.0 * np.arctan2(np.sin(half) * (1.0 + _dot(a, b)), np.cos(half) * volume - np.sin(half) * _dot(b, d))
    moved = np.cos(arc)[..., None] * a + np.sin(arc)[..., None] * d
    # Along the arc b-c', 1 - cos is uniform: sin(theta/2)^2 = u[1] sin(theta'/2)^2.
    chord = moved - b
    sine = np.sqrt(square[..., 1]) * 0.5 * np.sqrt(_dot(chord, chord))
    tangent = _unit(chord - _dot(b, chord)[..., None] * b)
    cosine = np.sqrt(np.clip(1.0 - sine * sine, 0.0, None))
    return (1.0 - 2.0 * sine * sine)[..., None] * b + (2.0 * sine * cosine)[..., None] * tangent


def spherical_triangle_density(directions: ArrayLike, a: ArrayLike, b: ArrayLike, c: ArrayLike) -> FloatArray:
    """Density (...) of :func:`square_to_spherical_triangle`, per solid angle. [1/sr]

    One over the solid angle inside, 0 outside.
    """
    place = np.asarray(directions, dtype=np.float64)
    a, b, c = (np.asarray(x, dtype=np.float64) for x in (a, b, c))
    sign = np.sign(_dot(a, np.cross(b - a, c - a)))
    inside = np.ones(np.broadcast_shapes(place.shape[:-1], a.shape[:-1]), dtype=bool)
    for p, q in ((a, b), (b, c), (c, a)):
        normal = np.cross(p, q - p)
        inside &= sign * _dot(place, normal) >= -_ON_EDGE * np.sqrt(_dot(normal, normal))
    return np.where(inside, 1.0 / solid_angle(a, b, c), 0.0)


def square_to_cap(u: ArrayLike, axis: ArrayLike, sine: ArrayLike) -> FloatArray:
    """Directions (..., 3), uniform by solid angle within an angle of ``axis``.

    Concentric squares become rings.  ``axis`` (..., 3) are unit vectors, ``sine`` (...) the sine of
    the half-angle, up to 90 degrees: R/d for a sphere of radius R at the distance d.
    """
    square = _square(u)
    centre = np.asarray(axis, dtype=np.float64)
    edge = np.asarray(sine, dtype=np.float64)
    flat = square_to_disk(square)
    # 1 - cos = r^2 (1 - cos_max), and 1 - cos_max = sine^2 / (1 + cos_max) keeps its digits.
    height = edge * edge / (1.0 + np.sqrt(np.clip(1.0 - edge * edge, 0.0, None)))
    fall = height * _dot(flat, flat)
    stretch = np.sqrt(height * np.clip(2.0 - fall, 0.0, None))
    # A right-handed frame about the axis without a branch that leaves a seam inside the cap.
    sign = np.copysign(1.0, centre[..., 2])
    x, y, z = centre[..., 0], centre[..., 1], centre[..., 2]
    p = -1.0 / (sign + z)
    q = x * y * p
    first = np.stack([1.0 + sign * x * x * p, sign * q, -sign * x], axis=-1)
    second = np.stack([q, sign + y * y * p, -y], axis=-1)
    return (
        (1.0 - fall)[..., None] * centre
        + (stretch * flat[..., 0])[..., None] * first
        + (stretch * flat[..., 1])[..., None] * second
    )


def cap_density(directions: ArrayLike, axis: ArrayLike, sine: ArrayLike) -> FloatArray:
    """Density (...) of :func:`square_to_cap`, per solid angle: 1 / (2 pi (1 - cos)) inside. [1/sr]"""
    place, centre = np.asarray(directions, dtype=np.float64), np.asarray(axis, dtype=np.float64)
    edge = np.asarray(sine, dtype=np.float64)
    height = edge * edge / (1.0 + np.sqrt(np.clip(1.0 - edge * edge, 0.0, None)))
    away = place - centre
    return np.where(0.5 * _dot(away, away) <= height * (1.0 + _ON_EDGE) + 1e-15, 1.0 / (2.0 * np.pi * height), 0.0)
