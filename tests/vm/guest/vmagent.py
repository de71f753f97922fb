"""Runs shell commands for the host over a virtio-serial port: one line of JSON in, one out.

in:  {"id": 1, "cmd": "...", "timeout": 60}
out: {"id": 1, "rc": 0, "out": "...", "err": "..."}; id 0 at the start. rc 124 = timed out, 125 = could not be run.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
import time
from typing import Any

PORT = open(sys.argv[1], "r+b", buffering=0)  # noqa: SIM115 - for as long as the machine lives
LOCK = threading.Lock()


def send(answer: dict[str, Any]) -> None:
    left = json.dumps(answer).encode() + b"\n"
    with LOCK:
        while left:
            left = left[PORT.write(left) or 0 :]


def text(output: bytes | None) -> str:
    return (output or b"").decode(errors="replace")


def run(ask: dict[str, Any]) -> None:
    try:
        done = subprocess.run(
            ["/bin/bash", "-c", ask["cmd"]],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=ask.get("timeout", 60),
            start_new_session=True,
        )
        rc, out, err = done.returncode, done.stdout, done.stderr
    except subprocess.TimeoutExpired as e:
        rc, out, err = 124, e.stdout or b"", e.stderr or b""
    except OSError as e:
        rc, out, err = 125, b"", str(e).encode()
    send({"id": ask["id"], "rc": rc, "out": text(out), "err": text(err)})


send({"id": 0, "hello": os.uname().release})
if "NOTIFY_SOCKET" in os.environ:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
        notify.sendto(b"READY=1", os.environ["NOTIFY_SOCKET"])
pending = b""
while True:
    data = PORT.read(65536)
    if not data:  # the host's side is closed: wait for it to come back
        time.sleep(0.05)
        continue
    pending += data
    *lines, pending = pending.split(b"\n")
    for line in lines:
        if line.strip():
            threading.Thread(target=run, args=(json.loads(line),), daemon=True).start()
