"""An S3 server that misbehaves as a file says: `python faulty_s3.py PORT FAULTS.json`.

FAULTS.json, absent for none: {"errors": share of requests answered with 500, "delay_s": of every answer, "down": true}.
"""

import json
import random
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from moto.moto_server.werkzeug_app import DomainDispatcherApplication, MotoRequestHandler, create_backend_app
from werkzeug.serving import run_simple

ERROR = b"<?xml version='1.0'?><Error><Code>InternalError</Code><Message>We are unwell.</Message></Error>"


def faulty(app: Callable[..., Iterable[bytes]], faults: Path) -> Callable[..., Iterable[bytes]]:
    rng = random.Random(0)

    def answer(environ: dict[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
        try:
            fault = json.loads(faults.read_text())
        except (FileNotFoundError, ValueError):
            fault = {}
        time.sleep(fault.get("delay_s", 0))
        if fault.get("down") or rng.random() < fault.get("errors", 0):
            environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
            start(
                "500 Internal Server Error", [("Content-Type", "application/xml"), ("Content-Length", str(len(ERROR)))]
            )
            return [ERROR]
        return app(environ, start)

    return answer


if __name__ == "__main__":
    port, control = int(sys.argv[1]), Path(sys.argv[2])
    app = faulty(DomainDispatcherApplication(create_backend_app), control)
    run_simple("127.0.0.1", port, app, threaded=True, request_handler=MotoRequestHandler)
