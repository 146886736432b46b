"""Where a distant light comes from: by its highlight on a mirror ball, or by the shading of a matt surface.

Lambert's law is linear in the light's vector, which gives the start. Where the picture shows a highlight, a lobe about
the half vector or the mirror direction is fitted with it: left to robust weights alone, a broad one pulls the light by
several degrees. Only where the light comes in at an angle is looked at, so that shadows say nothing.
"""

import functools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

import brdf
from brdf.errors import InputError
from fitting.photographs.ball import Circle, ball_normals

# What belongs to a highlight: its core is looked for above one share of the brightest pixel; it reaches down to half of
# the brightest, within a share of the radius around it.
CORE, HIGHLIGHT, HIGHLIGHT_RADIUS = 0.9, 0.5, 0.12
# Lambert's law is fitted where the light's cosine exceeds this, at first on pixels above this share of the brightest.
LIT, BRIGHT = 0.15, 0.05
# Huber's tuning constant, which keeps 95 % efficiency on Gaussian noise, times the ratio of deviation and median.
HUBER = 1.345 * 1.4826
FEWEST = 10
# More pixels than these tell the light no better than the model is true.
MOST_PIXELS = 1 << 14
# With a smaller exponent a lobe cannot be told from Lambert's law, with a larger one it cannot be seen. Where to start.
LOWEST_N, LARGEST_N = 3.0, 1e4
STARTS = (8.0, 60.0)
# Where a descent ends: the slope of the mean cost, in units of the brightest pixel.
CLOSE = 1e-10
# Which pixels the light reaches is settled where no number changes by more.
CHANGE = 1e-7
# A highlight is believed where the logarithm of the likelihood rises by so much.
RISE = 20.0
# The surface is cut into so many blocks along each side; residuals of one block may go together.
BLOCKS = 12
# Root mean square angle in degrees of directions drawn at random: the mean of t^2 under sin(t) / 2 is pi^2 / 2 - 2.
GUESS = float(np.degrees(np.sqrt(np.pi**2 / 2 - 2)))
# Residuals below this share of the light are rounding.
ROUNDING = 1e-9
TO_VIEW = np.array([0.0, 0.0, 1.0])
# What is no ball. Of balls the shading leaves up to 0.05 of the light unexplained, of reliefs and coins 0.05 to 3; of
# what is bright on mirror balls all lies in the highlight, elsewhere up to 0.4 does (photographs of shared/data).
DOUBTFUL, NO_BALL, IN_HIGHLIGHT = 0.04, 0.08, 0.5


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


def _values(picture: Any) -> np.ndarray:
    return np.atleast_3d(np.asarray(getattr(picture, "pixels", picture), np.float64))


def light_from_highlight(picture: Any, circle: Circle, *, mask: Any = True) -> Float[np.ndarray, "3"]:
    """Direction towards a distant light from its reflection in a mirror ball.

    Args:
        picture: linear values, (H, W, C) or (H, W), or a `brdf.Picture`, of the mirror ball.
        circle: its outline.
        mask: (H, W), pixels that count; or True.

    Returns:
        The unit direction, 2 (N.V) N - V at the middle of the highlight.

    Raises:
        InputError: where the ball is not in the picture or shows no highlight, or not the whole of it.
    """
    from scipy.ndimage import label  # it takes long to load

    grey = _values(picture).mean(axis=-1)
    inside = (ball_normals(grey.shape, circle)[..., 2] > 0) & np.isfinite(grey) & mask
    largest = float(np.max(grey, where=inside, initial=-np.inf))
    if not largest > 0:
        raise InputError("picture", "is black on the mirror ball", "Give a picture with a highlight")
    core = inside & (grey >= CORE * largest)
    if np.count_nonzero(core) > 0.25 * np.count_nonzero(inside):
        raise InputError("picture", "has no highlight: a quarter of the ball is as bright", "Give a darker exposure")
    bright = inside & (grey >= HIGHLIGHT * largest)
    found: Any = label(bright, np.ones((3, 3)))
    patches = found[0]
    y, x = np.argwhere(patches == np.bincount(patches[core]).argmax()).mean(axis=0)
    rows, columns = np.nonzero(bright)
    near = np.hypot(columns - x, rows - y) <= HIGHLIGHT_RADIUS * circle.radius
    if np.mean(near) < IN_HIGHLIGHT:
        came = (
            f"is bright in many places: {100 * np.mean(near):.0f} % of it lie where a mirror ball's highlight would be"
        )
        raise InputError("picture", came, "Give a photograph of a mirror ball and its circle; of a matt one use --matt")
    if np.any(near & ((np.minimum(rows, columns) == 0) | (rows == grey.shape[0] - 1) | (columns == grey.shape[1] - 1))):
        raise InputError("picture", "cuts through the highlight with its edge", "Give a photograph of all of it")
    x, y = float(columns[near].mean()), float(rows[near].mean())
    across, up = (x - circle.x) / circle.radius, (circle.y - y) / circle.radius
    z = max(1 - across**2 - up**2, 0.0) ** 0.5
    return 2 * z * np.array([across, up, z]) - TO_VIEW


