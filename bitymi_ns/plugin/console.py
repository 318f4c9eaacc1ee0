"""Console messages: errors without a traceback, warnings, a step bar."""

import functools
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from bitymi_ns.capture.types import CaptureError
from bitymi_ns.endings import INTERRUPTED as INTERRUPTED
from bitymi_ns.trust import listed as listed
from bitymi_ns.trust import printable


@contextmanager
def step_bar(done: int, total: int) -> Iterator[Callable[[int], None]]:
    """A progress bar below whatever else is printed; nothing where the output is not a terminal.

    Returns:
        What is to be called with the index of every finished step.
    """
    columns = (TextColumn("step"), MofNCompleteColumn(), BarColumn(), TimeRemainingColumn())
    terminal = CONSOLE.is_terminal
    with Progress(*columns, console=CONSOLE, refresh_per_second=2, transient=True, disable=not terminal) as bar:
        task = bar.add_task("", completed=done, total=total)
        yield lambda step: bar.update(task, completed=step + 1)


class InputError(SystemExit):
    """Something about the input is wrong. Python prints the message to stderr and exits with status 1.

    A SystemExit rather than an Exception: nerfstudio's commands have no error handling of their own, and a traceback
    through them hides what the user can do about it.
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(f"bitymi: {message}"))

    def __str__(self) -> str:
        return str(self.code)


def fail(message: str, cause: BaseException | None = None) -> NoReturn:
    """Raise InputError(message), remembering `cause` for debuggers."""
    raise InputError(message) from cause


def say(message: str) -> None:
    """Tell the user something, in one line however long it is; brackets in it are no markup."""
    CONSOLE.print(escape(printable(message)), soft_wrap=True)


def warn(message: str) -> None:
    """Tell the user about something that goes on without what it should have had."""
    CONSOLE.print(f"[bold yellow]{escape(printable(message))}", soft_wrap=True)


@contextmanager
def as_input_error() -> Iterator[None]:
    """End with one line where a capture cannot be used; also a decorator."""
    try:
        yield
    except CaptureError as error:
        fail(str(error), error)


class _Console(logging.Handler):
    """Prints what the reading of captures reports."""

    def emit(self, record: logging.LogRecord) -> None:
        (warn if record.levelno >= logging.WARNING else say)(record.getMessage())


_captures = logging.getLogger("bitymi_ns.capture")
_captures.addHandler(_Console())
_captures.setLevel(logging.INFO)
_captures.propagate = False

warn_once = functools.cache(warn)  # the same message only once in a process
