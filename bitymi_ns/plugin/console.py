"""Console messages: errors without traceback, warnings, a step bar."""

import functools
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from bitymi_ns.capture.types import CaptureError
from bitymi_ns.exit_messages import INTERRUPTED as INTERRUPTED
from bitymi_ns.trust import listed as listed
from bitymi_ns.trust import printable


@contextmanager
def step_bar(done: int, total: int) -> Iterator[Callable[[int, float | None], None]]:
    """Show a progress bar in a terminal; yield the function to call with a finished step's index and the seconds left,
    if known."""
    columns = (TextColumn("step"), MofNCompleteColumn(), BarColumn(), TextColumn("{task.fields[left]}"))
    hidden = not CONSOLE.is_terminal
    with Progress(*columns, console=CONSOLE, refresh_per_second=2, transient=True, disable=hidden) as bar:
        task = bar.add_task("", completed=done, total=total, left="")

        def show(step: int, left: float | None) -> None:
            bar.update(task, completed=step + 1, left="" if left is None else f"{duration(left)} left")

        yield show


def duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 100 * 60 else f"{seconds / 3600:.1f} h"


class InputError(SystemExit):
    """Wrong input: Python prints the message to stderr and exits with status 1. nerfstudio's commands handle no errors,
    so an Exception would end in a traceback."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(f"bitymi: {message}"))

    def __str__(self) -> str:
        return str(self.code)


def fail(message: str, cause: BaseException | None = None) -> NoReturn:
    raise InputError(message) from cause


def say(message: str) -> None:
    """Print one line, however long; brackets in it are not markup."""
    CONSOLE.print(escape(printable(message)), soft_wrap=True)


def warn(message: str) -> None:
    CONSOLE.print(f"[bold yellow]{escape(printable(message))}", soft_wrap=True)


@contextmanager
def as_input_error() -> Iterator[None]:
    """Convert a CaptureError to an InputError."""
    try:
        yield
    except CaptureError as error:
        fail(str(error), error)


class _Console(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        (warn if record.levelno >= logging.WARNING else say)(record.getMessage())


_captures = logging.getLogger("bitymi_ns.capture")
_captures.addHandler(_Console())
_captures.setLevel(logging.INFO)
_captures.propagate = False

warn_once = functools.cache(warn)
