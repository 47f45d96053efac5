"""Point clouds of ROS with fewer points and fields, with numpy (extra `media`; python3-numpy)."""

from __future__ import annotations

from typing import Any, Dict, List, Optional, Sequence, Tuple

from udp_mesh.bridges.message_codec import Numbers

try:
    import numpy
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "`voxel_m` and `fields` need numpy: install python3-numpy, or pip install numpy"
    ) from error

_BYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 8: 8}
"""Size of each `datatype` of sensor_msgs/PointField."""
_FLOATS = {7: "f4", 8: "f8"}
_AXES = ("x", "y", "z")


class CloudError(ValueError):
    """This cloud cannot be reduced."""


def reduced_cloud(message: Dict[str, Any], voxel_m: Optional[float], fields: Sequence[str]) -> Dict[str, Any]:
    """A sensor_msgs/PointCloud2 with the first point in each cube of edge `voxel_m`, and only `fields` of each point
    (empty: all). Points without a position (NaN) are left out; the cloud is then no longer ordered in rows. Raises
    CloudError."""
    points = _points(message)
    known = {field["name"]: field for field in message["fields"]}
    missing = [name for name in fields if name not in known]
    if missing:
        text = "expected the fields {}, found {}"
        raise CloudError(text.format(", ".join(fields), ", ".join(sorted(known)) or "none"))
    reduced = dict(message)
    if voxel_m is not None:
        points = points[_first_in_each_voxel(points, known, voxel_m, is_bigendian=bool(message["is_bigendian"]))]
        reduced.update(height=1, width=len(points), is_dense=1)
    if fields:
        points, kept = _only(points, [known[name] for name in fields])
        reduced["fields"] = kept
    step = points.shape[1]
    reduced.update(point_step=step, row_step=step * reduced["width"], data=Numbers("B", points.tobytes()))
    return reduced


def _points(message: Dict[str, Any]) -> Any:
    """One row of bytes per point."""
    height, width, step, row_step = (message[name] for name in ("height", "width", "point_step", "row_step"))
    data = numpy.frombuffer(message["data"].data, numpy.uint8)
    if not step or row_step < width * step or len(data) < height * row_step:
        text = "expected {} rows of {} bytes with {} points of {} bytes, found {} bytes"
        raise CloudError(text.format(height, row_step, width, step, len(data)))
    rows = data[: height * row_step].reshape(height, row_step)[:, : width * step]
    return numpy.ascontiguousarray(rows).reshape(height * width, step)


def _span(field: Dict[str, Any], step: int) -> Tuple[int, int]:
    """First byte and number of bytes of a field in a point."""
    size = _BYTES.get(field["datatype"], 0) * max(1, field["count"])
    if not size or field["offset"] + size > step:
        raise CloudError("the field {} does not fit into points of {} bytes".format(field["name"], step))
    return field["offset"], size


def _first_in_each_voxel(points: Any, known: Dict[str, Any], voxel_m: float, *, is_bigendian: bool) -> Any:
    """Indexes of the points to keep, in their order."""
    axes = []
    for axis in _AXES:
        field = known.get(axis)
        if field is None or field["datatype"] not in _FLOATS:
            raise CloudError("expected the fields x, y and z as floating point numbers")
        start, size = _span(field, points.shape[1])
        form = (">" if is_bigendian else "<") + _FLOATS[field["datatype"]]
        axes.append(numpy.ascontiguousarray(points[:, start : start + size]).view(form)[:, 0].astype("f8"))
    positions = numpy.stack(axes, axis=1)
    finite = numpy.flatnonzero(numpy.isfinite(positions).all(axis=1))
    voxels = numpy.floor(positions[finite] / voxel_m).astype(numpy.int64)
    if len(voxels):
        voxels -= voxels.min(axis=0)
        extent = voxels.max(axis=0) + 1
        if float(extent[0]) * float(extent[1]) * float(extent[2]) >= 2**62:
            raise CloudError("the cloud is too wide for voxels of {:g} m".format(voxel_m))
    else:
        extent = numpy.ones(3, numpy.int64)
    numbers = (voxels[:, 0] * extent[1] + voxels[:, 1]) * extent[2] + voxels[:, 2]
    first = numpy.unique(numbers, return_index=True)[1]
    return finite[numpy.sort(first)]


def _only(points: Any, fields: List[Dict[str, Any]]) -> Tuple[Any, List[Dict[str, Any]]]:
    """The bytes of these fields, one behind the other."""
    columns, kept, offset = [], [], 0
    for field in fields:
        start, size = _span(field, points.shape[1])
        columns.append(points[:, start : start + size])
        kept.append({**field, "offset": offset})
        offset += size
    return numpy.ascontiguousarray(numpy.concatenate(columns, axis=1)), kept
