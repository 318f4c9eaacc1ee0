"""Bundles in a browser: a local server, and export to a folder for any web server. The page is built from `web/`."""

from .page import PageError, Site, single_site, site_of, write_static
from .serve import address_of, is_loopback, serve

__all__ = ["PageError", "Site", "address_of", "is_loopback", "serve", "single_site", "site_of", "write_static"]
