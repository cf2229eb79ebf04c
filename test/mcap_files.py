"""MCAP files in other layouts, written by the mcap library."""

from mcap.reader import make_reader
from mcap.writer import Writer


def rewritten(path, target, order=None, chunk_size=4096, **options):
    """Write an MCAP file again with the mcap library; `order` sorts the messages."""
    with path.open('rb') as source, target.open('wb') as file:
        found = list(make_reader(source).iter_messages())
        writer = Writer(file, chunk_size=chunk_size, **options)
        writer.start('ros2')
        channels = {}
        for schema, channel, message in sorted(found, key=order) if order else found:
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            writer.add_message(
                channels[channel.topic], message.log_time, message.data, message.log_time
            )
        writer.finish()
    return target
