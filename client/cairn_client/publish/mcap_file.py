"""MCAP files of messages of ROS 2: a map's readings, to be opened by Foxglove, PlotJuggler or `ros2 bag play`."""

from pathlib import Path
from types import TracebackType
from typing import Self

from mcap.writer import Writer

from cairn_fusion.ros.map_messages import MapMessage, definition_of
from cairn_map.errors import BadInputError


class McapFile:
    """MCAP file that grows message by message, for a `with` block: at its end it gets its index, and its name.

    Until then messages go into FILE.part, and what was there under the name stays. An error leaves FILE.part with its
    index; without a message no file is left.

    Raises:
        BadInputError: kind `bad_output`: the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._whole_path = path
        if path.is_dir():
            raise BadInputError("bad_output", f"cannot write {path}: it is a folder")
        self.path = path.with_name(f"{path.name}.part")
        """Place of the messages."""
        try:
            self._file = self.path.open("wb")
        except OSError as exc:
            raise BadInputError("bad_output", f"cannot write {path}: {exc.strerror}") from exc
        self._writer = Writer(self._file)
        self._writer.start(profile="ros2", library="cairn")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._counts: dict[str, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()
        if not self.count:
            self.path.unlink()
        elif exc is None or isinstance(exc, KeyboardInterrupt):
            # Ctrl-C is how a file that follows a map ends.
            self.path = self.path.replace(self._whole_path)

    @property
    def count(self) -> int:
        """Messages so far."""
        return sum(self._counts.values())

    def send(self, message: MapMessage) -> None:
        """Append a message."""
        topic = message.topic
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schema_of(message.type_name))
        self._counts[topic] = self._counts.get(topic, 0) + 1
        self._writer.add_message(
            self._channels[topic], message.time_ns, message.data, message.time_ns, self._counts[topic]
        )

    def _schema_of(self, type_name: str) -> int:
        if type_name not in self._schemas:
            data = definition_of(type_name).encode()
            self._schemas[type_name] = self._writer.register_schema(type_name, "ros2msg", data)
        return self._schemas[type_name]
