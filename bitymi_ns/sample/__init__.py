"""A small ray-traced room with exact cameras, written as a nerfstudio capture: the demo and end-to-end test scene."""

from .capture import generate

__all__ = ["generate"]
