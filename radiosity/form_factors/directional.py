"""Directional bundles: form factors by rays shot from a patch, stratum by stratum of its hemisphere.

P. Shirley, "A ray tracing method for illumination calculations in diffuse-specular scenes" (Graphics
Interface 1990), lets each patch send its power along rays with a cosine density; what a ray meets first
takes its share.  Here the hemisphere is cut into strata of equal cosine-weighted size, and each stratum
is a bundle of rays from one point of the patch.  A. Woo, "Efficient Shadow Computations in Ray Tracing"
(IEEE CG&A 1993), proposes his plane-vertex check for such bundles: a polygon with all its vertices
outside one of the bundle's planes is rejected before any intersection.

The hemisphere is cut along meridians and parallels.  A bundle's planes go through its point: two
meridians; the plane that touches the outer parallel's cone in the middle; the plane through the two
inner corners; and the patch's own.  All of a stratum lies within them.

:class:`DirectionalBundles` traces with Embree and gives columns to the solvers as
:class:`~radiosity.form_factors.bundle.ReceiverBundles` does; :func:`instrument_bundles` counts tests in
the voxel grid, with the check and without.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from radiosity.form_factors._sampling import place_on_pieces, stream
from radiosity.form_factors.bundle import Columns, LinkSettings
from radiosity.patches import PatchMesh
from workbench.accel.base import NO_POLYGON, Hits
from workbench.accel.embree import EmbreeAccelerator
from workbench.accel.voxel_grid import CLOSEST, COUNTED, RayIDs, VoxelGrid, walk
from workbench.counters import Counters
from workbench.errors import OptionError
from workbench.geometry.flat import Geometry

__all__ = [
    "BundleHits",
    "Bundles",
    "DirectionalBundles",
    "bundle_planes",
    "bundle_rays",
    "instrument_bundles",
    "strata_of",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

RAYS_A_BUNDLE = 8
LEAST_RAYS = 2048
"""Of a patch, however few the elements."""
REPLICATES = 16
"""Independent random shifts of all the strata: their scatter is the standard error."""
LEAST_SECTORS = 4
"""Strata round the normal: each must span less than half a turn."""
MARGIN = 64.0
"""Units in the last place of the coordinates by which a rejected polygon must lie outside."""

# Generalised golden ratio in four dimensions (M. Roberts 2018): g solves g^5 = g + 1.
_G4 = 1.1673039782614187
# ... and in two.
_G2 = 1.3247179572447460


def strata_of(bundles: int) -> tuple[int, int]:
    """Rings and sectors of the hemisphere, about as wide as high, for about so many strata."""
    rings = max(1, round(math.sqrt(bundles / 4.0)))
    return rings, max(LEAST_SECTORS, round(bundles / rings))


@njit(nogil=True, cache=True)
def _frame(nx, ny, nz):
    """Two unit vectors that make a right-handed frame with the unit normal (T. Duff et al. 2017)."""
    sign = 1.0 if nz >= 0.0 else -1.0
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return 1.0 + sign * nx * nx * a, sign * b, -sign * nx, b, sign + ny * ny * a, -ny


@njit(nogil=True, cache=True)
def _planes(ring, sector, rings, sectors, nx, ny, nz, margin, planes):
    """Outward planes (5, 4) of a stratum's bundle, through its point: normals and the margin to lie outside by."""
    ux, uy, uz, vx, vy, vz = _frame(nx, ny, nz)
    first, last = 2.0 * math.pi * sector / sectors, 2.0 * math.pi * (sector + 1) / sectors
    middle, half = 0.5 * (first + last), 0.5 * (last - first)
    low, high = math.asin(math.sqrt(ring / rings)), math.asin(min(math.sqrt((ring + 1) / rings), 1.0))
    # Rows in the frame (u, v, n).
    local = (
        (math.sin(first), -math.cos(first), 0.0),
        (-math.sin(last), math.cos(last), 0.0),
        (math.cos(high) * math.cos(middle), math.cos(high) * math.sin(middle), -math.sin(high)),
        (-math.cos(low) * math.cos(middle), -math.cos(low) * math.sin(middle), math.sin(low) * math.cos(half)),
        (0.0, 0.0, -1.0),
    )
    for k in range(5):
        a, b, c = local[k]
        planes[k, 0] = a * ux + b * vx + c * nx
        planes[k, 1] = a * uy + b * vy + c * ny
        planes[k, 2] = a * uz + b * vz + c * nz
        planes[k, 3] = margin


