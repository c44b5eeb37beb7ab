"""Where adaptive and atomic adaptive sampling fail, and the number that shows it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from trace_scenes import floor, look_down, material, scene, square, sun

from workbench.render.adaptive import adaptive
from workbench.render.atomic import AtomicOptions
from workbench.render.textures import Checker
from workbench.render.trace import TraceOptions, Tracer
from workbench.scene.library import diffuse
from workbench.scene.model import Light, Surface

EVERYTHING = -1.0  # a threshold below every difference: all samples to the last level
SHADOWS = AtomicOptions(("shadows",))


def blocked_sun(squares, pixels=8, camera=None):
    """A floor of pixels one unit wide under a sun that squares above the camera block in part."""
    screens = Surface.from_polygons("screens", material("screens"), [square(*s, 12.0) for s in squares])
    return Tracer(scene([floor(), screens], [sun()], camera or look_down(pixels, 1.0)))


def test_5_1_small_shadow_between_lit_corners_is_missed_and_its_chance_is_known():
    rng = np.random.default_rng(4)
    side, found, hidden = 0.5, [], 0
    for _ in range(40):
        low = rng.uniform(-1.5, 1.0, 2)
        tracer = blocked_sun([(low, low + side)], pixels=4)
        plain = adaptive(tracer, threshold=EVERYTHING, level=5)
        atomic = adaptive(tracer, threshold=EVERYTHING, level=5, atomic=SHADOWS)
        corner_dark = bool((np.floor(low + side) > np.floor(low)).all())  # a corner of the grid lies inside
        missing = 16.0 - plain.radiance.sum()
        assert missing == pytest.approx(side**2, abs=0.08)
        if not corner_dark and (np.floor(low + side) == np.floor(low)).all():
            assert atomic.radiance.sum() == pytest.approx(16.0, rel=1e-12)  # inside one pixel: lost whole
        if corner_dark:
            assert atomic.radiance.sum() < 16.0 - 0.1
        hidden += not corner_dark
        found.append(atomic.tally.shadow.saved)
    assert min(found) > 0
    # Chance 1 - w^2 that no grid corner falls into the shadow, of which (1 - w)^2 lie inside one pixel.
    assert hidden / 40 == pytest.approx(1 - side**2, abs=0.2)


def test_5_1_shadow_of_one_pixel_is_always_found_and_a_finer_grid_finds_the_lost_one():
    rng = np.random.default_rng(9)
    for _ in range(20):
        low = rng.uniform(-1.5, 0.4, 2)
        atomic = adaptive(blocked_sun([(low, low + 1.001)], pixels=4), atomic=SHADOWS)
        assert atomic.radiance.min() < 0.9
    hidden = [((0.25, 0.25), (0.75, 0.75))]
    coarse = adaptive(blocked_sun(hidden), threshold=EVERYTHING, atomic=SHADOWS)
    fine = adaptive(blocked_sun(hidden, camera=look_down(32, 0.25)), threshold=EVERYTHING, atomic=SHADOWS)
    assert coarse.radiance.min() == pytest.approx(1.0)  # reports 1 where 0.75 is lit
    assert fine.radiance.mean() == pytest.approx(1 - 0.25 / 64, abs=2e-3)
    # Plain adaptive sampling without a reason to look misses it as well.
    assert adaptive(blocked_sun(hidden)).samples.max() == 4


def test_5_2_lit_gap_between_dark_corners_is_missed():
    slabs = [((-9.0, -9.0), (0.4, 9.0)), ((0.6, -9.0), (9.0, 9.0))]
    pixel = np.s_[:, 4]  # x from 0 to 1
    plain = adaptive(blocked_sun(slabs), threshold=EVERYTHING, level=6)
    atomic = adaptive(blocked_sun(slabs), threshold=EVERYTHING, level=6, atomic=SHADOWS)
    assert plain.radiance[pixel].mean() == pytest.approx(7 / 32)  # 7 of 32 columns of samples lie in the gap
    assert atomic.radiance[pixel].max() == 0.0
    # The gap is wider than these pixels: a corner falls into it.
    finer = adaptive(blocked_sun(slabs, camera=look_down(50, 0.16)), threshold=EVERYTHING, level=6, atomic=SHADOWS)
    assert finer.radiance.mean() == pytest.approx(0.2 / 8, abs=2e-3)


def test_5_3_fold_on_one_surface_needs_the_criterion_of_normals():
    """A groove 0.6 wide in the floor, all one surface: its wall is dark, the corners on the floor are lit."""
    edges = (-4.0, 0.2, 0.5, 0.8, 4.0)
    heights = (0.0, 0.0, -0.3, 0.0, 0.0)
    rings = [
        np.array([[x0, -4, z0], [x1, -4, z1], [x1, 4, z1], [x0, 4, z0]], dtype=float)
        for x0, x1, z0, z1 in zip(edges, edges[1:], heights, heights[1:], strict=False)
    ]
    groove = Surface.from_polygons("groove", diffuse("groove", 1.0), rings)
    slant = np.array([1.0, 0.0, -0.8]) / np.hypot(1.0, 0.8)
    tracer = Tracer(scene([groove], [sun(direction=slant)], look_down(4, 1.0)))
    plain = adaptive(tracer, threshold=EVERYTHING)
    trusting = adaptive(tracer, threshold=EVERYTHING, atomic=SHADOWS)
    careful = adaptive(tracer, threshold=EVERYTHING, atomic=AtomicOptions(("shadows",), normal_angle_deg=10.0))
    assert np.abs(trusting.radiance - plain.radiance).max() > 0.02
    np.testing.assert_array_equal(careful.radiance, plain.radiance)
    assert 0 < careful.tally.shadow.saved < trusting.tally.shadow.saved


def penumbra(pixels=6, samples=64):
    """The floor between x = -0.1 and 0.1 under a unit square light and a half-plane's edge, all penumbra."""
    lamp = Surface.from_polygons(
        "lamp", material("lamp", emission=np.pi, two_sided=False), [square((-0.5, -0.5), (0.5, 0.5), 2.0)[::-1]]
    )
    half = Surface.from_polygons("half-plane", material("half"), [square((0.0, -9.0), (9.0, 9.0), 1.0)])
    camera = look_down(pixels, 0.2 / pixels, height=0.9)
    return Tracer(scene([floor(), lamp, half], camera=camera), TraceOptions(light_samples=samples))


