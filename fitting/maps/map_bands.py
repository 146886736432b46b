"""Maps by bands of rows: read, fitted and kept one after the other, on all cores, devices and processes."""

import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np

from brdf.errors import InputError
from brdf.precision import working_precision
from fitting.maps.kept_bands import KeptBands
from fitting.maps.map_inputs import Photographs
from fitting.maps.tiles import TILE, How, Surface, fit_band
from fitting.progress import waiting
from fitting.solver.devices import device_count, gathered, own, placed

BAND = 124 * TILE
"""Texels that are read and laid out at a time."""


class Bands:
    """Bands of rows, from the top: each is read, fitted on a core or device while others are, and kept where asked."""

    def __init__(self, given: Photographs, surface: Surface, how: How, keep: str | Path | None = None):
        """Of these photographs.

        Args:
            given: the photographs.
            surface: what all texels see.
            how: they are fitted.
            keep: a folder for what is done.
        """
        self.given, self.surface, self.how = given, surface, how
        _, height, width, _ = given.shape
        count = min(height, max(-(-height * width // BAND), device_count()))
        self.rows = -(-height // count)
        self.starts = range(0, height, self.rows)
        self.texels = -(-self.rows * width // TILE) * TILE
        self.kept = None if keep is None else KeptBands(keep, given, (how, surface[:2], surface.shared, self.rows))

    def fit(self) -> dict[str, np.ndarray]:
        """The layers, (H, W, ...)."""
        mine, count = own(len(self.starts)), len(self.starts)
        if len(mine) < count and self.kept is None:
            raise InputError("keep", "is missing", "Give a folder that all processes see, for the bands of each")
        if len(mine) < count:
            gathered({}, 1, (1,))  # connected before the work begins, processes notice at once where one is lost
        _, height, width, _ = self.given.shape
        layers: dict[str, np.ndarray] = {}

        def place(index: int, band: dict[str, np.ndarray]) -> None:
            start = self.starts[index]
            stop = min(start + self.rows, height)
            for name, values in band.items():
                if name not in layers:
                    layers[name] = np.empty((height, width, *values.shape[1:]), values.dtype)
                texels = values[: (stop - start) * width]
                layers[name][start:stop] = texels.reshape(stop - start, width, *values.shape[1:])

        with waiting("fitting maps") as say:
            for done, (index, band) in enumerate(self._each(mine), start=1):
                place(index, band)
                say(f"fitting maps, {100 * done // len(mine)} % done")
        if len(mine) < count and self.kept is not None:
            gathered({}, 1, (1,))  # until all processes have kept theirs
            for index in sorted(set(range(count)) - set(mine)):
                place(index, self.kept.read(self.starts[index]) or {})
            gathered({}, 1, (1,))  # and have read those of the others
        return layers

    def _each(self, mine: list[int]) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        queue: deque[tuple[int, Future]] = deque()
        workers = os.cpu_count() or 1
        with ThreadPoolExecutor(workers) as pool:
            for index in mine:
                start, precision = self.starts[index], self.how.precision
                band = None if self.kept is None else self.kept.read(start)
                if band is not None:
                    yield index, band
                    continue
                rows = np.arange(start, min(start + self.rows, self.given.shape[1]))
                codes = self.given.band(rows, self.texels, precision, pool)
                with working_precision(precision):
                    placed_there = placed(index, (codes, self.surface.some(rows, self.texels, precision)))
                queue.append((index, pool.submit(fit_band, self.given, self.how, *placed_there)))
                if len(queue) > workers:
                    yield self._done(*queue.popleft())
            for one in queue:
                yield self._done(*one)

    def _done(self, index: int, future: Future) -> tuple[int, dict[str, np.ndarray]]:
        band = future.result()
        if self.kept is not None:
            self.kept.write(self.starts[index], band)
        return index, band
