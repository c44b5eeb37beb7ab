"""Sensor points from a file: six numbers a line, with commas or as Radiance writes them."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from workbench.errors import InputError

__all__ = ["read_sensor_points"]

_WANTED = "six numbers x,y,z,nx,ny,nz"


def read_sensor_points(path: str | Path) -> NDArray[np.float64]:
    """Points and normals (n, 6) from lines of x, y, z, nx, ny, nz.

    Numbers are parted by commas, semicolons, tabs or spaces (Radiance's ``rtrace`` input).  A first
    line of names, empty lines and lines that begin with ``#`` are skipped.

    Raises
    ------
    InputError
        If the file cannot be read, a line has other than six finite numbers, or a normal has no
        length; it names the line.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as problem:
        reason = getattr(problem, "strerror", None) or "not a text file"
        raise InputError(f"{path}: cannot be read: {reason}; expected lines of x,y,z,nx,ny,nz") from None
    rows: list[list[float]] = []
    named = False
    for number, line in enumerate(text.splitlines(), 1):
        stripped = line.strip()
        if not stripped or stripped.startswith("#"):
            continue
        cells = [cell.strip() for cell in re.split(r"[,;]", stripped)] if re.search("[,;]", stripped) else line.split()
        if not rows and not named and not any(map(_is_number, cells)) and re.match(r"[\"']?[A-Za-z_]", cells[0]):
            named = True
            continue
        try:
            row = [float(cell) for cell in cells]
        except ValueError:
            row = []
        if len(row) != 6 or not all(map(math.isfinite, row)):
            shown = stripped if len(stripped) <= 60 else f"{stripped[:57]}..."
            raise InputError(f"{path}: line {number}: found {shown!r}, expected {_WANTED}")
        if not any(row[3:]):
            raise InputError(f"{path}: line {number}: found a normal of length zero, expected a direction")
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: found no points, expected lines of x,y,z,nx,ny,nz")
    return np.asarray(rows)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
