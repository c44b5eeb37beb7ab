"""The native scene format: TOML, schema 1.

Keys at the top::

    schema = 1                      # required
    name, description               # text; the name is the file's stem unless given
    bands                           # number of bands; else that of the longest list, 3 where a mesh
                                    # brings its own materials, or 1
    closed = true                   # the author's word that no light can leave
    background                      # radiance where no surface is [W/(m2 sr)]

    [camera]                        # eye, look_at; up = [0, 0, 1], fov = 45 (vertical, degrees),
                                    # width = 512, height = 512
    [sky]                           # type = "uniform", "overcast" (the CIE traditional overcast sky) or
                                    # "cie-1" to "cie-15" (CIE S 011); zenith_radiance [W/(m2 sr)] or
                                    # horizontal_irradiance [W/m2] (of the sky, without the sun's beam);
                                    # ground_reflectance = 0, up = [0, 0, 1], sun_direction (to the sun)
    [cameras.NAME]                  # further ones, with the same keys; the first of them is used where
                                    # there is no [camera]
    [materials.NAME]                # reflectance, emission [W/m2, radiant exitance], specular,
                                    # exponent = inf, transmittance, ior = 1, two_sided = false
    [[surface]]                     # name, material, one shape, transform
    [[light]]                       # name, type and what belongs to it

A value of bands is one number for all bands or a list with one for each.  A shape is exactly one of::

    polygon = [[x, y, z], ...]      # counter-clockwise from the front; concave is fine
    holes = [[[x, y, z], ...], ...] # cut from `polygon`; may run either way
    polygons = [[[x, y, z], ...], ...]
    box = {min, max, inward = false, omit = ["-z", ...]}
    sphere = {center, radius, facet_error = 0.02 (share of the radius), inward = false}
    spline = {degree = [p, q], points = [[[x, y, z] or [x, y, z, weight], ...], ...],
              knots = [[...], [...]] (clamped and uniform unless given), segments = [16, 16],
              flip = false (the front is the side of du x dv)}
    torus_knot = {p = 2, q = 3, radius = 1, tube = 0.2, segments = 480, sides = 24}
    mesh = "file"                   # beside the scene file; its own materials unless `material`; of a
                                    # Radiance file (.rad) the surfaces, not its distant sources

``transform`` is a list of steps, applied in the order in which they are listed: ``{translate = [x, y, z]}``,
``{rotate = {axis = [x, y, z], degrees = a}}`` (counter-clockwise seen from the axis' end, about
the origin), ``{scale = s}`` or ``{scale = [sx, sy, sz]}``.  A scale that is not the same in all axes
leaves a sphere without its exact record.

Lights: ``point`` (position, intensity [W/sr]), ``spot`` (position, direction, intensity along the
axis [W/sr], cone_deg = 90, exponent = 0), ``directional`` (direction of travel, irradiance on a
surface that faces it [W/m2]), ``linear`` (position, end, intensity per length across the line
[W/(sr m)], lambertian = false), ``area`` (polygon, and radiance [W/(m2 sr)] or exitance [W/m2]); an
area light becomes a black surface that emits.

Every fault ends as a :class:`~workbench.errors.SceneError` of one line: file, key, what was found,
what was wanted.
"""

from __future__ import annotations

import difflib
import itertools
import math
import re
import reprlib
import tomllib
import types
import typing
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StrictBool,
    StrictInt,
    StrictStr,
    ValidationError,
)

from workbench.errors import InputError, SceneError
from workbench.geometry.polygons import vector_area
from workbench.scene._tokens import LARGEST, LARGEST_SIDE, read_text
from workbench.scene.library import box_surface, polygon_fault, sphere_surface, torus_knot_mesh, transformed
from workbench.scene.model import SKY_KINDS, Camera, Light, Material, Scene, Sky, Surface

if TYPE_CHECKING:
    from workbench.scene.mesh import MeshSurfaces

__all__ = ["load_scene", "read_toml"]

FloatArray = NDArray[np.float64]
Key = tuple[str | int, ...]

# ---------------------------------------------------------------------------------------------
# Values


