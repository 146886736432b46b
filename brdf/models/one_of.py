"""A model that a program learns when it runs: one program serves all, where making it costs more than running it."""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from brdf.models import MODELS
from brdf.models.base import Material, SpecularMaterial


class OneOf(eqx.Module):
    """A model with a lobe, with what light samples ask of its class.

    Attributes:
        models: those it may be.
        index: which of them it is.
    """

    models: tuple[type[SpecularMaterial], ...] = eqx.field(static=True)
    index: Int[Any, ""]

    @classmethod
    def of(cls, model: type[Material]) -> "type[Material] | OneOf":
        """Of all models that have a name; the model itself where it is none of them or has no lobe."""
        models = tuple(one for one in MODELS.values() if issubclass(one, SpecularMaterial))
        return cls(models, np.int32(models.index(model))) if model in models else model

    @property
    def log_cosine(self) -> Callable[..., Array]:
        """See `SpecularMaterial.log_cosine`."""
        kinds = list(dict.fromkeys(model.log_cosine for model in self.models))
        kind = jnp.asarray([kinds.index(model.log_cosine) for model in self.models])[self.index]
        return partial(jax.lax.switch, kind, kinds)

    def scale(self, n: Array) -> Array:
        """See `SpecularMaterial.scale`."""
        return jax.lax.switch(self.index, [model.scale for model in self.models], n)

    @property
    def cosine_weighted(self) -> Array:
        """See `SpecularMaterial`."""
        return jnp.asarray([model.cosine_weighted for model in self.models])[self.index]


Model = type[Material] | OneOf


def has_lobe(model: Model) -> "TypeGuard[type[SpecularMaterial] | OneOf]":
    """Whether it has a specular term."""
    return isinstance(model, OneOf) or issubclass(model, SpecularMaterial)
