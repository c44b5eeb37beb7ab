"""Spheres, cones and cylinders as facets, with a stated facet error."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.arrays import readonly
from workbench.errors import InputError
from workbench.geometry.polygons import plane_basis

__all__ = ["cone_mesh", "sphere_mesh"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_MAX_LEVEL = 7


def _check_facet_error(facet_error: float) -> None:
    if not 1e-4 <= facet_error < 1:
        raise InputError(f"facet_error: found {facet_error}, expected a share of the radius from 0.0001 to below 1")


@lru_cache(maxsize=_MAX_LEVEL + 1)
def _unit_sphere(level: int) -> tuple[FloatArray, IntArray, float]:
    """Icosahedron divided ``level`` times: vertices, triangles, largest distance of the sphere from a facet."""
    if level == 0:
        golden = (1 + 5**0.5) / 2
        vertices = np.asarray([(0, s, t * golden) for s in (-1.0, 1.0) for t in (-1.0, 1.0)])
        vertices = np.concatenate([np.roll(vertices, k, axis=1) for k in range(3)])
        vertices /= np.linalg.norm(vertices, axis=1)[:, None]
        # The faces are the triples of mutually nearest vertices, turned outward.
        near = vertices @ vertices.T > 0.44
        triples = [
            (i, j, k)
            for i in range(12)
            for j in range(i + 1, 12)
            for k in range(j + 1, 12)
            if near[i, j] and near[j, k] and near[i, k]
        ]
        faces = np.asarray(triples, dtype=np.int64)
        inward = np.linalg.det(vertices[faces]) < 0
        faces[inward] = faces[inward][:, ::-1]
    else:
        coarse, triangles, _ = _unit_sphere(level - 1)
        edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
        edges, middle = np.unique(edges, axis=0, return_inverse=True)
        middles = coarse[edges].sum(axis=1)
        vertices = np.concatenate([coarse, middles / np.linalg.norm(middles, axis=1)[:, None]])
        ab, bc, ca = np.split(middle.reshape(-1) + len(coarse), 3)
        a, b, c = triangles.T
        faces = np.concatenate(
            [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        ).astype(np.int64)
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    height = np.abs(np.einsum("ij,ij->i", normal, corner[:, 0])) / np.linalg.norm(normal, axis=1)
    return readonly(vertices), readonly(faces), float(1 - height.min())


def sphere_mesh(
    center: ArrayLike, radius: float, facet_error: float = 0.02
) -> tuple[FloatArray, IntArray, FloatArray, float]:
    """A sphere as triangles of nearly equal size, vertices on the sphere, fronts outside.

    Parameters
    ----------
    center : (3,) float
    radius : float
        Greater than 0. [scene lengths]
    facet_error : float
        Largest distance between sphere and facets as a share of the radius, 0.0001 or more.
        0.3 gives 20 triangles, 0.1 gives 80, 0.02 gives 320, 0.005 gives 1,280.

    Returns
    -------
    vertices : (v, 3) float
    faces : (f, 3) int
    normals : (v, 3) float
        Outward unit normals of the sphere.
    distance : float
        Largest distance that there is between sphere and facets. [scene lengths]

    Raises
    ------
    InputError
        If the radius is not positive or the facet error out of its range.
    """
    _check_facet_error(facet_error)
    if not radius > 0:
        raise InputError(f"radius: found {radius}, expected a number greater than 0")
    level = next(level for level in range(_MAX_LEVEL + 1) if _unit_sphere(level)[2] <= facet_error)
    normals, faces, share = _unit_sphere(level)
    return np.asarray(center, dtype=np.float64) + radius * normals, faces, normals, share * radius


def cone_mesh(
    base: ArrayLike, base_radius: float, apex: ArrayLike, apex_radius: float, facet_error: float = 0.02
) -> tuple[FloatArray, IntArray, FloatArray, float]:
    """The side of a cone, a cut cone or a cylinder as planar facets; fronts outside, no caps.

    Parameters
    ----------
    base, apex : (3,) float
        Centres of the two end circles.
    base_radius, apex_radius : float
        0 or more, not both 0. [scene lengths]
    facet_error : float
        Largest distance between surface and facets as a share of the larger radius, 0.0001 or
        more.  0.02 gives 16 facets.

    Returns
    -------
    vertices : (v, 3) float
    faces : (n, 4) int, or (n, 3) int where one radius is 0
    normals : (v, 3) float
        Outward unit normals of the cone; those of a tip are the normals of its facet's middle.
    distance : float
        Largest distance that there is between surface and facets. [scene lengths]

    Raises
    ------
    InputError
        If the circles coincide, a radius is negative, both are 0, or the facet error is out of its
        range.
    """
    _check_facet_error(facet_error)
    base = np.asarray(base, dtype=np.float64)
    axis = np.asarray(apex, dtype=np.float64) - base
    length = float(np.linalg.norm(axis))
    if not length > 0:
        raise InputError("base and apex: found the same point, expected two")
    if base_radius < 0 or apex_radius < 0 or base_radius == apex_radius == 0:
        raise InputError(f"radii: found {base_radius} and {apex_radius}, expected 0 or more and not both 0")
    axis = axis / length
    count = max(3, int(np.ceil(np.pi / np.arccos(1 - facet_error))))
    u, v = plane_basis(axis)
    # Circle points at whole steps, tips of a true cone at half steps.
    angle = 2 * np.pi * np.arange(count) / count
    slope = (base_radius - apex_radius) / length

    def ring(radius: float, height: float, turn: float) -> tuple[FloatArray, FloatArray]:
        outward = np.cos(angle + turn)[:, None] * u + np.sin(angle + turn)[:, None] * v
        normal = outward + slope * axis
        return base + height * axis + radius * outward, normal / np.linalg.norm(normal, axis=1)[:, None]

    half = np.pi / count
    low, low_normal = ring(base_radius, 0.0, half if base_radius == 0 else 0.0)
    high, high_normal = ring(apex_radius, length, half if apex_radius == 0 else 0.0)
    here = np.arange(count)
    after = (here + 1) % count
    if apex_radius == 0:
        columns = [here, after, here + count]
    elif base_radius == 0:
        columns = [here, after + count, here + count]
    else:
        columns = [here, after, after + count, here + count]
    sagitta = max(base_radius, apex_radius) * (1 - np.cos(np.pi / count))
    return (
        np.concatenate([low, high]),
        np.stack(columns, axis=1).astype(np.int64),
        np.concatenate([low_normal, high_normal]),
        float(sagitta),
    )
