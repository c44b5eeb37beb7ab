"""Hierarchical radiosity: links at the coarsest level that the wanted error allows.

P. Hanrahan, D. Salzman and L. Aupperle, "A rapid hierarchical radiosity algorithm" (SIGGRAPH 1991),
with clusters above the surfaces (B. Smits, J. Arvo and D. Greenberg, SIGGRAPH 1994).  What departs
from them:

* pairs are refined in whole frontiers of flat arrays, over threads, never link by link;
* links are made as power arrives: a pair of nodes that are both dark stays where it is, at whatever
  level, until one of them has something to send;
* the occlusion state and the candidates of a shaft go down with the pairs: a part of a clear pair is
  clear, and a part of any other chooses its candidates among the whole's;
* a link keeps the exchange area of both directions, so reciprocity is exact; in a scene declared
  closed the rows are balanced to sum to 1 without breaking it;
* over each end of a link the form factor has a slope and a bend, as in Galerkin radiosity (H. Zatz, SIGGRAPH 1993),
  whose moments are pulled and pushed with the means: the product of two means misses light where both are large,
  which made rooms half a per cent too dark;
* light is exchanged by the bare parts of what is covered, and row sums above 1 are levelled with their
  neighbours' in open scenes: cutting them alone would lose light;
* a pair whose sender is uneven is split sooner, for what its shapes miss;
* what a link may be off is weighed by its receiver's share of all area, so that the sum of squares
  over all links estimates the mean square error: shadow edges end by themselves;
* the equations are solved by conjugate gradients over push and pull, which near reflectance 1 needs
  tens of sweeps, not thousands.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radiosity.form_factors._links import occluder_arrays, workspace
from radiosity.hierarchy import Hierarchy
from radiosity.patches import PatchMesh
from radiosity.solvers._pairs import (
    CLEAR,
    CUT,
    DROPPED,
    KEPT,
    PART_OF_CLEAR,
    PART_OF_CUT,
    RAYS,
    UNSEEN,
    apply_rays,
    finish,
    judge,
    link_errors,
    measure,
    pair_rays,
    tolerances,
)
from radiosity.solvers._push_pull import (
    deviations,
    expand,
    form_factors,
    gather,
    level,
    pull,
    pull_moments,
    push,
    push_shapes,
    sort_links,
    spreads,
    total,
)
from radiosity.solvers.incident import cosine_directions, incident_irradiance, incident_spread, points_of_elements
from radiosity.solvers.progressive import CHECKPOINT_SECONDS, CHECKPOINT_SHARE, remaining_bound
from radiosity.solvers.solution import Checkpoint, EnergyBook, Progress, ProgressEvent, Solution
from workbench.accel.box_tree import BoxTree
from workbench.accel.embree import BLOCK_RAYS, EmbreeAccelerator
from workbench.arrays import as_count, as_positive
from workbench.counters import Counters
from workbench.culling.tally import add_tally, new_tally
from workbench.errors import InputError, OptionError
from workbench.geometry.flat import Geometry
from workbench.memory import require_memory
from workbench.record import RunRecord
from workbench.scene.model import Scene
from workbench.shadow.occlusion import Shader
from workbench.shadow.sky import SkyLight

__all__ = ["solve_hierarchical"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

BLOCK = 2048
"""Pairs a task: fixed, so that nothing depends on the number of workers."""
ROWS = 16384
"""Receiving nodes a task of a sweep."""
FIRST_RAYS, MOST_RAYS = 16, 256
"""Rays a pair that only rays can settle, at first and at most."""
CUT_LIMIT = 12
"""Most candidates in the pyramid of one point that are cut exactly."""
CUT_LEVELS = 3
"""Halvings of a kept receiver in search of shadow boundaries, for its mean."""
FINISHED = 0.5
"""Share of the link error that the exchange area itself may be off."""
FALL = 0.4
"""Power of the link error with which the sums of errors fall (seen on rooms)."""
BETWEEN = 0.5
GATHERED = 0.15
"""What a receiver's detail counts where points gather for themselves: light that its elements get wrong among
them, and detail within one element, which only nearby points see at all (both measured on rooms)."""
COARSER = (16.0, 16.0, 4.0, 1.0)
"""Link errors of the rounds in units of the last: emitters first, then with what they lit, then finer."""
EXACT_ELEMENTS, EXACT = 12, 1e-8
"""Up to this many elements, if no more may be made, form factors are found to this error: a second at most."""
LEAST_SPLIT = 3
"""Elements that a quad or triangle becomes more when it is split."""
ELEMENTS_FALL = 0.8
"""Power of the number of elements with which the link error falls (seen on rooms)."""
FIRST_ERROR, LAST_ERROR = 1e-2, 1e-7
"""Link errors between which a wanted number of elements is sought."""
BETWEEN_ROUNDS, ROWS_OFF = 1e-3, 1e-11
"""What balanced row sums may be off while links are still refined, and at the end."""
LEAST_LOOSE, LOOSE_ROUNDS = 0.02, 10
"""Least share of a link that row balancing may scale, and rounds before everything is scaled."""
COVER_RAYS = (1, 6)
"""Rays from each point that tell whether it is covered: of all elements, and of doubtful ones at twice the points."""
LEAST_COVER_POINTS, MOST_COVER_POINTS, ALL_COVER_POINTS = 8, 256, 2**14
"""Points of an element, and of all surfaces: few points of few elements made the bare area of a room 1 % too large."""
PAIR_BYTES = 220
"""Memory that a new pair takes while it is measured, and as a link with both its directions."""
OUTSIDE = 3.0
"""What the light from outside may be off, over the link error, of which a solve leaves some tens; or over 1 / n."""
SMALLEST = 2.0**-14
"""Shortest edge that is split by default, as a share of the scene's size."""


_NODE_VALUES = ("bright", "received", "uneven", "detail", "bias", "whole")
"""Arrays (nodes,) that one round leaves for the next."""


@dataclass
class _Links:
    """Pairs of nodes as flat arrays; see :mod:`radiosity.solvers._pairs`."""

    a: NDArray[np.int32]
    b: NDArray[np.int32]
    state: NDArray[np.int8]
    offset: IntArray
    count: NDArray[np.int32]
    exchange: FloatArray
    vary_a: NDArray[np.float32]
    vary_b: NDArray[np.float32]
    bend_a: NDArray[np.float32]
    bend_b: NDArray[np.float32]
    doubt: NDArray[np.float32]
    shape_a: NDArray[np.float32]
    shape_b: NDArray[np.float32]

    @classmethod
    def unseen(cls, a: NDArray, b: NDArray) -> _Links:
        n = len(a)
        return cls(
            a.astype(np.int32),
            b.astype(np.int32),
            np.full(n, UNSEEN, dtype=np.int8),
            np.zeros(n, dtype=np.int64),
            np.full(n, -1, dtype=np.int32),
            np.zeros(n),
            *(np.zeros(n, dtype=np.float32) for _ in range(5)),
            *(np.zeros((n, 4), dtype=np.float32) for _ in range(2)),
        )

    def __len__(self) -> int:
        return len(self.a)

    def take(self, which: NDArray) -> _Links:
        return _Links(*(getattr(self, f.name)[which] for f in fields(self)))

    @staticmethod
    def join(parts: list[_Links]) -> _Links:
        if len(parts) == 1:
            return parts[0]
        return _Links(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(_Links)))


