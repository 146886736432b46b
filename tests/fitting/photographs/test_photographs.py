"""Photographs of a ball through the library: circles, lights, what counts."""

import dataclasses

import numpy as np
import pytest
from ball_pictures import BALL, SHAPE, angle, disc, photograph_scene, shaded
from project_paths import REAL, real_data

import brdf
import fitting
from brdf.errors import InputError
from fitting.photographs.ball import Circle, ball_normals, ball_points, find_circle
from fitting.photographs.distant_light import light_from_highlight, light_from_shading
from fitting.photographs.light_files import read_directions, read_intensities

# -- the ball ----------------------------------------------------------------------------------------------------------


def test_pixels_that_the_outline_runs_through_do_not_count():
    """A camera mixes the background into them: here a bright one, each pixel being the mean of 8 x 8 points."""
    fine = 8
    # The centre of coarse pixel (x, y) is that of fine pixels 8 x .. 8 x + 7.
    small = Circle(fine * BALL.x + (fine - 1) / 2, fine * BALL.y + (fine - 1) / 2, fine * BALL.radius)
    shape = (fine * SHAPE[0], fine * SHAPE[1])
    light = (0.3, 0.4, 0.86)
    drawn = np.where(disc(small, shape)[..., None], 0.1 + shaded(light, 0.6, small, shape), 1.0)
    picture = drawn.reshape(SHAPE[0], fine, SHAPE[1], fine, 1).mean(axis=(1, 3)).astype(np.float32)
    result = fitting.fit(
        picture, photograph_scene(brdf.Scene(points=ball_points(SHAPE, BALL)), light, ambient=[1.0]), model="lambert"
    )
    # The mean over a pixel of the shading is not that at its centre, where the terminator runs.
    assert result.residual < 5e-3
    assert float(result.material.k_a[0]) == pytest.approx(0.1, abs=1e-3)
    assert float(result.material.k_d[0]) == pytest.approx(0.6, rel=3e-3)


@pytest.mark.parametrize("circle", [BALL, Circle(24.5, 24.5, 20.0), Circle(30.0, 25.0, 8.3)])
def test_a_ball_is_found_in_its_mask(circle):
    mask = disc(circle)
    found = find_circle(mask)
    # The outline of a disc of pixels is known to a fraction of a pixel only.
    assert np.allclose(found, circle, atol=0.35)
    mask[int(circle.y), int(circle.x)] = False  # a hole
    mask[0, -1] = True  # a speck
    assert np.allclose(find_circle(mask), circle, atol=0.5)


def test_what_is_no_ball_is_refused():
    square = np.zeros(SHAPE, bool)
    square[10:40, 10:40] = True
    for mask, said in ((square, "no ball"), (np.zeros(SHAPE), "is empty")):
        with pytest.raises(InputError, match=said):
            find_circle(mask)


def test_normals_point_right_up_and_to_the_camera():
    points = ball_points(SHAPE, BALL)
    corners = [disc(Circle(BALL.x + dx, BALL.y + dy, BALL.radius)) for dx in (-0.5, 0.5) for dy in (-0.5, 0.5)]
    assert np.array_equal(points.mask, np.all(corners, axis=0))
    right = np.asarray(points.normal)[25, 50]
    up = np.asarray(points.normal)[5, 30]
    assert right[0] > 0.9
    assert up[1] > 0.9
    assert np.allclose(np.linalg.norm(points.normal[points.mask], axis=-1), 1)
    assert np.array_equal(points.to_view[25, 50], [0, 0, 1])


@pytest.mark.parametrize(
    "circle",
    [
        Circle(np.nan, 1, 9),
        Circle(1, 1, -5),
        Circle(1, 1, 2),
        Circle(500, 1, 9),
        Circle(1, np.inf, 9),
        Circle(9, 9, 4e4),
    ],
)
def test_circles_that_are_none(circle):
    with pytest.raises(InputError, match="circle"):
        ball_points(SHAPE, circle)


# -- the light ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", [(0, 0, 1), (0.5, 0.4, 0.8), (-0.7, 0.2, 0.5), (0.1, -0.6, 0.9)])
def test_the_shading_tells_the_light(direction):
    found = light_from_shading(shaded(direction), ball_points(SHAPE, BALL))
    assert angle(found.direction, direction) < 1e-3  # float32 pixels
    assert found.strength == pytest.approx(0.8, rel=1e-5)


