"""Skies: their radiance, their horizontal irradiance, what openings leave of them, and their TOML table."""

from __future__ import annotations

import math

import numpy as np
import pytest

import radiosity
import workbench
from workbench.errors import InputError, SceneError
from workbench.geometry.flat import Geometry
from workbench.scene.library import box_surface, diffuse
from workbench.scene.model import SKY_KINDS, Scene, Sky, Surface
from workbench.shadow.occlusion import Shader
from workbench.shadow.sky import SkyLight

SUN = np.array([0.6, 0.0, 0.8])
NONE = np.zeros(1)


def _sky(kind, **options):
    return Sky(kind, options.pop("ground", NONE), zenith_radiance=np.ones(1), sun_direction=SUN, **options)


@pytest.mark.parametrize("kind", SKY_KINDS)
def test_every_sky_is_relative_to_its_zenith_and_dark_below_the_horizon(kind):
    light = SkyLight.of_sky(_sky(kind))
    assert light.radiance([[0, 0, 1]])[0, 0] == pytest.approx(1.0)
    assert light.radiance([[1, 0, -0.01]])[0, 0] == 0.0
    rng = np.random.default_rng(3)
    # Uniform directions of the half sphere: E = 2 pi mean(L cos), an independent Monte Carlo sum.
    along = rng.normal(size=(200_000, 3))
    along /= np.linalg.norm(along, axis=1)[:, None]
    along[:, 2] = np.abs(along[:, 2])
    terms = 2 * math.pi * light.radiance(along)[:, 0] * along[:, 2]
    doubt = terms.std() / math.sqrt(len(terms))
    assert abs(light.horizontal_irradiance[0] - terms.mean()) < 4 * doubt


def test_horizontal_irradiance_of_skies_with_a_closed_form():
    assert SkyLight.of_sky(_sky("uniform")).horizontal_irradiance[0] == pytest.approx(math.pi, rel=1e-12)
    assert SkyLight.of_sky(_sky("cie-5")).horizontal_irradiance[0] == pytest.approx(math.pi, rel=1e-12)
    # Integral of (1 + 2 sin g) / 3 over the dome: pi (1 + 4/3) / 3 = 7 pi / 9.
    assert SkyLight.of_sky(_sky("overcast")).horizontal_irradiance[0] == pytest.approx(7 * math.pi / 9, rel=1e-9)


def test_published_values_of_a_clear_sky():
    # CIE S 011 type 12 beside the sun, from the standard's own formula: gradation times indicatrix.
    a, b, c, d, e = -1.0, -0.32, 10.0, -3.0, 0.45
    chi, z = math.radians(30.0), math.radians(50.0)
    zs = math.acos(0.8)

    def phi(angle):
        return 1 + a * math.exp(b / math.cos(angle))

    def f(angle):
        return 1 + c * (math.exp(d * angle) - math.exp(d * math.pi / 2)) + e * math.cos(angle) ** 2

    wanted = f(chi) * phi(z) / (f(zs) * phi(0.0))
    # A direction at 50 degrees from the zenith and 30 from the sun.
    azimuth = math.acos((math.cos(chi) - math.cos(z) * 0.8) / (math.sin(z) * 0.6))
    direction = [math.sin(z) * math.cos(azimuth), math.sin(z) * math.sin(azimuth), math.cos(z)]
    assert SkyLight.of_sky(_sky("cie-12")).radiance([direction])[0, 0] == pytest.approx(wanted, rel=1e-12)


def _open_floor(kind, **options):
    floor = Surface.from_polygons("floor", diffuse("floor", 0.0), [[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]])
    return Scene("open", (floor,), bands=1, background=NONE, sky=_sky(kind, **options))


@pytest.mark.parametrize("kind", ["uniform", "overcast", "cie-3", "cie-13"])
def test_unobstructed_points_get_the_whole_sky(kind):
    scene = _open_floor(kind, ground=np.array([0.2]))
    light = SkyLight.of_scene(scene)
    shader = Shader(Geometry.from_scene(scene), 1)
    whole = light.horizontal_irradiance[0]
    up = light.shares(shader, [[0.5, 0.5, 0.0]], [[0, 0, 1]], own_polygon=0, error=1e-6)
    assert up[0, 0] == pytest.approx(whole, rel=1e-7) and up[0, 1] == 0.0
    # A wall in the open gets half of the ground's exitance; turned down, all of it but the floor's shadow.
    wall = light.irradiance(light.shares(shader, [[50.0, 0.5, 0.0]], [[1, 0, 0]]))
    share = light.shares(shader, [[50.0, 0.5, 0.0]], [[1, 0, 0]])[0, 1]
    assert share == pytest.approx(0.5, rel=1e-9)
    assert wall[0, 0] > 0.1 * whole


