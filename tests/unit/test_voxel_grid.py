"""The voxel grid: its walk counted by a plain one, its lists, its mailboxes, and broken on purpose."""

from __future__ import annotations

import numpy as np
import pytest
from broken_kernels import break_kernel
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_scenes import box_triangles, geometry_of, nasty_polygons, rectangle

from workbench.accel import voxel_grid
from workbench.accel.brute import BruteForce
from workbench.accel.voxel_grid import VoxelGrid
from workbench.errors import InputError


def _crowd(seed: int, count: int = 40, size: float = 0.25):
    rng = np.random.default_rng(seed)
    polygons = [rng.uniform(0, 1, 3) + rng.uniform(-size, size, (3, 3)) for _ in range(count)]
    return rng, geometry_of(polygons), rng.uniform(-0.5, 1.5, (80, 3)), rng.normal(size=(80, 3))


def _plain_nearest(grid: VoxelGrid, origin, direction, mailboxes: bool):
    """Amanatides and Woo's walk with mailboxes, in plain Python; (t, counts)."""
    low, size = grid.cells.low, grid.cells.size
    n = grid.cells.resolution
    lists = [grid.cells.items[a:b].tolist() for a, b in zip(grid.cells.start[:-1], grid.cells.start[1:], strict=True)]
    alone = [BruteForce(geometry_of([grid.geometry.piece(i)])) for i in range(grid.geometry.piece_count)]
    count = {"voxels_stepped": 0, "mailbox_skips": 0, "polygon_tests": 0}
    t0, t1 = sorted(np.stack([(low - origin) / direction, (low + n * size - origin) / direction]), key=lambda _: 0)
    enter, leave = max(0.0, np.minimum(t0, t1).max()), np.maximum(t0, t1).min()
    best, tested = np.inf, set()
    if enter > leave:
        return best, count
    cell = np.clip(np.floor((origin + enter * direction - low) / size), 0, n - 1).astype(int)
    step = np.where(direction > 0, 1, -1)
    t_max = (low + (cell + (direction > 0)) * size - origin) / direction
    while True:
        count["voxels_stepped"] += 1
        for obj in lists[(cell[0] * n[1] + cell[1]) * n[2] + cell[2]]:
            if mailboxes and obj in tested:
                count["mailbox_skips"] += 1
                continue
            tested.add(obj)
            count["polygon_tests"] += 1
            best = min(best, alone[obj].closest_hit(origin, direction).t.item())
        axis = int(np.argmin(t_max))
        if best <= t_max[axis]:
            return best, count
        cell[axis] += step[axis]
        if not 0 <= cell[axis] < n[axis]:
            return best, count
        t_max[axis] += abs(size[axis] / direction[axis])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("mailboxes", [True, False])
def test_counters_equal_a_plain_walk(seed, mailboxes):
    _, geometry, origins, directions = _crowd(seed, count=15)
    grid = VoxelGrid(geometry, resolution=(5, 4, 3), mailboxes=mailboxes)
    for origin, direction in zip(origins[:25], directions, strict=False):
        before = dict(grid.counters)
        hit = grid.closest_hit(origin, direction)
        best, count = _plain_nearest(grid, origin, direction, mailboxes)
        assert hit.t == best
        for name, expected in count.items():
            assert grid.counters[name] - before.get(name, 0) == expected, name


def test_mailboxes_save_exactly_the_tests_they_skip():
    _, geometry, origins, directions = _crowd(1)
    kept, bare = VoxelGrid(geometry, resolution=8), VoxelGrid(geometry, resolution=8, mailboxes=False)
    for question in ("closest_hit", "occluded"):
        getattr(kept, question)(origins, directions), getattr(bare, question)(origins, directions)
    assert kept.counters["mailbox_skips"] > 0 and bare.counters["mailbox_skips"] == 0
    assert bare.counters["polygon_tests"] == kept.counters["polygon_tests"] + kept.counters["mailbox_skips"]
    assert bare.counters["voxels_stepped"] == kept.counters["voxels_stepped"]


