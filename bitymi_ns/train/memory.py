"""Memory of the views: bounds that do not grow with their number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

T = TypeVar("T")


class MemoryBudget:
    """Memory that caches may fill, several together. What fits first stays for good: views are looked at in turn, and a
    cache that replaced the oldest would have dropped each one just before it is needed again.

    Attributes:
        left: bytes that are not taken.
    """

    def __init__(self, nbytes: int) -> None:
        self.left = nbytes

    def reserve(self, nbytes: int) -> bool:
        """Whether so much is left; if so it is taken."""
        if nbytes > self.left:
            return False
        self.left -= nbytes
        return True


class OnDemand(Sequence, Generic[T]):
    """A sequence whose items are made whenever they are asked for.

    Args:
        count: its length.
        make: gives the item of an index, 0 to count - 1.
    """

    def __init__(self, count: int, make: Callable[[int], T]) -> None:
        self._indices, self._make = range(count), make

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, index: int) -> T:  # type: ignore[override]
        return self._make(self._indices[index])
