"""The command line, and the only place that wires things together.

Exit codes: 0 good, 1 found wanting, 2 wrong use, 3 recovered with loss. Results go to stdout, talk to stderr; --json
where a program may read the result. Each sub-command imports what it needs when it runs, so that start is light.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

GOOD, WANTING, WRONG_USE, LOSS = 0, 1, 2, 3
NAMED_FILE = re.compile(r"([A-Za-z0-9_-]{1,32})=(.+)\Z", re.DOTALL)


SCENARIOS = (
    ("clean", "a bridge at .5 and 1.7 Hz, RTK at 10 Hz, accelerometer at 100 Hz, no fault; 15 min"),
    ("rough", "the same with 5 % outliers, 10 % of the epochs missing, latency, bias, lost and double samples"),
    ("hostile", "rough, and wrong fixes that agree with each other for 5 to 60 s, 20 an hour"),
    ("floaty", "hostile, and 15 s of float solutions every 3 min"),
    ("P0", "bridge and building model on a slider, 1.13, 4.45, 7.27 Hz (Lima et al.); 20 min"),
    ("P1", "high-rise, .21, .34, .44 Hz, one weak axis (Wang et al.); 1 h"),
    ("P2", "a receiver alone at 1 Hz that does not move (Duong et al.); 1 h"),
    ("P3", "arch bridge with traffic, .91, 1.64, 2.52 Hz, float solutions (patent); 15 min"),
    ("P4", "cable-stayed bridge with traffic, .309, .507, .645 Hz, RTK at 1 Hz (Shan and Qi); 50 min"),
)
"""Of `simulate`: what each is, for its --help, which must not import the simulator (a test holds both together)."""


class WrongUseError(Exception):
    """The command line asks for what cannot be done; the text says what would be right."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    args = _parser().parse_args(argv)
    command: Callable[[argparse.Namespace], int] = args.command
    try:
        code = command(args)
        sys.stdout.flush()
        return code
    except WrongUseError as e:
        return _complain(str(e))
    except BrokenPipeError:  # `edge-agent cat ... | head`: the reader has what it wanted
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return GOOD
    except OSError as e:
        return _complain(f"{e.filename}: {e.strerror}" if e.filename else str(e))
    except KeyboardInterrupt:
        return 130


def _complain(text: str) -> int:
    print(f"edge-agent: {text}", file=sys.stderr)
    return WRONG_USE


def _say(text: str) -> None:
    print(text, file=sys.stderr)


def _result(args: argparse.Namespace, value: Any, text: str) -> None:
    """One result on stdout, as JSON where asked for."""
    print(json.dumps(value, indent=2, ensure_ascii=False) if args.json else text)


# ------------------------------------------------------------------------------------------------------------ commands


def _config(args: argparse.Namespace) -> Any:
    from edge_agent.config import ConfigError, load

    try:
        return load(args.config, getattr(args, "set", None) or ())
    except ConfigError as e:
        raise WrongUseError(f"{args.config} has {len(e.mistakes)} mistake(s):\n" + "\n".join(e.mistakes)) from None


def _run(args: argparse.Namespace) -> int:
    stops = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(number, _stopped) for number in stops]  # until the agent sees to them itself
    try:
        config = _config(args)
        from edge_agent.lock import InUseError
        from edge_agent.runtime import run

        try:
            return run(config)
        except InUseError as e:
            raise WrongUseError(f"run: {e}") from None
    finally:
        for number, handler in zip(stops, before, strict=True):
            signal.signal(number, handler)


def _stopped(number: int, frame: Any) -> None:
    """A stop while the service starts: an orderly end. A repair that it cuts short is done at the next start."""
    raise SystemExit(GOOD)


