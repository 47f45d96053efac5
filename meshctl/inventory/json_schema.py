"""The format as a JSON Schema (draft 2020-12), so that editors complete and check an inventory."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, NoDefault
from pydantic_core import core_schema

from meshctl.inventory.documents import InventoryDocument
from meshctl.inventory.fields import empty_mapping

SCHEMA_ID = "urn:meshctl:inventory:1"


def json_schema() -> dict[str, Any]:
    """The schema of every file of an inventory.

    A file that names the format's version is the first one and holds what a fleet must have; one that does not is
    included, and holds any of the same keys.
    """
    schema = _untitled(InventoryDocument.model_json_schema(by_alias=True, schema_generator=_Generator))
    required = schema.pop("required")
    whole = {"if": {"required": ["meshctl"]}, "then": {"required": required}}
    return {"$schema": _Generator.schema_dialect, "$id": SCHEMA_ID, **schema, **whole}


class _Generator(GenerateJsonSchema):
    """Leaves out defaults that say nothing: that a key is not written, or that a section has its own."""

    def get_default_value(self, schema: core_schema.WithDefaultSchema) -> Any:
        default = super().get_default_value(schema)
        return NoDefault if default is None or isinstance(default, BaseModel) else default

    def function_before_schema(self, schema: core_schema.BeforeValidatorFunctionSchema) -> dict[str, Any]:
        """Where nothing may stand for an empty mapping, null is allowed."""
        inner = super().function_before_schema(schema)
        if schema["function"]["function"] is empty_mapping:
            return {"anyOf": [inner, {"type": "null"}]}
        return inner


def _untitled(value: Any) -> Any:
    """Without the titles, which repeat the keys."""
    if isinstance(value, list):
        return [_untitled(item) for item in value]
    if not isinstance(value, dict):
        return value
    return {key: _untitled(item) for key, item in value.items() if not (key == "title" and isinstance(item, str))}
