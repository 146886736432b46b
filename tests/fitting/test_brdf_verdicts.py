"""What a person is told of a fitted table: which sentence for which deviations, and no warning of a library."""

import dataclasses
import warnings

import numpy as np
import pytest

import brdf
import fitting
from brdf.errors import InputError
from brdf.measured.table import from_angles
from fitting.measured_result import BrdfCandidate, Losses


def directions(count: int = 600, seed: int = 4) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    polar, azimuth = np.arccos(random.uniform(0.2, 1, (2, count))), random.uniform(0, 2 * np.pi, (2, count))
    return from_angles(polar[0], azimuth[0]), from_angles(polar[1], azimuth[1])


@pytest.fixture(scope="module")
def lobe() -> fitting.BrdfFitResult:
    light, view = directions()
    half = light + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    values = 0.1 + half[:, 2] ** 20
    return fitting.fit_brdf(brdf.MeasuredBRDF.from_samples(light, view, values), "normalized-blinn-phong")


SENTENCES = {
    "all of it": (0.1, 0.05, "normalized-blinn-phong describes it within 10 % (rms; 5 % of the light goes elsewhere)"),
    "rounding": (1e-12, 0.0, "normalized-blinn-phong describes it within 0.0001 % (rms; 0 % of the light"),
    "a plastic's body": (
        0.73,
        0.17,
        "normalized-blinn-phong puts 83 % of the light where it belongs, but not the peak",
    ),
    "the peak of two lobes": (
        0.075,
        0.53,
        "normalized-blinn-phong comes within 7.5 % (rms), but 53 % of the light goes",
    ),
    "the body of a retro-reflector": (0.96, 0.466, "normalized-blinn-phong does not fit: it leaves 96 % of the table"),
    "a peak, and all the light elsewhere": (0.3, 1.2, "normalized-blinn-phong does not fit"),
    "nothing": (1.0, 1.0, "normalized-blinn-phong does not fit"),
}


@pytest.mark.parametrize("name", SENTENCES)
def test_the_sentence_follows_both_measures(lobe, name):
    cosine, misplaced, said = SENTENCES[name]
    losses = Losses(cosine, cosine, 0.1, misplaced)
    result = dataclasses.replace(
        lobe, losses=losses, candidates=(dataclasses.replace(lobe.candidates[0], losses=losses),)
    )
    assert result.verdict.startswith(said)
    assert result.fits == ("does not fit" not in said)


@pytest.mark.parametrize(
    ("share", "rest"),
    [
        (0.75, "; the best lobe, normalized-blinn-phong, explains 44 % of the squares that Lambert leaves"),
        (0.96, "; the best lobe, normalized-blinn-phong, explains 7.8 % of the squares that Lambert leaves"),
        (1 - 1e-5, "; the best lobe, normalized-blinn-phong, explains 0.002 % of the squares that Lambert leaves"),
        (1 - 1e-9, "; no lobe comes closer"),
        (1.0, "; no lobe comes closer"),
        (1 + 1e-9, "; no lobe comes closer"),
    ],
)
@pytest.mark.parametrize("loss", ["cosine", "log"])
def test_how_much_closer_the_best_lobe_comes_is_told_as_it_is(lobe, share, rest, loss):
    alone, closer = Losses(0.2449, 0.2, 0.1, 0.1), Losses(0.2449 * share, 0.2, 0.1 * share, 0.1)
    matt = brdf.Lambert(k_d=[0.3])
    candidates = (
        BrdfCandidate("lambert", 1, getattr(alone, loss), alone, matt),
        dataclasses.replace(lobe.candidates[0], loss=getattr(closer, loss), losses=closer),
    )
    result = dataclasses.replace(lobe, material=matt, loss=loss, losses=alone, candidates=candidates, chosen=0)
    assert result.verdict == f"Lambert is enough within 24 % (rms; 10 % of the light goes elsewhere){rest}"


def test_where_no_lobe_helps_it_says_so():
    light, view = directions()
    values = 0.2 + 0.2 * np.maximum(np.sum(light * view, axis=1), 0) ** 20
    result = fitting.fit_brdf(brdf.MeasuredBRDF.from_samples(light, view, values))
    assert result.material.name == "lambert"
    assert result.verdict.endswith("; no lobe comes closer")


def test_the_brightest_sample_is_one_that_counted():
    light, view = directions(400)
    light[0], view[0] = from_angles(np.radians(89), 0.0), from_angles(np.radians(89), np.pi)
    light[1] = view[1] = from_angles(np.radians(30), 1.0)
    values = np.full(400, 0.01)
    values[:2] = 1e4, 100
    result = fitting.fit_brdf(brdf.MeasuredBRDF.from_samples(light, view, values))
    assert not result.fits
    assert "0° from the direction back to the light, which stands at 30°" in result.verdict


def test_one_pair_of_directions_gives_no_warning():
    light, view = (np.repeat(from_angles(0.3, azimuth)[None], 50, axis=0) for azimuth in (0.0, 0.0))
    table = brdf.MeasuredBRDF.from_samples(light, view, np.full(50, 0.5))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert fitting.fit_brdf(table).verdict.startswith("Lambert is enough within 0")


@pytest.mark.parametrize("values", [-0.5, np.linspace(-1, 0, 600)])
def test_a_table_without_a_value_above_0_is_refused(values):
    light, view = directions()
    table = brdf.MeasuredBRDF.from_samples(light, view, np.broadcast_to(values, 600))
    with pytest.raises(InputError, match=r"has no value above 0 within 80° of the normal\. Check its sign"):
        fitting.fit_brdf(table)
