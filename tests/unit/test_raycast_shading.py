"""Phong's formula against values worked out by hand, and the camera's rays."""

import math

import numpy as np
import pytest

from workbench.errors import InputError, OptionError
from workbench.render.camera import PinholeRays
from workbench.render.image import to_bytes
from workbench.render.raycast import RayCaster
from workbench.scene.model import Camera
from workbench.scene.sc import read_sc

# One pixel, eye at (0, 0, 5) looking down -z, so the ray is the axis and V = (0, 0, 1).
EYE = "size 1 1 background .1 .2 .3 lookat 0 0 5  0 0 0  0 1 0 ambient {ambient} world\n"
SQUARE = "polygon 4  -9 -9 0  9 -9 0  9 9 0  -9 9 0\n"
MATTE = "material m { color .8 .6 .4  kdr .5 } use m\n"
SHINY = "material m { color .8 .6 .4  kdr .5  ksr .25  e 3 } use m\n"
HALF, ROOT2, ROOT3 = 0.5, math.sqrt(2), math.sqrt(3)
DIFFUSE = np.array([0.4, 0.3, 0.2])  # C_mat k_dr of both materials

# ambient, world, radiance by hand.
PIXELS = {
    "background": ("1 1 1", "", [0.1, 0.2, 0.3]),
    "ambient alone": (".5 .25 1", MATTE + SQUARE, [0.2, 0.075, 0.2]),
    # N.L = 1
    "light on the axis": ("0 0 0", MATTE + SQUARE + "light 0 0 2  1 .5 .25", DIFFUSE * [1, 0.5, 0.25]),
    # The same from farther: nothing falls with distance.
    "no attenuation": ("0 0 0", MATTE + SQUARE + "light 0 0 900  1 .5 .25", DIFFUSE * [1, 0.5, 0.25]),
    # 60 degrees off: N.L = 1/2, N.H = cos 30 = sqrt(3)/2, cubed 3 sqrt(3)/8; the highlight is white.
    "highlight": (
        ".1 .1 .1",
        SHINY + SQUARE + f"light {ROOT3} 0 1  1 1 1",
        DIFFUSE * (0.1 + HALF) + 0.25 * 3 * ROOT3 / 8,
    ),
    # 120 degrees off: N.L = -1/2 counts 0, N.H = cos 60 = 1/2, cubed 1/8: the formula clamps each alone.
    "light behind the surface": ("0 0 0", SHINY + SQUARE + f"light {ROOT3} 0 -1  1 1 1", [0.25 / 8] * 3),
    # Straight behind: H has no direction and counts 0.
    "light opposite the viewer": (".5 .5 .5", SHINY + SQUARE + "light 0 0 -4  1 1 1", DIFFUSE / 2),
    # Seen from its back: N is turned toward the viewer.
    "back of a polygon": (
        "0 0 0",
        SHINY + "polygon 4  -9 9 0  9 9 0  9 -9 0  -9 -9 0\n" + f"light {ROOT3} 0 1  1 1 1",
        DIFFUSE * HALF + 0.25 * 3 * ROOT3 / 8,
    ),
    # The square turned 45 degrees about x: N = (0, -1, 1)/sqrt 2; light on the axis: N.L = N.H = 1/sqrt 2.
    "tilted": (
        "0 0 0",
        SHINY + "rot x 45 " + SQUARE + "trans 0 0 0 rot x -45 light 0 0 3  1 1 1",
        DIFFUSE / ROOT2 + 0.25 / (2 * ROOT2),
    ),
    # Two lights add; red N.L = 1, green N.L = 1/2 with N.H^3 = 3 sqrt(3)/8.
    "two lights": (
        "0 0 0",
        SHINY + SQUARE + f"light 0 0 3  1 0 0  light 0 {ROOT3} 1  0 1 0",
        [0.4 + 0.25, 0.3 * HALF + 0.25 * 3 * ROOT3 / 8, 0],
    ),
    "emission is added": (
        ".5 .5 .5",
        "material m { color 1 1 1 kdr .5 emission 2 .125 0 } use m\n" + SQUARE,
        [2.25, 0.375, 0.25],
    ),
    # Hit at (0, 0, 1), N = V; light at (7, 0, 1): N.L = 0, N.H = 1/sqrt 2.
    "top of a sphere": ("0 0 0", SHINY + "sphere 0 0 0 1  light 7 0 1  1 1 1", [0.25 / (2 * ROOT2)] * 3),
    # Centre (.6, 0, 0): hit at (0, 0, .8), N = (-.6, 0, .8); light at the eye: N.L = N.H = .8.
    "side of a sphere": ("0 0 0", SHINY + "sphere .6 0 0 1  light 0 0 5  1 1 1", DIFFUSE * 0.8 + 0.25 * 0.512),
    # Eye and light inside: hit at (0, 0, -6) from the centre; N turned to +z, N.L = N.H = 1.
    "inside of a sphere": ("0 0 0", SHINY + "sphere 0 0 0 6  light 0 0 5  1 1 1", DIFFUSE + 0.25),
    # A light in the very point has no direction: N.L = 0, H = V.
    "light in the surface": ("0 0 0", SHINY + SQUARE + "light 0 0 0  1 1 1", [0.25] * 3),
    # e = 0: even a clamped 0 to the power 0 is 1, as C's pow has it.
    "exponent zero": (
        "0 0 0",
        "material m { kdr 0 ksr .5 e 0 } use m\n" + SQUARE + "light 0 0 -4  1 1 1",
        [0.5] * 3,
    ),
}