def test_default_resolution_is_cubes_about_four_an_object():
    rng = np.random.default_rng(0)
    triangles = rng.uniform(0, 1, (2000, 1, 3)) * [4, 2, 1] + rng.uniform(-0.01, 0.01, (2000, 3, 3))
    x, y, z = VoxelGrid(geometry_of(triangles)).resolution
    assert x * y * z == pytest.approx(4 * 2000, rel=0.1)
    assert x / y == pytest.approx(2, rel=0.1) and y / z == pytest.approx(2, rel=0.1)
    assert VoxelGrid(geometry_of([rectangle(0, 1, 0, 1, 0)])).resolution[2] == 1


def test_every_piece_is_listed_where_it_lies_and_seldom_elsewhere():
    rng = np.random.default_rng(2)
    polygons = nasty_polygons(rng, 40, np.zeros((1, 3)))
    polygons = [p for p in polygons if np.abs(p).max() < 3]
    grid = VoxelGrid(geometry_of(polygons), resolution=9)
    cells = grid.cells
    for index, polygon in enumerate(polygons):
        share = rng.dirichlet(np.ones(len(polygon)), 300)
        place = np.floor((share @ polygon - cells.low) / cells.size).astype(int)
        for x, y, z in np.unique(place, axis=0):
            cell = (x * 9 + y) * 9 + z
            assert index in cells.items[cells.start[cell] : cells.start[cell + 1]]
    # A slanted triangle takes a sheet of voxels, not its bounding box.
    slanted = VoxelGrid(geometry_of([[[0, 0, 0], [1, 0, 1], [0.5, 1, 0.5]]]), resolution=20)
    assert len(slanted.cells.items) < 3 * 20 * 20


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_spheres_equal_brute_force_bit_for_bit(seed):
    rng = np.random.default_rng(seed)
    geometry = geometry_of(nasty_polygons(rng, 4, np.zeros((1, 3))))
    balls = np.column_stack([rng.uniform(-1, 2, (8, 3)), 10.0 ** rng.uniform(-2, 0.5, 8)])
    balls[0, :3] = balls[1, :3]  # one inside another
    origins, directions = rng.uniform(-2, 3, (60, 3)), rng.normal(size=(60, 3))
    origins[:10] = balls[rng.integers(0, 8, 10), :3]
    brute = BruteForce(geometry, spheres=balls)
    expected = brute.closest_hit(origins, directions)
    for resolution in (None, 1, 6):
        grid = VoxelGrid(geometry, spheres=balls, resolution=resolution)
        found = grid.closest_hit(origins, directions)
        assert (found.t == expected.t).all() and (found.polygon == expected.polygon).all()
        assert (grid.occluded(origins, directions) == brute.occluded(origins, directions)).all()


def test_threads_change_neither_answers_nor_counts(monkeypatch):
    monkeypatch.setattr(voxel_grid, "BLOCK", 7)
    _, geometry, origins, directions = _crowd(3)
    one = VoxelGrid(geometry)
    hits = one.closest_hit(origins, directions)
    for workers in (2, 16):
        many = VoxelGrid(geometry, workers=workers)
        again = many.closest_hit(origins, directions)
        assert (again.t == hits.t).all() and (again.polygon == hits.polygon).all()
        assert dict(many.counters) == dict(one.counters)


def test_transparent_layers_are_counted_once_each():
    # Panes in many voxels, a folded sheet, a shared edge, opaque behind: as brute force, and by hand.
    panes = [rectangle(-3, 3, -3, 3, z) for z in (1.0, 1.5)]
    grid = VoxelGrid(
        geometry_of(panes, box_triangles([-1, -1, 2], [1, 1, 3], 2), transmittance=(0.5, 0.25), bands=2), resolution=7
    )
    brute = BruteForce(grid.geometry)
    rng = np.random.default_rng(4)
    origins = rng.uniform(-0.9, 0.9, (200, 3)) * [1, 1, 0]
    origins[:50] = rng.integers(-1, 2, (50, 3)) * [0.5, 0.5, 0]  # on shared edges and corners
    for far, expected in ((0.4, 1.0), (1.2, 0.5), (1.9, 0.25), (2.5, 0.0625), (9.0, 0.015625)):
        for tracer in (grid, brute):
            assert (tracer.transmitted(origins, [0, 0, 1.0], far) == expected).all()


