"""Embree (through embreex) behind the interface of every accelerator: the engine of solves.

Embree works in float32.  The scene is moved to the origin and scaled to unit size before the tree
is built and so are the rays, which keeps relative precision at about 1e-6 of the scene's size
wherever the scene lies.  Embree's near limit is fixed at 0, and a polygon cannot be skipped by
identity, so rays that start or end *on* a surface must be moved off it by the caller:
:attr:`EmbreeAccelerator.offset` is the distance to use.

Near the plane of a triangle, and of a sliver even far from it, single precision reports hits where there
are none, and at distances that are off by more than the triangle's size (embree issues 387 and 423).  Such
hits are looked at again in double precision: see :data:`DOUBTFUL`.
"""

from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from workbench.accel.base import NO_POLYGON, Hits, as_rays
from workbench.accel.box_tree import BoxTree
from workbench.counters import Counters
from workbench.errors import InputError
from workbench.geometry.flat import Geometry

__all__ = ["BLOCK_RAYS", "EmbreeAccelerator"]

BLOCK_RAYS = 32768
"""Rays a block: small enough to stay in cache, large enough to hide the call."""

OFFSET = 5e-7
"""Distance by which ends of rays are moved off surfaces, as a share of the scene's size.

What lies nearer to a surface than that does not shadow it.  From 6e-8 down rays begin to hit the
surface that they leave (of 200 tilted triangles, once in 100,000)."""

DOUBTFUL = 3e-3
"""A hit is looked at again where the sine of the ray's angle to the triangle, times the triangle's height over its
longest side, is less: its distance is off by some 1e-7 over that."""
THIN = 1e-3
"""Triangles of less height, as a share of their longest side, make shadow rays doubtful too."""
ON = 1e-6
"""What lies this share of its longest side outside a triangle is still on it: edges that are shared do not leak."""


@njit(nogil=True, cache=True)
def _doubtful(triangle, normals, directions, longest, out):
    """Which rays hit a triangle (their number in ``triangle``, below zero for none) so that it is to be doubted.

    ``normals`` (n, 3) are as long as twice the triangles' areas, ``longest`` their longest sides squared.  Returns
    whether any is.
    """
    some = False
    for i in range(triangle.shape[0]):
        out[i] = False
        if triangle[i] >= 0:
            x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
            volume = abs(normals[i, 0] * x + normals[i, 1] * y + normals[i, 2] * z)
            least = DOUBTFUL * longest[triangle[i]]
            out[i] = volume * volume < least * least * (x * x + y * y + z * z)
            some = some or out[i]
    return some


@njit(nogil=True, cache=True)
def _crossing(origin, direction, triangle):
    """Where a ray crosses a triangle or its rim, in double precision; infinite for a miss or a ray in its plane."""
    a, b, c = triangle[0], triangle[1], triangle[2]
    u, v = b - a, c - a
    normal = np.cross(u, v)
    facing = normal @ direction
    square = normal @ normal
    if facing == 0.0 or square == 0.0:
        return np.inf
    t = (normal @ (a - origin)) / facing
    if t < 0.0:
        return np.inf
    at = origin + t * direction
    longest = np.sqrt(max(u @ u, v @ v, (v - u) @ (v - u)))
    # Nor does the rim of a sliver reach far beyond its tips.
    rim = min(ON * longest, 1e3 * ON * np.sqrt(square) / longest)
    for start, along in ((a, u), (b, c - b), (c, a - c)):
        # Distance to the inner side of an edge.
        if np.cross(along, at - start) @ normal < -rim * np.sqrt((along @ along) * square):
            return np.inf
    return t


@njit(nogil=True, cache=True)
def _misses_box(origin, direction, low, high, far):
    """Whether a ray misses a box, widened by what is still on a triangle's rim, up to ``far``."""
    enter, leave = 0.0, far
    for axis in range(3):
        bottom, top = low[axis] - 2.0 * ON - origin[axis], high[axis] + 2.0 * ON - origin[axis]
        if direction[axis] == 0.0:
            if bottom > 0.0 or top < 0.0:
                return True
            continue
        near, beyond = bottom / direction[axis], top / direction[axis]
        enter, leave = max(enter, min(near, beyond)), min(leave, max(near, beyond))
    return enter > leave


