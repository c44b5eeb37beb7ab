"""Every technique that a chart compares, one adapter each: the same question, a setting that makes it finer.

A *problem* is one question to one scene: direct light at points (shadows), form factors between
polygons (view factors), light at points after all reflections (solve), or a picture (render).  It
makes its techniques by name.  A new technique is one method of the problem and one line in its
table.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radiosity.report.metrics import resolution
from radiosity.rivals import RIVALS, Rival, open_rival
from radiosity.rivals.base import black_lamps
from radiosity.surface_grid import surface_grid
from workbench.counters import Counters
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.scene.model import Scene

__all__ = ["PROBLEMS", "Answer", "Problem", "Reference", "Technique", "problem_for"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Answer:
    """``values`` (n, ...) in the problem's shape, counts of work, and the error that the technique itself states.

    ``stated`` may be a function, called when the seconds have been taken: of a technique that looks again for it.
    """

    values: FloatArray
    counters: Mapping[str, int] = field(default_factory=dict)
    stated: float | Callable[[], float] | None = None


@dataclass(frozen=True)
class Technique:
    """One way to answer, with the setting that makes it finer.

    Parameters
    ----------
    name : str
    key : str
        What the setting is called.
    values : tuple of float
        Settings of a chart that names none, coarse to fine.
    ask : callable
        ``ask(value, seed)`` answers.
    kind : str
        ``"ours"``, ``"auto"`` (the setting is the wanted error) or ``"rival"``.
    seeded : bool
        Whether the seed changes the answer.
    """

    name: str
    key: str
    values: tuple[float, ...]
    ask: Callable[[float, int], Answer]
    kind: str = "ours"
    seeded: bool = True


@dataclass(frozen=True)
class Reference:
    """What answers are judged by: ``values`` (n, ...), their ``variance`` and relative ``error`` where known.

    With a variance, which is taken off, ``error`` is the relative noise.
    """

    name: str
    values: FloatArray
    variance: FloatArray | float = 0.0
    error: float = 0.0


class Problem:
    """One question to one scene; see :data:`PROBLEMS`."""

    what = ""
    question = ""
    """What a rival is asked, of :data:`radiosity.rivals.QUESTIONS`."""
    error_label = ""
    own: tuple[str, ...] = ()
    default_reference = "converged"

    def __init__(self, scene: Scene, *, workers: int | None = None) -> None:
        self.scene = scene
        self.workers = workers or len(os.sched_getaffinity(0))
        self.geometry = Geometry.from_scene(scene)

    @property
    def title(self) -> str:
        """The question in words."""
        return self.what

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """All techniques, ours first."""
        return (*cls.own, *(name for name in RIVALS if cls.question in _rival_answers(name)))

    def technique(self, name: str) -> Technique:
        """The technique of that name, made ready.

        Raises
        ------
        OptionError
            If it is unknown, absent here or cannot answer for this scene; the message says why.
        """
        if name in self.own:
            made: Technique = getattr(self, "_" + name.replace("+", "_").replace("-", "_"))()
            return made
        if name not in self.names():
            raise OptionError(f"methods: found {name!r}, expected one or more of {', '.join(self.names())}")
        return self._rival(name, open_rival(name, self.scene))

    def _rival(self, name: str, rival: Rival) -> Technique:
        raise NotImplementedError

    def reference(self, kind: str) -> Reference:
        """What answers are judged by: ``"exact"``, ``"converged"``, a rival's name, or ``"RIVAL:SAMPLES"``."""
        raise NotImplementedError

    def judged(self, values: FloatArray) -> FloatArray:
        """Values as they are compared."""
        return values

    def floor(self, reference: Reference) -> float:
        """Relative error below which nothing can be told with that reference."""
        if isinstance(reference.variance, np.ndarray) and reference.variance.any():
            return resolution(self.judged(reference.values), self.judged(reference.variance))
        return reference.error


def _rival_answers(name: str) -> frozenset[str]:
    # Without importing the engine: the classes import it when they open a scene.
    import importlib

    module, kind, _ = RIVALS[name]
    answers: frozenset[str] = getattr(importlib.import_module(module), kind).answers
    return answers


RIVAL_RUNS = 8
"""Independent runs of a rival that make a reference: enough to know its variance."""


