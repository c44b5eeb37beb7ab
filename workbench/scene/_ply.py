"""PLY files (G. Turk, "The PLY Polygon File Format", Stanford 1994) with their polygons whole.

No library at hand will do: trimesh cuts polygons into fans, which is wrong for concave ones, and cannot read
binary files that mix triangles with quads; VTK keeps coordinates in single precision, believes indices out of range
and dies on a binary file cut short; meshio refuses edges, lists of texture coordinates and most names of types;
plyfile is under the GPL, which this project is not.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from workbench.errors import SceneError

__all__ = ["read_ply"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_FORMATS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}

# Name, type of the value, and type of the count before a list or None.
_Property = tuple[str, str, str | None]
_Columns = dict[str, "FloatArray | list[FloatArray]"]


def read_ply(path: Path, data: bytes) -> tuple[FloatArray, list[IntArray], FloatArray | None]:
    """Vertices (v, 3), the vertex indices of each face, and the vertices' normals (v, 3) if the file has them.

    Raises
    ------
    SceneError
        If ``data`` is no PLY file, is cut short, or has indices out of range.
    """
    kind, elements, body = _header(path, data)
    if kind == "ascii":
        try:
            # As doubles in memory, so that text and binary files go one way from here.
            body = np.array(body.split(), dtype="<f8").tobytes()
        except ValueError as error:
            raise SceneError(f"found text among the numbers ({error}); correct the file", path=path) from None
    found: dict[str, _Columns] = {}
    at = 0
    for name, count, properties in elements:
        if kind == "ascii":
            properties = [(label, "f8", None if length is None else "f8") for label, _, length in properties]
        found[name], at = _element(path, name, count, properties, body, at, _FORMATS[kind])

    vertex = found.get("vertex", {})
    if not all(axis in vertex for axis in "xyz"):
        raise SceneError("found no vertices with x, y and z, expected a PLY mesh", path=path)
    vertices = np.column_stack([np.asarray(vertex[axis]) for axis in "xyz"])
    normals = None
    if all(axis in vertex for axis in ("nx", "ny", "nz")):
        normals = np.column_stack([np.asarray(vertex[axis]) for axis in ("nx", "ny", "nz")])
    lists = {name: column for name, column in found.get("face", {}).items() if isinstance(column, list)}
    rings = lists.get("vertex_indices", lists.get("vertex_index", next(iter(lists.values()), [])))
    for number, ring in enumerate(rings):
        if not ((ring >= 0) & (ring < len(vertices)) & (ring == np.floor(ring))).all():
            found_indices = ", ".join(f"{index:g}" for index in ring[:8])
            raise SceneError(
                f"face {number}: found the vertex indices {found_indices}, expected indices of the {len(vertices)} "
                "vertices; export it anew",
                path=path,
            )
    return vertices, [ring.astype(np.int64) for ring in rings if len(ring) >= 3], normals


def _header(path: Path, data: bytes) -> tuple[str, list[tuple[str, int, list[_Property]]], bytes]:
    """Format, the elements in order, and the bytes behind the header."""
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise SceneError("found no PLY header, expected `ply` ... `end_header`; check the file", path=path)
    kind = ""
    elements: list[tuple[str, int, list[_Property]]] = []
    for number, line in enumerate(data[:end].decode("latin-1").splitlines(), start=1):
        words = line.split()
        try:
            match words:
                case ["format", kind, *_] if kind in _FORMATS:
                    pass
                case ["element", name, count]:
                    elements.append((name, int(count), []))
                    if int(count) < 0:
                        raise ValueError
                case ["property", "list", length, value, name]:
                    elements[-1][2].append((name, _TYPES[value], _TYPES[length]))
                case ["property", value, name]:
                    elements[-1][2].append((name, _TYPES[value], None))
                case [] | ["ply" | "comment" | "obj_info", *_]:
                    pass
                case _:
                    raise ValueError
        except (IndexError, KeyError, ValueError):
            raise SceneError(
                f"found {line.strip()[:60]!r}, expected format, element, property or comment", path=path, line=number
            ) from None
    if kind not in _FORMATS:
        raise SceneError(f"found no format, expected one of {', '.join(_FORMATS)}", path=path)
    # Exactly one line end stands behind the header: the bytes after it may look like another.
    start = end + len(b"end_header")
    start += 2 if data[start : start + 2] == b"\r\n" else 1
    return kind, elements, data[start:]


def _element(
    path: Path, name: str, count: int, properties: list[_Property], body: bytes, at: int, order: str
) -> tuple[_Columns, int]:
    """Columns of the ``count`` rows that start at byte ``at``, lists as a list of arrays; and where the rows end."""
    short = SceneError(
        f"the file ends within its {count} of element {name!r}; it is cut short, export it anew", path=path
    )

    def row(at: int) -> tuple[np.dtype, list[int]]:
        """The type of the row at byte ``at``, whose lists say how long they are."""
        fields: list[tuple] = []
        lengths = []
        for label, value, length in properties:
            if length is None:
                fields.append((label, order + value))
                continue
            place = at + np.dtype(fields).itemsize
            size = np.dtype(order + length).itemsize
            if place + size > len(body):
                raise short
            items = int(np.frombuffer(body, order + length, 1, place)[0])
            if items < 0 or place + size + items * np.dtype(value).itemsize > len(body):
                raise short
            fields += [(f"{label} length", order + length), (label, order + value, (items,))]
            lengths.append(items)
        return np.dtype(fields), lengths

    lists = [label for label, _, length in properties if length is not None]
    if count == 0 or not properties:
        return {label: [] if label in lists else np.empty(0) for label, _, _ in properties}, at
    columns: dict[str, list[FloatArray]] = {label: [] for label, _, _ in properties}
    left = count
    while left:
        # As many rows at once as have lists of the same lengths; a file that mixes them pays row by row.
        kind, lengths = row(at)
        rows = min(left, (len(body) - at) // kind.itemsize)
        if rows == 0:
            raise short
        block = np.frombuffer(body, kind, rows, at)
        same = np.ones(rows, dtype=bool)
        for label, items in zip(lists, lengths, strict=True):
            same &= block[f"{label} length"] == items
        rows = rows if same.all() else int(np.argmin(same))
        for label in columns:
            columns[label].append(block[label][:rows].astype(np.float64))
        at += rows * kind.itemsize
        left -= rows
    return {
        label: list(itertools.chain.from_iterable(parts)) if label in lists else np.concatenate(parts)
        for label, parts in columns.items()
    }, at
