"""Small scenes of the bake's tests."""

from tests.bake.conftest import camera, scene, surfels

__all__ = ["camera", "scene", "surfels"]
