"""Reader of Radiance scene descriptions (``.rad``; G. J. Ward, "The RADIANCE Lighting Simulation and Rendering
System", SIGGRAPH 1994; the file format is described in Radiance's reference manual).

What becomes of a file:

* **Geometry.**  ``polygon`` (the seams of holes, edges that the ring walks twice, are opened again), ``sphere``,
  ``bubble``, ``cylinder``, ``tube``, ``cone``, ``cup`` and ``ring``.  Each primitive makes a surface of its own
  name; polygons of one name and material that follow each other make one together.  Round primitives become facets,
  rings a polygon of the same area.  Polygons without area are dropped, those that are not planar cut into triangles.
* **Materials.**  ``plastic``, ``metal``, ``trans`` (what it scatters to the other side is left out), ``glass`` (a
  pane: what passes and mirrors at normal incidence), ``dielectric``, ``mirror``, ``light`` and ``glow`` (exitance is
  pi times their radiance).  Surfaces reflect from both sides, as in Radiance; lamps shine from their front and are
  black.  Roughness r becomes the Phong exponent 2 / r^2 - 2.  Patterns and textures are left out, with a note.
* **Distant sources.**  A ``light`` source becomes a directional light.  A ``glow`` source of 360 degrees is the
  background; those of 180 degrees about an axis and against it are sky and ground: uniform, or under a
  ``skybright.cal`` pattern, as ``gensky`` writes it, the overcast or uniform sky that it says.
* **Commands.**  ``!xform`` with all its moves, arrays and iterations, ``!cat`` and ``!genbox`` are read here; no
  command is ever run, so other generators must be run first and their output included.  Files are sought beside the
  including file, then beside the first one.
* **Missing materials.**  A room without its materials is common, since ``oconv`` takes several files: a
  ``materials.rad`` beside the file is read for materials that are not defined, and a note says so.
* **Views.**  Perspective views (``-vtv``) of ``*.vf`` files beside the scene or in its folder ``views`` are its
  cameras.

Bands are red, green and blue.
"""

from __future__ import annotations

import math
import shlex
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from workbench.errors import SceneError
from workbench.geometry.polygons import PLANARITY, plane_basis, triangulate_ring, vector_area
from workbench.scene._tokens import LARGEST, Words, read_text, ring_fault
from workbench.scene.library import BOX_QUADS, cone_surface, polygon_fault, sphere_surface, transformed
from workbench.scene.model import Camera, Light, Material, Scene, Sky, Surface

__all__ = ["load_scene", "read_rad"]

FloatArray = NDArray[np.float64]

FACET_ERROR = 0.005
"""Largest distance between a round primitive and its facets, as a share of its radius."""
RING_CORNERS = 48
"""Corners of the polygon that stands for a ring."""
MOST_COPIES = 100_000
"""Most copies that one ``xform`` makes: its arrays multiply."""
DEEPEST = 32
"""Files that may include each other, one in the other."""
LARGEST_REFLECTANCE = 0.99
PICTURE_SIDE = 512
"""Longer side of a view's picture. [pixels]"""
SUN = 10.0
"""Largest angle of a distant source that counts as a direction. [degrees]"""

LEAST_WITH_HOLE = 8
"""Corners of a triangle with a triangular hole, both ends of the seam counted twice."""

_ZERO_AREA = 1e-14
"""A polygon below this share of its squared extent has no area."""

# Name: the counts of real arguments that it may have.
_MATERIALS = {
    "plastic": (5,),
    "metal": (5,),
    "trans": (7,),
    "glass": (3, 4),
    "dielectric": (5,),
    "mirror": (3,),
    "light": (3,),
    "glow": (4,),
}
_SHAPES = {
    "polygon": (),
    "sphere": (4,),
    "bubble": (4,),
    "cylinder": (7,),
    "tube": (7,),
    "cone": (8,),
    "cup": (8,),
    "ring": (8,),
    "source": (4,),
}
_PATTERNS = ("bright", "color", "spec", "tex")
"""How the names of patterns and textures begin: brightfunc, colorpict, texdata, ..."""
_KNOWN = ", ".join([*_MATERIALS, *_SHAPES])


