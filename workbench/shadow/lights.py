"""Lights in one vocabulary: what a light gives an open point, and where its shadow rays go.

Every light is a *sender* with

* ``unit_irradiance(points, normals)``, the closed form, unoccluded, for a power of 1;
* ``irradiance(points, normals)``, that times the light's power in each band;
* ``sample(points, normals, u)``, shadow rays from points of the unit square, with their density
  and their weights: each ray's part of the unit irradiance, cosines and distance included.

``(weights * transmitted).sum(1)`` is an unbiased estimate of the unit irradiance.  Better is the
closed form times :func:`visible_share`, the weighted share of rays that pass, for it has no noise
where nothing blocks.  Equal weights (:func:`equal_weights`) are the papers' form and give the
visible share of the light's length or area, which is not the visible share of its irradiance.

A ``power`` is an intensity [W/sr] of point and spot lights, an irradiance [W/m2] of directional
ones, an intensity per length [W/(sr m)] of linear ones and an exitance [W/m2] of surfaces, so the
unit irradiance of a surface is its form factor from the point.  A one-sided light gives nothing
behind it; what lies below a receiver's horizon gives that receiver nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from workbench.arrays import as_points, as_unit_vectors
from workbench.errors import InputError
from workbench.geometry.flat import Geometry
from workbench.geometry.lambert import lambert_piece
from workbench.geometry.polygons import check_polygon, convex_pieces, plane_basis, vector_area
from workbench.sampling.warp import solid_angle, square_to_cap, square_to_disk, square_to_spherical_triangle
from workbench.scene.model import Light, Scene
from workbench.shadow.linear import linear_irradiance
from workbench.shadow.woo import irradiance_weights

__all__ = [
    "DirectionalLight",
    "DiskLight",
    "LightSamples",
    "LinearLight",
    "PointLight",
    "PolygonLight",
    "Sender",
    "SphereLight",
    "SpotLight",
    "equal_weights",
    "lights_of_scene",
    "visible_share",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NO_POLYGONS = np.empty(0, dtype=np.int64)
_IN_PLANE = 1e-15  # of the distance: nearer to a surface's plane is in it, which sees nothing
_SERIES = 0.05  # below, x - sin x cos x loses digits and a series does not


@dataclass(frozen=True)
class LightSamples:
    """Shadow rays to one light, K from each point.

    Parameters
    ----------
    directions : (n, K, 3) float
        From the point to the sample: crossings with ``0 < t < far`` block.
    far : float
        1 where the directions reach the light, ``inf`` for a light without a place.
    weights : (n, K) float
        Each ray's part of the irradiance for a power of 1, divided by K.
    density : (n, K) float
        Of the samples, by ``measure``; 0 where a light has no side to send from.
    measure : str
        ``"area"``, ``"length"`` or ``"solid angle"``; ``"place"`` for lights that have one only.
    """

    directions: FloatArray
    far: float
    weights: FloatArray
    density: FloatArray
    measure: str

    @property
    def count(self) -> int:
        """Rays from each point, K."""
        return self.directions.shape[1]


class Sender(Protocol):
    """What every light offers; ``polygons`` are the geometry's polygons that it is made of."""

    @property
    def name(self) -> str:
        """The light's name in the scene."""
        ...

    @property
    def power(self) -> FloatArray:
        """(bands,) float."""
        ...

    @property
    def polygons(self) -> IntArray:
        """(k,) int; empty for a light that is no surface."""
        ...

    def unit_irradiance(self, points: ArrayLike, normals: ArrayLike) -> FloatArray:
        """Unoccluded irradiance (n,) for a power of 1, in closed form."""
        ...

    def irradiance(self, points: ArrayLike, normals: ArrayLike) -> FloatArray:
        """Unoccluded irradiance (n, bands). [W m-2]"""
        ...

    def sample(self, points: ArrayLike, normals: ArrayLike, u: ArrayLike) -> LightSamples:
        """Shadow rays for points ``u`` of the unit square, (K, 2) for all points or (n, K, 2)."""
        ...


def equal_weights(samples: LightSamples) -> FloatArray:
    """Weights (n, K) of 1/K: the papers' ``occlusion / K``.

    They give the visible share of what the samples are spread over (length, area), which differs
    from the share of the irradiance by up to 0.022 of it below a straight edge; kept for
    reproductions.  Source: Woo 1993, Figures 2 and 4; a hardware camera's fraction of pixels is the
    same thing.
    """
    return np.full(samples.weights.shape, 1.0 / samples.count)


