"""Tables of the store in PostgreSQL, step by step, so that servers of one step and the next run together.

    row written by            keyed by
    directory   anyone        map; token, audit: of the server
    push        one robot     map, robot ...        author, held, robot_key; commits, diff
    fold        the folder    map, ...              head, log, touched, retracted, cell, tile, vector_mark

Every key begins with the map, so that maps can be spread over several databases; those of cells have room for a layer.
No row refers to one of another map, and no cursor comes from a sequence: `number` is a mere handle of a commit. What
has to be found together is kept in one row, so that no read joins tables by a plan that may be a bad one.

A step that was released never changes. A step expands: programs of the step before it go on working. What only they
need is dropped by a later step, which names itself as the oldest that may still work (`Step.oldest`).
"""

from dataclasses import dataclass
from typing import Any

import psycopg
from psycopg import errors
from psycopg.conninfo import conninfo_to_dict

from cairn_map.commits.ids import SERVERS_OWN
from cairn_map.errors import BadInputError, CairnError, ConflictError
from cairn_server.store.postgres.connections import PRIMARY, Connection, connect, connect_to_any, first
from cairn_server.store.postgres.failures import opening_failure
from cairn_server.store.replica_notes import SERVER_S

SERVER_MIN = 150_000
"""Oldest PostgreSQL, as its `server_version_num`."""
STARTS_MAX = 8
"""Most attempts of servers that start at once on an empty database: one makes the tables, the others wait for it."""
LOCK_S = 0.3
"""Longest wait of a step for a table that other servers use, seconds: less than the one second after which the database
ends one of two transactions that wait for each other, so that the step gives way and never a robot's request."""
LOCK_TRIES_MAX = 100
"""Most attempts of a step: half a minute of a busy database."""

IS_WAITING = "((folded_seq IS NULL AND damaged IS NULL) OR due_from IS NOT NULL)"
"""SQL of the commits that folding has still to do with."""
IS_MEASURED = "folded_seq IS NOT NULL AND unfolded_seq IS NULL AND cells > 0 AND captured_last_s <= received_s + 600"
"""SQL of the commits in the map that say credibly when they were captured; seconds of `CAPTURED_AHEAD_MAX_S`."""
SERVERS_IN_SQL = ", ".join(f"'{robot}'" for robot in sorted(SERVERS_OWN))
IS_RESERVE = f"(closed OR robot IN ({SERVERS_IN_SQL}))"
"""SQL of the authors whose commits are the reserve's."""
NOW_S = "extract(epoch FROM clock_timestamp())::float8"
"""SQL of the time of day, UTC seconds since 1970, by the database's clock: the same for all servers."""

