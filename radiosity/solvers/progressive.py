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

import time

import numpy as np
from numpy.typing import NDArray

from radiosity.form_factors.bundle import ReceiverBundles
from radiosity.solvers.solution import Progress, ProgressEvent, Solution
from workbench.memory import available_bytes

__all__ = ["remaining_bound", "shoot_until"]

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


def _receive(solution: Solution, factor: FloatArray, senders: IntArray, sent: FloatArray) -> None:
    """Carry radiosity ``sent`` (k, bands) from patches ``senders`` to all elements; keep the book."""
    mesh, book = solution.mesh, solution.book
    arriving = factor.T @ sent
    reflected = mesh.reflectance * arriving
    solution.irradiance += arriving
    solution.radiosity += reflected
    solution.unshot += reflected
    shot = mesh.patch_area[senders] @ sent
    received = mesh.element_area @ arriving
    book.shot += shot
    book.received += received
    book.absorbed += mesh.element_area @ (arriving - reflected)
    book.escaped += shot - received


def _shoot(solution: Solution, patches: IntArray, factor: FloatArray) -> None:
    """Shoot the unshot radiosity of some patches, each as its mean."""
    mesh = solution.mesh
    sent = mesh.patch_mean(solution.unshot)[patches]
    for patch in patches:
        solution.unshot[mesh.patch_start[patch] : mesh.patch_start[patch + 1]] = 0.0
    _receive(solution, factor, patches, sent)


def _solve_rest(solution: Solution, cache: dict[int, FloatArray]) -> None:
    """Solve all further bounces at once, from the form factors of every patch that can send.

    The total each patch will still shoot, s, obeys ``s = u + M s`` with the unshot radiosity ``u``
    and ``M`` the reflected share of each patch's form factors, all as patch means.
    """
    mesh = solution.mesh
    senders = np.asarray(sorted(cache))
    factor = np.stack([cache[patch] for patch in senders.tolist()])
    unshot = mesh.patch_mean(solution.unshot)[senders]
    total = np.empty_like(unshot)
    for band in range(mesh.bands):
        weight = mesh.element_area * mesh.reflectance[:, band]
        back = np.add.reduceat(factor * weight, mesh.patch_start[:-1], axis=1).T[senders]
        system = np.eye(len(senders)) - back / mesh.patch_area[senders][:, None]
        total[:, band] = np.linalg.solve(system, unshot[:, band])
    _receive(solution, factor, senders, total)
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


def shoot_until(
    solution: Solution,
    bundles: ReceiverBundles,
    *,
    tolerance: float,
    progress: Progress | None = None,
) -> None:
    """Shoot a solution's unshot power until :func:`remaining_bound` falls below ``tolerance``.

    The solution is changed in place and usable after each step; ``KeyboardInterrupt`` (raised by
    ``progress`` or by Ctrl-C) ends the work with ``stopped = "interrupted"``.
    """
    mesh, record = solution.mesh, solution.record
    start = time.perf_counter()
    cache: dict[int, FloatArray] = {}
    room = int(CACHE_SHARE * available_bytes() / (8 * mesh.element_count))
    can_send = np.maximum.reduceat(mesh.reflectance.max(axis=1), mesh.patch_start[:-1]) > 0
    sums: list[float] = []
    doubts: list[float] = []
    known: set[int] = set()
    solution.converged, solution.stopped = False, "interrupted"
    try:
        while True:
            residual = remaining_bound(solution)
            if progress is not None:
                seconds = time.perf_counter() - start
                progress(ProgressEvent(record.counters["shots"], residual, tolerance, seconds, "shooting"))
            if residual <= tolerance:
                solution.converged, solution.stopped = True, "tolerance"
                break
            power = np.abs(mesh.patch_mean(solution.unshot)).sum(axis=1) * mesh.patch_area
            waiting = can_send | (power > 0)
            if (
                len(cache)
                and waiting.sum() <= min(len(cache), SOLVE_LIMIT)
                and all(int(p) in cache for p in np.flatnonzero(waiting))
            ):
                with record.stage("solve"):
                    _solve_rest(solution, cache)
                solution.converged, solution.stopped = True, "solved"
                break
            # Strongest first; ties by number, so that the order is the same everywhere.
            order = np.lexsort((np.arange(len(power)), -power))[:BATCH]
            batch = order[power[order] >= BATCH_SHARE * power[order[0]]]
            if not power[batch[0]] > 0:
                solution.converged, solution.stopped = True, "tolerance"
                break
            fresh = np.asarray([p for p in batch.tolist() if p not in cache], dtype=np.int64)
            rows = {p: cache[p] for p in batch.tolist() if p in cache}
            if len(fresh):
                with record.stage("form factors"):
                    columns = bundles.columns(fresh, _floors(solution, fresh, bundles.settings.error))
                for row, patch in enumerate(fresh.tolist()):
                    factor = columns.factor[row]
                    row_sum = float(factor @ mesh.element_area / mesh.patch_area[patch])
                    if patch not in known:
                        known.add(patch)
                        sums.append(row_sum)
                        doubts.append(float(columns.spread[row] @ mesh.element_area / mesh.patch_area[patch]))
                    if solution.scene.closed and row_sum >= LEAST_ROW_SUM:
                        factor = factor / row_sum  # in an enclosure all that is shot arrives
                    rows[patch] = factor
                    if len(cache) < room:
                        cache[patch] = factor
            with record.stage("shoot"):
                _shoot(solution, batch, np.stack([rows[p] for p in batch.tolist()]))
            record.counters.add(shots=len(batch))
    except KeyboardInterrupt:
        pass
    finally:
        _report(solution, bundles, cache, np.asarray(sums), np.asarray(doubts))


def _report(
    solution: Solution,
    bundles: ReceiverBundles,
    cache: dict[int, FloatArray],
    sums: FloatArray,
    doubts: FloatArray,
) -> None:
    """Put what the run knows of its own errors into the record."""
    mesh, record = solution.mesh, solution.record
    record.counters.merge(bundles.counters)
    record.seconds["inside embree, summed over threads"] = bundles.seconds_in_embree
    record.errors["remaining_bound"] = remaining_bound(solution)
    record.errors["energy_imbalance"] = solution.book.imbalance(solution.unshot_power)
    if len(sums):
        record.errors["row_sum"] = {
            "min": float(sums.min()),
            "mean": float(sums.mean()),
            "max": float(sums.max()),
            "stated_error": float(doubts.max()),
            "rows": len(sums),
        }
    if len(cache) > 1:
        patches = np.asarray(sorted(cache))
        exchange = np.stack(
            [np.add.reduceat(cache[p] * mesh.element_area, mesh.patch_start[:-1])[patches] for p in patches.tolist()]
        )
        scale = max(float(exchange.max()), 1e-300)
        record.errors["reciprocity"] = float(np.abs(exchange - exchange.T).max() / scale)
