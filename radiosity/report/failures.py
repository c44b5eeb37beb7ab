"""What a failure is, what became of a technique on it, and formulas for what is right.

Every entry of the catalogue (:mod:`radiosity.report.catalogue`) is a small scene with one number that a
formula gives, and the techniques that claim to find it.  A technique is *right* within the entry's
tolerance; it *degrades* where it is further off but its own stated error says so; it *refuses* with a
reason; it *disclaims* where it is further off and its documentation names the case; anything else is
*wrong silently*, which no technique of ours may be.  Rivals are judged alike; what they state is the
spread of a few independent runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.errors import WorkbenchError

__all__ = ["Cell", "Failure", "contour_factor", "judge", "point_irradiance"]

FloatArray = NDArray[np.float64]

STATED = 4.0
"""A technique's stated error counts as said up to this many times: it is one standard error, or about."""


@dataclass(frozen=True)
class Failure:
    """One entry of the catalogue.

    Parameters
    ----------
    name, group : str
    about : str
        What breaks, and what a broken technique gives.
    expected : float
    tolerance : float
        Largest error that is still right, in the unit of ``expected``.
    techniques : dict
        Name to function; each returns the value and the error that the technique states (nan: none).
    disclaimed : dict
        Techniques whose documentation says that they do not handle this, and what it says.
    """

    name: str
    group: str
    about: str
    expected: float
    tolerance: float
    techniques: Mapping[str, Callable[[], tuple[float, float]]]
    disclaimed: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Cell:
    """What became of one technique on one entry.

    ``verdict`` is ``right``, ``degrades``, ``refuses``, ``disclaims`` or ``wrong``; ``error`` is signed, relative to
    the expected value (or absolute where that is 0), nan after a refusal; ``reason`` says why it refused
    or disclaims.
    """

    verdict: str
    error: float
    stated: float
    reason: str = ""


def judge(entry: Failure, technique: str) -> Cell:
    """Run one technique on one entry."""
    scale = abs(entry.expected) or 1.0
    try:
        value, stated = entry.techniques[technique]()
    except WorkbenchError as refused:
        return Cell("refuses", math.nan, math.nan, str(refused))
    off = value - entry.expected
    if not math.isfinite(off):
        return Cell("wrong", off, stated)
    if abs(off) <= entry.tolerance:
        verdict = "right"
    else:
        verdict = "degrades" if abs(off) <= STATED * stated + entry.tolerance else "wrong"
    if verdict == "wrong" and technique in entry.disclaimed:
        return Cell("disclaims", off / scale, stated / scale, entry.disclaimed[technique])
    return Cell(verdict, off / scale, stated / scale)


# ---- formulas ---------------------------------------------------------------------------------------


def point_irradiance(ring: ArrayLike, point: ArrayLike = (0, 0, 0), normal: ArrayLike = (0, 0, 1)) -> float:
    """Irradiance at a point from a polygon of radiance 1 wholly above its horizon (J. H. Lambert, 1760).

    Half the sum over the edges of the angle that each subtends times the cosine between the
    normal and the plane through the point and the edge.
    """
    toward = np.asarray(ring, dtype=float) - np.asarray(point, dtype=float)
    following = np.roll(toward, -1, axis=0)
    cross = np.cross(toward, following)
    length = np.linalg.norm(cross, axis=1)
    angle = np.arctan2(length, np.einsum("ij,ij->i", toward, following))
    cosine = cross @ np.asarray(normal, dtype=float) / np.where(length > 0, length, 1.0)
    return 0.5 * abs(float(angle @ cosine))


def contour_factor(first: ArrayLike, second: ArrayLike) -> float:
    """Form factor from one planar polygon to another that it sees whole, by the double contour integral.

    F = 1 / (2 pi A) times the sum over pairs of edges of their product by the mean logarithm of their
    distance (E. M. Sparrow 1963).  The inner integral is in closed form, the outer one by the
    double-exponential rule of H. Takahasi and M. Mori (1974), which endures logarithms at its ends.
    """
    p, q = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    step = np.arange(-48, 49) / 14.0
    place = 0.5 * (1.0 + np.tanh(0.5 * math.pi * np.sinh(step)))
    weight = 0.25 * math.pi * np.cosh(step) / np.cosh(0.5 * math.pi * np.sinh(step)) ** 2 / 14.0
    total = 0.0
    for a, b in zip(p, np.roll(p, -1, axis=0), strict=True):
        x = a + place[:, None] * (b - a)
        for c, d in zip(q, np.roll(q, -1, axis=0), strict=True):
            parallel = float((b - a) @ (d - c))
            if parallel != 0.0:
                total += parallel * float(weight @ _mean_logarithm(x, c, d))
    area = 0.5 * np.linalg.norm(np.cross(p, np.roll(p, -1, axis=0)).sum(axis=0))
    return abs(total) / (2.0 * math.pi * float(area))  # the sign tells which way round each ring runs


def _mean_logarithm(x: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    """Mean over the segment c d of the logarithm of the distance from each point x."""
    length = float(np.linalg.norm(d - c))
    along = (d - c) / length
    near = (c - x) @ along
    far = near + length
    aside = np.sqrt(np.maximum(((c - x) ** 2).sum(axis=1) - near**2, 0.0))

    def part(t: FloatArray) -> FloatArray:
        square = t * t + aside * aside
        log = 0.5 * np.log(np.where(square > 0, square, 1.0))
        return t * log - t + np.where(aside > 0, aside * np.arctan2(t, np.where(aside > 0, aside, 1.0)), 0.0)

    return np.asarray((part(far) - part(near)) / length)


# ---- rivals -----------------------------------------------------------------------------------------


SEEDS = 4
"""Independent runs of a rival, whose spread is the error that it states."""


def spread_of(ask: Callable[[int], float]) -> tuple[float, float]:
    """The mean of a few runs with different seeds, and its standard error."""
    runs = [ask(seed) for seed in range(SEEDS)]
    return float(np.mean(runs)), float(np.std(runs, ddof=1)) / math.sqrt(SEEDS)
