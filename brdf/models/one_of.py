"""A model that a program learns when it runs: one program serves all, where making it costs more than running it."""

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from brdf.models import MODELS
from brdf.models.base import Material, SpecularMaterial


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class OneOf:
    """A model, with what light samples ask of its class.

    Attributes:
        models: those it may be.
        index: which of them it is.
    """

    models: tuple[type[Material], ...] = dataclasses.field(metadata={"static": True})
    index: Int[Array, ""] | int | np.int32 = 0

    @classmethod
    def of(cls, model: type[Material]) -> "OneOf":
        """Of all models that have a name; the model alone where it is none of them or has no lobe."""
        models = tuple(one for one in MODELS.values() if issubclass(one, SpecularMaterial))
        return cls(models, np.int32(models.index(model))) if model in models else cls((model,))

    @property
    def lobes(self) -> tuple[type[SpecularMaterial], ...]:
        """The models, where they have a lobe."""
        return tuple(model for model in self.models if issubclass(model, SpecularMaterial))

    @property
    def log_cosine(self) -> Callable[..., Array]:
        """See `SpecularMaterial.log_cosine`."""
        kinds = list(dict.fromkeys(model.log_cosine for model in self.lobes))
        kind = jnp.asarray([kinds.index(model.log_cosine) for model in self.lobes])[self.index]
        return partial(jax.lax.switch, kind, kinds)

    def scale(self, n: Array) -> Array:
        """See `SpecularMaterial.scale`."""
        return jax.lax.switch(self.index, [model.scale for model in self.lobes], n)

    @property
    def cosine_weighted(self) -> Array:
        """See `SpecularMaterial`."""
        return jnp.asarray([model.cosine_weighted for model in self.lobes])[self.index]
