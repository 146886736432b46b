"""Basis images and pictures: image = k_a B_a + k_d B_d + k_s B_s(n).

A picture is linear in k_a, k_d, k_s and in the light, so rendering, fitting and relighting all read the same basis
images. This is the one pass over light samples that makes them. What a scene lacks is not compiled: without ambient
light, lights or a specular term there is no arithmetic for it.
"""

from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from brdf.errors import InputError
from brdf.lights import Light, LightSample
from brdf.models import Material, SpecularMaterial
from brdf.precision import Precision, cast, working_precision
from brdf.scene import Scene, SurfacePoints
from brdf.vectors import BELOW_HORIZON, dot

STORED_SAMPLES = 4
"""Up to so many light samples the fit keeps their terms as arrays; beyond, it makes them anew at each exponent."""

NO_LOBE = -1e9
"""The peak of a pixel without a lobe: exp(n * this) = 0 for every n that a fit visits."""


class LightTerms(eqx.Module):
    """What one light sample adds to the basis images at one point.

    Attributes:
        diffuse: I (N·L)+, (C,).
        weight: I, times N·L where the model says so, 0 where the lobe is gated, (C,).
        log_cosine: logarithm of the lobe's cosine; 0 where the lobe is gated.
    """

    diffuse: Float[Array, "*pixels C"]
    weight: Float[Array, "*pixels C"]
    log_cosine: Float[Array, "*pixels"]


def light_terms(model: type[Material], point: SurfacePoints, sample: LightSample) -> LightTerms:
    """The terms of one light sample at one point.

    Args:
        model: the class of the material; its values are not needed.
        point: one surface point.
        sample: what the light sends there.
    """
    cosine = dot(point.normal, sample.to_light)
    lit = point.mask & (cosine > 0)
    diffuse = sample.intensity * jnp.where(lit, cosine, 0)
    if not issubclass(model, SpecularMaterial):
        return LightTerms(diffuse, jnp.zeros_like(diffuse), jnp.zeros_like(cosine))
    log_cosine = model.log_cosine(point.normal, sample.to_light, point.to_view)
    above = lit & (dot(point.normal, point.to_view) > 0) & (log_cosine > 0.5 * BELOW_HORIZON)
    factor = cosine if model.cosine_weighted else jnp.ones_like(cosine)
    weight = sample.intensity * jnp.where(above, factor, 0)
    return LightTerms(diffuse, weight, jnp.where(above, log_cosine, 0))


def _terms_of_node(model: type[Material], points: SurfacePoints, light: Light, node: Any) -> LightTerms:
    def at_point(point: SurfacePoints) -> LightTerms:
        return light_terms(model, point, light.illuminate(node, point.position))

    return jax.vmap(at_point)(points)


def _each_node(model: type[Material], points: SurfacePoints, lights: tuple[Light, ...]) -> Iterator[LightTerms]:
    for light in lights:
        nodes = light.nodes()
        for index in range(sample_count(light)):
            yield _terms_of_node(model, points, light, jax.tree.map(lambda leaf, i=index: leaf[i], nodes))


def sample_count(light: Light) -> int:
    """The number of samples of a light.

    Args:
        light: any light.
    """
    nodes = jax.eval_shape(light.nodes)
    return jax.tree.leaves(nodes)[0].shape[0]


def _power(weight: Array, log_cosine: Array, n: Array) -> tuple[Array, Array]:
    value = weight * jnp.exp(jnp.asarray(n, log_cosine.dtype) * log_cosine)[:, None]
    return value, value * log_cosine[:, None]


def _peak(weight: Array, log_cosine: Array) -> Array:
    return jnp.where(jnp.max(weight, axis=-1) > 0, log_cosine, NO_LOBE)


class StoredLobe(eqx.Module):
    """The specular basis of few light samples, kept as arrays: each evaluation costs an exponential per sample.

    Attributes:
        weights: of each sample, (P, C).
        log_cosines: of each sample, (P,).
    """

    weights: tuple[Float[Array, "P C"], ...]
    log_cosines: tuple[Float[Array, " P"], ...]

    def __call__(self, n: Float[Array, ""]) -> tuple[Float[Array, "P C"], Float[Array, "P C"]]:
        """The basis image without the model's scale, and its derivative in n.

        Args:
            n: the exponent.
        """
        value, slope = _power(self.weights[0], self.log_cosines[0], n)
        for weight, log_cosine in zip(self.weights[1:], self.log_cosines[1:], strict=True):
            more = _power(weight, log_cosine, n)
            value, slope = value + more[0], slope + more[1]
        return value, slope

    def peak(self) -> Float[Array, " P"]:
        """The largest logarithm of the lobe's cosine over the samples, `NO_LOBE` where no sample has one."""
        peaks = [_peak(*sample) for sample in zip(self.weights, self.log_cosines, strict=True)]
        return jnp.max(jnp.stack(peaks), axis=0)

    def pixels(self, choose: Callable[[Array], Array]) -> "StoredLobe":
        """The same for some of the pixels.

        Args:
            choose: applied to each array whose first axis is the pixels.
        """
        return jax.tree.map(choose, self)


