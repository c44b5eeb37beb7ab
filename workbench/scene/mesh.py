"""Mesh files: OBJ, PLY, STL, GLB and glTF; the door to trimesh.

STL, GLB and glTF are read by trimesh, which gives triangles.  OBJ, MTL and PLY statements are read here:
trimesh cuts quads and polygons into triangles, where radiosity patches want them whole, takes
the negative indices of a file whose groups follow each other for those of the first group, and passes over
colours with a comment behind them.

What becomes of a file:

* **Surfaces.**  One for each group or object and material of an OBJ file, one for each mesh node
  (with its transform applied) of the others.  It is named after its material if no other surface
  has that material, else after its group, else after both.
* **Faces.**  Quads and polygons of OBJ and PLY files stay whole, concave ones too; those that are not
  planar are cut into triangles.  Faces without area, and those that repeat another, are dropped.  The notes count
  each.
* **Fronts.**  The winding is taken as it stands and surfaces are one-sided, whether they look
  outward (a solid) or inward (a room), unless the file says ``doubleSided``.  Where neighbours
  of a closed body contradict each other, the smaller part of its faces is turned; where those of
  an open sheet do, its surface becomes two-sided.  Both are noted.
* **Materials.**  OBJ: ``Kd`` is the reflectance, ``Ke`` the emission [W/m2], ``Ks`` with ``Ns`` the
  specular reflectance (a mirror from ``illum 3`` on, none for 0 and 1), cut where the sum would
  exceed 1; ``Tf`` with ``illum`` 4, 6, 7 or 9, else ``1 - d`` (or ``Tr``), the transmittance; ``Ni`` the index of
  refraction.  glTF: the base colour (linear by that format's definition) is the reflectance, its
  alpha with ``alphaMode BLEND`` the transmittance, the emissive factor times its strength the emission; metal and
  roughness are not read.  A texture of reflectance or emission counts with its mean colour, decoded from sRGB; a
  missing one is left out.  Surfaces without a material are grey, reflectance 0.5.  All have three bands.
* **Lights and cameras** of glTF files are read (candela and lux as W/sr and W/m2); other formats have none.
"""

from __future__ import annotations

import gzip
import io
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from workbench.errors import SceneError
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import PLANARITY, triangulate_ring
from workbench.scene._gltf import described, lights_and_cameras, strengthened
from workbench.scene._ply import read_ply
from workbench.scene.library import rings_cross
from workbench.scene.model import Camera, Light, Material, Scene, Surface

__all__ = ["MESH_SUFFIXES", "MeshSurfaces", "lit", "load_scene", "read_mesh"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".obj.gz", ".ply", ".stl")
"""Suffixes of the mesh files that can be read."""

DEFAULT_REFLECTANCE = 0.5
"""Reflectance of a surface whose file gives none."""

LARGEST_REFLECTANCE = 0.99
"""No paint reflects more; a file's white (1, 1, 1) would keep light in a closed room for ever."""

_ZERO_AREA = 1e-14
"""A face below this share of its squared extent has no area."""


@dataclass(frozen=True)
class MeshSurfaces:
    """Surfaces of a mesh file, with three-band materials, and notes on what the reader changed.

    ``lights`` and ``cameras`` are those of a glTF file.
    """

    surfaces: tuple[Surface, ...]
    notes: tuple[str, ...]
    lights: tuple[Light, ...] = ()
    cameras: Mapping[str, Camera] = field(default_factory=dict)


@dataclass
class _Part:
    """Faces that share a group and a material, before they are looked at."""

    group: str
    material: str
    vertices: FloatArray
    rings: IntArray
    sizes: IntArray
    normals: FloatArray | None


def _material(name: str, reflectance: Any = DEFAULT_REFLECTANCE, **given: Any) -> Material:
    """A three-band material; what is not given is absent."""
    values = {"emission": 0.0, "specular": 0.0, "transmittance": 0.0, **given}
    bands = {key: np.array(np.broadcast_to(values[key], 3), float) for key in ("emission", "specular", "transmittance")}
    return Material(
        name=name,
        reflectance=np.array(np.broadcast_to(reflectance, 3), dtype=float),
        exponent=float(values.get("exponent", np.inf)),
        ior=float(values.get("ior", 1.0)),
        two_sided=bool(values.get("two_sided", False)),
        **bands,
    )


