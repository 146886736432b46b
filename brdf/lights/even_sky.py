"""A sky of one brightness of which every point sees all that is above its horizon.

What a lobe shows of it depends on the angle of view alone, not on where the point is. So it is summed up for some
angles, with many light samples, and is cubic between these, to 1e-5. Against quadrature a half-vector lobe is right to
3e-4, a mirror-vector lobe to 1e-3, near the outline to 2e-2.
"""

import dataclasses
import functools
import operator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from brdf.geometry.surface_points import SurfacePoints
from brdf.lights.base import Lighting, stacked
from brdf.lights.environment import ConstantEnvironment
from brdf.vectors import Components

VIEWS, SAMPLES = 96, 4096
"""Angles of view, whose cosines are squares of evenly spaced numbers, and light samples of each."""
GRAZING = 1e-12
"""The smallest cosine of a view from the front."""


class Views(NamedTuple):
    """Between which of the angles each of P points is seen, and their weights, four for one point.

    Attributes:
        index: of the angles; `VIEWS` for a view from behind.
        weight: of what is summed up there.
    """

    index: Int[Any, "P T"]
    weight: Float[Any, "P T"]

    @classmethod
    def of(cls, points: SurfacePoints) -> "Views":
        """Of (P,) points; those that are masked show nothing."""
        cosine = jnp.broadcast_to(points.normal @ points.to_view, points.mask.shape)
        place = jnp.sqrt(jnp.clip(cosine, GRAZING, 1.0)) * (VIEWS - 1)
        first = jnp.clip(jnp.floor(place) - 1, 0, VIEWS - 4)
        t = place - first
        # The polynomials of Lagrange through 0, 1, 2, 3.
        cubic = (
            (t - 1) * (t - 2) * (3 - t) / 6,
            t * (t - 2) * (t - 3) / 2,
            t * (t - 1) * (3 - t) / 2,
            t * (t - 1) * (t - 2) / 6,
        )
        ahead = (cosine > 0)[:, None]
        index = jnp.where(ahead, first[:, None].astype(np.int32) + np.arange(4, dtype=np.int32), VIEWS)
        weight = jnp.where(ahead, jnp.stack(cubic, axis=1), jnp.eye(4, dtype=t.dtype)[0])
        arrives = points.mask if points.share is None else points.mask * points.share
        return cls(index, weight * arrives[:, None])

    def per_pixel(self, each: int) -> "Views":
        """Of pixels of so many points."""
        return Views(*(leaf.reshape(-1, each * leaf.shape[1]) for leaf in self))

    def taken(self, values: Any) -> Any:
        """From values at the angles, (..., V, C), those of the points, (..., P, C), on the host where they are."""
        xp = values.__array_namespace__()
        parts = (
            xp.take(values, index, axis=-2) * weight[:, None].astype(values.dtype)
            for index, weight in zip(self.index.T, self.weight.T, strict=True)
        )
        return functools.reduce(operator.add, parts)

    def largest(self, peaks: Float[Array, " V"], nothing: float) -> Float[Array, " P"]:
        """The largest of values at the angles that count; ``nothing`` where none does."""
        return jnp.max(jnp.where(self.weight != 0, peaks[self.index], nothing), axis=1)


def seen_under(sky: Float[Any, " C"]) -> tuple[SurfacePoints, Lighting]:
    """Points that are seen at each of the angles, and last from behind, and the samples of the sky above them."""
    cosine = np.append(np.maximum(np.linspace(0, 1, VIEWS) ** 2, GRAZING), -1.0)
    zero, one = np.zeros(VIEWS + 1), np.ones(VIEWS + 1)
    position, normal, to_view = (
        Components(tuple(jnp.asarray(part, sky.dtype) for part in vector))
        for vector in ((zero, zero, zero), (zero, zero, one), (np.sqrt(1 - cosine**2), zero, cosine))
    )
    (stack,) = stacked([ConstantEnvironment(1.0, samples=SAMPLES)], sky.dtype)
    stack = dataclasses.replace(stack, emitted=stack.emitted * sky)
    return SurfacePoints(position, normal, to_view, jnp.ones(VIEWS + 1, bool)), Lighting((stack,))
