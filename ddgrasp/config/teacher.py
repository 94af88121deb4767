"""The teacher: PPO on the privileged state, on one host or several."""

from dataclasses import dataclass
from typing import Annotated

from ddgrasp.config.checks import (
    Count,
    CountOrNone,
    LearningRate,
    Range,
    Section,
    Share,
    Steps,
    Text,
    Width,
)
from ddgrasp.errors import UserError

NOTHING, GUIDE = "nothing", "guide"
"""Values of `TeacherConfig.start` that are no folder."""
MOST_GRADIENT_STEPS = 2**31 - 1
"""PPO counts them in 32 bits."""


@dataclass(frozen=True)
class TeacherConfig(Section, name="teacher"):
    """PPO on the privileged state."""

    start: Text = "guide"
    """What the policy starts from: nothing (PPO alone, on the reward), guide (a scripted controller,
    ppo/guide.py, is cloned into it first), or a run directory or pretrained folder whose policy goes on (with
    total_steps 0 it is used as it is)."""
    total_steps: Annotated[int, Range(0, 10**12)] = 2_000_000
    """Control steps of experience, over all environments together."""
    num_envs: Annotated[int, Range(1, 2**31 - 1)] = 512
    """Environments stepped together."""
    unroll_steps: Annotated[int, Range(1, 10_000)] = 20
    """Control steps between updates."""
    minibatches: Count = 8
    """Gradient steps per epoch; must divide num_envs."""
    epochs: Annotated[int, Range(1, 1000)] = 4
    """Passes over each batch of experience."""
    learning_rate: LearningRate = 2e-5
    """Adam's step size for the policy at the start; decays linearly to a tenth, unless target_kl steers it.
    Keep it small for a policy that acts well already (start): a large step undoes it."""
    target_kl: Annotated[float, Range(0, 10)] = 0.0
    """Above 0 the step size is raised and lowered so that an update changes the policy by about this KL
    divergence (as rsl_rl does by its desired_kl); 0 lets it decay linearly."""
    critic_learning_rate: LearningRate = 5e-4
    """Adam's step size for the value network at the start; always decays linearly to a tenth."""
    discount: Share = 0.97
    """How much a reward one control step later counts (gamma)."""
    bootstrap_time_limit: bool = False
    """What comes after an episode's last step counts as what the value network expects of it (Pardo et al.
    2018), instead of nothing. A policy that holds what it has lifted is worth ever more by that, to a network
    that learns from its own estimates: PPO follows them away from a cloned one (docs/teacher.md)."""
    gae_lambda: Share = 0.95
    """Generalised advantage estimation: 0 trusts the value network, 1 the rewards that were seen.
    Brax's, whose advantage is a step's own error plus discount, not discount times lambda, times the next
    step's."""
    action_std: Annotated[float, Range(0, 10, above=True)] = 0.15
    """Standard deviation of the exploration noise of the arm's joints at the start, before the tanh. What a
    loaded policy has learnt of its noise is relative to it: as much as its own training had leaves it as it
    was."""
    gripper_std: Annotated[float, Range(0, 10, above=True)] = 0.15
    """The same for the gripper's command, which counts by its sign alone."""
    min_std: Annotated[float, Range(0, 10)] = 0.01
    """Floor of the noise: 0.2 keeps it above 0.2 / log 2 = 29 % of action_std and gripper_std (and adds as
    much to both at the start)."""
    entropy_cost: Annotated[float, Range(0, 10)] = 1e-3
    """Weight of the reward for acting at random: more keeps exploring for longer."""
    clip: Share = 0.2
    """PPO's clipping range: how far an update may move an action's probability, as a share of it."""
    reward_scaling: Annotated[float, Range(0, 1000, above=True)] = 0.5
    """Factor on every reward before it is learnt from."""
    max_grad_norm: Annotated[float, Range(0, 1_000_000, above=True)] = 1.0
    """Longer gradients are shortened to this length."""
    hidden: tuple[Width, ...] = (256, 128)
    """Layers of policy and value networks."""
    pregrasp_share: Share = 0.2
    """Share of the training episodes not begun by held_share that start with the hand above the object
    (exploring starts)."""
    pregrasp_turn_rad: Annotated[float, Range(0, 1.5)] = 0.0
    """The hand's yaw there, off the grasp's by up to this: how to turn to either side is found near the
    object."""
    held_share: Share = 0.0
    """Share of training episodes that start with the object in the hand, anywhere up to the lift target."""
    settle_from: Share = 1.0
    """From this share of the iterations on PPO settles: episodes start as the world's do, without the two
    shares above, and target_kl with the least step size shrinks linearly to a tenth; 1 for never."""
    clone_rounds: Count = 8
    """DAgger rounds in which the policy network learns the guide before PPO; for start guide alone."""
    clone_envs: Count = 192
    """Episodes per such round."""
    clone_steps: Steps = 500
    """Optimiser steps per such round."""
    critic_warmup: CountOrNone = 10
    """Iterations in which the critic alone learns, so that it does not mislead a policy that was cloned or
    loaded; its own start is random."""
    eval_every: Count = 20
    """Iterations between deterministic evaluations; there is one after the last too."""
    checkpoint_every: Count = 20
    """Iterations between whole-state checkpoints."""
    stop_at: Share = 1.0
    """End early once two evaluations in a row reach this success rate."""

    @property
    def iterations(self) -> int:
        """Number of iterations in `total_steps` control steps."""
        return max(1, round(self.total_steps / (self.num_envs * self.unroll_steps)))

    @property
    def starts_from_file(self) -> bool:
        """Whether `start` names a run or a pretrained folder."""
        return self.start not in (NOTHING, GUIDE)

    def check(self) -> None:
        """See `Section.check`."""
        if self.num_envs % self.minibatches:
            raise UserError(
                f"teacher.num_envs {self.num_envs} is no multiple of teacher.minibatches {self.minibatches}: "
                "change one of them."
            )
        if not self.start:
            raise self.error("start", "nothing, guide, or a run directory or pretrained folder")
        if self.total_steps == 0 and not self.starts_from_file:
            raise self.error(
                "total_steps", f"at least 1: a teacher that starts from {self.start} has to learn"
            )
        if (steps := self.iterations * self.epochs * self.minibatches) > MOST_GRADIENT_STEPS:
            raise UserError(
                f"teacher.total_steps {self.total_steps} makes {self.iterations} iterations, with "
                f"teacher.epochs {self.epochs} and teacher.minibatches {self.minibatches} {steps} gradient "
                f"steps; expected at most {MOST_GRADIENT_STEPS}: take fewer of one, or more teacher.num_envs."
            )


