"""The interface of every accelerator: two questions about rays.

``closest_hit`` finds the first polygon along a ray, ``occluded`` whether any polygon lies along
it.  A ray is an open segment: crossings with ``0 < t < far`` count, ``t`` in units of the
direction's length, so a shadow ray from a point to a light sample has direction ``sample - point``
and ``far = 1``.  Brute force (:mod:`workbench.accel.brute`) is the judge of every accelerator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.arrays import as_points
from workbench.counters import Counters
from workbench.errors import InputError

__all__ = ["Accelerator", "Hits", "NO_POLYGON", "Rays", "as_rays", "as_skip_polygons"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NO_POLYGON = -1
"""Polygon index of a ray that met nothing, and of an unused place in ``skip_polygons``."""


@dataclass(frozen=True)
class Hits:
    """The first crossing of each ray.

    Parameters
    ----------
    t : (n,) float
        Distance in units of the direction's length; ``inf`` for a miss.
    polygon : (n,) int
        Index into the geometry's polygons; -1 for a miss.  Accelerators that know exact spheres
        number them on from the last polygon.
    """

    t: FloatArray
    polygon: IntArray


@runtime_checkable
class Accelerator(Protocol):
    """What every tracer offers.

    ``skip_polygons`` is ``(n, 2)`` (or one row for all rays): polygons that never count for that
    ray, -1 for none.  It excludes the receiver's and the sender's own polygon by identity, never
    by distance.
    """

    name: str
    counters: Counters

    def closest_hit(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        far: float | ArrayLike = np.inf,
        skip_polygons: ArrayLike | None = None,
    ) -> Hits:
        """First crossing of each ray; the lower polygon index wins a tie."""
        ...

    def occluded(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        far: float | ArrayLike = 1.0,
        skip_polygons: ArrayLike | None = None,
    ) -> NDArray[np.bool_]:
        """Whether anything lies along each ray, (n,)."""
        ...


@dataclass(frozen=True)
class Rays:
    """Checked rays: origins and directions (n, 3), far (n,), skip_polygons (n, 2)."""

    origins: FloatArray
    directions: FloatArray
    far: FloatArray
    skip_polygons: IntArray

    def __len__(self) -> int:
        return len(self.origins)


def _own(array: NDArray, dtype: type = np.float64) -> NDArray:
    # Contiguous and writable: numba compiles a kernel again for read-only arrays.
    return np.require(array, dtype=dtype, requirements=["C", "W"])


def as_skip_polygons(values: ArrayLike | None, count: int) -> IntArray:
    """Polygon indices as ``(count, 2)``; ``None`` skips nothing, one row serves all.

    Raises
    ------
    InputError
        If the values are not integers or the shape is neither (2,), (1, 2) nor (count, 2).
    """
    array = np.full((1, 2), NO_POLYGON) if values is None else np.atleast_2d(np.asarray(values))
    if not np.issubdtype(array.dtype, np.integer):
        raise InputError(f"skip_polygons: found {array.dtype} values, expected integers")
    if array.ndim != 2 or array.shape[1] != 2 or array.shape[0] not in (1, count):
        raise InputError(f"skip_polygons: found shape {array.shape}, expected ({count}, 2)")
    return _own(np.broadcast_to(array, (count, 2)), np.int64)


def as_rays(
    origins: ArrayLike,
    directions: ArrayLike,
    far: float | ArrayLike,
    skip_polygons: ArrayLike | None,
) -> Rays:
    """Check and broadcast the arguments of a question: one origin or direction serves all rays.

    Raises
    ------
    InputError
        If shapes do not agree, a value is not finite, a direction has no length, or ``far`` is
        negative or NaN.
    """
    start, along = as_points(origins, "origins"), as_points(directions, "directions")
    if len(start) != len(along):
        if 1 not in (len(start), len(along)):
            raise InputError(f"origins and directions: found {len(start)} and {len(along)} rows, expected as many")
        count = max(len(start), len(along)) if min(len(start), len(along)) else 0
        start, along = np.broadcast_to(start, (count, 3)), np.broadcast_to(along, (count, 3))
    still = ~along.any(axis=1)
    if still.any():
        raise InputError(f"directions: row {int(np.argmax(still))} has length zero")
    try:
        limit = np.broadcast_to(np.asarray(far, dtype=np.float64), (len(start),))
    except ValueError:
        raise InputError(f"far: found shape {np.shape(far)}, expected one value or ({len(start)},)") from None
    if not (limit >= 0.0).all():
        raise InputError(f"far: row {int(np.argmin(limit >= 0.0))} is negative or not a number")
    return Rays(_own(start), _own(along), _own(limit), as_skip_polygons(skip_polygons, len(start)))
