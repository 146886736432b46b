"""Where a distant light comes from: by its highlight on a mirror ball, or by the shading of a matt surface.

Lambert's law is linear in the light's vector, which gives the start. Where the picture shows a highlight, a lobe about
the half vector or the mirror direction is fitted with it: left to robust weights alone, a broad one pulls the light by
several degrees. Only where the light comes in at an angle is looked at, so that shadows say nothing.
"""

import contextlib
import functools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

import brdf
from brdf.errors import InputError
from fitting.photographs.ball import Circle, ball_normals
from fitting.solver.losses import LIMITING_ROUNDS, REACH

# What belongs to a highlight: its core is looked for above one share of the brightest pixel; it reaches down to half of
# the brightest, within a share of the radius around it.
CORE, HIGHLIGHT, HIGHLIGHT_RADIUS = 0.9, 0.5, 0.12
# A patch as bright, of this share of the largest's pixels, is another light's.
ALIKE = 0.25
# Lambert's law is fitted where the light's cosine exceeds this, at first on pixels above this share of the brightest.
LIT, BRIGHT = 0.15, 0.05
# A Gaussian's deviation over the median of its size; Huber's tuning constant, which keeps 95 % efficiency on it.
DEVIATION = 1.4826
HUBER = 1.345 * DEVIATION
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
# What faces away from the light, well inside the outline, is black or lit from elsewhere: by what surrounds a ball with
# up to 0.014 of the light on those photographs. Noise that is cut off at 0 has a mean of 0.4 deviations.
INSIDE, ELSEWHERE, CUT_NOISE = 0.3, 0.015, 0.4
# A light from so far behind leaves a crescent of less than three fifths of the ball's radius. On a thin one ambient
# light and a highlight can be taken for each other and for shading, and the jackknife does not see that.
BEHIND = -0.4
# The highlight of a light more than 150 degrees from the view lies on the outline's pixels, which do not count.
FAR_BEHIND, FROM_OUTLINE = -0.866, "it comes from behind: its highlight runs along the outline and can be degrees off"
TOO_LITTLE = InputError("picture", "shows too little of the lit surface to tell the light", "Give its direction")


def _values(picture: Any) -> np.ndarray:
    """Linear values, NaN where a picture is fully transparent."""
    values, opaque = np.array(getattr(picture, "pixels", picture), np.float64), getattr(picture, "opaque", None)
    if opaque is not None:
        values[~opaque] = np.nan
    return np.atleast_3d(values)


def light_from_highlight(picture: Any, circle: Circle, *, mask: Any = None) -> Float[np.ndarray, "3"]:
    """Direction towards a distant light from its reflection in a mirror ball.

    Args:
        picture: linear values, (H, W, C) or (H, W), or a `brdf.Picture`, of the mirror ball.
        circle: its outline.
        mask: (H, W), pixels that count; None for all.

    Returns:
        The unit direction, 2 (N.V) N - V, averaged over the highlight; from more than 150 degrees off the view it can
        be degrees off.

    Raises:
        InputError: where the ball is not in the picture or shows no highlight, not the whole of it, or several.
    """
    grey = _values(picture).mean(axis=-1)
    normals = ball_normals(grey.shape, circle)
    inside = (normals[..., 2] > 0) & np.isfinite(grey) & (True if mask is None else mask)
    largest = float(np.max(grey, where=inside, initial=-np.inf))
    if not largest > 0:
        raise InputError("picture", "is black on the mirror ball", "Give a picture with a highlight")
    core, bright = (inside & (grey >= share * largest) for share in (CORE, HIGHLIGHT))
    if np.count_nonzero(core) > 0.25 * np.count_nonzero(inside):
        raise InputError("picture", "has no highlight: a quarter of the ball is as bright", "Give a darker exposure")
    place = np.argwhere(bright)
    y, x = np.median(np.argwhere(core), axis=0)
    near = np.hypot(place[:, 1] - x, place[:, 0] - y) <= HIGHLIGHT_RADIUS * circle.radius
    mirrored = 2 * normals[..., 2:] * normals - TO_VIEW
    highlights = _highlights(bright, mirrored)
    if np.mean(near) < IN_HIGHLIGHT and highlights != 2:
        share = f"{100 * np.mean(near):.0f} % of it lie where a mirror ball's highlight would be"
        remedy = "Give a photograph of a mirror ball and its circle; of a matt one use --matt"
        raise InputError("picture", f"is bright in many places: {share}", remedy)
    if highlights > 1:
        remedy = "Photograph one light at a time, or leave the others out by a mask"
        raise InputError("picture", f"shows {highlights} highlights of like brightness on the mirror ball", remedy)
    place = place[near]
    if np.any((place == 0) | (place == np.array(grey.shape) - 1)):
        raise InputError("picture", "cuts through the highlight with its edge", "Give a photograph of all of it")
    # A mirror ball keeps areas, 4 / radius^2 steradians a pixel: the mean over pixels is that over directions.
    return _unit(mirrored[tuple(place.T)].mean(axis=0))[0]


