"""Radiosity on the workbench: meshes of patches, form factors, solvers, pictures and reports.

>>> import workbench, radiosity
>>> scene = workbench.load("cornell-box")                    # doctest: +SKIP
>>> solution = radiosity.solve(scene, error=0.01)         # doctest: +SKIP
>>> solution.save("out/cornell")                             # doctest: +SKIP

The public names are imported when they are first used, so that ``import radiosity`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from radiosity.accuracy import solve
    from radiosity.form_factors.matrix import ViewFactors, view_factors
    from radiosity.form_factors.pair import FormFactor, form_factor
    from radiosity.patches import PatchMesh
    from radiosity.sensors import Gatherer, IrradianceEstimate
    from radiosity.solvers.solution import ProgressEvent, Solution
    from radiosity.view import render_preview

__all__ = [
    "FormFactor",
    "Gatherer",
    "IrradianceEstimate",
    "PatchMesh",
    "ProgressEvent",
    "Solution",
    "ViewFactors",
    "form_factor",
    "render_preview",
    "solve",
    "view_factors",
]

_HOME = {
    "FormFactor": "radiosity.form_factors.pair",
    "Gatherer": "radiosity.sensors",
    "IrradianceEstimate": "radiosity.sensors",
    "PatchMesh": "radiosity.patches",
    "ProgressEvent": "radiosity.solvers.solution",
    "Solution": "radiosity.solvers.solution",
    "ViewFactors": "radiosity.form_factors.matrix",
    "form_factor": "radiosity.form_factors.pair",
    "render_preview": "radiosity.view",
    "solve": "radiosity.accuracy",
    "view_factors": "radiosity.form_factors.matrix",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