FIRST = f"""
CREATE TABLE map (
    map bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    name text COLLATE "C" NOT NULL UNIQUE,
    geometry text NOT NULL,
    sensor_model text NOT NULL,
    seal_key bytea NOT NULL
);
CREATE TABLE head (
    map bigint PRIMARY KEY,
    log_id bytea NOT NULL,
    seq bigint NOT NULL,
    chain bytea NOT NULL,
    folded bigint NOT NULL DEFAULT 0,               -- commits in the log
    cells bigint NOT NULL DEFAULT 0,                -- these four of all cells
    cells_bytes bigint NOT NULL DEFAULT 0,
    fingerprint bytea NOT NULL,
    corners bigint[]                                -- of those with a known voxel: lowest i, j, k, then highest
) WITH (fillfactor = 50);
CREATE TABLE author (
    map bigint,
    robot text COLLATE "C",
    incarnation text COLLATE "C",
    top bigint NOT NULL,                            -- highest number
    intervals bigint NOT NULL,                      -- of its numbers, folded or not
    closed boolean NOT NULL DEFAULT false,          -- takes no new commits, and is the reserve's
    PRIMARY KEY (map, robot, incarnation)
) WITH (fillfactor = 70);
CREATE TABLE held (
    map bigint,
    account text COLLATE "C",                       -- robot; empty: the reserve
    region bigint,
    tops bigint[] NOT NULL,                         -- per plane: largest numbers of its commits here, added up
    room bigint NOT NULL,                           -- least that a plane may still take
    part float8 NOT NULL,                           -- of the account's share, of the fullest plane
    PRIMARY KEY (map, account, region),
    CONSTRAINT held_has_room CHECK (room >= 0)
) WITH (fillfactor = 70);
CREATE INDEX held_much ON held (map, account, part) WHERE part > 0.5;
CREATE TABLE robot_key (
    map bigint,
    robot text COLLATE "C",
    incarnation text COLLATE "C",
    is_proven boolean NOT NULL,                     -- it signed something here, so it is a key
    may_return boolean NOT NULL,                    -- an operator's word waits for its registration
    since_s float8 NOT NULL,
    by text NOT NULL,                               -- name of the token that brought it
    PRIMARY KEY (map, robot, incarnation)
);
CREATE TABLE commits (
    map bigint,
    robot text COLLATE "C",
    incarnation text COLLATE "C",
    n bigint,
    number bigint GENERATED ALWAYS AS IDENTITY,     -- about the order of arrival
    sha bytea NOT NULL,
    size_bytes bigint NOT NULL,
    cells bigint NOT NULL,
    bricks bigint NOT NULL,
    meta bytea NOT NULL,                            -- as pushed
    captured_first_s float8,
    captured_last_s float8,
    retracts text NOT NULL,                         -- ids separated by spaces
    rig bytea,
    signatures text,
    via text,
    regions bigint[] NOT NULL,                      -- in which its account is charged
    tops bigint[] NOT NULL,                         -- per region, each plane's largest number
    received_s float8 NOT NULL,
    received_age_s float8 NOT NULL,                 -- age of the store when it came, or came again
    folded_age_s float8 NOT NULL DEFAULT 0,
    folded_seq bigint,
    unfolded_seq bigint,                            -- log entry that took it out again
    due_from bigint,                                -- of a folded retract: first name still to be taken out
    damaged text,                                   -- why it is set aside
    gone boolean NOT NULL DEFAULT false,            -- its evidence is not kept any more
    PRIMARY KEY (map, robot, incarnation, n)
) WITH (fillfactor = 80);
CREATE UNIQUE INDEX commits_number ON commits (map, number);
CREATE INDEX commits_waiting ON commits (map, number) WHERE {IS_WAITING};
CREATE INDEX commits_retracting ON commits (map, number) WHERE folded_seq IS NULL AND retracts <> '';
CREATE INDEX commits_folded ON commits (map, folded_age_s, folded_seq) WHERE folded_seq IS NOT NULL;
CREATE INDEX commits_kept ON commits (map, folded_age_s) WHERE NOT gone AND cells > 0 AND folded_seq IS NOT NULL;
CREATE INDEX commits_received ON commits (map, received_s);
CREATE INDEX commits_captured ON commits (map, captured_last_s) WHERE {IS_MEASURED};
CREATE TABLE diff (
    map bigint,
    layer smallint NOT NULL DEFAULT 0,
    commit_number bigint,
    cell bigint,
    body bytea NOT NULL,
    PRIMARY KEY (map, commit_number, layer, cell)
);
CREATE TABLE log (
    map bigint,
    seq bigint,
    kind bytea NOT NULL,
    commit_number bigint NOT NULL,
    chain bytea NOT NULL,
    PRIMARY KEY (map, seq)
);
CREATE TABLE touched (                              -- with what a reader asks of each entry, so that nothing is joined
    map bigint,
    layer smallint NOT NULL DEFAULT 0,
    cell bigint,
    seq bigint,
    kind bytea NOT NULL,
    robot text COLLATE "C" NOT NULL,
    incarnation text COLLATE "C" NOT NULL,
    n bigint NOT NULL,
    size_bytes bigint NOT NULL,
    PRIMARY KEY (map, layer, cell, seq)
);
CREATE TABLE retracted (map bigint, id text COLLATE "C", PRIMARY KEY (map, id));
CREATE TABLE vector_mark (                          -- at about each thousandth log entry
    map bigint,
    seq bigint,
    vector text NOT NULL,                           -- ids folded so far, as JSON
    PRIMARY KEY (map, seq)
);
CREATE TABLE cell (
    map bigint,
    layer smallint NOT NULL DEFAULT 0,
    cell bigint,
    lm bigint NOT NULL,
    digest bytea NOT NULL,
    fingerprint bytea NOT NULL,
    voxels bigint NOT NULL,
    size_bytes bigint NOT NULL,
    gone_seq bigint NOT NULL DEFAULT 0,             -- newest entry of which the evidence is gone
    hottest_k float8,
    body bytea NOT NULL,
    stamps bytea NOT NULL,
    PRIMARY KEY (map, layer, cell)
) WITH (fillfactor = 70);
CREATE TABLE tile (
    map bigint,
    layer smallint NOT NULL DEFAULT 0,
    tile bigint,                                    -- of 4^3 cells: their numbers without the last 6 bits
    lm bigint NOT NULL,                             -- newest of its cells
    cells bigint NOT NULL,                          -- with a known voxel
    size_bytes bigint NOT NULL,                     -- of these
    fingerprint bytea NOT NULL,                     -- sum of its cells'
    PRIMARY KEY (map, layer, tile)
) WITH (fillfactor = 70);
CREATE INDEX tile_changed ON tile (map, layer, lm);
-- Already compressed: PostgreSQL would only try again.
ALTER TABLE diff ALTER body SET STORAGE EXTERNAL;
ALTER TABLE cell ALTER body SET STORAGE EXTERNAL, ALTER stamps SET STORAGE EXTERNAL;
CREATE TABLE lease (map bigint PRIMARY KEY, holder text NOT NULL, until timestamptz NOT NULL);
CREATE TABLE branch (
    map bigint,
    name text COLLATE "C",
    mode text NOT NULL,
    sensors text NOT NULL,
    cursor text,
    last_seen_s float8 NOT NULL,
    incarnation text NOT NULL,
    PRIMARY KEY (map, name)
) WITH (fillfactor = 70);
CREATE TABLE branch_status (map bigint, name text COLLATE "C", status text NOT NULL, PRIMARY KEY (map, name))
    WITH (fillfactor = 70);
CREATE TABLE token (
    name text COLLATE "C" PRIMARY KEY,
    role text NOT NULL,
    map bigint,                                     -- NULL: all maps
    robot text,
    hash bytea NOT NULL UNIQUE,                     -- SHA-256 of the secret
    created_s float8 NOT NULL,
    created_age_s float8 NOT NULL,
    expires_s float8,
    last_used_s float8,
    used_age_s float8 NOT NULL DEFAULT 0,
    confirmed boolean NOT NULL DEFAULT true
);
CREATE INDEX token_of_robot ON token (map, robot);
CREATE TABLE audit (
    stream text,                                    -- each has a chain of its own
    number bigint,
    time_s float8 NOT NULL,
    who text NOT NULL,
    what text NOT NULL,
    detail text NOT NULL,
    chain bytea NOT NULL,
    PRIMARY KEY (stream, number)
);
CREATE TABLE audit_head (stream text PRIMARY KEY, number bigint NOT NULL, chain bytea NOT NULL);
CREATE TABLE age (one boolean PRIMARY KEY CHECK (one), age_s float8 NOT NULL, wall_s float8 NOT NULL);
INSERT INTO age VALUES (true, 0, 0);
"""

