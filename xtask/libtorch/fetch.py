"""Provides the files of a recipe: finds its packages (`wheels`, or source archives) through pip, downloads and checks them, unpacks what is named.

Usage: python3 - RECIPE DOWNLOADS TARGET      (RECIPE is the text of a recipe such as cpu.json)

pip is asked where a wheel lies, so its index, credentials, proxy and certificates apply; it is not asked to
fetch it, because it cannot resume a broken transfer and its dry run downloads the whole wheel unseen. A run
that was cut short leaves `DOWNLOADS/*.part` and `TARGET/*.unpacked` behind, and the next one continues there.

Progress goes to standard error. Standard output stays empty, or carries the one sentence that says what failed.
Standard library only; any Python from 3.7 on.
"""

import ast
import errno
import functools
import hashlib
import http.client
import json
import os
import re
import shutil
import ssl
import subprocess
import sys
import tarfile
import time
import urllib.error
import urllib.request
import zipfile
from pathlib import Path

MIB = 1 << 20
OLDEST_PYTHON = (3, 7)
OLDEST_PIP = (21, 2)  # the first with `pip index`
FRUITLESS_ATTEMPTS = 4
SOCKET_TIMEOUT_SECONDS = 60
AGAIN = "run the command again and it continues there"


class Failure(Exception):
    """What went wrong and what to do about it, in one sentence."""


class Refused(Exception):
    """The server answers, but not to us: pip may hold credentials or certificates that this script does not."""


def main(recipe, downloads, target):
    for folder in (downloads, target):
        folder.mkdir(parents=True, exist_ok=True)
    check_pip()
    check_space(recipe["disk_bytes"], downloads, target)
    for wheel in recipe["wheels"]:
        unpacked = target / (wheel["file"] + ".unpacked")
        if not unpacked.exists():
            part = downloads / (wheel["file"] + ".part")
            fetch(wheel, part)
            unpack(wheel, part, target)
            unpacked.touch()
            part.unlink()
    for unpacked in target.glob("*.unpacked"):
        unpacked.unlink()


def check_pip():
    if sys.version_info < OLDEST_PYTHON:
        raise Failure(f"{sys.executable} is too old: install Python 3.7 or newer with pip")
    answer = pip("--version")
    version = re.match(r"pip (\d+)\.(\d+)", answer.stdout)
    if answer.returncode != 0 or version is None:
        raise Failure(
            f"{sys.executable} has no pip: install it (on Debian and Ubuntu: apt install python3-pip)"
        )
    if (int(version[1]), int(version[2])) < OLDEST_PIP:
        raise Failure(
            f"{version[0]} is too old, 21.2 or newer is needed: run python3 -m pip install --upgrade pip"
        )


def check_space(disk_bytes, downloads, target):
    held = sum(p.stat().st_size for f in (downloads, target) for p in f.rglob("*") if p.is_file())
    needed, free = disk_bytes - held, shutil.disk_usage(target).free
    if free < needed:
        raise Failure(
            f"{target.parent} has {free / 1e9:.1f} GB free and {needed / 1e9:.1f} GB are needed: "
            "free some space, or name a folder on another disk in GATSBI_CACHE"
        )


def fetch(wheel, part):
    """Leaves the complete, checked wheel in `part`."""
    kept = part.stat().st_size if part.exists() else 0
    if kept > wheel["bytes"]:
        part.unlink()
        kept = 0
    if kept < wheel["bytes"]:
        url = locate(wheel)
        try:
            download(wheel, url, part)
        except Refused as refusal:
            download_with_pip(wheel, refusal, part)
    if sha256(part) == wheel["sha256"]:
        return
    part.unlink()
    if kept == 0:
        raise Failure(
            f"{wheel['file']} does not have the expected checksum (sha256 {wheel['sha256']}): "
            "the package index, or something on the way to it, serves another file"
        )
    say(f"the part of {wheel['file']} that an earlier run left is damaged: starting over")
    fetch(wheel, part)


