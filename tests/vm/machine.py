"""A virtual machine in QEMU with what a gateway has: systemd, a CAN card, 16550A serial ports, USB serial, watchdog.

    with Machine.fresh(image, share=folder, out=folder) as vm:
        vm.sh("systemctl is-system-running")
        gnss = vm.port("ttyS1")

Needs neither root nor KVM. `fresh` restores a snapshot of the booted system, which is made on the first use and cached
beside the image. The guest sees `share` as /mnt/share, read-only, and `out` as /mnt/out. QEMU does not pace serial
input by the baud rate: the host must. can0 and can1 are two SJA1000 cards on one bus.

Every wait here is patient: under emulation, on a host with other work, a second may become a minute.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

BOOT_S = 600.0  # 10 s on a quiet machine; more with other work beside it
COMMAND_S = 600.0  # of a command in the guest; most take 0.1 s
QEMU_S = 300.0  # until QEMU opens its sockets


@dataclass(frozen=True, slots=True)
class Done:
    """How a command in the guest ended."""

    rc: int
    out: str
    err: str


class GuestError(RuntimeError):
    """A command in the guest failed; the text has its output."""


EMULATION = ("-accel", "tcg,thread=multi,tb-size=256", "-cpu", "max")


def accelerator() -> tuple[str, ...]:
    """KVM where the processor has it, else emulation. /dev/kvm alone proves nothing: a software KVM has no vmx or svm,
    and a stock kernel does not start on it."""
    hardware = any(f" {flag}" in Path("/proc/cpuinfo").read_text() for flag in ("vmx", "svm"))
    if hardware and os.access("/dev/kvm", os.R_OK | os.W_OK):
        return ("-accel", "kvm", "-cpu", "host")
    return EMULATION


def _command(image: Path, disk: Path, folder: Path, share: Path, out: Path, accel: Sequence[str]) -> list[str]:
    """QEMU's command line; its devices belong to the snapshot."""

    def channel(name: str) -> list[str]:
        return ["-chardev", f"socket,id={name},path={folder}/{name}.sock,server=on,wait=off"]

    def files(tag: str, path: Path, more: str) -> list[str]:
        return ["-virtfs", f"local,path={path},mount_tag={tag},security_model=none,multidevs=remap{more}"]

    return [
        *("qemu-system-x86_64", "-M", "q35", *accel, "-smp", "2", "-m", "1024"),
        *("-nodefaults", "-no-user-config", "-display", "none", "-no-reboot", "-nic", "none"),
        *("-kernel", f"{image}/vmlinux", "-initrd", f"{image}/initrd.cpio"),
        *("-append", "console=ttyS0 root=/dev/vda panic=-1 quiet"),
        *(
            "-drive",
            f"file={disk},format=qcow2,if=none,id=disk,cache=writeback",
            "-device",
            "virtio-blk-pci,drive=disk",
        ),
        *("-chardev", f"file,id=console,path={folder}/console.log", "-serial", "chardev:console"),  # ttyS0
        *(*channel("ttyS1"), "-serial", "chardev:ttyS1", *channel("ttyS2"), "-serial", "chardev:ttyS2"),
        *(*channel("agent"), "-device", "virtio-serial-pci"),
        *("-device", "virtserialport,chardev=agent,name=test.exec"),
        *(*channel("clock"), "-device", "virtserialport,chardev=clock,name=test.clock"),
        *(*channel("usb0"), "-device", "qemu-xhci,id=xhci"),
        *("-object", "can-bus,id=bus"),
        *("-device", "kvaser_pci,canbus=bus", "-device", "kvaser_pci,canbus=bus"),
        *("-device", "i6300esb", "-action", "watchdog=reset"),
        *("-object", "rng-random,id=random,filename=/dev/urandom", "-device", "virtio-rng-pci,rng=random"),
        *files("share", share, ",readonly=on"),
        *files("out", out, ""),
        *("-qmp", f"unix:{folder}/qmp.sock,server=on,wait=off"),
    ]


