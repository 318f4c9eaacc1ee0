"""Photographs or a video in, camera poses out: `poses.find_poses`, and `known_poses.triangulate` for known poses."""

import ctypes
import signal
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pycolmap as pycolmap


def __getattr__(name: str) -> Any:
    """Import `pycolmap` when it is first wanted, with the process's signal handlers kept: its import has SIGTERM, and
    whatever ends a process by a fault, print a native stack."""
    if name != "pycolmap":
        raise AttributeError(name)
    sigaction, kept = ctypes.CDLL(None).sigaction, ctypes.create_string_buffer(256)  # larger than struct sigaction
    handlers = [(each, kept.raw) for each in signal.valid_signals() if sigaction(int(each), None, kept) == 0]
    import pycolmap

    for each, handler in handlers:
        sigaction(int(each), handler, None)
    return globals().setdefault(name, pycolmap)
