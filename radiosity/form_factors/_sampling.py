"""Where samples fall: streams of random numbers and points on polygons, as kernels."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

_S15 = math.sqrt(15.0)
_A, _B = (6.0 - _S15) / 21.0, (6.0 + _S15) / 21.0
RADON_POINTS = np.array(
    [
        [1 / 3, 1 / 3, 1 / 3],
        [1 - 2 * _A, _A, _A], [_A, 1 - 2 * _A, _A], [_A, _A, 1 - 2 * _A],
        [1 - 2 * _B, _B, _B], [_B, 1 - 2 * _B, _B], [_B, _B, 1 - 2 * _B],
    ]
)  # fmt: skip
RADON_WEIGHTS = np.array([9 / 40, *[(155 - _S15) / 1200] * 3, *[(155 + _S15) / 1200] * 3])
"""Radon's rule of seven points, exact to the fifth degree."""


@njit(nogil=True, cache=True, inline="always")
def stream(a, b, seed):
    """SplitMix64 of three integers: an independent stream for each element, patch and seed."""
    h = np.uint64(a) * np.uint64(0x9E3779B97F4A7C15)
    h ^= np.uint64(b) * np.uint64(0xBF58476D1CE4E5B9) + np.uint64(seed) * np.uint64(0x94D049BB133111EB)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return h ^ (h >> np.uint64(31))


@njit(nogil=True, cache=True)
def place_on_pieces(corners, starts, first, last, total, u, v, out):
    """Point of the pieces ``first..last`` at (u, v), uniform by area; returns its piece."""
    goal = u * total
    for piece in range(first, last):
        a, b = starts[piece], starts[piece + 1]
        for k in range(a + 1, b - 1):
            e0, e1, e2 = corners[k, 0] - corners[a, 0], corners[k, 1] - corners[a, 1], corners[k, 2] - corners[a, 2]
            f0, f1, f2 = (
                corners[k + 1, 0] - corners[a, 0],
                corners[k + 1, 1] - corners[a, 1],
                corners[k + 1, 2] - corners[a, 2],
            )
            c0, c1, c2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
            area = 0.5 * math.sqrt(c0 * c0 + c1 * c1 + c2 * c2)
            if goal <= area or (piece == last - 1 and k == b - 2):
                s = math.sqrt(min(max(goal / area, 0.0), 1.0)) if area > 0.0 else 0.0
                # Uniform on a triangle: distance from the first corner by sqrt, across by v.
                p, q = s * (1.0 - v), s * v
                out[0] = corners[a, 0] + p * e0 + q * f0
                out[1] = corners[a, 1] + p * e1 + q * f1
                out[2] = corners[a, 2] + p * e2 + q * f2
                return piece
            goal -= area
    return last - 1
