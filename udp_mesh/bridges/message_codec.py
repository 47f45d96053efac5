"""ROS messages as bytes <-> values, by their definition: the wire of ROS 1, and CDR as ROS 2 sends it. Pure.

A message becomes a dictionary, a contained message too; arrays of numbers stay bytes in little-endian order
(`Numbers`), so that an image or a point cloud is never unpacked. The two wires differ in alignment, in the terminator
of strings, in the encapsulation header of CDR, and in `seq` of std_msgs/Header, which ROS 2 does not have.

References: http://wiki.ros.org/msg and the OMG's DDSI-RTPS 2.3, section 10.2 (plain CDR of encoding version 1).
"""

from __future__ import annotations

import struct
import sys
from array import array
from functools import lru_cache
from typing import Any, Dict, List, NamedTuple, Optional, Tuple

from udp_mesh.bridges.message_definition import HEADER, MAX_DEPTH, DefinitionError, Field, MessageDefinition

Message = Dict[str, Any]
ENCAPSULATION = b"\x00\x01\x00\x00"
"""Plain CDR, little-endian, without options."""
MAX_ELEMENTS = 1 << 20
"""Contained messages or strings in one array: bounds what a few bytes can make us allocate."""
MAX_PADDING_BYTES = 7
"""At the end of a CDR message: up to the alignment of the largest number."""
NUMBERS = {
    "bool": "B",
    "int8": "b",
    "uint8": "B",
    "char": "B",
    "byte": "b",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}


class CodecError(ValueError):
    """These bytes or values are not a message of this definition."""


