"""Full form factors and one linear solve: the judge of the other solvers on small scenes."""

from __future__ import annotations

import time

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from radiosity.form_factors.bundle import ColumnFinder
from radiosity.solvers.solution import Progress, ProgressEvent, Solution

__all__ = ["balance_rows", "solve_direct"]

FloatArray = NDArray[np.float64]

COLUMNS_A_STEP = 32
COVERED = 0.01
"""Share of an element of a closed scene that must see nothing to count as covered (the floor under a box)."""


def balance_rows(exchange: FloatArray, areas: FloatArray, rounds: int = 200) -> FloatArray:
    """Scale exchange areas so that each row sums to an area, keeping reciprocity; rows of nothing stay.

    The symmetric matrix S is scaled to ``x_i x_j S_ij`` with row sums ``A_i`` (cf. J. van Leersum,
    "A method for determining a consistent set of radiation view factors", 1989; here by symmetric
    iterative scaling, which keeps zeros and signs).

    Parameters
    ----------
    exchange : (n, n) float
        Symmetric exchange areas A_i F_ij of a closed scene.
    areas : (n,) float
        Wanted row sums: the elements' areas, without what is covered of them.
    rounds : int
        Most iterations; it ends once the rows agree to 1e-14.

    Returns
    -------
    (n, n) float
    """
    x = np.ones(len(areas))
    open_rows = exchange.any(axis=1) & (areas > 0)
    for _ in range(rounds):
        ratio = np.divide(areas, x * (exchange @ x), out=np.ones(len(areas)), where=open_rows)
        x *= np.sqrt(ratio)
        if np.abs(ratio - 1.0).max() < 1e-14:
            break
    return exchange * x * x[:, None]


def solve_direct(solution: Solution, bundles: ColumnFinder, *, closed: bool, progress: Progress | None = None) -> None:
    """Solve ``B = E + rho F B`` with the full matrix of form factors between elements.

    Every element must be its own patch.  ``F`` is made reciprocal by averaging both directions; in
    a closed scene its rows are then balanced.  Both corrections are reported, with the row sums
    as found.  Ctrl-C before the end leaves the emission alone as the solution.
    """
    mesh, record = solution.mesh, solution.record
    n = mesh.element_count
    start = time.perf_counter()
    factor = np.zeros((n, n))
    doubt = np.zeros(n)
    mean_square = np.zeros((n, 2))
    solution.converged, solution.stopped = False, "interrupted"
    try:
        for first in range(0, n, COLUMNS_A_STEP):
            if progress is not None:
                progress(ProgressEvent(first, 1.0, 0.5, time.perf_counter() - start, "form factors"))
            chosen = np.arange(first, min(first + COLUMNS_A_STEP, n))
            with record.stage("form factors"):
                columns = bundles.columns(chosen)
            factor[:, chosen] = columns.factor.T
            doubt += columns.spread.sum(axis=0)
            mean_square[chosen] = columns.mean_square
    except KeyboardInterrupt:
        record.counters.merge(bundles.counters)
        return
    with record.stage("solve"):
        area = mesh.element_area
        exchange = factor * area[:, None]
        scale = max(float(exchange.max()), 1e-300)
        sums = factor.sum(axis=1)
        record.errors["row_sum"] = {
            "min": float(sums.min()),
            "mean": float(sums.mean()),
            "max": float(sums.max()),
            "stated_error": float(doubt.max()),
            "rows": n,
        }
        record.errors["reciprocity"] = float(np.abs(exchange - exchange.T).max() / scale)
        exchange = 0.5 * (exchange + exchange.T)
        visible = np.ones(n)
        if closed:
            # A row far from 1 is no error of form factors: something lies on the element.  What is left
            # of it is all that exchanges light, and its row sums to 1.
            sums = exchange.sum(axis=1) / area
            covered = 1.0 - sums > np.maximum(doubt, COVERED)
            visible[covered] = sums[covered]
            balanced = balance_rows(exchange, area * visible)
            record.errors["row_balance_correction"] = float(np.abs(balanced - exchange).max() / scale)
            record.results["covered_elements"] = int(covered.sum())
            exchange = balanced
        share = np.where(visible > 0, visible, 1.0)[:, None]
        factor = exchange / (area[:, None] * share)
        # Light that came from outside fell on the visible part, too.
        before = mesh.emission + (solution.unshot - mesh.emission) / share
        seen = np.empty_like(before)
        for band in range(mesh.bands):
            rho = mesh.reflectance[:, band]
            system = np.eye(n) - rho[:, None] * factor
            seen[:, band] = scipy.linalg.solve(system, before[:, band])
        arriving = visible[:, None] * (factor @ seen)
        solution.radiosity += mesh.reflectance * arriving
        solution.irradiance += arriving
        solution.unshot[:] = 0.0
        square = mean_square.T @ solution.radiosity**2
        solution.state_irradiance_error(form_factors=square[0], visibility=square[1])
        book = solution.book
        shot, received = area @ solution.radiosity, area @ arriving
        book.shot += shot
        book.received += received
        book.absorbed += area @ ((1.0 - mesh.reflectance) * arriving)
        book.escaped += shot - received
    record.counters.merge(bundles.counters)
    record.counters.add(shots=n)
    record.seconds["inside embree, summed over threads"] = bundles.seconds_in_embree
    record.errors["remaining_bound"] = 0.0
    record.errors["energy_imbalance"] = book.imbalance(solution.unshot_power)
    solution.converged, solution.stopped = True, "solved"