def _highlights(bright, mirrored) -> int:
    """How many patches are another light's: so large, and so far from the largest in direction; and that one."""
    from scipy.ndimage import label  # it takes long to load

    labelled: Any = label(bright, np.ones((3, 3)))
    patch = labelled[0]
    size = np.bincount(patch.ravel())[1:]
    ways = [mirrored[patch == 1 + one].mean(axis=0) for one in np.flatnonzero(size >= ALIKE * size.max())]
    first = mirrored[patch == 1 + np.argmax(size)].mean(axis=0)
    return 1 + int(np.sum(np.linalg.norm(ways - first, axis=1) > 2 * HIGHLIGHT_RADIUS))


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
        elsewhere: what the side that faces away from the light shows beyond ambient light that was stated, and beyond
            noise, relative to the strength; 0 where too little of that side is seen.
    """

    direction: Float[np.ndarray, "3"]
    strength: float
    error: float
    unexplained: float
    elsewhere: float

    @property
    def stated_error(self) -> str:
        """The error, and why it may be too small."""
        doubt = ""
        if self.elsewhere > ELSEWHERE:
            share = f"{100 * self.elsewhere:.2g} % of the light"
            remedy = "state --ambient, or photograph one light at a time"
            doubt = f" (the side facing away shows {share}, lit from elsewhere too: it can be far off; {remedy})"
        elif self.direction[2] < BEHIND:
            doubt = " (it comes from behind: a highlight on the thin crescent can turn it by several times that)"
        elif self.unexplained > DOUBTFUL:
            share = f"{100 * self.unexplained:.0f} % of the light unexplained"
            doubt = f" (the shading leaves {share}: it can be off by several times that)"
        return f"± {self.error:.2g}°{doubt}"


def light_from_shading(
    picture: Any,
    points: brdf.SurfacePoints,
    *,
    saturation: float | None = None,
    mask: Any = None,
    ambient: bool = False,
) -> ShadingLight:
    """Direction of a distant light from the shading: Lambert's law and a highlight where the light comes in.

    Args:
        picture: linear values, (H, W, C) or (H, W), or a `brdf.Picture`.
        points: what each pixel sees, the viewer being far away along z.
        saturation: linear value from which on pixels are clipped; None takes the largest code of an integer file. What
            is predicted so near it that noise decides does not count either.
        mask: (H, W), pixels that count; None for all.
        ambient: whether the surface is lit from all around as well.

    Returns:
        The light.

    Raises:
        InputError: where fewer than ten pixels are lit, they do not determine a direction, or are not shaded as these
            points would be.
    """
    if saturation is None:
        saturation = getattr(picture, "saturation", None)
    elif not saturation > 0:
        raise InputError("saturation", f"must be a linear value above 0, got {saturation!r}", "Give a number")
    values = _values(picture)
    grey, level = values.mean(axis=-1), saturation or np.inf
    counts = np.asarray(points.mask) & np.isfinite(grey) & (True if mask is None else mask)
    clipped = counts & (values.max(axis=-1) >= level)
    pixel = np.argwhere(counts & ~clipped)
    pixel = pixel[:: max(1, -(-len(pixel) // MOST_PIXELS))]
    row, column = pixel.T
    normal, value = np.asarray(points.normal, np.float64)[row, column].T.copy(), grey[row, column]
    unit = float(np.max(value, initial=0.0))
    if np.count_nonzero(value > BRIGHT * unit) < FEWEST:
        raise InputError("picture", "has fewer than ten lit pixels on the surface", "Give a brighter picture")
    value = value / unit
    found = _fitted(value, normal, ambient)
    if clipped.any():
        brightest = max(values[row, column].T / unit, key=np.mean)
        within, found = _below(level / unit, brightest, value, normal, ambient, found)
        value, normal, pixel = value[within], normal[:, within], pixel[within]
    numbers, mirror, lit, scale = found
    pixel -= pixel.min(axis=0)
    block = (pixel // -(-(pixel.max() + 1) // BLOCKS) @ [BLOCKS, 1])[lit]
    shown, slopes = _shown(numbers, mirror, normal[:, lit])
    residual = value[lit] - shown
    pull, parts = np.clip(residual, -scale, scale), [block == one for one in np.unique(block)]
    error = _error(numbers[:3], slopes, pull, np.abs(residual) <= scale, parts)
    if not error < GUESS:
        raise TOO_LITTLE
    length = float(np.linalg.norm(numbers[:3]))
    unexplained = _common(pull, parts) / length
    if unexplained > NO_BALL:
        what = f"is not shaded like this surface: {100 * unexplained:.0f} % of the light is left unexplained"
        remedy = "Give a matt ball and its circle; check encoding, saturation and ambient light"
        raise InputError("picture", what, remedy)
    away = (numbers[:3] @ normal < -LIT * length) & (normal[2] > INSIDE)
    count, elsewhere = np.count_nonzero(away), 0.0
    if count >= FEWEST:
        noise = (CUT_NOISE + 3 / count**0.5) * DEVIATION * np.median(np.abs(residual))
        elsewhere = max(np.mean(value[away]) - (numbers[3] if ambient else 0.0) - noise, 0.0) / length
    return ShadingLight(numbers[:3] / length, length * unit, error, unexplained, float(elsewhere))


def _below(level, channel, value, normal, ambient, found) -> tuple[np.ndarray, tuple]:
    """Which pixels are predicted below a level of a channel, and what `_fitted` says of these.

    Of pixels near the level the ones that do not reach it are those that noise made darker.
    """
    within = np.ones(len(value), bool)
    for _ in range(LIMITING_ROUNDS):
        numbers, mirror, lit, _ = found
        shown, among = _shown(numbers, mirror, normal)[0], np.flatnonzero(within)[lit]
        shown *= np.mean(channel[among]) / np.mean(value[among])
        noise = DEVIATION * np.median(np.abs(channel - shown)[among])
        inside = shown < level - REACH * noise
        # Where few are left noise reaches from the level into the dark.
        if np.array_equal(inside, within) or np.count_nonzero(inside & (value > BRIGHT)) < FEWEST:
            break
        within, found = inside, _fitted(value[inside], normal[:, inside], ambient)
    return within, found


def _fitted(value, normal, ambient) -> tuple[np.ndarray, bool, np.ndarray, float]:
    """The numbers of `_shown`, whether the lobe is about the mirror direction, the pixels reached and Huber's bound.

    Lambert's law alone tells which pixels the light reaches, and how far they are off.
    """
    lit, residual = value > BRIGHT, value
    numbers, cost, scale, mirror = np.zeros(4 if ambient else 3), 0.0, 0.0, False
    for _ in range(100):
        before, scale = numbers, _bound(residual[lit])
        numbers, cost = _refine(numbers, mirror, scale, value[lit], normal[:, lit])
        residual = value - _shown(numbers, mirror, normal)[0]
        if np.allclose(before, numbers, rtol=0, atol=CHANGE):
            break
        lit = _reached(normal, numbers)
    found = [(numbers, cost, False)]
    for about_mirror in (False, True):
        for n in STARTS:
            start = np.array([*numbers[:3], *([0.02] if ambient else []), 0.1, np.log(n - LOWEST_N)])
            with contextlib.suppress(InputError):  # of a lobe that no pixel shows
                found.append((*_refine(start, about_mirror, scale, value[lit], normal[:, lit]), about_mirror))
    shiny, left, about_mirror = min(found, key=lambda one: one[1])
    if np.count_nonzero(lit) * np.log(max(cost, 1e-300) / max(left, 1e-300)) > 2 * RISE:
        # Lambert's law alone may have looked at pixels that the light does not reach.
        lit, mirror = _reached(normal, shiny), about_mirror
        scale = _bound((value - _shown(shiny, mirror, normal)[0])[lit])
        numbers, _ = _refine(shiny, mirror, scale, value[lit], normal[:, lit])
    return numbers, mirror, lit, scale


def _bound(residual) -> float:
    """Beyond which a residual's pull is constant."""
    return max(HUBER * np.median(np.abs(residual)), ROUNDING)