def test_crowded_points_fall_back_to_rays_with_an_honest_error():
    # A grille of 400 bars over the floor: too many to cut from most points.
    bars = [
        np.array([[x, 0, 1], [x + 0.0025, 0, 1], [x + 0.0025, 1, 1], [x, 1, 1]]) for x in np.linspace(0, 0.9975, 200)
    ]
    paint = diffuse("black", 0.0)
    floor = Surface.from_polygons("floor", paint, [[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]])
    scene = Scene(
        "grille", (floor, Surface.from_polygons("grille", paint, bars)), bands=1, background=NONE, sky=_sky("uniform")
    )
    solution = radiosity.solve(scene, elements=1, workers=1)
    points, normals = np.array([[0.5, 0.5, 0.0], [0.25, 0.5, 0.0]]), np.array([[0, 0, 1.0], [0, 0, 1]])
    found = solution.irradiance(points, normals, own_polygon=0, workers=1, error=0.01)
    assert found.method == "rays"
    # The bars hide their form factor each: Lambert's sum over all of them, exact as none overlaps.
    from radiosity.form_factors.analytic import point_to_polygon

    wanted = math.pi * (1 - sum(point_to_polygon(points, normals, bar) for bar in bars))
    assert (np.abs(found.irradiance[:, 0] - wanted) < 4 * found.standard_error[:, 0]).all()
    assert np.sqrt((found.standard_error**2).mean()) < 0.012 * wanted.mean()
    assert not found.indirect.any() and np.array_equal(found.direct, found.irradiance)


def test_exact_sky_agrees_with_rays_in_a_furnished_room():
    room = box_surface("room", diffuse("wall", 0.0), [0, 0, 0], [4, 3, 3], inward=True, omit=["-y"])
    desk = box_surface("desk", diffuse("desk", 0.0), [1, 0.5, 0.7], [3, 1.3, 0.75])
    scene = Scene("room", (room, desk), bands=1, background=NONE, sky=_sky("cie-4", ground=np.array([0.3])))
    geometry = Geometry.from_scene(scene)
    light, shader = SkyLight.of_scene(scene), Shader(geometry, 1)
    from radiosity.solvers.incident import _sky_by_rays

    rng = np.random.default_rng(4)
    points = rng.uniform([0.2, 0.1, 0.1], [3.8, 2.8, 2.8], (30, 3))
    points = points[~((points[:, 1] < 1.4) & (points[:, 1] > 0.4) & (np.abs(points[:, 2] - 0.72) < 0.1))]
    normals = rng.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    exact = light.shares(shader, points, normals)
    runs = np.stack([_sky_by_rays(points, normals, 4096, [seed], light, shader) for seed in range(4)])
    doubt = runs.std(axis=0, ddof=1) / 2 + 2e-4
    assert (np.abs(exact - runs.mean(axis=0)) < 5 * doubt).all()


def test_panes_dim_the_sky():
    square = np.array([[-50.0, -50, 1], [50, -50, 1], [50, 50, 1], [-50, 50, 1]])
    pane = diffuse("pane", 0.0)
    pane = type(pane)(**{**pane.__dict__, "transmittance": np.array([0.4]), "two_sided": True})
    floor = Surface.from_polygons("floor", diffuse("floor", 0.0), [[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]])
    roof = Surface.from_polygons("roof", pane, [square])
    scene = Scene("pane", (floor, roof), bands=1, background=NONE, sky=_sky("uniform"))
    light = SkyLight.of_scene(scene)
    found = light.shares(Shader(Geometry.from_scene(scene), 1), [[0.5, 0.5, 0]], [[0, 0, 1]], own_polygon=0)
    # The pane fills 1 - 1/(1 + h^2/r^2)-ish of the view: between 0.4 and 0.4 + 0.6/2500 of the whole.
    assert 0.4 * math.pi <= found[0, 0] < 0.4007 * math.pi


