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
# # 4. Is it plausible?
#
# *`make lab` opens this notebook in Jupyter; it is kept as text, a double click on it opens it as a notebook.*
#
# A surface that a physically based renderer may use has to be **positive** (no negative light), **reciprocal** (light and
# viewer may change places) and **energy conserving** (not more light comes back than arrives). `brdf.check` tests all
# three, with a bound on its own numerical error.

# %%
import jax.numpy as jnp
import numpy as np

import brdf
import fitting

# %matplotlib inline

# %% [markdown]
# ## The classic form fails
#
# Divide the light and the cosine out of the shading equation and the BRDF is left: $f_r = [k_d + k_s\,S/(N{\cdot}L)]/\pi$.
# The classic $S$ has no factor $N{\cdot}L$ to cancel that division. So the highlight grows without bound towards grazing
# light, and light and viewer do not enter alike.

# %%
classic = brdf.BlinnPhong(k_d=0.4, k_s=0.4, n=30)
report = brdf.check(classic, name="classic Blinn-Phong")
report

# %%
fitting.overview(classic, report)

# %% [markdown]
# ## The normalised form passes
#
# It multiplies the lobe by $N{\cdot}L$ and by a constant that makes it reflect all light at normal incidence. Then
# $k_d + k_s \le 1$ is all there is to obey. `nearest_normalized` finds the one that looks most alike.

# %%
plausible = brdf.nearest_normalized(classic)
plausible

# %%
brdf.check(plausible, name="its nearest plausible form")

# %% [markdown]
# How much light is lost in the surface is one minus the albedo:

# %%
angles = np.radians([0, 30, 60, 85])
for angle, albedo in zip(np.degrees(angles), np.asarray(brdf.directional_albedo(plausible, angles)), strict=True):
    print(f"light at {angle:2.0f}°: {100 * (1 - float(albedo[0])):.1f} % absorbed")

# %% [markdown]
# ## Constants that are often used, and wrong
#
# $(n+8)/(8\pi)$ reflects more than arrives; $(n+2)/(2\pi)$ normalises the distribution of facets, not a BRDF.


# %%
def half_vector_lobe(constant):
    """f_r = constant(n) (N.H)^n at n = 10, in 1/sr."""

    def f_r(to_light, to_view):
        half = to_light + to_view
        cosine = half[2] / jnp.sqrt(jnp.sum(half**2))
        return constant(10.0) * cosine[None] ** 10.0

    return f_r


for name, constant in {
    "(n+8)/(8 pi)": lambda n: (n + 8) / (8 * jnp.pi),
    "(n+2)/(2 pi)": lambda n: (n + 2) / (2 * jnp.pi),
    "(n+2)(n+4)/(8 pi (2^(-n/2) + n))": lambda n: (n + 2) * (n + 4) / (8 * jnp.pi * (2 ** (-n / 2) + n)),
}.items():
    energy = brdf.check(half_vector_lobe(constant), name=name).energy
    print(f"{name:34} {energy.verdict}: the largest albedo is {energy.value:.4f}")

# %% [markdown]
# ## A BRDF of your own
#
# Any function of two directions can be checked, in the local frame whose +z axis is the normal. Here an attempt at
# velvet: brighter towards the rim. Change it and see.


# %%
def velvet(to_light, to_view):
    """A matt surface with a sheen that grows towards the rim, as a function of the viewer alone."""
    sheen = (1.0 - to_view[2]) ** 3
    return jnp.array([0.5, 0.1, 0.2]) / jnp.pi + 0.3 * sheen


velvet_report = brdf.check(velvet)
velvet_report

# %% [markdown]
# The sheen depends on the viewer alone, so changing places changes the value. Let it depend on both alike:


# %%
def better_velvet(to_light, to_view):
    """The same with light and viewer on an equal footing."""
    sheen = ((1.0 - to_view[2]) * (1.0 - to_light[2])) ** 1.5
    return jnp.array([0.5, 0.1, 0.2]) / jnp.pi + 0.3 * sheen


better_report = brdf.check(better_velvet)
better_report

# %%
fitting.overview(better_velvet, better_report)
