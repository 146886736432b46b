"""Fitting reflectance models to pictures: one call, no guess, the global optimum, and how sure it is.

Names load when first used, so that the command's help does not import JAX; `__init__.pyi` says from where.
"""

from typing import Any

import lazy_loader

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name != "__version__":
        return _load(name)
    import importlib.metadata

    return importlib.metadata.version("brdf-fitting")
