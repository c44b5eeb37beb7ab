"""Surfaces and scenes built in code: what the TOML reader's shapes and the studies are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.arrays import as_bands
from workbench.errors import InputError
from workbench.geometry.polygons import check_polygon, convex_pieces, plane_basis, vector_area
from workbench.geometry.tessellation import cone_mesh, sphere_mesh
from workbench.scene.model import Material, Scene, Sphere, Surface

__all__ = [
    "BOX_QUADS",
    "BOX_SIDES",
    "box_surface",
    "closed_scene_gaps",
    "cone_surface",
    "diffuse",
    "polygon_fault",
    "quad_light_over_floor",
    "rings_cross",
    "sphere_surface",
    "torus_knot_mesh",
    "transformed",
    "unit_cube",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

BOX_SIDES = ("-x", "+x", "-y", "+y", "-z", "+z")
"""Names of a box's six sides, by the axis and the end at which they lie."""

# Corner i of a box has bit 0 for x, bit 1 for y, bit 2 for z; each side runs counter-clockwise
# seen from outside, in the order of BOX_SIDES.
BOX_QUADS = np.array([[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]])


def diffuse(name: str, reflectance: ArrayLike, emission: ArrayLike = 0.0, *, bands: int = 1) -> Material:
    """A one-sided diffuse material; scalars are spread over the bands."""
    zero = np.zeros(bands)
    return Material(
        name=name,
        reflectance=as_bands(reflectance, bands, "reflectance"),
        emission=as_bands(emission, bands, "emission"),
        specular=zero,
        exponent=np.inf,
        transmittance=zero,
    )


def box_surface(
    name: str, material: Material, low: ArrayLike, high: ArrayLike, *, inward: bool = False, omit: Sequence[str] = ()
) -> Surface:
    """An axis-aligned box of up to six quads.

    Parameters
    ----------
    name, material
        Of the surface.
    low, high : (3,) float
        Opposite corners. [scene lengths]
    inward : bool
        Whether the fronts look into the box (a room) or out of it (a solid).
    omit : sequence of str
        Sides to leave out, of :data:`BOX_SIDES`: the bottom of what stands on a floor is ``-z``.
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if not (low < high).all():
        raise InputError(f"box: found min {low.tolist()} and max {high.tolist()}, expected min < max in each axis")
    unknown = sorted(set(omit) - set(BOX_SIDES))
    if unknown or len(set(omit)) == 6:
        raise InputError(f"box: found omit {list(omit)}, expected some of {', '.join(BOX_SIDES)}, not all")
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    quads = BOX_QUADS[[side not in omit for side in BOX_SIDES]]
    return Surface.from_mesh(name, material, np.where(bits, high, low), quads[:, ::-1] if inward else quads)


def sphere_surface(
    name: str, material: Material, center: ArrayLike, radius: float, *, facet_error: float = 0.02, inward: bool = False
) -> Surface:
    """A sphere as triangles, with the exact sphere kept beside them.

    Parameters
    ----------
    name, material
        Of the surface.
    center : (3,) float
    radius : float
        [scene lengths]
    facet_error : float
        Largest distance between sphere and facets, as a share of the radius.
    inward : bool
        Whether the front is the inside.
    """
    vertices, faces, normals, distance = sphere_mesh(center, radius, facet_error)
    return Surface.from_mesh(
        name,
        material,
        vertices,
        faces[:, ::-1] if inward else faces,
        vertex_normals=-normals if inward else normals,
        sphere=Sphere(np.asarray(center, dtype=np.float64), float(radius)),
        facet_error=distance,
    )


def cone_surface(
    name: str,
    material: Material,
    base: ArrayLike,
    base_radius: float,
    apex: ArrayLike,
    apex_radius: float,
    *,
    facet_error: float = 0.02,
    inward: bool = False,
) -> Surface:
    """The side of a cone, a cut cone or a cylinder as facets, see :func:`~workbench.geometry.tessellation.cone_mesh`.

    Parameters
    ----------
    name, material
        Of the surface.
    base, apex : (3,) float
        Centres of the end circles.
    base_radius, apex_radius : float
        [scene lengths]
    facet_error : float
        Largest distance between surface and facets, as a share of the larger radius.
    inward : bool
        Whether the front is the inside.
    """
    vertices, faces, normals, distance = cone_mesh(base, base_radius, apex, apex_radius, facet_error)
    return Surface.from_mesh(
        name,
        material,
        vertices,
        faces[:, ::-1] if inward else faces,
        vertex_normals=-normals if inward else normals,
        facet_error=distance,
    )


def transformed(surface: Surface, matrix: ArrayLike) -> Surface:
    """The surface under an affine map; fronts stay fronts, also under a mirror image.

    The exact sphere is kept under rotation, translation and uniform scale, and dropped otherwise;
    ``facet_error`` grows by the largest stretch.

    Parameters
    ----------
    surface : Surface
    matrix : (4, 4) float
        Acts on columns ``(x, y, z, 1)``.

    Raises
    ------
    InputError
        If the matrix is singular.
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    linear, shift = matrix[:3, :3], matrix[:3, 3]
    stretch = np.linalg.svd(linear, compute_uv=False)
    if not (np.isfinite(stretch).all() and stretch[-1] > 1e-12 * stretch[0]):
        raise InputError("transform: found a map that flattens the surface, expected scales other than 0")
    ring_vertices = surface.ring_vertices
    if np.linalg.det(linear) < 0:
        # Reverse each ring in place: position k of a ring goes to its mirror position.
        starts, ends = surface.ring_offsets[:-1], surface.ring_offsets[1:]
        mirror = np.repeat(starts + ends - 1, ends - starts) - np.arange(len(ring_vertices))
        ring_vertices = ring_vertices[mirror]
    normals = surface.vertex_normals
    if normals is not None:
        normals = normals @ np.linalg.inv(linear)
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    sphere = surface.sphere
    if sphere is not None:
        uniform = stretch[0] - stretch[-1] <= 1e-9 * stretch[0]
        sphere = Sphere(linear @ sphere.center + shift, sphere.radius * float(stretch[0])) if uniform else None
    return replace(
        surface,
        vertices=np.ascontiguousarray(surface.vertices @ linear.T + shift),
        ring_vertices=ring_vertices,
        vertex_normals=normals,
        sphere=sphere,
        facet_error=surface.facet_error * float(stretch[0]),
    )


