"""The whole journey of a solve: scene, geometry, mesh, form factors, solver, solution."""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Callable
from typing import Any, TypedDict, Unpack

import numpy as np

from radiosity.form_factors.bundle import ColumnFinder, LinkSettings, ReceiverBundles
from radiosity.form_factors.directional import DirectionalBundles
from radiosity.form_factors.matrix import SOLVE_ENTRY
from radiosity.patches import PatchMesh, build_mesh, forecast_elements
from radiosity.solvers.direct import solve_direct, solve_matrix
from radiosity.solvers.incident import incident_irradiance
from radiosity.solvers.progressive import shoot_until
from radiosity.solvers.solution import Checkpoint, EnergyBook, Progress, Solution
from workbench.accel.embree import EmbreeAccelerator
from workbench.arrays import as_count, as_fraction, as_positive
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.memory import available_bytes, require_memory
from workbench.record import RunRecord
from workbench.scene.model import Scene
from workbench.shadow.occlusion import Shader

__all__ = ["begin", "most_matrix_elements", "require_matrix_memory", "solve", "solve_by_matrix", "solve_by_patches"]

METHODS = ("auto", "progressive", "direct", "matrix", "hierarchical")
BUNDLES: dict[str, Callable[..., ColumnFinder]] = {"receiver": ReceiverBundles, "directional": DirectionalBundles}
"""How form factors are found: from the receivers toward a patch, or from the patch into its hemisphere."""
FULL = ("direct", "matrix")
"""Methods that find all form factors before they solve."""

DEFAULT_ELEMENTS = 2000
DEFAULT_LINK_ERROR = 1e-3
MATRIX_POLYGONS, MATRIX_ELEMENTS = 2000, 4000
"""Scenes of at most so many polygons are solved with the full matrix, up to so many elements if no error is asked."""
DIRECT_ELEMENTS, LEAST_MATRIX_ERROR = 64, 1e-4
"""Up to so many elements form factors are found column by column where they are asked to a smaller error."""
EXACT_ELEMENTS = 12
"""Up to this many elements form factors are found to 1e-8: a second at most."""

ONE_LEVEL_ELEMENTS = 1600
"""Up to this many elements, each shoots for itself; above, patches of 2 x 2 elements shoot."""


class SolveOptions(TypedDict, total=False):
    """The options of :func:`solve`, explained there."""

    method: str
    elements: int | None
    max_edge: float | None
    rays: int
    tolerance: float
    form_factor_error: float | None
    link_error: float | None
    direct_in_mesh: bool
    bundles: str
    workers: int | None
    seed: int


DEFAULTS: SolveOptions = {
    "method": "auto",
    "elements": None,
    "max_edge": None,
    "rays": 16,
    "tolerance": 0.01,
    "form_factor_error": None,
    "link_error": None,
    "direct_in_mesh": True,
    "bundles": "receiver",
    "workers": None,
    "seed": 0,
}

# Bytes an element costs while a mesh is made and solved, beside its bands.
_ELEMENT_BYTES = 3000
DIRECT_ENTRY = 40.0
"""Bytes of an entry of a matrix that is found column by column."""
_FEWER = "ask for fewer elements or a larger max_edge"


def _form_factor_error(elements: int, method: str) -> float:
    """Default accuracy of form factors: what costs nothing is done well."""
    if elements <= EXACT_ELEMENTS:
        return 1e-8
    return 1e-3 if method == "direct" or elements <= DIRECT_ELEMENTS else 0.02


def _settings(error: float, rays: int, seed: int, patches: int) -> LinkSettings:
    """Link settings for a relative form-factor error."""
    tight = error <= 1e-3
    return LinkSettings(
        rays=rays,
        error=error,
        floor=0.1 * error / max(patches, 1),
        candidates=40 if tight else 12,
        # Each level halves the cells along a shadow edge, which cost twice as much; an element's mean
        # carries what is left, and the stated error says so.
        levels=min(max(3, math.ceil(math.log2(1.0 / error)) - 2), 5 if error >= 1e-3 else 7 if error >= 1e-5 else 20),
        closed_forms=tight,
        seed=seed,
    )


