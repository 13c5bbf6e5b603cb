"""Import bags of ROS 2: MCAP files, `.db3` files of rosbag2, and folders of rosbag2 with several of them.

A bag is an episode. `ros_messages` gives its messages to it; this module reads files. An MCAP file is read chunk by
chunk, also one that was never finished, and the messages of a chunk in the order of their times. Messages are decoded
by rosbags, with the definitions that the file has, else with those of the latest ROS 2; transforms by a decoder of our
own, because they are most of a bag.

The memory that an import takes does not grow with the bag.
"""

import re
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from pycrorm_async.errors import MissingExtra
from pycrorm_async.imports import intake as intakes
from pycrorm_async.imports.intake import Intake
from pycrorm_async.imports.ros_messages import RosMap, RosReader, transforms_of

_MCAP = b"\x89MCAP0\r\n"
_SQLITE = b"SQLite format 3\0"
_ZSTD = b"\x28\xb5\x2f\xfd"
_REPORTED = 5_000
"""The messages between two reports of the progress."""
_TIMES_NS = range(2**63)
_DAMAGE = struct.error, ValueError, EOFError, RuntimeError, OverflowError, MemoryError
"""What reading a damaged file of MCAP raises, besides errors of its libraries."""
_TF = "tf2_msgs/msg/TFMessage"


class _Message(NamedTuple):
    """A message: when it was received, its topic and type, the definition of that, and its bytes in CDR.

    The type is empty if it is no message of ROS 2, which are those in CDR.
    """

    at: int
    topic: str
    type_name: str
    definition: str
    data: bytes


def read_bag(path: Path, settings: RosMap, intake: Intake) -> None:
    """Give the episode of a bag to the intake. Raises `WrongFormat` and `MissingExtra`."""
    files = [each for each in path.iterdir() if each.suffix in (".mcap", ".db3")] if path.is_dir() else [path]
    files.sort(key=_numbered)
    if not files:
        raise intakes.WrongFormat(f"{path} has no .mcap or .db3 file")
    decoder = _Decoder()
    messages = chain.from_iterable(_messages(each, intake) for each in files)
    first = next(messages, None)
    if first is None:
        intake.left_out("bags", "they have no messages")
        return
    metadata = {"file": path.name}
    with intake.episode(intakes.identity_of(*files), first.at, description=path.name, metadata=metadata) as episode:
        reader = RosReader(settings, episode, intake)
        unwanted, undecoded = Counter[tuple[str, str]](), Counter[tuple[str, str]]()
        for message in chain([first], messages):
            topic, type_name = message.topic, message.type_name
            if episode.is_stored:
                break
            if message.at not in _TIMES_NS:
                intake.left_out("messages", "their times are out of range")
            elif not type_name or not reader.wants(topic, type_name):
                unwanted[topic, type_name] += 1
            elif reader.is_due(topic, type_name, message.at):
                try:
                    if type_name == _TF and message.data[:2] == b"\0\1":
                        reader.transforms(transforms_of(message.data), message.at)
                    else:
                        reader.read(topic, type_name, decoder.decoded(message), message.at)
                except decoder.refusals:
                    undecoded[topic, type_name] += 1
        reader.finish()
        for (topic, type_name), count in unwanted.items():
            why = (
                f"{type_name} is recorded if `observations` names its topic" if type_name else "they are none of ROS 2"
            )
            intake.left_out(f"messages of {topic}", why, count)
        for (topic, type_name), count in undecoded.items():
            intake.left_out(f"messages of {topic}", f"they cannot be decoded as {type_name}", count)


def _numbered(file: Path) -> list[str | int]:
    """Return a key by which bag_10.mcap comes after bag_2.mcap."""
    parts = re.split(r"([0-9]+)", file.name)
    return [int(each) if index % 2 else each for index, each in enumerate(parts)]


FORMAT = intakes.ImportFormat(read_bag, "bags of ROS 2: MCAP, .db3, and folders of rosbag2", RosMap)


class _Decoder:
    """Decodes messages with the definitions of their file.

    Attributes:
        refusals: what decoding raises for bytes that do not fit.
    """

    def __init__(self) -> None:
        try:
            from rosbags.serde import SerdeError
            from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
        except ImportError:
            raise MissingExtra("bags need mcap and rosbags: pip install 'pycrorm-async[ros]'") from None
        damage = struct.error, ValueError, TypeError, AttributeError, IndexError, KeyError
        self.refusals: tuple[type[Exception], ...] = (SerdeError, TypesysError, *damage)
        self._types_of = get_types_from_msg
        self._latest = get_typestore(Stores.LATEST)
        self._new_store: Callable[[], Any] = partial(get_typestore, Stores.EMPTY)
        self._stores: dict[tuple[str, str], Any] = {}

    def decoded(self, message: _Message) -> Any:
        """Return a message. Raises one of `refusals`, and what a damaged message causes."""
        key = message.type_name, message.definition
        store = self._stores.get(key)
        if store is None:
            store = self._latest
            if message.definition:
                store = self._new_store()
                store.register(self._types_of(message.definition, message.type_name))
            self._stores[key] = store
        return store.deserialize_cdr(message.data, message.type_name)


