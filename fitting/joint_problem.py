"""What a joint fit frees: leaves of material and scenes as one vector of numbers, and the pictures that they show."""

import re
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

import brdf
from brdf.errors import InputError

# What a diagnosis names that is a number of a scene.
NAMED = re.compile(r"(light|intensity|ball|radius)(?: (\d+))?(?: of picture (\d+))?")


# What freed leaves may not go below 0. A position has no bound, n is searched by its logarithm.
NOT_NEGATIVE = ("k_a", "k_d", "k_s", "intensity", "radiance", "ambient", "attenuation")
DIRECTIONS = ("direction",)


class JointProblem(eqx.Module):
    """From a vector of freed numbers to weighted residuals; a pytree, so that its programs are compiled once a shape.

    Attributes:
        leaves: of material and list of scenes.
        targets: what is compared with, (P, C) each.
        weights: of their pixels, (P,) each; None where all count, and alike.
        shape: of material and scenes.
        places: of the freed leaves.
        names: of the fields that they are.
        words: what a person calls them.
    """

    leaves: list[Array]
    targets: list[Array]
    weights: list[Array | None]
    shape: Any = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    words: tuple[str, ...] = eqx.field(static=True)

    def freed(self) -> list[Array]:
        """The freed leaves."""
        return [self.leaves[place] for place in self.places]

    @property
    def ends(self) -> Int[np.ndarray, " L"]:
        """Where in the vector each freed leaf but the last one ends."""
        return np.cumsum([leaf.size for leaf in self.freed()])[:-1]

    def by_picture(self, values: Float[np.ndarray, "*B N"]) -> list[Float[np.ndarray, "*B P C"]]:
        """What the residuals of each picture are, or their derivatives.

        Args:
            values: of all pictures, one after the other.
        """
        parts = np.split(values, np.cumsum([target.size for target in self.targets])[:-1], axis=-1)
        both = zip(parts, self.targets, strict=True)
        return [np.asarray(part, np.float64).reshape(*part.shape[:-1], *target.shape) for part, target in both]

    def _each(self, of: Callable[[str], bool]) -> Bool[np.ndarray, " U"]:
        return np.repeat([of(name) for name in self.names], [leaf.size for leaf in self.freed()])

    @property
    def bounded(self) -> Bool[np.ndarray, " U"]:
        """Which numbers may not be negative."""
        return self._each(lambda name: name in NOT_NEGATIVE)

    @property
    def exponents(self) -> Bool[np.ndarray, " U"]:
        """Which are exponents, by their logarithm."""
        return self._each(lambda name: name == "n")

    def design(self, vector: Float[np.ndarray, " U"]) -> Float[np.ndarray, "U V"]:
        """What each small change moves of the numbers: of a direction two small turns, its length is no unknown."""
        from scipy.linalg import block_diag  # late: few commands fit jointly

        both = zip(np.split(vector, self.ends), self.names, strict=True)
        return np.asarray(
            block_diag(*(_across(own).T if name in DIRECTIONS else np.eye(own.size) for own, name in both))
        )

    def start(self) -> Array:
        """The freed numbers as they are searched: n by its logarithm."""
        both = zip(self.freed(), self.names, strict=True)
        return jnp.concatenate([jnp.ravel(jnp.log(leaf) if name == "n" else leaf) for leaf, name in both])

    def at(self, vector: Array) -> "JointProblem":
        """The problem with other freed numbers."""
        leaves = list(self.leaves)
        for place, name, part in zip(self.places, self.names, jnp.split(vector, self.ends), strict=True):
            leaves[place] = (jnp.exp(part) if name == "n" else part).reshape(leaves[place].shape)
        return eqx.tree_at(lambda problem: problem.leaves, self, leaves)

    def content(self) -> tuple[brdf.Material, list[brdf.Scene]]:
        """Material and scenes."""
        return jax.tree.unflatten(self.shape, self.leaves)

    def residuals(self, vector: Array) -> Array:
        """Weighted residuals of all pictures, one after the other."""
        material, scenes = self.at(vector).content()
        found = []
        for target, weight, scene in zip(self.targets, self.weights, scenes, strict=True):
            residual = brdf.render(material, scene).reshape(target.shape) - target
            if weight is not None:
                counts = weight[:, None] > 0
                residual = jnp.where(counts, residual * jnp.where(counts, weight[:, None], 1) ** 0.5, 0)
            found.append(residual.ravel())
        return jnp.concatenate(found)


