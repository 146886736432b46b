"""What a light is: samples, each a direction and an intensity at a surface point.

Intensity means what the classic shading equation means by it: the radiance that a white Lambertian surface facing the
light would show. Irradiance is π times that, and a sample of radiance L over the solid angle dω has the intensity
L dω / π. A light's emittance has C channels and the picture is linear in it. Each kind of light answers for one point
and one of its samples; batching over points and the sum over samples are outside.

Lights of one kind become one stack of arrays with a row for each sample, which one loop shades: a program is no larger
for a thousand lights than for two.
"""

import abc
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from brdf.checks import Scalar, Spectrum, Vector
from brdf.geometry.base import Shape
from brdf.geometry.surface_points import SurfacePoints


class LightSample(NamedTuple):
    """What one sample of a light sends to one surface point.

    Attributes:
        to_light: unit direction towards the light, (3,).
        intensity: what arrives, (C,), without the cosine at the surface.
        distance: to the light, in world units; infinite for a light at infinity.
        radius: angular radius, in radians, of a disc as large as the patch that the sample stands for: shadow edges
            sweep over it. None for light without extent, whose shadows are hard.
        moments: where the sample stands for a patch of the sky, the mean of its directions weighted by radiance, (3,),
            shorter than 1, and their covariance, (3, 3); None for a single direction.
        lobe_only: 1 where the sample counts for the specular term alone, 0 where for the diffuse alone; None for both.
    """

    to_light: Vector
    intensity: Spectrum
    distance: Scalar
    radius: Scalar | None = None
    moments: tuple[Vector, Float[Array, "3 3"]] | None = None
    lobe_only: Scalar | None = None


class Light(eqx.Module):
    """A source of light.

    Attributes:
        type_name: what ``type`` in a scene file says.
    """

    type_name: ClassVar[str]

    @abc.abstractmethod
    def rows(self) -> tuple[Any, ...]:
        """What `sample` takes: arrays with one leading axis, as long as the light has samples."""

    @staticmethod
    @abc.abstractmethod
    def sample(point: SurfacePoints, *row: Any) -> LightSample:
        """What one sample sends to one point."""

    @property
    def emittance(self) -> Spectrum:
        """The field that the picture is linear in, intensity or radiance, (C,)."""
        fields = vars(self)
        return fields["intensity" if "intensity" in fields else "radiance"]


def repeated(count: int, *values: Any) -> tuple[Any, ...]:
    """Each value ``count`` times, as rows."""
    rows = []
    for value in values:
        xp = jnp if isinstance(value, Tracer) else np
        rows.append(xp.broadcast_to(value, (count, *value.shape)))
    return tuple(rows)


class LightStack(eqx.Module):
    """The lights of one kind.

    Attributes:
        kind: their class.
        rows: of all their samples, arrays (S, ...).
        light: which of the scene's lights each row belongs to, (S,).
    """

    kind: type[Light] = eqx.field(static=True)
    rows: tuple[Array, ...]
    light: Int[Array, " S"]


class Lighting(eqx.Module):
    """The lights, and the shapes that stand in their way.

    Attributes:
        stacks: the lights, kind by kind.
        occluders: the scene's shapes in its order; none where they cannot shadow anything that is seen.
    """

    stacks: tuple[LightStack, ...]
    occluders: tuple[Shape, ...] = ()

    @property
    def samples(self) -> int:
        """Of all lights together."""
        return sum(stack.light.shape[0] for stack in self.stacks)

    def each(self) -> Iterator[tuple[type[Light], tuple[Array, ...], Array]]:
        """Every sample on its own: the kind of its light, its numbers, which light it belongs to."""
        for stack in self.stacks:
            for index in range(stack.light.shape[0]):
                yield stack.kind, tuple(values[index] for values in stack.rows), stack.light[index]


def stacked(lights: Sequence[Light], dtype: Any) -> tuple[LightStack, ...]:
    """Lights as arrays, kind by kind; those of one kind that have no common shape, as of other channels, apart."""
    kinds: dict[Any, list[tuple[Any, ...]]] = {}
    for index, light in enumerate(lights):
        rows = light.rows()
        shapes = tuple(values.shape[1:] for values in rows)
        kinds.setdefault((type(light), shapes), []).append((*rows, np.full(rows[0].shape[0], index, np.int32)))
    stacks = []
    for (kind, _), members in kinds.items():
        *rows, light = (_joined(values) for values in zip(*members, strict=True))
        stacks.append(LightStack(kind, tuple(jnp.asarray(values, dtype) for values in rows), light))
    return tuple(stacks)


def _joined(values: Sequence[Any]) -> Any:
    traced = any(isinstance(value, Tracer) for value in values)
    return jnp.concatenate(values) if traced else np.concatenate(values)