_TEXTURE_USED = "textures count with their mean colour"
_TEXTURE_ABSENT = "textures that are missing or unreadable were left out"


def _mean_colour(image: Any, notes: Counter[str]) -> FloatArray | None:
    """Mean linear colour (3,) of a PIL image whose values are sRGB (IEC 61966-2-1)."""
    try:
        counts = np.asarray(image.convert("RGB").histogram(), dtype=float).reshape(3, 256)
    except Exception:  # pictures are decoded only here, and a broken one may fail in any way
        notes[_TEXTURE_ABSENT] += 1
        return None
    notes[_TEXTURE_USED] += 1
    level = np.arange(256) / 255.0
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    return counts @ linear / counts.sum(axis=1)


def _checked(material: Material, path: Path, notes: Counter[str]) -> Material:
    """The material with its values in range, or an error that names file and material."""
    where = f"material {material.name!r}"
    for name in ("reflectance", "specular", "transmittance", "emission"):
        values = getattr(material, name)
        top = np.inf if name == "emission" else 1.0
        if not (np.isfinite(values).all() and (values >= 0).all() and (values <= top).all()):
            wanted = "numbers of 0 or more" if name == "emission" else "numbers from 0 to 1"
            raise SceneError(f"{where}: found {name} {values.tolist()}, expected {wanted}; correct the file", path=path)
    reflectance = np.minimum(material.reflectance, LARGEST_REFLECTANCE)
    if (reflectance < material.reflectance).any():
        notes[f"reflectances above {LARGEST_REFLECTANCE} were read as {LARGEST_REFLECTANCE}"] += 1
    transmittance = np.minimum(material.transmittance, 1.0 - reflectance)
    specular = np.minimum(material.specular, 1.0 - reflectance - transmittance)
    return replace(material, reflectance=reflectance, specular=np.maximum(specular, 0.0), transmittance=transmittance)


# ---------------------------------------------------------------------------------------------
# OBJ


def _decoded(data: bytes) -> str:
    """Text of an OBJ or MTL file."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")  # names and comments of old exporters; numbers are the same


def _statements(text: str) -> Iterator[tuple[int, str, str]]:
    """Line number, keyword and the rest of each statement; a backslash at the end joins the next line."""
    joined, start = "", 0
    for number, line in enumerate([*text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), ""], start=1):
        start = start or number
        if line.endswith("\\"):
            joined += line[:-1] + " "
            continue
        key, _, rest = (joined + line).strip().replace("\t", " ").partition(" ")
        if key and not key.startswith("#"):
            yield start, key, rest.strip()
        joined, start = "", 0


def _numbers_of(rest: str) -> list[str]:
    """The words of a statement without its comment.  Names keep theirs: "Material #25" is one."""
    return rest.split("#", 1)[0].split()


def _named(name: str, materials: dict[str, Material]) -> str:
    """The material that a ``usemtl`` means, which may have a comment behind it."""
    return name if name in materials else name.split(" #", 1)[0].strip()


def _beside(path: Path, name: str) -> Path | None:
    """The file that another names: as it stands, with Windows' separators, or by its last part alone."""
    for candidate in (name, name.replace("\\", "/"), PureWindowsPath(name).name):
        try:
            if (path.parent / candidate).is_file():
                return path.parent / candidate
        except (OSError, ValueError):  # too long, or a NUL
            continue
    return None


