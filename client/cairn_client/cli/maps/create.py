"""`cairn map create`: a new map, empty or from prior data: a folder of cells, or another map.

Prior data are the map's first commits, of author `initial`. They are commits like any other: every robot gets them by
ordinary sync, and a retract takes them out again. They state no time, so they are older than every epoch.
"""

import argparse
import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from cairn_client.cli.arguments import (
    EPOCH_HELP,
    NO_EPOCHS,
    Subparsers,
    add_map_parser,
    api_of,
    channels_from_text,
    epoch_s_from_text,
    say,
    shown_length,
)
from cairn_client.cli.maps.map_export import fetch_map
from cairn_client.http.api import MapApi
from cairn_client.http.origin_tokens import NO_TOKENS, OriginTokens
from cairn_map.codec.cell_code import DecodedCell, cell_digest
from cairn_map.codec.history_code import DecodedHistory
from cairn_map.commits.commit import Commit, CommitMeta, make_commit
from cairn_map.commits.ids import INITIAL, Author, CommitId, Incarnation
from cairn_map.epochs.epoch import STANDARD_EPOCH_S
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import STANDARD_CHANNELS, Channel
from cairn_map.evidence.grid import Geometry, geometry_for
from cairn_map.files.cell_folder import FolderHead, read_cells, read_head
from cairn_map.wire.messages import CreateMap, MapInfo

CELLS_A_COMMIT = 16
"""Cells of prior data in one commit, which stays far below a commit's largest size."""
CHECKED = CommitId(Author(INITIAL, Incarnation("0" * 16)), 0)
"""Id of the commits that are only made to see that they can be."""
FILE_KINDS = {
    **dict.fromkeys((".bt", ".ot"), "an OctoMap octree"),
    **dict.fromkeys((".ply", ".pcd", ".las", ".laz", ".xyz"), "a point cloud"),
    **dict.fromkeys((".npz", ".npy"), "a file of NumPy arrays"),
    **dict.fromkeys((".bag", ".db3", ".mcap"), "a bag"),
    ".cell": "one cell of a map",
    ".view": "the view of one cell",
}
"""Kinds of files that one may take for a map, by their suffix."""
VOXEL_M = 0.04


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand."""
    create = add_map_parser(commands, "create", _create, text="create a map, empty or from prior data")
    create.add_argument("--voxel", type=float, metavar="METRES", help=f"voxel edge ({VOXEL_M:g}, or that of --from)")
    create.add_argument(
        "--channels", help="colour,intensity,temperature, or those of --from; scalars as NAME:UNIT:STEP; '' for none"
    )
    text = f"{EPOCH_HELP} ({STANDARD_EPOCH_S}, or that of --from)"
    create.add_argument("--epoch", metavar=f"SECONDS|{NO_EPOCHS}", help=text)
    create.add_argument("--from", dest="source", metavar="DIR|URL", help="folder of cells, or another map's URL")


def _create(args: argparse.Namespace) -> int:
    tokens = args.token.bound_to(args.map)
    api, name = api_of(args.map, tokens)
    if args.source is not None:
        # A grid that is asked for as well has to be the source's: evidence cannot be moved to another one.
        asked = _Asked(args.voxel, None if args.channels is None else channels_from_text(args.channels), args.epoch)
        with api:
            info, count, added = push_prior_data(
                api, name, args.source, tokens=tokens, check=asked.check, epoch_s=asked.epoch_s
            )
        say_map(info)
        say(f"started from {args.source}: {count} cells, as the commit of author `initial`")
        if added < count:
            say(f"{count - added} of them were pushed before, and are not added again (nor if they were retracted)")
        return 0
    with api:
        made = api.create_map(name, CreateMap(geometry=_geometry(args), epoch_s=epoch_s_from_text(args.epoch)))
    say_map(made)
    return 0


def say_map(info: MapInfo) -> None:
    """Write a line about a map: its voxels, cells, channels and epochs."""
    geometry = info.geometry
    names = ", ".join(channel.name for channel in geometry.channels) or "none but occupancy"
    epochs = "" if info.epoch_s is None else f", epochs of {info.epoch_s} s"
    say(
        f"map {info.name}: voxels of {shown_length(geometry.voxel_edge_m)}, "
        f"cells of {geometry.cell_edge_m:g} m, channels {names}{epochs}"
    )


def push_prior_data(
    api: MapApi,
    name: str,
    source: str,
    *,
    tokens: OriginTokens = NO_TOKENS,
    check: Callable[[Geometry], None] = lambda _: None,
    epoch_s: Callable[[int | None], int | None] = lambda source: source,
) -> tuple[MapInfo, int, int]:
    """Create a map with the grid and the evidence of a folder or another map; returns it, the
    count of cells, and how many of them were added.

    A source that is a URL is read with the token that `tokens` has for its server. It may be repeated after a cut
    link: evidence that is there already is not added again. `check` may refuse the source's grid, before anything
    is made. `epoch_s` is the length of the new map's epochs, of that of the source: the evidence comes as one sum
    without a time, which fits any.

    Raises:
        BadInputError: the source is neither a folder of cells nor a map's URL.
        ConflictError: the map exists with another grid.
    """
    head, cells = _open(source, tokens)
    check(head.geometry)
    wanted = CreateMap(geometry=head.geometry, sensor_model=head.sensor_model, epoch_s=epoch_s(head.epoch_s))
    api.create_map(name, wanted)
    count = added = 0
    author: Author | None = None
    for n, group in enumerate(_groups(cells)):
        author = author or Author(INITIAL, _incarnation(group))
        pushed = api.push(name, _commit(CommitId(author, n), group, head.geometry))
        count += len(group)
        added += len(group) if pushed.state == "new" else 0
    return api.map_info(name), count, added


def _open(source: str, tokens: OriginTokens) -> tuple[FolderHead, Iterable[DecodedCell]]:
    if "://" not in source:
        folder = Path(source)
        _check_folder(folder)
        head = read_head(folder)
        # All of it is read before the map is made: a damaged file must not leave a part of a map behind.
        for group in _groups(_totals(read_cells(folder, head.layer))):
            try:
                _commit(CHECKED, group, head.geometry)
            except BadInputError as exc:
                raise BadInputError(exc.kind, f"{folder}: {exc.message}") from exc
        return head, _totals(read_cells(folder, head.layer))
    api, name = api_of(source, tokens)
    info = api.map_info(name)
    head = FolderHead(geometry=info.geometry, sensor_model=info.sensor_model, epoch_s=info.epoch_s)
    return head, _fetched(api, info)


def _check_folder(folder: Path) -> None:
    """Refuse a source that is a file, of a map's or another program's, by its kind.

    Raises:
        BadInputError: kind `no_map_folder`.
    """
    if folder.is_dir() or not folder.exists():
        return
    kind = FILE_KINDS.get(folder.suffix.lower(), "a file")
    raise BadInputError(
        "no_map_folder",
        f"{folder} is {kind}, from which no evidence can be taken: --from takes a folder that `cairn map export "
        "--cells DIR` wrote, or another map's URL; scans with poses become a map by `cairn robot replay`",
    )


def _fetched(api: MapApi, info: MapInfo) -> Iterator[DecodedCell]:
    with api:
        yield from _totals(cell for _, cell in fetch_map(api, info))


def _totals(cells: Iterable[DecodedHistory]) -> Iterator[DecodedCell]:
    """Sums over all epochs: prior data are of no time, and a new map begins without the history of the old one."""
    for cell in cells:
        geometry = cell.layer.geometry
        evidence = cell.history.total(geometry)
        digest = cell.digest if not cell.layer.has_epochs else cell_digest(cell.key, evidence, geometry)
        yield DecodedCell(cell.key, geometry, evidence, digest)


def _groups(cells: Iterable[DecodedCell]) -> Iterator[list[DecodedCell]]:
    group: list[DecodedCell] = []
    for cell in cells:
        if len(cell.evidence):
            group.append(cell)
        if len(group) == CELLS_A_COMMIT:
            yield group
            group = []
    if group:
        yield group


def _incarnation(cells: list[DecodedCell]) -> Incarnation:
    """An incarnation that follows from the first commit's evidence, so that doing it again adds nothing."""
    return Incarnation(hashlib.sha256(b"".join(cell.digest for cell in cells)).hexdigest()[:16])


