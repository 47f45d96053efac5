"""Upload a file to a node without SFTP, over an unreliable link: survey, send missing chunks, verify, rename.

The partial file on the node is named after the target and the content's hash, so two contents never mix. A survey
hashes it chunk by chunk; everything before the first differing chunk is kept. The other chunks are sent with one
command each, which answers with the hash of what was written. At the end the whole file is hashed on the node and
renamed. After a cut, the next `upload` resumes from the partial file. The data goes through `cat`.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from meshctl.device.connection import Connection
from meshctl.device.errors import UploadFailed
from meshctl.device.framing import quoted
from meshctl.errors import InputError

# Large enough that the round trips of a chunk do not matter, small enough to lose little at a cut: at 1 Mbit/s a chunk
# takes two seconds.
CHUNK_BYTES = 256 << 10
# A slower link counts as lost; bounds how long a chunk may take.
MIN_BYTES_PER_S = 4 << 10
# The unit of rate limiting.
_PIECE_BYTES = 4 << 10
_COMMAND_TIMEOUT_S = 60.0
# How often to survey again after a damaged chunk, which a leftover writer of a cut connection can cause.
MAX_SURVEYS = 3


@dataclass(frozen=True, slots=True)
class UploadProgress:
    """`verified` of `total` bytes are on the node with matching hashes."""

    verified: int
    total: int


@dataclass(frozen=True, slots=True)
class Uploaded:
    """The result of an upload: `sent` bytes were sent, `kept` bytes were there from before a cut."""

    path: str
    sha256: str
    total: int
    sent: int
    kept: int


class Content:
    """The data to upload, read chunk by chunk: bytes or a file. Raises InputError for an unreadable file."""

    def __init__(self, source: bytes | Path) -> None:
        self._source = source
        self.size = 0
        digest = hashlib.sha256()
        try:
            self.size = len(source) if isinstance(source, bytes) else source.stat().st_size
            for index in range(self.chunks):
                digest.update(self.chunk(index))
        except OSError as error:
            raise InputError(f"{source!s}: cannot be read: {error.strerror or error}") from error
        self.sha256 = digest.hexdigest()

    @property
    def chunks(self) -> int:
        return -(-self.size // CHUNK_BYTES)

    def chunk(self, index: int) -> bytes:
        start = index * CHUNK_BYTES
        if isinstance(self._source, bytes):
            return self._source[start : start + CHUNK_BYTES]
        with self._source.open("rb") as file:
            file.seek(start)
            return file.read(CHUNK_BYTES)


def upload(
    connection: Connection,
    source: bytes | Path,
    path: str,
    *,
    mode: int = 0o644,
    rate_bytes_per_s: float | None = None,
    progress: Callable[[UploadProgress], None] | None = None,
    sleep: Callable[[float], None] = time.sleep,
) -> Uploaded:
    """Write `source` to `path` on the node, with `mode`; a second call after a cut resumes.

    Raises UploadFailed if the node has no space or the data does not match, Timeout and ConnectionLost for the link;
    then `path` is unchanged.
    """
    content = Content(source)
    partial = _partial(path, content)
    report = progress or (lambda _: None)
    sent = 0
    kept_at_first: int | None = None
    for _ in range(MAX_SURVEYS):
        survey = _survey(connection, path, partial, content)
        if survey.done:
            report(UploadProgress(content.size, content.size))
            return Uploaded(path, content.sha256, content.size, sent, content.size - sent)
        good = survey.good_chunks
        kept_at_first = good * CHUNK_BYTES if kept_at_first is None else kept_at_first
        report(UploadProgress(min(good * CHUNK_BYTES, content.size), content.size))
        while good < content.chunks:
            data = content.chunk(good)
            arrived = _send_chunk(connection, partial, good, data, rate_bytes_per_s, sleep)
            sent += len(data)
            if not arrived:
                break
            good += 1
            report(UploadProgress(min(good * CHUNK_BYTES, content.size), content.size))
        if good == content.chunks and _put_in_place(connection, partial, path, content, mode):
            return Uploaded(path, content.sha256, content.size, sent, min(kept_at_first, content.size))
    raise UploadFailed(f"{connection.endpoint.label}: {path}: the data was corrupted on the way")


@dataclass(frozen=True, slots=True)
class _Survey:
    done: bool
    good_chunks: int


def _partial(path: str, content: Content) -> str:
    target = PurePosixPath(path)
    if not target.is_absolute() or target.name in {"", "..", "."}:
        raise ValueError(f"{path!r}: expected the absolute path of a file")
    return str(target.parent / f".{target.name}.{content.sha256[:16]}.part")


# Partial files of other contents are removed: they are never resumed, and fill a small /tmp.
_SURVEY = """\
t={target} p={partial} size={size}
d=${{t%/*}}
mkdir -p "$d" || exit 1
for old in "$d"/.${{t##*/}}.*.part; do [ "$old" = "$p" ] || rm -f "$old"; done
[ ! -f "$t" ] || [ "$(wc -c <"$t")" -ne $size ] || sha256sum <"$t" | sed 's/^/whole /'
have=0; [ ! -f "$p" ] || have=$(wc -c <"$p")
free=$(df -k "$d" 2>/dev/null | awk 'END {{ if (NF > 3) print $(NF - 2) }}')
[ -z "$free" ] || [ $((free * 1024 + have)) -ge $size ] || {{ echo "full $free"; exit 0; }}
i=0
while [ $((i * {chunk})) -lt "$have" ]; do
	dd if="$p" bs={chunk} skip=$i count=1 2>/dev/null | sha256sum | sed 's/^/chunk /'
	i=$((i + 1))
