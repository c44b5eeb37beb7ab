"""The command ``radiosity chart`` on small questions, to the files that it leaves."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from click.testing import CliRunner

from radiosity.cli import main
from radiosity.report.speed_accuracy import COUNTS
from radiosity.report.techniques import PROBLEMS, problem_for
from workbench.scene.load import load


def run(*arguments):
    return CliRunner().invoke(main, ["chart", *arguments], catch_exceptions=False)


def rows_of(folder):
    with (folder / "records.csv").open() as stream:
        return list(csv.DictReader(stream))


def test_a_chart_of_shadows_grows(tmp_path):
    folder = tmp_path / "chart"
    first = run("cornell-box", "--grid", "8x8", "--repeats", "1", "--methods", "rays,exact", "--sweep", "samples=4,16",
                "-o", str(folder))  # fmt: skip
    assert first.exit_code == 0, first.output
    before = rows_of(folder)
    # 'samples' is the setting of both; exact cuts do not look at it.
    assert [(row["method"], row["value"]) for row in before] == [
        ("rays", "4"), ("rays", "16"), ("exact", "4"), ("exact", "16"),
    ]  # fmt: skip
    assert float(before[2]["error"]) == 0.0 and 0.01 < float(before[1]["error"]) < float(before[0]["error"])
    assert int(before[0]["rays"]) * 4 == int(before[1]["rays"]) > 0
    second = run("cornell-box", "--grid", "8x8", "--repeats", "1", "--methods", "rays,auto", "--sweep", "samples=4,16",
                 "--sweep", "error=0.05", "-o", str(folder))  # fmt: skip
    assert second.exit_code == 0, second.output
    after = rows_of(folder)
    assert after[: len(before)] == before and after[-1]["method"] == "auto"
    for name in ("chart.svg", "chart.png", "report.html", "record.json"):
        assert (folder / name).stat().st_size > 1000
    page = (folder / "report.html").read_text()
    assert "<svg" in page and "camera" not in page and "src=" not in page
    assert json.loads((folder / "record.json").read_text())["settings"]["what"] == "shadows"
    other = run("l-room", "--methods", "exact", "-o", str(folder))
    assert other.exit_code == 2 and "another scene" in other.output


def test_a_rerun_reproduces_every_count(tmp_path):
    """All that chance and threads could change: rays, adaptive shadows, bundles, links; a changed count is told."""
    np.save(tmp_path / "ones.npy", np.ones((16, load("l-room").bands)))
    small = {"shadows": ["cornell-box", "--grid", "8x8", "--methods", "auto,rays,shaft,adaptive,voxel+rayID"],
             "solve": ["l-room", "--points", "16", "--reference", str(tmp_path / "ones.npy"),
                       "--methods", "matrix+gather,directional+gather,hierarchical+gather",
                       "--sweep", "elements=16,50"]}  # fmt: skip
    for what, arguments in small.items():
        question = [arguments[0], "--what", what, *arguments[1:], "--repeats", "1"]
        first, second = tmp_path / f"{what}1", tmp_path / f"{what}2"
        assert run(*question, "--workers", "2", "-o", str(first)).exit_code == 0
        found = run(*question, "--workers", "1", "--compare", str(first), "-o", str(second))
        assert "counts of our own: all equal" in found.output and "errors of our own: all equal" in found.output
        assert f"{len(rows_of(first))} runs that both have" in found.output
        keep = ("method", "value", "seed", "error", *COUNTS)
        assert [[row[k] for k in keep] for row in rows_of(first)] == [[row[k] for k in keep] for row in rows_of(second)]
    text = (first / "records.csv").read_text().splitlines()
    cells = dict(zip(text[0].split(","), text[-1].split(","), strict=True))
    cells["rays"] = str(int(cells["rays"]) + 1)
    (first / "records.csv").write_text("\n".join([*text[:-1], ",".join(cells.values())]) + "\n")
    found = run(*question, "--compare", str(first), "-o", str(second))
    assert found.exit_code == 1 and "counts of our own: 1 differ" in found.output
    assert run("cornell-box", "--compare", str(first), "-o", str(tmp_path / "c")).exit_code == 2


def test_pictures_of_all_light_by_every_technique():
    """At 24 x 24 pixels a gather of some elements is closer to a fine one than the mesh itself; all are finite."""
    problem = problem_for("picture", load("cornell-box"), width=24)
    judge = problem.judged(problem.technique("matrix+gather").ask(400, 3).values)
    off = {}
    for name, value in (("gather", 0.05), ("matrix+gather", 50), ("gather-every-pixel", 50), ("mesh", 100)):
        found = problem.judged(problem.technique(name).ask(value, 3).values)
        off[name] = float(np.sqrt(((found - judge) ** 2).mean()) / judge.mean())
    assert max(off["gather"], off["matrix+gather"], off["gather-every-pixel"]) < 0.1
    assert off["mesh"] > 2.0 * off["matrix+gather"]


@pytest.mark.parametrize("arguments, said", [
    (["--methods", "magic"], "magic"),
    (["--sweep", "samples"], "KEY=V1,V2"),
    (["--sweep", "samples=-1"], "positive"),
    (["--sweep", "colour=1", "--methods", "exact"], "colour"),
    (["--width", "10"], "--width"),
    (["--reference", "nothing.npy", "--methods", "exact"], "nothing.npy"),
    (["--reference", "magic", "--methods", "exact"], "magic"),
    (["--reference", "mitsuba:many", "--methods", "exact"], "RIVAL:SAMPLES"),
    (["--grid", "0x4"], "0x4"),
])  # fmt: skip
def test_bad_input_is_one_line(tmp_path, arguments, said):
    found = run("cornell-box", *arguments, "-o", str(tmp_path / "out"))
    assert found.exit_code == 2
    assert said in found.output and "Traceback" not in found.output


def test_other_questions(tmp_path):
    small = {"viewfactors": ("l-room", ["--methods", "bundle,rays,hemicube", "--sweep", "bundle=0.1",
                                        "--sweep", "rays=4096", "--sweep", "hemicube=4"]),
             "render": ("cornell-box", ["--methods", "aliased,atomic", "--sweep", "aliased=1,2", "--width", "12",
                                        "--sweep", "atomic=0.5"])}  # fmt: skip
    bounds = {"bundle": 0.02, "rays": 0.04, "hemicube": 0.6, "aliased": 1.0, "atomic": 1.0}
    for what, (scene, arguments) in small.items():
        found = run(scene, "--what", what, "--repeats", "1", *arguments, "-o", str(tmp_path / what))
        assert found.exit_code == 0, found.output
        for row in rows_of(tmp_path / what):
            assert float(row["error"]) < bounds[row["method"]], row


def test_an_interrupted_chart_goes_on(tmp_path, monkeypatch):
    from radiosity.report import speed_accuracy

    arguments = ["cornell-box", "--grid", "6x6", "--repeats", "1", "--methods", "rays", "--sweep", "rays=4,16,64"]
    kept = speed_accuracy.write_runs

    def interrupted(path, runs):
        kept(path, runs)
        if len(runs) == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(speed_accuracy, "write_runs", interrupted)
        assert CliRunner().invoke(main, ["chart", *arguments, "-o", str(tmp_path / "c")]).exit_code != 0
    before = rows_of(tmp_path / "c")
    assert len(before) == 2
    found = run(*arguments, "-o", str(tmp_path / "c"))
    assert found.exit_code == 0, found.output
    assert rows_of(tmp_path / "c")[:2] == before and len(rows_of(tmp_path / "c")) == 3


def test_solve_against_a_reference_of_ones_own(tmp_path):
    problem = problem_for("solve", load("l-room"), points=16)
    values = problem.technique("progressive+gather").ask(200, 3).values
    np.save(tmp_path / "mine.npy", values)
    arguments = ["--methods", "progressive,progressive+gather", "--sweep", "elements=100", "--points", "16"]
    reference = ["--reference", str(tmp_path / "mine.npy")]
    found = run("l-room", "--what", "solve", "--repeats", "1", *arguments, *reference, "-o", str(tmp_path / "o"))
    assert found.exit_code == 0, found.output
    coarse, gathered = rows_of(tmp_path / "o")
    assert float(gathered["error"]) < 0.03 and float(coarse["error"]) < 0.3


def test_every_technique_is_on_a_chart():
    """The techniques of the three sources, the engine's own and every solver with and without a gather."""
    expected = {
        "shadows": {"voxel+rayID", "voxel+plane-vertex", "shaft", "adaptive", "exact", "camera", "camera-optimised",
                    "rays", "auto", "mitsuba", "radiance", "trimesh"},
        "viewfactors": {"bundle", "hemicube", "rays", "auto", "pyviewfactor", "trimesh"},
        "solve": {f"{method}{gather}" for method in ("matrix", "progressive", "directional", "hierarchical", "direct")
                  for gather in ("", "+gather")} | {"auto", "mitsuba", "radiance"},
        "render": {"aliased", "adaptive", "atomic", "gather", "mitsuba", "radiance"},
        "picture": {"gather", "gather-every-pixel", "matrix+gather", "mesh", "mitsuba", "radiance"},
    }  # fmt: skip
    for what, names in expected.items():
        assert names <= set(PROBLEMS[what].names()), what


@pytest.mark.parametrize("method", ["matrix", "directional"])
def test_solvers_agree_where_each_is_gathered(method):
    """Two solvers that share no code for form factors find the light of the L-room within their errors."""
    problem = problem_for("solve", load("l-room"), points=16)
    judge = problem.technique("progressive+gather").ask(400, 3)
    found = problem.technique(f"{method}+gather").ask(200, 3)
    assert found.counters["rays" if method == "directional" else "exact_cuts"] > 0
    assert np.abs(found.values - judge.values).mean() < 0.03 * judge.values.mean()
    assert np.abs(problem.technique(method).ask(100, 3).values - judge.values).mean() < 0.3 * judge.values.mean()


def test_every_technique_is_named_in_its_problem():
    for kind in PROBLEMS.values():
        assert len(set(kind.names())) == len(kind.names())
        for name in kind.own:
            assert hasattr(kind, "_" + name.replace("+", "_").replace("-", "_"))
