"""The grasping task behind MuJoCo Playground's environment API.

Reads top to bottom: state, reset, step, reward. `reset` and `step` are for one environment; vmap
them, or use `AutoReset`, which also draws a new episode where one ended.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
from flax import struct
from jax.sharding import Mesh
from jaxtyping import Float, Int
from ml_collections import config_dict
from mujoco import mjx
from mujoco_playground import MjxEnv, State

from ddgrasp import contract
from ddgrasp.arrays import AnyArray
from ddgrasp.config import WorldConfig
from ddgrasp.errors import UserError
from ddgrasp.layout import ACTION, QPOS, QVEL, closes
from mjx_envs import devices, grasp_math, kinematics, randomize, rewards, scene
from mjx_envs.physics import interface as physics
from mjx_envs.physics.backends import make_physics
from mjx_envs.precision import exact

LIFTED_M = 0.03
OUT_OF_REACH_M = 0.35
"""An object that rolled this far from the workspace's centre, horizontally, ends the episode."""


@struct.dataclass
class Latency:
    """Commands on their way to the robot."""

    late: jax.Array
    """() bool, whether they take a control step in this episode."""
    controls: jax.Array
    """(9,) the last step's."""


@struct.dataclass
class Episode:
    """What stays fixed during an episode, and its counters."""

    params: physics.ModelParams
    object_index: jax.Array
    """() position in `GraspEnv.table.names`."""
    variant: jax.Array
    """() index into the table's arrays: the object in one of its rest poses."""
    rest_height: jax.Array
    """() m."""
    branch: jax.Array
    """() see `grasp_math.yaw_branch`."""
    distances: rewards.Distances
    action: jax.Array
    """(8,) last action."""
    steps: jax.Array
    hold_count: jax.Array
    """() consecutive steps with the object in the hand at the target: what success needs."""
    bonus_count: jax.Array
    """() the same as the reward counts them: `rewards.succeeds`."""
    grasped: jax.Array
    """() bool."""
    total_reward: jax.Array
    """() sum over the steps so far."""
    latency: Latency | None = None
    """None unless configured."""


