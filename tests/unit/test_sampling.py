"""Point sets and warps: strata, ranges and seeds exactly; what is random by chi-square tests."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from shapely.geometry import Polygon, box

from workbench.errors import InputError
from workbench.sampling import sequences, warp
from workbench.sampling.sequences import (
    SEQUENCES,
    hashed,
    multijittered,
    n_rooks,
    owen_scramble,
    owen_sobol,
    point_set,
    shifted,
    sobol,
    sobol_bits,
)
from workbench.shadow.rays import NOISE, unit_samples

SIGNIFICANCE = 0.01
COUNTS = (1, 2, 3, 7, 16, 17, 36, 64)


def assert_distribution(observed, expected, tests: int = 1) -> None:
    """Pearson's chi-square at a Sidak-corrected 1 %, cells of less than 5 expected put together."""
    observed, expected = np.ravel(observed).astype(float), np.ravel(expected).astype(float)
    assert not observed[expected == 0.0].any(), "samples where the density is zero"
    expected = expected * observed.sum() / expected.sum()
    order = np.argsort(expected)
    observed, expected = observed[order], expected[order]
    few = int(np.searchsorted(expected, 5.0))
    if few:
        observed = np.concatenate([[observed[:few].sum()], observed[few:]])
        expected = np.concatenate([[expected[:few].sum()], expected[few:]])
    keep = expected > 0.0
    statistic = ((observed - expected)[keep] ** 2 / expected[keep]).sum()
    p = stats.chi2.sf(statistic, keep.sum() - 1)
    assert p > 1.0 - (1.0 - SIGNIFICANCE) ** (1.0 / tests), f"chi-square {statistic:.1f} in {keep.sum()} cells, p = {p}"


# --- point sets -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SEQUENCES)
@pytest.mark.parametrize("count", COUNTS)
def test_sets_have_the_promised_shape_and_come_from_their_seed(name, count):
    points = point_set(name, count, 5)
    assert points.shape == (count, 2) and points.dtype == np.float64
    assert (points >= 0.0).all() and (points < 1.0).all()
    assert (points == point_set(name, count, np.random.default_rng(5))).all()
    assert (points != point_set(name, count, 6)).any()


@pytest.mark.parametrize("name", SEQUENCES)
@pytest.mark.parametrize("count", [1, 5, 16])
def test_each_point_alone_is_uniform(name, count):
    # One random member of each of 2,000 sets, in a 4 x 4 grid.
    rng = np.random.default_rng([count, list(SEQUENCES).index(name)])
    points = np.stack([point_set(name, count, rng) for _ in range(2000)])
    cells = (points * 4).astype(int) @ [4, 1]
    member = cells[np.arange(2000), rng.integers(0, count, 2000)]
    assert_distribution(np.bincount(member, minlength=16), np.full(16, 1 / 16), tests=3 * len(SEQUENCES))
    # The mean of f = x y over a set is unbiased: 1/4 within 4 standard errors.
    means = points.prod(axis=2).mean(axis=1)
    assert abs(means.mean() - 0.25) < 4.0 * means.std() / np.sqrt(2000) + 1e-12


@pytest.mark.parametrize("name", ["jittered", "uniform-jitter"])
@pytest.mark.parametrize("count", COUNTS)
def test_one_point_in_each_stratum(name, count):
    points = point_set(name, count, 1)
    corner, size = sequences._strata(count)
    assert np.allclose(size.prod(axis=1), 1.0 / count, rtol=1e-14)
    assert ((points >= corner) & (points < corner + size)).all()
    # The strata tile the square: no overlap, and areas that add up to 1.
    tiles = [box(*c, *(c + s)) for c, s in zip(corner, size, strict=True)]
    assert sum(t.area for t in tiles) == pytest.approx(1.0)
    assert all(a.intersection(b).area < 1e-12 for i, a in enumerate(tiles) for b in tiles[:i])
    place = (points - corner) / size
    assert np.allclose(place, place[0]) == (name == "uniform-jitter" or count == 1)


