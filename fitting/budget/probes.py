"""What the estimate of a fit's error needs of its pixels, compiled: columns of the linear system, products, scores."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

import brdf
from brdf.precision import Precision
from brdf.rendering import basis
from fitting.solver.normal_equations import AnyArray


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
    images = basis(model, scene)
    ambient = jnp.zeros(1) if scene.ambient is None else jnp.asarray(scene.ambient)
    columns = [jnp.broadcast_to(ambient, shape)]
    columns.append(jnp.zeros(shape) if images.diffuse is None else jnp.broadcast_to(images.diffuse, shape))
    if images.lobe is None:
        columns += [jnp.zeros(shape)] * 2
    else:
        value, slope = images.lobe(n)
        columns += [jnp.broadcast_to(value, shape), jnp.broadcast_to(slope * n, shape)]
    return jnp.stack(columns, axis=-1), images.points.mask


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
def shadow_changes(
    model: type[brdf.Material],
    scene: brdf.Scene,
    pixel: Int[AnyArray, " M"] | None,
    lift: float,
    weight: Float[AnyArray, " M"],
    n: Float[AnyArray, ""],
    x: Float[AnyArray, "3 C"],
) -> Float[Array, "M C 4"]:
    """Products of the columns with what changes where a surface point that is lifted crosses a shadow's edge.

    Args:
        model: the class of the material.
        scene: the whole picture's, or that of some pixels.
        pixel: which pixels of the whole picture, or None.
        lift: along the normal, over the coordinates of the point or the extent of what shadows it.
        weight: of each pixel.
        n: exponent.
        x: coefficients.
    """
    scene = scene if pixel is None else brdf.some_pixels(scene, pixel, precision="float64")
    points = scene.surface_points()
    extent = jnp.stack([shape.extent() for shape in scene.shapes])
    others = jnp.broadcast_to(extent, (*points.mask.shape, extent.size))
    if points.shape is not None:
        others = jnp.where(points.shape[..., None] == jnp.arange(extent.size), 0.0, others)
    size = jnp.maximum(jnp.max(jnp.abs(points.position), axis=-1), jnp.max(others, axis=-1))
    position = points.position + (lift * size)[..., None] * points.normal
    lifted = dataclasses.replace(scene, points=dataclasses.replace(points, position=position))
    shape = (weight.size, x.shape[1])
    (before, seen), (after, _) = _columns(model, scene, n, shape), _columns(model, lifted, n, shape)
    change = jnp.einsum("mck,kc->mc", (after - before)[..., :3], x)
    counts = jnp.where(seen & crossed(before, after), weight, 0)
    return -jnp.einsum("m,mci,mc->mci", counts, before, change)


def crossed(before: Any, after: Any) -> Any:
    """Which pixels a shadow's edge has passed, told by the diffuse column, (M,).

    Args:
        before: columns, (M, C, 4).
        after: the same with something moved a little.
    """
    before, after = before[..., 1], after[..., 1]
    brightest = jnp.max(jnp.abs(before))
    jump = jnp.abs(after - before) > 0.1 * jnp.maximum(jnp.abs(before), jnp.abs(after)) + 1e-3 * brightest
    return jnp.any(jump, axis=1)


@eqx.filter_jit
def columns_in(
    model: type[brdf.Material], scene: brdf.Scene, pixel: Any, n: Any, shape: tuple[int, int], precision: Precision
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
