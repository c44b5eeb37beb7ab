"""The recursive tracer against closed forms: directions, lights, transparency, energy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from trace_scenes import floor, look_down, material, scene, square, sun

from workbench.errors import InputError, OptionError
from workbench.render import _trace_kernels as kernels
from workbench.render.camera import PinholeRays
from workbench.render.pictures import PICTURES, test_picture
from workbench.render.textures import Checker, Noise
from workbench.render.trace import TraceOptions, Tracer
from workbench.scene.library import diffuse, sphere_surface
from workbench.scene.model import Light, Sky, Surface
from workbench.scene.nff import load_scene
from workbench.shadow.linear import linear_irradiance

SPD = Path(__file__).resolve().parents[2] / ".." / "shared" / "scenes-external" / "nff-spd"
DOWN = np.array([[0.0, 0.0, -1.0]])


def unit(rng, count):
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def test_mirrored_directions():
    rng = np.random.default_rng(1)
    incoming, normal = unit(rng, 200), unit(rng, 200)
    normal *= -np.sign(np.einsum("ij,ij->i", incoming, normal))[:, None]
    flags = np.ones(1, dtype=bool)
    found = kernels.mirror(incoming, normal, normal, np.zeros(200, np.int32), flags)
    cosine = np.einsum("ij,ij->i", incoming, normal)
    np.testing.assert_allclose(found, incoming - 2 * cosine[:, None] * normal, atol=1e-15)
    # A shading normal bent so far that the mirrored ray would enter: mirrored about the facet instead.
    facing = np.array([[0.0, 0.0, 1.0]])
    bent = np.array([[0.8, 0.0, 0.6]])
    grazing = np.array([[-np.cos(0.1), 0.0, -np.sin(0.1)]])
    assert (kernels.mirror(-bent, bent, facing, np.zeros(1, np.int32), flags)[:, 2] > 0).all()
    away = kernels.mirror(
        np.array([[0.6, 0.0, -0.8]]), np.array([[-1.0, 0.0, 0.0]]), facing, np.zeros(1, np.int32), flags
    )
    np.testing.assert_allclose(away, [[0.6, 0.0, 0.8]])
    assert kernels.mirror(grazing, bent, facing, np.zeros(1, np.int32), flags)[0, 2] > 0


@pytest.mark.parametrize("front", [True, False])
def test_refracted_directions_follow_snell_and_reflect_totally(front):
    rng = np.random.default_rng(2)
    count, ior = 400, 1.5
    incoming, normal = unit(rng, count), unit(rng, count)
    normal *= -np.sign(np.einsum("ij,ij->i", incoming, normal))[:, None]
    sides = np.full(count, front)
    found, total = kernels.refract(incoming, normal, normal, sides, np.full(count, ior))
    eta = 1 / ior if front else ior
    cosine = -np.einsum("ij,ij->i", incoming, normal)
    sine = eta * np.sqrt(1 - cosine**2)
    np.testing.assert_array_equal(total, sine > 1)
    assert total.any() != front
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)
    through = found[~total]
    along = np.einsum("ij,ij->i", through, normal[~total])
    np.testing.assert_allclose(along, -np.sqrt(1 - sine[~total] ** 2), atol=1e-12)
    # In one plane with the incoming ray and the normal.
    volume = np.einsum("ij,ij->i", np.cross(incoming, normal)[~total], through)
    np.testing.assert_allclose(volume, 0, atol=1e-12)
    mirrored = incoming[total] + 2 * cosine[total, None] * normal[total]
    np.testing.assert_allclose(found[total], mirrored, atol=1e-12)


def test_ray_through_a_glass_slab_comes_out_parallel_and_moved():
    """A slab 1 thick of index 1.5 moves a ray at 45 degrees by sin 45 (1 - cos 45 / (1.5 cos 28.126)) = 0.3292."""
    glass = material("glass", transmittance=1.0, ior=1.5, two_sided=False)
    slab = Surface.from_polygons("slab", glass, [square((-9, -9), (9, 9), 2.0), square((-9, -9), (9, 9), 1.0)[::-1]])
    texture = {"floor": Checker(0.5, 1.0, 0.0, "x", (0.01, 0.0, 0.0))}
    along = np.array([[1.0, 0.0, -1.0]]) / np.sqrt(2)
    tracer = Tracer(scene([floor(), slab], [sun()]), textures=texture)
    # Without the slab the floor is met at x = start + 3; with it 1 - tan(28.126 deg) = 0.4655 earlier.
    shift = 1 - np.tan(np.arcsin(np.sin(np.pi / 4) / 1.5))
    assert shift == pytest.approx(0.4655, abs=1e-4)
    for start, expected in ((0.01 - 3.0 + shift + 0.01, 1.0), (0.01 - 3.0 + shift - 0.01, 0.0)):
        found = tracer.trace([start, 0.0, 3.0], along)
        assert found.radiance[0, 0] == pytest.approx(expected)
        assert found.tally.refraction.shot == 2


def test_total_reflection_keeps_light_inside():
    glass = material("glass", transmittance=1.0, ior=1.5, two_sided=False)
    ceiling = Surface.from_polygons("surface of glass", glass, [square((-9, -9), (9, 9), 1.0)])
    tracer = Tracer(scene([ceiling], background=1.0))
    steep = np.array([[0.1, 0.0, 1.0]]) / np.sqrt(1.01)
    flat = np.array([[1.0, 0.0, 0.5]]) / np.sqrt(1.25)
    for along in (steep, flat):
        assert tracer.trace([0, 0, 0], along).radiance[0, 0] == pytest.approx(1.0)
    lid = Surface.from_polygons("lid", material("lid"), [square((-99, -99), (99, 99), 3.0)])
    tracer = Tracer(scene([ceiling, lid], background=1.0))
    assert tracer.trace([0, 0, 0], steep).radiance[0, 0] == 0.0
    assert tracer.trace([0, 0, 0], flat).radiance[0, 0] == pytest.approx(1.0)


def test_mirrors_face_to_face_stop_at_the_depth():
    """Between mirrors of 0.5 and 0.5 with radiance 1 each: 1 + 1/2 + 1/4 + 1/8 at depth 3."""
    shiny = material("shiny", specular=0.5, emission=np.pi)
    mirrors = [Surface.from_polygons(f"mirror {z}", shiny, [square((-9, -9), (9, 9), z)]) for z in (0.0, 1.0)]
    for depth in range(6):
        found = Tracer(scene(mirrors), TraceOptions(depth=depth)).trace([0.1, 0.2, 0.5], DOWN)
        assert found.radiance[0, 0] == pytest.approx(2 - 0.5**depth)
        assert found.tally.reflection.shot == depth


@pytest.mark.parametrize("exponent", [1.0, 20.0, 500.0])
@pytest.mark.parametrize("branch", ["specular", "transmittance"])
def test_furnace_of_fuzzy_bundles(branch, exponent):
    """Everything around has radiance 1: a surface that sends on 0.8 of it has 0.8, whatever its lobe."""
    sheet = Surface.from_polygons(
        "sheet", material("sheet", **{branch: 0.8}, exponent=exponent), [square((-9, -9), (9, 9), 0)]
    )
    tracer = Tracer(scene([sheet], background=1.0), TraceOptions(bundle=16))
    rng = np.random.default_rng(5)
    along = unit(rng, 300)
    along[:, 2] = -np.abs(along[:, 2]) - 1e-3
    found = tracer.trace([0, 0, 1e-3], along)
    np.testing.assert_allclose(found.radiance, 0.8, rtol=1e-12)
    assert getattr(found.tally, "reflection" if branch == "specular" else "refraction").shot == 300 * 16


def test_fuzzy_lobe_has_the_mean_cosine_of_its_exponent():
    """The mean of cos over a lobe cos^e is (e + 1) / (e + 2)."""
    for exponent in (1.0, 10.0, 100.0):
        up = np.tile([0.0, 0.0, 1.0], (4000, 1))
        found = kernels.lobe(up, np.full(4000, exponent), up, np.arange(4000).astype(np.uint64), 4)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)
        assert found[:, 2].mean() == pytest.approx((exponent + 1) / (exponent + 2), abs=2e-3)
        assert np.abs(found[:, :2].mean(axis=0)).max() < 0.01


def irradiance(light, point, *, surfaces=(), **options):
    """Irradiance of a white floor at (x, y), through its radiance E / pi."""
    tracer = Tracer(scene([floor(), *surfaces], [light] if light else []), TraceOptions(**options))
    return np.pi * tracer.trace([point[0], point[1], 0.5], DOWN).radiance[0, 0]


def test_lights_by_their_formulas():
    power = np.array([5.0])
    point = Light("p", "point", power, position=np.array([1.0, 2.0, 3.0]))
    assert irradiance(point, (0, 0)) == pytest.approx(5 * 3 / 14**1.5)
    assert irradiance(point, (0, 0), falloff=False) == pytest.approx(5 * 3 / 14**0.5)
    spot = replace(point, kind="spot", direction=np.array([0.0, 0.0, -1.0]), cone_deg=40.0, exponent=2.0)
    assert irradiance(spot, (0, 0)) == pytest.approx(5 * 3 / 14**1.5 * 9 / 14)
    assert irradiance(replace(spot, cone_deg=36.0), (0, 0)) == 0.0  # atan(sqrt 5 / 3) = 36.7 degrees
    assert irradiance(sun(2.0, (0.6, 0.0, -0.8)), (0, 0)) == pytest.approx(1.6)
    ends = np.array([-1.0, 0.5, 2.0]), np.array([2.0, 1.0, 1.5])
    for lambertian in (False, True):
        line = Light("l", "linear", power, position=ends[0], end=ends[1], lambertian=lambertian)
        exact = 5.0 * linear_irradiance([[0.2, 0.1, 0.0]], [[0, 0, 1]], *ends, lambertian=lambertian)
        assert irradiance(line, (0.2, 0.1), light_samples=512) == pytest.approx(float(np.ravel(exact)[0]), rel=1e-4)
    # Below the middle of a unit square of radiance 1 at height 2: 0.23083679773.
    lamp = Surface.from_polygons(
        "lamp", material("lamp", emission=np.pi, two_sided=False), [square((-0.5, -0.5), (0.5, 0.5), 2.0)[::-1]]
    )
    assert irradiance(None, (0, 0), surfaces=[lamp], light_samples=1024) == pytest.approx(0.23083679773, rel=1e-3)
    jittered = [irradiance(None, (0, 0), surfaces=[lamp], light_samples=64, jitter=True, seed=s) for s in range(8)]
    assert np.std(jittered) > 0
    assert np.mean(jittered) == pytest.approx(0.23083679773, rel=5e-3)


def test_highlight_is_the_normalised_lobe():
    """Seen along the mirrored direction: ks (e + 1) / (2 pi) I / r^2."""
    gloss = material("gloss", specular=0.4, exponent=30.0)
    light = Light("p", "point", np.array([7.0]), position=np.array([-2.0, 0.0, 2.0]))
    tracer = Tracer(scene([floor(matter=gloss)], [light]), TraceOptions(depth=0))
    along = np.array([[-1.0, 0.0, -1.0]]) / np.sqrt(2)
    at_peak = tracer.trace([1.0, 0.0, 1.0], along).radiance[0, 0]
    assert at_peak == pytest.approx(0.4 * 31 / (2 * np.pi) * 7 / 8)
    tilted = np.array([[-np.sin(0.9), 0.0, -np.cos(0.9)]])
    start = -tilted[0] * 2
    assert tracer.trace(start, tilted).radiance[0, 0] == pytest.approx(
        at_peak * np.cos(0.9 - np.pi / 4) ** 30, rel=1e-6
    )


def test_backs_are_black_unless_both_sides_send():
    one = diffuse("one", 0.5)
    light = sun(direction=(0, 0, 1.0))
    for matter, expected in ((one, 0.0), (replace(one, two_sided=True), 0.5)):
        found = Tracer(scene([floor(matter=matter)], [light])).trace([0, 0, -1.0], -DOWN)
        assert found.radiance[0, 0] == pytest.approx(expected)
        assert found.surface[0] == 0
    lid = Surface.from_polygons("lid", one, [square((-9, -9), (9, 9), 1.0)[::-1]])
    parts = scene([floor(), lid], [Light("p", "point", np.ones(1), position=np.array([0.5, 0.0, 0.5]))])
    assert Tracer(parts).trace([0, 0, 2.0], DOWN).radiance[0, 0] == 0.0
    seen = Tracer(parts, TraceOptions(see_backs=False)).trace([0, 0, 2.0], DOWN)
    assert seen.surface[0] == 0
    assert seen.radiance[0, 0] == pytest.approx(0.5 / 0.5**1.5 / np.pi)


def test_interpolated_normals_follow_the_sphere():
    ball = sphere_surface("ball", diffuse("ball", 1.0), [0, 0, 0], 1.0, facet_error=0.02)
    tracer = Tracer(scene([ball], [sun()]))
    rng = np.random.default_rng(3)
    places = rng.uniform(-0.5, 0.5, (300, 2))
    found = tracer.trace(np.column_stack([places, np.full(300, 3.0)]), np.repeat(DOWN, 300, axis=0))
    exact = np.sqrt(1 - (places**2).sum(axis=1))
    assert np.abs(found.radiance[:, 0] - exact).max() < 0.02
    flat = Tracer(scene([replace(ball, vertex_normals=None)], [sun()]))
    flat_found = flat.trace(np.column_stack([places, np.full(300, 3.0)]), np.repeat(DOWN, 300, axis=0))
    assert np.abs(flat_found.radiance[:, 0] - exact).mean() > 3 * np.abs(found.radiance[:, 0] - exact).mean()


def test_normals_of_quads_and_of_concave_faces():
    corners = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [2, 1, 0], [0, 4, 0]], dtype=float)  # concave at (2, 1)
    slant = np.array([[-0.6, 0, 0.8], [0.6, 0, 0.8], [0.6, 0, 0.8], [0, 0, 1], [-0.6, 0, 0.8]])
    surface = replace(Surface.from_polygons("kite", diffuse("kite", 1.0), [corners]), vertex_normals=slant)
    tracer = Tracer(scene([surface], [sun(np.pi, (-0.6, 0, -0.8))]))
    for x, expected in ((0.05, 0.28), (3.95, 1.0)):  # 0.8^2 - 0.6^2 and 0.8^2 + 0.6^2
        assert tracer.trace([x, 0.5, 1.0], DOWN).radiance[0, 0] == pytest.approx(expected, abs=0.05)


def test_textures_repeat_and_stay_in_their_range():
    rng = np.random.default_rng(6)
    points = rng.uniform(-20, 20, (5000, 3))
    checker = Checker(0.5, 1.0, 0.25, "xyz")
    values = checker(points)
    assert set(np.unique(values)) == {0.25, 1.0}
    np.testing.assert_array_equal(checker(points + [0.5, 0.5, 0.0]), values)
    np.testing.assert_array_equal(checker(points + [0.5, 0.0, 0.0]), 1.25 - values)
    noise = Noise(0.7, (0.2, 0.3, 0.4), 0.9, 3, 2.0, seed=1)
    values = noise(points)
    assert values.shape == (5000, 3)
    assert (values >= [0.2, 0.3, 0.4]).all() and (values <= 0.9 + 1e-12).all()
    assert values.std() > 0.1
    np.testing.assert_array_equal(noise(points), values)
    assert np.abs(noise(points + 1e-6) - values).max() < 1e-4  # continuous
    assert np.abs(Noise(0.7, seed=2)(points) - Noise(0.7, seed=3)(points)).max() > 0.1
    for broken in (
        lambda: Checker(0.0),
        lambda: Checker(1.0, axes="w"),
        lambda: Noise(-1.0),
        lambda: Noise(1.0, octaves=0),
    ):
        with pytest.raises(InputError):
            broken()


def test_answers_and_counts_do_not_depend_on_workers():
    picture = test_picture("desk", 8, 6)
    rays = PinholeRays.from_camera(picture.scene.camera)
    rng = np.random.default_rng(0)
    along = rays.directions(rng.uniform(0, 8, 40000), rng.uniform(0, 6, 40000))
    options = replace(picture.options, jitter=True, bundle=2)
    found = [
        Tracer(picture.scene, options, textures=picture.textures, workers=n).trace(rays.eye, along) for n in (1, 3)
    ]
    np.testing.assert_array_equal(found[0].radiance, found[1].radiance)
    assert dict(found[0].tally.counters()) == dict(found[1].tally.counters())


@pytest.mark.parametrize("name", PICTURES)
def test_every_picture_has_its_lights_and_is_neither_dark_nor_burnt(name):
    picture = test_picture(name, 32, 24)
    tracer = picture.tracer()
    assert tracer.light_count == {"pots": 2, "desk": 1, "spheres": 3, "tori": 1}[name]
    assert all(surface.material.specular.any() for surface in picture.scene.surfaces)  # "each is mirror reflective"
    assert len(picture.scene.surfaces) < tracer.triangle_count / 50
    rays = PinholeRays.from_camera(picture.scene.camera)
    radiance = tracer.trace(rays.eye, rays.row_directions(0, 24)).radiance
    assert 0.05 < np.clip(radiance, 0, 1).mean() < 0.6
    assert (radiance > 1).mean() < 0.05


def test_what_cannot_be_traced_is_refused():
    light = Light("odd", "laser", np.ones(1))
    for make, words in (
        (lambda: Tracer(scene([floor()], [light])), "laser"),
        (lambda: Tracer(scene([floor()], [Light("p", "point", np.ones(1))])), "position"),
        (lambda: Tracer(scene([floor()]), textures={"flor": Checker(1.0)}), "flor"),
        (lambda: Tracer(scene([floor()])).trace(np.zeros((2, 3)), np.repeat(DOWN, 3, axis=0)), "2 and 3"),
    ):
        with pytest.raises(InputError, match=words):
            make()
    for options in ({"depth": -1}, {"bundle": 0}, {"light_samples": 0}):
        with pytest.raises(OptionError):
            TraceOptions(**options)
    with pytest.raises(OptionError, match="vase"):
        test_picture("vase")
    with pytest.raises(OptionError):
        Tracer(scene([floor()]), workers=0)


@pytest.mark.skipif(not SPD.is_dir(), reason="the SPD scenes are not beside the repository")
@pytest.mark.parametrize(
    ("name", "facet_error", "hits", "reflected", "shadow_rays"),
    [
        ("tetra_6", 0.02, 49788, 0, 46112),
        ("teapot_12", 0.02, 161120, 225248, 407656),
        pytest.param("balls_4", 0.02, 263169, 175095, 954368, marks=pytest.mark.speed),
        ("balls_4", 0.1, 263169, None, 954368),
        pytest.param("tree_11", 0.1, 169836, 0, 1097419, marks=pytest.mark.speed),
    ],
)
def test_published_counts_of_the_standard_procedural_databases(name, facet_error, hits, reflected, shadow_rays):
    """513 x 513 eye rays through pixel corners; the numbers of Haines' Readme 3.14, within 1 per cent.

    His tree is at most 5 deep and "the eye ray is of depth 1": four reflections in a row.  Spheres
    and cones are facets here; the reader's default is fine enough for reflections between spheres too.
    """
    source = load_scene(SPD / f"{name}.nff", facet_error=facet_error)
    tracer = Tracer(source, TraceOptions(depth=4, falloff=False, see_backs=False))
    rays = PinholeRays.from_camera(source.camera)
    y, x = np.meshgrid(np.arange(513.0), np.arange(513.0), indexing="ij")
    tally = tracer.trace(rays.eye, rays.directions(x.ravel(), y.ravel())).tally
    assert tally.cast_hits == pytest.approx(hits, rel=0.01)
    assert tally.shadow.shot == pytest.approx(shadow_rays, rel=0.01)
    if reflected is not None:
        assert tally.reflection.shot == pytest.approx(reflected, rel=0.01)


def test_rays_that_meet_nothing_see_the_sky_also_in_mirrors():
    """Overcast: (1 + 2 sin) / 3 of the zenith's radiance; below the horizon the ground, 0.2 of 7 pi / 9 over pi."""
    sky = Sky("overcast", np.array([0.2]), zenith_radiance=np.array([9.0]))
    mirror = floor(2.0, matter=material("mirror", specular=0.5))
    tracer = Tracer(replace(scene([mirror], background=5.0), sky=sky))
    slant = np.array([np.sqrt(0.75), 0.0, 0.5])
    along = np.array([[0, 0, 1.0], slant, slant * [1, 1, -1], [0, 0, -1.0]])
    origins = np.array([[0, 0, 1.0], [0, 0, 1.0], [9, 0, 1.0], [0, 0, 1.0]])
    expected = [9.0, 6.0, 0.2 * 7 / 9 * 9.0, 4.5]
    np.testing.assert_allclose(tracer.trace(origins, along).radiance[:, 0], expected, rtol=1e-6)
    ends = tracer.trace_to_diffuse(origins, along)
    np.testing.assert_allclose(ends.radiance[:, 0], expected, rtol=1e-6)


def test_floor_seen_from_above_is_where_the_camera_says():
    """The texture's edge at x = 0.3 of a picture from -1 to 1 lies at column 6.5 of 10."""
    texture = {"floor": Checker(50.0, 1.0, 0.0, "x", (0.3, 0.0, 0.0))}
    tracer = Tracer(scene([floor()], [sun()], look_down(10, 0.2)), textures=texture)
    rays = PinholeRays.from_camera(tracer.scene.camera)
    found = tracer.trace(rays.eye, rays.directions([6.49, 6.51], [5.0, 5.0]))
    np.testing.assert_allclose(found.radiance[:, 0], [0.0, 1.0])
