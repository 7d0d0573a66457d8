"""The twin behind LitServe: JSON with base64."""

import sys
from base64 import b64decode, b64encode

import litserve
from core import Core


class Twin(litserve.LitAPI):
    """One process with the model; what arrives within a millisecond is a batch."""

    def setup(self, device: str) -> None:
        self.core = Core()

    def decode_request(self, request: dict[str, str]) -> tuple[str, bytes]:
        return request["session"], b64decode(request["body"])

    def batch(self, inputs: list[tuple[str, bytes]]) -> list[tuple[str, bytes]]:
        return inputs

    def predict(self, inputs: list[tuple[str, bytes]]) -> list[bytes]:
        return self.core.observe([session for session, _ in inputs], [body for _, body in inputs])

    def unbatch(self, output: list[bytes]) -> list[bytes]:
        return output

    def encode_response(self, output: bytes) -> dict[str, str]:
        return {"objects": b64encode(output).decode()}


if __name__ == "__main__":
    api = Twin(max_batch_size=16, batch_timeout=0.001)
    server = litserve.LitServer(api, accelerator="cpu", workers_per_device=1, timeout=60)
    server.run(port=int(sys.argv[1]), host="127.0.0.1", generate_client_file=False, num_api_servers=1)
