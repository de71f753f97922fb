"""Modes of the whole structure from all its accelerometers at once: frequency-domain decomposition (Brincker, Zhang &
Andersen 2001) and covariance-driven stochastic subspace identification with uncertainty (Dohler & Mevel 2013), both by
pyOMA2 (extra `review`), which is imported when used.

`Together` keeps the stretch of a review in which the accelerometers moved most. `identify` splits the frequencies that
it is given into bands of a few octaves, thins the channels to each band, and keeps the poles that stand still while the
model's order grows. Without the library the answer is None: `spectra.fit_mode` then stands alone.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from edge_agent.messages import F64, I64, S
from edge_agent.review.series import Piece

LONGEST_S, LEAST_S, MOST = 1800.0, 50.0, 150_000
"""Length of the stretch that is kept, and of one that is worth the trouble; samples of a sensor in it (600 s at 250 Hz:
2 MB)."""
WHOLE = 0.98
"""A channel that has less of the stretch than this is left out."""
BAND = 4.0
"""Highest over lowest frequency of a band: beyond, the rows of the subspace hold too little of the slowest period."""
ABOVE = 1.35
"""The thinned rate is twice so much of a band's highest frequency."""
ROWS = (12, 24)
"""Block rows: a period of the lowest frequency between these."""
CHANNELS = 6
"""Channels in a subspace, those that move most: the cost of the sd grows with their square. Decomposition takes all."""
ORDER, BLOCKS = 28, 20
"""Highest order, and blocks of the record that the sd comes from."""
STABLE = {"err_fn": 0.02, "err_xi": 0.3, "err_phi": 0.1}
"""A pole stands still where one of the order before is within these shares of its frequency and damping, and of 1 less
the likeness of the shapes."""
OFTEN = 0.3
"""A mode is told where a pole stands still in so large a share of the orders,"""
REACH = 0.2
"""in the band of the frequencies given and so much beyond,"""
STILL, SURE, DAMPED = 0.01, 0.05, 0.10
"""within so large a share of its frequency, with an sd and a damping below these."""


class Channels(NamedTuple):
    """Accelerations of several sensors on one even grid: begin UTC ns, Hz, x (n, c) m/s2, a name for each column."""

    begin_ns: int
    rate_hz: float
    x: F64
    names: list[str]


class Mode(NamedTuple):
    """A mode of the structure: frequency, damping and their sd, share of the orders that show it, the nearest peak of
    the first singular value (NaN: none), shape (c,) of its channels, the largest 1."""

    freq_hz: float
    std_freq_hz: float
    damping: float
    std_damping: float
    share: float
    fdd_hz: float
    shape: npt.NDArray[np.complex128]


class Poles(NamedTuple):
    """Of every order: frequency, its sd, damping, its sd (k,), order, whether it stood still from the order before."""

    freq_hz: F64
    std_hz: F64
    damping: F64
    std_damping: F64
    order: I64
    still: npt.NDArray[np.bool_]


class Band(NamedTuple):
    """One band: the rate it was thinned to, frequencies and singular values (k, at most 3), poles, modes, the names of
    the channels that the modes' shapes are of."""

    rate_hz: float
    freq_hz: F64
    singular: F64
    poles: Poles
    modes: list[Mode]
    names: list[str]


@dataclass
class Modal:
    """What was identified: the stretch, its channels, the bands; `why`: why there is none."""

    begin_ns: int = 0
    seconds: float = 0.0
    names: list[str] = field(default_factory=list)
    bands: list[Band] = field(default_factory=list)
    why: str = ""

    @property
    def modes(self) -> list[Mode]:
        return [m for b in self.bands for m in b.modes]