def _check(scene: Scene, settings: dict[str, Any]) -> None:
    method, elements, max_edge = settings["method"], settings["elements"], settings["max_edge"]
    if method not in METHODS:
        raise OptionError(f"method: found {method!r}, expected one of {', '.join(METHODS)}")
    if elements is not None and max_edge is not None:
        raise OptionError("elements and max_edge were both given; choose one of them")
    if elements is not None:
        settings["elements"] = as_count(elements, "elements")
    if max_edge is not None:
        settings["max_edge"] = as_positive(max_edge, "max_edge", "a positive length")
    for name, least in (("rays", 1), ("workers", 1), ("seed", 0)):
        settings[name] = as_count(settings[name], name, least)
    for name in ("tolerance", "form_factor_error"):
        if settings[name] is not None:
            settings[name] = as_fraction(settings[name], name)
    where = str(scene.path) if scene.path is not None else scene.name
    if not any(surface.face_count for surface in scene.surfaces):
        raise InputError(f"{where}: found no surface; add a [[surface]] to the scene")
    if not scene.has_emitter:
        raise InputError(
            f"{where}: found no emitter, expected a material with emission, a light or a background; add one"
        )
    reflectance = np.stack([surface.material.reflectance for surface in scene.surfaces])
    if scene.closed and (reflectance.min(axis=0) >= 1.0).any():
        raise InputError(
            f"{where}: found reflectance 1 on every surface of a closed scene, which has no solution;"
            " lower one reflectance below 1"
        )


def _forecast(scene: Scene, elements: int | None, max_edge: float | None, method: str) -> None:
    """Refuse a mesh or matrix that cannot fit in memory, before it is made."""
    count = float(elements) if elements is not None else float(forecast_elements(scene, max_edge or math.inf))
    require_memory(count * (_ELEMENT_BYTES + 64 * scene.bands), f"a mesh of {count:.3g} elements", _FEWER)
    if method in FULL:
        require_matrix_memory(count, SOLVE_ENTRY if method == "matrix" else DIRECT_ENTRY)


def require_matrix_memory(count: float, entry: float = SOLVE_ENTRY) -> None:
    """Refuse a full matrix of form factors, of so many bytes an ``entry``, that cannot fit in memory."""
    require_memory(entry * count**2, f"a matrix of {count:.3g} x {count:.3g} form factors", _FEWER)


def most_matrix_elements() -> int:
    """Most elements whose matrix fits in memory, with some to spare."""
    return int(math.sqrt(0.8 * available_bytes() / SOLVE_ENTRY))


def _note_materials(geometry: Geometry, record: RunRecord) -> None:
    """Say in the record what of the materials a solve leaves out."""
    if any(material.specular.any() for material in geometry.surface_material):
        record.choices["specular"] = "mirror reflection is left to pictures; its share is absorbed"
    if geometry.polygon_transmittance.any():
        record.choices["transmittance"] = (
            "panes dim what is cut exactly; where rays decide (long candidate lists, clusters, lights without surface)"
            " they block"
        )


def _start(scene: Scene, mesh: PatchMesh, incident: np.ndarray, record: RunRecord) -> Solution:
    """The solution before the first shot: emission, and light from outside the mesh reflected once."""
    area = mesh.element_area
    reflected = mesh.reflectance * incident
    book = EnergyBook.empty(mesh.bands)
    book.emitted = area @ (mesh.emission + incident)
    book.received = area @ incident
    book.absorbed = area @ (incident - reflected)
    return Solution(
        scene=scene,
        mesh=mesh,
        radiosity=mesh.emission + reflected,
        element_irradiance=incident.copy(),
        unshot=mesh.emission + reflected,
        book=book,
        record=record,
        direct_irradiance=incident,
    )


