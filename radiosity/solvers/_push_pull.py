"""Exchange over links at all levels of the tree, as kernels: pull up, cross the links, push down."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(nogil=True, cache=True)
def pull(values, count, opened, child, children, area):
    """Area-weighted means of the leaves, for every node above them, in place; (nodes, bands).

    A node without area (all covered) has 0.
    """
    bands = values.shape[1]
    for n in range(count - 1, -1, -1):
        if opened[n] == 0:
            continue
        for band in range(bands):
            sum_of_parts = 0.0
            for k in range(child[n], child[n] + children[n]):
                sum_of_parts += area[k] * values[k, band]
            values[n, band] = sum_of_parts / area[n] if area[n] > 0.0 else 0.0


@njit(nogil=True, cache=True)
def total(values, count, opened, child, children):
    """Sums over the leaves (nodes,), for every node above them, in place."""
    for n in range(count - 1, -1, -1):
        if opened[n] == 1:
            values[n] = 0.0
            for k in range(child[n], child[n] + children[n]):
                values[n] += values[k]


@njit(nogil=True, cache=True)
def level(rows, count, opened, child, children, area):
    """Cut row sums to what each may be at most, and hand what is cut to the nearest leaves with room, in place.

    ``rows`` (nodes, 2) holds the means of the row sums and of their largest values; the means of the former are
    kept for each node that has room.
    """
    rows[0, 0] = min(rows[0, 0], rows[0, 1])
    for n in range(count):
        if opened[n] == 0:
            continue
        rest, room = area[n] * rows[n, 0], 0.0
        for k in range(child[n], child[n] + children[n]):
            rows[k, 0] = min(rows[k, 0], rows[k, 1])
            rest -= area[k] * rows[k, 0]
            room += area[k] * (rows[k, 1] - rows[k, 0])
        if rest > 0.0 and room > 0.0:
            share = min(rest / room, 1.0)
            for k in range(child[n], child[n] + children[n]):
                rows[k, 0] += share * (rows[k, 1] - rows[k, 0])


@njit(nogil=True, cache=True)
def push(values, count, opened, child, children):
    """Add what each opened node received to its parts, in place; leaves end with the whole."""
    bands = values.shape[1]
    for n in range(count):
        if opened[n] == 0:
            continue
        for k in range(child[n], child[n] + children[n]):
            for band in range(bands):
                values[k, band] += values[n, band]


@njit(nogil=True, cache=True)
def sort_links(a, b, exchange, area, start, column, factor):
    """Both directions of every link, gathered by receiver: row ``n`` is ``start[n]:start[n + 1]``.

    ``factor`` holds the form factor from the receiver to the sender ``column``, 0 from one without area.  A link
    of a node with itself stands once.
    """
    rows = start.shape[0] - 1
    start[:] = 0
    for i in range(a.shape[0]):
        start[a[i] + 1] += 1
        if a[i] != b[i]:
            start[b[i] + 1] += 1
    for n in range(rows):
        start[n + 1] += start[n]
    place = start[:-1].copy()
    for i in range(a.shape[0]):
        x, y = a[i], b[i]
        column[place[x]] = y
        factor[place[x]] = exchange[i] / area[x] if area[x] > 0.0 else 0.0
        place[x] += 1
        if x != y:
            column[place[y]] = x
            factor[place[y]] = exchange[i] / area[y] if area[y] > 0.0 else 0.0
            place[y] += 1


@njit(nogil=True, cache=True)
def gather(first, last, start, column, factor, values, out):
    """Irradiance that rows ``first..last`` receive over their own links from ``values`` (nodes, bands)."""
    bands = values.shape[1]
    for n in range(first, last):
        for band in range(bands):
            out[n, band] = 0.0
        for i in range(start[n], start[n + 1]):
            j = column[i]
            f = factor[i]
            for band in range(bands):
                out[n, band] += f * values[j, band]


@njit(nogil=True, cache=True)
def expand(split, end, a, b, children, child, new_a, new_b, parent):
    """Pairs that replace the pairs ``split``: the parts of one end with the other; their number.

    ``end`` is 1 to split the first, 2 the second.  A cluster with itself gives its parts with
    themselves and with each other.  ``parent`` gets the place of the pair that each came from.
    """
    used = 0
    for s in range(split.shape[0]):
        i = split[s]
        x, y = a[i], b[i]
        n = x if end[i] == 1 else y
        for k in range(child[n], child[n] + children[n]):
            if x == y:
                for m in range(k, child[n] + children[n]):
                    new_a[used], new_b[used], parent[used] = k, m, i
                    used += 1
                continue
            if end[i] == 1:
                new_a[used], new_b[used] = k, y
            else:
                new_a[used], new_b[used] = x, k
            parent[used] = i
            used += 1
    return used


@njit(nogil=True, cache=True)
def deviations(square, mean, out):
    """Largest standard deviation over the bands of each node, from the means of squares and values."""
    for n in range(mean.shape[0]):
        most = 0.0
        for band in range(mean.shape[1]):
            most = max(most, square[n, band] - mean[n, band] * mean[n, band])
        out[n] = np.sqrt(most)