@dataclass(frozen=True)
class HostsConfig(Section, name="hosts"):
    """Several processes, usually one per host, that train as one. Not part of a run's configuration: the same
    run may go on with another number of them."""

    coordinator: Text = ""
    """Address (host:port) of process 0, the same on every host; auto asks Slurm, Open MPI, Kubernetes or a
    TPU pod, which name the processes too; empty for one process."""
    processes: Annotated[int, Range(1, 100_000)] = 1
    """Number of processes."""
    process: Annotated[int, Range(0, 100_000)] = 0
    """This process, from 0; 0 alone writes logs, policies and manifests."""

    def check(self) -> None:
        """See `Section.check`."""
        named = self.coordinator not in ("", "auto")
        host, _, port = self.coordinator.rpartition(":")
        if named and not (host and port.isdecimal() and 0 < int(port) < 65536):
            raise self.error("coordinator", "host:port with a port of 1 to 65535, or auto")
        if not named and (self.processes, self.process) != (1, 0):
            raise UserError(
                f"hosts.processes is {self.processes}, hosts.process {self.process}, hosts.coordinator "
                f"{self.coordinator!r}: give the address (host:port) of process 0."
            )
        if not 0 <= self.process < self.processes:
            raise self.error("process", f"0 to {self.processes - 1} (hosts.processes is {self.processes})")
