"""How `udp-mesh` reads its arguments and shows its help."""

from __future__ import annotations

import argparse
import re
import textwrap
from typing import NoReturn


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Does not break paths and examples at hyphens."""

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(" ".join(text.split()), width, break_on_hyphens=False, break_long_words=False)


# as argparse writes it: with quotes around each word up to Python 3.11
_INVALID_CHOICE = re.compile(r"invalid choice: '(.+)' \(choose from (.+)\)")


class CommandParser(argparse.ArgumentParser):
    """Suggests the nearest known word for an unknown one."""

    def error(self, message: str) -> NoReturn:
        if found := _INVALID_CHOICE.search(message):
            from difflib import get_close_matches

            near = get_close_matches(found[1], re.findall(r"[\w-]+", found[2]), n=1)
            message += f"; did you mean '{near[0]}'?" if near else ""
        super().error(message)
