"""Scenes under other lights: with more or fewer light samples."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx

import brdf
from brdf.lights.base import Light


def extended(scene: brdf.Scene) -> bool:
    """Whether a scene has a light whose number of samples can be chosen.

    Args:
        scene: any.
    """
    return any(hasattr(light, "samples") for light in scene.lights)


def with_lights(scene: brdf.Scene, lights: Sequence[Light]) -> brdf.Scene:
    """The scene under other lights, none of them masked.

    Args:
        scene: any.
        lights: instead of its own.
    """
    return dataclasses.replace(scene, lights=tuple(lights), visibility=())


class Lamps:
    """Scenes with other numbers of light samples; maps are cut up once for each number."""

    def __init__(self) -> None:
        """Nothing made yet."""
        self._made: dict[tuple[int, int], tuple[Light, Light]] = {}

    def with_samples(self, scene: brdf.Scene, samples: int | None) -> brdf.Scene:
        """The scene with so many samples in each of its lights with an extent.

        Args:
            scene: any.
            samples: at most so many; None leaves it as it is.
        """
        if samples is None or not extended(scene):
            return scene
        return dataclasses.replace(scene, lights=tuple(self._light(light, samples) for light in scene.lights))

    def _light(self, light: Any, samples: int) -> Any:
        if not hasattr(light, "samples") or light.samples == samples:
            return light
        key = (id(light), samples)
        if key not in self._made:
            if isinstance(light, brdf.EnvironmentMap):
                plain = brdf.EnvironmentMap(light.pixels, samples=samples)
                made = eqx.tree_at(lambda one: one.radiance, plain, plain.radiance * light.radiance)
            else:
                made = dataclasses.replace(light, samples=samples)
            # The light is kept, or another might come to have its identity.
            self._made[key] = (light, made)
        return self._made[key][1]


def with_samples(scene: brdf.Scene, samples: int | None) -> brdf.Scene:
    """As `Lamps.with_samples`, once.

    Args:
        scene: any.
        samples: at most so many.
    """
    return Lamps().with_samples(scene, samples)