def _read_obj(path: Path) -> tuple[list[_Part], dict[str, Material], Counter[str]]:
    """Statements ``v``, ``vn``, ``f``, ``g``, ``o``, ``usemtl`` and ``mtllib``; others are passed over."""
    data = _bytes_of(path)
    if path.suffix.lower() == ".gz":
        try:
            data = gzip.decompress(data)
        except (OSError, EOFError, zlib.error) as error:
            raise SceneError(f"found no gzip data ({error}), expected a compressed OBJ file", path=path) from None
    if b"\0" in data:
        raise SceneError("found binary data, expected the text of an OBJ file; check the file", path=path)

    points: list[list[float]] = []
    normals: list[list[float]] = []
    faces: dict[tuple[str, str], list[tuple[list[int], list[int]]]] = {}
    libraries: list[str] = []
    group = object_name = material = ""
    for number, key, rest in _statements(_decoded(data)):
        try:
            if key in ("v", "vn"):
                words = _numbers_of(rest)
                values = [float(word) for word in words[:3]]
                if len(values) < 3 or not all(abs(value) < 1e60 for value in values):
                    raise ValueError(f"{key} {' '.join(words)[:60]!r}, expected three finite numbers")
                (points if key == "v" else normals).append(values)
            elif key == "f":
                corners, shading = _obj_face(_numbers_of(rest), len(points), len(normals))
                faces.setdefault((group or object_name, material), []).append((corners, shading))
            elif key == "g":
                group = rest
            elif key == "o":
                object_name, group = rest, ""
            elif key == "usemtl":
                material = rest
            elif key == "mtllib":
                libraries.append(rest)
        except ValueError as error:
            raise SceneError(f"found {error}; correct the line", path=path, line=number) from None
    if not faces:
        raise SceneError("found no face, expected `v` and `f` statements of an OBJ file", path=path)

    notes: Counter[str] = Counter()
    materials: dict[str, Material] = {}
    for library in libraries:
        materials |= _read_mtl(path, library, notes)

    position = np.asarray(points, dtype=np.float64)
    shading_normals = np.asarray(normals, dtype=np.float64).reshape(-1, 3)
    parts = []
    for (name, material), members in faces.items():
        corner = np.asarray([index for corners, _ in members for index in corners], dtype=np.int64)
        normal = np.asarray([index for _, indices in members for index in indices], dtype=np.int64)
        sizes = np.asarray([len(corners) for corners, _ in members], dtype=np.int64)
        if (normal >= 0).all():
            pairs, rings = np.unique(np.column_stack([corner, normal]), axis=0, return_inverse=True)
            part_normals = shading_normals[pairs[:, 1]]
            used = pairs[:, 0]
        else:
            used, rings = np.unique(corner, return_inverse=True)
            part_normals = None
        parts.append(_Part(name, _named(material, materials), position[used], rings.ravel(), sizes, part_normals))
    return parts, materials, notes


def _obj_face(words: list[str], point_count: int, normal_count: int) -> tuple[list[int], list[int]]:
    """Vertex and normal indices from 0; -1 where a corner has no normal."""
    corners, shading = [], []
    for word in words:
        fields = word.split("/")
        try:
            corner = int(fields[0])
            normal = int(fields[2]) if len(fields) > 2 and fields[2] else 0
        except ValueError:
            raise ValueError(f"the corner {word[:40]!r}, expected v, v/vt, v//vn or v/vt/vn") from None
        corner = corner - 1 if corner > 0 else point_count + corner if corner < 0 else -1
        normal = normal - 1 if normal > 0 else normal_count + normal if normal < 0 else -1
        if not 0 <= corner < point_count or normal >= normal_count or normal < -1:
            raise ValueError(
                f"the corner {word[:40]!r}, expected indices of the {point_count} vertices and {normal_count} normals "
                "above it"
            )
        corners.append(corner)
        shading.append(normal)
    if len(corners) < 3:
        raise ValueError(f"a face of {len(corners)} corners, expected 3 or more")
    return corners, shading


def _read_mtl(path: Path, name: str, notes: Counter[str]) -> dict[str, Material]:
    """Materials of one ``mtllib``; a missing file is a note, as the geometry is whole without it."""
    whole = _beside(path, name)
    files = [whole] if whole is not None else [_beside(path, word) for word in name.split()]
    if not files or None in files:
        notes[f"the material file {name!r} is missing: surfaces are grey, reflectance {DEFAULT_REFLECTANCE}"] += 1
    records: dict[str, dict[str, str]] = {}
    for file in files:
        if file is None:
            continue
        try:
            text = _decoded(file.read_bytes())
        except OSError as error:
            raise SceneError(f"material file {name!r}: cannot be read ({error.strerror})", path=path) from None
        record: dict[str, str] = {}
        for _, key, rest in _statements(text):
            if key.lower() == "newmtl":
                record = records[rest] = {}
            else:
                record[key.lower()] = rest
    return {key: _checked(_mtl_material(key, record, path, notes), path, notes) for key, record in records.items()}


