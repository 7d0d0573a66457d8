import os
import subprocess

import pytest

import gatsbi_client as gc
from server import ROOT, serving


def new_key(file, role):
    program = os.environ.get("GATSBI_SERVER", str(ROOT / "target/debug/gatsbi-server"))
    made = [program, "keys", "new", "--tenant", "lab", "--role", role, "--file", str(file)]
    return subprocess.run(made, check=True, capture_output=True, text=True).stdout.strip()


def test_a_key_opens_what_its_role_allows(tmp_path, frames, monkeypatch):
    monkeypatch.delenv("GATSBI_API_KEY", raising=False)
    keys = tmp_path / "keys.toml"
    read, predict = new_key(keys, "read"), new_key(keys, "predict")
    with serving(tmp_path / "log", "--keys", str(keys)) as address:
        with gc.Client(address) as nobody, pytest.raises(gc.NotAllowed) as refused:
            nobody.models()
        assert refused.value.reason == "NO_KEY"
        with gc.Client(address, api_key=read) as reader:
            assert reader.models()
            with pytest.raises(gc.NotAllowed) as refused:
                reader.create_session()
            assert refused.value.reason == "ROLE_TOO_LOW"
        monkeypatch.setenv("GATSBI_API_KEY", predict)
        with gc.Client(address) as client, client.create_session() as session:
            assert session.observe(frames[0]).step == 0
            assert session.imagine([[0.0] * len(client.models()[0].actions)], outputs=["objects"]).outputs


def test_a_certificate_needs_authorities():
    with pytest.raises(ValueError, match="give ca"):
        gc.Client("127.0.0.1:1", certificate=("a", "b"))
