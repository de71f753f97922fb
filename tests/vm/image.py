"""Builds the virtual machine's image: kernel, initial RAM disk and root file system of a stock Debian 12.

The image holds nothing of the project: systemd, udev, can-utils and Python, so a test begins on an empty gateway. It is
cached outside of the repository under a key of all that goes in (this file, `guest/`, the package list, the kernel's
version) and takes about a minute to build, as root or as a user with subuids. Debian's mirror, reached through apt, is
needed for that; where something of it fails, it is a RuntimeError with the reason.

The kernel is Debian's `linux-image-amd64` (the cloud one has no CAN), unpacked only: its modules are copied, its
vmlinux is taken out of the bzImage, since unpacking that under emulation takes seconds.
"""

from __future__ import annotations

import hashlib
import io
import lzma
import os
import re
import shutil
import struct
import subprocess
import tarfile
from collections.abc import Callable, Sequence
from pathlib import Path

GUEST = Path(__file__).resolve().parent / "guest"
SUITE = "bookworm"
# numpy's wheels need libstdc++6, which a minimal Debian does not have
PACKAGES = (
    "systemd",
    "systemd-sysv",
    "udev",
    "kmod",
    "iproute2",
    "can-utils",
    "python3",
    "python3-venv",
    "dbus",
    "procps",
    "libstdc++6",
)
SIZE = "1536M"
BOOT_MODULES = ("virtio_pci", "virtio_blk", "ext4", "crc32c_generic")
# A name with a slash is a folder of the kernel's tree.
ROOT_MODULES = (
    "kernel/net/can",
    "kernel/drivers/net/can",
    "9p",
    "9pnet_virtio",
    "overlay",
    "fuse",
    "loop",
    "virtio_console",
    "virtio-rng",
    "virtio_pci",
    "virtio_blk",
    "ext4",
    "crc32c_generic",
    "xhci_pci",
    "usbserial",
    "ftdi_sio",
    "cp210x",
    "pl2303",
    "ch341",
    "cdc_acm",
    "i6300esb",
    "autofs4",
    "qemu_fw_cfg",
)
# Of the kernel package: what those and their dependencies may lie in.
KERNEL_PARTS = (
    "./boot/vmlinuz*",
    "./lib/modules/*/modules.*",
    *(f"./lib/modules/*/kernel/{d}/*" for d in ("net", "fs", "lib", "crypto", "arch")),
    *(
        f"./lib/modules/*/kernel/drivers/{d}/*"
        for d in ["net/can", "virtio", "block", "char", "usb", "watchdog", "tty", "nvdimm"]
    ),
)
# Units that only cost time in a test.
MASKED = (
    "systemd-binfmt.service",
    "proc-sys-fs-binfmt_misc.automount",
    "modprobe@dm_mod.service",
    "modprobe@loop.service",
    "modprobe@efi_pstore.service",
    "modprobe@drm.service",
    "modprobe@configfs.service",
    "modprobe@fuse.service",
    "systemd-pstore.service",
    "e2scrub_reap.service",
    "getty.target",
    "getty@.service",
    "serial-getty@.service",
    "apt-daily.timer",
    "apt-daily-upgrade.timer",
    "dpkg-db-backup.timer",
    "fstrim.timer",
    "e2scrub_all.timer",
    "sys-kernel-tracing.mount",
    "dev-hugepages.mount",
)

Say = Callable[[str], None]


