"""The record that a solver returns: radiosity on a mesh, with its energy book and its errors."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from radiosity.interpolation import conforming_rings, corner_values
from radiosity.patches import PatchMesh
from workbench.counters import Counters
from workbench.errors import InputError
from workbench.record import RunRecord
from workbench.scene.model import Scene

if TYPE_CHECKING:
    import pyvista
    from numpy.typing import ArrayLike

    from radiosity.sensors import IrradianceEstimate

__all__ = ["Checkpoint", "EnergyBook", "Progress", "ProgressEvent", "ShootingState", "Solution"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ProgressEvent:
    """What a solver says of itself after each step.

    ``residual`` bounds the light still missing, relative to the light found; the solver stops when
    it falls below ``tolerance``.
    """

    shots: int
    residual: float
    tolerance: float
    seconds: float
    message: str


Progress = Callable[[ProgressEvent], None]
Checkpoint = Callable[["Solution"], None]

KEPT_LIMIT = 256 * 2**20
"""Most bytes of kept form factors that are saved with a solution that is not finished."""


@dataclass
class EnergyBook:
    """Where the power went, a band each. [W]

    At every step ``emitted = unshot + absorbed + escaped`` and ``shot = received + escaped``, each to
    rounding.  ``escaped`` is shot power that no element received: it left an open scene, fell on
    the black back of a surface, or is the error of the row sums in a closed one.
    """

    emitted: FloatArray
    shot: FloatArray
    received: FloatArray
    absorbed: FloatArray
    escaped: FloatArray

    @classmethod
    def empty(cls, bands: int) -> EnergyBook:
        """A book without entries."""
        return cls(*(np.zeros(bands) for _ in range(5)))

    def imbalance(self, unshot: FloatArray) -> float:
        """Largest |emitted - unshot - absorbed - escaped| of the bands, relative to emitted."""
        off = np.abs(self.emitted - unshot - self.absorbed - self.escaped)
        scale = np.where(self.emitted > 0, self.emitted, 1.0)
        return float((off / scale).max(initial=0.0))

    def as_dict(self) -> dict[str, list[float]]:
        """The entries in W, a list of bands each."""
        return {f"{f.name}_W": getattr(self, f.name).tolist() for f in dataclasses.fields(self)}


@dataclass
class ShootingState:
    """What progressive refinement knows beside the solution, so that it can go on after a break.

    Parameters
    ----------
    floor : (q,) float
        Absolute error below which each patch's form factors were not refined; NaN: none found yet.
    row_sum, doubt : (q,) float
        Row sum of each patch as found, and its stated error.
    mean_square : (q, 2) float
        Area-weighted mean squared error of the form factors to each patch, by formula and by rays.
    sent : (q, bands) float
        Radiosity that each patch has shot. [W m-2]
    kept : dict
        Form factors (n,) from all elements to a patch.
    """

    floor: FloatArray
    row_sum: FloatArray
    doubt: FloatArray
    mean_square: FloatArray
    sent: FloatArray
    kept: dict[int, FloatArray] = field(default_factory=dict)

    @classmethod
    def empty(cls, patches: int, bands: int) -> ShootingState:
        """Nothing found, nothing shot."""
        unknown = np.full(patches, np.nan)
        return cls(unknown, unknown.copy(), unknown.copy(), np.zeros((patches, 2)), np.zeros((patches, bands)))

    def copy(self) -> ShootingState:
        """An independent copy; the kept form factors, which never change, are shared."""
        arrays = {name: getattr(self, name).copy() for name in _SHOOTING_ARRAYS}
        return ShootingState(**arrays, kept=dict(self.kept))

    def as_arrays(self, *, with_kept: bool) -> dict[str, NDArray]:
        """Arrays by name, for a file."""
        arrays: dict[str, NDArray] = {name: getattr(self, name) for name in _SHOOTING_ARRAYS}
        if with_kept and 0 < sum(row.nbytes for row in self.kept.values()) <= KEPT_LIMIT:
            arrays["kept_patches"] = np.asarray(sorted(self.kept), dtype=np.int64)
            arrays["kept_factors"] = np.stack([self.kept[p] for p in sorted(self.kept)])
        return arrays

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray]) -> ShootingState:
        """The inverse of :meth:`as_arrays`."""
        state = cls(**{name: arrays[name] for name in _SHOOTING_ARRAYS}, kept={})
        if "kept_patches" in arrays:
            state.kept = dict(zip(arrays["kept_patches"].tolist(), arrays["kept_factors"], strict=True))
        return state


_SHOOTING_ARRAYS = ("floor", "row_sum", "doubt", "mean_square", "sent")


def _column(values: NDArray) -> NDArray:
    """Values as VTK takes them: one band as a plain array."""
    return values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values


@dataclass
class Solution:
    """Radiosity, irradiance and unshot radiosity on the elements of a mesh.

    Parameters
    ----------
    scene : Scene
    mesh : PatchMesh
    radiosity : (n, bands) float
        Flux leaving per area, emission included. [W m-2]
    element_irradiance : (n, bands) float
        Flux arriving per area. [W m-2]
    unshot : (n, bands) float
        The part of radiosity that has not been shot yet. [W m-2]
    book : EnergyBook
    record : RunRecord
    converged : bool
    stopped : str
        Why the solver stopped: ``tolerance``, ``solved``, ``interrupted``.
    direct_irradiance : (n, bands) float
        Flux per area from lights without surface and from the background. [W m-2]
    shooting : ShootingState, optional
        Progressive refinement's own state.
    refinement : dict, optional
        Arrays by name: the state of an unfinished hierarchical solve.
    """

    scene: Scene
    mesh: PatchMesh
    radiosity: FloatArray
    element_irradiance: FloatArray
    unshot: FloatArray
    book: EnergyBook
    record: RunRecord
    converged: bool = False
    stopped: str = ""
    direct_irradiance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    shooting: ShootingState | None = None
    refinement: dict[str, NDArray] | None = None

    @property
    def unshot_power(self) -> FloatArray:
        """Power still to be shot, (bands,). [W]"""
        return self.mesh.element_area @ self.unshot

    @property
    def mean_irradiance(self) -> FloatArray:
        """Area-weighted mean irradiance, (bands,). [W m-2]"""
        area = self.mesh.element_area
        return (area @ self.element_irradiance) / area.sum()

    def state_irradiance_error(self, **mean_squares: FloatArray) -> None:
        """Put named errors of the irradiance into the record, each given by its mean square (bands,).

        Stated as root mean square over area and bands, relative to the mean irradiance.
        """
        mean = float(self.mean_irradiance.mean())
        for name, square in mean_squares.items():
            value = math.sqrt(float(np.mean(square)))
            self.record.errors[f"irradiance_{name}_rms"] = value / mean if mean > 0 else 0.0

    def vertex_radiosity(self) -> FloatArray:
        """Radiosity interpolated to the corners of the mesh's pieces, (k, bands). [W m-2]"""
        return corner_values(self.mesh, self.radiosity)

    def irradiance(
        self,
        points: ArrayLike,
        normals: ArrayLike,
        *,
        error: float = 0.01,
        own_polygon: ArrayLike | None = None,
        rays: int | None = None,
        workers: int | None = None,
        seed: int = 0,
    ) -> IrradianceEstimate:
        """Irradiance at any points: direct light found afresh, indirect light gathered from this solution.

        Arguments as in :meth:`radiosity.sensors.Gatherer.irradiance`; for several questions make a
        ``Gatherer`` once.
        """
        from radiosity.sensors import Gatherer

        gatherer = Gatherer(self, workers=workers, seed=seed)
        return gatherer.irradiance(points, normals, own_polygon=own_polygon, error=error, rays=rays)

    def to_pyvista(self, *, conforming: bool = False) -> pyvista.PolyData:
        """The mesh with its arrays, for pyvista.

        Cell arrays ``radiosity_W_m2``, ``irradiance_W_m2``, ``emission_W_m2``, ``unshot_W_m2``,
        ``reflectance``, ``surface_id``, ``patch_id``, ``element_id``; point array
        ``radiosity_W_m2``, interpolated; field data ``surface_names``.

        Parameters
        ----------
        conforming : bool
            Cut elements into triangles that meet corner to corner: where small elements lie beside a large
            one, shading by the points then shows no cracks.
        """
        import pyvista

        mesh = self.mesh
        owner = mesh.piece_element
        points, at_points = mesh.corners, self.vertex_radiosity()
        if conforming:
            points, at_points, triangles, piece = self._triangles(at_points)
            cells = np.insert(triangles, 0, 3, axis=1).ravel()
            owner = owner[piece]
        else:
            counts = np.diff(mesh.piece_start)
            # Each ring as (count, corner, corner, ...), the layout of VTK's cell array.
            cells = np.insert(np.arange(len(mesh.corners)), mesh.piece_start[:-1], counts)
        poly = pyvista.PolyData(points, faces=cells)
        for name, values in (
            ("radiosity_W_m2", self.radiosity),
            ("irradiance_W_m2", self.element_irradiance),
            ("emission_W_m2", mesh.emission),
            ("unshot_W_m2", self.unshot),
            ("reflectance", mesh.reflectance),
            ("surface_id", mesh.element_surface),
            ("patch_id", mesh.element_patch),
            ("element_id", np.arange(mesh.element_count)),
        ):
            poly.cell_data[name] = _column(values[owner])
        poly.point_data["radiosity_W_m2"] = _column(at_points)
        poly.field_data["surface_names"] = np.asarray([s.name for s in self.scene.surfaces])
        return poly

    def _triangles(self, at_corners: FloatArray) -> tuple[FloatArray, FloatArray, NDArray, NDArray]:
        """Points, their values, triangles (t, 3) that meet corner to corner, and the piece of each."""
        mesh = self.mesh
        points, starts, edge = conforming_rings(mesh)
        counts = np.diff(starts)
        ring = np.repeat(np.arange(len(counts)), counts)
        # A corner in the middle of an edge gets the mean of the edge's ends, on both sides of it alike.
        after = np.arange(1, len(mesh.corners) + 1)
        after[mesh.piece_start[1:] - 1] = mesh.piece_start[:-1]
        length = np.linalg.norm(mesh.corners[after] - mesh.corners, axis=1)[edge]
        t = np.linalg.norm(points - mesh.corners[edge], axis=1) / np.where(length > 0, length, 1.0)
        values = at_corners[edge] + t[:, None] * (at_corners[after[edge]] - at_corners[edge])
        key = np.unique(np.column_stack([points, mesh.element_surface[mesh.piece_element[ring]]]), axis=0,
                        return_inverse=True)[1].reshape(-1)  # fmt: skip
        inside = np.column_stack([np.bincount(ring, points[:, k], len(counts)) for k in range(3)]) / counts[:, None]
        hanging = t > 0
        # Both sides of an edge must agree: what hangs on the longer edge decides.
        chosen = np.full(key.max() + 1, -1)
        chosen[key[hanging]] = np.flatnonzero(hanging)
        values = np.where((chosen[key] >= 0)[:, None], values[chosen[key]], values)
        centre = np.column_stack([np.bincount(ring, v, len(counts)) for v in values.T]) / counts[:, None]
        here = np.arange(len(points))
        following = here + 1
        following[starts[1:] - 1] = starts[:-1]
        fans = np.column_stack([here, following, len(points) + ring])
        # A triangle with nothing on its edges stays one.
        whole = np.flatnonzero(counts == 3)
        keep = counts[ring] != 3
        triangles = np.concatenate([fans[keep], starts[whole, None] + np.arange(3)])
        piece = np.concatenate([ring[keep], whole])
        return np.concatenate([points, inside]), np.concatenate([values, centre]), triangles, piece

    def save(self, directory: str | Path) -> None:
        """Write ``solution.npz``, ``solution.vtp`` and ``record.json``, each whole or not at all."""
        directory = Path(directory)
        directory.mkdir(parents=True, exist_ok=True)
        self.save_state(directory)
        vtp = directory / f".solution.{os.getpid()}.part.vtp"
        try:
            self.to_pyvista().save(vtp)
            vtp.replace(directory / "solution.vtp")
        finally:
            vtp.unlink(missing_ok=True)
        self.record.write(directory / "record.json")

    def save_state(self, directory: str | Path) -> None:
        """Write ``solution.npz`` alone, whole or not at all: all that ``resume`` needs."""
        directory = Path(directory)
        arrays = {f"mesh_{f.name}": getattr(self.mesh, f.name) for f in dataclasses.fields(self.mesh)}
        state = {
            "converged": self.converged,
            "stopped": self.stopped,
            "scene_path": str(self.scene.path) if self.scene.path is not None else "",
            "record": self.record.as_dict(),
        }
        arrays |= {f"book_{k}": getattr(self.book, k) for k in ("emitted", "shot", "received", "absorbed", "escaped")}
        if self.shooting is not None:
            stored = self.shooting.as_arrays(with_kept=not self.converged)
            arrays |= {f"shooting_{name}": values for name, values in stored.items()}
        if self.refinement is not None:
            arrays |= {f"refinement_{name}": values for name, values in self.refinement.items()}
        beside = directory / f".solution.{os.getpid()}.part.npz"
        try:
            np.savez(
                beside,
                radiosity_W_m2=self.radiosity,
                irradiance_W_m2=self.element_irradiance,
                unshot_W_m2=self.unshot,
                direct_irradiance_W_m2=self.direct_irradiance,
                state=json.dumps(state, default=float),
                **arrays,
            )
            beside.replace(directory / "solution.npz")
        finally:
            beside.unlink(missing_ok=True)

    @classmethod
    def load(cls, directory: str | Path) -> Solution:
        """Read a saved solution; the scene is read again from its own file.

        Raises
        ------
        InputError
            If the folder holds no solution, or it cannot be read.
        """
        path = Path(directory) / "solution.npz"
        if not path.is_file():
            raise InputError(
                f"{path}: not found, expected a saved solution; run 'radiosity solve SCENE -o {directory}'"
            )
        try:
            with np.load(path, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            state: dict[str, Any] = json.loads(str(arrays["state"]))
            fields = {f.name: arrays[f"mesh_{f.name}"] for f in dataclasses.fields(PatchMesh)}
            fields["facet_error"] = float(fields["facet_error"])
            mesh = PatchMesh(**fields)
            names = ("emitted", "shot", "received", "absorbed", "escaped")
            book = EnergyBook(*(arrays[f"book_{k}"] for k in names))
            values = [arrays[k] for k in ("radiosity_W_m2", "irradiance_W_m2", "unshot_W_m2", "direct_irradiance_W_m2")]
            stored, refinement = (
                {name[len(prefix) :]: array for name, array in arrays.items() if name.startswith(prefix)}
                for prefix in ("shooting_", "refinement_")
            )
            shooting = ShootingState.from_arrays(stored) if stored else None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: found no readable solution ({error}); solve the scene again") from None
        stored_record = state["record"]
        record = RunRecord(command=stored_record["command"])
        for name in ("settings", "choices", "seconds", "errors", "results"):
            setattr(record, name, stored_record[name])
        record.counters = Counters(**stored_record["counters"])
        scene = Scene(name=Path(directory).name, surfaces=(), bands=mesh.bands)
        if state["scene_path"] and Path(state["scene_path"]).exists():
            from workbench.scene.load import load

            scene = load(state["scene_path"])
        return cls(
            scene=scene,
            mesh=mesh,
            radiosity=values[0],
            element_irradiance=values[1],
            unshot=values[2],
            book=book,
            record=record,
            converged=bool(state["converged"]),
            stopped=str(state["stopped"]),
            direct_irradiance=values[3],
            shooting=shooting,
            refinement=refinement or None,
        )
