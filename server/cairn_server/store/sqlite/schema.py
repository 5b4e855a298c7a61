"""Tables of the embedded store, step by step: a store of version n has taken the first n steps.

A step that was released never changes. A new store takes them all; an older one takes what it lacks, in one
transaction, when a server opens it. `tests/formats` keeps a store of every version.
"""

import apsw

from cairn_map.errors import BadInputError
from cairn_server.store.sqlite.tile_rows import fill_tiles

WAITING = (
    "(SELECT number FROM commits WHERE map = ?1 AND folded_seq IS NULL AND damaged IS NULL"
    " UNION ALL SELECT number FROM commits WHERE map = ?1 AND due_from IS NOT NULL)"
)
"""SQL of the numbers of a map's commits that folding has still to do with, along the indices of both."""
WAITING_MAPS = (
    "SELECT map FROM commits WHERE folded_seq IS NULL AND damaged IS NULL"
    " UNION SELECT map FROM commits WHERE due_from IS NOT NULL"
)
"""SQL of the maps that have any."""
IS_MEASURED = "folded_seq IS NOT NULL AND unfolded_seq IS NULL AND cells > 0 AND captured_last_s <= received_s + 600"
"""SQL of the commits in the map that say credibly when they were captured; seconds of `CAPTURED_AHEAD_MAX_S`."""

MAPS = "(SELECT * FROM map WHERE number NOT IN (SELECT number FROM gone_map)) AS map"
"""SQL of the maps that were not deleted; rows of others in `map` are there for other rows that refer to them."""

FIRST = """
CREATE TABLE map (
    number INTEGER PRIMARY KEY,
    name TEXT NOT NULL UNIQUE,
    geometry TEXT NOT NULL,
    sensor_model TEXT NOT NULL,
    operator TEXT NOT NULL,
    log_id BLOB NOT NULL,
    seq INTEGER NOT NULL,
    chain BLOB NOT NULL,
    vector TEXT NOT NULL,           -- ids folded so far, as JSON
    tops TEXT NOT NULL              -- per plane: sum over all commits of their largest number
);
CREATE TABLE commits (
    number INTEGER PRIMARY KEY AUTOINCREMENT,   -- order of arrival
    map INTEGER NOT NULL REFERENCES map,
    robot TEXT NOT NULL,
    incarnation TEXT NOT NULL,
    n INTEGER NOT NULL,
    sha BLOB NOT NULL,
    size_bytes INTEGER NOT NULL,
    cells INTEGER NOT NULL,
    meta BLOB NOT NULL,             -- as pushed
    captured_first_s REAL,
    captured_last_s REAL,
    retracts TEXT NOT NULL,         -- ids separated by spaces
    received_s REAL NOT NULL,
    folded_seq INTEGER,
    folded_s REAL,
    damaged TEXT,                   -- why it is set aside
    UNIQUE (map, robot, incarnation, n)
);
CREATE INDEX commits_pending ON commits (map, number) WHERE folded_seq IS NULL AND damaged IS NULL;
CREATE INDEX commits_folded ON commits (map, folded_s) WHERE folded_seq IS NOT NULL;
CREATE INDEX commits_retracting ON commits (map, number) WHERE retracts <> '';
CREATE TABLE author (
    map INTEGER NOT NULL REFERENCES map,
    robot TEXT NOT NULL,
    incarnation TEXT NOT NULL,
    top INTEGER NOT NULL,           -- highest number
    intervals INTEGER NOT NULL,     -- of its numbers, folded or not
    PRIMARY KEY (map, robot, incarnation)
) WITHOUT ROWID;
CREATE TABLE diff (
    number INTEGER PRIMARY KEY,
    commit_number INTEGER NOT NULL REFERENCES commits,
    cell INTEGER NOT NULL,
    body BLOB,                      -- NULL once it is not kept any more
    UNIQUE (commit_number, cell)
);
CREATE TABLE log (
    map INTEGER NOT NULL REFERENCES map,
    seq INTEGER NOT NULL,
    kind BLOB NOT NULL,
    commit_number INTEGER NOT NULL REFERENCES commits,
    chain BLOB NOT NULL,
    PRIMARY KEY (map, seq)
) WITHOUT ROWID;
CREATE TABLE touched (
    map INTEGER NOT NULL REFERENCES map,
    cell INTEGER NOT NULL,
    seq INTEGER NOT NULL,
    PRIMARY KEY (map, cell, seq)
) WITHOUT ROWID;
CREATE TABLE retracted (
    map INTEGER NOT NULL REFERENCES map,
    id TEXT NOT NULL,
    PRIMARY KEY (map, id)
) WITHOUT ROWID;
CREATE TABLE cell (
    number INTEGER PRIMARY KEY,
    map INTEGER NOT NULL REFERENCES map,
    cell INTEGER NOT NULL,
    lm INTEGER NOT NULL,
    digest BLOB NOT NULL,
    fingerprint BLOB NOT NULL,
    voxels INTEGER NOT NULL,
    size_bytes INTEGER NOT NULL,
    body BLOB NOT NULL,
    UNIQUE (map, cell)
);
CREATE INDEX cell_changed ON cell (map, lm);
CREATE TABLE branch (
    map INTEGER NOT NULL REFERENCES map,
    name TEXT NOT NULL,
    mode TEXT NOT NULL,
    sensors TEXT NOT NULL,
    cursor TEXT,
    last_seen_s REAL NOT NULL,
    token_hash BLOB NOT NULL UNIQUE,
    PRIMARY KEY (map, name)
) WITHOUT ROWID;
CREATE TABLE audit (
    number INTEGER PRIMARY KEY AUTOINCREMENT,
    time_s REAL NOT NULL,
    what TEXT NOT NULL,
    detail TEXT NOT NULL
);
"""

