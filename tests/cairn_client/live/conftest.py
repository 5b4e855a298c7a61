"""The head of the drive."""

import pytest
from tests.fixtures.client.live_run import MAKE, MAPPING
from tests.fixtures.fusion.bags import write_bag
from tests.fixtures.fusion.live_drive import drive, in_bag_order

from cairn_calib.rig.rig import Rig
from cairn_fusion.ros.bag_recording import open_bag_recording


@pytest.fixture(scope="session")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    folder = tmp_path_factory.mktemp("bags") / "drive"
    return open_bag_recording(write_bag(folder, "mcap", lambda make: in_bag_order(drive(MAKE))), MAPPING).rig
