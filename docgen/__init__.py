"""Reference pages and man pages, generated from the programs' own definitions.

Command line objects, the inventory's JSON Schema and the daemon's settings -> `Command` and tables -> Markdown or roff.
`mkdocs_hooks` adds the pages to the site, `hatch_build.py` adds the man pages to the wheel; nothing generated is
committed. `python -m docgen DIRECTORY` writes all of it for a look.
"""
