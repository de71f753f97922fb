"""What a few seconds of a port's bytes or frames say about its wiring and settings: lists of Raw in, findings out.

Rules: pure, no clock and no I/O; everything is judged by the codecs that run live. A finding is `good`, a `note` (it
works, but know this) or `bad` (it will not do as configured), and says what would be right. Numbers are rounded for
eyes. Left out: opening ports, trying other baud rates (`check`).
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.binary_frames import HEAD, frame_error, frame_length
from drivers.dbc_codec import GRAVITY_MPS2, UNITS, AccelCodec
from drivers.nmea_codec import COARSE_STEP_M, NmeaCodec
from drivers.nmea_fields import xor8
from edge_agent.messages import (
    F64,
    MS,
    AccelBlock,
    AccelerometerSettings,
    CanFlag,
    CanFrames,
    GnssFix,
    PortSettings,
    Quality,
    Raw,
    ReceiverSettings,
    Reject,
    S,
    Tick,
)
from edge_agent.pipeline import RANK

GOOD, NOTE, BAD = "good", "note", "bad"

LATENCY_SLACK_MS = 20.0  # a latency that is wrong by so much is 1 mm at 50 mm/s
RATE_SLACK = 0.05  # of a configured rate: worse than any oscillator
TILT_NOTE_DEG, TILT_BAD_DEG = 5.0, 20.0  # of gravity from the z axis: a bracket that is not level, a wrong rotation
MOVING_MPS2 = 1.0  # sd of an acceleration: not at rest
INCOMPLETE_LEAST = 2  # samples with a missing axis at the begin: it was amid one, and their order was not known yet
LISTED = 12  # identifiers named in one line

_SENTENCE = re.compile(rb"\$([A-Z][A-Z0-9]{2,9})(?:,[ -#%-)+-~]*)?\*([0-9A-Fa-f]{2})")
_START = re.compile(rb"\$|\xb5b|\xd3[\x00-\x03]|\xaaD[\x12\x13\xb5]")
_HEADINGS = ("HDT", "THS", "AVR")


@dataclass(frozen=True, slots=True)
class Finding:
    level: str  # GOOD, NOTE, BAD
    where: str  # a path of the configuration
    text: str


# -------------------------------------------------------------------------------------------------------------- serial


@dataclass(slots=True)
class Stream:
    """What stands in a serial stream: sentences by talker and type, binary frames by protocol, sentences refused."""

    sentences: Counter[str]
    binary: Counter[str]
    bad: int = 0  # a sentence or frame whose check fails

    @property
    def valid(self) -> int:
        return self.sentences.total() + self.binary.total()


def scan(data: bytes) -> Stream:
    """Count the sentences and binary frames of a stream whose two ends may be cut."""
    found = Stream(Counter(), Counter())
    pos = 0
    while (match := _START.search(data, pos)) is not None:
        pos = match.start()
        name, length = frame_length(data[pos : pos + HEAD])
        if length > 0 and pos + length <= len(data):
            if not frame_error(name, data[pos : pos + length]):
                found.binary[name] += 1
                pos += length
                continue
            found.bad += name != "RTCM3"  # two bytes of its head say little: most are chance
        elif data[pos] == 0x24 and (sentence := _SENTENCE.match(data, pos)) is not None:
            if xor8(data[pos + 1 : sentence.end() - 3]) == int(sentence[2], 16):
                found.sentences[sentence[1].decode()] += 1
            else:
                found.bad += 1
            pos = sentence.end()
            continue
        pos += 1
    return found


def payloads(raws: Sequence[Raw]) -> bytes:
    """The bytes of a serial port in one piece."""
    return b"".join(raw.payload for raw in raws if isinstance(raw.payload, bytes))


def judge_serial(
    port: PortSettings, receiver: ReceiverSettings | None, raws: Sequence[Raw], ticks: Sequence[Raw], seconds: float
) -> list[Finding]:
    """Judge what a serial port read in `seconds`; `ticks` = the clock port's Raws of the same time."""
    where = f"ports.{port.name}"
    data = payloads(raws)
    if not data:
        text = "nothing came: check power, the cable (transmit to receive), the baud rate, and that this output is on"
        return [Finding(BAD, where, text)]
    found = scan(data)
    each = [f"{k} {n / seconds:.3g}/s" for k, n in (*found.sentences.most_common(), *found.binary.most_common())]
    if not found.valid:
        text = f"{len(data) / seconds:.0f} bytes/s, but no sentence and no frame of a known protocol in them"
        return [Finding(BAD, where, text)]
    out = [Finding(GOOD, where, f"{len(data) / seconds:.0f} bytes/s: {', '.join(each)}")]
    if found.bad > 1 + 0.01 * found.valid:  # the first may have been cut
        text = f"{found.bad} of {found.bad + found.valid} fail their checksum: noise, a bad ground, or bytes lost"
        out.append(Finding(BAD, where, text))
    if receiver is not None:
        out += _judge_receiver(receiver, found, raws, ticks)
    return out


