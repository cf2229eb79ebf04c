"""Camera images in the page of `boxreg review`, read from real recordings, in a real browser."""

from io import BytesIO
import shutil

from boxreg_ros.cli import main
from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.io.recording import Recording
from boxreg_ros.offline.review_command import drive_of
from boxreg_ros.review.server import review_server
from browser import NEEDS_BROWSER, opened_page, press, serving
from camera_drives import (
    as_file,
    COMPRESSED,
    FOCAL,
    HEIGHT,
    IMAGE,
    INFO,
    info,
    LATE,
    MOUNT,
    picture,
    WIDTH,
    with_cameras,
)
import numpy as np
import pytest
from ros_messages import Drive, SCENE

pytest.importorskip('plotly')
Picture = pytest.importorskip('PIL.Image')
QUICK = ['--set', 'solver.rounds=2', '--set', 'sampling.points=64']


def pixel_ahead(place, stamp, drive):
    """Return the pixel of a place in the image at a stamp, by the model of the lens."""
    sweep = (stamp - drive.stamps[0]) / 1e8
    x, y, z = place - MOUNT - [0.5 * sweep, 0, 0]
    u, v = -y / x, -z / x
    bend = 1 - 0.1 * (u * u + v * v)
    return np.array([FOCAL * u * bend + WIDTH / 2, FOCAL * v * bend + HEIGHT / 2])


@NEEDS_BROWSER
def test_boxes_are_shown_in_the_nearest_image_of_the_best_camera(tmp_path):
    drive = with_cameras(Drive())
    out = tmp_path / 'out'
    recording = drive.write(tmp_path / 'drive')
    assert main(['relabel', str(recording), '-o', str(out), '--report', *QUICK]) == 0
    assert b'image/jpeg' not in (out / 'report.html').read_bytes()
    with (
        serving(review_server([(out, drive_of(out))], 0, 'anna')) as server,
        opened_page(server.address + '#track=1') as page,
    ):
        for row, image in ((0, 0), (1, 0), (2, 2), (4, 4)):  # 70 ms are nearer than 130
            page.evaluate(f'step({row})')
            page.wait_for_function(f"cameras.shown === '1 ' + view.part.stamps[{row}]")
            stamp = drive.stamps[image] + LATE
            late = round((stamp - drive.stamps[row]) * 1e-6)
            assert f'/front/image_raw/compressed · {late:+d} ms' in page.inner_text('#camera-text')
            # The lower left of the image, away from the box, has its grey level.
            shown = page.evaluate("""(() => {
              const c = $('camera-view'), [x, y] = c.at([20, 225]);
              return [...c.getContext('2d').getImageData(x, y, 1, 1).data]; })()""")
            if shown[3]:
                assert shown[0] == pytest.approx(10 * image, abs=3)
            found = page.evaluate(f"""(async () => {{
              const stamp = view.part.stamps[{row}], camera = (await camerasAt(stamp))[0];
              const {{ pose }} = await imageAt(0, stamp);
              const box = boxAtTime(view.part, {row}, '{stamp}');
              return [box.slice(0, 3), pixelOf(camera, inCamera(pose, box))]; }})()""")
            assert found[1] == pytest.approx(pixel_ahead(found[0], stamp, drive), abs=0.5)
            truth = pixel_ahead(drive.truth[drive.stamps[0]][0][:3], stamp, drive)
            assert found[1] == pytest.approx(truth, abs=4)
        # The box is drawn there: its colour is along the outline.
        count = page.evaluate("""(() => {
          const c = $('camera-view'), hex = colour('refined').match(/[0-9a-f]{2}/g);
          const { data } = c.getContext('2d').getImageData(0, 0, c.width, c.height);
          const isNear = i => hex.every((v, k) => Math.abs(data[i + k] - parseInt(v, 16)) < 40);
          let n = 0;
          for (let i = 0; i < data.length; i += 4) n += isNear(i);
          return n; })()""")
        assert count > 100
        page.select_option('#camera-choice', '1')
        page.wait_for_function("$('camera-text').textContent.includes('/rear/image_rect')")
        assert 'not in this image' in page.inner_text('#camera-text')
        page.click('#tab-drive')
        page.wait_for_function("document.querySelectorAll('#drive-cameras canvas').length === 2")
        page.wait_for_function("Boolean(document.querySelectorAll('#drive-cameras canvas')[1].at)")
        shown = page.evaluate("""(() => {
          const c = document.querySelectorAll('#drive-cameras canvas')[1], [x, y] = c.at([9, 9]);
          return [...c.getContext('2d').getImageData(x, y, 1, 1).data]; })()""")
        assert np.abs(np.subtract(shown, [0, 0, 200, 255])).max() < 6  # bgr8
        # The points of the sweep in the image, by their distance: grey pixels get colours.
        page.evaluate("""(async () => {
          const stamp = sceneStamp(), { pose } = await imageAt(0, stamp);
          window.shown = { camera: (await camerasAt(stamp))[0], pose }; })()""")
        coloured = """(() => {
          const c = document.querySelector('#drive-cameras canvas'), context = c.getContext('2d');
          const { points, origin } = scene.sweep, { camera, pose } = window.shown, found = [];
          for (let i = 0; i < points.length; i += 3) {
            const at = inCamera(pose, [0, 1, 2].map(k => points[i + k] + origin[k]));
            const pixel = pixelOf(camera, at);
            if (!pixel || pixel.some((v, k) => v < 2 || v > camera.size[k] - 2)) continue;
            const rgb = [...context.getImageData(...c.at(pixel), 1, 1).data].slice(0, 3);
            found.push(Math.max(...rgb) - Math.min(...rgb) > 60);
          }
          return [found.length, found.filter(Boolean).length]; })()"""
        count, before = page.evaluate(coloured)
        assert count > 50
        assert before < count / 2  # the outlines of boxes
        page.check('#scene-in-image')
        page.wait_for_function(f'{coloured}[1] > 0.9 * {count}')
        page.uncheck('#scene-in-image')
        page.wait_for_function(f"{coloured}.join() === '{count},{before}'")


