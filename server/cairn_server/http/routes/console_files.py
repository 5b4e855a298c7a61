"""The operator's console as it was built: a handful of files, held in memory, each plain and gzipped.

server/console/ has the sources. Names of assets carry a digest of what they hold, so browsers keep them for ever; only
the page itself is asked for again.
"""

import gzip
import hashlib
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from cairn_map.errors import NotFoundError

STATIC = Path(str(files("cairn_server"))) / "static"
PAGE = "index.html"
MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}
NOT_BUILT = """<!doctype html><html lang="en"><meta charset="utf-8"><title>cairn</title><h1>cairn map server</h1>
<p>It runs, but its console is not built. In the folder with cairn's sources, where npm's packages can be had:</p>
<pre>make console</pre>
<p>and start the server again. Until then: <a href="maps">maps</a>, <a href="docs">routes</a>;
<code>cairn map ls</code> lists the maps in a terminal.</p></html>"""


@dataclass(frozen=True, slots=True)
class ConsoleFile:
    """One file of the page."""

    plain: bytes
    gzipped: bytes
    media_type: str
    etag: str


class ConsoleFiles:
    """The page and its assets by name; without a built console, a page that says how to build it."""

    def __init__(self, folder: Path = STATIC) -> None:
        paths = [path for path in (folder / "assets").glob("*") if path.suffix in MEDIA_TYPES]
        self._assets = {path.name: _file(path.read_bytes(), path.suffix) for path in paths}
        page = folder / PAGE
        self.page = _file(page.read_bytes() if page.exists() else NOT_BUILT.encode(), ".html")

    def asset(self, name: str) -> ConsoleFile:
        """A script, style or picture of the page.

        Raises:
            NotFoundError: kind `no_route`: the page has no such file; a page of an older version asks, perhaps.
        """
        if name not in self._assets:
            raise NotFoundError("no_route", f"the console has no file {name[:64]}; reload the page")
        return self._assets[name]


def _file(data: bytes, suffix: str) -> ConsoleFile:
    etag = f'"{hashlib.sha256(data).hexdigest()[:32]}"'
    return ConsoleFile(data, gzip.compress(data, 9, mtime=0), MEDIA_TYPES[suffix], etag)