def _judge_receiver(
    receiver: ReceiverSettings, found: Stream, raws: Sequence[Raw], ticks: Sequence[Raw]
) -> Iterator[Finding]:
    where = f"receivers.{receiver.name}"
    offset, sync = _clock(ticks)
    codec = NmeaCodec()
    items = [i for r in raws if isinstance(r.payload, bytes) for i in codec.feed(r.t_ns, r.payload, r.t_ns + offset)]
    fixes = [i for i in (*items, *codec.finish()) if isinstance(i, GnssFix)]
    kinds = {name.removeprefix("PTNL")[-3:] for name in found.sentences}
    if receiver.heading and not kinds & set(_HEADINGS):
        yield Finding(BAD, f"{where}.heading", f"no heading comes: switch on one of {', '.join(_HEADINGS)}")
    if not fixes:
        yield Finding(BAD, where, "no position comes: switch on GGA (and GST)")
        return
    good = [f for f in fixes if f.quality > 0 and not math.isnan(f.lat_deg)]
    shares = ", ".join(
        f"{q.name.lower()} {100 * n / len(fixes):.0f} %" for q, n in Counter(f.quality for f in fixes).most_common()
    )
    rate = _rate([f.utc_ns for f in fixes if f.utc_ns])
    often = f"{rate:.3g} fixes/s" if rate else f"{len(fixes)} fixes"
    if not good:
        yield Finding(
            BAD, where, f"{often}, none with a position: check the antenna, its cable and its view of the sky"
        )
        return
    satellites = [f.satellites for f in good]
    least, most = min(satellites), max(satellites)
    sky = f"{least}{f' to {most}' if most > least else ''} satellites, HDOP {max(f.hdop for f in good):.3g} at worst"
    used = sum(RANK.get(f.quality, 0) >= RANK[receiver.min_quality] for f in good)
    yield Finding(GOOD, where, f"{often}: {shares}; {sky}")
    if not used:
        text = f"no fix reaches {receiver.min_quality.name.lower()}: are corrections coming? Until then none is used"
        yield Finding(BAD, f"{where}.min_quality", text)
    elif Quality.FIXED not in {f.quality for f in good}:
        yield Finding(NOTE, where, "no fixed solution: the start waits for 15 s of them")
    yield _decimals(where, good)
    if "GST" not in kinds:
        text = "no GST comes: accuracy is guessed from the quality and DOP; switch GST on"
        yield Finding(NOTE, where, text)
    if not any(f.date_known for f in fixes):
        text = "no date comes (RMC or ZDA): the gateway's clock must know the day"
        yield Finding(NOTE, where, text)
    yield _latency(receiver, good, offset, sync)


def _decimals(where: str, fixes: Sequence[GnssFix]) -> Finding:
    # zeros at the end are dropped by some receivers: the finest step is what it can say
    north, up = (min(f.resolution_enu_m[i] for f in fixes) for i in (1, 2))
    text = f"one step of the last decimal is {1000 * north:.2g} mm north, {1000 * up:.2g} mm up"
    if north <= COARSE_STEP_M and up <= COARSE_STEP_M:
        return Finding(GOOD, where, text)
    more = "send at least 7 decimals of a minute and 3 of the height (u-blox: CFG-NMEA-HIGHPREC; others: more digits)"
    return Finding(BAD, where, f"{text}, too coarse: {more}")