@dataclass(frozen=True)
class _Primitive:
    """A primitive as its file has it; ``numbers`` are its real arguments."""

    modifier: str
    kind: str
    name: str
    words: tuple[str, ...]
    numbers: FloatArray
    path: Path
    line: int

    def fail(self, message: str) -> NoReturn:
        raise SceneError(f"{self.kind} {self.name!r}: {message}", path=self.path, line=self.line)


@dataclass
class _Polygons:
    """Polygons of one name and material that follow each other in one file."""

    mark: tuple[str, Path]
    name: str
    material: Material
    polygons: list[list[FloatArray]]


@dataclass
class _Reading:
    """What the files have said so far."""

    first: Path
    defined: dict[str, _Primitive] = field(default_factory=dict)
    materials: dict[str, Material] = field(default_factory=dict)
    surfaces: list[Surface | _Polygons] = field(default_factory=list)
    sources: list[_Primitive] = field(default_factory=list)
    notes: Counter[str] = field(default_factory=Counter)
    names: set[str] = field(default_factory=set)
    looked_beside: bool = False


# ---------------------------------------------------------------------------------------------
# Files, primitives, commands


def _commands_apart(text: str) -> tuple[str, list[str]]:
    """The text with each command line replaced by ``!`` and its number; and the commands."""
    lines = text.split("\n")
    commands: list[str] = []
    at = 0
    while at < len(lines):
        if not lines[at].lstrip().startswith("!"):
            at += 1
            continue
        command = lines[at].strip()[1:]
        lines[at] = f"!{len(commands)}"
        while command.endswith("\\") and at + 1 < len(lines):
            at += 1
            command = f"{command[:-1]} {lines[at].strip()}"
            lines[at] = ""
        commands.append(command)
        at += 1
    return "\n".join(lines), commands


@dataclass(frozen=True)
class _Copy:
    """Where one copy of an included file goes: a map, a prefix of the names, another modifier."""

    matrix: FloatArray = field(default_factory=lambda: np.eye(4))
    prefix: str = ""
    modifier: str | None = None

    def of(self, inner: _Copy) -> _Copy:
        """This copy of a file in which ``inner`` was included."""
        return _Copy(self.matrix @ inner.matrix, self.prefix + inner.prefix, self.modifier or inner.modifier)


def _read_file(path: Path, reading: _Reading, copies: list[_Copy], depth: int, materials_only: bool = False) -> None:
    text, commands = _commands_apart(read_text(path))
    words = Words(text, path)
    while words.peek() is not None:
        word = words.take("a primitive")
        if word.startswith("!"):
            if not materials_only:
                _run(commands[int(word[1:])], words, reading, copies, depth)
            continue
        line = words.line
        kind, name = words.take(f"the type of what {word!r} modifies"), words.take("a name")
        if kind == "alias":
            other = words.take("the name that an alias stands for")
            if other not in reading.defined:
                words.fail(f"alias {name!r}: found {words.quote(other)}, expected a modifier defined before", line)
            reading.defined[name] = reading.defined[other]
            reading.materials.pop(name, None)
            continue
        strings = tuple(
            words.take(f"string argument {i + 1} of {name}")
            for i in range(words.integer(f"the number of string arguments of {name}", 0, 10**6))
        )
        words.integer(f"the number of integer arguments of {name}", 0, 0)
        count = words.integer(f"the number of real arguments of {name}", 0, 10**8)
        numbers: list[float] = []
        for i in range(count):  # a wrong count must end at the wrong word, not at an allocation
            numbers.append(words.number(f"real argument {i + 1} of {name}"))
        primitive = _Primitive(word, kind, name, strings, np.asarray(numbers), path, line)
        if kind in _SHAPES:
            if not materials_only:
                _place(primitive, reading, copies)
        elif kind in _MATERIALS or kind.startswith(_PATTERNS):
            reading.defined[name] = primitive
            reading.materials.pop(name, None)
        else:
            primitive.fail(f"found the type {words.quote(kind)}, expected one of {_KNOWN}; replace it")


