"""The base of all models, and the model of a secret reference."""

from __future__ import annotations

from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from meshctl.inventory.fields import Text, expected_error

# Default of an optional key without its own default; `model_fields_set` shows whether it is set.
NOT_WRITTEN: Any = None


class Document(BaseModel):
    """Base of all models: known keys only, no values in errors. `json_schema` reads the attributes' docstrings."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        populate_by_name=False,
        hide_input_in_errors=True,
        # every command loads an inventory: build the validator of the whole, not one of each part as well
        defer_build=True,
    )


class SecretDocument(Document):
    """A reference to a secret: `{env: NAME}`, `{file: PATH, key: NAME}` or `{age: PATH, key: NAME, identity: PATH}`."""

    env: Text = Field(default="", pattern="^([A-Za-z_][A-Za-z0-9_]*)?$")
    """Environment variable with the secret."""
    file: Text = ""
    """File with the secret, outside the repository; relative to this file."""
    age: Text = ""
    """File encrypted with age; relative to this file."""
    key: Text = ""
    """Entry of the file, if it is a YAML mapping. Default: the whole file is the secret."""
    identity: Text = ""
    """File with the age or SSH identity for decryption. Default: $MESHCTL_AGE_IDENTITY."""

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if sum(map(bool, (self.env, self.file, self.age))) != 1:
            raise expected_error("exactly one of env, file and age, not empty")
        if self.env and (self.key or self.identity):
            raise expected_error("no key and identity with env")
        if self.file and self.identity:
            raise expected_error("no identity with file: only age files have one")
        return self
