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
from radiosity.solvers._solid_angle import PLACES, cell_counts, places_of, solid_angles
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
MORE_POINTS, MOST_POINTS = 16, 1024
"""Points an element that tell how uneven the light is; and most for the sky on elements where these points differ:"""
FEW_ELEMENTS, SKY_POINTS = 256, 4096
"""Elements of a mesh up to which these get more at first; and points in all of a later round, which go to the worst."""
UNEVEN, MEAN_SHARE = 0.07, 0.5
"""Share of the wanted error that the mean of an element may be off by, from which there are more points at first; and
the same of the root mean square over the elements, from which there are further ones."""
SPREAD_POWER = 0.75
"""Power of the number of points with which the error of an element's mean falls, from their standard deviation on: the
points are a lattice, and what they see has edges."""

ENDS = 4.0
"""Rays toward a lamp end so many times the tracer's offset before it."""

# Generalised golden ratio in two dimensions.
_G2 = 1.3247179572447460
_GAUSS = 0.5 / math.sqrt(3.0)


@njit(nogil=True, cache=True)
def _smooth_points(corners, piece_start, element_piece, chosen, out, fits):
    """Gauss's 2 x 2 points of elements that are one parallelogram, whose weights are equal; ``fits`` tells them."""
    for row in range(chosen.shape[0]):
        e = chosen[row]
        a = piece_start[element_piece[e]]
        fits[row] = False
        if element_piece[e + 1] != element_piece[e] + 1 or piece_start[element_piece[e] + 1] != a + 4:
            continue
        gap = size = 0.0
        for axis in range(3):
            gap += abs(corners[a, axis] + corners[a + 2, axis] - corners[a + 1, axis] - corners[a + 3, axis])
            size += abs(corners[a + 2, axis] - corners[a, axis])
        fits[row] = gap <= 1e-3 * size
        for k in range(4):
            u, v = 0.5 + (_GAUSS if k & 1 else -_GAUSS), 0.5 + (_GAUSS if k & 2 else -_GAUSS)
            for axis in range(3):
                out[row * 4 + k, axis] = (1.0 - v) * ((1.0 - u) * corners[a, axis] + u * corners[a + 1, axis]) + v * (
                    (1.0 - u) * corners[a + 3, axis] + u * corners[a + 2, axis]
                )


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
    light: Light, place: FloatArray | None, points: FloatArray, normals: FloatArray, tracer: EmbreeAccelerator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Irradiance per unit power at points from a light without surface, or per length from a ``place`` of a line.

    As if it shone evenly, with its fall-off, and with what hides it.
    """
    start = points + tracer.offset * normals
    far: float | FloatArray
    if light.kind == "directional":
        assert light.direction is not None
        toward = np.broadcast_to(-light.direction, points.shape)
        value = even = np.maximum(np.einsum("ij,ij->i", normals, toward), 0.0)
        far = np.inf
    else:
        assert place is not None
        toward = place - points
        distance = np.linalg.norm(toward, axis=1)
        safe = np.where(distance > 0, distance, 1.0)
        value = even = np.maximum(np.einsum("ij,ij->i", normals, toward), 0.0) / safe**3
        toward = place - start
        # A lamp may lie on a ceiling, which does not hide it.
        far = np.clip(1.0 - ENDS * tracer.offset / safe, 0.0, 1.0)
        if light.kind == "spot":
            assert light.direction is not None
            along = (points - place) @ light.direction / safe
            inside = along >= math.cos(math.radians(light.cone_deg))
            value = even * np.where(inside, np.maximum(along, 0.0) ** light.exponent, 0.0)
        elif light.kind == "linear" and light.lambertian:
            assert light.end is not None and light.position is not None
            axis = (light.end - light.position) / np.linalg.norm(light.end - light.position)
            value = even * np.sqrt(np.maximum(1.0 - (((points - place) @ axis) / safe) ** 2, 0.0))
    lit = np.flatnonzero(value > 0)
    seen = value.copy()
    seen[lit[tracer.occluded(start[lit], toward[lit], np.broadcast_to(far, len(points))[lit])]] = 0.0
    return even, value, seen


def _light_means(
    light: Light, mesh: PatchMesh, first: int, last: int, seed: int, tracer: EmbreeAccelerator
) -> FloatArray:
    """Mean irradiance (elements,) per unit power, from a light without surface.

    Solid angles say what an even light sends unhindered (:mod:`radiosity.solvers._solid_angle`).  Points at random
    places of their strata see how much of the light is hidden; its fall-off is smooth and integrated by Gauss's rule,
    on elements that are parallelograms and that no cone's edge crosses.
    """
    total = np.zeros(last - first)
    cells, places = cell_counts(light, mesh, first, last)
    for cell, count in {(int(a), int(b)) for a, b in zip(cells, places, strict=True)}:
        group = first + np.flatnonzero((cells == cell) & (places == count))
        step = max(1, BLOCK_RAYS // max(cell * cell, POINTS))
        for begin in range(0, len(group), step):
            chosen = group[begin : begin + step]
            total[chosen - first] = _means_of(light, mesh, chosen, cell, count, seed, tracer)
    return total


def _means_of(
    light: Light, mesh: PatchMesh, chosen: IntArray, cells: int, count: int, seed: int, tracer: EmbreeAccelerator
) -> FloatArray:
    """:func:`_light_means` of chosen elements, by ``cells`` a side (0: few points) and ``count`` places of a line."""
    samples = max(cells * cells, POINTS)
    points = points_of_elements(mesh, chosen, samples, seed)
    normals = np.repeat(mesh.element_normal[chosen], samples, axis=0)
    if light.kind == "directional":  # even over an element, but for what hides it
        return _from_light(light, None, points, normals, tracer)[2].reshape(-1, samples).mean(axis=1)
    smooth, fits = np.zeros((len(chosen) * POINTS, 3)), np.zeros(len(chosen), dtype=np.bool_)
    bundled = (light.kind == "spot" and light.exponent > 0) or light.lambertian
    if bundled and not cells:
        _smooth_points(mesh.corners, mesh.piece_start, mesh.element_piece, chosen, smooth, fits)
    total, whole = np.zeros(len(chosen)), np.empty(len(chosen))
    for place in places_of(light, count):
        solid_angles(mesh.corners, mesh.piece_start, mesh.element_piece, mesh.element_normal, chosen, place, whole)
        even, value, seen = (
            each.reshape(-1, samples).sum(axis=1) for each in _from_light(light, place, points, normals, tracer)
        )
        part = np.divide(seen, even, out=np.zeros_like(seen), where=even > 0)
        if fits.any():
            toward = _from_light(light, place, smooth, np.repeat(mesh.element_normal[chosen], POINTS, axis=0), tracer)
            flat, bundle = (each.reshape(-1, POINTS).sum(axis=1) for each in toward[:2])
            share = np.divide(seen, value, out=np.zeros_like(seen), where=value > 0)
            falls = np.divide(bundle, flat, out=np.zeros_like(flat), where=flat > 0)
            part = np.where(fits & (value > 0), falls * share, part)
        total += whole * part
    part_length = 1.0
    if light.end is not None and light.position is not None:
        part_length = float(np.linalg.norm(light.end - light.position)) / count
    return total * (part_length / mesh.element_area[chosen])


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
        an element differs by little of it, these are enough.  Large elements get more.
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
        rows, count = np.arange(mesh.element_count), POINTS
        found = _from_sky(mesh, rows, count, sky_rays, seed, sky, shader)
        mean, doubt = found.mean(axis=1), found.std(axis=1) / count**SPREAD_POWER
        level = mesh.element_area @ (out + mean) / mesh.element_area.sum()
        share = mesh.element_area / mesh.element_area.sum()
        while count < MOST_POINTS:
            off = np.max(doubt / np.where(level > 0.0, level, np.inf), axis=1)
            if count == POINTS and len(off) <= FEW_ELEMENTS:
                rows = np.flatnonzero(off > UNEVEN * error)
            elif share @ off**2 > (MEAN_SHARE * error) ** 2:
                worst = np.argsort(-share * off**2, kind="stable")[: SKY_POINTS // (4 * count)]
                rows = np.sort(worst[off[worst] > MEAN_SHARE * error])
            else:
                break
            count *= 4
            if len(rows):
                found = _from_sky(mesh, rows, count, sky_rays, seed, sky, shader)
                mean[rows], doubt[rows] = found.mean(axis=1), found.std(axis=1) / count**SPREAD_POWER
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
            places = [None] if light.kind == "directional" else list(places_of(light, PLACES))
            seen = [_from_light(light, place, points, normals, tracer)[2] for place in places]
            length = 1.0
            if light.end is not None and light.position is not None:
                length = float(np.linalg.norm(light.end - light.position))
            total += np.mean(seen, axis=0).reshape(-1, MORE_POINTS, 1) * (length * light.power)
        out[first:last] = total.std(axis=1)
    sky = SkyLight.of_scene(scene)
    if sky is not None:
        shader = shader if shader is not None else Shader(Geometry.from_scene(scene))
        found = _from_sky(mesh, np.arange(mesh.element_count), POINTS, sky_rays, seed, sky, shader)
        out = np.hypot(out, found.std(axis=1))
    return out
