"""The four named configurations. Presets are values: nothing branches on a preset's name."""

from ddgrasp.config import Config
from ddgrasp.errors import unknown_name

DEBUG = Config(preset="debug")
DEMO = Config(preset="demo")
LAPTOP = Config(preset="laptop")
PAPER = Config(preset="paper")

PRESETS = {config.preset: config for config in (DEBUG, DEMO, LAPTOP, PAPER)}


def get_preset(name: str) -> Config:
    """The preset of that name; UserError with the nearest right name otherwise."""
    if name not in PRESETS:
        raise unknown_name("preset", name, PRESETS)
    return PRESETS[name]
