"""The named configurations. Presets are values: nothing branches on a preset's name."""

from dataclasses import replace

from ddgrasp import contract
from ddgrasp.config import (
    PAPER_REWARD,
    Config,
    DaggerConfig,
    DDGConfig,
    DDGDepthConfig,
    DDGTrainingConfig,
    DemosConfig,
    DeployConfig,
    EncoderConfig,
    EvalConfig,
    ExportConfig,
    GraftConfig,
    HandViewConfig,
    HeadConfig,
    PictureConfig,
    PosesConfig,
    PriorConfig,
    RecordConfig,
    SamplingConfig,
    ScoreConfig,
    StudentConfig,
    StudentTrainingConfig,
    TeacherConfig,
    UNetConfig,
    WorldConfig,
)
from ddgrasp.errors import looked_up

_DEBUG_DDG = DDGConfig(
    depth=DDGDepthConfig(height_px=45, width_px=80),
    unet=UNetConfig(widths=(16, 24), blocks=(0, 1), attention_heads=2),
    training=DDGTrainingConfig(steps=20, batch_size=4, checkpoint_every=10),
    sampling=SamplingConfig(steps=2, batch_size=4),
)
_BUMPS = SamplingConfig(sampler="ddim", spacing="linspace", steps=6, deviation_correlation=0.5)
"""Bumps are decided in strong noise, where linspace steps stop and quadratic ones hardly do."""
_RIG_DDG = DDGConfig(
    depth=DDGDepthConfig(surface="planes"),
    unet=UNetConfig(position=True),
    training=DDGTrainingConfig(steps=1000),
    sampling=_BUMPS,
)
"""Bumps and places of the rig's camera are learnt, chosen by a student's success (docs/table2.md)."""
_PAPER_DDG = DDGConfig(
    depth=_RIG_DDG.depth,
    unet=UNetConfig(
        space_to_depth=2, widths=(96, 192, 384), blocks=(2, 2, 2), attention_heads=8, position=True
    ),
    training=DDGTrainingConfig(steps=8000, batch_size=64, learning_rate=3e-4, ema_decay=0.999),
    sampling=replace(_BUMPS, steps=10, batch_size=256),
)

DEBUG = Config(
    preset="debug",
    world=WorldConfig(episode_steps=45, camera_scale=0.125),
    teacher=TeacherConfig(
        start="pretrained/teacher",
        total_steps=160,
        num_envs=8,
        unroll_steps=10,
        minibatches=1,  # eight devices share it
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
        picture=PictureConfig(height_px=56, width_px=72, fill_holes=True),
        encoder=EncoderConfig(width=8, keypoints=8),
        hand_view=HandViewConfig(size_px=16, pitch_m=0.008, width=8, blocks=1),
        head=HeadConfig(width=32, blocks=1, train_steps=4, batch_size=16),
        poses=PosesConfig(rounds=1, episodes=4, steps=10),
        training=StudentTrainingConfig(steps=4, batch_size=4),
        dagger=DaggerConfig(rounds=1, episodes=2, steps=4),
    ),
    export=ExportConfig(parity_batches=4, latency_runs=20),
    deploy=DeployConfig(realtime_trials=1),
    evaluation=EvalConfig(teacher_trials=16, student_trials=2, rig_trials=2),
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
    ddg=_RIG_DDG,
    student=StudentConfig(
        init_from="pretrained/student",
        picture=PictureConfig(fill_holes=True),
        training=StudentTrainingConfig(learning_rate=3e-4, steps=200, demo_stretch_steps=12),
        poses=PosesConfig(rounds=2, steps=500),
        dagger=DaggerConfig(rounds=1, episodes=48, steps=200),
        head=HeadConfig(train_steps=1500),
    ),
    evaluation=EvalConfig(student_trials=30),
    score=ScoreConfig(trajectories=24, kid_subset_size=150, tsne_maps=3000),
)
"""For two cores; the student starts from the pretrained one. 28 to 35 minutes on two Intel Xeon cores, 19 on
two AMD EPYC ones (docs/results.md)."""