def visible_share(weights: ArrayLike, transmitted: ArrayLike) -> FloatArray:
    """Weighted share (n,) or (n, bands) of the light that passes; 0 where all weights are 0.

    Parameters
    ----------
    weights : (n, K) float
    transmitted : (n, K) or (n, K, bands) float
        What passes along each ray. [0..1]

    Raises
    ------
    InputError
        If shapes do not agree.
    """
    share, through = np.asarray(weights, dtype=np.float64), np.asarray(transmitted, dtype=np.float64)
    if share.ndim != 2 or through.ndim not in (2, 3) or through.shape[:2] != share.shape:
        raise InputError(
            f"transmitted: found shape {through.shape}, expected {share.shape} or {(*share.shape, 'bands')}"
        )
    total = share.sum(axis=1, keepdims=True)
    return np.einsum("nk,nk...->n...", share / np.where(total > 0.0, total, 1.0), through)


def _receivers(points: ArrayLike, normals: ArrayLike) -> tuple[FloatArray, FloatArray]:
    place, normal = as_points(points), as_unit_vectors(normals)
    if len(normal) not in (1, len(place)):
        raise InputError(f"normals: found {len(normal)} rows, expected {len(place)}")
    return place, np.ascontiguousarray(np.broadcast_to(normal, place.shape))


def _square(u: ArrayLike, count: int) -> FloatArray:
    array = np.asarray(u, dtype=np.float64)
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3 or array.shape[2] != 2 or array.shape[0] not in (1, count) or array.shape[1] < 1:
        raise InputError(f"u: found shape {array.shape}, expected (K, 2) or ({count}, K, 2) with K of 1 or more")
    if not ((array >= 0.0) & (array <= 1.0)).all():
        raise InputError("u: found a value outside 0 to 1")
    return array


def _unit_vector(values: ArrayLike, name: str) -> FloatArray:
    return as_unit_vectors(values, name)[0]


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.einsum("...i,...i->...", a, b)


class _Powered:
    """What the lights share: bands are powers times the unit irradiance."""

    power: FloatArray

    def unit_irradiance(self, points: ArrayLike, normals: ArrayLike) -> FloatArray:
        raise NotImplementedError

    def irradiance(self, points: ArrayLike, normals: ArrayLike) -> FloatArray:
        """Unoccluded irradiance (n, bands). [W m-2]"""
        return self.unit_irradiance(points, normals)[:, None] * self.power


# --- lights without extent --------------------------------------------------------------------------


class _OneRay(_Powered):
    # A light of one direction or place: one ray, whatever was asked, with the closed form as weight.
    _far = 1.0

    @property
    def polygons(self) -> IntArray:
        """None: the light is no surface."""
        return _NO_POLYGONS

    def _toward(self, place: FloatArray) -> FloatArray:
        raise NotImplementedError

    def sample(self, points: ArrayLike, normals: ArrayLike, u: ArrayLike) -> LightSamples:
        """The one shadow ray a point: K is 1 whatever ``u`` holds."""
        place, normal = _receivers(points, normals)
        _square(u, len(place))
        weights = self.unit_irradiance(place, normal)[:, None]
        return LightSamples(self._toward(place)[:, None], self._far, weights, np.ones_like(weights), "place")


@dataclass(frozen=True)
class DirectionalLight(_OneRay):
    """Parallel light; ``power`` is its irradiance on a surface that faces it. [W m-2]

    Parameters
    ----------
    name : str
    power : (bands,) float
    direction : (3,) float
        In which the light travels.
    """

    name: str
    power: FloatArray
    direction: FloatArray
    _far = math.inf

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", _unit_vector(self.direction, "direction"))

    def _toward(self, place: FloatArray) -> FloatArray:
        return np.broadcast_to(-self.direction, place.shape).copy()

    def unit_irradiance(self, points: ArrayLike, normals: ArrayLike) -> FloatArray:
        """The cosine of the angle to the normal, (n,)."""
        _, normal = _receivers(points, normals)
        return np.clip(-normal @ self.direction, 0.0, None)


