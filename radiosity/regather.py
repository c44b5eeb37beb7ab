"""A coarse solution made fit to be read by a gather: direct light fine, indirect light gathered once more.

What is wrong with a coarse solution sits at shadow boundaries and contacts, where one element holds
both lit and dark places.  Direct light can be found exactly anywhere, so elements get it afresh, one
place each.  What else arrives is gathered at the same place by a hemisphere bundle that reads the
solution, which leaves of its errors what one more bounce leaves.  Then elements are cut in four where
direct light is uneven, or where they are larger than the distance to what lights them, and all is
gathered again: elements stay coarse where light is smooth.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from radiosity.element_lookup import element_gradients
from radiosity.form_factors._sampling import place_on_pieces, stream
from radiosity.patches import PatchMesh
from radiosity.sensors import Gatherer
from radiosity.solvers.solution import Solution
from workbench.errors import OptionError
from workbench.memory import require_memory

__all__ = ["regathered"]

STEP = 0.1
"""Step of direct light in an element, relative to the mean irradiance, from which it is cut."""
INSIDE = 0.02
"""Share of the way to the middle at which an element's corners are asked."""
CLOSE = 1.5
"""Sizes of an element within which the harmonic mean of what lights it must not lie."""

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_ELEMENT_BYTES = 3000
"""Memory that a fine element takes while its mesh is made."""


@njit(nogil=True, cache=True)
def _element_places(corners, piece_start, element_piece, area, seed, out, piece):
    # A random place on each element, and its piece.
    for e in range(area.shape[0]):
        h = stream(e, 1, seed)
        u = np.float64(h & np.uint64(0xFFFFFF)) / 16777216.0
        v = np.float64((h >> np.uint64(24)) & np.uint64(0xFFFFFF)) / 16777216.0
        piece[e] = place_on_pieces(corners, piece_start, element_piece[e], element_piece[e + 1], area[e], u, v, out[e])


def _places(mesh: PatchMesh, seed: int) -> tuple[FloatArray, FloatArray]:
    """A place (n, 3) on each element and the normal there: the middle of a piece, any place of a cluster."""
    points = mesh.element_centroid.copy()
    normals = mesh.element_normal.copy()
    pieces = np.diff(mesh.element_piece)
    rough = np.flatnonzero((pieces > 1) | (mesh.element_polygon < 0))
    if len(rough):
        place, piece = np.empty((mesh.element_count, 3)), np.empty(mesh.element_count, dtype=np.int64)
        _element_places(mesh.corners, mesh.piece_start, mesh.element_piece, mesh.element_area, seed, place, piece)
        points[rough], normals[rough] = place[rough], mesh.piece_normal[piece[rough]]
    return points, normals


def regathered(
    solution: Solution,
    *,
    passes: int = 3,
    rays: int = 128,
    error: float = 0.02,
    gatherer: Gatherer | None = None,
    workers: int | None = None,
    seed: int = 0,
) -> Gatherer:
    """A solution gathered again on a mesh that is cut where a gather would see its elements.

    Parameters
    ----------
    solution : Solution
        With its scene.
    passes : int
        Rounds of gathering and cutting.
    rays : int
        Rays of the bundle at each element and pass.
    error : float
        Of the picture: elements are cut down to a quarter of this share of the scene's size.
    gatherer : Gatherer, optional
        Of the solution, if there is one already.
    workers : int, optional
    seed : int

    Returns
    -------
    Gatherer
        Of a solution on the finer mesh; the energy book and the record are those of the solve.

    Raises
    ------
    OptionError
        If ``passes`` is less than 1.
    """
    if passes < 1:
        raise OptionError(f"passes: found {passes}, expected 1 or more")
    found = gatherer or Gatherer(solution, workers=workers, seed=seed)
    smallest = 0.25 * error * found.geometry.size
    mesh = solution.mesh
    for number in range(passes):
        points, normals = _places(mesh, seed + number)
        bundles = found.indirect(points, normals, rays=rays, counters=solution.record.counters)
        direct, uneven = _direct_light(found, mesh, points, normals, bundles.sky, error, solution)
        arriving = bundles.indirect + direct
        _fill_covered(mesh, arriving)
        found = found.reading(_holding(solution, mesh, arriving))
        if number == passes - 1:
            break
        large = mesh.element_size > smallest
        close = bundles.distance < CLOSE * mesh.element_size
        joined = np.diff(mesh.element_piece) > 1  # of several pieces: one place says little of it
        cut = (uneven | close | joined) & large & mesh.reflectance.any(axis=1)
        cut &= mesh.element_polygon >= 0
        finer, parent = _cut(mesh, cut)
        require_memory(
            finer.element_count * _ELEMENT_BYTES, f"a mesh of {finer.element_count} elements", "ask for a larger error"
        )
        # Children read their parent until they are gathered themselves.
        offset = finer.element_centroid - mesh.element_centroid[parent]
        smooth = element_gradients(mesh, found.lookup, arriving)
        arriving = np.maximum(arriving[parent] + np.einsum("nbk,nk->nb", smooth[parent], offset), 0.0)
        mesh = finer
        found = found.reading(_holding(solution, mesh, arriving))
    return found


