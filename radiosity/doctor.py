"""What this machine has and lacks for the workbench, and what to install."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Check", "examine"]

_INSTALL = "run 'pip install -c constraints.txt .' in the project's folder"


@dataclass(frozen=True)
class Check:
    """One thing that was looked at.

    Parameters
    ----------
    name : str
    good : bool
    found : str
        What there is, or what is wrong.
    advice : str
        What to do about it, empty when all is well.
    essential : bool
        Whether solving is impossible without it.
    """

    name: str
    good: bool
    found: str
    advice: str = ""
    essential: bool = True


def _python() -> Check:
    good = sys.version_info >= (3, 11)
    return Check("python", good, platform.python_version(), "" if good else "install Python 3.11 or newer")


def _embree() -> Check:
    import numpy as np
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], dtype=np.float32))
    origins = np.array([[0.2, 0.2, 1], [0.8, 0.8, 1]], dtype=np.float32)
    hits = scene.run(origins, np.tile(np.array([[0, 0, -1]], dtype=np.float32), (2, 1)))
    version = importlib.metadata.version("embreex")
    if hits.tolist() != [0, -1]:
        return Check("embree", False, f"embreex {version} traced {hits.tolist()}, expected [0, -1]", _INSTALL)
    return Check("embree", True, f"embreex {version}, traces rays")


def _numba() -> Check:
    import numba

    double = numba.njit(lambda x: 2 * x)
    good = double(21) == 42
    return Check("numba", good, f"numba {numba.__version__}, {'compiles' if good else 'compiles wrongly'}", "")


def _libraries() -> Check:
    versions = []
    for name in ("numpy", "scipy", "trimesh", "pyvista", "matplotlib"):
        importlib.import_module(name)
        versions.append(f"{name} {importlib.metadata.version(name)}")
    return Check("libraries", True, ", ".join(versions))


def _threads() -> Check:
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Check("threads", True, f"{usable} usable of {os.cpu_count()} cores")


def _memory() -> Check:
    from workbench.memory import available_bytes

    free = available_bytes()
    good = free >= 1 << 30
    advice = "" if good else "close other programs: less than 1 GiB is free"
    return Check("memory", good, f"{free / (1 << 30):.1f} GiB free", advice, essential=False)


def _kernel_cache() -> Check:
    folder = os.environ.get("NUMBA_CACHE_DIR") or str(Path(__file__).resolve().parent)
    advice = "set NUMBA_CACHE_DIR to a folder that you may write, or each run compiles its kernels anew"
    try:
        with tempfile.TemporaryFile(dir=folder):
            return Check("kernel cache", True, folder, essential=False)
    except OSError as error:
        return Check("kernel cache", False, f"{folder}: {error.strerror}", advice, essential=False)


def _off_screen() -> Check:
    from radiosity.view import drawing_problem

    problem = drawing_problem()
    if problem is None:
        return Check("off-screen GL", True, "'radiosity view --screenshot' works", essential=False)
    found, _, advice = problem.partition("; ")
    return Check("off-screen GL", False, found, f"{advice}, for 'radiosity view'", essential=False)


def _window() -> Check:
    from radiosity.view import window_problem

    problem = window_problem()
    if problem is None:
        return Check("window", True, "'radiosity view' can open one", essential=False)
    return Check("window", False, problem, "use 'radiosity view DIR --screenshot FILE.png'", essential=False)


_CHECKS: dict[str, tuple[Callable[[], Check], bool]] = {
    "python": (_python, True),
    "libraries": (_libraries, True),
    "embree": (_embree, True),
    "numba": (_numba, True),
    "threads": (_threads, True),
    "memory": (_memory, False),
    "kernel cache": (_kernel_cache, False),
    "off-screen GL": (_off_screen, False),
    "window": (_window, False),
}


def examine() -> list[Check]:
    """Look at the machine: every check, in order, whatever fails."""
    results = []
    for name, (check, essential) in _CHECKS.items():
        try:
            results.append(check())
        except Exception as error:  # a broken library may raise anything, and the rest must still be looked at
            results.append(Check(name, False, f"{type(error).__name__}: {error}", _INSTALL, essential))
    return results
