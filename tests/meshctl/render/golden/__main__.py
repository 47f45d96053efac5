"""Rewrite every golden file, and delete files without a case."""

from __future__ import annotations

from tests.meshctl.render.golden import FOLDER, cases, render_case

for old in FOLDER.glob("*.txt"):
    old.unlink()
for name, fleet in cases():
    (FOLDER / f"{name}.txt").write_text(render_case(fleet), encoding="utf-8")
