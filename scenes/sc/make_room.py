"""Write ``room.sc``: a room with two fractals in it, 2,457 polygons and spheres.

Run ``python scenes/sc/make_room.py``; the file goes beside this script.  The count is the one that
the ray-casting assignment gives for its own lost ``room.sc``; the room is ours:

======================================================  =====
walls, ceiling and lamp                                     6
floor of hexagons and half hexagons                       313
star on the floor, a concave polygon                        1
two plinths                                                10
sphereflake after Haines: 1 + 9 + 81 + 729 spheres        820
Sierpinski tetrahedron of depth 4: 256 tetrahedra       1,024
frieze of tiles along three walls: what is missing        283
======================================================  =====

Each part is a GROUP and so is each branch of a fractal, so the bounding volumes follow its growth.
"""

from __future__ import annotations

import math
from pathlib import Path

PRIMITIVES = 2457
HALF, HEIGHT = 4.0, 3.2
HEXAGON = 0.3

HEADER = """\
# A room with a sphereflake and a Sierpinski tetrahedron: 2,457 polygons and spheres.
# Written by make_room.py.  Words and rules are those of a reconstructed language, see
# workbench/scene/sc.py.
size 512 512
background 0 0 0
ambient .2 .2 .21
persp 52
lookat 3.3 2.1 3.7  -.35 1.05 -.7  0 1 0
world
light 1.2 3 1.5  .52 .5 .44
light -3 2.4 3  .2 .22 .28
light 3.4 1.2 -1  .16 .13 .1
material wall   { color .72 .7 .64  kdr 1  ksr 0  e 1 }
material lamp   { color .9 .9 .85  kdr 1  ksr 0  e 1  emission 8 8 7.2 }
material slate  { color .36 .42 .46  kdr .95  ksr .08  e 12 }
material clay   { color .62 .4 .3  kdr .95  ksr .08  e 12 }
material sand   { color .78 .7 .55  kdr .95  ksr .08  e 12 }
material star   { color .86 .72 .3  kdr .9  ksr .2  e 20 }
material stone  { color .5 .5 .53  kdr 1  ksr 0  e 1 }
material copper { color .85 .48 .3  kdr .7  ksr .5  e 40 }
material amber  { color .95 .68 .2  kdr .75  ksr .4  e 40 }
material cream  { color .9 .88 .8  kdr .75  ksr .4  e 40 }
material teal   { color .2 .6 .6  kdr .75  ksr .4  e 40 }
material tetra  { color .45 .62 .9  kdr .85  ksr .25  e 25 }
material blue   { color .2 .3 .55  kdr .9  ksr .2  e 20 }
material white  { color .88 .88 .86  kdr .9  ksr .2  e 20 }
"""


def number(value: float) -> str:
    """A coordinate, short."""
    return f"{value:.7g}" if abs(value) > 1e-9 else "0"


def polygon(points: list[tuple[float, float, float]]) -> str:
    return f"polygon {len(points)}  " + "  ".join(" ".join(number(c) for c in point) for point in points)


def shell() -> list[str]:
    """Four walls, the ceiling and a lamp below it."""
    h, top = HALF, HEIGHT
    ground = [(-h, h), (h, h), (h, -h), (-h, -h)]
    lines = ["push  # shell", "use wall"]
    for (x0, z0), (x1, z1) in zip(ground, ground[1:] + ground[:1], strict=True):
        lines.append(polygon([(x1, 0, z1), (x0, 0, z0), (x0, top, z0), (x1, top, z1)]))
    lines.append(polygon([(x, top, z) for x, z in reversed(ground)]))
    lines += ["use lamp", polygon([(x * 0.2, top - 0.02, z * 0.2) for x, z in reversed(ground)]), "pop"]
    return lines


