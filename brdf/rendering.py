"""Basis images and pictures: image = k_a B_a + k_d B_d + k_s B_s(n).

A picture is linear in k_a, k_d, k_s and in the light, so rendering, fitting and relighting all read the same basis
images. They come from the one pass over light samples of `brdf.light_sum`. What a scene lacks is not compiled:
without ambient light, lights, a specular term or occluders there is no arithmetic for it.
"""

import contextlib
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from brdf.errors import InputError
from brdf.geometry.surface_points import SurfacePoints
from brdf.geometry.visibility import Lighting
from brdf.light_sum import (
    STACKED_VALUES,
    STORED_SAMPLES,
    LightTerms,
    each_sample,
    light_channels,
    sample_count,
    stacked_terms,
    sum_over_samples,
)
from brdf.lobes import AveragedLobe, Lobe, StackedLobe, StoredLobe, StreamedLobe, average
from brdf.models import Material, SpecularMaterial
from brdf.precision import Precision, cast, working_precision
from brdf.scene import Scene


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
    centres = eqx.tree_at(lambda p: p.area, points, None, is_leaf=lambda leaf: leaf is None)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf).reshape(-1, *leaf.shape[2:]), centres)


def basis(model: type[Material], scene: Scene, *, points: SurfacePoints | None = None) -> Basis:
    """The basis images of a scene under a model, to be evaluated at any n.

    Args:
        model: the class of the material.
        scene: what is seen, and the light on it.
        points: what the pixels see, where that is known already.
    """
    points = scene.surface_points() if points is None else points
    return _basis(model, points, scene.ambient, scene.lighting)


@eqx.filter_jit
def _basis(model: type[Material], points: SurfacePoints, ambient: Any, lighting: Lighting) -> Basis:
    centres = _flat(points)
    if not lighting.lights:
        return Basis(centres, ambient, None, None)
    diffuse, lobe = _diffuse_and_lobe(model, centres, lighting)
    if points.area is not None:
        fine_diffuse, fine_lobe = _diffuse_and_lobe(model, _flat(points.area.points), lighting)
        diffuse = diffuse.at[points.area.pixel].set(average(points.area.weight, fine_diffuse), mode="drop")
        if lobe is not None and fine_lobe is not None:
            lobe = AveragedLobe(lobe, fine_lobe, points.area.weight, points.area.slot.ravel())
    return Basis(centres, ambient, diffuse, lobe)


def _diffuse_and_lobe(
    model: type[Material], points: SurfacePoints, lighting: Lighting
) -> tuple[Float[Array, "P C"], StoredLobe | StackedLobe | StreamedLobe | None]:
    specular = issubclass(model, SpecularMaterial)
    samples = sum(map(sample_count, lighting.lights))
    if samples <= STORED_SAMPLES:
        terms = list(each_sample(model, points, lighting))
        diffuse = sum((term.diffuse for term in terms[1:]), start=terms[0].diffuse)
        lobe = StoredLobe(tuple(t.weight for t in terms), tuple(t.log_cosine for t in terms))
        return diffuse, lobe if specular else None
    values = samples * points.mask.size * (1 + max(light_channels(light) for light in lighting.lights))
    if specular and values <= STACKED_VALUES:
        diffuse, weights, log_cosines = stacked_terms(model, points, lighting)
        return diffuse, StackedLobe(weights, log_cosines)
    diffuse = sum_over_samples(model, points, lighting, lambda terms: terms.diffuse)
    return diffuse, StreamedLobe(points, lighting, model) if specular else None


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
    return _basis_images(model, points, scene.ambient, scene.lighting, jnp.asarray(n))


@eqx.filter_jit
def _basis_images(
    model: type[Material],
    points: SurfacePoints,
    ambient: Float[Array, " C"] | None,
    lighting: Lighting,
    n: Float[Array, ""],
) -> BasisImages:
    shape, area = points.mask.shape, points.area

    def of_terms(terms: LightTerms) -> tuple[Array, Array | None]:
        if not issubclass(model, SpecularMaterial):
            return terms.diffuse, None
        return terms.diffuse, terms.weight * (model.scale(n) * jnp.exp(n * terms.log_cosine))[:, None]

    def lit(points: SurfacePoints) -> tuple[Array | None, Array | None]:
        return sum_over_samples(model, points, lighting, of_terms) if lighting.lights else (None, None)

    def averaged(centre: Array | None, fine: Array | None) -> Float[Array, "H W C"] | None:
        if centre is not None and fine is not None and area is not None:
            centre = centre.at[area.pixel].set(average(area.weight, fine), mode="drop")
        return None if centre is None else centre.reshape(*shape, -1)

    def seen(points: SurfacePoints) -> Array | None:
        return None if ambient is None else jnp.where(points.mask[:, None], ambient, 0)

    centres = _flat(points)
    images = (seen(centres), *lit(centres))
    if area is None:
        return BasisImages(*(averaged(image, None) for image in images))
    fine = _flat(area.points)
    return BasisImages(*map(averaged, images, (seen(fine), *lit(fine))))


def combine(material: Material, images: BasisImages) -> Any:
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
def shade(material: Material, points: SurfacePoints, ambient: Any, lighting: Lighting) -> Any:
    """The picture of a material at given points; None where there is no light at all.

    Args:
        material: what the points are made of.
        points: what the pixels see.
        ambient: intensity of the ambient light, (C,), or None.
        lighting: lights and occluders.
    """
    n = material.n if isinstance(material, SpecularMaterial) else jnp.ones(())
    return combine(material, _basis_images(type(material), points, ambient, lighting, jnp.asarray(n)))


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
        InputError: where material and light differ in their channels, or a coefficient is out of reach.
    """
    with working_precision(precision):
        channels = channels_of(material, scene)
        scene, points = seen(scene, precision)
        _check_reach(material, np.dtype(points.normal.dtype))
        material = cast(material, precision)
        image = shade(material, points, scene.ambient, scene.lighting)
        width, height = scene.resolution
        return jnp.zeros((height, width, channels)) if image is None else image


def _check_reach(material: Material, dtype: np.dtype) -> None:
    for name in ("k_a", "k_d", "k_s"):
        value = getattr(material, name, None)
        if isinstance(value, np.ndarray) and np.any(value > np.finfo(dtype).max):
            came = f"is out of reach of {dtype.name}, got {np.max(value):g}"
            raise InputError(name, came, "Use another unit of light, or float64")


def seen(scene: Scene, precision: Precision | None) -> tuple[Scene, SurfacePoints]:
    """A scene in a precision, and what each pixel sees.

    Args:
        scene: the scene; where pixels are averaged over their area, and nothing of it is being traced, the pixels that
            need it are found at once, also inside a transformation of the material.
        precision: "float32", "float64" or None.
    """
    samples = 1 if scene.camera is None else scene.camera.samples
    traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(scene))
    now = jax.ensure_compile_time_eval() if samples > 1 and not traced else contextlib.nullcontext()
    with now:
        scene = cast(scene, precision)
        return scene, scene.surface_points()


def channels_of(material: Material, scene: Scene) -> int:
    """The number of channels of a material's picture.

    Args:
        material: with as many channels as the light, or one of the two with 1.
        scene: with the light.

    Raises:
        InputError: where they differ.
    """
    counts = {scene.channels, material.k_d.shape[0]} - {1}
    if len(counts) > 1:
        came = f"has {material.k_d.shape[0]} channels, the light has {scene.channels}"
        raise InputError("material", came, "Give both the same number, or one of them a single channel")
    return max(scene.channels, material.k_d.shape[0])
