import socket
import threading

import numpy as np
import pyarrow.parquet as parquet
import pytest

import gatsbi_client as gc
from server import ROOT, serving


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


class Cutting:
    """A way to the server that can be told to cut a connection in the middle of an answer."""

    def __init__(self, address):
        host, port = address.split(":")
        self._server, self._armed, self.cuts = (host, int(port)), threading.Event(), 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def cut_the_next_answer(self):
        self._armed.set()

    def close(self):
        self._listener.close()

    def _accept(self):
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            far = socket.create_connection(self._server)
            for ends in ((near, far, False), (far, near, True)):
                threading.Thread(target=self._pump, args=ends, daemon=True).start()

    def _pump(self, one, other, answers):
        try:
            while data := one.recv(65536):
                if answers and self._armed.is_set():
                    # What is shorter than headers and a message belongs to the protocol.
                    if len(data) > 100:
                        self._armed.clear()
                        self.cuts += 1
                        break
                other.sendall(data)
        except OSError:
            pass
        for each in (one, other):
            try:
                each.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass


@pytest.fixture
def cutting(address):
    way = Cutting(address)
    yield way
    way.close()
