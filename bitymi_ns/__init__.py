"""Textured Beta-surfel splatting: a nerfstudio method."""

__version__ = "0.1.0"


class KernelsUnavailable(RuntimeError):
    """The compiled kernels are missing, or not for this machine; the message says what to do."""
