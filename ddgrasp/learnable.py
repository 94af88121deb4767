"""Whether anything would be learnt by a configuration: asked of what is to be made.

What was made by such a one is read as ever, so that these are no checks of the configuration's own.
"""

import math

from ddgrasp import contract
from ddgrasp.config import Config, DDGDiffusionConfig, StudentConfig, TeacherConfig
from ddgrasp.errors import UserError

_MOST_BONUS = 1e15
"""Its square, which the critic's loss has, summed over a batch is far from float32's largest number."""


def check_learnable(config: Config) -> None:
    """UserError for settings with which teacher, generator or student would learn nothing of use, or act
    before they have."""
    if config.scale == 1:  # a trial run has too few iterations for anything
        _check_actor(config.teacher)
        _check_time(config)
    _check_bonus(config)
    _check_noise(config.ddg.diffusion)
    _check_losses(config.student)
    _check_head(config.student)
    _check_sight(config.student)


def _check_actor(teacher: TeacherConfig) -> None:
    if teacher.total_steps and teacher.critic_warmup >= teacher.iterations:
        raise UserError(
            f"teacher.critic_warmup is {teacher.critic_warmup}, and teacher.total_steps "
            f"{teacher.total_steps} makes {teacher.iterations} iteration(s), in all of which the critic "
            "alone would learn: take fewer of those, or more steps."
        )
    if teacher.total_steps and teacher.num_envs * teacher.unroll_steps == teacher.minibatches:
        raise UserError(
            f"teacher.minibatches {teacher.minibatches} of {teacher.num_envs} environments' unroll_steps "
            f"{teacher.unroll_steps} are one control step each, whose advantage less the mean is 0: the "
            "policy would learn nothing; take fewer minibatches, or more steps."
        )


def _check_time(config: Config) -> None:
    if config.teacher.total_steps and config.world.episode_steps < contract.HOLD_STEPS:
        raise UserError(
            f"world.episode_steps is {config.world.episode_steps}; success is an object held for the last "
            f"{contract.HOLD_STEPS}, and would never be seen: take more."
        )


def _check_bonus(config: Config) -> None:
    """PPO's sums of it are float32."""
    if not config.teacher.total_steps:
        return
    reward = config.world.reward
    count = min(reward.bonus_max_count, config.world.episode_steps)
    if math.log(reward.bonus_base) + count * math.log(reward.bonus_growth) > math.log(_MOST_BONUS):
        raise UserError(
            f"world.reward.bonus_base {reward.bonus_base:g} times bonus_growth {reward.bonus_growth:g} to "
            f"the power of {count} (the lesser of bonus_max_count and episode_steps) is a bonus beyond "
            f"{_MOST_BONUS:g}: take a lower bonus_growth or bonus_max_count."
        )


def _check_noise(diffusion: DDGDiffusionConfig) -> None:
    if diffusion.log_snr_shift > (most := diffusion.noisy_up_to):
        raise diffusion.error(
            "log_snr_shift",
            f"at most {most:.1f} with {diffusion.steps} steps of schedule {diffusion.schedule}: the last one "
            "would not be noise, which sampling begins with",
        )
    if diffusion.log_snr_shift < (least := diffusion.exact_from):
        raise diffusion.error(
            "log_snr_shift",
            f"at least {least:.1f} with {diffusion.steps} steps of schedule {diffusion.schedule}: sampling's "
            "first step would lose the network's answer to rounding; or take fewer steps",
        )


def _check_losses(student: StudentConfig) -> None:
    training, rounds = student.training, student.poses.rounds
    if _on_pictures(student) and not (training.aux_weight or training.action_weight):
        raise UserError(
            "student.training.aux_weight and action_weight are both 0: training on pictures would change "
            "nothing; give one of them a weight."
        )
    if rounds and not student.head.aux_to_head:
        raise UserError(
            f"student.poses.rounds is {rounds}, and student.head.aux_to_head off: on poses without pictures "
            "the head would see nothing; take 0 rounds."
        )


def _on_pictures(student: StudentConfig) -> bool:
    """Whether anything is trained on pictures."""
    return student.training.steps > 0 or student.dagger.rounds * student.dagger.steps > 0


def _check_sight(student: StudentConfig) -> None:
    """What acts must see, and what sees must have been trained, and be what it is called."""
    encoder = student.encoder
    if encoder.output_stride > (largest := encoder.largest_stride):
        stages = f"{len(encoder.stage_blocks)} stage(s) of stage_blocks"
        raise encoder.error("output_stride", f"at most {largest}, which is what {stages} reach")
    if student.head.conditioning == "film" and not student.head.blocks:
        raise UserError(
            "student.head.blocks is 0 with student.head.conditioning film, which acts in blocks alone: the "
            "head would see neither an observation nor the diffusion step; take 1 or more, or concat."
        )
    if not (_on_pictures(student) or student.init_from):
        raise UserError(
            f"student.training.steps is 0, dagger.rounds {student.dagger.rounds} and dagger.steps "
            f"{student.dagger.steps}, no student.init_from: nothing would have trained perception; give "
            "steps, or a student to begin from."
        )


def _check_head(student: StudentConfig) -> None:
    """What acts must have been trained, which the action loss on pictures does by itself."""
    head, training, begun = student.head, student.training, bool(student.init_from)
    if training.action_weight and training.steps:
        return
    lacking = "steps" if training.action_weight else "action_weight"
    if head.features_to_head and (student.poses.rounds or (student.dagger.rounds and not begun)):
        raise UserError(
            f"student.head.features_to_head with student.training.{lacking} 0: the head would act before it "
            f"has learnt what the features mean; give {lacking}, or 0 poses.rounds and dagger.rounds."
        )
    acts_untrained = student.dagger.rounds or not head.train_steps
    if acts_untrained and not (student.poses.rounds * student.poses.steps or begun):
        raise UserError(
            f"student.poses.rounds {student.poses.rounds} and steps {student.poses.steps}, student.training."
            f"{lacking} 0, no student.init_from: nothing would have trained the action head before it acts; "
            f"give rounds and steps on poses, {lacking}, or a student to begin from."
        )
