"""Shadow cameras: where they fail and by how much, one test for each known failure, numbered."""

from __future__ import annotations

import ctypes
import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

from workbench.errors import InputError, MissingLibraryError, OptionError
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import vector_area
from workbench.scene.model import Material, Scene, Surface
from workbench.shadow import gl_rasteriser
from workbench.shadow.hardware_camera import CameraState, camera_shadows
from workbench.shadow.proxy import proxy_geometry, silhouette_areas

NOTHING = np.zeros(3)
BLACK = Material("black", NOTHING, NOTHING, NOTHING, np.inf, NOTHING)
LIGHT = np.array([[-0.5, -0.5, 2], [-0.5, 0.5, 2], [0.5, 0.5, 2], [0.5, -0.5, 2]])
UP = np.array([0.0, 0.0, 1.0])
MODES = ["naive", "optimised"]
TRUTH = Path(__file__).resolve().parents[2] / ".." / "shared" / "truth" / "truth.json"


def has_gl() -> bool:
    try:
        return bool(gl_rasteriser.gl_renderer())
    except MissingLibraryError:
        return False


BACKENDS = ["software", pytest.param("gl", marks=pytest.mark.skipif(not has_gl(), reason="no OpenGL on EGL here"))]


def geometry_of(*polygons, material=BLACK) -> Geometry:
    polygons = [np.asarray(polygon, dtype=float) for polygon in polygons]
    return Geometry.from_scene(Scene("test", (Surface.from_polygons("all", material, polygons),)))


def mesh_geometry(mesh) -> Geometry:
    return Geometry.from_scene(Scene("test", (Surface.from_mesh("mesh", BLACK, mesh.vertices, mesh.faces),)))


def square(x0, x1, y0, y1, z) -> np.ndarray:
    return np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]], dtype=float)


def clipped(polygon, normal, offset=0.0) -> np.ndarray:
    """The part of a polygon where ``normal . p > offset``."""
    height = polygon @ normal - offset
    kept = []
    for i in range(len(polygon)):
        j = (i + 1) % len(polygon)
        if height[i] > 0:
            kept.append(polygon[i])
        if (height[i] > 0) != (height[j] > 0):
            t = height[i] / (height[i] - height[j])
            kept.append(polygon[i] + t * (polygon[j] - polygon[i]))
    return np.asarray(kept).reshape(-1, 3)


def irradiance(polygon, point=(0, 0, 0), normal=UP) -> float:
    """Irradiance from a polygon of radiance 1, by Lambert's formula above the horizon."""
    normal = np.asarray(normal) / np.linalg.norm(normal)
    corners = clipped(np.asarray(polygon, dtype=float) - point, normal)
    total = 0.0
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        across = np.cross(a, b)
        length = np.linalg.norm(across)
        if length > 0:
            total += np.arctan2(length, a @ b) * (across @ normal) / length
    return abs(total) / 2


def facing(polygon, point=(0, 0, 0)) -> np.ndarray:
    polygon = np.asarray(polygon, dtype=float)
    return polygon if vector_area(polygon) @ (point - polygon[0]) > 0 else polygon[::-1]


def look(points, normals, light, geometry, **options):
    points = np.atleast_2d(points)
    return camera_shadows(points, np.broadcast_to(normals, points.shape), light, geometry, **options)


E0 = irradiance(LIGHT)


