"""Woo's loops: the shadow of a linear or area light by K rays a point, with and without the
plane-vertex check.

Source: A. Woo, "Efficient Shadow Computations in Ray Tracing" (IEEE CG&A 13(5), 1993), Figures 2
(brute force with rayIDs) and 4 (plane-vertex check: ids m to m + K - 1, culled polygons get
m + K - 1, no check at the last ray).  Both run on the voxel walk of
:mod:`workbench.accel.voxel_grid`, count what they do, and give the same answer bit for bit.

Departures from the paper, all needed for that equality:

* d is ``N . S``, not "N x S" as printed; vertices are taken relative to S, so d drops out.
* A vertex is outside only beyond a margin of rounding (:data:`MARGIN`).  With S in line with a
  linear light, or on an edge of an area light, N is zero or noise and culls nothing.
* The sides of the light pyramid's planes come from S and the light's centroid, not from its
  winding, which the paper takes as counter-clockwise.  Where S lies in the light's plane no plane
  has a side, and none culls.
* Concave lights are refused: cut them into convex parts, each a light of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from workbench.accel.base import as_skip_polygons
from workbench.accel.voxel_grid import (
    ANY,
    CLOSEST,
    COUNTED,
    TRANSMIT,
    RayIDs,
    VoxelGrid,
    blocks,
    share_out,
    walk,
)
from workbench.arrays import as_points, as_unit_vectors
from workbench.counters import Counters
from workbench.errors import InputError
from workbench.geometry.polygons import check_polygon, is_convex, vector_area

__all__ = [
    "LightOcclusion",
    "MARGIN",
    "adaptive_area_occlusion",
    "adaptive_linear_occlusion",
    "irradiance_weights",
    "light_occlusion",
    "soft_shadow_kludge",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MARGIN = 64.0
"""Units in the last place of the scene's coordinates by which a culled vertex must lie outside."""

_EPSILON = float(np.finfo(np.float64).eps)
_SAMPLE_ULPS = 16.0


@njit(nogil=True, cache=True)
def _light_planes(points, row, light, reach, margin, planes):
    """Outward planes through a point and a light's edges, (nx, ny, nz, margin) relative to the point.

    A linear light has one plane; both its sides are outside.  Returns how many rows were filled.
    """
    edges = light.shape[0]
    px, py, pz = points[row, 0], points[row, 1], points[row, 2]
    cx = cy = cz = 0.0
    for i in range(edges):
        cx += (light[i, 0] - px) / edges
        cy += (light[i, 1] - py) / edges
        cz += (light[i, 2] - pz) / edges
    used = 0
    for i in range(1 if edges == 2 else edges):
        j = (i + 1) % edges
        ax, ay, az = light[i, 0] - px, light[i, 1] - py, light[i, 2] - pz
        bx, by, bz = light[j, 0] - px, light[j, 1] - py, light[j, 2] - pz
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        # |N . v| <= |a| |b| |v|: rounding of N, of the vertices and of the samples, in that unit.
        spread = math.sqrt((ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz))
        slack = margin * _EPSILON * spread * reach
        if edges == 2:
            planes[0, 0], planes[0, 1], planes[0, 2], planes[0, 3] = nx, ny, nz, slack
            planes[1, 0], planes[1, 1], planes[1, 2], planes[1, 3] = -nx, -ny, -nz, slack
            return 2
        side = nx * cx + ny * cy + nz * cz
        if not abs(side) > slack:
            continue
        if side > 0.0:
            nx, ny, nz = -nx, -ny, -nz
        planes[used, 0], planes[used, 1], planes[used, 2], planes[used, 3] = nx, ny, nz, slack
        used += 1
    return used


@njit(nogil=True, cache=True)
def _shoot(
    objects, cells, origin, direction, far, skip, mode, ids, first, last, planes, boxes, through, counts
):  # fmt: skip
    # One shadow ray; ``ids`` is (mailbox, touched, current).  Leaves what passes in ``through``.
    through[:] = 1.0
    _, index = walk(
        objects, cells, origin, direction, 0, far, skip, mode,
        ids[0], ids[1], ids[2], first, last, planes, boxes, True, through, counts,
    )  # fmt: skip
    if index >= 0 and mode != TRANSMIT:
        through[:] = 0.0


