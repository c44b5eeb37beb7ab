"""Light that arrives from outside the mesh: lights without surface, and the sky or background.

Both reach the elements before the first shot: lights through Embree, the sky cut exactly by what
hides it where that can be.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from radiosity.form_factors._sampling import place_on_pieces, stream
from radiosity.patches import PatchMesh
from workbench.accel.embree import BLOCK_RAYS, EmbreeAccelerator
from workbench.geometry.flat import Geometry
from workbench.scene.model import Light, Scene
from workbench.shadow.occlusion import Shader
from workbench.shadow.sky import SkyLight

__all__ = ["cosine_directions", "incident_irradiance", "incident_spread", "points_of_elements"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

POINTS = 4
"""Points an element at which lights without surface and the sky are evaluated."""
FEW_ELEMENTS, MORE_POINTS = 256, 16
"""Points an element for the sky in meshes of few elements, which are large, where these points differ:"""
UNEVEN = 0.2
"""Deviation of the light at the points of an element from which there are more, over the wanted error."""

# Generalised golden ratio in two dimensions.
_G2 = 1.3247179572447460
_GAUSS = 0.5 / math.sqrt(3.0)


@njit(nogil=True, cache=True)
def _smooth_points(corners, piece_start, element_piece, first, last, out, fits):
    """Gauss's 2 x 2 points of elements that are one parallelogram, whose weights are equal; ``fits`` tells them."""
    for e in range(first, last):
        a = piece_start[element_piece[e]]
        fits[e - first] = False
        if element_piece[e + 1] != element_piece[e] + 1 or piece_start[element_piece[e] + 1] != a + 4:
            continue
        gap = size = 0.0
        for axis in range(3):
            gap += abs(corners[a, axis] + corners[a + 2, axis] - corners[a + 1, axis] - corners[a + 3, axis])
            size += abs(corners[a + 2, axis] - corners[a, axis])
        fits[e - first] = gap <= 1e-3 * size
        for k in range(4):
            u, v = 0.5 + (_GAUSS if k & 1 else -_GAUSS), 0.5 + (_GAUSS if k & 2 else -_GAUSS)
            for axis in range(3):
                out[(e - first) * 4 + k, axis] = (1.0 - v) * (
                    (1.0 - u) * corners[a, axis] + u * corners[a + 1, axis]
                ) + v * ((1.0 - u) * corners[a + 3, axis] + u * corners[a + 2, axis])


@njit(nogil=True, cache=True)
def _chosen_points(corners, piece_start, element_piece, area, chosen, count, seed, out):
    for i in range(chosen.shape[0]):
        e = chosen[i]
        h = stream(e, 0, seed)
        s1 = np.float64(h & np.uint64(0xFFFFFF)) / 16777216.0
        s2 = np.float64((h >> np.uint64(24)) & np.uint64(0xFFFFFF)) / 16777216.0
        for k in range(count):
            place_on_pieces(
                corners, piece_start, element_piece[e], element_piece[e + 1], area[e],
                (s1 + (k + 0.5) / _G2) % 1.0, (s2 + (k + 0.5) / _G2**2) % 1.0, out[i * count + k],
            )  # fmt: skip


def points_of_elements(mesh: PatchMesh, chosen: IntArray, count: int, seed: int) -> FloatArray:
    """Points (k * count, 3), ``count`` on each chosen element, uniform by area."""
    points = np.empty((len(chosen), count, 3))
    _chosen_points(
        mesh.corners, mesh.piece_start, mesh.element_piece, mesh.element_area, chosen, count, seed,
        points.reshape(-1, 3),
    )  # fmt: skip
    return points.reshape(-1, 3)