class GraspEnv(MjxEnv):
    """Grasp the object and hold it 40 cm up. Observation (40,), action (8,), 10 Hz."""

    def __init__(self, config: WorldConfig):
        """Raises UserError where JAX is told to count in 64 bits, which no physics here does."""
        if jax.config.read("jax_enable_x64"):
            raise UserError(
                "jax_enable_x64 is on: states, physics and pictures are of 32 bits here; leave it off "
                "(JAX_ENABLE_X64=0)."
            )
        super().__init__(config_dict.create(ctrl_dt=contract.CONTROL_DT_S, sim_dt=config.sim_dt_s))
        self.config = config
        self.table = randomize.ObjectTable(config.objects)
        self.physics = make_physics(config.backend, config.sim_dt_s, self.table.layout)
        self._mj_model = scene.build_model(config.sim_dt_s, self.table.layout)

    @exact
    def reset(self, rng: randomize.Key, exploring: randomize.Share = 1.0) -> State:
        """A new episode: object, pose, dynamics and joints drawn from `rng`.

        `exploring` () is a factor on the shares of episodes that start above the object or with it in hand.
        """
        _, k_variant, k_params, k_qpos, k_start, k_next, k_late = _keys(rng)
        index = self.object_drawn(rng)
        variant = randomize.sample_variant(k_variant, self.config.random, self.table, index)
        params, size = randomize.sample_params(k_params, self.config.random, self.table, variant)
        rest = jnp.asarray(self.table.rest_height, jnp.float32)[variant] * size
        qpos = randomize.sample_qpos(k_qpos, self.config.random, rest)
        branch = grasp_math.yaw_branch(qpos[QPOS.object_quat], self._symmetry(variant), jnp)
        if self.config.random.pregrasp_share > 0:
            grasp = self._grasp_pose(qpos, variant, branch)
            share = exploring * self.config.random.pregrasp_share
            turn_rad = self.config.random.pregrasp_turn_rad
            qpos = randomize.maybe_pregrasp(k_start, share, turn_rad, qpos, *grasp)
        if self.config.random.held_share > 0:
            grasp = self._grasp_pose(qpos, variant, branch)
            half_width = jnp.asarray(self.table.half_width, jnp.float32)[variant] * size
            # k_held is split(k_start, 3)[1], a pregrasp's key too; it stays so until teachers are retrained.
            k_held, share = jax.random.fold_in(k_start, 1), exploring * self.config.random.held_share
            qpos = randomize.maybe_held(k_held, share, qpos, *grasp, half_width)
        state = physics.initial_state(qpos)
        episode = Episode(
            params=params,
            object_index=index,
            variant=variant,
            rest_height=rest,
            branch=branch,
            distances=self._distances(state.qpos, variant, branch),
            action=jnp.zeros(contract.ACTION_SIZE).at[ACTION.gripper].set(-1.0),
            steps=jnp.zeros((), jnp.int32),
            hold_count=jnp.zeros((), jnp.int32),
            bonus_count=jnp.zeros((), jnp.int32),
            grasped=jnp.zeros((), bool),
            total_reward=jnp.zeros(()),
            latency=self._latency(k_late, qpos, rest),
        )
        obs = self._get_obs(state, episode)
        metrics = {f"reward/{name}": jnp.zeros(()) for name in rewards.TERMS}
        names = ("success", "lost", "blown_up", "saturated", "return", "length", "contacts_dropped")
        metrics |= {name: jnp.zeros(()) for name in names}
        info = {"episode": episode, "rng": k_next, "truncation": jnp.zeros(())}
        return State(state, obs, jnp.zeros(()), jnp.zeros(()), metrics, info)

    def object_drawn(self, rng: randomize.Key) -> Int[jax.Array, ""]:
        """() index of the object that `reset(rng)` takes."""
        return jax.random.randint(_keys(rng)[0], (), 0, len(self.table.names))

    @exact
    def step(self, state: State, action: Float[jax.Array, "8"]) -> State:
        """One control step with `action` (8,), of which [-1, 1] counts; an episode whose action or state is
        not finite is over."""
        sound = jnp.all(jnp.isfinite(action))
        action = jnp.where(sound, action, 0.0)  # the C engine would drive every joint to 0 by a NaN
        action = jnp.clip(action, -1.0, 1.0)
        old: physics.PhysicsState = state.data
        episode: Episode = state.info["episode"]
        controls, latency = self._delayed(
            episode.latency, grasp_math.controls(old.qpos[QPOS.arm], action, jnp)
        )
        new = self.physics.step(episode.params, old, controls)
        blown_up = ~(jnp.all(jnp.isfinite(new.qpos)) & jnp.all(jnp.isfinite(new.qvel)))
        finite = sound & ~blown_up
        new = jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, old)

        distances = self._distances(new.qpos, episode.variant, episode.branch)
        object_pos = new.qpos[QPOS.object_pos]
        touching, closing = jnp.all(new.touch > grasp_math.TOUCH_N), closes(action)
        grasped = touching & closing
        rewarded = rewards.grasped(self.config.reward, touching, closing, distances.grip_to_object)
        held = grasp_math.at_lift_target(object_pos, jnp)
        hold_count = jnp.where(held & grasped, episode.hold_count + 1, 0)
        succeeds = rewards.succeeds(self.config.reward, held, grasped) & sound
        bonus_count = jnp.where(succeeds, episode.bonus_count + 1, 0)
        terms = rewards.terms(
            self.config.reward,
            rewards.Transition(
                before=episode.distances, after=distances, action=action, last_action=episode.action,
                acceleration=(new.qvel[QVEL.arm] - old.qvel[QVEL.arm]) / contract.CONTROL_DT_S,
                grasped=rewarded, lifted=rewarded & (object_pos[2] > episode.rest_height + LIFTED_M),
                bonus_count=bonus_count,
            ),
        )  # fmt: skip
        reward = jnp.sum(jnp.stack(list(terms.values())))
        steps = episode.steps + 1
        center = jnp.asarray(contract.WORKSPACE_CENTER_M)
        lost = jnp.linalg.norm(object_pos[:2] - center) > OUT_OF_REACH_M
        lost = (lost & ~grasped) | ~finite
        over = steps >= self.config.episode_steps
        episode = replace(
            episode, distances=distances, action=action, steps=steps, hold_count=hold_count,
            bonus_count=bonus_count, grasped=grasped, total_reward=episode.total_reward + reward,
            latency=latency,
        )  # fmt: skip
        metrics = {f"reward/{name}": value for name, value in terms.items()}
        metrics["success"] = (over & ~lost & (hold_count >= contract.HOLD_STEPS)).astype(jnp.float32)
        metrics |= {"lost": lost.astype(jnp.float32), "blown_up": blown_up.astype(jnp.float32)}
        metrics |= {"return": episode.total_reward, "length": steps.astype(jnp.float32)}
        metrics["contacts_dropped"] = new.dropped.astype(jnp.float32)
        metrics["saturated"] = jnp.mean(jnp.abs(action[ACTION.arm]) > grasp_math.SATURATED)
        info = state.info | {"episode": episode, "truncation": (over & ~lost).astype(jnp.float32)}
        return replace(
            state,
            data=new,
            obs=self._get_obs(new, episode),
            reward=reward,
            done=(over | lost).astype(jnp.float32),
            metrics=metrics,
            info=info,
        )

    def _get_obs(self, state: physics.PhysicsState, episode: Episode) -> jax.Array:
        log_category = jnp.asarray(self.table.log_category, jnp.float32)[episode.variant]
        symmetry, offset = self._symmetry(episode.variant), self._grasp_offset(episode.variant)
        return grasp_math.observation(
            state.qpos, state.qvel, symmetry, episode.branch, log_category, jnp, offset
        )

    def _distances(self, qpos, variant, branch) -> rewards.Distances:
        grasp_pos, grasp_quat = self._grasp_pose(qpos, variant, branch)
        grip_pose = kinematics.grip_pose(qpos[QPOS.arm], jnp)
        return rewards.distances(self.config.reward, qpos, grasp_pos, grasp_quat, grip_pose)

    def _latency(self, k_late, qpos, rest_height) -> Latency | None:
        """At the start: the robot holds its pose, gripper open, or closed on what it starts with in hand."""
        share = self.config.random.latency_share
        if share == 0:
            return None
        late = jax.random.uniform(k_late) < share
        in_hand = jnp.where(qpos[QPOS.object_pos][2] > rest_height, 1.0, -1.0)
        still = jnp.zeros(contract.ACTION_SIZE).at[ACTION.gripper].set(in_hand)
        return Latency(late, grasp_math.controls(qpos[QPOS.arm], still, jnp))

    def _delayed(self, latency: Latency | None, controls) -> tuple[jax.Array, Latency | None]:
        """The controls in force now, and what is on its way then."""
        if latency is None:
            return controls, None
        now = jnp.where(latency.late, latency.controls, controls)
        return now, replace(latency, controls=controls)

    def _grasp_pose(self, qpos, variant, branch) -> tuple[jax.Array, jax.Array]:
        symmetry, offset = self._symmetry(variant), self._grasp_offset(variant)
        pose = qpos[QPOS.object_pos], qpos[QPOS.object_quat]
        return grasp_math.grasp_pose(*pose, symmetry, branch, jnp, offset)

    def _symmetry(self, variant) -> jax.Array:
        return jnp.asarray(self.table.symmetry)[variant]

    def _grasp_offset(self, variant) -> jax.Array:
        return jnp.asarray(self.table.grasp_offset, jnp.float32)[variant]

    @property
    def xml_path(self) -> str:
        """None on disk: the scene is generated (`mjx_envs.scene.scene_xml`)."""
        return ""

    @property
    def action_size(self) -> int:
        """8."""
        return contract.ACTION_SIZE

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The scene, with the cube in the slots."""
        return self._mj_model

    @property
    def mjx_model(self) -> mjx.Model:
        """The scene on the JAX device."""
        return mjx.put_model(self._mj_model)


def _keys(rng: randomize.Key) -> jax.Array:
    """(7, ...) the keys of an episode's parts."""
    return jax.random.split(rng, 7)


