"""Bundles and captures to be opened by other programs."""

from tests.bake.conftest import surfels
from tests.capture.conftest import arc, pictures, views
from tests.interchange.conftest import bundle
from tests.view.conftest import bundle as page_bundle

__all__ = ["arc", "bundle", "page_bundle", "pictures", "surfels", "views"]