def _holding(solution: Solution, mesh: PatchMesh, irradiance: FloatArray) -> Solution:
    """The solution with another mesh and irradiance."""
    radiosity = mesh.emission + mesh.reflectance * irradiance
    return replace(
        solution, mesh=mesh, radiosity=radiosity, element_irradiance=irradiance, unshot=np.zeros_like(radiosity)
    )


def _fill_covered(mesh: PatchMesh, irradiance: FloatArray) -> None:
    """Give elements at whose place no light arrives at all the irradiance of the nearest that gets some.

    They lie under something, where nobody sees them; but slopes are read across their borders, and
    their darkness must not leak out.
    """
    dark = ~irradiance.any(axis=1)
    side = 2 * mesh.element_polygon + (mesh.element_side > 0)
    for which in np.unique(side[dark & (mesh.element_polygon >= 0)]).tolist():
        rows, lit = np.flatnonzero(dark & (side == which)), np.flatnonzero(~dark & (side == which))
        if len(lit):
            nearest = cKDTree(mesh.element_centroid[lit]).query(mesh.element_centroid[rows])[1]
            irradiance[rows] = irradiance[lit[nearest]]


def _direct_light(
    gatherer: Gatherer, mesh: PatchMesh, points: FloatArray, normals: FloatArray, sky: FloatArray, error: float,
    solution: Solution,
) -> tuple[FloatArray, NDArray[np.bool_]]:  # fmt: skip
    """Mean direct irradiance (n, bands) of elements, and whether their corners differ from their places.

    The mean of a flat element with k corners is 1 - k / 12 of the value at its centroid and a twelfth of
    that at each corner: exact for quadratics on triangles and parallelograms.
    """
    counters = solution.record.counters
    middle = gatherer.direct(points, normals, own_polygon=mesh.element_polygon, error=error, counters=counters)
    value = middle.irradiance + np.where(middle.crowded[:, None], sky, 0.0)
    uneven = np.zeros(mesh.element_count, dtype=bool)
    sizes = np.diff(mesh.piece_start)
    first = mesh.element_piece[:-1]
    plain = (np.diff(mesh.element_piece) == 1) & (mesh.element_polygon >= 0) & (sizes[first] <= 4) & ~middle.crowded
    element = np.repeat(mesh.piece_element, sizes)
    corner = np.flatnonzero(plain[element])
    if not len(corner):
        return value, uneven
    owner = element[corner]
    # A little inside: edges of elements lie in corners of rooms.
    place = mesh.corners[corner] + INSIDE * (mesh.element_centroid[owner] - mesh.corners[corner])
    found = gatherer.direct(
        place, mesh.element_normal[owner], own_polygon=mesh.element_polygon[owner], error=error, counters=counters
    )
    known = np.where(found.crowded[:, None], value[owner], found.irradiance)
    level = np.average(solution.element_irradiance, axis=0, weights=solution.mesh.element_area)
    differs = (np.abs(known - value[owner]) > STEP * level).any(axis=1)
    uneven[owner[differs]] = True
    change = known - value[owner]
    mean = [np.bincount(owner, band / 12.0, mesh.element_count) for band in change.T]
    return np.maximum(value + np.column_stack(mean), 0.0), uneven


