"""The surfels and cameras that the tests of the bake have, too."""

from tests.bake.conftest import camera, surfels

__all__ = ["camera", "surfels"]
