"""Build the documentation site into the wheel, as `fieldkit/data/docs/`, which `fieldkit docs` opens."""

import shutil
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class DocumentationHook(BuildHookInterface):
    """Runs mkdocs, except for an editable installation, for which `fieldkit docs` shows the pages of the checkout."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the site, and add it to the files of the wheel."""
        self._site: Path | None = None
        if version == "editable":
            return
        from mkdocs.commands.build import build  # noqa: PLC0415 (an editable installation does not need it)
        from mkdocs.config import load_config  # noqa: PLC0415 (as above)

        self._site = Path(tempfile.mkdtemp(prefix="fieldkit-docs-"))
        config = load_config(str(Path(self.root) / ".ci" / "mkdocs.yml"), site_dir=str(self._site), strict=True)
        config.plugins.on_startup(command="build", dirty=False)
        build(config)
        for path in self._site.rglob("*.map"):
            path.unlink()  # source maps of scripts, needed only by developers of the theme
        build_data["force_include"][str(self._site)] = "fieldkit/data/docs"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:  # noqa: ARG002 (set by hatch)
        """Remove the built site."""
        if self._site is not None:
            shutil.rmtree(self._site)
