"""Lights: closed forms against known values and quadrature, and the lights of a scene."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_scenes import FAR, UNIT_SQUARE_LIGHT, rectangle, truth

from workbench.errors import InputError
from workbench.geometry.flat import Geometry
from workbench.scene.library import diffuse, sphere_surface
from workbench.scene.model import Light, Scene, Surface
from workbench.shadow.lights import (
    DirectionalLight,
    DiskLight,
    LinearLight,
    PointLight,
    PolygonLight,
    SphereLight,
    SpotLight,
    equal_weights,
    lights_of_scene,
    visible_share,
)

UP = np.array([0.0, 0.0, 1.0])
DOWN = -UP
ONE = np.ones(1)
RADIANCE = np.array([math.pi])  # the exitance of radiance 1
SEEDS = st.integers(0, 2**32 - 1)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(60)
U = np.random.default_rng(0).random((5, 2))


def row(x, y=0.0):
    """Points (x, y, 0)."""
    x = np.asarray(x, dtype=float)
    return np.column_stack([x, np.full(len(x), y), np.zeros(len(x))])


def disk_quadrature(point, normal, centre, radius, light_normal) -> float:
    """cos cos / (pi r^2) over the part of a disk above the horizon, by Gauss rules that meet its edges."""
    normal, light_normal = (np.asarray(x) / np.linalg.norm(x) for x in (normal, light_normal))
    offset = np.asarray(centre) - point
    climb = normal - (normal @ light_normal) * light_normal
    slope = np.linalg.norm(climb)
    u = climb / slope if slope > 1e-14 else np.linalg.svd(light_normal[None])[2][1]
    v = np.cross(light_normal, u)
    # Height over the horizon is offset . n + x slope, x along u; x = R cos s, y = R sin s eta.
    lowest = -(offset @ normal) / (radius * slope) if slope > 1e-14 else -np.sign(offset @ normal) * np.inf
    if lowest >= 1.0:
        return 0.0
    last = math.pi if lowest <= -1.0 else math.acos(lowest)
    s, eta = np.meshgrid(0.5 * last * (NODES + 1.0), NODES, indexing="ij")
    weight = np.outer(0.5 * last * WEIGHTS, WEIGHTS) * radius**2 * np.sin(s) ** 2
    to = offset + (radius * np.cos(s))[..., None] * u + (radius * np.sin(s) * eta)[..., None] * v
    square = (to**2).sum(axis=-1)
    return (
        float((weight * np.clip(to @ normal, 0, None) * np.clip(-(to @ light_normal), 0, None) / square**2).sum())
        / math.pi
    )


# --- lights without extent --------------------------------------------------------------------------


def test_directional_light():
    light = DirectionalLight("sun", np.array([3.0, 1.0]), [-1, -2, -2])
    # cos = 2/3; from below nothing.
    assert light.irradiance([[5, 6, 7]], UP) == pytest.approx(np.array([[2.0, 2 / 3]]), rel=1e-15)
    assert light.unit_irradiance([0, 0, 0], DOWN) == 0.0
    assert light.unit_irradiance([0, 0, 0], UP) == pytest.approx(truth("light/directional"), rel=1e-9)
    rays = light.sample(row([0, 1]), UP, U)
    assert rays.far == np.inf and rays.count == 1
    assert rays.directions == pytest.approx(np.tile(np.array([1, 2, 2]) / 3, (2, 1, 1)))


def test_point_and_spot_lights():
    point = PointLight("bulb", ONE, [0, 0, 3])
    # I cos / r^2 below it: 1/9; cos^3 / h^2 beside.
    x = np.array([0, 0.5, 1.5])
    assert point.unit_irradiance(row(x), UP) == pytest.approx(3 / (9 + x**2) ** 1.5, rel=1e-14)
    assert not point.unit_irradiance([[0, 0, 4], [0, 3, 3]], UP).any()
    # CIE 171 case 5.2: 1000 cd, Lambertian, so a spot of exponent 1 and half the directions.
    lamp = SpotLight("lamp", np.array([1000.0]), [0, 0, 3], DOWN, exponent=1.0)
    places = [[0, 0], [0.5, 0], [1, 0], [1.5, 0], [0.5, 0.5], [1, 0.5], [1.5, 0.5], [1, 1], [1.5, 1], [1.5, 1.5]]
    floor = np.column_stack([places, np.zeros(10)])
    square = 9 + (floor**2).sum(axis=1)
    assert lamp.irradiance(floor, UP)[:, 0] == pytest.approx(9000 / square**2, rel=1e-14)
    assert lamp.irradiance(floor, UP)[:, 0] == pytest.approx(truth("cie171/5.2-point-source"), rel=1e-9)
    assert not lamp.irradiance([[0, 0, 3.5], [1, 1, 3]], DOWN + [0.1, 0.1, 0]).any()
    spot = SpotLight("spot", ONE, [0, 0, 2], DOWN, 30.0, 4.0)
    x = np.array([0, 0.5, 1, 1.25])
    expected = np.where(x < 2 * math.tan(math.pi / 6), 2.0**5 / (4 + x**2) ** 3.5, 0.0)
    assert spot.unit_irradiance(row(x), UP) == pytest.approx(expected, rel=1e-14)
    assert spot.unit_irradiance(row(x), UP) == pytest.approx(truth("light/spot"), rel=1e-9)
    rays = spot.sample(row(x), UP, U)
    assert rays.far == 1.0 and (rays.directions[:, 0] == np.array([0, 0, 2]) - row(x)).all()
    assert (rays.weights[:, 0] == spot.unit_irradiance(row(x), UP)).all()


def test_linear_light():
    for lambertian, name, value in (
        (False, "isotropic", 0.48401280648045447),
        (True, "lambertian", 0.4405287538798714),
    ):
        light = LinearLight("tube", np.array([2.0]), [-1, 1, 2], [3, 1, 2], lambertian)
        assert light.unit_irradiance([0, 0, 0], UP) == pytest.approx(value, rel=1e-14)
        assert light.irradiance([[0, 0, 0]], UP)[0, 0] == pytest.approx(2 * truth(f"light/linear-{name}"), rel=1e-9)
        middle = (np.arange(4000) + 0.5) / 4000
        rays = light.sample([0, 0, 0], UP, np.column_stack([middle, middle]))
        assert rays.weights.sum() == pytest.approx(value, rel=1e-7)
        assert (rays.density == 0.25).all() and rays.measure == "length"


# --- polygons ---------------------------------------------------------------------------------------


def test_quad_light_known_values():
    light = PolygonLight("panel", RADIANCE, UNIT_SQUARE_LIGHT)
    x = np.arange(13) / 4
    found = light.irradiance(row(x), UP)[:, 0]
    # Below the centre of a square of half-side a at the height h: 8 / pi times ... by arctangents.
    c = 0.5 / math.hypot(0.5, 2)
    assert found[0] == pytest.approx(4 * c * math.atan(c), rel=1e-13)
    assert found == pytest.approx(truth("light/quad-row"), rel=1e-9)
    wall = PolygonLight("wall", RADIANCE, [np.array([[0, -1, 0], [0, 1, 0], [0, 1, 1], [0, -1, 1.0]])])
    assert wall.irradiance(row([0.01, 0.1, 0.5, 1, 2]), UP)[:, 0] == pytest.approx(
        truth("light/vertical-quad-on-floor"), rel=1e-9
    )
    flat = PolygonLight("floor", RADIANCE, [[[1, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0]]])
    assert flat.unit_irradiance([[0, 0, 0], [1.5, 0.5, 0], [1, 0, 0]], UP).tolist() == [0.0, 0.0, 0.0]


def test_cie_171_case_5_3():
    light = PolygonLight(
        "ceiling", np.array([1000 * math.pi]), np.array([[1.5, 1.5, 3], [1.5, 2.5, 3], [2.5, 2.5, 3], [2.5, 1.5, 3]])
    )
    wall = np.column_stack([np.full(6, 2.0), np.zeros(6), 2.75 - 0.5 * np.arange(6)])
    floor = np.column_stack([np.full(8, 2.0), 0.25 + 0.5 * np.arange(8), np.zeros(8)])
    found = np.concatenate([light.irradiance(wall, [0, 1, 0]), light.irradiance(floor, UP)])[:, 0]
    assert found == pytest.approx(truth("cie171/5.3-area-source"), rel=1e-9)


@pytest.mark.parametrize(
    ("name", "point", "normal", "polygon"),
    [
        ("triangle", [0, 0, 0], [0, 0, 1], [[1, 0, 1], [-0.5, 0.75, 2], [-0.25, -1, 0.5]]),
        ("triangle-tilted-normal", [0, 0, 0], [1, 2, 6], [[1, 0, 1], [-0.5, 0.75, 2], [-0.25, -1, 0.5]]),
        ("half-below-horizon", [0, 0, 0], [0, 0, 1], [[1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]]),
        ("wall-at-distance-1e-6", [1e-6, 0, 0], [0, 0, 1], [[0, -1, 0], [0, 1, 0], [0, 1, 1], [0, -1, 1]]),
        ("concave-L-overhead", [0, 0, 0], [0, 0, 1],
         [[-1, -1, 1], [1, -1, 1], [1, 0, 1], [0, 0, 1], [0, 1, 1], [-1, 1, 1]]),
    ],
)  # fmt: skip
def test_polygon_form_factors(name, point, normal, polygon):
    # Whichever way the polygon is listed, one of its sides faces the point.
    expected = truth(f"vf/element/{name}")
    values = [
        PolygonLight("p", ONE, np.array(p, float)).unit_irradiance(point, normal) for p in (polygon, polygon[::-1])
    ]
    assert sorted(v.item() for v in values) == pytest.approx([0.0, expected], rel=1e-9, abs=0.0)
    both = PolygonLight("p", ONE, np.array(polygon, float), two_sided=True)
    assert both.unit_irradiance(point, normal) == pytest.approx(expected, rel=1e-9)


def test_concave_light_with_a_hole_is_the_whole_less_the_hole():
    outer, hole = rectangle(-1, 1, -1, 1, 2)[::-1], rectangle(-0.5, 0.25, -0.5, 0.5, 2)
    frame = PolygonLight("frame", ONE, [outer, hole])
    assert len(frame.parts) > 1 and sum(map(len, frame.parts)) == 3 * len(frame.parts)
    assert frame.area == pytest.approx(4 - 0.75, rel=1e-15) and frame.normal == pytest.approx(DOWN)
    points = np.random.default_rng(1).uniform(-2, 2, (50, 3))
    normals = np.random.default_rng(2).normal(size=(50, 3))
    whole, part = PolygonLight("w", ONE, outer), PolygonLight("h", ONE, hole[::-1])
    expected = whole.unit_irradiance(points, normals) - part.unit_irradiance(points, normals)
    assert frame.unit_irradiance(points, normals) == pytest.approx(expected, rel=1e-9, abs=1e-15)


def test_one_sided_surfaces_give_nothing_behind_them():
    behind = np.array([[0, 0, 3.0], [0.3, 0.1, 2.5], [5, 0, 2.001]])
    for make in (
        lambda two: PolygonLight("p", ONE, UNIT_SQUARE_LIGHT, two),
        lambda two: DiskLight("d", ONE, [0, 0, 2], 0.5, DOWN, two),
    ):
        for normal in (DOWN, UP, [1, 0, 0], [-1, 0, 0.1]):
            assert not make(False).unit_irradiance(behind, normal).any()
            assert not make(False).sample(behind, normal, U).weights.any()
        # Two-sided: the mirror image of what is in front.
        mirrored = behind * [1, 1, -1] + [0, 0, 4]
        back = make(True).unit_irradiance(behind, DOWN)
        assert back == pytest.approx(make(False).unit_irradiance(mirrored, UP), rel=1e-12) and back.all()
        rays = make(True).sample(behind, DOWN, U).weights
        assert rays == pytest.approx(make(False).sample(mirrored, UP, U).weights, rel=1e-9)


def test_1_5_point_in_the_lights_plane():
    # Finite, never negative, growing with the distance from the plane.
    for light in (PolygonLight("p", ONE, rectangle(-0.5, 0.5, -0.5, 0.5, 0)), DiskLight("d", ONE, [0, 0, 0], 0.5, UP)):
        heights = np.array([0.0, *10.0 ** np.arange(-15, 0)])
        points = np.column_stack([np.full(16, 2.0), np.zeros(16), heights])
        found = light.unit_irradiance(points, [-1, 0, 0])
        assert np.isfinite(found).all() and found[0] == 0.0 and (np.diff(found) >= 0.0).all()
        # Far below the light's size in height, the factor is in proportion to it.
        assert found[10] / found[5] == pytest.approx(heights[10] / heights[5], rel=1e-4)


# --- disks and spheres ------------------------------------------------------------------------------


def test_disk_known_values():
    disk = DiskLight("d", ONE, [0, 0, 2], 1.0, DOWN)
    # On the axis: R^2 / (h^2 + R^2); off it Howell's B-12.
    assert disk.unit_irradiance([0, 0, 0], UP) == pytest.approx(1 / 5, rel=1e-15)
    x = np.array([0.75, 5.0])
    z = 1 + x**2 + 4
    assert disk.unit_irradiance(row(x), UP) == pytest.approx(
        0.5 * (1 - (x**2 + 3) / np.sqrt(z**2 - 4 * x**2)), rel=1e-13
    )
    assert disk.unit_irradiance(row([0.75]), UP) == pytest.approx(truth("vf/element/disk-off-axis"), rel=1e-9)
    assert disk.unit_irradiance(row([5.0]), UP) == pytest.approx(truth("vf/element/disk-far-off-axis"), rel=1e-9)
    # Half of it above the horizon of a point on the axis: (1/pi)(atan(R/h) - (R h)/(h^2 + R^2)).
    half = (math.atan(0.5) - 2 / 5) / math.pi
    for normal in ([1, 0, 0], [0, 1, 0], [-0.6, 0.8, 0]):
        assert disk.unit_irradiance([0, 0, 0], normal) == pytest.approx(half, rel=1e-13)


@settings(max_examples=250, deadline=None)
@given(seed=SEEDS)
def test_disk_equals_quadrature(seed):
    rng = np.random.default_rng(seed)
    light_normal, normal = rng.normal(size=(2, 3))
    light_normal /= np.linalg.norm(light_normal)
    centre, radius = rng.normal(size=3), 10.0 ** rng.uniform(-2, 0.5)
    kind = rng.integers(0, 4)
    height = 10.0 ** rng.uniform(-0.3, 1) * radius
    along = np.cross(light_normal, rng.normal(size=3))
    point = centre + height * light_normal + rng.choice([0.0, 1e-9, 0.5, 3.0]) * radius * along
    if kind == 0:
        normal = -light_normal
    elif kind == 1:  # the horizon passes through the centre, up to rounding
        normal = np.cross(centre - point, normal)
    disk = DiskLight("d", ONE, centre, radius, light_normal)
    found = disk.unit_irradiance(point, normal).item()
    expected = disk_quadrature(point, normal, centre, radius, light_normal)
    # A cut disk loses digits with (d/R)^2.
    distance = np.linalg.norm(point - centre) / radius
    open_value = DiskLight("d", ONE, centre, radius, light_normal).unit_irradiance(point, centre - point).item()
    assert found == pytest.approx(expected, rel=1e-9, abs=2e-15 * (1 + distance) * open_value + 1e-16)
    assert 0.0 <= found <= 1.0


def test_far_and_grazing_disk_keeps_its_digits():
    # Far away: cos cos R^2 / d^2 to (R/d)^2, also where both cosines are 1e-4.
    disk = DiskLight("d", ONE, [0, 0, 1], 1.0, DOWN)
    for x in (1e3, 1e4, 1e6):
        square = 1 + x * x
        assert disk.unit_irradiance([x, 0, 0], UP) == pytest.approx(1 / square**2, rel=10 / square)


def test_sphere_known_values():
    sphere = SphereLight("s", RADIANCE, [0, 0, 3], 1.0)
    assert sphere.irradiance([[0, 0, 0]], [0, 1, 1])[0, 0] == pytest.approx(math.pi / 9 * math.sqrt(0.5), rel=1e-14)
    assert sphere.irradiance([[0, 0, 0]], [0, 1, 1])[0, 0] == pytest.approx(truth("light/sphere-45deg"), rel=1e-9)
    # Cut in half by the horizon: (sigma - sin cos) / pi, sin sigma = 1/3.
    sigma = math.asin(1 / 3)
    half = (sigma - math.sin(sigma) * math.cos(sigma)) / math.pi
    assert sphere.unit_irradiance([0, 0, 0], [1, 0, 0]) == pytest.approx(half, rel=1e-13)
    angle = math.radians(85)
    cut = sphere.unit_irradiance([0, 0, 0], [math.sin(angle), 0, math.cos(angle)])
    assert cut == pytest.approx(0.013737713652504448, rel=1e-12)
    assert cut == pytest.approx(truth("vf/sphere/element-85deg-cut-by-horizon"), rel=1e-9)
    # On the sphere: half of the sky at any tilt, (1 + cos) / 2; inside and below nothing.
    on = [0, 0, 2]
    for tilt in (0.0, 0.5, 2.0, 3.0):
        seen = sphere.unit_irradiance(on, [math.sin(tilt), 0, math.cos(tilt)])
        assert seen == pytest.approx((1 + math.cos(tilt)) / 2, rel=1e-12)
    assert not sphere.unit_irradiance([[0, 0, 2.5], [0, 0, 3], [0, 0, 5]], UP).any()
    assert not sphere.sample([[0, 0, 2.5], [0, 0, 3]], UP, U).weights.any()


@settings(max_examples=250, deadline=None)
@given(seed=SEEDS)
def test_sphere_equals_quadrature_over_its_outline(seed):
    # The disk of the circle where lines from the point touch the sphere.
    rng = np.random.default_rng(seed)
    centre, normal = rng.normal(size=(2, 3))
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    radius = 10.0 ** rng.uniform(-4, 0)
    distance = radius * (1.1 + 10.0 ** rng.uniform(-1, 4))
    point = centre - distance * direction
    sine = radius / distance
    if rng.random() < 0.7:  # cut by the horizon
        tilt = rng.uniform(-0.999, 0.999) * math.asin(sine)
        side = np.cross(direction, normal)
        side /= np.linalg.norm(side)
        normal = math.sin(tilt) * direction + math.cos(tilt) * side
    found = SphereLight("s", ONE, centre, radius).unit_irradiance(point, normal).item()
    cosine = math.sqrt(1 - sine * sine)
    expected = disk_quadrature(point, normal, point + distance * cosine**2 * direction, radius * cosine, -direction)
    # Rounding of the point's own coordinates shifts the horizon by an ulp of the sphere's size.
    rounding = 1e-15 * (1 + np.abs(centre).max() + distance) / radius
    assert found == pytest.approx(expected, rel=1e-9, abs=4 * rounding * sine * sine)


# --- rays, weights ----------------------------------------------------------------------------------

LIGHTS = {
    "linear": LinearLight("l", ONE, [-1, 1, 2], [3, 1, 2], True),
    "parallelogram": PolygonLight("p", ONE, UNIT_SQUARE_LIGHT),
    "concave": PolygonLight(
        "c", ONE, np.array([[-1, -1, 2], [-1, 1, 2], [0, 1, 2], [0, 0, 2], [1, 0, 2], [1, -1, 2.0]])
    ),
    "frame": PolygonLight("f", ONE, [rectangle(-1, 1, -1, 1, 2)[::-1], rectangle(-0.5, 0.25, -0.5, 0.5, 2)]),
    "frame by solid angle": PolygonLight(
        "f", ONE, [rectangle(-1, 1, -1, 1, 2)[::-1], rectangle(-0.5, 0.25, -0.5, 0.5, 2)], by_solid_angle=True
    ),
    "disk": DiskLight("d", ONE, [0.2, 0, 2], 0.7, [0.1, 0.2, -1]),
    "sphere": SphereLight("s", ONE, [0.5, 0, 2], 0.6),
}


@pytest.mark.parametrize("name", LIGHTS)
def test_rays_end_on_the_light(name):
    light = LIGHTS[name]
    rng = np.random.default_rng(5)
    points = rng.uniform(-1, 1, (4, 3)) * [1, 1, 0.2]
    rays = light.sample(points, UP, rng.random((4, 64, 2)))
    assert rays.directions.shape == (4, 64, 3) and rays.weights.shape == rays.density.shape == (4, 64)
    ends = points[:, None] + rays.directions
    if isinstance(light, SphereLight):
        from_centre = ends - light.centre
        assert np.linalg.norm(from_centre, axis=2) == pytest.approx(0.6, rel=1e-9)
        assert (np.einsum("nkj,nkj->nk", from_centre, rays.directions) <= 1e-9).all()  # the near side
    elif isinstance(light, DiskLight):
        assert np.abs((ends - light.centre) @ light.normal).max() < 1e-12
        assert np.linalg.norm(ends - light.centre, axis=2).max() <= 0.7 * (1 + 1e-12)
    elif isinstance(light, PolygonLight):
        assert np.abs(ends[..., 2] - 2).max() < 1e-12
        assert np.abs(ends[..., :2]).max() <= 1 + 1e-12
        if name.startswith("frame"):
            hole = (np.abs(ends[..., 0] + 0.125) < 0.375 - 1e-9) & (np.abs(ends[..., 1]) < 0.5 - 1e-9)
            assert not hole.any()
    # One set for all points is that set for each.
    alike = light.sample(points, UP, U)
    again = light.sample(points, UP, np.tile(U, (4, 1, 1)))
    assert (alike.directions == again.directions).all() and (alike.weights == again.weights).all()


def test_solid_angle_weights_are_one_over_pi_density():
    # cos / (pi p): by solid angle the weight has no distance in it, and below no horizon it is bounded.
    light = LIGHTS["frame by solid angle"]
    points = np.array([[0.4, 0.1, 1.999], [0, 0, 0]])
    rays = light.sample(points, UP, U)
    unit = rays.directions / np.linalg.norm(rays.directions, axis=2)[..., None]
    assert rays.weights == pytest.approx(unit[..., 2] / (math.pi * rays.density * 5), rel=1e-9)
    assert (rays.weights * 5 <= 2.0).all()


def test_1_12_and_6_1_equal_weights_give_the_area_and_not_the_irradiance():
    # A half-plane hides a quarter of the light's area and three quarters of its irradiance.
    light = PolygonLight("p", ONE, np.array([[0, -2, 1], [0, 2, 1], [4, 2, 1], [4, -2, 1]], float))
    middle = (np.arange(64) + 0.5) / 64
    a, b = (x.ravel() for x in np.meshgrid(middle, middle))
    rays = light.sample([0, 0, 0], UP, np.column_stack([a, b]))
    passes = (rays.directions[..., 0] >= 1.0).astype(float)
    area = visible_share(equal_weights(rays), passes)
    assert area == pytest.approx(0.75, abs=1e-12)
    assert visible_share(rays.weights, passes) == pytest.approx(0.24188417221, rel=1e-3)
    assert truth("fail/area-fraction-is-not-irradiance") == pytest.approx([0.24188417221, 0.75], rel=1e-9)
    # A band a column of the answer.
    through = np.stack([passes, 0.5 * passes], axis=2)
    assert visible_share(rays.weights, through)[0, 1] == pytest.approx(0.5 * visible_share(rays.weights, passes)[0])
    assert visible_share(np.zeros((1, 3)), np.ones((1, 3))) == 0.0
    # A line: halves by length are no halves by cos / r^2.
    line = LinearLight("l", ONE, [0, 0, 1], [4, 0, 1])
    rays = line.sample([0, 0, 0], UP, np.column_stack([middle, middle]))
    near = (rays.directions[..., 0] < 2.0).astype(float)
    assert visible_share(equal_weights(rays), near) == 0.5
    expected = (2 / math.sqrt(5)) / (4 / math.sqrt(17))
    assert visible_share(rays.weights, near) == pytest.approx(expected, rel=1e-3)


# --- the lights of a scene --------------------------------------------------------------------------


def test_lights_of_scene():
    paint, lamp = diffuse("paint", 0.5), diffuse("lamp", 0.0, 2.0)
    surfaces = (
        Surface.from_polygons("floor", paint, [rectangle(-1, 1, -1, 1, 0)]),
        Surface.from_polygons("panels", lamp, [UNIT_SQUARE_LIGHT, UNIT_SQUARE_LIGHT + [2, 0, 0]]),
        sphere_surface("ball", lamp, [0, 3, 2], 0.5, facet_error=0.1),
        sphere_surface("sky", lamp, [0, 0, 0], FAR, facet_error=0.3, inward=True),
    )
    lights = (
        Light("sun", "directional", ONE, direction=DOWN),
        Light("off", "point", 0 * ONE, position=UP),
        Light("bulb", "point", ONE, position=2 * UP),
        Light("spot", "spot", ONE, position=2 * UP, direction=DOWN, cone_deg=20.0, exponent=2.0),
        Light("tube", "linear", ONE, position=2 * UP, end=3 * UP, lambertian=True),
    )
    scene = Scene("room", surfaces, lights, bands=1, background=np.zeros(1))
    geometry = Geometry.from_scene(scene)
    found = lights_of_scene(scene, geometry)
    names = [light.name for light in found]
    assert names[:7] == ["sun", "bulb", "spot", "tube", "panels[0]", "panels[1]", "ball"]
    assert [type(light).__name__ for light in found[:7]] == [
        "DirectionalLight", "PointLight", "SpotLight", "LinearLight", "PolygonLight", "PolygonLight", "SphereLight",
    ]  # fmt: skip
    spot, tube = found[2], found[3]
    assert isinstance(spot, SpotLight) and (spot.cone_deg, spot.exponent) == (20.0, 2.0)
    assert isinstance(tube, LinearLight) and tube.lambertian
    # A sphere that is seen from inside stays its facets, which face inward.
    assert len(found) == 7 + surfaces[3].face_count and names[7] == "sky[0]"
    assert isinstance(found[7], PolygonLight) and found[7].normal @ found[7].rings[0][0] < 0
    # Each knows its polygons, all emitting polygons once.
    own = np.concatenate([light.polygons for light in found])
    emitting = [geometry.surface_name[s] != "floor" for s in geometry.polygon_surface]
    assert sorted(own) == list(np.flatnonzero(emitting))
    assert found[4].irradiance([[0, 0, 0]], UP)[0, 0] == pytest.approx(2.0 * 0.23083679773017077 / math.pi, rel=1e-12)
    # All of the sky's facets fill the hemisphere: the form factors sum to 1.
    sky = sum(light.unit_irradiance([0, 0, 0], UP).item() for light in found[7:])
    assert sky == pytest.approx(1.0, rel=1e-12)
    with pytest.raises(InputError, match=r"geometry: found .* expected the scene's"):
        lights_of_scene(Scene("other", surfaces[:1]), geometry)
    with pytest.raises(InputError, match="no direction"):
        lights_of_scene(
            Scene("bad", surfaces[:1], (Light("s", "directional", ONE),)),
            Geometry.from_scene(Scene("bad", surfaces[:1])),
        )
    with pytest.raises(InputError, match="kind 'laser'"):
        lights_of_scene(
            Scene("bad", surfaces[:1], (Light("s", "laser", ONE),)), Geometry.from_scene(Scene("bad", surfaces[:1]))
        )


def test_bad_arguments_get_one_clear_line():
    quad = LIGHTS["parallelogram"]
    for u in ([[0.5]], [[1.5, 0]], [[np.nan, 0]], np.zeros((3, 2, 2)), np.zeros((0, 2))):
        for light in (*LIGHTS.values(), PointLight("p", ONE, UP)):
            with pytest.raises(InputError, match="u: found"):
                light.sample(row([0, 1]), UP, u)
    with pytest.raises(InputError, match="normals"):
        quad.unit_irradiance(row([0, 1, 2]), [UP, UP])
    with pytest.raises(InputError, match="lies on the light 'p'"):
        PointLight("p", ONE, UP).unit_irradiance([0, 0, 1], UP)
    with pytest.raises(InputError, match="lies on a corner"):
        LIGHTS["frame by solid angle"].sample([1, 1, 2], UP, U)
    for make in (
        lambda: PolygonLight("p", ONE, [[0, 0, 0], [1, 0, 0], [2, 0, 0]]),
        lambda: PolygonLight("p", ONE, np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0]])),
        lambda: DiskLight("d", ONE, UP, 0.0, UP),
        lambda: SphereLight("s", ONE, UP, -1.0),
        lambda: SpotLight("s", ONE, UP, DOWN, 120.0),
        lambda: SpotLight("s", ONE, UP, DOWN, 20.0, -1.0),
        lambda: LinearLight("l", ONE, UP, UP),
        lambda: DirectionalLight("d", ONE, [0, 0, 0]),
    ):
        with pytest.raises(InputError):
            make()
    with pytest.raises(InputError, match="transmitted"):
        visible_share(np.ones((2, 3)), np.ones((2, 4)))