def _run(command: str, words: Words, reading: _Reading, copies: list[_Copy], depth: int) -> None:
    """Do what a command line asks for, without running anything."""
    try:
        asked = shlex.split(command, comments=True)
    except ValueError as error:
        words.fail(f"found {words.quote(command)} ({error}), expected a command")
    name = Path(asked[0]).name if asked else ""
    if depth >= DEEPEST:
        words.fail(f"found files included {DEEPEST} deep, expected fewer; does one include itself?")
    if any(mark in asked for mark in ("|", ";", "<", ">", "&&")) or name not in ("xform", "cat", "genbox"):
        words.fail(
            f"found the command {words.quote(command)}, expected xform, cat or genbox alone; no command is run here: "
            "run it, and include its output by `!xform FILE`"
        )
    if name == "genbox":
        _box(asked[1:], words, reading, copies)
        return
    inner, files = _xform(asked[1:], words) if name == "xform" else ([_Copy()], asked[1:])
    if not files:
        words.fail(f"found {words.quote(command)}, expected the name of a file in it")
    if len(copies) * len(inner) > MOST_COPIES:
        words.fail(f"found {len(copies) * len(inner)} copies, expected at most {MOST_COPIES}")
    every = [outer.of(one) for outer in copies for one in inner]
    for file in files:
        beside = [folder / file for folder in (words.path.parent, reading.first.parent)]
        found = next((path for path in beside if path.is_file()), None)
        if found is None:
            words.fail(f"found no file {words.quote(file)} beside this one, expected one; correct the name")
        _read_file(found, reading, every, depth + 1)


def _xform(arguments: list[str], words: Words) -> tuple[list[_Copy], list[str]]:
    """Copies and files of an ``xform`` command: moves in the order given, arrays, iterations."""
    rest = list(arguments)

    def value(option: str) -> float:
        try:
            number = float(rest.pop(0))
        except (IndexError, ValueError):
            number = math.nan
        if not abs(number) <= LARGEST:
            words.fail(f"xform {option}: expected a number behind it")
        return number

    def whole(option: str) -> int:
        number = value(option)
        if number != int(number) or not 1 <= number <= MOST_COPIES:
            words.fail(f"xform {option}: found {number:g}, expected a whole number from 1 to {MOST_COPIES}")
        return int(number)

    prefix, modifier = "", None
    # Blocks of moves; each but the first is repeated, as an array or as one long move.
    blocks: list[tuple[str, int, FloatArray]] = [("i", 1, np.eye(4))]
    while rest and rest[0].startswith("-"):
        option = rest.pop(0)
        move = np.eye(4)
        if option == "-t":
            move[:3, 3] = [value(option) for _ in range(3)]
        elif option in ("-rx", "-ry", "-rz"):
            angle, axis = math.radians(value(option)), "xyz".index(option[2])
            a, b = (axis + 1) % 3, (axis + 2) % 3
            move[a, a] = move[b, b] = math.cos(angle)
            move[a, b], move[b, a] = -math.sin(angle), math.sin(angle)
        elif option == "-s":
            scale = value(option)
            if scale == 0:
                words.fail("xform -s: found 0, expected another number")
            move[:3, :3] *= scale
        elif option in ("-mx", "-my", "-mz"):
            move["xyz".index(option[2]), "xyz".index(option[2])] = -1.0
        elif option in ("-a", "-i"):
            blocks.append((option[1], whole(option), np.eye(4)))
            continue
        elif option in ("-n", "-m"):
            if not rest:
                words.fail(f"xform {option}: expected a name behind it")
            if option == "-n":
                prefix = rest.pop(0)
            else:
                modifier = rest.pop(0)
            continue
        elif option in ("-c", "-e", "-I"):
            continue
        else:
            words.fail(
                f"found the option {words.quote(option)} of xform, expected one of "
                "-t, -rx, -ry, -rz, -s, -mx, -my, -mz, -a, -i, -n, -m"
            )
        how, count, before = blocks[-1]
        blocks[-1] = (how, count, move @ before)
    copies: list[tuple[FloatArray, str]] = [(np.eye(4), "")]
    for how, count, move in blocks:
        if how == "i":
            power = np.linalg.matrix_power(move, count)
            copies = [(power @ matrix, suffix) for matrix, suffix in copies]
            continue
        if len(copies) * count > MOST_COPIES:
            words.fail(f"found more than {MOST_COPIES} copies in one xform, expected fewer")
        powers = [np.eye(4)]
        for _ in range(count - 1):
            powers.append(move @ powers[-1])
        copies = [(powers[i] @ matrix, f"{suffix}{i}.") for matrix, suffix in copies for i in range(count)]
    name = f"{prefix}." if prefix else ""
    return [_Copy(matrix, name + suffix, modifier) for matrix, suffix in copies], rest


