"""Differentiable reflectance: models, lights, scenes, pictures and plausibility checks.

Names load when first used, so that importing the package does not import JAX; `__init__.pyi` says from where.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
