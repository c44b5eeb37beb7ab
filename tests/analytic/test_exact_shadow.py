"""Exact soft shadows: the sender cut by its occluders, against closed forms and against rays."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_scenes import FAR, UNIT_SQUARE_LIGHT, convex_light, geometry_of, nasty_polygons, rectangle, truth

from radiosity.form_factors.analytic import point_to_polygon
from workbench.accel.brute import BruteForce
from workbench.shadow.area import MAX_PIECES, cut_workspace, visible_share

UP = np.array([0.0, 0.0, 1.0])
LIGHT = UNIT_SQUARE_LIGHT


def unit_normal(ring):
    vector = 0.5 * np.cross(ring - ring[0], np.roll(ring, -1, axis=0) - ring[0]).sum(axis=0)
    return vector / np.linalg.norm(vector)


def visible(point, normal, sender, occluders, through=0.0):
    """Form factor to the visible part of a convex sender, and the number of its pieces."""
    sender = np.ascontiguousarray(sender, dtype=float)
    rings = [np.asarray(ring, dtype=float) for ring in occluders]
    corners = np.ascontiguousarray(np.concatenate(rings)) if rings else np.empty((0, 3))
    starts = np.concatenate([[0], np.cumsum([len(ring) for ring in rings])]).astype(np.int64)
    through = np.ascontiguousarray(np.broadcast_to(np.asarray(through, dtype=float), (len(rings),)))
    return visible_share(
        *np.asarray(point, dtype=float), *np.asarray(normal, dtype=float), sender, 0, len(sender), unit_normal(sender),
        corners, starts, through, np.arange(len(rings)), len(rings), *cut_workspace(),
    )  # fmt: skip


def share(*args, **options):
    value, pieces = visible(*args, **options)
    assert pieces >= 0
    return value


def half_plane(z, axis=0, edge=0.0, side=1):
    """The part of the plane z beyond ``edge`` on an axis, out to FAR."""
    low, high = [-FAR, -FAR], [FAR, FAR]
    (low if side > 0 else high)[axis] = edge
    return rectangle(low[0], high[0], low[1], high[1], z)


def lambert(point, ring):
    return point_to_polygon(point, UP, ring)[0]


# Closed forms


@pytest.mark.parametrize("side", [0.4, 1.5, 0.1])
@pytest.mark.parametrize("x", [0.0, 0.125, 0.3, 0.5, 0.75, 1.0, 1.3, 2.0, 3.0])
@pytest.mark.parametrize("y", [0.0, 0.2])
def test_square_over_square_is_the_light_less_its_covered_rectangle(side, x, y):
    # Seen from (x, y, 0) the occluder at half height covers a rectangle twice as large, moved by -(x, y).
    occluder = rectangle(-side / 2, side / 2, -side / 2, side / 2, 1.0)
    low = np.maximum([-side - x, -side - y], -0.5)
    high = np.minimum([side - x, side - y], 0.5)
    wanted = lambert([x, y, 0], LIGHT)
    if (low < high).all():
        wanted -= lambert([x, y, 0], rectangle(low[0], high[0], low[1], high[1], 2.0))
    for ring in (occluder, occluder[::-1], np.roll(occluder, 1, axis=0)):
        assert share([x, y, 0], UP, LIGHT, [ring]) == pytest.approx(wanted, abs=1e-13)


@pytest.mark.parametrize("height", [1e-9, 1e-6, 1e-3, 0.5, 1.0, 1.9, 2 - 1e-6])
@pytest.mark.parametrize("edge", [-0.4, -0.1, 0.0, 0.2])
def test_straight_edge_at_any_height(height, edge):
    # A half-plane x > edge at a height z covers x > 2 edge / z of the light.
    limit = np.clip(2 * edge / height, -0.5, 0.5)
    wanted = lambert([0, 0, 0], rectangle(-0.5, limit, -0.5, 0.5, 2.0)) if limit > -0.5 else 0.0
    assert share([0, 0, 0], UP, LIGHT, [half_plane(height, edge=edge)]) == pytest.approx(wanted, abs=1e-12)


@pytest.mark.parametrize(
    ("occluders", "left"),
    [
        ([half_plane(1.0), half_plane(1.5)], 0.5),  # the same half twice: union, not product
        ([half_plane(1.0), half_plane(1.0)], 0.5),
        ([half_plane(1.0), half_plane(1.0)[::-1]], 0.5),
        ([half_plane(1.0), half_plane(1.5, side=-1)], 0.0),  # complementary
        ([half_plane(1.0), half_plane(1.5, axis=1)], 0.25),  # crossed
        ([half_plane(1.0), half_plane(1.5, axis=1), half_plane(0.3, axis=1)], 0.25),
        ([rectangle(-FAR, FAR, -FAR, FAR, 1.0)], 0.0),
    ],
)
def test_half_planes(occluders, left):
    whole = lambert([0, 0, 0], LIGHT)
    for rings in (occluders, occluders[::-1], [ring[::-1] for ring in occluders]):
        assert share([0, 0, 0], UP, LIGHT, rings) == pytest.approx(left * whole, abs=1e-14)


@pytest.mark.parametrize("slats", [2, 5, 16])
def test_fence_is_the_sum_of_its_gaps(slats):
    # Slats at half height, duty 1/2, of a period of light / slats: shadows twice as wide.
    period = 1.0 / slats
    left = -0.5 + period * np.arange(slats)
    fence = [rectangle(a / 2, (a + period / 2) / 2, -FAR, FAR, 1.0) for a in left]
    wanted = sum(lambert([0, 0, 0], rectangle(a + period / 2, a + period, -0.5, 0.5, 2.0)) for a in left)
    found, pieces = visible([0, 0, 0], UP, LIGHT, fence)
    assert found == pytest.approx(wanted, abs=1e-13)
    assert pieces == slats


def test_panes_are_multiplied_and_counted_once_each():
    whole = lambert([0.2, 0, 0], LIGHT)
    full = [rectangle(-FAR, FAR, -FAR, FAR, z) for z in np.linspace(0.2, 1.8, 10)]
    assert share([0.2, 0, 0], UP, LIGHT, full[:3], through=0.5) == pytest.approx(0.125 * whole, rel=1e-13)
    assert share([0.2, 0, 0], UP, LIGHT, full, through=0.9) == pytest.approx(0.9**10 * whole, rel=1e-13)
    # A clear pane does nothing, an opaque sheet behind a pane everything.
    assert share([0.2, 0, 0], UP, LIGHT, full[:1], through=1.0) == pytest.approx(whole, rel=1e-13)
    assert share([0.2, 0, 0], UP, LIGHT, full[:2], through=[0.5, 0.0]) == 0.0
    # Half panes: 1/2 clear, 1/2 dimmed; crossed: quarters of 1, tau, tau and tau^2.
    assert share([0, 0, 0], UP, LIGHT, [half_plane(1.0)], through=0.5) == pytest.approx(
        0.75 * lambert([0, 0, 0], LIGHT), rel=1e-13
    )
    crossed = [half_plane(1.0), half_plane(1.5, axis=1)]
    assert share([0, 0, 0], UP, LIGHT, crossed, through=0.4) == pytest.approx(
        (1 + 0.4 + 0.4 + 0.16) / 4 * lambert([0, 0, 0], LIGHT), rel=1e-13
    )


@pytest.mark.parametrize(
    "occluder",
    [
        rectangle(-5, 5, -5, 5, 2.5),  # beyond the light
        rectangle(-5, 5, -5, 5, 2.0),  # in the light's plane
        rectangle(0.5, 5, -5, 5, 2.0),  # beside the light, in its plane
        rectangle(-5, 5, -5, 5, -0.5),  # behind the point
        rectangle(-5, 5, -5, 5, 0.0),  # in the receiver's plane
        np.array([[1, -0.2, 1], [1, 1, 1], [-0.2, 1, 1.0]]),  # outside the pyramid, outside no single plane
        np.array([[0, -1, 0.0], [0, 1, 0], [0, 1, 5], [0, -1, 5]]),  # edge on, through the point
        np.array([[-1, -1, 2], [1, -1, 2], [1, -1, 4], [-1, -1, 4.0]]),  # stands on the light's plane
        np.array([[0.5, -1, 0.0], [0.5, 1, 0], [0.5, 1, -3], [0.5, -1, -3]]),  # hangs below the receiver's plane
    ],
)
def test_what_cannot_block_changes_nothing(occluder):
    whole = lambert([0, 0, 0], LIGHT)
    for ring in (occluder, occluder[::-1]):
        assert share([0, 0, 0], UP, LIGHT, [ring]) == pytest.approx(whole, abs=1e-14)


def test_straddling_planes_count_only_between():
    # A wall x = 0.2 from far below to far above covers the light beyond the ray's x = 0.2 ... at its top
    # edge of the visible part, here all of x > 0.2.
    wall = np.array([[0.2, -9, -7], [0.2, 9, -7], [0.2, 9, 11], [0.2, -9, 11.0]])
    wanted = lambert([0, 0, 0], rectangle(-0.5, 0.2, -0.5, 0.5, 2.0))
    assert share([0, 0, 0], UP, LIGHT, [wall]) == pytest.approx(wanted, abs=1e-13)
    # A slope from the floor behind the point to above the light, over the point.
    slope = np.array([[-1, -9, -1], [-1, 9, -1], [3, 9, 3.5], [3, -9, 3.5]])
    at_light = -1 + 4 * 3 / 4.5  # where it pierces z = 2
    wanted = lambert([0, 0, 0], rectangle(at_light, 0.5, -0.5, 0.5, 2.0)) if at_light < 0.5 else 0.0
    assert share([0, 0, 0], UP, LIGHT, [slope]) == pytest.approx(wanted, abs=1e-13)


def test_contact_shadow_and_near_plane():
    # Failure modes 4.9 and 6.6: occluders very near the point.
    for height, half in ((1e-5, 0.25), (1e-3, 5e-4), (1e-8, 1.0)):
        assert share([0, 0, 0], UP, LIGHT, [rectangle(-half, half, -half, half, height)]) == 0.0


def test_a_light_across_the_horizon():
    # The light is a wall through the receiver's plane; the occluder hides its upper left quarter.
    light = np.array([[1, -1, -1], [1, -1, 1], [1, 1, 1], [1, 1, -1.0]])
    occluder = np.array([[0.5, 0, -2], [0.5, 2, -2], [0.5, 2, 2], [0.5, 0, 2.0]])
    whole = lambert([0, 0, 0], light)
    assert whole == pytest.approx(0.111468394005107, rel=1e-12)
    assert share([0, 0, 0], UP, light, []) == pytest.approx(whole, rel=1e-14)
    assert share([0, 0, 0], UP, light, [occluder]) == pytest.approx(whole / 2, rel=1e-13)


def test_in_or_behind_the_lights_plane():
    assert visible([0, 0, 2], UP, LIGHT, [half_plane(1.0)]) == (0.0, 0)
    assert visible([0, 0, 3], -UP, LIGHT, [half_plane(1.0)]) == (0.0, 0)
    values = [share([2, 0, 2 - d], [-1, 0, 0], LIGHT, [half_plane(-5.0)]) for d in (1e-12, 1e-6, 1e-3, 0.1)]
    assert np.isfinite(values).all() and (np.diff(values) > 0).all() and values[0] >= 0


def test_too_many_pieces_are_given_up_not_guessed():
    columns = int(np.sqrt(MAX_PIECES)) + 2
    grid = [
        rectangle(x, x + 0.3 / columns, y, y + 0.3 / columns, 1.0)
        for x in np.linspace(-0.24, 0.22, columns)
        for y in np.linspace(-0.24, 0.22, columns)
    ]
    assert visible([0, 0, 0], UP, LIGHT, grid)[1] == -1
    ring = np.array([[np.cos(a), np.sin(a), 1.0] for a in np.linspace(0, 2 * np.pi, 64, endpoint=False)])
    assert visible([0, 0, 0], UP, LIGHT, [0.1 * ring])[1] == -1


@pytest.mark.parametrize("shift", [1e3, 1e5])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_shift_and_scale(shift, scale):
    point, ring = np.array([0.3, 0.1, 0.0]), rectangle(-0.2, 0.2, -0.2, 0.2, 1.0)
    wanted = share(point, UP, LIGHT, [ring])
    found = share((point + shift) * scale, UP, (LIGHT + shift) * scale, [(ring + shift) * scale])
    assert found == pytest.approx(wanted, abs=1e-15 * shift * 10)


# Shared truths


def _compare(points, wanted, occluders):
    for point, value in zip(points, wanted, strict=True):
        assert np.pi * share(point, UP, LIGHT, occluders) == pytest.approx(value, abs=1e-9 * 0.2308)


@pytest.mark.parametrize(("name", "side"), [("row-a=1.5", 1.5), ("row-a=0.4", 0.4)])
def test_truth_squares(name, side):
    wanted = truth(f"shadow/square/{name}")
    xs = np.arange(len(wanted)) / 8
    occluder = rectangle(-side / 2, side / 2, -side / 2, side / 2, 1.0)
    _compare([[x, 0, 0] for x in xs], wanted, [occluder])


def test_truth_square_on_the_diagonal():
    wanted = truth("shadow/square/diagonal-a=1.5")
    occluder = rectangle(-0.75, 0.75, -0.75, 0.75, 1.0)
    _compare([[x / 8, x / 8, 0] for x in range(len(wanted))], wanted, [occluder])


def test_truth_straight_edge():
    wanted = truth("shadow/straight-edge/profile")
    xs = np.linspace(-0.6, 0.6, len(wanted))
    # The truth's half-plane has no end; FAR leaves nothing of the light beside it.
    _compare([[x, 0, 0] for x in xs], wanted, [half_plane(1.0)])


def test_truth_area_fraction_is_not_irradiance():
    light = np.array([[0, -2, 1], [0, 2, 1], [4, 2, 1], [4, -2, 1.0]])
    wanted = truth("fail/area-fraction-is-not-irradiance")[0]
    occluder = half_plane(0.5, edge=0.5, side=-1)
    assert share([0, 0, 0], UP, light, [occluder]) / lambert([0, 0, 0], light) == pytest.approx(wanted, rel=1e-12)


# Against rays


def _sampled(rng, point, normal, sender, polygons, count):
    """Estimate of the visible share by ``count`` rays, its standard error, and the rays' weights."""
    fan = np.array([[sender[0], sender[k], sender[k + 1]] for k in range(1, len(sender) - 1)])
    area = 0.5 * np.linalg.norm(np.cross(fan[:, 1] - fan[:, 0], fan[:, 2] - fan[:, 0]), axis=1)
    chosen = fan[rng.choice(len(fan), count, p=area / area.sum())]
    s, t = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    target = (1 - s) * chosen[:, 0] + s * (1 - t) * chosen[:, 1] + s * t * chosen[:, 2]
    along = target - point
    square = (along**2).sum(axis=1)
    face = unit_normal(sender)
    weight = np.maximum(along @ normal, 0) * np.maximum(-(along @ face), 0) / (np.pi * square**2) * area.sum()
    blocked = BruteForce(geometry_of(polygons)).occluded(point, along, 1.0) if polygons else np.zeros(count, bool)
    value = np.where(blocked, 0.0, weight)
    return value.mean(), value.std() / np.sqrt(count), weight


