"""Checks that turn what a caller gives into arrays of known shape and type, and numbers of a known range."""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.errors import InputError, OptionError

__all__ = [
    "as_bands",
    "as_count",
    "as_fraction",
    "as_places",
    "as_points",
    "as_positive",
    "as_unit_vectors",
    "readonly",
]


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


def as_places(points: ArrayLike, normals: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points and unit normals, both (n, 3), of one or more places; a single normal serves all points.

    Raises
    ------
    InputError
        If there is no point, or points and normals do not belong together.
    """
    where, facing = as_points(points), as_unit_vectors(normals)
    if len(where) == 0:
        raise InputError("points: found none, expected one or more")
    if len(facing) == 1 and len(where) > 1:
        facing = np.repeat(facing, len(where), axis=0)
    if len(facing) != len(where):
        raise InputError(f"normals: found {len(facing)} rows for {len(where)} points")
    return where, facing


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


def as_count(value: Any, name: str, least: int = 1) -> int:
    """A whole number; a float such as 1e4 counts as one.

    Raises
    ------
    OptionError
        If it is no whole number, or below ``least``.
    """
    whole = isinstance(value, (float, np.floating)) and float(value).is_integer()
    try:
        count = int(value) if whole else operator.index(value)
    except TypeError:
        raise OptionError(f"{name}: found {value!r}, expected a whole number of {least} or more") from None
    if count < least:
        raise OptionError(f"{name}: found {count}, expected {least} or more")
    return count


def _as_float(value: Any) -> float:
    """The number, or nan if it is none."""
    try:
        return math.nan if isinstance(value, str) else float(value)
    except (TypeError, ValueError):
        return math.nan


def as_fraction(value: Any, name: str) -> float:
    """A number between 0 and 1, neither of them.

    Raises
    ------
    OptionError
        If it is none.
    """
    number = _as_float(value)
    if not 0.0 < number < 1.0:
        raise OptionError(f"{name}: found {value!r}, expected a number between 0 and 1")
    return number


def as_positive(value: Any, name: str, expected: str = "a positive number") -> float:
    """A finite number above 0.

    Raises
    ------
    OptionError
        If it is none: ``expected`` says what was wanted.
    """
    number = _as_float(value)
    if not 0.0 < number < math.inf:
        raise OptionError(f"{name}: found {value!r}, expected {expected}")
    return number


def readonly(array: NDArray) -> NDArray:
    """The array itself, with writing switched off."""
    array.setflags(write=False)
    return array
