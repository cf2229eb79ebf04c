#!/usr/bin/env bash
# guess: Datumaro's KITTI raw export gives the state 1 (interpolated) to poses between keyframes, and 2 (labelled) to keyframes
# happens: every pose has the state 2; that it is no keyframe is in occlusion_kf alone, which KITTI has for occlusion
# versions: datumaro 1.13.12
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --no-deps datumaro==1.13.12 attrs==26.1.0 imagesize==2.0.1 json-stream==2.5.1 \
    json-stream-rs-tokenizer==0.5.4 lxml==6.1.3 defusedxml==0.7.1 numpy==2.4.6 opencv-python-headless==4.11.0.86 orjson==3.13.0 \
    pandas==3.1.1 python-dateutil==4.0.0 six==1.17.0 pillow==13.0.0 pycocotools==2.0.11 PyYAML==6.0.3 shapely==2.0.7 tqdm==4.70.1 \
    typing-extensions==4.16.0
"$folder/venv/bin/python" -W ignore - "$folder" <<'PYTHON'
from importlib.metadata import version
from pathlib import Path
import sys
from xml.etree import ElementTree

from datumaro.components.annotation import Cuboid3d
from datumaro.components.dataset import Dataset
from datumaro.components.dataset_base import DatasetItem
from datumaro.components.media import PointCloud

print('datumaro', version('datumaro'))
items = []
for number, is_keyframe in enumerate([True, False, False, True]):
    attributes = {'track_id': 1, 'occluded': False, 'keyframe': is_keyframe}
    car = Cuboid3d([10.0 + number, 3.0, -1.0], [0.0, 0.0, 0.3], [4.5, 1.9, 1.6], label=0, attributes=attributes)
    items.append(DatasetItem(str(number), annotations=[car], attributes={'frame': number}))
out = Path(sys.argv[1], 'kitti')
Dataset.from_iterable(items, categories=['car'], media_type=PointCloud).export(str(out), 'kitti_raw')
poses = ElementTree.parse(out / 'tracklet_labels.xml').findall('tracklets/item/poses/item')
found = [(pose.findtext('state'), pose.findtext('occlusion_kf')) for pose in poses]
print('state, occlusion_kf:', *found)
assert found == [('2', '1'), ('2', '0'), ('2', '0'), ('2', '1')]
PYTHON
