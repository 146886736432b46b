"""Basis images and pictures: image = k_a B_a + k_d B_d + k_s B_s(n).

A picture is linear in k_a, k_d, k_s and in the light, so rendering, fitting and relighting all read the same basis
images. They come from the one pass over light samples of `brdf.lobes`. What a scene lacks is not compiled: without
ambient light, lights, a specular term or occluders there is no arithmetic for it.
"""

import contextlib
import dataclasses
import functools
import math
import operator
from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

from brdf.checks import Scalar, instance, known
from brdf.errors import InputError, as_numbers
from brdf.geometry.rays import PrimaryRays, Sight
from brdf.geometry.surface_points import SurfacePoints
from brdf.lights.base import Lighting, stacked
from brdf.lobes import (
    NO_LOBE,
    STACKED_VALUES,
    STORED_SAMPLES,
    TILE,
    LightTerms,
    Lobe,
    Near,
    OneOf,
    averaged,
    diffuse_and_kept,
    diffuse_and_peak,
    is_sampled,
    over_samples,
    tabulated,
)
from brdf.models.base import Material, SpecularMaterial, check_model, check_single
from brdf.precision import Precision, cast, pytree, working_precision
from brdf.scene import Scene

# Of so few pixels a program takes longer to make than to run: one serves lights of more or fewer samples.
FEW_PIXELS = 4096


@pytree
class Basis:
    """What the pixels show before any material: flat over the picture's pixels, row by row.

    Attributes:
        diffuse: sum of I (N·L)+, (P, C); None without lights.
        lobe: the specular basis as a function of n; None without lights or for a model without a specular term.
    """

    diffuse: Float[Array, "P C"] | None
    lobe: Lobe | None


def basis(
    model: type[Material],
    scene: Scene,
    *,
    points: Sight | None = None,
    near: Near | None = None,
    counts: Bool[np.ndarray, " P"] | None = None,
) -> Basis:
    """The basis images of a scene under a model, to be evaluated at any n.

    Args:
        model: the class of the material.
        scene: what is seen, and the light on it.
        points: what the pixels see, where that is known already, or `Scene.sight`, which is also what None stands for.
        near: which exponents will be asked for, so that many light samples are gone through once; None for any.
        counts: which pixels will be looked at, where ``near`` is given; the others may be 0. None for all.
    """
    points = scene.sight() if points is None else points
    lighting, area = _lighting(scene, points), points.area
    if not scene.lights:
        return Basis(None, None)
    if near is not None and area is None and is_sampled(lighting):
        return Basis(*_tabulated(model, points.stored().pixels(), lighting, near, counts))
    made = []
    for seen in [points] if area is None else [dataclasses.replace(points, area=None), area.points]:
        values = seen.count * lighting.samples * (1 + lighting.channels)
        if is_sampled(lighting) and (values > STACKED_VALUES or not issubclass(model, SpecularMaterial)):
            made.append(diffuse_and_peak(OneOf((model,)), seen.stored().pixels(), lighting))
        else:
            made.append(diffuse_and_kept(OneOf.of(model), seen, lighting))
    diffuse, lobe = made[0]
    if area is not None:
        slot, (fine_diffuse, fine_lobe) = area.slot.ravel(), made[1]
        diffuse = averaged(slot, diffuse, fine_diffuse)
        if lobe is not None and fine_lobe is not None:
            peak = averaged(slot, lobe.peak, fine_lobe.peak)
            lobe = dataclasses.replace(lobe, peak=peak, fine=fine_lobe, slot=slot)
    return Basis(diffuse, lobe)


