"""The plausibility check: verdicts on BRDFs of known standing, worst cases, bounds, words."""

import json
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from labelled_brdfs import FUNCTIONS, MATERIALS, dented, direction

import brdf
from brdf.albedo import directional_albedo
from brdf.errors import InputError
from brdf.models import BlinnPhong, NormalizedBlinnPhong, NormalizedPhong, Phong
from brdf.plausibility.numeric import check_black_box, integrate
from brdf.plausibility.report import ENERGY_LIMIT, Angles, judged
from brdf.plausibility.verdicts import check

WORD = {True: "pass", False: "fail"}


def test_the_labelled_set_is_large():
    assert len(MATERIALS) + len(FUNCTIONS) >= 60


@pytest.mark.parametrize("case", [pytest.param(case, id=case[0]) for case in MATERIALS + FUNCTIONS])
def test_verdicts_on_brdfs_of_known_standing(case):
    name, brdf, *labels = case
    report = check(brdf, name=name)
    for (test, finding), label in zip(report.findings.items(), labels, strict=True):
        assert finding.verdict == WORD[label], f"{test}\n{report}"
        assert abs(finding.margin) >= finding.error_bound
    assert report.plausible is all(labels)
    json.dumps(report.to_json(), allow_nan=False)


def test_only_channels_with_a_highlight_are_said_to_grow():
    energy = brdf.check(brdf.Phong(k_d=[1.5, 0.1], k_s=[0.0, 1e-20], n=10.0)).energy
    assert (energy.verdict, energy.value, energy.channel) == ("fail", 1.5, 0)
    assert "grows" not in energy.sentence
    assert jnp.ones(()).dtype == jnp.float32  # JAX is left as it was


@pytest.mark.parametrize(
    "material",
    [
        Phong(k_d=0.4, k_s=0.3, n=2.0),
        BlinnPhong(k_d=0.7, k_s=0.8, n=300.0),
        NormalizedPhong(k_d=0.7, k_s=0.8, n=300.0),
        NormalizedBlinnPhong(k_d=0.4, k_s=0.3, n=2.0),
    ],
    ids=lambda material: material.name,
)
def test_what_is_known_on_paper_is_what_the_search_finds(material):
    known, found = check(material), check_black_box(material.reflectance, "same")
    for name, finding in known.findings.items():
        assert finding.verdict == found.findings[name].verdict, name
    if material.cosine_weighted:
        np.testing.assert_allclose(known.energy.value, found.energy.value, atol=1e-6)
        assert found.energy.to_light.polar < 0.2
    else:
        np.testing.assert_allclose(known.reciprocity.value, found.reciprocity.value, atol=2e-3)
    np.testing.assert_allclose(known.positivity.value, found.positivity.value, rtol=1e-4)


@pytest.mark.parametrize("model", [Phong, BlinnPhong])
@pytest.mark.parametrize(
    ("k_d", "k_s", "n"), [(0.3, 0.5, 50.0), (0.9, 0.4, 3.0), (0.5, 1e-6, 100.0), (1.2, 0.1, 5.0), (0.8, 1.0, 28.0)]
)
def test_classic_forms_say_where_the_albedo_crosses_one(model, k_d, k_s, n):
    material = model(k_d=k_d, k_s=k_s, n=n)
    energy = check(material).energy
    assert energy.crossing is not None
    crossing = math.radians(energy.crossing)
    beyond = directional_albedo(material, np.linspace(crossing + 1e-6, 0.5 * np.pi, 100), precision="float64")
    assert np.min(beyond) > 1
    if crossing > 0:  # light from above may be too much, too, and slanted light not
        np.testing.assert_allclose(directional_albedo(material, crossing, precision="float64"), 1, rtol=1e-6)
    else:
        assert k_d >= 0.9
    assert energy.value > 1
    np.testing.assert_allclose(
        directional_albedo(material, math.radians(energy.to_light.polar), precision="float64"), energy.value, rtol=1e-4
    )


def test_words_for_opengls_blinn_phong():
    text = str(check(BlinnPhong(k_d=[0.3, 0.3, 0.2], k_s=[0.5, 0.5, 0.5], n=50.0)))
    assert "not plausible" in text
    assert "not reciprocal: the specular term is not multiplied by N·L; f_r(89.99°→" in text
    assert "does not conserve energy: the albedo exceeds 1 for light beyond 89.88° and grows without bound" in text
    assert "Its nearest plausible form is NormalizedBlinnPhong(" in text


def test_the_channel_that_exceeds_first_is_named_beside_the_worst():
    """Blue was said to cross where green does; by itself it does at 89.68 degrees."""
    text = check(brdf.Phong(k_d=[0.2, 0.9, 0.1], k_s=[0.0, 0.3, 0.6], n=20.0)).energy.sentence
    assert "beyond 88.39°, channel green, and grows without bound, to 27.7 at 89.99°, channel blue" in text


def test_light_that_is_nearly_grazing_is_not_said_to_be_at_90_degrees():
    energy = check(BlinnPhong(k_d=0.5, k_s=0.2, n=1e5)).energy
    beyond, worst = (float(one) for one in re.findall(r"([\d.]+)°", energy.sentence))
    assert 89.99 < beyond < worst < 90
    np.testing.assert_allclose([90 - beyond, 90 - worst], [90 - energy.crossing, 90 - energy.to_light.polar], rtol=0.1)