def _cut(mesh: PatchMesh, cut: NDArray[np.bool_]) -> tuple[PatchMesh, IntArray]:
    """The mesh with some of its flat elements cut, and the parent (n,) of each element.

    Each convex piece with k corners falls into k quads about its middle.  Patches as senders stay what
    they are.
    """
    starts, sizes = mesh.piece_start, np.diff(mesh.piece_start)
    owner = mesh.piece_element
    old = np.flatnonzero(~cut[owner])
    piece = np.repeat(np.arange(len(owner)), sizes)
    middle = np.add.reduceat(mesh.corners, starts[:-1]) / sizes[:, None]
    lead = np.flatnonzero(cut[owner[piece]])  # a quad for each corner
    mine = piece[lead]
    onward = np.where(lead + 1 < starts[mine + 1], lead + 1, starts[mine])
    back = np.where(lead > starts[mine], lead - 1, starts[mine + 1] - 1)
    here, after, before = mesh.corners[lead], mesh.corners[onward], mesh.corners[back]
    quads = np.stack([here, 0.5 * (here + after), middle[mine], 0.5 * (here + before)], axis=1)
    area = 0.5 * np.abs(
        np.einsum("ij,ij->i", np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]), mesh.piece_normal[mine])
    )
    kept = np.flatnonzero(area > 1e-9 * mesh.element_area[owner[mine]])
    lead, mine, quads, area = lead[kept], mine[kept], quads[kept], area[kept]
    # Pieces and elements in the order of their parents.
    order = np.argsort(np.concatenate([owner[old], owner[mine]]), kind="stable")
    source = np.concatenate([old, mine])[order]
    count = np.concatenate([sizes[old], np.full(len(mine), 4)])[order]
    start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    corners = np.empty((start[-1], 3))
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    kept_corner = np.flatnonzero(~cut[owner[piece]])
    corners[np.repeat(start[place[: len(old)]] - starts[old], sizes[old]) + kept_corner] = mesh.corners[kept_corner]
    at = start[place[len(old) :]]
    corners[at[:, None] + np.arange(4)] = quads
    fresh = order >= len(old)
    begins = fresh | np.concatenate([[True], np.diff(owner[source]) != 0])
    element = np.cumsum(begins) - 1
    parent = owner[source[begins]]
    quad_of = np.flatnonzero(fresh[begins])
    chosen = order[fresh] - len(old)
    areas, sizes_of, centroid = mesh.element_area[parent], mesh.element_size[parent], mesh.element_centroid[parent]
    areas[quad_of] = area[chosen]
    ring = quads[chosen]
    halves = [
        0.5 * np.linalg.norm(np.cross(ring[:, k] - ring[:, 0], ring[:, k + 1] - ring[:, 0]), axis=1) for k in (1, 2)
    ]
    weighted = sum(h[:, None] * (ring[:, 0] + ring[:, k] + ring[:, k + 1]) for h, k in zip(halves, (1, 2), strict=True))
    centroid[quad_of] = weighted / (3.0 * (halves[0] + halves[1]))[:, None]
    sizes_of[quad_of] = 2.0 * np.linalg.norm(ring - centroid[quad_of][:, None], axis=2).max(axis=1)
    patch = mesh.element_patch[parent]
    finer = replace(
        mesh,
        corners=corners,
        piece_start=start,
        piece_element=element.astype(np.int64),
        piece_normal=np.ascontiguousarray(mesh.piece_normal[source]),
        element_area=areas,
        element_normal=np.ascontiguousarray(mesh.element_normal[parent]),
        element_centroid=np.ascontiguousarray(centroid),
        element_size=sizes_of,
        element_polygon=mesh.element_polygon[parent],
        element_surface=mesh.element_surface[parent],
        element_side=mesh.element_side[parent],
        element_patch=patch,
        reflectance=np.ascontiguousarray(mesh.reflectance[parent]),
        emission=np.ascontiguousarray(mesh.emission[parent]),
        patch_start=np.searchsorted(patch, np.arange(mesh.patch_count + 1)).astype(np.int64),
    )
    return finer, parent
