"""Metadata of installed packages that extend fieldkit, as pip writes it."""

from pathlib import Path


def write_package(folder: Path, name: str, entry_points: str, version: str = "1.0") -> None:
    """Write the metadata of a package to a folder of `sys.path`, as pip does."""
    metadata_folder = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    metadata_folder.mkdir(parents=True)
    metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n\nName: of its description\n"
    (metadata_folder / "METADATA").write_text(metadata, encoding="utf-8")
    (metadata_folder / "entry_points.txt").write_text(entry_points, encoding="utf-8")