REPLICAS = """
ALTER TABLE branch_status ADD COLUMN heard_s float8 NOT NULL DEFAULT 0;
-- Not logged: what is lost in them costs bytes or a moment.
CREATE UNLOGGED TABLE branch_view (
    map bigint,
    name text COLLATE "C",
    media_type text NOT NULL,
    time_s float8 NOT NULL,
    data bytea NOT NULL,
    PRIMARY KEY (map, name)
) WITH (fillfactor = 50);
CREATE UNLOGGED TABLE ticket (
    hash bytea PRIMARY KEY,                         -- SHA-256 of its text
    map_name text NOT NULL,
    asked text NOT NULL,
    holder bytea,
    until timestamptz NOT NULL
);
CREATE UNLOGGED TABLE body (                        -- commits that come in parts
    map bigint,
    robot text COLLATE "C",
    commit text COLLATE "C",
    digest text NOT NULL,
    total_bytes bigint NOT NULL,
    size_bytes bigint NOT NULL,
    used_at timestamptz NOT NULL,
    PRIMARY KEY (map, robot, commit)
);
CREATE UNLOGGED TABLE body_part (
    map bigint,
    robot text COLLATE "C",
    commit text COLLATE "C",
    offset_bytes bigint,
    data bytea NOT NULL,
    PRIMARY KEY (map, robot, commit, offset_bytes)
);
ALTER TABLE branch_view ALTER data SET STORAGE EXTERNAL;
ALTER TABLE body_part ALTER data SET STORAGE EXTERNAL;
CREATE UNLOGGED TABLE bucket (
    name text COLLATE "C" PRIMARY KEY,
    turns float8 NOT NULL,
    turned timestamptz NOT NULL
) WITH (fillfactor = 70);
CREATE TABLE use_day (
    map bigint,
    robot text COLLATE "C",
    day bigint NOT NULL,
    size_bytes bigint NOT NULL,
    cells bigint NOT NULL,
    bricks bigint NOT NULL,
    turns float8,                                   -- left of its commits of a minute; NULL: without a bound
    turned timestamptz NOT NULL,
    PRIMARY KEY (map, robot)
) WITH (fillfactor = 50);
CREATE TABLE handed_over (upstream text, map_name text, age_s float8 NOT NULL, PRIMARY KEY (upstream, map_name));
CREATE TABLE shared_secret (one boolean PRIMARY KEY CHECK (one), secret bytea NOT NULL);
"""

