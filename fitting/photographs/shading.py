"""A distant light from the shading of a surface: ambient light, Lambert's law and a highlight, fitted robustly.

Lambert's law is linear in the light's vector, which gives the start. Where the picture shows a highlight, a lobe about
the half vector or the mirror direction is fitted with it: left to robust weights alone, a broad one pulls the light by
several degrees. Only where the light comes in at an angle is looked at, so that shadows say nothing.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import least_squares

from brdf.errors import InputError

# Lambert's law is fitted where the light's cosine exceeds this, at first on pixels above this share of the brightest.
LIT, BRIGHT = 0.15, 0.05
# Huber's tuning constant, which keeps 95 % efficiency on Gaussian noise, times the ratio of deviation and median.
HUBER = 1.345 * 1.4826
FEWEST = 10
# More pixels than these tell the light no better than the model is true.
MOST_PIXELS = 1 << 16
# So many are enough to tell which highlight it is.
SEARCH_PIXELS = 1 << 11
# Exponents: below the least a lobe cannot be told from Lambert's law; starts of the search.
EXPONENTS, STARTS = (3.0, 1e4), (8.0, 60.0)
# A highlight is believed where the logarithm of the likelihood rises by so much.
RISE = 20.0
# The surface is cut into so many blocks along each side; residuals of one block may go together.
BLOCKS = 12
TO_VIEW = np.array([0.0, 0.0, 1.0])


class Shading(NamedTuple):
    """What the shading tells.

    Attributes:
        light: towards the light, as long as what a pixel that faces it shows, (3,).
        error: standard error of the direction, in degrees.
        pixels: how many told it.
    """

    light: Float[np.ndarray, "3"]
    error: float
    pixels: int


class _Pixels(NamedTuple):
    value: Float[np.ndarray, " M"]
    normal: Float[np.ndarray, "M 3"]
    block: Int[np.ndarray, " M"]

    def some(self, which: Bool[np.ndarray, " M"]) -> "_Pixels":
        return _Pixels(self.value[which], self.normal[which], self.block[which])


def fit_shading(
    value: Float[np.ndarray, " M"],
    normal: Float[np.ndarray, "M 3"],
    place: Int[np.ndarray, "M 2"],
    *,
    ambient: bool = False,
) -> Shading:
    """Find the light.

    Args:
        value: of each pixel.
        normal: there, the viewer being far away along z.
        place: row and column of it.
        ambient: whether there is light from all around.

    Raises:
        InputError: where fewer than ten pixels are lit or they do not determine a direction.
    """
    pixels = _thinned(_Pixels(value, normal, _blocks(place)), MOST_PIXELS)
    light, lit = _linear(pixels, ambient=ambient)
    known = pixels.some(lit)
    highlight = _highlight(known, light, ambient=ambient)
    if highlight is None:
        columns = _columns(known.normal, ambient=ambient)
        unknown, weight = _robust(columns, known.value, np.ones(known.value.size, bool))
        residual, slopes = known.value - columns @ unknown, columns
    else:
        # Lambert's law alone may have looked at pixels that the light does not reach.
        known = pixels.some(_reached(pixels, highlight[:3]))
        scale = HUBER * float(np.median(np.abs(known.value - _model(highlight, known.normal)))) + 1e-12
        unknown = _descend(known, highlight, scale, ambient=ambient)
        residual, slopes = known.value - _model(unknown, known.normal), _slopes(unknown, known.normal, ambient=ambient)
        weight = _huber(residual)
    light = unknown[:3]
    return Shading(light, _error(light, residual, slopes, weight, known.block), known.value.size)


def _thinned(pixels: _Pixels, most: int) -> _Pixels:
    count = pixels.value.size
    return pixels.some(np.arange(count) % max(1, -(-count // most)) == 0)


def _blocks(place: Int[np.ndarray, "M 2"]) -> Int[np.ndarray, " M"]:
    if not len(place):
        return np.zeros(0, int)
    first = place.min(axis=0)
    side = max(1, -(-int(np.max(place.max(axis=0) + 1 - first)) // BLOCKS))
    row, column = ((place - first) // side).T
    return row * BLOCKS + column


def _columns(normal: Float[np.ndarray, "M 3"], *, ambient: bool) -> Float[np.ndarray, "M K"]:
    return np.column_stack([normal, np.ones(len(normal))]) if ambient else normal


def _huber(residual: Float[np.ndarray, " M"]) -> Float[np.ndarray, " M"]:
    size = np.abs(residual)
    return np.minimum(1.0, (HUBER * np.median(size) + 1e-12) / np.maximum(size, 1e-300))


def _robust(
    columns: Float[np.ndarray, "M K"], value: Float[np.ndarray, " M"], lit: Bool[np.ndarray, " M"]
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " M"]]:
    """Reweighted least squares over the lit pixels: what the columns are multiplied by, and weights."""
    weight, unknown = lit.astype(float), np.zeros(columns.shape[1])
    for _ in range(3):
        gram = (columns * weight[:, None]).T @ columns
        if np.linalg.matrix_rank(gram, tol=1e-9 * np.trace(gram)) < gram.shape[0]:
            raise InputError("picture", "shows no surface curved enough to tell the light", "Give its direction")
        unknown = np.linalg.solve(gram, (columns * weight[:, None]).T @ value)
        weight[lit] = _huber((value - columns @ unknown)[lit])
    return unknown, weight


def _reached(pixels: _Pixels, light: Float[np.ndarray, "3"]) -> Bool[np.ndarray, " M"]:
    return pixels.normal @ light > LIT * np.linalg.norm(light)


def _linear(pixels: _Pixels, *, ambient: bool) -> tuple[Float[np.ndarray, "3"], Bool[np.ndarray, " M"]]:
    """The light by Lambert's law alone, and which pixels it reaches."""
    value, columns = pixels.value, _columns(pixels.normal, ambient=ambient)
    lit = value > BRIGHT * np.max(value, initial=0.0)
    light = np.zeros(3)
    for _ in range(100):
        if np.count_nonzero(lit) < FEWEST:
            raise InputError("picture", "has fewer than ten lit pixels on the surface", "Give a brighter picture")
        before, light = light, _robust(columns, value, lit)[0][:3]
        lit = _reached(pixels, light)
        if np.allclose(before, light, rtol=1e-9, atol=0):
            break
    if np.count_nonzero(lit) < FEWEST:
        raise InputError("picture", "has fewer than ten lit pixels on the surface", "Give a brighter picture")
    return light, lit