def _picture(path: Path, statement: str, notes: Counter[str]) -> FloatArray | None:
    """Mean linear colour (3,) of the texture that a ``map_`` statement names behind its options."""
    from PIL import Image

    words = statement.split()
    file = _beside(path, statement)
    while file is None and statement.startswith("-") and len(words) > 1:
        # Options such as `-s 1 1 1 -clamp on` stand before the name, which may have spaces.
        words = words[1:]
        file = _beside(path, " ".join(words))
    try:
        image = Image.open(file) if file is not None else None
    except Exception:  # a decoder of foreign bytes may fail in any way
        image = None
    if image is None:
        notes[_TEXTURE_ABSENT] += 1
        return None
    return _mean_colour(image, notes)


def _mtl_material(name: str, record: dict[str, str], path: Path, notes: Counter[str]) -> Material:
    """The workbench's material for the statements of one ``newmtl``, by their keywords in small letters."""

    def numbers(key: str, default: float) -> FloatArray:
        words = _numbers_of(record[key]) if key in record else [str(default)]
        try:
            values = np.array([float(word) for word in words if word != "-halo"])
            if len(values) not in (1, 3) or not np.isfinite(values).all():
                raise ValueError
            return np.array(np.broadcast_to(values, 3))
        except ValueError:
            raise SceneError(
                f"material {name!r}: found {key} {' '.join(words)[:60]!r}, expected one or three finite numbers; "
                "correct the file",
                path=path,
            ) from None

    reflectance = numbers("kd", DEFAULT_REFLECTANCE)
    colour = _picture(path, record["map_kd"], notes) if "map_kd" in record else None
    if colour is not None:
        # Exporters write Kd 0 or none beside a texture that carries the whole colour.
        reflectance = reflectance * colour if "kd" in record and reflectance.any() else colour
    emission = numbers("ke", 0.0)
    glow = _picture(path, record["map_ke"], notes) if "map_ke" in record else None
    if glow is not None:
        emission = emission * glow if emission.any() else glow
    illumination = int(numbers("illum", 2.0)[0])
    opaque = float(numbers("d", 1.0)[0] if "d" in record else 1.0 - numbers("tr", 0.0)[0])
    glass = illumination in (4, 6, 7, 9) and "tf" in record
    return _material(
        name,
        reflectance * (1.0 if glass else opaque),
        emission=emission,
        specular=numbers("ks", 0.0) if illumination >= 2 else 0.0,
        exponent=np.inf if illumination >= 3 else max(numbers("ns", 0.0)[0], 0.0),
        transmittance=numbers("tf", 0.0) if glass else 1.0 - opaque,
        ior=max(float(numbers("ni", 1.0)[0]), 1e-3),
    )


# ---------------------------------------------------------------------------------------------
# Everything else


def _read_ply(path: Path) -> list[_Part]:
    """The one part of a PLY file."""
    vertices, rings, normals = read_ply(path, _bytes_of(path))
    if not rings:
        raise SceneError("found no face, expected a PLY file with faces", path=path)
    corners = np.concatenate(rings)
    if not np.isfinite(vertices[corners]).all():
        raise SceneError("found coordinates that are not finite; export it anew", path=path)
    if normals is None:
        corners, vertices = _joined(corners, vertices)
    return [_Part("", "", vertices, corners, np.asarray([len(ring) for ring in rings]), normals)]


def _joined(corners: IntArray, vertices: FloatArray) -> tuple[IntArray, FloatArray]:
    """Corners and vertices without repetition: STL and many PLY files repeat a vertex for each face."""
    vertices, index = np.unique(vertices, axis=0, return_inverse=True)
    return index.ravel()[corners], vertices


