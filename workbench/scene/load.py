"""A scene from a file of any known kind, chosen by its suffix, or a built-in scene by its name."""

from __future__ import annotations

import difflib
import importlib
import tomllib
from pathlib import Path

from workbench.errors import SceneError
from workbench.scene.model import Scene
from workbench.scene.overlaps import without_overlaps

__all__ = ["SUFFIXES", "built_in_scenes", "load"]

_MESH = "workbench.scene.mesh"
_READERS = {
    ".toml": "workbench.scene.toml",
    ".obj": _MESH,
    ".obj.gz": _MESH,
    ".ply": _MESH,
    ".stl": _MESH,
    ".glb": _MESH,
    ".gltf": _MESH,
    ".sc": "workbench.scene.sc",
    ".nff": "workbench.scene.nff",
    ".rad": "workbench.scene.rad",
}
_AS_THEY_ARE = (".sc", ".nff")
SUFFIXES = tuple(_READERS)
"""Suffixes of the files that :func:`load` reads."""

_FOLDER = Path(__file__).resolve().parents[2] / "scenes"
"""The built-in scenes lie beside the package, in the repository; an installed wheel has none."""


def _built_in_files() -> dict[str, Path]:
    return {path.stem: path for path in sorted(_FOLDER.glob("*.toml"), key=lambda path: path.stem)}


def built_in_scenes() -> dict[str, str]:
    """Name and description of each built-in scene; empty where the repository's ``scenes`` is absent."""
    found = {}
    for name, path in _built_in_files().items():
        try:
            found[name] = str(tomllib.loads(path.read_text(encoding="utf-8")).get("description", ""))
        except (OSError, ValueError) as error:
            found[name] = f"(cannot be read: {' '.join(str(error).split())})"
    return found


def load(path: str | Path | Scene) -> Scene:
    """Read a scene.

    Parameters
    ----------
    path : str, Path or Scene
        A file whose suffix is one of :data:`SUFFIXES` (in small or capital letters), or the name of
        a built-in scene such as ``"cornell-box"``; a file of that name comes first.  A scene is
        handed back, so that what takes a scene takes its name, too.

    Returns
    -------
    Scene
        What the reader changed or supposed stands in its ``notes``.  Where polygons lie on others in one plane, what
        they hide is cut away (:mod:`workbench.scene.overlaps`), but for the files of ray casters (.sc, .nff).

    Raises
    ------
    SceneError
        If there is no such file or its contents cannot be used: one line that names the file, the
        line or key, what was found and what was wanted.

    See Also
    --------
    workbench.scene.toml : the native format.
    workbench.scene.rad : what becomes of Radiance files.
    workbench.scene.mesh : what becomes of OBJ, PLY, STL, GLB and glTF files.
    """
    if isinstance(path, Scene):
        return without_overlaps(path)
    try:
        path = Path(path)
    except TypeError:
        raise SceneError(f"scene: found {path!r}, expected a Scene, a file or the name of a built-in scene") from None
    name = path.name.lower()
    suffix = next((known for known in sorted(_READERS, key=len, reverse=True) if name.endswith(known)), None)
    if suffix is not None:
        scene: Scene = importlib.import_module(_READERS[suffix]).load_scene(path)
        return scene if suffix in _AS_THEY_ARE else without_overlaps(scene)
    built_in = _built_in_files()
    if str(path) in built_in and not path.is_file():
        return load(built_in[str(path)])
    if path.is_dir():
        raise SceneError("found a folder, expected a scene file or the name of a built-in scene", path=path)
    if "." in path.name.strip(".") or path.exists():
        raise SceneError(f"found an unknown kind of file, expected one of {', '.join(SUFFIXES)}", path=path)
    close = difflib.get_close_matches(str(path), built_in, n=1)
    hint = f"did you mean {close[0]!r}?" if close else "`radiosity scenes` lists the built-in ones"
    raise SceneError(f"found no such file and no built-in scene of that name; {hint}", path=path)
