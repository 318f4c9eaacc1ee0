"""Errors of operations that callers handle."""

from __future__ import annotations


class TooManyFragments(RuntimeError):
    """A view has more fragments than it may have.

    Attributes:
        count: how many there are.
        most: how many there may be.
    """

    def __init__(self, count: int, most: int, width: int, height: int, size: int) -> None:
        """
        Args:
            count, most: fragments.
            width, height: of the view, pixels.
            size: bytes per fragment in the list.
        """
        super().__init__(
            f"the view has {count:,} fragments, {count / (width * height):.0f} per pixel; their list needs "
            f"{count * size / 2**30:.2f} GiB, and there is room for {most:,}: render a smaller image or use fewer "
            "surfels"
        )
        self.count, self.most = count, most
