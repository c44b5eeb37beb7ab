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
def spreads(spread, count, opened, child, children, area, centre):
    """Mean square distances from the centre, of leaves (nodes,), for every node above them, in place."""
    for n in range(count - 1, -1, -1):
        if opened[n] == 0:
            continue
        spread[n] = 0.0
        if area[n] <= 0.0:
            continue
        for k in range(child[n], child[n] + children[n]):
            square = spread[k]
            for axis in range(3):
                square += (centre[k, axis] - centre[n, axis]) ** 2
            spread[n] += area[k] / area[n] * square


@njit(nogil=True, cache=True)
def pull_moments(values, count, opened, child, children, area, centre, spread):
    """Means and moments of the leaves, for every node above them, in place; (nodes, 5, bands).

    With u the place from the centre, the rows hold the means of the value times 1, u (three rows), and
    u . u - ``spread``; all but the first are 0 over a leaf, which is even.
    """
    bands = values.shape[2]
    for n in range(count - 1, -1, -1):
        values[n, 1:, :] = 0.0
        if opened[n] == 0:
            continue
        values[n, 0, :] = 0.0
        if area[n] <= 0.0:
            continue
        for k in range(child[n], child[n] + children[n]):
            share = area[k] / area[n]
            x, y, z = centre[k, 0] - centre[n, 0], centre[k, 1] - centre[n, 1], centre[k, 2] - centre[n, 2]
            square = x * x + y * y + z * z + spread[k] - spread[n]
            for band in range(bands):
                here = values[k, 0, band]
                one, two, three = values[k, 1, band], values[k, 2, band], values[k, 3, band]
                values[n, 0, band] += share * here
                values[n, 1, band] += share * (one + x * here)
                values[n, 2, band] += share * (two + y * here)
                values[n, 3, band] += share * (three + z * here)
                values[n, 4, band] += share * (
                    values[k, 4, band] + 2.0 * (x * one + y * two + z * three) + square * here
                )


@njit(nogil=True, cache=True)
def push_shapes(values, count, opened, child, children, centre, spread):
    """Add what each opened node received, by its :func:`pull_moments` shapes, to its parts, in place.

    ``values`` (nodes, 5, bands); leaves end with the whole.
    """
    bands = values.shape[2]
    for n in range(count):
        if opened[n] == 0:
            continue
        for k in range(child[n], child[n] + children[n]):
            x, y, z = centre[k, 0] - centre[n, 0], centre[k, 1] - centre[n, 1], centre[k, 2] - centre[n, 2]
            square = x * x + y * y + z * z + spread[k] - spread[n]
            for band in range(bands):
                one, two, three, bend = values[n, 1, band], values[n, 2, band], values[n, 3, band], values[n, 4, band]
                values[k, 0, band] += values[n, 0, band] + x * one + y * two + z * three + square * bend
                values[k, 1, band] += one + 2.0 * x * bend
                values[k, 2, band] += two + 2.0 * y * bend
                values[k, 3, band] += three + 2.0 * z * bend
                values[k, 4, band] += bend


@njit(nogil=True, cache=True)
def sort_links(a, b, shape_a, shape_b, start, column, place, own, far):
    """Both directions of every link, gathered by receiver: row ``n`` is ``start[n]:start[n + 1]``.

    ``column`` is the sender, ``place`` the link, ``own`` and ``far`` the shapes of the form factor over
    receiver and sender.  A link of a node with itself stands once.
    """
    rows = start.shape[0] - 1
    start[:] = 0
    for i in range(a.shape[0]):
        start[a[i] + 1] += 1
        if a[i] != b[i]:
            start[b[i] + 1] += 1
    for n in range(rows):
        start[n + 1] += start[n]
    free = start[:-1].copy()
    for i in range(a.shape[0]):
        x, y = a[i], b[i]
        e = free[x]
        column[e], place[e] = y, i
        for row in range(4):
            own[e, row], far[e, row] = shape_a[i, row], shape_b[i, row]
        free[x] += 1
        if x != y:
            e = free[y]
            column[e], place[e] = x, i
            for row in range(4):
                own[e, row], far[e, row] = shape_b[i, row], shape_a[i, row]
            free[y] += 1


@njit(nogil=True, cache=True)
def form_factors(exchange, area, start, place, factor):
    """Form factors from the receivers of sorted links, from exchange areas of links; 0 from one without area."""
    for n in range(start.shape[0] - 1):
        for e in range(start[n], start[n + 1]):
            factor[e] = exchange[place[e]] / area[n] if area[n] > 0.0 else 0.0


@njit(nogil=True, cache=True)
def gather(first, last, start, column, factor, own, far, shaped, values, leaves_too, out):
    """Irradiance that rows ``first..last`` receive over their own links, and its shape over each.

    ``values`` and ``out`` (nodes, 5, bands) are as in :func:`pull_moments` and :func:`push_shapes`.
    Only what is ``shaped`` sends and gets shapes (with ``leaves_too`` every receiver gets them).
    """
    bands = values.shape[2]
    for n in range(first, last):
        out[n, :, :] = 0.0
        both = leaves_too or shaped[n]
        for e in range(start[n], start[n + 1]):
            j = column[e]
            f = factor[e]
            moments = shaped[j]
            # Written out: loops over four rows cost more than the work in them.
            for band in range(bands):
                sent = values[j, 0, band]
                if moments:
                    sent += (
                        far[e, 0] * values[j, 1, band] + far[e, 1] * values[j, 2, band]
                        + far[e, 2] * values[j, 3, band] + far[e, 3] * values[j, 4, band]
                    )  # fmt: skip
                sent *= f
                out[n, 0, band] += sent
                if both:
                    out[n, 1, band] += own[e, 0] * sent
                    out[n, 2, band] += own[e, 1] * sent
                    out[n, 3, band] += own[e, 2] * sent
                    out[n, 4, band] += own[e, 3] * sent


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
