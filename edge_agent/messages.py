"""Every value that crosses a module boundary, frozen and wearing its unit.

Rules: times are int64 nanoseconds (`_ns`); monotonic unless the name says `utc`. Lengths are metres, accelerations
m/s2, angles degrees. Axes of three are structure axes (x, y, z up) unless a name says otherwise. Residual = z - Hx;
a_true = a_measured - b. No value here holds behaviour beyond what its fields say, and none imports another module of
the project.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

F64: TypeAlias = npt.NDArray[np.float64]
I64: TypeAlias = npt.NDArray[np.int64]
U8: TypeAlias = npt.NDArray[np.uint8]
U32: TypeAlias = npt.NDArray[np.uint32]

S = 1_000_000_000
"""Nanoseconds in a second."""
MS = 1_000_000
"""Nanoseconds in a millisecond."""

# ---------------------------------------------------------------------------------------------------------------- raw


class CanFlag(enum.IntFlag):
    """Bits of `CanFrames.flags`."""

    EXT = 1  # 29-bit identifier
    RTR = 2  # remote request, carries no data
    ERR = 4  # error frame of the controller, `can_id` holds the error class
    FD = 8
    BRS = 16
    ESI = 32
    DRAIN = 64  # stamped when the socket was drained, not when the frame arrived
    SPREAD = 128  # wall clock stepped under the kernel's stamp: spread evenly over the drain interval


@dataclass(frozen=True, slots=True)
class CanFrames:
    """A packed block of CAN frames in the order of arrival, columns not rows.

    t_ns (n,) int64 monotonic; can_id (n,) uint32 without flag bits; flags (n,) uint8 of `CanFlag`; length (n,) uint8
    bytes used; data (n, w) uint8, w = 8 (classic) or 64 (any FD frame in the block), zero beyond `length`;
    dropped = frames that the kernel dropped since the block before.
    """

    t_ns: I64
    can_id: U32
    flags: U8
    length: U8
    data: U8
    dropped: int = 0


@dataclass(frozen=True, slots=True)
class Tick:
    """The clock port's second: host wall time at a monotonic instant. Wall time enters the agent only here."""

    utc_ns: int
    sync: bool  # the kernel says that the wall clock is disciplined
    error_ns: int  # the kernel's estimate of its error; 0 = not known


@dataclass(frozen=True, slots=True)
class Raw:
    """What a port read, exactly. `order` is its place in the order of `Pipeline.step`, given by the main thread."""

    t_ns: int
    order: int
    source: str  # name of the port; "clock" for ticks
    payload: bytes | CanFrames | Tick


# ------------------------------------------------------------------------------------------------------------ decoded


class Quality(enum.IntEnum):
    """GGA quality indicator (NMEA 0183)."""

    NONE = 0
    SINGLE = 1
    DGNSS = 2
    PPS = 3
    FIXED = 4
    FLOAT = 5
    ESTIMATED = 6
    MANUAL = 7
    SIMULATED = 8


@dataclass(frozen=True, slots=True)
class GnssFix:
    """One epoch of one receiver.

    `utc_ns` is when it was true by the receiver's clock (0 = no time in the sentence); `arrival_ns` the monotonic stamp
    of the read that completed the position sentence; `t_ns` when it was true on the monotonic clock (0 until the
    pipeline's time base has set it). NaN = the receiver did not say.
    """

    t_ns: int
    arrival_ns: int
    utc_ns: int
    date_known: bool  # the date came from RMC or ZDA, not from the host's clock
    lat_deg: float
    lon_deg: float
    h_m: float  # ellipsoidal; MSL + separation
    separation_m: float
    quality: Quality
    satellites: int
    hdop: float
    pdop: float
    vdop: float
    age_s: float  # of the corrections
    station: str
    std_enu_m: tuple[float, float, float]  # of GST
    resolution_enu_m: tuple[float, float, float]  # one step of the last decimal
    sentences: tuple[str, ...]  # e.g. ("GGA", "GST"), in the order of arrival
    course_deg: float = math.nan  # over ground, clockwise from true north; of VTG
    speed_mps: float = math.nan


