"""Brute force: every ray against every polygon, in double precision; the judge of all else."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from workbench.accel._intersect import object_crossing, objects_of, ray_frame, ray_limits
from workbench.accel.base import NO_POLYGON, Hits, as_rays
from workbench.counters import Counters
from workbench.geometry.flat import Geometry

__all__ = ["BruteForce"]


@njit(nogil=True, cache=True)
def _trace(objects, origins, directions, far, skip, any_hit, t, polygon, counts):
    pieces = objects.piece_start.shape[0] - 1
    for ray in range(origins.shape[0]):
        frame = ray_frame(directions, ray)
        near, limit = ray_limits(objects, origins, directions, ray, far[ray], frame[2])
        t[ray] = math.inf
        polygon[ray] = NO_POLYGON
        for index in range(objects.owner.shape[0]):
            owner = objects.owner[index]
            if owner == skip[ray, 0] or owner == skip[ray, 1]:
                continue
            counts[0 if index < pieces else 1] += 1
            hit, _ = object_crossing(objects, index, origins, directions, ray, frame, near, limit, False)
            if hit < t[ray]:
                t[ray] = hit
                polygon[ray] = owner
                if any_hit:
                    break
        if polygon[ray] != NO_POLYGON:
            counts[2] += 1


@njit(nogil=True, cache=True)
def _transmit(objects, origins, directions, far, skip, through, counts):
    pieces = objects.piece_start.shape[0] - 1
    bands = through.shape[1]
    for ray in range(origins.shape[0]):
        frame = ray_frame(directions, ray)
        near, limit = ray_limits(objects, origins, directions, ray, far[ray], frame[2])
        through[ray] = 1.0
        met = False
        for index in range(objects.owner.shape[0]):
            owner = objects.owner[index]
            if owner == skip[ray, 0] or owner == skip[ray, 1]:
                continue
            counts[0 if index < pieces else 1] += 1
            opaque = not objects.clear[index].any()
            _, crossings = object_crossing(objects, index, origins, directions, ray, frame, near, limit, not opaque)
            if crossings == 0:
                continue
            met = True
            for band in range(bands):
                through[ray, band] *= objects.clear[index, band] ** crossings
            if opaque:
                break
        counts[2] += met


class BruteForce:
    """Tests each ray against each convex piece and sphere.

    Parameters
    ----------
    geometry : Geometry
    spheres : (s, 4) float, optional
        Exact opaque spheres (centre, radius), numbered on from the last polygon.

    Raises
    ------
    InputError
        If ``spheres`` is not such an array.
    """

    name = "brute"

    def __init__(self, geometry: Geometry, *, spheres: ArrayLike | None = None) -> None:
        self._objects = objects_of(geometry, spheres)
        self.counters = Counters()

    def _count(self, rays: int, counts: NDArray[np.int64]) -> None:
        self.counters.add(rays=rays, polygon_tests=counts[0], sphere_tests=counts[1], rays_hit=counts[2])

    def _ask(self, origins, directions, far, skip_polygons, any_hit):
        rays = as_rays(origins, directions, far, skip_polygons)
        hits = Hits(np.empty(len(rays)), np.empty(len(rays), dtype=np.int64))
        counts = np.zeros(3, dtype=np.int64)
        _trace(
            self._objects, rays.origins, rays.directions, rays.far, rays.skip_polygons, any_hit,
            hits.t, hits.polygon, counts,
        )  # fmt: skip
        self._count(len(rays), counts)
        return hits

    def closest_hit(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        far: float | ArrayLike = np.inf,
        skip_polygons: ArrayLike | None = None,
    ) -> Hits:
        """First crossing of each ray; see :class:`workbench.accel.base.Accelerator`."""
        return self._ask(origins, directions, far, skip_polygons, False)

    def occluded(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        far: float | ArrayLike = 1.0,
        skip_polygons: ArrayLike | None = None,
    ) -> NDArray[np.bool_]:
        """Whether anything lies along each ray; see :class:`workbench.accel.base.Accelerator`."""
        return self._ask(origins, directions, far, skip_polygons, True).polygon != NO_POLYGON

    def transmitted(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        far: float | ArrayLike = 1.0,
        skip_polygons: ArrayLike | None = None,
    ) -> NDArray[np.float64]:
        """Share of light that passes along each ray, (n, bands): the product of transmittances.

        Each crossing of a surface counts once, also on an edge that two of its polygons share; a
        folded sheet counts at each fold's two sides.
        """
        rays = as_rays(origins, directions, far, skip_polygons)
        through = np.empty((len(rays), self._objects.clear.shape[1]))
        counts = np.zeros(3, dtype=np.int64)
        _transmit(self._objects, rays.origins, rays.directions, rays.far, rays.skip_polygons, through, counts)
        self._count(len(rays), counts)
        return through