SERVERS = """
CREATE UNLOGGED TABLE server (                      -- those alive, each heard of every some seconds
    id text COLLATE "C" PRIMARY KEY,
    answers boolean NOT NULL,
    folds boolean NOT NULL,
    version text NOT NULL,
    clock_ahead_s float8 NOT NULL,
    folded_at timestamptz,
    heard_at timestamptz NOT NULL
) WITH (fillfactor = 50);
"""

OBJECTS = """
-- Bytes that moved to an object store; NULL: they are here.
ALTER TABLE cell ALTER body DROP NOT NULL, ALTER stamps DROP NOT NULL, ADD COLUMN object text;
ALTER TABLE diff ALTER body DROP NOT NULL, ADD COLUMN segment text, ADD COLUMN start_bytes bigint,
    ADD COLUMN size_bytes bigint;
CREATE TABLE segment (
    map bigint,
    name text COLLATE "C",
    live bigint NOT NULL,                           -- pieces that rows of diff name
    size_bytes bigint NOT NULL,
    PRIMARY KEY (map, name)
);
-- Every object that no row names: on its way there, or out of use. It is here before it is made, until it is deleted.
CREATE TABLE dead_object (
    map bigint,
    name text COLLATE "C",
    since_age_s float8 NOT NULL,                    -- age of the store
    doomed boolean NOT NULL DEFAULT false,          -- is being deleted, so that no row may name it any more
    PRIMARY KEY (map, name)
);
CREATE INDEX dead_object_since ON dead_object (since_age_s);
CREATE TABLE settled (                              -- what was looked at; what came later is not here any more, or hot
    map bigint PRIMARY KEY,
    seq bigint NOT NULL DEFAULT 0,                  -- tiles changed up to here
    age_s float8 NOT NULL DEFAULT 0,                -- commits folded up to here,
    number bigint NOT NULL DEFAULT 0                -- and this one
);
CREATE TABLE object_store (
    one boolean PRIMARY KEY CHECK (one),
    id text NOT NULL,                               -- as the object that marks its place says, too
    url text NOT NULL,
    holder text,                                    -- process that settles, until then
    until timestamptz NOT NULL DEFAULT '-infinity'
);
"""
OWNED_OBJECTS = """
-- The database that may settle and delete, as the object of its bucket says, too: no copy of this one may.
ALTER TABLE object_store
    ADD COLUMN era text,                            -- drawn when the bucket was taken, or adopted
    ADD COLUMN turned_s float8 NOT NULL DEFAULT 0,  -- time of the newest turn of the bucket's object
    ADD COLUMN listed_age_s float8 NOT NULL DEFAULT 0; -- age of the store when all names were listed last
CREATE INDEX dead_object_doomed ON dead_object (map, name) WHERE doomed;
"""
EPOCHS = """
ALTER TABLE map ADD COLUMN epoch_s bigint;          -- length of an epoch; NULL: one sum for all times
ALTER TABLE head ADD COLUMN history_bytes bigint NOT NULL DEFAULT 0;    -- of cells_bytes: rows older than their newest
ALTER TABLE commits ADD COLUMN epoch bigint;        -- of its evidence; NULL: the base
ALTER TABLE touched ADD COLUMN epoch bigint;
ALTER TABLE cell ADD COLUMN history_bytes bigint NOT NULL DEFAULT 0;    -- these two of size_bytes
ALTER TABLE tile ADD COLUMN history_bytes bigint NOT NULL DEFAULT 0;
ALTER TABLE server ADD COLUMN step bigint;          -- newest one that its program knows; NULL: an earlier one than this
"""
EPOCHS_OLDEST = 6
"""Oldest step whose programs work on a store with a map with epochs."""
CLOCK = """
ALTER TABLE age ADD COLUMN clock text;              -- `store_clock.ClockMark`, as JSON
CREATE INDEX commits_epoch ON commits (map, epoch) WHERE epoch IS NOT NULL;
"""
ADDRESSES = """
ALTER TABLE audit ADD COLUMN client text NOT NULL DEFAULT '';       -- address that a request came from
"""
GONE = """
CREATE TABLE gone_map (                             -- deleted
    map bigint PRIMARY KEY,
    name text COLLATE "C" NOT NULL,
    deleted_s float8 NOT NULL,
    by text NOT NULL,                               -- name of the token
    cleared boolean NOT NULL DEFAULT false          -- no row of it is left
);
CREATE INDEX gone_map_name ON gone_map (name);
CREATE INDEX gone_map_left ON gone_map (map) WHERE NOT cleared;
CREATE TABLE gone_token (hash bytea PRIMARY KEY, map bigint NOT NULL);  -- that ended with its map
ALTER TABLE author ADD COLUMN kept_bytes bigint NOT NULL DEFAULT 0;     -- of its commits whose evidence is not gone
UPDATE author SET kept_bytes = kept.size_bytes FROM (
    SELECT map, robot, incarnation, sum(size_bytes)::bigint AS size_bytes FROM commits WHERE NOT gone GROUP BY 1, 2, 3
) AS kept
WHERE author.map = kept.map AND author.robot = kept.robot AND author.incarnation = kept.incarnation;
"""
MARKS = """
CREATE TABLE mark (
    map bigint,
    commit_number bigint,
    n bigint,                                       -- its number in the commit
    changed_seq bigint,                             -- log entry that brought it, or took it out; NULL: pending
    low_x bigint NOT NULL,                          -- corners of its box, millimetres
    low_y bigint NOT NULL,
    low_z bigint NOT NULL,
    high_x bigint NOT NULL,
    high_y bigint NOT NULL,
    high_z bigint NOT NULL,
    record text,                                    -- as the commit has it, JSON; NULL: it was taken out
    PRIMARY KEY (map, commit_number, n)
);
CREATE INDEX mark_changed ON mark (map, changed_seq, low_x, low_y, low_z, high_x, high_y, high_z);
ALTER TABLE author ADD COLUMN marks bigint NOT NULL DEFAULT 0;          -- of its commits, that are not taken out
"""
LAYERS = "COMMENT ON COLUMN map.name IS 'of a map, or MAP.LAYER: of a further layer of one'"
LAYERS_OLDEST = 11
"""Oldest step whose programs work on a store with maps of several layers: others take the commit that defines one for
damaged, and its name for none of a map."""
MARKS_OLDEST = 10
"""Oldest step whose programs work on a store with marks: others take a commit with marks for a damaged one."""
ATTACHMENTS = """
ALTER TABLE mark ADD COLUMN attached_sha bytea;         -- SHA-256 of its attachment; NULL: none, or it was taken out
ALTER TABLE mark ADD COLUMN attached_bytes bigint;      -- size that it states
CREATE INDEX mark_attached ON mark (map, attached_sha) WHERE attached_sha IS NOT NULL;
CREATE TABLE attachment (
    map bigint,
    sha bytea,
    uploader text,                                  -- name of the token that sends it; empty: whole, with that SHA-256
    account text NOT NULL,                          -- robot whose mark names it
    size_bytes bigint NOT NULL,
    held_bytes bigint NOT NULL,
    idle_age_s float8,                              -- age of the store since which nothing keeps it; NULL: it is kept
    PRIMARY KEY (map, sha, uploader)
);
CREATE TABLE attachment_part (
    map bigint,
    sha bytea,
    uploader text,
    begin_bytes bigint,
    body bytea NOT NULL,
    PRIMARY KEY (map, sha, uploader, begin_bytes)
);
ALTER TABLE attachment_part ALTER COLUMN body SET STORAGE EXTERNAL;     -- pictures do not shrink
"""
ASSIGNMENTS = 'CREATE TABLE assignment (map bigint, robot text COLLATE "C", assignment text, PRIMARY KEY (map, robot))'
ATTACHMENTS_OLDEST = 12
"""Oldest step whose programs read a mark with an attachment."""
BOUND_OLDEST = 4
"""Oldest step whose programs read a store of which bytes are in an object store."""