def _repeated(ask: Callable[[int], FloatArray], name: str, runs: int = 4) -> Reference:
    """The mean of runs with different seeds, and its variance."""
    found = np.stack([ask(1000 + seed) for seed in range(runs)])
    variance = found.var(axis=0, ddof=1) / runs
    values = found.mean(axis=0)
    return Reference(name, values, variance, float(np.sqrt(variance.mean()) / np.abs(values).mean()))


# ---- shadows ------------------------------------------------------------------------------------


class Shadows(Problem):
    """Direct irradiance at a grid of points on a surface, [W m-2]."""

    what, question, default_reference = "shadows", "direct", "exact"
    error_label = "error: rms over the points / mean irradiance"
    own = (
        "auto", "exact", "shaft", "rays", "adaptive", "camera", "camera-optimised", "voxel+rayID", "voxel+plane-vertex",
    )  # fmt: skip

    def __init__(
        self,
        scene: Scene,
        *,
        grid: tuple[int, int] = (48, 48),
        surface: str | None = None,
        workers: int | None = None,
    ) -> None:
        from workbench.shadow.lights import lights_of_scene
        from workbench.shadow.occlusion import Shader

        super().__init__(black_lamps(scene), workers=workers)  # which changes nothing of direct light
        self.sensors = surface_grid(scene, self.geometry, surface, grid)
        self.lights = list(lights_of_scene(scene, self.geometry))
        if not self.lights:
            raise InputError(f"{scene.name}: found no light, expected a light or a surface with emission")
        self.shader = Shader(self.geometry, self.workers)

    @property
    def title(self) -> str:
        """The question in words."""
        return (
            f"direct light at {len(self.sensors.points):,} points on {self.sensors.name}, {len(self.lights)} light(s), "
            f"{self.geometry.polygon_count:,} polygons"
        )

    def _estimate(self, method: str, seed: int, **options: Any) -> Answer:
        found = self.shader.estimate(
            self.sensors.points, self.sensors.normals, self.lights, method, seed=seed,
            own_polygon=self.sensors.own, **options,
        )  # fmt: skip
        mean = float(found.irradiance.mean())
        stated = float(np.sqrt((found.standard_error**2).mean())) / mean if mean > 0 else None
        return Answer(found.irradiance, dict(found.counters), stated)

    def _by_samples(self, name: str, method: str, values: tuple[int, ...], key: str = "samples") -> Technique:
        return Technique(
            name, key, values, lambda value, seed: self._estimate(method, seed, samples=int(value)),
            seeded=not method.startswith("camera"),
        )  # fmt: skip

    def _auto(self) -> Technique:
        return Technique(
            "auto", "error", (0.1, 0.03, 0.01, 0.003, 0.001),
            lambda value, seed: self._estimate("auto", seed, error=value), kind="auto",
        )  # fmt: skip

    def _exact(self) -> Technique:
        return Technique(
            "exact", "samples", (1,), lambda value, seed: self._estimate("exact", seed, samples=1), seeded=False
        )

    def _shaft(self) -> Technique:
        return self._by_samples("shaft", "shaft", (4, 16, 64, 256, 1024))

    def _rays(self) -> Technique:
        return self._by_samples("rays", "rays", (2, 4, 16, 64, 256, 1024))

    def _adaptive(self) -> Technique:
        return self._by_samples("adaptive", "adaptive", (16, 64, 256))

    def _camera(self) -> Technique:
        return self._by_samples("camera", "camera", (16, 64, 256, 1024), "pixels")

    def _camera_optimised(self) -> Technique:
        return self._by_samples("camera-optimised", "camera-optimised", (16, 64, 256, 1024), "pixels")

    def _voxel_plane_vertex(self) -> Technique:
        return self._by_samples("voxel+plane-vertex", "rays+plane-vertex", (4, 16, 64))

    def _voxel_rayID(self) -> Technique:
        from workbench.accel.voxel_grid import VoxelGrid
        from workbench.shadow._sampled import Bundle, woo_shares
        from workbench.shadow.lights import PolygonLight
        from workbench.shadow.occlusion import LIFT

        grid = VoxelGrid(self.geometry)
        points, normals = self.sensors.points, self.sensors.normals
        lights: list[PolygonLight] = []
        for light in self.lights:
            if isinstance(light, PolygonLight) and not light.two_sided and len(light.parts) == 1:
                lights.append(light)
            else:
                raise OptionError(f"voxel+rayID: light {light.name!r} is no convex one-sided polygon; leave it out")

        def ask(value: float, seed: int) -> Answer:
            counters = Counters()
            total = np.zeros((len(points), self.scene.bands))
            bundle = Bundle(
                points, normals, np.arange(len(points)), self.sensors.own, int(value), seed, self.workers,
                LIFT * self.geometry.size,
            )  # fmt: skip
            for light in lights:
                open_share = light.unit_irradiance(points, normals)
                share, _ = woo_shares(
                    grid, bundle, light.parts[0], light.normal, int(light.polygons[0]), False, counters
                )
                total += (share * open_share)[:, None] * light.power
            return Answer(total, dict(counters))

        return Technique("voxel+rayID", "samples", (4, 16, 64), ask)

    def _rival(self, name: str, rival: Rival) -> Technique:
        def ask(value: float, seed: int) -> Answer:
            points, normals = self.sensors.points, self.sensors.normals
            return Answer(rival.irradiance(points, normals, samples=int(value), seed=seed, direct_only=True))

        return Technique(name, "samples", (4, 16, 64, 256, 1024), ask, kind="rival")

    def reference(self, kind: str) -> Reference:
        """Exact cuts, or 4 x 4,096 rays."""
        if kind == "exact":
            found = self._estimate("exact", 0)
            return Reference("exact cuts", found.values, 0.0, found.stated if isinstance(found.stated, float) else 0.0)
        if kind == "converged":
            return _repeated(lambda seed: self._estimate("rays", seed, samples=4096).values, "4 x 4,096 rays a point")
        return _rival_reference(self, kind, 4096)


