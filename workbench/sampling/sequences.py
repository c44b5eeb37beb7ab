"""Point sets of the unit square: how K samples of a light, a pixel or a hemisphere are spread.

Every set is ``(count, 2)`` in [0, 1)^2 and comes from an explicit ``rng``.  Each point on its own
is uniform, so the mean of a function over a set is an unbiased estimate of its integral; the sets
differ in how evenly they fill the square and therefore in variance.

*Stratified* sampling comes in two forms: :func:`jittered` (a place of its own in each stratum)
and :func:`uniform_jitter` (one random place, the same in all strata).

One set serves many points to be shaded when each has it moved in its own way: by a toroidal shift
(:func:`shifted`, Cranley and Patterson) or by a scramble of its own (:func:`owen_sobol`).  Both
hash the point's index, so the answer does not depend on how points are shared out to workers.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from workbench.errors import InputError

__all__ = [
    "SEQUENCES",
    "hashed",
    "independent",
    "jittered",
    "multijittered",
    "n_rooks",
    "owen_scramble",
    "owen_sobol",
    "point_set",
    "r2",
    "scrambled",
    "shifted",
    "sobol",
    "sobol_bits",
    "uniform_jitter",
]

FloatArray = NDArray[np.float64]
Seed = int | np.random.Generator

_BELOW_ONE = 1.0 - 2.0**-53
_PLASTIC = 1.3247179572447460260  # the real root of x^3 = x + 1


def _checked(count: int, rng: Seed) -> np.random.Generator:
    if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 1:
        raise InputError(f"count: found {count!r}, expected a whole number of 1 or more")
    return np.random.default_rng(rng)


def _strata(count: int) -> tuple[FloatArray, FloatArray]:
    # Lower corners and sizes (count, 2) of strata of equal area, as square as the count allows:
    # columns of unequal numbers have widths in proportion.
    columns = max(1, round(math.sqrt(count)))
    rows = np.full(columns, count // columns)
    rows[: count % columns] += 1
    width = np.repeat(rows / count, rows)
    left = np.repeat(np.cumsum(rows) - rows, rows) / count
    place = np.arange(count) - np.repeat(np.cumsum(rows) - rows, rows)
    height = 1.0 / np.repeat(rows, rows)
    return np.column_stack([left, place * height]), np.column_stack([width, height])


def independent(count: int, rng: Seed) -> FloatArray:
    """Independent uniform points (count, 2): the slow honest one that the others are judged by."""
    return _checked(count, rng).random((count, 2))


def jittered(count: int, rng: Seed) -> FloatArray:
    """One random point in each of ``count`` strata of equal area, (count, 2).

    A square number gives the usual grid; other numbers columns of unequal numbers of strata.
    Source: R. L. Cook, "Stochastic sampling in computer graphics" (ACM TOG 5(1), 1986).
    """
    random = _checked(count, rng)
    corner, size = _strata(count)
    return np.minimum(corner + size * random.random((count, 2)), _BELOW_ONE)


def uniform_jitter(count: int, rng: Seed) -> FloatArray:
    """One random place, the same in each of ``count`` strata of equal area, (count, 2).

    Source: R. Ramamoorthi, J. Anderson, M. Meyer and D. Nowrouzezahrai, "A theory of Monte Carlo
    visibility sampling" (ACM TOG 31(5), 2012), who find it better than jitter for linear lights.
    """
    random = _checked(count, rng)
    corner, size = _strata(count)
    return np.minimum(corner + size * random.random((1, 2)), _BELOW_ONE)


def n_rooks(count: int, rng: Seed) -> FloatArray:
    """Points (count, 2), one in each of ``count`` rows and one in each of ``count`` columns.

    Source: P. Shirley, "Discrepancy as a quality measure for sample distributions"
    (Eurographics 1991); also called Latin hypercube sampling.
    """
    random = _checked(count, rng)
    cells = np.column_stack([random.permutation(count), random.permutation(count)])
    return np.minimum((cells + random.random((count, 2))) / count, _BELOW_ONE)


def multijittered(count: int, rng: Seed) -> FloatArray:
    """Jittered and N-rooks at once, (count, 2), on the most nearly square grid that holds ``count``.

    The grid has c columns and count / c rows, c the largest divisor up to the square root; a prime
    count is N-rooks.  Source: K. Chiu, P. Shirley and C. Wang, "Multi-jittered sampling"
    (Graphics Gems IV, 1994), with its rows and columns of sub-cells shuffled.
    """
    random = _checked(count, rng)
    columns = next(c for c in range(math.isqrt(count), 0, -1) if count % c == 0)
    rows = count // columns
    # Sub-column of the cell (i, j) inside column i, and its sub-row inside row j.
    across = np.stack([random.permutation(rows) for _ in range(columns)])
    along = np.stack([random.permutation(columns) for _ in range(rows)], axis=1)
    i, j = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")
    cells = np.column_stack([(i * rows + across).ravel(), (j * columns + along).ravel()])
    return np.minimum((cells + random.random((count, 2))) / count, _BELOW_ONE)


def r2(count: int, rng: Seed) -> FloatArray:
    """The R2 lattice (count, 2), moved by one random toroidal shift.

    Source: M. Roberts, "The unreasonable effectiveness of quasirandom sequences" (2018): multiples
    of 1/g and 1/g^2, g the plastic number.
    """
    shift = _checked(count, rng).random(2)
    step = np.array([1.0 / _PLASTIC, 1.0 / (_PLASTIC * _PLASTIC)])
    return np.minimum((shift + np.arange(count)[:, None] * step) % 1.0, _BELOW_ONE)


@njit(nogil=True, cache=True)
def _sobol_bits(count):
    out = np.zeros((count, 2), dtype=np.uint32)
    for k in range(count):
        x = y = np.uint32(0)
        direction = np.uint32(0x80000000)
        place = np.uint32(0x80000000)
        rest = k
        while rest:
            if rest & 1:
                x ^= place
                y ^= direction
            rest >>= 1
            place >>= np.uint32(1)
            direction ^= direction >> np.uint32(1)
        out[k, 0], out[k, 1] = x, y
    return out


def sobol_bits(count: int) -> NDArray[np.uint32]:
    """The first ``count`` points of the plain Sobol sequence, (count, 2), as 32-bit binary fractions.

    Any aligned block of a power of two of them is a (0, m, 2)-net.  The first coordinate is the reversed index (van
    der Corput), the second comes from the Pascal matrix (I. M. Sobol, 1967).
    """
    _checked(count, 0)
    bits: NDArray[np.uint32] = _sobol_bits(count)
    return bits


@njit(nogil=True, cache=True)
def hashed(index, seed):
    """64 random bits of a pair of whole numbers (SplitMix64): a stream's seed for each index."""
    h = np.uint64(index) * np.uint64(0x9E3779B97F4A7C15)
    h ^= np.uint64(seed) * np.uint64(0xBF58476D1CE4E5B9) + np.uint64(0x94D049BB133111EB)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return h ^ (h >> np.uint64(31))


