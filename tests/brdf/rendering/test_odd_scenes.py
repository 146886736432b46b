"""Scene files with what no scene holds: names that are lists, endless lists, lights that stand where nobody knows."""

import re
from pathlib import Path

import numpy as np
import pytest

import brdf
from benchmarks.fuzz_corpus import CAMERA, LIGHT, POINT, SPHERE
from brdf.errors import InputError
from brdf.images.writing import write_layers

AOV = '[aov]\nfile = "n.exr"\n'
SHADOW = LIGHT + 'visibility = "n.exr"\n'
ENVIRONMENT = CAMERA + SPHERE + '[[lights]]\ntype = "environment"\n'
REFUSED = {
    "layer is a list": (AOV + 'normal = ["a"]\n' + LIGHT, r"aov\.normal: must be the name of a layer, got \['a'\]"),
    "layer is a number": (AOV + "position = 3\n" + LIGHT, r"aov\.position: must be the name of a layer, got 3"),
    "layer is missing": (AOV + 'position = "P"\n' + LIGHT, r"n\.exr: has no layer 'P', got the unnamed one, normal"),
    "shadow's layer": (CAMERA + SPHERE + SHADOW + "visibility_layer = []\n", r"lights\[0\]\.visibility_layer: must be"),
    "to_view is text": (AOV + 'to_view = "x"\n' + LIGHT, r"aov\.to_view: must be a number, got 'x'"),
    "to_view is zero": (AOV + "to_view = [0, 0, 0]\n" + LIGHT, r"aov\.to_view: must not have zero length"),
    "to_view is ragged": (AOV + "to_view = [[0], 0, 1]\n" + LIGHT, r"aov\.to_view: must be three numbers"),
    "to_view is short": (AOV + "to_view = [0, 1]\n" + LIGHT, r"aov\.to_view: must be three numbers"),
    "no positions": (
        AOV + POINT,
        r"lights\[0\]: stands somewhere, but .*aov has no layer of positions\. Add the layer",
    ),
    "occluders": (
        AOV + '[[shapes]]\ntype = "sphere"\ncenter = [0, 0, 2]\nradius = 0.5\nfitted = false\n' + LIGHT,
        r"shapes: stand somewhere, but .*aov has no layer of positions\. Add the layer",
    ),
    "empty name": (ENVIRONMENT + 'file = ""\n', r"lights\[0\]\.file: must be a path, got ''"),
    "long list": (
        CAMERA + SPHERE + LIGHT.replace("1.0, ", "1.0, " * 3000),
        r"intensity: has 6001 entries\. Give at most",
    ),
    "long file": ("#" * (5 << 20), r"is larger than 4 MiB"),
    "not UTF-8": ("# caf\xe9 \n", r"is not UTF-8 text \(line 1"),
}


@pytest.fixture
def place(tmp_path: Path) -> Path:
    normal = np.zeros((8, 8, 3), np.float32)
    normal[..., 2] = 1
    write_layers(tmp_path / "n.exr", {"": normal, "normal": normal})
    return tmp_path


@pytest.mark.parametrize("name", REFUSED)
def test_a_scene_that_is_refused(place, name):
    content, said = REFUSED[name]
    (place / "scene.toml").write_bytes(content.encode("latin-1"))
    with pytest.raises(InputError) as told:
        brdf.Scene.load(place / "scene.toml")
    assert re.search(said, str(told.value)), told.value
    assert str(told.value).startswith(str(place))


@pytest.mark.parametrize("light", [LIGHT, '[[lights]]\ntype = "environment"\nradiance = 1\n'])
def test_lights_from_far_away_need_no_positions(place, light):
    (place / "scene.toml").write_text(AOV + light)
    assert brdf.Scene.load(place / "scene.toml").points is not None
