"""Matrices of form factors (view factors) between all surfaces or patches of a scene, with obstruction.

The exchange area A_i F_ij of each pair is found once, so the matrix is reciprocal by construction; in a
scene declared closed a symmetric scaling makes its rows sum to 1 without breaking that.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from radiosity.form_factors import _pairs, _stripes
from radiosity.form_factors._covered import covered_pieces
from radiosity.form_factors._ray_shares import MOST_RAYS, Sight, ray_shares
from radiosity.form_factors._refine import REFINING_RAYS, cell_workspace
from radiosity.form_factors._symmetric import SymmetricMatrix
from radiosity.form_factors.hemisphere_rays import (
    COUNTS,
    FIRST_RAYS,
    RANDOMISATIONS,
    HemisphereRays,
    RayExchanges,
    least_seconds,
)
from radiosity.patches import PatchMesh, build_mesh, forecast_elements
from workbench.arrays import as_count, as_fraction
from workbench.culling.shaft import MAX_SHAFT_PLANES
from workbench.culling.tally import add_tally, new_tally
from workbench.errors import InputError, OptionError
from workbench.geometry.coplanar import Occluders, join_coplanar
from workbench.geometry.flat import Geometry
from workbench.memory import require_memory
from workbench.record import RunRecord
from workbench.scene.load import load
from workbench.scene.model import Scene

__all__ = ["ViewFactors", "close_rows", "exchange_areas", "view_factors"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Matrix = Any
"""A dense numpy array, a scipy.sparse.csr_array or, of solves, a :class:`SymmetricMatrix`, (n, n)."""

LEAF = 8
"""Most pieces of a leaf of the tree of pairs."""
STRIPE, SHORT_STRIPE = 48, 8
"""Most pieces of a task, and of one in a scene of few large polygons, whose pairs take long: fixed, so that nothing
depends on the number of workers."""
LARGE = 600
"""Fewer rows than this are large polygons: longer candidate lists are cut, at more points."""
MISSED_OF_FEW = 0.3
"""Share of a large polygon, over the points of a rule, that they may miss though they agree."""
COVERED = 0.01
"""Share of a row of a closed scene that must be missing to count as covered (the floor under a box)."""
BLOCK_ROWS = 128
"""Rows of a matrix that a thread takes at once."""
REFINEMENTS, AIM = 5, 0.8
"""Most rounds of refining, and the part of the wanted error that they aim at: to close rows adds to what is stated."""
ROUNDS = 200
"""Most rounds of the scaling that closes rows."""
DENSE_ENTRY, SPARSE_ENTRY = 12, 16
"""Bytes of a value and its error, and of those with a column: the smaller whole decides."""
SOLVE_ENTRY = 4.0
"""Bytes of an entry of a solve's matrix: half of it in single precision, its patches', what waits for its place."""
CLOSED_TO = 1e-10
"""Error of a row sum at which the scaling ends."""
PAIR_SECONDS = 2e-7
"""Of a pair of pieces at an error of 0.02, in processor seconds: measured on closed rooms of 2,000 and 8,000 triangles,
which are clear for the most part, so that it is seldom less.  It grows with the inverse root of the error."""
FEW_SECONDS, PLANE_SECONDS, CLUTTER_SECONDS = 4e-7, 5e-6, 2.5e-6
"""Of a pair of few pieces at first sight, what each plane a piece adds to it, and to refine it to 0.01 for each plane
and plane a piece: measured on the office, rooms (also in 100 to 400 triangles), Cornell boxes: within a factor of 3."""
MOST_PLANES = 150
"""Planes beyond which more do not make a pair dearer: rays see past them."""
ENGINE_SECONDS, PIECE_SECONDS = 1.5e-3, 2e-5
"""To prepare pairs, and of it each piece."""
WORTH_A_LOOK = 3e-3
"""Seconds that pairs must be expected to take for rays to be tried: below, the answer of pairs is the better one."""

_CENTROID = (np.full((1, 3), 1.0 / 3.0), np.ones(1))
_TRIANGLE_3 = (np.array([[4.0, 1, 1], [1, 4, 1], [1, 1, 4]]) / 6.0, np.full(3, 1.0 / 3.0))
_A, _B = 0.445948490915965, 0.091576213509771
_TRIANGLE_6 = (
    np.array(
        [
            [1 - 2 * _A, _A, _A], [_A, 1 - 2 * _A, _A], [_A, _A, 1 - 2 * _A],
            [1 - 2 * _B, _B, _B], [_B, 1 - 2 * _B, _B], [_B, _B, 1 - 2 * _B],
        ]
    ),
    np.repeat([0.223381589678011, 0.109951743655322], 3),
)  # fmt: skip
"""D. A. Dunavant, "High degree efficient symmetrical Gaussian quadrature rules for the triangle" (1985)."""


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products (..., 3), written out: of few vectors numpy's take several times as long."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


@cache
def _triangle_rule(level: int) -> tuple[FloatArray, FloatArray]:
    """Three points on each of the ``4**level`` parts of a triangle."""
    return _split_triangle(_TRIANGLE_3, level)


def _split_triangle(rule: tuple[FloatArray, FloatArray], level: int) -> tuple[FloatArray, FloatArray]:
    """A rule of barycentric points on each of the ``4**level`` parts of a triangle."""
    cells = [np.eye(3)]
    for _ in range(level):
        cells = [part for cell in cells for part in _quarters(cell)]
    return np.concatenate([rule[0] @ cell for cell in cells]), np.tile(rule[1] / len(cells), len(cells))


def _quarters(cell: FloatArray) -> list[FloatArray]:
    a, b, c = cell
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return [np.stack(part) for part in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]


@cache
def _gauss_square(points: int, cells: int) -> tuple[FloatArray, FloatArray]:
    """A product Gauss rule on each of ``cells`` x ``cells`` parts of the unit square: (n, 2) and weights."""
    x, w = np.polynomial.legendre.leggauss(points)
    x = ((x[None] + 1.0) / 2.0 + np.arange(cells)[:, None]).ravel() / cells
    w = np.tile(w / 2.0, cells) / cells
    return np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2), np.outer(w, w).ravel()


@dataclass(frozen=True)
class _Pieces:
    """Convex pieces in the order of a tree, with all that the kernels read of them."""

    owner: IntArray
    corners: FloatArray
    start: IntArray
    normal: FloatArray
    offset: FloatArray
    centroid: FloatArray
    area: FloatArray
    radius: FloatArray
    low: FloatArray
    high: FloatArray
    group: IntArray
    side: IntArray

    @property
    def count(self) -> int:
        return len(self.area)


def _rule_points(
    pieces: _Pieces, triangle: tuple[FloatArray, FloatArray], square: tuple[FloatArray, FloatArray]
) -> tuple[IntArray, FloatArray]:
    """Weighted points (n, 4) of a rule on each piece, and where each piece's begin."""
    sizes = np.diff(pieces.start)
    fans = np.where(sizes == 4, 0, sizes - 2)
    each = np.where(sizes == 4, len(square[1]), fans * len(triangle[1]))
    start = np.concatenate([[0], np.cumsum(each)]).astype(np.int64)
    out = np.empty((start[-1], 4))
    quads = np.flatnonzero(sizes == 4)
    if len(quads):
        c = pieces.corners[pieces.start[quads][:, None] + np.arange(4)]
        u, v = square[0][:, 0], square[0][:, 1]
        shape = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=1)
        along = (1 - v)[:, None] * (c[:, 1] - c[:, 0])[:, None] + v[:, None] * (c[:, 2] - c[:, 3])[:, None]
        across = (1 - u)[:, None] * (c[:, 3] - c[:, 0])[:, None] + u[:, None] * (c[:, 2] - c[:, 1])[:, None]
        row = start[quads][:, None] + np.arange(len(u))
        out[row, :3] = shape @ c
        out[row, 3] = square[1] * np.linalg.norm(_cross(along, across), axis=2)
    rest = np.flatnonzero(sizes != 4)
    if len(rest):
        which = np.repeat(rest, fans[rest])
        step = np.arange(len(which)) - np.repeat(np.cumsum(fans[rest]) - fans[rest], fans[rest])
        first = pieces.start[which]
        c = pieces.corners[np.stack([first, first + step + 1, first + step + 2], axis=1)]
        size = 0.5 * np.linalg.norm(_cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]), axis=1)
        n = len(triangle[1])
        row = (start[which] + step * n)[:, None] + np.arange(n)
        out[row, :3] = triangle[0] @ c
        out[row, 3] = triangle[1] * size[:, None]
    return start, out


