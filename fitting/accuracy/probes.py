"""What the estimate of a fit's error needs of its pixels, compiled: columns of the linear system, products, scores."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

import brdf
from fitting.engine.pictures import AnyArray


class Probe(NamedTuple):
    """Sums over some pixels of one picture.

    Attributes:
        gram: (C, 4, 4), of ambient, diffuse, lobe and the lobe's derivative by log n.
        step: (C, 4), products with the residual.
        scores: (M, C, 4), those products pixel by pixel.
    """

    gram: Float[Array, "C 4 4"]
    step: Float[Array, "C 4"]
    scores: Float[Array, "M C 4"]


def _columns(
    model: type[brdf.Material], scene: brdf.Scene, n: Any, shape: tuple[int, int]
) -> tuple[Float[Array, "M C 4"], Any]:
    """Ambient, diffuse, lobe and its derivative by log n, for each channel; and which pixels see the object."""
    basis = brdf.basis(model, scene)
    ambient = jnp.zeros(1) if scene.ambient is None else jnp.asarray(scene.ambient)
    columns = [jnp.broadcast_to(ambient, shape)]
    columns.append(jnp.zeros(shape) if basis.diffuse is None else jnp.broadcast_to(basis.diffuse, shape))
    if basis.lobe is None:
        columns += [jnp.zeros(shape)] * 2
    else:
        value, slope = basis.lobe(n)
        columns += [jnp.broadcast_to(value, shape), jnp.broadcast_to(slope * n, shape)]
    return jnp.stack(columns, axis=-1), basis.points.mask


def _direct_probe(
    model: type[brdf.Material],
    scene: brdf.Scene,
    pixel: Int[AnyArray, " M"] | None,
    target: Float[AnyArray, "M C"],
    weight: Float[AnyArray, " M"],
    n: Float[AnyArray, ""],
    x: Float[AnyArray, "3 C"],
) -> Probe:
    scene = scene if pixel is None else brdf.some_pixels(scene, pixel, precision="float64")
    count, channels = target.shape
    columns, seen = _columns(model, scene, n, (count, channels))
    counted = seen & (weight > 0)
    weight = jnp.where(counted, weight, 0)
    residual = jnp.where(counted[:, None], target - jnp.einsum("mck,kc->mc", columns[..., :3], x), 0)
    scores = columns * (weight[:, None] * residual)[..., None]
    gram = jnp.einsum("m,mci,mcj->cij", weight, columns, columns)
    return Probe(gram, jnp.sum(scores, axis=0), scores)


probe: Any = eqx.filter_jit(_direct_probe)


@eqx.filter_jit
def difference(
    model: type[brdf.Material],
    coarse: brdf.Scene,
    fine: brdf.Scene,
    pixel: Int[AnyArray, " M"] | None,
    weight: Float[AnyArray, " M"],
    n: Float[AnyArray, ""],
    x: Float[AnyArray, "3 C"],
) -> Float[Array, "C 4"]:
    """Products of the columns with what a finer model changes.

    Args:
        model: the class of the material.
        coarse: the whole picture's scene, or that of some pixels.
        fine: the same under more light samples.
        pixel: which pixels of the whole picture, or None.
        weight: of each pixel.
        n: exponent.
        x: coefficients.
    """
    if pixel is not None:
        coarse, fine = (brdf.some_pixels(scene, pixel, precision="float64") for scene in (coarse, fine))
    shape = (weight.size, x.shape[1])
    (few, seen), (many, _) = _columns(model, coarse, n, shape), _columns(model, fine, n, shape)
    weight = jnp.where(seen, weight, 0)
    change = jnp.einsum("mck,kc->mc", (many - few)[..., :3], x)
    # A coarser model gives more of what it lacks, hence the sign.
    return -jnp.einsum("m,mci,mc->ci", weight, few, change)


@eqx.filter_jit
def columns_in(
    model: type[brdf.Material], scene: brdf.Scene, pixel: Any, n: Any, shape: tuple[int, int], precision: brdf.Precision
) -> tuple[Float[Array, "M C 4"], Any]:
    """The columns, and which pixels see the object, compiled.

    Args:
        model: the class of the material.
        scene: the whole picture's, or that of some pixels.
        pixel: which pixels of the whole picture, or None.
        n: exponent.
        shape: how many pixels and channels.
        precision: in which the pixels are traced.
    """
    scene = scene if pixel is None else brdf.some_pixels(scene, pixel, precision=precision)
    return _columns(model, scene, n, shape)
