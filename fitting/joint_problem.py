"""What a fit frees: leaves of material and scenes as one vector of numbers, and the pictures that they show.

The numbers of a leaf are its own, but for two: n is searched by its logarithm, and a direction, whose length says
nothing, by two small turns of it.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
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
NAMED = re.compile(r"(light|distance|intensity|ball|radius)(?: (\d+))?(?: of picture (\d+))?")
# What freed leaves may not go below 0.
NOT_NEGATIVE = ("k_a", "k_d", "k_s", "intensity", "radiance", "ambient", "attenuation")
# Derivatives of the renderer are as fast without, and compiled in half the time. From 0.11 on XLA has no such option.
QUICKLY_COMPILED: Any = {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11) else {}
# Values (P, C), and weights (P,) or (P, C), or None where each pixel weighs 1.
Picture = tuple[Array, Array | None]


class Leaf(NamedTuple):
    """A freed leaf of material and scenes.

    Attributes:
        position: among all leaves.
        words: what a person calls it, at the end its field.
        numbers: its part of the vector of all.
    """

    position: int
    words: str
    numbers: slice

    @property
    def name(self) -> str:
        """Of its field."""
        return self.words.rpartition(".")[2]

    @property
    def is_direction(self) -> bool:
        """Whether its length says nothing."""
        return self.name == "direction"

    @property
    def bounded(self) -> bool:
        """Whether its numbers may not be negative."""
        return self.name in NOT_NEGATIVE

    def of(self, value: Array) -> Array:
        """The numbers of a value: of a direction no turn."""
        if self.is_direction:
            return jnp.zeros(2, value.dtype)
        return jnp.ravel(jnp.log(value) if self.name == "n" else value)

    def at(self, start: Array, numbers: Array) -> Array:
        """The value of some numbers; turns are those from the start."""
        if self.is_direction:
            return start + numbers @ turns(start)
        return (jnp.exp(numbers) if self.name == "n" else numbers).reshape(start.shape)


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
        """What the residuals of each picture are, or their derivatives, from those of all, one after the other."""
        values, shapes = np.asarray(values, np.float64), [target.shape for target, _ in self.pictures]
        parts = np.split(values, np.cumsum(list(map(math.prod, shapes)))[:-1], axis=-1)
        return [part.reshape(*values.shape[:-1], *shape) for part, shape in zip(parts, shapes, strict=True)]

    def each(self, of: Callable[[Leaf], bool]) -> Bool[np.ndarray, " U"]:
        """What is so of the leaf that each number belongs to."""
        return np.concatenate([np.full(leaf.numbers.stop - leaf.numbers.start, of(leaf)) for leaf in self.freed])

    @eqx.filter_jit
    def start(self) -> Array:
        """The freed numbers."""
        return jnp.concatenate([leaf.of(self.leaves[leaf.position]) for leaf in self.freed])

    @eqx.filter_jit
    def at(self, vector: Array) -> "JointProblem":
        """The problem with other freed numbers; directions turn from there."""
        moved = [leaf.at(self.leaves[leaf.position], vector[leaf.numbers]) for leaf in self.freed]
        return eqx.tree_at(lambda problem: [problem.leaves[leaf.position] for leaf in self.freed], self, moved)

    def content(self) -> tuple[brdf.Material, list[brdf.Scene]]:
        """Material and scenes."""
        return jax.tree.unflatten(self.shape, self.leaves)

    @eqx.filter_jit
    def residuals(self, vector: Array) -> Array:
        """Weighted residuals of all pictures, one after the other."""
        return residuals(*self.at(vector).content(), self.pictures)


def residuals(material: brdf.Material, scenes: Sequence[brdf.Scene], pictures: Sequence[Picture]) -> Array:
    """Weighted residuals of all pictures, one after the other."""
    found = []
    for (target, weight), scene in zip(pictures, scenes, strict=True):
        residual = brdf.render(material, scene).reshape(target.shape) - target
        if weight is not None:
            weight = weight.reshape(target.shape[0], -1)
            counts = weight > 0
            residual = jnp.where(counts, residual * jnp.where(counts, weight, 1) ** 0.5, 0)
        found.append(residual.ravel())
    return jnp.concatenate(found)


@partial(jax.jit, compiler_options=QUICKLY_COMPILED)
def linearised(problem: JointProblem, vector: Array) -> tuple[Array, Array]:
    """The residuals (N,) and their derivatives (U, N), one column of the Jacobian at a time."""
    found, along = jax.linearize(problem.residuals, vector)
    return found, jax.lax.map(along, jnp.eye(vector.size))


def turns(direction: Float[Array, "3"]) -> Float[Array, "2 3"]:
    """Two vectors across a direction, of its length: small turns of it, of an angle of 1."""
    return jnp.stack(perpendicular(normalize(direction))) * norm(direction)


def degrees_between(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> float:
    """The angle between two directions of any length."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def joint_problem(start: Any, free: Callable[..., Any] | None, pictures: Sequence[Picture] = ()) -> JointProblem:
    """Find the freed leaves, which must be distinct, among those of material and scenes, each an array of its own."""
    start = jax.tree.map(jnp.array, start)
    given = {"material": start[0], "scenes": start[1]}
    asked = map(id, chosen_leaves("free", free, given, "(material.n, scenes[0].lights[0].direction)"))
    paths, shape = jax.tree_util.tree_flatten_with_path(start)
    own = {id(leaf): (index, _words(path, len(start[1])), leaf.size) for index, (path, leaf) in enumerate(paths)}
    freed, begin = [], 0
    for index, words, size in map(own.__getitem__, asked):
        end = begin + (2 if words.endswith(".direction") else size)
        freed.append(Leaf(index, words, slice(begin, end)))
        begin = end
    return JointProblem([leaf for _, leaf in paths], shape, tuple(freed), pictures)


