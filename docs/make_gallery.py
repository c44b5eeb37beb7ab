"""Draw the gallery of README.md: for each scene the radiosity mesh beside the gathered picture.

Run with ``python docs/make_gallery.py [NAME ...] [--error E]``; writes docs/gallery-NAME.png.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import radiosity
import workbench
from radiosity.gather import GatherOptions, PictureGatherer
from radiosity.view import _Caster, _directions
from workbench.render.camera import PinholeRays
from workbench.render.image import Exposure, srgb_bytes, tone_mapped
from workbench.render.pictures import test_picture
from workbench.scene.library import diffuse
from workbench.scene.model import Camera, Scene, Surface

SCENES = ("cornell-box", "office", "sculpture-room", "pots")
ELEMENTS = {"cornell-box": 800, "office": 1500, "sculpture-room": 600, "pots": 400}


def pots() -> Scene:
    """The pots and the chair of Woo's picture, as we drew them, under two panels that shine."""
    scene = test_picture("pots", 400, 300).scene
    panels = (
        ("lamp", [[-4.6, -5.2, 6.8], [-4.6, -3.6, 6.8], [-3.0, -3.6, 6.8], [-3.0, -5.2, 6.8]], (60.0, 56.0, 48.0)),
        ("window", [[5.9, -5.0, 2.5], [5.9, -5.0, 5.5], [5.9, -2.0, 5.5], [5.9, -2.0, 2.5]][::-1], (14.0, 17.0, 20.0)),
    )
    lit = [
        Surface.from_polygons(name, diffuse(name, 0.0, power, bands=3), [np.array(corners)])
        for name, corners, power in panels
    ]
    return replace(scene, surfaces=(*scene.surfaces, *lit), lights=())


def flat_mesh(solution: radiosity.Solution, camera: Camera) -> NDArray[np.float64]:
    """The elements' radiance, one colour each, four rays a pixel."""
    caster = _Caster(solution.mesh, np.asarray(camera.eye, dtype=float))
    triangle, _ = caster.cast(_directions(camera, 2))
    radiance = np.zeros((len(triangle), solution.mesh.bands))
    met = triangle >= 0
    radiance[met] = solution.radiosity[caster.element[triangle[met]]] / np.pi
    return radiance.reshape(camera.height, 2, camera.width, 2, -1).mean(axis=(1, 3))


def main() -> None:
    """Write the pictures asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*SCENES, []], default=list(SCENES))
    parser.add_argument("--error", type=float, default=0.02)
    parser.add_argument("--height", type=int, default=300)
    arguments = parser.parse_args()
    for name in arguments.names:
        scene = pots() if name == "pots" else workbench.load(name)
        assert scene.camera is not None
        width = round(arguments.height * scene.camera.width / scene.camera.height)
        camera = replace(scene.camera, width=width, height=arguments.height)
        start = time.perf_counter()
        solution = radiosity.solve(scene, elements=ELEMENTS[name])
        solved = time.perf_counter() - start
        gathered = PictureGatherer(solution, GatherOptions(error=arguments.error)).draw(PinholeRays.from_camera(camera))
        sys.stdout.write(f"{name}: solved in {solved:.1f} s, drawn in {time.perf_counter() - start - solved:.1f} s\n")
        exposure = Exposure(gathered.radiance)
        left, right = (
            srgb_bytes(tone_mapped(picture, "linear", exposure))
            for picture in (flat_mesh(solution, camera), gathered.radiance)
        )
        gap = np.full((arguments.height, 6, 3), 255, dtype=np.uint8)
        path = Path(__file__).parent / f"gallery-{name}.png"
        Image.fromarray(np.concatenate([left, gap, right], axis=1)).save(path, optimize=True)
        sys.stdout.write(f"{path}: {path.stat().st_size / 1000:.0f} kB\n")


if __name__ == "__main__":
    main()
