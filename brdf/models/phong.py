"""Phong, classic and normalised."""

from typing import ClassVar

import jax.numpy as jnp

from brdf import vectors
from brdf.models.base import SpecularMaterial
from brdf.vectors import Directions, Numbers, Scalars


class Phong(SpecularMaterial):
    """A glossy surface as VTK and PyTorch3D draw it: S = (R.V)+^n, R the mirror direction of the light.

    k_a, k_d, k_s at least 0, n at least 0. Not reciprocal and not energy conserving for k_s > 0: the albedo diverges
    at grazing light. Source: B. T. Phong, "Illumination for computer generated pictures", CACM 18 (1975) 311-317.
    """

    name: ClassVar[str] = "phong"
    cosine_weighted: ClassVar[bool] = False

    @staticmethod
    def log_cosine(normal: Directions, to_light: Directions, to_view: Directions) -> Scalars:
        """Logarithm of R.V; see ``SpecularMaterial.log_cosine``."""
        return vectors.mirror_log_cosine(normal, to_light, to_view)

    @staticmethod
    def scale(n: Numbers) -> Scalars:
        """1: the classic form is not normalised."""
        return jnp.ones_like(n)


class NormalizedPhong(SpecularMaterial):
    """Phong made physically plausible: S = (n+2)/2 (R.V)+^n (N.L)+.

    k_a, k_d, k_s at least 0, n at least 0. Reciprocal. Conserves energy when k_d + k_s <= 1: the lobe alone reflects
    all light at normal incidence and less at grazing angles, where the surface cuts it. Source: R. R. Lewis, "Making
    shaders more physically plausible", Computer Graphics Forum 13 (1994) 109-120; E. P. Lafortune and Y. D. Willems,
    "Using the modified Phong reflectance model for physically based rendering", Report CW 197, K.U. Leuven, 1994.
    """

    name: ClassVar[str] = "normalized-phong"
    cosine_weighted: ClassVar[bool] = True

    @staticmethod
    def log_cosine(normal: Directions, to_light: Directions, to_view: Directions) -> Scalars:
        """Logarithm of R.V; see ``SpecularMaterial.log_cosine``."""
        return vectors.mirror_log_cosine(normal, to_light, to_view)

    @staticmethod
    def scale(n: Numbers) -> Scalars:
        """(n+2)/2: the albedo of the lobe at normal incidence is 1."""
        return 0.5 * (jnp.asarray(n) + 2.0)