@dataclass(frozen=True)
class PointLight(_OneRay):
    """The same intensity in all directions; ``power`` is that intensity. [W sr-1]"""

    name: str
    power: FloatArray
    position: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", as_points(self.position, "position")[0])

    def _toward(self, place: FloatArray) -> FloatArray:
        toward = self.position - place
        if not toward.any(axis=1).all():
            raise InputError(f"points: one lies on the light {self.name!r}; move it off the light")
        return toward

    def unit_irradiance(self, points: ArrayLike, normals: ArrayLike) -> FloatArray:
        """cos / r^2, (n,)."""
        place, normal = _receivers(points, normals)
        toward = self._toward(place)
        square = _dot(toward, toward)
        return np.clip(_dot(toward, normal), 0.0, None) / (square * np.sqrt(square))


@dataclass(frozen=True)
class SpotLight(PointLight):
    """A point light with a cone; ``power`` is the intensity along the axis. [W sr-1]

    Parameters
    ----------
    name, power, position
        As of :class:`PointLight`.
    direction : (3,) float
        The axis, in which the light travels.
    cone_deg : float
        Half-angle beyond which it gives nothing, up to 90. [degrees]
    exponent : float
        Intensity falls as cos^exponent of the angle to the axis.
    """

    direction: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))
    cone_deg: float = 90.0
    exponent: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "direction", _unit_vector(self.direction, "direction"))
        if not 0.0 < self.cone_deg <= 90.0:
            raise InputError(f"cone_deg: found {self.cone_deg}, expected more than 0 and at most 90 degrees")
        if not 0.0 <= self.exponent < math.inf:
            raise InputError(f"exponent: found {self.exponent}, expected 0 or more")

    def unit_irradiance(self, points: ArrayLike, normals: ArrayLike) -> FloatArray:
        """cos / r^2 times the fall-off, (n,)."""
        open_light = super().unit_irradiance(points, normals)
        toward = self._toward(as_points(points))
        cosine = -(toward @ self.direction) / np.sqrt(_dot(toward, toward))
        # cos 90 degrees is not 0 in doubles; a light of half the directions has none at its equator.
        edge = math.cos(math.radians(self.cone_deg)) if self.cone_deg < 90.0 else 0.0
        lit = (cosine >= edge) & (cosine > 0.0)
        return open_light * np.where(lit, np.where(lit, cosine, 1.0) ** self.exponent, 0.0)


@dataclass(frozen=True)
class LinearLight(_Powered):
    """A line of light; ``power`` is the intensity per length across it. [W sr-1 m-1]

    Parameters
    ----------
    name : str
    power : (bands,) float
    start, end : (3,) float
    lambertian : bool
        Whether intensity falls with the sine of the angle to the line.
    """

    name: str
    power: FloatArray
    start: FloatArray
    end: FloatArray
    lambertian: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "start", as_points(self.start, "start")[0])
        object.__setattr__(self, "end", as_points(self.end, "end")[0])
        if (self.start == self.end).all():
            raise InputError("start and end: expected two different points, the ends of one light")

    @property
    def polygons(self) -> IntArray:
        """None: the light is no surface."""
        return _NO_POLYGONS

    def unit_irradiance(self, points: ArrayLike, normals: ArrayLike) -> FloatArray:
        """:func:`workbench.shadow.linear.linear_irradiance`, (n,)."""
        return linear_irradiance(points, normals, self.start, self.end, lambertian=self.lambertian)

    def sample(self, points: ArrayLike, normals: ArrayLike, u: ArrayLike) -> LightSamples:
        """Rays spread evenly over the length by ``u[..., 0]``."""
        place, normal = _receivers(points, normals)
        square = _square(u, len(place))
        axis = self.end - self.start
        length = float(np.linalg.norm(axis))
        targets = np.broadcast_to(self.start + square[..., :1] * axis, (len(place), square.shape[1], 3))
        weights = irradiance_weights(place, normal, targets, light_axis=axis if self.lambertian else None)
        return LightSamples(
            targets - place[:, None], 1.0, weights * (length / square.shape[1]),
            np.full(weights.shape, 1.0 / length), "length",
        )  # fmt: skip


# --- surfaces ---------------------------------------------------------------------------------------


def _area_samples(place, normal, targets, light_normal, two_sided, area) -> LightSamples:
    # Samples spread evenly over a flat light: weight cos cos A / (pi r^2 K).
    count = targets.shape[1]
    targets = np.broadcast_to(targets, (len(place), count, 3))
    weights = irradiance_weights(place, normal, targets, light_normal=light_normal)
    if two_sided:
        weights += irradiance_weights(place, normal, targets, light_normal=-light_normal)
    return LightSamples(
        targets - place[:, None], 1.0, weights * (area / (math.pi * count)),
        np.full(weights.shape, 1.0 / area), "area",
    )  # fmt: skip


