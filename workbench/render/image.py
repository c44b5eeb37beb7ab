"""Pictures: radiance to bytes, bytes to files."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from workbench.errors import InputError, OptionError

__all__ = [
    "PICTURE_SUFFIXES",
    "RADIANCE_SUFFIXES",
    "TONE_CURVES",
    "Exposure",
    "check_picture_path",
    "srgb_bytes",
    "to_bytes",
    "tone_mapped",
    "write_picture",
    "write_radiance",
]

PICTURE_SUFFIXES = {".tiff": "TIFF", ".tif": "TIFF", ".png": "PNG"}
"""File suffixes of pictures to be looked at, and their formats."""
RADIANCE_SUFFIXES = {".exr": "OpenEXR", ".hdr": "Radiance RGBE"}
"""File suffixes of pictures that keep radiance as it is, and their formats."""
TONE_CURVES = ("linear", "reinhard", "filmic")
"""From radiance to the light of a display: see :func:`tone_mapped`."""

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709
KEY = 0.18
"""Middle grey: where curves put the log-average luminance."""


def to_bytes(radiance: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Pixel values 255 * radiance, rounded to the nearest whole number and pegged at 0 and 255."""
    return np.floor(np.clip(255.0 * radiance, 0.0, 255.0) + 0.5).astype(np.uint8)


class Exposure:
    """How bright a picture is shown.

    Parameters
    ----------
    radiance : (h, w, 3) float
        The picture that is exposed for; black pixels do not count. [W m-2 sr-1]
    stops : float
        Powers of two by which it is made brighter than chosen.
    white : float, optional
        ``linear`` only: radiance shown as white; by default that below which 98 per cent of the pixels
        lie. [W m-2 sr-1]

    Attributes
    ----------
    white : float
        [W m-2 sr-1]
    average : float
        Log-average luminance. [W m-2 sr-1]
    burnt : float
        Luminance that ``reinhard`` shows as white: that below which 99.5 per cent lie. [W m-2 sr-1]
    """

    def __init__(self, radiance: NDArray[np.floating], stops: float = 0.0, white: float | None = None) -> None:
        if not math.isfinite(stops):
            raise OptionError(f"exposure: found {stops}, expected a number of stops")
        if white is not None and not 0.0 < white < math.inf:
            raise OptionError(f"white: found {white}, expected a radiance greater than 0")
        self.gain = 2.0**stops
        lit = radiance.max(axis=2)
        lit = lit[lit > 0]
        luminance = radiance @ _LUMINANCE
        luminance = luminance[luminance > 0]
        self.white = white if white is not None else float(np.percentile(lit, 98)) if len(lit) else 1.0
        self.average = float(np.exp(np.log(luminance).mean())) if len(luminance) else 1.0
        self.burnt = float(np.percentile(luminance, 99.5)) if len(luminance) else 1.0


def tone_mapped(radiance: NDArray[np.floating], curve: str, exposure: Exposure) -> NDArray[np.float64]:
    """Light of a display, 0..1, for a radiance; linear, without the display's transfer curve.

    Parameters
    ----------
    radiance : (h, w, 3) float
        [W m-2 sr-1]
    curve : str
        ``linear`` -- in proportion up to white, pegged there.
        ``reinhard`` -- the global operator of E. Reinhard, M. Stark, P. Shirley and J. Ferwerda
        (SIGGRAPH 2002), Eq. 4, on luminance: colours keep their hue.
        ``filmic`` -- K. Narkowicz's fit to the ACES curve (2015), band by band.
    exposure : Exposure

    Raises
    ------
    OptionError
        If the curve is unknown.
    """
    if curve not in TONE_CURVES:
        raise OptionError(f"tone: found {curve!r}, expected one of {', '.join(TONE_CURVES)}")
    light = np.maximum(np.asarray(radiance, dtype=np.float64), 0.0) * exposure.gain
    if curve == "linear":
        return np.minimum(light / exposure.white, 1.0)
    light = light * (KEY / exposure.average)
    if curve == "reinhard":
        most = max(exposure.burnt * exposure.gain * KEY / exposure.average, 1e-9)
        luminance = light @ _LUMINANCE
        scale = (1.0 + luminance / most**2) / (1.0 + luminance)
        return np.clip(light * scale[..., None], 0.0, 1.0)
    return np.clip(light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14), 0.0, 1.0)