def _tabulated(
    model: type[Material], points: SurfacePoints, lighting: Lighting, near: Near, counts: np.ndarray | None
) -> tuple[Array, Lobe | None]:
    index = np.flatnonzero(points.mask if counts is None else points.mask & counts)
    # Of one size for few numbers of pixels, or each would be compiled.
    size = max(index.size, TILE >> 2)
    size = -(-size // TILE) * TILE if size > TILE else 1 << (size - 1).bit_length()
    padded = np.resize(index if index.size else np.zeros(1, int), size)
    found = tabulated(OneOf.of(model), points.pixels(padded), lighting, near)

    def spread(values: Any, outside: float = 0.0) -> Array:
        image = np.full((points.count, *values.shape[1:]), outside, values.dtype)
        image[index] = np.asarray(values)[: index.size]
        return jax.device_put(image)

    diffuse, peak, table = found
    return spread(diffuse), None if table is None else Lobe(spread(peak, NO_LOBE), table=spread(table), near=near)


def _lighting(
    scene: Scene, points: Sight, fill_above: float = math.inf, chosen: Sequence[int] | None = None
) -> Lighting:
    """Of all lights, or of some by their index."""
    index = range(len(scene.lights)) if chosen is None else chosen
    even = [place for place in index if scene.sees_whole(scene.lights[place])]
    rest = [place for place in index if place not in even]
    stacks = stacked([scene.lights[place] for place in rest], _dtype(points), fill_above, index=rest)
    sky = [jnp.asarray(scene.lights[place].emittance, _dtype(points)) for place in even]
    return Lighting(stacks, scene.occluders, functools.reduce(operator.add, sky) if sky else None)


def _dtype(points: Sight) -> np.dtype:
    return jnp.result_type(points.camera.position if isinstance(points, PrimaryRays) else points.position)


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
    model: type[Material], scene: Scene, n: Float[ArrayLike, ""] = 1.0, *, points: Sight | None = None
) -> BasisImages:
    """The basis images of a scene under a model, all in one pass over the light samples.

    Args:
        model: the class of the material.
        scene: what is seen, and the light on it.
        n: the exponent; a model without a specular term does not look at it.
        points: what the pixels see, where that is known already.

    Example:
        >>> basis = brdf.basis_images(brdf.BlinnPhong, brdf.Scene.load("scene.toml"), n=50)
        >>> basis.diffuse.shape, basis.specular.shape
        ((32, 32, 3), (32, 32, 3))
    """
    check_model(model)
    instance("scene", scene, Scene, "Write brdf.basis_images(brdf.BlinnPhong, scene)")
    points = scene.sight() if points is None else points
    lighting = _lighting(scene, points, STORED_SAMPLES if math.prod(scene.resolution) <= FEW_PIXELS else math.inf)
    lobe = OneOf.of(model) if is_sampled(lighting) else OneOf((model,))
    return _basis_images(lobe, points, scene.ambient, lighting, jnp.asarray(n))


@eqx.filter_jit
def basis_columns(material: Material, scene: Scene) -> Float[Array, "4 *pixels C"]:
    """The basis images of a material's model at its exponent, and the derivative of the last by that; 0 for none."""
    n = jnp.asarray(getattr(material, "n", 1.0))
    images, slopes = jax.jvp(partial(basis_images, type(material), scene), (n,), (jnp.ones_like(n),))
    shown = images.ambient, images.diffuse, images.specular, slopes.specular
    shape = (*scene.resolution[::-1], material.k_d.size)
    return jnp.stack([jnp.broadcast_to(0.0 if one is None else one, shape) for one in shown])


@jax.jit
def _basis_images(model: OneOf, points: Sight, ambient: Any, lighting: Lighting, n: Scalar) -> BasisImages:
    def of_terms(terms: LightTerms) -> tuple[Array, Array | None]:
        if not model.lobes:
            return terms.diffuse, None
        return terms.diffuse, terms.weight * (model.scale(n) * jnp.exp(n * terms.log_cosine))

    centres, area, made = points.in_components(), points.area, []
    for seen in (centres, *([] if area is None else [area.points.in_components()])):
        share = seen.mask if seen.share is None else seen.mask * seen.share
        ambience = None if ambient is None else seen.per_pixel(share.reshape(-1, 1) * ambient)
        dark = not lighting.stacks and lighting.sky is None
        lit = (None, None) if dark else over_samples(model, seen, lighting, of_terms)[0]
        made.append((ambience, *lit))
    images = made[0] if area is None else jax.tree.map(partial(averaged, area.slot.ravel()), *made)
    return BasisImages(*jax.tree.map(lambda image: image.reshape(*centres.mask.shape, -1), images))


