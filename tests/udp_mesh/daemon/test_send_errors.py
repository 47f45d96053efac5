"""Send errors are logged soon after the first, then rarely, and when they stop."""

import errno

from udp_mesh.daemon.send_errors import LOG_AGAIN_S, LOG_NEW_DESTINATIONS_S, RESOLVED_AFTER_S, REVIEW_S, SendErrors

BOB, CAROL = ("10.7.20.2", 8700), ("fe80::3", 8700)


def test_a_send_error_is_logged_with_its_reason_and_destinations() -> None:
    errors = SendErrors()
    assert not errors
    errors.add("mesh0", {(BOB, errno.EPERM): 3}, 10.0)
    errors.add("mesh0", {(BOB, errno.EPERM): 2, (CAROL, errno.EPERM): 1}, 10.5)
    assert errors.active() == ()
    (logged,), resolved = errors.review(10.0 + REVIEW_S)
    assert (logged.link, logged.to, logged.datagrams) == ("mesh0", "10.7.20.2:8700,[fe80::3]:8700", 6)
    assert logged.reason == "Operation not permitted"
    assert resolved == []
    assert errors.active() == (logged,)


def test_an_ongoing_error_is_logged_once_a_minute() -> None:
    errors = SendErrors()
    logged_at = []
    for second in range(300):
        errors.add("mesh0", {(BOB, errno.EPERM): 50}, float(second))
        ongoing, resolved = errors.review(second + 0.5)
        assert resolved == []
        logged_at += [second] * len(ongoing)
    assert logged_at == list(range(0, 300, int(LOG_AGAIN_S)))


def test_an_error_that_affects_more_peers_is_logged_again_soon() -> None:
    errors = SendErrors()
    errors.add("mesh0", {(BOB, errno.EPERM): 1}, 0.0)
    errors.review(REVIEW_S)
    errors.add("mesh0", {(BOB, errno.EPERM): 1, (CAROL, errno.EPERM): 1}, 2.0)
    assert errors.review(2.0) == ([], [])
    ((logged,), _) = errors.review(REVIEW_S + LOG_NEW_DESTINATIONS_S)
    assert logged.to == "10.7.20.2:8700,[fe80::3]:8700"
    errors.add("mesh0", {(BOB, errno.EPERM): 1, (CAROL, errno.EPERM): 1}, 10.0)
    assert errors.review(2 * (REVIEW_S + LOG_NEW_DESTINATIONS_S)) == ([], [])


def test_each_link_and_reason_is_separate_and_is_resolved_separately() -> None:
    errors = SendErrors()
    errors.add("mesh0", {(BOB, errno.EPERM): 1, (BOB, errno.EMSGSIZE): 1}, 0.0)
    errors.add("mesh1", {(BOB, errno.EPERM): 1}, 0.0)
    ongoing, _ = errors.review(REVIEW_S)
    assert {(one.link, one.reason) for one in ongoing} == {
        ("mesh0", "Operation not permitted"),
        ("mesh0", "Message too long"),
        ("mesh1", "Operation not permitted"),
    }
    errors.add("mesh1", {(BOB, errno.EPERM): 1}, RESOLVED_AFTER_S)
    _, resolved = errors.review(RESOLVED_AFTER_S + REVIEW_S)
    assert [one.link for one in resolved] == ["mesh0", "mesh0"]
    assert [one.link for one in errors.active()] == ["mesh1"]


def test_errors_of_a_link_that_goes_down_are_not_logged() -> None:
    errors = SendErrors()
    errors.add("mesh0", {(BOB, errno.ENETDOWN): 9}, 0.0)
    errors.link_closed("mesh0")
    assert errors.review(REVIEW_S) == ([], [])
    assert not errors


def test_many_destinations_are_counted_but_only_a_few_are_listed() -> None:
    errors = SendErrors()
    errors.add("mesh0", {((f"10.7.{n // 250}.{n % 250}", 8700), errno.EPERM): 1 for n in range(1000)}, 0.0)
    (logged,), _ = errors.review(REVIEW_S)
    assert logged.datagrams == 1000
    assert logged.to.endswith("-more")
    assert len(logged.destinations) < 100
