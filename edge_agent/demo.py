"""`edge-agent demo`: a simulated bridge plays in real time into the live agent; ends with a picture,
its figures and the report.

The agent is the real one, its own process, started from a configuration file as a service would be. It reads a
pseudo-terminal that plays the GNSS receiver, and a CAN bus: vcan0 where the kernel has it up, else an slcan adapter
on a second pseudo-terminal. What is judged is what it wrote to its files, read back, against the exact truth.
Structure axes: x along the deck, y across, z up.
"""

from __future__ import annotations

import contextlib
import importlib.util
import math
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from edge_agent import layouts
from edge_agent.geodesy import Frame
from edge_agent.messages import F64, I64, MS, U8, VALID_MODES, S, Verdict
from edge_agent.recording import cdr, reader, topics
from edge_agent.review.report import review
from edge_agent.review.series import configuration
from edge_agent.simulate.bridge import SimRecord, run
from edge_agent.simulate.encode import RECEIVER, Wiring, config_yaml, dbc_text, point_name
from edge_agent.simulate.play import Sink, Terminal, can_schedule, open_can, play, serial_schedule, wait_ready
from edge_agent.simulate.sensors import FixLabel
from edge_agent.simulate.specs import START_NS, Accel, Fault, Gnss, Modal, Ramp, Scenario, Structure, Vec3

AZIMUTH_DEG = 60.0  # the deck's axis: east-north-east
LATENCY_S = 0.200
LINE_S = 0.008  # a GGA's 92 bytes at 115200 baud
ROTATE_S = 20
MIN_SECONDS = 25.0  # the filter starts after 15 s
READY_S, STOP_S = 120.0, 120.0  # patience with the agent's start and end
OUTLIERS = Fault("outliers", 23.0, 1.5, (0.7, 0.0, 0.0))
WRONG = Fault("wrong", 28.0, 10.0, (0.05, -0.03, 0.06))
OUTAGE = Fault("outage", 45.0, 5.0)


def scenario() -> Scenario:
    """A bridge deck under wind, sun and four lorries; faults in the order in which the picture shows them."""

    def lorry(start_s: float, length_s: float, size: Vec3) -> tuple[Ramp, Ramp]:
        x, y, z = size
        half = length_s / 2
        return Ramp(start_s, half, size), Ramp(start_s + half, half, (-x, -y, -z))

    structure = Structure(
        thermal_m=(0.004, 0.003, 0.002),
        thermal_s=120.0,
        modes=(Modal(0.62, (0.0015, 0.0020, 0.0025)), Modal(1.35, (0.0004, 0.0005, 0.0008))),
        ramps=(
            *lorry(17.0, 6.0, (0.002, 0.001, -0.020)),
            *lorry(30.0, 6.0, (0.002, 0.001, -0.025)),
            *lorry(44.5, 6.5, (0.002, 0.001, -0.030)),
            *lorry(53.0, 5.0, (0.002, 0.001, -0.015)),
        ),
    )
    gnss = Gnss(drop_share=0.02, latency_s=LATENCY_S, jitter_s=0.020, calm_s=0.0, faults=(OUTLIERS, WRONG, OUTAGE))
    accel = Accel(
        noise=2.2e-4,
        bias_mps2=(0.02, 0.05),
        bias_walk=1e-11,
        jitter_s=0.001,
        drop_share=0.002,
        duplicate_share=0.002,
    )
    return Scenario("demo", structure, gnss, (accel,), duration_s=60.0)


