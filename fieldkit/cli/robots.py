"""`fieldkit robots`: list robot profiles, or show one."""

from fieldkit.cli import listing
from fieldkit.config.profiles import load_profile


def add(commands: listing.Commands) -> None:
    """Add the subcommand."""
    listing.add(commands, "robots", load_profile, "robot profile")
