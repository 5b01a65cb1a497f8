"""The commands `fieldkit cosim ...`; any package can add commands in this way (docs/add-a-command.md)."""
