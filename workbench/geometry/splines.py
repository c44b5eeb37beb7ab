"""Rational B-spline surfaces: evaluation, exact surfaces of revolution, and tessellation.

Evaluation is scipy's :class:`~scipy.interpolate.BSpline` on homogeneous coordinates
``(w x, w y, w z, w)``, one direction after the other; the formulas are those of Piegl and Tiller,
*The NURBS Book* (2nd ed. 1997): eq. 4.15 (surface), eq. 4.20 (derivatives of a quotient),
section 7.5 (full circle by nine control points), section 8.5 (surfaces of revolution).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline

from workbench.errors import InputError

__all__ = [
    "RationalSurface",
    "clamped_knots",
    "evaluate",
    "facet_error",
    "surface_of_revolution",
    "tessellate",
    "torus",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_WELD = 1e-10
"""Points closer than this share of the surface's size are one vertex at seams and poles."""


@dataclass(frozen=True)
class RationalSurface:
    """A tensor-product rational B-spline surface; its front is the side of du x dv.

    Parameters
    ----------
    degree : (2,) int
        In u and in v, 1 or more.
    knots : pair of (n + degree + 1,) float
        Non-decreasing knot vectors.
    control : (n, m, 3) float
        Control points, first index along u. [scene lengths]
    weights : (n, m) float
        Positive weights.

    Raises
    ------
    InputError
        If the parts do not fit together.
    """

    degree: tuple[int, int]
    knots: tuple[FloatArray, FloatArray]
    control: FloatArray
    weights: FloatArray

    def __post_init__(self) -> None:
        if self.control.ndim != 3 or self.control.shape[2] != 3 or self.weights.shape != self.control.shape[:2]:
            raise InputError(
                f"spline: found control points {self.control.shape} and weights {self.weights.shape}, "
                "expected (n, m, 3) and (n, m)"
            )
        if not (np.isfinite(self.control).all() and np.isfinite(self.weights).all() and (self.weights > 0).all()):
            raise InputError("spline: found a control point or weight that is not finite, or a weight that is not > 0")
        for axis, name in enumerate("uv"):
            degree, knots, count = self.degree[axis], self.knots[axis], self.control.shape[axis]
            if degree < 1 or count <= degree:
                raise InputError(
                    f"spline: found degree {degree} with {count} points in {name}, expected 1..{count - 1}"
                )
            if knots.shape != (count + degree + 1,):
                raise InputError(
                    f"spline: found {knots.size} knots in {name}, expected points + degree + 1 = {count + degree + 1}"
                )
            if not np.isfinite(knots).all() or (np.diff(knots) < 0).any() or knots[degree] >= knots[count]:
                raise InputError(f"spline: found knots in {name} that decrease or span nothing, expected a rising list")

    def spans(self, axis: int) -> FloatArray:
        """Distinct knots of the domain along u (0) or v (1): the ends of the polynomial spans."""
        degree, count = self.degree[axis], self.control.shape[axis]
        return np.unique(self.knots[axis][degree : count + 1])


def clamped_knots(count: int, degree: int) -> FloatArray:
    """Uniform knots (count + degree + 1,) over 0..1 that make the spline start and end at its end points."""
    return np.concatenate([np.zeros(degree), np.linspace(0.0, 1.0, count - degree + 1), np.ones(degree)])