def test_own_closed_forms_equal_the_table_of_truths():
    if not TRUTH.exists():
        pytest.skip("no table of truths beside the repository")
    case = {each["name"]: each for each in json.loads(TRUTH.read_text())["cases"]}
    assert pytest.approx(case["fail/near-plane-occluder"]["value"][1], rel=1e-12) == E0
    wide = case["fail/area-fraction-is-not-irradiance"]
    light = np.array(wide["geometry"]["light"], dtype=float)
    part = irradiance(clipped(light, np.array([1.0, 0, 0]), 1.0)) / irradiance(light)
    assert part == pytest.approx(wide["value"][0], rel=1e-12)
    for name in ("vf/element/triangle", "vf/element/half-below-horizon"):
        found = irradiance(case[name]["geometry"]["polygon"]) / np.pi
        assert found == pytest.approx(case[name]["value"], rel=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
def test_6_1_pixels_are_equal_areas_of_the_light_not_equal_irradiance(backend):
    light = np.array([[0, -2, 1], [0, 2, 1], [4, 2, 1], [4, -2, 1]], dtype=float)
    # The half-plane z = 0.5, x < 0.5 hides what lies at x < 1 on the light.
    right = irradiance(clipped(light, np.array([1.0, 0, 0]), 1.0)) / irradiance(light)
    assert right == pytest.approx(0.2418841722, abs=1e-9)
    geometry = geometry_of(square(-50, 0.5, -50, 50, 0.5))
    errors = []
    for viewport in (8, 16, 32, 64, 128):
        seen = look([0, 0, 0], UP, light, geometry, viewport=viewport, backend=backend)
        assert seen.pixel_fraction[0] == 0.75
        errors.append(abs(seen.visible_share[0] - right))
        assert errors[-1] < 0.5 / viewport
    # The edge lies between two pixels here, so the error even falls as the midpoint rule's, 1/n^2.
    assert np.log2(errors[1] / errors[-1]) / 3 > 1.8


def test_6_2_the_mild_case_a_straight_edge():
    x = np.linspace(-0.6, 0.6, 49)
    points = np.column_stack([x, 0 * x, 0 * x])
    geometry = geometry_of(square(0, 100, -100, 100, 1))
    visible = [clipped(LIGHT, np.array([-1.0, 0, 0]), place) for place in x]
    right = np.array([irradiance(part, point) for part, point in zip(visible, points, strict=True) if len(part)])
    right = np.concatenate([right, np.zeros(len(x) - len(right))])
    whole = np.array([irradiance(LIGHT, point) for point in points])
    # At a multiple of the pixel only the weighting is left of the error.
    seen = look(points, UP, LIGHT, geometry, viewport=80)
    assert np.abs(seen.visible_share * whole - right).max() < 2e-5
    area_error = np.abs(seen.pixel_fraction - right / whole)
    assert area_error.max() == pytest.approx(0.0281, abs=1e-4)
    assert abs(x[np.argmax(area_error)]) == pytest.approx(0.275)
    # Elsewhere the edge costs half a pixel at most: 1/(2n) of the light, times its weight of at most 1.3.
    coarse = look(points + [0.0037, 0, 0], UP, LIGHT, geometry, viewport=32)
    shifted = look(points + [0.0037, 0, 0], UP, LIGHT, geometry, viewport=1000)
    assert np.abs(coarse.pixel_fraction - shifted.pixel_fraction).max() <= 1 / 64 + 1 / 2000
    assert np.abs(coarse.visible_share - shifted.visible_share).max() <= 1.3 / 64 + 1e-3


@pytest.mark.parametrize("backend", BACKENDS)
def test_6_9_a_corner_above_the_horizon_covers_half_of_the_viewport(backend):
    # The cut runs along the diagonal of the pixels; through their centres it would take all of them or none.
    empty = geometry_of(square(50, 51, 50, 51, -50))
    for corner in range(4):
        normal = LIGHT[corner] - LIGHT[(corner + 2) % 4]
        for lift in (0.1, 0.2, 0.35):
            # The tangent plane of a point in the light's axis that cuts the corner's sides alike.
            edge = LIGHT[corner] - lift * normal
            tilted = normal - (normal @ edge) / (edge @ edge) * edge
            seen = look([0, 0, 0], tilted, LIGHT, empty, mode="naive", backend=backend)
            assert seen.light_pixels[0] == 32 * 31 // 2
            assert seen.light_weight[0] == pytest.approx(irradiance(LIGHT, normal=tilted), rel=0.01)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("jitter", ["none", "shift", "rotate"])
def test_no_jitter_moves_the_camera_off_a_blocker_at_the_rim(backend, jitter):
    # Seen from the origin a strip covers the outermost 1/100 of the light: no point may be known lit.
    for turn in (LIGHT, np.roll(LIGHT, 1, axis=0)):
        for strip in (square(-0.3, -0.245, -1, 1, 1), square(0.245, 0.3, -1, 1, 1), square(-1, 1, 0.245, 0.3, 1)):
            seen = look(np.zeros((50, 3)), UP, turn, geometry_of(strip), jitter=jitter, seed=3, backend=backend)
            assert (seen.state == CameraState.RENDERED).all()
            if jitter != "none":
                # And all of it is sampled: 1/100 on the average of the shifts.
                assert 1 - seen.pixel_fraction.mean() == pytest.approx(0.01, abs=0.008)


def fence(offset: float) -> Geometry:
    """32 slats at half height whose shadows are half a pixel wide, one a pixel; ``offset`` in pixels."""
    left = ((np.arange(-40, 80) + offset) / 32 - 0.5) / 2
    return geometry_of(*(square(x, x + 1 / 128, -2, 2, 1) for x in left))


def test_6_3_slats_one_pixel_apart_need_a_turned_pattern():
    # Truth: half of the light. A pattern in step with the slats sees all or nothing.
    assert look([0, 0, 0], UP, LIGHT, fence(0.25)).pixel_fraction[0] == 0.0
    assert look([0, 0, 0], UP, LIGHT, fence(0.75)).pixel_fraction[0] == 1.0
    points = np.zeros((400, 3))
    shifted = look(points, UP, LIGHT, fence(0.25), jitter="shift", seed=1).pixel_fraction
    # A shifted pattern is a pixel wider than the light, and falls out of step by one slat over its width.
    assert shifted.mean() == pytest.approx(0.5, abs=4 * 0.5 / 20)
    turned = look(points, UP, LIGHT, fence(0.25), jitter="rotate", seed=1).pixel_fraction
    assert turned.mean() == pytest.approx(0.5, abs=0.01)
    # Angles near 0 and 90 degrees still beat with the slats, the others do not.
    assert np.median(np.abs(turned - 0.5)) < 0.02
    assert np.quantile(np.abs(turned - 0.5), 0.9) < 0.07


def test_6_4_a_strip_between_two_columns_of_pixels():
    # 0.02 of the light's width, on the line between columns 16 and 17 of 32.
    geometry = geometry_of(square(1 / 128 - 0.005, 1 / 128 - 0.005 + 0.01, -2, 2, 1) - [1 / 128, 0, 0])
    seen = look([0, 0, 0], UP, LIGHT, geometry, conservative=True)
    assert seen.visible_share[0] == 1.0  # The picture misses it ...
    assert seen.state[0] == CameraState.RENDERED  # ... but the point is not called lit ...
    assert seen.untouched_fraction[0] <= 0.98 <= seen.pixel_fraction[0]  # ... and the truth is bracketed.
    assert seen.untouched_fraction[0] == 30 / 32
    points = np.zeros((4000, 3))
    for jitter in ("shift", "rotate"):
        shares = look(points, UP, LIGHT, geometry, jitter=jitter, seed=4).pixel_fraction
        error = shares.std() / np.sqrt(len(points))
        assert error < 3e-4
        assert abs(shares.mean() - 0.98) < 4 * error + 2e-4


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("mode", MODES)
def test_6_5_overdraw_counts_once(backend, mode):
    # Two quads hide the same 0.3 of the light: 6 columns of 20.
    low, high = square(-1, -0.1, -1, 1, 1), square(-2, -0.15, -2, 2, 1.5)
    for order in ((low, high), (high, low), (low, low, high)):
        seen = look([0, 0, 0], UP, LIGHT, geometry_of(*order), viewport=20, mode=mode, backend=backend)
        assert seen.pixel_fraction[0] == 0.7
    rng = np.random.default_rng(0)
    pile = rng.uniform(-0.3, 0.3, (100, 1, 3)) + rng.normal(0, 0.2, (100, 3, 3)) + [0, 0, 1]
    seen = look(rng.uniform(-0.2, 0.2, (50, 3)), UP, LIGHT, geometry_of(*pile), mode=mode, backend=backend)
    assert (seen.visible_pixels >= 0).all() and (seen.visible_pixels <= seen.light_pixels).all()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "occluder",
    [
        square(-0.0005, 0.0005, -0.0005, 0.0005, 1e-3),
        square(-0.25, 0.25, -0.25, 0.25, 1e-5),
        square(-0.0005, 0.0005, -0.0005, 0.0005, 1e-3)[::-1],
        # A roof that starts behind the point's back and ends above the light.
        np.array([[-9, -9, -1e-3], [9, -9, 3e-3], [9, 9, 3e-3], [-9, 9, -1e-3]]),
    ],
)
def test_6_6_no_near_plane_cuts_an_occluder_away(backend, mode, occluder):
    seen = look([0, 0, 0], UP, LIGHT, geometry_of(occluder), mode=mode, backend=backend)
    assert seen.visible_share[0] == 0.0
    behind = look([0, 0, 0], UP, LIGHT, geometry_of(square(-5, 5, -5, 5, -0.5)), mode=mode, backend=backend)
    assert behind.visible_share[0] == 1.0


