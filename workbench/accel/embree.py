"""Embree (through embreex) behind the interface of every accelerator: the engine of solves.

Embree works in float32.  The scene is moved to the origin and scaled to unit size before the tree
is built and so are the rays, which keeps relative precision at about 1e-6 of the scene's size
wherever the scene lies.  Embree's near limit is fixed at 0, and a polygon cannot be skipped by
identity, so rays that start or end *on* a surface must be moved off it by the caller:
:attr:`EmbreeAccelerator.offset` is the distance to use.
"""

from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.accel.base import NO_POLYGON, Hits, as_rays
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
        unit = np.ascontiguousarray((triangles - self._centre) * self._scale, dtype=np.float32)
        if len(unit):
            self._mesh = TriangleMesh(self._scene, unit)
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
            limit = np.minimum(rays.far[block], 1e30).astype(np.float32)
            result = self._scene.run(start, along, dists=limit, output=True)
            hit = np.asarray(result["primID"]) >= 0
            reach = np.asarray(result["tfar"], dtype=np.float64)
            t[block] = np.where(hit, reach, np.inf)
            polygon[block] = np.where(hit, self._polygon[np.maximum(result["primID"], 0)], NO_POLYGON)

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
        return np.asarray(self._scene.run(origins, directions, dists=far, query="OCCLUDED"))

    def nearest_raw(self, origins: NDArray, directions: NDArray) -> NDArray[np.int64]:
        """First polygon (n,) along rays made in unit coordinates as float32, -1 for none.

        For callers that intersect the polygon again in double precision; counts nothing.
        """
        if len(self._polygon) == 0:
            return np.full(len(origins), NO_POLYGON, dtype=np.int64)
        triangle = np.asarray(self._scene.run(origins, directions, query="INTERSECT"))
        return np.where(triangle >= 0, self._polygon[triangle], NO_POLYGON)
