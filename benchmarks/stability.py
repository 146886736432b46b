"""The stability map: how far float32 is from float64, and whether every derivative is finite, over n and angle.

python -m benchmarks.stability stability.png
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from brdf.measured.table import from_angles
from brdf.models import MODELS, Material, SpecularMaterial
from fitting.report.material_plots import LIGHT, SIGNED

EXPONENTS = np.array([0.0, 1e-3, 0.1, 0.5, 1.0, 2.0, 5.0, *np.geomspace(10.0, 1e8, 15)])
ANGLES = np.array([*np.arange(0.0, 85.0, 5.0), 85.0, 87.0, 88.0, 89.0, 89.5, 89.9, 89.99, 89.999, 90.0])
OFFSETS = np.array([-6.0, -3.0, -1.5, -0.7, -0.2, 0.0, 0.2, 0.7, 1.5, 3.0, 6.0])
"""Where the view stands: lobe widths 1 / sqrt(n+1) from the mirror direction, in and across the plane of incidence."""


@dataclasses.dataclass(frozen=True)
class StabilityMap:
    """What was found for one model.

    Attributes:
        model: its name.
        exponents: n, (a,).
        angles: angle of the light in degrees, (b,).
        error: largest difference of the specular term between float32 and float64, evaluated on the same float32
            vectors and relative to the peak of the lobe, over all views, (a, b).
        finite: whether value and all first derivatives, forward and reverse, float32 and float64, were finite, (a, b).
    """

    model: str
    exponents: Float[np.ndarray, " a"]
    angles: Float[np.ndarray, " b"]
    error: Float[np.ndarray, "a b"]
    finite: Bool[np.ndarray, "a b"]


def stability_map(
    model: type[Material], exponents: Float[np.ndarray, " a"] = EXPONENTS, angles: Float[np.ndarray, " b"] = ANGLES
) -> StabilityMap:
    """Compare float32 with float64 and try all derivatives, over exponent and angle of the light.

    Args:
        model: one of the five models.
        exponents: n, at least 0, (a,).
        angles: angle of the light in degrees, 0 to 90, (b,).

    Returns:
        The map.
    """

    def value(n: Array, vectors: Float[Array, "3 3"]) -> Array:
        """The specular term, then f_r."""
        material = model(k_d=0.5, k_s=0.5, n=n) if issubclass(model, SpecularMaterial) else model(k_d=0.5)
        return jnp.append(material.specular(*vectors), material.reflectance(vectors[1], vectors[2]))

    grid = np.meshgrid(exponents, np.radians(angles), OFFSETS, [False, True], indexing="ij")
    n, angle, offset, across = (x.ravel() for x in grid)
    vectors = _vectors(angle, offset / np.sqrt(n + 1.0), across[:, None])
    terms, finite = [], np.ones(len(n), bool)
    for x64 in (False, True):
        with jax.enable_x64(x64):
            arguments = [jnp.asarray(x, jnp.result_type(float)) for x in (n, vectors)]
            functions = value, jax.jacfwd(value, (0, 1)), jax.jacrev(value, (0, 1))
            outcomes = [jax.jit(jax.vmap(function))(*arguments) for function in functions]
        for leaf in jax.tree.leaves(outcomes):
            finite &= np.isfinite(np.asarray(leaf)).reshape(len(n), -1).all(axis=1)
        terms.append(np.asarray(outcomes[0], np.float64)[:, 0])
    peak = np.maximum(model.scale(n), 1.0) if issubclass(model, SpecularMaterial) else 1.0
    shape = len(exponents), len(angles), -1
    error = np.nan_to_num(np.abs(terms[0] - terms[1]) / peak, nan=np.inf).reshape(shape).max(axis=2)
    return StabilityMap(model.name, exponents, angles, error, np.all(finite.reshape(shape), axis=2))


def _vectors(theta: np.ndarray, tilt: np.ndarray, across: np.ndarray) -> Float[np.ndarray, "m 3 3"]:
    """Normal, light and view, rounded to float32; the view tilts from the mirror direction, in or across the plane."""
    light, tilt = from_angles(theta, 0.0), tilt[:, None]
    sideways = np.where(across, [0.0, 1.0, 0.0], from_angles(-theta - 0.5 * np.pi, 0.0))
    view = np.cos(tilt) * light * [-1.0, 1.0, 1.0] + np.sin(tilt) * sideways
    return np.stack([np.broadcast_to([0.0, 0.0, 1.0], light.shape), light, view], axis=1).astype(np.float32)


def plot_stability(maps: list[StabilityMap]) -> Figure:
    """Error of float32 over exponent and angle, a panel for each model; a cross where a derivative is not finite.

    Args:
        maps: from `stability_map`, one a model.

    Returns:
        The figure.

    """
    figure = Figure(figsize=(3.0 * len(maps) + 1, 3.4), layout="constrained")
    panels = figure.subplots(1, len(maps), sharey=True, squeeze=False)[0]
    scale = LogNorm(1e-8, 1e-4)
    for axes, found in zip(panels, maps, strict=True):
        axes.pcolormesh(np.clip(found.error, 1e-8, None), norm=scale, cmap=SIGNED)
        row, column = np.nonzero(~found.finite)
        axes.plot(column + 0.5, row + 0.5, "rx")
        axes.set_xticks(np.arange(len(found.angles))[::6] + 0.5, [f"{angle:g}" for angle in found.angles[::6]])
        axes.set_yticks(np.arange(len(found.exponents))[::3] + 0.5, [f"{n:.3g}" for n in found.exponents[::3]])
        said = f"{len(row)} not finite" if len(row) else "all derivatives finite"
        axes.set_title(f"{found.model}\n{said}", fontsize=10)
        axes.set_xlabel(LIGHT)
    panels[0].set_ylabel("exponent n")
    colours = ScalarMappable(scale, SIGNED)
    figure.colorbar(colours, ax=list(panels), label="error of float32, of the peak", extend="both")
    return figure


def main(path: Path) -> None:
    """Draw the maps of all models.

    Args:
        path: the picture to write.
    """
    maps = [stability_map(model) for model in MODELS.values()]
    for one in maps:
        broken = np.count_nonzero(~one.finite)
        print(f"{one.model:<24} largest error {one.error.max():.1e} of the peak, {broken} not finite")
    plot_stability(maps).savefig(path, dpi=120)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path", type=Path, nargs="?", default=Path("stability.png"))
    main(parser.parse_args().path)
