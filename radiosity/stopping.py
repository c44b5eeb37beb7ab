"""Progress bars of solves, and Ctrl-C as a request to stop.

Only the standard library is imported at the top.
"""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from radiosity.solvers.solution import ProgressEvent

__all__ = ["INTERRUPTED", "solve_progress"]

INTERRUPTED = 130
"""Exit code of a command that was stopped by Ctrl-C."""


@contextmanager
def solve_progress() -> Iterator[Any]:
    """A progress bar on a terminal, and Ctrl-C turned into a request to stop after this step.

    Yields the function that the solver calls with a ``ProgressEvent``.  After the first Ctrl-C its
    next call raises ``KeyboardInterrupt``, which the solver answers with the solution so far; a
    second Ctrl-C ends the process.
    """
    from tqdm import tqdm

    asked = False

    def on_interrupt(number: int, frame: Any) -> None:
        nonlocal asked
        if asked:  # threads inside a kernel would keep an exception from ending the process
            os.write(2, b"\nradiosity: quit; nothing was written\n")
            os._exit(INTERRUPTED)
        asked = True
        os.write(2, b"\nradiosity: stopping after this step; press Ctrl-C again to quit at once\n")

    before = signal.signal(signal.SIGINT, on_interrupt)
    bar = tqdm(
        total=1.0,
        disable=None,  # off where standard error is not a terminal
        bar_format="{desc} {percentage:3.0f}%|{bar}| {elapsed}, {remaining} left{postfix}",
        leave=False,
    )
    first_residual: float | None = None

    def report(event: ProgressEvent) -> None:
        nonlocal first_residual
        if not bar.disable:
            if first_residual is None and event.residual > 0:
                first_residual = event.residual
            bar.set_description_str(event.message, refresh=False)
            bar.set_postfix_str(f"{event.shots} shots, residual {event.residual:.2g} > {event.tolerance:.2g}", False)
            bar.update(max(0.0, _share_done(first_residual, event.residual, event.tolerance) - bar.n))
        if asked:
            raise KeyboardInterrupt

    try:
        yield report
    finally:
        bar.close()
        signal.signal(signal.SIGINT, before)


def _share_done(first: float | None, residual: float, tolerance: float) -> float:
    """How far the residual has come from its first value to the tolerance.

    Counted in logarithms: each shot takes away a share of what is left.
    """
    if residual <= tolerance:
        return 1.0
    if first is None or first <= residual:
        return 0.0
    return math.log(first / residual) / math.log(first / tolerance)
