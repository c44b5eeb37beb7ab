"""Checks that turn what a caller gives into arrays of known shape and type."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.errors import InputError

__all__ = ["as_bands", "as_points", "as_unit_vectors", "readonly"]


def as_points(values: ArrayLike, name: str = "points") -> NDArray[np.float64]:
    """Finite points or vectors as an ``(n, 3)`` float array; a single triple becomes ``(1, 3)``.

    Raises
    ------
    InputError
        If the shape is not ``(n, 3)`` or a value is not finite.
    """
    try:
        array = np.atleast_2d(np.asarray(values, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected numbers in an (n, 3) array; {error}") from None
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{name}: found shape {array.shape}, expected (n, 3)")
    if not np.isfinite(array).all():
        raise InputError(f"{name}: row {int(np.argmin(np.isfinite(array).all(axis=1)))} is not finite")
    return np.ascontiguousarray(array)


def as_unit_vectors(values: ArrayLike, name: str = "normals") -> NDArray[np.float64]:
    """Vectors as an ``(n, 3)`` array of length 1.

    Raises
    ------
    InputError
        If the shape is not ``(n, 3)``, a value is not finite or a vector has no length.
    """
    array = as_points(values, name)
    length = np.linalg.norm(array, axis=1)
    if (length == 0).any():
        raise InputError(f"{name}: row {int(np.argmin(length))} has length zero")
    return np.ascontiguousarray(array / length[:, None])


def as_bands(values: ArrayLike, bands: int, name: str = "values") -> NDArray[np.float64]:
    """A scalar, one value or ``bands`` values as a ``(bands,)`` float array.

    Raises
    ------
    InputError
        If the number of values is neither 1 nor ``bands``, or one is not finite.
    """
    try:
        array = np.atleast_1d(np.asarray(values, dtype=np.float64))
    except (TypeError, ValueError):
        raise InputError(f"{name}: found {values!r}, expected {bands} number(s)") from None
    if array.ndim != 1 or array.size not in (1, bands):
        raise InputError(f"{name}: found {array.size} values, expected 1 or {bands}")
    if not np.isfinite(array).all():
        raise InputError(f"{name}: found {values!r}, expected finite numbers")
    return np.ascontiguousarray(np.broadcast_to(array, (bands,)))


def readonly(array: NDArray) -> NDArray:
    """The array itself, with writing switched off."""
    array.setflags(write=False)
    return array
