"""Worker process that renders an inventory's templates: requests on standard input, answers on standard output.

Requests are pickled by `meshctl.render.sandbox` in the parent process. Answers are JSON, because a process that has
rendered an untrusted template is not trusted.
"""

from __future__ import annotations

import json
import math
import os
import pickle
import resource
import sys
from dataclasses import asdict
from typing import Any

from meshctl.diagnostics import InvalidInput
from meshctl.render.sandbox import LENGTH_BYTES, OUTPUT_BYTES
from meshctl.render.template_set import TemplateSet


def main(cpu_s: int, memory_bytes: int) -> None:
    """Answer requests until end of input. The memory limit is permanent, the CPU limit is per request."""
    resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sets: dict[tuple[object, ...], TemplateSet] = {}
    source, out = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    while head := source.read(LENGTH_BYTES):
        folders, backend, parts, boundary, file, context = pickle.loads(source.read(int.from_bytes(head, "big")))
        used = resource.getrusage(resource.RUSAGE_SELF)
        # the limit is in whole seconds
        limit_s = math.ceil(used.ru_utime + used.ru_stime) + cpu_s
        resource.setrlimit(resource.RLIMIT_CPU, (limit_s, resource.RLIM_INFINITY))
        key = (folders, backend, parts)
        if key not in sets:
            sets[key] = TemplateSet(folders, backend, parts, boundary)
        answer = json.dumps(_answer(sets[key], file, context)).encode()
        out.write(len(answer).to_bytes(LENGTH_BYTES, "big") + answer)
        out.flush()


def _answer(templates: TemplateSet, file: Any, context: Any) -> dict[str, object]:
    try:
        text = templates.text(file, context)
    except InvalidInput as error:
        return {
            "diagnostics": [
                {**asdict(diagnostic), "severity": diagnostic.severity.value} for diagnostic in error.diagnostics
            ]
        }
    if len(text) > OUTPUT_BYTES:
        return {"exceeded": f"the template's output of {len(text)} characters exceeds {OUTPUT_BYTES}"}
    return {"text": text}


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