def _reached(normal, numbers) -> np.ndarray:
    """Pixels that the light reaches at an angle."""
    lit = numbers[:3] @ normal > LIT * np.linalg.norm(numbers[:3])
    if np.count_nonzero(lit) < FEWEST:
        raise TOO_LITTLE
    return lit


def _unit(vector):
    """A vector at length 1, and the derivative of that by the vector."""
    length = max(np.linalg.norm(vector), 1e-9)
    unit = vector / length
    return unit, (np.eye(3) - np.outer(unit, unit)) / length


def _shown(numbers, mirror, normal) -> tuple[np.ndarray, np.ndarray]:
    """What pixels with these normals show, the light reaching them: Lambert's law, ambient light and a highlight.

    Args:
        numbers: the light's vector, as long as what a pixel that faces it shows; of an even count ambient light; of
            more than four the strength of a highlight, either sign meaning the same, and the logarithm of what its
            exponent has beyond the lowest.
        mirror: whether its lobe is about the mirror direction, not the half vector.
        normal: of P pixels, (3, P).

    Returns:
        The values, and their derivatives by the numbers, (F, P).
    """
    light = numbers[:3]
    shown, slopes = light @ normal, normal
    if len(numbers) % 2 == 0:
        shown, slopes = shown + numbers[3], np.vstack([slopes, np.ones_like(shown)])
    if len(numbers) > 4:
        specular, log_beyond = numbers[-2:]
        axis, turns = _unit(light)
        if mirror:
            about = 2 * normal[2] * normal - TO_VIEW[:, None]  # to the light, mirrored, as the view is
        else:
            axis, again = _unit(axis + TO_VIEW)
            turns, about = again @ turns, normal
        beyond = np.exp(min(log_beyond, np.log(LARGEST_N)))
        cosine = np.clip(axis @ about, 1e-9, 1.0)
        log_cosine = np.log(cosine)
        lobe = np.exp((LOWEST_N + beyond) * log_cosine)
        by_light = abs(specular) * (LOWEST_N + beyond) * lobe / cosine * (turns.T @ about)
        slopes = np.vstack([slopes, np.sign(specular) * lobe, abs(specular) * beyond * lobe * log_cosine])
        shown, slopes[:3] = shown + abs(specular) * lobe, slopes[:3] + by_light
    return shown, slopes


