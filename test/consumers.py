"""
What the libraries of others make of our label files; `test/consumers.txt` says which.

Run by their own environment as a program: the name of a function below and its arguments; prints
what the function returns as JSON. Tests call `consumer`.

"""

import json
from pathlib import Path
import subprocess
import sys

HOME = Path(__file__).resolve().parents[1] / '.venv-consumers'


def consumer(name, *arguments):
    """Run a function below in the environment of consumers; return what it returns."""
    import pytest

    if not (HOME / 'bin' / 'python').exists():
        pytest.skip('.venv-consumers is not there: make test sets it up')
    command = [HOME / 'bin' / 'python', '-W', 'ignore', __file__, name, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def nuscenes(folder, version):
    """Return every annotation as the devkit gives it: globally, and in the LiDAR's frame."""
    from nuscenes.nuscenes import NuScenes
    from nuscenes.utils.data_classes import LidarPointCloud

    data = NuScenes(version, folder, verbose=False)
    boxes = []
    for sample in data.sample:
        channel, token = next(iter(sample['data'].items()))
        path, local, _ = data.get_sample_data(token)
        points = None
        if Path(path).exists():
            points = LidarPointCloud.from_file(path).points[:3].T.tolist()
        for there, name in zip(local, sample['anns'], strict=True):
            row, box = data.get('sample_annotation', name), data.get_box(name)
            boxes.append({
                'channel': channel, 'timestamp': sample['timestamp'], 'name': box.name,
                'center': box.center.tolist(), 'wlh': box.wlh.tolist(),
                'matrix': box.rotation_matrix.tolist(), 'corners': box.corners().T.tolist(),
                'local': there.center.tolist(), 'points': points,
                'velocity': data.box_velocity(name).tolist(),
                'track': row['instance_token'], 'num_points': row['num_lidar_pts'],
                'next': row['next'], 'prev': row['prev'],
            })  # fmt: skip
    return boxes


def av2(path):
    """Return centre, extents, rotation and vertices of every cuboid."""
    from av2.structures.cuboid import CuboidList

    return [
        {
            'category': cuboid.category,
            'stamp_ns': int(cuboid.timestamp_ns),
            'center': cuboid.xyz_center_m.tolist(),
            'lwh': cuboid.dims_lwh_m.tolist(),
            'matrix': cuboid.dst_SE3_object.rotation.tolist(),
            'vertices': cuboid.vertices_m.tolist(),
        }
        for cuboid in CuboidList.from_feather(Path(path)).cuboids
    ]


if __name__ == '__main__':
    json.dump(globals()[sys.argv[1]](*sys.argv[2:]), sys.stdout)
