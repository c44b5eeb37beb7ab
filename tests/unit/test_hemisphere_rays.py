"""View factors by rays from the rows: closed forms, reciprocity, two sides, open scenes, and when they are taken."""

from __future__ import annotations

import numpy as np
import pytest
from radiosity_scenes import UNIT, polygon_scene
from view_factor_scenes import closed_room

import radiosity
from radiosity.form_factors import matrix
from workbench.scene.library import box_surface, diffuse
from workbench.scene.model import Scene, Surface


def errors_of(found):
    return found.standard_error if not found.sparse else found.standard_error.toarray()


@pytest.fixture
def by_rays(monkeypatch):
    """Rays however small the scene."""
    monkeypatch.setattr(matrix, "_pair_seconds", lambda *_: np.inf)

    def ask(scene, **options):
        found = radiosity.view_factors(scene, **options)
        assert found.record.results["method"] == "hemisphere rays" and found.record.counters["rays"] > 0
        return found

    return ask


def grid(name, corner, along, across, n, material=None):
    """A parallelogram in n x n squares."""
    corner, along, across = (np.asarray(v, dtype=float) for v in (corner, along, across))
    step = np.arange(n + 1) / n
    points = corner + step[:, None, None] * along + step[None, :, None] * across
    k = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    rings = np.stack([k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]], axis=-1).reshape(-1, 4)
    return Surface.from_mesh(name, material or diffuse(name, 0.5), points.reshape(-1, 3), rings)


FACING = (
    grid("low", [0, 0, 0], [1, 0, 0], [0, 1, 0], 50),
    grid("high", [0, 0, 1], [0, 1, 0], [1, 0, 0], 50),
)
HOWELL_C11 = 0.19982489569838746


def test_many_polygons_by_surface_get_rays_and_their_closed_form():
    z = []
    for seed in range(12):
        found = radiosity.view_factors(Scene("facing", FACING, bands=1), by="surface", error=0.02, seed=seed, workers=1)
        assert found.record.results["method"] == "hemisphere rays"
        predicted = found.record.results["predicted_seconds"]
        assert predicted["hemisphere rays"] < predicted["pairs"]
        assert found.record.errors["stated_row_error"] <= 0.02
        assert found.closure_correction == 0 and found.reciprocity < 1e-14
        assert (np.diag(found.dense()) == 0).all() and (np.diag(errors_of(found)) == 0).all()
        z.append((found.dense()[0, 1] - HOWELL_C11) / errors_of(found)[0, 1])
    assert np.abs(z).max() < 4
    # Neither biased nor stated far too large or too small: 12 draws.
    assert abs(np.mean(z)) < 4 / np.sqrt(12) and 0.3 < np.sqrt(np.mean(np.square(z))) < 2


def test_the_cheaper_way_is_taken():
    small = radiosity.view_factors(
        polygon_scene(FACING[0].face(0)[0] * 50, [[0, 0, 1], [0, 1, 1], [1, 1, 1]]), error=0.1
    )
    # So few pairs are not worth a look at rays.
    assert (
        small.record.results["method"] == "pairs" and "hemisphere rays" not in small.record.results["predicted_seconds"]
    )
    room = closed_room(0.8)
    for by, error, way in (("patch", 0.1, "pairs"), ("surface", 0.1, "hemisphere rays"), ("surface", 1e-3, "pairs")):
        record = radiosity.view_factors(room, by=by, error=error).record
        predicted = record.results["predicted_seconds"]
        assert record.results["method"] == way
        assert predicted[way] <= min(predicted.values())
    # Nor are rays tried where they are hopeless.
    assert record.counters["rays"] == 0 and len(predicted) == 1


def test_cluttered_scenes_get_rays_for_a_coarse_error():
    # Many large polygons at random: their pairs see each other past most others.
    rng = np.random.default_rng(3)
    rings = []
    for _ in range(120):
        along, across, middle = rng.normal(size=3), rng.normal(size=3), rng.uniform(-1, 1, 3)
        rings.append(middle + 0.3 * np.array([along, across, -along - across]))
    scene = polygon_scene(*rings)
    coarse = radiosity.view_factors(scene, error=0.1)
    assert coarse.record.results["method"] == "hemisphere rays"
    assert coarse.record.errors["stated_row_error"] <= 0.1
    fine = radiosity.view_factors(scene, error=0.01)
    off = np.abs(coarse.dense() - fine.dense()).sum(axis=1).mean()
    stated = coarse.record.errors["stated_row_error"]
    # A sum over 14,280 entries hardly scatters: it is known as well as its estimate is right.
    assert stated / 2 < off < 1.2 * stated
    # Entries have bounds where no ray met a pair; together these are far more than can be missing.
    assert errors_of(coarse).sum(axis=1).mean() > stated