@njit(nogil=True, cache=True)
def _bundle_rays(
    patch, replicate, seed, rings, sectors, rays, corners, start, normals, first, last, area, origins, directions,
    pieces,
):  # fmt: skip
    """Points (bundles, 3), unit directions (bundles, rays, 3) and the piece of each point."""
    h = stream(patch, replicate, seed)
    s1 = np.float64(h & np.uint64(0xFFFFFF)) / 16777216.0
    s2 = np.float64((h >> np.uint64(24)) & np.uint64(0xFFFFFF)) / 16777216.0
    g3, g4 = 1.0 / _G4**3, 1.0 / _G4**4
    for b in range(rings * sectors):
        ring, sector = b // sectors, b % sectors
        piece = place_on_pieces(
            corners, start, first, last, area, (s1 + b * g3) % 1.0, (s2 + b * g4) % 1.0, origins[b]
        )  # fmt: skip
        pieces[b] = piece
        nx, ny, nz = normals[piece, 0], normals[piece, 1], normals[piece, 2]
        ux, uy, uz, vx, vy, vz = _frame(nx, ny, nz)
        own = stream(patch * 1000003 + b, replicate + 7919, seed)
        r1 = np.float64(own & np.uint64(0xFFFFFF)) / 16777216.0
        r2 = np.float64((own >> np.uint64(24)) & np.uint64(0xFFFFFF)) / 16777216.0
        for k in range(rays):
            # Equal steps in sin^2 of the angle to the normal are equal cosine-weighted parts (Malley).
            square = (ring + (r1 + k / _G2) % 1.0) / rings
            phi = 2.0 * math.pi * (sector + (r2 + k / _G2**2) % 1.0) / sectors
            sine, cosine = math.sqrt(square), math.sqrt(max(1.0 - square, 0.0))
            a, c = sine * math.cos(phi), sine * math.sin(phi)
            directions[b, k, 0] = a * ux + c * vx + cosine * nx
            directions[b, k, 1] = a * uy + c * vy + cosine * ny
            directions[b, k, 2] = a * uz + c * vz + cosine * nz


@dataclass(frozen=True)
class Bundles:
    """Bundles of one patch and replicate: a point each, and the rays that leave it.

    Parameters
    ----------
    origins : (b, 3) float
    directions : (b, k, 3) float
        Unit vectors.
    normals : (b, 3) float
        Of the patch at the points.
    rings, sectors : int
        Strata of the hemisphere; bundle ``i`` is of ring ``i // sectors``, sector ``i % sectors``.
    """

    origins: FloatArray
    directions: FloatArray
    normals: FloatArray
    rings: int
    sectors: int


def bundle_rays(
    mesh: PatchMesh, patch: int, *, bundles: int, rays: int = RAYS_A_BUNDLE, replicate: int = 0, seed: int = 0
) -> Bundles:
    """The bundles of a patch: a quasi-random point a stratum, and quasi-random rays within it.

    Parameters
    ----------
    mesh : PatchMesh
    patch : int
    bundles : int
        About how many strata; the nearest full grid is taken.
    rays : int
        Rays a bundle.
    replicate, seed : int
        Of the random shifts.
    """
    rings, sectors = strata_of(bundles)
    count = rings * sectors
    origins, directions = np.empty((count, 3)), np.empty((count, rays, 3))
    pieces = np.empty(count, dtype=np.int64)
    _bundle_rays(
        patch, replicate, seed, rings, sectors, rays, mesh.sender_corners, mesh.sender_start, mesh.sender_normal,
        mesh.patch_sender[patch], mesh.patch_sender[patch + 1], mesh.patch_area[patch], origins, directions, pieces,
    )  # fmt: skip
    return Bundles(origins, directions, mesh.sender_normal[pieces], rings, sectors)


