"""Counts of the work done: rays, tests, checks and culls.

Counts travel between machines where seconds do not, so every part of the workbench adds to a
:class:`Counters` and every record prints one.  A name must be listed in :data:`MEANINGS`; a
misspelt one is an error, not a new counter.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

__all__ = ["MEANINGS", "Counters"]

MEANINGS: dict[str, str] = {
    "rays": "rays traced, of all kinds",
    "rays_hit": "rays that met a surface",
    "box_tests": "tests against a bounding box of a tree or a group",
    "bounding_sphere_tests": "tests against the bounding sphere of a group",
    "polygon_tests": "ray-polygon or ray-triangle intersection tests",
    "sphere_tests": "ray-sphere intersection tests",
    "voxels_stepped": "voxels visited by grid walks",
    "mailbox_skips": "tests skipped because the polygon's rayID was the current ray's",
    "plane_vertex_checks": "polygons checked against the planes of a light or bundle",
    "plane_vertex_culls": "polygons that the plane-vertex check set aside",
    "tests_avoided": "intersection tests that a plane-vertex cull made unnecessary",
    "any_hit_tests_saved": "intersection tests that a nearest-hit search of the same rays would have added",
    "shaft_tests": "boxes or polygons tested against a shaft",
    "shaft_culls": "boxes or polygons outside a shaft",
    "shafts": "shafts built",
    "shafts_empty": "shafts without a candidate: the whole group sees the sender",
    "horizon_culls": "point-sender pairs settled by facing or horizon alone",
    "not_inshadow": "point-sender pairs found NOT_INSHADOW without rays",
    "inshadow": "point-sender pairs found INSHADOW without rays",
    "complex_shadow": "point-sender pairs left COMPLEX_SHADOW",
    "closed_forms": "evaluations of Lambert's formula or of a closed form factor",
    "exact_cuts": "point-sender pairs cut exactly by their candidates' edges",
    "exact_pieces": "visible pieces that the exact cuts left",
    "exact_overflows": "exact cuts given up for rays because too many pieces appeared",
    "silhouette_edges": "edges projected from a point onto a sender, to see where its layers of occluders change",
    "sender_lines": "lines over a sender, each cut by the silhouettes before it",
    "fitted_points": "point-sender pairs whose visible share is a fit to those of their neighbours",
    "camera_renders": "pictures drawn by hardware cameras, one a point and light",
    "camera_polygons": "polygons drawn into the pictures of hardware cameras and hemicubes",
    "camera_fallbacks": "point-sender pairs that no camera sees well, left to another method",
    "cast_rays": "rays from the eye",
    "cast_rays_hit": "rays from the eye, shot or settled, that met a surface",
    "shadow_rays": "rays toward lights",
    "reflection_rays": "reflected rays",
    "refraction_rays": "refracted rays",
    "cast_rays_saved": "rays from the eye settled by the polygon that a pixel's corners share",
    "shadow_rays_saved": "shadow rays not shot because a pixel's corners agree",
    "reflection_rays_saved": "reflected rays replaced by interpolation between a pixel's corners",
    "refraction_rays_saved": "refracted rays replaced by interpolation between a pixel's corners",
    "shots": "patches shot",
    "bundles": "directional bundles of rays shot from patches",
    "links": "sender-receiver pairs given a form factor",
}
"""Every counter's name and what it counts."""


class Counters(Mapping[str, int]):
    """Named integer counts, all zero to begin with.

    >>> counts = Counters()
    >>> counts.add(rays=3, rays_hit=1)
    >>> counts["rays"]
    3
    """

    def __init__(self, **counts: int) -> None:
        self._counts: dict[str, int] = {}
        self.add(**counts)

    def add(self, **counts: int) -> None:
        """Add to the named counters; an unknown name raises ``KeyError``."""
        for name, count in counts.items():
            if name not in MEANINGS:
                raise KeyError(f"no counter is called {name!r}; see workbench.counters.MEANINGS")
            self._counts[name] = self._counts.get(name, 0) + int(count)

    def merge(self, other: Mapping[str, int]) -> None:
        """Add every count of ``other``."""
        self.add(**dict(other))

    def __getitem__(self, name: str) -> int:
        if name not in MEANINGS:
            raise KeyError(name)
        return self._counts.get(name, 0)

    def __iter__(self) -> Iterator[str]:
        return (name for name in MEANINGS if name in self._counts)

    def __len__(self) -> int:
        return len(self._counts)

    def __repr__(self) -> str:
        return f"Counters({', '.join(f'{k}={v}' for k, v in self.items())})"
