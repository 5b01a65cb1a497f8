"""Configuration in YAML: strict schemas, catalogs of files by name, robot profiles and site files."""

import os

# Set before the import of pydantic, which otherwise searches the files of all installed packages for plugins: 25 ms.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
