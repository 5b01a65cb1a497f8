"""`fieldkit procedures`: list procedures, or show one."""

from fieldkit.cli import listing
from fieldkit.trial.procedure import load_procedure


def add(commands: listing.Commands) -> None:
    """Add the subcommand."""
    listing.add(commands, "procedures", load_procedure, "procedure")
