"""Hit rates of the cullers: how many polygons they set aside, and how many tests are left to a ray.

Four ways to shade the same points with the same rays to area lights:

* ``rayID``: voxel walk with mailboxes (Woo 1993, Figure 2); nothing is culled;
* ``plane-vertex``: the same walk with the plane-vertex check (his Figure 4);
* ``shaft``: a shaft from each group of points to the light finds candidates in a box tree (Haines and
  Wallace 1991); every ray tests them until one blocks it, without a walk;
* ``shaft, plane-vertex``: each point checks its group's candidates against its own light pyramid.

All four find the same rays blocked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from workbench.accel._intersect import object_crossing, objects_of, ray_frame, ray_limits
from workbench.accel.base import as_skip_polygons
from workbench.accel.box_tree import BoxTree
from workbench.accel.voxel_grid import RayIDs, VoxelGrid
from workbench.arrays import as_points, as_unit_vectors
from workbench.counters import Counters
from workbench.culling.hull_shaft import shaft_candidates, shaft_planes
from workbench.culling.plane_vertex import CHECK_SLACK, light_pyramid, outside_planes, plane_workspace
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import vector_area
from workbench.scene.library import diffuse, torus_knot_mesh
from workbench.scene.model import Scene, Surface
from workbench.shadow.woo import light_occlusion

__all__ = ["METHODS", "HitRates", "Setting", "hit_rates", "sweep"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

METHODS = ("rayID", "plane-vertex", "shaft", "shaft, plane-vertex")


@dataclass(frozen=True)
class HitRates:
    """What one method did for one set of rays.

    Parameters
    ----------
    blocked : (lights, n, K) bool
        Whether each ray is blocked.
    asked, culled : int
        Polygons put to the culler and set aside by it: once a point and light by the plane-vertex
        check, once a group and light by the shaft.  In ``shaft, plane-vertex`` both are summed as
        pairs of a point and a polygon: all of them asked, those that no ray needs to test culled.
    counters : Counters
    """

    blocked: NDArray[np.bool_]
    asked: int
    culled: int
    counters: Counters

    @property
    def tests_per_ray(self) -> float:
        """Intersection tests done for each ray."""
        return self.counters["polygon_tests"] / self.counters["rays"]

    @property
    def culled_share(self) -> float:
        """Share of the polygons asked about that were set aside. [0..1]"""
        return self.culled / self.asked if self.asked else 0.0


@njit(nogil=True, cache=True)
def _candidate_rays(
    objects, points, normals, light, light_normal, samples, skip, candidates, check, slack, planes, blocked, counts
):  # fmt: skip
    # Rays of a group of points against the group's candidates.  counts: rays, hits, tests, checks, culls.
    origin, direction = np.empty((1, 3)), np.empty((1, 3))
    kept = np.empty(candidates.shape[0], dtype=np.int64)
    for row in range(points.shape[0]):
        used = 0
        if check:
            used = light_pyramid(
                points[row, 0], points[row, 1], points[row, 2], normals[row, 0], normals[row, 1], normals[row, 2],
                light, 0, light.shape[0], light_normal, 0.0, planes,
            )  # fmt: skip
        many = 0
        for place in range(candidates.shape[0]):
            piece = candidates[place]
            if objects.owner[piece] == skip[row, 0] or objects.owner[piece] == skip[row, 1]:
                continue
            if check:
                counts[3] += 1
                first, stop = objects.piece_start[piece], objects.piece_start[piece + 1]
                if outside_planes(objects.corners, first, stop, planes, used, slack):
                    counts[4] += 1
                    continue
            kept[many] = piece
            many += 1
        origin[0, :] = points[row]
        for ray in range(samples.shape[1]):
            for k in range(3):
                direction[0, k] = samples[row, ray, k] - points[row, k]
            frame = ray_frame(direction, 0)
            near, far = ray_limits(objects, origin, direction, 0, 1.0, frame[2])
            counts[0] += 1
            blocked[row, ray] = False
            for place in range(many):
                counts[2] += 1
                _, crossings = object_crossing(objects, kept[place], origin, direction, 0, frame, near, far, False)
                if crossings > 0:
                    blocked[row, ray] = True
                    counts[1] += 1
                    break


def hit_rates(
    geometry: Geometry,
    points: ArrayLike,
    normals: ArrayLike,
    lights: Sequence[ArrayLike],
    samples: Sequence[ArrayLike],
    method: str,
    *,
    group: int = 64,
    resolution: int | None = None,
    skip_polygons: ArrayLike | None = None,
) -> HitRates:
    """Shade points from convex area lights by one method and count.

    Parameters
    ----------
    geometry : Geometry
        Opaque occluders.
    points, normals : (n, 3) float
        Receivers; ``group`` neighbours in this order share a shaft.
    lights : sequence of (E, 3) float
        Convex polygons, counter-clockwise from the lit side, wholly above every receiver's horizon.
    samples : sequence of (n, K, 3) float
        On each light.
    method : str
        One of :data:`METHODS`.
    group : int
        Points that share a shaft.
    resolution : int, optional
        Voxels along each axis; by default the grid's own choice.
    skip_polygons : (n, 2) int, optional
        Polygons that never count for a point, such as its own.

    Raises
    ------
    OptionError
        If the method is unknown or ``group`` is less than 1.
    InputError
        If shapes do not agree or a light reaches below a receiver's horizon.
    """
    if method not in METHODS:
        raise OptionError(f"method: found {method!r}, expected one of {', '.join(METHODS)}")
    if group < 1:
        raise OptionError(f"group: found {group}, expected 1 or more")
    place, normal = as_points(points), as_unit_vectors(normals)
    corners = [as_points(light, "light") for light in lights]
    ends = [np.ascontiguousarray(array, dtype=np.float64) for array in samples]
    if len(normal) != len(place) or len(ends) != len(corners) or any(len(array) != len(place) for array in ends):
        raise InputError("hit_rates: found arrays of different lengths, expected one row a point and samples a light")
    for light in corners:
        if (np.einsum("nkj,nj->nk", light[None] - place[:, None], normal) < 0.0).any():
            raise InputError("lights: one reaches below the horizon of a point; its rays there are not comparable")
    skip = as_skip_polygons(skip_polygons, len(place))
    if method in ("rayID", "plane-vertex"):
        return _by_voxels(geometry, place, corners, ends, method == "plane-vertex", resolution, skip)
    return _by_shafts(geometry, place, normal, corners, ends, method == "shaft, plane-vertex", group, skip)


def _by_voxels(geometry, points, lights, samples, check, resolution, skip) -> HitRates:
    grid = VoxelGrid(geometry, resolution=resolution)
    ids = RayIDs(grid.object_count)
    counters = Counters()
    blocked = []
    for light, ends in zip(lights, samples, strict=True):
        found = light_occlusion(grid, points, light, ends, check=check, skip_polygons=skip, ids=ids)
        assert found.transmitted is not None
        blocked.append(found.transmitted[:, :, 0] == 0.0)
        counters.merge(found.counters)
    return HitRates(np.asarray(blocked), counters["plane_vertex_checks"], counters["plane_vertex_culls"], counters)


def _by_shafts(geometry, points, normals, lights, samples, check, group, skip) -> HitRates:
    objects = objects_of(geometry)
    tree = BoxTree.build(geometry)
    counters = Counters()
    counts = np.zeros(5, dtype=np.int64)
    planes = plane_workspace(max(len(light) for light in lights))
    slack = CHECK_SLACK * max(geometry.size, float(np.abs(np.concatenate([points, *lights])).max()))
    blocked = np.empty((len(lights), len(points), samples[0].shape[1]), dtype=bool)
    asked = culled = 0
    for index, light in enumerate(lights):
        vector = vector_area(light)
        facing = vector / np.linalg.norm(vector)
        for first in range(0, len(points), group):
            part = slice(first, first + group)
            shared = bool((skip[part] == skip[first]).all())
            common: list[int] = np.unique(skip[part]).tolist() if shared else []
            counters.add(shafts=1)
            candidates = shaft_candidates(
                geometry, shaft_planes(points[part], light, "box"), tree=tree, skip_polygons=common, counters=counters
            )
            before = counts[4]
            _candidate_rays(
                objects, points[part], normals[part], light, facing, samples[index][part], skip[part], candidates,
                check, slack, planes, blocked[index, part], counts,
            )  # fmt: skip
            many = len(points[part])
            if check:
                asked += many * geometry.piece_count
                culled += many * (geometry.piece_count - len(candidates)) + int(counts[4] - before)
            else:
                asked += geometry.piece_count
                culled += geometry.piece_count - len(candidates)
    rays, hits, tests, checks, culls = counts.tolist()
    counters.add(
        rays=rays, rays_hit=hits, polygon_tests=tests, plane_vertex_checks=checks, plane_vertex_culls=culls
    )  # fmt: skip
    return HitRates(blocked, asked, culled, counters)


@dataclass(frozen=True)
class Setting:
    """A knot over a floor under square lights, and how it is sampled.

    Parameters
    ----------
    resolution : int or None
        Voxels along each axis; ``None`` is the grid's own choice.
    segments : int
        Steps along the knot; an eighth as many go around it: ``segments^2 / 4`` triangles.
    light_side : float
        Of each square light, at height 3 over a floor of side 4. [scene lengths]
    rays : int
        K, to each light from each point; a square number.
    lights : int
        One over the middle, more on a circle round it.
    side : int
        Points along a side of the floor, a multiple of 8.
    group : int
        Points that share a shaft, in rows of tiles of 8 x 8.
    """

    resolution: int | None = None
    segments: int = 96
    light_side: float = 1.0
    rays: int = 16
    lights: int = 1
    side: int = 32
    group: int = 64

    def build(self, seed: int = 1) -> dict[str, Any]:
        """Arguments of :func:`hit_rates`, all but the method."""
        across = round(self.rays**0.5)
        if across * across != self.rays or self.side % 8 or self.side < 8 or self.lights < 1:
            raise OptionError(f"setting: found {self}, expected square rays, side a multiple of 8, 1 light or more")
        paint = diffuse("paint", 0.5)
        floor = np.array([[-2.0, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]])
        vertices, faces, _, _ = torus_knot_mesh(
            radius=0.55, tube=0.14, segments=self.segments, sides=max(self.segments // 8, 3)
        )
        knot = Surface.from_mesh("knot", paint, vertices + [0.0, 0.0, 1.2], faces)
        scene = Scene("knot", (Surface.from_polygons("floor", paint, [floor]), knot), background=np.zeros(1), bands=1)
        # Points in tiles of 8 x 8, which share a shaft.
        tile, within = np.divmod(np.arange(self.side**2), 64)
        column = 8 * (tile % (self.side // 8)) + within % 8
        row = 8 * (tile // (self.side // 8)) + within // 8
        points = np.column_stack([(column + 0.5) / self.side, (row + 0.5) / self.side, np.zeros(self.side**2)])
        points[:, :2] = 4.0 * points[:, :2] - 2.0
        square = 0.5 * self.light_side * np.array([[-1.0, -1, 0], [-1, 1, 0], [1, 1, 0], [1, -1, 0]])
        angles = 2.0 * np.pi * np.arange(self.lights) / self.lights
        spread = 0.0 if self.lights == 1 else 1.0
        centres = np.column_stack([spread * np.cos(angles), spread * np.sin(angles), np.full(self.lights, 3.0)])
        rng = np.random.default_rng(seed)
        cells = np.stack(np.meshgrid(np.arange(across), np.arange(across), indexing="ij"), axis=-1).reshape(-1, 2)
        lights = [square + centre for centre in centres]
        samples = []
        for light in lights:
            place = (cells + rng.random((len(points), self.rays, 2))) / across
            samples.append(light[0] + place @ np.stack([light[1] - light[0], light[3] - light[0]]))
        return {
            "geometry": Geometry.from_scene(scene),
            "points": points,
            "normals": np.broadcast_to([0.0, 0.0, 1.0], points.shape),
            "lights": lights,
            "samples": samples,
            "resolution": self.resolution,
            "group": self.group,
            "skip_polygons": [0, -1],
        }


def sweep(base: Setting, parameter: str, values: Sequence[Any], *, seed: int = 1) -> list[dict[str, Any]]:
    """Vary one parameter of a setting and run all methods.

    Parameters
    ----------
    base : Setting
    parameter : str
        A field of :class:`Setting`.
    values : sequence
        Its values.
    seed : int
        Of the jittered samples.

    Returns
    -------
    list of dict
        A row a value and method: tests a ray, the share of polygons culled, checks and shaft tests
        a point and light, voxels a ray and the share of rays blocked.  ``avoided_%`` is what the
        plane-vertex check saved of the tests of the method without it: ``rayID`` or ``shaft``.
    """
    rows = []
    for value in values:
        arguments = replace(base, **{parameter: value}).build(seed)
        pairs = len(arguments["points"]) * len(arguments["lights"])
        before = 0.0
        for method in METHODS:
            found = hit_rates(method=method, **arguments)
            checked = method.endswith("plane-vertex")
            saved = 100.0 * (1.0 - found.tests_per_ray / before) if checked and before else None
            before = found.tests_per_ray
            done = found.counters
            rows.append(
                {
                    parameter: value,
                    "method": method,
                    "polygons": arguments["geometry"].piece_count,
                    "tests_per_ray": found.tests_per_ray,
                    "avoided_%": saved,
                    "culled_%": None if method == "rayID" else 100.0 * found.culled_share,
                    "checks_per_point": done["plane_vertex_checks"] / pairs,
                    "shaft_tests_per_point": (done["box_tests"] + done["shaft_tests"]) / pairs,
                    "voxels_per_ray": done["voxels_stepped"] / done["rays"],
                    "blocked_%": 100.0 * done["rays_hit"] / done["rays"],
                }
            )
    return rows
