"""The tracer's floor under every light: soft shadows equal the exact truths, as traced radiance E rho / pi."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from instrument_scenes import FAR, UNIT_SQUARE_LIGHT, rectangle, truth
from trace_scenes import floor, look_down, material, scene, square

from workbench.render.adaptive import adaptive
from workbench.render.atomic import AtomicOptions
from workbench.render.textures import Checker
from workbench.render.trace import TraceOptions, Tracer
from workbench.scene.library import sphere_surface
from workbench.scene.model import Light, Scene, Surface

E0 = 0.23083679773017077
"""Lambert: irradiance below the unit square at height 2, radiance 1."""
LAMP = material("lamp", emission=math.pi, two_sided=False)
SQUARE = Surface.from_polygons("lamp", LAMP, [UNIT_SQUARE_LIGHT])


def sheet(polygon, name="sheet", **more):
    return Surface.from_polygons(name, material(name, **more), [polygon])


def received(x, *surfaces, light=None, y=None, matter=None, start=0.1, **options):
    """Irradiance of a white floor at (x, y): radiance of rays straight down, times pi."""
    x = np.asarray(x, dtype=float)
    origins = np.column_stack([x, np.zeros_like(x) if y is None else y, np.full_like(x, start)])
    tracer = Tracer(
        scene([floor(2 * FAR, matter=matter), *surfaces], [light] if light else []), TraceOptions(**options)
    )
    return math.pi * tracer.trace(origins, np.tile([0.0, 0.0, -1.0], (len(x), 1))).radiance[:, 0]


def test_open_area_lights():
    np.testing.assert_allclose(received(0.25 * np.arange(13), SQUARE), truth("light/quad-row"), rtol=1e-9)
    wall = Surface.from_polygons("lamp", LAMP, [np.array([[0, -1, 0], [0, 1, 0], [0, 1, 1], [0, -1, 1.0]])])
    found = received([0.01, 0.1, 0.5, 1, 2], wall)
    np.testing.assert_allclose(found, truth("light/vertical-quad-on-floor"), rtol=1e-9)


@pytest.mark.parametrize("lambertian", [False, True])
def test_open_linear_light(lambertian):
    ends = np.array([-1, 1, 2.0]), np.array([3, 1, 2.0])
    light = Light("tube", "linear", np.ones(1), position=ends[0], end=ends[1], lambertian=lambertian)
    wanted = truth(f"light/linear-{'lambertian' if lambertian else 'isotropic'}")
    assert received([0.0], light=light)[0] == pytest.approx(wanted, rel=1e-9)


def test_lights_without_extent():
    spot = Light("spot", "spot", np.ones(1), position=np.array([0, 0, 2.0]), direction=np.array([0, 0, -1.0]),
                 cone_deg=30.0, exponent=4.0)  # fmt: skip
    np.testing.assert_allclose(received([0.0, 0.5, 1.0, 1.25], light=spot), truth("light/spot"), rtol=1e-9)
    sun = Light("sun", "directional", np.ones(1), direction=np.array([-1.0, -2.0, -2.0]))
    assert received([0.0], light=sun)[0] == pytest.approx(truth("light/directional"), rel=1e-9)


def test_emitting_sphere_is_exact_whatever_its_facets():
    """A sphere whole above the horizon gives (R / d)^2 cos: 1/9 below the middle."""
    ball = sphere_surface("ball", LAMP, [0, 0, 3.0], 1.0, facet_error=0.1)
    x = np.array([0.0, 1.0, 2.0])
    np.testing.assert_allclose(received(x, ball), math.pi * 3 / (x * x + 9) ** 1.5, rtol=1e-9)


def test_straight_edge():
    shade = sheet(rectangle(0.0, FAR, -FAR, FAR, 1.0))
    found = received(np.arange(-12, 13) / 20, SQUARE, shade)
    np.testing.assert_allclose(found, truth("shadow/straight-edge/profile"), atol=1e-6 * E0)
    tube = Light("tube", "linear", np.ones(1), position=np.array([-0.5, 0, 2.0]), end=np.array([0.5, 0, 2.0]))
    found = received(np.arange(-6, 7) / 10, shade, light=tube)
    np.testing.assert_allclose(found, truth("shadow/straight-edge/linear-light"), atol=1e-6)


@pytest.mark.parametrize(("path", "side"), [("row", 0.4), ("row", 1.5), ("diagonal", 1.5)])
def test_square_occluder(path, side):
    x = np.arange(18) / 8
    shade = sheet(rectangle(-side / 2, side / 2, -side / 2, side / 2, 1.0))
    found = received(x, SQUARE, shade, y=x if path == "diagonal" else None)
    np.testing.assert_allclose(found, truth(f"shadow/square/{path}-a={side}"), atol=1e-6 * E0)


@pytest.mark.parametrize("name", ["same", "crossed"])
def test_two_half_planes(name):
    second = rectangle(0.0, FAR, -FAR, FAR, 1.5) if name == "same" else rectangle(-FAR, FAR, 0.0, FAR, 1.5)
    shades = sheet(rectangle(0.0, FAR, -FAR, FAR, 1.0)), sheet(second, "second")
    wanted = truth(f"shadow/two-half-planes-{name}") * E0
    assert received([0.0], SQUARE, *shades)[0] == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize(("tau", "count"), [(0.5, 3), (0.9, 10)])
def test_transparent_panes(tau, count):
    panes = [sheet(rectangle(-9, 9, -9, 9, 0.2 + 0.15 * k), f"pane {k}", transmittance=tau) for k in range(count)]
    wanted = truth(f"shadow/transparent-panes-{tau}-x{count}") * E0
    assert received([0.0], SQUARE, *panes)[0] == pytest.approx(wanted, rel=1e-6)


def test_coloured_panes_keep_their_colours():
    """To the shadow module panes are grey, so these lights take rays: each band passes its own share."""

    def coloured(surface, **more):
        matter = surface.material
        bands = {k: np.repeat(getattr(matter, k), 3) for k in ("reflectance", "emission", "specular", "transmittance")}
        return replace(surface, material=replace(matter, **bands | more))

    pane = coloured(
        sheet(rectangle(-9, 9, -9, 9, 1.0), "pane", transmittance=1.0), transmittance=np.array([0.9, 0.5, 0.1])
    )
    tracer = Tracer(Scene("test", (coloured(floor()), coloured(SQUARE), pane), (), None))
    found = math.pi * tracer.trace([0, 0, 0.5], [[0, 0, -1.0]]).radiance[0]
    np.testing.assert_allclose(found, E0 * np.array([0.9, 0.5, 0.1]), rtol=0.01)


def test_a_mesh_of_many_faces_takes_rays_and_shines_as_one_light():
    """The square cut into 64: more lights than the shadow module is asked about."""
    cells = [
        square((i / 8 - 0.5, j / 8 - 0.5), (i / 8 - 0.375, j / 8 - 0.375), 2.0)[::-1]
        for i in range(8)
        for j in range(8)
    ]
    tracer = Tracer(scene([floor(), Surface.from_polygons("lamp", LAMP, cells)]))
    assert tracer.light_names == ("lamp",)
    found = tracer.trace([0, 0, 0.5], [[0, 0, -1.0]])
    assert found.tally.shadow.shot > 1
    assert math.pi * found.radiance[0, 0] == pytest.approx(E0, rel=0.01)


def test_lamps_of_one_name_are_two_lights():
    halves = [
        Surface.from_polygons("lamp", LAMP, [ring[::-1]])
        for ring in (rectangle(-0.5, 0.0, -0.5, 0.5, 2.0), rectangle(0.0, 0.5, -0.5, 0.5, 2.0))
    ]
    assert received([0.0], *halves)[0] == pytest.approx(E0, rel=1e-9)


def test_two_faces_are_one_light_with_one_state():
    halves = [rectangle(-0.5, 0.0, -0.5, 0.5, 2.0)[::-1], rectangle(0.0, 0.5, -0.5, 0.5, 2.0)[::-1]]
    lamp = Surface.from_polygons("lamp", LAMP, halves)
    shade = sheet(rectangle(0.0, FAR, -FAR, FAR, 1.0))
    x = np.array([-0.6, -0.2, 0.0, 0.2, 0.6])
    tracer = Tracer(scene([floor(2 * FAR), lamp, shade]))
    trees = tracer.ray_trees(len(x))
    origins = np.column_stack([x, 0 * x, 0 * x + 0.1])
    found = tracer.trace(origins, np.tile([0, 0, -1.0], (5, 1)), record=trees)
    assert trees.state[:, 0, 0].tolist() == [0, 2, 2, 2, 1]
    np.testing.assert_allclose(math.pi * found.radiance[:, 0], received(x, SQUARE, shade), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("samples", [None, 256])
def test_both_sides_of_a_two_sided_lamp_shine(samples):
    """The unit square at height 2, front up: the floor below and the ceiling above, at 4, get the same."""
    lamp = Surface.from_polygons("lamp", material("lamp", emission=math.pi), [UNIT_SQUARE_LIGHT[::-1]])
    lid = sheet(square((-9, -9), (9, 9), 4.0), "lid", reflectance=1.0)
    tracer = Tracer(scene([floor(), lamp, lid]), TraceOptions(light_samples=samples))
    found = tracer.trace([[0, 0, 1.0], [0, 0, 3.0]], [[0, 0, -1.0], [0, 0, 1.0]]).radiance[:, 0]
    np.testing.assert_allclose(math.pi * found, E0, rtol=1e-9 if samples is None else 0.01)


def test_highlight_of_a_linear_light_needs_rays_in_its_penumbra_only():
    """Against 4096 rays along the light; no ray where all of it is seen."""
    light = Light("tube", "linear", np.ones(1), position=np.array([-0.5, 0, 2.0]), end=np.array([0.5, 0, 2.0]))
    gloss = material("gloss", 0.5, specular=0.4, exponent=8.0)
    shade = sheet(rectangle(0.0, FAR, -FAR, FAR, 1.0))
    x = np.arange(-6, 7) / 10
    found, many = (received(x, shade, light=light, matter=gloss, light_samples=k, depth=0) for k in (None, 4096))
    np.testing.assert_allclose(found, many, atol=0.01 * many.max())
    dull = received(x, shade, light=light, matter=material("dull", 0.5), depth=0)
    assert (found[:6] > dull[:6]).all()
    tracer = Tracer(scene([floor(matter=gloss)], [light]), TraceOptions(depth=0))
    assert tracer.trace([0, 0, 1.0], [[0, 0, -1.0]]).tally.shadow.shot == 1


def test_assumed_states_give_the_same_light_without_asking():
    """Guided by corners that agree, an open point gets the closed form; in a penumbra nothing is assumed."""
    shade = sheet(rectangle(0.0, FAR, -FAR, FAR, 5.0))
    lamp = Surface.from_polygons("lamp", LAMP, [UNIT_SQUARE_LIGHT + [0, 0, 8.0]])
    camera = look_down(16, 0.1, height=4.0)
    tracer = Tracer(scene([floor(), shade, lamp], (), camera), textures={"floor": Checker(0.07, 1.0, 0.2, "xy")})
    only = AtomicOptions(("shadows",))
    plain, atomic = (adaptive(tracer, threshold=1e-4, atomic=kind) for kind in (None, only))
    np.testing.assert_allclose(atomic.radiance, plain.radiance, rtol=1e-9, atol=1e-12)
    saved, shot = atomic.tally.shadow.saved, atomic.tally.shadow.shot
    assert saved > 0 and saved + shot == plain.tally.shadow.shot
    # Penumbra below the edge: |x| < 0.5 at these heights; columns 3..12 lie inside it.
    assert (atomic.saved[:, 4:12] == 0).all()


def test_shadow_error_bounds_the_visible_share_below_many_facets():
    """A ball of 5,000 facets over the floor: root mean square error of the share, against 65,536 rays a point."""
    ball = sphere_surface("ball", material("ball"), [0.1, 0.05, 1.0], 0.3, facet_error=0.002)
    x, y = np.random.default_rng(4).uniform(-0.8, 0.8, (2, 300))
    parts = SQUARE, ball
    shares = {
        error: received(x, *parts, y=y, shadow_error=error) / received(x, SQUARE, y=y) for error in (0.1, 0.02, 2e-4)
    }
    for error in (0.1, 0.02):
        off = shares[error] - shares[2e-4]
        assert 0 < np.sqrt((off**2).mean()) < error
