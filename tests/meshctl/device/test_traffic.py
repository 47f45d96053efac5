"""The bytes of a connection are counted at its socket, in both directions."""

from __future__ import annotations

from pathlib import Path

from meshctl.device.connection import Credentials
from meshctl.device.ssh import connect
from meshctl.device.traffic import TrafficMeter
from meshctl.device.trust import TrustStore
from tests.meshctl.device.sandbox import Sandbox
from tests.meshctl.device.servers import PATIENT, Server, host_key


def test_a_meter_counts_what_commands_and_their_output_cost(server: Server, node: Sandbox, tmp_path: Path) -> None:
    trust = TrustStore(tmp_path / "pins")
    trust.replace("b03", host_key(node))
    ours = Credentials(key_files=(tmp_path / "operator",), use_agent=False)
    meter = TrafficMeter()
    with connect(server.endpoint(), credentials=ours, trust=trust, deadlines=PATIENT, meter=meter) as ssh:
        (device,) = meter.totals()
        assert device == server.endpoint().identity
        login = meter.totals()[device]
        assert 2000 < login < 20_000, "key exchange and login"
        ssh.run("head -c 100000 /dev/zero")
        received = meter.totals()[device] - login
        assert 100_000 < received < 110_000
        ssh.run("cat >/dev/null", stdin=bytes(50_000))
        assert 50_000 < meter.totals()[device] - login - received < 56_000
