"""`meshctl inventory import netbox`, with the real pynetbox, against a recorded API on loopback."""

from __future__ import annotations

import json
import shutil
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from typer.testing import CliRunner, Result

from meshctl.cli.main import build
from meshctl.cli.netbox_client import fetch
from meshctl.errors import Unreachable
from meshctl.interchange.netbox import STATES, rows
from meshctl.inventory import load_fleet
from meshctl.resources import shipped

RECORDED = Path(__file__).parent / "recorded_netbox_api"
TOKEN = "0123456789abcdef0123456789abcdef01234567"


class RecordedApi(BaseHTTPRequestHandler):
    """Serves the recorded records page by page, as NetBox does, to those who have the token."""

    def do_GET(self) -> None:
        url = urlsplit(self.path)
        query = parse_qs(url.query)
        self.server.requests.append(self.path)  # type: ignore[attr-defined]
        if self.headers.get("Authorization") != f"Token {TOKEN}":
            return self._answer(403, {"detail": "Invalid token"})
        file = RECORDED / f"{url.path.removeprefix('/api/').strip('/').replace('/', '_')}.json"
        if url.path.rstrip("/") == "/api":
            return self._answer(200, {})
        if not file.exists():
            return self._answer(404, {"detail": "Not found."})
        found = json.loads(file.read_text())
        for key, field in (("site", "site"), ("device_id", "device")):
            wanted = set(query.get(key, ()))
            if wanted:
                found = [each for each in found if {str(each[field]["id"]), each[field].get("slug")} & wanted]
        # two a page
        start = int(query.get("offset", ["0"])[0])
        parameters = "&".join(f"{key}={value}" for key, values in query.items() for value in values if key != "offset")
        after = f"http://{self.headers['Host']}{url.path}?{parameters}&offset={start + 2}"
        more = after if start + 2 < len(found) else None
        return self._answer(
            200, {"count": len(found), "next": more, "previous": None, "results": found[start : start + 2]}
        )

    def _answer(self, status: int, body: object) -> None:
        content = json.dumps(body).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("API-Version", "4.1")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        pass


@contextmanager
def serving(handler: type[BaseHTTPRequestHandler]) -> Iterator[ThreadingHTTPServer]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.05,))
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture(scope="module")
def api() -> Iterator[ThreadingHTTPServer]:
    with serving(RecordedApi) as server:
        server.requests = []  # type: ignore[attr-defined]
        yield server


@pytest.fixture
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("NETBOX_TOKEN", TOKEN)
    return Path(shutil.copytree(shipped("inventory") / "subt-final", tmp_path / "fleet"))


def run(server: ThreadingHTTPServer, fleet: Path, *words: str) -> Result:
    url = f"http://127.0.0.1:{server.server_address[1]}"
    return CliRunner().invoke(build("inventory"), ["inventory", "import", "netbox", url, "-i", str(fleet), *words])


def test_known_nodes_change_and_new_ones_are_added_on_request(api: ThreadingHTTPServer, fleet: Path) -> None:
    refused = run(api, fleet)
    assert refused.exit_code == 2
    assert "/dcim/devices:12" in refused.output
    assert "give --add to add new nodes" in refused.output
    before = load_fleet(fleet).nodes["husky1-b01"]
    done = run(api, fleet, "--add")
    assert done.exit_code == 0, done.output
    after = load_fleet(fleet)
    node = after.nodes["husky1-b01"]
    assert (node.label, node.serial, node.mac) == ("H1A", "SN-0017", "02:00:5e:00:00:01")
    # meshctl tracks the state of its nodes itself
    assert (node.state, node.address, node.hardware) == (before.state, before.address, before.hardware)
    new = after.nodes["roof"]
    assert (new.role.value, new.state.value, new.hardware.name) == ("robot", "spare", "rocket")
    assert (str(new.address.ip), new.mac) == ("10.42.0.77", "02:00:5e:00:00:09")
    assert set(after.nodes) == {*load_fleet(shipped("inventory") / "subt-final").nodes, "roof"}
    again = run(api, fleet, "--add", "--json")
    assert "left out: 1 device without a name in NetBox" in again.stderr
    assert json.loads(again.stdout)["nodes"] == []


