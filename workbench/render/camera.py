"""Pinhole rays: from a place on the picture to a direction in the world."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.arrays import as_points
from workbench.errors import InputError, OptionError
from workbench.scene.model import Camera

__all__ = ["PinholeRays"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class PinholeRays:
    """All the rays of a pinhole camera with square pixels.

    The direction through the point (x, y) of the picture, x to the right and y downward in pixels
    from its upper left corner, is ``corner + x * right + y * down``, made unit length.

    Parameters
    ----------
    eye : (3,) float
    corner, right, down : (3,) float
        [scene lengths at distance 1 along the view axis]
    width, height : int
        [pixels]
    """

    eye: FloatArray
    corner: FloatArray
    right: FloatArray
    down: FloatArray
    width: int
    height: int

    @classmethod
    def from_matrix(cls, world_to_eye: ArrayLike, fov_deg: float, width: int, height: int) -> PinholeRays:
        """Rays of a camera that looks down -z in eye space, +y up.

        Parameters
        ----------
        world_to_eye : (4, 4) float
            Affine; its last row is 0 0 0 1.
        fov_deg : float
            Full vertical angle. [degrees]
        width, height : int
            [pixels]

        Raises
        ------
        InputError
            If the matrix has no inverse or is not affine, the angle is not in 0..180 or a side is
            not positive.
        """
        matrix = np.asarray(world_to_eye, dtype=np.float64)
        if matrix.shape != (4, 4) or not (matrix[3] == (0, 0, 0, 1)).all():
            raise InputError("world_to_eye: expected a (4, 4) matrix whose last row is 0 0 0 1")
        if not 0 < fov_deg < 180:
            raise OptionError(f"fov_deg: found {fov_deg}, expected an angle between 0 and 180 degrees")
        if width < 1 or height < 1:
            raise OptionError(f"size: found {width} x {height}, expected 1 pixel or more each way")
        try:
            to_world = np.linalg.inv(matrix[:3, :3])
        except np.linalg.LinAlgError:
            raise InputError("world_to_eye: found a matrix without an inverse, expected one with") from None
        pixel = 2 * math.tan(math.radians(fov_deg) / 2) / height
        return cls(
            eye=-to_world @ matrix[:3, 3],
            corner=to_world @ np.asarray([-0.5 * width * pixel, 0.5 * height * pixel, -1.0]),
            right=to_world @ np.asarray([pixel, 0.0, 0.0]),
            down=to_world @ np.asarray([0.0, -pixel, 0.0]),
            width=width,
            height=height,
        )

    @classmethod
    def from_camera(cls, camera: Camera) -> PinholeRays:
        """Rays of a scene's camera.

        Raises
        ------
        InputError
            If eye, look-at point and up vector lie on one line, or as :meth:`from_matrix`.
        """
        eye, look_at, up = (as_points(getattr(camera, n), n)[0] for n in ("eye", "look_at", "up"))
        back = eye - look_at
        across = np.cross(up, back)
        if not np.linalg.norm(across) > 1e-9 * np.linalg.norm(up) * np.linalg.norm(back):
            raise InputError("camera: found eye, look_at and up on one line, expected an up vector across the view")
        back /= np.linalg.norm(back)
        across /= np.linalg.norm(across)
        matrix = np.eye(4)
        matrix[:3, :3] = across, np.cross(back, across), back
        matrix[:3, 3] = -matrix[:3, :3] @ eye
        return cls.from_matrix(matrix, camera.fov_deg, camera.width, camera.height)

    def directions(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Unit directions (n, 3) through points of the picture.

        Parameters
        ----------
        x, y : (n,) float
            Column and row; the centre of the upper left pixel is (0.5, 0.5). [pixels]
        """
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        along = self.corner + x.reshape(-1, 1) * self.right + y.reshape(-1, 1) * self.down
        return along / np.linalg.norm(along, axis=1)[:, None]

    def row_directions(self, first: int, end: int) -> FloatArray:
        """Unit directions ((end - first) * width, 3) through the pixel centres of rows ``first..end - 1``."""
        y, x = np.meshgrid(np.arange(first, end) + 0.5, np.arange(self.width) + 0.5, indexing="ij")
        return self.directions(x.ravel(), y.ravel())
