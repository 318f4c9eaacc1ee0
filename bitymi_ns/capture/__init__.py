"""Photographs or a video in, camera poses out."""

from bitymi_ns.capture.known import KnownView, triangulate
from bitymi_ns.capture.poses import find_poses
from bitymi_ns.capture.types import CaptureError, Poses, SfmOptions
from bitymi_ns.progress import Progress

__all__ = ["CaptureError", "KnownView", "Poses", "Progress", "SfmOptions", "find_poses", "triangulate"]
