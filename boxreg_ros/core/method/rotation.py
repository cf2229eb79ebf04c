"""R = Rz(yaw) Ry(pitch) Rx(roll) of one box and its derivatives, as plain loops call it."""

from math import cos, sin

from boxreg_ros.core.method.compile import loop


@loop
def fill_rotation(roll, pitch, yaw, R):
    """Write R (3, 3)."""
    cr, sr = cos(roll), sin(roll)
    cp, sp = cos(pitch), sin(pitch)
    cy, sy = cos(yaw), sin(yaw)
    R[0, 0] = cy * cp
    R[0, 1] = cy * sp * sr - sy * cr
    R[0, 2] = cy * sp * cr + sy * sr
    R[1, 0] = sy * cp
    R[1, 1] = sy * sp * sr + cy * cr
    R[1, 2] = sy * sp * cr - cy * sr
    R[2, 0] = -sp
    R[2, 1] = cp * sr
    R[2, 2] = cp * cr


@loop
def fill_rotation_derivatives(roll, pitch, yaw, R, dR):
    """Write R (3, 3) and its derivatives dR (3, 3, 3) by roll, pitch and yaw, in front."""
    fill_rotation(roll, pitch, yaw, R)
    cy, sy = cos(yaw), sin(yaw)
    for j in range(3):
        # Roll turns the y axis into z; pitch turns about the yawed y axis; yaw turns the rows.
        dR[0, j, 0] = 0.0
        dR[0, j, 1] = R[j, 2]
        dR[0, j, 2] = -R[j, 1]
        dR[1, 0, j] = cy * R[2, j]
        dR[1, 1, j] = sy * R[2, j]
        dR[1, 2, j] = -cy * R[0, j] - sy * R[1, j]
        dR[2, 0, j] = -R[1, j]
        dR[2, 1, j] = R[0, j]
        dR[2, 2, j] = 0.0
