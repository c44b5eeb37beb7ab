"""Lines over a sender, cut by silhouettes: the same share as the exact cut, whatever the occluders are."""

from __future__ import annotations

import math

import numpy as np
import pytest
from broken_kernels import break_kernel
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_scenes import (
    UNIT_SQUARE_LIGHT,
    box_triangles,
    geometry_of,
    nasty_polygons,
    rectangle,
)

from workbench.geometry.tessellation import sphere_mesh
from workbench.shadow import occlusion, silhouette
from workbench.shadow.occlusion import PILOT_POINTS, PILOT_RAYS, AreaLight, OcclusionState, Shader
from workbench.shadow.silhouette import EdgeTable, SenderFrame

UP = np.array([0.0, 0.0, 1.0])
SQUARE = AreaLight(UNIT_SQUARE_LIGHT, np.ones(1))
L_SHAPE = np.array([[-1, -1, 2], [-1, 1, 2], [0, 1, 2], [0, 0, 2], [1, 0, 2], [1, -1, 2.0]])
DARK, LIT, COMPLEX = OcclusionState.INSHADOW, OcclusionState.NOT_INSHADOW, OcclusionState.COMPLEX_SHADOW


def leave_all_to_lines(patch):
    """``auto`` cuts no list, however short, and finds rays dear."""
    for name, value in (("CUT_LIMIT", 0), ("LIST_LIMIT", 0), ("CROWD_LIMIT", 0), ("RAY_NS", 1e12)):
        patch.setattr(occlusion, name, value)


@pytest.fixture
def only_lines(monkeypatch):
    leave_all_to_lines(monkeypatch)


def torus_triangles(radius, tube, steps, centre, turn):
    """A closed torus (t, 3, 3) of 2 steps^2 triangles about an axis turned by ``turn`` from z."""
    u, v = np.meshgrid(np.arange(steps) * math.tau / steps, np.arange(steps) * math.tau / steps, indexing="ij")
    ring = radius + tube * np.cos(v)
    vertex = np.stack([ring * np.cos(u), ring * np.sin(u), tube * np.sin(v)], axis=-1)
    c, s = math.cos(turn), math.sin(turn)
    vertex = vertex @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T + centre
    a, b = np.roll(vertex, -1, 0), np.roll(vertex, -1, 1)
    both = np.roll(vertex, (-1, -1), (0, 1))
    return np.concatenate([np.stack([vertex, a, both], 2), np.stack([vertex, both, b], 2)]).reshape(-1, 3, 3)


def ball(centre, radius, error=0.02):
    vertices, faces, _, _ = sphere_mesh(centre, radius, error)
    return vertices[faces]


def sheet(rng, steps, height):
    """An open wavy sheet of triangles."""
    x, y = np.meshgrid(np.linspace(-0.7, 0.6, steps), np.linspace(-0.5, 0.8, steps), indexing="ij")
    grid = np.stack([x, y, height + 0.1 * np.sin(4 * x + rng.uniform(0, 6)) * np.cos(3 * y)], axis=-1)
    quads = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2).reshape(-1, 4, 3)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def compare(shader, points, normals, light, far=False, **options):
    """Hold ``auto`` by lines against exact cuts; returns (error / standard error) where lines were drawn."""
    exact = shader.estimate(points, normals, light, "exact", **options)
    found = shader.estimate(points, normals, light, "auto", error=1e-3, **options)
    assert found.counters["rays"] <= 4 * PILOT_RAYS * min(len(points), 2 * PILOT_POINTS)  # four pieces of a light
    state, whole = found.state[:, 0], exact.open_share[:, 0]
    gap = np.abs(found.visible_share - exact.visible_share)[:, 0]
    doubt = np.hypot(found.standard_error, exact.standard_error)[:, 0] / math.pi
    # Far from the origin the coordinates are rounded to 1e-11.
    rounding = 1e-9 * np.maximum(whole, 1e-30) + (1e-6 * whole if far else 0.0)
    assert (gap <= np.where(state == COMPLEX, 6 * doubt, exact.standard_error[:, 0]) + rounding).all()
    np.testing.assert_array_equal(found.visible_share[state == LIT], exact.open_share[state == LIT])
    assert not found.visible_share[state == DARK].any()
    drawn = (state == COMPLEX) & (gap > rounding)
    return gap[drawn] / doubt[drawn]


