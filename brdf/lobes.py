"""The specular basis image as a function of the exponent, in the forms that the fit evaluates again and again."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from brdf.geometry.surface_points import SurfacePoints
from brdf.geometry.visibility import Lighting
from brdf.light_sum import LightTerms, sum_over_samples
from brdf.models import Material

NO_LOBE = -1e9
"""The peak of a pixel without a lobe: exp(n * this) = 0 for every n that a fit visits."""


def _power(weight: Array, log_cosine: Array, n: Array) -> tuple[Array, Array]:
    value = weight * jnp.exp(jnp.asarray(n, log_cosine.dtype) * log_cosine)[:, None]
    return value, value * log_cosine[:, None]


def _peak(weight: Array, log_cosine: Array) -> Array:
    return jnp.where(jnp.max(weight, axis=-1) > 0, log_cosine, NO_LOBE)


class StoredLobe(eqx.Module):
    """The specular basis of few light samples, kept as arrays: each evaluation costs an exponential per sample.

    Attributes:
        weights: of each sample, (P, C).
        log_cosines: of each sample, (P,).
    """

    weights: tuple[Float[Array, "P C"], ...]
    log_cosines: tuple[Float[Array, " P"], ...]

    def __call__(self, n: Float[Array, ""]) -> tuple[Float[Array, "P C"], Float[Array, "P C"]]:
        """The basis image without the model's scale, and its derivative in n.

        Args:
            n: the exponent.
        """
        value, slope = _power(self.weights[0], self.log_cosines[0], n)
        for weight, log_cosine in zip(self.weights[1:], self.log_cosines[1:], strict=True):
            more = _power(weight, log_cosine, n)
            value, slope = value + more[0], slope + more[1]
        return value, slope

    def peak(self) -> Float[Array, " P"]:
        """The largest logarithm of the lobe's cosine over the samples, `NO_LOBE` where no sample has one."""
        peaks = [_peak(*sample) for sample in zip(self.weights, self.log_cosines, strict=True)]
        return jnp.max(jnp.stack(peaks), axis=0)

    def pixels(self, choose: Callable[[Array], Array]) -> "StoredLobe":
        """The same for some of the pixels.

        Args:
            choose: applied to each array whose first axis is the pixels.
        """
        return jax.tree.map(choose, self)


class StackedLobe(eqx.Module):
    """The specular basis of many light samples and so few pixels that their terms fit into memory.

    Attributes:
        weights: of each sample, (P, S, C).
        log_cosines: of each sample, (P, S).
    """

    weights: Float[Array, "P S C"]
    log_cosines: Float[Array, "P S"]

    def __call__(self, n: Float[Array, ""]) -> tuple[Float[Array, "P C"], Float[Array, "P C"]]:
        """The basis image without the model's scale, and its derivative in n.

        Args:
            n: the exponent.
        """
        log_cosines = self.log_cosines[..., None]
        values = self.weights * jnp.exp(jnp.asarray(n, log_cosines.dtype) * log_cosines)
        return jnp.sum(values, axis=1), jnp.sum(values * log_cosines, axis=1)

    def peak(self) -> Float[Array, " P"]:
        """The largest logarithm of the lobe's cosine over the samples, `NO_LOBE` where no sample has one."""
        return jnp.max(jnp.where(jnp.max(self.weights, axis=-1) > 0, self.log_cosines, NO_LOBE), axis=1)

    def pixels(self, choose: Callable[[Array], Array]) -> "StackedLobe":
        """The same for some of the pixels.

        Args:
            choose: applied to each array whose first axis is the pixels.
        """
        return jax.tree.map(choose, self)


class StreamedLobe(eqx.Module):
    """The specular basis of many light samples, made anew at each evaluation in bounded memory.

    Attributes:
        points: (P,) surface points.
        lighting: lights and occluders.
        model: the class of the material.
    """

    points: SurfacePoints
    lighting: Lighting
    model: type[Material] = eqx.field(static=True)

    def __call__(self, n: Float[Array, ""]) -> tuple[Float[Array, "P C"], Float[Array, "P C"]]:
        """The basis image without the model's scale, and its derivative in n.

        Args:
            n: the exponent.
        """

        def of_terms(terms: LightTerms) -> tuple[Array, Array]:
            return _power(terms.weight, terms.log_cosine, n)

        return sum_over_samples(self.model, self.points, self.lighting, of_terms)

    def peak(self) -> Float[Array, " P"]:
        """The largest logarithm of the lobe's cosine over the samples, `NO_LOBE` where no sample has one."""

        def of_terms(terms: LightTerms) -> Array:
            return _peak(terms.weight, terms.log_cosine)

        return sum_over_samples(self.model, self.points, self.lighting, of_terms, combine=jnp.maximum, start=NO_LOBE)

    def pixels(self, choose: Callable[[Array], Array]) -> "StreamedLobe":
        """The same for some of the pixels.

        Args:
            choose: applied to each array whose first axis is the pixels.
        """
        return StreamedLobe(jax.tree.map(choose, self.points), self.lighting, self.model)


class AveragedLobe(eqx.Module):
    """The specular basis of pixels some of which are averaged over their area.

    Attributes:
        centre: of all pixels, by their centres.
        fine: of the points, (K M,), of those that are averaged.
        weight: of each point in its pixel, (K, M).
        slot: for every pixel its row in ``weight``, or -1, (P,).
    """

    centre: StoredLobe | StackedLobe | StreamedLobe
    fine: StoredLobe | StackedLobe | StreamedLobe
    weight: Float[Array, "K M"]
    slot: Int[Array, " P"]

    def __call__(self, n: Float[Array, ""]) -> tuple[Float[Array, "P C"], Float[Array, "P C"]]:
        """The basis image without the model's scale, and its derivative in n.

        Args:
            n: the exponent.
        """
        means = tuple(average(self.weight, part) for part in self.fine(n))
        value, slope = (self._chosen(*pair) for pair in zip(self.centre(n), means, strict=True))
        return value, slope

    def peak(self) -> Float[Array, " P"]:
        """The largest logarithm of the lobe's cosine over samples and points, `NO_LOBE` where none has one."""
        finest = jnp.max(self.fine.peak().reshape(self.weight.shape), axis=1)
        return self._chosen(self.centre.peak(), finest)

    def pixels(self, choose: Callable[[Array], Array]) -> "AveragedLobe":
        """The same for some of the pixels.

        Args:
            choose: applied to each array whose first axis is the pixels.
        """
        return AveragedLobe(self.centre.pixels(choose), self.fine, self.weight, choose(self.slot))

    def _chosen(self, centre: Array, fine: Array) -> Array:
        averaged = self.slot >= 0
        gathered = fine[jnp.maximum(self.slot, 0)]
        return jnp.where(averaged.reshape(-1, *(1,) * (centre.ndim - 1)), gathered, centre)


def average(weight: Float[Array, "K M"], values: Float[Array, "K*M C"]) -> Float[Array, "K C"]:
    """The mean of each pixel's points.

    Args:
        weight: of each point in its pixel.
        values: of the points, pixel by pixel.
    """
    return jnp.sum(weight[..., None] * values.reshape(*weight.shape, -1), axis=1)


Lobe = StoredLobe | StackedLobe | StreamedLobe | AveragedLobe
