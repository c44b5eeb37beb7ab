"""A filter against what noise a gather leaves, through scikit-image (extra ``denoise``)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from workbench.errors import MissingLibraryError

__all__ = ["denoised", "require_denoiser"]

FAINTEST = 1e-4
"""Radiance, as a share of the mean, below which differences do not count."""


def require_denoiser() -> None:
    """Make sure that scikit-image is there.

    Raises
    ------
    MissingLibraryError
        If it is not; says what to install.
    """
    try:
        import skimage.restoration  # noqa: F401
    except ImportError:
        raise MissingLibraryError(
            "--denoise: found no scikit-image; run pip install 'radiosity-workbench[denoise]'"
        ) from None


def denoised(radiance: NDArray[np.floating]) -> NDArray[np.float64]:
    """Filter a picture by non-local means on the logarithm of its radiance, so that dark parts count.

    Source: A. Buades, B. Coll and J.-M. Morel, "A non-local algorithm for image denoising" (CVPR 2005).

    Parameters
    ----------
    radiance : (h, w, bands) float
        [W m-2 sr-1]
    """
    require_denoiser()
    from skimage.restoration import denoise_nl_means, estimate_sigma

    least = FAINTEST * max(float(radiance.mean()), 1e-300)
    shown = np.log(np.asarray(radiance, dtype=np.float64) + least)
    sigma = float(np.mean(estimate_sigma(shown, channel_axis=-1)))
    smooth = denoise_nl_means(
        shown, patch_size=5, patch_distance=6, h=0.8 * sigma, sigma=sigma, fast_mode=True, channel_axis=-1
    )
    return np.maximum(np.exp(smooth) - least, 0.0)
