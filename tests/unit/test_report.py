"""Metrics, records and charts of error against seconds, on made-up techniques with known errors."""

from __future__ import annotations

import gc
import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from numba import njit

from radiosity.report.metrics import at_error, frontier, relative_rms, resolution, slope
from radiosity.report.page import html_page
from radiosity.report.speed_accuracy import (
    MORE,
    SAME,
    Run,
    apart,
    auto_ratios,
    compare,
    draw_chart,
    measure,
    points_of,
    ranking,
    read_runs,
    scene_digest,
    seconds_to,
    write_runs,
)
from radiosity.report.techniques import Answer, Problem, Reference, Technique, problem_for
from workbench.errors import InputError, OptionError
from workbench.scene.library import diffuse, unit_cube


def test_relative_rms_of_a_known_offset():
    """Half the rows off by 0.1 of a mean of 2: sqrt(0.005) / 2."""
    reference = np.full((1000, 1), 2.0)
    found = reference + np.where(np.arange(1000) % 2 == 0, 0.1, 0.0)[:, None]
    error, doubt = relative_rms(found, reference)
    assert error == pytest.approx(math.sqrt(0.005) / 2.0)
    # squares are 0 or 0.01: their standard deviation is 0.005, and d sqrt(x) = dx / (2 sqrt x)
    assert doubt == pytest.approx(0.005 / math.sqrt(1000) / (2 * math.sqrt(0.005)) / 2.0, rel=1e-2)
    assert relative_rms(reference, reference) == (0.0, 0.0)


def test_relative_rms_takes_off_the_noise_of_the_reference():
    rng = np.random.default_rng(1)
    truth = np.ones((40000, 1))
    reference = truth + 0.03 * rng.normal(size=truth.shape)
    found = truth + 0.04 * rng.normal(size=truth.shape)
    error, doubt = relative_rms(found, reference, 0.03**2)
    assert abs(error - 0.04) < 5 * doubt and doubt < 0.001


def test_resolution_bounds_what_is_left_of_the_noise():
    """A perfect answer against references with known noise: what is left is below the resolution 19 times of 20."""
    rng = np.random.default_rng(2)
    truth = np.ones((1000, 1))
    level = 0.03 * rng.uniform(0.2, 2.0, truth.shape)
    least = resolution(truth, level**2)
    left = [relative_rms(truth, truth + level * rng.normal(size=truth.shape), level**2)[0] for _ in range(400)]
    assert 0.2 < least / np.sqrt((level**2).mean()) < 0.5  # far below the noise
    # Twice the standard error, on one side: 2.3 % of a normal distribution.
    assert np.mean(np.array(left) > least) < 0.05 and np.mean(np.array(left) > 0.5 * least) > 0.05


def test_relative_rms_refuses_what_has_no_meaning():
    for found, reference in (([1.0], [0.0]), ([math.nan], [1.0]), ([1.0, 2.0], [1.0])):
        with pytest.raises(InputError):
            relative_rms(found, reference)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.floats(0.01, 100), st.floats(1e-6, 1)), min_size=1, max_size=20))
def test_frontier_is_what_nothing_beats(points):
    seconds, errors = zip(*points, strict=True)
    kept = frontier(seconds, errors)
    for i in range(len(points)):
        beaten = any(seconds[j] <= seconds[i] and errors[j] <= errors[i] and points[j] != points[i] for j in kept)
        assert beaten or points[i] in [points[k] for k in kept]
    for a, b in itertools.pairwise(kept):
        assert seconds[a] < seconds[b] and errors[a] > errors[b]


def test_slope_and_seconds_at_an_error():
    seconds = [0.01, 0.1, 1.0, 10.0]
    errors = [0.3 * t**-0.5 for t in seconds]
    assert slope(seconds, errors) == pytest.approx(-0.5)
    assert slope(seconds[:2], errors[:2]) is None
    assert at_error(seconds, errors, 0.3) == pytest.approx(1.0)
    assert at_error(seconds, errors, 0.6) == pytest.approx(0.25)
    assert at_error(seconds, errors, 99.0) == 0.01
    assert at_error(seconds, errors, 0.01) is None


class Coin(Problem):
    """Estimate 1 with a known error: value^-1/2, its sign by the seed; counts its calls."""

    what, error_label = "coin", "error"
    own = ("halving", "exact", "auto", "broken")

    def __init__(self):
        super().__init__(unit_cube(0.5, 1.0), workers=1)
        self.calls = []

    def technique(self, name):
        def ask(value, seed):
            self.calls.append((name, value, seed))
            if name == "broken" and value > 1:
                raise OptionError("value: found too much")
            off = 0.0 if name == "exact" else value**-0.5
            return Answer(np.full((4, 1), 1.0 + (off if seed % 2 else -off)), {"rays": int(value)}, off)

        kind = "auto" if name == "auto" else "ours"
        return Technique(name, "samples", (1.0, 4.0, 16.0), ask, kind, seeded=name != "exact")