def rings_cross(rings: Sequence[FloatArray], normal: FloatArray) -> bool:
    """Whether two edges of a polygon's rings cross, seen along the unit ``normal``.

    Edges that only touch do not cross: a hole may be cut by a seam that the ring walks twice.
    """
    u, v = plane_basis(normal)
    start = np.concatenate([ring - rings[0][0] for ring in rings]) @ np.column_stack([u, v])
    end = np.concatenate([np.roll(ring, -1, axis=0) - rings[0][0] for ring in rings]) @ np.column_stack([u, v])

    def side(a: FloatArray, b: FloatArray, point: FloatArray) -> FloatArray:
        along, to = b - a, point - a
        turn = along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0]
        # Within rounding a point lies on the line.
        scale = np.hypot(along[..., 0], along[..., 1]) * np.hypot(to[..., 0], to[..., 1])
        return np.where(np.abs(turn) <= 1e-9 * scale, 0.0, np.sign(turn))

    for a, b in zip(start, end, strict=True):
        if ((side(a, b, start) * side(a, b, end) < 0) & (side(start, end, a) * side(start, end, b) < 0)).any():
            return True
    return False


def polygon_fault(rings: Sequence[FloatArray]) -> str | None:
    """What is wrong with a polygon (outer ring, holes...), in a few words, or ``None``.

    To the tests of :func:`~workbench.geometry.polygons.check_polygon` it adds those that need
    more time: edges that cross, and holes that do not lie inside.
    """
    fault = check_polygon(rings)
    if fault is None:
        vector = vector_area(rings)
        crossing = rings_cross(rings, vector / np.linalg.norm(vector))
        try:
            convex_pieces(rings)
        except InputError:
            crossing = True
        if crossing:
            fault = "a polygon whose rings cross themselves or each other"
    return fault


