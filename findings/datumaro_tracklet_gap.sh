#!/usr/bin/env bash
# guess: where a track is interrupted, Datumaro's KITTI raw export leaves the frame out, or marks it by the numbers of KITTI
# happens: it repeats the last pose, with the names of its own constants as occlusion and truncation, and cannot read its file back
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


def car(x):
    return Cuboid3d([x, 3.0, -1.0], [0.0, 0.0, 0.3], [4.5, 1.9, 1.6], label=0, attributes={'track_id': 1})


items = [DatasetItem(str(i), annotations=[car(10.0 + i)] * (i != 1), attributes={'frame': i}) for i in range(3)]
out = Path(sys.argv[1], 'kitti')
Dataset.from_iterable(items, categories=['car'], media_type=PointCloud).export(str(out), 'kitti_raw')
poses = ElementTree.parse(out / 'tracklet_labels.xml').findall('tracklets/item/poses/item')
found = [[pose.findtext(tag) for tag in ('tx', 'state', 'occlusion', 'truncation')] for pose in poses]
print(*found, sep='\n')
assert found[1] == ['10.0', '2', 'OcclusionStates.OCCLUSION_UNSET', 'TruncationStates.OUT_IMAGE']
try:
    Dataset.import_from(str(out), 'kitti_raw')
except Exception as error:
    print('read back:', type(error).__name__, error)
else:
    raise SystemExit('it reads its file now')
PYTHON