STAMPS = """
ALTER TABLE map ADD COLUMN seal_key BLOB NOT NULL DEFAULT x'';
UPDATE map SET seal_key = randomblob(32);           -- by which the server knows its own retracts again
ALTER TABLE commits ADD COLUMN rig BLOB;            -- SHA-256 of rig.json
UPDATE commits SET rig = unhex(json_extract(CAST(meta AS TEXT), '$.rig'));
ALTER TABLE commits ADD COLUMN gone INTEGER NOT NULL DEFAULT 0;     -- its evidence is not kept any more
ALTER TABLE cell ADD COLUMN stamps BLOB NOT NULL DEFAULT x'';       -- log entry that last changed each block
ALTER TABLE cell ADD COLUMN gone_seq INTEGER NOT NULL DEFAULT 0;    -- the newest entry of which the evidence is gone
ALTER TABLE branch ADD COLUMN incarnation TEXT NOT NULL DEFAULT '';
ALTER TABLE commits ADD COLUMN unfolded_seq INTEGER;                -- log entry that took it out again
UPDATE commits SET unfolded_seq =
    (SELECT seq FROM log WHERE log.map = commits.map AND commit_number = number AND kind = CAST('-' AS BLOB));
CREATE INDEX commits_kept ON commits (map, folded_s) WHERE gone = 0 AND cells > 0 AND folded_seq IS NOT NULL;
"""

