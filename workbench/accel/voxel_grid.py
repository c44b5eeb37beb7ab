"""The instrument: a uniform voxel grid that counts every step, test and skipped test.

Sources: J. Amanatides and A. Woo, "A Fast Voxel Traversal Algorithm for Ray Tracing" (Eurographics
1987), the walk and the rayID mailbox; A. Woo, "Efficient Shadow Computations in Ray Tracing"
(IEEE CG&A 1993), Figures 2 and 4, whose loops (:mod:`workbench.shadow.woo`) run on the same walk.

Where it departs from the 1987 paper: the parameter of the next voxel face is computed afresh from
the face, not added up, so that no error grows along the walk; and every polygon is also entered
in voxels that it misses by less than the margin of :attr:`VoxelGrid.margin`, which exceeds any
rounding of the walk.  A polygon in a voxel face is thus in both neighbours, and a walk that takes
one of the ways round a voxel corner still meets it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from workbench.accel._intersect import Objects, object_crossing, objects_of, ray_frame, ray_limits
from workbench.accel.base import NO_POLYGON, Hits, as_rays
from workbench.counters import Counters
from workbench.errors import InputError
from workbench.geometry.flat import Geometry

__all__ = ["COUNTED", "RAY_ID_LIMIT", "RayIDs", "VoxelGrid"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

COUNTED = (
    "rays",
    "rays_hit",
    "voxels_stepped",
    "mailbox_skips",
    "polygon_tests",
    "sphere_tests",
    "plane_vertex_checks",
    "plane_vertex_culls",
    "tests_avoided",
)
"""The counters of a walk, in the order of a kernel's ``counts`` array."""
_RAYS, _HIT, _VOXELS, _SKIPS, _POLYGONS, _SPHERES, _CHECKS, _CULLS, _AVOIDED = range(len(COUNTED))

CLOSEST, ANY, TRANSMIT = 0, 1, 2

RAY_ID_LIMIT = 2**63 - 1
"""Largest rayID; a counter that would pass it clears all ids and begins again at 1."""

BLOCK = 4096
"""Rays or points that a worker takes at a time."""

_CELLS_PER_OBJECT = 4.0
_MAX_RESOLUTION = 256
_MAX_CELLS = 2**24


class Cells(NamedTuple):
    """A grid as kernels read it: the lists of all cells in one array, x slowest, z fastest."""

    low: FloatArray
    high: FloatArray
    size: FloatArray
    resolution: IntArray
    start: IntArray
    items: IntArray


@njit(nogil=True, cache=True)
def _near_cell(objects, index, normal, low, high, margin):
    # Whether an object comes within the margin of the box low..high, conservatively.
    pieces = objects.piece_start.shape[0] - 1
    if index < pieces:
        # The slab that holds all corners (a quad may be a little warped) against the box.
        centre = reach = 0.0
        for k in range(3):
            centre += 0.5 * normal[k] * (low[k] + high[k])
            reach += abs(normal[k]) * (0.5 * (high[k] - low[k]) + margin[k])
        least, most = math.inf, -math.inf
        for corner in range(objects.piece_start[index], objects.piece_start[index + 1]):
            d = 0.0
            for k in range(3):
                d += normal[k] * objects.corners[corner, k]
            least, most = min(least, d), max(most, d)
        return centre + reach >= least and centre - reach <= most
    # The shell of a sphere: the nearest point of the box inside it, the farthest outside.
    nearest = farthest = 0.0
    for k in range(3):
        centre = objects.spheres[index - pieces, k]
        below, above = low[k] - margin[k] - centre, high[k] + margin[k] - centre
        nearest += max(below, -above, 0.0) ** 2
        farthest += max(abs(below), abs(above)) ** 2
    radius = objects.spheres[index - pieces, 3]
    return nearest <= radius * radius <= farthest


