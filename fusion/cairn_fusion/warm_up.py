"""Warm-up: every kernel of this package, run once on a tiny scan, so that Numba compiles and caches it."""

from dataclasses import replace
from importlib.util import find_spec

import numpy as np

from cairn_calib.rig.camera import camera_from_field_of_view
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.clouds.lzf_kernels import decompress_into
from cairn_fusion.mapping.integrate import Integrator, Method, integrate_scan, integrate_scans
from cairn_fusion.mapping.ray_casting import carried
from cairn_fusion.recording.scan import Scan
from cairn_fusion.transfer.covariance_grid import CovarianceGrid
from cairn_fusion.transfer.transfer import depth_steps
from cairn_map.evidence.channels import classes_channel
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import Geometry, geometry_for, level_geometry
from cairn_map.queries.map_snapshot import snapshot_of
from cairn_map.render.camera_rays import CameraRays
from cairn_map.render.map_render import MapRenderer
from cairn_map.render.pose_spread import PoseSpread


def warm_up() -> None:
    """Integrate a scan of three images of two by two pixels, from images to evidence, and look at it."""
    camera = camera_from_field_of_view(2, 2, horizontal_deg=60.0)
    beside = np.eye(4)
    beside[0, 3] = 0.01
    spectra = {"tof": Spectrum.RANGE, "colour": Spectrum.COLOUR, "thermal": Spectrum.THERMAL}
    cameras = {name: mount_camera(spectrum, camera, beside) for name, spectrum in spectra.items()}
    rig = Rig(name="warm-up", cameras=cameras | {"tof": mount_camera(Spectrum.RANGE, camera, np.eye(4))})
    image = np.ones((2, 2), np.float32)
    with_gap = image.copy()
    with_gap[0, 0] = np.nan
    scan = Scan(
        time_s=0.0,
        T_map_rig=np.eye(4),
        range_camera="tof",
        range_m=with_gap,
        amplitude=np.ones((2, 2), np.uint16),
        colour={"colour": np.zeros((2, 2, 3), np.uint8)},
        thermal={"thermal": 300 * image},
    )
    integrate_scans([scan, scan], rig, Geometry(), integrator=Integrator(), threads=2)
    integrate_scan(scan, rig, Geometry(), integrator=Integrator(method=Method.CAST))
    carried(np.zeros((1, 3)), np.eye(4))  # points of a sweep
    depth_steps(np.ones((2, 2, 3)))
    integrate_scan(scan, rig, level_geometry(), integrator=Integrator())
    labelled = replace(scan, labels={"tof": np.zeros((2, 2), np.uint8)}, label_names={0: "wall"})
    classed = geometry_for(voxel_edge_m=0.05, channels=(classes_channel(("wall",)),))
    integrate_scans([labelled, labelled], rig, classed, integrator=Integrator())
    decompress_into(np.zeros(2, np.uint8), np.zeros(1, np.uint8))
    covariance = CovarianceGrid.of(rig, src="tof", dst="colour")
    covariance.at(np.zeros((1, 2)), np.ones(1, np.float32), np.ones(1, np.float32))
    if find_spec("cv2") is not None:
        _look(rig, scan)


def _look(rig: Rig, scan: Scan) -> None:
    """Fuse the scan, with a second thermal camera, into a picture, and draw a map over it: both need OpenCV."""
    from cairn_fusion.view.overlay import Live, OverlayStyle, draw_overlay
    from cairn_fusion.view.telepresence import Telepresence, ViewOptions

    both = Rig(name="warm-up", cameras={**rig.cameras, "second": rig["thermal"]})
    Telepresence(both, ViewOptions()).view(replace(scan, thermal={**scan.thermal, "second": scan.thermal["thermal"]}))
    for spread in (PoseSpread.of_sigmas(), PoseSpread.of_sigmas(0.01, 0.01)):
        live = Live(
            rgb=scan.colour["colour"],
            range_m=scan.range_m,
            sight=CameraRays(rig["colour"].camera.rays()),
            T_map_camera=np.eye(4),
            spread=spread,
        )
        draw_overlay(MapRenderer(), snapshot_of(EvidenceMap(Geometry())), live, OverlayStyle(step_px=1))
