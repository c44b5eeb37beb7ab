"""Pictures by sampling: aliased, supersampled, adaptive, and atomic adaptive.

Adaptive sampling is Whitted's (CACM 23(6), 1980) as Woo describes it (IEEE CG&A 13(5), 1993): each
pixel is sampled at its corners, which neighbours share; where their colours differ by more than a
threshold the pixel is cut into quadrants, and these again, down to a highest level.  Level 3
allows 5 x 5 = 25 samples a pixel.  A quadrant that is not cut counts with the mean of its corners
times its area.

All pixels of a band of rows go through the levels together.  A band keeps its lower boundary for
the next one, as the paper flips its two rows of corner samples; ``rows=1`` holds exactly those two
rows, and any other height gives the same picture bit for bit (unless ``shared_boundary`` is set).
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workbench.errors import InputError, OptionError
from workbench.memory import require_memory
from workbench.render.atomic import AtomicOptions, Guide, RayTrees
from workbench.render.camera import PinholeRays
from workbench.render.trace import ComponentCount, RayTally, Traced, Tracer

__all__ = ["Picture", "adaptive", "aliased", "camera_rays", "require_picture_memory", "supersampled"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Picture:
    """A picture and what it cost.

    Parameters
    ----------
    radiance : (h, w, bands) float
        [W m-2 sr-1]
    samples : (h, w) int
        Samples used by each pixel, those on its boundary included.
    saved : (h, w) int
        Shadow rays not shot at samples inside the pixel (and on boundaries that it sampled first)
        because the corners agreed.
    tally : RayTally
    traced : int
        Samples traced; fewer than the sum of ``samples``, for neighbours share.
    seconds : float
        Wall clock.
    """

    radiance: FloatArray
    samples: IntArray
    saved: IntArray
    tally: RayTally
    traced: int
    seconds: float


def camera_rays(tracer: Tracer, camera: PinholeRays | None) -> PinholeRays:
    """``camera``, or the rays of the scene's own; an :class:`InputError` if there is none."""
    if camera is not None:
        return camera
    if tracer.scene.camera is None:
        raise InputError("camera: found none in the scene, expected one; give camera=")
    return PinholeRays.from_camera(tracer.scene.camera)


def require_picture_memory(rays: PinholeRays, bands: int, lattice: int) -> None:
    """Refuse a picture that cannot be held: radiance, counts, and its copies on the way to bytes."""
    needed = rays.width * rays.height * (16 + 4 * 8 * bands) + lattice
    require_memory(
        needed, f"a picture of {rays.width} x {rays.height} pixels", "ask for a smaller one or a lower level"
    )


def _uniform(tracer: Tracer, camera: PinholeRays | None, side: int, rows: int) -> Picture:
    """``side`` x ``side`` samples at the middles of equal parts of each pixel."""
    start = time.perf_counter()
    rays = camera_rays(tracer, camera)
    require_picture_memory(rays, tracer.bands, 0)
    radiance = np.empty((rays.height, rays.width, tracer.bands))
    tally = RayTally([ComponentCount() for _ in range(tracer.light_count)])
    for first in range(0, rays.height, rows):
        end = min(first + rows, rays.height)
        line, column = np.meshgrid(np.arange(first * side, end * side), np.arange(rays.width * side), indexing="ij")
        found = tracer.trace_unchecked(
            rays.eye[None],
            rays.directions((column.ravel() + 0.5) / side, (line.ravel() + 0.5) / side),
            (line * rays.width * side + column).ravel(),
        )
        block = found.radiance.reshape(end - first, side, rays.width, side, tracer.bands)
        radiance[first:end] = block.mean(axis=(1, 3))
        tally.add(found.tally)
    shape = (rays.height, rays.width)
    return Picture(
        radiance,
        np.full(shape, side * side, dtype=np.int64),
        np.zeros(shape, dtype=np.int64),
        tally,
        rays.height * rays.width * side * side,
        time.perf_counter() - start,
    )


