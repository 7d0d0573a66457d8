"""A real server with the bundled checkpoint, and Chromium."""

import os
import socket
import subprocess
import time
import urllib.request
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet
import pytest
from playwright.sync_api import expect, sync_playwright

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / "episodes/samples/push1-heldout.parquet"
# The page is tested without any network but the loopback: the browser should not look for its maker's.
QUIET = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]

# Machines that test much at once are slow.
expect.set_options(timeout=20000)


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


class Server:
    """The server's process, on ports that stay when it is started anew."""

    def __init__(self, folder):
        self.grpc, self.http, self.admin = (f"127.0.0.1:{free_port()}" for _ in range(3))
        self.log = folder / "server.log"
        self.start()

    def start(self):
        program = os.environ.get("GATSBI_SERVER", str(ROOT / "target/debug/gatsbi-server"))
        with self.log.open("a") as log:
            self.process = subprocess.Popen(
                [program, "--checkpoint", str(ROOT / "models/checkpoints/push1-tiny.safetensors"), "--threads", "1",
                 "--grpc-listen", self.grpc, "--http-listen", self.http, "--admin-listen", self.admin],
                stdout=log, stderr=log)
        for _ in range(600):
            assert self.process.poll() is None, self.log.read_text()
            try:
                urllib.request.urlopen(f"http://{self.http}/v1/models", timeout=5).close()
                return
            except OSError:
                time.sleep(0.1)
        raise AssertionError(self.log.read_text())

    def stop(self):
        self.process.terminate()
        assert self.process.wait(30) == 0

    def gatsbi(self, *arguments):
        """Runs the command line."""
        program = os.environ.get("GATSBI", str(ROOT / "target/debug/gatsbi"))
        command = [program, "--server", f"http://{self.grpc}", "--json", *map(str, arguments)]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    def observe(self, session, first, end):
        """Replays recorded frames through a session."""
        self.gatsbi("observe", "--session", session, "--episode", SAMPLES, "--frames", f"{first}..{end}")


@pytest.fixture(scope="session")
def server(tmp_path_factory):
    server = Server(tmp_path_factory.mktemp("server"))
    yield server
    server.stop()


@pytest.fixture(scope="session")
def browser():
    with sync_playwright() as playwright:
        program = os.environ.get("CHROMIUM", "/usr/bin/chromium")
        browser = playwright.chromium.launch(executable_path=program, args=QUIET)
        yield browser
        browser.close()


@pytest.fixture
def open_page(browser, server):
    """Opens the page; what goes wrong in it fails the test."""
    wrong, contexts = [], []

    def open_page(path="", expected=(), **options):
        options = {"viewport": {"width": 1280, "height": 900}, "reduced_motion": "reduce"} | options
        context = browser.new_context(**options)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(20000)
        ignore = lambda text: any(part in text for part in expected)
        page.on("console", lambda message: message.type in ("error", "warning") and not ignore(message.text)
                and wrong.append(f"console: {message.text}"))
        page.on("pageerror", lambda error: wrong.append(f"error: {error}"))
        page.on("request", lambda request: request.url.startswith((f"http://{server.http}/", "data:", "blob:"))
                or wrong.append(f"elsewhere: {request.url}"))
        page.goto(f"http://{server.http}/{path}")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert not wrong, "\n".join(wrong)


@pytest.fixture(scope="session")
def shots():
    """Where screenshots go, to be looked at."""
    folder = Path(os.environ.get("GATSBI_SHOTS", ROOT / "target/page"))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def episode():
    """Frames `[T, 64, 64, 3]` and actions `[T, A]` of a recorded robot."""
    row = parquet.ParquetFile(SAMPLES).read_row_group(1).to_pylist()[0]
    frames = np.frombuffer(row["rgb"], np.uint8).reshape(row["length"], 64, 64, 3)
    actions = np.asarray(row["actions"], np.float32).reshape(row["length"], -1)
    return frames, actions
