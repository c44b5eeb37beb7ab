"""The final gather: a picture's direct light pixel by pixel, its indirect light from a coarse solution.

Each ray from the eye ends on diffuse surfaces; neighbouring ends of a pixel on one surface are one
*fragment*.  A fragment's direct light is found by the shadow module: in closed form where nothing
lies between (NOT_INSHADOW), zero in shadow (INSHADOW), cut exactly or sampled where Woo's state is
COMPLEX_SHADOW.  Indirect irradiance is gathered by hemisphere bundles that read the solution at
their hits, but only at *nodes*: *atomic adaptive sampling* (A. Woo, IEEE CG&A 13(5), 1993) carried
to components of a gather.  Nodes begin on a coarse lattice of blocks of pixels; a block is cut in
four, for this component alone, where its nodes disagree with what their neighbours on the same sheet
foretell, or stand nearer to what lights them than they stand to each other (the harmonic mean
distance of an irradiance cache: G. J. Ward, F. M. Rubinstein and R. D. Clear, SIGGRAPH 1988).
Irradiance is interpolated, never radiance: reflectance multiplies last.
"""

from __future__ import annotations

import copy
import math
import os
import pickle
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from radiosity import _picture_kernels as kernels
from radiosity.element_lookup import element_gradients
from radiosity.regather import regathered
from radiosity.sensors import Direct, DirectLight, Gatherer, allotted
from radiosity.solvers.solution import Solution
from workbench.accel.base import NO_POLYGON
from workbench.arrays import as_fraction
from workbench.counters import Counters
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.memory import require_memory
from workbench.render._trace_kernels import locate
from workbench.render.camera import PinholeRays
from workbench.render.trace import TraceOptions, Tracer, corner_normals
from workbench.sampling.sequences import sobol
from workbench.scene.model import Scene