@pytest.mark.parametrize(
    "material",
    [
        brdf.Phong(k_d=1.0, k_s=1e-4, n=1e6),
        brdf.BlinnPhong(k_d=0.5, k_s=1e-20, n=10.0),
        brdf.Phong(k_d=0.6, k_s=0.4, n=1e15),
    ],
)
def test_what_shows_closer_to_grazing_light_than_numbers_go_is_judged_all_the_same(material):
    """The albedo of a classic form grows without bound, however little k_s is."""
    report = brdf.check(material)
    assert report.energy.verdict == "fail"
    assert report.energy.sentence.endswith("grows without bound")
    json.dumps(report.to_json(), allow_nan=False)


def test_the_reported_pair_shows_the_reported_ratio():
    material = Phong(k_d=0.1, k_s=0.4, n=7.0)
    finding = check(material).reciprocity
    light, view = (direction(a.polar, a.azimuth) for a in (finding.to_light, finding.to_view))
    with jax.enable_x64(True):
        there, back = (float(material.reflectance(*pair)[0]) for pair in ((light, view), (view, light)))
    np.testing.assert_allclose(1 - back / there, finding.value, rtol=1e-6)


def test_worst_case_of_a_hole_is_in_the_hole():
    where = (37.0, 112.0)
    finding = check(dented(where, "half"), name="hole").positivity
    light, view = (direction(a.polar, a.azimuth) for a in (finding.to_light, finding.to_view))
    total = light + view
    assert total @ direction(*where) / np.linalg.norm(total) > math.cos(math.radians(0.25))
    np.testing.assert_allclose(finding.value, 0.3 / np.pi - 0.2, rtol=1e-12)


def test_cannot_tell_where_the_bound_is_wider_than_the_margin():
    margins = {1e-9: "cannot tell", -1e-9: "cannot tell", math.nan: "cannot tell", 1e-7: "pass", -1e-7: "fail"}
    for margin, word in margins.items():
        assert judged(margin, 0.0, 1e-8, (Angles(0.0), None, 0), "", least=True).verdict == word
    edge = check(NormalizedPhong(k_d=0.5, k_s=0.5 + 1e-6, n=10.0)).energy
    assert edge.verdict == "cannot tell"
    assert abs(edge.margin) < edge.error_bound


def test_a_function_that_is_not_finite_cannot_be_judged():
    report = check(lambda light, view: jnp.where(view[2] > 0.9, jnp.nan, 0.1)[None], name="broken")
    assert report.plausible is None
    assert all(finding.verdict == "cannot tell" for finding in report.findings.values())
    assert "not a finite number" in str(report)
    json.dumps(report.to_json(), allow_nan=False)


@pytest.mark.parametrize(
    ("brdf", "message"),
    [
        (3.0, "must be a material or a function, got float"),
        (lambda light, view: jnp.ones((2, 2)), r"must return one real number per channel, got float64\[2, 2\]"),
        (lambda light, view: float(light[0]), "cannot be called with two vectors"),
        (lambda light: light, "cannot be called with two vectors"),
    ],
)
def test_what_cannot_be_checked(brdf, message):
    with pytest.raises(InputError, match=message):
        check(brdf)


@pytest.mark.parametrize("n", [0.0, 12.0, 1e4, 1e6])
def test_quadrature_bounds_its_error(n):
    """Any mean of lobes anywhere, against the closed form of the integral of cos^n over its hemisphere."""
    axes = np.stack([direction(0, 0), direction(40, 70)])[: 1 + (n >= 1e4)]  # lobes that are whole

    def evaluate(which, directions):
        cosine = np.sum(directions * axes[which], axis=1)
        return np.where(cosine > 0, np.maximum(cosine, 1e-300) ** n, 0.0)[:, None]

    value, bound = integrate(evaluate, axes[:, None], tolerance=1e-9 / (n + 1), budget=3_000_000)
    np.testing.assert_allclose(value, 2 * np.pi / (n + 1), rtol=0, atol=float(np.max(bound)))
    assert np.all(bound < 1e-5 / (n + 1))


def test_limit_leaves_room_for_a_lossless_material():
    assert check(NormalizedPhong(k_d=0.3, k_s=0.7, n=1e6)).energy.value <= ENERGY_LIMIT


def test_a_registered_model_that_nobody_knows_on_paper_is_measured(monkeypatch):
    """What is known of the five models was taken for known of every model in the table."""

    class Bright(brdf.Lambert):
        name = "bright"

        def reflectance(self, to_light, to_view):
            return 2.0 * super().reflectance(to_light, to_view)

    monkeypatch.setitem(brdf.MODELS, "bright", Bright)
    assert brdf.check(Bright(k_d=0.9)).energy.verdict == "fail"


@pytest.mark.parametrize("n", [100.0, 2000.0, 1e4])
def test_of_a_sharp_lobe_alone_the_ratio_is_that_of_the_cosines(n: float):
    """Where f_r underflows it was anything from 1e-4 to 100."""
    finding = check(BlinnPhong(k_d=0.0, k_s=0.5, n=n)).reciprocity
    assert finding.to_view is not None
    ratio = float(finding.sentence.rpartition(" is ")[2].partition(" times")[0])
    cosines = [math.cos(math.radians(one.polar)) for one in (finding.to_view, finding.to_light)]
    assert ratio == pytest.approx(cosines[0] / cosines[1], rel=1e-3)


def test_a_black_channel_is_reciprocal():
    report = check(Phong(k_d=[0, 0.2, 0.3], k_s=[0, 0.1, 0.1], n=5))
    assert report.reciprocity.verdict == "fail"
    assert report.reciprocity.margin < 0
