"""Irradiance at points from a solution: solve coarse, gather fine.

Direct light (emitting surfaces, lights without surface, the sky) is found at each point through the
shadow module, exactly where it can be, and never read from the mesh.  Indirect light is gathered from the
radiosity that the solution's elements reflect: by hemisphere bundles of cosine-equal quasi-random
rays whose hits read the solution, or in closed form over all elements where they are few.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radiosity._exact_gather import exact_gather
from radiosity._gather_kernels import RUNS, collect_hits, gather_rays, stand_in_front
from radiosity.element_lookup import ElementLookup, bounding_rectangle, element_gradients
from radiosity.patches import PatchMesh
from radiosity.solvers.solution import Solution
from workbench.arrays import as_count, as_fraction, as_places
from workbench.counters import Counters
from workbench.culling.tally import BOX, CHECK, CLOSED, CUT, PIECES, add_tally, new_tally
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.sampling.sequences import sobol_bits
from workbench.scene.model import Scene
from workbench.shadow.lights import Sender, SphereLight, lights_of_scene
from workbench.shadow.occlusion import ROUNDING, Shader
from workbench.shadow.sky import SkyLight

__all__ = ["Bundled", "Direct", "DirectLight", "Gatherer", "IrradianceEstimate", "allotted", "left_for_sampling"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MOST_LIGHTS = 64
"""Emitting polygons of one surface that are each asked as a light; those of a larger mesh are gathered."""
SOLVE_SHARE = 0.9
"""Share of a wanted error for the solve; sampling may take what its estimate leaves of the square, and at least:"""
LEAST_SHARE = 0.58
PILOT_RAYS = (16, 64)
"""Rays a point by which the number of rays is chosen: as many as 0.03 of error needs, within these."""
PILOT_ERROR = 0.03
MOST_RAYS = 65536
"""Most rays a point."""
MOST_ROUNDS = 8
"""Rounds in which rays are added where the spread says that they are too few."""
BLOCK_RAYS, LEAST_RAYS = 16384, 2048
"""Rays made, traced and read at once: few enough that all threads have some of them, and more than a thread costs."""
MOST_PANES = 8
"""Panes in a row that a ray goes through."""
NET_GAIN = 0.7
"""The four runs of a net are no better than their spread says, but the whole net is: by this (measured)."""
POOL = 4.0
"""Degrees of freedom for which the mean spread of all points counts in the error of one."""
DIRECT_SHARE = 0.5
"""Share of the wanted error that sampled direct light may take."""
COARSE = 0.5
"""Distance, in diameters of an element, below which rays that hit it may need more than the mesh knows."""
ROUGH, ROUGH_SHARE = 0.05, 0.5
"""Error from which this share of that distance will do."""
DEEP_HITS, DEEP_FOR, MOST_DEEP = 4, 600, 256
"""Such hits of a run whose light is gathered again, instead of read from the mesh, in bundles of 600 rays; their number
grows with the power 3/2 of the rays, as the variance falls.  And the most of them."""
NEAR_RAYS = 512
"""Rays a point that find them where the rest is gathered in closed form."""
DEEP_RAYS = 8
"""Rays from each of them, and the error of its direct light:"""
DEEP_ERROR = 0.05

_Close = tuple[IntArray, IntArray, NDArray[np.float64], IntArray, IntArray]
"""Rows of points, and of each and its runs: hits on coarse elements, some of these, their elements and polygons."""

COSTS = {BOX: 0.04, CHECK: 0.15, CLOSED: 0.6, CUT: 7.0, PIECES: 0.9}
"""Costs by which a method is chosen, in units of a ray made, traced and read (0.15 us, measured)."""
GROUP_COST = 1.2
"""The same for one side of a polygon: its pyramid."""
MOST_PIECES = 20_000
"""Most pieces of elements that are gathered in closed form."""
CELL_SHARE = 0.01
"""Share of the wanted error that one cell of an element may take where its radiosity has a slope."""
TRIAL, MOST_TRIALS = 32, 8
"""One point in so many is gathered in closed form to see what that costs, but not more of them than that."""
CUT_LIMIT = 40
"""Longest list of candidates that is cut at once; longer ones cut the element into parts."""


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
    reached : bool
        Whether sampling is within the wanted error; if not, :data:`MOST_RAYS` a point were not enough.
    method : str
        How indirect light was gathered: ``"rays"``, ``"exact"`` (every element in closed form, cut by
        what hides it) or ``"none"`` (nothing is reflected).
    counters : Counters
    seconds : dict
        Wall-clock seconds by stage.
    """

    irradiance: FloatArray
    direct: FloatArray
    indirect: FloatArray
    standard_error: FloatArray
    distance: FloatArray
    reached: bool
    method: str
    counters: Counters
    seconds: dict[str, float]


