"""Shadow rays from points to an area sender, through Embree, in blocks over threads.

The share of the rays that arrive, each weighted by the kernel cos cos / r^2, scales the closed
form: the sender's irradiance is never estimated from the bare kernel.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workbench.accel.embree import BLOCK_RAYS, EmbreeAccelerator
from workbench.sampling.sequences import hashed, scrambled, sobol_bits

__all__ = ["NOISE", "sender_samples", "unit_samples", "visible_shares", "weighted_shares"]

FloatArray = NDArray[np.float64]

NOISE = 0.52
"""Measured on a tessellated torus: K rays leave an error of NOISE K^-3/4 of a visible share."""
SHARED_RAYS = 8192
"""More rays than these are spread over threads."""
PRIOR = 4.0
"""Degrees of freedom for which that measurement counts in the standard error of a point."""


def sender_samples(ring: FloatArray, unit: FloatArray) -> FloatArray:
    """Points (n, k, 3) of a convex polygon at ``unit`` (n, k, 2), uniform by area.

    A parallelogram is an affine image of the square; other polygons are fans of triangles.
    """
    u, v = unit[..., 0], unit[..., 1]
    size = np.abs(ring - ring[0]).max()
    if len(ring) == 4 and np.abs(ring[0] + ring[2] - ring[1] - ring[3]).max() <= 1e-9 * size:
        return ring[0] + u[..., None] * (ring[1] - ring[0]) + v[..., None] * (ring[3] - ring[0])
    edge = ring[1:] - ring[0]
    area = np.linalg.norm(np.cross(edge[:-1], edge[1:]), axis=1)
    ends = np.concatenate([[0.0], np.cumsum(area) / area.sum()])
    which = np.clip(np.searchsorted(ends, u, side="right") - 1, 0, len(area) - 1)
    inner = np.clip((u - ends[which]) / np.where(area > 0, np.diff(ends), 1.0)[which], 0.0, 1.0)
    s = np.sqrt(inner)
    return ring[0] + (s * (1.0 - v))[..., None] * edge[which] + (s * v)[..., None] * edge[which + 1]


@njit(nogil=True, cache=True)
def _fill(bits, index, seed, out):
    for row in range(out.shape[0]):
        scrambled(bits, hashed(index[row], seed), out[row])


def unit_samples(index: NDArray[np.int64], count: int, seed: int) -> FloatArray:
    """The unit-square samples (n, count, 2) that :func:`visible_shares` uses at points of these numbers.

    Sobol points, Owen-scrambled for each point by its number and ``seed``, whatever the blocks: past
    an edge they leave a quarter less error than a shifted lattice, and runs of 4, 16, ... of them are nets, too.
    """
    out = np.empty((len(index), count, 2))
    _fill(sobol_bits(count), np.ascontiguousarray(index), seed, out)
    return out


@njit(nogil=True, cache=True)
def _make_rays(
    points, normals, index, first, last, bits, seed, ring, edges, sender_normal, offset, centre, scale, origins,
    directions, weights,
):  # fmt: skip
    """A ray a point for each of ``bits`` toward the fan triangles ``ring`` (t, 3, 3) of cumulated areas ``edges``."""
    unit = np.empty((bits.shape[0], 2))
    mx, my, mz = sender_normal[0], sender_normal[1], sender_normal[2]
    parallelogram = ring.shape[0] == 2
    for axis in range(3):
        gap = ring[0, 0, axis] + ring[0, 2, axis] - ring[0, 1, axis] - ring[min(1, ring.shape[0] - 1), 2, axis]
        if abs(gap) > 1e-9 / scale:
            parallelogram = False
    row = 0
    for i in range(first, last):
        scrambled(bits, hashed(index[i], seed), unit)
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        sx, sy, sz = px + offset * nx, py + offset * ny, pz + offset * nz
        ox, oy, oz = (sx - centre[0]) * scale, (sy - centre[1]) * scale, (sz - centre[2]) * scale
        for sample in range(bits.shape[0]):
            u, v = unit[sample, 0], unit[sample, 1]
            if parallelogram:
                a, b = u, v
                k = 0
                yx = ring[0, 0, 0] + a * (ring[0, 1, 0] - ring[0, 0, 0]) + b * (ring[1, 2, 0] - ring[0, 0, 0])
                yy = ring[0, 0, 1] + a * (ring[0, 1, 1] - ring[0, 0, 1]) + b * (ring[1, 2, 1] - ring[0, 0, 1])
                yz = ring[0, 0, 2] + a * (ring[0, 1, 2] - ring[0, 0, 2]) + b * (ring[1, 2, 2] - ring[0, 0, 2])
            else:
                k = 0
                while k < ring.shape[0] - 1 and u > edges[k + 1]:
                    k += 1
                s = math.sqrt(max((u - edges[k]) / (edges[k + 1] - edges[k]), 0.0))
                a, b = s * (1.0 - v), s * v
                yx = ring[k, 0, 0] + a * (ring[k, 1, 0] - ring[k, 0, 0]) + b * (ring[k, 2, 0] - ring[k, 0, 0])
                yy = ring[k, 0, 1] + a * (ring[k, 1, 1] - ring[k, 0, 1]) + b * (ring[k, 2, 1] - ring[k, 0, 1])
                yz = ring[k, 0, 2] + a * (ring[k, 1, 2] - ring[k, 0, 2]) + b * (ring[k, 2, 2] - ring[k, 0, 2])
            dx, dy, dz = yx - px, yy - py, yz - pz
            cx = dx * nx + dy * ny + dz * nz
            cy = -(dx * mx + dy * my + dz * mz)
            square = dx * dx + dy * dy + dz * dz
            weights[row] = cx * cy / (square * square) if cx > 0.0 and cy > 0.0 else 0.0
            origins[row, 0], origins[row, 1], origins[row, 2] = ox, oy, oz
            directions[row, 0] = (yx + offset * mx - sx) * scale
            directions[row, 1] = (yy + offset * my - sy) * scale
            directions[row, 2] = (yz + offset * mz - sz) * scale
            row += 1


@njit(nogil=True, cache=True)
def weighted_shares(first, last, count, weights, through, share, doubt):
    """Weighted visible share of points ``first..last`` from ``count`` rays each, and its standard error.

    ``through`` is 0 where a ray is blocked and 1 (Embree: -1) where it arrives, or what a pane lets
    pass.  The error is pooled: the spread of four runs of the rays, which has three degrees of
    freedom and would by itself be far too small at some points, and what K points of the net
    leave of a share on the average, :data:`NOISE` K^-3/4, less near 0 and 1.  Rays of unequal weight, as to a
    light that the horizon cuts, count as fewer: (sum w)^2 / sum w^2 (L. Kish, Survey Sampling, 1965).
    """
    row = 0
    runs = 4 if count >= 8 else 1
    seen, total = np.empty(4), np.empty(4)
    for i in range(first, last):
        for run in range(runs):
            seen[run] = total[run] = 0.0
        squares = 0.0
        for k in range(count):
            run = k * runs // count
            w = weights[row]
            total[run] += w
            squares += w * w
            seen[run] += w * abs(through[row])
            row += 1
        whole = total[:runs].sum()
        if whole <= 0.0:
            share[i], doubt[i] = 0.0, 0.5
            continue
        mean = seen[:runs].sum() / whole
        share[i] = mean
        rays = whole * whole / squares if squares > 0.0 else 1.0
        # A narrow shadow has nearly as long an outline as a wide one: the root of mean (1 - mean).
        square = NOISE * NOISE * rays**-1.5 * 2.0 * math.sqrt(max(mean * (1.0 - mean), 0.0))
        if runs > 1:
            spread = 0.0
            for run in range(runs):
                spread += (seen[run] - mean * total[run]) ** 2
            spread *= runs / (runs - 1.0) / (whole * whole)
            square = (PRIOR * square + (runs - 1.0) * spread) / (PRIOR + runs - 1.0)
        # K rays that agree leave room for a blocker, or a gap, of about half a ray's width.
        doubt[i] = max(math.sqrt(square), 0.5 / rays)


def _in_turn(work: Callable[[int], None], tasks: Sequence[int]) -> None:
    for task in tasks:
        work(task)


def visible_shares(
    tracer: EmbreeAccelerator,
    points: FloatArray,
    normals: FloatArray,
    index: NDArray[np.int64],
    pieces: list[FloatArray],
    sender_normal: FloatArray,
    *,
    count: int,
    seed: int = 0,
    workers: int = 1,
    spread: Callable[[Callable[[int], None], Sequence[int]], object] = _in_turn,
) -> tuple[FloatArray, FloatArray]:
    """Visible share of a sender from each point by ``count`` rays.

    Parameters
    ----------
    tracer : EmbreeAccelerator
    points, normals : (n, 3) float
    index : (n,) int
        Number of each point: its stream of random numbers depends on it and on ``seed`` alone.
    pieces : list of (k, 3) float
        Convex pieces of the sender.
    sender_normal : (3,) float
    count, seed : int
    workers, spread
        How many threads there are, and what shares out blocks to them.

    Returns
    -------
    share, doubt : (n,) float
        Share weighted by cos cos / r^2 [0..1], and its standard error (:func:`weighted_shares`).
    """
    share, doubt = np.zeros(len(points)), np.zeros(len(points))
    ring = np.concatenate([[[p[0], p[i], p[i + 1]] for i in range(1, len(p) - 1)] for p in pieces])
    area = np.linalg.norm(np.cross(ring[:, 1] - ring[:, 0], ring[:, 2] - ring[:, 0]), axis=1)
    edges = np.concatenate([[0.0], np.cumsum(area) / area.sum()])
    centre, scale = tracer.frame
    bits = sobol_bits(count)
    step = max(1, BLOCK_RAYS // count)
    if len(points) * count > SHARED_RAYS:
        step = min(step, -(-len(points) // workers))

    def block(first: int) -> None:
        last = min(first + step, len(points))
        rows = (last - first) * count
        origins, directions = np.empty((rows, 3), np.float32), np.empty((rows, 3), np.float32)
        weights = np.empty(rows)
        _make_rays(
            points, normals, index, first, last, bits, seed, ring, edges, sender_normal, tracer.offset, centre,
            scale, origins, directions, weights,
        )  # fmt: skip
        blocked = tracer.blocked_raw(origins, directions, np.ones(rows, np.float32))
        weighted_shares(first, last, count, weights, blocked, share, doubt)

    spread(block, range(0, len(points), step))
    tracer.counters.add(rays=len(points) * count)
    return share, doubt
