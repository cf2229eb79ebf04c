"""Camera images and calibrations beside labels, from a real recording with two cameras."""

import json

from boxreg_ros.cli import main
from boxreg_ros.errors import ConfigError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.fixed_frame import input_boxes
from boxreg_ros.io.recording import Recording
from boxreg_ros.labels import frames_of, Options, Provenance, writer_for
from camera_drives import COMPRESSED, IMAGE, info, with_cameras
from consumers import consumer
import numpy as np
from paths import BAGS
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
    """Return a recording of two cameras, and the folder of its labels in several formats."""
    folder = tmp_path_factory.mktemp('cameras')
    recording = with_cameras(Drive()).write(folder / 'drive')
    formats = 'sustechpoints,xtreme1,supervisely,sly_pointcloud,datumaro,nuscenes,t4'
    words = ['relabel', str(recording), '-o', str(folder / 'out'), '--formats', formats]
    assert main([*words, '--with-images', '--with-points', *QUICK]) == 0
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


@pytest.mark.parametrize('name', ['supervisely', 'sly_pointcloud'])
def test_supervisely_finds_the_images_and_their_calibration(drive, name):
    _, out = drive
    for found in consumer('supervisely_images', out / name, name):
        (ahead, back) = sorted(found['images'], key=lambda image: image['name'])
        assert (ahead['name'], back['name']) == (f'{FRONT}.jpg', f'{REAR}.jpg')
        assert ahead['size'] == [320, 240]
        assert ahead['meta']['deviceId'] == FRONT
        sensors = ahead['meta']['sensorsData']
        np.testing.assert_allclose(sensors['extrinsicMatrix'], T_AHEAD[:12], atol=1e-9)
        assert sensors['intrinsicMatrix'] == K


def test_datumaro_finds_the_images(drive):
    _, out = drive
    items = consumer('datumaro_images', out / 'datumaro')
    assert len(items) > 3
    for item, images in items.items():
        assert images == {f'{item}/{FRONT}.jpg': [240, 320], f'{item}/{REAR}.jpg': [240, 320]}
    (image, _) = json_of(out / 'datumaro/annotations/default.json')['items'][0]['related_images']
    assert image['boxreg']['intrinsic'] == K
    np.testing.assert_allclose(image['boxreg']['extrinsic'], T_AHEAD[:12], atol=1e-9)


def test_the_camera_of_kitti_is_that_of_the_recording(drive, tmp_path, capsys):
    recording, _ = drive
    words = ['relabel', str(recording), '--formats=kitti,kitti_object', *QUICK, '-o']
    assert main([*words, str(tmp_path / 'a')]) == 2
    error = capsys.readouterr().err
    assert 'got 2 in ' in error
    assert '/front/image_raw/compressed, /rear/image_rect; give --camera TOPIC' in error
    out = tmp_path / 'b'
    assert main([*words, str(out), '--camera=/rear/camera_info', '--with-images']) == 0
    # Looks back: p_camera = (y, -z, -x) of the same place
    expected = [0, 1, 0, 0, 0, 0, -1, -0.5, -1, 0, 0, 0.5]
    values = calibration(out / 'kitti' / 'calib' / '0000.txt')
    assert values['P2'] == [150, 0, 160, 0, 0, 150, 120, 0, 0, 0, 1, 0]
    np.testing.assert_allclose(values['Tr_velo_cam'], expected, atol=1e-9)
    names = sorted(path.stem for path in (out / 'kitti_object/label_2').iterdir())
    values = calibration(out / 'kitti_object/calib' / f'{names[0]}.txt')
    np.testing.assert_allclose(values['Tr_velo_to_cam'], expected, atol=1e-9)
    for folder in ('kitti/image_02/0000', 'kitti_object/image_2'):
        images = sorted((out / folder).iterdir())
        assert len(images) == len(names)
        assert size_of(images[0]) == (320, 240)
    assert sorted(path.stem for path in images) == names
    words = [*words[:3], '--set', 'solver.rounds=1', f'--camera={out}/kitti/calib/0000.txt']
    assert main([*words, '--with-images', '-o', str(tmp_path / 'c')]) == 2
    assert 'expected --camera TOPIC, whose images' in capsys.readouterr().err


def calibration(path):
    """Return the numbers of each line by its name."""
    lines = (line.split(': ') for line in path.read_text().splitlines())
    return {name: [float(word) for word in words.split()] for name, words in lines}


def size_of(path):
    from PIL import Image

    with Image.open(path) as image:
        assert image.format == 'PNG'
        return image.size


@pytest.mark.parametrize('frame', ['lidar', 'base'])
def test_the_only_camera_info_is_enough_without_images(tmp_path, frame):
    drive = with_cameras(Drive(sweeps=3))
    left_out = ('/front/image_raw/compressed', '/rear/image_rect', '/rear/camera_info')
    drive.items = [item for item in drive.items if item[0] not in left_out]
    recording = drive.write(tmp_path / 'drive')
    labels = tmp_path / 'boxes.csv'
    BoxTable.from_arrays(input_boxes(Recording([recording]))[0]).write(labels)
    words = ['convert', str(labels), '--from=csv', '--to=kitti_object', '-o', str(tmp_path / 'a')]
    assert main([*words, f'--recording={recording}', f'--label-frame={frame}']) == 0
    path = next((tmp_path / 'a/kitti_object/calib').iterdir())
    # The camera is at (0.5, 0, 1.5) in the frame `base`, above which the LiDAR is by 2 m.
    down = -0.5 if frame == 'lidar' else 1.5
    expected = [0, -1, 0, 0, 0, 0, -1, down, 1, 0, 0, -0.5]
    np.testing.assert_allclose(calibration(path)['Tr_velo_to_cam'], expected, atol=1e-9)