@dataclass(frozen=True, slots=True)
class Step:
    """One step of the schema."""

    sql: str
    oldest: int
    """Number of the oldest step whose programs work on a database that took this one."""


STEPS = tuple(
    Step(sql, oldest=1)
    for sql in (
        *(FIRST, REPLICAS, SERVERS, OBJECTS, OWNED_OBJECTS, EPOCHS, CLOCK, ADDRESSES, GONE, MARKS, LAYERS),
        *(ATTACHMENTS, ASSIGNMENTS),
    )
)


def prepare(url: str, *, has_objects: bool = False) -> None:
    """Make the tables in an empty database, or what an older store lacks of them; all in one transaction.

    Args:
        url: of the database.
        has_objects: an object store is at hand.

    Raises:
        BadInputError: kind `bad_store`: it cannot be reached, is none, not fit for a store, or lacks the object store
            in which some of its bytes are; `store_version`: the store is of a newer cairn.
    """
    try:
        stated = conninfo_to_dict(url)
        place = place_of(stated)
    except psycopg.ProgrammingError as exc:  # whose text may quote the password
        raise BadInputError("bad_store", "the URL of the store is none: postgresql://USER@HOST:PORT/DATABASE") from exc
    wanted = stated.get("target_session_attrs", PRIMARY)
    if wanted not in (PRIMARY, "primary"):
        raise BadInputError(
            "bad_store", f"a store works on the primary alone: leave target_session_attrs={wanted} out of {place}"
        )
    for turn in range(LOCK_TRIES_MAX):
        try:
            with _connected(url) as connection, connection.transaction():
                _check_server(connection, place)
                _take_steps(connection)
                if not has_objects:
                    _check_unbound(connection, place)
            return
        except errors.LockNotAvailable as exc:
            if turn == LOCK_TRIES_MAX - 1:
                raise BadInputError(
                    "bad_store", f"the tables of {place} are in use all the time; start again when it is less busy"
                ) from exc
        except (errors.UniqueViolation, errors.DuplicateTable) as exc:
            # Two servers make the first table at the same time: one of them fails, and finds it then.
            if turn >= STARTS_MAX - 1 or isinstance(exc, errors.DuplicateTable):
                raise opening_failure(exc, place) from exc
        except CairnError:
            raise
        except psycopg.Error as exc:
            raise opening_failure(exc, place) from exc


