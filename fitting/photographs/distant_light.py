"""Where a distant light comes from: by its highlight on a mirror ball, or by the shading of a matt surface.

Lambert's law is linear in the light's vector, which gives the start. Where the picture shows a highlight, a lobe about
the half vector or the mirror direction is fitted with it: left to robust weights alone, a broad one pulls the light by
several degrees. Only where the light comes in at an angle is looked at, so that shadows say nothing.
"""

import itertools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

import brdf
from brdf.errors import InputError
from fitting.photographs.ball import Circle, ball_normals

Array = np.ndarray

# What belongs to a highlight: its core is looked for above one share of the brightest pixel; it reaches down to half of
# the brightest, within a share of the radius around it.
CORE, HIGHLIGHT, HIGHLIGHT_RADIUS = 0.9, 0.5, 0.12
# Lambert's law is fitted where the light's cosine exceeds this, at first on pixels above this share of the brightest.
LIT, BRIGHT = 0.15, 0.05
# Huber's tuning constant, which keeps 95 % efficiency on Gaussian noise, times the ratio of deviation and median.
HUBER = 1.345 * 1.4826
FEWEST = 10
# More pixels than these tell the light no better than the model is true; so many are enough to tell which highlight.
MOST_PIXELS, SEARCH_PIXELS = 1 << 16, 1 << 11
# Of the numbers of `_shown`; with a smaller exponent a lobe cannot be told from Lambert's law. Exponents to start from.
LOWEST = np.array([-np.inf, -np.inf, -np.inf, -np.inf, 0.0, np.log(3.0)])
HIGHEST = np.array([np.inf, np.inf, np.inf, np.inf, np.inf, np.log(1e4)])
STARTS = (8.0, 60.0)
# Where a descent ends, in units of the brightest pixel.
CLOSE = 1e-8
# A highlight is believed where the logarithm of the likelihood rises by so much.
RISE = 20.0
# The surface is cut into so many blocks along each side; residuals of one block may go together.
BLOCKS = 12
# Root mean square angle in degrees of directions drawn at random: the mean of t^2 under sin(t) / 2 is pi^2 / 2 - 2.
GUESS = float(np.degrees(np.sqrt(np.pi**2 / 2 - 2)))
# Residuals below this share of the light are rounding.
ROUNDING = 1e-9
TO_VIEW = np.array([0.0, 0.0, 1.0])


def photograph_scene(
    points: brdf.SurfacePoints, direction: Any, intensity: Any = 1.0, *, ambient: Any = None
) -> brdf.Scene:
    """The scene of a photograph under one distant light.

    Args:
        points: what the pixels see.
        direction: towards the light, (3,), of any length but 0.
        intensity: of it, a number or one per channel; where it is not known, 1: k_d then is k_d times the intensity.
        ambient: intensity of the ambient light, or None.

    Raises:
        InputError: naming the argument.
    """
    light = brdf.DirectionalLight(direction=direction, intensity=intensity)
    return brdf.Scene(points=points, lights=(light,), ambient=ambient)


def _values(picture: Any) -> Float[Array, "H W C"]:
    return np.atleast_3d(np.asarray(getattr(picture, "pixels", picture), np.float64))


def light_from_highlight(picture: Any, circle: Circle, *, mask: Any = True) -> Float[Array, "3"]:
    """Direction towards a distant light from its reflection in a mirror ball.

    Args:
        picture: linear values, (H, W, C) or (H, W), or a `brdf.Picture`, of the mirror ball.
        circle: its outline.
        mask: (H, W), pixels that count; or True.

    Returns:
        The unit direction, 2 (N.V) N - V at the middle of the highlight.

    Raises:
        InputError: where the ball is not in the picture or shows no highlight.
    """
    grey = _values(picture).mean(axis=-1)
    inside = np.any(ball_normals((grey.shape[0], grey.shape[1]), circle) != 0, axis=-1) & np.isfinite(grey) & mask
    largest = float(np.max(grey, where=inside, initial=-np.inf))
    if not largest > 0:
        raise InputError("picture", "is black on the mirror ball", "Give a picture with a highlight")
    rows, columns = np.nonzero(inside & (grey >= CORE * largest))
    if rows.size > 0.25 * np.count_nonzero(inside):
        raise InputError("picture", "has no highlight: a quarter of the ball is as bright", "Give a darker exposure")
    x, y = float(np.median(columns)), float(np.median(rows))
    if not np.any(np.hypot(columns - x, rows - y) <= HIGHLIGHT_RADIUS * circle.radius):
        # The median fell between two lights.
        x, y = float(columns[0]), float(rows[0])
    rows, columns = np.nonzero(inside & (grey >= HIGHLIGHT * largest))
    for _ in range(20):
        near = np.hypot(columns - x, rows - y) <= HIGHLIGHT_RADIUS * circle.radius
        x, y = float(columns[near].mean()), float(rows[near].mean())
    across, up = (x - circle.x) / circle.radius, -(y - circle.y) / circle.radius
    z = max(1 - across**2 - up**2, 0.0) ** 0.5
    return np.array([2 * z * across, 2 * z * up, 2 * z * z - 1])