@dataclass(frozen=True)
class _Elements:
    """What matrices read of a mesh; of whole polygons it is made without one, at once."""

    corners: FloatArray
    piece_start: IntArray
    piece_element: IntArray
    piece_normal: FloatArray
    element_area: FloatArray
    element_polygon: IntArray
    element_surface: IntArray
    element_side: IntArray

    @property
    def element_count(self) -> int:
        return len(self.element_area)

    @property
    def element_normal(self) -> FloatArray:
        """Normal (n, 3) of each element: that of its first piece, since none is a cluster."""
        return self.piece_normal[np.searchsorted(self.piece_element, np.arange(self.element_count))]

    @classmethod
    def of_mesh(cls, mesh: PatchMesh) -> _Elements:
        """The elements of a divided scene."""
        return cls(
            mesh.corners, mesh.piece_start, mesh.piece_element, mesh.piece_normal, mesh.element_area,
            mesh.element_polygon, mesh.element_surface, mesh.element_side,
        )  # fmt: skip

    @classmethod
    def of_polygons(cls, geometry: Geometry) -> _Elements:
        """A polygon an element, and its back another where both sides exchange."""
        two = np.asarray([material.two_sided for material in geometry.surface_material], dtype=bool)
        both = two[geometry.polygon_surface]
        polygon = np.repeat(np.arange(geometry.polygon_count), np.where(both, 2, 1))
        side = np.ones(len(polygon), dtype=np.int64)
        side[1:][polygon[1:] == polygon[:-1]] = -1
        # Pieces of each element, and the corners of each piece: backwards on backs.
        first, last = geometry.polygon_piece_start[polygon], geometry.polygon_piece_start[polygon + 1]
        owner = np.repeat(np.arange(len(polygon)), last - first)
        piece = np.arange(len(owner)) - np.repeat(np.cumsum(last - first) - (last - first), last - first)
        piece += np.repeat(first, last - first)
        sizes = np.diff(geometry.piece_start)[piece]
        start = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        step = np.arange(start[-1]) - np.repeat(start[:-1], sizes)
        turned = np.repeat(side[owner] < 0, sizes)
        row = np.where(turned, np.repeat(geometry.piece_start[piece + 1] - 1, sizes) - step, step)
        row = np.where(turned, row, row + np.repeat(geometry.piece_start[piece], sizes))
        return cls(
            np.ascontiguousarray(geometry.corners[row]),
            start,
            owner.astype(np.int64),
            np.ascontiguousarray(geometry.piece_normal[piece] * side[owner, None]),
            geometry.polygon_area[polygon],
            polygon.astype(np.int64),
            geometry.polygon_surface[polygon],
            side,
        )


def _mesh_pieces(mesh: _Elements, occluders: Occluders) -> _Pieces:
    """The pieces of a mesh, in its order."""
    start = mesh.piece_start
    sizes = np.diff(start)
    ring = np.repeat(np.arange(len(sizes)), sizes)
    after = np.arange(len(mesh.corners)) + 1
    after[start[1:] - 1] = start[:-1]
    origin = mesh.corners[start[:-1]][ring]
    part = 0.5 * _cross(mesh.corners - origin, mesh.corners[after] - origin)
    signed = np.einsum("ij,ij->i", part, mesh.piece_normal[ring])
    area = np.bincount(ring, signed, len(sizes)).astype(np.float64)
    middle = (origin + mesh.corners + mesh.corners[after]) / 3.0
    centroid = (
        np.stack([np.bincount(ring, signed * middle[:, k], len(sizes)) for k in range(3)], axis=1) / area[:, None]
    )
    away = np.linalg.norm(mesh.corners - centroid[ring], axis=1)
    polygon = mesh.element_polygon[mesh.piece_element]
    return _Pieces(
        owner=mesh.piece_element,
        corners=mesh.corners,
        start=start,
        normal=mesh.piece_normal,
        offset=np.einsum("ij,ij->i", mesh.piece_normal, mesh.corners[start[:-1]]),
        centroid=centroid,
        area=area,
        radius=np.maximum.reduceat(away, start[:-1]),
        low=np.minimum.reduceat(mesh.corners, start[:-1]),
        high=np.maximum.reduceat(mesh.corners, start[:-1]),
        group=occluders.polygon_group[polygon],
        side=np.where(np.einsum("ij,ij->i", mesh.piece_normal, _group_normals(mesh, occluders, polygon)) < 0, -1, 1),
    )


def _group_normals(mesh: _Elements, occluders: Occluders, polygon: IntArray) -> FloatArray:
    """One normal a plane group, at each piece."""
    normal = np.empty((int(occluders.polygon_group.max()) + 1, 3))
    normal[occluders.polygon_group[polygon]] = mesh.piece_normal
    return normal[occluders.polygon_group[polygon]]


def _reordered(pieces: _Pieces, order: IntArray) -> _Pieces:
    sizes = np.diff(pieces.start)[order]
    start = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    rows = np.arange(start[-1]) - np.repeat(start[:-1], sizes) + np.repeat(pieces.start[order], sizes)
    rest = {
        name: np.ascontiguousarray(getattr(pieces, name)[order])
        for name in ("owner", "normal", "offset", "centroid", "area", "radius", "low", "high", "group", "side")
    }
    return _Pieces(corners=np.ascontiguousarray(pieces.corners[rows]), start=start, **rest)


@dataclass(frozen=True)
class _Tree:
    """Nodes over ranges of pieces; ``group`` is -1 unless all pieces lie in one plane and face one way."""

    first: IntArray
    last: IntArray
    left: IntArray
    right: IntArray
    low: FloatArray
    high: FloatArray
    group: IntArray
    normal: FloatArray
    offset: FloatArray
    stripes: IntArray


