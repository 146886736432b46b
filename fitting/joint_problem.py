"""What a fit frees: leaves of material and scenes as one vector of numbers, and the pictures that they show.

The numbers of a leaf are its own, but for two: n is searched by its logarithm, and a direction, whose length says
nothing, by two small turns of it. `fitting.joint` fits them, `fitting.implicit` asks how they move with others, and
`fitting.light_choice` and `fitting.diagnosis` what pictures tell of them.
"""

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
from brdf.vectors import norm, normalize, perpendicular

# What a diagnosis names that is a number of a scene.
NAMED = re.compile(r"(light|intensity|ball|radius)(?: (\d+))?(?: of picture (\d+))?")
# What freed leaves may not go below 0.
NOT_NEGATIVE = ("k_a", "k_d", "k_s", "intensity", "radiance", "ambient", "attenuation")
# Values (P, C), and weights (P,), or None where each pixel weighs 1.
Picture = tuple[Array, Array | None]
REMEDY = "Return a tuple of leaves, such as (material.n, scenes[0].lights[0].direction)"


def turns(direction: Float[Array, "3"]) -> Float[Array, "2 3"]:
    """Two vectors across a direction, of its length: small turns of it, of an angle of 1."""
    return jnp.stack(perpendicular(normalize(direction))) * norm(direction)