def test_records_grow_and_are_not_run_again(tmp_path):
    coin, judge = Coin(), Reference("truth", np.ones((4, 1)))
    runs, notes = measure(coin, judge, [("halving", None)], seeds=(0, 1), repeats=2)
    assert len(runs) == 3 * 2 * 2 * MORE and not notes  # settings, seeds, repeats of short runs
    assert {run.error for run in runs} == {1.0, 0.5, 0.25}
    path = tmp_path / "records.csv"
    write_runs(path, runs)
    again = read_runs(path)
    assert [run.place for run in again] == [run.place for run in runs]
    asked = len(coin.calls)
    more, _ = measure(coin, judge, [("halving", None), ("exact", [4.0])], seeds=(0, 1), repeats=2, before=again)
    assert len(more) == len(runs) + 2 * MORE
    assert [call[0] for call in coin.calls[asked:]] == ["exact"] * (1 + 2 * MORE)  # one in vain, one seed
    assert [replace(a, seconds=0) for a in more[: len(runs)]] == [replace(a, seconds=0) for a in again]
    # A record from the beginning has the same counts and errors.
    fresh, _ = measure(Coin(), judge, [("halving", None), ("exact", [4.0])], seeds=(0, 1), repeats=2)
    assert [(r.place, r.rays, r.error) for r in fresh] == [(r.place, r.rays, r.error) for r in more]


def test_a_run_that_compiled_kernels_is_done_again():
    """The finest setting needs a kernel that no other had: its first run is no measurement."""

    class Compiled(Coin):
        def technique(self, name):
            plain = super().technique(name)
            kernel = njit(lambda x: x + 1.0)  # of its own: nothing is compiled before it is called

            def ask(value, seed):
                if value == 16:
                    kernel(value)
                return plain.ask(value, seed)

            return replace(plain, ask=ask)

    coin = Compiled()
    runs, notes = measure(coin, Reference("truth", np.ones((4, 1))), [("halving", None)], repeats=1)
    assert [run.value for run in runs] == [1.0, 4.0, 16.0]
    assert coin.calls == [("halving", value, 0) for value in (1.0, 1.0, 4.0, 16.0, 16.0)]
    assert max(run.seconds for run in runs) < 0.05  # compiling takes longer
    assert len(notes) == 1 and notes[0].startswith("halving at samples 16: a run") and "compiled" in notes[0]


def test_what_fails_is_left_out_with_its_reason():
    runs, notes = measure(Coin(), Reference("truth", np.ones((4, 1))), [("broken", None), ("exact", [1.0])], repeats=1)
    assert [run.place[:2] for run in runs] == [("broken", 1.0), ("exact", 1.0)]
    assert "found too much" in notes[0]


def test_dear_settings_are_left_out():
    runs, notes = measure(Coin(), Reference("truth", np.ones((4, 1))), [("halving", None)], repeats=3, limit=0.0)
    assert {run.value for run in runs} == {1.0} and len(runs) == 3 * MORE
    assert "4, 16 left out" in notes[0]


def test_long_runs_come_once_and_short_ones_often(monkeypatch):
    """Of a clock that says 0.01, 1, 3 and 30 s: fifteen runs, three, one, and one after which the rest is left out."""
    coin, now = Coin(), [0.0]
    took = {1.0: 0.01, 2.0: 1.0, 3.0: 3.0, 4.0: 30.0, 5.0: 60.0}
    technique = coin.technique

    def slow(name):
        made = technique(name)

        def ask(value, seed):
            assert not gc.isenabled() or not now[0]  # it is on in the run in vain only
            now[0] += took[value]
            return made.ask(value, seed)

        return replace(made, ask=ask)

    monkeypatch.setattr(coin, "technique", slow)
    monkeypatch.setattr("radiosity.report.speed_accuracy.time.perf_counter", lambda: now[0])
    plan = [("halving", list(took))]
    runs, notes = measure(coin, Reference("truth", np.ones((4, 1))), plan, repeats=3, limit=2.0, longest=20.0)
    assert [(p.value, p.runs) for p in points_of(runs)] == [(1.0, 15), (2.0, 3), (3.0, 1), (4.0, 1)]
    assert "5 left out" in notes[0] and gc.isenabled()


def test_points_and_the_ratio_of_auto():
    runs, _ = measure(Coin(), Reference("truth", np.ones((4, 1))), [("halving", None), ("auto", [4.0])], seeds=(0, 1))
    runs = [replace(run, seconds=run.value * (3.0 if run.kind == "auto" else 1.0)) for run in runs]
    points = points_of(runs)
    assert [(p.method, p.value, p.error, p.runs) for p in points][-1] == ("auto", 4.0, 0.5, 6 * MORE)
    assert [ratio for _, ratio in auto_ratios(points)] == [pytest.approx(3.0)]