# === files ====================================================================================================


def _messages(path: Path, intake: Intake) -> Iterator[_Message]:
    with path.open("rb") as file:
        magic = file.read(len(_SQLITE))
    if magic.startswith(_MCAP):
        return _mcap_messages(path, intake)
    if magic == _SQLITE:
        return _sqlite_messages(path, intake)
    hint = ": convert it with `rosbags-convert`" if magic.startswith(b"#ROSBAG") else ""
    raise intakes.WrongFormat(f"{path} is neither an MCAP file nor a .db3 file of rosbag2{hint}")


def _mcap_messages(path: Path, intake: Intake) -> Iterator[_Message]:
    try:
        from mcap.exceptions import McapError
        from mcap.records import Channel, Chunk, Message, Schema
        from mcap.stream_reader import StreamReader, breakup_chunk
        from zstandard import ZstdError
    except ImportError:
        raise MissingExtra("bags need mcap and rosbags: pip install 'pycrorm-async[ros]'") from None
    size = path.stat().st_size
    schemas: dict[int, Any] = {}
    topics: dict[int, tuple[str, str, str]] = {}
    count = 0
    with path.open("rb") as file:
        records = chain.from_iterable(
            sorted(breakup_chunk(each), key=lambda record: getattr(record, "log_time", -1))
            if isinstance(each, Chunk)
            else (each,)
            for each in StreamReader(file, emit_chunks=True, record_size_limit=size).records
        )
        while True:
            try:
                record = next(records, None)
            except (McapError, ZstdError, *_DAMAGE) as error:
                reason = f"{type(error).__name__}{': ' if str(error) else ''}{error}"
                intake.cut(path, f"cannot be read behind byte {file.tell():,}, after {count:,} messages ({reason})")
                return
            if record is None:
                return
            match record:
                case Message(channel_id=channel, log_time=at, data=data) if channel in topics:
                    count += 1
                    if count % _REPORTED == 0:
                        intake.progress(file.tell(), size)
                    yield _Message(at, *topics[channel], data)
                case Message():
                    intake.left_out("messages", "the file has no channel of their number")
                case Channel(id=number, topic=topic, schema_id=schema_id, message_encoding=encoding):
                    schema = schemas.get(schema_id)
                    name = schema.name if schema is not None and encoding == "cdr" else ""
                    is_text = schema is not None and schema.encoding == "ros2msg"
                    topics[number] = topic, name, schema.data.decode(errors="replace") if schema and is_text else ""
                case Schema(id=number):
                    schemas[number] = record


def _sqlite_messages(path: Path, intake: Intake) -> Iterator[_Message]:
    with intakes.opened_database(path) as database:
        count = 0
        try:
            topics = {
                number: (str(topic), str(name))
                for number, topic, name in database.execute("SELECT id, name, type FROM topics")
            }
            definitions = dict[str, str]()
            if database.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
                known = (
                    "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'"
                )
                definitions.update(database.execute(known))
            [total] = database.execute("SELECT count(*) FROM messages").fetchone()
        except intakes.DATABASE_ERRORS as error:
            raise intakes.WrongFormat(f"{path} is no .db3 file of rosbag2: {error}") from None
        try:
            rows = database.execute("SELECT timestamp, topic_id, data FROM messages ORDER BY timestamp, id")
            for at, number, data in rows:
                count += 1
                if count % _REPORTED == 0:
                    intake.progress(count, total)
                if number not in topics or not isinstance(at, int) or not isinstance(data, bytes):
                    intake.left_out(
                        "messages", "the file has no topic of their number, or they have no time or content"
                    )
                    continue
                topic, name = topics[number]
                yield _Message(at, topic, name, definitions.get(name, ""), _whole(data))
        except intakes.DATABASE_ERRORS as error:
            intake.cut(path, f"cannot be read after {count:,} messages: {error}")


def _whole(data: bytes) -> bytes:
    """Return a message, also one that is compressed by itself: bytes in CDR begin with zero."""
    if not data.startswith(_ZSTD):
        return data
    import zstandard

    try:
        return zstandard.ZstdDecompressor().decompress(data)
    except zstandard.ZstdError:
        return data
