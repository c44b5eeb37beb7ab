"""Pictures: radiance to bytes, bytes to files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from workbench.errors import InputError, OptionError

__all__ = ["PICTURE_SUFFIXES", "check_picture_path", "to_bytes", "write_picture"]

PICTURE_SUFFIXES = {".tiff": "TIFF", ".tif": "TIFF", ".png": "PNG"}
"""File suffixes that can be written, and their formats."""


def to_bytes(radiance: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Pixel values 255 * radiance, rounded to the nearest whole number and pegged at 0 and 255."""
    return np.floor(np.clip(255.0 * radiance, 0.0, 255.0) + 0.5).astype(np.uint8)


def check_picture_path(path: str | Path) -> Path:
    """The path, if a picture can be written there.

    Raises
    ------
    OptionError
        If the suffix is unknown, the folder does not exist or the path is a folder.
    """
    path = Path(path)
    if path.suffix.lower() not in PICTURE_SUFFIXES:
        raise OptionError(f"{path}: found the suffix {path.suffix!r}, expected {', '.join(PICTURE_SUFFIXES)}")
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
