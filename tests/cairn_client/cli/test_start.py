"""Start of a robot's program: libraries that it loads only when they are needed."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.processes


@pytest.mark.parametrize(
    ("program", "late"),
    [
        ("import cairn_client.robot.robot", ["httpx", "rich", "cv2", "rosbags", "mcap", "ruamel.yaml"]),
        ("from cairn_client.main import main; main(['--help'])", ["numba", "numpy", "httpx", "rich"]),
    ],
)
def test_what_is_needed_later_is_loaded_later(program: str, late: list[str]) -> None:
    told = f"{program}\nimport sys\nsys.stderr.write(' '.join(name for name in {late} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", told], check=True, capture_output=True, text=True)
    assert done.stderr == ""
