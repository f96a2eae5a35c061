"""Shards on a web server or an object store, read by HTTP ranges."""

import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote
from urllib.request import getproxies, proxy_bypass

from urllib3 import BaseHTTPResponse, PoolManager, ProxyManager, Retry, Timeout
from urllib3.exceptions import (
    ConnectTimeoutError,
    HTTPError,
    MaxRetryError,
    NewConnectionError,
    ProtocolError,
    ProxyError,
    ReadTimeoutError,
)
from urllib3.util import parse_url

from l3r.data.schema import (
    MANIFEST_NAME,
    IndexEntry,
    Manifest,
    ShardEntry,
    ShardIndex,
    index_path,
    parse_index,
    parse_manifest,
)
from l3r.data.store import ShardStore, UnreachableError
from l3r.errors import DataError

PAUSES = (0.2, 0.5, 1.0, 2.0, 4.0)
"""Seconds between attempts."""
MAX_CONNECTIONS = 16
"""Open connections of one process; one thread uses one."""
MAX_FILE_BYTES = 256 * 2**20
"""Largest manifest or index that is read."""
MAX_SECONDS = 300.0
"""After so long no attempt begins and no body is read on."""

_PASSING = (408, 425, 429, 500, 502, 503, 504)
"""Answers that may be another a moment later."""
_SILENCE = (NewConnectionError, ConnectTimeoutError, ReadTimeoutError, ProxyError)
_RANGE = re.compile(r"bytes[ =](\d{1,18})-(\d{1,18})/")
_TIMEOUT = Timeout(connect=10, read=60)
_REDIRECTS_ONLY = Retry(total=None, connect=0, read=0, status=0, other=0, redirect=5)