def test_without_a_camera_one_is_assumed_and_said(tmp_path, capsys):
    boxes = np.array([[8, 1, 0.5, 4.5, 1.9, 1.6, 0, 0, 0.3], [-8, 1, 0, 4.5, 1.9, 1.6, 0, 0, 0]])
    (tmp_path / '1700000000000000000.txt').write_text(
        '8 1 0.5 4.5 1.9 1.6 0.3 car\n-8 1 0 4.5 1.9 1.6 0 car\n'
    )
    words = ['convert', str(tmp_path), '--from=openpcdet', '--to=kitti_object,kitti', '-o']
    assert main([*words, str(tmp_path / 'out')]) == 0
    printed = capsys.readouterr().out
    for name in ('kitti', 'kitti_object'):
        assert f'format {name}: no camera is known: one at the LiDAR that looks along' in printed
    folder = tmp_path / 'out/kitti_object'
    (labels,) = (folder / 'label_2').iterdir()
    # OpenPCDet reads the third, fifth and sixth line, and the size of the image of that name.
    lines = (folder / 'calib' / labels.name).read_text().splitlines()
    assert [lines[k].split(':')[0] for k in (2, 4, 5)] == ['P2', 'R0_rect', 'Tr_velo_to_cam']
    assert size_of(folder / 'image_2' / f'{labels.stem}.png') == (1242, 1242)
    ahead, behind = (line.split() for line in labels.read_text().splitlines())
    left, top, right, bottom = map(float, ahead[4:8])
    # The centre is at (8, 1, 0.5): x = -1 and y = -0.5 at the depth 8
    assert left < 621 - 621 / 8 < right
    assert top < 621 - 0.5 * 621 / 8 < bottom
    assert behind[4:8] == ['-1.000000'] * 4
    (found,) = frames_of('kitti_object', folder)
    np.testing.assert_allclose(found.refined.boxes.boxes, boxes, atol=1e-6)


def test_images_that_cannot_be_read_are_left_out_and_said(tmp_path, capsys):
    drive = with_cameras(Drive())
    m = drive.messages
    first = next(item[2] for item in drive.items if item[0] == '/front/image_raw/compressed')
    first.data = first.data[:50]  # of a JPEG file: its size can be read
    for stamp in drive.stamps:
        drive.items.append(('/depth/camera_info', stamp, info(m, stamp, 'ahead')))
        depth = m.build(IMAGE, header=m.header(stamp, 'ahead'), height=1, width=1,
                        encoding='32FC1', step=4, data=np.zeros(4, np.uint8))  # fmt: skip
        drive.items.append(('/depth/image_rect_raw', stamp, depth))
        image = m.build(COMPRESSED, header=m.header(stamp, 'nowhere'), format='jpeg',
                        data=first.data)  # fmt: skip
        drive.items.append(('/lost/image_raw/compressed', stamp, image))
    recording = drive.write(tmp_path / 'drive')
    words = ['relabel', str(recording), '--with-images', *QUICK, '-o']
    assert main([*words, str(tmp_path / 'a'), '--formats=sustechpoints']) == 0
    printed = capsys.readouterr().err
    assert f'{len(drive.stamps)} images are missing or cannot be read; first: /depth' in printed
    assert 'images of /lost/image_raw/compressed are left out: expected a CameraInfo' in printed
    images = json_of(tmp_path / 'a/sustechpoints/boxreg.json')['images']
    assert images['/rear/image_rect'] == images['/depth/image_rect_raw missing'] == 8
    camera = ['--formats=kitti_object', '--camera=/front/camera_info']
    assert main([*words, str(tmp_path / 'b'), *camera]) == 0
    assert '2 images are missing or cannot be read; first: /front' in capsys.readouterr().err
    assert (
        main(
            [
                'relabel',
                *words[2:],
                str(tmp_path / 'c'),
                str(BAGS / 'street.mcap'),
                '--formats=t4',
                '--end=1',
            ]
        )
        == 0
    )
    assert 'no image is written' in capsys.readouterr().err


def test_a_camera_in_a_frame_that_is_not_optical_is_named(tmp_path, capsys):
    drive = with_cameras(Drive())
    for _, _, message in drive.items:
        for transform in getattr(message, 'transforms', ()):
            if transform.child_frame_id == 'ahead':
                turn = transform.transform.rotation
                turn.x, turn.y, turn.z, turn.w = 0.0, 0.0, 0.0, 1.0
    words = ['relabel', str(drive.write(tmp_path / 'drive')), '-o', str(tmp_path / 'out')]
    assert main([*words, '--formats=sustechpoints', '--with-images', *QUICK]) == 0
    printed = capsys.readouterr().err
    assert "the camera looks up: 'ahead' is no optical frame" in printed
    assert '/rear' not in printed


def test_images_need_a_recording(tmp_path):
    with pytest.raises(ConfigError, match='--with-images: expected a recording with camera'):
        writer_for('xtreme1', tmp_path, Provenance(), Options(with_images=True))
