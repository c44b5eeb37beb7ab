"""Visible shares of exchange areas by rays, for pairs with too many occluders to cut."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from radiosity.form_factors._sampling import place_on_pieces, stream
from workbench.accel.embree import BLOCK_RAYS, EmbreeAccelerator
from workbench.geometry.flat import Geometry

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

FIRST_RAYS = 32
"""Rays of a pair before it is known how much they differ."""
COARSE, COARSE_RAYS = 0.1, 16
"""Wanted error of a share above which fewer do, and those."""
MOST_RAYS = 2048
FEW_PAIRS, LEAST_PRIOR, MOST_PRIOR = 50, 0.1, 50.0
"""Fewer pairs say nothing of each other; least and most pseudo-rays of what they say."""

# Generalised golden ratio in four dimensions (M. Roberts 2018): g solves g^5 = g + 1.
_G4 = 1.1673039782614187


@njit(nogil=True, cache=True)
def _pair_rays(
    pairs, begin, counts, seed, corners, start, normal, area, offset, centre, scale, starts, origins, directions,
    weights,
):  # fmt: skip
    """Rays between points of both pieces, in Embree's unit frame, each with its kernel cos cos / r^2.

    Pair ``p`` gets rays ``starts[p]:starts[p + 1]``, numbers ``begin[p]`` to ``begin[p] + counts[p]`` of its
    sequence; those between points that do not face each other are left out.  Returns their number.
    """
    x, y = np.empty(3), np.empty(3)
    g1, g2, g3, g4 = 1.0 / _G4, 1.0 / _G4**2, 1.0 / _G4**3, 1.0 / _G4**4
    row = 0
    for p in range(pairs.shape[0]):
        starts[p] = row
        i, j = pairs[p, 0], pairs[p, 1]
        h = stream(i, j, seed)
        s1 = np.float64(h & np.uint64(0xFFFF)) / 65536.0
        s2 = np.float64((h >> np.uint64(16)) & np.uint64(0xFFFF)) / 65536.0
        s3 = np.float64((h >> np.uint64(32)) & np.uint64(0xFFFF)) / 65536.0
        s4 = np.float64((h >> np.uint64(48)) & np.uint64(0xFFFF)) / 65536.0
        n, m = normal[i], normal[j]
        for k in range(counts[p]):
            t = begin[p] + k + 0.5
            place_on_pieces(corners, start, i, i + 1, area[i], (s1 + g1 * t) % 1.0, (s2 + g2 * t) % 1.0, x)
            place_on_pieces(corners, start, j, j + 1, area[j], (s3 + g3 * t) % 1.0, (s4 + g4 * t) % 1.0, y)
            dx, dy, dz = y[0] - x[0], y[1] - x[1], y[2] - x[2]
            cx = dx * n[0] + dy * n[1] + dz * n[2]
            cy = -(dx * m[0] + dy * m[1] + dz * m[2])
            if cx <= 0.0 or cy <= 0.0:
                continue
            square = dx * dx + dy * dy + dz * dz
            weights[row] = cx * cy / (square * square)
            for axis in range(3):
                a = x[axis] + offset * n[axis]
                origins[row, axis] = (a - centre[axis]) * scale
                directions[row, axis] = (y[axis] + offset * m[axis] - a) * scale
            row += 1
    starts[pairs.shape[0]] = row
    return row


@njit(nogil=True, cache=True)
def _gather(starts, weights, passed, sums):
    """Add each pair's seen, whole and squared weights to ``sums`` (pairs, 3)."""
    for p in range(starts.shape[0] - 1):
        for k in range(starts[p], starts[p + 1]):
            w = weights[k]
            sums[p, 1] += w
            sums[p, 2] += w * w
            sums[p, 0] += w * passed[k]


