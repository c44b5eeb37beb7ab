"""Mitsuba 3 (W. Jakob and others, 2022, www.mitsuba-renderer.org): path tracing, vectorised by Dr.Jit.

Irradiance at a point is gathered as Mitsuba's own path integrator shades a white diffuse surface:
direct light by one emitter sample and one cosine-weighted direction, joined by the balance heuristic
(E. Veach and L. Guibas, SIGGRAPH 1995), reflected light by following that direction.
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radiosity.rivals.base import Rival, band_triples, checked_points
from workbench.arrays import as_count
from workbench.scene.model import Camera, Light, Scene

__all__ = ["Mitsuba"]

FloatArray = NDArray[np.float64]

BLOCK = 1 << 21
"""Paths followed at once: the memory of one wave stays below a gigabyte."""
MAX_DEPTH = 1000
"""Longest path; Russian roulette ends nearly all of them far earlier."""

_TRIAL = """
import mitsuba
mitsuba.set_variant("llvm_ad_mono")
import drjit
values = drjit.maximum(drjit.arange(mitsuba.Float, 4) - 1.5, 0)
drjit.eval(drjit.gather(mitsuba.Float, values, drjit.arange(mitsuba.UInt32, 4)))
"""


class Mitsuba(Rival):
    """A scene in Mitsuba 3; paths a point or pixel are the samples.

    Parameters
    ----------
    scene : Scene
    variant : str, optional
        Mitsuba's variant; ``llvm_ad_mono`` for one band and ``llvm_ad_rgb`` otherwise, bands in threes.
    sampler : str
        Mitsuba's sampler.  ``multijitter`` is its best here: of the noise of ``independent`` at 256 samples it
        leaves a quarter for direct light and two thirds for all light.  It rounds the number of samples up to a
        product of two near numbers.

    Raises
    ------
    OptionError
        If the scene holds panes, two-sided emitters, or lights of other kinds than point and
        directional.
    """

    name = "mitsuba"
    answers = frozenset({"direct", "irradiance", "picture"})
    light_kinds = frozenset({"point", "directional"})

    def __init__(self, scene: Scene, variant: str | None = None, sampler: str = "multijitter") -> None:
        super().__init__(scene)
        self.sampler = sampler
        self.variant = variant or ("llvm_ad_mono" if scene.bands == 1 else "llvm_ad_rgb")
        self._mi = _module(self.variant)
        self._triples = band_triples(scene.bands)
        self._scenes = [self._load(chosen) for chosen in self._triples]

    @classmethod
    def absent(cls) -> str | None:
        """Whether Dr.Jit finds an LLVM library that it can use."""
        # An LLVM older than 16 ends the process when it meets a maximum, so another process tries it.
        trial = subprocess.run([sys.executable, "-c", _TRIAL], capture_output=True, text=True, check=False)
        if trial.returncode == 0:
            return None
        said = (trial.stderr.strip() or "no reason given").splitlines()
        return f"its llvm variants do not run here ({said[0][:80]}); install LLVM 16 or newer (Debian: libllvm19)"

    # ---- the scene ------------------------------------------------------------------------------

    def _load(self, chosen: NDArray[np.int64]) -> Any:
        mi, geo = self._mi, self.geometry

        def colour(values: FloatArray) -> dict[str, Any]:
            return {"type": "rgb", "value": np.asarray(values)[chosen].tolist()}

        triangles, piece = geo.triangles
        surface_of = geo.polygon_surface[geo.piece_polygon[piece]]
        described: dict[str, Any] = {"type": "scene"}
        for index, material in enumerate(geo.surface_material):
            mine = triangles[surface_of == index]
            if not len(mine):
                continue
            props = mi.Properties()
            bsdf: dict[str, Any] = {"type": "diffuse", "reflectance": colour(material.reflectance)}
            props["mesh_bsdf"] = mi.load_dict({"type": "twosided", "bsdf": bsdf} if material.two_sided else bsdf)
            if material.emission.any():
                radiance = colour(material.emission / np.pi)
                props["mesh_emitter"] = mi.load_dict({"type": "area", "radiance": radiance})
            mesh = mi.Mesh(f"surface {index}", 3 * len(mine), len(mine), props=props)
            parameters = mi.traverse(mesh)
            parameters["vertex_positions"] = mine.reshape(-1).astype(np.float32)
            parameters["faces"] = np.arange(3 * len(mine), dtype=np.uint32)
            parameters.update()
            described[f"surface{index}"] = mesh
        for index, light in enumerate(self.scene.lights):
            if light.power.any():
                described[f"light{index}"] = _light(light, colour)
        if self.scene.background.any():
            described["background"] = {"type": "constant", "radiance": colour(self.scene.background)}
        return mi.load_dict(described)

    # ---- questions ------------------------------------------------------------------------------

    def irradiance(
        self, points: ArrayLike, normals: ArrayLike, *, samples: int, seed: int = 0, direct_only: bool = False
    ) -> FloatArray:
        """Irradiance (n, bands) at points by ``samples`` paths each, see :meth:`Rival.irradiance`. [W m-2]"""
        points, normals = checked_points(points, normals, samples)
        self._mi = _module(self.variant)
        found = np.zeros((len(points), self.scene.bands))
        step = max(1, BLOCK // samples)
        for number, first in enumerate(range(0, len(points), step)):
            rows = slice(first, first + step)
            for chosen, loaded in zip(self._triples, self._scenes, strict=True):
                value = self._gather(loaded, points[rows], normals[rows], samples, seed * 65537 + number, direct_only)
                found[rows, chosen] = value[:, : len(chosen)]
        return found

    def _gather(
        self, loaded: Any, points: FloatArray, normals: FloatArray, samples: int, seed: int, direct_only: bool
    ) -> FloatArray:
        import drjit as dr

        mi = self._mi
        sampler = mi.load_dict({"type": self.sampler, "sample_count": samples})
        samples = sampler.sample_count()  # it may have rounded up
        count = len(points) * samples
        if self.sampler != "independent":
            sampler.set_samples_per_wavefront(samples)  # a wave holds all strata of each of its points
        sampler.seed(seed % (1 << 32), count)
        row = dr.arange(mi.UInt32, count) // dr.opaque(mi.UInt32, samples)  # one kernel for all numbers of samples

        def at(values: FloatArray) -> Any:
            columns = [mi.Float(np.ascontiguousarray(values[:, axis], dtype=np.float32)) for axis in range(3)]
            return [dr.gather(mi.Float, column, row) for column in columns]

        here = dr.zeros(mi.SurfaceInteraction3f, count)
        here.p, here.n = mi.Point3f(*at(points)), mi.Normal3f(*at(normals))
        here.sh_frame = mi.Frame3f(here.n)
        inv_pi, zero = 1.0 / np.pi, mi.Float(0.0)

        # An emitter sample, weighed against the chance that the cosine-weighted direction finds it.
        sample, weight = loaded.sample_emitter_direction(here, sampler.next_2d(), True)
        cosine = dr.maximum(dr.dot(sample.d, here.n), 0.0)
        share = dr.select(sample.delta, 1.0, sample.pdf / (sample.pdf + cosine * inv_pi))
        total = dr.select(sample.pdf > 0.0, weight * cosine * share, zero)

        # The cosine-weighted direction: what is emitted toward the point there, and what is reflected.
        local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        ray = here.spawn_ray(here.sh_frame.to_world(local))
        met = loaded.ray_intersect(ray)
        emitter = met.emitter(loaded)
        emitted = emitter.eval(met)
        toward = mi.DirectionSample3f(loaded, met, here)
        density = loaded.pdf_emitter_direction(here, toward)
        share = dr.select(local.z > 0.0, local.z * inv_pi / (local.z * inv_pi + density), zero)
        total += np.pi * emitted * dr.select(emitter != None, share, zero)  # noqa: E711
        if not direct_only:
            integrator = mi.load_dict({"type": "path", "max_depth": MAX_DEPTH})
            radiance, _, _ = integrator.sample(loaded, sampler, mi.RayDifferential3f(ray))
            total += np.pi * (radiance - emitted)
        return np.stack(
            [np.asarray(dr.block_sum(channel, samples), dtype=np.float64) / samples for channel in total], axis=1
        )

    def picture(self, camera: Camera, *, samples: int, seed: int = 0, direct_only: bool = False) -> FloatArray:
        """A picture (height, width, bands) by ``samples`` paths a pixel. [W m-2 sr-1]"""
        as_count(samples, "samples")
        mi = self._mi = _module(self.variant)
        eye, target, up = (np.asarray(v, dtype=float).tolist() for v in (camera.eye, camera.look_at, camera.up))
        sensor = mi.load_dict({
            "type": "perspective",
            "fov": float(camera.fov_deg),
            "fov_axis": "y",
            "near_clip": 1e-4 * self.geometry.size,
            "far_clip": 1e4 * self.geometry.size,
            "to_world": mi.ScalarTransform4f().look_at(origin=eye, target=target, up=up),
            "film": {
                "type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"},
                "pixel_format": "luminance" if self.variant.endswith("mono") else "rgb", "component_format": "float32",
            },
            "sampler": {"type": self.sampler, "sample_count": samples},
        })  # fmt: skip
        # Two edges of a direct path: from the lamp to the surface, and on to the eye.
        integrator = mi.load_dict({"type": "path", "max_depth": 2 if direct_only else MAX_DEPTH})
        found = np.zeros((camera.height, camera.width, self.scene.bands))
        for chosen, loaded in zip(self._triples, self._scenes, strict=True):
            image = np.asarray(mi.render(loaded, sensor=sensor, integrator=integrator, spp=samples, seed=seed))
            found[..., chosen] = image.reshape(camera.height, camera.width, -1)[..., : len(chosen)]
        return found


def _module(variant: str) -> Any:
    """Mitsuba with the variant set; it is one for the whole process."""
    import mitsuba

    if mitsuba.variant() != variant:
        mitsuba.set_variant(variant)
        mitsuba.set_log_level(mitsuba.LogLevel.Error)  # it warns of every number of samples that it rounds
    return mitsuba


def _light(light: Light, colour: Any) -> dict[str, Any]:
    if light.kind == "point":
        return {"type": "point", "position": np.asarray(light.position).tolist(), "intensity": colour(light.power)}
    return {
        "type": "directional",
        "direction": np.asarray(light.direction).tolist(),
        "irradiance": colour(light.power),
    }
