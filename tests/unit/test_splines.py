"""Rational B-spline surfaces against circles, tori and spheres, whose answers are closed forms."""

from collections import Counter

import numpy as np
import pytest

from workbench.errors import InputError
from workbench.geometry.splines import (
    RationalSurface,
    clamped_knots,
    evaluate,
    facet_error,
    surface_of_revolution,
    tessellate,
    torus,
)


def _half_edges(faces):
    return Counter((int(a), int(b)) for face in faces for a, b in zip(face, np.roll(face, -1), strict=True))


def _is_watertight(faces):
    edges = _half_edges(faces)
    return all(count == 1 and edges[(b, a)] == 1 for (a, b), count in edges.items())


def _area(vertices, faces):
    tri = vertices[faces]
    return 0.5 * np.linalg.norm(np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0]), axis=1).sum()


def _volume(vertices, faces):
    tri = vertices[faces]
    return np.einsum("ij,ij->", tri[:, 0], np.cross(tri[:, 1], tri[:, 2])) / 6


def _sphere(radius=1.0):
    # Half a circle from the south pole over the equator to the north pole, as two exact quarters.
    profile = radius * np.array([[0, -1], [1, -1], [1, 0], [1, 1], [0, 1]], dtype=float)
    return surface_of_revolution(
        profile, degree=2, knots=[0, 0, 0, 0.5, 0.5, 1, 1, 1], weights=[1, np.sqrt(0.5), 1, np.sqrt(0.5), 1]
    )


def test_torus_points_lie_on_the_implicit_torus():
    u, v = np.linspace(0, 1, 37), np.linspace(0, 1, 29)
    points, du, dv = evaluate(torus(2.0, 0.5), u, v)
    ring = np.hypot(points[..., 0], points[..., 1])
    assert np.abs((ring - 2.0) ** 2 + points[..., 2] ** 2 - 0.25).max() < 1e-14
    normal = np.cross(du, dv)
    outward = points - 2.0 * np.stack([points[..., 0] / ring, points[..., 1] / ring, 0 * ring], axis=-1)
    cosine = np.einsum("abi,abi->ab", normal, outward) / np.linalg.norm(normal, axis=2) / 0.5
    assert np.abs(cosine - 1).max() < 1e-12


def test_derivatives_agree_with_differences():
    rng = np.random.default_rng(5)
    surface = RationalSurface(
        (3, 2),
        (clamped_knots(6, 3), clamped_knots(5, 2)),
        rng.normal(size=(6, 5, 3)),
        rng.uniform(0.5, 2.0, size=(6, 5)),
    )
    u, v, step = np.array([0.21, 0.52]), np.array([0.11, 0.77]), 1e-6
    _, du, dv = evaluate(surface, u, v)
    by_u = (evaluate(surface, u + step, v)[0] - evaluate(surface, u - step, v)[0]) / (2 * step)
    by_v = (evaluate(surface, u, v + step)[0] - evaluate(surface, u, v - step)[0]) / (2 * step)
    assert np.allclose(du, by_u, atol=1e-7)
    assert np.allclose(dv, by_v, atol=1e-7)


def test_torus_mesh_is_watertight_and_its_area_and_volume_converge_by_the_square():
    errors = []
    for count in (32, 64):
        vertices, faces, normals = tessellate(torus(2.0, 0.5), count, count)
        assert _is_watertight(faces)
        assert len(vertices) == count * count
        assert len(faces) == 2 * count * count
        assert np.allclose(np.linalg.norm(normals, axis=1), 1)
        # Area 4 pi^2 R r, volume 2 pi^2 R r^2, positive because faces run outward.
        errors.append(
            (1 - _area(vertices, faces) / (4 * np.pi**2), 1 - _volume(vertices, faces) / (2 * np.pi**2 * 2.0 * 0.25))
        )
    errors = np.array(errors)
    assert (errors > 0).all()
    assert np.allclose(errors[0] / errors[1], 4, rtol=0.05)
    assert errors[1].max() < 0.006