def _build_tree(pieces: _Pieces) -> tuple[_Tree, IntArray]:
    """Tree over pieces, planes kept together as long as possible, and the order of its pieces."""
    key = np.unique(np.stack([pieces.group, pieces.side], axis=1), axis=0, return_inverse=True)[1].ravel()
    key = key.astype(np.int64)
    # Centre of each plane's pieces, for the upper part of the tree.
    count = np.bincount(key)
    middle = np.stack([np.bincount(key, pieces.centroid[:, k]) / count for k in range(3)], axis=1)
    nodes: list[list[int]] = []
    order: list[IntArray] = []
    stripes: list[int] = []
    placed = 0
    widest = SHORT_STRIPE if STRIPE < pieces.count < LARGE else STRIPE
    # Entries: pieces, parent's row and column to fill in, whether a stripe lies above.
    stack: list[tuple[IntArray, int, int, bool]] = [(np.arange(pieces.count), -1, 0, False)]
    while stack:
        inside, parent, column, striped = stack.pop()
        row = len(nodes)
        if parent >= 0:
            nodes[parent][column] = row
        planes = key[inside]
        single = bool((planes == planes[0]).all())
        nodes.append([placed, placed + len(inside), -1, -1, int(inside[0]) if single else -1])
        if not striped and len(inside) <= widest:
            stripes.append(row)
            striped = True
        if len(inside) <= LEAF:
            order.append(inside)
            placed += len(inside)
            continue
        place = pieces.centroid[inside] if single else middle[planes]
        axis = int(np.argmax(np.ptp(place, axis=0)))
        ranked = inside[np.lexsort((inside, planes, place[:, axis]))]
        half = len(ranked) // 2
        if not single:
            # Cut between planes, not through one.
            change = np.flatnonzero(np.diff(key[ranked])) + 1
            half = int(change[np.argmin(np.abs(change - half))])
        stack.append((ranked[half:], row, 3, striped))
        stack.append((ranked[:half], row, 2, striped))
    table = np.asarray(nodes, dtype=np.int64)
    final = np.concatenate(order).astype(np.int64)
    low, high = pieces.low[final], pieces.high[final]
    node_low = np.stack([low[a:b].min(axis=0) for a, b in table[:, :2]])
    node_high = np.stack([high[a:b].max(axis=0) for a, b in table[:, :2]])
    lead = table[:, 4]
    flat = lead >= 0
    tree = _Tree(
        first=table[:, 0].copy(),
        last=table[:, 1].copy(),
        left=table[:, 2].copy(),
        right=table[:, 3].copy(),
        low=node_low,
        high=node_high,
        group=np.where(flat, pieces.group[lead], -1),
        normal=np.ascontiguousarray(np.where(flat[:, None], pieces.normal[lead], 0.0)),
        offset=np.where(flat, pieces.offset[lead], 0.0),
        stripes=np.asarray(stripes, dtype=np.int64),
    )
    return tree, final


def _occluder_frames(occluders: Occluders) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Of each occluder its plane's frame (origin, u, v), flat corners, and their lowest and highest (u, v)."""
    count = occluders.count
    # As plane_basis, all at once.
    u = _cross(np.eye(3)[np.argmin(np.abs(occluders.normal), axis=1)], occluders.normal)
    u /= np.linalg.norm(u, axis=1)[:, None]
    frame = np.hstack([occluders.corners[occluders.start[:-1]], u, _cross(occluders.normal, u)])
    ring = np.repeat(np.arange(count), np.diff(occluders.start))
    off = occluders.corners - frame[ring, :3]
    flat = np.stack([np.einsum("ij,ij->i", off, frame[ring, 3:6]), np.einsum("ij,ij->i", off, frame[ring, 6:])], axis=1)
    low = np.minimum.reduceat(flat, occluders.start[:-1]) if count else np.empty((0, 2))
    high = np.maximum.reduceat(flat, occluders.start[:-1]) if count else np.empty((0, 2))
    return frame, np.ascontiguousarray(flat), low, high


@dataclass(frozen=True)
class _Care:
    """How the wanted error is spent."""

    error: float
    share_error: float
    floor: float
    first: int
    levels: int
    missed: float
    limit: int
    reach: FloatArray

    @classmethod
    def for_error(cls, error: float, count: int, loose: bool = True) -> _Care:
        """Settings for an L1 error of the rows: half of it for open exchanges, half for visible shares."""
        relative = 0.5 * error
        first = 0 if loose and error > 1e-2 and count >= LARGE else 1
        rules = (_pairs.POINT_RULE, 2.0), (_pairs.COARSE_RULE, 4.0), (_pairs.FINE_RULE, 5.6), (_pairs.LAMBERT_RULE, 5.6)
        return cls(
            error=relative,
            # Pairs seen in part carry about a tenth of a row.
            share_error=6.0 * error,
            floor=1.0 / max(count, 1),
            # Mean error of a share by rules of 1, 3, 12, 48, ... points a triangle: 5 %, 2.5 %, 0.6 %, 0.2 %, ...
            # Few and large polygons have more in their shadows: they get a level more.
            first=first,
            levels=2 if loose and count < LARGE else (1, 2)[first] + sum(error < e for e in (1e-2, 3e-3, 4e-4, 5e-5)),
            # A hundred thousand pairs do not all miss the same way; the few of a small scene may.
            missed=MISSED_OF_FEW if loose and count < LARGE else 0.06,
            limit=min(12 if error > 5e-3 else 32 if count >= LARGE else _pairs.MAX_CUT, _pairs.MAX_CUT),
            reach=np.array([(factor / relative) ** (1.0 / power) for factor, power in rules]),
        )


class _Stripe(NamedTuple):
    """What was found in a stripe: rows, exchange areas and errors of its pairs, and what it took."""

    row: NDArray[np.int32]
    column: NDArray[np.int32]
    value: FloatArray
    error: NDArray[np.float32]
    bins: FloatArray
    tally: NDArray[np.int64]
    rays: int
    refined: int

    def merged(self, rows: int) -> _Stripe:
        """The same with pairs of the same rows added up."""
        return _Stripe(*_merged(self.row, self.column, self.value, self.error, rows), *self[4:])


