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
from radiosity.form_factors._sampling import place_on_pieces, stream
from radiosity.patches import PatchMesh
from workbench.accel.box_tree import BoxTree
from workbench.accel.embree import BLOCK_RAYS, EmbreeAccelerator
from workbench.counters import Counters
from workbench.errors import OptionError
from workbench.geometry.flat import Geometry

__all__ = ["Columns", "LinkSettings", "ReceiverBundles"]

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


@njit(nogil=True, cache=True)
def _bundle_rays(
    elements, counts, patch, patch_area, seed, mesh, offset, centre, scale, starts, origins, directions, weights
):  # fmt: skip
    """Rays from random points of elements to random points of a patch, in Embree's unit frame.

    Element ``i`` tries ``counts[i]`` pairs; those that face each other become rays
    ``starts[i]:starts[i + 1]`` with the kernel cos cos / r^2 as weight.  Returns the number of rays.
    """
    x, y = np.empty(3), np.empty(3)
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
        n = mesh.normal[e]
        for k in range(counts[i]):
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
            if cx <= 0.0 or cy <= 0.0:
                continue
            weights[row] = cx * cy / (square * square)
            for axis in range(3):
                start = x[axis] + offset * n[axis]
                origins[row, axis] = (start - centre[axis]) * scale
                directions[row, axis] = (y[axis] + offset * m[axis] - start) * scale
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
            if not blocked[k]:
                seen += w
        if total <= 0.0:
            # No pair faced the other: what little is seen is in doubt as a whole.
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
            tally = np.zeros(len(TALLY), dtype=np.int64)
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
            self.counters.add(**dict(zip(TALLY, tally.tolist(), strict=True)), rays=traced)
            self.seconds_in_embree += seconds
        return Columns(chosen, factor, spread)

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
                elements[block], counts[block], patch, float(self.mesh.patch_area[patch]), self.settings.seed,
                self._mesh, self.accelerator.offset, centre, scale, starts, origins, directions, weights,
            )  # fmt: skip
            clock = time.perf_counter()
            blocked = self.accelerator.blocked_unit(origins[:used], directions[:used], np.ones(used, dtype=np.float32))
            seconds += time.perf_counter() - clock
            traced += used
            _apply_shares(elements[block], starts, weights, blocked, factor, spread)
        return traced, seconds