def _box(arguments: list[str], words: Words, reading: _Reading, copies: list[_Copy]) -> None:
    """``genbox modifier name x y z [-i]``: a box from the origin, fronts outside, or inside with ``-i``."""
    inward = "-i" in arguments
    plain = [word for word in arguments if word != "-i"]
    try:
        size = np.array([float(word) for word in plain[2:]])
    except ValueError:
        size = np.zeros(0)
    if len(size) != 3 or not ((size > 0) & (size <= LARGEST)).all():
        words.fail(
            f"found `genbox {' '.join(arguments)[:60]}`, expected `genbox modifier name x y z [-i]` "
            "with sizes above 0; run other forms and include their output"
        )
    corners = np.where((np.arange(8)[:, None] >> np.arange(3)) & 1, size, 0.0)
    for index, quad in enumerate(BOX_QUADS):
        ring = corners[quad[::-1] if inward else quad]
        name = f"{plain[1]}.{index}"
        _place(_Primitive(plain[0], "polygon", name, (), ring.ravel(), words.path, words.line), reading, copies)


# ---------------------------------------------------------------------------------------------
# Materials


def _look_beside(primitive: _Primitive, reading: _Reading) -> None:
    """Read materials of a ``materials.rad`` beside the first file, once."""
    if reading.looked_beside:
        return
    reading.looked_beside = True
    beside = reading.first.with_name("materials.rad")
    if beside != reading.first and beside.is_file():
        defined = dict(reading.defined)
        _read_file(beside, reading, [], 0, materials_only=True)
        reading.defined |= defined
        reading.notes["materials that the file does not define were taken from materials.rad beside it"] += 0


def _material(primitive: _Primitive, reading: _Reading, modifier: str) -> Material:
    """The material of a primitive, made when it is first used."""
    if modifier in reading.materials:
        return reading.materials[modifier]
    if modifier != "void" and modifier not in reading.defined:
        _look_beside(primitive, reading)
    if modifier == "void" or modifier not in reading.defined:
        primitive.fail(f"found the modifier {modifier!r}, expected a material defined before; include it")
    given = reading.defined[modifier]
    seen = {modifier}
    while given.kind not in _MATERIALS:  # a pattern on its own: what it modifies comes first
        if given.modifier in seen or given.modifier not in reading.defined:
            primitive.fail(f"found the modifier {modifier!r}, which leads to no material, expected one of {_KNOWN}")
        seen.add(given.modifier)
        given = reading.defined[given.modifier]
    if given.modifier != "void" or len(seen) > 1:
        lamp = given.kind in ("light", "glow")
        reading.notes[f"patterns {'of lamps (their distributions)' if lamp else 'and textures'} were left out"] += 1
    reading.materials[modifier] = made = _made(given, modifier, reading)
    return made