def test_6_7_a_light_seen_from_behind_gives_nothing():
    light = square(-0.5, 0.5, -0.5, 0.5, 0)
    seen = look([0, 0, -1], UP, light, geometry_of(square(5, 6, 5, 6, 5)))
    assert seen.state[0] == CameraState.UNLIT
    assert seen.visible_share[0] == seen.pixel_fraction[0] == 0.0
    both = look([0, 0, -1], UP, light, geometry_of(square(5, 6, 5, 6, 5)), two_sided=True, mode="naive")
    assert both.light_weight[0] == pytest.approx(irradiance(light, [0, 0, -1]), rel=1e-3)
    away = look([0, 0, 0], -UP, LIGHT, geometry_of(square(5, 6, 5, 6, 5)))
    assert away.state[0] == CameraState.UNLIT


def test_6_8_near_the_lights_plane_it_is_right_or_falls_back():
    light = square(-0.5, 0.5, -0.5, 0.5, 0)
    geometry = geometry_of(square(5, 6, 5, 6, 5))
    for height in (0.0, 1e-12, 1e-9, 1e-6, 1e-3, 0.1):
        seen = look([2, 0, height], [-1.0, 0, 0], light, geometry, mode="naive")
        if height == 0:
            assert seen.state[0] == CameraState.UNLIT and seen.visible_share[0] == 0
        elif height < 1e-7:
            assert seen.state[0] in (CameraState.FALLBACK, CameraState.RENDERED)
        else:
            assert seen.state[0] == CameraState.RENDERED
        if seen.state[0] == CameraState.RENDERED:
            assert seen.light_weight[0] == pytest.approx(irradiance(light, [2, 0, height], [-1, 0, 0]), rel=2e-3)
    # Closer to the middle of the light than a pixel is wide, pixels see the kernel's peak or miss it.
    for viewport, state in ((32, CameraState.FALLBACK), (128, CameraState.RENDERED)):
        seen = look([0, 0, 1.98], UP, LIGHT, geometry, viewport=viewport, mode="naive")
        assert seen.state[0] == state
    assert seen.light_weight[0] == pytest.approx(irradiance(LIGHT, [0, 0, 1.98]), rel=0.01)
    flat = look([0, 0, 1.98], UP, LIGHT, geometry)
    assert flat.fallback[0] and np.isnan(flat.visible_share[0]) and flat.counters["camera_fallbacks"] == 1