class Together:
    """Keeps the stretch in which all accelerometers together moved most."""

    def __init__(self) -> None:
        self.best: dict[str, tuple[I64, npt.NDArray[np.float32]]] = {}
        self._score = -1.0
        self._run = ""
        self._begin = 0
        self._rows: dict[str, list[tuple[I64, npt.NDArray[np.float32]]]] = {}

    def add(self, piece: Piece) -> None:
        times = [a.utc_ns for a in piece.accelerations.values() if len(a.utc_ns)]
        if not times:
            return
        first = int(min(t[0] for t in times))
        full = any(sum(len(t) for t, _ in rows) >= MOST for rows in self._rows.values())
        if full or piece.run != self._run or not 0 <= first - self._begin < LONGEST_S * S:
            self.close()
            self._run, self._begin = piece.run, first
        for name, a in piece.accelerations.items():
            if len(a.utc_ns):
                self._rows.setdefault(name, []).append((a.utc_ns, a.xyz.astype(np.float32)))

    def close(self) -> None:
        rows, self._rows = self._rows, {}
        score = 0.0
        joined = {}
        for name, parts in rows.items():
            t, x = np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
            good = np.isfinite(x).all(axis=1) & np.concatenate([[True], np.diff(np.maximum.accumulate(t)) > 0])
            t, x = t[good], x[good]
            if len(t) > 100:
                joined[name] = t, x
                score += float(np.diff(x, axis=0).std(axis=0).sum()) * math.sqrt(float(t[-1] - t[0]))
        if score > self._score:
            self._score, self.best = score, joined

    def channels(self) -> Channels | None:
        """The stretch that all of them share; None where there is none of LEAST_S."""
        held = dict(self.best)
        while held:
            begin, end = max(int(t[0]) for t, _ in held.values()), min(int(t[-1]) for t, _ in held.values())
            rate = min(S / float(np.median(np.diff(t))) for t, _ in held.values())
            if end - begin >= LEAST_S * S:
                break
            held.pop(min(held, key=lambda n: int(held[n][0][-1] - held[n][0][0])))
        if not held:
            return None
        n = math.floor((end - begin) / S * rate) + 1
        grid = np.arange(n) / rate
        columns, names = [], []
        for name, (t, x) in held.items():
            seconds = (t - begin) / S
            inside = (seconds >= 0) & (seconds <= grid[-1])
            if inside.sum() < WHOLE * (end - begin) / S * (S / float(np.median(np.diff(t)))):
                continue
            columns += [np.interp(grid, seconds, x[:, i].astype(np.float64)) for i in range(3)]
            names += [f"{name} {axis}" for axis in "xyz"]
        return Channels(begin, rate, np.stack(columns, axis=1), names) if columns else None


def installed() -> bool:
    return importlib.util.find_spec("pyoma2") is not None


def bands_of(freq_hz: Sequence[float]) -> list[list[float]]:
    """Frequencies in groups of which the highest is at most BAND times the lowest."""
    out: list[list[float]] = []
    for f in sorted(freq_hz):
        if out and f <= BAND * out[-1][0]:
            out[-1].append(f)
        else:
            out.append([f])
    return out


