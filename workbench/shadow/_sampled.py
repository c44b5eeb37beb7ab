"""Shares of a light seen by rays of the instrument: Woo's loops, his adaptive light, single rays.

Each function answers for a bundle of points and returns their visible shares, with the standard
errors of those shares.  Both ends of the rays are moved off their surfaces by ``lift``, whatever
polygons are excluded by identity: sensors may lie on surfaces that nobody named.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.accel.voxel_grid import VoxelGrid
from workbench.counters import Counters
from workbench.shadow.lights import LinearLight, PolygonLight, Sender
from workbench.shadow.rays import sender_samples, unit_samples, weighted_shares
from workbench.shadow.woo import (
    LightOcclusion,
    adaptive_area_occlusion,
    adaptive_linear_occlusion,
    irradiance_weights,
    light_occlusion,
)

__all__ = ["Bundle", "adaptive_linear_shares", "adaptive_shares", "linear_shares", "sender_shares", "woo_shares"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

UNSEEN = 0.1
"""Share of a part of a light that corners which agree miss, root mean square under random triangles."""
UNSEEN_LINE = 0.15
"""The same for a half of a linear light and its ends."""
STEP_NOISE = 0.7
"""Steps by which even samples of a line are off: each of a few ends of shadows by 0.29 of one."""
_RAYS = 1 << 17
"""Rays a block of points: bounds the memory, not the answer."""
_END = 1.0 - 1e-9
"""Rays toward a curved light end this far along: its facets in the geometry begin there."""


@dataclass(frozen=True)
class Bundle:
    """Points that ask for the same light, and how.

    Parameters
    ----------
    points, normals : (n, 3) float
    index : (n,) int
        Number of each point; its random numbers depend on it and on ``seed`` alone.
    own : (n,) int
        Polygon on which each point lies, -1 for none.
    count, seed, workers : int
    lift : float
        Distance by which ends of rays are moved along the normals. [scene lengths]
    """

    points: FloatArray
    normals: FloatArray
    index: IntArray
    own: IntArray
    count: int
    seed: int
    workers: int
    lift: float

    @property
    def place(self) -> FloatArray:
        """Where the rays begin."""
        return self.points + self.lift * self.normals

    def skip(self, light: int) -> IntArray:
        """(n, 2): each point's own polygon and the light's."""
        return np.column_stack([self.own, np.full(len(self.own), light)])


def _in_blocks(
    bundle: Bundle, ask: Callable[[slice, FloatArray], tuple[FloatArray, FloatArray]]
) -> tuple[FloatArray, FloatArray]:
    """Shares and errors from ``ask(rows, unit)``, which gives weights (n, k) and what passes (n, k)."""
    count = len(bundle.points)
    share, doubt = np.zeros(count), np.zeros(count)
    step = max(1, _RAYS // bundle.count)
    for first in range(0, count, step):
        rows = slice(first, min(first + step, count))
        weights, through = ask(rows, unit_samples(bundle.index[rows], bundle.count, bundle.seed))
        rays = weights.shape[1]
        weighted_shares(
            0, len(weights), rays, np.ascontiguousarray(weights).ravel(), np.ascontiguousarray(through).ravel(),
            share[rows], doubt[rows],
        )  # fmt: skip
    return share, doubt


def _passed(found: LightOcclusion, counters: Counters) -> FloatArray:
    counters.merge(found.counters)
    assert found.transmitted is not None
    return found.transmitted.mean(axis=2)


def woo_shares(
    grid: VoxelGrid, bundle: Bundle, ring: FloatArray, normal: FloatArray, polygon: int, check: bool, counters: Counters
) -> tuple[FloatArray, FloatArray]:
    """A convex polygon by K rays a point through voxels, with or without the plane-vertex check."""
    lifted = ring + bundle.lift * normal
    place, skip = bundle.place, bundle.skip(polygon)

    def ask(rows: slice, unit: FloatArray) -> tuple[FloatArray, FloatArray]:
        targets = sender_samples(lifted, unit)
        found = light_occlusion(
            grid, place[rows], lifted, targets, check=check, skip_polygons=skip[rows], workers=bundle.workers
        )
        weights = irradiance_weights(place[rows], bundle.normals[rows], targets, light_normal=normal)
        return weights, _passed(found, counters)

    return _in_blocks(bundle, ask)


def linear_shares(
    grid: VoxelGrid, bundle: Bundle, light: LinearLight, check: bool, counters: Counters
) -> tuple[FloatArray, FloatArray]:
    """A linear light by K rays a point through voxels: even steps from a random start."""
    ends = np.stack([light.start, light.end])
    place, skip = bundle.place, bundle.skip(-1)
    axis = light.end - light.start

    def ask(rows: slice, unit: FloatArray) -> tuple[FloatArray, FloatArray]:
        along = (np.arange(bundle.count) + unit[:, :1, 0]) / bundle.count
        targets = light.start + along[..., None] * axis
        found = light_occlusion(
            grid, place[rows], ends, targets, check=check, skip_polygons=skip[rows], workers=bundle.workers
        )
        weights = irradiance_weights(
            place[rows], bundle.normals[rows], targets, light_axis=axis if light.lambertian else None
        )
        return weights, _passed(found, counters)

    share, _ = _in_blocks(bundle, ask)
    return share, np.full(len(share), STEP_NOISE / bundle.count)


def sender_shares(grid: VoxelGrid, bundle: Bundle, light: Sender, counters: Counters) -> tuple[FloatArray, FloatArray]:
    """Any light by the rays of its own sampler: K of a sphere, one of a light without extent."""
    place, skip = bundle.place, bundle.skip(int(light.polygons[0]) if len(light.polygons) == 1 else -1)

    def ask(rows: slice, unit: FloatArray) -> tuple[FloatArray, FloatArray]:
        rays = light.sample(place[rows], bundle.normals[rows], unit)
        origins = np.repeat(place[rows], rays.count, axis=0)
        before = dict(grid.counters)
        through = grid.transmitted(
            origins, rays.directions.reshape(-1, 3), rays.far * _END, np.repeat(skip[rows], rays.count, axis=0)
        )
        counters.add(**{name: total - before.get(name, 0) for name, total in grid.counters.items()})
        return rays.weights, through.mean(axis=1).reshape(rays.weights.shape)

    return _in_blocks(bundle, ask)


def _quads(ring: FloatArray) -> list[FloatArray]:
    """A convex polygon as quads (4, 3), each with its four quarters; a triangle gets a fourth corner."""
    quads = []
    for i in range(1, len(ring) - 1, 2):
        if i + 2 < len(ring):
            a, b, c, d = ring[0], ring[i], ring[i + 1], ring[i + 2]
        else:
            a, b, c, d = ring[0], ring[i], ring[i + 1], 0.5 * (ring[i + 1] + ring[0])
        middle = 0.25 * (a + b + c + d)
        ab, bc, cd, da = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + d), 0.5 * (d + a)
        quads += [
            np.stack(quarter)
            for quarter in ([a, ab, middle, da], [ab, b, bc, middle], [middle, bc, c, cd], [da, middle, cd, d])
        ]
    return quads


def _adaptive(
    bundle: Bundle, parts: list[tuple[FloatArray, LightOcclusion]], spans: int, unseen: float, counters: Counters
) -> tuple[FloatArray, FloatArray]:
    """Parts of a light put together, each counting by its closed form."""
    total, seen, square = np.zeros(len(bundle.points)), np.zeros(len(bundle.points)), np.zeros(len(bundle.points))
    for factor, found in parts:
        counters.merge(found.counters)
        hidden = found.occlusion.mean(axis=1)
        total += factor
        seen += factor * (1.0 - hidden)
        # A shadow's edge is known to half a cell, what lies between corners that agree is not known.
        square += (factor * np.where((hidden > 0.0) & (hidden < 1.0), 0.5 / spans, 0.0) + factor * unseen) ** 2
    scale = np.where(total > 0.0, total, 1.0)
    return seen / scale, np.sqrt(square) / scale


def adaptive_shares(
    grid: VoxelGrid, bundle: Bundle, ring: FloatArray, normal: FloatArray, polygon: int, counters: Counters
) -> tuple[FloatArray, FloatArray]:
    """A convex polygon by adaptive samples: corners of its quarters, then quadrants of each.

    About ``bundle.count`` rays where all is cut to the finest cells.  Inside a quarter the weights
    are equal, as in the paper; the quarters count by their closed forms.
    """
    most = max(1, round(math.log2(math.sqrt(bundle.count) / 2.0)))
    parts = []
    for quad in _quads(ring + bundle.lift * normal):
        factor = PolygonLight("", np.ones(1), quad).unit_irradiance(bundle.place, bundle.normals)
        found = adaptive_area_occlusion(
            grid, bundle.place, quad, levels=(0, most), skip_polygons=bundle.skip(polygon), workers=bundle.workers
        )
        parts.append((factor, found))
    return _adaptive(bundle, parts, 2**most, UNSEEN, counters)


def adaptive_linear_shares(
    grid: VoxelGrid, bundle: Bundle, light: LinearLight, counters: Counters
) -> tuple[FloatArray, FloatArray]:
    """A linear light by Woo's adaptive samples of its two halves: ends and middle first."""
    most = max(1, round(math.log2(bundle.count / 2.0))) if bundle.count > 2 else 1
    middle = 0.5 * (light.start + light.end)
    parts = []
    for ends in ((light.start, middle), (middle, light.end)):
        half = LinearLight("", np.ones(1), *ends, lambertian=light.lambertian)
        found = adaptive_linear_occlusion(
            grid, bundle.place, np.stack(ends), levels=(0, min(most, 16)), skip_polygons=bundle.skip(-1),
            workers=bundle.workers,
        )  # fmt: skip
        parts.append((half.unit_irradiance(bundle.place, bundle.normals), found))
    return _adaptive(bundle, parts, 2**most, UNSEEN_LINE, counters)
