import asyncio
import re
import socket
import threading
from pathlib import Path

import numpy as np
import pytest

import gatsbi_client as gc

HERE = Path(__file__).resolve().parents[1]


def test_generated_files_are_current(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(HERE))
    from generate import generate
    generate(tmp_path)
    generated = [path.relative_to(tmp_path) for path in tmp_path.rglob("*.py*")]
    assert Path("_sync.py") in generated and len(generated) > 20
    for path in generated:
        assert (HERE / "gatsbi_client" / path).read_bytes() == (tmp_path / path).read_bytes(), path


@pytest.mark.parametrize("snippet", re.findall(r"```python\n(.*?)```", (HERE / "README.md").read_text(), re.S))
def test_readme(snippet, address, frames):
    exec(snippet, {"address": address, "frames": frames})


def test_fork_rewind_export_and_handles(client, frames, dimension):
    a = np.zeros(dimension)
    with client.create_session(keep_steps=4) as s:
        s.observe(frames[0])
        first = s.observe(frames[1], a, outputs=["frame", "latents"])
        assert first.outputs["frame"].shape[2] == 3
        snapshot = s.export()
        (fork,) = s.fork()
        fork.observe(frames[2], a)
        assert (s.refresh().next_step, fork.next_step) == (2, 3)
        assert s.export() == snapshot
        fork.delete()
        s.observe(frames[2], a)
        assert s.rewind(0).next_step == 1
        again = s.observe(frames[1], a, outputs=["frame", "latents"])
        assert np.array_equal(again.outputs["latents"], first.outputs["latents"])
        with client.import_session(snapshot) as other:
            assert other.next_step == 2
        actions = np.zeros((2, 2, dimension))
        roll = s.imagine(actions, outputs=["latents"], samples=2, seed=3)
        assert roll.outputs["latents"].shape[:3] == (2, 2, 2)
        with client.open_handles([s.id, snapshot]) as h:
            assert h.step(np.zeros((2, dimension))).outputs["objects"].shape[0] == 2


def test_sync_and_asyncio_agree(client, address, frames, dimension):
    actions = np.zeros((2, 3, dimension))
    with client.create_session() as s:
        s.observe(frames[0])
        want = s.imagine(actions, outputs=["frame"]).outputs["frame"].tobytes()
    async def other():
        async with gc.AsyncClient(address) as c, await c.create_session() as s:
            await s.observe(frames[0])
            return (await s.imagine(actions, outputs=["frame"])).outputs["frame"].tobytes()
    assert asyncio.run(other()) == want


def test_errors(client, frames, dimension):
    with client.create_session() as s:
        s.observe(frames[0])
        with pytest.raises(gc.InvalidRequest) as e:
            s.observe(frames[1], np.zeros(dimension + 1))
        assert "action" in e.value.fields[0].field
        with pytest.raises(gc.InvalidRequest):
            s.observe(frames[1], np.full(dimension, np.nan))
        with pytest.raises(gc.InvalidRequest):
            s.observe(frames[1][:, :, :2], np.zeros(dimension))
        with pytest.raises(gc.StepGap) as gap:
            s.observe(frames[1], np.zeros(dimension), step=9)
        assert gap.value.expected_step == 1
    with pytest.raises(gc.NotFound):
        client.session("0" * 32)


def test_lost_answer_is_asked_for_again(address, frames):
    host, port = address.split(":")
    armed, cuts = threading.Event(), []
    listener = socket.create_server(("127.0.0.1", 0))

    def pump(a, b, back):
        try:
            while data := a.recv(65536):
                if back and armed.is_set():
                    armed.clear()
                    cuts.append(1)
                    break
                b.sendall(data)
        except OSError:
            pass
        for each in (a, b):
            try:
                each.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass

    def accept():
        while True:
            try:
                a, _ = listener.accept()
            except OSError:
                return
            b = socket.create_connection((host, int(port)))
            for args in ((a, b, False), (b, a, True)):
                threading.Thread(target=pump, args=args, daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    proxy = f"127.0.0.1:{listener.getsockname()[1]}"
    with gc.Client(proxy) as c, c.create_session() as s:
        armed.set()
        assert s.observe(frames[0]).step == 0
        assert cuts == [1] and s.refresh().next_step == 1
    with gc.Client(proxy, retries=gc.Retries(attempts=1)) as once:
        session = once.create_session()
        armed.set()
        with pytest.raises(gc.Unavailable):
            session.observe(frames[0])
    listener.close()
