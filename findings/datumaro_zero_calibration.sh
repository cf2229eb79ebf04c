#!/usr/bin/env bash
# guess: a project of Supervisely that Datumaro reads and writes keeps the calibration of its camera images, or has none afterwards
# happens: each image gets a calibration of zeros, in the place of the true one; its size and name are kept
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
import json
from pathlib import Path
import sys

from datumaro.components.dataset import Dataset
from PIL import Image

print('datumaro', version('datumaro'))
source, out = Path(sys.argv[1], 'source'), Path(sys.argv[1], 'out')
images = source / 'ds0/related_images/a_pcd'
for path in (source / 'ds0/ann', source / 'ds0/pointcloud', images):
    path.mkdir(parents=True)
sensors = {
    'extrinsicMatrix': [0.0, -1, 0, 0.1, 0, 0, -1, -0.2, 1, 0, 0, -0.3],
    'intrinsicMatrix': [150.0, 0, 16, 0, 150, 12, 0, 0, 1],
}
Image.new('RGB', (32, 24)).save(images / 'front.jpg')
(images / 'front.jpg.json').write_text(json.dumps({'name': 'front.jpg', 'meta': {'deviceId': 'front', 'sensorsData': sensors}}))
(source / 'ds0/pointcloud/a.pcd').write_text(
    'VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n1 2 3\n')
axes = {'position': (8, 1, 0), 'rotation': (0, 0, 0.3), 'dimensions': (4.5, 1.9, 1.6)}
figure = {
    'key': '1' * 32, 'objectKey': '2' * 32, 'geometryType': 'cuboid_3d',
    'geometry': {name: dict(zip('xyz', values)) for name, values in axes.items()},
}
annotation = {
    'description': '', 'key': '3' * 32, 'tags': [], 'objects': [{'key': '2' * 32, 'classTitle': 'car', 'tags': []}],
    'figures': [figure],
}
(source / 'ds0/ann/a.pcd.json').write_text(json.dumps(annotation))
numbers = {'tags': {}, 'objects': {'2' * 32: 0}, 'figures': {'1' * 32: 0}, 'videos': {'3' * 32: 0}}
(source / 'key_id_map.json').write_text(json.dumps(numbers))
classes = [{'title': 'car', 'shape': 'cuboid_3d', 'color': '#0000FF', 'geometry_config': {}}]
(source / 'meta.json').write_text(json.dumps({'classes': classes, 'tags': [], 'projectType': 'point_clouds'}))

data = Dataset.import_from(str(source), 'sly_pointcloud')
data.export(str(out), 'sly_pointcloud', save_media=True)
(written,) = out.glob('ds0/related_images/*/*.json')
found = json.loads(written.read_text())['meta']['sensorsData']
print(written.name, found)
assert (written.with_suffix('')).exists()
assert found == {'extrinsicMatrix': [0] * 12, 'intrinsicMatrix': [0] * 9}
PYTHON
