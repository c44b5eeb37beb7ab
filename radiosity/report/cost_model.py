"""What a count costs: processor seconds a ray, a test, a cut, fitted to records of charts.

Counts travel between machines and seconds do not; the committed table was measured on an AMD EPYC, and a
table of one's own is a chart and a fit away.  It tells where the seconds of a run went (``radiosity
explain``).  No choice is made by it: automatic choice goes by errors that it measures as it solves, and
by counts of elements and polygons.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

from radiosity.report.speed_accuracy import COUNTS, Run, counted
from workbench.errors import InputError
from workbench.record import write_text_atomically

__all__ = ["TABLE", "CostModel", "fit", "read_table", "write_table"]

TABLE = Path(__file__).with_name("cost_table.json")
"""The committed table: a model for each question of ``radiosity chart``."""


@dataclass(frozen=True)
class CostModel:
    """Processor seconds as a sum over counts.

    Parameters
    ----------
    start : float
        Seconds of a run that counts nothing.
    seconds : dict of str to float
        Of one unit of each count, see :data:`radiosity.report.speed_accuracy.COUNTS`.
    spread : float
        Root mean square of the relative error of the fit.
    runs : int
        Runs that it was fitted to.
    """

    start: float
    seconds: Mapping[str, float]
    spread: float
    runs: int

    def parts(self, counters: Mapping[str, int]) -> dict[str, float]:
        """Seconds that each count takes, dearest first; ``start`` is one of them."""
        counts = counted(counters)
        found = {name: self.seconds.get(name, 0.0) * counts[name] for name in COUNTS} | {"start": self.start}
        return dict(sorted(((n, s) for n, s in found.items() if s > 0), key=lambda item: -item[1]))

    def predict(self, counters: Mapping[str, int]) -> float:
        """Processor seconds of a run with these counts."""
        return sum(self.parts(counters).values())


def fit(runs: Sequence[Run]) -> CostModel:
    """Non-negative least squares of relative errors (C. L. Lawson and R. J. Hanson 1974).

    Rivals, and runs that count nothing, are left out.

    Raises
    ------
    InputError
        If fewer than three runs are left.
    """
    mine = [run for run in runs if run.kind != "rival" and run.cpu_seconds > 0 and _row(run).any()]
    if len(mine) < 3:
        raise InputError(f"cost model: found {len(mine)} runs of our own, expected 3 or more; chart more settings")
    seconds = np.array([run.cpu_seconds for run in mine])
    table = np.column_stack([np.ones(len(mine)), np.stack([_row(run) for run in mine])]) / seconds[:, None]
    scale = np.where(table.any(axis=0), np.abs(table).max(axis=0), 1.0)
    found, _ = nnls(table / scale, np.ones(len(mine)))
    found /= scale
    spread = float(np.sqrt(((table @ found - 1.0) ** 2).mean()))
    prices = {name: float(price) for name, price in zip(COUNTS, found[1:], strict=True) if price > 0}
    return CostModel(float(found[0]), prices, spread, len(mine))


def _row(run: Run) -> np.ndarray:
    return np.array([float(getattr(run, name)) for name in COUNTS])


def read_table(path: Path = TABLE) -> dict[str, CostModel]:
    """The models of a table, by the question (``shadows``, ``viewfactors``, ``solve`` ...).

    Raises
    ------
    InputError
        If the file holds no such table.
    """
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return {what: CostModel(**model) for what, model in stored.items()}
    except (OSError, ValueError, TypeError, AttributeError) as problem:
        raise InputError(f"{path}: found no table of costs ({problem})") from None


def write_table(models: Mapping[str, CostModel], path: Path = TABLE) -> None:
    """Write a table, whole or not at all."""
    stored = {
        what: {
            "start": float(f"{model.start:.4g}"),
            "seconds": {name: float(f"{price:.4g}") for name, price in model.seconds.items()},
            "spread": float(f"{model.spread:.3g}"),
            "runs": model.runs,
        }
        for what, model in models.items()
    }
    write_text_atomically(path, json.dumps(stored, indent=2) + "\n")
