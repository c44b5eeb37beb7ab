"""Receivers sorted into tiles of neighbours, for culls and lists of candidates that they share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workbench.geometry.polygons import plane_basis

__all__ = ["DIFFERENT", "Tiles", "sort_into_tiles"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MOST = (96, 1024)
"""Points a tile, about: a 256th of a plane's, but at least and at most these."""
LEAST = 8
"""Points on one plane that make tiles of their own; fewer are scattered."""
SCATTERED = 64
"""Most scattered points a tile, and of those of a plane that lie together inside it."""
DIFFERENT = -2
"""Polygon of a tile whose points lie on several."""
CELLS = 32
"""Scattered points share a tile inside one of so many cells along the longest side of their bounds."""


@dataclass(frozen=True)
class Tiles:
    """n points in t tiles: each of one plane, or of a small cell of space.

    Parameters
    ----------
    order : (n,) int
        The given row of each sorted point.
    points, normals : (n, 3) float
    own : (n,) int
        Polygon on which each point lies, -1 for none.
    flat : (n, 2) float
        Place on the tile's plane; zero where a tile is not flat.
    start : (t + 1,) int
        Tile ``i`` is rows ``start[i]:start[i + 1]``; neighbours in it lie close together.
    bounds : (t, 2, 3) float
    normal, offset : (t, 3), (t,) float
        Half-space that holds all that its points see; the normal is zero where a tile is not flat.
    polygon : (t,) int
        ``own`` of all its points, :data:`DIFFERENT` where they differ.
    """

    order: IntArray
    points: FloatArray
    normals: FloatArray
    own: IntArray
    flat: FloatArray
    start: IntArray
    bounds: FloatArray
    normal: FloatArray
    offset: FloatArray
    polygon: IntArray

    def of(self, rows: IntArray) -> IntArray:
        """Tile (k,) of each of the sorted rows."""
        return np.searchsorted(self.start, rows, side="right") - 1


@njit(nogil=True, cache=True)
def _mix(h, value):
    """One more value into a 64-bit hash."""
    h = (h ^ value) * np.uint64(0x9E3779B97F4A7C15)
    return h ^ (h >> np.uint64(29))


@njit(nogil=True, cache=True)
def _plane_keys(points, normals, own, size, keys):
    """Hash of each point's plane: normal and offset to a billionth, polygon.  Returns whether all are equal."""
    same = True
    for i in range(points.shape[0]):
        h = np.uint64(own[i] + 1)
        offset = 0.0
        for axis in range(3):
            offset += points[i, axis] * normals[i, axis]
            h = _mix(h, np.uint64(np.int64(np.rint(normals[i, axis] * 1e9))))
        keys[i] = _mix(h, np.uint64(np.int64(np.rint(offset / size * 1e9))))
        same = same and keys[i] == keys[0]
    return same


@njit(nogil=True, cache=True)
def _measure(points, plane, frames, flat, low, high):
    """Places on each point's plane, and each plane's bounds of them."""
    low[:], high[:] = np.inf, -np.inf
    for i in range(points.shape[0]):
        p = plane[i]
        for k in range(2):
            x = points[i, 0] * frames[p, k, 0] + points[i, 1] * frames[p, k, 1] + points[i, 2] * frames[p, k, 2]
            flat[i, k] = x
            low[p, k] = min(low[p, k], x)
            high[p, k] = max(high[p, k], x)


@njit(nogil=True, cache=True)
def _spread_bits(value):
    """The three low bits of a number with a zero between each."""
    return (value & 1) | (value & 2) << 1 | (value & 4) << 2


@njit(nogil=True, cache=True)
def _place_in_cells(flat, plane, low, scale, across, first, bucket, counts):
    """Bucket of each point: its plane's cell, and inside it one of 64 along a Morton curve."""
    for i in range(flat.shape[0]):
        p = plane[i]
        u, v = (flat[i, 0] - low[p, 0]) * scale[p, 0], (flat[i, 1] - low[p, 1]) * scale[p, 1]
        a, b = min(int(u), across[p, 0] - 1), min(int(v), across[p, 1] - 1)
        x, y = min(int((u - a) * 8.0), 7), min(int((v - b) * 8.0), 7)
        cell = first[p] + b * across[p, 0] + a
        bucket[i] = 64 * cell + _spread_bits(x) + 2 * _spread_bits(y)
        counts[bucket[i] + 1] += 1


@njit(nogil=True, cache=True)
def _counting_sort(bucket, start, order):
    """Rows by bucket, in their order within each; ``start`` is used up."""
    for i in range(bucket.shape[0]):
        order[start[bucket[i]]] = i
        start[bucket[i]] += 1


@njit(nogil=True, cache=True)
def _scattered_keys(points, normals, low, cell, keys):
    """Orientation (the octant of the normal) and cell, along a Morton curve, of each point."""
    for i in range(points.shape[0]):
        key = 0
        for axis in range(3):
            key = 2 * key + (1 if normals[i, axis] > 0.0 else 0)
        x, y, z = (
            int((points[i, 0] - low[0]) / cell),
            int((points[i, 1] - low[1]) / cell),
            int((points[i, 2] - low[2]) / cell),
        )
        for bit in range(5, -1, -1):
            key = 8 * key + 4 * (x >> bit & 1) + 2 * (y >> bit & 1) + (z >> bit & 1)
        keys[i] = key


