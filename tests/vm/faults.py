"""Faults on the running service, one after another, and the table of what they did.

    fault | detected in | recovered in | lost

All of it is measured in the recordings, on the guest's monotonic clock. Detected: the first that the agent says of the
fault (systemd, where the agent cannot), counted from the fault. Recovered: the first data after it, counted from the
fault's end. Lost: data that were there to be had and are in no file, in seconds around the fault. The figures are those
of an emulated processor and are told, not judged. Judged is that each fault is told, that the data come again by
themselves, and that no block is missing in silence.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
import yaml
from machine import Machine
from session import DATA, SERVICE, Session, Wire, say, stored, waited

from edge_agent.messages import CanFlag, CanFrames, S
from edge_agent.recording import cdr, reader, topics

USB = "GPS0001"
BY_ID = f"/dev/serial/by-id/usb-QEMU_QEMU_USB_SERIAL_{USB}-if00-port0"
WATCHDOG_S = 45  # instead of the unit's 90
CARD_MB = 48  # of the small disk that gets full
HOLD_S = 8.0  # longer than record.fsync_s
SLOW_S = 15.0  # in which the recordings' growth is measured
PEAK_MB = 150  # the process, with record.ring_mb and the queues at their defaults
KEPT = "/var/lib/kept"
CARD = "/var/tmp/card.img"
MOUNT = f"mount -o loop,errors=remount-ro {CARD} {DATA}"
PORTS = ("gnss", "can", "adapter")
DROP_IN = f"/run/systemd/system/{SERVICE}.service.d"
ROW = "      {:<36} {:>11} {:>12}   {}"


@dataclass
class Fault:
    """One row of the table; times are monotonic ns of the guest, since its boot."""

    name: str
    ports: tuple[str, ...]  # whose data it interrupts
    kinds: tuple[str, ...] = ()  # what the agent says of it, on /faults or /events
    source: str = ""  # and of whom, where not of the port
    back: tuple[str, ...] = ()  # kinds that say it is over, where data are no sign of it
    begin_ns: int = 0
    end_ns: int = 0
    told_ns: int = 0  # where no recording can say it,
    over_ns: int = 0  # nor this


@dataclass
class Recorded:
    """What the files of some runs say."""

    times: dict[str, npt.NDArray[np.int64]]  # port -> ns of its frames, or of its reads
    said: list[tuple[int, str, str]]  # ns, kind, source
    holes: list[tuple[int, int]]  # raw blocks that are in no file: when the next one came that is, how many
    losses: int  # of raw data, as /faults tells


@dataclass
class Course:
    """The session while faults are done to it."""

    s: Session
    gnss: Wire  # a USB adapter; the CAN cards are played in the guest
    adapter: Wire  # an slcan adapter, which the kernel's own driver makes slcan0
    faults: list[Fault] = field(default_factory=list)

    def at(self, command: str = ":") -> int:
        """Do something in the guest; its monotonic ns just before, to 10 ms."""
        out = self.s.vm.sh(f"read -r up _ </proc/uptime; {{ {command}; }} >/dev/null && echo $up")
        return round(float(out) * S)

    def begin(self, fault: Fault, command: str = ":") -> Fault:
        say(f"fault: {fault.name}")
        self.s.journal()
        fault.begin_ns = fault.end_ns = self.at(command)
        self.faults.append(fault)
        return fault

    def lasts(self, fault: Fault, end: Callable[[], int]) -> None:
        """Let a port's fault last until its silence is told, end it, and wait for the data."""
        (port,) = fault.ports
        silent = self.s.told(rf"(?m)^{port}: SILENT")
        fault.end_ns = end()
        good = self.s.told(rf"(?m)^{port}: OK") and silent and self.alive()
        self.s.tally.row(good, f"{fault.name}: over by itself", "SILENT, then OK in the journal")

    def alive(self) -> bool:
        return self.s.show("ActiveState")["ActiveState"] == "active"

    def records(self) -> bool:
        """Wait until the service runs, has a file open and hears the CAN card, and let it record that."""
        good = self.s.ready() < float("inf") and waited(lambda: self.s.vm.run(f"ls {DATA}/*.part").rc == 0)
        good = good and waited(lambda: "can OK" in self.s.show("StatusText")["StatusText"])
        time.sleep(4)
        return good

    def collect(self, name: str) -> None:
        """Copy the files out; one that the disk did not let end is good up to its last whole chunk."""
        self.s.vm.sh(f"mkdir -p /mnt/out/{name}; cp {DATA}/*.mcap {DATA}/*.part /mnt/out/{name}/ || true")

    def noted(self, fault: Fault, text: str) -> None:
        """Keep when something was said after the fault, by the service or by systemd of it."""
        fault.told_ns = self.said_ns(text, fault.begin_ns)

    def said_ns(self, text: str, from_ns: int) -> int:
        """When the journal first has it from some time on; 0 = not."""
        for line in self.s.vm.sh(f"journalctl -b -n 300 -o json --no-pager -u {SERVICE}").splitlines():
            entry = json.loads(line)
            t_ns = int(entry["__MONOTONIC_TIMESTAMP"]) * 1000
            if t_ns >= from_ns and text in str(entry.get("MESSAGE", "")):
                return t_ns
        return 0

    def host_offset_ns(self) -> int:
        """The guest's monotonic clock minus the host's."""
        best = (1 << 62, 0)
        for _ in range(5):
            before = time.monotonic_ns()
            guest = self.at()
            after = time.monotonic_ns()
            best = min(best, (after - before, guest - (before + after) // 2))
        return best[1]


def prepared(s: Session, site: str, dbc: str) -> None:
    """The receiver is on a USB adapter now, which is not plugged yet, and slcan0 is of the kernel's driver."""
    tree = yaml.safe_load(site)
    tree["ports"]["gnss"]["device"] = BY_ID
    tree["record"] = {"free_gb": 0.1}  # the disk is small: nothing shall go for want of space
    tree["ports"]["adapter"] = {"kind": "can", "interface": "socketcan", "channel": "slcan0"}
    (s.share / "faults.yaml").write_text(yaml.safe_dump(tree, sort_keys=False))
    disk = s.share / "card.img"
    disk.write_bytes(b"")
    os.truncate(disk, CARD_MB << 20)
    mke2fs = shutil.which("mke2fs", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin") or "mke2fs"
    subprocess.run([mke2fs, "-q", "-t", "ext4", disk], check=True, stdin=subprocess.DEVNULL)
    (s.share / "vm.dbc").write_text(dbc)
    s.vm.sh("cp /mnt/share/faults.yaml /etc/edge-agent/site.yaml; cp /mnt/share/vm.dbc /etc/edge-agent/")
    s.vm.sh(f"cp --sparse=always /mnt/share/card.img {CARD}")
    s.vm.sh("slcand -o -s6 -S 115200 /dev/ttyS2 slcan0; sleep 1; ip link set slcan0 up")
    # the adapter passes for a receiver, whose numbers it does not have
    rule = 'SUBSYSTEM=="tty", ENV{ID_VENDOR_ID}=="0403", ENV{EDGE_GNSS}="1"'
    s.vm.sh(f"mkdir -p /run/udev/rules.d; echo '{rule}' >/run/udev/rules.d/79-test.rules; udevadm control --reload")
    s.vm.sh("systemctl daemon-reload")


def course(c: Course, reboot: Callable[[], Machine], everything: bool) -> None:
    """The faults in turn, then the table; not `everything`: a late adapter, SIGSTOP and the power cut."""
    if not everything:
        watched(c)
    late_adapter(c)
    is_visible(c)
    if everything:
        for part in (interface_down, interface_removed, bus_off, usb_replugged, clock_steps):
            part(c)
        seen = c.s.show("NRestarts")["NRestarts"]
        c.s.tally.row(seen == "0", "through all of this the process ran on", f"{seen} restarts")
        stopped(c)
        disk_full(c)
        forced_read_only(c)
        disk_slow(c)
        takes_little_memory(c)
        read_only(c)
        folder_deleted(c)
        watched(c)
    ended(c, ENDS if everything else ENDS[-1:])
    power_cut(c, reboot)


# ----------------------------------------------------------------------------------------------------------- the ports


def late_adapter(c: Course) -> None:
    """A USB adapter that is plugged after the start: the device list of the sandbox lets it in, the rules name it."""
    vm, row = c.s.vm, c.s.tally.row
    c.s.journal()
    seconds = c.s.starts()
    row(seconds < float("inf"), "READY with a receiver that is not there", f"{seconds:.1f} s")
    c.s.told(r"(?m)^gnss: SILENT")
    vm.plug_usb(USB)
    short = f"/dev/gnss-{USB}-00"
    there = waited(lambda: vm.run(f"test -e {BY_ID} -a -e {short}").rc == 0)
    c.gnss.on = True
    opened = c.s.told(r"(?ms)^gnss: PORT_OPEN.*^gnss: OK")
    timer = vm.run("cat /sys/bus/usb-serial/devices/ttyUSB0/latency_timer").out.strip()
    name = vm.run(f"readlink {short}").out.strip()
    wrong = vm.run("journalctl -b -u systemd-udevd --no-pager -o cat | grep edge-agent").out.strip()
    row(there and opened, "a USB adapter plugged later is opened", "PORT_OPEN, then OK in the journal")
    row(name == "ttyUSB0" and not wrong, "udev rule: a stable name", f"{short} -> {name} {wrong}")
    row(timer == "1", "udev rule: latency timer of FTDI adapters", f"{timer or 'absent'} ms")
    c.records()


def interface_down(c: Course) -> None:
    fault = c.begin(Fault("CAN interface down and up", ("can",), ("PORT_LOST",)), "ip link set can0 down")
    c.lasts(fault, lambda: c.at("ip link set can0 up"))


def interface_removed(c: Course) -> None:
    """The card's driver lets go of it and takes it back; systemd-networkd brings the interface up again."""
    where = c.s.vm.sh("basename $(readlink -f /sys/class/net/can0/device)").strip()
    driver = "/sys/bus/pci/drivers/kvaser_pci"
    fault = c.begin(Fault("CAN interface removed and back", ("can",), ("PORT_LOST",)), f"echo {where} >{driver}/unbind")
    c.lasts(fault, lambda: c.at(f"echo {where} >{driver}/bind"))


def bus_off(c: Course) -> None:
    """The adapter reports bus-off and hears nothing, until it says that it is back."""
    fault = c.begin(Fault("bus-off", ("adapter",), ("BUS_OFF", "PORT_LOST", "SILENT")))
    c.adapter.on = False
    c.adapter.say(b"sb096128\r")

    def end() -> int:
        c.adapter.say(b"sa000000\r")
        c.adapter.on = True
        return c.at()

    c.lasts(fault, end)


def usb_replugged(c: Course) -> None:
    """Another program holds the old name, so the adapter comes back under the next one."""
    c.s.vm.sh("sleep 3600 </dev/ttyUSB0 >/dev/null 2>&1 &")
    fault = c.begin(Fault("USB serial unplugged, back as ttyUSB1", ("gnss",), ("PORT_LOST",)))
    c.gnss.on = False
    c.s.vm.unplug_usb()

    def end() -> int:
        c.s.vm.plug_usb(USB)
        waited(lambda: c.s.vm.run(f"test -e {BY_ID}").rc == 0)
        name = c.s.vm.run(f"basename $(readlink -f {BY_ID})").out.strip()
        c.s.tally.row(name == "ttyUSB1", "the adapter has another name, the link the same", name)
        c.gnss.on = True
        return c.at()

    c.lasts(fault, end)


# --------------------------------------------------------------------------------------------------- clock and disk


def clock_steps(c: Course) -> None:
    for name, step_s in (("one hour", 3600), ("one year", 365 * 86_400)):
        for where, sign in (("forth", "+"), ("back", "-")):
            before = files(c)
            fault = Fault(f"wall clock {name} {where}", PORTS, ("CLOCK_STEP",), "clock")
            c.begin(fault, f"date -s @$(($(date +%s) {sign} {step_s}))")
            good = waited(lambda before=before: files(c) - before != set())  # type: ignore[misc]
            time.sleep(3)
            kept = before <= files(c)
            c.s.tally.row(
                good and kept and c.alive(), f"{fault.name}: a new file begins", "the service runs on, no file has gone"
            )


def files(c: Course) -> set[str]:
    """Names of the recordings, open or finished."""
    return {name.removesuffix(".part") for name in c.s.vm.sh(f"ls {DATA}").split() if ".mcap" in name}


def disk_full(c: Course) -> None:
    fault = Fault("disk full", (), ("DISK_FULL",), "recorder", ("DISK_OK",))
    c.begin(fault, f"dd if=/dev/zero of={DATA}/filler bs=64k 2>/dev/null || true")
    fault.begin_ns = c.at()  # full from here
    told = c.s.told("DISK_FULL")
    time.sleep(HOLD_S)
    fault.end_ns = c.at(f"rm {DATA}/filler")
    good = c.s.told("DISK_OK") and told
    fault.over_ns = c.said_ns("DISK_OK", fault.end_ns)
    c.s.tally.row(good and c.alive(), "disk full: told, and over by itself", "DISK_FULL, then DISK_OK")


def read_only(c: Course) -> None:
    """The file system refuses for good after an error, as a worn card's does. What helps is another card."""
    fault = Fault("disk read-only, later another disk", ("can",))
    c.begin(fault, f"mount -o remount,abort {DATA}")
    told = c.s.told("DISK_(READ-ONLY|IO)")
    time.sleep(HOLD_S)
    c.noted(fault, "DISK_")
    good = told and c.alive()
    c.s.tally.row(good, "disk read-only: told, and it runs on", "DISK_READ-ONLY in the journal")
    c.gnss.on = False
    c.s.stops()
    c.collect("card")
    c.s.vm.sh(f"umount -l {DATA}")
    fault.end_ns = c.at(f"systemctl start --no-block {SERVICE}")
    c.s.tally.row(c.records(), "disk read-only: it records on another disk", "")
    c.gnss.on = True


def forced_read_only(c: Course) -> None:
    """The kernel makes every disk read-only by force, as it does in an emergency; no write of an open file fails."""
    fault = Fault("disks read-only by force (sysrq u)", (), ("DISK_READ-ONLY",), "recorder", ("DISK_OK",))
    c.begin(fault, "echo u >/proc/sysrq-trigger")
    told = c.s.told("DISK_READ-ONLY")
    time.sleep(HOLD_S)
    fault.end_ns = c.at(f"mount -o remount,rw /; mount -o remount,rw {DATA}")
    good = c.s.told("DISK_OK") and told
    fault.over_ns = c.said_ns("DISK_OK", fault.end_ns)
    c.s.tally.row(good and c.alive(), f"{fault.name}: told, and over by itself", "DISK_READ-ONLY, then DISK_OK")


def disk_slow(c: Course) -> None:
    """The disk takes a tenth of what comes, by the limit of the service's group."""
    size = f"du -cb {DATA}/*.mcap* | tail -n 1 | cut -f 1"
    before, began = int(c.s.vm.sh(size)), c.at()
    time.sleep(SLOW_S)
    rate = (int(c.s.vm.sh(size)) - before) * S // (c.at() - began)
    limit = max(rate // 10, 100)
    fault = Fault("disk ten times too slow", (), ("WRITER_STALLED",), "recorder", ("WRITER_OK",))
    set_to = f"systemctl set-property --runtime {SERVICE} IOWriteBandwidthMax="
    c.begin(fault, f"{set_to}'{DATA} {limit}'")
    told = c.s.told("WRITER_STALLED")
    time.sleep(HOLD_S)
    fault.end_ns = c.at(set_to)
    good = c.s.told("WRITER_OK") and told
    fault.over_ns = c.said_ns("WRITER_OK", fault.end_ns)
    time.sleep(HOLD_S)  # what waited goes to the disk
    text = f"WRITER_STALLED, then WRITER_OK; {limit} of {rate} bytes/s"
    c.s.tally.row(good and c.alive(), f"{fault.name}: told, and over by itself", text)


def folder_deleted(c: Course) -> None:
    """Somebody deletes the folder of the recordings; second names keep what the agent writes into nowhere."""
    fault = Fault("data folder deleted", ("can",), ("DISK_IO",), "recorder")
    c.begin(fault, f"mkdir {KEPT} && ln {DATA}/*.mcap* {KEPT}/ && rm -rf {DATA}")
    told = c.s.told("DISK_IO")
    c.noted(fault, "DISK_IO")
    good = c.records() and told
    c.s.vm.sh(f"mkdir /mnt/out/kept && cp {KEPT}/* /mnt/out/kept/ && rm -rf {KEPT}")
    c.s.tally.row(good, f"{fault.name}: told, and it records again by itself", "DISK_IO in the journal")


def takes_little_memory(c: Course) -> None:
    """What waited in memory while the disk refused stayed within its bound."""
    pid = c.s.show("MainPID")["MainPID"]
    found = re.search(r"VmHWM:\s+(\d+) kB", c.s.vm.sh(f"cat /proc/{pid}/status"))
    peak_mb = int(found[1]) / 1e3 if found else float("inf")
    c.s.tally.row(peak_mb < PEAK_MB, "through refusing disks its memory stays bounded", f"{peak_mb:.0f} MB at most")


# --------------------------------------------------------------------------------------------------------- the process


def is_visible(c: Course) -> None:
    """`status` for a technician who is not root."""
    done = c.s.vm.run("runuser -u nobody -- edge-agent status")
    good = done.rc in (0, 1) and re.search(r"(?m)^ports +gnss ", done.out) is not None  # 1: not valid yet
    c.s.tally.row(good, "edge-agent status, as an ordinary user", f"code {done.rc}, {len(done.out.splitlines())} lines")
    say(done.out + done.err)


def listens(c: Course) -> None:
    """`check --live` while the service is stopped and the bridge is played."""
    c.gnss.on = True
    done = c.s.vm.run("edge-agent check -c /etc/edge-agent/site.yaml --live --seconds 20")
    c.gnss.on = False
    good = done.rc in (0, 1) and all(f"ports.{port}" in done.out for port in PORTS)
    text = f"code {done.rc}, {len(done.out.splitlines())} lines"
    c.s.tally.row(good, "edge-agent check --live says what comes at each port", text)
    say(done.out + done.err)


def stopped(c: Course) -> None:
    """Stop it, see what comes at the ports, put another disk in, start it."""
    c.gnss.on = False  # the emulated adapter would keep all for the next reader
    fault = c.begin(Fault("stop, later start", ("can",)), f"systemctl stop {SERVICE}")
    c.noted(fault, "Deactivated successfully")
    listens(c)
    c.s.vm.sh(MOUNT)
    fault.end_ns = c.at(f"systemctl start --no-block {SERVICE}")
    good = c.records() and fault.told_ns > 0
    c.gnss.on = True
    c.s.tally.row(good, f"{fault.name}: in good order, and it records again", "Deactivated successfully")


ENDS = (
    ("restart", f"systemctl restart --no-block {SERVICE}", "Stopping "),
    ("kill -9", "kill -9 {pid}", "Main process exited"),
    (f"SIGSTOP, watchdog of {WATCHDOG_S} s", "kill -STOP {pid}", "Watchdog timeout"),
)
"""A name, how it is done, and what systemd says of it."""


def watched(c: Course) -> None:
    """A shorter watchdog from the next start on."""
    c.s.vm.sh(f"mkdir -p {DROP_IN} && printf '[Service]\\nWatchdogSec={WATCHDOG_S}\\n' >{DROP_IN}/watchdog.conf")
    c.s.vm.sh("systemctl daemon-reload")


def ended(c: Course, ways: Sequence[tuple[str, str, str]]) -> None:
    """The process comes to its end in one way or another; systemd starts it again."""
    for name, command, said in ways:
        before = c.s.show("MainPID")["MainPID"]
        c.gnss.on = False
        fault = c.begin(Fault(name, ("can",)), command.format(pid=before))
        other = waited(lambda before=before: c.s.show("MainPID")["MainPID"] not in ("0", before))  # type: ignore[misc]
        good = c.records() and other
        c.gnss.on = True
        c.noted(fault, said)
        c.s.tally.row(good and fault.told_ns > 0, f"{name}: it comes again and records", f"systemd: {said.strip()}")
    log = c.s.vm.sh(f"journalctl -b -u {SERVICE} --no-pager -o cat | grep -c RECOVERED || true").strip()
    c.s.tally.row(
        int(log) >= len(ways[-2:]), "the torn files are made whole at the next start", f"{log} times RECOVERED"
    )


def power_cut(c: Course, reboot: Callable[[], Machine]) -> None:
    """The plug is pulled; the machine boots, and all comes up by itself."""
    offset_ns = c.host_offset_ns()
    say("fault: power cut")
    cut_ns = time.monotonic_ns()
    cut_utc_ns = time.time_ns()
    c.s.vm.power_cut()
    c.s.vm = vm = reboot()
    vm.sh("ip link set can1 type can bitrate 500000 && ip link set can1 up")
    vm.sh("cangen can1 -g 20 -I 098 -L 8 >/dev/null 2>&1 & true")
    good = c.records()
    log = vm.sh(f"journalctl -b -u {SERVICE} --no-pager -o cat")
    recovered = re.search(r"RECOVERED: (.*)", log)
    text = recovered[1] if recovered else "nothing recovered"
    c.s.tally.row(good and recovered is not None, "power cut: it comes up by itself, the file is whole", text)
    room = vm.sh("sysctl -n net.core.rmem_max").strip()
    waited(lambda: vm.sh("ip -br link show can0").split()[1] == "UP")
    state = vm.sh("ip -br link show can0").split()[1]
    modules = vm.run("grep -qw usbserial /proc/modules && grep -qw cdc_acm /proc/modules").rc == 0
    text = f"can0 {state}, net.core.rmem_max {room}, modules {'loaded' if modules else 'absent'}"
    c.s.tally.row(state == "UP" and room == "4194304" and modules, "and so do interface, buffer and drivers", text)
    again_ns = c.host_offset_ns()
    c.s.be_patient()
    c.s.stops()
    c.collect("disk")
    table(c, Fault("power cut", ("can",), begin_ns=cut_ns + offset_ns), cut_utc_ns, again_ns - offset_ns)


# ----------------------------------------------------------------------------------------------------------- the table


def recorded(files: list[Path]) -> Recorded:
    """What files say whose runs are of one boot."""
    times: dict[str, list[npt.NDArray[np.int64]]] = {port: [np.zeros(0, np.int64)] for port in PORTS}
    said: list[tuple[int, str, str]] = []
    orders: dict[str, dict[int, int]] = {}
    losses = 0
    for path in files:
        mine = orders.setdefault(run_of(path)["run"], {})
        for m in stored([path], "/raw/clock", *(f"/raw/{port}" for port in PORTS), "/faults", "/events"):
            if m.topic.startswith("/raw/"):
                r = topics.decode_raw(m.topic, m.schema, m.data)
                mine[r.order] = r.t_ns
                if r.source in times:
                    f = r.payload
                    if isinstance(f, CanFrames):
                        times[r.source].append(f.t_ns[f.flags & CanFlag.ERR == 0])
                    else:
                        times[r.source].append(np.array([r.t_ns], np.int64))
                continue
            event = cdr.decode(m.schema, m.data)
            said.append((int(event["monotonic_ns"]), str(event["kind"]), str(event["source"])))
            if event["kind"] == "LOSS" and str(event["source"]).startswith("/raw/"):
                losses += int(event["values"][0]["value"])
    holes = [(o[b], b - a - 1) for o in orders.values() for a, b in itertools.pairwise(sorted(o)) if b - a > 1]
    return Recorded({p: np.sort(np.concatenate(t)) for p, t in times.items()}, sorted(said), holes, losses)


def run_of(path: Path) -> dict[str, str]:
    return reader.head_metadata(path, "edge_agent:run")


def gap(times: npt.NDArray[np.int64], begin_ns: int, until_ns: int) -> tuple[int, int]:
    """The longest time without data that ends after a fault: its two ends."""
    use = times[(times > begin_ns - 30 * S) & (times < until_ns)]
    if use.size < 2 or use[-1] <= begin_ns:
        return 0, 0
    first = max(int(np.searchsorted(use, begin_ns, "right")) - 1, 0)
    at = first + int(np.argmax(np.diff(use[first:])))
    return int(use[at]), int(use[at + 1])


def table(c: Course, cut: Fault, cut_utc_ns: int, boot_ns: int) -> None:
    """`cut`: the power cut; boot_ns: the monotonic clock after it minus that before it."""
    files = sorted((c.s.out / "disk").glob("*.mcap"))
    card = [p for name in ("card", "kept") for p in (c.s.out / name).glob("*.mcap*")]
    new = [p for p in files if int(run_of(p)["started_utc_ns"]) > cut_utc_ns]
    old = [p for p in files if p not in new] + card
    before, after = recorded(old), recorded(new)
    print(ROW.format("fault", "detected in", "recovered in", "lost"))
    ends = [f.begin_ns for f in c.faults[1:]] + [cut.begin_ns]
    good = True
    for fault, until_ns in zip(c.faults, ends, strict=True):
        good &= print_row(fault, before, until_ns)
    told = [t - boot_ns for t, kind, _ in after.said if kind == "RECOVERED"]
    last = int(before.times["can"][-1]) if before.times["can"].size else 0
    first = int(after.times["can"][0]) - boot_ns if after.times["can"].size else 0
    good &= bool(told and first and last)
    seconds = (cut.begin_ns - last) / S
    text = f"{seconds:.2f} s of data before it, {(first - cut.begin_ns) / S:.1f} s until it records again"
    print(ROW.format(cut.name, since(told[0] if told else 0, cut.begin_ns), since(first, cut.begin_ns), text))
    c.s.tally.row(good, "every fault was told and is over", "see the table")
    missing = sum(n for _, n in before.holes + after.holes)
    told_lost = before.losses + after.losses
    text = f"{missing} blocks missing, {told_lost} told by LOSS"
    c.s.tally.row(missing <= told_lost, "nothing is missing in silence", text)
    open_ledgers = sum(kind == "LEDGER" for _, kind, _ in before.said + after.said)
    c.s.tally.row(not open_ledgers, "the ledger balanced all the time", f"{open_ledgers} times LEDGER on /faults")


def since(t_ns: int, begin_ns: int) -> str:
    return f"{max(t_ns - begin_ns, 0) / S:.2f} s" if t_ns else "never"


def print_row(fault: Fault, r: Recorded, until_ns: int) -> bool:
    """Print it; whether the fault was told and is over."""
    sources = (fault.source,) if fault.source else fault.ports

    def first(kinds: tuple[str, ...], from_ns: int) -> int:
        return next((t for t, k, source in r.said if k in kinds and source in sources and from_ns <= t < until_ns), 0)

    told = fault.told_ns or first(
        fault.kinds, fault.begin_ns - 2 * S
    )  # the last block of a disk fills it before dd ends
    gaps = {port: gap(r.times[port], fault.begin_ns, until_ns) for port in fault.ports}
    if fault.back:
        over = fault.over_ns
        lost = sum(n for t, n in r.holes if fault.begin_ns <= t < until_ns)
        text = f"{lost} blocks of all ports, told by LOSS" if lost else "nothing"
    elif "CLOCK_STEP" in fault.kinds:  # nothing should be seen of it
        over = told
        text = "nothing: longest gap " + ", ".join(f"{p} {(b - a) / S:.2f} s" for p, (a, b) in gaps.items())
    else:
        a, over = gaps[fault.ports[0]]
        text = f"{max(over - a - (fault.end_ns - fault.begin_ns), 0) / S:.2f} s"
        if fault.told_ns:
            text += f", of it {max(fault.begin_ns - a, 0) / S:.2f} s before"
    print(ROW.format(fault.name, since(told, fault.begin_ns), since(over, fault.end_ns), text), flush=True)
    return bool(told and over)
