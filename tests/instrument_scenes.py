"""Scenes for the tests of tracers and of Woo's loops: hand-made ones and random nasty ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import check_polygon
from workbench.scene.model import Material, Scene, Surface

TRUTH = Path(__file__).resolve().parents[1] / ".." / "shared" / "truth" / "truth.json"

UNIT_SQUARE_LIGHT = np.array([[-0.5, -0.5, 2], [-0.5, 0.5, 2], [0.5, 0.5, 2], [0.5, -0.5, 2.0]])
"""The light of most shadow truths, above the origin; it faces down."""

FAR = 100.0
"""Where half-planes end."""


def truth(name: str):
    """The value of a shared truth; skips the test where the shared folder is absent."""
    if not TRUTH.exists():
        pytest.skip(f"the shared truths are not beside this checkout ({TRUTH})")
    return next(case["value"] for case in json.loads(TRUTH.read_text())["cases"] if case["name"] == name)


def material(transmittance=0.0, bands: int = 1) -> Material:
    zero = np.zeros(bands)
    return Material("paint", zero + 0.5, zero, zero, 1.0, zero + transmittance)


def geometry_of(*surfaces, transmittance=0.0, bands: int = 1) -> Geometry:
    """A geometry of surfaces, each a list of polygons (n, 3); one transmittance, or one a surface."""
    through = np.broadcast_to(np.asarray(transmittance, dtype=float), (len(surfaces),))
    return Geometry.from_scene(
        Scene(
            "test",
            tuple(
                Surface.from_polygons(f"surface {i}", material(tau, bands), [np.asarray(p, float) for p in polygons])
                for i, (polygons, tau) in enumerate(zip(surfaces, through, strict=True))
            ),
            bands=bands,
        )
    )


def rectangle(x0, x1, y0, y1, z) -> np.ndarray:
    """A rectangle parallel to z = 0, facing up."""
    return np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]], dtype=float)


def box_triangles(low, high, splits: int = 1) -> np.ndarray:
    """A closed box (t, 3, 3); each face is a lattice of 2 splits^2 triangles with shared corners."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    steps = np.linspace(0.0, 1.0, splits + 1)
    triangles = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (low, high):
            for i in range(splits):
                for j in range(splits):
                    corner = np.empty((2, 2, 3))
                    corner[..., axis] = side[axis]
                    for a in range(2):
                        for b in range(2):
                            corner[a, b, u] = low[u] + steps[i + a] * (high[u] - low[u])
                            corner[a, b, v] = low[v] + steps[j + b] * (high[v] - low[v])
                    triangles += [
                        [corner[0, 0], corner[1, 0], corner[1, 1]],
                        [corner[0, 0], corner[1, 1], corner[0, 1]],
                    ]
    return np.array(triangles)


def nasty_polygons(rng: np.random.Generator, count: int, anchors: np.ndarray) -> list[np.ndarray]:
    """Random convex polygons of the kinds that break cullers.

    Slivers, polygons with corners on a coarse lattice (coplanar, touching and coincident ones
    among them), polygons that share corners with ``anchors`` (points to be shaded, corners of
    lights), that straddle everything, and that lie far away.
    """
    polygons: list[np.ndarray] = []
    lattice = np.arange(-4, 9) / 4.0
    while len(polygons) < count:
        kind = rng.integers(0, 8)
        if kind == 0:  # anything
            polygon = rng.uniform(-1.0, 2.0, (3, 3))
        elif kind == 1:  # small
            polygon = rng.uniform(-0.5, 1.5, 3) + rng.uniform(-0.2, 0.2, (3, 3))
        elif kind == 2:  # on the lattice
            polygon = rng.choice(lattice, (3, 3))
        elif kind == 3:  # an axis-aligned rectangle on the lattice
            axis = rng.integers(0, 3)
            low, size = rng.choice(lattice, 3), rng.choice([0.25, 0.5, 1.0, 2.0], 2)
            polygon = np.tile(low, (4, 1))
            polygon[[1, 2], (axis + 1) % 3] += size[0]
            polygon[[2, 3], (axis + 2) % 3] += size[1]
        elif kind == 4:  # a sliver 2^-13 wide
            start, end = rng.uniform(-1.0, 2.0, (2, 3))
            polygon = np.array([start, end, end + 2.0**-13 * rng.normal(size=3)])
        elif kind == 5:  # touching: corners of what is there already
            pool = np.concatenate([anchors, *polygons]) if polygons else anchors
            polygon = pool[rng.integers(0, len(pool), 3)] + rng.choice([0.0, 1.0], (3, 1)) * rng.choice(lattice, (3, 3))
        elif kind == 6:  # straddling: huge, through the middle
            polygon = rng.uniform(-20.0, 20.0, (3, 3))
            polygon += rng.uniform(0.0, 1.0, 3) - polygon.mean(axis=0)
        else:  # far away
            polygon = rng.uniform(-1.0, 1.0, (3, 3)) + 10.0 ** rng.integers(2, 6) * rng.normal(size=3)
        if polygons and rng.random() < 0.1:
            polygon = polygons[rng.integers(0, len(polygons))][::-1].copy()  # coincident, turned round
        if check_polygon([polygon]) is None:
            polygons.append(polygon)
    return polygons


def line_samples(rng: np.random.Generator, ends: np.ndarray, points: int, rays: int) -> np.ndarray:
    """(points, rays, 3) samples of a line, its ends and middle among them."""
    share = rng.random((points, rays, 1))
    share[rng.random(share.shape) < 0.2] = 0.5
    share[rng.random(share.shape) < 0.1] = 0.0
    share[rng.random(share.shape) < 0.1] = 1.0
    return (1.0 - share) * ends[0] + share * ends[1]


def polygon_samples(rng: np.random.Generator, corners: np.ndarray, points: int, rays: int) -> np.ndarray:
    """(points, rays, 3) samples of a convex polygon, some on its edges and corners."""
    share = rng.exponential(size=(points, rays, len(corners)))
    on_edge = rng.random((points, rays)) < 0.2
    share[on_edge, 2:] = 0.0
    share[rng.random((points, rays)) < 0.1, 1:] = 0.0
    share /= share.sum(axis=2, keepdims=True)
    return share @ corners


def convex_light(rng: np.random.Generator) -> np.ndarray:
    """A convex polygon of 3 to 6 corners in a lattice plane or a random one."""
    edges = rng.integers(3, 7)
    angle = np.sort(rng.choice(24, edges, replace=False)) * (2.0 * np.pi / 24.0)
    flat = np.stack([np.cos(angle), np.sin(angle)], axis=1) * rng.uniform(0.2, 1.0)
    if rng.random() < 0.5:
        frame = np.eye(3)[:2]
    else:
        frame = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2]
    return rng.choice([0.0, 0.5, 1.5], 3) + flat @ frame
