"""Geometry: a scene flattened to the arrays that kernels read.

A *polygon* is a face of a surface as the author wrote it.  A *piece* is one of the convex parts
it is cut into (most polygons are one piece).  A *triangle* is one of a piece's fan, for tracers
that know triangles only.  Each knows the one above it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from workbench.errors import InputError, SceneError
from workbench.geometry.polygons import are_convex, convex_pieces, fan_triangles, vector_area
from workbench.scene.model import Material, Scene, Surface

__all__ = ["Geometry"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
"""Axes of a cross product, written out: numpy's takes ten times as long on a few vectors."""


def _convex_meshes(surfaces: Sequence[Surface]) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Corners (f, n, 3) and vector areas (f, 3) of meshes of triangles or convex quads, by number: nothing to cut.

    All surfaces at once: scenes of many small ones are common.
    """
    found: dict[int, tuple[FloatArray, FloatArray]] = {}
    for many in (3, 4):
        chosen = [
            number
            for number, surface in enumerate(surfaces)
            if surface.face_count
            and len(surface.ring_offsets) == surface.face_count + 1
            and surface.ring_offsets[1] == many
            and (surface.face_count == 1 or (np.diff(surface.ring_offsets) == many).all())
        ]
        if not chosen:
            continue
        rings = [surfaces[number].vertices[surfaces[number].ring_vertices].reshape(-1, many, 3) for number in chosen]
        corners = np.concatenate(rings)
        side = corners[:, 1:] - corners[:, :1]
        one, two = side[:, :-1], side[:, 1:]
        turned = one[..., _NEXT] * two[..., _LAST] - one[..., _LAST] * two[..., _NEXT]
        vectors = 0.5 * turned.sum(axis=1)
        good = np.ones(len(corners), dtype=bool)
        if many == 4:
            area = np.linalg.norm(vectors, axis=1)
            good = (area > 0) & are_convex(corners, vectors / np.where(area > 0, area, 1.0)[:, None])
        ends = np.cumsum([len(ring) for ring in rings])
        for number, ring, end in zip(chosen, rings, ends.tolist(), strict=True):
            part = slice(end - len(ring), end)
            if good[part].all():
                found[number] = ring, vectors[part]
    return found


@dataclass(frozen=True)
class Geometry:
    """The polygons of a scene as flat arrays.

    Parameters
    ----------
    corners : (k, 3) float
        Corners of the convex pieces, piece after piece, counter-clockwise from the front.
    piece_start : (p + 1,) int
        Piece ``i`` has corners ``piece_start[i]:piece_start[i + 1]``.
    piece_normal : (p, 3) float
        Unit normals.
    piece_polygon : (p,) int
    polygon_area : (q,) float
        Areas. [scene lengths squared]
    polygon_normal : (q, 3) float
    polygon_surface : (q,) int
    polygon_face : (q,) int
        Index of the face inside its surface.
    surface_material : list of Material
    surface_name : list of str
    polygon_transmittance : (q,) float
        Mean transmittance over the bands; 0 blocks.
    """

    corners: FloatArray
    piece_start: IntArray
    piece_normal: FloatArray
    piece_polygon: IntArray
    polygon_area: FloatArray
    polygon_normal: FloatArray
    polygon_surface: IntArray
    polygon_face: IntArray
    surface_material: tuple[Material, ...]
    surface_name: tuple[str, ...]
    polygon_transmittance: FloatArray

    @property
    def piece_count(self) -> int:
        """Number of convex pieces."""
        return len(self.piece_polygon)

    @property
    def polygon_count(self) -> int:
        """Number of polygons."""
        return len(self.polygon_area)

    def piece(self, index: int) -> FloatArray:
        """Corners (n, 3) of one convex piece."""
        return self.corners[self.piece_start[index] : self.piece_start[index + 1]]

    @cached_property
    def polygon_piece_start(self) -> IntArray:
        """(q + 1,) int: polygon ``j`` has pieces ``start[j]:start[j + 1]``."""
        return np.searchsorted(self.piece_polygon, np.arange(self.polygon_count + 1)).astype(np.int64)

    @cached_property
    def bounds(self) -> FloatArray:
        """(2, 3) float: lowest and highest corner of the whole."""
        if len(self.corners) == 0:
            return np.zeros((2, 3))
        return np.stack([self.corners.min(axis=0), self.corners.max(axis=0)])

    @cached_property
    def size(self) -> float:
        """Longest side of the bounding box; 1 for an empty geometry."""
        return float(np.ptp(self.bounds, axis=0).max()) or 1.0

    @cached_property
    def slack(self) -> float:
        """Distance by which a polygon must lie outside a plane to be culled. [scene lengths]

        A share of the size, but never less than the coordinates' own rounding far from the origin.
        """
        return max(1e-12 * self.size, 16.0 * float(np.finfo(np.float64).eps) * float(np.abs(self.bounds).max()))

    @cached_property
    def piece_bounds(self) -> FloatArray:
        """(p, 2, 3) float: lowest and highest corner of each piece."""
        starts = self.piece_start[:-1]
        if len(starts) == 0:
            return np.empty((0, 2, 3))
        low = np.minimum.reduceat(self.corners, starts, axis=0)
        high = np.maximum.reduceat(self.corners, starts, axis=0)
        return np.ascontiguousarray(np.stack([low, high], axis=1))

    @cached_property
    def triangles(self) -> tuple[FloatArray, IntArray]:
        """Fan triangles (t, 3, 3) of all pieces, and the piece (t,) of each."""
        return fan_triangles(self.corners, self.piece_start)

    def part(self, keep: NDArray[np.bool_]) -> Geometry:
        """The polygons (q,) that are to be kept, in their order."""
        pieces = keep[self.piece_polygon]
        sizes = np.diff(self.piece_start)
        number = np.cumsum(keep) - 1
        return Geometry(
            corners=np.ascontiguousarray(self.corners[np.repeat(pieces, sizes)]),
            piece_start=np.concatenate([[0], np.cumsum(sizes[pieces])]).astype(np.int64),
            piece_normal=self.piece_normal[pieces],
            piece_polygon=number[self.piece_polygon[pieces]],
            polygon_area=self.polygon_area[keep],
            polygon_normal=self.polygon_normal[keep],
            polygon_surface=self.polygon_surface[keep],
            polygon_face=self.polygon_face[keep],
            surface_material=self.surface_material,
            surface_name=self.surface_name,
            polygon_transmittance=self.polygon_transmittance[keep],
        )

    @classmethod
    def from_scene(cls, scene: Scene) -> Geometry:
        """Flatten a scene.

        Raises
        ------
        SceneError
            If a concave polygon cannot be cut (it crosses itself).
        """
        corners: list[FloatArray] = []
        sizes: list[IntArray] = []
        piece_polygon: list[IntArray] = []
        vectors: list[FloatArray] = []
        polygon_surface: list[IntArray] = []
        polygon_face: list[IntArray] = []
        polygons = 0
        meshes = _convex_meshes(scene.surfaces)
        for index, surface in enumerate(scene.surfaces):
            count = surface.face_count
            whole = meshes.get(index)
            if whole is not None:
                corners.append(whole[0].reshape(-1, 3))
                sizes.append(np.full(count, whole[0].shape[1]))
                piece_polygon.append(np.arange(polygons, polygons + count))
                vectors.append(whole[1])
            else:
                for face, rings in enumerate(surface.faces()):
                    try:
                        pieces = convex_pieces(rings)
                    except InputError as error:
                        raise SceneError(
                            f"surface {surface.name!r}, face {face}: found {error}, expected a simple polygon",
                            path=scene.path,
                        ) from None
                    corners.extend(pieces)
                    sizes.append(np.asarray([len(piece) for piece in pieces]))
                    piece_polygon.append(np.full(len(pieces), polygons + face))
                    vectors.append(vector_area(rings)[None])
            polygon_surface.append(np.full(count, index))
            polygon_face.append(np.arange(count))
            polygons += count
        vector = np.concatenate(vectors) if vectors else np.empty((0, 3))
        area = np.linalg.norm(vector, axis=1)
        normal = vector / np.where(area > 0, area, 1.0)[:, None]
        owner = np.concatenate(piece_polygon).astype(np.int64) if piece_polygon else np.empty(0, np.int64)
        surface_of = np.concatenate(polygon_surface).astype(np.int64) if polygons else np.empty(0, np.int64)
        through = np.asarray([s.material.transmittance.mean() for s in scene.surfaces] or [0.0])
        return cls(
            corners=np.ascontiguousarray(np.concatenate(corners)) if corners else np.empty((0, 3)),
            piece_start=np.concatenate([[0], np.cumsum(np.concatenate(sizes))]).astype(np.int64)
            if sizes
            else np.zeros(1, np.int64),
            piece_normal=np.ascontiguousarray(normal[owner]),
            piece_polygon=owner,
            polygon_area=area,
            polygon_normal=normal,
            polygon_surface=surface_of,
            polygon_face=np.concatenate(polygon_face).astype(np.int64) if polygons else np.empty(0, np.int64),
            surface_material=tuple(s.material for s in scene.surfaces),
            surface_name=tuple(s.name for s in scene.surfaces),
            polygon_transmittance=through[surface_of] if polygons else np.empty(0),
        )