@pytest.mark.parametrize("backend", BACKENDS)
def test_6_9_the_light_is_clipped_at_the_horizon(backend):
    light = facing([[1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]])
    far_off = geometry_of(square(5, 6, 5, 6, 5))
    seen = look([0, 0, 0], UP, light, far_off, mode="naive", backend=backend)
    assert seen.light_weight[0] / np.pi == pytest.approx(0.11146839401, rel=1e-3)
    assert seen.light_pixels[0] == 32 * 32  # The viewport fits the half that is above.
    # A wall over the part above the horizon hides all of it, one over the lower part nothing.
    high, low = (geometry_of([[0.5, -9, a], [0.5, 9, a], [0.5, 9, b], [0.5, -9, b]]) for a, b in ((0, 9), (-9, 0)))
    assert look([0, 0, 0], UP, light, high, backend=backend).visible_share[0] == 0.0
    assert look([0, 0, 0], UP, light, low, backend=backend).visible_share[0] == 1.0
    slanting = look([0, 0, 0], [0.3, 0.7, 1], light, far_off, mode="naive", backend=backend, viewport=64)
    assert slanting.light_weight[0] == pytest.approx(irradiance(light, (0, 0, 0), [0.3, 0.7, 1]), rel=0.01)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("mode", MODES)
