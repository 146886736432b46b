"""Fitting reflectance models to pictures: one call, no guess, the global optimum, and how sure it is.

Names load when first used, so that the command's help does not import JAX; `__init__.pyi` says from where.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
