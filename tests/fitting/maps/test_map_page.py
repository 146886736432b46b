"""The page of maps shows in a browser what `Maps.render` shows, to the codes that it holds, and loads nothing."""

import re
from pathlib import Path

import numpy as np
import pytest
from browser_pages import asked, drawn, needs_browser

import brdf
import fitting
from fitting.maps.map_result import REASONS

LIGHTS = [[0.0, 0.0, 1.0], [0.6, -0.3, 0.74], [-0.7, 0.65, 0.3]]
MODELS = [("blinn-phong",), ("normalized-phong",), ("normalized-blinn-phong",), ("lambert", "phong", "blinn-phong")]


def some_maps(models: tuple[str, ...], size: tuple[int, int] = (24, 36)) -> fitting.Maps:
    """Texels that lean every way, dull and sharp; a corner is outside."""
    random = np.random.default_rng(2)
    z, turn = random.uniform(0.05, 1, size), random.uniform(0, 2 * np.pi, size)
    normal = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=-1)
    reason, chosen = random.integers(0, len(REASONS), size), random.integers(0, len(models), size)
    reason = np.where(reason == 1, 0, reason)
    reason[:6, :6], normal[:6, :6] = 1, 0
    n, number = np.exp(random.uniform(0, np.log(1000), size)), random.uniform(0.1, 0.9, size)
    lobe = np.array([peak(name, n) for name in models])
    k_s = random.uniform(0, 0.5, (*size, 3)) / np.take_along_axis(lobe, chosen[None], 0)[0][..., None]
    k_s[np.array(models)[chosen] == "lambert"] = 0
    k_d = random.uniform(0, 0.5, (*size, 3))
    layers = {"n": np.where(reason == 0, n, np.nan), "k_d": k_d, "k_s": k_s, "fitted_n": n, "fitted_k_s": k_s}
    layers |= {name: number for name in ("n_error", "normal_error", "residual")}
    layers |= {"k_d_error": k_d, "k_s_error": k_s, "normal": normal, "determined": reason == 0}
    layers |= {"reason": reason.astype(np.uint8), "chosen": chosen.astype(np.uint8)}
    for name in ("k_d", "k_s", "fitted_k_s"):
        layers[name] = np.where(reason[..., None] == 1, 0, layers[name])
    return fitting.Maps(**layers, models=models, to_view=np.array([0.1, -0.2, 1.0]))


def peak(name: str, n: np.ndarray) -> np.ndarray:
    model = brdf.MODELS[name]
    return np.asarray(model.scale(n)) if hasattr(model, "scale") else np.ones_like(n)


@needs_browser
def test_the_page_draws_what_render_draws(tmp_path: Path):
    every = [some_maps(models) for models in MODELS]
    states = [f"exposure=0&srgb=false&light0={','.join(map(str, light))}" for light in LIGHTS]
    for maps, answer in zip(every, drawn([(maps.view().text, states) for maps in every], tmp_path), strict=True):
        assert (answer["messages"], answer["requests"]) == ([], [])
        lobes = np.choose(maps.chosen, [peak(name, maps.fitted_n) for name in maps.models])[..., None] * maps.fitted_k_s
        for codes, light in zip(answer["codes"], LIGHTS, strict=True):
            picture = maps.render(light)
            # What the page holds is rounded: coefficients to 5e-4 of each, normals to 5e-5 radians, over which a lobe
            # changes by up to (n / e)^½ of its peak a radian (twice that about the mirror direction), n to 1e-4.
            held = 5e-4 * picture + 5e-5 * maps.k_d
            held += lobes * (2 * 5e-5 * np.sqrt(maps.fitted_n / np.e) + 1e-4)[..., None]
            off = np.abs(codes - 255.0 * np.clip(picture, 0, 1))
            assert np.all(off <= 0.51 + 255 * held), maps.models
            assert np.max(picture) > 0.5


@needs_browser
def test_each_map_is_shown(tmp_path: Path):
    maps = some_maps(MODELS[0])
    states = [f"srgb=false&map={name}" for name in ("normal", "determined", "k_d")]
    (answer,) = drawn([(maps.view().text, states)], tmp_path)
    normal, determined, k_d = answer["codes"]
    inside = maps.reason != 1
    assert np.max(np.abs(normal - 255 * (0.5 * maps.normal + 0.5))[inside]) <= 0.51
    assert not normal[~inside].any()
    assert np.array_equal(np.all(determined == determined[inside & (maps.reason == 0)][0], axis=-1), maps.reason == 0)
    white = np.percentile(maps.k_d[inside], 99.5)
    assert np.max(np.abs(k_d - 255 * np.clip(maps.k_d / white, 0, 1))[inside]) <= 0.51 + 0.13


@needs_browser
def test_a_reader_moves_the_light(tmp_path: Path):
    maps = some_maps(MODELS[0])
    maps.view("<b>maps").save(tmp_path / "page.html")
    seen = asked("relight_page", tmp_path / "page.html")
    assert (seen["messages"], seen["requests"]) == ([], [])
    dragged, pressed = (np.array(seen[key].split(","), float) for key in ("dragged", "pressed"))
    assert dragged[:2] == pytest.approx([0.25 * 36 / 12, 0.5], abs=0.05)  # 24 rows high, 36 columns wide
    assert np.degrees(np.arccos(dragged @ pressed)) == pytest.approx(3 * np.hypot(dragged[0], dragged[2]), abs=0.1)
    column, row = map(int, re.search(r"column (\d+), row (\d+)", seen["pointer"]).groups())
    assert (column, row) == (27, 6)
    assert REASONS[maps.reason[row, column]] in seen["pointer"]
    assert f"{maps.fitted_n[row, column]:.3g}"[:3] in seen["pointer"]
    assert seen["legends"]["k_d"].startswith("White is 0.49")
    assert seen["without"] == {"still": True, "viewer": False}


def test_large_maps_are_thinned_and_small_ones_shown_in_jupyter():
    assert "every 2th column" in some_maps(MODELS[0], (4, 1100)).view().text
    maps = some_maps(MODELS[0])
    assert "data:image/png;base64," in maps._repr_html_()
    assert "36 x 24 texels" in maps._repr_html_()
    assert "<b>maps" not in maps.view("<b>maps").text