def _read_by_trimesh(path: Path) -> tuple[list[_Part], dict[str, Material], Counter[str], MeshSurfaces]:
    """Mesh nodes of an STL, GLB or glTF file; lights and cameras of the latter in a record without surfaces."""
    import trimesh

    data = _bytes_of(path)
    kind = path.suffix.lower().lstrip(".")
    extra = MeshSurfaces((), ())
    try:
        if kind != "stl":
            description = described(data)
            extra = MeshSurfaces((), (), *lights_and_cameras(description))
            data = strengthened(data, description)
            resolver = trimesh.resolvers.FilePathResolver(str(path))
            loaded = trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=resolver, process=False)
        else:
            loaded = trimesh.load_scene(str(path), file_type=kind, process=False)
        nodes = [(node, *loaded.graph[node]) for node in loaded.graph.nodes_geometry]
    except Exception as error:  # a parser of foreign bytes may fail in any way
        raise SceneError(
            f"cannot be read as {kind.upper()} ({_brief(error)}); check the file or export it anew", path=path
        ) from None
    notes: Counter[str] = Counter()
    materials: dict[str, Material] = {}
    keys: dict[int, str] = {}
    parts = []
    for node, matrix, geometry_name in nodes:
        mesh = loaded.geometry[geometry_name]
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            continue  # point clouds and paths have no surface
        vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
        if not (np.isfinite(vertices).all() and faces.min() >= 0 and faces.max() < len(vertices)):
            raise SceneError(
                f"mesh {node!r}: found coordinates that are not finite or indices out of range; export it anew",
                path=path,
            )
        # trimesh tells only here whether normals came with the file; asking for them computes some.
        normals = np.asarray(mesh.vertex_normals) if "vertex_normals" in mesh._cache.cache else None
        if normals is None:
            faces, vertices = _joined(faces, vertices)
        linear = np.asarray(matrix, dtype=np.float64)[:3, :3]
        vertices = vertices @ linear.T + matrix[:3, 3]
        if np.linalg.det(linear) < 0:
            faces = faces[:, ::-1]
        if normals is not None and abs(np.linalg.det(linear)) > 0:
            normals = normals @ np.linalg.inv(linear)
        material = getattr(mesh.visual, "material", None)
        key = ""
        if isinstance(material, trimesh.visual.material.PBRMaterial):
            key = keys.get(id(material), "")
            if not key:
                key = _unique(str(material.name or "material"), materials)
                keys[id(material)] = key
                materials[key] = _checked(_pbr_material(key, material, notes), path, notes)
        parts.append(_Part(str(node), key, vertices, faces.ravel(), np.full(len(faces), 3), normals))
    if not parts:
        raise SceneError(
            f"found no triangle, expected a whole {kind.upper()} file with faces; is it cut short?", path=path
        )
    return parts, materials, notes, extra


def _pbr_material(name: str, material: Any, notes: Counter[str]) -> Material:
    """The workbench's material for one of glTF."""
    factor = material.baseColorFactor
    # trimesh keeps factors as bytes: 0.8 comes back as 204.
    base = np.ones(4) if factor is None else np.asarray(factor, dtype=np.float64) / 255.0
    reflectance = base[:3]
    emission = np.zeros(3) if material.emissiveFactor is None else np.asarray(material.emissiveFactor, dtype=np.float64)
    if material.baseColorTexture is not None:
        colour = _mean_colour(material.baseColorTexture, notes)
        reflectance = reflectance if colour is None else reflectance * colour
    if material.emissiveTexture is not None:
        colour = _mean_colour(material.emissiveTexture, notes)
        emission = emission if colour is None else emission * colour
    opaque = base[3] if material.alphaMode == "BLEND" else 1.0
    return _material(
        name,
        reflectance * opaque,
        emission=emission,
        transmittance=1.0 - opaque,
        two_sided=bool(material.doubleSided),
    )


# ---------------------------------------------------------------------------------------------
# Faces


def _bytes_of(path: Path) -> bytes:
    """The file's bytes; missing, a folder, empty or forbidden is an error in one line."""
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SceneError(f"cannot be read ({reason}); check the name and the permissions", path=path) from None
    if not data:
        raise SceneError("found an empty file, expected a mesh", path=path)
    return data


def _brief(error: BaseException) -> str:
    """The first line of a foreign error, short enough for one line."""
    text = next(iter(str(error).splitlines()), "") or type(error).__name__
    return text if len(text) <= 100 else text[:97] + "..."


def _unique(name: str, taken: Any) -> str:
    """The name, with a number behind it if it is taken."""
    number, candidate = 1, name
    while candidate in taken:
        number += 1
        candidate = f"{name}.{number}"
    return candidate