ACCESS = """
CREATE TABLE token (
    name TEXT PRIMARY KEY,
    role TEXT NOT NULL,
    map INTEGER REFERENCES map,     -- NULL: all maps
    robot TEXT,
    hash BLOB NOT NULL UNIQUE,      -- SHA-256 of the secret
    created_s REAL NOT NULL,
    expires_s REAL,
    last_used_s REAL
);
INSERT INTO token (name, role, map, robot, hash, created_s, last_used_s)
    SELECT map.name || ':' || branch.name, 'robot', branch.map, branch.name, token_hash, last_seen_s, last_seen_s
    FROM branch JOIN map ON map.number = branch.map;
CREATE TABLE branch_without_token (
    map INTEGER NOT NULL REFERENCES map,
    name TEXT NOT NULL,
    mode TEXT NOT NULL,
    sensors TEXT NOT NULL,
    cursor TEXT,
    last_seen_s REAL NOT NULL,
    incarnation TEXT NOT NULL DEFAULT '',
    PRIMARY KEY (map, name)
) WITHOUT ROWID;
INSERT INTO branch_without_token SELECT map, name, mode, sensors, cursor, last_seen_s, incarnation FROM branch;
DROP TABLE branch;
ALTER TABLE branch_without_token RENAME TO branch;
ALTER TABLE audit ADD COLUMN who TEXT NOT NULL DEFAULT 'server';
ALTER TABLE audit ADD COLUMN chain BLOB NOT NULL DEFAULT x'';       -- over the line before and this one
"""

BRANCH_STATUS = """
CREATE TABLE branch_status (
    map INTEGER NOT NULL,
    name TEXT NOT NULL,
    status TEXT NOT NULL,           -- the last one, as JSON
    PRIMARY KEY (map, name),
    FOREIGN KEY (map, name) REFERENCES branch (map, name) ON DELETE CASCADE
) WITHOUT ROWID;
"""

RECEIVED = """
CREATE INDEX commits_received ON commits (received_s);  -- a clock may be set back: numbers do not rise with it
"""

SIGNED = """
ALTER TABLE commits ADD COLUMN signatures TEXT;     -- of whom it speaks for, as pushed; NULL: it cannot travel
ALTER TABLE commits ADD COLUMN via TEXT;            -- name of the token of the relay that handed it over
"""

HOTTEST = """
ALTER TABLE cell ADD COLUMN hottest_k REAL;         -- mean of its hottest voxel; NULL: none, or not known yet
-- A column behind a cell's bytes is found by reading through all of them: a list of cells never looks at the rows.
CREATE INDEX cell_listed ON cell (map, cell, lm, digest, fingerprint, voxels, size_bytes, gone_seq, hottest_k);
DROP INDEX cell_changed;
"""

AGES = """
CREATE TABLE age (age_s REAL NOT NULL, wall_s REAL NOT NULL);       -- one row: `store_age.AgeMark`
INSERT INTO age VALUES (0, 0);
-- Ages of the store. Times of day in older stores may have jumped and prove nothing, so what is there counts from now.
ALTER TABLE commits ADD COLUMN received_age_s REAL NOT NULL DEFAULT 0;      -- when it came, or came again
ALTER TABLE commits ADD COLUMN folded_age_s REAL NOT NULL DEFAULT 0;        -- folded_s is NULL from now on
UPDATE commits SET received_age_s = 1e-3 WHERE received_s > folded_s;       -- came again: after it was folded
ALTER TABLE token ADD COLUMN created_age_s REAL NOT NULL DEFAULT 0;
ALTER TABLE token ADD COLUMN used_age_s REAL NOT NULL DEFAULT 0;
DROP INDEX commits_folded;
CREATE INDEX commits_folded ON commits (map, folded_age_s) WHERE folded_seq IS NOT NULL;
DROP INDEX commits_kept;
CREATE INDEX commits_kept ON commits (map, folded_age_s) WHERE gone = 0 AND cells > 0 AND folded_seq IS NOT NULL;
"""