@settings(max_examples=60, deadline=None, derandomize=True)  # statistics: the same scenes each time
@given(seed=st.integers(0, 2**32 - 1))
def test_agrees_with_rays_through_any_occluders(seed):
    rng = np.random.default_rng(seed)
    sender = convex_light(rng)
    point = rng.choice([0.0, 0.25, 0.5, 1.0], 3) if rng.random() < 0.4 else rng.uniform(-1.0, 2.0, 3)
    if (point - sender[0]) @ unit_normal(sender) < 0:
        sender = sender[::-1].copy()
    normal = sender.mean(axis=0) - point + rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    polygons = nasty_polygons(rng, rng.integers(0, 7), np.concatenate([sender, point[None]]))
    # In the planes of receiver and sender, too.
    polygons += [p - ((p - point) @ normal)[:, None] * normal for p in polygons[:1] if rng.random() < 0.3]
    face = unit_normal(sender)
    polygons += [p - ((p - sender[0]) @ face)[:, None] * face for p in polygons[:1] if rng.random() < 0.3]
    polygons = [p for p in polygons if np.linalg.norm(np.cross(p[1] - p[0], p[2] - p[0])) > 1e-12]
    found, pieces = visible(point, normal, sender, polygons)
    if pieces < 0:
        return
    whole = share(point, normal, sender, [])
    count = 4000
    estimate, error, weight = _sampled(rng, point, normal, sender, polygons, count)
    if (weight > 0).sum() < 50:
        return  # hardly anything of the sender above the horizon: nothing to judge by
    # Five standard errors, and a handful of rays' weight: what few rays pass has no spread to judge by.
    assert abs(found - estimate) < 5 * error + 8 * weight.max() / count + 1e-9
    assert -1e-15 <= found <= whole * (1 + 1e-12) + 1e-15
    # Winding, order and repetition of the occluders mean nothing.
    turned = [p[::-1] if rng.random() < 0.5 else np.roll(p, 1, axis=0) for p in polygons]
    for others in (turned, polygons[::-1], [*polygons, *polygons[:2]]):
        again, pieces = visible(point, normal, sender, others)
        assert pieces < 0 or again == pytest.approx(found, abs=1e-10 * whole + 1e-14)
    # One occluder more never lets more through.
    for k in range(len(polygons)):
        fewer, pieces = visible(point, normal, sender, polygons[:k] + polygons[k + 1 :])
        assert pieces < 0 or fewer >= found - 1e-10 * whole - 1e-14
