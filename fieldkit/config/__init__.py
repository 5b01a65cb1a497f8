"""Configuration in YAML: strict schemas, catalogs of files by name, robot profiles and site files."""