class Sight:
    """What arrives along rays between points: opaque polygons block it, panes dim it.

    Parameters
    ----------
    geometry : Geometry
    """

    def __init__(self, geometry: Geometry) -> None:
        clear = geometry.polygon_transmittance > 0.0
        self._transmittance = geometry.polygon_transmittance[clear]
        self._panes = EmbreeAccelerator(geometry.part(clear)) if clear.any() else None
        self.tracer = EmbreeAccelerator(geometry.part(~clear) if clear.any() else geometry)
        self.offset = max(tracer.offset for tracer in (self.tracer, self._panes) if tracer is not None)

    def passed(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> FloatArray:
        """Share (n,) that arrives along rays (n, 3) in the tracer's unit coordinates, from end to end."""
        blocked = self.tracer.blocked_raw(origins, directions, np.ones(len(origins), dtype=np.float32))
        passed = (blocked != 0).astype(np.float64)
        if self._panes is None:
            return passed
        centre, unit = self.tracer.frame
        rows = np.flatnonzero(passed)
        start, rest = origins[rows] / unit + centre, directions[rows].astype(np.float64) / unit
        while len(rows):
            hits = self._panes.closest_hit(start, rest, far=1.0)
            met = hits.polygon >= 0
            rows, start, rest = rows[met], start[met], rest[met]
            passed[rows] *= self._transmittance[hits.polygon[met]]
            # On from just beyond the pane.
            step = hits.t[met] + self.offset / np.linalg.norm(rest, axis=1)
            on = step < 1.0
            rows, start, rest = rows[on], (start + step[:, None] * rest)[on], (rest * (1.0 - step[:, None]))[on]
        return passed


def _trace(
    pairs: IntArray, begin: IntArray, counts: IntArray, seed: int, pieces, sight: Sight, sums: FloatArray
) -> int:
    """Trace the asked rays of every pair, block by block."""
    centre, scale = sight.tracer.frame
    ends = np.cumsum(counts)
    first = 0
    traced = 0
    while first < len(pairs):
        last = max(first + 1, int(np.searchsorted(ends, ends[first] - counts[first] + BLOCK_RAYS, side="right")))
        block = slice(first, last)
        most = int(counts[block].sum())
        starts = np.empty(last - first + 1, dtype=np.int64)
        origins = np.empty((most, 3), dtype=np.float32)
        directions = np.empty_like(origins)
        weights = np.empty(most)
        used = _pair_rays(
            pairs[block], begin[block], counts[block], seed, pieces.corners, pieces.start, pieces.normal, pieces.area,
            sight.offset, centre, scale, starts, origins, directions, weights,
        )  # fmt: skip
        _gather(starts, weights, sight.passed(origins[:used], directions[:used]), sums[block])
        traced += used
        first = last
    return traced


def _shares(sums: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Visible share of each pair, and the number of rays of equal weight that tell as much of it as its own."""
    whole = np.where(sums[:, 1] > 0, sums[:, 1], 1.0)
    share = np.where(sums[:, 1] > 0, sums[:, 0] / whole, 0.5)
    return share, np.where(sums[:, 1] > 0, whole**2 / np.where(sums[:, 2] > 0, sums[:, 2], 1.0), 0.0)


def _prior(share: FloatArray, rays: FloatArray, weight: FloatArray) -> FloatArray:
    """Pseudo-rays (2,) that arrive and do not, by which each pair is taken to be like the others (empirical Bayes).

    Most pairs of small pieces see each other whole or not at all: rays that agree then tell more than they do by
    themselves.  Moments of the beta-binomial distribution (J. C. Kleinman, JASA 68, 1973), each pair by its
    ``weight``; of few pairs one pseudo-ray of either kind (Laplace).
    """
    told = rays > 1.0
    few = np.ones(2)
    if told.sum() < FEW_PAIRS:
        return few
    w = weight[told] / weight[told].sum()
    if w.max() * FEW_PAIRS > 1.0:
        return few
    mean = float(w @ share[told])
    scatter = float(w @ (share[told] - mean) ** 2)
    by_chance = float(w @ (1.0 / rays[told]))
    whole = mean * (1.0 - mean)
    alike = (scatter - whole * by_chance) / (whole * (1.0 - by_chance)) if whole > 0.0 else 0.0
    total = min(max(1.0 / max(alike, 1e-9) - 1.0, LEAST_PRIOR), MOST_PRIOR)
    mean = (mean * len(w) + 1.0) / (len(w) + 2.0)
    return total * np.array([mean, 1.0 - mean])


def _doubts(share: FloatArray, rays: FloatArray, prior: FloatArray) -> FloatArray:
    """Standard error of each visible share: about it, not about the mean of what it may be."""
    mean = (share * rays + prior[0]) / (rays + prior.sum())
    return np.sqrt(mean * (1.0 - mean) / (rays + prior.sum() + 1.0) + (mean - share) ** 2)


def ray_shares(
    pairs: IntArray, goals: FloatArray, weight: FloatArray, seed: int, pieces, sight: Sight, most: int = MOST_RAYS
) -> tuple[FloatArray, FloatArray, int]:
    """Visible share of each pair of pieces by rays, its standard error, and the rays traced.

    Parameters
    ----------
    pairs : (m, 2) int
    goals : (m,) float
        Wanted standard error of each share.
    weight : (m,) float
        What each share is a share of.
    seed : int
    pieces
        Corners, start, normal and area of the pieces.
    sight : Sight
    most : int
        Most rays of a pair.
    """
    sums = np.zeros((len(pairs), 3))
    counts = np.where(goals > COARSE, COARSE_RAYS, FIRST_RAYS)
    begin = np.zeros(len(pairs), dtype=np.int64)
    traced = _trace(pairs, begin, counts, seed, pieces, sight, sums)
    share, rays = _shares(sums)
    prior = _prior(share, rays, weight)
    wanted = np.minimum((_doubts(share, rays, prior) / goals) ** 2 * counts, most)
    more = np.flatnonzero(wanted > 1.5 * counts)
    if len(more):
        extra = np.ceil(wanted[more]).astype(np.int64) - counts[more]
        part = sums[more]
        traced += _trace(np.ascontiguousarray(pairs[more]), counts[more], extra, seed, pieces, sight, part)
        sums[more] = part
        share, rays = _shares(sums)
    return share, _doubts(share, rays, prior), traced