@njit(nogil=True, cache=True)
def _light_loop(
    objects, cells, points, lights, samples, skip, mode, check, boxes, margin, reach,
    mailbox, touched, current, limit, transmitted, counts,
):  # fmt: skip
    # Figure 4, and Figure 2 where ``check`` is off.  Returns the next rayID.
    rays = samples.shape[1]
    planes = np.empty((max(lights.shape[1], 2), 4))
    no_planes = np.empty((0, 4))
    origin, direction, far = np.empty((1, 3)), np.empty((1, 3)), 1.0
    for row in range(points.shape[0]):
        if current > limit - rays:
            mailbox[:] = 0
            touched[:] = 0
            current = 1
        first = current
        last = first + rays - 1
        used = 0
        if check:
            used = _light_planes(points, row, lights[row if lights.shape[0] > 1 else 0], reach, margin, planes)
        for i in range(rays):
            for k in range(3):
                origin[0, k] = points[row, k]
                direction[0, k] = samples[row, i, k] - points[row, k]
            _shoot(
                objects, cells, origin, direction, far, skip[row : row + 1], mode, (mailbox, touched, current),
                first, last, planes[:used] if i != rays - 1 else no_planes, boxes, transmitted[row, i], counts,
            )  # fmt: skip
            current += 1
    return current


@njit(nogil=True, cache=True)
def _adaptive_loop(
    objects, cells, points, lights, skip, mode, check, boxes, margin, reach, levels,
    mailbox, touched, current, limit, occlusion, shots, counts,
):  # fmt: skip
    # Woo's adaptive linear light; ``levels`` are the least and the most halvings.
    spans = 2 ** levels[1]
    rays = spans + 1
    planes = np.empty((2, 4))
    no_planes = np.empty((0, 4))
    origin, direction, far = np.empty((1, 3)), np.empty((1, 3)), 1.0
    bands = occlusion.shape[1]
    through = np.empty((rays, bands))
    shot = np.empty(rays, dtype=np.bool_)
    stack = np.empty((2 * levels[1] + 2, 2), dtype=np.int64)
    coarse = 2 ** (levels[1] - levels[0])
    for row in range(points.shape[0]):
        if current > limit - rays:
            mailbox[:] = 0
            touched[:] = 0
            current = 1
        first = current
        last = first + rays - 1
        light = lights[row if lights.shape[0] > 1 else 0]
        used = _light_planes(points, row, light, reach, margin, planes) if check else 0
        shot[:] = False
        shots[row] = 0
        occlusion[row] = 0.0
        for begin in range(0, spans, coarse):
            stack[0, 0], stack[0, 1] = begin, begin + coarse
            depth = 1
            while depth > 0:
                depth -= 1
                lower, upper = stack[depth, 0], stack[depth, 1]
                for place in (lower, upper):
                    if shot[place]:
                        continue
                    share = place / spans
                    for k in range(3):
                        origin[0, k] = points[row, k]
                        at = light[0, k] + share * (light[1, k] - light[0, k])
                        direction[0, k] = at - points[row, k]
                    _shoot(
                        objects, cells, origin, direction, far, skip[row : row + 1], mode,
                        (mailbox, touched, first + shots[row]), first, last,
                        planes[:used] if shots[row] != rays - 1 else no_planes, boxes, through[place], counts,
                    )  # fmt: skip
                    shot[place] = True
                    shots[row] += 1
                differ = False
                for band in range(bands):
                    differ = differ or through[lower, band] != through[upper, band]
                if differ and upper - lower > 1:
                    middle = (lower + upper) // 2
                    stack[depth, 0], stack[depth, 1] = middle, upper
                    stack[depth + 1, 0], stack[depth + 1, 1] = lower, middle
                    depth += 2
                    continue
                for band in range(bands):
                    mean = 0.5 * (through[lower, band] + through[upper, band])
                    occlusion[row, band] += (1.0 - mean) * (upper - lower) / spans
        # All K ids are spent, however many rays were shot: a culled polygon holds the last of them.
        current = first + rays
    return current


