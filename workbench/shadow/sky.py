"""The sky as a light: its radiance by direction, and the irradiance that openings let in.

From a point the dome is eight spherical triangles, four of sky and four of ground.  Each is cut by
the cones of the occluders between, as area lights are (:mod:`workbench.shadow.area`); over the
convex pieces that stay open a uniform radiance is integrated by Lambert's formula, any other by
Gauss's rule on ever smaller triangles.  Where occluders are too many to cut, callers use rays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.arrays import as_points, as_unit_vectors
from workbench.counters import Counters
from workbench.culling.tally import add_tally, new_tally
from workbench.errors import InputError
from workbench.geometry.polygons import plane_basis
from workbench.scene.model import SKY_KINDS, Scene, Sky
from workbench.shadow._sky import dome_integral, relative_radiances, sky_points
from workbench.shadow.occlusion import ROUNDING, Shader

__all__ = ["CIE_SKIES", "SkyLight"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CIE_SKIES: dict[str, tuple[float, float, float, float, float]] = {
    "cie-1": (4.0, -0.70, 0.0, -1.0, 0.00),
    "cie-2": (4.0, -0.70, 2.0, -1.5, 0.15),
    "cie-3": (1.1, -0.80, 0.0, -1.0, 0.00),
    "cie-4": (1.1, -0.80, 2.0, -1.5, 0.15),
    "cie-5": (0.0, -1.00, 0.0, -1.0, 0.00),
    "cie-6": (0.0, -1.00, 2.0, -1.5, 0.15),
    "cie-7": (0.0, -1.00, 5.0, -2.5, 0.30),
    "cie-8": (0.0, -1.00, 10.0, -3.0, 0.45),
    "cie-9": (-1.0, -0.55, 2.0, -1.5, 0.15),
    "cie-10": (-1.0, -0.55, 5.0, -2.5, 0.30),
    "cie-11": (-1.0, -0.55, 10.0, -3.0, 0.45),
    "cie-12": (-1.0, -0.32, 10.0, -3.0, 0.45),
    "cie-13": (-1.0, -0.32, 16.0, -3.0, 0.30),
    "cie-14": (-1.0, -0.15, 16.0, -3.0, 0.30),
    "cie-15": (-1.0, -0.15, 24.0, -2.8, 0.15),
}
"""Parameters a and b of the gradation, c, d and e of the indicatrix (CIE S 011/E:2003, Table 1)."""

_EXACT = 1e-10
"""Tolerance of the sky's own horizontal irradiance, in units of the zenith's radiance."""


@dataclass(frozen=True)
class SkyLight:
    """A sky ready to be asked.

    Parameters
    ----------
    law : (12,) float
        As :func:`workbench.shadow._sky.relative_radiance` takes it.
    zenith_radiance, ground_radiance : (bands,) float
        [W m-2 sr-1]
    """

    law: FloatArray
    zenith_radiance: FloatArray
    ground_radiance: FloatArray

    @classmethod
    def of_sky(cls, sky: Sky) -> SkyLight:
        """The light of a sky.

        Raises
        ------
        InputError
            If its kind is unknown, or not exactly one of its two strengths is given, or it lacks the
            sun that it follows.
        """
        if sky.kind not in SKY_KINDS:
            raise InputError(f"sky: found kind {sky.kind!r}, expected one of {', '.join(SKY_KINDS)}")
        if (sky.zenith_radiance is None) == (sky.horizontal_irradiance is None):
            raise InputError("sky: expected exactly one of zenith_radiance and horizontal_irradiance")
        law = np.zeros(12)
        law[:3] = as_unit_vectors(sky.up, "up")[0]
        law[3:6] = law[:3] if sky.sun_direction is None else as_unit_vectors(sky.sun_direction, "sun_direction")[0]
        law[11] = {"uniform": 2.0, "overcast": 1.0, "cie-5": 2.0}.get(sky.kind, 0.0)
        if sky.kind in CIE_SKIES:
            law[6:11] = CIE_SKIES[sky.kind]
            if law[8] != 0.0 and sky.sun_direction is None:
                raise InputError(f"sky: found no sun_direction, which the sky {sky.kind} follows")
        whole = _horizontal(law)
        if sky.zenith_radiance is not None:
            zenith = np.asarray(sky.zenith_radiance, dtype=np.float64)
        else:
            zenith = np.asarray(sky.horizontal_irradiance, dtype=np.float64) / whole
        return cls(law, zenith, np.asarray(sky.ground_reflectance) * zenith * (whole / math.pi))

    @classmethod
    def of_scene(cls, scene: Scene) -> SkyLight | None:
        """The sky of a scene, or its background as a uniform one all round; None where all is black."""
        if scene.closed:
            return None
        if scene.sky is not None:
            return cls.of_sky(scene.sky)
        if not scene.background.any():
            return None
        law = np.zeros(12)
        law[[2, 5, 11]] = 1.0, 1.0, 2.0
        return cls(law, scene.background, scene.background)

    @property
    def horizontal_irradiance(self) -> FloatArray:
        """On an unobstructed surface that faces up, (bands,). [W m-2]"""
        return self.zenith_radiance * _horizontal(self.law)

    def radiance(self, directions: ArrayLike) -> FloatArray:
        """Radiance (n, bands) in directions (n, 3), of the sky above the horizon, of the ground below. [W m-2 sr-1]"""
        above, share = self.relative(directions)
        return np.where(above[:, None], share[:, None] * self.zenith_radiance, self.ground_radiance)

    def relative(self, directions: ArrayLike) -> tuple[NDArray[np.bool_], FloatArray]:
        """Whether directions (n, 3) lead above the horizon, and the radiance there in units of the zenith's."""
        along = as_unit_vectors(directions, "directions")
        share = np.empty(len(along))
        relative_radiances(along, self.law, share)
        return along @ self.law[:3] > 0.0, share

    @cached_property
    def octants(self) -> FloatArray:
        """The dome as spherical triangles (8, 3, 3) of unit vectors, sky first."""
        up = self.law[:3]
        u, v = plane_basis(up)
        around = [u, v, -u, -v]
        # Counter-clockwise from outside, so that each edge's plane points into its triangle.
        sky = [np.stack([up, around[k], around[(k + 1) % 4]]) for k in range(4)]
        ground = [np.stack([-up, around[(k + 1) % 4], around[k]]) for k in range(4)]
        return np.stack(sky + ground)

    def shares(
        self,
        shader: Shader,
        points: ArrayLike,
        normals: ArrayLike,
        *,
        own_polygon: ArrayLike | None = None,
        error: float = 1e-4,
        counters: Counters | None = None,
    ) -> FloatArray:
        """How much of the sky and of the ground reaches points past all occluders, exactly.

        Parameters
        ----------
        shader : Shader
            Over the geometry of the occluders; a pane lets its mean transmittance pass.
        points, normals : (n, 3) float
        own_polygon : (n,) int or int, optional
            Polygon on which each point lies, which never shadows it; -1 for none.
        error : float
            Of the quadrature over the sky, as a share of the unobstructed horizontal irradiance.
        counters : Counters, optional

        Returns
        -------
        (n, 2) float
            The irradiance for a zenith radiance of 1, and for a ground of exitance 1 (a form
            factor).  NaN where the occluders are too many to be cut: there only rays can tell.
        """
        place, facing = as_points(points), as_unit_vectors(normals)
        own = np.full(len(place), -1, dtype=np.int64)
        if own_polygon is not None:
            own[:] = own_polygon
        geo = shader.geometry
        slack = max(geo.slack, ROUNDING * float(np.abs(place).max(initial=0.0)))
        through = np.ascontiguousarray(geo.polygon_transmittance[geo.piece_polygon])
        ground = bool(self.ground_radiance.any())
        out = np.zeros((len(place), 2))
        step = max(1, min(64, len(place) // 16))

        def work(first: int) -> NDArray[np.int64]:
            tally = new_tally()
            sky_points(
                place, facing, own, first, min(first + step, len(place)), self.law, ground, self.octants, geo.corners,
                geo.piece_start, geo.piece_polygon, geo.piece_normal, through, *shader.tree, slack,
                1e-2 * error * math.pi, out, tally,
            )  # fmt: skip
            return tally

        for tally in shader.spread(work, range(0, len(place), step)):
            if counters is not None:
                add_tally(counters, tally)
        return out

    def irradiance(self, shares: FloatArray) -> FloatArray:
        """Irradiance (n, bands) for what :meth:`shares` found. [W m-2]"""
        return shares[:, :1] * self.zenith_radiance + shares[:, 1:] * (math.pi * self.ground_radiance)


def _horizontal(law: FloatArray) -> float:
    """Horizontal irradiance of a sky of zenith radiance 1."""
    up = law[:3]
    u, v = plane_basis(up)
    cells, state = np.empty((64, 3, 3)), np.empty((64, 2))
    around = [u, v, -u, -v]
    return math.fsum(
        dome_integral(np.stack([up, around[k], around[(k + 1) % 4]]), 3, up[0], up[1], up[2], law, _EXACT, cells, state)
        for k in range(4)
    )
