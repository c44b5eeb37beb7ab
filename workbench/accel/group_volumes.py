"""The bounding-volume hierarchy of the ray-casting assignment: the groups of a ``.sc`` file.

Every GROUP (everything between a ``push`` and its ``pop``) carries a bounding sphere and a bounding
box; a ray that misses them skips the group.  Either volume, both (the sphere first) or none can be
chosen, and the answer is the same bit for bit: the volumes are grown by more than the rounding
error of a hit, a group is skipped only when it lies strictly beyond the best hit so far, and
primitives are met in the order of the files, so the first of two equal hits wins either way.

Spheres and polygons are exact and in double precision; polygons, convex or not, are tested by
counting crossings in the coordinate plane that they face most, as in Haines, "Point in Polygon
Strategies", Graphics Gems IV.  The tree is one array in preorder with skip links.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from workbench.accel.base import Hits, Rays, as_rays
from workbench.counters import Counters
from workbench.errors import OptionError
from workbench.geometry.polygons import vector_area
from workbench.scene.sc import ScScene, ScSphere

__all__ = ["VOLUMES", "GroupVolumes"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

VOLUMES = ("none", "bsphere", "bbox", "both")
"""The choices of bounding volume."""

_ROUNDING = 1e-12
"""Growth of the volumes as a share of the coordinates: some thousand times their rounding error."""

_POLYGON, _SPHERE, _GROUP = 0, 1, 2


@njit(nogil=True, cache=True)
def _sphere_span(ox, oy, oz, dx, dy, dz, length2, cx, cy, cz, radius):
    """Parameters where the ray's line enters and leaves a sphere; (inf, -inf) when it misses.

    The distance from centre to line is formed from the part of the vector across the ray: the
    textbook b^2 - c loses half the digits of small spheres far away.
    """
    x, y, z = cx - ox, cy - oy, cz - oz
    middle = (x * dx + y * dy + z * dz) / length2
    x -= middle * dx
    y -= middle * dy
    z -= middle * dz
    rest = radius * radius - (x * x + y * y + z * z)
    if not rest >= 0.0:
        return np.inf, -np.inf
    half = np.sqrt(rest / length2)
    return middle - half, middle + half


@njit(nogil=True, cache=True)
def _clip_slab(o, d, low, high, enter, leave):
    """The part of ``enter..leave`` in which a coordinate lies in ``low..high``."""
    if abs(d) < 1e-300:
        return (enter, leave) if low <= o <= high else (np.inf, -np.inf)
    near, far = (low - o) / d, (high - o) / d
    if near > far:
        near, far = far, near
    return max(enter, near), min(leave, far)


@njit(nogil=True, cache=True)
def _crossings_odd(x, y, flat, start, end):
    """Whether a point of the plane lies inside the polygon ``flat[start:end]``.

    A crossing of an edge is computed from its lower end, whichever way round the edge is walked,
    so that two polygons of one plane never both miss a point of the edge they share.
    """
    inside = False
    x0, y0 = flat[end - 1, 0], flat[end - 1, 1]
    for k in range(start, end):
        x1, y1 = flat[k, 0], flat[k, 1]
        if (y1 > y) != (y0 > y):
            if y1 > y:
                crossing = x0 + (y - y0) * ((x1 - x0) / (y1 - y0))
            else:
                crossing = x1 + (y - y1) * ((x0 - x1) / (y0 - y1))
            if x < crossing:
                inside = not inside
        x0, y0 = x1, y1
    return inside


@njit(nogil=True, cache=True)
def _traverse(
    origins, directions, far, skip_polygons, any_hit,
    item_kind, item_index, item_skip,
    plane, axes, flat, start, sphere,
    use_bsphere, use_bbox, bsphere, bbox,
    t_out, primitive_out, counts,
):  # fmt: skip
    sphere_tests = polygon_tests = bsphere_tests = bbox_tests = 0
    for ray in range(len(origins)):
        # Plain numbers, not slices of arrays: a slice costs as much as the test itself.
        ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        skip0, skip1 = skip_polygons[ray, 0], skip_polygons[ray, 1]
        length2 = dx * dx + dy * dy + dz * dz
        best, found = far[ray], -1
        item = 0
        while item < len(item_kind):
            kind, i = item_kind[item], item_index[item]
            if kind == _GROUP:
                enter, leave = 0.0, best
                if use_bsphere:
                    bsphere_tests += 1
                    enter, leave = _sphere_span(
                        ox, oy, oz, dx, dy, dz, length2, bsphere[i, 0], bsphere[i, 1], bsphere[i, 2], bsphere[i, 3]
                    )
                    enter, leave = max(enter, 0.0), min(leave, best)
                if use_bbox and enter <= leave:
                    bbox_tests += 1
                    enter, leave = _clip_slab(ox, dx, bbox[i, 0], bbox[i, 3], 0.0, best)
                    enter, leave = _clip_slab(oy, dy, bbox[i, 1], bbox[i, 4], enter, leave)
                    enter, leave = _clip_slab(oz, dz, bbox[i, 2], bbox[i, 5], enter, leave)
                item = item + 1 if enter <= leave else item_skip[item]
                continue
            item += 1
            t = np.inf
            if kind == _SPHERE:
                sphere_tests += 1
                t, leave = _sphere_span(
                    ox, oy, oz, dx, dy, dz, length2, sphere[i, 0], sphere[i, 1], sphere[i, 2], sphere[i, 3]
                )
                if not t > 0.0:
                    t = leave
            else:
                polygon_tests += 1
                slope = plane[i, 0] * dx + plane[i, 1] * dy + plane[i, 2] * dz
                if slope != 0.0:
                    t = (plane[i, 3] - (plane[i, 0] * ox + plane[i, 1] * oy + plane[i, 2] * oz)) / slope
            if not 0.0 < t < best or i in (skip0, skip1):
                continue
            if kind == _POLYGON:
                u, v = axes[i, 0], axes[i, 1]
                x, y = origins[ray, u] + t * directions[ray, u], origins[ray, v] + t * directions[ray, v]
                if not _crossings_odd(x, y, flat, start[i], start[i + 1]):
                    continue
            best, found = t, i
            if any_hit:
                break
        t_out[ray] = best if found >= 0 else np.inf
        primitive_out[ray] = found
    counts[:] = sphere_tests, polygon_tests, bsphere_tests, bbox_tests


@njit(nogil=True, cache=True)
def _meet_polygons(origins, directions, primitives, plane, axes, flat, start, t_out):
    for ray in range(len(origins)):
        i = primitives[ray]
        slope = toward = 0.0
        for k in range(3):
            slope += plane[i, k] * directions[ray, k]
            toward += plane[i, k] * origins[ray, k]
        t_out[ray] = np.inf
        if slope == 0.0:
            continue
        t = (plane[i, 3] - toward) / slope
        u, v = axes[i, 0], axes[i, 1]
        x, y = origins[ray, u] + t * directions[ray, u], origins[ray, v] + t * directions[ray, v]
        if t > 0.0 and _crossings_odd(x, y, flat, start[i], start[i + 1]):
            t_out[ray] = t


class GroupVolumes:
    """Rays against the spheres and polygons of a ``.sc`` scene, group by group.

    ``Hits.polygon`` is the index of the primitive, sphere or polygon, in the scene's order.

    Parameters
    ----------
    scene : ScScene
    volumes : {"none", "bsphere", "bbox", "both"}
        The bounding volumes that are tested.
    primitives : {"all", "spheres"}
        ``"spheres"`` leaves the polygons out, for a caller that traces them otherwise.

    Attributes
    ----------
    counters : Counters
        ``rays``, ``rays_hit``, ``sphere_tests``, ``polygon_tests``, ``bounding_sphere_tests`` and
        ``box_tests`` of every question asked.
    is_sphere : (p,) bool
    """

    name = "groups"

    def __init__(self, scene: ScScene, volumes: str = "both", primitives: str = "all") -> None:
        if volumes not in VOLUMES:
            raise OptionError(f"volumes: found {volumes!r}, expected one of {', '.join(VOLUMES)}")
        if primitives not in ("all", "spheres"):
            raise OptionError(f"primitives: found {primitives!r}, expected 'all' or 'spheres'")
        self.volumes = volumes
        self.counters = Counters()
        count = len(scene.primitives)
        self.is_sphere = np.asarray([isinstance(p, ScSphere) for p in scene.primitives], dtype=bool)
        self._sphere, self._plane = np.zeros((count, 4)), np.zeros((count, 4))
        self._axes = np.zeros((count, 2), dtype=np.int64)
        self._start = np.zeros(count + 1, dtype=np.int64)
        flat: list[FloatArray] = []
        # Distance that a hit may lie outside its primitive's bounds, rounding aside: a polygon may
        # be as uneven as the reader allows, and its hits lie in the mean plane.
        slack = np.zeros(count)
        largest = 0.0
        for index, primitive in enumerate(scene.primitives):
            self._start[index + 1] = self._start[index]
            if isinstance(primitive, ScSphere):
                self._sphere[index] = *primitive.center, primitive.radius
                largest = max(largest, float(np.abs(primitive.center).max()) + primitive.radius)
                continue
            vertices = primitive.vertices
            vector = vector_area(vertices)
            normal = vector / np.linalg.norm(vector)
            offset = float((vertices @ normal).mean())
            drop = int(np.abs(normal).argmax())
            axes = [(drop + 1) % 3, (drop + 2) % 3]
            self._plane[index], self._axes[index] = (*normal, offset), axes
            self._start[index + 1] += len(vertices)
            flat.append(vertices[:, axes])
            slack[index] = 2.0 * float(np.abs(vertices @ normal - offset).max())
            largest = max(largest, float(np.abs(vertices).max()))
        self._flat = np.ascontiguousarray(np.concatenate(flat)) if flat else np.zeros((1, 2))
        self._largest = largest
        groups = scene.groups
        self._bsphere = np.asarray([(*g.bsphere_center, g.bsphere_radius) for g in groups]).reshape(-1, 4)
        self._bbox = np.asarray([g.bbox.ravel() for g in groups]).reshape(-1, 6)
        self._slack = np.asarray([slack[g.first_primitive : g.end_primitive].max() for g in groups])
        kept = np.flatnonzero(self.is_sphere) if primitives == "spheres" else np.arange(count)
        self._link(scene, kept)

    def _link(self, scene: ScScene, kept: IntArray) -> None:
        """Groups and the ``kept`` primitives as one list in preorder with skip links."""
        groups = scene.groups
        first = np.asarray([g.first_primitive for g in groups], dtype=np.int64)
        # Before a group stand the groups before it in preorder and the primitives before its first.
        group_item = np.arange(len(groups)) + np.searchsorted(kept, first)
        after = np.asarray([g.end_group for g in groups], dtype=np.int64) + np.searchsorted(
            kept, np.asarray([g.end_primitive for g in groups], dtype=np.int64)
        )
        primitive_item = np.arange(len(kept)) + np.searchsorted(first, kept, side="right")
        size = len(groups) + len(kept)
        self._item_kind = np.full(size, _GROUP, dtype=np.int64)
        self._item_index = np.zeros(size, dtype=np.int64)
        self._item_skip = np.zeros(size, dtype=np.int64)
        self._item_index[group_item] = np.arange(len(groups))
        self._item_skip[group_item] = after
        self._item_kind[primitive_item] = np.where(self.is_sphere[kept], _SPHERE, _POLYGON)
        self._item_index[primitive_item] = kept

    def _ask(self, rays: Rays, any_hit: bool) -> tuple[Hits, Counters]:
        t, primitive = np.empty(len(rays)), np.empty(len(rays), dtype=np.int64)
        counts = np.zeros(4, dtype=np.int64)
        reach = self._largest + (float(np.abs(rays.origins).max()) if len(rays) else 0.0)
        grow = (self._slack + _ROUNDING * reach)[:, None]
        _traverse(
            rays.origins, rays.directions, rays.far, rays.skip_polygons, any_hit,
            self._item_kind, self._item_index, self._item_skip,
            self._plane, self._axes, self._flat, self._start, self._sphere,
            self.volumes in ("bsphere", "both"), self.volumes in ("bbox", "both"),
            self._bsphere + grow * (0, 0, 0, 1), self._bbox + grow * (-1, -1, -1, 1, 1, 1),
            t, primitive, counts,
        )  # fmt: skip
        sphere_tests, polygon_tests, bsphere_tests, bbox_tests = (int(count) for count in counts)
        return Hits(t, primitive), Counters(
            rays=len(rays),
            rays_hit=int((primitive >= 0).sum()),
            sphere_tests=sphere_tests,
            polygon_tests=polygon_tests,
            bounding_sphere_tests=bsphere_tests,
            box_tests=bbox_tests,
        )

    def normals(self, points: FloatArray, primitives: IntArray) -> FloatArray:
        """Unit normals (n, 3) of ``primitives`` (n,) at ``points`` (n, 3) on them; those of spheres look outward."""
        found = self._plane[primitives, :3]
        sphere = self.is_sphere[primitives]
        outward = points[sphere] - self._sphere[primitives[sphere], :3]
        found[sphere] = outward / np.linalg.norm(outward, axis=1)[:, None]
        return found

    def meet_polygons(self, origins: FloatArray, directions: FloatArray, primitives: IntArray) -> FloatArray:
        """Parameters (n,) where each ray meets the one polygon named for it; ``inf`` where it does not.

        ``origins`` and ``directions`` are (n, 3), ``primitives`` (n,) are indices of polygons.
        Nothing is counted.
        """
        t = np.empty(len(primitives))
        _meet_polygons(origins, directions, primitives, self._plane, self._axes, self._flat, self._start, t)
        return t

    def closest_hit_counted(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        far: float | ArrayLike = np.inf,
        skip_polygons: ArrayLike | None = None,
    ) -> tuple[Hits, Counters]:
        """As :meth:`closest_hit`, with the counts of this question alone: for use from threads."""
        return self._ask(as_rays(origins, directions, far, skip_polygons), False)

    def closest_hit(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        far: float | ArrayLike = np.inf,
        skip_polygons: ArrayLike | None = None,
    ) -> Hits:
        """First crossing of each ray with 0 < t < far; the lower primitive index wins a tie.

        Parameters
        ----------
        origins, directions : (n, 3) float
        far : float or (n,) float
            Limit of t, in units of the direction's length.
        skip_polygons : (n, 2) int, optional
            Primitives that do not count for that ray.

        Raises
        ------
        InputError
            If the shapes do not agree or a value cannot be used.
        """
        hits, counts = self.closest_hit_counted(origins, directions, far, skip_polygons)
        self.counters.merge(counts)
        return hits

    def occluded(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        far: float | ArrayLike = 1.0,
        skip_polygons: ArrayLike | None = None,
    ) -> NDArray[np.bool_]:
        """Whether any primitive lies along each ray with 0 < t < far, (n,) bool; as :meth:`closest_hit`."""
        hits, counts = self._ask(as_rays(origins, directions, far, skip_polygons), True)
        self.counters.merge(counts)
        return hits.polygon >= 0
