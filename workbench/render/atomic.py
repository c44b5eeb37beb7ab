"""Atomic adaptive sampling: what the corners of a pixel know spares work inside it.

Source: A. Woo, "Efficient Shadow Computations in Ray Tracing" (IEEE CG&A 13(5), 1993), "Atomic
adaptive sampling" and "Other uses of atomic adaptive sampling".

Each corner sample leaves a :class:`RayTrees` record: the *surface* met (not the tessellated
polygon), one state a light, the radiance that came along the reflected and the refracted ray.
A sample inside the pixel whose ray meets the same surface as all four corners may then assume

* **shadows**: for each light, the corners' state, if all four say Inshadow or all four say
  Not_Inshadow; Complex_Shadow (a penumbra, a transparent occluder) is never assumed;
* **cast**: that it meets the polygon that all four corners met, if it crosses that polygon;
* **reflection**, **refraction**: the bilinear interpolation of the corners' radiances, if these
  are similar, without any ray below.

The published method records the top of each ray tree only; with ``whole_tree`` every node down to
the depth limit is recorded and used, as the paper wishes for ("with more available memory").

What it cannot know: a feature that lies between agreeing corners.  A shadow or a surface smaller
than the pixel pitch can be missed, as adaptive sampling itself misses it at the first level; a
shadow of side ``w`` pixels, placed at random, hides between four corners with chance ``(1 - w)^2``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from workbench.errors import OptionError
from workbench.render import _trace_kernels as kernels

__all__ = ["COMPONENTS", "AtomicOptions", "Guide", "RayTrees"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

COMPONENTS = ("shadows", "cast", "reflection", "refraction")
"""What can be assumed, each on its own."""

NO_SURFACE = -1
"""Surface of a ray that met nothing."""
NOT_TRACED = -2
"""Surface of a node of the ray tree to which no ray went."""
DISAGREE = -3
"""Surface of a node over which a pixel's corners disagree."""


@dataclass(frozen=True)
class AtomicOptions:
    """What to assume, and how careful to be.

    Parameters
    ----------
    components : tuple of str
        Some of :data:`COMPONENTS`.
    whole_tree : bool
        Record and use every node of the ray tree; otherwise the top level, as published.
    similar : float
        Largest difference, in picture units (radiance times specular or transmittance), between
        the corners' reflected (or refracted) radiances that may be interpolated.
    normal_angle_deg : float, optional
        Woo's additional criterion: assume nothing where the normal differs from a corner's, or
        corners' from each other's, by more than this. [degrees]

    Raises
    ------
    OptionError
        If a component is unknown or a number is out of its range.
    """

    components: tuple[str, ...] = COMPONENTS
    whole_tree: bool = False
    similar: float = 0.06
    normal_angle_deg: float | None = None

    def __post_init__(self) -> None:
        unknown = [name for name in self.components if name not in COMPONENTS]
        if unknown:
            raise OptionError(f"atomic: found {unknown[0]!r}, expected some of {', '.join(COMPONENTS)}")
        if not self.similar >= 0.0:
            raise OptionError(f"similar: found {self.similar}, expected 0 or more")
        if self.normal_angle_deg is not None and not 0.0 < self.normal_angle_deg <= 180.0:
            raise OptionError(f"normal_angle_deg: found {self.normal_angle_deg}, expected more than 0, at most 180")