def run_demo(out_dir: Path, seconds: float = 60.0, seed: int = 1) -> int:
    """Run the demo into a new folder below `out_dir`; returns 0, 1 where the agent failed or fused worse than the raw
    fixes, 2 for wrong use."""
    if not seconds >= MIN_SECONDS:
        return _fail(f"--seconds {seconds:g}: at least {MIN_SECONDS:g}, as the filter starts after 15 s", 2)
    if importlib.util.find_spec("matplotlib") is None:
        return _fail("the picture needs matplotlib: pip install 'edge-agent[demo]'", 2)
    folder = out_dir.resolve() / datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    folder.mkdir(parents=True)
    sinks: list[Sink] = []
    try:
        serial = Terminal()
        sinks.append(serial)
        can, interface, channel = open_can()
        sinks.append(can)
        made = scenario()
        (folder / "accelerometers.dbc").write_text(dbc_text(made))
        text = config_yaml(
            made,
            site="demo",
            wiring=Wiring(serial.path, interface, channel),
            azimuth_deg=AZIMUTH_DEG,
            rotate_s=ROTATE_S,
            latency_ms=(LATENCY_S + LINE_S) * 1e3,
        )
        (folder / "config.yaml").write_text(text)
        _say(f"receiver on {serial.path}, accelerometer on {interface} {channel}, files in {folder}")
        record = _live(folder, made, seconds, seed, serial, can)
    finally:
        for sink in sinks:
            sink.close()
    if record is None:
        return 1
    files = sorted((folder / "recordings").glob("*.mcap"))
    if not files:
        return _fail(f"the agent left no recording; its log: {folder / 'agent.log'}", 1)
    seen = read_back(files, record)
    if not len(seen.t_s):
        return _fail(f"the recordings hold no fused sample; the agent's log: {folder / 'agent.log'}", 1)
    figures = judge(seen, record)
    picture = folder / "demo.png"
    draw(picture, seen, record, figures)
    print(figures.line(sum(f.stat().st_size for f in files), len(files)))
    print(f"picture  {picture}")
    report = folder / "report.html"
    review([folder / "recordings"], report)
    print(f"report   {report}")
    for path in layouts.write(configuration(files), folder):
        print(f"layout   {path}")
    for file in files:
        print(f"file     {file}")
    if not figures.better:
        return _fail("the fused displacement is not better than the raw fixes", 1)
    return 0


