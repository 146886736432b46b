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
# # 7. Differentiable
#
# *`make lab` opens this notebook in Jupyter; it is kept as text, a double click on it opens it as a notebook.*
#
# `brdf.render` is a JAX function: it can be differentiated by every number in material and scene. And a fit can be
# differentiated too, without differentiating its search.

# %%
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import brdf
import fitting

# %matplotlib inline

# %%
camera = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(128, 128))


def scene(direction):
    """A ball under one lamp."""
    light = brdf.DirectionalLight(direction=direction, intensity=[0.9])
    return brdf.Scene(camera=camera, shapes=(brdf.Sphere(center=[0, 0, 0], radius=1),), ambient=[0.2], lights=(light,))


direction = np.array([0.4, 0.5, 0.8])
material = brdf.BlinnPhong(k_a=[0.3, 0.2, 0.1], k_d=[0.5, 0.35, 0.2], k_s=[0.4, 0.4, 0.4], n=30.0)

# %% [markdown]
# ## Gradients through the renderer
#
# What does each pixel do when the exponent grows, or when the lamp moves to the right? Forward mode gives a whole picture
# of derivatives in one pass.

# %%
by_n = jax.jvp(lambda n: brdf.render(eqx.tree_at(lambda m: m.n, material, n), scene(direction)), (30.0,), (1.0,))[1]


def lit_from(place):
    """The picture under a lamp at a place that JAX may vary."""
    return brdf.render(material, eqx.tree_at(lambda s: s.lights[0].direction, scene(direction), place))


by_light = jax.jvp(lit_from, (jnp.asarray(direction),), (jnp.array([1.0, 0.0, 0.0]),))[1]

figure, axes = plt.subplots(1, 3, figsize=(9, 2.9), layout="constrained")
axes[0].imshow(brdf.displayed(np.asarray(brdf.render(material, scene(direction)))))
axes[0].set_title("the picture")
for ax, values, title in ((axes[1], by_n, "its derivative by n"), (axes[2], by_light, "by the light's x")):
    red = np.asarray(values)[..., 0]
    limit = np.quantile(np.abs(red), 0.995)
    image = ax.imshow(red, cmap="cividis", vmin=-limit, vmax=limit)
    ax.set_title(title)
    figure.colorbar(image, ax=ax)
for ax in axes:
    ax.set_axis_off()

# %% [markdown]
# ## Finding a light from a picture
#
# Somebody says that the lamp is at (0.25, 0.6, 0.8). It is not, and the fit tells: the residual has the shape of a
# highlight in the wrong place. Free the direction together with the material, starting from the separable optimum.

# %%
rng = np.random.default_rng(1)
clean = np.asarray(brdf.render(material, scene(direction), precision="float64"))
target = clean + rng.normal(0, 0.01, clean.shape)

wrong = scene([0.25, 0.6, 0.8])
first = fitting.fit(target, wrong, model="blinn-phong")
found = fitting.fit_jointly(
    target, wrong, first.material, lambda m, s: (m.k_a, m.k_d, m.k_s, m.n, s[0].lights[0].direction)
)


def unit(vector):
    """Of length 1."""
    return np.asarray(vector) / np.linalg.norm(vector)


def degrees_between(a, b):
    """The angle between two directions."""
    return np.degrees(np.arccos(np.clip(unit(a) @ unit(b), -1, 1)))


place = found.scenes[0].lights[0].direction
print(f"residual with the wrong light {100 * first.residual:.1f} %, with the found one {100 * found.residual:.2f} %")
print(
    f"the light was off by {degrees_between([0.25, 0.6, 0.8], direction):.1f}°, is off by "
    f"{degrees_between(place, direction):.3f}° after {found.steps} steps; n = {float(found.material.n):.2f}, truth 30"
)

# %% [markdown]
# ## Through the fit: how the fitted n moves when a light moves
#
# A fit takes the light as known. How much does an error of that knowledge matter? At the optimum the gradient of the
# cost by the unknowns is zero, whatever the light; the implicit function theorem turns that into the derivative of the
# fitted numbers by the light, from one Hessian, with no step size and without a look at the search.

# %%
result = fitting.fit(target, scene(direction), model="blinn-phong", precision="float64")
(moves,) = fitting.sensitivity(result, lambda scenes: (scenes[0].lights[0].direction,))
print("dn / d(direction) =", moves.n)

# %% [markdown]
# The derivative along the direction itself is zero, as it should be: a longer vector is the same lamp. Across it, a
# degree of error costs this much of n, where the standard error from the noise is

# %%
right = unit(np.cross([0, 1, 0], direction))
up = unit(np.cross(direction, right))
degree = np.radians(1) * np.linalg.norm(direction)
for name, axis in (("to the right", right), ("upwards", up)):
    print(f"a degree {name}: n changes by {float(moves.n @ axis) * degree:+.3f}")
print(f"standard error of n: {next(p.error for p in result.parameters if p.name == 'n'):.3f}")

# %% [markdown]
# ## Against fits at shifted lights
#
# The line is the derivative, the points are fits of the same picture under a lamp that was moved. They agree near the
# middle; farther out the fit bends, because a lamp in the wrong place blurs the highlight whichever way it is off.

# %%
shifts = np.linspace(-2, 2, 9)
refits = [
    float(
        fitting.fit(target, scene(direction + shift * degree * up), model="blinn-phong", precision="float64").material.n
    )
    for shift in shifts
]
step = 1e-3
there, back = (
    float(fitting.fit(target, scene(direction + s * step * up), model="blinn-phong", precision="float64").material.n)
    for s in (1, -1)
)
implicit, measured = float(moves.n @ up), (there - back) / (2 * step)
print(
    f"dn by implicit differentiation {implicit:.6f}, by fits at shifted lights {measured:.6f}, "
    f"relative difference {abs(implicit / measured - 1):.1e}"
)

figure, ax = plt.subplots(figsize=(6, 3.5), layout="constrained")
ax.plot(shifts, refits, "o", label="fits under a shifted lamp")
ax.plot(shifts, float(result.material.n) + implicit * degree * shifts, "-", label="implicit derivative")
ax.axhline(30, color="0.5", linewidth=0.8, linestyle=":", label="truth")
ax.set(xlabel="lamp moved up, degrees", ylabel="fitted n")
_ = ax.legend()
