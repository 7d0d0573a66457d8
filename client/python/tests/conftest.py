import os
import socket
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet
import pytest

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


@pytest.fixture(scope="session")
def address(tmp_path_factory):
    with serving(tmp_path_factory.mktemp("server") / "log") as address:
        yield address


@pytest.fixture
def client(address):
    with gc.Client(address) as client:
        yield client


@pytest.fixture(scope="session")
def dimension(address):
    with gc.Client(address) as client:
        return len(client.models()[0].actions)


@pytest.fixture(scope="session")
def frames():
    row = parquet.ParquetFile(ROOT / "episodes/samples/push1-heldout.parquet").read_row_group(0).to_pylist()[0]
    side = int((len(row["rgb"]) // row["length"] // 3) ** 0.5)
    return np.frombuffer(row["rgb"], np.uint8).reshape(row["length"], side, side, 3)
