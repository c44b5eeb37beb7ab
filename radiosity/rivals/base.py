"""The interface of a rival, and what all of them check."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.arrays import as_count, as_places
from workbench.errors import OptionError
from workbench.geometry.flat import Geometry
from workbench.scene.model import Camera, Scene

__all__ = ["QUESTIONS", "Rival", "band_triples", "black_lamps", "checked_points"]

FloatArray = NDArray[np.float64]

QUESTIONS = ("direct", "irradiance", "view factors", "picture")
"""Direct irradiance at points, irradiance with all reflections, form factors between polygons, a picture."""


class Rival:
    """Another engine with a scene loaded; subclasses answer the questions in ``answers``.

    Parameters
    ----------
    scene : Scene

    Raises
    ------
    OptionError
        If the engine cannot model the scene; the message says what is in its way.
    """

    name = ""
    answers: frozenset[str] = frozenset()
    light_kinds: frozenset[str] = frozenset()
    """Kinds of :class:`~workbench.scene.model.Light` that the engine has."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.geometry = Geometry.from_scene(scene)
        for surface in scene.surfaces:
            if surface.material.transmittance.any():
                raise OptionError(f"{self.name}: surface {surface.name!r} is a pane, which this rival is not given")
            if surface.material.two_sided and surface.material.emission.any():
                raise OptionError(f"{self.name}: surface {surface.name!r} emits on both sides, expected one-sided")
        if scene.sky is not None:
            raise OptionError(f"{self.name}: found a sky of kind {scene.sky.kind!r}, expected a background or none")
        for light in scene.lights:
            if light.power.any() and light.kind not in self.light_kinds:
                raise OptionError(f"{self.name}: light {light.name!r} is of kind {light.kind}, which it does not have")

    @classmethod
    def absent(cls) -> str | None:
        """Why the engine cannot run here although its package is installed, or ``None``."""
        return None

    def irradiance(
        self, points: ArrayLike, normals: ArrayLike, *, samples: int, seed: int = 0, direct_only: bool = False
    ) -> FloatArray:
        """Irradiance (n, bands) at points. [W m-2]

        Parameters
        ----------
        points : (n, 3) float
        normals : (n, 3) or (3,) float
        samples : int
            Paths a point, or what the engine has in their place.
        seed : int
        direct_only : bool
            Leave out light that was reflected.

        Raises
        ------
        OptionError
            If the engine does not answer that.
        """
        raise OptionError(f"{self.name}: does not answer 'irradiance', only {', '.join(sorted(self.answers))}")

    def view_factors(self, *, samples: int, seed: int = 0) -> FloatArray:
        """Form factors (q, q) from row polygon to column polygon of ``self.geometry``.

        Parameters
        ----------
        samples : int
            Rays or elements a polygon.
        seed : int

        Raises
        ------
        OptionError
            If the engine does not answer that.
        """
        raise OptionError(f"{self.name}: does not answer 'view factors', only {', '.join(sorted(self.answers))}")

    def picture(self, camera: Camera, *, samples: int, seed: int = 0, direct_only: bool = False) -> FloatArray:
        """Radiance (height, width, bands) of a picture, row 0 on top. [W m-2 sr-1]

        Parameters
        ----------
        camera : Camera
        samples : int
            Paths a pixel, or what the engine has in their place.
        seed : int
        direct_only : bool

        Raises
        ------
        OptionError
            If the engine does not answer that.
        """
        raise OptionError(f"{self.name}: does not answer 'picture', only {', '.join(sorted(self.answers))}")


def checked_points(points: ArrayLike, normals: ArrayLike, samples: int) -> tuple[FloatArray, FloatArray]:
    """Points and unit normals, both (n, 3); an option error for a bad number of samples."""
    as_count(samples, "samples")
    return as_places(points, normals)


def band_triples(bands: int) -> list[NDArray[np.int64]]:
    """Bands in threes, for engines that know three; the last one repeats its last band."""
    return [np.minimum(np.arange(first, first + 3), bands - 1) for first in range(0, bands, 3)]


def black_lamps(scene: Scene) -> Scene:
    """The scene with reflectance 0 on all that emits: what every engine can model alike."""
    surfaces = tuple(
        replace(surface, material=replace(surface.material, reflectance=np.zeros(scene.bands)))
        if surface.material.emission.any()
        else surface
        for surface in scene.surfaces
    )
    return replace(scene, surfaces=surfaces)
