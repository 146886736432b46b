"""Pictures as the engine sees them: arrays over pixels, and the lobe as a function of the exponent."""

from collections.abc import Callable
from typing import Protocol, Self, TypeAlias, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Natural logarithms of what is still well inside float32 and float64, times an exponent of 1e7 too: a compiler that may
# reorder products multiplies the two first, and infinity times the 0 of a dark pixel is no number.
_LARGEST_DECAY_SINGLE = 60.0
_LARGEST_DECAY_DOUBLE = 600.0

# On the host or on the device.
AnyArray: TypeAlias = jax.Array | np.ndarray


@runtime_checkable
class Lobe(Protocol):
    """The specular basis image as a function of the exponent; an Equinox module."""

    def __call__(self, n: Float[Array, ""]) -> tuple[Float[Array, "P Cb"], Float[Array, "P Cb"]]:
        """The basis image and its derivative by ``n``, in the pixels' dtype; finite for every ``n`` in the search."""
        ...

    def peak(self) -> Float[Array, " P"]:
        """The largest ``log(cos)`` over the light samples of each pixel, at most 0: how soon its lobe dies out."""
        ...

    def pixels(self, choose: Callable[[Array], Array]) -> Self:
        """The same lobe for some of the pixels: ``choose`` applied to each array whose first axis is the pixels."""
        ...


class OneLightLobe(eqx.Module):
    """The lobe of one light sample per pixel: ``weight * exp(n * log_cos)``.

    Attributes:
        log_cos: Logarithm of the lobe's cosine, at most 0, finite.
        weight: What multiplies the lobe: light intensity, visibility, ``(N.L)+`` if the model has it; 0 where gated.
    """

    log_cos: Float[Array, " P"]
    weight: Float[Array, "P Cb"]

    def __call__(self, n: Float[Array, ""]) -> tuple[Float[Array, "P Cb"], Float[Array, "P Cb"]]:
        """The basis image and its derivative by ``n``."""
        value = self.weight * jnp.exp(n.astype(self.log_cos.dtype) * self.log_cos)[:, None]
        return value, value * self.log_cos[:, None]

    def peak(self) -> Float[Array, " P"]:
        """The logarithm of the cosine itself, there being one light; far below 0 where the lobe is gated."""
        return jnp.where(jnp.any(self.weight > 0, axis=1), self.log_cos, -1e9)

    def pixels(self, choose: Callable[[Array], Array]) -> "OneLightLobe":
        """The lobe of the chosen pixels."""
        return OneLightLobe(log_cos=choose(self.log_cos), weight=choose(self.weight))


class Picture(eqx.Module):
    """One picture, or one tile of one: ``target ~ x_a * ambient + x_d * diffuse + x_s * lobe(n)``.

    Attributes:
        target: Linear radiance; its dtype is the dtype of the pass.
        diffuse: Diffuse basis image; ``Cb`` is 1 where it is the same for all channels, else ``C``.
        lobe: Specular basis image, ``None`` for a model without one.
        weight: Weight of each squared residual, at least 0; a target of weight 0 may be anything, NaN too. ``None``
            weighs every pixel 1 and costs nothing.
        ambient: What multiplies ``x_a``, the same for all pixels; 0 in a picture without ambient light.
    """

    target: Float[Array, "P C"]
    diffuse: Float[Array, "P Cb"]
    lobe: Lobe | None = None
    weight: Float[Array, " P"] | Float[Array, "P C"] | None = None
    ambient: Float[AnyArray, " Ca"] = eqx.field(default_factory=lambda: np.ones(1))

    def pixels(self, choose: Callable[[Array], Array]) -> "Picture":
        """The same picture, some of its pixels."""
        return Picture(
            target=choose(self.target),
            diffuse=choose(self.diffuse),
            lobe=None if self.lobe is None else self.lobe.pixels(choose),
            weight=None if self.weight is None else choose(self.weight),
            ambient=self.ambient,
        )


def relative_lobe(
    lobe: Lobe, log_n: Float[Array, ""], peak: Float[Array, ""], dtype: np.dtype
) -> tuple[Float[Array, "P Cb"], Float[Array, "P Cb"]]:
    """The lobe relative to its largest value, ``S exp(-n peak)``, and the derivative of that by log n.

    Where no pixel sees the highlight's centre a lobe itself falls by many powers of ten within a step of log n, but its
    shape does not change faster than elsewhere. Past the range of the dtype it counts as dark.
    """
    n = jnp.exp(log_n)
    value, slope = lobe(n)
    decay = n * peak
    limit = _LARGEST_DECAY_SINGLE if dtype == np.float32 else _LARGEST_DECAY_DOUBLE
    scale = jnp.where(-decay < limit, jnp.exp(-decay), 0.0).astype(dtype)
    value = value.astype(dtype)
    slope = slope.astype(dtype) * n.astype(dtype) - value * decay.astype(dtype)
    return value * scale, slope * scale