def aliased(tracer: Tracer, camera: PinholeRays | None = None, *, rows: int = 32) -> Picture:
    """One ray through the middle of each pixel.

    Parameters
    ----------
    tracer : Tracer
    camera : PinholeRays, optional
        The scene's own unless given.
    rows : int
        Rows of pixels traced at a time.

    Raises
    ------
    InputError
        If there is no camera.
    """
    return _uniform(tracer, camera, 1, rows)


def supersampled(tracer: Tracer, side: int, camera: PinholeRays | None = None, *, rows: int = 8) -> Picture:
    """``side`` x ``side`` rays in each pixel, averaged; arguments as in :func:`aliased`."""
    if not 1 <= side <= 64:
        raise OptionError(f"side: found {side}, expected 1 to 64 samples each way")
    return _uniform(tracer, camera, side, rows)


def adaptive(
    tracer: Tracer,
    camera: PinholeRays | None = None,
    *,
    threshold: float = 0.06,
    level: int = 3,
    atomic: AtomicOptions | None = None,
    shared_boundary: bool = False,
    white: float = 1.0,
    rows: int | None = None,
) -> Picture:
    """Adaptive sampling, and with ``atomic`` atomic adaptive sampling.

    Parameters
    ----------
    tracer : Tracer
    camera : PinholeRays, optional
        The scene's own unless given.
    threshold : float
        Cut a quadrant where a band of its corners' radiances, each pegged at white, differs by more
        than this share of white; below 0 everything is cut.  Error does not fall below what the threshold lets pass.
    level : int
        1 samples corners only; level ``n`` allows (2^(n-1) + 1)^2 samples a pixel.
    atomic : AtomicOptions, optional
        Assume what the corners agree on.
    shared_boundary : bool
        Woo's additional criterion: also cut a pixel whose corners agree, where a neighbour's
        samples on the shared boundary differ from them by more than the threshold.  Samples of the
        band above count, and those of the same band; so the height of the band has a small say.
    white : float
        Radiance shown as white; the thresholds, ``atomic.similar`` too, are shares of it.
    rows : int, optional
        Rows of pixels a band; at high levels fewer by default, for a band holds all that may be sampled.

    Raises
    ------
    OptionError
        If a number is out of its range.
    InputError
        If there is no camera.
    """
    if not 1 <= level <= 8:
        raise OptionError(f"level: found {level}, expected 1 to 8")
    step = 2 ** (level - 1)
    if rows is None:
        rows = max(1, min(32, 128 // step))
    if rows < 1:
        raise OptionError(f"rows: found {rows}, expected 1 or more")
    if not 0.0 < white < math.inf:
        raise OptionError(f"white: found {white}, expected a radiance greater than 0")
    if atomic is not None:
        atomic = replace(atomic, similar=atomic.similar * white)
    start = time.perf_counter()
    rays = camera_rays(tracer, camera)
    lattice = (rows * step + 1) * (rays.width * step + 1) * (8 * tracer.bands + 5)
    require_picture_memory(rays, tracer.bands, lattice)
    band = _Bands(tracer, rays, threshold * white, white, step, atomic, shared_boundary)
    for first in range(0, rays.height, rows):
        band.sample(first, min(first + rows, rays.height))
    return Picture(band.radiance, band.samples, band.saved, band.tally, band.traced, time.perf_counter() - start)


@njit(nogil=True, cache=True)
def _corners_differ(colour, place, size, columns, threshold, white):
    # Squares whose corners' colours, pegged at white, differ by more than the threshold.
    uneven = np.zeros(place.shape[0], dtype=np.bool_)
    down = size * columns
    for i in range(place.shape[0]):
        p = place[i]
        for band in range(colour.shape[1]):
            a, b = min(colour[p, band], white), min(colour[p + size, band], white)
            c, d = min(colour[p + down, band], white), min(colour[p + down + size, band], white)
            if max(a, b, c, d) - min(a, b, c, d) > threshold:
                uneven[i] = True
    return uneven


@njit(nogil=True, cache=True)
def _count_or_keep(colour, pixel, place, size, columns, cut, weight, total):
    # Squares that are not cut, added to their pixels (mean of the corners times the share of area);
    # returns the others.
    down = size * columns
    kept = 0
    pixels, places = np.empty_like(pixel), np.empty_like(place)
    for i in range(place.shape[0]):
        p = place[i]
        if cut[i]:
            pixels[kept], places[kept] = pixel[i], p
            kept += 1
            continue
        for band in range(colour.shape[1]):
            four = colour[p, band] + colour[p + size, band] + colour[p + down, band] + colour[p + down + size, band]
            total[pixel[i], band] += four * weight
    return pixels[:kept], places[:kept]


@njit(nogil=True, cache=True)
def _quarters(pixel, place, half, columns):
    # The four quadrants of each square.
    pixels, places = np.empty(4 * pixel.shape[0], pixel.dtype), np.empty(4 * pixel.shape[0], place.dtype)
    down = half * columns
    for i in range(pixel.shape[0]):
        p = place[i]
        pixels[4 * i : 4 * i + 4] = pixel[i]
        places[4 * i], places[4 * i + 1], places[4 * i + 2], places[4 * i + 3] = p, p + half, p + down, p + down + half
    return pixels, places


@njit(nogil=True, cache=True)
def _put(samples, radiance, colour, owner, saved, spared):
    # Samples written into the lattice, and the shadow rays they spared into their pixels.
    for i in range(samples.shape[0]):
        colour[samples[i]] = radiance[i]
        spared[owner[i]] += saved[i]


@njit(nogil=True, cache=True)
def _middles(pixel, place, half, columns, known, user, count):
    # The middles of the sides and of the squares that nobody knows yet, and the pixel that asks
    # first.  Marks them known, and counts for each pixel the samples that it did not use before:
    # the squares of a pixel follow one another, so the last user tells.
    wanted = np.empty(5 * place.shape[0], dtype=np.int64)
    owner = np.empty(5 * place.shape[0], dtype=np.int64)
    found = 0
    down = half * columns
    for i in range(place.shape[0]):
        p = place[i]
        for at in (p + half, p + down, p + down + half, p + down + 2 * half, p + 2 * down + half):
            if user[at] != pixel[i]:
                user[at] = pixel[i]
                count[pixel[i]] += 1
            if not known[at]:
                known[at] = True
                wanted[found], owner[found] = at, pixel[i]
                found += 1
    return wanted[:found], owner[:found]


@njit(nogil=True, cache=True)
def _lattice_rays(samples, columns, top, step, corner, right, down):
    # Unit directions through samples of a band that begins at pixel row ``top``, and their numbers
    # in the whole picture's lattice.
    along = np.empty((samples.shape[0], 3))
    number = np.empty(samples.shape[0], dtype=np.int64)
    for i in range(samples.shape[0]):
        line = samples[i] // columns + top * step
        column = samples[i] % columns
        number[i] = line * columns + column
        x, y = column / step, line / step
        dx = corner[0] + x * right[0] + y * down[0]
        dy = corner[1] + x * right[1] + y * down[1]
        dz = corner[2] + x * right[2] + y * down[2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        along[i, 0], along[i, 1], along[i, 2] = dx / length, dy / length, dz / length
    return along, number


@njit(nogil=True, cache=True)
def _places(samples, owner, columns, step, pixel_line, pixel_column):
    # Where in its pixel each sample lies, 0..1 to the right and downward.
    x, y = np.empty(samples.shape[0]), np.empty(samples.shape[0])
    for i in range(samples.shape[0]):
        x[i] = (samples[i] % columns) / step - pixel_column[owner[i]]
        y[i] = (samples[i] // columns) / step - pixel_line[owner[i]]
    return x, y


class _Bands:
    """The state that goes from one band of rows to the next.

    Samples lie on a lattice of ``step`` intervals a pixel; a band holds its part of the lattice:
    colours, which of them are known, and the ray trees of the corners.
    """

    def __init__(
        self,
        tracer: Tracer,
        rays: PinholeRays,
        threshold: float,
        white: float,
        step: int,
        atomic: AtomicOptions | None,
        shared_boundary: bool,
    ) -> None:
        self.tracer, self.rays, self.threshold, self.white, self.step = tracer, rays, threshold, white, step
        self.atomic, self.shared_boundary = atomic, shared_boundary
        self.columns = rays.width * step + 1
        shape = (rays.height, rays.width)
        self.radiance = np.zeros((*shape, tracer.bands))
        self.samples = np.zeros(shape, dtype=np.int64)
        self.saved = np.zeros(shape, dtype=np.int64)
        self.tally = RayTally([ComponentCount() for _ in range(tracer.light_count)])
        self.traced = 0
        # The lower boundary of the band above: colours and what is known of its lattice row, and
        # the ray trees of its corners.
        self.line: FloatArray | None = None
        self.line_known = np.zeros(self.columns, dtype=bool)
        self.line_trees: RayTrees | None = None

    def _shoot(self, samples: IntArray, top: int, *how: Any) -> Traced:
        """Trace samples of the band's lattice, numbered along its rows."""
        rays = self.rays
        along, number = _lattice_rays(samples, self.columns, top, self.step, rays.corner, rays.right, rays.down)
        found = self.tracer.trace_unchecked(rays.eye[None], along, number, *how)
        self.tally.add(found.tally)
        self.traced += len(samples)
        return found

    def sample(self, top: int, bottom: int) -> None:
        """Sample the pixel rows ``top..bottom - 1``."""
        step, width = self.step, self.rays.width
        height, across = (bottom - top) * step + 1, self.columns
        self.colour = np.zeros((height * across, self.tracer.bands))
        self.known = np.zeros(height * across, dtype=bool)
        self.user = np.full(height * across, -1, dtype=np.int32)
        self.top = top
        corner_line, corner_column = np.meshgrid(np.arange(bottom - top + 1), np.arange(width + 1), indexing="ij")
        corners = (corner_line * step * across + corner_column * step).ravel()
        trees = None
        if self.atomic is not None:
            angle = self.atomic.normal_angle_deg is not None
            trees = self.tracer.ray_trees(len(corners), whole_tree=self.atomic.whole_tree, normals=angle)
        new = slice(0, None)
        if self.line is not None:
            self.colour[:across], self.known[:across] = self.line, self.line_known
            new = slice(width + 1, None)
            if trees is not None and self.line_trees is not None:
                trees.put(slice(0, width + 1), self.line_trees)
        found = self._shoot(corners[new], top, trees.rows(new) if trees is not None else None)
        self.colour[corners[new]] = found.radiance
        self.known[corners[new]] = True

        pixel_line, pixel_column = np.meshgrid(np.arange(bottom - top), np.arange(width), indexing="ij")
        self.pixel_line, self.pixel_column = pixel_line.ravel(), pixel_column.ravel()
        pixels = np.arange(len(self.pixel_line))
        place = (self.pixel_line * across + self.pixel_column) * step
        self.total = np.zeros((len(pixels), self.tracer.bands))
        self.count = np.full(len(pixels), 4, dtype=np.int64)
        self.spared = np.zeros(len(pixels), dtype=np.int64)
        four = self.pixel_line * (width + 1) + self.pixel_column
        self.tree_corners = np.stack([four, four + 1, four + width + 1, four + width + 2], axis=1)
        whole = self._descend(pixels, place, step, trees, self._uneven(place, step), keep_uncut=self.shared_boundary)
        while len(whole):
            # Neighbours may have met on the boundary what the corners do not show.
            uneven = self._boundary_uneven(place[whole], step)
            if not uneven.any():
                self._count(whole, place[whole], step, np.zeros(len(whole), dtype=bool))
                break
            self._descend(whole[uneven], place[whole[uneven]], step, trees, np.ones(int(uneven.sum()), dtype=bool))
            whole = whole[~uneven]

        shape = (bottom - top, width)
        self.radiance[top:bottom] = self.total.reshape(*shape, -1)
        self.samples[top:bottom] = self.count.reshape(shape)
        self.saved[top:bottom] += self.spared.reshape(shape)
        self.line, self.line_known = self.colour[-across:].copy(), self.known[-across:].copy()
        if trees is not None:
            self.line_trees = trees.rows(np.arange((bottom - top) * (width + 1), len(corners)))

    def _uneven(self, place: IntArray, size: int) -> NDArray[np.bool_]:
        """Which squares' corners differ by more than the threshold."""
        return _corners_differ(self.colour, place, size, self.columns, self.threshold, self.white)

    def _boundary_uneven(self, place: IntArray, size: int) -> NDArray[np.bool_]:
        """Which squares have a known sample on their boundary that makes them uneven."""
        along = np.arange(size + 1)
        offsets = np.unique(np.concatenate([along, along * self.columns, size * self.columns + along,
                                            along * self.columns + size]))  # fmt: skip
        at = place[:, None] + offsets
        known = self.known[at][:, :, None]
        colour = np.minimum(self.colour[at], self.white)
        highest = np.where(known, colour, -np.inf).max(axis=1)
        lowest = np.where(known, colour, np.inf).min(axis=1)
        return (highest - lowest).max(axis=1) > self.threshold

    def _count(self, pixel: IntArray, place: IntArray, size: int, cut: NDArray[np.bool_]) -> tuple[IntArray, IntArray]:
        """Add squares that are not cut to their pixels; returns pixels and places of the others."""
        weight = 0.25 * (size / self.step) ** 2
        return _count_or_keep(self.colour, pixel, place, size, self.columns, cut, weight, self.total)

    def _descend(
        self,
        pixel: IntArray,
        place: IntArray,
        size: int,
        trees: RayTrees | None,
        cut: NDArray[np.bool_],
        keep_uncut: bool = False,
    ) -> IntArray:
        """Cut squares, sample, and go on; returns the pixels left whole, which ``keep_uncut`` does not count."""
        left = np.empty(0, dtype=np.int64)
        if size == 1:
            cut = np.zeros(len(pixel), dtype=bool)
        if keep_uncut and size > 1:
            left = pixel[~cut]
            pixel, place = pixel[cut], place[cut]
        else:
            pixel, place = self._count(pixel, place, size, cut)
        guide, guide_row = None, np.empty(0, dtype=np.int64)
        if trees is not None and self.atomic is not None and len(pixel):
            guide = Guide.from_corners(trees, self.tree_corners[pixel], self.atomic)
            guide_row = np.zeros(len(self.count), dtype=np.int64)
            guide_row[pixel] = np.arange(len(pixel))
        while len(pixel):
            half = size // 2
            wanted, owner = _middles(pixel, place, half, self.columns, self.known, self.user, self.count)
            if len(wanted):
                found = self._inside(wanted, owner, guide, guide_row)
                _put(wanted, found.radiance, self.colour, owner, found.saved, self.spared)
            pixel, place = _quarters(pixel, place, half, self.columns)
            size = half
            cut = self._uneven(place, size) if size > 1 else np.zeros(len(pixel), dtype=bool)
            pixel, place = self._count(pixel, place, size, cut)
        return left

    def _inside(self, wanted: IntArray, owner: IntArray, guide: Guide | None, guide_row: IntArray) -> Traced:
        if guide is None:
            return self._shoot(wanted, self.top)
        place = _places(wanted, owner, self.columns, self.step, self.pixel_line, self.pixel_column)
        return self._shoot(wanted, self.top, None, guide, guide_row[owner], place)