def _clean(part: _Part, path: Path, notes: Counter[str], seen: set[bytes]) -> _Part | None:
    """Faces with area, planar ones whole, others as triangles; ``None`` if nothing is left.

    ``seen`` are the faces of the parts before it, which are not repeated.
    """
    starts = np.cumsum(part.sizes) - part.sizes
    kept: list[tuple[int, IntArray]] = []
    for size in np.unique(part.sizes):
        faces = np.flatnonzero(part.sizes == size)
        rings = part.rings[starts[faces][:, None] + np.arange(size)]
        points = part.vertices[rings]
        moved = points - points[:, :1]
        vector = 0.5 * np.cross(moved, np.roll(moved, -1, axis=1)).sum(axis=1)
        area = np.linalg.norm(vector, axis=1)
        extent = np.ptp(points, axis=1).max(axis=1)
        sound = area > _ZERO_AREA * extent**2
        if not sound.all():
            notes["faces without area were dropped"] += int((~sound).sum())
        normal = vector / np.where(sound, area, 1.0)[:, None]
        planar = np.abs(np.einsum("fci,fi->fc", moved, normal)).max(axis=1) <= PLANARITY * extent
        edge = np.roll(points, -1, axis=1) - points
        turn = np.einsum("fci,fi->fc", np.cross(edge, np.roll(edge, -1, axis=1)), normal)
        # Up to four left turns make a convex face; five may make a pentagram.
        simple = (turn >= 0).all(axis=1) if size <= 4 else np.zeros(len(faces), dtype=bool)
        for k in np.flatnonzero(sound):
            if not simple[k] and rings_cross([points[k]], normal[k]):
                raise SceneError(
                    f"surface {part.group or part.material!r}, face {faces[k]}: found edges that cross, "
                    "expected a simple polygon; correct the file",
                    path=path,
                )
            if planar[k]:
                kept.append((int(faces[k]), rings[k]))
            else:
                notes["faces that are not planar were cut into triangles"] += 1
                kept.extend((int(faces[k]), rings[k][corner]) for corner in triangulate_ring(points[k], normal[k]))
    kept.sort(key=lambda item: item[0])
    _, weld = np.unique(part.vertices, axis=0, return_inverse=True)
    weld = weld.ravel()
    places = part.vertices + 0.0  # one zero: -0.0 has other bytes
    rings = []
    for _, ring in kept:
        # Rings that start elsewhere are the same; the order along each axis is that of the welded numbers.
        same = places[np.roll(ring, -int(weld[ring].argmin()))].tobytes()
        if same in seen:
            # Two equal faces would send and receive everything twice.
            notes["faces that repeat another were dropped"] += 1
        else:
            seen.add(same)
            rings.append(ring)
    if not rings:
        return None
    return replace(part, rings=np.concatenate(rings), sizes=np.asarray([len(ring) for ring in rings], dtype=np.int64))


def _agree(part: _Part, name: str, notes: Counter[str]) -> tuple[_Part, bool]:
    """The part with the winding of closed bodies in agreement; and whether no contradiction is left."""
    _, corner = np.unique(part.vertices, axis=0, return_inverse=True)
    corner = corner.ravel()[part.rings]
    ends = np.cumsum(part.sizes)
    starts = ends - part.sizes
    following = np.arange(len(corner)) + 1
    following[ends - 1] = starts
    faces = len(part.sizes)
    face = np.repeat(np.arange(faces), part.sizes)
    edge = np.column_stack([corner, corner[following]])
    low, high = edge.min(axis=1), edge.max(axis=1)
    _, key, count = np.unique(low * (corner.max() + 1) + high, return_inverse=True, return_counts=True)
    shared = np.flatnonzero(count[key] == 2)
    pairs = shared[np.argsort(key[shared], kind="stable")].reshape(-1, 2)
    first, second = face[pairs].T
    against = edge[pairs[:, 0], 0] == edge[pairs[:, 1], 0]  # both run the same way
    if not against.any():
        return part, True
    # Two copies of each face, as it is and turned: an edge joins the copies that agree, so that
    # each connected body falls into two mirror images, or into one if it has no two sides.
    rows = np.concatenate([first, first + faces])
    columns = np.concatenate([second + faces * against, second + faces * ~against])
    joined = sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(2 * faces, 2 * faces))
    label = sparse.csgraph.connected_components(joined, directed=False)[1]
    as_is, turned = label[:faces], label[faces:]
    is_open = np.zeros(label.max() + 1, dtype=bool)
    open_faces = face[count[key] != 2]
    is_open[as_is[open_faces]] = is_open[turned[open_faces]] = True
    closed = ~is_open[as_is] & (as_is != turned)
    points = part.vertices[part.rings]
    from_first = points - points[starts][face]
    area = np.zeros((faces, 3))
    np.add.at(area, face, 0.5 * np.cross(from_first, from_first[following]))
    weight = np.bincount(as_is, np.linalg.norm(area, axis=1), minlength=label.max() + 1)
    flip = (weight[as_is] < weight[turned]) | ((weight[as_is] == weight[turned]) & (as_is > turned))
    flip &= closed
    if flip.any():
        notes[f"faces of {name!r} were turned to agree with their neighbours"] += int(flip.sum())
    mirror = np.repeat(starts + ends - 1, part.sizes) - np.arange(len(part.rings))
    rings = np.where(flip[face], part.rings[mirror], part.rings)
    return replace(part, rings=rings), bool(closed[first[against]].all())