@njit(nogil=True, cache=True)
def _fill(objects, normals, cells, margin, cursor, items, store):
    # Enter each object in its cells: first a count in ``cursor``, then, with ``store``, the lists.
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    low, high = np.empty(3), np.empty(3)
    pieces = objects.piece_start.shape[0] - 1
    none = np.zeros(3)
    for index in range(objects.owner.shape[0]):
        normal = normals[index] if index < pieces else none
        for k in range(3):
            below = (objects.bounds[index, 0, k] - margin[k] - cells.low[k]) / cells.size[k]
            above = (objects.bounds[index, 1, k] + margin[k] - cells.low[k]) / cells.size[k]
            first[k] = max(0, math.floor(below))
            last[k] = min(cells.resolution[k] - 1, math.floor(above))
        single = first[0] == last[0] and first[1] == last[1] and first[2] == last[2]
        for i in range(first[0], last[0] + 1):
            low[0], high[0] = cells.low[0] + i * cells.size[0], cells.low[0] + (i + 1) * cells.size[0]
            for j in range(first[1], last[1] + 1):
                low[1], high[1] = cells.low[1] + j * cells.size[1], cells.low[1] + (j + 1) * cells.size[1]
                for k in range(first[2], last[2] + 1):
                    low[2], high[2] = cells.low[2] + k * cells.size[2], cells.low[2] + (k + 1) * cells.size[2]
                    if single or _near_cell(objects, index, normal, low, high, margin):
                        cell = (i * cells.resolution[1] + j) * cells.resolution[2] + k
                        if store:
                            items[cursor[cell]] = index
                        cursor[cell] += 1


@njit(nogil=True, cache=True)
def _outside_a_plane(objects, index, origins, ray, planes, boxes):
    # The plane-vertex check: all vertices (or box corners) strictly outside one and the same plane.
    pieces = objects.piece_start.shape[0] - 1
    ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
    for j in range(planes.shape[0]):
        nx, ny, nz, margin = planes[j, 0], planes[j, 1], planes[j, 2], planes[j, 3]
        if boxes:
            least = nx * (objects.bounds[index, 0 if nx > 0.0 else 1, 0] - ox)
            least += ny * (objects.bounds[index, 0 if ny > 0.0 else 1, 1] - oy)
            least += nz * (objects.bounds[index, 0 if nz > 0.0 else 1, 2] - oz)
            outside = least > margin
        elif index >= pieces:
            ball = index - pieces
            centre = nx * (objects.spheres[ball, 0] - ox)
            centre += ny * (objects.spheres[ball, 1] - oy)
            centre += nz * (objects.spheres[ball, 2] - oz)
            outside = centre - objects.spheres[ball, 3] * math.sqrt(nx * nx + ny * ny + nz * nz) > margin
        else:
            outside = True
            for corner in range(objects.piece_start[index], objects.piece_start[index + 1]):
                distance = nx * (objects.corners[corner, 0] - ox)
                distance += ny * (objects.corners[corner, 1] - oy)
                distance += nz * (objects.corners[corner, 2] - oz)
                if not distance > margin:
                    outside = False
                    break
        if outside:
            return True
    return False


@njit(nogil=True, cache=True)
def _face(cells, axis, cell, origins, directions, ray):
    # t at which the ray leaves the cell along one axis.
    d = directions[ray, axis]
    if d > 0.0:
        return (cells.low[axis] + (cell + 1) * cells.size[axis] - origins[ray, axis]) / d
    if d < 0.0:
        return (cells.low[axis] + cell * cells.size[axis] - origins[ray, axis]) / d
    return math.inf