def torus_knot_mesh(
    p: int = 2, q: int = 3, *, radius: float = 1.0, tube: float = 0.2, segments: int = 480, sides: int = 24
) -> tuple[FloatArray, IntArray, FloatArray, float]:
    """A tube about the (p, q) torus knot: closed, its front outside, about the z axis.

    The centre line is ``((radius + radius/2 cos q t) cos p t, (radius + radius/2 cos q t) sin p t,
    radius/2 sin q t)`` for t in 0..2 pi; the tube's circles stand in its normal planes.

    Parameters
    ----------
    p, q : int
        Turns about the axis and about the tube of the torus; without a common factor.
    radius, tube : float
        Of the torus that carries the knot, and of the tube. [scene lengths]
    segments, sides : int
        Steps along the knot and around the tube; there are ``2 segments sides`` triangles.

    Returns
    -------
    vertices : (segments * sides, 3) float
    faces : (2 * segments * sides, 3) int
    normals : (segments * sides, 3) float
        Outward unit normals of the smooth tube.
    facet_error : float
        Largest distance measured between the middle of a facet's edge or face and the tube.
        [scene lengths]
    """
    if min(p, q) < 1 or np.gcd(p, q) != 1:
        raise InputError(f"torus_knot: found p = {p}, q = {q}; expected positive numbers without a common factor")
    if segments < 3 or sides < 3 or not (radius > 0 and tube > 0):
        raise InputError("torus_knot: expected 3 or more segments and sides, a radius > 0 and a tube > 0")

    def frame(t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        reach = radius * (1 + 0.5 * np.cos(q * t))
        swell = -0.5 * radius * q * np.sin(q * t)
        cos, sin = np.cos(p * t), np.sin(p * t)
        line = np.stack([reach * cos, reach * sin, 0.5 * radius * np.sin(q * t)], axis=-1)
        tangent = np.stack(
            [swell * cos - reach * p * sin, swell * sin + reach * p * cos, 0.5 * radius * q * np.cos(q * t)], axis=-1
        )
        tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
        # The normal of the carrying torus is never along the knot, so the frame never turns over.
        away = np.stack([np.cos(q * t) * cos, np.cos(q * t) * sin, np.sin(q * t)], axis=-1)
        across = np.cross(away, tangent)
        return line, away, across / np.linalg.norm(across, axis=-1, keepdims=True)

    def surface(t: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        line, away, across = frame(t)
        normal = np.cos(s)[..., None] * away + np.sin(s)[..., None] * across
        return line + tube * normal, normal

    step, turn = 2 * np.pi / segments, 2 * np.pi / sides
    t, s = np.meshgrid(step * np.arange(segments), turn * np.arange(sides), indexing="ij")
    vertices, normals = surface(t, s)
    i, j = np.meshgrid(np.arange(segments), np.arange(sides), indexing="ij")
    a, b = i * sides + j, ((i + 1) % segments) * sides + j
    c, d = ((i + 1) % segments) * sides + (j + 1) % sides, i * sides + (j + 1) % sides
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    vertices, normals = vertices.reshape(-1, 3), normals.reshape(-1, 3)
    error = 0.0
    for ends, dt, ds in (((a, b), 0.5, 0.0), ((b, c), 1.0, 0.5), ((a, c), 0.5, 0.5)):
        middle = 0.5 * (vertices[ends[0]] + vertices[ends[1]])
        exact, exact_normal = surface(t + dt * step, s + ds * turn)
        error = max(error, float(np.abs(np.einsum("abi,abi->ab", exact - middle, exact_normal)).max()))
    return vertices, faces.astype(np.int64), normals, error


def unit_cube(reflectance: ArrayLike, emission: ArrayLike, *, bands: int = 1) -> Scene:
    """The closed unit cube seen from inside, one material: B = e / (1 - rho) everywhere.

    Six surfaces in the order of :data:`BOX_SIDES`, so that tests can give one its own material.
    """
    material = diffuse("wall", reflectance, emission, bands=bands)
    surfaces = tuple(
        box_surface(side, material, [0, 0, 0], [1, 1, 1], inward=True, omit=[s for s in BOX_SIDES if s != side])
        for side in BOX_SIDES
    )
    return Scene("unit cube", surfaces, background=np.zeros(bands), bands=bands, closed=True)


def quad_light_over_floor(
    occluder: Surface | None = None, *, light_side: float = 1.0, light_height: float = 2.0, floor_side: float = 4.0
) -> Scene:
    """A square light of radiance 1 (exitance pi) above a black floor at z = 0, both centred on the z axis.

    The setting of most shadow studies: below the middle of a unit light at height 2 the unoccluded
    irradiance is 0.23084 W/m2.
    """

    def square(side: float, height: float, turn: int) -> FloatArray:
        half = 0.5 * side
        ring = np.array([[-half, -half, height], [half, -half, height], [half, half, height], [-half, half, height]])
        return ring[::turn].copy()

    floor = Surface.from_polygons("floor", diffuse("floor", 0.0), [square(floor_side, 0.0, 1)])
    light = Surface.from_polygons("light", diffuse("light", 0.0, np.pi), [square(light_side, light_height, -1)])
    surfaces = (floor, light) if occluder is None else (floor, light, occluder)
    return Scene("quad light over a floor", surfaces, background=np.zeros(1), bands=1)


def closed_scene_gaps(surfaces: Sequence[Surface], *, tolerance: float = 1e-9) -> int:
    """Number of polygon edges without exactly one partner that runs the other way; 0 is watertight.

    Corners closer than ``tolerance`` of the whole size count as one.
    """
    points = np.concatenate([surface.vertices[surface.ring_vertices] for surface in surfaces])
    sizes = np.concatenate([np.diff(surface.ring_offsets) for surface in surfaces])
    step = tolerance * float(np.ptp(points, axis=0).max())
    _, corner = np.unique(np.round((points - points[0]) / step), axis=0, return_inverse=True)
    corner = corner.ravel()
    ends = np.cumsum(sizes)
    following = np.arange(len(corner)) + 1
    following[ends - 1] = ends - sizes
    edges = np.column_stack([corner, corner[following]])
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    reverse = {(b, a): n for (a, b), n in zip(map(tuple, unique.tolist()), counts.tolist(), strict=True)}
    return sum(
        n
        for edge, n in zip(map(tuple, unique.tolist()), counts.tolist(), strict=True)
        if n != 1 or reverse.get(edge) != 1
    )
