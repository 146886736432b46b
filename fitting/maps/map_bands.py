"""Maps by bands of rows: read, fitted and kept one after the other, on all cores, devices and processes."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from brdf.errors import InputError
from brdf.files import atomic_path
from brdf.precision import working_precision
from fitting.maps.map_inputs import fingerprint
from fitting.maps.tiles import TILE, MapProblem
from fitting.progress import waiting
from fitting.solver.devices import device_count, gathered, own, placed

BAND = 152 * TILE
"""Texels that are read and laid out at a time."""


def fit_bands(problem: MapProblem, keep: Path | None = None) -> dict[str, np.ndarray]:
    """The layers, (H, W, ...), band after band from the top: one is read while others are fitted, each on a core.

    Args:
        problem: what is fitted.
        keep: a folder for what is done: what an interrupted run goes on from, and what processes hand each other.

    Raises:
        InputError: where the folder cannot be used, or is missing and there are several processes.
    """
    height, width, _ = problem.photographs.size
    rows = -(-height // min(height, max(-(-height * width // BAND), device_count())))
    starts, texels = range(0, height, rows), -(-rows * width // TILE) * TILE
    mine, reading = own(len(starts)), threading.Lock()
    others = sorted(set(range(len(starts))) - set(mine))
    if others and keep is None:
        raise InputError("keep", "is missing", "Give a folder that all processes see, for the bands of each")
    if others:
        gathered({}, 1, (1,))  # connected before the work begins, processes notice at once where one is lost
    key = "" if keep is None else _key(problem)
    kept = [None if keep is None else keep / f"{key}-{start:08d}-{rows}.npz" for start in starts]
    layers: dict[str, np.ndarray] = {}

    def band(index):
        path = kept[index]
        if path is not None and path.is_file():
            return read_band(path)
        with reading:
            tiles = problem.tiles(np.arange(starts[index], min(starts[index] + rows, height)), texels)
        with working_precision(problem.precision):
            tiles = placed(index, tiles)
        return problem.fit(*tiles)

    def place(index, found):
        for name, values in found.items():
            if name not in layers:
                layers[name] = np.empty((height, width, *values.shape[1:]), values.dtype)
            part = layers[name][starts[index] : starts[index] + rows]
            part[:] = values[: len(part) * width].reshape(part.shape)

    with waiting("fitting maps") as say, ThreadPoolExecutor(os.cpu_count()) as pool:
        for done, (index, found) in enumerate(zip(mine, pool.map(band, mine), strict=True), start=1):
            place(index, found)
            path = kept[index]
            if path is not None and not path.is_file():
                write_band(path, found)
            say(f"fitting maps, {100 * done // len(mine)} % done")
    if others:
        gathered({}, 1, (1,))  # until all processes have kept theirs
        for index in others:
            path = kept[index]
            assert path is not None
            place(index, read_band(path))
        gathered({}, 1, (1,))  # and have read those of the others
    return layers


def _key(problem: MapProblem) -> str:
    """Of all that maps depend on: files by name, size and time, arrays by content."""
    told = []
    for one in problem.photographs.each:
        told.append(one.curve)
        if Path(one.name).is_file():
            status = Path(one.name).stat()
            told += one.name, status.st_size, status.st_mtime_ns
        else:
            told.append(one.rows(0, one.shape[0]))
    named = {**vars(problem), **vars(problem.photographs), "each": told, "photographs": None}
    return fingerprint(named)


def read_band(path: Path) -> dict[str, np.ndarray]:
    """The layers of a band."""
    with np.load(path) as layers:
        return dict(layers)


def write_band(path: Path, layers: dict[str, np.ndarray]) -> None:
    """Keep them: whole, or not at all.

    Raises:
        InputError: where that cannot be.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(path.parent, f"cannot be made ({error.strerror})", "Give another folder") from None
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **layers)  # pyright: ignore[reportArgumentType]
