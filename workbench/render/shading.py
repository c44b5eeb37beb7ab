"""Phong's illumination formula, exactly as the ray-casting assignment gives it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["phong", "turn_toward"]

FloatArray = NDArray[np.float64]


def turn_toward(normals: FloatArray, viewer: FloatArray) -> FloatArray:
    """``normals`` (n, 3), each reversed where it points away from ``viewer`` (n, 3)."""
    away = np.einsum("ij,ij->i", normals, viewer) < 0
    return np.where(away[:, None], -normals, normals)


def phong(
    points: FloatArray,
    normals: FloatArray,
    viewer: FloatArray,
    diffuse: FloatArray,
    specular: FloatArray,
    exponent: FloatArray,
    emission: FloatArray,
    light_positions: FloatArray,
    light_radiances: FloatArray,
    ambient: FloatArray,
) -> FloatArray:
    """Radiance (n, 3) that leaves each point toward the viewer.

    The formula of the assignment (CMU 15-463, P2, "Shading"; Foley et al. 16.14 and 16.20 with the
    halfway vector of page 731)::

        I = C_mat k_dr [I_a + sum_i I_i max(N.L_i, 0)] + sum_i I_i k_sr max(N.H_i, 0)^e

    with H_i the unit vector along L_i + V.  The highlight is white, light does not fall with
    distance, nothing casts a shadow.  ``emission`` is added as it is, an extension for scenes that
    radiosity shares.  A light at the very point, or one straight behind it so that H_i has no
    direction, has N.L_i or N.H_i zero.

    Parameters
    ----------
    points, normals, viewer : (n, 3) float
        Shaded points, unit normals and unit directions V to the viewer.
    diffuse : (n, 3) float
        C_mat k_dr.
    specular, exponent : (n,) float
        k_sr and e.
    emission : (n, 3) float
    light_positions, light_radiances : (l, 3) float
    ambient : (3,) float
    """
    received = np.broadcast_to(ambient, points.shape).copy()
    highlight = np.zeros_like(received)
    for position, radiance in zip(light_positions, light_radiances, strict=True):
        toward = _unit(position - points)
        halfway = _unit(toward + viewer)
        received += np.maximum(np.einsum("ij,ij->i", normals, toward), 0.0)[:, None] * radiance
        shine = np.maximum(np.einsum("ij,ij->i", normals, halfway), 0.0) ** exponent
        highlight += (specular * shine)[:, None] * radiance
    return diffuse * received + highlight + emission


def _unit(vectors: FloatArray) -> FloatArray:
    """Vectors (n, 3) made unit length; those of length 0 stay 0."""
    length = np.linalg.norm(vectors, axis=1)
    return vectors / np.where(length > 0, length, 1.0)[:, None]
