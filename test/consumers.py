"""
Read label files and recordings with third-party libraries, which `test/consumers.txt` lists.

The libraries have an environment of their own. Tests call `consumer` with the name of a function
below and its arguments. This file runs there as long as the tests: each library is loaded once.

"""

from functools import cache
import json
import os
from pathlib import Path
import subprocess
import sys
import traceback

MARKER_ARRAY = 'visualization_msgs.msg.MarkerArray'
HOME = Path(__file__).resolve().parents[1] / '.venv-consumers'


def consumer(*call):
    """Run a function below in the environment of the libraries, and return its result."""
    running = program()
    print(json.dumps([str(one) for one in call]), file=running.stdin, flush=True)
    answer = json.loads(running.stdout.readline())
    assert 'error' not in answer, answer['error']
    return answer['result']


@cache
def program():
    """Start the program that runs the functions; it ends with the process of the tests."""
    import pytest

    if not (HOME / 'bin' / 'python').exists():
        pytest.skip('.venv-consumers does not exist: make test creates it')
    command = [HOME / 'bin' / 'python', '-W', 'ignore', __file__]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def serve():
    """Run the calls of each line of the input, and write a line with the result of each."""
    answers = os.fdopen(os.dup(1), 'w')
    os.dup2(2, 1)  # what the libraries print
    for line in sys.stdin:
        name, *arguments = json.loads(line)
        try:
            answer = {'result': globals()[name](*arguments)}
        except BaseException:
            answer = {'error': traceback.format_exc()}
        print(json.dumps(answer), file=answers, flush=True)


def nuscenes(folder, version):
    """Return every annotation as the devkit reads it: in the global and in the LiDAR frame."""
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
        for local_box, name in zip(local, sample['anns'], strict=True):
            row = data.get('sample_annotation', name)
            box = data.get_box(name)
            boxes.append({
                'channel': channel, 'timestamp': sample['timestamp'], 'name': box.name,
                'center': box.center.tolist(), 'wlh': box.wlh.tolist(),
                'matrix': box.rotation_matrix.tolist(), 'corners': box.corners().T.tolist(),
                'local': local_box.center.tolist(), 'points': points,
                'velocity': data.box_velocity(name).tolist(),
                'track': row['instance_token'], 'num_points': row['num_lidar_pts'],
                'next': row['next'], 'prev': row['prev'],
            })  # fmt: skip
    return boxes


def nuscenes_attributes(folder, version):
    """Return the names of the attributes of each instance in the first sample."""
    from nuscenes.nuscenes import NuScenes

    data = NuScenes(version, folder, verbose=False)
    found = {}
    for name in data.sample[0]['anns']:
        row = data.get('sample_annotation', name)
        tokens = row['attribute_tokens']
        track = data.get('instance', row['instance_token'])['instance_name']
        found[track] = sorted(data.get('attribute', token)['name'] for token in tokens)
    return found


def lidarseg(folder, version):
    """Return the points of each category of each sample, and of each panoptic instance."""
    import numpy as np
    from nuscenes.nuscenes import NuScenes
    from nuscenes.utils.data_io import load_bin_file, panoptic_to_lidarseg

    data = NuScenes(version, folder, verbose=False)
    names = data.lidarseg_idx2name_mapping
    samples = []
    for row, whole in zip(data.lidarseg, data.panoptic, strict=True):
        assert row['sample_data_token'] == whole['sample_data_token']
        categories = load_bin_file(str(Path(folder, row['filename'])), type='lidarseg')
        codes = load_bin_file(str(Path(folder, whole['filename'])), type='panoptic')
        assert (panoptic_to_lidarseg(codes) == categories).all()
        sweep = data.get('sample_data', row['sample_data_token'])
        counts = [np.unique(values, return_counts=True) for values in (categories, codes)]
        (found, number), (instances, points) = counts
        samples.append({
            'timestamp': sweep['timestamp'],
            'categories': dict(zip(map(names.get, found.tolist()), number.tolist(), strict=True)),
            'instances': dict(zip(instances.tolist(), points.tolist(), strict=True)),
            'size': Path(folder, sweep['filename']).stat().st_size,
        })  # fmt: skip
    return samples