def _show(value: Any) -> str:
    """A value as it may stand in a one-line message: printable, and not endless."""
    text = reprlib.repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"found {_show(value)}, expected a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not abs(number) <= LARGEST:
        raise ValueError(f"found {_show(value)}, expected a finite number")
    return number


def _exponent(value: Any) -> float:
    return math.inf if value == math.inf else _number(value)


def _above_zero(value: float) -> float:
    if not value > 0:
        raise ValueError(f"found {value:g}, expected a number greater than 0")
    return value


def _printable(value: str) -> str:
    if not value.isprintable():
        raise ValueError(f"found {_show(value)}, expected printable text on one line")
    return value


def _numbers(value: Any, count: tuple[int, ...], wanted: str) -> FloatArray:
    if not isinstance(value, list) or len(value) not in count:
        raise ValueError(f"found {_show(value)}, expected {wanted}")
    return np.asarray([_number(item) for item in value])


def _vector(value: Any) -> FloatArray:
    return _numbers(value, (3,), "three numbers")


def _direction(value: Any) -> FloatArray:
    vector = _vector(value)
    length = float(np.linalg.norm(vector))
    if not length > 0:
        raise ValueError("found a vector of length zero, expected a direction")
    return vector / length


def _list(value: Any, least: int, wanted: str) -> list[Any]:
    if not isinstance(value, list) or len(value) < least:
        raise ValueError(f"found {_show(value)}, expected {wanted}")
    return value


def _each(items: list[Any], convert: Callable[[Any], Any], what: str) -> list[Any]:
    """Convert the items of a list; a fault says at which it lies."""
    found = []
    for index, item in enumerate(items):
        try:
            found.append(convert(item))
        except ValueError as error:
            raise ValueError(f"{what} {index}: {error}") from None
    return found


def _ring(value: Any) -> FloatArray:
    items = _list(value, 3, "a list of 3 or more points [x, y, z]")
    return np.asarray(_each(items, _vector, "point"))


def _rings(value: Any) -> list[FloatArray]:
    return _each(_list(value, 1, "a list of polygons"), _ring, "polygon")


def _bands(value: Any) -> FloatArray:
    if isinstance(value, list) and value:
        array = np.asarray([_number(item) for item in value])
    elif isinstance(value, list):
        raise ValueError("found an empty list, expected a number or one for each band")
    else:
        array = np.asarray([_number(value)])
    if (array < 0).any():
        raise ValueError(f"found {_show(value)}, expected 0 or more")
    return array


def _share(value: Any) -> FloatArray:
    array = _bands(value)
    if (array > 1).any():
        raise ValueError(f"found {_show(value)}, expected 0..1")
    return array


def _control(value: Any) -> FloatArray:
    """Control points (n, m, 4) with their weights, all rows of equal length."""
    rows = _each(
        _list(value, 2, "two or more rows of control points"),
        lambda row: _each(
            _list(row, 2, "a row of two or more control points"),
            lambda point: np.append(_numbers(point, (3, 4), "[x, y, z] or [x, y, z, weight]"), 1.0)[:4],
            "point",
        ),
        "row",
    )
    if len({len(row) for row in rows}) != 1:
        raise ValueError(f"found rows of {sorted({len(row) for row in rows})} points, expected rows of equal length")
    return np.asarray(rows)


def _knots(value: Any) -> tuple[FloatArray, FloatArray]:
    pair = _list(value, 2, "two lists of knots")
    if len(pair) != 2:
        raise ValueError(f"found {len(pair)} lists, expected two lists of knots")
    u, v = _each(pair, lambda row: np.asarray([_number(item) for item in _list(row, 4, "4 or more knots")]), "list")
    return u, v


Number = Annotated[float, BeforeValidator(_number)]
Positive = Annotated[float, BeforeValidator(lambda value: _above_zero(_number(value)))]
Exponent = Annotated[float, BeforeValidator(_exponent), Field(ge=0)]
Vector = Annotated[Any, BeforeValidator(_vector)]
Direction = Annotated[Any, BeforeValidator(_direction)]
Bands = Annotated[Any, BeforeValidator(_bands)]
Share = Annotated[Any, BeforeValidator(_share)]
Ring = Annotated[Any, BeforeValidator(_ring)]
Rings = Annotated[Any, BeforeValidator(_rings)]
Text = Annotated[StrictStr, Field(min_length=1, max_length=200), AfterValidator(_printable)]
Segments = Annotated[StrictInt, Field(ge=1, le=4096)]


