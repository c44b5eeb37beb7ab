"""Polygons: normals, areas, planarity, and the cutting of concave ones into convex pieces."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from workbench.errors import InputError

__all__ = [
    "are_convex",
    "check_polygon",
    "convex_pieces",
    "fan_triangles",
    "is_convex",
    "plane_basis",
    "triangulate_ring",
    "vector_area",
]

FloatArray = NDArray[np.float64]

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]

PLANARITY = 1e-5
"""Largest distance of a vertex from its polygon's plane, as a share of the polygon's size."""


def vector_area(rings: Sequence[FloatArray] | FloatArray) -> FloatArray:
    """Vector area (3,) of a polygon with holes: its length is the area, its direction the normal.

    Newell's sum, taken about the first vertex so that far-away polygons lose no digits.
    """
    if isinstance(rings, np.ndarray):
        rings = [rings]
    origin = rings[0][0]
    total = np.zeros(3)
    for ring in rings:
        # Written out: numpy's cross and roll take ten times as long on a few vertices.
        moved = ring - origin
        onward = np.concatenate([moved[1:], moved[:1]])
        turned = moved[:, _NEXT] * onward[:, _LAST] - moved[:, _LAST] * onward[:, _NEXT]
        total += 0.5 * turned.sum(axis=0)
    return total


def plane_basis(normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors (3,) that make a right-handed frame with the unit ``normal``."""
    # Written out: numpy takes thirty times as long on one vector.
    x, y, z = normal.tolist()
    least = min(abs(x), abs(y), abs(z))
    a, b, c = (0.0, -z, y) if abs(x) == least else (z, 0.0, -x) if abs(y) == least else (-y, x, 0.0)
    scale = 1.0 / math.sqrt(a * a + b * b + c * c)
    a, b, c = a * scale, b * scale, c * scale
    return np.array([a, b, c]), np.array([y * c - z * b, z * a - x * c, x * b - y * a])


def are_convex(rings: FloatArray, normals: FloatArray) -> NDArray[np.bool_]:
    """Whether each ring of (f, n, 3) turns the same way at each corner; collinear corners are allowed.

    ``normals`` (f, 3) point to where the rings go counter-clockwise.
    """
    onward = np.concatenate([np.arange(1, rings.shape[1]), [0]])
    edge = rings[:, onward] - rings
    following = edge[:, onward]
    crossed = edge[..., _NEXT] * following[..., _LAST] - edge[..., _LAST] * following[..., _NEXT]
    turn = np.einsum("fnj,fj->fn", crossed, normals)
    length = np.sqrt(np.einsum("fnj,fnj->fn", edge, edge))
    left = (turn >= -1e-12 * length * length[:, onward]).all(axis=1)
    # All turns to the left but more than one full turn (a pentagram) is not convex either.
    angle = np.arctan2(turn, np.einsum("fnj,fnj->fn", edge, following)).sum(axis=1)
    return left & (np.abs(angle - 2 * np.pi) < 1e-6)


def is_convex(ring: FloatArray, normal: FloatArray) -> bool:
    """Whether a ring (n, 3) turns the same way at each corner, see :func:`are_convex`."""
    return bool(are_convex(ring[None], np.asarray(normal)[None])[0])


def check_polygon(rings: Sequence[FloatArray]) -> str | None:
    """What is wrong with a polygon, in a few words, or ``None``.

    Tested: at least three vertices a ring, finite coordinates, an area, planarity to
    :data:`PLANARITY` of its size.
    """
    for ring in rings:
        if len(ring) < 3:
            return f"a ring of {len(ring)} vertices, expected 3 or more"
        if not np.isfinite(ring).all():
            return "a coordinate that is not finite"
    vector = vector_area(rings)
    area = float(np.linalg.norm(vector))
    points = np.concatenate(list(rings))
    extent = float(np.ptp(points, axis=0).max())
    if not area > 1e-14 * extent * extent:
        return "a polygon of zero area"
    off = float(np.abs((points - points[0]) @ (vector / area)).max())
    if off > PLANARITY * extent:
        return f"a non-planar polygon: a vertex lies {off:.3g} off the plane, {off / extent:.2g} of its size"
    return None


def fan_triangles(corners: FloatArray, starts: NDArray[np.int64]) -> tuple[FloatArray, NDArray[np.int64]]:
    """Fan triangles (t, 3, 3) of convex rings, and the ring (t,) of each.

    Ring ``i`` is ``corners[starts[i]:starts[i + 1]]``.
    """
    counts = np.diff(starts) - 2
    ring = np.repeat(np.arange(len(counts)), counts).astype(np.int64)
    first = np.repeat(starts[:-1], counts)
    step = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.ascontiguousarray(corners[np.stack([first, first + step + 1, first + step + 2], axis=1)]), ring


def convex_pieces(rings: Sequence[FloatArray]) -> list[FloatArray]:
    """A polygon as convex pieces with its orientation: itself, or triangles by ear cutting.

    Raises
    ------
    InputError
        If the triangles do not add up to the polygon's area (a ring that crosses itself).
    """
    vector = vector_area(rings)
    area = float(np.linalg.norm(vector))
    normal = vector / area
    if len(rings) == 1 and is_convex(rings[0], normal):
        return [np.ascontiguousarray(rings[0], dtype=np.float64)]
    u, v = plane_basis(normal)
    points = np.concatenate(list(rings))
    flat = np.column_stack([(points - points[0]) @ u, (points - points[0]) @ v])
    ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    triangles = mapbox_earcut.triangulate_float64(flat, ends).reshape(-1, 3)
    corners = points[triangles]
    vectors = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    signed = vectors @ normal
    if abs(np.abs(signed).sum() - area) > 1e-6 * area:
        raise InputError("a polygon whose rings cross themselves or each other")
    keep = np.abs(signed) > 1e-14 * area
    corners[signed < 0] = corners[signed < 0][:, ::-1]
    return [np.ascontiguousarray(corner) for corner in corners[keep]]


def triangulate_ring(ring: FloatArray, normal: FloatArray) -> NDArray[np.int64]:
    """Triangles (t, 3) of a ring (n, 3) that need not be planar, cut in its projection along the unit ``normal``."""
    u, v = plane_basis(normal)
    moved = ring - ring[0]
    flat = np.column_stack([moved @ u, moved @ v])
    triangles = mapbox_earcut.triangulate_float64(flat, np.asarray([len(ring)], dtype=np.uint32)).reshape(-1, 3)
    corners = ring[triangles]
    turned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ normal < 0
    triangles[turned] = triangles[turned][:, ::-1]
    return triangles.astype(np.int64)
