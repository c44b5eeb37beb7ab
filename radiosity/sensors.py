"""Irradiance at points from a solution: solve coarse, gather fine.

Direct light (emitting surfaces, lights without surface) is found at each point through the shadow
module, exactly where it can be, and never read from the mesh.  Indirect light is gathered from the
radiosity that the solution's elements reflect: by hemisphere bundles of cosine-equal quasi-random
rays whose hits read the solution, or in closed form over all elements where they are few.
"""

from __future__ import annotations

import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radiosity._gather_kernels import RUNS, collect_hits, gather_rays, net_bits
from radiosity.element_lookup import ElementLookup, element_gradients
from radiosity.solvers.solution import Solution
from workbench.accel.embree import BLOCK_RAYS
from workbench.arrays import as_points, as_unit_vectors
from workbench.counters import Counters
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.shadow.lights import Sender, SphereLight, lights_of_scene
from workbench.shadow.occlusion import Shader

__all__ = ["Gatherer", "IrradianceEstimate"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MOST_LIGHTS = 64
"""Emitting polygons of one surface that are each asked as a light; those of a larger mesh are gathered."""
PILOT_RAYS = 64
"""Rays a point by which the number of rays is chosen."""
MOST_RAYS = 65536
"""Most rays a point."""
MOST_PANES = 8
"""Panes in a row that a ray goes through."""
NET_GAIN = 0.7
"""The four runs of a net are no better than their spread says, but the whole net is: by this (measured)."""
POOL = 4.0
"""Degrees of freedom for which the mean spread of all points counts in the error of one."""
DIRECT_SHARE = 0.5
"""Share of the wanted error that sampled direct light may take."""


@dataclass(frozen=True)
class IrradianceEstimate:
    """Irradiance at n points.

    Parameters
    ----------
    irradiance, direct, indirect : (n, bands) float
        All light that arrives, the part straight from emitters, and the part that was reflected
        before. [W m-2]
    standard_error : (n, bands) float
        Of the irradiance: what sampling leaves, not what is wrong with the solution. [W m-2]
    distance : (n,) float
        Harmonic mean distance of what the indirect light comes from, infinite where nothing is
        seen: the scale on which it changes. [scene lengths]
    method : str
        How indirect light was gathered: ``"rays"`` or ``"none"`` (nothing is reflected).
    counters : Counters
    seconds : dict
        Wall-clock seconds by stage.
    """

    irradiance: FloatArray
    direct: FloatArray
    indirect: FloatArray
    standard_error: FloatArray
    distance: FloatArray
    method: str
    counters: Counters
    seconds: dict[str, float]


class Gatherer:
    """A solution made ready for many questions about the light at points.

    Parameters
    ----------
    solution : Solution
        With the scene that it was solved for.
    workers : int, optional
        Threads, all cores by default; the answers do not depend on it.
    seed : int
        Of the rays.

    Raises
    ------
    InputError
        If the solution has lost its scene, or its mesh is not of that scene.
    """

    def __init__(self, solution: Solution, *, workers: int | None = None, seed: int = 0) -> None:
        scene, mesh = solution.scene, solution.mesh
        if not scene.surfaces:
            raise InputError(
                f"{scene.name}: found a solution without its scene; its file was moved, so solve the scene again"
            )
        self.solution, self.seed = solution, seed
        self.geometry = Geometry.from_scene(scene)
        self.shader = Shader(self.geometry, workers)
        self.workers = self.shader.workers
        self.lookup = ElementLookup.build(self.geometry, mesh)
        gathered = {
            name
            for name, surface in enumerate(scene.surfaces)
            if surface.face_count > MOST_LIGHTS and surface.sphere is None
        }
        self.lights = tuple(self._lights(gathered))
        asked = ~np.isin(mesh.element_surface, list(gathered))
        # What rays read: reflected light, and the emission of meshes with too many facets to ask each.
        self.reflected = np.ascontiguousarray(solution.radiosity - np.where(asked[:, None], mesh.emission, 0.0))
        gradient = element_gradients(mesh, self.lookup, self.reflected)
        level = self.reflected - np.einsum("ebk,ek->eb", gradient, mesh.element_centroid)
        self._linear = np.ascontiguousarray(np.concatenate([gradient, level[..., None]], axis=2))
        first = self.geometry.piece_start[self.geometry.polygon_piece_start[:-1]]
        self._level = np.einsum("ij,ij->i", self.geometry.polygon_normal, self.geometry.corners[first])

    def _lights(self, gathered: set[int]) -> list[Sender]:
        lights = lights_of_scene(self.solution.scene, self.geometry)
        surface = self.geometry.polygon_surface
        return [
            light
            for light in lights
            if isinstance(light, SphereLight)
            or not len(light.polygons)
            or int(surface[light.polygons[0]]) not in gathered
        ]

    def irradiance(
        self,
        points: ArrayLike,
        normals: ArrayLike,
        *,
        own_polygon: ArrayLike | None = None,
        error: float = 0.01,
        rays: int | None = None,
    ) -> IrradianceEstimate:
        """Irradiance at points anywhere, on surfaces or in the air.

        Parameters
        ----------
        points : (n, 3) float
        normals : (n, 3) or (3,) float
            Of the receiving side, any length but zero.
        own_polygon : (n,) int or int, optional
            Polygon of the geometry on which each point lies, which never shadows it; -1 for none.
        error : float
            Wanted error: root mean square over the points, relative to their mean irradiance.
        rays : int, optional
            Rays a point for indirect light, instead of as many as ``error`` asks; a power of two of 8
            or more is best and the number is rounded up to one.

        Returns
        -------
        IrradianceEstimate

        Raises
        ------
        InputError, OptionError
            If an array has another shape or a number is out of range.
        """
        place, facing = as_points(points), as_unit_vectors(normals)
        if len(place) == 0:
            raise InputError("points: found none, expected one or more")
        if len(facing) == 1 and len(place) > 1:
            facing = np.repeat(facing, len(place), axis=0)
        if len(facing) != len(place):
            raise InputError(f"normals: found {len(facing)} rows for {len(place)} points")
        if not 0 < error < 1:
            raise OptionError(f"error: found {error}, expected a number between 0 and 1")
        if rays is not None and not 1 <= rays <= MOST_RAYS:
            raise OptionError(f"rays: found {rays}, expected 1 to {MOST_RAYS}")
        counters, seconds = Counters(), {}
        begin = time.perf_counter()
        direct, direct_error = self._direct(place, facing, own_polygon, error, counters)
        seconds["direct"] = time.perf_counter() - begin
        begin = time.perf_counter()
        method = "rays" if self.reflected.any() else "none"
        if method == "rays":
            indirect, doubt, distance = self._bundles(place, facing, direct, error, rays, counters)
        else:
            indirect, doubt = np.zeros_like(direct), np.zeros_like(direct)
            distance = np.full(len(place), math.inf)
        seconds["indirect"] = time.perf_counter() - begin
        return IrradianceEstimate(
            direct + indirect, direct, indirect, np.hypot(direct_error, doubt), distance, method, counters, seconds
        )

    # ---- direct light ---------------------------------------------------------------------------

    def _direct(
        self, points: FloatArray, normals: FloatArray, own: ArrayLike | None, error: float, counters: Counters
    ) -> tuple[FloatArray, FloatArray]:
        """Irradiance straight from the lights, and its standard error."""
        bands = self.reflected.shape[1]
        if not self.lights:
            return np.zeros((len(points), bands)), np.zeros((len(points), bands))
        found = self.shader.estimate(
            points, normals, self.lights, "auto", error=DIRECT_SHARE * error, seed=self.seed, own_polygon=own
        )
        counters.merge(found.counters)
        shape = (len(points), bands)
        return np.broadcast_to(found.irradiance, shape).copy(), np.broadcast_to(found.standard_error, shape).copy()

    # ---- indirect light -------------------------------------------------------------------------

    def _bundles(
        self,
        points: FloatArray,
        normals: FloatArray,
        direct: FloatArray,
        error: float,
        rays: int | None,
        counters: Counters,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Indirect irradiance by hemisphere bundles, its standard error, and the harmonic mean distance."""
        n, bands = direct.shape
        sums, reach = np.zeros((n, RUNS, bands)), np.zeros((n, 2))
        everyone = np.arange(n)
        count = np.full(n, PILOT_RAYS if rays is None else max(_power_of_two(rays), 2 * RUNS))
        self._trace(points, normals, everyone, 0, int(count[0]), sums, reach, counters)
        if rays is None:
            mean, spread = _runs(sums, count)
            level = (direct + mean).mean(axis=0)
            allowed = math.sqrt(1.0 - DIRECT_SHARE**2) * error * level
            # Of the bands, the one that is furthest from its error decides.
            over = (spread / np.where(allowed > 0, allowed, math.inf)).max(axis=1)
            wanted = np.minimum(PILOT_RAYS * np.maximum(over, 1.0) ** (4.0 / 3.0), MOST_RAYS)
            target = 2 ** np.ceil(np.log2(wanted) - 1e-9).astype(np.int64)
            for total in np.unique(target[target > PILOT_RAYS]).tolist():
                rows = np.flatnonzero(target == total)
                # The pilot's runs are the first rays of the longer net's first runs.
                longer = np.zeros((len(rows), RUNS, bands))
                for run in range(RUNS):
                    longer[:, run * PILOT_RAYS // total] += sums[rows, run]
                sums[rows] = longer
                self._trace(points, normals, rows, PILOT_RAYS, total, sums, reach, counters)
                count[rows] = total
        mean, spread = _runs(sums, count)
        distance = np.divide(reach[:, 1], reach[:, 0], out=np.full(n, math.inf), where=reach[:, 0] > 0)
        return mean, spread, distance

    def _trace(
        self,
        points: FloatArray,
        normals: FloatArray,
        rows: IntArray,
        first: int,
        count: int,
        sums: FloatArray,
        reach: FloatArray,
        counters: Counters,
    ) -> None:
        """Shoot rays ``first..count`` of the bundles of some points, block by block over the threads."""
        tracer, geometry, mesh = self.shader.tracer, self.geometry, self.solution.mesh
        centre, scale = tracer.frame
        bits = net_bits(count)
        share = max(1, BLOCK_RAYS // (count - first))
        blocks = [rows[i : i + share] for i in range(0, len(rows), share)]

        def work(block: IntArray) -> tuple[int, int]:
            many = len(block) * (count - first)
            origins, directions = np.empty((many, 3), np.float32), np.empty((many, 3), np.float32)
            owner, run = np.empty(many, dtype=np.int32), np.empty(many, dtype=np.int32)
            gather_rays(
                points, normals, block, bits, first, count, count, self.seed, tracer.offset, centre, scale, origins,
                directions, owner, run,
            )  # fmt: skip
            weight = np.ones(many)
            part, near = np.zeros((len(block), RUNS, sums.shape[2])), np.zeros((len(block), 2))
            traced = hits = 0
            for depth in range(MOST_PANES + 1):
                polygon = tracer.nearest_raw(origins, directions)
                traced, hits = traced + len(polygon), hits + int((polygon >= 0).sum())
                passed = np.empty((len(polygon), 3))
                through = collect_hits(
                    origins, directions, owner, run, weight, polygon, first == 0 and depth == 0, centre, scale,
                    geometry.polygon_normal, self._level, geometry.polygon_transmittance, self.lookup.root,
                    self.lookup.frame, self.lookup.counts, self.lookup.cells, *self.lookup.lists_and_trees,
                    mesh.piece_element, self._linear, part, near, passed,
                )  # fmt: skip
                if not through:
                    break
                row = passed[:through, 0].astype(np.int64)
                along = directions[row].astype(np.float64)
                beyond = origins[row] + (passed[:through, 2:] * scale + tracer.offset * scale) * along
                origins, directions = np.ascontiguousarray(beyond, np.float32), np.ascontiguousarray(directions[row])
                owner, run, weight = owner[row], run[row], np.ascontiguousarray(passed[:through, 1])
            sums[block] += part
            reach[block] += near
            return traced, hits

        if self.workers > 1 and len(blocks) > 1:
            with ThreadPoolExecutor(self.workers) as pool:
                done = list(pool.map(work, blocks))
        else:
            done = [work(block) for block in blocks]
        counters.add(rays=sum(traced for traced, _ in done), rays_hit=sum(hits for _, hits in done))


def _power_of_two(count: int) -> int:
    return 1 << max(count - 1, 0).bit_length()


def _runs(sums: FloatArray, count: IntArray) -> tuple[FloatArray, FloatArray]:
    """Mean of each point's bundle and its standard error, from the spread of the runs.

    Four runs tell an error but roughly, so each point's counts together with the mean of all.
    """
    mean = sums.sum(axis=1) / count[:, None]
    each = sums * (RUNS / count[:, None, None])
    square = ((each - mean[:, None]) ** 2).sum(axis=1) / (RUNS * (RUNS - 1.0))
    # Points with other numbers of rays differ: what they share is the spread at one ray's count.
    common = count[:, None] ** 1.5
    pooled = (square * common).mean(axis=0) / common
    return mean, NET_GAIN * np.sqrt((POOL * pooled + (RUNS - 1.0) * square) / (POOL + RUNS - 1.0))