def locate(wheel):
    """Asks pip for the address of the wheel."""
    name = wheel["file"].split("-")[0]
    # Many -v, because a `quiet` in the user's settings takes some away; pip then prints each link it considers.
    answer = pip("index", "versions", name, "-vvvvv", "--timeout", "20", "--retries", "1")
    link = re.search(r"\S+/" + re.escape(wheel["file"]), answer.stdout)
    if link is not None:
        return re.sub(r"//[^/@]*@", "//", link[0])  # pip prints credentials masked
    unreachable = re.search(r"Could not fetch URL (\S+): (.*) - skipping", answer.stdout)
    if unreachable is None:
        raise Failure(
            f"the package index that pip is set to does not offer {wheel['file']}: "
            f"see python3 -m pip index versions {name} -v"
        )
    system_error = re.search(r"\[Errno -?\d+\] ([^'\")]+)", unreachable[2])
    cause = system_error[1] if system_error else re.split(r": HTTPS?Conn", unreachable[2])[0]
    raise Failure(
        f"pip cannot reach {unreachable[1]} ({cause}): "
        "check the network, and pip's index-url, proxy and cert settings"
    )


def download(wheel, url, part):
    """Appends to `part` what it lacks, reconnecting where the transfer breaks off."""
    total = wheel["bytes"]
    progress = Progress(wheel)
    fruitless = 0
    while True:
        have = part.stat().st_size if part.exists() else 0
        reason = "the connection was closed"
        try:
            request = urllib.request.Request(url, headers={"Range": f"bytes={have}-"})
            with opener().open(request, timeout=SOCKET_TIMEOUT_SECONDS) as response:
                resumed = getattr(response, "status", None) == http.client.PARTIAL_CONTENT
                with part.open("ab" if resumed else "wb") as file:
                    progress.start(file.tell())
                    while file.tell() < total:
                        block = response.read(MIB // 16)
                        if not block:
                            break
                        file.write(block)
                        progress.show(file.tell())
        except (OSError, http.client.HTTPException) as error:
            cause = getattr(error, "reason", error)
            if (
                isinstance(cause, ssl.SSLCertVerificationError)
                or 400 <= getattr(error, "code", 0) < 500
            ):
                raise Refused(str(error)) from error
            if disk_full(error):
                raise
            reason = str(cause)
        now = part.stat().st_size if part.exists() else 0
        if now >= total:
            progress.finish()
            return
        fruitless = 0 if now > have else fruitless + 1
        if fruitless == FRUITLESS_ATTEMPTS:
            raise Failure(
                f"the download of {wheel['file']} broke off at {now // MIB} of {total // MIB} MiB "
                f"({reason}): {AGAIN}"
            )
        say(f"the download broke off at {now // MIB} MiB ({reason}): reconnecting")
        time.sleep(2**fruitless - 1)


def download_with_pip(wheel, refusal, part):
    """Lets pip itself fetch the wheel: not resumable, but with whatever opens the index to it."""
    say(f"the direct download is refused ({refusal}): leaving it to pip")
    if not wheel["file"].endswith(".whl"):
        raise Failure(f"the package index refuses {wheel['file']} ({refusal})")
    tags = wheel["file"][: -len(".whl")].split("-")
    wanted = ("--python-version", "3.11", "--implementation", "cp", "--abi", "cp311")
    platform = ("--platform", tags[-1].split(".")[0])
    command = ("download", "--no-deps", "--only-binary", ":all:", *wanted, *platform)
    pip(*command, "--dest", str(part.parent), f"{tags[0]}=={tags[1]}", stdout=sys.stderr)
    wheel_file = part.parent / wheel["file"]
    if not wheel_file.exists():
        raise Failure(f"the package index refuses {wheel['file']} ({refusal}), to pip as well")
    os.replace(wheel_file, part)


def unpack(wheel, part, target):
    say(f"unpacking {wheel['file']}")
    if wheel["file"].endswith(".tar.gz"):
        with tarfile.open(part, "r:gz") as archive:
            names = [member.name for member in archive.getmembers() if member.isfile()]
            unpack_members(wheel, names, archive.extractfile, target)
    else:
        with zipfile.ZipFile(part) as archive:
            names = [name for name in archive.namelist() if not name.endswith("/")]
            unpack_members(wheel, names, archive.open, target)


def unpack_members(wheel, names, open_member, target):
    for prefix, destination in wheel["members"].items():
        wanted = [name for name in names if name.startswith(prefix)]
        if not wanted:
            raise Failure(f"{wheel['file']} holds no {prefix}")
        for name in wanted:
            path = target / (destination + name[len(prefix) :])
            path.parent.mkdir(parents=True, exist_ok=True)
            with open_member(name) as source, path.open("wb") as file:
                shutil.copyfileobj(source, file, MIB)


class Progress:
    """A bar with rate and time left in a terminal, a line every few seconds otherwise."""

    def __init__(self, wheel):
        self.label = " ".join(wheel["file"].split("-")[:2])
        self.total = wheel["bytes"]
        self.terminal = sys.stderr.isatty()
        self.interval = 0.1 if self.terminal else 5.0
        self.shown = 0.0

    def start(self, have):
        self.began = self.shown = time.monotonic()
        self.had = have

    def show(self, have):
        now = time.monotonic()
        if now - self.shown >= self.interval:
            self.shown = now
            self.write(have, now)

    def finish(self):
        self.write(self.total, time.monotonic())
        if self.terminal:
            say("")

    def write(self, have, now):
        rate = (have - self.had) / max(now - self.began, 1e-3)
        left = (self.total - have) / rate if rate else 0
        text = (
            f"{self.label}: {have // MIB} of {self.total // MIB} MiB, {rate / MIB:.1f} MiB/s, "
            f"{left // 60:.0f}:{left % 60:02.0f} left"
        )
        if self.terminal:
            filled = "#" * (30 * have // self.total)
            sys.stderr.write(f"\r[{filled:30}] {text}\x1b[K")
            sys.stderr.flush()
        else:
            say(text)


def pip(*arguments, stdout=subprocess.PIPE):
    options = ["--no-input", "--no-color", "--disable-pip-version-check"]
    return subprocess.run(
        [sys.executable, "-m", "pip", *options, *arguments],
        check=False,
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
    )


@functools.lru_cache(maxsize=None)
def opener():
    """An opener of addresses that honours pip's `cert`, `client-cert` and `proxy`."""
    cert = pip_setting("cert")
    folder = cert is not None and os.path.isdir(cert)
    context = ssl.create_default_context(**{"capath" if folder else "cafile": cert})
    if pip_setting("client-cert"):
        context.load_cert_chain(pip_setting("client-cert"))
    handlers = [urllib.request.HTTPSHandler(context=context)]
    if pip_setting("proxy"):
        proxy = pip_setting("proxy")
        handlers.append(urllib.request.ProxyHandler({"http": proxy, "https": proxy}))
    return urllib.request.build_opener(*handlers)


@functools.lru_cache(maxsize=None)
def pip_setting(name):
    """One of pip's settings, from its environment variable or its configuration files."""
    from_environment = os.environ.get("PIP_" + name.upper().replace("-", "_"))
    if from_environment:
        return from_environment
    values = dict(
        line.split("=", 1) for line in pip("config", "list").stdout.splitlines() if "=" in line
    )
    written = values.get(f"download.{name}", values.get(f"global.{name}"))
    return ast.literal_eval(written) if written else None


def sha256(path):
    digest = hashlib.sha256()
    with path.open("rb") as file:
        for block in iter(lambda: file.read(MIB), b""):
            digest.update(block)
    return digest.hexdigest()


def disk_full(error):
    return getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)


def say(text):
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    try:
        main(json.loads(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]))
    except Failure as failure:
        print(failure)
        sys.exit(1)
    except OSError as error:
        if not disk_full(error):
            raise
        print(f"the disk that holds {sys.argv[2]} is full: free some space, then {AGAIN}")
        sys.exit(1)
    except KeyboardInterrupt:
        say(f"\ninterrupted: {AGAIN}")
        sys.exit(130)
