"""A simulated record as files: the raw recording that the agent would have made, its configuration, and the truth.

`raw.mcap` replays like any other (`edge-agent replay raw.mcap -c config.yaml -o fused.mcap`); the truth stands beside
it as CSV, on the recording's UTC.
"""

from __future__ import annotations

from pathlib import Path

from edge_agent.messages import S
from edge_agent.recording import topics
from edge_agent.recording.writer import PART, SegmentWriter
from edge_agent.simulate.bridge import SimRecord
from edge_agent.simulate.encode import config_yaml, dbc_text, raw_blocks
from edge_agent.simulate.sensors import FixLabel

RAW, CONFIG, DBC, TRUTH, FIXES = "raw.mcap", "config.yaml", "accelerometers.dbc", "truth.csv", "fixes.csv"
_AXES = ("east", "north", "up")


def write_files(record: SimRecord, folder: Path) -> list[Path]:
    """Write everything into `folder`, made where it is missing; return the paths.

    Raises FileExistsError where a recording stands there already, OSError from the disk.
    """
    folder.mkdir(parents=True, exist_ok=True)
    texts = {CONFIG: config_yaml(record.scenario, dbc=DBC, site=f"simulated-{record.scenario.name}")}
    if record.accels:
        texts[DBC] = dbc_text(record.scenario)
    metadata = {"source": "simulated", "scenario": record.scenario.name, "seed": str(record.seed)}
    writer: SegmentWriter | None = None
    done = False
    try:
        for raw in raw_blocks(record):
            utc_ns = raw.t_ns + record.utc_offset_ns
            if writer is None:
                attachments = {name: text.encode() for name, text in texts.items()}
                writer = SegmentWriter(folder / (RAW + PART), metadata=metadata, attachments=attachments, utc_ns=utc_ns)
            writer.add(topics.raw_record(raw, utc_ns))
        if writer is None:
            raise ValueError("simulate: the record holds nothing")
        writer.close()
        done = True
    finally:
        if writer is not None and not done:
            writer.abandon()
            writer.path.unlink(missing_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text)
    _write_truth(record, folder / TRUTH)
    _write_fixes(record, folder / FIXES)
    return [folder / name for name in (RAW, *texts, TRUTH, FIXES)]


def _write_truth(record: SimRecord, path: Path) -> None:
    """Truth at the first accelerometer's samples, or at the fixes where there is none."""
    truth = record.truth
    names = [
        f"{q}_{axis}_{u}"
        for q, u in (("displacement", "m"), ("velocity", "mps"), ("acceleration", "mps2"))
        for axis in _AXES
    ]
    with path.open("w", encoding="ascii") as file:
        print("utc_ns", *names, sep=",", file=file)
        rows = zip(truth.t_ns.tolist(), truth.d_m.tolist(), truth.v_mps.tolist(), truth.a_mps2.tolist(), strict=True)
        for t, d, v, a in rows:
            print(t + record.utc_offset_ns, *(f"{x:.9g}" for x in (*d, *v, *a)), sep=",", file=file)


def _write_fixes(record: SimRecord, path: Path) -> None:
    """Each fix with what was wrong with it."""
    f, truth = record.fixes, record.truth_at_fixes
    names = [f"{q}_{axis}_m" for q in ("fix", "truth", "offset") for axis in _AXES]
    with path.open("w", encoding="ascii") as file:
        print("utc_ns", "latency_s", "quality", "label", *names, sep=",", file=file)
        for i, t in enumerate(f.t_ns.tolist()):
            numbers = (*f.z_m[i].tolist(), *truth.d_m[i].tolist(), *f.offset_m[i].tolist())
            latency = (int(f.arrival_ns[i]) - t) / S
            label = FixLabel(int(f.label[i])).name.lower()
            fields = (f"{latency:.6f}", int(f.quality[i]), label, *(f"{x:.6f}" for x in numbers))
            print(t + record.utc_offset_ns, *fields, sep=",", file=file)
