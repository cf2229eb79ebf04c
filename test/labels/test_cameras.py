"""Camera images and calibrations beside labels, from a real recording with two cameras."""

import json

from boxreg_ros.cli import main
from boxreg_ros.errors import ConfigError
from boxreg_ros.labels import Options, Provenance, writer_for
from camera_drives import with_cameras
from consumers import consumer
import numpy as np
import pytest
from ros_messages import Drive

pytest.importorskip('PIL.Image')
QUICK = ['--set', 'solver.rounds=2', '--set', 'sampling.points=64']
FRONT, REAR = 'front_image_raw_compressed', 'rear_image_rect'
K = [150.0, 0, 160.0, 0, 150.0, 120.0, 0, 0, 1]
# x right, y down, z forward: p_camera = (-y, -z, x) of the place minus (0.5, 0, -0.5), since the
# LiDAR is 2 m above the frame in which the camera is at (0.5, 0, 1.5).
T_AHEAD = [0, -1, 0, 0, 0, 0, -1, -0.5, 1, 0, 0, -0.5, 0, 0, 0, 1]


@pytest.fixture(scope='module')
def drive(tmp_path_factory):
    """Return a folder with a recording of two cameras and its labels in four formats."""
    folder = tmp_path_factory.mktemp('cameras')
    recording = with_cameras(Drive()).write(folder / 'drive')
    formats = 'sustechpoints,xtreme1,supervisely,nuscenes,t4'
    words = ['relabel', str(recording), '-o', str(folder / 'out'), '--formats', formats]
    assert main([*words, '--with-images', *QUICK]) == 0
    return recording, folder / 'out'


def json_of(path):
    return json.loads(path.read_text())


def test_tools_get_the_nearest_image_of_each_camera_and_its_calibration(drive):
    _, out = drive
    scene = out / 'sustechpoints'
    names = sorted(path.stem for path in (scene / 'label').iterdir())
    for camera in (FRONT, REAR):
        assert sorted(path.stem for path in (scene / 'camera' / camera).iterdir()) == names
    calibration = json_of(scene / 'calib' / 'camera' / f'{FRONT}.json')
    np.testing.assert_allclose(calibration['extrinsic'], T_AHEAD, atol=1e-9)
    assert calibration['intrinsic'] == K
    first, second = ((scene / 'camera' / FRONT / f'{names[k]}.jpg').read_bytes() for k in (0, 1))
    assert first == second  # 70 ms are nearer than 130
    assert first != (scene / 'camera' / FRONT / f'{names[2]}.jpg').read_bytes()

    scene = out / 'xtreme1' / 'scene_1'
    assert sorted(path.stem for path in (scene / 'camera_image_1').iterdir()) == names
    (ahead, _) = json_of(scene / 'camera_config' / f'{names[0]}.json')
    np.testing.assert_allclose(ahead['camera_external'], T_AHEAD, atol=1e-9)
    assert ahead['camera_internal'] == {'fx': 150, 'fy': 150, 'cx': 160, 'cy': 120}
    assert (ahead['width'], ahead['height'], ahead['rowMajor']) == (320, 240, True)

    folder = out / 'supervisely' / 'episode' / 'related_images' / f'{names[0]}_pcd'
    meta = json_of(folder / f'{FRONT}.jpg.json')['meta']
    assert meta['deviceId'] == FRONT
    np.testing.assert_allclose(meta['sensorsData']['extrinsicMatrix'], T_AHEAD[:12], atol=1e-9)
    assert json_of(out / 'xtreme1' / 'boxreg.json')['images'] == {
        '/front/image_raw/compressed': len(names), '/rear/image_rect': len(names)
    }  # fmt: skip


def test_nuscenes_devkit_projects_boxes_into_the_images(drive):
    _, out = drive
    channel = f'CAM_{FRONT.upper()}'
    found = consumer('nuscenes_images', out / 'nuscenes', 'v1.0-boxreg', channel)
    assert found and all(image['size'] == [320, 240] for image in found)
    for image in found:
        assert image['intrinsic'] == np.reshape(K, (3, 3)).tolist()
        for centre, local in zip(image['in_lidar'], image['in_camera'], strict=True):
            x, y, z = np.subtract(centre, [0.5, 0, -0.5])
            np.testing.assert_allclose(local, [-y, -z, x], atol=1e-6)


def test_the_camera_of_kitti_is_that_of_the_recording(drive, tmp_path, capsys):
    recording, _ = drive
    words = ['relabel', str(recording), '--formats=kitti', *QUICK, '-o']
    assert main([*words, str(tmp_path / 'a')]) == 2
    error = capsys.readouterr().err
    assert 'got 2 in ' in error
    assert '/front/image_raw/compressed, /rear/image_rect; give --camera TOPIC' in error
    assert main([*words, str(tmp_path / 'b'), '--camera=/rear/image_rect']) == 0
    lines = (tmp_path / 'b' / 'kitti' / 'calib' / '0000.txt').read_text().splitlines()
    values = {line.split(':')[0]: line.split(':')[1].split() for line in lines}
    assert [float(one) for one in values['P2']] == [150, 0, 160, 0, 0, 150, 120, 0, 0, 0, 1, 0]
    # Looks back: p_camera = (y, -z, -x) of the same place
    expected = [0, 1, 0, 0, 0, 0, -1, -0.5, -1, 0, 0, 0.5]
    np.testing.assert_allclose(np.array(values['Tr_velo_cam'], float), expected, atol=1e-9)


def test_images_need_a_recording(tmp_path):
    with pytest.raises(ConfigError, match='--with-images: expected a recording with camera'):
        writer_for('xtreme1', tmp_path, Provenance(), Options(with_images=True))
    with pytest.raises(ConfigError, match='--camera FILE'):
        writer_for('kitti', tmp_path, Provenance(), Options())