@pytest.mark.parametrize("name", PIXELS)
def test_pixel_by_hand(tmp_path, name):
    ambient, world, wanted = PIXELS[name]
    path = tmp_path / "one.sc"
    path.write_text(EYE.format(ambient=ambient) + world)
    caster = RayCaster(read_sc(path), workers=1)
    np.testing.assert_allclose(caster.render().radiance[0, 0], wanted, rtol=0, atol=1e-12)
    np.testing.assert_allclose(caster.trace([0, 0, 5], [0, 0, -2])[0], wanted, rtol=0, atol=1e-12)


@pytest.mark.parametrize("column", [0, 2])
def test_pixel_off_the_axis_by_hand(tmp_path, column):
    """Three pixels in a row, 90 degrees high: the outer rays run along (+-2, 0, -1)/sqrt 5.

    They meet z = 0 at x = +-10.  Under a light straight above, L = N = (0, 0, 1), V.N = 1/sqrt 5 and
    N.H = cos of half the angle between L and V = sqrt((1 + 1/sqrt 5)/2).
    """
    path = tmp_path / "row.sc"
    x = 10 * (column - 1)
    path.write_text(
        f"size 3 1 persp 90 lookat 0 0 5  0 0 0  0 1 0 world {SHINY} light {x} 0 3  1 1 1 scale 3 3 3 {SQUARE}"
    )
    radiance = RayCaster(read_sc(path)).render().radiance
    shine = ((1 + 1 / math.sqrt(5)) / 2) ** 1.5
    np.testing.assert_allclose(radiance[0, column], DIFFUSE + 0.25 * shine, rtol=0, atol=1e-12)


def test_bytes_are_rounded_and_pegged():
    radiance = np.array([0.0, 0.4 / 255, 0.6 / 255, 0.5, 1.0, 1.01, 1e9, np.inf])
    assert to_bytes(radiance).tolist() == [0, 0, 1, 128, 255, 255, 255, 255]


def test_pixel_centres():
    """Eye at the origin, 90 degrees high, 4 x 2 pixels: at distance 1 a pixel is 1 wide and high."""
    rays = PinholeRays.from_matrix(np.eye(4), 90, 4, 2)
    wanted = np.array([[x, y, -1] for y in (0.5, -0.5) for x in (-1.5, -0.5, 0.5, 1.5)])
    wanted /= np.linalg.norm(wanted, axis=1)[:, None]
    np.testing.assert_allclose(rays.row_directions(0, 2), wanted, atol=1e-15)
    np.testing.assert_allclose(rays.row_directions(1, 2), wanted[4:], atol=1e-15)
    np.testing.assert_allclose(rays.directions([0, 4], 0)[:, :2] * np.sqrt(6), [[-2, 1], [2, 1]], atol=1e-14)


def test_rays_run_through_the_screen_points_of_the_matrix(tmp_path):
    """The screen place of any point of a pixel's ray is the pixel's centre, for any camera matrix."""
    path = tmp_path / "a.sc"
    path.write_text("size 31 17 persp 50 scale 1 1.5 1 rot z 20 lookat 3 4 5  0 1 0  0 1 .2 trans .1 0 0 world")
    scene = read_sc(path)
    rays = PinholeRays.from_matrix(scene.world_to_eye, scene.fov_deg, scene.width, scene.height)
    for x, y in [(0.5, 0.5), (12.5, 3.5), (30.5, 16.5)]:
        point = rays.eye + 7.3 * rays.directions(x, y)[0]
        xw, yw, _, w = scene.world_to_screen @ [*point, 1]
        assert w > 0 and (xw / w, yw / w) == pytest.approx((x, y), abs=1e-11)


@pytest.mark.parametrize("call", [
    lambda: PinholeRays.from_matrix(np.eye(3), 40, 4, 4),
    lambda: PinholeRays.from_matrix(np.diag([1.0, 0, 1, 1]), 40, 4, 4),
    lambda: PinholeRays.from_camera(Camera(np.zeros(3), np.array([0, 0, 1.0]), np.array([0, 0, 2.0]))),
])  # fmt: skip
def test_cameras_that_see_nothing_are_errors(call):
    with pytest.raises(InputError):
        call()


@pytest.mark.parametrize(("fov", "size"), [(0, (4, 4)), (180, (4, 4)), (40, (0, 4))])
def test_cameras_out_of_range_are_errors(fov, size):
    with pytest.raises(OptionError):
        PinholeRays.from_matrix(np.eye(4), fov, *size)
