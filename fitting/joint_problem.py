"""Which numbers of material and scenes a joint fit frees, and the residuals as a function of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import brdf
from fitting.observation import Tile

# What freed leaves may not go below. A direction or a position has no bound, n is searched by its logarithm.
_NOT_NEGATIVE = ("k_a", "k_d", "k_s", "intensity", "radiance", "ambient", "attenuation")


class JointProblem(eqx.Module):
    """From a vector of freed numbers to weighted residuals; a pytree, so that its programs are compiled once a shape.

    Attributes:
        start: material and list of scenes to start from.
        seen: what is compared with.
        places: of the freed leaves among those of ``start``.
        names: of the fields that they are.
    """

    start: Any
    seen: list[Tile]
    places: tuple[int, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, start: Any, free: Callable[..., Sequence[Any]], seen: list[Tile]) -> "JointProblem":
        """Find the freed leaves by putting markers there.

        Raises:
            InputError: where ``free`` does not name distinct leaves.
        """
        remedy = "Return a tuple of leaves, such as (material.n, scenes[0].lights[0].direction)"
        try:
            leaves = tuple(free(*start))
        except TypeError as error:
            raise brdf.InputError("free", f"gives no tuple of leaves ({error})", remedy) from None
        if not leaves:
            raise brdf.InputError("free", "names no leaf", "Return the leaves to fit")
        own = {id(leaf) for leaf in jax.tree.leaves(start)}
        if not all(id(leaf) in own and jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves):
            raise brdf.InputError("free", "gives what is no number of material or scenes as a whole", remedy)
        if len({id(leaf) for leaf in leaves}) < len(leaves):
            raise brdf.InputError("free", "gives a leaf twice", remedy)
        count = len(leaves)
        marked = eqx.tree_at(lambda tree: tuple(free(*tree)), start, [_Marker(index) for index in range(count)])
        paths = jax.tree_util.tree_leaves_with_path(marked, is_leaf=lambda leaf: isinstance(leaf, _Marker))
        found = {
            leaf.index: (place, path[-1].name) for place, (path, leaf) in enumerate(paths) if isinstance(leaf, _Marker)
        }
        places, names = zip(*(found[index] for index in range(count)), strict=True)
        return cls(start, seen, places, names)

    @property
    def is_n(self) -> list[bool]:
        """Which freed leaves are exponents, searched by their logarithm."""
        return [name == "n" for name in self.names]

    @property
    def origin(self) -> Float[Array, " K"]:
        """The vector to start from."""
        return jax.flatten_util.ravel_pytree(self._coded())[0]

    @property
    def lower(self) -> Float[np.ndarray, " K"]:
        """What each entry may not go below."""
        bounds = [
            np.full(np.size(leaf), 0.0 if name in _NOT_NEGATIVE else -np.inf)
            for leaf, name in zip(self._coded(), self.names, strict=True)
        ]
        return np.concatenate(bounds)

    def _coded(self) -> tuple[Array, ...]:
        leaves = jax.tree.leaves(self.start)
        freed = [jnp.asarray(leaves[place]) for place in self.places]
        return tuple(jnp.log(leaf) if is_n else leaf for leaf, is_n in zip(freed, self.is_n, strict=True))

    def unravel(self, vector: Float[Array, " K"]) -> tuple[Array, ...]:
        """A vector's entries leaf by leaf."""
        return jax.flatten_util.ravel_pytree(self._coded())[1](vector)

    def decode(self, vector: Float[Array, " K"]) -> tuple[Array, ...]:
        """The freed leaves."""
        return tuple(
            jnp.exp(leaf) if is_n else leaf for leaf, is_n in zip(self.unravel(vector), self.is_n, strict=True)
        )

    def put(self, vector: Float[Array, " K"]) -> Any:
        """Material and scenes with the freed leaves in place."""
        leaves, shape = jax.tree.flatten(self.start)
        for place, leaf in zip(self.places, self.decode(vector), strict=True):
            leaves[place] = leaf
        return jax.tree.unflatten(shape, leaves)

    def residuals(self, vector: Float[Array, " K"]) -> list[Array]:
        """Weighted residuals of each picture."""
        material, scenes = self.put(vector)
        found = []
        for observation, scene in zip(self.seen, scenes, strict=True):
            residual = brdf.render(material, scene).reshape(observation.target.shape) - observation.target
            if observation.weight is not None:
                counts = observation.weight[:, None] > 0
                residual = jnp.where(counts, residual * jnp.where(counts, observation.weight[:, None], 1) ** 0.5, 0)
            found.append(residual)
        return found


@dataclass(frozen=True)
class _Marker:
    index: int
