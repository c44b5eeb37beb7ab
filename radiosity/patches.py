"""Patches and elements: the two-level mesh on which radiosity is solved.

*Elements* receive light and hold radiosity; *patches*, groups of neighbouring elements, shoot it
(M. F. Cohen, D. P. Greenberg, D. S. Immel and P. J. Brock, "An efficient radiosity approach for
realistic image synthesis", IEEE CG&A 1986).  Quads stay quads.  A patch of a flat surface is one
polygon that its elements tile; on a tessellated surface elements and patches are clusters of facets:
a mesh finer than the answer needs costs no more elements.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray

from workbench.arrays import as_count, as_positive
from workbench.errors import OptionError
from workbench.geometry.contacts import contact_lines, cut_along
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import convex_pieces, fan_triangles, plane_basis, vector_area
from workbench.scene.model import Scene, Surface

TESSELLATED = 64
"""Faces from which a surface counts as tessellated, so that its small facets are clustered."""
NEAR = 0.05
"""Distance, as a share of an element's edge, within which polygons touch: elements are cut along the lines."""
VAST, MOST_OF_REST = 0.5, 2.0
"""A polygon with more than this share of all area counts at most so many times as much as all smaller ones."""
LEAST_TOUCHING = 0.2
"""Extent, as a share of an element's edge, below which a polygon's contacts are not looked at."""
COARSE_CLUSTERS = 12
"""Least number of cubes over a tessellated surface, however coarse the mesh."""

