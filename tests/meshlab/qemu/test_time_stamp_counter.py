"""The host's counter is measured exactly, and an emulated kernel gets its frequency."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from meshlab.qemu.qemu import KVM, TCG, Machine
from meshlab.qemu.time_stamp_counter import counter_khz, measured_khz

KHZ = 2_596_000


@dataclass
class BusyHost:
    """A clock that a reading takes 100 ns of; `gaps_ns` is how long the first readings are interrupted."""

    gaps_ns: list[int]
    now_ns: int = 0

    def clock_ns(self) -> int:
        self.now_ns += 50
        return self.now_ns

    def counter(self) -> int:
        count = self.now_ns * KHZ // 1_000_000
        self.now_ns += self.gaps_ns.pop(0) if self.gaps_ns else 50
        return count

    def sleep(self, duration_s: float) -> None:
        self.now_ns += round(duration_s * 1e9)


@pytest.mark.parametrize("gaps_ms", [(), (3,), (0, 3), (0, 40, 40), (40, 40, 40)])
def test_an_interrupted_reading_does_not_count(gaps_ms: tuple[int, ...]) -> None:
    host = BusyHost([round(gap * 1e6) + 50 for gap in gaps_ms])
    assert measured_khz(host.counter, host.clock_ns, host.sleep) == pytest.approx(KHZ, rel=1e-4)


def test_an_emulated_kernel_gets_the_frequency_that_it_would_measure_wrongly(tmp_path: Path) -> None:
    machine = Machine(tmp_path, tmp_path / "kernel", tmp_path / "initrd", radios=1, nodes=1)
    words = " ".join(machine._command(TCG, 3)).split()
    (found,) = (int(word.removeprefix("tsc_early_khz=")) for word in words if word.startswith("tsc_early_khz="))
    assert found == pytest.approx(counter_khz(), rel=1e-3)
    assert not any("tsc_early_khz" in word for word in machine._command(KVM, 3))
