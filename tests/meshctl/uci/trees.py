"""Arbitrary UCI trees for property tests."""

from __future__ import annotations

from hypothesis import strategies as st

from meshctl.uci import Package, Section, Value

_names = st.text("abcxyz019_", min_size=1, max_size=6)
_types = st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=1, max_size=6)
_letters = st.one_of(
    st.sampled_from(" \t\n\r'\"\\#;\v$`"), st.characters(exclude_characters="\0", exclude_categories=["Cs"])
)
values = st.text(_letters, max_size=8)
_options: st.SearchStrategy[dict[str, Value]] = st.dictionaries(
    _names, st.one_of(values.filter(bool), st.lists(values, min_size=1, max_size=3).map(tuple)), max_size=4
)


@st.composite
def packages(draw: st.DrawFn, types: st.SearchStrategy[str] = _types) -> Package:
    """A package with named and anonymous sections."""
    names = draw(st.lists(st.one_of(st.none(), _names), max_size=6))
    unique = [name for index, name in enumerate(names) if name is None or name not in names[:index]]
    return Package("network", tuple(Section(draw(types), name, draw(_options)) for name in unique))
