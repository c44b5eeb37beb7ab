"""Irradiance at points: exact direct light, gathered indirect light, honest errors, the same for any workers."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from radiosity_scenes import cube_with_emitter

import radiosity
import workbench
from radiosity.sensors import MOST_RAYS, Gatherer, allotted
from workbench.errors import InputError, OptionError
from workbench.scene.library import box_surface, diffuse, unit_cube
from workbench.scene.model import Scene, Surface


@pytest.fixture(scope="module")
def cornell():
    """The Cornell box, coarsely solved, and sensors on its surfaces and in its air."""
    solution = radiosity.solve(workbench.load("cornell-box"), elements=400, tolerance=0.02, workers=1)
    mesh = solution.mesh
    rng = np.random.default_rng(5)
    element = rng.choice(mesh.element_count, 60, p=mesh.element_area / mesh.element_area.sum())
    air = rng.uniform([0.05, 0.35, 0.05], [0.5, 0.5, 0.5], (20, 3))
    normal = rng.normal(size=(20, 3))
    points = np.concatenate([mesh.element_centroid[element], air])
    normals = np.concatenate([mesh.element_normal[element], normal / np.linalg.norm(normal, axis=1)[:, None]])
    own = np.concatenate([mesh.element_polygon[element], np.full(20, -1)])
    return solution, points, normals, own


def test_furnace_is_constant_at_every_point():
    # With radiosity 1 / (1 - rho) = 2 all round, a closed furnace gives E = 2 anywhere in any direction.
    solution = radiosity.solve(unit_cube(0.5, 1.0), elements=24, tolerance=1e-6, workers=1)
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(0.02, 0.98, (50, 3)), rng.normal(size=(50, 3))
    found = solution.irradiance(points, normals, workers=1)
    assert np.abs(found.irradiance / 2.0 - 1).max() < 1e-4
    assert np.abs(found.direct - 1.0).max() < 1e-6  # the emission itself, in closed form


def test_black_scene_has_direct_light_only():
    scene = cube_with_emitter(0.0, 0.0)
    solution = radiosity.solve(scene, elements=24, workers=1)
    found = solution.irradiance([[0.5, 0.5, 0.5]], [[0, 0, -1]], workers=1)
    assert found.method == "none" and not found.indirect.any()
    # Lambert over the unit square from half its side above the middle: 0.5541264 (the hemicube's top).
    assert found.irradiance[0, 0] == pytest.approx(0.55412642398, abs=1e-9)


def test_bundles_tell_their_error(cornell):
    solution, points, normals, own = cornell
    gatherer = Gatherer(solution, workers=1)
    truth = np.mean(
        [Gatherer(solution, workers=1, seed=s).irradiance(points, normals, own_polygon=own, rays=4096).indirect
         for s in (11, 12, 13)], axis=0,
    )  # fmt: skip
    for rays in (32, 256):
        found = gatherer.irradiance(points, normals, own_polygon=own, rays=rays)
        z = (found.indirect - truth) / found.standard_error
        assert 0.5 < np.sqrt((z**2).mean()) < 1.4
        assert np.mean(np.abs(z) > 3) < 0.03


def test_asked_error_is_kept_and_rays_grow_with_it(cornell):
    solution, points, normals, own = cornell
    gatherer = Gatherer(solution, workers=1)
    truth = gatherer.irradiance(points, normals, own_polygon=own, rays=8192)
    before = 0
    for error in (0.05, 0.01, 0.003):
        found = Gatherer(solution, workers=1, seed=3).irradiance(points, normals, own_polygon=own, error=error)
        off = np.sqrt(((found.irradiance - truth.irradiance) ** 2).mean(axis=0)) / truth.irradiance.mean(axis=0)
        assert off.max() < 1.2 * error
        assert found.counters["rays"] > before
        before = found.counters["rays"]


def test_one_point_gets_rays_until_its_error_is_met(cornell):
    solution, points, normals, own = cornell
    truth = Gatherer(solution, workers=1).irradiance(points[:24], normals[:24], own_polygon=own[:24], rays=16384)
    off = []
    for i in range(24):
        gatherer = Gatherer(solution, workers=1, seed=5 + i)
        found = gatherer.irradiance(points[i : i + 1], normals[i : i + 1], own_polygon=own[i : i + 1], error=0.005)
        assert found.reached
        assert (found.standard_error <= 0.005 * found.irradiance).all()
        off.append((found.irradiance - truth.irradiance[i]) / truth.irradiance[i])
    # Each point alone: so are the errors of all together, whose truth has an error of its own.
    assert np.sqrt(np.mean(np.square(off))) < 1.3 * 0.005


def test_too_few_rays_are_said(cornell, monkeypatch):
    solution, points, normals, own = cornell
    monkeypatch.setattr("radiosity.sensors.MOST_RAYS", 64)
    found = Gatherer(solution, workers=1).irradiance(points, normals, own_polygon=own, error=1e-3)
    assert not found.reached
    assert found.standard_error.max() > 1e-3 * found.irradiance.mean()


@given(
    st.lists(st.just(0.0) | st.floats(0.1, 1e3), min_size=1, max_size=30),
    st.lists(st.sampled_from([16, 64, 1024]), min_size=30, max_size=30),
    st.floats(1e-4, 10.0),
)
def test_rays_areallotted_as_the_error_allows(spread, counts, allowed):
    variance, count = np.square(spread)[:, None], np.array(counts[: len(spread)])
    rays = allotted(variance, count, np.array([allowed]))
    assert ((rays >= count) & (rays & (rays - 1) == 0)).all()
    foretold = (variance[:, 0] * (count / rays) ** 1.5).mean()
    assert foretold <= allowed * (1 + 1e-9) or (rays[np.array(spread) > 0] == MOST_RAYS).all()
    if rays.sum() > count.sum():  # no more than needed: half of them all would be too few
        half = np.maximum(rays // 2, count)
        assert (variance[:, 0] * (count / half) ** 1.5).mean() > 0.9 * allowed


def test_answer_does_not_depend_on_workers(cornell):
    solution, points, normals, own = cornell
    one = Gatherer(solution, workers=1).irradiance(points, normals, own_polygon=own, rays=512)
    four = Gatherer(solution, workers=4).irradiance(points, normals, own_polygon=own, rays=512)
    assert np.array_equal(one.irradiance, four.irradiance)
    assert np.array_equal(one.standard_error, four.standard_error)


def test_distance_is_the_harmonic_mean():
    # From the middle of a sphere-like cube of side 2: between 1 (faces) and sqrt 3 (corners).
    solution = radiosity.solve(unit_cube(0.5, 1.0), elements=6, workers=1)
    found = solution.irradiance([[0.5, 0.5, 0.5], [0.5, 0.5, 0.01]], [[0, 0, 1], [1, 0, 0]], workers=1, rays=256)
    assert 0.5 < found.distance[0] < 0.5 * np.sqrt(3)
    assert found.distance[1] < 0.1  # close above the floor


def test_panes_dim_what_lies_behind_them():
    # A black lid that emits above a pane of transmittance 0.3, above a grey floor: the pane dims direct light, and
    # indirect light on its way up and down.
    def room(transmittance):
        pane = diffuse("pane", 0.0)
        pane = type(pane)(**{**pane.__dict__, "transmittance": np.array([transmittance]), "two_sided": True})
        square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        surfaces = (
            Surface.from_polygons("lamp", diffuse("lamp", 0.0, 1.0), [square[::-1] + [0, 0, 1]]),
            Surface.from_polygons("floor", diffuse("floor", 0.5), [square]),
            Surface.from_polygons("pane", pane, [square + [0, 0, 0.5]]),
        )
        return Scene("pane", surfaces, bands=1)

    solution = radiosity.solve(room(0.3), elements=100, workers=1)
    points, normals = np.array([[0.5, 0.5, 0.9], [0.5, 0.5, 0.01]]), np.array([[0, 0, -1.0], [0, 0, 1.0]])
    found = solution.irradiance(points, normals, workers=1, rays=4096)
    from radiosity.form_factors.analytic import point_to_polygon

    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    mesh = solution.mesh
    floor = np.flatnonzero(mesh.element_surface == 1)
    sent = sum(
        solution.radiosity[e, 0] * point_to_polygon(points[:1], normals[:1], mesh.corners[4 * e : 4 * e + 4])[0]
        for e in floor.tolist()
    )
    assert (np.diff(mesh.piece_start) == 4).all()
    assert len(floor) > 20
    seen_whole = point_to_polygon(points[:1], normals[:1], square)[0]
    seen_by_pane = point_to_polygon(points[:1], normals[:1], square + [0, 0, 0.5])[0]
    # Every line from the point to the floor goes through the pane, for the pane covers the floor.
    assert seen_by_pane > seen_whole
    assert found.indirect[0, 0] == pytest.approx(0.3 * sent, rel=0.01)
    assert found.direct[1, 0] == pytest.approx(0.3 * point_to_polygon(points[1:], normals[1:], square + [0, 0, 1])[0])


def test_the_back_of_a_one_sided_surface_is_black_and_blocks():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    lamp = Surface.from_polygons("lamp", diffuse("lamp", 0.0, 1.0), [square[::-1] + [0, 0, 2.0]])
    floor = Surface.from_polygons("floor", diffuse("floor", 0.5), [square])
    shelf = Surface.from_polygons("shelf", diffuse("shelf", 0.9), [square + [0, 0, 1.0]])
    solution = radiosity.solve(Scene("shelf", (lamp, floor, shelf), bands=1), elements=30, workers=1)
    below = solution.irradiance([[0.5, 0.5, 0.9]], [[0, 0, 1]], workers=1, rays=256)
    above = solution.irradiance([[0.5, 0.5, 1.9]], [[0, 0, -1]], workers=1, rays=256)
    assert below.irradiance[0, 0] == 0.0
    assert above.indirect[0, 0] > 0.0


def test_emission_of_a_mesh_of_many_facets_is_counted_once():
    # A lamp of 200 facets is gathered, not asked facet by facet; it must equal one polygon of the same shape.
    square = np.array([[0.2, 0.2, 1.0], [0.2, 0.8, 1.0], [0.8, 0.8, 1.0], [0.8, 0.2, 1.0]])
    steps = np.linspace(0.2, 0.8, 11)
    quads = [
        np.array([[a, c, 1.0], [a, d, 1.0], [b, d, 1.0], [b, c, 1.0]])
        for a, b in itertools.pairwise(steps)
        for c, d in itertools.pairwise(steps)
    ]
    lamp = diffuse("lamp", 0.0, 1.0)
    room = box_surface("room", diffuse("wall", 0.5), [0, 0, 0], [1, 1, 1], inward=True, omit=["+z"])
    one = Scene("one", (room, Surface.from_polygons("lamp", lamp, [square])), bands=1)
    many = Scene("many", (room, Surface.from_polygons("lamp", lamp, quads)), bands=1)
    point, normal = [[0.5, 0.5, 0.0]], [[0, 0, 1]]
    values = []
    for scene in (one, many):
        solution = radiosity.solve(scene, elements=300, workers=1, tolerance=1e-3)
        values.append(solution.irradiance(point, normal, own_polygon=0, workers=1, rays=4096))
    assert not values[1].direct.any()
    assert values[1].irradiance[0, 0] == pytest.approx(values[0].irradiance[0, 0], rel=0.01)


def test_bad_questions_are_refused(cornell):
    solution = cornell[0]
    gatherer = Gatherer(solution, workers=1)
    with pytest.raises(InputError, match="points: found none"):
        gatherer.irradiance(np.empty((0, 3)), np.empty((0, 3)))
    with pytest.raises(InputError, match="normals: found 2 rows for 3 points"):
        gatherer.irradiance(np.zeros((3, 3)), np.ones((2, 3)))
    with pytest.raises(OptionError, match="error: found 0"):
        gatherer.irradiance([[0, 0, 0]], [[0, 0, 1]], error=0)
    with pytest.raises(OptionError, match="rays: found 0"):
        gatherer.irradiance([[0, 0, 0]], [[0, 0, 1]], rays=0)


def test_hits_on_elements_that_are_coarse_for_their_distance_are_gathered_again():
    # Along the edges of the cube a ray's hit lies on an element far larger than its distance; there the mean of
    # the element says little.  Truth: the same cube, each element a 16th of the area.
    scene = cube_with_emitter(0.5, 0.5)
    coarse, fine = (radiosity.solve(scene, elements=n, form_factor_error=1e-3) for n in (24, 384))
    d = np.linspace(0.01, 0.1, 12)
    points = np.column_stack([d, np.full(12, 0.37), np.ones(12)])
    normal = [[0, 0, -1.0]]
    wanted = Gatherer(fine).irradiance(points, normal, rays=4096).irradiance[:, 0]
    gatherer = Gatherer(coarse)
    found = gatherer.irradiance(points, normal, rays=4096)
    off = np.sqrt((((found.irradiance[:, 0] - wanted) / wanted) ** 2).mean())
    gatherer._coarse[:] = 0.0
    read = gatherer.irradiance(points, normal, rays=4096)
    plain = np.sqrt((((read.irradiance[:, 0] - wanted) / wanted) ** 2).mean())
    assert off < 0.5 * plain and off < 0.02
    assert found.counters["rays"] > read.counters["rays"]


@pytest.fixture(scope="module")
def furnished():
    # A closed room of one grey with a box on the floor and a lamp; the box has no bottom.
    grey = diffuse("grey", 0.6)
    lamp = np.array([[1.5, 1, 2.6], [1.5, 2, 2.6], [2.5, 2, 2.6], [2.5, 1, 2.6]], float)
    surfaces = (
        box_surface("room", grey, (0, 0, 0), (4, 3, 2.7), inward=True),
        box_surface("table", grey, (2, 1, 0), (3, 2, 0.8), omit=["-z"]),
        Surface.from_polygons("lamp", diffuse("lamp", 0.0, 100.0), [lamp]),
    )
    scene = Scene("furnished", surfaces, background=np.zeros(1), bands=1, closed=True)
    return Gatherer(radiosity.solve(scene, elements=200, workers=1), workers=1)


UP, WEST = (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("place", "normal", "beside"),
    [
        ((1.0, 1.5, -1e-9), UP, (0, 0, 1e-9)),  # rounded to behind the floor
        ((1.0, 1.5, -1e-6), UP, (0, 0, 1e-6)),
        ((2.5, 1.5, 0.8 - 1e-7), UP, (0, 0, 1e-7)),  # and into the table
        ((0.0, 1.5, 0.0), UP, (1e-3, 0, 0)),  # where the floor meets a wall,
        ((0.0, 0.0, 0.0), UP, (1e-3, 1e-3, 0)),  # two walls,
        ((2.0, 1.5, 0.0), UP, (-1e-3, 0, 0)),  # the foot of the table
        ((2.0, 1.0, 0.0), WEST, (0, 1e-3, 1e-3)),  # and the foot of its edge
        ((2.0, 1.5, 0.8), WEST, (0, 0, -1e-3)),  # the rim of its top hides nothing
        ((2.0, 1.5, 0.8), UP, (1e-3, 0, 0)),
    ],
)
def test_sensors_on_surfaces_and_where_they_meet_see_what_those_just_beside_them_see(furnished, place, normal, beside):
    places = np.array([place, np.add(place, beside)])
    found = furnished.irradiance(places, normal, rays=4096)
    assert found.irradiance[0] == pytest.approx(found.irradiance[1], rel=0.02)
    # The answer is the same whatever else is asked, and nothing is moved that does not touch.
    free = furnished.irradiance([(1.0, 1.5, 0.5)], UP, rays=64)
    np.testing.assert_array_equal(
        free.irradiance, furnished.irradiance([(1.0, 1.5, 0.5)], UP, rays=64, own_polygon=-1).irradiance
    )


def test_sensors_inside_solids_and_behind_surfaces_get_nothing(furnished):
    places = [(2.5, 1.5, 0.4), (1.0, 1.5, -1e-3), (1.0, 1.5, 0.0)]
    found = furnished.irradiance(places, [UP, UP, (0.0, 0.0, -1.0)], rays=64)
    assert not found.irradiance.any()