def test_background_is_a_uniform_sky_all_round():
    floor = Surface.from_polygons("floor", diffuse("floor", 0.5), [[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]])
    scene = Scene("open", (floor,), bands=1, background=np.array([2.0]))
    solution = radiosity.solve(scene, elements=4, workers=1)
    assert np.allclose(solution.element_irradiance, 2 * math.pi, rtol=1e-9)
    found = solution.irradiance([[0.5, 0.5, 0.5]], [[1, 0, 0]], workers=1)
    assert found.direct[0, 0] < 2 * math.pi and found.direct[0, 0] > math.pi


# ---- TOML ---------------------------------------------------------------------------------------

SCENE = """
schema = 1
{sky}
[materials.wall]
reflectance = 0.5
[[surface]]
name = "floor"
material = "wall"
polygon = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
"""


def _load(tmp_path, sky, top=""):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE.format(sky=f"{top}\n[sky]\n{sky}"))
    return workbench.load(path)


def test_a_sky_is_read(tmp_path):
    scene = _load(
        tmp_path, 'type = "cie-7"\nhorizontal_irradiance = [100, 120]\nground_reflectance = 0.2\n'
        "up = [0, 2, 0]\nsun_direction = [1, 1, 0]"
    )  # fmt: skip
    sky = scene.sky
    assert scene.bands == 2 and sky.kind == "cie-7" and sky.up.tolist() == [0, 1, 0] and scene.has_emitter
    assert sky.horizontal_irradiance.tolist() == [100, 120] and sky.ground_reflectance.tolist() == [0.2, 0.2]
    light = SkyLight.of_scene(scene)
    assert light.horizontal_irradiance == pytest.approx([100, 120], rel=1e-9)
    assert light.ground_radiance == pytest.approx([20 / math.pi, 24 / math.pi], rel=1e-9)


@pytest.mark.parametrize(
    ("sky", "message"),
    [
        ('type = "overcats"\nzenith_radiance = 1', r"sky.type: found 'overcats'; did you mean 'overcast'"),
        ('type = "cie-16"\nzenith_radiance = 1', r"sky.type: found 'cie-16'"),
        ('zenith_radiance = 1', r"sky.type: found nothing, expected this key"),
        ('type = "uniform"', r"sky: expected exactly one of zenith_radiance and horizontal_irradiance"),
        ('type = "uniform"\nzenith_radience = 1', r"sky.zenith_radience: found an unknown key; did you mean"),
        ('type = "cie-2"\nzenith_radiance = 1', r"sky.sun_direction: found nothing, expected the direction to the sun"),
        ('type = "cie-2"\nzenith_radiance = 1\nsun_direction = [0, 0, -1]', r"found a sun below the horizon"),
        ('type = "uniform"\nzenith_radiance = 1\nground_reflectance = 1.5', r"sky.ground_reflectance: found 1.5"),
        ('type = "uniform"\nzenith_radiance = [1, 2]\nground_reflectance = [0.1, 0.2, 0.3]', r"found 2 values"),
    ],
)  # fmt: skip
def test_faults_of_a_sky_are_named(tmp_path, sky, message):
    with pytest.raises(SceneError, match=message):
        _load(tmp_path, sky)


def test_a_sky_beside_a_background_or_in_a_closed_scene_is_refused(tmp_path):
    good = 'type = "uniform"\nzenith_radiance = 1'
    with pytest.raises(SceneError, match="background: found a background beside"):
        _load(tmp_path, good, "background = 1")
    with pytest.raises(SceneError, match="closed: found true in a scene with a"):
        _load(tmp_path, good, "closed = true")


def test_a_sky_built_in_code_is_checked():
    with pytest.raises(InputError, match="exactly one of"):
        SkyLight.of_sky(Sky("uniform", NONE))
    with pytest.raises(InputError, match="found kind 'blue'"):
        SkyLight.of_sky(Sky("blue", NONE, zenith_radiance=np.ones(1)))
    with pytest.raises(InputError, match="found no sun_direction"):
        SkyLight.of_sky(Sky("cie-9", NONE, zenith_radiance=np.ones(1)))
