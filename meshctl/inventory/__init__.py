"""YAML inventory -> frozen fleet, with the position of every value.

Flow: bytes -> text (`source`) -> tree with positions (`compose`) -> one tree of all files (`include`) -> validated
document (`validate`, `documents`) -> layers of every node (`layers`, `ranges`) -> fleet (`build`, `nodes`, `addresses`,
`provenance`). Also: `secrets` resolves references, `json_schema` generates the schema for editors, `explain` lists the
origin of a node's values, `edit` changes files and keeps their comments, `starter` writes a first inventory.
"""

from meshctl.inventory.load import Loaded, load, load_fleet

__all__ = ["Loaded", "load", "load_fleet"]