@njit(nogil=True, cache=True)
def _on_quad(light, u, v, axis):
    # Bilinear: straight lines between points that divide opposite edges alike.
    near = light[0, axis] + u * (light[1, axis] - light[0, axis])
    far = light[3, axis] + u * (light[2, axis] - light[3, axis])
    return near + v * (far - near)


@njit(nogil=True, cache=True)
def _cell_area(light, spans, i, j, size):
    # Area of the lattice cell (i, j) of a quad light: twice, the cross product of its diagonals.
    ax = ay = az = bx = by = bz = 0.0
    for corner in range(4):
        # Corners 0, 1, 2, 3 at (0, 0), (1, 0), (1, 1), (0, 1); diagonals 0-2 and 1-3.
        u = (i + (size if corner == 1 or corner == 2 else 0)) / spans
        v = (j + (size if corner >= 2 else 0)) / spans
        sign = 1.0 if corner >= 2 else -1.0
        x = _on_quad(light, u, v, 0)
        y = _on_quad(light, u, v, 1)
        z = _on_quad(light, u, v, 2)
        if corner % 2 == 0:
            ax, ay, az = ax + sign * x, ay + sign * y, az + sign * z
        else:
            bx, by, bz = bx + sign * x, by + sign * y, bz + sign * z
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return math.sqrt(cx * cx + cy * cy + cz * cz)


