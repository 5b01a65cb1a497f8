"""Backends by name: errors for a backend that is not installed, cannot be loaded, or has no site file."""

from pathlib import Path

import pytest

from fieldkit.backends.registry import load_backend
from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError
from tests.helpers.outside_packages import write_package


def test_missing_site_file_and_unknown_backend_are_errors() -> None:
    with pytest.raises(ConfigurationError, match="needs a site file"):
        load_backend("field", None, None)
    with pytest.raises(ConfigurationError, match="no backend 'gazebo'") as error_info:
        load_backend("gazebo", None, None)
    assert "emulated" in error_info.value.remedy


def test_error_of_backend_that_cannot_be_loaded_names_entry_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_package(tmp_path, "bench", f"[{plugins.BACKENDS}]\nbench = no_such_package:Bench\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigurationError, match="No module named 'no_such_package'") as error_info:
        load_backend("bench", None, None)
    assert error_info.value.where == "entry point bench = no_such_package:Bench of bench 1.0"
