"""UCI, OpenWrt's configuration format: text -> tree -> text, and diffs of trees."""

from meshctl.uci.difference import (
    ChangeKind,
    Diff,
    OptionChange,
    SectionChange,
    apply,
    diff,
    is_secret,
    is_secret_option,
    masked_changes,
)
from meshctl.uci.parser import parse, parse_export
from meshctl.uci.text import dump, quote
from meshctl.uci.tree import Package, Section, Value

__all__ = [
    "ChangeKind",
    "Diff",
    "OptionChange",
    "Package",
    "Section",
    "SectionChange",
    "Value",
    "apply",
    "diff",
    "dump",
    "is_secret",
    "is_secret_option",
    "masked_changes",
    "parse",
    "parse_export",
    "quote",
]
