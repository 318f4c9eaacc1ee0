"""Console messages: errors without a traceback, warnings, a step bar; filtering of nerfstudio's own lines."""

import functools
import logging
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

import rich
from nerfstudio.utils.rich_utils import CONSOLE
from rich.errors import MarkupError
from rich.markup import escape
from rich.panel import Panel
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from bitymi_ns.capture.types import CaptureError
from bitymi_ns.endings import INTERRUPTED as INTERRUPTED
from bitymi_ns.trust import listed as listed
from bitymi_ns.trust import printable

REMARKS = re.compile(
    r"Saving config to|Saving checkpoints to"  # our summary of the run says where
    r"|Mixed precision is disabled|Auto image downscale factor of 1$"
    r"|\[NOTE\] Not running eval iterations"  # the training curve is of held-out views
    r"|\[bold yellow\]Disabled comet|disabled local writer"
)
"""Beginnings of the lines that are dropped. Everything else is shown: it may be about the capture."""


@contextmanager
def filter_console() -> Iterator[None]:
    """Drop these lines, the box in which the viewer's server states its address, and torch's
    warnings about nerfstudio's code. Afterwards all is as before: other methods are not concerned."""

    def remark(said: Any) -> bool:
        return isinstance(said, str) and REMARKS.match(said) is not None

    def box(said: Any) -> bool:
        return isinstance(said, Panel) and "viser" in str(said.title)

    with (
        ignore_torch_warnings(),
        _dropping(CONSOLE, "print", remark),
        _dropping(CONSOLE, "log", remark, _stack_offset=2),  # it states its caller
        _dropping(rich, "print", box),
    ):
        yield


@contextmanager
def ignore_torch_warnings() -> Iterator[None]:
    """Ignore torch's warnings about nerfstudio's code: no user can act on them."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=FutureWarning, module="nerfstudio")
        warnings.filterwarnings("ignore", "Converting a tensor with requires_grad", UserWarning, module="nerfstudio")
        yield


@contextmanager
def _dropping(owner: Any, name: str, dropped: Callable[[Any], bool], **always: Any) -> Iterator[None]:
    """Have the function `name` of `owner` do nothing where `dropped` holds for its first argument."""
    write = getattr(owner, name)

    def filtered(*said: Any, **options: Any) -> None:
        if said and dropped(said[0]):
            return
        try:
            write(*said, **{**always, **options})
        except MarkupError:  # brackets in a path
            write(*map(escape, map(str, said)), **{**always, **options})

    setattr(owner, name, filtered)
    try:
        yield
    finally:
        setattr(owner, name, write)


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
_captures.handlers, _captures.propagate = [_Console()], False
_captures.setLevel(logging.INFO)

warn_once = functools.cache(warn)  # the same message only once in a process
