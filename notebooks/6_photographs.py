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
# # 6. Photographs
#
# *`make lab` opens this notebook in Jupyter; it is kept as text, a double click on it opens it as a notebook.*
#
# Real pictures are not renders: lights are known roughly, surfaces do not follow a formula, light comes back from the
# table. What does a fit say then, and how sure is it?
#
# With the project's data folder beside it, this notebook takes photographs of a real glossy ball (DiLiGenT benchmark,
# Shi et al. 2016) under eight of its lamps. Without, it makes a stand-in with the toolkit's own renderer: two lobes, of
# which a fit with one must miss something, and camera noise. It says which.

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import brdf
import fitting

# %matplotlib inline

# %%
folder = Path(os.environ.get("BRDF_REAL_DATA", "../shared/data"))
photographs = folder / "diligent-ball" / "ball_crop_uint16.npz"
chosen = range(3, 96, 12)


def real_ball():
    """Eight photographs: linear values divided by the lamp's intensity, normals, what counts, directions of the lamps."""
    with np.load(photographs) as data:
        intensity = data["light_intensities"][chosen]
        codes = data["images"][chosen]
        pictures = codes / 65535.0 / intensity[:, None, None, :]
        counts = data["mask"] & np.all(codes < 65535, axis=-1)  # the middle of the highlight is clipped
        return pictures, data["normal"], counts, data["light_dirs"][chosen]


def own_ball():
    """A stand-in: a broad lobe and a sharp one on a ball, with noise, under eight lamps."""
    place = (np.arange(146) + 0.5) / 146 * 2.06 - 1.03
    x, y = np.meshgrid(place, -place)
    height = 1 - x**2 - y**2
    normal = np.where((height > 0)[..., None], np.stack([x, y, np.sqrt(np.maximum(height, 0))], -1), 0.0)
    around = np.arange(8) * 2 * np.pi / 8
    directions = np.stack([0.6 * np.cos(around), 0.5 * np.sin(around), np.full(8, 0.75)], -1)
    points = brdf.SurfacePoints.from_normals(normal)
    broad = brdf.BlinnPhong(k_d=[0.12, 0.1, 0.08], k_s=[0.04] * 3, n=150)
    sharp = brdf.BlinnPhong(k_d=[0.0] * 3, k_s=[0.9] * 3, n=2500)
    rng = np.random.default_rng(2)
    pictures = []
    for direction in directions:
        lit = brdf.Scene(points=points, lights=(brdf.DirectionalLight(direction=direction, intensity=[1.0]),))
        clean = sum(np.asarray(brdf.render(one, lit, precision="float64")) for one in (broad, sharp))
        pictures.append(clean + rng.normal(0, 0.003, clean.shape))
    return np.array(pictures), normal, np.broadcast_to(height > 0, (8, 146, 146)), directions


pictures, normal, counts, directions = real_ball() if photographs.exists() else own_ball()
print("photographs of the DiLiGenT ball" if photographs.exists() else "no data folder: pictures of our own renderer")

# %% [markdown]
# A scene needs no camera where the normals are known: each pixel is given its own.

# %%
points = brdf.SurfacePoints.from_normals(normal)
scenes = [
    brdf.Scene(points=points, lights=(brdf.DirectionalLight(direction=direction, intensity=[1.0]),))
    for direction in directions
]
targets = [picture.astype(np.float32) for picture in pictures]
masks = list(counts)

# %% [markdown]
# ## All at once, and no start to give
#
# The sharp highlight is a few pixels wide. A local search that starts at n = 10 never sees it and ends at a broad lobe;
# the search over all of log n does not care.

# %%
result = fitting.fit(targets, scenes, mask=masks)
print(result)

# %% [markdown]
# The middle of the highlight is clipped in some photographs: those pixels say "at least", not "so much". They were left
# out. Taken for data, these few change the answer:

# %%
clipped = sum(int(np.sum(np.any(normal != 0, axis=-1) & ~mask)) for mask in masks)
naive = fitting.fit(targets, scenes, model=result.material.name)
print(f"n = {float(naive.material.n):.4g} with {clipped} clipped pixels, {float(result.material.n):.4g} without them")

# %% [markdown]
# ## How sure is it?
#
# The standard errors come from the scatter of the residual, as if the model were true. Where it is not, neighbouring
# residuals are alike, and the report warns. Another answer to "how sure" needs no theory: leave a photograph out, and see
# how far the numbers move.

# %%
for warning in result.warnings:
    print("warning:", warning)
print(f"correlation of neighbouring residuals: {result.structure:.2f} (0 for noise)")
model = result.material.name
others = []
for left in range(0, len(targets), 2):
    few = fitting.fit(
        *([*one[:left], *one[left + 1 :]] for one in (targets, scenes)),
        model=model,
        mask=[*masks[:left], *masks[left + 1 :]],
    )
    others.append([float(few.material.n), *np.asarray(few.material.k_d), *np.asarray(few.material.k_s)])
others = np.array(others)
error = next((parameter.error for parameter in result.parameters if parameter.name == "n"), None)
print(
    f"n = {float(result.material.n):.4g}, by the formula ± {error or float('nan'):.2g}; "
    f"with one photograph left out {others[:, 0].min():.4g} to {others[:, 0].max():.4g}"
)

# %% [markdown]
# ## What does the scene require?
#
# The table lists every model that was tried, simplest first, with the error expected on pixels that were not looked at.
# A model is adequate when a better one gains no more than chance. Here is the residual that each kind leaves:

# %%
kinds = ["lambert", "phong", "blinn-phong"]
residuals = [fitting.fit(targets, scenes, model=kind, mask=masks).residual for kind in kinds]
figure, ax = plt.subplots(figsize=(5, 2.4), layout="constrained")
ax.barh(kinds, 100 * np.array(residuals), color=["#56B4E9", "#E69F00", "#0072B2"])
_ = ax.set_xlabel("residual, % of the pictures (rms)")

# %% [markdown]
# ## The picture and what is missing
#
# The residual has the shape of the highlight, so the real one is not a power of a cosine. Around its core the photograph is
# brighter than the fit: highlights of real materials, and of real lenses, have a wider skirt than one lobe can follow.

# %%
result.plot(2)
