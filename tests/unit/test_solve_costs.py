"""The table of costs by which a solve to an error chooses its method."""

from __future__ import annotations

import numpy as np
import pytest

from radiosity import accuracy
from radiosity.solve_costs import expected_seconds, features, fit, read_table
from workbench.errors import InputError
from workbench.scene.library import diffuse
from workbench.scene.model import Scene, Surface


def test_a_fit_finds_the_costs_that_made_the_runs():
    truth = {"start": 0.03, "polygon": 1e-3, "hidden": 2e-8}
    rows = []
    for polygons, error in ((8, 0.1), (10, 0.05), (100, 0.02), (200, 0.05)):
        row = features("matrix", polygons=polygons, pieces=polygons + 2, error=error)
        rows.append((row, sum(truth[name] * count for name, count in row.items())))
    assert fit(rows) == pytest.approx(truth, rel=1e-6)


def test_more_of_anything_costs_more():
    size = {"polygons": 100, "pieces": 150}
    for method in read_table():
        seconds = [expected_seconds(method, **size, error=error) for error in (0.1, 0.05, 0.02)]
        assert 0 < seconds[0] < seconds[1] < seconds[2]


def test_a_file_without_a_table_is_told(tmp_path):
    broken = tmp_path / "costs.json"
    broken.write_text("[1, 2]")
    with pytest.raises(InputError, match="no table of costs"):
        read_table(broken)


def test_polygons_in_many_pieces_are_solved_by_links_where_little_is_asked():
    """A comb of 3,000 corners falls into thousands of pieces, all of which a full matrix would pair."""
    teeth = 1500
    x = np.repeat(np.linspace(0, 1, teeth), 2)[: 2 * teeth]
    y = np.tile([1.0, 0.5], teeth)
    outline = np.column_stack([np.r_[x, 1.0, 0.0], np.r_[y, 0.0, 0.0], np.zeros(2 * teeth + 2)])[::-1]
    comb = Surface.from_polygons("comb", diffuse("grey", 0.5, bands=1), [outline])
    lamp = Surface.from_polygons(
        "lamp", diffuse("lamp", 0.0, 1.0, bands=1),
        [np.array([[0, 0, 1.0], [0, 1, 1.0], [1, 1, 1.0], [1, 0, 1.0]])],
    )  # fmt: skip
    chosen = {}
    for error in (0.1, 0.01):
        run = accuracy._Run(target=error, seconds=np.inf, options={}, settings={})
        chosen[error] = accuracy._method(Scene("comb", (comb, lamp), bands=1), run)
        assert run.choices["method"].startswith(chosen[error])
    assert chosen == {0.1: "hierarchical", 0.01: "matrix"}
