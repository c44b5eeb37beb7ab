"""Directional bundles: their strata and planes, row sums, standard errors, and the instrument's law."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from radiosity_scenes import cube_with_emitter, each_truth, polygon_scene, standing_box, truth

import radiosity
import workbench
from radiosity.form_factors.bundle import LinkSettings
from radiosity.form_factors.directional import (
    DirectionalBundles,
    bundle_planes,
    bundle_rays,
    instrument_bundles,
    strata_of,
)
from radiosity.patches import build_mesh
from workbench.accel.brute import BruteForce
from workbench.accel.voxel_grid import VoxelGrid
from workbench.errors import OptionError
from workbench.geometry.flat import Geometry
from workbench.scene.library import box_surface, diffuse
from workbench.scene.model import Scene, Surface


def columns_of(scene, rays, *, seed=0, workers=2, **mesh_options):
    geometry = Geometry.from_scene(scene)
    mesh = build_mesh(scene, geometry, **({"split": 1} | mesh_options))
    bundles = DirectionalBundles(geometry, mesh, LinkSettings(rays=rays, seed=seed), workers)
    try:
        return bundles.columns(np.arange(mesh.patch_count)), mesh, bundles
    finally:
        bundles.close()


# ---- strata and planes


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), bundles=st.integers(1, 400))
def test_every_ray_lies_within_its_bundles_planes(seed, bundles):
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    quad = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float) @ turn
    scene = polygon_scene(quad)
    mesh = build_mesh(scene, Geometry.from_scene(scene))
    made = bundle_rays(mesh, 0, bundles=bundles, rays=16, seed=seed % 1000)
    assert len(made.origins) == made.rings * made.sectors
    for b in range(len(made.origins)):
        planes = bundle_planes(b // made.sectors, b % made.sectors, made.rings, made.sectors, made.normals[b])
        assert (made.directions[b] @ planes[:, :3].T).max() < 1e-12
    assert np.linalg.norm(made.directions, axis=2) == pytest.approx(1)


def test_the_planes_leave_out_most_of_the_other_strata():
    rings, sectors = strata_of(200)
    scene = polygon_scene(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float))
    made = bundle_rays(build_mesh(scene, Geometry.from_scene(scene)), 0, bundles=200, rays=8)
    inside = np.zeros((rings * sectors, rings * sectors))
    for b in range(len(inside)):
        planes = bundle_planes(b // sectors, b % sectors, rings, sectors, made.normals[b])
        inside[b] = ((made.directions @ planes[:, :3].T) < 1e-12).all(axis=2).mean(axis=1)
    assert (np.diag(inside) == 1).all()
    # Beside its own, a pyramid holds the corners of its neighbours' strata only.
    assert inside.sum(axis=1).mean() < 1.8


def test_strata_hold_equal_cosine_weighted_shares():
    scene = polygon_scene(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float))
    mesh = build_mesh(scene, Geometry.from_scene(scene))
    made = bundle_rays(mesh, 0, bundles=4096, rays=1)
    cosine = made.directions[:, 0, 2]
    # Density cos / pi: the mean cosine is 2/3, that of its square 1/2; strata make it far better than noise.
    assert cosine.mean() == pytest.approx(2 / 3, abs=2e-3)
    assert (cosine**2).mean() == pytest.approx(1 / 2, abs=2e-3)
    assert made.origins[:, :2].mean(axis=0) == pytest.approx([0.5, 0.5], abs=5e-3)


def test_two_rays_of_a_bundle_share_one_point():
    # Failure mode 1.9: planes through one point are wrong for rays from another.
    scene = polygon_scene(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float))
    made = bundle_rays(build_mesh(scene, Geometry.from_scene(scene)), 0, bundles=64)
    assert made.origins.shape == (len(made.directions), 3) and len(np.unique(made.origins, axis=0)) == len(made.origins)


# ---- the engine


@pytest.mark.parametrize("scene", [cube_with_emitter(0.5, 0.5), standing_box(bottom=False)], ids=lambda s: s.name)
def test_rows_of_closed_scenes_sum_to_one_exactly(scene):
    columns, mesh, bundles = columns_of(scene, 64, max_edge=0.5)
    sums = columns.factor @ mesh.element_area / mesh.patch_area
    # Floor that the box covers shoots into it from below, and is lost on its black backs; nothing else is.
    floor = (mesh.element_normal[:, 2] > 0.5) & (mesh.element_centroid[:, 2] < 1e-9) & (scene.name != "cube")
    assert np.abs(sums[~floor] - 1).max() < 1e-12
    assert sums.max() < 1 + 1e-12
    assert bundles.counters["bundles"] > 0 and bundles.counters["rays"] >= 8 * bundles.counters["bundles"]


def z_values(columns, wanted):
    z = (columns.factor - wanted) / np.where(columns.spread > 0, columns.spread, 1.0)
    return z[(columns.spread > 0) & (wanted > 0)]


@each_truth("occ/L-room/")
def test_l_room_within_four_standard_errors(name):
    wanted = np.array(truth(name)["value"]).T
    columns, _, _ = columns_of(workbench.load("l-room"), 4000)
    assert np.abs(z_values(columns, wanted)).max() < 4
    assert (columns.factor[wanted == 0] == 0).all()


def test_the_standard_error_is_one():
    # Many seeds: z has the spread of Student's t with 15 degrees of freedom, root mean square 1.07.
    wanted = 0.2 * np.ones((6, 6))
    side, opposite = 0.20004377607540316, 0.19982489569838746  # Howell C-14, C-11
    wanted[:] = side
    cube = cube_with_emitter(0.5, 0.5)
    values = []
    for seed in range(40):
        columns, mesh, _ = columns_of(cube, 400, seed=seed)
        normal = mesh.element_normal
        target = np.where(normal @ normal.T < -0.5, opposite, np.where(normal @ normal.T > 0.5, 0.0, side))
        values.append(z_values(columns, target))
    z = np.concatenate(values)
    assert 0.85 < np.sqrt((z**2).mean()) < 1.3
    assert abs(z.mean()) < 5 / np.sqrt(len(z))
    assert (np.abs(z) > 4).mean() < 0.01


def test_error_falls_faster_than_noise():
    # Quasi-random strata: from N to 16 N rays plain noise would fall by 4.
    room = workbench.load("l-room")
    exact = radiosity.view_factors(room, error=1e-5).dense().T
    errors = [
        np.mean([np.abs(columns_of(room, rays, seed=seed)[0].factor - exact).mean() for seed in range(4)])
        for rays in (512, 8192)
    ]
    assert errors[1] < errors[0] / 5


def test_both_sides_of_a_sheet_receive():
    two = diffuse("two", 0.5)
    sheet = Surface.from_polygons(
        "sheet",
        type(two)(**{**two.__dict__, "two_sided": True}),
        [np.array([[0.2, 0.2, 0.5], [0.8, 0.2, 0.5], [0.8, 0.8, 0.5], [0.2, 0.8, 0.5]])],
    )
    room = box_surface("room", diffuse("wall", 0.5), [0, 0, 0], [1, 1, 1], inward=True)
    scene = Scene("sheet in a room", (room, sheet), bands=1, closed=True)
    columns, mesh, _ = columns_of(scene, 600, max_edge=0.4)
    assert np.abs(columns.factor @ mesh.element_area / mesh.patch_area - 1).max() < 1e-12
    exact = radiosity.view_factors(scene, max_edge=0.4, error=1e-3).dense().T
    assert np.abs(columns.factor - exact).max() < 0.02
    upper, lower = (np.flatnonzero((mesh.element_surface == 1) & (mesh.element_side == side)) for side in (1, -1))
    assert len(upper) == len(lower) > 0 and (columns.factor[np.ix_(upper, lower)] == 0).all()


def test_workers_and_batches_change_nothing():
    cube = cube_with_emitter(0.5, 0.5)
    one, _, _ = columns_of(cube, 64, workers=1, max_edge=0.5)
    two, _, _ = columns_of(cube, 64, workers=2, max_edge=0.5)
    assert (one.factor == two.factor).all() and (one.spread == two.spread).all()


@pytest.mark.parametrize("method", ["progressive", "direct"])
def test_both_solvers_take_them(method):
    cube = cube_with_emitter(0.5, 0.5)
    exact = radiosity.solve(cube, elements=24, method=method)
    found = radiosity.solve(cube, elements=24, method=method, bundles="directional", rays=256)
    mean = float(exact.element_irradiance.mean())
    assert np.sqrt(((found.element_irradiance - exact.element_irradiance) ** 2).mean()) < 0.03 * mean
    assert found.record.counters["bundles"] > 0 and found.record.settings["bundles"] == "directional"
    assert found.book.imbalance(found.unshot_power) < 1e-12


def test_an_unknown_kind_is_refused():
    with pytest.raises(OptionError, match="bundles"):
        radiosity.solve(cube_with_emitter(0.5, 0.5), elements=6, bundles="sideways")
    with pytest.raises(OptionError, match="hierarchical"):
        radiosity.solve(cube_with_emitter(0.5, 0.5), elements=6, bundles="directional", method="hierarchical")


# ---- the instrument: the check changes counts, never hits


def random_scene(rng):
    polygons = [np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)]
    for _ in range(rng.integers(5, 40)):
        centre, size = rng.uniform([-1, -1, -0.2], [2, 2, 2]), rng.uniform(0.02, 0.8)
        polygons.append(centre + size * rng.normal(size=(3, 3)))
    return polygon_scene(*polygons)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_check_drops_no_polygon_that_a_ray_meets(seed):
    rng = np.random.default_rng(seed)
    scene = random_scene(rng)
    geometry = Geometry.from_scene(scene)
    made = bundle_rays(build_mesh(scene, geometry), 0, bundles=40, seed=seed % 1000)
    grid = VoxelGrid(geometry)
    plain = instrument_bundles(grid, made, 0, check=False)
    checked = instrument_bundles(grid, made, 0)
    assert (plain.hits.polygon == checked.hits.polygon).all() and (plain.hits.t == checked.hits.t).all()
    assert plain.counters["plane_vertex_checks"] == 0
    done, avoided = checked.counters["polygon_tests"], checked.counters["tests_avoided"]
    assert done <= plain.counters["polygon_tests"] <= done + avoided
    # Brute force judges both.
    origins = np.repeat(made.origins, made.directions.shape[1], axis=0)
    brute = BruteForce(geometry).closest_hit(origins, made.directions.reshape(-1, 3), np.inf, [[0, -1]])
    assert (brute.polygon == checked.hits.polygon.ravel()).all()


def test_the_check_saves_tests_in_the_office():
    office = workbench.load("office")
    geometry = Geometry.from_scene(office)
    mesh = build_mesh(office, geometry)
    grid = VoxelGrid(geometry)
    made = bundle_rays(mesh, 0, bundles=256, rays=16)
    own = int(mesh.patch_polygon[0])
    plain, checked = (instrument_bundles(grid, made, own, check=check).counters for check in (False, True))
    assert checked["polygon_tests"] < 0.8 * plain["polygon_tests"]
    assert checked["plane_vertex_culls"] > 0 and checked["bundles"] == len(made.origins)
