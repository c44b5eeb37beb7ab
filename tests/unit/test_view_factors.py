"""View-factor matrices: reciprocity, closing, sparse and dense, honest errors, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from radiosity_scenes import UNIT, each_truth, polygon_scene, truth
from view_factor_scenes import closed_room

import radiosity
from radiosity.form_factors import _ray_shares, matrix
from radiosity.form_factors.analytic import polygon_to_polygon
from radiosity.form_factors.matrix import close_rows
from workbench.errors import InputError, MemoryForecastError, OptionError
from workbench.scene.library import box_surface, diffuse
from workbench.scene.model import Scene, Surface


@pytest.fixture(scope="module")
def room():
    return closed_room(0.8)


@pytest.fixture(scope="module")
def found(room):
    return radiosity.view_factors(room, error=1e-3, workers=2)


@pytest.fixture(scope="module")
def reference(room):
    return radiosity.view_factors(room, error=1e-4, workers=2)


def errors_of(found):
    return found.standard_error if not found.sparse else found.standard_error.toarray()


def test_rows_close_without_breaking_reciprocity(found):
    factor = found.dense()
    exchange = found.areas[:, None] * factor
    assert np.abs(exchange - exchange.T).max() <= 1e-15 * exchange.max()
    assert found.reciprocity < 1e-14
    assert np.abs(factor.sum(axis=1) - 1).max() < 1e-9
    assert np.abs(found.row_sums - 1).max() < 3e-3  # as found, before closing
    assert 0 < found.closure_correction < 1e-3
    assert (factor >= 0).all() and (np.diag(factor) == 0).all()


def test_the_wanted_error_is_met_and_stated(found, reference):
    off = np.abs(found.dense() - reference.dense())
    assert off.sum(axis=1).mean() < 1e-3
    stated = errors_of(found)
    assert 0.5 * off.sum(axis=1).mean() < stated.sum(axis=1).mean() < 10 * off.sum(axis=1).mean()
    # The reference's own error beside ours; one in a hundred may lie beyond three.
    allowed = 3 * np.hypot(stated, errors_of(reference)) + 1e-9
    assert (off > allowed).mean() < 0.01


def test_the_number_of_workers_changes_nothing(room, found):
    again = radiosity.view_factors(room, error=1e-3, workers=1)
    assert (again.dense() == found.dense()).all()
    assert dict(again.record.counters) == dict(found.record.counters)


def test_sparse_equals_dense(room, found, monkeypatch):
    monkeypatch.setattr(matrix, "SPARSE_ENTRY", 0 if not found.sparse else 10**6)
    other = radiosity.view_factors(room, error=1e-3, workers=2)
    assert other.sparse != found.sparse
    assert other.dense() == pytest.approx(found.dense(), rel=1e-12, abs=0)
    assert errors_of(other) == pytest.approx(errors_of(found), rel=1e-6, abs=0)
    assert other.reciprocity < 1e-14


def test_surfaces_are_the_area_weighted_sum_of_their_polygons(room, found):
    by = radiosity.view_factors(room, by="surface", error=1e-3, workers=2)
    assert by.names == [surface.name for surface in room.surfaces]
    owner = np.repeat(np.arange(len(by.names)), [surface.face_count for surface in room.surfaces])
    exchange = np.zeros((len(by.names), len(by.names)))
    np.add.at(exchange, (owner[:, None], owner[None, :]), found.areas[:, None] * found.dense())
    assert by.areas == pytest.approx(np.bincount(owner, found.areas))
    # Closed on surfaces there, on polygons here; 1e-3 was asked of either.
    off = np.abs(by.dense() - exchange / by.areas[:, None])
    assert off.sum(axis=1).mean() < 2e-3
    assert np.abs(by.dense().sum(axis=1) - 1).max() < 1e-9


def test_an_open_scene_is_not_closed():
    one, two = truth_squares()
    found = radiosity.view_factors(polygon_scene(one, two), error=1e-6)
    # Howell C-11 for unit squares a unit apart.
    assert found.dense() == pytest.approx(np.array([[0, 0.19982489569838746], [0.19982489569838746, 0]]), abs=1e-8)
    assert found.closure_correction == 0


def truth_squares():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    return square, square[::-1] + [0, 0, 1]


def test_covered_floor_keeps_what_it_sees():
    # A box stands on the undivided floor: the floor's row lacks the covered share, and keeps it so.
    room = box_surface("room", diffuse("wall", 0.5), *UNIT, inward=True)
    box = box_surface("box", diffuse("box", 0.5), [0.25, 0.25, 0], [0.75, 0.75, 0.5], omit=["-z"])
    found = radiosity.view_factors(Scene("covered", (room, box), bands=1, closed=True), error=1e-3)
    assert found.record.results["covered_rows"] == 1
    sums = found.dense().sum(axis=1)
    floor = [i for i, s in enumerate(sums) if s < 0.99]
    assert len(floor) == 1 and sums[floor[0]] == pytest.approx(0.75, abs=2e-3)
    assert np.abs(np.delete(sums, floor[0]) - 1).max() < 1e-6


def test_coplanar_elements_and_two_sides_of_a_sheet_exchange_nothing():
    sheet = Surface.from_polygons(
        "sheet", diffuse("s", 0.5), [np.array([[0, 0, 0.5], [1, 0, 0.5], [1, 1, 0.5], [0, 1, 0.5]])]
    )
    back = Surface.from_polygons("back", diffuse("b", 0.5), [sheet.face(0)[0][::-1]])
    room = box_surface("room", diffuse("wall", 0.5), [-1, -1, -1], [2, 2, 2], inward=True)
    found = radiosity.view_factors(Scene("sheet", (room, sheet, back), bands=1, closed=True), max_edge=0.6, error=5e-3)
    rows = [i for i, name in enumerate(found.names) if name.startswith(("sheet", "back"))]
    assert (found.dense()[np.ix_(rows, rows)] == 0).all()
    assert np.abs(found.row_sums - 1).max() < 0.03


def test_long_candidate_lists_get_rays(monkeypatch):
    monkeypatch.setattr(matrix._pairs, "MAX_CUT", 1)
    room = closed_room(1.5)
    by_rays = radiosity.view_factors(room, error=3e-3)
    monkeypatch.undo()
    exact = radiosity.view_factors(room, error=1e-4)
    assert by_rays.record.counters["rays"] > 0 and exact.record.counters["rays"] == 0
    off, stated = by_rays.dense() - exact.dense(), np.hypot(errors_of(by_rays), errors_of(exact))
    assert np.abs(off).sum(axis=1).mean() < 3e-2
    # One standard error: the z values of the entries that are seen in part.
    z = off[stated > 1e-5] / stated[stated > 1e-5]
    assert len(z) > 50 and np.sqrt((z**2).mean()) < 1.5


@pytest.mark.parametrize(("a", "b"), [(0.1, 0.1), (0.05, 0.5), (1.0, 1.0), (3.0, 1.0)])
def test_doubts_of_rays_are_those_of_pairs_that_are_alike(a, b):
    # Shares drawn from a beta distribution, and rays from them: of 20,000 a root mean square is known to 1 %.
    rng = np.random.default_rng(11)
    for rays in (4, 16, 64):
        true = rng.beta(a, b, 20000)
        share, many = rng.binomial(rays, true) / rays, np.full(20000, float(rays))
        doubt = _ray_shares._doubts(share, many, _ray_shares._prior(share, many, np.ones(20000)))
        actual = np.sqrt(((share - true) ** 2).mean())
        assert 0.85 < np.sqrt((doubt**2).mean()) / actual < 1.4
        # Where all rays agree, too.
        same = (share == 0) | (share == 1)
        off, said = (np.sqrt((v[same] ** 2).mean()) for v in (share - true, doubt))
        assert 0.75 < said / off < 2.5
    few = _ray_shares._prior(share[:20], many[:20], np.ones(20))
    assert few.tolist() == [1.0, 1.0]


def test_panes_dim_rays_too(monkeypatch):
    # Two squares with two panes and a small blocker between: by exact cuts, and by rays where nothing may be cut.
    low, high = truth_squares()
    opaque = diffuse("wall", 0.5)
    pane = type(opaque)(**{**opaque.__dict__, "transmittance": np.full_like(opaque.reflectance, 0.5)})
    surfaces = [Surface.from_polygons(f"s{i}", opaque, [ring]) for i, ring in enumerate((low, high))]
    for height, material, size in ((0.3, pane, 9.0), (0.5, opaque, 0.4), (0.7, pane, 0.6)):
        ring = (low - [0.5, 0.5, 0]) * size + [0.5, 0.5, height]
        surfaces.append(Surface.from_polygons(f"at {height}", material, [ring]))
    scene = Scene("panes", tuple(surfaces), bands=1)
    exact = radiosity.view_factors(scene, error=1e-5)
    clear = radiosity.view_factors(Scene("clear", tuple(surfaces[:2]), bands=1), error=1e-5)
    assert 0.1 < exact.dense()[0, 1] / clear.dense()[0, 1] < 0.4
    monkeypatch.setattr(matrix._pairs, "MAX_CUT", 0)
    monkeypatch.setattr(matrix, "REFINEMENTS", 0)
    found = radiosity.view_factors(scene, error=1e-3)
    assert found.record.counters["rays"] > 0
    assert abs(found.dense() - exact.dense())[0, 1] < 4 * errors_of(found)[0, 1] < 0.02


@each_truth("occ/L-room/")
def test_l_room(name):
    import workbench

    found = radiosity.view_factors(workbench.load("l-room"), error=1e-4)
    assert found.dense() == pytest.approx(np.array(truth(name)["value"]), abs=1e-4)
    assert (found.dense()[np.array(truth(name)["value"]) == 0] == 0).all()


def test_closing_keeps_symmetry_zeros_and_rows_of_nothing():
    exchange = np.array([[0, 2.0, 1.0, 0], [2.0, 0, 1.1, 0], [1.0, 1.1, 0, 0], [0, 0, 0, 0]])
    wanted = np.array([3.05, 3.0, 2.2, 1.0])
    x = close_rows(exchange, wanted)
    closed = exchange * x * x[:, None]
    assert closed.sum(axis=1)[:3] == pytest.approx(wanted[:3], rel=1e-8)
    assert x[3] == 1 and ((closed == 0) == (exchange == 0)).all()


def test_names_say_surface_face_and_part():
    square, _ = truth_squares()
    surfaces = (
        Surface.from_polygons("one", diffuse("a", 0.5), [square]),
        Surface.from_polygons("two", diffuse("a", 0.5), [square + [0, 0, 1], square + [2, 0, 1]]),
    )
    scene = Scene("names", surfaces, bands=1)
    assert radiosity.view_factors(scene).names == ["one", "two[0]", "two[1]"]
    names = radiosity.view_factors(scene, max_edge=0.5).names
    assert names[:4] == ["one.0", "one.1", "one.2", "one.3"] and names[4] == "two[0].0"


def test_files_hold_the_matrix(found, tmp_path):
    found.save(tmp_path / "F.npz")
    with np.load(tmp_path / "F.npz") as stored:
        assert (stored["areas"] == found.areas).all() and stored["names"].tolist() == found.names
        if "F" in stored:
            assert (stored["F"] == found.dense()).all()
        else:
            import scipy.sparse

            n = len(found.names)
            parts = stored["F_data"], stored["F_indices"], stored["F_indptr"]
            assert (scipy.sparse.csr_array(parts, shape=(n, n)).toarray() == found.dense()).all()
    found.save(tmp_path / "F.csv")
    lines = (tmp_path / "F.csv").read_text().splitlines()
    assert lines[0] == "from,to,F,standard_error"
    assert len(lines) == 1 + np.count_nonzero((found.dense() != 0) | (errors_of(found) != 0))
    with pytest.raises(InputError, match=r"expected \.npz or \.csv"):
        found.save(tmp_path / "F.txt")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["F.csv", "F.npz"]


@pytest.mark.parametrize(
    "options", [{"by": "room"}, {"error": 0.0}, {"error": 2.0}, {"error": float("nan")}, {"workers": 0}]
)
def test_bad_options_are_refused(options):
    with pytest.raises(OptionError, match=next(iter(options))):
        radiosity.view_factors(polygon_scene(*truth_squares()), **options)


def test_a_scene_without_surface_is_refused():
    with pytest.raises(InputError, match="no surface"):
        radiosity.view_factors(Scene("empty", ()))


def test_too_large_a_matrix_is_refused_with_its_size(monkeypatch):
    # A million rows: 16 bytes and more for each of a million million pairs, in any machine too much.
    with pytest.raises(MemoryForecastError, match="GiB"):
        radiosity.view_factors(polygon_scene(*truth_squares()), elements=10**9)
    monkeypatch.setattr("workbench.memory.available_bytes", lambda: 1000)
    with pytest.raises(MemoryForecastError, match=r"2 x 2 view factors|mesh of"):
        radiosity.view_factors(polygon_scene(*truth_squares()))


def test_whole_polygons_are_the_undivided_mesh():
    # Two sides, a concave polygon in pieces, a quad and a triangle: with a mesh of one element a polygon and without.
    two = diffuse("two", 0.5)
    two = type(two)(**{**two.__dict__, "two_sided": True})
    sheet = Surface.from_polygons("sheet", two, [np.array([[0.3, 0.3, 0.4], [0.7, 0.3, 0.5], [0.5, 0.7, 0.45]])])
    arrow = np.array([[0.1, 0.1, 0.7], [0.9, 0.1, 0.7], [0.5, 0.3, 0.7], [0.5, 0.9, 0.7]])
    room = box_surface("room", diffuse("wall", 0.5), *UNIT, inward=True)
    scene = Scene("mixed", (room, sheet, Surface.from_polygons("arrow", two, [arrow])), bands=1, closed=True)
    whole, divided = radiosity.view_factors(scene), radiosity.view_factors(scene, elements=1)
    assert whole.names == divided.names and "sheet (back)" in whole.names
    assert whole.areas == pytest.approx(divided.areas)
    assert whole.dense() == pytest.approx(divided.dense(), rel=1e-9, abs=1e-12)
    assert np.abs(whole.row_sums - 1).max() < 5e-3
    # The arrow's two sides see different rooms; neither sees the other or itself.
    rows = [whole.names.index(name) for name in ("arrow", "arrow (back)")]
    assert (whole.dense()[np.ix_(rows, rows)] == 0).all()


def wedge(degrees):
    """Two unit squares that share an edge at an angle, and the form factor of their halves before a wall across."""
    angle = np.radians(degrees)
    floor = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    leaf = np.array([[0, 0, 0], [0, 1, 0], [np.cos(angle), 1, np.sin(angle)], [np.cos(angle), 0, np.sin(angle)]])
    wall = np.array([[-9, 0.5, -9], [9, 0.5, -9], [9, 0.5, 9], [-9, 0.5, 9]], dtype=float)
    half = [1, 0.5, 1]
    return floor, leaf, wall, polygon_to_polygon(floor * half, leaf * half)


@pytest.mark.parametrize("degrees", [0.1, 1, 30, 90, 179])
@pytest.mark.parametrize("error", [1e-2, 1e-3])
def test_a_wall_across_a_wedge(degrees, error):
    # The wall touches both leaves; beside it lie penumbrae as thin as the wedge.
    floor, leaf, wall, exact = wedge(degrees)
    found = radiosity.view_factors(polygon_scene(floor, leaf, wall), error=error)
    assert abs(found.dense()[0, 1] - exact) <= error
    assert found.record.errors["stated_row_error"] <= error


def test_a_leg_that_stands_on_a_polygon_is_seen_by_it():
    # A slender leg under a seat: its shadow on the seat is narrow, and touches the seat.
    seat = np.array([[0, 0, 0], [0, 1, 0], [1, 1, 0], [1, 0, 0]], dtype=float)
    side = np.array([[2, -1, -1.5], [2, -1, 0], [2, 2, 0], [2, 2, -1.5]], dtype=float)
    low, high = 0.47, 0.53
    leg = [np.array([[x, low, 0], [x, high, 0], [x, high, -0.8], [x, low, -0.8]]) for x in (low, high)] + [
        np.array([[low, y, 0], [high, y, 0], [high, y, -0.8], [low, y, -0.8]]) for y in (low, high)
    ]
    exact = radiosity.form_factor(seat, side, leg, error=1e-8)
    free = radiosity.form_factor(seat, side)
    assert free > exact * 1.02
    for error in (1e-3, 1e-4):
        found = radiosity.view_factors(polygon_scene(seat, side, *leg), error=error)
        assert abs(found.dense()[0, 1] - exact) <= error
        assert found.record.errors["stated_row_error"] <= error


def test_only_the_pairs_that_make_the_error_are_refined():
    import workbench

    loose, fine = (radiosity.view_factors(workbench.load("l-room"), error=error) for error in (0.05, 1e-4))
    assert "refined_pairs" not in loose.record.results
    # 14 pieces, 91 pairs.
    assert 0 < fine.record.results["refined_pairs"] < 91
    assert fine.record.errors["stated_row_error"] <= 1e-4


def test_rows_with_pieces_that_see_each_other_keep_values_and_errors_together():
    # By surface the inside of a box sees itself; its two halves are one row, whose entry on the diagonal is theirs.
    room = box_surface("room", diffuse("wall", 0.5), *UNIT, inward=True)
    found = radiosity.view_factors(Scene("room", (room,), bands=1, closed=True), by="surface", error=1e-4)
    assert found.dense() == pytest.approx(np.ones((1, 1)), abs=1e-9)
    assert 0 < errors_of(found)[0, 0] <= 1e-4


def test_a_row_that_lacks_much_but_bears_nothing_is_closed():
    # A coarse matrix of a room in triangles: rows off by more than 1 % are errors, not covers.
    found = radiosity.view_factors(closed_room(1.0), error=0.1, workers=2)
    assert found.record.results["covered_rows"] == 0
    assert np.abs(found.dense().sum(axis=1) - 1).max() < 1e-9


def test_polygons_without_area_are_refused():
    flat = np.array([[0, 0, 0.5], [1, 0, 0.5], [2, 0, 0.5]])
    square, _ = truth_squares()
    with pytest.raises(InputError, match="no area"):
        radiosity.view_factors(polygon_scene(square, flat))
