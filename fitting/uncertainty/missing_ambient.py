"""Light where none of the scene's arrives: the scene has no ambient term, and the picture needs one."""

from collections.abc import Sequence

import numpy as np

from fitting.solver.normal_equations import Picture

# The dark side shows at least this share of the mean of the lit one, and so many of its own standard errors.
SHARE, DEVIATIONS = 0.02, 5.0
FEWEST_PIXELS = 30
# That many pixels of that many pictures are looked at; a mean needs no more.
MOST_PIXELS, MOST_PICTURES = 8192, 16


def missing_ambient(pictures: Sequence[Picture]) -> str:
    """What to say where pixels that no light of the scene reaches are bright.

    Args:
        pictures: as the engine sees them.

    Returns:
        A sentence; empty where the scene has ambient light, where all pixels are lit, or where the others are dark.
    """
    dark, lit = [], []
    for index in range(0, len(pictures), -(-len(pictures) // MOST_PICTURES)):
        picture = pictures[index]
        if np.any(np.asarray(picture.ambient)):
            return ""
        some = slice(None, None, -(-picture.target.shape[0] // MOST_PIXELS))
        # Through NumPy: a slice of an array on the device would be compiled.
        target, diffuse = np.asarray(picture.target)[some].astype(np.float64), np.asarray(picture.diffuse)[some]
        counted = np.all(np.isfinite(target), axis=1)
        if picture.weight is not None:
            counted &= np.asarray(picture.weight)[some].reshape(len(target), -1).min(axis=1) > 0
        reached = np.any(diffuse > 0, axis=1)
        brightness = target.mean(axis=1)
        dark.append(brightness[counted & ~reached])
        lit.append(brightness[counted & reached])
    unlit, bright = np.concatenate(dark), np.concatenate(lit)
    if min(unlit.size, bright.size) < FEWEST_PIXELS:
        return ""
    share = float(unlit.mean() / max(bright.mean(), np.finfo(float).tiny))
    error = float(unlit.std() / np.sqrt(unlit.size))
    if share < SHARE or unlit.mean() < DEVIATIONS * error:
        return ""
    return (
        f"where no light of the scene arrives the picture still shows {100 * share:.2g} % of its lit side: give the "
        "scene an [ambient] light, or a photograph --ambient, and k_a takes that up"
    )
