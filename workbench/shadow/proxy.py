"""Proxy scenes for shadow cameras: simplified meshes, and by how much their silhouettes are off.

The hardware-camera paper draws an approximate scene, since "the general shape matters most".  How
much it matters is measured here: the distances between the surfaces, and the area of the silhouette
seen from random directions, proxy over original.  A regular octagon in place of a disc, for one,
casts 10 % less shadow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from workbench.accel.box_tree import BoxTree
from workbench.arrays import as_unit_vectors
from workbench.errors import MissingLibraryError, OptionError
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import plane_basis
from workbench.scene.model import Scene, Surface
from workbench.shadow.hardware_camera import camera_shadows

__all__ = ["Proxy", "SurfaceError", "proxy_geometry", "silhouette_areas"]

FloatArray = NDArray[np.float64]

_SAMPLES = 2000


@dataclass(frozen=True)
class SurfaceError:
    """How one simplified surface differs from the original.

    Parameters
    ----------
    surface : str
        Its name.
    faces, proxy_faces : int
        Triangles before and after.
    distance : float
        Largest distance of a sampled vertex of the original from the proxy. [scene lengths]
    distance_back : float
        Largest distance of a sampled vertex of the proxy from the original. [scene lengths]
    silhouette : (k,) float
        Silhouette's area over the original's, seen from ``k`` random directions.
    """

    surface: str
    faces: int
    proxy_faces: int
    distance: float
    distance_back: float
    silhouette: FloatArray


@dataclass(frozen=True)
class Proxy:
    """A simplified geometry and the error of each surface that was simplified."""

    geometry: Geometry
    errors: tuple[SurfaceError, ...]


def proxy_geometry(
    geometry: Geometry,
    *,
    share: float = 0.1,
    smallest: int = 200,
    directions: int = 16,
    viewport: int = 256,
    seed: int = 0,
) -> Proxy:
    """Simplify the finely tessellated surfaces of a geometry by quadric edge collapse.

    Parameters
    ----------
    geometry : Geometry
    share : float
        Triangles to keep. [0..1]
    smallest : int
        Surfaces of no more triangles than this stay as they are, and no surface is asked to go
        below it.
    directions, viewport : int
        Directions from which silhouettes are compared, and pixels along a side of each picture.
    seed : int
        Of the directions and of the vertices sampled.

    Raises
    ------
    OptionError
        If ``share`` is not in (0, 1], or ``smallest`` or ``directions`` is not positive.
    MissingLibraryError
        If fast_simplification is absent.
    """
    if not 0 < share <= 1:
        raise OptionError(f"share: found {share}, expected more than 0 and at most 1")
    for name, value in (("smallest", smallest), ("directions", directions)):
        if value < 1:
            raise OptionError(f"{name}: found {value}, expected 1 or more")
    rng = np.random.default_rng(seed)
    ways = as_unit_vectors(rng.normal(size=(directions, 3)))
    triangles, piece = geometry.triangles
    surface_of_piece = geometry.polygon_surface[geometry.piece_polygon]
    surface_of_triangle = surface_of_piece[piece]
    surfaces, errors = [], []
    for index, (name, material) in enumerate(zip(geometry.surface_name, geometry.surface_material, strict=True)):
        mine = triangles[surface_of_triangle == index]
        if len(mine) <= smallest:
            pieces = [geometry.piece(int(k)) for k in np.flatnonzero(surface_of_piece == index)]
            surfaces.append(Surface.from_polygons(name, material, pieces))
            continue
        vertices, faces = _simplified(mine, max(smallest, round(share * len(mine))))
        surfaces.append(Surface.from_mesh(name, material, vertices, faces))
        whole = Surface.from_mesh(name, material, mine.reshape(-1, 3), np.arange(3 * len(mine)).reshape(-1, 3))
        exact, coarse = (Geometry.from_scene(Scene(name, (each,))) for each in (whole, surfaces[-1]))
        areas = [silhouette_areas(each, ways, bounds=exact.bounds, viewport=viewport) for each in (exact, coarse)]
        errors.append(
            SurfaceError(
                name,
                len(mine),
                len(faces),
                _largest_distance(mine.reshape(-1, 3), vertices[faces], rng),
                _largest_distance(vertices, mine, rng),
                areas[1] / areas[0],
            )
        )
    return Proxy(Geometry.from_scene(Scene("proxy", tuple(surfaces))), tuple(errors))


def _simplified(triangles: FloatArray, faces: int) -> tuple[FloatArray, NDArray[np.int64]]:
    """Vertices and faces of a mesh of about ``faces`` triangles."""
    try:
        import fast_simplification  # type: ignore[import-untyped]
    except ImportError:
        raise MissingLibraryError("fast_simplification: not found; pip install fast_simplification") from None
    points, corner = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    points, kept = fast_simplification.simplify(points, corner.reshape(-1, 3).astype(np.int32), target_count=faces)
    kept = kept.astype(np.int64)
    edges = np.diff(points[kept], axis=1)
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    return points.astype(np.float64), kept[area > 0]


def silhouette_areas(
    geometry: Geometry, directions: ArrayLike, *, bounds: FloatArray | None = None, viewport: int = 256
) -> FloatArray:
    """Areas (k,) of a geometry's parallel projections along ``directions`` (k, 3).

    Counted in the picture of a camera 10,000 sizes away; off by about one pixel's area for every
    pixel of outline at most.  ``bounds`` (2, 3) is the box to look at, the geometry's own by
    default.
    """
    directions = as_unit_vectors(directions, "directions")
    low, high = geometry.bounds if bounds is None else bounds
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    tree = BoxTree.build(geometry)
    areas = np.empty(len(directions))
    for k, way in enumerate(directions):
        u, v = plane_basis(way)
        back, half = centre - 1.01 * radius * way, 1.05 * radius
        screen = np.stack([back + half * (a * u + b * v) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        eye = centre + 1e4 * radius * way
        seen = camera_shadows(eye, -way, screen, geometry, viewport=viewport, backend="software", tree=tree)
        areas[k] = (1 - seen.pixel_fraction[0]) * 4 * half * half
    return areas


def _largest_distance(points: FloatArray, triangles: FloatArray, rng: np.random.Generator) -> float:
    """Largest distance of a sample of points from a mesh: the one-sided Hausdorff distance."""
    if len(points) > _SAMPLES:
        points = points[rng.choice(len(points), _SAMPLES, replace=False)]
    return float(_distances(np.ascontiguousarray(points), np.ascontiguousarray(triangles)).max())


@njit(nogil=True, cache=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(nogil=True, cache=True)
def _distances(points, triangles):
    """Distance of each point (n, 3) from the nearest triangle (t, 3, 3).

    The seven regions of C. Ericson, Real-Time Collision Detection (2005), 5.1.5.
    """
    nearest = np.full(len(points), np.inf)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ab = (b[0] - a[0], b[1] - a[1], b[2] - a[2])
        ac = (c[0] - a[0], c[1] - a[1], c[2] - a[2])
        bb, bc, cc = _dot(ab, ab), _dot(ab, ac), _dot(ac, ac)
        for k in range(len(points)):
            ap = (points[k, 0] - a[0], points[k, 1] - a[1], points[k, 2] - a[2])
            d1, d2 = _dot(ab, ap), _dot(ac, ap)
            d3, d4, d5, d6 = d1 - bb, d2 - bc, d1 - bc, d2 - cc
            va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
            if d1 <= 0.0 and d2 <= 0.0:
                v, w = 0.0, 0.0
            elif d3 >= 0.0 and d4 <= d3:
                v, w = 1.0, 0.0
            elif d6 >= 0.0 and d5 <= d6:
                v, w = 0.0, 1.0
            elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
                v, w = d1 / (d1 - d3), 0.0
            elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
                v, w = 0.0, d2 / (d2 - d6)
            elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
                w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
                v = 1.0 - w
            else:
                v, w = vb / (va + vb + vc), vc / (va + vb + vc)
            off = (ap[0] - v * ab[0] - w * ac[0], ap[1] - v * ab[1] - w * ac[1], ap[2] - v * ab[2] - w * ac[2])
            nearest[k] = min(nearest[k], _dot(off, off))
    return np.sqrt(nearest)
