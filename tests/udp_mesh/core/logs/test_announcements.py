"""When changes are announced, and to whom."""

from __future__ import annotations

from udp_mesh.core.events import MessageId
from udp_mesh.core.logs.announcements import CARRIED_S, COMPLETE_INTERVAL_S, GATHER_S, INTERVAL_S, Announcements
from udp_mesh.core.logs.item import LogKey
from udp_mesh.core.logs.knowledge import PeerView
from udp_mesh.core.logs.messages import Have, HaveEntry, decode_control

KEY = LogKey("artifact", "spot", bytes(32))


class Announcer:
    """Announces to `reader`, who can act on news at once, and to `carrier`."""

    def __init__(self) -> None:
        self.sent: list[tuple[float, str, bool]] = []
        self.announcements = Announcements(
            self.send, lambda log, _: HaveEntry(log, ((1, 1),)), lambda _, peer: peer == "reader", 0.0
        )
        self.peers = {"reader": PeerView(), "carrier": PeerView()}
        self.run(0.0)
        for message in (1, 2):
            self.announcements.ended(MessageId(message))
        self.sent.clear()

    def send(self, topic: str, payload: bytes, peer: str | None, now: float) -> MessageId:
        message = decode_control(payload)
        assert isinstance(message, Have)
        assert peer is not None
        self.sent.append((round(now, 3), peer, message.complete))
        return MessageId(len(self.sent))

    def run(self, until_s: float) -> None:
        while self.announcements.next_at <= until_s:
            self.announcements.run([KEY], self.peers, self.announcements.next_at)
        self.announcements.run([KEY], self.peers, until_s)


def test_news_is_announced_soon_to_those_who_can_act_on_it_and_later_to_others() -> None:
    team = Announcer()
    team.announcements.note(KEY, 10.0)
    team.run(20.0)
    assert team.sent == [(10.0 + GATHER_S, "reader", False), (10.0 + CARRIED_S, "carrier", False)]


def test_the_next_announcement_waits_for_the_outcome_of_the_one_before() -> None:
    team = Announcer()
    for step in range(20):
        team.announcements.note(KEY, 10.0 + step)
        team.run(10.5 + step)
    assert [peer for _, peer, _ in team.sent] == ["reader", "carrier"]
    assert team.announcements.ended(MessageId(1))
    assert not team.announcements.ended(MessageId(1))
    team.run(30.0)
    assert [peer for _, peer, _ in team.sent] == ["reader", "carrier", "reader"]


def test_a_burst_of_news_shares_announcements() -> None:
    team = Announcer()
    for step in range(100):
        team.announcements.note(KEY, 10.0 + step / 100)
        team.run(10.0 + step / 100)
        for message in range(1, len(team.sent) + 1):
            team.announcements.ended(MessageId(message))
    team.run(15.0)
    assert len(team.sent) <= 2 + 1 / INTERVAL_S + 1


def test_everything_is_repeated_once_a_minute() -> None:
    team = Announcer()
    team.run(COMPLETE_INTERVAL_S + 1)
    assert sorted(team.sent) == [(COMPLETE_INTERVAL_S, "carrier", True), (COMPLETE_INTERVAL_S, "reader", True)]