def _live(folder: Path, made: Scenario, seconds: float, seed: int, serial: Terminal, can: Sink) -> SimRecord | None:
    """Start the agent, play to it, stop it; None where it failed, which has been said then."""
    log_path = folder / "agent.log"
    command = [sys.executable, "-m", "edge_agent", "run", "-c", str(folder / "config.yaml")]
    with log_path.open("wb") as log, contextlib.ExitStack() as cleanup:
        agent = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT)
        cleanup.callback(_end, agent)
        if not wait_ready((serial, can), READY_S, lambda: agent.poll() is None):
            _fail(f"the agent did not open its ports within {READY_S:g} s; its log:\n{_tail(log_path)}", 1)
            return None
        # Fixes fall on whole fractions of UTC; the first one comes a moment from now.
        mono_ns, wall_ns = time.monotonic_ns(), time.time_ns()
        utc_ns = (wall_ns // S + 2) * S
        record = run(made, seed, seconds, utc_ns)
        parts: list[tuple[Sink, list[tuple[int, bytes]]]] = [
            (serial, serial_schedule(record)),
            (can, can_schedule(record, can)),
        ]
        ended = threading.Event()
        tell = _Progress(seconds)

        def progress(t_ns: int) -> None:
            tell(t_ns)
            if agent.poll() is not None:
                ended.set()

        late_ns = play(parts, mono_ns + utc_ns - wall_ns - START_NS, stop=ended, progress=progress)
        tell.done()
        if late_ns > 50 * MS:
            _say(f"this machine was busy: bytes left up to {late_ns / MS:.0f} ms late")
        if serial.lost:
            _say(f"{serial.lost} bytes found the agent too slow")
        if agent.poll() is None:
            agent.send_signal(signal.SIGTERM)
        try:
            code = agent.wait(STOP_S)
        except subprocess.TimeoutExpired:
            _fail(f"the agent did not end within {STOP_S:g} s of SIGTERM", 1)
            return None
        if code != 0:
            _fail(f"the agent ended with code {code}; its log:\n{_tail(log_path)}", 1)
            return None
    return record


def _end(agent: subprocess.Popen[bytes]) -> None:
    """Leave no agent behind, whatever happened."""
    if agent.poll() is None:
        agent.kill()
        agent.wait()


def _tail(path: Path) -> str:
    return "\n".join(path.read_text(errors="replace").splitlines()[-20:])


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _fail(text: str, code: int) -> int:
    _say(f"demo: {text}")
    return code


class _Progress:
    """Tells the second and what happens in it on stderr."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.shown = ""

    def __call__(self, t_ns: int) -> None:
        t = (t_ns - START_NS) / S
        what = "the filter starts after 15 s of fixes" if t < 15.5 else "fusing"
        for fault, name in ((OUTLIERS, "outliers"), (WRONG, "wrong fix"), (OUTAGE, "no fixes")):
            if fault.start_s - 1 < t < fault.start_s + fault.length_s:
                what = name
        if sys.stderr.isatty():
            print(f"\r{t:3.0f} of {self.seconds:.0f} s  {what:<40}", end="", file=sys.stderr, flush=True)
        elif what != self.shown:
            _say(f"{t:3.0f} of {self.seconds:.0f} s  {what}")
            self.shown = what

    def done(self) -> None:
        """End the line."""
        if sys.stderr.isatty():
            _say("")


# ------------------------------------------------------------------------------------------------------- what it wrote


@dataclass(frozen=True, slots=True)
class Seen:
    """What the files say, structure axes: times in s of the record; samples with d and sd (n, 3), fixes with z (m, 3)
    at the receiver's own time, which no delay on this machine moves.

    `verdict` of a fix: of `Verdict`, 255 where the files hold none.
    """

    t_s: F64
    d_m: F64
    std_m: F64
    mode: U8
    fix_t_s: F64
    fix_m: F64
    verdict: U8


def read_back(files: Sequence[Path], record: SimRecord) -> Seen:
    """Everything of the demo's point and receiver in the files, on the record's time."""
    point, solution = f"/fusion/{point_name(record.scenario)}", f"/gnss/{RECEIVER}/solution"
    wanted = {f"{point}/block", f"{point}/update", solution}
    zero_ns = START_NS + record.utc_offset_ns
    times: list[I64] = [np.zeros(0, np.int64)]
    columns: list[list[F64]] = [[np.zeros((0, 3))], [np.zeros((0, 3))]]
    modes: list[U8] = [np.zeros(0, np.uint8)]
    fixes: dict[int, tuple[int, Vec3]] = {}
    verdicts: dict[int, int] = {}
    frame = Frame(record.scenario.reference_llh, AZIMUTH_DEG)
    for file in files:
        for stored in reader.read_messages(file, wanted):
            if stored.topic == solution:
                value = cdr.decode(stored.schema, stored.data)
                enu = (value["east_m"], value["north_m"], value["up_m"])
                fixes[stored.publish_ns] = (value["gnss_utc_ns"] - zero_ns, frame.to_structure(enu))
            elif stored.topic.endswith("/update"):
                verdicts[stored.publish_ns] = cdr.decode(stored.schema, stored.data)["verdict"]
            else:
                block = topics.decode_fused_block("", stored.data)
                times.append(stored.publish_ns - zero_ns + block.t_ns - block.t_ns[0])
                columns[0].append(block.displacement_m)
                columns[1].append(block.std_displacement_m)
                modes.append(block.mode)
    stamps = sorted(fixes)
    return Seen(
        np.concatenate(times) / S,
        np.concatenate(columns[0]),
        np.concatenate(columns[1]),
        np.concatenate(modes),
        np.array([fixes[t][0] for t in stamps], dtype=np.int64) / S,
        np.array([fixes[t][1] for t in stamps]).reshape(-1, 3),
        np.array([verdicts.get(t, 255) for t in stamps], dtype=np.uint8),
    )


def truth_at(record: SimRecord, t_s: F64) -> F64:
    """True displacement (n, 3) in structure axes at times of the record."""
    d = record.motion.at(START_NS + np.rint(t_s * S).astype(np.int64)).d_m
    frame = Frame(record.scenario.reference_llh, AZIMUTH_DEG)
    x, y = frame.to_structure((1.0, 0.0, 0.0)), frame.to_structure((0.0, 1.0, 0.0))  # columns of the rotation
    return np.stack([x[0] * d[:, 0] + y[0] * d[:, 1], x[1] * d[:, 0] + y[1] * d[:, 1], d[:, 2]], axis=1)


@dataclass(frozen=True, slots=True)
class Figures:
    """Errors against the truth from the first valid fused sample on, m, axes x y z."""

    fused_rms_m: Vec3
    raw_rms_m: Vec3  # every fix as the receiver gave it
    good_rms_m: Vec3  # the fixes that no fault touched
    within: tuple[float, float, float]  # share of fused errors within 1, 2, 3 of their own sd
    rejected: int
    offset: int
    fixes: int
    outliers: int  # sent by the simulator
    caught: int  # of them with any verdict but ACCEPTED

    @property
    def better(self) -> bool:
        """Fused beats the raw fixes on every axis."""
        return all(f < r for f, r in zip(self.fused_rms_m, self.raw_rms_m, strict=True))

    def line(self, size: int, files: int) -> str:
        """The demo's one line of figures."""

        def mm(x: Vec3) -> str:
            return "/".join(f"{1e3 * v:.2f}" for v in x)

        one, two, three = (f"{100 * x:.1f}" for x in self.within)
        return (
            f"rms error x/y/z: fused {mm(self.fused_rms_m)} mm, raw fixes {mm(self.raw_rms_m)} mm "
            f"(faultless ones {mm(self.good_rms_m)} mm); within 1/2/3 sd: {one}/{two}/{three} %; "
            f"{self.fixes} fixes, {self.rejected} rejected ({self.caught} of {self.outliers} outliers caught), "
            f"{self.offset} used less a level offset; {size} bytes in {files} files"
        )


def _rms(error: F64) -> Vec3:
    x, y, z = (math.sqrt(float(v)) for v in np.mean(error**2, axis=0))
    return x, y, z


def judge(seen: Seen, record: SimRecord) -> Figures:
    """The figures of what was read back; `seen` holds at least one fused sample."""
    valid = np.isin(seen.mode, [int(m) for m in VALID_MODES])
    begin = float(seen.t_s[valid][0]) if valid.any() else float(seen.t_s[0])
    use = valid if valid.any() else np.ones_like(valid)
    error = seen.d_m[use] - truth_at(record, seen.t_s[use])
    ratio = np.abs(error) / seen.std_m[use]
    late = seen.fix_t_s >= begin
    raw = seen.fix_m[late] - truth_at(record, seen.fix_t_s[late])
    label = _labels(seen.fix_t_s[late], record)
    outlier = label == FixLabel.OUTLIER
    verdict = seen.verdict[late]
    nothing = (math.nan, math.nan, math.nan)
    good = label == FixLabel.GOOD
    return Figures(
        _rms(error),
        _rms(raw) if len(raw) else nothing,
        _rms(raw[good]) if good.any() else nothing,
        (float(np.mean(ratio <= 1)), float(np.mean(ratio <= 2)), float(np.mean(ratio <= 3))),
        int(np.sum(verdict == Verdict.REJECTED)),
        int(np.sum(verdict == Verdict.OFFSET)),
        int(late.sum()),
        int(outlier.sum()),
        int(np.sum(outlier & (verdict != Verdict.ACCEPTED))),
    )


def _labels(t_s: F64, record: SimRecord) -> U8:
    """The simulator's label of the fix that is nearest in time to each of `t_s`."""
    known = (record.fixes.t_ns - START_NS) / S
    k = np.clip(np.searchsorted(known, t_s), 1, len(known) - 1)
    k -= t_s - known[k - 1] < known[k] - t_s
    return record.fixes.label[k]


# ------------------------------------------------------------------------------------------------------------- picture

BLUE, GREY, RED, ORANGE, BLACK = "#0072B2", "#9a9a9a", "#D55E00", "#E69F00", "#000000"  # safe for the colour-blind


def draw(path: Path, seen: Seen, record: SimRecord, figures: Figures) -> None:
    """PNG: the vertical displacement of the whole run, close looks at its faults, the other axes, and the error."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    end = float(max(seen.t_s[-1], OUTAGE.start_s))
    grid = np.arange(0.0, float(seen.t_s[-1]), 0.01)  # a short run ends before its last fault
    truth = truth_at(record, grid) * 1e3
    figure, axes = plt.subplot_mosaic(
        [["z", "z"], ["error", "error"], ["wrong", "outage"], ["x", "y"]],
        figsize=(13, 14),
        dpi=110,
        height_ratios=[3.2, 1.5, 2.6, 2.0],
        layout="constrained",
    )

    def panel(ax, axis: int, begin: float, stop: float, title: str) -> None:  # type: ignore[no-untyped-def]
        inside = (grid >= begin) & (grid <= stop)
        f = (seen.t_s >= begin) & (seen.t_s <= stop)
        g = (seen.fix_t_s >= begin) & (seen.fix_t_s <= stop)
        d, sd = seen.d_m[f, axis] * 1e3, seen.std_m[f, axis] * 1e3
        around = np.concatenate([truth[inside, axis], d, [0.0]])
        wrong = WRONG.start_s < stop and WRONG.start_s + WRONG.length_s > begin
        shown = seen.fix_m[g, axis] * 1e3
        level = shown[(seen.verdict[g] == Verdict.OFFSET)] if wrong else shown[:0]
        around = np.concatenate([around, level])
        low, high = around.min(), around.max()
        room = 0.12 * (high - low) + 8.0
        low, high = low - room, high + room
        z, t, verdict = shown, seen.fix_t_s[g], seen.verdict[g]
        clipped = np.clip(z, low + 0.03 * (high - low), high - 0.09 * (high - low))  # names stand above
        plain = ~np.isin(verdict, [int(Verdict.REJECTED), int(Verdict.OFFSET)])
        ax.fill_between(seen.t_s[f], d - 2 * sd, d + 2 * sd, color=BLUE, alpha=0.25, lw=0, label="fused, 2 sd")
        ax.plot(t[plain], clipped[plain], ".", ms=4, color=GREY, label="raw GNSS")
        o, r = verdict == Verdict.OFFSET, verdict == Verdict.REJECTED
        ax.plot(t[o], clipped[o], ".", ms=5, color=ORANGE, label="used less a level offset")
        ax.plot(t[r], clipped[r], "x", ms=5, mew=1.3, color=RED, label="rejected (at the edge: beyond)")
        ax.plot(seen.t_s[f], d, "-", lw=1.6, color=BLUE, label="fused")
        ax.plot(grid[inside], truth[inside, axis], "-", lw=0.8, color=BLACK, label="truth")
        ax.set(xlim=(begin, stop), ylim=(low, high), title=title, ylabel="displacement [mm]", xlabel="time [s]")
        shade(ax, begin, stop)

    def shade(ax, begin: float, stop: float) -> None:  # type: ignore[no-untyped-def]
        for fault, colour in ((OUTLIERS, RED), (WRONG, ORANGE), (OUTAGE, GREY)):
            if begin < fault.start_s + fault.length_s and fault.start_s < stop:
                ax.axvspan(fault.start_s, fault.start_s + fault.length_s, color=colour, alpha=0.12, lw=0)
        ax.grid(alpha=0.3, lw=0.6)

    x, y, z = (f"{1e3 * v:.2f}" for v in figures.fused_rms_m)
    panel(axes["z"], 2, 0.0, end, f"z, vertical: fused rms error {z} mm")
    panel(axes["wrong"], 2, WRONG.start_s - 2, min(end, WRONG.start_s + WRONG.length_s + 2), "z: a wrong fix of 10 s")
    panel(axes["outage"], 2, OUTAGE.start_s - 2, min(end, OUTAGE.start_s + OUTAGE.length_s + 2), "z: 5 s without a fix")
    panel(axes["x"], 0, 0.0, end, f"x, along the deck: fused rms error {x} mm")
    panel(axes["y"], 1, 0.0, end, f"y, across the deck: fused rms error {y} mm")
    top = axes["z"].get_ylim()[1]
    for fault, name in ((OUTLIERS, "outliers"), (WRONG, "wrong fix"), (OUTAGE, "no fixes")):
        if fault.start_s < end:
            axes["z"].annotate(
                name,
                (fault.start_s + fault.length_s / 2, top),
                (0, -4),
                textcoords="offset points",
                ha="center",
                va="top",
            )
    if seen.t_s[0] > 5.0:
        at = (seen.t_s[0] / 2, top)
        axes["z"].annotate("start window", at, (0, -4), textcoords="offset points", ha="center", va="top", color=GREY)
    axes["z"].legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=6, fontsize=9, frameon=False)
    ax = axes["error"]
    error, sd = (seen.d_m - truth_at(record, seen.t_s))[:, 2] * 1e3, seen.std_m[:, 2] * 1e3
    ax.fill_between(seen.t_s, -2 * sd, 2 * sd, color=BLUE, alpha=0.25, lw=0, label="2 sd, as published")
    ax.plot(seen.t_s, error, "-", lw=1.0, color=BLUE, label="fused minus truth")
    most = float(np.quantile(np.concatenate([np.abs(error), 2 * sd]), 0.995)) * 1.2
    ax.set(xlim=(0, end), ylim=(-most, most), ylabel="error of z [mm]", xlabel="time [s]")
    shade(ax, 0.0, end)
    ax.legend(loc="lower left", ncols=2, fontsize=9, framealpha=0.9)
    when = datetime.fromtimestamp((START_NS + record.utc_offset_ns) // S, UTC)
    figure.suptitle(
        f"Simulated bridge, {when:%Y-%m-%d %H:%M:%S} UTC: RTK GNSS and accelerometer fused live by edge-agent\n"
        f"rms error x/y/z: fused {x}/{y}/{z} mm, fixes without a fault "
        + "/".join(f"{1e3 * v:.1f}" for v in figures.good_rms_m)
        + " mm",
        fontsize=12,
    )
    figure.savefig(path)
    plt.close(figure)