def _made(given: _Primitive, name: str, reading: _Reading) -> Material:
    """One of Radiance's materials in our terms."""
    numbers, kind = given.numbers, given.kind
    if len(numbers) not in _MATERIALS[kind]:
        wanted = " or ".join(str(count) for count in _MATERIALS[kind])
        given.fail(f"found {len(numbers)} real arguments, expected {wanted}")
    top = LARGEST if kind in ("light", "glow") else 1.0
    if not ((numbers[:3] >= 0) & (numbers[:3] <= top)).all():
        given.fail(f"found the colour {numbers[:3].tolist()}, expected numbers from 0{'' if top > 1 else ' to 1'}")
    zero = np.zeros(3)
    color, reflectance, specular, transmittance, exponent, ior = numbers[:3], zero, zero, zero, math.inf, 1.0
    if kind in ("light", "glow"):
        return Material(name, zero, np.pi * color, zero, math.inf, zero)
    if kind in ("plastic", "metal", "trans"):
        share, rough = float(numbers[3]), float(numbers[4])
        passing = numbers[5:7] if kind == "trans" else np.zeros(2)
        if not (0 <= share <= 1 and 0 <= rough <= 1 and ((passing >= 0) & (passing <= 1)).all()):
            given.fail("found a specularity, roughness or transmission out of range, expected 0 to 1")
        exponent = math.inf if rough == 0 else max(2.0 / rough**2 - 2.0, 0.0)
        scattered = color * (1.0 - share)
        specular = color * share if kind == "metal" else np.full(3, share)
        reflectance = scattered * (1.0 - passing[0])
        transmittance = scattered * passing[0] * passing[1]
        if passing[0] * (1.0 - passing[1]) > 0:
            reading.notes["light that `trans` scatters to the other side was left out"] += 1
    elif kind == "glass":
        ior_inside = float(numbers[3]) if len(numbers) == 4 else 1.52
        mirrored = ((ior_inside - 1.0) / (ior_inside + 1.0)) ** 2
        # Both faces, with all reflections between them.
        through = 1.0 - (mirrored * color) ** 2
        transmittance = (1.0 - mirrored) ** 2 * color / through
        specular = mirrored + mirrored * (1.0 - mirrored) ** 2 * color**2 / through
    elif kind == "dielectric":
        ior = float(numbers[3])
        if not 1 <= ior <= 10:
            given.fail(f"found the index of refraction {ior:g}, expected 1 to 10")
        specular = np.full(3, ((ior - 1.0) / (ior + 1.0)) ** 2)
        transmittance = color * (1.0 - specular)
    else:
        specular = color
    if (reflectance > LARGEST_REFLECTANCE).any():
        reading.notes[f"reflectances above {LARGEST_REFLECTANCE} were read as {LARGEST_REFLECTANCE}"] += 1
        reflectance = np.minimum(reflectance, LARGEST_REFLECTANCE)
    specular = np.minimum(specular, 1.0 - reflectance - transmittance)
    return Material(name, reflectance, zero, specular, exponent, transmittance, ior, two_sided=True)


# ---------------------------------------------------------------------------------------------
# Surfaces


def _rings(ring: FloatArray) -> list[FloatArray]:
    """A ring with its seams opened: an edge walked there and back joins a hole to what surrounds it."""
    keep = (ring != np.roll(ring, 1, axis=0)).any(axis=1)
    ring = ring[keep] if keep.any() else ring[:1]
    _, corner = np.unique(ring, axis=0, return_inverse=True)
    corners = corner.reshape(-1).tolist()
    count = len(corners)
    seen: dict[tuple[int, int], int] = {}
    for i in range(count):
        back = seen.get((corners[(i + 1) % count], corners[i]))
        if back is not None:
            # Edge `back` comes in, edge `i` goes out again: between them lies one ring, about them the other.
            inner = ring[back + 1 : i]
            outer = np.concatenate([ring[:back], ring[i + 1 :]])
            return [part for half in (outer, inner) if len(half) > 2 for part in _rings(half)]
        seen[(corners[i], corners[(i + 1) % count])] = i
    return [ring]


def _nested(rings: list[FloatArray], normal: FloatArray) -> list[list[FloatArray]]:
    """Polygons (outer ring, holes...) of flat rings, even-odd as in Radiance: holes may wind either way."""
    import shapely

    u, v = plane_basis(normal)
    shapes = [shapely.Polygon(np.column_stack([ring @ u, ring @ v])) for ring in (r - rings[0][0] for r in rings)]
    order = sorted(range(len(rings)), key=lambda i: -shapes[i].area)
    within: dict[int, list[int]] = {}
    polygons: dict[int, list[FloatArray]] = {}
    for at, i in enumerate(order):
        inside = shapes[i].representative_point()
        within[i] = [j for j in order[:at] if shapes[j].contains(inside)]
        hole = len(within[i]) % 2 == 1
        ring = rings[i] if (float(vector_area(rings[i]) @ normal) > 0) != hole else rings[i][::-1]
        if hole:
            polygons[within[i][-1]].append(ring)
        else:
            polygons[i] = [ring]
    return list(polygons.values())