# ---------------------------------------------------------------------------------------------
# Tables


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)


class _CameraTable(_Table):
    eye: Vector
    look_at: Vector
    up: Direction = np.array([0.0, 0.0, 1.0])
    fov: Annotated[Number, Field(gt=0, lt=180)] = 45.0
    width: Annotated[StrictInt, Field(ge=1, le=LARGEST_SIDE)] = 512
    height: Annotated[StrictInt, Field(ge=1, le=LARGEST_SIDE)] = 512


def _sky_kind(value: Any) -> str:
    if isinstance(value, str) and value in SKY_KINDS:
        return value
    close = difflib.get_close_matches(str(value), SKY_KINDS, n=1, cutoff=0.5)
    wanted = f"did you mean {close[0]!r}?" if close else "expected uniform, overcast, or cie-1 to cie-15"
    raise ValueError(f"found {_show(value)}; {wanted}")


class _SkyTable(_Table):
    type: Annotated[Any, BeforeValidator(_sky_kind)]
    zenith_radiance: Bands = None
    horizontal_irradiance: Bands = None
    ground_reflectance: Share = np.zeros(1)
    up: Direction = np.array([0.0, 0.0, 1.0])
    sun_direction: Direction = None


class _MaterialTable(_Table):
    reflectance: Share = np.zeros(1)
    emission: Bands = np.zeros(1)
    specular: Share = np.zeros(1)
    exponent: Exponent = math.inf
    transmittance: Share = np.zeros(1)
    ior: Positive = 1.0
    two_sided: StrictBool = False


class _Box(_Table):
    min: Vector
    max: Vector
    inward: StrictBool = False
    omit: list[Literal["-x", "+x", "-y", "+y", "-z", "+z"]] = []


class _Sphere(_Table):
    center: Vector
    radius: Positive
    facet_error: Annotated[Number, Field(ge=1e-4, lt=1)] = 0.02
    inward: StrictBool = False


class _Spline(_Table):
    degree: Annotated[list[Annotated[StrictInt, Field(ge=1, le=20)]], Field(min_length=2, max_length=2)]
    points: Annotated[Any, BeforeValidator(_control)]
    knots: Annotated[Any, BeforeValidator(_knots)] = None
    segments: Annotated[list[Segments], Field(min_length=2, max_length=2)] = [16, 16]
    flip: StrictBool = False


class _TorusKnot(_Table):
    p: Annotated[StrictInt, Field(ge=1, le=100)] = 2
    q: Annotated[StrictInt, Field(ge=1, le=100)] = 3
    radius: Positive = 1.0
    tube: Positive = 0.2
    segments: Segments = 480
    sides: Segments = 24


class _Rotation(_Table):
    axis: Direction
    degrees: Number


class _Step(_Table):
    translate: Vector = None
    rotate: _Rotation | None = None
    scale: Annotated[Any, BeforeValidator(lambda v: _vector(v) if isinstance(v, list) else _number(v))] = None


class _SurfaceTable(_Table):
    name: Text
    material: Text | None = None
    polygon: Ring = None
    holes: Rings = None
    polygons: Rings = None
    mesh: Text | None = None
    box: _Box | None = None
    sphere: _Sphere | None = None
    spline: _Spline | None = None
    torus_knot: _TorusKnot | None = None
    transform: list[_Step] = []


class _Point(_Table):
    name: Text
    type: Literal["point"]
    position: Vector
    intensity: Bands


class _Spot(_Table):
    name: Text
    type: Literal["spot"]
    position: Vector
    direction: Direction
    intensity: Bands
    cone_deg: Annotated[Number, Field(gt=0, le=90)] = 90.0
    exponent: Annotated[Number, Field(ge=0)] = 0.0


class _Directional(_Table):
    name: Text
    type: Literal["directional"]
    direction: Direction
    irradiance: Bands


