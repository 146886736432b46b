"""Which light to add next: the one under which one more picture would tell most.

The information of a picture (Fisher's; for noise of one size the Gram matrix of the derivatives by the numbers, over
the noise's variance) adds up over pixels and pictures, and its inverse is the covariance. So what a picture under
another light would make of the errors is known before it is taken: its derivatives are those of the fitted material.

Source: Fedorov, "Theory of Optimal Experiments", 1972; Pukelsheim, "Optimal Design of Experiments", 2006, chapter 6,
for adding one observation after the other.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import brdf
from brdf.errors import InputError
from brdf.lights.base import Light
from brdf.precision import working_precision
from brdf.rendering import basis_columns
from fitting.progress import waiting
from fitting.result import FitResult, of_material_alone
from fitting.solver.nnls import inverse_diagonal
from fitting.solver.tied import join_channels

# Directions of the hemisphere that are tried, 6° apart, and then around the best: up to which angle, how many.
HEMISPHERE, AROUND = (np.pi / 2, 400), ((0.1, 16), (0.025, 16))
# Of a picture at most so many pixels are looked at, evenly spread; what they tell is scaled up.
MOST_PIXELS = 1 << 14
# Of the largest eigenvalue of the information: a smaller one tells nothing.
DEPENDENT = 1e-12
# Weights are what brightness says where their mean at each of so many leaves no more than this share of their variance.
LEVELS, UNEXPLAINED = 64, 0.1


@dataclass(frozen=True)
class LightChoice:
    """The lights to add, and what they are foretold to do.

    Attributes:
        lights: the chosen ones, the best first; each after those before it.
        of: the number whose error they shrink.
        before: its standard error now; the root mean square where it has a value per channel.
        after: with the first of the lights, with the first two, and so on.
        candidates: the lights that were tried for the first.
        foretold: the error with each of them alone, (K,).
        known: the lights that the result has seen.

    Example:
        >>> result = fitting.fit(brdf.read_image("target.exr"), brdf.Scene.load("scene.toml"), model="blinn-phong")
        >>> choice = fitting.next_light(result, [[0, 0, 1], [0.9, 0, 0.3]])
        >>> len(choice.lights), choice.after[0] < choice.before
        (1, True)
        >>> figure = choice.plot()
    """

    lights: tuple[Light, ...]
    of: str
    before: float
    after: tuple[float, ...]
    candidates: tuple[Light, ...] = field(repr=False)
    foretold: Float[np.ndarray, " K"] = field(repr=False)
    known: tuple[Light, ...] = field(repr=False)

    @property
    def direction(self) -> Float[np.ndarray, "3"]:
        """Of the first light where it is directional: the unit vector towards it."""
        return direction_of(self.lights[0])

    @property
    def _what(self) -> str:
        """What is told of."""
        return "number of undetermined texels" if self.of == "undetermined" else f"error of {self.of}"

    def __str__(self) -> str:
        """In words, a line a light."""
        lines, befores = [], (self.before, *self.after)
        for light, before, after in zip(self.lights, befores, self.after, strict=False):
            shown = repr(light)
            if isinstance(light, brdf.DirectionalLight):
                shown = f"a light from ({', '.join(f'{value:.3f}' for value in direction_of(light))})"
            lines.append(f"{shown} brings the {self._what} from {before:.3g} to {after:.3g}")
        return "\n".join(lines)

    def plot(self) -> Any:
        """The hemisphere of lights seen from the camera, coloured by the error that each would leave, if it leaves one.

        Returns:
            A matplotlib figure.

        Raises:
            InputError: where the candidates have no direction.
        """
        from matplotlib.figure import Figure

        figure = Figure(figsize=(4.6, 3.8), layout="constrained")
        axes = figure.subplots()
        tried = np.array([direction_of(light) for light in self.candidates])
        colours = axes.scatter(*tried[:, :2].T, c=self.foretold, cmap="cividis_r", s=45, linewidths=0)
        for lights, marker, label in ((self.known, "x", "there already"), (self.lights, "*", "chosen")):
            places = [direction_of(light)[:2] for light in lights if isinstance(light, brdf.DirectionalLight)]
            axes.scatter(*np.reshape(places, (-1, 2)).T, marker=marker, s=90, color="#D55E00", label=label)
        axes.set(title="with one more light", xlabel="x towards the light", ylabel="y", aspect="equal")
        axes.legend(loc="lower right", fontsize=7)
        figure.colorbar(colours, label=self._what)
        return figure


def next_light(result: Any, candidates: Sequence[Any] | None = None, count: int = 1, *, of: str = "n") -> LightChoice:
    """Find the light under which one more picture would shrink the error of a number most.

    Camera, shapes, ambient light and noise are taken to stay as they are in the first picture.

    Args:
        result: of `fitting.fit`, of one picture or several; or maps, see `Maps.next_light`.
        candidates: lights, or directions towards them, (K, 3), which shine as bright on what the picture shows as the
            brightest of the result's lights; None for any direction of the hemisphere on the camera's side.
        count: how many, one chosen after the other.
        of: "n", "k_s", "k_d", "k_a", or one channel, as "k_s[0]".

    Returns:
        The lights, the error before and after, and a picture of the hemisphere: `LightChoice`.

    Raises:
        InputError: naming the argument, where it cannot be used.

    Example:
        >>> result = fitting.fit(brdf.read_image("target.exr"), brdf.Scene.load("scene.toml"), model="blinn-phong")
        >>> choice = fitting.next_light(result, candidates=[[0, 0, 1], [0.5, 0.6, 0.7]])
        >>> choice.direction.round(1)
        array([0., 0., 1.])
    """
    if hasattr(result, "next_light"):  # maps, which stand above this module, know their own texels
        return result.next_light(candidates, count, of=of)
    if not isinstance(result, FitResult):
        what = f"must be of fitting.fit or fit_maps, got {type(result).__name__}"
        raise InputError("result", what, "Fit the pictures first")
    of_material_alone(result)
    free, asked = result.free_parameters, result[of]
    asked = asked if isinstance(asked, tuple) else (asked,)
    for one in asked:
        if one not in free:
            what = f"{one.key} has no error to shrink: {one.reason or 'is at its bound'}"
            raise InputError("of", what, "Ask for another number")
    wanted, index = [one in asked for one in free], [one.place(result.noise.size) for one in free]
    known = tuple(light for scene in result.scenes for light in scene.lights)
    with working_precision("float64"), waiting("trying lights"):
        material = brdf.cast(result.material, "float64")
        k_s = np.asarray(getattr(material, "k_s", np.zeros(result.noise.size)))

        def information_of(scene: brdf.Scene, weight: np.ndarray) -> np.ndarray:
            """Fisher's information of the free numbers."""
            gram = np.asarray(_gram(material, brdf.cast(scene, "float64"), weight))
            none = np.zeros(gram.shape[:2])
            return join_channels(gram, none, none[:, 0], k_s, result.noise**2).gram[np.ix_(index, index)]

        def error(information: np.ndarray) -> float:
            """Root mean square of the standard errors of what is wanted; infinite where one is not determined."""
            return float(np.sqrt(np.mean(inverse_diagonal(information, DEPENDENT)[wanted])))

        scenes = [_scene(result, index, counted) for index, counted in enumerate(result.counted)]
        clipped, ceiling = _clipped(result)
        first, weight, counted = _scene(result, 0, result.counted[0] | clipped)

        def rendered(scene: brdf.Scene) -> np.ndarray:
            return np.asarray(brdf.render(material, scene, precision="float64")).reshape(weight.shape[0], -1)

        bright = _by_brightness(rendered(first)[counted], weight[counted])
        to_view = np.asarray(first.surface_points().to_view, np.float64).reshape(-1, 3).mean(axis=0)
        information = np.sum([information_of(scene, weight) for scene, weight, _ in scenes], axis=0)
        # What is known is what the fit says, of codes by their edges: another picture is taken to tell as much a pixel.
        own = math.sqrt(np.mean([one.error**2 for one in asked]))
        unit = (error(information) / own) ** 2 if own > 0 else 1.0

        def information_by(light: Light) -> np.ndarray:
            lit, channels = dataclasses.replace(first, lights=(light,), visibility=()), result.noise.size
            if lit.channels not in (1, channels):
                what = f"have {lit.channels} channels, the pictures {channels}"
                raise InputError("candidates", what, "Give both the same number, or light of one")
            shown = rendered(lit)
            return unit * information_of(lit, (weight if bright is None else bright(shown)) * (shown < ceiling))

        arriving = [_arriving(light, scene) for scene, *_ in scenes for light in scene.lights]
        return choose_lights(candidates, count, of, known, arriving, to_view, unit * information, information_by, error)


