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
# # 3. Lights
#
# *`make lab` opens this notebook in Jupyter; it is kept as text, a double click on it opens it as a notebook.*
#
# Every light ends in light samples, a direction and an intensity at a surface point. *Intensity* is the radiance that a
# white Lambertian surface facing the light shows; an irradiance is π times that. A rendering sums over the samples that a
# point can see.

# %%
import time

import matplotlib.pyplot as plt
import numpy as np

import brdf

# %matplotlib inline

# %% [markdown]
# ## The six kinds
#
# A ball before a wall under each of them. Shadows are hard under a light without extent and soften by themselves under
# one that has it; nothing else is switched on for that. (A rectangle shines to one side, along `edge_u` × `edge_v`.)

# %%
camera = brdf.PerspectiveCamera(position=[0, 0.6, 6.0], target=[0, 0, 0], up=[0, 1, 0], fov=32, resolution=(144, 144))
shapes = (
    brdf.Sphere(center=[0.25, -0.1, 0], radius=0.8),
    brdf.Rectangle(center=[0, 0, -1.3], edge_u=[3, 0, 0], edge_v=[0, 3, 0]),
)
material = brdf.BlinnPhong(k_a=[0.6, 0.45, 0.3], k_d=[0.6, 0.45, 0.3], k_s=[0.3, 0.3, 0.3], n=60)


def sky(height=32):
    """A blue sky over brown ground, with a low sun."""
    up = np.cos((np.arange(height) + 0.5) * np.pi / height)[:, None, None]
    pixels = np.where(up > 0, [0.25, 0.35, 0.6], [0.12, 0.09, 0.06]) * np.ones((height, 2 * height, 1))
    pixels[9:11, 20:22] = [60.0, 50.0, 35.0]
    return pixels


place = np.array([-1.6, 1.8, 2.6])
lights = {
    "directional": brdf.DirectionalLight(direction=place, intensity=[0.9]),
    "point": brdf.PointLight(position=place, intensity=[10.0]),
    "spot": brdf.SpotLight(
        position=place, direction=-place + [0.1, -0.1, 0], intensity=[11.0], cutoff_angle=25, exponent=10
    ),
    "rectangle": brdf.RectangleLight(
        center=place, edge_u=[0.2, 0.5, -0.25], edge_v=[0.55, 0, 0.35], radiance=[32.0], samples=64
    ),
    "sphere": brdf.SphereLight(center=place, radius=0.5, radiance=[40.0], samples=64),
    "environment": brdf.EnvironmentMap(sky(), samples=1024),
}


def scene_of(*given, ambient=None, **changes):
    """The ball and the wall under these lights."""
    return brdf.Scene(**({"camera": camera, "shapes": shapes, "ambient": ambient, "lights": given} | changes))


figure, axes = plt.subplots(2, 3, figsize=(8, 5.6), layout="constrained")
for ax, (name, light) in zip(axes.flat, lights.items(), strict=True):
    image = np.asarray(brdf.render(material, scene_of(light), precision="float32"))
    ax.imshow(brdf.displayed(image, white=max(float(np.quantile(image, 0.999)), 0.6)))
    ax.set_title(name, fontsize=10)
    ax.set_axis_off()

# %% [markdown]
# ## Hard and soft shadows
#
# The same lamp, larger and larger, at the same power: the half shadow grows, the highlight becomes the picture of the lamp.

# %%
radii = [0.05, 0.3, 0.9]
figure, axes = plt.subplots(1, 3, figsize=(8, 2.9), layout="constrained")
for ax, radius in zip(axes, radii, strict=True):
    lamp = brdf.SphereLight(center=place, radius=radius, radiance=[10.0 / radius**2], samples=128)
    ax.imshow(brdf.displayed(np.asarray(brdf.render(material, scene_of(lamp), precision="float32"))))
    ax.set_title(f"sphere light, radius {radius:g}", fontsize=10)
    ax.set_axis_off()

# %% [markdown]
# ## Light is linear
#
# A picture under several lights is the sum of the pictures under each. So one picture per light is enough for every
# recolouring of the lamps, afterwards and at no cost (Haeberli 1992).

# %%
three = scene_of(
    brdf.DirectionalLight(direction=[-1.0, 0.6, 0.8], intensity=[0.5]),
    brdf.DirectionalLight(direction=[1.0, 0.5, 0.6], intensity=[0.5]),
    brdf.PointLight(position=[0.2, 2.5, 1.5], intensity=[4.0]),
)
images = brdf.render_lights(material, three, precision="float32")
whole = np.asarray(brdf.render(material, three, precision="float32"))
print(f"sum of the pictures against the picture of the sum: {np.abs(np.sum(images, 0) - whole).max():.1e}")

moods = {
    "as it was": [[1, 1, 1]] * 3,
    "evening": [[2.2, 1.1, 0.3], [0.15, 0.25, 0.7], [0, 0, 0]],
    "stage": [[0.2, 0.2, 2.0], [2.0, 0.2, 0.6], [0.8, 0.8, 0.3]],
}
start = time.perf_counter()
relit = {name: np.asarray(brdf.relight(images, np.array(factors, np.float32))) for name, factors in moods.items()}
print(f"three recolourings, compiled and done, in {1000 * (time.perf_counter() - start):.0f} ms")
figure, axes = plt.subplots(1, 3, figsize=(8, 2.9), layout="constrained")
for ax, (name, image) in zip(axes, relit.items(), strict=True):
    ax.imshow(brdf.displayed(image))
    ax.set_title(name, fontsize=10)
    ax.set_axis_off()

# %% [markdown]
# ## Ambient light is a stand-in
#
# Light that has been reflected by other things comes from everywhere. The classic equation puts one constant in its
# place, $k_a I_a$, which knows no normal and no shadow. An environment of constant radiance does it properly: on a lone
# white ball the two agree exactly, and where ball and wall hide the sky from each other they cannot.

# %%
white = brdf.Lambert(k_a=[1.0], k_d=[1.0])
ambient = np.asarray(brdf.render(white, scene_of(ambient=[0.5]), precision="float32"))
around = brdf.ConstantEnvironment(radiance=[0.5], samples=256)
dome = np.asarray(brdf.render(white, scene_of(around), precision="float32"))
alone = np.asarray(brdf.render(white, scene_of(around, shapes=shapes[:1]), precision="float32"))
print(
    f"a lone white ball under a constant sky of 0.5 shows {alone.max():.4f} at most, "
    f"{alone[72, 72, 0]:.4f} in the middle"
)

figure, axes = plt.subplots(1, 3, figsize=(8.6, 2.9), layout="constrained")
for ax, image, title in ((axes[0], ambient, "ambient term"), (axes[1], dome, "constant environment")):
    ax.imshow(brdf.displayed(image))
    ax.set_title(title, fontsize=10)
shadow = axes[2].imshow(dome[..., 0] / 0.5, cmap="cividis", vmin=0, vmax=1)
axes[2].set_title("share of the light that arrives", fontsize=10)
figure.colorbar(shadow, ax=axes[2])
for ax in axes:
    ax.set_axis_off()