def _resumed(scene: Scene, mesh: PatchMesh, previous: Solution, record: RunRecord) -> Solution:
    """Go on from ``previous`` if it belongs to the same mesh and materials."""
    same = previous.mesh.corners.shape == mesh.corners.shape and all(
        np.array_equal(getattr(previous.mesh, name), getattr(mesh, name))
        for name in ("corners", "piece_start", "patch_start", "reflectance", "emission")
    )
    if not same:
        raise InputError(
            "resume: the saved solution has another mesh or other materials; give the same scene and mesh options,"
            " or solve without resume"
        )
    record.counters.merge(previous.record.counters)
    record.seconds.update(previous.record.seconds)
    return Solution(
        scene=scene,
        mesh=mesh,
        # Copies: the earlier solution stays what it was.
        radiosity=previous.radiosity.copy(),
        element_irradiance=previous.element_irradiance.copy(),
        unshot=previous.unshot.copy(),
        book=copy.deepcopy(previous.book),
        record=record,
        direct_irradiance=previous.direct_irradiance,
        shooting=previous.shooting.copy() if previous.shooting is not None else None,
    )


def solve(
    scene: Scene,
    *,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
    resume: Solution | None = None,
    rounds: Callable[[Solution], None] | None = None,
    **options: Unpack[SolveOptions],
) -> Solution:
    """Solve a scene for radiosity.

    Parameters
    ----------
    scene : Scene
        From :func:`workbench.load` or built in code.
    method : str
        ``progressive`` (shooting), ``hierarchical`` (links at the coarsest level that will do, elements
        where the light changes), ``direct`` (full matrix, by columns; small scenes), ``matrix`` (full
        matrix, reciprocal by construction, pairs settled in groups; up to some thousand elements), or ``auto``: full
        where it fits, since nothing is left unshot then, else ``progressive``.
    elements : int, optional
        About how many elements; 1 gives one a polygon.  Default 2,000 (or one a polygon, if there
        are more polygons).
    max_edge : float, optional
        Longest element edge instead. [scene lengths]
    rays : int
        Rays from an element toward a patch, where only rays can tell how much it sees.
    tolerance : float
        Stop when the bound on the light still missing falls below this share of all light.
    form_factor_error : float, optional
        Wanted relative error of each form factor; chosen from the number of elements by default.
    link_error : float, optional
        Of ``hierarchical``: the error that one link may leave, see
        :func:`radiosity.solvers.hierarchical.solve_hierarchical`.  With ``elements`` by default as small as
        their number allows, without it 1e-3.
    direct_in_mesh : bool
        Of ``hierarchical``: whether elements resolve shadows, or leave direct light to points and pictures.
    bundles : str
        ``receiver``: each element looks toward the shooting patch (Wallace, Elmquist and Haines 1989).
        ``directional``: the patch shoots rays into the strata of its hemisphere (Shirley 1990); a patch then
        shoots ``rays`` times the number of elements.
    workers : int, optional
        Threads, all cores by default.  The answer does not depend on it.
    seed : int
        Of the rays.
    progress : callable, optional
        Called with a :class:`ProgressEvent` at every step.
    checkpoint : callable, optional
        Called now and then with the unfinished solution, for instance to save it.
    resume : Solution, optional
        An earlier solution of the same scene and mesh to go on from.
    rounds : callable, optional
        Of ``hierarchical``: called with the solution after each round of refinement; the one that is returned can then
        be gone on from with more elements.

    Returns
    -------
    Solution

    Raises
    ------
    InputError, OptionError
        If the scene sends no light, has no solution, or an option is out of range.
    MemoryForecastError
        If the mesh or matrix would not fit in memory.

    Notes
    -----
    Specular reflection and refraction are left to the picture: their share is absorbed here.  Panes
    (transmittance above 0) dim what is cut exactly and block rays; ``record.choices`` says so.
    """
    record = begin(scene, **options)
    settings = record.settings
    method, elements, max_edge = settings["method"], settings["elements"], settings["max_edge"]
    with record.stage("mesh"):
        geometry = Geometry.from_scene(scene)
    if method == "hierarchical":
        _note_materials(geometry, record)
        from radiosity.solvers.hierarchical import solve_hierarchical  # kernels that others need not load

        return solve_hierarchical(
            scene,
            geometry,
            record,
            link_error=settings["link_error"],
            max_elements=elements,
            max_edge=max_edge,
            direct_in_mesh=settings["direct_in_mesh"],
            form_factor_error=settings["form_factor_error"],
            tolerance=min(settings["tolerance"], 1e-4),
            workers=settings["workers"],
            seed=settings["seed"],
            progress=progress,
            checkpoint=checkpoint,
            resume=resume,
            rounds=rounds,
        )
    if method == "auto":
        method = _chosen(scene, geometry, record, resume)
    whole = method in FULL
    with record.stage("mesh"):
        mesh = build_mesh(
            scene, geometry, elements=elements, max_edge=max_edge, split=1 if whole else 2, cluster=not whole
        )
        if not whole and mesh.patch_count < mesh.element_count <= ONE_LEVEL_ELEMENTS:
            mesh = build_mesh(scene, geometry, elements=elements, max_edge=max_edge, split=1)
    _forecast(scene, mesh.element_count, None, method)
    if method == "matrix":
        with record.stage("prepare"):
            shader = Shader(geometry, settings["workers"])
        return solve_by_matrix(scene, shader, mesh, record, progress=progress)[0]
    return solve_by_patches(
        scene, geometry, mesh, record, method=method, progress=progress, checkpoint=checkpoint, resume=resume
    )