def test_highlights_and_cast_shadows_do_not_pull():
    picture = shaded((0.3, 0.4, 0.86))
    picture[18:24, 34:40] = 3.0  # a highlight, not clipped
    picture[30:40, 20:28] = 0.0  # a cast shadow
    plain = light_from_shading(picture, ball_points(SHAPE, BALL))
    assert angle(plain.direction, (0.3, 0.4, 0.86)) < 1.0


@pytest.mark.parametrize("ambient", [0.0, 0.1])
@pytest.mark.parametrize(
    ("model", "k_s", "n"),
    [
        pytest.param("phong", 0.0, 1.0, id="matt"),
        *[(model, 0.3, n) for model in ("phong", "blinn-phong") for n in (8.0, 100.0)],
    ],
)
def test_ambient_light_and_highlights_do_not_pull_the_light(ambient, model, k_s, n):
    points = ball_points((128, 128), Circle(63.3, 64.1, 55.0))
    material = brdf.MODELS[model](k_a=[ambient], k_d=[0.5], k_s=[k_s], n=n)  # pyright: ignore
    shares = []
    for seed, direction in enumerate([(0.3, 0.4, 0.9), (0.5, 0.4, 0.7), (-0.8, 0.2, 0.4), (0.6, -0.6, 0.25)]):
        clean = np.asarray(brdf.render(material, photograph_scene(brdf.Scene(points=points), direction, ambient=[1.0])))
        noisy = clean + np.random.default_rng(seed).normal(0, 0.01, clean.shape)
        found = light_from_shading(noisy, points, ambient=ambient > 0)
        assert found.error < 0.1
        shares.append(angle(found.direction, direction) / found.error)
    # Four angles know their mean square to 60 %; where ambient light is not looked for, it is 5 to 10 errors.
    assert np.sqrt(np.mean(np.square(shares))) < 1.8


@pytest.mark.parametrize("direction", [(0, 0, 1), (0.5, 0.4, 0.8), (-0.8, 0.2, 0.4), (0.3, -0.9, 0.1)])
def test_the_highlight_tells_the_light(direction):
    circle = Circle(150.2, 139.7, 120.0)
    points = ball_points((280, 300), circle)
    light = np.asarray(direction) / np.linalg.norm(direction)
    normal = np.asarray(points.normal)
    mirrored = 2 * normal[..., 2:] * normal - [0, 0, 1]
    glow = np.exp(400 * (mirrored @ light - 1)) + 0.02
    found = light_from_highlight(np.where(points.mask, np.minimum(glow, 1.0), 0)[..., None], circle)
    # The picture of a round light on a ball is not quite symmetric about its centre.
    assert angle(found, direction) < 1.0


@pytest.mark.parametrize(("polar", "off"), [(60, 0.2), (130, 0.3), (150, 0.7)])
def test_a_broad_highlight_tells_the_middle_of_the_light(polar, off):
    """A disc light of 6 degrees: at the middle of its picture on the ball it was 0.7 degrees off at 130, 1.8 at 150."""
    circle, (across, up) = Circle(101.3, 97.8, 80.4), np.cos([0.7, 0.7 - np.pi / 2]) * np.sin(np.radians(polar))
    light = np.array([across, up, np.cos(np.radians(polar))])
    normal = ball_normals((200, 200), circle)
    lit = (2 * normal[..., 2:] * normal - [0, 0, 1]) @ light > np.cos(np.radians(6))
    found = light_from_highlight(np.where(normal[..., 2] > 0, lit, 0.0), circle)
    assert angle(found, light) < off  # whole pixels are lit or not, each some degrees wide near the outline


@pytest.mark.parametrize(
    ("brightness", "degrees", "refused"), [(1.0, 5.0, True), (0.7, 3.0, True), (0.3, 5.0, False), (1.0, 1.5, False)]
)
def test_two_highlights_are_refused_unless_one_is_faint_or_a_speck(brightness, degrees, refused):
    """Of two alike the one with more pixels was taken, whichever that was."""
    circle, light, other = Circle(101.3, 97.8, 80.4), np.array([0.36, 0.48, 0.8]), np.array([-0.8, 0.0, 0.6])
    normal = ball_normals((200, 200), circle)
    mirrored = 2 * normal[..., 2:] * normal - [0, 0, 1]
    first, second = (mirrored @ way > np.cos(np.radians(wide)) for way, wide in ((light, 5.0), (other, degrees)))
    picture = np.where(normal[..., 2] > 0, np.maximum(first, brightness * second), 0)
    if refused:
        with pytest.raises(InputError, match="shows 2 highlights"):
            light_from_highlight(picture, circle)
        return
    assert angle(light_from_highlight(picture, circle), light) < 0.3