def evaluate(surface: RationalSurface, u: ArrayLike, v: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points and derivatives on the grid ``u`` x ``v``.

    Parameters
    ----------
    surface : RationalSurface
    u, v : (a,) and (b,) float
        Parameters inside the domain.

    Returns
    -------
    points, du, dv : (a, b, 3) float
        Position and its derivatives by u and v.
    """
    homogeneous = np.concatenate([surface.control * surface.weights[..., None], surface.weights[..., None]], axis=2)
    along_u = BSpline(surface.knots[0], homogeneous, surface.degree[0])
    parameter_u, parameter_v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)

    def along_v(rows: FloatArray, derivative: int) -> FloatArray:
        spline = BSpline(surface.knots[1], rows.transpose(1, 0, 2), surface.degree[1])
        return spline(parameter_v, nu=derivative).transpose(1, 0, 2)

    rows = along_u(parameter_u)
    value = along_v(rows, 0)
    by_u = along_v(along_u(parameter_u, nu=1), 0)
    by_v = along_v(rows, 1)
    weight = value[..., 3:]
    points = value[..., :3] / weight
    du = (by_u[..., :3] - by_u[..., 3:] * points) / weight
    dv = (by_v[..., :3] - by_v[..., 3:] * points) / weight
    return points, du, dv


def _parameters(spans: FloatArray, count: int) -> FloatArray:
    """At least ``count`` segments, the same number in each knot span, so that creases stay edges."""
    each = -(-count // (len(spans) - 1))
    inner = [np.linspace(low, high, each, endpoint=False) for low, high in pairwise(spans)]
    return np.append(np.concatenate(inner), spans[-1])


def tessellate(surface: RationalSurface, u_count: int, v_count: int) -> tuple[FloatArray, IntArray, FloatArray]:
    """Triangles with shading normals; seams share their vertices, poles are single vertices.

    Parameters
    ----------
    surface : RationalSurface
    u_count, v_count : int
        Segments along u and v, each rounded up to a multiple of the number of knot spans.

    Returns
    -------
    vertices : (n, 3) float
    faces : (t, 3) int
        Counter-clockwise from the side of du x dv; triangles without area (poles) are left out.
    normals : (n, 3) float
        Unit normals of the exact surface; at poles, where du x dv vanishes, the mean of the faces'.

    Raises
    ------
    InputError
        If a count is below 1 or the surface has no area.
    """
    if u_count < 1 or v_count < 1:
        raise InputError(f"spline: found {u_count} x {v_count} segments, expected 1 or more each way")
    points, du, dv = evaluate(surface, _parameters(surface.spans(0), u_count), _parameters(surface.spans(1), v_count))
    rows, columns = points.shape[:2]
    size = float(np.ptp(points.reshape(-1, 3), axis=0).max())

    def same(a: FloatArray, b: FloatArray) -> bool:
        return bool(np.abs(a - b).max() <= _WELD * size)

    index = np.arange(rows * columns).reshape(rows, columns)
    if same(points[0], points[-1]):
        index[-1] = index[0]
    if same(points[:, 0], points[:, -1]):
        index[:, -1] = index[:, 0]
    for line in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        if same(points[line], points[line][:1]):
            index[line] = index[line][0]

    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    flat = points.reshape(-1, 3)
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    vectors = 0.5 * np.cross(flat[faces[:, 1]] - flat[faces[:, 0]], flat[faces[:, 2]] - flat[faces[:, 0]])
    keep = np.linalg.norm(vectors, axis=1) > 1e-14 * size * size
    faces, vectors = faces[keep], vectors[keep]
    if len(faces) == 0:
        raise InputError("spline: found a surface of zero area, expected control points that span one")

    normals = np.cross(du, dv).reshape(-1, 3)
    length = np.linalg.norm(normals, axis=1)
    scale = (np.linalg.norm(du, axis=2) * np.linalg.norm(dv, axis=2)).max()
    from_faces = np.zeros_like(flat)
    for corner in range(3):
        np.add.at(from_faces, faces[:, corner], vectors)
    normals = np.where((length > 1e-9 * scale)[:, None], normals, from_faces)
    used, faces = np.unique(faces, return_inverse=True)
    normals = normals[used]
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    return np.ascontiguousarray(flat[used]), faces.reshape(-1, 3).astype(np.int64), normals


def facet_error(surface: RationalSurface, u_count: int, v_count: int) -> float:
    """Largest distance, along the normal, between the surface and the facets of :func:`tessellate`.

    Measured at the middles of all edges, so it is an estimate, good to a few parts in a hundred
    where facets are small against the surface's bends. [scene lengths]
    """
    u, v = (_parameters(surface.spans(axis), count) for axis, count in enumerate((u_count, v_count)))
    between_u, between_v = 0.5 * (u[1:] + u[:-1]), 0.5 * (v[1:] + v[:-1])
    points, _, _ = evaluate(surface, u, v)
    largest = 0.0
    for at_u, at_v, middle in (
        (between_u, v, 0.5 * (points[1:] + points[:-1])),
        (u, between_v, 0.5 * (points[:, 1:] + points[:, :-1])),
        (between_u, between_v, 0.5 * (points[1:, 1:] + points[:-1, :-1])),
    ):
        exact, du, dv = evaluate(surface, at_u, at_v)
        normal = np.cross(du, dv)
        length = np.linalg.norm(normal, axis=2, keepdims=True)
        height = np.einsum("abi,abi->ab", exact - middle, normal / np.where(length > 0, length, 1.0))
        largest = max(largest, float(np.abs(height).max()))
    return largest


# A full circle of nine control points: the corners and side middles of the square around it.
_CIRCLE = np.array([[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1], [1, 0]], dtype=np.float64)
_CIRCLE_WEIGHTS = np.array([1, np.sqrt(0.5)] * 4 + [1])
_CIRCLE_KNOTS = np.array([0, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 4]) / 4.0


def surface_of_revolution(
    profile: ArrayLike, *, degree: int = 3, knots: ArrayLike | None = None, weights: ArrayLike | None = None
) -> RationalSurface:
    """The exact surface that a profile sweeps about the z axis; u runs around, v along the profile.

    A profile that rises on the outside has its front outside (a pot drawn from its rim down has
    its front inside).

    Parameters
    ----------
    profile : (n, 2) float
        Control points (radius, z) of the profile's B-spline. [scene lengths]
    degree : int
        Of the profile.
    knots : (n + degree + 1,) float, optional
        Clamped and uniform unless given.
    weights : (n,) float, optional
        All 1 unless given.

    Raises
    ------
    InputError
        If the profile is not ``(n, 2)`` or does not fit the degree, knots or weights.
    """
    points = np.asarray(profile, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise InputError(f"profile: found shape {points.shape}, expected (n, 2) pairs of radius and z")
    count = len(points)
    if not 1 <= degree < count:
        raise InputError(f"profile: found degree {degree} with {count} points, expected 1..{count - 1}")
    weight = np.ones(count) if weights is None else np.asarray(weights, dtype=np.float64)
    if weight.shape != (count,):
        raise InputError(f"profile: found {weight.size} weights, expected {count}")
    control = np.empty((9, count, 3))
    control[:, :, :2] = _CIRCLE[:, None, :] * points[None, :, :1]
    control[:, :, 2] = points[:, 1]
    along = clamped_knots(count, degree) if knots is None else np.asarray(knots, dtype=np.float64)
    return RationalSurface((2, degree), (_CIRCLE_KNOTS, along), control, _CIRCLE_WEIGHTS[:, None] * weight)


def torus(radius: float, tube: float) -> RationalSurface:
    """The exact torus about the z axis, front outside.

    ``radius`` is that of the circle in the middle of the tube, ``tube`` that of the tube itself.
    Its area is 4 pi^2 radius tube.
    """
    if not 0 < tube < radius:
        raise InputError(f"torus: found tube radius {tube:g} and radius {radius:g}, expected 0 < tube < radius")
    profile = np.column_stack([radius + tube * _CIRCLE[:, 0], tube * _CIRCLE[:, 1]])
    return surface_of_revolution(profile, degree=2, knots=_CIRCLE_KNOTS, weights=_CIRCLE_WEIGHTS)