def _latency(receiver: ReceiverSettings, fixes: Sequence[GnssFix], offset: int, sync: bool) -> Finding:
    where = f"receivers.{receiver.name}.latency_ms"
    late = np.array([(f.arrival_ns + offset - f.utc_ns) / MS for f in fixes if f.utc_ns and offset])
    if not late.size:
        return Finding(NOTE, where, "the sentences carry no time, so their latency cannot be told")
    mean, sd = float(np.mean(late)), float(np.std(late))
    if not sync:
        text = "the gateway's clock is not disciplined (chrony), so the latency of the fixes cannot be told"
        return Finding(NOTE, where, f"{text}; against it {mean:.0f} ms, sd {sd:.1f} ms")
    text = f"fixes arrive {mean:.0f} ms after their time, sd {sd:.1f} ms"
    if mean < 0:
        return Finding(BAD, where, f"{text}: before it, so the gateway's clock or the receiver's time is wrong")
    if receiver.latency_ms is not None and abs(mean - receiver.latency_ms) > LATENCY_SLACK_MS:
        return Finding(
            BAD, where, f"{text}, not {receiver.latency_ms:g}: correct it, or leave it out to have it learned"
        )
    return Finding(GOOD, where, text)


def _clock(ticks: Sequence[Raw]) -> tuple[int, bool]:
    """(UTC - monotonic in ns, disciplined) by the last Tick; 0 where there is none."""
    for raw in reversed(ticks):
        if isinstance(raw.payload, Tick):
            return raw.payload.utc_ns - raw.t_ns, raw.payload.sync
    return 0, False


def _rate(stamps: Sequence[int]) -> float:
    """Events a second of ascending stamps by their median interval; 0 = not known."""
    steps = np.diff(np.array(stamps, np.int64))
    steps = steps[steps > 0]
    return S / float(np.median(steps)) if steps.size else 0.0


# ----------------------------------------------------------------------------------------------------------------- CAN


def judge_can(
    port: PortSettings,
    accelerometers: Sequence[AccelerometerSettings],
    raws: Sequence[Raw],
    seconds: float,
    bitrate: int | None,
    names: Mapping[tuple[bool, int], str],
) -> list[Finding]:
    """Judge what a CAN port read in `seconds`. `accelerometers`: those of this port; `bitrate` None = not known;
    `names`: (extended, identifier) -> message as the DBC files call it."""
    where = f"ports.{port.name}"
    blocks = [raw.payload for raw in raws if isinstance(raw.payload, CanFrames)]
    errors = sum(int(np.count_nonzero(b.flags & CanFlag.ERR)) for b in blocks)
    dropped = sum(b.dropped for b in blocks)
    frames = sum(b.t_ns.size for b in blocks) - errors
    out: list[Finding] = []
    if errors:
        text = f"{errors} error frames: check the bit rate, the termination (60 ohm from CAN_H to CAN_L) and the ground"
        out.append(Finding(BAD, where, text))
    if not frames:
        text = "no frame came: check power, the bit rate, CAN_H and CAN_L, the termination (60 ohm between them), and"
        return [Finding(BAD, where, f"{text} that the sensor sends by itself"), *out]
    load = _load(blocks, seconds, bitrate)
    out.insert(0, Finding(BAD if load > 80 else GOOD, where, f"{frames / seconds:.4g} frames/s{_load_text(load)}"))
    if dropped:
        out.append(Finding(BAD, where, f"the kernel dropped {dropped} frames: is this machine too busy?"))
    seen = _identifiers(blocks)
    mine: dict[tuple[bool, int], list[str]] = {}
    for settings in accelerometers:
        listens = _listens(AccelCodec(settings), blocks, seen)
        for key in listens:
            mine.setdefault(key, []).append(settings.name)
        out += _judge_accelerometer(settings, blocks, listens)
    unknown = [k for k in seen if k not in mine]
    for key, (count, lengths) in seen.items():
        if key in mine:
            sizes = "/".join(str(n) for n in lengths)
            text = (
                f"0x{key[1]:X} {count / seconds:.4g}/s of {sizes} bytes{_called(names, key)} -> {', '.join(mine[key])}"
            )
            out.insert(1, Finding(GOOD, where, text))
    if unknown:
        each = ", ".join(f"0x{k[1]:X}{_called(names, k)} {seen[k][0] / seconds:.3g}/s" for k in unknown[:LISTED])
        more = f" and {len(unknown) - LISTED} more" if len(unknown) > LISTED else ""
        out.append(Finding(NOTE if accelerometers else GOOD, where, f"recorded, decoded by nobody: {each}{more}"))
    return out


