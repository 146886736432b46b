"""How well the shading tells the light: the stated error is that of theory and that of many draws."""

import numpy as np
import pytest
from ball_pictures import angle
from project_paths import REAL, real_data

import brdf
from brdf.errors import InputError
from fitting.photographs.ball import Circle, ball_points
from fitting.photographs.distant_light import (
    DOUBTFUL,
    GUESS,
    LIT,
    ShadingLight,
    light_from_highlight,
    light_from_shading,
)

SIDE = 90
POINTS = ball_points((SIDE, SIDE), Circle(44.3, 44.8, 42.0))
ON_BALL = np.asarray(POINTS.mask)
ROW, COLUMN = np.nonzero(ON_BALL)
NORMAL = np.asarray(POINTS.normal, np.float64)[ON_BALL]
FRONT, ASIDE, BEHIND = (0.4, 0.3, 0.87), (0.8, -0.6, 0.05), (-0.7, 0.5, -0.5)


def shown(light, *, ambient=0.0, k_s=0.0, n=1.0):
    """A ball under a light of intensity 1, k_d being 0.6, by Blinn and Phong."""
    to_light = np.array(light) / np.linalg.norm(light)
    half = to_light + np.array([0, 0, 1])
    cosine = NORMAL @ to_light
    highlight = k_s * np.maximum(NORMAL @ half / np.linalg.norm(half), 0) ** n
    return ambient + np.where(cosine > 0, 0.6 * cosine + highlight, 0)


def light_of(value, *, ambient=False, mask=True) -> ShadingLight:
    """The light that the pixels on the ball tell."""
    picture = np.zeros((SIDE, SIDE))
    picture[ON_BALL] = value
    return light_from_shading(picture, POINTS, ambient=ambient, mask=mask)


def over_exposed_light_of(clean, level, rng) -> ShadingLight:
    """The light that noisy pixels on the ball tell, (P, C), which end at a level."""
    picture = np.zeros((SIDE, SIDE, clean.shape[1]))
    picture[ON_BALL] = np.minimum(clean + 0.02 * rng.standard_normal(clean.shape), level)
    return light_from_shading(picture, POINTS, saturation=level)


@pytest.mark.parametrize("light", [FRONT, ASIDE, BEHIND])
def test_the_error_is_that_of_theory_for_gaussian_noise(light):
    """Huber's estimate keeps 95 % efficiency: its variance is that of least squares over 0.95."""
    noise, rng, size = 0.01, np.random.default_rng(0), np.linalg.norm(light)
    unit = np.array(light) / size
    columns = NORMAL[NORMAL @ unit > LIT]
    across = np.eye(3) - np.outer(unit, unit)
    variance = np.trace(across @ np.linalg.inv(columns.T @ columns) @ across) * (noise / 0.6) ** 2 / 0.95
    clean = shown(light)
    stated = [light_of(clean + noise * rng.standard_normal(len(clean))).error for _ in range(12)]
    # A draw's variance is known as from some 30 blocks, to 25 %; 12 draws know it to 7 %, the error to 3.5 %.
    assert np.sqrt(np.mean(np.square(stated))) == pytest.approx(np.degrees(np.sqrt(variance)), rel=0.08)


@pytest.mark.parametrize(
    "surface",
    [
        pytest.param({}, id="matt"),
        pytest.param({"ambient": 0.1, "k_s": 0.4, "n": 40.0}, id="shiny, ambient"),
        pytest.param({"k_s": 0.4, "n": 8000.0}, id="a highlight in one block"),
    ],
)
def test_the_light_is_as_far_off_as_the_error_says(surface):
    rng, shares = np.random.default_rng(1), []
    for light in (FRONT, ASIDE, BEHIND):
        clean = shown(light, **surface)
        for _ in range(5):
            found = light_of(clean + 0.02 * rng.standard_normal(len(clean)), ambient="ambient" in surface)
            shares.append(angle(found.direction, light) / found.error)
    # 15 angles in two directions know their mean square to 30 % or so, its root to 15 %.
    assert 0.65 < np.sqrt(np.mean(np.square(shares))) < 1.4


