"""From one value an element to one value a corner, for smooth shading."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from radiosity.patches import PatchMesh

__all__ = ["corner_values"]

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