def nasty(seed, count, far, turned, concave):
    """Slivers, coplanar, touching, straddling and far-away polygons before a light, and six sensors."""
    rng = np.random.default_rng(seed)
    shift = far * np.array([1.0, -1.0, 0.5])
    light = (L_SHAPE if concave else UNIT_SQUARE_LIGHT) * [1, -1 if turned else 1, 1] + [0.25, 0.5, 0.0]
    light = light[::-1] if turned else light
    points = np.column_stack([rng.choice([0.0, 0.25, 0.5, 1.0, rng.uniform(-1, 2)], (6, 2)), np.zeros(6)])
    polygons = nasty_polygons(rng, count, np.concatenate([light, points]))
    polygons = [polygon for polygon in polygons if np.abs(polygon).max() < 300.0]
    geometry = geometry_of(*[[polygon + shift] for polygon in polygons], [rectangle(60, 61, 60, 61, -60) + shift])
    return Shader(geometry, 1), points + shift, AreaLight(light + shift, np.ones(1))


@settings(max_examples=200, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(1, 12),
    far=st.sampled_from([0.0, 0.0, 1e5]),
    turned=st.booleans(),
    concave=st.booleans(),
)
def test_lines_agree_with_exact_cuts_past_nasty_polygons(seed, count, far, turned, concave):
    with pytest.MonkeyPatch.context() as patch:
        leave_all_to_lines(patch)
        shader, points, light = nasty(seed, count, far, turned, concave)
        compare(shader, points, UP, light, far > 0.0)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("_cross", "change = -change", "change = change"),  # falling edges count as rising ones
        ("_cross", "onward[a] += change", "onward[a] += 0"),  # what covers the whole line is forgotten
        ("_face", "1 if off > 0.0", "1 if off < 0.0 and c > 0"),  # the side of a piece
        ("_misses", "max(reach[a, 3], reach[b, 3])", "min(reach[a, 2], reach[b, 2])"),  # how far up an edge is seen
        ("_misses", ">= ring_box[1, 0]", "<= ring_box[0, 0]"),  # the side on which edges may be dropped
        ("_reaches", "max(ax, bx) <= ring_box[0, 0]", "max(ax, bx) <= ring_box[1, 0]"),  # what meets the sender
        ("_inside", "if not outside:", "if outside:"),  # what of it may lie before the sender
        ("_loose_ring", "-top, 0.0", "-0.9 * top, 0.0"),  # what lies close to the receiver
    ],
)  # fmt: skip
def test_the_law_of_lines_notices_a_broken_kernel(monkeypatch, only_lines, name, old, new):
    break_kernel(monkeypatch, silhouette, name, old, new)
    with pytest.raises(AssertionError):
        for seed in range(60):
            shader, points, light = nasty(seed, 8, 0.0, False, False)
            compare(shader, points, UP, light)
        rng = np.random.default_rng(0)
        leaves = [rng.uniform([-0.5, -0.5, 0.5], [0.5, 0.5, 1.5]) + 0.01 * rng.normal(size=(3, 3)) for _ in range(8)]
        compare(Shader(geometry_of(leaves), 1), rng.uniform([-1, -1, 0], [1, 1, 0], (60, 3)), UP, SQUARE)
        floor = np.array([[0.2, 0.1, 0.0], [0.5, 0.0, 0.0]])
        wall = np.array([[-5, 0.3, 0], [5, 0.3, 0], [5, 0.3, 0.15], [-5, 0.3, 0.15]])
        compare(
            Shader(geometry_of([wall], list(box_triangles([-0.3, 0.01, 0], [0.4, 0.6, 1.0], 2))), 1), floor, UP, SQUARE
        )


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_union_of_overlapping_tessellated_occluders(seed):
    # Balls, tori and open sheets through one another, some of them twice: what one hides is hidden once.
    rng = np.random.default_rng(seed)
    parts = [
        ball(rng.uniform([-0.6, -0.6, 0.5], [0.6, 0.6, 1.5]), 0.3, 0.05),
        ball(rng.uniform([-0.6, -0.6, 0.5], [0.6, 0.6, 1.5]), 0.25, 0.05),
        torus_triangles(0.4, 0.15, 8, rng.uniform([-0.3, -0.3, 0.8], [0.3, 0.3, 1.2]), rng.uniform(0, 3)),
        sheet(rng, 5, rng.uniform(0.4, 1.6)),
    ]
    triangles = np.concatenate([parts[i] for i in rng.choice(4, 3)])
    flipped = rng.random(len(triangles)) < 0.5  # wound as they come
    triangles[flipped] = triangles[flipped][:, ::-1]
    points = np.column_stack([rng.uniform(-1.2, 1.2, (40, 2)), np.zeros(40)])
    with pytest.MonkeyPatch.context() as patch:
        leave_all_to_lines(patch)
        compare(Shader(geometry_of(list(triangles)), 1), points, UP, SQUARE)


