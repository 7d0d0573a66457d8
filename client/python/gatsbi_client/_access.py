"""How a client shows who it is, and knows that the server is the right one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import grpc


def key(given: str | None) -> str | None:
    """The key: as given, or that of the environment (`GATSBI_API_KEY`)."""
    return given if given is not None else os.environ.get("GATSBI_API_KEY") or None


def credentials(
    ca: str | os.PathLike[str] | None, certificate: tuple[str | os.PathLike[str], str | os.PathLike[str]] | None
) -> grpc.ChannelCredentials | None:
    """TLS with the authorities in the file `ca`, and with an own certificate and its private key where given."""
    if ca is None:
        if certificate is not None:
            raise ValueError("a certificate is of use with TLS only; give ca, the authorities of the server")
        return None
    chain, private = (Path(path).read_bytes() for path in certificate) if certificate else (None, None)
    return grpc.ssl_channel_credentials(Path(ca).read_bytes(), private, chain)


class Keyed:
    """A channel that shows a key with every call."""

    def __init__(self, channel: Any, secret: str | None) -> None:
        self._channel = channel
        self._metadata = () if secret is None else (("authorization", f"Bearer {secret}"),)

    def close(self, *grace: float | None) -> Any:
        """Closes the channel."""
        return self._channel.close(*grace)

    def unary_unary(self, *method: Any) -> Any:
        """As the channel's."""
        return self._with_key(self._channel.unary_unary(*method))

    def unary_stream(self, *method: Any) -> Any:
        """As the channel's."""
        return self._with_key(self._channel.unary_stream(*method))

    def stream_stream(self, *method: Any) -> Any:
        """As the channel's."""
        return self._with_key(self._channel.stream_stream(*method))

    def _with_key(self, invoke: Any) -> Any:
        def call(*arguments: Any, **options: Any) -> Any:
            return invoke(*arguments, metadata=self._metadata, **options)

        return call