class _Linear(_Table):
    name: Text
    type: Literal["linear"]
    position: Vector
    end: Vector
    intensity: Bands
    lambertian: StrictBool = False


class _Area(_Table):
    name: Text
    type: Literal["area"]
    polygon: Ring
    radiance: Bands = None
    exitance: Bands = None


_LIGHTS: dict[str, type[_Table]] = {
    "area": _Area,
    "directional": _Directional,
    "linear": _Linear,
    "point": _Point,
    "spot": _Spot,
}
_SHAPES = ("polygon", "polygons", "mesh", "box", "sphere", "spline", "torus_knot")


class _File(_Table):
    schema_: Literal[1] = Field(alias="schema")
    name: Text | None = None
    description: StrictStr = ""
    bands: Annotated[StrictInt, Field(ge=1, le=10_000)] | None = None
    closed: StrictBool = False
    background: Bands = np.zeros(1)
    camera: _CameraTable | None = None
    sky: _SkyTable | None = None
    cameras: dict[str, _CameraTable] = {}
    materials: dict[str, _MaterialTable] = {}
    surface: list[_SurfaceTable] = []
    light: list[dict[str, Any]] = []


# ---------------------------------------------------------------------------------------------
# Faults


def _key(parts: Key) -> str:
    """``("surface", 3, "polygon")`` as ``surface[3].polygon``."""
    text = ""
    for part in parts:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            word = part if re.fullmatch(r"[A-Za-z0-9_-]+", part) else _show(part)
            text += f".{word}" if text else word
    return text


def _tables_of(annotation: Any) -> Iterator[type[_Table]]:
    """Tables that an annotation such as ``list[_Step] | None`` speaks of."""
    is_class = isinstance(annotation, type) and not isinstance(annotation, types.GenericAlias)
    if is_class and issubclass(annotation, _Table):
        yield annotation
    for inner in typing.get_args(annotation):
        yield from _tables_of(inner)


def _known_keys(table: type[_Table], parts: Key) -> list[str]:
    """Keys that may stand where ``parts``, a path inside ``table``, leads."""
    current: type[_Table] = table
    names = iter(parts)
    for name in names:
        field = current.model_fields.get(name) if isinstance(name, str) else None
        if field is None:
            continue
        current = next(_tables_of(field.annotation), current)
        if typing.get_origin(field.annotation) is dict:
            next(names, None)  # the name that the author gave
    return [field.alias or name for name, field in current.model_fields.items()]


def _fault(error: ValidationError, table: type[_Table], base: Key) -> tuple[Key, str]:
    """Key and one-line message of the first fault; unknown keys come first, as they explain missing ones."""
    found = min(error.errors(include_url=False), key=lambda item: item["type"] != "extra_forbidden")
    parts = tuple(part for part in found["loc"] if part != "[key]")
    kind, value, limits = found["type"], found.get("input"), found.get("ctx", {})
    if kind == "extra_forbidden":
        known = _known_keys(table, parts[:-1])
        close = difflib.get_close_matches(str(parts[-1]), known, n=1, cutoff=0.5)
        advice = f"did you mean {close[0]!r}?" if close else f"expected one of {', '.join(known)}"
        return (*base, *parts), f"found an unknown key; {advice}"
    if kind == "missing":
        return (*base, *parts), "found nothing, expected this key; add it"
    if kind == "value_error":
        return (*base, *parts), str(limits.get("error"))
    words = {
        "string_type": "text",
        "bool_type": "true or false",
        "int_type": "a whole number",
        "list_type": "a list",
        "dict_type": "a table",
        "model_type": "a table",
        "model_attributes_type": "a table",
        "string_too_short": "text that is not empty",
        "string_too_long": f"text of at most {limits.get('max_length')} characters",
        "too_short": f"{limits.get('min_length')} items",
        "too_long": f"{limits.get('max_length')} items",
        "literal_error": str(limits.get("expected")),
        "greater_than": f"more than {limits.get('gt')}",
        "greater_than_equal": f"{limits.get('ge')} or more",
        "less_than": f"less than {limits.get('lt')}",
        "less_than_equal": f"{limits.get('le')} or less",
    }
    wanted = words.get(kind, " ".join(str(found["msg"]).split()))
    return (*base, *parts), f"found {_show(value)}, expected {wanted}"