@pytest.mark.parametrize("count", COUNTS)
def test_n_rooks_and_multijitter_have_one_point_a_row_and_column(count):
    for sampler in (n_rooks, multijittered):
        cells = (sampler(count, 3) * count).astype(int)
        assert (np.sort(cells, axis=0) == np.arange(count)[:, None]).all()
    if count in (16, 36, 64):
        grid = (multijittered(count, 3) * np.sqrt(count)).astype(int)
        assert len({tuple(cell) for cell in grid}) == count


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("log2", [0, 1, 4, 7])
def test_scrambled_sobol_stays_a_net(log2, seed):
    # A (0, m, 2)-net: each of the 2^a x 2^b boxes of area 2^-m holds one point, before and after.
    count = 2**log2
    plain = sobol_bits(count) * 2.0**-32
    for points in (plain, sobol(count, seed), owen_sobol(3, count, seed)[2]):
        for a in range(log2 + 1):
            cells = (points * [2**a, 2 ** (log2 - a)]).astype(int)
            assert len({tuple(cell) for cell in cells}) == count


@pytest.mark.parametrize("count", [1, 2, 7, 64, 1000])
def test_sobol_bits_are_the_points_of_scipy(count):
    whole = 2 ** (count - 1).bit_length()
    theirs = (stats.qmc.Sobol(2, scramble=False, bits=32).random(whole) * 2.0**32).astype(np.uint32)
    ours = sobol_bits(whole)
    assert {tuple(p) for p in ours.tolist()} == {tuple(p) for p in theirs.tolist()}  # theirs in the order of Gray
    np.testing.assert_array_equal(ours[:count], sobol_bits(count))


@pytest.mark.parametrize("count", [16, 64, 256])
def test_scrambled_points_leave_less_error_past_edges_than_independent_ones_by_far(count):
    # Half planes over the square, as shadow edges cross a light: NOISE K^-3/4 bounds what is left.
    rng = np.random.default_rng(count)
    angle, place = rng.uniform(0, 2 * np.pi, 800), rng.random((800, 2))
    edge = np.column_stack([np.cos(angle), np.sin(angle)])
    level = (edge * place).sum(axis=1)
    few, many = (
        ((edge[:, None] * points).sum(axis=2) < level[:, None]).mean(axis=1)
        for points in (unit_samples(np.arange(800), count, 1), unit_samples(np.arange(800), 64 * count, 2))
    )
    off = np.sqrt(np.mean((few - many) ** 2))
    assert 0.15 * count**-0.75 < off < NOISE * count**-0.75


def test_owen_scramble_is_a_one_to_one_nested_permutation():
    rng = np.random.default_rng(0)
    bits = rng.integers(0, 2**32, 200, dtype=np.uint32)
    for seed in rng.integers(0, 2**32, 20, dtype=np.uint32):
        moved = np.array([owen_scramble(x, seed) for x in bits], dtype=np.uint32)
        assert len(set(moved)) == len(set(bits))
        for depth in (1, 2, 5, 9):
            # Points share their first digits after the scramble just where they did before.
            before, after = bits >> np.uint32(32 - depth), moved >> np.uint32(32 - depth)
            assert ((before[:, None] == before) == (after[:, None] == after)).all()
    # Each of the first digits turns in about half of the seeds.
    turned = [(int(owen_scramble(bits[0], hashed(i, 1) & np.uint64(0xFFFFFFFF))) ^ int(bits[0])) for i in range(4000)]
    for digit in range(32):
        share = np.mean([(t >> digit) & 1 for t in turned])
        assert abs(share - 0.5) < 4.5 * 0.5 / np.sqrt(4000)


def test_rows_have_sets_of_their_own_that_do_not_depend_on_blocks():
    base = point_set("r2", 8, 0)
    for make in (lambda n, first: owen_sobol(n, 8, 11, first), lambda n, first: shifted(base, n, 11, first)):
        whole = make(10, 0)
        assert (np.concatenate([make(4, 0), make(6, 4)]) == whole).all()
        assert len(np.unique(whole[:, 0, 0])) == 10
        assert (whole >= 0.0).all() and (whole < 1.0).all()
    moved = shifted(base, 2000, 3)
    # One toroidal shift a row; the shifts are uniform.
    step = (moved - base) % 1.0
    assert np.allclose(np.abs((step - step[:, :1] + 0.5) % 1.0 - 0.5), 0.0, atol=1e-12)
    cells = (step[:, 0] * 4).astype(int) @ [4, 1]
    assert_distribution(np.bincount(cells, minlength=16), np.full(16, 1 / 16))


