"""Install the packages a node lacks, from files: it has no internet. Nothing that is in use is cut by it."""

from __future__ import annotations

from pathlib import Path

from meshctl.apply.job import Job
from meshctl.device import openwrt
from meshctl.device.framing import quoted
from meshctl.device.observe import observe
from meshctl.device.ssh import SshConnection
from meshctl.device.upload import upload
from meshctl.errors import InputError, NodeError
from meshctl.plan import PackageStep
from meshctl.plan.packages import missing_packages

DIRECTORY = "/tmp/meshctl/packages"


def install(job: Job, connection: SshConnection, step: PackageStep) -> None:
    """Bring the step's files there, install them, and see that nothing is missing. Raises NodeError, InputError."""
    files = [_local(job, file) for file in step.files]
    tool = job.before.package_tool
    if tool is None:
        raise NodeError(f"{job.name}: it did not tell whether it has opkg or apk")
    with job.step("packages"):
        there = []
        for file in files:
            path = f"{DIRECTORY}/{file.name}"
            upload(connection, file, path, rate_bytes_per_s=job.work.rate_bytes_per_s, progress=job.progress)
            there.append(path)
        if step.remove:
            verb = ("opkg", "remove") if tool == "opkg" else ("apk", "del")
            connection.run(quoted(*verb, *step.remove)).check(f"{job.name}: remove {', '.join(step.remove)}")
        openwrt.install_packages(connection, there, tool=tool)
        connection.run(f"rm -rf {quoted(DIRECTORY)}")
        lacking = missing_packages(job.wanted.needs, observe(connection))
        if lacking:
            raise NodeError(f"{job.name}: after installing it still lacks {', '.join(group[0] for group in lacking)}")


def _local(job: Job, file: str) -> Path:
    """A package file's path here; relative ones stand beside the inventory."""
    path = Path(file).expanduser()
    path = path if path.is_absolute() else Path(job.work.fleet.base) / path
    if not path.is_file():
        raise InputError(f"{path}: package file not found", hint="correct package_files in the hardware profile")
    return path