@pytest.mark.parametrize(
    ("colour", "level"),
    [pytest.param([1.0], 0.5, id="grey"), pytest.param([0.6, 1.0, 0.2], 0.4, id="green clips first")],
)
def test_what_is_over_exposed_is_left_out_whatever_noise_made_of_it(colour, level):
    """Left out by what they show, pixels near the level err to one side: the light was 1.5 to 2 errors off."""
    rng, shares = np.random.default_rng(8), []
    for light in (FRONT, ASIDE):
        for _ in range(10):
            found = over_exposed_light_of(np.outer(shown(light), colour), level, rng)
            shares.append(angle(found.direction, light) / found.error)
    # 20 angles in two directions know their mean square to 25 %, its root to 12 %.
    assert 0.65 < np.sqrt(np.mean(np.square(shares))) < 1.4


def test_a_highlight_where_every_pixel_is_left_out_does_not_hinder():
    """No pixel that counted bent the cost of the sharp lobe that was tried there, and the picture was refused."""
    found = over_exposed_light_of(shown(FRONT)[:, None], 0.5, np.random.default_rng(18))
    assert angle(found.direction, FRONT) < 2 * found.error


def test_residuals_that_go_together_over_a_block_count_as_one():
    """Stains that fill a block each: with each pixel for itself the error would be a tenth of this."""
    rng, shares = np.random.default_rng(2), []
    rows, columns = (ROW - ROW.min()) // 7, (COLUMN - COLUMN.min()) // 7
    for light in (FRONT, ASIDE):
        for _ in range(8):
            stained = shown(light) * (1 + 0.05 * rng.standard_normal((12, 12))[rows, columns])
            found = light_of(stained)
            shares.append(angle(found.direction, light) / found.error)
    assert 0.7 < np.sqrt(np.mean(np.square(shares))) < 1.35


@pytest.mark.parametrize("unit", [2.0**-70, 2.0**40])
@pytest.mark.parametrize("k_s", [0.0, 0.4])
def test_the_unit_of_the_values_does_not_matter(unit, k_s):
    noise = 1e-3 * np.random.default_rng(4).standard_normal(len(NORMAL))
    value = shown(FRONT, k_s=k_s, n=40.0) + noise
    one, other = light_of(value), light_of(unit * value)
    np.testing.assert_allclose(other.direction, one.direction, rtol=1e-9)
    assert other.strength == pytest.approx(unit * one.strength, rel=1e-9)
    assert other.error == pytest.approx(one.error, rel=1e-9)


def test_an_error_is_a_guess_from_that_of_random_directions_on():
    way = np.random.default_rng(6).standard_normal((200_000, 3))
    off = np.degrees(np.arctan2(np.linalg.norm(way[:, :2], axis=1), way[:, 2]))
    # The squares' deviation is 1 of their mean at most: 1 / sqrt(200 000) of it, half of that of the root.
    assert pytest.approx(np.sqrt(np.mean(off**2)), rel=4e-3) == GUESS


def test_a_crescent_whose_highlight_takes_all_the_light_is_refused():
    """The fit with a highlight ends at a light from straight behind, which reaches no pixel that is seen."""
    clean = shown((-0.499, -0.037, -0.866), ambient=0.13, k_s=0.17, n=10.4)
    noisy = clean + 0.014 * np.random.default_rng(1).standard_normal(len(clean))
    with pytest.raises(InputError, match="too little of the lit surface"):
        light_of(noisy, ambient=True)


def test_a_single_block_is_refused():
    """How far what one part of the surface tells is off, only other parts know."""
    mask = np.zeros((SIDE, SIDE), bool)
    mask[24:29, 59:64] = True
    mask[68, 14] = True  # in the mask, in the dark: the blocks are as large as for the whole ball
    noisy = shown(FRONT) + 0.01 * np.random.default_rng(3).standard_normal(len(NORMAL))
    with pytest.raises(InputError, match="too little of the lit surface"):
        light_of(noisy, mask=mask)


# -- what is no ball ---------------------------------------------------------------------------------------------------


