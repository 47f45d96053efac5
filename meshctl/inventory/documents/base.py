"""What all models share, and the one that says where a secret is."""

from __future__ import annotations

from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from meshctl.inventory.fields import Text, wrong

# A key without a default of its own that may be left out; `model_fields_set` tells whether it was written.
NOT_WRITTEN: Any = None


class Document(BaseModel):
    """What all models share: only known keys, attribute docstrings as descriptions, never a value in an error."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        populate_by_name=False,
        use_attribute_docstrings=True,
        hide_input_in_errors=True,
    )


class SecretDocument(Document):
    """Where a secret is: `{env: NAME}`, `{file: PATH, key: NAME}` or `{age: PATH, key: NAME, identity: PATH}`."""

    env: Text = Field(default="", pattern="^([A-Za-z_][A-Za-z0-9_]*)?$")
    """Name of an environment variable that holds the secret."""
    file: Text = ""
    """A file that holds the secret, outside the repository; relative to the file that names it."""
    age: Text = ""
    """A file encrypted with age; relative to the file that names it."""
    key: Text = ""
    """Which entry of the file, when that is a mapping in YAML; without it the secret is the whole file."""
    identity: Text = ""
    """File with the age or SSH identity that decrypts; without it $MESHCTL_AGE_IDENTITY."""

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if sum(map(bool, (self.env, self.file, self.age))) != 1:
            raise wrong("exactly one of env, file and age")
        if self.env and (self.key or self.identity):
            raise wrong("env alone: an environment variable has neither key nor identity")
        if self.file and self.identity:
            raise wrong("no identity: only age files are decrypted with one")
        return self