def place_of(parts: dict[str, Any]) -> str:
    """Hosts, ports, database and user of a URL, as people may read them: without the password."""
    user = f"{parts['user']}@" if parts.get("user") else ""
    hosts, ports = (str(parts.get(name) or "").split(",") for name in ("host", "port"))
    ports = ports * len(hosts) if len(ports) == 1 else ports
    places = (f"{host or 'localhost'}{port and ':'}{port}" for host, port in zip(hosts, ports, strict=False))
    return f"postgresql://{user}{','.join(places)}/{parts.get('dbname', '')}"


def _connected(url: str) -> Connection:
    """A connection to the primary; to another server, which is refused for what it is, if none of them is a primary."""
    try:
        return connect(url)
    except psycopg.OperationalError as exc:
        try:
            return connect_to_any(url, target_session_attrs="any")
        except psycopg.OperationalError:
            raise exc from None


def _check_server(connection: Connection, place: str) -> None:
    query = (
        "SELECT current_setting('server_version_num')::bigint, current_setting('server_version'),"
        " current_setting('server_encoding'), pg_is_in_recovery(), current_setting('synchronous_commit'),"
        " current_setting('fsync')"
    )
    number, version, encoding, is_standby, commits, fsync = first(connection, query)
    complaint = None
    if number < SERVER_MIN:
        complaint = f"it is PostgreSQL {version}; take {SERVER_MIN // 10_000} or newer"
    elif is_standby:
        complaint = "it is a standby, which takes no commits; name its primary"
    elif encoding != "UTF8":
        complaint = f"its database is in {encoding}; make one with ENCODING 'UTF8'"
    elif "off" in (commits, fsync):
        complaint = "synchronous_commit or fsync is off: what was acknowledged could be lost; turn both on"
    if complaint is not None:
        raise BadInputError("bad_store", f"cannot keep a store at {place}: {complaint}")