@dataclass(frozen=True, slots=True)
class GnssHeading:
    """One heading of a receiver with two antennas: the azimuth from the first antenna to the second.

    Times as in `GnssFix`; `utc_ns` 0 = the sentence has no time of its own and does not stand first in its epoch.
    `quality` NONE = the receiver says that it is not valid, FIXED = fixed, or the sentence does not tell.
    """

    t_ns: int
    arrival_ns: int
    utc_ns: int
    heading_deg: float  # 0 to 360, clockwise from true north
    quality: Quality
    tilt_deg: float  # second antenna above the first
    baseline_m: float  # between the antennas
    resolution_deg: float  # one step of the last decimal
    sentence: str  # AVR, THS or HDT


class AccelFlag(enum.IntFlag):
    """Bits of `AccelBlock.flags`."""

    SATURATED = 1
    GAP_BEFORE = 2  # samples are missing between this one and the one before
    STUCK = 4
    SPIKE = 8
    FITTED = 16  # time from the counter or the rate, not from an arrival stamp
    INCOMPLETE = 32  # an axis of the sample was missing and holds NaN


STUCK_SAMPLES = 48
"""So many samples before the first that is flagged STUCK may already have been so."""


@dataclass(frozen=True, slots=True)
class AccelBlock:
    """Samples of one accelerometer: t_ns (n,) int64, xyz (n, 3) m/s2, flags (n,) uint8 of `AccelFlag`,
    count (n,) int64: the sample's number by the device's unwrapped counter, or by arrival where it has none.

    From a codec, `t_ns` is the arrival stamp and xyz is already in structure axes; the pipeline replaces `t_ns` by the
    time base's.
    """

    source: str
    t_ns: I64
    xyz: F64
    flags: U8
    count: I64
    drain_stamped: bool = False  # some frame of this block was stamped at the drain


@dataclass(frozen=True, slots=True)
class Reject:
    """Input that was refused: bytes, a sentence, a frame. `count` > 1 where repeats were folded."""

    t_ns: int
    source: str
    reason: str  # a stable upper-case word, e.g. "CHECKSUM"
    detail: str  # what stood there and what would be right
    count: int = 1


@dataclass(frozen=True, slots=True)
class Event:
    """Something the pipeline decided or noticed. `begin_ns`/`end_ns` 0 = a moment at `t_ns`."""

    t_ns: int
    kind: str
    source: str
    text: str
    values: tuple[tuple[str, float], ...] = ()
    begin_ns: int = 0
    end_ns: int = 0


@dataclass(frozen=True, slots=True)
class Fault:
    """The world failed (device gone, disk full). Belongs to the runtime; goes on `/faults`."""

    t_ns: int
    source: str
    kind: str
    text: str
    values: tuple[tuple[str, float], ...] = ()


# -------------------------------------------------------------------------------------------------------------- fused


@dataclass(frozen=True, slots=True)
class Measurement:
    """A fix as the filter takes it: position in structure axes about the reference, with its sd by the R rule."""

    t_ns: int  # when it was true, monotonic
    arrival_ns: int
    z_m: tuple[float, float, float]
    std_m: tuple[float, float, float]
    quality: Quality
    time_uncertain: bool = False


class Verdict(enum.IntEnum):
    ACCEPTED = 0
    REJECTED = 1
    OFFSET = 2  # used as z - o while a level offset is open
    PRECHECK = 3  # quality, age or range: never reached the gate
    OLD = 4  # older than the anchor: counted, dropped
    START = 5  # belongs to the start window


class Mode(enum.IntEnum):
    INIT = 0
    FUSED = 1
    GNSS_ONLY = 2
    ACCEL_ONLY = 3
    COAST = 4
    CONTRADICTION = 5
    INVALID = 6


class FusionFlag(enum.IntFlag):
    FLOAT = 1
    JUMP_OPEN = 2
    ACCEL_GAP = 4
    DEGRADED = 8
    TIME_UNCERTAIN = 16


