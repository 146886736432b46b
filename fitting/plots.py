"""Pictures of a fit, for print: colour-blind-safe, linear values shown through the sRGB encoding."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from fitting.result import FitResult


def display(linear: Float[np.ndarray, "H W C"], white: float) -> Float[np.ndarray, "H W 3"]:
    """Values for a screen: one or three channels through the sRGB encoding (IEC 61966-2-1), the rest as their mean.

    Args:
        linear: radiance.
        white: the radiance that is shown as white.
    """
    if linear.shape[-1] != 3:
        linear = np.repeat(linear.mean(axis=-1, keepdims=True), 3, axis=-1)
    value = np.clip(np.nan_to_num(linear) / white, 0, 1)
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)


def comparison(result: FitResult, picture: int = 0) -> Figure:
    """Target, fit and signed residual, the pixels left out in grey.

    Args:
        result: of a fit.
        picture: which of its pictures.
    """
    target, fitted = np.asarray(result.targets[picture]), result.fitted(picture)
    counted = result.counted[picture]
    values = target[counted]
    white = float(np.quantile(values, 0.999)) if values.size else 1.0
    residual = np.where(counted, (fitted - target).mean(axis=-1), np.nan)
    limit = max(float(np.nanquantile(np.abs(residual), 0.995)), 1e-12)
    figure = Figure(figsize=(10.5, 3.6), layout="constrained")
    axes: Any = figure.subplots(1, 3)
    axes[0].imshow(display(target, white))
    axes[0].set_title("target")
    axes[1].imshow(display(fitted, white))
    axes[1].set_title(f"fit, {result.material.name}")
    axes[2].set_facecolor("0.8")
    image = axes[2].imshow(residual, cmap="PuOr_r", vmin=-limit, vmax=limit)
    axes[2].set_title("fit − target, mean of channels")
    figure.colorbar(image, ax=axes[2], label="radiance")
    for axis in axes:
        axis.set_xticks([])
        axis.set_yticks([])
    return figure
