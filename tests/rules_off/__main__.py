"""Switch each rule off in a copy of the tree, and see its test fail.

$ python -m tests.rules_off 5 9     # these rules; default: all
"""

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
    rules = {int(text) for text in sys.argv[1:]}
    unnoticed = 0
    with tempfile.TemporaryDirectory() as name:
        tree = Path(name)
        for folder in (*FOLDERS, "tests"):
            shutil.copytree(ROOT / folder, tree / folder)
        shutil.copy2(ROOT / "pyproject.toml", tree)
        for switch in SWITCHES:
            if not rules or switch.rule in rules:
                noticed = is_noticed(tree, switch)
                unnoticed += not noticed
                sys.stdout.write(f"{switch.rule:>3}  {'noticed' if noticed else 'UNNOTICED':<10}{switch.without}\n")
                sys.stdout.flush()
    return min(1, unnoticed)


def is_noticed(tree: Path, switch: Switch) -> bool:
    """Whether its test fails in the tree while it is off."""
    path = tree / switch.path
    source = path.read_text()
    path.write_text(source.replace(switch.old, switch.new))
    try:
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", f"tests/{switch.caught_by}"]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(str(tree / folder) for folder in FOLDERS)}
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, timeout=LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        return True
    finally:
        path.write_text(source)
    return done.returncode == 1  # and not 4: no such test


if __name__ == "__main__":
    sys.exit(main())
