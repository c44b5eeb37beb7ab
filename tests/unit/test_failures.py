"""The catalogue of failures: its formulas, its verdicts, and a quick run of what every technique makes of it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from click.testing import CliRunner

from radiosity.cli import main
from radiosity.report.catalogue import CATALOGUE
from radiosity.report.failures import Failure, contour_factor, judge, point_irradiance
from radiosity.rivals import RIVALS, absent
from workbench.errors import OptionError

UNIT = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])


def test_point_irradiance_below_a_square():
    """0.23083679773 below the middle of a unit square of radiance 1 at height 2; pi below an endless one."""
    assert point_irradiance(UNIT - [0.5, 0.5, -2.0]) == pytest.approx(0.23083679773, abs=1e-11)
    assert point_irradiance(2e6 * (UNIT - [0.5, 0.5, 0.0]) + [0, 0, 1.0]) == pytest.approx(math.pi, rel=1e-5)


@pytest.mark.parametrize("second, expected", [
    (UNIT[::-1] + [0, 0, 1.0], 0.19982489569838746),  # Howell C-11
    (UNIT[:, [2, 1, 0]], 0.20004377607540316),  # Howell C-14, sharing an edge
    (UNIT * [math.cos(math.radians(1)), 1, 0] + UNIT[:, [2, 1, 0]] * [0, 0, math.sin(math.radians(1))], 0.98299717857),
    (UNIT[::-1] + [0, 0, 1e4], 1.0 / (math.pi * 1e8)),  # A / (pi r^2)
])  # fmt: skip
def test_contour_factor(second, expected):
    relative = 1e-3 if expected < 1e-8 else 1e-8  # logarithms of 1e4 cancel to A / r^2
    assert contour_factor(UNIT, second) == pytest.approx(expected, rel=relative)


def test_verdicts():
    def entry(value, stated):
        def refuse():
            raise OptionError("cameras see no panes")

        techniques = {"t": lambda: (value, stated), "r": refuse}
        return Failure("f", "g", "a", 2.0, 0.01, techniques, {"d": "says so"})

    assert judge(entry(2.009, 0.0), "t").verdict == "right"
    assert judge(entry(2.1, 0.05), "t").verdict == "degrades"
    assert judge(entry(2.1, 0.05), "t").error == pytest.approx(0.05)
    assert judge(entry(2.1, 0.001), "t").verdict == "wrong"
    assert judge(entry(2.1, math.nan), "t").verdict == "wrong"
    assert judge(entry(math.nan, 9.0), "t").verdict == "wrong"
    assert judge(entry(2.0, 0.0), "r").verdict == "refuses"
    known = Failure("f", "g", "a", 2.0, 0.01, {"d": lambda: (0.0, 0.0)}, {"d": "says so"})
    assert judge(known, "d").verdict == "disclaims" and judge(known, "d").reason == "says so"


def test_catalogue_is_in_order():
    names = [entry.name for entry in CATALOGUE]
    assert len(set(names)) == len(names) >= 110
    groups = [entry.group for entry in CATALOGUE]
    assert len(set(groups)) == len([g for i, g in enumerate(groups) if i == 0 or groups[i - 1] != g])
    for entry in CATALOGUE:
        assert set(entry.disclaimed) <= set(entry.techniques), entry.name


def test_every_kind_of_failure_and_technique_is_in_it():
    groups = {entry.group for entry in CATALOGUE}
    assert groups >= {
        "touching patches", "grazing pyramids", "reflectance near 1", "float32 far from the origin", "slivers", "leaks",
        "concave lights", "missed small shadows", "mailboxes", "aliasing cameras", "near hits", "silhouettes",
        "fireflies", "dim corners",
    }  # fmt: skip
    techniques = {name for entry in CATALOGUE for name in entry.techniques}
    assert set(RIVALS) <= techniques
    assert {"matrix", "progressive", "directional", "hierarchical", "direct"} <= techniques
    assert {"auto+gather", "matrix+gather", "gathered picture", "atomic picture", "hemicube", "exact"} <= techniques


@pytest.mark.parametrize("entry", CATALOGUE, ids=lambda entry: entry.name)
def test_nothing_is_wrong_silently(entry):
    found = {technique: judge(entry, technique) for technique in entry.techniques if technique not in RIVALS}
    wrong = {technique: cell for technique, cell in found.items() if cell.verdict == "wrong"}
    assert not wrong
    close = [cell.verdict == "right" or abs(cell.error) < 0.1 for cell in found.values()]
    assert any(close) or math.isinf(entry.expected)


@pytest.mark.parametrize("rival", RIVALS)
def test_rivals_are_judged_alike(rival):
    if absent(rival) is not None:
        pytest.skip(str(absent(rival)))
    name = "touching squares" if rival == "pyviewfactor" else "one occluder behind another"
    entry = next(entry for entry in CATALOGUE if entry.name == name)
    assert judge(entry, rival).verdict in ("right", "degrades")


def culls_all(scene, technique, point):
    """Exact cuts after a culler that drops every occluder: no noise, so no error is stated."""
    from radiosity.report import catalogue

    lamps = tuple(surface for surface in scene.surfaces if surface.name.startswith("lamp"))
    return catalogue._shadow(replace(scene, surfaces=lamps), technique, point)


def test_a_broken_technique_is_wrong_silently(tmp_path, monkeypatch):
    """The verdict, the table, the figure's legend and the exit code all say so."""
    from radiosity.report import catalogue

    entry = next(entry for entry in CATALOGUE if entry.name == "wall inside the pyramid")
    scene = entry.techniques["exact"].args[0]
    broken = partial(culls_all, scene, "exact", (0.0, 0.0, 0.0))
    spoilt = replace(entry, techniques={"exact": entry.techniques["exact"], "broken": broken})
    cell = judge(spoilt, "broken")
    # All of the light, where none arrives: 0.2308 of a radiance of 1.
    assert cell.verdict == "wrong" and cell.error == pytest.approx(0.23083679773, abs=1e-9)
    assert judge(spoilt, "exact").verdict == "right"
    monkeypatch.setattr(catalogue, "CATALOGUE", (spoilt,))
    found = CliRunner().invoke(main, ["stability", "-o", str(tmp_path)])
    assert found.exit_code == 1
    assert "broken: WRONG" in found.output and "1 right, 0 degrades, 0 refuses, 0 disclaims, 1 wrong" in found.output


def test_the_command(tmp_path):
    found = CliRunner().invoke(main, ["stability", "--only", "mailboxes", "-o", str(tmp_path / "s")])
    assert found.exit_code == 0, found.output
    assert "ids run out" in found.output and "0 wrong" in found.output
    assert {p.name for p in (tmp_path / "s").iterdir()} == {"stability.csv", "stability.png", "record.json"}
    assert CliRunner().invoke(main, ["stability", "--only", "nothing like it"]).exit_code == 2
    listed = CliRunner().invoke(main, ["stability", "--list"]).output
    assert all(entry.name in listed for entry in CATALOGUE)
