"""Form factors by cosine-distributed rays from each row, for few rows of many polygons.

Where a surface is made of thousands of polygons, going through its pairs of polygons takes far longer than its few
form factors are worth.  Rays that leave it uniformly by area and with a cosine density land on each other surface
with the probability of its form factor (P. Shirley, "A ray tracing method for illumination calculations in
diffuse-specular scenes", Graphics Interface 1990), however many polygons it has.

Rays lie on a Kronecker sequence in four dimensions (two of the point, two of the direction), shifted at random
(R. Cranley and T. N. L. Patterson 1976); the scatter of :data:`RANDOMISATIONS` independent shifts is the standard
error.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from radiosity.form_factors._sampling import stream
from radiosity.form_factors.directional import element_geometry
from workbench.accel.embree import BLOCK_RAYS, EmbreeAccelerator
from workbench.counters import Counters
from workbench.geometry.polygons import fan_triangles

__all__ = ["HemisphereRays", "predicted_rays", "ray_exchanges"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

RANDOMISATIONS = 16
"""Independent random shifts of a row's rays."""
FIRST_RAYS = 64
"""Rays a row and randomisation of the first round."""
AIM = 0.8
"""Part of the wanted error that is aimed at: to close rows adds to what is stated."""
MOST_GROWTH = 16.0
"""Most times as many rays after a round as before it."""
COUNTS = 1 << 24
"""Most counts (row, randomisation, column) held at once."""

# Generalised golden ratio in four dimensions (M. Roberts 2018): g solves g^5 = g + 1.
_G4 = 1.1673039782614187


@njit(nogil=True, cache=True)
def _rays(
    first, count, rays, base, turn, seed, row_start, triangles, normals, upto, offset, origins, directions
):  # fmt: skip
    """Rays ``first`` to ``first + count`` of all: by rows from ``base``, in them by randomisations, ``rays`` each."""
    shift = np.empty(4)
    last = -1
    t0 = t1 = 0
    for q in range(count):
        number = (first + q) // rays
        k = (first + q) % rays
        row, shake = base + number // RANDOMISATIONS, number % RANDOMISATIONS
        if number != last:
            last = number
            for axis in range(4):
                bits = stream(row, (turn * RANDOMISATIONS + shake) * 4 + axis, seed)
                shift[axis] = np.float64(bits >> np.uint64(11)) * 2.0**-53
            t0, t1 = row_start[row], row_start[row + 1]
        u = (shift[0] + k / _G4) % 1.0
        v = (shift[1] + k / _G4**2) % 1.0
        square = (shift[2] + k / _G4**3) % 1.0
        phi = 2.0 * math.pi * ((shift[3] + k / _G4**4) % 1.0)
        # A triangle by its area, a point of it by what is left of u.
        goal = u * upto[t1 - 1]
        low, high = t0, t1 - 1
        while low < high:
            middle = (low + high) // 2
            if upto[middle] > goal:
                high = middle
            else:
                low = middle + 1
        before = upto[low - 1] if low > t0 else 0.0
        s = math.sqrt(min(max((goal - before) / max(upto[low] - before, 1e-300), 0.0), 1.0))
        p, r = s * (1.0 - v), s * v
        nx, ny, nz = normals[low, 0], normals[low, 1], normals[low, 2]
        # T. Duff et al. 2017; equal steps of the sine squared are equal cosine-weighted parts (Malley).
        sign = 1.0 if nz >= 0.0 else -1.0
        a = -1.0 / (sign + nz)
        b = nx * ny * a
        sine, cosine = math.sqrt(square), math.sqrt(1.0 - square)
        x, y = sine * math.cos(phi), sine * math.sin(phi)
        directions[q, 0] = x * (1.0 + sign * nx * nx * a) + y * b + cosine * nx
        directions[q, 1] = x * sign * b + y * (sign + ny * ny * a) + cosine * ny
        directions[q, 2] = -x * sign * nx - y * ny + cosine * nz
        for axis in range(3):
            corner = triangles[low, 0, axis]
            along = p * (triangles[low, 1, axis] - corner) + r * (triangles[low, 2, axis] - corner)
            origins[q, axis] = corner + along + offset * normals[low, axis]


