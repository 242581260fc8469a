"""The metrics of a node over HTTP, on the loopback interface, for Prometheus."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from cobevglue.node.metrics import CONTENT_TYPE

__all__ = ["MetricsPage", "serve_metrics"]


class MetricsPage:
    """The text that is served; replaced as a whole, so that no reader sees half of it."""

    text = ""


@contextmanager
def serve_metrics(page: MetricsPage, port: int) -> Iterator[int]:
    """Serve `page` as http://127.0.0.1:PORT/metrics until the block ends.

    Args:
        page: what to serve.
        port: 0 for any free one.

    Returns:
        The port.

    Raises:
        OSError: the port is in use; the message names it.
    """

    class Handler(BaseHTTPRequestHandler):
        timeout = 5.0

        def do_GET(self) -> None:
            found = self.path.split("?")[0] in ("/", "/metrics")
            body = page.text.encode() if found else b"the metrics are at /metrics\n"
            self.send_response(200 if found else 404)
            self.send_header("Content-Type", CONTENT_TYPE)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *values: object) -> None:
            """No log: standard error has the status line."""

    try:
        server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    except (OSError, OverflowError) as error:
        raise OSError(f"metrics: port {port}: {error}") from None
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, args=(0.1,), name="metrics", daemon=True)
    thread.start()
    try:
        yield int(server.server_address[1])
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
