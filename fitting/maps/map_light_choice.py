"""Which light to add to those of maps: the texels' information on their exponents, light by light."""

from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

import brdf
from brdf.errors import InputError
from brdf.models.base import SpecularMaterial
from brdf.vectors import dot
from fitting.light_choice import LightChoice, choose_lights, direction_of

if TYPE_CHECKING:
    from fitting.maps.map_result import Maps

MOST_ERROR = 0.25
"""Standard error of ln n up to which it counts as determined."""

MOST_TEXELS = 4096
"""Of the maps at most so many texels are looked at, evenly spread."""


def _lobe(model: type[SpecularMaterial], weight: Any, log_cosine: Any, log_n: Any) -> Any:
    n = jnp.exp(log_n)
    return model.scale(n) * weight * jnp.exp(n * log_cosine)


def next_light(maps: "Maps", candidates: Any, count: int, of: str) -> LightChoice:
    """See `Maps.next_light`."""
    if of not in ("n", "undetermined"):
        raise InputError("of", f"must be n or undetermined, got {of!r}", "Ask for one of these")
    if maps.to_light is None or maps.noise is None:
        raise InputError("maps", "do not know directions of their lights", "Fit them under distant lights")
    glossy = [issubclass(brdf.MODELS[name], SpecularMaterial) for name in maps.models]
    shows = np.any(maps.fitted_k_s > 0, axis=-1) & np.array(glossy)[maps.chosen] & (maps.noise > 0)
    texel = np.flatnonzero(shows)
    if not texel.size:
        raise InputError("maps", "have no texel with a highlight", "Name a model with one")
    texel = texel[:: -(-texel.size // MOST_TEXELS)]
    normal, log_n = maps.normal.reshape(-1, 3)[texel], np.log(maps.fitted_n.ravel()[texel])
    strength = np.sum(maps.fitted_k_s.reshape(-1, maps.fitted_k_s.shape[-1])[texel] ** 2.0, axis=1)
    strength = strength / maps.noise.ravel()[texel] ** 2.0
    chosen, to_view = maps.chosen.ravel()[texel], maps.to_view / np.linalg.norm(maps.to_view)

    @jax.jit
    def products(to_light: Any) -> Any:
        """Of the columns of k_d and k_s and the derivative by ln n: the upper triangle of their Gram matrix, (6, T)."""
        cosine = jnp.maximum(dot(normal, to_light), 0)
        lobe = slope = jnp.zeros_like(cosine)
        for index, name in enumerate(maps.models):
            model = brdf.MODELS[name]
            if not issubclass(model, SpecularMaterial):
                continue
            log_cosine, weight = model.log_cosine(normal, to_light, to_view), cosine if model.cosine_weighted else 1.0
            at = jnp.asarray(log_n)
            found = jax.jvp(partial(_lobe, model, weight, log_cosine), (at,), (jnp.ones_like(at),))
            here = (chosen == index) & (cosine > 0)
            lobe, slope = (jnp.where(here, new, old) for new, old in zip(found, (lobe, slope), strict=True))
        columns = cosine, lobe, slope
        return jnp.stack([a * b for i, a in enumerate(columns) for b in columns[i:]])

    def told_by(light: Any) -> np.ndarray:
        return np.asarray(products(direction_of(light)), np.float64)

    def error(information: np.ndarray) -> float:
        dd, ds, dx, ss, sx, xx = information
        ss, sx, xx = ss - divided(ds * ds, dd), sx - divided(ds * dx, dd), xx - divided(dx * dx, dd)
        left = strength * np.maximum(xx - divided(sx * sx, ss), 0)
        errors = 1 / np.sqrt(np.maximum(left, np.finfo(float).tiny))
        return float(
            np.median(errors) if of == "n" else np.count_nonzero(errors > MOST_ERROR) * shows.sum() / texel.size
        )

    def divided(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.divide(a, b, out=np.zeros_like(a), where=b > 0)

    known = tuple(brdf.DirectionalLight(light, 1.0) for light in maps.to_light)
    information = np.sum([told_by(light) for light in known], axis=0)
    return choose_lights(candidates, count, of, known, to_view, information, told_by, error)