__all__ = ["TESSELLATED", "Extents", "PatchMesh", "build_mesh", "edge_scales", "forecast_elements"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class PatchMesh:
    """Elements (receivers) and patches (senders) as flat arrays.

    Elements are sorted by patch: patch ``p`` owns ``patch_start[p]:patch_start[p + 1]``.

    Parameters
    ----------
    corners : (k, 3) float
        Corners of the elements' convex pieces, counter-clockwise from the lit side.
    piece_start : (m + 1,) int
    piece_element : (m,) int
        Owner of each piece, ascending; nearly every flat element is one piece.
    piece_normal : (m, 3) float
    element_area : (n,) float
        [scene lengths squared]
    element_normal, element_centroid : (n, 3) float
    element_size : (n,) float
        Largest distance of a corner from the centroid, doubled.
    element_polygon : (n,) int
        Polygon of the :class:`Geometry`, -1 for a cluster of facets.
    element_surface : (n,) int
    element_side : (n,) int
        1 for the front of its polygon, -1 for the back of a two-sided one.
    element_patch : (n,) int
    reflectance, emission : (n, bands) float
        Diffuse reflectance [0..1] and radiant exitance [W m-2].
    patch_start : (q + 1,) int
    sender_corners, sender_start, sender_normal, patch_sender
        Convex pieces of the patches as senders, in the same layout; patch ``p`` has pieces
        ``patch_sender[p]:patch_sender[p + 1]``.
    patch_polygon : (q,) int
        Polygon of a flat patch, -1 for a cluster of facets.
    facet_error : float
        Largest distance of an exact surface from its facets. [scene lengths]
    """

    corners: FloatArray
    piece_start: IntArray
    piece_element: IntArray
    piece_normal: FloatArray
    element_area: FloatArray
    element_normal: FloatArray
    element_centroid: FloatArray
    element_size: FloatArray
    element_polygon: IntArray
    element_surface: IntArray
    element_side: IntArray
    element_patch: IntArray
    reflectance: FloatArray
    emission: FloatArray
    patch_start: IntArray
    sender_corners: FloatArray
    sender_start: IntArray
    sender_normal: FloatArray
    patch_sender: IntArray
    patch_polygon: IntArray
    facet_error: float

    @property
    def element_count(self) -> int:
        """Number of elements."""
        return len(self.element_area)

    @property
    def patch_count(self) -> int:
        """Number of patches."""
        return len(self.patch_start) - 1

    @property
    def bands(self) -> int:
        """Number of spectral bands."""
        return self.reflectance.shape[1]

    @cached_property
    def element_piece(self) -> IntArray:
        """(n + 1,) int: element ``e`` has pieces ``element_piece[e]:element_piece[e + 1]``."""
        return np.searchsorted(self.piece_element, np.arange(self.element_count + 1)).astype(np.int64)

    @cached_property
    def element_bounds(self) -> FloatArray:
        """(n, 2, 3) float: box round each element."""
        first = self.piece_start[self.element_piece[:-1]]
        low, high = np.minimum.reduceat(self.corners, first), np.maximum.reduceat(self.corners, first)
        return np.ascontiguousarray(np.stack([low, high], axis=1))

    @cached_property
    def patch_area(self) -> FloatArray:
        """(q,) float: area of each patch, the sum of its elements'."""
        return np.add.reduceat(self.element_area, self.patch_start[:-1])

    @cached_property
    def patch_bounds(self) -> FloatArray:
        """(q, 2, 3) float: box round each patch."""
        first = self.patch_sender[:-1]
        low = np.minimum.reduceat(np.minimum.reduceat(self.sender_corners, self.sender_start[:-1], axis=0), first)
        high = np.maximum.reduceat(np.maximum.reduceat(self.sender_corners, self.sender_start[:-1], axis=0), first)
        return np.ascontiguousarray(np.stack([low, high], axis=1))

    @cached_property
    def patch_normal(self) -> FloatArray:
        """(q, 3) float: normal of a flat patch; mean direction of a cluster."""
        total = np.add.reduceat(self.element_normal * self.element_area[:, None], self.patch_start[:-1])
        length = np.linalg.norm(total, axis=1)
        return np.ascontiguousarray(total / np.where(length > 0, length, 1.0)[:, None])

    def patch_mean(self, values: FloatArray) -> FloatArray:
        """Area-weighted mean over each patch's elements: (n, bands) to (q, bands)."""
        weighted = values * self.element_area[:, None]
        return np.add.reduceat(weighted, self.patch_start[:-1]) / self.patch_area[:, None]


@dataclass
class _Part:
    """What one polygon (or cluster) adds: element rings, patch of each, sender rings a patch."""

    elements: list[list[FloatArray]]
    patch_of: list[int]
    senders: list[list[FloatArray]]


def _cut_at_contacts(part: _Part, normal: FloatArray, segments: FloatArray) -> _Part:
    """The part with its elements cut where other polygons touch them.

    Patches of several elements send as before; where each element is a patch, so is each new one.
    """
    elements: list[list[FloatArray]] = []
    patch_of: list[int] = []
    for element, patch in zip(part.elements, part.patch_of, strict=True):
        cells = cut_along(element, normal, segments)
        elements.extend(cells)
        patch_of.extend([patch] * len(cells))
    if len(part.senders) == len(part.elements):
        return _Part(elements, list(range(len(elements))), elements)
    return _Part(elements, patch_of, part.senders)


def _steps(length: float, edge: float, split: int) -> int:
    """Number of intervals of at most ``edge``, a multiple of ``split`` if more than one."""
    count = max(1, math.ceil(length / edge - 1e-9))
    return count if count == 1 else split * math.ceil(count / split)


def _bilinear(quad: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
    u, v = u[..., None], v[..., None]
    return (quad[0] * (1 - u) + quad[1] * u) * (1 - v) + (quad[3] * (1 - u) + quad[2] * u) * v


def _quad_cells(quad: FloatArray, nu: int, nv: int) -> FloatArray:
    """(nv, nu, 4, 3) cells of a quad."""
    grid = _bilinear(quad, *np.meshgrid(np.linspace(0, 1, nu + 1), np.linspace(0, 1, nv + 1)))
    return np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=2)


def _quad_counts(quad: FloatArray, edge: float, split: int) -> tuple[int, int]:
    side = np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1)
    return _steps(max(side[0], side[2]), edge, split), _steps(max(side[1], side[3]), edge, split)


