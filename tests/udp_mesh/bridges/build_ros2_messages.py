"""Builds a package of messages with the generators of ROS 2's wheels and the C compiler, without colcon and CMake:

    python build_ros2_messages.py PACKAGE_FOLDER OUT

It runs in the Python that has rclpy (`ros2_processes`). `OUT/python` is for PYTHONPATH, `OUT/lib` for LD_LIBRARY_PATH.
Messages may contain those of std_msgs and builtin_interfaces.
"""

from __future__ import annotations

import json
import subprocess
import sys
import sysconfig
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy
from rosidl_adapter.msg import convert_msg_to_idl
from rosidl_generator_c import generate_c as generate_structures
from rosidl_generator_py import generate_py
from rosidl_generator_type_description import generate_type_hash
from rosidl_typesupport_c import generate_c as generate_type_support
from rosidl_typesupport_fastrtps_c import generate_typesupport_fastrtps_c

ROS = Path(sys.prefix)
DEPENDENCIES = ("std_msgs", "builtin_interfaces")
FAST_RTPS = "rosidl_typesupport_fastrtps_c"


class Package:
    def __init__(self, source: Path, out: Path) -> None:
        self.source, self.out, self.name = source, out, source.name
        self.made, self.libraries = out / "python" / source.name, out / "lib"
        self.messages = sorted(path.stem for path in (source / "msg").glob("*.msg"))
        self.libraries.mkdir(parents=True)

    def generate(self) -> None:
        for message in self.messages:
            convert_msg_to_idl(self.source, self.name, Path("msg") / f"{message}.msg", self.out / "idl" / "msg")
        generate_type_hash(self._arguments("rosidl_generator_type_description"))
        generate_structures(self._arguments("rosidl_generator_c"))
        generate_typesupport_fastrtps_c(self._arguments(FAST_RTPS))
        generate_type_support(self._arguments("rosidl_typesupport_c"), [FAST_RTPS])
        generate_py(self._arguments("rosidl_generator_py"), ["rosidl_typesupport_c"])
        for generator in ("rosidl_generator_c", FAST_RTPS):
            (template,) = (ROS / "share" / generator / "resource").glob("*.h.in")
            text = template.read_text().replace("@PROJECT_NAME@", self.name)
            text = text.replace("@PROJECT_NAME_UPPER@", self.name.upper())
            (self.made / "msg" / template.stem).write_text(text)
        (self.made / "__init__.py").touch()

    def _arguments(self, generator: str) -> str:
        """The file of a generator's arguments, as rosidl's CMake writes it."""
        installed = [f"{package}:{ROS / 'share' / package}" for package in DEPENDENCIES]
        file = self.out / f"{generator}.json"
        arguments = {
            "package_name": self.name,
            "output_dir": str(self.made),
            "template_dir": str(ROS / "share" / generator / "resource"),
            "idl_tuples": [f"{self.out / 'idl'}:msg/{message}.idl" for message in self.messages],
            "include_paths": installed,
            "ros_interface_dependencies": installed,
            "target_dependencies": [],
            "type_description_tuples": [
                f"msg/{message}.idl:{self.made / 'msg' / message}.json" for message in self.messages
            ],
        }
        file.write_text(json.dumps(arguments))
        return str(file)

    def compile(self) -> None:
        messages, details = self.made / "msg", self.made / "msg" / "detail"
        runtime = ["rosidl_runtime_c", "rcutils"]
        self._link(self._library("rosidl_generator_c"), details.glob("*.c"), runtime, "rosidl_generator_c")
        fast = ["rosidl_typesupport_fastrtps_cpp", FAST_RTPS, "fastcdr", *runtime]
        own = [f"{self.name}__rosidl_generator_c"]
        self._link(self._library(FAST_RTPS), details.glob("*.cpp"), [*own, *fast], FAST_RTPS, "rosidl_generator_c")
        own += [f"{self.name}__{FAST_RTPS}"]
        supports = [*own, "rosidl_typesupport_c", "rosidl_runtime_c"]
        self._link(self._library("rosidl_typesupport_c"), messages.glob("*.cpp"), supports, "rosidl_typesupport_c")
        converters = self._library("rosidl_generator_py")
        self._link(converters, messages.glob("_*.c"), own, "rosidl_generator_py", "rosidl_generator_c")
        own += [f"{self.name}__rosidl_typesupport_c", f"{self.name}__rosidl_generator_py"]
        module = f"{self.name}_s__rosidl_typesupport_c{sysconfig.get_config_var('EXT_SUFFIX')}"
        self._link(self.made / module, [self.made / f"_{self.name}_s.ep.rosidl_typesupport_c.c"], own)

    def _library(self, kind: str) -> Path:
        return self.libraries / f"lib{self.name}__{kind}.so"

    def _link(self, to: Path, sources: Iterable[Path], libraries: Sequence[str], *of_dependencies: str) -> None:
        """Compiles to a shared library; `of_dependencies` are kinds of the messages' dependencies' libraries."""
        includes = [
            self.out / "python",
            ROS / "include",
            *(each for each in (ROS / "include").iterdir() if each.is_dir()),
        ]
        folders = [self.libraries, ROS / "lib"]
        linked = [*libraries, *(f"{package}__{kind}" for kind in of_dependencies for package in DEPENDENCIES)]
        done = subprocess.run(
            [
                *("c++", "-shared", "-fPIC", "-w", "-fpermissive", "-o", str(to)),
                *(f"-I{each}" for each in (*includes, sysconfig.get_paths()["include"], numpy.get_include())),
                *(word for path in sources for word in ("-x", "c" if path.suffix == ".c" else "c++", str(path))),
                *("-x", "none"),
                *(word for folder in folders for word in (f"-L{folder}", f"-Wl,-rpath,{folder}")),
                *(f"-l{library}" for library in linked),
            ],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise SystemExit(f"{to.name}: {done.stderr}")


def main() -> None:
    package = Package(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve())
    package.generate()
    package.compile()


if __name__ == "__main__":
    main()
