#!/usr/bin/env bash
# guess: one DecoderFactory of mcap-protobuf-support decodes each file by the schemas in it
# happens: it remembers decoders by the number of a schema: a second file of other schemas is decoded by the first
#          file's, and fields that these lack are missing from the message without an error
# versions: mcap 1.6.0, mcap-protobuf-support 0.6.0, protobuf 7.36.2
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q mcap==1.6.0 mcap-protobuf-support==0.6.0 protobuf==7.36.2
"$folder/venv/bin/python" - <<'PYTHON'
from io import BytesIO

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory


def recorded(**values):
    """Return an MCAP file with one message of these doubles."""
    file = descriptor_pb2.FileDescriptorProto(name='state.proto', package='car', syntax='proto3')
    message = file.message_type.add(name='State')
    for number, name in enumerate(values, 1):
        message.field.add(name=name, number=number, type=1, label=1)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName('car.State'))
    files = descriptor_pb2.FileDescriptorSet(file=[file])
    target = BytesIO()
    writer = Writer(target)
    writer.start()
    schema = writer.register_schema('car.State', 'protobuf', files.SerializeToString())
    channel = writer.register_channel('/state', 'protobuf', schema)
    writer.add_message(channel, 1, kind(**values).SerializeToString(), 1)
    writer.finish()
    return BytesIO(target.getvalue())


def fields(file, factory):
    """Return the names of the fields of the one message."""
    (found,) = make_reader(file, decoder_factories=[factory]).iter_decoded_messages()
    return [field.name for field, _ in found.decoded_message.ListFields()]


first, second = recorded(speed=3.5), recorded(speed=3.5, heading=1.25)
alone = fields(second, DecoderFactory())
shared = DecoderFactory()
fields(first, shared)
second.seek(0)
behind = fields(second, shared)
print('second file by a factory of its own:', alone)
print('second file behind the first one:   ', behind)
assert alone == ['speed', 'heading'] and behind == ['speed']
PYTHON
