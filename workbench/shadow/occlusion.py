"""The three occlusion states, and one question: how much of a light does each point receive?

A. Woo, "Efficient Shadow Computations in Ray Tracing" (IEEE CG&A 1993) marks a point, for one
light, as in shadow, not in shadow, or complex.  :func:`estimate` finds the state, the visible part
and the irradiance of points under polygonal area lights, by a method of choice.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.accel.box_tree import BoxTree
from workbench.accel.embree import EmbreeAccelerator
from workbench.arrays import as_points, as_unit_vectors
from workbench.counters import Counters
from workbench.culling.plane_vertex import CHECK_SLACK
from workbench.culling.tally import TALLY, add_tally, new_tally
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import check_polygon, convex_pieces, plane_basis, vector_area
from workbench.shadow import _settle
from workbench.shadow.rays import visible_shares
from workbench.shadow.smooth import fill_smoothly

__all__ = ["METHODS", "AreaLight", "OcclusionEstimate", "OcclusionState", "Shader", "estimate"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

METHODS = ("auto", "exact", "rays", "shaft")
"""Methods by name: see :func:`estimate`."""

TILE = 1024
"""Points a tile, about."""
NOISE = 0.64
"""Measured on a tessellated torus: K rays leave an error of NOISE K^-3/4 of a visible share."""
MARGIN = 1.3
"""Errors of neighbouring fits partly cancel: measured errors stay below the asked one by this."""
PILOT_POINTS = 256
"""Points that give a first idea of the mean irradiance."""
CUT_LIMIT = 12
"""Longest candidate list that ``auto`` and ``shaft`` cut exactly."""


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
        :class:`OcclusionState` of each point for each light.
    open_share, visible_share : (n, l) float
        Form factor from the point to the light, unoccluded and with its occluders. [0..1]
    irradiance : (n, bands) float
        [W m-2]
    standard_error : (n, bands) float
        Estimated error of the irradiance. [W m-2]
    counters : Counters
    seconds : dict
        Wall-clock seconds by stage.
    """

    state: NDArray[np.int8]
    open_share: FloatArray
    visible_share: FloatArray
    irradiance: FloatArray
    standard_error: FloatArray
    counters: Counters
    seconds: dict[str, float]


@dataclass(frozen=True)
class _Tiles:
    """Points sorted into tiles of neighbours on one plane."""

    order: IntArray
    points: FloatArray
    normals: FloatArray
    own: IntArray
    flat: FloatArray
    start: IntArray
    bounds: FloatArray
    normal: FloatArray
    offset: FloatArray
    polygon: IntArray


def _planes_of(points: FloatArray, normals: FloatArray, own: IntArray, size: float) -> IntArray:
    """Number (n,) of each point's plane: same normal, same offset, same polygon."""
    key = np.column_stack([np.round(normals * 1e9), np.round(np.einsum("ij,ij->i", points, normals) / size * 1e9), own])
    if (key == key[0]).all():
        return np.zeros(len(points), dtype=np.int64)
    return np.unique(key, axis=0, return_inverse=True)[1].ravel()


