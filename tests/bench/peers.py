"""What the agent is measured against: the libraries as people wire them, and the floor that numpy blocks reach.

Peers get the same raw data. The floor is no product: no gaps, no jumps, no start, one receiver, steady state; it says
what the arithmetic costs when nothing else is done.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from tasks import S, _config, _raws, cpu_ns

F64 = np.ndarray[Any, np.dtype[np.float64]]


def _decoded(data: Path, seconds: float) -> list[tuple[int, Any]]:
    """(t_ns, AccelBlock dict or z (3,)) as the codecs give them."""
    from edge_agent import assemble
    from edge_agent.messages import CanFrames, GnssFix

    pipeline = assemble.pipeline(_config(data))
    raws = _raws(data)
    out: list[tuple[int, Any]] = []
    frame = next(iter(pipeline.receivers.values())).frame
    for raw in raws:
        if raw.t_ns - raws[0].t_ns > seconds * S:
            break
        if isinstance(raw.payload, CanFrames):
            blocks = {}
            for name, accelerometer in pipeline.accelerometers.items():
                block, _ = accelerometer.codec.feed(raw.payload)
                if block is not None:
                    blocks[name] = block
            out.append((raw.t_ns, blocks))
        elif isinstance(raw.payload, bytes):
            for receiver in pipeline.receivers.values():
                for item in receiver.codec.feed(raw.t_ns, raw.payload, raw.t_ns + 1_780_000_000 * S):
                    if isinstance(item, GnssFix):
                        out.append((raw.t_ns, np.array(frame.enu(item.lat_deg, item.lon_deg, item.h_m))))
    return out


# ---------------------------------------------------------------------------------------------------------- libraries


class FilterpyPoint:
    """Three filterpy filters (displacement, velocity; acceleration as input), one per axis."""

    def __init__(self, dt: float) -> None:
        from filterpy.kalman import KalmanFilter

        self.axes = []
        for sigma in (0.003, 0.003, 0.006):
            f = KalmanFilter(dim_x=2, dim_z=1, dim_u=1)
            f.F = np.array([[1.0, dt], [0.0, 1.0]])
            f.B = np.array([[0.5 * dt * dt], [dt]])
            f.H = np.array([[1.0, 0.0]])
            f.Q = 1e-7 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
            f.R = np.array([[sigma**2]])
            self.axes.append(f)

    def sample(self, a: Any) -> None:
        for f, v in zip(self.axes, a, strict=True):
            f.predict(u=v)

    def fix(self, z: Any) -> None:
        for f, v in zip(self.axes, z, strict=True):
            f.update(v)


def filterpy(data: Path) -> dict[str, float]:
    """us per sample and axis, one point."""
    items = _decoded(data, 25.0)
    point = FilterpyPoint(0.004)
    samples = 0
    start = cpu_ns()
    for _, item in items:
        if isinstance(item, dict):
            for a in next(iter(item.values())).xyz:
                point.sample(a)
                samples += 1
        else:
            point.fix(item)
    return {"us": (cpu_ns() - start) / 1e3 / (3 * samples)}


def filterpy_rts(_: Path) -> dict[str, float]:
    """filterpy's filter and smoother over 10 s of one axis, by what an hour of three axes would take: seconds."""
    from filterpy.kalman import KalmanFilter

    dt, n = 0.004, 2500
    f = KalmanFilter(dim_x=2, dim_z=1, dim_u=1)
    f.F = np.array([[1.0, dt], [0.0, 1.0]])
    f.B = np.array([[0.5 * dt * dt], [dt]])
    f.H = np.array([[1.0, 0.0]])
    f.Q = 1e-7 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    f.R = np.array([[0.003**2]])
    a = -0.05 * np.sin(np.pi * dt * np.arange(n))
    zs = [np.array([[0.005 * np.sin(np.pi * dt * i)]]) if i % 25 == 0 else None for i in range(n)]
    start = cpu_ns()
    means, covariances, _, _ = f.batch_filter(zs, us=[np.array([[v]]) for v in a])
    f.rts_smoother(means, covariances)
    return {"s": (cpu_ns() - start) / S * 3 * 3600 / (n * dt)}


