"""Hatchling's hook: wheels and source archives of cairn carry the built console.

A source archive has the page in it, so installing from one needs neither Node nor npm. An editable install is left
alone: there the page is built by `make`, or by build_console.py. CAIRN_SKIP_CONSOLE=1 installs without a page.
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
        """Build the page, unless it is there."""
        if self._is_needed(version):
            build_console.build()

    def _is_needed(self, version: str) -> bool:
        skipped = os.environ.get("CAIRN_SKIP_CONSOLE", "0") != "0"
        return version != "editable" and not skipped and not build_console.is_built()