def test_more_rays_for_a_smaller_error(by_rays):
    room = closed_room(2.0)
    rays = []
    for error in (0.1, 0.03, 0.01):
        found = by_rays(room, by="surface", error=error, workers=2)
        assert found.record.errors["stated_row_error"] <= error
        rays.append(found.record.results["rays_a_row"])
    assert rays[0] < rays[1] < rays[2]


@pytest.mark.parametrize("by", ["surface", "patch"])
def test_a_closed_room_with_obstruction_against_pairs(by_rays, monkeypatch, by):
    room = closed_room(2.0)
    z = []
    for seed in range(3):
        found = by_rays(room, by=by, error=0.03, seed=seed, workers=2)
        factor = found.dense()
        exchange = found.areas[:, None] * factor
        assert np.abs(exchange - exchange.T).max() <= 1e-14 * exchange.max()
        assert np.abs(factor.sum(axis=1) - 1).max() < 1e-9 and found.closure_correction > 0
        assert np.abs(found.row_sums - 1).max() < 0.05
        with monkeypatch.context() as plain:
            plain.setattr(matrix, "_pair_seconds", lambda *_: 0.0)
            exact = radiosity.view_factors(room, by=by, error=1e-4, workers=2)
        assert exact.record.results["method"] == "pairs"
        off = factor - exact.dense()
        assert np.abs(off).sum(axis=1).mean() < 0.03
        doubt = np.hypot(errors_of(found), errors_of(exact))
        assert (off[doubt == 0] == 0).all()
        # Pairs of rows that cannot face each other have neither value nor error.
        assert (factor[errors_of(found) == 0] == 0).all()
        z.append((off / np.where(doubt > 0, doubt, 1.0))[exact.dense() > 0.01])
    z = np.concatenate(z)
    assert 0.3 < np.sqrt((z**2).mean()) < 1.5 and np.abs(z).max() < 5


def test_threads_change_nothing_and_seeds_do(by_rays):
    room = closed_room(2.0)
    one, two, other = (by_rays(room, error=0.1, workers=w, seed=s) for w, s in ((1, 0), (2, 0), (2, 1)))
    assert (one.dense() == two.dense()).all() and dict(one.record.counters) == dict(two.record.counters)
    assert (one.dense() != other.dense()).any()


def test_both_sides_of_a_sheet_and_a_black_back(by_rays):
    # Between two squares a sheet that covers both: its sides see one each, and the squares do not see each other.
    material = diffuse("sheet", 0.5)
    two = type(material)(**{**material.__dict__, "two_sided": True})
    box = [grid("low", [0, 0, 0], [1, 0, 0], [0, 1, 0], 3), grid("high", [0, 0, 2], [0, 1, 0], [1, 0, 0], 3)]
    for sheet_material, back in ((two, True), (material, False)):
        sheet = grid("sheet", [-9, -9, 1], [19, 0, 0], [0, 19, 0], 4, sheet_material)
        found = by_rays(Scene("sheet", (*box, sheet), bands=1), by="surface", error=0.03)
        low, high, up = (found.names.index(name) for name in ("low", "high", "sheet"))
        factor, error = found.dense(), errors_of(found)
        assert factor[low, high] == 0 and factor[low, up] == 0 and factor[high, low] == 0
        assert abs(factor[high, up] - 1) < 0.02
        if back:
            down = found.names.index("sheet (back)")
            assert factor[low, down] == pytest.approx(factor[high, up], abs=0.02)
            assert factor[up, down] == factor[down, up] == error[up, down] == 0
        else:
            assert factor[low].sum() == 0  # the back is black


