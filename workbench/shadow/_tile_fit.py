"""A cubic fitted to the visible shares at some points of a flat region, and how well it foretells them.

The kernels' sibling of :mod:`workbench.shadow.smooth`: one region at a time, as the lines are drawn.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

__all__ = ["NODES", "NODE_GAP", "TERMS", "cubic_at", "cut_runs", "fit_cubic", "pick_nodes", "quarter"]

SIDE = 5
"""Nodes along each side of a region."""
NODES = SIDE * SIDE
TERMS = 10
"""Coefficients of a cubic in two variables."""
FEWEST = 20
"""Nodes without which nothing is fitted."""
NODE_GAP = 0.3
"""Widest distance of neighbouring nodes, as a share of the region's side."""
_RIM = np.array([-0.96, -0.6, 0.0, 0.6, 0.96])
_BETWEEN = 0.5 * (_RIM[1:] + _RIM[:-1])


@njit(nogil=True, cache=True)
def _terms(u, v, out):
    out[0], out[1], out[2], out[3], out[4], out[5] = 1.0, u, v, u * u, u * v, v * v
    out[6], out[7], out[8], out[9] = u * u * u, u * u * v, u * v * v, v * v * v


@njit(nogil=True, cache=True)
def pick_nodes(flat, rows, a, b, frame, nodes):
    """Rows of ``rows[a:b]`` nearest to the nodes of their rectangle; their number.

    ``frame`` (2, 2) gets the rectangle's middle and half its sides.
    """
    chosen, nearest = nodes[0], nodes[1]
    for axis in range(2):
        low = high = flat[rows[a], axis]
        for k in range(a + 1, b):
            low, high = min(low, flat[rows[k], axis]), max(high, flat[rows[k], axis])
        frame[0, axis], frame[1, axis] = 0.5 * (low + high), 0.5 * (high - low)
    if frame[1, 0] <= 0.0 or frame[1, 1] <= 0.0:
        return 0
    for c in range(NODES):
        chosen[c], nearest[c] = -1, np.inf
    for k in range(a, b):
        u = (flat[rows[k], 0] - frame[0, 0]) / frame[1, 0]
        v = (flat[rows[k], 1] - frame[0, 1]) / frame[1, 1]
        i = j = 0
        for c in range(SIDE - 1):
            i += u > _BETWEEN[c]
            j += v > _BETWEEN[c]
        square = (u - _RIM[i]) ** 2 + (v - _RIM[j]) ** 2
        if square < nearest[SIDE * i + j]:
            nearest[SIDE * i + j], chosen[SIDE * i + j] = square, rows[k]
    count = 0
    for c in range(NODES):
        if chosen[c] >= 0:
            chosen[count] = chosen[c]
            count += 1
    return count if count >= FEWEST else 0


@njit(nogil=True, cache=True)
def fit_cubic(flat, frame, count, nodes):
    """Fit the nodes' values (``nodes[5]``); root mean square by which others foretell each, infinite for no fit.

    Least squares by normal equations: over [-1, 1]^2 they keep ten digits.  A value left out is off
    by its residual over one less its leverage, of which the mean over the nodes counts.
    """
    chosen, _, basis, matrix, coefficients, values, solved = nodes
    for c in range(count):
        u = (flat[chosen[c], 0] - frame[0, 0]) / frame[1, 0]
        v = (flat[chosen[c], 1] - frame[0, 1]) / frame[1, 1]
        _terms(u, v, basis[c])
    for i in range(TERMS):
        coefficients[i] = 0.0
        for c in range(count):
            coefficients[i] += basis[c, i] * values[c]
        for j in range(i + 1):
            total = 0.0
            for c in range(count):
                total += basis[c, i] * basis[c, j]
            matrix[i, j] = total
    # Cholesky, in place.
    for j in range(TERMS):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        if pivot <= 1e-8 * matrix[j, j]:
            return np.inf
        pivot = math.sqrt(pivot)
        matrix[j, j] = pivot
        for i in range(j + 1, TERMS):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / pivot
    for i in range(TERMS):
        for k in range(i):
            coefficients[i] -= matrix[i, k] * coefficients[k]
        coefficients[i] /= matrix[i, i]
    square = 0.0
    for c in range(count):
        residual = values[c]
        leverage = 0.0
        for i in range(TERMS):
            total = basis[c, i]
            for k in range(i):
                total -= matrix[i, k] * solved[k]
            solved[i] = total / matrix[i, i]
            leverage += solved[i] * solved[i]
            residual -= solved[i] * coefficients[i]
        square += residual * residual / max(1.0 - leverage, 0.02)
    for i in range(TERMS - 1, -1, -1):
        for k in range(i + 1, TERMS):
            coefficients[i] -= matrix[k, i] * coefficients[k]
        coefficients[i] /= matrix[i, i]
    return math.sqrt(square / count)


@njit(nogil=True, cache=True)
def cubic_at(flat, row, frame, nodes):
    """The fitted cubic at a row."""
    c = nodes[4]
    u = (flat[row, 0] - frame[0, 0]) / frame[1, 0]
    v = (flat[row, 1] - frame[0, 1]) / frame[1, 1]
    low = c[0] + u * (c[1] + u * (c[3] + u * c[6]))
    return low + v * (c[2] + u * (c[4] + u * c[7]) + v * (c[5] + u * c[8] + v * c[9]))


@njit(nogil=True, cache=True)
def cut_runs(a, b, length, stack, top):
    """Put ``a..b`` on a stack in runs of ``length``; the stack's new top."""
    while b > a:
        top += 1
        stack[top, 0], stack[top, 1] = max(a, b - length), b
        b -= length
    return top


@njit(nogil=True, cache=True)
def quarter(flat, rows, a, b, spare, stack, top):
    """Sort ``rows[a:b]`` into the quarters of their rectangle and stack these; points of one place into runs."""
    lu = hu = flat[rows[a], 0]
    lv = hv = flat[rows[a], 1]
    for k in range(a + 1, b):
        u, v = flat[rows[k], 0], flat[rows[k], 1]
        lu, hu, lv, hv = min(lu, u), max(hu, u), min(lv, v), max(hv, v)
    mu, mv = 0.5 * (lu + hu), 0.5 * (lv + hv)
    for k in range(a, b):
        spare[k] = rows[k]
    bottom, end = top, a
    for part in range(4):
        start = end
        for k in range(a, b):
            if (flat[spare[k], 0] > mu) + 2 * (flat[spare[k], 1] > mv) == part:
                rows[end] = spare[k]
                end += 1
        if end > start:
            top += 1
            stack[top, 0], stack[top, 1] = start, end
    return top if top > bottom + 1 else cut_runs(a, b, NODES, stack, bottom)
