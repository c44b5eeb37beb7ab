# %% [markdown]
# # A first solve
#
# Load a scene, ask for an error, and look: at the picture, at the numbers, and at what they cost.

# %%
import matplotlib.pyplot as plt
import numpy as np

import radiosity
import workbench

scene = workbench.load("cornell-box")
print(f"{scene.name}: {len(scene.surfaces)} surfaces, {scene.bands} bands")

# %% [markdown]
# The error is the root mean square error of the irradiance over the surfaces, relative to its mean. The
# solver compares each mesh with a coarser one, refines until they agree well enough, and says how the
# error is made up.

# %%
solution = radiosity.solve(scene, error=0.05)
print(f"converged: {solution.converged}, {solution.mesh.element_count} elements")
for name, value in solution.record.errors["estimate"].items():
    print(f"  {name:14s} {value:.2g}")

# %% [markdown]
# ## Where the light goes
#
# What is emitted is absorbed or leaves through the open front; the book balances to rounding.

# %%
book = solution.book.as_dict()
for name, watts in book.items():
    print(f"{name:12s} {np.round(watts, 4)}")

# %% [markdown]
# ## Irradiance at points of one's own
#
# Direct light is found at the point, exactly where it can be; only reflected light is read from the mesh.
# A row of points across the floor, in front of the blocks:

# %%
x = np.linspace(0.02, 0.53, 60)
row = np.column_stack([x, np.zeros(60), np.full(60, 0.04)])
found = radiosity.Gatherer(solution).irradiance(row, [0, 1, 0], error=0.005)
figure, axes = plt.subplots(layout="constrained")
for band, colour in enumerate(("tab:red", "tab:green", "tab:blue")):
    axes.plot(x, found.irradiance[:, band], color=colour, label=f"band {band}")
    axes.plot(x, found.direct[:, band], color=colour, ls=":")
axes.set_xlabel("x [m]")
axes.set_ylabel("irradiance (dotted: direct) [W m$^{-2}$]")
axes.legend()
axes.set_title("Across the floor of the Cornell box, 4 cm inside")
plt.show()

# %% [markdown]
# ## The picture
#
# `radiosity solve cornell-box -o out/cornell` also leaves the mesh for ParaView and a preview; in Python:

# %%
picture = radiosity.render_preview(solution, width=192, height=192)
plt.figure(layout="constrained")
plt.imshow(picture)
plt.axis("off")
plt.title("Cornell box, radiosity of the mesh")
plt.show()