def test_6_10_the_light_and_its_housing_do_not_shade_it(backend, mode):
    housing = [LIGHT, LIGHT[::-1], square(-1, 1, -1, 1, 2), square(-1, 1, -1, 1, 2.001), square(-5, 5, -5, 5, 2.5)]
    points = np.random.default_rng(3).uniform([-2, -2, -0.5], [2, 2, 0.5], (100, 3))
    seen = look(points, UP, LIGHT, geometry_of(*housing), mode=mode, backend=backend)
    assert (seen.visible_share == 1.0).all()
    if mode == "optimised":
        assert (seen.state == CameraState.NOT_INSHADOW).all()
    # Away from the origin the coordinates lose digits, not the light.
    shift = np.array([1e6, -1e6, 1e6])
    moved = geometry_of(*(polygon + shift for polygon in housing))
    seen = look(points + shift, UP, LIGHT + shift, moved, mode=mode, backend=backend)
    assert (seen.visible_share == 1.0).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_6_11_lights_of_other_shapes_are_drawn_and_counted(backend):
    far_off = geometry_of(square(5, 6, 5, 6, 5))
    triangle = facing([[1, 0, 1], [-0.5, 0.75, 2], [-0.25, -1, 0.5]])
    trapezoid = facing([[-1, -1, 2], [1, -1, 2], [0.3, 1, 2], [-0.3, 1, 2]])
    angle = np.linspace(0, 2 * np.pi, 65)[:-1]
    disc = facing(np.column_stack([np.cos(angle), np.sin(angle), 0 * angle + 2]))
    concave = facing([[-1, -1, 1], [1, -1, 1], [1, 0, 1], [0, 0, 1], [0, 1, 1], [-1, 1, 1]])
    for light in (triangle, trapezoid, disc, concave):
        errors = []
        for viewport in (32, 128):
            seen = look([0, 0, 0], UP, light, far_off, viewport=viewport, mode="naive", backend=backend)
            assert seen.visible_share[0] == 1.0
            assert 0 < seen.light_pixels[0] < viewport**2
            errors.append(abs(seen.light_weight[0] / irradiance(light) - 1))
        assert errors[0] < 1 / 32 and errors[1] < 1 / 128
        # Half hidden by a wall through the point: what lies at x > 0.05 on the light's side of it.
        wall = np.array([[0.05, -9, -9], [0.05, 9, -9], [0.05, 9, 9], [0.05, -9, 9]])
        # The part with x < 0.05 of a concave polygon is taken apart to be summed.
        part = irradiance(clipped(light, np.array([-1.0, 0, 0]), -0.05)) / irradiance(light)
        seen = look([0, 0, 0], UP, light, geometry_of(wall), viewport=128, backend=backend)
        assert seen.visible_share[0] == pytest.approx(part, abs=0.01)
    assert irradiance(triangle) / np.pi == pytest.approx(0.25020043651, rel=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
def test_6_11_a_light_that_is_not_flat(backend):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    light = list(ball.triangles + [0, 0, 2])
    ball.apply_translation([0, 0, 2])
    geometry = mesh_geometry(ball)
    own = np.arange(geometry.polygon_count)
    seen = look([0, 0, 0], UP, light, geometry, viewport=128, mode="naive", backend=backend)
    assert seen.visible_share[0] == 1.0  # The ball's far side does not hide its near side.
    # A sphere of radius r at distance d: E = pi (r / d)^2; the mesh is 0.6 % smaller in outline.
    assert seen.light_weight[0] == pytest.approx(np.pi / 16, rel=0.015)
    assert look([0, 0, 0], UP, light, geometry, ignore=own).state[0] == CameraState.NOT_INSHADOW
    wall = square(0, 9, -9, 9, 1)
    half = look([0, 0, 0], UP, light, geometry_of(wall), viewport=128, backend=backend)
    assert half.visible_share[0] == pytest.approx(0.5, abs=0.01)
    # A plate through the ball's middle, wider than it, hides nothing of the near side.
    plate = look([0, 0, 0], UP, light, geometry_of(square(-2, 2, -2, 2, 2.001)), viewport=64, backend=backend)
    assert plate.visible_share[0] == 1.0
    # One close before the ball's limb hides a little of it, and the far plane does not drop it.
    limb = geometry_of(square(0.4, 9, -9, 9, 1.75))
    shares = [look([0, 0, 0], UP, light, limb, mode=mode, backend=backend).visible_share[0] for mode in MODES]
    assert 0.9 < shares[0] == shares[1] < 1.0
    # Inside the ball all facets are seen from behind; a dome down to the horizon fits no viewport.
    assert look([0, 0, 2], UP, light, geometry_of(wall)).state[0] == CameraState.UNLIT
    dome = [facet[::-1] for facet in light]
    assert look([0, 0, 2], UP, dome, geometry_of(wall)).fallback[0]


@pytest.mark.parametrize("sides", [6, 8, 12, 16, 32, 64])
def test_6_12_a_low_poly_disc_casts_less_shadow(sides):
    def disc(n):
        angle = 2 * np.pi * np.arange(n) / n
        return geometry_of(np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]))

    right = sides / (2 * np.pi) * np.sin(2 * np.pi / sides)  # area of the n-gon over its circle's
    areas = [silhouette_areas(disc(n), [UP], viewport=512)[0] for n in (sides, 720)]
    assert areas[1] == pytest.approx(np.pi, rel=2e-3)
    assert areas[0] / areas[1] == pytest.approx(right, abs=2e-3)


