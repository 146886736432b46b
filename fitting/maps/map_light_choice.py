"""Which light to add to those of maps: the texels' information on their exponents, light by light."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

import brdf
from brdf.errors import InputError
from brdf.models.base import SpecularMaterial
from brdf.vectors import Components, quotient
from fitting.light_choice import LightChoice, choose_lights, direction_of
from fitting.maps.texels import Distant, columns_of

if TYPE_CHECKING:
    from fitting.maps.map_result import Maps

MOST_ERROR = 0.25
"""Standard error of ln n up to which it counts as determined."""

MOST_TEXELS = 4096
"""Of the maps at most so many texels are looked at, evenly spread."""


def next_light(maps: "Maps", candidates: Any, count: int, of: str) -> LightChoice:
    """See `Maps.next_light`."""
    if of not in ("n", "undetermined"):
        raise InputError("of", f"must be n or undetermined, got {of!r}", "Ask for one of these")
    if maps.to_light is None or maps.noise is None:
        raise InputError("maps", "do not know directions of their lights", "Fit them under distant lights")
    models = [brdf.MODELS[name] for name in maps.models]
    glossy = [issubclass(model, SpecularMaterial) for model in models]
    shows = np.any(maps.fitted_k_s > 0, axis=-1) & np.array(glossy)[maps.chosen] & (maps.noise > 0)
    texel = np.flatnonzero(shows)
    if not texel.size:
        raise InputError("maps", "have no texel with a highlight", "Name a model with one")
    texel = texel[:: -(-texel.size // MOST_TEXELS)]
    normal = Components(tuple(jnp.asarray(maps.normal.reshape(-1, 3)[texel].T)))
    log_n = jnp.log(maps.fitted_n.ravel()[texel])
    chosen, to_view = maps.chosen.ravel()[texel], maps.to_view / np.linalg.norm(maps.to_view)

    @jax.jit
    def products(to_light):
        """Of the columns of k_d and k_s and the derivative by ln n: the upper triangle of their Gram matrix, (6, T)."""
        lights = Distant(Components(tuple(to_light[:, None])), Components(tuple(to_view)), None)
        columns = columns_of(models, chosen, log_n, 1, lambda texels: texels.facing(normal, lights))
        columns = [one[:, 0, 0] for one in columns]
        return jnp.stack([a * b for i, a in enumerate(columns) for b in columns[i:]])

    def information_by(light: Any) -> np.ndarray:
        emitted = np.asarray(light.emittance, np.float64)
        if emitted.size not in (1, maps.k_d.shape[2]):
            what = f"have {emitted.size} channels, the maps {maps.k_d.shape[2]}"
            raise InputError("candidates", what, "Give both the same number, or light of one")
        return np.mean(emitted**2) / np.mean(shining**2) * np.asarray(products(direction_of(light)), np.float64)

    def left_by(information: np.ndarray) -> np.ndarray:
        """Of the information on ln n, what k_d and k_s leave."""
        dd, ds, dx, ss, sx, xx = information
        ss, sx, xx = ss - quotient(ds * ds, dd), sx - quotient(ds * dx, dd), xx - quotient(dx * dx, dd)
        return np.maximum(xx - quotient(sx * sx, ss), np.finfo(float).tiny)

    def error(information: np.ndarray) -> float:
        errors = 1 / np.sqrt(strength * left_by(information))
        return float(
            np.median(errors) if of == "n" else np.count_nonzero(errors > MOST_ERROR) * shows.sum() / texel.size
        )

    shining = np.ones(len(maps.to_light)) if maps.intensity is None else maps.intensity
    known = tuple(map(brdf.DirectionalLight, maps.to_light, shining))
    information = np.sum([information_by(light) for light in known], axis=0)
    strength = np.sum(maps.fitted_k_s.reshape(-1, maps.fitted_k_s.shape[-1])[texel] ** 2.0, axis=1)
    strength /= maps.noise.ravel()[texel] ** 2.0
    # The maps' own errors know the weights of their values: what the texels with one say, the others are taken to say.
    own = (maps.n_error / maps.n).ravel()[texel]
    unit = 1 / (own**2 * strength * left_by(information))
    has_own = np.isfinite(unit)
    strength *= np.where(has_own, unit, np.median(unit[has_own]) if np.any(has_own) else 1)
    arriving = [np.asarray(light.emittance) for light in known]
    return choose_lights(candidates, count, of, known, arriving, to_view, information, information_by, error)
