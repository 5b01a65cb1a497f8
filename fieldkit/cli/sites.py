"""Find the site file for a command line. This module imports little, because some commands must start quickly."""

import argparse
from pathlib import Path
from typing import Final

from fieldkit.config.locations import SITE_FILE
from fieldkit.config.schema import Document
from fieldkit.config.site import Site, load_site

DEFAULT_BACKEND: Final = "emulated"


def lab_site(arguments: argparse.Namespace) -> tuple[Site, Document] | tuple[None, None]:
    """Return the site file that the options choose, with its document, or None for both without a site file.

    Raises:
        ConfigurationError: For the same reasons as `load_site`.
    """
    path: Path | None = arguments.site
    if path is None and Path(SITE_FILE).is_file():
        path = Path(SITE_FILE)
    return (None, None) if path is None else load_site(path)


def backend_name(arguments: argparse.Namespace, site: Site | None) -> str:
    """Return the name of the backend that the options or the site file choose."""
    name: str | None = arguments.backend
    if name is not None:
        return name
    return DEFAULT_BACKEND if site is None else site.backend
