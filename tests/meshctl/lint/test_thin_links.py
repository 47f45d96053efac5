"""Findings about thin links stand at the entry in question (MC771 to MC777)."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.diagnostics import Diagnostic
from meshctl.lint import Example, check_path
from meshctl.lint.example import environment, write
from meshctl.regdb import SHIPPED, load

_REGDB = load(SHIPPED)
LORA = "lora: {bits_per_s: 5470, band: eu868, frame_bytes: 120, frame_s: 0.0125}"


def _found(fragment: str, directory: Path) -> list[Diagnostic]:
    example = Example(fragment)
    return list(check_path(write(example, directory), _REGDB, environment(example)).diagnostics)


def _thin(found: list[Diagnostic]) -> list[tuple[str, str, str]]:
    return [(item.code, item.path, item.found) for item in found if item.code.startswith("MC77")]


@pytest.mark.parametrize(
    ("fragment", "expected"),
    [
        (
            "robots: {base-station: {thin: {number: 7}}, husky1: {thin: {number: 7}}}",
            [("MC771", "robots.husky1.thin.number", "7")],
        ),
        (
            f"udp_mesh: {{thin_links: {{{LORA}}}}}\n"
            "robots: {husky1: {thin: {number: 2, ports: {lore: /dev/ttyUSB0}}}}\n"
            "topics: {stop: {priority: 0, thin: true, thin_links: [lora, xbee]}}",
            [("MC772", "robots.husky1.thin.ports.lore", "lore"), ("MC772", "topics.stop.thin_links.1", "xbee")],
        ),
        (
            "udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: eu868, duty_cycle: 0.05}}}",
            [("MC773", "udp_mesh.thin_links.lora.duty_cycle", "0.05")],
        ),
        (
            "udp_mesh: {thin_links: {lora: {bits_per_s: 980, band: us915, frame_bytes: 200}}}",
            [],
        ),
        (
            "udp_mesh: {thin_links: {lora: {bits_per_s: 980, band: us915, frame_s: 0.1}}}",
            [("MC774", "udp_mesh.thin_links.lora", "0.48 s at 980 bit/s")],
        ),
        (
            "udp_mesh: {thin_links: {lora: {bits_per_s: 300, band: eu868, frame_bytes: 255}}}",
            [("MC774", "udp_mesh.thin_links.lora", "6.96 s")],
        ),
        (
            f"udp_mesh: {{thin_links: {{{LORA}}}}}\n"
            "topics: {pose: {priority: 8, rate_hz: 1, size_bytes: 40, thin: true}}",
            [("MC775", "udp_mesh.thin_links.lora", "15 %")],
        ),
        (
            "udp_mesh: {thin_links: {x: {framing: xbee-escaped, bits_per_s: 250000, frame_bytes: 101}}}",
            [("MC777", "udp_mesh.thin_links.x.frame_bytes", "101 B")],
        ),
        (
            "udp_mesh: {thin_links: {x: {framing: xbee, bits_per_s: 10000, band: us915, frame_bytes: 255}}}",
            [],
        ),
        (
            "udp_mesh: {thin_links: {x: {framing: xbee, bits_per_s: 250000}, cable: {bits_per_s: 46080}}}",
            [],
        ),
        (
            f"udp_mesh: {{thin_links: {{{LORA}}}}}\n"
            "topics: {atlas: {priority: 8, size_bytes: 9000, thin: true, delta: true}}",
            [("MC776", "topics.atlas.size_bytes", "9000 B"), ("MC776", "topics.atlas.delta", "delta")],
        ),
    ],
)
def test_each_fault_is_reported_at_its_entry(
    fragment: str, expected: list[tuple[str, str, str]], tmp_path: Path
) -> None:
    assert _thin(_found(fragment, tmp_path)) == expected


def test_a_sensible_set_of_topics_has_no_findings(tmp_path: Path) -> None:
    topics = (
        "topics: {estop: {priority: 0, class: emergency_stop, rate_hz: 0.01, size_bytes: 20, thin: true}, "
        "pose: {priority: 8, rate_hz: 1, size_bytes: 40, thin: true, thin_period_s: 60}}"
    )
    assert _thin(_found(f"udp_mesh: {{thin_links: {{{LORA}}}}}\n{topics}", tmp_path)) == []