@njit(nogil=True, cache=True)
def walk(
    objects, cells, origins, directions, ray, far, skip, mode,
    mailbox, touched, current, first, last, planes, boxes, mailboxes, through, counts,
):  # fmt: skip
    """Walk one ray through the grid.  Returns (t, object), (inf, -1) for a miss.

    ``mode``: ``CLOSEST`` looks for the nearest crossing, ``ANY`` stops at the first found,
    ``TRANSMIT`` multiplies ``through`` (bands,) by the transmittances of all that is crossed.

    ``mailbox`` holds the rayID of each object; this ray is ``current``.  ``planes`` (j, 4), normals
    that point outward and margins, switch the plane-vertex check on: an object seen for the first
    time since ray ``first`` that lies outside one of them gets the id ``last`` and is not tested
    until then.  ``touched`` is the instrument's own: the last ray that met the object at all, which
    tells a test avoided from a second meeting with the same ray.
    """
    frame = ray_frame(directions, ray)
    near, limit = ray_limits(objects, origins, directions, ray, far, frame[2])
    pieces = objects.piece_start.shape[0] - 1
    counts[_RAYS] += 1
    best, best_index = math.inf, -1
    enter, leave = 0.0, limit
    for k in range(3):
        d = directions[ray, k]
        if d == 0.0:
            if not cells.low[k] <= origins[ray, k] <= cells.high[k]:
                return best, best_index
        else:
            t1, t2 = (cells.low[k] - origins[ray, k]) / d, (cells.high[k] - origins[ray, k]) / d
            enter, leave = max(enter, min(t1, t2)), min(leave, max(t1, t2))
    if not enter <= leave or enter == math.inf:
        return best, best_index
    cx = math.floor((origins[ray, 0] + enter * directions[ray, 0] - cells.low[0]) / cells.size[0])
    cy = math.floor((origins[ray, 1] + enter * directions[ray, 1] - cells.low[1]) / cells.size[1])
    cz = math.floor((origins[ray, 2] + enter * directions[ray, 2] - cells.low[2]) / cells.size[2])
    nx, ny, nz = cells.resolution[0], cells.resolution[1], cells.resolution[2]
    cx, cy, cz = min(max(cx, 0), nx - 1), min(max(cy, 0), ny - 1), min(max(cz, 0), nz - 1)
    tx = _face(cells, 0, cx, origins, directions, ray)
    ty = _face(cells, 1, cy, origins, directions, ray)
    tz = _face(cells, 2, cz, origins, directions, ray)
    while True:
        counts[_VOXELS] += 1
        cell = (cx * ny + cy) * nz + cz
        for place in range(cells.start[cell], cells.start[cell + 1]):
            index = cells.items[place]
            owner = objects.owner[index]
            if owner == skip[ray, 0] or owner == skip[ray, 1]:
                continue
            if mailboxes:
                if mailbox[index] >= current:
                    if touched[index] == current:
                        counts[_SKIPS] += 1
                    else:
                        touched[index] = current
                        counts[_AVOIDED] += 1
                    continue
                if planes.shape[0] > 0 and mailbox[index] < first:
                    counts[_CHECKS] += 1
                    if _outside_a_plane(objects, index, origins, ray, planes, boxes):
                        counts[_CULLS] += 1
                        counts[_AVOIDED] += 1
                        mailbox[index] = last
                        touched[index] = current
                        continue
                mailbox[index] = current
                touched[index] = current
            counts[_POLYGONS if index < pieces else _SPHERES] += 1
            opaque = mode != TRANSMIT or not objects.clear[index].any()
            t, crossings = object_crossing(objects, index, origins, directions, ray, frame, near, limit, not opaque)
            if crossings == 0:
                continue
            if mode == TRANSMIT:
                for band in range(through.shape[0]):
                    through[band] *= objects.clear[index, band] ** crossings
            # A hit in a voxel further on is kept until the walk has passed it: the object will
            # not be tested again.  The lower index wins a tie, as in brute force.
            if t < best or (t == best and index < best_index):
                best, best_index = t, index
            if mode == ANY or (mode == TRANSMIT and opaque):
                counts[_HIT] += 1
                return best, best_index
        exit_t = min(tx, ty, tz)
        if exit_t >= leave or (mode == CLOSEST and best <= exit_t):
            break
        if tx == exit_t:
            cx += 1 if directions[ray, 0] > 0.0 else -1
            if cx < 0 or cx >= nx:
                break
            tx = _face(cells, 0, cx, origins, directions, ray)
        elif ty == exit_t:
            cy += 1 if directions[ray, 1] > 0.0 else -1
            if cy < 0 or cy >= ny:
                break
            ty = _face(cells, 1, cy, origins, directions, ray)
        else:
            cz += 1 if directions[ray, 2] > 0.0 else -1
            if cz < 0 or cz >= nz:
                break
            tz = _face(cells, 2, cz, origins, directions, ray)
    counts[_HIT] += best_index >= 0
    return best, best_index


@njit(nogil=True, cache=True)
def _trace(
    objects, cells, origins, directions, far, skip, mode, mailbox, current, id_limit, mailboxes,
    planes, t, polygon, through, counts,
):  # fmt: skip
    # Independent rays, one id each; returns the next id.
    for ray in range(origins.shape[0]):
        if current >= id_limit:
            mailbox[:] = 0
            current = 1
        t[ray], index = walk(
            objects, cells, origins, directions, ray, far[ray], skip, mode,
            mailbox, mailbox, current, current, current, planes, False, mailboxes, through[ray], counts,
        )  # fmt: skip
        polygon[ray] = objects.owner[index] if index >= 0 else NO_POLYGON
        current += 1
    return current


