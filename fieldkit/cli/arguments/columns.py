"""What `fieldkit columns` takes."""

from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare what `fieldkit columns` takes."""
    parser.usage = "%(prog)s [-h] [PROCEDURE | show NAME]"
    parser.description = "What every column of the CSVs means: all, those that the steps of a procedure fill, or one."
    parser.add_argument("filled", metavar="PROCEDURE", nargs="?", help="a procedure, or its file, or the word show")
    parser.add_argument("column", metavar="NAME", nargs="?", help="after the word show: name of a column")
    parser.set_defaults(run="catalog:columns")