def test_6_12_a_proxy_states_its_error():
    ball = trimesh.creation.icosphere(subdivisions=4)
    wall = square(-1, 1, -1, 1, 3)
    surfaces = (
        Surface.from_mesh("ball", BLACK, ball.vertices, ball.faces),
        Surface.from_polygons("wall", BLACK, [wall]),
    )
    geometry = Geometry.from_scene(Scene("test", surfaces))
    proxy = proxy_geometry(geometry, share=0.01, smallest=50, directions=8)
    assert proxy.geometry.surface_name == ("ball", "wall")
    assert (proxy.geometry.polygon_surface == 1).sum() == 1
    (error,) = proxy.errors
    assert error.surface == "ball" and error.faces == 5120 and 40 <= error.proxy_faces <= 60
    assert (proxy.geometry.polygon_surface == 0).sum() == error.proxy_faces
    # The true distances, from the unit sphere's own formula.
    triangles, piece = proxy.geometry.triangles
    corners = triangles[proxy.geometry.polygon_surface[proxy.geometry.piece_polygon[piece]] == 0]
    sample = np.einsum("kb,tbc->tkc", np.random.default_rng(0).dirichlet([1, 1, 1], 500), corners)
    depth = 1 - np.linalg.norm(sample, axis=-1).min()
    assert error.distance == pytest.approx(depth, rel=0.1)
    assert error.distance_back == pytest.approx(np.abs(1 - np.linalg.norm(corners, axis=-1)).max(), abs=2e-3)
    # What it says of the silhouettes is what the shadows then show.
    light = np.array([[-2, -2, 1e4], [-2, 2, 1e4], [2, 2, 1e4], [2, -2, 1e4]])
    exact, coarse = (
        1 - look([0, 0, -1e4], UP, light, each, viewport=512, ignore=[each.polygon_count - 1]).pixel_fraction[0]
        for each in (geometry, proxy.geometry)
    )
    assert exact * 16 / 4 == pytest.approx(np.pi, rel=0.005)
    assert error.silhouette.min() - 0.03 < coarse / exact < error.silhouette.max() + 0.03
    assert 0.85 < error.silhouette.mean() < 1.0
    whole = proxy_geometry(geometry, share=1.0, smallest=10000)
    assert whole.errors == () and whole.geometry.polygon_count == geometry.polygon_count


