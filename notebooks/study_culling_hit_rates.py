# %% [markdown]
# # Hit rates of the shadow cullers
#
# How many polygons does a culler set aside, and how many intersection tests are left to a shadow ray?
# One scene, a torus knot over a floor under square lights, is shaded by four methods that find the
# same rays blocked:
#
# * **rayID**: a voxel walk with mailboxes; no culler (Woo 1993, Figure 2)
# * **plane-vertex**: the same walk; polygons outside the light pyramid are set aside (his Figure 4)
# * **shaft**: one shaft from each group of points to the light finds candidates in a box tree (Haines
#   and Wallace 1991); every ray tests the candidates until one blocks it
# * **shaft, plane-vertex**: each point checks the candidates of its group against its own pyramid
#
# Everything here is a count, so it is the same on every machine.

# %%
import matplotlib.pyplot as plt

from workbench.study.hit_rates import METHODS, Setting, sweep
from workbench.study.result import format_table

base = Setting()  # 2,304 triangles, 1,024 points, a unit light, K = 16; larger: Setting(segments=192, side=64)

sweeps = {
    "resolution": ("voxels along each axis", [8, 16, 32, 64]),
    "segments": ("tessellation: segments along the knot", [32, 64, 96, 128]),
    "light_side": ("side of the light", [0.125, 0.25, 0.5, 1.0, 2.0]),
    "rays": ("K, rays to each light", [4, 9, 16, 36]),
    "lights": ("number of lights", [1, 2, 4]),
    "group": ("points that share a shaft", [1, 8, 16, 64]),
}

# %% [markdown]
# ## The counts
#
# `avoided %` compares with the same method without the check. `culled %` is the share of the polygons
# that were put to the culler: for plane-vertex those that the walk met, for shafts all of the scene. One table is
# printed; the figure below shows all.

# %%
results = {}
for parameter, (_, values) in sweeps.items():
    results[parameter] = sweep(base, parameter, values)
print(format_table(results["light_side"]))

# %% [markdown]
# ## What is left to a ray
#
# * The finer the grid, the fewer polygons a ray meets that it could have been spared: the check avoids
#   most in coarse grids and least in fine ones, where stepping from voxel to voxel takes over.
# * The smaller the light, the thinner the pyramid and the better the check: it is at its best for
#   linear lights, whose pyramid is a triangle, and at its worst where the light is as large as the
#   occluder.
# * More rays a point share one check, so its price falls with K. Tests a ray hardly change: what a
#   pyramid lets through, every one of its rays may meet.
# * Several lights are shaded one after the other; each has its own pyramid and the rates stay.
# * A shaft culls most of the scene at the price of a few box tests a point, but a ray that tests its
#   list from end to end does more tests than a walk that meets only what is near. The list shrinks
#   with the group. Lists pay where they are short enough to be cut exactly, or empty.

# %%
figure, axes = plt.subplots(4, 3, figsize=(12, 13), layout="constrained")
for place, (parameter, (about, values)) in enumerate(sweeps.items()):
    tests, culled = axes[2 * (place // 3), place % 3], axes[2 * (place // 3) + 1, place % 3]
    for index, method in enumerate(METHODS):
        style = {"color": f"C{index}", "marker": "os^D"[index], "label": method}
        rows = [row for row in results[parameter] if row["method"] == method]
        tests.plot(values, [row["tests_per_ray"] for row in rows], **style)
        if method != "rayID":
            culled.plot(values, [row["culled_%"] for row in rows], **style)
    for part in (tests, culled):
        part.set_xscale("log", base=2)
        part.set_xticks(values, [f"{value:g}" for value in values])
        part.minorticks_off()
        part.grid(alpha=0.3)
        part.set_xlabel(about)
    tests.set_yscale("log")
    tests.set_ylim(1, 1000)
    culled.set_ylim(0, 105)
    tests.set_ylabel("intersection tests a ray")
    culled.set_ylabel("polygons culled, % of those asked")
axes[0, 0].legend(fontsize=8)
axes[1, 0].legend(fontsize=8)
figure.suptitle("Cullers of shadow rays: a torus knot under square lights, 1,024 points")
plt.show()