def _mesh_quad(quad: FloatArray, edge: float, split: int) -> _Part:
    nu, nv = _quad_counts(quad, edge, split)
    if nu == nv == 1:
        return _Part([[quad]], [0], [[quad]])
    pu, pv = max(1, nu // split), max(1, nv // split)
    cells = _quad_cells(quad, nu, nv)
    coarse = _quad_cells(quad, pu, pv)
    patch = [(j * pv // nv) * pu + i * pu // nu for j in range(nv) for i in range(nu)]
    return _Part([[cell] for cell in cells.reshape(-1, 4, 3)], patch, [[cell] for cell in coarse.reshape(-1, 4, 3)])


def _triangle_cells(tri: FloatArray, n: int) -> tuple[list[FloatArray], list[tuple[int, int, bool]]]:
    a, u, v = tri[0], (tri[1] - tri[0]) / n, (tri[2] - tri[0]) / n
    cells, index = [], []
    for j in range(n):
        for i in range(n - j):
            corner = a + i * u + j * v
            cells.append(np.stack([corner, corner + u, corner + v]))
            index.append((i, j, True))
            if i + j < n - 1:
                cells.append(np.stack([corner + u, corner + u + v, corner + v]))
                index.append((i, j, False))
    return cells, index


def _triangle_count(tri: FloatArray, edge: float, split: int) -> int:
    return _steps(float(np.linalg.norm(np.roll(tri, -1, axis=0) - tri, axis=1).max()), edge, split)


def _mesh_triangle(tri: FloatArray, edge: float, split: int) -> _Part:
    n = _triangle_count(tri, edge, split)
    coarse_n = max(1, n // split)
    ratio = n // coarse_n
    cells, index = _triangle_cells(tri, n)
    coarse, coarse_index = _triangle_cells(tri, coarse_n)
    place = {key: number for number, key in enumerate(coarse_index)}
    patch = []
    for i, j, up in index:
        # Centroid in units of the coarse cell decides which coarse triangle it lies in.
        s = (i + (1 / 3 if up else 2 / 3)) / ratio
        t = (j + (1 / 3 if up else 2 / 3)) / ratio
        ci, cj = int(s), int(t)
        patch.append(place[(ci, cj, (s - ci) + (t - cj) < 1.0)])
    return _Part([[cell] for cell in cells], patch, [[cell] for cell in coarse])


def _grid_rows(rings: list[FloatArray]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Frame along the longest edge of any polygon, and its flat bounds: lowest corner and extent."""
    vector = vector_area(rings)
    normal = vector / np.linalg.norm(vector)
    sides = np.roll(rings[0], -1, axis=0) - rings[0]
    u = sides[int(np.argmax(np.linalg.norm(sides, axis=1)))]
    u = u / np.linalg.norm(u) if np.linalg.norm(u) > 0 else plane_basis(normal)[0]
    frame = np.stack([u, np.cross(normal, u)])
    flat = (np.concatenate(rings) - rings[0][0]) @ frame.T
    return frame, flat.min(axis=0), np.ptp(flat, axis=0)


def _mesh_polygon(rings: list[FloatArray], pieces: list[FloatArray], edge: float, split: int) -> _Part:
    """Any polygon: cells of a grid along its longest edge, cut by its outline."""
    frame, low, extent = _grid_rows(rings)
    nu, nv = (_steps(float(length), edge, split) for length in extent)
    if nu * nv == 1:
        return _Part([pieces], [0], [pieces])
    flat = [(ring - rings[0][0]) @ frame.T for ring in rings]
    outline = shapely.Polygon(flat[0], flat[1:])
    shapely.prepare(outline)
    xs = low[0] + extent[0] * np.linspace(0, 1, nu + 1)
    ys = low[1] + extent[1] * np.linspace(0, 1, nv + 1)
    grid = np.stack(np.meshgrid(xs, ys), axis=-1)
    cells = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=2).reshape(-1, 4, 2)
    boxes = shapely.box(cells[:, 0, 0], cells[:, 0, 1], cells[:, 2, 0], cells[:, 2, 1])
    least = 1e-6 * float(extent[0] * extent[1]) / (nu * nv)
    parts: list[list[FloatArray]] = []
    groups: dict[int, list[int]] = {}

    def add(cell: int, part: list[FloatArray]) -> None:
        j, i = divmod(cell, nu)
        groups.setdefault((j // split) * nu + i // split, []).append(len(parts))
        parts.append(part)

    whole = shapely.covers(outline, boxes)
    lifted = rings[0][0] + cells @ frame
    for cell in range(len(boxes)):
        if whole[cell]:
            add(cell, [np.ascontiguousarray(lifted[cell])])
            continue
        for part in shapely.get_parts(shapely.intersection(boxes[cell], outline)):
            if part.geom_type != "Polygon" or part.area <= least:
                continue
            part = shapely.geometry.polygon.orient(part)
            loops = [np.asarray(part.exterior.coords)[:-1]] + [np.asarray(r.coords)[:-1] for r in part.interiors]
            add(cell, convex_pieces([rings[0][0] + loop @ frame for loop in loops]))
    if split == 1:  # a hole may leave two parts of one cell: each is an element and a patch
        return _Part(parts, list(range(len(parts))), parts)
    patch = np.empty(len(parts), dtype=np.int64)
    for number, members in enumerate(groups.values()):
        patch[members] = number
    senders = [[piece for k in members for piece in parts[k]] for members in groups.values()]
    return _Part(parts, patch.tolist(), senders)


@dataclass(frozen=True)
class Extents:
    """What decides into how many elements the polygons of a surface fall.

    Quads and other polygons fall into ``share`` of the cells of a grid over ``along`` x ``across``; of triangles,
    whose ``across`` is 0, ``along`` is the longest edge.
    """

    along: FloatArray
    across: FloatArray
    share: FloatArray

    @classmethod
    def of_surface(cls, surface: Surface) -> Extents:
        """Measure every polygon once."""
        sizes = np.diff(surface.ring_offsets)
        if len(sizes) == surface.face_count and (sizes == sizes[0]).all() and sizes[0] in (3, 4):
            ring = surface.vertices[surface.ring_vertices].reshape(len(sizes), sizes[0], 3)
            side = np.linalg.norm(np.roll(ring, -1, axis=1) - ring, axis=2)
            if sizes[0] == 3:
                return cls(side.max(axis=1), np.zeros(len(sizes)), np.ones(len(sizes)))
            return cls(np.maximum(side[:, 0], side[:, 2]), np.maximum(side[:, 1], side[:, 3]), np.ones(len(sizes)))
        rows = []
        for rings in surface.faces():
            if len(rings) == 1 and len(rings[0]) in (3, 4):
                side = np.linalg.norm(np.roll(rings[0], -1, axis=0) - rings[0], axis=1)
                triangle = len(side) == 3
                rows.append((side.max(), 0.0, 1.0) if triangle else (max(side[0], side[2]), max(side[1], side[3]), 1.0))
            else:
                extent = _grid_rows(rings)[2]
                rows.append((*extent, float(np.linalg.norm(vector_area(rings)) / (extent[0] * extent[1]))))
        return cls(*(np.array(column) for column in zip(*rows, strict=True)))

    def counts(self, edge: float | FloatArray, split: int) -> IntArray:
        """About how many elements each polygon falls into, with one largest edge or one a polygon."""

        def steps(length: FloatArray) -> FloatArray:
            count = np.maximum(1.0, np.ceil(length / edge - 1e-9))
            return np.where(count > 1, split * np.ceil(count / split), count)

        along = steps(self.along)
        across = np.where(self.across > 0, steps(self.across), along)
        return np.maximum(1, np.ceil(self.share * along * across)).astype(np.int64)


def edge_scales(geometry: Geometry) -> FloatArray:
    """How much longer (q,) the elements' edges are on a polygon that is far larger than all smaller ones together.

    A yard of a thousand times the area of the house on it would else get all elements, and the house none.
    """
    area = geometry.polygon_area
    order = np.argsort(area, kind="stable")
    counted = area[order].copy()
    outlier = np.flatnonzero(counted > VAST * area.sum())
    for k in outlier[outlier > 0].tolist():
        counted[k] = min(counted[k], MOST_OF_REST * counted[:k].sum())
    scales = np.empty(len(area))
    scales[order] = np.sqrt(area[order] / counted)
    return scales


def forecast_elements(
    scene: Scene,
    edge: float,
    split: int = 2,
    extents: list[Extents] | None = None,
    scales: FloatArray | None = None,
) -> int:
    """About how many elements :func:`build_mesh` makes for a largest edge, without making them.

    ``scales`` (q,) multiplies the edge for each polygon.
    """
    total = first = 0
    for number, surface in enumerate(scene.surfaces):
        sides = 2 if surface.material.two_sided else 1
        if not surface.face_count:
            continue
        edges = edge if scales is None else edge * scales[first : first + surface.face_count]
        first += surface.face_count
        n = (extents[number] if extents is not None else Extents.of_surface(surface)).counts(edges, split)
        small = small_facets(surface, edge) if (np.diff(surface.ring_offsets) == 3).all() else ()
        if len(small):
            n[small] = 0
            tri = surface.vertices[surface.ring_vertices].reshape(-1, 3, 3)[small]
            vector = np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0])
            area = 0.5 * np.linalg.norm(vector, axis=1)
            normal = vector / np.maximum(2.0 * area, 1e-300)[:, None]
            cell = min(edge, math.sqrt(float(area.sum()) / COARSE_CLUSTERS))
            key = _cluster_keys(tri.mean(axis=1), normal, cell)
            # One number a key: the count of distinct ones is all that is asked.
            low, span = key.min(axis=0), np.ptp(key, axis=0) + 1
            total += sides * len(np.unique(((key - low) * np.cumprod([1, *span[:-1]])).sum(axis=1)))
        total += sides * int(n.sum())
    return total


def _edge_for(scene: Scene, geometry: Geometry, elements: int, split: int, scales: FloatArray) -> float:
    """Largest edge that gives about the asked number of elements, by bisection."""
    extents = [Extents.of_surface(surface) for surface in scene.surfaces]
    high = 2.0 * geometry.size
    if forecast_elements(scene, high, split, extents, scales) >= elements:
        return math.inf
    low = math.sqrt(float((geometry.polygon_area / scales**2).sum()) / (4.0 * elements))
    while forecast_elements(scene, low, split, extents, scales) < elements and low > 1e-6 * geometry.size:
        low *= 0.5
    for _ in range(40):
        middle = math.sqrt(low * high)
        if forecast_elements(scene, middle, split, extents, scales) > elements:
            low = middle
        else:
            high = middle
        if high / low < 1.005:
            break
    return high


def small_facets(surface: Surface, edge: float) -> IntArray:
    """Faces of a tessellated surface that are no larger than an element: those are clustered."""
    sizes = np.diff(surface.ring_offsets)
    if surface.face_count < TESSELLATED or len(sizes) != surface.face_count:
        return np.empty(0, np.int64)
    corner = surface.vertices[surface.ring_vertices]
    starts = surface.ring_offsets[:-1]
    low, high = np.minimum.reduceat(corner, starts), np.maximum.reduceat(corner, starts)
    # The box of a facet bounds its area: good enough to tell a wall from a facet of a statue.
    extent = np.sort(high - low, axis=1)
    largest = math.sqrt(float((extent[:, 1] * extent[:, 2]).sum()) / COARSE_CLUSTERS)
    small = np.flatnonzero(extent[:, 2] <= min(edge, 0.5 * largest))
    return small if len(small) >= TESSELLATED else np.empty(0, np.int64)


def _cluster_keys(centroid: FloatArray, normal: FloatArray, cell: float) -> IntArray:
    """Cube and direction (n, 6) of each facet."""
    place = np.floor((centroid - centroid.min(axis=0)) / cell).astype(np.int64)
    return np.concatenate([place, np.floor((normal + 1.0) * 1.9999).astype(np.int64)], axis=1)


def _clusters(centroid: FloatArray, normal: FloatArray, cell: float) -> tuple[IntArray, IntArray]:
    """Element of each facet, and patch of each element, by place and direction.

    Facets of one element share a cube of side ``cell`` and face the same of four directions an axis;
    patches join the elements of cubes twice as large and of one octant.
    """
    distinct, element = np.unique(_cluster_keys(centroid, normal, cell), axis=0, return_inverse=True)
    return element.ravel(), np.unique(distinct // 2, axis=0, return_inverse=True)[1].ravel()


def build_mesh(
    scene: Scene,
    geometry: Geometry,
    *,
    elements: int | None = None,
    max_edge: float | None = None,
    split: int = 2,
    cluster: bool = True,
) -> PatchMesh:
    """Divide a scene's polygons into elements and patches.

    Parameters
    ----------
    scene, geometry : Scene, Geometry
        A scene and its flattened form.
    elements : int, optional
        About how many elements to make; never fewer than one a polygon (and side), or than a
        coarse set of clusters on a tessellated surface.
    max_edge : float, optional
        Longest element edge instead. [scene lengths]  Neither: one element a polygon.
    split : int
        Elements along the edge of a patch.
    cluster : bool
        Let small facets of tessellated surfaces shoot together.

    Raises
    ------
    OptionError
        If both are given, or one is not positive.
    """
    if elements is not None and max_edge is not None:
        raise OptionError("elements and max_edge were both given; choose one of them")
    if elements is not None:
        elements = as_count(elements, "elements")
    if max_edge is not None:
        max_edge = as_positive(max_edge, "max_edge", "a positive length")
    edge, scales = math.inf, np.ones(geometry.polygon_count)
    if max_edge is not None:
        edge = max_edge
    elif elements is not None:
        scales = edge_scales(geometry)
        edge = _edge_for(scene, geometry, elements, split, scales)
    # One element a polygon is asked for as such; elements of a mesh end where something stands on them.
    contacts = contact_lines(geometry, NEAR * edge, LEAST_TOUCHING * edge) if math.isfinite(edge) else {}
    edge = min(edge, 4.0 * geometry.size)

    rings: list[list[FloatArray]] = []
    polygon: list[int] = []
    side: list[int] = []
    patch: list[int] = []
    senders: list[list[FloatArray]] = []
    patch_polygon: list[int] = []
    number = 0
    surface_of: list[int] = []
    for surface_index, surface in enumerate(scene.surfaces):
        sides = (1, -1) if surface.material.two_sided else (1,)
        faces = range(surface.face_count)
        sizes = np.diff(surface.ring_offsets)
        fine: set[int] = set()
        small = small_facets(surface, edge) if cluster else np.empty(0, np.int64)
        if len(small):
            fine = set(small.tolist())
            first = surface.ring_offsets[small]
            corner = surface.vertices[surface.ring_vertices]
            centroid = np.add.reduceat(corner, surface.ring_offsets[:-1])[small] / sizes[small, None]
            small_area = float(geometry.polygon_area[number + small].sum())
            element_of, patch_of = _clusters(
                centroid, geometry.polygon_normal[number + small], min(edge, math.sqrt(small_area / COARSE_CLUSTERS))
            )
            facets = [corner[start : start + size] for start, size in zip(first, sizes[small], strict=True)]
            for sign in sides:
                base = len(senders)
                groups: list[list[FloatArray]] = [[] for _ in patch_of]
                for facet, group in zip(facets, element_of.tolist(), strict=True):
                    groups[group].append(facet[::sign])
                rings.extend(groups)
                polygon.extend([-1] * len(groups))
                surface_of.extend([surface_index] * len(groups))
                side.extend([sign] * len(groups))
                patch.extend((base + patch_of).tolist())
                merged: list[list[FloatArray]] = [[] for _ in range(int(patch_of.max()) + 1)]
                for group, owner in zip(groups, patch_of.tolist(), strict=True):
                    merged[owner].extend(group)
                senders.extend(merged)
                patch_polygon.extend([-1] * len(merged))
        for face in faces:
            if face in fine:
                continue
            loops = surface.face(face)
            a, b = geometry.polygon_piece_start[number + face : number + face + 2]
            pieces = [geometry.piece(i) for i in range(a, b)]
            longest = edge * scales[number + face]
            if len(loops) == 1 and len(loops[0]) == 3:
                part = _mesh_triangle(loops[0], longest, split)
            elif len(loops) == 1 and len(loops[0]) == 4 and len(pieces) == 1:
                part = _mesh_quad(loops[0], longest, split)
            else:
                part = _mesh_polygon(loops, pieces, longest, split)
            if number + face in contacts:
                part = _cut_at_contacts(part, geometry.polygon_normal[number + face], contacts[number + face])
            for sign in sides:
                base = len(senders)
                rings.extend([loop[::sign] for loop in element] for element in part.elements)
                polygon.extend([number + face] * len(part.elements))
                surface_of.extend([surface_index] * len(part.elements))
                side.extend([sign] * len(part.elements))
                patch.extend(base + p for p in part.patch_of)
                senders.extend([loop[::sign] for loop in sender] for sender in part.senders)
                patch_polygon.extend([number + face] * len(part.senders))
        number += surface.face_count

    order = np.argsort(np.asarray(patch, dtype=np.int64), kind="stable")
    rings = [rings[i] for i in order]
    element_patch = np.asarray(patch, dtype=np.int64)[order]
    element_polygon = np.asarray(polygon, dtype=np.int64)[order]
    element_side = np.asarray(side, dtype=np.int64)[order]
    element_surface = np.asarray(surface_of, dtype=np.int64)[order]
    flat = [loop for element in rings for loop in element]
    piece_start = np.concatenate([[0], np.cumsum([len(loop) for loop in flat])]).astype(np.int64)
    corners = np.ascontiguousarray(np.concatenate(flat))
    piece_element = np.repeat(np.arange(len(rings)), [len(element) for element in rings]).astype(np.int64)
    element_area, centroid = _area_and_centroid(corners, piece_start, piece_element, len(rings))
    away = np.linalg.norm(corners - centroid[np.repeat(piece_element, np.diff(piece_start))], axis=1)
    first_corner = piece_start[np.searchsorted(piece_element, np.arange(len(rings)))]
    piece_vector = _vector_areas(corners, piece_start)
    sender_flat = [loop for sender in senders for loop in sender]
    sender_start = np.concatenate([[0], np.cumsum([len(loop) for loop in sender_flat])]).astype(np.int64)
    sender_corners = np.ascontiguousarray(np.concatenate(sender_flat))
    vectors = _vector_areas(sender_corners, sender_start)
    materials = [surface.material for surface in scene.surfaces]
    return PatchMesh(
        corners=corners,
        piece_start=piece_start,
        piece_element=piece_element,
        element_area=element_area,
        element_normal=_element_normals(geometry, element_polygon, element_side, piece_vector, piece_element),
        piece_normal=np.ascontiguousarray(piece_vector / np.linalg.norm(piece_vector, axis=1)[:, None]),
        element_centroid=centroid,
        element_size=2.0 * np.maximum.reduceat(away, first_corner),
        element_polygon=element_polygon,
        element_surface=element_surface,
        element_side=element_side,
        element_patch=element_patch,
        reflectance=np.ascontiguousarray(np.stack([m.reflectance for m in materials])[element_surface]),
        emission=np.ascontiguousarray(np.stack([m.emission for m in materials])[element_surface]),
        patch_start=np.searchsorted(element_patch, np.arange(len(senders) + 1)).astype(np.int64),
        sender_corners=sender_corners,
        sender_start=sender_start,
        sender_normal=np.ascontiguousarray(vectors / np.linalg.norm(vectors, axis=1)[:, None]),
        patch_sender=np.concatenate([[0], np.cumsum([len(sender) for sender in senders])]).astype(np.int64),
        patch_polygon=np.asarray(patch_polygon, dtype=np.int64),
        facet_error=max((surface.facet_error for surface in scene.surfaces), default=0.0),
    )


def _element_normals(
    geometry: Geometry, polygon: IntArray, side: IntArray, piece_vector: FloatArray, piece_element: IntArray
) -> FloatArray:
    """Normals of the polygons, and of clusters the mean direction of their facets."""
    total = np.stack([np.bincount(piece_element, piece_vector[:, k], len(polygon)) for k in range(3)], axis=1)
    normal = total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None]
    flat = polygon >= 0
    normal[flat] = geometry.polygon_normal[polygon[flat]] * side[flat, None]
    return np.ascontiguousarray(normal)


def _vector_areas(corners: FloatArray, starts: IntArray) -> FloatArray:
    tri, ring = fan_triangles(corners, starts)
    out = np.zeros((len(starts) - 1, 3))
    np.add.at(out, ring, 0.5 * np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0]))
    return out


def _area_and_centroid(
    corners: FloatArray, starts: IntArray, owner: IntArray, count: int
) -> tuple[FloatArray, FloatArray]:
    tri, ring = fan_triangles(corners, starts)
    part = 0.5 * np.linalg.norm(np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0]), axis=1)
    who = owner[ring]
    area = np.bincount(who, part, count).astype(np.float64)
    centroid = np.stack([np.bincount(who, part * tri.mean(axis=1)[:, k], count) for k in range(3)], axis=1)
    return area, np.ascontiguousarray(centroid / area[:, None])
