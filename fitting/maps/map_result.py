"""Maps: one material per texel, how sure it is, and why where it is not; as files and as pictures."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt8

import brdf
from brdf.errors import InputError, as_numbers, what_came
from brdf.files import as_path, read_text
from brdf.models.base import SpecularMaterial

REASONS = (
    "determined",
    "outside",
    "too few photographs",
    "no highlight seen",
    "no light near the mirror direction",
    "n is loose",
)
"""Why n and k_s of a texel are not determined, by the number in `Maps.reason`."""


@dataclasses.dataclass(frozen=True, eq=False)
class Maps:
    """One material per texel. Values that the photographs do not determine are NaN.

    Attributes:
        n: exponent.
        k_d: diffuse coefficient.
        k_s: specular coefficient.
        normal: unit; 0 outside.
        n_error: standard error.
        k_d_error: standard error.
        k_s_error: standard error.
        normal_error: standard error, in degrees; 0 where normals were given.
        determined: whether n and k_s are: the standard error of ln n is at most 0.25, and k_s above twice its own.
        reason: why not, as a number; `REASONS` has the words.
        residual: root mean square of what is left, over that of the photographs.
        fitted_n: the exponent that fits best, also where it is not determined: what renders.
        fitted_k_s: the specular coefficient to it; 0 where no highlight is seen.
        chosen: which of ``models`` each texel has.
        models: names.
        to_view: unit vector towards the camera, of one that is near the mean.
        notes: what was found out about the photographs.
        k_a: ambient coefficient, where there was ambient light.
        k_a_error: standard error.
        to_light: unit vectors towards the lights, where all are distant.
        intensity: what each photograph was divided by: of its light, times exposure; the channels' mean.
        noise: of a value, its standard deviation.
        left_out: share of a texel's values that were left out as cast shadows or other outliers.

    Example:
        >>> maps = fitting.load_maps("maps")
        >>> maps.n.shape, maps.k_d.shape, bool(maps.determined.all())
        ((4, 4), (4, 4, 3), True)
    """

    n: Float[np.ndarray, "H W"]
    k_d: Float[np.ndarray, "H W C"]
    k_s: Float[np.ndarray, "H W C"]
    normal: Float[np.ndarray, "H W 3"]
    n_error: Float[np.ndarray, "H W"]
    k_d_error: Float[np.ndarray, "H W C"]
    k_s_error: Float[np.ndarray, "H W C"]
    normal_error: Float[np.ndarray, "H W"]
    determined: Bool[np.ndarray, "H W"]
    reason: UInt8[np.ndarray, "H W"]
    residual: Float[np.ndarray, "H W"]
    fitted_n: Float[np.ndarray, "H W"]
    fitted_k_s: Float[np.ndarray, "H W C"]
    chosen: UInt8[np.ndarray, "H W"]
    models: tuple[str, ...]
    to_view: Float[np.ndarray, "3"]
    notes: tuple[str, ...] = ()
    k_a: Float[np.ndarray, "H W C"] | None = None
    k_a_error: Float[np.ndarray, "H W C"] | None = None
    to_light: Float[np.ndarray, "P 3"] | None = None
    intensity: Float[np.ndarray, " P"] | None = None
    noise: Float[np.ndarray, "H W"] | None = None
    left_out: Float[np.ndarray, "H W"] | None = None

    def layers(self) -> dict[str, np.ndarray]:
        """Every map by name."""
        texels = {k: v for k, v in vars(self).items() if isinstance(v, np.ndarray) and k != "to_light"}
        return {k: v for k, v in texels.items() if v.shape[:2] == self.n.shape}

    def __str__(self) -> str:
        """How many texels are determined, why the others are not, their models, and the middle of what was found."""
        height, width = self.n.shape
        inside = self.reason != REASONS.index("outside")
        total = max(np.count_nonzero(inside), 1)
        lines = [
            f"maps of {width} x {height} texels, {np.count_nonzero(inside)} of them fitted ({', '.join(self.models)})"
        ]
        for number, words in enumerate(REASONS):
            share = np.count_nonzero((self.reason == number) & inside) / total
            lines += [f"  {words:<36}{100 * share:6.1f} %"] if share else []
        chosen = self.chosen[inside & (self.reason != REASONS.index("too few photographs"))]
        for number, name in enumerate(self.models if len(self.models) > 1 else ()):
            lines.append(f"  {name:<36}{100 * np.count_nonzero(chosen == number) / total:6.1f} %")
        for name, values in (("n", self.n), ("k_d", self.k_d), ("k_s", self.k_s), ("residual", self.residual)):
            known = values[np.isfinite(values)]
            if known.size:
                low, middle, high = np.percentile(known, [25, 50, 75])
                lines.append(f"  {name:<9} median {middle:.4g}, half of it from {low:.4g} to {high:.4g}")
        if self.left_out is not None and np.any(self.left_out > 0):
            left_out = 100 * np.mean(self.left_out[inside])
            lines.append(f"  cast shadows and other outliers: {left_out:.1f} % of the values left out")
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])

    def render(self, light: Any, *, ambient: Any = 0.0) -> Float[np.ndarray, "H W C"]:
        """The picture under another distant light, seen from afar.

        Args:
            light: direction towards it, (3,), or a `brdf.DirectionalLight`.
            ambient: intensity of ambient light, a number or (C,), where the maps have k_a.

        Returns:
            Linear values; 0 outside.

        Raises:
            InputError: where it is no direction, or has other channels than the maps.

        Example:
            >>> fitting.load_maps("maps").render([0.3, 0.0, 1.0]).shape
            (4, 4, 3)
        """
        light = light if isinstance(light, brdf.DirectionalLight) else brdf.DirectionalLight(light, 1.0)
        ambient = as_numbers("ambient", ambient, remedy="Give the intensity of the ambient light")
        intensity, ambient, channels = np.atleast_1d(light.intensity), np.atleast_1d(ambient), self.k_d.shape[2]
        for name, values in (("light", intensity), ("ambient", ambient)):
            if values.shape not in ((1,), (channels,)):
                what = f"is of shape {values.shape}, the maps of {channels} channels"
                raise InputError(name, what, "Give a number, or one for each channel")
        if not np.all((ambient >= 0) & (ambient < np.inf)):
            raise InputError("ambient", f"must be 0 or more, got {ambient!r:.60}", "Give its intensity")
        if self.k_a is None and np.any(ambient):
            raise InputError("ambient", "lights maps without k_a", "Fit them with their ambient light")
        to_light = np.asarray(light.direction) / np.linalg.norm(light.direction)
        to_view = self.to_view / np.linalg.norm(self.to_view)
        normal = jnp.asarray(self.normal)
        cosine = np.maximum(self.normal @ to_light, 0)[..., None]
        picture = np.nan_to_num(self.k_d) * cosine
        for index, name in enumerate(self.models):
            model = brdf.MODELS[name]
            if issubclass(model, SpecularMaterial):
                each = eqx.tree_at(lambda one: one.n, model(k_d=0.0, k_s=1.0, n=1.0), jnp.asarray(self.fitted_n))
                lobe = np.asarray(each.specular(normal, jnp.asarray(to_light), jnp.asarray(to_view)))
                picture += np.where((self.chosen == index)[..., None], self.fitted_k_s * lobe[..., None], 0)
        picture *= intensity
        picture += 0 if self.k_a is None else np.nan_to_num(self.k_a) * ambient
        return picture.astype(np.float32)

    def next_light(self, candidates: Any = None, count: int = 1, *, of: str = "n") -> Any:
        """The light under which one more photograph would tell most of the exponents.

        Args:
            candidates: directions towards lights, (K, 3), which shine like the brightest of the maps' own, exposure and
                all; or directional lights; None for any direction of the hemisphere.
            count: how many lights, one chosen after the other.
            of: "n" for the median standard error of ln n over texels with a highlight, or "undetermined" for how many
                of these have one above 0.25.

        Returns:
            A `LightChoice`.

        Raises:
            InputError: naming the argument, or where the maps do not know their lights.

        Example:
            >>> choice = fitting.load_maps("maps").next_light([[0, 0, 1], [0.3, 0.1, 1], [0.9, 0, 0.3]])
            >>> choice.after[0] <= choice.before
            True
        """
        from fitting.maps.map_light_choice import next_light

        return next_light(self, candidates, count, of)

    def save(self, folder: str | Path, *, plot: bool = False) -> None:
        """Write maps.exr with a layer a map, maps.json, and 16-bit images for other programs: all of it or nothing.

        The images are k_d.png and k_s.png (linear, divided by the ``scale`` that maps.json tells), normals.png
        (n·0.5 + 0.5, y up), gloss.png (log2 n / 16), base_color.png (sRGB), metallic_roughness.png with
        material.gltf, residual.png; info.json is for OpenLIME.

        Args:
            folder: made where missing.
            plot: also maps.png, the figure of `plot`.

        Raises:
            InputError: where it cannot be written.

        Example:
            >>> maps = fitting.load_maps("maps")
            >>> maps.save("copy")
        """
        from fitting.maps.map_files import write_maps  # late: pictures are written by what renders none

        write_maps(self, folder, plot=plot)

    def view(self, title: str = "maps") -> Any:
        """A page that relights the maps: under a light that moves, or one by one, drawn in WebGL2.

        k_d, k_s and residual are held to 5e-4 of each, normals to 5e-5 radians, n to 1e-4 of it, of more than 1024
        texels on a side every second, third, ...

        Args:
            title: of the page.

        Returns:
            A page, which Jupyter shows without a kernel and ``.save("page.html")`` writes: one file, no network.

        Example:
            >>> fitting.load_maps("maps").view().save("page.html")
        """
        from fitting.maps.map_page import maps_page

        return maps_page(self, title, REASONS)

    def _repr_html_(self) -> str:
        """For Jupyter."""
        from fitting.maps.map_page import maps_html

        return maps_html(self)

    def plot(self) -> Any:
        """A Matplotlib figure of the maps.

        Example:
            >>> figure = fitting.load_maps("maps").plot()
        """
        from fitting.maps.map_files import draw_maps

        return draw_maps(self)


def load_maps(folder: str | Path) -> Maps:
    """Read what `Maps.save` wrote.

    Args:
        folder: with maps.exr and maps.json.

    Raises:
        InputError: naming the file.

    Example:
        >>> fitting.load_maps("maps").models
        ('blinn-phong',)
    """
    folder = as_path(folder)
    path, remedy = folder / "maps.json", "Give a folder that Maps.save wrote"
    text = read_text(path)
    try:
        about = json.loads(text)
        kinds = {name: np.dtype(kind) for name, kind in about["layers"].items()}
        (*models,), (*notes,) = about["models"], about["notes"]
        unknown = [name for name in models if name not in brdf.MODELS]
        to_view = np.array(about["to_view"], float).reshape(3)
        to_light = np.array(about["to_light"], float).reshape(-1, 3) if about.get("to_light") else None
        intensity = np.array(about["intensity"], float) if about.get("intensity") else None
        if intensity is not None and not (intensity.ndim == 1 and np.all((intensity > 0) & (intensity < np.inf))):
            raise ValueError
        if to_light is not None and intensity is not None and len(to_light) != len(intensity):
            raise ValueError
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(path, "does not describe maps", remedy) from None
    if unknown or not models:
        raise InputError(path, f"names no models that are known, got {what_came(about['models'])}", remedy)
    fields = {field.name: field.default is dataclasses.MISSING for field in dataclasses.fields(Maps)}
    if missing := [name for name in fields if fields[name] and name not in {"models", "to_view", *kinds}]:
        raise InputError(path, f"names no layer {missing[0]}", remedy)
    found = brdf.read_layers(folder / "maps.exr")
    layers = {}
    for name, kind in kinds.items():
        if name not in found or name not in fields:
            raise InputError(folder / "maps.exr", f"has no layer {name} of maps", "Write the maps again")
        values = (
            found[name]
            if name.startswith(("k_", "fitted_k", "normal")) and name != "normal_error"
            else found[name][..., 0]
        )
        layers[name] = values.astype(kind)
    given = {"to_view": to_view, "to_light": to_light, "intensity": intensity}
    return Maps(models=tuple(models), notes=tuple(notes), **given, **layers)