def _check(args: argparse.Namespace) -> int:
    from edge_agent.config import ConfigError, load, notes

    try:
        config = load(args.config, args.set or ())
    except ConfigError as e:
        count = f"{args.config}: {len(e.mistakes)} mistake{'' if len(e.mistakes) == 1 else 's'}"
        _result(args, {"ok": False, "mistakes": list(e.mistakes)}, "\n".join([count, *e.mistakes]))
        return WANTING
    parts = {k: list(getattr(config, k)) for k in ("ports", "receivers", "accelerometers", "points")}
    names = "; ".join(f"{k}: {', '.join(v) or 'none'}" for k, v in parts.items())
    from edge_agent import check

    result = {"ok": True, "mistakes": [], "site": config.site, **parts}
    text = f"{args.config}: good; {names}"
    if not args.live:
        # what is not there today is no mistake of the text: it may come, and the service waits for it
        told = [*notes(config), *(f"{f.where}: {f.text}" for f in check.today(config))]
        _result(args, {**result, "notes": told}, "\n".join([text, *(f"note: {t}" for t in told)]))
        return GOOD
    if not 0.1 <= args.seconds <= 3600:
        raise WrongUseError(f"--seconds {args.seconds:g}: 0.1 to 3600")
    from edge_agent.judge import BAD
    from edge_agent.lock import InUseError

    _say(f"listening to {', '.join(config.ports)} for {args.seconds:g} s")
    try:
        found = [*check.live(config, args.seconds), *check.disk(config)]
    except InUseError as e:
        raise WrongUseError(f"check --live: {e}") from None
    told = notes(config)
    bad = sum(f.level == BAD for f in found)
    lines = [text, *(f"note: {t}" for t in told), check.as_text(found)]
    lines.append(f"found wanting: {bad} BAD above" if bad else "live: good")
    _result(args, {**result, "ok": not bad, "notes": told, "live": check.as_json(found)}, "\n".join(lines))
    return WANTING if bad else GOOD


def _import(args: argparse.Namespace) -> int:
    import datetime

    from edge_agent.importer import MAX_NAMED, ImportRefusedError, import_logs

    if not args.nmea and not args.can:
        raise WrongUseError("import: name at least one log with --nmea or --can")
    config = _config(args) if args.config else None
    try:
        date = datetime.date.fromisoformat(args.date) if args.date else None
        if date is not None and not 1980 <= date.year < 2100:
            raise ValueError
    except ValueError:
        raise WrongUseError(f"--date {args.date}: write YYYY-MM-DD, 1980 to 2099") from None
    nmea = [_port_and_file(text, "gnss") for text in args.nmea]
    can = []
    for text in args.can:
        port, path = _port_and_file(text, "can")
        interface = None
        if not path.is_file() and ":" in path.name:
            name, _, interface = str(path).rpartition(":")
            path = Path(name)
        can.append((port, path, interface))
    try:
        done = import_logs(args.output, nmea=nmea, can=can, config=config, dbc=args.dbc, date=date)
    except ImportRefusedError as e:
        raise WrongUseError(f"import: {e}") from None
    for log in done.logs:
        for note in log.notes:
            _say(note)
        if log.noted > MAX_NAMED:
            _say(f"{log.path.name}: and {log.noted - MAX_NAMED} more")
        if log.other:
            _say(f"{log.path.name}: {log.other} frames of other interfaces than {log.interface} left out, as asked")
    kinds = [(log, "bytes" if i < len(nmea) else "frames") for i, log in enumerate(done.logs)]
    seconds = (done.last_utc_ns - done.first_utc_ns) / 1e9
    result = {
        "output": done.path,
        "blocks": done.raws,
        "ticks": done.ticks,
        "seconds": round(seconds, 3),
        "lost": done.lost,
        "logs": [
            {"file": str(log.path), "port": log.port, "lines": log.lines, kind: log.items, "lost": log.lost}
            for log, kind in kinds
        ],
    }
    text = [f"{done.path}: {seconds:.1f} s in {done.raws} blocks, {done.ticks} of them ticks"]
    text += [
        f"  {log.port}: {log.items} {kind} of {log.lines} lines of {log.path}, {log.lost} lines lost"
        for log, kind in kinds
    ]
    _result(args, result, "\n".join(text))
    return LOSS if done.lost else GOOD


def _port_and_file(text: str, default: str) -> tuple[str, Path]:
    """[PORT=]FILE; a file whose own name looks like that is taken as it stands."""
    m = NAMED_FILE.match(text)
    if m is None or Path(text).is_file():
        return default, Path(text)
    return m[1], Path(m[2])


