"""The closed room with two boxes in it, all triangles: the scene on which view-factor codes are compared."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from workbench.scene.library import diffuse
from workbench.scene.model import Scene, Surface

ROOM = ((0.0, 0.0, 0.0), (4.0, 4.0, 3.0))
BOXES = (((0.5, 0.5, 0.0), (1.5, 1.5, 2.0)), ((2.5, 2.0, 0.0), (3.5, 3.0, 1.0)))


def _faces(low, high, inward):
    (x0, y0, z0), (x1, y1, z1) = low, high
    faces = {
        "-x": [[x0, y0, z0], [x0, y0, z1], [x0, y1, z1], [x0, y1, z0]],
        "+x": [[x1, y0, z0], [x1, y1, z0], [x1, y1, z1], [x1, y0, z1]],
        "-y": [[x0, y0, z0], [x1, y0, z0], [x1, y0, z1], [x0, y0, z1]],
        "+y": [[x0, y1, z0], [x0, y1, z1], [x1, y1, z1], [x1, y1, z0]],
        "-z": [[x0, y0, z0], [x0, y1, z0], [x1, y1, z0], [x1, y0, z0]],
        "+z": [[x0, y0, z1], [x1, y0, z1], [x1, y1, z1], [x0, y1, z1]],
    }
    return {name: np.asarray(face[::-1] if inward else face) for name, face in faces.items()}


def _rectangles():
    """Names and rectangles; the floor is cut out under the boxes, so that nothing is covered."""
    for name, face in _faces(*ROOM, True).items():
        if name != "-z":
            yield "room" + name, face
    xs = sorted({ROOM[0][0], ROOM[1][0], *(corner[0] for box in BOXES for corner in box)})
    ys = sorted({ROOM[0][1], ROOM[1][1], *(corner[1] for box in BOXES for corner in box)})
    for x0, x1 in pairwise(xs):
        for y0, y1 in pairwise(ys):
            if any(low[0] <= x0 and x1 <= high[0] and low[1] <= y0 and y1 <= high[1] for low, high in BOXES):
                continue
            yield "room-z", np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]])
    for number, box in enumerate(BOXES, 1):
        for name, face in _faces(*box, False).items():
            if name != "-z":
                yield f"box{number}{name}", face


def _edge(name, edge, finer):
    return edge / finer if name.startswith("box") else edge


def _steps(face, edge, up):
    sides = np.linalg.norm(face[1] - face[0]), np.linalg.norm(face[3] - face[0])
    return [max(1, int(np.floor(side / edge + up - 1e-9))) for side in sides]


def _triangles(face, edge, up):
    nu, nv = _steps(face, edge, up)
    u, v = np.meshgrid(np.linspace(0, 1, nu + 1), np.linspace(0, 1, nv + 1))
    u, v = u[..., None], v[..., None]
    grid = face[0] * (1 - u) * (1 - v) + face[1] * u * (1 - v) + face[2] * u * v + face[3] * (1 - u) * v
    for j in range(nv):
        for i in range(nu):
            a, b, c, d = grid[j, i], grid[j, i + 1], grid[j + 1, i + 1], grid[j + 1, i]
            yield from ([a, b, c], [a, c, d]) if (i + j) % 2 == 0 else ([a, b, d], [b, c, d])


def closed_room(edge: float, up: float = 1.0, finer: float = 1.0) -> Scene:
    """The room in triangles whose legs are about ``edge``: at most that if ``up`` is 1, the nearest number if 0.5.

    Those of the boxes are ``finer`` times shorter.
    """
    surfaces: dict[str, list] = {}
    for name, face in _rectangles():
        surfaces.setdefault(name, []).extend(_triangles(face, _edge(name, edge, finer), up))
    material = diffuse("paint", 0.5)
    parts = tuple(
        Surface.from_mesh(
            name,
            material,
            np.asarray(triangles).reshape(-1, 3),
            np.arange(3 * len(triangles)).reshape(-1, 3),
        )
        for name, triangles in surfaces.items()
    )
    return Scene(f"closed room with two boxes, edge {edge:g}", parts, bands=1, closed=True)


def room_of(triangles: int) -> Scene:
    """The room in as nearly ``triangles`` triangles as its grids allow."""

    def count(choice):
        edge, up, finer = choice
        return sum(2 * int(np.prod(_steps(face, _edge(name, edge, finer), up))) for name, face in _rectangles())

    choices = [
        (edge, up, finer)
        for finer in (1.0, 1.1, 1.25, 1.5)
        for up in (0.5, 0.75, 1.0)
        for edge in np.geomspace(0.05, 3.0, 400)
    ]
    return closed_room(*min(choices, key=lambda choice: abs(count(choice) - triangles)))