def cache_dir() -> Path:
    """Where images, snapshots and wheels are kept between runs."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "edge-agent-vm"


def build(say: Say) -> Path:
    """The folder of the image: vmlinux, initrd.cpio, base.qcow2. Built where it is not in the cache."""
    kernel = _kernel_package()
    digest = hashlib.sha256(f"{kernel} {SUITE}".encode())
    for path in (Path(__file__), *sorted(GUEST.glob("*"))):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    out = cache_dir() / f"image-{digest.hexdigest()[:16]}"
    if (out / "base.qcow2").exists():
        return out
    say(f"building the image {out} ({kernel}), about a minute")
    work = out.with_suffix(".work")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    try:
        try:
            _make(work, kernel)
        except RuntimeError as e:  # a mirror has its bad moments
            say(f"once more: {e}")
            shutil.rmtree(work)
            work.mkdir()
            _make(work, kernel)
        for name in ("vmlinux", "initrd.cpio", "base.qcow2"):
            out.mkdir(exist_ok=True)
            os.replace(work / name, out / name)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return out


def _make(work: Path, kernel: str) -> None:
    _kernel(work, kernel)
    _root(work)


def _run(command: Sequence[str | Path], cwd: Path | None = None) -> str:
    env = os.environ | ({"TMPDIR": str(cwd)} if cwd else {})
    done = subprocess.run(
        command, cwd=cwd, env=env, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace"
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, command))}: code {done.returncode}\n{done.stdout}\n{done.stderr}")
    return done.stdout


def _kernel_package() -> str:
    found = re.search(r"Depends: (linux-image-\S+)", _run(["apt-cache", "depends", "linux-image-amd64"]))
    if found is None:
        raise RuntimeError("apt knows no kernel: apt-get update")
    return found[1]


# -------------------------------------------------------------------------------------------------------------- kernel


def _kernel(work: Path, package: str) -> None:
    """vmlinux and initrd.cpio, and modules.tar for the root file system."""
    release = package.removeprefix("linux-image-")
    _run(["apt-get", "download", package, "busybox-static"], cwd=work)
    deb, busybox = next(work.glob("linux-image-*.deb")), next(work.glob("busybox-static_*.deb"))
    for archive, parts in ((deb, KERNEL_PARTS), (busybox, ("./bin/busybox",))):
        (work / "data.tar").write_bytes(
            subprocess.run(["dpkg-deb", "--fsys-tarfile", archive], check=True, capture_output=True).stdout
        )
        (work / "k").mkdir(exist_ok=True)
        # A folder that this kernel does not have is no mistake: the modules that are needed are looked up below.
        subprocess.run(
            ["tar", "-C", "k", "-xf", "data.tar", "--wildcards", *parts],
            cwd=work,
            stderr=subprocess.DEVNULL,
            check=False,
        )
        (work / "data.tar").unlink()
    modules = Modules(work / "k", release)
    boot, root = modules.closure(BOOT_MODULES), modules.closure(ROOT_MODULES)
    (work / "vmlinux").write_bytes(_vmlinux((work / f"k/boot/vmlinuz-{release}").read_bytes()))
    (work / "initrd.cpio").write_bytes(_initrd(modules, boot, (work / "k/bin/busybox").read_bytes()))
    with tarfile.open(work / "modules.tar", "w") as tar:
        for path in [modules.path(n) for n in root] + sorted(modules.base.glob("modules.*")):
            entry = tarfile.TarInfo(f"usr/{path.relative_to(work / 'k')}")
            data = path.read_bytes()
            entry.size, entry.mode = len(data), 0o644
            tar.addfile(entry, io.BytesIO(data))


class Modules:
    """The kernel's modules and what they depend on, read from the modules themselves."""

    def __init__(self, root: Path, release: str) -> None:
        self.root = root
        self.base = root / "lib/modules" / release
        self._files = {p.stem.replace("-", "_"): p for p in self.base.glob("kernel/**/*.ko")}
        if not self._files:
            raise RuntimeError("the modules of this kernel are compressed; that of Debian 12 is needed")

    def path(self, name: str) -> Path:
        return self._files[name]

    def closure(self, wanted: Sequence[str]) -> list[str]:
        """The modules of `wanted` and all that they need, in an order in which they can be loaded."""
        order: list[str] = []
        seen: set[str] = set()

        def add(name: str) -> None:
            name = name.replace("-", "_")
            if name in seen or name not in self._files:  # built in
                return
            seen.add(name)
            for need in self._needs(name):
                add(need)
            order.append(name)

        for name in wanted:
            if "/" in name:
                for inside, path in sorted(self._files.items()):
                    if str(path.relative_to(self.base)).startswith(name):
                        add(inside)
            else:
                add(name)
        return order

    def _needs(self, name: str) -> list[str]:
        data = self._files[name].read_bytes()
        found = [n for m in re.finditer(rb"\0depends=([^\0]*)\0", data) for n in m[1].decode().split(",")]
        for m in re.finditer(rb"\0softdep=([^\0]*)\0", data):
            found += re.sub(r"(pre|post):", "", m[1].decode()).split()
        return [n for n in found if n]


