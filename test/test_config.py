from dataclasses import asdict
from pathlib import Path

from boxreg_ros.config import Config, settings
from boxreg_ros.errors import BoxregError, ConfigError
import pytest
import yaml


def test_settings_list_the_defaults():
    config = Config()
    assert [item for item, _ in config.items()] == list(settings())
    assert all(value == item.default for item, value in config.items() if '.' not in item.name)
    assert Config.from_dict({}) == config


def test_every_setting_has_a_meaning_and_bounds():
    names = [item.name for item in settings()]
    assert len(names) == len(set(names)) > 30
    for item in settings():
        assert item.meaning, item.name
        kind = type(item.default)
        assert kind in (bool, int, float, str, tuple), item.name
        if kind in (int, float):
            assert item.low <= item.default <= item.high, item.name


def test_dictionary_and_yaml_round_trip(tmp_path):
    config = Config.from_dict(
        {
            'objective': 'paper',
            'window': 7,
            'lag': 2,
            'solver': {'rounds': 2},
            'paper': {'closeness': 1e-6},
            'pedestrian': {'names': ['human'], 'turning': 2.5},
        }
    )
    assert config.solver.rounds == 2
    assert config.pedestrian.names == ('human',)
    assert config.pedestrian.slip == Config().pedestrian.slip != Config().vehicle.slip
    assert Config.from_dict(asdict(config)) == config
    path = tmp_path / 'config.yaml'
    path.write_text(yaml.safe_dump(asdict(config)))
    assert Config.from_yaml(path) == config


@pytest.mark.parametrize('node', ['/**', 'boxreg', '/robot/boxreg'])
def test_ros_parameter_files_are_read(tmp_path, node):
    path = tmp_path / 'params.yaml'
    path.write_text(f'{node}:\n  ros__parameters:\n    window: 12\n    solver: {{rounds: 3}}\n')
    config = Config.from_yaml(path)
    assert (config.window, config.solver.rounds) == (12, 3)


def test_empty_file_means_defaults(tmp_path):
    path = tmp_path / 'empty.yaml'
    path.write_text('# nothing\n')
    assert Config.from_yaml(path) == Config()


def test_exponents_without_a_decimal_point_are_numbers(tmp_path):
    path = tmp_path / 'config.yaml'
    path.write_text('paper: {closeness: 1e-6}\n')
    assert Config.from_yaml(path).paper.closeness == 1e-6


def test_dotted_names_update_a_copy():
    config = Config()
    changed = config.updated({'solver.rounds': 2, 'mode': 'bev', 'vehicle.names': ['Auto']})
    assert (changed.solver.rounds, changed.mode, changed.vehicle.names) == (2, 'bev', ('Auto',))
    assert changed.solver.threads == config.solver.threads
    assert config == Config()


@pytest.mark.parametrize(
    ('values', 'name'),
    [
        ({'windw': 3}, 'windw'),
        ({'solver': {'round': 3}}, 'solver.round'),
        ({'vehicle': {'speed': 3.0}}, 'vehicle.speed'),
    ],
)
def test_unknown_keys_are_refused_by_name(values, name):
    with pytest.raises(ConfigError, match=rf'^{name}: no such setting; expected one of '):
        Config.from_dict(values)


def test_dotted_keys_and_plain_groups_are_refused_with_how_to_write_them():
    with pytest.raises(ConfigError, match=r'^solver\.rounds: .*write solver: \{rounds: '):
        Config.from_dict({'solver.rounds': 3})
    with pytest.raises(ConfigError, match=r'^solver: expected SolverConfig, .*from_dict'):
        Config(solver={'rounds': 3})


@pytest.mark.parametrize('name', ['windw', 'solver.round', 'window.size', 'a.b.c'])
def test_unknown_dotted_names_are_refused(name):
    with pytest.raises(ConfigError, match='window' if name == 'window.size' else name[0]):
        Config().updated({name: 3})


@pytest.mark.parametrize('values', [{'window': 10.5}, {'window': True}])
def test_values_of_another_type_are_refused_by_name(values):
    ((name, value),) = values.items()
    with pytest.raises(ConfigError, match=rf'^{name}: expected int, got {value!r}$'):
        Config(**values)


def bounds():
    for item in settings():
        if item.low is not None:
            yield item.name, item.low - 1
        if item.high is not None:
            yield item.name, item.high + 1
        if item.choices:
            yield item.name, 'neither'