def _polygon(primitive: _Primitive, reading: _Reading) -> list[list[FloatArray]]:
    """Polygons (outer ring, holes...) of one ``polygon``."""
    numbers = primitive.numbers
    if len(numbers) < 9 or len(numbers) % 3:
        primitive.fail(f"found {len(numbers)} real arguments, expected three a corner and 3 corners or more")
    points = numbers.reshape(-1, 3)
    vector = vector_area(points)
    area, extent = float(np.linalg.norm(vector)), float(np.ptp(points, axis=0).max())
    if not area > _ZERO_AREA * extent**2:
        reading.notes["polygons without area were dropped"] += 1
        return []
    normal = vector / area
    rings = _rings(points) if len(points) >= LEAST_WITH_HOLE else [points]
    if np.abs((points - points[0]) @ normal).max() > PLANARITY * extent:
        if len(rings) > 1:
            primitive.fail("found a polygon with holes that is not planar, expected a planar one")
        reading.notes["polygons that are not planar were cut into triangles"] += 1
        return [[points[corners]] for corners in triangulate_ring(points, normal)]
    polygons = [rings] if len(rings) == 1 else _nested(rings, normal)
    for polygon in polygons:
        fault = ring_fault(polygon[0]) if len(polygon) == 1 else polygon_fault(polygon)
        if fault is not None:
            primitive.fail(f"found {fault}; correct the points")
    return polygons


def _positive(primitive: _Primitive, *values: float) -> None:
    if not all(value > 0 for value in values):
        primitive.fail(f"found the radius {min(values):g}, expected a number greater than 0")


def _round(primitive: _Primitive, material: Material) -> Surface:
    """Spheres, cones, cylinders and rings as facets."""
    kind, name, numbers = primitive.kind, primitive.name, primitive.numbers
    if kind in ("sphere", "bubble"):
        radius = float(numbers[3])
        _positive(primitive, abs(radius))
        inward = (kind == "bubble") != (radius < 0)
        return sphere_surface(name, material, numbers[:3], abs(radius), facet_error=FACET_ERROR, inward=inward)
    if kind == "ring":
        small, large = sorted(float(value) for value in numbers[6:8])
        _positive(primitive, large)
        length = float(np.linalg.norm(numbers[3:6]))
        if small < 0 or small == large or not length > 0:
            primitive.fail("expected two different radii of 0 or more and a direction")
        u, v = plane_basis(numbers[3:6] / length)
        angle = 2 * np.pi * np.arange(RING_CORNERS) / RING_CORNERS
        circle = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
        circle *= math.sqrt(2 * np.pi / RING_CORNERS / math.sin(2 * np.pi / RING_CORNERS))
        rings = [numbers[:3] + large * circle] + ([numbers[:3] + small * circle[::-1]] if small > 0 else [])
        return Surface.from_polygons(name, material, [rings])
    radii = numbers[6:8] if kind in ("cone", "cup") else np.repeat(numbers[6], 2)
    if (radii < 0).any() or not (radii > 0).any() or (numbers[:3] == numbers[3:6]).all():
        primitive.fail("expected radii of 0 or more, not all 0, and two different ends")
    return cone_surface(
        name,
        material,
        numbers[:3],
        float(radii[0]),
        numbers[3:6],
        float(radii[1]),
        facet_error=FACET_ERROR,
        inward=kind in ("tube", "cup"),
    )


def _claim(name: str, reading: _Reading) -> str:
    """The name, with a number behind it if it is taken."""
    free, number = name, 1
    while free in reading.names:
        number += 1
        free = f"{name}.{number}"
    reading.names.add(free)
    return free


