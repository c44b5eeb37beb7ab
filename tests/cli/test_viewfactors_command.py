"""The command ``radiosity viewfactors``: files, record, exit codes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest


def run(*arguments, cwd=None):
    code = "from radiosity.cli import main; main()"
    return subprocess.run([sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, cwd=cwd)


def test_l_room_by_surface_as_npz_with_its_record(tmp_path):
    done = run("viewfactors", "l-room", "-o", tmp_path / "F.npz", "--by", "surface", "--json", tmp_path / "r.json")
    assert done.returncode == 0, done.stderr
    assert "row sums as found" in done.stdout and "reciprocity error" in done.stdout
    record = json.loads((tmp_path / "r.json").read_text())
    assert record["command"] == "viewfactors" and record["counters"]["links"] > 0
    assert record["errors"]["reciprocity"] < 1e-14
    with np.load(tmp_path / "F.npz") as stored:
        assert len(stored["names"]) == 8
        assert stored["row_sums"] == pytest.approx(np.ones(8), abs=1e-3)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["F.npz", "r.json"]


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["l-room", "-o", "F.txt"], "expected .npz or .csv"),
        (["l-room", "-o", "nowhere/F.npz"], "cannot be written"),
        (["l-room", "-o", "F.npz", "--error", "0"], "--error"),
        (["l-room", "-o", "F.npz", "--error", "nan"], "--error"),
        (["l-room", "-o", "F.npz", "--by", "room"], "--by"),
        (["l-room", "-o", "F.npz", "--elements", "9", "--max-edge", "1"], "found both"),
        (["no-such-scene", "-o", "F.npz"], "no-such-scene"),
        (["l-room", "-o", "F.npz", "--elements", "2000000000"], "GiB"),
    ],
)
def test_bad_input_ends_with_one_line_and_no_file(arguments, wanted, tmp_path):
    done = run("viewfactors", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1 and wanted in done.stderr
    assert not list(tmp_path.iterdir())


def test_ctrl_c_leaves_nothing(tmp_path):
    code = "from radiosity.cli import main; main()"
    arguments = ["viewfactors", "office", "-o", str(tmp_path / "F.npz"), "--elements", "20000", "--error", "1e-5"]
    work = subprocess.Popen([sys.executable, "-c", code, *arguments], stderr=subprocess.PIPE, text=True)
    time.sleep(6.0)
    os.kill(work.pid, signal.SIGINT)
    _, complaint = work.communicate(timeout=60)
    assert work.returncode == 130 and "nothing more was written" in complaint
    assert not list(tmp_path.iterdir())


def test_an_error_that_is_not_reached_is_said(tmp_path, monkeypatch):
    from click.testing import CliRunner

    from radiosity.cli import main
    from radiosity.form_factors import matrix

    monkeypatch.setattr(matrix, "REFINEMENTS", 0)
    arguments = ["viewfactors", "l-room", "-o", str(tmp_path / "F.npz"), "--error", "1e-5"]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0 and "asked for 1e-05, not reached" in done.output
    monkeypatch.undo()
    assert "not reached" not in CliRunner().invoke(main, arguments).output