def _rival_reference(problem: Problem, asked: str, samples: int) -> Reference:
    kind, _, given = asked.partition(":")
    if given.isdecimal() and int(given) > 0:
        samples = int(given)
    elif given:
        raise OptionError(f"reference: found {asked!r}, expected RIVAL:SAMPLES with a whole number of samples")
    if kind not in problem.names() or kind in problem.own:
        raise OptionError(
            f"reference: found {kind!r}, expected exact, converged, FILE.npy or a rival that answers this"
        )
    technique = problem.technique(kind)
    name = f"{kind}, {RIVAL_RUNS} x {samples:,} samples"
    return _repeated(lambda seed: technique.ask(samples, seed).values, name, RIVAL_RUNS)


# ---- view factors -------------------------------------------------------------------------------


class ViewFactors(Problem):
    """Form factors between all polygons of a scene."""

    what, question, default_reference = "viewfactors", "view factors", "exact"
    error_label = "error: rms over the pairs / mean form factor"
    own = ("auto", "bundle", "hemicube", "rays")

    @property
    def title(self) -> str:
        """The question in words."""
        return f"form factors between {self.geometry.polygon_count:,} polygons"

    @cached_property
    def _mesh(self) -> Any:
        from radiosity.patches import build_mesh

        if any(material.two_sided for material in self.geometry.surface_material):
            raise OptionError("viewfactors: found a two-sided surface, expected one-sided ones")
        return build_mesh(self.scene, self.geometry, split=1, cluster=False)

    def _columns(self, settings: Any) -> tuple[FloatArray, Counters]:
        from radiosity.form_factors.bundle import ReceiverBundles

        bundles = ReceiverBundles(self.geometry, self._mesh, settings, self.workers)
        try:
            factor = bundles.columns(np.arange(self._mesh.patch_count)).factor.T
        finally:
            bundles.close()
        counters = Counters()
        counters.merge(bundles.counters)
        # Element i of the mesh is some polygon; hand the matrix back in the scene's order.
        order = np.argsort(self._mesh.element_polygon)
        return np.ascontiguousarray(factor[np.ix_(order, order)]), counters

    def _auto(self) -> Technique:
        from radiosity.form_factors.matrix import view_factors

        order = np.argsort(self._mesh.element_polygon)

        def ask(value: float, seed: int) -> Answer:
            found = view_factors(self.scene, error=value, workers=self.workers, seed=seed)
            stated = found.standard_error
            doubt = stated if isinstance(stated, np.ndarray) else stated.toarray()
            mean = float(found.dense().mean())
            return Answer(
                found.dense()[np.ix_(order, order)], dict(found.record.counters),
                float(np.sqrt((doubt**2).mean())) / mean if mean > 0 else None,
            )  # fmt: skip

        return Technique("auto", "error", (0.1, 0.03, 0.01, 0.003, 0.001), ask, kind="auto")

    def _bundle(self) -> Technique:
        from radiosity.solvers.solve import _settings

        def ask(value: float, seed: int) -> Answer:
            values, counters = self._columns(_settings(value, 16, seed, self._mesh.patch_count))
            return Answer(values, dict(counters))

        return Technique("bundle", "error", (0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 0.0001), ask)

    def _sample_points(self, count: int, seed: int) -> tuple[FloatArray, FloatArray, IntArray, FloatArray]:
        """Points spread over every polygon, their normals, polygons, and shares of their polygon's area."""
        from workbench.sampling.warp import square_to_triangle

        corners, piece = self.geometry.triangles
        edges = corners[:, 1:] - corners[:, :1]
        area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        polygon = self.geometry.piece_polygon[piece]
        share = area / self.geometry.polygon_area[polygon]
        many = np.maximum(1, np.round(count * share).astype(np.int64))
        rng = np.random.default_rng(seed)
        golden = np.array([0.7548776662466927, 0.5698402909980532])  # R2 sequence (M. Roberts 2018)
        points, weights = [], []
        for ring, n, part in zip(corners, many, share, strict=True):
            unit = (rng.random(2) + np.arange(n)[:, None] * golden) % 1.0
            points.append(square_to_triangle(unit, ring))
            weights.append(np.full(n, part / n))
        owner = np.repeat(polygon, many)
        return np.concatenate(points), self.geometry.polygon_normal[owner], owner, np.concatenate(weights)

    def _summed(self, per_point: FloatArray, owner: IntArray, weight: FloatArray) -> FloatArray:
        total = np.zeros((self.geometry.polygon_count, self.geometry.polygon_count))
        np.add.at(total, owner, per_point * weight[:, None])
        return total

    def _no_panes(self, name: str) -> None:
        """Refuse panes for a technique that ends at the first surface met."""
        for material in self.geometry.surface_material:
            if material.transmittance.any():
                raise OptionError(f"{name}: found the pane {material.name!r}, which it takes for opaque; leave it out")

    def _hemicube(self) -> Technique:
        self._no_panes("hemicube")
        from workbench.accel.box_tree import BoxTree
        from workbench.shadow.hemicube import hemicube_deltas, hemicube_items

        tree = BoxTree.build(self.geometry)
        normal = self.geometry.polygon_normal
        first = self.geometry.corners[self.geometry.piece_start[self.geometry.polygon_piece_start[:-1]]]

        def ask(value: float, seed: int) -> Answer:
            counters = Counters()
            points, normals, owner, weight = self._sample_points(int(value), seed)
            resolution = 50
            items = hemicube_items(
                points, normals, self.geometry, resolution=resolution, own_polygon=owner, seed=seed, tree=tree,
                counters=counters, workers=self.workers,
            )  # fmt: skip
            deltas = hemicube_deltas(resolution, normalised=True)
            seen = np.stack([np.bincount(row + 1, deltas, len(normal) + 1)[1:] for row in items])
            front = np.einsum("ijk,jk->ij", points[:, None] - first[None], normal) > 0.0  # backs are black
            return Answer(self._summed(seen * front, owner, weight), dict(counters))

        return Technique("hemicube", "hemicubes a polygon", (1, 4, 16, 64, 256), ask)

    def _rays(self) -> Technique:
        self._no_panes("rays")
        from radiosity.form_factors.hemisphere_rays import RANDOMISATIONS, HemisphereRays

        mesh = self._mesh
        source = HemisphereRays(mesh, mesh.element_polygon)

        def ask(value: float, seed: int) -> Answer:
            counters = Counters()
            rays = max(1, round(value / RANDOMISATIONS))
            hits, _ = source.hits(rays, 0, seed, map, counters)
            return Answer(hits / (rays * RANDOMISATIONS), dict(counters))

        return Technique("rays", "rays a polygon", (256, 1024, 4096, 16384, 65536, 262144), ask)

    def _rival(self, name: str, rival: Rival) -> Technique:
        values = (1, 4, 16, 64) if name == "pyviewfactor" else (256, 1024, 4096, 16384, 65536)
        key = "elements a polygon" if name == "pyviewfactor" else "rays a polygon"
        return Technique(
            name, key, values, lambda value, seed: Answer(rival.view_factors(samples=int(value), seed=seed)),
            kind="rival", seeded=name != "pyviewfactor",
        )  # fmt: skip

    def reference(self, kind: str) -> Reference:
        """Form factors to 1e-6 by exact cuts (up to 64 polygons), or 4 x 1,048,576 rays a polygon."""
        from radiosity.solvers.solve import _settings

        if kind == "exact":
            if self.geometry.polygon_count > 64:
                raise OptionError(
                    f"reference: found {self.geometry.polygon_count} polygons, expected at most 64 for exact ones;"
                    " ask for --reference converged"
                )
            return Reference("exact cuts to 1e-6", self._columns(_settings(1e-6, 16, 0, self._mesh.patch_count))[0])
        if kind == "converged":
            ask = self._rays().ask
            return _repeated(lambda seed: ask(1 << 20, seed).values, "4 x 1,048,576 rays a polygon")
        return _rival_reference(self, kind, 1 << 20)