class ShadingLight(NamedTuple):
    """A distant light as the shading of a matt surface tells it.

    Attributes:
        direction: towards it, unit, (3,).
        strength: what a pixel that faces it shows: diffuse albedo times intensity.
        error: standard error of the direction in degrees, the root mean square of the angle to the true one, from the
            residual; it knows that what the model leaves goes together over parts of the surface, not what it does to
            the direction everywhere alike.
        unexplained: root mean square of what the model leaves over parts of the surface, relative to the strength; of
            photographs of matt balls up to 0.05.
    """

    direction: Float[np.ndarray, "3"]
    strength: float
    error: float
    unexplained: float


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
        points: what each pixel sees, the viewer being far away along z.
        saturation: linear value from which on pixels are clipped; None takes the largest code of an integer file.
        mask: (H, W), pixels that count; or True.
        ambient: whether the surface is lit from all around as well.

    Returns:
        Direction and strength, found robustly so that highlights and cast shadows do not pull.

    Raises:
        InputError: where fewer than ten pixels are lit, they do not determine a direction, or are not shaded as these
            points would be.
    """
    if saturation is None:
        saturation = getattr(picture, "saturation", None)
    elif not saturation > 0:
        raise InputError("saturation", f"must be a linear value above 0, got {saturation!r}", "Give a number")
    values = _values(picture)
    grey, top = values.mean(axis=-1), values.max(axis=-1)
    counts = np.asarray(points.mask) & np.isfinite(grey) & mask & (top < (np.inf if saturation is None else saturation))
    pixel = np.argwhere(counts)
    pixel = pixel[:: max(1, -(-len(pixel) // MOST_PIXELS))]
    row, column = pixel.T
    normal, value = np.asarray(points.normal, np.float64)[row, column].T.copy(), grey[row, column]
    unit = float(np.max(value, initial=0.0))
    lit = value > BRIGHT * unit
    if np.count_nonzero(lit) < FEWEST:
        raise InputError("picture", "has fewer than ten lit pixels on the surface", "Give a brighter picture")
    value = residual = value / unit
    numbers, cost, scale, free = np.zeros(6), 0.0, 0.0, np.array([True, True, True, ambient, False, False])
    for _ in range(100):
        before, scale = numbers, _bound(residual[lit])
        numbers, cost = _refine(numbers, free, False, scale, value[lit], normal[:, lit])
        residual = value - _shown(numbers, free, False, normal)[0]
        if np.allclose(before, numbers, rtol=0, atol=CHANGE):
            break
        lit = _reached(normal, numbers)
    found = []
    with_highlight = free | (np.arange(6) > 3)
    for mirror in (False, True):
        for n in STARTS:
            start = np.array([*numbers[:3], 0.02 * ambient, 0.1, np.log(n - LOWEST_N)])
            found.append((*_refine(start, with_highlight, mirror, scale, value[lit], normal[:, lit]), mirror))
    shiny, left, mirror = min(found, key=lambda one: one[1])
    if np.count_nonzero(lit) * np.log(max(cost, 1e-300) / max(left, 1e-300)) > 2 * RISE:
        # Lambert's law alone may have looked at pixels that the light does not reach.
        lit, free, residual = (
            _reached(normal, shiny),
            with_highlight,
            value - _shown(shiny, with_highlight, mirror, normal)[0],
        )
        scale = _bound(residual[lit])
        numbers, _ = _refine(shiny, free, mirror, scale, value[lit], normal[:, lit])
        residual = value - _shown(numbers, free, mirror, normal)[0]
    pixel -= pixel.min(axis=0)
    block = pixel // -(-(pixel.max() + 1) // BLOCKS) @ [BLOCKS, 1]
    slopes = _shown(numbers, free, mirror, normal[:, lit])[1] * free[:, None]
    error = _error(numbers[:3], residual[lit], slopes, scale, block[lit])
    if not error < GUESS:
        raise _too_little()
    length = float(np.linalg.norm(numbers[:3]))
    unexplained = _left_over_parts(np.clip(residual[lit], -scale, scale), block[lit]) / length
    if unexplained > NO_BALL:
        came = f"is not shaded like this surface: {100 * unexplained:.0f} % of the light is left unexplained"
        raise InputError(
            "picture", came, "Give a matt ball and its circle; check encoding, saturation and ambient light"
        )
    return ShadingLight(numbers[:3] / length, length * unit, error, unexplained)


def _left_over_parts(residual, block) -> float:
    """Root mean square of what residuals of one block have in common, less what their scatter makes of their mean."""
    _, index, count = np.unique(block, return_inverse=True, return_counts=True)
    mean = np.bincount(index, residual) / count
    spread = np.bincount(index, (residual - mean[index]) ** 2) / np.maximum(count - 1, 1)
    known = count > 1
    between = np.sum((count * mean**2 - spread)[known]) / max(np.sum(count[known]), 1)
    return float(np.sqrt(max(between, 0.0)))


def _too_little() -> InputError:
    return InputError("picture", "shows too little of the lit surface to tell the light", "Give its direction")


def _bound(residual) -> float:
    """Beyond which a residual's pull is constant."""
    return max(HUBER * np.median(np.abs(residual)), ROUNDING)


