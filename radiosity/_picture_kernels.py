"""Kernels of pictures: local fits between samples."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

RIDGE = 1e-3
"""Share of the sum of weights that holds slopes back where samples do not tell them."""
THROUGH = 1e-4
"""Square of the distance, as a share of the furthest neighbour's, below which a sharp sample alone counts, about."""
REACH = 1.5
"""Values of a fit stay within the samples' range widened by this share of it on either side."""


@njit(nogil=True, cache=True)
def local_fits(place, neighbour, distance, limit, sample_place, values, sharp, out):
    """Fit a plane to the nearest samples about each place, and read it there.

    Moving least squares: weights (1 - (d/h)^2)^2, h the distance of the furthest neighbour.  Where the nearest sample
    is sharp they are divided by (d/h)^2, about: the fit goes through the samples (Lancaster and Salkauskas 1981).

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
    sharp : (m,) bool
    out : (n, bands) float
        NaN where there is no neighbour.
    """
    bands = values.shape[1]
    k = neighbour.shape[1]
    weight = np.empty(k)
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
            if sharp[neighbour[i, 0]]:
                w /= r * r + THROUGH
            weight[j] = w
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
                mean += weight[j] * values[m, band]
                low, high = min(low, values[m, band]), max(high, values[m, band])
            mean /= s
            # About the weighted mean: slopes from the centred moments, held back by a ridge.
            ax, ay = sx / s, sy / s
            cxx = sxx - s * ax * ax + RIDGE * s
            cyy = syy - s * ay * ay + RIDGE * s
            cxy = sxy - s * ax * ay
            bx = by = 0.0
            for j in range(count):
                m, w = neighbour[i, j], weight[j]
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


@njit(nogil=True, cache=True)
def eye_rays(eye, corner, right, down, x, y, centre, scale, along, starts, directions):
    """Unit directions (n, 3) through places of the picture, and the rays in Embree's unit coordinates, float32."""
    for i in range(x.shape[0]):
        square = 0.0
        for k in range(3):
            along[i, k] = corner[k] + x[i] * right[k] + y[i] * down[k]
            square += along[i, k] * along[i, k]
        inverse = 1.0 / math.sqrt(square)
        for k in range(3):
            along[i, k] *= inverse
            starts[i, k] = (eye[k] - centre[k]) * scale
            directions[i, k] = along[i, k]


@njit(nogil=True, cache=True)
def plain_ends(
    along, polygon, t, facing, front, polygon_surface, both_sides, reflectance, emitted, beyond, sheets, pixel_size,
    radiance, mark, ray, sheet, footprint, gain,
):  # fmt: skip
    """What rays saw in a scene where no ray leads on: radiance, marks, and the ends on what reflects, packed.

    ``ray, sheet, footprint, gain`` are those of :class:`radiosity.gather._Fragments`.  Returns the number of ends.
    """
    bands = radiance.shape[1]
    surfaces = reflectance.shape[0]
    many = 0
    for i in range(along.shape[0]):
        mark[i] = 0
        if not t[i] < np.inf:
            for band in range(bands):
                radiance[i, band] = beyond[band]
            continue
        s = polygon_surface[polygon[i]]
        if not (front[i] or both_sides[s]):
            continue
        on = 2 * sheets[polygon[i]] + (0 if front[i] else 1)
        mark[i] = (on + 1) * (surfaces + 1) + s + 1
        reflects = False
        for band in range(bands):
            radiance[i, band] = emitted[s, band]
            reflects = reflects or reflectance[s, band] > 0.0
        if not reflects:
            continue
        cosine = abs(along[i, 0] * facing[i, 0] + along[i, 1] * facing[i, 1] + along[i, 2] * facing[i, 2])
        ray[many], sheet[many] = i, on
        footprint[many] = t[i] * pixel_size / math.sqrt(max(cosine, 1e-3))
        for band in range(bands):
            gain[many, band] = reflectance[s, band] / math.pi
        many += 1
    return many


@njit(nogil=True, cache=True)
def alike(mark, steady, width, height, step, same, varies):
    """Which pixels' four corners, of a lattice (height + 1, width + 1), saw the same, without a step in radiance.

    And what the sum of its bands ``varies`` by (pixels,).
    """
    for row in range(height):
        for column in range(width):
            first = row * (width + 1) + column
            agree = True
            mean = square = 0.0
            for other in (first, first + 1, first + width + 1, first + width + 2):
                bright = steady[other].sum()
                mean += 0.25 * bright
                square += 0.25 * bright * bright
                agree = agree and mark[other] == mark[first]
                if agree:
                    agree = not _steps(steady, first, steady, other, step)
            same[row * width + column] = agree
            varies[row * width + column] = max(square - mean * mean, 0.0)


@njit(nogil=True, cache=True)
def _steps(one, i, two, j, step):
    """Whether two rows of radiance differ by more than a share of the brightest band."""
    most = off = 0.0
    for band in range(one.shape[1]):
        most = max(most, one[i, band], two[j, band])
        off = max(off, abs(one[i, band] - two[j, band]))
    return off > step * most


