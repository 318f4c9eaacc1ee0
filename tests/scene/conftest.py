"""Surfels and cameras shared with the tests of the bake."""

from tests.bake.conftest import camera, surfels

__all__ = ["camera", "surfels"]
