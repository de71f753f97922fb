"""An agent with triggers: events on /events that replay finds too, and a clip of the time around them."""

from __future__ import annotations

from pathlib import Path

from live import Live, ScriptedPort, decoded, faults, raws, recordings, values

from edge_agent import config
from edge_agent.messages import S
from edge_agent.recording.reader import info, read_messages
from edge_agent.replay import replay
from edge_agent.simulate import SCENARIOS, simulate
from edge_agent.simulate.encode import config_yaml, dbc_text, raw_blocks
from edge_agent.verify import verify

SCENARIO = SCENARIOS["clean"]


def test_an_agent_keeps_the_time_around_its_events(tmp_path: Path) -> None:
    script = list(raw_blocks(simulate("clean", 1, 35.0)))
    sets = ("triggers.shaken.point=deck", "triggers.shaken.above_mps2=0.02", "triggers.pulled.fault=PORT_LOST")
    more = ("events.before_s=3", "events.after_s=2", "events.hold_s=0.5", "events.max_s=8", "record.rotate_s=5")
    made = config.parse(
        config_yaml(SCENARIO, dbc="a.dbc", site="site", data_dir="rec"),
        tmp_path,
        lambda name: dbc_text(SCENARIO).encode(),
        ["record.free_gb=0", "record.flush_s=0.05", *sets, *more],
    )
    ports = {name: ScriptedPort() for name in ("gnss", "can", "clock")}
    with Live(made, ports) as live:
        for i in range(0, len(script), 50):
            live.play(script[i : i + 50])
            live.settle()
    files = recordings(tmp_path / "rec")
    events = decoded(files, "/events")
    begun = [e for e in events if e["kind"] == "TRIGGER"]
    assert begun, "the simulated deck moves less than this test thinks"
    assert {e["source"] for e in begun} == {"shaken"}
    assert all(values(e)["value"] >= 0.02 for e in begun)
    report = replay(files, None, None, True)
    assert report.ok, str(report)
    assert report.compared > 1000
    kept = recordings(tmp_path / "rec" / "clips")
    assert kept
    logs = [s.log_ns for s in read_messages(files[0])]  # Ticks came before its first data
    assert logs == sorted(logs)
    said = faults(files, "CLIP")
    assert {f["text"].split(":")[0] for f in said} <= {p.name for p in kept}
    everything = [(s.topic, s.log_ns, s.data) for s in (x for f in files for x in read_messages(f))]
    first = begun[0]["monotonic_ns"]
    for path in kept:
        assert info(path).complete
        clip = [(s.topic, s.log_ns, s.data) for s in read_messages(path)]
        a, b = min(t for _, t, _ in clip), max(t for _, t, _ in clip)
        assert clip == [x for x in everything if a <= x[1] <= b]  # every record, in order
    stamps = [r.t_ns for r in raws(kept[:1]) if r.source == "can"]
    assert 2.8 < (first - min(stamps)) / S < 3.2
    assert verify([tmp_path / "rec"]).wanting == []