VALID_MODES = (Mode.FUSED, Mode.GNSS_ONLY, Mode.COAST)


@dataclass(frozen=True, slots=True)
class Innovation:
    """The gate's word on one fix. ratio = v'S^-1 v / chi2(.999, dof); fits iff <= 1."""

    point: str
    t_ns: int
    residual_m: F64  # (3,)
    variance_m2: F64  # (3, 3)
    ratio: float
    verdict: Verdict
    latency_ns: int  # arrival - t_ns
    std_m: F64  # (3,) of the measurement as used
    offset_m: F64  # (3,) level offset at that time, 0 when closed


@dataclass(frozen=True, slots=True)
class HeadingEstimate:
    """The heading filter's word on one heading; NaN before its start. ratio = nu^2 / S / chi2(.999, 1); fits iff <= 1.

    `heading_deg` 0 to 360 and `std_deg` are the estimate with this heading in it, `measured_deg` what the receiver
    said, `std_measured_deg` the sd it was used with."""

    t_ns: int
    heading_deg: float
    std_deg: float
    measured_deg: float
    std_measured_deg: float
    tilt_deg: float  # as the receiver said
    baseline_m: float
    ratio: float
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class Estimate:
    """A block of the fused stream of one point: t_ns (n,), displacement/velocity and their sd (n, 3) in m and m/s,
    mode (n,) uint8 of `Mode`, flags (n,) uint8 of `FusionFlag`; bias (3,) m/s2 and offset (3,) m with their sd (3,) at
    the block's anchor. `revision` 0 = live, 1 = fixed-lag smoothed, 2 = final."""

    point: str
    t_ns: I64
    displacement_m: F64
    velocity_mps: F64
    std_displacement_m: F64
    std_velocity_mps: F64
    mode: U8
    flags: U8
    bias_mps2: F64
    std_bias_mps2: F64
    offset_m: F64
    std_offset_m: F64
    revision: int = 0


# ---------------------------------------------------------------------------------------------------------- recording


@dataclass(frozen=True, slots=True)
class Record:
    """One MCAP message, encoded. `log_ns` and `publish_ns` are UTC by the segment's map."""

    topic: str
    log_ns: int
    publish_ns: int
    data: bytes
    derived: bool  # `replay --verify` compares it; refused first when the outbox fills
    schema: str = ""  # "" = as the topic says (recording.topics.schema_of); `/raw/<port>` must name it


@dataclass(frozen=True, slots=True)
class Rotate:
    """In-band order to close a segment and open the next, whose first record is `checkpoint` (a `/raw/checkpoint`
    Record). `utc_ns` names the file."""

    checkpoint: Record
    utc_ns: int
    reason: str
    sync: bool = True  # the wall clock is disciplined: only then may recordings be deleted for their age


# ----------------------------------------------------------------------------------------------------------- settings
# Frozen values that edge_agent.config makes from the YAML. A default stands with its unit and its reason.


@dataclass(frozen=True, slots=True)
class Structure:
    azimuth_deg: float = 90.0  # x axis, clockwise from true north; 90 = East, so x y z = E N U
    reference_llh: tuple[float, float, float] | None = None  # deg, deg, ellipsoidal m; None = median of the start


@dataclass(frozen=True, slots=True)
class PortSettings:
    name: str
    kind: str  # "serial" | "can"; "clock" is made by the agent itself
    device: str = ""  # serial: path, by-id preferred
    baud: int = 115200  # the usual default of RTK receivers
    interface: str = "socketcan"  # python-can's interface name
    channel: str = "can0"
    bitrate: int | None = None  # bit/s; None = as the system has set it
    fd: bool = False
    drain_ms: int = 20  # wake-ups cost more than reads; 20 ms at 2000 frames/s fill a seventh of the default buffer
    block_ms: int = 100  # one Raw per block: latency of the fused stream against cost per record


@dataclass(frozen=True, slots=True)
class ReceiverSettings:
    name: str
    port: str
    latency_ms: float | None = None  # None = learned against a synchronised host clock
    sigma_floor_m: tuple[float, float, float] = (0.001, 0.001, 0.002)  # no RTK receiver is better than 1/1/2 mm
    min_quality: Quality = Quality.FLOAT  # FLOAT: fixed and float are used; FIXED: fixed only; SINGLE: anything
    heading: bool = False  # most receivers have one antenna