def _commit(commit: CommitId, cells: list[DecodedCell], geometry: Geometry) -> Commit:
    meta = CommitMeta(id=str(commit), geometry=geometry.digest().hex(), note="prior data")
    return make_commit(meta, {cell.key: cell.evidence for cell in cells}, geometry)


@dataclass(frozen=True, slots=True)
class _Asked:
    """Grid and epochs that were asked for, as far as they were."""

    voxel_edge_m: float | None
    channels: tuple[Channel, ...] | None
    epoch: str | None

    def epoch_s(self, source_s: int | None) -> int | None:
        """Length of an epoch, seconds: that which was asked for, else the source's."""
        return epoch_s_from_text(self.epoch, otherwise=source_s)

    def check(self, found: Geometry) -> None:
        """Refuse another grid than was asked for.

        Raises:
            BadInputError: kind `other_geometry`.
        """
        is_other_edge = self.voxel_edge_m is not None and round(self.voxel_edge_m * 1e6) != found.voxel_edge_um
        if is_other_edge or (self.channels is not None and self.channels != found.channels):
            raise BadInputError(
                "other_geometry",
                f"the source of --from has {found}: its evidence cannot be moved to another grid. Leave --voxel and "
                "--channels out, or make an empty map of that grid and replay the recordings",
            )


def _geometry(args: argparse.Namespace) -> Geometry:
    channels = STANDARD_CHANNELS if args.channels is None else channels_from_text(args.channels)
    return geometry_for(voxel_edge_m=VOXEL_M if args.voxel is None else args.voxel, channels=channels)
