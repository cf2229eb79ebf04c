"""Valid files in layouts that writers have, and that other readers refuse or read otherwise."""

from contextlib import closing
import sqlite3
import struct
import zlib

from boxreg_ros.io.storage.files import opened
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.writer import IndexType
from mcap_files import rewritten
import pytest
from ros_messages import Drive, write_recording
import zstandard

MAGIC = b'\x89MCAP0\r\n'
PRIVATE = struct.pack('<BQ', 0x80, 5) + b'other'
"""A record of a kind that readers must skip."""


@pytest.fixture(scope='module')
def plain(tmp_path_factory):
    """Return an MCAP file of 12 sweeps."""
    folder = tmp_path_factory.mktemp('plain')
    return rewritten(Drive(sweeps=12).write(folder / 'drive'), folder / 'plain.mcap')


def content_of(path):
    """Return topic, type, definition, time and bytes of all messages of a file, and its times."""
    with closing(opened(path)) as file:
        found = [
            (r.connection.topic, r.connection.msgtype, r.connection.msgdef, r.received_ns, r.data)
            for r in file.messages(file.connections, None, None)
        ]
        counts = {c.topic: c.msgcount for c in file.connections}
        assert list(file.damages) == []
        found.sort(key=lambda one: (one[3], one[0]))
        return found, counts, file.start_time, file.end_time


class Layout:
    """Write the messages of an MCAP file again, each record where the specification allows it."""

    definitions = 'chunks'
    """``chunks``: before the first message on a channel; ``each``: in each chunk; ``front``."""
    repeats_channels = repeats_schemas = True
    has_indexes = has_statistics = has_summary = has_checksums = True
    private = False
    padding = b''
    """Behind the fields of each record, for those of later versions."""
    profile = 'ros2'
    early_ns = None
    """Added to all times, which become small numbers."""

    def __init__(self, **options):
        vars(self).update(options)
        self.out = RecordBuilder()
        self.known = {}

    def add(self, record, out=None):
        """Write a record, padded where it may be."""
        builder = RecordBuilder()
        record.write(builder)
        content = builder.end()
        if self.padding and not isinstance(record, records.Message):
            size = len(content) - 9 + len(self.padding)
            content = content[:1] + struct.pack('<Q', size) + content[9:] + self.padding
        (out or self.out).write(content + (PRIVATE if self.private else b''))

    def define(self, schema, channel, out=None):
        for record in (schema, channel):
            self.add(record, out)
        self.known[channel.id] = schema, channel

    def chunk(self, messages):
        """Write a chunk and its message indexes; return its index."""
        content = RecordBuilder()
        indexes = {}
        defined = {} if self.definitions == 'each' else self.known
        for schema, channel, message in messages:
            if channel.id not in defined:
                self.define(schema, channel, content)
                defined[channel.id] = schema, channel
            index = indexes.setdefault(channel.id, records.MessageIndex(channel.id, []))
            index.records.append((message.log_time, content.count))
            self.add(message, content)
        data = content.end()
        times = [message.log_time for _, _, message in messages]
        packed = zstandard.compress(data)
        begin = self.out.count
        crc = zlib.crc32(data) if self.has_checksums else 0
        self.add(records.Chunk(
            compression='zstd', data=packed, message_start_time=min(times),
            message_end_time=max(times), uncompressed_crc=crc, uncompressed_size=len(data),
        ))  # fmt: skip
        end = self.out.count
        offsets = {}
        for number, index in indexes.items() if self.has_indexes else ():
            offsets[number] = self.out.count
            self.add(index)
        return records.ChunkIndex(
            chunk_length=end - begin - len(PRIVATE) * self.private, chunk_start_offset=begin,
            compression='zstd', compressed_size=len(packed), message_start_time=min(times),
            message_end_time=max(times), message_index_offsets=offsets,
            message_index_length=self.out.count - end, uncompressed_size=len(data),
        )  # fmt: skip

    def write(self, path, target):
        """Write the messages of `path`, some in each chunk, to `target`."""
        with path.open('rb') as file:
            found = list(make_reader(file).iter_messages())
        if self.early_ns is not None:
            first = found[0][2].log_time
            for _, _, message in found:
                message.log_time += self.early_ns - first
        self.out.write(MAGIC)
        self.add(records.Header(self.profile, 'test'))
        if self.definitions == 'front':
            for schema, channel, _ in found:
                if channel.id not in self.known:
                    self.define(schema, channel)
        chunks = [self.chunk(found[at : at + 7]) for at in range(0, len(found), 7)]
        self.add(records.DataEnd(0))
        summary_start = self.out.count
        self.summary(found, chunks)
        footer = RecordBuilder()
        records.Footer(summary_start if self.out.count > summary_start else 0, 0, 0).write(footer)
        target.write_bytes(self.out.end() + footer.end() + MAGIC)
        return target

    def summary(self, found, chunks):
        if not self.has_summary:
            return
        for schema, channel in self.known.values():
            if self.repeats_schemas:
                self.add(schema)
            if self.repeats_channels:
                self.add(channel)
        counts = {}
        for _, channel, _ in found:
            counts[channel.id] = counts.get(channel.id, 0) + 1
        times = [message.log_time for _, _, message in found]
        if self.has_statistics:
            self.add(records.Statistics(
                attachment_count=0, metadata_count=0, channel_count=len(self.known),
                schema_count=len({schema.id for schema, _ in self.known.values()}),
                channel_message_counts=counts, chunk_count=len(chunks), message_count=len(found),
                message_start_time=min(times), message_end_time=max(times),
            ))  # fmt: skip
        for chunk in chunks:
            self.add(chunk)