def _points(mesh: PatchMesh, chosen: IntArray, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
    return points_of_elements(mesh, chosen, count, seed), np.repeat(mesh.element_normal[chosen], count, axis=0)


def _from_light(
    light: Light, points: FloatArray, normals: FloatArray, tracer: EmbreeAccelerator, k: int
) -> tuple[FloatArray, FloatArray]:
    """Irradiance per unit power at points, from a light without surface or one sample of it: unoccluded, and seen."""
    start = points + tracer.offset * normals
    if light.kind == "directional":
        assert light.direction is not None
        toward = np.broadcast_to(-light.direction, points.shape)
        cosine = np.maximum(np.einsum("ij,ij->i", normals, toward), 0.0)
        lit = np.flatnonzero(cosine > 0)
        seen = cosine.copy()
        seen[lit[tracer.occluded(start[lit], toward[lit], np.inf)]] = 0.0
        return cosine, seen
    assert light.position is not None
    place = light.position
    length = 1.0
    if light.kind == "linear":
        assert light.end is not None
        place = light.position + (k + 0.5) / POINTS * (light.end - light.position)
        length = float(np.linalg.norm(light.end - light.position))
    toward = place - points
    distance = np.linalg.norm(toward, axis=1)
    safe = np.where(distance > 0, distance, 1.0)
    value = np.maximum(np.einsum("ij,ij->i", normals, toward), 0.0) / safe**3 * length
    if light.kind == "spot":
        assert light.direction is not None
        along = -(toward @ light.direction) / safe
        inside = along >= math.cos(math.radians(light.cone_deg))
        value *= np.where(inside, np.maximum(along, 0.0) ** light.exponent, 0.0)
    elif light.kind == "linear" and light.lambertian:
        assert light.end is not None
        axis = (light.end - light.position) / length
        value *= np.sqrt(np.maximum(1.0 - ((toward @ axis) / safe) ** 2, 0.0))
    lit = np.flatnonzero(value > 0)
    seen = value.copy()
    seen[lit[tracer.occluded(start[lit], place - start[lit], 1.0)]] = 0.0
    return value, seen


def _light_means(
    light: Light, mesh: PatchMesh, first: int, last: int, seed: int, tracer: EmbreeAccelerator
) -> FloatArray:
    """Mean irradiance (elements,) per unit power, from a light without surface.

    Points at random places of their strata see how much of the light is hidden; what is not hidden
    is smooth and integrated by Gauss's rule, on elements that are parallelograms.
    """
    points, normals = _points(mesh, np.arange(first, last), POINTS, seed)
    smooth, fits = np.zeros_like(points), np.zeros(last - first, dtype=np.bool_)
    _smooth_points(mesh.corners, mesh.piece_start, mesh.element_piece, first, last, smooth, fits)
    total = np.zeros(last - first)
    samples = POINTS if light.kind == "linear" else 1
    for k in range(samples):
        whole, seen = (v.reshape(-1, POINTS).mean(axis=1) for v in _from_light(light, points, normals, tracer, k))
        better = _from_light(light, smooth, normals, tracer, k)[0].reshape(-1, POINTS).mean(axis=1)
        share = np.divide(seen, whole, out=np.zeros_like(seen), where=whole > 0)
        total += np.where(fits & (whole > 0), better * share, seen) / samples
    return total


def _from_sky(
    mesh: PatchMesh, chosen: IntArray, count: int, rays: int, seed: int, sky: SkyLight, shader: Shader
) -> FloatArray:
    """Irradiance (k, count, bands) from the sky at points of the chosen elements: exact, or by rays."""
    out = np.empty((len(chosen), count, mesh.bands))
    step = max(1, BLOCK_RAYS // (4 * count))
    for first in range(0, len(chosen), step):
        block = chosen[first : first + step]
        points, normals = _points(mesh, block, count, seed)
        own = np.repeat(mesh.element_polygon[block], count)
        shares = sky.shares(shader, points, normals, own_polygon=own, error=1e-3)
        crowded = np.flatnonzero(np.isnan(shares[:, 0]))
        if len(crowded):
            shares[crowded] = _sky_by_rays(points[crowded], normals[crowded], rays, [seed, int(block[0])], sky, shader)
        out[first : first + step] = sky.irradiance(shares).reshape(-1, count, mesh.bands)
    return out


def cosine_directions(normals: FloatArray, count: int, seed: list[int]) -> FloatArray:
    """Cosine-distributed unit directions (n * count, 3) about normals (n, 3), ``count`` each."""
    rng = np.random.default_rng(seed)
    shift = np.repeat(rng.random((len(normals), 2)), count, axis=0)
    k = np.tile(np.arange(count), len(normals))
    u = ((k + 0.5) / count + shift[:, 0]) % 1.0
    phi = 2.0 * math.pi * ((k / 1.6180339887498949 + shift[:, 1]) % 1.0)
    normals = np.repeat(normals, count, axis=0)
    # Malley's method: cosine-weighted directions are a disk lifted to the hemisphere.
    radius, height = np.sqrt(u), np.sqrt(1.0 - u)
    helper = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    a = np.cross(helper, normals)
    a /= np.linalg.norm(a, axis=1)[:, None]
    b = np.cross(normals, a)
    return a * (radius * np.cos(phi))[:, None] + b * (radius * np.sin(phi))[:, None] + normals * height[:, None]


def _sky_by_rays(
    points: FloatArray, normals: FloatArray, count: int, seed: list[int], sky: SkyLight, shader: Shader
) -> FloatArray:
    """What :meth:`SkyLight.shares` gives, from ``count`` cosine-distributed rays a point."""
    along = cosine_directions(normals, count, seed)
    points, normals = np.repeat(points, count, axis=0), np.repeat(normals, count, axis=0)
    free = ~shader.tracer.occluded(points + shader.tracer.offset * normals, along, np.inf)
    above, radiance = sky.relative(along)
    return np.stack(
        [math.pi * (free * radiance).reshape(-1, count).mean(axis=1), (free & ~above).reshape(-1, count).mean(axis=1)],
        axis=1,
    )


def incident_irradiance(
    scene: Scene,
    mesh: PatchMesh,
    tracer: EmbreeAccelerator,
    *,
    error: float = 0.0,
    sky_rays: int = 128,
    seed: int = 0,
    shader: Shader | None = None,
) -> FloatArray:
    """Irradiance of every element from the lights without surface and from the sky or background.

    Parameters
    ----------
    scene, mesh : Scene, PatchMesh
    tracer : EmbreeAccelerator
        Over the scene's geometry.
    error : float
        Wanted error of the sky's light, relative to the mean of all that arrives: where the light at a few points of
        an element differs by little of it, these are enough.
    sky_rays : int
        Cosine-distributed rays a point of an element toward the sky, where its occluders are too many
        to be cut.
    seed : int
    shader : Shader, optional
        Over the scene's geometry, for who asks more than once.

    Returns
    -------
    (n, bands) float
        Irradiance. [W m-2]
    """
    out = np.zeros((mesh.element_count, mesh.bands))
    sky = SkyLight.of_scene(scene)
    if not scene.lights and sky is None:
        return out
    step = max(1, BLOCK_RAYS // POINTS)
    for first in range(0, mesh.element_count, step):
        last = min(first + step, mesh.element_count)
        for light in scene.lights:
            out[first:last] += _light_means(light, mesh, first, last, seed, tracer)[:, None] * light.power
    if sky is not None:
        shader = shader if shader is not None else Shader(Geometry.from_scene(scene))
        everything = np.arange(mesh.element_count)
        found = _from_sky(mesh, everything, POINTS, sky_rays, seed, sky, shader)
        mean = found.mean(axis=1)
        if mesh.element_count <= FEW_ELEMENTS:
            level = mesh.element_area @ (out + mean) / mesh.element_area.sum()
            uneven = np.flatnonzero((found.std(axis=1) > UNEVEN * error * level).any(axis=1))
            mean[uneven] = _from_sky(mesh, uneven, MORE_POINTS, sky_rays, seed, sky, shader).mean(axis=1)
        out += mean
    return out


def incident_spread(
    scene: Scene,
    mesh: PatchMesh,
    tracer: EmbreeAccelerator,
    *,
    sky_rays: int = 128,
    seed: int = 0,
    shader: Shader | None = None,
) -> FloatArray:
    """How much what :func:`incident_irradiance` finds varies over each element.

    Parameters
    ----------
    scene, mesh, tracer, sky_rays, seed, shader
        As there.

    Returns
    -------
    (n, bands) float
        Standard deviation of the irradiance over the element. [W m-2]
    """
    out = np.zeros((mesh.element_count, mesh.bands))
    step = max(1, BLOCK_RAYS // MORE_POINTS)
    for first in range(0, mesh.element_count, step):
        last = min(first + step, mesh.element_count)
        points, normals = _points(mesh, np.arange(first, last), MORE_POINTS, seed)
        total = np.zeros((last - first, MORE_POINTS, mesh.bands))
        for light in scene.lights:
            samples = POINTS if light.kind == "linear" else 1
            seen = sum(_from_light(light, points, normals, tracer, k)[1] for k in range(samples)) / samples
            total += np.asarray(seen).reshape(-1, MORE_POINTS, 1) * light.power
        out[first:last] = total.std(axis=1)
    sky = SkyLight.of_scene(scene)
    if sky is not None:
        shader = shader if shader is not None else Shader(Geometry.from_scene(scene))
        found = _from_sky(mesh, np.arange(mesh.element_count), POINTS, sky_rays, seed, sky, shader)
        out = np.hypot(out, found.std(axis=1))
    return out