def _chosen(scene: Scene, geometry: Geometry, record: RunRecord, resume: Solution | None) -> str:
    """The method of ``auto``."""
    settings, polygons = record.settings, geometry.polygon_count
    elements = settings["elements"] or forecast_elements(scene, settings["max_edge"])
    error = settings["form_factor_error"]
    if resume is not None and resume.shooting is not None:
        method, reason = "progressive", "what is resumed was"
    elif settings["bundles"] != "receiver":
        method, reason = "progressive", f"bundles are {settings['bundles']}"
    elif polygons > MATRIX_POLYGONS:
        method, reason = "progressive", f"{polygons} polygons, all form factors at once up to {MATRIX_POLYGONS}"
    elif max(elements, polygons) > min(MATRIX_ELEMENTS, most_matrix_elements()):
        method, reason = "progressive", f"about {elements} elements, all form factors at once up to {MATRIX_ELEMENTS}"
    else:
        # Nothing is left unshot then: a dim room beside a bright yard is right, too.
        few = forecast_elements(scene, math.inf, 1) <= EXACT_ELEMENTS and elements <= EXACT_ELEMENTS
        exact = few or (error is not None and error < LEAST_MATRIX_ERROR and elements <= DIRECT_ELEMENTS)
        method = "direct" if exact else "matrix"
        reason = f"{polygons} polygons and about {max(elements, polygons)} elements, all form factors at once"
    record.choices["method"] = f"{method}: {reason}"
    return method


def begin(scene: Scene, **options: Unpack[SolveOptions]) -> RunRecord:
    """Check the scene and the options of a solve, see :func:`solve`, and forecast its memory.

    Returns
    -------
    RunRecord
        With the settings, defaults filled in.

    Raises
    ------
    TypeError
        If there is no such option.
    InputError, OptionError, MemoryForecastError
        As :func:`solve`.
    """
    unknown = sorted(set(options) - set(DEFAULTS))
    if unknown:
        raise TypeError(f"solve() got an unexpected keyword argument {unknown[0]!r}")
    settings: dict[str, Any] = {"scene": scene.name, **DEFAULTS, **options}
    if settings["workers"] is None:
        settings["workers"] = len(os.sched_getaffinity(0))
    _check(scene, settings)
    method, elements, max_edge = settings["method"], settings["elements"], settings["max_edge"]
    bundles = settings["bundles"]
    if method != "hierarchical":
        if settings["link_error"] is not None or not settings["direct_in_mesh"]:
            raise OptionError(f"link_error and direct_in_mesh: found with method {method!r}, expected 'hierarchical'")
        if elements is None and max_edge is None:
            settings["elements"] = elements = DEFAULT_ELEMENTS
    elif settings["link_error"] is None and elements is None:
        settings["link_error"] = DEFAULT_LINK_ERROR
    if bundles not in BUNDLES:
        raise OptionError(f"bundles: found {bundles!r}, expected one of {', '.join(BUNDLES)}")
    if method == "hierarchical" and bundles != "receiver":
        raise OptionError(
            f"bundles: found {bundles!r} with method 'hierarchical', which has links of its own;"
            " choose method 'progressive' or 'direct'"
        )
    _forecast(scene, elements, max_edge, method)
    return RunRecord(command="solve", settings=settings)


