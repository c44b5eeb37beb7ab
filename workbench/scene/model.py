"""The scene as frozen records: what a reader makes and everything else reads.

Quantities are radiometric.  Reflectance lies in 0..1 a band, emission is radiant exitance in
W/m2, background is radiance in W/(m2 sr).  Every array of bands has the scene's ``bands`` values.
Lengths are in the scene's own unit, metres unless the scene says otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

__all__ = ["SKY_KINDS", "Camera", "Light", "Material", "Scene", "Sky", "Sphere", "Surface"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Material:
    """How a surface sends light back, lets it through and emits it.

    Parameters
    ----------
    name : str
    reflectance : (bands,) float
        Diffuse reflectance. [0..1]
    emission : (bands,) float
        Radiant exitance of the emitting side. [W m-2]
    specular : (bands,) float
        Mirror (or glossy, see ``exponent``) reflectance. [0..1]
    exponent : float
        Phong exponent of the highlight and of fuzzy reflection; ``inf`` is a perfect mirror.
    transmittance : (bands,) float
        Share of light that passes straight through. [0..1]
    ior : float
        Index of refraction; 1 bends nothing.
    two_sided : bool
        Whether both sides reflect and emit.  A one-sided surface still blocks light from both
        sides; its back is black.
    """

    name: str
    reflectance: FloatArray
    emission: FloatArray
    specular: FloatArray
    exponent: float
    transmittance: FloatArray
    ior: float = 1.0
    two_sided: bool = False


@dataclass(frozen=True)
class Sphere:
    """An exact sphere: ``center`` (3,) and ``radius``, both in scene lengths."""

    center: FloatArray
    radius: float


@dataclass(frozen=True)
class Surface:
    """One surface and the polygons that make it up.

    Woo (1993) asks for the difference: neighbouring points share a *surface* far more often than
    they share a tessellated *polygon*.  Faces stay as they came (triangles, quads, concave
    polygons, polygons with holes); convex parts are cut only for tracing.

    Parameters
    ----------
    name : str
    material : Material
    vertices : (v, 3) float
    ring_vertices : (k,) int
        Indices into ``vertices``, ring after ring, counter-clockwise from the front; the rings of
        holes run the other way.
    ring_offsets : (r + 1,) int
        Ring ``i`` is ``ring_vertices[ring_offsets[i]:ring_offsets[i + 1]]``.
    face_rings : (f + 1,) int
        Face ``j`` has rings ``face_rings[j]:face_rings[j + 1]``; the first is the outer one.
    vertex_normals : (v, 3) float, optional
        Shading normals of a tessellated smooth surface.
    sphere : Sphere, optional
        The exact sphere of which the faces are a tessellation.
    facet_error : float
        Largest distance between the exact surface and its facets. [scene lengths]
    """

    name: str
    material: Material
    vertices: FloatArray
    ring_vertices: IntArray
    ring_offsets: IntArray
    face_rings: IntArray
    vertex_normals: FloatArray | None = None
    sphere: Sphere | None = None
    facet_error: float = 0.0

    @property
    def face_count(self) -> int:
        """Number of faces."""
        return len(self.face_rings) - 1

    def face(self, index: int) -> list[FloatArray]:
        """Rings of one face, each ``(n, 3)``; the first is the outer one."""
        return [
            self.vertices[self.ring_vertices[self.ring_offsets[r] : self.ring_offsets[r + 1]]]
            for r in range(self.face_rings[index], self.face_rings[index + 1])
        ]

    def faces(self) -> Iterator[list[FloatArray]]:
        """Each face's rings, in order."""
        return (self.face(index) for index in range(self.face_count))

    @classmethod
    def from_polygons(
        cls, name: str, material: Material, polygons: Sequence[FloatArray | Sequence[FloatArray]]
    ) -> Surface:
        """A surface of polygons, each an ``(n, 3)`` ring or a list of rings (outer, holes...)."""
        vertices, ring_offsets, face_rings = [], [0], [0]
        for polygon in polygons:
            rings = polygon if isinstance(polygon, (list, tuple)) else [polygon]
            if rings and np.ndim(rings[0]) == 1:  # a plain list of triples is a single ring
                rings = [rings]
            for ring in rings:
                ring = np.asarray(ring, dtype=np.float64)
                vertices.append(ring)
                ring_offsets.append(ring_offsets[-1] + len(ring))
            face_rings.append(face_rings[-1] + len(rings))
        return cls(
            name=name,
            material=material,
            vertices=np.concatenate(vertices) if vertices else np.empty((0, 3)),
            ring_vertices=np.arange(ring_offsets[-1], dtype=np.int64),
            ring_offsets=np.asarray(ring_offsets, dtype=np.int64),
            face_rings=np.asarray(face_rings, dtype=np.int64),
        )

    @classmethod
    def from_mesh(
        cls,
        name: str,
        material: Material,
        vertices: FloatArray,
        faces: IntArray,
        *,
        vertex_normals: FloatArray | None = None,
        sphere: Sphere | None = None,
        facet_error: float = 0.0,
    ) -> Surface:
        """A surface of equal-sized faces, ``faces`` being ``(f, 3)`` or ``(f, 4)`` indices."""
        faces = np.ascontiguousarray(faces, dtype=np.int64)
        count, size = faces.shape
        return cls(
            name=name,
            material=material,
            vertices=np.ascontiguousarray(vertices, dtype=np.float64),
            ring_vertices=faces.ravel(),
            ring_offsets=np.arange(count + 1, dtype=np.int64) * size,
            face_rings=np.arange(count + 1, dtype=np.int64),
            vertex_normals=vertex_normals,
            sphere=sphere,
            facet_error=facet_error,
        )


