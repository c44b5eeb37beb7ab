"""The three occlusion states, and one question: how much of a light does each point receive?

A. Woo, "Efficient Shadow Computations in Ray Tracing" (IEEE CG&A 1993) marks a point, for one
light, as in shadow, not in shadow, or complex.  :func:`estimate` finds the state, the visible part
and the irradiance of points under lights of every kind, by a method of choice.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.accel.box_tree import BoxTree, boxes_meeting_planes
from workbench.accel.embree import EmbreeAccelerator
from workbench.accel.voxel_grid import VoxelGrid
from workbench.arrays import as_count, as_fraction, as_places, as_points
from workbench.counters import Counters
from workbench.culling.plane_vertex import CHECK_SLACK
from workbench.culling.shaft import MAX_SHAFT_PLANES, box_shaft
from workbench.culling.tally import CLOSED, add_tally, new_tally
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.geometry.lambert import lambert_piece
from workbench.geometry.polygons import check_polygon, convex_pieces, plane_basis, vector_area
from workbench.shadow import _sampled, _settle
from workbench.shadow._tile_fit import NODE_GAP
from workbench.shadow.area import MAX_CORNERS
from workbench.shadow.hardware_camera import CameraState, camera_shadows
from workbench.shadow.lights import (
    DirectionalLight,
    DiskLight,
    LinearLight,
    PointLight,
    PolygonLight,
    Sender,
    SphereLight,
)
from workbench.shadow.linear import visible_linear_irradiance
from workbench.shadow.rays import NOISE, visible_shares
from workbench.shadow.silhouette import (
    BLUR,
    FIT_NS,
    MAX_LINES,
    RAY_NS,
    RAYED,
    EdgeTable,
    SenderFrame,
    line_tiles,
    sender_width,
)
from workbench.shadow.smooth import ALONE_NOISE, fill_smoothly
from workbench.shadow.tiles import Tiles, sort_into_tiles

__all__ = ["METHODS", "AreaLight", "OcclusionEstimate", "OcclusionState", "Shader", "estimate"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
_Each = TypeVar("_Each")
_Done = TypeVar("_Done")

METHODS = ("adaptive", "auto", "camera", "camera-optimised", "exact", "rays", "rays+plane-vertex", "shaft")
"""Methods by name: see :func:`estimate`."""
_UNCULLED = ("adaptive", "rays", "rays+plane-vertex")
"""Methods that ask every point that faces the light."""

MARGIN = 1.3
"""Errors of neighbouring fits partly cancel: measured errors stay below the asked one by this."""
LINE_MARGIN = 0.8
"""Share of the asked error that lines are drawn for: what they state scatters from point to point."""
PILOT_POINTS, PILOT_RAYS = 128, 16
"""Points that give a first idea of the mean irradiance and of the noise, and rays at each."""
USUAL_NOISE = 0.22
"""L lines usually leave an error of USUAL_NOISE L^-3/2 of a visible share past a tessellated torus."""
LIST_LIMIT = 64
"""Longest candidate list of a tile whose points ``auto`` looks at one by one before it draws lines."""
CUT_LIMIT = 12
"""Longest candidate list that ``auto`` and ``shaft`` cut exactly in any case."""
CROWD_LIMIT = 64
"""And the longest that ``auto`` cuts where that is cheaper than lines and rays."""
CUT_NS, KEPT_NS, VOXEL_NS = 2000.0, 500.0, 1400.0
"""Nanoseconds of a cut, of each candidate left in it, and of a ray of the instrument, which panes need."""
TILE_NS, POINT_NS = 300e3, 20e3
"""Nanoseconds of lines: of a tile, and of a point at which they are drawn."""
PREPARE_NS, PREPARED_NS = 3000.0, 150.0
"""Nanoseconds a piece of all geometry before the first line is drawn, and with a sender that was asked before."""
FILL_NS = 2e6
"""Nanoseconds of fits to rays, however few the points are."""
FRAMES, FRAMED_PIECES = 16, 1_000_000
"""Senders whose frames are kept, at most, and pieces in all of them: some 100 MB."""
LEAST_MEAN = 0.05
"""``auto``: of darker scenes the error is asked relative to this share of the unoccluded irradiance."""
BLOCK_POINTS, CUT_POINTS = 4096, 256
"""Points a block of work on one thread, at least: to be settled by culls, and to be cut."""
LIFT = 1e-9
"""Distance by which rays of the instrument begin and end off surfaces, as a share of the scene's size."""
ROUNDING = 64.0 * float(np.finfo(np.float64).eps)
"""Rounding of a distance, as a share of the coordinates it is a difference of."""
ROUND_CORNERS = 24
"""Corners of the regular polygon that stands for a disk when it is cut, checked or drawn."""
ROUND_ERROR = 0.0022
"""Share of a disk that lies outside that polygon of its area, and so the most that it can be off."""


class OcclusionState(IntEnum):
    """Woo's three states of a point for one light."""

    NOT_INSHADOW = 0
    INSHADOW = 1
    COMPLEX_SHADOW = 2


@dataclass(frozen=True)
class AreaLight:
    """A polygonal diffuse light, emitting from its front.

    Parameters
    ----------
    polygon : (m, 3) float
        Planar simple polygon, counter-clockwise from the emitting side; concave ones are cut.
    radiance : (bands,) float
        [W m-2 sr-1]
    polygon_id : int
        The geometry's polygon that this light is, -1 if it is none: it never shadows itself.
    """

    polygon: FloatArray
    radiance: FloatArray
    polygon_id: int = -1