def made(method, value, seconds, error, kind="ours", rays=0, repeat=0):
    return Run(method, kind, "n", value, 0, repeat, seconds, seconds, 0.0, 0.0, error, 0.0, math.nan, rays=rays)


def test_seconds_to_an_error_are_those_of_the_frontiers():
    """Ours fall as 0.1 t^-1/2 and reach 1 %; the rival takes four times as long and ends at 3 %."""
    runs = [made("a", t, t, 0.1 * t**-0.5) for t in (1.0, 10.0, 100.0)]
    runs += [made("slow", t, 2.0 * t, 0.1 * t**-0.5) for t in (1.0, 100.0)]
    runs += [made("r", t, 4.0 * t, 0.1 * t**-0.5, "rival") for t in (1.0, 100 / 9)]
    rows = seconds_to(points_of(runs), (0.1, 0.03, 0.0100001, 0.001))
    assert [row["ours"] for row in rows] == [
        pytest.approx(1),
        pytest.approx(100 / 9),
        pytest.approx(100, rel=1e-4),
        None,
    ]
    assert [row["r"] for row in rows][:2] == [pytest.approx(4), pytest.approx(400 / 9)]
    assert rows[2]["r"] is None and rows[3]["by"] is None
    assert rows[1]["by"] == "a (n 100)"


def test_an_error_below_its_doubt_is_not_believed():
    """A noisy reference is taken off: what is left may be 0, and then says no more than its doubt."""
    run = replace(made("a", 1.0, 1.0, 0.0), error_standard_error=0.002)
    assert points_of([run])[0].error == 0.002


def test_compare_finds_changed_counts_and_swaps():
    def record(factor=1.0, rays=64):
        runs = [made("a", n, t, e, rays=rays, repeat=r) for n, t, e in ((1, 1.0, 0.2), (2, 4.0, 0.1)) for r in (0, 1)]
        runs += [made("b", 1, 2.0 * factor * (1 + 0.1 * r), 0.15, repeat=r) for r in (0, 1)]
        return [*runs, made("r", 1, 1.0, 0.9, "rival", rays=int(factor * 100))]

    same = compare(record(), record())
    assert (same.runs, same.frontier) == (7, 4) and not (same.counts or same.errors or same.swapped or same.ties)
    # b moves from between a's two points to beyond both: of all pairs, that of a 2 and b 1 turns round.
    moved = compare(record(), record(4.0))
    assert len(moved.swapped) == 1 and "a 2" in moved.swapped[0] and "b 1" in moved.swapped[0] and not moved.ties
    # The same move within the spread of b's runs is a tie.
    wide = [replace(run, seconds=0.5 if run.method == "b" and run.repeat else run.seconds) for run in record(4.0)]
    tied = compare(record(), [*wide, made("b", 1, 8.0, 0.15, repeat=2)])
    assert not tied.swapped and len(tied.ties) == 1
    changed = compare(record(), record(rays=65))
    assert len(changed.counts) == 4 and "rays 64 -> 65" in changed.counts[0]
    off = compare(record(), [replace(run, error=run.error * 1.001) for run in record()])
    assert len(off.errors) == 6  # a rival's errors are its own


def times(method, value, error, *seconds):
    return [made(method, value, s, error, repeat=r) for r, s in enumerate(seconds)]


def test_order_is_told_up_to_the_spread():
    """Spreads that overlap, or medians within 5 %, are ties; one outlier of fifteen runs moves nothing."""
    [a, b, c, d, e] = points_of(
        [*times("a", 1, 0.3, 1.0, 1.1, 1.3), *times("b", 1, 0.2, 1.2, 1.4, 1.5), *times("c", 1, 0.4, 1.6, 1.61, 1.62),
         *times("d", 1, 0.1, 2.0, 2.01, 2.0), *times("e", 1, 0.05, 2.07, 2.08, 2.07)]
    )  # fmt: skip
    assert not apart(a, b) and not apart(b, a) and apart(a, c) and apart(c, b)
    one, other, far = points_of([*times("f", 1, 0.1, 1.0), *times("g", 1, 0.1, 1.2), *times("h", 1, 0.1, 1.3)])
    assert not apart(one, other) and apart(one, far)  # of single runs no spread is known
    assert d.slow < e.quick and not apart(d, e)  # 3.5 % apart in every run, which another process may turn round
    assert [(p.method, [q.method for q in tied]) for p, tied in ranking([a, b, c, d, e])] == [
        ("a", ["b"]), ("b", ["a"]), ("d", ["e"]), ("e", ["d"]),
    ]  # fmt: skip
    # c makes a larger error than b and takes longer; were it as fast as b's slowest run, it would be tied.
    near = points_of([*times("b", 1, 0.2, 1.2, 1.4, 1.5), *times("c", 1, 0.4, 1.45, 1.46, 1.48)])
    assert [p.method for p, _ in ranking(near)] == ["b", "c"]
    [many] = points_of(times("m", 1, 0.1, *(1.0 + 0.001 * k for k in range(14)), 9.0))
    assert (many.quick, many.slow) == (1.001, 1.013)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.floats(0.01, 100), st.floats(1.0, 2.0), st.floats(1e-6, 1)), min_size=1, max_size=12))
