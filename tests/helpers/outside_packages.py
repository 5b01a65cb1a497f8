"""Packages that are installed beside fieldkit, as far as pip's files tell of them."""

from pathlib import Path


def write_package(folder: Path, name: str, entry_points: str, version: str = "1.0") -> None:
    """Write what pip writes beside a package, in a folder of `sys.path`."""
    about = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    about.mkdir(parents=True)
    said = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n\nName: of its description\n"
    (about / "METADATA").write_text(said, encoding="utf-8")
    (about / "entry_points.txt").write_text(entry_points, encoding="utf-8")