def random_case(seed):
    rng = np.random.default_rng(seed)
    polygons = list(rng.uniform(-1, 1, (5, 1, 3)) + rng.normal(0, 0.3, (5, 3, 3)) + [0, 0, 0.8])
    polygons += [square(-3, 3, -3, 3, 0), square(-0.4, 0.4, -0.3, 0.3, 0.6), square(-3, 3, -3, 3, 3.5)]
    points = np.column_stack([rng.uniform(-8, 8, (60, 2)), np.where(rng.random(60) < 0.7, 0, 0.1)])
    light = (
        LIGHT
        if seed % 2
        else [np.array([[-0.5, -0.5, 2], [-0.2, 0.6, 2], [0.5, 0.1, 2]]), square(0.6, 0.9, -0.5, 0.5, 1.9)[::-1]]
    )
    return points, light, geometry_of(*polygons)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("jitter", ["none", "rotate"])
def test_naive_and_optimised_cameras_agree_bit_for_bit(jitter, backend):
    renders = np.zeros(2)
    for seed in range(12):
        points, light, geometry = random_case(seed)
        naive, quick = (look(points, UP, light, geometry, mode=mode, jitter=jitter, backend=backend) for mode in MODES)
        assert np.array_equal(naive.visible_share, quick.visible_share, equal_nan=True)
        assert np.array_equal(naive.pixel_fraction, quick.pixel_fraction, equal_nan=True)
        assert (naive.visible_share[quick.state == CameraState.NOT_INSHADOW] == 1).all()
        assert (naive.visible_share[quick.state == CameraState.INSHADOW] == 0).all()
        renders += naive.counters["camera_renders"], quick.counters["camera_renders"]
    assert renders[1] < 0.7 * renders[0]


def test_a_convex_occluder_before_the_whole_light_is_known_dark():
    points = [[0, 0, 0], [0.6, 0, 0], [2, 0, 0]]
    for light in (LIGHT, list(trimesh.creation.icosphere(subdivisions=1, radius=0.4).triangles + [0, 0, 2])):
        seen = look(points, UP, light, geometry_of(square(-0.5, 0.5, -0.5, 0.5, 1)))
        assert seen.state.tolist() == [CameraState.INSHADOW, CameraState.RENDERED, CameraState.NOT_INSHADOW]
        assert seen.counters["inshadow"] == seen.counters["not_inshadow"] == seen.counters["complex_shadow"] + 1 == 1
    # A plate that covers the whole view but dives behind the light half way hides half of it.
    tilted = geometry_of([[-5, -5, 1], [5, -5, 3], [5, 5, 3], [-5, 5, 1]])
    half = look([0, 0, 0], UP, LIGHT, tilted)
    assert half.state[0] == CameraState.RENDERED and half.visible_share[0] == pytest.approx(0.5)


@pytest.mark.skipif(not has_gl(), reason="no OpenGL on EGL here")
@pytest.mark.parametrize("viewport", [4, 17, 32, 128])
def test_both_backends_agree_but_for_pixels_on_edges(viewport):
    for seed in range(4):
        points, light, geometry = random_case(seed)
        points = np.concatenate([points] * (5 if viewport == 128 else 1))  # 300 tiles: two atlases of 256
        soft, hard = (
            look(points, UP, light, geometry, viewport=viewport, jitter="rotate", seed=seed, backend=backend)
            for backend in ("software", "gl")
        )
        assert hard.backend.startswith("gl: ")
        most = max(2, 0.01 * viewport**2)
        # A sliver of a light may cover the centre of a pixel by one rounding and none by the other.
        sliver = np.maximum(soft.light_pixels, hard.light_pixels) <= most
        assert ((soft.state == hard.state) | sliver).all()
        assert np.abs(soft.light_pixels - hard.light_pixels).max() <= most
        assert np.abs(soft.visible_pixels - hard.visible_pixels).max() <= most
        # A pixel here and there: one of 16 is already 6 % of a picture, one of 1024 a thousandth.
        assert np.nanmean(np.abs(soft.pixel_fraction - hard.pixel_fraction)) < (0.001 if viewport > 4 else 0.01)


