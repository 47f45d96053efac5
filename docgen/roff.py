"""`Command` -> one man page per program, in roff's `man` macros (man(7))."""

from __future__ import annotations

from collections.abc import Iterable

from docgen.commands import Command, Option

_SEE_ALSO = {
    "meshctl": r"\fBudp-mesh\fR(1), \fBssh\fR(1)",
    "udp-mesh": r"\fBmeshctl\fR(1), \fBsystemd\fR(1)",
}


def man_page(program: Command, version: str) -> str:
    """Section 1: every command with its arguments and options."""
    name = program.name
    lines = [
        f'.TH {name.upper()} 1 "" "meshctl-fleet {version}" "User Commands"',
        ".nh",
        ".ad l",
        ".SH NAME",
        f"{_escaped(name)} \\- {_escaped(_bare(program.summary))}",
        ".SH SYNOPSIS",
        f".B {_escaped(name)}",
        r"\fICOMMAND\fR [\fIOPTIONS\fR] ...",
        ".SH DESCRIPTION",
        *_prose(program.description),
    ]
    if program.options:
        lines += [".SH OPTIONS", *_options(program.options)]
    lines.append(".SH COMMANDS")
    for command in program.walk():
        if not command.commands:
            lines += _command(command)
    if program.notes:
        lines += [".SH NOTES", *_prose(program.notes)]
    if program.examples:
        lines += [".SH EXAMPLES", *_examples(program.examples)]
    lines += [".SH SEE ALSO", _SEE_ALSO.get(name, "")]
    return "\n".join(line for line in lines if line) + "\n"


def _command(command: Command) -> list[str]:
    lines = [f".SS {_escaped(command.usage)}", *_prose(command.description)]
    lines += _options((*command.arguments, *command.options))
    for example in command.examples:
        lines += [".PP", f"Example: {_escaped(example)}"]
    if command.notes:
        lines += [".PP", *_prose(command.notes)]
    return lines


def _options(options: Iterable[Option]) -> list[str]:
    lines = []
    for option in options:
        if option.names:
            names = ", ".join(rf"\fB{_escaped(name)}\fR" for name in option.names)
            head = rf"{names} \fI{_escaped(option.metavar)}\fR" if option.metavar else names
        else:
            head = rf"\fI{_escaped(option.metavar)}\fR"
        lines += [".TP", head, _text(option.help or "See the description.")]
        lines += [rf"Default: \fB{_escaped(option.default)}\fR."] if option.default else []
        lines += [rf"Environment: \fB{_escaped(option.variable)}\fR."] if option.variable else []
    return lines


def _prose(paragraphs: Iterable[str]) -> list[str]:
    lines: list[str] = []
    for paragraph in paragraphs:
        lines += [".PP", _text(paragraph)] if lines else [_text(paragraph)]
    return lines


def _examples(examples: Iterable[str]) -> list[str]:
    return [".nf", *(_text(example) for example in examples), ".fi"]


def _text(text: str) -> str:
    """A line of text: a leading dot or quote would make it a request."""
    escaped = _escaped(text)
    return rf"\&{escaped}" if escaped[:1] in (".", "'") else escaped


def _escaped(text: str) -> str:
    return (
        text.replace("\\", r"\e").replace("-", r"\-").replace("'", r"\(aq").replace("`", r"\(ga").replace("~", r"\(ti")
    )


def _bare(summary: str) -> str:
    return summary.rstrip(".")