SHARES = """
-- map.tops is from here on of the commits that came before: what comes later is on its robot's account.
CREATE TABLE held (
    map INTEGER NOT NULL REFERENCES map,
    account TEXT NOT NULL,          -- robot; empty: the reserve
    region INTEGER NOT NULL,        -- of 4^3 cells: their numbers without the last 6 bits
    tops BLOB NOT NULL,             -- per plane an int64: largest numbers of its commits in the region, added up
    part REAL NOT NULL,             -- of the account's share, of the fullest plane
    PRIMARY KEY (map, account, region)
) WITHOUT ROWID;
CREATE INDEX held_much ON held (map, account, part) WHERE part > 0.5;
ALTER TABLE commits ADD COLUMN charged BLOB;    -- per region its number and tops; NULL: before accounts
ALTER TABLE author ADD COLUMN closed INTEGER NOT NULL DEFAULT 0;    -- takes no new commits, and is the reserve's
-- More robots than there are shares begin again, each with its next incarnation.
UPDATE author SET closed = 1 WHERE robot NOT IN ('operator', 'initial') AND map IN (
    SELECT map FROM author WHERE robot NOT IN ('operator', 'initial') GROUP BY map HAVING count(DISTINCT robot) > 256);
"""

KEYS = """
CREATE TABLE robot_key (                            -- incarnations that may speak for a robot's name
    map INTEGER NOT NULL REFERENCES map,
    robot TEXT NOT NULL,
    incarnation TEXT NOT NULL,
    is_proven INTEGER NOT NULL,     -- it signed something here, so it is a key
    may_return INTEGER NOT NULL,    -- an operator's word waits for its registration
    since_s REAL NOT NULL,
    by TEXT NOT NULL,               -- name of the token that brought it
    PRIMARY KEY (map, robot, incarnation)
) WITHOUT ROWID;
INSERT INTO robot_key
    SELECT map, robot, incarnation, EXISTS (
        SELECT 1 FROM commits WHERE commits.map = author.map AND commits.robot = author.robot
        AND commits.incarnation = author.incarnation AND signatures IS NOT NULL
    ), 0, unixepoch(), 'server' FROM author WHERE robot NOT IN ('operator', 'initial');
INSERT OR IGNORE INTO robot_key
    SELECT map, name, incarnation, 0, 0, unixepoch(), 'server' FROM branch WHERE incarnation <> '';
"""

ENDED = """
CREATE TABLE ended_list (id TEXT NOT NULL);         -- one row: of the list next to the store (`ended_tokens`)
ALTER TABLE token ADD COLUMN confirmed INTEGER NOT NULL DEFAULT 1;  -- 0: restored, and off until an admin confirms it
"""

BRICKS = """
ALTER TABLE commits ADD COLUMN bricks INTEGER NOT NULL DEFAULT 0;   -- of 8^3 voxels that it touches; 0: before quotas
"""

CAPTURED = f"""
CREATE INDEX commits_captured ON commits (map, captured_last_s) WHERE {IS_MEASURED};
"""

DUE = """
ALTER TABLE commits ADD COLUMN due_from INTEGER;    -- of a folded retract: first name still to be taken out
CREATE INDEX commits_due ON commits (map, number) WHERE due_from IS NOT NULL;
"""

TILES = """
-- What reads of a map may not cost a row for each of its cells or commits; `tile_rows.fill_tiles` computes it.
CREATE TABLE tile (
    map INTEGER NOT NULL REFERENCES map,
    tile INTEGER NOT NULL,          -- of 4^3 cells: their numbers without the last 6 bits
    lm INTEGER NOT NULL,            -- newest of its cells
    cells INTEGER NOT NULL,         -- with a known voxel
    size_bytes INTEGER NOT NULL,    -- of these
    fingerprint BLOB NOT NULL,      -- sum of its cells'
    PRIMARY KEY (map, tile)
) WITHOUT ROWID;
CREATE INDEX tile_changed ON tile (map, lm);
ALTER TABLE map ADD COLUMN cells INTEGER NOT NULL DEFAULT 0;        -- these four of all cells
ALTER TABLE map ADD COLUMN cells_bytes INTEGER NOT NULL DEFAULT 0;
ALTER TABLE map ADD COLUMN fingerprint BLOB NOT NULL DEFAULT x'';
ALTER TABLE map ADD COLUMN corners TEXT;                            -- of those with a known voxel, as JSON
ALTER TABLE map ADD COLUMN folded INTEGER NOT NULL DEFAULT 0;       -- commits in the log
CREATE TABLE vector_mark (                                          -- at about each thousandth log entry
    map INTEGER NOT NULL REFERENCES map,
    seq INTEGER NOT NULL,
    vector TEXT NOT NULL,           -- ids folded so far, as JSON
    PRIMARY KEY (map, seq)
);
ALTER TABLE map DROP COLUMN vector;
DROP INDEX commits_folded;
CREATE INDEX commits_folded ON commits (map, folded_age_s, folded_seq) WHERE folded_seq IS NOT NULL;
"""