def _identifiers(blocks: Sequence[CanFrames]) -> dict[tuple[bool, int], tuple[int, list[int]]]:
    """(extended, identifier) -> (frames, lengths), the most frequent first."""
    count: Counter[tuple[bool, int]] = Counter()
    lengths: dict[tuple[bool, int], set[int]] = {}
    for b in blocks:
        for can_id, flags, length in zip(b.can_id.tolist(), b.flags.tolist(), b.length.tolist(), strict=True):
            if not flags & CanFlag.ERR:
                key = (bool(flags & CanFlag.EXT), can_id)
                count[key] += 1
                lengths.setdefault(key, set()).add(length)
    return {k: (n, sorted(lengths[k])) for k, n in count.most_common()}


def _called(names: Mapping[tuple[bool, int], str], key: tuple[bool, int]) -> str:
    return f" ({names[key]})" if key in names else ""


def _of(block: CanFrames, key: tuple[bool, int]) -> CanFrames:
    """The frames of one identifier."""
    extended = (block.flags & CanFlag.EXT != 0) == key[0]
    at = np.flatnonzero((block.can_id == key[1]) & extended & (block.flags & CanFlag.ERR == 0))
    return CanFrames(block.t_ns[at], block.can_id[at], block.flags[at], block.length[at], block.data[at])


def _listens(
    codec: AccelCodec, blocks: Sequence[CanFrames], seen: Mapping[tuple[bool, int], object]
) -> list[tuple[bool, int]]:
    """The identifiers that a codec takes: asked of itself, whatever its rule of matching is."""
    fresh = codec.save()
    found = []
    for key in seen:
        codec.load(fresh)
        for block in blocks:
            one = _of(block, key)
            if one.t_ns.size:
                codec.feed(one)
                break
        if codec.counters["frames"]:
            found.append(key)
    return found


def _judge_accelerometer(
    settings: AccelerometerSettings, blocks: Sequence[CanFrames], listens: Sequence[tuple[bool, int]]
) -> Iterator[Finding]:
    where = f"accelerometers.{settings.name}"
    codec = AccelCodec(settings)
    wanted = sorted(codec.ids)
    if not listens:
        ids = ", ".join(f"0x{can_id:X}{' (29 bits)' if extended else ''}" for extended, can_id in wanted)
        yield Finding(BAD, where, f"none of its frames came: {ids}; check the sensor's address and the ids")
        return
    samples: list[AccelBlock] = []
    reasons: Counter[str] = Counter()
    for block in blocks:
        got, remarks = codec.feed(block)
        for r in remarks:
            if isinstance(r, Reject):
                reasons[r.reason] += r.count
        if got is not None:
            samples.append(got)
    if samples and codec.counters["incomplete"] <= INCOMPLETE_LEAST:
        del reasons["INCOMPLETE"]
    if reasons:
        text = f"frames refused: {', '.join(f'{n} {k}' for k, n in reasons.most_common())}"
        yield Finding(BAD, where, f"{text}; check the DBC file against the sensor")
    if not samples:
        if not reasons:
            yield Finding(BAD, where, "frames came, but no sample is complete: an axis is missing")
        return
    xyz = np.concatenate([b.xyz for b in samples])
    t_ns = np.concatenate([b.t_ns for b in samples])
    span = float(t_ns[-1] - t_ns[0]) / S
    rate = (len(t_ns) - 1) / span if span > 0 else 0.0
    lost = codec.counters["lost"]
    gaps = f", {lost} missing" if settings.counter is not None else ""
    yield Finding(GOOD, where, f"{len(xyz)} samples, {rate:.4g}/s{gaps}; the first is ({_listed(xyz[0], 3)}) m/s2")
    if lost > 0.01 * len(xyz):
        yield Finding(BAD, where, f"{lost} samples missing by the sensor's own counter")
    if settings.rate_hz is not None and rate and abs(rate / settings.rate_hz - 1) > RATE_SLACK:
        text = f"samples come at {rate:.4g} Hz, not {settings.rate_hz:g}: correct it, or leave it out"
        yield Finding(BAD, f"{where}.rate_hz", text)
    yield from _judge_gravity(settings, xyz)