__all__ = ["GatherOptions", "Picture", "PictureGatherer"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CURVED = 64
"""Faces from which a surface is one sheet, whatever the planes of its facets."""
NEIGHBOURS = 10
"""Nodes between which indirect irradiance is interpolated."""
APART = 1e6
"""Distance between sheets in the tree of nodes. [pixels]"""
STEP = 0.1
"""Relative step of radiance inside a pixel from which it is sampled inside."""
TURN = 2.0
"""Relative second difference of direct light between pixels, as a multiple of the error, from which it is too."""
TRUSTED = 0.05
"""Error from which a pixel whose corners saw one polygon is taken to show it in its middle, without a ray."""
MOST_TURN = 0.2
FIRST_PLACES, MOST_PLACES = (4, 8), 4096
"""Rays from the eye in a pixel that shows an edge, before it is known how many it needs (first where the error is
:data:`TRUSTED` or more), and the most of them."""
INSIDE_ERROR = (0.55, 0.35)
"""Share of the error that edges in pixels may make, first where the error is :data:`TRUSTED` or more."""
NET_ERROR = 0.6
"""n rays in a pixel leave this, times n^-3/4, of their standard deviation (measured)."""
PIXEL_ERROR = 4.0
"""Error of any one of these pixels, as a multiple of the picture's: more would show as specks."""
INSIDE_ROUNDS, GROWTH = 4, 8
"""Rounds in which such rays are added, and how many times as many a pixel has after one."""
CORNER_SHARE = 0.25
"""A pixel's rays vary by this share of what its corners' radiance varies by, before they tell themselves."""
POOL = 4.0
"""Rays for which the mean spread of all pixels counts in that of one."""
DIRECT_SHARE = 4
"""Of so many rays in a subdivided pixel one is a place at which direct light is found; all where that has an edge."""
SPACING, SPACED_FOR = 0.5, 0.02
"""Nodes stand no further apart than this share of the harmonic mean distance to what lights them, for this error or a
smaller one; as the root of the error beyond, for interpolation errs as the square of the step."""
PILOT_RAYS = (16, 128)
"""Rays of a bundle before it is known how many are needed: as many as 0.03 of error needs, within these."""
NODE_ERROR = 1.0
"""Standard error of a node, as a share of the picture's error: a fit averages over a few nodes."""
INSIDE_TURN = 12.0
"""Second difference of all light between pixels, relative to what the pixel shows and as a multiple of the error, from
which indirect light is gathered at several places inside the pixel."""
INSIDE_SPREAD = 0.5
"""Standard deviation inside a pixel, as a share of that difference, by which these places are counted."""
INSIDE_PLACES = (8, 32)
"""Least and most of them."""
SHARP = 0.5
"""A node speaks for itself where it is off the fit by more than its standard error and this share of the error."""
NOISE = 2.5
"""Standard errors of a node by which it may differ from what was foretold without being uneven."""
TILE = 256
"""Side of a tile. [pixels]"""
RAYS_AT_ONCE = 1 << 19
"""Ends of rays from the eye that are held at once inside pixels: more cost gigabytes, and time for them."""
TILES_IN_MEMORY = 8
_PIXEL_BYTES = 16000
"""Memory that a pixel of a tile takes while it is drawn, edges counted."""
CHECKED, CHECKED_OF = (128, 512), 32
"""Pixels of a picture that are drawn again to tell its error: one of 32, within these."""
STEPS = (0.05, 4.0)
"""Relative steps to a neighbour, clipped to these, by which they are chosen."""
CHECK_SHARE = 0.5
"""Standard error of these, as a share of the picture's error."""
DEPTH = 6
"""Reflections and refractions in a row."""
FUZZY_DEPTH = 3
"""The same in scenes with fuzzy reflections."""


@dataclass(frozen=True)
class GatherOptions:
    """How well to gather.

    Parameters
    ----------
    error : float
        Wanted error: root mean square over the pixels of each one's relative error.
    rays : int, optional
        Rays of each hemisphere bundle; as many as ``error`` needs unless given.
    atomic : bool
        Interpolate indirect irradiance between nodes; otherwise every fragment is gathered.
    indirect : bool
        Off: direct light only.
    see_backs : bool
        Whether one-sided faces are seen from behind, black; otherwise the eye looks through them,
        and only the eye: light is blocked all the same.
    """

    error: float = 0.02
    rays: int | None = None
    atomic: bool = True
    indirect: bool = True
    see_backs: bool = False

    def __post_init__(self) -> None:
        as_fraction(self.error, "error")
        if self.rays is not None and not 1 <= self.rays <= 65536:
            raise OptionError(f"rays: found {self.rays}, expected 1 to 65536")

    @property
    def pilot_rays(self) -> int:
        """Rays of a bundle before it is known how many are needed."""
        return int(
            np.clip(2 ** round(math.log2(PILOT_RAYS[1]) + 4.0 / 3.0 * math.log2(0.03 / self.error)), *PILOT_RAYS)
        )

    @property
    def passes(self) -> int:
        """Rounds in which the solution is gathered again, see :func:`radiosity.regather.regathered`."""
        return int(np.clip(round(math.log2(0.32 / self.error)), 1, 6))

    @property
    def fuzzy_rays(self) -> int:
        """Rays of a fuzzy reflection."""
        return int(np.clip(2 ** round(math.log2(16 * 0.02 / self.error)), 4, 64))

    @property
    def fuzzy_places(self) -> int:
        """Rays from the eye, at first, in a pixel that shows an edge or a speck of a fuzzy reflection."""
        return int(np.clip(2 ** round(math.log2(1.28 / self.error)), 16, 512))

    @property
    def check_places(self) -> int:
        """Rays from the eye in a pixel that is drawn again to tell the error."""
        return int(np.clip(2 ** round(math.log2(2.56 / self.error)), 32, 1024))


@dataclass
class _Fragments:
    """What the rays of one pixel see of one sheet, a row each.

    ``sheet`` numbers what irradiance is continuous on: a plane, or a curved surface, seen directly
    or by one and the same first mirror.  ``x, y`` are places in the picture, ``footprint`` is the size
    of a pixel there, and ``gain`` (n, bands) what irradiance is multiplied by in the pixel.
    """

    pixel: IntArray
    sheet: IntArray
    polygon: IntArray
    x: FloatArray
    y: FloatArray
    points: FloatArray
    normals: FloatArray
    footprint: FloatArray
    gain: FloatArray

    def __len__(self) -> int:
        return len(self.pixel)

    @classmethod
    def none(cls, bands: int) -> _Fragments:
        whole, nothing, places = np.empty(0, dtype=np.int64), np.empty(0), np.empty((0, 3))
        return cls(whole, whole, whole, nothing, nothing, places, places, nothing, np.empty((0, bands)))

    def take(self, rows: NDArray) -> _Fragments:
        return _Fragments(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @staticmethod
    def joined(parts: list[_Fragments]) -> _Fragments:
        names = _Fragments.__dataclass_fields__
        return _Fragments(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass
class _Seen:
    """What rays from the eye met: radiance (n, bands) that needs no gather and the part of it without fuzzy
    reflections, a mark (n,) by which rays that saw the same sheets are alike, fragments, of which ``ray`` tells
    the ray, in the order of the rays, each ray's ``polygon`` (n,) where it is known, and whether a fuzzy reflection
    is the first thing that it met (n,)."""

    radiance: FloatArray
    steady: FloatArray
    mark: IntArray
    fragments: _Fragments
    ray: IntArray
    polygon: IntArray
    fuzzy: NDArray[np.bool_]


@dataclass(frozen=True)
class _Plain:
    """A scene where no ray from the eye leads on, as kernels read it."""

    triangles: FloatArray
    first_triangle: IntArray
    corner_normals: FloatArray
    one_sided: NDArray[np.bool_]
    both_sides: NDArray[np.bool_]
    reflectance: FloatArray
    emitted: FloatArray

    @classmethod
    def build(cls, scene: Scene, geometry: Geometry) -> _Plain:
        triangles, piece = geometry.triangles
        both = np.array([surface.material.two_sided for surface in scene.surfaces])
        rows = [(surface.material.reflectance, surface.material.emission) for surface in scene.surfaces]
        reflectance, emission = np.array(rows).transpose(1, 0, 2)
        return cls(
            triangles,
            np.searchsorted(geometry.piece_polygon[piece], np.arange(geometry.polygon_count + 1)),
            corner_normals(scene, geometry),
            ~both[geometry.polygon_surface],
            both,
            np.ascontiguousarray(reflectance),
            emission / math.pi,
        )


class PictureGatherer:
    """A solution made ready to be drawn, or a scene's direct light alone.

    Parameters
    ----------
    source : Solution or DirectLight
        A solution with its scene, of 1 or 3 bands; from direct light alone there is no indirect light.  A
        :class:`radiosity.sensors.Gatherer` is taken as it is.
    options : GatherOptions, optional
    workers : int, optional
        Threads, all cores by default; the picture does not depend on it.  Those of direct light that is given.
    seed : int
        Of the rays.

    Raises
    ------
    OptionError
        If indirect light or a sky is wanted without a solution.
    """

    def __init__(
        self,
        source: Solution | DirectLight,
        options: GatherOptions | None = None,
        *,
        workers: int | None = None,
        seed: int = 0,
    ) -> None:
        self.options = options or GatherOptions()
        self.gatherer: DirectLight
        if isinstance(source, DirectLight):
            self.gatherer = source
        else:
            self.gatherer = Gatherer(source, workers=workers, seed=seed)
        if not isinstance(self.gatherer, Gatherer):
            if self.options.indirect:
                raise OptionError("indirect: found True without a solution, expected one; solve the scene first")
            if self.gatherer.sky is not None:
                raise OptionError("source: found a scene with a sky, expected a solution of it; solve it first")
        elif self.options.indirect and self.options.passes:
            self.gatherer = regathered(
                self.gatherer.solution, passes=self.options.passes, error=self.options.error, gatherer=self.gatherer,
                seed=seed,
            )  # fmt: skip
        self.scene, self.geometry = self.gatherer.scene, self.gatherer.geometry
        self.workers, self.seed = self.gatherer.workers, seed
        self.bands = self.scene.bands
        materials = [surface.material for surface in self.scene.surfaces]
        # With a last row for rays that met nothing.
        self._fuzzy = np.array([m.specular.any() and math.isfinite(m.exponent) for m in materials] + [False])
        self._leads_on = any(m.specular.any() or m.transmittance.any() for m in materials)
        self.rays_each = self.options.fuzzy_rays if self._fuzzy.any() else 1
        self._sheets = _sheets(self.geometry)
        self._known: dict[int, int] = {}
        self._slopes: FloatArray | None = None
        self._places = sobol(MOST_PLACES, np.random.default_rng(seed))
        self.ambient = self._ambient()

    @property
    def elements_read(self) -> int:
        """Elements of the mesh that bundles read."""
        return self.gatherer.solution.mesh.element_count if isinstance(self.gatherer, Gatherer) else 0

    @cached_property
    def _tracer(self) -> Tracer:
        fuzzy = bool(self._fuzzy.any())
        return Tracer(
            self.scene,
            TraceOptions(
                depth=FUZZY_DEPTH if fuzzy else DEPTH if self._leads_on else 0,
                bundle=self.rays_each,
                see_backs=self.options.see_backs,
                seed=self.seed,
            ),
            workers=self.workers,
        )

    @cached_property
    def _plain(self) -> _Plain:
        return _Plain.build(self.scene, self.geometry)

    def _ambient(self) -> FloatArray:
        """Mean indirect irradiance (bands,), about: all of it, less what emitters send. [W m-2]"""
        if not (self.options.indirect and isinstance(self.gatherer, Gatherer)):
            return np.zeros(self.bands)
        solution = self.gatherer.solution
        mesh = solution.mesh
        share = mesh.element_area / mesh.element_area.sum()
        return np.maximum(share @ (solution.element_irradiance - mesh.emission), 0.0)

    def _read(self, points: FloatArray, polygon: IntArray, front: NDArray[np.bool_]) -> FloatArray:
        """Irradiance (n, bands) of the solution at points of polygons. [W m-2]"""
        assert isinstance(self.gatherer, Gatherer)
        solution, lookup = self.gatherer.solution, self.gatherer.lookup
        if self._slopes is None:
            self._slopes = element_gradients(solution.mesh, lookup, solution.element_irradiance)
        element = lookup.elements(points, polygon, front)
        known = np.maximum(element, 0)
        off = points - solution.mesh.element_centroid[known]
        found = solution.element_irradiance[known] + np.einsum("nbk,nk->nb", self._slopes[known], off)
        return np.where(element[:, None] >= 0, np.maximum(found, 0.0), 0.0)

    def _numbered(self, code: IntArray) -> IntArray:
        """Small numbers for the codes of sheets, the same for the same code in all tiles."""
        distinct, place = np.unique(code, return_inverse=True)
        for each in distinct.tolist():
            self._known.setdefault(each, len(self._known))
        return np.array([self._known[each] for each in distinct.tolist()], dtype=np.int64)[place.ravel()]

    def _checking(self) -> PictureGatherer:
        """One that draws single pixels with more care, and looks where hits read the solution at what is true there."""
        other = copy.copy(self)
        other.options = replace(self.options, error=CHECK_SHARE / NODE_ERROR * self.options.error, rays=None)
        other.seed = self.seed + 104_729
        if isinstance(self.gatherer, Gatherer):
            other.gatherer = self.gatherer.doubting()
        other._places = sobol(MOST_PLACES, np.random.default_rng(other.seed))
        return other

    def draw(self, rays: PinholeRays) -> Picture:
        """The whole picture at once."""
        picture = Picture(self, rays)
        for _ in picture.steps():
            pass
        return picture

    def look(
        self, rays: PinholeRays, x: FloatArray, y: FloatArray, pixel: IntArray, keys: IntArray,
        known: IntArray | None = None,
    ) -> _Seen:  # fmt: skip
        """Follow rays through places of the picture to the diffuse surfaces that they see.

        ``known`` (n,) are polygons that the rays meet, -1 where that is not known; only where no ray leads on.
        """
        if not self._leads_on:
            return self._look_plainly(rays, x, y, pixel, known)
        along = rays.directions(x, y)
        ends = self._tracer.trace_to_diffuse(rays.eye, along, keys=keys)
        radiance, steady = ends.radiance.copy(), ends.radiance
        gain = ends.throughput * ends.reflectance / math.pi
        keep = np.arange(len(ends.ray))
        sheet = 2 * self._sheets[ends.polygon] + ~ends.front
        met = self.gatherer.shader.tracer.closest_hit(rays.eye, along).polygon
        first = np.where(met >= 0, self.geometry.polygon_surface[met], -1)
        mirror = first[ends.ray]
        read = (ends.depth > 0) & self._fuzzy[mirror]
        if read.any() and self.options.indirect:
            # Many rays of a lobe, each of little weight: they read the solution, as bundles do.
            light = self._read(ends.points[read], ends.polygon[read], ends.front[read])
            np.add.at(radiance, ends.ray[read], gain[read] * light)
            keep = np.flatnonzero(~read)
        # Behind a mirror: another sheet for each mirror and each number of reflections.
        behind = np.where(ends.depth > 0, (mirror + 1) * (DEPTH + 1) + ends.depth, 0)
        sheet = self._numbered(sheet + behind * (2 * int(self._sheets.max(initial=0)) + 2))
        names = ("ray", "points", "normals", "facing", "surface", "polygon")
        ends = replace(ends, **{name: getattr(ends, name)[keep] for name in names})
        sheet, gain = sheet[keep], gain[keep]
        toward = ends.points - rays.eye
        distance = np.linalg.norm(toward, axis=1)
        cosine = np.abs(np.einsum("ij,ij->i", toward, ends.facing)) / np.maximum(distance, 1e-300)
        pixel_size = float(np.linalg.norm(rays.right))
        fragments = _Fragments(
            pixel[ends.ray], sheet, ends.polygon, x[ends.ray], y[ends.ray], ends.points, ends.normals,
            distance * pixel_size / np.sqrt(np.maximum(cosine, 1e-3)), gain,
        )  # fmt: skip
        # What a ray saw is the sum of hashes of surfaces and sheets.
        mark = np.zeros(len(x), dtype=np.uint64)
        code = (sheet * (len(self.scene.surfaces) + 1) + ends.surface + 1).astype(np.uint64)
        np.add.at(mark, ends.ray, code * np.uint64(0x9E3779B97F4A7C15) ^ (code >> np.uint64(7)))
        order = np.argsort(ends.ray, kind="stable")
        return _Seen(
            radiance, steady, mark.astype(np.int64), fragments.take(order), ends.ray[order],
            np.full(len(x), NO_POLYGON, dtype=np.int64), self._fuzzy[first],
        )  # fmt: skip

    def _look_plainly(
        self, rays: PinholeRays, x: FloatArray, y: FloatArray, pixel: IntArray, known: IntArray | None
    ) -> _Seen:
        """:meth:`look` where no ray leads on: nothing mirrors, nothing lets light through."""
        plain, geometry, tracer = self._plain, self.geometry, self.gatherer.shader.tracer
        n = len(x)
        along, points, facing, shading = (np.empty((n, 3)) for _ in range(4))
        t, front = np.full(n, np.inf), np.zeros(n, dtype=bool)
        polygon = np.full(n, NO_POLYGON, dtype=np.int64) if known is None else known
        view = (rays.eye, rays.corner, rays.right, rays.down)

        def work(part: slice) -> None:
            toward, mine = along[part], polygon[part]
            starts, directions = np.empty(toward.shape, np.float32), np.empty(toward.shape, np.float32)
            kernels.eye_rays(*view, x[part], y[part], *tracer.frame, toward, starts, directions)
            wanted = np.flatnonzero(mine == NO_POLYGON)
            if len(wanted) == len(mine):
                mine[:] = tracer.nearest_raw(starts, directions)
            elif len(wanted):
                mine[wanted] = tracer.nearest_raw(starts[wanted], directions[wanted])
            eyes = np.broadcast_to(rays.eye, toward.shape)
            table = (plain.first_triangle, plain.triangles, plain.corner_normals)
            spread = (t[part], points[part], facing[part], shading[part], front[part])

            def find(rows: IntArray) -> None:
                locate(rows, eyes, toward, mine, *table, False, tracer.offset, *spread)

            met = np.flatnonzero(mine != NO_POLYGON)
            find(met)
            if not self.options.see_backs:
                # On through the backs of one-sided surfaces, in steps that double: a ray that grazes a back
                # must not meet it for ever.
                step = tracer.offset
                while len(met):
                    met = met[np.isfinite(spread[0][met]) & ~spread[4][met] & plain.one_sided[mine[met]]]
                    if not len(met):
                        break
                    gone = spread[0][met] + step
                    step *= 2.0
                    mine[met] = tracer.closest_hit(rays.eye + gone[:, None] * toward[met], toward[met]).polygon
                    spread[0][met] = np.inf
                    met = met[mine[met] != NO_POLYGON]
                    find(met)

        self.gatherer.in_blocks(work, n)
        radiance, mark = np.zeros((n, self.bands)), np.empty(n, dtype=np.int64)
        ray, sheet = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
        footprint, gain = np.empty(n), np.empty((n, self.bands))
        many = kernels.plain_ends(
            along, polygon, t, facing, front, geometry.polygon_surface, plain.both_sides, plain.reflectance,
            plain.emitted, self.scene.background, self._sheets, float(np.linalg.norm(rays.right)), radiance, mark, ray,
            sheet, footprint, gain,
        )  # fmt: skip
        if self.gatherer.sky is not None:
            missed = np.flatnonzero(~np.isfinite(t))
            if len(missed):
                radiance[missed] = self.gatherer.sky.radiance(along[missed])
        ray = ray[:many]
        rows = ray if many < n else slice(None)
        fragments = _Fragments(
            pixel[rows], sheet[:many], polygon[rows], x[rows], y[rows], points[rows], shading[rows], footprint[:many],
            gain[:many],
        )  # fmt: skip
        return _Seen(radiance, radiance, mark, fragments, ray, polygon, np.zeros(n, dtype=bool))


def _sheets(geometry: Geometry) -> IntArray:
    """Number of each polygon's sheet: its plane, or its surface where that is curved."""
    first = geometry.corners[geometry.piece_start[geometry.polygon_piece_start[:-1]]]
    level = np.einsum("ij,ij->i", geometry.polygon_normal, first) / geometry.size
    key = np.column_stack([np.rint(geometry.polygon_normal * 1e6), np.rint(level * 1e6)])
    sheet = np.unique(key, axis=0, return_inverse=True)[1].ravel()
    faces = np.bincount(geometry.polygon_surface, minlength=len(geometry.surface_name))
    curved = faces[geometry.polygon_surface] >= CURVED
    return np.where(curved, int(sheet.max(initial=0)) + 1 + geometry.polygon_surface, sheet)


@dataclass
class _Nodes:
    """Where indirect irradiance was gathered.

    ``place`` (n, 3) is the place in the picture and the sheet, ``value`` (n, 2 bands) the irradiance
    found, first the indirect one, then that from the sky.  A ``sharp`` (n,) node disagrees with what is fitted to it
    and its neighbours: light changes within a pixel or two, and it speaks for itself.
    """

    place: FloatArray
    value: FloatArray
    sharp: NDArray[np.bool_]

    @classmethod
    def none(cls, bands: int) -> _Nodes:
        return cls(np.empty((0, 3)), np.empty((0, 2 * bands)), np.empty(0, dtype=bool))

    def add(self, place: FloatArray, value: FloatArray) -> None:
        self.place = np.concatenate([self.place, place])
        self.value = np.concatenate([self.value, value])
        self.sharp = np.concatenate([self.sharp, np.zeros(len(place), dtype=bool)])

    def sharpen(self, first: int, allowed: FloatArray, workers: int) -> None:
        """Mark nodes from ``first`` on that differ from the fit by more than ``allowed`` (n, 2 bands)."""
        if first < len(self.place):
            off = np.abs(self.between(self.place[first:], workers) - self.value[first:])
            self.sharp[first:] = (off > allowed).any(axis=1)

    def near(self, left: float, top: float, right: float, bottom: float) -> _Nodes:
        x, y = self.place[:, 0], self.place[:, 1]
        inside = (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
        return _Nodes(self.place[inside], self.value[inside], self.sharp[inside])

    def between(self, places: FloatArray, workers: int) -> FloatArray:
        """Irradiance at places, from the nodes of their sheets; NaN where a sheet has none."""
        out = np.full((len(places), self.value.shape[1]), np.nan)
        if not len(self.place) or not len(places):
            return out
        distance, neighbour = cKDTree(self.place).query(places, k=min(NEIGHBOURS, len(self.place)), workers=workers)
        shape = (len(places), -1)
        kernels.local_fits(
            np.ascontiguousarray(places[:, :2]), neighbour.reshape(shape), distance.reshape(shape), 0.5 * APART,
            np.ascontiguousarray(self.place[:, :2]), self.value, self.sharp, out,
        )  # fmt: skip
        return out


class Picture:
    """A picture on its way: drawn tile by tile, first with the nodes so far, then with all.

    Attributes
    ----------
    radiance : (h, w, bands) float
        As good as it is yet; 0 where nothing is drawn. [W m-2 sr-1]
    samples : dict of str to (h, w) int
        How often each component was sampled in each pixel: ``camera`` rays, ``direct`` places,
        ``indirect`` bundles.
    states : (h, w, lights) int
        Woo's state of each pixel's middle for each light, see
        :class:`workbench.shadow.occlusion.OcclusionState`; -1 where an edge or nothing diffuse is seen.
    tiles : list of (left, top, right, bottom)
        [pixels]
    drafted, finished : set of int
        Tiles drawn with the nodes so far, and with all.
    counters : Counters
    """

    def __init__(self, owner: PictureGatherer, rays: PinholeRays) -> None:
        self.owner, self.rays = owner, rays
        width, height, bands = rays.width, rays.height, owner.bands
        require_memory(
            float(width) * height * (8.0 * bands + 30.0 + len(owner.gatherer.lights)) + TILE**2 * _PIXEL_BYTES,
            f"a picture of {width} x {height} pixels", "ask for a smaller --size",
        )  # fmt: skip
        self.radiance = np.zeros((height, width, bands))
        self.samples = {name: np.zeros((height, width), dtype=np.int32) for name in ("camera", "direct", "indirect")}
        self.states = np.full((height, width, len(owner.gatherer.lights)), -1, dtype=np.int8)
        self.tiles = [
            (x, y, min(x + TILE, width), min(y + TILE, height))
            for y in range(0, height, TILE)
            for x in range(0, width, TILE)
        ]
        self.drafted: set[int] = set()
        self.finished: set[int] = set()
        self.counters = Counters()
        self._nodes = _Nodes.none(bands)

    def steps(self) -> Iterator[float]:
        """Draw; yields after each tile how much is done, 0..1, and may be left at any time."""
        many = len(self.tiles)
        with ExitStack() as stack:
            folder: str | None = None
            waiting: dict[int, Any] = {}
            for number in range(many):
                if number in self.finished:
                    continue
                tile = _Tile(self, *self.tiles[number])
                tile.look()
                tile.place_nodes(self._nodes)
                tile.reflect(self._nodes)
                self._take(tile)
                self.drafted.add(number)
                if many == 1:
                    self.finished.add(number)
                else:
                    # Beyond a few tiles what they see is kept on disk: memory does not grow with the picture.
                    kept = tile.light
                    if len(waiting) >= TILES_IN_MEMORY:
                        folder = folder or stack.enter_context(tempfile.TemporaryDirectory(prefix="radiosity-"))
                        path = os.path.join(folder, f"{number}.pickle")
                        with open(path, "wb") as file:
                            pickle.dump(kept, file)
                        waiting[number] = path
                    else:
                        waiting[number] = kept
                yield 0.9 * (number + 1) / many
            for number in list(waiting):
                kept = waiting.pop(number)
                if isinstance(kept, str):
                    with open(kept, "rb") as file:
                        kept = pickle.load(file)
                tile = _Tile(self, *self.tiles[number])
                tile.light = kept
                tile.reflect(self._nodes)
                left, top, right, bottom = self.tiles[number]
                self.radiance[top:bottom, left:right] = tile.radiance.reshape(bottom - top, right - left, -1)
                self.finished.add(number)
                yield 0.9 + 0.1 * len(self.finished) / many

    def measured_error(self) -> float:
        """Relative error of the picture, by drawing some of its pixels again.

        Each is drawn alone, with other and more rays, without interpolation, and with light that is gathered
        once more where rays would read the solution: all that the picture is off by shows, but for
        what the second gather reads.  What the second look is off by itself is taken off.

        Returns
        -------
        float
            Root mean square, over the pixels that show anything, of the norm of the bands' error relative to
            the norm of the bands.
        """
        height, width, bands = self.radiance.shape
        many = min(max(height * width // CHECKED_OF, CHECKED[0]), CHECKED[1], height * width)
        chance = self._chances()
        rng = np.random.default_rng(self.owner.seed + 1)
        chosen = np.searchsorted(np.cumsum(chance), (np.arange(many) + rng.random(many)) / many)
        chosen, times = np.unique(np.minimum(chosen, height * width - 1), return_counts=True)
        row, column = np.divmod(chosen, width)
        other = Picture(self.owner._checking(), self.rays)
        parts = []
        for left, top, right, bottom in self.tiles:
            inside = np.flatnonzero((column >= left) & (column < right) & (row >= top) & (row < bottom))
            if not len(inside):
                continue
            tile = _Tile(other, left, top, right, bottom)
            place = (row[inside] - top) * (right - left) + column[inside] - left
            found, variance = tile.drawn_alone(place)
            drawn = self.radiance[top:bottom, left:right].reshape(-1, bands)[place]
            norm = (found**2).sum(axis=1)
            weight = np.where(norm > 0, times[inside] / chance[chosen[inside]], 0.0)
            off = np.column_stack([((drawn - found) ** 2).sum(axis=1), variance.sum(axis=1)])
            parts.append(np.column_stack([weight, (weight / np.maximum(norm, 1e-300))[:, None] * off]))
            self.counters.merge(tile.counters)
        weight, whole, own = np.concatenate(parts).sum(axis=0).tolist()
        if weight == 0.0:
            return 0.0
        # Of a picture that is better than the second look the difference tells little: no less than half is stated.
        return math.sqrt(max(whole - own, 0.25 * whole) / weight)

    def _chances(self) -> FloatArray:
        """Chances (pixels,) of being drawn again: as the steps to the neighbours, where errors are large."""
        norm = np.linalg.norm(self.radiance, axis=2)
        step = np.zeros_like(norm)
        for axis in (0, 1):
            change = np.abs(np.diff(norm, axis=axis))
            for side in ((1, 0), (0, 1)):
                pad = [(0, 0), (0, 0)]
                pad[axis] = side
                step = np.maximum(step, np.pad(change, pad))
        share = np.clip(step / np.maximum(norm, 1e-300), *STEPS).ravel()
        return share / share.sum()

    def _take(self, tile: _Tile) -> None:
        left, top, right, bottom = tile.left, tile.top, tile.left + tile.width, tile.top + tile.height
        part = (slice(top, bottom), slice(left, right))
        shape = (bottom - top, right - left)
        self.radiance[part] = tile.radiance.reshape(*shape, -1)
        for name, count in tile.samples.items():
            self.samples[name][part] = count.reshape(shape)
        self.states[part] = tile.states.reshape(*shape, -1)
        self.counters.merge(tile.counters)

    def state(self) -> dict[str, NDArray]:
        """All that :meth:`resume` needs."""
        return {
            "radiance": self.radiance,
            "states": self.states,
            "node_place": self._nodes.place,
            "node_value": self._nodes.value,
            "node_sharp": self._nodes.sharp,
            "finished": np.array(sorted(self.finished), dtype=np.int64),
            "drafted": np.array(sorted(self.drafted), dtype=np.int64),
            **{f"samples_{name}": count for name, count in self.samples.items()},
        }

    def resume(self, state: Mapping[str, NDArray]) -> None:
        """Go on from a saved :meth:`state` of the same picture.

        Raises
        ------
        InputError
            If the state is that of a picture of another size.
        """
        if state["radiance"].shape != self.radiance.shape or state["states"].shape != self.states.shape:
            raise InputError(
                f"resume: found a picture of shape {state['radiance'].shape}, expected {self.radiance.shape};"
                " draw without --resume"
            )
        self.radiance, self.states = state["radiance"].copy(), state["states"].copy()
        self.samples = {name: state[f"samples_{name}"].copy() for name in self.samples}
        self._nodes = _Nodes(state["node_place"], state["node_value"], state["node_sharp"])
        self.finished, self.drafted = set(state["finished"].tolist()), set(state["drafted"].tolist())


@dataclass
class _Light:
    """What a tile saw: radiance (pixels, bands) that needs no gather, fragments, and their direct irradiance.

    Where a fragment is ``crowded`` (n,), the sky is not in it, see :class:`radiosity.sensors.Direct`.  What is
    gathered inside pixels for some fragments is their ``inside``: their rows, and as nodes hold it (k, 2 bands).
    """

    radiance: FloatArray
    fragments: _Fragments
    direct: FloatArray
    crowded: NDArray[np.bool_]
    inside: tuple[IntArray, FloatArray] | None = None

    def asks_nodes(self, indirect: bool) -> bool:
        return len(self.fragments) > 0 and (indirect or bool(self.crowded.any()))


class _Tile:
    """One rectangle of a picture."""

    def __init__(self, picture: Picture, left: int, top: int, right: int, bottom: int) -> None:
        self.owner, self.rays, self.options = picture.owner, picture.rays, picture.owner.options
        self.left, self.top, self.width, self.height = left, top, right - left, bottom - top
        # Blocks keep their share of the picture, whatever its resolution.
        self.pitch = int(np.clip(2 ** round(math.log2(max(min(self.rays.width, self.rays.height), 1) / 16)), 4, 64))
        self.counters = Counters()
        self.calls = 0
        pixels = self.width * self.height
        self.samples = {name: np.zeros(pixels, dtype=np.int64) for name in ("camera", "direct", "indirect")}

    def look(self) -> None:
        """Find what the pixels see, and its direct light."""
        shape = self.height * self.width
        radiance = np.zeros((shape, self.owner.bands))
        whole, edges, corners = self._whole_pixels(radiance)
        straight = self._direct(whole)
        direct = straight.irradiance
        shadow = np.zeros(shape, dtype=bool)
        bent = self._bends(whole.pixel, whole.sheet, direct.sum(axis=1))
        shadow[whole.pixel[bent > min(TURN * self.options.error, MOST_TURN)]] = True
        cut = shadow.copy()
        cut[edges] = True
        radiance[cut] = 0.0
        kept = ~cut[whole.pixel]
        self.samples["camera"] += 1  # a corner
        self.samples["direct"] += np.bincount(whole.pixel, minlength=shape)
        self.states = np.full((shape, len(self.owner.gatherer.lights)), -1, dtype=np.int8)
        self.states[whole.pixel] = straight.state
        inside = np.flatnonzero(cut)
        allowed = (INSIDE_ERROR[self.options.error < TRUSTED] * self.options.error) ** 2 * shape
        fragments, light, crowded = self._divide(inside, shadow[inside], corners[inside], radiance, allowed)
        self.light = _Light(
            radiance, _Fragments.joined([whole.take(kept), fragments]), np.concatenate([direct[kept], light]),
            np.concatenate([straight.crowded[kept], crowded]),
        )  # fmt: skip

    def reflect(self, nodes: _Nodes) -> None:
        """Add what the fragments reflect, their indirect light read between nodes."""
        fragments, arriving = self.light.fragments, self.light.direct
        if self.light.asks_nodes(self.options.indirect) and len(nodes.place):
            margin = 4.0 * self.pitch
            right, bottom = self.left + self.width + margin, self.top + self.height + margin
            near = nodes.near(self.left - margin, self.top - margin, right, bottom)
            found = near.between(_places(fragments), self.owner.workers)
            if self.light.inside is not None:
                rows, value = self.light.inside
                found[rows] = value
            bands = self.owner.bands
            if self.options.indirect:
                arriving = arriving + found[:, :bands]
            arriving = arriving + np.where(self.light.crowded[:, None], found[:, bands:], 0.0)
        self.radiance = self.light.radiance.copy()
        for band in range(self.owner.bands):
            weights = fragments.gain[:, band] * arriving[:, band]
            self.radiance[:, band] += np.bincount(fragments.pixel, weights, len(self.radiance))

    def drawn_alone(self, pixels: IntArray) -> tuple[FloatArray, FloatArray]:
        """Radiance (n, bands) of some pixels without nodes, and its variance by bundles."""
        shape = self.height * self.width
        radiance = np.zeros((shape, self.owner.bands))
        fragments, direct, crowded = self._divide(pixels, np.zeros(len(pixels), dtype=bool), 0.0, radiance, None)
        variance = np.zeros_like(radiance)
        arriving, bands = direct, self.owner.bands
        self.light = _Light(radiance, fragments, direct, crowded)
        if self.light.asks_nodes(self.options.indirect):
            # Light of each sheet in a pixel at several places; at the fragment alone where none of them lies on it.
            sheets = int(fragments.sheet.max()) + 1
            known, first, group = np.unique(
                fragments.pixel * sheets + fragments.sheet, return_index=True, return_inverse=True
            )
            inside = self._inside(pixels, np.full(len(pixels), INSIDE_PLACES[0]))
            its = inside.pixel * sheets + inside.sheet
            owner = np.minimum(np.searchsorted(known, its), len(known) - 1)
            kept = np.flatnonzero(known[owner] == its)
            alone = np.setdiff1d(np.arange(len(known)), owner[kept])
            owner = np.concatenate([owner[kept], alone])
            inside = _Fragments.joined([inside.take(kept), fragments.take(first[alone])])
            mean, doubt, _ = self._mean_of_groups(inside, owner, direct[first[owner]], len(known))
            found = mean[group]
            if self.options.indirect:
                arriving = arriving + found[:, :bands]
            arriving = arriving + np.where(crowded[:, None], found[:, bands:], 0.0)
            for band in range(bands):
                # Fragments of one group err alike.
                gain = np.bincount(group, fragments.gain[:, band], len(known))
                variance[:, band] = np.bincount(known // sheets, (gain * doubt[:, band]) ** 2, shape)
        for band in range(bands):
            radiance[:, band] += np.bincount(fragments.pixel, fragments.gain[:, band] * arriving[:, band], shape)
        return radiance[pixels], variance[pixels]

    # ---- rays from the eye ----------------------------------------------------------------------

    def _look(self, x: NDArray, y: NDArray, pixel: IntArray, keys: IntArray, known: IntArray | None = None) -> _Seen:
        self.counters.add(rays=len(x), cast_rays=len(x))
        return self.owner.look(self.rays, self.left + x, self.top + y, pixel, keys, known)

    def _whole_pixels(self, radiance: FloatArray) -> tuple[_Fragments, IntArray, FloatArray]:
        """Fragments of the pixels whose middle and corners see the same, in their order, the other pixels, and the
        variance (pixels,) of what the corners see shine."""
        shape = self.height * self.width
        # Corners stand off whole numbers by a hair: edges of rooms like to lie on them.
        down, across = np.divmod(np.arange((self.width + 1) * (self.height + 1)), self.width + 1)
        corner = self._look(across + 1e-4, down + 1e-4, np.arange(len(across)), self._keys(across, down, 0))
        lobes = corner.fuzzy.reshape(self.height + 1, self.width + 1)
        self.fuzzy = (lobes[:-1, :-1] | lobes[:-1, 1:] | lobes[1:, :-1] | lobes[1:, 1:]).ravel()
        same, varies = np.empty(shape, dtype=bool), np.empty(shape)
        kernels.alike(corner.mark, corner.steady, self.width, self.height, STEP, same, varies)
        pixel = np.flatnonzero(same)
        row, column = np.divmod(pixel, self.width)
        first = row * (self.width + 1) + column
        known = None
        if self.options.error >= TRUSTED:
            known = corner.polygon[first]
            for other in (1, self.width + 1, self.width + 2):
                known[corner.polygon[first + other] != known] = NO_POLYGON
        self.samples["camera"][pixel] += 1 if known is None else known == NO_POLYGON
        middle = self._look(column + 0.5, row + 0.5, pixel, self._keys(column, row, 0), known)
        agree = middle.mark == corner.mark[first]
        if corner.steady.any():
            other = corner.steady[first]
            step = np.abs(other - middle.steady).max(axis=1)
            agree &= step <= STEP * np.maximum(other, middle.steady).max(axis=1)
        if agree.all():
            radiance[pixel] = middle.radiance
            return middle.fragments, np.flatnonzero(~same), varies
        same[pixel[~agree]] = False
        radiance[pixel[agree]] = middle.radiance[agree]
        return middle.fragments.take(np.flatnonzero(agree[middle.ray])), np.flatnonzero(~same), varies

    def _keys(self, column: IntArray, row: IntArray, place: int | IntArray) -> IntArray:
        """Number of a ray in the whole picture, which its random numbers come from."""
        return ((row + self.top) * (self.rays.width + 1) + column + self.left) * (1 << 10) + place

    def _divide(
        self,
        pixels: IntArray,
        shadow: NDArray[np.bool_],
        corners: FloatArray | float,
        radiance: FloatArray,
        allowed: float | None,
    ) -> tuple[_Fragments, FloatArray, NDArray[np.bool_]]:
        """Cast rays in some pixels until their squared relative errors add up to ``allowed``; if None, as a check does.

        ``shadow`` tells where direct light has an edge, ``corners`` by what the corners' radiance varies.  Returns
        fragments, their direct light, and if crowded.
        """
        bands, count = self.owner.bands, np.zeros(len(pixels), dtype=np.int64)
        seen, moments = np.zeros((len(pixels), bands)), np.zeros((len(pixels), 5))
        moments[:, 3], moments[:, 4] = math.inf, corners
        parts: list[tuple[_Fragments, IntArray, FloatArray, NDArray[np.bool_]]] = []
        if allowed is None:
            target = np.full(len(pixels), self.options.check_places)
        else:
            # Few rays of few lobes either miss a lamp or make a speck of it.
            least_places = FIRST_PLACES[self.options.error < TRUSTED]
            target = np.where(self.fuzzy[pixels], self.options.fuzzy_places, least_places)
        for _ in range(INSIDE_ROUNDS if allowed is not None else 1):
            self._cast(pixels, shadow, count, target, seen, moments, parts)
            count = np.maximum(count, target)
            if allowed is None or not len(pixels):
                break
            variance = _variances(moments)
            worst = (PIXEL_ERROR * self.options.error) ** 2
            if variance.sum() <= allowed and variance.max() <= worst:
                break
            # What the most rays leave has to be borne.
            least = 1.5 * float((variance * (count / MOST_PLACES) ** 1.5).sum())
            target = allotted(variance[:, None], count, np.array([max(allowed, least) / len(pixels)]), MOST_PLACES)
            needed = count * np.maximum(variance / worst, 1.0) ** (2.0 / 3.0)
            target = np.maximum(target, 2 ** np.ceil(np.log2(needed)).astype(np.int64))
            target = np.minimum(target, np.minimum(GROWTH * count, MOST_PLACES))
        radiance[pixels] = seen / np.maximum(count, 1)[:, None]
        self.samples["camera"][pixels] += count
        if not parts:
            return _Fragments.none(bands), np.zeros((0, bands)), np.zeros(0, dtype=bool)
        fragments = _Fragments.joined([part[0] for part in parts])
        fragments.gain /= count[np.concatenate([part[1] for part in parts])][:, None]
        return fragments, np.concatenate([part[2] for part in parts]), np.concatenate([part[3] for part in parts])

    def _cast(
        self, pixels: IntArray, shadow: NDArray[np.bool_], count: IntArray, target: IntArray, seen: FloatArray,
        moments: FloatArray, parts: list[tuple[_Fragments, IntArray, FloatArray, NDArray[np.bool_]]],
    ) -> None:  # fmt: skip
        """Cast the rays that pixels with ``count`` of them lack to ``target``, and take their sums up."""
        more = np.maximum(target - count, 0)
        # The first rays tell what direct light varies by, too, if that matters.
        share = 1 if self.options.error < TRUSTED and not count.any() else DIRECT_SHARE
        ends = np.cumsum(more)
        most = max(RAYS_AT_ONCE // self.owner.rays_each, MOST_PLACES)
        first = 0
        while first < len(pixels):
            last = max(int(np.searchsorted(ends, ends[first] - more[first] + most, side="right")), first + 1)
            rows = np.repeat(np.arange(first, last), more[first:last])
            if len(rows):
                before = ends[first] - more[first]
                place = np.arange(len(rows)) - (ends - more - before - count)[rows]
                # The first of each pixel's new places: together they are spread over it.
                wanted = shadow[rows] | (share * (place - count[rows]) < more[rows])
                self._cast_in(pixels, rows, place, wanted, shadow, seen, moments, parts)
            first = last

    def _cast_in(
        self, pixels: IntArray, rows: IntArray, place: IntArray, wanted: NDArray[np.bool_], shadow: NDArray[np.bool_],
        seen: FloatArray, moments: FloatArray, parts: list[tuple[_Fragments, IntArray, FloatArray, NDArray[np.bool_]]],
    ) -> None:  # fmt: skip
        """Cast rays in pixels ``rows`` at places of the net; direct light is ``wanted`` at some.

        Marks in ``shadow`` pixels where it has an edge.
        """
        number = pixels[rows]
        row, column = np.divmod(number, self.width)
        inside = self.owner._places[place]
        found = self._look(column + inside[:, 0], row + inside[:, 1], number, self._keys(column, row, place))
        every, bands = found.fragments, self.owner.bands
        bright = found.radiance.sum(axis=1)
        if len(every):
            # What the rays of a pixel see of one sheet is one fragment.
            owner = rows[found.ray]
            group, label = np.empty(len(every), dtype=np.int64), np.empty(len(every), dtype=np.int64)
            many = kernels.group_sheets(owner, every.sheet, group, label)
            total, chosen = np.empty((many, bands)), np.empty(many, dtype=np.int64)
            asked = np.empty(len(every), dtype=bool)
            kernels.stand_for(group, every.x, every.y, every.gain, wanted[found.ray], total, chosen, asked)
            # Direct light at some places of each fragment, for shadows have edges inside pixels, too: weighted
            # by gain, which differs where one sheet holds several surfaces.
            places = np.flatnonzero(asked)
            straight = self._direct(every.take(places))
            light = np.empty((many, bands))
            kernels.light_of_groups(
                group, places, every.gain, straight.irradiance, found.ray, self.owner.ambient, light, bright
            )
            if not seen.any() and self.options.error < TRUSTED:
                # Light that varies over a sheet in a pixel is asked of all its rays.
                shine, sheet = straight.irradiance.sum(axis=1), group[places]
                least, most = np.full(many, np.inf), np.zeros(many)
                np.minimum.at(least, sheet, shine)
                np.maximum.at(most, sheet, shine)
                shadow[owner[chosen[most - least > TURN * self.options.error * most]]] = True
            crowded = np.bincount(group[places], straight.crowded, many) > 0
            fragments = every.take(chosen)
            fragments.gain = total
            parts.append((fragments, owner[chosen], light, crowded))
            self.samples["direct"] += np.bincount(every.pixel[places], minlength=len(self.samples["direct"]))
        kernels.sum_rays(rows, found.radiance, bright, seen, moments)

    # ---- direct light ---------------------------------------------------------------------------

    def _direct(self, fragments: _Fragments) -> Direct:
        return self.owner.gatherer.direct(
            fragments.points, fragments.normals, own_polygon=fragments.polygon, error=self.options.error,
            counters=self.counters,
        )  # fmt: skip

    def _bends(self, pixel: IntArray, sheet: IntArray, bright: FloatArray) -> FloatArray:
        """By what share (n,) light bends or steps toward the neighbours on a sheet; rows are sorted by pixel."""
        bent = np.empty(len(pixel))
        start = np.zeros(self.height * self.width + 1, dtype=np.int64)
        np.cumsum(np.bincount(pixel, minlength=len(start) - 1), out=start[1:])
        kernels.bends(pixel, sheet, np.ascontiguousarray(bright), start, self.width, bent)
        return bent

    # ---- indirect light -------------------------------------------------------------------------

    def _bundles(
        self, fragments: _Fragments, rows: IntArray, direct: FloatArray, places: int = 1
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """What nodes hold (n, 2 bands), its standard error, and harmonic mean distance (n,) of some fragments.

        ``direct`` (n, bands) is their direct light.  Of so many ``places`` the mean is as good as a node.
        """
        where = (fragments.points[rows], fragments.normals[rows])
        gatherer = self.owner.gatherer
        assert isinstance(gatherer, Gatherer)
        # A seed of its own for each call: rows begin at 0 in all, and alike rows would err alike.
        self.calls += 1
        seed = self.owner.seed + ((self.top * self.rays.width + self.left) * 64 + self.calls) * 7919
        if self.options.rays is not None:
            found = gatherer.indirect(*where, rays=-(-self.options.rays // places), counters=self.counters, seed=seed)
        else:
            pilot = self.options.pilot_rays
            if places > 1:
                pilot = max(2 * pilot // places, PILOT_RAYS[0])
            found = gatherer.indirect(
                *where, rays=pilot, counters=self.counters, error=NODE_ERROR * math.sqrt(places) * self.options.error,
                direct=direct, seed=seed,
            )  # fmt: skip
        spread = np.concatenate([found.standard_error, found.standard_error], axis=1)
        return np.concatenate([found.indirect, found.sky], axis=1), spread, found.distance

    def place_nodes(self, nodes: _Nodes) -> None:
        """Add nodes on ever finer lattices, where the last one's disagree with what was foretold."""
        fragments, direct = self.light.fragments, self.light.direct
        if not self.light.asks_nodes(self.options.indirect):
            return
        everywhere = _places(fragments)
        if not self.options.atomic:
            value, _, _ = self._bundles(fragments, np.arange(len(fragments)), direct)
            self.samples["indirect"] += np.bincount(fragments.pixel, minlength=len(self.samples["indirect"]))
            nodes.add(everywhere, value)
            nodes.sharp[:] = True
            self._gather_inside(value)
            return
        margin = 2.0 * self.pitch
        edges = self.left - margin, self.top - margin, self.left + self.width + margin, self.top + self.height + margin
        region = np.ones(len(fragments), dtype=bool)
        pitch, first, before = self.pitch, True, len(nodes.place)
        doubt, least = [np.empty((0, 2 * self.owner.bands))], [np.empty((0, 2 * self.owner.bands))]
        while pitch >= 1 and region.any():
            cell = _cells(everywhere, pitch)
            near = nodes.near(*edges)
            held = np.isin(cell, _cells(near.place, pitch))
            rows = _nearest_to_middles(fragments, np.flatnonzero(region & ~held), cell, pitch)
            flagged = np.zeros(0, dtype=np.int64)
            if len(rows):
                foretold = near.between(everywhere[rows], self.owner.workers)
                found, spread, distance = self._bundles(fragments, rows, direct[rows])
                whole = direct[rows] + found[:, : self.owner.bands]
                total = np.concatenate([whole, whole + found[:, self.owner.bands :]], axis=1)
                off = np.abs(np.where(np.isfinite(foretold), foretold, found) - found) - NOISE * spread
                uneven = (off > self.options.error * total).any(axis=1)
                spacing = SPACING * math.sqrt(max(self.options.error / SPACED_FOR, 1.0))
                close = pitch * fragments.footprint[rows] > spacing * distance
                flagged = cell[rows[uneven | close]]
                nodes.add(everywhere[rows], found)
                doubt.append(spread)
                least.append(SHARP * self.options.error * total)
                self.samples["indirect"] += np.bincount(fragments.pixel[rows], minlength=len(self.samples["indirect"]))
            if not first:  # the second lattice is sampled everywhere, too: it judges the first
                region = np.isin(cell, (np.unique(flagged)[:, None] + _AROUND).ravel())
            pitch, first = pitch // 2, False
        nodes.sharpen(before, np.concatenate(least) + np.concatenate(doubt), self.owner.workers)
        self._gather_inside(nodes.near(*edges).between(everywhere, self.owner.workers))

    def _gather_inside(self, value: FloatArray) -> None:
        """Gather at several places of the fragments whose light bends inside their pixels.

        ``value`` (n, 2 bands) is what nodes tell of each fragment.
        """
        fragments, bands = self.light.fragments, self.owner.bands
        sheets = int(fragments.sheet.max()) + 1
        known, first, group = np.unique(
            fragments.pixel * sheets + fragments.sheet, return_index=True, return_inverse=True
        )
        pixel, sheet = fragments.pixel[first], fragments.sheet[first]
        each = (fragments.gain * (self.light.direct + value[:, :bands] + value[:, bands:])).sum(axis=1)
        sent, gain = np.bincount(group, each), np.bincount(group, fragments.gain.sum(axis=1))
        shown = self.light.radiance.sum(axis=1) + np.bincount(fragments.pixel, each, len(self.light.radiance))
        bent = self._bends(pixel, sheet, sent / np.where(gain > 0.0, gain, 1.0))
        off = np.minimum(bent, 1.0) * sent / np.where(shown[pixel] > 0.0, shown[pixel], math.inf) / self.options.error
        chosen = off > INSIDE_TURN
        if not chosen.any():
            return
        count = np.zeros(len(self.light.radiance), dtype=np.int64)
        wanted = 2 ** np.ceil(4.0 / 3.0 * np.log2(INSIDE_SPREAD * off[chosen])).astype(np.int64)
        np.maximum.at(count, pixel[chosen], np.clip(wanted, *INSIDE_PLACES))
        asked = np.flatnonzero(count)
        found = self._inside(asked, count[asked])
        its = found.pixel * sheets + found.sheet
        owner = np.minimum(np.searchsorted(known, its), len(known) - 1)
        kept = np.flatnonzero((known[owner] == its) & chosen[owner])
        mean, _, have = self._mean_of_groups(
            found.take(kept), owner[kept], self.light.direct[first[owner[kept]]], len(known)
        )
        rows = np.flatnonzero(have[group])
        self.light.inside = rows, mean[group[rows]]

    def _inside(self, pixels: IntArray, count: IntArray) -> _Fragments:
        """Fragments at the first ``count`` places inside some pixels."""
        number = np.repeat(pixels, count)
        place = np.arange(len(number)) - np.repeat(np.cumsum(count) - count, count)
        row, column = np.divmod(number, self.width)
        inside = self.owner._places[place]
        keys = self._keys(column, row, place)
        return self._look(column + inside[:, 0], row + inside[:, 1], number, keys).fragments

    def _mean_of_groups(
        self, fragments: _Fragments, group: IntArray, direct: FloatArray, many: int
    ) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """What nodes would hold (many, 2 bands) of groups of fragments, its standard error, and whether it is known."""
        found, spread, _ = self._bundles(fragments, np.arange(len(fragments)), direct, places=INSIDE_PLACES[0])
        weight = fragments.gain.sum(axis=1)
        total = np.bincount(group, weight, many)
        have = total > 0.0
        share = weight / np.where(have, total, 1.0)[group]
        mean, square = np.empty((many, found.shape[1])), np.empty((many, found.shape[1]))
        for k in range(found.shape[1]):
            mean[:, k] = np.bincount(group, share * found[:, k], many)
            square[:, k] = np.bincount(group, (share * spread[:, k]) ** 2, many)
        self.samples["indirect"] += np.bincount(fragments.pixel, minlength=len(self.samples["indirect"]))
        return mean, np.sqrt(square), have


def _variances(moments: FloatArray) -> FloatArray:
    """Squared relative errors (n,) of pixels.

    ``moments`` of the brightness of their rays: number, sum, sum of squares, the least, and the variance from corner
    to corner.  A few rays tell a spread but roughly, so the corners count too, and the mean of all pixels.  Relative
    they are to what the pixel shows at least: where one ray of eight met a lamp, it may be one of a hundred.
    """
    count, total, square, least, corners = moments.T
    mean, weight = total / count, count - 1.0 + POOL
    spread = (np.maximum(square - count * mean**2, 0.0) + POOL * CORNER_SHARE * corners) / weight
    sure = np.maximum(mean - 4.0 * NET_ERROR * np.sqrt(spread) * count**-0.75, least)
    relative = np.where(sure > 0.0, spread / np.where(sure > 0.0, sure, 1.0) ** 2, 1.0)
    pooled = float(np.minimum(relative, 1.0).mean())
    return NET_ERROR**2 * (relative * (count - 1.0) + POOL * pooled) / weight * count**-1.5


def _places(fragments: _Fragments) -> FloatArray:
    """Places (n, 3) in the picture, the sheets far apart."""
    return np.column_stack([fragments.x, fragments.y, fragments.sheet * APART])


_ROW = 1 << 20
_AROUND = np.array([dy * _ROW + dx for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
"""From a cell's number to those of itself and its neighbours."""


def _cells(place: FloatArray, pitch: int) -> IntArray:
    """Number (n,) of each place's cell of a lattice, on its sheet."""
    column, row = ((place[:, k] / pitch).astype(np.int64) + 1 for k in (0, 1))
    return (np.rint(place[:, 2] / APART).astype(np.int64) * _ROW + row) * _ROW + column


def _nearest_to_middles(fragments: _Fragments, rows: IntArray, cell: IntArray, pitch: int) -> IntArray:
    """Of the fragments ``rows`` the one in each cell that is nearest to the cell's middle."""
    off = np.hypot(fragments.x[rows] / pitch % 1.0 - 0.5, fragments.y[rows] / pitch % 1.0 - 0.5)
    order = rows[np.lexsort((off, cell[rows]))]
    return order[np.concatenate([[True], np.diff(cell[order]) != 0])] if len(order) else order
