"""MCAP files of messages of ROS 2: a map's readings, to be opened by Foxglove, PlotJuggler or `ros2 bag play`."""

from pathlib import Path
from types import TracebackType
from typing import Literal, Self

from mcap.writer import CompressionType, Writer

from cairn_fusion.ros.bag import Wire
from cairn_fusion.ros.map_messages import MapMessage, definition_of
from cairn_map.errors import BadInputError


class McapFile:
    """MCAP file that grows message by message, for a `with` block: at its end it gets its index, and its name.

    Until then messages go into FILE.part, and what was there under the name stays. An error leaves FILE.part with its
    index; without a message no file is left.

    Raises:
        BadInputError: kind `bad_output`: the file cannot be written.
    """

    def __init__(self, path: Path, *, packing: Literal["ZSTD", "LZ4"] = "ZSTD") -> None:
        """Args: packing: of the file's chunks; LZ4 packs less, at a fifth of the work."""
        self._whole_path = path
        if path.is_dir():
            raise BadInputError("bad_output", f"cannot write {path}: it is a folder")
        self.path = path.with_name(f"{path.name}.part")
        """Place of the messages."""
        try:
            self._file = self.path.open("wb")
        except OSError as exc:
            raise BadInputError("bad_output", f"cannot write {path}: {exc.strerror}") from exc
        self._writer = Writer(self._file, compression=CompressionType[packing])
        self._writer.start(profile="ros2", library="cairn")
        self._channels: dict[str, int] = {}
        self._schemas: dict[tuple[str, Wire], int] = {}
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

    def send(self, message: MapMessage, wire: Wire = Wire.CDR) -> None:
        """Append a message, coded so."""
        topic = message.topic
        if topic not in self._channels:
            schema = self._schema_of(message.type_name, wire)
            self._channels[topic] = self._writer.register_channel(topic, wire.value, schema)
        self._counts[topic] = self._counts.get(topic, 0) + 1
        self._writer.add_message(
            self._channels[topic], message.time_ns, message.data, message.time_ns, self._counts[topic]
        )

    def _schema_of(self, type_name: str, wire: Wire) -> int:
        if (type_name, wire) not in self._schemas:
            data, form = definition_of(type_name, wire).encode(), "ros1msg" if wire is Wire.ROS1 else "ros2msg"
            self._schemas[type_name, wire] = self._writer.register_schema(type_name, form, data)
        return self._schemas[type_name, wire]
