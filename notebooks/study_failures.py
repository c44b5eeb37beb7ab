# %% [markdown]
# # Where techniques of light transport fail
#
# Every technique has scenes that break it: patches that touch, light pyramids that are nearly flat,
# float32 far from the origin, pixels as wide as the slats before them. The catalogue has one small scene
# for each, with one number that a formula gives, and every technique that claims to find it.
#
# *right*: within the entry's tolerance. *degrades*: further off, but the technique's own stated error
# says so. *refuses*: with a reason. *disclaims*: its documentation names the case. Anything else would be
# *wrong silently*. `radiosity stability` prints the whole matrix, Mitsuba, Radiance, pyViewFactor and
# trimesh included; here a part of it, of our own techniques.

# %%
import matplotlib.pyplot as plt

from radiosity.report.catalogue import CATALOGUE
from radiosity.report.failures import contour_factor, judge, point_irradiance
from radiosity.rivals import RIVALS
from radiosity.stability_command import draw_matrix, run_catalogue

groups = ("concave lights", "union, not product", "aliasing cameras", "missed small shadows", "near hits")
chosen = [
    (entry, [name for name in entry.techniques if name not in RIVALS]) for entry in CATALOGUE if entry.group in groups
]
matrix = run_catalogue(chosen)

# %%
draw_matrix(plt.figure(), chosen, matrix)
plt.show()

# %% [markdown]
# ## Two of them at close hand
#
# **A fence before a light.** Sixteen slats, each as wide as the gap beside it. Half the light passes. Samples
# on a regular lattice can all fall on slats: Woo's adaptive light looks at corners first, finds them all
# dark, and believes them. Samples that are spread without a period do not fall into step.

# %%
fence = next(entry for entry in CATALOGUE if entry.name == "fence")
print(f"right: {fence.expected:.6f}")
for technique in ("adaptive", "camera", "rays", "exact"):
    value, stated = fence.techniques[technique]()
    print(f"{technique:10s} {value:.6f}  states +- {stated:.6f}  {judge(fence, technique).verdict}")

# %% [markdown]
# **Squares that share an edge.** The kernel of the form factor grows without bound there. From centre to
# centre it gives cos cos / (pi r^2) = 0.3183; the double contour integral gives the right 0.2000.

# %%
floor = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
wall = [[0, 0, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1]]
print(f"contour integral {contour_factor(floor, wall):.10f}, centre to centre {1 / 3.141592653589793:.4f}")
light = [[-0.5, -0.5, 2], [0.5, -0.5, 2], [0.5, 0.5, 2], [-0.5, 0.5, 2]]
print(f"and Lambert's formula below a unit square at height 2: {point_irradiance(light):.10f}")
