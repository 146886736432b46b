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
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from brdf.checks import Checked, Spectrum
from brdf.geometry.base import Shape
from brdf.geometry.surface_points import Points
from brdf.vectors import Components


class LightSample(NamedTuple):
    """What samples of a light that emit 1 send to surface points.

    Attributes:
        to_light: unit direction towards the light.
        intensity: what arrives, without the cosine at the surface.
        distance: to the light, in world units; infinite for a light at infinity.
        radius: angular radius, in radians, of a disc as large as the patch that the sample stands for: shadow edges
            sweep over it. None for light without extent, whose shadows are hard.
        moments: where the sample stands for a patch of the sky, the mean of its directions weighted by radiance,
            shorter than 1, and the rows of their covariance; None for a single direction.
        lobe_only: 1 where the sample counts for the specular term alone, 0 where for the diffuse alone; None for both.
    """

    to_light: Components
    intensity: Any
    distance: Array
    radius: Array | None = None
    moments: tuple[Components, tuple[Components, ...]] | None = None
    lobe_only: Array | None = None


class Light(Checked):
    """A source of light.

    Attributes:
        type_name: what ``type`` in a scene file says.
        emits: the places in a row whose product is a spectrum that the sample's intensity is proportional to.
        weighs: the place among a sample's own numbers that its intensity is proportional to; None for a light of one.
    """

    type_name: ClassVar[str]
    emits: ClassVar[tuple[int, ...]]
    weighs: ClassVar[int | None] = None

    @property
    @abc.abstractmethod
    def rows(self) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """Its numbers, and those of its samples: arrays with one leading axis, none for a light of a single sample."""

    @staticmethod
    @abc.abstractmethod
    def sample(point: Points, *row: Any) -> LightSample:
        """What samples send to points; lights with an extent put their samples above the horizon.

        Args:
            point: where, (P,).
            row: the light's numbers, and those of its samples, (S, 1) each; 1 for what it emits.
        """

    @property
    def emittance(self) -> Spectrum:
        """The field that the picture is linear in, intensity or radiance, (C,)."""
        fields = vars(self)
        return fields["intensity" if "intensity" in fields else "radiance"]


AnyArray = Array | np.ndarray

# Where samples are filled up, to a multiple of this.
FILLED = 4096


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class LightStack:
    """The L lights of one kind with S samples each; those of a single sample are together the samples of one.

    Attributes:
        kind: their class.
        numbers: of each light, arrays (L, ...).
        nodes: of each light's samples, arrays (L, S, ...).
        light: which of the scene's lights each sample belongs to, (L, S).
    """

    kind: type[Light] = dataclasses.field(metadata={"static": True})
    numbers: tuple[AnyArray, ...]
    nodes: tuple[AnyArray, ...]
    light: Int[AnyArray, "L S"]

    @property
    def samples(self) -> int:
        """Of all the lights."""
        return math.prod(self.light.shape)

    @property
    def channels(self) -> int:
        """Of what is emitted."""
        row = *self.numbers, *self.nodes
        return max(row[place].shape[-1] for place in self.kind.emits)

    def emitted(self) -> Float[Array, "L S C"]:
        """What each sample emits, for an intensity of 1."""
        row = [*(values[:, None] for values in self.numbers), *self.nodes]
        product = functools.reduce(operator.mul, (row[place] for place in self.kind.emits))
        return jnp.broadcast_to(product, (*self.light.shape, self.channels))

    def chunks(self, largest: int) -> tuple[tuple[Array, ...], Int[Array, "L K B"], Float[Array, "L K B C"]]:
        """Nodes, lights and emission by chunks of up to so many samples; samples of no light fill up the last one."""
        count = self.light.shape[1]
        chunks = -(-count // largest)
        place = np.arange(chunks * -(-count // chunks)).reshape(chunks, -1)
        nodes, light, emitted = jax.tree.map(
            lambda leaf: jnp.asarray(leaf)[:, np.minimum(place, count - 1)], (self.nodes, self.light, self.emitted())
        )
        return nodes, light, jnp.where((place < count)[..., None], emitted, 0)


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
        return sum(stack.samples for stack in self.stacks)


def stacked(lights: Sequence[Light], dtype: Any, fill_above: float = math.inf) -> tuple[LightStack, ...]:
    """Lights as arrays, kind by kind; those of one kind that have no common shape, as of other channels, apart.

    Args:
        lights: of a scene.
        dtype: of the arrays.
        fill_above: lights of more samples get further ones that send nothing, so that one program serves many numbers.
    """
    kinds: dict[Any, list[tuple[Any, ...]]] = {}
    for index, light in enumerate(lights):
        numbers, nodes = light.rows
        shapes = tuple(np.shape(values) for values in (*numbers, *nodes))
        kinds.setdefault((type(light), len(numbers), shapes), []).append((index, *numbers, *nodes))
    stacks = []
    for (kind, count, _), members in kinds.items():
        index, *values = zip(*members, strict=True)
        values = [_stack(each, dtype) for each in values]
        light = np.array(index, np.int32)
        if len(values) == count:
            stacks.append(LightStack(kind, (), tuple(each[None] for each in values), light[None]))
            continue
        numbers, nodes = values[:count], values[count:]
        if (
            kind.weighs is not None
            and nodes[0].shape[1] > fill_above
            and all(isinstance(each, np.ndarray) for each in nodes)
        ):
            nodes = _filled(nodes, kind.weighs)
        each = np.broadcast_to(light[:, None], nodes[0].shape[:2])
        stacks.append(LightStack(kind, tuple(numbers), tuple(nodes), each))
    return tuple(stacks)


def _filled(nodes: Sequence[np.ndarray], weighs: int) -> list[np.ndarray]:
    """Samples of lights, and further ones that send nothing."""
    each = nodes[0].shape[1]
    found = [np.pad(one, [(0, 0), (0, -each % FILLED)] + [(0, 0)] * (one.ndim - 2), mode="edge") for one in nodes]
    found[weighs][:, each:] = 0
    return found


def _stack(values: Sequence[Any], dtype: Any) -> Any:
    traced = any(isinstance(value, Tracer) for value in values)
    return jnp.stack(values).astype(dtype) if traced else np.stack(values).astype(dtype)