@njit(nogil=True, cache=True)
def _look_again(rows, origins, directions, limit, triangles, tree, triangle, reach):
    """Trace some rays anew in double precision, through a tree of boxes."""
    low, high, skip, head, leaf, order = tree
    for i in rows:
        first, who = limit[i], -1
        node = 0
        while node < low.shape[0]:
            if _misses_box(origins[i], directions[i], low[node], high[node], first):
                node = skip[node]
                continue
            for k in range(head[node], head[node] + leaf[node]):
                t = _crossing(origins[i], directions[i], triangles[order[k]])
                if t <= first and (t < first or who < 0):
                    first, who = t, order[k]
            node += 1
        triangle[i], reach[i] = who, first if who >= 0 else np.inf


class EmbreeAccelerator:
    """Closest-hit and occlusion queries by Embree over a geometry's triangles.

    Parameters
    ----------
    geometry : Geometry
    workers : int
        Threads over which blocks of rays are spread; the answer does not depend on it.
    """

    name = "embree"

    def __init__(self, geometry: Geometry, workers: int = 1) -> None:
        logging.getLogger("embreex").setLevel(logging.ERROR)
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.counters = Counters()
        self.workers = workers
        triangles, piece = geometry.triangles
        self._polygon = geometry.piece_polygon[piece]
        self._centre = geometry.bounds.mean(axis=0)
        self._scale = 1.0 / geometry.size
        self.offset = OFFSET * geometry.size
        self._scene = EmbreeScene()
        self._triangles = np.ascontiguousarray((triangles - self._centre) * self._scale)
        side = np.roll(self._triangles, -1, axis=1) - self._triangles
        longest = np.einsum("tij,tij->ti", side, side).max(axis=1, initial=0.0)
        twice = np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=1)
        self._longest = longest.astype(np.float32)
        self._slivers = bool((twice < THIN * longest).any())
        if len(self._triangles):
            self._mesh = TriangleMesh(self._scene, self._triangles.astype(np.float32))
            # The first query builds the tree; do it here, before threads share the scene.
            self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def _unit(self, origins: NDArray, directions: NDArray) -> tuple[NDArray, NDArray]:
        start = ((origins - self._centre) * self._scale).astype(np.float32)
        return start, (directions * self._scale).astype(np.float32)

    def _blocks(self, count: int) -> list[slice]:
        return [slice(i, min(i + BLOCK_RAYS, count)) for i in range(0, count, BLOCK_RAYS)]

    def _run(self, work, count: int) -> None:
        blocks = self._blocks(count)
        if self.workers > 1 and len(blocks) > 1:
            with ThreadPoolExecutor(self.workers) as pool:
                list(pool.map(work, blocks))
        else:
            for block in blocks:
                work(block)

    @staticmethod
    def _refuse_skips(skip_polygons: ArrayLike | None) -> None:
        if skip_polygons is not None and (np.asarray(skip_polygons) != NO_POLYGON).any():
            raise InputError(
                "skip_polygons: embree cannot skip polygons by identity; move the rays' ends off the surface"
                " by EmbreeAccelerator.offset, or use the brute or voxel accelerator"
            )

    def closest_hit(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        far: float | ArrayLike = np.inf,
        skip_polygons: ArrayLike | None = None,
    ) -> Hits:
        """First crossing of each ray, see :class:`workbench.accel.base.Accelerator`.

        Raises
        ------
        InputError
            If ``skip_polygons`` names a polygon.
        """
        self._refuse_skips(skip_polygons)
        rays = as_rays(origins, directions, far, None)
        t = np.full(len(rays), np.inf)
        polygon = np.full(len(rays), NO_POLYGON, dtype=np.int64)

        def work(block: slice) -> None:
            start, along = self._unit(rays.origins[block], rays.directions[block])
            limit = np.minimum(rays.far[block], 1e30)
            triangle, reach, doubt = self._first(start, along, limit)
            if doubt is not None:
                begin = (rays.origins[block] - self._centre) * self._scale
                along = rays.directions[block] * self._scale
                _look_again(doubt, begin, along, limit, self._triangles, self._boxes, triangle, reach)
            t[block] = reach
            polygon[block] = np.where(triangle >= 0, self._polygon[np.maximum(triangle, 0)], NO_POLYGON)

        if len(self._polygon):
            self._run(work, len(rays))
        self.counters.add(rays=len(rays), rays_hit=int((polygon >= 0).sum()))
        return Hits(t, polygon)

    def occluded(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        far: float | ArrayLike = 1.0,
        skip_polygons: ArrayLike | None = None,
    ) -> NDArray[np.bool_]:
        """Whether anything lies along each ray, see :class:`workbench.accel.base.Accelerator`.

        Raises
        ------
        InputError
            If ``skip_polygons`` names a polygon.
        """
        self._refuse_skips(skip_polygons)
        rays = as_rays(origins, directions, far, None)
        blocked = np.zeros(len(rays), dtype=bool)

        def work(block: slice) -> None:
            start, along = self._unit(rays.origins[block], rays.directions[block])
            blocked[block] = self.blocked_raw(start, along, rays.far[block].astype(np.float32)) == 0

        if len(self._polygon):
            self._run(work, len(rays))
        self.counters.add(rays=len(rays), rays_hit=int(blocked.sum()))
        return blocked

    def _first(self, start: NDArray, along: NDArray, limit: NDArray) -> tuple[NDArray, NDArray, NDArray | None]:
        """Embree's first triangle (n,), -1 for none, along rays in unit coordinates, its distance, doubtful rows."""
        result = self._scene.run(start, along, dists=limit.astype(np.float32), output=True)
        triangle = np.asarray(result["primID"])
        reach = np.where(triangle >= 0, np.asarray(result["tfar"], dtype=np.float64), np.inf)
        doubt = np.empty(len(triangle), dtype=bool)
        some = _doubtful(triangle, np.asarray(result["Ng"]), along, self._longest, doubt)
        return triangle, reach, np.flatnonzero(doubt) if some else None

    @cached_property
    def _boxes(self) -> tuple[NDArray, ...]:
        """A tree of boxes over the triangles in unit coordinates."""
        tree = BoxTree.over(np.stack([self._triangles.min(axis=1), self._triangles.max(axis=1)], axis=1))
        return tree.low, tree.high, tree.skip, tree.first, tree.count, tree.order

    @property
    def frame(self) -> tuple[NDArray[np.float64], float]:
        """Centre (3,) and scale that take scene coordinates to Embree's unit ones."""
        return self._centre, self._scale

    def blocked_raw(self, origins: NDArray, directions: NDArray, far: NDArray) -> NDArray[np.int32]:
        """Embree's own answer for rays made in unit coordinates as float32: 0 blocked, -1 clear.

        For kernels, which keep their own counts.  ``far`` (n,) float32 is overwritten by Embree.
        """
        if len(self._polygon) == 0:
            return np.full(len(origins), -1, dtype=np.int32)
        limit = far.astype(np.float64) if self._slivers else None
        answer = np.asarray(self._scene.run(origins, directions, dists=far, query="OCCLUDED"))
        if limit is not None:
            rows = np.flatnonzero(answer == 0)
            triangle, reach, doubt = self._first(origins[rows], directions[rows], np.minimum(limit[rows], 1e30))
            if doubt is not None:
                begin, along = origins[rows].astype(np.float64), directions[rows].astype(np.float64)
                _look_again(doubt, begin, along, limit[rows], self._triangles, self._boxes, triangle, reach)
                answer[rows[doubt[triangle[doubt] < 0]]] = -1
        return answer

    def nearest_raw(self, origins: NDArray, directions: NDArray) -> NDArray[np.int64]:
        """First polygon (n,) along rays made in unit coordinates as float32, -1 for none.

        For callers that intersect the polygon again in double precision; counts nothing.
        """
        if len(self._polygon) == 0:
            return np.full(len(origins), NO_POLYGON, dtype=np.int64)
        triangle = np.asarray(self._scene.run(origins, directions, query="INTERSECT"))
        return np.where(triangle >= 0, self._polygon[triangle], NO_POLYGON)

    def first_raw(self, origins: NDArray, directions: NDArray) -> NDArray[np.int64]:
        """As :meth:`nearest_raw`; doubtful hits are looked at again in double precision, as by :meth:`closest_hit`."""
        if len(self._polygon) == 0:
            return np.full(len(origins), NO_POLYGON, dtype=np.int64)
        limit = np.full(len(origins), 1e30)
        triangle, reach, doubt = self._first(origins, directions, limit)
        if doubt is not None:
            begin, along = origins.astype(np.float64), directions.astype(np.float64)
            _look_again(doubt, begin, along, limit, self._triangles, self._boxes, triangle, reach)
        return np.where(triangle >= 0, self._polygon[triangle], NO_POLYGON)
