"""Woo's Table 1 at a tiny size: its columns, its formula and its files; seconds are not asserted."""

from __future__ import annotations

import json

import numpy as np
import pytest

from radiosity.reproduce import REPRODUCTIONS
from workbench.render.pictures import PICTURES
from workbench.study.atomic_table import PAPER_MINUTES, atomic_study, picture_difference
from workbench.study.result import write_study


@pytest.fixture(scope="module")
def result():
    return atomic_study(width=40, height=30, repeats=1)


def test_rows_follow_the_papers_formula(result):
    assert [row["picture"] for row in result.rows] == list(PICTURES)
    assert [row["lights"] for row in result.rows] == [2, 1, 3, 1]
    for row in result.rows:
        for name, new in (("saved_%", "atomic_s"), ("whole_tree_saved_%", "whole_tree_s")):
            assert row[name] == pytest.approx(100 * (row["adaptive_s"] - row[new]) / row["adaptive_s"])
        assert 30 < row["rays_saved_%"] < 100
        assert 0 < row["rms_of_255"] < 6
    # 28.6, 21.4 and 44.4 per cent; the paper prints 40 for the first.
    assert [row["paper_saved_%"] for row in result.rows[:3]] == pytest.approx([28.57, 21.43, 44.44], abs=0.01)
    assert result.rows[3]["paper_saved_%"] is None and "tori" not in PAPER_MINUTES


def test_record_has_rays_by_kind_and_by_light(result):
    for name in PICTURES:
        found = result.record.results[name]
        adaptive, atomic = found["adaptive"], found["atomic"]
        assert adaptive["rays"]["shadow_rays_saved"] == 0 < atomic["rays"]["shadow_rays_saved"]
        for kind in ("cast", "shadow", "reflection"):
            assert atomic["rays"][f"{kind}_rays"] < adaptive["rays"][f"{kind}_rays"]
        assert sum(light["shot"] for light in atomic["shadows"].values()) == atomic["rays"]["shadow_rays"]
        assert atomic["rms_difference_of_255"] <= atomic["largest_difference_of_255"]


def test_difference_of_pictures():
    one = np.zeros((2, 2, 3))
    other = one.copy()
    other[0, 0] = 7.0  # pegged at 1
    assert picture_difference(one, other) == (pytest.approx(127.5), 255.0)


def test_files_and_figure(result, tmp_path):
    files = write_study(result, tmp_path)
    assert [file.name for file in files] == ["woo-table-1.csv", "woo-table-1.png", "record.json"]
    assert files[1].stat().st_size > 20_000
    assert json.loads(files[2].read_text())["results"]["spheres"]["triangles"] > 10_000
    assert "woo-table-1" in REPRODUCTIONS
