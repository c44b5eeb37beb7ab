"""The record that a solver returns: radiosity on a mesh, with its energy book and its errors."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from radiosity.interpolation import corner_values
from radiosity.patches import PatchMesh
from workbench.counters import Counters
from workbench.errors import InputError
from workbench.record import RunRecord
from workbench.scene.model import Scene

if TYPE_CHECKING:
    import pyvista

__all__ = ["EnergyBook", "ProgressEvent", "Solution"]

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
    irradiance : (n, bands) float
        Flux arriving per area. [W m-2]
    unshot : (n, bands) float
        The part of radiosity that has not been shot yet. [W m-2]
    book : EnergyBook
    record : RunRecord
    converged : bool
    stopped : str
        Why the solver stopped: ``tolerance``, ``solved``, ``interrupted``.
    """

    scene: Scene
    mesh: PatchMesh
    radiosity: FloatArray
    irradiance: FloatArray
    unshot: FloatArray
    book: EnergyBook
    record: RunRecord
    converged: bool = False
    stopped: str = ""
    direct_irradiance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def unshot_power(self) -> FloatArray:
        """Power still to be shot, (bands,). [W]"""
        return self.mesh.element_area @ self.unshot

    def vertex_radiosity(self) -> FloatArray:
        """Radiosity interpolated to the corners of the mesh's pieces, (k, bands). [W m-2]"""
        return corner_values(self.mesh, self.radiosity)

    def to_pyvista(self) -> pyvista.PolyData:
        """The mesh with its arrays, for pyvista.

        Cell arrays ``radiosity_W_m2``, ``irradiance_W_m2``, ``emission_W_m2``, ``unshot_W_m2``,
        ``reflectance``, ``surface_id``, ``patch_id``, ``element_id``; point array
        ``radiosity_W_m2``, interpolated; field data ``surface_names``.
        """
        import pyvista

        mesh = self.mesh
        counts = np.diff(mesh.piece_start)
        # Each ring as (count, corner, corner, ...), the layout of VTK's cell array.
        cells = np.insert(np.arange(len(mesh.corners)), mesh.piece_start[:-1], counts)
        poly = pyvista.PolyData(mesh.corners, faces=cells)
        owner = mesh.piece_element
        for name, values in (
            ("radiosity_W_m2", self.radiosity),
            ("irradiance_W_m2", self.irradiance),
            ("emission_W_m2", mesh.emission),
            ("unshot_W_m2", self.unshot),
            ("reflectance", mesh.reflectance),
            ("surface_id", mesh.element_surface),
            ("patch_id", mesh.element_patch),
            ("element_id", np.arange(mesh.element_count)),
        ):
            poly.cell_data[name] = _column(values[owner])
        poly.point_data["radiosity_W_m2"] = _column(self.vertex_radiosity())
        poly.field_data["surface_names"] = np.asarray([s.name for s in self.scene.surfaces])
        return poly

    def save(self, directory: str | Path) -> None:
        """Write ``solution.npz``, ``solution.vtp`` and ``record.json``, each whole or not at all."""
        directory = Path(directory)
        directory.mkdir(parents=True, exist_ok=True)
        arrays = {f"mesh_{f.name}": getattr(self.mesh, f.name) for f in dataclasses.fields(self.mesh)}
        state = {
            "converged": self.converged,
            "stopped": self.stopped,
            "scene_path": str(self.scene.path) if self.scene.path is not None else "",
            "record": self.record.as_dict(),
        }
        arrays |= {f"book_{k}": getattr(self.book, k) for k in ("emitted", "shot", "received", "absorbed", "escaped")}
        beside = directory / f".solution.{os.getpid()}.part.npz"
        vtp = directory / f".solution.{os.getpid()}.part.vtp"
        try:
            np.savez(
                beside,
                radiosity_W_m2=self.radiosity,
                irradiance_W_m2=self.irradiance,
                unshot_W_m2=self.unshot,
                direct_irradiance_W_m2=self.direct_irradiance,
                state=json.dumps(state, default=float),
                **arrays,
            )
            self.to_pyvista().save(vtp)
            beside.replace(directory / "solution.npz")
            vtp.replace(directory / "solution.vtp")
        finally:
            beside.unlink(missing_ok=True)
            vtp.unlink(missing_ok=True)
        self.record.write(directory / "record.json")

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
            irradiance=values[1],
            unshot=values[2],
            book=book,
            record=record,
            converged=bool(state["converged"]),
            stopped=str(state["stopped"]),
            direct_irradiance=values[3],
        )
