"""Code that runs inside an emulated robot: init process, file system, network and services."""
