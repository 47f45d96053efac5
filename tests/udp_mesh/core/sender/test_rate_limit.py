"""A topic's rate limit holds over each second, however long the topic was idle before."""

from __future__ import annotations

from udp_mesh.core.sender.rate_limit import BURST_S, TokenBucket


def test_an_idle_topic_saves_up_no_more_than_a_short_burst() -> None:
    bucket, now, sent = TokenBucket(10_000, 0.0), 3600.0, 0
    while now < 3601.0:
        while bucket.has_tokens(now):
            bucket.consume(100)
            sent += 100
        now = max(now + 1e-6, bucket.ready_at())
    assert 9_000 <= sent <= 10_000 * (1.0 + BURST_S) + 200
