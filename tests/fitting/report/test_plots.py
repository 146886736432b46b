"""Pictures of a fit: encoded for a screen, signed, complete, and drawn for every kind of result."""

import dataclasses

import matplotlib
import numpy as np
import pytest

import brdf
import fitting
from fitting.report import plots
from fitting.report.material_plots import overview

SIZE = 40


def fit(material: brdf.Material, model: str, noise: float = 0.0, spoil: bool = False) -> fitting.FitResult:
    camera = brdf.OrthographicCamera(
        position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(SIZE, SIZE)
    )
    light = brdf.DirectionalLight(direction=[0.4, 0.5, 0.8], intensity=[0.9])
    scene = brdf.Scene(camera=camera, shapes=(brdf.Sphere(center=[0, 0, 0], radius=1),), lights=(light,))
    target = np.array(brdf.render(material, scene, precision="float64"))
    target += np.random.default_rng(5).normal(0, noise, target.shape)
    if spoil:
        target[20, 20] = np.nan
    return fitting.fit(target, scene, model=model)


@pytest.mark.parametrize("value", [0.0, 0.001, 0.0031308, 0.18, 0.5, 1.0])
def test_linear_values_are_shown_through_srgb(value: float):
    expected = 12.92 * value if value <= 0.0031308 else 1.055 * value ** (1 / 2.4) - 0.055
    np.testing.assert_allclose(
        brdf.displayed(np.full((1, 1, 3), value)), expected, atol=2e-4
    )  # a twentieth of an 8-bit code


def test_what_is_no_colour_is_shown_as_its_mean():
    assert brdf.displayed(np.full((2, 2, 31), 0.25)).shape == (2, 2, 3)
    np.testing.assert_allclose(brdf.displayed(np.array([[[np.nan, 0.5, 2.0]]]), white=1.0)[0, 0, [0, 2]], [0, 1])


def test_signed_colours_keep_their_order_in_grey():
    colours = matplotlib.colormaps[plots.SIGNED](np.linspace(0, 1, 64))[:, :3]
    grey = brdf_grey(colours)
    assert np.all(np.diff(grey) > 0)
    np.testing.assert_allclose(np.ptp(colours[31:33].mean(0)), 0, atol=0.05)  # zero is grey


def brdf_grey(encoded: np.ndarray) -> np.ndarray:
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


def test_channel_colours_are_told_apart_in_grey_or_by_their_dashes():
    colours = np.array([matplotlib.colors.to_rgb(name) for name in plots.CHANNEL_COLOURS])
    assert len({tuple(colour) for colour in colours}) == len(colours)
    assert len(set(plots.CHANNEL_STYLES)) >= 3


def test_a_glossy_fit_shows_all_panels():
    figure = fit(brdf.BlinnPhong(k_d=[0.5, 0.4, 0.3], k_s=0.4, n=30), "blinn-phong", noise=0.01, spoil=True).plot()
    titles = [axes.get_title() for axes in figure.axes]
    assert titles[:3] == ["target", "fit, blinn-phong", "fit − target, largest channel"]
    assert any("highlight" in title for title in titles)
    assert {"scanline", "profile of n"} <= set(titles)
    residual = figure.axes[2].images[0]
    low, high = residual.get_clim()
    assert low == -high
    assert np.isnan(residual.get_array().filled(np.nan)[20, 20])  # a pixel left out is no residual
    profile = next(axes for axes in figure.axes if axes.get_title() == "profile of n")
    grid, values = profile.lines[0].get_data()
    assert abs(np.log(grid[np.argmin(values)] / 30)) < 0.05


@pytest.mark.parametrize(
    ("material", "model"),
    [
        (brdf.Lambert(k_d=0.5), "lambert"),
        (brdf.Lambert(k_d=0.5), "blinn-phong"),
        (brdf.Phong(k_d=0.0, k_s=0.5, n=1e4), "phong"),
        (brdf.Lambert(k_d=np.linspace(0.1, 0.9, 7)), "auto"),
    ],
    ids=["matt", "n not determined", "sharper than a pixel", "a spectrum"],
)
def test_every_result_is_drawn(material: brdf.Material, model: str, tmp_path):
    fit(material, model, noise=1e-3).plot().savefig(tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000


@pytest.mark.parametrize("material", [brdf.Lambert(k_d=0.5), brdf.preset("gold")], ids=["matt", "gold"])
def test_overview_has_four_quarters(material: brdf.Material, tmp_path):
    figure = overview(material, brdf.check(material))
    figure.savefig(tmp_path / "picture.png")
    titles = [axes.get_title() for part in figure.subfigs for axes in part.axes]
    assert any("f_r" in title for title in titles)
    assert "Light reflected, of that arriving" in titles
    assert titles[0].startswith(material.name)


def test_of_several_pictures_the_one_explained_worst_is_drawn_and_named():
    result = fit(brdf.Lambert(k_d=0.5), "lambert")
    (scene,), (target,) = result.scenes, result.targets
    noise = np.random.default_rng(1).normal(0, 0.02, target.shape).astype(np.float32)
    both = fitting.fit([target, target + noise, target], [scene] * 3, model="lambert")
    assert both.plot().get_suptitle() == "picture 2 of 3 (explained worst)"
    named = dataclasses.replace(both, names=("a.png", "b.png", "c.png"))
    assert named.plot(2).get_suptitle() == "picture 3 of 3, c.png"
    assert result.plot().get_suptitle() == ""
    with pytest.raises(brdf.InputError, match="picture: must be from 0 to 2, got 3"):
        both.plot(3)


def test_a_spectrum_is_drawn_from_its_first_channel_to_its_last():
    figure = fit(brdf.Lambert(k_d=np.linspace(0.1, 0.9, 9)), "lambert").plot()
    labels = [text.get_text() for text in figure.axes[-1].get_legend().get_texts()]
    assert (labels[0], labels[-2]) == ("channel 0", "channel 8")


def test_a_function_is_drawn_as_the_ball_of_the_material_that_it_is():
    material = brdf.BlinnPhong(k_d=[0.5, 0.3, 0.2], k_s=[0.3] * 3, n=30)
    ball = next(part.axes[0].images[0] for part in overview(material.reflectance).subfigs)
    expected = brdf.lit_sphere(material, 256)
    np.testing.assert_allclose(np.asarray(ball.get_array()), expected, atol=1e-3)  # its screen values have 16 bits


def test_margins_without_a_pixel_that_counts_are_cropped():
    result = fit(brdf.Lambert(k_d=0.5), "lambert")
    counted = np.zeros((SIZE, SIZE), bool)
    counted[10:20, 5:15] = True
    axes = dataclasses.replace(result, counted=[counted]).plot().axes[0]
    assert axes.get_xlim() == (2.5, 16.5)  # two pixels around
    assert axes.get_ylim() == (21.5, 7.5)