def test_better_spread_sets_have_less_error():
    # Half-plane across the square at 30 degrees: RMS over 400 sets of 64; independent: 0.0625.
    rng = np.random.default_rng(8)
    normal = np.array([np.cos(0.5), np.sin(0.5)])
    errors = {}
    for name in SEQUENCES:
        inside = [(point_set(name, 64, rng) @ normal < 0.55).mean() for _ in range(400)]
        errors[name] = np.std(inside)
    assert errors["independent"] == pytest.approx(0.5 / 8, rel=0.15)
    for name in SEQUENCES:
        if name != "independent":
            # N-rooks strata lie along the axes only; a shared jitter moves all strata at an edge alike.
            assert errors[name] < (0.9 if name in ("n-rooks", "uniform-jitter") else 0.5) * errors["independent"], name


def test_bad_arguments_get_one_clear_line():
    with pytest.raises(InputError, match="sampler: found 'halton'"):
        point_set("halton", 4, 0)
    for name in SEQUENCES:
        for count in (0, -1, 2.5, True):
            with pytest.raises(InputError, match="count"):
                point_set(name, count, 0)
    with pytest.raises(InputError, match="points"):
        shifted([[0.5, 1.0]], 1, 0)
    with pytest.raises(InputError, match="rows"):
        owen_sobol(-1, 4, 0)
    for u in ([0.5], [[0.5, 1.5]], [[np.nan, 0.0]]):
        with pytest.raises(InputError, match="u: found"):
            warp.square_to_disk(u)
    with pytest.raises(InputError, match="zero area"):
        warp.square_to_polygon([0.5, 0.5], [[0, 0, 0], [1, 0, 0], [2, 0, 0]])


# --- warps: flat ------------------------------------------------------------------------------------

TRIANGLE = np.array([[0.1, 0.2], [0.9, 0.05], [0.4, 0.95]])
SHAPES = {
    "triangle": TRIANGLE,
    "parallelogram": np.array([[0.1, 0.1], [0.7, 0.2], [0.9, 0.8], [0.3, 0.7]]),
    "quad": np.array([[0.05, 0.1], [0.9, 0.3], [0.6, 0.9], [0.3, 0.8]]),
    "quad, clockwise": np.array([[0.05, 0.1], [0.9, 0.3], [0.6, 0.9], [0.3, 0.8]])[::-1],
    "hexagon with corners in a row": np.array([[0, 0], [0.5, 0], [1, 0], [1, 0.6], [0.5, 1], [0, 0.3]]),
    "sliver": np.array([[0, 0.5], [1, 0.5], [1, 0.5 + 2.0**-13]]),
}


def _flat(shape: str, u):
    corners = np.column_stack([SHAPES[shape], np.full(len(SHAPES[shape]), 2.0)])
    sampler = warp.square_to_triangle if len(corners) == 3 else warp.square_to_polygon
    return corners, sampler(u, corners)


@pytest.mark.parametrize("shape", SHAPES)
def test_flat_samples_follow_their_density(shape):
    corners, samples = _flat(shape, np.random.default_rng(2).random((40_000, 2)))
    polygon = Polygon(SHAPES[shape])
    density = warp.triangle_density if len(corners) == 3 else warp.polygon_density
    assert np.allclose(density(samples, corners), 1.0 / polygon.area, rtol=1e-11)
    assert (density(samples + [2.0, 0, 0], corners) == 0.0).all()
    assert np.allclose(samples[:, 2], 2.0, atol=1e-15)
    low, high = SHAPES[shape].min(axis=0), SHAPES[shape].max(axis=0)
    cells = 12
    edges = [np.linspace(low[k], high[k], cells + 1) for k in range(2)]
    observed = np.histogram2d(samples[:, 0], samples[:, 1], bins=edges)[0]
    expected = [
        [
            polygon.intersection(box(edges[0][i], edges[1][j], edges[0][i + 1], edges[1][j + 1])).area
            for j in range(cells)
        ]
        for i in range(cells)
    ]
    assert_distribution(
        observed[np.array(expected) > 1e-15], np.array(expected)[np.array(expected) > 1e-15], len(SHAPES)
    )