@pytest.mark.parametrize(('name', 'value'), list(bounds()))
def test_values_out_of_bounds_are_refused_by_name(name, value):
    with pytest.raises(ConfigError, match=rf'^{name}: expected .* got {value!r}'):
        Config().updated({name: value})


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('window', 3.5),
        ('window', '10'),
        ('window', True),
        ('max_gap', 'long'),
        ('max_gap', float('nan')),
        ('max_gap', True),
        ('mode', 3),
        ('vehicle.names', 'car'),
        ('vehicle.names', [1]),
        ('solver', 3),
    ],
)
def test_wrong_types_are_refused_by_name(name, value):
    with pytest.raises(ConfigError, match=rf'^{name}: expected .* got '):
        Config().updated({name: value})


@pytest.mark.parametrize(
    'text',
    [
        '- 1\n- 2\n',
        'word\n',
        'a: [\n',
        '/**:\n  ros__parameters: 3\n',
        'window: 2\n',
        'lag: 4\nlag: 5\n',
        pytest.param('[' * 5000, id='nested'),
        'lag: 2026-13-45',
        'lag: !!python/name:os.system',
    ],
)
def test_errors_of_invalid_files_name_the_file(tmp_path, text):
    path = tmp_path / 'invalid.yaml'
    path.write_text(text)
    with pytest.raises(ConfigError, match=r'invalid\.yaml') as caught:
        Config.from_yaml(path)
    assert '\n' not in str(caught.value)


def test_errors_of_unreadable_files_name_the_file(tmp_path):
    binary = tmp_path / 'binary.yaml'
    binary.write_bytes(b'\xff\xfe\x00')
    for path in (binary, tmp_path / 'absent.yaml', Path(tmp_path)):
        with pytest.raises(BoxregError, match=path.name) as caught:
            Config.from_yaml(path)
        assert '; ' in str(caught.value)  # a remedy


@pytest.mark.parametrize(
    ('class_name', 'group'),
    [
        ('car', 'vehicle'),
        ('Pedestrian', 'pedestrian'),
        ('human.pedestrian.adult', 'pedestrian'),
        ('pedestrian/child', 'pedestrian'),
        ('motorcycle_rider', 'cyclist'),
        ('BICYCLE', 'cyclist'),
        ('BICYCLIST', 'cyclist'),  # of Argoverse 2
        ('motorbike', 'cyclist'),
        ('Adult', 'pedestrian'),
        ('carpet', 'vehicle'),
        ('', 'vehicle'),
    ],
)
def test_class_names_select_a_group(class_name, group):
    config = Config()
    assert config.class_config(class_name) is getattr(config, group)


