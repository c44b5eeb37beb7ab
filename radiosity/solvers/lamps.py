"""Light of emitting surfaces on the elements of a mesh, through the shadow module.

Lamps are far brighter than all else and often small: what they send is found more carefully than
what walls exchange, at points of each element, exactly where the shadow module can.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radiosity.patches import PatchMesh
from radiosity.solvers.incident import points_of_elements
from workbench.counters import Counters
from workbench.geometry.flat import Geometry
from workbench.scene.model import Scene
from workbench.shadow.lights import Sender, lights_of_scene
from workbench.shadow.occlusion import OcclusionState, Shader

__all__ = ["LampLight", "lamp_irradiance", "lamps_of_scene"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MOST_LAMPS = 64
"""Most emitting polygons that are asked one by one."""
POINTS, MORE_TIMES = 4, 4
"""Points of an element, and how many times more where they differ or where much is asked:"""
CAREFUL = 0.01
EDGE_POWER = 0.65
"""Along shadow edges the error falls with this power of the number of points (seen: 0.58 to 0.75)."""
SMOOTH = 0.1
"""Where the light is smooth the rule's error is about this times the cube of the deviation, relative to the mean."""


@dataclass(frozen=True)
class LampLight:
    """What lamps send to the elements of a mesh.

    Parameters
    ----------
    irradiance : (n, bands) float
        [W m-2]
    mean_square : (bands,) float
        Area-weighted mean of its squared error. [W2 m-4]
    elements : (k,) int
        Elements that are lamps: what they emit has been sent.
    """

    irradiance: FloatArray
    mean_square: FloatArray
    elements: IntArray


def lamps_of_scene(scene: Scene, geometry: Geometry) -> list[Sender] | None:
    """The emitting surfaces as lights, or ``None`` if they have too many polygons to be asked one by one."""
    polygons = sum(surface.face_count for surface in scene.surfaces if surface.material.emission.any())
    if polygons > MOST_LAMPS:
        return None
    return [light for light in lights_of_scene(scene, geometry) if len(light.polygons)]


def _even_points(mesh: PatchMesh, chosen: IntArray, count: int, seed: int) -> FloatArray:
    """Points (k * count, 3) of the chosen elements: Gauss's, two an axis and cell, on parallelograms."""
    points = points_of_elements(mesh, chosen, count, seed).reshape(len(chosen), count, 3)
    first, last = mesh.element_piece[chosen], mesh.element_piece[chosen + 1]
    start = mesh.piece_start[first]
    quad = np.flatnonzero((last == first + 1) & (mesh.piece_start[first + 1] - start == 4))
    ring = mesh.corners[start[quad, None] + np.arange(4)]
    skew = np.abs(ring[:, 0] - ring[:, 1] + ring[:, 2] - ring[:, 3]).max(axis=1)
    even = skew < 1e-6 * mesh.element_size[chosen[quad]]
    quad, ring = quad[even], ring[even]
    cells = round(math.sqrt(count)) // 2
    place = ((np.arange(cells) + 0.5)[:, None] + np.array([-0.5, 0.5]) / math.sqrt(3.0)).ravel() / cells
    u, v = (each.ravel()[:, None] for each in np.meshgrid(place, place))
    points[quad] = (
        ring[:, None, 0] + u * (ring[:, None, 1] - ring[:, None, 0]) + v * (ring[:, None, 3] - ring[:, None, 0])
    )
    return points.reshape(-1, 3)


def _shares(
    mesh: PatchMesh, shader: Shader, lamps: list[Sender], chosen: IntArray, count: int, error: float, seed: int,
    counters: Counters,
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:  # fmt: skip
    """Mean form factor from the chosen elements to each lamp, its deviation, and whether shadow edges cross it."""
    found = shader.estimate(
        _even_points(mesh, chosen, count, seed), np.repeat(mesh.element_normal[chosen], count, axis=0), lamps,
        "auto", error=error, seed=seed, own_polygon=np.repeat(mesh.element_polygon[chosen], count),
    )  # fmt: skip
    counters.merge(found.counters)
    share = found.visible_share.reshape(len(chosen), count, len(lamps))
    state = found.state.reshape(share.shape)
    edge = (state != state[:, :1]).any(axis=1) | (state == OcclusionState.COMPLEX_SHADOW).any(axis=1)
    return share.mean(axis=1), share.std(axis=1, ddof=1), edge


def lamp_irradiance(
    mesh: PatchMesh,
    shader: Shader,
    lamps: list[Sender],
    counters: Counters,
    *,
    error: float = 0.01,
    visible: FloatArray | None = None,
    seed: int = 0,
) -> LampLight:
    """Mean irradiance of every element from lamps.

    Parameters
    ----------
    mesh : PatchMesh
        Of single polygons: no clusters of facets.
    shader : Shader
        Over the scene's geometry.
    lamps : list of lights
        From :func:`lamps_of_scene`.
    counters : Counters
        Gets the counts of the shadow module.
    error : float
        Wanted error of the light at points, see :func:`workbench.shadow.occlusion.estimate`.
    visible : (n,) float, optional
        In an enclosure the share of each element that sees anything: all that a lamp sends from there must
        arrive, and its light is scaled so.
    seed : int
    """
    n, everything = mesh.element_count, np.arange(mesh.element_count)
    count = POINTS if error > CAREFUL else MORE_TIMES * POINTS
    mean, deviation, edge = _shares(mesh, shader, lamps, everything, count, error, seed, counters)
    relative = np.divide(deviation, mean, out=np.zeros_like(mean), where=mean > 0)
    doubt = np.where(edge, deviation / count**EDGE_POWER, SMOOTH * deviation * relative**2)
    uneven = np.flatnonzero(edge.any(axis=1))
    if len(uneven):
        count *= MORE_TIMES
        mean[uneven], deviation, edge = _shares(mesh, shader, lamps, uneven, count, error, seed + 1, counters)
        doubt[uneven] = np.where(edge, deviation / count**EDGE_POWER, doubt[uneven])
    area, emits = mesh.element_area, mesh.emission.any(axis=1)
    irradiance, square = np.zeros((n, mesh.bands)), np.zeros(mesh.bands)
    for k, lamp in enumerate(lamps):
        own = emits & np.isin(mesh.element_polygon, lamp.polygons)
        scale = 1.0
        if visible is not None:
            sent, arrives = float(area[own] @ visible[own]), float(area @ mean[:, k])
            scale = sent / arrives if 0.5 * sent < arrives else 1.0
        power = np.broadcast_to(np.asarray(lamp.power, dtype=np.float64), (mesh.bands,))
        irradiance += scale * mean[:, k, None] * power
        square += (area @ doubt[:, k] ** 2 / area.sum()) * power**2
    return LampLight(irradiance, square, np.flatnonzero(emits))
