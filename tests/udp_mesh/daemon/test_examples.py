"""The examples of the README and the guide work as printed."""

import asyncio
import contextlib
import functools
import os
import re
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

import udp_mesh
from tests.udp_mesh.daemon.processes import poll
from tests.udp_mesh.links.sockets import WAIT_S, free_port
from udp_mesh import Key, LinkConfig, Neighbour, Node, Rates, Settings
from udp_mesh.client import MeshClient, MeshError

PAGES = Path(udp_mesh.__file__).parents[1]
KEY = Key(bytes(range(32)))


def example(page: str, wanted: str) -> str:
    """The block of code that has the wanted line."""
    text = (PAGES / page).read_text()
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    blocks += [textwrap.dedent(block) for block in re.findall(r"(?:^    .*\n|^\n(?=    ))+", text, re.MULTILINE)]
    return str(next(block for block in blocks if wanted in block))


@pytest.mark.parametrize(
    ("page", "wanted"), [("README.md", "async with Node"), ("docs/udp-mesh.md", "async with Node")]
)
def test_the_library_example_reaches_a_base_started_later(page: str, wanted: str) -> None:
    port = free_port()

    def settings(name: str, **fields: Any) -> Settings:
        """On this test's port, with quick heartbeats, on two addresses that name each other."""
        other = Neighbour(("127.0.6.1" if name == "base" else "127.0.6.2", port))
        return Settings(
            name, port=port, neighbours=(other,), rates=Rates(heartbeat_s=0.2, heartbeat_sparse_s=0.2), **fields
        )

    imported, _, body = example(page, wanted).strip().partition("\n")
    names: dict[str, Any] = {}
    exec(imported, names)
    names |= {
        "Settings": settings,
        "Node": functools.partial(Node, links=(LinkConfig(address="127.0.6.1", broadcast=False),)),
        "text": KEY.secret.hex(),
    }
    exec(f"async def shown():\n{textwrap.indent(body, '    ')}", names)
    shown: Callable[[], Coroutine[Any, Any, None]] = names["shown"]

    async def main() -> None:
        base = settings("base", keys=(KEY,))
        async with asyncio.timeout(WAIT_S):
            task = asyncio.create_task(shown())
            async with Node(base, links=(LinkConfig(address="127.0.6.2", broadcast=False),)) as node:
                arrived = asyncio.ensure_future(anext(node.messages()))
                # Stop at the first to finish, so that a failing example does not block.
                await asyncio.wait((arrived, task), return_when=asyncio.FIRST_COMPLETED)
                if not arrived.done():
                    await task
                assert (await arrived).payload in (b"stop", b"ready")
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await task

    asyncio.run(main())


def test_the_guide_example_with_two_robots_on_one_machine_works(tmp_path: Path) -> None:
    shown = example("docs/udp-mesh.md", "udp-mesh run robot2.toml")
    # With a port and addresses of this test's own
    shown = shown.replace("127.0.0.", "127.0.7.").replace('key_file = "', f'port = {free_port()}\nkey_file = "')
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    with subprocess.Popen(
        ["sh", "-c", f"{shown}\nwait"], cwd=tmp_path, env=environment, start_new_session=True, stderr=subprocess.PIPE
    ) as shell:
        try:
            poll(lambda: round_trip_s(tmp_path), "robot3 answers robot2")
        finally:
            os.killpg(shell.pid, signal.SIGTERM)
            shell.communicate(timeout=WAIT_S)


def round_trip_s(folder: Path) -> float | None:
    here = Path.cwd()
    os.chdir(folder)
    try:
        with MeshClient("robot2.sock") as mesh:
            return float(mesh.request("ping", peer="robot3")["round_trip_s"])
    except MeshError:
        return None
    finally:
        os.chdir(here)
