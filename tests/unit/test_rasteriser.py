"""The rasteriser: every pixel once, the same pixels as rays would block, whatever the viewport."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh

from workbench.geometry.flat import Geometry
from workbench.scene.model import Material, Scene, Surface
from workbench.shadow import rasteriser
from workbench.shadow.hardware_camera import CameraState, camera_shadows

NOTHING = np.zeros(3)
BLACK = Material("black", NOTHING, NOTHING, NOTHING, np.inf, NOTHING)
LIGHT = np.array([[-0.5, -0.5, 2], [-0.5, 0.5, 2], [0.5, 0.5, 2], [0.5, -0.5, 2]])
UP = [0.0, 0.0, 1.0]


def geometry_of(polygons) -> Geometry:
    return Geometry.from_scene(Scene("test", (Surface.from_polygons("all", BLACK, list(polygons)),)))


def blocked_pixels(polygons, viewport, point=(0, 0, 0), **options) -> int:
    seen = camera_shadows([point], [UP], LIGHT, geometry_of(polygons), viewport=viewport, mode="naive", **options)
    return int(seen.light_pixels[0] - seen.visible_pixels[0])


def rays_blocked(point, targets, triangles) -> np.ndarray:
    """Whether the segment from the point to each target meets a triangle: plain Moeller-Trumbore."""
    blocked = np.zeros(len(targets), bool)
    way = targets - point
    for a, b, c in triangles:
        ab, ac = b - a, c - a
        p = np.cross(way, ac)
        det = p @ ab
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (p @ (point - a)) / det
            q = np.cross(point - a, ab)
            v = way @ q / det
            t = (q @ ac) / det
        blocked |= (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < rasteriser.FAR)
    return blocked


@pytest.mark.parametrize("viewport", [4, 8, 32])
def test_triangles_that_share_edges_cover_each_pixel_once(viewport):
    # Vertices lie on pixel centres (halved: the mesh is half way up), so that every edge of the
    # grid and every diagonal runs exactly through centres; all coordinates are dyadic.
    centre = ((np.arange(viewport) + 0.5) / viewport - 0.5) / 2
    triangles = []
    for x0, x1 in itertools.pairwise(centre):
        for y0, y1 in itertools.pairwise(centre):
            a, b, c, d = (np.array([x, y, 1.0]) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1)))
            triangles += (
                [np.stack([a, b, c]), np.stack([a, c, d])] if x0 < 0 else [np.stack([a, b, d]), np.stack([b, c, d])]
            )
    each = sum(blocked_pixels([triangle], viewport) for triangle in triangles)
    assert each == blocked_pixels(triangles, viewport) == (viewport - 1) ** 2


@pytest.mark.parametrize("jitter", ["none", "rotate"])
def test_a_random_mesh_neither_leaks_nor_overlaps(jitter):
    rng = np.random.default_rng(5)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    inner = rng.uniform(-0.5, 0.5, (40, 2))
    from scipy.spatial import Delaunay

    flat = np.concatenate([corners, inner])
    # The vertices wander up and down: the silhouette is the outer square's, far outside the light.
    height = np.concatenate([np.ones(4), rng.uniform(0.9, 1.1, 40)])
    vertices = np.column_stack([flat * height[:, None], height])
    triangles = list(vertices[Delaunay(flat).simplices])
    each = [blocked_pixels([triangle], 32, jitter=jitter, seed=3) for triangle in triangles]
    whole = camera_shadows([[0, 0, 0]], [UP], LIGHT, geometry_of(triangles), jitter=jitter, seed=3)
    assert sum(each) == whole.light_pixels[0]
    assert whole.visible_pixels[0] == 0


@pytest.mark.parametrize("seed", range(12))
def test_blocked_pixels_are_those_that_rays_find_blocked(seed):
    rng = np.random.default_rng(seed)
    triangles = rng.uniform([-1.5, -1.5, -1.0], [1.5, 1.5, 3.0], (6, 1, 3)) + rng.normal(0, 0.7, (6, 3, 3))
    corner, u, v = np.array([-0.5, -0.4, 2.0]), np.array([0.3, 1.1, 0.2]), np.array([1.2, 0.1, -0.3])
    light = np.stack([corner, corner + u, corner + u + v, corner + v])
    points = rng.uniform([-1, -1, -0.2], [1, 1, 0.2], (5, 3))
    seen = camera_shadows(points, [[0, 0, 1.0]] * 5, light, geometry_of(triangles), viewport=16, backend="software")
    middle = (np.arange(16) + 0.5) / 16
    x, y = (each.reshape(-1, 1) for each in np.meshgrid(middle, middle))
    targets = corner + x * u + y * v
    for k, point in enumerate(points):
        blocked = rays_blocked(point, targets, triangles)
        assert round(256 * (1 - seen.pixel_fraction[k])) == blocked.sum()
        way = targets - point
        square = (way * way).sum(axis=1)
        weight = way[:, 2] * np.abs(way @ np.cross(u, v)) / square**2
        assert seen.visible_share[k] == pytest.approx(weight[~blocked].sum() / weight.sum(), abs=1e-12)


def test_a_parallelogram_fills_its_viewport_from_anywhere():
    rng = np.random.default_rng(2)
    light = np.array([[0, 0, 0], [1, 0.2, 0.1], [1.3, 1.0, 0.4], [0.3, 0.8, 0.3]])
    normal = np.cross(light[1] - light[0], light[3] - light[0])
    points = rng.normal(0, 3, (300, 3))
    points = points[(points - light[0]) @ normal > 0.3]
    # Each point looks straight at the middle of the light, so that no part lies below its horizon.
    seen = camera_shadows(points, light.mean(axis=0) - points, light, two_triangles(), viewport=17, mode="naive")
    assert (seen.state == CameraState.RENDERED).all()
    assert (seen.light_pixels == 17 * 17).all()


def two_triangles() -> Geometry:
    return geometry_of(
        [np.array([[9.0, 9, 9], [9, 10, 9], [10, 9, 9]]), np.array([[9.0, 9, 8], [9, 10, 8], [10, 9, 8]])]
    )


def test_polygons_that_reach_behind_the_point_are_drawn_whole():
    # A wall x = 0.1 from far behind the point to far above it hides the light's part x > 0.1.
    wall = np.array([[0.1, -50, -50], [0.1, 50, -50], [0.1, 50, 50], [0.1, -50, 50]])
    assert blocked_pixels([wall], 20) == 20 * 8
    assert blocked_pixels([wall[::-1]], 20) == 20 * 8


def test_conservative_drawing_touches_every_pixel_that_a_polygon_meets():
    rng = np.random.default_rng(0)
    for _ in range(20):
        triangle = np.column_stack([rng.uniform(-0.25, 0.25, (3, 2)), np.ones(3)])
        seen = camera_shadows([[0, 0, 0]], [UP], LIGHT, geometry_of([triangle]), viewport=8, conservative=True)
        # A dense sample of the triangle, projected to the light: all its pixels must be touched.
        share = rng.dirichlet([1, 1, 1], 20000)
        met = np.unique(np.floor((2 * (share @ triangle)[:, :2] + 0.5) * 8), axis=0)
        touched = round(64 * (1 - seen.untouched_fraction[0]))
        assert len(met) <= touched <= 64
        area = 0.5 * abs(np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])[2]) * 4
        assert 1 - seen.untouched_fraction[0] >= area
        assert seen.untouched_fraction[0] <= seen.pixel_fraction[0]


def test_counts_are_those_of_the_work_done():
    near = np.array([[-0.1, -0.1, 1], [0.1, -0.1, 1], [0.1, 0.1, 1], [-0.1, 0.1, 1]])
    geometry = geometry_of([near, near + [5, 0, 0], near + [0, 0, 2]])
    points = [[0, 0, 0], [3, 0, 0]]
    naive = camera_shadows(points, [UP] * 2, LIGHT, geometry, mode="naive")
    assert naive.counters["camera_renders"] == 2
    assert naive.counters["camera_polygons"] == 6
    assert naive.counters["box_tests"] == 0
    quick = camera_shadows(points, [UP] * 2, LIGHT, geometry)
    assert quick.counters["camera_renders"] == 1
    assert quick.counters["not_inshadow"] == 1
    assert quick.counters["camera_polygons"] == 1


def test_distance_to_the_viewport_is_the_distance_to_a_parallelogram():
    rng = np.random.default_rng(4)
    a, b = (each.ravel() for each in np.meshgrid(np.linspace(0, 1, 201), np.linspace(0, 1, 201)))
    for _ in range(20):
        frame = rng.normal(size=(3, 3))
        dense = np.linalg.norm(frame[0] + np.outer(a, frame[1]) + np.outer(b, frame[2]), axis=1).min()
        found = rasteriser._distance_to_frame(frame)
        assert found == pytest.approx(rasteriser._distance_to_frame.py_func(frame), rel=1e-12)
        assert dense - 0.02 <= found <= dense + 1e-12


def test_a_closed_mesh_around_the_point_lets_nothing_through():
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    geometry = Geometry.from_scene(Scene("s", (Surface.from_mesh("s", BLACK, sphere.vertices, sphere.faces),)))
    points = np.random.default_rng(1).uniform(-0.15, 0.15, (200, 3))
    seen = camera_shadows(points, [UP] * 200, LIGHT, geometry, jitter="rotate", viewport=16)
    assert (seen.visible_share == 0).all()
