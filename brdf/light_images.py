"""One picture per light, and any recolouring of the lights from those: light is linear.

Source: P. Haeberli, Synthetic lighting for photography, Grafica Obscura, 1992.
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from brdf.errors import InputError
from brdf.geometry.surface_points import SurfacePoints
from brdf.geometry.visibility import Lighting
from brdf.models import Material
from brdf.precision import Precision, cast, working_precision
from brdf.rendering import channels_of, seen, shade
from brdf.scene import Scene


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
        InputError: where material and light differ in their channels.
    """
    with working_precision(precision):
        channels = channels_of(material, scene)
        scene, points = seen(scene, precision)
        material = cast(material, precision)
        lighting, images = scene.lighting, []
        for index, light in enumerate(lighting.lights):
            # the light's own mask comes first where masks are given
            mine = points if points.visibility is None else _with_mask(points, index)
            images.append(shade(material, mine, None, Lighting((light,), lighting.occluders)))
        if scene.ambient is not None:
            images.append(shade(material, points, scene.ambient, Lighting(())))
        width, height = scene.resolution
        shape = (height, width, channels)
        return jnp.stack([jnp.broadcast_to(image, shape) for image in images]) if images else jnp.zeros((0, *shape))


def _with_mask(points: SurfacePoints, index: int) -> SurfacePoints:
    """The points with the given mask of one light only."""
    masks, area = points.visibility, points.area
    assert masks is not None
    if area is not None:
        area = dataclasses.replace(area, points=_with_mask(area.points, index))
    return dataclasses.replace(points, visibility=(masks[index],), area=area)


def relight(images: Float[ArrayLike, "L H W C"], factors: ArrayLike) -> Float[Array, "H W C"]:
    """The picture under other intensities and colours of the same lights, at the cost of a sum.

    Args:
        images: one per light, as `render_lights` returns them.
        factors: what multiplies each light, (L,), or each of its channels, (L, C).

    Raises:
        InputError: where the factors do not fit the pictures.
    """
    images, factors = jnp.asarray(images), jnp.asarray(factors)
    if factors.ndim == 1:
        factors = factors[:, None]
    if factors.ndim != 2 or factors.shape[0] != images.shape[0] or 1 not in (factors.shape[1], images.shape[3]):
        if factors.shape != (images.shape[0], images.shape[3]):
            expected = f"({images.shape[0]},) or ({images.shape[0]}, {images.shape[3]})"
            raise InputError("factors", f"must be of shape {expected}, got {factors.shape}", "Give one per light")
    return jnp.sum(images * factors[:, None, None, :], axis=0)
