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
# # 5. Speed against accuracy
#
# *`make lab` opens this notebook in Jupyter; it is kept as text, a double click on it opens it as a notebook.*
#
# How many pixels, how many light samples, which precision? The answer depends on the scene, so the toolkit measures it
# there. A word on the times below: they were taken while this page was made, on whatever else the machine had to do;
# compare them with each other, not with yours.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import brdf
import fitting

# %matplotlib inline

# %%
size = 1200
camera = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(size, size))
material = brdf.BlinnPhong(k_d=[0.5, 0.4, 0.3], k_s=[0.4, 0.4, 0.4], n=40.0)


def scene_of(light):
    """A ball under a light."""
    return brdf.Scene(camera=camera, shapes=(brdf.Sphere(center=[0, 0, 0], radius=1),), lights=(light,))


lamp = scene_of(brdf.DirectionalLight(direction=[0.4, 0.5, 0.8], intensity=[0.9]))
target = np.asarray(brdf.render(material, lamp, precision="float64"))
target = target + np.random.default_rng(0).normal(0, 0.01, target.shape)

# %% [markdown]
# ## Say how accurate, and no more is computed
#
# `accuracy` is the relative error of the fitted numbers that is good enough, over and above that of using all pixels. The
# fit looks at a few pixels, estimates what the others would change, and takes more until the estimate holds; up to a
# megapixel it looks at all of them at once. It says what it chose.

# %%
full = fitting.fit(target, lamp, model="blinn-phong", precision="float64")
for accuracy in (1e-1, 1e-3):
    fast = fitting.fit(target, lamp, model="blinn-phong", accuracy=accuracy)
    off = abs(float(fast.material.n) / float(full.material.n) - 1)
    print(
        f"accuracy {accuracy:g}: {fast.choice.pixels} of {fast.choice.of_pixels} pixels, "
        f"estimated error {fast.choice.chosen.error:.1e}, of n in fact {off:.1e}"
    )

# %% [markdown]
# ## Light samples
#
# A rectangle of light is a sum over samples. Four times the samples are four times the work; what do they buy? Here
# the picture's error against 256 samples, for a matt surface, a broad highlight and a sharp one.

# %%
counts = [1, 4, 16, 64]
small = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(64, 64))


def lit_by(samples):
    """A ball under a square lamp of so many samples."""
    lamp = brdf.RectangleLight(
        center=[1, 1.5, 2.5], edge_u=[0, 0.5, -0.3], edge_v=[0.6, 0, 0], radiance=[10.0], samples=samples
    )
    return brdf.Scene(camera=small, shapes=(brdf.Sphere(center=[0, 0, 0], radius=1),), lights=(lamp,))


surfaces = {
    "matt": brdf.Lambert(k_d=[0.6]),
    "n = 40": brdf.BlinnPhong(k_d=[0.3], k_s=[0.4], n=40),
    "n = 4000": brdf.BlinnPhong(k_d=[0.3], k_s=[0.4], n=4000),
}
errors = {}
for name, surface in surfaces.items():
    reference = np.asarray(brdf.render(surface, lit_by(256), precision="float64"))
    errors[name] = [
        np.sqrt(np.mean((np.asarray(brdf.render(surface, lit_by(count), precision="float32")) - reference) ** 2))
        / np.sqrt(np.mean(reference**2))
        for count in counts
    ]
figure, ax = plt.subplots(figsize=(5.5, 3.4), layout="constrained")
for (name, values), style in zip(errors.items(), ("o-", "s--", "^:"), strict=True):
    ax.loglog(counts, values, style, label=name)
ax.set(xlabel="samples of the light", ylabel="error of the picture (rms, relative)")
_ = ax.legend()

# %% [markdown]
# ## Everything at once: `fitting.tradeoff`
#
# It varies what the scene has, and only that, in an order that drift of the machine cannot favour, and marks the
# cheapest configuration that is accurate enough.

# %%
table = fitting.tradeoff(target, lamp, seconds=20.0)
for row in table.rows:
    if table.marks(row):
        print(f"{row.name:<62}{1e3 * row.seconds:8.1f} ms  {row.error:.0e}  {table.marks(row)}")
table.plot()

# %% [markdown]
# Area lights and maps of the sky take longer to measure: each number of light samples is another program to compile.
# These two were measured by `python -m benchmarks.tradeoff_fronts`, at 512² with 1 % noise.

# %%
folder = next(path for path in (Path("benchmarks"), Path("../benchmarks")) if path.exists())
figure, axes = plt.subplots(1, 2, figsize=(13, 4.6), layout="constrained")
for ax, (name, light) in zip(axes, (("area light", "area"), ("sky", "environment")), strict=True):
    ax.imshow(plt.imread(folder / f"front_{light}.png"))
    ax.set_title(name)
    ax.set_axis_off()

# %% [markdown]
# **One directional light.** The time of a fit hardly hangs on the number of pixels below some ten thousand, so there is
# no reason to go below 1000 of them, and of a clean picture 1000 tell as much as all. With noise the error falls as one
# over the root of their number: `accuracy=1e-2` is enough for a preview, the default for a result. float64 costs half
# as much again and matters for exponents above 10 000.
#
# **An area light.** The time is pixels times light samples. A sample of the pixels is worth more than ever, and light
# samples matter by the narrowness of the highlight against the lamp: 16 left 1e-3 for n = 60, 32 left 7e-3 and 64 2e-5
# for n = 400. Leave the choice to `accuracy`: it takes more of them only while they still change the answer.
#
# **A map of the sky.** Its light has no edge, so the error falls slowly: for n = 60 256 samples left 3e-2, 1024 left
# 2e-3. Take some thousand pixels before many samples, `accuracy=1e-1` or 1e-2 first; then look whether it matters.

# %% [markdown]
# ## Stable at the extremes
#
# Measured materials have exponents from 1 to 121 000. A lobe of n = 1e6 is a thousandth of a radian wide; in single
# precision `pow(dot(N, H), n)` is off by 6 % there, because the cosine next to 1 has no digits left. The toolkit never
# forms that cosine. `python -m benchmarks.stability` draws the error of float32 against float64 over exponent and angle of
# the light, for every model, and whether every derivative is finite: it is 2e-7 of the peak at most, and they are.

# %%
normal = np.array([0.0, 0.0, 1.0], np.float32)
for n in (1e2, 1e4, 1e6):
    angle = 1 / np.sqrt(n)
    half = np.array([np.sin(angle), 0, np.cos(angle)], np.float32)
    exact = np.float64(half[2]) / np.sqrt(np.sum(np.float64(half) ** 2))
    naive = float(np.power(half[2], np.float32(n)))
    ours = float(brdf.BlinnPhong(k_d=0, k_s=1, n=n).specular(normal, half, half))
    print(f"n = {n:9.0f}: pow in float32 is off by {abs(naive - exact**n):.1e}, ours by {abs(ours - exact**n):.1e}")