def semantickitti(sequence, truth):
    """
    Return the instances of each scan and the IoU of each class, as semantic-kitti-api has them.

    None where it is not installed. `truth` has the true ``.label`` files.

    """
    import importlib.util

    if importlib.util.find_spec('auxiliary') is None:  # its only package
        return None
    from auxiliary.laserscan import SemLaserScan
    from auxiliary.np_ioueval import iouEval
    import numpy as np

    scan = SemLaserScan(sem_color_dict={0: [0, 0, 0]})
    evaluator = iouEval(n_classes=260, ignore=[0])
    instances = []
    for path in sorted(Path(sequence, 'velodyne').iterdir()):
        scan.open_scan(str(path))
        scan.open_label(str(Path(truth, path.stem + '.label')))
        true = scan.sem_label
        scan.open_label(str(Path(sequence, 'labels', path.stem + '.label')))
        evaluator.addBatch(scan.sem_label, true)
        instances.append(np.bincount(scan.inst_label).tolist())
    iou = evaluator.getIoU()[1].tolist()
    return {
        'iou': {number: value for number, value in enumerate(iou) if value},
        'instances': instances,
    }


def nuscenes_scene(folder, version, name):
    """Return sweeps and boxes of a scene in the global frame, through the devkit's transforms."""
    import numpy as np
    from nuscenes.nuscenes import NuScenes
    from nuscenes.utils.data_classes import LidarPointCloud
    from nuscenes.utils.geometry_utils import transform_matrix
    from pyquaternion import Quaternion

    data = NuScenes(version, folder, verbose=False)
    (scene,) = (scene for scene in data.scene if scene['name'] == name)
    samples = [s['token'] for s in data.sample if s['scene_token'] == scene['token']]
    sweeps = []
    for row in data.sample_data:
        if row['channel'] != 'LIDAR_TOP' or row['sample_token'] not in samples:
            continue
        cloud = LidarPointCloud.from_file(str(Path(folder, row['filename'])))
        for table, key in (('calibrated_sensor', 'calibrated_sensor_token'),
                           ('ego_pose', 'ego_pose_token')):  # fmt: skip
            pose = data.get(table, row[key])
            cloud.transform(transform_matrix(pose['translation'], Quaternion(pose['rotation'])))
        sweeps.append([row['timestamp'], cloud.points[:3].T.astype(np.float64).tolist()])
    boxes = []
    for token in samples:
        sample = data.get('sample', token)
        for box in map(data.get_box, sample['anns']):
            length, width, height = box.wlh[[1, 0, 2]].tolist()
            yaw = float(box.orientation.yaw_pitch_roll[0])
            boxes.append([*box.center.tolist(), length, width, height, yaw])
    return {'sweeps': sweeps, 'boxes': boxes}


def truckscenes_clouds(folder, version):
    """Return the clouds of each LiDAR in the global frame, each point by the closest pose."""
    import numpy as np
    from pyquaternion import Quaternion
    from truckscenes import TruckScenes
    from truckscenes.utils.data_classes import LidarPointCloud
    from truckscenes.utils.geometry_utils import transform_matrix

    data = TruckScenes(version, folder, verbose=False)
    sweeps = []
    for row in data.sample_data:
        if row['sensor_modality'] != 'lidar':
            continue
        cloud = LidarPointCloud.from_file(str(Path(folder, row['filename'])))
        mount = data.get('calibrated_sensor', row['calibrated_sensor_token'])
        cloud.transform(transform_matrix(mount['translation'], Quaternion(mount['rotation'])))
        points = []
        for point, micros in zip(cloud.points.T, cloud.timestamps[0].tolist(), strict=True):
            pose = data.getclosest('ego_pose', micros)
            T = transform_matrix(pose['translation'], Quaternion(pose['rotation']))
            points.append((T @ np.append(point[:3], 1.0))[:3].tolist())
        sweeps.append([row['channel'], row['timestamp'], points])
    return sweeps