def _names(parts: Sequence[_Part], default: str) -> list[str]:
    """A name a part: the material's if no other part has it, else the group's, else both."""
    groups = Counter(part.group for part in parts)
    materials = Counter(part.material for part in parts)
    names: list[str] = []
    for part in parts:
        if part.material and materials[part.material] == 1:
            name = part.material
        elif part.group and groups[part.group] == 1:
            name = part.group
        else:
            name = "/".join(word for word in (part.group, part.material) if word) or default
        names.append(_unique(name, names))
    return names


def read_mesh(path: str | Path) -> MeshSurfaces:
    """Surfaces of a mesh file, as the module's text says.

    Raises
    ------
    SceneError
        If the file cannot be read, has no face with area, or holds a value out of range.
    """
    path = Path(path)
    if not path.name.lower().endswith(MESH_SUFFIXES):
        raise SceneError(f"found an unknown kind of mesh, expected one of {', '.join(MESH_SUFFIXES)}", path=path)
    is_obj = path.name.lower().endswith((".obj", ".obj.gz"))
    materials: dict[str, Material] = {}
    notes: Counter[str] = Counter()
    extra = MeshSurfaces((), ())
    if is_obj:
        parts, materials, notes = _read_obj(path)
    elif path.suffix.lower() == ".ply":
        parts = _read_ply(path)
    else:
        parts, materials, notes, extra = _read_by_trimesh(path)
    surfaces = []
    seen: set[bytes] = set()
    stem = path.name.split(".", 1)[0] or "mesh"
    for part, name in zip(parts, _names(parts, stem), strict=True):
        if not (np.abs(part.vertices) < 1e60).all():
            raise SceneError(f"surface {name!r}: found coordinates beyond 1e60; rescale the file", path=path)
        clean = _clean(part, path, notes, seen)
        if clean is None:
            continue
        material = materials.get(part.material) or _material(part.material or "default")
        if part.material and material.name not in materials and not any("is missing" in note for note in notes):
            notes[f"materials that no file defines are grey, reflectance {DEFAULT_REFLECTANCE}"] += 1
        agreed, consistent = _agree(clean, name, notes)
        if not consistent and not material.two_sided:
            material = replace(material, two_sided=True)
            notes["surfaces whose neighbouring faces contradict each other were made two-sided"] += 1
        used, rings = np.unique(agreed.rings, return_inverse=True)
        normals = None
        if agreed.normals is not None:
            length = np.linalg.norm(agreed.normals[used], axis=1)
            if np.isfinite(length).all() and (length > 0).all():
                normals = agreed.normals[used] / length[:, None]
        surfaces.append(
            Surface(
                name=name,
                material=material,
                vertices=np.ascontiguousarray(agreed.vertices[used]),
                ring_vertices=rings.ravel().astype(np.int64),
                ring_offsets=np.concatenate([[0], np.cumsum(agreed.sizes)]).astype(np.int64),
                face_rings=np.arange(len(agreed.sizes) + 1, dtype=np.int64),
                vertex_normals=normals,
            )
        )
    if not surfaces:
        raise SceneError("found no face with an area, expected a mesh", path=path)
    told = tuple(f"{text} ({count})" for text, count in notes.items())
    return replace(extra, surfaces=tuple(surfaces), notes=told)


# ---------------------------------------------------------------------------------------------
# A mesh file as a scene


