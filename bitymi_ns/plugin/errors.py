"""How the nerfstudio commands report what a user can put right: one clear message, no traceback, exit status 1."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from bitymi_ns.trust import printable


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


def listed(names: Sequence[object], most: int = 3) -> str:
    """The first few names, and how many more there are."""
    shown = ", ".join(str(name) for name in names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"
