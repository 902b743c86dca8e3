"""Logs with values that no recorder of fitctl writes: copies of one, with its messages changed."""

from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema
from samples.log_samples import RUN_INFO, WALL_S, tick, write_log

from fitctl.logging.reading import read_records


def forged(source, target, change, add=lambda _: None):
    """Copy a log; `change` may alter each record's message, and returns its publish time, or None for its own.

    Parameters
    ----------
    change : callable
        Gets a :class:`fitctl.logging.reading.LogMessage`.
    add : callable, optional
        Gets the library's writer at the end, for more records.
    """
    with source.open("rb") as stream, target.open("wb") as file:
        reader = make_reader(stream)
        summary = reader.get_summary()
        writer = Writer(file)
        writer.start()
        for entry in reader.iter_metadata():
            writer.add_metadata(entry.name, entry.metadata)
        channels = {}
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            kind = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[channel.topic] = writer.register_channel(
                channel.topic, channel.message_encoding, kind
            )
        for record in read_records(source):
            publish_ns = change(record)
            writer.add_message(
                channel_id=channels[record.topic],
                log_time=record.log_time_ns,
                data=record.message.SerializeToString(),
                publish_time=record.publish_time_ns if publish_ns is None else publish_ns,
                sequence=record.sequence,
            )
        add(writer)
        writer.finish()
    return target


def forged_of(records, target, topic, **values):
    """A log of sample records, where every message of a topic has these values."""
    source = write_log(target.with_name("as_recorded.mcap"), records)
    return with_values(source, target, topic, **values)


def with_values(source, target, topic, **values):
    """Copy a log; every message of a topic has these values in the copy."""

    def change(record):
        if record.topic == topic:
            for name, value in values.items():
                setattr(record.message, name, value)

    return forged(source, target, change)


def with_topic_of_another_program(target):
    """A log of a tick, with a topic in JSON."""
    source = write_log(target.with_name("as_recorded.mcap"), [RUN_INFO, tick(1)])

    def add(writer):
        channel = writer.register_channel("/odo", "json", schema_id=0)
        writer.add_message(channel, log_time=2 * 10**18, data=b"{}", publish_time=2 * 10**18)

    return forged(source, target, lambda _: None, add)


def with_messages_of_another_program(target, topic, message):
    """A log of a tick, with two messages of any protobuf type under a topic."""
    source = write_log(target.with_name("as_recorded.mcap"), [RUN_INFO, tick(1)])

    def add(writer):
        kind = register_schema(writer, type(message))
        channel = writer.register_channel(topic, "protobuf", kind)
        for after_ns in (0, 1):
            time_ns = round((WALL_S + 1) * 1e9) + after_ns
            data = message.SerializeToString()
            writer.add_message(channel, log_time=time_ns, data=data, publish_time=time_ns)

    return forged(source, target, lambda _: None, add)
