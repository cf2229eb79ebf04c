"""Poses that several data sets share."""

from __future__ import annotations

from collections.abc import Sequence

from boxreg_ros.rotations import quaternion_from_matrix
from boxreg_ros.structures import Floats
import numpy as np


def pose_rows(transforms: Sequence[Floats]) -> Floats:
    """Return poses x y z qx qy qz qw, shape (P, 7), of P matrices (4, 4)."""
    poses = np.zeros((len(transforms), 7))
    for pose, T in zip(poses, transforms, strict=True):
        pose[:3] = T[:3, 3]
        pose[3:] = quaternion_from_matrix(T[:3, :3])
    return poses
