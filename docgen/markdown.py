"""`Command`, the inventory's schema, the daemon's settings and metrics -> Markdown pages of the reference."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from enum import Enum
from typing import Any

from docgen.commands import Command, Option


def command_page(program: Command) -> str:
    """Every command of a program, with a heading each."""
    parts = [f"# {program.name}", *map(_prose, program.description)]
    parts.append(f"Generated from the program; `{program.name} COMMAND --help` and `man {program.name}` show the same.")
    rows = [
        f"| [`{each.name}`](#{_anchor(each.name)}) | {_cell(each.summary.rstrip('.'))} |" for each in _leaves(program)
    ]
    parts.append("\n".join(["| command | does |", "| --- | --- |", *rows]))
    if program.options:
        parts += [_options(program.options)]
    parts += [*map(_prose, program.notes), *_examples(program.examples)]
    for command in _leaves(program):
        # an explicit anchor keeps links stable whatever the heading's own slug is
        parts.append(f"## `{command.name}` {{ #{_anchor(command.name)} }}")
        parts += map(_prose, command.description)
        parts.append(f"```\n{command.usage}\n```")
        if command.arguments or command.options:
            parts.append(_options((*command.arguments, *command.options)))
        parts += [*_examples(command.examples), *map(_prose, command.notes)]
    return "\n\n".join(parts) + "\n"


def _leaves(program: Command) -> list[Command]:
    return [command for command in program.walk() if not command.commands]


def _anchor(name: str) -> str:
    return name.replace(" ", "-")


def _options(options: Sequence[Option]) -> str:
    rows = []
    for option in options:
        more = [f"Default: `{option.default}`."] if option.default else []
        more += [f"Environment: `{option.variable}`."] if option.variable else []
        first = option.synopsis.replace("|", r"\|")
        rows.append(f"| `{first}` | {_cell(' '.join([option.help, *more]))} |")
    return "\n".join(["| argument or option | meaning |", "| --- | --- |", *rows])


def _examples(examples: Iterable[str]) -> list[str]:
    lines = "\n".join(examples)
    return [f"```sh\n{lines}\n```"] if lines else []


def inventory_page(schema: Mapping[str, Any]) -> str:
    """Every key of the inventory, by section, from its JSON Schema."""
    definitions: Mapping[str, Any] = schema["$defs"]
    parts = [
        "# Inventory keys",
        "Generated from the schema that `meshctl schema` prints for editors. [The inventory](inventory.md) explains how"
        "\nlayers, ranges, address rules and secrets work together.",
        "## Top level",
        _keys(schema, definitions),
    ]
    for name, definition in definitions.items():
        if "properties" in definition:
            parts += [f"## {_title(name)} {{ #{name.lower()} }}"]
            parts += [_prose(definition["description"])] if "description" in definition else []
            parts += [_keys(definition, definitions)]
        elif "enum" in definition:
            parts += [f"## {_title(name)} {{ #{name.lower()} }}"]
            parts += [f"One of {', '.join(f'`{value}`' for value in definition['enum'])}."]
    return "\n\n".join(parts) + "\n"


def _title(name: str) -> str:
    """`RadioLayer` -> `Radio`, `NodeState` -> `Node state`."""
    words = re.sub(r"(?<!^)(?=[A-Z])", " ", name.removesuffix("Document")).split()
    return " ".join([words[0], *(word.lower() for word in words[1:])])


def _keys(definition: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    rows = []
    required = definition.get("required", ())
    for key, field in definition["properties"].items():
        notes = ["Required."] if key in required else []
        if field.get("default") not in (None, "", [], {}):
            notes.append(f"Default: `{_json(field['default'])}`.")
        meaning = _cell(" ".join([field.get("description", ""), *notes]))
        rows.append(f"| `{key}` | {_type(field, definitions)} | {meaning} |")
    return "\n".join(["| key | value | meaning |", "| --- | --- | --- |", *rows])


def _json(value: object) -> str:
    return {True: "true", False: "false"}.get(value, str(value)) if isinstance(value, bool) else str(value)


def _type(field: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    if "$ref" in field:
        name = field["$ref"].rsplit("/", 1)[1]
        return f"[{_title(name).lower()}](#{name.lower()})" if name in definitions else name
    if "anyOf" in field:
        kinds = dict.fromkeys(_type(each, definitions) for each in field["anyOf"] if each.get("type") != "null")
        return " or ".join(kinds)
    if "enum" in field:
        # releases may also be written as numbers; the text stands for both
        return ", ".join(f"`{value}`" for value in field["enum"] if isinstance(value, str | bool))
    if "const" in field:
        return f"`{field['const']}`"
    match field.get("type"):
        case "array":
            return f"list of {_type(field.get('items', {}), definitions)}"
        case "object":
            inner = field.get("additionalProperties")
            if isinstance(inner, Mapping):
                return f"mapping to {_type(inner, definitions)}"
            return "{" + ", ".join(f"`{key}`" for key in field.get("properties", {})) + "}"
        case [kind, *_]:
            # the type, then those as which YAML reads it without quotes
            return str(kind)
        case kind:
            return str(kind or "any value")


def daemon_page() -> str:
    """Every key of udp-mesh.toml, from the dataclasses that the file is read into."""
    from udp_mesh.core import settings
    from udp_mesh.daemon.configuration import DaemonSettings

    tables: tuple[tuple[str, type, tuple[str, ...]], ...] = (
        # the rest of a node's settings has a table of its own or comes from `key_file`
        ("Top level", settings.Settings, ("keys", "topics", "undeclared", "neighbours", "rates", "limits")),
        ("`[topics.NAME]` and `[undeclared]`", settings.Topic, ("name",)),
        ("`[[neighbours]]`", settings.Neighbour, ()),
        ("`[rates]`", settings.Rates, ()),
        ("`[limits]`", settings.Limits, ()),
        ("`[daemon]`", DaemonSettings, ()),
    )
    parts = [
        "# Daemon configuration",
        "Every key of `udp-mesh.toml` with its type and default, generated from the program."
        "\n[The transport](udp-mesh.md) explains them with examples, `key_file` and `[[links]]`"
        "\nincluded; `udp-mesh check --json` prints all values in force.",
    ]
    for title, table, left_out in tables:
        parts += [f"## {title}", _prose(inspect.getdoc(table) or "")]
        meanings = _field_docstrings(table)
        rows = [
            f"| `{field.name}` | {_toml_type(str(field.type))} | {_toml_default(field)} "
            f"| {_cell(meanings.get(field.name, ''))} |"
            for field in dataclasses.fields(table)
            if field.name not in left_out
        ]
        lines = ["| key | type | default | meaning |", "| --- | --- | --- | --- |", *rows]
        parts.append("\n".join(lines if meanings else [line.rsplit(" |", 2)[0] + " |" for line in lines]))
    return "\n\n".join(parts) + "\n"


def _field_docstrings(table: type) -> dict[str, str]:
    """The docstrings below a dataclass's fields."""
    (body,) = ast.parse(inspect.getsource(table)).body
    assert isinstance(body, ast.ClassDef)
    found = {}
    for node, following in itertools.pairwise(body.body):
        if isinstance(node, ast.AnnAssign) and isinstance(following, ast.Expr) and isinstance(node.target, ast.Name):
            found[node.target.id] = str(ast.literal_eval(following.value))
    return found


def _toml_type(annotation: str) -> str:
    name = re.sub(r"<class '(.*)'>", r"\1", annotation).removesuffix(" | None").rsplit(".", 1)[-1]
    names = {"str": "string", "int": "integer", "float": "number", "bool": "boolean", "Path": "path"}
    return names.get(name, "list of strings" if "tuple[str, ..." in annotation else "string")


def _toml_default(field: dataclasses.Field[Any]) -> str:
    default = field.default
    if default is dataclasses.MISSING:
        return "required"
    if default is None:
        return "not set"
    if field.name == "socket_mode":
        return f'`"{default:04o}"`'
    value = default.value if isinstance(default, Enum) else default
    match value:
        case bool():
            return f"`{str(value).lower()}`"
        case int() | float():
            return f"`{value}`"
        case tuple():
            return f"`{list(value)}`"
        case _:
            return f'`"{value}"`'


def _prose(text: str) -> str:
    return "\n".join(line.strip() for line in text.strip().splitlines())


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", r"\|")
