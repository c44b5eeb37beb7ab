"""Pictures of scenes without reflected light: pixels show the exact irradiance of the shared truths."""

from __future__ import annotations

import numpy as np
import pytest
from picture_scenes import lit_floor, solved, straight_down
from radiosity_scenes import truth

from radiosity.gather import PictureGatherer
from workbench.scene.library import diffuse
from workbench.scene.model import Light, Scene, Surface

E0 = 0.23083679773017077
FAR = 50.0


def _half_plane(height, axis):
    """The half-plane x > 0 (axis 0) or y > 0 (axis 1) at a height, as far as it matters."""
    low = [-FAR, -FAR]
    low[axis] = 0.0
    return [[low[0], low[1], height], [FAR, low[1], height], [FAR, FAR, height], [low[0], FAR, height]]


def _seen(scene, points):
    """Irradiance that the middle pixels of small patches of floor show: radiance times pi / rho."""
    gatherer = PictureGatherer(solved(scene), workers=1)
    return [gatherer.draw(straight_down(x, y, width=1e-4)).radiance[1, 1, 0] * np.pi / 0.5 for x, y in points]


def _row(name):
    case = truth(name)
    geometry = case["geometry"]
    x = geometry.get("x", geometry.get("s"))
    return case, [(each, each if "diagonal" in name else 0.0) for each in x]


@pytest.mark.parametrize(
    "name", ["light/quad-row", "shadow/square/row-a=1.5", "shadow/square/row-a=0.4", "shadow/square/diagonal-a=1.5"]
)
def test_rows_under_a_quad(name):
    case, points = _row(name)
    occluders = [case["geometry"]["occluder"]] if "occluder" in case["geometry"] else []
    assert _seen(lit_floor(*occluders), points) == pytest.approx(case["value"], abs=1e-5 * E0)


def test_a_straight_edge():
    case, points = _row("shadow/straight-edge/profile")
    assert _seen(lit_floor(_half_plane(1.0, 0)), points) == pytest.approx(case["value"], abs=1e-5 * E0)


@pytest.mark.parametrize(("name", "axis"), [("same", 0), ("crossed", 1)])
def test_two_half_planes(name, axis):
    wanted = truth(f"shadow/two-half-planes-{name}")["value"]
    found = _seen(lit_floor(_half_plane(1.0, 0), _half_plane(1.5, axis)), [(0.0, 0.0)])
    assert found[0] / E0 == pytest.approx(wanted, abs=1e-5)


def test_a_quad_that_stands_on_the_floor():
    case = truth("light/vertical-quad-on-floor")
    floor = [[-6, -6, 0], [6, -6, 0], [6, 6, 0], [-6, 6, 0]]
    scene = Scene(
        "standing light",
        (
            Surface.from_polygons("floor", diffuse("grey", 0.5), [np.array(floor, float)]),
            Surface.from_polygons("light", diffuse("light", 0.0, np.pi), [np.array(case["geometry"]["light"], float)]),
        ),
        background=np.zeros(1),
        bands=1,
    )
    points = [(x, 0.0) for x in case["geometry"]["x"]]
    assert _seen(scene, points) == pytest.approx(case["value"], rel=1e-4)


def _floor_and(light):
    floor = np.array([[-6, -6, 0], [6, -6, 0], [6, 6, 0], [-6, 6, 0]], float)
    surface = Surface.from_polygons("floor", diffuse("grey", 0.5), [floor])
    return Scene("floor", (surface,), lights=(light,), background=np.zeros(1), bands=1)


def test_lights_without_surface():
    one = np.ones(1)
    sun = Light("sun", "directional", one, direction=-np.array([1, 2, 2]) / 3.0)
    assert _seen(_floor_and(sun), [(0, 0)]) == pytest.approx([truth("light/directional")["value"]], rel=1e-9)
    spot = Light(
        "spot",
        "spot",
        one,
        position=np.array([0, 0, 2.0]),
        direction=np.array([0, 0, -1.0]),
        cone_deg=30.0,
        exponent=4.0,
    )
    case = truth("light/spot")
    points = [(x, y) for x, y, _ in case["geometry"]["points"]]
    assert _seen(_floor_and(spot), points) == pytest.approx(case["value"], rel=1e-6)
    for kind in ("isotropic", "lambertian"):
        tube = Light(
            "tube", "linear", one, position=np.array([-1, 1, 2.0]), end=np.array([3, 1, 2.0]),
            lambertian=kind == "lambertian",
        )  # fmt: skip
        wanted = truth(f"light/linear-{kind}")["value"]
        assert _seen(_floor_and(tube), [(0, 0)]) == pytest.approx([wanted], rel=1e-6)
