"""Solid textures: patterns in space that scale a surface's reflectance, fine enough to alias."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from workbench.errors import InputError

__all__ = ["Checker", "Noise", "Texture"]

FloatArray = NDArray[np.float64]


class Texture(Protocol):
    """What a surface's reflectance is multiplied by."""

    def __call__(self, points: FloatArray) -> FloatArray:
        """Factors (n, bands) or (n, 1) at ``points`` (n, 3) in scene coordinates."""
        ...


@dataclass(frozen=True)
class Checker:
    """Cubes of two factors in turn.

    Parameters
    ----------
    size : float
        Edge of a cube. [scene lengths]
    first, second : float or (bands,) float
        Factors on the reflectance. [0..1]
    axes : str
        Axes along which the pattern changes; ``"xy"`` makes columns along z.
    origin : (3,) float
        A corner of the pattern.  Away from any surface along an axis, or the surface flickers.
    """

    size: float
    first: ArrayLike = 1.0
    second: ArrayLike = 0.2
    axes: str = "xy"
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not self.size > 0 or not set(self.axes) <= set("xyz") or not self.axes:
            raise InputError(f"checker: found size {self.size} and axes {self.axes!r}, expected > 0 and some of 'xyz'")

    def __call__(self, points: FloatArray) -> FloatArray:
        columns = ["xyz".index(axis) for axis in self.axes]
        cell = np.floor((points[:, columns] - np.asarray(self.origin)[columns]) / self.size)
        odd = (cell.sum(axis=1) % 2).astype(bool)
        first, second = np.atleast_1d(np.asarray(self.first)), np.atleast_1d(np.asarray(self.second))
        return np.where(odd[:, None], second, first).astype(np.float64)


@dataclass(frozen=True)
class Noise:
    """Smooth lattice noise summed over octaves (fractal noise), from ``low`` to ``high``.

    Parameters
    ----------
    size : float
        Width of the largest features. [scene lengths]
    low, high : float or (bands,) float
        Factors on the reflectance where the noise is least and greatest. [0..1]
    octaves : int
        Each next one has half the size and half the weight.
    contrast : float
        Slope at the mean; large values make hard-edged spots.
    seed : int
    """

    size: float
    low: ArrayLike = 0.2
    high: ArrayLike = 1.0
    octaves: int = 3
    contrast: float = 1.5
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.size > 0 or self.octaves < 1:
            raise InputError(f"noise: found size {self.size} and octaves {self.octaves}, expected > 0 and 1 or more")

    def __call__(self, points: FloatArray) -> FloatArray:
        low, high = np.broadcast_arrays(np.atleast_1d(self.low), np.atleast_1d(self.high))
        return _noise(
            points, 1.0 / self.size, self.octaves, self.seed, self.contrast,
            np.array(low, dtype=np.float64), np.array(high, dtype=np.float64),
        )  # fmt: skip


@njit(nogil=True, cache=True, inline="always")
def _lattice(x, y, z, seed):
    # A number in [0, 1) for each lattice point; an integer hash, good enough for pictures.
    h = np.uint32(x * 374761393 + y * 668265263 + z * 2147483647 + seed * 1274126177)
    h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(1274126177))
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(2246822519))
    return float(h ^ (h >> np.uint32(15))) / 4294967296.0


@njit(nogil=True, cache=True)
def _noise(points, frequency, octaves, seed, contrast, low, high):
    found = np.empty((points.shape[0], low.shape[0]))
    for i in range(points.shape[0]):
        total = weight = 0.0
        scale, share = frequency, 1.0
        for octave in range(octaves):
            x, y, z = points[i, 0] * scale, points[i, 1] * scale, points[i, 2] * scale
            fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
            ix, iy, iz = int(fx), int(fy), int(fz)
            u, v, w = x - fx, y - fy, z - fz
            u, v, w = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v), w * w * (3.0 - 2.0 * w)
            value = 0.0
            for dx in range(2):
                for dy in range(2):
                    for dz in range(2):
                        part = (u if dx else 1.0 - u) * (v if dy else 1.0 - v) * (w if dz else 1.0 - w)
                        value += part * _lattice(ix + dx, iy + dy, iz + dz, seed + octave)
            total += share * value
            weight += share
            scale, share = scale * 2.0, share * 0.5
        share = min(max(0.5 + contrast * (total / weight - 0.5), 0.0), 1.0)
        for band in range(low.shape[0]):
            found[i, band] = low[band] + share * (high[band] - low[band])
    return found