class RayIDs:
    """The rayIDs of one thread: a mailbox an object and the id of the next ray.

    Ids are 64-bit and only grow.  A counter about to pass ``limit`` clears the mailboxes and
    begins again at 1: ids from before would all look newer than the rays to come.

    Parameters
    ----------
    objects : int
        Number of objects of the grid.
    first : int
        Id of the first ray, at least 1.
    limit : int
        Largest id.

    Raises
    ------
    InputError
        If not ``1 <= first <= limit <= RAY_ID_LIMIT``.
    """

    def __init__(self, objects: int, first: int = 1, limit: int = RAY_ID_LIMIT) -> None:
        if not 1 <= first <= limit <= RAY_ID_LIMIT:
            raise InputError(f"RayIDs: found first={first}, limit={limit}, expected 1 <= first <= limit < 2^63")
        self.mailbox = np.zeros(objects, dtype=np.int64)
        self.touched = np.zeros(objects, dtype=np.int64)
        self.current = first
        self.limit = limit


def blocks(count: int, worker: int, workers: int) -> Iterator[slice]:
    """The blocks of ``count`` rows that fall to one worker."""
    for start in range(worker * BLOCK, count, workers * BLOCK):
        yield slice(start, min(start + BLOCK, count))


def share_out(workers: int, work: Callable[[int], NDArray[np.int64]]) -> NDArray[np.int64]:
    """Run ``work(worker)`` for each worker on its own thread and add up the counts it returns.

    Raises
    ------
    InputError
        If ``workers`` is less than 1.
    """
    if workers < 1:
        raise InputError(f"workers: found {workers}, expected 1 or more")
    if workers == 1:
        return work(0)
    with ThreadPoolExecutor(workers) as pool:
        return np.sum(list(pool.map(work, range(workers))), axis=0)