@njit(nogil=True, cache=True)
def _polygon_factor(points, normals, corners, starts, light_normal, two_sided, in_plane, out):
    mx, my, mz = light_normal[0], light_normal[1], light_normal[2]
    for row in range(points.shape[0]):
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        nx, ny, nz = normals[row, 0], normals[row, 1], normals[row, 2]
        height = mx * (x - corners[0, 0]) + my * (y - corners[0, 1]) + mz * (z - corners[0, 2])
        reach = 0.0
        for i in range(corners.shape[0]):
            reach = max(reach, abs(corners[i, 0] - x), abs(corners[i, 1] - y), abs(corners[i, 2] - z))
        out[row] = 0.0
        if abs(height) <= in_plane * reach or (height < 0.0 and not two_sided):
            continue
        for part in range(starts.shape[0] - 1):
            share = lambert_piece(x, y, z, nx, ny, nz, corners, starts[part], starts[part + 1])
            out[row] += max(share if height > 0.0 else -share, 0.0)


@dataclass(frozen=True)
class PolygonLight(_Powered):
    """A diffuse polygon, concave or with holes if need be; ``power`` is its exitance. [W m-2]

    Parameters
    ----------
    name : str
    power : (bands,) float
    rings : sequence of (n, 3) float, or one (n, 3)
        The outer ring, counter-clockwise from the emitting side, then holes.
    two_sided : bool
        Whether the back emits too.
    polygons : (k,) int
        The polygon of the geometry that is this light.
    by_solid_angle : bool
        Whether samples are spread evenly over the solid angle that the light fills from the point,
        not over its area: better near the light.
    """

    name: str
    power: FloatArray
    rings: Sequence[FloatArray] | FloatArray
    two_sided: bool = False
    polygons: IntArray = field(default_factory=lambda: _NO_POLYGONS)
    by_solid_angle: bool = False

    def __post_init__(self) -> None:
        single = len(self.rings) > 0 and np.ndim(self.rings[0]) == 1
        rings = tuple(as_points(ring, "rings") for ring in ([self.rings] if single else self.rings))
        wrong = check_polygon(rings)
        if wrong is not None:
            raise InputError(f"light {self.name!r}: found {wrong}, expected a plane polygon")
        object.__setattr__(self, "rings", rings)

    @cached_property
    def parts(self) -> tuple[FloatArray, ...]:
        """Convex parts (n, 3), each a light that every culler takes."""
        return tuple(convex_pieces([*self.rings]))

    @cached_property
    def area(self) -> float:
        """Area. [scene lengths squared]"""
        return float(np.linalg.norm(vector_area(self.rings)))

    @cached_property
    def normal(self) -> FloatArray:
        """Unit normal (3,) of the front."""
        return vector_area(self.rings) / self.area

    @cached_property
    def _corners(self) -> tuple[FloatArray, IntArray]:
        starts = np.concatenate([[0], np.cumsum([len(part) for part in self.parts])]).astype(np.int64)
        return np.concatenate(self.parts), starts

    @cached_property
    def _triangles(self) -> FloatArray:
        # (t, 3, 3): the fans of all parts.
        return np.concatenate(
            [np.stack([np.broadcast_to(p[0], (len(p) - 2, 3)), p[1:-1], p[2:]], axis=1) for p in self.parts]
        )

    @cached_property
    def _edges(self) -> tuple[FloatArray, FloatArray] | None:
        # A parallelogram is one affine map of the square, which keeps strata whole.
        if len(self.rings) > 1 or len(self.rings[0]) != 4:
            return None
        a, b, c = self.rings[0][1:] - self.rings[0][0]
        return (a, c) if np.abs(b - a - c).max() <= 1e-12 * np.abs(self.rings[0] - self.rings[0][0]).max() else None

    def unit_irradiance(self, points: ArrayLike, normals: ArrayLike) -> FloatArray:
        """Lambert's formula over the convex parts, (n,): the form factor from each point."""
        place, normal = _receivers(points, normals)
        out = np.empty(len(place))
        _polygon_factor(place, normal, *self._corners, self.normal, self.two_sided, _IN_PLANE, out)
        return out

    def sample(self, points: ArrayLike, normals: ArrayLike, u: ArrayLike) -> LightSamples:
        """Rays spread evenly over the area, or over the solid angle.

        A parallelogram is an affine map of the square.  Other polygons are strips of ``u[..., 0]``,
        one a triangle, as wide as the triangle's share.
        """
        place, normal = _receivers(points, normals)
        square = _square(u, len(place))
        if self.by_solid_angle:
            return self._by_solid_angle(place, normal, np.broadcast_to(square, (len(place), *square.shape[1:])))
        if self._edges is not None:
            a, c = self._edges
            targets = self.rings[0][0] + square[..., :1] * a + square[..., 1:] * c
        else:
            corners = self._triangles
            sizes = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
            index, inner = _strip(square[..., 0], sizes[None, :])
            root, across = np.sqrt(inner)[..., None], square[..., 1:]
            first = corners[index, 0]
            targets = first + root * (
                (1.0 - across) * (corners[index, 1] - first) + across * (corners[index, 2] - first)
            )
        return _area_samples(place, normal, targets, self.normal, self.two_sided, self.area)

    def _by_solid_angle(self, place: FloatArray, normal: FloatArray, square: FloatArray) -> LightSamples:
        corners = self._triangles[None] - place[:, None, None]  # (n, t, 3, 3)
        length = np.sqrt(_dot(corners, corners))
        if not length.all():
            raise InputError(f"points: one lies on a corner of the light {self.name!r}; move it off the light")
        unit = corners / length[..., None]
        angles = solid_angle(unit[:, :, 0], unit[:, :, 1], unit[:, :, 2])
        height = (place - self.rings[0][0]) @ self.normal
        reach = length.max(axis=(1, 2))
        faces = np.abs(height) > _IN_PLANE * reach if self.two_sided else height > _IN_PLANE * reach
        index, inner = _strip(square[..., 0], angles)
        rows = np.arange(len(place))[:, None]
        chosen = unit[rows, index]
        along = square_to_spherical_triangle(
            np.stack([inner, square[..., 1]], axis=-1), chosen[..., 0, :], chosen[..., 1, :], chosen[..., 2, :]
        )
        # From the direction to the light's plane; one that grazes it (a point in the plane) is not used.
        slope = along @ self.normal
        steep = (slope * height[:, None] < 0.0) & faces[:, None]
        distance = np.where(steep, -height[:, None] / np.where(steep, slope, 1.0), reach[:, None])
        total = angles.sum(axis=1)[:, None]
        weights = np.where(steep, np.clip(np.einsum("nkj,nj->nk", along, normal), 0.0, None), 0.0)
        return LightSamples(
            along * distance[..., None], 1.0, weights * total / (math.pi * square.shape[1]),
            np.where(faces[:, None], 1.0 / np.where(total > 0.0, total, 1.0), 0.0) * np.ones(weights.shape),
            "solid angle",
        )  # fmt: skip


