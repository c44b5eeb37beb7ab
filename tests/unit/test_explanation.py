"""The cost model and the explanation of a solve, on numbers that are known and on one small room."""

from __future__ import annotations

import time

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.figure import Figure
from numba.core import event

from radiosity.cli import main
from radiosity.report.cost_model import TABLE, CostModel, fit, read_table, write_table
from radiosity.report.explanation import (
    Explanation,
    _ablate,
    _at_most,
    _Outcome,
    _Purse,
    _Stopped,
    draw_ablations,
    explain,
)
from radiosity.report.speed_accuracy import Run
from workbench.errors import InputError, OptionError
from workbench.scene.load import load


def made_up(rays, cuts, seconds, kind="ours"):
    return Run("m", kind, "k", 1.0, 0, 0, seconds, seconds, 0.0, 0.0, 0.1, 0.01, 0.1, rays=rays, exact_cuts=cuts)


def test_fit_finds_the_prices_it_was_made_of():
    """0.01 s to start, 1e-7 s a ray, 1e-6 s a cut."""
    rng = np.random.default_rng(1)
    runs = [made_up(int(r), int(c), 0.01 + 1e-7 * r + 1e-6 * c) for r, c in rng.integers(0, 10**6, (12, 2))]
    model = fit([*runs, made_up(5, 5, 99.0, "rival")])
    assert model.start == pytest.approx(0.01, rel=1e-6)
    assert model.seconds == {"rays": pytest.approx(1e-7), "exact_cuts": pytest.approx(1e-6)}
    assert model.spread < 1e-9 and model.runs == 12
    assert model.predict({"rays": 10**6, "exact_cuts": 10**5}) == pytest.approx(0.21)
    assert list(model.parts({"rays": 1, "exact_cuts": 10**6})) == ["exact_cuts", "start", "rays"]


def test_prices_are_never_negative():
    runs = [made_up(n, 10**5 - n, 0.1 + 1e-7 * n) for n in (10, 20000, 40000, 80000)]
    model = fit(runs)
    assert model.start >= 0 and all(price > 0 for price in model.seconds.values())
    with pytest.raises(InputError, match="3 or more"):
        fit(runs[:2])


def test_the_committed_table_can_be_read_and_written(tmp_path):
    models = read_table()
    assert {"shadows", "viewfactors", "solve"} <= set(models)
    assert all(model.runs >= 3 and model.spread < 1.0 for model in models.values())
    write_table(models, tmp_path / "t.json")
    assert (tmp_path / "t.json").read_text() == TABLE.read_text()
    (tmp_path / "t.json").write_text('{"solve": 3}')
    with pytest.raises(InputError, match="no table"):
        read_table(tmp_path / "t.json")
    assert isinstance(models["solve"], CostModel)


@pytest.mark.parametrize(
    ("method", "dear"), [("auto", "column by column, from each receiver"), ("progressive", "rays for all")]
)
def test_a_solve_is_explained(method, dear):
    found = explain(load("l-room"), error=0.2, method=method, repeats=2)
    told = "\n".join(found.facts)
    for said in ("reached", "not subdivided", "lights", "exact cuts", "rays a point"):
        assert said in told
    assert {item.part for item in found.ablations} == {"mesh", "form factors", "shadows"}
    by_name = {item.without: item for item in found.ablations}
    for item in found.ablations:
        assert len(item.ratios) == 2 and min(item.seconds) > 0 and np.isfinite(item.error_without)
        # The run without the decision did other work: by its solver, its mesh or its counts.
        assert item.used != item.used_without, item
    for without, item in by_name.items():
        if without.startswith("about"):
            few, many = (int(u.split(", ")[1].split()[0].replace(",", "")) for u in (item.used, item.used_without))
            assert many > few
        if without.startswith("read off"):
            assert ", gathered;" in item.used and ", read off;" in item.used_without
        if without == "column by column, from each receiver":
            assert item.used.startswith("matrix, ") and item.used_without.startswith("progressive, ")
        if without == "rays for all":
            assert "exact cuts" in item.used and "exact cuts" not in item.used_without
        if without.endswith("rays at every point"):
            assert "shaft tests" in item.used and "shaft tests" not in item.used_without
    errors = {item.without: item.error_without for item in found.ablations if item.part == "form factors"}
    better = next(item for item in found.ablations if item.without.startswith("form factors to"))
    # Of a whole solve, most of whose error is the mesh's: better form factors leave it as it is, or lower.
    assert errors[better.without] <= 1.05 * better.error
    assert errors[dear] > 1e-3
    if method == "progressive":
        assert max(errors.values()) == errors[dear]
    figure = Figure(layout="constrained")
    draw_ablations(figure, found.ablations, "t")
    figure.savefig("/dev/null", format="png")
    assert len(figure.axes[0].get_yticklabels()) == len(found.ablations)


def test_dear_work_is_stopped_and_told():
    """Of tasks that take 0.01, 0.03 and endless processor seconds, and one that is refused."""

    def work(seconds, used):
        end = time.process_time() + seconds
        while time.process_time() < end:
            sum(range(1000))
        return _Outcome(np.array([[used]]), f"{used}")

    def refused():
        raise OptionError("too much")

    tasks = {"base": lambda: work(0.01, 1), "slow": lambda: work(0.03, 2), "same": lambda: work(0.01, 1),
             "endless": lambda: work(60.0, 3), "refused": refused}  # fmt: skip
    words = {name: (f"not {name}", name) for name in ("slow", "same", "endless", "refused")}
    found = Explanation(None)
    _ablate(found, "mesh", words, "base", tasks, 3, lambda values: float(values[0, 0]) / 100, _Purse(5.0))
    by_name = {item.without: item for item in found.ablations}
    assert set(by_name) == {"slow", "endless"}
    assert len(by_name["slow"].ratios) == 3 and 1.5 < by_name["slow"].ratio < 8.0 and not by_name["slow"].stopped
    assert by_name["endless"].stopped and by_name["endless"].ratio > 5.0 and np.isnan(by_name["endless"].error_without)
    assert "same work" in found.facts[0] and "too much" in found.facts[1]
    figure = Figure(layout="constrained")
    draw_ablations(figure, found.ablations, "t")
    assert any("stopped" in text.get_text() for text in figure.axes[0].texts)
    empty = Explanation(None)
    _ablate(empty, "mesh", words, "base", tasks, 3, lambda values: 0.0, _Purse(0.0))
    assert not empty.ablations and len(empty.facts) == 4 and "no time was left" in empty.facts[0]


def test_compiling_does_not_count():
    """0.3 s of compiling do not end work that may take 0.1 s, and are not taken from the purse."""
    purse = _Purse(1.0)
    part = purse.part(0.5)
    with _at_most(0.1, part) as compiling, event.trigger_event("numba:compile"):
        end = time.process_time() + 0.3
        while time.process_time() < end:
            sum(range(1000))
    assert compiling.processor >= 0.3 and part.left() > 0.4 and purse.left() > 0.9
    with pytest.raises(_Stopped), _at_most(0.01, part):
        while part.left() > 0.0:
            sum(range(1000))
    assert part.left() > 0.3


def test_a_solve_by_links_is_explained():
    found = explain(load("l-room"), error=0.2, method="hierarchical", repeats=1)
    assert "column by column, from each receiver" in {item.without for item in found.ablations}


def test_bad_input_of_the_command(tmp_path):
    for arguments in (["nothing.toml"], ["l-room", "--error", "2"]):
        found = CliRunner().invoke(main, ["explain", *arguments])
        assert found.exit_code == 2 and "Traceback" not in found.output
