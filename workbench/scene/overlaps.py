"""Polygons that lie on others in one plane, facing the same way: what they hide is cut away.

A lamp flush with its ceiling, a rug on a floor, a face that an exporter wrote twice: without a cut both would
receive and send, and the light there would count twice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from workbench.scene.model import Scene, Surface

if TYPE_CHECKING:
    import shapely

__all__ = ["without_overlaps"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SAME_NORMAL, SAME_OFFSET = 1e-6, 1e-7
"""Steps to which normals, and distances of planes over the scene's size, are rounded to tell the same plane."""
FEW = 600
"""Faces in shared planes up to which each is compared with each."""
NEGLIGIBLE = 1e-9
"""Share of a polygon's area, or of its sides, that is no overlap but rounding."""


def without_overlaps(scene: Scene) -> Scene:
    """The scene with every polygon cut away where a smaller one lies on it; the same object where none does.

    Of equal polygons the first stays.  Polygons with transmittance or shading normals are left alone, and two-sided
    ones are cut by two-sided ones only: from behind one would see what is cut away.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    Scene
        Its ``notes`` say what was cut.
    """
    surfaces = [s for s in scene.surfaces if s.face_count and s.sphere is None and s.vertex_normals is None]
    surfaces = [s for s in surfaces if not s.material.transmittance.any()]
    if sum(s.face_count for s in surfaces) < 2:
        return scene
    plane = np.concatenate([_planes(s) for s in surfaces])
    owner = np.repeat(np.arange(len(surfaces)), [s.face_count for s in surfaces])
    face = np.concatenate([np.arange(s.face_count) for s in surfaces])
    two = np.array([s.material.two_sided for s in surfaces])[owner]
    group = _groups(plane, scene)
    pairs = _touching_boxes(surfaces, owner, face, plane, group)
    if not len(pairs):
        return scene
    import shapely  # only where something may overlap: it takes a while

    shapes: dict[int, shapely.Polygon] = {}

    def shape(i: int) -> shapely.Polygon:
        if i not in shapes:
            rings = [ring[:, _kept(plane[i])] for ring in surfaces[owner[i]].face(int(face[i]))]
            shapes[i] = shapely.make_valid(shapely.Polygon(rings[0], rings[1:]))
        return shapes[i]

    covers: dict[int, list[int]] = {}
    for i, j in pairs.tolist():
        facing = float(plane[i, :3] @ plane[j, :3]) > 0
        one, other = shape(i), shape(j)
        # The smaller lies on the larger; of equals the first.
        below, above = (i, j) if other.area < one.area * (1.0 - NEGLIGIBLE) else (j, i)
        if (two[below] and not two[above]) or not (facing or two[above]):
            continue
        if one.intersection(other).area > NEGLIGIBLE * min(one.area, other.area):
            covers.setdefault(below, []).append(above)
    if not covers:
        return scene
    return _cut(scene, surfaces, owner, face, plane, covers, shape)


