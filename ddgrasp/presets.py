"""The four named configurations. Presets are values: nothing branches on a preset's name."""

from ddgrasp.config import Config, DDGConfig, DeployConfig, EvalConfig, RecordConfig
from ddgrasp.errors import unknown_name

_DEBUG_DDG = DDGConfig(
    height_px=90,
    width_px=160,
    widths=(16, 24),
    blocks=(0, 1),
    attention_heads=2,
    train_steps=20,
    batch_size=4,
    checkpoint_every=10,
)
_LAPTOP_DDG = DDGConfig(
    widths=(32, 64, 128), blocks=(0, 2, 1), train_steps=6000, ema_decay=0.999, sample_steps=10
)
_PAPER_DDG = DDGConfig(
    space_to_depth=2,
    widths=(96, 192, 384),
    blocks=(2, 2, 2),
    attention_heads=8,
    train_steps=8000,
    batch_size=64,
    learning_rate=3e-4,
    ema_decay=0.999,
    sample_steps=10,
    sample_batch=256,
)

DEBUG = Config(
    preset="debug",
    ddg=_DEBUG_DDG,
    record=RecordConfig(trajectories=2, frames=12),
    deploy=DeployConfig(realtime_trials=1),
    evaluation=EvalConfig(rig_trials=4),
)
DEMO = Config(preset="demo", record=RecordConfig(trajectories=24))
LAPTOP = Config(
    preset="laptop",
    ddg=_LAPTOP_DDG,
    record=RecordConfig(trajectories=80),
    evaluation=EvalConfig(rig_trials=300),
)
PAPER = Config(
    preset="paper",
    ddg=_PAPER_DDG,
    record=RecordConfig(trajectories=80),
    deploy=DeployConfig(workers=8, realtime_trials=10),
    evaluation=EvalConfig(rig_trials=300),
)

PRESETS = {config.preset: config for config in (DEBUG, DEMO, LAPTOP, PAPER)}


def get_preset(name: str) -> Config:
    """The preset of that name; UserError with the nearest right name otherwise."""
    if name not in PRESETS:
        raise unknown_name("preset", name, PRESETS)
    return PRESETS[name]
