"""Each rule's page, from its code: `python -m meshctl.lint.pages docs/lint` writes them, `--explain` prints one.

A page says what the rule finds, why it matters, how to fix it, and shows one inventory that fails and one that passes.
"""

from __future__ import annotations

import sys
from pathlib import Path

from meshctl.lint.catalog import CHAPTERS, RULES, rules_of
from meshctl.lint.example import BASE
from meshctl.lint.rule import Example, Rule


def page(rule: Rule) -> str:
    """The rule's page as Markdown."""
    parts = [
        f"# {rule.code}: {rule.title}",
        f"`{rule.name}`, {_article(rule.severity.value)}.",
        rule.why,
        f"**Mend it:** {rule.fix}",
        "## Fails",
        _example(rule.failing),
        "## Passes",
        _example(rule.passing),
        "Both are laid over the [base inventory](index.md#the-base-inventory) and run as tests.",
    ]
    return "\n\n".join(parts) + "\n"


def _article(severity: str) -> str:
    return f"an {severity}" if severity == "error" else f"a {severity}"


def _example(example: Example) -> str:
    parts = [f"```yaml\n{example.fragment}```"]
    parts += [f"with the file `{name}`:\n\n```\n{text.rstrip()}\n```" for name, text in example.files.items()]
    parts += [f"with `{name}={value}` in the environment" for name, value in example.environment.items()]
    if example.also:
        parts.append(f"(It also gives {', '.join(example.also)}.)")
    return "\n\n".join(parts)


def index() -> str:
    """The page that lists all rules by chapter, with the base inventory of the examples."""
    parts = ["# The rules of `meshctl lint`", f"{len(RULES)} rules. [How to use them](../lint.md)."]
    for title, module in CHAPTERS:
        rows = [
            f"| [{rule.code}]({rule.code}.md) | {rule.severity.value} | {rule.title} |" for rule in rules_of(module)
        ]
        parts.append(f"## {title}")
        parts.append("\n".join(["| code | severity | finds |", "| --- | --- | --- |", *rows]))
    parts.append("## The base inventory")
    parts.append(
        "Every example is laid over this one, which has nothing to report: mappings join key by key, anything else"
        "\nreplaces, `<removed>` takes a key away. An example with a comment stands behind it as it is."
    )
    parts.append(f"```yaml\n{BASE}```")
    return "\n\n".join(parts) + "\n"


def pages() -> dict[str, str]:
    """All files of docs/lint by name."""
    return {"index.md": index(), **{f"{rule.code}.md": page(rule) for rule in RULES}}


def main(directory: Path) -> None:
    """Write all pages into `directory`, and take away pages of rules that are gone."""
    wanted = pages()
    directory.mkdir(parents=True, exist_ok=True)
    for file in directory.glob("*.md"):
        if file.name not in wanted:
            file.unlink()
    for name, text in wanted.items():
        (directory / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
