"""With what losses a JPEG was written, and what these do to another picture."""

import io
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8


class Jpeg(NamedTuple):
    """How a JPEG was written.

    Attributes:
        steps: its tables of steps, of brightness and of colours.
        subsampling: of the colours, as Pillow numbers it; 0 for none.
    """

    steps: tuple[tuple[int, ...], ...]
    subsampling: int

    @classmethod
    def of(cls, path: Path) -> "Jpeg | None":
        """Read how a JPEG was written; None where it does not keep brightness and colours apart, as inks."""
        from PIL import JpegImagePlugin  # late: few files are JPEGs

        try:
            # Of damaged remarks there is no need to warn.
            with warnings.catch_warnings(action="ignore"), JpegImagePlugin.JpegImageFile(path) as image:
                steps = tuple(tuple(table) for table in image.quantization.values())
                return cls(steps, JpegImagePlugin.get_sampling(image)) if image.mode == "RGB" and steps[1:] else None
        except (OSError, ValueError, SyntaxError):  # damaged: it is read all the same, or refused, elsewhere
            return None

    def through(self, codes: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
        """Codes as they come back from such a file."""
        from PIL import Image, JpegImagePlugin

        file = io.BytesIO()
        Image.fromarray(codes).save(file, "JPEG", qtables=self.steps, subsampling=self.subsampling)
        file.seek(0)
        return np.asarray(JpegImagePlugin.JpegImageFile(file))
