"""Reading recordings without ROS: MCAP files, ROS 2 bags (MCAP or SQLite) and ROS 1 bags. Needs the extra `ros`."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from cobevglue.recordings.message_definitions import LAYOUTS

__all__ = ["Recording", "Topic", "open_recording"]

_ENDINGS = (".mcap", ".db3", ".bag")
_EXPLANATIONS = {
    "File magic is invalid.": "this is no MCAP file",
    "File end magic is invalid.": "the file is truncated; `mcap recover` makes a readable one of it",
    "'protobuf'": "its messages are in protobuf; only messages of ROS can be read",
    "'jsonschema'": "its messages are in JSON; only messages of ROS can be read",
    "Profile is not ros2.": "its messages are not of ROS 2 (the profile of the MCAP file)",
}
"""Of errors of rosbags that say too little."""


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a recording.

    Attributes:
        name: as recorded.
        type: of its messages, for example `vision_msgs/msg/Detection3DArray`.
        count: number of messages.
    """

    name: str
    type: str
    count: int


class Recording:
    """A recording that is open for reading; see `open_recording`.

    Attributes:
        path: of the recording.
        topics: by name.
    """

    def __init__(self, path: Path, reader: Any) -> None:
        self.path = path
        self.topics = {
            name: Topic(name, info.msgtype or "several types", info.msgcount)
            for name, info in sorted(reader.topics.items())
        }
        self._reader = reader
        self._decoders: dict[str, Callable[[bytes], Any]] = {}

    def messages(self, topics: Iterable[str]) -> Iterator[tuple[str, float, Any]]:
        """The messages of these topics in the order in which they were received.

        Yields:
            Topic, time of receipt [s], and the message with its fields as attributes.

        Raises:
            ValueError: the recording is damaged, or the definition of a message is missing; names file and topic.
        """
        chosen = set(topics)
        connections = [each for each in self._reader.connections if each.topic in chosen]
        incoming = self._reader.messages(connections) if connections else iter(())
        counts = dict.fromkeys(chosen, 0)
        while True:
            with _named_errors(f"{self.path}: "):
                entry = next(incoming, None)
            if entry is None:
                return
            connection, nanoseconds, data = entry
            counts[connection.topic] += 1
            with _named_errors(f"{self.path}: {connection.topic}: message {counts[connection.topic]}: "):
                if connection.topic not in self._decoders:
                    self._decoders[connection.topic] = _decoder(connection, data, is_ros1=self.path.suffix == ".bag")
                message = self._decoders[connection.topic](data)
            yield connection.topic, 1e-9 * nanoseconds, message


@contextmanager
def open_recording(path: str | Path) -> Iterator[Recording]:
    """Open a recording.

        with open_recording("drive.mcap") as recording:
            for topic, received, message in recording.messages(["/car1/objects"]):
                ...

    Args:
        path: an `.mcap`, `.db3` or `.bag` file, or the folder of a ROS 2 bag.

    Raises:
        FileNotFoundError: it does not exist.
        ValueError: it is no recording, or a damaged one; names the file.
        ModuleNotFoundError: rosbags is not installed.
    """
    path = Path(path)
    _check_kind(path)
    try:
        from rosbags import rosbag1, rosbag2
    except ImportError as error:
        raise ModuleNotFoundError(
            f"recordings need rosbags: pip install 'cobevglue[ros]' ({error})", name="rosbags"
        ) from None
    with _named_errors(f"{path}: "):
        reader: Any = rosbag1.Reader(path) if path.suffix == ".bag" else rosbag2.Reader(path)
        reader.open()
    try:
        yield Recording(path, reader)
    finally:
        reader.close()


@contextmanager
def _named_errors(where: str) -> Iterator[None]:
    """What the library raises on damaged data, which may be anything, as a ValueError that says where."""
    try:
        yield
    except OSError:
        raise
    except Exception as error:
        said = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(where + _EXPLANATIONS.get(said, said)) from error


def _check_kind(path: Path) -> None:
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if path.is_dir() and not (path / "metadata.yaml").exists():
        files = sorted(file.name for file in path.iterdir() if file.suffix in _ENDINGS)
        hint = f"give one of its files, such as {path / files[0]}" if files else "there is no recording in it"
        raise ValueError(f"{path}: a folder without metadata.yaml is not a ROS 2 bag; {hint}")
    if path.is_file() and path.suffix not in _ENDINGS:
        raise ValueError(f"{path}: a recording ends with {', '.join(_ENDINGS)}, or is the folder of a ROS 2 bag")


def _decoder(connection: Any, data: bytes, is_ros1: bool) -> Callable[[bytes], Any]:
    """The function from the bytes of a message to its fields, by the definition in the bag or by ours.

    Args:
        connection: of rosbags.
        data: the first message, to tell which layout it has where the bag does not say.
        is_ros1: it is a ROS 1 bag.
    """
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    kind, definition = connection.msgtype, connection.msgdef
    if definition.format != MessageDefinitionFormat.NONE:
        store = get_typestore(Stores.EMPTY)
        if definition.format == MessageDefinitionFormat.MSG:
            store.register(get_types_from_msg(definition.data, kind))
        else:  # several files, each after a line of "=" and its name
            for part in re.split(r"^=+\nIDL: .*\n", definition.data, flags=re.MULTILINE):
                store.register(get_types_from_idl(part))
        return partial(store.deserialize_ros1 if is_ros1 else store.deserialize_cdr, typename=kind)
    problem = f"the recording has no definition of {kind}"
    for layout in LAYOUTS:
        store, types = get_typestore(Stores.ROS2_HUMBLE), {}
        for name, text in layout.items():
            types.update(get_types_from_msg(text, name))
        store.register(types)
        if kind in store.types:
            decode = partial(store.deserialize_cdr, typename=kind)
            try:
                decode(data)
            except Exception as error:  # of another layout
                problem += f", and the message does not fit the known one: {error}"
            else:
                return decode
    raise ValueError(problem)