def test_ranking_holds_the_frontier_and_nothing_beaten(drawn):
    points = points_of([r for i, (t, wide, e) in enumerate(drawn) for r in times(f"m{i}", 1, e, t / wide, t, t * wide)])
    kept = ranking(points)
    names = {p.method for p, _ in kept}
    assert {points[i].method for i in frontier([p.seconds for p in points], [p.error for p in points])} <= names
    for p in points:
        beaten = any(q.error <= p.error and q.slow < p.quick and q.seconds * SAME < p.seconds for q in points)
        assert beaten == (p.method not in names)
    others = {q.method: tied for q, tied in kept}
    assert all(p in others[q.method] for p, tied in kept for q in tied)


def test_a_rerun_within_the_spread_is_reproduced():
    """Two settings that take the same time, run twice: no order is told, whichever came first."""
    rng = np.random.default_rng(5)
    for _ in range(50):
        records = []
        for _ in range(2):
            drift = rng.uniform(0.5, 2.0)  # a whole record may be slow
            seconds = {n: drift * rng.uniform(0.98, 1.02) * (1 + 0.05 * rng.exponential(size=15)) for n in "abc"}
            records.append([r for n, error in zip("abc", (0.3, 0.2, 0.1), strict=True)
                            for r in times(n, 16, error, *seconds[n])])  # fmt: skip
        assert not compare(*records).swapped
    # Three that take 1, 2 and 4 times as long keep their order, and are told when they do not.
    first = [r for k, n in enumerate("abc") for r in times(n, 16, 0.3 - 0.1 * k, *(2.0**k * (1 + 0.05 * seconds["a"])))]
    turned = [replace(r, method={"a": "b", "b": "a"}.get(r.method, r.method)) for r in first]
    turned = [replace(r, error={"a": 0.3, "b": 0.2, "c": 0.1}[r.method]) for r in turned]
    assert not compare(first, first).swapped
    assert compare(first, turned).swapped == ["a 16 and b 16"]


def test_chart_draws_every_technique_and_zero_errors():
    runs, _ = measure(Coin(), Reference("truth", np.ones((4, 1))), [(n, None) for n in ("halving", "exact", "auto")])
    figure = Figure(layout="constrained")
    draw_chart(figure, points_of(runs), title="t", label="e", floor=0.01, noise=0.02)
    figure.savefig("/dev/null", format="png")
    texts = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert any(text.startswith("halving, slope") or text == "halving" for text in texts)
    assert any("chooses itself" in text for text in texts)
    assert figure.axes[0].get_xscale() == figure.axes[0].get_yscale() == "log"


def test_broken_records_are_refused(tmp_path):
    path = tmp_path / "records.csv"
    path.write_text("method,value\nrays,1\n")
    with pytest.raises(InputError, match="no record of runs"):
        read_runs(path)


def test_digest_tells_scenes_apart():
    scene = unit_cube(0.5, 1.0)
    assert scene_digest(scene) == scene_digest(unit_cube(0.5, 1.0))
    other = replace(scene, surfaces=(replace(scene.surfaces[0], material=diffuse("x", 0.6)), *scene.surfaces[1:]))
    assert scene_digest(other) != scene_digest(scene)
    assert scene_digest(replace(scene, notes=("read from a file",))) == scene_digest(scene)


def test_page_is_whole_and_escaped():
    page = html_page("a < b", "<?xml?><svg>x</svg>", {"T": [{"m": "<rays>", "n": "1.5"}]}, ["n & m"], {"cores": 2})
    assert page.startswith("<!doctype html>") and "<svg>x</svg>" in page and "<?xml" not in page
    assert "&lt;rays&gt;" in page and "n &amp; m" in page and "http" not in page


def test_samplers_of_view_factors_refuse_panes():
    """A ray or a pixel ends at a pane, behind which view factors go on."""
    pane = replace(diffuse("pane", 0.0), transmittance=np.array([0.5]))
    scene = unit_cube(0.5, 1.0)
    scene = replace(scene, surfaces=(*scene.surfaces[:5], replace(scene.surfaces[5], material=pane)))
    problem = problem_for("viewfactors", scene, workers=1)
    for name in ("rays", "hemicube"):
        with pytest.raises(OptionError, match="pane"):
            problem.technique(name)
    assert problem.technique("auto").kind == "auto"