class _Engine:
    """What the stripes of one matrix share: arrays, settings, threads' scratch."""

    def __init__(self, mesh: _Elements, geometry: Geometry, care: _Care, seed: int) -> None:
        self.occluders = join_coplanar(geometry)
        pieces = _mesh_pieces(mesh, self.occluders)
        self.tree, order = _build_tree(pieces)
        self.pieces = _reordered(pieces, order)
        self.care, self.seed = care, seed
        self.geometry = geometry
        self._building = Lock()
        p, t, o = self.pieces, self.tree, self.occluders
        frame, flat, flow, fhigh = _occluder_frames(o)
        levels = [_rule_points(p, _CENTROID, _gauss_square(1, 1))]
        levels += [_rule_points(p, _triangle_rule(k), _gauss_square(2, 2**k)) for k in range(max(care.levels - 1, 1))]
        ends = np.cumsum([0] + [len(points) for _, points in levels])
        points = np.concatenate([points for _, points in levels])
        level_starts = np.stack([start + end for (start, _), end in zip(levels, ends[:-1], strict=True)])
        fine_start, fine = _rule_points(p, _TRIANGLE_6, _gauss_square(3, 1))
        self._polygon = mesh.element_polygon
        self._occluder_boxes = [
            bound.reduceat(o.corners, o.start[:-1]) if o.count else np.empty((0, 3))
            for bound in (np.minimum, np.maximum)
        ]
        self._nodes = (t.first, t.last, t.left, t.right, t.low, t.high, t.group, t.normal, t.offset)
        self._constant = (
            p.corners, p.start, p.normal, p.offset, p.centroid, p.area, p.radius, p.low, p.high, p.group,
            points, level_starts, fine, fine_start,
            o.corners, o.start, o.normal, o.offset, o.group, o.through, frame, flat, flow, fhigh,
            *self._occluder_boxes, o.slack, care.error, care.share_error, care.floor, care.first, care.levels,
            care.missed, care.reach, care.limit,
        )  # fmt: skip
        self._corners = int(max(np.diff(p.start).max(), np.diff(o.start).max(initial=3), 8))
        self._idle: list[tuple[Any, ...]] = []

    def _scratch(self) -> tuple[Any, ...]:
        if self._idle:
            return self._idle.pop()
        widest = int((self.tree.last - self.tree.first)[self.tree.stripes].max())
        return (
            *_pairs.pair_workspace(self._corners),
            *cell_workspace(self.occluders.count, 2 * self._corners + 16),
            np.empty((MAX_SHAFT_PLANES, 4)),
            np.empty((16, 3)),
            np.empty(96 * (self.occluders.count + 1), dtype=np.int64),
            np.empty((1024, 4), dtype=np.int64),
            np.zeros((widest, self.pieces.count)),
            np.zeros((widest, self.pieces.count)),
        )

    def stripe(
        self, node: int, row_of: NDArray[np.int32], importance: FloatArray, threshold: float = math.inf
    ) -> _Stripe:
        """The pairs of a stripe's pieces with all that come after each.

        Pairs whose error times the ``importance`` of both pieces is above ``threshold`` are refined.
        """
        scratch = self._scratch()
        try:
            rows = int(self.tree.last[node] - self.tree.first[node])
            out, spread = scratch[-2][:rows], scratch[-1][:rows]
            room = 4096
            while True:
                flagged = np.empty((room, 2), dtype=np.int64)
                tally = new_tally()
                flags, refined = _stripes.stripe(
                    node, *self._nodes, *self._constant, importance, *scratch[:-2], out, spread, flagged, threshold,
                    tally,
                )  # fmt: skip
                if flags <= room:
                    break
                room = int(flags)
            traced = 0
            base = int(self.tree.first[node])
            if flags:
                traced = self._by_rays(flagged[:flags], base, out, spread, importance, threshold)
            # A pair that no point saw may still exchange a little: its error stays.
            count = _stripes.count_pairs(spread, rows)
            r, c = np.empty(count, dtype=np.int32), np.empty(count, dtype=np.int32)
            value, error = np.empty(count), np.empty(count, dtype=np.float32)
            bins = np.zeros((_stripes.BINS, 2))
            _stripes.take_pairs(out, spread, rows, base, row_of, importance, r, c, value, error, bins)
            return _Stripe(r, c, value, error, bins, tally, traced, int(refined))
        finally:
            self._idle.append(scratch)

    def pairs_after(self, node: int) -> int:
        """Twice the number of pairs of a stripe."""
        first, last = int(self.tree.first[node]), int(self.tree.last[node])
        return (last - first) * (2 * self.pieces.count - first - last)

    def _by_rays(
        self, pairs: IntArray, base: int, out: FloatArray, spread: FloatArray, importance: FloatArray, threshold: float
    ) -> int:
        i, j = pairs[:, 0], pairs[:, 1]
        whole = out[i - base, j]
        smaller = np.minimum(self.pieces.area[i], self.pieces.area[j])
        goals = self.care.share_error * (1.0 + self.care.floor * smaller / whole)
        goals = np.minimum(goals, threshold / (whole * (importance[i] + importance[j])))
        most = MOST_RAYS if threshold == math.inf else REFINING_RAYS
        share, doubt, traced = ray_shares(pairs, goals, whole, self.seed, self.pieces, self.sight(), most)
        out[i - base, j] = whole * share
        spread[i - base, j] = spread[i - base, j] * share + whole * doubt
        return traced

    def touched(self, row_of: IntArray, rows: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which of the asked rows have something standing or lying on them."""
        p, o = self.pieces, self.occluders
        asked = np.flatnonzero(rows[row_of])
        out = np.zeros(len(asked), dtype=bool)
        if len(asked):
            covered_pieces(
                asked, p.corners, p.start, p.normal, p.low, p.high, p.group, p.side, self._polygon[p.owner],
                o.corners, o.start, o.group, self._occluder_boxes[0], self._occluder_boxes[1],
                max(o.slack, 1e-9 * self.geometry.size), out,
            )  # fmt: skip
        found = np.zeros(len(rows), dtype=bool)
        found[row_of[asked[out]]] = True
        return found

    @cached_property
    def _sight(self) -> Sight:
        return Sight(self.geometry)

    def sight(self) -> Sight:
        """What rays pass, built when the first thread needs it."""
        with self._building:
            return self._sight


def close_rows(exchange: Matrix, wanted: FloatArray, to: float = CLOSED_TO, *, over_area: bool = False) -> FloatArray:
    """Scale factors x so that ``x_i x_j S_ij`` has the wanted row sums; rows of nothing keep 1.

    Symmetric scaling keeps reciprocity, zeros and signs (cf. J. van Leersum, "A method for determining a
    consistent set of radiation view factors from a set generated by a nonexact method", Int. J. Heat Fluid
    Flow 10(1), 1989, who corrects additively).

    Parameters
    ----------
    exchange : (n, n) float, dense, sparse or a SymmetricMatrix
        Symmetric exchange areas A_i F_ij.
    wanted : (n,) float
        Row sums to reach: the areas, without what is covered of them.
    to : float
        Relative error of the row sums at which the scaling ends.
    over_area : bool
        Whether their mean is meant, weighted by ``wanted``, and not the worst.  Two faces of a narrow gap see hardly
        more than each other: their sums close very slowly.

    Returns
    -------
    (n,) float
    """
    x = np.ones(len(wanted))
    for _ in range(ROUNDS):
        sums = x * (exchange @ x)
        live = (sums > 0) & (wanted > 0)
        ratio = np.divide(wanted, sums, out=np.ones(len(wanted)), where=live)
        each = np.abs(ratio - 1.0)
        off = float(wanted @ each / wanted.sum()) if over_area else float(each.max(initial=0.0))
        if off < to:
            break
        # A step leaves the square of what was off: to solve for it more closely would be wasted.
        fraction = min(max(off, 0.1 * to / off), 0.01)
        step = _newton_step(exchange, x, sums, np.where(live, wanted - sums, 0.0), fraction)
        # Far from the goal a step could turn a sign: there the plain scaling goes on.
        x *= 1.0 + step if np.abs(step).max() < 0.3 else np.sqrt(ratio)
    return x


def _newton_step(exchange: Matrix, x: FloatArray, sums: FloatArray, missing: FloatArray, fraction: float) -> FloatArray:
    """Relative change d of x by Newton: ``(diag(sums) + X S X) d = missing``, by conjugate gradients.

    They end where ``fraction`` of what is missing is left.
    """
    diagonal = np.where(sums > 0, sums, 1.0)
    d = np.zeros_like(x)
    rest = missing.copy()
    along = rest / diagonal
    square = float(rest @ along)
    goal = fraction * fraction * square
    for _ in range(50):
        if square <= goal:
            break
        image = sums * along + x * (exchange @ (x * along))
        step = square / float(along @ image)
        d += step * along
        rest -= step * image
        scaled = rest / diagonal
        square, before = float(rest @ scaled), square
        along = scaled + square / before * along
    return d


@dataclass(frozen=True)
class ViewFactors:
    """Form factors (view factors) between the surfaces or patches of a scene.

    Parameters
    ----------
    matrix : (n, n) float, numpy array or scipy.sparse.csr_array
        Row ``i`` holds F from ``i`` to each ``j``, the share of what leaves ``i`` that reaches ``j``.
    standard_error : (n, n) float, of the same form
        Estimated error of each entry: of its quadrature, its visible share and the closing of the rows.
    areas : (n,) float
        [scene lengths squared]
    names : list of str
    row_sums : (n,) float
        Sums of the rows as found.
    closure_correction : float
        Largest change of an entry of F by closing the rows; 0 in open scenes.
    reciprocity : float
        Largest |A_i F_ij - A_j F_ji| over the largest exchange area.
    record : RunRecord
        Settings, seconds, counters and errors.
    """

    matrix: Matrix
    standard_error: Matrix
    areas: FloatArray
    names: list[str]
    row_sums: FloatArray
    closure_correction: float
    reciprocity: float
    record: RunRecord

    @property
    def sparse(self) -> bool:
        """Whether the matrix is stored sparse."""
        return not isinstance(self.matrix, np.ndarray)

    def dense(self) -> FloatArray:
        """The matrix as a numpy array, (n, n)."""
        return self.matrix if isinstance(self.matrix, np.ndarray) else self.matrix.toarray()

    def save(self, path: str | Path) -> None:
        """Write ``.npz`` (everything) or ``.csv`` (entries whose value or error is not 0), whole or not at all.

        The npz holds ``areas``, ``names``, ``row_sums`` and either ``F`` and ``standard_error`` or their CSR
        parts ``F_data``, ``F_indices``, ``F_indptr``, ``standard_error_data`` (the same places).  The csv has a
        line an entry: ``from,to,F,standard_error``.

        Raises
        ------
        InputError
            If the suffix is another, or the file cannot be written.
        """
        path = Path(path)
        if path.suffix not in (".npz", ".csv"):
            raise InputError(f"{path}: found the suffix {path.suffix!r}, expected .npz or .csv")
        beside = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
        try:
            if path.suffix == ".npz":
                self._write_npz(beside)
            else:
                self._write_csv(beside)
            beside.replace(path)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}; give another file") from None
        finally:
            beside.unlink(missing_ok=True)

    def _write_npz(self, path: Path) -> None:
        parts: dict[str, Any] = {"areas": self.areas, "names": np.asarray(self.names), "row_sums": self.row_sums}
        if isinstance(self.matrix, np.ndarray):
            parts |= {"F": self.matrix, "standard_error": self.standard_error}
        else:
            assert not isinstance(self.standard_error, np.ndarray)
            parts |= {
                "F_data": self.matrix.data,
                "F_indices": self.matrix.indices,
                "F_indptr": self.matrix.indptr,
                "standard_error_data": self.standard_error.data,
            }
        np.savez(path, **parts)

    def _write_csv(self, path: Path) -> None:
        quoted = ['"' + name.replace('"', '""') + '"' if set(name) & set(',"\n') else name for name in self.names]
        with path.open("w", encoding="utf-8") as out:
            out.write("from,to,F,standard_error\n")
            for i, name in enumerate(quoted):
                if isinstance(self.matrix, np.ndarray):
                    row, error = self.matrix[i], self.standard_error[i]
                    where = np.flatnonzero((row != 0) | (error != 0))
                    values, errors = row[where], error[where]
                else:
                    a, b = self.matrix.indptr[i : i + 2]
                    where, values = self.matrix.indices[a:b], self.matrix.data[a:b]
                    errors = self.standard_error.data[a:b]
                out.writelines(
                    f"{name},{quoted[j]},{value:.12g},{error:.3g}\n"
                    for j, value, error in zip(where.tolist(), values.tolist(), errors.tolist(), strict=True)
                )


def _names(mesh: _Elements, geometry: Geometry, by: str) -> tuple[IntArray, list[str]]:
    """Row of each element, and the name of each row."""
    back = mesh.element_side < 0
    if by == "surface":
        key = np.stack([mesh.element_surface, back], axis=1)
        rows, owner = np.unique(key, axis=0, return_inverse=True)
        names = [geometry.surface_name[s] + (" (back)" if b else "") for s, b in rows.tolist()]
        return owner.ravel().astype(np.int64), names
    polygon, surface = mesh.element_polygon, mesh.element_surface
    faces = np.bincount(geometry.polygon_surface, minlength=len(geometry.surface_name))
    parts = np.bincount(polygon[~back], minlength=geometry.polygon_count)
    first = np.concatenate([[0], np.flatnonzero(np.diff(polygon) | np.diff(mesh.element_side)) + 1])
    step = np.arange(len(polygon)) - np.repeat(first, np.diff(np.append(first, len(polygon))))
    names = []
    for e in range(len(polygon)):
        name = geometry.surface_name[surface[e]]
        if faces[surface[e]] > 1:
            name += f"[{geometry.polygon_face[polygon[e]]}]"
        if parts[polygon[e]] > 1:
            name += f".{step[e]}"
        names.append(name + (" (back)" if back[e] else ""))
    return np.arange(len(polygon)), names


def _facing_share(engine_pieces: _Pieces, seed: int) -> float:
    """Share of pairs whose fronts have a point before each other: the most that can exchange."""
    rng = np.random.default_rng(seed)
    i, j = rng.integers(0, engine_pieces.count, (2, 4096))
    c, n, r = engine_pieces.centroid, engine_pieces.normal, engine_pieces.radius
    along = c[j] - c[i]
    before = np.einsum("ij,ij->i", n[i], along) > -r[j]
    return float((before & (np.einsum("ij,ij->i", n[j], along) < r[i])).mean())


def _forecast(count: float, facing: float, workers: int) -> float:
    """Bytes of the exchange areas as found, of the matrix with its errors, and of the threads' stripes."""
    found = 0.5 * facing * count**2 * 24.0
    kept = min(16.0, 24.0 * facing) * count**2
    return found + kept + workers * 2.0 * STRIPE * count * 8.0


Progress = Callable[[float], None]


def view_factors(
    scene: Scene | str | Path,
    *,
    by: str = "patch",
    error: float = 1e-3,
    elements: int | None = None,
    max_edge: float | None = None,
    workers: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> ViewFactors:
    """View factors between all surfaces or patches of a scene, with obstruction.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, or what :func:`workbench.load` takes.
    by : str
        ``patch``: a row a polygon (or an element of it, see below); ``surface``: a row a surface, the
        area-weighted mean over its polygons.  A two-sided surface has a row a side.
    error : float
        Wanted error: the mean over the rows of the sum of |F_ij - exact|.
    elements, max_edge : optional
        Divide the polygons first, as :func:`radiosity.solve` does.  Default: not at all.
    workers : int, optional
        Threads, all cores by default.  The answer does not depend on it.
    seed : int
        Of the rays, where rays decide.
    progress : callable, optional
        Called with the share done, 0 to 1.

    Returns
    -------
    ViewFactors

    Raises
    ------
    InputError, OptionError
        If the scene has no surface or an option is out of its range.
    MemoryForecastError
        If the matrix would not fit in memory.

    Notes
    -----
    Clear pairs get a closed form or a quadrature of that accuracy; pairs behind a few polygons are cut
    exactly at the points of a rule (facets of one plane block as one polygon); only the rest gets rays.
    Then the pairs that make the stated error larger than ``error``, and only those, are refined: both ends are
    halved where the pair's error is made.
    Where that is expected to take long, a few rays from each row tell how many would be needed instead, and the
    cheaper way is taken (rays where rows are few for the polygons, or the scene is cluttered and the error coarse): see
    :mod:`radiosity.form_factors.hemisphere_rays`.  The record says which (``method``) and the processor seconds
    predicted of both.  An entry that no ray has met has an error of three hits, a bound; the stated row error counts
    all of these together and may be less than their sum.
    In a scene declared closed rows are closed by a symmetric scaling, see :func:`close_rows`; a row on which
    something stands and that lacks more than 1 % (and than four times its error) is covered and keeps what it has.
    """
    scene = load(scene)
    threads = as_count(workers, "workers") if workers is not None else len(os.sched_getaffinity(0))
    if by not in ("patch", "surface"):
        raise OptionError(f"by: found {by!r}, expected 'patch' or 'surface'")
    error, seed = as_fraction(error, "error"), as_count(seed, "seed", 0)
    where = str(scene.path) if scene.path is not None else scene.name
    if not any(surface.face_count for surface in scene.surfaces):
        raise InputError(f"{where}: found no surface; add a [[surface]] to the scene")
    advice = "ask for fewer elements, a larger max_edge, or by='surface'"
    if elements is not None:
        count = float(elements)
    elif max_edge is not None:
        count = float(forecast_elements(scene, max_edge, 1))
    else:
        count = float(sum(surface.face_count for surface in scene.surfaces))
    require_memory(3000.0 * count, f"a mesh of {count:.3g} elements", advice)
    record = RunRecord(
        "viewfactors",
        {
            "scene": scene.name, "by": by, "error": error, "elements": elements, "max_edge": max_edge,
            "workers": threads, "seed": seed,
        },
    )  # fmt: skip
    with record.stage("mesh"):
        geometry = Geometry.from_scene(scene)
        if elements is None and max_edge is None:
            mesh = _Elements.of_polygons(geometry)
        else:
            mesh = _Elements.of_mesh(
                build_mesh(scene, geometry, elements=elements, max_edge=max_edge, split=1, cluster=False)
            )
        row_of, names = _names(mesh, geometry, by)
        areas = np.bincount(row_of, mesh.element_area, len(names)).astype(np.float64)
        if not (areas > 0).all():
            flat = int(np.argmin(areas))
            raise InputError(
                f"{where}: found {names[flat]} with no area; leave out polygons whose corners lie in a line"
            )
    what = f"a matrix of {len(names)} x {len(names)} view factors"
    predicted = {"pairs": _pair_seconds(mesh, geometry, len(names), error)}
    record.results["predicted_seconds"] = predicted
    # Rays end at panes.
    clear = not geometry.polygon_transmittance.any()
    rays = None
    if clear and predicted["pairs"] > max(WORTH_A_LOOK, least_seconds(len(names), len(mesh.piece_element), error)):
        with record.stage("prepare"), _threads(threads, len(mesh.piece_element)) as each:
            require_memory(_ray_forecast(len(names), len(mesh.piece_element)), what, advice)
            rays = RayExchanges(HemisphereRays(mesh, row_of), areas, seed, record.counters)
            rays.add(FIRST_RAYS, each)
            predicted["hemisphere rays"] = rays.seconds(error)
            if predicted["hemisphere rays"] > predicted["pairs"]:
                rays = None
    record.results["method"] = "pairs" if rays is None else "hemisphere rays"
    surplus = 0.0
    if rays is not None:
        with record.stage("exchange areas"), _threads(threads, len(mesh.piece_element)) as each:
            rays.reach(error, each, progress)
            exchange, spread = _smaller(*rays.matrices())
        record.results["rays_a_row"] = rays.rays
        surplus = rays.surplus

        def touched(rows: NDArray[np.bool_]) -> NDArray[np.bool_]:
            engine = _Engine(mesh, geometry, _Care.for_error(error, mesh.element_count), seed)
            return engine.touched(row_of[engine.pieces.owner], rows)

        occluders = geometry.polygon_count
    else:
        with record.stage("prepare"):
            engine = _Engine(mesh, geometry, _Care.for_error(error, mesh.element_count), seed)
            facing = _facing_share(engine.pieces, seed) if engine.pieces.count > LARGE else 1.0
            require_memory(_forecast(len(names), facing, threads), what, advice)
        piece_row = row_of[engine.pieces.owner]
        with record.stage("exchange areas"):
            exchange, spread = _all_exchanges(engine, piece_row, areas, threads, record, progress, error)

        def touched(rows: NDArray[np.bool_]) -> NDArray[np.bool_]:
            return engine.touched(piece_row, rows)

        occluders = engine.occluders.count
    with record.stage("close"):
        found = _finished(scene, exchange, spread, areas, names, record, touched, threads, surplus)
    record.results.update(rows=len(names), pieces=len(mesh.piece_element), occluders=occluders, sparse=found.sparse)
    return found


def _pair_seconds(mesh: _Elements, geometry: Geometry, rows: int, error: float) -> float:
    """Processor seconds that pairs are expected to take.

    Pairs of few large polygons are refined behind most of the scene's planes, those of planes in many pieces seldom;
    errors of many pieces in one row cancel in part.
    """
    pieces = len(mesh.piece_element)
    pairs = 0.5 * pieces**2
    prepare = ENGINE_SECONDS + PIECE_SECONDS * pieces
    if pieces >= LARGE:
        return prepare + pairs * PAIR_SECONDS * math.sqrt(0.02 / error)
    planes = geometry.polygon_count
    if prepare + pairs * (FEW_SECONDS + planes / pieces * PLANE_SECONDS) > WORTH_A_LOOK:
        normal = geometry.polygon_normal
        corner = geometry.corners[geometry.piece_start[geometry.polygon_piece_start[:-1]]] - geometry.bounds[0]
        plane = np.column_stack([normal, np.einsum("ij,ij->i", normal, corner) / geometry.size])
        plane *= np.where(plane[np.arange(len(plane)), np.abs(normal).argmax(axis=1)] < 0, -1.0, 1.0)[:, None]
        planes = len(np.unique(np.round(1e6 * plane + 0.237), axis=0))
    planes = min(planes, MOST_PLANES)
    refine = CLUTTER_SECONDS * planes * (0.01 / error) ** 0.9 * math.sqrt(rows / pieces)
    return prepare + pairs * (FEW_SECONDS + planes / pieces * (PLANE_SECONDS + refine))


def _ray_forecast(rows: int, pieces: int) -> float:
    """Bytes of a ray matrix and what it is made of, of the counts held at once, and of the triangles."""
    return 100.0 * rows**2 + 16.0 * max(COUNTS, RANDOMISATIONS * rows) + 1000.0 * pieces


def _smaller(exchange: FloatArray, spread: NDArray[np.float32]) -> tuple[Matrix, Matrix]:
    """Both matrices sparse where that is smaller; what has a value has an error."""
    if SPARSE_ENTRY * np.count_nonzero(spread) >= DENSE_ENTRY * spread.size:
        return exchange, spread
    import scipy.sparse  # takes longer than a small solve, for matrices that are sparse only

    row, column = np.nonzero(spread)
    start = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(spread)))])
    made = [
        scipy.sparse.csr_array((m[row, column], column.astype(np.int32), start), shape=m.shape)
        for m in (exchange, spread)
    ]
    return made[0], made[1]


