"""The format as a JSON Schema (draft 2020-12), for completion and validation in editors."""

from __future__ import annotations

import ast
import inspect
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, NoDefault
from pydantic_core import core_schema

from meshctl.inventory.documents import InventoryDocument
from meshctl.inventory.fields import any_flag, any_text, empty_mapping

# of the words that the loader reads as true or false, those that are text in YAML 1.2
_FLAG_WORDS = "^([Yy][Ee][Ss]|[Nn][Oo]|[Oo][Nn]|[Oo][Ff][Ff])$"
SCHEMA_ID = "urn:meshctl:inventory:1"


def json_schema() -> dict[str, Any]:
    """The schema of every file of an inventory.

    A file with `meshctl` is the first one and must have the required keys; a file without it is included, and may have
    any keys.
    """
    schema = _untitled(InventoryDocument.model_json_schema(by_alias=True, schema_generator=_Generator))
    required = schema.pop("required")
    whole = {"if": {"required": ["meshctl"]}, "then": {"required": required}}
    return {"$schema": _Generator.schema_dialect, "$id": SCHEMA_ID, **schema, **whole}


class _Generator(GenerateJsonSchema):
    """Omits defaults without information: unset keys, and sections with their own defaults. Describes each key by its
    attribute's docstring."""

    def model_schema(self, schema: core_schema.ModelSchema) -> dict[str, Any]:
        described = super().model_schema(schema)
        model: type[BaseModel] = schema["cls"]
        docstrings = attribute_docstrings(model)
        for name, field in model.model_fields.items():
            described["properties"][field.alias or name]["description"] = docstrings[name]
        return described

    def get_default_value(self, schema: core_schema.WithDefaultSchema) -> Any:
        default = super().get_default_value(schema)
        return NoDefault if default is None or isinstance(default, BaseModel) else default

    def function_before_schema(self, schema: core_schema.BeforeValidatorFunctionSchema) -> dict[str, Any]:
        """Allow null where it means an empty mapping, and what YAML 1.2, by which editors read, takes for another type
        than the loader does: `label: 17`, `canary: yes`."""
        inner = super().function_before_schema(schema)
        function = schema["function"]["function"]
        if function is empty_mapping:
            return {"anyOf": [inner, {"type": "null"}]}
        if function is any_text and inner["type"] == "string":
            return {**inner, "type": ["string", "number", "boolean"]}
        if function is any_flag:
            return {**inner, "type": ["boolean", "string"], "pattern": _FLAG_WORDS}
        return inner


def attribute_docstrings(model: type[BaseModel]) -> dict[str, str]:
    """The string below each attribute, also of the model's bases. pydantic can read them when it creates a model, which
    takes a sixth of the time to import them all."""
    found: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if not issubclass(base, BaseModel) or base is BaseModel:
            continue
        (definition,) = ast.parse(inspect.getsource(base)).body
        assert isinstance(definition, ast.ClassDef)
        for attribute, below in zip(definition.body, definition.body[1:], strict=False):
            match attribute, below:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    found[name] = inspect.cleandoc(text)
    return found


def _untitled(value: Any) -> Any:
    """Remove titles, which repeat the keys."""
    if isinstance(value, list):
        return [_untitled(item) for item in value]
    if not isinstance(value, dict):
        return value
    return {key: _untitled(item) for key, item in value.items() if not (key == "title" and isinstance(item, str))}