# ---------------------------------------------------------------------------------------------
# Building


class _Builder:
    """Makes the records of one file; keeps what every fault must name."""

    def __init__(self, path: Path, table: _File, lights: list[_Table]) -> None:
        self.path, self.table, self.lights = path, table, lights
        self.bands = self._count_bands()
        self.notes: list[str] = []
        self.names: dict[str, str] = {}
        self.materials = {name: self._material(name, material) for name, material in table.materials.items()}

    def fail(self, key: Key, message: str) -> typing.NoReturn:
        raise SceneError(message, path=self.path, key=_key(key))

    def _band_values(self) -> Iterator[tuple[Key, FloatArray]]:
        yield ("background",), self.table.background
        if self.table.sky is not None:
            for field in ("zenith_radiance", "horizontal_irradiance", "ground_reflectance"):
                if getattr(self.table.sky, field) is not None:
                    yield ("sky", field), getattr(self.table.sky, field)
        for name, material in self.table.materials.items():
            for field in ("reflectance", "emission", "specular", "transmittance"):
                yield ("materials", name, field), getattr(material, field)
        for index, light in enumerate(self.lights):
            for field in ("intensity", "irradiance", "radiance", "exitance"):
                if getattr(light, field, None) is not None:
                    yield ("light", index, field), getattr(light, field)

    def _count_bands(self) -> int:
        bands = self.table.bands
        if bands is None:
            own = any(surface.mesh is not None and surface.material is None for surface in self.table.surface)
            bands = max([3 if own else 1, *(values.size for _, values in self._band_values())])
        for key, values in self._band_values():
            if values.size not in (1, bands):
                self.fail(key, f"found {values.size} values, expected 1 or {bands}, the number of bands")
        return bands

    def spread(self, values: FloatArray) -> FloatArray:
        return np.ascontiguousarray(np.broadcast_to(values, (self.bands,)))

    def _material(self, name: str, table: _MaterialTable) -> Material:
        shares = [self.spread(values) for values in (table.reflectance, table.specular, table.transmittance)]
        total = float(np.sum(shares, axis=0).max())
        if total > 1 + 1e-9:
            self.fail(
                ("materials", name),
                f"found reflectance + specular + transmittance = {total:g}, expected at most 1 in each band",
            )
        return Material(
            name=name,
            reflectance=shares[0],
            emission=self.spread(table.emission),
            specular=shares[1],
            exponent=table.exponent,
            transmittance=shares[2],
            ior=table.ior,
            two_sided=table.two_sided,
        )

    def claim(self, name: str, key: Key) -> None:
        """Take a name of a surface or light; a second time is a fault."""
        if name in self.names:
            self.fail((*key, "name"), f"found {name!r} again (first at {self.names[name]}), expected a name used once")
        self.names[name] = _key(key)

    def material_of(self, name: str | None, key: Key) -> Material:
        if name is None:
            self.fail((*key, "material"), "found nothing, expected the name of a material; add it")
        if name not in self.materials:
            close = difflib.get_close_matches(name, self.materials, n=1)
            known = (
                f"did you mean {close[0]!r}?"
                if close
                else f"known are {', '.join(map(_show, list(self.materials)[:20])) or 'none'}"
            )
            self.fail((*key, "material"), f"found {name!r}, expected the name of a material; {known}")
        return self.materials[name]

    def polygon(self, name: str, material: Material, polygons: list[list[FloatArray]], keys: list[Key]) -> Surface:
        for rings, key in zip(polygons, keys, strict=True):
            outer = vector_area(rings[0])
            for index in range(1, len(rings)):
                if vector_area(rings[index]) @ outer > 0:
                    rings[index] = rings[index][::-1]
            fault = polygon_fault(rings)
            if fault is not None:
                self.fail(key, f"found {fault}; correct the points or cut the polygon in two")
        return Surface.from_polygons(name, material, polygons)

    def surfaces(self) -> Iterator[Surface]:
        for index, table in enumerate(self.table.surface):
            key: Key = ("surface", index)
            self.claim(table.name, key)
            given = [shape for shape in _SHAPES if getattr(table, shape) is not None]
            if len(given) != 1:
                found = " and ".join(given) or "no shape"
                self.fail(key, f"found {found}, expected exactly one of {', '.join(_SHAPES)}")
            shape = given[0]
            if table.holes is not None and shape != "polygon":
                self.fail((*key, "holes"), f"found holes beside {shape}, expected them beside polygon only")
            if table.mesh is not None:
                made = self._mesh(table, table.mesh, key)
            else:
                try:
                    made = [self._shape(table, self.material_of(table.material, key), key)]
                except SceneError:
                    raise
                except InputError as error:
                    self.fail((*key, shape), str(error).removeprefix(f"{shape}: "))
            matrix = self._matrix(table.transform, (*key, "transform"))
            for surface in made:
                if table.transform:
                    try:
                        surface = transformed(surface, matrix)
                    except (InputError, np.linalg.LinAlgError) as error:
                        self.fail((*key, "transform"), str(error).removeprefix("transform: "))
                if not (np.abs(surface.vertices) <= LARGEST).all():
                    self.fail(key, f"found coordinates beyond {LARGEST:g}, expected smaller ones; rescale the scene")
                yield surface

    def _shape(self, table: _SurfaceTable, material: Material, key: Key) -> Surface:
        if table.polygon is not None:
            return self.polygon(table.name, material, [[table.polygon, *(table.holes or [])]], [(*key, "polygon")])
        if table.polygons is not None:
            keys = [(*key, "polygons", index) for index in range(len(table.polygons))]
            return self.polygon(table.name, material, [[ring] for ring in table.polygons], keys)
        if table.box is not None:
            box = table.box
            return box_surface(table.name, material, box.min, box.max, inward=box.inward, omit=box.omit)
        if table.sphere is not None:
            ball = table.sphere
            return sphere_surface(
                table.name, material, ball.center, ball.radius, facet_error=ball.facet_error, inward=ball.inward
            )
        if table.torus_knot is not None:
            vertices, faces, normals, error = torus_knot_mesh(**table.torus_knot.model_dump())
            return Surface.from_mesh(table.name, material, vertices, faces, vertex_normals=normals, facet_error=error)
        return self._spline(table.name, material, table.spline)

    @staticmethod
    def _spline(name: str, material: Material, table: Any) -> Surface:
        # scipy.interpolate takes half a second to import; most scenes have no spline.
        from workbench.geometry.splines import RationalSurface, clamped_knots, facet_error, tessellate

        points, (p, q) = table.points, table.degree
        for degree, count, axis in ((p, points.shape[0], "u"), (q, points.shape[1], "v")):
            if count <= degree:
                raise InputError(f"found degree {degree} with {count} points in {axis}, expected {degree + 1} or more")
        knots = table.knots or (clamped_knots(points.shape[0], p), clamped_knots(points.shape[1], q))
        spline = RationalSurface((p, q), knots, points[..., :3], points[..., 3])
        vertices, faces, normals = tessellate(spline, *table.segments)
        return Surface.from_mesh(
            name,
            material,
            vertices,
            faces[:, ::-1] if table.flip else faces,
            vertex_normals=-normals if table.flip else normals,
            facet_error=facet_error(spline, *table.segments),
        )

    def _mesh(self, table: _SurfaceTable, file: str, key: Key) -> list[Surface]:
        path = self.path.parent / file
        mesh: MeshSurfaces | Scene
        try:
            if file.lower().endswith(".rad"):
                from workbench.scene.rad import read_rad

                mesh = read_rad(path)
            else:
                from workbench.scene.mesh import read_mesh

                mesh = read_mesh(path)
        except SceneError as error:
            self.fail((*key, "mesh"), str(error))
        self.notes.extend(f"{table.name}: {note}" for note in mesh.notes)
        own = table.material is None
        if own and self.bands not in (1, 3):
            self.fail(
                (*key, "material"),
                f"found nothing in a scene of {self.bands} bands, expected a material, as the mesh brings red, green, "
                "blue; add it",
            )
        made = []
        for surface in mesh.surfaces:
            name = table.name if len(mesh.surfaces) == 1 else f"{table.name}/{surface.name}"
            if name != table.name:
                self.claim(name, key)
            material = self._grey(surface.material) if own else self.material_of(table.material, key)
            made.append(replace(surface, name=name, material=material))
        return made

    def _grey(self, material: Material) -> Material:
        """A material of three bands as the scene's own: as it is, or its mean in a scene of one band."""
        if self.bands == 3:
            return material
        names = ("reflectance", "emission", "specular", "transmittance")
        return replace(material, **{name: getattr(material, name).mean(keepdims=True) for name in names})

    def _matrix(self, steps: list[_Step], key: Key) -> FloatArray:
        matrix = np.eye(4)
        for index, step in enumerate(steps):
            given = [name for name in ("translate", "rotate", "scale") if getattr(step, name) is not None]
            if len(given) != 1:
                found = " and ".join(given) or "nothing"
                self.fail((*key, index), f"found {found}, expected exactly one of translate, rotate, scale")
            one = np.eye(4)
            if step.translate is not None:
                one[:3, 3] = step.translate
            elif step.rotate is not None:
                one[:3, :3] = _rotation(step.rotate.axis, step.rotate.degrees)
            else:
                scale = np.broadcast_to(step.scale, 3)
                if (scale == 0).any():
                    self.fail((*key, index, "scale"), "found 0, expected other numbers")
                one[:3, :3] = np.diag(scale)
            matrix = one @ matrix
        return matrix

    def light_records(self) -> tuple[list[Light], list[Surface]]:
        lights: list[Light] = []
        emitters: list[Surface] = []
        for index, table in enumerate(self.lights):
            key: Key = ("light", index)
            self.claim(table.name, key)  # type: ignore[attr-defined]
            if isinstance(table, _Area):
                emitters.append(self._area(table, key))
            elif isinstance(table, _Linear) and (table.position == table.end).all():
                self.fail((*key, "end"), "found the same point as position, expected another")
            else:
                fields = table.model_dump()
                power = fields.pop("irradiance", None)
                power = fields.pop("intensity") if power is None else power
                lights.append(Light(fields.pop("name"), fields.pop("type"), self.spread(power), **fields))
        return lights, emitters

    def _area(self, table: _Area, key: Key) -> Surface:
        if (table.radiance is None) == (table.exitance is None):
            self.fail(key, "expected exactly one of radiance and exitance")
        exitance = table.exitance if table.radiance is None else np.pi * table.radiance
        zero = np.zeros(self.bands)
        material = Material(table.name, zero, self.spread(exitance), zero, math.inf, zero)
        return self.polygon(table.name, material, [[table.polygon]], [(*key, "polygon")])

    def sky(self) -> Sky | None:
        table = self.table.sky
        if table is None:
            return None
        if (table.zenith_radiance is None) == (table.horizontal_irradiance is None):
            self.fail(("sky",), "expected exactly one of zenith_radiance and horizontal_irradiance")
        if self.table.background.any():
            self.fail(("background",), "found a background beside [sky], expected one of them")
        if self.table.closed:
            self.fail(("closed",), "found true in a scene with a [sky], which no light of it could enter; remove one")
        if table.sun_direction is None and table.type not in ("uniform", "overcast", "cie-1", "cie-3", "cie-5"):
            self.fail(("sky", "sun_direction"), f"found nothing, expected the direction to the sun of sky {table.type}")
        if table.sun_direction is not None and not table.sun_direction @ table.up > 0:
            self.fail(
                ("sky", "sun_direction"), "found a sun below the horizon, expected one above it (it points to it)"
            )
        given = {
            name: None if getattr(table, name) is None else self.spread(getattr(table, name))
            for name in ("zenith_radiance", "horizontal_irradiance")
        }
        ground = self.spread(table.ground_reflectance)
        return Sky(table.type, ground, up=table.up, sun_direction=table.sun_direction, **given)

    def camera(self, table: _CameraTable, key: Key) -> Camera:
        view = table.look_at - table.eye
        length = float(np.linalg.norm(view))
        if not length > 0:
            self.fail((*key, "look_at"), "found the same point as eye, expected another")
        if np.linalg.norm(np.cross(view / length, table.up)) < 1e-9:
            self.fail((*key, "up"), "found a vector along the line of sight, expected one across it")
        return Camera(table.eye, table.look_at, table.up, table.fov, table.width, table.height)


