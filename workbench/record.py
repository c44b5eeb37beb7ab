"""The RunRecord: what a run was asked, what it did, what it cost and how wrong it may be."""

from __future__ import annotations

import functools
import json
import os
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from workbench.counters import Counters
from workbench.errors import InputError

__all__ = ["RunRecord", "check_folder", "write_text_atomically"]

_LIBRARIES = ("radiosity-workbench", "numpy", "scipy", "numba", "embreex", "trimesh", "pyvista", "vtk")


@functools.cache
def _versions() -> dict[str, str]:
    import importlib.metadata

    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _machine() -> dict[str, Any]:
    name = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                name = line.split(":", 1)[1].strip()
                break
    except OSError:
        pass
    return {"processor": name, "cores": os.cpu_count(), "system": platform.platform()}


def write_text_atomically(path: str | Path, text: str) -> None:
    """Write beside the target, then rename: a reader never sees half a file."""
    path = Path(path)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        beside.write_text(text, encoding="utf-8")
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def check_folder(path: Path | None) -> None:
    """Refuse, before the work, a folder that cannot take files; leave no trace of the trial.

    Raises
    ------
    InputError
        If the folder cannot be made, or no file can be written into it.
    """
    made: list[Path] = []
    try:
        for folder in [*reversed(path.parents), path] if path is not None else []:
            if not folder.exists():
                folder.mkdir()
                made.append(folder)
        if path is not None:
            probe = path / f".radiosity.{os.getpid()}.part"
            probe.touch()
            probe.unlink()
    except OSError as problem:
        raise InputError(f"{path}: cannot write here: {problem.strerror or problem}; give another folder") from None
    finally:
        for folder in reversed(made):
            folder.rmdir()


@dataclass
class RunRecord:
    """Settings, versions, seconds by stage, counters and error estimates of one run.

    ``seconds`` maps a stage to wall-clock seconds; ``errors`` maps the name of an error estimate
    (with its definition in the name) to its value; ``choices`` says what was chosen
    automatically and why.
    """

    command: str
    settings: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    counters: Counters = field(default_factory=Counters)
    errors: dict[str, Any] = field(default_factory=dict)
    choices: dict[str, str] = field(default_factory=dict)
    results: dict[str, Any] = field(default_factory=dict)

    # Found when asked for: not every run writes its record, and these take some hundredths of a second.
    @cached_property
    def versions(self) -> dict[str, str]:
        """Versions of Python and of the libraries."""
        return dict(_versions())

    @cached_property
    def machine(self) -> dict[str, Any]:
        """Processor, number of cores and system."""
        return _machine()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the wall-clock seconds of the ``with`` block to stage ``name``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def as_dict(self) -> dict[str, Any]:
        """The record as plain JSON-ready values."""
        return {
            "command": self.command,
            "settings": self.settings,
            "choices": self.choices,
            "seconds": {name: round(value, 6) for name, value in self.seconds.items()},
            "counters": dict(self.counters),
            "errors": self.errors,
            "results": self.results,
            "versions": self.versions,
            "machine": self.machine,
        }

    def write(self, path: str | Path) -> None:
        """Write the record as JSON, whole or not at all; ``-`` means standard output."""
        text = json.dumps(self.as_dict(), indent=2, default=float) + "\n"
        if str(path) == "-":
            sys.stdout.write(text)
        else:
            write_text_atomically(path, text)
