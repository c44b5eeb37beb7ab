"""Rays led through mirrors, glass and bundles to the diffuse surfaces that a final gather lights."""

from __future__ import annotations

import numpy as np
import pytest
from trace_scenes import floor, look_down, material, scene, square, sun

from workbench.errors import InputError
from workbench.geometry.flat import Geometry
from workbench.render.camera import PinholeRays
from workbench.render.textures import Checker
from workbench.render.trace import TraceOptions, Tracer
from workbench.scene.model import Light, Surface
from workbench.shadow.lights import lights_of_scene
from workbench.shadow.occlusion import Shader

DOWN = np.array([[0.0, 0.0, -1.0]])


def sheet(name, matter, low, high, z):
    return Surface.from_polygons(name, matter, [square(low, high, z)])


def mixed_scene():
    """Diffuse, mirroring, glossy and clear sheets over one another, under a sun and a lamp."""
    surfaces = [
        floor(matter=material("floor", 0.7, specular=0.2, exponent=40.0)),
        sheet("mirror", material("mirror", 0.0, specular=0.9), (-3, -3), (-1, 3), 0.5),
        sheet("glass", material("glass", 0.05, specular=0.1, transmittance=0.8, ior=1.4), (-1, -3), (2, 0), 1.0),
        sheet("lid", material("lid", 0.4), (0, 0.5), (2, 2), 3.0),
        sheet("back", material("back", 0.5, two_sided=False), (-3, 2), (3, 3), 2.0),
    ]
    lamp = Light("lamp", "point", np.array([30.0]), position=np.array([-1.0, 1.0, 5.0]))
    return scene(surfaces, [sun(direction=(0.3, 0.1, -1.0)), lamp], look_down(48, 0.15), background=0.3)


@pytest.mark.parametrize("bundle", [1, 4])
@pytest.mark.parametrize("workers", [1, 3])
def test_ends_with_their_direct_light_make_the_traced_picture(bundle, workers):
    """radiance = what is seen + sum of throughput rho / pi E, with E by the shadow module's own estimate."""
    whole = mixed_scene()
    options = TraceOptions(bundle=bundle, ambient=0.05, seed=3)
    tracer = Tracer(whole, options, textures={"floor": Checker(0.4, 1.0, 0.3, "xy")}, workers=workers)
    rays = PinholeRays.from_camera(whole.camera)
    along = rays.row_directions(0, rays.height)
    ends, plain = tracer.trace_to_diffuse(rays.eye, along), tracer.trace(rays.eye, along)
    geometry = Geometry.from_scene(whole)
    lights = lights_of_scene(whole, geometry)
    found = Shader(geometry, 1).estimate(ends.points, ends.normals, lights, own_polygon=ends.polygon)
    np.testing.assert_allclose(ends.radiance_with(found.irradiance), plain.radiance, rtol=1e-9)
    assert ends.depth.max() == 3
    assert ends.tally.reflection.shot == plain.tally.reflection.shot
    assert ends.tally.refraction.shot == plain.tally.refraction.shot
    assert 0 < ends.tally.shadow.shot < plain.tally.shadow.shot


def test_a_path_by_hand():
    """Down through glass of 0.8 at z = 1, a mirror of 0.5 at z = 0, up to a ceiling of 0.4 at z = 2."""
    surfaces = [
        sheet("mirror", material("mirror", 0.25, specular=0.5), (-9, -9), (9, 9), 0.0),
        sheet("glass", material("glass", transmittance=0.8), (-9, -9), (9, 9), 1.0),
        sheet("ceiling", material("ceiling", 0.4), (-9, -9), (9, 9), 2.0),
    ]
    ends = Tracer(scene(surfaces)).trace_to_diffuse([0.5, 0.25, 1.5], DOWN)
    np.testing.assert_array_equal(ends.surface, [0, 2])
    np.testing.assert_array_equal(ends.polygon, [0, 2])
    np.testing.assert_array_equal(ends.ray, [0, 0])
    np.testing.assert_array_equal(ends.depth, [1, 3])
    np.testing.assert_allclose(ends.throughput[:, 0], [0.8, 0.8 * 0.5 * 0.8])
    np.testing.assert_allclose(ends.reflectance[:, 0], [0.25, 0.4])
    np.testing.assert_allclose(ends.points, [[0.5, 0.25, 0.0], [0.5, 0.25, 2.0]], atol=1e-12)
    np.testing.assert_allclose(ends.normals, [[0, 0, 1], [0, 0, -1]])
    np.testing.assert_array_equal(ends.front, [True, False])
    received = np.array([[2.0], [3.0]])
    expected = (0.8 * 0.25 * 2 + 0.32 * 0.4 * 3) / np.pi
    assert ends.radiance_with(received)[0, 0] == pytest.approx(expected)


def test_emission_background_and_black_backs():
    lamp = sheet("lamp", material("lamp", emission=2 * np.pi, two_sided=False), (-1, -1), (1, 1), 0.0)
    tracer = Tracer(scene([lamp], background=0.7))
    ends = tracer.trace_to_diffuse([[0, 0, 1.0], [0, 0, -1.0], [5, 0, 1.0]], [[0, 0, -1.0], [0, 0, 1.0], [0, 0, -1.0]])
    np.testing.assert_allclose(ends.radiance[:, 0], [2.0, 0.0, 0.7])
    assert len(ends.ray) == 0
    assert ends.radiance_with(np.empty((0, 1))).shape == (3, 1)


def test_furnace_of_ends():
    """Shares add up: with irradiance pi / rho everywhere and a surround of 1 a sheet sends back all of 1."""
    matter = material("sheet", 0.3, specular=0.45, transmittance=0.25, exponent=20.0)
    tracer = Tracer(scene([floor(matter=matter)], background=1.0), TraceOptions(bundle=8))
    ends = tracer.trace_to_diffuse([0, 0, 1.0], np.repeat([[0.6, 0.0, -0.8]], 50, axis=0))
    assert (ends.depth == 0).all()
    np.testing.assert_allclose(ends.radiance_with(np.full((50, 1), np.pi)), 1.0, rtol=1e-12)


def test_many_blocks_keep_their_rays():
    tracer = Tracer(scene([floor(matter=material("floor", 0.5, specular=0.5))]), workers=2)
    x = np.linspace(-5, 5, 40000)
    ends = tracer.trace_to_diffuse(np.column_stack([x, 0 * x, 0 * x + 1]), np.repeat(DOWN, len(x), axis=0))
    np.testing.assert_array_equal(ends.ray, np.arange(len(x)))
    np.testing.assert_allclose(ends.points[:, 0], x, atol=1e-12)


def test_wrong_shapes_are_refused():
    tracer = Tracer(scene([floor()]))
    with pytest.raises(InputError, match="keys"):
        tracer.trace_to_diffuse([0, 0, 1.0], DOWN, keys=np.arange(2))
    with pytest.raises(InputError, match="irradiance"):
        tracer.trace_to_diffuse([0, 0, 1.0], DOWN).radiance_with(np.ones((1, 3)))