def bundle_planes(ring: int, sector: int, rings: int, sectors: int, normal: FloatArray) -> FloatArray:
    """Planes (5, 4) of a stratum's bundle relative to its point: outward normals, and zero.

    A direction of the stratum has ``n . d <= 0`` for each.

    Parameters
    ----------
    ring, sector : int
        Of the stratum, rings counted from the normal.
    rings, sectors : int
        In all; four sectors or more.
    normal : (3,) float
        Unit normal of the patch.
    """
    planes = np.empty((5, 4))
    nx, ny, nz = np.asarray(normal, dtype=np.float64).tolist()
    _planes(ring, sector, rings, sectors, nx, ny, nz, 0.0, planes)
    return planes


# ---- the engine -------------------------------------------------------------------------------


def element_geometry(mesh: Any) -> tuple[Geometry, IntArray, IntArray]:
    """What rays meet, a polygon an element; the element of each, and the one on its other side or -1."""
    front = np.flatnonzero(mesh.element_side > 0)
    back = np.flatnonzero(mesh.element_side < 0)
    other = np.full(mesh.element_count, -1, dtype=np.int64)
    if len(back):
        # Both sides of a face are divided alike, in one order.
        for surface in np.unique(mesh.element_surface[back]).tolist():
            mine = [s[mesh.element_surface[s] == surface] for s in (front, back)]
            order = [s[np.argsort(mesh.element_polygon[s], kind="stable")] for s in mine]
            other[order[0]] = order[1]
    place = np.full(mesh.element_count, -1, dtype=np.int64)
    place[front] = np.arange(len(front))
    keep = place[mesh.piece_element] >= 0
    sizes = np.diff(mesh.piece_start)
    corners = mesh.corners[np.repeat(keep, sizes)]
    geometry = Geometry(
        corners=np.ascontiguousarray(corners),
        piece_start=np.concatenate([[0], np.cumsum(sizes[keep])]).astype(np.int64),
        piece_normal=mesh.piece_normal[keep],
        piece_polygon=place[mesh.piece_element][keep],
        polygon_area=mesh.element_area[front],
        polygon_normal=mesh.element_normal[front],
        polygon_surface=np.zeros(len(front), dtype=np.int64),
        polygon_face=np.arange(len(front)),
        surface_material=(),
        surface_name=(),
        polygon_transmittance=np.zeros(len(front)),
    )
    return geometry, front, other