class ShadingLight(NamedTuple):
    """A distant light as the shading of a matt surface tells it.

    Attributes:
        direction: towards it, unit, (3,).
        strength: what a pixel that faces it shows: diffuse albedo times intensity.
        error: standard error of the direction in degrees, the root mean square of the angle to the true one, from the
            residual; it knows that what the model leaves goes together over parts of the surface, not what it does to
            the direction everywhere alike.
    """

    direction: Float[Array, "3"]
    strength: float
    error: float


def light_from_shading(
    picture: Any,
    points: brdf.SurfacePoints,
    *,
    saturation: float | None = None,
    mask: Any = True,
    ambient: bool = False,
) -> ShadingLight:
    """Direction of a distant light from the shading: Lambert's law and a highlight where the light comes in.

    Args:
        picture: linear values, (H, W, C) or (H, W), or a `brdf.Picture`.
        points: what each pixel sees.
        saturation: linear value from which on pixels are clipped; None takes the largest code of an integer file.
        mask: (H, W), pixels that count; or True.
        ambient: whether the surface is lit from all around as well.

    Returns:
        Direction and strength, found robustly so that highlights and cast shadows do not pull.

    Raises:
        InputError: where fewer than ten pixels are lit or they do not determine a direction.
    """
    if saturation is not None and not saturation > 0:
        raise InputError("saturation", f"must be a linear value above 0, got {saturation!r}", "Give a number")
    if saturation is None:
        saturation = getattr(picture, "saturation", None)
    values = _values(picture)
    counts = np.asarray(points.mask) & np.isfinite(values.mean(axis=-1)) & mask
    if saturation is not None:
        counts &= np.max(values, axis=-1) < saturation
    normal = np.asarray(points.normal, np.float64)[counts]
    return fit_shading(values[counts].mean(axis=-1), normal, np.argwhere(counts), ambient=ambient)


