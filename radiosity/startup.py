"""What makes short commands start sooner.

Only the standard library is imported at the top.
"""

from __future__ import annotations

import sys

__all__ = ["load_numba"]

_BLAS = "scipy.linalg.cython_blas"


def load_numba() -> None:
    """Import numba without scipy, for processes of our own: a tenth of a second less.

    numba looks for scipy's BLAS once, as it loads, so that kernels may multiply matrices.  No kernel here
    does.  scipy itself stays as it is for those who import it.
    """
    if "numba.np.arraymath" in sys.modules or _BLAS in sys.modules:
        return
    # None in its place is what Python knows as a module that cannot be imported.
    sys.modules[_BLAS] = None  # type: ignore[assignment]
    try:
        import numba.np.arraymath  # noqa: F401
    finally:
        del sys.modules[_BLAS]