def choose_lights(
    candidates: Any,
    count: int,
    of: str,
    known: tuple[Light, ...],
    arriving: Sequence[np.ndarray],
    to_view: np.ndarray,
    information: np.ndarray,
    information_by: Callable[[Light], np.ndarray],
    error: Callable[[np.ndarray], float],
) -> LightChoice:
    """Choose lights one after the other, each where it leaves the least error.

    The information of the known lights, which adds up, tells with that of one more the error of the number ``of``; a
    hemisphere of candidates lies around ``to_view``, as bright as the most that is arriving of a known light.
    """
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise InputError("count", f"must be 1 or more, got {count}", "Say how many lights to add")
    shining = max(arriving, key=np.mean, default=np.ones(1))
    listed = isinstance(candidates, Sequence | np.ndarray | jax.Array)
    given = [_light(one, shining) for one in candidates] if listed else []
    if candidates is not None and not given:
        what = f"is empty, or no list: {candidates!r:.60}"
        raise InputError("candidates", what, "Give lights or directions, or None for any direction")

    def left(light: Light) -> float:
        return error(information + information_by(light))

    def around(middle: np.ndarray, size: float, number: int) -> list[Light]:
        return [_light(one, shining) for one in _cap(middle, size, number)]

    before, chosen, after, foretold = error(information), [], [], []
    tried = given or around(to_view, *HEMISPHERE)
    for _ in range(count):
        errors = list(map(left, tried))
        foretold, best = foretold or errors, tried[int(np.argmin(errors))]
        for near in () if given else AROUND:
            best = min([best, *around(direction_of(best), *near)], key=left)
        information = information + information_by(best)
        chosen.append(best)
        after.append(error(information))
    return LightChoice(tuple(chosen), of, before, tuple(after), tuple(tried), np.array(foretold), known)


