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
# # 2. Lambert, Phong, Blinn-Phong
#
# *`make lab` opens this notebook in Jupyter; it is kept as text, a double click on it opens it as a notebook.*
#
# A point reflects $k_a I_a + \sum_i I_i\,[\,k_d\,(N{\cdot}L_i)_+ + k_s\,S(L_i, V)\,]$. The models differ in $S$ alone:
#
# | model | S | who draws it |
# | --- | --- | --- |
# | Lambert | 0 | everybody |
# | Phong | $(R{\cdot}V)_+^n$ | VTK, PyTorch3D |
# | Blinn-Phong | $(N{\cdot}H)_+^n$ | OpenGL, Wavefront MTL |
#
# $R$ is the mirror direction of the light, $H$ halves the angle between light and viewer.

# %%
import io
import statistics
import time

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import brdf

# %matplotlib inline


# %%
def ball_scene(size, direction=(-0.5, 0.6, 0.8)):
    """One ball, one lamp, a little ambient light."""
    camera = brdf.OrthographicCamera(
        position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.1, resolution=(size, size)
    )
    light = brdf.DirectionalLight(direction=direction, intensity=[0.8])
    ball = brdf.Sphere(center=[0, 0, 0], radius=1)
    return brdf.Scene(camera=camera, shapes=(ball,), ambient=[0.2], lights=(light,))


def picture(material, scene):
    """The picture as a screen shows it: linear light through the sRGB encoding."""
    return brdf.displayed(np.asarray(brdf.render(material, scene, precision="float32")))


# %% [markdown]
# ## The plastic look
#
# A white highlight on a coloured ball reads as plastic: light that is reflected at the surface keeps the lamp's colour,
# light that has been inside takes the pigment's. Metals have no inside to speak of, and their highlight is coloured.

# %%
scene = ball_scene(256)
orange = {"k_a": [0.6, 0.25, 0.05], "k_d": [0.6, 0.25, 0.05]}
looks = {
    "matt: Lambert": brdf.Lambert(**orange),
    "plastic: grey k_s": brdf.BlinnPhong(**orange, k_s=[0.45] * 3, n=60),
    "metal: coloured k_s": brdf.BlinnPhong(k_a=[0.2, 0.1, 0.03], k_d=[0.2, 0.1, 0.03], k_s=[0.8, 0.45, 0.15], n=30),
}
figure, axes = plt.subplots(1, 3, figsize=(8, 3), layout="constrained")
for ax, (name, material) in zip(axes, looks.items(), strict=True):
    ax.imshow(picture(material, scene))
    ax.set_title(name)
    ax.set_axis_off()

# %% [markdown]
# ## N·H against R·V: why $n_H \approx 4\,n_R$
#
# Turn the viewer by a small angle $a$ away from the mirror direction. Then $R$ and $V$ are $a$ apart, but $H$ moves only
# $a/2$ away from $N$. Near the peak $\cos^n a \approx e^{-n a^2/2}$, so half the angle needs four times the exponent for
# the same highlight, as the left picture shows. Across the plane of light and normal the two differ, the more the more
# grazing the light: there $H$ moves by $a/(2\cos\theta)$, so that Blinn-Phong's highlight is narrower than Phong's. It is
# why highlights on a wet road are tall and slim, and why Blinn-Phong draws them and Phong does not.

# %%
degrees = np.linspace(-29.9, 29.9, 401)  # 30 more, and the viewer is below the surface
theta = np.radians(60)
to_light = np.array([-np.sin(theta), 0, np.cos(theta)])
mirror = to_light * [-1, 1, 1]


def viewers(sideways):
    """Directions some degrees from the mirror direction: in the plane of light and normal, or across it."""
    turn = np.array([0.0, 1, 0]) if sideways else np.array([np.cos(theta), 0, -np.sin(theta)])
    angle = np.radians(degrees)[:, None]
    return np.cos(angle) * mirror + np.sin(angle) * turn