LAPTOP = Config(
    preset="laptop",
    world=WorldConfig(objects=(*contract.SEEN_OBJECTS, *contract.PLAIN_SHAPES)),
    teacher=TeacherConfig(total_steps=500_000, eval_every=10),
    demos=DemosConfig(episodes=1200, rgb=False),
    record=RecordConfig(trajectories=80),
    ddg=replace(_RIG_DDG, training=DDGTrainingConfig(steps=1200)),
    student=StudentConfig(
        picture=PictureConfig(fill_holes=True),
        training=StudentTrainingConfig(steps=3000, clean_share=0.3, demo_stretch_steps=12),
        dagger=DaggerConfig(rounds=2, episodes=48, steps=400),
        head=HeadConfig(train_steps=3000),
    ),
    evaluation=EvalConfig(student_trials=60),
)
"""Everything trained here on two cores, the teacher from the guide. 81 minutes on two Intel Xeon cores,
50 to 69 on two AMD EPYC ones (docs/results.md). Six plain shapes besides the paper's objects teach a student
more than those. Demos have no colour, which takes most of their time and which row Monocular of Table II
alone needs."""

_FROM_NOTHING = TeacherConfig(
    start="nothing",
    total_steps=5_000_000,
    num_envs=1024,
    minibatches=16,
    learning_rate=3e-4,
    target_kl=0.02,
    critic_learning_rate=1e-3,
    action_std=0.3,
    gripper_std=0.5,
    min_std=0.2,
    bootstrap_time_limit=True,
    entropy_cost=2e-3,
    hidden=(256, 256, 128),
    pregrasp_share=0.5,
    pregrasp_turn_rad=1.0,
    held_share=0.2,
    settle_from=0.6,
    critic_warmup=0,
    eval_every=12,
    checkpoint_every=24,
)

PPO = replace(LAPTOP, preset="ppo", world=WorldConfig(), teacher=_FROM_NOTHING)
"""`laptop` with a teacher by PPO alone, on the paper's six objects (docs/teacher.md)."""

PPO_PAPER = replace(PPO, preset="ppo_paper", world=replace(PPO.world, reward=PAPER_REWARD))
"""`ppo` on the paper's reward."""

CAMERA = replace(
    LAPTOP,
    preset="camera",
    ddg=DDGConfig(
        depth=DDGDepthConfig(surface="piecewise"),
        prior=PriorConfig(source="metric_inverse_depth"),
        training=DDGTrainingConfig(
            snr_limits=(1.0, 3.0), hole_loss="cross_entropy", batch_size=4, steps=4000
        ),
        unet=UNetConfig(blocks=(1, 1, 1)),
        sampling=SamplingConfig(sampler="ddim", steps=2, eta=1.0),
        graft=GraftConfig(deviation_threshold=0.0016),
    ),
)
"""`laptop` with a generator for a real camera that moves, chosen on 80 of its frames
(docs/generator_log.md)."""

STUDENT_PAPER = replace(
    LAPTOP,
    preset="student_paper",
    world=WorldConfig(),
    student=StudentConfig(
        picture=PictureConfig(channels=("depth",)),
        encoder=EncoderConfig(
            stem="conv7", width=64, stage_blocks=(2, 2, 2, 2), output_stride=32, pooling="mean", features=512
        ),
        hand_view=HandViewConfig(size_px=0),
        head=HeadConfig(features_to_head=True, aux_to_head=False, chunk=1, train_steps=0),
        training=StudentTrainingConfig(
            aux_weight=0.0,
            action_weight=1.0,
            held_weight=1.0,
            demo_held_steps=10_000,
            clean_share=0.0,
            disparity_noise_px=0.0,
        ),
        poses=PosesConfig(rounds=0),
        dagger=DaggerConfig(rounds=0),
    ),
    deploy=DeployConfig(noise="normal"),
)
"""`laptop` with the paper's student (III-C) and six objects: ResNet-18 on depth alone, end to end, behaviour
cloning on 1,200 demos, one action from Gaussian noise; no privileged losses, hand view, DAgger or noise by
hand. A sample takes 42 ms forward and backward on two Intel Xeon cores, so that its training is about 67
minutes; after 24,350 steps of 64 on stretches of demos it has them by heart (docs/table2.md); as it is here
it has not been trained. Not the paper's: group norm for batch norm, random first weights
(--student.encoder.weights weights/resnet18), 112 x 144 pixels, a quarter of its 450 x 580 each way, from a
window around a known place, 1,500 steps of 64 (it names neither), a ninth number of state (how the hand's
width changes), demos of a perturbed teacher (--demos.noise-share 0), a closing of the hand that lasts
(--student.head.closing-steps 0), and the loop's rules (deploy.retry)."""

