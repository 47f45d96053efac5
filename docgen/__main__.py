"""`python -m docgen DIRECTORY`: write the generated pages and man pages there."""

from __future__ import annotations

import argparse
from pathlib import Path

from docgen.pages import man_pages, pages


def main(directory: Path) -> None:
    directory.mkdir(parents=True, exist_ok=True)
    for name, text in {**pages(), **man_pages()}.items():
        (directory / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m docgen", description=__doc__)
    parser.add_argument("directory", type=Path)
    main(parser.parse_args().directory)
