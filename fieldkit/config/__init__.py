"""Configuration in YAML: strict schemas, catalogs of files by name, robot profiles and site files."""

import os

# Set before the import of pydantic, which otherwise searches all installed packages for plugins and takes 25 ms.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
