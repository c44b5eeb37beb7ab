# %% [markdown]
# # Daylight in a room
#
# A side-lit office under the CIE overcast sky, six metres deep, with one window. The scene's sky gives 100
# W/m2 on open ground, so irradiance inside is the daylight factor in percent.

# %%
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import radiosity
import workbench

scene = workbench.load("daylight-office")
solution = radiosity.solve(scene, error=0.05)
print(f"{solution.mesh.element_count} elements, estimated error {solution.record.errors['estimate']['total']:.2g}")

# %% [markdown]
# ## The daylight factor over the working plane
#
# A grid of sensors 0.8 m above the floor, half a metre from the walls. Light from the sky comes in closed
# form through what is open of the window; light from the walls is gathered from the solution.

# %%
x, y = np.meshgrid(np.linspace(0.5, 3.5, 13), np.linspace(0.5, 5.5, 21))
plane = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.8)])
found = radiosity.Gatherer(solution).irradiance(plane, [0, 0, 1], error=0.005)
factor = found.irradiance[:, 0].reshape(x.shape)
figure, axes = plt.subplots(figsize=(5, 7), layout="constrained")
filled = axes.contourf(x, y, factor, levels=[0.25, 0.5, 1, 2, 3, 5, 8, 12], cmap="viridis", extend="both")
axes.set_aspect("equal")
axes.set_xlabel("x [m]")
axes.set_ylabel("distance from the window wall [m]")
axes.set_title("Daylight factor at 0.8 m")
figure.colorbar(filled, ax=axes, label="daylight factor [%]")
plt.show()
print(f"mean {factor.mean():.2f} %, least {factor.min():.2f} %, uniformity {factor.min() / factor.mean():.2f}")

# %% [markdown]
# ## Sky and reflections apart, and another sky
#
# Deep in the room what is reflected matters most. A uniform sky of the same total gives more at the back:
# the overcast sky is three times as bright at the zenith as at the horizon, which is all the back can see.

# %%
uniform = replace(scene, sky=replace(scene.sky, kind="uniform"))
line = np.column_stack([np.full(30, 2.0), np.linspace(0.3, 5.7, 30), np.full(30, 0.8)])
figure, axes = plt.subplots(layout="constrained")
for name, solved in (("overcast", solution), ("uniform", radiosity.solve(uniform, error=0.05))):
    got = radiosity.Gatherer(solved).irradiance(line, [0, 0, 1], error=0.003)
    (drawn,) = axes.semilogy(line[:, 1], got.irradiance[:, 0], label=f"{name} sky")
    axes.semilogy(line[:, 1], got.indirect[:, 0], ls=":", color=drawn.get_color(), label=f"{name}, reflected")
axes.set_xlabel("distance from the window wall [m]")
axes.set_ylabel("daylight factor [%]")
axes.set_title("Along the middle of the room, 0.8 m high")
axes.grid(alpha=0.3, which="both")
axes.legend()
plt.show()