def t4(tables):
    """Return all tables as the schema classes of the T4 devkit read them."""
    skip_package_init('t4_devkit')  # imports a viewer
    from t4_devkit.schema import build_schema, SchemaName

    found = {}
    for name in SchemaName:
        if not name.is_optional():
            rows = build_schema(name, str(Path(tables, name.filename)))
            found[name.value] = [vars(row) for row in rows]
    return json.loads(json.dumps(found, default=lambda value: getattr(value, 'q', value).tolist()))


def skip_package_init(name):
    """Register a package without running its __init__, whose dependencies are not installed."""
    import importlib.util
    import types

    parent, _, last = name.rpartition('.')
    found = importlib.util.find_spec(parent or last).submodule_search_locations
    package = types.ModuleType(name)
    package.__path__ = [str(Path(item, last)) for item in found] if parent else list(found)
    sys.modules[name] = package


def av2_precision(folder):
    """Return the average precision of the cuboids of a log as detections of themselves."""
    from av2.evaluation.detection.eval import evaluate
    from av2.evaluation.detection.utils import DetectionCfg
    import pandas as pd

    table = pd.read_feather(Path(folder, 'annotations.feather'))
    table['log_id'] = 'log'
    table['num_interior_pts'] = table['num_interior_pts'].clip(1)
    configuration = DetectionCfg(eval_only_roi_instances=False)
    detections = table.assign(score=table['score'])
    scores = evaluate(detections, table, configuration, n_jobs=1)[2]
    return {name: float(value) for name, value in scores['AP'].items() if value > 0}


def nuscenes_images(folder, version, channel):
    """Return the boxes of each sample in the frames of the LiDAR and of a camera."""
    from nuscenes.nuscenes import NuScenes
    from PIL import Image

    data = NuScenes(version, folder, verbose=False)
    images = []
    for sample in data.sample:
        path, boxes, intrinsic = data.get_sample_data(sample['data'][channel], box_vis_level=0)
        _, in_lidar, _ = data.get_sample_data(sample['data']['LIDAR_TOP'], box_vis_level=0)
        tokens = [box.token for box in boxes]
        images.append({
            'size': list(Image.open(path).size), 'intrinsic': intrinsic.tolist(),
            'in_camera': [box.center.tolist() for box in boxes],
            'in_lidar': [box.center.tolist() for box in in_lidar if box.token in tokens],
        })  # fmt: skip
    return images


def nuscenes_precision(folder, version):
    """Return the average precision of annotations as detections of themselves, by class."""
    from nuscenes.eval.common.data_classes import EvalBoxes
    from nuscenes.eval.common.utils import center_distance
    from nuscenes.eval.detection.algo import accumulate, calc_ap
    from nuscenes.eval.detection.data_classes import DetectionBox
    from nuscenes.eval.detection.utils import category_to_detection_name
    from nuscenes.nuscenes import NuScenes

    data = NuScenes(version, folder, verbose=False)
    boxes = EvalBoxes()
    for row in data.sample_annotation:
        name = category_to_detection_name(row['category_name'])
        if name is not None:
            boxes.add_boxes(row['sample_token'], [DetectionBox(
                row['sample_token'], tuple(row['translation']), tuple(row['size']),
                tuple(row['rotation']), (0.0, 0.0), num_pts=row['num_lidar_pts'],
                detection_name=name, detection_score=row['score'],
            )])  # fmt: skip
    found = {box.detection_name for box in boxes.all}
    return {
        name: float(calc_ap(accumulate(boxes, boxes, name, center_distance, 0.5), 0.0, 0.0))
        for name in found
    }


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


