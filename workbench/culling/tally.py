"""The rows of the integer array in which kernels count: a name of ``workbench.counters`` each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from workbench.counters import Counters

__all__ = ["TALLY", "add_tally", "new_tally"]

TALLY = (
    "box_tests",
    "shafts",
    "shafts_empty",
    "shaft_tests",
    "shaft_culls",
    "horizon_culls",
    "plane_vertex_checks",
    "plane_vertex_culls",
    "not_inshadow",
    "inshadow",
    "complex_shadow",
    "closed_forms",
    "exact_cuts",
    "exact_pieces",
    "exact_overflows",
    "links",
    "silhouette_edges",
    "sender_lines",
    "fitted_points",
)
"""Name of each row."""

(
    BOX,
    SHAFT,
    EMPTY,
    SHAFT_TEST,
    SHAFT_CULL,
    HORIZON,
    CHECK,
    CULL,
    CLEAR,
    DARK,
    COMPLEX,
    CLOSED,
    CUT,
    PIECES,
    OVERFLOW,
    LINK,
    EDGES,
    LINES,
    FITTED,
) = range(len(TALLY))


def new_tally() -> NDArray[np.int64]:
    """Zeros, one row a name."""
    return np.zeros(len(TALLY), dtype=np.int64)


def add_tally(counters: Counters, tally: NDArray[np.int64]) -> None:
    """Add a kernel's counts to named counters."""
    counters.add(**dict(zip(TALLY, tally.tolist(), strict=True)))
