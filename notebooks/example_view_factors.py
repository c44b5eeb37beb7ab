# %% [markdown]
# # View factors
#
# The share of what leaves one surface that reaches another, for radiative exchange in rooms, furnaces
# and between buildings. The L-room has two walls that do not see each other and floors that are no
# rectangles: what lies in the way counts.

# %%
import matplotlib.pyplot as plt
import numpy as np

import radiosity
import workbench
from radiosity.report.failures import contour_factor

scene = workbench.load("l-room")
found = radiosity.view_factors(scene, by="surface", error=1e-3)
print("row sums as found:", np.round(found.row_sums, 6))
print(f"reciprocity |A_i F_ij - A_j F_ji| / A F: {found.reciprocity:.1e}")

# %%
factor = found.dense()
figure, axes = plt.subplots(figsize=(7, 6), layout="constrained")
shown = axes.imshow(factor, cmap="viridis")
axes.set_xticks(range(len(found.names)), found.names, rotation=60, ha="right")
axes.set_yticks(range(len(found.names)), found.names)
for i, j in np.ndindex(factor.shape):
    colour = "white" if factor[i, j] < 0.6 * factor.max() else "black"
    axes.text(j, i, f"{factor[i, j]:.3f}", ha="center", va="center", color=colour, fontsize=8)
axes.set_title("L-room: from row to column")
figure.colorbar(shown, ax=axes, label="form factor")
plt.show()

# %% [markdown]
# ## Against a closed form
#
# The walls `y=0` and `x=3` share an edge and nothing stands between them, so the double contour
# integral is exact.

# %%
surfaces = {surface.name: surface.face(0)[0] for surface in scene.surfaces}
first, second = found.names.index("y=0"), found.names.index("x=3")
exact = contour_factor(surfaces["y=0"], surfaces["x=3"])
print(f"F from y=0 to x=3: {factor[first, second]:.6f}, exact {exact:.6f}")
assert abs(factor[first, second] - exact) < 1e-3
hidden = factor[found.names.index("x=3"), found.names.index("y=3")]
print(f"the two ends of the L do not see each other: {hidden:g}")
assert hidden == 0.0

# %% [markdown]
# ## Net exchange
#
# With black walls at temperatures T the net power from surface i is the sum of A_i F_ij sigma (T_i^4 - T_j^4).
# The emitting end at 40 degrees Celsius, all else at 20:

# %%
kelvin = np.full(len(found.names), 293.15)
kelvin[found.names.index("x=3")] = 313.15
emitted = 5.670374419e-8 * kelvin**4
net = found.areas * (factor * (emitted[:, None] - emitted[None])).sum(axis=1)
for name, watts in zip(found.names, net, strict=True):
    print(f"{name:20s} {watts:8.1f} W")
print(f"{'sum':20s} {net.sum():8.1g} W")
