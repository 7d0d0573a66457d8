import os
import socket
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

import gatsbi_client as gc

ROOT = Path(__file__).resolve().parents[3]


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


@contextmanager
def serving(log, *flags):
    """The gRPC address of a server with these flags."""
    program = os.environ.get("GATSBI_SERVER", str(ROOT / "target/debug/gatsbi-server"))
    grpc, http, admin = (f"127.0.0.1:{free_port()}" for _ in range(3))
    with log.open("w") as out:
        server = subprocess.Popen(
            [program, "--checkpoint", str(ROOT / "models/checkpoints/push1-tiny.safetensors"), "--threads", "1",
             "--grpc-listen", grpc, "--http-listen", http, "--admin-listen", admin, *flags], stdout=out, stderr=out)
    try:
        with gc.Client(grpc) as client:
            for _ in range(100):
                assert server.poll() is None, log.read_text()
                try:
                    client.models()
                    break
                except gc.NotAllowed:
                    break
                except gc.Unavailable:
                    time.sleep(0.1)
        yield grpc
    finally:
        server.terminate()
        server.wait(20)
