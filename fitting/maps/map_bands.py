"""Maps by bands of texels: read, fitted and kept one after the other, on all cores, devices and processes."""

import threading
import zipfile
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Int

from brdf.errors import InputError
from brdf.files import atomic_path
from fitting.maps.map_inputs import fingerprint, places
from fitting.maps.tiles import CHUNK, TILE, MapProblem
from fitting.progress import waiting
from fitting.solver.devices import core_count, device_count, gathered, own

BAND = 10 * CHUNK * TILE - 1
"""Texels that are read and laid out at a time; a lane is left over."""

FORM = 3
"""Of what is kept of a band: another number where its layers change."""

SPARSE = 16
"""Of so many pixels for each of these at most: the others see nothing."""


def fit_bands(problem: MapProblem, keep: Path | None = None) -> dict[str, np.ndarray]:
    """The layers, (H, W, ...), band after band from the top: one is read while others are fitted, each on a core.

    What is done is kept in the folder ``keep``: what an interrupted run goes on from, and what processes hand each
    other; refused where it cannot be used, or is missing and there are several processes.
    """
    (height, width, _), texels = problem.photographs.size, problem.texels
    if not texels.size:
        raise InputError("pictures", "show no texel that counts", "Check mask and normals")
    bands = _bands(texels, width, min(BAND, -(-texels.size // device_count())))
    mine, reading = own(len(bands)), threading.Lock()
    others = sorted(set(range(len(bands))) - set(mine))
    if others and keep is None:
        raise InputError("keep", "is missing", "Give a folder that all processes see, for the bands of each")
    if others:
        gathered({}, 1, (1,))  # connected before the work begins, processes notice at once where one is lost
    key = "" if keep is None else _key(problem)
    kept = [None if keep is None else keep / f"{key}-{some[0]:010d}-{some.size}.npz" for some in bands]
    layers: dict[str, np.ndarray] = {}

    def band(index):
        found = read_band(kept[index])
        if found is not None:
            return found, None
        with reading:
            tiles = problem.tiles(bands[index])
        found = problem.fit(*tiles, index)
        found.pop("criteria", None)
        return found, kept[index]

    def place(index, found):
        for name, values in found.items():
            if name not in layers:
                layers[name] = np.empty((height * width, *values.shape[1:]), values.dtype)
                if texels.size < height * width:
                    layers[name][:] = values[bands[index].size]
            layers[name][places(bands[index])] = values[: bands[index].size]

    with waiting("fitting maps") as say, ThreadPoolExecutor(core_count()) as pool:
        for done, (index, (found, path)) in enumerate(zip(mine, pool.map(band, mine), strict=True), start=1):
            place(index, found)
            # Of input in which nothing counts nothing is left, unless other processes wait for it.
            if path is not None and (others or np.any(np.isfinite(found["k_d"][: bands[index].size]))):
                write_band(path, found)
            say(f"fitting maps, {100 * done // len(mine)} % done")
    if others:
        gathered({}, 1, (1,))  # until all processes have kept theirs
        for index in others:
            found = read_band(kept[index])
            if found is None:
                raise InputError(str(kept[index]), "is missing or damaged", "Give a folder that all processes see")
            place(index, found)
        gathered({}, 1, (1,))  # and have read those of the others
    return {name: values.reshape(height, width, *values.shape[1:]) for name, values in layers.items()}


def _bands(texels: Int[np.ndarray, " K"], width: int, most: int) -> list[Int[np.ndarray, " B"]]:
    """So many texels each at most, of whole rows where these are as many."""
    found = []
    while texels.size:
        row = texels[0] // width + max(1, SPARSE * most // width)
        count = min(most, np.searchsorted(texels, row * width))
        if count < texels.size:
            count = np.searchsorted(texels, texels[count] // width * width) or count
        found.append(texels[:count])
        texels = texels[count:]
    return found


def _key(problem: MapProblem) -> str:
    """Of all that maps depend on: files by name, size and time, arrays by content."""
    sources = []
    for one in problem.photographs.each:
        sources += one.curve, one.top
        if Path(one.name).is_file():
            status = Path(one.name).stat()
            sources += one.name, status.st_size, status.st_mtime_ns
        else:
            sources.append(one.rows(0, one.shape[0]))
    named = {**vars(problem), "photographs": {**vars(problem.photographs), "each": sources}, "form": FORM}
    return fingerprint(named)


def read_band(path: Path | None) -> dict[str, np.ndarray] | None:
    """The layers of a band; None where they are not kept, or not whole."""
    if path is None or not path.is_file():
        return None
    try:
        with path.open("rb") as file, np.load(file) as layers:
            return dict(layers)
    except (OSError, ValueError, EOFError, TypeError, RuntimeError, zipfile.BadZipFile, zlib.error):
        return None


def write_band(path: Path, layers: dict[str, np.ndarray]) -> None:
    """Keep them: whole, or not at all; refused where that cannot be."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(path.parent, f"cannot be made ({error.strerror})", "Give another folder") from None
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **layers)  # pyright: ignore[reportArgumentType]
