"""What the error of a light does to the numbers, against fits under turned lights."""

import numpy as np

import brdf
import fitting
from fitting.photographs.light_error import with_light_errors

CAMERA = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(48, 48))
DEGREES = 0.3


def scene(direction: np.ndarray) -> brdf.Scene:
    light = brdf.DirectionalLight(direction=direction, intensity=[1.0])
    return brdf.Scene(CAMERA, [brdf.Sphere([0, 0, 0], 1)], ambient=[0.2], lights=[light])


def test_errors_hold_what_turned_lights_change():
    direction = np.array([0.4, 0.5, 0.768])
    material = brdf.BlinnPhong(k_a=[0.1], k_d=[0.5], k_s=[0.3], n=20)
    target = np.asarray(brdf.render(material, scene(direction), precision="float64"))
    target = target + np.random.default_rng(0).normal(0, 0.003, target.shape)
    result = fitting.fit(target, scene(direction), model="blinn-phong", precision="float64")
    wider = with_light_errors(result, [DEGREES])
    squares = {one.key: 0.0 for one in result.parameters}
    for turn in np.linalg.svd(direction[None])[2][1:]:
        # Half the difference of fits under lights turned by one standard error each way, of each of two turns.
        step = np.radians(DEGREES) / np.sqrt(2) * np.linalg.norm(direction) * turn
        both = [
            fitting.fit(target, scene(direction + sign * step), model="blinn-phong", precision="float64")
            for sign in (1, -1)
        ]
        for one in result.parameters:
            ahead, behind = (next(p for p in fit.parameters if p.key == one.key) for fit in both)
            squares[one.key] += ((float(ahead) - float(behind)) / 2) ** 2
    grown = []
    for before, after in zip(result.parameters, wider.parameters, strict=True):
        error, low, high = np.array([after.error, *(after.interval or (np.nan, np.nan))], float)
        np.testing.assert_allclose(error, np.hypot(np.array(before.error), squares[before.key] ** 0.5), rtol=0.05)
        assert low < np.min(before.interval or np.nan) < np.max(before.interval or np.nan) < high
        grown.append(error / np.array(before.error))
    assert max(grown) > 2
