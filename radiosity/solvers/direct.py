"""Full form factors and one linear solve: the judge on small scenes, and the fastest on middling ones."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from radiosity.form_factors._symmetric import SymmetricMatrix
from radiosity.form_factors.bundle import ColumnFinder
from radiosity.form_factors.matrix import CLOSED_TO, close_rows, exchange_areas
from radiosity.solvers._slopes import Slopes
from radiosity.solvers.lamps import lamp_irradiance, lamps_of_scene
from radiosity.solvers.progressive import receive
from radiosity.solvers.solution import Progress, ProgressEvent, Solution
from workbench.geometry.flat import Geometry
from workbench.shadow.occlusion import Shader

__all__ = ["solve_direct", "solve_exchange", "solve_matrix"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

COLUMNS_A_STEP = 32
SOLVED_TO, MOST_STEPS = 1e-14, 2000
"""Relative residual at which the linear equations count as solved, and most steps towards it."""
CORRECTED_TO = 1e-6
"""The same of what slopes send, a small part of the light."""
CLOSED_SHARE = 1e-3
"""Share of the wanted error that rows which are not quite closed may make, over all reflections."""
COVERED = 0.01
"""Share of an element of a closed scene that must see nothing to count as covered (the floor under a box)."""


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
    exchange = factor * mesh.element_area[:, None]
    record.errors["reciprocity"] = float(np.abs(exchange - exchange.T).max() / max(float(exchange.max()), 1e-300))
    with record.stage("solve"):
        whole = SymmetricMatrix.of_dense(0.5 * (exchange + exchange.T))
        seen = solve_exchange(solution, whole, factor.sum(axis=1), doubt, closed=closed)
    square = mean_square.T @ _told_apart(seen, mesh.element_area, closed) ** 2
    solution.state_irradiance_error(form_factors=square[0], visibility=square[1])
    record.counters.merge(bundles.counters)
    record.counters.add(shots=n)
    record.seconds["inside embree, summed over threads"] = bundles.seconds_in_embree


def _told_apart(seen: FloatArray, area: FloatArray, closed: bool) -> FloatArray:
    """The radiosity on which errors of form factors act: in rows that sum to 1 its mean counts for nothing."""
    return seen - (area @ seen) / area.sum() if closed else seen


def _bounce(
    exchange: SymmetricMatrix, area: FloatArray, rho: FloatArray, before: FloatArray, to: float = SOLVED_TO
) -> FloatArray:
    """Radiosity B of ``B = before + rho F B``, all bands at once, by conjugate gradients.

    Where rho > 0 the equations times area / rho are symmetric and positive definite; black elements
    (whose B is known) go to the right-hand side (cf. L. Neumann and R. F. Tobler, "New efficient
    algorithms with positive definite radiosity matrix", 1994).  ``area`` is (n, 1).
    """
    live = rho > 0
    diagonal = np.where(live, area / np.where(live, rho, 1.0) - exchange.diagonal()[:, None], 1.0)

    def times(x: FloatArray) -> FloatArray:
        return np.where(live, area / np.where(live, rho, 1.0) * x - exchange @ np.where(live, x, 0.0), 0.0)

    known = np.where(live, 0.0, before)
    wanted = np.where(live, area * before / np.where(live, rho, 1.0) + exchange @ known, 0.0)
    x = np.where(live, before, 0.0)
    rest = wanted - times(x)
    z = rest / diagonal
    direction, power = z.copy(), (rest * z).sum(axis=0)
    goal = to**2 * (wanted * wanted / diagonal).sum(axis=0)
    for _ in range(MOST_STEPS):
        if (power <= goal).all():
            break
        image = times(direction)
        curve = (direction * image).sum(axis=0)
        step = np.divide(power, curve, out=np.zeros_like(power), where=curve > 0)
        x += step * direction
        rest -= step * image
        z = rest / diagonal
        power, before_power = (rest * z).sum(axis=0), power
        turn = np.divide(power, before_power, out=np.zeros_like(power), where=before_power > 0)
        direction = z + turn * direction
    return x + known


def solve_exchange(
    solution: Solution,
    exchange: SymmetricMatrix,
    sums: FloatArray,
    doubt: FloatArray,
    *,
    closed: bool,
    closed_to: float = CLOSED_TO,
    geometry: Geometry | None = None,
) -> FloatArray:
    """Solve for all light that is still to be exchanged, given the exchange areas between all elements.

    Parameters
    ----------
    solution : Solution
        Changed in place: what is unshot is shot, with all that follows from it.
    exchange : SymmetricMatrix
        (n, n): exchange areas A_i F_ij; in a closed scene balanced in place. [scene lengths squared]
    sums, doubt : (n,) float
        Row sums of the form factors as found, and their errors.
    closed : bool
        Whether the elements are an enclosure, so that rows are balanced.
    closed_to : float
        Mean error of the row sums, over the area, that may then be left.
    geometry : Geometry, optional
        Of the scene: elements then send the slope of their radiosity, too, see :class:`Slopes`.

    Returns
    -------
    (n, bands) float
        Radiosity that was exchanged, of the part of each element that sees anything. [W m-2]
    """
    mesh, record = solution.mesh, solution.record
    n, area = mesh.element_count, mesh.element_area
    scale = max(exchange.max(), 1e-300)
    record.errors["row_sum"] = {
        "min": float(sums.min()),
        "mean": float(sums.mean()),
        "max": float(sums.max()),
        "stated_error": float(doubt.max()),
        "rows": n,
    }
    visible = np.ones(n)
    if closed:
        visible = _visible_shares(exchange @ np.ones(n) / area, doubt)
        change = exchange.scale_by(close_rows(exchange, area * visible, closed_to, over_area=True))
        record.errors["row_balance_correction"] = change / scale
        record.results["covered_elements"] = int((visible < 1.0).sum())
    share = np.where(visible > 0, visible, 1.0)[:, None]
    # Light that came from outside or from lamps fell on the visible part, too; emission leaves the whole.
    unshot = solution.unshot
    own = np.minimum(mesh.emission, unshot)
    before = own + (unshot - own) / share
    seen = _bounce(exchange, area[:, None] * share, mesh.reflectance, before)
    beside = np.zeros_like(seen)
    if geometry is not None:
        # Once is enough: what the slopes of the correction send is of a higher order.
        beside = Slopes(mesh, geometry, sums > COVERED, area * share[:, 0]).sent(seen)
        arrives = (exchange @ beside) / (area[:, None] * share)
        seen += _bounce(exchange, area[:, None] * share, mesh.reflectance, mesh.reflectance * arrives, CORRECTED_TO)
    arriving = (exchange @ (seen + beside)) / area[:, None]
    reflected = mesh.reflectance * arriving
    book = solution.book
    shot, received = area @ (unshot + reflected), area @ arriving
    solution.radiosity += reflected
    solution.element_irradiance += arriving
    unshot[:] = 0.0
    book.shot += shot
    book.received += received
    book.absorbed += area @ (arriving - reflected)
    book.escaped += shot - received
    record.errors["remaining_bound"] = 0.0
    record.errors["energy_imbalance"] = book.imbalance(solution.unshot_power)
    solution.converged, solution.stopped = True, "solved"
    return seen


def _visible_shares(sums: FloatArray, doubt: FloatArray) -> FloatArray:
    """Share of each element of an enclosure that sees anything, from its row sum.

    A row far from 1 is no error of form factors: something lies on the element.  What is left of it is all
    that exchanges light, and its row sums to 1.
    """
    return np.where(1.0 - sums > np.maximum(doubt, COVERED), sums, 1.0)


def solve_matrix(
    solution: Solution,
    shader: Shader,
    *,
    error: float,
    closed: bool,
    coarse: Solution | None = None,
    workers: int = 1,
    seed: int = 0,
    progress: Progress | None = None,
) -> None:
    """As :func:`solve_direct`, but with all form factors at once, reciprocal by construction.

    The light of lamps, unless they have too many polygons, goes through the shadow module
    (:mod:`radiosity.solvers.lamps`).  Pairs of the rest are settled in groups
    (:func:`radiosity.form_factors.matrix.exchange_areas`) to ``error``, the mean over the rows of the
    sum of their errors.  Ctrl-C before the end leaves the emission alone as the solution.

    Parameters
    ----------
    solution : Solution
        Before anything is shot; changed in place.
    shader : Shader
        Over the scene's geometry.
    error, workers, seed, progress
        As in :func:`radiosity.solvers.solve.solve`.
    closed : bool
        Whether the elements are an enclosure.
    coarse : Solution, optional
        The same scene, nothing shot, on a mesh whose elements are the patches of the solution's: solved too,
        from the same exchange areas added up.  What differs is what the mesh leaves.  Both then send the slopes of
        radiosity, too (:class:`radiosity.solvers._slopes.Slopes`).
    """
    mesh, record = solution.mesh, solution.record
    n, start = mesh.element_count, time.perf_counter()
    solution.converged, solution.stopped = False, "interrupted"

    def report(done: float) -> None:
        if progress is not None:
            progress(ProgressEvent(0, 1.0 - done, 0.0, time.perf_counter() - start, "form factors"))

    square = np.zeros((2, mesh.bands))
    closed_to = max(CLOSED_SHARE * error * (1.0 - float(mesh.reflectance.max())), CLOSED_TO)
    lamps = lamps_of_scene(solution.scene, shader.geometry)
    try:
        report(0.0)
        with record.stage("form factors"):
            exchange, doubt, spread = exchange_areas(
                mesh, shader.geometry, record, error=error, workers=workers, seed=seed, progress=report
            )
            area = mesh.element_area
            sums, doubt = exchange @ np.ones(n) / area, doubt / area
        if lamps:
            with record.stage("light of lamps"):
                visible = _visible_shares(sums, doubt) if closed else None
                light = lamp_irradiance(mesh, shader, lamps, record.counters, error=error, visible=visible, seed=seed)
    except KeyboardInterrupt:
        return
    # A mesh that was asked for is solved as it is, with one radiosity an element, as by any other method.
    sloped = shader.geometry if coarse is not None else None
    with record.stage("solve"):
        if lamps:
            _receive_lamps(solution, light.irradiance, light.elements)
            square[0] += light.mean_square
        if coarse is not None:
            if lamps:
                emits = np.flatnonzero(coarse.mesh.emission.any(axis=1))
                _receive_lamps(coarse, mesh.patch_mean(light.irradiance), emits)
            row_sums, doubts = (mesh.patch_mean(each[:, None])[:, 0] for each in (sums, doubt))
            summed = exchange.summed(mesh.patch_start)
            solve_exchange(coarse, summed, row_sums, doubts, closed=closed, closed_to=closed_to, geometry=sloped)
        seen = solve_exchange(solution, exchange, sums, doubt, closed=closed, closed_to=closed_to, geometry=sloped)
        square[0] += spread @ _told_apart(seen, area, closed) ** 2 / area.sum()
    solution.state_irradiance_error(form_factors=square[0], visibility=square[1])
    record.errors["reciprocity"] = 0.0
    record.counters.add(shots=n)


def _receive_lamps(solution: Solution, irradiance: FloatArray, elements: IntArray) -> None:
    """Let the light of lamps (the ``elements``) arrive: what they emit has been shot."""
    mesh = solution.mesh
    sent = mesh.element_area[elements] @ mesh.emission[elements]
    solution.unshot[elements] -= mesh.emission[elements]
    receive(solution, irradiance, sent)
