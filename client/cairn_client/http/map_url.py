"""URL of a map: `http://HOST:PORT/maps/NAME`; of one of its layers `http://HOST:PORT/maps/NAME.LAYER`."""

from urllib.parse import urlsplit

from cairn_map.commits.ids import map_name, map_of_layer
from cairn_map.epochs.layer import EVIDENCE
from cairn_map.errors import BadInputError


def split_map_url(map_url: str) -> tuple[str, str]:
    """Server and map, or layer, of `http://HOST:PORT/maps/NAME`.

    Raises:
        BadInputError: it is not of that form.
    """
    try:
        parts = urlsplit(map_url)
        is_host = bool(parts.hostname) and parts.port != 0  # reading the port checks it
    except ValueError:
        parts, is_host = urlsplit(""), False
    head, _, name = parts.path.rstrip("/").rpartition("/maps/")
    if parts.scheme not in ("http", "https") or not is_host or not name or "/" in name:
        raise BadInputError("bad_url", f"a map's URL is http://HOST:PORT/maps/NAME, got {map_url[:200]!r}")
    return f"{parts.scheme}://{parts.netloc}{head}", map_name(name)


def layer_url(map_url: str, layer: str) -> str:
    """URL of a layer of a map, by the map's URL; that of `evidence` is the map's own.

    Raises:
        BadInputError: kind `bad_option`: the URL is that of a layer already; or it is none, or the name cannot be.
    """
    server_url, name = split_map_url(map_url)
    if map_of_layer(name) is not None:
        raise BadInputError("bad_option", f"{map_url} has one layer: to name another, take the map's own URL")
    return f"{server_url}/maps/{name if layer == EVIDENCE else map_name(f'{name}.{layer}')}"
