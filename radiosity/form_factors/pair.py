"""The form factor of one pair of polygons behind any occluders, to a wanted error.

What a point of one polygon sees of the other is exact (the other is cut by the occluders); it is integrated
over the first by a rule that is refined where it errs most.  Where the occluders are few, the first polygon
is divided beforehand along the lines at which what is seen changes its form: the planes through an edge of
an occluder and a corner of the other polygon, and the other way round (the EV events of discontinuity
meshing, D. Lischinski, F. Tampieri and D. P. Greenberg 1992).  No visible sliver lies between its points.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from radiosity.form_factors import _pairs
from radiosity.form_factors._sampling import RADON_POINTS, RADON_WEIGHTS
from radiosity.form_factors.analytic import _as_pieces, _best_exchange, _clip_pair
from workbench.arrays import as_positive
from workbench.culling.tally import new_tally
from workbench.errors import InputError
from workbench.geometry.coplanar import Occluders, join_coplanar
from workbench.geometry.flat import Geometry
from workbench.geometry.lambert import lambert_piece
from workbench.geometry.planes import clip_by_plane
from workbench.geometry.polygons import check_polygon, plane_basis
from workbench.scene.library import diffuse
from workbench.scene.model import Scene, Surface

__all__ = ["FormFactor", "form_factor"]

FloatArray = NDArray[np.float64]

MOST_LINES = 96
"""Most event lines along which a polygon is divided beforehand."""
MOST_POINTS = 3_000_000
"""Points after which refinement ends, whatever the wanted error: the error says so."""
FRAGMENTS = 4096
"""Visible fragments of a polygon from one point."""
LONG, MOST_SHORTENED = 4.0, 4000
"""Length of a cell, in distances from the other polygon or in its widths, above which it is halved beforehand; most
cells that this may make."""
THIN = 0.02
"""Distance of polygons, in extents of one, below which penumbrae are thin layers."""
GRID = 8
"""Cells along a polygon that has too many event lines to be divided along them."""


class FormFactor(float):
    """A form factor: a float that knows its estimated absolute error as ``.error``."""

    error: float

    def __new__(cls, value: float, error: float) -> FormFactor:
        """The value with its error."""
        made = super().__new__(cls, value)
        made.error = error
        return made

    def __getnewargs__(self) -> tuple[float, float]:  # type: ignore[override]
        """For copies and pickles."""
        return float(self), self.error


@njit(nogil=True, cache=True)
def _cell_values(
    cells, normal, target, corners, start, normals, offset, through, kept, many, fragments, sizes, weights, points,
    rule, hidden, out, tally,
):  # fmt: skip
    """Integral of the visible or the ``hidden`` form factor over each triangle of ``cells`` (n, 3, 3).

    Returns whether there was room.
    """
    for c in range(cells.shape[0]):
        ax, ay, az = cells[c, 0, 0], cells[c, 0, 1], cells[c, 0, 2]
        ux, uy, uz = cells[c, 1, 0] - ax, cells[c, 1, 1] - ay, cells[c, 1, 2] - az
        vx, vy, vz = cells[c, 2, 0] - ax, cells[c, 2, 1] - ay, cells[c, 2, 2] - az
        px, py, pz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        area = 0.5 * math.sqrt(px * px + py * py + pz * pz)
        total = 0.0
        for k in range(rule.shape[0]):
            s, t = points[k, 1], points[k, 2]
            x, y, z = ax + s * ux + t * vx, ay + s * uy + t * vy, az + s * uz + t * vz
            share = _pairs.seen_share(
                x, y, z, normal[0], normal[1], normal[2], target, 0, target.shape[0], corners, start, normals, offset,
                through, kept, many, fragments, sizes, weights, tally,
            )  # fmt: skip
            if share < 0.0:
                return False
            if hidden:
                whole = lambert_piece(x, y, z, normal[0], normal[1], normal[2], target, 0, target.shape[0])
                share = max(whole - share, 0.0)
            total += rule[k] * share
        out[c] = area * total
    return True


def _halves(cells: FloatArray) -> FloatArray:
    """Each triangle cut through the middle of its longest side, (2 n, 3, 3)."""
    side = np.linalg.norm(np.roll(cells, -1, axis=1) - cells, axis=2)
    turn = (np.argmax(side, axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = (cells[np.arange(len(cells)), turn[:, k]] for k in range(3))
    m = 0.5 * (a + b)
    return np.stack([np.stack([a, m, c], axis=1), np.stack([m, b, c], axis=1)], axis=1).reshape(-1, 3, 3)


def _layers(a: FloatArray, normal: FloatArray, b: FloatArray, ring: FloatArray) -> FloatArray:
    """Planes (k, 4) beside an occluder's own, where ``a`` and ``b`` lie so close that its penumbra is a thin layer.

    At one, four, sixteen ... times the distance of the polygons: no rule over whole cells would see such a layer.
    """
    other = np.cross(b[1] - b[0], b[2] - b[0])
    n = np.cross(ring[1] - ring[0], ring[2] - ring[0])
    n /= np.linalg.norm(n)
    height = (a - ring[0]) @ n
    after, height_after = np.roll(a, -1, axis=0), np.roll(height, -1)
    cut = height * height_after < 0
    slope = float(other @ normal)
    if not cut.any() or abs(slope) < 0.1 * np.linalg.norm(other):
        return np.empty((0, 4))
    at = a[cut] + (height[cut] / (height[cut] - height_after[cut]))[:, None] * (after[cut] - a[cut])
    gap = float(np.abs((b[0] - at) @ other / slope).max())
    extent = float(np.ptp(a, axis=0).max())
    if not 1e-12 * extent < gap < THIN * extent:
        return np.empty((0, 4))
    off = gap * 4.0 ** np.arange(int(math.log(extent / gap, 4.0)) + 1)
    d = ring[0] @ n + np.concatenate([-off, off])
    return np.column_stack([np.tile(n, (len(d), 1)), d])


def _event_lines(a: FloatArray, normal: FloatArray, b: FloatArray, rings: list[FloatArray]) -> FloatArray:
    """Planes (k, 4) ``n . x = d`` that cut polygon ``a`` where what is seen of ``b`` changes its form."""
    size = float(np.ptp(np.concatenate([a, b]), axis=0).max())
    u, v = plane_basis(normal)
    flat = np.column_stack([(a - a[0]) @ u, (a - a[0]) @ v])
    planes = []
    ends = np.roll(b, -1, axis=0)
    for ring in rings:
        after = np.roll(ring, -1, axis=0)
        # An edge of the occluder with a corner of b; an edge of b with a corner of the occluder; the occluder's plane.
        for p, q, corner in ((ring, after, b), (b, ends, ring), (ring[:1], after[:1], ring[2:3])):
            n = np.cross((q - p)[:, None], corner[None] - p[:, None]).reshape(-1, 3)
            planes.append(np.column_stack([n, np.einsum("ij,ij->i", n, np.repeat(p, len(corner), axis=0))]))
    planes += [_layers(a, normal, b, ring) for ring in rings]
    plane = np.concatenate(planes)
    length = np.linalg.norm(plane[:, :3], axis=1)
    plane = plane[length > 1e-12 * size * size] / length[length > 1e-12 * size * size, None]
    line = np.column_stack([plane[:, :3] @ u, plane[:, :3] @ v, plane[:, 3] - plane[:, :3] @ a[0]])
    steep = np.hypot(line[:, 0], line[:, 1])
    line = line[steep > 1e-9] / steep[steep > 1e-9, None]
    height = flat @ line[:, :2].T - line[:, 2]
    extent = float(np.ptp(flat, axis=0).max())
    line = line[(height.min(axis=0) < -1e-9 * extent) & (height.max(axis=0) > 1e-9 * extent)]
    line *= np.where((line[:, 0] < -1e-12) | ((np.abs(line[:, 0]) <= 1e-12) & (line[:, 1] < 0)), -1.0, 1.0)[:, None]
    scale = np.array([1.0, 1.0, 1.0 / extent])
    _, first = np.unique(np.round(line * scale / 1e-9), axis=0, return_index=True)
    line = line[np.sort(first)]
    # Back to planes of space, across a's own.
    return np.column_stack(
        [line[:, :1] * u + line[:, 1:2] * v, line[:, 2] + (line[:, :1] * u + line[:, 1:2] * v) @ a[0]]
    )


def _divided(polygon: FloatArray, planes: FloatArray) -> list[FloatArray]:
    """Convex parts of a convex polygon, cut by every plane."""
    extent = float(np.ptp(polygon, axis=0).max())
    parts = [polygon]
    for nx, ny, nz, d in planes.tolist():
        cut = []
        for part in parts:
            for sign in (1.0, -1.0):
                room = np.empty((len(part) + 2, 3))
                left = clip_by_plane(part, len(part), sign * nx, sign * ny, sign * nz, sign * d, 1e-12 * extent, room)
                if left >= 3:
                    cut.append(room[:left].copy())
        parts = cut
    return parts


def _fan(parts: list[FloatArray]) -> FloatArray:
    """Triangles (n, 3, 3) of convex polygons."""
    return np.concatenate([np.stack([np.stack([p[0], p[k], p[k + 1]]) for k in range(1, len(p) - 1)]) for p in parts])


def _grid(polygon: FloatArray) -> FloatArray:
    cells = _fan([polygon])
    for _ in range(2 * int(math.log2(GRID))):
        cells = _halves(cells)
    return cells


class _Blocked:
    """One pair of convex pieces and the occluders between them."""

    def __init__(
        self, a: FloatArray, normal: FloatArray, b: FloatArray, found: list[int], occluders: Occluders
    ) -> None:
        self.a, self.normal, self.b, self.occluders = a, normal, b, occluders
        self.rings = [occluders.corners[occluders.start[k] : occluders.start[k + 1]] for k in found]
        self.kept = np.asarray(found, dtype=np.int64)
        corners = max([len(a), len(b), *(len(ring) for ring in self.rings)])
        self.work = _pairs.pair_workspace(corners, FRAGMENTS)[:3]
        self.points = 0
        # So near that rims are thin layers too: what is hidden has none at the rims, and the whole is known.
        self.hidden = any(len(_layers(a, normal, b, ring)) for ring in self.rings)

    def values(self, cells: FloatArray) -> FloatArray:
        o = self.occluders
        out = np.empty(len(cells))
        self.points += 7 * len(cells)
        fragments, sizes, weights = self.work
        if not _cell_values(
            np.ascontiguousarray(cells), self.normal, self.b, o.corners, o.start, o.normal, o.offset, o.through,
            self.kept, len(self.kept), fragments, sizes, weights, RADON_POINTS, RADON_WEIGHTS, self.hidden, out,
            new_tally(),
        ):  # fmt: skip
            raise InputError(
                f"occluders: found so many between the polygons that more than {FRAGMENTS} parts of one are seen from"
                " a point; leave out what is too small to matter, or use radiosity.view_factors, which shoots rays"
            )
        return out

    def _shortened(self, cells: FloatArray) -> FloatArray:
        """Long cells halved until they are no longer than a few distances or widths: no end is passed over."""
        low, high = self.b.min(axis=0), self.b.max(axis=0)
        for _ in range(12):
            longest = np.linalg.norm(np.roll(cells, -1, axis=1) - cells, axis=2).max(axis=1)
            width = np.linalg.norm(np.cross(cells[:, 1] - cells[:, 0], cells[:, 2] - cells[:, 0]), axis=1) / longest
            middle = cells.mean(axis=1)
            gap = np.linalg.norm(np.maximum(np.maximum(low - middle, middle - high), 0.0), axis=1)
            long = longest > LONG * np.maximum(gap, width)
            if not long.any() or len(cells) + int(long.sum()) > MOST_SHORTENED:
                break
            cells = np.concatenate([cells[~long], _halves(cells[long])])
        return cells

    def integral(self, tolerance: float) -> tuple[float, float]:
        """Exchange area seen, or hidden, and its estimated error."""
        lines = _event_lines(self.a, self.normal, self.b, self.rings)
        cells = _fan(_divided(self.a, lines)) if len(lines) <= MOST_LINES else _grid(self.a)
        cells = self._shortened(cells)
        value = self.values(cells)
        parts = _halves(_halves(cells))
        fine = self.values(parts).reshape(-1, 4)
        parts = parts.reshape(-1, 4, 3, 3)
        while True:
            # Quartering takes far more than three quarters off, but at a crease of what is seen.
            error = 0.4 * np.abs(fine.sum(axis=1) - value)
            total = float(error.sum())
            if total <= tolerance or self.points > MOST_POINTS:
                return math.fsum(fine.ravel().tolist()), total
            order = np.argsort(-error)
            worst = order[: int(np.searchsorted(np.cumsum(error[order]), total - 0.5 * tolerance)) + 1]
            worst = worst[error[worst] > 0.02 * error[worst[0]]]
            stay = np.ones(len(error), dtype=bool)
            stay[worst] = False
            young = parts[worst].reshape(-1, 3, 3)
            smaller = _halves(_halves(young))
            young_fine = self.values(smaller).reshape(-1, 4)
            value = np.concatenate([value[stay], fine[worst].ravel()])
            parts = np.concatenate([parts[stay], smaller.reshape(-1, 4, 3, 3)])
            fine = np.concatenate([fine[stay], young_fine])


def _as_rings(polygon: Any, name: str) -> list[FloatArray]:
    """A polygon given as one ring (n, 3), or as a list of rings: the outer one, then holes."""
    rings = polygon if isinstance(polygon, (list, tuple)) and len(polygon) and np.ndim(polygon[0]) == 2 else [polygon]
    try:
        return [np.array(ring, dtype=np.float64).reshape(-1, 3) for ring in rings]
    except (TypeError, ValueError):
        raise InputError(
            f"{name}: found no rows of three numbers, expected corners (n, 3) or a list of rings"
        ) from None


def _occluders(polygons: Sequence[Any]) -> Occluders:
    if not isinstance(polygons, Iterable):
        raise InputError(f"occluders: found {polygons!r}, expected a list of polygons")
    faces = []
    for index, polygon in enumerate(polygons):
        rings = _as_rings(polygon, f"occluders[{index}]")
        problem = check_polygon(rings)
        if problem:
            raise InputError(f"occluders[{index}]: found {problem}, expected a planar polygon with an area")
        faces.append(rings)
    surface = Surface.from_polygons("occluders", diffuse("black", 0.0), faces)
    return join_coplanar(Geometry.from_scene(Scene("occluders", (surface,), bands=1)))


def _between(a: FloatArray, b: FloatArray, occluders: Occluders, slack: float) -> list[int] | None:
    """Occluders that may come between two convex polygons, the largest first; ``None`` if one hides all."""
    found = []
    room = np.empty((8 * (len(a) + 2) * (len(b) + 2), 2))
    for k in range(occluders.count):
        ring = occluders.corners[occluders.start[k] : occluders.start[k + 1]]
        n, d = occluders.normal[k], float(occluders.offset[k])
        ha, hb = a @ n - d, b @ n - d
        if (ha.min() >= -slack and hb.min() >= -slack) or (ha.max() <= slack and hb.max() <= slack):
            continue
        u, v = plane_basis(n)
        flat = np.column_stack([(ring - ring[0]) @ u, (ring - ring[0]) @ v])
        frame = (*n.tolist(), d, *ring[0].tolist(), *u.tolist(), *v.tolist())
        count, separates = _pairs.crossings(a, 0, len(a), b, 0, len(b), *frame, slack, room)
        what = _pairs.verdict(
            room, count, separates, flat, 0, len(flat), flat.min(axis=0)[None], flat.max(axis=0)[None], 0, slack
        )
        if what == _pairs.HIDES:
            return None
        if what == _pairs.TOUCHES:
            found.append((-float(np.prod(np.ptp(flat, axis=0))), k))
    return [k for _, k in sorted(found)]


def form_factor(
    polygon_a: ArrayLike | Sequence[ArrayLike],
    polygon_b: ArrayLike | Sequence[ArrayLike],
    occluders: Sequence[Any] = (),
    error: float = 1e-6,
) -> FormFactor:
    """Form factor (view factor) F from one polygon to another behind any opaque polygons.

    Parameters
    ----------
    polygon_a, polygon_b : (n, 3) float, or list of such rings
        Planar simple polygons, convex or not, counter-clockwise from the sides that exchange; a list is
        an outer ring and holes.
    occluders : sequence of polygons
        As above; both sides block.  What lies in the plane of a polygon does not hide it.
    error : float
        Wanted absolute error of F.

    Returns
    -------
    FormFactor
        A float, F_a-b, with its estimated absolute error as ``.error``. [dimensionless, 0..1]

    Raises
    ------
    InputError
        If a polygon has no area, is not planar or crosses itself, ``error`` is not positive, or there are too
        many occluders to cut one polygon by.

    Notes
    -----
    ``A_a F_ab = A_b F_ba`` holds within the errors: the smaller polygon is the one integrated over.
    """
    error = as_positive(error, "error", "a positive number such as 1e-6")
    ends = []
    for name, polygon in (("polygon_a", polygon_a), ("polygon_b", polygon_b)):
        outer, *holes = _as_rings(polygon, name)
        ends.append(_as_pieces(outer, holes, name))
    (pieces_a, normal_a, area_a), (pieces_b, normal_b, area_b) = ends
    corners = np.concatenate([*pieces_a, *pieces_b])
    blockers = _occluders(occluders)
    size = float(np.ptp(np.concatenate([corners, blockers.corners]), axis=0).max())
    slack = 1e-12 * size + 16.0 * float(np.finfo(np.float64).eps) * float(np.abs(corners).max())
    swapped = area_b < area_a
    pairs = [(p, q) for p in pieces_a for q in pieces_b]
    tolerance = error * area_a / len(pairs)
    exchange, doubt = [], 0.0
    longest = max(len(piece) for piece in (*pieces_a, *pieces_b))
    for p, q in pairs:
        work = np.empty((4, 2 * longest + 4, 3))
        m, k = _clip_pair(p, 0, len(p), normal_a, q, 0, len(q), normal_b, work)
        if m <= 0 or k <= 0:
            continue
        # The clipped corners are relative to the first corner of q.
        a, b = work[2, :m] + q[0], work[3, :k] + q[0]
        found = _between(a, b, blockers, slack)
        if found is None:
            continue
        if not found:
            value, off = _best_exchange(p, normal_a, not swapped, q, normal_b, 0.5 * tolerance, work)
            off += 0.5 * tolerance
        else:
            one, normal, other = (b, normal_b, a) if swapped else (a, normal_a, b)
            blocked = _Blocked(one, normal, np.ascontiguousarray(other), found, blockers)
            value, off = blocked.integral(0.9 * tolerance)
            if blocked.hidden:
                whole, rounding = _best_exchange(p, normal_a, not swapped, q, normal_b, 0.1 * tolerance, work)
                value, off = max(whole - value, 0.0), off + rounding + 0.1 * tolerance
        exchange.append(value)
        doubt += off
    return FormFactor(min(math.fsum(exchange) / area_a, 1.0), doubt / area_a)
