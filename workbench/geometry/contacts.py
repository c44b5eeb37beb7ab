"""Contact lines: where other polygons touch, cross or nearly touch a polygon.

Irradiance jumps there (a discontinuity of order zero; P. S. Heckbert, "Discontinuity meshing for radiosity",
1992): the floor is lit up to the foot of a box and dark beneath it.  An element half under a box would hold the mean
of both, which nobody sees.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import convex_pieces, plane_basis

__all__ = ["contact_lines", "cut_along"]

FloatArray = NDArray[np.float64]

INSIDE = 1e-6
"""Lines nearer than this to the outline, as a share of the polygon's size, are the outline."""
GRID = 1e-9
"""Coordinates are rounded to this share of a cell's size, so that lines meet in the same points."""
LEAST_PART = 0.02
"""Parts of a cell that are smaller than this share of it are no cells of their own."""
_BLOCK = 1 << 22
"""Pairs of boxes that are compared at once."""


def contact_lines(geometry: Geometry, near: float, least: float = 0.0) -> dict[int, FloatArray]:
    """Segments on polygons along which other polygons touch them.

    They are the other polygons' edges within ``near`` of the plane, seen along its normal, and the lines in which
    polygons cross it; what runs along the polygon's own outline is left out.

    Parameters
    ----------
    geometry : Geometry
    near : float
        Largest distance that counts as touching. [scene lengths]
    least : float
        Polygons, on either side, whose largest extent is below this are passed over. [scene lengths]

    Returns
    -------
    dict
        Polygon to its segments (m, 2, 3), in its plane; polygons without any are left out.
    """
    bounds = geometry.piece_bounds
    if not len(bounds):
        return {}
    large = np.ptp(bounds, axis=1).max(axis=1) >= least
    others = np.flatnonzero(large)
    starts = geometry.polygon_piece_start[:-1]
    low = np.minimum.reduceat(bounds[:, 0], starts) - near
    high = np.maximum.reduceat(bounds[:, 1], starts) + near
    asked = np.flatnonzero((high - low - 2 * near).max(axis=1) >= least)
    found: dict[int, FloatArray] = {}
    rows = max(1, _BLOCK // max(len(others), 1))
    for begin in range(0, len(asked), rows):
        block = asked[begin : begin + rows]
        meet = (low[block, None] <= bounds[None, others, 1]).all(axis=2)
        meet &= (bounds[None, others, 0] <= high[block, None]).all(axis=2)
        meet &= geometry.piece_polygon[others] != block[:, None]
        for row in np.flatnonzero(meet.any(axis=1)).tolist():
            polygon = int(block[row])
            segments = _segments(geometry, polygon, others[meet[row]], near)
            if len(segments):
                found[polygon] = segments
    return found


def _segments(geometry: Geometry, polygon: int, pieces: NDArray[np.int64], near: float) -> FloatArray:
    """Segments (m, 2, 3) that some pieces leave on the inside of a polygon."""
    own = range(geometry.polygon_piece_start[polygon], geometry.polygon_piece_start[polygon + 1])
    normal, origin = geometry.polygon_normal[polygon], geometry.piece(own[0])[0]
    # All corners of the pieces in one row, and where the next of each ring stands.
    sizes = np.diff(geometry.piece_start)[pieces]
    begin = np.cumsum(sizes) - sizes
    which = np.repeat(np.arange(len(pieces)), sizes)
    place = np.arange(len(which))
    ahead = np.where(place + 1 < (begin + sizes)[which], place + 1, begin[which])
    ring = geometry.corners[place - begin[which] + geometry.piece_start[pieces][which]]
    height = (ring - origin) @ normal
    flat = np.abs(height) <= near
    touching = flat & flat[ahead]
    level = height[:, None] * normal
    edges = np.stack([ring - level, (ring - level)[ahead]], axis=1)[touching]
    # A convex piece that does not touch crosses the plane along one segment.
    cuts = (height < 0) != (height[ahead] < 0)
    cuts &= (np.maximum.reduceat(height, begin) > 0)[which]
    cuts &= (np.bincount(which, cuts) == 2)[which] & (np.bincount(which, touching) == 0)[which]
    share = (height[cuts] / (height - height[ahead])[cuts])[:, None]
    crossed = (ring[cuts] + share * (ring[ahead] - ring)[cuts]).reshape(-1, 2, 3)
    order = np.argsort(np.concatenate([which[touching], which[cuts][::2]]), kind="stable")
    segments = np.concatenate([edges, crossed])[order]
    if not len(segments):
        return segments
    frame = np.stack(plane_basis(normal))
    outline = shapely.union_all([shapely.Polygon((geometry.piece(k) - origin) @ frame.T) for k in own])
    inner = outline.buffer(-INSIDE * float(np.sqrt(outline.area)))
    shapely.prepare(inner)
    return segments[shapely.intersects(inner, shapely.linestrings((segments - origin) @ frame.T))]


def cut_along(pieces: Sequence[FloatArray], normal: FloatArray, segments: FloatArray) -> list[list[FloatArray]]:
    """A cell cut along segments into cells; lines that end inside it cut nothing.

    Parameters
    ----------
    pieces : sequence of (n, 3) float
        Convex pieces of the cell, counter-clockwise about ``normal``.
    normal : (3,) float
    segments : (m, 2, 3) float
        In the cell's plane.

    Returns
    -------
    list of list of (n, 3) float
        Convex pieces of each part.  Parts below 2 % of the cell are given to the largest.
    """
    origin, frame = pieces[0][0], np.stack(plane_basis(normal))
    cell = shapely.union_all([shapely.Polygon((piece - origin) @ frame.T) for piece in pieces])
    lines = shapely.linestrings((segments - origin) @ frame.T)
    lines = lines[shapely.intersects(cell, lines)]
    if not len(lines):
        return [list(pieces)]
    grid = GRID * float(np.sqrt(cell.area))
    edges = shapely.union_all([shapely.boundary(cell), *shapely.intersection(lines, cell)], grid_size=grid)
    parts = [
        part for part in shapely.get_parts(shapely.polygonize([edges])) if cell.contains(part.representative_point())
    ]
    parts.sort(key=lambda part: -part.area)
    # What rounding and slivers would lose stays with the largest part.
    kept = [part for part in parts[1:] if part.area > LEAST_PART * cell.area]
    if not kept:
        return [list(pieces)]
    rest = shapely.difference(cell, shapely.union_all(kept), grid_size=grid)
    made = []
    for part in (rest, *kept):
        loops: list[FloatArray] = []
        for shape in shapely.get_parts(part):
            if shape.geom_type != "Polygon" or shape.area <= 1e-9 * cell.area:
                continue
            shape = shapely.geometry.polygon.orient(shape)
            rings = [np.asarray(ring.coords)[:-1] for ring in (shape.exterior, *shape.interiors)]
            loops += convex_pieces([origin + ring @ frame for ring in rings])
        if loops:
            made.append(loops)
    return made
