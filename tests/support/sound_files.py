"""Sound files, to be spoiled one at a time."""

import json
from pathlib import Path

import numpy as np

import brdf
from benchmarks.fuzz_corpus import CAMERA, LIGHT, SPHERE

SCENE = CAMERA + SPHERE + LIGHT


MATERIAL = {"model": "blinn-phong", "k_a": [0.1], "k_d": [0.5], "k_s": [0.3], "n": 37.5}


def scene(old: str, new: str, base: str = SCENE) -> str:
    """The sound scene, spoiled in one place."""
    assert old in base
    return base.replace(old, new)


def sound_files(folder: Path) -> Path:
    """A scene, a material and a picture of 8 x 8 pixels."""
    (folder / "scene.toml").write_text(SCENE)
    (folder / "material.json").write_text(json.dumps(MATERIAL))
    brdf.write_image(folder / "target.exr", np.linspace(0.1, 0.9, 192, dtype=np.float32).reshape(8, 8, 3))
    return folder