def degrees_between(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> float:
    """The angle between two directions of any length."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


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
    def is_direction(self) -> bool:
        """Whether its length says nothing."""
        return self.name == "direction"

    @property
    def bounded(self) -> bool:
        """Whether its numbers may not be negative."""
        return self.name in NOT_NEGATIVE

    @property
    def numbers(self) -> slice:
        """Its part of the vector."""
        return slice(self.start, self.start + (2 if self.is_direction else math.prod(self.shape)))

    def of(self, value: Array) -> Array:
        """The numbers of a value: of a direction no turn."""
        if self.is_direction:
            return jnp.zeros(2, value.dtype)
        return jnp.ravel(jnp.log(value) if self.name == "n" else value)

    def at(self, start: Array, numbers: Array) -> Array:
        """The value of some numbers; turns are those from the start."""
        if self.is_direction:
            return start + numbers @ turns(start)
        return (jnp.exp(numbers) if self.name == "n" else numbers).reshape(self.shape)


class JointProblem(eqx.Module):
    """From a vector of freed numbers to weighted residuals; a pytree, so that its programs are compiled once a shape.

    Attributes:
        leaves: all of material and scenes.
        shape: of the tree.
        freed: the leaves to fit.
        pictures: values and weights of each.
    """

    leaves: list[Array]
    shape: Any = eqx.field(static=True)
    freed: tuple[Leaf, ...] = eqx.field(static=True)
    pictures: Sequence[Picture] = ()

    def by_picture(self, values: Float[Any, "*B N"]) -> list[Float[np.ndarray, "*B P C"]]:
        """What the residuals of each picture are, or their derivatives.

        Args:
            values: of all pictures, one after the other.
        """
        values, shapes = np.asarray(values, np.float64), [target.shape for target, _ in self.pictures]
        parts = np.split(values, np.cumsum(list(map(math.prod, shapes)))[:-1], axis=-1)
        return [part.reshape(*values.shape[:-1], *shape) for part, shape in zip(parts, shapes, strict=True)]

    def each(self, of: Callable[[Leaf], bool]) -> Bool[np.ndarray, " U"]:
        """What is so of the leaf that each number belongs to."""
        return np.concatenate([np.full(leaf.numbers.stop - leaf.start, of(leaf)) for leaf in self.freed])

    @property
    def moves_outlines(self) -> bool:
        """Whether pixels may come to see another shape, or none: something of the camera or of a shape is freed."""
        return any("camera." in leaf.words or "shapes[" in leaf.words for leaf in self.freed)

    def start(self) -> Array:
        """The freed numbers."""
        return jnp.concatenate([leaf.of(self.leaves[leaf.place]) for leaf in self.freed])

    def at(self, vector: Array) -> "JointProblem":
        """The problem with other freed numbers; directions turn from there."""
        leaves = list(self.leaves)
        for leaf in self.freed:
            leaves[leaf.place] = leaf.at(leaves[leaf.place], vector[leaf.numbers])
        return eqx.tree_at(lambda problem: problem.leaves, self, leaves)

    def content(self) -> tuple[brdf.Material, list[brdf.Scene]]:
        """Material and scenes."""
        return jax.tree.unflatten(self.shape, self.leaves)

    def residuals(self, vector: Array) -> Array:
        """Weighted residuals of all pictures, one after the other."""
        return residuals(*self.at(vector).content(), self.pictures)


def residuals(material: brdf.Material, scenes: Sequence[brdf.Scene], pictures: Sequence[Picture]) -> Array:
    """Weighted residuals of all pictures, one after the other."""
    found = []
    for (target, weight), scene in zip(pictures, scenes, strict=True):
        residual = brdf.render(material, scene).reshape(target.shape) - target
        if weight is not None:
            counts = weight[:, None] > 0
            residual = jnp.where(counts, residual * jnp.where(counts, weight[:, None], 1) ** 0.5, 0)
        found.append(residual.ravel())
    return jnp.concatenate(found)


@eqx.filter_jit
def linearised(problem: JointProblem, vector: Array) -> tuple[Array, Array]:
    """The residuals (N,) and their derivatives (U, N), one column of the Jacobian at a time."""
    residuals, along = jax.linearize(problem.residuals, vector)
    return residuals, jax.lax.map(along, jnp.eye(vector.size))


def joint_problem(
    start: Any, free: Callable[..., Sequence[Any]] | None, pictures: Sequence[Picture] = ()
) -> JointProblem:
    """Find the freed leaves among those of the start, each an array of its own.

    Args:
        start: material and list of scenes.
        free: from both to the leaves.
        pictures: see `JointProblem`.

    Raises:
        InputError: where ``free`` does not name distinct leaves.
    """
    start = jax.tree.map(jnp.array, start)
    try:
        asked = [id(leaf) for leaf in free(*start)]  # pyright: ignore[reportOptionalCall]  # None is refused below
    except (TypeError, AttributeError, IndexError) as error:
        raise InputError("free", f"gives no tuple of leaves ({error})", REMEDY) from None
    if not asked:
        raise InputError("free", "names no leaf", "Return the leaves to fit")
    paths, shape = jax.tree_util.tree_flatten_with_path(start)
    own = {
        id(leaf): (place, getattr(path[-1], "name", ""), _words(path, len(start[1])), leaf.shape)
        for place, (path, leaf) in enumerate(paths)
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    }
    if not own.keys() >= set(asked):
        raise InputError("free", "gives what is no number of material or scenes as a whole", REMEDY)
    if len(set(asked)) < len(asked):
        raise InputError("free", "gives a leaf twice", REMEDY)
    freed: list[Leaf] = []
    for leaf in asked:
        freed.append(Leaf(*own[leaf], start=freed[-1].numbers.stop if freed else 0))
    return JointProblem([leaf for _, leaf in paths], shape, tuple(freed), pictures)


def _words(path: Sequence[Any], scenes: int) -> str:
    """What a person calls a leaf: n, lights[0].direction, or scenes[1].ambient where there are several."""
    words = jax.tree_util.keystr(tuple(path[1:]))  # without the number that says material or scenes
    if path[0].idx == 1:
        words = f"scenes{words}" if scenes > 1 else words.partition("]")[2]
    return words.removeprefix(".")


def named_leaves(names: Sequence[str]) -> Callable[[Any, list[brdf.Scene]], list[Any]]:
    """The leaves of causes that a diagnosis names, after those of the material."""
    asked = {str(name): NAMED.fullmatch(str(name)) for name in names}
    for name, match in asked.items():
        if match is None:
            words = "Name light, intensity, ball or radius, or one of them as the diagnosis does"
            raise InputError("free", f"names {name!r}, which is no number of a scene", words)

    def leaves(material: Any, scenes: list[brdf.Scene]) -> list[Any]:
        found = [material.k_d] if any(scene.lights for scene in scenes) else []
        found += [material.k_a] if any(scene.ambient is not None for scene in scenes) else []
        found += [material.k_s, material.n] if np.any(getattr(material, "k_s", 0.0)) else []
        for name, match in asked.items():
            assert match is not None
            index, picture = (None if part is None else int(part) for part in match.groups()[1:])
            own: list[Any] = []
            for place, scene in enumerate(scenes):
                some = scene_leaves(match[1], scene, index) if picture in (None, place) else []
                # The first light's intensity is the unit of the material.
                is_unit = place == 0 and index is None and match[1] == "intensity"
                own += some[1:] if is_unit else some
            if not own:
                remedy = "Free what they have; the first light's intensity is the unit of the material"
                raise InputError("free", f"names {name!r}, which is not in the scenes: light is a direction", remedy)
            found += own
        return found

    return leaves


def scene_leaves(kind: str, scene: brdf.Scene, index: int | None = None) -> list[Any]:
    """Those of a kind of cause: "light", "intensity", "ball" or "radius"; of one light or of all."""
    lights: list[Any] = [light for place, light in enumerate(scene.lights) if index in (None, place)]
    spheres: list[Any] = [shape for shape in scene.shapes if isinstance(shape, brdf.Sphere) and shape.fitted]
    if kind == "light":
        return [light.direction for light in lights if isinstance(light, brdf.DirectionalLight)]
    if kind == "intensity":
        return [light.emittance for light in lights]
    return [sphere.center if kind == "ball" else sphere.radius for sphere in spheres]