@njit(nogil=True, cache=True)
def _reversed_bits(x):
    x = ((x & np.uint32(0x55555555)) << np.uint32(1)) | ((x >> np.uint32(1)) & np.uint32(0x55555555))
    x = ((x & np.uint32(0x33333333)) << np.uint32(2)) | ((x >> np.uint32(2)) & np.uint32(0x33333333))
    x = ((x & np.uint32(0x0F0F0F0F)) << np.uint32(4)) | ((x >> np.uint32(4)) & np.uint32(0x0F0F0F0F))
    x = ((x & np.uint32(0x00FF00FF)) << np.uint32(8)) | ((x >> np.uint32(8)) & np.uint32(0x00FF00FF))
    return np.uint32((x << np.uint32(16)) | (x >> np.uint32(16)))


@njit(nogil=True, cache=True)
def owen_scramble(bits, seed):
    """Nested uniform scramble of one 32-bit binary fraction; ``seed`` has 32 bits.

    Each binary digit is turned or kept by a hash of the digits before it, which keeps every
    elementary interval of a (t, m, s)-net: as many points in it as before.
    Source: B. Burley, "Practical hash-based Owen scrambling" (JCGT 9(4), 2020), after
    A. B. Owen (1995) and S. Laine and T. Karras (2011).
    """
    x = _reversed_bits(np.uint32(bits))
    x = np.uint32(x + np.uint32(seed))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x6C50B47C)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0xB82F1E52)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0xC7AFE638)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x8D22F6E6)))
    return _reversed_bits(x)