@dataclass
class RayTrees:
    """What samples found, a row a sample and a column a node of the ray tree.

    Node 0 is the cast ray; node ``k`` has the reflected ray ``2 k + 1`` and the refracted ray
    ``2 k + 2`` (a binary heap, the fixed stack of the paper), or in a scene without anything
    transparent only the reflected ray ``k + 1``.

    Parameters
    ----------
    polygon : (n,) int32
        Polygon met by the cast ray, -1 for none.
    surface : (n, nodes) int32
        Surface met; NO_SURFACE, or NOT_TRACED.
    state : (n, nodes, lights) uint8
        NOT_INSHADOW, INSHADOW or COMPLEX_SHADOW.
    reflected, refracted : (n, nodes, bands) float32
        Radiance along the ray below; NaN where none was shot.
    normal : (n, nodes, 3) float32 or None
        Shading normals, kept only for the criterion of normals.
    """

    polygon: NDArray[np.int32]
    surface: NDArray[np.int32]
    state: NDArray[np.uint8]
    reflected: NDArray[np.float32]
    refracted: NDArray[np.float32]
    normal: NDArray[np.float32] | None

    @property
    def nodes(self) -> int:
        """Nodes recorded of each ray tree."""
        return self.surface.shape[1]

    @classmethod
    def empty(cls, count: int, nodes: int, lights: int, bands: int, normals: bool) -> RayTrees:
        """Room for ``count`` samples, nothing recorded yet."""
        return cls(
            polygon=np.full(count, NO_SURFACE, dtype=np.int32),
            surface=np.full((count, nodes), NOT_TRACED, dtype=np.int32),
            state=np.full((count, nodes, lights), kernels.COMPLEX_SHADOW, dtype=np.uint8),
            reflected=np.full((count, nodes, bands), np.nan, dtype=np.float32),
            refracted=np.full((count, nodes, bands), np.nan, dtype=np.float32),
            normal=np.zeros((count, nodes, 3), dtype=np.float32) if normals else None,
        )

    def rows(self, rows: slice | IntArray) -> RayTrees:
        """Some of the samples; a slice shares the memory."""
        return RayTrees(
            self.polygon[rows],
            self.surface[rows],
            self.state[rows],
            self.reflected[rows],
            self.refracted[rows],
            None if self.normal is None else self.normal[rows],
        )

    def put(self, rows: slice | IntArray, other: RayTrees) -> None:
        """Write the samples of ``other`` into ``rows``."""
        self.polygon[rows] = other.polygon
        self.surface[rows] = other.surface
        self.state[rows] = other.state
        self.reflected[rows] = other.reflected
        self.refracted[rows] = other.refracted
        if self.normal is not None:
            self.normal[rows] = other.normal


@dataclass(frozen=True)
class Guide:
    """What the four corners of each pixel agree on, a row a pixel.

    Parameters
    ----------
    options : AtomicOptions
    trees : RayTrees
        The corners' records.
    corners : (p, 4) int
        Rows of ``trees``: upper left, upper right, lower left, lower right.
    polygon : (p,) int32
        Polygon that all four met, or -1.
    surface : (p, nodes) int32
        Surface that all four met, NO_SURFACE included, or DISAGREE.
    state : (p, nodes, lights) uint8
        State that all four found, or COMPLEX_SHADOW.
    reflection_spread, refraction_spread : (p, nodes) float32
        Largest difference between the corners' radiances; NaN where one is missing.
    normal : (p, nodes, 4, 3) float32
        The corners' normals; empty without the criterion of normals.
    """

    options: AtomicOptions
    trees: RayTrees
    corners: IntArray
    polygon: NDArray[np.int32]
    surface: NDArray[np.int32]
    state: NDArray[np.uint8]
    reflection_spread: NDArray[np.float32]
    refraction_spread: NDArray[np.float32]
    normal: NDArray[np.float32]

    @property
    def cosine(self) -> float:
        """Least cosine between normals that agree; a little less for those of float32."""
        angle = self.options.normal_angle_deg
        return -2.0 if angle is None else float(np.cos(np.radians(angle))) - 1e-6

    @classmethod
    def from_corners(cls, trees: RayTrees, corners: IntArray, options: AtomicOptions) -> Guide:
        """Agreement of pixels whose corners are the rows ``corners`` (p, 4) of ``trees``."""
        pixels, (_, nodes, lights) = len(corners), trees.state.shape
        surface = np.empty((pixels, nodes), dtype=np.int32)
        state = np.empty((pixels, nodes, lights), dtype=np.uint8)
        polygon = np.empty(pixels, dtype=np.int32)
        spread = np.empty((2, pixels, nodes), dtype=np.float32)
        kernels.agree_of_corners(
            trees.surface, trees.state, trees.reflected, trees.refracted, trees.polygon, corners,
            surface, state, polygon, spread,
        )  # fmt: skip
        normal = np.empty((0, nodes, 4, 3), dtype=np.float32)
        guide = cls(options, trees, corners, polygon, surface, state, spread[0], spread[1], normal)
        if trees.normal is not None and options.normal_angle_deg is not None:
            normal = np.ascontiguousarray(trees.normal[corners].transpose(0, 2, 1, 3))
            alike = np.einsum("pnci,pndi->pncd", normal, normal).min(axis=(2, 3))
            surface[(alike < guide.cosine) & (surface >= 0)] = DISAGREE
            guide = replace(guide, normal=normal)
        polygon[surface[:, 0] == DISAGREE] = NO_SURFACE
        use = options.components
        if "shadows" not in use:
            state[:] = kernels.COMPLEX_SHADOW
        if "cast" not in use:
            polygon[:] = NO_SURFACE
        if "reflection" not in use:
            guide.reflection_spread[:] = np.nan
        if "refraction" not in use:
            guide.refraction_spread[:] = np.nan
        return guide
