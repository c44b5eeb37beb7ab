"""Seconds in which numba compiles kernels: they are no part of what a run costs, which has them once a machine."""

from __future__ import annotations

import time

from numba.core import event

__all__ = ["Compiling"]


class Compiling(event.Listener):
    """Seconds in which kernels are compiled, on the clock and of the processor: the first run on a machine has many."""

    def __init__(self) -> None:
        self.wall = self.processor = 0.0
        self._depth = 0
        self._since = (0.0, 0.0)

    def on_start(self, event: event.Event) -> None:
        if self._depth == 0:
            self._since = time.perf_counter(), time.process_time()
        self._depth += 1

    def on_end(self, event: event.Event) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.wall += time.perf_counter() - self._since[0]
            self.processor += time.process_time() - self._since[1]

    def so_far(self) -> float:
        """Processor seconds, those of a kernel under way with them."""
        return self.processor + (time.process_time() - self._since[1] if self._depth else 0.0)
