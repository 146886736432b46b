"""Pictures of a fit: encoded for a screen, signed, complete, and drawn for every kind of result."""

import dataclasses

import matplotlib
import numpy as np
import pytest

import brdf
from brdf.display import lit_sphere
from fitting.report import plots
from fitting.report.material_plots import overview


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
    for cycle in (plots.CHANNELS, plots.OTHERS):
        assert len({(line["color"], line["linestyle"]) for line in cycle}) == len(colours)


def test_a_glossy_fit_shows_all_panels(glossy):
    figure = glossy.plot()
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
    [(brdf.Lambert(k_d=0.5), "blinn-phong"), (brdf.Phong(k_d=0.0, k_s=0.5, n=1e4), "phong")],
    ids=["n not determined", "sharper than a pixel"],
)
def test_every_result_is_drawn(fit_ball, material: brdf.Material, model: str, tmp_path):
    fit_ball(material, model, noise=1e-3).plot().savefig(tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000


@pytest.mark.parametrize("material", [brdf.Lambert(k_d=0.5), brdf.preset("gold")], ids=["matt", "gold"])
def test_overview_has_four_quarters(material: brdf.Material, tmp_path):
    figure = overview(material, brdf.check(material))
    figure.savefig(tmp_path / "picture.png")
    titles = [axes.get_title() for part in figure.subfigs for axes in part.axes]
    assert any("f_r" in title for title in titles)
    assert "Light reflected, of that arriving" in titles
    assert titles[0].startswith(material.name)


def test_of_several_pictures_the_one_explained_worst_is_drawn_and_named(matt):
    noise = np.random.default_rng(1).normal(0, 0.02, matt.targets[0].shape)
    targets = [matt.targets[0], matt.targets[0] + noise, matt.targets[0]]
    three = {"scenes": list(matt.scenes) * 3, "counted": list(matt.counted) * 3}
    several = dataclasses.replace(matt, targets=targets, **three, files=())
    assert several.plot().get_suptitle() == "picture 2 of 3 (explained worst)"
    named = dataclasses.replace(several, files=[{"path": f"/x/{name}.png"} for name in "abc"])
    assert named.plot(2).get_suptitle() == "picture 3 of 3, c.png"
    assert matt.plot().get_suptitle() == ""
    with pytest.raises(brdf.InputError, match="picture: must be from 0 to 2, got 3"):
        several.plot(3)


def test_a_spectrum_is_drawn_from_its_first_channel_to_its_last(matt, tmp_path):
    material = brdf.Lambert(k_d=np.linspace(0.1, 0.9, 9))
    target = np.asarray(brdf.render(material, matt.scenes[0]))
    figure = dataclasses.replace(matt, material=material, targets=[target]).plot()
    scanline = next(axes for axes in figure.axes if axes.get_title() == "scanline")
    labels = [text.get_text() for text in scanline.get_legend().get_texts()]
    assert (labels[0], labels[-2]) == ("channel 0", "channel 8")
    figure.savefig(tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000


def test_a_function_is_drawn_as_the_ball_of_the_material_that_it_is():
    material = brdf.BlinnPhong(k_d=[0.5, 0.3, 0.2], k_s=[0.3] * 3, n=30)
    ball = next(part.axes[0].images[0] for part in overview(material.reflectance).subfigs)
    expected = lit_sphere(material, 256)
    np.testing.assert_allclose(np.asarray(ball.get_array()), expected, atol=1e-3)  # its screen values have 16 bits


def test_margins_without_a_pixel_that_counts_are_cropped(matt):
    counted = np.zeros(matt.targets[0].shape[:2], bool)
    counted[10:20, 5:15] = True
    axes = dataclasses.replace(matt, counted=[counted]).plot().axes[0]
    assert axes.get_xlim() == (2.5, 16.5)  # two pixels around
    assert axes.get_ylim() == (21.5, 7.5)


def test_a_picture_of_which_no_pixel_counts_is_drawn(matt):
    counted = np.zeros(matt.targets[0].shape[:2], bool)
    assert len(dataclasses.replace(matt, counted=[counted]).plot().axes) >= 4