@pytest.mark.parametrize('options', [
    {},
    {'has_checksums': False},
    {'has_checksums': False, 'has_summary': False},
    {'repeats_schemas': False},
    {'repeats_channels': False},
    {'repeats_schemas': False, 'definitions': 'front'},
    {'repeats_schemas': False, 'repeats_channels': False, 'definitions': 'each'},
    {'repeats_schemas': False, 'has_indexes': False},
    {'definitions': 'each'},
    {'has_indexes': False},
    {'has_indexes': False, 'early_ns': 0},
    {'has_indexes': False, 'has_statistics': False},
    {'has_statistics': False},
    {'has_summary': False},
    {'has_summary': False, 'private': True, 'padding': b'later'},
    {'private': True},
    {'padding': b'later'},
    {'profile': ''},
    {'profile': 'px4', 'has_summary': False},
    {'early_ns': 0},
], ids=str)  # fmt: skip
def test_layouts_that_the_specification_of_mcap_allows(tmp_path, plain, options):
    path = Layout(**options).write(plain, tmp_path / 'layout.mcap')
    found, counts, begin_ns, end_ns = content_of(path)
    expected, all_counts, first_ns, last_ns = content_of(plain)
    if options.get('early_ns') == 0:
        expected = [(*one[:3], one[3] - first_ns, one[4]) for one in expected]
        first_ns, last_ns = 0, last_ns - first_ns
    assert found == expected
    assert (begin_ns, end_ns) == (first_ns, last_ns)
    assert counts == all_counts


@pytest.mark.parametrize('options', [
    {'repeat_schemas': False},
    {'repeat_channels': False},
    {'index_types': IndexType.NONE},
    {'index_types': IndexType.CHUNK},
    {'index_types': IndexType.MESSAGE},
    {'use_chunking': False, 'repeat_schemas': False},
    {'use_statistics': False},
    {'use_summary_offsets': False},
], ids=str)  # fmt: skip
def test_options_of_the_writer_of_mcap(tmp_path, plain, options):
    path = rewritten(plain, tmp_path / 'options.mcap', **options)
    assert content_of(path) == content_of(plain)


# rosbag2 databases -----------------------------------------------------------------------------

OLDER = {
    1: ['offered_qos_profiles', 'type_description_hash'],
    2: ['type_description_hash'],
    3: ['type_description_hash'],
}
"""Columns of the topics that the schemas before 4 do not have."""


@pytest.fixture(scope='module')
def database(tmp_path_factory):
    """Return the bytes of a database of 12 sweeps."""
    folder = Drive(sweeps=12).write(tmp_path_factory.mktemp('database') / 'drive', 'sqlite3')
    (file,) = folder.glob('*.db3')
    return file.read_bytes()


def changed(database, path, *statements):
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(database)
    with closing(sqlite3.connect(path)) as connected:
        for statement in statements:
            connected.execute(statement)
        connected.commit()
    return path


def messages_of(path):
    found, counts, *times = content_of(path)
    return [(one[0], one[1], one[3], one[4]) for one in found], counts, times


@pytest.mark.parametrize('version', [1, 2, 3])
def test_databases_of_older_releases(tmp_path, database, version):
    path = changed(
        database, tmp_path / 'older.db3', 'DROP TABLE message_definitions',
        *(f'ALTER TABLE topics DROP COLUMN {column}' for column in OLDER[version]),
        f'UPDATE schema SET schema_version = {version}' if version == 3 else 'DROP TABLE schema',
        *(['DROP TABLE metadata'] if version < 3 else []),
    )  # fmt: skip
    expected = messages_of(changed(database, tmp_path / 'newest.db3'))
    assert messages_of(path) == expected


@pytest.mark.parametrize('name', ['run #1', 'what?', 'a%20b', "it's", 'über', 'a b&c=d'])
def test_any_name_of_a_folder(tmp_path, database, name):
    expected = messages_of(changed(database, tmp_path / 'plain.db3'))
    assert messages_of(changed(database, tmp_path / name / f'{name}.db3')) == expected


@pytest.mark.parametrize('statement', [
    'DROP INDEX timestamp_idx',
    "UPDATE message_definitions SET encoding = 'unknown', encoded_message_definition = ''",
    'DELETE FROM message_definitions',
    "UPDATE topics SET offered_qos_profiles = ''",
    "UPDATE topics SET type_description_hash = ''",
    "INSERT INTO topics VALUES (99, '/empty', 'std_msgs/msg/String', 'cdr', '', '')",
    'PRAGMA user_version = 7',
    'CREATE TABLE other(x)',
])  # fmt: skip
def test_databases_as_recorders_and_converters_write_them(tmp_path, database, statement):
    expected, counts, times = messages_of(changed(database, tmp_path / 'plain.db3'))
    found, more, other_times = messages_of(changed(database, tmp_path / 'other.db3', statement))
    assert (found, other_times) == (expected, times)
    assert {topic: count for topic, count in more.items() if count} == counts


# ROS 1 bags ------------------------------------------------------------------------------------


@pytest.mark.parametrize('compression', [None, 'BZ2', 'LZ4'])
def test_bags_of_each_compression(tmp_path, compression):
    from rosbags.rosbag1 import Writer

    drive = Drive(sweeps=12, ros1=True)
    expected = content_of(write_recording(tmp_path / 'plain', drive.items, 'rosbag1'))
    store = drive.messages.store
    writer = Writer(tmp_path / 'packed.bag')
    writer.chunk_threshold = 5_000
    if compression is not None:
        writer.set_compression(Writer.CompressionFormat[compression])
    with writer:
        connections = {}
        for topic, time_ns, message in drive.items:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], time_ns, store.serialize_ros1(message, kind))
    assert content_of(tmp_path / 'packed.bag') == expected
