"""Text that somebody else wrote, made fit to be shown."""


def harmless(text: str) -> str:
    """Return `text` without what moves a cursor, rings, colours, or turns the direction of writing: each a `?`.

    Line ends and no-break spaces stay.
    """
    return "".join(char if char.isprintable() or char in "\n\N{NO-BREAK SPACE}" else "?" for char in text)


def encodable(text: str) -> str:
    """Return `text` as a file takes it: a `?` for each half of a surrogate pair, as names that are no UTF-8 hold."""
    return text.encode(errors="replace").decode()