@njit(nogil=True, cache=True)
def _bound_tiles(points, normals, own, start, size, bounds, normal, offset, polygon):
    """Box, half-space and polygon of each tile; points of a flat tile lie on one plane to a billionth."""
    for t in range(start.shape[0] - 1):
        first, last = start[t], start[t + 1]
        tilt, least = 0.0, np.inf
        polygon[t] = own[first]
        for axis in range(3):
            normal[t, axis] = normals[first, axis]
            bounds[t, 0, axis] = bounds[t, 1, axis] = points[first, axis]
        for i in range(first, last):
            level = 0.0
            for axis in range(3):
                bounds[t, 0, axis] = min(bounds[t, 0, axis], points[i, axis])
                bounds[t, 1, axis] = max(bounds[t, 1, axis], points[i, axis])
                level += normals[first, axis] * points[i, axis]
                tilt = max(tilt, abs(normals[i, axis] - normals[first, axis]))
            least = min(least, level)
            if own[i] != own[first]:
                polygon[t] = DIFFERENT
        offset[t] = least - 4.0 * size * tilt
        if tilt > 1e-8:
            normal[t, :] = 0.0


def sort_into_tiles(points: FloatArray, normals: FloatArray, own: IntArray, size: float) -> Tiles:
    """Sort points into tiles: squares of each plane, and cells of what lies scattered.

    Parameters
    ----------
    points, normals : (n, 3) float
        Unit normals.
    own : (n,) int
        Polygon on which each point lies, -1 for none; points of different polygons share no plane.
    size : float
        Size of the scene, to which planes are told apart. [scene lengths]
    """
    n = len(points)
    keys = np.empty(n, dtype=np.uint64)
    if _plane_keys(points, normals, own, size, keys):
        first, plane, sizes = np.zeros(1, dtype=np.int64), np.zeros(n, dtype=np.int64), np.array([n])
    else:
        _, first, plane, sizes = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    flat = np.zeros((n, 2))
    wide = sizes >= min(LEAST, n)
    together = wide[plane]
    if wide.all():
        rows, numbers = np.arange(n), plane
    else:
        rows, numbers = np.flatnonzero(together), (np.cumsum(wide) - 1)[plane[together]]
    orders, lengths = [], []
    if len(rows):
        first, sizes = first[wide], sizes[wide]
        low, high = np.empty((len(first), 2)), np.empty((len(first), 2))
        here = np.empty((len(rows), 2))
        frames = np.array([plane_basis(normals[i]) for i in first])
        _measure(points if len(rows) == n else points[rows], numbers, frames, here, low, high)
        flat[rows] = here
        # About square cells that hold the wanted number of points.
        extent = high - low
        tiles = np.maximum(np.rint(sizes / np.clip(sizes / 256, *MOST)), 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            aspect = np.where(extent[:, 1] > 0, extent[:, 0] / extent[:, 1], np.inf)
            aspect = np.nan_to_num(aspect, posinf=1e12)
        columns = np.clip(np.rint(np.sqrt(tiles * np.minimum(aspect, tiles))), 1, tiles)
        across = np.stack([columns, np.maximum(np.rint(tiles / columns), 1)], axis=1).astype(np.int64)
        begin = np.concatenate([[0], np.cumsum(across.prod(axis=1))])
        scale = across / np.where(extent > 0, extent, 1.0)
        bucket, counts = np.empty(len(rows), dtype=np.int64), np.zeros(64 * begin[-1] + 1, dtype=np.int64)
        _place_in_cells(here, numbers, low, scale, across, begin, bucket, counts)
        ends = np.cumsum(counts)
        held = np.diff(ends[::64])
        order = np.empty(len(rows), dtype=np.int64)
        _counting_sort(bucket, ends, order)
        orders.append(rows[order])
        lengths.append(held[held > 0])
    if len(rows) < n:
        rest = np.flatnonzero(~together)
        low = points[rest].min(axis=0)
        cell = float(np.ptp(points[rest], axis=0).max()) / CELLS or 1.0
        cells = np.empty(len(rest), dtype=np.int64)
        _scattered_keys(points[rest], normals[rest], low, cell, cells)
        order = np.argsort(cells, kind="stable")
        held = np.unique(cells, return_counts=True)[1]
        # Full cells are cut into runs.
        runs = -(-held // SCATTERED)
        lengths.append(np.where(_last_of_each(runs), np.repeat(held - SCATTERED * (runs - 1), runs), SCATTERED))
        orders.append(rest[order])
    order = np.concatenate(orders)
    start = np.concatenate([[0], np.cumsum(np.concatenate(lengths))]).astype(np.int64)
    count = len(start) - 1
    moved, turned, polygons = points[order], normals[order], own[order]
    bounds, normal, offset = np.empty((count, 2, 3)), np.empty((count, 3)), np.empty(count)
    polygon = np.empty(count, dtype=np.int64)
    _bound_tiles(moved, turned, polygons, start, size, bounds, normal, offset, polygon)
    return Tiles(order, moved, turned, polygons, flat[order], start, bounds, normal, offset, polygon)


def _last_of_each(runs: IntArray) -> NDArray[np.bool_]:
    """Which of ``runs.sum()`` rows is the last of its run."""
    last = np.zeros(int(runs.sum()), dtype=bool)
    last[np.cumsum(runs) - 1] = True
    return last
