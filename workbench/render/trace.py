"""The recursive tracer, in wavefronts: all rays of one depth of the ray trees at a time.

T. Whitted's recursion (CACM 23(6), 1980) turned into batches: find the closest hits, send shadow
rays to every light, then go on with all reflected and refracted rays as one batch.  Lights are the
scene's own (point, spot, directional, linear) and every surface that emits.  Soft shadows, those of
linear lights and of surfaces, come from :mod:`workbench.shadow.occlusion`, as exact there as anywhere
else; with ``light_samples`` these lights take a set number of shadow rays instead, as in the papers.
Quantities are radiometric: radiance in W/(m2 sr), a diffuse
surface under irradiance E sends rho E / pi, a highlight is the energy-conserving Phong lobe
(e + 1) / (2 pi) cos^e around the mirrored direction, which is also the lobe of fuzzy reflection.
An emitting surface makes no highlight: reflected rays see it themselves.

Departures from physics, as in the ray tracers of the papers: no Fresnel terms (mirror and
transparent shares are constants), shadow rays pass transparent surfaces unbent, and what is seen
beyond all surfaces, a sky or a background, lights nothing.

The tracer both records and obeys :mod:`workbench.render.atomic`: see :class:`RayTrees` and
:class:`Guide` there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.accel.base import NO_POLYGON
from workbench.accel.embree import EmbreeAccelerator
from workbench.arrays import as_bands, as_count, as_fraction, as_points, as_unit_vectors
from workbench.counters import Counters
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.render import _trace_kernels as kernels
from workbench.render._trace_kernels import COMPLEX_SHADOW, INSHADOW, NOT_INSHADOW
from workbench.render.atomic import NO_SURFACE, Guide, RayTrees
from workbench.render.textures import Texture
from workbench.scene.model import Light, Scene, Surface
from workbench.shadow.lights import LinearLight, Sender, lights_of_scene
from workbench.shadow.occlusion import OcclusionEstimate, OcclusionState, Shader
from workbench.shadow.rays import NOISE
from workbench.shadow.sky import SkyLight

__all__ = ["ComponentCount", "DiffuseEnds", "RayTally", "TraceOptions", "Traced", "Tracer", "corner_normals"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
_Work = TypeVar("_Work")

BLOCK_RAYS = 16384
"""Samples a block: their wavefront stays in cache."""

LIGHT_RAYS = 64
"""Shadow rays to a light that the shadow module does not take and of which no number is asked."""

SOFT_FACES = 32
"""Faces of a surface up to which each is a light of its own to the shadow module."""

MAX_CROSSINGS = 64
"""Transparent surfaces that a shadow ray passes; beyond, it counts as blocked."""


@dataclass(frozen=True)
class TraceOptions:
    """How to trace.

    Parameters
    ----------
    depth : int
        Reflections and refractions in a row, 3 in the paper.
    light_samples : int, optional
        Shadow rays to a linear or area light, as in the papers; unless given, soft shadows are found
        by :class:`~workbench.shadow.occlusion.Shader`.
    shadow_error : float
        Wanted error of the visible share of a light at a sample, where occluders are too many to be
        cut exactly; a pixel averages four samples or more.
    jitter : bool
        With ``light_samples``: move the samples of a light by a random number a point.  Off,
        penumbras show steps of 1/K; on, noise, which adaptive sampling takes for detail.
    bundle : int
        Rays of a fuzzy reflection or refraction at the cast ray's hit (deeper ones take one);
        1 traces the sharp direction whatever the exponent.
    falloff : bool
        Whether light of point and spot lights falls with the square of distance.
    see_backs : bool
        Whether one-sided surfaces are seen from behind, black; off, rays to the eye pass there, as
        NFF scenes expect.  Shadow rays are blocked from both sides all the same.
    ambient : (bands,) float
        Radiance from everywhere, never shadowed; times the reflectance. [W m-2 sr-1]
    seed : int
        Of all random numbers.
    """

    depth: int = 3
    light_samples: int | None = None
    shadow_error: float = 0.02
    jitter: bool = False
    bundle: int = 1
    falloff: bool = True
    see_backs: bool = True
    ambient: ArrayLike = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.depth <= 16:
            raise OptionError(f"depth: found {self.depth}, expected 0 to 16")
        for name in ("light_samples", "bundle"):
            found = getattr(self, name)
            if found is not None and not 1 <= found <= 4096:
                raise OptionError(f"{name}: found {found}, expected 1 to 4096")
        as_fraction(self.shadow_error, "shadow_error")


@dataclass
class ComponentCount:
    """One component's rays: samples that ``assumed``, rays ``shot``, rays ``saved`` by assuming.

    A reflected or refracted ray saved counts 1; what would have followed it is not known.  A light
    whose soft shadow the shadow module finds counts 1 a point, however it was found.
    """

    assumed: int = 0
    shot: int = 0
    saved: int = 0

    def add(self, other: ComponentCount) -> None:
        """Add the counts of another."""
        self.assumed += other.assumed
        self.shot += other.shot
        self.saved += other.saved


@dataclass
class RayTally:
    """Rays by component, shadow rays by light."""

    shadows: list[ComponentCount]
    cast: ComponentCount = field(default_factory=ComponentCount)
    reflection: ComponentCount = field(default_factory=ComponentCount)
    refraction: ComponentCount = field(default_factory=ComponentCount)
    cast_hits: int = 0
    cast_misguided: int = 0

    def add(self, other: RayTally) -> None:
        """Add the counts of another tally over the same lights."""
        for mine, theirs in zip(self.shadows, other.shadows, strict=True):
            mine.add(theirs)
        for name in ("cast", "reflection", "refraction"):
            getattr(self, name).add(getattr(other, name))
        self.cast_hits += other.cast_hits
        self.cast_misguided += other.cast_misguided

    @property
    def shadow(self) -> ComponentCount:
        """All lights together."""
        total = ComponentCount()
        for light in self.shadows:
            total.add(light)
        return total

    @property
    def rays(self) -> int:
        """Rays shot of every kind."""
        return sum(part.shot for part in (self.cast, self.shadow, self.reflection, self.refraction))

    def counters(self) -> Counters:
        """The tally by the workbench's names."""
        return Counters(
            rays=self.rays,
            cast_rays=self.cast.shot,
            cast_rays_hit=self.cast_hits,
            shadow_rays=self.shadow.shot,
            reflection_rays=self.reflection.shot,
            refraction_rays=self.refraction.shot,
            cast_rays_saved=self.cast.saved,
            shadow_rays_saved=self.shadow.saved,
            reflection_rays_saved=self.reflection.saved,
            refraction_rays_saved=self.refraction.saved,
        )


