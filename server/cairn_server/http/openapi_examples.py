"""Examples of request bodies, for the OpenAPI document; each is one that the server takes."""

from typing import Any

EXAMPLES: dict[tuple[str, str], Any] = {
    ("put", "/maps/{name}"): {
        "geometry": {"voxel_edge_um": 40_000, "depth": 7},
        "sensor_model": {"p_hit": 0.7, "p_miss": 0.4},
    },
    ("post", "/maps/{name}/branches"): {
        "robot": "mole",
        "mode": "high-end",
        "incarnation": "1f2e3d4c5b6a7988",
        "sensors": ["tof", "colour", "thermal"],
    },
    ("post", "/maps/{name}/branches/{branch}/missing"): {
        "author": "mole.1f2e3d4c5b6a7988",
        "cursor": None,
        "kinds": ["delta", "full"],
    },
    ("post", "/maps/{name}/retracts"): {"commits": ["mole.1f2e3d4c5b6a7988.12"], "note": "wrong calibration"},
    ("post", "/maps/{name}/main/export/tickets"): {"format": "laz", "box": "-4,-4,0,4,4,2.5", "p": 0.7},
    ("put", "/maps/{name}/branches/{branch}/status"): {
        "time_s": 1795253400.0,
        "pose": {
            "time_s": 1795253400.0,
            "t_map_rig": [1.5, -2.0, 0.4],
            "q_map_rig": [0.0, 0.0, 0.0, 1.0],
            "sigma_m": 0.05,
            "sigma_rad": 0.01,
        },
        "mode": "high-end",
        "waiting": 3,
        "waiting_bytes": 1500000,
        "battery": 0.8,
        "note": "at the stairs",
    },
}