def _strip(u: FloatArray, sizes: FloatArray) -> tuple[IntArray, FloatArray]:
    # Strip of [0, 1), as wide as its share of ``sizes`` (n, t), that holds u (n, K), and the place in it.
    upper = np.cumsum(sizes, axis=-1)
    upper = upper / np.where(upper[:, -1:] > 0.0, upper[:, -1:], 1.0)
    index = np.minimum((u[..., None] >= upper[:, None, :]).sum(axis=-1), sizes.shape[-1] - 1)
    rows = np.broadcast_to(np.arange(len(sizes))[:, None], index.shape)
    high = upper[rows, index]
    low = np.where(index > 0, upper[rows, np.maximum(index - 1, 0)], 0.0)
    return index, np.clip((u - low) / np.where(high > low, high - low, 1.0), 0.0, 1.0)


@njit(nogil=True, cache=True)
def _atan_over(x):
    return math.atan(x) / x if x != 0.0 else 1.0


@njit(nogil=True, cache=True)
def _log1p_over(x):
    return math.log1p(x) / x if x != 0.0 else 1.0


@njit(nogil=True, cache=True)
def _disk_factor(cx, cy, cz, radius, mx, my, mz, nx, ny, nz):
    """Form factor from the origin, normal n, to a disk about c whose plane has the normal m, c . m > 0.

    Lambert's contour integral: an arc of the circle and, where the horizon cuts the disk, the chord.
    With u in the disk's plane along c, v = m x u, and t the angle from u, |r|^2 = A + B cos t; the
    integrals of 1, cos t and sin t over that are elementary, and written without cancellation.
    """
    h = cx * mx + cy * my + cz * mz
    ux, uy, uz = cx - h * mx, cy - h * my, cz - h * mz
    side = math.sqrt(ux * ux + uy * uy + uz * uz)
    if side > 0.0:
        ux, uy, uz = ux / side, uy / side, uz / side
        # Near the axis the difference above is mostly rounding, which may lean out of the plane.
        lean = ux * mx + uy * my + uz * mz
        ux, uy, uz = ux - lean * mx, uy - lean * my, uz - lean * mz
    else:  # on the axis any u will do
        if abs(mx) < 0.6:
            ux, uy, uz = 0.0, -mz, my
        else:
            ux, uy, uz = mz, 0.0, -mx
    length = math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / length, uy / length, uz / length
    vx, vy, vz = my * uz - mz * uy, mz * ux - mx * uz, mx * uy - my * ux
    nu, nv = nx * ux + ny * uy + nz * uz, nx * vx + ny * vy + nz * vz
    nm = nx * mx + ny * my + nz * mz
    height = side * nu + h * nm
    swing = radius * math.sqrt(nu * nu + nv * nv)
    if height <= -swing:
        return 0.0
    a = side * side + h * h + radius * radius
    b = 2.0 * radius * side
    s = math.sqrt(((side - radius) * (side - radius) + h * h) * ((side + radius) * (side + radius) + h * h))
    if height >= swing:
        q = side * side - h * h - radius * radius
        rise = s - q if q <= 0.0 else 4.0 * h * h * side * side / (s + q)
        return radius * radius / (s * (s + a)) * (nm * rise + 2.0 * h * side * nu)
    middle, half = math.atan2(nv, nu), math.acos(-height / swing)
    t0, t1 = middle - half, middle + half
    beta = b / (a + s)
    # t - psi, psi the angle of which 1/(A + B cos t) is the derivative over S; both over B.
    lag = 0.0
    for end in range(2):
        t = t1 if end else t0
        tangent = math.sin(t) / ((a + s) * (1.0 + beta * math.cos(t)))
        lagging = 2.0 * tangent * _atan_over(b * tangent)
        lag += lagging if end else -lagging
    psi = (t1 - t0) - b * lag
    whole = psi / s
    cosine = lag - psi * b / (s * (a + s))
    rise = (math.cos(t1) - math.cos(t0)) / (a + b * math.cos(t0))
    sine = -rise * _log1p_over(b * rise)
    total = radius * radius * nm * whole + radius * ((side * nm - h * nu) * cosine - h * nv * sine)
    # Back along the chord, which lies on the horizon.
    px, py = side + radius * math.cos(t1), radius * math.sin(t1)
    qx, qy = side + radius * math.cos(t0), radius * math.sin(t0)
    # p x q in the frame u, v, m, along n.
    turn = h * (py - qy) * nu + h * (qx - px) * nv + (px * qy - py * qx) * nm
    total += math.atan2(turn, px * qx + py * qy + h * h)
    return max(total, 0.0) / (2.0 * math.pi)


