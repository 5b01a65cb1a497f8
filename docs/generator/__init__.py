"""Write the reference pages, `docs/reference/*.md`, from the code: `python -m docs.generator`."""
