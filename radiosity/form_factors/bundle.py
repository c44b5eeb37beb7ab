"""Receiver bundles: form factors from every element to a shooting patch.

J. R. Wallace, K. A. Elmquist and E. A. Haines, "A ray tracing algorithm for progressive radiosity"
(SIGGRAPH 1989), shoot rays from each receiver toward the shooting patch, an area light.  Here most
receivers never need them: facing, shafts and light pyramids settle them, short candidate lists are
cut exactly (:mod:`radiosity.form_factors._links`), and only the rest gets rays, whose
cosine-weighted visible share scales the closed form.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from radiosity.form_factors._links import (
    CLUSTER_FAR,
    SAMPLES,
    MeshArrays,
    Workspace,
    box_distance,
    longest_ring,
    mesh_arrays,
    occluder_arrays,
    open_share,
    patch_extent,
    shoot,
    workspace,
)
from radiosity.form_factors._sampling import place_on_pieces, stream
from radiosity.patches import PatchMesh
from workbench.accel.box_tree import BoxTree
from workbench.accel.embree import BLOCK_RAYS, EmbreeAccelerator
from workbench.counters import Counters
from workbench.culling.tally import add_tally, new_tally
from workbench.errors import OptionError
from workbench.geometry.flat import Geometry
from workbench.geometry.planes import newell_normal

__all__ = ["ColumnFinder", "Columns", "LinkSettings", "ReceiverBundles"]

FloatArray = NDArray[np.float64]

GROUPS_A_TASK = 128
"""Receiving patches a task: fixed, so that nothing depends on the number of workers."""


@dataclass(frozen=True)
class LinkSettings:
    """How exactly form factors are found.

    Parameters
    ----------
    rays : int
        Rays a bundle, where rays decide.
    error : float
        Wanted error of an element's form factor to a patch, relative to it.
    floor : float, optional
        Wanted absolute error below which no form factor is refined; by default a tenth of
        ``error`` times an equal share among the patches.
    candidates : int
        Longest candidate list that is cut exactly.
    levels : int
        Largest number of halvings of an element in the search for shadow boundaries.
    closed_forms : bool
        Use the closed form for every unoccluded pair, not only for near ones.
    seed : int
        Of the rays' low-discrepancy shifts.
    """

    rays: int = 16
    error: float = 0.02
    floor: float | None = None
    candidates: int = 12
    levels: int = 4
    closed_forms: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if self.rays < 1:
            raise OptionError(f"rays: found {self.rays}, expected 1 or more")
        if not self.error > 0:
            raise OptionError(f"error: found {self.error}, expected a positive number")
        if not 0 <= self.levels <= 24:
            raise OptionError(f"levels: found {self.levels}, expected 0 to 24")


class ColumnFinder(Protocol):
    """What a solver asks of its bundles, whichever way they are shot."""

    mesh: PatchMesh
    settings: LinkSettings
    counters: Counters
    seconds_in_embree: float
    accelerator: EmbreeAccelerator

    def columns(self, patches: Sequence[int] | NDArray[np.int64], floors: FloatArray | None = None) -> Columns:
        """Form factors from all elements to each of ``patches``."""
        ...

    def take_counters(self) -> Counters:
        """The counts since this was last asked."""
        ...

    def close(self) -> None:
        """Stop the threads."""
        ...


@dataclass(frozen=True)
class Columns:
    """Form factors from all elements to some patches.

    ``factor`` (k, n): row ``j`` holds F from each element to patch ``patches[j]``, averaged over the
    element.  ``spread`` (k, n): its estimated error (quadrature difference, or one standard error
    of the rays).  ``mean_square`` (k, 2): area-weighted mean of the squared error, of form factors found
    by formula and of those found by rays.
    """

    patches: NDArray[np.int64]
    factor: FloatArray
    spread: FloatArray
    mean_square: FloatArray


# Generalised golden ratio in four dimensions (M. Roberts 2018): g solves g^5 = g + 1.
_G4 = 1.1673039782614187


@njit(nogil=True, cache=True)
def _piece_shares(mesh, element, first, last, slack, shares):
    """Cumulated form factors from an element's centroid to each piece of a near cluster; their sum."""
    total = 0.0
    for s in range(first, last):
        total += max(
            open_share(
                mesh.centroid[element, 0], mesh.centroid[element, 1], mesh.centroid[element, 2],
                mesh.normal[element, 0], mesh.normal[element, 1], mesh.normal[element, 2],
                mesh.sender_corners, mesh.sender_start[s], mesh.sender_start[s + 1], mesh.sender_normal, s, slack,
            ),
            0.0,
        )  # fmt: skip
        shares[s - first] = total
    return total