def _light(given: Any, shining: np.ndarray) -> Light:
    if isinstance(given, Light):
        return given
    try:
        return brdf.DirectionalLight(direction=given, intensity=shining)
    except InputError:
        what = f"must hold lights or directions of 3 numbers, got {given!r:.60}"
        raise InputError("candidates", what, "Give brdf lights, or (K, 3) directions towards the light") from None


def _arriving(light: Light, scene: brdf.Scene) -> np.ndarray:
    """What a white matt surface shows of a light at most, facing it, (C,); of one that is near or wide, in a scene."""
    if isinstance(light, brdf.DirectionalLight):
        return np.asarray(light.emittance)
    alone = dataclasses.replace(scene, lights=(light,), ambient=None, visibility=())
    image = brdf.render(brdf.Lambert(k_d=np.ones(alone.channels)), alone, precision="float64")
    return np.max(np.asarray(image).reshape(-1, alone.channels), axis=0)


def direction_of(light: Light) -> np.ndarray:
    """The unit vector towards a light; refused where it is not distant."""
    if not isinstance(light, brdf.DirectionalLight):
        what = f"hold a {type(light).__name__}, which has no one direction"
        raise InputError("candidates", what, "Give directional lights, or look at foretold")
    direction = np.asarray(light.direction, np.float64)
    return direction / np.linalg.norm(direction)


def _clipped(result: FitResult) -> tuple[Bool[np.ndarray, "H W"], float]:
    """Which pixels of the first picture are clipped, and from which value on; infinite where none is."""
    target, counted = np.asarray(result.targets[0], np.float64), np.asarray(result.counted[0])
    brightest = np.where(np.asarray(result.scenes[0].sight().mask).reshape(counted.shape), target.max(axis=-1), -np.inf)
    clipped = ~counted & np.isfinite(brightest) & (brightest >= np.max(target[counted]))
    clipped &= result.left_out.get("clipped", 0) > 0
    return clipped, float(np.min(brightest, where=clipped, initial=np.inf))


def _scene(
    result: FitResult, index: int, which: Bool[np.ndarray, "H W"]
) -> tuple[brdf.Scene, Float[np.ndarray, "P 1|C"], Bool[np.ndarray, " P"]]:
    """Some pixels of a picture, at most so many, their weights, which stand for all of them, and which of them counted.

    Those that did not weigh as much as the others do.
    """
    pixel, counted = np.flatnonzero(which), np.ravel(result.counted[index])
    some = pixel[:: -(-pixel.size // MOST_PIXELS)]
    weight = result.weighed[index].reshape(counted.size, -1)
    weight = np.where(counted[:, None], weight, np.mean(weight[counted], axis=0))[some] * (pixel.size / some.size)
    return brdf.some_pixels(result.scenes[index], some, precision="float64"), weight, counted[some]


def _by_brightness(value: np.ndarray, weight: np.ndarray) -> Callable[[np.ndarray], np.ndarray] | None:
    """Weights of other values, (P, C), where those of the values are what their brightness says; else None."""
    if np.ptp(weight) == 0:
        return None
    known = []
    for channel in range(value.shape[1]):
        own = weight[:, channel % weight.shape[1]]
        order = np.argsort(value[:, channel])
        parts = [part for part in np.array_split(order, LEVELS) if part.size]
        of_parts = np.array([[np.mean(value[part, channel]), np.mean(own[part])] for part in parts]).T
        left = own[order] - np.interp(value[order, channel], *of_parts)
        if np.var(left) > UNEXPLAINED * np.var(own):
            return None
        known.append((of_parts[0], of_parts[1]))
    return lambda other: np.stack([np.interp(own, *of) for own, of in zip(other.T, known, strict=True)], axis=1)


def _cap(middle: np.ndarray, size: float, count: int) -> list[np.ndarray]:
    """Evenly spread directions around another one, up to an angle from it: Vogel's spiral, of equal areas."""
    height = 1 - (1 - np.cos(size)) * (np.arange(count) + 0.5) / count
    around = np.sqrt(1 - height**2) * np.exp(1j * np.pi * (3 - np.sqrt(5)) * np.arange(count))
    axes = np.vstack([middle / np.linalg.norm(middle), np.linalg.svd(middle[None])[2][1:]])
    return list(np.stack([height, around.real, around.imag], axis=1) @ axes)


@eqx.filter_jit
def _gram(material: brdf.Material, scene: brdf.Scene, weight: Float[Any, "W 1|C"]) -> Float[Array, "C 4 4"]:
    """Weighted products of the columns of a picture: ambient, diffuse, lobe, and the lobe's derivative by n."""
    columns = basis_columns(material, scene).reshape(4, *weight.shape[:1], -1)
    return jnp.einsum("iwc,wc,jwc->cij", columns, jnp.broadcast_to(weight, columns.shape[1:]), columns)