def _place(primitive: _Primitive, reading: _Reading, copies: list[_Copy]) -> None:
    """Add each copy of a primitive to the surfaces or to the distant sources."""
    counts = _SHAPES[primitive.kind]
    if counts and len(primitive.numbers) not in counts:
        primitive.fail(f"found {len(primitive.numbers)} real arguments, expected {counts[0]}")
    modifiers = [copy.modifier or primitive.modifier for copy in copies]
    if primitive.kind == "source":
        for copy, modifier in zip(copies, modifiers, strict=True):
            numbers = np.append(copy.matrix[:3, :3] @ primitive.numbers[:3], primitive.numbers[3])
            reading.sources.append(replace(primitive, numbers=numbers, modifier=modifier))
        return
    materials = [_material(primitive, reading, modifier) for modifier in modifiers]
    polygons = _polygon(primitive, reading) if primitive.kind == "polygon" else []
    for copy, material in zip(copies, materials, strict=True):
        name, linear = copy.prefix + primitive.name, copy.matrix[:3, :3]
        step = -1 if np.linalg.det(linear) < 0 else 1  # fronts stay fronts in a mirror
        if primitive.kind == "polygon":
            moved = [[(ring @ linear.T + copy.matrix[:3, 3])[::step] for ring in rings] for rings in polygons]
            corners = [ring for rings in moved for ring in rings]
        else:
            surface = transformed(_round(primitive, material), copy.matrix)
            corners = [surface.vertices]
        if not all((np.abs(ring) <= LARGEST).all() for ring in corners):
            primitive.fail(f"found coordinates beyond {LARGEST:g}, expected smaller ones; rescale the scene")
        if primitive.kind != "polygon":
            if primitive.kind != "ring":
                note = f"spheres, cones and cylinders are facets that lie within {FACET_ERROR:g} of their radius"
                reading.notes[note] += 0
            reading.surfaces.append(replace(surface, name=_claim(name, reading)))
            continue
        before = reading.surfaces[-1] if reading.surfaces else None
        mark = (name, primitive.path)
        if isinstance(before, _Polygons) and before.mark == mark and before.material is material:
            before.polygons += moved
        elif moved:
            reading.surfaces.append(_Polygons(mark, _claim(name, reading), material, moved))


# ---------------------------------------------------------------------------------------------
# Sky and views


def _half_sky(source: _Primitive, reading: _Reading) -> tuple[str, FloatArray, FloatArray]:
    """Kind of sky, zenith and ground radiance (3,) of a distant glow, which a ``skybright.cal`` pattern may scale."""
    glow = reading.defined.get(source.modifier)
    if glow is None or glow.kind not in ("light", "glow"):
        source.fail(f"found the modifier {source.modifier!r}, expected a light or a glow defined before")
    color = glow.numbers[:3]
    pattern = reading.defined.get(glow.modifier)
    if pattern is None:
        return "uniform", color, color
    if pattern.kind != "brightfunc" or "skybright.cal" not in " ".join(pattern.words) or len(pattern.numbers) < 3:
        pattern.fail("found a pattern on a distant source, expected none or the skybright.cal of gensky")
    kind = {2: "overcast", 3: "uniform"}.get(int(pattern.numbers[0]))
    if kind is None:
        pattern.fail(
            "found a clear or intermediate sky of gensky, expected an overcast (-c) or uniform (-u) one; "
            "or read the geometry as `mesh` of a TOML scene with a [sky] of its own"
        )
    return kind, color * pattern.numbers[1], color * pattern.numbers[2]


def _distant(reading: _Reading) -> tuple[list[Light], FloatArray, Sky | None]:
    """Directional lights, background and sky."""
    lights: list[Light] = []
    background = np.zeros(3)
    halves: list[tuple[FloatArray, str, FloatArray, FloatArray]] = []
    for source in reading.sources:
        length = float(np.linalg.norm(source.numbers[:3]))
        angle = float(source.numbers[3])
        if not length > 0:
            source.fail("found no direction, expected one")
        toward = source.numbers[:3] / length
        if 0 < angle <= SUN:
            given = reading.defined.get(source.modifier)
            if given is None or given.kind not in ("light", "glow"):
                source.fail(f"found the modifier {source.modifier!r}, expected a light or a glow defined before")
            solid = 2 * np.pi * (1 - math.cos(math.radians(angle) / 2))
            lights.append(Light(source.name, "directional", given.numbers[:3] * solid, direction=-toward))
            continue
        if angle not in (180.0, 360.0):
            source.fail(f"found the angle {angle:g}, expected one up to {SUN:g} (a sun), 180 (half the sky) or 360")
        kind, zenith, ground = _half_sky(source, reading)
        if angle == 360.0:
            if kind != "uniform":
                source.fail("found a sky over 360 degrees, expected 180 about the zenith and 180 against it")
            background = background + zenith
        else:
            halves.append((toward, kind, zenith, ground))
    if not halves:
        return lights, background, None
    if background.any():
        raise SceneError("found distant glows of 360 and 180 degrees, expected one kind", path=reading.first)
    # A sky is what is brighter; the ground is what stands against it.
    highest = max(range(len(halves)), key=lambda i: halves[i][0][2])
    up, kind, zenith, _ = halves[highest]
    rest = [half for i, half in enumerate(halves) if i != highest]
    if any(float(half[0] @ up) > -1 + 1e-9 for half in rest) or len(rest) > 1:
        raise SceneError("found several half skies, expected a sky and a ground against it", path=reading.first)
    reflectance = np.zeros(3)
    if rest:
        # The ground shines with its radiance; ours reflects the sky's horizontal irradiance.
        horizontal = np.pi * zenith * (7.0 / 9.0 if kind == "overcast" else 1.0)
        reflectance = np.divide(np.pi * rest[0][3], horizontal, out=np.zeros(3), where=horizontal > 0)
        if (reflectance > 1).any():
            reading.notes["ground brighter than a white one under this sky was read as white"] += 0
            reflectance = np.minimum(reflectance, 1.0)
    return lights, background, Sky(kind, reflectance, zenith_radiance=zenith, up=up)