@jax.jit
def _shade(material: Material, points: Sight, ambient: Any, lighting: Lighting) -> Any:
    """The picture k_a B_a + k_d B_d + k_s B_s of surface points; None where there is no light at all."""
    n = jnp.asarray(getattr(material, "n", 1.0))
    images = _basis_images(OneOf((type(material),)), points, ambient, lighting, n)
    terms = zip(("k_a", "k_d", "k_s"), (images.ambient, images.diffuse, images.specular), strict=True)
    parts = [getattr(material, name) * image for name, image in terms if image is not None]
    return functools.reduce(operator.add, parts) if parts else None


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

    Example:
        >>> brdf.render(brdf.preset("gold"), brdf.Scene.load("scene.toml")).shape
        (32, 32, 3)
    """
    with working_precision(precision):
        shape = _shape(material, scene)
        scene, points = _seen(scene, precision)
        lighting = _lighting(scene, points)
        material = cast(material, precision)
        image = _shade(material, points, scene.ambient, lighting)
        return jnp.zeros(shape) if image is None else image


def render_lights(material: Material, scene: Scene, *, precision: Precision | None = None) -> Float[Array, "L H W C"]:
    """One picture per light: their sum is the picture that `brdf.render` makes.

    Args:
        material: with as many channels as the light, or one of the two with 1.
        scene: what is seen, and the light on it.
        precision: as for `brdf.render`.

    Returns:
        Linear radiance, (L, H, W, C): a picture for each of the scene's lights in their order, and last one for the
        ambient light where the scene has any.

    Raises:
        InputError: as for `brdf.render`.

    Example:
        >>> images = brdf.render_lights(brdf.preset("gold"), brdf.Scene.load("scene.toml"))
        >>> images.shape  # the light and the ambient light
        (2, 32, 32, 3)

    Source: P. Haeberli, Synthetic lighting for photography, Grafica Obscura, 1992.
    """
    with working_precision(precision):
        shape = _shape(material, scene)
        scene, points = _seen(scene, precision)
        material = cast(material, precision)
        images = []
        for index in range(len(scene.lights)):
            own = _lighting(scene, points, chosen=[index])  # with its own mask, where masks are given
            images.append(_shade(material, points, None, own))
        if scene.ambient is not None:
            images.append(_shade(material, points, scene.ambient, Lighting(())))
        return jnp.stack([jnp.broadcast_to(image, shape) for image in images]) if images else jnp.zeros((0, *shape))


def relight(images: Float[ArrayLike, "L H W C"], factors: ArrayLike) -> Float[Array, "H W C"]:
    """The picture under other intensities and colours of the same lights, at the cost of a sum.

    Args:
        images: one per light, as `render_lights` returns them.
        factors: what multiplies each light, (L,), or each of its channels, (L, C).

    Raises:
        InputError: where these are no numbers, or the factors do not fit the pictures.

    Example:
        >>> images = brdf.render_lights(brdf.preset("gold"), brdf.Scene.load("scene.toml"))
        >>> brdf.relight(images, [0.5, 1.0]).shape  # the light halved
        (32, 32, 3)
    """
    by: Any = known("factors", factors)
    given: Any = images if isinstance(images, jax.Array | np.ndarray) else as_numbers("images", images)
    if given.ndim != 4:
        what = f"must be of shape (L, H, W, C), got {given.shape}"
        raise InputError("images", what, "Give what brdf.render_lights returns")
    lights, _, _, channels = given.shape
    fits = by.ndim in (1, 2) and by.shape[0] == lights
    if not fits or (by.ndim == 2 and channels != 1 and by.shape[1] not in (1, channels)):
        expected = f"({lights},) or ({lights}, {channels})"
        raise InputError("factors", f"must be of shape {expected}, got {by.shape}", "Give one per light")
    with working_precision("float64" if given.dtype == np.float64 else None):
        pictures = jnp.asarray(given)
        return jnp.sum(pictures * jnp.asarray(by, pictures.dtype).reshape(lights, 1, 1, -1), axis=0)


def _seen(scene: Scene, precision: Precision | None) -> tuple[Scene, Sight]:
    """A scene in a precision, and what each pixel sees.

    Where pixels are averaged over their area, and nothing of the scene is being traced, the pixels that need it are
    found at once, also inside a transformation of the material.
    """
    samples = 1 if scene.camera is None else scene.camera.samples
    traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(scene))
    # Where nothing is being traced at all, that would make a program of every constant.
    inside = samples > 1 and not traced and isinstance(jnp.zeros(()), Tracer)
    with jax.ensure_compile_time_eval() if inside else contextlib.nullcontext():
        scene = cast(scene, precision)
        return scene, scene.sight()


def _shape(material: Material, scene: Scene) -> tuple[int, int, int]:
    """Height, width and channels of a material's picture, in the working precision."""
    words = "Write brdf.render(material, scene)"
    check_single(material, words, "Write jax.vmap(lambda material: brdf.render(material, scene))(materials)")
    instance("scene", scene, Scene, words)
    own, lit = material.k_d.shape[0], scene.channels
    if own != lit and 1 not in (own, lit):
        what = f"has {own} channels, the light has {lit}"
        raise InputError("material", what, "Give both the same number, or one of them a single channel")
    dtype = jnp.result_type(float)
    for name, value in vars(material).items():
        if isinstance(value, np.ndarray) and np.any(value > np.finfo(dtype).max):
            what = f"is out of reach of {dtype.name}, got {np.max(value):g}"
            raise InputError(name, what, "Use another unit of light, or float64")
    width, height = scene.resolution
    return height, width, max(own, lit)
