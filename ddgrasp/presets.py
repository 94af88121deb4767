"""The four named configurations. Presets are values: nothing branches on a preset's name."""

from ddgrasp.config import Config, RecordConfig
from ddgrasp.errors import unknown_name

DEBUG = Config(preset="debug", record=RecordConfig(trajectories=2, frames=12))
DEMO = Config(preset="demo", record=RecordConfig(trajectories=24))
LAPTOP = Config(preset="laptop", record=RecordConfig(trajectories=80))
PAPER = Config(preset="paper", record=RecordConfig(trajectories=80))

PRESETS = {config.preset: config for config in (DEBUG, DEMO, LAPTOP, PAPER)}


def get_preset(name: str) -> Config:
    """The preset of that name; UserError with the nearest right name otherwise."""
    if name not in PRESETS:
        raise unknown_name("preset", name, PRESETS)
    return PRESETS[name]
