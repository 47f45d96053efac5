"""One YAML inventory in, one frozen fleet out, with the place of every value.

The flow: bytes -> text (`source`) -> tree with positions (`compose`) -> one tree of all files (`include`) -> checked
document (`validate`, `documents`) -> layers of every node (`layers`, `ranges`) -> fleet (`build`, `nodes`, `addresses`,
`origins`). Beside it: `secrets` fetches what references name, `json_schema` describes the format to editors, `explain`
tells where a node's values come from, `edit` changes files and keeps their comments, `starter` writes a first one.
"""

from meshctl.inventory.load import Loaded, load, load_fleet

__all__ = ["Loaded", "load", "load_fleet"]
