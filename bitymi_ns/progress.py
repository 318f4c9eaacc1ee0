"""Progress callbacks of slow steps."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol


class Progress(Protocol):
    """Callback after each chunk of work, with the step's name, the amount done and the total."""

    def __call__(self, step: str, done: int, total: int) -> None: ...


def no_progress(step: str, done: int, total: int) -> None: ...


@contextmanager
def rich_progress() -> Iterator[Progress]:
    """Create a callback that draws one bar per step."""
    from rich.progress import Progress as Bars  # lazily: only needed in a terminal
    from rich.progress import TaskID

    with Bars() as bars:
        tasks: dict[str, TaskID] = {}

        def update(step: str, done: int, total: int) -> None:
            if step not in tasks:
                tasks[step] = bars.add_task(step, total=total)
            bars.update(tasks[step], completed=done, total=total)

        yield update