class Machine:
    """One running machine; close it, or use it as a context."""

    accel = accelerator()  # emulation once the processor's help has failed

    def __init__(self, image: Path, disk: Path, share: Path, out: Path, snapshot: str = "") -> None:
        self.disk = disk
        self.folder = Path(tempfile.mkdtemp(prefix="edge-agent-vm-"))
        self._numbers = itertools.count(1)
        self._qmp: tuple[socket.socket, Any] | None = None
        with (self.folder / "qemu.log").open("wb") as log:
            self._process = subprocess.Popen(
                [
                    *_command(image, disk, self.folder, share, out, self.accel),
                    *(["-loadvm", snapshot] if snapshot else []),
                ],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        try:
            self._agent = self.port("agent")
            self._answers = self._agent.makefile("rb")
        except BaseException:
            self.close()
            raise

    # ---------------------------------------------------------------------------------------------------- how it starts

    @classmethod
    def boot(cls, image: Path, disk: Path, share: Path, out: Path) -> Machine:
        """A real boot of a disk."""

        def start() -> Machine:
            machine = cls(image, disk, share, out)
            try:
                machine._answer(BOOT_S)
            except BaseException:
                machine.close()
                raise
            return machine

        return cls._twice(start)

    @classmethod
    def fresh(cls, image: Path, share: Path, out: Path) -> Machine:
        """A machine just booted, on a disk of its own that goes away with it."""

        def start() -> Machine:
            nowhere = Path("/nonexistent")
            line = " ".join(_command(image, nowhere, nowhere, nowhere, nowhere, cls.accel))
            ready = image / f"ready-{hashlib.sha256(line.encode()).hexdigest()[:16]}.qcow2"
            if not ready.exists():
                cls._make_ready(image, ready, share, out)
            folder = Path(tempfile.mkdtemp(prefix="edge-agent-disk-"))
            disk = folder / "disk.qcow2"
            try:
                subprocess.run(["cp", "--sparse=always", "--reflink=auto", ready, disk], check=True)
                machine = cls(image, disk, share, out, "ready")
            except BaseException:
                shutil.rmtree(folder)
                raise
            machine._own = folder
            try:
                machine.set_clock()
                machine.mount()
            except BaseException:
                machine.close()
                raise
            return machine

        return cls._twice(start)

    @classmethod
    def _twice(cls, start: Callable[[], Machine]) -> Machine:
        """A machine that does not come up gets a second chance, without the processor's help."""
        try:
            return start()
        except (OSError, RuntimeError, ValueError, subprocess.CalledProcessError) as e:
            print(f"the machine did not come up, once more: {e}", file=sys.stderr, flush=True)
            cls.accel = EMULATION
            return start()

    @classmethod
    def _make_ready(cls, image: Path, ready: Path, share: Path, out: Path) -> None:
        """Boot the image once and keep it as it stands; a mounted share or a USB device would forbid that."""
        new = ready.with_suffix(".new")
        base = str(image / "base.qcow2")
        subprocess.run(["qemu-img", "create", "-q", "-f", "qcow2", "-b", base, "-F", "qcow2", new], check=True)
        with cls.boot(image, new, share, out) as machine:
            machine.sh(
                "systemctl is-system-running --wait || true; modprobe -a 9p 9pnet_virtio; sync", timeout=2 * BOOT_S
            )
            answer = machine.monitor("savevm ready")
            if answer:
                raise RuntimeError(f"QEMU made no snapshot: {answer}")
            machine.power_cut()
        os.replace(new, ready)

    # --------------------------------------------------------------------------------------------------- what it can do

    def run(self, command: str, timeout: float = COMMAND_S) -> Done:
        """Run a shell command in the guest."""
        number = next(self._numbers)
        self._agent.sendall(json.dumps({"id": number, "cmd": command, "timeout": timeout}).encode() + b"\n")
        while True:
            answer = self._answer(timeout + 60)
            if answer.get("id") == number:
                return Done(answer["rc"], answer["out"], answer["err"])

    def _answer(self, timeout: float) -> dict[str, Any]:
        """The next line that the guest says."""
        self._agent.settimeout(timeout)
        try:
            line = self._answers.readline()
        except ConnectionError:
            line = b""
        if not line:
            raise RuntimeError(f"QEMU ended: {(self.folder / 'qemu.log').read_text()}")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def sh(self, command: str, timeout: float = COMMAND_S) -> str:
        """Run a shell command in the guest; its output. Raises GuestError where it fails."""
        done = self.run(command, timeout)
        if done.rc:
            raise GuestError(f"{command}: code {done.rc}\n{done.out}{done.err}")
        return done.out

    def mount(self) -> None:
        """Make `share` and `out` visible in the guest."""
        mount = "mount -t 9p -o trans=virtio,version=9p2000.L,msize=262144"
        self.sh(f"mkdir -p /mnt/share /mnt/out && {mount},ro share /mnt/share && {mount} out /mnt/out")

    def set_clock(self) -> None:
        """The host's wall time: after a restore the guest has that of the snapshot."""
        self.sh(f"date -s @{time.time():.3f}")

    def port(self, name: str) -> socket.socket:
        """The host's end of ttyS1, ttyS2, usb0, clock."""
        end_s = time.monotonic() + QEMU_S
        while time.monotonic() < end_s:
            if self._process.poll() is not None:
                raise RuntimeError(f"QEMU ended: {(self.folder / 'qemu.log').read_text()}")
            end = socket.socket(socket.AF_UNIX)
            try:
                end.connect(f"{self.folder}/{name}.sock")
            except OSError:
                end.close()
                time.sleep(0.05)
            else:
                return end
        raise TimeoutError(f"QEMU does not open {name}")

    def qmp(self, execute: str, **arguments: Any) -> Any:
        """One command to QEMU itself."""
        if self._qmp is None:
            control = self.port("qmp")
            self._qmp = control, control.makefile("rb")
            self._qmp[1].readline()
            self.qmp("qmp_capabilities")
        control, answers = self._qmp
        control.sendall(json.dumps({"execute": execute, "arguments": arguments}).encode() + b"\n")
        while True:
            answer = json.loads(answers.readline())
            if "error" in answer:
                raise RuntimeError(str(answer))
            if "return" in answer:
                return answer["return"]

    def monitor(self, line: str) -> str:
        """One line to QEMU's monitor."""
        return str(self.qmp("human-monitor-command", **{"command-line": line}))

    def plug_usb(self, serial: str) -> socket.socket:
        """Plug an FTDI serial adapter; the host's end of it. `unplug_usb` takes it out."""
        end = self.port("usb0")
        self.qmp("device_add", driver="usb-serial", id="usb0", chardev="usb0", serial=serial, bus="xhci.0")
        return end

    def unplug_usb(self) -> None:
        self.qmp("device_del", id="usb0")

    def power_cut(self) -> int:
        """What a pulled plug does. The host's monotonic ns of it."""
        self._process.kill()
        cut_ns = time.monotonic_ns()
        self._process.wait()
        return cut_ns

    @property
    def pid(self) -> int:
        """QEMU's process."""
        return self._process.pid

    _own: Path | None = None

    def close(self) -> None:
        if self._process.poll() is None:
            self.power_cut()
        shutil.rmtree(self.folder, ignore_errors=True)
        if self._own is not None:
            shutil.rmtree(self._own, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