@dataclass(frozen=True)
class Bundled:
    """What hemisphere bundles found: see :class:`IrradianceEstimate` for ``distance``.

    ``indirect``, its ``standard_error`` and what came from the ``sky`` are (n, bands), in W/m2.
    """

    indirect: FloatArray
    standard_error: FloatArray
    distance: FloatArray
    sky: FloatArray


@dataclass(frozen=True)
class Direct:
    """Light straight from emitters and sky.

    ``irradiance`` and ``standard_error`` are (n, bands), in W/m2; ``state`` (n, lights) is Woo's, see
    :class:`workbench.shadow.occlusion.OcclusionState`.  Where ``crowded`` (n,), the sky is cut by too
    much to be exact: it is not in ``irradiance``, and left to the rays of bundles.
    """

    irradiance: FloatArray
    standard_error: FloatArray
    state: NDArray[np.int8]
    crowded: NDArray[np.bool_]


class DirectLight:
    """A scene's emitters and sky, ready to be asked for the light that comes straight from them.

    Parameters
    ----------
    scene : Scene
    workers : int, optional
        Threads, all cores by default; the answers do not depend on it.
    seed : int
        Of the rays.
    shader : Shader, optional
        Over the scene's geometry, if there is one already; its threads are used.
    """

    def __init__(
        self, scene: Scene, *, workers: int | None = None, seed: int = 0, shader: Shader | None = None
    ) -> None:
        self.scene, self.seed = scene, seed
        self.shader = shader if shader is not None else Shader(Geometry.from_scene(scene), workers)
        self.geometry = self.shader.geometry
        self.workers = self.shader.workers
        self.lights = tuple(self._senders(set()))
        self.sky = SkyLight.of_scene(scene)

    def in_blocks(self, work: Callable[[slice], None], count: int) -> None:
        """Do ``work`` on blocks of ``count`` rays, over the threads."""
        step = min(BLOCK_RAYS, max(LEAST_RAYS, -(-count // self.workers)))
        self.shader.spread(work, [slice(i, min(i + step, count)) for i in range(0, count, step)])

    def _senders(self, left_out: set[int]) -> list[Sender]:
        """All lights but emitting surfaces of some numbers."""
        surface = self.geometry.polygon_surface
        return [
            light
            for light in lights_of_scene(self.scene, self.geometry)
            if isinstance(light, SphereLight)
            or not len(light.polygons)
            or int(surface[light.polygons[0]]) not in left_out
        ]

    def direct(
        self, points: FloatArray, normals: FloatArray, *, own_polygon: ArrayLike, error: float, counters: Counters
    ) -> Direct:
        """Irradiance straight from lights and sky alone; arguments as of :meth:`Gatherer.irradiance`, not checked."""
        shape = (len(points), self.scene.bands)
        value, doubt, crowded = np.zeros(shape), np.zeros(shape), np.zeros(len(points), dtype=bool)
        state = np.ones((len(points), len(self.lights)), dtype=np.int8)
        if self.lights and len(points):
            found = self.shader.estimate(
                points, normals, self.lights, "auto", error=DIRECT_SHARE * error, seed=self.seed,
                own_polygon=own_polygon,
            )  # fmt: skip
            counters.merge(found.counters)
            state = found.state
            value += found.irradiance
            doubt += found.standard_error
        if self.sky is not None and len(points):
            shares = self.sky.shares(
                self.shader, points, normals, own_polygon=own_polygon, error=DIRECT_SHARE * error, counters=counters
            )
            crowded = np.isnan(shares[:, 0])
            shares[crowded] = 0.0
            value += self.sky.irradiance(shares)
        return Direct(value, doubt, state, crowded)


class Gatherer(DirectLight):
    """A solution made ready for many questions about the light at points.

    Parameters
    ----------
    solution : Solution
        With the scene that it was solved for.
    workers, seed, shader
        As of :class:`DirectLight`.

    Raises
    ------
    InputError
        If the solution has lost its scene, or its mesh is not of that scene.
    """

    def __init__(
        self, solution: Solution, *, workers: int | None = None, seed: int = 0, shader: Shader | None = None
    ) -> None:
        scene = solution.scene
        if not scene.surfaces:
            raise InputError(
                f"{scene.name}: found a solution without its scene; its file was moved, so solve the scene again"
            )
        super().__init__(scene, workers=workers, seed=seed, shader=shader)
        gathered = {
            name
            for name, surface in enumerate(scene.surfaces)
            if surface.face_count > MOST_LIGHTS and surface.sphere is None
        }
        if gathered:
            self.lights = tuple(self._senders(gathered))
        self._gathered = gathered
        self._read(solution)

    def reading(self, solution: Solution) -> Gatherer:
        """This gatherer reading another solution of the same scene: what is ready of the scene is shared."""
        other = copy.copy(self)
        other.__dict__.pop("_exact", None)
        other._read(solution)
        return other

    def doubting(self) -> Gatherer:
        """This gatherer, but gathering light again at hits of any distance, to see what the solution is off by."""
        other = copy.copy(self)
        other._coarse = np.where(self._coarse > 0, math.inf, 0.0)
        return other

    def _read(self, solution: Solution) -> None:
        mesh = solution.mesh
        self.solution = solution
        self.lookup = ElementLookup.build(self.geometry, mesh)
        asked = ~np.isin(mesh.element_surface, list(self._gathered))
        # What rays read: reflected light, and the emission of meshes with too many facets to ask each.
        self.reflected = np.ascontiguousarray(solution.radiosity - np.where(asked[:, None], mesh.emission, 0.0))
        gradient = element_gradients(mesh, self.lookup, self.reflected)
        level = self.reflected - np.einsum("ebk,ek->eb", gradient, mesh.element_centroid)
        bright = (mesh.reflectance * solution.element_irradiance).any(axis=1)
        self._coarse = np.where(bright, COARSE * mesh.element_size, 0.0)
        self._sloped = gradient.any(axis=(1, 2))
        self._linear = np.ascontiguousarray(np.concatenate([gradient, level[..., None]], axis=2))
        first = self.geometry.piece_start[self.geometry.polygon_piece_start[:-1]]
        self._level = np.einsum("ij,ij->i", self.geometry.polygon_normal, self.geometry.corners[first])

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
            Polygon of the geometry on which each point lies, which never shadows it; -1 for none.  Unless
            given it is looked for: a point on a surface, or off it by less than a 2,000,000th of the scene's
            size, counts as lying on the side that it faces, and one where two surfaces meet as just before both.
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
        place, facing = as_places(points, normals)
        error = as_fraction(error, "error")
        if rays is not None and (rays := as_count(rays, "rays")) > MOST_RAYS:
            raise OptionError(f"rays: found {rays}, expected 1 to {MOST_RAYS}")
        counters, seconds = Counters(), {}
        begin = time.perf_counter()
        if own_polygon is None:
            place, own_polygon = self._stand_in_front(place, facing)
        who = own_polygon
        straight = self.direct(place, facing, own_polygon=who, error=error, counters=counters)
        seconds["direct"] = time.perf_counter() - begin
        begin = time.perf_counter()
        found, method = self._indirect(place, facing, own_polygon, straight, error, rays, counters)
        direct = straight.irradiance + found.sky
        whole, doubt = direct + found.indirect, np.hypot(straight.standard_error, found.standard_error)
        seconds["indirect"] = time.perf_counter() - begin
        square = (doubt**2).mean(axis=0)
        reached = bool((square <= (error * whole.mean(axis=0)) ** 2).all())
        return IrradianceEstimate(
            whole, direct, found.indirect, doubt, found.distance, reached, method, counters, seconds
        )

    def _stand_in_front(self, points: FloatArray, normals: FloatArray) -> tuple[FloatArray, IntArray]:
        """Points (n, 3) moved off surfaces to the side that is seen, and the polygons (n,) on which they lie."""
        geometry, own = self.geometry, np.empty(len(points), dtype=np.int64)
        one_sided = np.array([not material.two_sided for material in geometry.surface_material])
        moved = points.copy()
        stand_in_front(
            moved, normals, own, geometry.corners, geometry.piece_start, geometry.piece_polygon,
            geometry.polygon_normal, one_sided[geometry.polygon_surface], *self.shader.tree,
            self.shader.tracer.offset, new_tally(),
        )  # fmt: skip
        return moved, own

    def indirect(
        self,
        points: FloatArray,
        normals: FloatArray,
        *,
        rays: int,
        counters: Counters,
        error: float | None = None,
        direct: FloatArray | None = None,
        seed: int | None = None,
    ) -> Bundled:
        """Indirect irradiance alone, for callers that find direct light elsewhere; arguments are not checked.

        Parameters
        ----------
        points, normals : (n, 3) float
            Normals of unit length.
        rays : int
            Rays a point, rounded up to a power of two.
        counters : Counters
            The rays are added here.
        error : float, optional
            Standard error wanted at each point, relative to all the irradiance there: more rays where
            ``rays`` are too few, up to :data:`MOST_RAYS`.
        direct : (n, bands) float
            With ``error``. [W m-2]
        seed : int, optional
            Of these rays alone; that of the gatherer unless given.
        """
        if seed is not None:
            other = copy.copy(self)
            other.seed = seed
            return other.indirect(points, normals, rays=rays, counters=counters, error=error, direct=direct)
        shape = (len(points), self.reflected.shape[1])
        if not self.reflected.any() and self.sky is None:
            return Bundled(np.zeros(shape), np.zeros(shape), np.full(len(points), math.inf), np.zeros(shape))
        bundle = self._empty_bundle(points, normals, np.ones(len(points), dtype=bool), error)
        self._extend(bundle, np.full(len(points), max(_power_of_two(rays), 2 * RUNS)), counters)
        mean, spread, sky = bundle.result()
        if error is not None and direct is not None:
            allowed = error * (direct + mean + sky)
            over = (spread / np.where(allowed > 0, allowed, math.inf)).max(axis=1)
            target = 2 ** np.ceil(np.log2(bundle.count * np.maximum(over, 1.0) ** (4.0 / 3.0)) - 0.5)
            self._extend(bundle, np.minimum(target, MOST_RAYS).astype(np.int64), counters)
            mean, spread, sky = bundle.result()
        return Bundled(mean, spread, bundle.distance(), sky)

    # ---- indirect light -------------------------------------------------------------------------

    def _indirect(
        self,
        points: FloatArray,
        normals: FloatArray,
        own: ArrayLike | None,
        straight: Direct,
        error: float,
        rays: int | None,
        counters: Counters,
    ) -> tuple[Bundled, str]:
        """Indirect irradiance, and the sky where only rays see it; with the method chosen."""
        direct, crowded = straight.irradiance, straight.crowded
        n, bands = direct.shape
        nothing = np.zeros((n, bands))
        if not self.reflected.any() and not crowded.any():
            return Bundled(nothing, nothing.copy(), np.full(n, math.inf), nothing), "none"
        bundle = self._empty_bundle(points, normals, crowded, error)
        if rays is not None:
            self._extend(bundle, np.full(n, max(_power_of_two(rays), 2 * RUNS)), counters)
            return bundle.found(), "rays"
        who = np.full(n, -1, dtype=np.int64) if own is None else np.broadcast_to(np.asarray(own, np.int64), (n,))
        # Closed forms know no candidates yet: what they cost at least.
        least = math.inf
        groups, pieces = self._sending
        if not crowded.any() and pieces <= MOST_PIECES:
            least = GROUP_COST * groups + COSTS[CLOSED] * pieces
        pilot = _power_of_two(round(PILOT_RAYS[1] * (PILOT_ERROR / error) ** (4.0 / 3.0)))
        pilot = min(max(pilot, PILOT_RAYS[0]), PILOT_RAYS[1])
        closed = least <= pilot
        self._extend(bundle, np.full(n, 4 * RUNS if closed else pilot), counters)
        for step in range(MOST_ROUNDS):
            mean, spread, from_sky = bundle.result()
            level = (direct + mean + from_sky).mean(axis=0)
            small = CELL_SHARE * error * level
            # What direct light has left of the error; of few points the spread tells but roughly.
            allowed = (error * level) ** 2
            allowed -= np.minimum((straight.standard_error**2).mean(axis=0), DIRECT_SHARE**2 * allowed)
            allowed /= 1.0 + math.sqrt(2.0 / ((RUNS - 1) * n))
            if closed:
                return self._closed(bundle, who, small, allowed, counters), "exact"
            if ((spread**2).mean(axis=0) <= allowed).all():
                break
            target = allotted(spread**2, bundle.count, allowed)
            wanted = int((target - bundle.count).sum())
            if wanted == 0:
                break
            if step == 0 and least * n < wanted:
                trial = np.unique(np.linspace(0, n - 1, min(-(-n // TRIAL), MOST_TRIALS)).astype(np.int64))
                cost = self._closed_forms(points, normals, who, trial, small, counters)[2]
                if cost * n < wanted * len(trial):
                    return self._closed(bundle, who, small, allowed, counters), "exact"
            self._extend(bundle, target, counters)
        return bundle.found(), "rays"

    def _closed(
        self, bundle: _Bundle, own: IntArray, small: FloatArray, allowed: FloatArray, counters: Counters
    ) -> Bundled:
        """Everything in closed form, but for what rays find of elements that are coarse for their distance."""
        every = np.arange(len(bundle.points))
        value, doubt, _ = self._closed_forms(bundle.points, bundle.normals, own, every, small, counters)
        near = bundle.close > 0
        target = np.where(near, np.maximum(NEAR_RAYS, bundle.count), bundle.count)
        for _ in range(MOST_ROUNDS):
            self._extend(bundle, target, counters)
            fix, unsure = bundle.runs_of(bundle.fix)
            unsure = np.where(near[:, None], unsure / NET_GAIN, 0.0)
            if ((unsure**2).mean(axis=0) <= allowed).all():
                break
            target = allotted(unsure**2, bundle.count, allowed)
        return Bundled(value + fix, doubt + unsure, bundle.distance(), np.zeros_like(value))

    def _empty_bundle(
        self, points: FloatArray, normals: FloatArray, crowded: NDArray[np.bool_], error: float | None = None
    ) -> _Bundle:
        reach = ROUGH_SHARE if error is not None and error >= ROUGH else 1.0
        n, bands = len(points), self.reflected.shape[1]
        return _Bundle(
            points,
            normals,
            np.zeros((n, RUNS, bands)),
            np.zeros((n, RUNS, bands)),
            np.zeros((n, RUNS, 2)),
            np.zeros((n, 2)),
            np.zeros(n, dtype=np.int64),
            np.zeros(n, dtype=np.int64),
            self.sky if crowded.any() else None,
            crowded,
            reach if self._coarse.any() else 0.0,
        )

    @cached_property
    def _sending(self) -> tuple[int, int]:
        """Numbers of sides of polygons, and of pieces of elements on them, that send light."""
        lit: NDArray[np.bool_] = np.asarray(self.reflected.any(axis=1))
        pieces = np.flatnonzero(lit[self.lookup.piece_element])
        return len(np.unique(_side_keys(self.solution.mesh, self.lookup, pieces))), len(pieces)

    @cached_property
    def _exact(self) -> _Groups:
        """The elements' pieces by side of a polygon, for closed forms."""
        return _Groups.build(self.solution.mesh, self.lookup, self.reflected)

    def _closed_forms(
        self,
        points: FloatArray,
        normals: FloatArray,
        own: IntArray,
        rows: IntArray,
        small: FloatArray,
        counters: Counters,
    ) -> tuple[FloatArray, FloatArray, float]:
        """Irradiance of ``rows`` by every element in closed form (others 0), its doubt, and the cost in rays.

        ``small`` (bands,) is what one place that stands for a cell may be off by. [W m-2]
        """
        geo, mesh, parts = self.geometry, self.solution.mesh, self._exact
        through = geo.polygon_transmittance[geo.piece_polygon]
        out, doubt = np.zeros((len(points), self.reflected.shape[1])), np.zeros((len(points), self.reflected.shape[1]))
        slack = max(geo.slack, ROUNDING * float(np.abs(points).max()))
        everything = np.arange(parts.groups)

        def work(block: IntArray) -> NDArray[np.int64]:
            tally = new_tally()
            exact_gather(
                points, normals, own, block, everything, parts.rings, parts.polygon, parts.normal, parts.members,
                parts.start, mesh.corners, mesh.piece_start, mesh.piece_normal, mesh.piece_element, self._linear,
                self._sloped, geo.corners, geo.piece_start, geo.piece_polygon, through, *self.shader.tree,
                slack, CUT_LIMIT, small, out, doubt, tally,
            )  # fmt: skip
            return tally

        blocks = np.array_split(rows, max(1, len(rows) // 16)) if len(rows) else []
        done = self.shader.spread(work, blocks)
        cost = GROUP_COST * parts.groups * len(rows)
        for tally in done:
            add_tally(counters, tally)
            cost += sum(each * int(tally[row]) for row, each in COSTS.items())
        return out, doubt, cost

    def _extend(self, bundle: _Bundle, target: IntArray, counters: Counters) -> None:
        """Shoot rays until each bundle has ``target`` (n,) of them, powers of two; none where it has as many.

        Block by block over the threads.
        """
        blocks: list[tuple[IntArray, int, int]] = []
        more = np.flatnonzero(target > bundle.count)
        for before, count in np.unique(np.column_stack([bundle.count, target])[more], axis=0).tolist():
            rows = more[(bundle.count[more] == before) & (target[more] == count)]
            if before:
                # The runs so far are the first rays of the longer net's first runs.
                for sums in (bundle.sums, bundle.fix, bundle.seen):
                    longer = np.zeros((len(rows), *sums.shape[1:]))
                    for run in range(RUNS):
                        longer[:, run * before // count] += sums[rows, run]
                    sums[rows] = longer
            share = max(1, BLOCK_RAYS // (count - before))
            blocks += [(rows[i : i + share], before, count) for i in range(0, len(rows), share)]
        if blocks:
            self._trace(bundle, blocks, counters)
            bundle.count[more] = target[more]

    def _trace(self, bundle: _Bundle, blocks: list[tuple[IntArray, int, int]], counters: Counters) -> None:
        """Shoot rays of bundles: for each block its rows, the first ray and the number of rays of the whole net."""
        tracer, geometry, mesh = self.shader.tracer, self.geometry, self.solution.mesh
        centre, scale = tracer.frame
        law = bundle.sky.law if bundle.sky is not None else np.zeros(12)
        bits = sobol_bits(max(count for *_, count in blocks))
        coarse = bundle.deep * self._coarse if bundle.deep else np.zeros(mesh.element_count)

        def work(task: tuple[IntArray, int, int]) -> tuple[int, int, _Close]:
            block, first, count = task
            deep = min(max(round(DEEP_HITS * (count / DEEP_FOR) ** 1.5), 1), MOST_DEEP) if bundle.deep else 0
            many = len(block) * (count - first)
            origins, directions = np.empty((many, 3), np.float32), np.empty((many, 3), np.float32)
            owner, run = np.empty(many, dtype=np.int32), np.empty(many, dtype=np.int32)
            gather_rays(
                bundle.points, bundle.normals, block, bits, first, count, count, self.seed, tracer.offset, centre,
                scale, origins, directions, owner, run,
            )  # fmt: skip
            weight = np.ones(many)
            part, near = np.zeros((len(block), RUNS, bundle.sums.shape[2])), np.zeros((len(block), 2))
            seen = np.zeros((len(block), RUNS, 2))
            kept = np.empty((len(block), RUNS, deep, 4))
            element, side = np.zeros((len(block), RUNS, deep), np.int64), np.zeros((len(block), RUNS, deep), np.int64)
            close = np.zeros((len(block), RUNS), np.int64)
            traced = hits = 0
            for depth in range(MOST_PANES + 1):
                polygon = tracer.nearest_raw(origins, directions)
                traced, hits = traced + len(polygon), hits + int((polygon >= 0).sum())
                passed = np.empty((len(polygon), 3))
                through = collect_hits(
                    origins, directions, owner, run, weight, polygon, first == 0 and depth == 0, centre, scale,
                    geometry.polygon_normal, self._level, geometry.polygon_transmittance, self.lookup.root,
                    self.lookup.frame, self.lookup.counts, self.lookup.cells, *self.lookup.lists_and_trees,
                    mesh.piece_element, self._linear, law, bundle.sky is not None, coarse, self.seed, part, near, seen,
                    passed, kept, element, side, close,
                )  # fmt: skip
                if not through:
                    break
                row = passed[:through, 0].astype(np.int64)
                along = directions[row].astype(np.float64)
                beyond = origins[row] + (passed[:through, 2:] * scale + tracer.offset * scale) * along
                origins, directions = np.ascontiguousarray(beyond, np.float32), np.ascontiguousarray(directions[row])
                owner, run, weight = owner[row], run[row], np.ascontiguousarray(passed[:through, 1])
            bundle.sums[block] += part
            bundle.seen[block] += seen
            bundle.reach[block] += near
            return traced, hits, (block, close, kept, element, side)

        done = self.shader.spread(work, blocks)
        counters.add(rays=sum(traced for traced, *_ in done), rays_hit=sum(hits for _, hits, _ in done))
        if bundle.deep:
            self._correct(bundle, [close for *_, close in done], counters)

    def _correct(self, bundle: _Bundle, found: list[_Close], counters: Counters) -> None:
        """Gather again where rays hit elements that are coarse for their distance.

        The mesh's radiosity there is a control variate: what a few of these hits, chosen at random, really
        send back, less what the mesh says, corrects the sum over all.
        """
        mesh = self.solution.mesh
        parts = []
        for rows, near, kept, element, side in found:
            bundle.close[rows] += near.sum(axis=1)
            slots = np.minimum(near, kept.shape[2])
            point, run, slot = np.nonzero(np.arange(kept.shape[2]) < slots[..., None])
            share = kept[point, run, slot, 3] * near[point, run] / slots[point, run]
            parts.append((rows[point], run, kept[point, run, slot, :3], share, element[point, run, slot],
                          side[point, run, slot]))  # fmt: skip
        rows, run, place, share, e, polygon = (np.concatenate(part) for part in zip(*parts, strict=True))
        if not len(rows):
            return
        behind = polygon < 0
        polygon = np.where(behind, ~polygon, polygon)
        normal = self.geometry.polygon_normal[polygon] * np.where(behind, -1.0, 1.0)[:, None]
        lit = self.direct(place, normal, own_polygon=polygon, error=DEEP_ERROR, counters=counters)
        small = self._empty_bundle(place, normal, lit.crowded)
        small.deep = 0.0
        self._extend(small, np.full(len(place), DEEP_RAYS), counters)
        indirect, _, from_sky = small.result()
        # What the mesh holds beside reflected light stays: the emission of lamps with too many facets.
        own = self.reflected[e] - mesh.reflectance[e] * self.solution.element_irradiance[e]
        true = mesh.reflectance[e] * (lit.irradiance + indirect + from_sky) + own
        read = np.einsum("nbk,nk->nb", self._linear[e, :, :3], place) + self._linear[e, :, 3]
        np.add.at(bundle.fix, (rows, run), share[:, None] * (true - np.maximum(read, 0.0)))


def left_for_sampling(solution: Solution, error: float) -> float:
    """What of a wanted error at points is left for sampling, as much as the solution states to be off.

    The two are independent, so their squares add up; of a solution that states nothing half is supposed.
    """
    estimate = solution.record.errors.get("estimate", {}).get("total", math.sqrt(0.5) * error)
    return math.sqrt(max(error**2 - estimate**2, (LEAST_SHARE * error) ** 2))


def _power_of_two(count: int) -> int:
    return 1 << max(count - 1, 0).bit_length()


def allotted(variance: FloatArray, count: IntArray, allowed: FloatArray, most: int | None = None) -> IntArray:
    """Numbers of rays (n,), powers of two, that bring the mean variance of all points to ``allowed`` (bands,).

    ``variance`` (n, bands) is that with ``count`` (n,) rays; it falls with their power -3/2.  The rays in all are
    fewest (Lagrange) where each point has as many as the power 2/5 of its variance at one ray, up to ``most``
    (:data:`MOST_RAYS` unless given).
    """
    unit = variance * (count**1.5)[:, None]
    # Of the bands, the one that is furthest from its error decides.
    worst = (unit / np.where(allowed > 0, allowed, math.inf)).max(axis=1)

    def rays(scale: float) -> FloatArray:
        with np.errstate(divide="ignore"):
            wanted = 2.0 ** np.round(np.log2(scale * worst**0.4))
        return np.minimum(np.maximum(wanted, count), most or MOST_RAYS)

    low, high = -20.0, 40.0  # powers of two
    while high - low > 0.05:
        middle = 0.5 * (low + high)
        enough = (unit / (rays(2.0**middle) ** 1.5)[:, None]).mean(axis=0) <= np.maximum(allowed, 0.0)
        low, high = (low, middle) if (enough | (allowed <= 0)).all() else (middle, high)
    return np.maximum(rays(2.0**high), count).astype(np.int64)


@dataclass
class _Bundle:
    """Bundles of n points and what their rays found so far.

    Light is gathered again at hits within ``deep`` times the distance for which the mesh is too coarse; 0: never.
    """

    points: FloatArray
    normals: FloatArray
    sums: FloatArray
    fix: FloatArray
    seen: FloatArray
    reach: FloatArray
    count: IntArray
    close: IntArray
    sky: SkyLight | None
    crowded: NDArray[np.bool_]
    deep: float

    def result(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean of each bundle, the standard error from the spread of the runs, and the sky seen where it is asked.

        Four runs tell an error but roughly, so each point's counts together with the mean of all.
        """
        from_sky = np.zeros((len(self.points), self.sums.shape[2]))
        parts = None
        if self.sky is not None:
            seen = self.seen * (RUNS * self.crowded[:, None, None] / self.count[:, None, None])
            parts = np.stack([self.sky.irradiance(seen[:, run]) for run in range(RUNS)], axis=1)
            from_sky = parts.mean(axis=1)
        mean, spread = self.runs_of(self.sums, parts)
        fix, unsure = self.runs_of(self.fix)
        # What corrects a sum is drawn at random: it has no net's gain.
        return mean + fix, np.hypot(spread, unsure / NET_GAIN), from_sky

    def found(self) -> Bundled:
        """All that the rays found."""
        mean, spread, from_sky = self.result()
        return Bundled(mean, spread, self.distance(), from_sky)

    def runs_of(self, sums: FloatArray, beside: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Mean of sums (n, runs, bands) over the rays, and its standard error with ``beside``, means of the runs."""
        count = self.count[:, None]
        mean = sums.sum(axis=1) / count
        each = sums * (RUNS / count[..., None])
        if beside is not None:
            each = each + beside
        square = ((each - each.mean(axis=1, keepdims=True)) ** 2).sum(axis=1) / (RUNS * (RUNS - 1.0))
        # Points with other numbers of rays differ: what they share is the spread at one ray's count.
        common = count**1.5
        pooled = (square * common).mean(axis=0) / common
        return mean, NET_GAIN * np.sqrt((POOL * pooled + (RUNS - 1.0) * square) / (POOL + RUNS - 1.0))

    def distance(self) -> FloatArray:
        """Harmonic mean distance of the hits, infinite where nothing was met."""
        inverse, hits = self.reach[:, 0], self.reach[:, 1]
        return np.where(inverse > 0, hits / np.where(inverse > 0, inverse, 1.0), math.inf)


def _side_keys(mesh: PatchMesh, lookup: ElementLookup, pieces: IntArray) -> IntArray:
    """Number (n,) of the side of a polygon that each of some pieces lies on."""
    return lookup.piece_polygon[pieces] * 2 + (mesh.element_side[mesh.piece_element[pieces]] < 0)


@dataclass(frozen=True)
class _Groups:
    """Pieces of elements that send light, by side of a polygon.

    ``rings`` (g, 4, 3) are rectangles round each group, ``polygon``, ``normal`` its polygon and the
    normal of its side, ``members[start[i]:start[i + 1]]`` its pieces of the mesh.
    """

    rings: FloatArray
    polygon: IntArray
    normal: FloatArray
    members: IntArray
    start: IntArray

    @property
    def groups(self) -> int:
        return len(self.polygon)

    @property
    def pieces(self) -> int:
        return len(self.members)

    @classmethod
    def build(cls, mesh: PatchMesh, lookup: ElementLookup, values: FloatArray) -> _Groups:
        lit: NDArray[np.bool_] = np.asarray(values.any(axis=1))
        pieces = np.flatnonzero(lit[mesh.piece_element])
        key = _side_keys(mesh, lookup, pieces)
        order = np.argsort(key, kind="stable")
        members = pieces[order]
        groups, first = np.unique(key[order], return_index=True)
        start = np.append(first, len(members)).astype(np.int64)
        rings = np.stack([bounding_rectangle(mesh, members[a:b]) for a, b in pairwise(start.tolist())])
        return cls(
            np.ascontiguousarray(rings), groups // 2, np.ascontiguousarray(mesh.piece_normal[members[first]]), members,
            start,
        )  # fmt: skip