def _reached(normal, numbers) -> np.ndarray:
    """Pixels that the light reaches at an angle."""
    lit = numbers[:3] @ normal > LIT * np.linalg.norm(numbers[:3])
    if np.count_nonzero(lit) < FEWEST:
        raise _too_little()
    return lit


def _shown(numbers, free, mirror, normal) -> tuple[np.ndarray, np.ndarray]:
    """What pixels with these normals show, the light reaching them: ambient light, Lambert's law and a highlight.

    Args:
        numbers: the light's vector, as long as what a pixel that faces it shows; ambient light; strength of the
            highlight, either sign meaning the same, and logarithm of what its exponent has beyond the lowest.
        free: which numbers may change; without a free highlight there is none.
        mirror: whether its lobe is about the mirror direction, not the half vector.
        normal: of P pixels, (3, P).

    Returns:
        The values, and their derivatives by all numbers, (6, P).
    """
    light, (ambient, specular, log_beyond) = numbers[:3], numbers[3:]
    slopes = np.zeros((6, normal.shape[1]))
    slopes[:3], slopes[3] = normal, 1.0
    if not free[4]:
        return ambient + light @ normal, slopes
    length = max(np.linalg.norm(light), 1e-300)
    to_light = light / length
    turned = (np.eye(3) - np.outer(to_light, to_light)) / length  # derivative of to_light by the light
    if mirror:
        cosine = 2 * (to_light @ normal) * normal[2] - to_light[2]
        by_light = 2 * normal[2] * (turned @ normal) - turned[:, 2:]
    else:
        half = to_light + TO_VIEW
        size = max(np.linalg.norm(half), 1e-9)
        half /= size
        cosine = half @ normal
        by_light = (turned @ normal - np.outer(turned @ half, cosine)) / size
    beyond = np.exp(min(log_beyond, np.log(LARGEST_N)))
    cosine = np.clip(cosine, 1e-9, 1.0)
    log_cosine = np.log(cosine)
    lobe = np.exp((LOWEST_N + beyond) * log_cosine)
    slopes[:3] += (abs(specular) * (LOWEST_N + beyond) * lobe / cosine) * by_light
    slopes[4] = np.sign(specular) * lobe
    slopes[5] = abs(specular) * beyond * lobe * log_cosine
    return ambient + light @ normal + abs(specular) * lobe, slopes


