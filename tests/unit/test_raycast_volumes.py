"""Group bounding volumes: they change the counts and never the picture."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from workbench.accel.base import Accelerator
from workbench.accel.brute import BruteForce
from workbench.accel.group_volumes import VOLUMES, GroupVolumes
from workbench.errors import OptionError
from workbench.geometry.flat import Geometry
from workbench.render.image import to_bytes
from workbench.render.raycast import ACCELERATORS, RayCaster, average_tests
from workbench.scene.sc import ScSphere, load_scene, read_sc

ROOT = Path(__file__).resolve().parents[2]
OWN = ROOT / "scenes" / "sc"
SHARED = ROOT / ".." / "shared" / "sc-format"
NAMES = ["min", "table", "room", "new"]
SQUARE = "polygon 4  0 0 0  1 0 0  1 1 0  0 1 0\n"


def scene_of(folder, text):
    path = folder / "a.sc"
    path.write_text(text)
    return read_sc(path)


def scene_file(folder, name):
    path = folder / f"{name}.sc"
    if not path.is_file():
        pytest.skip(f"{path} is not here")
    return read_sc(path)


@pytest.mark.parametrize(("folder", "name"), [(OWN, n) for n in NAMES] + [(SHARED, n) for n in NAMES[:3]])
def test_pictures_do_not_depend_on_volumes_or_workers(folder, name):
    scene = scene_file(folder, name)
    size = (96, 72)
    pictures = [RayCaster(scene, volumes=v, size=size, workers=w).render() for v in VOLUMES for w in (1, 3)]
    for picture in pictures[1:]:
        assert picture.radiance.tobytes() == pictures[0].radiance.tobytes()
        assert picture.primitive.tobytes() == pictures[0].primitive.tobytes()
    for one, three in zip(pictures[::2], pictures[1::2], strict=True):
        assert dict(one.counters) == dict(three.counters)
    # Something is seen, and not everything is the same.
    assert len(np.unique(to_bytes(pictures[0].radiance).reshape(-1, 3), axis=0)) > 50


@pytest.mark.parametrize(("folder", "name"), [(OWN, n) for n in NAMES] + [(SHARED, n) for n in NAMES[:3]])
def test_pictures_agree_between_accelerators(folder, name):
    scene = scene_file(folder, name)
    pictures = [RayCaster(scene, accelerator=a, size=(96, 72)).render().radiance for a in ACCELERATORS]
    for picture in pictures[1:]:
        assert np.abs(to_bytes(picture).astype(int) - to_bytes(pictures[0]).astype(int)).max() <= 1


def test_without_volumes_each_ray_meets_each_primitive():
    for name in NAMES:
        scene = read_sc(OWN / f"{name}.sc")
        picture = RayCaster(scene, volumes="none", size=(9, 7)).render()
        tests = average_tests(picture.counters)
        spheres = sum(isinstance(p, ScSphere) for p in scene.primitives)
        assert tests == {
            "spheres": spheres, "polygons": len(scene.primitives) - spheres, "bounding_spheres": 0,
            "bounding_boxes": 0, "sum": len(scene.primitives),
        }  # fmt: skip


def test_volumes_save_most_tests_in_the_room():
    scene = read_sc(OWN / "room.sc")
    sums = {v: average_tests(RayCaster(scene, volumes=v, size=(64, 64)).render().counters)["sum"] for v in VOLUMES}
    assert sums["none"] == 2457
    assert sums["bsphere"] < 2457 / 4 and sums["bbox"] < 2457 / 40 and sums["both"] < 2457 / 30


@pytest.mark.parametrize(("volumes", "wanted"), [("none", (5, 1, 0, 0)), ("bsphere", (3, 0, 4, 0)),
                                                 ("bbox", (1, 0, 0, 4)), ("both", (1, 0, 4, 2))])  # fmt: skip
def test_counts_by_hand(tmp_path, volumes, wanted):
    """One ray down the z axis, five squares and a sphere.

    Group 0 holds the square that is hit and group 1, two squares off the axis: their box begins at
    x = y = .02, but the sphere about it, centre .52, radius sqrt(.5^2 + .5^2 + .25^2) = .75, reaches
    the axis at .735.  Group 2, a square and a sphere, lies beyond the hit, group 3 aside.
    """
    scene = scene_of(
        tmp_path,
        f"""world
        push  trans -.5 -.5 0 {SQUARE}
          push  trans .52 .52 1 {SQUARE} trans 0 0 -.5 {SQUARE} pop
        pop
        push  trans -.5 -.5 -9 {SQUARE} sphere 0 0 0 1 pop
        push  trans 50 0 0 {SQUARE} pop""",
    )
    groups = GroupVolumes(scene, volumes)
    hits = groups.closest_hit([[0, 0, 5]], [[0, 0, -1]])
    assert (hits.t[0], hits.polygon[0]) == (5, 0)
    counted = ("polygon_tests", "sphere_tests", "bounding_sphere_tests", "box_tests")
    assert tuple(groups.counters[name] for name in counted) == wanted
    assert (groups.counters["rays"], groups.counters["rays_hit"]) == (1, 1)


numbers = st.floats(-2, 2).map(lambda v: round(v, 2))
scales = st.floats(0.02, 3).map(lambda v: round(v, 2))
parts = st.one_of(
    st.tuples(numbers, numbers, numbers).map(lambda v: "trans {} {} {}".format(*v)),
    st.tuples(scales, scales, scales).map(lambda v: "scale {} {} {}".format(*v)),
    st.tuples(st.sampled_from("xyz"), st.integers(-180, 180)).map(lambda v: "rot {} {}".format(*v)),
    st.just("push"),
    st.just("pop"),
    st.just(SQUARE),
    st.just("polygon 5  0 0 0  2 0 0  2 2 0  1 .5 0  0 2 0"),
    st.tuples(numbers, numbers, numbers, scales).map(lambda v: "scale -1 1 1\n push sphere {} {} {} {}".format(*v)),
)


def balanced(words):
    """The statements with pushes and pops that match and spheres where they are allowed."""
    text, uneven = ["world"], [False]
    for word in words:
        if word == "pop":
            if len(uneven) == 1:
                continue
            uneven.pop()
        elif "push" in word:
            if "sphere" in word and uneven[-1]:
                continue
            uneven.append(uneven[-1])
        elif word.startswith("scale"):
            uneven[-1] = True
        text.append(word)
    return "\n".join(text + ["pop"] * (len(uneven) - 1))


@settings(max_examples=120, deadline=None)
@given(st.lists(parts, min_size=4, max_size=40), st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1e3, 1e6]))
def test_4_12_volumes_drop_no_hit_of_random_scenes(tmp_path_factory, words, seed, shift):
    """Failure mode 4.12: nested non-uniform scales, reflections, far coordinates, rays that graze."""
    text = balanced(words).replace("world", f"world trans {shift} {-shift} {shift}", 1)
    scene = scene_of(tmp_path_factory.mktemp("sc"), text)
    rng = np.random.default_rng(seed)
    places = [p.center[None] if isinstance(p, ScSphere) else p.vertices for p in scene.primitives]
    # Half of the rays aim at vertices and centres: at the very borders of primitives and groups.
    targets = np.concatenate([*places, np.array([[shift, -shift, shift]]) + rng.normal(size=(20, 3))])
    targets = targets[rng.integers(0, len(targets), 200)]
    targets[::3] += rng.normal(size=targets[::3].shape)
    origins = np.array([shift, -shift, shift]) + rng.normal(scale=5, size=(200, 3))
    directions = (targets - origins) * rng.uniform(0.3, 3, (200, 1))
    found = []
    for volumes in VOLUMES:
        groups = GroupVolumes(scene, volumes)
        hits = groups.closest_hit(origins, directions)
        blocked = groups.occluded(origins, directions, np.inf)
        np.testing.assert_array_equal(blocked, hits.polygon >= 0)
        found.append((hits.t.tobytes(), hits.polygon.tobytes()))
    assert found[1:] == found[:1] * 3


def test_rays_that_graze_small_far_spheres(tmp_path):
    """b^2 - c would be rounding noise here: radius 1e-5 at a distance of 1e4, tested to 1e-9 of the radius."""
    scene = scene_of(tmp_path, "world push sphere 0 0 0 1e-5 pop")
    offset = 1e-5 * np.array([0.0, 0.5, 0.999999, 1.000001, 2.0])
    origins = np.column_stack([offset, np.zeros(5), np.full(5, 1e4)])
    for volumes in VOLUMES:
        hits = GroupVolumes(scene, volumes).closest_hit(origins, [[0, 0, -1]])
        assert (hits.polygon >= 0).tolist() == [True, True, True, False, False]
        np.testing.assert_allclose(hits.t[:3], 1e4 - np.sqrt(1e-10 - offset[:3] ** 2), rtol=0, atol=1e-11)


def test_the_first_of_equal_primitives_wins(tmp_path):
    """Coincident squares, one alone and two in groups: the order of the file decides, whatever is tested."""
    first, second = f"push {SQUARE} pop ", f"push push {SQUARE} pop trans 0 0 -1 {SQUARE} pop "
    for text in (first + second, second + first, SQUARE + second):
        scene = scene_of(tmp_path, "world " + text)
        for volumes in VOLUMES:
            assert GroupVolumes(scene, volumes).closest_hit([[0.4, 0.3, 2]], [[0, 0, -1]]).polygon[0] == 0


@pytest.mark.parametrize("distance", [1, 1e3, 1e6])
def test_rays_through_the_very_edges_of_a_volume(tmp_path, distance):
    """A square fills its flat box; without room for rounding one ray in forty at its edges would be lost."""
    scene = scene_of(tmp_path, f"world trans .1 .2 .3 push {SQUARE} pop")
    rng = np.random.default_rng(5)
    corner = scene.primitives[0].vertices
    edge, share = rng.integers(0, 4, 4000), rng.uniform(0, 1, (4000, 1))
    targets = corner[edge] * share + corner[(edge + 1) % 4] * (1 - share)
    origins = targets + distance * rng.normal(size=(4000, 3))
    # Lengths at random: with t = 1 at every edge, rounding would hide.
    directions = (targets - origins) * rng.uniform(0.3, 3, (4000, 1))
    answers = [GroupVolumes(scene, v).closest_hit(origins, directions) for v in VOLUMES]
    assert 0.2 < (answers[0].polygon >= 0).mean() < 0.8
    for answer in answers[1:]:
        np.testing.assert_array_equal(answer.t, answers[0].t)


def test_uneven_polygons_stay_inside_their_flat_volumes(tmp_path):
    """One vertex is 5e-6 off, as the reader allows: near the opposite one the mean plane lies 1.25e-6 below
    every vertex, and flat rays that meet it there pass below the box of the vertices."""
    scene = scene_of(tmp_path, "world push polygon 4  0 0 0  1 0 5e-6  1 1 0  0 1 0 pop")
    rng = np.random.default_rng(3)
    low, high = np.array([[0, 0.9, -1e-6], [-1, 1, 1e-5]]), np.array([[0.1, 1, -1e-6], [0, 2, 1e-5]])
    targets, origins = (rng.uniform(low[k], high[k], (1000, 3)) for k in range(2))
    answers = [GroupVolumes(scene, v).closest_hit(origins, targets - origins) for v in VOLUMES]
    assert (answers[0].polygon >= 0).mean() > 0.9
    for answer in answers[1:]:
        np.testing.assert_array_equal(answer.t, answers[0].t)


def test_agrees_with_brute_force_on_polygons(tmp_path):
    """Convex and concave polygons against the triangles of brute force."""
    rng = np.random.default_rng(11)
    text = "size 4 4 lookat 0 0 9 0 0 0 0 1 0 world\n"
    for _ in range(25):
        x, y, z, a, b = rng.uniform(-2, 2, 5)
        text += f"push trans {x} {y} {z} rot x {90 * a} rot y {90 * b}\n"
        text += "polygon 7  0 0 0  2 0 0  2 2 0  1.5 .5 0  1 2 0  .5 .5 0  0 2 0 pop\n"
    scene = scene_of(tmp_path, text)
    groups, brute = GroupVolumes(scene), BruteForce(Geometry.from_scene(load_scene(tmp_path / "a.sc")))
    assert isinstance(groups, Accelerator)
    origins, directions = rng.normal(size=(2000, 3)) * 3, rng.normal(size=(2000, 3))
    one, other = groups.closest_hit(origins, directions), brute.closest_hit(origins, directions)
    assert 200 < (one.polygon >= 0).sum() < 1900
    np.testing.assert_array_equal(one.polygon, other.polygon)
    np.testing.assert_allclose(one.t, other.t, rtol=1e-9)
    far = rng.uniform(0, 2, 2000)
    np.testing.assert_array_equal(groups.occluded(origins, directions, far), brute.occluded(origins, directions, far))
    skip = np.column_stack([one.polygon, np.full(2000, -1)])
    one, other = groups.closest_hit(origins, directions, far, skip), brute.closest_hit(origins, directions, far, skip)
    np.testing.assert_array_equal(one.polygon, other.polygon)


def test_concave_polygon_pixel_by_pixel(tmp_path):
    """A thick letter U of area 7: the notch shows the background, and hits add up to the area."""
    scene = scene_of(tmp_path, "size 200 200 background 1 1 1 persp 45 lookat 1.5 1.5 9  1.5 1.5 0  0 1 0 world\n"
                     "polygon 8  0 0 0  3 0 0  3 3 0  2 3 0  2 1 0  1 1 0  1 3 0  0 3 0")  # fmt: skip
    seen = RayCaster(scene).render().primitive == 0
    side = 2 * 9 * np.tan(np.radians(22.5))
    place = (np.arange(200) + 0.5) / 200 * side - side / 2 + 1.5
    x, y = np.meshgrid(place, 3 - place)
    inside = (x > 0) & (x < 3) & (y > 0) & (y < 3) & ~((x > 1) & (x < 2) & (y > 1))
    np.testing.assert_array_equal(seen, inside)
    assert seen.mean() * side * side == pytest.approx(7, rel=0.02)


def test_shared_edges_neither_leak_nor_double(tmp_path):
    """A fan of triangles of one plane: each ray at a shared edge or vertex meets one of them at t = 1."""
    ring = [(np.cos(a), np.sin(a)) for a in 2 * np.pi * np.arange(7) / 7]
    text = "world push\n"
    for (x0, y0), (x1, y1) in zip(ring, ring[1:] + ring[:1], strict=True):
        text += f"polygon 3  0 0 0  {x0:.17g} {y0:.17g} 0  {x1:.17g} {y1:.17g} 0\n"
    scene = scene_of(tmp_path, text + "pop")
    share = np.linspace(0, 0.999, 300)[:, None]
    targets = np.concatenate([share * np.array([[x, y]]) for x, y in ring])
    origins = np.column_stack([targets, np.ones(len(targets))])
    hits = GroupVolumes(scene).closest_hit(origins, [[0, 0, -1]])
    assert (hits.t == 1).all()


@pytest.mark.parametrize("accelerator", ACCELERATORS)
@pytest.mark.parametrize("world", ["", "sphere 0 0 0 1", SQUARE, "push pop"])
def test_scenes_with_little_in_them(tmp_path, accelerator, world):
    scene = scene_of(tmp_path, f"size 5 5 background .5 .25 0 lookat .5 .5 5  .5 .5 0  0 1 0 world {world}")
    picture = RayCaster(scene, accelerator=accelerator).render()
    assert (picture.primitive >= 0).any() == bool(scene.primitives)
    np.testing.assert_array_equal(picture.radiance[0, 0], [0.5, 0.25, 0])


def test_choices_that_do_not_exist(tmp_path):
    scene = scene_of(tmp_path, "world")
    with pytest.raises(OptionError, match="volumes: found 'boxes'"):
        GroupVolumes(scene, "boxes")
    with pytest.raises(OptionError, match="primitives: found 'cones'"):
        GroupVolumes(scene, primitives="cones")
    with pytest.raises(OptionError, match="accelerator: found 'octree'"):
        RayCaster(scene, accelerator="octree")
    with pytest.raises(OptionError, match="workers: found 0"):
        RayCaster(scene, workers=0)
    tiny = scene_of(tmp_path, f"world trans 1e12 0 0 {SQUARE}")
    RayCaster(tiny)
    for accelerator in ("voxels", "embree"):
        with pytest.raises(OptionError, match="found a scene 1 in size at coordinates up to 1e"):
            RayCaster(tiny, accelerator=accelerator)
