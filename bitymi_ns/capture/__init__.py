"""Photographs or a video in, camera poses out.

What finds poses is loaded when it is asked for: it brings COLMAP and the decoders of videos, half a second that the
command line and those who only recognise a capture need not wait for.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from bitymi_ns.capture.types import CaptureError, Poses, SfmOptions, SfmSettings
from bitymi_ns.progress import Progress

if TYPE_CHECKING:
    from bitymi_ns.capture.known import KnownView, triangulate
    from bitymi_ns.capture.poses import find_poses

__all__ = ["CaptureError", "KnownView", "Poses", "Progress", "SfmOptions", "SfmSettings", "find_poses", "triangulate"]

_LATER = {"KnownView": "known", "triangulate": "known", "find_poses": "poses"}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LATER[name]}"), name)