@njit(nogil=True, cache=True)
def _disk_factors(points, normals, centre, radius, light_normal, two_sided, in_plane, out):
    for row in range(points.shape[0]):
        cx, cy, cz = centre[0] - points[row, 0], centre[1] - points[row, 1], centre[2] - points[row, 2]
        mx, my, mz = light_normal[0], light_normal[1], light_normal[2]
        h = -(cx * mx + cy * my + cz * mz)  # in front of the disk: above 0
        reach = math.sqrt(cx * cx + cy * cy + cz * cz) + radius
        out[row] = 0.0
        if abs(h) <= in_plane * reach or (h < 0.0 and not two_sided):
            continue
        if h > 0.0:
            mx, my, mz = -mx, -my, -mz
        out[row] = _disk_factor(
            cx, cy, cz, radius, mx, my, mz, normals[row, 0], normals[row, 1], normals[row, 2]
        )  # fmt: skip


@dataclass(frozen=True)
class DiskLight(_Powered):
    """A diffuse disk; ``power`` is its exitance. [W m-2]

    Parameters
    ----------
    name : str
    power : (bands,) float
    centre : (3,) float
    radius : float
        [scene lengths]
    normal : (3,) float
        Of the emitting side.
    two_sided : bool
    polygons : (k,) int
        Polygons of the geometry that stand for the disk.
    """

    name: str
    power: FloatArray
    centre: FloatArray
    radius: float
    normal: FloatArray
    two_sided: bool = False
    polygons: IntArray = field(default_factory=lambda: _NO_POLYGONS)

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", as_points(self.centre, "centre")[0])
        object.__setattr__(self, "normal", _unit_vector(self.normal, "normal"))
        _check_radius(self.radius)

    @property
    def area(self) -> float:
        """Area. [scene lengths squared]"""
        return math.pi * self.radius**2

    def unit_irradiance(self, points: ArrayLike, normals: ArrayLike) -> FloatArray:
        """The form factor from each point, (n,), exact also where the horizon cuts the disk.

        Uncut, it is the element-to-disk factor B-12 and B-13 of J. R. Howell's catalogue.  Cut, a
        disk of radius R at a distance d loses (d/R)^2 of the digits: 1e-9 at 1,000 radii.
        """
        place, normal = _receivers(points, normals)
        out = np.empty(len(place))
        _disk_factors(place, normal, self.centre, float(self.radius), self.normal, self.two_sided, _IN_PLANE, out)
        return out

    def sample(self, points: ArrayLike, normals: ArrayLike, u: ArrayLike) -> LightSamples:
        """Rays spread evenly over the area, squares of ``u`` to rings."""
        place, normal = _receivers(points, normals)
        flat = self.radius * square_to_disk(_square(u, len(place)))
        a, b = plane_basis(self.normal)
        targets = self.centre + flat[..., :1] * a + flat[..., 1:] * b
        return _area_samples(place, normal, targets, self.normal, self.two_sided, self.area)


