"""What each command takes: a module of its name, whose `add` gets its parser. Nothing here imports what runs it.

`run` of the parsed arguments names the function that runs it: `trial:run` is `run` of `fieldkit.cli.commands.trial`.
"""
