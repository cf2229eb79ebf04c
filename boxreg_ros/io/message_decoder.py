"""Messages from the bytes of a recording, with those that cannot be decoded counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from typing import Any

from boxreg_ros.errors import one_line, UnsupportedMessage
from boxreg_ros.io.definitions import definitions_of, RELEASES, TypeDefinition
from boxreg_ros.io.foxglove import ChannelDecoder, FOXGLOVE_ENCODINGS
from boxreg_ros.io.storage.files import encoding_of
from boxreg_ros.io.storage.reader import decompressed, is_message
from boxreg_ros.io.storage.record import Record
from rosbags.interfaces import Connection, MessageDefinition, MessageDefinitionFormat
from rosbags.serde import SerdeError
from rosbags.typesys import TypesysError
from rosbags.typesys.store import Typestore

ENCAPSULATIONS = {
    b'\0\x02': 'PL_CDR', b'\0\x03': 'PL_CDR', b'\0\x06': 'XCDR2', b'\0\x07': 'XCDR2',
    b'\0\x08': 'D_CDR2', b'\0\x09': 'D_CDR2', b'\0\x0a': 'PL_CDR2', b'\0\x0b': 'PL_CDR2',
}  # fmt: skip
"""Encodings of DDS-XTypes that no middleware of ROS 2 records, by the first bytes of a message."""
SAMPLE = 1000
"""Messages among which one is looked for that fits one definition alone; chosen."""


class MessageDecoder:
    """
    Decode the messages of a recording, called `origin`, each by the definition of its connection.

    `unreadable` counts the messages of each topic that could not be decoded; `first_errors` says
    why.

    """

    def __init__(self, origin: str) -> None:
        self.origin = origin
        self.unreadable: Counter[str] = Counter()
        self.first_errors: dict[str, UnsupportedMessage] = {}
        self._decoders: dict[tuple[str, ...], _RosDecoder | ChannelDecoder] = {}

    def message(self, record: Record) -> Any:
        """Return a message decoded; UnsupportedMessage if its bytes are not of its type."""
        return self.decoded(record.connection, record.data)

    def decoded(self, connection: Connection, data: bytes) -> Any:
        """Return a message on a connection; raises as `message`."""
        origin = f'{self.origin}: a message on {connection.topic!r} is not a {connection.msgtype}'
        with malformed(f'{origin} as defined there'):
            return self._decoder_of(connection)(data)

    def choose_definition(self, connection: Connection, records: Iterable[Record]) -> str:
        """
        Choose the definition of a type that has several and that the recording does not define.

        It is the one by which the first of `records`, those on the connection, parse whole.

        Returns
        -------
        str
            What was chosen, and of which release of ROS 2; empty if nothing had to be.

        """
        decoder = self._decoder_of(connection)
        if not isinstance(decoder, _RosDecoder) or len(decoder.definitions) < 2:
            return ''
        for record in islice(records, SAMPLE):
            with suppress(UnsupportedMessage):
                if decoder.fits_one(record.data):
                    release = decoder.definitions[0].release
                    return (
                        f'{connection.topic}: the recording has no definition of '
                        f'{connection.msgtype}; its messages are read as those of ROS 2 '
                        f'{_releases_from(release, decoder.definitions)}, the only known '
                        f'definition that they fit'
                    )
        return ''

    def store_of(self, connection: Connection) -> Typestore | None:
        """Return the definition of a connection's messages; None if it is not known, or of ROS."""
        decoder = self._decoder_of(connection)
        if isinstance(decoder, _RosDecoder) and decoder.definitions:
            return decoder.definitions[0].store
        return None

    @contextmanager
    def counted(self, topic: str) -> Iterator[None]:
        """Count a message of a topic that cannot be decoded: the rest of the block is left out."""
        try:
            yield
        except UnsupportedMessage as error:
            self.unreadable[topic] += 1
            self.first_errors.setdefault(topic, error)

    def reset(self) -> None:
        """Forget the counts."""
        self.unreadable.clear()
        self.first_errors.clear()

    def _decoder_of(self, connection: Connection) -> _RosDecoder | ChannelDecoder:
        encoding = encoding_of(connection)
        definition = connection.msgdef
        key = (connection.msgtype, encoding, definition.data, definition.format.name)
        decoder = self._decoders.get(key)
        if decoder is None:
            if encoding in FOXGLOVE_ENCODINGS:
                decoder = ChannelDecoder(self.origin, connection)
            else:
                decoder = _RosDecoder(connection.msgtype, definition, encoding == 'ros1')
            self._decoders[key] = decoder
        return decoder


