"""What a light is: samples, each a direction and an intensity at a surface point.

Intensity means what the classic shading equation means by it: the radiance that a white Lambertian surface facing the
light would show. Irradiance is π times that, and a sample of radiance L over the solid angle dω has the intensity
L dω / π. A light's emittance has C channels and the picture is linear in it. Each kind of light answers for one point
and one of its samples; batching over points and the sum over samples are outside.

Lights of one kind and as many samples are one stack of arrays, which one loop over lights and samples shades: a program
is no larger for a thousand lights than for two.
"""

import abc
import dataclasses
import functools
import math
import operator
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from brdf.checks import Checked, Scalar, Spectrum, Vector
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


class Light(Checked):
    """A source of light.

    Attributes:
        type_name: what ``type`` in a scene file says.
        emits: the places in a row whose product is a spectrum that the sample's intensity is proportional to.
        weighs: the place among a sample's own numbers that its intensity is proportional to.
    """

    type_name: ClassVar[str]
    emits: ClassVar[tuple[int, ...]]
    weighs: ClassVar[int] = -1

    @abc.abstractmethod
    def rows(self) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """Its numbers, and those of its samples: arrays with one leading axis, none for a light of a single sample."""

    @staticmethod
    @abc.abstractmethod
    def sample(point: SurfacePoints, *row: Any) -> LightSample:
        """What one sample sends to one point; lights with an extent put their samples above its horizon.

        Args:
            point: where.
            row: the light's numbers and those of one of its samples.
        """

    @property
    def emittance(self) -> Spectrum:
        """The field that the picture is linear in, intensity or radiance, (C,)."""
        fields = vars(self)
        return fields["intensity" if "intensity" in fields else "radiance"]


# Where samples are filled up, to a multiple of this.
FILLED = 4096


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class LightStack:
    """The L lights of one kind, with S samples each.

    Attributes:
        kind: their class.
        numbers: of each light, arrays (L, ...).
        nodes: of each light's samples, arrays (L, S, ...); none where S is 1.
        light: which of the scene's lights each is, (L,).
    """

    kind: type[Light] = dataclasses.field(metadata={"static": True})
    numbers: tuple[Array, ...]
    nodes: tuple[Array, ...]
    light: Int[Array, " L"]

    @property
    def samples(self) -> int:
        """Of all the lights."""
        return self.light.shape[0] * (self.nodes[0].shape[1] if self.nodes else 1)

    @property
    def spectra(self) -> list[Array]:
        """What multiplies each other to what a sample emits, (L, 1 or S, C) each."""
        found, count = [*self.numbers, *self.nodes], len(self.numbers)
        return [found[place] if place >= count else found[place][:, None] for place in self.kind.emits]

    def emitted(self, channels: int) -> Float[Array, "L S C"]:
        """What each sample emits, in so many channels, for an intensity of 1."""
        each = self.nodes[0].shape[1] if self.nodes else 1
        product = functools.reduce(operator.mul, self.spectra)
        return jnp.broadcast_to(product, (self.light.shape[0], each, channels))

    def rows(self) -> tuple[tuple[Array, ...], Array]:
        """What `Light.sample` takes, one row for each sample, and the light that each belongs to."""
        if not self.nodes:
            return self.numbers, self.light
        each = self.nodes[0].shape[1]
        numbers = tuple(jnp.repeat(values, each, axis=0) for values in self.numbers)
        nodes = tuple(values.reshape(-1, *values.shape[2:]) for values in self.nodes)
        return (*numbers, *nodes), jnp.repeat(self.light, each)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Lighting:
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
        return sum(map(operator.attrgetter("samples"), self.stacks))

    def each(self) -> Iterator[tuple[type[Light], tuple[Array, ...], Array]]:
        """Every sample on its own: the kind of its light, its row, which light it belongs to."""
        for stack in self.stacks:
            rows, light = stack.rows()
            for index in range(stack.samples):
                yield stack.kind, tuple(values[index] for values in rows), light[index]


def stacked(lights: Sequence[Light], dtype: Any, fill_above: float = math.inf) -> tuple[LightStack, ...]:
    """Lights as arrays, kind by kind; those of one kind that have no common shape, as of other channels, apart.

    Args:
        lights: of a scene.
        dtype: of the arrays.
        fill_above: lights of more samples get further ones that send nothing, so that one program serves many numbers.
    """
    kinds: dict[Any, list[tuple[Any, ...]]] = {}
    for index, light in enumerate(lights):
        numbers, nodes = light.rows()
        shapes = tuple(values.shape for values in (*numbers, *nodes))
        kinds.setdefault((type(light), len(numbers), shapes), []).append((np.int32(index), *numbers, *nodes))
    stacks = []
    for (kind, count, _), members in kinds.items():
        light, *values = map(_stack, zip(*members, strict=True))
        values[count:] = _filled(values[count:], kind.weighs, fill_above)
        values = tuple(jnp.asarray(value, dtype) for value in values)
        stacks.append(LightStack(kind, values[:count], values[count:], light))
    return tuple(stacks)


def _filled(nodes: Sequence[Any], weighs: int, above: float) -> list[Any]:
    """Samples of lights, and further ones that send nothing, where there are more than so many."""
    each = nodes[0].shape[1] if nodes else 0
    if each <= above or not all(isinstance(values, np.ndarray) for values in nodes):
        return list(nodes)
    more = -each % FILLED
    found = [np.concatenate([values, np.repeat(values[:, -1:], more, axis=1)], axis=1) for values in nodes]
    found[weighs][:, each:] = 0
    return found


def _stack(values: Sequence[Any]) -> Any:
    traced = any(isinstance(value, Tracer) for value in values)
    return jnp.stack(values) if traced else np.stack(values)
