"""The named scenarios, as data: three steps of difficulty on one bridge, and the cases of the five papers.

clean, rough, hostile, floaty share structure and noise and differ in faults only. P0: Lima et al. (bridge and building
model, slider); P1: Wang et al. (high-rise); P2: Duong et al. (static GNSS stations); P3: the arch-bridge patent; P4:
Shan and Qi (Taidong cable-stayed bridge). Noise levels that the papers do not give are those of the project's
numerical study.
"""

from __future__ import annotations

from dataclasses import replace

from edge_agent.simulate.bridge import SimRecord, run
from edge_agent.simulate.specs import EPOCH_UTC_NS, Accel, Gnss, Modal, Ramp, Scenario, Structure

_BRIDGE = Structure(
    thermal_m=(0.020, 0.010, 0.010),
    modes=(Modal(0.5, (0.006, 0.004, 0.003)), Modal(1.7, (0.002, 0.0015, 0.001))),
)
_ROUGH = Gnss(outlier_share=0.05, drop_share=0.10, latency_s=0.200, jitter_s=0.020)
_ROUGH_ACCEL = Accel(
    noise=2.2e-4,
    bias_mps2=(0.02, 0.05),
    bias_walk=1e-11,
    drop_share=0.002,
    duplicate_share=0.002,
    jitter_s=0.001,
)
_HOSTILE = replace(_ROUGH, wrong_per_h=20.0)

_ALL = (
    Scenario("clean", _BRIDGE, Gnss(), (Accel(noise=5e-4),)),
    Scenario("rough", _BRIDGE, _ROUGH, (_ROUGH_ACCEL,)),
    Scenario("hostile", _BRIDGE, _HOSTILE, (_ROUGH_ACCEL,)),
    Scenario("floaty", _BRIDGE, replace(_HOSTILE, float_every_s=180.0, float_s=15.0), (_ROUGH_ACCEL,)),
    Scenario(
        "P0",
        Structure(
            modes=(
                Modal(1.13, (0.0010, 0.0006, 0.0004)),
                Modal(4.45, (0.00010, 0.00006, 0.00004)),
                Modal(7.27, (0.00004, 0.00003, 0.00002)),
            ),
            force_corner_hz=10.0,
            ramps=(Ramp(60.0, 1080.0, (0.18, 0.0, 0.0), smooth_s=0.5),),  # slider, 1 cm a minute for 18 minutes
            taps_per_h=60.0,
            tap_m=(0.001, 0.0005, 0.0005),
        ),
        Gnss(rate_hz=20.0, sigma_m=(0.0022, 0.0022, 0.005), multipath_m=(0.0015, 0.0015, 0.003), multipath_s=40.0),
        (Accel(name="acc50", rate_hz=50.0, noise=1e-5), Accel(name="acc250", rate_hz=250.0, noise=1e-5)),
        duration_s=1200.0,
    ),
    Scenario(
        "P1",
        Structure(
            thermal_m=(0.030, 0.020, 0.005),  # sway with the wind and the sun
            thermal_s=1800.0,
            modes=(
                Modal(0.21, (0.004, 0.001, 0.0002)),
                Modal(0.34, (0.001, 0.002, 0.0002)),
                Modal(0.44, (0.001, 0.0005, 0.0002)),
                Modal(1.05, (0.0001, 0.0001, 0.00002)),
                Modal(1.72, (0.00004, 0.00004, 0.00001)),
            ),
        ),
        Gnss(sigma_m=(0.003, 0.003, 0.007), multipath_m=(0.003, 0.003, 0.007), multipath_s=90.0, latency_s=0.100),
        (Accel(rate_hz=20.0, noise=3e-5, temperature_mps2=2e-3),),
        duration_s=3600.0,
    ),
    Scenario(
        "P2",
        Structure(),
        Gnss(rate_hz=1.0, sigma_m=(0.045, 0.050, 0.070), outlier_share=0.03),
        (),
        duration_s=3600.0,
    ),
    Scenario(
        "P3",
        Structure(
            modes=(
                Modal(0.91, (0.0008, 0.0010, 0.0015)),
                Modal(1.64, (0.0003, 0.0004, 0.0006)),
                Modal(2.52, (0.0002, 0.0002, 0.0003)),
            ),
            traffic_per_h=120.0,
            traffic_m=(0.002, 0.001, -0.008),
        ),
        Gnss(outlier_share=0.01, float_every_s=180.0, float_s=15.0),
        (Accel(noise=2e-4),),
    ),
    Scenario(
        "P4",
        Structure(
            thermal_m=(0.015, 0.005, 0.020),
            thermal_s=3000.0,
            modes=(
                Modal(0.309, (0.002, 0.002, 0.005)),
                Modal(0.507, (0.001, 0.0008, 0.001)),
                Modal(0.645, (0.0005, 0.0005, 0.001)),
            ),
            traffic_per_h=60.0,
            traffic_m=(0.003, 0.002, -0.030),
            traffic_s=20.0,
        ),
        Gnss(rate_hz=1.0, sigma_m=(0.006, 0.006, 0.010), multipath_m=(0.003, 0.003, 0.006), multipath_s=120.0),
        (Accel(rate_hz=64.0, noise=3e-5, scale=0.01),),
        duration_s=3000.0,
    ),
)
SCENARIOS: dict[str, Scenario] = {s.name: s for s in _ALL}


def simulate(name: str, seed: int, duration_s: float | None = None, utc_ns: int = EPOCH_UTC_NS) -> SimRecord:
    """`run` for a scenario by name. Raises ValueError for an unknown one, with those that there are."""
    if name not in SCENARIOS:
        raise ValueError(f"simulate: no scenario {name!r}; there are {', '.join(SCENARIOS)}")
    return run(SCENARIOS[name], seed, duration_s, utc_ns)
