"""Gathering as kernels: places of sensors, cosine-equal rays from points, and what their hits send back."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from radiosity.element_lookup import search_list
from workbench.accel.box_tree import boxes_meeting_planes
from workbench.sampling.sequences import hashed, owen_scramble
from workbench.shadow._sky import relative_radiance

RUNS = 4
"""Blocks of one point's rays that are told apart: each is a net of its own, their spread tells the error."""


ALIKE, CROSSING = 0.9, 0.1
"""Cosine from which a surface faces as a sensor does, and sine from which it crosses the sensor's plane."""


@njit(nogil=True, cache=True)
def stand_in_front(
    points, normals, own, corners, starts, piece_polygon, polygon_normal, one_sided, low, high, skip, first, count,
    order, bounds, near, tally,
):  # fmt: skip
    """Move ``points`` (n, 3) that lie on surfaces, or less than ``near`` off them, to the side that can be seen.

    ``own`` (n,) gets the polygon that faces as the sensor does, the nearest one; a point behind it moves onto it.  A
    point on a one-sided polygon that rises before the sensor, as on the line where a wall meets the floor, moves
    ``near`` before that: on the line itself half of what is seen would lie behind the wall.
    """
    planes, found = np.empty((6, 4)), np.empty(64, dtype=np.int64)
    for i in range(points.shape[0]):
        n = normals[i]
        own[i] = -1
        closest = np.inf
        # The own polygon first, then what rises before it, twice: two walls may meet there.
        for step in range(3):
            p = points[i].copy()
            for axis in range(3):
                planes[2 * axis : 2 * axis + 2] = 0.0
                planes[2 * axis, axis], planes[2 * axis, 3] = 1.0, p[axis] - near
                planes[2 * axis + 1, axis], planes[2 * axis + 1, 3] = -1.0, -p[axis] - near
            many = boxes_meeting_planes(low, high, skip, first, count, order, bounds, planes, 6, 0.0, found, tally)
            for k in range(min(many, found.shape[0])):
                piece = found[k]
                polygon = piece_polygon[piece]
                a, b = starts[piece], starts[piece + 1]
                m = polygon_normal[polygon]
                off, facing = 0.0, 0.0
                for axis in range(3):
                    off += m[axis] * (p[axis] - corners[a, axis])
                    facing += m[axis] * n[axis]
                if abs(off) > near:
                    continue
                inside, rise = True, -np.inf
                for c in range(a, b):
                    side = corners[c + 1 if c + 1 < b else a] - corners[c]
                    away = p - corners[c]
                    inward = np.cross(side, away)
                    inside = inside and (inward * m).sum() >= -near * math.sqrt((side * side).sum())
                    rise = max(rise, -(away * n).sum())
                if not inside:
                    continue
                if step == 0:
                    alike = facing > ALIKE or (facing < -ALIKE and not one_sided[polygon])
                    if alike and abs(off) < closest:
                        closest, own[i] = abs(off), polygon
                        if off * facing < 0.0:
                            points[i] = p - off * m
                elif one_sided[polygon] and rise > near and off < near and polygon != own[i]:
                    along = m - facing * n
                    square = (along * along).sum()
                    if square > CROSSING * CROSSING:
                        points[i] += (near - off) / square * along
                        break


@njit(nogil=True, cache=True)
def gather_rays(
    points, normals, rows, bits, first, last, count, seed, offset, centre, scale, origins, directions, owner, run,
):  # fmt: skip
    """Rays ``first..last`` of the ``count`` in the bundle of each of ``rows``, in Embree's unit coordinates.

    Directions are unit vectors as dense as the cosine to the normal: a scrambled net of the unit
    square, of each point's own by its number and ``seed``, on the disk (Shirley and Chiu 1997) lifted
    to the hemisphere (Malley).  ``owner`` gets the position in ``rows`` of each ray, ``run`` its block.
    """
    k = 0
    for position in range(rows.shape[0]):
        i = rows[position]
        h = hashed(i, seed)
        s0, s1 = np.uint32(h & np.uint64(0xFFFFFFFF)), np.uint32(h >> np.uint64(32))
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        # A frame about the normal without a branch at the pole (Duff et al., JCGT 6(1), 2017).
        sign = math.copysign(1.0, nz)
        a = -1.0 / (sign + nz)
        b = nx * ny * a
        px, py, pz = 1.0 + sign * nx * nx * a, sign * b, -sign * nx
        qx, qy, qz = b, sign + ny * ny * a, -ny
        ox = (points[i, 0] + offset * nx - centre[0]) * scale
        oy = (points[i, 1] + offset * ny - centre[1]) * scale
        oz = (points[i, 2] + offset * nz - centre[2]) * scale
        for j in range(first, last):
            u = 2.0 * ((np.float64(owen_scramble(bits[j, 0], s0)) + 0.5) * 2.0**-32) - 1.0
            v = 2.0 * ((np.float64(owen_scramble(bits[j, 1], s1)) + 0.5) * 2.0**-32) - 1.0
            if abs(u) > abs(v):
                radius, angle = u, 0.25 * math.pi * (v / u)
            else:
                radius, angle = v, 0.5 * math.pi - 0.25 * math.pi * (u / v)
            x, y = radius * math.cos(angle), radius * math.sin(angle)
            z = math.sqrt(max(1.0 - radius * radius, 0.0))
            origins[k, 0], origins[k, 1], origins[k, 2] = ox, oy, oz
            directions[k, 0] = x * px + y * qx + z * nx
            directions[k, 1] = x * py + y * qy + z * ny
            directions[k, 2] = x * pz + y * qz + z * nz
            owner[k], run[k] = position, j * RUNS // count
            k += 1


