"""One interface to occlusion: states that are never wrong, answers that do not depend on the wrong things."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_scenes import FAR, UNIT_SQUARE_LIGHT, geometry_of, nasty_polygons, rectangle

from workbench.accel.brute import BruteForce
from workbench.errors import InputError, OptionError
from workbench.geometry.polygons import convex_pieces, vector_area
from workbench.geometry.tessellation import sphere_mesh
from workbench.shadow import occlusion
from workbench.shadow.lights import (
    DirectionalLight,
    DiskLight,
    LinearLight,
    PointLight,
    PolygonLight,
    SphereLight,
    SpotLight,
)
from workbench.shadow.occlusion import METHODS, PILOT_POINTS, PILOT_RAYS, AreaLight, OcclusionState, Shader, estimate
from workbench.shadow.rays import sender_samples, unit_samples

UP = np.array([0.0, 0.0, 1.0])
ONE = np.ones(1)
SQUARE = AreaLight(UNIT_SQUARE_LIGHT, ONE)
L_SHAPE = np.array([[-1, -1, 2], [-1, 1, 2], [0, 1, 2], [0, 0, 2], [1, 0, 2], [1, -1, 2.0]])
EMPTY = geometry_of([rectangle(50, 51, 50, 51, -50)])
each_method = pytest.mark.parametrize("method", METHODS)
DARK, LIT, COMPLEX = OcclusionState.INSHADOW, OcclusionState.NOT_INSHADOW, OcclusionState.COMPLEX_SHADOW


def plane_points(count, half=1.5, seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-half, half, (count, 2)), np.zeros(count)])


def grid_points(side, half=1.0):
    x, y = np.meshgrid(np.linspace(-half, half, side), np.linspace(-half, half, side))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(side * side)])


@pytest.fixture(scope="module")
def torus():
    """A torus of 1,600 triangles under the square light, over points of a floor that is not there."""
    u, v = np.meshgrid(np.arange(40) * math.tau / 40, np.arange(20) * math.tau / 20, indexing="ij")
    ring = 0.55 + 0.2 * np.cos(v)
    vertex = np.stack([ring * np.cos(u), ring * np.sin(u), 0.9 + 0.2 * np.sin(v)], axis=-1)
    quads = np.stack([vertex, np.roll(vertex, -1, 0), np.roll(vertex, (-1, -1), (0, 1)), np.roll(vertex, -1, 1)], 2)
    quads = quads.reshape(-1, 4, 3)
    return Shader(geometry_of(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])), 1)


# ---- the states --------------------------------------------------------------------------------


def blocked_by_brute(geometry, points, normals, ring, own=-1, rays=24, seed=0):
    """Which of the rays to inner points of the light brute force says are blocked, and their weights."""
    inner = 1e-6 + (1.0 - 2e-6) * unit_samples(np.arange(len(points)), rays, seed)
    targets = sender_samples(ring, inner)
    origins = np.repeat(points, rays, axis=0)
    along = targets.reshape(-1, 3) - origins
    skip = np.full((len(along), 2), -1)
    skip[:, 1] = own
    blocked = BruteForce(geometry).occluded(origins, along, 1.0, skip).reshape(-1, rays)
    above = np.einsum("nkj,nj->nk", along.reshape(-1, rays, 3), normals) > 1e-9 * np.abs(along).max()
    return blocked, above


@settings(max_examples=200, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(1, 12),
    far=st.sampled_from([0.0, 0.0, 1e5]),
    turned=st.booleans(),
    concave=st.booleans(),
)
def test_states_are_never_wrong_against_brute_rays(seed, count, far, turned, concave):
    # Slivers, coplanar, touching, straddling and far-away polygons; both windings of every kind.
    rng = np.random.default_rng(seed)
    shift = far * np.array([1.0, -1.0, 0.5])
    light = (L_SHAPE if concave else UNIT_SQUARE_LIGHT) * [1, -1 if turned else 1, 1] + [0.25, 0.5, 0.0]
    light = light[::-1] if turned else light
    points = np.column_stack([rng.choice([0.0, 0.25, 0.5, 1.0, rng.uniform(-1, 2)], (6, 2)), np.zeros(6)])
    polygons = nasty_polygons(rng, count, np.concatenate([light, points]))
    polygons = [polygon for polygon in polygons if np.abs(polygon).max() < 300.0]
    geometry = geometry_of(*[[polygon + shift] for polygon in polygons], [rectangle(60, 61, 60, 61, -60) + shift])
    sender = AreaLight(light + shift, ONE)
    normals = np.repeat(UP[None], 6, axis=0)
    exact = estimate(points + shift, UP, sender, geometry, "exact", workers=1)
    for method in ("auto", "exact", "shaft"):
        found = exact if method == "exact" else estimate(points + shift, UP, sender, geometry, method, workers=1)
        state = found.state[:, 0]
        np.testing.assert_array_equal(found.visible_share[state == LIT, 0], found.open_share[state == LIT, 0])
        assert (found.visible_share[state == DARK, 0] == 0.0).all()
    # A sensor in the plane of a slanted polygon sees it edge on: it hides nothing, but rounded rays may meet it.
    clear = np.ones(6, dtype=bool)
    for polygon in polygons:
        normal = vector_area(polygon) / np.linalg.norm(vector_area(polygon))
        if abs(normal[2]) < 1 - 1e-9:
            clear &= np.abs((points - polygon[0]) @ normal) > 1e-6
    lit = clear & (exact.state[:, 0] == LIT)
    dark = clear & (exact.state[:, 0] == DARK) & (exact.open_share[:, 0] > 0.0)
    for ring in convex_pieces([light]):
        blocked, above = blocked_by_brute(geometry, points + shift, normals, ring + shift, seed=seed)
        # A ray may graze what hides a null set: of a lit point none but such rays are blocked.
        assert (blocked & above)[lit].mean(axis=1).max(initial=0.0) <= 1 / 24
        assert (~blocked & above)[dark].mean(axis=1).max(initial=0.0) <= 1 / 24


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 8))
def test_exact_share_is_what_brute_rays_converge_to(seed, count):
    rng = np.random.default_rng(seed)
    polygons = [rng.uniform([-1, -1, 0.1], [1, 1, 1.9], (3, 3)) for _ in range(count)]
    geometry = geometry_of(polygons)
    points = plane_points(4, 1.0, seed)
    exact = estimate(points, UP, SQUARE, geometry, "exact", workers=1)
    blocked, above = blocked_by_brute(geometry, points, np.repeat(UP[None], 4, 0), UNIT_SQUARE_LIGHT, rays=1024)
    targets = sender_samples(UNIT_SQUARE_LIGHT, 1e-6 + (1 - 2e-6) * unit_samples(np.arange(4), 1024, 0))
    along = targets - points[:, None]
    weight = along[..., 2] ** 2 / np.einsum("nkj,nkj->nk", along, along) ** 2
    share = (weight * (~blocked & above)).sum(axis=1) / weight.sum(axis=1)
    # 1,024 samples: 0.52 K^-3/4 = 0.0029 of the light, five times that.
    assert np.abs(exact.visible_share[:, 0] / exact.open_share[:, 0] - share).max() < 0.015


def test_three_states_under_a_square_occluder():
    # Similar triangles: umbra to 1.0, penumbra to 2.0 from the centre, for half-sides 0.5 and 0.75.
    geometry = geometry_of([rectangle(-0.75, 0.75, -0.75, 0.75, 1.0)])
    for method in ("auto", "camera-optimised", "exact", "shaft"):
        # A camera's frustum is wider than the light.
        outside = 2.5 if method == "camera-optimised" else 2.01
        points = np.array([[0.5, 0, 0], [0.99, 0, 0], [1.5, 0, 0], [outside, 0, 0], [5, 5, 0]])
        found = estimate(points, UP, SQUARE, geometry, method, workers=1)
        assert found.state[2, 0] == COMPLEX
        assert found.visible_share[:2, 0].tolist() == [0.0, 0.0]
        assert (found.state[[0, 1], 0] == DARK).all()
        assert (found.state[[3, 4], 0] == LIT).all()


def test_candidates_are_what_the_pyramid_leaves():
    squares = [rectangle(x - 0.05, x + 0.05, -0.05, 0.05, 1.0) for x in (-0.3, 0.0, 0.3, 2.0)]
    found = estimate([[0, 0, 0.0], [10, 0, 0]], UP, SQUARE, geometry_of(squares), "exact", workers=1)
    # At z = 1 the pyramid from the origin is 0.5 wide: the square at 0 is inside, those at 0.3 touch its rim.
    assert found.candidates[0, 0] == 1
    assert found.candidates[1, 0] == 0
    assert estimate([[0, 0, 0.0]], UP, SQUARE, geometry_of(squares), "rays", workers=1).candidates[0, 0] == -1


# ---- what answers must not depend on ------------------------------------------------------------


@each_method
def test_one_and_two_workers_give_the_same(method):
    geometry = geometry_of([rectangle(-0.3, 0.2, -0.4, 0.4, 1.0)], [rectangle(0.1, 0.5, -0.1, 0.6, 0.6)])
    points = plane_points(3000)
    lights = [SQUARE, AreaLight(UNIT_SQUARE_LIGHT + [0.5, 0.2, 0.3], 2 * ONE)]
    one, two = (estimate(points, UP, lights, geometry, method, workers=w, samples=16) for w in (1, 2))
    np.testing.assert_array_equal(one.irradiance, two.irradiance)
    np.testing.assert_array_equal(one.standard_error, two.standard_error)
    np.testing.assert_array_equal(one.state, two.state)
    assert dict(one.counters) == dict(two.counters)


@each_method
def test_the_order_of_the_points_does_not_matter_to_exact_answers(method):
    geometry = geometry_of([rectangle(-0.3, 0.2, -0.4, 0.4, 1.0)])
    points = plane_points(200)
    shuffle = np.random.default_rng(1).permutation(200)
    whole = estimate(points, UP, SQUARE, geometry, method, workers=1)
    mixed = estimate(points[shuffle], UP, SQUARE, geometry, method, workers=1)
    # Sampled answers are tied to a point's number; others are bit for bit the same.
    bound = 1e-15 if method in ("auto", "exact", "shaft") else 10.0
    gap = np.abs(whole.irradiance[shuffle] - mixed.irradiance)
    assert (gap <= bound * np.maximum(np.hypot(mixed.standard_error, whole.standard_error[shuffle]), 1e-3)).all()


@each_method
@pytest.mark.parametrize("ring", [UNIT_SQUARE_LIGHT, L_SHAPE], ids=["square", "concave"])
def test_winding_matters_only_through_the_emitting_side(method, ring):
    # The same light begun at another corner is the same; turned round it sends nothing down, and all up.
    geometry = geometry_of([rectangle(-0.3, 0.2, -0.4, 0.4, 1.0)], [rectangle(-0.3, 0.2, -0.4, 0.4, 3.0)])
    points = plane_points(40)
    usual = estimate(points, UP, AreaLight(ring, ONE), geometry, method, workers=1)
    begun = estimate(points, UP, AreaLight(np.roll(ring, 2, axis=0), ONE), geometry, method, workers=1)
    back = estimate(points, UP, AreaLight(ring[::-1], ONE), geometry, method, workers=1)
    mirror = np.array([1.0, 1.0, -1.0])
    above = estimate(points * mirror + [0, 0, 4.0], -UP, AreaLight(ring[::-1], ONE), geometry, method, workers=1)
    spread = 6 * np.hypot(usual.standard_error, begun.standard_error) + 1e-12
    assert (np.abs(usual.irradiance - begun.irradiance) <= spread).all()
    assert (np.abs(usual.irradiance - above.irradiance) <= 6 * np.hypot(usual.standard_error, above.standard_error)
            + 1e-12).all()  # fmt: skip
    assert not back.irradiance.any()
    assert (back.state == DARK).all()
    assert usual.irradiance.min() > 0.0


@pytest.mark.parametrize("shift", [0.0, 1e3, 1e5])
@each_method
def test_far_from_the_origin(method, shift):
    # Sensors on a floor that is a polygon of the scene, unnamed: its own plane must not shadow it.
    move = shift * np.array([1.0, -1.0, 0.7])
    geometry = geometry_of([rectangle(-2, 2, -2, 2, 0) + move], [rectangle(-0.2, 0.2, -0.2, 0.2, 1.0) + move])
    points = np.array([[1.5, 0, 0], [0.0, 0, 0]]) + move
    found = estimate(points, UP, AreaLight(UNIT_SQUARE_LIGHT + move, ONE), geometry, method, workers=1, samples=256)
    # shadow/square/row-a=0.4 and light/quad-row: 0.10261467505 and 0.07891872805.
    wanted = np.array([0.10261467505329237, 0.07891872804788831])
    assert np.abs(found.irradiance[:, 0] - wanted).max() < (1e-6 if method in ("auto", "exact", "shaft") else 0.02)
    assert found.irradiance[0, 0] > 0.09


@each_method
def test_tilted_floor_far_away_does_not_shadow_its_own_sensors(method):
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    move = np.array([1e5, 2e5, -1e5])
    geometry = geometry_of([rectangle(-2, 2, -2, 2, 0) @ turn.T + move])
    points = plane_points(50) @ turn.T + move
    light = AreaLight(UNIT_SQUARE_LIGHT @ turn.T + move, ONE)
    found = estimate(points, turn @ UP, light, geometry, method, workers=1, samples=16)
    np.testing.assert_allclose(found.visible_share, found.open_share, rtol=1e-9)


# ---- lights among the polygons, sensors of all kinds ---------------------------------------------


@each_method
def test_lights_in_the_geometry_do_not_shadow_themselves(method):
    geometry = geometry_of([UNIT_SQUARE_LIGHT], [L_SHAPE + [3, 0, 0]])
    points = plane_points(30)
    for index, ring in enumerate((UNIT_SQUARE_LIGHT, L_SHAPE + [3, 0, 0])):
        for number in (index, -1):  # named, and merely lying there
            found = estimate(points, UP, AreaLight(ring, ONE, number), geometry, method, workers=1, samples=16)
            np.testing.assert_allclose(found.visible_share, found.open_share, rtol=1e-9)
            assert (found.open_share > 0).all()


@each_method
def test_points_behind_the_light_get_nothing(method):
    points = np.array([[0, 0, 2.5], [0.3, 0.2, 4.0], [0, 0, 2.0], [5, 5, 2.0]])
    found = estimate(points, UP * [1, 1, -1], SQUARE, EMPTY, method, workers=1)
    assert not found.irradiance.any()
    assert (found.state == DARK).all()


@each_method
def test_a_single_point(method):
    found = estimate([0, 0, 0], UP, SQUARE, EMPTY, method, workers=1)
    # light/quad-row at x = 0: 0.23083679773.
    assert found.irradiance.shape == (1, 1)
    assert found.irradiance[0, 0] == pytest.approx(0.23083679773017077, rel=1e-9)


@each_method
@pytest.mark.parametrize("along", [[1, 0, 0], [0, 1, 0], [1, 1, 0]])
def test_collinear_sensors(method, along, torus):
    points = np.linspace(-1, 1, 400)[:, None] * np.array(along, dtype=float)
    found = torus.estimate(points, UP, SQUARE, method, samples=64)
    exact = torus.estimate(points, UP, SQUARE, "exact")
    bound = np.maximum(6 * found.standard_error, 0.06 * exact.irradiance.mean())
    assert (np.abs(found.irradiance - exact.irradiance) <= bound).all()


@each_method
def test_many_sensors_at_one_place(method, torus):
    # A tile without extent cannot be cut into smaller ones.
    found = torus.estimate(np.repeat([[0.1, 0.05, 0.0]], 300, axis=0), UP, SQUARE, method)
    exact = torus.estimate([[0.1, 0.05, 0.0]], UP, SQUARE, "exact")
    assert np.abs(found.irradiance.mean() - exact.irradiance[0, 0]) < 0.1 * exact.irradiance[0, 0]


@each_method
def test_scattered_sensors_of_all_orientations(method, torus):
    rng = np.random.default_rng(4)
    points = rng.uniform([-1, -1, 0], [1, 1, 0.5], (150, 3))
    normals = rng.normal(size=(150, 3))
    found = torus.estimate(points, normals, SQUARE, method, samples=64)
    exact = torus.estimate(points, normals, SQUARE, "exact")
    # 64 rays: 0.64 64^-3/4 = 0.03 of the open irradiance, which is some three times what arrives.
    assert np.sqrt(np.mean((found.irradiance - exact.irradiance) ** 2)) < 0.15 * exact.irradiance.mean()
    assert np.isfinite(found.standard_error).all()


# ---- auto --------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [0.03, 0.01])
def test_auto_meets_its_asked_error_under_a_torus(torus, error):
    points = grid_points(72)
    exact = torus.estimate(points, UP, SQUARE, "exact").irradiance[:, 0]
    for seed in (0, 1):
        found = torus.estimate(points, UP, SQUARE, "auto", error=error, seed=seed)
        assert np.sqrt(np.mean((found.irradiance[:, 0] - exact) ** 2)) <= error * exact.mean()
        # And without rays but the pilot's: by lines, of which L leave some 0.17 L^-3/2; the share may be off by 0.35
        # errors here.
        assert found.counters["rays"] <= 2 * PILOT_POINTS * PILOT_RAYS
        assert found.counters["sender_lines"] < 4 * (0.17 / (0.35 * error)) ** (2 / 3) * len(points)


def test_auto_meets_its_asked_error_by_rays_and_fits(torus, monkeypatch):
    # As it does behind panes and in thickets: no lines are drawn.
    monkeypatch.setattr(occlusion, "line_tiles", lambda *arguments: None)
    points = grid_points(72)
    exact = torus.estimate(points, UP, SQUARE, "exact").irradiance[:, 0]
    found = torus.estimate(points, UP, SQUARE, "auto", error=0.02)
    assert np.sqrt(np.mean((found.irradiance[:, 0] - exact) ** 2)) <= 0.02 * exact.mean()
    # Fewer rays than K = (0.64 / share)^(4/3) at every point: the share may be off by 0.35 errors here.
    assert 0 < found.counters["rays"] < 0.5 * (0.64 / (0.35 * 0.02)) ** (4 / 3) * len(points)
    assert found.counters["sender_lines"] == 0


def test_auto_takes_what_is_cheapest_at_the_asked_error(torus):
    # Little asked of few points: a handful of rays at each, and no preparation of lines.
    found = torus.estimate(grid_points(10), UP, SQUARE, "auto", error=0.2)
    assert found.counters["sender_lines"] == 0
    assert 0 < found.counters["rays"] <= 64 * 100
    # Much asked of many: lines, and no rays but the pilot's.
    found = torus.estimate(grid_points(72), UP, SQUARE, "auto", error=1e-3)
    assert found.counters["sender_lines"] > 0
    assert found.counters["rays"] <= 2 * PILOT_POINTS * PILOT_RAYS
    # Long lists, but of few points: cut, without any error.
    leaves = np.random.default_rng(8).uniform([-1, -1, 0.5], [1, 1, 1.5], (40, 3))
    shader = Shader(geometry_of([leaf + [[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0.1]] for leaf in leaves]), 1)
    found = shader.estimate(plane_points(300), UP, SQUARE, "auto", error=1e-3)
    assert found.counters["exact_cuts"] > 100
    assert found.counters["sender_lines"] == 0
    assert not found.standard_error.any()


def test_panes_before_a_tessellated_occluder_dim_and_hide(torus):
    # A wide pane of transmittance 1/2 above the torus halves all that passes.
    pane = rectangle(-FAR, FAR, -FAR, FAR, 1.5)
    triangles = [torus.geometry.piece(i) for i in range(torus.geometry.piece_count)]
    shader = Shader(geometry_of(triangles, [pane], transmittance=[0.0, 0.5]), 1)
    points = plane_points(40)
    exact = torus.estimate(points, UP, SQUARE, "exact")
    found = shader.estimate(points, UP, SQUARE, "auto", error=0.05)
    assert np.abs(found.irradiance - 0.5 * exact.irradiance).max() < 0.1 * exact.irradiance.mean()
    assert found.counters["sender_lines"] == 0


def test_auto_draws_few_lines_where_all_is_dark():
    # A ball of 1,280 facets hides all of the light; the relative error of nothing has no bottom.
    vertices, faces, _, _ = sphere_mesh([0.0, 0.0, 1.0], 0.8, 0.005)
    points = grid_points(40, 0.2)
    found = estimate(points, UP, SQUARE, geometry_of(list(vertices[faces])), "auto", workers=1)
    assert not found.irradiance.any()
    assert (found.state == DARK).all()
    # The pilot's alone.
    assert found.counters["rays"] <= 2 * PILOT_POINTS * PILOT_RAYS
    assert found.counters["sender_lines"] <= 8 * 512


# ---- other lights ------------------------------------------------------------------------------


@each_method
@pytest.mark.parametrize(
    "light",
    [
        PointLight("bulb", ONE, [0.0, 0.0, 2.0]),
        SpotLight("spot", ONE, [0.0, 0.0, 2.0], [0.0, 0.0, -1.0], 60.0, 2.0),
        DirectionalLight("sun", ONE, [0.2, 0.0, -1.0]),
    ],
    ids=lambda light: light.name,
)
def test_lights_without_extent_are_settled_by_one_ray(method, light):
    geometry = geometry_of([rectangle(-0.25, 0.25, -0.25, 0.25, 1.0)])
    points = plane_points(200)
    found = estimate(points, UP, light, geometry, method, workers=1)
    along = np.broadcast_to([-0.2, 0.0, 1.0], points.shape) if light.name == "sun" else [0, 0, 2.0] - points
    hidden = (np.abs((points + along / along[:, 2:])[:, :2]) < 0.25).all(axis=1)
    wanted = np.where(hidden, 0.0, light.irradiance(points, UP)[:, 0])
    np.testing.assert_allclose(found.irradiance[:, 0], wanted, rtol=1e-7)
    assert 0 < hidden.sum() < 200
    assert (found.state[hidden] == DARK).all()
    assert (found.state[~hidden & (wanted > 0), 0] == LIT).all()
    assert found.counters["rays"] == (light.irradiance(points, UP) > 0).sum()
    assert not found.standard_error.any()


@pytest.mark.parametrize("method", ["adaptive", "auto", "exact", "rays", "rays+plane-vertex", "shaft"])
@pytest.mark.parametrize("lambertian", [False, True])
def test_linear_light_under_a_straight_edge(method, lambertian):
    # Right of the edge x = 0 at half height the part of the line with s < -x is seen: closed form of that part.
    light = LinearLight("tube", ONE, [-0.5, 0, 2.0], [0.5, 0, 2.0], lambertian)
    geometry = geometry_of([rectangle(0.0, FAR, -FAR, FAR, 1.0)])
    x = np.array([-0.7, -0.4, -0.1, 0.0, 0.2, 0.4, 0.7])
    points = np.column_stack([x, 0 * x, 0 * x])
    found = estimate(points, UP, light, geometry, method, workers=1, samples=64)
    wanted = [
        LinearLight("part", ONE, [-0.5, 0, 2.0], [min(-a, 0.5), 0, 2.0], lambertian).irradiance(point[None], UP)[0, 0]
        if -a > -0.5
        else 0.0
        for a, point in zip(x, points, strict=True)
    ]
    if method in ("auto", "exact", "shaft"):
        np.testing.assert_allclose(found.irradiance[:, 0], wanted, atol=1e-9)
        assert found.state[:, 0].tolist() == [LIT, *[COMPLEX] * 5, DARK]
    else:
        error = np.abs(found.irradiance[:, 0] - wanted)
        assert (error <= 4 * found.standard_error[:, 0] + 1e-12).all()
        assert error.max() < 0.03


@pytest.mark.parametrize("method", METHODS)
def test_disk_light_halved_by_an_edge(method):
    disk = DiskLight("disk", ONE, [0.0, 0.0, 2.0], 0.5, [0.0, 0.0, -1.0])
    geometry = geometry_of([rectangle(0.0, FAR, -FAR, FAR, 1.0)])
    found = estimate([[0, 0, 0.0], [-3, 0, 0]], UP, disk, geometry, method, workers=1, samples=400)
    # On the axis (r/d)^2/(1 + (r/d)^2) = 1/17, half of it by symmetry; open, the exact factor.
    assert found.open_share[0, 0] == pytest.approx(1 / 17, rel=1e-12)
    assert abs(found.visible_share[0, 0] - 0.5 / 17) <= 4 * found.standard_error[0, 0]
    assert found.visible_share[0, 0] == pytest.approx(0.5 / 17, rel=0.06)
    assert found.visible_share[1, 0] == pytest.approx(found.open_share[1, 0], rel=1e-9)


@pytest.mark.parametrize("method", ["auto", "exact", "rays", "shaft"])
def test_sphere_light_halved_by_an_edge_and_not_by_its_own_facets(method):
    vertices, faces, _, _ = sphere_mesh([0.0, 0.0, 3.0], 1.0, 0.02)
    geometry = geometry_of(list(vertices[faces]), [rectangle(0.0, FAR, -FAR, FAR, 1.0)])
    light = SphereLight("ball", ONE, [0.0, 0.0, 3.0], 1.0, np.arange(len(faces)))
    found = estimate([[0, 0, 0.0], [-2.0, 0, 0]], UP, light, geometry, method, workers=1, samples=400)
    # (R/d)^2 cos: 1/9 below the centre; half of it by symmetry.  From x = -2 the edge is out of the way.
    assert found.open_share[0, 0] == pytest.approx(1 / 9, rel=1e-12)
    assert abs(found.visible_share[0, 0] - 0.5 / 9) <= 4 * found.standard_error[0, 0] + 1e-4
    assert found.visible_share[1, 0] == pytest.approx(found.open_share[1, 0], rel=1e-9)


def test_two_sided_polygon_lights_both_sides():
    light = PolygonLight("pane", ONE, UNIT_SQUARE_LIGHT, two_sided=True)
    points, normals = np.array([[0, 0, 0.0], [0, 0, 4.0]]), np.array([UP, -UP])
    for method in METHODS:
        found = estimate(points, normals, light, EMPTY, method, workers=1)
        np.testing.assert_allclose(found.irradiance, 0.23083679773017077 / math.pi, rtol=1e-9)


def test_polygon_light_with_a_hole_is_the_difference_of_two():
    hole = rectangle(-0.2, 0.2, -0.2, 0.2, 2.0)
    light = PolygonLight("frame", ONE, [UNIT_SQUARE_LIGHT, hole])
    geometry = geometry_of([rectangle(0.05, FAR, -FAR, FAR, 1.0)])
    points = plane_points(20)
    frame = estimate(points, UP, light, geometry, "exact", workers=1).visible_share
    outer = estimate(points, UP, SQUARE, geometry, "exact", workers=1).visible_share
    inner = estimate(points, UP, AreaLight(hole[::-1], ONE), geometry, "exact", workers=1).visible_share
    np.testing.assert_allclose(frame, outer - inner, atol=1e-13)


def test_a_light_of_100_corners_is_cut_like_its_triangles():
    # More corners than the kernels' scratch holds: the light is cut into smaller pieces first.
    angle = -np.arange(100) * math.tau / 100
    ring = np.column_stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), np.full(100, 2.0)])
    geometry = geometry_of([rectangle(0.0, FAR, -FAR, FAR, 1.0)])
    for method in METHODS:
        found = estimate([[0, 0, 0.0]], UP, AreaLight(ring, ONE), geometry, method, workers=1, samples=256)
        exact = 0.5 * found.open_share[0, 0]
        assert abs(found.visible_share[0, 0] - exact) <= max(1e-12, 4 * found.standard_error[0, 0] / math.pi)


def test_panes_dim_by_their_product_in_every_method_that_knows_them():
    geometry = geometry_of(
        [rectangle(-FAR, FAR, -FAR, FAR, 0.5 + 0.3 * k) for k in range(3)], transmittance=0.5
    )  # fmt: skip
    lights = [PointLight("bulb", ONE, [0.1, 0.0, 2.0]), SQUARE]
    for method in ("adaptive", "auto", "exact", "rays", "rays+plane-vertex", "shaft"):
        found = estimate([[0, 0, 0.0]], UP, lights, geometry, method, workers=1)
        np.testing.assert_allclose(found.visible_share, 0.125 * found.open_share, rtol=1e-9)


def test_several_lights_of_several_bands_add_up():
    lights = [AreaLight(UNIT_SQUARE_LIGHT, np.array([1.0, 2.0, 3.0])), PointLight("bulb", 2 * ONE, [1.0, 0, 1.0])]
    found = estimate([[0, 0, 0.0]], UP, lights, EMPTY, "exact", workers=1)
    # cos / r^2 = (1 / sqrt 2) / 2 for the bulb, of 2 W/sr in every band.
    wanted = 0.23083679773017077 * np.array([1.0, 2.0, 3.0]) + 2 / (2 * math.sqrt(2))
    np.testing.assert_allclose(found.irradiance[0], wanted, rtol=1e-12)


def test_same_seed_same_rays_in_the_instrument_and_in_embree():
    geometry = geometry_of([rectangle(-0.31, 0.17, -0.23, 0.41, 1.0)])
    points = plane_points(100)
    embree = estimate(points, UP, SQUARE, geometry, "rays", workers=1, seed=3)
    voxels = estimate(points, UP, SQUARE, geometry, "rays+plane-vertex", workers=1, seed=3)
    np.testing.assert_allclose(embree.irradiance, voxels.irradiance, atol=1e-6)
    assert embree.counters["rays"] == voxels.counters["rays"] == 6400


def test_camera_falls_back_to_exact_cuts_near_the_lights_plane():
    # 0.01 below a light of side 1 a picture of 8 pixels across cannot hold the kernel.
    geometry = geometry_of([rectangle(0.0, 0.01, -0.3, 0.2, 1.995)])
    camera = estimate([[0, 0, 1.99]], UP, SQUARE, geometry, "camera", workers=1)
    exact = estimate([[0, 0, 1.99]], UP, SQUARE, geometry, "exact", workers=1)
    assert camera.counters["camera_fallbacks"] == 1
    assert 0.0 < camera.irradiance[0, 0] == exact.irradiance[0, 0] < 0.9 * math.pi


# ---- bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "pattern"),
    [
        ({"method": "magic"}, "method: found 'magic'"),
        ({"error": 0.0}, "error: found 0"),
        ({"samples": 0}, "samples: found 0"),
        ({"workers": 0}, "workers: found 0"),
        ({"lights": []}, "lights: found none"),
        ({"lights": AreaLight(UNIT_SQUARE_LIGHT[:2], ONE)}, "light: found a ring of 2 vertices"),
        ({"lights": [SQUARE, AreaLight(UNIT_SQUARE_LIGHT, np.ones(3)), AreaLight(L_SHAPE, np.ones(2))]}, "bands"),
        ({"lights": object()}, "light"),
        ({"points": np.empty((0, 3))}, "points: found none"),
        ({"normals": np.ones((2, 3))}, "normals: found 2 rows for 1 points"),
        ({"method": "camera", "lights": LinearLight("tube", ONE, [0, 0, 1.0], [1, 0, 1.0])}, "cameras see areas only"),
        ({"method": "adaptive", "lights": SphereLight("ball", ONE, [0, 0, 3.0], 1.0)}, "sphere 'ball'"),
    ],
)
def test_bad_input_is_refused_in_one_line(change, pattern):
    arguments = {"points": [[0, 0, 0.0]], "normals": UP, "lights": SQUARE, "geometry": EMPTY} | change
    with pytest.raises((InputError, OptionError), match=pattern) as caught:
        estimate(**arguments)
    assert "\n" not in str(caught.value)
