"""Shards on a web server or an object store, read by HTTP ranges."""

import time
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote
from urllib.request import getproxies, proxy_bypass

from urllib3 import BaseHTTPResponse, PoolManager, ProxyManager, Retry, Timeout
from urllib3.exceptions import HTTPError, MaxRetryError, ProtocolError
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
from l3r.data.store import ShardStore
from l3r.errors import DataError

PAUSES = (0.2, 0.5, 1.0, 2.0, 4.0)
"""Seconds between attempts."""
MAX_CONNECTIONS = 16
"""Open connections of one process; one thread uses one."""

_PASSING = (408, 425, 429, 500, 502, 503, 504)
"""Answers that may be another a moment later."""
_TIMEOUT = Timeout(connect=10, read=60)
_REDIRECTS_ONLY = Retry(total=None, connect=0, read=0, status=0, other=0, redirect=5)


class HttpStore(ShardStore):
    """A folder of shards at an http(s) address.

    A graph is one request for a range. Connections are kept; what may pass (no connection, a
    broken one, an answer of 5xx or 429) is tried again after growing pauses. Proxies of the
    environment are used.

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
            DataError: The server refuses it, or does not answer after all attempts.
        """
        problem = ""
        for pause in (0.0, *PAUSES):
            time.sleep(pause)
            try:
                return self._try(url, where, hint, span)
            except MaxRetryError as error:
                problem = str(error.reason or error)
            except HTTPError as error:
                problem = str(error)
        raise DataError(
            f"{where}: {problem}, {1 + len(PAUSES)} times in a row; look after the server and the"
            " network"
        )

    def _try(self, url: str, where: str, hint: str, span: tuple[int, int] | None) -> bytes:
        headers = {} if span is None else {"Range": f"bytes={span[0]}-{span[1]}"}
        response = self._connections().request(
            "GET",
            url,
            headers=headers,
            timeout=_TIMEOUT,
            retries=_REDIRECTS_ONLY,
            preload_content=False,  # a server without ranges would send the whole tar
        )
        try:
            _check(response, where, hint, span)
            data = response.read()
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


def _check(response: BaseHTTPResponse, where: str, hint: str, span: tuple[int, int] | None) -> None:
    """Look at an answer before its body is read.

    Raises:
        ProtocolError: Another attempt may go well.
        DataError: It will not.
    """
    status = f"the server answers {response.status} {response.reason or ''}".rstrip()
    if response.status in _PASSING:
        raise ProtocolError(status)
    if span is None and response.status == 200:
        return
    if span is not None and response.status == 200:
        raise DataError(
            f"{where}: the server sends the whole tar, expected the range that was asked for;"
            " take a server that knows ranges (nginx, S3 and most others), or copy the shards to a"
            " disk"
        )
    if span is None or response.status != 206:
        raise DataError(f"{where}: {status}; {hint}")
    found = response.headers.get("Content-Range", "")
    if not found.replace("=", " ").startswith(f"bytes {span[0]}-"):
        raise DataError(
            f"{where}: the server sends '{found}', expected bytes {span[0]}-{span[1]}; take"
            " another server, or copy the shards to a disk"
        )
