"""With what losses a JPEG was written, and what these do to another picture."""

import bisect
import functools
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenImageIO as oiio  # noqa: N813
from jaxtyping import UInt8

from brdf.files import utf8_name

_TABLES, _SCAN, _FILL = 0xDB, 0xDA, 0xFF


class Jpeg(NamedTuple):
    """How a JPEG was written.

    Attributes:
        steps: sum of its tables of steps, of brightness and of colours.
        subsampling: of the colours, "4:4:4" for none.
    """

    steps: int
    subsampling: str

    @classmethod
    def of(cls, path: Path, spec: oiio.ImageSpec) -> "Jpeg | None":
        """Read how a JPEG was written; None where it does not keep brightness and colours apart, as inks.

        Args:
            path: of the file.
            spec: its header.
        """
        found = 0 if spec.get_string_attribute("jpeg:ColorSpace") else _steps(path)
        return cls(found, spec.get_string_attribute("jpeg:subsampling", "4:4:4")) if found else None

    @property
    def quality(self) -> int:
        """1 to 100, as libjpeg counts: that with the nearest steps."""
        return 1 + bisect.bisect_left(range(1, 100), -self.steps, key=lambda quality: -_steps_of(quality))

    def through(self, codes: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
        """Codes as they come back from such a file.

        Args:
            codes: that go into it.
        """
        with tempfile.TemporaryDirectory() as folder:
            image = oiio.ImageInput.open(utf8_name(_written(codes, self.quality, self.subsampling, folder)))
            assert image is not None
            found = image.read_image("uint8")
            assert found is not None
            image.close()
        return found


def _written(codes: np.ndarray, quality: int, subsampling: str, folder: str) -> Path:
    path = Path(folder, "picture.jpg")
    spec = oiio.ImageSpec(codes.shape[1], codes.shape[0], codes.shape[2], "uint8")
    spec.attribute("CompressionQuality", quality)
    spec.attribute("jpeg:subsampling", subsampling)
    file = oiio.ImageOutput.create(utf8_name(path))
    assert file is not None
    file.open(str(path), spec)
    file.write_image(np.ascontiguousarray(codes))
    file.close()
    return path


@functools.cache
def _steps_of(quality: int) -> int:
    with tempfile.TemporaryDirectory() as folder:
        return _steps(_written(np.zeros((16, 16, 3), np.uint8), quality, "4:4:4", folder))


def _steps(path: Path) -> int:
    """The sum of a file's first two tables of steps, of brightness and of colours; 0 where it has fewer.

    Source: ITU T.81, B.1.1.2 and B.2.4.1.
    """
    data, at, tables = path.read_bytes(), 2, []
    while at + 4 <= len(data) and data[at + 1] != _SCAN:
        if data[at + 1] == _FILL:
            at += 1
            continue
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        segment = data[at + 4 : end] if data[at + 1] == _TABLES else b""
        while segment:
            wide = segment[0] >> 4
            size = 1 + (64 << wide)
            tables.append(int(np.frombuffer(segment[1:size], ">u2" if wide else "u1").sum()))
            segment = segment[size:]
        at = end
    return sum(tables[:2]) if len(tables) > 1 else 0
