"""Backends by name: those that are not installed, cannot be loaded, or lack their site file."""

from importlib.metadata import EntryPoint

import pytest

from fieldkit.backends.registry import load_backend
from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError


def test_no_site_file_and_an_unknown_backend_are_errors() -> None:
    with pytest.raises(ConfigurationError, match="needs a site file"):
        load_backend("field", None, None)
    with pytest.raises(ConfigurationError, match="no backend 'gazebo'") as caught:
        load_backend("gazebo", None, None)
    assert "emulated" in caught.value.remedy


def test_a_backend_that_cannot_be_loaded_names_its_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = EntryPoint("bench", "no_such_package:Bench", plugins.BACKENDS)
    monkeypatch.setattr(plugins, "entry_points", lambda *, group: [broken])
    with pytest.raises(ConfigurationError, match="No module named 'no_such_package'") as caught:
        load_backend("bench", None, None)
    assert caught.value.where == "entry point bench = no_such_package:Bench"