def test_answers_do_not_depend_on_the_workers_or_on_company():
    points, light, geometry = random_case(1)
    points = np.concatenate([points] * 10)
    one, two = (look(points, UP, light, geometry, jitter="rotate", seed=9, workers=count) for count in (1, 3))
    assert np.array_equal(one.visible_share, two.visible_share, equal_nan=True)
    assert dict(one.counters) == dict(two.counters)
    other = look(points, UP, light, geometry, jitter="rotate", seed=10)
    assert not np.array_equal(one.visible_share, other.visible_share, equal_nan=True)


def test_the_points_own_polygon_never_blocks():
    # The point lies a hair below its floor, as rounding leaves it.
    floor = square(-5, 5, -5, 5, 1e-6)
    assert look([0, 0, 0], UP, LIGHT, geometry_of(floor)).visible_share[0] == 0.0
    assert look([0, 0, 0], UP, LIGHT, geometry_of(floor), own_polygon=[0]).visible_share[0] == 1.0
    assert look([0, 0, 0], UP, LIGHT, geometry_of(square(-5, 5, -5, 5, 0))).visible_share[0] == 1.0


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_the_answer_does_not_depend_on_the_unit_of_length(scale):
    points, light, geometry = random_case(1)
    plain = look(points, UP, light, geometry)
    scaled = geometry_of(*(scale * geometry.piece(k) for k in range(geometry.piece_count)))
    again = look(scale * points, UP, scale * light, scaled)
    assert np.nanmax(np.abs(plain.visible_share - again.visible_share)) < 2 / 1024


def test_bad_input_is_refused_in_one_line():
    geometry = geometry_of(square(5, 6, 5, 6, 5))
    for error, wanted, options in (
        (OptionError, "viewport: found 1, expected 2", {"viewport": 1}),
        (OptionError, "mode: found 'fast', expected one of naive", {"mode": "fast"}),
        (OptionError, "jitter: found 'yes'", {"jitter": "yes"}),
        (OptionError, "backend: found 'cuda'", {"backend": "cuda"}),
        (OptionError, "conservative: found backend 'gl'", {"conservative": True, "backend": "gl"}),
        (InputError, "own_polygon: found shape (2,), expected (1,)", {"own_polygon": [0, 1]}),
    ):
        with pytest.raises(error, match=re.escape(wanted)):
            look([0, 0, 0], UP, LIGHT, geometry, **options)
    with pytest.raises(InputError, match="light: polygon 0: found a polygon of zero area"):
        look([0, 0, 0], UP, np.zeros((3, 3)), geometry)
    with pytest.raises(InputError, match=re.escape("light: expected an (n, 3) polygon or a list")):
        look([0, 0, 0], UP, [], geometry)
    with pytest.raises(InputError, match="normals: found 2 rows, expected 1"):
        camera_shadows([0, 0, 0], [UP, UP], LIGHT, geometry)
    glass = Material("glass", NOTHING, NOTHING, NOTHING, np.inf, np.full(3, 0.5))
    with pytest.raises(InputError, match="polygon 0 is transparent"):
        look([0, 0, 0], UP, LIGHT, geometry_of(square(-1, 1, -1, 1, 1), material=glass))
    empty = look([0, 0, 0], UP, LIGHT, geometry_of())
    assert empty.state[0] == CameraState.NOT_INSHADOW
    with pytest.raises(OptionError, match="share: found 0"):
        proxy_geometry(geometry, share=0)


def test_without_opengl_the_error_says_what_to_install(monkeypatch):
    def absent(name, *_):
        raise OSError(name)

    gl_rasteriser.gl_renderer.cache_clear()
    monkeypatch.setattr(ctypes, "CDLL", absent)
    try:
        with pytest.raises(MissingLibraryError, match="not found; use backend='software', or install Mesa"):
            look([0, 0, 0], UP, LIGHT, geometry_of(square(-1, 0, -1, 1, 1)), backend="gl")
        seen = look([0, 0, 0], UP, LIGHT, geometry_of(square(-1, 0, -1, 1, 1)), backend="auto")
        assert seen.backend == "software" and seen.visible_share[0] == pytest.approx(0.5)
    finally:
        gl_rasteriser.gl_renderer.cache_clear()
