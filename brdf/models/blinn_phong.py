"""Blinn's lobe of the half vector H = (L + V) / |L + V| about the normal: the classic form and the normalised one.

| parameter | default | meaning | differentiable |
| --- | --- | --- | --- |
| k_a | 0 | ambient coefficient, a number or (C,), at least 0 | yes |
| k_d | | diffuse coefficient, a number or (C,), at least 0 | yes |
| k_s | | specular coefficient, a number or (C,), at least 0 | yes |
| n | | exponent, one number for all channels, at least 0 | yes |

`BlinnPhong`: S = (N.H)+^n. `NormalizedBlinnPhong`: S = (n+2)(n+4) / (8 (2^(-n/2) + n)) (N.H)+^n (N.L)+.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from brdf import vectors
from brdf.models.base import SpecularMaterial
from brdf.vectors import Numbers, Scalars


class BlinnPhong(SpecularMaterial):
    """A glossy surface as OpenGL's fixed function and Wavefront's MTL (illum 2) draw it: S = (N.H)+^n.

    k_a, k_d, k_s at least 0, n at least 0. Not reciprocal and not energy conserving for k_s > 0: the albedo diverges
    at grazing light. Source: J. F. Blinn, "Models of light reflection for computer synthesized pictures", SIGGRAPH
    1977, 192-198.

    Example:
        >>> brdf.BlinnPhong(k_d=[0.4, 0.3, 0.1], k_s=0.5, n=50)
        BlinnPhong(k_a=[0, 0, 0], k_d=[0.4, 0.3, 0.1], k_s=[0.5, 0.5, 0.5], n=50)
    """

    name = "blinn-phong"
    log_cosine = staticmethod(vectors.half_log_cosine)


class NormalizedBlinnPhong(SpecularMaterial):
    """Blinn-Phong made physically plausible: S = (n+2)(n+4) / (8 (2^(-n/2) + n)) (N.H)+^n (N.L)+.

    k_a, k_d, k_s at least 0, n at least 0. Reciprocal. Conserves energy when k_d + k_s <= 1: the lobe alone reflects
    all light at normal incidence and less at grazing angles. Source: F. Giesen, "Phong normalization factor
    derivation", 2009; the lobe is Blinn's of 1977.

    Example:
        >>> brdf.check(brdf.NormalizedBlinnPhong(k_d=0.3, k_s=0.6, n=50)).plausible
        True
    """

    name = "normalized-blinn-phong"
    cosine_weighted = True
    log_cosine = staticmethod(vectors.half_log_cosine)

    @staticmethod
    def scale(n: Numbers) -> Scalars:
        """(n+2)(n+4) / (8 (2^(-n/2) + n)): the albedo of the lobe at normal incidence is 1."""
        # A plain number by NumPy: by JAX each operation would be compiled.
        xp: Any = jnp if isinstance(n, jax.Array) else np
        n = xp.asarray(n, None if xp is jnp else float)
        return 0.125 * (n + 2.0) * ((n + 4.0) / (xp.exp(-0.5 * math.log(2.0) * n) + n))
