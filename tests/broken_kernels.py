"""Deliberately broken kernels: a law whose test passes on them would be no law.

A kernel's source is changed in one place and run as plain Python, and so are the kernels that
call it; everything else stays compiled.
"""

from __future__ import annotations

import inspect
import textwrap
from types import ModuleType

from workbench.accel import _intersect, brute, voxel_grid
from workbench.shadow import occlusion, silhouette, woo

_LINES = [(silhouette, "line_tiles"), (occlusion, "line_tiles")]
_CALLERS = {
    (silhouette, "_cross"): [(silhouette, "_look"), *_LINES],
    (silhouette, "_face"): [(silhouette, "_look"), *_LINES],
    (silhouette, "_inside"): _LINES,
    (silhouette, "_loose_ring"): [(silhouette, "_look"), *_LINES],
    (silhouette, "_reaches"): [(silhouette, "_look"), *_LINES],
    (silhouette, "_blurred"): _LINES,
    (silhouette, "_misses"): [(silhouette, "_tile_edges"), (silhouette, "_narrow"), *_LINES],
    (voxel_grid, "_outside_a_plane"): [(voxel_grid, "walk"), (woo, "walk"), (woo, "_shoot"), (woo, "_light_loop")],
    (voxel_grid, "walk"): [(voxel_grid, "walk"), (voxel_grid, "_trace")],
    (voxel_grid, "_trace"): [],
    (woo, "_light_planes"): [(woo, "_light_loop"), (woo, "_adaptive_loop")],
    (woo, "_light_loop"): [],
    (woo, "_adaptive_loop"): [],
    (_intersect, "_piece_crossing"): [(_intersect, "object_crossing"), (brute, "object_crossing")]
    + [(brute, "_trace"), (brute, "_transmit")],
}


def break_kernel(monkeypatch, module: ModuleType, name: str, old: str, new: str) -> None:
    """Replace ``old``, which must occur once, by ``new`` in a kernel for the rest of the test."""
    kernel = getattr(module, name)
    source = textwrap.dedent(inspect.getsource(kernel.py_func))
    assert source.count(old) == 1, f"{name} no longer holds {old!r} once: bring the broken version up to date"
    source = source.replace(old, new).partition("def ")
    made: dict = {}
    exec(compile("def " + source[2], f"<broken {name}>", "exec"), module.__dict__, made)
    plain = [(place, caller, getattr(place, caller).py_func) for place, caller in _CALLERS[module, name]]
    for place, caller, function in plain:
        monkeypatch.setattr(place, caller, function)
    monkeypatch.setattr(module, name, made[name])
    if (module, name) == (voxel_grid, "walk"):
        monkeypatch.setattr(woo, "walk", made[name])