class AutoReset:
    """Batched environment over `mesh` (by default all devices): where an episode ended, a new one starts.

    The reward, done, metrics and truncation of the ending step are kept. New episodes wait in
    `info["next"]`; call `refresh` at least once an episode, not every step: drawing them costs as
    much as stepping.
    """

    def __init__(self, env: GraspEnv, mesh: Mesh | None = None):
        self.env = env
        self.mesh = mesh or devices.make_mesh()

    def reset(self, rng: jax.Array) -> State:
        """Batch of new episodes from keys (B, 2), at staggered times so that they do not end together."""
        state = devices.each(self.mesh, self.env.reset)(rng)
        episode = state.info["episode"]
        stagger = jnp.arange(rng.shape[0]) % self.env.config.episode_steps
        info = state.info | {"episode": replace(episode, steps=stagger.astype(jnp.int32))}
        return self.refresh(replace(state, info=info))

    def refresh(self, state: State, exploring: randomize.Share = 1.0) -> State:
        """Draw the batch's next episodes, `exploring` as in `GraspEnv.reset`."""
        keys = state.info["rng"]
        fresh = devices.each(self.mesh, self.env.reset)(keys, jnp.full(len(keys), exploring, jnp.float32))
        waiting = (fresh.data, fresh.obs, fresh.info["episode"])
        return replace(state, info=state.info | {"next": waiting, "rng": fresh.info["rng"]})

    def step(self, state: State, action: Float[AnyArray, "b 8"]) -> State:
        """One control step of the batch with `action` (B, 8)."""
        waiting = state.info["next"]
        bare = {k: v for k, v in state.info.items() if k != "next"}
        state = devices.each(self.mesh, self.env.step)(replace(state, info=bare), action)

        def pick(new, old):
            return jnp.where(state.done.reshape((-1,) + (1,) * (old.ndim - 1)) > 0, new, old)

        ended = (state.data, state.obs, state.info["episode"])
        data, obs, episode = jax.tree.map(pick, waiting, ended)
        info = state.info | {"episode": episode, "next": waiting}
        return replace(state, data=data, obs=obs, info=info)