def test_disk_and_hemisphere_follow_their_density():
    u = np.random.default_rng(3).random((40_000, 2))
    flat = warp.square_to_disk(u)
    assert (warp.disk_density(flat) == 1.0 / np.pi).all()
    assert (warp.disk_density([[1.1, 0.0], [0.8, 0.8]]) == 0.0).all()
    angle = np.arctan2(flat[:, 1], flat[:, 0])
    # Rings of equal area and equal angles.
    observed = np.histogram2d((flat**2).sum(axis=1), angle, bins=[np.linspace(0, 1, 9), np.linspace(-np.pi, np.pi, 17)])
    assert_distribution(observed[0], np.ones((8, 16)), 2)
    directions = warp.square_to_cosine_hemisphere(u)
    assert np.allclose((directions**2).sum(axis=1), 1.0, atol=1e-14)
    cosine = directions[:, 2]
    assert np.allclose(warp.cosine_hemisphere_density(directions), cosine / np.pi, rtol=1e-15)
    assert warp.cosine_hemisphere_density([0, 0.6, -0.8]) == 0.0
    edges = np.linspace(0, 1, 11)
    observed = np.histogram2d(cosine, angle, bins=[edges, np.linspace(-np.pi, np.pi, 9)])[0]
    # The integral of cos/pi over a ring: cos_high^2 - cos_low^2.
    assert_distribution(observed, np.repeat(np.diff(edges**2)[:, None], 8, axis=1), 2)


# --- warps: on the sphere ---------------------------------------------------------------------------


def _sphere_cells(directions, cells: int):
    # Cells of equal solid angle: uniform in z and in longitude.
    z = np.clip((directions[..., 2] + 1.0) * 0.5 * cells, 0, cells - 1e-9).astype(int)
    phi = np.clip(
        (np.arctan2(directions[..., 1], directions[..., 0]) + np.pi) / (2 * np.pi) * 2 * cells, 0, 2 * cells - 1e-9
    )
    return z * 2 * cells + phi.astype(int)


def _fine_sphere(cells: int, fine: int):
    z = (np.arange(cells * fine) + 0.5) / (cells * fine) * 2 - 1
    phi = (np.arange(2 * cells * fine) + 0.5) / (2 * cells * fine) * 2 * np.pi - np.pi
    z, phi = (x.ravel() for x in np.meshgrid(z, phi, indexing="ij"))
    flat = np.sqrt(1 - z * z)
    return np.column_stack([flat * np.cos(phi), flat * np.sin(phi), z])


def _check_on_sphere(samples, density, tests):
    # Cells turned to no axis: the lattice would sample the edge of a polar cap one-sidedly.
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    cells, fine = 10, 60
    lattice = _fine_sphere(cells, fine)
    weight = density(lattice @ turn.T)
    expected = np.bincount(_sphere_cells(lattice, cells), weight, minlength=2 * cells * cells)
    # The density integrates to 1 over the sphere, up to the lattice.
    assert weight.mean() * 4 * np.pi == pytest.approx(1.0, rel=0.02)
    observed = np.bincount(_sphere_cells(samples @ turn, cells), minlength=2 * cells * cells)
    # Cells of which the lattice sees little count as one.
    seldom = expected < 0.05 * expected.max()
    together = [np.append(x[~seldom], x[seldom].sum()) for x in (observed, expected)]
    assert_distribution(*together, tests)


OCTANT = np.eye(3)
TRIANGLES = {
    "octant": OCTANT,
    "octant, other winding": OCTANT[::-1],
    "wide": np.array([[1, 0, 0.05], [-0.5, 0.85, 0.05], [-0.5, -0.85, 0.05]]),
    "long": np.array([[1, 0, 0.1], [-0.9, 0.4, 0.2], [0.1, 0.5, 0.9]]),
}


