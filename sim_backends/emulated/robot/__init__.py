"""Inside of an emulated robot: its first process, file system, network and services."""