@njit(nogil=True, cache=True)
def _count(first, rays, met, counts):
    """Add one to the count of each ray's row, randomisation and column."""
    for q in range(met.shape[0]):
        if met[q] >= 0:
            number = (first + q) // rays
            counts[number // RANDOMISATIONS, number % RANDOMISATIONS, met[q]] += 1


def predicted_rays(rows: int, error: float) -> float:
    """Rays of all rows for an error, if every row sees all others alike: the most that it can take.

    A row of n equal entries, each met from both ends, has the mean error sqrt(n / (2 N)) after N rays a row, and less
    than n / N more of what none has met.
    """
    root = math.sqrt(rows / 2.0) / (2.0 * AIM * error)
    return rows * max((root + math.sqrt(root * root + rows / (AIM * error))) ** 2, RANDOMISATIONS * FIRST_RAYS)


class HemisphereRays:
    """Rays from the rows of a matrix, and where they land.

    A ray that meets the back of a one-sided polygon, or nothing, lands nowhere.  Panes are taken for opaque.

    Parameters
    ----------
    mesh
        Elements with their pieces, as of :class:`radiosity.patches.PatchMesh`, not clustered.
    row_of : (e,) int
        Row of each element; every row has an area.
    """

    def __init__(self, mesh: Any, row_of: IntArray) -> None:
        elements, front, other = element_geometry(mesh)
        self._tracer = EmbreeAccelerator(elements)
        self._normal = elements.polygon_normal
        self._front = row_of[front]
        back = other[front]
        self._back = np.where(back >= 0, row_of[back], -1)
        triangles, piece = fan_triangles(mesh.corners, mesh.piece_start)
        owner = row_of[mesh.piece_element[piece]]
        order = np.argsort(owner, kind="stable")
        self.rows = int(row_of.max()) + 1
        self._triangles = np.ascontiguousarray(triangles[order])
        self._normals = np.ascontiguousarray(mesh.piece_normal[piece[order]])
        self._start = np.searchsorted(owner[order], np.arange(self.rows + 1)).astype(np.int64)
        edges = self._triangles[:, 1:] - self._triangles[:, :1]
        area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        # Summed row by row: sums of all would leave small rows few digits.
        self._upto = np.concatenate(
            [np.cumsum(area[a:b]) for a, b in zip(self._start[:-1], self._start[1:], strict=True)]
        )

    def facing(self) -> NDArray[np.bool_]:
        """Whether each pair of rows (n, n) may exchange: neither lies wholly behind the other's plane, if any."""
        behind = np.zeros((self.rows, self.rows), dtype=bool)
        corners = self._triangles.reshape(-1, 3)
        size = float(np.abs(corners - corners.mean(axis=0)).max())
        corners = corners - corners.mean(axis=0)
        for row in range(self.rows):
            t0, t1 = self._start[row], self._start[row + 1]
            normal = self._normals[t0]
            height = corners @ normal
            level = height[3 * t0]
            flat = np.abs(height[3 * t0 : 3 * t1] - level).max() <= 1e-9 * size
            if flat and (self._normals[t0:t1] @ normal > 0).all():
                behind[row] = np.maximum.reduceat(height, 3 * self._start[:-1]) - level <= 1e-9 * size
        return ~(behind | behind.T)

    def hits(self, rays: int, turn: int, seed: int, each: Callable[..., Any], counters: Counters) -> tuple[Any, Any]:
        """Trace a round; hits (n, n) of each row's rays on each, and the variances of these numbers.

        Parameters
        ----------
        rays : int
            A row and randomisation: :data:`RANDOMISATIONS` times as many a row.
        turn : int
            Number of the round, which has random shifts of its own.
        seed : int
        each : callable
            ``map``, or that of a pool of threads.
        counters : Counters
            Gets ``rays``.
        """
        n = self.rows
        total, variance = np.empty((n, n)), np.empty((n, n))
        batch = max(1, COUNTS // (RANDOMISATIONS * n))
        for base in range(0, n, batch):
            some = min(batch, n - base)
            counts = np.zeros((some, RANDOMISATIONS, n), dtype=np.int64)
            whole = some * RANDOMISATIONS * rays

            def trace(first: int, base: int = base, whole: int = whole) -> IntArray:
                return self._landed(first, min(BLOCK_RAYS, whole - first), rays, base, turn, seed)

            # A few blocks ahead of the counting, whose rays would else pile up.
            for ahead in range(0, whole, 64 * BLOCK_RAYS):
                blocks = range(ahead, min(ahead + 64 * BLOCK_RAYS, whole), BLOCK_RAYS)
                for first, met in zip(blocks, each(trace, blocks), strict=True):
                    _count(first, rays, met, counts)
            counters.add(rays=whole)
            total[base : base + some] = counts.sum(axis=1)
            variance[base : base + some] = RANDOMISATIONS * counts.var(axis=1, ddof=1)
        return total, variance

    def _landed(self, first: int, count: int, rays: int, base: int, turn: int, seed: int) -> IntArray:
        """Row on which each ray of a block lands, or -1."""
        origins, directions = np.empty((count, 3)), np.empty((count, 3))
        _rays(
            first, count, rays, base, turn, seed, self._start, self._triangles, self._normals, self._upto,
            self._tracer.offset, origins, directions,
        )  # fmt: skip
        met = self._tracer.closest_hit(origins, directions).polygon
        place = np.maximum(met, 0)
        before = np.einsum("ij,ij->i", directions, self._normal[place]) < 0.0
        return np.where(met >= 0, np.where(before, self._front[place], self._back[place]), -1)


def ray_exchanges(
    source: HemisphereRays,
    areas: FloatArray,
    error: float,
    seed: int,
    each: Callable[..., Any],
    counters: Counters,
    progress: Callable[[float], None] | None = None,
) -> tuple[FloatArray, NDArray[np.float32], int]:
    """Symmetric exchange areas ``A_i F_ij`` by rays, their standard errors, and the rays a row.

    Rays are added until the mean over the rows of the sum of the errors of F is below ``error``.

    The hits of both directions of a pair are added up: by reciprocity they have the variances A_i S / N and A_j S / N
    of an exchange area S, whose inverses as weights give the hits of both over N / A_i + N / A_j.  The weights
    don't depend on what was hit, so the mean is not biased.  No error is less than that of one hit, and that of a
    pair that no ray has met is three hits, by the rule of three (J. A. Hanley and A. Lippman-Hand, JAMA 249, 1983).
    """
    n = len(areas)
    facing = source.facing()
    hits, variance = np.zeros((n, n)), np.zeros((n, n))
    done, rays, turn = 0, FIRST_RAYS, 0
    inverse = 1.0 / areas
    own = np.eye(n, dtype=bool)
    while True:
        found = source.hits(rays, turn, seed, each, counters)
        for sums, part in zip((hits, variance), found, strict=True):
            sums += np.where(facing, part, 0.0)
        done += rays
        turn += 1
        each_hit = 1.0 / (done * RANDOMISATIONS * np.where(own, inverse[:, None], inverse[:, None] + inverse))
        both = np.where(own, hits, hits + hits.T)
        least = np.where(both > 0.0, 1.0, 9.0)  # the square of one hit, and of three
        spread = np.sqrt(np.maximum(np.where(own, variance, variance + variance.T), least)) * each_hit * facing
        stated = float((spread.sum(axis=1) * inverse).mean())
        if progress is not None:
            progress(min((AIM * error / stated) ** 2, 1.0))
        if stated <= AIM * error:
            return both * each_hit, spread.astype(np.float32), done * RANDOMISATIONS
        wanted = done * min((stated / (AIM * error)) ** 2, MOST_GROWTH)
        rays = max(math.ceil(wanted) - done, done // 4)
