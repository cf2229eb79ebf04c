"""MCAP files in other layouts, written by the mcap library."""

from mcap.reader import make_reader
from mcap.writer import Writer


def add_messages(writer, path, order=None, without=(), early_ns=0, sequence=0):
    """
    Add the messages of an MCAP file to a writer; `order` sorts them.

    Topics `without` messages are registered alone. Messages were published `early_ns` before they
    were received.

    """
    with path.open('rb') as file:
        found = list(make_reader(file).iter_messages())
    channels = {}
    for schema, channel, message in sorted(found, key=order) if order else found:
        topic, time = channel.topic, message.log_time
        if topic not in channels:
            number = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[topic] = writer.register_channel(
                topic, channel.message_encoding, number, channel.metadata
            )
        if topic not in without:
            writer.add_message(channels[topic], time, message.data, time - early_ns, sequence)


def rewritten(path, target, order=None, chunk_size=4096, without=(), **options):
    """Write an MCAP file again with the mcap library, see `add_messages`."""
    with target.open('wb') as file:
        writer = Writer(file, chunk_size=chunk_size, **options)
        writer.start('ros2')
        add_messages(writer, path, order, without)
        writer.finish()
    return target