def _refine(numbers, mirror, scale, value, normal) -> tuple[np.ndarray, float]:
    """The nearest minimum of Huber's cost; and the cost. An error where there is none within reach."""
    from scipy.optimize import minimize  # it takes long to load

    @functools.lru_cache(1)  # cost and curvature are asked at the same numbers
    def off(*numbers):
        shown, slopes = _shown(np.array(numbers), mirror, normal)
        return shown - value, slopes

    def cost(numbers):
        residual, slopes = off(*numbers)
        pull = np.clip(residual, -scale, scale)
        return np.mean(pull * (residual - 0.5 * pull)), slopes @ pull / len(value)

    def curvature(numbers):
        residual, slopes = off(*numbers)
        return slopes * (scale / np.maximum(np.abs(residual), scale)) @ slopes.T / len(value)

    how: Any = {"method": "trust-exact", "jac": True, "hess": curvature, "options": {"gtol": CLOSE, "maxiter": 50}}
    try:
        found = minimize(cost, numbers, **how)
    except ValueError:  # of a curvature that no pixel bends, which leads out of reach
        raise TOO_LITTLE from None
    return found.x, found.fun


def _common(residual, parts):
    """Root mean square of what residuals of one part have in common, less what their scatter makes of their mean."""
    known = [residual[part] for part in parts if np.count_nonzero(part) > 1]
    between = sum(len(one) * np.mean(one) ** 2 - np.var(one, ddof=1) for one in known) / max(sum(map(len, known)), 1)
    return max(between, 0.0) ** 0.5


def _error(light, slopes, pull, within, parts) -> float:
    """Root mean square angle to the true direction in degrees, where residuals of one part go together as they like.

    The jackknife over parts: how far leaving one out moves the light, by one Newton step. A pixel pulls with its
    residual up to Huber's bound, and with the bound beyond; the derivative of that is 1 and 0.

    Source: Huber 1981, section 7.6; Bell and McCaffrey 2002.
    """
    length = np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-300)
    slopes = slopes / length
    gram = np.stack([(slopes * within)[:, part] @ slopes[:, part].T for part in parts])
    hessian = gram.sum(axis=0) - gram
    inverse = np.linalg.pinv(hessian, 1e-9, hermitian=True)
    # A highlight may lie in one part; without it the others still tell the light, or they do not.
    if not np.allclose((inverse @ hessian)[:, :3], np.eye(len(slopes))[:3], rtol=0, atol=1e-3):
        return np.inf
    pulls = np.stack([slopes[:, part] @ pull[part] for part in parts])
    moved = (inverse @ pulls[..., None])[:, :3, 0] / length[:3, 0]
    size = np.linalg.norm(light)
    across = np.sum(moved**2) - np.sum((moved @ light / size) ** 2)
    return float(np.degrees(np.sqrt((1 - 1 / len(moved)) * across) / size))