@dataclass(frozen=True)
class Traced:
    """What rays brought back.

    Parameters
    ----------
    radiance : (n, bands) float
        [W m-2 sr-1]
    surface : (n,) int
        Surface met by each ray, -1 for none.
    saved : (n,) int
        Shadow rays of the sample's ray tree not shot because their answer was assumed.
    tally : RayTally
    """

    radiance: FloatArray
    surface: IntArray
    saved: IntArray
    tally: RayTally


@dataclass(frozen=True)
class DiffuseEnds:
    """The points at which rays see a diffuse surface: directly, in mirrors, through glass.

    A row an end; a ray has none (it meets nothing, or black), one, or many (a surface both diffuse
    and mirroring is an end and leads on to others).  Their order does not depend on the workers.

    Parameters
    ----------
    ray : (m,) int
        The ray, a row of those traced.
    points : (m, 3) float
        On the surface, not lifted off it.
    normals : (m, 3) float
        Unit shading normals on the side that is seen: interpolated where the surface is smooth.
    facing : (m, 3) float
        Unit normals of the polygons on the same side.
    surface, polygon : (m,) int
        Of the scene, and of its geometry.
    front : (m,) bool
        Whether the front is seen; a back only where the material is two-sided or lets light through.
    depth : (m,) int
        Reflections and refractions before the end.
    throughput : (m, bands) float
        Product of the specular and transmitted shares along the path, divided by the rays of a bundle.
    reflectance : (m, bands) float
        Diffuse, with its texture; not part of ``throughput``.
    radiance : (n, bands) float
        What the ``n`` rays bring beside the ends' reflected light: emission seen, background,
        ambient light, and highlights of the scene's lights on shiny surfaces. [W m-2 sr-1]
    tally : RayTally
        Shadow rays in it went to highlights.
    """

    ray: IntArray
    points: FloatArray
    normals: FloatArray
    facing: FloatArray
    surface: IntArray
    polygon: IntArray
    front: NDArray[np.bool_]
    depth: IntArray
    throughput: FloatArray
    reflectance: FloatArray
    radiance: FloatArray
    tally: RayTally

    def radiance_with(self, irradiance: ArrayLike) -> FloatArray:
        """Radiance (n, bands) of the rays when the ends have ``irradiance`` (m, bands) in W/m2."""
        received = np.asarray(irradiance, dtype=np.float64)
        if received.shape != self.throughput.shape:
            raise InputError(
                f"irradiance: found shape {received.shape}, expected {self.throughput.shape}, a row an end"
            )
        found = self.radiance.copy()
        np.add.at(found, self.ray, self.throughput * self.reflectance / np.pi * received)
        return found


@dataclass(frozen=True)
class _Emitter:
    """A light as the kernels read it; see :func:`~workbench.render._trace_kernels.light_rays`.

    With ``senders`` the shadow module finds its soft shadow, and rays serve its highlights only.
    """

    law: int
    power: FloatArray
    samples: int
    corners: FloatArray
    cumulative: FloatArray
    normals: FloatArray
    scale: float
    cosine_cut: float = -2.0
    spot_exponent: float = 0.0
    falls: bool = True
    highlight: bool = True
    senders: tuple[Sender, ...] = ()


def _of_light(light: Light, options: TraceOptions) -> _Emitter:
    """A light that is no surface."""

    def given(name: str) -> FloatArray:
        value = getattr(light, name)
        if value is None:
            raise InputError(f"light {light.name!r}: found no {name}, expected one for a {light.kind} light")
        return as_points(value, f"light {light.name!r}, {name}")

    if light.kind in ("point", "spot"):
        spot = light.kind == "spot"
        return _Emitter(
            law=kernels.POINT,
            power=light.power,
            samples=1,
            corners=given("position")[None],
            cumulative=np.ones(1),
            normals=as_unit_vectors(given("direction")) if spot else np.zeros((1, 3)),
            scale=1.0,
            cosine_cut=math.cos(math.radians(light.cone_deg)) if spot else -2.0,
            spot_exponent=light.exponent,
            falls=options.falloff,
        )
    if light.kind == "directional":
        toward = -as_unit_vectors(given("direction"))
        return _Emitter(kernels.DIRECTIONAL, light.power, 1, toward[None], np.ones(1), np.zeros((1, 3)), 1.0)
    if light.kind != "linear":
        raise InputError(f"light {light.name!r}: found the kind {light.kind!r}, expected a kind that the tracer knows")
    ends = np.concatenate([given("position"), given("end")])
    axis = ends[1:] - ends[:1]
    length = float(np.linalg.norm(axis))
    samples = options.light_samples or LIGHT_RAYS
    return _Emitter(
        law=kernels.LINEAR_LAMBERTIAN if light.lambertian else kernels.LINEAR,
        power=light.power,
        samples=samples,
        corners=ends[None],
        cumulative=np.ones(1),
        normals=axis / length,
        scale=length / samples,
    )


def _of_surface(surface: Surface, options: TraceOptions) -> _Emitter:
    """An emitting surface: an area light."""
    geometry = Geometry.from_scene(Scene(surface.name, (surface,)))
    triangles, _ = geometry.triangles
    vector = 0.5 * np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(vector, axis=1)
    samples = options.light_samples or LIGHT_RAYS
    return _Emitter(
        law=kernels.AREA_BOTH_SIDES if surface.material.two_sided else kernels.AREA,
        power=surface.material.emission / np.pi,
        samples=samples,
        corners=triangles,
        cumulative=np.cumsum(area) / area.sum(),
        normals=vector / area[:, None],
        scale=float(area.sum()) / samples,
        highlight=False,
    )