EPOCHS = """
ALTER TABLE map ADD COLUMN epoch_s INTEGER;         -- length of an epoch; NULL: one sum for all times
ALTER TABLE map ADD COLUMN history_bytes INTEGER NOT NULL DEFAULT 0;    -- of cells_bytes: rows older than their newest
ALTER TABLE commits ADD COLUMN epoch INTEGER;       -- of its evidence; NULL: the base
ALTER TABLE cell ADD COLUMN history_bytes INTEGER NOT NULL DEFAULT 0;   -- these two of size_bytes
ALTER TABLE tile ADD COLUMN history_bytes INTEGER NOT NULL DEFAULT 0;
DROP INDEX cell_listed;
CREATE INDEX cell_listed
    ON cell (map, cell, lm, digest, fingerprint, voxels, size_bytes, gone_seq, hottest_k, history_bytes);
"""

CLOCK = """
ALTER TABLE age ADD COLUMN clock TEXT;              -- `store_clock.ClockMark`, as JSON
CREATE INDEX commits_epoch ON commits (map, epoch) WHERE epoch IS NOT NULL;
"""

ADDRESSES = """
ALTER TABLE audit ADD COLUMN client TEXT NOT NULL DEFAULT '';       -- address that a request came from
"""

GONE = """
CREATE TABLE gone_map (                             -- deleted; as long as `map` has its number, rows of it are left
    number INTEGER PRIMARY KEY,
    name TEXT NOT NULL,
    deleted_s REAL NOT NULL,
    by TEXT NOT NULL                -- name of the token
);
CREATE TABLE gone_token (                           -- that ended with its map
    hash BLOB PRIMARY KEY,
    map INTEGER NOT NULL
) WITHOUT ROWID;
-- Without a reference to commits: to remove one would look through the whole log for its number.
CREATE TABLE log_without_reference (
    map INTEGER NOT NULL REFERENCES map,
    seq INTEGER NOT NULL,
    kind BLOB NOT NULL,
    commit_number INTEGER NOT NULL,
    chain BLOB NOT NULL,
    PRIMARY KEY (map, seq)
) WITHOUT ROWID;
INSERT INTO log_without_reference SELECT map, seq, kind, commit_number, chain FROM log;
DROP TABLE log;
ALTER TABLE log_without_reference RENAME TO log;
ALTER TABLE author ADD COLUMN kept_bytes INTEGER NOT NULL DEFAULT 0;    -- of its commits whose evidence is not gone
UPDATE author SET kept_bytes = coalesce((
    SELECT sum(size_bytes) FROM commits
    WHERE commits.map = author.map AND commits.robot = author.robot AND commits.incarnation = author.incarnation
        AND gone = 0
), 0);
"""