def test_a_highlight_at_the_edge_of_the_picture_is_refused():
    circle = Circle(20.0, 50.0, 60.0)
    normal = np.asarray(ball_points((100, 100), circle).normal)
    mirrored = 2 * normal[..., 2:] * normal - [0, 0, 1]
    light = np.array([-0.6, 0.0, 0.8])  # its mirror image stands at x = 1
    glow = np.where(normal[..., 2:] > 0, np.exp(400 * (mirrored @ light - 1))[..., None], 0)
    with pytest.raises(InputError, match="cuts through the highlight"):
        light_from_highlight(glow, circle)


def test_pictures_that_tell_no_light():
    points = ball_points(SHAPE, BALL)
    with pytest.raises(InputError, match="fewer than ten lit pixels"):
        light_from_shading(np.zeros((*SHAPE, 1)), points)
    flat = brdf.SurfacePoints.from_normals(np.broadcast_to([0.0, 0.0, 1.0], (*SHAPE, 3)))
    with pytest.raises(InputError, match="too little of the lit surface"):
        light_from_shading(np.ones((*SHAPE, 1)), flat)
    with pytest.raises(InputError, match="is black"):
        light_from_highlight(np.zeros((*SHAPE, 1)), BALL)
    with pytest.raises(InputError, match="no highlight"):
        light_from_highlight(np.ones((*SHAPE, 1)), BALL)


def test_the_length_of_a_direction_does_not_matter():
    picture, points = shaded((0.3, 0.4, 0.86)), ball_points(SHAPE, BALL)
    for length in (1e-300, 1e3, 1e308):
        scene = photograph_scene(brdf.Scene(points=points), np.array([0.3, 0.4, 0.86]) * length)
        k_d = fitting.fit(picture, scene, model="lambert").material.k_d
        assert np.allclose(k_d, 0.8, rtol=1e-5)


def test_light_files(tmp_path):
    (tmp_path / "a.txt").write_text("2\n0 0 1\n0.5, 0.5, 1 # two\n")
    assert read_directions(tmp_path / "a.txt", 2).tolist() == [[0, 0, 1], [0.5, 0.5, 1]]
    assert read_intensities(tmp_path / "a.txt").shape == (2, 3)
    for text, said in [
        ("", "is empty"),
        ("#", "no numbers"),
        ("1 2\n", "line 1"),
        ("1 2 x\n", "line 1"),
        ("0 0 0", "line 1"),
    ]:
        (tmp_path / "b.txt").write_text(text)
        with pytest.raises(InputError, match=said):
            read_directions(tmp_path / "b.txt")
    with pytest.raises(InputError, match="2 lines for 5 pictures"):
        read_directions(tmp_path / "a.txt", 5)


# -- what counts -------------------------------------------------------------------------------------------------------


def test_dark_pixels_are_left_out():
    picture = shaded((0.3, 0.4, 0.86))
    scene = photograph_scene(brdf.Scene(points=ball_points(SHAPE, BALL)), (0.3, 0.4, 0.86))
    result = fitting.fit(picture, scene, model="lambert", dark=0.2)
    assert result.left_out["dark"] == np.count_nonzero(ball_points(SHAPE, BALL).mask & (picture[..., 0] <= 0.2))
    with pytest.raises(InputError, match="no brighter than 5"):
        fitting.fit(picture, scene, model="lambert", dark=5.0)