def _place(command: str, path: Path, inputs: Sequence[Path]) -> None:
    """Refuse an output that could not be written, or would take a recording's place, before the work is done."""
    folder = path.absolute().parent
    if path.is_dir():
        raise WrongUseError(f"{command}: {path} is a folder: name a file in it")
    if not folder.is_dir():
        raise WrongUseError(f"{command}: there is no folder {folder}: make it first")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise WrongUseError(f"{command}: may not write into {folder}")
    inside = (p for i in inputs for p in ([i] if not i.is_dir() else i.iterdir()))
    if any(p.resolve() == path.resolve() for p in inside if ".mcap" in p.suffixes):
        raise WrongUseError(f"{command}: {path} is one of the recordings that are read: choose another name")
    if path.suffix != ".mcap" and path.is_file() and _begins(path):
        raise WrongUseError(f"{command}: {path} is a recording: a page must not take its place")


def _progress() -> Callable[[str], None] | None:
    """Says on one line of a terminal how far long work is; None where stderr is none."""

    def say(text: str) -> None:
        print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)

    return say if sys.stderr.isatty() else None


def _clear() -> None:
    """Wipe that line."""
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)


def _one_site(inputs: Sequence[Path]) -> None:
    """Settings are those of the first file, so all must be of its site."""
    from edge_agent.replay import in_order
    from edge_agent.review.sources import setups

    names = dict.fromkeys(s.config.site for s in setups(in_order(inputs)))
    if len(names) > 1:
        told = ", ".join(names)
        raise WrongUseError(f"replay: files of {len(names)} sites, {told}: name those of one, or give settings with -c")


def _compare(args: argparse.Namespace) -> int:
    """`replay --compare`: old settings against new ones."""
    if args.verify:
        raise WrongUseError("replay: --compare has two settings, --verify none that differ; choose one")
    if not args.set and not args.config:
        raise WrongUseError("replay: --compare needs other settings: --set path=value, or -c CONFIG")
    if args.page.suffix.lower() not in (".html", ".htm"):
        raise WrongUseError(f"replay: --page {args.page}: the page is HTML, name it so")
    _place("replay", args.page, args.inputs)
    from edge_agent.config import ConfigError
    from edge_agent.recording.reader import DamagedError
    from edge_agent.replay import ReplayError, in_order, recorded_config
    from edge_agent.review import compare

    try:
        if not args.config:
            _one_site(args.inputs)
        first = in_order(args.inputs)[0]
        if args.config:
            new = _config(args)
            old = _config(argparse.Namespace(config=args.config)) if args.set else recorded_config(first)
        else:
            old, new = recorded_config(first), recorded_config(first, args.set)
        folder = (args.output or args.page).absolute().parent
        found = compare.compare(args.inputs, args.output, old, new, args.set, folder, _progress())
        if args.smooth:
            from edge_agent.review.smoothed import add_smoothed

            add_smoothed(args.output)
    except (ReplayError, ConfigError) as e:
        raise WrongUseError(f"replay: {e}") from None
    except DamagedError as e:
        _say(f"edge-agent: replay: {e}")
        return WANTING
    finally:
        _clear()
    part = args.page.with_name(args.page.name + ".part")
    part.write_text(compare.page(found), encoding="utf-8")
    part.replace(args.page)
    _result(args, compare.as_json(found), compare.as_text(found))
    _say(f"page {args.page}")
    return GOOD


def _replay(args: argparse.Namespace) -> int:
    if args.smooth and args.output is None:
        raise WrongUseError("replay: --smooth writes into the new recording: give -o OUT")
    if args.output is not None:
        _place("replay", args.output, args.inputs)
    if args.compare:
        return _compare(args)
    if args.output is None and not args.verify:
        raise WrongUseError("replay: give -o OUT for a new recording, --verify to compare, or both")
    config = _config(args) if args.config else None
    from edge_agent.config import ConfigError
    from edge_agent.recording.reader import DamagedError
    from edge_agent.replay import ReplayError, in_order, recorded_config, replay

    try:
        if config is None:
            _one_site(args.inputs)
        if args.set and config is None:
            config = recorded_config(in_order(args.inputs)[0], args.set)
        report = replay(args.inputs, args.output, config, args.verify)
        if args.smooth:
            from edge_agent.review.smoothed import add_smoothed

            for point, n in add_smoothed(args.output).items():
                report.note(f"/fusion/{point}/smoothed: {n} samples")
    except (ReplayError, ConfigError) as e:
        raise WrongUseError(f"replay: {e}") from None
    except DamagedError as e:
        _say(f"edge-agent: replay: {e}")
        return WANTING
    _result(args, {"ok": report.ok, **dataclasses.asdict(report)}, str(report))
    return GOOD if report.ok else WANTING