def test_sensors_on_the_tessellated_surface_itself(only_lines):
    # Many tiles, each with points of several polygons: none is shadowed by its own.
    triangles = torus_triangles(0.6, 0.25, 24, [0, 0, 0.9], 1.3)
    geometry = geometry_of(list(triangles))
    rng = np.random.default_rng(2)
    own = rng.integers(0, len(triangles), 600)
    points = np.einsum("ij,ijk->ik", rng.dirichlet(np.ones(3), 600), triangles[own])
    shader = Shader(geometry, 1)
    outward = geometry.polygon_normal[own]
    z = compare(shader, points, outward, SQUARE, own_polygon=own)
    assert len(z) > 20


def test_contact_shadow_of_a_tessellated_box_on_the_floor(only_lines):
    # fail/contact-shadow: a lid 1e-5 above the floor hides all; its walls cross the height of the sensors.
    lid = box_triangles([-3, -3, 1e-5], [3, 3, 0.5], 4)
    room = box_triangles([-3, -3, -0.3], [3, 3, 0.5], 4)
    for triangles in (lid, room):
        found = Shader(geometry_of(list(triangles)), 1).estimate([[0.1, 0.2, 0.0]], UP, SQUARE, "auto")
        assert found.visible_share[0, 0] == 0.0
        assert found.state[0, 0] == DARK


@pytest.mark.parametrize("normal", [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.9, 0.1, -0.2]])
def test_occluders_across_the_horizon_and_the_plane_of_the_light(only_lines, normal):
    # Tori through the floor and through the light: only what lies between hides.
    triangles = np.concatenate(
        [torus_triangles(0.5, 0.2, 12, [0, 0, 0.1], 0.9), torus_triangles(0.4, 0.15, 12, [0.3, 0.1, 2.0], 0.5)]
    )
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-1.0, 1.0, (60, 2)), np.zeros(60)])
    compare(Shader(geometry_of(list(triangles)), 1), points, np.array(normal), SQUARE)


def test_stated_errors_are_honest(only_lines):
    rng = np.random.default_rng(5)
    leaves = [rng.uniform([-0.8, -0.8, 0.5], [0.8, 0.8, 1.5]) + 0.06 * rng.normal(size=(3, 3)) for _ in range(60)]
    points = np.column_stack([rng.uniform(-1.5, 1.5, (400, 2)), np.zeros(400)])
    for triangles in (leaves, list(ball([0.1, 0, 1.0], 0.35)), list(torus_triangles(0.5, 0.2, 16, [0, 0, 0.9], 0.5))):
        shader = Shader(geometry_of(triangles), 1)
        exact = shader.estimate(points, UP, SQUARE, "exact").irradiance[:, 0]
        for error in (0.03, 0.005):
            found = shader.estimate(points, UP, SQUARE, "auto", error=error)
            drawn = found.state[:, 0] == COMPLEX
            z = (found.irradiance[:, 0] - exact)[drawn] / found.standard_error[drawn, 0]
            assert (np.abs(z) > 3).mean() < 0.03
            assert 0.3 < np.sqrt((z**2).mean()) < 1.3
            assert np.sqrt(np.mean((found.irradiance[:, 0] - exact) ** 2)) <= error * exact.mean()


