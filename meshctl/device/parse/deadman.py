"""`meshctl-deadman`: its `status` line and the one-line answers of its verbs (scripts/deadman.sh)."""

from __future__ import annotations

from dataclasses import dataclass

from meshctl.device.observation import ChangeStatus
from meshctl.uci import masked_changes


@dataclass(frozen=True, slots=True)
class Answer:
    """`ok key=value ...` or `refused CODE text`; anything else is neither, with the text as it came."""

    ok: bool
    values: dict[str, str]
    code: str = ""
    text: str = ""


def parse_answer(stdout: str) -> Answer:
    for line in stdout.splitlines():
        words = line.split()
        if words[:1] == ["ok"]:
            return Answer(True, _values(words[1:]))
        if words[:1] == ["refused"]:
            # the reason may be a list of uncommitted UCI changes
            return Answer(False, {}, words[1] if len(words) > 1 else "", masked_changes(" ".join(words[2:])))
    return Answer(False, {}, "", stdout.strip())


def parse_status(stdout: str) -> ChangeStatus | None:
    """None when the text is not a status line."""
    values = _values(stdout.split())
    if "state" not in values:
        return None
    return ChangeStatus(
        state=values["state"],
        change_id=values.get("id", ""),
        owner=values.get("owner", ""),
        window_s=_integer(values.get("window_s")),
        left_s=_number(values.get("left_s")),
        due_uptime_s=_number(values.get("due_uptime_s")),
        reload_status=_integer(values.get("reload_status")),
        lock_owner=values.get("lock_owner", ""),
        lock_left_s=_number(values.get("lock_left_s")),
        last_id=values.get("last_id", ""),
        last_outcome=values.get("last_outcome", ""),
        last_reason=values.get("last_reason", ""),
        version=values.get("version", ""),
        is_reloading_restored=values.get("restored_reload") == "yes",
    )


def _values(words: list[str]) -> dict[str, str]:
    return dict(word.split("=", 1) for word in words if "=" in word)


def _number(text: str | None) -> float | None:
    try:
        return float(text) if text else None
    except ValueError:
        return None


def _integer(text: str | None) -> int | None:
    number = _number(text)
    return None if number is None or number != number or abs(number) == float("inf") else int(number)
