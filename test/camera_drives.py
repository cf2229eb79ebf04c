"""Drives with two cameras, ahead and back, as other programs record them."""

from io import BytesIO

import numpy as np

WIDTH, HEIGHT, FOCAL = 320, 240, 150.0
MOUNT = np.array([0.5, 0.0, 1.5])
FORWARD = (-0.5, 0.5, -0.5, 0.5)
"""Axes of a camera that looks ahead: x right, y down, z forward."""
BACKWARD = (0.5, 0.5, -0.5, -0.5)
LATE = 30_000_000
IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED = 'sensor_msgs/msg/CompressedImage'
INFO = 'sensor_msgs/msg/CameraInfo'


def picture(level):
    """Return an image of one grey level."""
    return np.full((HEIGHT, WIDTH, 3), level, np.uint8)


def as_file(pixels, kind):
    from PIL import Image as Picture

    file = BytesIO()
    Picture.fromarray(pixels).save(file, kind)
    return np.frombuffer(file.getvalue(), np.uint8)


def info(messages, stamp, frame_id, distortion=()):
    matrix = [FOCAL, 0, WIDTH / 2, 0, FOCAL, HEIGHT / 2, 0, 0, 1]
    names = ('d', 'k', 'r', 'p')
    values = (distortion, matrix, np.eye(3).ravel(), [*matrix[:3], 0, *matrix[3:6], 0, 0, 0, 1, 0])
    if messages.ros1:
        names = tuple(name.upper() for name in names)
    return messages.build(
        INFO, header=messages.header(stamp, frame_id), height=HEIGHT, width=WIDTH,
        distortion_model='plumb_bob',
        **{n: np.array(v, np.float64) for n, v in zip(names, values, strict=True)},
    )  # fmt: skip


def with_cameras(drive):
    """Add a camera ahead, 30 ms after each other sweep, and one that looks back, as raw images."""
    m = drive.messages
    start = drive.stamps[0]
    for frame_id, turn in (('ahead', FORWARD), ('back', BACKWARD)):
        pose = m.tf(m.transform(start, 'base', frame_id, MOUNT, turn))
        drive.items.append(('/tf_static', start, pose))
    for k, stamp in enumerate(drive.stamps):
        if k % 2 == 0:
            at = stamp + LATE
            message = m.build(
                COMPRESSED, header=m.header(at, 'ahead'), format='jpeg',
                data=as_file(picture(10 * k), 'JPEG'),
            )  # fmt: skip
            drive.items.append(('/front/image_raw/compressed', at, message))
            drive.items.append(('/front/camera_info', at, info(m, at, 'ahead', [-0.1, 0, 0, 0])))
        message = m.build(
            IMAGE, header=m.header(stamp, 'back'), height=HEIGHT, width=WIDTH, encoding='bgr8',
            step=3 * WIDTH, data=(picture(200) * [1, 0, 0]).astype(np.uint8).ravel(),
        )  # fmt: skip
        drive.items.append(('/rear/image_rect', stamp, message))
        drive.items.append(('/rear/camera_info', stamp, info(m, stamp, 'back')))
    return drive