@NEEDS_BROWSER
def test_missing_clouds_and_damaged_images_are_said_where_they_are(tmp_path):
    drive = with_cameras(Drive())
    recording, out = drive.write(tmp_path / 'drive'), tmp_path / 'out'
    assert main(['relabel', str(recording), '-o', str(out), '--report', *QUICK]) == 0
    # Since then, half of the clouds and the content of the images were lost.
    last = drive.stamps[3]
    drive.items = [item for item in drive.items if item[0] != '/points' or item[1] <= last]
    for topic, _, message in drive.items:
        if topic.startswith('/front/image'):
            message.data = message.data[:40]
        if topic.startswith('/rear/image'):
            message.encoding = '64FC3'
    shutil.rmtree(tmp_path / 'drive')
    drive.write(tmp_path / 'drive')
    with (
        serving(review_server([(out, drive_of(out))], 0, 'anna')) as server,
        opened_page(server.address + '#track=1', expected='400') as page,
    ):
        page.wait_for_function("$('camera-text').textContent.includes('damaged')")
        page.select_option('#camera-choice', '1')
        page.wait_for_function("$('camera-text').textContent.includes('64FC3')")
        page.evaluate('step(3)')
        page.wait_for_function('view.cloud?.stamp === view.part.stamps[3]')
        page.evaluate('step(7)')
        page.wait_for_timeout(500)
        assert page.evaluate('view.cloud.stamp === view.part.stamps[3]')  # none at the last stamp
        page.click('#tab-drive')
        page.wait_for_function(
            "$('scene-clock').textContent.includes('no cloud here: that of 0.30')"
        )
        assert '64FC3' in page.inner_text('#drive-cameras')
        page.click('#tab-tracks')
        page.locator('#top').focus()
        press(page, 'a', 'log.count === 1')


