"""The commands `fieldkit cosim ...`. Other packages can add commands in the same way (docs/add-a-command.md)."""
