"""The pytest plugin for tests of robot software on emulated or real robots (docs/pytest.md)."""
