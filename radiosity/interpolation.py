"""From one value an element to one value a corner, for smooth shading."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from radiosity.patches import PatchMesh

__all__ = ["conforming_rings", "corner_values"]

_CREASE = 0.8
"""Cosine of the angle beyond which a facet is not blended with the mean of its neighbours."""


def corner_values(mesh: PatchMesh, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values of elements interpolated to the corners of the mesh's pieces.

    Each corner gets the area-weighted mean over the elements of its surface that meet there.  A
    crease, such as the edge of a box, is kept: across it only elements of one direction are joined.

    Parameters
    ----------
    mesh : PatchMesh
    values : (n, bands) float
        One row an element.

    Returns
    -------
    (k, bands) float
        One row for each of ``mesh.corners``.
    """
    element = np.repeat(mesh.piece_element, np.diff(mesh.piece_start))
    low = mesh.corners.min(axis=0)
    size = float(np.ptp(mesh.corners, axis=0).max()) or 1.0
    place = np.rint((mesh.corners - low) * (1e6 / size)).astype(np.int64)
    place = np.column_stack([mesh.element_surface[element], mesh.element_side[element], place])
    vertex = _labels(place)
    area = mesh.element_area[element]
    normal = mesh.element_normal[element]
    mean_normal = _sums(vertex, normal)
    mean_normal /= np.maximum(np.linalg.norm(mean_normal, axis=1), 1e-300)[:, None]
    smooth = np.ones(vertex.max() + 1, dtype=bool)
    smooth[vertex[np.einsum("ij,ij->i", normal, mean_normal[vertex]) < _CREASE]] = False
    direction = np.where(smooth[vertex][:, None], 0, np.rint(normal * 50)).astype(np.int64)
    group = _labels(np.column_stack([vertex, direction]))
    total = _sums(group, values[element] * area[:, None])
    return (total / _sums(group, area[:, None]))[group]


def _labels(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """The number (k,) of each row among the distinct rows of a (k, m) array."""
    return np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)


def _sums(group: NDArray[np.int64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of the rows (k, m) of each group."""
    return np.column_stack([np.bincount(group, weights=column) for column in rows.T])


def conforming_rings(mesh: PatchMesh) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """The mesh's pieces with every corner of a neighbour that lies on one of their edges (no T-junctions).

    Edges are halved as long as a corner lies in their middle, which finds all corners that halving has
    made, on the same polygon or on another that shares the edge.

    Parameters
    ----------
    mesh : PatchMesh

    Returns
    -------
    points : (k, 3) float
        Corners, ring after ring; equal corners are equal to the last bit.
    starts : (m + 1,) int
        Ring ``i``, piece ``i`` of the mesh, is ``points[starts[i]:starts[i + 1]]``.
    edge : (k,) int
        The corner of the mesh on whose edge (toward the next corner of its ring) each point lies; the corner
        itself comes first.
    """
    low, size = mesh.corners.min(axis=0), float(np.ptp(mesh.corners, axis=0).max()) or 1.0

    def key(points: NDArray[np.float64]) -> NDArray[np.int64]:
        # No power of two in the scale: halves of edges then never fall between two cells.
        cell = np.rint((points - low) * (731_701.0 / size)).astype(np.int64)
        return (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]

    known, first = np.unique(key(mesh.corners), return_index=True)

    def place(points: NDArray[np.float64]) -> NDArray[np.int64]:
        """A corner (n,) at each point, -1 for none."""
        wanted = key(points)
        at = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
        return np.where(known[at] == wanted, first[at], -1)

    ring = np.repeat(np.arange(len(mesh.piece_start) - 1), np.diff(mesh.piece_start))
    after = np.arange(1, len(mesh.corners) + 1)
    after[mesh.piece_start[1:] - 1] = mesh.piece_start[:-1]
    edge, begin = np.arange(len(mesh.corners)), np.zeros(len(mesh.corners))
    one, two, width = mesh.corners, mesh.corners[after], 1.0
    corner = place(mesh.corners)
    found = [(edge, begin, corner)]
    while len(edge) and width > 2.0**-40:
        middle = 0.5 * (one + two)
        corner = place(middle)
        # A middle that is the corner at an end: the edge is as short as corners are apart.
        hit = (corner >= 0) & (corner != place(one)) & (corner != place(two))
        width *= 0.5
        found.append((edge[hit], begin[hit] + width, corner[hit]))
        edge, begin = np.tile(edge[hit], 2), np.concatenate([begin[hit], begin[hit] + width])
        one, two = np.concatenate([one[hit], middle[hit]]), np.concatenate([middle[hit], two[hit]])
    edge, begin, corner = (np.concatenate(part) for part in zip(*found, strict=True))
    order = np.lexsort((begin, edge))
    starts = np.searchsorted(ring[edge[order]], np.arange(len(mesh.piece_start)))
    return mesh.corners[corner[order]], starts.astype(np.int64), edge[order]