def _vmlinux(bzimage: bytes) -> bytes:
    """The kernel itself, by the payload fields of the x86 boot protocol's header."""
    offset, length = struct.unpack_from("<II", bzimage, 0x248)
    begin = (bzimage[0x1F1] + 1) * 512 + offset
    return lzma.LZMADecompressor().decompress(bzimage[begin : begin + length])  # 4 bytes of size follow the stream


def _initrd(modules: Modules, boot: Sequence[str], busybox: bytes) -> bytes:
    """A cpio archive (newc) with busybox, `guest/init` and the modules that the root file system needs."""
    paths = {str(modules.path(n).relative_to(modules.root)): modules.path(n).read_bytes() for n in boot}
    folders = sorted({"/".join(p.split("/")[:i]) for p in paths for i in range(1, p.count("/") + 1)})
    entries = [(d, 0o40755, b"") for d in ("bin", "proc", "sys", "dev", "r", *folders)]
    entries += [("init", 0o100755, (GUEST / "init").read_bytes()), ("bin/busybox", 0o100755, busybox)]
    entries += [("mods", 0o100644, "".join(f"{p}\n" for p in paths).encode())]
    entries += [(p, 0o100644, data) for p, data in paths.items()]
    out = bytearray()
    for i, (name, mode, data) in enumerate([*entries, ("TRAILER!!!", 0, b"")]):
        numbers = (i + 1, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(name) + 1, 0)
        for part in (b"070701" + b"".join(b"%08X" % n for n in numbers) + name.encode() + b"\0", data):
            out += part + b"\0" * (-len(part) % 4)
    return bytes(out)


# ---------------------------------------------------------------------------------------------------- root file system


def _root(work: Path) -> None:
    """base.qcow2: an ext4 of a minimal Debian with `PACKAGES`, the modules and the command agent."""
    units = "$1/etc/systemd/system"
    hook = [
        "#!/bin/sh",
        "set -e",
        'chroot "$1" depmod "$(ls "$1/lib/modules")"',
        *(f'ln -sf /dev/null "{units}/{u}"' for u in MASKED),
        f'ln -sf /lib/systemd/system/multi-user.target "{units}/default.target"',
        f'mkdir -p "{units}/multi-user.target.wants"',
        f'ln -sf ../vmagent.service "{units}/multi-user.target.wants/"',
        'echo testvm > "$1/etc/hostname"',
        'echo 0123456789abcdef0123456789abcdef > "$1/etc/machine-id"',
        'echo "/dev/vda / ext4 defaults,errors=remount-ro 0 1" > "$1/etc/fstab"',
        'chroot "$1" python3 -m compileall -q /usr/lib/python3 /usr/lib/python3.11 >/dev/null 2>&1 || true',
    ]
    (work / "hook").write_text("\n".join(hook) + "\n")
    (work / "hook").chmod(0o755)
    _run(
        [
            "mmdebstrap",
            "--quiet",
            "--variant=minbase",
            f"--include={','.join(PACKAGES)}",
            *(f"--dpkgopt=path-exclude=/usr/share/{d}/*" for d in ("man", "doc", "locale")),
            '--aptopt=Acquire::Languages "none"',
            f"--customize-hook=tar-in {work}/modules.tar /",
            f"--customize-hook=upload {GUEST}/vmagent.py /usr/local/lib/vmagent.py",
            f"--customize-hook=upload {GUEST}/vmagent.service /etc/systemd/system/vmagent.service",
            f'--customize-hook={work}/hook "$1"',
            SUITE,
            str(work / "root.tar"),
        ],
        cwd=work,
    )
    disk = (
        f"mkdir r && tar -C r -xf root.tar --exclude='./dev/*' && truncate -s {SIZE} disk.raw && "
        "/sbin/mke2fs -q -t ext4 -L root -E lazy_itable_init=0,root_owner=0:0 -d r disk.raw && rm -rf r"
    )
    as_root = [] if os.geteuid() == 0 else ["unshare", "--map-auto", "--map-root-user"]
    _run([*as_root, "bash", "-c", disk], cwd=work)
    _run(["qemu-img", "convert", "-O", "qcow2", work / "disk.raw", work / "base.qcow2"])