def srgb_bytes(light: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Pixel values (h, w, 3) of an sRGB picture (IEC 61966-2-1) for linear light 0..1."""
    light = np.clip(light, 0.0, 1.0)
    curved = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    return to_bytes(curved)


def check_picture_path(path: str | Path, *, radiance: bool = False) -> Path:
    """The path, if a picture can be written there; with ``radiance`` also one that keeps radiance.

    Raises
    ------
    OptionError
        If the suffix is unknown, the folder does not exist or the path is a folder.
    """
    path = Path(path)
    known = [*PICTURE_SUFFIXES, *(RADIANCE_SUFFIXES if radiance else ())]
    if path.suffix.lower() not in known:
        raise OptionError(f"{path}: found the suffix {path.suffix!r}, expected {', '.join(known)}")
    if not path.parent.is_dir():
        raise OptionError(f"{path}: found no folder {str(path.parent)!r}, expected one; make it first")
    if path.is_dir():
        raise OptionError(f"{path}: found a folder, expected the name of a picture file")
    return path


def write_picture(path: str | Path, pixels: NDArray[np.uint8]) -> None:
    """Write an RGB picture, TIFF or PNG by suffix, whole or not at all.

    Parameters
    ----------
    path : path
    pixels : (h, w, 3) uint8
        Rows from the top.

    Raises
    ------
    InputError
        If the shape or type is another, or the file cannot be written.
    """
    from PIL import Image

    path = check_picture_path(path)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8:
        raise InputError(f"pixels: found {pixels.dtype} of shape {pixels.shape}, expected uint8 of shape (h, w, 3)")
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        Image.fromarray(pixels).save(beside, format=PICTURE_SUFFIXES[path.suffix.lower()])
        beside.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose another place") from None
    finally:
        beside.unlink(missing_ok=True)


def write_radiance(path: str | Path, radiance: NDArray[np.floating]) -> None:
    """Write radiance as it is, OpenEXR (32-bit floats) or Radiance RGBE by suffix, whole or not at all.

    Parameters
    ----------
    path : path
    radiance : (h, w, 3) float
        Rows from the top; linear, with the primaries of sRGB. [W m-2 sr-1]

    Raises
    ------
    InputError
        If the shape is another, or the file cannot be written.
    """
    path = check_picture_path(path, radiance=True)
    if radiance.ndim != 3 or radiance.shape[2] != 3:
        raise InputError(f"radiance: found shape {radiance.shape}, expected (h, w, 3)")
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        if path.suffix.lower() == ".exr":
            import OpenEXR

            channels = {"RGB": np.ascontiguousarray(radiance, dtype=np.float32)}
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            OpenEXR.File(header, channels).write(str(beside))
        else:
            height, width = radiance.shape[:2]
            head = f"#?RADIANCE\nSOFTWARE=radiosity-workbench\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n"
            beside.write_bytes(head.encode() + _rgbe(radiance).tobytes())
        beside.replace(path)
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be written ({reason}); choose another place") from None
    finally:
        beside.unlink(missing_ok=True)


def _rgbe(radiance: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Pixels (h, w, 4) with a shared exponent, not run-length coded.

    Source: G. Ward, "Real pixels" (Graphics Gems II, 1991).
    """
    values = np.maximum(np.asarray(radiance, dtype=np.float64), 0.0)
    most = values.max(axis=2)
    exponent = np.frexp(most)[1]
    shown = (most > 1e-32) & (exponent + 128 > 0)
    scale = np.where(shown, np.ldexp(256.0, -exponent), 0.0)
    out = np.empty((*most.shape, 4), dtype=np.uint8)
    out[..., :3] = np.minimum(values * scale[..., None], 255.0).astype(np.uint8)
    out[..., 3] = np.where(shown, exponent + 128, 0)
    return out
