"""Adaptive sampling's samples and sums, and what atomic adaptive sampling spares."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from trace_scenes import floor, look_down, material, scene, square, sun

from workbench.errors import MemoryForecastError, OptionError
from workbench.render.adaptive import adaptive, aliased, supersampled
from workbench.render.atomic import COMPONENTS, AtomicOptions
from workbench.render.pictures import PICTURES, test_picture
from workbench.render.textures import Checker, Noise
from workbench.render.trace import Tracer
from workbench.scene.model import Surface

EVERYTHING = -1.0


@pytest.fixture(scope="module")
def tracers():
    return {name: test_picture(name, 48, 36).tracer() for name in PICTURES}


def rms(one, other):
    return 255 * np.sqrt(((np.clip(one.radiance, 0, 1) - np.clip(other.radiance, 0, 1)) ** 2).mean())


def edge(at, pixels=4, **more):
    """A floor that is white left of x = ``at`` and black right of it."""
    texture = {"floor": Checker(50.0, 0.0, 1.0, "x", (at, 0.0, 0.0))}
    return Tracer(scene([floor()], [sun()], look_down(pixels, 1.0)), textures=texture, **more)


def test_aliased_and_supersampled_pictures_sample_middles():
    tracer = edge(0.3)
    assert aliased(tracer).radiance[:, :, 0].tolist() == [[1.0, 1.0, 0.0, 0.0]] * 4
    picture = supersampled(tracer, 10)
    np.testing.assert_allclose(picture.radiance[:, :, 0], [[1.0, 1.0, 0.3, 0.0]] * 4)
    assert picture.tally.cast.shot == 1600
    assert (picture.samples == 100).all()


def test_even_pixels_take_four_shared_samples():
    picture = adaptive(edge(9.0))
    assert picture.traced == 25  # corners of 4 x 4 pixels
    assert (picture.samples == 4).all()
    np.testing.assert_allclose(picture.radiance, 1.0)


@pytest.mark.parametrize("level", [1, 2, 3, 4])
def test_levels_allow_the_stated_number_of_samples(level):
    side = 2 ** (level - 1)
    picture = adaptive(edge(0.3), threshold=EVERYTHING, level=level)
    assert (picture.samples == (side + 1) ** 2).all()
    assert picture.traced == (4 * side + 1) ** 2  # each shared sample once
    # Trapezoid rule over the columns of samples: lit while their place is left of 0.3.
    lit = np.arange(side + 1) / side < 0.3
    weights = np.r_[0.5, np.ones(side - 1), 0.5] / side if side > 1 else np.array([0.5, 0.5])
    np.testing.assert_allclose(picture.radiance[:, 2, 0], (lit * weights).sum())


def test_only_uneven_quadrants_are_cut():
    """An edge at 0.3: of the pixel's four quadrants the two left ones are uneven."""
    picture = adaptive(edge(0.3), level=3)
    # 9 samples of level 2; then 5 in each of two quadrants, of which the middle of their common side is shared.
    assert picture.samples[:, 2].tolist() == [18] * 4
    assert picture.samples[:, [0, 1, 3]].max() == 4
    np.testing.assert_allclose(picture.radiance[:, 2, 0], 0.25 + 0.125)


@pytest.mark.parametrize("name", PICTURES)
@pytest.mark.parametrize("atomic", [None, AtomicOptions(), AtomicOptions(whole_tree=True)])
def test_bands_of_any_height_give_the_same_picture(tracers, name, atomic):
    """One row at a time, with the two rows of corners that the paper keeps, or all at once."""
    found = [adaptive(tracers[name], atomic=atomic, rows=rows) for rows in (1, 7, 36)]
    for other in found[1:]:
        np.testing.assert_array_equal(other.radiance, found[0].radiance)
        np.testing.assert_array_equal(other.samples, found[0].samples)
        np.testing.assert_array_equal(other.saved, found[0].saved)
        assert dict(other.tally.counters()) == dict(found[0].tally.counters())


@pytest.mark.parametrize("name", PICTURES)
def test_nothing_to_assume_changes_nothing(tracers, name):
    plain, none = adaptive(tracers[name]), adaptive(tracers[name], atomic=AtomicOptions(()))
    np.testing.assert_array_equal(plain.radiance, none.radiance)
    assert plain.tally == none.tally


@pytest.mark.parametrize("name", PICTURES)
def test_shadow_rays_shot_and_saved_add_up(tracers, name):
    """Forced to the last level both trace the same samples, so each light's sum must agree."""
    plain = adaptive(tracers[name], threshold=EVERYTHING)
    atomic = adaptive(tracers[name], threshold=EVERYTHING, atomic=AtomicOptions(("shadows",)))
    for light, all_shot in zip(atomic.tally.shadows, plain.tally.shadows, strict=True):
        assert light.saved > 0
        assert light.shot + light.saved == all_shot.shot
        assert light.assumed <= light.saved
    assert atomic.saved.sum() == atomic.tally.shadow.saved
    assert rms(plain, atomic) < 1.0


