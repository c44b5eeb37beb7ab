"""Points on a flat surface or from a file: where direct light is asked for, and where each stands in a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radiosity.points_file import read_sensor_points
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import plane_basis
from workbench.scene.model import Scene

__all__ = ["Sensors", "read_points", "surface_grid"]


@dataclass(frozen=True)
class Sensors:
    """Points to be shaded, and where they stand in a picture.

    ``cells`` (n,) numbers the points inside a grid of ``shape`` (rows, columns) over ``extent``
    (left, right, bottom, top); ``None`` for points that form no grid.
    """

    name: str
    points: NDArray
    normals: NDArray
    own: NDArray
    flat: NDArray
    labels: tuple[str, str]
    shape: tuple[int, int] | None = None
    cells: NDArray | None = None
    extent: tuple[float, float, float, float] | None = None


def read_points(path: Path) -> Sensors:
    """Points and normals from a file, see :func:`radiosity.points_file.read_sensor_points`.

    Raises
    ------
    InputError
        If the file cannot be read, or a line has other than six finite numbers.
    """
    table = read_sensor_points(path)
    spread = np.ptp(table[:, :3], axis=0)
    first, second = sorted(np.argsort(-spread, kind="stable")[:2].tolist())
    return Sensors(
        path.name, table[:, :3], table[:, 3:], np.full(len(table), -1), table[:, [first, second]],
        ("xyz"[first], "xyz"[second]),
    )  # fmt: skip


def surface_grid(scene: Scene, geometry: Geometry, name: str | None, shape: tuple[int, int]) -> Sensors:
    """Points in the middle of the cells of a grid over a flat surface, as far as they lie on it.

    Without a name: the surface with the largest area that faces up, along the coordinate axis
    nearest to the camera's up, or z.

    Raises
    ------
    InputError
        If there is no such surface, it is not flat, or no point falls on it.
    """
    up = np.array([0.0, 0.0, 1.0])
    if scene.camera is not None:
        axis = int(np.argmax(np.abs(scene.camera.up)))
        up = np.eye(3)[axis] * np.sign(scene.camera.up[axis])
    area, normal = geometry.polygon_area, geometry.polygon_normal
    if name is None:
        twice = np.array([m.two_sided for m in geometry.surface_material], dtype=bool)[geometry.polygon_surface]
        dark = np.array([not m.emission.any() for m in geometry.surface_material])[geometry.polygon_surface]
        rise = normal @ up
        facing = dark & ((rise > 0.9) | (twice & (rise < -0.9)))
        if not facing.any():
            raise InputError(f"{scene.name}: found no surface that faces up; give --surface NAME or --points FILE.csv")
        sums = np.bincount(geometry.polygon_surface[facing], area[facing], minlength=len(geometry.surface_name))
        chosen = int(np.argmax(sums))
        mine = np.flatnonzero(facing & (geometry.polygon_surface == chosen))
    else:
        if name not in geometry.surface_name:
            known = sorted(set(geometry.surface_name))
            more = " ..." if len(known) > 8 else ""
            raise OptionError(f"--surface: found {name!r}, expected one of {', '.join(known[:8])}{more}")
        chosen = geometry.surface_name.index(name)
        mine = np.flatnonzero(geometry.polygon_surface == chosen)
        if not len(mine):
            raise InputError(f"--surface: {name!r} has no polygons; give another")
    # The flat part with the largest area: polygons of the plane of one of them.
    lead_piece = geometry.polygon_piece_start[mine]
    anchor = geometry.corners[geometry.piece_start[lead_piece]]
    best: Any = mine[:0]
    for lead in mine[np.argsort(-area[mine], kind="stable")[:16]]:
        origin = geometry.corners[geometry.piece_start[geometry.polygon_piece_start[lead]]]
        level = (normal[mine] @ normal[lead] > 1 - 1e-9) & (
            np.abs((anchor - origin) @ normal[lead]) <= 1e-7 * geometry.size
        )
        if area[mine[level]].sum() > area[best].sum():
            best = mine[level]
    if area[best].sum() < 0.25 * area[mine].sum() and name is not None and len(mine) > 6:
        raise InputError(f"--surface: {name!r} is not flat; give its points with --points FILE.csv")
    front = normal[best[0]]
    facing_up = front if name is not None or front @ up > 0 else -front
    axes = [np.eye(3)[k] for k in range(3) if abs(facing_up[k]) < 1e-6]
    u, v = (axes[0], axes[1]) if len(axes) == 2 else plane_basis(facing_up)
    pieces = [k for polygon in best for k in range(*geometry.polygon_piece_start[[polygon, polygon + 1]])]
    flat = [np.column_stack([geometry.piece(k) @ u, geometry.piece(k) @ v]) for k in pieces]
    low, high = np.concatenate(flat).min(axis=0), np.concatenate(flat).max(axis=0)
    columns, rows = shape
    across = low[0] + (np.arange(columns) + 0.5) / columns * (high[0] - low[0])
    along = low[1] + (np.arange(rows) + 0.5) / rows * (high[1] - low[1])
    place = np.stack(np.meshgrid(across, along), axis=-1).reshape(-1, 2)
    own = np.full(len(place), -1)
    for k, ring in zip(pieces, flat, strict=True):
        edge = np.roll(ring, -1, axis=0) - ring
        gap = place[:, None] - ring
        turn = edge[:, 0] * gap[..., 1] - edge[:, 1] * gap[..., 0]
        inside = (turn >= 0).all(axis=1) | (turn <= 0).all(axis=1)
        own[inside & (own < 0)] = geometry.piece_polygon[k]
    cells = np.flatnonzero(own >= 0)
    if not len(cells):
        raise InputError(f"--grid: found no point of {columns}x{rows} on {geometry.surface_name[chosen]!r}; ask more")
    depth = float(geometry.corners[geometry.piece_start[pieces[0]]] @ facing_up)
    points = place[cells, :1] * u + place[cells, 1:] * v + depth * facing_up
    labels = tuple("xyz"[int(np.argmax(w))] if w.max() == 1.0 else letter for w, letter in ((u, "u"), (v, "v")))
    return Sensors(
        f"{geometry.surface_name[chosen]!r}", points, np.repeat(facing_up[None], len(points), axis=0), own[cells],
        place[cells], (labels[0], labels[1]), (rows, columns), cells,
        (float(low[0]), float(high[0]), float(low[1]), float(high[1])),
    )  # fmt: skip
