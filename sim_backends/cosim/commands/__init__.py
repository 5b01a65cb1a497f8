"""The commands `fieldkit cosim ...`, as any package can add some (docs/add-a-command.md)."""