@njit(nogil=True, cache=True)
def _adaptive_area_loop(
    objects, cells, points, light, skip, mode, check, boxes, margin, reach, levels,
    mailbox, touched, current, limit, occlusion, shots, counts,
):  # fmt: skip
    # The area counterpart of _adaptive_loop: cells of a lattice in place of stretches.
    spans = 2 ** levels[1]
    row_length = spans + 1
    rays = row_length * row_length
    planes = np.empty((4, 4))
    no_planes = np.empty((0, 4))
    origin, direction, far = np.empty((1, 3)), np.empty((1, 3)), 1.0
    bands = occlusion.shape[1]
    through = np.empty((rays, bands))
    shot = np.empty(rays, dtype=np.bool_)
    stack = np.empty((3 * levels[1] + 4, 3), dtype=np.int64)
    places = np.empty(4, dtype=np.int64)
    coarse = 2 ** (levels[1] - levels[0])
    whole = _cell_area(light, spans, 0, 0, spans)
    for row in range(points.shape[0]):
        if current > limit - rays:
            mailbox[:] = 0
            touched[:] = 0
            current = 1
        first = current
        last = first + rays - 1
        used = _light_planes(points, row, light, reach, margin, planes) if check else 0
        shot[:] = False
        shots[row] = 0
        occlusion[row] = 0.0
        for begin in range(4 ** levels[0]):
            stack[0, 0] = begin // 2 ** levels[0] * coarse
            stack[0, 1] = begin % 2 ** levels[0] * coarse
            stack[0, 2] = coarse
            depth = 1
            while depth > 0:
                depth -= 1
                i, j, size = stack[depth, 0], stack[depth, 1], stack[depth, 2]
                for corner in range(4):
                    p, q = i + size * (corner % 2), j + size * (corner // 2)
                    place = p * row_length + q
                    places[corner] = place
                    if shot[place]:
                        continue
                    for k in range(3):
                        origin[0, k] = points[row, k]
                        direction[0, k] = _on_quad(light, p / spans, q / spans, k) - points[row, k]
                    _shoot(
                        objects, cells, origin, direction, far, skip[row : row + 1], mode,
                        (mailbox, touched, first + shots[row]), first, last,
                        planes[:used] if shots[row] != rays - 1 else no_planes, boxes, through[place], counts,
                    )  # fmt: skip
                    shot[place] = True
                    shots[row] += 1
                differ = False
                for corner in range(1, 4):
                    for band in range(bands):
                        differ = differ or through[places[corner], band] != through[places[0], band]
                if differ and size > 1:
                    half = size // 2
                    for corner in range(4):
                        stack[depth, 0], stack[depth, 1] = i + half * (corner % 2), j + half * (corner // 2)
                        stack[depth, 2] = half
                        depth += 1
                    continue
                for band in range(bands):
                    hidden = 0.0
                    for corner in range(4):
                        hidden += 0.25 * (1.0 - through[places[corner], band])
                    occlusion[row, band] += hidden * _cell_area(light, spans, i, j, size) / whole
        # All K ids are spent, however many rays were shot: a culled polygon holds the last of them.
        current = first + rays
    return current


@dataclass(frozen=True)
class LightOcclusion:
    """How much of a light is hidden from each point.

    Parameters
    ----------
    occlusion : (n, b) float
        Blocked share of the light under the weights asked for; ``b`` is 1 where every object is
        opaque, otherwise the number of bands.
    transmitted : (n, K, b) float or None
        What passes along each ray; ``None`` where the number of rays varies.
    shots : (n,) int
        Rays shot from each point.
    counters : Counters
        What this call did.  ``tests_avoided`` counts the pairs of a ray and a culled object that
        met in some voxel: exactly the tests that Figure 2 makes and Figure 4 does not, since both
        walk the same voxels and stop at the same hits.  ``mailbox_skips`` counts meetings of a
        ray with an object after its first with that object.
    """

    occlusion: FloatArray
    transmitted: FloatArray | None
    shots: IntArray
    counters: Counters


def irradiance_weights(
    points: ArrayLike,
    normals: ArrayLike,
    samples: ArrayLike,
    *,
    light_normal: ArrayLike | None = None,
    light_axis: ArrayLike | None = None,
) -> FloatArray:
    """Each sample's part of the irradiance, (n, K): cos / r^2, by its own light's law.

    Equal weights give the hidden share of the light's length or area, which is not the hidden
    share of the irradiance.

    Parameters
    ----------
    points, normals : (n, 3) float
        Receivers; samples below a receiver's horizon weigh nothing.
    samples : (n, K, 3) float
        Points on the light, spread evenly over its length or area.
    light_normal : (3,) float, optional
        Area light: its front normal; the cosine there is a factor, zero behind it.
    light_axis : (3,) float, optional
        Lambertian linear light: its direction; the sine of the angle to it is a factor.

    Raises
    ------
    InputError
        If shapes do not agree or a sample lies on its point.
    """
    place, normal = as_points(points), as_unit_vectors(normals)
    toward = _samples(samples, len(place)) - place[:, None]
    square = np.einsum("nkj,nkj->nk", toward, toward)
    if not square.all():
        raise InputError("samples: a sample lies on its point; move the point off the light")
    unit = toward / np.sqrt(square)[:, :, None]
    weights = np.clip(np.einsum("nkj,nj->nk", unit, np.broadcast_to(normal, place.shape)), 0.0, None) / square
    if light_normal is not None:
        weights *= np.clip(-unit @ as_unit_vectors(light_normal, "light_normal")[0], 0.0, None)
    if light_axis is not None:
        cosine = unit @ as_unit_vectors(light_axis, "light_axis")[0]
        weights *= np.sqrt(np.clip(1.0 - cosine * cosine, 0.0, None))
    return weights


def _samples(samples: ArrayLike, count: int) -> FloatArray:
    array = np.asarray(samples, dtype=np.float64)
    if array.ndim != 3 or array.shape[0] != count or array.shape[1] < 1 or array.shape[2] != 3:
        raise InputError(f"samples: found shape {array.shape}, expected ({count}, K, 3) with K of 1 or more")
    if not np.isfinite(array).all():
        raise InputError("samples: found a value that is not finite")
    return np.ascontiguousarray(array)


def _lights(light: ArrayLike, count: int) -> FloatArray:
    # One light (1, E, 3) for all points, or a linear light a point (n, 2, 3).
    array = np.asarray(light, dtype=np.float64)
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3 or array.shape[2] != 3 or array.shape[1] < 2 or not np.isfinite(array).all():
        raise InputError(f"light: found shape {array.shape}, expected (E, 3) finite corners, E of 2 or more")
    if array.shape[1] > 2:
        if len(array) > 1:
            raise InputError(f"light: found {len(array)} polygons, expected one; shade one area light at a time")
        wrong = check_polygon([array[0]])
        if wrong is None and not is_convex(array[0], vector_area(array[0]) / np.linalg.norm(vector_area(array[0]))):
            wrong = "a concave light"
        if wrong is not None:
            raise InputError(f"light: found {wrong}, expected a convex polygon; cut the light into convex parts")
    elif len(array) not in (1, count):
        raise InputError(f"light: found {len(array)} lines, expected one or {count}")
    elif (array[:, 0] == array[:, 1]).all(axis=1).any():
        raise InputError("light: found a line of no length, expected two different ends")
    return np.ascontiguousarray(array)


def _check_on_light(lights: FloatArray, samples: FloatArray) -> None:
    # A sample off the light would lie outside the pyramid that the check takes for the whole bundle.
    tolerance = _SAMPLE_ULPS * _EPSILON * max(np.abs(lights).max(), np.abs(samples).max())
    if lights.shape[1] == 2:
        axis = (lights[:, 1] - lights[:, 0])[:, None]
        along = samples - lights[:, :1]
        share = np.clip((along * axis).sum(axis=2) / (axis * axis).sum(axis=2), 0.0, 1.0)
        off = np.linalg.norm(along - share[:, :, None] * axis, axis=2).max()
    else:
        corners = lights[0]
        normal = vector_area(corners)
        normal /= np.linalg.norm(normal)
        off = np.abs((samples - corners[0]) @ normal).max() - np.abs((corners - corners[0]) @ normal).max()
        for corner, following in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            outward = np.cross(following - corner, normal)
            length = np.linalg.norm(outward)
            if length > 0.0:
                off = max(off, ((samples - corner) @ (outward / length)).max())
    if off > tolerance:
        raise InputError(f"samples: one lies {off:.3g} off the light, expected at most {tolerance:.3g} (rounding)")


class _Run:
    """The checked arguments that every loop shares, and the ids and threads it runs on."""

    def __init__(self, grid, points, lights, skip_polygons, ids, workers):
        self.grid, self.points, self.lights = grid, points, lights
        self.skip = as_skip_polygons(skip_polygons, len(points))
        if ids is not None and (workers != 1 or len(ids.mailbox) != grid.object_count):
            raise InputError("ids: found more than one worker or another grid's ids, expected one worker, this grid")
        self.ids, self.workers = ids, workers
        grid.check_origins(points)
        self.transparent = bool(grid.objects.clear.any())
        self.bands = grid.bands if self.transparent else 1
        self.mode = TRANSMIT if self.transparent else ANY
        tops = [np.abs(array).max() for array in (points, lights, grid.objects.bounds) if array.size]
        self.reach = float(sum(tops))  # more than any coordinate relative to a point

    def __call__(self, rays: int, loop) -> Counters:
        """Run ``loop(rows, ids, counts)`` over the blocks of all workers."""
        limit = RayIDs(0).limit if self.ids is None else self.ids.limit
        if rays >= limit:
            raise InputError(f"samples: found K = {rays}, expected less than the largest rayID {limit}")

        def work(worker: int) -> IntArray:
            ids = self.ids or RayIDs(self.grid.object_count)
            counts = np.zeros(len(COUNTED), dtype=np.int64)
            for rows in blocks(len(self.points), worker, self.workers):
                ids.current = loop(rows, ids, counts)
            return counts

        return Counters(**dict(zip(COUNTED, share_out(self.workers, work), strict=True)))

    def lights_of(self, rows: slice) -> FloatArray:
        return self.lights[rows] if len(self.lights) > 1 else self.lights


def _weighted(transmitted: FloatArray, weights: str | ArrayLike) -> FloatArray:
    if isinstance(weights, str):
        if weights != "equal":
            raise InputError(f"weights: found {weights!r}, expected 'equal' or an (n, K) array")
        return 1.0 - transmitted.mean(axis=1)
    share = np.asarray(weights, dtype=np.float64)
    if share.shape != transmitted.shape[:2] or not (share >= 0.0).all():
        raise InputError(f"weights: found shape {share.shape}, expected {transmitted.shape[:2]}, none negative")
    total = share.sum(axis=1, keepdims=True)
    share = share / np.where(total > 0.0, total, 1.0)
    return np.einsum("nk,nkb->nb", share, 1.0 - transmitted)


def light_occlusion(
    grid: VoxelGrid,
    points: ArrayLike,
    light: ArrayLike,
    samples: ArrayLike,
    *,
    check: bool = True,
    boxes: bool = False,
    weights: str | ArrayLike = "equal",
    skip_polygons: ArrayLike | None = None,
    ids: RayIDs | None = None,
    workers: int = 1,
    count_any_hit: bool = False,
    margin: float = MARGIN,
) -> LightOcclusion:
    """Occlusion of a linear or convex area light by K rays a point (Woo 1993, Figures 2 and 4).

    Parameters
    ----------
    grid : VoxelGrid
    points : (n, 3) float
        Points S to be shaded.
    light : (E, 3) float, or (n, 2, 3)
        Two ends of a linear light or the corners of a convex area light; or a line a point.
    samples : (n, K, 3) float
        Points on the light, one a ray.
    check : bool
        Whether polygons are checked against the light's planes (Figure 4) or not (Figure 2).
    boxes : bool
        Check the corners of bounding boxes in place of vertices: Woo's form for surfaces more
        complex than a polygon.  Culls no more than vertices do.
    weights : "equal" or (n, K) float
        ``"equal"`` is the paper's ``occlusion /= K``: a share of length or area.
        :func:`irradiance_weights` makes it a share of irradiance.  A row of zeros gives 0.
    skip_polygons : (n, 2) int, optional
        The receiver's and the light's own polygon, excluded by identity.
    ids : RayIDs, optional
        Mailboxes and counter to go on with, as when several lights are shaded in turn from one
        set of mailboxes; needs ``workers=1``.  By default each worker has fresh ones.
    workers : int
        Threads.  Answers and counts do not depend on it.
    count_any_hit : bool
        Trace again for nearest hits, only to count ``any_hit_tests_saved``: the tests that
        stopping at the first hit found saved.
    margin : float
        See :data:`MARGIN`; tests lower it to show that the law then breaks.

    Raises
    ------
    InputError
        If an argument is out of its range, a sample lies off the light or on its point, or the
        light is concave.
    """
    place = as_points(points)
    lights, targets = _lights(light, len(place)), _samples(samples, len(place))
    if len(place):
        _check_on_light(lights, targets)
        if not (targets != place[:, None]).any(axis=2).all():
            raise InputError("samples: a sample lies on its point; move the point off the light")
    run = _Run(grid, place, lights, skip_polygons, ids, workers)
    if count_any_hit and run.transparent:
        raise InputError("count_any_hit: found transparent surfaces, expected opaque ones: no ray stops at its first")
    rays = targets.shape[1]
    transmitted = np.empty((len(place), rays, run.bands))

    def loop(mode, target):
        return lambda rows, own, counts: _light_loop(
            grid.objects, grid.cells, place[rows], run.lights_of(rows), targets[rows], run.skip[rows], mode,
            check, boxes, margin, run.reach, own.mailbox, own.touched, own.current, own.limit, target[rows], counts,
        )  # fmt: skip

    counters = run(rays, loop(run.mode, transmitted))
    if count_any_hit:
        run.ids = None
        nearest = run(rays, loop(CLOSEST, np.empty_like(transmitted)))
        saved = sum(nearest[name] - counters[name] for name in ("polygon_tests", "sphere_tests"))
        counters.add(any_hit_tests_saved=saved)
    shots = np.full(len(place), rays, dtype=np.int64)
    return LightOcclusion(_weighted(transmitted, weights), transmitted, shots, counters)


def adaptive_linear_occlusion(
    grid: VoxelGrid,
    points: ArrayLike,
    light: ArrayLike,
    *,
    levels: tuple[int, int] = (1, 4),
    check: bool = True,
    boxes: bool = False,
    skip_polygons: ArrayLike | None = None,
    ids: RayIDs | None = None,
    workers: int = 1,
    margin: float = MARGIN,
) -> LightOcclusion:
    """Occlusion of a linear light with 3 to 17 rays a point (Woo 1993, "adaptive variation").

    Rays go to the ends and the middle; a stretch between two samples is halved where their
    occlusion differs.  The counter then jumps to m + K, K = 17, whatever was shot.  Each stretch
    counts by its length and the mean of its ends: equal weights, as in the paper.

    Three samples that agree settle the light: a gap or an occluder between them, up to half of
    it, goes unseen.  ``levels=(4, 4)`` shoots all 17, which miss at most 1/16 between two of them.

    Parameters
    ----------
    grid, points, check, boxes, skip_polygons, ids, workers, margin
        As in :func:`light_occlusion`.
    light : (2, 3) or (n, 2, 3) float
    levels : (int, int)
        Least and most halvings of the line: 2^level + 1 samples.

    Raises
    ------
    InputError
        If an argument is out of its range or the light is not a line.
    """
    place = as_points(points)
    lights = _lights(light, len(place))
    if lights.shape[1] != 2:
        raise InputError(f"light: found {lights.shape[1]} corners, expected the two ends of a linear light")
    least, most = levels
    if not 0 <= least <= most <= 16:
        raise InputError(f"levels: found {levels}, expected 0 <= least <= most <= 16")
    share = np.arange(2**most + 1)[:, None] / 2**most
    if (place[:, None] == lights[:, :1] + share * (lights[:, 1:] - lights[:, :1])).all(axis=2).any():
        raise InputError("points: a point lies on a sample of the light; move it off the light")
    run = _Run(grid, place, lights, skip_polygons, ids, workers)
    occlusion = np.empty((len(place), run.bands))
    shots = np.empty(len(place), dtype=np.int64)
    counters = run(
        2**most + 1,
        lambda rows, own, counts: _adaptive_loop(
            grid.objects, grid.cells, place[rows], run.lights_of(rows), run.skip[rows], run.mode, check, boxes,
            margin, run.reach, (least, most), own.mailbox, own.touched, own.current, own.limit,
            occlusion[rows], shots[rows], counts,
        ),
    )  # fmt: skip
    return LightOcclusion(occlusion, None, shots, counters)


def adaptive_area_occlusion(
    grid: VoxelGrid,
    points: ArrayLike,
    light: ArrayLike,
    *,
    levels: tuple[int, int] = (0, 3),
    check: bool = True,
    boxes: bool = False,
    skip_polygons: ArrayLike | None = None,
    ids: RayIDs | None = None,
    workers: int = 1,
    margin: float = MARGIN,
) -> LightOcclusion:
    """Occlusion of a four-cornered light with 4 to 81 rays a point: corners, then quadrants.

    The area counterpart of :func:`adaptive_linear_occlusion`.  Rays go to the corners; a cell
    whose four corners differ is cut in four by straight lines between the middles of its edges.
    The counter then jumps to m + K, K = (2^most + 1)^2 the largest number of rays possible,
    whatever was shot.  Each cell counts by its area and the mean of its corners: equal weights.

    Four corners that agree settle their cell: what lies between them, all of the light with
    ``least`` of 0, goes unseen.  ``levels=(n, n)`` shoots the whole lattice.

    Parameters
    ----------
    grid, points, check, boxes, skip_polygons, ids, workers, margin
        As in :func:`light_occlusion`.
    light : (4, 3) float
        Corners of a parallelogram or another convex quad, in order.
    levels : (int, int)
        Least and most halvings of an edge.

    Raises
    ------
    InputError
        If an argument is out of its range, the light is no convex quad or a point lies on it.
    """
    place = as_points(points)
    lights = _lights(light, len(place))
    if lights.shape[1] != 4:
        raise InputError(f"light: found {lights.shape[1]} corners, expected the four of a convex quad")
    least, most = levels
    if not 0 <= least <= most <= 8:
        raise InputError(f"levels: found {levels}, expected 0 <= least <= most <= 8")
    spans = 2**most
    lattice = np.array(
        [
            [[_on_quad(lights[0], i / spans, j / spans, k) for k in range(3)] for j in range(spans + 1)]
            for i in range(spans + 1)
        ]
    ).reshape(1, -1, 3)
    _check_on_light(lights, lattice)
    for corner in lattice[0]:
        if (place == corner).all(axis=1).any():
            raise InputError("points: a point lies on a sample of the light; move it off the light")
    run = _Run(grid, place, lights, skip_polygons, ids, workers)
    occlusion = np.empty((len(place), run.bands))
    shots = np.empty(len(place), dtype=np.int64)
    counters = run(
        (spans + 1) ** 2,
        lambda rows, own, counts: _adaptive_area_loop(
            grid.objects, grid.cells, place[rows], lights[0], run.skip[rows], run.mode, check, boxes, margin,
            run.reach, (least, most), own.mailbox, own.touched, own.current, own.limit,
            occlusion[rows], shots[rows], counts,
        ),
    )  # fmt: skip
    return LightOcclusion(occlusion, None, shots, counters)


def soft_shadow_kludge(
    grid: VoxelGrid,
    points: ArrayLike,
    normals: ArrayLike,
    position: ArrayLike,
    fractions: ArrayLike,
    *,
    length: float = 2.0,
    check: bool = True,
    skip_polygons: ArrayLike | None = None,
    workers: int = 1,
) -> LightOcclusion:
    """Woo's "kludge that faked soft shadows from point lights", kept as a historical method.

    One ray goes to the point light P.  Only where it is blocked do K rays go to a line from P to
    P + 2 N, N the surface's unit normal at the point.

    **Do not take it for a soft shadow.**  A point that sees P counts as fully lit, so there is no
    outer penumbra and the shadow keeps a hard edge: below an occluder edge at half height, a
    point from which 2/3 of the line is blocked is reported 0 blocked.

    Parameters
    ----------
    grid, check, skip_polygons, workers
        As in :func:`light_occlusion`.
    points, normals : (n, 3) float
    position : (3,) float
        P.
    fractions : (K,) or (n, K) float
        Where on the line the K rays end. [0..1]
    length : float
        Length of the line, 2 in the paper. [scene lengths]

    Raises
    ------
    InputError
        If an argument is out of its range or a point lies on the line.
    """
    place, normal = as_points(points), as_unit_vectors(normals)
    light = as_points(position, "position")[0]
    if length <= 0.0 or not math.isfinite(length):
        raise InputError(f"length: found {length}, expected a positive length")
    share = np.asarray(fractions, dtype=np.float64)
    if share.ndim not in (1, 2) or not ((share >= 0.0) & (share <= 1.0)).all():
        raise InputError(f"fractions: found shape {share.shape}, expected (K,) or (n, K) values from 0 to 1")
    share = np.broadcast_to(share, (len(place), share.shape[-1]))
    skip = as_skip_polygons(skip_polygons, len(place))
    lines = np.stack([np.broadcast_to(light, place.shape), light + length * np.broadcast_to(normal, place.shape)], 1)
    single = light_occlusion(
        grid, place, lines, lines[:, :1], check=False, skip_polygons=skip, workers=workers
    )  # fmt: skip
    hidden = np.flatnonzero(single.occlusion.any(axis=1))
    ends = lines[hidden, :1] + share[hidden, :, None] * (lines[hidden, 1:] - lines[hidden, :1])
    soft = light_occlusion(
        grid, place[hidden], lines[hidden], ends, check=check, skip_polygons=skip[hidden], workers=workers
    )  # fmt: skip
    occlusion = single.occlusion.copy()
    occlusion[hidden] = soft.occlusion
    shots = single.shots.copy()
    shots[hidden] += soft.shots
    counters = Counters()
    counters.merge(single.counters)
    counters.merge(soft.counters)
    return LightOcclusion(occlusion, None, shots, counters)
