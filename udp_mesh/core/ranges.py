"""A set of integers stored as ranges: the finished messages of a peer, in little memory however many there were."""

from bisect import bisect_left, bisect_right


class RangeSet:
    """Integers as disjoint, sorted, inclusive ranges. Adding the successor of the largest number needs no search."""

    __slots__ = ("_firsts", "_lasts")

    def __init__(self) -> None:
        self._firsts: list[int] = []
        self._lasts: list[int] = []

    def __contains__(self, number: int) -> bool:
        place = bisect_right(self._firsts, number) - 1
        return place >= 0 and number <= self._lasts[place]

    def __len__(self) -> int:
        """The number of ranges, which the memory cap limits."""
        return len(self._firsts)

    def add(self, number: int) -> None:
        firsts, lasts = self._firsts, self._lasts
        if lasts and number == lasts[-1] + 1:
            lasts[-1] = number
            return
        place = bisect_right(firsts, number)
        if place and number <= lasts[place - 1]:
            return
        joins_left = place > 0 and lasts[place - 1] == number - 1
        joins_right = place < len(firsts) and firsts[place] == number + 1
        if joins_left and joins_right:
            lasts[place - 1] = lasts[place]
            del firsts[place], lasts[place]
        elif joins_left:
            lasts[place - 1] = number
        elif joins_right:
            firsts[place] = number
        else:
            firsts.insert(place, number)
            lasts.insert(place, number)

    def add_range(self, first: int, last: int) -> None:
        """Add every number from `first` to `last`."""
        if last < first:
            return
        firsts, lasts = self._firsts, self._lasts
        begin = bisect_right(firsts, first) - 1
        if begin < 0 or lasts[begin] < first - 1:
            begin += 1
        end = bisect_right(firsts, last + 1)
        if begin < end:
            first, last = min(first, firsts[begin]), max(last, lasts[end - 1])
        firsts[begin:end] = [first]
        lasts[begin:end] = [last]

    def remove(self, number: int) -> None:
        """Take a number out, if it is contained."""
        firsts, lasts = self._firsts, self._lasts
        place = bisect_right(firsts, number) - 1
        if place < 0 or number > lasts[place]:
            return
        first, last = firsts[place], lasts[place]
        kept = [(begin, end) for begin, end in ((first, number - 1), (number + 1, last)) if begin <= end]
        firsts[place : place + 1] = [begin for begin, _ in kept]
        lasts[place : place + 1] = [end for _, end in kept]

    def remove_range(self, first: int, last: int) -> None:
        """Take every number from `first` to `last` out."""
        firsts, lasts = self._firsts, self._lasts
        begin = bisect_left(lasts, first)
        end = bisect_right(firsts, last)
        if begin >= end:
            return
        kept = [(firsts[begin], first - 1), (last + 1, lasts[end - 1])]
        kept = [(low, high) for low, high in kept if low <= high]
        firsts[begin:end] = [low for low, _ in kept]
        lasts[begin:end] = [high for _, high in kept]

    def gaps(self, first: int, last: int) -> list[tuple[int, int]]:
        """The ranges from `first` to `last` that are not contained, ascending. Looks at no range outside of these."""
        firsts, lasts = self._firsts, self._lasts
        missing: list[tuple[int, int]] = []
        place = bisect_right(firsts, first)
        if place:
            first = max(first, lasts[place - 1] + 1)
        while place < len(firsts) and firsts[place] <= last:
            if firsts[place] > first:
                missing.append((first, firsts[place] - 1))
            first = lasts[place] + 1
            place += 1
        if first <= last:
            missing.append((first, last))
        return missing

    def without(self, other: "RangeSet") -> list[tuple[int, int]]:
        """The ranges of this set's numbers that `other` does not contain, ascending."""
        missing: list[tuple[int, int]] = []
        taken = other.ranges()
        place = 0
        for first, last in self.ranges():
            while place < len(taken) and taken[place][1] < first:
                place += 1
            look = place
            while look < len(taken) and taken[look][0] <= last:
                if taken[look][0] > first:
                    missing.append((first, taken[look][0] - 1))
                first = taken[look][1] + 1
                look += 1
            if first <= last:
                missing.append((first, last))
        return missing

    @property
    def count(self) -> int:
        """How many numbers it contains."""
        return sum(last - first + 1 for first, last in self.ranges())

    def ranges(self) -> list[tuple[int, int]]:
        """(first, last) of each range, ascending."""
        return list(zip(self._firsts, self._lasts, strict=True))

    def fill_lowest_gap(self, apart_from: int | None = None) -> int | None:
        """Join the two lowest ranges: their gap then counts as contained. Numbers from `apart_from` on are not joined
        with lower ones. Returns the last number of the gap."""
        firsts, lasts = self._firsts, self._lasts
        place = int(apart_from is not None and len(firsts) > 1 and lasts[0] < apart_from <= firsts[1])
        if place + 1 >= len(firsts):
            return None
        del lasts[place]
        return firsts.pop(place + 1) - 1
