"""Other people's engines behind one interface, so that charts can set them beside ours.

A *rival* is made of a scene and answers some of these questions, with a quality that ``samples``
sets; :data:`QUESTIONS` names them.  The packages are optional (the ``peers`` extra): :func:`absent`
says why a rival cannot run here, and nothing is imported before it is asked for.

Every rival sees the same flat polygons as ours, one-sided unless the material is two-sided: the back
is black and blocks light.  What a rival cannot model is refused with a reason, not left out.
"""

from __future__ import annotations

import importlib
import importlib.util
from functools import cache

from radiosity.rivals.base import QUESTIONS, Rival
from workbench.errors import OptionError
from workbench.scene.model import Scene

__all__ = ["QUESTIONS", "RIVALS", "TITLES", "Rival", "absent", "open_rival"]

RIVALS = {
    "mitsuba": ("radiosity.rivals.mitsuba", "Mitsuba", "mitsuba"),
    "pyviewfactor": ("radiosity.rivals.pyviewfactor", "PyViewFactor", "pyviewfactor"),
    "radiance": ("radiosity.rivals.radiance", "Radiance", "pyradiance"),
    "trimesh": ("radiosity.rivals.trimesh_ray", "TrimeshRay", "trimesh"),
}
"""Module, class and needed package of each rival, by its name on the command line."""
TITLES = {
    "mitsuba": "Mitsuba 3, paths",
    "pyviewfactor": "pyViewFactor, contours of a mesh",
    "radiance": "Radiance, rtrace uncached",
    "trimesh": "trimesh.ray, NumPy and Embree",
}
"""What charts call them."""


@cache
def absent(name: str) -> str | None:
    """Why the rival cannot run on this machine, or ``None`` if it can."""
    module, kind, package = _entry(name)
    if importlib.util.find_spec(package) is None:
        return f"{package} is not installed; pip install 'radiosity-workbench[peers]'"
    reason: str | None = getattr(importlib.import_module(module), kind).absent()
    return reason


def open_rival(name: str, scene: Scene) -> Rival:
    """The rival of that name, with the scene loaded.

    Raises
    ------
    OptionError
        If the name is unknown, the rival is absent here, or it cannot model the scene.
    """
    module, kind, _ = _entry(name)
    reason = absent(name)
    if reason is not None:
        raise OptionError(f"{name}: {reason}")
    rival: Rival = getattr(importlib.import_module(module), kind)(scene)
    return rival


def _entry(name: str) -> tuple[str, str, str]:
    if name not in RIVALS:
        raise OptionError(f"rival: found {name!r}, expected one of {', '.join(RIVALS)}")
    return RIVALS[name]