def test_5_4_no_shadow_ray_is_saved_in_a_penumbra():
    tracer = penumbra()
    plain = adaptive(tracer, threshold=EVERYTHING)
    atomic = adaptive(tracer, threshold=EVERYTHING, atomic=AtomicOptions())
    assert atomic.tally.shadow.saved == 0
    assert atomic.tally.shadow.shot == plain.tally.shadow.shot > 0
    np.testing.assert_array_equal(atomic.radiance, plain.radiance)


def test_5_4_penumbra_has_the_exact_profile():
    """Irradiance at x = -0.1, 0, 0.1 behind the half-plane, the light's clipped polygon by Lambert's formula."""
    tracer = penumbra(samples=4096)
    points = np.array([[-0.1, 0.0], [0.0, 0.0], [0.1, 0.0]])
    eye = np.array([0.0, 0.0, 0.9])
    along = np.column_stack([points, np.zeros(3)]) - eye
    found = np.pi * tracer.trace(eye, along).radiance[:, 0]
    np.testing.assert_allclose(found, [0.14134448786, 0.11541839887, 0.08851031558], rtol=5e-3)


def test_5_5_transparent_shadows_compare_values_not_flags():
    """Left of x = 0 one pane of 0.5, right of it two: all corners say Complex_Shadow."""
    pane = material("pane", transmittance=0.5)
    panes = [
        Surface.from_polygons("whole", pane, [square((-9.0, -9.0), (9.0, 9.0), 12.0)]),
        Surface.from_polygons("half", pane, [square((0.1, -9.0), (9.0, 9.0), 13.0)]),
    ]
    tracer = Tracer(scene([floor(), *panes], [sun()], look_down(4, 1.0)))
    atomic = adaptive(tracer, threshold=EVERYTHING, atomic=AtomicOptions())
    assert atomic.tally.shadow.saved == 0
    np.testing.assert_allclose(atomic.radiance[:, :2], 0.5)
    np.testing.assert_allclose(atomic.radiance[:, 3], 0.25)
    # Samples at 0, 1/4 ... of the pixel from 0 to 1, the first of five of them left of the edge.
    np.testing.assert_allclose(atomic.radiance[:, 2], 0.125 * 0.5 + 0.875 * 0.25)


