"""The bench of rays and shadows: scenes, geometry, tracers, cullers, lights and pictures.

>>> import workbench
>>> scene = workbench.load("cornell-box")                    # doctest: +SKIP
>>> [surface.name for surface in scene.surfaces]             # doctest: +SKIP

The public names are imported when they are first used, so that ``import workbench`` costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from workbench.scene.load import load

    __version__: str

__all__ = ["__version__", "load"]


def __getattr__(name: str) -> Any:
    value: Any
    if name == "load":
        from workbench.scene import load as reader

        value = reader.load
    elif name == "__version__":
        from importlib.metadata import PackageNotFoundError, version

        try:
            value = version("radiosity-workbench")
        except PackageNotFoundError:  # used from a source folder that was never installed
            value = "0+unknown"
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