def _views(path: Path, reading: _Reading) -> dict[str, Camera]:
    """Perspective views of ``*.vf`` files beside the scene and in ``views``."""
    cameras: dict[str, Camera] = {}
    for file in sorted([*path.parent.glob("*.vf"), *(path.parent / "views").glob("*.vf")]):
        try:
            words = read_text(file).split()
            given: dict[str, list[float]] = {}
            for name, count in (("-vp", 3), ("-vd", 3), ("-vu", 3), ("-vh", 1), ("-vv", 1)):
                at = words.index(name)
                given[name] = [float(word) for word in words[at + 1 : at + 1 + count]]
                if len(given[name]) != count or not all(math.isfinite(value) for value in given[name]):
                    raise ValueError(name)
        except (SceneError, ValueError):
            reading.notes["views that are not perspective, or broken, were left out"] += 1
            continue
        eye, along, up = (np.array(given[name]) for name in ("-vp", "-vd", "-vu"))
        high, wide = (math.tan(math.radians(given[name][0]) / 2) for name in ("-vv", "-vh"))
        proper = np.linalg.norm(np.cross(along, up)) > 1e-9 * np.linalg.norm(along) * np.linalg.norm(up)
        if ("-vt" in "".join(words) and "-vtv" not in words) or not (proper and 0 < high < 100 and 0 < wide < 100):
            reading.notes["views that are not perspective, or broken, were left out"] += 1
            continue
        scale = PICTURE_SIDE / max(wide, high)
        cameras[file.stem] = Camera(
            eye, eye + along, up, given["-vv"][0], max(1, round(wide * scale)), max(1, round(high * scale))
        )
    return cameras


def read_rad(path: str | Path) -> Scene:
    """A Radiance file as a scene, as the module's text says; without light if the file has none.

    Raises
    ------
    SceneError
        If a file cannot be read or breaks a rule; the message names file and line.
    """
    path = Path(path)
    reading = _Reading(path)
    _read_file(path, reading, [_Copy()], 0)
    if not reading.surfaces:
        raise SceneError("found no surface, expected polygons or other shapes of Radiance", path=path)
    lights, background, sky = _distant(reading)
    cameras = _views(path, reading)
    return Scene(
        name=path.stem,
        surfaces=tuple(
            Surface.from_polygons(found.name, found.material, found.polygons) if isinstance(found, _Polygons) else found
            for found in reading.surfaces
        ),
        lights=tuple(lights),
        camera=next(iter(cameras.values()), None),
        cameras=cameras,
        background=background,
        bands=3,
        path=path,
        notes=tuple(f"{text} ({count})" if count else text for text, count in reading.notes.items()),
        sky=sky,
    )


def load_scene(path: str | Path) -> Scene:
    """As :func:`read_rad`; a scene that emits nothing is lit as a mesh file is.

    Raises
    ------
    SceneError
        As :func:`read_rad`.
    """
    scene = read_rad(path)
    if scene.has_emitter:
        return scene
    from workbench.scene.mesh import lit

    return lit(scene)
