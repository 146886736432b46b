"""Inputs that are probably something else than they are given as: codes, sRGB, radians, a constant, noise."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import jax.numpy as jnp
import numpy as np

import brdf
from brdf.images.encoding import decode, encode
from fitting.model_fit import ModelFit
from fitting.pixels import FLAT, Observed
from fitting.solver.normal_equations import Picture
from fitting.uncertainty.structure import CHANCE, SIZES, Errors, over_blocks, shared

# Diffuse reflection of this size is none: light of intensity 1 that is pi, or one at twice its distance, stays below.
FAR_ABOVE = 10.0
# Decoded values are what was meant where the model leaves less than this share of the squares; or this share, and of
# that nothing that errs together.
CLEARLY, LESS = 0.25, 0.9
# Degrees that are as likely radians, where a fit leaves more than this share of the picture.
RADIANS, BADLY = 2.1, 0.05
# A picture of noise: the fit leaves this share of what varies, and that is much.
NOISE, MUCH = 0.95, 0.2
# So many pixels tell of most pictures that they are neither one value nor whole numbers.
FEW = 64


def doubts(
    fit: ModelFit, material: brdf.Material, observed: Observed, refit: Callable[..., ModelFit], *, structure: bool
) -> Iterator[str]:
    """Warnings, each with the remedy; ``refit`` fits a model to what was seen."""
    floats = [one for one in observed.problem.targets if one.file is None and not one.streamed]
    brightest = float(np.max(observed.brightest))
    if floats and 2 < brightest <= 65535 and _all(observed, lambda values: values == np.rint(values)):
        yield (
            f"the picture holds whole numbers up to {brightest:g}: if they are codes of a file, give them as uint8 or "
            'uint16, with encoding="srgb" where they are for a screen'
        )
    elif np.max(material.k_d) > FAR_ABOVE:
        yield (
            f"k_d is {np.max(material.k_d):.3g}, and a surface reflects no more than 1: are the picture and the "
            "light's intensity in one unit? Values of 0 to 255 want dividing by 255, dim lights their true intensity"
        )
    cameras = [scene.camera for scene in observed.scenes if isinstance(scene.camera, brdf.PerspectiveCamera)]
    narrow = [float(camera.fov) for camera in cameras if camera.fov <= RADIANS]
    if narrow and fit.residual > BADLY:
        yield (
            f"the camera's field of view is {narrow[0]:.3g} degrees, and the fit is poor: if these are radians, give "
            f"fov={np.degrees(narrow[0]):.4g}"
        )
    if _all(observed, lambda values: len(values) > 1 and values == values[0]) and _shaded(fit.pictures):
        yield (
            "the picture is the same in every pixel, under light that is not: is it the one that was meant? "
            "Numbers from it say nothing of the surface"
        )
    if fit.residual > MUCH:
        shown = [values.astype(np.float64) for values in _counted_values(observed)]
        varies = sum(len(values) * np.sum(np.var(values, axis=0)) for values in shown)
        total = sum(np.sum(values**2) for values in shown)
        if fit.residual**2 * total > NOISE * varies and not any(map(_follows_light, fit.pictures)):
            yield (
                "light and shape explain nothing of what varies in the picture, which may be noise: is it a picture of "
                "this scene, and neither mirrored nor shifted?"
            )
    plain = len(floats) == len(observed.problem.targets) and brightest <= 1
    # By shares what rounding and black have cut off of dark pixels looks like a curve.
    by_shares = observed.problem.loss in ("relative", "log")
    if structure and plain and not by_shares and _is_encoded(fit, observed, refit):
        yield (
            "the picture looks sRGB-encoded: decoded, the model explains it far better. "
            'Give encoding="srgb", or the file itself'
        )


def _all(observed: Observed, holds: Callable[[np.ndarray], np.ndarray | bool]) -> bool:
    """Whether something holds for the values of all pixels that count; a few tell at once that it does not."""
    return all(np.all(holds(values)) for most in (FEW, None) for values in _counted_values(observed, most))


def _counted_values(observed: Observed, most: int | None = None) -> Iterator[np.ndarray]:
    """Of each picture the values of pixels that count, (K, C); of no more than so many."""
    for image, counted in zip(observed.shown, observed.counted, strict=True):
        index = np.flatnonzero(counted)
        step = 1 if most is None else max(1, -(-index.size // most))
        yield np.take(image.reshape(-1, image.shape[-1]), index[::step], axis=0)


def _shaded(pictures: Sequence[Picture]) -> bool:
    """Whether light falls unevenly on what counts."""
    lights = (np.asarray(picture.diffuse)[picture.counts] for picture in pictures)
    return any(light.size and np.max(np.ptp(light, axis=0)) > FLAT * np.max(light) for light in lights)


def _follows_light(picture: Picture) -> bool:
    """Whether what counts varies with the light that falls on it, or that does not vary."""
    parts = (np.asarray(part)[picture.counts].mean(axis=1, dtype=float) for part in (picture.diffuse, picture.target))
    light, value = (part - part.mean() for part in parts)
    return bool((light @ value) ** 2 >= (1 - NOISE) * (light @ light) * (value @ value))


def _is_encoded(fit: ModelFit, observed: Observed, refit: Callable[..., ModelFit]) -> bool:
    """Whether the decoded picture is explained, or far better; compared in the values that were given.

    A highlight is allowed under both, as the wrong encoding may have hidden one.
    """
    model = brdf.BlinnPhong if observed.problem.model == "auto" and fit.model is brdf.Lambert else fit.model
    as_given, pictures, decoded = fit if model is fit.model else refit(model, observed), None, []
    for tile in observed.tiles:
        values = decode(np.clip(np.asarray(tile.target, np.float32), 0.0, None), "srgb")
        decoded.append(tile._replace(target=jnp.asarray(values, tile.target.dtype), bounds=None))
    if observed.problem.sample_errors and model is fit.model:
        # Lobes of many light samples are not made anew for a doubt.
        pairs = zip(fit.pictures, decoded, strict=True)
        pictures = [dataclasses.replace(picture, target=tile.target, bounds=None) for picture, tile in pairs]
    as_srgb, left = refit(model, observed._replace(tiles=decoded), pictures=pictures), []
    for picture, tile, width in zip(as_srgb.pictures, observed.tiles, observed.widths, strict=True):
        shown = encode(picture.predict(as_srgb.optimum.n, as_srgb.optimum.x).astype(np.float64), "srgb")
        errors = np.where(np.asarray(picture.weights) > 0, np.asarray(tile.target) - shown, 0.0)
        left.append(over_blocks(Errors(errors, np.arange(len(errors)), width), SIZES[0]))
    share = sum(np.sum(grid.squares) for grid in left) / np.sum(as_given.optimum.cost)
    together, chance = shared(left)
    return bool(share < CLEARLY or (share < LESS and together < CHANCE * chance))
