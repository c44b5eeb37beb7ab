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

import numpy as np
from numba import njit
from numpy.typing import NDArray

from radiosity.form_factors._links import (
    TALLY,
    MeshArrays,
    Workspace,
    longest_ring,
    mesh_arrays,
    occluder_arrays,
    shoot,
    workspace,
)
from radiosity.patches import PatchMesh
from workbench.accel.box_tree import BoxTree
from workbench.accel.embree import BLOCK_RAYS, EmbreeAccelerator
from workbench.counters import Counters
from workbench.errors import OptionError
from workbench.geometry.flat import Geometry

__all__ = ["Columns", "LinkSettings", "ReceiverBundles", "place_on_pieces", "stream"]

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


@dataclass(frozen=True)
class Columns:
    """Form factors from all elements to some patches.

    ``factor`` (k, n): row ``j`` holds F from each element to patch ``patches[j]``, averaged over the
    element.  ``spread`` (k, n): its estimated error (quadrature difference, or one standard error
    of the rays).
    """

    patches: NDArray[np.int64]
    factor: FloatArray
    spread: FloatArray


# Generalised golden ratio in four dimensions (M. Roberts 2018): g solves g^5 = g + 1.
_G4 = 1.1673039782614187


@njit(nogil=True, cache=True, inline="always")
def stream(a, b, seed):
    """SplitMix64 of three integers: an independent stream for each element, patch and seed."""
    h = np.uint64(a) * np.uint64(0x9E3779B97F4A7C15)
    h ^= np.uint64(b) * np.uint64(0xBF58476D1CE4E5B9) + np.uint64(seed) * np.uint64(0x94D049BB133111EB)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return h ^ (h >> np.uint64(31))


@njit(nogil=True, cache=True)
def place_on_pieces(corners, starts, first, last, total, u, v, out):
    """Point of the pieces ``first..last`` at (u, v), uniform by area; returns its piece."""
    goal = u * total
    for piece in range(first, last):
        a, b = starts[piece], starts[piece + 1]
        for k in range(a + 1, b - 1):
            e0, e1, e2 = corners[k, 0] - corners[a, 0], corners[k, 1] - corners[a, 1], corners[k, 2] - corners[a, 2]
            f0, f1, f2 = (
                corners[k + 1, 0] - corners[a, 0],
                corners[k + 1, 1] - corners[a, 1],
                corners[k + 1, 2] - corners[a, 2],
            )
            c0, c1, c2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
            area = 0.5 * math.sqrt(c0 * c0 + c1 * c1 + c2 * c2)
            if goal <= area or (piece == last - 1 and k == b - 2):
                s = math.sqrt(min(max(goal / area, 0.0), 1.0)) if area > 0.0 else 0.0
                # Uniform on a triangle: distance from the first corner by sqrt, across by v.
                p, q = s * (1.0 - v), s * v
                out[0] = corners[a, 0] + p * e0 + q * f0
                out[1] = corners[a, 1] + p * e1 + q * f1
                out[2] = corners[a, 2] + p * e2 + q * f2
                return piece
            goal -= area
    return last - 1


