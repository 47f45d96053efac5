"""Documentation pages, generated from the rules: `python -m meshctl.lint.pages docs/lint`; `--explain` prints one.

A page says what the rule finds, why it matters and how to fix it, with an example that fails and one that passes.
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
        f"**Fix:** {rule.fix}",
        "## Fails",
        _example(rule.failing),
        "## Passes",
        _example(rule.passing),
        "Both examples are merged into the [base inventory](index.md#the-base-inventory) and run as tests.",
    ]
    return "\n\n".join(parts) + "\n"


def _article(severity: str) -> str:
    return f"an {severity}" if severity == "error" else f"a {severity}"


def _example(example: Example) -> str:
    parts = [f"```yaml\n{example.fragment}```"]
    parts += [f"with the file `{name}`:\n\n```\n{text.rstrip()}\n```" for name, text in example.files.items()]
    parts += [f"with `{name}={value}` in the environment" for name, value in example.environment.items()]
    if example.also:
        parts.append(f"(Also reports {', '.join(example.also)}.)")
    return "\n\n".join(parts)


def index() -> str:
    """The list of all rules by chapter, with the base inventory of the examples."""
    parts = ["# Rules of `meshctl lint`", f"{len(RULES)} rules. See [linting an inventory](../lint.md) for usage."]
    for title, module in CHAPTERS:
        rows = [
            f"| [{rule.code}]({rule.code}.md) | {rule.severity.value} | {rule.title} |" for rule in rules_of(module)
        ]
        parts.append(f"## {title}")
        parts.append("\n".join(["| code | severity | finds |", "| --- | --- | --- |", *rows]))
    parts.append("## The base inventory")
    parts.append(
        "Every example is merged into this inventory, which has no findings: mappings merge key by key, other values"
        "\nreplace, and `<removed>` removes a key. An example with a comment is appended unchanged."
    )
    parts.append(f"```yaml\n{BASE}```")
    return "\n\n".join(parts) + "\n"


def pages() -> dict[str, str]:
    """All files of docs/lint by name."""
    return {"index.md": index(), **{f"{rule.code}.md": page(rule) for rule in RULES}}


def main(directory: Path) -> None:
    """Write all pages into `directory`, and delete pages of removed rules."""
    wanted = pages()
    directory.mkdir(parents=True, exist_ok=True)
    for file in directory.glob("*.md"):
        if file.name not in wanted:
            file.unlink()
    for name, text in wanted.items():
        (directory / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
