"""What `fieldkit completion` takes."""

from typing import Final

from fieldkit.cli.parser import Parser

SHELLS: Final = ("bash", "zsh", "fish")


def add(parser: Parser) -> None:
    """Declare what `fieldkit completion` takes."""
    parser.description = (
        "Print a script that completes commands, options, robots, procedures and trials by the Tab key."
    )
    parser.epilog = (
        'in ~/.bashrc or ~/.zshrc: eval "$(fieldkit completion bash)", or zsh; '
        "in ~/.config/fish/config.fish: fieldkit completion fish | source"
    )
    parser.add_choice("shell", SHELLS, metavar="SHELL", help=f"one of: {', '.join(SHELLS)}")
    parser.set_defaults(run="completion:run")