@njit(nogil=True, cache=True)
def scrambled(bits, own, out):
    """Points (k, 2) in [0, 1) of ``bits`` (k, 2), each axis scrambled by its half of the 64 bits ``own``."""
    for axis in range(2):
        digits = np.uint32((own >> np.uint64(32 * axis)) & np.uint64(0xFFFFFFFF))
        for k in range(bits.shape[0]):
            # The middle of the 2^-32 that the 32 digits leave open.
            out[k, axis] = (np.float64(owen_scramble(bits[k, axis], digits)) + 0.5) * 2.0**-32


@njit(nogil=True, cache=True)
def _owen(bits, first, seed, out):
    for row in range(out.shape[0]):
        scrambled(bits, hashed(first + row, seed), out[row])


@njit(nogil=True, cache=True)
def _shift(points, first, seed, out):
    for row in range(out.shape[0]):
        h = hashed(first + row, seed)
        for axis in range(2):
            move = np.float64((h >> np.uint64(32 * axis)) & np.uint64(0xFFFFFFFF)) * 2.0**-32
            for k in range(points.shape[0]):
                value = points[k, axis] + move
                out[row, k, axis] = value - 1.0 if value >= 1.0 else value


def sobol(count: int, rng: Seed) -> FloatArray:
    """The first ``count`` Sobol points, Owen-scrambled, (count, 2); best at powers of two."""
    seed = int(_checked(count, rng).integers(2**62))
    return owen_sobol(1, count, seed)[0]


def owen_sobol(rows: int, count: int, seed: int, first: int = 0) -> FloatArray:
    """``count`` Sobol points for each of ``rows`` points to be shaded, each scrambled on its own.

    Parameters
    ----------
    rows, count : int
    seed : int
    first : int
        Index of the first row: blocks ``first`` to ``first + rows - 1`` of one long list.

    Returns
    -------
    (rows, count, 2) float
    """
    out = np.empty((_rows(rows), int(count), 2))
    _owen(sobol_bits(count), first, seed, out)
    return out


def shifted(points: ArrayLike, rows: int, seed: int, first: int = 0) -> FloatArray:
    """One point set, moved round the unit torus in its own way for each of ``rows`` points.

    Source: R. Cranley and T. N. L. Patterson, "Randomization of number theoretic methods for
    multiple integration" (SIAM J. Numer. Anal. 13(6), 1976).

    Parameters
    ----------
    points : (count, 2) float
        In [0, 1).
    rows, seed, first : int
        As in :func:`owen_sobol`.

    Returns
    -------
    (rows, count, 2) float

    Raises
    ------
    InputError
        If ``points`` has another shape or leaves the square.
    """
    base = np.ascontiguousarray(points, dtype=np.float64)
    if base.ndim != 2 or base.shape[1] != 2 or not ((base >= 0.0) & (base < 1.0)).all():
        raise InputError(f"points: found shape {base.shape}, expected (count, 2) values in [0, 1)")
    out = np.empty((_rows(rows), len(base), 2))
    _shift(base, first, seed, out)
    return out


def _rows(rows: int) -> int:
    if isinstance(rows, bool) or not isinstance(rows, (int, np.integer)) or rows < 0:
        raise InputError(f"rows: found {rows!r}, expected a whole number of 0 or more")
    return int(rows)


SEQUENCES = {
    "independent": independent,
    "jittered": jittered,
    "multijittered": multijittered,
    "n-rooks": n_rooks,
    "r2": r2,
    "sobol": sobol,
    "uniform-jitter": uniform_jitter,
}
"""Every point set by name; all share the signature ``(count, rng)``."""


def point_set(name: str, count: int, rng: Seed) -> FloatArray:
    """The point set called ``name``, (count, 2) in [0, 1)^2.

    Raises
    ------
    InputError
        If no set has that name or ``count`` is not 1 or more.
    """
    if name not in SEQUENCES:
        raise InputError(f"sampler: found {name!r}, expected one of {', '.join(SEQUENCES)}")
    return SEQUENCES[name](count, rng)