def test_noise_weights_give_the_errors_of_the_camera():
    direction, read, shot = (0.3, 0.4, 0.86), 0.002, 0.003
    clean = shaded(direction)
    scene = photograph_scene(brdf.Scene(points=ball_points(SHAPE, BALL)), direction)
    estimates, errors = [], []
    for seed in range(60):
        sigma = np.sqrt(read**2 + shot * clean)
        noisy = (clean + sigma * np.random.default_rng(seed).standard_normal(clean.shape)).astype(np.float32)
        result = fitting.fit(noisy, scene, model="lambert", noise=(read, shot))
        (parameter,) = [one for one in result.parameters if one.name == "k_d"]
        estimates.append(parameter.value)
        errors.append(parameter.error)
    # 60 draws know a standard deviation to 9 %; weights from noisy values shift k_d by at most about one error.
    assert np.std(estimates) == pytest.approx(np.mean(errors), rel=0.35)
    assert np.mean(estimates) == pytest.approx(0.8, abs=2 * np.mean(errors))


def test_a_picture_in_another_unit_keeps_its_clipping(tmp_path):
    codes = np.arange(256, dtype=np.float32).reshape(16, 16, 1).repeat(3, axis=2) / 255
    brdf.write_image(tmp_path / "a.png", codes, encoding="linear")
    picture = brdf.read_picture(tmp_path / "a.png", encoding="linear")
    double = picture.scaled(2.0)
    assert double.saturation == 2.0
    coloured = picture.scaled(np.array([1.0, 2.0, 4.0]))
    assert np.isnan(coloured.pixels[-1, -1]).all()
    assert np.isfinite(coloured.pixels[-1, -2]).all()


# -- real photographs --------------------------------------------------------------------------------------------------

GRAY, CHROME = Circle(108.5, 108.5, 108), Circle(253.5, 148, 119.5)
AROUND_GRAY = np.s_[36:254, 136:354]


def photographs(ball: str) -> list[brdf.Picture]:
    """Of one ball, under twelve lights."""
    names = [f"{ball}.{index}.png" for index in range(12)]
    return [brdf.read_picture(REAL / "uw-spheres" / ball / name, encoding="linear") for name in names]


def gray_photographs() -> list[brdf.Picture]:
    """Without the two thirds of their pixels that lie around the ball."""
    return [dataclasses.replace(whole, pixels=whole.pixels[AROUND_GRAY]) for whole in photographs("gray")]


@real_data
def test_the_gray_sphere_is_matt_and_equally_bright_under_twelve_lights():
    directions = read_directions(REAL / "uw-spheres" / "lights.txt", 12)
    found = []
    for picture, direction in zip(gray_photographs(), directions, strict=True):
        scene = photograph_scene(brdf.Scene(points=ball_points(picture.pixels.shape[:2], GRAY)), direction)
        found.append(fitting.fit(picture, scene, model="lambert").material.k_d.mean())
    assert np.max(np.abs(found / np.mean(found) - 1)) < 0.02


@real_data
def test_the_gray_sphere_tells_its_own_lights_and_how_bright_they_are():
    strengths, brightest = [], []
    for picture in gray_photographs()[::2]:
        points = ball_points(picture.pixels.shape[:2], GRAY)
        strengths.append(light_from_shading(picture, points).strength)
        # Whatever its direction, a light shows its strength where the ball faces it; no model is needed to see that.
        grey = np.where(points.mask, picture.pixels.mean(axis=-1), 0)
        means = np.lib.stride_tricks.sliding_window_view(grey, (20, 20)).mean(axis=(2, 3))
        brightest.append(means.max())
    spread = np.array(strengths) / np.mean(strengths) - 1
    assert np.std(spread) < 0.02
    # The first light is the brightest by either measure: the lamps differ, one by more than 2 %.
    assert np.argmax(strengths) == np.argmax(brightest) == 0
    assert np.max(np.abs(np.delete(spread, 0))) < 0.02


@real_data
def test_lambert_is_chosen_for_the_gray_sphere():
    directions = read_directions(REAL / "uw-spheres" / "lights.txt", 12)[::3]
    pictures = gray_photographs()[::3]
    points = ball_points(pictures[0].pixels.shape[:2], GRAY)
    result = fitting.fit(pictures, [photograph_scene(brdf.Scene(points=points), direction) for direction in directions])
    assert result.material.name == "lambert"


@real_data
def test_lights_from_the_chrome_sphere():
    directions = read_directions(REAL / "uw-spheres" / "lights.txt", 12)
    apart = []
    for picture, direction in zip(photographs("chrome"), directions, strict=True):
        apart.append(angle(light_from_highlight(picture, CHROME), direction))
    # The file itself is off for three of the twelve.
    assert np.count_nonzero(np.array(apart) < 3) >= 9
