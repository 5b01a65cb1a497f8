"""`fieldkit positions TRIAL [ROLE=FILE ...]`: where robots really stood, from who walked with them."""

import argparse

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.units import parse_duration_s
from fieldkit.trial import positions
from fieldkit.trial.positions import Spotted


def run(arguments: argparse.Namespace) -> int:
    """Keep what is given, and print who tells where robots were in each repeat, and how far apart."""
    told = dict(map(positions.told, arguments.told))
    if told or arguments.clear:
        if told and arguments.clear:
            raise ConfigurationError("--clear forgets what was given", remedy="leave it out to give others instead")
        rebuilt = positions.give(
            arguments.trial,
            told,
            offset_s=_offset_s(arguments.offset),
            gap_s=parse_duration_s(arguments.gap),
            heights=arguments.heights,
        )
        print(f"changed: {', '.join(rebuilt.changed)}" if rebuilt.changed else "the same bytes as before")
    for spotted in positions.spotted(arguments.trial):
        for line in _lines(spotted):
            print(line)
    return 0


def _offset_s(text: str) -> float:
    text = text.strip()
    offset_s = parse_duration_s(text.removeprefix("-"))
    return -offset_s if text.startswith("-") else offset_s


def _lines(one: Spotted) -> list[str]:
    """Return what is known of an attempt, a line per figure."""
    who = one.told_by or "as the lab knows"
    found = [
        f"{one.attempt}  {what}: {least:.1f} to {most:.1f} m, {who}"
        for what, (least, most) in one.distances_m.items()
    ]
    return found + [f"{one.attempt}  {what}: no distance, {why}" for what, why in one.missing.items()]
