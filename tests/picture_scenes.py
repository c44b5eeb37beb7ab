"""Small scenes and cameras for the tests of pictures."""

from __future__ import annotations

import numpy as np

import radiosity
from workbench.render.camera import PinholeRays
from workbench.scene.library import box_surface, diffuse
from workbench.scene.model import Camera, Scene, Surface

LIGHT = [[-0.5, -0.5, 2], [-0.5, 0.5, 2], [0.5, 0.5, 2], [0.5, -0.5, 2]]
"""The light of light/quad-row in truth.json, facing down, radiance 1."""


def camera(eye, look_at, *, up=(0, 0, 1), fov=40.0, width=16, height=16) -> PinholeRays:
    vectors = (np.asarray(v, dtype=float) for v in (eye, look_at, up))
    return PinholeRays.from_camera(Camera(*vectors, fov, width, height))


def straight_down(x, y, *, height=0.5, width=0.02, pixels=3) -> PinholeRays:
    """A camera that sees a square of the floor about (x, y), its middle pixel's middle exactly there."""
    fov = 2 * np.degrees(np.arctan(0.5 * width / height))
    return camera((x, y, height), (x, y, 0), up=(0, 1, 0), fov=fov, width=pixels, height=pixels)


def lit_floor(*occluders, reflectance=0.5, bands=1) -> Scene:
    """A floor under the light; only black occluders, so that there is no indirect light."""
    floor = [[-6, -6, 0], [6, -6, 0], [6, 6, 0], [-6, 6, 0]]
    black = diffuse("black", 0.0, bands=bands)
    return Scene(
        "lit floor",
        (
            Surface.from_polygons("floor", diffuse("grey", reflectance, bands=bands), [np.array(floor, float)]),
            Surface.from_polygons("light", diffuse("light", 0.0, np.pi, bands=bands), [np.array(LIGHT, float)]),
            *(Surface.from_polygons(f"occluder{k}", black, [np.array(o, float)]) for k, o in enumerate(occluders)),
        ),
        background=np.zeros(bands),
        bands=bands,
    )


def furnace(reflectance=0.8, *, inner=True) -> Scene:
    """A closed box of one material with a block of the same inside; radiosity is 1 / (1 - rho) everywhere."""
    grey = diffuse("grey", reflectance, 1.0)
    parts = [box_surface("room", grey, (0, 0, 0), (3, 2, 2), inward=True)]
    if inner:
        parts.append(box_surface("block", grey, (1, 0.6, 0.4), (1.6, 1.2, 1.1)))
    return Scene("furnace", tuple(parts), background=np.zeros(1), bands=1, closed=True)


def solved(scene, **options) -> radiosity.Solution:
    return radiosity.solve(scene, **({"elements": 100, "tolerance": 0.01, "workers": 1} | options))