def library(data: Path, out: str) -> dict[str, float]:
    """python-can messages -> cantools -> pynmea2 -> filterpy -> JSON in MCAP: percent of a core; reading the bus is not
    in it."""
    import can
    import cantools
    import pynmea2
    from mcap.writer import Writer

    from edge_agent.messages import CanFrames

    raws = _raws(data)
    raws = [r for r in raws if r.t_ns - raws[0].t_ns <= 12 * S]
    messages: list[tuple[int, Any]] = []
    for raw in raws:
        if isinstance(raw.payload, CanFrames):
            p = raw.payload
            frames = zip(p.t_ns.tolist(), p.can_id.tolist(), p.data, strict=True)
            messages += [
                (t, can.Message(timestamp=t / S, arbitration_id=i, data=d.tobytes(), is_extended_id=False))
                for t, i, d in frames
            ]
        elif isinstance(raw.payload, bytes):
            messages.append((raw.t_ns, raw.payload))
    dbc = cantools.database.load_string((data / "accelerometers.dbc").read_text(), "dbc")
    ids = sorted({m.arbitration_id for _, m in messages if not isinstance(m, bytes)})
    points = {i: FilterpyPoint(0.004) for i in ids}
    path = Path(out) / f"library{os.getpid()}.mcap"
    start = cpu_ns()
    with open(path, "wb") as f:
        writer = Writer(f)
        writer.start()
        schema = writer.register_schema("json", "jsonschema", b"{}")
        raw_topic = writer.register_channel("/can", "json", schema)
        fix_topic = writer.register_channel("/fix", "json", schema)
        topics = {i: writer.register_channel(f"/fused/{i}", "json", schema) for i in ids}
        for t, m in messages:
            if isinstance(m, bytes):
                for line in m.decode().splitlines():
                    s = pynmea2.parse(line)
                    if s.sentence_type == "GGA":
                        fix = {"lat": s.latitude, "lon": s.longitude, "h": float(s.altitude)}
                        writer.add_message(fix_topic, t, json.dumps(fix).encode(), t)
                        z = ((fix["lon"] - 7.5) * 76e3, (fix["lat"] - 46.5) * 111e3, fix["h"] - 610.0)
                        for point in points.values():
                            point.fix(z)
                continue
            i = m.arbitration_id
            values = dbc.decode_message(i, m.data)
            raw_text = json.dumps({"id": i, "data": m.data.hex(), "t": m.timestamp})
            writer.add_message(raw_topic, t, raw_text.encode(), t)
            point = points[i]
            point.sample((values["X"], values["Y"], values["Z"]))
            fused = {"d": [float(f.x[0, 0]) for f in point.axes], "v": [float(f.x[1, 0]) for f in point.axes]}
            writer.add_message(topics[i], t, json.dumps(fused).encode(), t)
        writer.finish()
    used = cpu_ns() - start
    path.unlink()
    return {"percent": 100.0 * used / (raws[-1].t_ns - raws[0].t_ns)}


# --------------------------------------------------------------------------------------------------------------- floor


def hold(t0: int, a0: F64, g: F64, t: Any, a: F64) -> tuple[F64, F64]:
    """First-order-hold integrals of a block a (P, n, 3) at t (n,) ns behind (t0, a0), carried on from g = (g1, g2)."""
    h = np.diff(t, prepend=t0)[:, None] * 1e-9
    before = np.concatenate([a0[:, None], a[:, :-1]], axis=1)
    g1 = np.cumsum((a + before) * (0.5 * h), axis=1) + g[0][:, None]
    v0 = np.concatenate([g[0][:, None], g1[:, :-1]], axis=1)
    g2 = np.cumsum((v0 + (a + 2.0 * before) * (h * (1 / 6))) * h, axis=1) + g[1][:, None]
    return g1, g2


class Plain:
    """Two states (displacement, velocity), constant gain, by blocks: the least that fuses."""

    def __init__(self, points: int) -> None:
        self.d = np.zeros((points, 3))
        self.v = np.zeros((points, 3))
        self.g = (np.zeros((points, 3)), np.zeros((points, 3)))
        self.anchor = (np.zeros((points, 3)), np.zeros((points, 3)), 0)
        self.t0, self.a0 = 0, np.zeros((points, 3))

    def block(self, t: Any, a: F64) -> tuple[F64, F64]:
        g1, g2 = hold(self.t0 or int(t[0]), self.a0, self.g, t, a)
        b1, b2, tb = self.anchor
        dt = ((t - tb) * 1e-9)[:, None]
        v = g1 + (self.v - b1)[:, None]
        d = g2 + (self.d - b2)[:, None] + (self.v - b1)[:, None] * dt
        self.t0, self.a0, self.g = int(t[-1]), a[:, -1], (g1[:, -1], g2[:, -1])
        self.last = (d[:, -1], v[:, -1])
        return d, v

    def fix(self, z: F64) -> None:
        d, v = self.last
        nu = z - d
        self.d, self.v = d + 0.05 * nu, v + 0.01 * nu
        self.anchor = (*self.g, self.t0)


