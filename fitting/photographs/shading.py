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
# Root mean square angle in degrees of directions drawn at random: the mean of t^2 under sin(t) / 2 is pi^2 / 2 - 2.
GUESS = float(np.degrees(np.sqrt(np.pi**2 / 2 - 2)))
# Residuals below this share of the light are rounding.
ROUNDING = 1e-9
TO_VIEW = np.array([0.0, 0.0, 1.0])


class Shading(NamedTuple):
    """What the shading tells.

    Attributes:
        light: towards the light, as long as what a pixel that faces it shows, (3,).
        error: standard error of the direction in degrees: the root mean square of the angle to the true one.
        pixels: how many told it.
    """

    light: Float[np.ndarray, "3"]
    error: float
    pixels: int


class _Look(NamedTuple):
    """What a shiny surface shows.

    Attributes:
        light: towards the light, as long as what a matt pixel that faces it shows, (3,).
        ambient: what light from all around adds; None where there is none.
        specular: strength of the highlight.
        log_n: logarithm of its exponent.
        mirror: whether its lobe is about the mirror direction, not the half vector.
    """

    light: Float[np.ndarray, "3"]
    ambient: float | None
    specular: float
    log_n: float
    mirror: bool

    def numbers(self) -> Float[np.ndarray, " K"]:
        """What is solved for: light, ambient where there is any, specular, log_n."""
        around = [] if self.ambient is None else [self.ambient]
        return np.array([*self.light, *around, self.specular, self.log_n])

    def with_numbers(self, numbers: Float[np.ndarray, " K"]) -> "_Look":
        x, y, z, *around, specular, log_n = numbers
        return _Look(np.array([x, y, z]), around[0] if around else None, specular, log_n, self.mirror)

    def one_each(self, light: float, ambient: float, specular: float, log_n: float) -> Float[np.ndarray, " K"]:
        """In the order of `numbers` one value for each kind of them."""
        around = None if self.ambient is None else ambient
        return _Look(np.full(3, light), around, specular, log_n, self.mirror).numbers()

    def of(self, normal: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, " M"]:
        """What pixels with these normals show, the light reaching them."""
        direction = self.light / max(float(np.linalg.norm(self.light)), 1e-300)
        highlight = self.specular * _lobe(direction, normal, mirror=self.mirror) ** np.exp(self.log_n)
        return (self.ambient or 0.0) + normal @ self.light + highlight

    def slopes(self, normal: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "M K"]:
        """Derivatives by what is solved for, by central differences."""
        numbers = self.numbers()
        steps = 1e-5 * np.maximum(np.abs(numbers), 1e-3 * float(np.linalg.norm(self.light)))
        found = []
        for step, move in zip(steps, np.diag(steps), strict=True):
            up, down = self.with_numbers(numbers + move), self.with_numbers(numbers - move)
            found.append((up.of(normal) - down.of(normal)) / (2 * step))
        return np.stack(found, axis=1)


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
    # From here on in units of the light: the solver's limits are absolute.
    unit = float(np.linalg.norm(light))
    pixels, light = pixels._replace(value=pixels.value / unit), light / unit
    known = pixels.some(lit)
    look = _highlight(known, light, ambient=ambient)
    if look is None:
        slopes = _columns(known.normal, ambient=ambient)
        unknown, weight = _robust(slopes, known.value, np.ones(known.value.size, bool))
        light, residual = unknown[:3], known.value - slopes @ unknown
    else:
        # Lambert's law alone may have looked at pixels that the light does not reach.
        known = pixels.some(_reached(pixels, look.light))
        if known.value.size < FEWEST:
            raise _too_little()
        look = _descend(known, look, _bound(known.value - look.of(known.normal), 1.0))
        light, residual, slopes = look.light, known.value - look.of(known.normal), look.slopes(known.normal)
        weight = _huber(residual, 1.0)
    error = _error(light, residual, slopes, weight, known.block)
    if not error < GUESS:
        raise _too_little()
    return Shading(light * unit, error, known.value.size)


def _too_little() -> InputError:
    return InputError("picture", "shows too little of the lit surface to tell the light", "Give its direction")


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


def _bound(residual: Float[np.ndarray, " M"], size: float) -> float:
    """Beyond which a residual's pull is constant, where the light is of this size."""
    return max(HUBER * float(np.median(np.abs(residual))), ROUNDING * size)


def _huber(residual: Float[np.ndarray, " M"], size: float) -> Float[np.ndarray, " M"]:
    return np.minimum(1.0, _bound(residual, size) / np.maximum(np.abs(residual), 1e-300))


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
        weight[lit] = _huber((value - columns @ unknown)[lit], float(np.linalg.norm(unknown[:3])))
    return unknown, weight


def _reached(pixels: _Pixels, light: Float[np.ndarray, "3"]) -> Bool[np.ndarray, " M"]:
    return pixels.normal @ light > LIT * np.linalg.norm(light)