def fit_shading(
    value: Float[Array, " M"],
    normal: Float[Array, "M 3"],
    pixel: Int[Array, "M 2"],
    *,
    ambient: bool = False,
) -> ShadingLight:
    """Find the light.

    Args:
        value: of each pixel.
        normal: there, the viewer being far away along z.
        pixel: row and column of it.
        ambient: whether there is light from all around.

    Raises:
        InputError: where fewer than ten pixels are lit or they do not determine a direction.
    """
    some = slice(None, None, max(1, -(-value.size // MOST_PIXELS)))
    value, normal, block = value[some], normal[some], _blocks(pixel)[some]
    unit = float(np.max(value, initial=0.0))
    lit = value > BRIGHT * unit
    if np.count_nonzero(lit) < FEWEST:
        raise InputError("picture", "has fewer than ten lit pixels on the surface", "Give a brighter picture")
    value = residual = value / unit
    matt, free = np.zeros(6), np.array([True, True, True, ambient, False, False])
    for _ in range(100):
        before, scale = matt, _bound(residual[lit])
        matt, cost, residual, slopes = _refine(matt, free, False, scale, value, normal, lit)
        if np.allclose(before, matt, rtol=0, atol=10 * CLOSE):
            break
        lit = _reached(normal, matt[:3])
    light, free = matt[:3], free | [False, False, False, False, True, True]
    few = np.flatnonzero(lit)[:: max(1, -(-np.count_nonzero(lit) // SEARCH_PIXELS))]
    found = []
    for mirror, n in itertools.product((False, True), STARTS):
        start = np.array([*light, 0.02 * ambient, 0.1, np.log(n)])
        shiny, left, *_ = _refine(start, free, mirror, scale, value[few], normal[few], lit[few])
        found.append((left, mirror, shiny))
    _, mirror, shiny = min(found, key=lambda one: one[0])
    shiny, left, off, _ = _refine(shiny, free, mirror, scale, value, normal, lit)
    if np.count_nonzero(lit) * np.log(max(cost, 1e-300) / max(left, 1e-300)) > 2 * RISE:
        # Lambert's law alone may have looked at pixels that the light does not reach.
        lit = _reached(normal, shiny[:3])
        scale = _bound(off[lit])
        shiny, _, residual, slopes = _refine(shiny, free, mirror, scale, value, normal, lit)
        light = shiny[:3]
    error = _error(light, residual[lit], slopes[lit], scale, block[lit])
    if not error < GUESS:
        raise _too_little()
    length = float(np.linalg.norm(light))
    return ShadingLight(light / length, length * unit, error)


def _too_little() -> InputError:
    return InputError("picture", "shows too little of the lit surface to tell the light", "Give its direction")


def _blocks(pixel: Array) -> Array:
    """Which of the blocks each pixel lies in."""
    if not len(pixel):
        return np.zeros(0, int)
    pixel = pixel - pixel.min(axis=0)
    row, column = (pixel // -(-(pixel.max() + 1) // BLOCKS)).T
    return row * BLOCKS + column


def _bound(residual: Array) -> float:
    """Beyond which a residual's pull is constant."""
    return max(HUBER * float(np.median(np.abs(residual))), ROUNDING)


def _reached(normal: Array, light: Array) -> Array:
    """Pixels that the light reaches at an angle."""
    lit = normal @ light > LIT * np.linalg.norm(light)
    if np.count_nonzero(lit) < FEWEST:
        raise _too_little()
    return lit


def _shown(numbers: Array, mirror: bool, normal: Array) -> Array:
    """What pixels with these normals show, the light reaching them: ambient light, Lambert's law and a highlight.

    Args:
        numbers: the light's vector, as long as what a pixel that faces it shows; ambient light; strength of the
            highlight and logarithm of its exponent.
        mirror: whether its lobe is about the mirror direction, not the half vector.
        normal: of the pixels.
    """
    light, (ambient, specular, log_n) = numbers[:3], numbers[3:]
    shown = ambient + normal @ light
    if not specular:
        return shown
    to_light = light / max(float(np.linalg.norm(light)), 1e-300)
    half = to_light + TO_VIEW
    about_half = normal @ (half / max(float(np.linalg.norm(half)), 1e-9))
    cosine = 2 * (normal @ to_light) * normal[:, 2] - to_light[2] if mirror else about_half
    return shown + specular * np.clip(cosine, 1e-9, 1.0) ** np.exp(log_n)


def _refine(
    numbers: Array,
    free: Array,
    mirror: bool,
    scale: float,
    value: Array,
    normal: Array,
    lit: Array,
) -> tuple[Array, float, Array, Array]:
    """The nearest minimum of Huber's cost, by Newton steps that are damped as Levenberg and Marquardt's.

    Returns:
        The numbers and the cost, and of every pixel the residual and the derivatives.
    """

    def at(numbers: Array) -> tuple[float, Array]:
        residual = value - _shown(numbers, mirror, normal)
        off = np.abs(residual[lit]) / scale
        return float(np.sum(np.where(off <= 1, off**2, 2 * off - 1))), residual

    def slopes(numbers: Array) -> Array:
        steps = 1e-5 * np.maximum(np.abs(numbers), 1e-3) * np.eye(6)
        ends = [_shown(numbers + step, mirror, normal) - _shown(numbers - step, mirror, normal) for step in steps]
        return np.stack(ends, axis=1) * free / (2 * np.diag(steps))

    cost, residual = at(numbers)
    columns, damping = slopes(numbers), 1e-3
    for _ in range(50):
        weight = lit * np.minimum(1.0, scale / np.maximum(np.abs(residual), 1e-300))
        pull = columns.T @ (weight * residual)
        held = (numbers <= LOWEST) & (pull < 0) | (numbers >= HIGHEST) & (pull > 0)
        gram = (columns.T * weight) @ columns * ~held * ~held[:, None]
        step = np.linalg.pinv(gram + damping * np.diag(np.diag(gram)), 1e-13, hermitian=True) @ (pull * ~held)
        trial = np.clip(numbers + step, LOWEST, HIGHEST)
        trial_cost, left = at(trial)
        if trial_cost < cost:
            numbers, cost, residual, damping = trial, trial_cost, left, damping / 10
            columns = slopes(numbers) if free[4] else columns  # without a highlight all is linear
        else:
            damping *= 10
        if np.max(np.abs(step)) < CLOSE:
            break
    return numbers, cost, residual, columns


def _error(light: Array, residual: Array, slopes: Array, scale: float, block: Array) -> float:
    """Root mean square angle to the true direction in degrees, where residuals of one block go together as they like.

    The jackknife over blocks: how far leaving one out moves the light, by one Newton step. A pixel pulls with its
    residual up to Huber's bound, and with the bound beyond; the derivative of that is 1 and 0.

    Source: Huber 1981, section 7.6; Bell and McCaffrey 2002.
    """
    length = np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
    columns = slopes / length
    pull = columns * np.clip(residual, -scale, scale)[:, None]
    within = columns * (np.abs(residual) <= scale)[:, None]
    members = [block == one for one in np.unique(block)]
    hessian = np.stack([within[here].T @ within[here] for here in members])
    score = np.stack([pull[here].sum(axis=0) for here in members])
    others = hessian.sum(axis=0) - hessian
    inverse = np.linalg.pinv(others, 1e-9, hermitian=True)
    # A highlight may lie in one block; without it the others still tell the light, or they do not.
    if not np.allclose((inverse @ others)[:, :3], np.eye(6)[:3], rtol=0, atol=1e-3):
        return float("inf")
    moved = (inverse @ score[:, :, None])[:, :3, 0] / length[:3]
    along = light / np.linalg.norm(light)
    across = (moved - np.outer(moved @ along, along)) / np.linalg.norm(light)
    return float(np.degrees(np.sqrt((1 - 1 / len(members)) * np.sum(across**2))))