def _lobe(direction: Float[np.ndarray, "3"], normal: Float[np.ndarray, "M 3"], *, mirror: bool) -> np.ndarray:
    """The cosine of the highlight's lobe."""
    if mirror:
        cosine = 2 * (normal @ direction) * (normal @ TO_VIEW) - direction @ TO_VIEW
    else:
        half = direction + TO_VIEW
        cosine = normal @ (half / max(float(np.linalg.norm(half)), 1e-9))
    return np.clip(cosine, 1e-9, 1.0)


def _model(unknown: Float[np.ndarray, " 7"], normal: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, " M"]:
    """What a pixel shows: of the light (3), ambient light, strength, logarithm of the exponent and kind of the lobe."""
    light, (around, specular, log_n, mirror) = unknown[:3], unknown[3:]
    direction = light / max(float(np.linalg.norm(light)), 1e-300)
    return around + normal @ light + specular * _lobe(direction, normal, mirror=mirror > 0) ** np.exp(log_n)


def _slopes(
    unknown: Float[np.ndarray, " 7"], normal: Float[np.ndarray, "M 3"], *, ambient: bool
) -> Float[np.ndarray, "M K"]:
    """Derivatives of the model by what was free, by central differences."""
    free = [0, 1, 2, 3, 4, 5] if ambient else [0, 1, 2, 4, 5]
    steps = 1e-5 * np.maximum(np.abs(unknown), 1e-3 * float(np.linalg.norm(unknown[:3])))
    found = []
    for index in free:
        step = np.zeros(7)
        step[index] = steps[index]
        found.append((_model(unknown + step, normal) - _model(unknown - step, normal)) / (2 * steps[index]))
    return np.stack(found, axis=1)