@njit(nogil=True, cache=True)
def collect_hits(
    origins, directions, owner, run, weight, polygon, measure, centre, scale, polygon_normal, polygon_level, through,
    root, frame, counts, cells, lists, order, boxes, links, starts, edges, piece_element, linear, law,
    open_sky, coarse, seed, sums, reach, seen, passed, kept, kept_element, kept_polygon, near,
):  # fmt: skip
    """Add what the hits of rays send back to ``sums`` (points, runs, bands); the number of rays past a pane.

    ``linear`` (elements, bands, 4) gives the radiosity at (x, y, z) as ``a x + b y + c z + d``.
    ``seen`` (points, runs, 2) gets, if ``open_sky``, what rays that miss everything see of the sky of
    ``law`` (irradiance for a zenith radiance of 1) and of the ground (form factor).
    ``reach`` (points, 2) gets the sum of 1 / distance and the number of hits, if ``measure``.
    ``passed`` gets the position, the weight and the distance of rays that go on through a pane.
    A hit closer than ``coarse`` (elements,) is on an element that may be too coarse for its distance: ``near``
    (points, runs) counts those, ``kept`` (points, runs, m, 4) has the place and weight of m of them, each
    as likely (reservoir sampling, A. G. Waterman's), with their element and polygon (~polygon seen from behind).
    """
    many = 0
    bands = linear.shape[1]
    for k in range(polygon.shape[0]):
        p = polygon[k]
        dx, dy, dz = np.float64(directions[k, 0]), np.float64(directions[k, 1]), np.float64(directions[k, 2])
        if p < 0:
            if open_sky:
                if law[0] * dx + law[1] * dy + law[2] * dz > 0.0:
                    seen[owner[k], run[k], 0] += weight[k] * math.pi * relative_radiance(dx, dy, dz, law)
                else:
                    seen[owner[k], run[k], 1] += weight[k]
            continue
        ox = np.float64(origins[k, 0]) / scale + centre[0]
        oy = np.float64(origins[k, 1]) / scale + centre[1]
        oz = np.float64(origins[k, 2]) / scale + centre[2]
        facing = polygon_normal[p, 0] * dx + polygon_normal[p, 1] * dy + polygon_normal[p, 2] * dz
        if facing == 0.0:
            continue
        height = polygon_level[p] - (polygon_normal[p, 0] * ox + polygon_normal[p, 1] * oy + polygon_normal[p, 2] * oz)
        t = max(height / facing, 0.0)
        position = owner[k]
        if measure:
            reach[position, 0] += weight[k] / max(t, 1e-300)
            reach[position, 1] += weight[k]
        if through[p] > 0.0:
            passed[many, 0], passed[many, 1], passed[many, 2] = k, weight[k] * through[p], t
            many += 1
        group = root[p, 0 if facing < 0.0 else 1]
        if group == -1:
            continue
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        if group <= -2:
            e = -2 - group
        else:
            # The look-up's grid, written out: a call would cost more.
            u = frame[group, 0] * x + frame[group, 1] * y + frame[group, 2] * z - frame[group, 3]
            v = frame[group, 4] * x + frame[group, 5] * y + frame[group, 6] * z - frame[group, 7]
            column = min(max(int(u), 0), counts[group, 1] - 1)
            row = min(max(int(v), 0), counts[group, 2] - 1)
            piece = cells[counts[group, 0] + row * counts[group, 1] + column]
            if piece < 0:
                piece = search_list(x, y, z, -1 - piece, lists, order, boxes, links, starts, edges)
            e = piece_element[piece]
        if t < coarse[e]:
            slot = near[position, run[k]]
            near[position, run[k]] += 1
            if slot >= kept.shape[2]:
                slot = np.int64(hashed(position * 65537 + k, seed) % np.uint64(slot + 1))
            if slot < kept.shape[2]:
                kept[position, run[k], slot, 0] = x
                kept[position, run[k], slot, 1] = y
                kept[position, run[k], slot, 2] = z
                kept[position, run[k], slot, 3] = weight[k]
                kept_element[position, run[k], slot] = e
                kept_polygon[position, run[k], slot] = p if facing < 0.0 else ~p
        for band in range(bands):
            value = linear[e, band, 0] * x + linear[e, band, 1] * y + linear[e, band, 2] * z + linear[e, band, 3]
            sums[position, run[k], band] += weight[k] * max(value, 0.0)
    return many