class _Materials:
    """The surfaces' materials as arrays, a row a surface."""

    def __init__(self, scene: Scene) -> None:
        materials = [surface.material for surface in scene.surfaces]
        shape = (len(materials), scene.bands)

        def rows(name: str) -> FloatArray:
            return np.asarray([getattr(material, name) for material in materials], dtype=np.float64).reshape(shape)

        self.reflectance = rows("reflectance")
        self.radiance = rows("emission") / np.pi
        self.specular = rows("specular")
        self.transmittance = rows("transmittance")
        self.exponent = np.asarray([material.exponent for material in materials], dtype=np.float64)
        self.ior = np.asarray([material.ior for material in materials], dtype=np.float64)
        self.mirrors = np.asarray(self.specular.any(axis=1))
        self.clear = np.asarray(self.transmittance.any(axis=1))
        # What lets light through has no dark side.
        self.both_sides = np.asarray([m.two_sided for m in materials], dtype=bool) | self.clear
        # Highlights: a perfect mirror shows no point light, and exponent -1 says so to the kernel.
        self.highlight_exponent = np.where(self.mirrors & np.isfinite(self.exponent), self.exponent, -1.0)
        self.emits = self.radiance.any(axis=1)


def corner_normals(scene: Scene, geometry: Geometry) -> FloatArray:
    """Normals at the corners of the geometry's triangles (t, 3, 3); empty if no surface is smooth."""
    if all(surface.vertex_normals is None for surface in scene.surfaces):
        return np.empty((0, 3, 3))
    at_corners = np.repeat(geometry.piece_normal, np.diff(geometry.piece_start), axis=0)
    piece_surface = geometry.polygon_surface[geometry.piece_polygon]
    corner_surface = np.repeat(piece_surface, np.diff(geometry.piece_start))
    first = np.searchsorted(corner_surface, np.arange(len(scene.surfaces) + 1))
    for index, surface in enumerate(scene.surfaces):
        if surface.vertex_normals is None:
            continue
        part = slice(first[index], first[index + 1])
        corners = geometry.corners[part]
        normals = surface.vertex_normals[surface.ring_vertices]
        if corners.shape != normals.shape or (corners != surface.vertices[surface.ring_vertices]).any():
            normals = _matched_normals(surface, corners)  # concave faces were cut and their corners moved about
        at_corners[part] = normals
    counts = np.diff(geometry.piece_start) - 2
    start = np.repeat(geometry.piece_start[:-1], counts)
    step = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.ascontiguousarray(at_corners[np.stack([start, start + step + 1, start + step + 2], axis=1)])


def _matched_normals(surface: Surface, corners: FloatArray) -> FloatArray:
    """Normals of the vertices that lie where ``corners`` (n, 3) do; at creases the last one counts."""
    assert surface.vertex_normals is not None
    found = {tuple(v): normal for v, normal in zip(surface.vertices.tolist(), surface.vertex_normals, strict=True)}
    return np.asarray([found[tuple(corner)] for corner in corners.tolist()])