def _info(args: argparse.Namespace) -> int:
    from edge_agent.cat import describe, describe_text

    files, wanting = describe(args.files)
    if not any("bytes" in f for f in files):  # none is a recording
        raise WrongUseError("info: " + "\n".join(f"{f['file']}: {f['damage']}" for f in files))
    _result(args, files, describe_text(files))
    return WANTING if wanting else GOOD


def _verify(args: argparse.Namespace) -> int:
    from edge_agent import verify

    def progress(path: Path) -> None:
        print(f"\r\x1b[K{path.name}", end="", file=sys.stderr, flush=True)

    talks = sys.stderr.isatty()
    verdict = verify.verify(args.paths, progress if talks else None)
    if talks:
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)
    if not verdict.files:
        raise WrongUseError(f"verify: no recording in {', '.join(map(str, args.paths))}")
    _result(args, verify.as_json(verdict), verify.as_text(verdict))
    if verdict.wanting:
        return WANTING
    return LOSS if verdict.lost else GOOD


def _review(args: argparse.Namespace) -> int:
    if args.output is None and not args.json:
        raise WrongUseError("review: give -o REPORT.html for the page, --json for its figures, or both")
    if args.output is not None:
        if args.output.suffix.lower() not in (".html", ".htm"):
            raise WrongUseError(f"review: -o {args.output}: the page is HTML, name it so")
        _place("review", args.output, args.inputs)
    from edge_agent.replay import ReplayError
    from edge_agent.review import ahead
    from edge_agent.review.report import as_text, review

    ahead.alone()
    try:
        found = review(args.inputs, args.output, _progress())
    except ReplayError as e:
        raise WrongUseError(f"review: {e}") from None
    finally:
        _clear()
    several = len(found) > 1
    figures = {"sites": {r.review.config.site: r.figures for r in found}} if several else found[0].figures
    _result(args, figures, "\n\n".join(as_text(r.review) for r in found))
    if several:
        names = ", ".join(r.review.config.site for r in found)
        _say(f"edge-agent: review: the files are of {len(found)} sites, each has its own page: {names}")
    for r in found:
        if r.page is not None:
            _say(f"report {r.page}")
    if any(r.review.damaged for r in found):
        return LOSS
    return WANTING if several else GOOD


def _tune(args: argparse.Namespace) -> int:
    from edge_agent.config import ConfigError
    from edge_agent.replay import ReplayError
    from edge_agent.review import tune

    try:
        found = tune.tune(args.inputs, _progress())
    except (ReplayError, ConfigError) as e:
        raise WrongUseError(f"tune: {e}") from None
    finally:
        _clear()
    _result(args, tune.as_json(found), tune.as_text(found))
    return GOOD


def _layouts(args: argparse.Namespace) -> int:
    from edge_agent import layouts
    from edge_agent.replay import ReplayError
    from edge_agent.review.sources import one_site, opened

    try:
        found = opened(args.inputs)
        one_site(found)
        written = layouts.write(found.config, args.output)
    except ReplayError as e:
        raise WrongUseError(f"layouts: {e}") from None
    for path in written:
        print(path)
    return GOOD


def _cat(args: argparse.Namespace) -> int:
    from edge_agent import cat

    try:
        begin = None if args.begin is None else cat.parse_time(args.begin)
        end = None if args.end is None else cat.parse_time(args.end)
    except ValueError as e:
        raise WrongUseError(f"cat: {e}") from None
    if args.format == "csv" and len(args.topic) != 1:
        try:
            there = "\n".join(f"  {t}" for t in cat.topics_of(args.files))
        except ValueError as e:
            raise WrongUseError(f"cat: {e}") from None
        raise WrongUseError(
            f"cat: CSV holds one topic; name it with --topic, or take --format jsonl. There are:\n{there}"
        )
    table = cat.rows(args.files, args.topic, begin, end)
    try:
        n = (cat.write_csv if args.format == "csv" else cat.write_jsonl)(sys.stdout, table)
    except ValueError as e:
        _say(f"edge-agent: cat: {e}")
        return WANTING
    if n == 0:
        _say("cat: nothing of that topic and time; `edge-agent info` lists what there is")
        return WANTING
    return GOOD


