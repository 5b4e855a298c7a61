"""A link to the database that is cut without a word: in a network namespace, whose kernel drops all packets.

Prints the seconds until a statement sent after the cut fails, and one that waited for its answer.

    $ unshare --net sh -c 'ip link set lo up && python -m tests.replicas.silent_cut'
"""

import subprocess
import sys
import threading
import time
from contextlib import closing

import psycopg
from tests.fixtures.server.postgres import WHEEL, programs_of
from tests.replicas.fault_run import postgres_in

from cairn_server.store.postgres.connections import Connection, connect

DROP, PASS = (["iptables", flag, "OUTPUT", "--jump", "DROP"] for flag in ("--append", "--delete"))
BEGUN_S = 0.5


def main() -> None:
    """Cut the link, and say how long it took; the first argument is more of the store's URL."""
    with postgres_in(programs_of(WHEEL)) as postgres:
        url = postgres.url("postgres") + "".join(sys.argv[1:])
        with closing(connect(url)) as asking, closing(connect(url)) as waiting:
            thread = threading.Thread(target=_fail, args=(waiting, "SELECT pg_sleep(60)"))
            thread.start()
            threading.Event().wait(BEGUN_S)
            subprocess.run(DROP, check=True)
            _fail(asking, "SELECT 1")
            thread.join()
            subprocess.run(PASS, check=True)


def _fail(connection: Connection, query: str) -> None:
    start_s = time.monotonic()
    try:
        connection.execute(query.encode())
    except psycopg.OperationalError:
        sys.stdout.write(f"{time.monotonic() - start_s:.1f}\n")


if __name__ == "__main__":
    main()
