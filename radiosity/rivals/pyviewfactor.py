"""pyViewFactor (M. Bogdan, E. Walther, M. Alecian and M. Chapon, IBPSA France 2022): form factors of meshes.

It integrates each pair of faces along their contours and drops pairs whose centroids are hidden from
each other, all or nothing, so partly hidden polygons need a mesh: ``samples`` elements a polygon, about.
"""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from radiosity.patches import build_mesh
from radiosity.rivals.base import Rival
from workbench.arrays import as_count
from workbench.errors import OptionError
from workbench.memory import require_memory

__all__ = ["PyViewFactor"]

FloatArray = NDArray[np.float64]


class PyViewFactor(Rival):
    """A scene for pyViewFactor."""

    name = "pyviewfactor"
    answers = frozenset({"view factors"})
    light_kinds = frozenset({"point", "spot", "directional", "linear"})

    def view_factors(self, *, samples: int, seed: int = 0) -> FloatArray:
        """Form factors (q, q) between polygons from a mesh of about ``samples`` elements each.

        Elements are summed to polygons by their areas.  ``seed`` changes nothing: no chance is involved.
        """
        import pyvista
        from pyviewfactor import compute_viewfactor_matrix

        as_count(samples, "samples")
        if any(material.two_sided for material in self.geometry.surface_material):
            raise OptionError("pyviewfactor: found a two-sided surface, expected one-sided ones")
        polygons = self.geometry.polygon_count
        wanted = None if samples == 1 else samples * polygons
        mesh = build_mesh(self.scene, self.geometry, elements=wanted, split=1, cluster=False)
        n = len(mesh.piece_element)
        require_memory(120.0 * n * n, f"pyviewfactor's matrix of {n} x {n} faces", "ask for fewer samples")
        sizes = np.diff(mesh.piece_start)
        cells = np.insert(np.arange(len(mesh.corners)), mesh.piece_start[:-1], sizes)
        faces = pyvista.PolyData(mesh.corners, faces=cells)
        corners, _ = self.geometry.triangles
        hiding = pyvista.PolyData(
            corners.reshape(-1, 3), faces=np.insert(np.arange(3 * len(corners)), 3 * np.arange(len(corners)), 3)
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # Its F[i, j] goes from face j to face i.
            factor = np.asarray(compute_viewfactor_matrix(faces, obstacles=hiding)).T
        owner = mesh.element_polygon[mesh.piece_element]
        spread = np.zeros((n, polygons))
        spread[np.arange(n), owner] = 1.0
        area = np.asarray(faces.compute_cell_sizes(length=False, volume=False)["Area"])
        return (spread.T * area) @ factor @ spread / self.geometry.polygon_area[:, None]