class Tracer:
    """A scene ready to be traced.

    Parameters
    ----------
    scene : Scene
    options : TraceOptions, optional
    textures : mapping of str to Texture, optional
        By the names of surfaces; each multiplies its surface's reflectance.
    workers : int
        Threads over which blocks of samples are spread.  Answers and counts do not depend on it.

    Attributes
    ----------
    light_names : tuple of str
        The scene's lights, then its emitting surfaces: the order of the tally's ``shadows``.
    geometry : Geometry
        The scene's polygons.

    Raises
    ------
    InputError
        If a texture is given for an unknown surface or a light has an unknown kind.
    """

    def __init__(
        self,
        scene: Scene,
        options: TraceOptions | None = None,
        *,
        textures: Mapping[str, Texture] | None = None,
        workers: int = 1,
    ) -> None:
        workers = as_count(workers, "workers")
        self.scene, self.options, self.workers = scene, options or TraceOptions(), workers
        self.bands = scene.bands
        self._ambient = as_bands(self.options.ambient, self.bands, "ambient")
        names = [surface.name for surface in scene.surfaces]
        unknown = sorted(set(textures or {}) - set(names))
        if unknown:
            raise InputError(f"textures: found {unknown[0]!r}, expected the name of a surface")
        self._textures = {i: textures[name] for i, name in enumerate(names) if name in textures} if textures else {}
        self._materials = _Materials(scene)
        self.geometry = Geometry.from_scene(scene)
        triangles, piece = self.geometry.triangles
        polygon = self.geometry.piece_polygon[piece]
        self._triangles = triangles
        self._first_triangle = np.searchsorted(polygon, np.arange(self.geometry.polygon_count + 1))
        self._corner_normals = corner_normals(scene, self.geometry)
        self._surface = np.append(self.geometry.polygon_surface, NO_SURFACE).astype(np.int32)
        self._all = EmbreeAccelerator(self.geometry)
        self.offset = self._all.offset
        self._sky = SkyLight.of_scene(scene) if scene.sky is not None else None
        self._set_up_shadows()
        emitting = [surface for surface in scene.surfaces if surface.material.emission.any()]
        shining = [light for light in scene.lights if light.power.any()]
        self._lights = [_of_light(light, self.options) for light in shining]
        self._lights += [_of_surface(surface, self.options) for surface in emitting]
        self.light_names = tuple(
            [light.name for light in scene.lights if light.power.any()] + [s.name for s in emitting]
        )
        self._shader: Shader | None = None
        if self.options.light_samples is None:
            self._set_up_soft_shadows()

    def _set_up_soft_shadows(self) -> None:
        """Give linear and area lights to the shadow module, where it knows all that their shadows need.

        To it a pane is grey, and every face of a surface a light.
        """
        panes = self._materials.transmittance[self._materials.clear]
        if (panes != panes[:, :1]).any():
            return
        scene = self.scene
        dark = np.zeros(self.bands)
        surfaces = tuple(
            surface
            if surface.sphere is not None or surface.face_count <= SOFT_FACES
            else replace(surface, material=replace(surface.material, emission=dark))
            for surface in scene.surfaces
        )
        senders = lights_of_scene(replace(scene, surfaces=surfaces), self.geometry)
        shining = sum(bool(light.power.any()) for light in scene.lights)
        parts: list[list[Sender]] = [[] for _ in self._lights]
        emitting = [i for i, surface in enumerate(scene.surfaces) if surface.material.emission.any()]
        place = {surface: i for i, surface in enumerate(emitting, shining)}
        for i, sender in enumerate(senders):
            if i < shining:
                if isinstance(sender, LinearLight):
                    parts[i].append(sender)
            else:
                surface = int(self.geometry.polygon_surface[sender.polygons[0]])
                parts[place[surface]].append(sender)
        self._lights = [
            replace(light, senders=tuple(own) if len(own) <= SOFT_FACES else ())
            for light, own in zip(self._lights, parts, strict=True)
        ]
        if any(light.senders for light in self._lights):
            self._shader = Shader(self.geometry, self.workers)

    def _set_up_shadows(self) -> None:
        clear: NDArray[np.bool_] = self._materials.clear
        self._panes: EmbreeAccelerator | None = None
        self._opaque = self._all
        if not clear.any():
            return
        surfaces = self.scene.surfaces

        def part(wanted: bool) -> Geometry:
            chosen = tuple(s for s, c in zip(surfaces, clear, strict=True) if c == wanted)
            return Geometry.from_scene(replace(self.scene, surfaces=chosen))

        self._opaque = EmbreeAccelerator(part(False))
        panes = part(True)
        self._panes = EmbreeAccelerator(panes)
        through = self._materials.transmittance[clear]
        self._pane_transmittance = through[panes.polygon_surface]

    def beyond(self, directions: FloatArray) -> FloatArray:
        """Radiance (n or 1, bands) of the sky or the background in unit directions (n, 3). [W m-2 sr-1]"""
        if self._sky is None or not len(directions):
            return self.scene.background[None]
        return self._sky.radiance(directions)

    @property
    def branching(self) -> int:
        """Rays that may follow from a hit: 1, or 2 in a scene with transparent surfaces."""
        return 1 if self._panes is None else 2

    @property
    def light_count(self) -> int:
        """Number of lights."""
        return len(self._lights)

    @property
    def triangle_count(self) -> int:
        """Number of triangles traced."""
        return len(self._triangles)

    def ray_trees(self, count: int, *, whole_tree: bool = False, normals: bool = False) -> RayTrees:
        """Room to record ``count`` samples: the top of each ray tree, or every node to the depth limit."""
        nodes = 1
        if whole_tree:
            # Without anything transparent the tree is a chain of reflections.
            nodes = self.options.depth + 1 if self.branching == 1 else 2 ** (self.options.depth + 1) - 1
        return RayTrees.empty(count, nodes, self.light_count, self.bands, normals)

    def trace(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        *,
        keys: IntArray | None = None,
        record: RayTrees | None = None,
        guide: Guide | None = None,
        guide_rows: IntArray | None = None,
        place: tuple[FloatArray, FloatArray] | None = None,
    ) -> Traced:
        """Radiance along rays.

        Parameters
        ----------
        origins : (n, 3) or (3,) float
        directions : (n, 3) float
            Unit vectors.
        keys : (n,) int, optional
            Number of each ray from which its random numbers come; 0, 1, 2... unless given.
        record : RayTrees, optional
            Written, row i by ray i: corner samples.
        guide : Guide, optional
            What may be assumed: samples inside pixels.
        guide_rows : (n,) int
            Row of the guide for each ray; with ``guide``.
        place : pair of (n,) float
            Where in its pixel each ray passes, 0..1 to the right and downward; with ``guide``.

        Raises
        ------
        InputError
            If shapes do not agree or values are not finite.
        """
        start, along, number = _as_rays(origins, directions, keys)
        if guide is not None and (guide_rows is None or place is None):
            raise InputError("guide: found no guide_rows or place, expected both")
        return self.trace_unchecked(start, along, number, record, guide, guide_rows, place)

    def trace_unchecked(
        self,
        start: FloatArray,
        along: FloatArray,
        number: IntArray,
        record: RayTrees | None = None,
        guide: Guide | None = None,
        guide_rows: IntArray | None = None,
        place: tuple[FloatArray, FloatArray] | None = None,
        *,
        met: IntArray | None = None,
    ) -> Traced:
        """:meth:`trace` for callers that made the rays themselves: nothing is checked.

        ``met`` (n,): polygons that the rays are known to meet, -1 for none; they are not cast again.
        """
        count = len(along)
        salted = kernels.child_keys(number.astype(np.uint64), self.options.seed, 1)
        guided = None
        if guide is not None and guide_rows is not None and place is not None:
            guided = _Guided(guide, guide_rows, *place)
        radiance = np.empty((count, self.bands))
        surface = np.empty(count, dtype=np.int64)
        saved = np.zeros(count, dtype=np.int64)

        def work(rows: slice) -> RayTally:
            sweep = _Sweep(
                self,
                self.no_rays(),
                None if record is None else record.rows(rows),
                None if guided is None else guided.rows(rows),
                surface[rows],
                saved[rows],
                None if met is None else met[rows],
            )
            radiance[rows] = sweep.follow(_first_wave(start, along, salted, rows), 0)
            return sweep.tally

        tally = self.no_rays()
        for part in self._in_blocks(count, work):
            tally.add(part)
        return Traced(radiance, surface, saved, tally)

    def trace_to_diffuse(
        self, origins: ArrayLike, directions: ArrayLike, *, keys: IntArray | None = None
    ) -> DiffuseEnds:
        """Follow rays through mirrors, glass and fuzzy bundles to all the diffuse surfaces that they see.

        What a final gather needs: the points whose irradiance makes the picture, and with what
        weight.  With direct irradiance alone :meth:`DiffuseEnds.radiance_with` gives the radiance of
        :meth:`trace`; the more irradiance it is given, the more of the light is in the picture.
        Directions of bundles are those of :meth:`trace` for the same ``keys``.

        Parameters
        ----------
        origins : (n, 3) or (3,) float
        directions : (n, 3) float
            Unit vectors.
        keys : (n,) int, optional
            Number of each ray from which its random numbers come; 0, 1, 2... unless given.

        Raises
        ------
        InputError
            If shapes do not agree or values are not finite.
        """
        start, along, number = _as_rays(origins, directions, keys)
        count = len(along)
        salted = kernels.child_keys(number.astype(np.uint64), self.options.seed, 1)
        surface, saved = np.empty(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
        radiance = np.empty((count, self.bands))

        def work(rows: slice) -> tuple[RayTally, list[tuple[NDArray, ...]]]:
            sweep = _Sweep(self, self.no_rays(), None, None, surface[rows], saved[rows])
            radiance[rows], ends = sweep.diffuse_ends(_first_wave(start, along, salted, rows))
            return sweep.tally, [(end[0] + rows.start, *end[1:]) for end in ends]

        tally, parts = self.no_rays(), []
        for found, ends in self._in_blocks(count, work):
            tally.add(found)
            parts += ends
        columns: list[Any] = [np.concatenate(column) for column in zip(*parts, strict=True)]
        return DiffuseEnds(*[*columns, radiance, tally])

    def no_rays(self) -> RayTally:
        """A tally of nothing yet."""
        return RayTally([ComponentCount() for _ in self._lights])

    def _in_blocks(self, count: int, work: Callable[[slice], _Work]) -> list[_Work]:
        """``work`` on each block of ``count`` rays, over the threads; always one block or more."""
        blocks = [slice(i, min(i + BLOCK_RAYS, count)) for i in range(0, max(count, 1), BLOCK_RAYS)]
        # The shadow module has threads of its own.
        if self.workers > 1 and len(blocks) > 1 and self._shader is None:
            with ThreadPoolExecutor(self.workers) as pool:
                return list(pool.map(work, blocks))
        return [work(rows) for rows in blocks]

    # ---- what the sweep asks of the scene

    def transmitted(self, origins: NDArray, directions: NDArray) -> FloatArray:
        """Share (n, bands or 1) that passes along shadow rays, in the opaque part's unit coordinates."""
        blocked = self._opaque.blocked_raw(origins, directions, np.ones(len(origins), dtype=np.float32)) == 0
        through = (~blocked).astype(np.float64)[:, None]
        if self._panes is None:
            return through
        through = np.repeat(through, self.bands, axis=1)
        centre, unit = self._opaque.frame
        rows = np.flatnonzero(~blocked)
        start = origins[rows].astype(np.float64) / unit + centre
        rest = directions[rows].astype(np.float64) / unit
        for _ in range(MAX_CROSSINGS):
            if len(rows) == 0:
                return through
            hits = self._panes.closest_hit(start, rest, far=1.0)
            met = hits.polygon != NO_POLYGON
            rows, start, rest, t = rows[met], start[met], rest[met], hits.t[met]
            through[rows] *= self._pane_transmittance[hits.polygon[met]]
            # On from just beyond the pane.
            length = np.linalg.norm(rest, axis=1)
            step = t + self.offset / length
            go_on = (step < 1.0) & through[rows].any(axis=1)
            rows, start, rest, step = rows[go_on], start[go_on], rest[go_on], step[go_on]
            start = start + step[:, None] * rest
            rest = rest * (1.0 - step)[:, None]
        through[rows] = 0.0
        return through


def _as_rays(
    origins: ArrayLike, directions: ArrayLike, keys: IntArray | None
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Rays checked: origins (n or 1, 3), unit directions (n, 3) and their numbers (n,)."""
    along = as_unit_vectors(directions, "directions")
    count = len(along)
    start = as_points(origins, "origins")
    if len(start) not in (1, count):
        raise InputError(f"origins and directions: found {len(start)} and {count} rows, expected as many")
    number = np.arange(count) if keys is None else np.asarray(keys)
    if number.shape != (count,):
        raise InputError(f"keys: found shape {number.shape}, expected {(count,)}, one a ray")
    return start, along, number


def _first_wave(start: FloatArray, along: FloatArray, keys: NDArray[np.uint64], rows: slice) -> _Wave:
    """The cast rays of a block."""
    return _Wave(
        np.ascontiguousarray(np.broadcast_to(start if len(start) == 1 else start[rows], along[rows].shape)),
        along[rows],
        keys[rows],
        np.arange(len(along[rows])),
        np.zeros(len(along[rows]), dtype=np.int64),
    )


@dataclass(frozen=True)
class _Guided:
    """A guide, and where in it each sample stands."""

    guide: Guide
    row: IntArray
    x: FloatArray
    y: FloatArray

    def rows(self, rows: slice) -> _Guided:
        return _Guided(self.guide, self.row[rows], self.x[rows], self.y[rows])


@dataclass(frozen=True)
class _Wave:
    """All rays of one depth: origins and directions (n, 3), keys, their samples and tree nodes.

    A node of -1 is beyond what is recorded.
    """

    origins: FloatArray
    directions: FloatArray
    keys: NDArray[np.uint64]
    sample: IntArray
    node: IntArray


@dataclass(frozen=True)
class _Found:
    """The hits of a wave, a row a ray that met something; ``ray`` is its row in the wave.

    With a guide, ``pixel`` is the guide's row and ``agreed`` whether the corners met that surface.
    """

    ray: IntArray
    surface: NDArray[np.int32]
    polygon: IntArray
    points: FloatArray
    facing: FloatArray
    shading: FloatArray
    front: NDArray[np.bool_]
    directions: FloatArray
    sample: IntArray
    node: IntArray
    pixel: IntArray
    agreed: NDArray[np.bool_]


@dataclass(frozen=True)
class _Shading:
    """What lights need of the hits of a wave: keys of random numbers, lit sides, reflectance, mirrored directions.

    Light is added to ``leaving`` (n, bands).
    """

    keys: NDArray[np.uint64]
    lit: NDArray[np.bool_]
    reflectance: FloatArray
    mirrored: FloatArray
    leaving: FloatArray


def _joined(estimate: OcclusionEstimate) -> NDArray[np.uint8]:
    """One state (n,) of the parts of a light: all in shadow, none in shadow, or complex; parts unseen have no say."""
    away = estimate.open_share <= 0.0
    dark = (away | (estimate.state == OcclusionState.INSHADOW)).all(axis=1)
    clear = (away | (estimate.state == OcclusionState.NOT_INSHADOW)).all(axis=1)
    return np.where(dark, INSHADOW, np.where(clear, NOT_INSHADOW, COMPLEX_SHADOW)).astype(np.uint8)


class _Sweep:
    """One block of samples on its way through the scene."""

    def __init__(
        self,
        tracer: Tracer,
        tally: RayTally,
        record: RayTrees | None,
        guided: _Guided | None,
        surface: IntArray,
        saved: IntArray,
        met: IntArray | None = None,
    ) -> None:
        self.met = met
        self.tracer, self.tally, self.record, self.guided = tracer, tally, record, guided
        self.surface, self.saved = surface, saved
        self._kept: tuple[NDArray[np.float32], NDArray[np.float32], FloatArray, FloatArray, IntArray] | None = None
        if record is not None:
            self.nodes = record.nodes
        else:
            self.nodes = guided.guide.surface.shape[1] if guided is not None else 0

    def follow(self, wave: _Wave, depth: int) -> FloatArray:
        """Radiance (n, bands) along the rays of a wave."""
        tracer, materials = self.tracer, self.tracer._materials
        radiance = np.empty((len(wave.sample), tracer.bands))
        found = self._hits(wave, depth)
        if self.record is not None:
            self._note_surfaces(wave, found)
        count = len(found.ray)
        if count < len(radiance):
            missed = np.ones(len(radiance), dtype=bool)
            missed[found.ray] = False
            radiance[missed] = tracer.beyond(wave.directions[missed])
        if count == 0:
            return radiance
        lit, reflectance, mirrored = self._begin(found)
        leaving = radiance if count == len(radiance) else np.empty((count, tracer.bands))
        kernels.sent_unlit(found.surface, lit, reflectance, materials.radiance, tracer._ambient, leaving)
        self._light(wave, found, lit, reflectance, mirrored, leaving)
        if depth < tracer.options.depth:
            self._go_on(wave, found, lit, mirrored, leaving, depth)
        if leaving is not radiance:
            radiance[found.ray] = leaving
        return radiance

    def _begin(self, found: _Found) -> tuple[NDArray[np.bool_], FloatArray, FloatArray]:
        """Whether each hit's side is lit, its reflectance, and its mirrored direction."""
        tracer, materials, count = self.tracer, self.tracer._materials, len(found.ray)
        lit, reflectance = np.empty(count, dtype=bool), np.empty((count, tracer.bands))
        kernels.begin(found.surface, found.front, materials.both_sides, materials.reflectance, lit, reflectance)
        for index, texture in tracer._textures.items():
            rows = np.flatnonzero(found.surface == index)
            if len(rows):
                kernels.scale_rows(rows, texture(found.points.take(rows, axis=0)), reflectance)
        mirrored = kernels.mirror(found.directions, found.shading, found.facing, found.surface, materials.mirrors)
        return lit, reflectance, mirrored

    def diffuse_ends(self, wave: _Wave) -> tuple[FloatArray, list[tuple[NDArray, ...]]]:
        """Radiance (n, bands) beside what diffuse surfaces reflect, and these: columns of :class:`DiffuseEnds`."""
        tracer, materials = self.tracer, self.tracer._materials
        radiance = np.zeros((len(wave.sample), tracer.bands))
        throughput = np.ones_like(radiance)
        ends: list[tuple[NDArray, ...]] = []
        for depth in range(tracer.options.depth + 1):
            found = self._hits(wave, depth)
            missed = np.ones(len(wave.sample), dtype=bool)
            missed[found.ray] = False
            np.add.at(radiance, wave.sample[missed], throughput[missed] * tracer.beyond(wave.directions[missed]))
            throughput = throughput[found.ray]
            lit, reflectance, mirrored = self._begin(found)
            leaving = np.empty_like(throughput)
            kernels.sent_unlit(found.surface, lit, reflectance, materials.radiance, tracer._ambient, leaving)
            shiny = lit & (materials.highlight_exponent[found.surface] >= 0.0)
            if shiny.any():
                self._light(wave, found, shiny, np.zeros_like(reflectance), mirrored, leaving, highlights_only=True)
            np.add.at(radiance, found.sample, throughput * leaving)
            rows = np.flatnonzero(lit & reflectance.any(axis=1))
            ends.append(
                (
                    found.sample[rows], found.points[rows], found.shading[rows], found.facing[rows],
                    found.surface[rows].astype(np.int64), found.polygon[rows], found.front[rows],
                    np.full(len(rows), depth), throughput[rows], reflectance[rows],
                )
            )  # fmt: skip
            if depth == tracer.options.depth:
                break
            copies = tracer.options.bundle if depth == 0 else 1
            reflecting, passing = self._leading_on(found, lit)
            wave = self._next_wave(wave, found, reflecting, passing, mirrored, copies)
            shares = [
                throughput[rows] * share[found.surface[rows]] / copies
                for rows, share in ((reflecting, materials.specular), (passing, materials.transmittance))
            ]
            throughput = np.repeat(np.concatenate(shares), copies, axis=0)
            if len(throughput) == 0:
                break
        return radiance, ends

    # ---- hits

    def _hits(self, wave: _Wave, depth: int) -> _Found:
        tracer = self.tracer
        count = len(wave.sample)
        t = np.full(count, np.inf)
        points, facing, shading = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 3))
        front = np.zeros(count, dtype=bool)
        polygon = np.full(count, NO_POLYGON, dtype=np.int64)

        def locate(rows: IntArray, must_contain: bool) -> None:
            kernels.locate(
                rows, wave.origins, wave.directions, polygon, tracer._first_triangle, tracer._triangles,
                tracer._corner_normals, must_contain, tracer.offset, t, points, facing, shading, front,
            )  # fmt: skip

        rest = np.arange(count)
        if depth == 0 and self.guided is not None and "cast" in self.guided.guide.options.components:
            polygon[:] = self.guided.guide.polygon[self.guided.row]
            tried = np.flatnonzero(polygon != NO_POLYGON)
            locate(tried, True)
            self.tally.cast.assumed += len(tried)
            rest = np.flatnonzero(np.isinf(t))
            self.tally.cast.saved += count - len(rest)
            self.tally.cast_misguided += len(tried) - (count - len(rest))
        if len(rest):
            whole = len(rest) == count
            start = wave.origins if whole else wave.origins[rest]
            along = wave.directions if whole else wave.directions[rest]
            if depth == 0 and self.met is not None:
                polygon[:] = self.met
            else:
                polygon[rest] = tracer._all.nearest_raw(*kernels.unit_rays(start, along, *tracer._all.frame))
            if depth == 0:
                self.tally.cast.shot += len(rest)
            met = rest[polygon[rest] != NO_POLYGON]
            locate(met, False)
            if not tracer.options.see_backs:
                self._pass_backs(wave, met, t, polygon, front, locate)
        surface = tracer._surface[polygon]
        if depth == 0:
            self.surface[:] = surface
            if self.record is not None:
                self.record.polygon[:] = polygon
        ray = np.flatnonzero(np.isfinite(t))
        if depth == 0:
            self.tally.cast_hits += len(ray)
        agreed, pixel = np.zeros(len(ray), dtype=bool), np.empty(0, dtype=np.int64)
        parts = (surface, polygon, points, facing, shading, front, wave.directions, wave.sample, wave.node)
        if len(ray) < count:
            parts = tuple(part.take(ray, axis=0) for part in parts)  # type: ignore[assignment]
        surface, polygon, points, facing, shading, front, directions, sample, node = parts
        if self.guided is not None:
            guide = self.guided.guide
            pixel = self.guided.row[sample]
            kernels.agreement(pixel, node, surface, shading, guide.surface, guide.normal, guide.cosine, agreed)
        return _Found(ray, surface, polygon, points, facing, shading, front, directions, sample, node, pixel, agreed)

    def _pass_backs(
        self,
        wave: _Wave,
        met: IntArray,
        t: FloatArray,
        polygon: IntArray,
        front: NDArray[np.bool_],
        locate: Callable[[IntArray, bool], None],
    ) -> None:
        """Lead rays that met the back of a one-sided surface on to what is behind."""
        tracer = self.tracer
        one_sided = np.append(~tracer._materials.both_sides, False)
        # Doubled each time: a ray that grazes a back must not meet it for ever.
        step = tracer.offset
        while True:
            behind = met[np.isfinite(t[met]) & ~front[met] & one_sided[tracer._surface[polygon[met]]]]
            if len(behind) == 0:
                return
            gone = t[behind] + step
            step *= 2.0
            start = wave.origins[behind] + gone[:, None] * wave.directions[behind]
            hits = tracer._all.closest_hit(start, wave.directions[behind])
            polygon[behind] = hits.polygon
            t[behind] = np.inf
            met = behind[hits.polygon != NO_POLYGON]
            locate(met, False)

    def _note_surfaces(self, wave: _Wave, found: _Found) -> None:
        assert self.record is not None
        recorded = wave.node >= 0
        self.record.surface[wave.sample[recorded], wave.node[recorded]] = NO_SURFACE
        met = found.node >= 0
        self.record.surface[found.sample[met], found.node[met]] = found.surface[met]
        if self.record.normal is not None:
            self.record.normal[found.sample[met], found.node[met]] = found.shading[met]

    # ---- lights

    def _light(
        self,
        wave: _Wave,
        found: _Found,
        lit: NDArray[np.bool_],
        reflectance: FloatArray,
        mirrored: FloatArray,
        leaving: FloatArray,
        highlights_only: bool = False,
    ) -> None:
        """Add the light of every light to ``leaving`` (n, bands); or of those only that make highlights."""
        tracer, count = self.tracer, len(found.ray)
        keys = wave.keys[found.ray] if tracer.options.jitter else wave.keys[:0]
        at = _Shading(keys, lit, reflectance, mirrored, leaving)
        assumed = np.full(count, COMPLEX_SHADOW, dtype=np.uint8)
        recorded = found.node >= 0
        for index, light in enumerate(tracer._lights):
            if highlights_only and not light.highlight:
                continue
            if self.guided is not None:
                kernels.assume(found.agreed, found.pixel, found.node, self.guided.guide.state, index, assumed)
            send = self._soft_light if light.senders else self._light_by_rays
            states, seen, shot = send(light, index, found, at, assumed)
            tally = self.tally.shadows[index]
            tally.shot += shot
            if self.record is not None:
                self.record.state[found.sample[recorded], found.node[recorded], index] = states[recorded]
            if self.guided is not None:
                points, spared = kernels.count_spared(assumed, lit, seen, found.sample, self.saved)
                tally.assumed += points
                tally.saved += spared

    def _light_by_rays(
        self, light: _Emitter, index: int, found: _Found, at: _Shading, assumed: NDArray[np.uint8]
    ) -> tuple[NDArray[np.uint8], IntArray, int]:
        """Add one light by a ray a sample of it; returns states, samples above each horizon, and rays shot."""
        tracer, count, materials = self.tracer, len(found.ray), self.tracer._materials
        states = np.empty(count, dtype=np.uint8)
        seen, out_of_cone = np.empty(count, dtype=np.int64), np.empty(count, dtype=bool)
        room = self._room(count * light.samples)
        targets, axes = self._targets(light, index, at.keys)
        rays = kernels.light_rays(
            light.law, targets, axes, light.scale, light.cosine_cut, light.spot_exponent, light.falls,
            light.highlight, light.power, tracer.offset, *tracer._opaque.frame,
            found.points, found.facing, found.shading, at.mirrored, materials.highlight_exponent, at.lit, assumed,
            at.reflectance, materials.specular, found.surface,
            at.leaving, seen, out_of_cone, *room,
        )  # fmt: skip
        origin, along, weight, lobe_weight, owner = room
        through = tracer.transmitted(origin[:rays], along[:rays])
        kernels.gather_light(
            rays, through, weight, lobe_weight, owner, light.power, at.reflectance, materials.specular,
            found.surface, assumed, out_of_cone, at.leaving, states,
        )  # fmt: skip
        return states, seen, rays

    def _room(self, size: int) -> tuple[NDArray[np.float32], NDArray[np.float32], FloatArray, FloatArray, IntArray]:
        """Room for shadow rays, kept from light to light: origins, directions, weights (two), owners."""
        if self._kept is None or len(self._kept[-1]) < size:
            self._kept = (
                np.empty((size, 3), np.float32), np.empty((size, 3), np.float32),
                np.empty(size), np.empty(size), np.empty(size, dtype=np.int64),
            )  # fmt: skip
        return self._kept

    def _soft_light(
        self, light: _Emitter, index: int, found: _Found, at: _Shading, assumed: NDArray[np.uint8]
    ) -> tuple[NDArray[np.uint8], IntArray, int]:
        """Add one light as the shadow module finds it; returns as :meth:`_light_by_rays`, a point counting 1.

        Highlights are sampled along the light: without rays where all or none of it is seen.
        """
        tracer = self.tracer
        states = np.where(assumed == COMPLEX_SHADOW, INSHADOW, assumed).astype(np.uint8)
        received = np.zeros_like(at.reflectance)
        open_rows = np.flatnonzero(at.lit & (assumed == NOT_INSHADOW))
        if len(open_rows):
            points, normals = found.points[open_rows], found.shading[open_rows]
            received[open_rows] = sum(sender.irradiance(points, normals) for sender in light.senders)
        asked = np.flatnonzero(at.lit & (assumed == COMPLEX_SHADOW))
        if len(asked):
            assert tracer._shader is not None
            # Not "auto": its smooth fits are for receivers side by side on a plane, these lie scattered.
            estimate = tracer._shader.estimate(
                found.points[asked], found.shading[asked], light.senders, "shaft",
                samples=math.ceil((NOISE / tracer.options.shadow_error) ** (4.0 / 3.0)),
                seed=tracer.options.seed, own_polygon=found.polygon[asked],
            )  # fmt: skip
            received[asked] = estimate.irradiance
            states[asked] = _joined(estimate)
        np.add(at.leaving, at.reflectance * (received / np.pi), out=at.leaving)
        if light.highlight:
            shiny = at.lit & (tracer._materials.highlight_exponent[found.surface] >= 0.0)
            if shiny.any():
                glossy = replace(at, lit=shiny, reflectance=np.zeros_like(at.reflectance))
                self._light_by_rays(light, index, found, glossy, states)
        return states, at.lit.astype(np.int64), len(asked)

    def _targets(self, light: _Emitter, index: int, keys: NDArray[np.uint64]) -> tuple[FloatArray, FloatArray]:
        if light.law in (kernels.POINT, kernels.DIRECTIONAL):
            return light.corners[:, :1], light.normals[None]
        jitter = self.tracer.options.jitter
        shape = (len(keys) if jitter else 1, light.samples, 3)
        targets, axes = np.empty(shape), np.empty(shape)
        kernels.light_targets(
            light.law, light.corners, light.cumulative, light.normals, keys, 1000 + 2 * index, light.samples, jitter,
            targets, axes,
        )  # fmt: skip
        return targets, axes

    # ---- reflection and refraction

    def _go_on(
        self,
        wave: _Wave,
        found: _Found,
        lit: NDArray[np.bool_],
        mirrored: FloatArray,
        leaving: FloatArray,
        depth: int,
    ) -> None:
        """Add what reflected and refracted rays bring, all of them one wave."""
        materials = self.tracer._materials
        reflecting, passing = self._leading_on(found, lit)
        copies = self.tracer.options.bundle if depth == 0 else 1
        if self.guided is not None:
            reflecting = self._interpolate("reflection", found, reflecting, leaving, copies)
            passing = self._interpolate("refraction", found, passing, leaving, copies)
        if len(reflecting) + len(passing) == 0:
            return
        both = self._next_wave(wave, found, reflecting, passing, mirrored, copies)
        brought = self.follow(both, depth + 1)
        if copies > 1:
            brought = brought.reshape(-1, copies, self.tracer.bands).mean(axis=1)
        for name, rows, values, share in (
            ("reflected", reflecting, brought[: len(reflecting)], materials.specular),
            ("refracted", passing, brought[len(reflecting) :], materials.transmittance),
        ):
            if len(rows) == 0:
                continue
            kernels.add_share(rows, found.surface, share, values, leaving)
            if self.record is not None:
                node = found.node[rows]
                recorded = node >= 0
                getattr(self.record, name)[found.sample[rows[recorded]], node[recorded]] = values[recorded]

    def _leading_on(self, found: _Found, lit: NDArray[np.bool_]) -> tuple[IntArray, IntArray]:
        """Rows of the hits that reflect, and of those that let light pass."""
        materials = self.tracer._materials
        reflecting = np.flatnonzero(materials.mirrors.take(found.surface) & lit)
        if self.tracer._panes is None:
            return reflecting, np.empty(0, dtype=np.int64)
        return reflecting, np.flatnonzero(materials.clear.take(found.surface))

    def _next_wave(
        self, wave: _Wave, found: _Found, reflecting: IntArray, passing: IntArray, mirrored: FloatArray, copies: int
    ) -> _Wave:
        """Reflected rays, then refracted ones, ``copies`` of each row."""
        materials = self.tracer._materials
        self.tally.reflection.shot += len(reflecting) * copies
        self.tally.refraction.shot += len(passing) * copies
        reflected = self._next(
            wave, found, reflecting, mirrored.take(reflecting, axis=0), np.ones(len(reflecting)), 1, copies
        )
        if len(passing) == 0:
            return reflected
        bent, inside = kernels.refract(
            found.directions[passing], found.shading[passing], found.facing[passing], found.front[passing],
            materials.ior[found.surface[passing]],
        )  # fmt: skip
        refracted = self._next(wave, found, passing, bent, np.where(inside, 1.0, -1.0), 2, copies)
        return _Wave(
            *(np.concatenate([getattr(w, part.name) for w in (reflected, refracted)]) for part in fields(_Wave))
        )

    def _next(
        self,
        wave: _Wave,
        found: _Found,
        rows: IntArray,
        along: FloatArray,
        side: FloatArray,
        branch: int,
        copies: int,
    ) -> _Wave:
        """The reflected (``branch`` 1) or refracted (2) rays of some hits; ``side`` is -1 for those that go through."""
        tracer = self.tracer
        start, keys, sample, node = kernels.next_rays(
            rows, found.points, found.facing, side, tracer.offset, wave.keys, found.ray, found.sample, found.node,
            branch, tracer.branching, self.nodes,
        )  # fmt: skip
        if tracer.options.bundle > 1:
            exponents = tracer._materials.exponent[found.surface[rows]]
            along = kernels.lobe(along, exponents, found.facing[rows], keys, copies)
        if copies > 1:
            # A bundle has no one node below it.
            return _Wave(
                np.repeat(start, copies, axis=0), along, kernels.child_keys(keys, 3, copies),
                np.repeat(sample, copies), np.full(len(rows) * copies, -1),
            )  # fmt: skip
        return _Wave(start, along, keys, sample, node)

    def _interpolate(self, component: str, found: _Found, rows: IntArray, leaving: FloatArray, copies: int) -> IntArray:
        """Add what may be interpolated between the corners; returns the rows that need a ray."""
        assert self.guided is not None
        guide, materials = self.guided.guide, self.tracer._materials
        if len(rows) == 0 or component not in guide.options.components:
            return rows
        if component == "reflection":
            spread, values, share = guide.reflection_spread, guide.trees.reflected, materials.specular
        else:
            spread, values, share = guide.refraction_spread, guide.trees.refracted, materials.transmittance
        left = np.empty(len(rows), dtype=np.int64)
        count = kernels.interpolate(
            rows, found.agreed, found.sample, found.pixel, found.node, found.surface, share, spread, values,
            guide.corners, self.guided.x, self.guided.y, guide.options.similar, leaving, left,
        )  # fmt: skip
        tally: ComponentCount = getattr(self.tally, component)
        tally.assumed += len(rows) - count
        tally.saved += (len(rows) - count) * copies
        return left[:count]