@njit(nogil=True, cache=True)
def _bundle_rays(elements, patch, patch_area, count, seed, mesh, offset, centre, scale, origins, directions, weights):
    """Rays from random points of elements to random points of a patch, in Embree's unit frame.

    ``weights`` gets the kernel cos cos / r^2 of each ray; 0 for a pair that does not face.
    """
    x, y = np.empty(3), np.empty(3)
    g1, g2, g3, g4 = 1.0 / _G4, 1.0 / _G4**2, 1.0 / _G4**3, 1.0 / _G4**4
    row = 0
    for i in range(elements.shape[0]):
        e = elements[i]
        h = stream(e, patch, seed)
        s1 = np.float64(h & np.uint64(0xFFFF)) / 65536.0
        s2 = np.float64((h >> np.uint64(16)) & np.uint64(0xFFFF)) / 65536.0
        s3 = np.float64((h >> np.uint64(32)) & np.uint64(0xFFFF)) / 65536.0
        s4 = np.float64((h >> np.uint64(48)) & np.uint64(0xFFFF)) / 65536.0
        n = mesh.normal[e]
        for k in range(count):
            t = k + 0.5
            place_on_pieces(
                mesh.corners, mesh.piece_start, mesh.element_piece[e], mesh.element_piece[e + 1], mesh.area[e],
                (s1 + g1 * t) % 1.0, (s2 + g2 * t) % 1.0, x,
            )  # fmt: skip
            piece = place_on_pieces(
                mesh.sender_corners, mesh.sender_start, mesh.patch_sender[patch], mesh.patch_sender[patch + 1],
                patch_area, (s3 + g3 * t) % 1.0, (s4 + g4 * t) % 1.0, y,
            )  # fmt: skip
            m = mesh.sender_normal[piece]
            cx = cy = square = 0.0
            for axis in range(3):
                d = y[axis] - x[axis]
                cx += d * n[axis]
                cy -= d * m[axis]
                square += d * d
                start = x[axis] + offset * n[axis]
                origins[row, axis] = (start - centre[axis]) * scale
                directions[row, axis] = (y[axis] + offset * m[axis] - start) * scale
            weights[row] = cx * cy / (square * square) if cx > 0.0 and cy > 0.0 and square > 0.0 else 0.0
            row += 1


@njit(nogil=True, cache=True)
def _apply_shares(elements, count, weights, blocked, factor, spread):
    """Scale the unoccluded form factors by the weighted visible share; set the standard error."""
    for i in range(elements.shape[0]):
        e = elements[i]
        total = seen = square = 0.0
        for k in range(i * count, (i + 1) * count):
            w = weights[k]
            total += w
            square += w * w
            if not blocked[k]:
                seen += w
        if total <= 0.0:
            spread[e] = factor[e]  # no ray could tell: the whole is in doubt
            continue
        share = seen / total
        # One of (effective count + 2) pseudo-rays, so that agreeing rays still leave a doubt.
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

    def columns(self, patches: Sequence[int] | NDArray[np.int64]) -> Columns:
        """Form factors from all elements to each of ``patches``."""
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

        def settle(task: tuple[int, int, int]) -> tuple[NDArray, float, int]:
            row, first, last = task
            tally = np.zeros(len(TALLY), dtype=np.int64)
            work = self._idle.pop()
            try:
                shoot(
                    int(chosen[row]), first, last, self._geo, self._mesh, settings.candidates, settings.error,
                    self._floor, settings.levels, settings.closed_forms, factor[row], spread[row], rays[row],
                    work, tally,
                )  # fmt: skip
            finally:
                self._idle.append(work)
            a, b = self.mesh.patch_start[first], self.mesh.patch_start[last]
            doubtful = a + np.flatnonzero(rays[row, a:b])
            seconds = self._trace(int(chosen[row]), doubtful, factor[row], spread[row])
            return tally, seconds, len(doubtful) * settings.rays

        for tally, seconds, traced in self._pool.map(settle, tasks):
            self.counters.add(**dict(zip(TALLY, tally.tolist(), strict=True)), rays=traced)
            self.seconds_in_embree += seconds
        return Columns(chosen, factor, spread)

    def _trace(self, patch: int, elements: NDArray[np.int64], factor: FloatArray, spread: FloatArray) -> float:
        """Scale the flagged form factors by rays, block by block; seconds spent inside Embree."""
        count = self.settings.rays
        step = max(1, BLOCK_RAYS // count)
        centre, scale = self.accelerator.frame
        seconds = 0.0
        for start in range(0, len(elements), step):
            block = elements[start : start + step]
            origins = np.empty((len(block) * count, 3), dtype=np.float32)
            directions = np.empty_like(origins)
            weights = np.empty(len(origins))
            _bundle_rays(
                block, patch, float(self.mesh.patch_area[patch]), count, self.settings.seed, self._mesh,
                self.accelerator.offset, centre, scale, origins, directions, weights,
            )  # fmt: skip
            begin = time.perf_counter()
            blocked = self.accelerator.blocked_unit(origins, directions, np.ones(len(origins), dtype=np.float32))
            seconds += time.perf_counter() - begin
            _apply_shares(block, count, weights, blocked, factor, spread)
        return seconds
