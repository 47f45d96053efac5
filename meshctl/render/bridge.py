"""The ROS bridge's own file: what it reduces of the topics. YAML, written as JSON, which is YAML too."""

from __future__ import annotations

import json
from typing import Any

from meshctl.model import Fleet, Reduction

BRIDGE_CONFIG_NAME = "bridge.yaml"


def bridge_config(fleet: Fleet) -> bytes | None:
    """The file for every robot with a bridge; None if no topic is reduced."""
    topics = {topic.name: _entry(topic.reduce) for topic in fleet.topics if topic.reduce is not None}
    return json.dumps({"topics": topics}, indent=2).encode() + b"\n" if topics else None


def _entry(reduction: Reduction) -> dict[str, Any]:
    """The keys that are set; the bridge has the same names and defaults."""
    entry: dict[str, Any] = {
        "rate_hz": reduction.rate_hz,
        "voxel_m": reduction.voxel_m,
        "max_voxel_m": reduction.max_voxel_m,
        "fields": list(reduction.fields) or None,
        "adapt": reduction.adapt or None,
    }
    if reduction.encode is not None:
        jpeg = reduction.encode
        entry["encode"] = {"quality": jpeg.quality, "min_quality": jpeg.min_quality, "scale": jpeg.scale}
    return {key: value for key, value in entry.items() if value is not None}