class StreamedLobe(eqx.Module):
    """The specular basis of many light samples, made anew at each evaluation in bounded memory.

    Attributes:
        points: (P,) surface points.
        lights: the lights.
        model: the class of the material.
    """

    points: SurfacePoints
    lights: tuple[Light, ...]
    model: type[Material] = eqx.field(static=True)

    def __call__(self, n: Float[Array, ""]) -> tuple[Float[Array, "P C"], Float[Array, "P C"]]:
        """The basis image without the model's scale, and its derivative in n.

        Args:
            n: the exponent.
        """

        def of_terms(terms: LightTerms) -> tuple[Array, Array]:
            return _power(terms.weight, terms.log_cosine, n)

        return sum_over_samples(self.model, self.points, self.lights, of_terms)

    def peak(self) -> Float[Array, " P"]:
        """The largest logarithm of the lobe's cosine over the samples, `NO_LOBE` where no sample has one."""

        def of_terms(terms: LightTerms) -> Array:
            return _peak(terms.weight, terms.log_cosine)

        return sum_over_samples(self.model, self.points, self.lights, of_terms, combine=jnp.maximum, start=NO_LOBE)

    def pixels(self, choose: Callable[[Array], Array]) -> "StreamedLobe":
        """The same for some of the pixels.

        Args:
            choose: applied to each array whose first axis is the pixels.
        """
        return StreamedLobe(jax.tree.map(choose, self.points), self.lights, self.model)


Lobe = StoredLobe | StreamedLobe


def sum_over_samples(
    model: type[Material],
    points: SurfacePoints,
    lights: tuple[Light, ...],
    of_terms: Any,
    *,
    combine: Any = jnp.add,
    start: float = 0.0,
) -> Any:
    """Combine a function of the light terms over all samples, never holding more than one sample's images.

    Args:
        model: the class of the material.
        points: (P,) surface points.
        lights: the lights.
        of_terms: from the `LightTerms` of one sample to a pytree of (P, ...) arrays.
        combine: how two values become one.
        start: what `combine` starts from.
    """
    total = None
    for light in lights:
        nodes = light.nodes()
        first = jax.tree.map(lambda leaf: leaf[0], nodes)

        def of_node(node: Any, light: Light = light) -> Any:
            return of_terms(_terms_of_node(model, points, light, node))

        if sample_count(light) == 1:
            value = of_node(first)
            total = value if total is None else jax.tree.map(combine, total, value)
            continue
        if total is None:
            total = jax.tree.map(lambda leaf: jnp.full(leaf.shape, start, leaf.dtype), jax.eval_shape(of_node, first))
        step = jax.checkpoint(lambda carry, node: (jax.tree.map(combine, carry, of_node(node)), None))
        total, _ = jax.lax.scan(step, total, nodes)
    return total


class Basis(eqx.Module):
    """What the pixels show before any material: flat over the picture's pixels, row by row.

    Attributes:
        points: (P,) surface points.
        ambient: intensity of the ambient light, (C,), or None.
        diffuse: sum of I (N·L)+, (P, C); None without lights.
        lobe: the specular basis as a function of n; None without lights or for a model without a specular term.
    """

    points: SurfacePoints
    ambient: Float[Array, " C"] | None
    diffuse: Float[Array, "P C"] | None
    lobe: Lobe | None


def _flat(points: SurfacePoints) -> SurfacePoints:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf).reshape(-1, *leaf.shape[2:]), points)


def basis(model: type[Material], scene: Scene, *, points: SurfacePoints | None = None) -> Basis:
    """The basis images of a scene under a model, to be evaluated at any n.

    Args:
        model: the class of the material.
        scene: what is seen, and the light on it.
        points: what the pixels see, where that is known already.
    """
    points = scene.surface_points() if points is None else points
    return _basis(model, points, scene.ambient, scene.lights)


