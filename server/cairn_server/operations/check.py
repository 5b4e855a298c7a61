"""Read a server's whole store and report what is damaged.

    $ cairn serve check --data ./cairn-data
    2 maps, 1204 commits, 56 cells: all sound

It looks at the pages of the file, at the chain of every log, at every diff that is kept against its commit's SHA-256,
at every cell against its digest and fingerprint, at whether each cell is the sum of its commits, and at the attachments
of marks. It may run while the server does. The exit code is 0 if all is sound and 6 if not.

    $ cairn serve check --data ./cairn-data --repair
    lab: cell 0,-1,2 at rest does not have its digest: rebuilt from its commits

    $ cairn serve check --store postgresql://cairn@database/cairn

A database is checked in the same way, while servers work on it, with all that is in its object store (--objects); its
own pages are its own server's (pg_amcheck).

With --repair, which needs the server stopped, damaged cells are rebuilt where the log still has all of their commits.
Others stay set aside: the server answers 500 damaged_store for such a cell alone and goes on with all others; commits
that touch it wait. The next robot that syncs and still has the cell as it was heals it by itself; or a backup from
before the damage is restored, after which robots push again what is newer.
"""

import argparse
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from cairn_map.errors import EXIT_CODES, BadInputError, DamagedDataError, NotFoundError
from cairn_map.progress import PercentLine
from cairn_server.folding.store_check import Finding, check_map
from cairn_server.operations.bucket_owner import bucket_complaints, settings_of_database
from cairn_server.operations.store_opening import store_of
from cairn_server.settings import Settings
from cairn_server.store.sqlite.archive import SqliteArchive
from cairn_server.store.sqlite.backup import give_store_to_owner
from cairn_server.store.sqlite.store import FILE_NAME, SqliteStore
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow


def main(argv: list[str]) -> int:
    """Check, and repair if asked."""
    parser = argparse.ArgumentParser(
        "cairn serve check", description=__doc__, epilog=EXIT_CODES, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Settings().folder, metavar="DIR", help="folder of the store")
    parser.add_argument("--store", metavar="URL", help="check this PostgreSQL database instead of a folder")
    parser.add_argument("--objects", metavar="URL", help="bucket with the cold bytes of this database (s3://...)")
    parser.add_argument("--repair", action="store_true", help="rebuild damaged cells; the server must be stopped")
    args = parser.parse_args(argv)
    if args.store is not None:
        return _check_database(args.store, args.objects, is_repair=args.repair)
    if args.repair:
        if not (args.data / FILE_NAME).is_file():
            raise NotFoundError("no_store", f"there is no store {args.data / FILE_NAME}")
        store = SqliteStore(args.data)
        try:
            outcome = check_all(store, _complaints(args.data))
            if any(finding.is_sum for _, finding in outcome.findings):
                store.recount()
            left = [text for row, finding in outcome.findings for text in _healed(store, row, finding)]
        finally:
            store.close()
            give_store_to_owner(args.data)
    else:
        archive = SqliteArchive(args.data / FILE_NAME)
        try:
            outcome = check_all(archive, archive.complaints())
        # Values of the right kind that no store writes: a cell below 0, a vector that is no JSON.
        except (ValueError, TypeError, OverflowError, KeyError) as exc:
            raise DamagedDataError("damaged_store", f"{args.data}: restore a backup: {exc}") from exc
        finally:
            archive.close()
        left = [str(finding) for _, finding in outcome.findings]
        sys.stdout.writelines(f"{text}\n" for text in left)
    if left:
        raise DamagedDataError("damaged_store", f"{outcome.summary}: {len(left)} things are damaged")
    sys.stdout.write(f"{outcome.summary}: all sound\n")
    return 0


def _check_database(url: str, objects: str | None, *, is_repair: bool) -> int:
    if is_repair:
        raise BadInputError(
            "bad_setting",
            "--repair is for a folder; cells of a database are rebuilt by the server that meets them, or healed by "
            "the next robot that has them, and sums come with a restored backup",
        )
    open_store, _ = store_of(settings_of_database(url, objects))
    store = open_store()
    try:
        return _reported(check_all(store, bucket_complaints(url, objects), source="objects"))
    finally:
        store.close()


def _reported(outcome: "Outcome") -> int:
    sys.stdout.writelines(f"{finding}\n" for _, finding in outcome.findings)
    if outcome.findings:
        raise DamagedDataError("damaged_store", f"{outcome.summary}: {len(outcome.findings)} things are damaged")
    sys.stdout.write(f"{outcome.summary}: all sound\n")
    return 0


def _complaints(folder: Path) -> list[str]:
    archive = SqliteArchive(folder / FILE_NAME)
    try:
        return archive.complaints()
    finally:
        archive.close()


@dataclass(frozen=True, slots=True)
class Outcome:
    """Findings of a check, and its summary in one line."""

    findings: list[tuple[MapRow | None, Finding]]
    summary: str


def check_all(store: Store, complaints: Iterable[str] = (), *, source: str = "file") -> Outcome:
    """Everything in a store; complaints about its file, or another source, come first."""
    findings: list[tuple[MapRow | None, Finding]] = [(None, Finding(source, text)) for text in complaints]
    progress = PercentLine("check")
    rows = store.maps()
    commits = cells = not_kept = attachments = missing = 0
    for row in rows:
        checked = check_map(store, row, progress.at)
        findings += [(row, finding) for finding in checked.findings]
        commits, cells, not_kept = commits + checked.commits, cells + checked.cells, not_kept + checked.not_kept
        attachments, missing = attachments + checked.attachments, missing + checked.missing_attachments
    progress.finish()
    summary = f"{len(rows)} maps, {commits} commits, {cells} cells"
    if attachments or missing:
        summary += f", {attachments} attachments ({missing} did not come yet)"
    if not_kept:
        summary += f" ({not_kept} commits' evidence is not kept any more, so their cells cannot be added up)"
    return Outcome(findings, summary)


def _healed(store: SqliteStore, row: MapRow | None, finding: Finding) -> list[str]:
    """Write a damaged cell again if the log has all of it; the finding, if it has not. Reports either."""
    if row is not None and finding.sound is not None and store.health.heal(row, finding.sound):
        store.audit("healed_cell", f"map {row.name}: {finding.what}: rebuilt from its commits")
        sys.stdout.write(f"{finding}: rebuilt from its commits\n")
        return []
    if row is not None and finding.attachment is not None:
        store.attachments.drop(row.number, finding.attachment)
        sys.stdout.write(f"{finding}: dropped, and wanted again\n")
        return []
    if finding.is_sum:
        sys.stdout.write(f"{finding}: computed again\n")
        return []
    sys.stdout.write(f"{finding}\n")
    return [str(finding)]
