"""A web server of a folder that answers ranges, and that can be told to fail."""

import threading
from collections import deque
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote


@dataclass
class Server:
    """What a test sees of a running server."""

    url: str
    folder: Path
    requests: list = field(default_factory=list)
    """(path, Range header) of each request."""
    connections: set = field(default_factory=set)
    """Client ports seen."""
    faults: deque = field(default_factory=deque)
    """What the next requests meet: a status, ``close``, ``cut`` or ``short``; then all is well."""
    knows_ranges: bool = True
    redirect: str = ""
    """Where every request is sent on to."""


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    # A response goes out at once; else Nagle's algorithm holds its body back for 40 ms.
    wbufsize = -1
    disable_nagle_algorithm = True

    def do_GET(self):
        state = self.server.state
        asked = self.headers.get("Range")
        state.requests.append((self.path, asked))
        state.connections.add(self.client_address)
        fault = state.faults.popleft() if state.faults else None
        if state.redirect:
            return self.answer(302, b"", {"Location": state.redirect + self.path})
        if isinstance(fault, int):
            return self.answer(fault, b"sorry")
        if fault == "close":
            self.close_connection = True
            return None
        path = state.folder / unquote(self.path).lstrip("/")
        if not path.is_file():
            return self.answer(404, b"no such file")
        if asked is None or not state.knows_ranges:
            return self.answer(200, path.read_bytes(), fault=fault)
        return self.answer_range(path, asked, fault)

    def answer_range(self, path, asked, fault):
        first, last = map(int, asked.removeprefix("bytes=").split("-"))
        total = path.stat().st_size
        if first >= total:
            return self.answer(416, b"", {"Content-Range": f"bytes */{total}"})
        last = min(last, total - 1) - (100 if fault == "short" else 0)
        with path.open("rb") as stream:
            stream.seek(first)
            data = stream.read(last - first + 1)
        found = {"Content-Range": f"bytes {first}-{last}/{total}"}
        return self.answer(206, data, found, fault)

    def answer(self, status, data, headers=None, fault=None):
        self.send_response(status)
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if fault == "cut":
            data = data[: len(data) // 2]
            self.close_connection = True
        self.wfile.write(data)
        self.wfile.flush()

    def log_message(self, *_):
        pass


@contextmanager
def serve(folder):
    """Serve a folder on a free port, for as long as the block runs."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    server.state = Server(f"http://127.0.0.1:{server.server_address[1]}", Path(folder))
    thread = threading.Thread(target=server.serve_forever, args=(0.05,))
    thread.start()
    try:
        yield server.state
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
