"""trimesh.ray (M. Dawson-Haggerty and others, trimesh.org): what a script with NumPy and Embree does.

Rays are made in NumPy, all in float64, and asked of trimesh's ray interface, which hands them to
Embree where embreex is installed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radiosity.rivals.base import Rival, checked_points
from workbench.arrays import as_count
from workbench.errors import OptionError
from workbench.geometry.polygons import plane_basis
from workbench.sampling.warp import square_to_cosine_hemisphere
from workbench.scene.model import Scene
from workbench.shadow.lights import lights_of_scene

__all__ = ["TrimeshRay"]

FloatArray = NDArray[np.float64]

BLOCK = 1 << 20
"""Rays asked at once."""
LIFT = 1e-6
"""Distance of a ray's start from its surface, as a share of the scene's size."""


class TrimeshRay(Rival):
    """A scene as one :class:`trimesh.Trimesh`; rays a point and light, or a polygon, are the samples."""

    name = "trimesh"
    answers = frozenset({"direct", "view factors"})
    light_kinds = frozenset({"point", "spot", "directional", "linear"})

    def __init__(self, scene: Scene) -> None:
        import trimesh

        super().__init__(scene)
        corners, self._piece = self.geometry.triangles
        mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
        self._rays = mesh.ray
        self._lights = lights_of_scene(scene, self.geometry)
        self._corners = corners

    def irradiance(
        self, points: ArrayLike, normals: ArrayLike, *, samples: int, seed: int = 0, direct_only: bool = False
    ) -> FloatArray:
        """Direct irradiance (n, bands) at points, ``samples`` rays to each light. [W m-2]"""
        points, normals = checked_points(points, normals, samples)
        if not direct_only:
            raise OptionError("trimesh: traces no reflected light; ask for direct light only")
        if self.scene.background.any():
            raise OptionError("trimesh: found a background, expected lights only")
        rng = np.random.default_rng(seed)
        found = np.zeros((len(points), self.scene.bands))
        step = max(1, BLOCK // samples)
        lift = LIFT * self.geometry.size
        for first in range(0, len(points), step):
            here, facing = points[first : first + step], normals[first : first + step]
            for light in self._lights:
                drawn = light.sample(here, facing, rng.random((len(here), samples, 2)))
                reach = 4.0 * self.geometry.size if np.isinf(drawn.far) else 1.0
                # The start is lifted, the end stays where it is.
                toward = drawn.directions * reach - lift * facing[:, None]
                start = np.broadcast_to((here + lift * facing)[:, None], toward.shape)
                passed = self._clear(start.reshape(-1, 3), toward.reshape(-1, 3))
                share = (drawn.weights * passed.reshape(drawn.weights.shape)).sum(axis=1)
                found[first : first + step] += share[:, None] * light.power
        return found

    def _clear(self, start: FloatArray, toward: FloatArray) -> NDArray[np.bool_]:
        """Whether nothing lies between the start and the end of each segment."""
        first = self._rays.intersects_first(start, toward)
        clear = first < 0
        rows = np.flatnonzero(~clear)
        # trimesh knows no far limit: where is the first triangle's plane?
        corner = self._corners[first[rows]]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.einsum("ij,ij->i", corner[:, 0] - start[rows], normal) / np.einsum(
                "ij,ij->i", toward[rows], normal
            )
        clear[rows] = ~(reach < 1.0 - 1e-6)
        return clear

    def view_factors(self, *, samples: int, seed: int = 0) -> FloatArray:
        """Form factors (q, q) by ``samples`` cosine-weighted rays from each polygon's lit side."""
        as_count(samples, "samples")
        if any(material.two_sided for material in self.geometry.surface_material):
            raise OptionError("trimesh: found a two-sided surface, expected one-sided ones")
        rng = np.random.default_rng(seed)
        geo = self.geometry
        polygon_of = geo.piece_polygon[self._piece]
        edges = self._corners[:, 1:] - self._corners[:, :1]
        area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        factor = np.zeros((geo.polygon_count, geo.polygon_count))
        for polygon in range(geo.polygon_count):
            mine = np.flatnonzero(polygon_of == polygon)
            for first in range(0, samples, BLOCK):
                count = min(BLOCK, samples - first)
                chosen = rng.choice(mine, count, p=area[mine] / area[mine].sum())
                a, b = np.sort(rng.random((2, count)), axis=0)
                weights = np.column_stack([a, b - a, 1.0 - b])
                normal = geo.polygon_normal[polygon]
                start = np.einsum("ij,ijk->ik", weights, self._corners[chosen]) + LIFT * geo.size * normal
                toward = square_to_cosine_hemisphere(rng.random((count, 2))) @ np.stack([*plane_basis(normal), normal])
                met = self._rays.intersects_first(start, toward)
                hit = polygon_of[met[met >= 0]]
                front = np.einsum("ij,ij->i", geo.polygon_normal[hit], toward[met >= 0]) < 0.0
                factor[polygon] += np.bincount(hit[front], minlength=geo.polygon_count) / samples
        return factor