class HttpStore(ShardStore):
    """A folder of shards at an http(s) address.

    A graph is one request for a range. Connections are kept; what may pass (no connection, a
    broken one, an answer of 5xx or 429) is tried again after growing pauses. Proxies of the
    environment are used.

    Without redirects, no graph takes longer than ``MAX_SECONDS``, the 10 s to connect and 60 s of
    silence that the last attempt may add, and a pause: 374 s. No more
    bytes are read than were asked for, and one.

    Args:
        url: Address of the folder.

    Raises:
        DataError: The address cannot be used.
    """

    def __init__(self, url: str) -> None:
        self.place = url.rstrip("/")
        try:
            parts = parse_url(self.place)
        except HTTPError as error:
            raise DataError(f"{url}: {error}; expected https://HOST/FOLDER") from error
        # A name and a password, or a signature, would end up in config.yaml and in checkpoints.
        if not parts.host or parts.auth or parts.query or parts.fragment:
            raise DataError(
                f"{parts.scheme}://{parts.host}{parts.path or ''}: expected https://HOST/FOLDER"
                " without user, signature or '#'; copy shards that need those to a disk"
            )
        self.name = unquote((parts.path or "").rpartition("/")[2]) or parts.host
        self._pool: PoolManager | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave the connections behind."""
        return {**self.__dict__, "_pool": None}

    def read_manifest(self) -> Manifest:
        """Fetch ``manifest.json``."""
        url = f"{self.place}/{MANIFEST_NAME}"
        hint = "expected the address of a folder of finished shards"
        return parse_manifest(self._fetch(url, url, hint), url)

    def read_index(self, shard: ShardEntry) -> ShardIndex:
        """Fetch the index that ``l3r-prep build`` wrote beside the tar.

        Raises:
            DataError: It is not there, or of another tar than the manifest says.
        """
        url = self._url(index_path(Path(shard.name)).name)
        hint = "'l3r-prep build' writes it beside each tar: copy it there too"
        index = parse_index(self._fetch(url, url, hint), url)
        if index.tar_bytes != shard.bytes:
            raise DataError(
                f"{url}: made of a tar of {index.tar_bytes} bytes, the manifest says"
                f" {shard.bytes}; copy the folder of shards there again"
            )
        return index

    def read_graph(self, shard: ShardEntry, entry: IndexEntry) -> bytes:
        """Fetch the range.

        Raises:
            DataError: It cannot be had, the server knows no ranges, or the tar ends before.
        """
        first, last = entry.offset, entry.offset + entry.size - 1
        where = f"{self._url(shard.name)}:{entry.key}"
        hint = "copy the folder of shards there again"
        data = self._fetch(self._url(shard.name), where, hint, (first, last))
        if len(data) != entry.size:
            raise DataError(
                f"{where}: the server gave {len(data)} of {entry.size} bytes, its tar is cut off;"
                f" {hint}"
            )
        return data

    def _url(self, name: str) -> str:
        return f"{self.place}/{quote(name)}"

    def _fetch(self, url: str, where: str, hint: str, span: tuple[int, int] | None = None) -> bytes:
        """Get a file, or its bytes from the first to the last of a span.

        Raises:
            UnreachableError: No attempt met a server that answers.
            DataError: The server refuses it, or fails in all attempts.
        """
        deadline = time.monotonic() + MAX_SECONDS
        problem, attempts, is_silent = "", 0, True
        for pause in (0.0, *PAUSES):
            time.sleep(pause)
            if attempts and time.monotonic() > deadline:
                break
            attempts += 1
            try:
                return self._try(_Request(url, where, hint, span, deadline))
            except HTTPError as error:
                reason = error.reason if isinstance(error, MaxRetryError) else error
                problem = str(reason or error)
                is_silent = is_silent and isinstance(reason, _SILENCE)
        message = f"{where}: {problem}, {attempts} times in a row; look after the server and the"
        raise (UnreachableError if is_silent else DataError)(f"{message} network")

    def _try(self, request: "_Request") -> bytes:
        span = request.span
        response = self._connections().request(
            "GET",
            request.url,
            headers={} if span is None else {"Range": f"bytes={span[0]}-{span[1]}"},
            timeout=_TIMEOUT,
            retries=_REDIRECTS_ONLY,
            preload_content=False,  # a server without ranges would send the whole tar
        )
        try:
            _check(response, request)
            data = _read(response, request)
        except BaseException:
            response.close()  # what is left of the answer is not wanted
            raise
        response.release_conn()
        return data

    def _connections(self) -> PoolManager:
        if self._pool is None:
            scheme = parse_url(self.place).scheme or ""
            host = parse_url(self.place).host or ""
            proxy = None if proxy_bypass(host) else getproxies().get(scheme)
            options: dict[str, Any] = {"maxsize": MAX_CONNECTIONS}
            self._pool = ProxyManager(proxy, **options) if proxy else PoolManager(**options)
        return self._pool


@dataclass(frozen=True)
class _Request:
    """One thing to fetch."""

    url: str
    where: str
    hint: str
    span: tuple[int, int] | None
    """First and last byte; None: the whole file."""
    deadline: float
    """Of ``time.monotonic``."""

    @property
    def max_bytes(self) -> int:
        return MAX_FILE_BYTES if self.span is None else self.span[1] - self.span[0] + 1


def _read(response: BaseHTTPResponse, request: _Request) -> bytes:
    """Read a body, at most one byte more than it may have.

    Raises:
        ProtocolError: It comes too slowly.
        DataError: It is too long.
    """
    data = bytearray()
    while len(data) <= request.max_bytes:
        if time.monotonic() > request.deadline:
            raise ProtocolError(f"{len(data)} bytes in {MAX_SECONDS:.0f} s")
        # One read of the socket each, so that a trickle meets the deadline too.
        piece = response.read1(request.max_bytes + 1 - len(data))
        if not piece:
            return bytes(data)
        data += piece
    raise _flooded(request)


def _flooded(request: _Request) -> DataError:
    return DataError(
        f"{request.where}: the server sends more than was asked, expected {request.max_bytes} bytes"
        f" or less; {request.hint}"
    )


def _check(response: BaseHTTPResponse, request: _Request) -> None:
    """Look at an answer before its body is read.

    Raises:
        ProtocolError: Another attempt may go well.
        DataError: It will not.
    """
    where, span = request.where, request.span
    status = f"the server answers {response.status} {response.reason or ''}".rstrip()
    if response.status in _PASSING:
        raise ProtocolError(status)
    if span is not None and response.status == 200:
        raise DataError(
            f"{where}: the server sends the whole tar, expected the range that was asked for;"
            " take a server that knows ranges (nginx, S3 and most others), or copy the shards to a"
            " disk"
        )
    if response.status != (200 if span is None else 206):
        raise DataError(f"{where}: {status}; {request.hint}")
    length = response.headers.get("Content-Length", "")
    if length.isdigit() and int(length[:18]) > request.max_bytes:
        raise _flooded(request)
    if span is not None:
        _check_span(response.headers.get("Content-Range", ""), length, span, where)


def _check_span(found: str, length: str, span: tuple[int, int], where: str) -> None:
    """Compare what is sent with what was asked; a tar that ends before is told by its length.

    Raises:
        DataError: It is another range, or its length is not that of the range.
    """
    match = _RANGE.match(found)
    first, last = (int(match[1]), int(match[2])) if match else (-1, -1)
    is_length = not length or length == str(last - first + 1)
    if first != span[0] or not first <= last <= span[1] or not is_length:
        raise DataError(
            f"{where}: the server sends '{found:.80}' of {length or 'unknown'} bytes, expected"
            f" bytes {span[0]}-{span[1]}; take another server, or copy the shards to a disk"
        )