def _rotation(axis: FloatArray, degrees: float) -> FloatArray:
    """Matrix (3, 3) of a turn about the unit ``axis`` (Rodrigues), exact at quarter turns."""
    quarter, rest = divmod(degrees, 90.0)
    sine, cosine = math.sin(math.radians(rest)), math.cos(math.radians(rest))
    cosine, sine = [(cosine, sine), (-sine, cosine), (-cosine, -sine), (sine, -cosine)][int(quarter % 4)]
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return cosine * np.eye(3) + sine * cross + (1 - cosine) * np.outer(axis, axis)


# ---------------------------------------------------------------------------------------------


def read_toml(path: str | Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises
    ------
    SceneError
        If the file cannot be opened, is empty, or is not TOML; it names the line.
    """
    text = read_text(path)
    if not text.strip():
        raise SceneError("found an empty file, expected a scene that starts with `schema = 1`", path=path)
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise SceneError("found lists nested too deep, expected a scene in TOML", path=path) from None
    except ValueError as error:  # TOMLDecodeError, or a number of too many digits
        message = " ".join(str(error).split())
        place = re.search(r" ?\(at line (\d+), column (\d+)\)$| ?\(at end of document\)$", message)
        line = None
        if place is not None:
            line = int(place[1]) if place[1] else text.rstrip().count("\n") + 1
            message = message[: place.start()]
        raise SceneError(f"found no valid TOML ({message[:150]}); correct the line", path=path, line=line) from None


def load_scene(path: str | Path) -> Scene:
    """A scene in the native format, as the module's text defines it.

    Raises
    ------
    SceneError
        If the file cannot be read or something in it cannot be used.
    """
    path = Path(path)
    values = read_toml(path)
    if values.get("schema") != 1 or isinstance(values.get("schema"), bool):
        found = _show(values["schema"]) if "schema" in values else "nothing"
        close = [] if "schema" in values else difflib.get_close_matches("schema", values, n=1, cutoff=0.8)
        hint = f" (is {close[0]!r} a misspelling?)" if close else ""
        raise SceneError(f"found {found}, expected 1; start the file with `schema = 1`{hint}", path=path, key="schema")
    base: Key = ()
    table: type[_Table] = _File
    try:
        file = _File.model_validate(values)
        lights = []
        for index, light in enumerate(file.light):
            base = ("light", index)
            kind = light.get("type")
            if not isinstance(kind, str) or kind not in _LIGHTS:
                found = _show(kind) if "type" in light else "nothing"
                raise SceneError(
                    f"found {found}, expected one of {', '.join(_LIGHTS)}", path=path, key=_key((*base, "type"))
                )
            table = _LIGHTS[kind]
            lights.append(table.model_validate(light))
    except ValidationError as error:
        key, message = _fault(error, table, base)
        raise SceneError(message, path=path, key=_key(key)) from None
    with np.errstate(all="ignore"):  # what overflows is found by its result and named
        builder = _Builder(path, file, lights)
        point_lights, emitters = builder.light_records()
        surfaces = tuple(itertools.chain(builder.surfaces(), emitters))
        camera = builder.camera(file.camera, ("camera",)) if file.camera is not None else None
        cameras = {name: builder.camera(each, ("cameras", name)) for name, each in file.cameras.items()}
        sky = builder.sky()
    if not surfaces:
        raise SceneError("found no surface, expected at least one [[surface]]; add it", path=path, key="surface")
    return Scene(
        name=file.name or path.stem,
        surfaces=surfaces,
        lights=tuple(point_lights),
        camera=camera or next(iter(cameras.values()), None),
        cameras=cameras,
        background=builder.spread(file.background),
        bands=builder.bands,
        closed=file.closed,
        path=path,
        notes=tuple(builder.notes),
        sky=sky,
    )