def _planes(surface: Surface) -> FloatArray:
    """Unit normal and distance from the origin (faces, 4) of each face, from its outer ring (M. E. Newell)."""
    first = surface.face_rings[:-1]
    start, end = surface.ring_offsets[first], surface.ring_offsets[first + 1]
    sizes = end - start
    which = np.repeat(np.arange(len(sizes)), sizes)
    row = np.arange(len(which)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    here = surface.vertices[surface.ring_vertices[start[which] + row]]
    after = surface.vertices[surface.ring_vertices[start[which] + (row + 1) % sizes[which]]]
    base = here[np.cumsum(sizes) - sizes]
    normal = np.add.reduceat(np.cross(here - base[which], after - base[which]), np.cumsum(sizes) - sizes)
    length = np.linalg.norm(normal, axis=1)
    normal /= np.where(length > 0, length, 1.0)[:, None]
    return np.column_stack([normal, np.einsum("ij,ij->i", normal, base)])


def _groups(plane: FloatArray, scene: Scene) -> IntArray:
    """A number for each plane, whatever way its faces look."""
    corners = np.concatenate([surface.vertices for surface in scene.surfaces])
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle, size = 0.5 * (low + high), max(float((high - low).max()), 1e-300)
    key = np.column_stack([plane[:, :3] / SAME_NORMAL, (plane[:, 3] - plane[:, :3] @ middle) / (size * SAME_OFFSET)])
    key = np.round(key)
    lead = key[np.arange(len(key)), np.argmax(np.abs(plane[:, :3]), axis=1)]
    key *= np.where(lead < 0, -1.0, 1.0)[:, None]
    group: IntArray = np.unique(key + 0.0, axis=0, return_inverse=True)[1].reshape(-1)
    return group


def _kept(plane: FloatArray) -> list[int]:
    """The two axes on which a plane is seen widest."""
    away = int(np.argmax(np.abs(plane[:3])))
    return [axis for axis in range(3) if axis != away]


def _touching_boxes(
    surfaces: list[Surface], owner: IntArray, face: IntArray, plane: FloatArray, group: IntArray
) -> IntArray:
    """Pairs (n, 2), in order, of faces of one plane whose boxes overlap."""
    shared = np.flatnonzero(np.bincount(group)[group] > 1)
    if not len(shared):
        return np.empty((0, 2), dtype=np.int64)
    box = np.empty((len(shared), 2, 3))
    at = 0
    for number, surface in enumerate(surfaces):
        mine = face[shared[owner[shared] == number]]
        if len(mine):
            corner = surface.vertices[surface.ring_vertices]
            first = surface.ring_offsets[surface.face_rings]
            for side, bound in enumerate((np.minimum, np.maximum)):
                box[at : at + len(mine), side] = bound.reduceat(corner, first[:-1])[mine]
            at += len(mine)
    axes = np.argsort(np.abs(plane[shared, :3]), axis=1, kind="stable")[:, :2]
    low, high = (np.take_along_axis(box[:, side], axes, axis=1) for side in (0, 1))
    inset = NEGLIGIBLE * (high - low)
    low, high = low + inset, high - inset
    same = group[shared]
    if len(shared) <= FEW:
        met = same[:, None] == same
        for axis in range(2):
            met &= (low[:, None, axis] <= high[:, axis]) & (low[:, axis] <= high[:, None, axis])
        pairs: IntArray = shared[np.argwhere(np.triu(met, 1))]
        return pairs
    import shapely

    # Planes side by side, so that one tree finds all pairs.
    left, width = low[:, 0].min(), float(np.ptp(np.concatenate([low[:, 0], high[:, 0]]))) + 1.0
    shift = np.unique(same, return_inverse=True)[1].reshape(-1) * 2.0 * width - left
    boxes = shapely.box(low[:, 0] + shift, low[:, 1], high[:, 0] + shift, high[:, 1])
    found = shapely.STRtree(boxes).query(boxes, predicate="intersects")
    found = found[:, found[0] < found[1]]
    pairs = np.sort(shared[found[:, same[found[0]] == same[found[1]]]].T, axis=1)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def _cut(
    scene: Scene, surfaces: list[Surface], owner: IntArray, face: IntArray, plane: FloatArray,
    covers: dict[int, list[int]], shape: Callable[[int], shapely.Polygon],
) -> Scene:  # fmt: skip
    """The scene with what ``covers`` hide cut away."""
    import shapely

    changed: dict[int, Surface | None] = {}
    notes = []
    for number, surface in enumerate(surfaces):
        mine = [i for i in covers if owner[i] == number]
        if not mine:
            continue
        faces: list[list[FloatArray]] = []
        by: dict[str, float] = {}
        hit = {int(face[i]): i for i in mine}
        for index in range(surface.face_count):
            if index not in hit:
                faces.append(surface.face(index))
                continue
            i = hit[index]
            left = shape(i)
            for j in covers[i]:
                before = left.area
                left = left.difference(shape(j))
                by[surfaces[owner[j]].name] = by.get(surfaces[owner[j]].name, 0.0) + before - left.area
            parts = [part for part in shapely.get_parts(left) if part.geom_type == "Polygon"]
            faces += [_rings(p, plane[i]) for p in parts if p.area > NEGLIGIBLE * shape(i).area]
        notes.append(
            f"surface {surface.name!r} was cut away where it lies in one plane under {', '.join(map(repr, by))}"
        )
        new = Surface.from_polygons(surface.name, surface.material, faces) if faces else None
        changed[id(surface)] = None if new is None else replace(new, facet_error=surface.facet_error)
    kept = [changed.get(id(surface), surface) for surface in scene.surfaces]
    return replace(
        scene, surfaces=tuple(surface for surface in kept if surface is not None), notes=(*scene.notes, *notes)
    )


def _rings(part: shapely.Polygon, plane: FloatArray) -> list[FloatArray]:
    """Rings of a face in space from a shape in its plane, counter-clockwise from its front; holes the other way."""
    from shapely.geometry.polygon import orient

    axes = _kept(plane)
    away = 3 - sum(axes)
    # Seen along the axis left out, what is counter-clockwise from the front is so if the normal points at the eye.
    turned = (plane[away] > 0) == (away != 1)
    part = orient(part, 1.0 if turned else -1.0)
    rings = []
    for line in (part.exterior, *part.interiors):
        flat = np.asarray(line.coords)[:-1]
        ring = np.empty((len(flat), 3))
        ring[:, axes] = flat
        ring[:, away] = (plane[3] - flat @ plane[axes]) / plane[away]
        rings.append(ring)
    return rings
