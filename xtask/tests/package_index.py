"""A package index with one small wheel and, where asked for, bad manners.

Usage: python3 package_index.py FOLDER [--slice N] [--until N] [--no-range] [--refuse-direct]

Writes the wheel and a log of its requests (`requests`, one `Range` header a line) into FOLDER, prints one line
of JSON (`url`, `file`, `bytes`, `sha256`) and serves until it is killed.
"""

import argparse
import hashlib
import json
import random
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

NAME = "gatsbi_sample-1.0-py3-none-manylinux_2_17_x86_64.whl"


def make_wheel(path):
    info = "gatsbi_sample-1.0.dist-info"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("sample/lib/one.so", random.Random(1).randbytes(300_000))
        archive.writestr("sample/include/two.h", "#pragma once\n")
        archive.writestr("sample/python/three.py", "pass\n")
        archive.writestr(
            f"{info}/METADATA", "Metadata-Version: 2.1\nName: gatsbi-sample\nVersion: 1.0\n"
        )
        archive.writestr(
            f"{info}/WHEEL",
            "Wheel-Version: 1.0\nRoot-Is-Purelib: false\nTag: py3-none-manylinux_2_17_x86_64\n",
        )
        archive.writestr(f"{info}/RECORD", "")


class Handler(BaseHTTPRequestHandler):
    def do_GET(self):
        if self.path == "/simple/gatsbi-sample/":
            page = f'<!DOCTYPE html><a href="/files/{NAME}#sha256={self.server.sha256}">{NAME}</a>'
            self.answer(200, page.encode(), {"Content-Type": "text/html"})
        elif self.path == f"/files/{NAME}":
            self.send_wheel()
        else:
            self.answer(404, b"")

    def send_wheel(self):
        manners, wheel = self.server.manners, self.server.wheel
        wanted = self.headers.get("Range")
        with (manners.folder / "requests").open("a") as log:
            log.write(f"{wanted}\n")
        if manners.refuse_direct and not self.headers.get("User-Agent", "").startswith("pip/"):
            self.answer(403, b"")
            return
        start = 0 if manners.no_range or wanted is None else int(wanted[len("bytes=") : -1])
        end = min(start + manners.slice, max(manners.until, start), len(wheel))
        status = 200 if manners.no_range else 206
        range_header = {"Content-Range": f"bytes {start}-{len(wheel) - 1}/{len(wheel)}"}
        self.answer(status, wheel[start:end], range_header, length=len(wheel) - start)

    def answer(self, status, body, headers=None, length=None):
        self.send_response(status)
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body) if length is None else length))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--slice", type=int, default=1 << 30, help="bytes sent over one connection")
    parser.add_argument("--until", type=int, default=1 << 30, help="bytes of the wheel ever sent")
    parser.add_argument("--no-range", action="store_true")
    parser.add_argument("--refuse-direct", action="store_true", help="serve pip only")
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.manners = parser.parse_args()
    path = server.manners.folder / NAME
    if not path.exists():
        make_wheel(path)
    server.wheel = path.read_bytes()
    server.sha256 = hashlib.sha256(server.wheel).hexdigest()
    url = f"http://127.0.0.1:{server.server_port}/simple"
    facts = {"url": url, "file": NAME, "bytes": len(server.wheel), "sha256": server.sha256}
    print(json.dumps(facts), flush=True)
    server.serve_forever()