@njit(nogil=True, cache=True)
def _bundle_rays(
    elements, counts, patch, seed, mesh, slack, offset, centre, scale, starts, origins, directions, weights
):  # fmt: skip
    """Rays from random points of elements toward a patch, in Embree's unit frame.

    Element ``i`` gets rays ``starts[i]:starts[i + 1]``, at most ``counts[i]``, each with the weight that
    its visibility carries: the kernel cos cos / r^2 over the density of its points, which are
    uniform on a flat patch, the samples of a far cluster, and drawn by their facets' form factors on
    a near one.  Pairs that do not face each other get no ray.  Returns the number of rays.
    """
    x, y = np.empty(3), np.empty(3)
    first, last = mesh.patch_sender[patch], mesh.patch_sender[patch + 1]
    cluster = mesh.patch_polygon[patch] < 0
    shares = np.empty(last - first)
    extent = patch_extent(mesh.patch_bounds, patch)
    g1, g2, g3, g4 = 1.0 / _G4, 1.0 / _G4**2, 1.0 / _G4**3, 1.0 / _G4**4
    row = 0
    for i in range(elements.shape[0]):
        starts[i] = row
        e = elements[i]
        h = stream(e, patch, seed)
        s1 = np.float64(h & np.uint64(0xFFFF)) / 65536.0
        s2 = np.float64((h >> np.uint64(16)) & np.uint64(0xFFFF)) / 65536.0
        s3 = np.float64((h >> np.uint64(32)) & np.uint64(0xFFFF)) / 65536.0
        s4 = np.float64((h >> np.uint64(48)) & np.uint64(0xFFFF)) / 65536.0
        far = cluster and box_distance(mesh.centroid, e, mesh.patch_bounds, patch) > CLUSTER_FAR * extent
        total = 0.0
        if cluster and not far:
            total = _piece_shares(mesh, e, first, last, slack, shares)
        for k in range(counts[i]):
            t = k + 0.5
            own = place_on_pieces(
                mesh.corners, mesh.piece_start, mesh.element_piece[e], mesh.element_piece[e + 1], mesh.area[e],
                (s1 + g1 * t) % 1.0, (s2 + g2 * t) % 1.0, x,
            )  # fmt: skip
            n = mesh.piece_normal[own]
            u, v = (s3 + g3 * t) % 1.0, (s4 + g4 * t) % 1.0
            mx = my = mz = 0.0
            density = 1.0
            if far:
                j = (k * SAMPLES) // counts[i] if counts[i] < SAMPLES else k % SAMPLES
                y[0], y[1], y[2] = mesh.samples[patch, j, 0], mesh.samples[patch, j, 1], mesh.samples[patch, j, 2]
                m = mesh.sample_normals[patch, j]
                mx, my, mz = m[0], m[1], m[2]
            else:
                low, high = first, last
                area = mesh.patch_area[patch]
                if cluster:
                    if total <= 0.0:
                        break
                    low = first + np.searchsorted(shares, s3 * total / counts[i] + k * total / counts[i])
                    low = min(low, last - 1)
                    high = low + 1
                    u = (s3 * 977.0 + g3 * t) % 1.0
                    vx, vy, vz = newell_normal(mesh.sender_corners, mesh.sender_start[low], mesh.sender_start[high])
                    area = math.sqrt(vx * vx + vy * vy + vz * vz)
                    # Drawn with a density of its form factor over its area.
                    density = (shares[low - first] - (shares[low - first - 1] if low > first else 0.0)) / area
                piece = place_on_pieces(mesh.sender_corners, mesh.sender_start, low, high, area, u, v, y)
                m = mesh.sender_normal[piece]
                mx, my, mz = m[0], m[1], m[2]
            dx, dy, dz = y[0] - x[0], y[1] - x[1], y[2] - x[2]
            cx = dx * n[0] + dy * n[1] + dz * n[2]
            cy = -(dx * mx + dy * my + dz * mz)
            if cx <= 0.0 or cy <= 0.0:
                continue
            square = dx * dx + dy * dy + dz * dz
            weights[row] = cx * cy / (square * square * density)
            sx, sy, sz = x[0] + offset * n[0], x[1] + offset * n[1], x[2] + offset * n[2]
            origins[row, 0], origins[row, 1], origins[row, 2] = (
                (sx - centre[0]) * scale,
                (sy - centre[1]) * scale,
                (sz - centre[2]) * scale,
            )
            directions[row, 0] = (y[0] + offset * mx - sx) * scale
            directions[row, 1] = (y[1] + offset * my - sy) * scale
            directions[row, 2] = (y[2] + offset * mz - sz) * scale
            row += 1
    starts[elements.shape[0]] = row
    return row


@njit(nogil=True, cache=True)
def _apply_shares(elements, starts, weights, blocked, factor, spread):
    """Scale the unoccluded form factors by the weighted visible share; set the standard error."""
    for i in range(elements.shape[0]):
        e = elements[i]
        total = seen = square = 0.0
        for k in range(starts[i], starts[i + 1]):
            w = weights[k]
            total += w
            square += w * w
            if blocked[k] != 0:
                seen += w
        if total <= 0.0:
            # No pair faced the other: a grazing glance at most; half of it, in doubt as a whole.
            factor[e] *= 0.5
            spread[e] = factor[e]
            continue
        share = seen / total
        # Two pseudo-rays, one of each kind, so that agreeing rays still leave a doubt.
        effective = total * total / square
        safe = (share * effective + 1.0) / (effective + 2.0)
        spread[e] = factor[e] * math.sqrt(safe * (1.0 - safe) / (effective + 2.0))
        factor[e] *= share