@eqx.filter_jit
def _basis(model: type[Material], points: SurfacePoints, ambient: Any, lights: tuple[Light, ...]) -> Basis:
    points = _flat(points)
    if not lights:
        return Basis(points, ambient, None, None)
    specular = issubclass(model, SpecularMaterial)
    if sum(map(sample_count, lights)) <= STORED_SAMPLES:
        terms = list(_each_node(model, points, lights))
        diffuse = sum((term.diffuse for term in terms[1:]), start=terms[0].diffuse)
        lobe = StoredLobe(tuple(t.weight for t in terms), tuple(t.log_cosine for t in terms))
        return Basis(points, ambient, diffuse, lobe if specular else None)
    diffuse = sum_over_samples(model, points, lights, lambda terms: terms.diffuse)
    return Basis(points, ambient, diffuse, StreamedLobe(points, lights, model) if specular else None)


class BasisImages(eqx.Module):
    """The three images that a picture is a linear combination of; None where the scene or the model lacks one.

    Attributes:
        ambient: (H, W, C), I_a where the pixel sees a fitted surface.
        diffuse: (H, W, C), the sum of I (N·L)+.
        specular: (H, W, C), the sum of I S(n).
    """

    ambient: Float[Array, "H W C"] | None
    diffuse: Float[Array, "H W C"] | None
    specular: Float[Array, "H W C"] | None


def basis_images(
    model: type[Material], scene: Scene, n: Float[ArrayLike, ""] = 1.0, *, points: SurfacePoints | None = None
) -> BasisImages:
    """The basis images of a scene under a model, all in one pass over the light samples.

    Args:
        model: the class of the material.
        scene: what is seen, and the light on it.
        n: the exponent; a model without a specular term does not look at it.
        points: what the pixels see, where that is known already.
    """
    points = scene.surface_points() if points is None else points
    return _basis_images(model, points, scene.ambient, scene.lights, jnp.asarray(n))


@eqx.filter_jit
def _basis_images(
    model: type[Material],
    points: SurfacePoints,
    ambient: Float[Array, " C"] | None,
    lights: tuple[Light, ...],
    n: Float[Array, ""],
) -> BasisImages:
    shape = points.mask.shape

    def picture(flat: Float[Array, "P C"] | None) -> Float[Array, "H W C"] | None:
        return None if flat is None else flat.reshape(*shape, -1)

    def of_terms(terms: LightTerms) -> tuple[Array, Array | None]:
        if not issubclass(model, SpecularMaterial):
            return terms.diffuse, None
        return terms.diffuse, terms.weight * (model.scale(n) * jnp.exp(n * terms.log_cosine))[:, None]

    ambient = None if ambient is None else jnp.where(points.mask[..., None], ambient, 0)
    diffuse, specular = sum_over_samples(model, _flat(points), lights, of_terms) if lights else (None, None)
    return BasisImages(ambient, picture(diffuse), picture(specular))


def combine(material: Material, images: BasisImages) -> Float[Array, "H W C"] | None:
    """The picture k_a B_a + k_d B_d + k_s B_s; None where there is no light at all.

    Args:
        material: the coefficients.
        images: the basis images for its model and exponent.
    """
    terms = [(material.k_a, images.ambient), (material.k_d, images.diffuse)]
    if isinstance(material, SpecularMaterial):
        terms.append((material.k_s, images.specular))
    pictures = [k * image for k, image in terms if image is not None]
    return sum(pictures[1:], start=pictures[0]) if pictures else None


@eqx.filter_jit
def _shade(material: Material, points: SurfacePoints, ambient: Any, lights: tuple[Light, ...]) -> Any:
    n = material.n if isinstance(material, SpecularMaterial) else jnp.ones(())
    return combine(material, _basis_images(type(material), points, ambient, lights, jnp.asarray(n)))


def render(material: Material, scene: Scene, *, precision: Precision | None = None) -> Float[Array, "H W C"]:
    """The picture of a material in a scene: jitted, differentiable in every leaf of both.

    Pixels that see no fitted surface are 0.

    Args:
        material: with as many channels as the light, or one of the two with 1.
        scene: what is seen, and the light on it.
        precision: "float32" or "float64", whatever JAX's global setting; None keeps that setting. Inside a
            transformation (`jax.grad`, `jax.jit`) the transformation's setting holds, so leave it None there.

    Returns:
        Linear radiance, (H, W, C).

    Raises:
        InputError: where material and light differ in their channels.
    """
    counts = {scene.channels, material.k_d.shape[0]} - {1}
    if len(counts) > 1:
        came = f"has {material.k_d.shape[0]} channels, the light has {scene.channels}"
        raise InputError("material", came, "Give both the same number, or one of them a single channel")
    with working_precision(precision):
        material, scene = cast((material, scene), precision)
        image = _shade(material, scene.surface_points(), scene.ambient, scene.lights)
        width, height = scene.resolution
        channels = max(scene.channels, material.k_d.shape[0])
        return jnp.zeros((height, width, channels)) if image is None else image
