"""Why a solve does what it does: what the solver uses and leaves out, and what each decision saves.

Every saving is measured: the same question is asked again with one decision switched off.  The
answers are compared with a better one, so that what a decision costs in accuracy stands beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from radiosity.accuracy import solve, surface_points
from radiosity.form_factors.bundle import LinkSettings, ReceiverBundles
from radiosity.report.metrics import relative_rms
from radiosity.sensors import Gatherer
from radiosity.solvers.solution import Solution
from radiosity.solvers.solve import _settings
from workbench.geometry.flat import Geometry
from workbench.scene.model import Scene
from workbench.shadow.lights import lights_of_scene
from workbench.shadow.occlusion import Shader
from workbench.study.result import interleaved

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Ablation", "Explanation", "draw_ablations", "explain"]

FloatArray = NDArray[np.float64]

PATCHES = 24
"""Patches whose form factors are found again with decisions switched off."""
POINTS = 512
"""Points at which shadows are found again."""
MOST_SAMPLES = 4096
"""Rays a point at which the search for as many as the error needs ends."""
MOST_DOUBLINGS = 3


@dataclass(frozen=True)
class Ablation:
    """One decision, and the same work without it.

    Parameters
    ----------
    part : str
        ``mesh``, ``form factors`` or ``shadows``.
    decision, without : str
        What is done, and what is done in its place.
    seconds, seconds_without : float
        Medians of interleaved runs.
    error, error_without : float
        Relative, against a better answer.
    """

    part: str
    decision: str
    without: str
    seconds: float
    seconds_without: float
    error: float
    error_without: float

    @property
    def ratio(self) -> float:
        """How many times as long the work takes without the decision."""
        return self.seconds_without / self.seconds


@dataclass
class Explanation:
    """What :func:`explain` found: facts in words, ablations, and the solution that they are about."""

    solution: Solution
    facts: list[str] = field(default_factory=list)
    ablations: list[Ablation] = field(default_factory=list)


def explain(
    scene: Scene, *, error: float = 0.05, method: str = "auto", workers: int | None = None, seed: int = 0,
    repeats: int = 3, report: Callable[[str], None] = lambda line: None,
) -> Explanation:  # fmt: skip
    """Solve a scene to an error, say how, and switch each decision off in turn.

    Parameters
    ----------
    scene : Scene
    error, method : float, str
        As in :func:`radiosity.solve`.
    workers : int, optional
    seed : int
    repeats : int
        Runs of each ablation, interleaved.
    report : callable
        Called with a line before each part of the work.

    Raises
    ------
    InputError, OptionError, MemoryForecastError
        As :func:`radiosity.solve`.
    """
    report("solving ...")
    solution = solve(scene, error=error, method=method, workers=workers, seed=seed)
    found = Explanation(solution)
    geometry = Geometry.from_scene(scene)
    _mesh_facts(found, geometry, error)
    if solution.record.settings["method"] != "matrix":  # whose decisions are told with the meshes
        report("finding form factors with decisions switched off ...")
        _links(found, geometry, seed, repeats)
    report("finding shadows with decisions switched off ...")
    points = surface_points(solution.mesh, POINTS, seed=3)
    _shadows(found, geometry, points, error, seed, repeats, workers)
    report("solving other meshes ...")
    _meshes(found, points, error, seed, workers)
    return found


# ---- what was done ----------------------------------------------------------------------------------


def _mesh_facts(found: Explanation, geometry: Geometry, error: float) -> None:
    solution, record = found.solution, found.solution.record
    mesh, estimate = solution.mesh, record.errors["estimate"]
    elements = np.bincount(mesh.element_surface, minlength=len(geometry.surface_name))
    sides = np.array([2 if material.two_sided else 1 for material in geometry.surface_material])
    polygons = np.bincount(geometry.polygon_surface, minlength=len(elements)) * sides
    whole = [name for name, e, p in zip(geometry.surface_name, elements, polygons, strict=True) if e == p]
    fewer = [name for name, e, p in zip(geometry.surface_name, elements, polygons, strict=True) if 0 < e < p]
    finest = np.argsort(-elements, kind="stable")[:3]
    method = record.choices.get("method", record.settings.get("method", ""))
    reached = "reached" if record.results["target_reached"] else "not reached"
    found.facts += [
        f"asked error {error:g}: {reached}, estimated {estimate['total']:.2g} (meshing {estimate['meshing']:.2g}, form"
        f" factors {estimate['form_factors']:.2g}, visibility {estimate['visibility']:.2g}, convergence"
        f" {estimate['convergence']:.2g}); stopped because {record.choices['stop']}",
        f"method: {method}",
        f"meshes tried: {', '.join(str(level['elements']) for level in record.results['levels'])} elements;"
        f" the last has {mesh.element_count:,} elements and {mesh.patch_count:,} shooting patches",
        f"most elements on {', '.join(f'{geometry.surface_name[i]!r} ({elements[i]})' for i in finest)}",
        f"surfaces not subdivided: {_listed(whole)}",
    ]
    if fewer:
        found.facts.append(f"surfaces with fewer elements than facets (clustered): {_listed(fewer)}")
    counts = record.counters
    checked = counts["shaft_tests"] + counts["plane_vertex_checks"]
    culled = counts["shaft_culls"] + counts["plane_vertex_culls"]
    found.facts.append(
        f"form factors: {counts['closed_forms']:,} closed forms, {counts['exact_cuts']:,} exact cuts,"
        f" {counts['rays']:,} rays; shafts and planes set aside {culled:,} of {checked:,} candidates"
        + (f" ({culled / checked:.0%})" if checked else "")
    )


def _listed(names: Sequence[str]) -> str:
    names = list(dict.fromkeys(names))
    if not names:
        return "none"
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


# ---- form factors -----------------------------------------------------------------------------------


def _links(found: Explanation, geometry: Geometry, seed: int, repeats: int) -> None:
    """Form factors to some patches: the brightest ones and an even choice of the rest."""
    mesh, record = found.solution.mesh, found.solution.record
    power = np.add.reduceat((mesh.emission * mesh.element_area[:, None]).sum(axis=1), mesh.patch_start[:-1])
    bright = np.argsort(-power, kind="stable")[: PATCHES // 4]
    even = np.linspace(0, mesh.patch_count - 1, PATCHES - len(bright)).astype(np.int64)
    chosen = np.unique(np.concatenate([bright, even]))
    asked = float(record.choices["form_factor_error"])
    rays = int(record.settings["rays"])
    used = _settings(asked, rays, seed, mesh.patch_count)
    workers = int(record.settings["workers"])

    def columns(settings: LinkSettings) -> FloatArray:
        bundles = ReceiverBundles(geometry, mesh, settings, workers)
        try:
            return bundles.columns(chosen).factor
        finally:
            bundles.close()

    variants = {
        "used": used,
        "cut": replace(used, candidates=0),
        "rays": replace(used, candidates=40),
        "closed": replace(used, closed_forms=not used.closed_forms),
        "floor": replace(used, floor=1e-9),
        "error": _settings(min(asked / 10, 1e-3), rays, seed, mesh.patch_count),
    }
    better = columns(replace(_settings(min(asked / 30, 3e-4), rays * 16, seed + 1, mesh.patch_count)))
    columns(used)
    seconds, answers = interleaved({name: partial(columns, s) for name, s in variants.items()}, repeats)
    where = better > 0

    def error(name: str) -> float:
        return relative_rms(answers[name][where][:, None], better[where][:, None])[0]

    words = {
        "cut": ("short lists of candidates are cut exactly", "rays for all"),
        "rays": (f"more than {used.candidates} candidates get rays", "up to 40 are cut exactly"),
        "closed": ("closed forms for near pairs only", "closed forms for all that is clear")
        if not used.closed_forms
        else ("closed forms for all that is clear", "closed forms for near pairs only"),
        "floor": ("faint form factors get less care", "all get the same"),
        "error": (f"form factors to {asked:g}, as the error needs", f"form factors to {min(asked / 10, 1e-3):g}"),
    }
    base = float(np.median(seconds["used"]))
    for name, (decision, without) in words.items():
        took = float(np.median(seconds[name]))
        found.ablations.append(Ablation("form factors", decision, without, base, took, error("used"), error(name)))


# ---- shadows ----------------------------------------------------------------------------------------


def _shadows(
    found: Explanation, geometry: Geometry, where: tuple[Any, Any, Any], error: float, seed: int, repeats: int,
    workers: int | None,
) -> None:  # fmt: skip
    """Direct light at points: automatic, and with cullers, exact cuts or the smooth fit switched off."""
    scene = found.solution.scene
    lights = list(lights_of_scene(scene, geometry))
    if not lights:
        found.facts.append("lights: none but the background, which rays gather")
        return
    shader = Shader(geometry, workers)
    points, normals, own = where

    def ask(method: str, samples: int = 64) -> Any:
        return shader.estimate(
            points, normals, lights, method, error=error, samples=samples, seed=seed, own_polygon=own
        )  # fmt: skip

    exact = ask("exact").irradiance
    if not exact.any():
        found.facts.append("lights: none reaches a surface directly")
        return

    def off(estimate: Any) -> float:
        return relative_rms(estimate.irradiance, exact)[0]

    automatic = ask("auto")
    goal = max(error, off(automatic))
    _light_facts(found, lights, automatic)
    tasks: dict[str, Callable[[], Any]] = {"auto": partial(ask, "auto"), "exact": partial(ask, "exact")}
    needed: dict[str, int] = {}
    for method in ("rays", "shaft"):
        samples = 4
        while samples < MOST_SAMPLES and off(ask(method, samples)) > goal:
            samples *= 2
        needed[method] = samples
        tasks[method] = partial(ask, method, samples)
    seconds, answers = interleaved(tasks, repeats)
    base, reached = float(np.median(seconds["auto"])), off(answers["auto"])
    words = {
        "rays": ("cullers settle what is clear or dark", f"{needed['rays']} rays at every point"),
        "shaft": (
            "as many rays as the error asks, where a fit needs them",
            f"{needed['shaft']} at every crowded point",
        ),
        "exact": ("rays where candidates are many", "exact cuts everywhere"),
    }
    for name, (decision, without) in words.items():
        took = float(np.median(seconds[name]))
        found.ablations.append(Ablation("shadows", decision, without, base, took, reached, off(answers[name])))


def _light_facts(found: Explanation, lights: Sequence[Any], estimate: Any) -> None:
    states = np.asarray(estimate.state)
    reached = np.asarray(estimate.open_share) > 0
    exact: list[str] = []
    sampled: list[str] = []
    for index, light in enumerate(lights):
        rays = (np.asarray(estimate.candidates)[:, index] > 12) & (states[:, index] == 2)
        (sampled if rays.any() else exact).append(light.name)
    count = max(int(reached.sum()), 1)
    clear, dark, rest = (float(((states == k) & reached).sum()) / count for k in range(3))
    found.facts += [
        f"lights without noise (closed forms and exact cuts): {_listed(exact)}; sampled where crowded:"
        f" {_listed(sampled)}",
        f"points that a light may reach: {clear:.0%} see it whole, {dark:.0%} not at all, {rest:.0%} in part; "
        f"{estimate.counters['rays'] / len(states):.2g} rays a point",
    ]


# ---- meshes -----------------------------------------------------------------------------------------


def _meshes(
    found: Explanation, where: tuple[Any, Any, Any], error: float, seed: int, workers: int | None
) -> None:  # fmt: skip
    """The same light read off the mesh without a gather, and from a mesh twice as fine."""
    from time import perf_counter

    from radiosity.element_lookup import ElementLookup

    points, normals, polygons = where
    final = found.solution
    count = final.mesh.element_count
    settings = {
        name: final.record.settings[name] for name in ("method", "rays", "tolerance", "form_factor_error", "seed")
    } | {"workers": workers}
    flat = polygons >= 0

    def solved(elements: int = count, **other: Any) -> tuple[Solution, float]:
        start = perf_counter()
        solution = solve(final.scene, elements=elements, **(settings | other))
        return solution, perf_counter() - start

    def gathered(solution: Solution) -> tuple[FloatArray, float]:
        start = perf_counter()
        found = Gatherer(solution, workers=workers, seed=seed).irradiance(
            points, normals, own_polygon=polygons, error=0.3 * error
        )
        return found.irradiance, perf_counter() - start

    once, took = solved(count)
    finer, longer = solved(2 * count)
    better, more = gathered(finer)
    values, gathering = gathered(once)
    base = took + gathering
    reached = relative_rms(values[flat], better[flat])[0]
    found.ablations.append(
        Ablation("mesh", f"{count:,} elements are enough", f"{2 * count:,} elements", base, longer + more, reached, 0.0)
    )

    if settings["method"] == "matrix":
        _matrix(found, solved, gathered, better[flat], flat, base, reached)

    def read(solution: Solution) -> float:
        lookup = ElementLookup.build(Geometry.from_scene(solution.scene), solution.mesh)
        element = lookup.elements(points[flat], polygons[flat], np.ones(int(flat.sum()), dtype=bool))
        return relative_rms(solution.element_irradiance[element], better[flat])[0]

    goal = max(error, reached)
    elements, off, spent = count, read(once), took
    for doubling in range(MOST_DOUBLINGS):
        if off <= goal:
            break
        elements = count * 2 ** (doubling + 1)
        mesh, spent = (finer, longer) if doubling == 0 else solved(elements)
        off = read(mesh)
    found.ablations.append(
        Ablation(
            "mesh", "direct light is found at the point", f"read off {elements:,} elements", base, spent, reached, off
        )
    )


def _matrix(
    found: Explanation, solved: Callable[..., tuple[Solution, float]],
    gathered: Callable[..., tuple[FloatArray, float]],
    better: FloatArray, flat: NDArray[np.bool_], base: float, reached: float,
) -> None:  # fmt: skip
    """What the full matrix saves, and what better form factors would cost."""
    asked = float(found.solution.record.settings["form_factor_error"])
    others: list[tuple[str, str, dict[str, Any]]] = [
        ("all form factors at once, pairs settled in groups", "column by column, from each receiver",
         {"method": "progressive", "form_factor_error": None}),
        (f"form factors to {asked:g}, as the error needs", f"form factors to {asked / 10:g}",
         {"form_factor_error": asked / 10}),
    ]  # fmt: skip
    for decision, without, options in others:
        solution, took = solved(**options)
        values, more = gathered(solution)
        off = relative_rms(values[flat], better)[0]
        found.ablations.append(Ablation("form factors", decision, without, base, took + more, reached, off))


# ---- the figure -------------------------------------------------------------------------------------


def draw_ablations(figure: Figure, ablations: Sequence[Ablation], title: str) -> None:
    """How many times as long the work takes without each decision, into an empty figure."""
    figure.set_size_inches(10.0, 1.5 + 0.52 * len(ablations))
    axes = figure.subplots()
    colours = {"mesh": "#009e73", "form factors": "#0072b2", "shadows": "#e69f00"}
    ordered = sorted(ablations, key=lambda item: (list(colours).index(item.part), -item.ratio))
    place = np.arange(len(ordered))
    ratios = [item.ratio for item in ordered]
    axes.barh(place, [r - 1.0 for r in ratios], left=1.0, color=[colours[item.part] for item in ordered], height=0.6)
    axes.axvline(1.0, color="0.3", lw=0.8)
    axes.set_xscale("log")
    low, high = min(0.5, *ratios), max(2.0, *ratios)
    axes.set_xlim(low / 1.6, high * 12.0)
    for row, item in enumerate(ordered):
        text = f"x {item.ratio:.2g};  error {item.error:.2%} -> {item.error_without:.2%}"
        axes.text(max(item.ratio, 1.0) * 1.06, row, text, va="center", fontsize=8)
    axes.set_yticks(place, [f"{item.decision}\nwithout: {item.without}" for item in ordered], fontsize=8)
    axes.invert_yaxis()
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlabel("times as long without the decision (below 1: it does not pay in seconds here)")
    axes.set_title(title, fontsize=11)
    axes.grid(axis="x", alpha=0.25)
    handles = [figure_patch(colour, part) for part, colour in colours.items()]
    axes.legend(handles=handles, fontsize=8, loc="lower right")


def figure_patch(colour: str, label: str) -> Any:
    """A key of the legend."""
    from matplotlib.patches import Patch

    return Patch(facecolor=colour, label=label)
