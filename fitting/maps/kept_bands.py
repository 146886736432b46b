"""Bands of maps that are done, in files: what an interrupted run goes on from, and what processes hand each other."""

import hashlib
import zlib
from pathlib import Path
from typing import Any

import jax
import numpy as np

from brdf.errors import InputError
from brdf.files import atomic_path
from fitting.maps.map_inputs import Photographs


class KeptBands:
    """A folder with a file for each band of rows that is done; files of other inputs are not looked at."""

    def __init__(self, folder: str | Path, given: Photographs, told: Any):
        """Know the inputs.

        Args:
            folder: made where missing.
            given: the photographs, which are known again by name, size and time, or where they are arrays by content.
            told: whatever else the maps depend on.
        """
        self.folder = Path(folder)
        digest = hashlib.sha256()
        scenes = jax.tree.flatten(given.scenes)
        for part in (given.shape, given.to_light, *scenes, given.scale, given.top, given.encoding, told):
            _add(digest, part)
        for name, read in zip(given.names, given.rows, strict=True):
            if Path(name).is_file():
                status = Path(name).stat()
                _add(digest, (name, status.st_size, status.st_mtime_ns))
            else:
                _add(digest, zlib.crc32(np.ascontiguousarray(read(0, given.shape[1])).tobytes()))
        self._key = digest.hexdigest()[:16]

    def _path(self, start: int) -> Path:
        return self.folder / f"{self._key}-{start:08d}.npz"

    def read(self, start: int) -> dict[str, np.ndarray] | None:
        """The layers of the band that begins at a row; None where it is not done."""
        path = self._path(start)
        if not path.is_file():
            return None
        with np.load(path) as layers:
            return dict(layers)

    def write(self, start: int, layers: dict[str, np.ndarray]) -> None:
        """Keep the layers of a band: whole, or not at all.

        Raises:
            InputError: where it cannot be written.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(self.folder, f"cannot be made ({error.strerror})", "Give another folder") from None
        with atomic_path(self._path(start)) as temporary, temporary.open("wb") as file:
            np.savez(file, **layers)  # pyright: ignore[reportArgumentType]


def _add(digest: Any, part: Any) -> None:
    """Arrays by content, everything else by what it says of itself."""
    if isinstance(part, tuple | list):
        for one in part:
            _add(digest, one)
    elif isinstance(part, np.ndarray | jax.Array):
        digest.update(np.ascontiguousarray(part).tobytes())
    else:
        digest.update(repr(part).encode())
