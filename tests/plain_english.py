"""Words that read as if translated, or as a private metaphor, and stay out of code, messages, help and docs."""

from __future__ import annotations

import re

_EVERYWHERE = (
    r"told|anew|whoever|somebody|nobody|mend(?:s|ed|ing)?|tells? of|cope[sd]? with|take up what|in vain|never heard of"
    r"|towards|whilst|amongst|whence|half-way|such a one|lest|comes? to rest|goes on|as they told"
)
# in code these are also keys, names of functions and parts of sound sentences
_IN_PAGES = (
    r"tells?|of a node that|takes? up|taken up|carr(?:y|ied) out|struck|of its own accord|again and again"
    # British spellings
    r"|neighbours?|behaviours?|colours?|favou?r(?:s|ed|ing)|honours?|cancelled|cancelling|labelled"
    r"|travell(?:ed|ing)|practis(?:e|es|ed|ing)|licence|misspelt|grey|metres?|centres?"
    r"|(?:recogn|organ|optim|initial|serial|synchron|normal|minim|maxim|real)is(?:e|es|ed|ing|ation)"
)
# words of the command line and of the lab's protocol, and names of lint rules
_ALLOWED = re.compile(
    r"lab mend\b|`mend`|^mend$|([a-z]+-)+nobody|nobody(-[a-z]+)+|as nobody|^(nobody can log in|carried by nobody)$"
)
_WORDS = re.compile(rf"\b(?:{_EVERYWHERE})\b", re.I)
_PAGE_WORDS = re.compile(rf"\b(?:{_EVERYWHERE}|{_IN_PAGES})\b", re.I)
# fenced and indented code, code spans, and anchors made of command names
_CODE_OR_ANCHOR = re.compile(r"```.*?```|^ {4}.*?$|`[^`]*`|\(#[\w-]+\)|\{ #[\w-]+ \}", re.MULTILINE | re.DOTALL)


def has_listed_word(text: str) -> bool:
    """Whether a word of the list occurs in it, also where it is allowed."""
    return _WORDS.search(text) is not None


def bad_words(text: str) -> list[str]:
    """The words of the list in a message, docstring, comment or line of a page."""
    # what is allowed contains such a word, and few texts have one
    return [match[0] for match in _WORDS.finditer(_ALLOWED.sub("", text))] if has_listed_word(text) else []


def bad_page_words(page: str) -> list[str]:
    """The words of the longer list in the prose of a Markdown page."""
    return [match[0] for match in _PAGE_WORDS.finditer(_CODE_OR_ANCHOR.sub("", page))]