class Numbers(NamedTuple):
    """An array of numbers: a format character of `struct`, and the elements in little-endian order."""

    form: str
    data: bytes

    def values(self) -> List[Any]:
        return list(struct.unpack("<{}{}".format(len(self.data) // struct.calcsize(self.form), self.form), self.data))


def numbers(type_name: str, values: List[Any]) -> Numbers:
    """Values as an array of this type."""
    form = NUMBERS[type_name]
    return Numbers(form, struct.pack("<{}{}".format(len(values), form), *values))


def decode(definition: MessageDefinition, data: bytes, ros_version: int) -> Message:
    """Bytes -> values. Raises CodecError."""
    reader = MessageReader(data, ros_version)
    try:
        message = _read(reader, definition, definition.name, 0)
        reader.finish()
        return message
    except (struct.error, UnicodeDecodeError, DefinitionError) as error:
        raise CodecError("{}: {}".format(definition.name, error)) from error


def encode(definition: MessageDefinition, message: Message, ros_version: int) -> bytes:
    """Values -> bytes; fields that are missing are zero. Raises CodecError."""
    writer = _Writer(ros_version)
    try:
        _write(writer, definition, definition.name, message)
    except (struct.error, UnicodeEncodeError, DefinitionError, TypeError) as error:
        raise CodecError("{}: {}".format(definition.name, error)) from error
    return bytes(writer.data)


def converted(definition: MessageDefinition, data: bytes, from_version: int, to_version: int) -> bytes:
    """One wire -> the other. Raises CodecError."""
    return encode(definition, decode(definition, data, from_version), to_version)


@lru_cache(maxsize=256)
def _layout(text: str) -> Tuple[struct.Struct, int]:
    """A format of `struct` with one kind of number, and the size of each."""
    return struct.Struct(text), struct.calcsize("<" + text[-1])


class MessageReader:
    """The bytes of one message, read in the order of its fields. Raises struct.error, UnicodeDecodeError or CodecError
    for bytes that are none."""

    def __init__(self, data: bytes, ros_version: int) -> None:
        self.ros_version, self._at, self._is_cdr = ros_version, 0, ros_version == 2
        self._data, self._order = memoryview(data), "<"
        if ros_version == 2:
            if data[:2] not in (b"\x00\x00", b"\x00\x01"):
                raise CodecError("expected plain CDR, found the encapsulation {}".format(data[:2].hex()))
            self._order = "<" if data[1] else ">"
            self._data = self._data[4:]

    def number(self, form: str) -> Any:
        return self.values(form)[0]

    def values(self, form: str) -> Tuple[Any, ...]:
        """Consecutive fields of one type of number, such as `3d`."""
        layout, size = _layout(self._order + form)
        if self._is_cdr:
            self._at += -self._at % size
        found = layout.unpack_from(self._data, self._at)
        self._at += layout.size
        return found

    def time(self, type_name: str = "time") -> Tuple[int, int]:
        """Seconds and nanoseconds."""
        signs = _time_form(type_name, self.ros_version)
        return self.number(signs[0]), self.number(signs[1])

    def take(self, size: int) -> bytes:
        raw = self._data[self._at : self._at + size]
        if len(raw) != size:
            raise CodecError("expected {} more bytes, found {}".format(size, len(raw)))
        self._at += size
        return bytes(raw)

    def text(self) -> str:
        raw = self.take(self.number("I"))
        return (raw[:-1] if self.ros_version == 2 and raw[-1:] == b"\0" else raw).decode()

    def numbers(self, form: str, count: int) -> Numbers:
        size = struct.calcsize(form)
        if self.ros_version == 2 and count:
            self._at += -self._at % size
        raw = self.take(count * size)
        return Numbers(form, raw if self._order == "<" or size == 1 else _swapped(form, raw))

    def finish(self) -> None:
        """Checks that nothing is left but padding: other bytes mean that the source has another definition."""
        left = len(self._data) - self._at
        if left > (MAX_PADDING_BYTES if self.ros_version == 2 else 0):
            raise CodecError("{} bytes are left after the last field".format(left))


def _swapped(form: str, raw: bytes) -> bytes:
    values = array(form, raw)
    values.byteswap()
    return values.tobytes()


def _read(reader: MessageReader, definition: MessageDefinition, name: str, depth: int) -> Message:
    if depth > MAX_DEPTH:
        raise CodecError("{}: nested too deeply".format(name))
    fields = definition.fields(name)
    if not fields and reader.ros_version == 2:
        # an IDL structure has at least one member
        reader.number("B")
    return {
        field.name: _read_field(reader, definition, field, depth)
        for field in fields
        if not is_missing(name, field, reader.ros_version)
    }


def _read_field(reader: MessageReader, definition: MessageDefinition, field: Field, depth: int) -> Any:
    form = NUMBERS.get(field.type)
    if field.length is None:
        return _read_value(reader, definition, field.type, form, depth)
    count = field.length or reader.number("I")
    if form is not None:
        return reader.numbers(form, count)
    if count > MAX_ELEMENTS:
        raise CodecError("{}: expected at most {} elements, found {}".format(field.name, MAX_ELEMENTS, count))
    return [_read_value(reader, definition, field.type, None, depth) for _ in range(count)]


def _read_value(
    reader: MessageReader, definition: MessageDefinition, type_name: str, form: Optional[str], depth: int
) -> Any:
    if form is not None:
        return reader.number(form)
    if type_name == "string":
        return reader.text()
    if type_name in ("time", "duration"):
        return reader.time(type_name)
    return _read(reader, definition, type_name, depth + 1)


def _time_form(type_name: str, ros_version: int) -> str:
    """Seconds and nanoseconds; ROS 2's types are builtin_interfaces/Time and Duration."""
    if type_name == "time":
        return "iI" if ros_version == 2 else "II"
    return "iI" if ros_version == 2 else "ii"


def is_missing(name: str, field: Field, ros_version: int) -> bool:
    """Whether this version of ROS does not have this field of the message `name`."""
    return ros_version == 2 and name == HEADER and field.name == "seq"


class _Writer:
    def __init__(self, ros_version: int) -> None:
        self.ros_version = ros_version
        self.data = bytearray(ENCAPSULATION if ros_version == 2 else b"")

    def align(self, size: int) -> None:
        if self.ros_version == 2:
            # relative to the end of the encapsulation header
            self.data += bytes(-(len(self.data) - 4) % size)

    def number(self, form: str, value: Any) -> None:
        self.align(struct.calcsize(form))
        self.data += struct.pack("<" + form, value)

    def text(self, value: str) -> None:
        raw = value.encode() + (b"\0" if self.ros_version == 2 else b"")
        self.number("I", len(raw))
        self.data += raw

    def numbers(self, value: Numbers) -> None:
        if value.data:
            self.align(struct.calcsize(value.form))
        self.data += value.data


def _write(writer: _Writer, definition: MessageDefinition, name: str, message: Message) -> None:
    fields = definition.fields(name)
    if not fields and writer.ros_version == 2:
        writer.number("B", 0)
    for field in fields:
        if not is_missing(name, field, writer.ros_version):
            _write_field(writer, definition, field, message.get(field.name))


def _write_field(writer: _Writer, definition: MessageDefinition, field: Field, value: Any) -> None:
    form = NUMBERS.get(field.type)
    if field.length is None:
        _write_value(writer, definition, field.type, form, value)
    elif form is not None:
        found = value if value is not None else Numbers(form, bytes(field.length * struct.calcsize(form)))
        count = len(found.data) // struct.calcsize(form)
        _write_count(writer, field, count)
        writer.numbers(found)
    else:
        elements = value if value is not None else [None] * field.length
        _write_count(writer, field, len(elements))
        for element in elements:
            _write_value(writer, definition, field.type, None, element)


def _write_count(writer: _Writer, field: Field, count: int) -> None:
    if not field.length:
        writer.number("I", count)
    elif count != field.length:
        raise CodecError("{}: expected {} elements, found {}".format(field.name, field.length, count))


def _write_value(
    writer: _Writer, definition: MessageDefinition, type_name: str, form: Optional[str], value: Any
) -> None:
    if form is not None:
        writer.number(form, value or 0)
    elif type_name == "string":
        writer.text(value or "")
    elif type_name in ("time", "duration"):
        seconds, nanoseconds = value or (0, 0)
        signs = _time_form(type_name, writer.ros_version)
        writer.number(signs[0], seconds)
        writer.number(signs[1], nanoseconds)
    else:
        _write(writer, definition, type_name, value or {})


# array.tobytes() and the arrays above are little-endian only here
assert sys.byteorder == "little", "the bridge's codec expects a little-endian machine"
