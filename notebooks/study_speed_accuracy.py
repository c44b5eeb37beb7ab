# %% [markdown]
# # Speed against accuracy
#
# Any technique can be made exact by waiting. What counts is where it stands on the plane of seconds
# and error, and how fast it comes down. Here three questions to small scenes are asked by every technique
# of ours: each setting is a point, and nothing lies left of and below the frontier.
#
# `radiosity chart` does the same from the command line, keeps a record that grows, and sets Mitsuba,
# Radiance, pyViewFactor and trimesh on the same axes where they are installed.
#
# Seconds belong to a machine; the counts beside them do not. Every setting runs several times, in mixed order, and
# short ones often: the point is the median, its bar the spread. What the bars do not tell apart is a tie (a grey
# ring), so that the order is the same when the notebook runs again.

# %%
import matplotlib.pyplot as plt

import workbench
from radiosity.report.metrics import slope
from radiosity.report.speed_accuracy import auto_ratios, draw_chart, measure, points_of
from radiosity.report.techniques import Reference, problem_for
from workbench.study.result import format_table

# %% [markdown]
# ## Shadows on the floor of the Cornell box
#
# Direct light at 24 x 24 points, judged by exact cuts. Cameras and rays come down with their number of
# pixels and samples; techniques that cull first have nothing left to sample in this scene and are exact.

# %%
box = workbench.load("cornell-box")
shadows = problem_for("shadows", box, grid=(24, 24))
plan = [(name, None) for name in ("rays", "camera", "camera-optimised", "adaptive", "shaft", "exact", "auto")]
judge = shadows.reference("exact")
runs, _ = measure(shadows, judge, plan, repeats=2, limit=0.5)
points = points_of(runs)
draw_chart(plt.figure(layout="constrained"), points, title=shadows.title, label=shadows.error_label)
plt.show()

# %%
columns = ("method", "value", "seconds", "error", "doubt")
print(format_table([{name: getattr(p, name) for name in columns} | {"rays": p.counts["rays"]} for p in points]))

# %% [markdown]
# ## How fast errors fall
#
# Random samples bring the error down as samples^-1/2. The samples here are spread evenly, so along
# the straight edges of shadows the error falls as samples^-3/4, and pictures of n pixels as n^-1/2 to n^-1.

# %%
for method in ("rays", "camera"):
    mine = [p for p in points if p.method == method]
    print(f"{method}: error ~ samples^{slope([p.value for p in mine], [p.error for p in mine]):.2f}")

# %% [markdown]
# ## View factors of the L-room
#
# Eight polygons, two of them concave, and two that do not see each other. Hemicubes and rays sample;
# bundles and `auto` evaluate closed forms over what the cuts leave.

# %%
room = workbench.load("l-room")
factors = problem_for("viewfactors", room)
plan = [("auto", None), ("bundle", (0.1, 0.03, 0.01)), ("hemicube", (1, 4, 16)), ("rays", (256, 1024, 4096))]
runs, _ = measure(factors, factors.reference("exact"), plan, repeats=2, limit=0.5)
points = points_of(runs)
draw_chart(plt.figure(layout="constrained"), points, title=factors.title, label=factors.error_label)
plt.show()

# %% [markdown]
# ## All the light of the Cornell box
#
# Irradiance at 96 points after all reflections, judged by a finer mesh with other random numbers. Read
# off their elements (`matrix`), meshes need thousands of elements, most of them for shadows' edges. Asked at
# the points (`+gather`), where direct light is found afresh, some hundred do; which solver made them matters
# for the seconds and hardly for the error.

# %%
solves = problem_for("solve", box, points=96)
fine = Reference("matrix, 1,600 elements, gathered", solves.technique("matrix+gather").ask(1600, 9).values, 0.0, 0.004)
plan = [
    ("auto", (0.1, 0.05, 0.02)),
    ("matrix", (100, 400)),
    ("matrix+gather", (16, 50, 200, 400)),
    ("progressive+gather", (16, 50, 200)),
    ("hierarchical+gather", (100, 200)),
]
runs, _ = measure(solves, fine, plan, repeats=2, limit=0.5)
solved = points_of(runs)
draw_chart(plt.figure(layout="constrained"), solved, title=solves.title, label=solves.error_label, floor=fine.error)
plt.show()

# %% [markdown]
# ## Does automatic choice choose well?
#
# For each automatic point: how many times the seconds of our best hand-tuned point at the same error.
# Below 1 it beats all hand-tuned ones; a dash says that none of them is as exact.

# %%
for question, found in (("view factors", points), ("solve", solved)):
    for point, ratio in auto_ratios(found):
        times = "-" if ratio is None else f"{ratio:.2g} times"
        print(f"{question}: error asked {point.value:g}, reached {point.error:.2g}: {times}")
