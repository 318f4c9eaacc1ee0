"""Textured Beta-surfel splatting: a nerfstudio method."""

__version__ = "0.1.0"
