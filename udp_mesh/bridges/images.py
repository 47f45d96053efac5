"""Images of ROS -> JPEG, with Pillow (extra `media`; python3-pil)."""

from __future__ import annotations

from io import BytesIO
from typing import Any, Dict, Tuple

try:
    from PIL import Image
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("`encode` needs Pillow: install python3-pil, or pip install pillow") from error

_BILINEAR: Any = getattr(Image, "Resampling", Image).BILINEAR
"""Moved in Pillow 9.1; ROS Noetic's Ubuntu has 7.0."""
_MODES: Dict[str, Tuple[str, str, int]] = {
    "rgb8": ("RGB", "RGB", 3),
    "bgr8": ("RGB", "BGR", 3),
    "8UC3": ("RGB", "BGR", 3),
    "rgba8": ("RGB", "RGBX", 4),
    "bgra8": ("RGB", "BGRX", 4),
    "mono8": ("L", "L", 1),
    "8UC1": ("L", "L", 1),
}
"""sensor_msgs/image_encodings.h: the mode in Pillow, the layout of the bytes, bytes per pixel."""


class ImageError(ValueError):
    """This image cannot be encoded as JPEG."""


def jpeg_of_raw(message: Dict[str, Any], quality: int, scale: float) -> bytes:
    """A sensor_msgs/Image as JPEG. Raises ImageError."""
    encoding, width, height, step = (message[name] for name in ("encoding", "width", "height", "step"))
    if encoding not in _MODES:
        known = ", ".join(sorted(_MODES))
        raise ImageError("expected an image with the encoding {}, found {!r}".format(known, encoding))
    mode, layout, pixel_bytes = _MODES[encoding]
    data = message["data"].data
    if not width or not height or step < width * pixel_bytes or len(data) < step * height:
        text = "expected {} lines of {} bytes for {} pixels each, found {} bytes"
        raise ImageError(text.format(height, step, width, len(data)))
    image = Image.frombuffer(mode, (width, height), data, "raw", layout, step, 1)
    return _jpeg(image, quality, _scaled(image.size, scale))


def jpeg_of_compressed(message: Dict[str, Any], quality: int, scale: float) -> bytes:
    """A sensor_msgs/CompressedImage (JPEG, PNG) as JPEG. Raises ImageError."""
    if "compressedDepth" in message["format"]:
        raise ImageError("a compressed depth image has no equivalent in JPEG")
    try:
        image = Image.open(BytesIO(message["data"].data))
        if image.format not in ("JPEG", "PNG"):
            raise ImageError("expected JPEG or PNG, found {}".format(image.format))
        size = _scaled(image.size, scale)
        # lets the JPEG decoder skip what is scaled away
        image.draft(None, size)
        image.load()
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise ImageError("format {!r}: {}".format(message["format"][:40], error)) from error
    return _jpeg(image if image.mode in ("L", "RGB") else image.convert("RGB"), quality, size)


def _scaled(size: Tuple[int, int], scale: float) -> Tuple[int, int]:
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def _jpeg(image: Image.Image, quality: int, size: Tuple[int, int]) -> bytes:
    if size != image.size:
        image = image.resize(size, _BILINEAR)
    out = BytesIO()
    image.save(out, "JPEG", quality=quality)
    return out.getvalue()
