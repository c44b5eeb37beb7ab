"""One ray a pixel in two passes a row, with the plane-vertex check of the row (Woo 1993)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from instrument_scenes import nasty_polygons
from trace_scenes import floor, look_down, material, scene, sun

from workbench.accel.brute import BruteForce
from workbench.accel.voxel_grid import RayIDs, VoxelGrid
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.render.adaptive import aliased
from workbench.render.camera import PinholeRays
from workbench.render.pictures import PICTURES, test_picture
from workbench.render.rows import cast_rows, picture_by_rows
from workbench.render.trace import TraceOptions, Tracer
from workbench.scene.model import Camera, Scene, Surface


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 30), fov=st.sampled_from([5.0, 40.0, 120.0]))
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_no_row_loses_a_polygon_that_a_ray_meets(seed, count, fov):
    """The law of cullers, over slivers, coplanar, touching, straddling and far polygons, and eyes on them."""
    rng = np.random.default_rng(seed)
    polygons = nasty_polygons(rng, count, rng.uniform(-1, 1, (3, 3)))
    whole = scene([Surface.from_polygons("all", material("all", 0.5), polygons)])
    grid = VoxelGrid(Geometry.from_scene(whole))
    eye = polygons[0].mean(axis=0) if rng.random() < 0.2 else rng.uniform(-2, 2, 3)
    camera = Camera(eye, eye + rng.normal(size=3), rng.normal(size=3), fov, 9, 7)
    rays = PinholeRays.from_camera(camera)
    along = rays.row_directions(0, 7)
    single = BruteForce(grid.geometry).closest_hit(eye, along)
    plain, checked = (cast_rows(grid, eye, along.reshape(7, 9, 3), check=check) for check in (False, True))
    for found in (plain, checked):
        np.testing.assert_array_equal(found.hits.t.ravel(), single.t)
        np.testing.assert_array_equal(found.hits.polygon.ravel(), single.polygon)
    before, after = plain.counters, checked.counters
    assert after["polygon_tests"] + after["tests_avoided"] == before["polygon_tests"]
    assert after["voxels_stepped"] == before["voxels_stepped"]
    assert after["plane_vertex_checks"] >= after["plane_vertex_culls"]
    assert before["plane_vertex_checks"] == before["tests_avoided"] == 0


@pytest.mark.parametrize("name", PICTURES)
def test_picture_is_the_same_bit_for_bit_and_that_of_the_plain_loop(name):
    tracer = test_picture(name, 64, 48).tracer()
    grid = VoxelGrid(tracer.geometry)
    checked = picture_by_rows(tracer, grid=grid)
    plain = picture_by_rows(tracer, check=False, rows=20, grid=grid)
    np.testing.assert_array_equal(checked.picture.radiance, plain.picture.radiance)
    assert checked.picture.tally == plain.picture.tally
    assert checked.counters["tests_avoided"] > 0.3 * plain.counters["polygon_tests"]
    assert checked.counters["polygon_tests"] + checked.counters["tests_avoided"] == plain.counters["polygon_tests"]
    # Embree rounds to single precision: at an edge it may take the polygon beside.
    usual = aliased(tracer)
    same = (usual.radiance == checked.picture.radiance).all(axis=2)
    assert same.mean() > 0.99
    assert usual.tally.cast.shot == checked.picture.tally.cast.shot == 64 * 48
    assert checked.counters["rays"] == 64 * 48


def test_rays_led_past_backs_and_rays_that_meet_nothing():
    lid = Surface.from_polygons("lid", material("lid", 0.5, two_sided=False), [np.array(
        [[-9, -9, 3.0], [-9, 9, 3], [9, 9, 3], [9, -9, 3]])])  # fmt: skip
    parts = scene([floor(1.0), lid], [sun()], look_down(9, 0.3), background=0.25)
    tracer = Tracer(parts, TraceOptions(see_backs=False))
    found, usual = picture_by_rows(tracer).picture, aliased(tracer)
    np.testing.assert_array_equal(found.radiance, usual.radiance)
    assert (found.radiance == 0.25).any() and found.tally.cast_hits == usual.tally.cast_hits == 9


def test_ids_that_run_out_begin_again():
    tracer = test_picture("tori", 16, 12).tracer()
    grid = VoxelGrid(tracer.geometry)
    rays = PinholeRays.from_camera(tracer.scene.camera)
    along = rays.row_directions(0, 12).reshape(12, 16, 3)
    ids = RayIDs(grid.object_count, first=30, limit=40)
    found, fresh = cast_rows(grid, rays.eye, along, ids=ids), cast_rows(grid, rays.eye, along)
    np.testing.assert_array_equal(found.hits.polygon, fresh.hits.polygon)
    assert ids.current <= 41
    with pytest.raises(InputError, match="rayID"):
        cast_rows(grid, rays.eye, along, ids=RayIDs(grid.object_count, limit=16))


def test_one_column_and_wrong_arguments():
    tracer = Tracer(
        scene([floor()], [sun()], Camera(np.array([0, 0, 5.0]), np.zeros(3), np.array([0, 1.0, 0]), 40.0, 1, 3))
    )
    np.testing.assert_array_equal(picture_by_rows(tracer).picture.radiance, aliased(tracer).radiance)
    with pytest.raises(OptionError, match="rows"):
        picture_by_rows(tracer, rows=0)
    with pytest.raises(InputError, match="camera"):
        picture_by_rows(Tracer(scene([floor()])))
    other = VoxelGrid(Geometry.from_scene(Scene("other", (floor(), Surface.from_polygons("b", material(), [
        np.array([[0, 0, 1.0], [1, 0, 1], [0, 1, 1]])])), bands=1)))  # fmt: skip
    with pytest.raises(InputError, match="grid"):
        picture_by_rows(tracer, grid=other)