def test_poles_become_single_vertices_with_exact_normals():
    vertices, faces, normals = tessellate(_sphere(3.0), 24, 12)
    assert _is_watertight(faces)
    assert len(vertices) == 24 * 11 + 2
    assert len(faces) == 2 * 24 * 10 + 2 * 24
    assert np.allclose(np.linalg.norm(vertices, axis=1), 3.0, atol=1e-13)
    assert np.allclose(normals, vertices / 3.0, atol=1e-6)
    assert _volume(vertices, faces) == pytest.approx(4 / 3 * np.pi * 27, rel=0.03)


def test_a_crease_at_a_knot_stays_an_edge():
    # A straight cone frustum, then a flat lid: degree 1, the corner of the profile lies at v = 1/2.
    surface = surface_of_revolution([[2.0, 0.0], [1.0, 1.0], [0.0, 1.0]], degree=1)
    vertices, faces, _ = tessellate(surface, 16, 3)  # 3 rounds up to 4: two a span
    assert len(np.unique(np.round(vertices[:, 2], 12))) == 3
    rim = np.isclose(vertices[:, 2], 1.0) & np.isclose(np.hypot(vertices[:, 0], vertices[:, 1]), 1.0)
    assert rim.sum() == 16
    tri = vertices[faces]
    assert (np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0])[:, 2] > 0).all()


def test_an_open_patch_is_not_welded():
    grid = np.stack(np.meshgrid(np.arange(4.0), np.arange(4.0), [0.0], indexing="ij"), axis=-1)[:, :, 0]
    surface = RationalSurface((3, 3), (clamped_knots(4, 3), clamped_knots(4, 3)), grid, np.ones((4, 4)))
    vertices, faces, normals = tessellate(surface, 5, 3)
    assert len(vertices) == 24
    assert len(faces) == 30
    assert _area(vertices, faces) == pytest.approx(9.0, rel=1e-12)
    assert np.allclose(normals, [0, 0, 1])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"degree": (4, 1)}, "degree 4 with 4 points"),
        ({"knots": (np.arange(5.0), clamped_knots(2, 1))}, "5 knots in u, expected points"),
        ({"knots": (clamped_knots(4, 3)[::-1].copy(), clamped_knots(2, 1))}, "knots in u that decrease"),
        ({"weights": np.zeros((4, 2))}, "weight that is not > 0"),
        ({"weights": np.ones((4, 3))}, "weights (4, 3)"),
    ],
)
def test_parts_that_do_not_fit_are_refused(change, words):
    parts = {
        "degree": (3, 1),
        "knots": (clamped_knots(4, 3), clamped_knots(2, 1)),
        "control": np.random.default_rng(1).normal(size=(4, 2, 3)),
        "weights": np.ones((4, 2)),
    }
    RationalSurface(**parts)
    with pytest.raises(InputError) as caught:
        RationalSurface(**{**parts, **change})
    assert words in str(caught.value)


def test_a_surface_without_area_is_refused():
    flat = RationalSurface((1, 1), (clamped_knots(2, 1), clamped_knots(2, 1)), np.zeros((2, 2, 3)), np.ones((2, 2)))
    with pytest.raises(InputError, match="zero area"):
        tessellate(flat, 2, 2)
    with pytest.raises(InputError, match="tube"):
        torus(1.0, 1.5)


def test_facet_error_is_the_sagitta_and_falls_by_the_square():
    # A cylinder of radius 2: the error is the sagitta of its chords, r (1 - cos(pi / n)), to the
    # extent that the rational circle's parameter is uneven inside each quarter.
    cylinder = surface_of_revolution([[2.0, 0.0], [2.0, 1.0]], degree=1)
    errors = [facet_error(cylinder, count, 1) for count in (16, 32, 64)]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.05)
    vertices, _, _ = tessellate(cylinder, 64, 1)
    rim = vertices[np.isclose(vertices[:, 2], 0)]
    turn = np.sort(np.arctan2(rim[:, 1], rim[:, 0]))
    longest = np.diff(np.append(turn, turn[0] + 2 * np.pi)).max()
    assert errors[2] == pytest.approx(2.0 * (1 - np.cos(longest / 2)), rel=0.02)