# ---- solve --------------------------------------------------------------------------------------


class Solve(Problem):
    """Irradiance at points on the reflecting surfaces after all reflections, [W m-2]."""

    what, question = "solve", "irradiance"
    error_label = "error: rms over the points / mean irradiance"
    own = (
        "auto", "matrix", "matrix+gather", "progressive", "progressive+gather", "directional", "directional+gather",
        "hierarchical", "hierarchical+gather", "direct", "direct+gather",
    )  # fmt: skip
    gather_share = 0.5
    """``auto``: share of the wanted error that is left to gathering."""

    def __init__(self, scene: Scene, *, points: int = 256, workers: int | None = None) -> None:
        super().__init__(black_lamps(scene), workers=workers)
        self.points, self.normals, self.polygons = self._spread(points)

    @property
    def title(self) -> str:
        """The question in words."""
        return f"irradiance at {len(self.points):,} points on all surfaces, {self.geometry.polygon_count:,} polygons"

    def _spread(self, count: int) -> tuple[FloatArray, FloatArray, IntArray]:
        """Points uniform by area over what does not emit; always the same."""
        from workbench.sampling.warp import square_to_triangle

        corners, piece = self.geometry.triangles
        polygon = self.geometry.piece_polygon[piece]
        lamp = np.array([material.emission.any() for material in self.geometry.surface_material])
        edges = corners[:, 1:] - corners[:, :1]
        area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        area[lamp[self.geometry.polygon_surface[polygon]]] = 0.0
        if not area.any():
            raise InputError(f"{self.scene.name}: found no surface that does not emit, expected one to ask about")
        rng = np.random.default_rng(20)
        # Systematic: each stretch of the summed area holds one point.
        place = (np.arange(count) + rng.random(count)) / count * area.sum()
        chosen = np.searchsorted(np.cumsum(area), place, side="right").clip(max=len(area) - 1)
        chosen = np.where(area[chosen] > 0, chosen, int(np.argmax(area)))
        points = np.concatenate([square_to_triangle(rng.random(2), corners[k])[None] for k in chosen])
        return points, self.geometry.polygon_normal[polygon[chosen]], polygon[chosen]

    def _solved(self, options: dict[str, Any], seed: int) -> Any:
        from radiosity.solvers.solve import solve

        return solve(self.scene, workers=self.workers, seed=seed, **options)

    def _read(self, solution: Any) -> FloatArray:
        """Irradiance of the element under each point."""
        from radiosity.element_lookup import ElementLookup

        lookup = ElementLookup.build(self.geometry, solution.mesh)
        element = lookup.elements(self.points, self.polygons, np.ones(len(self.points), dtype=bool))
        return np.asarray(solution.element_irradiance[element])

    def _gathered(self, solution: Any, error: float, seed: int) -> tuple[FloatArray, Mapping[str, int]]:
        from radiosity.sensors import Gatherer

        found = Gatherer(solution, workers=self.workers, seed=seed).irradiance(
            self.points, self.normals, own_polygon=self.polygons, error=error
        )
        counters = Counters()
        counters.merge(solution.record.counters)
        counters.merge(found.counters)
        return found.irradiance, dict(counters)

    def _meshed(self, name: str, method: str, values: tuple[int, ...], gather: bool, **more: Any) -> Technique:
        def ask(value: float, seed: int) -> Answer:
            # Finer meshes are worth better form factors, less light left and a better gather: a gathered mesh of
            # n elements is off by about 0.3 / sqrt(n) while n is small, then by 3 / n.
            fine = 0.3 / math.sqrt(value)
            options: dict[str, Any] = {"method": method, "elements": int(value)} | more
            if method != "hierarchical":  # which chooses better for itself
                options["form_factor_error"] = min(2.0 * fine, 0.2)
            if method not in ("direct", "matrix"):  # which know no light left unshot
                options["tolerance"] = min(fine, 0.2)
            solution = self._solved(options, seed)
            if not gather:
                return Answer(self._read(solution), dict(solution.record.counters))
            return Answer(*self._gathered(solution, min(0.1, 4.0 / value, 60.0 / value**1.4), seed))

        return Technique(name, "elements", values, ask)

    def _auto(self) -> Technique:
        from radiosity.accuracy import solve

        def ask(value: float, seed: int) -> Answer:
            solution = solve(self.scene, error=value, workers=self.workers, seed=seed)
            values, counters = self._gathered(solution, self.gather_share * value, seed)
            stated = math.hypot(float(solution.record.errors["estimate"]["total"]), self.gather_share * value)
            return Answer(values, counters, stated)

        return Technique("auto", "error", (0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001), ask, kind="auto")

    def _hierarchical(self) -> Technique:
        return self._meshed("hierarchical", "hierarchical", (100, 400, 1600), False)

    def _hierarchical_gather(self) -> Technique:
        return self._meshed("hierarchical+gather", "hierarchical", (100, 200, 800, 3200, 12800), True)

    def _matrix(self) -> Technique:
        return self._meshed("matrix", "matrix", (100, 400, 1600), False)

    def _matrix_gather(self) -> Technique:
        return self._meshed("matrix+gather", "matrix", (16, 50, 200, 400, 800, 1600, 3200, 6400), True)

    def _progressive(self) -> Technique:
        return self._meshed("progressive", "progressive", (100, 400, 1600), False)

    def _progressive_gather(self) -> Technique:
        return self._meshed("progressive+gather", "progressive", (16, 50, 200, 800), True)

    def _directional(self) -> Technique:
        return self._meshed("directional", "progressive", (100, 400, 1600), False, bundles="directional")

    def _directional_gather(self) -> Technique:
        return self._meshed("directional+gather", "progressive", (16, 50, 200), True, bundles="directional")

    def _direct(self) -> Technique:
        return self._meshed("direct", "direct", (50, 100, 200), False)

    def _direct_gather(self) -> Technique:
        return self._meshed("direct+gather", "direct", (16, 50, 100), True)

    def _rival(self, name: str, rival: Rival) -> Technique:
        def ask(value: float, seed: int) -> Answer:
            return Answer(rival.irradiance(self.points, self.normals, samples=int(value), seed=seed))

        return Technique(name, "samples", (16, 64, 256, 1024, 4096, 16384), ask, kind="rival")

    def reference(self, kind: str) -> Reference:
        """A matrix solve of 4,000 elements gathered to 0.1 %, or 8 x 4,096 samples of a rival."""
        if kind == "exact":
            raise OptionError("reference: no exact answer is known for a solve; ask for converged, mitsuba or FILE.npy")
        if kind == "converged":
            fine = {"method": "matrix", "elements": 4000, "form_factor_error": 2e-3}
            values, _ = self._gathered(self._solved(fine, 1), 0.001, 1)
            return Reference("matrix, 4,000 elements, gathered to 0.1 %", values, 0.0, 0.001)
        return _rival_reference(self, kind, 4096)