@pytest.mark.parametrize("name", TRIANGLES)
def test_spherical_triangle_follows_its_density(name):
    corners = TRIANGLES[name] / np.linalg.norm(TRIANGLES[name], axis=1)[:, None]
    samples = warp.square_to_spherical_triangle(np.random.default_rng(4).random((20_000, 2)), *corners)
    assert np.allclose((samples**2).sum(axis=1), 1.0, atol=1e-14)
    density = warp.spherical_triangle_density(samples, *corners)
    assert np.allclose(density, 1.0 / warp.solid_angle(*corners), rtol=1e-12)
    _check_on_sphere(samples, lambda d: warp.spherical_triangle_density(d, *corners), len(TRIANGLES) + 4)


@pytest.mark.parametrize("sine", [0.3, 0.9, 1.0])
@pytest.mark.parametrize("axis", [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.6, -0.64, 0.48]])
def test_cap_follows_its_density(axis, sine):
    samples = warp.square_to_cap(np.random.default_rng(5).random((20_000, 2)), axis, sine)
    assert np.allclose((samples**2).sum(axis=1), 1.0, atol=1e-14)
    assert (warp.cap_density(samples, axis, sine) > 0.0).all()
    _check_on_sphere(samples, lambda d: warp.cap_density(d, axis, sine), 13)
    # 1 - cos is uniform, and so is the longitude about the axis: the mean points along it.
    height = 1 - np.sqrt(1 - sine**2)
    assert (1 - samples @ axis).max() <= height * (1 + 1e-12)
    assert_distribution(np.histogram((1 - samples @ axis) / height, bins=20, range=(0, 1))[0], np.ones(20), 9)


def test_known_solid_angles():
    assert warp.solid_angle(*OCTANT) == pytest.approx(np.pi / 2, rel=1e-15)
    # Girard: three right angles but one of 60 degrees: the excess is 60 degrees.
    lune = np.array([[0, 0, 1], [1, 0, 0], [0.5, np.sqrt(0.75), 0]])
    assert warp.solid_angle(*lune) == pytest.approx(np.pi / 3, rel=1e-14)
    # Small: the plane area of the corners.
    for size in (1e-3, 1e-6, 1e-9):
        corners = np.array([[0, 0, 1], [size, 0, 1], [0, size, 1]])
        corners /= np.linalg.norm(corners, axis=1)[:, None]
        assert warp.solid_angle(*corners) == pytest.approx(size**2 / 2, rel=1e-6 + size)


@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_small_and_thin_spherical_triangles_keep_their_digits(seed):
    # The sub-triangle that u[0] cuts off has that share of the solid angle, down to 1e-14 sr.
    rng = np.random.default_rng(seed)
    a = rng.normal(size=3)
    edges = rng.normal(size=(2, 3)) * 10.0 ** rng.uniform(-6, 0, (2, 1))
    b, c = a + edges[0], a + edges[1]
    a, b, c = (x / np.linalg.norm(x) for x in (a, b, c))
    whole = warp.solid_angle(a, b, c)
    share = rng.random()
    # u[1] = 1 lies on the side a-c.
    cut = warp.square_to_spherical_triangle([share, 1.0], a, b, c)
    shortest = min(np.linalg.norm(a - b), np.linalg.norm(b - c), np.linalg.norm(c - a))
    longest = max(np.linalg.norm(a - b), np.linalg.norm(b - c), np.linalg.norm(c - a))
    rounding = 1e-15 * longest / max(whole, 1e-300) + 1e-14 * longest / shortest
    if rounding < 1e-3:
        assert warp.solid_angle(a, b, cut) == pytest.approx(share * whole, rel=10 * rounding / max(share, 1e-3))
    assert np.allclose(warp.square_to_spherical_triangle([0.0, 1.0], a, b, c), a, atol=1e-14)
    assert np.allclose(warp.square_to_spherical_triangle([1.0, 1.0], a, b, c), c, atol=1e-9)
    assert np.allclose(warp.square_to_spherical_triangle([0.3, 0.0], a, b, c), b, atol=1e-14)