def av2_log(folder, stamp_ns):
    """Return a sweep, the pose of the vehicle and the poses of the LiDARs."""
    from av2.utils.io import read_city_SE3_ego, read_ego_SE3_sensor, read_lidar_sweep

    mounts = read_ego_SE3_sensor(Path(folder))
    return {
        'points': read_lidar_sweep(
            Path(folder, 'sensors', 'lidar', f'{stamp_ns}.feather')
        ).tolist(),
        'city_SE3_ego': read_city_SE3_ego(Path(folder))[int(stamp_ns)].transform_matrix.tolist(),
        'ego_SE3_lidar': mounts['up_lidar'].transform_matrix.tolist(),
        'positions': [
            mounts[name].translation.tolist()
            for name in ('up_lidar', 'down_lidar')
            if name in mounts
        ],
    }


def waymo(boxes, poses):
    """Return the first row of two tables, read by the components of the data set."""
    skip_package_init('waymo_open_dataset.v2')  # imports all of TensorFlow
    from pyarrow import parquet
    from waymo_open_dataset.v2.perception.box import BoxType, LiDARBoxComponent
    from waymo_open_dataset.v2.perception.pose import VehiclePoseComponent

    table = parquet.read_table(boxes)
    schema = LiDARBoxComponent.schema()
    label = LiDARBoxComponent.from_dict(table.select(schema.names).to_pylist()[0])
    pose = VehiclePoseComponent.from_dict(parquet.read_table(poses).to_pylist()[0])
    box = {
        'types_agree': table.select(schema.names).schema.equals(schema),
        'id': label.key.laser_object_id,
        'type': BoxType(label.type).name,
        'points': label.num_lidar_points_in_box,
        'box': [*label.box.center.numpy, *label.box.size.numpy, label.box.heading],
    }
    return box, pose.world_from_vehicle.transform


def waymo_schemas():
    """Return the columns of the components that clouds need, with their types."""
    import types

    skip_package_init('waymo_open_dataset.v2')
    # TensorFlow is not installed; these modules use its name in annotations only.
    tensorflow = types.ModuleType('tensorflow')
    tensorflow.Tensor = object
    sys.modules['tensorflow'] = tensorflow
    from waymo_open_dataset.v2.perception.context import LiDARCalibrationComponent
    from waymo_open_dataset.v2.perception.lidar import LiDARComponent, LiDARPoseComponent
    from waymo_open_dataset.v2.perception.pose import VehiclePoseComponent

    del sys.modules['tensorflow']
    components = {
        'lidar': LiDARComponent, 'lidar_pose': LiDARPoseComponent,
        'lidar_calibration': LiDARCalibrationComponent, 'vehicle_pose': VehiclePoseComponent,
    }  # fmt: skip
    return {
        folder: {field.name: str(field.type) for field in component.schema()}
        for folder, component in components.items()
    }


def pykitti(folder):
    """Return calibration and sweep of a sequence."""
    from pykitti import utils

    folder = Path(folder)
    calibration = utils.read_calib_file(folder / 'calib' / '0000.txt')
    return {
        **{name: calibration[name].tolist() for name in ('P2', 'Tr_velo_cam')},
        'points': utils.load_velo_scan(folder / 'velodyne' / '0000' / '000000.bin').tolist(),
    }


def pykitti_oxts(*files):
    """Return the poses (4, 4) of the GPS/IMU unit in the files of a drive or a sequence."""
    from pykitti import utils

    return [item.T_w_imu.tolist() for item in utils.load_oxts_packets_and_poses(files)]


def pandas(path):
    """Return columns of a table."""
    import pandas

    read = pandas.read_parquet if path.endswith('parquet') else pandas.read_csv
    table = read(path)
    names = ('stamp_ns', 'x', 'num_points')
    return {
        'x of 7': table[table.track_id.astype(str) == '7'].x.tolist(),
        'stamps': sorted(table.stamp_ns.unique().tolist()),
        'kinds': {name: str(table[name].dtype) for name in names},
    }


