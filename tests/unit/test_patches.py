"""Patches and elements: areas add up, patches are tiled by their elements, counts come out as asked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely
from radiosity_scenes import polygon_scene, standing_box
from scipy.spatial import cKDTree

from radiosity.patches import build_mesh, forecast_elements
from workbench.errors import OptionError
from workbench.geometry.flat import Geometry
from workbench.geometry.polygons import plane_basis, vector_area
from workbench.scene.library import box_surface, diffuse, sphere_surface, torus_knot_mesh
from workbench.scene.load import load
from workbench.scene.model import Scene, Surface

QUAD = np.array([[0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 2, 0.0]])
KITE = np.array([[0, 0, 1], [2, 0.3, 1], [2.5, 1.9, 1], [-0.2, 1.1, 1.0]])
TRIANGLE = np.array([[0, 0, 0], [2, 0, 1], [0.3, 1.5, 2.0]])
PENTAGON = np.array([[np.cos(a), np.sin(a), 0.5 * np.cos(a)] for a in np.arange(5) * (2 * np.pi / 5)])
ELL = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 3, 0], [0, 3, 0.0]])
COMB = np.array(
    [[0, 0, 0], [5, 0, 0], [5, 2, 0], [4, 2, 0], [4, 1, 0], [3, 1, 0], [3, 2, 0], [2, 2, 0], [2, 1, 0], [0, 1, 0.0]]
)
FRAME = [QUAD, np.array([[1, 0.5, 0], [1, 1.5, 0], [2, 1.5, 0], [2, 0.5, 0.0]])]

SHAPES = {
    "quad": QUAD, "kite": KITE, "triangle": TRIANGLE, "pentagon": PENTAGON, "L": ELL, "comb": COMB, "frame": FRAME,
    "needle": np.array([[0, 0, 0], [10, 0, 0], [10, 1e-3, 0.0]]), "strip": QUAD * [100, 1e-2, 1],
    "tilted L": ELL @ np.linalg.qr(np.arange(9.0).reshape(3, 3) + np.eye(3))[0].T + 7.0,
}  # fmt: skip
each_shape = pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)


def mesh_of(scene, **options):
    geometry = Geometry.from_scene(scene)
    return geometry, build_mesh(scene, geometry, **options)


def pieces(mesh, element):
    a, b = mesh.element_piece[element : element + 2]
    return [mesh.corners[mesh.piece_start[i] : mesh.piece_start[i + 1]] for i in range(a, b)]


def senders(mesh, patch):
    a, b = mesh.patch_sender[patch : patch + 2]
    return [mesh.sender_corners[mesh.sender_start[i] : mesh.sender_start[i + 1]] for i in range(a, b)]


def flat_union(rings, origin, u, v):
    return shapely.union_all([shapely.Polygon(np.column_stack([(r - origin) @ u, (r - origin) @ v])) for r in rings])


def check_layout(mesh):
    """What every mesh promises of its arrays."""
    n, q = mesh.element_count, mesh.patch_count
    assert mesh.patch_start[0] == 0 and mesh.patch_start[-1] == n and (np.diff(mesh.patch_start) > 0).all()
    assert (mesh.element_patch == np.repeat(np.arange(q), np.diff(mesh.patch_start))).all()
    assert (np.diff(mesh.piece_element) >= 0).all() and set(mesh.piece_element) == set(range(n))
    assert mesh.piece_start[-1] == len(mesh.corners) and mesh.sender_start[-1] == len(mesh.sender_corners)
    assert mesh.patch_sender[-1] == len(mesh.sender_normal) == len(mesh.sender_start) - 1
    assert (mesh.element_area > 0).all() and np.isfinite(mesh.corners).all()
    own = np.array([sum(np.linalg.norm(vector_area(r)) for r in pieces(mesh, e)) for e in range(n)])
    assert np.allclose(own, mesh.element_area, rtol=1e-9)
    # A patch sends from the area that its elements receive on.
    sending = [sum(np.linalg.norm(vector_area(r)) for r in senders(mesh, p)) for p in range(q)]
    assert np.allclose(sending, mesh.patch_area, rtol=1e-5)
    assert np.allclose(np.linalg.norm(mesh.element_normal, axis=1), 1.0, rtol=1e-9)
    assert np.allclose(np.linalg.norm(mesh.sender_normal, axis=1), 1.0, rtol=1e-9)
    low, high = mesh.element_bounds[:, 0], mesh.element_bounds[:, 1]
    assert (mesh.element_centroid >= low - 1e-9).all() and (mesh.element_centroid <= high + 1e-9).all()
    for e in range(n):
        rings = np.concatenate(pieces(mesh, e))
        assert (rings.min(axis=0) == low[e]).all() and (rings.max(axis=0) == high[e]).all()
        reach = np.linalg.norm(rings - mesh.element_centroid[e], axis=1).max()
        assert mesh.element_size[e] == pytest.approx(2 * reach, rel=1e-9)


@each_shape
@pytest.mark.parametrize("split", [1, 2, 3])
@pytest.mark.parametrize("edge", [np.inf, 0.7, 0.3])
def test_elements_tile_the_polygon_and_patches_their_elements(shape, split, edge):
    rings = shape if isinstance(shape, list) else [shape]
    extent = np.ptp(rings[0], axis=0).max()
    scene = polygon_scene(shape)
    options = {} if np.isinf(edge) else {"max_edge": edge * extent / 3}
    geometry, mesh = mesh_of(scene, split=split, **options)
    check_layout(mesh)
    area = geometry.polygon_area[0]
    assert mesh.element_area.sum() == pytest.approx(area, rel=1e-5)
    normal = geometry.polygon_normal[0]
    assert np.allclose(mesh.element_normal, normal)
    u, v = plane_basis(normal)
    origin = rings[0][0]
    loops = [np.column_stack([(r - origin) @ u, (r - origin) @ v]) for r in rings]
    outline = shapely.Polygon(loops[0], loops[1:])
    cover = flat_union([r for e in range(mesh.element_count) for r in pieces(mesh, e)], origin, u, v)
    assert cover.symmetric_difference(outline).area < 1e-5 * area
    for patch in range(mesh.patch_count):
        own = [r for e in range(mesh.patch_start[patch], mesh.patch_start[patch + 1]) for r in pieces(mesh, e)]
        inside, sent = flat_union(own, origin, u, v), flat_union(senders(mesh, patch), origin, u, v)
        # No element straddles two patches: elements of a patch cover what it sends from.
        assert inside.symmetric_difference(sent).area < 1e-5 * area
    if not np.isinf(edge) and shape is not SHAPES["needle"]:
        rectangular = len(rings) == 1 and len(rings[0]) in (3, 4)
        longest = max(
            np.linalg.norm(np.roll(r, -1, axis=0) - r, axis=1).max()
            for e in range(mesh.element_count)
            for r in pieces(mesh, e)
        )
        # Cells of other polygons may keep a diagonal where they are cut.
        assert longest <= options["max_edge"] * (1.0 if rectangular else np.sqrt(2)) * (1 + 1e-9)


def test_one_element_a_polygon_by_default():
    _, mesh = mesh_of(polygon_scene(*SHAPES.values()))
    assert mesh.element_count == mesh.patch_count == len(SHAPES)
    assert mesh.element_polygon.tolist() == list(range(len(SHAPES)))


def test_quads_stay_quads_and_triangles_triangles():
    _, mesh = mesh_of(polygon_scene(QUAD, TRIANGLE), max_edge=0.5)
    sizes = np.diff(mesh.piece_start)
    surface = mesh.element_surface[mesh.piece_element]
    assert (sizes[surface == 0] == 4).all() and (sizes[surface == 1] == 3).all()
    # 3 x 2 in steps of 0.5, all squares.
    assert (surface == 0).sum() == 24
    assert np.allclose(mesh.element_area[mesh.element_surface == 0], 0.25)


@pytest.mark.parametrize("elements", [1, 24, 500, 1000, 5000])
def test_counts_come_near_the_request(elements):
    scene = standing_box()
    geometry, mesh = mesh_of(scene, elements=elements)
    assert mesh.element_count <= max(elements, geometry.polygon_count) * 1.05
    if elements >= 500:
        assert mesh.element_count > 0.85 * elements


@pytest.mark.parametrize("split", [1, 2, 4])
def test_patches_hold_split_squared_elements(split):
    _, mesh = mesh_of(polygon_scene(QUAD, TRIANGLE), max_edge=0.25, split=split)
    assert (np.diff(mesh.patch_start) == split**2).all()


@pytest.mark.parametrize("edge", [0.5, 0.2, 0.1])
def test_forecast_is_close(edge):
    names = [name for name in SHAPES if name not in ("needle", "strip")]
    # Apart from each other: elements also end where polygons touch, which is not foreseen.
    apart = [
        Surface.from_polygons(
            n, diffuse(n, 0.5), [[np.asarray(r) + [0, 0, 20 * i] for r in (S if isinstance(S, list) else [S])]]
        )
        for i, (n, S) in enumerate((n, SHAPES[n]) for n in names)
    ]
    flat = Scene("flat", tuple(apart), bands=1)
    made = mesh_of(flat, max_edge=edge)[1].element_count
    assert 0.8 * made <= forecast_elements(flat, edge) <= 1.2 * made
    # Clusters follow the shape: only the order of magnitude is known beforehand.
    ball = Scene("ball", (sphere_surface("ball", diffuse("ball", 0.5), [0, 0, 0], 1.0, facet_error=0.005),), bands=1)
    made = mesh_of(ball, max_edge=edge)[1].element_count
    assert 0.5 * made <= forecast_elements(ball, edge) <= 2.0 * made


def test_two_sided_surfaces_have_both_sides_once():
    sheet = replace(diffuse("sheet", 0.5), two_sided=True)
    geometry, mesh = mesh_of(
        Scene("sheet", (Surface.from_polygons("s", sheet, [KITE, TRIANGLE]),), bands=1), max_edge=0.5
    )
    check_layout(mesh)
    front, back = mesh.element_side == 1, mesh.element_side == -1
    assert front.sum() == back.sum() > 2
    assert mesh.element_area[front].sum() == pytest.approx(geometry.polygon_area.sum(), rel=1e-9)
    assert mesh.element_area[back].sum() == pytest.approx(geometry.polygon_area.sum(), rel=1e-9)
    for e in range(mesh.element_count):
        wanted = geometry.polygon_normal[mesh.element_polygon[e]] * mesh.element_side[e]
        assert np.allclose(mesh.element_normal[e], wanted)
        assert all(vector_area(r) @ wanted > 0 for r in pieces(mesh, e))
    # No patch joins the two sides.
    for p in range(mesh.patch_count):
        assert len(set(mesh.element_side[mesh.patch_start[p] : mesh.patch_start[p + 1]])) == 1


@pytest.mark.parametrize("two_sided", [False, True])
def test_clusters_hold_every_facet_once(two_sided):
    vertices, faces = torus_knot_mesh(segments=120, sides=16)[:2]
    paint = replace(diffuse("knot", 0.5), two_sided=two_sided)
    scene = Scene("knot", (Surface.from_mesh("knot", paint, vertices, faces),), bands=1)
    geometry, mesh = mesh_of(scene, elements=300)
    check_layout(mesh)
    sides = 2 if two_sided else 1
    assert mesh.element_count < 0.5 * len(faces) * sides
    assert mesh.element_area.sum() == pytest.approx(sides * geometry.polygon_area.sum(), rel=1e-9)
    assert (mesh.patch_polygon == -1).all() and (mesh.element_polygon == -1).all()
    # Every facet, found again by its centroid.
    centroid = np.array(
        [mesh.corners[a:b].mean(axis=0) for a, b in zip(mesh.piece_start[:-1], mesh.piece_start[1:], strict=True)]
    )
    wanted = vertices[faces].mean(axis=1)
    distance, _ = cKDTree(wanted).query(centroid)
    assert distance.max() < 1e-9
    assert len(centroid) == sides * len(wanted)
    assert (np.bincount(cKDTree(wanted).query(centroid)[1]) == sides).all()
    # Facets of an element face about the same way: within the diagonal of a quarter of the cube of directions.
    turn = np.einsum("ij,ij->i", mesh.piece_normal, mesh.element_normal[mesh.piece_element])
    assert turn.min() > 0.4
    # Elements of a patch are neighbours in place and direction.
    for p in range(mesh.patch_count):
        own = slice(mesh.patch_start[p], mesh.patch_start[p + 1])
        assert (mesh.element_normal[own] @ mesh.patch_normal[p]).min() > 0.0


def test_without_clusters_every_facet_is_its_own_element():
    scene = Scene("ball", (sphere_surface("ball", diffuse("ball", 0.5), [0, 0, 0], 1.0),), bands=1)
    geometry, mesh = mesh_of(scene, elements=50, cluster=False)
    assert mesh.element_count == geometry.polygon_count == 320
    assert (mesh.element_polygon == np.arange(320)).all()
    assert mesh.facet_error == scene.surfaces[0].facet_error > 0


def test_materials_come_from_the_surface():
    bands = 3
    surfaces = (
        box_surface("room", diffuse("room", [0.1, 0.2, 0.3], bands=bands), [0, 0, 0], [1, 1, 1], inward=True),
        Surface.from_polygons("lamp", diffuse("lamp", 0.0, [1.0, 2.0, 3.0], bands=bands), [KITE * 0.2]),
    )
    _, mesh = mesh_of(Scene("s", surfaces, bands=bands), max_edge=0.3)
    for index, surface in enumerate(surfaces):
        own = mesh.element_surface == index
        assert (mesh.reflectance[own] == surface.material.reflectance).all()
        assert (mesh.emission[own] == surface.material.emission).all()
    values = np.arange(mesh.element_count * bands, dtype=float).reshape(-1, bands)
    mean = mesh.patch_mean(values)
    own = slice(mesh.patch_start[2], mesh.patch_start[3])
    assert np.allclose(mean[2], np.average(values[own], axis=0, weights=mesh.element_area[own]))


def test_patch_normals_and_bounds():
    _, mesh = mesh_of(polygon_scene(QUAD, TRIANGLE, ELL), max_edge=0.6)
    for p in range(mesh.patch_count):
        own = np.concatenate([r for e in range(*mesh.patch_start[p : p + 2]) for r in pieces(mesh, e)])
        assert np.allclose(mesh.patch_bounds[p], [own.min(axis=0), own.max(axis=0)], atol=1e-12)
        assert np.allclose(mesh.patch_normal[p], mesh.element_normal[mesh.patch_start[p]], atol=1e-12)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"elements": 5, "max_edge": 1.0}, "both given"),
        ({"elements": 0}, "found 0"),
        ({"max_edge": 0.0}, "found 0"),
        ({"max_edge": -1.0}, "found -1"),
        ({"max_edge": np.nan}, "found nan"),
    ],
)
def test_bad_options_get_one_line(options, words):
    with pytest.raises(OptionError, match=words) as caught:
        mesh_of(polygon_scene(QUAD), **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("elements", [16, 50, 100, 200])
def test_without_a_split_every_element_is_a_patch(elements):
    """Also where a hole leaves two parts of one cell of the grid, as a block on the floor of the Cornell box does."""
    scene = load("cornell-box")
    mesh = build_mesh(scene, Geometry.from_scene(scene), elements=elements, split=1, cluster=False)
    assert mesh.patch_count == mesh.element_count
    np.testing.assert_array_equal(np.sort(mesh.element_patch), np.arange(mesh.element_count))
    np.testing.assert_allclose(mesh.patch_area, mesh.element_area)


def test_a_vast_yard_does_not_take_all_elements():
    """A third of the elements stays with the house; scenes without an outlier are meshed as before."""
    house = box_surface("house", diffuse("grey", 0.5, bands=1), [-3, -3, 0], [3, 3, 3])
    yard = np.array([[-200, -200, -0.1], [200, -200, -0.1], [200, 200, -0.1], [-200, 200, -0.1]])
    scene = Scene("yard", (house, Surface.from_polygons("yard", diffuse("grey", 0.5, bands=1), [yard])), bands=1)
    mesh = mesh_of(scene, elements=600)[1]
    of_house = np.count_nonzero(mesh.element_polygon < 6)
    assert 0.25 * mesh.element_count < of_house < 0.5 * mesh.element_count
    # An edge that was asked for is the edge of all.
    assert np.count_nonzero(mesh_of(scene, max_edge=20.0)[1].element_polygon < 6) == 6