def floor() -> list[str]:
    """Hexagons in three colours, cut off at the walls; one group a row."""
    across, deep = HEXAGON * math.sqrt(3), HEXAGON * 1.5
    rows = math.ceil(HALF / deep)
    columns = math.ceil(HALF / across) + 1
    lines = ["push  # floor"]
    for row in range(-rows, rows + 1):
        lines.append("push")
        for column in range(-columns, columns + 1):
            center = ((column + 0.5 * (row % 2)) * across, row * deep)
            corners = [
                (center[0] + HEXAGON * math.sin(k * math.pi / 3), center[1] + HEXAGON * math.cos(k * math.pi / 3))
                for k in range(6)
            ]
            for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
                corners = cut(corners, axis, sign)
            if len(corners) > 2:
                # Colours so that no two neighbours agree.
                color = ("slate", "clay", "sand")[(column - row // 2 + 2 * row) % 3]
                lines += [f"use {color}", polygon([(x, 0, z) for x, z in corners])]
        lines.append("pop")
    return [*lines, "pop"]


def cut(corners: list[tuple[float, float]], axis: int, sign: int) -> list[tuple[float, float]]:
    """The part of a convex polygon of the floor inside one wall; slivers under a millimetre are dropped."""
    kept = []
    for one, two in zip(corners, corners[1:] + corners[:1], strict=True):
        a, b = HALF - sign * one[axis], HALF - sign * two[axis]
        if a >= 0:
            kept.append(one)
        if a * b < 0:
            share = a / (a - b)
            kept.append((one[0] + share * (two[0] - one[0]), one[1] + share * (two[1] - one[1])))
    if len(kept) > 2 and min(max(p[k] for p in kept) - min(p[k] for p in kept) for k in (0, 1)) > 1e-3:
        return kept
    return []


def star() -> list[str]:
    """An eight-pointed star let into the floor, as one concave polygon."""
    points = []
    for k in range(16):
        radius = 1.0 if k % 2 == 0 else 0.5
        points.append((radius * math.sin(k * math.pi / 8), 0.004, radius * math.cos(k * math.pi / 8)))
    return ["push  # star", "trans .55 0 .75", "use star", polygon(points), "pop"]


def plinth(x: float, z: float, half: float, height: float) -> list[str]:
    """A square block without a bottom."""
    ring = [(-half, half), (half, half), (half, -half), (-half, -half)]
    lines = ["push  # plinth", f"trans {number(x)} 0 {number(z)}", "rot y 20", "use stone"]
    for (x0, z0), (x1, z1) in zip(ring, ring[1:] + ring[:1], strict=True):
        lines.append(polygon([(x0, 0, z0), (x1, 0, z1), (x1, height, z1), (x0, height, z0)]))
    return [*lines, polygon([(a, height, b) for a, b in ring]), "pop"]


def flake(depth: int, level: int = 0) -> list[str]:
    """A unit sphere with nine spheres of a third of its size on it, and so on."""
    lines = [f"use {('copper', 'amber', 'cream', 'teal')[level]}", "sphere 0 0 0 1"]
    if level == depth:
        return lines
    # Six round the equator and three above; the trunk points along +y.
    for tilt, turns in ((90, range(0, 360, 60)), (35.2643897, range(30, 390, 120))):
        for turn in turns:
            lines += [
                "push",
                f"rot y {turn} rot z {-tilt:.9g} trans 0 1.333333333 0 scale .333333333 .333333333 .333333333",
            ]
            lines += flake(depth, level + 1)
            lines.append("pop")
    return lines


def sierpinski(depth: int) -> list[str]:
    """A tetrahedron of circumradius 1 on its base, made of four of half its size, and so on."""
    base = [(2 * math.sqrt(2) / 3 * math.sin(a), -1 / 3, 2 * math.sqrt(2) / 3 * math.cos(a)) for a in
            (0, 2 * math.pi / 3, 4 * math.pi / 3)]  # fmt: skip
    corners = [(0.0, 1.0, 0.0), *base]
    if depth == 0:
        a, b, c, d = corners
        return [polygon(face) for face in ([a, b, c], [a, c, d], [a, d, b], [b, d, c])]
    lines = []
    for corner in corners:
        lines += ["push", "trans " + " ".join(number(0.5 * v) for v in corner) + "  scale .5 .5 .5"]
        lines += sierpinski(depth - 1)
        lines.append("pop")
    return lines


def frieze(count: int) -> list[str]:
    """``count`` tiles, blue and white by turns, in a band along the back, the left and the right wall."""
    low, high, off = 2.55, 2.75, 0.01
    lines = ["push  # frieze"]
    for wall, (turn, share) in enumerate(((0, count // 3), (90, count // 3), (-90, count - 2 * (count // 3)))):
        lines += ["push", f"rot y {turn}"]
        step = 2 * HALF / share
        for k in range(share):
            x0, x1 = -HALF + (k + 0.08) * step, -HALF + (k + 0.92) * step
            lines += [f"use {('blue', 'white')[(k + wall) % 2]}"]
            lines.append(polygon([(x, y, -HALF + off) for x, y in ((x0, low), (x1, low), (x1, high), (x0, high))]))
        lines.append("pop")
    return [*lines, "pop"]


def room() -> str:
    """The text of ``room.sc``."""
    lines = shell() + floor() + star()
    lines += plinth(-1.45, -0.9, 0.5, 0.55) + plinth(0.75, -1.7, 0.6, 0.35)
    lines += ["push  # sphereflake", "trans -1.45 1.2 -.9", "rot y 15", "scale .65 .65 .65", *flake(3), "pop"]
    lines += ["push  # Sierpinski tetrahedron", "trans .75 .68 -1.7", "rot y 40", "use tetra"]
    lines += ["scale .98 .98 .98", *sierpinski(4), "pop"]
    lines += frieze(PRIMITIVES - sum(line.startswith(("polygon", "sphere")) for line in lines))
    return HEADER + "\n".join(lines) + "\n"


if __name__ == "__main__":
    Path(__file__).with_name("room.sc").write_text(room(), encoding="utf-8")