@pytest.mark.parametrize(("samples", "error"), [(1, 0.3), (17, 1 / 16)])
def test_5_6_linear_light_misses_gaps_between_its_samples(samples, error):
    """An occluder that hides 0.3 of the light: the middle alone reports nothing, 17 are within 1/16."""
    hide = Surface.from_polygons("slat", material("slat"), [square((-0.2, -9.0), (-0.05, 9.0), 1.0)])
    ends = np.array([-0.5, 0.0, 2.0]), np.array([0.5, 0.0, 2.0])
    light = Light("tube", "linear", np.ones(1), position=ends[0], end=ends[1])
    ray = np.array([[0.0, 0.0, 0.5]]), np.array([[0.0, 0.0, -1.0]])
    seen = [
        Tracer(scene(parts, [light]), TraceOptions(light_samples=samples)).trace(*ray).radiance[0, 0]
        for parts in ([floor()], [floor(), hide])
    ]
    blocked = 1 - seen[1] / seen[0]
    assert abs(blocked - 0.3) <= error + 1e-12
    if samples == 1:
        assert blocked == 0.0


def test_5_7_dip_between_equal_corners_is_not_found_by_subdivision():
    """Irradiance 0.0789 under a square occluder between corners that agree: one pixel sees no dip, 16 x 16 do."""
    lamp = Surface.from_polygons(
        "lamp", material("lamp", emission=np.pi, two_sided=False), [square((-0.5, -0.5), (0.5, 0.5), 2.0)[::-1]]
    )
    small = Surface.from_polygons("square", material("square"), [square((-0.2, -0.2), (0.2, 0.2), 1.0)])
    parts = [floor(), lamp, small]

    def picture(pixels, surfaces=parts):
        camera = look_down(pixels, 1.75 / pixels, height=0.9)
        return adaptive(
            Tracer(scene(surfaces, camera=camera), TraceOptions(light_samples=256)), threshold=0.005, level=5
        )

    assert picture(1).samples.max() == 4
    assert picture(1).radiance[0, 0, 0] == pytest.approx(picture(1, parts[:2]).radiance[0, 0, 0], rel=0.01)
    fine = np.pi * picture(16).radiance
    assert 0.0789 < fine.min() < 0.084  # the pixel's mean lies a little above the middle's value
    assert fine.mean() < 0.9 * np.pi * picture(16, parts[:2]).radiance.mean()


def test_5_8_error_falls_with_level_down_to_what_the_threshold_hides():
    """A strong edge and a weak one, each through one pixel row; exact means are known."""
    rows = np.s_[:, :, 0]

    def error(dark, level):
        # Checker columns of 2.7 units, edges at x = -0.35 and 2.35.
        texture = {"floor": Checker(2.7, 1.0, dark, "x", (-0.35, 0.0, 0.0))}
        tracer = Tracer(scene([floor()], [sun()], look_down(4, 1.0)), textures=texture)
        exact = np.array([dark, dark * 0.65 + 0.35, 1.0, 1.0])
        return np.abs(adaptive(tracer, threshold=0.06, level=level).radiance[rows] - exact).max()

    strong = [error(0.2, level) for level in (1, 3, 5, 7)]
    weak = [error(0.95, level) for level in (1, 3, 5, 7)]
    assert all(after < 0.6 * before for before, after in pairwise(strong))
    assert strong[-1] < 0.01
    assert weak[0] == weak[1] == weak[2] == weak[3] == pytest.approx(0.05 * 0.15, abs=1e-9)


@pytest.mark.parametrize(("transmittance", "panes"), [(0.9, 10), (0.5, 3)])
def test_5_9_transparent_panes_multiply(transmittance, panes):
    pane = material("pane", transmittance=transmittance)
    sheets = [
        Surface.from_polygons(f"pane {i}", pane, [square((-9.0, -9.0), (9.0, 9.0), 2.0 + 0.1 * i)])
        for i in range(panes)
    ]
    found = Tracer(scene([floor(), *sheets], [sun()])).trace([0.3, 0.2, 1.0], [[0.0, 0.0, -1.0]])
    assert found.radiance[0, 0] == pytest.approx(transmittance**panes, rel=1e-12)
