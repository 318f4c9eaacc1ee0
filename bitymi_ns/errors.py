"""Errors of more than one layer."""


class KernelsUnavailable(RuntimeError):
    """The compiled kernels are missing or do not run on this machine; the message says what to do."""