def _highlight(pixels: _Pixels, light: Float[np.ndarray, "3"], *, ambient: bool) -> Float[np.ndarray, " 7"] | None:
    """The model with a highlight; None where the picture shows none."""
    columns = _columns(pixels.normal, ambient=ambient)
    matt = pixels.value - columns @ _robust(columns, pixels.value, np.ones(pixels.value.size, bool))[0]
    size = float(np.linalg.norm(light))
    scale = max(HUBER * float(np.median(np.abs(matt))), 1e-9 * size)
    few = _thinned(pixels, SEARCH_PIXELS)
    start = np.array([*light, 0.02 * size if ambient else 0.0, 0.1 * size, 0.0, 0.0])
    found = []
    for mirror in (0.0, 1.0):
        for n in STARTS:
            start[5:] = np.log(n), mirror
            found.append(_descend(few, start, scale, ambient=ambient))
    best = min(found, key=lambda one: _cost(few, one, scale))
    best = _descend(pixels, best, scale, ambient=ambient)
    before, after = _huber_cost(matt, scale), _cost(pixels, best, scale)
    return best if pixels.value.size * np.log(before / max(after, 1e-300)) > 2 * RISE else None


def _huber_cost(residual: Float[np.ndarray, " M"], scale: float) -> float:
    share = np.abs(residual) / scale
    return float(np.sum(np.where(share <= 1, share**2, 2 * share - 1)))


def _cost(pixels: _Pixels, unknown: Float[np.ndarray, " 7"], scale: float) -> float:
    return _huber_cost(_model(unknown, pixels.normal) - pixels.value, scale)


def _descend(
    pixels: _Pixels, start: Float[np.ndarray, " 7"], scale: float, *, ambient: bool
) -> Float[np.ndarray, " 7"]:
    """The nearest minimum over what is free."""
    free = [0, 1, 2, 3, 4, 5] if ambient else [0, 1, 2, 4, 5]
    low = np.array([-np.inf, -np.inf, -np.inf, 0.0, 0.0, np.log(EXPONENTS[0])])[free]
    high = np.array([*[np.inf] * 5, np.log(EXPONENTS[1])])[free]
    size = float(np.linalg.norm(start[:3]))
    unknown = start.copy()

    def residual(values: np.ndarray) -> np.ndarray:
        unknown[free] = values
        return _model(unknown, pixels.normal) - pixels.value

    inside = np.clip(start[free], low, high)
    units = np.array([*[size] * 5, 1.0])[free]
    found = least_squares(residual, inside, bounds=(low, high), loss="huber", f_scale=scale, x_scale=units, max_nfev=50)
    unknown[free] = found.x
    return unknown


def _error(
    light: Float[np.ndarray, "3"],
    residual: Float[np.ndarray, " M"],
    slopes: Float[np.ndarray, "M K"],
    weight: Float[np.ndarray, " M"],
    block: Int[np.ndarray, " M"],
) -> float:
    """Standard error of the direction in degrees, where residuals of one block go together as they like.

    Source: Liang and Zeger 1986, the sandwich over clusters.
    """
    score = np.zeros((int(block.max()) + 1, slopes.shape[1]))
    np.add.at(score, block, slopes * (weight * residual)[:, None])
    used = np.count_nonzero(np.bincount(block))
    bread = np.linalg.pinv((slopes * weight[:, None]).T @ slopes)
    covariance = bread @ (score.T @ score) @ bread * used / max(used - slopes.shape[1], 1)
    length = float(np.linalg.norm(light))
    across = np.eye(3) - np.outer(light, light) / length**2
    return float(np.degrees(np.sqrt(0.5 * np.trace(across @ covariance[:3, :3] @ across)) / length))