class ReceiverBundles:
    """Form-factor columns over threads; one object a solve.

    Parameters
    ----------
    geometry : Geometry
        The occluders.
    mesh : PatchMesh
    settings : LinkSettings
    workers : int
        Threads; results do not depend on their number.
    """

    def __init__(self, geometry: Geometry, mesh: PatchMesh, settings: LinkSettings, workers: int = 1) -> None:
        self.mesh, self.settings, self.workers = mesh, settings, workers
        self.counters = Counters()
        self.seconds_in_embree = 0.0
        self.accelerator = EmbreeAccelerator(geometry, workers=1)
        self._geo = occluder_arrays(geometry, BoxTree.build(geometry))
        self._mesh: MeshArrays = mesh_arrays(mesh)
        self._corners = int(max(longest_ring(mesh.piece_start), longest_ring(mesh.sender_start)))
        floor = settings.floor
        self._floor = 0.1 * settings.error / max(mesh.patch_count, 1) if floor is None else floor
        self._pool = ThreadPoolExecutor(workers)
        self._idle: list[Workspace] = [workspace(self._corners) for _ in range(workers)]

    def close(self) -> None:
        """Stop the threads."""
        self._pool.shutdown()

    def take_counters(self) -> Counters:
        """The counts since this was last asked."""
        counters, self.counters = self.counters, Counters()
        return counters

    def columns(self, patches: Sequence[int] | NDArray[np.int64], floors: FloatArray | None = None) -> Columns:
        """Form factors from all elements to each of ``patches``.

        ``floors`` (k,) raises the absolute error below which a patch's form factors are not
        refined: faint patches need less care than bright ones.
        """
        chosen = np.asarray(patches, dtype=np.int64)
        n = self.mesh.element_count
        factor, spread = np.zeros((len(chosen), n)), np.zeros((len(chosen), n))
        rays = np.zeros((len(chosen), n), dtype=bool)
        groups = self.mesh.patch_count
        tasks = [
            (row, first, min(first + GROUPS_A_TASK, groups))
            for row in range(len(chosen))
            for first in range(0, groups, GROUPS_A_TASK)
        ]
        settings = self.settings
        lowest = np.full(len(chosen), self._floor) if floors is None else np.maximum(floors, self._floor)

        def settle(task: tuple[int, int, int]) -> tuple[NDArray, float, int]:
            row, first, last = task
            tally = new_tally()
            work = self._idle.pop()
            try:
                shoot(
                    int(chosen[row]), first, last, self._geo, self._mesh, settings.candidates, settings.error,
                    lowest[row], settings.levels, settings.closed_forms, factor[row], spread[row], rays[row],
                    work, tally,
                )  # fmt: skip
            finally:
                self._idle.append(work)
            a, b = self.mesh.patch_start[first], self.mesh.patch_start[last]
            doubtful = a + np.flatnonzero(rays[row, a:b])
            # What is too faint to matter gets a quarter of the rays.
            faint = factor[row, doubtful] < lowest[row]
            counts = np.where(faint, max(1, settings.rays // 4), settings.rays)
            traced, seconds = self._trace(int(chosen[row]), doubtful, counts, factor[row], spread[row])
            return tally, seconds, traced

        for tally, seconds, traced in self._pool.map(settle, tasks):
            add_tally(self.counters, tally)
            self.counters.add(rays=traced)
            self.seconds_in_embree += seconds
        weight = self.mesh.element_area / self.mesh.element_area.sum()
        square = spread**2
        by_rays = np.where(rays, square, 0.0) @ weight
        return Columns(chosen, factor, spread, np.column_stack([square @ weight - by_rays, by_rays]))

    def _trace(
        self, patch: int, elements: NDArray[np.int64], counts: NDArray[np.int64], factor: FloatArray, spread: FloatArray
    ) -> tuple[int, float]:
        """Scale the flagged form factors by rays, block by block; rays traced, seconds in Embree."""
        step = max(1, BLOCK_RAYS // self.settings.rays)
        centre, scale = self.accelerator.frame
        seconds, traced = 0.0, 0
        for begin in range(0, len(elements), step):
            block = slice(begin, begin + step)
            most = int(counts[block].sum())
            starts = np.empty(len(elements[block]) + 1, dtype=np.int64)
            origins = np.empty((most, 3), dtype=np.float32)
            directions = np.empty_like(origins)
            weights = np.empty(most)
            used = _bundle_rays(
                elements[block], counts[block], patch, self.settings.seed, self._mesh, self._geo.slack,
                self.accelerator.offset, centre, scale, starts, origins, directions, weights,
            )  # fmt: skip
            clock = time.perf_counter()
            blocked = self.accelerator.blocked_raw(origins[:used], directions[:used], np.ones(used, dtype=np.float32))
            seconds += time.perf_counter() - clock
            traced += used
            _apply_shares(elements[block], starts, weights, blocked, factor, spread)
        return traced, seconds
