"""Reader of ``.sc`` scene files, the input of ``raycast``.

The language of the files of the ray-casting assignment (CMU 15-463, spring 1996) is lost: its
documentation and its scene files are in no public copy that could be found.  What is read here is
a *reconstruction* from what the assignment itself says (groups between ``push`` and ``pop`` with
bounding sphere and box, spheres and polygons, one matrix from world to screen, the symbols of the
shading formula, several files read in sequence into one scene) with words borrowed from its
neighbours (SMF, IRIS GL, NFF).  It is not the syntax of 1996.

Statements, free in layout, ``#`` starts a comment::

    size W H            background R G B     ambient R G B     persp FOV_DEGREES
    lookat EYE AT UP    world                push              pop
    trans X Y Z         scale X Y Z          rot x|y|z DEGREES
    material NAME { color R G B  kdr K  ksr K  e E  ktr K  eta N  emission R G B }
    use NAME            light X Y Z  R G B
    polygon N  X Y Z ...                     sphere X Y Z  RADIUS

Where the reconstruction leaves a choice: a material defined again replaces the old one for the
``use`` statements after it; no field may be negative and ``eta`` must exceed 0; a reflection
(a matrix of negative determinant) keeps the front of a polygon in front, so the order of its
vertices is turned round; groups without a primitive are left out of the tree; ``z`` of the screen
is ``1 - 1/w``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from workbench.errors import SceneError
from workbench.scene._tokens import LARGEST, LARGEST_SIDE, Words, read_text, ring_fault
from workbench.scene.library import sphere_surface
from workbench.scene.model import Camera, Light, Material, Scene, Surface

__all__ = [
    "ScGroup",
    "ScLight",
    "ScMaterial",
    "ScPolygon",
    "ScScene",
    "ScSphere",
    "load_scene",
    "read_sc",
    "screen_matrix",
]

FloatArray = NDArray[np.float64]

_STATEMENTS = (
    "size, background, ambient, persp, lookat, world, push, pop, trans, scale, rot, material, use, light, "
    "polygon or sphere"
)
_BEFORE_WORLD = frozenset({"size", "persp", "lookat"})
_AFTER_WORLD = frozenset({"push", "pop", "use", "light", "polygon", "sphere"})


@dataclass(frozen=True)
class ScMaterial:
    """The parameters of the assignment's shading formula, and those of its sequels.

    Parameters
    ----------
    name : str
    color : (3,) float
        C_mat, reflectance. [0 or more]
    kdr, ksr : float
        Coefficients of diffuse and specular reflection.
    e : float
        Exponent of the highlight.
    ktr, eta : float
        Coefficient of transmission and index of refraction; the ray caster does not use them.
    emission : (3,) float
        Emitted radiosity.
    """

    name: str
    color: FloatArray
    kdr: float
    ksr: float
    e: float
    ktr: float
    eta: float
    emission: FloatArray


@dataclass(frozen=True)
class ScLight:
    """A point light: ``position`` (3,) in world space and ``radiance`` (3,), I_i of the formula."""

    position: FloatArray
    radiance: FloatArray


@dataclass(frozen=True)
class ScPolygon:
    """A planar, simple polygon, convex or not.

    ``vertices`` (n, 3) are in world space, counter-clockwise seen from the front; ``material``
    and ``group`` are indices into the scene's tuples, ``group`` being -1 outside every group;
    ``line`` is its line in its file.
    """

    vertices: FloatArray
    material: int
    group: int
    line: int


@dataclass(frozen=True)
class ScSphere:
    """A sphere in world space; ``material``, ``group`` and ``line`` as in :class:`ScPolygon`."""

    center: FloatArray
    radius: float
    material: int
    group: int
    line: int


@dataclass(frozen=True)
class ScGroup:
    """A GROUP: everything between a matching ``push`` and ``pop``.

    Groups stand in preorder (a parent before its children), and primitives in the order of the
    files, so a group is a range of both.

    Parameters
    ----------
    parent : int
        Index of the enclosing group, or -1.
    first_primitive, end_primitive : int
        Its primitives, those of its subgroups included.
    end_group : int
        First group in preorder that is not inside this one.
    bsphere_center : (3,) float
    bsphere_radius : float
        Bounding sphere in world space; its centre is that of the box.
    bbox : (2, 3) float
        Lowest and highest corner in world space.
    """

    parent: int
    first_primitive: int
    end_primitive: int
    end_group: int
    bsphere_center: FloatArray
    bsphere_radius: float
    bbox: FloatArray


@dataclass(frozen=True)
class ScScene:
    """What one or several ``.sc`` files say.

    Parameters
    ----------
    world_to_eye : (4, 4) float
        Eye space is right-handed: eye at the origin, looking down -z, +y up.
    fov_deg : float
        Full vertical angle of view. [degrees]
    width, height : int
        Size of the picture. [pixels]
    background, ambient : (3,) float
        Radiances.
    lights : tuple of ScLight
    materials : tuple of ScMaterial
        The first is the one in force before any ``use``.
    primitives : tuple of ScPolygon and ScSphere
        In the order of the files.
    groups : tuple of ScGroup
        In preorder.
    paths : tuple of Path
    """

    world_to_eye: FloatArray
    fov_deg: float
    width: int
    height: int
    background: FloatArray
    ambient: FloatArray
    lights: tuple[ScLight, ...]
    materials: tuple[ScMaterial, ...]
    primitives: tuple[ScPolygon | ScSphere, ...]
    groups: tuple[ScGroup, ...]
    paths: tuple[Path, ...]

    @property
    def world_to_screen(self) -> FloatArray:
        """(4, 4) float: the viewing matrix, viewport x perspective x world-to-eye.

        It takes (x, y, z, 1) to (x w, y w, z w, w) with x in 0..width to the right, y in 0..height
        downward and w the distance along the view axis.
        """
        return screen_matrix(self.fov_deg, self.width, self.height) @ self.world_to_eye


def screen_matrix(fov_deg: float, width: int, height: int) -> FloatArray:
    """(4, 4) float: from eye space to the screen; ``fov_deg`` is vertical, pixels are square."""
    focal = 0.5 * height / math.tan(math.radians(fov_deg) / 2)
    return np.asarray(
        [
            [focal, 0.0, -0.5 * width, 0.0],
            [0.0, -focal, -0.5 * height, 0.0],
            [0.0, 0.0, -1.0, -1.0],
            [0.0, 0.0, -1.0, 0.0],
        ]
    )


def _lookat(eye: FloatArray, at: FloatArray, up: FloatArray, words: Words) -> FloatArray:
    """World to eye: ``at`` on the -z axis, ``up`` in the half plane of +y."""
    back = eye - at
    distance = np.linalg.norm(back)
    if not distance > 0:
        words.fail("found the same point for eye and at of lookat, expected two")
    back /= distance
    right = np.cross(up, back)
    length = np.linalg.norm(right)
    if not length > 1e-9 * np.linalg.norm(up):
        words.fail("found an up vector of lookat along the line of sight, expected one across it")
    right /= length
    matrix = np.eye(4)
    matrix[:3, :3] = right, np.cross(back, right), back
    matrix[:3, 3] = -matrix[:3, :3] @ eye
    return matrix


def _rotation(axis: str, degrees: float) -> FloatArray:
    """Right-hand rotation about a coordinate axis; whole quarter turns are exact."""
    degrees = math.fmod(degrees, 360.0)
    if degrees % 90 == 0:
        cosine, sine = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(degrees // 90) % 4]
    else:
        cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    first = "xyz".index(axis)
    i, j = (first + 1) % 3, (first + 2) % 3
    matrix = np.eye(4)
    matrix[i, i] = matrix[j, j] = cosine
    matrix[i, j], matrix[j, i] = -sine, sine
    return matrix


class _Reader:
    """The state that runs on through the files of one scene."""

    def __init__(self) -> None:
        self.size = (512, 512)
        self.fov_deg = 45.0
        self.background = np.zeros(3)
        self.ambient = np.zeros(3)
        self.matrix = np.eye(4)
        self.world_to_eye: FloatArray | None = None
        self.lights: list[ScLight] = []
        self.materials = [ScMaterial("default", np.ones(3), 1.0, 0.0, 1.0, 0.0, 1.0, np.zeros(3))]
        self.names: dict[str, int] = {}
        self.material = 0
        self.primitives: list[ScPolygon | ScSphere] = []
        # Parent, first primitive and end primitive of every group opened.
        self.groups: list[list[int]] = []
        # Matrix, material, group and line of every push that is open in this file.
        self.stack: list[tuple[FloatArray, int, int, int]] = []
        self.group = -1

    def read(self, path: Path) -> None:
        """Read one file to its end."""
        words = Words(read_text(path), path, r"[{}]|[^\s{}]+")
        while words.peek() is not None:
            word = words.take("a statement")
            if word in _BEFORE_WORLD and self.world_to_eye is not None:
                words.fail(f"found {word!r} after 'world', expected it before; move it into the camera part")
            if word in _AFTER_WORLD and self.world_to_eye is None:
                words.fail(f"found {word!r} before 'world', expected the end of the camera part; write 'world' first")
            handler = getattr(self, f"_read_{word}", None) if word.isascii() and word.isalpha() else None
            if handler is None:
                words.unknown(word, f"one of {_STATEMENTS}")
            handler(words)
        if self.stack:
            words.fail("found a 'push' without its 'pop' at the end of the file, expected one", self.stack[-1][3])

    def finish(self, paths: tuple[Path, ...]) -> ScScene:
        """The scene, once every file is read."""
        if self.world_to_eye is None:
            raise SceneError("found no 'world' statement, expected one after the camera part; add it", path=paths[-1])
        return ScScene(
            world_to_eye=self.world_to_eye,
            fov_deg=self.fov_deg,
            width=self.size[0],
            height=self.size[1],
            background=self.background,
            ambient=self.ambient,
            lights=tuple(self.lights),
            materials=tuple(self.materials),
            primitives=tuple(self.primitives),
            groups=self._bounded_groups(),
            paths=paths,
        )

    def _bounded_groups(self) -> tuple[ScGroup, ...]:
        """The groups with their bounds."""
        low, high = np.empty((len(self.primitives), 3)), np.empty((len(self.primitives), 3))
        for index, primitive in enumerate(self.primitives):
            if isinstance(primitive, ScSphere):
                low[index], high[index] = primitive.center - primitive.radius, primitive.center + primitive.radius
            else:
                low[index], high[index] = primitive.vertices.min(axis=0), primitive.vertices.max(axis=0)
        # A vertex is a sphere of radius 0: one rule bounds both kinds.
        points = [p.center[None] if isinstance(p, ScSphere) else p.vertices for p in self.primitives]
        radii = [np.full(len(q), getattr(p, "radius", 0.0)) for p, q in zip(self.primitives, points, strict=True)]
        starts = np.concatenate([[0], np.cumsum([len(q) for q in points])]).astype(np.int64)
        point = np.concatenate(points) if points else np.empty((0, 3))
        radius = np.concatenate(radii) if radii else np.empty(0)
        # In preorder the first primitives never fall, and a group inside another starts before its end.
        end_groups = np.searchsorted([g[1] for g in self.groups], [g[2] for g in self.groups])
        found = []
        for (parent, first, end), end_group in zip(self.groups, end_groups, strict=True):
            box = np.stack([low[first:end].min(axis=0), high[first:end].max(axis=0)])
            center = 0.5 * box[0] + 0.5 * box[1]
            inside = slice(starts[first], starts[end])
            reach = np.linalg.norm(point[inside] - center, axis=1) + radius[inside]
            found.append(ScGroup(parent, first, end, int(end_group), center, float(reach.max()), box))
        return tuple(found)

    # The camera part.

    def _read_size(self, words: Words) -> None:
        width = words.integer("the width", 1, LARGEST_SIDE)
        self.size = (width, words.integer("the height", 1, LARGEST_SIDE))

    def _read_persp(self, words: Words) -> None:
        self.fov_deg = words.number("the vertical field of view in degrees", 1e-3, 179.9)

    def _read_lookat(self, words: Words) -> None:
        eye, at, up = (words.numbers(3, f"{name} of lookat") for name in ("eye", "at", "up"))
        self._multiply(_lookat(eye, at, up, words))

    def _read_world(self, words: Words) -> None:
        if self.world_to_eye is not None:
            words.fail("found a second 'world', expected one in all the files; remove it")
        linear = self.matrix[:3, :3]
        largest = np.abs(self.matrix).max()
        if not largest <= LARGEST or not abs(np.linalg.det(linear)) > 1e-12 * np.abs(linear).max() ** 3:
            words.fail("found a camera matrix that cannot be inverted, expected no scale by 0; mend the camera part")
        self.world_to_eye, self.matrix = self.matrix, np.eye(4)

    # Anywhere.

    def _read_background(self, words: Words) -> None:
        self.background = words.numbers(3, "background", 0.0)

    def _read_ambient(self, words: Words) -> None:
        self.ambient = words.numbers(3, "ambient", 0.0)

    def _multiply(self, matrix: FloatArray) -> None:
        with np.errstate(all="ignore"):  # an overflow is reported where a point meets it
            self.matrix = self.matrix @ matrix

    def _read_trans(self, words: Words) -> None:
        matrix = np.eye(4)
        matrix[:3, 3] = words.numbers(3, "trans")
        self._multiply(matrix)

    def _read_scale(self, words: Words) -> None:
        self._multiply(np.diag([*words.numbers(3, "scale"), 1.0]))

    def _read_rot(self, words: Words) -> None:
        axis = words.take("an axis")
        if axis not in ("x", "y", "z"):
            words.fail(f"found {words.quote(axis)} as the axis of rot, expected x, y or z")
        self._multiply(_rotation(axis, words.number("the angle of rot in degrees")))

    def _read_material(self, words: Words) -> None:
        name = words.take("the name of a material")
        if name in ("{", "}"):
            words.fail(f"found {name!r}, expected the name of a material")
        if words.take("'{'") != "{":
            words.fail(f"found no '{{' after the name of material {words.quote(name)}, expected one")
        start = words.line
        fields: dict[str, float | FloatArray] = {
            "color": np.ones(3), "kdr": 1.0, "ksr": 0.0, "e": 1.0, "ktr": 0.0, "eta": 1.0, "emission": np.zeros(3)
        }  # fmt: skip
        while True:
            if words.peek() is None:
                words.fail(f"found no '}}' that closes material {words.quote(name)}, expected one", start)
            field = words.take("a field")
            if field == "}":
                break
            if field not in fields:
                words.unknown(field, "a material field: color, kdr, ksr, e, ktr, eta, emission or '}'")
            if field in ("color", "emission"):
                fields[field] = words.numbers(3, field, 0.0)
            else:
                fields[field] = words.number(field, 1e-6 if field == "eta" else 0.0)
        self.names[name] = len(self.materials)
        self.materials.append(ScMaterial(name, **fields))  # type: ignore[arg-type]

    # The world part.

    def _read_push(self, words: Words) -> None:
        self.stack.append((self.matrix, self.material, self.group, words.line))
        self.groups.append([self.group, len(self.primitives), -1])
        self.group = len(self.groups) - 1

    def _read_pop(self, words: Words) -> None:
        if not self.stack:
            words.fail("found a 'pop' without its 'push' in this file, expected one; each file balances on its own")
        self.groups[self.group][2] = len(self.primitives)
        if self.groups[self.group][1] == len(self.primitives):
            self.groups.pop()  # nothing in it, so nothing opened after it is left either
        self.matrix, self.material, self.group, _ = self.stack.pop()

    def _read_use(self, words: Words) -> None:
        name = words.take("the name of a material")
        if name not in self.names:
            words.fail(f"found use of {words.quote(name)}, expected a material defined above")
        self.material = self.names[name]

    def _to_world(self, points: FloatArray, words: Words, line: int) -> FloatArray:
        with np.errstate(all="ignore"):
            moved = points @ self.matrix[:3, :3].T + self.matrix[:3, 3]
        if not (np.abs(moved) <= LARGEST).all():
            words.fail(f"found coordinates beyond {LARGEST:g} after the transformations, expected smaller ones", line)
        return moved

    def _read_light(self, words: Words) -> None:
        line = words.line
        position = self._to_world(words.numbers(3, "the position of light")[None], words, line)[0]
        self.lights.append(ScLight(position, words.numbers(3, "the radiance of light", 0.0)))

    def _read_polygon(self, words: Words) -> None:
        line = words.line
        count = words.integer("the number of vertices", 3, 10**6)
        vertices = self._to_world(words.points(count, 3, "vertex"), words, line)
        if self._mirrors():
            vertices = vertices[::-1]
        fault = ring_fault(vertices)
        if fault is not None:
            words.fail(f"found {fault}, expected a flat simple polygon", line)
        self.primitives.append(ScPolygon(np.ascontiguousarray(vertices), self.material, self.group, line))

    def _mirrors(self) -> bool:
        with np.errstate(all="ignore"):
            return bool(np.linalg.det(self.matrix[:3, :3]) < 0)

    def _read_sphere(self, words: Words) -> None:
        line = words.line
        center = self._to_world(words.numbers(3, "the centre of sphere")[None], words, line)[0]
        radius = words.number("the radius of sphere")
        if not radius > 0:
            words.fail(f"found the radius {radius:g} of a sphere, expected a number greater than 0", line)
        linear = self.matrix[:3, :3]
        largest = np.abs(linear).max()
        with np.errstate(all="ignore"):
            shape = linear / largest
            gram = shape.T @ shape
            square = np.trace(gram) / 3
            similar = bool((np.abs(gram - square * np.eye(3)) <= 1e-6 * square).all()) and largest > 0
        if not similar:
            words.fail(
                "found a sphere under a matrix that is no similarity, expected rotation, translation and uniform "
                "scale; make the three factors of scale equal",
                line,
            )
        radius = float(radius * math.sqrt(square) * largest)
        if not 0 < radius <= LARGEST:
            words.fail(f"found the radius {radius:g} of a sphere in world space, expected above 0, at most {LARGEST:g}")
        self.primitives.append(ScSphere(center, radius, self.material, self.group, line))


def read_sc(paths: str | Path | Iterable[str | Path]) -> ScScene:
    """Read one or several ``.sc`` files, in order, into one scene.

    The state (matrix, material, camera) runs on from file to file; ``push`` and ``pop`` balance in
    each.

    Parameters
    ----------
    paths : path or iterable of paths

    Raises
    ------
    SceneError
        If a file cannot be read or breaks a rule; the message names file and line.
    """
    files = tuple(Path(path) for path in ([paths] if isinstance(paths, (str, Path)) else paths))
    if not files:
        raise SceneError("found no scene file, expected one or more; name a .sc file")
    reader = _Reader()
    for path in files:
        reader.read(path)
    return reader.finish(files)


def _camera(scene: ScScene) -> Camera:
    """The camera as a pinhole.

    Raises
    ------
    SceneError
        If the camera matrix shears, mirrors or stretches, which a pinhole camera cannot say.
    """
    linear = np.linalg.inv(scene.world_to_eye[:3, :3])
    gram = linear.T @ linear
    square = float(np.trace(gram)) / 3
    scale = math.sqrt(square)
    if np.abs(gram - square * np.eye(3)).max() > 1e-6 * square or np.linalg.det(linear) < 0:
        raise SceneError(
            "found a camera matrix that mirrors, shears or stretches, expected rotation, translation and uniform "
            "scale; use lookat, trans and rot before 'world'",
            path=scene.paths[0],
        )
    eye = -linear @ scene.world_to_eye[:3, 3]
    return Camera(
        eye=eye,
        look_at=eye - linear[:, 2] / scale,
        up=np.asarray(linear[:, 1] / scale, dtype=np.float64),
        fov_deg=scene.fov_deg,
        width=scene.width,
        height=scene.height,
    )


def load_scene(path: str | Path | Iterable[str | Path], *, facet_error: float = 0.02) -> Scene:
    """A ``.sc`` scene as the record that radiosity and the other renderers read.

    The polygons of one group and one material make a surface; each sphere makes one, tessellated
    with the exact sphere beside it.  Reflectance is ``color * kdr``, ``specular`` is ``ksr`` in
    every band, ``ktr`` the transmittance, cut where it and the reflectance exceed 1; ``emission`` is the
    emitted radiosity.  Surfaces are one-sided.  A light becomes a
    point light of radiant intensity I_i [W/sr], which falls with the square of the distance where
    the ray caster's does not; the ambient radiance is left out, being what radiosity computes.

    Parameters
    ----------
    path : path or iterable of paths
    facet_error : float
        Largest distance between a sphere and its facets, as a share of its radius.

    Raises
    ------
    SceneError
        As :func:`read_sc`; also for a reflectance, ``ksr`` or ``ktr`` above 1, and for a camera
        that a pinhole cannot express.
    """
    source = read_sc(path)
    materials: dict[int, Material] = {}

    def material(primitive: ScPolygon | ScSphere) -> Material:
        index = primitive.material
        if index not in materials:
            said = source.materials[index]
            for name, value in (("color * kdr", said.color.max() * said.kdr), ("ksr", said.ksr), ("ktr", said.ktr)):
                if value > 1:
                    raise SceneError(
                        f"found {name} = {value:g} in material {said.name!r}, expected 0 to 1; lower it",
                        path=source.paths[-1],
                        line=primitive.line,
                    )
            reflectance = said.color * said.kdr
            materials[index] = Material(
                name=said.name,
                reflectance=reflectance,
                emission=said.emission,
                specular=np.full(3, said.ksr),
                exponent=said.e,
                transmittance=np.minimum(said.ktr, 1.0 - reflectance),
                ior=said.eta,
            )
        return materials[index]

    # A key of two numbers is a set of polygons, one of three a sphere.
    members: dict[tuple[int, ...], list[ScPolygon | ScSphere]] = {}
    for index, primitive in enumerate(source.primitives):
        key: tuple[int, ...] = (primitive.group, primitive.material)
        members.setdefault((*key, index) if isinstance(primitive, ScSphere) else key, []).append(primitive)
    surfaces = []
    for key, found in members.items():
        first = found[0]
        name = f"{material(first).name}" + ("" if first.group < 0 else f", group {first.group}")
        if isinstance(first, ScSphere):
            surfaces.append(
                sphere_surface(
                    f"{name}, sphere {key[2]}", material(first), first.center, first.radius, facet_error=facet_error
                )
            )
        else:
            rings = [polygon.vertices for polygon in found if isinstance(polygon, ScPolygon)]
            surfaces.append(Surface.from_polygons(name, material(first), rings))
    return Scene(
        name=source.paths[-1].stem,
        surfaces=tuple(surfaces),
        lights=tuple(
            Light(f"light {index}", "point", light.radiance, position=light.position)
            for index, light in enumerate(source.lights)
        ),
        camera=_camera(source),
        background=source.background,
        path=source.paths[-1],
        notes=_notes(source, facet_error),
    )


def _notes(source: ScScene, facet_error: float) -> tuple[str, ...]:
    """What :func:`load_scene` left out or changed."""
    notes = []
    if any(isinstance(primitive, ScSphere) for primitive in source.primitives):
        notes.append(f"spheres are facets that lie within {facet_error:g} of their radius")
    if source.lights:
        notes.append("point lights fall with the square of the distance, which those of raycast do not")
    if source.ambient.any():
        notes.append("the ambient radiance was left out: radiosity computes what it stands for")
    return tuple(notes)
