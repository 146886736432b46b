# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 1. Fit a picture
#
# *`make lab` opens this notebook in Jupyter; it is kept as text, a double click on it opens it as a notebook.*
#
# You have a picture of a thing under known light, and want the few numbers that reproduce its look: ambient `k_a`,
# diffuse `k_d`, specular `k_s` and the exponent `n`. Two files are needed: the picture, and `scene.toml`, which says
# what it shows. Here both come with the project: a golden ball, drawn by OpenGL with the classic "gold".

# %%
from pathlib import Path

import brdf
import fitting

# %matplotlib inline

# %%
folder = next(path for path in (Path("data/gold-ball"), Path("../data/gold-ball")) if path.exists())
print((folder / "scene.toml").read_text())
scene = brdf.Scene.load(folder / "scene.toml")
target = brdf.read_picture(folder / "target.exr")

# %% [markdown]
# ## The fit
#
# There is no start to give. For a given `n` the picture is linear in the coefficients, so the search is over `n` alone,
# from 0.1 to a million, and what it returns is the global optimum. `model="auto"`, the default, takes the simplest model
# that explains the picture.

# %%
result = fitting.fit(target, scene)
result

# %% [markdown]
# The same as text, as the command `brdf fit` prints it. Each number comes with its standard error; what a picture does
# not determine is said in words, never printed as if it were known. The table at the end shows which models were tried.

# %%
print(result)

# %% [markdown]
# OpenGL was given n = 51.2 and these coefficients:

# %%
gold = brdf.preset("gold")
print(gold)
print(f"n is off by {abs(float(result.material.n) / float(gold.n) - 1):.1e} of itself")

# %% [markdown]
# ## The fit, to turn
#
# Drag on the ball: the highlight follows. Drag beside it: the view turns. The two white lines wipe target, fit and residual
# over each other, the sliders carry the 95 % intervals. It needs no kernel, and `result.view().save("page.html")` writes
# it as a file.

# %%
result.view()

# %% [markdown]
# ## Is it plausible?
#
# Classic Blinn-Phong never is. The check says why, from which angle on, and what the nearest plausible material is.

# %%
report = brdf.check(result.material, name="the fitted gold")
report

# %% [markdown]
# ## Files for other programs
#
# `result.save(folder)` writes JSON, Wavefront MTL, the fitted picture and the report. Other formats are an export away;
# each says what it cannot carry.

# %%
import tempfile

with tempfile.TemporaryDirectory() as out:
    result.save(out)
    for to in ("three", "gltf", "mitsuba", "glsl"):
        export = brdf.save_export(result.material, Path(out) / f"gold.{to}", to=to, name="gold")
        print(f"{to}:", *export.losses or ["carries everything"], sep="\n    ")
    print(*sorted(path.name for path in Path(out).iterdir()))

# %% [markdown]
# ## The residual map
#
# Target and fit look alike; what tells is their difference. It is four orders of magnitude below the picture: what is
# left are the half floats of the file and the faces that OpenGL drew the ball with. A residual with a *shape* would say
# that the model is wrong, see notebook 6.

# %%
result.plot()
