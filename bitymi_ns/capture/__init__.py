"""Photographs or a video in, camera poses out: `poses.find_poses`, and `known_poses.triangulate` for known poses."""

import ctypes
import signal
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pycolmap as pycolmap


def __getattr__(name: str) -> Any:
    """Import `pycolmap` on first use and restore the signal handlers: its own print a native stack, also at SIGTERM."""
    if name != "pycolmap":
        raise AttributeError(name)
    sigaction, kept = ctypes.CDLL(None).sigaction, ctypes.create_string_buffer(256)  # larger than struct sigaction
    handlers = [(number, kept.raw) for number in signal.valid_signals() if sigaction(int(number), None, kept) == 0]
    import pycolmap

    for number, handler in handlers:
        sigaction(int(number), handler, None)
    return globals().setdefault(name, pycolmap)