def _accuracy(record: RunRecord, elements: int, method: str) -> float:
    """Relative error of form factors: as asked, or by the number of elements."""
    asked = record.settings["form_factor_error"]
    error = float(asked) if asked is not None else _form_factor_error(elements, method)
    record.choices["form_factor_error"] = f"{error:g}"
    return error


def _sum_up(solution: Solution) -> None:
    """Write into the record what a solve was of."""
    mesh, record = solution.mesh, solution.record
    record.errors["facet_error"] = mesh.facet_error
    record.results.update(
        elements=mesh.element_count,
        patches=mesh.patch_count,
        energy_book=solution.book.as_dict(),
        stopped=solution.stopped,
    )


def solve_by_matrix(
    scene: Scene,
    shader: Shader,
    mesh: PatchMesh,
    record: RunRecord,
    *,
    coarse_mesh: PatchMesh | None = None,
    progress: Progress | None = None,
) -> tuple[Solution, Solution | None]:
    """Solve on a mesh with all form factors at once, and on its patches with the same ones.

    Parameters
    ----------
    scene : Scene
    shader : Shader
        Over its geometry.
    mesh : PatchMesh
        Of single polygons: no clusters of facets.
    record : RunRecord
        From :func:`begin`, which checked the options; its settings are read.
    coarse_mesh : PatchMesh, optional
        Its elements are the patches of ``mesh``.
    progress : callable, optional
        As in :func:`solve`.

    Returns
    -------
    solution, coarse : Solution
        On either mesh; ``coarse`` is None without ``coarse_mesh``.
    """
    _note_materials(shader.geometry, record)
    settings = record.settings
    error = _accuracy(record, mesh.element_count, "matrix")
    tracer = EmbreeAccelerator(shader.geometry)
    with record.stage("incident light"):
        incident = incident_irradiance(scene, mesh, tracer, error=error, seed=settings["seed"], shader=shader)
    record.counters.merge(tracer.counters)
    solution = _start(scene, mesh, incident, record)
    coarse = None
    if coarse_mesh is not None:
        coarse = _start(scene, coarse_mesh, mesh.patch_mean(incident), RunRecord("solve", dict(settings)))
    solve_matrix(
        solution,
        shader,
        error=error,
        closed=scene.closed,
        coarse=coarse,
        workers=settings["workers"],
        seed=settings["seed"],
        progress=progress,
    )
    _sum_up(solution)
    return solution, coarse


def solve_by_patches(
    scene: Scene,
    geometry: Geometry,
    mesh: PatchMesh,
    record: RunRecord,
    *,
    method: str,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
    resume: Solution | None = None,
) -> Solution:
    """Solve on a mesh, ``progressive`` or ``direct``, with form factors found patch by patch.

    Arguments as in :func:`solve_by_matrix` and :func:`solve`.
    """
    _note_materials(geometry, record)
    settings = record.settings
    error = _accuracy(record, mesh.element_count, method)
    with record.stage("prepare"):
        links = _settings(error, settings["rays"], settings["seed"], mesh.patch_count)
        finder = BUNDLES[settings["bundles"]](geometry, mesh, links, settings["workers"])
    try:
        if resume is None or method == "direct":
            # A full solve has no half-way state to go on from.
            with record.stage("incident light"):
                incident = incident_irradiance(scene, mesh, finder.accelerator, error=error, seed=settings["seed"])
            solution = _start(scene, mesh, incident, record)
            record.counters.merge(finder.accelerator.counters)
        else:
            solution = _resumed(scene, mesh, resume, record)
        if method == "direct":
            solve_direct(solution, finder, closed=scene.closed, progress=progress)
        else:
            tolerance = settings["tolerance"]
            shoot_until(solution, finder, tolerance=tolerance, progress=progress, checkpoint=checkpoint)
    finally:
        finder.close()
    _sum_up(solution)
    return solution