def _check_unbound(connection: Connection, place: str) -> None:
    has_table = first(connection, "SELECT to_regclass('object_store') IS NOT NULL")
    bound = first(connection, "SELECT url FROM object_store") if has_table else None
    if bound is not None:
        raise BadInputError("bad_store", f"some bytes of {place} are in an object store: start with --objects {bound}")


def _take_steps(connection: Connection) -> None:
    connection.execute("CREATE TABLE IF NOT EXISTS cairn_schema (version bigint NOT NULL, oldest bigint NOT NULL)")
    # Servers that start at once come one after the other from here on.
    connection.execute("LOCK TABLE cairn_schema IN ACCESS EXCLUSIVE MODE")
    version, oldest = first(connection, "SELECT version, oldest FROM cairn_schema") or (0, 0)
    if oldest > len(STEPS):
        raise BadInputError(
            "store_version",
            f"the store has version {version}, which takes a cairn that knows version {oldest}; this one knows "
            f"versions to {len(STEPS)}: update it",
        )
    if version >= len(STEPS):
        return
    connection.execute(f"SET LOCAL lock_timeout TO '{LOCK_S}s'".encode())
    for step in STEPS[version:]:
        connection.execute(step.sql.encode())
    connection.execute("DELETE FROM cairn_schema")
    newest = max(oldest, *(step.oldest for step in STEPS))
    connection.execute("INSERT INTO cairn_schema VALUES (%s, %s)", (len(STEPS), newest))


def bar_older_programs(connection: Connection, oldest: int, *, what: str, instead: str) -> None:
    """Keep programs that know no step `oldest` from this store, whose rows they would take for damage.

    Those that start are refused by their schema; those that run are counted.

    Args:
        connection: inside the transaction that brings what they do not know.
        oldest: oldest step whose programs know it.
        what: name of it, for people.
        instead: what can be done without it.

    Raises:
        ConflictError: kind `older_servers`: some of them work on the store.
    """
    if (first(connection, "SELECT oldest FROM cairn_schema") or 0) >= oldest:
        return
    query = (
        "SELECT count(*) FROM server WHERE coalesce(step, 0) < %s"
        " AND heard_at > clock_timestamp() - make_interval(secs => %s::float8)"
    )
    count = first(connection, query, (oldest, SERVER_S))
    if count:
        raise ConflictError(
            "older_servers",
            f"servers of an earlier version ({count}) work on this store and know no {what}: update them first, or "
            f"{instead}",
        )
    connection.execute("UPDATE cairn_schema SET oldest = %s WHERE oldest < %s", (oldest, oldest))
