"""Rivals against exact values and against each other; each is skipped, with its reason, where it is absent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from radiosity.rivals import RIVALS, absent, open_rival
from radiosity.rivals.base import band_triples, black_lamps
from workbench.errors import OptionError
from workbench.geometry.flat import Geometry
from workbench.scene.library import box_surface, diffuse, quad_light_over_floor, unit_cube
from workbench.scene.load import load
from workbench.scene.model import Camera, Light, Sky, Surface

BELOW_LIGHT = 0.23083679773
"""Irradiance below the middle of a unit square light of radiance 1 at height 2 (Lambert's formula)."""
DIRECT = ("mitsuba", "radiance", "trimesh")
INDIRECT = ("mitsuba", "radiance")
FACTORS = ("pyviewfactor", "trimesh")


def rival(name, scene):
    reason = absent(name)
    if reason is not None:
        pytest.skip(f"{name}: {reason}")
    return open_rival(name, scene)


def seeds_agree(values, expected, *, bias=0.0, sigmas=5.0):
    """Means over seeds (first axis) within their standard errors, and ``bias``, of what is expected."""
    values = np.asarray(values)
    error = values.std(axis=0, ddof=1) / np.sqrt(len(values))
    assert (np.abs(values.mean(axis=0) - expected) <= sigmas * error + bias).all(), (values.mean(axis=0), error)
    assert (error < 0.02 * np.abs(expected).max()).all()


@pytest.mark.parametrize("name", DIRECT)
def test_direct_light_below_a_square(name):
    engine = rival(name, quad_light_over_floor())
    found = [engine.irradiance([[0, 0, 0]], [0, 0, 1], samples=1024, seed=s, direct_only=True)[0, 0] for s in range(8)]
    # Radiance may not subdivide further than 64 parts and jitters inside them.
    seeds_agree(found, BELOW_LIGHT, bias=1e-5)


@pytest.mark.parametrize("name", DIRECT)
def test_back_of_a_light_is_dark_and_backs_block(name):
    """A half-wall of one-sided polygons seen from behind blocks; a light seen from behind gives nothing."""
    shade = Surface.from_polygons(
        "shade", diffuse("shade", 0.0), [np.array([[-3, -3, 1], [-3, 3, 1], [3, 3, 1], [3, -3, 1.0]])]
    )
    for flip in (1, -1):
        turned = Surface.from_polygons("shade", shade.material, [shade.face(0)[0][::flip]])
        engine = rival(name, quad_light_over_floor(turned))
        assert engine.irradiance([[0, 0, 0]], [0, 0, 1], samples=64, direct_only=True) == pytest.approx(0.0, abs=1e-12)
    engine = rival(name, quad_light_over_floor())
    above = engine.irradiance([[0, 0, 3.0]], [0, 0, -1], samples=64, direct_only=True)
    assert above == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("name", INDIRECT)
def test_backs_are_black(name):
    """Light falls on the back of a plate: nothing is reflected from it to a point that only it could light."""
    _, light = quad_light_over_floor().surfaces
    plate = np.array([[1.0, -0.5, 0.0], [1.5, -0.5, 1.0], [1.5, 0.5, 1.0], [1.0, 0.5, 0.0]])
    toward = [[0.8, 0, 0.0]]
    for ring, dark in ((plate, False), (plate[::-1], True)):
        scene = replace(
            quad_light_over_floor(), surfaces=(light, Surface.from_polygons("p", diffuse("p", 0.9), [ring]))
        )
        normal = np.cross(ring[1] - ring[0], ring[2] - ring[1])
        assert (normal[0] < 0) != dark  # the front looks to the light and the point
        engine = rival(name, scene)
        whole = engine.irradiance(toward, [1, 0, 0], samples=4096)[0, 0]
        direct = engine.irradiance(toward, [1, 0, 0], samples=4096, direct_only=True)[0, 0]
        assert (whole - direct < 1e-6) if dark else (whole - direct > 1e-3)


def test_furnace():
    """E = e / (1 - rho) on the walls of a closed box that all emit e: 2 for e = 1, rho = 1/2."""
    engine = rival("mitsuba", unit_cube(0.5, 1.0))
    found = [
        engine.irradiance([[0.5, 0.5, 0.0], [0.1, 0.1, 0.0]], [0, 0, 1], samples=4096, seed=s)[:, 0] for s in range(8)
    ]
    seeds_agree(found, 2.0)


@pytest.mark.parametrize("name", INDIRECT)
def test_white_box_under_a_uniform_sky(name):
    """A black floor with a sky of radiance 1 receives pi; inside a white open box it receives pi too."""
    floor = quad_light_over_floor().surfaces[0]
    scene = replace(quad_light_over_floor(), surfaces=(floor,), background=np.ones(1))
    found = [rival(name, scene).irradiance([[0, 0, 0]], [0, 0, 1], samples=256, seed=s)[0, 0] for s in range(4)]
    assert found == pytest.approx(np.full(4, np.pi), rel=0.05)
    white = box_surface("box", diffuse("white", 0.95), [-1, -1, 0], [1, 1, 0.5], inward=True, omit=["+z"])
    engine = rival(name, replace(scene, surfaces=(white,)))
    found = [engine.irradiance([[0, 0, 0]], [0, 0, 1], samples=512, seed=s)[0, 0] for s in range(6)]
    assert 0.9 * np.pi < np.mean(found) < np.pi


@pytest.mark.parametrize("name", INDIRECT)
def test_same_light_in_a_room(name):
    """Both engines find the same reflected light in the Cornell box, each to its own noise."""
    other = "radiance" if name == "mitsuba" else "mitsuba"
    scene = black_lamps(load("cornell-box"))
    points, normal = [[0.05, 0.0, 0.1], [0.45, 0.0, 0.1]], [0, 1, 0]
    means, errors = [], []
    for engine in (rival(name, scene), rival(other, scene)):
        found = np.array([engine.irradiance(points, normal, samples=1024, seed=s) for s in range(6)])
        means.append(found.mean(axis=0))
        errors.append(found.std(axis=0, ddof=1) / np.sqrt(len(found)))
    # Radiance stops after a number of bounces that leaves 0.1 %.
    assert (np.abs(means[0] - means[1]) < 5 * np.hypot(*errors) + 0.004 * means[0]).all()


@pytest.mark.parametrize("name", FACTORS)
def test_view_factors_of_a_cube(name):
    """0.2000437761 between sides that share an edge, 0.1998248957 between opposite ones (Howell C-14, C-11)."""
    scene = unit_cube(0.5, 1.0)
    factor = rival(name, scene).view_factors(samples=1 if name == "pyviewfactor" else 40000)
    opposite = [1, 0, 3, 2, 5, 4]
    expected = np.where(np.arange(6)[:, None] == opposite, 0.19982489569838746, 0.20004377607540316)
    np.fill_diagonal(expected, 0.0)
    assert np.abs(factor - expected).max() < (1e-4 if name == "pyviewfactor" else 0.012)
    assert factor.sum(axis=1) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("name", FACTORS)
def test_view_factor_rows_send(name):
    """Row to column: a small square before a large one sees more of it than the other way round."""
    small = np.array([[-0.1, -0.1, 1], [-0.1, 0.1, 1], [0.1, 0.1, 1], [0.1, -0.1, 1.0]])
    large = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
    surfaces = tuple(Surface.from_polygons(n, diffuse(n, 0.5), [r]) for n, r in (("small", small), ("large", large)))
    scene = replace(unit_cube(0.5, 1.0), surfaces=surfaces, closed=False)
    factor = rival(name, scene).view_factors(samples=1 if name == "pyviewfactor" else 4000)
    assert factor[0, 1] > 20 * factor[1, 0] > 0
    area = Geometry.from_scene(scene).polygon_area
    assert area[0] * factor[0, 1] == pytest.approx(area[1] * factor[1, 0], rel=0.3)


@pytest.mark.parametrize("name", INDIRECT)
def test_pictures_stand_upright(name):
    """The picture's rows run from top to bottom and its columns from left to right; one lamp at the upper right."""
    lamp = np.array([[0.5, 0.5, -3], [1.0, 0.5, -3], [1.0, 1.0, -3], [0.5, 1.0, -3.0]])
    floor = np.array([[-9, -2, 0], [9, -2, 0], [9, -2, -9], [-9, -2, -9.0]])
    surfaces = (
        Surface.from_polygons("lamp", diffuse("lamp", 0.0, np.pi), [lamp]),
        Surface.from_polygons("floor", diffuse("floor", 0.5), [floor]),
    )
    scene = replace(unit_cube(0.5, 1.0), surfaces=surfaces, closed=False)
    camera = Camera(np.zeros(3), np.array([0, 0, -1.0]), np.array([0, 1.0, 0]), fov_deg=60.0, width=48, height=32)
    image = rival(name, scene).picture(camera, samples=64)
    assert image.shape == (32, 48, 1)
    # The lamp's middle, (0.75, 0.75, -3), is 0.25 / tan 30 deg = 0.433 of the half height from the axis.
    row, column = 16 - 0.433 * 16, 24 + 0.433 * 16
    assert image[round(row), round(column), 0] == pytest.approx(1.0, rel=1e-5)
    assert (image[:8, :24] == 0).all()


def test_distant_and_point_lights():
    floor = quad_light_over_floor().surfaces[0]
    lights = (
        Light("sun", "directional", np.array([2.0]), direction=np.array([0.0, 0.6, -0.8])),
        Light("bulb", "point", np.array([3.0]), position=np.array([0.0, 0.0, 2.0])),
    )
    scene = replace(quad_light_over_floor(), surfaces=(floor,), lights=lights)
    # 2 cos + I / d^2 = 1.6 + 0.75
    for name in DIRECT:
        found = rival(name, scene).irradiance([[0, 0, 0]], [0, 0, 1], samples=64, direct_only=True)
        assert found[0, 0] == pytest.approx(2.35, rel=0.06 if name == "mitsuba" else 1e-3), (
            name
        )  # it picks a light at random


def test_what_a_rival_cannot_model_is_refused():
    for name in RIVALS:
        pane = replace(diffuse("pane", 0.1), transmittance=np.array([0.5]))
        scene = replace(unit_cube(0.5, 1.0), surfaces=(replace(unit_cube(0.5, 1.0).surfaces[0], material=pane),))
        with pytest.raises(OptionError, match="pane"):
            rival(name, scene)
        with pytest.raises(OptionError, match="sky"):
            rival(name, replace(unit_cube(0.5, 1.0), sky=Sky("overcast", np.zeros(1), zenith_radiance=np.ones(1))))
    with pytest.raises(OptionError, match="emits and reflects"):
        rival("radiance", unit_cube(0.5, 1.0))
    with pytest.raises(OptionError, match="does not answer"):
        rival("trimesh", unit_cube(0.5, 1.0)).picture(load("cornell-box").camera, samples=1)
    with pytest.raises(OptionError, match="expected one of"):
        absent("povray")


def test_bands_in_threes():
    assert [t.tolist() for t in band_triples(1)] == [[0, 0, 0]]
    assert [t.tolist() for t in band_triples(3)] == [[0, 1, 2]]
    assert [t.tolist() for t in band_triples(5)] == [[0, 1, 2], [3, 4, 4]]
    lamps = black_lamps(load("cornell-box"))
    assert all(not s.material.reflectance.any() for s in lamps.surfaces if s.material.emission.any())


@pytest.mark.parametrize("name", DIRECT)
def test_five_bands(name):
    scene = quad_light_over_floor()
    power = np.arange(1.0, 6.0)
    surfaces = tuple(
        replace(s, material=diffuse(s.name, 0.0, power if s.name == "light" else 0.0, bands=5)) for s in scene.surfaces
    )
    scene = replace(scene, surfaces=surfaces, background=np.zeros(5), bands=5)
    found = rival(name, scene).irradiance([[0, 0, 0]], [0, 0, 1], samples=4096, direct_only=True)[0]
    assert found == pytest.approx(BELOW_LIGHT / np.pi * power, rel=0.05)
