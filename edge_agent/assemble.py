"""A configuration's codecs put into a Pipeline: the one way that live, replay and tests build the data path."""

from __future__ import annotations

import platform

import numpy as np

import drivers
from edge_agent.messages import Config
from edge_agent.pipeline import Pipeline


def pipeline(config: Config) -> Pipeline:
    """A fresh Pipeline for `config`. Raises ValueError where a codec refuses its settings."""
    nmea = drivers.load(drivers.CODECS, "nmea")
    accel = drivers.load(drivers.CODECS, "accel")
    return Pipeline(
        config,
        {name: nmea() for name in config.receivers},
        {name: accel(settings) for name, settings in config.accelerometers.items()},
    )


def platform_name() -> str:
    """What decides whether a replay is compared byte for byte: machine and numpy."""
    return f"{platform.machine()} numpy {np.__version__}"