def _tiles(points: FloatArray, normals: FloatArray, own: IntArray, size: float) -> _Tiles:
    """Group points by plane, then by squares of that plane that hold about :data:`TILE` points."""
    plane = _planes_of(points, normals, own, size)
    count = int(plane.max()) + 1
    first = np.zeros(count, dtype=np.int64)
    first[plane[::-1]] = np.arange(len(points))[::-1]
    flat = np.empty((len(points), 2))
    cell = np.empty((len(points), 2), dtype=np.int64)
    if count > max(64, len(points) // 32):
        # Scattered sensors: hardly two on a plane, each a tile of its own.
        order = np.arange(len(points))
        start = np.arange(len(points) + 1)
        flat[:] = 0.0
    else:
        for number in range(count):
            inside = np.flatnonzero(plane == number)
            u, v = plane_basis(normals[first[number]])
            here = np.column_stack([points[inside] @ u, points[inside] @ v])
            low, extent = here.min(axis=0), np.ptp(here, axis=0)
            tiles = max(1, round(len(inside) / TILE))
            aspect = extent[0] / extent[1] if extent[1] > 0 else math.inf
            across = min(max(round(math.sqrt(tiles * min(aspect, tiles))), 1), tiles)
            counts = np.array([across, max(1, round(tiles / across))])
            scaled = (here - low) / np.where(extent > 0, extent, 1.0) * counts
            cell[inside] = np.minimum(scaled.astype(np.int64), counts - 1)
            flat[inside] = here
        key = (plane * (int(cell[:, 0].max()) + 1) + cell[:, 0]) * (int(cell[:, 1].max()) + 1) + cell[:, 1]
        order = np.argsort(key, kind="stable")
        start = np.concatenate([[0], np.flatnonzero(np.diff(key[order])) + 1, [len(points)]])
    moved = np.ascontiguousarray(points[order])
    bounds = np.stack([np.minimum.reduceat(moved, start[:-1]), np.maximum.reduceat(moved, start[:-1])], axis=1)
    ordered = np.ascontiguousarray(normals[order])
    lead = start[:-1]
    return _Tiles(
        order=order,
        points=moved,
        normals=ordered,
        own=np.ascontiguousarray(own[order]),
        flat=np.ascontiguousarray(flat[order]),
        start=start.astype(np.int64),
        bounds=np.ascontiguousarray(bounds),
        normal=np.ascontiguousarray(ordered[lead]),
        offset=np.einsum("ij,ij->i", ordered[lead], moved[lead]),
        polygon=np.ascontiguousarray(own[order][lead]),
    )


def _rays_for(error: float) -> int:
    """Rays at a point whose visible share is wanted to ``error``."""
    return int(min(max((NOISE / error) ** (4.0 / 3.0), 16), 65536))


class Shader:
    """A geometry made ready for many questions: box tree, Embree scene, threads.

    Parameters
    ----------
    geometry : Geometry
    workers : int, optional
        Threads, all cores by default; the answers do not depend on it.
    """

    def __init__(self, geometry: Geometry, workers: int | None = None) -> None:
        self.geometry = geometry
        self.workers = workers if workers is not None else len(os.sched_getaffinity(0))
        if self.workers < 1:
            raise OptionError(f"workers: found {workers}, expected 1 or more")
        self.tracer = EmbreeAccelerator(geometry)
        tree = BoxTree.build(geometry)
        self._slack = CHECK_SLACK * geometry.size
        self._through = np.ascontiguousarray(geometry.polygon_transmittance[geometry.piece_polygon])
        self._tree = (tree.low, tree.high, tree.skip, tree.first, tree.count, tree.order, geometry.piece_bounds)

    def estimate(
        self,
        points: ArrayLike,
        normals: ArrayLike,
        lights: AreaLight | Sequence[AreaLight],
        method: str = "auto",
        *,
        error: float = 0.01,
        samples: int = 64,
        seed: int = 0,
        own_polygon: ArrayLike | None = None,
    ) -> OcclusionEstimate:
        """See :func:`estimate`."""
        where, facing = as_points(points), as_unit_vectors(normals)
        if len(facing) == 1 and len(where) > 1:
            facing = np.repeat(facing, len(where), axis=0)
        if len(facing) != len(where):
            raise InputError(f"normals: found {len(facing)} rows for {len(where)} points")
        if method not in METHODS:
            raise OptionError(f"method: found {method!r}, expected one of {', '.join(METHODS)}")
        if not 0 < error < 1:
            raise OptionError(f"error: found {error}, expected a number between 0 and 1")
        if samples < 1:
            raise OptionError(f"samples: found {samples}, expected 1 or more")
        if method != "exact" and self._through.any():
            raise InputError(
                f"method: {method!r} traces opaque surfaces only and the scene has transparent ones; use 'exact'"
            )
        chosen = [lights] if isinstance(lights, AreaLight) else list(lights)
        own = np.full(len(where), -1, dtype=np.int64)
        if own_polygon is not None:
            own = np.ascontiguousarray(np.broadcast_to(np.asarray(own_polygon, dtype=np.int64), (len(where),)))
        counters = Counters()
        seconds: dict[str, float] = {}
        start = time.perf_counter()
        tiles = _tiles(where, facing, own, self.geometry.size)
        seconds["tiles"] = time.perf_counter() - start
        bands = max((len(light.radiance) for light in chosen), default=1)
        state = np.zeros((len(where), len(chosen)), dtype=np.int8)
        open_share, visible, doubt = (np.zeros((len(where), len(chosen))) for _ in range(3))
        for column, light in enumerate(chosen):
            found = self._one_light(tiles, light, method, error, samples, seed + column, counters, seconds)
            for target, values in zip((open_share, visible, doubt, state), found, strict=True):
                target[tiles.order, column] = values
        radiance = np.stack([np.broadcast_to(light.radiance, (bands,)) for light in chosen]) * math.pi
        variance = doubt**2 @ radiance**2
        return OcclusionEstimate(state, open_share, visible, visible @ radiance, np.sqrt(variance), counters, seconds)

    def _one_light(
        self,
        tiles: _Tiles,
        light: AreaLight,
        method: str,
        error: float,
        samples: int,
        seed: int,
        counters: Counters,
        seconds: dict[str, float],
    ) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.int8]]:
        polygon = as_points(light.polygon, "light")
        problem = check_polygon([polygon])
        if problem:
            raise InputError(f"light: found {problem}, expected a planar polygon with an area")
        pieces = convex_pieces([polygon])
        normal = vector_area(polygon)
        normal /= np.linalg.norm(normal)
        n = len(tiles.points)
        whole, seen, doubt = np.zeros(n), np.zeros(n), np.zeros(n)
        complex_parts: list[tuple[FloatArray, IntArray]] = []
        lit, dark = np.ones(n, dtype=bool), np.ones(n, dtype=bool)
        for ring in pieces:
            begin = time.perf_counter()
            part, share, state = self._settle(tiles, ring, normal, light.polygon_id, method, counters)
            seconds["settle"] = seconds.get("settle", 0.0) + time.perf_counter() - begin
            whole += part
            waiting = np.flatnonzero(state == _settle.STATE_COMPLEX)
            if len(waiting) and method == "exact":
                begin = time.perf_counter()
                self._cut(tiles, waiting, ring, normal, light.polygon_id, share, doubt, counters)
                seconds["cut"] = seconds.get("cut", 0.0) + time.perf_counter() - begin
                waiting = waiting[:0]
            known = state != _settle.STATE_COMPLEX if method != "exact" else np.ones(n, dtype=bool)
            seen[known] += share[known]
            lit &= (state == _settle.STATE_CLEAR) | (part == 0.0)
            dark &= (state == _settle.STATE_DARK) | (known & (share == 0.0))
            if len(waiting):
                complex_parts.append((ring, waiting))
        for ring, waiting in complex_parts:
            begin = time.perf_counter()
            part = whole if len(pieces) == 1 else self._open(tiles, ring, normal)
            self._trace(
                tiles, waiting, ring, normal, method, error, samples, seed, part, seen, doubt, counters
            )  # fmt: skip
            seconds["rays"] = seconds.get("rays", 0.0) + time.perf_counter() - begin
        state = np.full(n, OcclusionState.COMPLEX_SHADOW, dtype=np.int8)
        state[lit] = OcclusionState.NOT_INSHADOW
        state[dark] = OcclusionState.INSHADOW
        return whole, seen, doubt, state

    def _settle(
        self, tiles: _Tiles, ring: FloatArray, normal: FloatArray, own: int, method: str, counters: Counters
    ) -> tuple[FloatArray, FloatArray, NDArray[np.int8]]:
        """Unoccluded and (where known) visible form factors to one convex piece, and states."""
        geo = self.geometry
        n, count = len(tiles.points), len(tiles.start) - 1
        part, share = np.zeros(n), np.zeros(n)
        state = np.zeros(n, dtype=np.int8)
        counts = np.full(count, -1, dtype=np.int64)
        lists = np.empty((count, _settle.MAX_CANDIDATES), dtype=np.int64)
        low, high = ring.min(axis=0), ring.max(axis=0)
        limit = CUT_LIMIT if method in ("auto", "shaft") else (64 if method == "exact" else 0)
        step = max(1, -(-count // 64))
        if method == "rays":
            counts[:] = 0  # brute force knows no candidates: it asks for the open form factors only

        def work(first: int) -> NDArray[np.int64]:
            last = min(first + step, count)
            tally = new_tally()
            if method != "rays":
                _settle.tile_candidates(
                    tiles.bounds, tiles.normal, tiles.offset, tiles.polygon, first, last, ring, low, high, normal, own,
                    geo.corners, geo.piece_start, geo.piece_polygon, *self._tree, self._slack, lists, counts, tally,
                )  # fmt: skip
            _settle.settle_points(
                tiles.points, tiles.normals, tiles.own, tiles.start, first, last, ring, 0, len(ring), normal, own,
                geo.corners, geo.piece_start, geo.piece_polygon, self._through, *self._tree, self._slack, limit, lists,
                counts, share, part, state, tally,
            )  # fmt: skip
            return tally

        with ThreadPoolExecutor(self.workers) as pool:
            for tally in pool.map(work, range(0, count, step)):
                found = dict(zip(TALLY, tally.tolist(), strict=True))
                counters.add(**({"closed_forms": found["closed_forms"]} if method == "rays" else found))
        if method == "rays":
            state[state == _settle.STATE_CLEAR] = _settle.STATE_COMPLEX
        return part, share, state

    def _cut(
        self, tiles: _Tiles, waiting: IntArray, ring: FloatArray, normal: FloatArray, own: int, share: FloatArray,
        doubt: FloatArray, counters: Counters,
    ) -> None:  # fmt: skip
        """Exact cuts at crowded points, the light quartered as far as needed."""
        geo = self.geometry

        def work(block: IntArray) -> NDArray[np.int64]:
            tally = new_tally()
            _settle.exact_points(
                block, tiles.points, tiles.normals, tiles.own, ring, 0, len(ring), normal, own, geo.corners,
                geo.piece_start, geo.piece_polygon, self._through, *self._tree, self._slack, share, doubt, tally,
            )  # fmt: skip
            return tally

        with ThreadPoolExecutor(self.workers) as pool:
            for tally in pool.map(work, np.array_split(waiting, max(1, len(waiting) // 256))):
                add_tally(counters, tally)

    def _trace(
        self, tiles: _Tiles, waiting: IntArray, ring: FloatArray, normal: FloatArray, method: str, error: float,
        samples: int, seed: int, part: FloatArray, seen: FloatArray, doubt: FloatArray, counters: Counters,
    ) -> None:  # fmt: skip
        """Rays at the points that are left, all of them or as many as a smooth fit needs."""
        n = len(tiles.points)
        share, spread = np.zeros(n), np.zeros(n)

        def sample(rows: IntArray, count: int) -> FloatArray:
            value, half = visible_shares(
                self.tracer, tiles.points[rows], tiles.normals[rows], tiles.order[rows], [ring], normal, count=count,
                seed=seed, workers=self.workers,
            )  # fmt: skip
            counters.add(rays=len(rows) * count)
            spread[rows] = half
            return value

        if method == "auto":
            # The error is asked of the irradiance over all points: what may a share here be off by?
            pilot = waiting[:: max(1, len(waiting) // PILOT_POINTS)]
            mean = (seen.sum() + float((sample(pilot, 16) * part[pilot]).mean()) * len(waiting)) / n
            weight = math.sqrt(float((part[waiting] ** 2).sum()) / n)
            allowed = min(max(MARGIN * error * mean / weight, 1e-5), 0.25)
            # Rows of the complex points only, tile by tile.
            tile = np.searchsorted(tiles.start, waiting, side="right") - 1
            edges = np.concatenate([[0], np.flatnonzero(np.diff(tile)) + 1, [len(waiting)]])
            local, fitted = np.zeros(len(waiting)), np.zeros(len(waiting))
            fill_smoothly(
                tiles.flat[waiting], edges[:-1], edges[1:], lambda rows, to: sample(waiting[rows], _rays_for(to)),
                local, fitted, error=allowed,
            )  # fmt: skip
            share[waiting], spread[waiting] = local, fitted
        else:
            share[waiting] = sample(waiting, samples)
        seen[waiting] += share[waiting] * part[waiting]
        doubt[waiting] += spread[waiting] * part[waiting]

    def _open(self, tiles: _Tiles, ring: FloatArray, normal: FloatArray) -> FloatArray:
        """Unoccluded form factors to one convex piece."""
        part, _, _ = self._settle(tiles, ring, normal, -1, "rays", Counters())
        return part


def estimate(
    points: ArrayLike,
    normals: ArrayLike,
    lights: AreaLight | Sequence[AreaLight],
    geometry: Geometry,
    method: str = "auto",
    *,
    error: float = 0.01,
    samples: int = 64,
    seed: int = 0,
    own_polygon: ArrayLike | None = None,
    workers: int | None = None,
) -> OcclusionEstimate:
    """Occlusion state, visible share and irradiance of points under polygonal area lights.

    Parameters
    ----------
    points : (n, 3) float
    normals : (n, 3) or (3,) float
        Normals of the receiving side (any length but zero).
    lights : AreaLight or sequence of them
    geometry : Geometry
        The occluders; a light may be one of its polygons.
    method : str
        ``rays`` -- ``samples`` rays at every point that faces the light, without culling.
        ``shaft`` -- shafts and light pyramids first, exact cuts of short lists, rays for the rest.
        ``exact`` -- every point cut exactly, the light quartered where it is crowded.
        ``auto`` -- as ``shaft``, with as many rays as ``error`` asks, and only at as many points of a
        tile as a smooth fit needs.
    error : float
        ``auto``: wanted error, root mean square over the points, relative to their mean irradiance.
    samples : int
        ``rays`` and ``shaft``: rays a point.
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
        If an argument has another shape or lies out of range.
    """
    return Shader(geometry, workers).estimate(
        points, normals, lights, method, error=error, samples=samples, seed=seed, own_polygon=own_polygon
    )