def test_walk_ends_with_the_ray():
    grid = VoxelGrid(geometry_of([rectangle(0.2, 0.4, 0.2, 0.4, 7.5)]), resolution=8, bounds=[[0, 0, 0], [8, 8, 8]])
    for far, voxels in ((0.5, 1), (3.5, 4), (7.0, 7), (100.0, 8)):
        before = grid.counters["voxels_stepped"]
        grid.occluded([0.7, 0.5, 0.0], [0, 0, 1.0], far)
        assert grid.counters["voxels_stepped"] - before == voxels
    before = grid.counters["voxels_stepped"]
    grid.closest_hit([0.3, 0.3, -5], [0, 0, -1.0])
    grid.closest_hit([20, 0.3, -5], [0, 0, 1.0])
    assert grid.counters["voxels_stepped"] == before  # neither enters the grid


BROKEN = {
    "the first hit found is the nearest": ("walk", "best <= exit_t", "best < math.inf"),
    "walk ends a voxel early": ("walk", "if exit_t >= leave", "if exit_t >= 0.7 * leave"),
    "steps along the wrong axis": ("walk", "exit_t = min(tx, ty, tz)", "exit_t = max(min(tx, ty), min(ty, tz))"),
    "mailbox of the last ray": ("walk", "if mailbox[index] >= current:", "if mailbox[index] >= current - 1:"),
}


@pytest.mark.parametrize(("name", "old", "new"), BROKEN.values(), ids=BROKEN)
def test_equality_with_brute_force_fails_on_a_broken_walk(monkeypatch, name, old, new):
    def mismatches():
        found = 0
        for seed in range(12):
            _, geometry, origins, directions = _crowd(seed, count=8 + 4 * seed, size=0.1 + 0.05 * seed)
            nearest = BruteForce(geometry).closest_hit(origins, directions)
            found += (VoxelGrid(geometry, resolution=5).closest_hit(origins, directions).t != nearest.t).sum()
        return found

    assert mismatches() == 0
    break_kernel(monkeypatch, voxel_grid, name, old, new)
    assert mismatches() > 0


def test_equality_fails_without_a_margin_round_voxels(monkeypatch):
    # A walk that rounds its way past a voxel corner misses polygons entered only where they lie.
    def mismatches():
        found = 0
        for seed in range(40):
            rng = np.random.default_rng(seed)
            n = int(rng.integers(2, 8))
            low, high = rng.uniform(-1, 0, 3), rng.uniform(1, 2, 3)
            corner = low + rng.integers(1, n, (30, 3)) * ((high - low) / n)  # voxel corners, rounded
            pointed = corner[:, None] + rng.choice([-1, 1], (30, 1, 3)) * rng.uniform(0, 0.1, (30, 3, 3))
            pointed[:, 0] = corner
            geometry = geometry_of(pointed)
            grid = VoxelGrid(geometry, resolution=n, bounds=[low, high])
            origins = rng.uniform(-3, 4, (600, 3))
            directions = corner[rng.integers(0, 30, 600)] - origins
            nearest = BruteForce(geometry).closest_hit(origins, directions)
            found += (grid.closest_hit(origins, directions).t != nearest.t).sum()
        return found

    assert mismatches() == 0
    fill = voxel_grid._fill
    monkeypatch.setattr(voxel_grid, "_fill", lambda o, n, c, margin, *rest: fill(o, n, c, 0.0 * margin, *rest))
    assert mismatches() > 0


def test_bad_arguments_get_one_clear_line():
    geometry = geometry_of([rectangle(0, 1, 0, 1, 0)])
    for options, words in (
        ({"resolution": 0}, "resolution"),
        ({"resolution": (4, 4)}, "resolution"),
        ({"resolution": 2.5}, "resolution"),
        ({"resolution": 1000}, "2\\^24"),
        ({"bounds": [[0, 0, 0], [1, 1, 1]]}, "to spare"),
        ({"bounds": [[0, 0, 0], [-1, 1, 1]]}, "lower and an upper"),
        ({"bounds": "box"}, "lower and an upper"),
        ({"spheres": [[0, 0, 0, 0]]}, "spheres"),
        ({"workers": 0}, "workers"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            VoxelGrid(geometry, **options).occluded([0, 0, 1], [0, 0, 1.0])
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="move the scene"):
        VoxelGrid(geometry).closest_hit([1e13, 0, 0], [0, 0, 1.0])