def exchange_areas(
    mesh: PatchMesh,
    geometry: Geometry,
    record: RunRecord,
    *,
    error: float = 1e-3,
    workers: int = 1,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[SymmetricMatrix, FloatArray, FloatArray]:
    """Exchange areas ``A_i F_ij`` between the elements of a mesh, reciprocal by construction, and their errors.

    Errors are kept summed up: what they do to the light of a solution needs no more.

    Parameters
    ----------
    mesh, geometry : PatchMesh, Geometry
    record : RunRecord
        Gets the counters.
    error : float
        As in :func:`view_factors`.
    workers, seed, progress
        As in :func:`view_factors`.

    Returns
    -------
    exchange : SymmetricMatrix
        (n, n). [scene lengths squared]
    doubt : (n,) float
        Sum of the errors of each row. [scene lengths squared]
    square : (n,) float
        Sum over i of the square of the error of ``A_i F_ij``, over ``A_i``. [scene lengths squared]

    Raises
    ------
    MemoryForecastError
        If the matrix would not fit in memory.
    """
    n = mesh.element_count
    require_memory(SOLVE_ENTRY * n**2, f"a matrix of {n} x {n} form factors", "ask for fewer elements")
    engine = _Engine(_Elements.of_mesh(mesh), geometry, _Care.for_error(error, n, loose=False), seed)
    pieces, row_of = engine.pieces.count, engine.pieces.owner.astype(np.int32)
    exchange = SymmetricMatrix.empty(n)
    doubt, square = np.zeros(n), np.zeros(n)
    with _threads(workers, pieces) as each:
        work = partial(engine.stripe, row_of=row_of, importance=1.0 / mesh.element_area[row_of] / n)
        done = 0
        for node, stripe in _told(engine.tree.stripes.tolist(), work, each, record):
            exchange.add(stripe.row, stripe.column, stripe.value)
            _add_errors(stripe.row, stripe.column, stripe.error, mesh.element_area, doubt, square)
            done += engine.pairs_after(node)
            if progress is not None:
                progress(min(done / pieces**2, 1.0))
    return exchange, doubt, square


def _told(
    nodes: list[int], work: Callable[[int], _Stripe], each: Callable[..., Any], record: RunRecord
) -> Iterator[tuple[int, _Stripe]]:
    """Stripes as they are found, counted in the record."""
    for node, stripe in zip(nodes, each(work, nodes), strict=True):
        add_tally(record.counters, stripe.tally)
        record.counters.add(rays=stripe.rays)
        yield node, stripe


@njit(nogil=True, cache=True)
def _add_errors(r, c, error, area, doubt, square):
    """Add the errors of pairs to the sums of both rows, and their squares over the other's area."""
    for k in range(r.shape[0]):
        i, j, e = r[k], c[k], error[k]
        doubt[i] += e
        doubt[j] += e
        square[i] += e * e / area[j]
        square[j] += e * e / area[i]


def _all_exchanges(
    engine: _Engine,
    row_of: NDArray[Any],
    areas: FloatArray,
    threads: int,
    record: RunRecord,
    progress: Progress | None,
    error: float,
) -> tuple[Matrix, Matrix]:
    """Symmetric exchange areas between rows and their errors, dense or sparse, whichever is smaller.

    Where the stated error is above ``error``, the pairs that make it are refined.
    """
    tree, n, rows = engine.tree, engine.pieces.count, len(areas)
    row_of = row_of.astype(np.int32)
    importance = 1.0 / areas[row_of] / rows
    found: dict[int, _Stripe] = {}

    def run(stripes: list[int], threshold: float) -> None:
        done = 0
        work = partial(engine.stripe, row_of=row_of, importance=importance, threshold=threshold)
        for node, stripe in _told(stripes, work, each, record):
            # Several pieces a row: add up what belongs together at once.
            found[node] = stripe if rows == n else stripe.merged(rows)
            done += engine.pairs_after(node)
            if progress is not None and threshold == math.inf:
                progress(min(done / n**2, 1.0))

    with _threads(threads, n) as each:
        run(tree.stripes.tolist(), math.inf)
        tighten = 1.0
        for turn in range(REFINEMENTS):
            stated = _stated(list(found.values()), areas)
            if stated <= error:
                break
            if turn > 0:
                # Refined pairs kept more doubt than was meant for them.
                tighten *= AIM * error / stated
            bins = np.sum([stripe.bins for stripe in found.values()], axis=0)
            threshold = tighten * _threshold(bins, AIM * error * float(bins[:, 1].sum()) / stated)
            again = [node for node, stripe in found.items() if _above(stripe.bins, threshold)]
            run(again, threshold)
            record.results["refined_pairs"] = sum(stripe.refined for stripe in found.values())
        parts = [found[node][:4] for node in tree.stripes.tolist()]
        found.clear()
        if rows < n:
            r, c, value, doubt = (np.concatenate([part[k] for part in parts]) for k in range(4))
            parts = [_merged(r, c, value, doubt, rows)]
        return _symmetric(parts, rows, each)


def _merged(
    row: NDArray[np.int32], column: NDArray[np.int32], value: FloatArray, error: NDArray[np.float32], rows: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], FloatArray, NDArray[np.float32]]:
    """What belongs to the same two rows added up; errors as those of independent pairs."""
    key, place = np.unique(np.minimum(row, column) * np.int64(rows) + np.maximum(row, column), return_inverse=True)
    place = place.ravel()
    low, high = np.divmod(key, rows)
    square = np.bincount(place, np.square(error, dtype=np.float64), len(key))
    total = np.bincount(place, value, len(key)).astype(np.float64)
    return low.astype(np.int32), high.astype(np.int32), total, np.sqrt(square).astype(np.float32)