def thinned(x: F64, rate_hz: float, new_hz: float) -> tuple[F64, float]:
    """x (n, c) less its straight lines at about `new_hz`, low-passed by leaving out what is above, and that rate."""
    n = len(x)
    ramp = np.linspace(-1.0, 1.0, n)
    y = x - x.mean(axis=0)
    y = y - ramp[:, None] * (ramp @ y) / float(ramp @ ramp)
    m = min(n, max(16, round(n * new_hz / rate_hz)))
    if m >= n:
        return y, rate_hz
    spectrum = np.fft.rfft(y, axis=0)[: m // 2 + 1]
    return np.asarray(np.fft.irfft(spectrum, m, axis=0)) * (m / n), rate_hz * m / n


def identify(channels: Channels, freq_hz: Sequence[float]) -> Modal:
    """Modes near frequencies that stand out of the spectra. Modal.why says what is missing."""
    found = Modal(channels.begin_ns, len(channels.x) / channels.rate_hz, channels.names)
    if not freq_hz:
        found.why = "no frequency stands out of the accelerations"
    elif not installed():
        found.why = "pyOMA-2 is not installed (pip install pyOMA-2, or the extra `review`)"
    else:
        for group in bands_of(freq_hz):
            band = _band(channels, group)
            if band is not None:
                found.bands.append(band)
        if not found.bands:
            found.why = f"{found.seconds:.0f} s are too short for {min(freq_hz):.2g} Hz"
    return found


def _band(channels: Channels, freq_hz: Sequence[float]) -> Band | None:
    x, rate = thinned(channels.x, channels.rate_hz, 2.0 * ABOVE * max(freq_hz))
    rows = int(np.clip(round(rate / min(freq_hz)), *ROWS))
    if len(x) < 40 * rows:
        return None
    moving = np.flatnonzero(x.std(axis=0) > 0)
    strong = np.sort(moving[np.argsort(-x[:, moving].std(axis=0))][:CHANNELS])
    if not len(strong):
        return None
    freq, singular = decomposed(x[:, moving], rate, min(freq_hz))
    poles, shapes = subspace(x[:, strong], rate, rows)
    names = [channels.names[i] for i in strong.tolist()]
    reach = (1.0 - REACH) * min(freq_hz), (1.0 + REACH) * max(freq_hz)
    return Band(rate, freq, singular, poles, modes_of(poles, shapes, freq, singular, reach), names)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """It logs, draws progress bars and warns of what is harmless here."""
    logger = logging.getLogger("pyoma2")
    level = logger.level
    logger.setLevel(logging.WARNING)
    with contextlib.redirect_stderr(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
    logger.setLevel(level)


def decomposed(x: F64, rate_hz: float, low_hz: float) -> tuple[F64, F64]:
    """Frequencies (k,) and the first singular values (k, at most 3) of the cross spectra of x (n, c)."""
    with _quiet():
        from pyoma2.algorithms import FDD
        from pyoma2.setup import SingleSetup

        segment = min(len(x) // 4, max(256, round(20.0 * rate_hz / low_hz)))
        setup = SingleSetup(x, fs=rate_hz)
        method = FDD(name="fdd", nxseg=segment, method_SD="per", pov=0.5)
        setup.add_algorithms(method)
        setup.run_all()
    values = np.asarray(method.result.S_val)
    count = min(3, values.shape[0])
    return np.asarray(method.result.freq, np.float64), np.stack([values[i, i] for i in range(count)], axis=1).real


def subspace(x: F64, rate_hz: float, rows: int, order: int = ORDER) -> tuple[Poles, npt.NDArray[np.complex128]]:
    """Poles of x (n, c) at every even order, and their shapes (k, c)."""
    with _quiet():
        from pyoma2.algorithms import SSI
        from pyoma2.setup import SingleSetup

        setup = SingleSetup(x, fs=rate_hz)
        order = min(order, rows * x.shape[1] // 2 * 2)
        orders = {"ordmin": 2, "ordmax": order, "step": 2}
        method = SSI(name="ssi", method="cov", br=rows, sc=STABLE, calc_unc=True, nb=BLOCKS, **orders)
        setup.add_algorithms(method)
        setup.run_all()
    r = method.result
    freq = np.asarray(r.Fn_poles, np.float64)
    known = np.isfinite(freq) & (freq > 0) & np.isfinite(r.Fn_poles_std)
    where = np.argwhere(known)
    order_of = where[:, 1] * 2
    poles = Poles(
        freq[known],
        np.asarray(r.Fn_poles_std, np.float64)[known],
        np.asarray(r.Xi_poles, np.float64)[known],
        np.asarray(r.Xi_poles_std, np.float64)[known],
        order_of.astype(np.int64),
        np.asarray(r.Lab)[known] == 1,
    )
    return poles, np.asarray(r.Phi_poles)[known]


def modes_of(
    poles: Poles, shapes: npt.NDArray[np.complex128], freq_hz: F64, singular: F64, reach: tuple[float, float]
) -> list[Mode]:
    """Poles between two frequencies that stand still over many orders, each as the one of the least sd among them; what
    the orders do not agree on is in its sd."""
    sure = poles.still & (poles.std_hz < SURE * poles.freq_hz) & (poles.damping < DAMPED) & (poles.damping > 0)
    sure &= (poles.freq_hz > reach[0]) & (poles.freq_hz < reach[1])
    at = np.flatnonzero(sure)
    at = at[np.argsort(poles.freq_hz[at])]
    if not len(at):
        return []
    cuts = [0, *(np.flatnonzero(np.diff(poles.freq_hz[at]) > STILL * poles.freq_hz[at][1:]) + 1).tolist(), len(at)]
    orders = len(np.unique(poles.order))
    found = []
    for a, b in pairwise(cuts):
        group = at[a:b]
        share = len(np.unique(poles.order[group])) / orders
        if share < OFTEN:
            continue
        middle = float(np.median(poles.freq_hz[group]))
        near = group[np.abs(poles.freq_hz[group] - middle) <= STILL * middle]
        i = int(near[np.argmin(poles.std_hz[near])])
        shape = shapes[i] / shapes[i][int(np.argmax(np.abs(shapes[i])))]
        found.append(
            Mode(
                float(poles.freq_hz[i]),
                math.hypot(float(poles.std_hz[i]), float(np.std(poles.freq_hz[near]))),
                float(poles.damping[i]),
                math.hypot(float(poles.std_damping[i]), float(np.std(poles.damping[near]))),
                share,
                _nearest_top(freq_hz, singular[:, 0], float(poles.freq_hz[i])),
                shape,
            )
        )
    return found


def in_phase(shape: npt.NDArray[np.complex128]) -> float:
    """1 where all channels of a shape (c,) move together or against each other, 0 where they circle."""
    return float(abs((shape * shape).sum()) / (np.abs(shape) ** 2).sum())


def _nearest_top(freq_hz: F64, value: F64, near_hz: float) -> float:
    """The highest line of the first singular value within a few lines of a frequency, where it is a local top."""
    step = float(freq_hz[1] - freq_hz[0])
    half = max(2.0 * step, 0.04 * near_hz)
    inside = np.flatnonzero(np.abs(freq_hz - near_hz) <= half)
    inside = inside[(inside > 0) & (inside < len(freq_hz) - 1)]
    if not len(inside):
        return math.nan
    k = int(inside[np.argmax(value[inside])])
    if not value[k - 1] <= value[k] >= value[k + 1]:
        return math.nan
    a, b, c = np.log(np.maximum(value[k - 1 : k + 2], 1e-300)).tolist()
    bend = a - 2 * b + c
    return float(freq_hz[k]) + (0.5 * (a - c) / bend if bend < 0 else 0.0) * step
