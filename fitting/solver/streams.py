"""Sequences whose elements are made when asked for, so that what is larger than memory can be gone through."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

T = TypeVar("T")


class Stream(Sequence[T]):
    """Elements made when asked for, again each time; only the last one is kept."""

    def __init__(self, make: Callable[[int], T], count: int):
        """A sequence of so many elements, each made by its index."""
        self._make, self._count = make, count
        self._last: tuple[int, T] | None = None

    def __len__(self) -> int:
        """How many elements there are."""
        return self._count

    def __getitem__(self, index: Any) -> Any:
        """One element."""
        if not 0 <= index < self._count:
            raise IndexError(index)
        if self._last is None or self._last[0] != index:
            self._last = None  # before the next is made, or two would be in memory
            self._last = index, self._make(index)
        return self._last[1]


def each(function: Callable[..., T], *sequences: Sequence[Any]) -> Sequence[T]:
    """A function of the elements of sequences of one length: a list, or a stream where one of them is one."""
    if any(isinstance(sequence, Stream) for sequence in sequences):
        return Stream(lambda i: function(*(sequence[i] for sequence in sequences)), len(sequences[0]))
    return list(map(function, *sequences))


def joined(sequences: Sequence[Sequence[T]]) -> Sequence[T]:
    """One sequence after the other: a list, or a stream where one of them is one."""
    places = [(sequence, i) for sequence in sequences for i in range(len(sequence))]
    if any(isinstance(sequence, Stream) for sequence in sequences):
        return Stream(lambda i: places[i][0][places[i][1]], len(places))
    return [sequence[i] for sequence, i in places]
