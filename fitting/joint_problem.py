"""What a joint fit frees: leaves of material and scenes as one vector of numbers, and the pictures that they show."""

import math
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import brdf
from brdf.errors import InputError

# What a diagnosis names that is a number of a scene.
NAMED = re.compile(r"(light|intensity|ball|radius)(?: (\d+))?(?: of picture (\d+))?")


# What freed leaves may not go below 0. A position has no bound, n is searched by its logarithm.
NOT_NEGATIVE = ("k_a", "k_d", "k_s", "intensity", "radiance", "ambient", "attenuation")
DIRECTIONS = ("direction",)


class Leaf(NamedTuple):
    """A freed leaf of material and scenes.

    Attributes:
        place: among all leaves.
        name: of its field.
        words: what a person calls it.
        shape: of the leaf.
        start: where its numbers begin in the vector of all.
    """

    place: int
    name: str
    words: str
    shape: tuple[int, ...]
    start: int

    @property
    def size(self) -> int:
        """How many numbers it has."""
        return math.prod(self.shape)

    @property
    def numbers(self) -> slice:
        """Its part of the vector."""
        return slice(self.start, self.start + self.size)


class JointProblem(eqx.Module):
    """From a vector of freed numbers to weighted residuals; a pytree, so that its programs are compiled once a shape.

    Attributes:
        leaves: all of material and scenes.
        targets: (H W, C) each.
        weights: (H W,) each, or None where each pixel weighs 1.
        shape: of the tree.
        freed: the leaves to fit.
    """

    leaves: list[Array]
    targets: list[Array]
    weights: list[Array | None]
    shape: Any = eqx.field(static=True)
    freed: tuple[Leaf, ...] = eqx.field(static=True)

    def by_picture(self, values: Float[np.ndarray, "*B N"]) -> list[Float[np.ndarray, "*B P C"]]:
        """What the residuals of each picture are, or their derivatives.

        Args:
            values: of all pictures, one after the other.
        """
        parts = np.split(values, np.cumsum([target.size for target in self.targets])[:-1], axis=-1)
        both = zip(parts, self.targets, strict=True)
        return [np.asarray(part, np.float64).reshape(*part.shape[:-1], *target.shape) for part, target in both]

    def each(self, of: Callable[[Leaf], bool]) -> Bool[np.ndarray, " U"]:
        """What is so of the leaf that each number belongs to."""
        return np.repeat([of(leaf) for leaf in self.freed], [leaf.size for leaf in self.freed])

    @property
    def bounded(self) -> Bool[np.ndarray, " U"]:
        """Which numbers may not be negative."""
        return self.each(lambda leaf: leaf.name in NOT_NEGATIVE)

    @property
    def moves_outlines(self) -> bool:
        """Whether pixels may come to see another shape, or none: something of the camera or of a shape is freed."""
        return any("camera." in leaf.words or "shapes[" in leaf.words for leaf in self.freed)

    def design(self, vector: Float[np.ndarray, " U"]) -> Float[np.ndarray, "U V"]:
        """What each small change moves of the numbers: of a direction two small turns, its length is no unknown."""
        from scipy.linalg import block_diag  # late: few commands fit jointly

        parts = [
            _across(vector[leaf.numbers]).T if leaf.name in DIRECTIONS else np.eye(leaf.size) for leaf in self.freed
        ]
        return np.asarray(block_diag(*parts))

    def start(self) -> Array:
        """The freed numbers as they are searched: n by its logarithm."""
        parts = [(self.leaves[leaf.place], leaf.name == "n") for leaf in self.freed]
        return jnp.concatenate([jnp.ravel(jnp.log(part) if by_log else part) for part, by_log in parts])

    def at(self, vector: Array) -> "JointProblem":
        """The problem with other freed numbers."""
        leaves = list(self.leaves)
        for leaf in self.freed:
            part = vector[leaf.numbers].reshape(leaf.shape)
            leaves[leaf.place] = jnp.exp(part) if leaf.name == "n" else part
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
    (leaves, shape), found = jax.tree.flatten(start), list[Leaf]()
    for place, name, words in (own[leaf] for leaf in freed):
        begin = found[-1].numbers.stop if found else 0
        found.append(Leaf(place, name, words, leaves[place].shape, begin))
    return JointProblem(leaves, targets, weights, shape, tuple(found))


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