# ---- pictures -----------------------------------------------------------------------------------


class Pictures(Problem):
    """A small picture of the direct light. [W m-2 sr-1]"""

    what, question = "render", "picture"
    error_label = "error: rms over the pixels that see no lamp / mean radiance"
    own: tuple[str, ...] = ("aliased", "adaptive", "atomic", "gather")
    direct_only = True
    reference_samples = 4096

    def __init__(self, scene: Scene, *, width: int = 96, workers: int | None = None) -> None:
        super().__init__(black_lamps(scene), workers=workers)
        if scene.camera is None:
            raise InputError(f"{scene.name}: found no camera, expected one to draw a picture")
        height = max(1, round(width * scene.camera.height / scene.camera.width))
        self.camera = replace(scene.camera, width=width, height=height)
        self.scene = replace(self.scene, camera=self.camera)

    @property
    def title(self) -> str:
        """The question in words."""
        size = f"{self.camera.width} x {self.camera.height} pixels"
        return f"{'direct' if self.direct_only else 'all'} light in {size}, {self.geometry.polygon_count:,} polygons"

    @cached_property
    def white(self) -> float:
        """Radiance below which 99 per cent of the pixels without lamps lie."""
        from workbench.render.direct import render_direct

        return float(
            render_direct(self.scene, sampling="aliased", workers=self.workers).record.results["white_W_m2_sr"]
        )

    def judged(self, values: FloatArray) -> FloatArray:
        """Radiance of the pixels that see no lamp: a lamp's edge would outweigh all else."""
        return values.reshape(-1, self.scene.bands)[~self._lamps]

    @cached_property
    def _lamps(self) -> NDArray[np.bool_]:
        """Pixels with a lamp in them, or next to one that has, by 8 x 8 rays a pixel."""
        from scipy.ndimage import binary_dilation

        from workbench.accel.embree import EmbreeAccelerator
        from workbench.render.camera import PinholeRays

        side, (h, w) = 8, (self.camera.height, self.camera.width)
        rays = PinholeRays.from_camera(replace(self.camera, width=side * w, height=side * h))
        toward = rays.row_directions(0, side * h)
        hit = EmbreeAccelerator(self.geometry).closest_hit(np.broadcast_to(rays.eye, toward.shape), toward).polygon
        lamp = np.array([material.emission.any() for material in self.geometry.surface_material] + [False])
        surface = np.append(self.geometry.polygon_surface, len(lamp) - 1)[hit]
        seen = lamp[surface].reshape(h, side, w, side).any(axis=(1, 3))
        return np.asarray(binary_dilation(seen, np.ones((3, 3)))).ravel()

    def _draw(self, value: float, seed: int, sampling: str, **more: Any) -> Answer:
        from workbench.render.direct import render_direct
        from workbench.render.trace import TraceOptions

        options = TraceOptions(seed=seed, **more.pop("trace", {}))
        found = render_direct(
            self.scene, sampling=sampling, options=options, white=self.white, workers=self.workers, **more
        )
        return Answer(found.picture.radiance, dict(found.record.counters))

    def _aliased(self) -> Technique:
        def ask(value: float, seed: int) -> Answer:
            # Several samples a pixel: a larger picture, averaged.
            side = int(value)
            large = replace(self.camera, width=side * self.camera.width, height=side * self.camera.height)
            found = replace_camera(self, large)._draw(value, seed, "aliased", trace={"shadow_error": 0.03})
            h, w = self.camera.height, self.camera.width
            return Answer(found.values.reshape(h, side, w, side, -1).mean(axis=(1, 3)), found.counters)

        return Technique("aliased", "samples along a pixel", (1, 2, 4, 8), ask, seeded=False)

    def _adaptive(self) -> Technique:
        return Technique(
            "adaptive", "threshold", (0.5, 0.2, 0.06, 0.02),
            lambda value, seed: self._draw(value, seed, "adaptive", threshold=value), seeded=False,
        )  # fmt: skip

    def _atomic(self) -> Technique:
        return Technique(
            "atomic", "threshold", (0.5, 0.2, 0.06, 0.02),
            lambda value, seed: self._draw(value, seed, "atomic", threshold=value), seeded=False,
        )  # fmt: skip

    def _rival(self, name: str, rival: Rival) -> Technique:
        def ask(value: float, seed: int) -> Answer:
            return Answer(rival.picture(self.camera, samples=int(value), seed=seed, direct_only=self.direct_only))

        return Technique(name, "samples a pixel", (1, 4, 16, 64, 256, 1024, 4096), ask, kind="rival")

    def reference(self, kind: str) -> Reference:
        """A final gather to 0.3 %, or 8 runs of a rival with ``reference_samples`` a pixel."""
        if kind == "exact":
            raise OptionError("reference: no exact picture is known; ask for converged, mitsuba or FILE.npy")
        if kind == "converged":
            return Reference(
                "final gather to 0.3 %", self._gathered(self._source(0.003, 7), 0.003, 7).values, 0.0, 0.003
            )
        return _rival_reference(self, kind, self.reference_samples)

    def _gather(self) -> Technique:
        return Technique(
            "gather", "error", (0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001),
            lambda value, seed: self._gathered(self._source(value, seed), value, seed), kind="auto",
        )  # fmt: skip

    @cached_property
    def _light(self) -> Any:
        """The scene made ready, as rivals load theirs."""
        from radiosity.sensors import DirectLight

        return DirectLight(self.scene, workers=self.workers)

    def _source(self, error: float, seed: int) -> Any:
        """What a picture of an error is gathered from."""
        return self._light

    def _gathered(self, source: Any, error: float, seed: int, *, atomic: bool = True) -> Answer:
        """The final gather."""
        from radiosity.gather import GatherOptions, PictureGatherer
        from workbench.render.camera import PinholeRays

        choice = GatherOptions(error=error, atomic=atomic, indirect=not self.direct_only, see_backs=True)
        gatherer = PictureGatherer(source, choice, workers=self.workers, seed=seed)
        picture = gatherer.draw(PinholeRays.from_camera(self.camera))
        counters = Counters()
        if source is not self._light:
            counters.merge(source.record.counters)
        counters.merge(picture.counters)
        return Answer(picture.radiance, dict(counters), picture.measured_error)