@dataclass(frozen=True)
class OcclusionEstimate:
    """What :func:`estimate` found, for n points and l lights.

    Parameters
    ----------
    state : (n, l) int
        :class:`OcclusionState` of each point for each light.  Where nothing comes from the light
        even unoccluded it is INSHADOW; what only rays have seen is COMPLEX_SHADOW.
    open_share, visible_share : (n, l) float
        Irradiance for a power of 1 in all bands, unoccluded and with the occluders: the form factor
        from the point for lights that are surfaces.
    irradiance : (n, bands) float
        [W m-2]
    standard_error : (n, bands) float
        Estimated error of the irradiance. [W m-2]
    candidates : (n, l) int
        Convex pieces of occluders that the culls left, one more than a cut takes meaning that many
        or more; -1 by methods that do not list them.
    counters : Counters
    seconds : dict
        Wall-clock seconds by stage.
    """

    state: NDArray[np.int8]
    open_share: FloatArray
    visible_share: FloatArray
    irradiance: FloatArray
    standard_error: FloatArray
    candidates: IntArray
    counters: Counters
    seconds: dict[str, float]


def _rays_for(error: float) -> int:
    """Rays at a point whose visible share is wanted to ``error``."""
    return int(min(max(math.ceil((NOISE / error) ** (4.0 / 3.0)), 4), 65536))


@dataclass(frozen=True)
class _Pilot:
    """What a few points tell: the mean form factor over all points, and the stated error of a share at waiting ones."""

    mean: float
    doubt: float

    def rays(self, error: float) -> int:
        """Rays at each waiting point that leave ``error`` of a share, as they state it."""
        times = self.doubt / error
        # What is stated where few rays agree falls as their number, all else faster.
        return min(max(math.ceil(PILOT_RAYS * max(times, times ** (4.0 / 3.0))), 4), _rays_for(error))


@dataclass(frozen=True)
class _Task:
    """One light's question: how, how well, and where to count."""

    method: str
    error: float
    samples: int
    seed: int
    slack: float
    counters: Counters
    seconds: dict[str, float]


@dataclass
class _Answer:
    """One light's answers (n,), in the order of the tiles."""

    open: FloatArray
    seen: FloatArray
    doubt: FloatArray
    state: NDArray[np.int8]
    candidates: IntArray

    @classmethod
    def sampled(cls, whole: FloatArray) -> _Answer:
        """All dark so far, complex where light may come."""
        state = np.where(whole > 0.0, OcclusionState.COMPLEX_SHADOW, OcclusionState.INSHADOW).astype(np.int8)
        unknown = np.full(len(whole), -1, dtype=np.int64)
        return cls(whole, np.zeros(len(whole)), np.zeros(len(whole)), state, unknown)


@dataclass(frozen=True)
class _Settled:
    """What is known (n,) of one convex piece of a light: form factors, states, candidates left."""

    part: FloatArray
    share: FloatArray
    doubt: FloatArray
    state: NDArray[np.int8]
    candidates: IntArray

    @classmethod
    def empty(cls, n: int) -> _Settled:
        """Nothing yet."""
        return cls(np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n, dtype=np.int8), np.zeros(n, dtype=np.int64))


def _round_ring(centre: FloatArray, radius: float, normal: FloatArray) -> FloatArray:
    """A regular polygon (24, 3) of a disk's area, counter-clockwise about ``normal``."""
    u, v = plane_basis(normal)
    step = 2.0 * math.pi / ROUND_CORNERS
    angle = step * np.arange(ROUND_CORNERS)
    reach = radius * math.sqrt(step / math.sin(step))
    return centre + reach * (np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v)


def _sides(light: AreaLight | PolygonLight | DiskLight) -> list[list[FloatArray]]:
    """Convex pieces of each emitting side, counter-clockwise from it, short enough to be cut."""
    if isinstance(light, DiskLight):
        pieces = [_round_ring(light.centre, light.radius, light.normal)]
    elif isinstance(light, PolygonLight):
        pieces = list(light.parts)
    else:
        polygon = as_points(light.polygon, "light")
        problem = check_polygon([polygon])
        if problem:
            raise InputError(f"light: found {problem}, expected a planar polygon with an area")
        pieces = convex_pieces([polygon])
    short = []
    for piece in pieces:
        most = MAX_CORNERS - 4
        short += [
            np.concatenate([piece[:1], piece[i : i + most - 1]])
            for i in (range(1, len(piece) - 1, most - 2) if len(piece) > most else [1])
        ]
    both = isinstance(light, (PolygonLight, DiskLight)) and light.two_sided
    return [short, [np.ascontiguousarray(ring[::-1]) for ring in short]] if both else [short]


_LIGHTS = (AreaLight, DirectionalLight, DiskLight, LinearLight, PointLight, PolygonLight, SphereLight)


def _power(light: AreaLight | Sender) -> FloatArray:
    """What the light's share is multiplied by: exitance of a surface, intensity of others."""
    power = light.radiance * math.pi if isinstance(light, AreaLight) else light.power
    return np.atleast_1d(np.asarray(power, dtype=np.float64))