figure, axes = plt.subplots(1, 2, figsize=(8, 3), layout="constrained", sharey=True)
for ax, sideways in zip(axes, (False, True), strict=True):
    for label, material, style in (
        ("Phong, n = 10", brdf.Phong(k_d=0, k_s=1, n=10), ("-", "#0072B2")),
        ("Blinn-Phong, n = 40", brdf.BlinnPhong(k_d=0, k_s=1, n=40), ("--", "#D55E00")),
        ("Blinn-Phong, n = 10", brdf.BlinnPhong(k_d=0, k_s=1, n=10), (":", "#009E73")),
    ):
        shown = np.asarray(material.specular(np.array([0.0, 0, 1]), to_light, viewers(sideways)))
        ax.plot(degrees, shown, linestyle=style[0], color=style[1], label=label)
    ax.set(title="across that plane" if sideways else "in the plane of light and normal")
    ax.set_xlabel("viewer, degrees from the mirror direction")
axes[0].set_ylabel("S, light at 60°")
axes[0].legend(fontsize=8)

# %% [markdown]
# ## Sliders
#
# Where widgets run, the sliders draw the ball anew while you drag. One program is compiled, for the first frame; after
# that a frame of 512 × 512 pixels takes a fraction of the 50 ms that a hand notices.

# %%
large = ball_scene(512)


def frame(n, k_s=0.45, model=brdf.BlinnPhong):
    """One frame, as bytes of a PNG."""
    shown = picture(model(**orange, k_s=[k_s] * 3, n=n), large)
    file = io.BytesIO()
    Image.fromarray((255 * shown + 0.5).astype(np.uint8)).save(file, "png", compress_level=1)
    return file.getvalue()


try:
    import ipywidgets
    from IPython.display import display
except ImportError:
    print("ipywidgets is not installed: the picture below stands in for the sliders")
else:
    shown = ipywidgets.Image(value=frame(60), format="png", width=384)
    exponent = ipywidgets.FloatLogSlider(value=60, base=10, min=0, max=4, description="n")
    strength = ipywidgets.FloatSlider(value=0.45, min=0, max=1, description="k_s")
    which = ipywidgets.Dropdown(options={"Blinn-Phong": brdf.BlinnPhong, "Phong": brdf.Phong}, description="model")

    def redraw(change):
        shown.value = frame(exponent.value, strength.value, which.value)

    for widget in (exponent, strength, which):
        widget.observe(redraw, names="value")
    display(ipywidgets.VBox([exponent, strength, which, shown]))

# %%
frame(10)
times = []
for n in np.geomspace(1, 1e4, 25):
    start = time.perf_counter()
    frame(n)
    times.append(1000 * (time.perf_counter() - start))
print(f"a frame of 512 x 512 takes {statistics.median(times):.0f} ms in the median (render, encode, compress)")

# %% [markdown]
# ## What n does
#
# The exponent sets the width of the highlight, about $1/\sqrt{n}$ radians, and nothing else: the classic forms keep its
# height at $k_s$, so that a large $n$ makes a *darker* surface. The normalised forms (notebook 4) keep the reflected
# energy instead. Each Phong ball stands below the Blinn-Phong ball with four times its exponent.

# %%
exponents = [4, 16, 64, 256, 4096]
figure, axes = plt.subplots(2, len(exponents), figsize=(9, 4), layout="constrained")
for column, n in enumerate(exponents):
    for row, material in enumerate(
        (brdf.BlinnPhong(**orange, k_s=[0.45] * 3, n=n), brdf.Phong(**orange, k_s=[0.45] * 3, n=n / 4))
    ):
        axes[row, column].imshow(picture(material, scene))
        axes[row, column].set_title(f"{'Blinn-Phong' if row == 0 else 'Phong'}, n = {float(material.n):g}", fontsize=9)
        axes[row, column].set_axis_off()
_ = figure.suptitle("the same highlight, by N·H above and by R·V below")
