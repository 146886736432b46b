"""Who draws a material or a report in Jupyter: `brdf.display`, which knows both and enters here by the package's root.

So what is drawn need not import what draws it.
"""

from collections.abc import Callable
from typing import Any

html: dict[str, Callable[[Any], str]] = {}
"""From "material" and "report" to what makes HTML of one."""
