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
# # 8. The next light
#
# *`make lab` opens this notebook in Jupyter; it is kept as text, a double click on it opens it as a notebook.*
#
# One photograph, and its exponent is known to so and so many per cent. Where should the lamp stand for the next one?
# What a picture would tell about each number is known before it is taken: it is in the derivatives of the fitted
# material. `fitting.next_light` adds that up and says where the error of n shrinks most.

# %%
import matplotlib.pyplot as plt
import numpy as np

import brdf
import fitting

# %matplotlib inline

# %%
camera = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(64, 64))
ball = brdf.Sphere(center=[0, 0, 0], radius=1)
truth = brdf.BlinnPhong(k_d=[0.4, 0.3, 0.2], k_s=[0.2, 0.2, 0.2], n=60)
rng = np.random.default_rng(0)


def lit_from(direction):
    return brdf.Scene(camera=camera, shapes=[ball], lights=[brdf.DirectionalLight(direction=direction, intensity=1.0)])


def photograph(scene):
    clean = np.asarray(brdf.render(truth, scene))
    return clean + 0.03 * rng.standard_normal(clean.shape).astype(np.float32)


first = lit_from([0.9, 0.3, -0.2])
result = fitting.fit(photograph(first), first, model="blinn-phong")
result["n"]

# %% [markdown]
# The lamp stands beside the ball, and its highlight is a sliver at the rim. Each point of the picture is a direction
# towards a further lamp, seen from the camera; the colour is the error of n that one more photograph would leave.

# %%
choice = fitting.next_light(result)
print(choice)
choice.plot()

# %% [markdown]
# ## Chosen, and at random
#
# Six photographs, each under the light that the fit of those before it asks for, against lights at random from the same
# hemisphere.


# %%
def errors(choose, lights=6):
    scenes = [first]
    pictures = [photograph(first)]
    found = []
    while True:
        fit = fitting.fit(pictures, scenes, model="blinn-phong")
        found.append(fit["n"].error or np.nan)
        if len(scenes) == lights:
            return found
        scenes.append(lit_from(choose(fit)))
        pictures.append(photograph(scenes[-1]))


def at_random(fit):
    direction = rng.standard_normal(3)
    return np.array([*direction[:2], abs(direction[2])])


asked = errors(lambda fit: fitting.next_light(fit).direction)
drawn = [errors(at_random) for _ in range(4)]

# %% [markdown]
# All lines fall, since every photograph tells something; the chosen lights are there about a photograph earlier. What is
# foretold holds for the model and the noise that the fit found: a lamp in the way of the camera, interreflection and
# shadows that the scene does not know are not in it.

# %%
counts = np.arange(1, 7)
figure, axes = plt.subplots(figsize=(5, 3.4), layout="constrained")
for line in drawn:
    axes.loglog(counts, line, color="#56B4E9", linewidth=0.8)
axes.loglog(counts, np.nanmedian(drawn, axis=0), "o--", color="#0072B2", label="at random: four draws, their median")
axes.loglog(counts, asked, "o-", color="#D55E00", label="chosen by next_light")
axes.set(xlabel="lights", ylabel="standard error of n", title="what each further light is worth")
axes.legend()
figure
