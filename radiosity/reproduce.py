"""Experiments of the papers, run again by ``radiosity reproduce NAME``.

A reproduction is a function of ``quick`` that returns a
:class:`~workbench.study.result.StudyResult`; a new one is one function here and one line in
:data:`REPRODUCTIONS`.  Each imports what it needs when it is called.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from workbench.study.result import StudyResult

__all__ = ["REPRODUCTIONS", "camera_table_1", "woo_corner_samples", "woo_radiosity_bundles", "woo_table_1", "woo_tori"]


def woo_tori(quick: bool) -> StudyResult:
    """Woo's tori: the plane-vertex check on soft shadows by K = 8 and by 3 to 17 rays."""
    from workbench.study.tori import tori_study

    return tori_study(width=160, height=120) if quick else tori_study()


def woo_corner_samples(quick: bool) -> StudyResult:
    """Woo's cast rays of pixel corners, row by row, with the plane-vertex check of each row."""
    from workbench.study.corner_samples import corner_study

    return corner_study(width=160, height=120) if quick else corner_study()


def woo_table_1(quick: bool) -> StudyResult:
    """Woo's Table 1: aliased, adaptive and atomic adaptive pictures, seconds and rays saved."""
    from workbench.study.atomic_table import atomic_study

    return atomic_study(width=120, height=90, repeats=1) if quick else atomic_study()


def camera_table_1(quick: bool) -> StudyResult:
    """Table 1 of the hardware-camera paper: shadow rays against cameras, seconds and error."""
    from workbench.study.camera_table import camera_study

    return camera_study(width=24, height=18) if quick else camera_study()


def woo_radiosity_bundles(quick: bool) -> StudyResult:
    """Woo's proposal for radiosity: directional bundles from patches, each with the plane-vertex check."""
    from radiosity.report.directional_bundles import bundles_study

    return bundles_study(patches=4, total=2048, repeats=1) if quick else bundles_study()


REPRODUCTIONS: dict[str, Callable[[bool], StudyResult]] = {
    "camera-table-1": camera_table_1,
    "woo-corner-samples": woo_corner_samples,
    "woo-radiosity-bundles": woo_radiosity_bundles,
    "woo-table-1": woo_table_1,
    "woo-tori": woo_tori,
}
"""By the names of the command line."""