PUBLISHED = {
    'nuScenes and TruckScenes': {
        'vehicle': """vehicle.bus.bendy vehicle.bus.rigid vehicle.car vehicle.construction
            vehicle.emergency.ambulance vehicle.emergency.police vehicle.trailer vehicle.truck
            vehicle.ego vehicle.train vehicle.other vehicle.ego_trailer movable_object.barrier
            movable_object.debris movable_object.pushable_pullable movable_object.trafficcone
            static_object.bicycle_rack static_object.traffic_sign car truck bus trailer
            construction_vehicle traffic_cone barrier""",
        'cyclist': """vehicle.bicycle vehicle.motorcycle bicycle motorcycle
            human.pedestrian.personal_mobility""",
        'pedestrian': """animal human.pedestrian.adult human.pedestrian.child
            human.pedestrian.construction_worker human.pedestrian.police_officer
            human.pedestrian.stroller human.pedestrian.wheelchair pedestrian""",
    },
    'Argoverse 2': {
        'vehicle': """ARTICULATED_BUS BOLLARD BOX_TRUCK BUS CONSTRUCTION_BARREL CONSTRUCTION_CONE
            LARGE_VEHICLE MESSAGE_BOARD_TRAILER MOBILE_PEDESTRIAN_CROSSING_SIGN RAILED_VEHICLE
            REGULAR_VEHICLE SCHOOL_BUS SIGN STOP_SIGN TRAFFIC_LIGHT_TRAILER TRUCK TRUCK_CAB
            VEHICULAR_TRAILER""",
        'cyclist': 'BICYCLE BICYCLIST MOTORCYCLE MOTORCYCLIST WHEELED_DEVICE WHEELED_RIDER',
        'pedestrian': 'ANIMAL DOG OFFICIAL_SIGNALER PEDESTRIAN STROLLER WHEELCHAIR',
    },
    'Waymo': {
        'vehicle': 'TYPE_VEHICLE TYPE_SIGN',
        'cyclist': 'TYPE_CYCLIST',
        'pedestrian': 'TYPE_PEDESTRIAN',
    },
    'KITTI': {
        'vehicle': 'Car Van Truck Tram Misc',
        'cyclist': 'Cyclist',
        'pedestrian': 'Pedestrian Person_sitting Person',
    },
    'PandaSet': {
        'vehicle': """Car Pickup_Truck Medium-sized_Truck Semi-truck Towed_Object
            Other_Vehicle_-_Construction_Vehicle Other_Vehicle_-_Uncommon Emergency_Vehicle Bus
            Train Trolley Tram_/_Subway Pylons Road_Barriers Signs Cones Construction_Signs
            Temporary_Construction_Barriers Rolling_Containers""",
        'cyclist': """Motorcycle Other_Vehicle_-_Pedicab Personal_Mobility_Device
            Motorized_Scooter Bicycle""",
        'pedestrian': 'Pedestrian Pedestrian_with_Object Animals_-_Bird Animals_-_Other',
    },
    'Lyft': {
        'vehicle': 'car other_vehicle bus truck emergency_vehicle',
        'cyclist': 'motorcycle bicycle',
        'pedestrian': 'pedestrian animal',
    },
    'ONCE': {'vehicle': 'Car Truck Bus', 'cyclist': 'Cyclist', 'pedestrian': 'Pedestrian'},
    'ZOD': {
        'vehicle': """Vehicle Vehicle_Car Vehicle_Van Vehicle_Truck Vehicle_Bus Vehicle_Trailer
            Vehicle_TramTrain Vehicle_HeavyEquip Vehicle_Emergency Vehicle_Other PoleObject
            TrafficSign TrafficSignal TrafficGuide DynamicBarrier""",
        'cyclist': """VulnerableVehicle VulnerableVehicle_Bicycle VulnerableVehicle_Motorcycle
            VulnerableVehicle_Scooter VulnerableVehicle_Other""",
        'pedestrian': 'Pedestrian Animal',
    },
    'View of Delft': {
        'vehicle': 'Car truck vehicle_other bicycle_rack human_depiction',
        'cyclist': 'Cyclist bicycle rider moped_scooter motor ride_other ride_uncertain',
        'pedestrian': 'Pedestrian',
    },
}
"""Class names of data sets by kind; spaces in them are underscores here."""


@pytest.mark.parametrize('dataset', PUBLISHED)
def test_classes_of_published_data_sets_are_of_their_kind(dataset):
    expected = PUBLISHED[dataset]
    given = {name: kind for kind, names in expected.items() for name in names.split()}
    for separator in ('_', ' '):
        found = {name: Config().kind(name.replace('_', separator)) for name in given}
        assert found == given


def test_a_name_of_several_words_selects_classes_with_all_of_them():
    config = Config().updated({'pedestrian.names': ['road_crew', 'bicycle courier']})
    for name in ('road_crew', 'Road Crew', 'crew.road', 'bicycle-courier'):
        assert config.kind(name) == 'pedestrian' and config.knows_class(name)
    assert not config.knows_class('road')
    assert config.kind('bicycle') == 'cyclist'


def test_classes_that_are_numbers_are_named_as_text():
    with pytest.raises(ConfigError, match=r"a list of texts such as \[car, '2'\], got \[2\]"):
        Config().updated({'pedestrian.names': [2]})
    assert Config().updated({'pedestrian.names': ['2']}).kind('2') == 'pedestrian'


def test_names_of_a_group_may_be_in_any_case():
    config = Config().updated({'pedestrian.names': ['Fussgaenger']})
    for name in ('FUSSGAENGER', 'fussgaenger', 'human-Fussgaenger'):
        assert config.class_config(name) is config.pedestrian


def test_a_lag_is_less_than_the_window():
    assert Config(window=8, lag=7).lag == 7
    with pytest.raises(ConfigError, match=r'^lag: expected less than window \(8\), got 8'):
        Config(window=8, lag=8)


def test_a_window_has_room_for_the_observations_that_it_needs():
    config = Config(window=5, min_observations=9)  # for estimate 'track'
    expected = r'^min_observations: expected at most window \(5\), got 9'
    with pytest.raises(ConfigError, match=expected):
        config.updated({'estimate': 'final'})
    with pytest.raises(ConfigError, match=r'^min_observations: expected at most track_window'):
        Config(track_window=10, min_observations=11)
