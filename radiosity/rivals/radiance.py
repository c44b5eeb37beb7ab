"""Radiance (G. J. Ward, "The RADIANCE lighting simulation and rendering system", SIGGRAPH 1994), by pyradiance.

Points are asked of ``rtrace -I``, pictures of ``rtrace`` over the pixels' rays.  Without its ambient
cache (``-aa 0``) every value is a plain Monte Carlo estimate; the parameters used stand in
:attr:`Radiance.parameters`.

Lamps are black in Radiance, so emitters that reflect are refused; :func:`~radiosity.rivals.base.black_lamps`
makes them black for all.  A surface's back is made black by a pattern on the ray's side.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radiosity.rivals.base import Rival, band_triples, checked_points
from workbench.arrays import as_count
from workbench.errors import OptionError
from workbench.geometry.flat import Geometry
from workbench.render.camera import PinholeRays
from workbench.scene.model import Camera, Light, Scene

__all__ = ["Radiance"]

FloatArray = NDArray[np.float64]

SOURCE_SAMPLES = 64
"""Radiance cuts a source into at most this many parts for one ray (MAXSPART)."""
BOUNCES = 12
"""Ambient bounces: at the mean reflectance of a room what is left is below 1 %; see ``ambient_bounces``."""
SEEDS = 64
"""Different sequences of random numbers."""
ANGLE = 0.05
"""Angle of a distant light that has none. [degrees]"""


class Radiance(Rival):
    """A scene as an octree of Radiance.

    ``samples`` are ambient divisions (``-ad``), or the parts of a source for direct light.

    Parameters
    ----------
    scene : Scene
    ambient_bounces : int, optional
        ``-ab``; by default as many as leave 0.1 % of the light at the area's mean reflectance, 2 to 12.
    workers : int, optional
        Processes, all cores by default.

    Raises
    ------
    OptionError
        If the scene holds panes, two-sided emitters, emitters that reflect, or lights of other kinds
        than point and directional.
    """

    name = "radiance"
    answers = frozenset({"direct", "irradiance", "picture"})
    light_kinds = frozenset({"point", "directional"})

    def __init__(self, scene: Scene, ambient_bounces: int | None = None, workers: int | None = None) -> None:
        super().__init__(scene)
        for surface in scene.surfaces:
            if surface.material.emission.any() and surface.material.reflectance.any():
                raise OptionError(
                    f"radiance: surface {surface.name!r} emits and reflects, and lamps are black in Radiance;"
                    " make its reflectance 0"
                )
        self.parameters: list[str] = []
        self.workers = workers or len(os.sched_getaffinity(0))
        self.ambient_bounces = ambient_bounces or _bounces(scene, self.geometry)
        self._folder = tempfile.TemporaryDirectory(prefix="radiosity-radiance-")
        self._triples = band_triples(scene.bands)
        self._octrees = [self._octree(number) for number in range(len(self._triples))]

    def _octree(self, number: int) -> Path:
        """Write and convert the scene with one triple of bands."""
        import pyradiance

        stem = Path(self._folder.name) / f"scene{number}"
        text = _described(self.scene, self.geometry, self._triples[number])
        stem.with_suffix(".rad").write_text(text, encoding="ascii")
        stem.with_suffix(".oct").write_bytes(pyradiance.oconv(stem.with_suffix(".rad"), warning=False))
        return stem.with_suffix(".oct")

    def _trace(self, octree: Path, rays: FloatArray, irradiance: bool, ambient: Sequence[str], seed: int) -> FloatArray:
        import pyradiance

        self.parameters = ["-aa", "0", "-dt", "0", "-dc", "1", "-dj", "1", *ambient]
        # A process's random numbers are always the same.  Points far around, looking at the scene, take some
        # of them first: as many as seed and process say.
        away = np.random.default_rng(0).normal(size=(4 * SEEDS, 3))
        away /= np.linalg.norm(away, axis=1)[:, None]
        in_vain = np.column_stack([self.geometry.bounds.mean(axis=0) + 1e3 * self.geometry.size * away, -away])

        def part(number: int) -> FloatArray:
            vain = 4 * ((seed * self.workers + number) % SEEDS)
            sent = np.concatenate([in_vain[:vain], rays[number :: self.workers]])
            got = pyradiance.rtrace(
                sent.astype("<f8").tobytes(), octree, header=False, inform="d", outform="d", irradiance=irradiance,
                uncorrelated=True, nproc=1, params=self.parameters,
            )  # fmt: skip
            return np.frombuffer(got, dtype="<f8").reshape(-1, 3)[vain:]

        found = np.empty((len(rays), 3))
        busy = range(min(self.workers, len(rays)))
        with ThreadPoolExecutor(len(busy)) as pool:
            for number, values in zip(busy, pool.map(part, busy), strict=True):
                found[number :: self.workers] = values
        return found

    def _ambient(self, samples: int, direct_only: bool) -> tuple[list[str], int]:
        """Parameters for so many samples, and how often each ray is repeated for them."""
        if not direct_only:
            # Rays that carry less than their share end by Russian roulette (-lr below 0), without bias.
            limits = ["-lr", str(-self.ambient_bounces - 2), "-lw", f"{0.1 / samples:.3g}"]
            return ["-ab", str(self.ambient_bounces), "-ad", str(samples), "-as", "0", "-ds", "0.03", *limits], 1
        repeats = -(-samples // SOURCE_SAMPLES)
        # A source is cut until its parts are smaller than this share of their distance.
        return ["-ab", "0", "-ds", f"{1.0 / math.sqrt(min(samples, SOURCE_SAMPLES)):.6f}"], repeats

    def irradiance(
        self, points: ArrayLike, normals: ArrayLike, *, samples: int, seed: int = 0, direct_only: bool = False
    ) -> FloatArray:
        """Irradiance (n, bands) at points by ``rtrace -I``, see :meth:`Rival.irradiance`. [W m-2]

        rtrace has no seed: as many points as ``seed`` says are asked in vain first.  The answer also
        depends on the number of processes.
        """
        points, normals = checked_points(points, normals, samples)
        if direct_only and self.scene.background.any():
            raise OptionError("radiance: a background is no source of direct light there; leave out direct_only")
        ambient, repeats = self._ambient(samples, direct_only)
        order = np.repeat(np.arange(len(points)), repeats)
        rays = np.column_stack([points, normals])[order]
        found = np.zeros((len(points), self.scene.bands))
        for chosen, octree in zip(self._triples, self._octrees, strict=True):
            values = self._trace(octree, rays, True, ambient, seed)
            sums = np.stack([np.bincount(order, values[:, k], len(points)) for k in range(len(chosen))], axis=1)
            found[:, chosen] = sums / repeats
        return found

    def picture(self, camera: Camera, *, samples: int, seed: int = 0, direct_only: bool = False) -> FloatArray:
        """A picture (height, width, bands), ``samples`` rays at random places of each pixel. [W m-2 sr-1]

        Each ray follows one path: many parts of a source or ambient divisions would be wasted on it.
        """
        as_count(samples, "samples")
        pinhole = PinholeRays.from_camera(camera)
        pixel = np.repeat(np.arange(camera.height * camera.width), samples)
        place = np.random.default_rng(seed).random((2, len(pixel)))
        toward = pinhole.directions(pixel % camera.width + place[0], pixel // camera.width + place[1])
        rays = np.column_stack([np.broadcast_to(pinhole.eye, toward.shape), toward])
        ambient = ["-ab", "0", "-ds", "0"]
        if not direct_only:
            bounces = self.ambient_bounces
            ambient = ["-ab", str(bounces), "-ad", "1", "-as", "0", "-ds", "0", "-lr", str(-bounces - 2), "-lw", "0.1"]
        found = np.zeros((camera.height * camera.width, self.scene.bands))
        for chosen, octree in zip(self._triples, self._octrees, strict=True):
            values = self._trace(octree, rays, False, ambient, seed).reshape(-1, samples, 3).mean(axis=1)
            found[:, chosen] = values[:, : len(chosen)]
        return found.reshape(camera.height, camera.width, self.scene.bands)


def _bounces(scene: Scene, geometry: Geometry) -> int:
    """Bounces after which 0.1 % is left at the mean reflectance of the area."""
    reflectance = np.array([material.reflectance.max() for material in geometry.surface_material])
    mean = float(np.average(reflectance[geometry.polygon_surface], weights=geometry.polygon_area))
    return 2 if mean < 0.03 else min(max(2, math.ceil(math.log(1e-3) / math.log(min(mean, 0.999)))), BOUNCES)


def _numbers(values: ArrayLike) -> str:
    return " ".join(f"{value:.17g}" for value in np.ravel(values))


def _described(scene: Scene, geometry: Geometry, chosen: NDArray[np.int64]) -> str:
    """The scene in Radiance's own format, three bands of it."""
    lines = ["void brightfunc front 2 if(Rdot,1,0) . 0 0"]
    for index, material in enumerate(geometry.surface_material):
        pattern = "void" if material.two_sided else "front"
        lines.append(f"{pattern} plastic paint{index} 0 0 5 {_numbers(material.reflectance[chosen])} 0 0")
        if material.emission.any():
            radiance = _numbers(material.emission[chosen] / np.pi)
            lines.append(f"void light lamp{index} 0 0 3 {radiance}")
    for piece in range(geometry.piece_count):
        surface = int(geometry.polygon_surface[geometry.piece_polygon[piece]])
        kind = "lamp" if geometry.surface_material[surface].emission.any() else "paint"
        ring = geometry.piece(piece)
        lines.append(f"{kind}{surface} polygon p{piece} 0 0 {ring.size} {_numbers(ring)}")
    for number, light in enumerate(scene.lights):
        if light.power.any():
            lines += _light(light, number, chosen, geometry.size)
    if scene.background.any():
        lines.append(f"void glow sky 0 0 4 {_numbers(scene.background[chosen])} 0")
        lines.append("sky source everywhere 0 0 4 0 0 1 360")
    return "\n".join(lines) + "\n"


def _light(light: Light, number: int, chosen: NDArray[np.int64], size: float) -> list[str]:
    if light.kind == "point":
        assert light.position is not None
        radius = 1e-4 * size  # a sphere of radiance I / (pi r^2)
        radiance = light.power[chosen] / (math.pi * radius**2)
        return [
            f"void light bulb{number} 0 0 3 {_numbers(radiance)}",
            f"bulb{number} sphere s{number} 0 0 4 {_numbers(light.position)} {radius:.17g}",
        ]
    assert light.direction is not None
    radiance = light.power[chosen] / (2.0 * math.pi * (1.0 - math.cos(math.radians(ANGLE / 2))))
    return [
        f"void light sun{number} 0 0 3 {_numbers(radiance)}",
        f"sun{number} source s{number} 0 0 4 {_numbers(-light.direction)} {ANGLE}",
    ]