def _refine(numbers, free, mirror, scale, value, normal) -> tuple[np.ndarray, float]:
    """The nearest minimum of Huber's cost over the free numbers; and the cost."""
    from scipy.optimize import minimize  # it takes long to load

    def among(some):
        every = numbers.copy()
        every[free] = some
        return every

    @functools.lru_cache(1)  # cost and curvature are asked at the same numbers
    def left(*some):
        shown, slopes = _shown(among(some), free, mirror, normal)
        return shown - value, slopes[free]

    def cost(some):
        residual, slopes = left(*some)
        pull = np.clip(residual, -scale, scale)
        return np.mean(pull * (residual - 0.5 * pull)), slopes @ pull / len(value)

    def curvature(some):
        residual, slopes = left(*some)
        weight = scale / np.maximum(np.abs(residual), scale)
        return (slopes * weight) @ slopes.T / len(value)

    how: Any = {"method": "trust-exact", "jac": True, "hess": curvature, "options": {"gtol": CLOSE, "maxiter": 50}}
    found = minimize(cost, numbers[free], **how)
    return among(found.x), found.fun


def _error(light, residual, slopes, scale, block) -> float:
    """Root mean square angle to the true direction in degrees, where residuals of one block go together as they like.

    The jackknife over blocks: how far leaving one out moves the light, by one Newton step. A pixel pulls with its
    residual up to Huber's bound, and with the bound beyond; the derivative of that is 1 and 0.

    Source: Huber 1981, section 7.6; Bell and McCaffrey 2002.
    """
    length = np.maximum(np.linalg.norm(slopes, axis=1), 1e-300)
    columns, pull, within = slopes.T / length, np.clip(residual, -scale, scale), np.abs(residual) <= scale
    order = np.argsort(block, kind="stable")
    first = np.flatnonzero(np.diff(block[order], prepend=-1))

    def over_blocks(values):
        return np.add.reduceat(values[order], first)

    near = columns * within[:, None]
    gram = over_blocks(near[:, :, None] * near[:, None])
    # Those of all but one as sums: of a single block that is 0, and a difference would be rounding.
    nothing = np.zeros((1, 6, 6))
    before, after = (np.cumsum(np.concatenate([nothing, one]), axis=0) for one in (gram[:-1], gram[:0:-1]))
    hessian = before + after[::-1]
    inverse = np.linalg.pinv(hessian, 1e-9, hermitian=True)
    # A highlight may lie in one block; without it the others still tell the light, or they do not.
    if not np.allclose((inverse @ hessian)[:, :3], np.eye(6)[:3], rtol=0, atol=1e-3):
        return np.inf
    moved = (inverse @ over_blocks(columns * pull[:, None])[..., None])[:, :3, 0] / length[:3]
    size = np.linalg.norm(light)
    across = np.sum(moved**2) - np.sum((moved @ light / size) ** 2)
    return float(np.degrees(np.sqrt((1 - 1 / len(moved)) * across) / size))
