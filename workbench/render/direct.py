"""A scene as a picture of its direct light, mirrors and glass: no light between diffuse surfaces."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from workbench.errors import InputError, OptionError
from workbench.record import RunRecord
from workbench.render.adaptive import Picture, adaptive, aliased, supersampled
from workbench.render.atomic import AtomicOptions
from workbench.render.camera import PinholeRays
from workbench.render.image import to_bytes
from workbench.render.rows import picture_by_rows
from workbench.render.trace import TraceOptions, Tracer
from workbench.scene.model import Scene

__all__ = ["SAMPLINGS", "DirectPicture", "render_direct"]

SAMPLINGS = ("aliased", "rows", "supersampled", "adaptive", "atomic")
"""One ray a pixel, the same in Woo's two passes a row, a square of rays, adaptive and atomic adaptive sampling."""

_GLANCE = 96


@dataclass(frozen=True)
class DirectPicture:
    """``pixels`` (h, w, 3) uint8, the :class:`Picture` behind them, and the record of the run."""

    pixels: NDArray[np.uint8]
    picture: Picture
    record: RunRecord


def _white(tracer: Tracer, rays: PinholeRays) -> float:
    """Radiance below which 99 per cent of a coarse look lie, lamps and black left out; 1 where nothing is left."""
    x = (np.arange(_GLANCE) + 0.5) * rays.width / _GLANCE
    y = (np.arange(_GLANCE) + 0.5) * rays.height / _GLANCE
    across, down = np.meshgrid(x, y)
    found = tracer.trace(rays.eye, rays.directions(across.ravel(), down.ravel()))
    lamps = np.array([surface.material.emission.any() for surface in tracer.scene.surfaces] + [False])
    seen = found.radiance.max(axis=1)[~lamps[found.surface]]
    return float(np.percentile(seen[seen > 0], 99)) if (seen > 0).any() else 1.0


def render_direct(
    scene: Scene,
    *,
    sampling: str = "atomic",
    options: TraceOptions | None = None,
    atomic: AtomicOptions | None = None,
    threshold: float = 0.06,
    level: int = 3,
    shared_boundary: bool = False,
    side: int = 4,
    white: float | None = None,
    width: int | None = None,
    workers: int = 1,
) -> DirectPicture:
    """Trace a scene through its own camera.

    Parameters
    ----------
    scene : Scene
        Of 1 or 3 bands, with a camera.
    sampling : str
        One of :data:`SAMPLINGS`.
    options : TraceOptions, optional
    atomic : AtomicOptions, optional
        For ``sampling="atomic"``.
    threshold, level, shared_boundary
        Of :func:`~workbench.render.adaptive.adaptive`.
    side : int
        Rays each way in a pixel, for ``sampling="supersampled"``.
    white : float, optional
        Radiance shown as white; chosen from a coarse look unless given. [W m-2 sr-1]
    width : int, optional
        Pixels across, the height in proportion; the camera's unless given.
    workers : int
        Threads; the picture does not depend on it.

    Raises
    ------
    InputError
        If the scene has no camera, or other than 1 or 3 bands.
    OptionError
        If an option is out of its range.
    """
    if sampling not in SAMPLINGS:
        raise OptionError(f"sampling: found {sampling!r}, expected one of {', '.join(SAMPLINGS)}")
    if scene.camera is None:
        raise InputError(f"{scene.path or scene.name}: found no camera, expected one; add it to the scene")
    if scene.bands not in (1, 3):
        raise InputError(f"{scene.path or scene.name}: found {scene.bands} bands, expected 1 or 3 for a picture")
    camera = scene.camera
    if width is not None:
        height = max(1, round(width * camera.height / camera.width))
        camera = replace(camera, width=width, height=height)
    rays = PinholeRays.from_camera(camera)
    record = RunRecord(
        "render",
        settings={"sampling": sampling, "width": rays.width, "height": rays.height, "threshold": threshold,
                  "level": level, "side": side, "shared_boundary": shared_boundary, "workers": workers},
    )  # fmt: skip
    with record.stage("build"):
        tracer = Tracer(scene, options, workers=workers)
    if white is None:
        with record.stage("exposure"):
            white = _white(tracer, rays)
        record.choices["white"] = f"{white:.4g} W/(m2 sr): 99 per cent of a coarse look, lamps left out, lie below"
    with record.stage("trace"):
        if sampling == "aliased":
            picture = aliased(tracer, rays)
        elif sampling == "rows":
            by_rows = picture_by_rows(tracer, rays)
            picture = by_rows.picture
            # The tally has these rays too.
            record.counters.merge({k: v for k, v in by_rows.counters.items() if k not in ("rays", "rays_hit")})
            record.results["first_pass_s"] = by_rows.first_pass_s
        elif sampling == "supersampled":
            picture = supersampled(tracer, side, rays)
        else:
            chosen = None if sampling == "adaptive" else atomic or AtomicOptions()
            picture = adaptive(
                tracer,
                rays,
                threshold=threshold,
                level=level,
                atomic=chosen,
                shared_boundary=shared_boundary,
                white=white,
            )
    if sampling in ("adaptive", "atomic"):
        # Four corners that agree tell nothing of what lies between them: the pitch of the corners.
        record.errors["widest_feature_that_can_be_missed_pixels"] = 1.0
    record.counters.merge(picture.tally.counters())
    record.results |= {
        "white_W_m2_sr": white,
        "samples": picture.traced,
        "samples_per_pixel": float(picture.samples.mean()),
        "shadow_rays": {
            light: vars(count) for light, count in zip(tracer.light_names, picture.tally.shadows, strict=True)
        },
    }
    radiance = picture.radiance if scene.bands == 3 else np.repeat(picture.radiance, 3, axis=2)
    return DirectPicture(to_bytes(radiance / white), picture, record)
