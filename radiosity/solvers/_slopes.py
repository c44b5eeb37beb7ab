"""What the slope of radiosity over elements sends, beside its mean.

Solved with one radiosity an element, light from near is wrong to the first order: in a corner radiosity falls where
the kernel K of the receiver rises.  The mean over the element j misses the part A_j <(K - <K>) (B - <B>)> of the light,
about A_j grad K . M_j grad B with the second moments M_j of the element: a term that a basis of higher order holds
(H. R. Zatz, "Galerkin radiosity: a higher order solution method for global illumination", SIGGRAPH 93).  Here both
gradients are those of least squares over the neighbours on the polygon, that of K from the form factors that are known
anyway, K_j = A_i F_ij / A_j.  As it is linear in them, the term is that of a radiosity beside the solved one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from radiosity.element_lookup import ElementLookup
from radiosity.patches import PatchMesh
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import fan_triangles

__all__ = ["Slopes"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

STEP = 1e-3
"""How far beyond an edge, over the element's size, its neighbour is looked for."""
ALIKE = 5.0
"""Largest ratio of the areas of neighbours between which there is a slope."""
IN_LINE = 0.05
"""Share of the larger sum of squares of neighbours' directions, below which the other direction is open."""
MOST_GAIN = 0.5
"""Most that an element sends of differences to its neighbours, summed up; 1/12 to 1/6 on a grid."""


class Slopes:
    """Neighbours of the elements of a mesh, and what the slopes between them send.

    Parameters
    ----------
    mesh : PatchMesh
    geometry : Geometry
    seeing : (n,) bool
        Elements that see anything: what is covered tells nothing of the light beside it.
    area : (n,) float
        Of the part of each element that sees anything, above 0. [scene lengths squared]
    """

    def __init__(self, mesh: PatchMesh, geometry: Geometry, seeing: NDArray[np.bool_], area: FloatArray) -> None:
        self._area = area
        self._element, self._other = _neighbours(mesh, geometry, seeing)
        n, j, k = mesh.element_count, self._element, self._other
        apart = mesh.element_centroid[k] - mesh.element_centroid[j]
        nearness = 1.0 / np.maximum((apart**2).sum(axis=1), 1e-300)
        square = np.zeros((n, 3, 3))
        np.add.at(square, j, nearness[:, None, None] * apart[:, :, None] * apart[:, None, :])
        # Neighbours about in one line leave the other direction open: it gets no slope.
        inverse = np.linalg.pinv(square, rcond=IN_LINE, hermitian=True)
        self._toward = np.einsum("kab,kb->ka", inverse[j], nearness[:, None] * apart)
        moment = _second_moments(mesh)
        # Between long and thin neighbours whose centres lie close a difference tells no slope along them.
        gain = np.bincount(j, np.einsum("ka,kab,kb->k", self._toward, moment[j], self._toward), n)
        share = MOST_GAIN / np.maximum(gain, MOST_GAIN)
        self._moment = moment * (area * share)[:, None, None]

    def gradient(self, values: FloatArray) -> FloatArray:
        """Gradients (n, bands, 3) of values (n, bands), by least squares over the neighbours."""
        j, k = self._element, self._other
        out = np.zeros((*values.shape, 3))
        np.add.at(out, j, (values[k] - values[j])[:, :, None] * self._toward[:, None, :])
        return out

    def sent(self, radiosity: FloatArray) -> FloatArray:
        """A radiosity (n, bands) beside the given one: elements that send both send what slopes send, too.

        Area times this sums to 0: slopes send no more light, they send it elsewhere.
        """
        j, k = self._element, self._other
        flux = np.einsum("nab,ncb->nca", self._moment, self.gradient(radiosity))
        each = np.einsum("kca,ka->kc", flux[j], self._toward)
        out = np.zeros_like(radiosity)
        np.add.at(out, k, each)
        np.add.at(out, j, -each)
        return out / self._area[:, None]


def _second_moments(mesh: PatchMesh) -> FloatArray:
    """Mean of (y - c) (y - c) over each element, (n, 3, 3), round its centroid c. [scene lengths squared]"""
    tri, ring = fan_triangles(mesh.corners, mesh.piece_start)
    owner = mesh.piece_element[ring]
    off = tri - mesh.element_centroid[owner][:, None]
    area = 0.5 * np.linalg.norm(np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0]), axis=1)
    middle = off.sum(axis=1)
    each = np.einsum("tia,tib->tab", off, off) + middle[:, :, None] * middle[:, None, :]
    out = np.zeros((mesh.element_count, 3, 3))
    np.add.at(out, owner, (area / 12.0)[:, None, None] * each)
    return out / mesh.element_area[:, None, None]


def _neighbours(mesh: PatchMesh, geometry: Geometry, seeing: NDArray[np.bool_]) -> tuple[IntArray, IntArray]:
    """Pairs (k,) of elements alike in size that share an edge on one side of a polygon, each both ways."""
    start, owner = mesh.piece_start, np.repeat(mesh.piece_element, np.diff(mesh.piece_start))
    piece = np.repeat(np.arange(len(start) - 1), np.diff(start))
    after = np.arange(len(mesh.corners)) + 1
    after[start[1:] - 1] = start[:-1]
    alone = np.bincount(mesh.element_polygon[mesh.element_polygon >= 0], minlength=geometry.polygon_count) == 1
    usable = (mesh.element_polygon >= 0) & seeing
    usable[usable] &= ~alone[mesh.element_polygon[usable]]
    begin = np.flatnonzero(usable[owner])
    if not len(begin):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    a, b, who = mesh.corners[begin], mesh.corners[after[begin]], owner[begin]
    out = np.cross(b - a, mesh.piece_normal[piece[begin]])
    length = np.linalg.norm(out, axis=1)[:, None]
    out *= STEP * mesh.element_size[who, None] / np.where(length > 0, length, 1.0)
    lookup = ElementLookup.build(geometry, mesh)
    front = mesh.element_side[who] > 0
    pairs = []
    for share in (0.25, 0.75):  # halves differ beside smaller elements
        found = lookup.elements(a + share * (b - a) + out, mesh.element_polygon[who], front)
        real = (found != who) & (found >= 0)
        real[real] &= seeing[found[real]]
        pairs.append(np.stack([who[real], found[real]], axis=1))
    both = np.concatenate(pairs)
    both = np.unique(np.concatenate([both, both[:, ::-1]]), axis=0)
    # Beside slivers a difference tells no slope.
    size = mesh.element_area[both]
    both = both[size.max(axis=1) <= ALIKE * size.min(axis=1)]
    return both[:, 0], both[:, 1]