def datumaro(folder, form='datumaro'):
    """Return every cuboid with its frame, and the KITTI raw tracklets that Datumaro exports."""
    import tempfile
    from xml.etree import ElementTree

    from datumaro import Dataset
    from datumaro.components.annotation import AnnotationType

    data = Dataset.import_from(folder, form)
    labels = data.categories()[AnnotationType.label]
    cuboids = [
        {
            'item': item.id, 'frame': item.attributes['frame'],
            'bytes': len(item.media.data or b'') if item.media else 0,
            'label': labels[annotation.label].name, 'position': annotation.position,
            'rotation': annotation.rotation, 'scale': annotation.scale,
            'attributes': annotation.attributes,
        }
        for item in data
        for annotation in item.annotations
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as out:
        data.export(out, 'kitti_raw')
        tree = ElementTree.parse(Path(out) / 'tracklet_labels.xml')
    tracklets = [
        {key: float(track.find(key).text) for key in 'hwl'}
        for track in tree.getroot().iter('item')
        if track.find('objectType') is not None
    ]
    return {'cuboids': cuboids, 'infos': data.infos(), 'tracklets': tracklets}


def datumaro_tracklets(folder, out):
    """Export a data set of Datumaro as tracklets of KITTI raw."""
    from datumaro import Dataset

    Dataset.import_from(folder, 'datumaro').export(out, 'kitti_raw', reindex=True)


def datumaro_kitti(folder):
    """Return the attributes of every box of KITTI object."""
    from datumaro import Dataset
    from datumaro.components.annotation import AnnotationType

    Path(folder, 'image_2').mkdir()
    data = Dataset.import_from(folder, 'kitti3d')
    labels = data.categories()[AnnotationType.label]
    return [
        {'id': item.id, 'label': labels[box.label].name, **box.attributes}
        for item in data
        for box in item.annotations
    ]


@cache
def import_supervisely():
    """Import what the projects of Supervisely need of the package."""
    from importlib import import_module

    skip_package_init('supervisely')  # imports the whole platform
    package = sys.modules['supervisely']
    package.logger = import_module('supervisely.sly_logger').logger
    package.env = import_module('supervisely.io.env')


def supervisely(folder):
    """Return every figure of every frame of a project of point cloud episodes."""
    from importlib import import_module

    import_supervisely()
    episodes = import_module('supervisely.project.pointcloud_episode_project')

    project = episodes.PointcloudEpisodeProject(folder, episodes.OpenMode.READ)
    (data,) = project.datasets
    label = data.get_ann(project.meta)
    figures = []
    for name in data:
        for figure in label.get_figures_on_frame(data.get_frame_idx(name)):
            geometry = figure.geometry.to_json()
            figures.append({
                'cloud': name, 'frame': figure.frame_index, 'geometry': geometry,
                'status': str(figure.status),
                'class': figure.parent_object.obj_class.name,
                'tags': [
                    (tag.name, tag.value, tag.frame_range) for tag in figure.parent_object.tags
                ],
            })  # fmt: skip
    return {
        'type': project.type, 'frames': label.frames_count, 'description': label.description,
        'items': sorted(data), 'figures': figures,
    }  # fmt: skip


def supervisely_tags(folder):
    """Return value and range of the tags of each track of a project, but id and status."""
    from importlib import import_module

    import_supervisely()
    episodes = import_module('supervisely.project.pointcloud_episode_project')

    project = episodes.PointcloudEpisodeProject(folder, episodes.OpenMode.READ)
    (data,) = project.datasets
    found = {}
    for item in data.get_ann(project.meta).objects:
        tags = {tag.name: [tag.value, list(tag.frame_range or ())] for tag in item.tags}
        track, _ = tags.pop('track_id')
        tags.pop('status')
        found[track] = tags
    return found


def supervisely_clouds(folder):
    """Return every figure of every cloud of a project of point clouds, and its name."""
    from importlib import import_module

    import_supervisely()
    projects = import_module('supervisely.project.pointcloud_project')
    project = projects.PointcloudProject(folder, projects.OpenMode.READ)
    (data,) = project.datasets
    figures = []
    for name in data:
        label = data.get_ann(name, project.meta)
        figures += [
            {
                'cloud': name, 'geometry': figure.geometry.to_json(),
                'class': figure.parent_object.obj_class.name,
                'object': figure.parent_object.key().hex,
                'tags': {tag.name: tag.value for tag in figure.parent_object.tags},
            }
            for figure in label.figures
        ]  # fmt: skip
    return {'type': project.type, 'items': sorted(data), 'figures': figures}


def supervisely_images(folder, form):
    """Return the images of each cloud of a project, with their calibration and size."""
    from importlib import import_module

    from PIL import Image

    import_supervisely()
    if form == 'supervisely':
        module = import_module('supervisely.project.pointcloud_episode_project')
        project = module.PointcloudEpisodeProject(folder, module.OpenMode.READ)
    else:
        module = import_module('supervisely.project.pointcloud_project')
        project = module.PointcloudProject(folder, module.OpenMode.READ)
    (data,) = project.datasets
    return [
        {
            'cloud': name,
            'images': [
                {'name': Path(path).name, 'size': list(Image.open(path).size), **info}
                for path, info in data.get_related_images(name)
            ],
        }
        for name in data
    ]


def datumaro_images(folder):
    """Return the sizes of the images beside each cloud, height and width, by their paths."""
    from datumaro import Dataset

    root = Path(folder, 'images/default')
    return {
        item.id: {
            str(Path(image.path).relative_to(root)): list(image.data.shape[:2])
            for image in item.media.extra_images
        }
        for item in Dataset.import_from(folder, 'datumaro')
    }


def vcd_transform(path, source, target, frame):
    """Return the transform between two coordinate systems of an OpenLABEL file at a frame."""
    from vcd import core, scl

    label = core.OpenLABEL()
    label.load_from_file(path)
    scene = scl.Scene(label)
    return scene.get_transform(source, target, int(frame))[0].tolist()


def vcd_write(path):
    """Write a file with VCD: a chain of poses, a static object and one that moves."""
    from vcd import core, types

    label = core.OpenLABEL()
    quaternion, euler = (
        types.TransformDataType.quat_and_trans_7x1,
        types.TransformDataType.euler_and_trans_6x1,
    )
    kinds = types.CoordinateSystemType
    label.add_coordinate_system('odom', cs_type=kinds.scene_cs)
    label.add_coordinate_system('vehicle-iso8855', cs_type=kinds.local_cs, parent_name='odom')
    label.add_coordinate_system(
        'lidar', cs_type=kinds.sensor_cs, parent_name='vehicle-iso8855',
        pose_wrt_parent=types.PoseData([0.0, 0.0, 0.6, 0.8, 1.2, 0.1, 1.8], quaternion),
    )  # fmt: skip
    parked = label.add_object('parked', 'car', coordinate_system='odom')
    box = [20.0, 3.0, 0.5, 0.0, 0.0, 0.0, 1.0, 4.5, 1.9, 1.6]
    label.add_object_data(parked, types.cuboid('box', box))
    moving = label.add_object('moving', 'truck')
    for number in range(3):
        seconds = f'2023-11-14T22:13:2{number}.123456789Z'
        label.add_frame_properties(number, timestamp=seconds)
        pose = types.TransformData([0.3, -0.1, 0.05, 10.0 + number, 2.0, 0.4], euler)
        label.add_transform(number, types.Transform('vehicle-iso8855', 'odom', pose))
        box = [10.0 + number, -3.0, -1.0, 0.1, 0.2, 0.3, 8.0, 2.5, 3.0]
        label.add_object_data(moving, types.cuboid('box', box, coordinate_system='lidar'), number)
    label.save(path, validate=True)
    return [parked, moving]


def vcd_labels(path):
    """Return the cuboids of the objects in each frame, as VCD reads and validates a file."""
    from vcd import core

    label = core.OpenLABEL()
    label.load_from_file(path, validation=True)
    root = label.get_root()
    return {
        number: {
            uid: [cuboid['val'] for cuboid in item['object_data']['cuboid']]
            for uid, item in frame.get('objects', {}).items()
        }
        for number, frame in root['frames'].items()
    }


def vcd_attributes(path):
    """Return truths and texts of the cuboids of the first frame by object, but its evidence."""
    from vcd import core

    label = core.OpenLABEL()
    label.load_from_file(path, validation=True)
    root = label.get_root()
    found = {}
    for uid, item in next(iter(root['frames'].values()))['objects'].items():
        (cuboid,) = item['object_data']['cuboid']
        kinds = cuboid['attributes']
        values = [*kinds.get('boolean', ()), *kinds['text']]
        found[root['objects'][uid]['name']] = {
            one['name']: one['val'] for one in values if one['name'] not in ('status', 'reason')
        }
    return found


def cloud(path):
    """Return the names and the rows of the points in a PCD or PLY file."""
    if path.endswith('.pcd'):
        from pypcd4 import PointCloud

        points = PointCloud.from_path(path)
        return {'fields': list(points.fields), 'rows': points.numpy().tolist()}
    from plyfile import PlyData

    vertex = PlyData.read(path)['vertex']
    return {
        'fields': [item.name for item in vertex.properties],
        'rows': [[float(value) for value in row] for row in vertex.data.tolist()],
    }


def recoded_cloud(path, out, encoding):
    """Write a PCD file again with another encoding."""
    from pypcd4 import Encoding, PointCloud

    PointCloud.from_path(path).save(out, Encoding(encoding))


def kitti_raw_clouds(root, date, drive):
    """Return the first number of each cloud of a drive as its frames are counted."""
    from pykitti import raw

    found = raw(root, date, drive)
    return [found.get_velo(i)[0].tolist() for i in range(len(found.velo_files))]


def live_run(path):
    """Return numbers of messages, clouds and markers of a recording as Rerun reads it."""
    from rerun.chunk import McapReader

    reader = McapReader(path)
    tables = [
        (chunk.entity_path, chunk.to_record_batch())
        for chunk in reader.stream()
        if not chunk.is_static
    ]
    return {
        'messages': {channel.topic: channel.message_count for channel in reader.info().channels},
        'clouds': [
            {'number': len(points), 'low': points.min(0).tolist(), 'high': points.max(0).tolist()}
            for points in _clouds_of(tables)
        ],
        'markers': [
            [_marker_of(marker) for marker in rows[0]['markers']]
            for rows in _column(tables, '/refined_markers', f'{MARKER_ARRAY}:message')
        ],
    }


def _column(tables, entity, name):
    """Return the values of a column of an entity, by the time of the log."""
    values = [
        row
        for path, table in tables
        if path == entity and name in table.schema.names
        for row in zip(
            table['message_log_time'].cast('int64').to_pylist(), table[name], strict=True
        )
    ]
    return [value.as_py() for _, value in sorted(values, key=lambda row: row[0])]


def _clouds_of(tables):
    import numpy as np

    for rows in _column(tables, '/points', 'Points3D:positions'):
        yield np.array(rows)


def _marker_of(marker):
    position, scale, colour = marker['pose']['position'], marker['scale'], marker['color']
    return {
        **{name: marker[name] for name in ('ns', 'id', 'action', 'text')},
        'frame': marker['header']['frame_id'],
        'position': [position[axis] for axis in 'xyz'],
        'scale': [scale[axis] for axis in 'xyz'],
        'colour': [colour[channel] for channel in 'rgba'],
    }


if __name__ == '__main__':
    serve()
