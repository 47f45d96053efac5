"""A message definition -> its type hash in ROS 2, such as `RIHS01_df66...`. Pure.

The hash is the SHA-256 of the type description as JSON: names and types of the fields, then those of every message
inside, sorted by name; constants and comments do not count (REP 2011; rosidl_generator_type_description).
"""

from __future__ import annotations

import hashlib
import json
from typing import Dict, List

from udp_mesh.bridges.message_codec import is_missing
from udp_mesh.bridges.message_definition import BUILTIN, Field, MessageDefinition
from udp_mesh.bridges.mixed_team import ros2_type

# type_description_interfaces/msg/FieldType
NESTED = 1
_NUMBERS = {"int8": 2, "uint8": 3, "int16": 4, "uint16": 5, "int32": 6, "uint32": 7, "int64": 8, "uint64": 9}
_OTHERS = {"float32": 10, "float64": 11, "char": 3, "bool": 15, "byte": 16, "string": 17}
TYPE_IDS = {**_NUMBERS, **_OTHERS}
ARRAY, SEQUENCE = 48, 144
"""Added for an array of fixed and of any length."""
_PLACEHOLDER = Field("structure_needs_at_least_one_member", "uint8", None)
_TIMES = {"time": "Time", "duration": "Duration"}


def type_hash(definition: MessageDefinition) -> str:
    """Raises DefinitionError for an incomplete definition."""
    found: Dict[str, object] = {}
    _describe(definition, definition.name, found)
    own = found.pop(ros2_type(definition.name))
    text = json.dumps(
        {"type_description": own, "referenced_type_descriptions": [found[name] for name in sorted(found)]}
    )
    return "RIHS01_" + hashlib.sha256(text.encode()).hexdigest()


def _describe(definition: MessageDefinition, name: str, found: Dict[str, object]) -> None:
    """Adds the descriptions of a message and of all inside it."""
    if ros2_type(name) in found:
        return
    fields = [field for field in definition.fields(name) if not is_missing(name, field, 2)]
    found[ros2_type(name)] = _description(ros2_type(name), fields or [_PLACEHOLDER])
    for field in fields:
        if field.type in _TIMES:
            inner = _nested_name(field.type)
            seconds = [Field("sec", "int32", None), Field("nanosec", "uint32", None)]
            found[inner] = _description(inner, seconds)
        elif field.type not in BUILTIN:
            _describe(definition, field.type, found)


def _nested_name(type_name: str) -> str:
    if type_name in _TIMES:
        return "builtin_interfaces/msg/" + _TIMES[type_name]
    return "" if type_name in TYPE_IDS else ros2_type(type_name)


def _description(name: str, fields: List[Field]) -> Dict[str, object]:
    described = []
    for field in fields:
        kind = TYPE_IDS.get(field.type, NESTED)
        if field.length is not None:
            kind += ARRAY if field.length else SEQUENCE
        described.append(
            {
                "name": field.name,
                "type": {
                    "type_id": kind,
                    "capacity": field.length or 0,
                    "string_capacity": 0,
                    "nested_type_name": _nested_name(field.type),
                },
            }
        )
    return {"type_name": name, "fields": described}