def test_what_no_ray_met_keeps_the_doubt_of_hits(by_rays):
    # Two specks that face each other over 2: rays from one never find the other, whose share is 1e-7.
    speck = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=float) * 1e-3
    floor = np.array([[0, 0, -1], [1, 0, -1], [1, 1, -1], [0, 1, -1]], dtype=float)
    away = speck[::-1] + [0.2, 0.2, 0.0]  # its back is the first speck's: it faces the floor only
    found = by_rays(polygon_scene(floor, speck + [0.5, 0.5, 0.0], speck[::-1] + [0.5, 0.5, 2.0], away), error=0.05)
    factor, error = found.dense(), errors_of(found)
    hit = 1.0 / (found.record.results["rays_a_row"] * (1 / found.areas[1] + 1 / found.areas[2]))
    assert factor[1, 2] == 0 < error[1, 2]
    assert error[1, 2] * found.areas[1] >= hit * (1 - 1e-6)
    true = found.areas[2] / (np.pi * 2.0**2)
    assert true < error[1, 2]
    # Of what cannot be nothing is doubted: a polygon and itself, and backs.
    assert (np.diag(error) == 0).all() and error[1, 0] == error[1, 3] == error[3, 2] == 0
    assert factor[3, 0] > 0.1  # while what rays met is known


def test_covered_floor_keeps_what_it_sees_by_rays(by_rays):
    room = box_surface("room", diffuse("wall", 0.5), *UNIT, inward=True)
    box = box_surface("box", diffuse("box", 0.5), [0.25, 0.25, 0], [0.75, 0.75, 0.5], omit=["-z"])
    found = by_rays(Scene("covered", (room, box), bands=1, closed=True), error=0.02)
    assert found.record.results["covered_rows"] == 1
    sums = found.dense().sum(axis=1)
    assert sums.min() == pytest.approx(0.75, abs=0.01) and np.abs(np.sort(sums)[1:] - 1).max() < 1e-6


def test_divided_polygons_and_sparse(by_rays, monkeypatch):
    # Rays land on elements; back to back rooms see nothing of each other, so that most entries are impossible.
    monkeypatch.setattr(matrix, "SPARSE_ENTRY", 0)
    scene = Scene(
        "facing",
        (grid("low", [0, 0, 0], [1, 0, 0], [0, 1, 0], 1), grid("high", [0, 0, 1], [0, 1, 0], [1, 0, 0], 1)),
        bands=1,
    )
    found = by_rays(scene, max_edge=0.5, error=0.05)
    assert found.sparse and len(found.names) > 2
    low = np.array([name.startswith("low") for name in found.names])
    exchange = found.areas[:, None] * found.dense()
    assert exchange[np.ix_(low, ~low)].sum() == pytest.approx(HOWELL_C11, abs=0.01)
    assert exchange[np.ix_(low, low)].sum() == 0 and found.reciprocity < 1e-14


def test_panes_keep_their_pairs(by_rays):
    pane = diffuse("pane", 0.1)
    pane = type(pane)(**{**pane.__dict__, "transmittance": np.full_like(pane.reflectance, 0.5)})
    sheet = grid("pane", [0, 0, 0.5], [1, 0, 0], [0, 1, 0], 1, pane)
    found = radiosity.view_factors(Scene("pane", (FACING[0], sheet), bands=1), by="surface", error=0.1)
    assert found.record.results["method"] == "pairs"


def test_pairs_behind_hundreds_of_polygons_agree_with_rays(by_rays, monkeypatch):
    # 250 small triangles between two squares: more than are looked at one by one, and sifted for none of these pairs.
    rng = np.random.default_rng(8)
    rings = [FACING[0].face(0)[0] * 50, FACING[0].face(0)[0][::-1] * 50 + [0, 0, 1]]
    for _ in range(250):
        rings.append(0.04 * rng.normal(size=(3, 3)) + [*rng.uniform(0.1, 0.9, 2), rng.uniform(0.3, 0.7)])
    scene = polygon_scene(*rings)
    rays = by_rays(scene, error=0.03, workers=2)
    monkeypatch.setattr(matrix, "_pair_seconds", lambda *_: 0.0)
    pairs = radiosity.view_factors(scene, error=0.1, workers=2)
    assert pairs.record.results["method"] == "pairs" and pairs.record.counters["rays"] > 0
    off, doubt = (m.dense()[0, 1] for m in (pairs, rays)), np.hypot(errors_of(pairs)[0, 1], errors_of(rays)[0, 1])
    assert abs(np.subtract(*off)) < 4 * doubt < 0.1
    assert rays.dense()[0, 1] < 0.8 * HOWELL_C11
    assert np.abs(pairs.dense() - rays.dense()).sum(axis=1).mean() < 0.13