def _linear(pixels: _Pixels, *, ambient: bool) -> tuple[Float[np.ndarray, "3"], Bool[np.ndarray, " M"]]:
    """The light by Lambert's law alone, and which pixels it reaches."""
    value, columns = pixels.value, _columns(pixels.normal, ambient=ambient)
    lit = value > BRIGHT * np.max(value, initial=0.0)
    if np.count_nonzero(lit) < FEWEST:
        raise InputError("picture", "has fewer than ten lit pixels on the surface", "Give a brighter picture")
    light = np.zeros(3)
    for _ in range(100):
        before, light = light, _robust(columns, value, lit)[0][:3]
        lit = _reached(pixels, light)
        if np.count_nonzero(lit) < FEWEST:
            raise _too_little()
        if np.allclose(before, light, rtol=1e-9, atol=0):
            break
    return light, lit


def _lobe(direction: Float[np.ndarray, "3"], normal: Float[np.ndarray, "M 3"], *, mirror: bool) -> np.ndarray:
    """The cosine of the highlight's lobe."""
    if mirror:
        cosine = 2 * (normal @ direction) * (normal @ TO_VIEW) - direction @ TO_VIEW
    else:
        half = direction + TO_VIEW
        cosine = normal @ (half / max(float(np.linalg.norm(half)), 1e-9))
    return np.clip(cosine, 1e-9, 1.0)


def _highlight(pixels: _Pixels, light: Float[np.ndarray, "3"], *, ambient: bool) -> _Look | None:
    """The surface with a highlight; None where the picture shows none."""
    columns = _columns(pixels.normal, ambient=ambient)
    matt = pixels.value - columns @ _robust(columns, pixels.value, np.ones(pixels.value.size, bool))[0]
    size = float(np.linalg.norm(light))
    scale = _bound(matt, size)
    few = _thinned(pixels, SEARCH_PIXELS)
    around = 0.02 * size if ambient else None
    starts = [_Look(light, around, 0.1 * size, np.log(n), mirror) for mirror in (False, True) for n in STARTS]
    found = [_descend(few, start, scale) for start in starts]
    best = _descend(pixels, min(found, key=lambda one: _cost(few, one, scale)), scale)
    before, after = _huber_cost(matt, scale), _cost(pixels, best, scale)
    return best if pixels.value.size * np.log(before / max(after, 1e-300)) > 2 * RISE else None


def _huber_cost(residual: Float[np.ndarray, " M"], scale: float) -> float:
    share = np.abs(residual) / scale
    return float(np.sum(np.where(share <= 1, share**2, 2 * share - 1)))


def _cost(pixels: _Pixels, look: _Look, scale: float) -> float:
    return _huber_cost(look.of(pixels.normal) - pixels.value, scale)


def _descend(pixels: _Pixels, start: _Look, scale: float) -> _Look:
    """The nearest minimum."""
    low = start.one_each(light=-np.inf, ambient=-np.inf, specular=0.0, log_n=np.log(EXPONENTS[0]))
    high = start.one_each(light=np.inf, ambient=np.inf, specular=np.inf, log_n=np.log(EXPONENTS[1]))
    size = float(np.linalg.norm(start.light))
    units = start.one_each(light=size, ambient=size, specular=size, log_n=1.0)

    def residual(numbers: np.ndarray) -> np.ndarray:
        return start.with_numbers(numbers).of(pixels.normal) - pixels.value

    inside = np.clip(start.numbers(), low, high)
    found = least_squares(residual, inside, bounds=(low, high), loss="huber", f_scale=scale, x_scale=units, max_nfev=50)
    return start.with_numbers(found.x)


def _error(
    light: Float[np.ndarray, "3"],
    residual: Float[np.ndarray, " M"],
    slopes: Float[np.ndarray, "M K"],
    weight: Float[np.ndarray, " M"],
    block: Int[np.ndarray, " M"],
) -> float:
    """Root mean square angle to the true direction in degrees, where residuals of one block go together as they like.

    The jackknife over blocks: how far leaving one out moves the light, by one Newton step. A pixel pulls with its
    weight times its residual; the derivative of that is 1 up to Huber's bound and 0 beyond, where the pull is constant.

    Source: Huber 1981, section 7.6; Bell and McCaffrey 2002.
    """
    length = np.linalg.norm(slopes, axis=0)
    length[length == 0] = 1.0
    columns = slopes / length
    pull, within = columns * (weight * residual)[:, None], columns * (weight >= 1)[:, None]
    members = [block == one for one in np.unique(block)]
    hessian = np.stack([within[here].T @ within[here] for here in members])
    score = np.stack([pull[here].sum(axis=0) for here in members])
    others = hessian.sum(axis=0) - hessian
    inverse = np.linalg.pinv(others, 1e-9, hermitian=True)
    # A highlight may lie in one block; without it the others still tell the light, or they do not.
    if not np.allclose((inverse @ others)[:, :3], np.eye(length.size)[:3], rtol=0, atol=1e-3):
        return float("inf")
    moved = (inverse @ score[:, :, None])[:, :3, 0] / length[:3]
    size = float(np.linalg.norm(light))
    across = moved - np.outer(moved @ light, light) / size**2
    return float(np.degrees(np.sqrt((1 - 1 / len(members)) * np.sum(across**2)) / size))
