"""Colours, markers and lines of all figures and of the HTML report, in a light and a dark theme.

Series use the colours of Okabe and Ito (2008, Color Universal Design), which colour-blind people can distinguish.
Each colour has a marker, so that no series is identified by colour alone. In the dark theme colours are lighter.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal

from fieldkit.core.errors import ConfigurationError

Colour = Literal["ink", "muted", "grid", "paper", "blue", "red", "green", "pink", "orange", "sky", "lost", "void"]
Marker = Literal["o", "s", "^", "D", "v", "P", "x", "|", ""]
Line = Literal["solid", "dashed", "dotted", "dashdot", "none"]

LIGHT: Final[Mapping[Colour, str]] = MappingProxyType(
    {
        "ink": "#1b1f24",
        "muted": "#57606a",
        "grid": "#d5dae0",
        "paper": "#ffffff",
        "blue": "#0072b2",
        "red": "#d55e00",
        "green": "#009e73",
        "pink": "#cc79a7",
        "orange": "#e69f00",
        "sky": "#56b4e9",
        "lost": "#b3261e",
        "void": "#8a6d00",
    }
)
DARK: Final[Mapping[Colour, str]] = MappingProxyType(
    {
        "ink": "#e8ebef",
        "muted": "#a3adb8",
        "grid": "#39424d",
        "paper": "#14181d",
        "blue": "#4aa8e0",
        "red": "#f08a3c",
        "green": "#2fc49a",
        "pink": "#df9cc0",
        "orange": "#f0b840",
        "sky": "#8fd0f5",
        "lost": "#ff7b72",
        "void": "#e3c04b",
    }
)


Format = Literal["svg", "pdf", "png"]
FORMATS: Final[tuple[Format, ...]] = ("svg", "pdf", "png")

SETTINGS: Final[dict[Any, Any]] = {
    "axes.edgecolor": LIGHT["muted"],
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.labelcolor": LIGHT["ink"],
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlecolor": LIGHT["ink"],
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "font.family": "DejaVu Sans",
    "grid.color": LIGHT["grid"],
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "pdf.fonttype": 42,  # TrueType, because IEEE accepts no Type 3 fonts
    "savefig.dpi": 300,
    "svg.fonttype": "none",  # text remains text, not paths
    "svg.hashsalt": "fieldkit",  # a fixed salt gives equal ids in each run
    "text.color": LIGHT["ink"],
    # Names from evidence must not be parsed as formulas.
    "text.parse_math": False,
    "xtick.color": LIGHT["muted"],
    "xtick.labelcolor": LIGHT["ink"],
    "ytick.color": LIGHT["muted"],
    "ytick.labelcolor": LIGHT["ink"],
}
"""Settings of matplotlib, without font sizes."""

# The files contain neither date nor version, so that equal figures give equal files.
METADATA: Final[dict[Format, dict[str, None]]] = {
    "svg": dict.fromkeys(("Date", "Creator", "Format", "Type")),
    "pdf": dict.fromkeys(("CreationDate", "Creator", "Producer")),
    "png": {"Software": None},
}
"""Metadata of files, by format."""


def format_of(path: Path, option: str) -> Format:
    """Return the format of a figure by the suffix of its file name.

    Args:
        path: The file.
        option: The option with which the user gave the path, for the message.

    Raises:
        ConfigurationError: The suffix is not one of `FORMATS`.
    """
    for file_format in FORMATS:
        if path.suffix == f".{file_format}":
            return file_format
    raise ConfigurationError(
        f"{option}: the suffix of {path.name!r} is unknown", remedy=f"use the suffix .{', .'.join(FORMATS)}"
    )


@dataclass(frozen=True)
class Style:
    """Colour, marker and line of a series.

    Attributes:
        colour: Colour of line and markers.
        marker: Shape of the markers; empty for none.
        line: Type of line; the markers of a broken line are hollow.
    """

    colour: Colour
    marker: Marker = ""
    line: Line = "solid"

    @property
    def is_hollow(self) -> bool:
        """True if the markers are not filled."""
        return self.line not in {"solid", "none"}


CYCLE: Final[tuple[tuple[Colour, Marker], ...]] = (
    ("blue", "o"),
    ("red", "s"),
    ("green", "^"),
    ("pink", "D"),
    ("orange", "v"),
    ("sky", "P"),
)
"""Colours and markers of series. The first belongs to the scenario with line of sight, the second to the scenario
without line of sight; the others are assigned to further procedures."""

LINES: Final[tuple[Line, ...]] = ("solid", "dashed", "dotted", "dashdot")
"""Lines of backends, in order: the field backend, if there is one, has the first."""

_NAME_BY_HEX: Final = {value: name for name, value in LIGHT.items()}
_HEX: Final = re.compile("|".join(_NAME_BY_HEX))


def use_variables(css: str) -> str:
    """Return CSS with each colour of the light theme replaced by the page's variable."""
    return _HEX.sub(lambda match: f"var(--{_NAME_BY_HEX[match[0]]})", css)


def variables(colours: Mapping[Colour, str]) -> str:
    """Return the CSS that sets the page's variables to these colours."""
    return "".join(f"--{name}:{value};" for name, value in colours.items())


SHAPES: Final[Mapping[Marker, str]] = MappingProxyType(
    {
        "o": "M-3 0a3 3 0 1 0 6 0a3 3 0 1 0-6 0z",
        "s": "M-3-3h6v6h-6z",
        "^": "M0-3.5L3.5 3h-7z",
        "D": "M0-4L4 0L0 4L-4 0z",
        "v": "M0 3.5L3.5-3h-7z",
        "P": "M-1-3.5h2v2.5h2.5v2h-2.5v2.5h-2v-2.5h-2.5v-2h2.5z",
        "x": "M-3-3L3 3M-3 3L3-3",
        "|": "M0-4V4",
        "": "",
    }
)
"""Markers as SVG paths around (0, 0), for legends."""

DASHES: Final[Mapping[Line, str]] = MappingProxyType(
    {"none": "0 99", "solid": "none", "dashed": "5 2", "dotted": "1.5 2", "dashdot": "6 2 1.5 2"}
)
"""Lines as SVG dash patterns, for legends."""