class _RosDecoder:
    """Decodes messages of one definition, or of the first of several known ones that they fit."""

    def __init__(self, kind: str, recorded: MessageDefinition, is_ros1: bool) -> None:
        self._kind = kind
        self._is_ros1 = is_ros1
        self._is_recorded = recorded.format != MessageDefinitionFormat.NONE
        self.definitions = list(definitions_of(kind, recorded, is_ros1))

    def __call__(self, data: bytes) -> Any:
        """Return a message; UnsupportedMessage if it fits none of the definitions."""
        data = decompressed(data)
        first_error: UnsupportedMessage | None = None
        for number, definition in enumerate(self.definitions):
            try:
                message = self._decoded(definition, data)
            except UnsupportedMessage as error:
                first_error = first_error or error
            else:
                if number:  # the others are of this one too
                    self.definitions.insert(0, self.definitions.pop(number))
                return message
        raise first_error or UnsupportedMessage(self._absence())

    def fits_one(self, data: bytes) -> bool:
        """Return whether a message fits one definition alone, which is the first from now on."""
        data = decompressed(data)
        fitting = []
        for definition in self.definitions:
            with suppress(UnsupportedMessage):
                self._decoded(definition, data)
                fitting.append(definition)
        if len(fitting) != 1:
            return False
        self.definitions.remove(fitting[0])
        self.definitions.insert(0, fitting[0])
        return True

    def _decoded(self, definition: TypeDefinition, data: bytes) -> Any:
        encoding = ENCAPSULATIONS.get(bytes(data[:2]))
        if encoding and not self._is_ros1:  # it might parse as plain CDR, with other values
            raise UnsupportedMessage(
                f'expected plain CDR, as the middlewares of ROS 2 write it, got {encoding}; '
                f'convert the recording to plain CDR with the library that wrote it'
            )
        store = definition.store
        decode = store.deserialize_ros1 if self._is_ros1 else store.deserialize_cdr
        view: Any = memoryview(data)  # parts of it are no copies
        try:
            return decode(view, self._kind)
        # rosbags turns all errors of malformed bytes into SerdeError; the others mean that a
        # definition refers to a type that rosbags does not decode, as ``wstring``.
        except (SerdeError, TypesysError, KeyError) as error:
            raise UnsupportedMessage(one_line(error)) from None

    def _absence(self) -> str:
        """Return why there is no definition, and what helps."""
        if self._is_recorded:
            return (
                'the definition in the recording cannot be read; convert the recording by a tool '
                'that writes it as ros2msg'
            )
        package = self._kind.partition('/')[0]
        return (
            f'expected its definition in the recording, got none; convert it where {package} is '
            f'installed, by ros2 bag convert to MCAP, which adds the definitions'
        )


def _releases_from(release: str, definitions: Iterable[TypeDefinition]) -> str:
    """Return the releases that share a definition, from the oldest to the newest."""
    names = list(RELEASES)
    starts = sorted(names.index(definition.release) for definition in definitions)
    newest = names.index(release)
    oldest = next((start for start in starts if start > newest), len(names)) - 1
    named = [names[oldest].capitalize(), names[newest].capitalize()]
    return ' to '.join(dict.fromkeys(named))


@contextmanager
def malformed(origin: str) -> Iterator[None]:
    """
    Turn errors that malformed messages cause into UnsupportedMessage; `origin` comes first.

    Decoders and adapters raise UnsupportedMessage for bytes, sizes and values that contradict
    each other. Beyond these, a message may lack a field because its definition in the recording
    is another one; that is an AttributeError of the message. Every other error, also an
    AttributeError of a module or of an object of ours, is a fault of boxreg_ros and goes on.

    """
    try:
        yield
    except UnsupportedMessage as error:
        raise UnsupportedMessage(f'{origin}: {one_line(error)}') from None
    except AttributeError as error:
        if not is_message(error.obj):
            raise
        raise UnsupportedMessage(
            f'{origin}: expected a field {error.name!r} in its {type(error.obj).__name__}, got '
            f'none; the definition in the recording is not the one that is known'
        ) from None
