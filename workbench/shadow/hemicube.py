"""Hemicubes: what a point sees in every direction, and what each pixel of the picture weighs.

A hemicube of height 1 and half-side 1 stands on the tangent plane of a point: a full face on top and
four half faces around it, looked at by five cameras.  Every pixel gets the polygon nearest to the
point and a *delta form factor*, the share of the point's hemisphere that it fills,

    top: dA / (pi (x^2 + y^2 + 1)^2),    side: z dA / (pi (y^2 + z^2 + 1)^2),

after M. F. Cohen and D. P. Greenberg, "The hemi-cube: a radiosity solution for complex
environments" (SIGGRAPH 1985).  Sums of deltas over the pixels of a polygon are its form factor from
the point; the error is about one delta along the polygon's outline, and a polygon smaller than a
pixel gets nothing or too much.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.accel.box_tree import BoxTree
from workbench.arrays import as_points, as_unit_vectors
from workbench.counters import Counters
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import plane_basis
from workbench.shadow import rasteriser

__all__ = ["hemicube_deltas", "hemicube_directions", "hemicube_items"]

_BLOCK = 16


def _check(resolution: int) -> int:
    if resolution < 2 or resolution % 2:
        raise OptionError(f"resolution: found {resolution}, expected an even number of pixels from 2")
    return int(resolution)


def hemicube_directions(resolution: int) -> NDArray[np.float64]:
    """Pixel centres (3 resolution^2, 3) on the hemicube, in a frame whose z is the normal.

    The top face row by row, then the faces at +x, +y, -x and -y from the horizon up, each along
    its counter-clockwise direction.

    Raises
    ------
    OptionError
        If the resolution is odd or below 2.
    """
    resolution = _check(resolution)
    middle = (2 * np.arange(resolution) + 1) / resolution - 1
    y, x = np.meshgrid(middle, middle, indexing="ij")
    faces = [np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)]
    z, along = np.meshgrid(middle[resolution // 2 :], middle, indexing="ij")
    for out_x, out_y in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        side = np.stack([out_x - out_y * along, out_y + out_x * along, z], axis=-1)
        faces.append(side.reshape(-1, 3))
    return np.concatenate(faces)


def hemicube_deltas(resolution: int, *, normalised: bool = False) -> NDArray[np.float64]:
    """Delta form factors (3 resolution^2,) of the pixels, in the order of :func:`hemicube_directions`.

    Each is the kernel at the pixel's centre times its area, so they sum to a little more than 1
    (1.000217 at resolution 50); ``normalised`` divides by the sum.

    Raises
    ------
    OptionError
        If the resolution is odd or below 2.
    """
    directions = hemicube_directions(resolution)
    square = np.einsum("ij,ij->i", directions, directions)
    deltas = directions[:, 2] * (2 / resolution) ** 2 / (np.pi * square * square)
    return deltas / deltas.sum() if normalised else deltas


def hemicube_items(
    points: ArrayLike,
    normals: ArrayLike,
    geometry: Geometry,
    *,
    resolution: int = 50,
    own_polygon: ArrayLike | None = None,
    seed: int | None = None,
    tree: BoxTree | None = None,
    counters: Counters | None = None,
    workers: int | None = None,
) -> NDArray[np.int32]:
    """The nearest polygon in every pixel of a hemicube at each point.

    Parameters
    ----------
    points, normals : (m, 3) float
    geometry : Geometry
        Polygons are opaque from both sides; polygons whose plane holds the point are not seen.
    resolution : int
        Pixels along a side of the top face; even.
    own_polygon : (m,) int, optional
        Polygon on which each point lies, never seen from it; -1 for none.
    seed : int, optional
        Turns each hemicube by its own random angle about its normal, which breaks up aliasing that
        neighbouring points would share; without it they are laid along the axes.
    tree : BoxTree, optional
        The geometry's tree, if it is at hand.
    counters : Counters, optional
        Gets ``box_tests``, ``plane_vertex_checks``, ``plane_vertex_culls``, ``camera_renders`` (five
        a point) and ``camera_polygons``.
    workers : int, optional
        Threads; all processors by default.

    Returns
    -------
    (m, 3 resolution^2) int32
        Polygon of each pixel in the order of :func:`hemicube_directions`, -1 where there is none.
        ``np.bincount(items[i] + 1, hemicube_deltas(resolution))[1:]`` are the form factors of point
        ``i``.

    Raises
    ------
    InputError
        Arrays of the wrong shape.
    OptionError
        If the resolution is odd or below 2.
    """
    resolution = _check(resolution)
    points = as_points(points, "points")
    normals = as_unit_vectors(normals, "normals")
    if len(normals) != len(points):
        raise InputError(f"normals: found {len(normals)} rows, expected {len(points)}, one a point")
    own = np.full(len(points), -1, np.int64)
    if own_polygon is not None:
        own = np.ascontiguousarray(own_polygon, dtype=np.int64)
        if own.shape != (len(points),):
            raise InputError(f"own_polygon: found shape {own.shape}, expected ({len(points)},)")
    turns = np.asarray([plane_basis(normal)[0] for normal in normals]).reshape(-1, 3)
    if seed is not None:
        angle = 2 * np.pi * np.random.default_rng(seed).random((len(points), 1))
        turns = np.cos(angle) * turns + np.sin(angle) * np.cross(normals, turns)
    occ = rasteriser.occluders(geometry, tree)
    items = np.empty((len(points), 3 * resolution * resolution), np.int32)

    def block(first: int) -> NDArray[np.int64]:
        part = slice(first, first + _BLOCK)
        counts = np.zeros(4, np.int64)
        rasteriser.draw_hemicubes(
            points[part], normals[part], turns[part], own[part], occ, resolution, items[part], counts
        )
        return counts

    counts = np.zeros(4, np.int64)
    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        for found in pool.map(block, range(0, len(points), _BLOCK)):
            counts += found
    if counters is not None:
        counters.add(
            box_tests=counts[rasteriser.BOX_TESTS],
            plane_vertex_checks=counts[rasteriser.CHECKS],
            plane_vertex_culls=counts[rasteriser.CULLS],
            camera_renders=5 * len(points),
            camera_polygons=counts[rasteriser.DRAWN],
        )
    return items