@pytest.mark.parametrize("component", COMPONENTS)
def test_each_component_is_a_switch_of_its_own(component):
    """A painted glass pane over a noisy, shiny floor: every component has something to assume."""
    glass = material("glass", 0.3, transmittance=0.5, specular=0.2, ior=1.3)
    pane = Surface.from_polygons("pane", glass, [square((-3.0, -4.0), (0.3, 4.0), 1.0)])
    texture = {"floor": Noise(4.0, 0.1, 1.0, 1, 1.0), "pane": Checker(0.37, 1.0, 0.1, "xy", (0.01, 0.02, 0.0))}
    shiny = floor(matter=material("floor", 0.9, specular=0.1))
    tracer = Tracer(scene([shiny, pane], [sun(2.0, (0.6, 0.0, -0.8))], look_down(16, 0.5), 0.5), textures=texture)
    plain = adaptive(tracer)
    atomic = adaptive(tracer, atomic=AtomicOptions((component,)))
    counts = {
        "shadows": atomic.tally.shadow,
        "cast": atomic.tally.cast,
        "reflection": atomic.tally.reflection,
        "refraction": atomic.tally.refraction,
    }
    for name, count in counts.items():
        assert (count.saved > 0) == (name == component)
        assert (count.assumed > 0) == (name == component)
    assert atomic.tally.rays < plain.tally.rays
    assert rms(plain, atomic) < 2.0
    whole = adaptive(tracer, atomic=AtomicOptions((component,), whole_tree=True))
    assert whole.tally.rays <= atomic.tally.rays
    assert rms(plain, whole) < 2.0


@pytest.mark.parametrize("name", PICTURES)
def test_rays_are_saved_in_every_picture_and_more_with_the_whole_tree(tracers, name):
    plain = adaptive(tracers[name])
    top = adaptive(tracers[name], atomic=AtomicOptions())
    tree = adaptive(tracers[name], atomic=AtomicOptions(whole_tree=True))
    assert top.tally.rays < 0.7 * plain.tally.rays
    assert tree.tally.rays < top.tally.rays
    assert rms(plain, top) < 5.0 and rms(plain, tree) < 5.0  # 48 x 36 pixels: outlines are wide


def test_reflections_that_differ_are_not_interpolated():
    """A mirror that shows a checker: interpolating its corners would blur the edges."""
    mirror = floor(matter=material("mirror", specular=1.0))
    ceiling = Surface.from_polygons("ceiling", material("ceiling", emission=np.pi), [square((-9, -9), (9, 9), 20.0)])
    half = Surface.from_polygons("dark half", material("dark"), [square((0.3, -9), (9, 9), 19.0)])
    tracer = Tracer(scene([mirror, ceiling, half], camera=look_down(6, 0.5)))
    plain = adaptive(tracer)
    careful = adaptive(tracer, atomic=AtomicOptions(("reflection",), similar=0.0))
    np.testing.assert_allclose(careful.radiance, plain.radiance, atol=1e-12)
    careless = adaptive(tracer, atomic=AtomicOptions(("reflection",), similar=10.0))
    assert careless.tally.reflection.saved > careful.tally.reflection.saved
    assert rms(plain, careless) > rms(plain, careful)


def test_shared_boundary_criterion_finds_what_a_neighbour_saw():
    """Thin lines across two pixels: one pixel's corners show its line, the other's do not."""
    bars = [square((-0.9, -0.55), (1.8, -0.45), 0.5), square((-0.05, -0.55), (0.05, 0.4), 0.5)]
    lines = Surface.from_polygons("bars", material("bars"), bars)
    tracer = Tracer(scene([floor(), lines], [sun()], look_down(4, 1.0)))
    plain = adaptive(tracer)
    more = adaptive(tracer, shared_boundary=True)
    assert (more.samples >= plain.samples).all()
    assert (more.samples > plain.samples).any()
    np.testing.assert_array_equal(
        more.radiance[more.samples == plain.samples], plain.radiance[more.samples == plain.samples]
    )
    exact = supersampled(tracer, 32)
    assert rms(more, exact) < rms(plain, exact)


def test_pictures_do_not_depend_on_workers():
    one, three = (test_picture("pots", 40, 30).tracer(workers) for workers in (1, 3))
    for options in (None, AtomicOptions(whole_tree=True)):
        found = [adaptive(tracer, atomic=options) for tracer in (one, three)]
        np.testing.assert_array_equal(found[0].radiance, found[1].radiance)
        assert found[0].tally == found[1].tally


def test_options_out_of_range_are_refused():
    tracer = edge(0.3)
    for call in (
        lambda: adaptive(tracer, level=0),
        lambda: adaptive(tracer, rows=0),
        lambda: supersampled(tracer, 0),
        lambda: AtomicOptions(("shadow",)),
        lambda: AtomicOptions(similar=-1.0),
        lambda: AtomicOptions(normal_angle_deg=0.0),
    ):
        with pytest.raises(OptionError):
            call()
    blind = Tracer(dataclasses.replace(tracer.scene, camera=None))
    with pytest.raises(Exception, match="camera"):
        aliased(blind)


def test_a_picture_that_does_not_fit_is_refused_before_it_starts(tracers, monkeypatch):
    """64 x 48 pixels hold 16 bytes of counts and 4 copies of 3 float64 each; a band of level 8 holds far more."""
    monkeypatch.setattr("workbench.memory.available_bytes", lambda: 64 * 48 * (16 + 96) + 10**6)
    tracer = tracers["tori"]
    aliased(tracer)
    with pytest.raises(MemoryForecastError, match="lower level"):
        adaptive(tracer, level=8)