done
"""


def _survey(connection: Connection, path: str, partial: str, content: Content) -> _Survey:
    script = _SURVEY.format(target=quoted(path), partial=quoted(partial), size=content.size, chunk=CHUNK_BYTES)
    answer = connection.run(script, timeout_s=_COMMAND_TIMEOUT_S * 2).check(
        f"{connection.endpoint.label}: look at {path}"
    )
    chunks: list[str] = []
    for line in answer.stdout.splitlines():
        match line.split():
            case ["whole", digest, *_] if digest == content.sha256:
                return _Survey(True, content.chunks)
            case ["chunk", digest, *_]:
                chunks.append(digest)
            case ["full", free]:
                raise UploadFailed(
                    f"{connection.endpoint.label}: {path}: needs {content.size // 1024 + 1} KiB, {free} KiB are free"
                )
            case _:
                continue
    good = 0
    while good < min(len(chunks), content.chunks) and chunks[good] == hashlib.sha256(content.chunk(good)).hexdigest():
        good += 1
    return _Survey(False, good)


# dd without input truncates the file at its seek position: OpenWrt has no truncate.
_CHUNK = """\
p={partial}
dd if=/dev/null of="$p" bs=1 seek={start} 2>/dev/null || exit 1
cat >>"$p" || exit 1
tail -c {length} "$p" | sha256sum
"""


def _send_chunk(
    connection: Connection,
    partial: str,
    index: int,
    data: bytes,
    rate_bytes_per_s: float | None,
    sleep: Callable[[float], None],
) -> bool:
    script = _CHUNK.format(partial=quoted(partial), start=index * CHUNK_BYTES, length=len(data))
    answer = connection.run(
        script,
        stdin=data if rate_bytes_per_s is None else paced(data, rate_bytes_per_s, sleep),
        timeout_s=_COMMAND_TIMEOUT_S + longest_s(data, rate_bytes_per_s),
    )
    if answer.exit_status != 0:
        raise UploadFailed(f"{connection.endpoint.label}: {partial}: cannot be written: {answer.stderr.strip()}")
    return answer.stdout.split()[:1] == [hashlib.sha256(data).hexdigest()]


def longest_s(data: bytes, rate_bytes_per_s: float | None) -> float:
    """How long sending `data` may take: over a link that is slower still it counts as lost."""
    return len(data) / min(MIN_BYTES_PER_S, (rate_bytes_per_s or MIN_BYTES_PER_S) / 2)


def paced(data: bytes, rate_bytes_per_s: float, sleep: Callable[[float], None] = time.sleep) -> Iterator[bytes]:
    """`data` in pieces, each followed by the pause for its size at that rate."""
    for start in range(0, len(data), _PIECE_BYTES):
        piece = data[start : start + _PIECE_BYTES]
        yield piece
        sleep(len(piece) / rate_bytes_per_s)


# Truncated first, because a leftover writer may have appended data; the hash detects missing data.
#
# sync is global on purpose: `sync FILE` needs busybox's FEATURE_SYNC_FANCY, which OpenWrt leaves out, and `fsync FILE`
# secures the content but not the rename. A radio has little other unwritten data: logs are in memory.
_FINISH = """\
p={partial} t={target}
dd if=/dev/null of="$p" bs=1 seek={size} 2>/dev/null || exit 1
[ "$(sha256sum <"$p")" = "{sha256}  -" ] || {{ echo damaged; exit 0; }}
chmod {mode:o} "$p" && /bin/sync && mv -f "$p" "$t" && /bin/sync && echo placed
"""


def _put_in_place(connection: Connection, partial: str, path: str, content: Content, mode: int) -> bool:
    script = _FINISH.format(
        partial=quoted(partial), target=quoted(path), size=content.size, sha256=content.sha256, mode=mode
    )
    answer = connection.run(script, timeout_s=_COMMAND_TIMEOUT_S * 2).check(
        f"{connection.endpoint.label}: put {path} in place"
    )
    return answer.stdout.strip() == "placed"