def _stated(stripes: list[_Stripe], areas: FloatArray) -> float:
    """Mean over the rows of the sum of all errors."""
    total = 0.0
    for stripe in stripes:
        total += float(stripe.error @ (1.0 / areas)[stripe.row] + stripe.error @ (1.0 / areas)[stripe.column])
    return total / len(areas)


def _threshold(bins: FloatArray, wanted: float) -> float:
    """The error at which pairs must be cut off for the sum of all to come to ``wanted``."""
    # From the smallest up: what lies below stays, what lies above would be cut to the threshold.
    below = np.concatenate([[0.0], np.cumsum(bins[:, 1])])
    above = np.concatenate([np.cumsum(bins[::-1, 0])[::-1], [0.0]])
    for b in range(len(bins)):
        edge = 2.0 ** (b + _stripes.FIRST_BIN)
        if below[b + 1] + above[b + 1] * edge > wanted:
            return max((wanted - below[b]) / max(above[b], 1.0), 0.25 * edge)
    return math.inf


def _above(bins: FloatArray, threshold: float) -> bool:
    """Whether a stripe has an error above the threshold."""
    lowest = math.frexp(threshold)[1] - _stripes.FIRST_BIN
    return bool(bins[max(lowest, 0) :, 0].any())


@contextmanager
def _threads(count: int, pieces: int) -> Iterator[Callable[..., Any]]:
    """``map`` over a pool of threads, whose waiting work is dropped when something stops it.

    Few pieces are done before threads have started.
    """
    if count == 1 or pieces <= STRIPE:
        yield map
        return
    pool = ThreadPoolExecutor(count)
    try:
        yield pool.map
    finally:
        pool.shutdown(cancel_futures=True)