def _check_radius(radius: float) -> None:
    if not 0.0 < radius < math.inf:
        raise InputError(f"radius: found {radius}, expected a positive length")


@njit(nogil=True, cache=True)
def _segment(x):
    # Twice the area that a chord cuts off the unit circle, x half its angle: x - sin x cos x.
    if x > _SERIES:
        return x - math.sin(x) * math.cos(x)
    y = 4.0 * x * x
    return x * y / 6.0 * (1.0 - y / 20.0 * (1.0 - y / 42.0 * (1.0 - y / 72.0)))


@njit(nogil=True, cache=True)
def _sphere_factors(points, normals, centre, radius, out):
    # Nusselt's analogue: the sphere's outline, thrown on the horizon's plane, is an ellipse; where
    # the horizon cuts it, two segments are left, one of the ellipse and one of the unit circle.
    for row in range(points.shape[0]):
        cx, cy, cz = centre[0] - points[row, 0], centre[1] - points[row, 1], centre[2] - points[row, 2]
        square = cx * cx + cy * cy + cz * cz
        out[row] = 0.0
        if square < radius * radius or square == 0.0:
            continue  # inside: behind the emitting side
        distance = math.sqrt(square)
        sine = radius / distance
        edge = math.sqrt(max((distance - radius) * (distance + radius), 0.0)) / distance
        cosine = (cx * normals[row, 0] + cy * normals[row, 1] + cz * normals[row, 2]) / distance
        if cosine >= sine:
            out[row] = sine * sine * cosine
            continue
        if cosine <= -sine:
            continue
        # Half-angles of the visible arc about the outline's centre and of its chord about the point.
        across = math.sqrt((sine - cosine) * (sine + cosine))
        arc = math.atan2(across, -cosine * edge)
        # With g the angle between c and n: sin(arc) = across / (sine sin g), sin(chord) = across / sin g.
        chord = math.atan2(across, edge)
        out[row] = max(sine * sine * cosine * _segment(arc) + _segment(chord), 0.0) / math.pi


