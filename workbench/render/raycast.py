"""Ray casting: one ray through each pixel centre, shaded where it first meets a surface.

The assignment's program (CMU 15-463, P2, spring 1996) without its command line, which is
:mod:`workbench.render.raycast_cli`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.accel.base import Hits
from workbench.accel.group_volumes import GroupVolumes
from workbench.arrays import as_count, as_points, as_unit_vectors
from workbench.counters import Counters
from workbench.errors import OptionError
from workbench.geometry.flat import Geometry
from workbench.memory import require_memory
from workbench.render.camera import PinholeRays
from workbench.render.shading import phong, turn_toward
from workbench.scene.model import Material, Scene, Surface
from workbench.scene.sc import ScPolygon, ScScene, ScSphere

__all__ = ["ACCELERATORS", "CastPicture", "RayCaster", "average_tests"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

ACCELERATORS = ("groups", "voxels", "embree")
"""The choices of accelerator."""

_BLOCK_RAYS = 8192
"""Rays of one block of rows: work for a thread that stays in its cache."""

_BLOCK_RAYS_OF_ALL = 131072
"""Rays of one block that an accelerator spreads over its own threads."""


@dataclass(frozen=True)
class CastPicture:
    """A picture before rounding.

    Parameters
    ----------
    radiance : (h, w, 3) float
    primitive : (h, w) int
        Index of the primitive seen, -1 where the background is.
    counters : Counters
        Rays, hits and intersection tests by kind.
    """

    radiance: FloatArray
    primitive: IntArray
    counters: Counters


def average_tests(counters: Counters) -> dict[str, float]:
    """Average number of intersection tests per ray: spheres, polygons, the two bounding volumes, sum."""
    rays = max(counters["rays"], 1)
    found = {
        "spheres": counters["sphere_tests"] / rays,
        "polygons": counters["polygon_tests"] / rays,
        "bounding_spheres": counters["bounding_sphere_tests"] / rays,
        "bounding_boxes": counters["box_tests"] / rays,
    }
    return found | {"sum": sum(found.values())}


class _Voxels:
    """The voxel grid over the polygons and exact spheres of a scene, in primitive indices."""

    own_threads = True

    def __init__(self, scene: ScScene, workers: int) -> None:
        from workbench.accel.voxel_grid import VoxelGrid

        spheres = [(*p.center, p.radius) for p in scene.primitives if isinstance(p, ScSphere)]
        geometry, polygons = _polygon_geometry(scene)
        others = np.setdiff1d(np.arange(len(scene.primitives)), polygons)
        # Index -1, nothing, comes out as -1 too.
        self._primitive = np.concatenate([polygons, others, [-1]])
        self._grid = VoxelGrid(geometry, spheres=np.asarray(spheres).reshape(-1, 4), workers=workers)

    def closest_hit_counted(self, origins: FloatArray, directions: FloatArray) -> tuple[Hits, Counters]:
        before = dict(self._grid.counters)
        hits = self._grid.closest_hit(origins, directions)
        counts = {name: count - before.get(name, 0) for name, count in self._grid.counters.items()}
        return Hits(hits.t, self._primitive[hits.polygon]), Counters(**counts)


class _Embree:
    """Embree for the polygons, the groups for the spheres, with hits in double precision.

    Embree sees each polygon a little larger than it is, more than its float32 can err, and its
    answer is tried in double precision.  Rays that met only the margin of a polygon go to the
    groups.  So the picture is that of the other accelerators, at Embree's speed nearly everywhere.
    """

    own_threads = True

    def __init__(self, scene: ScScene, groups: GroupVolumes, workers: int) -> None:
        from workbench.accel.embree import OFFSET, EmbreeAccelerator

        geometry, polygons = _polygon_geometry(scene)
        self._primitive = np.concatenate([polygons, [-1]])
        corners = geometry.corners.copy()
        for piece in range(geometry.piece_count):
            part = slice(geometry.piece_start[piece], geometry.piece_start[piece + 1])
            corners[part] = _grown(corners[part], geometry.piece_normal[piece], OFFSET * geometry.size)
        self._embree = EmbreeAccelerator(replace(geometry, corners=corners), workers)
        self._groups = groups
        self._spheres = GroupVolumes(scene, groups.volumes, primitives="spheres")

    def closest_hit_counted(self, origins: FloatArray, directions: FloatArray) -> tuple[Hits, Counters]:
        origins = np.broadcast_to(origins, directions.shape)
        found = self._embree.closest_hit(origins, directions)
        hit = np.flatnonzero(found.polygon >= 0)
        t, primitive = np.full(len(directions), np.inf), self._primitive[found.polygon]
        t[hit] = self._groups.meet_polygons(origins[hit], directions[hit], primitive[hit])
        doubtful = hit[np.isinf(t[hit])]
        spheres, _ = self._spheres.closest_hit_counted(origins, directions, t)
        nearer = spheres.polygon >= 0
        t[nearer], primitive[nearer] = spheres.t[nearer], spheres.polygon[nearer]
        exact, _ = self._groups.closest_hit_counted(origins[doubtful], directions[doubtful])
        t[doubtful], primitive[doubtful] = exact.t, exact.polygon
        return Hits(t, primitive), Counters(rays=len(t), rays_hit=int((primitive >= 0).sum()))


def _check_extent(scene: ScScene, accelerator: str) -> None:
    """Refuse scenes whose extent is lost in the rounding of their coordinates: grids and Embree need one."""
    if not scene.primitives:
        return
    bounds = np.asarray(
        [
            (p.center - p.radius, p.center + p.radius)
            if isinstance(p, ScSphere)
            else (p.vertices.min(axis=0), p.vertices.max(axis=0))
            for p in scene.primitives
        ]
    )
    extent = float((bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0)).max())
    largest = float(np.abs(bounds).max())
    if not extent > max(1e-30, 1e-9 * largest):
        raise OptionError(
            f"accelerator: found a scene {extent:.3g} in size at coordinates up to {largest:.3g}, expected a larger "
            f"share of them for {accelerator!r}; use 'groups'"
        )


def _polygon_geometry(scene: ScScene) -> tuple[Geometry, IntArray]:
    """The polygons of a scene as flat geometry, and the primitive index of each."""
    polygons = np.asarray([i for i, p in enumerate(scene.primitives) if isinstance(p, ScPolygon)], dtype=np.int64)
    plain = Material("polygons", np.ones(3), np.zeros(3), np.zeros(3), 1.0, np.zeros(3))
    rings = [p.vertices for p in scene.primitives if isinstance(p, ScPolygon)]
    surface = Surface.from_polygons("polygons", plain, rings)
    return Geometry.from_scene(Scene("polygons", (surface,), path=scene.paths[-1])), polygons


def _grown(corners: FloatArray, normal: FloatArray, margin: float) -> FloatArray:
    """A convex polygon (n, 3) scaled about its centre so that each edge moves out by ``margin`` or more."""
    center = corners.mean(axis=0)
    edge = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(edge, axis=1)
    inward = np.einsum("ij,ij->i", np.cross(normal, edge), center - corners)
    distance = (inward[length > 0] / length[length > 0]).min()
    return center + (corners - center) * (1.0 + margin / max(distance, 1e-6 * margin))


class RayCaster:
    """A ``.sc`` scene ready to be cast.

    Parameters
    ----------
    scene : ScScene
    volumes : {"none", "bsphere", "bbox", "both"}
        Bounding volumes of the groups that are tested; the picture does not depend on it.
    accelerator : {"groups", "voxels", "embree"}
        What finds the first hit: the scene's groups, a voxel grid, or Embree for the polygons with
        hits made good in double precision.  Embree cannot tell surfaces nearer to each other than
        some 1e-6 of the scene's size, and does not count its tests.
    size : (int, int), optional
        Width and height instead of the scene's own; the vertical angle of view stays. [pixels]
    workers : int, optional
        Threads; all cores if not given.  Neither picture nor counts depend on it.

    Raises
    ------
    OptionError
        If a choice does not exist, a side or ``workers`` is less than 1, or the scene is so small for
        its coordinates that voxels and Embree cannot resolve it.
    """

    def __init__(
        self,
        scene: ScScene,
        *,
        volumes: str = "both",
        accelerator: str = "groups",
        size: tuple[int, int] | None = None,
        workers: int | None = None,
    ) -> None:
        if accelerator not in ACCELERATORS:
            raise OptionError(f"accelerator: found {accelerator!r}, expected one of {', '.join(ACCELERATORS)}")
        self.workers = as_count(workers, "workers") if workers is not None else os.cpu_count() or 1
        self.scene = scene
        self._groups = GroupVolumes(scene, volumes)
        self._accelerator: GroupVolumes | _Voxels | _Embree = self._groups
        if accelerator != "groups":
            _check_extent(scene, accelerator)
        if accelerator == "voxels":
            self._accelerator = _Voxels(scene, self.workers)
        elif accelerator == "embree":
            self._accelerator = _Embree(scene, self._groups, self.workers)
        width, height = size or (scene.width, scene.height)
        self.rays = PinholeRays.from_matrix(scene.world_to_eye, scene.fov_deg, width, height)
        self._material = np.asarray([p.material for p in scene.primitives], dtype=np.int64)
        materials = scene.materials
        self._diffuse = np.asarray([m.color * m.kdr for m in materials])
        self._specular = np.asarray([m.ksr for m in materials])
        self._exponent = np.asarray([m.e for m in materials])
        self._emission = np.asarray([m.emission for m in materials])
        self._light_positions = np.asarray([light.position for light in scene.lights]).reshape(-1, 3)
        self._light_radiances = np.asarray([light.radiance for light in scene.lights]).reshape(-1, 3)

    def trace(self, origins: ArrayLike, directions: ArrayLike) -> FloatArray:
        """Radiance (n, 3) seen along rays with ``origins`` and ``directions`` (n, 3).

        Raises
        ------
        InputError
            If a value is not finite or a direction has length 0.
        """
        origins, directions = as_points(origins, "origins"), as_unit_vectors(directions, "directions")
        hits, _ = self._accelerator.closest_hit_counted(origins, directions)
        return self._shade(origins, directions, hits)

    def _shade(self, origins: FloatArray, directions: FloatArray, hits: Hits) -> FloatArray:
        radiance = np.broadcast_to(self.scene.background, directions.shape).copy()
        hit = np.flatnonzero(hits.polygon >= 0)
        primitive, viewer = hits.polygon[hit], -directions[hit]
        points = np.broadcast_to(origins, directions.shape)[hit] - hits.t[hit, None] * viewer
        normals = self._groups.normals(points, primitive)
        material = self._material[primitive]
        radiance[hit] = phong(
            points,
            turn_toward(normals, viewer),
            viewer,
            self._diffuse[material],
            self._specular[material],
            self._exponent[material],
            self._emission[material],
            self._light_positions,
            self._light_radiances,
            self.scene.ambient,
        )
        return radiance

    def render(self, progress: Callable[[float], None] | None = None) -> CastPicture:
        """Cast one ray through each pixel centre.

        Parameters
        ----------
        progress : callable, optional
            Called now and then with the share of the picture that is done.

        Raises
        ------
        MemoryForecastError
            If the picture needs more memory than is free.
        """
        width, height = self.rays.width, self.rays.height
        # 24 bytes of radiance, 8 of primitive, 3 and some for the file.
        require_memory(40 * width * height, f"a picture of {width} x {height}", "ask for a smaller one")
        radiance = np.empty((height, width, 3))
        primitive = np.empty((height, width), dtype=np.int64)
        own_threads = getattr(self._accelerator, "own_threads", False)
        rows = max(1, (_BLOCK_RAYS_OF_ALL if own_threads else _BLOCK_RAYS) // width)
        origin = self.rays.eye[None]

        def block(first: int) -> Counters:
            end = min(first + rows, height)
            directions = self.rays.row_directions(first, end)
            hits, counters = self._accelerator.closest_hit_counted(origin, directions)
            radiance[first:end] = self._shade(origin, directions, hits).reshape(end - first, width, 3)
            primitive[first:end] = hits.polygon.reshape(end - first, width)
            return counters

        total = Counters()
        starts = range(0, height, rows)
        pool = ThreadPoolExecutor(max_workers=1 if own_threads else self.workers)
        try:
            for done, counters in enumerate(pool.map(block, starts), start=1):
                total.merge(counters)
                if progress is not None:
                    progress(done / len(starts))
        finally:
            pool.shutdown(cancel_futures=True)
        return CastPicture(radiance, primitive, total)