@dataclass(frozen=True, slots=True)
class SignalField:
    """One number in a CAN frame, where no DBC file says so. Bit order as DBC: `start` counts as in the DBC file."""

    can_id: int
    start: int
    length: int
    byteorder: str = "little"
    signed: bool = True
    is_float: bool = False
    scale: float = 1.0
    offset: float = 0.0
    extended: bool = False
    pgn: int | None = None  # J1939: stands for `can_id`; any priority, source as `source_address` says


@dataclass(frozen=True, slots=True)
class AccelerometerSettings:
    name: str
    port: str
    unit: str = "m/s2"  # m/s2 | g | mg | gal
    dbc: str | None = None  # path as written in the YAML
    dbc_text: str = ""  # its content, read by config; the codec does no I/O
    signals: tuple[str, str, str] | None = None  # x, y, z: "Message.Signal" or "Signal"
    fields: tuple[SignalField, SignalField, SignalField] | None = None
    counter: str | SignalField | None = None
    sync: int | None = None  # CANopen: identifier of the SYNC at which the sensor samples; None = it samples by itself
    source_address: int | None = None  # J1939: whose messages; None = of a PGN anybody's, if only one sends it
    rate_hz: float | None = None  # None = learned
    range_mps2: float | None = None  # full scale; beyond 0.999 of it a sample is SATURATED
    rotation: tuple[tuple[float, float, float], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class PointSettings:
    name: str
    receiver: str | None = None
    accelerometer: str | None = None


@dataclass(frozen=True, slots=True)
class FusionSettings:
    """Every noise figure and limit of the filter; source: the project's numerical study unless a comment names another.
    Every field has its unit in its name and a reason.
    """

    start_s: float = 15.0  # window of fixed epochs before anything is emitted
    gate_alpha: float = 0.001  # false rejection of a good fix by the joint chi-square gate
    reacquire_s: float = 120.0  # T_re: longer than the longest wrong fix; then d takes the offset over
    wait_s: float = 0.5  # a fix waits for accelerations up to its time at most so long in Raw time
    invalid_std_horizontal_m: float = 0.050  # architecture: mode INVALID beyond
    invalid_std_vertical_m: float = 0.075
    invalid_outage_s: float = 30.0
    degraded_std_m: float = 0.005
    coast_s: float = 3.0  # without a used fix so long, the estimate is COAST: beyond any usual interval plus latency
    outage_s: float = 5.0  # after so long without a used fix, three must agree where the prediction cannot protect
    lockout_s: float = 10.0  # refusals that agree on nothing may last so long, then everything is re-opened
    accel_noise_m2ps3: float = 1e-7  # centre of the prior on q: 0.03 mg/rtHz, a good MEMS; two-sided density
    accel_noise_decades: float = 1.25  # its sd in powers of ten: from a quartz servo to a poorly mounted sensor
    bias_walk_m2ps5: float = 1e-9  # centre of the prior on qb: about 1 mg in an hour with temperature
    bias_walk_decades: float = 2.5  # its sd in powers of ten: a tilting shaker needs 1e-5
    gnss_only_q_m2ps3: float = 1e-6  # without accelerations: what velocity does by itself (wind, thermal motion)
    gnss_only_qb_m2ps5: float = 1e-4  # and the walk of the acceleration; both are only where the bank begins
    bank_memory_s: float = 600.0  # evidence on q, qb is forgotten over so long: temperature and traffic change
    bank_full_s: float = 60.0  # the bank takes every fix so long after the start,
    bank_step_s: float = 0.4  # then one in so many seconds: slow figures need no fast fixes
    r_step: float = 0.01  # step of the median tracker on R, a fraction per fix: 10 % scatter, 23 s at 10 Hz
    r_least: float = 0.049787068367863944  # e^-3, least factor on the declared R: a receiver is not 5 times better
    r_most: float = 54.598150033144236  # e^4, largest factor: a receiver that claims 3 mm may have 22
    float_std_m: float = 0.15  # a float solution wanders so much
    float_tau_s: float = 30.0  # within so long
    float_r_factor: float = 25.0  # and its declared R is too small by so much
    accel_mean_s: float = 10.0  # an accelerometer gap holds the mean of so long before it
    accel_absent_s: float = 1.0  # fixes no longer wait for an accelerometer that has been silent so long
    accel_lost_s: float = 60.0  # after so long the point goes on as one without accelerometer
    accel_settle_s: float = 5.0  # a new accelerometer is averaged so long before it is used
    accel_only_std_m: float = 0.02  # points without receiver: displacement is held about zero with this sd


@dataclass(frozen=True, slots=True)
class RecordSettings:
    rotate_s: int = 3600  # UTC-aligned; chunk indexes cost 1.4 kB a flush, so at least hourly
    rotate_mb: float = 256.0  # a file that an engineer's laptop opens at once
    keep_days: float = 365.0
    keep_gb: float = 16.0  # half of a 32 GB card
    free_gb: float = 1.0  # never fill the file system below this
    flush_s: float = 1.0  # lost at kill -9; costs 3 % of size against 10 s
    fsync_s: float = 5.0  # lost at a power cut, against the wear of the card
    view_hz: float = 25.0  # rate of the per-sample topics for plots
    inbox_mb: float = 4.0  # ports to main; 20 s of 8 x 250 Hz; when full the newest block is dropped
    outbox_mb: float = 16.0  # main to writer; derived records refused above 75 %, raw ones when full
    ring_mb: float = 16.0  # records kept in memory while the disk refuses
    accel_block: bool = False  # full-rate accelerations too; replay recomputes them from raw, so a gateway need not


@dataclass(frozen=True, slots=True)
class TriggerSettings:
    """When an event begins: one of three thresholds on a point's fused motion, or a kind of fault."""

    name: str
    point: str | None = None
    axis: str = "any"  # x, y, z: its size; horizontal: length of x and y; any: the largest of x, y, z
    above_m: float | None = None  # displacement
    above_mps: float | None = None  # velocity
    above_mps2: float | None = None  # acceleration, without gravity
    fault: str | None = None  # a kind on /faults, e.g. PORT_LOST


@dataclass(frozen=True, slots=True)
class EventSettings:
    """What is kept of an event, and when it is over."""

    before_s: float = 10.0  # kept before its begin: a lorry's whole way onto a long span
    after_s: float = 20.0  # and after its end: a lightly damped mode rings so long
    hold_s: float = 5.0  # over after so long below the release: longer than the period of any structure
    release: float = 0.8  # of the threshold: noise about it is one event
    max_s: float = 600.0  # longest clip: a level that stays above would never end it; the segments hold the rest
    clips_gb: float = 2.0  # all clips together; beyond it new ones are refused, none is ever deleted
    hook: tuple[str, ...] | None = None  # program and arguments; the clip's path comes behind
    hook_s: float = 30.0  # it is killed after so long: a mail that cannot be sent must not hold up the next clip


@dataclass(frozen=True, slots=True)
class Config:
    site: str
    data_dir: str
    structure: Structure
    ports: Mapping[str, PortSettings]
    receivers: Mapping[str, ReceiverSettings]
    accelerometers: Mapping[str, AccelerometerSettings]
    points: Mapping[str, PointSettings]
    fusion: FusionSettings = field(default_factory=FusionSettings)
    record: RecordSettings = field(default_factory=RecordSettings)
    events: EventSettings = field(default_factory=EventSettings)
    triggers: Mapping[str, TriggerSettings] = field(default_factory=dict)
    text: str = ""  # the YAML as read; goes into every segment
    files: tuple[tuple[str, bytes], ...] = ()  # every file that it names, with its content


State: TypeAlias = dict[str, Any]
"""What a stateful part saves: a tree of dict, list, str, int, float, bool, None, bytes and numpy arrays (state.py)."""