def _begins(path: Path) -> bool:
    """Whether a file begins as an MCAP file does."""
    from edge_agent.recording.reader import MAGIC

    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def _recover(args: argparse.Namespace) -> int:
    from edge_agent.lock import NAME, InUseError, hold
    from edge_agent.recording.repair import recover, repair
    from edge_agent.recording.writer import PART
    from edge_agent.replay import ended

    done = []
    for path in args.paths:
        if not path.is_dir() and not path.name.endswith((".mcap.part", ".mcap")):
            raise WrongUseError(f"recover: {path} is neither a folder nor a recording (*.mcap.part, *.mcap)")
        if path.name.endswith(".mcap") and path.is_file() and not _begins(path):
            raise WrongUseError(f"recover: {path} is no MCAP file: it is left as it is")
        folder = path if path.is_dir() else path.parent
        try:
            held = hold(folder) if (folder / NAME).exists() else None  # a folder that an agent once wrote into
        except InUseError as e:
            raise WrongUseError(f"recover: {e}") from None
        if path.is_dir():
            done += recover(path, thorough=True)
        elif path.name.endswith(PART):
            done.append(repair(path, thorough=True))
        elif not ended(path):  # a cut file under its final name, e.g. one that was copied while it was written
            done.append(repair(path.rename(path.with_name(path.name + PART)), thorough=True))
        if held is not None:
            os.close(held)
    result = [
        {"file": str(r.path), "what": r.what, "messages": r.messages, "lost_bytes": r.lost_bytes, "detail": r.detail}
        for r in done
    ]
    lines = [
        f"{r['file']}: {r['what']}, {r['messages']} messages kept, {r['lost_bytes']} bytes lost"
        + (f" ({r['detail']})" if r["detail"] else "")
        for r in result
    ]
    _result(args, result, "\n".join(lines) or "nothing to recover")
    if any(r.what == "failed" for r in done):
        return WANTING
    return LOSS if any(r.lost_bytes for r in done) else GOOD


def _status(args: argparse.Namespace) -> int:
    import time

    from edge_agent import status, watch

    data_dir = os.path.abspath(_config(args).data_dir) if args.config else None
    places = watch.places(os.environ, args.dir, data_dir)
    if args.watch and not args.json:
        watch.watch(
            sys.stdout, os.environ, lambda: status.load(places, data_dir), time.time_ns, lambda: time.sleep(1.0)
        )
        return GOOD
    while True:
        now = time.time_ns()  # before the file is read: a slow machine must not make it look old
        try:
            path, found = status.load(places, data_dir)
        except FileNotFoundError as e:
            hint = "" if args.dir or args.config else "; where the agent was started by hand, name its -c CONFIG"
            raise WrongUseError(f"{e}: does an agent run here?{hint}") from None
        except status.StatusError as e:
            _say(f"edge-agent: status: {e}")
            return WANTING
        if args.json:
            print(json.dumps(watch.report(path, found, now), ensure_ascii=False), flush=True)
        else:
            width, _ = watch.size()
            print(status.render(found, width, None, now, watch.ansi(sys.stdout, os.environ)[1]))
        if not args.watch:
            return WANTING if status.problems(found, now) else GOOD
        time.sleep(1.0)


def _simulate(args: argparse.Namespace) -> int:
    from edge_agent.simulate import SCENARIOS, simulate
    from edge_agent.simulate.files import write_files

    if args.scenario not in SCENARIOS:
        raise WrongUseError(f"simulate: no scenario {args.scenario!r}; there are: {', '.join(SCENARIOS)}")
    try:
        record = simulate(args.scenario, args.seed, args.seconds)
    except ValueError as e:
        raise WrongUseError(str(e)) from None
    for path in write_files(record, args.output):
        print(path)
    return GOOD


def _demo(args: argparse.Namespace) -> int:
    from edge_agent.demo import run_demo

    return run_demo(args.output, args.seconds, args.seed)


# -------------------------------------------------------------------------------------------------------------- parser


