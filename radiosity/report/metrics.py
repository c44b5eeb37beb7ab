"""Error against a reference, with its own standard error; what is on the frontier, and how fast errors fall."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.errors import InputError

__all__ = ["at_error", "frontier", "relative_rms", "resolution", "slope"]

FloatArray = NDArray[np.float64]


def relative_rms(found: ArrayLike, reference: ArrayLike, variance: ArrayLike = 0.0) -> tuple[float, float]:
    """Root mean square error relative to the mean of the reference, and the standard error of that.

    Parameters
    ----------
    found, reference : (n, ...) float
        Rows are points, patches or pixels.
    variance : float or (n, ...) float
        Variance of the reference itself: what it adds to the mean square on average is taken off.

    Returns
    -------
    error, standard_error : float
        The second by the spread of the rows' squared errors, carried through the root.

    Raises
    ------
    InputError
        If shapes differ, a value is not finite or the reference is 0 everywhere.
    """
    values, exact = np.asarray(found, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    if values.shape != exact.shape:
        raise InputError(f"relative_rms: found shapes {values.shape} and {exact.shape}, expected the same")
    if not (np.isfinite(values).all() and np.isfinite(exact).all()):
        raise InputError("relative_rms: found values that are not finite")
    mean = float(np.abs(exact).mean())
    if mean == 0.0:
        raise InputError("relative_rms: found a reference of 0 everywhere, so no error is relative to it")
    square = (values - exact) ** 2 - np.asarray(variance)
    rows = square.reshape(len(square), -1).mean(axis=1)
    error = math.sqrt(max(float(rows.mean()), 0.0))
    spread = float(rows.std(ddof=1)) / math.sqrt(len(rows)) if len(rows) > 1 else 0.0
    # d sqrt(x) = dx / (2 sqrt x); near 0 the root of the spread is all that can be said.
    return error / mean, min(spread / (2.0 * error) if error > 0 else math.inf, math.sqrt(spread)) / mean


def resolution(reference: ArrayLike, variance: ArrayLike) -> float:
    """Least relative error that can be told from none, against a reference whose noise is taken off.

    The squared noise of a row has a standard deviation of sqrt(2) times its variance (of Gaussian noise, alike in
    all bands); twice the standard error of the mean over the rows is what may be left of it.

    Parameters
    ----------
    reference, variance : (n, ...) float
        As in :func:`relative_rms`.
    """
    exact, noise = np.asarray(reference, dtype=np.float64), np.asarray(variance, dtype=np.float64)
    rows = noise.reshape(len(noise), -1).mean(axis=1)
    left = 2.0 * math.sqrt(2.0 * float((rows**2).sum())) / len(rows)
    return math.sqrt(left) / float(np.abs(exact).mean())


def frontier(seconds: Sequence[float], errors: Sequence[float]) -> list[int]:
    """Indices of the points that no other beats in both, from fast to exact (V. Pareto 1906)."""
    order = sorted(range(len(seconds)), key=lambda i: (seconds[i], errors[i]))
    kept: list[int] = []
    for index in order:
        if not kept or errors[index] < errors[kept[-1]]:
            kept.append(index)
    return kept


def slope(seconds: Sequence[float], errors: Sequence[float]) -> float | None:
    """Exponent p of error ~ seconds^p by least squares of the logarithms; ``None`` below three points.

    Random samples have p = -1/2, errors along shadow edges in even samples -3/4 and better.
    """
    pairs = [(math.log(t), math.log(e)) for t, e in zip(seconds, errors, strict=True) if t > 0 and e > 0]
    if len(pairs) < 3 or max(x for x, _ in pairs) - min(x for x, _ in pairs) < math.log(1.5):
        return None
    x, y = np.asarray(pairs).T
    return float(((x - x.mean()) * (y - y.mean())).sum() / ((x - x.mean()) ** 2).sum())


def at_error(seconds: Sequence[float], errors: Sequence[float], error: float) -> float | None:
    """Seconds of the frontier at an error, between its points along straight lines of the logarithms.

    An error above the largest is had for the seconds of the fastest point.  ``None`` below the
    smallest error: no point got there.
    """
    chosen = frontier(seconds, errors)
    if not chosen or error < errors[chosen[-1]]:
        return None
    for before, after in itertools.pairwise(chosen):
        high, low = errors[before], errors[after]
        if low <= error < high:
            if low <= 0.0:
                return seconds[after]
            part = math.log(high / error) / math.log(high / low)
            return float(seconds[before] ** (1.0 - part) * seconds[after] ** part)
    return seconds[chosen[0] if error >= errors[chosen[0]] else chosen[-1]]