class _Exchange:
    """The operator from radiosity of the leaves to their irradiance, over all links.

    Only the bare part of what is covered in part (the floor under a box) exchanges light: means over a node are
    weighed by the bare areas of its leaves, and what a link brings falls on the bare part of its end.

    Of each link a share is firm, and the rest, as much as its form factor varies over its ends, is loose:
    rows are balanced by scaling what is loose, so that the link from a lamp, which is known well, does
    not pay for a coarse one.
    """

    def __init__(
        self,
        tree: Hierarchy,
        leaves: IntArray,
        bare: FloatArray,
        links: _Links,
        pool: ThreadPoolExecutor,
        *,
        with_unseen: bool = False,
    ) -> None:
        self.tree, self.leaves, self.pool = tree, leaves, pool
        self.area = bare * tree.arrays.area[leaves]
        self.node_area = np.zeros(tree.node_count)
        self.node_area[leaves] = self.area
        total(self.node_area, tree.node_count, tree.arrays.opened, tree.arrays.child, tree.arrays.children)
        self.whole = self.node_area >= (1.0 - 1e-9) * tree.arrays.area[: tree.node_count]
        """Nodes without a covered part: shapes are about their middles."""
        self.scale = np.ones(len(self.leaves))
        self.loose_scale = np.ones(len(self.leaves))
        self.wanted: FloatArray | None = None
        self.balanced = np.zeros(len(leaves), dtype=bool)
        """Whether all that each row exchanges is known, so that it sums to 1."""
        self.links = links
        self.exchange = links.exchange if with_unseen else np.where(links.state > 0, links.exchange, 0.0)
        self.start = np.zeros(tree.node_count + 1, dtype=np.int64)
        directions = 2 * len(links) - int((links.a == links.b).sum())
        self.column, self.place = (np.empty(directions, dtype=np.int32) for _ in range(2))
        self.own, self.far = (np.empty((directions, 4), dtype=np.float32) for _ in range(2))
        sort_links(
            links.a, links.b, links.shape_a, links.shape_b, self.start, self.column, self.place, self.own, self.far
        )
        n, arrays = tree.node_count, tree.arrays
        self.shaped = self.whole & (arrays.opened[:n] == 1)
        self.spread = np.zeros(n)
        self.spread[leaves] = tree.spreads(leaves)
        spreads(self.spread, n, arrays.opened, arrays.child, arrays.children, arrays.area, arrays.centroid)
        self.firm = self._sorted(self.exchange)
        self.loose: FloatArray | None = None

    def _sorted(self, exchange: FloatArray) -> FloatArray:
        factor = np.empty(len(self.column))
        form_factors(exchange, self.node_area, self.start, self.place, factor)
        return factor

    def up(self, values: FloatArray) -> FloatArray:
        """Means of leaf values (n, bands) for all nodes."""
        arrays = self.tree.arrays
        nodes = np.zeros((self.tree.node_count, values.shape[1]))
        nodes[self.leaves] = values
        pull(nodes, self.tree.node_count, arrays.opened, arrays.child, arrays.children, self.node_area)
        return nodes

    def down(self, nodes: FloatArray) -> FloatArray:
        """Leaf sums (n, bands) of what all nodes received; ``nodes`` is used up."""
        arrays = self.tree.arrays
        push(nodes, self.tree.node_count, arrays.opened, arrays.child, arrays.children)
        return nodes[self.leaves]

    def _cross(self, factor: FloatArray, values: FloatArray, *, shapes: bool = False) -> FloatArray:
        """What ``values`` (n, bands) of the leaves bring to the leaves over links of these form factors.

        With ``shapes`` also how it falls over each leaf: (n, 5, bands), see :func:`push_shapes`.
        """
        arrays = self.tree.arrays
        tree = self.tree.node_count, arrays.opened, arrays.child, arrays.children
        nodes = np.zeros((self.tree.node_count, 5, values.shape[1]))
        nodes[self.leaves, 0] = values
        pull_moments(nodes, *tree, self.node_area, arrays.centroid, self.spread)
        received = np.empty_like(nodes)

        def rows(first: int) -> None:
            gather(
                first, min(first + ROWS, len(nodes)), self.start, self.column, factor, self.own, self.far,
                self.shaped, nodes, shapes, received,
            )  # fmt: skip

        list(self.pool.map(rows, range(0, len(nodes), ROWS)))
        push_shapes(received, *tree, arrays.centroid, self.spread)
        return received[self.leaves] if shapes else received[self.leaves, 0]

    def __call__(self, values: FloatArray) -> FloatArray:
        scaled = values * self.scale[:, None]
        received = self._cross(self.firm, scaled)
        if self.loose is not None:
            loose = self.loose_scale[:, None]
            received += loose * self._cross(self.loose, scaled * loose)
        return received * self.scale[:, None]

    def balance(self) -> None:
        """Scale rows and columns alike until the rows sum to about what is wanted.

        The symmetric scaling of :func:`radiosity.form_factors.matrix.close_rows`, first on what is loose; on
        everything where that does not do.
        """
        links, area = self.links, self.tree.arrays.area
        # How a form factor varies over an element does nothing to the element's row.
        off = np.array(links.doubt, dtype=np.float64)
        for end, bend in ((links.a, links.bend_a), (links.b, links.bend_b)):
            np.maximum(off, bend * area[end] * self.tree.arrays.opened[end], out=off)
        share = np.divide(off, self.exchange, out=np.ones_like(self.exchange), where=self.exchange > 0)
        share = np.clip(share, LEAST_LOOSE, 1.0)
        self.loose = self._sorted(self.exchange * share)
        self.firm = self._sorted(self.exchange * (1.0 - share))
        wanted, one = self.wanted, np.ones((len(self.area), 1))
        assert wanted is not None
        left = np.maximum(wanted - self._cross(self.firm, one)[:, 0], LEAST_LOOSE * wanted)
        for _ in range(LOOSE_ROUNDS):
            loose = self.loose_scale * self._cross(self.loose, self.loose_scale[:, None])[:, 0]
            self.loose_scale *= np.sqrt(np.divide(left, loose, out=np.ones_like(left), where=loose > 0))
        self.settle(BETWEEN_ROUNDS)

    def settle(self, limit: float) -> None:
        """Go on balancing until no row is off by more than ``limit``."""
        if self.loose is None or self.wanted is None:
            return
        one = np.ones((len(self.area), 1))
        for _ in range(100):
            sums = self(one)[:, 0]
            ratio = np.divide(self.wanted, sums, out=np.ones_like(sums), where=(sums > 0) & (self.wanted > 0))
            if np.abs(ratio - 1.0).max(initial=0.0) < limit:
                break
            self.scale *= np.sqrt(ratio)


