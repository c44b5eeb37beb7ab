"""Kernels of pictures: local fits between samples."""

from __future__ import annotations

import numpy as np
from numba import njit

RIDGE = 1e-3
"""Share of the sum of weights that holds slopes back where samples do not tell them."""
REACH = 1.5
"""Values of a fit stay within the samples' range widened by this share of it on either side."""


@njit(nogil=True, cache=True)
def local_fits(place, neighbour, distance, limit, sample_place, values, out):
    """Fit a plane to the nearest samples about each place, and read it there.

    Moving least squares: weights (1 - (d/h)^2)^2, h the distance of the furthest neighbour.

    Parameters
    ----------
    place : (n, 2) float
        Places in the picture. [pixels]
    neighbour : (n, k) int
        Samples, nearest first.
    distance : (n, k) float
        Beyond ``limit`` a neighbour lies on another sheet and does not count.
    sample_place : (m, 2) float
    values : (m, bands) float
    out : (n, bands) float
        NaN where there is no neighbour.
    """
    bands = values.shape[1]
    k = neighbour.shape[1]
    for i in range(place.shape[0]):
        count = 0
        while count < k and distance[i, count] < limit:
            count += 1
        if count == 0:
            out[i] = np.nan
            continue
        if count < k:
            h = 1.5 * distance[i, count - 1]
        else:
            h = distance[i, k - 1]
        h = max(h, 1e-9) * (1.0 + 1e-6)
        s = sx = sy = sxx = sxy = syy = 0.0
        for j in range(count):
            m = neighbour[i, j]
            r = distance[i, j] / h
            w = (1.0 - r * r) ** 2
            dx, dy = (sample_place[m, 0] - place[i, 0]) / h, (sample_place[m, 1] - place[i, 1]) / h
            s += w
            sx += w * dx
            sy += w * dy
            sxx += w * dx * dx
            sxy += w * dx * dy
            syy += w * dy * dy
        for band in range(bands):
            mean = 0.0
            low, high = np.inf, -np.inf
            for j in range(count):
                m = neighbour[i, j]
                r = distance[i, j] / h
                mean += (1.0 - r * r) ** 2 * values[m, band]
                low, high = min(low, values[m, band]), max(high, values[m, band])
            mean /= s
            # About the weighted mean: slopes from the centred moments, held back by a ridge.
            ax, ay = sx / s, sy / s
            cxx = sxx - s * ax * ax + RIDGE * s
            cyy = syy - s * ay * ay + RIDGE * s
            cxy = sxy - s * ax * ay
            bx = by = 0.0
            for j in range(count):
                m = neighbour[i, j]
                r = distance[i, j] / h
                w = (1.0 - r * r) ** 2
                dx, dy = (sample_place[m, 0] - place[i, 0]) / h - ax, (sample_place[m, 1] - place[i, 1]) / h - ay
                bx += w * dx * (values[m, band] - mean)
                by += w * dy * (values[m, band] - mean)
            determinant = cxx * cyy - cxy * cxy
            value = mean
            if determinant > 0.0:
                slope_x, slope_y = (cyy * bx - cxy * by) / determinant, (cxx * by - cxy * bx) / determinant
                value -= slope_x * ax + slope_y * ay
            slack = REACH * (high - low)
            out[i, band] = max(min(max(value, low - slack), high + slack), 0.0)