def _judge_gravity(settings: AccelerometerSettings, xyz: F64) -> Iterator[Finding]:
    """At rest a sensor shows gravity, upwards: the one thing that is known of unit and mounting."""
    where = f"accelerometers.{settings.name}"
    if len(xyz) < 10:
        return
    mean = np.mean(xyz, axis=0)
    norm = math.sqrt(float(np.sum(mean**2)))
    sd = float(np.max(np.std(xyz, axis=0)))
    said = f"mean ({_listed(mean, 2)}) m/s2"
    if abs(norm / GRAVITY_MPS2 - 1) > RATE_SLACK:
        yield _no_gravity(settings, norm, sd, said)
        return
    tilt = math.degrees(math.acos(max(-1.0, min(1.0, float(mean[2]) / norm))))
    if tilt > TILT_BAD_DEG:
        row = settings.rotation
        up = [sum(row[i][k] * float(mean[i]) for i in range(3)) / norm for k in range(3)]  # in the sensor's own axes
        best = max(range(3), key=lambda k: abs(up[k]))
        third = [round(math.copysign(1, up[k])) if k == best else 0 for k in range(3)]
        name = f"{'-' if up[best] < 0 else '+'}{'xyz'[best]}"
        text = f"gravity is not on z but at ({_listed(mean, 1)}): the sensor's own {name} points up"
        yield Finding(BAD, f"{where}.rotation", f"{text}, so the third row should be {third}")
    elif tilt > TILT_NOTE_DEG:
        text = f"gravity is {tilt:.0f} deg from z: put that into the rotation, or level the sensor"
        yield Finding(NOTE, f"{where}.rotation", f"{text}; {said}")
    else:
        yield Finding(GOOD, where, f"gravity {norm:.2f} m/s2 on +z, {tilt:.1f} deg from it; sd {sd:.2g} m/s2")


def _listed(values: F64, decimals: int) -> str:
    return ", ".join(f"{round(v, decimals) + 0.0:.{decimals}f}" for v in values.tolist())  # + 0.0: no -0.0


def _no_gravity(settings: AccelerometerSettings, norm: float, sd: float, said: str) -> Finding:
    where = f"accelerometers.{settings.name}"
    for unit, factor in UNITS.items():
        if abs(norm / UNITS[settings.unit] * factor / GRAVITY_MPS2 - 1) < RATE_SLACK:
            return Finding(BAD, f"{where}.unit", f"{said}: with unit: {unit} it would be gravity")
    if sd > MOVING_MPS2:
        return Finding(NOTE, where, f"{said}, sd {sd:.1f}: not at rest, so gravity cannot be told")
    if norm < 0.05 * GRAVITY_MPS2:
        return Finding(NOTE, where, f"{said}: no gravity; a sensor that blocks it is good for vibration only")
    return Finding(BAD, where, f"{said}, length {norm:.2f}: at rest it is 9.81; check scale, unit and signals")


def _load(blocks: Sequence[CanFrames], seconds: float, bitrate: int | None) -> float:
    """Largest load of the bus in % of the bit rate, NaN where that is not known or there are FD frames.

    A classic frame of n bytes has g + 8n + 13 bits, the space behind it counted, and at most (g + 8n - 1) // 4 stuff
    bits; g = 34, or 54 with a 29-bit identifier (R. I. Davis et al., Real-Time Systems 35, 2007). Real data has fewer.
    """
    bits = 0
    for b in blocks:
        if (b.flags & CanFlag.FD).any():
            return math.nan
        g = np.where(b.flags & CanFlag.EXT, 54, 34) + 8 * b.length.astype(np.int64) * (b.flags & CanFlag.RTR == 0)
        bits += int(np.sum(g + 13 + (g - 1) // 4))
    return 100 * bits / seconds / bitrate if bitrate else math.nan


def _load_text(load: float) -> str:
    return "" if math.isnan(load) else f", at most {load:.0f} % of what the bus can carry"