def test_lines_average_to_the_exact_share_and_their_error_falls(only_lines):
    # 300 points at one place draw their lines at 300 offsets.
    shader = Shader(geometry_of(list(torus_triangles(0.5, 0.2, 16, [0, 0, 0.9], 0.5))), 1)
    points = np.repeat([[0.3, 0.1, 0.0]], 300, axis=0)
    exact = shader.estimate(points[:1], UP, SQUARE, "exact").irradiance[0, 0]
    scatter = []
    for error in (0.1, 0.01, 0.001):
        found = shader.estimate(points, UP, SQUARE, "auto", error=error)
        gap = found.irradiance[:, 0] - exact
        # No more lines are drawn at offsets that look sure: a bias at a place, below the asked error.
        assert abs(gap.mean()) < 4 * gap.std(ddof=1) / math.sqrt(300) + error * exact
        scatter.append((found.counters["sender_lines"] / 300, gap.std(ddof=1)))
    lines, spread = np.log(np.array(scatter)).T
    # Lines at even distances past corners: -3/2.
    assert np.polyfit(lines, spread, 1)[0] < -1.2


# ---- the table of edges ---------------------------------------------------------------------------


def test_edges_of_a_closed_box_are_shared_by_two_pieces():
    edges = EdgeTable.build(geometry_of(list(box_triangles([0, 0, 0], [1, 1, 1]))))
    # Euler: V - E + F = 2 with 8 corners and 12 triangles.
    assert len(edges.place) == 8
    assert len(edges.ends) == 18
    assert (edges.piece >= 0).all()
    assert (np.abs(edges.turn) == 1).all()
    assert np.bincount(edges.piece.ravel(), minlength=12).tolist() == [3] * 12


def test_pieces_of_an_oriented_surface_run_against_each_other_along_their_edges():
    edges = EdgeTable.build(geometry_of(list(torus_triangles(0.5, 0.2, 6, [0, 0, 0], 0.3))))
    # V - E + F = 0 with F = 72 triangles.
    assert (len(edges.place), len(edges.ends)) == (36, 108)
    assert (edges.turn.sum(axis=1) == 0).all()


def test_edges_of_fins_cracks_and_negative_zeros():
    fin = [np.array([[0, 0, 0], [1, 0, 0], tip], float) for tip in ([0, 1, 0], [0, 0, 1], [0, -1, -0.0])]
    edges = EdgeTable.build(geometry_of(fin))
    # Three pieces on the edge from (0, 0, 0) to (1, 0, 0): two rows, and six edges of one piece.
    assert len(edges.ends) == 8
    assert len(edges.place) == 5
    assert np.bincount(edges.piece[edges.piece >= 0], minlength=3).tolist() == [3, 3, 3]
    assert ((edges.piece < 0) == (edges.turn == 0)).all()


def test_frame_keeps_distances_and_puts_the_sender_in_the_plane():
    geometry = geometry_of(list(ball([0.1, 0.2, 1.0], 0.3)))
    edges = EdgeTable.build(geometry)
    ring = np.array([[0, 0, 2], [0, 1, 2.5], [2, 1, 2.5], [2, 0, 2.0]])
    normal = np.cross(ring[1] - ring[0], ring[2] - ring[0])
    normal /= np.linalg.norm(normal)
    frame = SenderFrame.build(geometry, edges, ring, normal)
    np.testing.assert_allclose(frame.axes @ frame.axes.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(frame.axes) == pytest.approx(1.0)
    np.testing.assert_allclose(frame.place[:, 2], (edges.place - ring[0]) @ normal, atol=1e-12)
    np.testing.assert_allclose(frame.height[:, 0], frame.place[edges.vertex, 2].reshape(-1, 3).min(axis=1))