def _blocks(rows: int) -> list[tuple[int, int]]:
    return [(first, min(first + BLOCK_ROWS, rows)) for first in range(0, rows, BLOCK_ROWS)]


def _symmetric(parts: list[tuple[Any, ...]], rows: int, each: Callable[..., Any]) -> tuple[Matrix, Matrix]:
    """The whole matrices of distinct pairs (r, c, value, error), which are given up on the way."""
    for r, c, value, error in parts:
        # Pieces of one row that see each other do so both ways.
        value[r == c] *= 2.0
        error[r == c] *= math.sqrt(2.0)
    count = sum(2 * len(r) - int((r == c).sum()) for r, c, _, _ in parts)
    if SPARSE_ENTRY * count >= DENSE_ENTRY * rows**2:
        whole, whole_error = np.zeros((rows, rows)), np.zeros((rows, rows), dtype=np.float32)
        while parts:
            r, c, value, error = parts.pop()
            _scatter(r, c, value, error, whole, whole_error)
        return whole, whole_error
    import scipy.sparse  # takes longer than a small solve, for matrices that are sparse only

    start = np.zeros(rows + 1, dtype=np.int32 if count < 2**31 else np.int64)
    for part in parts:
        _count_rows(part[0], part[1], start)
    np.cumsum(start, out=start)
    column = np.empty(count, dtype=np.int32)
    data, errors = np.empty(count), np.empty(count, dtype=np.float32)
    place = start[:-1].copy()
    while parts:
        r, c, value, error = parts.pop()
        _place_pairs(r, c, value, error, place, column, data, errors)
    list(each(lambda block: _sort_rows(block[0], block[1], start, column, data, errors), _blocks(rows)))
    made = [scipy.sparse.csr_array((part, column, start), shape=(rows, rows)) for part in (data, errors)]
    for matrix in made:
        matrix.has_sorted_indices = True
    return made[0], made[1]