class _Solver:
    """One hierarchical solve: the tree, its links, and the brightness that refines them."""

    def __init__(
        self,
        scene: Scene,
        geometry: Geometry,
        record: RunRecord,
        *,
        min_edge: float,
        direct_in_mesh: bool,
        relative: float,
        outside_error: float,
        workers: int,
        seed: int,
        max_elements: int | None,
    ) -> None:
        self.outside_error = outside_error
        self.scene, self.geometry, self.record = scene, geometry, record
        self.min_edge, self.direct_in_mesh, self.relative, self.seed = min_edge, direct_in_mesh, relative, seed
        self.max_elements = max_elements
        self.before = Counters(**record.counters)
        self.counters = Counters()
        self.pool = ThreadPoolExecutor(workers)
        self.workers = workers
        self.seconds_in_embree = 0.0
        with record.stage("tree"):
            self.tree = Hierarchy(scene, geometry)
            self.geo = occluder_arrays(geometry, BoxTree.build(geometry))
            self.accelerator = EmbreeAccelerator(geometry, workers=workers)
        self._bare = np.zeros(0)
        self.two_sided = np.asarray([m.two_sided for m in geometry.surface_material])[geometry.polygon_surface]
        sky = SkyLight.of_scene(scene) is not None
        self.lit_from_outside = sky or bool(scene.lights)
        self.shader = Shader(geometry) if sky else None
        self._outside = {name: np.zeros((0, scene.bands)) for name in ("mean", "spread")}
        materials = [surface.material for surface in scene.surfaces]
        self.rho = np.stack([m.reflectance for m in materials])
        self.emission = np.stack([m.emission for m in materials])
        longest = int(np.diff(geometry.piece_start).max(initial=4))
        self._idle = [workspace(max(longest, 4)) for _ in range(workers)]
        self.links = _Links.unseen(np.zeros(1, np.int32), np.zeros(1, np.int32))
        self.candidates = np.zeros(0, dtype=np.int32)
        self.total_area = float(self.tree.arrays.area[0])
        n = self.tree.node_count
        self.bright = np.zeros(n)
        self.received = np.zeros(n)
        self.uneven = np.zeros(n)
        self.detail = np.zeros(n)
        self.bias = np.zeros(n)
        self.whole = np.ones(n, dtype=bool)
        self._weigh()

    def close(self) -> None:
        self.pool.shutdown()

    # ---- stopping and going on -----------------------------------------------------------------

    def count(self) -> None:
        """Put all counts so far into the record."""
        self.record.counters = Counters()
        for part in (self.before, self.counters, self.accelerator.counters):
            self.record.counters.merge(part)

    def state(self, at: _Round) -> dict[str, NDArray]:
        """All that :meth:`restore` needs, as arrays by name."""
        tree, unit = self.tree, at.unit if at.unit is not None else np.zeros(0)
        arrays = {f.name: getattr(self.links, f.name) for f in fields(_Links)}
        arrays |= {name: getattr(self, name).copy() for name in _NODE_VALUES}
        return arrays | {
            "candidates": self.candidates,
            "tree_split": tree.split,
            "tree_opened": tree.arrays.opened[: tree.node_count].copy(),
            "round": np.array([at.done, at.error, *unit]),
            "bare": self._bare.copy(),
            **{f"outside_{name}": values.copy() for name, values in self._outside.items()},
        }

    def restore(self, earlier: Solution) -> _Round:
        """Go on from an earlier solution's state."""
        state, tree = earlier.refinement, self.tree
        assert state is not None
        try:
            split, opened = state["tree_split"], state["tree_opened"]
            room = tree.node_count + 4 * len(split)
            if len(opened) > room or (len(split) and not 0 <= split.min() <= split.max() < len(opened)):
                raise ValueError
            tree.restore(split, opened)
            self.links = _Links(*(state[f.name] for f in fields(_Links)))
            for name in _NODE_VALUES:
                setattr(self, name, state[name].copy())
            self.candidates, self._bare = state["candidates"], state["bare"]
            self._outside = {name: state[f"outside_{name}"] for name in self._outside}
            done, error, *unit = state["round"].tolist()
            self._weigh()
            # Solved to the end already, the mesh is that of the leaves.
            mesh, leaves = earlier.mesh, tree.leaves()
            same = (
                np.array_equal(mesh.element_area, tree.arrays.area[leaves])
                and np.array_equal(mesh.element_centroid, tree.arrays.centroid[leaves])
                and np.array_equal(mesh.reflectance, self.rho[tree.arrays.surface[leaves]])
                and np.array_equal(mesh.emission, self.emission[tree.arrays.surface[leaves]])
            )
        except (KeyError, ValueError, IndexError):
            same = False
        if not same:
            raise InputError(
                "resume: the saved solution has another mesh or other materials; give the same scene, or solve without"
                " resume"
            )
        self.before.merge(earlier.record.counters)
        self.record.seconds.update(earlier.record.seconds)
        return _Round(int(done), float(error), np.array(unit))

    @property
    def levels(self) -> int:
        """Halvings of a receiver in search of shadow boundaries."""
        if self.relative == 0.0:
            return CUT_LEVELS
        return 5 if self.relative >= 1e-3 else 7 if self.relative >= 1e-5 else 20

    # ---- what nodes are worth ------------------------------------------------------------------

    def _weigh(self) -> None:
        """Weights of all nodes as receivers, and whether each can be split."""
        arrays, n = self.tree.arrays, self.tree.node_count
        share = np.sqrt(arrays.area[:n] / self.total_area)
        self.plain = share
        self.weight = share
        if not self.direct_in_mesh:
            surface = arrays.surface[:n]
            reflected = np.where(surface >= 0, self.rho.max(axis=1)[np.maximum(surface, 0)], self.rho.max())
            # Detail between elements is light put in the wrong place; within one it is only not shown.
            self.weight = share * reflected * np.where(arrays.opened[:n] == 1, BETWEEN, GATHERED)
        self.shaped = self.whole & (arrays.opened[:n] == 1)
        self.can_split = (arrays.opened[:n] == 1) | (arrays.children[:n] > 0) | (arrays.size[:n] > 2.0 * self.min_edge)

    def _grown(self) -> None:
        """Let new nodes have what their parents have."""
        n, old = self.tree.node_count, len(self.bright)
        if n > old:
            # Nodes of a parent that is itself new have what the last old one above them has.
            parent = self.tree.arrays.parent[old:n].copy()
            while (new := np.flatnonzero(parent >= old)).size:
                parent[new] = self.tree.arrays.parent[parent[new]]
            self.bright = np.concatenate([self.bright, self.bright[parent]])
            self.received = np.concatenate([self.received, self.received[parent]])
            self.uneven = np.concatenate([self.uneven, np.zeros(n - old)])
            self.detail = np.concatenate([self.detail, self.detail[parent]])
            self.bias = np.concatenate([self.bias, self.bias[parent]])
            self.whole = np.concatenate([self.whole, self.whole[parent]])
        self._weigh()

    # ---- frontiers -----------------------------------------------------------------------------

    def _tasks(self, work: Callable[[int, int, Any, NDArray], None], count: int) -> None:
        """Run ``work(first, last, workspace, tally)`` over blocks of pairs."""

        def one(first: int) -> NDArray:
            tally = new_tally()
            scratch = self._idle.pop()
            try:
                work(first, min(first + BLOCK, count), scratch, tally)
            finally:
                self._idle.append(scratch)
            return tally

        for tally in self.pool.map(one, range(0, count, BLOCK)):
            add_tally(self.counters, tally)

    def _measure(self, pairs: _Links) -> FloatArray:
        """Measure unseen pairs, rays included; returns the unoccluded exchange areas."""
        narrowed: dict[int, NDArray[np.int32]] = {}
        counts = np.empty(len(pairs), dtype=np.int32)

        def work(first: int, last: int, scratch: Any, tally: NDArray) -> None:
            fresh = np.empty((last - first) * KEPT, dtype=np.int32)
            used = measure(
                first, last, pairs.a, pairs.b, pairs.state, pairs.offset, pairs.count, self.candidates, self.bright,
                self.tree.arrays, self.geo, CUT_LIMIT, pairs.exchange, pairs.vary_a, pairs.vary_b,
                pairs.bend_a, pairs.bend_b, pairs.shape_a, pairs.shape_b, pairs.doubt, counts, fresh, scratch, tally,
            )  # fmt: skip
            narrowed[first] = fresh[:used].copy()

        self._tasks(work, len(pairs))
        pool = [narrowed[first] for first in sorted(narrowed)]
        lengths = np.maximum(counts, 0).astype(np.int64)
        pairs.offset[:] = len(self.candidates) + np.cumsum(lengths) - lengths
        pairs.count[:] = counts
        self.candidates = np.concatenate([self.candidates, *pool])
        whole = pairs.exchange.copy()
        rays = np.flatnonzero(pairs.state >= RAYS)
        self._trace(pairs, rays, np.full(len(rays), FIRST_RAYS), whole)
        return whole

    def _trace(self, pairs: _Links, chosen: IntArray, counts: IntArray, whole: FloatArray) -> None:
        """Let rays find what the chosen pairs see of each other."""
        centre, scale = self.accelerator.frame

        def work(first: int, last: int, scratch: Any, tally: NDArray) -> None:
            block, many = chosen[first:last], counts[first:last]
            most = int(many.sum())
            starts = np.empty(len(block) + 1, dtype=np.int64)
            origins = np.empty((most, 3), dtype=np.float32)
            directions = np.empty_like(origins)
            weights = np.empty(most)
            used = pair_rays(
                block, many, pairs.a, pairs.b, self.seed, self.tree.arrays, self.accelerator.offset, centre, scale,
                starts, origins, directions, weights,
            )  # fmt: skip
            clock = time.perf_counter()
            blocked = self.accelerator.blocked_raw(origins[:used], directions[:used], np.ones(used, dtype=np.float32))
            self.seconds_in_embree += time.perf_counter() - clock
            apply_rays(
                block, many, pairs.a, pairs.b, whole[block], starts, weights, blocked, self.tree.arrays.area,
                self.tree.arrays.flat, pairs.exchange, pairs.vary_a, pairs.vary_b, pairs.bend_a, pairs.bend_b,
                pairs.doubt,
            )  # fmt: skip
            traced.append(used)

        traced: list[int] = []
        self._tasks(work, len(chosen))
        self.counters.add(rays=sum(traced))

    def _judge(self, pairs: _Links, error: float) -> tuple[NDArray[np.int8], FloatArray]:
        verdict, need = np.empty(len(pairs), dtype=np.int8), np.empty(len(pairs))
        judge(
            pairs.a, pairs.b, pairs.vary_a, pairs.vary_b, pairs.bend_a, pairs.bend_b, pairs.state,
            self.tree.arrays.area, self.tree.arrays.flat, self.tree.arrays.size, self.shaped, self.bright,
            self.uneven, self.received, self.detail, self.bias, self.weight, self.plain, self.can_split, error,
            verdict, need,
        )  # fmt: skip
        return verdict, need

    def _finish(self, pairs: _Links, kept: IntArray, whole: FloatArray | None, error: float) -> None:
        """Bring kept pairs to the accuracy that the link error asks for."""
        allowed = np.empty(len(kept))
        tolerances(
            kept, pairs.a, pairs.b, pairs.exchange, self.tree.arrays.area, self.bright, self.uneven, self.received,
            self.plain, self.relative, FINISHED * error, allowed,
        )  # fmt: skip

        def work(first: int, last: int, scratch: Any, tally: NDArray) -> None:
            finish(
                first, last, kept, allowed, pairs.a, pairs.b, pairs.state, pairs.offset, pairs.count, self.candidates,
                self.bright, self.tree.arrays, self.geo, CUT_LIMIT, self.levels, pairs.exchange, pairs.doubt, scratch,
                tally,
            )  # fmt: skip

        was = pairs.state[kept] >= RAYS
        self._tasks(work, len(kept))
        rays = pairs.state[kept] >= RAYS
        fresh = kept[rays & ~was]
        if whole is None:
            whole = pairs.exchange.copy()
            more = fresh
            counts = np.full(len(fresh), FIRST_RAYS)
        else:
            whole[fresh] = pairs.exchange[fresh]
            again = rays & was & (pairs.doubt[kept] > allowed)
            ratio = np.minimum(pairs.doubt[kept][again] / np.maximum(allowed[again], 1e-300), float(MOST_RAYS))
            more = np.concatenate([fresh, kept[again]])
            # Noise falls with the root of the rays.
            wanted = np.concatenate([np.full(len(fresh), 4.0 * FIRST_RAYS), FIRST_RAYS * ratio**2])
            counts = np.clip(wanted, FIRST_RAYS, MOST_RAYS).astype(np.int64)
        self._trace(pairs, more, counts, whole)

    def _split(self, pairs: _Links, verdict: NDArray[np.int8], need: FloatArray) -> tuple[_Links, NDArray[np.bool_]]:
        """Parts of the pairs with a verdict, and the pairs that no room was left to split."""
        arrays = self.tree.arrays
        chosen = np.flatnonzero(verdict)
        ends = np.where(verdict == 1, pairs.a, pairs.b)[chosen]
        refused = np.zeros(len(pairs), dtype=bool)
        closed = arrays.opened[ends] == 0
        nodes, place = np.unique(ends[closed].astype(np.int64), return_inverse=True)
        if self.max_elements is not None and len(nodes):
            # Where elements are counted, those with the largest need come first.
            largest = np.zeros(len(nodes))
            np.maximum.at(largest, place, need[chosen[closed]])
            order = np.argsort(-largest, kind="stable")
            allowed = np.zeros(len(nodes), dtype=bool)
            allowed[order] = self.tree.open_balanced(nodes[order], self.max_elements - self.tree.leaf_count)
            refused[chosen[closed]] = ~allowed[place]
        else:
            self.tree.open_balanced(nodes)
        self._grown()
        arrays = self.tree.arrays
        chosen = np.flatnonzero((verdict > 0) & ~refused)
        ends = np.where(verdict == 1, pairs.a, pairs.b)[chosen]
        parts = arrays.children[ends]
        itself = pairs.a[chosen] == pairs.b[chosen]
        most = int(np.where(itself, parts * (parts + 1) // 2, parts).sum())
        require_memory(
            float(most * PAIR_BYTES), f"{most:.3g} more links", "ask for a larger link error or fewer elements"
        )
        a, b, parent = (np.empty(most, dtype=np.int32) for _ in range(3))
        used = expand(chosen, verdict, pairs.a, pairs.b, arrays.children, arrays.child, a, b, parent)
        made = _Links.unseen(a[:used], b[:used])
        came = parent[:used]
        # A flat node does not see itself.
        real = (made.a != made.b) | (arrays.flat[made.a] == 0)
        if not real.all():
            made, came = made.take(real), came[real]
        # Of a clear pair all parts are clear; of any other they choose among its candidates.
        known = pairs.state[came]
        made.state[known == CLEAR], made.state[known == CUT] = PART_OF_CLEAR, PART_OF_CUT
        for name in ("vary_a", "vary_b", "bend_a", "bend_b"):
            getattr(made, name)[:] = getattr(pairs, name)[came]
        made.offset[:], made.count[:] = pairs.offset[came], pairs.count[came]
        # Until it is measured a part has its share of the whole.
        split = np.where(verdict[came] == 1, pairs.a[came], pairs.b[came])
        part = np.where(arrays.parent[made.a] == split, made.a, made.b)
        made.exchange[:] = pairs.exchange[came] * arrays.area[part] / arrays.area[split]
        return made, refused

    def refine(self, error: float, report: Callable[[int], None]) -> None:
        """Split and measure until no link is off by more than ``error``, or nothing may be split."""
        lit = (self.bright[self.links.a] > 0) | (self.bright[self.links.b] > 0)
        waiting = (self.links.state <= 0) & lit
        frontier, store = self.links.take(waiting), self.links.take(~waiting)
        verdict, need = self._judge(store, error)
        chosen = verdict > 0
        pairs, verdict, need = store.take(chosen), verdict[chosen], need[chosen]
        store = store.take(~chosen)
        done = [store]
        try:
            self._finish(store, np.flatnonzero(store.state > 0), None, error)
            while len(frontier) or len(pairs):
                report(sum(len(part) for part in done) + len(frontier) + len(pairs))
                if len(frontier):
                    whole = self._measure(frontier)
                    alive = frontier.state != DROPPED
                    frontier, whole = frontier.take(alive), whole[alive]
                    fresh, fresh_need = self._judge(frontier, error)
                    kept, more = np.flatnonzero(fresh == 0), np.flatnonzero(fresh)
                    self._finish(frontier, kept, whole, error)
                    done.append(frontier.take(kept))
                    pairs = _Links.join([pairs, frontier.take(more)])
                    verdict, need = np.append(verdict, fresh[more]), np.append(need, fresh_need[more])
                    frontier = frontier.take(more[:0])
                parts, refused = self._split(pairs, verdict, need)
                left = pairs.take(refused)
                self._finish(left, np.arange(len(left)), None, error)
                dark = (self.bright[parts.a] == 0) & (self.bright[parts.b] == 0)
                done += [left, parts.take(dark)]
                frontier, pairs = parts.take(~dark), pairs.take(np.zeros(0, dtype=np.int64))
                verdict, need = verdict[:0], need[:0]
        finally:
            # Also when interrupted: what is waiting keeps its share of the pair that was split.
            self.links = _Links.join([*done, frontier, pairs])
            self._compact()

    def _compact(self) -> None:
        """Keep only the candidate lists that links still have."""
        links = self.links
        lengths = np.maximum(links.count, 0).astype(np.int64)
        total = int(lengths.sum())
        if total == len(self.candidates):
            return
        first = np.cumsum(lengths) - lengths
        index = np.repeat(links.offset - first, lengths) + np.arange(total)
        self.candidates = self.candidates[index]
        links.offset = first

    # ---- solving -------------------------------------------------------------------------------

    def divide(self, max_edge: float) -> None:
        """Open leaves until no flat one has an edge longer than ``max_edge``."""
        while True:
            leaves = self.tree.leaves()
            longest = self.tree.longest_edges(leaves)
            chosen = leaves[(longest > max_edge) & self.can_split[leaves]]
            if not len(chosen):
                return
            require_memory(
                float(len(leaves) * 2000), f"{4 * len(chosen):.3g} more elements", "ask for a larger max_edge"
            )
            self.tree.open_balanced(chosen)
            self._grown()

    def incident(self, nodes: IntArray) -> FloatArray:
        """Irradiance (k, bands) of nodes from lights without surface and from the sky."""

        def find(scene: Scene, mesh: PatchMesh, *args: Any, **options: Any) -> FloatArray:
            # A few fresh nodes may be off by more: the error is that over all surfaces.
            error = self.outside_error * math.sqrt(self.total_area / max(float(mesh.element_area.sum()), 1e-300))
            return incident_irradiance(scene, mesh, *args, error=error, **options)

        return self._from_outside("mean", find, nodes)

    def _from_outside(self, name: str, find: Callable[..., FloatArray], nodes: IntArray) -> FloatArray:
        """What ``find`` says of the light from outside the mesh on each node, asked once."""
        if not self.lit_from_outside:
            return np.zeros((len(nodes), self.scene.bands))
        known = self._outside[name]
        if len(known) < self.tree.node_count:
            more = np.full((self.tree.node_count - len(known), self.scene.bands), np.nan)
            known = self._outside[name] = np.concatenate([known, more])
        fresh = nodes[np.isnan(known[nodes, 0])]
        if len(fresh):
            with self.record.stage("light from outside"):
                known[fresh] = find(
                    self.scene, self.tree.mesh(fresh), self.accelerator, seed=self.seed, shader=self.shader
                )
        return known[nodes]

    def bare(self, leaves: IntArray) -> FloatArray:
        """Share of each leaf, (k,), that is not covered by what stands on it."""
        if len(self._bare) < self.tree.node_count:
            self._bare = np.concatenate([self._bare, np.full(self.tree.node_count - len(self._bare), np.nan)])
        fresh = leaves[np.isnan(self._bare[leaves])]
        if len(fresh):
            with self.record.stage("covers"):
                self._bare[fresh] = self._find_bare(fresh)
        return self._bare[leaves]

    def _find_bare(self, nodes: IntArray) -> FloatArray:
        """A point is covered if all its rays end at backs: under a box they end inside its sides.

        One ray a point first; only where one ends at a back the others follow.
        """
        out = np.ones(len(nodes))
        flat = np.flatnonzero(self.tree.arrays.flat[nodes] == 1)
        wanted = ALL_COVER_POINTS * self.tree.arrays.area[nodes] / self.total_area
        wanted = np.clip(2 ** np.ceil(np.log2(np.maximum(wanted, 1.0))), LEAST_COVER_POINTS, MOST_COVER_POINTS)
        for points in np.unique(wanted[flat]).astype(int).tolist():
            asked = flat[wanted[flat] == points]
            for times, rays in enumerate(COVER_RAYS, start=1):
                asked = self._cover(nodes, asked, times * points, rays, out)
        return out

    def _cover(self, nodes: IntArray, asked: IntArray, points: int, rays: int, out: FloatArray) -> IntArray:
        """Bare shares of the rows ``asked``, by so many points and rays from each; those in part covered."""
        step = max(BLOCK_RAYS // (points * rays), 1)
        doubtful = [asked[:0]]
        for first in range(0, len(asked), step):
            own = asked[first : first + step]
            mesh = self.tree.mesh(nodes[own])
            start = points_of_elements(mesh, np.arange(len(own)), points, self.seed)
            normals = np.repeat(mesh.element_normal, points, axis=0)
            # Streams are told apart by the nodes, whatever block they are in.
            along = cosine_directions(normals, rays, [self.seed, int(nodes[own[0]]), rays])
            start = np.repeat(start + self.accelerator.offset * normals, rays, axis=0)
            centre, scale = self.accelerator.frame
            hit = self.accelerator.nearest_raw(
                ((start - centre) * scale).astype(np.float32), (along * scale).astype(np.float32)
            )
            backs = (hit >= 0) & ~self.two_sided[hit]
            backs &= np.einsum("ij,ij->i", along, self.geometry.polygon_normal[hit]) > 0
            covered = backs.reshape(len(own), points, rays).all(axis=2)
            out[own] = 1.0 - covered.mean(axis=1)
            doubtful.append(own[covered.any(axis=1)])
            self.counters.add(rays=len(hit))
        return np.concatenate(doubtful)

    def refine_for_lights(self, error: float, unit: FloatArray) -> None:
        """Split leaves over which the light from outside the mesh varies by more than ``error``."""
        if not self.lit_from_outside:
            return
        fresh = self.tree.leaves()
        while len(fresh):
            spread = self._from_outside("spread", incident_spread, fresh)
            need = (spread / unit).max(axis=1) * self.weight[fresh]
            chosen = np.flatnonzero((need > error) & self.can_split[fresh])
            room = math.inf
            if self.max_elements is not None:
                room = float(self.max_elements - self.tree.leaf_count)
            nodes = fresh[chosen[np.argsort(-need[chosen], kind="stable")]]
            nodes = nodes[self.tree.open_balanced(nodes, room)]
            if not len(nodes):
                return
            before = len(self.bright)
            self._grown()
            child, counts = self.tree.arrays.child[nodes], self.tree.arrays.children[nodes]
            parts = np.repeat(child - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
            fresh = np.union1d(parts, np.arange(before, self.tree.node_count))
            fresh = fresh[self.tree.arrays.opened[fresh] == 0]

    def waiting(self) -> bool:
        """Whether there are links that were dark when last looked at and are not now."""
        links = self.links
        return bool(((links.state <= 0) & ((self.bright[links.a] > 0) | (self.bright[links.b] > 0))).any())

    def illuminate(self, radiosity: FloatArray, irradiance: FloatArray, exchange: _Exchange, unit: FloatArray) -> None:
        """Take the brightness of all nodes from the radiosity and irradiance (n, bands) of the leaves."""
        relative = radiosity / unit
        mean = exchange.up(relative)
        square = exchange.up(relative**2)
        self.bright = mean.max(axis=1)
        self.uneven = np.empty(len(mean))
        deviations(square, mean, self.uneven)
        self.whole = exchange.whole
        closed = exchange.up(exchange.balanced[:, None].astype(np.float64))[:, 0] > 1.0 - 1e-9
        self.received = np.where(closed, exchange.up(irradiance / unit).max(axis=1), 0.0)
        self._weigh()

    def accumulate(self, exchange: _Exchange) -> None:
        """Keep what the links are off, added up for every node, for the next round."""
        detail, bias, _ = self._errors(exchange, linear=True)
        self.detail, self.bias = exchange.up(np.column_stack([detail, bias])).T.copy()

    def stated_errors(self, exchange: _Exchange) -> dict[str, float]:
        """Root mean square errors of the irradiance over all surfaces, in units of its mean.

        What the links to one receiver are off over it is neither of one sign (as in a shadow, which is dark for
        all senders) nor independent: the geometric mean of their sum and of the root of their squares' sum
        was seen to be 1.0 to 1.5 times the error in rooms.
        """
        squares, sums = self._errors(exchange, linear=False), self._errors(exchange, linear=True)
        means = [sums[0] * np.sqrt(squares[0]), sums[1] * np.sqrt(squares[1]), squares[2]]
        parts = [math.sqrt(float(exchange.area @ part) / self.total_area) for part in means]
        names = ("over_receivers", "over_senders", "form_factors")
        return dict(zip(names, parts, strict=True)) | {"total": math.hypot(*parts)}

    def _errors(self, exchange: _Exchange, *, linear: bool) -> list[FloatArray]:
        """Errors of all links to each leaf (leaves,): over receivers, over senders, of form factors."""
        links, arrays = self.links, self.tree.arrays
        nodes = np.zeros((3, self.tree.node_count))
        link_errors(
            links.a, links.b, links.vary_a, links.vary_b, links.bend_a, links.bend_b, links.doubt, arrays.area,
            exchange.shaped, self.bright, self.uneven, self.received, exchange.node_area, nodes[0], nodes[1], nodes[2],
            linear,
        )  # fmt: skip
        return list(exchange.down(nodes.T.copy()).T)


def _conjugate_gradients(
    apply: Callable[[FloatArray], FloatArray], right: FloatArray, start: FloatArray, area: FloatArray, limit: float
) -> FloatArray:
    """Solve ``apply(z) = right`` (n, bands), each band for itself, in the inner product of ``area``.

    ``apply`` is symmetric and positive in it.  Ends when every band's residual is below ``limit`` of its
    right side, or no longer falls.
    """
    z = start.copy()
    residual = right - apply(z)
    along = residual.copy()
    square = area @ residual**2
    goal = limit**2 * (area @ right**2)
    for _ in range(500):
        busy = square > goal
        if not busy.any():
            break
        image = apply(along)
        curve = area @ (along * image)
        step = np.divide(square, curve, out=np.zeros_like(square), where=busy & (curve > 0))
        z += step * along
        residual -= step * image
        fresh = area @ residual**2
        along = residual + np.divide(fresh, square, out=np.zeros_like(square), where=square > 0) * along
        square = fresh
    return z


def _row_targets(solver: _Solver, exchange: _Exchange) -> tuple[FloatArray, FloatArray]:
    """Row sums wanted of the leaves, and those found; puts the latter and their doubt into the record."""
    links, record, tree = solver.links, solver.record, exchange.tree
    sums = exchange(np.ones((len(exchange.area), 1)))[:, 0]
    n = tree.node_count
    area = np.where(exchange.node_area > 0, exchange.node_area, math.inf)
    a, b, known = links.a, links.b, links.state > 0
    other = known & (a != b)
    off = np.asarray(np.bincount(a, np.where(known, links.doubt, 0.0), n), dtype=np.float64)
    off += np.bincount(b, np.where(other, links.doubt, 0.0), n)
    off /= area
    # A leaf's own row is off by the doubts of links and by their detail.
    detail = np.bincount(a, np.where(known, links.vary_a, 0.0), n) + np.bincount(
        b, np.where(other, links.vary_b, 0.0), n
    )
    stated = exchange.down((off + detail)[:, None])[:, 0]
    record.errors["row_sum"] = {
        "min": float(sums.min()),
        "mean": float(np.average(sums, weights=exchange.area)),
        "max": float(sums.max()),
        "stated_error": float(stated.max()),
        "rows": len(sums),
    }
    # Pairs that stayed dark on both sides were never measured: what is known of their rows is no whole.
    dark = ~known
    unseen = np.asarray(np.bincount(a[dark], minlength=n) + np.bincount(b[dark], minlength=n), dtype=np.float64)
    whole = exchange.down(unseen[:, None])[:, 0] == 0.0
    most = np.where(whole, 1.0, np.minimum(sums, 1.0))
    if solver.scene.closed:
        exchange.balanced = whole & (sums > 0.0)
        return np.where(sums > 0.0, most, 0.0), sums
    # Rows above 1 are errors as those below are; cutting only the former would lose light.
    nodes = np.zeros((n, 2))
    nodes[exchange.leaves, 0], nodes[exchange.leaves, 1] = sums, most
    arrays = tree.arrays
    pull(nodes, n, arrays.opened, arrays.child, arrays.children, exchange.node_area)
    level(nodes, n, arrays.opened, arrays.child, arrays.children, exchange.node_area)
    return nodes[exchange.leaves, 0], sums


def _solve_links(solver: _Solver, exchange: _Exchange, solution: Solution, *, limit: float) -> None:
    """Solve for the leaves over the links there are; fills the solution and its energy book."""
    mesh, book = solution.mesh, solution.book
    area = exchange.area
    if exchange.wanted is None:
        exchange.wanted, found = _row_targets(solver, exchange)
        if (exchange.wanted != found).any():
            exchange.balance()
    incident = solution.direct_irradiance
    sent = mesh.emission + mesh.reflectance * incident
    root = np.sqrt(mesh.reflectance)
    # E = K (s + R E) with K symmetric: z = sqrt(R) E solves (1 - sqrt(R) K sqrt(R)) z = sqrt(R) K s.
    right = root * exchange(sent)
    start = root * (solution.element_irradiance - incident)
    z = _conjugate_gradients(lambda v: v - root * exchange(root * v), right, start, area, limit)
    seen = sent + root * z
    arriving = exchange(seen)
    solution.element_irradiance = incident + arriving
    solution.radiosity = mesh.emission + mesh.reflectance * solution.element_irradiance
    # What was sent of what leaves: the rest, a residual, is yet unshot.
    bare = np.divide(area, mesh.element_area, out=np.zeros_like(area), where=mesh.element_area > 0)[:, None]
    solution.unshot = bare * (solution.radiosity - seen)
    covered = (mesh.element_area - area) @ mesh.emission
    book.emitted = covered + area @ (mesh.emission + incident)
    book.shot = covered + area @ seen
    book.received = area @ (incident + arriving)
    book.absorbed = area @ ((1.0 - mesh.reflectance) * (incident + arriving))
    book.escaped = book.shot - area @ arriving


def solve_hierarchical(
    scene: Scene,
    geometry: Geometry,
    record: RunRecord,
    *,
    link_error: float | None = 1e-3,
    max_edge: float | None = None,
    min_edge: float | None = None,
    direct_in_mesh: bool = True,
    max_elements: int | None = None,
    form_factor_error: float | None = None,
    tolerance: float = 1e-6,
    workers: int = 1,
    seed: int = 0,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
    resume: Solution | None = None,
    rounds: Callable[[Solution], None] | None = None,
) -> Solution:
    """Solve a scene over a hierarchy of links.

    Parameters
    ----------
    scene, geometry : Scene, Geometry
        A scene and its flattened form.
    record : RunRecord
        Gets the stages, counters, errors and results.
    link_error : float, optional
        Largest error that one link may leave, as a share of the mean irradiance of the scene: the
        deviation of the link's light over its receiver, times the root of the receiver's share of
        all area.  Where all rows are known to sum to 1, light counts by how much it differs from what the
        receiver gets from elsewhere.  The errors of all links give the root mean square error of the
        irradiance, element by element, stated as ``link_error_estimate``.  ``None`` with
        ``max_elements``: as small as that number allows.
    max_edge : float, optional
        Split everything until no flat element is longer than this, whatever its links.  [scene lengths]
    min_edge : float, optional
        Elements shorter than twice this are not split.  [scene lengths]  By default 2^-14 of the
        scene's size: where the link error ends splitting by itself.
    direct_in_mesh : bool
        Let elements resolve what they receive, shadows too: for meshes that are looked at as they
        are.  Without it elements are as fine as what they *reflect* needs (points and pictures take
        direct light themselves), and far fewer.
    max_elements : int, optional
        Make no more than about so many elements; those with the largest need are made.
    form_factor_error : float, optional
        Relative error of each kept form factor, where closed forms and cuts can reach it; by default
        only what the link error needs.
    tolerance : float
        Bound on the light still missing when the linear equations count as solved.
    workers : int
        Threads; the answer does not depend on it.
    seed : int
        Of the rays.
    progress : callable, optional
        Called with a :class:`ProgressEvent` at every frontier; a ``KeyboardInterrupt`` from it ends the
        refinement, and the links there are give the solution.
    checkpoint : callable, optional
        Called now and then, after a round of refinement, with the solution so far.
    resume : Solution, optional
        Such a solution, or one that was interrupted, to go on from; gone on from the former, the answer is
        that of an unbroken solve, bit for bit.  One that was finished is solved anew.
    rounds : callable, optional
        Called with the solution after each round of refinement, from coarse to fine; the one that is returned then
        keeps what is needed to go on from it with more elements.

    Returns
    -------
    Solution
        Its elements are the leaves of the tree; clusters of small facets may be among them.  Of an
        element that is covered in part (the floor under a box) the values are those of the bare part.

    Raises
    ------
    OptionError
        If an option is out of range.
    InputError
        If the solution to go on from is of another scene.
    MemoryForecastError
        If the links would not fit in memory.
    """
    if link_error is None and max_elements is None:
        raise OptionError("link_error and max_elements were both left out; give one of them")
    if link_error is not None:
        link_error = as_positive(link_error, "link_error", "a positive number such as 1e-3")
    for name, length in (("min_edge", min_edge), ("max_edge", max_edge)):
        if length is not None:
            as_positive(length, name, "a positive length")
    if max_elements is not None:
        max_elements = as_count(max_elements, "max_elements")
    solver = _Solver(
        scene,
        geometry,
        record,
        min_edge=min_edge if min_edge is not None else SMALLEST * geometry.size,
        direct_in_mesh=direct_in_mesh,
        relative=form_factor_error or 0.0,
        outside_error=OUTSIDE * (link_error or 1.0 / float(max_elements or 1)),
        workers=workers,
        seed=seed,
        max_elements=max_elements,
    )
    try:
        state = _Round()
        if resume is not None and resume.refinement is not None:
            state = solver.restore(resume)
        elif max_edge is not None:
            solver.divide(max_edge)
        if form_factor_error is None and (max_elements or math.inf) <= solver.tree.leaf_count <= EXACT_ELEMENTS:
            solver.relative = EXACT
        return _rounds(solver, state, link_error, tolerance, progress, checkpoint, rounds)
    finally:
        solver.close()


@dataclass
class _Round:
    """Where a solve stands between two rounds: those done, the last one's link error, the mean irradiance."""

    done: int = 0
    error: float = math.inf
    unit: FloatArray | None = None


def _next_error(solver: _Solver, state: _Round, link_error: float | None) -> float | None:
    """Link error of the next round, none coarser than the one before; None after the last."""
    if link_error is not None:
        if state.done < len(COARSER):
            return COARSER[state.done] * link_error
        finer = state.error > link_error
        error = link_error
    elif state.done < 2:
        return FIRST_ERROR
    else:
        assert solver.max_elements is not None
        share = solver.tree.leaf_count / solver.max_elements
        # With no room for another split only links would be refined, to no end.
        room = solver.max_elements - solver.tree.leaf_count
        finer = share < 0.98 and room >= LEAST_SPLIT and state.error > LAST_ERROR
        # No smaller than the elements last, or links alone are refined.
        error = max(0.5, share**ELEMENTS_FALL) * state.error if finer else state.error
    # Light that goes round more corners than there were rounds.
    return error if finer or solver.waiting() else None


def _rounds(
    solver: _Solver,
    state: _Round,
    link_error: float | None,
    tolerance: float,
    progress: Progress | None,
    checkpoint: Checkpoint | None,
    each_round: Callable[[Solution], None] | None,
) -> Solution:
    """Refine and solve, round by round."""
    record, tree = solver.record, solver.tree
    begin = time.perf_counter()
    final = link_error if link_error is not None else LAST_ERROR
    saved, pause = -math.inf, CHECKPOINT_SECONDS

    def report(links: int) -> None:
        if progress is not None:
            seconds = time.perf_counter() - begin
            progress(ProgressEvent(links, error or final, final, seconds, f"{tree.leaf_count} elements"))

    stopped = ""
    solution: Solution | None = None
    if state.unit is None:
        state.unit = _first_light(solver)
    else:
        with record.stage("solve"):
            solution, exchange = _solved(solver, limit=1e-3, interrupted=False)
    while (error := _next_error(solver, state, link_error)) is not None:
        # What the sums of errors will be after this round, about.
        fall = (error / state.error) ** FALL
        solver.detail *= fall
        solver.bias *= fall
        try:
            solver.refine_for_lights(error, state.unit)
            with record.stage("links"):
                solver.refine(error, report)
        except KeyboardInterrupt:
            stopped = "interrupted"
        with record.stage("solve"):
            solution, exchange = _solved(solver, limit=1e-3, interrupted=bool(stopped))
            found = solution.mean_irradiance
            state.unit = np.where(found > 0, found, state.unit)
            solver.illuminate(solution.radiosity, solution.element_irradiance, exchange, state.unit)
            solver.accumulate(exchange)
        state.error = error
        if stopped:
            break
        state.done += 1
        if each_round is not None:
            each_round(solution)
        if checkpoint is not None and time.perf_counter() - saved > pause:
            start = time.perf_counter()
            solver.count()
            solution.refinement = solver.state(state)
            checkpoint(solution)
            solution.refinement = None
            saved = time.perf_counter()
            pause = max(CHECKPOINT_SECONDS, (saved - start) / CHECKPOINT_SHARE)
    assert solution is not None
    with record.stage("solve"):
        exchange.settle(ROWS_OFF)
        limit = 1e-3
        while True:
            limit *= 1e-3
            _solve_links(solver, exchange, solution, limit=limit)
            if remaining_bound(solution) <= tolerance or limit < 1e-15:
                break
    solution.converged = not stopped
    solution.stopped = stopped or "tolerance"
    if stopped or each_round is not None:
        solution.refinement = solver.state(state)
    _report(solver, solution, exchange)
    return solution


def _first_light(solver: _Solver) -> FloatArray:
    """Make the emitters bright, and what is lit from outside the mesh; a guess at the mean irradiance (bands,)."""
    tree, scene, arrays = solver.tree, solver.scene, solver.tree.arrays
    leaves = tree.leaves()
    incident = solver.incident(leaves)
    area, surface = arrays.area[leaves], arrays.surface[leaves]
    emission, rho = solver.emission[surface], solver.rho[surface]
    unit = area @ (emission + incident) / area.sum()
    if scene.closed:
        unit = unit / (1.0 - np.minimum(area @ rho / area.sum(), 0.99))
    unit = np.where(unit > 0, unit, max(float(unit.max(initial=0.0)), 1e-300))
    none = _Exchange(tree, leaves, np.ones(len(leaves)), solver.links.take(np.zeros(0, dtype=np.int64)), solver.pool)
    solver.illuminate(emission + rho * incident, incident, none, unit)
    return unit


def _solved(solver: _Solver, *, limit: float, interrupted: bool) -> tuple[Solution, _Exchange]:
    """The solution over the links and leaves that there are."""
    tree = solver.tree
    # What waits for light carries none; what was about to be measured has its share of a measured link.
    leaves = tree.leaves()
    bare = solver.bare(leaves)
    exchange = _Exchange(tree, leaves, bare, solver.links, solver.pool, with_unseen=interrupted)
    mesh = tree.mesh(leaves)
    incident = np.zeros((len(bare), mesh.bands))
    np.divide(solver.incident(leaves), bare[:, None], out=incident, where=bare[:, None] > 0)
    solution = Solution(
        scene=solver.scene,
        mesh=mesh,
        radiosity=mesh.emission + mesh.reflectance * incident,
        element_irradiance=incident.copy(),
        unshot=np.zeros_like(incident),
        book=EnergyBook.empty(mesh.bands),
        record=solver.record,
        direct_irradiance=incident,
    )
    _solve_links(solver, exchange, solution, limit=limit)
    return solution, exchange


def _report(solver: _Solver, solution: Solution, exchange: _Exchange) -> None:
    """Put what the run knows of its own errors into the record."""
    record, links = solver.record, solver.links
    solver.count()
    record.seconds["inside embree, summed over threads"] = solver.seconds_in_embree
    record.errors["remaining_bound"] = remaining_bound(solution)
    record.errors["energy_imbalance"] = solution.book.imbalance(solution.unshot_power)
    # Both directions of a link are one number.
    record.errors["reciprocity"] = 0.0
    record.errors["link_error_estimate"] = solver.stated_errors(exchange)
    record.errors["facet_error"] = solution.mesh.facet_error
    record.results.update(
        elements=solution.mesh.element_count,
        nodes=solver.tree.node_count,
        links=len(links),
        links_clear=int((links.state == CLEAR).sum()),
        links_cut=int((links.state == CUT).sum()),
        links_by_rays=int((links.state >= RAYS).sum()),
        energy_book=solution.book.as_dict(),
        stopped=solution.stopped,
    )