class DirectionalBundles:
    """Form-factor columns by directional bundles over threads; one object a solve.

    In a closed scene each column's power sums to what was sent, by construction: every ray lands.

    Parameters
    ----------
    geometry : Geometry
        The occluders.
    mesh : PatchMesh
    settings : LinkSettings
        A patch shoots ``rays`` times the number of elements, a quarter of that if it is faint.
    workers : int
        Threads; results do not depend on their number.
    """

    def __init__(self, geometry: Geometry, mesh: PatchMesh, settings: LinkSettings, workers: int = 1) -> None:
        self.mesh, self.settings, self.workers = mesh, settings, workers
        self.counters = Counters()
        self.seconds_in_embree = 0.0
        self.accelerator = EmbreeAccelerator(geometry, workers=1)
        elements, self._front, self._other = element_geometry(mesh)
        self._tracer = EmbreeAccelerator(elements)
        floor = settings.floor
        self._floor = 0.1 * settings.error / max(mesh.patch_count, 1) if floor is None else floor
        self._pool = ThreadPoolExecutor(workers)

    def close(self) -> None:
        """Stop the threads."""
        self._pool.shutdown()

    def take_counters(self) -> Counters:
        """The counts since this was last asked."""
        counters, self.counters = self.counters, Counters()
        return counters

    def _bundles_of(self, patch: int, floor: float) -> int:
        """Bundles a replicate; what is too faint to matter gets a quarter of the rays."""
        wanted = max(self.settings.rays * self.mesh.element_count, LEAST_RAYS)
        typical = float(self.mesh.patch_area[patch] / self.mesh.element_area.sum())
        if typical < floor:
            wanted = max(wanted // 4, LEAST_RAYS)
        return math.ceil(wanted / (REPLICATES * RAYS_A_BUNDLE))

    def columns(self, patches: Sequence[int] | IntArray, floors: FloatArray | None = None) -> Columns:
        """Form factors from all elements to each of ``patches``, and their standard errors.

        ``floors`` (k,) raises the absolute error that is good enough for a patch.
        """
        chosen = np.asarray(patches, dtype=np.int64)
        mesh = self.mesh
        n = mesh.element_count
        lowest = np.full(len(chosen), self._floor) if floors is None else np.maximum(floors, self._floor)
        counts = np.zeros((len(chosen), REPLICATES, n))
        shot = np.zeros(len(chosen))
        wanted = [self._bundles_of(int(p), float(f)) for p, f in zip(chosen, lowest, strict=True)]
        tasks = [(row, replicate) for row in range(len(chosen)) for replicate in range(REPLICATES)]

        def work(task: tuple[int, int]) -> tuple[int, int, float]:
            row, replicate = task
            made = bundle_rays(
                mesh, int(chosen[row]), bundles=wanted[row], replicate=replicate, seed=self.settings.seed
            )
            hit, seconds, traced = self._first_elements(made)
            counts[row, replicate] = np.bincount(hit[hit >= 0], minlength=n)
            return made.directions.shape[0], traced, seconds

        for (row, _), (bundles, traced, seconds) in zip(tasks, self._pool.map(work, tasks), strict=True):
            self.counters.add(rays=traced, bundles=bundles)
            self.seconds_in_embree += seconds
            shot[row] += bundles * RAYS_A_BUNDLE
        # Reciprocity: F from the element to the patch is that from the patch times the ratio of areas.
        weight = mesh.patch_area[chosen, None] / (mesh.element_area[None] * shot[:, None])
        factor = counts.sum(axis=1) * weight
        scatter = counts.std(axis=1, ddof=1) * math.sqrt(REPLICATES)
        # Replicates that agree by chance still leave the doubt of one ray.
        spread = np.maximum(scatter, 1.0) * weight
        own = mesh.element_patch[None] == chosen[:, None]
        flat = (mesh.patch_polygon[chosen] >= 0)[:, None]
        spread[own & flat] = 0.0
        self.counters.add(links=int((factor > 0).sum()))
        mean_square = np.zeros((len(chosen), 2))
        mean_square[:, 1] = (scatter * weight) ** 2 @ mesh.element_area / mesh.element_area.sum()
        return Columns(chosen, factor, spread, mean_square)

    def _first_elements(self, made: Bundles) -> tuple[IntArray, float, int]:
        """Element met first by each ray, -1 for none or a black back; seconds in Embree; rays."""
        centre, scale = self._tracer.frame
        start = ((made.origins + self._tracer.offset * made.normals - centre) * scale).astype(np.float32)
        origins = np.repeat(start, made.directions.shape[1], axis=0)
        along = made.directions.reshape(-1, 3)
        directions = along.astype(np.float32)
        clock = time.perf_counter()
        met = self._tracer.nearest_raw(origins, directions)
        traced = len(met)
        lost = np.flatnonzero(met < 0)
        if len(lost):
            # A ray may slip between two triangles that share an edge: a second look, a hair beside.
            hair = np.float32(1e-5) * directions[lost][:, [1, 2, 0]]
            met[lost] = self._tracer.nearest_raw(np.ascontiguousarray(origins[lost]), directions[lost] + hair)
            traced += len(lost)
        seconds = time.perf_counter() - clock
        element = np.where(met >= 0, self._front[np.maximum(met, 0)], -1)
        behind = np.einsum("ij,ij->i", along, self.mesh.element_normal[element]) > 0.0
        flat = self.mesh.element_polygon[element] >= 0
        turned = np.where(behind & (flat | (self._other[element] >= 0)), self._other[element], element)
        return np.where(element >= 0, turned, -1), seconds, traced


# ---- the instrument ---------------------------------------------------------------------------


@dataclass(frozen=True)
class BundleHits:
    """First hits of bundles of rays, shape (bundles, rays), and what they took."""

    hits: Hits
    counters: Counters


@njit(nogil=True, cache=True)
def _bundle_loop(
    objects, cells, origins, directions, normals, skip, rings, sectors, margin, check, mailbox, touched, current, limit,
    t, polygon, counts,
):  # fmt: skip
    # The loop of Woo's Figure 4 with a bundle for the light, looking for the nearest hit; the next rayID.
    rays = directions.shape[1]
    no_planes, planes = np.empty((0, 4)), np.empty((5, 4))
    origin, direction, through = np.empty((1, 3)), np.empty((1, 3)), np.empty(0)
    own = np.empty((1, 2), dtype=np.int64)
    for b in range(directions.shape[0]):
        if current > limit - rays:
            mailbox[:] = 0
            touched[:] = 0
            current = 1
        first = current
        last = first + rays - 1
        own[0, 0], own[0, 1] = skip[b], -1
        for axis in range(3):
            origin[0, axis] = origins[b, axis]
        if check:
            _planes(
                b // sectors, b % sectors, rings, sectors, normals[b, 0], normals[b, 1], normals[b, 2], margin, planes
            )  # fmt: skip
        for k in range(rays):
            for axis in range(3):
                direction[0, axis] = directions[b, k, axis]
            t[b, k], index = walk(
                objects, cells, origin, direction, 0, np.inf, own, CLOSEST, mailbox, touched, current, first, last,
                planes if check and k != rays - 1 else no_planes, False, True, through, counts,
            )  # fmt: skip
            polygon[b, k] = objects.owner[index] if index >= 0 else NO_POLYGON
            current += 1
    return current


def instrument_bundles(grid: VoxelGrid, made: Bundles, own_polygon: int, *, check: bool = True) -> BundleHits:
    """Trace bundles through the counting voxel grid, each bundle's polygons checked against its planes once.

    Parameters
    ----------
    grid : VoxelGrid
    made : Bundles
    own_polygon : int
        The patch's own polygon, left out by identity.
    check : bool
        Whether to check polygons against the planes.  The hits are the same without, bit for bit.

    Raises
    ------
    OptionError
        If a bundle has more rays than there are rayIDs.
    """
    bundles, rays = made.directions.shape[:2]
    ids = RayIDs(grid.object_count)
    if rays >= ids.limit:
        raise OptionError(f"rays: found {rays} a bundle, expected less than the largest rayID {ids.limit}")
    grid.check_origins(made.origins)
    margin = MARGIN * float(np.finfo(float).eps) * (float(np.abs(made.origins).max()) + grid.objects.reach)
    t, polygon = np.empty((bundles, rays)), np.empty((bundles, rays), dtype=np.int64)
    counts = np.zeros(len(COUNTED), dtype=np.int64)
    skip = np.full(bundles, own_polygon, dtype=np.int64)
    _bundle_loop(
        grid.objects, grid.cells, made.origins, made.directions, made.normals, skip, made.rings, made.sectors, margin,
        check, ids.mailbox, ids.touched, ids.current, ids.limit, t, polygon, counts,
    )  # fmt: skip
    counters = Counters(**dict(zip(COUNTED, counts.tolist(), strict=True)))
    counters.add(bundles=bundles)
    return BundleHits(Hits(t, polygon), counters)
