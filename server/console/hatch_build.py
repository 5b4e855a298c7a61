"""Hatchling's hook: wheels and source archives of cairn carry the built console.

A source archive has the page in it, so installing from one needs neither Node nor npm. A wheel of sources without the
page, where npm's packages cannot be had, is made without it: the server runs, and says at / how to get its page. An
editable install is left alone: there the page is built by `make`, or by build_console.py. CAIRN_SKIP_CONSOLE=1
installs without a page.
"""

import os
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

sys.path.insert(0, str(Path(__file__).resolve().parent))
import build_console  # type: ignore[import-not-found, unused-ignore]


class ConsoleHook(BuildHookInterface[Any]):
    """Builds the page before files are gathered."""

    def dependencies(self) -> list[str]:
        """Node, if there is something to build."""
        return [build_console.NODE_WHEEL] if self._is_needed("") else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the page, unless it is there; a wheel goes on without it where that takes what cannot be had.

        Raises:
            BuildError: sources that do not compile, or a source archive without the page.
        """
        if not self._is_needed(version):
            return
        try:
            build_console.build()
        except build_console.NoToolsError as exc:
            if self.target_name != "wheel":
                raise
            self.app.display_warning(f"without the operator's page, all else is there: {exc}")

    def _is_needed(self, version: str) -> bool:
        skipped = os.environ.get("CAIRN_SKIP_CONSOLE", "0") != "0"
        return version != "editable" and not skipped and not build_console.is_built()
