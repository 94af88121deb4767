"""The named configurations. Presets are values: nothing branches on a preset's name."""

from dataclasses import replace

from ddgrasp.config import (
    Config,
    DDGConfig,
    DemosConfig,
    DeployConfig,
    EvalConfig,
    ExportConfig,
    RecordConfig,
    ScoreConfig,
    StudentConfig,
    TeacherConfig,
    WorldConfig,
)
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
    teacher=TeacherConfig(
        init_from="pretrained/teacher",
        total_steps=160,
        num_envs=8,
        unroll_steps=10,
        minibatches=2,
        epochs=1,
        learning_rate=1e-5,
        critic_warmup=0,
        eval_every=1,
        checkpoint_every=1,
    ),
    demos=DemosConfig(episodes=4, parallel=6),
    record=RecordConfig(trajectories=2, frames=12),
    ddg=_DEBUG_DDG,
    student=StudentConfig(
        width=8,
        keypoints=8,
        hand_view_px=16,
        hand_view_pitch_m=0.008,
        hand_view_width=8,
        hand_view_blocks=1,
        denoiser_width=32,
        denoiser_blocks=1,
        pose_rounds=1,
        pose_episodes=4,
        pose_steps=10,
        train_steps=4,
        batch_size=4,
        dagger_rounds=1,
        dagger_episodes=2,
        dagger_steps=2,
        head_steps=4,
        head_batch_size=16,
    ),
    export=ExportConfig(parity_batches=4, latency_runs=20),
    deploy=DeployConfig(realtime_trials=1),
    evaluation=EvalConfig(teacher_trials=16, student_trials=4, rig_trials=4),
    score=ScoreConfig(
        trajectories=3,
        frames=4,
        kid_subsets=4,
        kid_subset_size=6,
        bootstrap=8,
        tsne_maps=60,
        neighbours=3,
        repeat_scenes=1,
        repeats=2,
        curve_trajectories=(1, 2),
    ),
)
"""Every stage at its smallest; no quality claimed. PPO goes on from the pretrained policy, since a teacher
that never succeeds leaves no demos."""

DEMO = Config(
    preset="demo",
    teacher=TeacherConfig(total_steps=300_000, eval_every=10),
    demos=DemosConfig(episodes=120),
    record=RecordConfig(trajectories=24),
    ddg=DDGConfig(train_steps=1000),
    student=StudentConfig(
        init_from="pretrained/student",
        learning_rate=3e-4,
        pose_rounds=2,
        pose_steps=500,
        train_steps=200,
        dagger_rounds=1,
        dagger_episodes=48,
        dagger_steps=200,
        head_steps=1500,
    ),
    evaluation=EvalConfig(student_trials=60),
    score=ScoreConfig(trajectories=24, kid_subset_size=150, tsne_maps=3000),
)
"""For two cores within 45 minutes (23 on two AMD EPYC cores, 2026-11-22); the student starts from the
pretrained one."""

LAPTOP = Config(
    preset="laptop",
    teacher=TeacherConfig(total_steps=500_000, eval_every=10),
    demos=DemosConfig(episodes=240),
    record=RecordConfig(trajectories=80),
    ddg=DDGConfig(train_steps=1200, sampler="progressive"),
    student=StudentConfig(
        train_steps=1500,
        dagger_rounds=2,
        dagger_episodes=48,
        dagger_steps=400,
        head_steps=3000,
        clean_share=0.3,
    ),
    evaluation=EvalConfig(student_trials=60, rig_trials=60),
)
"""Everything trained from nothing on two cores (73 minutes of stage time on two AMD EPYC cores
that two to four other jobs shared, 2026-11-21)."""

CAMERA = replace(
    LAPTOP,
    preset="camera",
    ddg=DDGConfig(
        surface="piecewise",
        prior="metric_inverse_depth",
        snr_limits=(1.0, 3.0),
        blocks=(1, 1, 1),
        hole_loss="cross_entropy",
        batch_size=4,
        train_steps=4000,
        sampler="ddim",
        sample_steps=2,
        eta=1.0,
        deviation_threshold=0.0016,
    ),
)
"""`laptop` with a generator for a real camera that moves, chosen on 80 of its frames (docs/generator.md)."""

PAPER = Config(
    preset="paper",
    world=WorldConfig(backend="jax", camera_scale=0.5),
    teacher=TeacherConfig(total_steps=100_000_000, num_envs=8192, minibatches=32),
    demos=DemosConfig(episodes=1200, parallel=256),
    record=RecordConfig(trajectories=80),
    ddg=_PAPER_DDG,
    student=StudentConfig(
        input_height_px=225, input_width_px=290, stem="conv7", width=64, stage_blocks=(2, 2, 2, 2),
        output_stride=16,
        features_to_head=True, action_weight=1.0, pose_rounds=12, pose_episodes=1024,
        train_steps=40_000, batch_size=256, dagger_rounds=6, dagger_episodes=512, dagger_steps=5000,
        head_steps=20_000, crop_shift_px=12,
    ),
    deploy=DeployConfig(workers=8, realtime_trials=10),
    evaluation=EvalConfig(rig_trials=300),
    score=ScoreConfig(trajectories=160, kid_subset_size=1000),
)  # fmt: skip
"""The paper's sizes, for one GPU. Not run yet."""

PRESETS = {config.preset: config for config in (DEBUG, DEMO, LAPTOP, CAMERA, PAPER)}


def get_preset(name: str) -> Config:
    """The preset of that name; UserError with the nearest right name otherwise."""
    if name not in PRESETS:
        raise unknown_name("preset", name, PRESETS)
    return PRESETS[name]
