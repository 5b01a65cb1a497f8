"""The figures of a report as files for papers."""

from collections.abc import Iterator
from pathlib import Path

from fieldkit.core import files
from fieldkit.report import figures
from fieldkit.report.contents import Contents


def write(contents: Contents, folder: Path) -> Iterator[Path]:
    """Write every chart of a report in each format, yielding the files.

    Args:
        contents: The report.
        folder: Where to; it is there.

    Raises:
        OSError: A file cannot be written.
    """
    for section in contents.sections:
        for chart in section.charts:
            for form in figures.FORMATS:
                path = folder / f"{chart.name}.{form}"
                files.write(path, figures.paper(chart, form))
                yield path
