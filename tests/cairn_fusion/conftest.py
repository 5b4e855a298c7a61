import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def test_data() -> Path:
    folder = os.environ.get("CAIRN_TEST_DATA")
    if not folder:
        pytest.skip("CAIRN_TEST_DATA does not name the folder of real recordings")
    return Path(folder)
