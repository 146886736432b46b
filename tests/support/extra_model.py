"""A model that only the tests have, as a person would add one: a lobe that goes back to where the light comes from."""

from typing import ClassVar

from brdf import vectors
from brdf.models.base import SpecularMaterial


class Retroreflector(SpecularMaterial):
    """S = (L.V)+^n."""

    name: ClassVar[str] = "retroreflector"

    @staticmethod
    def log_cosine(normal, to_light, to_view):
        """Of the angle between light and view."""
        return vectors.log_cosine(to_light, to_view)