@pytest.mark.parametrize('encoding', ['protobuf', 'json'])
def test_images_of_foxglove_are_those_of_ros(tmp_path, encoding):
    foxglove = pytest.importorskip('foxglove_recordings')
    drive = with_cameras(Drive(boxes=SCENE))
    encodings = {'/boxes': 'cdr', '/points': 'cdr', '/tf': encoding}
    path = foxglove.write_foxglove_mcap(tmp_path / 'foxglove.mcap', drive, encodings)
    with Recording([path]) as first, Recording([drive.write(tmp_path / 'ros')]) as second:
        found, expected = first.images(), second.images()
        assert len(found.cameras) == 2
        for one, other in zip(found.cameras, expected.cameras, strict=True):
            np.testing.assert_equal(one, other)
            for stamp in drive.stamps:
                assert found.nearest(one, stamp) == expected.nearest(other, stamp)


@pytest.mark.parametrize('ros1', [False, True])
def test_images_are_read_with_the_model_beside_them(tmp_path, ros1):
    drive = with_cameras(Drive(ros1=ros1, boxes='markers'))
    m = drive.messages
    start = drive.stamps[0]
    grey = (np.arange(WIDTH * HEIGHT) // 2).astype('<u2')
    odd = [
        ('/a/mono16', m.build(IMAGE, header=m.header(start, 'a'), height=HEIGHT, width=WIDTH,
                              encoding='mono16', step=2 * WIDTH, data=grey.view(np.uint8))),
        ('/a/short', m.build(IMAGE, header=m.header(start, 'a'), height=HEIGHT, width=WIDTH,
                             encoding='mono8', step=WIDTH, data=np.zeros(9, np.uint8))),
        ('/a/narrow', m.build(IMAGE, header=m.header(start, 'a'), height=HEIGHT, width=WIDTH,
                              encoding='rgb8', step=WIDTH,  # in pixels
                              data=np.zeros(3 * WIDTH * HEIGHT, np.uint8))),
        ('/a/other', m.build(IMAGE, header=m.header(start, 'a'), height=1, width=1,
                             encoding='64FC3', step=24, data=np.zeros(24, np.uint8))),
        ('/a/video', m.build(COMPRESSED, header=m.header(start, 'a'), format='h264',
                             data=np.zeros(9, np.uint8))),
    ]  # fmt: skip
    drive.items += [(topic, start, message) for topic, message in odd]
    with Recording([drive.write(tmp_path / 'drive', 'bag' if ros1 else 'mcap')]) as recording:
        images = recording.images()
        by_topic = {camera.topic: camera for camera in images.cameras}
        front, rear = by_topic['/front/image_raw/compressed'], by_topic['/rear/image_rect']
        assert (front.frame_id, front.size, front.model) == ('ahead', (WIDTH, HEIGHT), 'plumb_bob')
        assert front.distortion.tolist() == [-0.1, 0, 0, 0]
        assert not len(rear.distortion)  # rectified
        assert rear.matrix[:, :3].ravel()[:3].tolist() == [FOCAL, 0, WIDTH / 2]
        assert by_topic['/a/mono16'].matrix is None
        found = images.nearest(front, drive.stamps[3])
        assert (found.stamp_ns, found.media_type) == (drive.stamps[2] + LATE, 'image/jpeg')
        with Picture.open(BytesIO(found.content)) as shown:
            assert np.abs(np.asarray(shown).astype(int) - 20).max() < 4
        found = images.nearest(by_topic['/a/mono16'], start)
        with Picture.open(BytesIO(found.content)) as shown:
            assert np.asarray(shown).astype(int)[-1, -1] > 245
        for topic, text in (
            *(('/a/short', '9 bytes'), ('/a/narrow', f'pixels in {WIDTH} bytes')),
            *(('/a/other', '64FC3'), ('/a/video', 'h264')),
        ):
            with pytest.raises(UnsupportedMessage, match=text):
                images.nearest(by_topic[topic], start)
        with pytest.raises(RecordingError, match='expected an image within'):
            images.nearest(front, start + 10**10)


def cameras_with(tmp_path, *topics):
    """Return the cameras of a recording with (topic, image, CameraInfo) each, by topic."""
    drive = Drive(sweeps=1)
    m, start = drive.messages, drive.stamps[0]
    for topic, pixels, values in topics:
        message = m.build(
            COMPRESSED, header=m.header(start, values.pop('frame', 'ahead')), format='jpeg',
            data=as_file(pixels, 'JPEG'),
        )  # fmt: skip
        model = info(m, start, message.header.frame_id)
        fields = {name: getattr(model, name) for name in model.__dataclass_fields__}
        fields.pop('__msgtype__')
        arrays = {
            name: np.array(values.pop(name), np.float64) for name in ('r', 'p') if name in values
        }
        drive.items.append((topic, start, message))
        name = f'{topic.rpartition("/")[0]}/camera_info'
        drive.items.append((name, start, m.build(INFO, **fields | arrays | values)))
    with Recording([drive.write(tmp_path / 'drive')]) as recording:
        return {camera.topic: camera for camera in recording.images().cameras}


@pytest.mark.parametrize(
    ('shape', 'values', 'pixel'),
    [
        ((120, 160), {'binning_x': 2, 'binning_y': 2}, (95, 52.5)),
        ((120, 160), {}, (95, 52.5)),  # made smaller, which no CameraInfo states
        ((240, 320), {'binning_x': 2, 'binning_y': 2}, (190, 105)),  # the model is of this size
        (
            (100, 200),
            {'roi': {'x_offset': 40, 'y_offset': 20, 'width': 200, 'height': 100}},
            (150, 85),
        ),
        (
            (50, 100),
            {
                'binning_x': 2,
                'binning_y': 2,
                'roi': {'x_offset': 40, 'y_offset': 20, 'width': 200, 'height': 100},
            },
            (75, 42.5),
        ),
    ],
)
def test_the_model_is_that_of_the_pixels_of_the_image(tmp_path, shape, values, pixel):
    pixels = np.zeros((*shape, 3), np.uint8)
    camera = cameras_with(tmp_path, ('/cam/image_raw', pixels, values))['/cam/image_raw']
    assert camera.size == shape[::-1]
    # In the whole image (190, 105): the place is 0.2 to the right and 0.1 above, at a depth of 1
    u, v, w = camera.matrix @ [0.2, -0.1, 1, 1]
    assert (u / w, v / w) == pytest.approx(pixel)


def test_a_model_that_is_no_number_is_none(tmp_path):
    values = {'p': np.full(12, np.nan)}
    found = cameras_with(tmp_path, ('/cam/image_rect', picture(9), values))
    assert found['/cam/image_rect'].matrix is None


def test_rectified_images_are_turned_and_share_a_frame(tmp_path):
    angle, shift = 0.1, -30.0
    cos, sin = np.cos(angle), np.sin(angle)
    R = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    P = np.array([[FOCAL, 0, 160, shift], [0, FOCAL, 120, 0], [0, 0, 1, 0]])
    model = {'r': R.ravel(), 'p': P.ravel()}
    found = cameras_with(
        tmp_path,
        ('/left/image_rect', picture(9), {'r': R.ravel()}),
        ('/right/image_rect', picture(9), dict(model)),
        ('/alone/image_rect', picture(9), {'frame': 'other', **model}),
        ('/direction/image_raw', picture(9), {'frame': 'third', **model}),
    )
    place = np.array([0.5, -0.3, 4, 1])

    def pixel(topic):
        camera = found[topic]
        u, v, w = camera.matrix @ camera.T_image_camera @ place
        return u / w, v / w

    u, v, w = P @ [*R @ place[:3], 1]
    assert pixel('/right/image_rect') == pytest.approx((u / w, v / w))
    # The frame of a camera that no other camera has is where it is: P is not to move it again
    assert pixel('/alone/image_rect') == pytest.approx(((u - shift) / w, v / w))
    assert pixel('/left/image_rect') == pytest.approx(((u - shift) / w, v / w))
    raw = found['/direction/image_raw']  # is not rectified, by its name
    assert (raw.T_image_camera == np.eye(4)).all()
