"""A pair of cameras on the fuselage that looks along a wing, for tests that project and triangulate."""

import cv2
import numpy as np

from process.camera_model import CameraModel, RigSide, StereoPair


def mounted(out: float, row_time_ns: float = 0.0) -> RigSide:
    """A pair on the fuselage that looks along the wing of side ``out`` (+1 right), pitched 8° up; 0.28 m apart."""
    pitch = np.radians(8.0)
    forward, right = np.array([0.0, out * np.cos(pitch), np.sin(pitch)]), np.array([out, 0.0, 0.0])
    T_body_cam0 = np.eye(4)
    T_body_cam0[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    T_body_cam0[:3, 3] = np.array([0.03, -out * 0.2, 0.08]) - 0.14 * right
    T_cam1_cam0 = np.eye(4)
    T_cam1_cam0[:3, :3] = cv2.Rodrigues(np.array([0.003, 0.008, -0.005]))[0]
    T_cam1_cam0[:3, 3] = [-0.2794, 0.002, -0.001]
    camera = CameraModel(
        2080, 1552, np.array([[1400.0, 0, 1040], [0, 1400, 776], [0, 0, 1]]), np.array([-0.1, 0.02, 3e-4, -2e-4, 0])
    )
    return RigSide(StereoPair(camera, camera, T_cam1_cam0), T_body_cam0, "0", "1", row_time_ns)
