"""Cast rays row by row, each row checked as one bundle: the plane-vertex check without antialiasing.

Source: A. Woo, "Efficient Shadow Computations in Ray Tracing" (IEEE CG&A 13(5), 1993), "Other uses of
plane-vertex checking".  All rays of a row lie in one plane through the eye, so a polygon that does
not cross it is set aside for the whole row, K = X.  A first pass casts the rays of the row and keeps
what they met in an array of X elements; a second pass goes on with shadows, reflections and
refractions.

The first pass is the loop of his Figure 4 with the eye for S and the row for the light, but looks
for the nearest hit.  It runs on the counting voxel grid; the second pass is the tracer's.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workbench.accel.base import NO_POLYGON, Hits
from workbench.accel.voxel_grid import CLOSEST, COUNTED, RayIDs, VoxelGrid, walk
from workbench.counters import Counters
from workbench.errors import InputError, OptionError
from workbench.render.adaptive import Picture, camera_rays, require_picture_memory
from workbench.render.camera import PinholeRays
from workbench.render.trace import Tracer
from workbench.shadow.woo import MARGIN

__all__ = ["RowHits", "RowPicture", "cast_rows", "picture_by_rows"]

FloatArray = NDArray[np.float64]


@njit(nogil=True, cache=True)
def _row_loop(
    objects, cells, eye, directions, skip, planes, mailbox, touched, current, limit, t, polygon, counts
):  # fmt: skip
    # Rows of cast rays.  ``planes`` (rows, 2, 4) are both sides of each row's plane; (rows, 0, 4)
    # leaves the check out.  Returns the next rayID.
    columns = directions.shape[1]
    no_planes = np.empty((0, 4))
    origin, direction, through = np.empty((1, 3)), np.empty((1, 3)), np.empty(0)
    origin[0, :] = eye
    for row in range(directions.shape[0]):
        if current > limit - columns:
            mailbox[:] = 0
            touched[:] = 0
            current = 1
        first = current
        last = first + columns - 1
        for column in range(columns):
            direction[0, :] = directions[row, column]
            t[row, column], index = walk(
                objects, cells, origin, direction, 0, np.inf, skip, CLOSEST, mailbox, touched, current, first, last,
                planes[row] if column != columns - 1 else no_planes, False, True, through, counts,
            )  # fmt: skip
            polygon[row, column] = objects.owner[index] if index >= 0 else NO_POLYGON
            current += 1
    return current


@dataclass(frozen=True)
class RowHits:
    """First hits of rows of cast rays, shape (rows, columns), and what they took."""

    hits: Hits
    counters: Counters


def cast_rows(
    grid: VoxelGrid, eye: FloatArray, directions: FloatArray, *, check: bool = True, ids: RayIDs | None = None
) -> RowHits:
    """Cast rows of rays from one eye, row after row.

    Parameters
    ----------
    grid : VoxelGrid
    eye : (3,) float
    directions : (rows, columns, 3) float
        Unit vectors; those of a row lie in one plane, up to rounding.
    check : bool
        Whether to check polygons against the plane of each row.  The hits are the same without.
    ids : RayIDs, optional
        Mailboxes and counter to go on with; fresh ones by default.

    Raises
    ------
    InputError
        If a row has more rays than there are rayIDs, or the eye is too far off for the grid.
    """
    rows, columns = directions.shape[:2]
    ids = ids or RayIDs(grid.object_count)
    if columns >= ids.limit:
        raise InputError(f"directions: found {columns} columns, expected less than the largest rayID {ids.limit}")
    grid.check_origins(eye[None])
    planes = np.empty((rows, 0, 4))
    if check:
        normal = np.cross(directions[:, 0], directions[:, -1])
        # The slack of workbench.shadow.woo: |N . v| <= |a| |b| |v|, here with unit a and b.
        reach = np.abs(eye).max() + grid.objects.reach
        slack = np.full((rows, 1), MARGIN * np.finfo(float).eps * reach)
        planes = np.stack([np.hstack([normal, slack]), np.hstack([-normal, slack])], axis=1)
    t, polygon = np.empty((rows, columns)), np.empty((rows, columns), dtype=np.int64)
    counts = np.zeros(len(COUNTED), dtype=np.int64)
    ids.current = _row_loop(
        grid.objects, grid.cells, np.ascontiguousarray(eye), directions, np.full((1, 2), NO_POLYGON), planes,
        ids.mailbox, ids.touched, ids.current, ids.limit, t, polygon, counts,
    )  # fmt: skip
    return RowHits(Hits(t, polygon), Counters(**dict(zip(COUNTED, counts.tolist(), strict=True))))


@dataclass(frozen=True)
class RowPicture:
    """A picture, what its cast rays took in the voxel grid, and the seconds of the two passes."""

    picture: Picture
    counters: Counters
    first_pass_s: float
    second_pass_s: float


def picture_by_rows(
    tracer: Tracer,
    camera: PinholeRays | None = None,
    *,
    check: bool = True,
    rows: int = 1,
    grid: VoxelGrid | None = None,
) -> RowPicture:
    """One ray through the middle of each pixel, by Woo's two passes over each row.

    The picture is that of :func:`~workbench.render.adaptive.aliased` but for rays so near an edge
    that single and double precision disagree about the polygon; with and without the check it is
    the same bit for bit.

    Parameters
    ----------
    tracer : Tracer
    camera : PinholeRays, optional
        The scene's own unless given.
    check : bool
        Whether to check polygons against the plane of each row.
    rows : int
        Rows cast before the second pass takes them up; 1 is the paper's array of X elements.
    grid : VoxelGrid, optional
        Of the tracer's geometry; made unless given.

    Raises
    ------
    InputError
        If there is no camera, or the grid has another number of polygons than the tracer.
    OptionError
        If ``rows`` is less than 1.
    """
    if rows < 1:
        raise OptionError(f"rows: found {rows}, expected 1 or more")
    rays = camera_rays(tracer, camera)
    require_picture_memory(rays, tracer.bands, 0)
    start = time.perf_counter()
    grid = grid or VoxelGrid(tracer.geometry)
    if grid.object_count != tracer.geometry.piece_count:
        raise InputError(
            f"grid: found {grid.object_count} objects, expected the tracer's {tracer.geometry.piece_count} polygons"
        )
    ids, counters, tally = RayIDs(grid.object_count), Counters(), tracer.no_rays()
    radiance = np.empty((rays.height, rays.width, tracer.bands))
    first_pass = 0.0
    for first in range(0, rays.height, rows):
        end = min(first + rows, rays.height)
        begun = time.perf_counter()
        along = rays.row_directions(first, end)
        met = cast_rows(grid, rays.eye, along.reshape(end - first, rays.width, 3), check=check, ids=ids)
        counters.merge(met.counters)
        first_pass += time.perf_counter() - begun
        number = np.arange(first * rays.width, end * rays.width)
        found = tracer.trace_unchecked(rays.eye[None], along, number, met=met.hits.polygon.ravel())
        radiance[first:end] = found.radiance.reshape(end - first, rays.width, -1)
        tally.add(found.tally)
    seconds = time.perf_counter() - start
    shape = (rays.height, rays.width)
    picture = Picture(
        radiance, np.ones(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64), tally, shape[0] * shape[1], seconds
    )
    return RowPicture(picture, counters, first_pass, seconds - first_pass)
