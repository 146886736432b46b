"""The pictures of a material show what the check says."""

import numpy as np
import pytest

from brdf.models import BlinnPhong, Lambert, NormalizedPhong
from brdf.plausibility.verdicts import check
from fitting.report.material_plots import plot_albedo, plot_lobe, plot_reciprocity


def test_albedo_curves_cross_the_limit_where_the_report_says():
    material = BlinnPhong(k_d=[0.3, 0.5], k_s=[0.5, 0.3], n=8.0)
    report = check(material)
    lines = plot_albedo(material, report).axes[0].lines
    degrees, albedo = lines[1].get_xdata(), lines[1].get_ydata()
    np.testing.assert_allclose(np.interp(1.0, albedo[100:], degrees[100:]), report.energy.crossing, atol=0.1)


def test_a_function_is_drawn_too():
    material = NormalizedPhong(k_d=0.3, k_s=0.5, n=30.0)
    known, sampled = (plot_albedo(brdf).axes[0].lines[1] for brdf in (material, material.reflectance))
    expected = np.interp(sampled.get_xdata(), known.get_xdata(), known.get_ydata())
    np.testing.assert_allclose(sampled.get_ydata(), expected, atol=1e-3)


def test_lobe_peaks_at_the_mirror_direction():
    lobe = plot_lobe(NormalizedPhong(k_d=0.1, k_s=0.5, n=3e5), angles=(40.0,)).axes[0].lines[0]
    assert np.degrees(lobe.get_xdata()[np.argmax(lobe.get_ydata())]) == pytest.approx(40, abs=0.01)


def test_reciprocity_map_is_antisymmetric():
    values = plot_reciprocity(BlinnPhong(k_d=0.3, k_s=0.5, n=8.0)).axes[0].collections[0].get_array()
    np.testing.assert_allclose(values, -np.transpose(values), atol=1e-9)
    assert np.max(values) > 0.5


def test_of_a_spectrum_there_are_as_many_albedo_curves_as_colours():
    figure = plot_albedo(Lambert(k_d=np.linspace(0.1, 0.9, 31)))
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == ["0", "6", "12", "18", "24", "30"]