class Adaptive(Plain):
    """Five states [d v b m o] with their covariance, gate, tracked R and a bank of 17 filters over q/r at each fix."""

    def __init__(self, points: int) -> None:
        super().__init__(points)
        n = 3 * points
        self.x = np.zeros((n, 5, 1))
        self.C = np.broadcast_to(np.diag([1e-4, 1e-3, 1e-2, 1e-4, 0.0]), (n, 5, 5)).copy()
        self.R = np.tile(np.array([0.003, 0.003, 0.006]) ** 2, points)
        self.q = np.full(n, 1e-7)
        self.rho = 10.0 ** np.linspace(-5, 5, 17)
        self.bx = np.zeros((17, n, 3, 1))
        self.bC = np.broadcast_to(np.diag([1.0, 1.0, 1.0]), (17, 3, 3)).copy()
        self.score = np.zeros((17, n))
        self.base = (np.zeros(n), np.zeros(n), 0)

    def block(self, t: Any, a: F64) -> tuple[F64, F64, F64]:  # type: ignore[override]
        g1, g2 = hold(self.t0 or int(t[0]), self.a0, self.g, t, a)
        b1, b2, tb = self.anchor
        dt = ((t - tb) * 1e-9)[:, None]
        x = self.x.reshape(-1, 3, 5)
        D, V, B = x[..., 0], x[..., 1], x[..., 2]
        v = g1 + (V - b1)[:, None] - B[:, None] * dt
        d = g2 + (D - b2)[:, None] + ((V - b1)[:, None] - B[:, None] * (0.5 * dt)) * dt
        C = self.C.reshape(-1, 3, 5, 5)
        var = C[..., 0, 0][:, None] + (2.0 * C[..., 0, 1][:, None] + C[..., 1, 1][:, None] * dt) * dt
        self.t0, self.a0, self.g = int(t[-1]), a[:, -1], (g1[:, -1], g2[:, -1])
        return d, v, np.sqrt(var)

    def fix(self, z: F64) -> None:
        g1, g2 = (g.reshape(-1) for g in self.g)
        b1, b2, tb = self.base
        dt = (self.t0 - tb) * 1e-9 if tb else 0.1
        s1, s2 = g1 - b1, g2 - b2 - b1 * dt
        F = np.eye(5)
        F[0, 1], F[0, 2], F[1, 2], F[3, 3] = dt, -0.5 * dt * dt, -dt, 1.0 - dt / 300.0
        q = np.zeros((5, 5))
        q[0, 0], q[0, 1], q[1, 0], q[1, 1] = dt**3 / 3, dt**2 / 2, dt**2 / 2, dt
        x = F @ self.x
        x[:, 0, 0] += s2
        x[:, 1, 0] += s1
        C = F @ self.C @ F.T + self.q[:, None, None] * q
        C[:, 2, 2] += 1e-10 * dt
        C[:, 3, 3] += 1e-6 * dt
        CH = C[:, :, 0] + C[:, :, 3] + C[:, :, 4]
        s = CH[:, 0] + CH[:, 3] + CH[:, 4] + self.R
        z = np.tile(z, len(x) // 3)
        nu = z - x[:, 0, 0] - x[:, 3, 0] - x[:, 4, 0]
        good = ((nu * nu / s).reshape(-1, 3).sum(axis=1) < 16.27).repeat(3)
        K = CH * (good / s)[:, None]
        self.x = x + (K * nu[:, None])[..., None]
        C = C - K[:, :, None] * CH[:, None]
        self.C = 0.5 * (C + C.swapaxes(1, 2))
        self.R *= np.where(nu * nu > 0.4549 * s, 1.01, 1 / 1.01)
        self._bank(F[:3, :3], q[:3, :3], z, s1, s2)
        self.base = (g1, g2, self.t0)
        self.anchor = (*self.g, self.t0)

    def _bank(self, F: F64, q: F64, z: F64, s1: F64, s2: F64) -> None:
        x = F @ self.bx
        x[..., 0, 0] += s2
        x[..., 1, 0] += s1
        C = F @ self.bC @ F.T + self.rho[:, None, None] * q
        s = C[:, 0, 0] + 1.0
        K = C[:, :, 0] / s[:, None]
        nu = z - x[..., 0, 0]
        self.bx = x + K[:, None, :, None] * nu[..., None, None]
        self.bC = C - K[:, :, None] * C[:, None, 0]
        self.score = 0.998 * self.score + nu * nu / s[:, None] + np.log(s)[:, None]
        best = self.score.argmin(axis=0)
        self.q += 0.01 * (self.rho[best] * self.R - self.q)


def _stacked(items: list[tuple[int, Any]]) -> list[tuple[Any, Any]]:
    """(times (n,), samples (P, n, 3)) or (None, z): points sampled together, as the floor assumes."""
    out: list[tuple[Any, Any]] = []
    for _, item in items:
        if isinstance(item, dict):
            n = min(len(b.t_ns) for b in item.values())
            t = next(iter(item.values())).t_ns[:n]
            out.append((t, np.stack([b.xyz[:n] for b in item.values()])))
        else:
            out.append((None, item))
    return out


def _run_floor(data: Path, kind: type[Plain]) -> dict[str, float]:
    items = _stacked(_decoded(data, 60.0))
    points = next(a.shape[0] for t, a in items if t is not None)
    axes = sum(a.shape[0] * a.shape[1] * 3 for t, a in items if t is not None)
    f = kind(points)
    start = cpu_ns()
    for t, a in items:
        if t is None:
            f.fix(a)
        else:
            f.block(t, a)
    return {"us": (cpu_ns() - start) / 1e3 / axes}


def floor_plain(data: Path) -> dict[str, float]:
    """us per sample and axis."""
    return _run_floor(data, Plain)


def floor_rts(data: Path) -> dict[str, float]:
    """What the plain filter needs, online in blocks of 25, for an hour of three axes at 250 Hz: seconds."""
    return {"s": floor_plain(data)["us"] * 3 * 3600 * 250 / 1e6}


def floor_adaptive(data: Path) -> dict[str, float]:
    """us per sample and axis."""
    return _run_floor(data, Adaptive)


def floor_pipeline(data: Path, out: str) -> dict[str, float]:
    """Blocks of raw frames -> int16 view -> adaptive filter -> float32 columns -> mcap: percent of a core."""
    from mcap.writer import CompressionType, Writer

    from edge_agent.messages import CanFrames

    raws = _raws(data)
    raws = [r for r in raws if r.t_ns - raws[0].t_ns <= 60 * S]
    first = next(r.payload for r in raws if isinstance(r.payload, CanFrames))
    ids = sorted(set(first.can_id.tolist()))
    f = Adaptive(len(ids))
    path = Path(out) / f"floor{os.getpid()}.mcap"
    flushed = 0
    start = cpu_ns()
    with open(path, "wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema("block", "ros2msg", b"uint8[] data")
        raw_topic = writer.register_channel("/raw", "cdr", schema)
        topics = [writer.register_channel(f"/fused/{i}", "cdr", schema) for i in ids]
        for raw in raws:
            p = raw.payload
            if isinstance(p, CanFrames):
                columns = (np.diff(p.t_ns, prepend=raw.t_ns).astype("<i4"), p.can_id, p.length, p.data.T)
                writer.add_message(raw_topic, raw.t_ns, b"".join(c.tobytes() for c in columns), raw.t_ns)
                places = [(p.can_id == i).nonzero()[0] for i in ids]
                n = min(map(len, places))
                if not n:
                    continue
                a = np.stack([p.data[k[:n], :6].view("<i2") * 0.0006 for k in places])
                t = p.t_ns[places[0][:n]]
                fused = np.concatenate(f.block(t, a), axis=2).astype("<f4")
                for topic, block in zip(topics, fused, strict=True):
                    writer.add_message(topic, raw.t_ns, block.T.tobytes(), raw.t_ns)
            elif isinstance(p, bytes):
                writer.add_message(raw_topic, raw.t_ns, p, raw.t_ns)
                fields = p[p.index(b"GGA") :].split(b",", 10)
                lat = float(fields[2][:2]) + float(fields[2][2:]) / 60
                lon = float(fields[4][:3]) + float(fields[4][3:]) / 60
                f.fix(np.array([(lon - 7.5) * 76e3, (lat - 46.5) * 111e3, float(fields[9]) + 47.3 - 610.0]))
            if raw.t_ns - flushed >= S:
                flushed = raw.t_ns
                writer.flush()
        writer.finish()
    used = cpu_ns() - start
    path.unlink()
    return {"percent": 100.0 * used / (raws[-1].t_ns - raws[0].t_ns)}


TASKS = {
    "filterpy": filterpy,
    "filterpy_rts": filterpy_rts,
    "library": library,
    "floor_plain": floor_plain,
    "floor_adaptive": floor_adaptive,
    "floor_rts": floor_rts,
    "floor_pipeline": floor_pipeline,
}