class Shader:
    """A geometry made ready for many questions: box tree, Embree scene, voxels, threads.

    Parameters
    ----------
    geometry : Geometry
    workers : int, optional
        Threads, all cores by default; the answers do not depend on it.
    """

    def __init__(self, geometry: Geometry, workers: int | None = None) -> None:
        self.geometry = geometry
        self.workers = as_count(workers, "workers") if workers is not None else len(os.sched_getaffinity(0))
        self._box_tree = tree = BoxTree.build(geometry)
        self._frames: dict[bytes, SenderFrame] = {}
        self._through = np.ascontiguousarray(geometry.polygon_transmittance[geometry.piece_polygon])
        self._tree = (tree.low, tree.high, tree.skip, tree.first, tree.count, tree.order, geometry.piece_bounds)

    @cached_property
    def tracer(self) -> EmbreeAccelerator:
        """Embree, for rays past opaque surfaces."""
        return EmbreeAccelerator(self.geometry)

    @property
    def tree(self) -> tuple[FloatArray, FloatArray, IntArray, IntArray, IntArray, IntArray, FloatArray]:
        """What :func:`workbench.accel.box_tree.boxes_meeting_planes` takes first: the box tree's arrays."""
        return self._tree

    @cached_property
    def _edges(self) -> EdgeTable:
        return EdgeTable.build(self.geometry)

    @cached_property
    def grid(self) -> VoxelGrid:
        """The instrument's voxels, for counted rays and for panes; a pane has one transmittance, its mean."""
        grey = tuple(
            replace(material, transmittance=np.full_like(material.transmittance, material.transmittance.mean()))
            for material in self.geometry.surface_material
        )
        return VoxelGrid(replace(self.geometry, surface_material=grey), workers=self.workers)

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self.workers)

    def spread(self, work: Callable[[_Each], _Done], tasks: Sequence[_Each]) -> list[_Done]:
        """``work`` on each task, over threads that are kept; tasks must not spread work themselves."""
        if self.workers == 1 or len(tasks) <= 1:
            return [work(task) for task in tasks]
        return list(self._pool.map(work, tasks))

    def estimate(
        self,
        points: ArrayLike,
        normals: ArrayLike,
        lights: AreaLight | Sender | Sequence[AreaLight | Sender],
        method: str = "auto",
        *,
        error: float = 0.01,
        samples: int = 64,
        seed: int = 0,
        own_polygon: ArrayLike | None = None,
    ) -> OcclusionEstimate:
        """See :func:`estimate`."""
        where, facing = as_places(points, normals)
        if method not in METHODS:
            raise OptionError(f"method: found {method!r}, expected one of {', '.join(METHODS)}")
        error, samples = as_fraction(error, "error"), as_count(samples, "samples")
        chosen = list(lights) if isinstance(lights, Sequence) else [lights]
        if not chosen:
            raise InputError("lights: found none, expected one or more")
        for light in chosen:
            if not isinstance(light, _LIGHTS):
                raise InputError(f"lights: found {type(light).__name__}, expected AreaLight or one of shadow.lights")
        powers = [_power(light) for light in chosen]
        bands = max(len(power) for power in powers)
        if {len(power) for power in powers} - {1, bands}:
            raise InputError(f"lights: found {sorted({len(p) for p in powers})} bands, expected as many for each light")
        own = np.full(len(where), -1, dtype=np.int64)
        if own_polygon is not None:
            own = np.ascontiguousarray(np.broadcast_to(np.asarray(own_polygon, dtype=np.int64), (len(where),)))
        counters = Counters()
        seconds: dict[str, float] = {}
        start = time.perf_counter()
        tiles = sort_into_tiles(where, facing, own, self.geometry.size)
        seconds["tiles"] = time.perf_counter() - start
        far = max(float(np.abs(where).max()), float(np.abs(self.geometry.bounds).max()))
        slack = max(CHECK_SLACK * self.geometry.size, ROUNDING * far)
        shape = (len(where), len(chosen))
        state, candidates = np.zeros(shape, dtype=np.int8), np.zeros(shape, dtype=np.int64)
        open_share, visible, doubt = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        for column, light in enumerate(chosen):
            answer = self._one_light(
                tiles, light, _Task(method, error, samples, seed + column, slack, counters, seconds)
            )
            open_share[tiles.order, column] = answer.open
            visible[tiles.order, column] = answer.seen
            doubt[tiles.order, column] = answer.doubt
            state[tiles.order, column] = answer.state
            candidates[tiles.order, column] = answer.candidates
        power = np.stack([np.broadcast_to(each, (bands,)) for each in powers])
        variance = doubt**2 @ power**2
        return OcclusionEstimate(
            state, open_share, visible, visible @ power, np.sqrt(variance), candidates, counters, seconds
        )

    def _one_light(self, tiles: Tiles, light: AreaLight | Sender, task: _Task) -> _Answer:
        if isinstance(light, (DirectionalLight, PointLight)):
            return self._single_rays(tiles, light, task)
        if isinstance(light, LinearLight):
            return self._linear(tiles, light, task)
        if isinstance(light, SphereLight):
            return self._sphere(tiles, light, task)
        assert isinstance(light, (AreaLight, PolygonLight, DiskLight))
        if isinstance(light, AreaLight):
            polygons = np.asarray([light.polygon_id] if light.polygon_id >= 0 else [], dtype=np.int64)
        else:
            polygons = light.polygons
        answer: _Answer | None = None
        for side in _sides(light):
            found = self._side(tiles, side, polygons, task)
            if answer is None:
                answer = found
                continue
            facing = found.open > 0.0  # no point sees both sides
            answer.state[facing] = found.state[facing]
            for name in ("open", "seen", "doubt", "candidates"):
                getattr(answer, name)[facing] = getattr(found, name)[facing]
        assert answer is not None
        if isinstance(light, DiskLight):
            whole = light.unit_irradiance(tiles.points, tiles.normals)
            self._rounded(answer, whole)
        return answer

    def _rounded(self, answer: _Answer, whole: FloatArray) -> None:
        """Turn answers for a polygon into those of the disk that it stands for."""
        scale = whole / np.where(answer.open > 0.0, answer.open, 1.0)
        answer.seen, answer.doubt = answer.seen * scale, answer.doubt * scale
        partly = answer.state == OcclusionState.COMPLEX_SHADOW
        answer.doubt[partly] = np.hypot(answer.doubt, ROUND_ERROR * whole)[partly]
        answer.open = whole

    def _bundle(self, tiles: Tiles, rows: IntArray, count: int, task: _Task) -> _sampled.Bundle:
        return _sampled.Bundle(
            tiles.points[rows], tiles.normals[rows], tiles.order[rows], tiles.own[rows], count, task.seed, self.workers,
            LIFT * self.geometry.size + 4.0 * task.slack,
        )  # fmt: skip

    # ---- lights without area ------------------------------------------------------------------

    def _single_rays(self, tiles: Tiles, light: Sender, task: _Task) -> _Answer:
        """Lights of one place or direction: whatever the method, one ray a point."""
        answer = _Answer.sampled(light.unit_irradiance(tiles.points, tiles.normals))
        rows = np.flatnonzero(answer.open > 0.0)
        share, _ = _sampled.sender_shares(self.grid, self._bundle(tiles, rows, 1, task), light, task.counters)
        answer.seen[rows] = share * answer.open[rows]
        answer.state[rows[share == 1.0]] = OcclusionState.NOT_INSHADOW
        answer.state[rows[share == 0.0]] = OcclusionState.INSHADOW
        return answer

    def _linear(self, tiles: Tiles, light: LinearLight, task: _Task) -> _Answer:
        """A linear light: exact past opaque surfaces, otherwise by rays."""
        answer = _Answer.sampled(light.unit_irradiance(tiles.points, tiles.normals))
        rows = np.flatnonzero(answer.open > 0.0)
        if not len(rows):
            return answer
        bundle = self._bundle(tiles, rows, task.samples, task)
        method = task.method
        if method.startswith("camera"):
            raise OptionError(f"method: found {method!r} for the linear light {light.name!r}; cameras see areas only")
        if method == "exact" and self._through.any():
            raise InputError("method: found 'exact' for a linear light behind panes; use 'rays'")
        if method in ("exact", "shaft", "auto") and not self._through.any():
            bundle = replace(bundle, lift=4.0 * task.slack)  # exact: rounding only
            pieces = self._pieces_toward(bundle.place, np.stack([light.start, light.end]), task)
            found = visible_linear_irradiance(
                self.geometry, bundle.place, bundle.normals, light.start, light.end, lambertian=light.lambertian,
                skip_polygons=bundle.skip(-1), pieces=pieces, workers=self.workers,
            )  # fmt: skip
            answer.seen[rows] = found.irradiance
            answer.state[rows[found.visible_length == 1.0]] = OcclusionState.NOT_INSHADOW
            answer.state[rows[found.irradiance == 0.0]] = OcclusionState.INSHADOW
            answer.candidates[rows] = len(pieces)
            return answer
        if method == "adaptive":
            share, doubt = _sampled.adaptive_linear_shares(self.grid, bundle, light, task.counters)
        else:
            share, doubt = _sampled.linear_shares(
                self.grid, bundle, light, method == "rays+plane-vertex", task.counters
            )
        answer.seen[rows] = share * answer.open[rows]
        answer.doubt[rows] = doubt * answer.open[rows]
        return answer

    def _pieces_toward(self, points: FloatArray, light: FloatArray, task: _Task) -> IntArray:
        """Pieces whose boxes meet the shaft from the box of all points to that of a light."""
        planes = np.empty((MAX_SHAFT_PLANES, 4))
        used = box_shaft(points.min(axis=0), points.max(axis=0), light.min(axis=0), light.max(axis=0), planes)
        found, tally = np.empty(self.geometry.piece_count, dtype=np.int64), new_tally()
        many = boxes_meeting_planes(*self._tree, planes, used, 4.0 * task.slack, found, tally)
        add_tally(task.counters, tally)
        return np.sort(found[:many])

    def _sphere(self, tiles: Tiles, light: SphereLight, task: _Task) -> _Answer:
        """A sphere: from each point a disk of its own; rays to the cap that it sees."""
        answer = _Answer.sampled(light.unit_irradiance(tiles.points, tiles.normals))
        rows = np.flatnonzero(answer.open > 0.0)
        if task.method == "exact":
            answer.candidates[:] = 0
            owners, polygon = self._owners(light.polygons)
            part, tally = np.zeros(len(tiles.points)), new_tally()
            for i in rows.tolist():
                toward = light.centre - tiles.points[i]
                distance = float(np.linalg.norm(toward))
                square = (light.radius / distance) ** 2
                normal = -toward / distance
                ring = _round_ring(
                    tiles.points[i] + (1.0 - square) * toward, light.radius * math.sqrt(1.0 - square), normal
                )
                (x, y, z), (nx, ny, nz) = tiles.points[i], tiles.normals[i]
                part[i] = lambert_piece(x, y, z, nx, ny, nz, ring, 0, len(ring))
                _settle.exact_points(
                    np.array([i]), tiles.points, tiles.normals, tiles.own, ring, 0, len(ring), normal, polygon,
                    self.geometry.corners, self.geometry.piece_start, owners, self._through, *self._tree, task.slack,
                    answer.seen, answer.doubt, tally,
                )  # fmt: skip
            add_tally(task.counters, tally)
            scale = answer.open[rows] / np.where(part[rows] > 0.0, part[rows], 1.0)
            cut = answer.seen[rows] < part[rows]
            answer.seen[rows] *= scale
            answer.doubt[rows] = answer.doubt[rows] * scale + np.where(cut, ROUND_ERROR * answer.open[rows], 0.0)
            answer.state[rows[answer.seen[rows] == 0.0]] = OcclusionState.INSHADOW
            return answer
        if task.method in ("rays+plane-vertex", "adaptive") or task.method.startswith("camera"):
            raise OptionError(f"method: found {task.method!r} for the sphere {light.name!r}; use rays, auto or exact")
        count = _rays_for(task.error) if task.method == "auto" else task.samples
        share, doubt = _sampled.sender_shares(self.grid, self._bundle(tiles, rows, count, task), light, task.counters)
        answer.seen[rows] = share * answer.open[rows]
        answer.doubt[rows] = doubt * answer.open[rows]
        return answer

    # ---- polygons -----------------------------------------------------------------------------

    def _owners(self, polygons: IntArray) -> tuple[IntArray, int]:
        """The polygon of each piece, all polygons of a light under one number, and that number."""
        owners = self.geometry.piece_polygon
        if len(polygons) > 1:
            owners = np.where(np.isin(owners, polygons), polygons[0], owners)
        return owners, int(polygons[0]) if len(polygons) else -1

    def _side(self, tiles: Tiles, pieces: list[FloatArray], polygons: IntArray, task: _Task) -> _Answer:
        """One emitting side of a flat light, given as convex pieces."""
        normal = vector_area(pieces[0])
        normal /= np.linalg.norm(normal)
        if task.method.startswith("camera"):
            return self._camera(tiles, pieces, normal, polygons, task)
        owners, polygon = self._owners(polygons)
        n = len(tiles.points)
        whole, seen, doubt = np.zeros(n), np.zeros(n), np.zeros(n)
        waiting_parts: list[tuple[FloatArray, IntArray, FloatArray, _Pilot | None]] = []
        lit, dark = np.ones(n, dtype=bool), np.ones(n, dtype=bool)
        candidates = np.full(n, -1 if task.method in _UNCULLED else 0, dtype=np.int64)
        for ring in pieces:
            begin = time.perf_counter()
            pilot = None
            found = self._settle(tiles, ring, normal, owners, polygon, task)
            task.seconds["settle"] = task.seconds.get("settle", 0.0) + time.perf_counter() - begin
            if task.method == "auto":
                waiting = np.flatnonzero(found.state == _settle.STATE_COMPLEX)
                if len(waiting):
                    pilot = self._pilot(tiles, ring, normal, polygon, found, waiting, task)
                    self._finish(tiles, ring, normal, owners, polygon, found, pilot, task)
            whole += found.part
            if task.method not in _UNCULLED:
                candidates += found.candidates
            waiting = np.flatnonzero(found.state == _settle.STATE_COMPLEX)
            known = np.ones(n, dtype=bool)
            if task.method == "exact":
                begin = time.perf_counter()
                self._cut(tiles, waiting, ring, normal, owners, polygon, found.share, doubt, task)
                task.seconds["cut"] = task.seconds.get("cut", 0.0) + time.perf_counter() - begin
            else:
                known[waiting] = False
                waiting_parts.append((ring, waiting, found.part, pilot))
            seen[known] += found.share[known]
            doubt += found.doubt
            lit &= (found.state == _settle.STATE_CLEAR) | (found.part == 0.0)
            dark &= known & (found.share == 0.0) & (found.state != _settle.STATE_SAMPLED)
        for ring, waiting, part, pilot in waiting_parts:
            if len(waiting):
                begin = time.perf_counter()
                self._trace(tiles, waiting, ring, normal, polygon, part, seen, doubt, pilot, task)
                task.seconds["rays"] = task.seconds.get("rays", 0.0) + time.perf_counter() - begin
        state = np.full(n, OcclusionState.COMPLEX_SHADOW, dtype=np.int8)
        state[lit] = OcclusionState.NOT_INSHADOW
        state[dark] = OcclusionState.INSHADOW
        return _Answer(whole, seen, doubt, state, candidates)

    def _settle(
        self, tiles: Tiles, ring: FloatArray, normal: FloatArray, owners: IntArray, own: int, task: _Task
    ) -> _Settled:
        """Form factors to a convex piece, unoccluded and (where known) visible, states, candidates left."""
        culled = task.method not in _UNCULLED
        found = _Settled.empty(len(tiles.points))
        # 0: only the open form factors are asked for.
        counts = np.full(len(tiles.start) - 1, -1 if culled else 0, dtype=np.int64)
        self._settle_tiles(
            tiles, ring, normal, owners, own, counts, found, task, 64 if task.method == "exact" else CUT_LIMIT,
            len(tiles.points), list_first=culled,
        )  # fmt: skip
        if not culled:
            found.state[found.state == _settle.STATE_CLEAR] = _settle.STATE_COMPLEX
        return found

    def _settle_tiles(
        self, tiles: Tiles, ring: FloatArray, normal: FloatArray, owners: IntArray, own: int, counts: IntArray,
        found: _Settled, task: _Task, limit: int, load: int, *, list_first: bool = False,
    ) -> None:  # fmt: skip
        """Settle tiles by their candidates, cutting up to ``limit``: as listed in ``counts`` or as shafts find them.

        ``load`` points are asked, about: so few that one thread settles them, or more.
        """
        geo = self.geometry
        count = len(counts)
        lists = np.empty((count if list_first else 0, _settle.MAX_CANDIDATES), dtype=np.int64)
        low, high = ring.min(axis=0), ring.max(axis=0)

        def work(first: int, last: int) -> NDArray[np.int64]:
            tally = new_tally()
            if list_first:
                _settle.tile_candidates(
                    tiles.bounds, tiles.normal, tiles.offset, tiles.polygon, first, last, ring, low, high, normal, own,
                    geo.corners, geo.piece_start, owners, *self._tree, task.slack, lists, counts, tally,
                )  # fmt: skip
                if task.method == "auto":
                    here = counts[first:last]
                    here[(here < 0) | (here > LIST_LIMIT)] = _settle.LATER
            _settle.settle_points(
                tiles.points, tiles.normals, tiles.own, tiles.start, first, last, ring, 0, len(ring), normal, own,
                geo.corners, geo.piece_start, owners, self._through, *self._tree, task.slack, limit, lists,
                counts, found.share, found.part, found.state, found.candidates, tally,
            )  # fmt: skip
            return tally

        for tally in self._blocks(
            work, count, min(64, -(-load // (BLOCK_POINTS if limit == CUT_LIMIT else CUT_POINTS)))
        ):
            if task.method in _UNCULLED:
                task.counters.add(closed_forms=tally[CLOSED])
            else:
                add_tally(task.counters, tally)

    def _blocks(self, work: Callable[[int, int], NDArray[np.int64]], count: int, most: int) -> list[IntArray]:
        """Tallies of ``work(first, last)`` over ``most`` equal ranges of ``count`` rows, on all workers."""
        step = max(1, -(-count // most))
        ranges = [(first, min(first + step, count)) for first in range(0, count, step)]
        return self.spread(lambda each: work(*each), ranges)

    def _finish(
        self, tiles: Tiles, ring: FloatArray, normal: FloatArray, owners: IntArray, own: int, found: _Settled,
        pilot: _Pilot, task: _Task,
    ) -> None:  # fmt: skip
        """``auto`` at the points that ``found`` leaves: cuts or lines, or nothing where rays are cheaper.

        Each tile gets what its candidates, the asked error and the number of its points make cheapest.
        """
        waiting = np.flatnonzero(found.state == _settle.STATE_COMPLEX)
        allowed = self._allowed(found.part, waiting, pilot.mean, task)
        worth = (VOXEL_NS if self._through.any() else RAY_NS) * pilot.rays(MARGIN * ALONE_NOISE * allowed)
        allowed *= LINE_MARGIN
        tile = tiles.of(waiting)
        chosen, first, held = np.unique(tile, return_index=True, return_counts=True)
        few = np.minimum(held, RAYED)
        flat = (tiles.normal[chosen] != 0.0).any(axis=1)
        rayed = np.where(flat, np.minimum(worth * held, worth * few + FIT_NS * held), worth * held)
        lined = TILE_NS + POINT_NS * few
        other = np.minimum(rayed, lined)
        cut = np.where((held * CUT_NS < other) & (CROWD_LIMIT > CUT_LIMIT), 0.0, np.inf)
        begin = time.perf_counter()
        for parts in ((0.5,), (0.2, 0.8)):  # the middle of each tile, and more of it where there is hope
            hopeful = np.flatnonzero(cut < other)
            if len(hopeful):
                rows = [waiting[first[hopeful] + (held[hopeful] * part).astype(np.int64)] for part in parts]
                kept = self._crowds(tiles, ring, normal, owners, own, np.concatenate(rows), task)
                price = np.where(kept <= CROWD_LIMIT, CUT_NS + KEPT_NS * kept, np.inf).reshape(len(parts), -1)
                cut[hopeful] += held[hopeful] * price.sum(axis=0) / 3.0
        short = chosen[cut < other]
        if len(short):
            self._cut_tiles(tiles, ring, normal, owners, own, short, found, task, int(held.sum()))
            left = np.isin(chosen, np.unique(tiles.of(np.flatnonzero(found.state == _settle.STATE_COMPLEX))))
            chosen, rayed = chosen[left], rayed[left]
        task.seconds["crowds"] = task.seconds.get("crowds", 0.0) + time.perf_counter() - begin
        ready = ring.tobytes() in self._frames
        if len(chosen) and rayed.sum() > self.geometry.piece_count * (PREPARED_NS if ready else PREPARE_NS):
            begin = time.perf_counter()
            self._draw_lines(tiles, ring, normal, owners, own, found, chosen, allowed, worth, task)
            task.seconds["lines"] = task.seconds.get("lines", 0.0) + time.perf_counter() - begin

    def _pilot(
        self, tiles: Tiles, ring: FloatArray, normal: FloatArray, own: int, found: _Settled, waiting: IntArray,
        task: _Task,
    ) -> _Pilot:  # fmt: skip
        """A few rays at some of the waiting points."""
        some = waiting[:: max(1, len(waiting) // PILOT_POINTS)]
        share, doubt = self._sample(tiles, some, PILOT_RAYS, ring, normal, own, task)
        known = float(found.share[found.state != _settle.STATE_COMPLEX].sum())
        mean = (known + float((share * found.part[some]).mean()) * len(waiting)) / len(found.state)
        return _Pilot(mean, math.sqrt(float((doubt**2).mean())))

    def _cut_tiles(
        self, tiles: Tiles, ring: FloatArray, normal: FloatArray, owners: IntArray, own: int, chosen: IntArray,
        found: _Settled, task: _Task, load: int,
    ) -> None:  # fmt: skip
        """Cut long lists at the ``load`` points of chosen tiles that wait."""
        counts = np.full(len(tiles.start) - 1, _settle.PASSED, dtype=np.int64)
        counts[chosen] = -1
        self._settle_tiles(tiles, ring, normal, owners, own, counts, found, task, CROWD_LIMIT, load)

    def _crowds(
        self, tiles: Tiles, ring: FloatArray, normal: FloatArray, owners: IntArray, own: int, some: IntArray,
        task: _Task,
    ) -> IntArray:  # fmt: skip
        """Candidates at some points, one more than ``CROWD_LIMIT`` for a longer list or more pieces than can be cut."""
        trial = _Settled.empty(len(tiles.points))
        trial.state[:] = _settle.STATE_CLEAR
        trial.state[some] = _settle.STATE_COMPLEX
        self._cut_tiles(tiles, ring, normal, owners, own, np.unique(tiles.of(some)), trial, task, len(some))
        return np.where(trial.state[some] == _settle.STATE_COMPLEX, CROWD_LIMIT + 1, trial.candidates[some])

    def _frame(self, ring: FloatArray, normal: FloatArray) -> SenderFrame:
        """The geometry in a sender's frame; those of the last few senders are kept."""
        key = ring.tobytes()
        frame = self._frames.pop(key, None)
        if frame is None:
            frame = SenderFrame.build(self.geometry, self._edges, ring, normal)
        self._frames[key] = frame
        while len(self._frames) > max(1, min(FRAMES, FRAMED_PIECES // max(self.geometry.piece_count, 1))):
            self._frames.pop(next(iter(self._frames)))
        return frame

    def _draw_lines(
        self, tiles: Tiles, ring: FloatArray, normal: FloatArray, owners: IntArray, own: int, found: _Settled,
        chosen: IntArray, allowed: float, worth: float, task: _Task,
    ) -> None:  # fmt: skip
        """Lines over the sender in chosen tiles, as many as the error asks."""
        edges = self._edges
        frame = self._frame(ring, normal)
        tree = self._tree
        sender = (ring, ring.min(axis=0), ring.max(axis=0), normal, own, frame.width)
        table = (
            self.geometry.piece_start, owners, self._through, edges.vertex, edges.edge, edges.ends, edges.piece,
            edges.turn,
        )  # fmt: skip
        axes = (frame.origin, frame.axes, frame.ring, frame.place, frame.plane, frame.height)
        spread = (
            tiles.points, tiles.normals, tiles.order, tiles.own, tiles.flat, tiles.start, tiles.bounds, tiles.normal,
            tiles.offset, tiles.polygon,
        )  # fmt: skip
        answer = (found.part, found.share, found.doubt, found.state, found.candidates)
        fewest = min(max(math.ceil((USUAL_NOISE / allowed) ** (2.0 / 3.0)), 4), MAX_LINES)

        def work(first: int, last: int) -> NDArray[np.int64]:
            tally = new_tally()
            line_tiles(
                chosen[first:last], spread, sender, table, axes, tree, task.slack, fewest, min(16 * fewest, MAX_LINES),
                allowed, worth, task.seed, CUT_LIMIT, answer, tally,
            )  # fmt: skip
            return tally

        # Each block makes marks for all pieces.
        for tally in self._blocks(work, len(chosen), min(8 * self.workers, max(self.workers, len(chosen) // 4))):
            add_tally(task.counters, tally)

    @staticmethod
    def _allowed(part: FloatArray, waiting: IntArray, mean: float, task: _Task) -> float:
        """Error that the shares of the waiting points may have, for the error asked of the mean of all."""
        mean = max(mean, LEAST_MEAN * float(part.mean()))
        weight = math.sqrt(float((part[waiting] ** 2).sum()) / len(part))
        return min(max(task.error * mean / weight, 1e-5), 0.25)

    def _cut(
        self, tiles: Tiles, waiting: IntArray, ring: FloatArray, normal: FloatArray, owners: IntArray, own: int,
        share: FloatArray, doubt: FloatArray, task: _Task,
    ) -> None:  # fmt: skip
        """Exact cuts at crowded points, the light quartered as far as needed."""
        geo = self.geometry
        unsure = np.zeros(len(tiles.points))

        def work(block: IntArray) -> NDArray[np.int64]:
            tally = new_tally()
            _settle.exact_points(
                block, tiles.points, tiles.normals, tiles.own, ring, 0, len(ring), normal, own, geo.corners,
                geo.piece_start, owners, self._through, *self._tree, task.slack, share, unsure, tally,
            )  # fmt: skip
            return tally

        for tally in self.spread(work, np.array_split(waiting, max(1, len(waiting) // 256))):
            add_tally(task.counters, tally)
        doubt += unsure

    def _camera(
        self, tiles: Tiles, pieces: list[FloatArray], normal: FloatArray, polygons: IntArray, task: _Task
    ) -> _Answer:
        """Cameras at the points; what no camera sees well is cut exactly."""
        geo = self.geometry
        open_task = replace(task, method="rays")
        whole = np.zeros(len(tiles.points))
        for ring in pieces:
            whole += self._settle(tiles, ring, normal, geo.piece_polygon, -1, open_task).part
        answer = _Answer.sampled(whole)
        viewport = min(max(round(math.sqrt(task.samples)), 2), 1024)
        begin = time.perf_counter()
        found = camera_shadows(
            tiles.points, tiles.normals, pieces, geo, viewport=viewport,
            mode="naive" if task.method == "camera" else "optimised", own_polygon=tiles.own,
            ignore=polygons if len(polygons) else None, tree=self._box_tree, workers=self.workers,
        )  # fmt: skip
        task.counters.merge(found.counters)
        task.seconds["camera"] = task.seconds.get("camera", 0.0) + time.perf_counter() - begin
        known = ~found.fallback
        answer.seen[known] = found.visible_share[known] * answer.open[known]
        rendered = found.state == CameraState.RENDERED
        # Not jittered, which would move the frustum off the rim that states are judged by.
        answer.doubt[rendered] = found.doubt[rendered] * answer.open[rendered]
        facing = answer.open > 0.0
        answer.state[facing & (found.state == CameraState.NOT_INSHADOW)] = OcclusionState.NOT_INSHADOW
        answer.state[facing & (found.state == CameraState.INSHADOW)] = OcclusionState.INSHADOW
        rows = np.flatnonzero(found.fallback & facing)
        if len(rows):
            left = sort_into_tiles(tiles.points[rows], tiles.normals[rows], tiles.own[rows], geo.size)
            cut = self._side(left, pieces, polygons, replace(task, method="exact"))
            answer.seen[rows[left.order]] = cut.seen
            answer.doubt[rows[left.order]] = cut.doubt
            answer.state[rows[left.order]] = cut.state
        return answer

    def _sample(
        self, tiles: Tiles, rows: IntArray, count: int, ring: FloatArray, normal: FloatArray, polygon: int, task: _Task
    ) -> tuple[FloatArray, FloatArray]:
        """Visible shares of a convex piece by ``count`` rays a point, and their standard errors."""
        if not (task.method in ("adaptive", "rays+plane-vertex") or self._through.any()):
            tracer = self.tracer
            share = visible_shares(
                tracer, tiles.points[rows], tiles.normals[rows], tiles.order[rows], [ring], normal, count=count,
                seed=task.seed, workers=self.workers, spread=self.spread,
            )  # fmt: skip
            task.counters.add(rays=len(rows) * count)
            return share
        bundle = self._bundle(tiles, rows, count, task)
        if task.method == "adaptive":
            return _sampled.adaptive_shares(self.grid, bundle, ring, normal, polygon, task.counters)
        check = task.method == "rays+plane-vertex"
        return _sampled.woo_shares(self.grid, bundle, ring, normal, polygon, check, task.counters)

    def _smooth_sides(
        self, tiles: Tiles, chosen: IntArray, ring: FloatArray, normal: FloatArray, polygon: int, task: _Task
    ) -> FloatArray:
        """Sides (k,) of the squares of tiles over which the light blurs what lies between the nodes of a fit."""
        sides = np.empty(len(chosen))
        _settle.smooth_sides(
            chosen, tiles.bounds, tiles.normal, tiles.offset, tiles.polygon, ring, ring.min(axis=0), ring.max(axis=0),
            normal, polygon, sender_width(ring, normal), self.geometry.piece_polygon, *self._tree, task.slack, sides,
        )  # fmt: skip
        return sides * (BLUR / NODE_GAP)

    def _trace(
        self, tiles: Tiles, waiting: IntArray, ring: FloatArray, normal: FloatArray, polygon: int, part: FloatArray,
        seen: FloatArray, doubt: FloatArray, pilot: _Pilot | None, task: _Task,
    ) -> None:  # fmt: skip
        """Rays at the points that are left, all of them or as many as a smooth fit needs."""

        def sample(rows: IntArray, error: float) -> tuple[FloatArray, FloatArray]:
            assert pilot is not None
            return self._sample(tiles, waiting[rows], pilot.rays(error), ring, normal, polygon, task)

        count = task.samples
        if pilot is not None:
            # The error is asked of the irradiance over all points: what may a share here be off by?
            allowed = MARGIN * self._allowed(part, waiting, pilot.mean, task)
            count = pilot.rays(ALONE_NOISE * allowed)
        fitted = False
        if pilot is not None:
            # Rows of the complex points only, tile by tile.
            tile = tiles.of(waiting)
            edges = np.concatenate([[0], np.flatnonzero(np.diff(tile)) + 1, [len(waiting)]])
            spared = int(np.maximum(np.diff(edges) - RAYED, 0).sum())
            fitted = RAY_NS * count * spared > FILL_NS + FIT_NS * len(waiting)
        if fitted:
            share, spread = np.zeros(len(waiting)), np.zeros(len(waiting))
            sides = self._smooth_sides(tiles, tile[edges[:-1]], ring, normal, polygon, task)
            fill_smoothly(tiles.flat[waiting], edges[:-1], edges[1:], sides, sample, share, spread, error=allowed)
        else:
            share, spread = self._sample(tiles, waiting, count, ring, normal, polygon, task)
        seen[waiting] += share * part[waiting]
        doubt[waiting] += spread * part[waiting]


def estimate(
    points: ArrayLike,
    normals: ArrayLike,
    lights: AreaLight | Sender | Sequence[AreaLight | Sender],
    geometry: Geometry,
    method: str = "auto",
    *,
    error: float = 0.01,
    samples: int = 64,
    seed: int = 0,
    own_polygon: ArrayLike | None = None,
    workers: int | None = None,
) -> OcclusionEstimate:
    """Occlusion state, visible share and irradiance of points under lights of any kind.

    Parameters
    ----------
    points : (n, 3) float
    normals : (n, 3) or (3,) float
        Normals of the receiving side (any length but zero).
    lights : AreaLight, a sender of :mod:`workbench.shadow.lights`, or a sequence of them
    geometry : Geometry
        The occluders; a light may be one of its polygons.  A pane lets its mean transmittance
        over the bands pass.
    method : str
        ``rays`` -- ``samples`` rays at every point that faces the light, without culling.
        ``rays+plane-vertex`` -- the same rays through the instrument's voxels, polygons set aside by
        Woo's check; all is counted.
        ``adaptive`` -- Woo's adaptive linear light and its area counterpart: corners first, more where
        they differ, about ``samples`` rays where all differ.  Corners that agree are believed, so
        small shadows are missed; the standard error allows for a tenth of the light.
        ``camera``, ``camera-optimised`` -- pictures of the light with ``samples`` pixels, at every point
        or only where the plane-vertex check leaves occluders; exact cuts where no camera sees well.
        ``shaft`` -- shafts and light pyramids first, exact cuts of short lists, rays for the rest.
        ``exact`` -- every point cut exactly, the light quartered where it is crowded.
        ``auto`` -- shafts and light pyramids first, exact cuts of short lists; past longer ones what is
        cheapest in each tile at the asked ``error``: exact cuts, lines over the light cut by silhouettes
        (:mod:`workbench.shadow.silhouette`), or rays, which panes need.  Where the light blurs all that lies
        between them, some points of a flat tile stand for the others by a cubic fit that foretells each of them.

        Lights without extent are settled by their one ray, whatever the method.  Linear lights are
        exact by ``exact``, ``shaft`` and ``auto``.  A disk is sampled, cut and drawn as a regular polygon
        of 24 corners and its area, off by at most 0.0022 of the disk; from a sphere ``exact``
        cuts the disk that each point sees, other methods shoot rays.
    error : float
        ``auto``: wanted error, root mean square over the points, relative to their mean irradiance
        (or to a twentieth of the unoccluded one, if that is more).
    samples : int
        Rays a point and convex piece of a light, or pixels a picture.
    seed : int
    own_polygon : (n,) int or int, optional
        Polygon of the geometry on which each point lies, which never shadows it; -1 for none.
    workers : int, optional

    Returns
    -------
    OcclusionEstimate

    Raises
    ------
    InputError, OptionError
        If an argument has another shape or lies out of range, or a method does not know a light:
        cameras see no panes and no lines, and a sphere has no edges to check.
    """
    return Shader(geometry, workers).estimate(
        points, normals, lights, method, error=error, samples=samples, seed=seed, own_polygon=own_polygon
    )
