"""Switch each rule off in a copy of the tree, and see its test fail.

$ python -m tests.rules_off 5 T6                   # these rules; default: all
$ python -m tests.rules_off --simulated 300 5 9    # see a seed of `tests.sync_sim` go wrong instead

Ends with 1 where a test notices nothing; simulated, where no switch of a rule is noticed by any of so many seeds (some
switches are of code that no simulation runs, such as SQLite's; of each rule, they are tried until one is noticed).
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.rules_off.switches import SWITCHES, Switch

ROOT = Path(__file__).parents[2]
FOLDERS = ("calib", "fusion", "client", "server")
LIMIT_S = 300


def main() -> int:
    """Print one line for each switch; 1 if one was not noticed."""
    parser = argparse.ArgumentParser("python -m tests.rules_off", description=__doc__)
    parser.add_argument("rules", nargs="*", type=_rule, metavar="RULE", help="5, T6 (all)")
    parser.add_argument("--simulated", type=int, metavar="SEEDS", help="simulate so many seeds instead")
    given = parser.parse_args()
    noticed_by: dict[int | str, list[bool]] = {}
    with tempfile.TemporaryDirectory() as name:
        tree = Path(name)
        for folder in (*FOLDERS, "tests"):
            shutil.copytree(ROOT / folder, tree / folder)
        shutil.copy2(ROOT / "pyproject.toml", tree)
        for switch in SWITCHES:
            is_seen = given.simulated and any(noticed_by.get(switch.rule, ()))
            if (not given.rules or switch.rule in given.rules) and not is_seen:
                noticed = is_noticed(tree, switch, seeds=given.simulated)
                noticed_by.setdefault(switch.rule, []).append(noticed)
                sys.stdout.write(f"{switch.rule:>3}  {'noticed' if noticed else 'UNNOTICED':<10}{switch.without}\n")
                sys.stdout.flush()
    enough = any if given.simulated else all
    return int(not all(enough(noticed) for noticed in noticed_by.values()))


def _rule(text: str) -> int | str:
    return int(text) if text.isdigit() else text


def is_noticed(tree: Path, switch: Switch, *, seeds: int | None) -> bool:
    """Whether its test fails in the tree while it is off; or one of so many seeds."""
    path = tree / switch.path
    source = path.read_text()
    path.write_text(source.replace(switch.old, switch.new))
    try:
        command = [sys.executable, "-m"]
        if seeds:
            command += ["tests.sync_sim", "--seeds", f"{seeds}", "--jobs", "1", "--until-wrong"]
        else:
            command += ["pytest", "-q", "-x", "-p", "no:cacheprovider", f"tests/{switch.caught_by}"]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(str(tree / folder) for folder in FOLDERS)}
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, timeout=LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        return True
    finally:
        path.write_text(source)
    return done.returncode == 1  # and not 4: no such test


if __name__ == "__main__":
    sys.exit(main())
