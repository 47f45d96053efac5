"""UCI, OpenWrt's configuration format: text -> tree -> text, and the difference of two trees."""

from meshctl.uci.parser import parse, parse_export
from meshctl.uci.text import dump, quote
from meshctl.uci.tree import Package, Section, Value

__all__ = ["Package", "Section", "Value", "dump", "parse", "parse_export", "quote"]
