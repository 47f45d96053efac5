"""What the kernel refuses to send is told soon, then seldom, and when it is over."""

import errno

from udp_mesh.daemon.send_errors import OVER_S, REVIEW_S, TELL_AGAIN_S, TELL_MORE_S, Refusals

BOB, CAROL = ("10.7.20.2", 8700), ("fe80::3", 8700)


def test_a_refusal_is_told_with_its_reason_and_to_whom() -> None:
    refusals = Refusals()
    assert not refusals
    refusals.add("mesh0", {(BOB, errno.EPERM): 3}, 10.0)
    refusals.add("mesh0", {(BOB, errno.EPERM): 2, (CAROL, errno.EPERM): 1}, 10.5)
    assert refusals.standing() == ()
    (told,), over = refusals.review(10.0 + REVIEW_S)
    assert (told.link, told.to, told.datagrams) == ("mesh0", "10.7.20.2:8700,[fe80::3]:8700", 6)
    assert told.reason == "Operation not permitted"
    assert over == []
    assert refusals.standing() == (told,)


def test_one_that_goes_on_is_told_once_a_minute() -> None:
    refusals = Refusals()
    told_at = []
    for second in range(300):
        refusals.add("mesh0", {(BOB, errno.EPERM): 50}, float(second))
        going_on, over = refusals.review(second + 0.5)
        assert over == []
        told_at += [second] * len(going_on)
    assert told_at == list(range(0, 300, int(TELL_AGAIN_S)))


def test_one_that_comes_to_concern_more_peers_is_told_again_soon() -> None:
    refusals = Refusals()
    refusals.add("mesh0", {(BOB, errno.EPERM): 1}, 0.0)
    refusals.review(REVIEW_S)
    refusals.add("mesh0", {(BOB, errno.EPERM): 1, (CAROL, errno.EPERM): 1}, 2.0)
    assert refusals.review(2.0) == ([], [])
    ((told,), _) = refusals.review(REVIEW_S + TELL_MORE_S)
    assert told.to == "10.7.20.2:8700,[fe80::3]:8700"
    refusals.add("mesh0", {(BOB, errno.EPERM): 1, (CAROL, errno.EPERM): 1}, 10.0)
    assert refusals.review(2 * (REVIEW_S + TELL_MORE_S)) == ([], [])


def test_each_link_and_reason_is_told_apart_and_ends_for_itself() -> None:
    refusals = Refusals()
    refusals.add("mesh0", {(BOB, errno.EPERM): 1, (BOB, errno.EMSGSIZE): 1}, 0.0)
    refusals.add("mesh1", {(BOB, errno.EPERM): 1}, 0.0)
    going_on, _ = refusals.review(REVIEW_S)
    assert {(one.link, one.reason) for one in going_on} == {
        ("mesh0", "Operation not permitted"),
        ("mesh0", "Message too long"),
        ("mesh1", "Operation not permitted"),
    }
    refusals.add("mesh1", {(BOB, errno.EPERM): 1}, OVER_S)
    _, over = refusals.review(OVER_S + REVIEW_S)
    assert [one.link for one in over] == ["mesh0", "mesh0"]
    assert [one.link for one in refusals.standing()] == ["mesh1"]


def test_what_a_link_refused_in_the_moment_it_went_down_is_not_told() -> None:
    refusals = Refusals()
    refusals.add("mesh0", {(BOB, errno.ENETDOWN): 9}, 0.0)
    refusals.link_gone("mesh0")
    assert refusals.review(REVIEW_S) == ([], [])
    assert not refusals


def test_a_crowd_of_destinations_is_counted_and_few_are_named() -> None:
    refusals = Refusals()
    refusals.add("mesh0", {((f"10.7.{n // 250}.{n % 250}", 8700), errno.EPERM): 1 for n in range(1000)}, 0.0)
    (told,), _ = refusals.review(REVIEW_S)
    assert told.datagrams == 1000
    assert told.to.endswith("-more")
    assert len(told.destinations) < 100
