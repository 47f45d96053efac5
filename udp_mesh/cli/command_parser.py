"""How `udp-mesh` reads its arguments and shows its help."""

from __future__ import annotations

import argparse
import re
import shlex
import textwrap
from collections.abc import Collection, Sequence
from typing import NoReturn


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Does not break paths and examples at hyphens."""

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(" ".join(text.split()), width, break_on_hyphens=False, break_long_words=False)


# as argparse writes it: with quotes around each word up to Python 3.11
_INVALID_CHOICE = re.compile(r"invalid choice: '(.+)' \(choose from (.+)\)")


class CommandParser(argparse.ArgumentParser):
    """Suggests the nearest known word for an unknown one, and the right order for options before the command."""

    words: Collection[str] = ()
    """The commands, if this is their parser."""

    def refuse_options_first(self, given: Sequence[str]) -> None:
        """End with a usage error if options stand before the command."""
        named = next((place for place, word in enumerate(given) if word in self.words), 0)
        if named and given[0].startswith("-") and given[0] not in ("-h", "--help", "--version"):
            moved = ["udp-mesh", given[named], *given[:named], *given[named + 1 :]]
            self.error(f"options follow the command: {shlex.join(moved)}")

    def error(self, message: str) -> NoReturn:
        if found := _INVALID_CHOICE.search(message):
            from difflib import get_close_matches

            near = get_close_matches(found[1], re.findall(r"[\w-]+", found[2]), n=1)
            message += f"; did you mean '{near[0]}'?" if near else ""
        super().error(message)