class _Version(argparse.Action):
    """--version, read from the installed package only when asked for."""

    def __init__(self, option_strings: Sequence[str], dest: str) -> None:
        super().__init__(option_strings, dest, nargs=0, help="print the version and exit")

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import version

        print(f"edge-agent {version('edge-agent')}")
        parser.exit()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="edge-agent",
        description="Fuses RTK GNSS and accelerometers on a gateway and records everything.",
        epilog="Exit codes: 0 good, 1 found wanting, 2 wrong use, 3 recovered with loss. "
        "`edge-agent COMMAND --help` shows an example of each.",
    )
    parser.add_argument("--version", action=_Version)
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    def add(
        name: str, command: Callable[[argparse.Namespace], int], about: str, example: str, more: str = ""
    ) -> argparse.ArgumentParser:
        p = commands.add_parser(
            name,
            help=about,
            description=about[0].upper() + about[1:] + ".",
            epilog=f"example:\n  {example}" + (f"\n\n{more}" if more else ""),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        p.set_defaults(command=command)
        return p

    def json_flag(p: argparse.ArgumentParser) -> None:
        p.add_argument("--json", action="store_true", help="the result as JSON")

    def config_flag(p: argparse.ArgumentParser, required: bool) -> None:
        p.add_argument("-c", "--config", type=Path, required=required, metavar="CONFIG", help="the YAML configuration")

    def set_flag(p: argparse.ArgumentParser) -> None:
        p.add_argument(
            "--set",
            action="append",
            default=[],
            metavar="PATH=VALUE",
            help="override one key, e.g. fusion.gate_alpha=0.01",
        )

    p = add("run", _run, "the service: read the ports, fuse, record, until SIGTERM", "edge-agent run -c site.yaml")
    config_flag(p, required=True)

    p = add(
        "check",
        _check,
        "check a configuration: every mistake with its path; --live: what arrives at its ports",
        "edge-agent check -c site.yaml\n  edge-agent check --live -c site.yaml",
    )
    config_flag(p, required=True)
    set_flag(p)
    p.add_argument("--live", action="store_true", help="open every port for some seconds and say what arrives")
    p.add_argument("--seconds", type=float, default=10.0, metavar="S", help="how long --live listens (10)")
    json_flag(p)

    p = add(
        "import",
        _import,
        "logs of others (NMEA, mixed binary, candump -l) to a raw recording",
        "edge-agent import -c site.yaml --nmea gps=rover.nmea --can can0=candump.log:can1 -o raw.mcap",
    )
    config_flag(p, required=False)
    p.add_argument(
        "--nmea", action="append", default=[], metavar="[PORT=]FILE", help="NMEA capture; PORT is gnss if unset"
    )
    p.add_argument(
        "--can",
        action="append",
        default=[],
        metavar="[PORT=]FILE[:IFACE]",
        help="candump -l log; PORT is can if unset; without IFACE every interface goes to that port",
    )
    p.add_argument("--dbc", action="append", default=[], type=Path, metavar="FILE", help="attach a DBC file")
    p.add_argument("--date", metavar="YYYY-MM-DD", help="day of the first sentence, where the sentences carry none")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.mcap")
    json_flag(p)

    p = add(
        "replay",
        _replay,
        "run recordings through the same data path again; verify or retune",
        "edge-agent replay --verify rec/*.mcap\n"
        "  edge-agent replay raw.mcap -c site.yaml --set fusion.gate_alpha=0.01 -o new.mcap\n"
        "  edge-agent replay rec/*.mcap --set fusion.accel_noise_m2ps3=1e-8 --compare --page compare.html",
    )
    p.add_argument("inputs", nargs="+", type=Path, metavar="IN")
    p.add_argument("-o", "--output", type=Path, metavar="OUT")
    config_flag(p, required=False)
    set_flag(p)
    p.add_argument(
        "--verify", action="store_true", help="compare every derived record with the recorded one, byte for byte"
    )
    p.add_argument(
        "--smooth", action="store_true", help="add the smoothed stream, which knows the whole record, to OUT"
    )
    p.add_argument(
        "--compare", action="store_true", help="settings before --set (or -c) against those after: figures and a page"
    )
    p.add_argument(
        "--page", type=Path, default=Path("compare.html"), metavar="PAGE.html", help="of --compare (compare.html)"
    )
    json_flag(p)

    p = add("status", _status, "what the running agent says of itself", "edge-agent status --watch")
    config_flag(p, required=False)
    p.add_argument(
        "--dir", action="append", default=[], type=Path, metavar="D", help="where status.json lies, or a data_dir"
    )
    p.add_argument("--watch", action="store_true", help="draw it anew each second, until Ctrl-C")
    json_flag(p)

    p = add("info", _info, "what recordings hold: times, topics, rates, run, continuity", "edge-agent info rec/*.mcap")
    p.add_argument("files", nargs="+", type=Path, metavar="FILE")
    json_flag(p)

    p = add(
        "verify",
        _verify,
        "is every file there and as it was written, what is missing and why",
        "edge-agent verify /var/lib/edge-agent",
    )
    p.add_argument("paths", nargs="+", type=Path, metavar="FOLDER|FILE")
    json_flag(p)

    p = add(
        "review",
        _review,
        "what moved, how much, how sure, at which frequencies, and what went wrong: one page",
        "edge-agent review /var/lib/edge-agent/recordings -o report.html",
        "Exit codes: 0 done; 1 done, but the files are of several sites: each has a page of its own,\n"
        "REPORT-SITE.html; 2 nothing to review, or no place for the page; 3 done, and damaged files are named.",
    )
    p.add_argument("inputs", nargs="+", type=Path, metavar="FOLDER|FILE")
    p.add_argument("-o", "--output", type=Path, metavar="REPORT.html", help="the page; it needs nothing but itself")
    json_flag(p)

    p = add(
        "tune",
        _tune,
        "would other settings have done better? Maximum likelihood of what was recorded, with sd and the gain",
        "edge-agent tune /var/lib/edge-agent/recordings",
    )
    p.add_argument("inputs", nargs="+", type=Path, metavar="FOLDER|FILE", help="recordings with a fused stream")
    json_flag(p)

    p = add(
        "layouts",
        _layouts,
        "layouts of Lichtblick (Foxglove) and PlotJuggler that open on displacement, gate, spectrum, map and log",
        "edge-agent layouts rec/*.mcap -o viewers/",
    )
    p.add_argument("inputs", nargs="+", type=Path, metavar="FOLDER|FILE", help="recordings, for the names in them")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")

    p = add(
        "cat",
        _cat,
        "any topic as CSV or JSON lines, with units, blocks as samples",
        "edge-agent cat --topic /fusion/mid/block rec/*.mcap > mid.csv",
    )
    p.add_argument("files", nargs="+", type=Path, metavar="FILE", help="taken in the order given")
    p.add_argument(
        "--topic", action="append", default=[], help="CSV: one; JSON lines: any number, all if none is named"
    )
    p.add_argument("--from", dest="begin", metavar="TIME", help="UTC, ISO or seconds since 1970; inclusive")
    p.add_argument("--to", dest="end", metavar="TIME", help="exclusive")
    p.add_argument("--format", choices=("csv", "jsonl"), default="csv")

    p = add(
        "recover", _recover, "make torn recordings (*.part) readable; nothing is deleted", "edge-agent recover rec/"
    )
    p.add_argument("paths", nargs="+", type=Path, metavar="FOLDER|FILE")
    json_flag(p)

    p = add(
        "simulate",
        _simulate,
        "a structure with sensors and faults of exactly known truth, as files",
        "edge-agent simulate hostile --seed 7 -o sim/",
        "scenarios:\n" + "\n".join(f"  {name:8}{text}" for name, text in SCENARIOS),
    )
    p.add_argument("scenario", metavar="SCENARIO", help="one of those below")
    p.add_argument("--seed", type=int, default=1, metavar="N", help="the same seed gives the same files")
    p.add_argument("--seconds", type=float, help="as the scenario says if unset")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="made where it is missing")

    p = add(
        "demo", _demo, "a simulated bridge plays through real ports into the live agent", "edge-agent demo -o demo-out"
    )
    p.add_argument("-o", "--output", type=Path, default=Path("demo-out"), metavar="DIR")
    p.add_argument("--seconds", type=float, default=60.0)
    p.add_argument("--seed", type=int, default=1)
    return parser


if __name__ == "__main__":
    sys.exit(main())
