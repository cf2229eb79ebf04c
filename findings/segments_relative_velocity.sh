#!/usr/bin/env bash
# guess: the relative velocity of add_kinematics_to_label is that of the object less that of the own vehicle in the same frames.
# happens: the first box of a track is paired with the first pose of the recording: a track that begins later gets the velocity of
#          the own vehicle from other frames. A car that keeps its distance is said to move at 5 m/s beside the own one.
# versions: segments-ai 1.33.0, numpy 2.4.6
# date: 2026-12-02
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check segments-ai==1.33.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

from segments.typing import Label, Sample
from segments.utils import add_kinematics_to_label

print('segments-ai', version('segments-ai'), 'numpy', version('numpy'))

# The own vehicle drives 5 m/s for five frames, one a second, and 10 m/s afterwards.
driven = [0, 5, 10, 15, 20, 30, 40, 50, 60]


def labelled(first):
    """Two cars that keep 20 m ahead, labelled from frame 0 and from frame `first` on, in world coordinates."""
    frames = []
    for frame, x in enumerate(driven):
        box = {'category_id': 1, 'position': {'x': x + 20.0, 'y': 0.0, 'z': 0.0},
               'dimensions': {'x': 4.0, 'y': 2.0, 'z': 1.5}, 'yaw': 0.0, 'type': 'cuboid'}
        boxes = [{'id': track, 'track_id': track, **box} for track in (1, 2) if track == 1 or frame >= first]
        frames.append({'annotations': boxes, 'timestamp': str(frame * 10**9)})
    return Label.model_validate(
        {'sample_uuid': 'a', 'label_type': 'pointcloud-cuboid-sequence', 'label_status': 'LABELED', 'labelset': 'truth',
         'attributes': {'frames': frames, 'format_version': '0.2'}, 'created_at': '', 'created_by': '',
         'updated_at': ''})


sample = Sample.model_validate(
    {'uuid': 'a', 'name': 'drive', 'metadata': {}, 'created_at': '', 'created_by': '', 'priority': 0,
     'attributes': {'frames': [
         {'pcd': {'url': 'a.pcd', 'type': 'pcd'}, 'timestamp': str(frame * 10**9), 'ego_pose': {
             'position': {'x': float(x), 'y': 0.0, 'z': 0.0},
             'heading': {'qx': 0.0, 'qy': 0.0, 'qz': 0.0, 'qw': 1.0}}}
         for frame, x in enumerate(driven)]}})
relative = {1: [], 2: []}
for frame in add_kinematics_to_label(sample, labelled(first=4)).attributes.frames:
    for box in frame.annotations:
        relative[box.track_id].append(box.velocity.relative if box.velocity else None)
print('relative velocity [m/s], labelled from the first frame:', relative[1])
print('from the fifth frame:', relative[2])
assert relative[1] == [None] + [0.0] * 8
assert relative[2] == [None] + [5.0] * 4
PYTHON