@njit(nogil=True, cache=True)
def bends(pixel, sheet, bright, start, width, bent):
    """By what share brightness bends or steps from pixel to pixel of a sheet, of the brighter ones (``bent`` (n,)).

    The mean over a pixel of what is smooth differs from its middle by a 24th of the second difference, and of a
    step by half of it.  ``start[p]:start[p + 1]`` are the fragments of pixel p.
    """
    height = (start.shape[0] - 1) // width
    for i in range(pixel.shape[0]):
        here, wanted = bright[i], sheet[i]
        bent[i] = 0.0
        row = np.int64(np.uint64(pixel[i]) // np.uint64(width))  # signed divisions take several times as long
        column = pixel[i] - row * width
        for axis in range(2):
            stride, low, high = (1, column, width - 1 - column) if axis == 0 else (width, row, height - 1 - row)
            before = _on_sheet(pixel[i] - stride, wanted, sheet, start) if low > 0 else -1
            after = _on_sheet(pixel[i] + stride, wanted, sheet, start) if high > 0 else -1
            if before >= 0 and after >= 0:
                off, most = abs(2.0 * here - bright[before] - bright[after]), max(bright[before], bright[after])
            elif before >= 0 or after >= 0:
                one = max(before, after)
                off, most = abs(here - bright[one]), bright[one]
                beyond = -1
                if before >= 0 and low > 1:
                    beyond = _on_sheet(pixel[i] - 2 * stride, wanted, sheet, start)
                elif after >= 0 and high > 1:
                    beyond = _on_sheet(pixel[i] + 2 * stride, wanted, sheet, start)
                if beyond >= 0 and here > 0.0:  # what the next two foretell, but that light ends somewhere
                    off = min(off, abs(here - 2.0 * bright[one] + bright[beyond]))
            else:
                continue
            most = max(most, here)
            if most > 0.0:
                bent[i] = max(bent[i], off / most)


@njit(nogil=True, cache=True)
def _on_sheet(place, wanted, sheet, start):
    """The fragment of a pixel on a sheet, -1 for none."""
    for j in range(start[place], start[place + 1]):
        if sheet[j] == wanted:
            return j
    return -1


@njit(nogil=True, cache=True)
def group_sheets(owner, sheet, group, label):
    """Number ends, sorted by ``owner``, so that those of one owner on one sheet share a number; how many there are."""
    many = first = 0
    for i in range(owner.shape[0]):
        if i == 0 or owner[i] != owner[i - 1]:
            first = many
        g = first
        while g < many and label[g] != sheet[i]:
            g += 1
        if g == many:
            label[many] = sheet[i]
            many += 1
        group[i] = g
    return many


@njit(nogil=True, cache=True)
def stand_for(group, x, y, gain, wanted, total, chosen, asked):
    """For each group its ``total`` gain (g, bands) and the end ``chosen`` (g,) nearest to its middle.

    ``asked`` are ends that are ``wanted``, and the chosen one of a group that has no such.  The middle itself
    may lie under something.
    """
    groups = total.shape[0]
    count, middle = np.zeros(groups), np.zeros((groups, 2))
    held = np.zeros(groups, dtype=np.bool_)
    total[:] = 0.0
    for i in range(group.shape[0]):
        g = group[i]
        count[g] += 1.0
        middle[g, 0] += x[i]
        middle[g, 1] += y[i]
        asked[i] = wanted[i]
        held[g] = held[g] or asked[i]
        for band in range(gain.shape[1]):
            total[g, band] += gain[i, band]
    nearest = np.full(groups, np.inf)
    for i in range(group.shape[0]):
        g = group[i]
        off = (x[i] - middle[g, 0] / count[g]) ** 2 + (y[i] - middle[g, 1] / count[g]) ** 2
        if off < nearest[g]:
            nearest[g], chosen[g] = off, i
    for g in range(groups):
        asked[chosen[g]] = asked[chosen[g]] or not held[g]


@njit(nogil=True, cache=True)
def light_of_groups(group, rows, gain, light, ray, ambient, mean, bright):
    """Mean ``light`` (g, bands) of groups by those ``rows`` of their ends that were asked, weighted by gain.

    Adds to ``bright`` (rays,) what all ends reflect of it, each of its own light where it was asked, and of
    ``ambient`` (bands,).
    """
    bands = gain.shape[1]
    weight = np.zeros(mean.shape)
    mean[:] = 0.0
    own = np.full(group.shape[0], -1, dtype=np.int64)
    for k in range(rows.shape[0]):
        i = rows[k]
        own[i] = k
        for band in range(bands):
            weight[group[i], band] += gain[i, band]
            mean[group[i], band] += gain[i, band] * light[k, band]
    for g in range(mean.shape[0]):
        for band in range(bands):
            if weight[g, band] > 0.0:
                mean[g, band] /= weight[g, band]
    for i in range(group.shape[0]):
        for band in range(bands):
            arriving = light[own[i], band] if own[i] >= 0 else mean[group[i], band]
            bright[ray[i]] += gain[i, band] * (arriving + ambient[band])


@njit(nogil=True, cache=True)
def sum_rays(owner, radiance, bright, radiance_sum, moments):
    """Add rays to their owners: radiance; number, sum and sum of squares of brightness, and the least."""
    for i in range(owner.shape[0]):
        o = owner[i]
        moments[o, 0] += 1.0
        moments[o, 1] += bright[i]
        moments[o, 2] += bright[i] * bright[i]
        moments[o, 3] = min(moments[o, 3], bright[i])
        for band in range(radiance.shape[1]):
            radiance_sum[o, band] += radiance[i, band]
