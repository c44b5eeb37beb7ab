"""How fine a mesh has to be: numbers of elements that are told before the mesh is made.

What a mesh leaves of the light at a point is a sum over its elements, whose errors are independent.  That
of one element goes with its area, with the light that it reflects and with its width, the root of its
area again.  So the square of the error goes with the sum over the elements of area**3 * reflected**2, and
small polygons that are never divided hardly matter.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from radiosity.patches import Extents, edge_scales
from workbench.geometry.flat import Geometry
from workbench.scene.model import Scene

__all__ = ["Divisions", "like_elements"]

FloatArray = NDArray[np.float64]

NEAR = 0.9
"""Share of the elements asked for from which a mesh is near enough."""
FINER = 1.1
"""Ratio of the largest edges of elements that are tried one after the other."""


def like_elements(area: FloatArray, reflected: FloatArray) -> float:
    """How many elements alike in size and light leave as large an error as these.

    Parameters
    ----------
    area : (n,) float
        Of the elements. [scene lengths squared]
    reflected : (n,) float
        Light that they reflect, in any unit.

    Returns
    -------
    float
        At most about n; 0 where nothing is reflected.
    """
    left = float(area**3 @ reflected**2)
    return math.sqrt(float(area.sum()) ** 2 * float(area @ reflected**2) / left) if left > 0 else 0.0


class Divisions:
    """Into how many elements and patches the polygons of a scene fall, without a mesh being made.

    Parameters
    ----------
    scene, geometry : Scene, Geometry
        A scene and its flattened form.

    Attributes
    ----------
    reflectance : float
        Mean of the scene's surfaces.
    """

    def __init__(self, scene: Scene, geometry: Geometry) -> None:
        surfaces = [surface for surface in scene.surfaces if surface.face_count]
        faces = [surface.face_count for surface in surfaces]
        each = [Extents.of_surface(surface) for surface in surfaces]
        self._extents = Extents(*(np.concatenate([getattr(e, n) for e in each]) for n in ("along", "across", "share")))
        self._scales = edge_scales(geometry)
        self._sides = np.repeat([2 if surface.material.two_sided else 1 for surface in surfaces], faces)
        self._reflectance = np.repeat([float(surface.material.reflectance.mean()) for surface in surfaces], faces)
        self._area = geometry.polygon_area
        self._coarsest = 2.0 * geometry.size
        weight = self._sides * self._area
        self.reflectance = float(weight @ self._reflectance / weight.sum())

    def _counts(self, edge: float) -> NDArray[np.int64]:
        return self._extents.counts(edge * self._scales, 2)

    def _like(self, count: FloatArray) -> float:
        """As :func:`like_elements`, by reflectance, of polygons that fall into ``count`` (q,) elements each."""
        sides, rho = self._sides, self._reflectance**2
        left = float((sides * self._area**3 * rho) @ (1.0 / count**2))
        return math.sqrt((sides @ self._area) ** 2 * ((sides * self._area) @ rho) / left) if left > 0 else math.inf

    def least(self, elements: int, ratio: float) -> int:
        """Number of elements of a mesh near ``elements`` that resolves the light better than its patches of 2 x 2.

        Parameters
        ----------
        elements : int
            Wanted number.
        ratio : float
            Least ratio of :func:`like_elements` of the mesh to that of its patches.  A mesh that is asked for more
            than it would take has as many elements as that takes.
        """
        edge, before = self._coarsest, 0
        while True:
            count = self._counts(edge)
            total = int(self._sides @ count)
            patches = np.where(count > 1, np.maximum(count / 4, 1.0), 1.0)
            if self._like(count.astype(np.float64)) >= ratio * self._like(patches) or not self._reflectance.any():
                if total >= elements:
                    # Of polygons alike in size the number jumps.
                    return before if before >= NEAR * elements else total
                before = total
            edge /= FINER