def relief(light, *, depth=0.5, k_s=0.0):
    """A plane with waves, lit from one side: bright all over where a ball has a crescent in the dark."""
    slope = depth * np.stack([np.cos(0.31 * COLUMN + 0.2 * ROW), np.sin(0.27 * ROW)], axis=1)
    normal = np.concatenate([slope, np.ones((len(slope), 1))], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    to_light = np.array(light) / np.linalg.norm(light)
    half = to_light + np.array([0, 0, 1])
    return 0.6 * np.maximum(normal @ to_light, 0) + k_s * np.maximum(normal @ half / np.linalg.norm(half), 0) ** 200


@pytest.mark.parametrize("ambient", [False, True])
@pytest.mark.parametrize("light", [(0.4, 0.3, 0.87), (0.9, 0.1, 0.3)])
def test_a_relief_is_not_taken_for_a_matt_ball(light, ambient):
    with pytest.raises(InputError, match=r"not shaded like this surface|too little of the lit surface"):
        light_of(relief(light), ambient=ambient)


def test_a_plate_is_no_part_of_a_large_ball():
    """Where all normals are nearly alike the search for the light had no curvature, and ended in a traceback."""
    row, column = np.mgrid[:160, :160] / 80 - 1
    picture = np.round(255 * 0.8 * (1 + (column - 0.3) ** 2 + (row + 0.2) ** 2) ** -3) / 255
    points = ball_points(picture.shape, Circle(80, 80, 500))
    with pytest.raises(InputError, match=r"not shaded like this surface|too little of the lit surface"):
        light_from_shading(picture, points)


def test_highlights_all_over_are_not_taken_for_a_mirror_ball():
    picture = np.zeros((SIDE, SIDE))
    picture[ON_BALL] = relief((0.4, 0.3, 0.87), k_s=3.0)
    with pytest.raises(InputError, match="bright in many places"):
        light_from_highlight(picture, Circle(44.3, 44.8, 42.0))


def test_noise_is_no_reason_to_doubt_a_ball():
    rng = np.random.default_rng(5)
    found = light_of(shown(FRONT) + 0.15 * rng.standard_normal(len(NORMAL)))
    assert found.unexplained < DOUBTFUL


NOISE = np.random.default_rng(9).standard_normal(len(NORMAL))
SECOND = shown((-0.6, 0.3, 0.7))


@pytest.mark.parametrize(
    ("value", "ambient", "doubted"),
    [
        pytest.param(shown(ASIDE) + 0.2 * SECOND, False, True, id="a second light"),
        pytest.param(shown(ASIDE) + 0.2 * SECOND, True, True, id="a second light called ambient"),
        pytest.param(shown(ASIDE, ambient=0.05), False, True, id="ambient light"),
        pytest.param(shown(ASIDE, ambient=0.05, k_s=0.3, n=20.0), True, False, id="ambient light that was stated"),
        pytest.param(shown(ASIDE, ambient=0.005), False, False, id="light to and fro"),
        pytest.param(shown(ASIDE, k_s=0.3, n=20.0), False, False, id="a highlight"),
        pytest.param(np.maximum(shown(ASIDE) + 0.05 * NOISE, 0), False, False, id="noise cut off at 0"),
        pytest.param(shown(ASIDE) + 0.15 * NOISE, False, False, id="noise"),
    ],
)
def test_light_on_the_side_that_faces_away_is_told(value, ambient, doubted):
    """A second light of a fifth turns the direction by 3 degrees and more, and the error says 0.1."""
    found = light_of(value + 1e-3 * NOISE, ambient=ambient)
    assert ("lit from elsewhere too" in found.stated_error) == doubted
    assert (angle(found.direction, ASIDE) > 2.0) == doubted


@real_data
@pytest.mark.parametrize("name", ["real-item2/image00.jpg", "real-item9/image17.jpg"])
def test_a_fresco_and_a_coin_are_no_balls(name):
    """Taken for balls, their light was up to 98° off and said to be known to 5°."""
    picture = brdf.read_picture(REAL / "rti" / name)
    height, width, _ = picture.pixels.shape
    circle = Circle((width - 1) / 2, (height - 1) / 2, min(width, height) / 2 - 1)
    with pytest.raises(InputError, match=r"not shaded like this surface"):
        light_from_shading(picture, ball_points((height, width), circle))
    with pytest.raises(InputError, match="bright in many places"):
        light_from_highlight(picture, circle)
