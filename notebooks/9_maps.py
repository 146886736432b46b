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
# # 9. Maps: a material for every pixel
#
# *`make lab` opens this notebook in Jupyter; it is kept as text, a double click on it opens it as a notebook.*
#
# A camera that stands still, a thing that lies still, and one lamp after the other: what museums call RTI and labs
# photometric stereo. The photographs of one pixel are then photographs of one point under many lights, and
# `fitting.fit_maps` finds $k_d$, $k_s$, $n$ and the normal of each. Here the thing is made up, so that the truth is
# known: a matt board with waves, and on it glossy strips, each duller than the one before.

# %%
import matplotlib.pyplot as plt
import numpy as np

import brdf
import fitting

# %matplotlib inline

# %%
size, count = 96, 32
x, y = np.meshgrid(np.linspace(-1, 1, size), np.linspace(1, -1, size))
slope = 0.25 * np.cos(6 * x) * np.cos(5 * y), -0.2 * np.sin(6 * x) * np.sin(5 * y)
normal = np.stack([-slope[0], -slope[1], np.ones_like(x)], axis=-1)
normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
strip = np.clip(np.floor(3 * (x + 1)), 0, 5)
exponent = 200 * 0.55**strip
k_d = np.stack([0.25 + 0.1 * strip / 5, 0.2 + 0 * x, 0.45 - 0.05 * strip], axis=-1)
k_s = np.where(np.abs(y) < 0.8, 0.4, 0.0)

turn = np.arange(count) + 0.5
up, around = 0.3 + 0.7 * turn / count, np.pi * (1 + 5**0.5) * turn
to_light = np.stack([np.sqrt(1 - up**2) * np.cos(around), np.sqrt(1 - up**2) * np.sin(around), up], axis=1)


def photograph(light, noise=0.01):
    """The equation itself: Blinn-Phong under one distant light, seen from above, with noise."""
    half = np.array([0, 0, 1]) + light
    lobe = np.maximum(normal @ (half / np.linalg.norm(half)), 0) ** exponent
    clean = k_d * np.maximum(normal @ light, 0)[..., None] + (k_s * lobe)[..., None]
    return clean + noise * np.random.default_rng(int(1e6 * light[0]) % 2**31).normal(size=clean.shape)


photographs = np.stack([photograph(light) for light in to_light])
figure, axes = plt.subplots(1, 4, figsize=(12, 3), layout="constrained")
for place, picture in zip(axes, photographs[::9], strict=True):
    place.imshow(brdf.displayed(picture))
    place.set_axis_off()

# %% [markdown]
# ## Normals known
#
# From a scanner, or from elsewhere. All numbers of all texels are found in one go, each the global optimum with its
# standard error; where the photographs cannot tell, a map is empty and says why. Here that is above and below the
# strips, where nothing is glossy.

# %%
maps = fitting.fit_maps(photographs, to_light, normal, specular="grey")
maps

# %%
maps.plot()

# %% [markdown]
# ## Normals sought
#
# `normals="fit"` finds them with the material. The angle to the true ones is what the maps say it would be.

# %%
found = fitting.fit_maps(photographs, to_light, "fit", specular="grey")
angle = np.degrees(np.arccos(np.clip(np.sum(found.normal * normal, axis=-1), -1, 1)))
f"median angle to the truth {np.median(angle):.2f}°, foretold {np.median(found.normal_error):.2f}°"

# %% [markdown]
# ## An n that texels share
#
# Who knows that a strip is one material gives its pixels one label. Their sums are added up, and $n$ is as sure as all
# of them together make it.

# %%
labels = np.where(k_s > 0, strip + 1, 0).astype(int)
shared = fitting.fit_maps(photographs, to_light, normal, specular="grey", labels=labels)
for label in range(1, 7):
    one, own = shared.n[labels == label][0], maps.n[labels == label]
    print(
        f"strip {label}: truth {exponent[labels == label][0]:6.1f}, shared {one:6.1f} "
        f"± {shared.n_error[labels == label][0]:.2f}, each texel by itself ± {np.nanmedian(maps.n_error[labels == label]):.1f}"
    )

# %% [markdown]
# ## Another light
#
# `maps.render` lights the thing anew, and `maps.view()` is a page where the light follows the mouse. `maps.save` writes
# the maps for other programs (OpenEXR layers, 16-bit PNGs, a glTF material, OpenLIME). On the command line all of this is
# `brdf maps photographs/ --out maps/ --report page.html`.

# %%
unseen = np.array([0.45, 0.2, 0.87])
figure, axes = plt.subplots(1, 2, figsize=(7, 3.2), layout="constrained")
for place, picture, title in zip(
    axes, (photograph(unseen), maps.render(unseen)), ("photograph", "from the maps"), strict=True
):
    place.imshow(brdf.displayed(picture))
    place.set_axis_off()
    place.set_title(title)