def _across(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2 3"]:
    """Small turns of a direction, of an angle of 1: two vectors across it, of its length."""
    return np.linalg.svd(direction[None])[2][1:] * np.linalg.norm(direction)


def joint_problem(
    start: Any, free: Callable[..., Sequence[Any]] | None, targets: list[Array], weights: list[Array | None]
) -> JointProblem:
    """Find the freed leaves among those of the start, each an array of its own.

    Args:
        start: material and list of scenes.
        free: from both to the leaves.
        targets: see `JointProblem`.
        weights: likewise.

    Raises:
        InputError: where ``free`` does not name distinct leaves.
    """
    start = jax.tree.map(jnp.array, start)
    remedy = "Return a tuple of leaves, such as (material.n, scenes[0].lights[0].direction)"
    try:
        freed = [id(leaf) for leaf in free(*start)]  # pyright: ignore[reportOptionalCall]  # None is refused below
    except (TypeError, AttributeError, IndexError) as error:
        raise InputError("free", f"gives no tuple of leaves ({error})", remedy) from None
    if not freed:
        raise InputError("free", "names no leaf", "Return the leaves to fit")
    paths = jax.tree_util.tree_leaves_with_path(start)
    own = {
        id(leaf): (place, getattr(path[-1], "name", ""), _words(path, len(start[1])))
        for place, (path, leaf) in enumerate(paths)
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    }
    if not own.keys() >= set(freed):
        raise InputError("free", "gives what is no number of material or scenes as a whole", remedy)
    if len(set(freed)) < len(freed):
        raise InputError("free", "gives a leaf twice", remedy)
    places, names, words = zip(*(own[leaf] for leaf in freed), strict=True)
    leaves, shape = jax.tree.flatten(start)
    return JointProblem(leaves, targets, weights, shape, places, names, words)


def named_leaves(names: Sequence[str]) -> Callable[[Any, list[brdf.Scene]], list[Any]]:
    """The leaves of causes that a diagnosis names, after those of the material."""
    asked = [NAMED.fullmatch(str(name)) for name in names]
    for name, match in zip(names, asked, strict=True):
        if match is None:
            words = "Name light, intensity, ball or radius, or one of them as the diagnosis does"
            raise InputError("free", f"names {name!r}, which is no number of a scene", words)

    def leaves(material: Any, scenes: list[brdf.Scene]) -> list[Any]:
        found = [material.k_d] if any(scene.lights for scene in scenes) else []
        found += [material.k_a] if any(scene.ambient is not None for scene in scenes) else []
        found += [material.k_s, material.n] if np.any(getattr(material, "k_s", 0.0)) else []
        for name, match in zip(names, asked, strict=True):
            assert match is not None
            index, picture = (None if part is None else int(part) for part in match.groups()[1:])
            own: list[Any] = []
            for place, scene in enumerate(scenes):
                if picture in (None, place):
                    own += _leaves_of(match[1], scene, index, first=place == 0)
            if not own:
                remedy = "Free what they have; the first light's intensity is the unit of the material"
                raise InputError("free", f"names {name!r}, which is not in the scenes: light is a direction", remedy)
            found += own
        return found

    return leaves


def _leaves_of(kind: str, scene: brdf.Scene, index: int | None, *, first: bool) -> list[Any]:
    """Of a scene. The first light's intensity is the unit of the material."""
    spheres: list[Any] = [shape for shape in scene.shapes if isinstance(shape, brdf.Sphere) and shape.fitted]
    lights: list[Any] = [light for place, light in enumerate(scene.lights) if index in (None, place)]
    if kind == "light":
        return [light.direction for light in lights if isinstance(light, brdf.DirectionalLight)]
    if kind == "intensity":
        shining = lights[1:] if first and index is None else lights
        return [light.emittance for light in shining]
    return [sphere.center if kind == "ball" else sphere.radius for sphere in spheres]


def _words(path: Sequence[Any], scenes: int) -> str:
    """What a person calls a leaf: n, lights[0].direction, or scenes[1].ambient where there are several."""
    words = jax.tree_util.keystr(tuple(path[1:]))  # without the number that says material or scenes
    if path[0].idx == 1:
        words = f"scenes{words}" if scenes > 1 else words.partition("]")[2]
    return words.removeprefix(".")


@eqx.filter_jit
def linearised(problem: JointProblem, vector: Array) -> tuple[Array, Array]:
    """The residuals (N,) and their derivatives (U, N), one column of the Jacobian at a time.

    Args:
        problem: with the pictures.
        vector: the freed numbers.
    """
    residuals, along = jax.linearize(problem.residuals, vector)
    return residuals, jax.lax.map(along, jnp.eye(vector.size))
