"""The message texts of every topic, and which topic has which.

Schemas are ROS 2 message texts followed by those that they name, as MCAP's `ros2msg` wants them; enum constants stand
directly before their field, or viewers show bare numbers. Own messages begin with an 8-byte field after the header, so
that what follows the frame's name has a fixed layout. Blocks hold columns: one value per sample and array, which
compresses well and loads as it is into numpy. Names of topics, messages and fields are the product's interface.
"""

from __future__ import annotations

from typing import NamedTuple

RULE = "=" * 80

_QUALITY = """uint8 NONE=0
uint8 SINGLE=1
uint8 DGNSS=2
uint8 PPS=3
uint8 FIXED=4
uint8 FLOAT=5
uint8 ESTIMATED=6
uint8 MANUAL=7
uint8 SIMULATED=8
"""

_VERDICT = """uint8 ACCEPTED=0
uint8 REJECTED=1
uint8 OFFSET=2     # used as z - offset while a level offset is open
uint8 PRECHECK=3   # quality, age or range: never reached the gate
uint8 OLD=4        # older than the filter's anchor: counted, dropped
uint8 START=5      # belongs to the start window
"""

_MODE = """uint8 INIT=0
uint8 FUSED=1
uint8 GNSS_ONLY=2
uint8 ACCEL_ONLY=3       # no absolute displacement
uint8 COAST=4            # no accepted fix, accelerations only
uint8 CONTRADICTION=5
uint8 INVALID=6
"""

_FUSION_FLAGS = """uint8 FLAG_FLOAT=1
uint8 FLAG_JUMP_OPEN=2
uint8 FLAG_ACCEL_GAP=4
uint8 FLAG_DEGRADED=8
uint8 FLAG_TIME_UNCERTAIN=16
"""

_ACCEL_FLAGS = """uint8 FLAG_SATURATED=1
uint8 FLAG_GAP_BEFORE=2
uint8 FLAG_STUCK=4
uint8 FLAG_SPIKE=8
uint8 FLAG_FITTED=16       # time from the counter or the rate, not from an arrival stamp
uint8 FLAG_INCOMPLETE=32   # an axis was missing and holds NaN
"""