class GlobalPictures(Pictures):
    """A small picture of all the light, direct and reflected. [W m-2 sr-1]"""

    what, direct_only, reference_samples = "picture", False, 2048
    own = ("gather", "matrix+gather", "gather-every-pixel", "mesh")

    def _source(self, error: float, seed: int) -> Any:
        from radiosity.accuracy import solve

        # As ``radiosity render`` does: the gather refines what it reads.
        return solve(self.scene, error=min(2.0 * error, 0.5), workers=self.workers, seed=seed)

    def _matrix_solution(self, elements: float, seed: int) -> Any:
        from radiosity.solvers.solve import solve

        return solve(
            self.scene, method="matrix", elements=int(elements), form_factor_error=0.15 / math.sqrt(elements),
            workers=self.workers, seed=seed,
        )  # fmt: skip

    def _by_elements(self, name: str, values: tuple[int, ...], atomic: bool) -> Technique:
        def ask(value: float, seed: int) -> Answer:
            # A pixel's error is about that of a point under the same mesh.
            error = min(0.1, 0.3 / math.sqrt(value))
            return self._gathered(self._matrix_solution(value, seed), error, seed, atomic=atomic)

        return Technique(name, "elements", values, ask)

    def _matrix_gather(self) -> Technique:
        return self._by_elements("matrix+gather", (16, 50, 200, 800, 3200), True)

    def _gather_every_pixel(self) -> Technique:
        return self._by_elements("gather-every-pixel", (16, 50, 200), False)

    def _mesh(self) -> Technique:
        """The elements themselves, as pictures of radiosity were drawn before gathers: no shadows but the mesh's."""
        from radiosity.element_lookup import ElementLookup, element_gradients
        from workbench.accel.embree import EmbreeAccelerator
        from workbench.render.camera import PinholeRays

        tracer, side = EmbreeAccelerator(self.geometry), 4
        h, w = self.camera.height, self.camera.width
        rays = PinholeRays.from_camera(replace(self.camera, width=side * w, height=side * h))

        def ask(value: float, seed: int) -> Answer:
            solution = self._matrix_solution(value, seed)
            mesh = solution.mesh
            lookup = ElementLookup.build(self.geometry, mesh)
            slopes = element_gradients(mesh, lookup, solution.radiosity)
            toward = rays.row_directions(0, side * h)
            hit = tracer.closest_hit(np.broadcast_to(rays.eye, toward.shape), toward)
            points = rays.eye + np.where(np.isfinite(hit.t), hit.t, 0.0)[:, None] * toward
            front = np.einsum("ij,ij->i", self.geometry.polygon_normal[hit.polygon], toward) < 0.0
            element = lookup.elements(points, hit.polygon, front)
            known = np.maximum(element, 0)
            found = solution.radiosity[known] + np.einsum(
                "nbk,nk->nb", slopes[known], points - mesh.element_centroid[known]
            )
            seen = np.where((element >= 0)[:, None], np.maximum(found, 0.0), 0.0) / math.pi
            return Answer(seen.reshape(h, side, w, side, -1).mean(axis=(1, 3)), dict(solution.record.counters))

        return Technique("mesh", "elements", (100, 400, 1600), ask)


def replace_camera(problem: Pictures, camera: Any) -> Pictures:
    """The same problem through another camera, with the same white."""
    import copy

    other = copy.copy(problem)
    other.camera = camera
    other.scene = replace(problem.scene, camera=camera)
    other.__dict__["white"] = problem.white
    return other


PROBLEMS: dict[str, type[Problem]] = {
    kind.what: kind for kind in (Shadows, ViewFactors, Solve, Pictures, GlobalPictures)
}
"""Problems by the word that the command line has for them."""


def problem_for(what: str, scene: Scene, **options: Any) -> Problem:
    """The problem of that name for a scene.

    Raises
    ------
    OptionError
        If there is no such problem.
    """
    if what not in PROBLEMS:
        raise OptionError(f"what: found {what!r}, expected one of {', '.join(PROBLEMS)}")
    return PROBLEMS[what](scene, **options)
