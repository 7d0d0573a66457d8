"""The twin behind mosec: a body with the session's number in 16 digits before it."""

from core import Core
from mosec import Server, Worker


class Twin(Worker):
    """One process with the model; what arrives within a millisecond is a batch."""

    def __init__(self) -> None:
        super().__init__()
        self.core = Core()

    def deserialize(self, data: bytes) -> bytes:
        return data

    def serialize(self, data: bytes) -> bytes:
        return data

    def forward(self, data: list[bytes]) -> list[bytes]:
        return self.core.observe([body[:16].decode() for body in data], [body[16:] for body in data])


if __name__ == "__main__":
    server = Server()
    server.append_worker(Twin, num=1, max_batch_size=16, max_wait_time=1)
    server.run()
