"""Soft shadows by hardware cameras: look from the point at the light and count pixels.

After "Software Shadows For Ray Tracing Using Hardware Cameras": a camera stands at the shading
point, its viewport covers the light, the scene is drawn, and the pixels not covered are the part of
the light that the point sees.  Here the light itself is drawn too, so that it may have any shape
(the paper's first future work), and many points share one picture on graphics hardware (its second).

Two shares come out.  The paper's ``pixel_fraction`` counts pixels; for a flat light these are equal
*areas of the light*, not equal shares of the irradiance (0.75 where 0.242 is right, for a light
that spans a wide angle).  ``visible_share`` weighs every pixel by cos cos dA / r^2 and converges to
the visible share of the irradiance.  Multiply it by the closed form of the unoccluded light.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.accel.box_tree import BoxTree
from workbench.arrays import as_points, as_unit_vectors
from workbench.counters import Counters
from workbench.errors import InputError, MissingLibraryError, OptionError
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import check_polygon, convex_pieces, plane_basis, vector_area
from workbench.shadow import rasteriser

__all__ = ["CameraShadows", "CameraState", "camera_shadows"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_ATLAS = 2048
_VERTICES = 1 << 20
_BLOCK = 256


class CameraState(IntEnum):
    """What became of a point.

    UNLIT: it faces away from the light or stands behind it.  NOT_INSHADOW and INSHADOW: known
    without a render (optimised mode).  RENDERED: a picture was drawn and counted.  FALLBACK: no
    camera sees this light well (the point nearly in the light's plane, closer to it than a pixel is
    wide, or a light that spans nearly the half-space); use rays or the exact method.
    """

    UNLIT = rasteriser.UNLIT
    NOT_INSHADOW = rasteriser.NOT_INSHADOW
    INSHADOW = rasteriser.INSHADOW
    RENDERED = rasteriser.RENDERED
    FALLBACK = rasteriser.FALLBACK


@dataclass(frozen=True)
class CameraShadows:
    """What the cameras at ``m`` points saw of one light.

    Parameters
    ----------
    state : (m,) int8
        A :class:`CameraState` each.
    visible_share : (m,) float
        Visible share of the irradiance above the horizon; NaN in a FALLBACK, 0 if UNLIT. [0..1]
    pixel_fraction : (m,) float
        Visible pixels over the light's pixels, as the paper counts; for a flat light the visible
        share of its area above the horizon.  An edge along a side of the viewport is off by up to half
        a pixel; of a light of which the horizon leaves one corner half the pixels are left, and an
        edge along the cut can be off by 2 / viewport of them. [0..1]
    untouched_fraction : (m,) float or None
        Share of the light's pixels that no polygon so much as touches (conservative drawing): a
        lower bound of the visible share of a parallelogram light's area. [0..1]
    light_pixels, visible_pixels : (m,) int
        The counts behind ``pixel_fraction``; 0 where nothing was rendered.
    light_weight, visible_weight : (m,) float
        The sums of cos cos dA / r^2 behind ``visible_share``, that is irradiance for radiance 1;
        0 where nothing was rendered. [sr]
    doubt : (m,) float
        Standard error of ``visible_share`` by the borders between pixels, and a pixel for what none of them
        shows; occluders much smaller than a pixel are not seen, and not allowed for. [0..1]
    counters : Counters
    backend : str
        ``software``, or ``gl: `` and the renderer's name.
    """

    state: NDArray[np.int8]
    visible_share: FloatArray
    pixel_fraction: FloatArray
    untouched_fraction: FloatArray | None
    light_pixels: IntArray
    visible_pixels: IntArray
    light_weight: FloatArray
    visible_weight: FloatArray
    doubt: FloatArray
    counters: Counters
    backend: str

    @property
    def fallback(self) -> NDArray[np.bool_]:
        """(m,) bool: points that need another method."""
        return self.state == CameraState.FALLBACK


def camera_shadows(
    points: ArrayLike,
    normals: ArrayLike,
    light: ArrayLike | Sequence[ArrayLike],
    geometry: Geometry,
    *,
    viewport: int = 32,
    mode: str = "optimised",
    jitter: str = "none",
    seed: int = 0,
    backend: str = "auto",
    conservative: bool = False,
    two_sided: bool = False,
    own_polygon: ArrayLike | None = None,
    ignore: ArrayLike | None = None,
    tree: BoxTree | None = None,
    workers: int | None = None,
) -> CameraShadows:
    """Look from each point at one light and count what is seen of it.

    Parameters
    ----------
    points, normals : (m, 3) float
        Shading points, and normals on the lit side.
    light : (n, 3) float or list of (n, 3) float
        One polygon, or several that make up a light of any shape (a sphere's facets), each
        counter-clockwise from its emitting side; concave ones are cut.
    geometry : Geometry
        The occluders: the scene, or a proxy of it (:mod:`workbench.shadow.proxy`).  Polygons in the
        plane of a flat light or beyond it do not block, so the light may be among them.
    viewport : int
        Pixels along a side, 2 to 1024; the paper uses 4 to 128.
    mode : str
        ``naive`` draws every polygon at every point; ``optimised`` draws what the plane-vertex
        check leaves, and nothing where that settles the point.  Both give the same answer.
    jitter : str
        ``none``; ``shift`` moves the sample pattern of each point by a random part of a pixel (the
        viewport is then a pixel wider than the light, which it always covers);
        ``rotate`` turns it as well, which keeps slats from falling in step with the pixels, at the
        price of up to half the pixels.
    seed : int
        Of the jitter; each point has its own random numbers whatever the number of workers.
    backend : str
        ``software`` (numba), ``gl`` (OpenGL on EGL), or ``auto``: ``gl`` on a graphics card,
        ``software`` where OpenGL is absent or itself runs on the processor.
    conservative : bool
        Also compute ``untouched_fraction``; ``software`` only.
    two_sided : bool
        Whether the light emits from both sides.
    own_polygon : (m,) int, optional
        Polygon on which each point lies, which never blocks its light; -1 for none.  Polygons whose
        plane holds the point block nothing in any case.
    ignore : (k,) int, optional
        Polygons that block nothing, such as those of a convex light that is not flat.
    tree : BoxTree, optional
        The geometry's tree, if it is at hand.
    workers : int, optional
        Threads of the software backend; all processors by default.

    Raises
    ------
    InputError
        Arrays of the wrong shape, a light without area, or transparent occluders.
    OptionError
        An option out of its range.
    MissingLibraryError
        ``backend="gl"`` where OpenGL is absent.
    """
    points = as_points(points, "points")
    normals = as_unit_vectors(normals, "normals")
    count = len(points)
    if len(normals) != count:
        raise InputError(f"normals: found {len(normals)} rows, expected {count}, one a point")
    own = np.full(count, -1, np.int64)
    if own_polygon is not None:
        own = np.ascontiguousarray(own_polygon, dtype=np.int64)
        if own.shape != (count,):
            raise InputError(f"own_polygon: found shape {own.shape}, expected ({count},)")
    _check_options(viewport, mode, jitter, backend, conservative)
    ignored = None if ignore is None else np.atleast_1d(np.asarray(ignore, dtype=np.int64))
    clear = np.flatnonzero(geometry.polygon_transmittance > 0)
    if len(np.setdiff1d(clear, ignored if ignored is not None else [])):
        raise InputError(
            f"geometry: polygon {clear[0]} is transparent, a camera counts opaque ones only; use a method of rays"
        )
    lamp = _lamp(light, two_sided)
    extent = float(np.ptp(lamp.corners, axis=0).max())
    occ = rasteriser.occluders(geometry, tree, extent=extent, ignore=ignored)
    work = _Work(points, normals, own, lamp, occ, viewport, mode == "naive", _samples(count, jitter, seed))
    chosen = _backend(backend, conservative)
    if chosen == "gl":
        renderer = work.draw_with_gl()
        name = f"gl: {renderer}"
    else:
        work.draw_with_software(conservative, workers)
        name = "software"
    return work.result(name, conservative)


def _check_options(viewport: int, mode: str, jitter: str, backend: str, conservative: bool) -> None:
    if not 2 <= viewport <= 1024:
        raise OptionError(f"viewport: found {viewport}, expected 2 to 1024 pixels")
    for name, value, known in (
        ("mode", mode, ("naive", "optimised")),
        ("jitter", jitter, ("none", "shift", "rotate")),
        ("backend", backend, ("auto", "gl", "software")),
    ):
        if value not in known:
            raise OptionError(f"{name}: found {value!r}, expected one of {', '.join(known)}")
    if conservative and backend == "gl":
        raise OptionError("conservative: found backend 'gl', expected 'software' or 'auto'")


def _backend(asked: str, conservative: bool) -> str:
    if asked != "auto":
        return asked
    if conservative:
        return "software"
    from workbench.shadow.gl_rasteriser import gl_renderer

    try:
        renderer = gl_renderer().lower()
    except MissingLibraryError:
        return "software"
    return "software" if any(name in renderer for name in ("llvmpipe", "softpipe", "swrast")) else "gl"


def _samples(count: int, jitter: str, seed: int) -> FloatArray:
    """(m, 3): angle of the sample pattern [rad] and its shift along both sides. [pixels]"""
    samples = np.zeros((count, 3))
    if jitter != "none":
        samples[:] = np.random.default_rng(seed).random((count, 3)) - [0.0, 0.5, 0.5]
        samples[:, 0] *= np.pi / 2 if jitter == "rotate" else 0.0
    return samples


def _lamp(light: ArrayLike | Sequence[ArrayLike], two_sided: bool) -> rasteriser.Lamp:
    """The light's convex pieces, and a basis of its plane if it is flat."""
    try:
        listed: list[Any] = list(light)  # type: ignore[arg-type]
        rings = (
            [as_points(listed, "light")] if np.ndim(listed[0]) == 1 else [as_points(ring, "light") for ring in listed]
        )
    except (TypeError, IndexError):
        raise InputError("light: expected an (n, 3) polygon or a list of them") from None
    pieces: list[FloatArray] = []
    for index, ring in enumerate(rings):
        wrong = check_polygon([ring])
        if wrong:
            raise InputError(f"light: polygon {index}: found {wrong}, expected a flat polygon with an area")
        pieces.extend(convex_pieces([ring]))
    vectors = np.asarray([vector_area(piece) for piece in pieces])
    normals = vectors / np.linalg.norm(vectors, axis=1)[:, None]
    corners = np.concatenate(pieces)
    start = np.concatenate([[0], np.cumsum([len(piece) for piece in pieces])]).astype(np.int64)
    size = float(np.ptp(corners, axis=0).max())
    off = np.abs((corners - corners[0]) @ normals[0]).max()
    planar = bool((normals @ normals[0] > 1 - 1e-9).all() and off <= 1e-7 * size)
    basis = _flat_basis(pieces, normals[0], size) if planar else np.eye(3)[:2]
    return rasteriser.Lamp(
        corners,
        start,
        np.ascontiguousarray(normals),
        planar,
        two_sided,
        corners[0].copy(),
        basis,
        np.ascontiguousarray(np.linalg.pinv(basis).T),
    )


def _flat_basis(pieces: list[FloatArray], normal: FloatArray, size: float) -> FloatArray:
    """Two vectors (2, 3) in a flat light's plane along which to fit the viewport.

    The sides of a parallelogram; otherwise those of the bounding rectangle of least area, which has
    a side along an edge of the convex hull.
    """
    first = pieces[0]
    if len(pieces) == 1 and len(first) == 4 and np.abs(first[0] - first[1] + first[2] - first[3]).max() <= 1e-9 * size:
        return np.stack([first[1] - first[0], first[3] - first[0]])
    u, v = plane_basis(normal)
    flat = (np.concatenate(pieces) - first[0]) @ np.stack([u, v]).T
    best, area = np.stack([u, v]), np.inf
    for piece in pieces:
        for edge in np.roll(piece, -1, axis=0) - piece:
            along = np.asarray([edge @ u, edge @ v])
            length = np.linalg.norm(along)
            if length == 0:
                continue
            turn = np.stack([along, [-along[1], along[0]]]) / length
            sides = np.ptp(flat @ turn.T, axis=0)
            if sides.prod() < area * (1 - 1e-9):
                area = sides.prod()
                best = turn @ np.stack([u, v])
    return best


class _Work:
    """Inputs and answers of one call, filled block by block."""

    def __init__(self, points, normals, own, lamp, occ, viewport, naive, samples):
        count = len(points)
        self.points, self.normals, self.own, self.samples = points, normals, own, samples
        self.lamp, self.occ, self.viewport, self.naive = lamp, occ, viewport, naive
        self.state = np.zeros(count, np.int8)
        self.pixels = np.zeros((count, 2), np.int64)
        self.weights = np.zeros((count, 3))
        self.untouched = np.zeros(count, np.int64)
        self.counts = np.zeros(4, np.int64)

    def draw_with_software(self, conservative: bool, workers: int | None) -> None:
        """Blocks of points over a pool of threads; the kernel holds no lock."""

        def block(first: int) -> IntArray:
            part = slice(first, first + _BLOCK)
            counts = np.zeros(4, np.int64)
            rasteriser.render_points(
                self.points[part],
                self.normals[part],
                self.own[part],
                self.lamp,
                self.occ,
                self.viewport,
                self.naive,
                conservative,
                self.samples[part],
                self.state[part],
                self.pixels[part],
                self.weights[part],
                self.untouched[part],
                counts,
            )
            return counts

        with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
            for counts in pool.map(block, range(0, len(self.points), _BLOCK)):
                self.counts += counts

    def draw_with_gl(self) -> str:
        """Fill the atlas, draw it, count it, until all points are done; the renderer's name."""
        from workbench.shadow.gl_rasteriser import GLRasteriser

        side = _ATLAS // self.viewport
        tile_point = np.empty(side * side, np.int64)
        frames = np.empty((side * side, 3, 3))
        # One point's polygons must fit, however many corners clipping gives them.
        corners = int(max(np.diff(self.occ.start).max(initial=3), np.diff(self.lamp.start).max() + 1)) + 10
        room = max(_VERTICES, 3 * corners * max(len(self.occ.owner), len(self.lamp.start)))
        light, triangles = np.empty((room, 3), np.float32), np.empty((room, 3), np.float32)
        first = 0
        with GLRasteriser(_ATLAS, room) as gl:
            while first < len(self.points):
                first, tiles, light_count, count = rasteriser.emit_tiles(
                    first,
                    self.points,
                    self.normals,
                    self.own,
                    self.lamp,
                    self.occ,
                    self.viewport,
                    _ATLAS,
                    self.naive,
                    self.samples,
                    self.state,
                    tile_point,
                    frames,
                    light,
                    triangles,
                    self.counts,
                )
                if tiles:
                    rows = -(-tiles // side) * self.viewport
                    picture = gl.draw(light[:light_count], triangles[:count], rasteriser.FAR, rows)
                    rasteriser.measure_tiles(
                        picture, tiles, tile_point, frames, self.normals, self.viewport, self.pixels, self.weights
                    )
            return gl.renderer

    def result(self, backend: str, conservative: bool) -> CameraShadows:
        """The shares, the states and the counters."""
        known = np.where(self.state == CameraState.NOT_INSHADOW, 1.0, 0.0)
        known[self.state == CameraState.FALLBACK] = np.nan
        rendered = self.state == CameraState.RENDERED
        shares = []
        for part, whole in (
            (self.weights[:, 1], self.weights[:, 0]),
            (self.pixels[:, 1], self.pixels[:, 0]),
            (self.untouched, self.pixels[:, 0]),
        ):
            share = known.copy()
            # A sliver of a light may cover no pixel at all: that is a FALLBACK too.
            share[rendered] = np.where(
                whole[rendered] > 0, part[rendered] / np.maximum(whole[rendered], 1e-300), np.nan
            )
            shares.append(share)
        self.state[rendered & (self.weights[:, 0] <= 0)] = CameraState.FALLBACK
        state = dict(zip(*np.unique(self.state, return_counts=True), strict=True))
        counters = Counters(
            box_tests=self.counts[rasteriser.BOX_TESTS],
            plane_vertex_checks=self.counts[rasteriser.CHECKS],
            plane_vertex_culls=self.counts[rasteriser.CULLS],
            horizon_culls=state.get(CameraState.UNLIT, 0),
            not_inshadow=state.get(CameraState.NOT_INSHADOW, 0),
            inshadow=state.get(CameraState.INSHADOW, 0),
            camera_renders=int(rendered.sum()),
            camera_polygons=self.counts[rasteriser.DRAWN],
            camera_fallbacks=state.get(CameraState.FALLBACK, 0),
        )
        return CameraShadows(
            state=self.state,
            visible_share=shares[0],
            pixel_fraction=shares[1],
            untouched_fraction=shares[2] if conservative else None,
            light_pixels=self.pixels[:, 0],
            visible_pixels=self.pixels[:, 1],
            light_weight=self.weights[:, 0],
            visible_weight=self.weights[:, 1],
            doubt=np.where(
                rendered,
                np.hypot(self.weights[:, 2] / np.maximum(self.weights[:, 0], 1e-300), self.viewport**-2.0),
                0.0,
            ),
            counters=counters,
            backend=backend,
        )