@dataclass(frozen=True)
class Light:
    """A light that is no surface of the scene.

    ``kind`` is ``point``, ``spot``, ``directional`` or ``linear``; area lights are surfaces with
    emission and are read as such.

    Parameters
    ----------
    name, kind : str
    power : (bands,) float
        ``point`` and ``spot``: radiant intensity along the axis [W/sr].  ``directional``:
        irradiance on a surface that faces it [W/m2].  ``linear``: radiant intensity per length
        across the axis [W/(sr m)].
    position : (3,) float, optional
        Of ``point`` and ``spot``; first end of ``linear``.
    end : (3,) float, optional
        Second end of ``linear``.
    direction : (3,) float, optional
        Unit vector in which ``spot`` and ``directional`` light travels.
    cone_deg : float
        ``spot``: half-angle beyond which it gives nothing. [degrees]
    exponent : float
        ``spot``: intensity falls as cos^exponent of the angle to the axis.
    lambertian : bool
        ``linear``: intensity falls with the sine of the angle to the line; otherwise isotropic.
    """

    name: str
    kind: str
    power: FloatArray
    position: FloatArray | None = None
    end: FloatArray | None = None
    direction: FloatArray | None = None
    cone_deg: float = 90.0
    exponent: float = 0.0
    lambertian: bool = False


SKY_KINDS = ("uniform", "overcast", *(f"cie-{number}" for number in range(1, 16)))
"""The skies: the same radiance all over, the CIE traditional overcast sky (1 + 2 sin) / 3, and the fifteen
standard general skies of CIE S 011 / ISO 15469."""


@dataclass(frozen=True)
class Sky:
    """The light of the sky above the horizon and of the ground below it, both infinitely far.

    Parameters
    ----------
    kind : str
        One of :data:`SKY_KINDS`.
    zenith_radiance : (bands,) float, optional
        [W m-2 sr-1]  Either this or the next.
    horizontal_irradiance : (bands,) float, optional
        On an unobstructed surface that faces up, without the sun's own beam. [W m-2]
    ground_reflectance : (bands,) float
        The ground shines as a diffuse plane of this reflectance under the whole sky. [0..1]
    up : (3,) float
        Unit vector to the zenith.
    sun_direction : (3,) float, optional
        Unit vector to the sun, which the brighter part of most general skies follows.
    """

    kind: str
    ground_reflectance: FloatArray
    zenith_radiance: FloatArray | None = None
    horizontal_irradiance: FloatArray | None = None
    up: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    sun_direction: FloatArray | None = None


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: ``fov_deg`` is the full vertical angle, pixels are square."""

    eye: FloatArray
    look_at: FloatArray
    up: FloatArray
    fov_deg: float = 45.0
    width: int = 512
    height: int = 512


@dataclass(frozen=True)
class Scene:
    """Everything that a reader found, in the order of the file.

    ``closed`` says that the author declares the surfaces an enclosure: no light escapes, every
    row of form factors sums to 1.  ``background`` is the radiance seen where no surface is, unless
    there is a ``sky``.
    ``notes`` tell, a sentence each, what the reader changed or supposed.  ``cameras`` are further
    ones by their names; ``camera`` is the one to use unless another is asked for.
    """

    name: str
    surfaces: tuple[Surface, ...]
    lights: tuple[Light, ...] = ()
    camera: Camera | None = None
    background: FloatArray = field(default_factory=lambda: np.zeros(3))
    bands: int = 3
    closed: bool = False
    path: Path | None = None
    notes: tuple[str, ...] = ()
    sky: Sky | None = None
    cameras: Mapping[str, Camera] = field(default_factory=dict)

    @property
    def has_emitter(self) -> bool:
        """Whether anything in the scene sends light."""
        return (
            any(surface.material.emission.any() for surface in self.surfaces)
            or any(light.power.any() for light in self.lights)
            or bool(self.background.any())
            or self.sky is not None
        )