@njit(nogil=True, cache=True)
def _scatter(r, c, value, error, dense, dense_error):
    """Write each pair to both of its places."""
    for k in range(r.shape[0]):
        dense[r[k], c[k]] = value[k]
        dense[c[k], r[k]] = value[k]
        dense_error[r[k], c[k]] = error[k]
        dense_error[c[k], r[k]] = error[k]


@njit(nogil=True, cache=True)
def _count_rows(r, c, start):
    """Add the entries of each row, both ways, to the place after it."""
    for k in range(r.shape[0]):
        start[r[k] + 1] += 1
        if c[k] != r[k]:
            start[c[k] + 1] += 1


@njit(nogil=True, cache=True)
def _place_pairs(r, c, value, error, place, column, data, errors):
    """Put each pair to the next place of both its rows."""
    for k in range(r.shape[0]):
        i, j = r[k], c[k]
        p = place[i]
        column[p], data[p], errors[p] = j, value[k], error[k]
        place[i] = p + 1
        if i != j:
            q = place[j]
            column[q], data[q], errors[q] = i, value[k], error[k]
            place[j] = q + 1


@njit(nogil=True, cache=True)
def _sort_rows(first, last, start, column, data, errors):
    """Put the entries of rows ``first..last`` in the order of their columns: through a whole row, no comparison."""
    rows = start.shape[0] - 1
    there = np.zeros(rows, dtype=np.bool_)
    values, doubts = np.empty(rows), np.empty(rows, dtype=np.float32)
    for i in range(first, last):
        for k in range(start[i], start[i + 1]):
            j = column[k]
            there[j] = True
            values[j], doubts[j] = data[k], errors[k]
        k = start[i]
        for j in range(rows):
            if there[j]:
                there[j] = False
                column[k], data[k], errors[k] = j, values[j], doubts[j]
                k += 1


def _finished(
    scene: Scene,
    exchange: Matrix,
    spread: Matrix,
    areas: FloatArray,
    names: list[str],
    record: RunRecord,
    touched: Callable[[NDArray[np.bool_]], NDArray[np.bool_]],
    threads: int,
    surplus: float,
) -> ViewFactors:
    """Close the rows of an enclosure, divide by the areas, and say how good it is.

    ``surplus`` is by how much the sum of all errors is known to be too large, as a mean over the rows.
    """
    n = len(areas)
    if isinstance(exchange, np.ndarray):
        start, column = np.arange(n + 1, dtype=np.int64) * n, np.empty(0, dtype=np.int32)
        data, errors = exchange.ravel(), spread.ravel()
    else:
        start, column, data, errors = exchange.indptr, exchange.indices, exchange.data, spread.data
    sums, stated, doubt, closed_sums = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    worst = np.zeros((n, 3))
    x = np.ones(n)
    with _threads(threads, n) as pool:

        def each(work: Callable[[int, int], None]) -> None:
            list(pool(lambda block: work(*block), _blocks(n)))

        each(lambda first, last: _row_sums(first, last, start, data, errors, areas, sums, stated, doubt))
        record.errors["stated_row_error_as_found"] = float(stated.mean()) - surplus
        if scene.closed:
            covered = 1.0 - sums > np.maximum(4.0 * doubt, COVERED)
            if covered.any():
                covered &= touched(covered)
            x = close_rows(exchange, np.where(covered, sums * areas, areas))
            record.results["covered_rows"] = int(covered.sum())
        each(lambda first, last: _scale_rows(first, last, start, column, data, errors, x, areas, worst))
        each(lambda first, last: _row_sums(first, last, start, data, errors, np.ones(n), closed_sums, stated, doubt))
    correction, back, largest = worst.max(axis=0, initial=0.0).tolist()
    back /= max(largest, 1e-300)
    record.errors.update(
        row_sum_as_found={"min": float(sums.min()), "mean": float(sums.mean()), "max": float(sums.max())},
        row_sum={"min": float(closed_sums.min()), "mean": float(closed_sums.mean()), "max": float(closed_sums.max())},
        closure_correction=correction,
        reciprocity=back,
        stated_row_error=float(stated.mean()) - surplus,
    )
    return ViewFactors(exchange, spread, areas, names, sums, correction, back, record)


@njit(nogil=True, cache=True)
def _row_sums(first, last, start, data, errors, areas, sums, stated, doubt):
    """Sums of the rows ``first..last`` over their areas, of their errors, and of the squares of those (its root)."""
    for i in range(first, last):
        total = linear = square = 0.0
        for k in range(start[i], start[i + 1]):
            total += data[k]
            linear += errors[k]
            square += errors[k] * errors[k]
        sums[i], stated[i], doubt[i] = total / areas[i], linear / areas[i], math.sqrt(square) / areas[i]


@njit(nogil=True, cache=True)
def _scale_rows(first, last, start, column, data, errors, x, areas, worst):
    """Make exchange areas form factors: times x on both sides, over the area; their errors with them.

    ``worst`` (n, 3): largest change of a form factor, |A_i F_ij - A_j F_ji| and exchange area of each row.
    """
    whole = column.shape[0] == 0
    for i in range(first, last):
        inverse = 1.0 / areas[i]
        change = back = largest = 0.0
        for k in range(start[i], start[i + 1]):
            j = k - start[i] if whole else column[k]
            moved = (x[i] * x[j] - 1.0) * data[k]
            value = data[k] + moved
            change = max(change, abs(moved) * inverse)
            back = max(back, abs(areas[i] * (value * inverse) - areas[j] * (value * (1.0 / areas[j]))))
            largest = max(largest, value)
            data[k] = value * inverse
            errors[k] = math.sqrt(errors[k] * errors[k] + moved * moved) * inverse
        worst[i, 0], worst[i, 1], worst[i, 2] = change, back, largest
