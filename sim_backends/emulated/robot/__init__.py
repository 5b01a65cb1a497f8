"""Inside of an emulated robot: its init process, file system, network and services."""