class VoxelGrid:
    """A uniform grid over the convex pieces of a geometry and, if wanted, exact spheres.

    Parameters
    ----------
    geometry : Geometry
    spheres : (s, 4) float, optional
        Exact opaque spheres (centre, radius), numbered on from the last polygon.
    resolution : int or three ints, optional
        Voxels along each axis.  By default cubes, about four an object (cf. J. Cleary and G. Wyvill,
        "Analysis of an algorithm for fast ray tracing using uniform space subdivision", 1988: the
        number of voxels grows with that of objects), at most 256 along an axis.
    bounds : (2, 3) float, optional
        Corners of the grid, which must hold all objects with the margin to spare; by default
        their bounding box, a little widened.
    mailboxes : bool
        Whether rayIDs keep a polygon from being tested twice by one ray.
    workers : int
        Threads.  Answers and counts do not depend on it.

    Raises
    ------
    InputError
        If an argument is out of its range.
    """

    name = "voxel-grid"

    def __init__(
        self,
        geometry: Geometry,
        *,
        spheres: ArrayLike | None = None,
        resolution: int | tuple[int, int, int] | None = None,
        bounds: ArrayLike | None = None,
        mailboxes: bool = True,
        workers: int = 1,
    ) -> None:
        self.geometry = geometry
        self.objects: Objects = objects_of(geometry, spheres)
        self.mailboxes = mailboxes
        self.workers = workers
        self.counters = Counters()
        self.cells, self.margin = self._build(resolution, bounds)

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Voxels along x, y and z."""
        x, y, z = self.cells.resolution.tolist()
        return x, y, z

    @property
    def object_count(self) -> int:
        """Number of convex pieces and spheres."""
        return len(self.objects.owner)

    @property
    def bands(self) -> int:
        """Number of bands of the transmittances."""
        return self.objects.clear.shape[1]

    def _build(self, resolution, bounds) -> tuple[Cells, FloatArray]:
        boxes = self.objects.bounds
        low = boxes[:, 0].min(axis=0) if len(boxes) else np.full(3, 0.5)
        high = boxes[:, 1].max(axis=0) if len(boxes) else np.full(3, 0.5)
        box = None
        if bounds is not None:
            box = np.asarray(bounds)
            if (
                box.dtype.kind not in "iuf"
                or box.shape != (2, 3)
                or not np.isfinite(box).all()
                or not (box[0] < box[1]).all()
            ):
                raise InputError(f"bounds: found {bounds!r}, expected a lower and an upper corner")
        size = high - low if box is None else box[1] - box[0]
        # A flat scene still needs voxels with a volume.
        size = np.maximum(size, 1e-3 * (size.max() or 1.0))
        if resolution is None:
            edge = (size.prod() / (_CELLS_PER_OBJECT * max(len(boxes), 1))) ** (1.0 / 3.0)
            counts = np.clip(np.rint(size / edge), 1, _MAX_RESOLUTION)
        else:
            counts = np.asarray(resolution)
            if counts.shape == ():
                counts = np.full(3, counts)
            whole = counts.shape == (3,) and np.issubdtype(counts.dtype, np.integer)
            if not whole or (counts < 1).any() or counts.prod() > _MAX_CELLS:
                raise InputError(
                    f"resolution: found {resolution!r}, expected 1 or more along each axis, at most 2^24 voxels in all"
                )
        counts = counts.astype(np.int64)
        margin = 2.0**-12 * size / counts + 2.0**-22 * np.linalg.norm(size)
        if box is None:
            middle, half = 0.5 * (low + high), 0.5 * size + 2.0 * margin
            low, high = middle - half, middle + half
        elif (box[0] > low - margin).any() or (box[1] < high + margin).any():
            raise InputError(
                f"bounds: found {box.tolist()}, expected a box round {low.tolist()} to {high.tolist()} "
                f"with {margin.max():.3g} to spare"
            )
        else:
            low, high = box.astype(np.float64)
        cell = (high - low) / counts
        cursor = np.zeros(int(counts.prod()), dtype=np.int64)
        empty = np.empty(0, dtype=np.int64)
        shape = Cells(np.ascontiguousarray(low), np.ascontiguousarray(high), cell, counts, empty, empty)
        normals = np.ascontiguousarray(self.geometry.piece_normal)
        _fill(self.objects, normals, shape, margin, cursor, empty, False)
        start = np.concatenate([[0], np.cumsum(cursor)]).astype(np.int64)
        items = np.empty(start[-1], dtype=np.int64)
        _fill(self.objects, normals, shape, margin, start[:-1].copy(), items, True)
        return shape._replace(start=start, items=items), margin

    def check_origins(self, origins: FloatArray) -> None:
        """Refuse origins so far off that their rounding exceeds the grid's margin.

        Raises
        ------
        InputError
            If an origin lies some 10^9 voxels from the grid or more.
        """
        if len(origins) == 0:
            return
        far = np.abs(origins).max(axis=0) + np.abs(self.cells.low) + np.abs(self.cells.high)
        if 16.0 * np.finfo(float).eps * far.max() > self.margin.min():
            raise InputError(
                f"origins: found coordinates up to {far.max():.3g}, expected less than "
                f"{self.margin.min() / (16.0 * np.finfo(float).eps):.3g} for this grid; move the scene to the origin"
            )

    def _ask(self, origins, directions, far, skip_polygons, mode) -> tuple[Hits, FloatArray]:
        rays = as_rays(origins, directions, far, skip_polygons)
        self.check_origins(rays.origins)
        count = len(rays)
        hits = Hits(np.empty(count), np.empty(count, dtype=np.int64))
        through = np.ones((count, self.bands if mode == TRANSMIT else 0))
        no_planes = np.empty((0, 4))

        def work(worker: int) -> NDArray[np.int64]:
            ids = RayIDs(self.object_count)
            counts = np.zeros(len(COUNTED), dtype=np.int64)
            for rows in blocks(count, worker, self.workers):
                ids.current = _trace(
                    self.objects, self.cells, rays.origins[rows], rays.directions[rows], rays.far[rows],
                    rays.skip_polygons[rows], mode, ids.mailbox, ids.current, ids.limit,
                    self.mailboxes or mode == TRANSMIT, no_planes,
                    hits.t[rows], hits.polygon[rows], through[rows], counts,
                )  # fmt: skip
            return counts

        self.counters.add(**dict(zip(COUNTED, share_out(self.workers, work), strict=True)))
        return hits, through

    def closest_hit(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        far: float | ArrayLike = np.inf,
        skip_polygons: ArrayLike | None = None,
    ) -> Hits:
        """First crossing of each ray; see :class:`workbench.accel.base.Accelerator`."""
        return self._ask(origins, directions, far, skip_polygons, CLOSEST)[0]

    def occluded(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        far: float | ArrayLike = 1.0,
        skip_polygons: ArrayLike | None = None,
    ) -> NDArray[np.bool_]:
        """Whether anything lies along each ray; see :class:`workbench.accel.base.Accelerator`."""
        return self._ask(origins, directions, far, skip_polygons, ANY)[0].polygon != NO_POLYGON

    def transmitted(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        far: float | ArrayLike = 1.0,
        skip_polygons: ArrayLike | None = None,
    ) -> FloatArray:
        """Share of light that passes along each ray, (n, bands): the product of transmittances.

        Each crossing of a surface counts once, also on an edge that two of its polygons share; a
        folded sheet counts at each of its layers.  Equal to brute force's up to the order in which
        the factors are multiplied.
        """
        return self._ask(origins, directions, far, skip_polygons, TRANSMIT)[1]