PAPER = Config(
    preset="paper",
    world=WorldConfig(backend="jax", camera_scale=0.5),
    teacher=replace(_FROM_NOTHING, total_steps=100_000_000, num_envs=8192, minibatches=32),
    demos=DemosConfig(episodes=1200, parallel=256, rgb=False),
    record=RecordConfig(trajectories=80),
    ddg=_PAPER_DDG,
    student=StudentConfig(
        picture=PictureConfig(height_px=224, width_px=288, fill_holes=True),
        encoder=EncoderConfig(stem="conv7", width=64, stage_blocks=(2, 2, 2, 2), output_stride=16),
        head=HeadConfig(features_to_head=True, train_steps=20_000),
        training=StudentTrainingConfig(action_weight=1.0, steps=40_000, batch_size=256, crop_shift_px=12),
        poses=PosesConfig(rounds=12, episodes=1024),
        dagger=DaggerConfig(rounds=6, episodes=512, steps=5000),
    ),
    deploy=DeployConfig(workers=8, realtime_trials=10),
    evaluation=EvalConfig(rig_trials=300),
    score=ScoreConfig(trajectories=160, kid_subset_size=1000),
)
"""The paper's sizes, for one GPU. No GPU has run it whole; `--scale 0.001` passes through it on a CPU, and
docs/accelerators.md says what is known of it. Not the paper's:

camera: 640 x 360, half of its 1280 x 720 per side, in which the crop window of 450 x 580 is 225 x 290 pixels.
    What the network sees is about what ResNet-18 was made for, and frames, which are read again and again,
    have a quarter of the bytes. The encoder needs multiples of 4: 224 x 288 trims a row and two columns and
    resamples nothing.
hand: a Franka Hand, where the paper's arm has a UMI gripper; the teacher sees the grasp as a pose
    (7 numbers), where the paper lists a position (3).
demos: of a teacher that is perturbed in a sixth of the steps (--demos.noise-share 0 for none), without colour
    (--demos.rgb); 8 of 80 recordings are held out from the generator's fit (--ddg.training.holdout-fraction).
generator: at 320 x 180 (the paper does not say), drawing holes and deviations from the surface instead of
    depth itself (the paper's: --ddg.depth.representation depth --ddg.graft.noise-threshold -0.2
    --ddg.training.loss-weight uniform; docs/generator.md compares them).
prior: inverse depth, holes filled, where the paper has Video Depth Anything: its weights are not part of this
    repository (--ddg.prior.source video_depth_anything, once they are converted). It is disturbed, in
    training and in sampling, where the paper's is fixed (--ddg.prior.noise 0 --ddg.prior.jitter 0
    --ddg.prior.blur-px 0 --ddg.prior.decoy-holes 0).
sampler: DDIM with 10 evaluations, where the paper goes through all K steps: 100 times the time. Frames of
    an episode share part of their noise (--ddg.sampling.frame-correlation 0
    --ddg.sampling.deviation-correlation 0: none).
bumps: deviations are counted from planes, and the network knows where in the picture it is: what a student's
    success was chosen by (docs/table2.md); the paper says nothing of either.
encoder: ResNet-18 from random numbers, where the paper's starts from ImageNet's weights, for the same reason
    (--student.encoder.weights weights/resnet18), and group norm for batch norm; its last stage keeps stride
    16, and keypoints pool it.
student: sees relief over the table instead of depth, its holes filled from around them, and has a hand view,
    privileged losses, pose rounds and DAgger, which the paper has not: perception to 5 mm is what decides
    whether it grasps (docs/student_log.md). Besides the generator's noise it trains with ripple made by hand
    and a fifth of clean samples (--student.training.disparity-noise-px 0 --student.training.clean-share 0),
    gives two actions at a time, whose diffusion starts from zeros (--deploy.noise normal: from noise), and
    sees how the hand's width changes. Of a demo it sees 20 steps after the grasp, held ones less often
    (--student.training.held-weight 1 --student.training.demo-held-steps 10000). Its head is trained on by
    itself, on perceived and on noisy true poses (--student.head.train-steps), has a closing that lasts
    (--student.head.closing-steps 0), and its loop has the rules of deploy.retry.
crops: shifted by up to 12 pixels around the window's place, since the camera's place is known here.
teacher: networks, number of environments and steps are not in the paper; ours for its 95 %. A fifth of the
    episodes begin with the object in the hand and half of the others above it, and the reward is ours; the
    paper's own five terms are those of preset `ppo_paper` (docs/teacher.md has both, learnt from nothing).
trials: some 50 of each object for the teacher and 17 for the student in simulation, where the paper has 100,
    and 25 of each on the rig (its 20 are a real robot's).
"""

PRESETS = {
    config.preset: config for config in (DEBUG, DEMO, LAPTOP, STUDENT_PAPER, PPO, PPO_PAPER, CAMERA, PAPER)
}


def get_preset(name: str) -> Config:
    """The preset of that name; UserError with the nearest right name otherwise."""
    return looked_up("preset", name, PRESETS)