def load_scene(path: str | Path) -> Scene:
    """A mesh file as a scene of three bands, with the cameras of a glTF file; :func:`lit` if nothing in it emits.

    Raises
    ------
    SceneError
        As :func:`read_mesh`.
    """
    path = Path(path)
    mesh = read_mesh(path)
    scene = Scene(
        name=path.name.split(".", 1)[0] or path.name,
        surfaces=mesh.surfaces,
        lights=mesh.lights,
        camera=next(iter(mesh.cameras.values()), None),
        cameras=mesh.cameras,
        background=np.zeros(3),
        bands=3,
        path=path,
        notes=mesh.notes,
    )
    return scene if scene.has_emitter else lit(scene)


def lit(scene: Scene) -> Scene:
    """A scene that emits nothing, given light, and a note that says so.

    It gets a uniform sky of radiance 1/pi, under which an open horizontal surface has an irradiance of
    1 W/m2, and a sun of 1 W/m2 from above and one side, without which open shapes would look flat; or,
    where the fronts see no sky (a closed room), an isotropic point light in the roomiest place found, whose
    flux in W equals the area of the surfaces, so that their mean direct irradiance is 1 W/m2.
    """
    import trimesh

    geometry = Geometry.from_scene(scene)
    triangles, piece = geometry.triangles
    tracer = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), process=False).ray
    normals = geometry.piece_normal[piece]
    area = 0.5 * np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    two_sided = np.asarray([material.two_sided for material in geometry.surface_material])
    two_sided = two_sided[geometry.polygon_surface[geometry.piece_polygon[piece]]]

    rng = np.random.default_rng(0)
    count = 4096
    chosen = rng.choice(len(triangles), count, p=area / area.sum())
    a, b = rng.random((2, count, 1))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    corner = triangles[chosen]
    start = corner[:, 0] + a * (corner[:, 1] - corner[:, 0]) + b * (corner[:, 2] - corner[:, 0])
    up = normals[chosen] * np.where(two_sided[chosen] & (rng.random(count) < 0.5), -1.0, 1.0)[:, None]
    ball = rng.normal(size=(count, 3))
    direction = up + ball / np.linalg.norm(ball, axis=1)[:, None]  # cosine-distributed about the normal
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    start = start + 1e-5 * geometry.size * up
    met = tracer.intersects_first(start, direction)
    if (met < 0).mean() > 0.01:
        note = (
            "nothing in the file emits: it is lit by a uniform sky of radiance 1/pi W/(m2 sr), "
            "1 W/m2 on an open horizontal surface, and a sun of 1 W/m2"
        )
        # Above whichever of y and z the file calls up.
        sun = Light("sun", "directional", np.ones(3), direction=-np.array([0.4, 0.7, 0.6]) / np.sqrt(1.01))
        return replace(scene, background=np.full(3, 1 / np.pi), lights=(sun,), notes=(*scene.notes, note))

    # The middles of 64 chords are places inside; the roomiest has its nearest wall farthest off.
    def reach(origin: FloatArray, along: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        first = tracer.intersects_first(origin, along)
        hit = first >= 0
        slope = np.einsum("ij,ij->i", along, normals[first])
        gap = np.einsum("ij,ij->i", triangles[first, 0] - origin, normals[first])
        distance = np.where(hit & (slope != 0), gap / np.where(slope == 0, 1.0, slope), np.inf)
        return distance, hit & ((slope < 0) | two_sided[first])

    distance, _ = reach(start[:64], direction[:64])
    inside = np.isfinite(distance)
    middles = start[:64][inside] + 0.5 * distance[inside, None] * direction[:64][inside]
    ball = rng.normal(size=(256, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    distance, front = reach(np.repeat(middles, 256, axis=0), np.tile(ball, (len(middles), 1)))
    room = distance.reshape(-1, 256).min(axis=1) * front.reshape(-1, 256).mean(axis=1)
    place = middles[int(np.argmax(room))]
    flux = float(area.sum())
    light = Light("light of an unlit room", "point", np.full(3, flux / (4 * np.pi)), position=place)
    note = (
        f"nothing in the file emits and no sky enters: it is lit by a point light of {flux:.4g} W "
        f"at ({', '.join(f'{value:.4g}' for value in place)})"
    )
    return replace(scene, lights=(light,), notes=(*scene.notes, note))
