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

__all__ = ["HemisphereRays", "RayExchanges", "least_seconds"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

RANDOMISATIONS = 16
"""Independent random shifts of a row's rays."""
FIRST_RAYS = 4
"""Rays a row and randomisation of the first round, which tells how many are needed."""
BOUND_OF_NONE = 3.0
"""Hits that a pair may have had where none was seen."""
AIM = 0.8
"""Part of the wanted error that is aimed at: to close rows adds to what is stated."""
MOST_GROWTH = 8.0
"""Most times as many rays after a round as before it."""
RAY_SECONDS, ENTRY_SECONDS, START_SECONDS, PIECE_SECONDS = 1.3e-7, 1.5e-7, 1e-3, 3e-6
"""Processor seconds of a ray, of an entry of the matrix, to prepare, and of it each piece."""
QUASI_RANDOM = 0.9
"""Power of the growth at 1 / sqrt(N) that is enough: quasi-random rays do better."""
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
def _landing(polygon, directions, normal, front, back):
    """Row on which each ray lands that meets a polygon (-1: none) of the given normals and rows on both sides."""
    for q in range(polygon.shape[0]):
        p = polygon[q]
        if p >= 0:
            along = 0.0
            for axis in range(3):
                along += directions[q, axis] * normal[p, axis]
            polygon[q] = front[p] if along < 0.0 else back[p]


@njit(nogil=True, cache=True)
def _count(first, rays, met, counts):
    """Add one to the count of each ray's row, randomisation and column."""
    for q in range(met.shape[0]):
        if met[q] >= 0:
            number = (first + q) // rays
            counts[number // RANDOMISATIONS, number % RANDOMISATIONS, met[q]] += 1


@njit(nogil=True, cache=True)
def _summed(counts, total, variance):
    """Sums (m, n) of counts (m, randomisations, n) and the variances of these sums, from the scatter."""
    many = counts.shape[1]
    for i in range(counts.shape[0]):
        for k in range(many):
            for j in range(counts.shape[2]):
                total[i, j] += counts[i, k, j]
                variance[i, j] += counts[i, k, j] * counts[i, k, j]
        for j in range(counts.shape[2]):
            variance[i, j] = (many * variance[i, j] - total[i, j] * total[i, j]) / (many - 1)


def least_seconds(rows: int, pieces: int, error: float) -> float:
    """Processor seconds that rays take at the least: to prepare, to trace what the easiest rows need, to sum up.

    Rows were measured to need from 1.1 error^-2 rays at 0.01, where they see few others, and from 0.04 n error^-2 at
    0.1 where they see many of n, less at smaller errors.
    """
    rays = max(FIRST_RAYS * RANDOMISATIONS, 0.3 * error**-1.9, 0.02 * rows * error**-1.9)
    return START_SECONDS + PIECE_SECONDS * pieces + rows * rays * RAY_SECONDS + rows**2 * ENTRY_SECONDS


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
        # In the tracer's unit coordinates.
        centre, scale = self._tracer.frame
        self._offset = self._tracer.offset * scale
        self._triangles = np.ascontiguousarray((triangles[order] - centre) * scale)
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
        total, variance = np.zeros((n, n)), np.zeros((n, n))
        batch = max(1, COUNTS // (RANDOMISATIONS * n))
        for base in range(0, n, batch):
            some = min(batch, n - base)
            counts = np.zeros((some, RANDOMISATIONS, n), dtype=np.int32)
            whole = some * RANDOMISATIONS * rays

            def trace(first: int, base: int = base, whole: int = whole) -> IntArray:
                return self._landed(first, min(BLOCK_RAYS, whole - first), rays, base, turn, seed)

            # A few blocks ahead of the counting, whose rays would else pile up.
            for ahead in range(0, whole, 64 * BLOCK_RAYS):
                blocks = range(ahead, min(ahead + 64 * BLOCK_RAYS, whole), BLOCK_RAYS)
                for first, met in zip(blocks, each(trace, blocks), strict=True):
                    _count(first, rays, met, counts)
            counters.add(rays=whole)
            _summed(counts, total[base : base + some], variance[base : base + some])
        return total, variance

    def _landed(self, first: int, count: int, rays: int, base: int, turn: int, seed: int) -> IntArray:
        """Row on which each ray of a block lands, or -1."""
        origins, directions = np.empty((count, 3), dtype=np.float32), np.empty((count, 3), dtype=np.float32)
        _rays(
            first, count, rays, base, turn, seed, self._start, self._triangles, self._normals, self._upto,
            self._offset, origins, directions,
        )  # fmt: skip
        met = self._tracer.first_raw(origins, directions)
        _landing(met, directions, self._normal, self._front, self._back)
        return met


class RayExchanges:
    """Symmetric exchange areas ``A_i F_ij`` between rows by rays, to which rays are added until they are good enough.

    The hits of both directions of a pair are added up: by reciprocity they have the variances A_i S / N and A_j S / N
    of an exchange area S, whose inverses as weights give the hits of both over N / A_i + N / A_j.  The weights
    don't depend on what was hit, so the mean is not biased.  No error is less than that of one hit, and that of a
    pair that no ray has met is three hits, by the rule of three (J. A. Hanley and A. Lippman-Hand, JAMA 249, 1983).

    Of all those pairs together far less is known to be missing than the sum of their bounds: about as many hits as
    there are pairs of exactly one (I. J. Good, "The population frequencies of species and the estimation of population
    parameters", Biometrika 40, 1953).

    Parameters
    ----------
    source : HemisphereRays
    areas : (n,) float
    seed : int
    counters : Counters
        Gets ``rays``.
    """

    def __init__(self, source: HemisphereRays, areas: FloatArray, seed: int, counters: Counters) -> None:
        self._source, self._seed, self._counters = source, seed, counters
        self._inverse = 1.0 / areas
        self._facing = source.facing()
        self._own = np.eye(len(areas), dtype=bool)
        self._hits, self._variance = np.zeros(self._own.shape), np.zeros(self._own.shape)
        self._rays = self._turn = 0

    @property
    def rays(self) -> int:
        """Rays a row."""
        return self._rays * RANDOMISATIONS

    def add(self, rays: int, each: Callable[..., Any]) -> None:
        """Trace so many rays more a row and randomisation; ``each`` is ``map``, or that of a pool of threads."""
        found = self._source.hits(rays, self._turn, self._seed, each, self._counters)
        for sums, part in zip((self._hits, self._variance), found, strict=True):
            sums += np.where(self._facing, part, 0.0)
        self._rays += rays
        self._turn += 1
        both_ways = self._inverse[:, None] + self._inverse
        self._hit = 1.0 / (self.rays * np.where(self._own, self._inverse[:, None], both_ways))
        self._both = np.where(self._own, self._hits, self._hits + self._hits.T)
        variance = np.where(self._own, self._variance, self._variance + self._variance.T)
        met = self._both > 0.0
        least = np.where(met, 1.0, BOUND_OF_NONE**2)
        self._spread = np.sqrt(np.maximum(variance, least)) * self._hit * self._facing
        # Mean over the rows of the sum of the errors of F: of what was met, and bounds of the rest.
        row_error = self._spread * self._inverse[:, None]
        n = len(self._inverse)
        self._met_error = float(row_error.sum(where=met)) / n
        self._bounds = float(row_error.sum(where=~met)) / n
        # Each pair counts 1 / N in the sum of its rows.
        single, double = (int(np.count_nonzero(np.triu((self._both == k) & self._facing))) for k in (1.0, 2.0))
        missing = single + 2.0 * math.sqrt(single) + BOUND_OF_NONE
        self._missing = min(missing / (self.rays * n), self._bounds)
        # Pairs that no ray has met yet are at least as many as share these hits (A. Chao, Scand. J. Stat. 11, 1984).
        self._unmet_error = math.sqrt(single * single * single / max(2.0 * double, 1.0)) / (self.rays * n)

    @property
    def stated(self) -> float:
        """Mean over the rows of the sum of the errors of F."""
        return self._met_error + self._missing

    @property
    def surplus(self) -> float:
        """By how much the sum of the entries' errors exceeds ``stated``: they bound each entry that no ray has met."""
        return self._bounds - self._missing

    def _wanted(self, error: float) -> float:
        """Rays a row and randomisation for an error, if scatter falls with their root and what is missing with them."""
        root = (self._met_error + self._unmet_error) * math.sqrt(self._rays) / (2.0 * AIM * error)
        return (root + math.sqrt(root * root + self._missing * self._rays / (AIM * error))) ** 2

    def seconds(self, error: float) -> float:
        """Processor seconds that the rays from here on to an error are expected to take."""
        growth = max(self._wanted(error) / self._rays, 1.0) ** QUASI_RANDOM
        return (growth - 1.0) * self._rays * RANDOMISATIONS * len(self._inverse) * RAY_SECONDS

    def reach(self, error: float, each: Callable[..., Any], progress: Callable[[float], None] | None = None) -> None:
        """Add rays until ``stated`` is below the aim of an error."""
        while self.stated > AIM * error:
            if progress is not None:
                progress(min((AIM * error / self.stated) ** 2, 1.0))
            most = MOST_GROWTH * self._rays
            self.add(max(math.ceil(min(self._wanted(error), most)) - self._rays, self._rays // 4, 1), each)

    def matrices(self) -> tuple[FloatArray, NDArray[np.float32]]:
        """Exchange areas and their errors, (n, n)."""
        return self._both * self._hit, self._spread.astype(np.float32)
