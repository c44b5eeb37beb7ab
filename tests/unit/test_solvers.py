"""The solvers: energy kept at every step, bounds that bound, equal answers for any number of workers."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from radiosity_scenes import UNIT, cube_with_emitter, polygon_scene, standing_box

import radiosity
import radiosity.solvers.solution as solution_module
from radiosity.form_factors.bundle import LinkSettings, ReceiverBundles
from radiosity.patches import build_mesh
from radiosity.solvers import progressive
from radiosity.solvers.progressive import remaining_bound, shoot_until
from radiosity.solvers.solve import _start
from workbench import memory
from workbench.errors import InputError, MemoryForecastError, OptionError
from workbench.geometry.flat import Geometry
from workbench.record import RunRecord
from workbench.scene.library import box_surface, diffuse, sphere_surface, unit_cube
from workbench.scene.model import Light, Scene, Surface


def room_with_ball(*, closed: bool = True) -> Scene:
    """A room with a tessellated ball: pairs that only rays can settle."""
    scene = cube_with_emitter(0.3, 0.6)
    ball = sphere_surface("ball", diffuse("ball", 0.7), [0.5, 0.45, 0.5], 0.25)
    return replace(scene, surfaces=(*scene.surfaces, ball), closed=closed)


def open_box() -> Scene:
    """A box without its lid: light escapes."""
    glow = box_surface("floor", diffuse("glow", 0.4, 1.0), *UNIT, inward=True, omit=["-x", "+x", "-y", "+y", "+z"])
    walls = box_surface("walls", diffuse("wall", 0.8), *UNIT, inward=True, omit=["-z", "+z"])
    return Scene("open box", (glow, walls), bands=1)


def started(scene, *, elements, error=0.02, workers=1, split=1):
    """A solution before the first shot, and its bundles."""
    geometry = Geometry.from_scene(scene)
    mesh = build_mesh(scene, geometry, elements=elements, split=split)
    bundles = ReceiverBundles(geometry, mesh, LinkSettings(error=error), workers)
    incident = np.zeros((mesh.element_count, mesh.bands))
    return _start(scene, mesh, incident, RunRecord(command="test")), bundles


class Stop:
    """Progress that interrupts after some calls, as Ctrl-C would."""

    def __init__(self, calls: int) -> None:
        self.left = calls
        self.events = []

    def __call__(self, event) -> None:
        self.events.append(event)
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt


# Equal answers


@pytest.mark.parametrize("scene", [standing_box(), room_with_ball()], ids=["polygons", "rays"])
def test_one_and_two_workers_agree_bit_for_bit(scene):
    one, two = (radiosity.solve(scene, elements=200, workers=k, tolerance=1e-3) for k in (1, 2))
    assert (one.radiosity == two.radiosity).all()
    assert (one.element_irradiance == two.element_irradiance).all()
    assert (one.unshot == two.unshot).all()
    assert dict(one.record.counters) == dict(two.record.counters)
    if len(scene.surfaces) == 3 and scene.surfaces[2].face_count > 64:
        assert one.record.counters["rays"] > 0


def test_the_seed_decides_the_rays_and_nothing_else_does():
    same = [radiosity.solve(room_with_ball(), elements=150, workers=1, seed=s, tolerance=0.01) for s in (3, 3, 4)]
    assert (same[0].radiosity == same[1].radiosity).all()
    assert (same[0].radiosity != same[2].radiosity).any()
    assert np.allclose(same[0].radiosity, same[2].radiosity, rtol=0.15)


@pytest.mark.parametrize("scene", [cube_with_emitter(0.3, 0.6), standing_box(), open_box()])
def test_direct_and_progressive_agree(scene):
    # Both with form factors to 5e-3; what is left is their error and the tolerance.
    direct, shot = (
        radiosity.solve(
            scene, method=m, max_edge=0.34, form_factor_error=5e-3, tolerance=1e-6, workers=1
        ) for m in ("direct", "progressive")
    )  # fmt: skip
    assert direct.mesh.element_count == shot.mesh.element_count
    mean = np.average(direct.radiosity, axis=0, weights=direct.mesh.element_area)
    assert np.abs(direct.radiosity - shot.radiosity).max() < 0.02 * mean
    assert np.abs(direct.element_irradiance - shot.element_irradiance).max() < 0.03 * mean


def test_patches_of_four_elements_agree_with_elements_that_shoot_alone():
    # Two-level substructuring: senders twice as coarse; on a cube of 6 x 8 x 8 below half a percent.
    alone = radiosity.solve(cube_with_emitter(0.5, 0.5), max_edge=1 / 8, workers=1, tolerance=1e-4)
    solution, bundles = started(cube_with_emitter(0.5, 0.5), elements=384, split=2)
    assert solution.mesh.patch_count == 96
    shoot_until(solution, bundles, tolerance=1e-4)
    bundles.close()
    order = [np.lexsort(np.round(s.mesh.element_centroid, 6).T) for s in (alone, solution)]
    ratio = solution.radiosity[order[1], 0] / alone.radiosity[order[0], 0]
    assert np.abs(ratio - 1).max() < 0.03
    assert abs(ratio.mean() - 1) < 0.005


# Energy


@pytest.mark.parametrize("scene", [cube_with_emitter(0.3, 0.6), open_box(), room_with_ball()])
def test_the_energy_book_balances_at_every_step(scene):
    solution, bundles = started(scene, elements=120)
    seen = []

    def check(event):
        book, unshot = solution.book, solution.unshot_power
        assert book.imbalance(unshot) < 1e-12
        # Both halves of the book: what was shot arrived or escaped.
        assert np.allclose(book.shot, book.received + book.escaped, rtol=1e-12)
        # And the elements tell the same: what they hold was emitted or reflected.
        mesh = solution.mesh
        reflected = mesh.element_area @ (mesh.reflectance * solution.element_irradiance)
        held = mesh.element_area @ (solution.radiosity - mesh.emission)
        assert np.allclose(held, reflected, rtol=1e-12)
        seen.append((event.shots, book.shot.sum(), event.residual))

    shoot_until(solution, bundles, tolerance=1e-4, progress=check)
    bundles.close()
    assert solution.book.imbalance(solution.unshot_power) < 1e-12
    assert len(seen) > 3
    assert all(a[1] <= b[1] for a, b in pairwise(seen))
    if not scene.closed:
        assert solution.book.escaped[0] > 0.1 * solution.book.emitted[0]


@pytest.mark.parametrize("bottom", [False, True])
@pytest.mark.parametrize("method", ["direct", "matrix", "progressive"])
def test_a_closed_scene_absorbs_what_it_emits(method, bottom):
    # Also with a floor that a box covers in part: what its patches send has nowhere else to go.
    solution = radiosity.solve(
        standing_box(bottom=bottom), method=method, elements=60, workers=1, tolerance=1e-6, form_factor_error=0.01
    )
    assert solution.mesh.element_count > 20
    book = solution.book
    assert book.absorbed[0] == pytest.approx(book.emitted[0], rel=1e-4)
    assert abs(book.escaped[0]) < 1e-4 * book.emitted[0]


def test_the_open_box_loses_what_leaves_through_its_lid():
    # The lid as a black receiver: what it would absorb is what the open box loses.
    lid = box_surface("lid", diffuse("black", 0.0), *UNIT, inward=True, omit=["-x", "+x", "-y", "+y", "-z"])
    lidded = replace(open_box(), surfaces=(*open_box().surfaces, lid), closed=True)
    lost = radiosity.solve(open_box(), max_edge=0.25, workers=1, tolerance=1e-6, form_factor_error=1e-3)
    kept = radiosity.solve(lidded, max_edge=0.25, workers=1, tolerance=1e-6, form_factor_error=1e-3)
    black = kept.mesh.element_surface == 2
    assert lost.book.escaped[0] == pytest.approx(
        float(kept.mesh.element_area[black] @ kept.element_irradiance[black, 0]), rel=2e-3
    )


# The bound


@pytest.mark.parametrize("rho", [0.2, 0.7, 0.95])
@pytest.mark.parametrize("scene", ["cube", "ball"])
def test_the_bound_on_the_remaining_error_is_a_bound(rho, scene, monkeypatch):
    # Without the solve at the end, so that many steps are seen.
    monkeypatch.setattr(progressive, "SOLVE_LIMIT", 0)
    base = cube_with_emitter(0.0, rho) if scene == "cube" else room_with_ball(closed=False)
    whole, bundles = started(base, elements=60)
    shoot_until(whole, bundles, tolerance=1e-9)
    total = whole.mesh.element_area @ whole.element_irradiance
    solution, again = started(base, elements=60)
    bounds, errors = [], []

    def check(event):
        assert event.residual == remaining_bound(solution)
        missing = total - solution.mesh.element_area @ solution.element_irradiance
        bounds.append(event.residual)
        errors.append(float((missing / total).max()))

    shoot_until(solution, again, tolerance=1e-3, progress=check)
    bundles.close()
    again.close()
    assert solution.converged and solution.stopped == "tolerance"
    assert len(bounds) > 3
    assert all(error <= bound * (1 + 1e-6) + 1e-9 for error, bound in zip(errors, bounds, strict=True))
    assert errors[-1] <= 1e-3
    # Not an idle one either: near the end within a factor of a few of what is missing.
    assert bounds[-1] < 30 * max(errors[-1], 1e-6) / (1 - rho)


@pytest.mark.parametrize("rho", [0.9, 0.999])
@pytest.mark.parametrize("elements", [1, 100])
def test_furnace_near_reflectance_one(rho, elements):
    # Failure modes 8.1 and 8.3: B = e / (1 - rho); row sums off by 5e-5 would cost 5 % at 0.999.
    for method, worst in (("direct", 1e-9), ("progressive", 1e-9 if elements == 1 else 1e-3)):
        solution = radiosity.solve(unit_cube(rho, 1.0), method=method, elements=elements, workers=1, tolerance=1e-6)
        assert np.abs(solution.radiosity * (1 - rho) - 1).max() < worst
        sums = solution.record.errors["row_sum"]
        assert abs(sums["max"] - 1) <= max(sums["stated_error"], 1e-12)


def test_the_last_bounces_are_solved_at_once():
    # Failure mode 8.2: gathering needs 13,808 sweeps for 1e-6 at 0.999 (ln 1e-6 / ln 0.999), shooting about as many.
    solution = radiosity.solve(unit_cube(0.999, 1.0), method="progressive", elements=1, workers=1, tolerance=1e-6)
    assert solution.stopped == "solved"
    assert solution.record.counters["shots"] <= 12


# Interruption and resume


def test_ctrl_c_leaves_a_usable_solution_that_resumes_to_the_same(monkeypatch):
    monkeypatch.setattr(progressive, "SOLVE_LIMIT", 0)
    options = {"method": "progressive", "elements": 150, "workers": 1, "tolerance": 1e-3}
    scene = cube_with_emitter(0.3, 0.6)
    whole = radiosity.solve(scene, **options)
    stop = Stop(4)
    part = radiosity.solve(scene, **options, progress=stop)
    assert not part.converged and part.stopped == "interrupted"
    assert part.book.imbalance(part.unshot_power) < 1e-12
    assert part.record.errors["remaining_bound"] == pytest.approx(stop.events[-1].residual)
    assert (part.radiosity >= part.mesh.emission - 1e-15).all() and np.isfinite(part.radiosity).all()
    before = part.radiosity.copy(), part.book.shot.copy()
    resumed = radiosity.solve(scene, **options, resume=part)
    assert resumed.converged
    assert (resumed.radiosity == whole.radiosity).all()
    assert (resumed.book.shot == whole.book.shot).all()
    assert resumed.record.counters["shots"] == whole.record.counters["shots"]
    # The interrupted solution is still what it was.
    assert (part.radiosity == before[0]).all() and (part.book.shot == before[1]).all()


@pytest.mark.parametrize("kept", [True, False])
def test_resume_through_a_file(tmp_path, monkeypatch, kept):
    monkeypatch.setattr(solution_module, "KEPT_LIMIT", 2**28 if kept else 0)
    scene = cube_with_emitter(0.3, 0.6)
    options = {"method": "progressive", "elements": 100, "workers": 1, "tolerance": 1e-5}
    part = radiosity.solve(scene, **options, progress=Stop(2))
    part.save(tmp_path / "out")
    loaded = radiosity.Solution.load(tmp_path / "out")
    assert (loaded.shooting is not None) and bool(loaded.shooting.kept) == kept
    resumed = radiosity.solve(scene, **options, resume=loaded)
    whole = radiosity.solve(scene, **options)
    # Form factors that were not kept are found again with the same care: the same bits.
    assert (resumed.radiosity == whole.radiosity).all()
    assert resumed.book.imbalance(resumed.unshot_power) < 1e-12


def test_a_killed_solve_resumes_from_its_checkpoint_to_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(progressive, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(progressive, "CHECKPOINT_SHARE", np.inf)

    class KilledError(Exception):
        pass

    calls = []

    def die_after_saving(unfinished):
        unfinished.save_state(tmp_path)
        calls.append(unfinished.record.counters["links"])
        if len(calls) == 3:
            raise KilledError

    scene = cube_with_emitter(0.3, 0.6)
    options = {"method": "progressive", "elements": 100, "workers": 1, "tolerance": 1e-5}
    whole = radiosity.solve(scene, **options)
    with pytest.raises(KilledError):
        radiosity.solve(scene, **options, checkpoint=die_after_saving)
    assert calls[0] < calls[2]
    resumed = radiosity.solve(scene, **options, resume=radiosity.Solution.load(tmp_path))
    assert (resumed.radiosity == whole.radiosity).all() and (resumed.book.shot == whole.book.shot).all()
    for name in ("shots", "links", "closed_forms"):
        assert resumed.record.counters[name] == whole.record.counters[name]


def test_resume_refuses_another_mesh():
    part = radiosity.solve(cube_with_emitter(0.3, 0.6), method="progressive", elements=100, workers=1, progress=Stop(1))
    for scene, elements in ((cube_with_emitter(0.3, 0.6), 400), (cube_with_emitter(0.3, 0.7), 100)):
        with pytest.raises(InputError, match="another mesh or other materials"):
            radiosity.solve(scene, method="progressive", elements=elements, workers=1, resume=part)


def test_an_interrupted_direct_solve_leaves_the_emission():
    solution = radiosity.solve(cube_with_emitter(0.3, 0.6), method="direct", elements=60, workers=1, progress=Stop(0))
    assert not solution.converged and solution.stopped == "interrupted"
    assert (solution.radiosity == solution.mesh.emission).all()


# Refusals


def test_a_closed_scene_that_reflects_all_has_no_solution():
    with pytest.raises(InputError, match="reflectance 1 on every surface") as caught:
        radiosity.solve(unit_cube(1.0, 1.0), workers=1)
    assert "\n" not in str(caught.value)
    # Open, it has one: all that is emitted escapes.
    solution = radiosity.solve(replace(open_box(), surfaces=tuple(
        replace(s, material=replace(s.material, reflectance=np.ones(1))) for s in open_box().surfaces
    )), elements=60, workers=1, tolerance=1e-6)  # fmt: skip
    assert solution.book.escaped[0] == pytest.approx(solution.book.emitted[0], rel=1e-5)


def test_a_scene_without_emitter_or_surface_is_refused():
    with pytest.raises(InputError, match="no emitter"):
        radiosity.solve(unit_cube(0.5, 0.0), workers=1)
    with pytest.raises(InputError, match="no surface"):
        radiosity.solve(Scene("nothing", (), bands=1), workers=1)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"elements": 10**12}, "1e\\+12 elements"),
        ({"max_edge": 1e-7}, "GiB"),
        ({"method": "direct", "elements": 10**6}, "matrix of 1e\\+06 x 1e\\+06"),
    ],
)
def test_what_cannot_fit_is_refused_before_it_starts(options, words):
    with pytest.raises(MemoryForecastError, match=words) as caught:
        radiosity.solve(unit_cube(0.5, 1.0), workers=1, **options)
    assert "\n" not in str(caught.value) and "is free" in str(caught.value)


def test_polygons_that_cannot_be_fewer_count_in_the_forecast(monkeypatch):
    # One element is asked for, but 400 polygons are 400 elements.
    tiles = [np.array([[i, 0, 0], [i + 1, 0, 0], [i + 1, 1, 0], [i, 1, 0.0]]) for i in range(400)]
    scene = polygon_scene(*tiles, material=diffuse("glow", 0.5, 1.0))
    monkeypatch.setattr(memory, "available_bytes", lambda: 4_000_000)
    with pytest.raises(MemoryForecastError, match="400 x 400"):
        radiosity.solve(scene, method="direct", elements=1, workers=1)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"method": "magic"}, "magic"),
        ({"elements": 5, "max_edge": 0.1}, "both given"),
        ({"elements": 0}, "elements: found 0"),
        ({"max_edge": np.nan}, "max_edge: found nan"),
        ({"rays": 0}, "rays: found 0"),
        ({"tolerance": 0.0}, "tolerance: found 0"),
        ({"tolerance": 1.0}, "tolerance: found 1"),
        ({"workers": 0}, "workers: found 0"),
        ({"form_factor_error": 2.0}, "form_factor_error: found 2"),
    ],
)
def test_bad_options_get_one_line(options, words):
    with pytest.raises(OptionError, match=words) as caught:
        radiosity.solve(unit_cube(0.5, 1.0), **{"workers": 1, **options})
    assert "\n" not in str(caught.value)


# Bands


@pytest.mark.parametrize("bands", [1, 3, 7])
def test_bands_do_not_mix(bands):
    rho, emission = np.linspace(0.1, 0.8, bands), np.linspace(2.0, 0.5, bands)
    solution = radiosity.solve(
        unit_cube(rho, emission, bands=bands), elements=1, workers=1, method="progressive", tolerance=1e-6
    )
    assert solution.radiosity.shape == (6, bands)
    assert np.allclose(solution.radiosity, emission / (1 - rho), rtol=1e-9)
    assert all(
        entry.shape == (bands,) for entry in (solution.book.emitted, solution.book.absorbed, solution.book.escaped)
    )


def test_three_bands_equal_three_solves_of_one():
    rho = [0.2, 0.5, 0.8]
    options = {"elements": 100, "workers": 1, "method": "direct"}

    def scene(values, bands):
        floor = box_surface("floor", diffuse("f", 0.5, 1.0, bands=bands), *UNIT, inward=True, omit=["+z"])
        top = box_surface(
            "top", diffuse("t", values, bands=bands), *UNIT, inward=True, omit=["-x", "+x", "-y", "+y", "-z"]
        )
        return Scene("s", (floor, top), bands=bands, closed=True)

    together = radiosity.solve(scene(rho, 3), **options)
    for band, value in enumerate(rho):
        assert np.allclose(together.radiosity[:, band], radiosity.solve(scene(value, 1), **options).radiosity[:, 0])


# Light from outside the mesh


def _floor(reflectance=0.0, half=1.0):
    ring = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0.0]])
    return Surface.from_polygons("floor", diffuse("floor", reflectance), [ring])


def _lit(light=None, *, background=0.0, others=(), elements=400):
    scene = Scene(
        "lit", (_floor(), *others), lights=(light,) if light else (), background=np.array([background]), bands=1
    )
    solution = radiosity.solve(scene, elements=elements, workers=1, tolerance=0.5)
    own = solution.mesh.element_surface == 0
    return solution.mesh.element_centroid[own], solution.element_irradiance[own, 0], solution.mesh.element_area[own]


def _light(kind, **values):
    return Light(
        "light",
        kind,
        np.array([10.0]),
        **{k: np.asarray(v, float) if isinstance(v, list) else v for k, v in values.items()},
    )


def test_point_light():
    where, found, _ = _lit(_light("point", position=[0.2, 0.1, 1.0]))
    d = where - [0.2, 0.1, 1.0]
    wanted = 10.0 / (d**2).sum(axis=1) ** 1.5  # I cos / r^2, height 1
    assert np.abs(found / wanted - 1).max() < 0.05
    assert abs((found / wanted).mean() - 1) < 2e-3


def test_spot_light():
    axis = np.array([0.0, 0.0, -1.0])
    where, found, area = _lit(
        _light("spot", position=[0, 0, 2.0], direction=axis.tolist(), cone_deg=20.0, exponent=4.0), elements=1600
    )
    d = where - [0, 0, 2.0]
    r = np.linalg.norm(d, axis=1)
    wanted = np.where(2.0 / r >= np.cos(np.radians(20)), 10.0 * (2.0 / r) ** 5 / r**2, 0.0)
    edge = np.abs(np.hypot(where[:, 0], where[:, 1]) - 2 * np.tan(np.radians(20))) < 0.06
    assert np.abs(found - wanted)[~edge].max() < 0.03 * wanted.max()
    # Flux in the cone: I 2 pi (1 - c^5) / 5 for cos^4.
    assert area @ found == pytest.approx(10 * 2 * np.pi * (1 - np.cos(np.radians(20)) ** 5) / 5, rel=0.01)


def test_directional_light_and_its_shadow():
    direction = np.array([-1.0, -2.0, -2.0]) / 3
    _, found, _ = _lit(_light("directional", direction=direction.tolist()))
    assert np.allclose(found, 10 * 2 / 3, rtol=1e-12)
    sheet = np.array([[-0.2, -0.3, 0.5], [0.3, -0.3, 0.5], [0.3, 0.3, 0.5], [-0.2, 0.3, 0.5]])
    shade = Surface.from_polygons("sheet", diffuse("sheet", 0.0), [sheet])
    where, found, area = _lit(_light("directional", direction=direction.tolist()), others=(shade,), elements=1600)
    # The shadow is the sheet moved by -0.5 direction / direction_z: area 0.5 x 0.6.
    assert area @ (found == 0) + area @ (found / found.max()) >= area.sum() * 0.9
    assert area @ (1 - found * 1.5 / 10) == pytest.approx(0.3, rel=0.02)
    centre = where[found == 0].mean(axis=0)
    assert centre[:2] == pytest.approx([0.05 - 0.25, 0.0 - 0.5], abs=0.03)


@pytest.mark.parametrize("lambertian", [False, True])
def test_linear_light(lambertian):
    ends = np.array([[-0.7, 0.1, 1.0], [0.9, 0.3, 1.2]])
    light = _light("linear", position=ends[0].tolist(), end=ends[1].tolist(), lambertian=lambertian)
    where, found, _ = _lit(light)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    axis = ends[1] - ends[0]
    length = np.linalg.norm(axis)
    wanted = np.zeros(len(where))
    for t, w in zip((nodes + 1) / 2, weights / 2, strict=True):
        d = ends[0] + t * axis - where
        r = np.linalg.norm(d, axis=1)
        sine = np.sqrt(1 - (d @ axis / (r * length)) ** 2) if lambertian else 1.0
        wanted += w * length * 10.0 * d[:, 2] / r**3 * sine
    assert np.abs(found / wanted - 1).max() < 0.06
    assert abs((found / wanted).mean() - 1) < 5e-3


def test_sky_over_an_open_floor_and_behind_a_wall():
    # An unobstructed horizontal surface: pi L.
    _, found, _ = _lit(background=2.0)
    assert np.allclose(found, 2 * np.pi, rtol=1e-6)
    # A huge wall along one side hides (1 - sin a) / 2 of the sky from its foot, a = 0 there: half.
    wall = np.array([[-1.001, -500, 0], [-1.001, 500, 0], [-1.001, 500, 500], [-1.001, -500, 500.0]])
    others = (Surface.from_polygons("wall", diffuse("black", 0.0), [wall]),)
    where, found, _ = _lit(background=2.0, others=others)
    assert len(found) >= 1
    high = where[:, 0] + 1.001
    # The wall's share of the hemisphere: (1 - cos b) / 2 with tan b = height / distance, b near 90 degrees.
    wanted = 2 * np.pi * (1 - 0.5 * (1 - high / np.hypot(high, 500)))
    assert abs((found / wanted).mean() - 1) < 0.02


def test_a_closed_scene_sees_no_sky():
    inside = replace(unit_cube(0.5, 1.0), background=np.array([100.0]))
    plain = radiosity.solve(unit_cube(0.5, 1.0), elements=1, workers=1)
    assert np.allclose(radiosity.solve(inside, elements=1, workers=1).radiosity, plain.radiosity)
    # Left open, the box itself hides the sky.
    hidden = radiosity.solve(replace(inside, closed=False), elements=1, workers=1)
    assert np.allclose(hidden.radiosity, plain.radiosity, rtol=1e-6)


def test_incident_light_is_reflected_and_booked():
    scene = replace(unit_cube(0.5, 0.0), lights=(_light("point", position=[0.5, 0.5, 0.5]),))
    solution = radiosity.solve(scene, elements=600, workers=1, tolerance=1e-5)
    # A point source of 10 W/sr emits 4 pi 10 W; all of it is absorbed in the end.
    assert solution.book.emitted[0] == pytest.approx(40 * np.pi, rel=5e-3)
    assert solution.book.absorbed[0] == pytest.approx(solution.book.emitted[0], rel=1e-4)
    direct = solution.direct_irradiance[:, 0]
    indirect = solution.element_irradiance[:, 0] - direct
    # Mean indirect irradiance: rho Phi / (S (1 - rho)).
    assert np.average(indirect, weights=solution.mesh.element_area) == pytest.approx(
        0.5 * 40 * np.pi / (6 * 0.5), rel=5e-3
    )
    assert (indirect > 0).all()


# Parts


def test_a_covered_emitter_gives_what_its_visible_part_gives():
    # Furnace with a box on the floor: whatever is covered, the rest glows at e / (1 - rho) = 2, and the mean of
    # a covered element is e + rho 2 v, v being the share of it that is visible.
    room = box_surface("room", diffuse("wall", 0.5, 1.0), *UNIT, inward=True)
    box = box_surface("box", diffuse("box", 0.5, 1.0), [0.25, 0.25, 0.0], [0.75, 0.75, 0.5])
    scene = Scene("furnace", (room, box), bands=1, closed=True)
    solution = radiosity.solve(scene, method="direct", elements=1, workers=1, form_factor_error=1e-4)
    mesh = solution.mesh
    floor = (mesh.element_surface == 0) & (mesh.element_centroid[:, 2] == 0)
    bottom = (mesh.element_surface == 1) & (mesh.element_centroid[:, 2] == 0)
    assert solution.record.results["covered_elements"] == 2
    assert solution.radiosity[floor, 0] == pytest.approx(1 + 0.5 * 2 * 0.75, abs=1e-3)
    assert solution.radiosity[bottom, 0] == 1.0
    assert solution.radiosity[~floor & ~bottom, 0] == pytest.approx(2.0, abs=1e-3)
    # What is emitted under the box stays there: 2 x 0.25.
    assert solution.book.escaped[0] == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("method", ["direct", "matrix", "progressive"])
def test_elements_that_see_nothing_are_left_alone(method):
    # Floor under a box, and the box's own bottom: covered, they have no light and harm nobody.
    options = {"method": method, "max_edge": 0.25, "workers": 1, "tolerance": 1e-5, "form_factor_error": 0.02}
    means = []
    for bottom in (True, False):
        solution = radiosity.solve(standing_box(bottom=bottom), **options)
        mesh = solution.mesh
        assert np.isfinite(solution.radiosity).all()
        if bottom:
            hidden = (mesh.element_surface == 2) & (mesh.element_normal[:, 2] < -0.5)
            assert hidden.any() and (solution.element_irradiance[hidden] == 0).all()
        lamp = mesh.element_surface == 1
        means.append(np.average(solution.radiosity[lamp, 0], weights=mesh.element_area[lamp]))
    assert means[0] == pytest.approx(means[1], rel=0.01)


def test_row_sums_keep_to_the_stated_error_in_a_closed_room_with_an_occluder():
    # A box afloat in a room: cuts, shafts and closed forms together; every row should sum to one.
    box = box_surface("box", diffuse("box", 0.5), [0.3, 0.35, 0.2], [0.6, 0.65, 0.45])
    room = replace(standing_box(), surfaces=(*standing_box().surfaces[:2], box))
    solution = radiosity.solve(room, method="direct", elements=60, workers=1, form_factor_error=0.01)
    sums = solution.record.errors["row_sum"]
    assert sums["rows"] == solution.mesh.element_count > 20
    assert max(1 - sums["min"], sums["max"] - 1) <= sums["stated_error"]
    assert sums["stated_error"] < 0.05


def test_the_matrix_solver_agrees_with_its_judge():
    scene = standing_box(bottom=False)
    fine = radiosity.solve(scene, method="direct", elements=150, form_factor_error=1e-3, workers=1)
    fast = radiosity.solve(scene, method="matrix", elements=150, form_factor_error=2e-3, workers=1)
    assert fast.mesh.element_count == fine.mesh.element_count
    off = (fast.element_irradiance - fine.element_irradiance) / fine.element_irradiance.mean()
    stated = fast.record.errors["irradiance_form_factors_rms"] + fine.record.errors["irradiance_form_factors_rms"]
    assert np.sqrt((off**2).mean()) < min(3 * stated, 0.02)
    assert fast.book.imbalance(fast.unshot_power) < 1e-12
    two = radiosity.solve(scene, method="matrix", elements=150, form_factor_error=2e-3, workers=2)
    assert (two.radiosity == fast.radiosity).all()


def test_an_interrupted_matrix_solve_leaves_the_emission():
    solution = radiosity.solve(cube_with_emitter(0.3, 0.6), method="matrix", elements=100, progress=Stop(1), workers=1)
    assert solution.stopped == "interrupted" and not solution.converged
    assert (solution.radiosity == solution.mesh.emission).all()
