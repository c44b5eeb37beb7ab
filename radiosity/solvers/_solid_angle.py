"""Means over elements of the light of points, spots and lines: exact where nothing hides or bundles it.

What a place that shines evenly sends to an element is its intensity times the solid angle of the element (A. van
Oosterom and J. Strackee, "The Solid Angle of a Plane Triangle", IEEE Trans. Biomed. Eng. 30, 1983).  So no light is
lost or made, however close to a wall the lamp hangs, where points on the element would miss the spike below it.
Fall-off and what hides a light enter as a mean over points, more of them where a light is close or a cone ends.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from radiosity.patches import PatchMesh
from workbench.scene.model import Light

__all__ = ["PLACES", "cell_counts", "places_of", "solid_angles"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

PLACES = 4
"""Places along a linear light for elements that are far from it, and the most for those close to it:"""
MOST_PLACES = 64
MOST_CELLS = 64
"""Most cells an axis of an element, each with one point."""
CELLS_A_CONE, LEAST_IN_CONE = 16.0, 8.0
"""Cells over the half-width of a cone's disk on an element that its edge crosses: they leave 0.3 % of its light."""
CELLS_A_BEAM, BEAM = 8.0, 3.5
"""Cells over the width, 1 / sqrt(n), of a beam of cos^n, and how many widths of it count."""
SUN_POINTS = 1 << 17
"""Points that look for parallel light, spread by area over what faces it: it may come through a small window."""
MOST_SUN_CELLS = 256
CELLS_A_DISTANCE = 2.0
"""Cells over an element's distance from the light, for what may hide a part of it."""


@njit(nogil=True, cache=True)
def solid_angles(corners, piece_start, element_piece, normal, chosen, place, out):
    """Solid angle of each chosen element seen from ``place``, 0 from behind. [sr]"""
    for row in range(chosen.shape[0]):
        e = chosen[row]
        total = 0.0
        for piece in range(element_piece[e], element_piece[e + 1]):
            a = piece_start[piece]
            ax, ay, az = corners[a, 0] - place[0], corners[a, 1] - place[1], corners[a, 2] - place[2]
            if not ax * normal[e, 0] + ay * normal[e, 1] + az * normal[e, 2] < 0.0:
                continue
            la = math.sqrt(ax * ax + ay * ay + az * az)
            part = 0.0
            for b in range(a + 1, piece_start[piece + 1] - 1):
                bx, by, bz = corners[b, 0] - place[0], corners[b, 1] - place[1], corners[b, 2] - place[2]
                cx, cy, cz = corners[b + 1, 0] - place[0], corners[b + 1, 1] - place[1], corners[b + 1, 2] - place[2]
                lb, lc = math.sqrt(bx * bx + by * by + bz * bz), math.sqrt(cx * cx + cy * cy + cz * cz)
                volume = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
                ab, bc, ca = ax * bx + ay * by + az * bz, bx * cx + by * cy + bz * cz, cx * ax + cy * ay + cz * az
                part += 2.0 * math.atan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
            total += abs(part)
        out[row] = total


def places_of(light: Light, count: int) -> FloatArray:
    """Places (k, 3) that stand for a light: itself, or the middles of ``count`` even parts of a line."""
    assert light.position is not None
    if light.end is None:
        return light.position[None]
    along = (np.arange(count) + 0.5)[:, None] / count
    return light.position + along * (light.end - light.position)


def cell_counts(light: Light, mesh: PatchMesh, first: int, last: int) -> tuple[IntArray, IntArray]:
    """Cells an axis and places along the light, (elements,) each; 0 cells where the usual points do."""
    if light.kind == "directional":
        assert light.direction is not None
        facing = mesh.element_normal @ light.direction < 0.0
        share = np.where(facing, mesh.element_area, 0.0)[first:last] / max(mesh.element_area[facing].sum(), 1e-300)
        sides = np.sqrt(SUN_POINTS * share)
        cells = np.where(sides > 2.0, 2.0 ** np.round(np.log2(np.clip(sides, 1.0, MOST_SUN_CELLS))), 0.0)
        return cells.astype(np.int64), np.ones(last - first, dtype=np.int64)
    centroid, size = mesh.element_centroid[first:last], mesh.element_size[first:last]
    gap = np.full(last - first, np.inf)
    for place in places_of(light, MOST_PLACES):
        toward = place - centroid
        height = np.einsum("ij,ij->i", toward, mesh.element_normal[first:last])
        # Not nearer than its height above the plane, nor than to a ball round the element.
        near = np.maximum(height, np.linalg.norm(toward, axis=1) - 0.5 * size)
        gap = np.where(height > 0.0, np.minimum(gap, near), gap)
    with np.errstate(divide="ignore"):
        wanted = np.where(gap < size, CELLS_A_DISTANCE * size / gap, 0.0)
    places = np.ones(last - first)
    if light.end is not None:
        assert light.position is not None
        length = float(np.linalg.norm(light.end - light.position))
        with np.errstate(divide="ignore"):
            places = 2.0 ** np.ceil(np.log2(np.clip(2.0 * length / gap, PLACES, MOST_PLACES)))
    if light.kind == "spot":
        assert light.position is not None and light.direction is not None
        toward = centroid - light.position
        distance = np.maximum(np.linalg.norm(toward, axis=1), 1e-300)
        angle = np.arccos(np.clip(toward @ light.direction / distance, -1.0, 1.0))
        reach = np.arcsin(np.minimum(0.5 * size / distance, 1.0))
        cone = math.radians(light.cone_deg)
        crossed = (angle < cone + reach) & (angle > cone - reach)
        width = distance * math.tan(min(cone, math.radians(80.0)))
        if light.exponent > 1.0:
            beam = 1.0 / math.sqrt(light.exponent)
            bundled = angle < BEAM * beam + reach
            wanted = np.where(bundled, np.maximum(wanted, CELLS_A_BEAM * size / (distance * beam)), wanted)
        wanted = np.where(crossed, np.maximum(wanted, np.maximum(CELLS_A_CONE * size / width, LEAST_IN_CONE)), wanted)
    # Powers of two, so that elements fall into few groups.
    cells = np.where(wanted > 2.0, 2.0 ** np.ceil(np.log2(np.clip(wanted, 1.0, MOST_CELLS))), 0.0)
    return cells.astype(np.int64), places.astype(np.int64)
