"""Photographs or a video in, camera poses out."""

from bitymi_ns.capture.known import KnownView, triangulate
from bitymi_ns.capture.poses import find_poses
from bitymi_ns.capture.types import CaptureError, Poses, Progress, SfmOptions

__all__ = ["CaptureError", "KnownView", "Poses", "Progress", "SfmOptions", "find_poses", "triangulate"]