_TEXTS: dict[str, str] = {
    # ---- ROS 2, as its packages have them
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "sensor_msgs/msg/NavSatStatus": """int8 STATUS_NO_FIX =  -1        # unable to fix position
int8 STATUS_FIX =      0        # unaugmented fix
int8 STATUS_SBAS_FIX = 1        # with satellite-based augmentation
int8 STATUS_GBAS_FIX = 2        # with ground-based augmentation
int8 status
uint16 SERVICE_GPS =     1
uint16 SERVICE_GLONASS = 2
uint16 SERVICE_COMPASS = 4      # includes BeiDou.
uint16 SERVICE_GALILEO = 8
uint16 service
""",
    "sensor_msgs/msg/NavSatFix": """std_msgs/Header header
sensor_msgs/NavSatStatus status
float64 latitude
float64 longitude
float64 altitude
float64[9] position_covariance
uint8 COVARIANCE_TYPE_UNKNOWN = 0
uint8 COVARIANCE_TYPE_APPROXIMATED = 1
uint8 COVARIANCE_TYPE_DIAGONAL_KNOWN = 2
uint8 COVARIANCE_TYPE_KNOWN = 3
uint8 position_covariance_type
""",
    "rcl_interfaces/msg/Log": """byte DEBUG=10
byte INFO=20
byte WARN=30
byte ERROR=40
byte FATAL=50
builtin_interfaces/Time stamp
uint8 level
string name
string msg
string file
string function
uint32 line
""",
    "diagnostic_msgs/msg/KeyValue": "string key\nstring value\n",
    "diagnostic_msgs/msg/DiagnosticStatus": """byte OK=0
byte WARN=1
byte ERROR=2
byte STALE=3
byte level
string name
string message
string hardware_id
diagnostic_msgs/KeyValue[] values
""",
    "diagnostic_msgs/msg/DiagnosticArray": "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n",
    "geometry_msgs/msg/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/msg/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
    "geometry_msgs/msg/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "geometry_msgs/msg/TransformStamped": """std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
""",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    # ---- own
    "edge_agent_msgs/msg/Vector3f": "float32 x\nfloat32 y\nfloat32 z\n",
    "edge_agent_msgs/msg/NamedValue": "string name\nfloat64 value\n",
    "edge_agent_msgs/msg/RawBytes": """# Bytes as one read of a port gave them.
std_msgs/Header header   # stamp: UTC of the read
uint64 order             # place in the order of processing, over all ports
uint64 monotonic_ns      # host's monotonic clock at the read
uint8[] data
""",
    "edge_agent_msgs/msg/CanFrames": """# A block of n CAN frames in the order of arrival, as columns.
# UTC = log_time + (monotonic time - monotonic_ns).
# Frame i: monotonic time t_first_ns + t_unit_ns * (d[1] + ... + d[i]), where d[i] is the signed integer whose byte k
# (least significant first) is t_delta_planes[k * n + i]; data byte k is data_planes[k * n + i], bytes beyond the stored
# planes are zero.
uint64 order             # place in the order of processing, over all ports
uint64 monotonic_ns      # host's monotonic clock at the end of the block
int64 t_first_ns         # monotonic stamp of the first frame
uint32 t_unit_ns         # 1, or 1000 where all stamps keep to whole microseconds of difference
uint32 dropped           # frames that the kernel dropped since the block before
uint8 width              # bytes per frame of the block: 8 classic, 64 with CAN FD
uint32[] can_id          # without flag bits
uint8 FLAG_EXT=1         # 29-bit identifier
uint8 FLAG_RTR=2
uint8 FLAG_ERR=4
uint8 FLAG_FD=8
uint8 FLAG_BRS=16
uint8 FLAG_ESI=32
uint8 FLAG_DRAIN=64      # stamped when the socket was drained
uint8 FLAG_SPREAD=128    # spread evenly over the drain interval after a step of the wall clock
uint8[] flags
uint8[] length           # data bytes used
uint8[] t_delta_planes
uint8[] data_planes
""",
    "edge_agent_msgs/msg/Tick": """# Host wall time at an instant of the host's monotonic clock.
std_msgs/Header header
uint64 order
uint64 monotonic_ns
int64 utc_ns             # wall clock as read
int64 error_ns           # the kernel's estimate of its error, 0 = not known
bool sync                # the kernel says that the wall clock is disciplined
""",
    "edge_agent_msgs/msg/Checkpoint": """# State of the data path before the record that follows: replay starts here.
std_msgs/Header header
uint64 order             # of the next Raw
uint64 monotonic_ns
int64 utc_ns             # of monotonic_ns, by the map that holds for this file
string reason
uint8[] state
""",
    "edge_agent_msgs/msg/GnssSolution": f"""# One epoch of one receiver. NaN = the receiver did not say.
std_msgs/Header header   # stamp: when the position was true
int64 monotonic_ns       # the same on the host's monotonic clock
int64 arrival_ns         # monotonic, of the read that completed the position
int64 latency_ns         # arrival - truth
int64 gnss_utc_ns        # by the receiver's clock, 0 = not said
float64 latitude_deg
float64 longitude_deg
float64 height_m         # ellipsoidal
float64 separation_m     # geoid above ellipsoid, as the receiver said
float64 east_m           # about the reference, or NaN before there is one
float64 north_m
float64 up_m
edge_agent_msgs/Vector3f std_enu_m
edge_agent_msgs/Vector3f resolution_enu_m   # one step of the last decimal
float32 hdop
float32 vdop
float32 pdop
float32 age_s            # of the corrections
float32 baseline_m
float32 course_deg       # over ground, clockwise from true north, of VTG
float32 speed_mps        # over ground
uint16 satellites
bool date_known          # the date came from the receiver
{_QUALITY}uint8 fix
string station           # of the corrections
string sentences         # types that made up the epoch, in the order of arrival
""",
    "edge_agent_msgs/msg/Accel": f"""# One sample of an accelerometer, structure axes, gravity included;
# a thinned view of the block topic for plots.
std_msgs/Header header
int64 seq                # number by the device's counter, or by arrival
float32 x                # m/s2
float32 y                # m/s2
float32 z                # m/s2
{_ACCEL_FLAGS}uint8 flags
""",
    "edge_agent_msgs/msg/AccelBlock": f"""# Samples of an accelerometer at full rate, structure axes, gravity included.
std_msgs/Header header   # stamp: of the first sample
int64 monotonic_ns       # of the first sample
bool drain_stamped       # some frame was stamped when the socket was drained
float32[] x_mps2
float32[] y_mps2
float32[] z_mps2
{_ACCEL_FLAGS}uint8[] flags
int64[] t_offset_ns      # after the first sample
int64[] seq              # number by the device's counter, or by arrival
""",
    "edge_agent_msgs/msg/FusedState": f"""# One sample of the fused stream of a point, structure axes;
# a thinned view of the block topic for plots.
std_msgs/Header header
int64 monotonic_ns
edge_agent_msgs/Vector3f displacement_m
edge_agent_msgs/Vector3f velocity_mps
edge_agent_msgs/Vector3f std_displacement_m
edge_agent_msgs/Vector3f std_velocity_mps
edge_agent_msgs/Vector3f bias_mps2
edge_agent_msgs/Vector3f offset_m
{_MODE}uint8 mode
{_FUSION_FLAGS}uint8 flags
""",
    "edge_agent_msgs/msg/FusedBlock": f"""# The fused stream of a point at full rate, structure axes.
# Displacement is rounded to 2^-24 m, velocity to 2^-22 m/s, standard deviations to 10 bits of mantissa (0.05 %).
std_msgs/Header header   # stamp: of the first sample
int64 monotonic_ns       # of the first sample
edge_agent_msgs/Vector3f bias_mps2        # accelerometer's, at the block's anchor
edge_agent_msgs/Vector3f std_bias_mps2
edge_agent_msgs/Vector3f offset_m         # level offset, 0 when closed
edge_agent_msgs/Vector3f std_offset_m
uint8 LIVE=0
uint8 SMOOTHED=1
uint8 FINAL=2
uint8 revision
float32[] displacement_x_m
float32[] displacement_y_m
float32[] displacement_z_m
float32[] velocity_x_mps
float32[] velocity_y_mps
float32[] velocity_z_mps
float32[] std_displacement_x_m
float32[] std_displacement_y_m
float32[] std_displacement_z_m
float32[] std_velocity_x_mps
float32[] std_velocity_y_mps
float32[] std_velocity_z_mps
{_MODE}uint8[] mode
{_FUSION_FLAGS}uint8[] flags
int64[] t_offset_ns      # after the first sample
""",
    "edge_agent_msgs/msg/FusionUpdate": f"""# The gate's word on one fix, structure axes.
std_msgs/Header header   # stamp: when the fix was true
int64 monotonic_ns
int64 latency_ns         # arrival - truth
edge_agent_msgs/Vector3f residual_m       # fix - prediction
edge_agent_msgs/Vector3f std_residual_m   # by the filter: sqrt of the diagonal of variance_m2
edge_agent_msgs/Vector3f std_fix_m        # of the fix as used
edge_agent_msgs/Vector3f offset_m         # level offset at that time, 0 when closed
float32[9] variance_m2                    # of the residual, row by row
float32 ratio                             # v' S^-1 v / chi2(0.999): fits when <= 1
{_VERDICT}uint8 verdict
""",
    "edge_agent_msgs/msg/Heading": f"""# Heading of a receiver with two antennas: azimuth from the first to the second.
std_msgs/Header header   # stamp: when it was true
int64 monotonic_ns
float64 heading_deg      # filtered, clockwise from true north, 0 to 360; NaN before its start
float64 measured_deg     # as the receiver said; NaN = not valid
float32 std_deg
float32 std_measured_deg # as used
float32 tilt_deg         # as the receiver said: second antenna above the first
float32 baseline_m       # as the receiver said: between the antennas
float32 ratio            # of the gate: fits when <= 1
{_VERDICT}uint8 verdict
""",
    "edge_agent_msgs/msg/Event": """# Something decided, noticed or failed. begin = end = stamp: a moment.
std_msgs/Header header
int64 monotonic_ns
builtin_interfaces/Time begin
builtin_interfaces/Time end
string kind
string source
string text
edge_agent_msgs/NamedValue[] values
""",
}

PRIMITIVES = {
    "bool": ("u1", "?"),
    "byte": ("u1", "B"),
    "char": ("u1", "B"),
    "int8": ("i1", "b"),
    "uint8": ("u1", "B"),
    "int16": ("<i2", "h"),
    "uint16": ("<u2", "H"),
    "int32": ("<i4", "i"),
    "uint32": ("<u4", "I"),
    "int64": ("<i8", "q"),
    "uint64": ("<u8", "Q"),
    "float32": ("<f4", "f"),
    "float64": ("<f8", "d"),
}
"""Number types of message texts -> (numpy, struct)."""


class Field(NamedTuple):
    """One field of a message text. `type` is a primitive, "string" or a full schema name; `length` None = a single
    value, -1 = a sequence, n >= 0 = a fixed array; `names` = the enum constants that stand before it."""

    name: str
    type: str
    length: int | None
    names: dict[int, str]


def full_name(name: str) -> str:
    """'std_msgs/Header' -> 'std_msgs/msg/Header'."""
    return name if name.count("/") == 2 else name.replace("/", "/msg/")


def parse_fields(text: str) -> tuple[Field, ...]:
    """Fields of one message text (no dependencies). ValueError for a line that is neither field nor constant."""
    fields: list[Field] = []
    names: dict[int, str] = {}
    for line in text.splitlines():
        words = line.split("#", 1)[0].split(None, 1)
        if not words:
            continue
        if len(words) < 2:
            raise ValueError(f"message text: {line!r} is no field")
        kind, rest = words
        head, equals, value = rest.partition("=")
        if equals:
            names[int(value.strip())] = head.strip()
            continue
        length: int | None = None
        if kind.endswith("]"):
            kind, _, size = kind[:-1].partition("[")
            length = int(size) if size.isdigit() else -1
        if kind not in PRIMITIVES and kind != "string":
            kind = full_name(kind)
        fields.append(Field(rest.split()[0], kind, length, names))
        names = {}
    return tuple(fields)


def parse_schema(name: str, text: str) -> dict[str, tuple[Field, ...]]:
    """Fields of a schema and of the types that it names, from one ros2msg text."""
    first, *others = text.split(RULE + "\n")
    types = {full_name(name): parse_fields(first)}
    for part in others:
        head, _, body = part.partition("\n")
        types[full_name(head.removeprefix("MSG:").strip())] = parse_fields(body)
    return types


def _with_dependencies(name: str) -> str:
    text, seen = _TEXTS[name], [name]
    for known in seen:  # grows while it runs: breadth first
        for field in parse_fields(_TEXTS[known]):
            if field.type in _TEXTS and field.type not in seen:
                seen.append(field.type)
                package, _, kind = field.type.split("/")
                text += f"{RULE}\nMSG: {package}/{kind}\n{_TEXTS[field.type]}"
    return text


RAW_BYTES = "edge_agent_msgs/msg/RawBytes"
CAN_FRAMES = "edge_agent_msgs/msg/CanFrames"
TICK = "edge_agent_msgs/msg/Tick"
CHECKPOINT = "edge_agent_msgs/msg/Checkpoint"
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
GNSS_SOLUTION = "edge_agent_msgs/msg/GnssSolution"
ACCEL = "edge_agent_msgs/msg/Accel"
ACCEL_BLOCK = "edge_agent_msgs/msg/AccelBlock"
FUSED_STATE = "edge_agent_msgs/msg/FusedState"
FUSED_BLOCK = "edge_agent_msgs/msg/FusedBlock"
FUSION_UPDATE = "edge_agent_msgs/msg/FusionUpdate"
HEADING = "edge_agent_msgs/msg/Heading"
EVENT = "edge_agent_msgs/msg/Event"
LOG = "rcl_interfaces/msg/Log"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
TF = "tf2_msgs/msg/TFMessage"

SCHEMAS: dict[str, str] = {
    name: _with_dependencies(name)
    for name in (
        RAW_BYTES,
        CAN_FRAMES,
        TICK,
        CHECKPOINT,
        NAV_SAT_FIX,
        GNSS_SOLUTION,
        ACCEL,
        ACCEL_BLOCK,
        FUSED_STATE,
        FUSED_BLOCK,
        FUSION_UPDATE,
        HEADING,
        EVENT,
        LOG,
        DIAGNOSTICS,
        TF,
    )
}
"""Schema name -> ros2msg text with its dependencies; the texts of every topic, and no other."""

RAW_PREFIX = "/raw/"
CLOCK_TOPIC = "/raw/clock"
CHECKPOINT_TOPIC = "/raw/checkpoint"

_FIXED_TOPICS = {
    CLOCK_TOPIC: TICK,
    CHECKPOINT_TOPIC: CHECKPOINT,
    "/faults": EVENT,
    "/events": EVENT,
    "/rosout": LOG,
    "/diagnostics": DIAGNOSTICS,
    "/tf_static": TF,
}
_LEAVES = {
    ("gnss", "fix"): NAV_SAT_FIX,
    ("gnss", "solution"): GNSS_SOLUTION,
    ("accel", "block"): ACCEL_BLOCK,
    ("fusion", "state"): FUSED_STATE,
    ("fusion", "block"): FUSED_BLOCK,
    ("fusion", "smoothed"): FUSED_BLOCK,
    ("fusion", "update"): FUSION_UPDATE,
    ("fusion", "heading"): HEADING,
}


def schema_of(topic: str) -> str:
    """Schema name of a topic. `/raw/<port>` does not say whether the port is serial or CAN: its Record must name the
    schema (`raw_record` does). ValueError for any topic that is not in the table."""
    if topic in _FIXED_TOPICS:
        return _FIXED_TOPICS[topic]
    match topic.split("/"):
        case ["", "accel", name] if name:
            return ACCEL
        case ["", kind, name, leaf] if name and (kind, leaf) in _LEAVES:
            return _LEAVES[kind, leaf]
        case ["", "raw", name] if name:
            raise ValueError(f"topic {topic!r}: the record must name its schema, {RAW_BYTES} or {CAN_FRAMES}")
    raise ValueError(f"topic {topic!r} is not one of this program's")