MARKS = """
CREATE TABLE mark (
    map INTEGER NOT NULL REFERENCES map,
    commit_number INTEGER NOT NULL,
    n INTEGER NOT NULL,             -- its number in the commit
    changed_seq INTEGER,            -- log entry that brought it, or took it out; NULL: pending
    low_x INTEGER NOT NULL,         -- corners of its box, millimetres
    low_y INTEGER NOT NULL,
    low_z INTEGER NOT NULL,
    high_x INTEGER NOT NULL,
    high_y INTEGER NOT NULL,
    high_z INTEGER NOT NULL,
    record TEXT,                    -- as the commit has it, JSON; NULL: it was taken out
    PRIMARY KEY (map, commit_number, n)
) WITHOUT ROWID;
CREATE INDEX mark_changed ON mark (map, changed_seq, low_x, low_y, low_z, high_x, high_y, high_z);
ALTER TABLE author ADD COLUMN marks INTEGER NOT NULL DEFAULT 0;     -- of its commits, that are not taken out
"""

LAYERS = """
-- Earlier programs take a commit of version 4 for a damaged one, and the name of a layer for none of a map.
"""

ATTACHMENTS = """
ALTER TABLE mark ADD COLUMN attached_sha BLOB;      -- SHA-256 of its attachment; NULL: it has none, or was taken out
ALTER TABLE mark ADD COLUMN attached_bytes INTEGER; -- size that it states
CREATE INDEX mark_attached ON mark (map, attached_sha) WHERE attached_sha IS NOT NULL;
CREATE TABLE attachment (
    map INTEGER NOT NULL REFERENCES map,
    sha BLOB NOT NULL,
    uploader TEXT NOT NULL,         -- name of the token that sends it; empty: whole, with that SHA-256
    account TEXT NOT NULL,          -- robot whose mark names it
    size_bytes INTEGER NOT NULL,
    held_bytes INTEGER NOT NULL,
    idle_age_s REAL,                -- age of the store since which nothing keeps it; NULL: something does
    PRIMARY KEY (map, sha, uploader)
) WITHOUT ROWID;
CREATE TABLE attachment_part (
    map INTEGER NOT NULL REFERENCES map,
    sha BLOB NOT NULL,
    uploader TEXT NOT NULL,
    begin_bytes INTEGER NOT NULL,
    body BLOB NOT NULL,
    PRIMARY KEY (map, sha, uploader, begin_bytes)
);
"""

ASSIGNMENTS = """
CREATE TABLE assignment (
    map INTEGER NOT NULL REFERENCES map,
    robot TEXT NOT NULL,
    assignment TEXT NOT NULL,       -- layers that it takes part in, as JSON
    PRIMARY KEY (map, robot)
) WITHOUT ROWID;
"""

STEPS = (
    FIRST,
    STAMPS,
    ACCESS,
    BRANCH_STATUS,
    RECEIVED,
    SIGNED,
    HOTTEST,
    AGES,
    SHARES,
    KEYS,
    ENDED,
    BRICKS,
    CAPTURED,
    DUE,
    TILES,
    EPOCHS,
    CLOCK,
    ADDRESSES,
    GONE,
    MARKS,
    LAYERS,
    ATTACHMENTS,
    ASSIGNMENTS,
)


def ensure_schema(connection: apsw.Connection) -> None:
    """Make the tables in a new file, or what an older one lacks of them.

    Raises:
        BadInputError: the file belongs to a newer version of cairn, or to another program.
    """
    version = connection.pragma("user_version")
    if version == len(STEPS):
        return
    if not 0 <= version < len(STEPS):
        raise newer_store("the store", version)
    if version == 0 and connection.execute("SELECT count(*) FROM sqlite_master").get:
        raise BadInputError("store_version", "the file is a database of another program")
    connection.execute("BEGIN IMMEDIATE")
    for step in STEPS[version:]:
        connection.execute(step)
    if TILES in STEPS[version:]:
        fill_tiles(connection)
    connection.execute(f"PRAGMA user_version = {len(STEPS)}")
    connection.execute("COMMIT")


def newer_store(what: str, version: int) -> BadInputError:
    """Error of a store, or a backup, that a newer program made."""
    return BadInputError(
        "store_version",
        f"{what} is of a newer cairn: it has version {version}, this program knows versions to {len(STEPS)}; update it",
    )