def test_a_filter_reaches_the_api(api: ThreadingHTTPServer, fleet: Path) -> None:
    api.requests.clear()  # type: ignore[attr-defined]
    none = run(api, fleet, "--filter", "site=elsewhere", "--json")
    assert none.exit_code == 2, none.output
    assert "no device matches --filter site=elsewhere" in none.output
    assert any("site=elsewhere" in each for each in api.requests)  # type: ignore[attr-defined]
    wrong = run(api, fleet, "--filter", "site")
    assert wrong.exit_code == 2
    assert "expected KEY=VALUE" in wrong.output


def test_a_wrong_token_no_token_no_answer_and_no_pynetbox_have_different_errors(
    api: ThreadingHTTPServer, fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NETBOX_TOKEN", "f" * 40)
    refused = run(api, fleet)
    assert refused.exit_code == 2
    assert "NetBox refused the request" in refused.output
    assert "f" * 40 not in refused.output
    monkeypatch.delenv("NETBOX_TOKEN")
    assert "NETBOX_TOKEN is not set" in run(api, fleet).output
    monkeypatch.setenv("NETBOX_TOKEN", TOKEN)
    words = ["inventory", "import", "netbox", "http://127.0.0.1:1", "-i", str(fleet)]
    silent = CliRunner().invoke(build("inventory"), words)
    assert silent.exit_code == 3, silent.output
    assert "no answer: cannot connect, or the connection broke" in silent.output
    assert "hint: check the address" in silent.output
    monkeypatch.setitem(sys.modules, "pynetbox", None)
    missing = run(api, fleet)
    assert missing.exit_code == 2
    assert "pip install 'meshctl-fleet[netbox]'" in missing.output


HTML = b"<html>Log in to continue</html>"
PAGE = {"count": 3, "next": None, "previous": None}


@pytest.mark.parametrize(
    ("status", "answer", "expected"),
    [
        (401, {"detail": "No credentials."}, ("401 Unauthorized: No credentials.", "check NETBOX_TOKEN")),
        (404, HTML, ("404 Not Found", "without /api")),
        (429, {"detail": "Throttled."}, ("429 Too Many Requests: Throttled.", "try again later")),
        (502, HTML, ("502 Bad Gateway", "the proxy in front of it")),
        (200, HTML, ("the answer is not JSON: is this NetBox?",)),
        (200, b"", ("the answer is not JSON: is this NetBox?",)),
        (200, [1, 2], ("expected a list of devices, found something else: is this NetBox?",)),
        (200, {"version": "4.1"}, ("expected a list of devices, found something else: is this NetBox?",)),
        (200, {**PAGE, "results": [None]}, ("expected a list of devices, found something else: is this NetBox?",)),
        (200, {**PAGE, "results": [{"id": "x"}]}, ("expected devices with a number as their id",)),
        (200, {**PAGE, "results": [{"id": 1}], "next": "/"}, ("more devices than NetBox counted, 3",)),
    ],
)
def test_an_answer_that_is_no_list_of_devices_is_an_error_that_says_what_to_do(
    fleet: Path, status: int, answer: object, expected: tuple[str, ...]
) -> None:
    before = (fleet / "fleet.yaml").read_bytes()

    class Api(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            content = answer if isinstance(answer, bytes) else json.dumps(answer).encode()
            content = content.replace(b'"/"', f'"http://{self.headers["Host"]}/api/dcim/devices/"'.encode())
            self.send_response(status)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:
            pass

    with serving(Api) as server:
        done = run(server, fleet, "--add")
    assert done.exit_code == 2, done.output
    for words in expected:
        assert words in done.output
    assert (fleet / "fleet.yaml").read_bytes() == before


def test_a_server_that_never_answers_is_given_up() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as silent,
        pytest.raises(Unreachable, match="no answer: nothing within"),
    ):
        fetch(f"http://127.0.0.1:{silent.getsockname()[1]}", TOKEN, {}, timeout_s=0.2)


def test_every_status_of_netbox_has_a_state() -> None:
    statuses = {"offline", "active", "planned", "staged", "failed", "inventory", "decommissioning"}
    assert set(STATES) == statuses


def test_a_value_that_the_inventory_does_not_allow_names_the_device() -> None:
    fleet = load_fleet(shipped("inventory") / "subt-final")
    record = {"id": 4, "name": "b 1", "serial": "", "asset_tag": None, "status": None, "primary_ip": None}
    (row,) = rows([record], [], fleet)
    assert (row.line, row.values) == (4, {"node": "b 1"})