@dataclass(frozen=True)
class SphereLight(_Powered):
    """A diffuse sphere that emits outward; ``power`` is its exitance. [W m-2]

    Parameters
    ----------
    name : str
    power : (bands,) float
    centre : (3,) float
    radius : float
        [scene lengths]
    polygons : (k,) int
        Polygons of the geometry that stand for the sphere.
    """

    name: str
    power: FloatArray
    centre: FloatArray
    radius: float
    polygons: IntArray = field(default_factory=lambda: _NO_POLYGONS)

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", as_points(self.centre, "centre")[0])
        _check_radius(self.radius)

    def unit_irradiance(self, points: ArrayLike, normals: ArrayLike) -> FloatArray:
        """The form factor from each point, (n,), exact also where the horizon cuts the sphere.

        Whole, it is (R/d)^2 cos; a point inside gets nothing.
        """
        place, normal = _receivers(points, normals)
        out = np.empty(len(place))
        _sphere_factors(place, normal, self.centre, float(self.radius), out)
        return out

    def sample(self, points: ArrayLike, normals: ArrayLike, u: ArrayLike) -> LightSamples:
        """Rays spread evenly over the solid angle of the visible cap; they end on the sphere."""
        place, normal = _receivers(points, normals)
        square = np.broadcast_to(_square(u, len(place)), (len(place), *_square(u, len(place)).shape[1:]))
        toward = self.centre - place
        distance = np.sqrt(_dot(toward, toward))
        outside = distance > self.radius
        # A point inside sees no emitting side: its rays go to the centre, without weight.
        axis = toward / np.where(distance > 0.0, distance, 1.0)[:, None]
        axis[distance == 0.0] = [0.0, 0.0, 1.0]
        sine = np.where(outside, self.radius / np.where(outside, distance, 1.0), 1.0)
        along = square_to_cap(square, axis[:, None], sine[:, None])
        cosine = np.einsum("nkj,nj->nk", along, axis)
        # Nearer crossing with the sphere; (d sin)^2 from the cross product keeps the rim's digits.
        off = np.cross(along, axis[:, None])
        depth = np.sqrt(np.clip(self.radius**2 - distance[:, None] ** 2 * _dot(off, off), 0.0, None))
        reach = np.where(outside[:, None], distance[:, None] * cosine - depth, distance[:, None])
        height = sine * sine / (1.0 + np.sqrt(np.clip(1.0 - sine * sine, 0.0, None)))
        angle = np.broadcast_to((2.0 * math.pi * height)[:, None], cosine.shape)
        weights = np.clip(np.einsum("nkj,nj->nk", along, normal), 0.0, None) * angle
        weights = np.where(outside[:, None], weights, 0.0) / (math.pi * square.shape[1])
        return LightSamples(
            along * reach[..., None], 1.0, weights, np.where(outside[:, None], 1.0 / angle, 0.0), "solid angle"
        )


# --- from a scene -----------------------------------------------------------------------------------


def _of_light(light: Light) -> Sender:
    def given(key: str) -> FloatArray:
        value = getattr(light, key)
        if value is None:
            raise InputError(f"light {light.name!r}: found no {key}, which a {light.kind} light needs")
        return value

    if light.kind == "directional":
        return DirectionalLight(light.name, light.power, given("direction"))
    if light.kind == "point":
        return PointLight(light.name, light.power, given("position"))
    if light.kind == "spot":
        axis = given("direction")
        return SpotLight(light.name, light.power, given("position"), axis, light.cone_deg, light.exponent)
    if light.kind == "linear":
        return LinearLight(light.name, light.power, given("position"), given("end"), light.lambertian)
    raise InputError(f"light {light.name!r}: found kind {light.kind!r}, expected point, spot, directional or linear")


def lights_of_scene(scene: Scene, geometry: Geometry) -> tuple[Sender, ...]:
    """All that sends light in a scene: its lights, in their order, then its emitting surfaces.

    A surface that is an exact sphere, seen from outside, is one :class:`SphereLight`, whatever its
    facets; every other emitting polygon is a :class:`PolygonLight` with the name of its surface and,
    where the surface has several, its face's number.

    Parameters
    ----------
    scene : Scene
    geometry : Geometry
        Of that scene: the lights know their polygons in it.

    Raises
    ------
    InputError
        If the geometry is not the scene's, or a light has an unknown kind.
    """
    faces = [surface.face_count for surface in scene.surfaces]
    if sum(faces) != geometry.polygon_count or len(geometry.surface_name) != len(scene.surfaces):
        raise InputError(
            f"geometry: found {geometry.polygon_count} polygons, expected the scene's {sum(faces)};"
            " make it with Geometry.from_scene"
        )
    senders: list[Sender] = [_of_light(light) for light in scene.lights if light.power.any()]
    first = np.concatenate([[0], np.cumsum(faces)])
    for index, surface in enumerate(scene.surfaces):
        power, two_sided = surface.material.emission, surface.material.two_sided
        if not power.any() or not surface.face_count:
            continue
        own = np.arange(first[index], first[index + 1])
        if surface.sphere is not None and _faces_outward(surface.face(0), surface.sphere.center):
            senders.append(SphereLight(surface.name, power, surface.sphere.center, surface.sphere.radius, own))
            continue
        for face, rings in enumerate(surface.faces()):
            name = surface.name if surface.face_count == 1 else f"{surface.name}[{face}]"
            senders.append(PolygonLight(name, power, rings, two_sided, own[face : face + 1]))
    return tuple(senders)


def _faces_outward(rings: Sequence[FloatArray], centre: FloatArray) -> bool:
    return bool(vector_area(rings) @ (rings[0].mean(axis=0) - centre) > 0.0)