def chosen_leaves(name: str, choose: Callable[..., Any] | None, given: Mapping[str, Any], example: str) -> list[Array]:
    """The leaves that a function of a user's gives of trees by what they are called, each leaf an array of its own.

    It gives one or several, of numbers and distinct, or is refused with an example of what it may return.
    """
    remedy = f"Return a tuple of leaves, such as {example}"
    try:
        found = choose(*given.values())  # pyright: ignore[reportOptionalCall]  # None is refused below
        found = [found] if isinstance(found, jax.Array) else list(found)
    except (TypeError, AttributeError, IndexError) as error:
        raise InputError(name, f"gives no tuple of leaves ({error})", remedy) from None
    own = {id(leaf) for leaf in jax.tree.leaves(dict(given)) if jnp.issubdtype(leaf.dtype, jnp.floating)}
    asked = set(map(id, found))
    for fails, what in (
        (not found, "names no leaf"),
        (not own >= asked, f"gives what is no number of {' or '.join(given)} as a whole"),
        (len(asked) < len(found), "gives a leaf twice"),
    ):
        if fails:
            raise InputError(name, what, remedy)
    return found


def _words(path: tuple[Any, ...], scenes: int) -> str:
    """What a person calls a leaf: n, lights[0].direction, or scenes[1].ambient where there are several."""
    words = jax.tree_util.keystr(path).replace("[1]", "scenes", 1) if path[0].idx else path[-1].name
    return words if scenes > 1 else words.removeprefix("scenes[0].")


def named_leaves(names: Sequence[str]) -> Callable[[Any, list[brdf.Scene]], list[Any]]:
    """The leaves of causes that a diagnosis names, after those of the material."""
    asked = [NAMED.fullmatch(str(name)) for name in names]
    if None in asked:
        words = "Name light, distance, intensity, ball or radius, or one of them as the diagnosis does"
        raise InputError("free", f"names {names[asked.index(None)]!r}, which is no number of a scene", words)

    def leaves(material: Any, scenes: list[brdf.Scene]) -> list[Any]:
        found = [material.k_d] if any(scene.lights for scene in scenes) else []
        found += [material.k_a] if any(scene.ambient is not None for scene in scenes) else []
        found += [material.k_s, material.n] if np.any(np.asarray(getattr(material, "k_s", 0.0))) else []
        for match in filter(None, asked):
            index, picture = (None if part is None else int(part) for part in match.groups()[1:])
            # Of all intensities that of the first light is the unit of the material.
            shown = scenes if picture is None else scenes[picture : picture + 1]
            own = [leaf for scene in shown for leaf in scene_leaves(match[1], scene, index)]
            is_unit = match[1] == "intensity" and index is None and not picture
            if not own[is_unit:]:
                remedy = "Free what they have; the first light's intensity is the unit of the material"
                raise InputError("free", f"names {match[0]!r}, which is not in the scenes", remedy)
            found += own[is_unit:]
        return list({id(leaf): leaf for leaf in found}.values())

    return leaves


def scene_leaves(kind: str, scene: brdf.Scene, index: int | None = None) -> list[Any]:
    """Those of a kind of cause; of one light or of all."""
    lights: list[Any] = [light for place, light in enumerate(scene.lights) if index in (None, place)]
    placed = [(light, place) for light in lights if (place := place_of(light))]
    spheres: list[Any] = [shape for shape in scene.shapes if isinstance(shape, brdf.Sphere) and shape.fitted]
    return {
        "light": [getattr(light, place) for light, place in placed],
        "distance": [getattr(light, place) for light, place in placed if place != "direction"],
        "intensity": [light.emittance for light in lights],
        "ball": [sphere.center for sphere in spheres],
        "radius": [sphere.radius for sphere in spheres],
    }[kind]


def place_of(light: Any) -> str | None:
    """What says where a light stands: its direction, if it is far; None for what has no one place."""
    return next((field for field in ("position", "center", "direction") if field in vars(light)), None)
