"""Visible shares over tiles of points: found at a few points, fitted, checked, refined.

Inside a penumbra the visible share of an area light varies smoothly, so a tile of neighbouring
points on one plane needs the share at a handful of them only.  A cubic polynomial is fitted; each
sample is predicted from the others (leave one out), and where that fails to meet the wanted error
the tile is quartered.  The samples carry their own noise, which the same check sees.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["ALONE_NOISE", "SAMPLE_NOISE", "fill_smoothly"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NODES = 25
"""Samples a tile."""
TERMS = 10
"""Coefficients of a cubic in two variables."""
SAMPLE_NOISE = 1.2
"""Noise that samples may have, in units of the wanted error: the fit takes a third of it away."""
ALONE_NOISE = 0.72
"""Noise of points that no fit smooths: no neighbours cancel it, so it must stay below the wanted error."""
SMALLEST = 48
"""Tiles of at most this many points are sampled at each of them."""

# Nodes spread over [-1, 1]^2 more densely toward the rim, where fits are worst.
_RIM = np.array([-0.96, -0.6, 0.0, 0.6, 0.96])
_NODES = np.array([(u, v) for u in _RIM for v in _RIM])


@njit(nogil=True, cache=True)
def _nearest_points(place, start, stop, nodes, chosen):
    """For each tile the points nearest to its nodes; -1 in place of a repeated point."""
    for t in range(start.shape[0]):
        for k in range(nodes.shape[0]):
            best, least = -1, np.inf
            for i in range(start[t], stop[t]):
                du, dv = place[i, 0] - nodes[k, 0], place[i, 1] - nodes[k, 1]
                square = du * du + dv * dv
                if square < least:
                    best, least = i, square
            for j in range(k):
                if chosen[t, j] == best:
                    best = -1
            chosen[t, k] = best


def _terms(place: FloatArray) -> FloatArray:
    """Cubic terms (..., 10) of places (..., 2)."""
    u, v = place[..., 0], place[..., 1]
    one = np.ones_like(u)
    return np.stack([one, u, v, u * u, u * v, v * v, u * u * u, u * u * v, u * v * v, v * v * v], axis=-1)


def fill_smoothly(
    flat: FloatArray,
    start: IntArray,
    stop: IntArray,
    sides: FloatArray,
    sample: Callable[[IntArray, float], tuple[FloatArray, FloatArray]],
    share: FloatArray,
    doubt: FloatArray,
    *,
    error: float,
) -> int:
    """Fill ``share`` over tiles of points, sampling as few as the wanted error allows.

    Parameters
    ----------
    flat : (n, 2) float
        Places of the points on their plane; reordered views are made inside, rows keep their numbers.
    start, stop : (t,) int
        Tile ``t`` is rows ``start[t]:stop[t]``.
    sides : (t,) float
        Longest side of a part of the tile that may be fitted: over a longer one small shadows slip between the nodes.
    sample : callable
        Shares at the given rows, to a given error, and their standard errors.
    share, doubt : (n,) float
        Written: visible share [0..1] and its estimated error.
    error : float
        Wanted root mean square error of a share inside a tile.

    Returns
    -------
    int
        Number of points sampled.
    """
    rows = np.concatenate([np.arange(a, b) for a, b in zip(start, stop, strict=True)]) if len(start) else start
    sizes = stop - start
    sampled = 0
    while len(rows):
        edges = np.concatenate([[0], np.cumsum(sizes)])
        tile = np.repeat(np.arange(len(sizes)), sizes)
        low = np.minimum.reduceat(flat[rows], edges[:-1])
        high = np.maximum.reduceat(flat[rows], edges[:-1])
        # Points all at one place cannot be cut apart.
        small = (sizes <= SMALLEST) | (low == high).all(axis=1)
        direct = rows[small[tile]]
        if len(direct):
            share[direct], doubt[direct] = sample(direct, ALONE_NOISE * error)
            sampled += len(direct)
        keep = ~small[tile]
        rows, sizes, sides = rows[keep], sizes[~small], sides[~small]
        if not len(rows):
            break
        edges = np.concatenate([[0], np.cumsum(sizes)])
        tile = np.repeat(np.arange(len(sizes)), sizes)
        low, high = low[~small], high[~small]
        middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), 1e-300)
        place = (flat[rows] - middle[tile]) / half[tile]
        chosen = np.empty((len(sizes), NODES), dtype=np.int64)
        _nearest_points(place, edges[:-1], edges[1:], _NODES, chosen)
        usable = ((chosen >= 0).sum(axis=1) >= NODES - 2) & (2.0 * half.max(axis=1) <= sides)
        spot = np.where(chosen >= 0, chosen, edges[:-1, None])
        known = chosen >= 0
        values, noise = np.zeros(chosen.shape), np.zeros(chosen.shape)
        ask = known & usable[:, None]
        values[ask], noise[ask] = sample(rows[spot[ask]], SAMPLE_NOISE * error)
        sampled += int(ask.sum())
        basis = _terms(place[spot]) * known[..., None]
        q, r = np.linalg.qr(basis)
        diagonal = np.abs(np.einsum("tii->ti", r))
        usable &= diagonal.min(axis=1) > 1e-6 * diagonal.max(axis=1)
        r[~usable] = np.eye(TERMS)
        weights = np.einsum("tkj,tk->tj", q, values)
        fit = np.einsum("tkj,tj->tk", q, weights)
        leverage = np.einsum("tkj,tkj->tk", q, q)
        left_out = np.where(known, (values - fit) / np.maximum(1.0 - leverage, 0.02), 0.0)
        # A left-out sample differs by its own noise, of which the fit keeps TERMS / NODES, and by misfit, all of
        # which stays.
        count = np.maximum(known.sum(axis=1), 1)
        square = (left_out**2 * (1.0 - leverage)).sum(axis=1) / count
        variance = (noise**2).sum(axis=1) / count
        rms = np.sqrt(np.maximum(square - variance * (1.0 - TERMS / NODES), variance * TERMS / NODES))
        good = usable & (rms <= error)
        coefficients = np.linalg.solve(r, weights[..., None])[..., 0]
        done = good[tile]
        guess = np.einsum("ij,ij->i", _terms(place[done]), coefficients[tile[done]])
        share[rows[done]] = np.clip(guess, 0.0, 1.0)
        doubt[rows[done]] = rms[tile[done]]
        # The rest in quarters: sorted by tile, then quarter, the order inside kept.
        rows, place, tile = rows[~done], place[~done], tile[~done]
        quarter = tile * 4 + (place[:, 0] > 0) * 2 + (place[:, 1] > 0)
        order = np.argsort(quarter, kind="stable")
        rows = rows[order]
        kinds, sizes = np.unique(quarter, return_counts=True)
        sides = sides[kinds // 4]
    return sampled
