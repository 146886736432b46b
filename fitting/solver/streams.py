"""Sequences whose elements are made when asked for, so that what is larger than memory can be gone through."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar, overload

T = TypeVar("T")


class Stream(Sequence[T]):
    """Elements made when asked for, again each time; only the last one is kept."""

    def __init__(self, make: Callable[[int], T], count: int):
        """Make a sequence.

        Args:
            make: gives an element by its index.
            count: how many there are.
        """
        self._make, self._count = make, count
        self._last: tuple[int, T] | None = None

    def __len__(self) -> int:
        """How many elements there are."""
        return self._count

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[T]: ...
    def __getitem__(self, index: int | slice) -> T | Sequence[T]:
        """An element, or a list of some."""
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(self._count))]
        if not -self._count <= index < self._count:
            raise IndexError(index)
        index %= self._count
        if self._last is None or self._last[0] != index:
            self._last = None  # before the next is made, or two would be in memory
            self._last = index, self._make(index)
        return self._last[1]


def each(function: Callable[..., T], *sequences: Sequence[Any]) -> Sequence[T]:
    """A function of the elements of sequences of one length: a list, or a stream where one of them is one.

    Args:
        function: of as many elements as there are sequences.
        sequences: any.
    """
    if any(isinstance(sequence, Stream) for sequence in sequences):
        return Stream(lambda i: function(*(sequence[i] for sequence in sequences)), len(sequences[0]))
    return [function(*elements) for elements in zip(*sequences, strict=True)]


def joined(sequences: Sequence[Sequence[T]]) -> Sequence[T]:
    """One sequence after the other: a list, or a stream where one of them is one.

    Args:
        sequences: any number.
    """
    if not any(isinstance(sequence, Stream) for sequence in sequences):
        return [element for sequence in sequences for element in sequence]
    places = [(sequence, i) for sequence in sequences for i in range(len(sequence))]
    return Stream(lambda i: places[i][0][places[i][1]], len(places))
