"""What drew the example that the documentation names lies within what a fit of it tells."""

import dataclasses
import json

import numpy as np
from project_paths import ROOT

import brdf
import fitting


def test_the_truth_of_the_area_light_lies_within_its_intervals():
    folder = ROOT / "data" / "area-light"
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    scene = brdf.Scene.load(folder / "scene.toml")
    result = fitting.fit(brdf.read_picture(folder / "target.exr"), scene, model=truth["model"])
    for one in result.parameters:
        true = truth[one.name] if one.channel is None else truth[one.name][one.channel]
        assert one.interval[0] <= true <= one.interval[1], str(result)
    # What the samples of the light leave goes together: it is known, and in the errors. What else does is told.
    assert not result.warnings
    light = dataclasses.replace(scene.lights[0], center=scene.lights[0].center + np.array([0.05, 0.0, 0.0]))
    moved = dataclasses.replace(scene, lights=(light,))
    result = fitting.fit(brdf.read_picture(folder / "target.exr"), moved, model=truth["model"])
    assert any("structure" in warning for warning in result.warnings)
