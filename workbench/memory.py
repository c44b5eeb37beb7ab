"""Forecasts of memory: work that cannot fit is refused before it starts, with the number."""

from __future__ import annotations

import os
from pathlib import Path

from workbench.errors import MemoryForecastError

__all__ = ["available_bytes", "require_memory"]


def available_bytes() -> int:
    """Memory that can be taken without swapping, in bytes."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2


def require_memory(needed: float, purpose: str, advice: str) -> None:
    """Refuse work that needs more than is free.

    Raises
    ------
    MemoryForecastError
        If ``needed`` bytes exceed :func:`available_bytes`.
    """
    free = available_bytes()
    if needed > free:
        raise MemoryForecastError(
            f"{purpose} would need about {needed / 2**30:.3g} GiB, {free / 2**30:.3g} GiB is free; {advice}"
        )
