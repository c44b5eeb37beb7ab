"""Small scenes for the tests of the tracer: a camera that looks straight down at a floor."""

from __future__ import annotations

import numpy as np

from workbench.scene.library import diffuse
from workbench.scene.model import Camera, Light, Material, Scene, Surface


def material(name="matter", reflectance=0.0, **more) -> Material:
    """A grey material of one band, both sides alike."""
    values = {"specular": 0.0, "transmittance": 0.0, "emission": 0.0} | {
        key: more.pop(key) for key in ("specular", "transmittance", "emission") if key in more
    }
    bands = {key: np.array([float(value)]) for key, value in values.items()}
    more = {"exponent": np.inf, "two_sided": True} | more
    return Material(name, np.array([float(reflectance)]), **bands, **more)


def square(low, high, z) -> np.ndarray:
    """A rectangle at height z, front up."""
    (x0, y0), (x1, y1) = low, high
    return np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]], dtype=float)


def floor(side=40.0, z=0.0, matter=None) -> Surface:
    """A square floor about the z axis."""
    return Surface.from_polygons(
        "floor", matter or diffuse("floor", 1.0), [square((-side / 2, -side / 2), (side / 2, side / 2), z)]
    )


def look_down(pixels, pitch, height=10.0, centre=(0.0, 0.0)) -> Camera:
    """A camera straight above whose pixels are ``pitch`` wide on the floor z = 0; x right, y up."""
    x, y = centre
    angle = 2 * np.degrees(np.arctan(0.5 * pixels * pitch / height))
    return Camera(np.array([x, y, height]), np.array([x, y, 0.0]), np.array([0.0, 1.0, 0.0]), angle, pixels, pixels)


def sun(irradiance=np.pi, direction=(0.0, 0.0, -1.0)) -> Light:
    """A directional light; by default a white floor below has radiance 1."""
    return Light("sun", "directional", np.array([irradiance]), direction=np.asarray(direction, dtype=float))


def scene(surfaces, lights=(), camera=None, background=0.0) -> Scene:
    """One band."""
    return Scene("test", tuple(surfaces), tuple(lights), camera, background=np.array([background]), bands=1)
