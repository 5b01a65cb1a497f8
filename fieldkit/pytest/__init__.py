"""The pytest plugin: tests of robots' software on emulated or real robots (docs/pytest.md)."""
