"""Progressive refinement: shoot the patch with the most unshot power, until little is left.

M. F. Cohen, S. E. Chen, J. R. Wallace and D. P. Greenberg, "A progressive refinement approach to
fast radiosity image generation" (SIGGRAPH 1988), on patches that shoot and elements that receive,
with the receiver bundles of Wallace, Elmquist and Haines (1989).  Three departures:

* patches are shot a few at a time, so that threads have work (the batch never depends on how many
  threads there are);
* in a scene declared closed, a patch's form factors are scaled to carry all that it shoots; near
  reflectance 1 a row sum's small error would else be multiplied by 1 / (1 - rho);
* form factors already found are kept while memory lasts, and once every patch that can send has
  been shot, what is left to bounce is solved at once on the patches.  Near reflectance 1 shooting
  alone would need thousands of rounds.
"""

from __future__ import annotations

import math
import time

import numpy as np
from numpy.typing import NDArray

from radiosity.form_factors.bundle import ColumnFinder
from radiosity.solvers.solution import Checkpoint, Progress, ProgressEvent, ShootingState, Solution
from workbench.memory import available_bytes

__all__ = ["receive", "remaining_bound", "shoot_until"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

BATCH = 8
"""Most patches shot at once."""
BATCH_SHARE = 0.25
"""A patch joins the batch if it has this share of the largest unshot power."""
SOLVE_LIMIT = 3000
"""Most patches whose last bounces are solved at once."""
FLOOR_SHARE = 0.1
"""Share of the wanted error that one patch may bring to an irradiance."""
LEAST_ROW_SUM = 0.1
"""A patch of a closed scene that sees less than this is covered, and shoots as it is."""
CACHE_SHARE = 0.25
"""Share of the free memory that kept form factors may take."""
CHECKPOINT_SECONDS = 10.0
"""Least time between checkpoints."""
CHECKPOINT_SHARE = 0.05
"""Share of the time that checkpoints may take."""


def remaining_bound(solution: Solution) -> float:
    """Bound on the light still missing, relative to all light that arrives.

    What is unshot can bring at most ``unshot / (1 - rho)`` more, ``rho`` being the largest
    reflectance: a bound on the error, where the size of the last change is none.
    """
    mesh = solution.mesh
    unshot = mesh.element_area @ np.abs(solution.unshot)
    largest = mesh.reflectance.max(axis=0)
    coming = unshot / np.maximum(1.0 - largest, 1e-12)
    whole = coming + solution.book.received
    return float(np.divide(coming, whole, out=np.zeros_like(coming), where=whole > 0).max(initial=0.0))


def receive(solution: Solution, arriving: FloatArray, shot: FloatArray) -> None:
    """Let irradiance ``arriving`` (n, bands) of a shot power (bands,) arrive; keep the book."""
    mesh, book = solution.mesh, solution.book
    reflected = mesh.reflectance * arriving
    solution.element_irradiance += arriving
    solution.radiosity += reflected
    solution.unshot += reflected
    received = mesh.element_area @ arriving
    book.shot += shot
    book.received += received
    book.absorbed += mesh.element_area @ (arriving - reflected)
    book.escaped += shot - received


def _shoot(solution: Solution, state: ShootingState, patches: IntArray, factor: FloatArray) -> None:
    """Shoot the unshot radiosity of some patches, each as its mean."""
    mesh = solution.mesh
    sent = mesh.patch_mean(solution.unshot)[patches]
    state.sent[patches] += sent
    for patch in patches:
        solution.unshot[mesh.patch_start[patch] : mesh.patch_start[patch + 1]] = 0.0
    receive(solution, factor.T @ sent, mesh.patch_area[patches] @ sent)


def _solve_rest(solution: Solution, state: ShootingState, senders: IntArray, factor: FloatArray) -> None:
    """Solve all further bounces at once, from the form factors of every patch that can send.

    The total each patch will still shoot, s, obeys ``s = u + M s`` with the unshot radiosity ``u``
    and ``M`` the reflected share of each patch's form factors, all as patch means.
    """
    mesh = solution.mesh
    unshot = mesh.patch_mean(solution.unshot)[senders]
    total = np.empty_like(unshot)
    for band in range(mesh.bands):
        weight = mesh.element_area * mesh.reflectance[:, band]
        back = np.add.reduceat(factor * weight, mesh.patch_start[:-1], axis=1).T[senders]
        system = np.eye(len(senders)) - back / mesh.patch_area[senders][:, None]
        total[:, band] = np.linalg.solve(system, unshot[:, band])
    state.sent[senders] += total
    receive(solution, factor.T @ total, mesh.patch_area[senders] @ total)
    # All that arrived has been shot again within ``total``.
    solution.unshot[:] = 0.0


def _floors(solution: Solution, patches: IntArray, error: float) -> FloatArray:
    """Form-factor error that matters for each patch: a share of the light there is, over its own.

    An error dF of a form factor changes an irradiance by ``dF * B``: of the contribution B F A that
    hierarchical radiosity refines by (P. Hanrahan, D. Salzman and L. Aupperle 1991), A is common to all.
    """
    mesh, book = solution.mesh, solution.book
    mean = np.maximum(book.received, book.emitted) / mesh.element_area.sum()
    sent = mesh.patch_mean(solution.unshot)[patches]
    share = np.divide(sent, mean, out=np.zeros_like(sent), where=mean > 0).max(axis=1)
    return FLOOR_SHARE * error / np.maximum(share, 1e-12)


def _columns(
    solution: Solution, state: ShootingState, bundles: ColumnFinder, patches: IntArray, room: int
) -> dict[int, FloatArray]:
    """Form factors to some patches: those kept, and those found now, which are kept while there is room."""
    mesh = solution.mesh
    rows = {p: state.kept[p] for p in patches.tolist() if p in state.kept}
    missing = np.asarray([p for p in patches.tolist() if p not in rows], dtype=np.int64)
    if not len(missing):
        return rows
    # A patch keeps the care it was given at first: found again, after a break, its form factors are the same.
    fresh = np.isnan(state.floor[missing])
    state.floor[missing[fresh]] = _floors(solution, missing[fresh], bundles.settings.error)
    with solution.record.stage("form factors"):
        columns = bundles.columns(missing, state.floor[missing])
    area, patch_area = mesh.element_area, mesh.patch_area[missing]
    state.row_sum[missing] = columns.factor @ area / patch_area
    state.doubt[missing] = columns.spread @ area / patch_area
    state.mean_square[missing] = columns.mean_square
    for row, patch in enumerate(missing.tolist()):
        factor = columns.factor[row]
        if solution.scene.closed and state.row_sum[patch] >= LEAST_ROW_SUM:
            factor = factor / state.row_sum[patch]  # in an enclosure all that is shot arrives
        rows[patch] = factor
        if len(state.kept) < room:
            state.kept[patch] = factor
    return rows


def shoot_until(
    solution: Solution,
    bundles: ColumnFinder,
    *,
    tolerance: float,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
) -> None:
    """Shoot a solution's unshot power until :func:`remaining_bound` falls below ``tolerance``.

    The solution is changed in place and usable after each step; ``KeyboardInterrupt`` (raised by
    ``progress`` or by Ctrl-C) ends the work with ``stopped = "interrupted"``.  ``checkpoint`` is called with it
    now and then; gone on from there, or from the interruption, the answer is the same, bit for bit.
    """
    mesh, record = solution.mesh, solution.record
    start = time.perf_counter()
    saved = -math.inf  # the first at once: from then on a solve that is killed can go on
    pause = CHECKPOINT_SECONDS
    if solution.shooting is None:
        solution.shooting = ShootingState.empty(mesh.patch_count, mesh.bands)
    state = solution.shooting
    room = int(CACHE_SHARE * available_bytes() / (8 * mesh.element_count))
    can_send = np.maximum.reduceat(mesh.reflectance.max(axis=1), mesh.patch_start[:-1]) > 0
    solution.converged, solution.stopped = False, "interrupted"
    try:
        while True:
            residual = remaining_bound(solution)
            if progress is not None:
                seconds = time.perf_counter() - start
                progress(ProgressEvent(record.counters["shots"], residual, tolerance, seconds, "shooting"))
            if checkpoint is not None and time.perf_counter() - saved > pause:
                _report(solution, bundles, state)
                began = time.perf_counter()
                checkpoint(solution)
                saved = time.perf_counter()
                pause = max(CHECKPOINT_SECONDS, (saved - began) / CHECKPOINT_SHARE)
            if residual <= tolerance:
                solution.converged, solution.stopped = True, "tolerance"
                break
            power = np.abs(mesh.patch_mean(solution.unshot)).sum(axis=1) * mesh.patch_area
            waiting = np.flatnonzero(can_send | (power > 0))
            if 0 < len(waiting) <= min(room, SOLVE_LIMIT) and not np.isnan(state.floor[waiting]).any():
                rows = _columns(solution, state, bundles, waiting, room)
                with record.stage("solve"):
                    _solve_rest(solution, state, waiting, np.stack([rows[p] for p in waiting.tolist()]))
                solution.converged, solution.stopped = True, "solved"
                break
            # Strongest first; ties by number, so that the order is the same everywhere.
            order = np.lexsort((np.arange(len(power)), -power))[:BATCH]
            batch = order[power[order] >= BATCH_SHARE * power[order[0]]]
            if not power[batch[0]] > 0:
                solution.converged, solution.stopped = True, "tolerance"
                break
            rows = _columns(solution, state, bundles, batch, room)
            with record.stage("shoot"):
                _shoot(solution, state, batch, np.stack([rows[p] for p in batch.tolist()]))
            record.counters.add(shots=len(batch))
    except KeyboardInterrupt:
        pass
    finally:
        _report(solution, bundles, state)


def _report(solution: Solution, bundles: ColumnFinder, state: ShootingState) -> None:
    """Put what the run knows of its own errors into the record."""
    mesh, record = solution.mesh, solution.record
    record.counters.merge(bundles.take_counters())
    inside = "inside embree, summed over threads"
    record.seconds[inside] = record.seconds.get(inside, 0.0) + bundles.seconds_in_embree
    bundles.seconds_in_embree = 0.0
    record.errors["remaining_bound"] = remaining_bound(solution)
    record.errors["energy_imbalance"] = solution.book.imbalance(solution.unshot_power)
    known = np.flatnonzero(~np.isnan(state.floor))
    if len(known):
        sums = state.row_sum[known]
        record.errors["row_sum"] = {
            "min": float(sums.min()),
            "mean": float(sums.mean()),
            "max": float(sums.max()),
            "stated_error": float(state.doubt[known].max()),
            "rows": len(known),
        }
        # Errors of different senders are independent: their squares add.
        square = state.mean_square[known].T @ state.sent[known] ** 2
        solution.state_irradiance_error(form_factors=square[0], visibility=square[1])
    if len(state.kept) > 1:
        patches = np.asarray(sorted(state.kept))
        exchange = np.stack(
            [
                np.add.reduceat(state.kept[p] * mesh.element_area, mesh.patch_start[:-1])[patches]
                for p in patches.tolist()
            ]
        )
        scale = max(float(exchange.max()), 1e-300)
        record.errors["reciprocity"] = float(np.abs(exchange - exchange.T).max() / scale)
