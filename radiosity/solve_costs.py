"""What a solve will cost, told before it is made: by method, from numbers of polygons and pieces and the asked error.

The committed table holds processor seconds of one machine; only their ratios decide.  It is fitted to runs
by ``python tests/speed/fit_solve_costs.py``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from workbench.errors import InputError

__all__ = ["TABLE", "expected_seconds", "features", "fit", "read_table"]

FIRST_ELEMENTS = 5.0
"""Elements of the first mesh, times the asked error, about."""
TABLE = Path(__file__).with_name("solve_costs.json")
"""Method to the seconds of each of its features."""


def features(method: str, *, polygons: int, pieces: int, error: float) -> dict[str, float]:
    """What the seconds of a method go with, when an error is asked.

    Parameters
    ----------
    method : str
        ``matrix`` (pairs of convex pieces) or ``hierarchical`` (polygons, which make the tree; links, which grow with
        them and with what is asked).
    polygons, pieces : int
        Of the scene: polygons, and the convex pieces that they are cut into.
    error : float
        Asked.
    """
    if method == "matrix":
        # Each piece is at least an element's, however coarse the mesh; any polygon may hide some of a pair.
        pairs = 0.5 * (pieces + FIRST_ELEMENTS / error) ** 2
        return {"start": 1.0, "polygon": float(polygons), "hidden": polygons * pairs}
    return {"start": 1.0, "polygon": float(polygons), "link": math.sqrt(polygons) / error}


def fit(rows: Sequence[tuple[Mapping[str, float], float]]) -> dict[str, float]:
    """Non-negative least squares of relative errors over (features, processor seconds) of runs of one method."""
    from scipy.optimize import nnls  # a fifth of a second, for this alone

    names = list(rows[0][0])
    seconds = np.array([used for _, used in rows])
    table: NDArray[np.float64] = np.array([[row[name] for name in names] for row, _ in rows]) / seconds[:, None]
    scale = table.max(axis=0)
    found, _ = nnls(table / scale, np.ones(len(rows)))
    return {name: float(value) for name, value in zip(names, found / scale, strict=True)}


@cache
def read_table(path: Path = TABLE) -> dict[str, dict[str, float]]:
    """The table of a file.

    Raises
    ------
    InputError
        If it holds none.
    """
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return {method: {name: float(s) for name, s in row.items()} for method, row in stored.items()}
    except (OSError, ValueError, TypeError, AttributeError) as problem:
        raise InputError(f"{path}: found no table of costs ({problem})") from None


def expected_seconds(method: str, *, polygons: int, pieces: int, error: float) -> float:
    """Processor seconds of a solve on the machine of the table; see :func:`features`."""
    row = read_table()[method]
    return sum(
        row[name] * count for name, count in features(method, polygons=polygons, pieces=pieces, error=error).items()
    )
