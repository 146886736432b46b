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
import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from brdf.checks import Checked, Spectrum
from brdf.geometry.shapes import Shape
from brdf.geometry.surface_points import SurfacePoints
from brdf.precision import pytree
from brdf.vectors import Components


class LightSample(NamedTuple):
    """What samples of a light that emit 1 send to surface points.

    Attributes:
        to_light: unit direction towards the light.
        intensity: what arrives, without the cosine at the surface.
        distance: to the light, in world units; infinite for a light at infinity.
        radius: angular radius, in radians, of a disc as large as the patch that the sample stands for: shadow edges
            sweep over it. None for light without extent, whose shadows are hard.
        cosine: (N·L)+, where the sample stands for a patch of the sky, its mean over that; None for a single direction.
        above: the share of such a patch above the horizon.
        lobe_intensity: what arrives for the specular term, where that is another.
    """

    to_light: Components
    intensity: Any
    distance: Array
    radius: Array | None = None
    cosine: Array | None = None
    above: Array | float = 1.0
    lobe_intensity: Any = None


Rows = tuple[tuple[Any, ...], tuple[Any, ...], Any]


class Light(Checked):
    """A source of light.

    Attributes:
        type_name: what ``type`` in a scene file says.
    """

    type_name: ClassVar[str]

    @property
    def rows(self) -> Rows:
        """Its numbers; those of its samples, (S, ...) each; the spectrum they emit, (C,), or (S, C).

        A light without extent is a single sample, of all its numbers in the order of its fields.
        """
        values = [getattr(self, field.name) for field in dataclasses.fields(self) if field.name != "intensity"]
        # On the host where they are known, or each would be a program.
        return (), tuple((one if isinstance(one, Tracer) else np.asarray(one))[None] for one in values), self.emittance

    @staticmethod
    @abc.abstractmethod
    def sample(point: SurfacePoints, *row: Any) -> LightSample:
        """What samples send to points; lights with an extent put their samples above the horizon.

        Args:
            point: where, (P,).
            row: the light's numbers, and those of its samples, (S, 1) each.
        """

    @property
    def emittance(self) -> Spectrum:
        """The field that the picture is linear in, intensity or radiance, (C,)."""
        fields = vars(self)
        return fields["intensity" if "intensity" in fields else "radiance"]


AnyArray = Array | np.ndarray

FILLED = 4096
"""Samples are filled up to a multiple of this."""


@pytree
class LightStack:
    """The L lights of one kind with S samples each.

    Attributes:
        kind: their class.
        numbers: of each light, arrays (L, ...).
        nodes: of each light's samples, arrays (L, S, ...).
        emitted: what each sample emits, (L, S, C).
        light: which of the scene's lights each sample belongs to, (L, S).
    """

    kind: type[Light] = dataclasses.field(metadata={"static": True})
    numbers: tuple[AnyArray, ...]
    nodes: tuple[AnyArray, ...]
    emitted: Float[AnyArray, "L S C"]
    light: Int[AnyArray, "L S"]

    def chunks(self, largest: int) -> tuple[Array, tuple[Any, Any, Array]]:
        """Emission, (K, B, C), and numbers, nodes and lights by chunks of up to so many samples of one light, (K, ...).

        Lights that are a sample each are taken together, as the samples of one. Samples of no light fill up the last
        chunk.
        """
        each: Any = jax.tree.map(jnp.asarray, (self.nodes, self.emitted, self.light))
        if not self.numbers and self.light.shape[1] == 1:
            each = jax.tree.map(lambda leaf: leaf.swapaxes(0, 1), each)
        count = each[2].shape[1]
        chunks = -(-count // largest)
        index = np.arange(chunks * -(-count // chunks)).reshape(chunks, -1)
        nodes, emitted, light = jax.tree.map(lambda leaf: leaf[:, np.minimum(index, count - 1)], each)
        emitted = jnp.where((index < count)[..., None], emitted, 0)
        nodes, emitted, light = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (nodes, emitted, light))
        return emitted, (jax.tree.map(lambda leaf: jnp.repeat(leaf, chunks, axis=0), self.numbers), nodes, light)


@pytree
class Lighting:
    """The lights, and the shapes that stand in their way.

    Attributes:
        stacks: the lights, kind by kind.
        occluders: the scene's shapes in its order; none where they cannot shadow anything that is seen.
        sky: what comes from everywhere alike to every point, (C,), apart from the stacks; None for nothing.
    """

    stacks: tuple[LightStack, ...]
    occluders: tuple[Shape, ...] = ()
    sky: Float[AnyArray, " C"] | None = None

    @property
    def samples(self) -> int:
        """Of all lights together, less the sky."""
        return sum(math.prod(stack.light.shape) for stack in self.stacks)

    @property
    def channels(self) -> int:
        """Of what is emitted."""
        own = [] if self.sky is None else [self.sky.shape[-1]]
        return max([stack.emitted.shape[-1] for stack in self.stacks] + own)


def stacked(
    lights: Sequence[Light], dtype: Any, fill_above: float = math.inf, *, index: Sequence[int] | None = None
) -> tuple[LightStack, ...]:
    """Lights as arrays, kind by kind; those of one kind that have no common shape, as of other channels, apart.

    Args:
        lights: of a scene.
        dtype: of the arrays.
        fill_above: lights of more samples get further ones that send nothing, so that one program serves many numbers.
        index: which of the scene's lights they are; None for all.
    """
    kinds: dict[Any, list[Any]] = {}
    for place, light in zip(range(len(lights)) if index is None else index, lights, strict=True):
        shapes = tuple(np.shape(values) for values in jax.tree.leaves(light.rows))
        kinds.setdefault((type(light), shapes), []).append((place, light.rows))
    stacks = []
    for (kind, _), members in kinds.items():
        places, rows = zip(*members, strict=True)
        numbers, nodes, emitted = jax.tree.map(lambda *values: _stack(values, dtype), *rows)
        samples = nodes[0].shape[1]
        each = emitted.reshape(len(places), -1, emitted.shape[-1])
        emitted = each.repeat(samples // each.shape[1], axis=1)
        if samples > fill_above and all(isinstance(one, np.ndarray) for one in (*nodes, emitted)):
            more = [(0, 0), (0, -samples % FILLED)]
            *nodes, emitted = (np.pad(one, more + [(0, 0)] * (one.ndim - 2), mode="edge") for one in (*nodes, emitted))
            emitted[:, samples:] = 0
        light = np.broadcast_to(np.array(places, np.int32)[:, None], emitted.shape[:2])
        stacks.append(LightStack(kind, numbers, tuple(nodes), emitted, light))
    return tuple(stacks)


def _stack(values: Sequence[Any], dtype: Any) -> Any:
    xp: Any = jnp if any(isinstance(value, Tracer) for value in values) else np
    return xp.stack(values).astype(dtype)
