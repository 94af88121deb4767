"""The student: depth frames and joint state in, a chunk of actions out (paper III-C3).

`StudentPolicy(config, profile)` holds the networks; its methods are called through `policy.apply`:

    params = init_params(key, config, profile)
    seen = policy.apply({"params": params}, depth_m, state, crop_rc, method="encode")
    cond = policy.apply({"params": params}, seen, state, method="condition")
    eps = policy.apply({"params": params}, noisy_action, k, cond, method="denoise")
"""

from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Float, Int, Key

from ddgrasp import artifacts, contract
from ddgrasp.arrays import AnyArray
from ddgrasp.config import Config, StudentConfig
from ddgrasp.contract import CameraProfile
from ddgrasp.errors import UserError
from ddgrasp.layout import POLICY_STATE, Layout
from ddgrasp.shipped import holding
from learning import diffusion
from learning.params import load_params
from mjx_envs import kinematics
from student_jax.denoiser import Denoiser, StateStream, normalise_state
from student_jax.encoder import POSITION_CENTER_M, POSITION_SCALE_M, DepthEncoder
from student_jax.hand_view import HandView
from student_jax.preprocess import crop_origin, prepare_depth

Numbers = jax.Array | np.ndarray
Positions = TypeVar("Positions", jax.Array, np.ndarray)

AUX = Layout(position=3, yaw=2, held=1)
"""The auxiliary output, see `Aux`."""
AUX_BESIDE = Layout(position=3, yaw=2, held=1, beside=3, near=1)
"""The same with the hand view: the object's offset from the hand too, and a gate between the two places."""
BESIDE_SCALE = 0.25
"""Network units per unit of that offset: 5 cm."""
TERMINAL_TIME = 0.98
"""End of the action diffusion's schedule, see `learning.diffusion.cosine_betas`."""
HEAD_PARAMS = ("state_stream", "denoiser")
"""The parameters that act; all others see."""
PARAMS_FILE = "params.msgpack"
"""Name of the parameter file in the student's artifact (`learning.params`)."""


class Aux(NamedTuple):
    """Privileged predictions, supervised in simulation only."""

    position: Float[Numbers, "B 3"]
    """Grasp position in network units; see `position_from_world` and `position_to_world`."""
    yaw: Float[Numbers, "B 2"]
    """Cosine and sine of twice the grasp yaw (`data.YAW_MULTIPLE`)."""
    held_logit: Float[Numbers, " B"]
    """Logit of the object being in the hand."""


class Seen(NamedTuple):
    """What the policy makes of one observation; worth caching while only the head trains."""

    features: Float[Numbers, "B F"]
    """The encoder's vector."""
    aux: Aux


def load(directory: Path | str) -> tuple[Config, dict]:
    """(configuration, parameters) of the student in a stage's folder, a run's or `pretrained/student`.

    The parameters are nested dicts of NumPy arrays. Raises UserError if there is none.
    """
    folder = holding(directory, artifacts.MANIFEST, "student")
    if folder is None or (manifest := artifacts.read_manifest(folder)).stage != "student":
        raise UserError(f"{directory} holds no finished student: train one with `ddgrasp student train`.")
    return artifacts.config_from_json(manifest.config), load_params(folder / PARAMS_FILE)


def position_from_world(position_m: Positions) -> Positions:
    """(..., 3) metres in the world to network units."""
    return (position_m - np.array(POSITION_CENTER_M, np.float32)) / POSITION_SCALE_M


def position_to_world(position: Float[Numbers, "*b 3"]) -> Float[jax.Array, "*b 3"]:
    """(..., 3) network units to metres in the world."""
    return jnp.asarray(position) * POSITION_SCALE_M + jnp.array(POSITION_CENTER_M)


class StudentPolicy(nn.Module):
    """Encoder, auxiliary head, state stream and denoiser."""

    config: StudentConfig
    profile: CameraProfile

    def setup(self) -> None:
        """Flax: builds the parts that the configuration names."""
        self.encoder = DepthEncoder(self.config, self.profile)
        self.aux_hidden = nn.Dense(self.config.encoder.features)
        self.aux_output = nn.Dense((AUX_BESIDE if self.config.hand_view.size_px else AUX).size)
        self.state_stream = StateStream(self.config)
        self.denoiser = Denoiser(self.config)
        if self.config.hand_view.size_px:
            self.hand_view = HandView(self.config, self.profile)

    def encode(
        self,
        depth_m: Float[AnyArray, "B 3 H W"],
        state: Float[AnyArray, "B 9"],
        crop_rc: Int[AnyArray, "B 2"] | None = None,
    ) -> Seen:
        """(B, 3, H, W) metres, whole frames or the part that is seen (`prepare_depth`), (B, 9), (B, 2) or
        None for the centred crop."""
        picture = prepare_depth(depth_m, crop_rc, self.profile, self.config)
        return self.encode_picture(picture, state, crop_rc)

    def encode_picture(
        self,
        picture: Float[AnyArray, "B h w C"],
        state: Float[AnyArray, "B 9"],
        crop_rc: Int[AnyArray, "B 2"] | None = None,
    ) -> Seen:
        """As `encode`, from the output of `prepare_depth`."""
        origin = crop_origin(crop_rc, picture.shape[0], self.profile)
        features = self.encoder(picture, origin)
        if not self.config.hand_view.size_px:
            raw = self._aux(features, normalise_state(state))
            return Seen(features, Aux(raw[:, AUX.position], raw[:, AUX.yaw], raw[:, AUX.held][:, 0]))
        grip_m = grip_position(state)
        grip = position_from_world(grip_m)
        features = jnp.concatenate([features, self.hand_view(picture, grip_m, origin)], axis=-1)
        raw = self._aux(features, normalise_state(state), grip)
        near = nn.sigmoid(raw[:, AUX_BESIDE.near])
        beside = grip + BESIDE_SCALE * raw[:, AUX_BESIDE.beside]
        position = near * beside + (1.0 - near) * raw[:, AUX.position]
        return Seen(features, Aux(position, raw[:, AUX.yaw], raw[:, AUX.held][:, 0]))

    def _aux(self, *parts: AnyArray) -> jax.Array:
        return self.aux_output(nn.relu(self.aux_hidden(jnp.concatenate(parts, axis=-1))))

    def condition(self, seen: Seen, state: Float[AnyArray, "B 9"]) -> Float[jax.Array, "B D"]:
        """(B, D) what the denoiser is told."""
        parts: list[Numbers] = [self.state_stream(state)]
        if self.config.head.features_to_head:
            parts.append(seen.features)
        if self.config.head.aux_to_head:
            aux = seen.aux
            beside = (aux.position - position_from_world(grip_position(state))) / BESIDE_SCALE
            parts += [aux.position, aux.yaw, nn.sigmoid(aux.held_logit)[:, None], beside]
        return jnp.concatenate(parts, axis=-1)

    def denoise(
        self,
        noisy_action: Float[AnyArray, "B chunk 8"],
        k: Int[AnyArray, " B"],
        cond: Float[AnyArray, "B D"],
    ) -> Float[jax.Array, "B chunk 8"]:
        """(B, chunk, 8), (B,) int steps, (B, D) -> predicted noise (B, chunk, 8)."""
        return self.denoiser(noisy_action, k, cond)

    def __call__(
        self,
        depth_m: Float[AnyArray, "B 3 H W"],
        state: Float[AnyArray, "B 9"],
        noisy_action: Float[AnyArray, "B chunk 8"],
        k: Int[AnyArray, " B"],
        crop_rc: Int[AnyArray, "B 2"] | None = None,
    ) -> tuple[Float[jax.Array, "B chunk 8"], Aux]:
        """Predicted noise and auxiliary predictions: everything a training step needs."""
        seen = self.encode(depth_m, state, crop_rc)
        return self.denoise(noisy_action, k, self.condition(seen, state)), seen.aux


def grip_position(state: Float[AnyArray, "B 9"]) -> Float[jax.Array, "B 3"]:
    """(B, 3) the point between the finger pads (m, robot base) from the state (B, 9)."""
    return kinematics.grip_pose(state[:, POLICY_STATE.arm], jnp)[0]


def feature_count(config: StudentConfig) -> int:
    """Length of `Seen.features`."""
    return config.encoder.features + (config.hand_view.features if config.hand_view.size_px else 0)


def noise_schedule(config: StudentConfig) -> diffusion.Schedule:
    """Noise schedule of the action diffusion: cosine, short of pure noise."""
    return diffusion.schedule_of(diffusion.cosine_betas(config.head.diffusion_steps, TERMINAL_TIME))


@partial(jax.jit, static_argnums=(1, 2))  # one program; op by op it takes many times longer
def init_params(key: Key[jax.Array, ""], config: StudentConfig, profile: CameraProfile) -> dict:
    """Fresh parameters (a dict of float32 arrays)."""
    depth = jnp.zeros((1, contract.DEPTH_FRAMES, profile.height_px, profile.width_px))
    action = jnp.zeros((1, config.head.chunk, contract.ACTION_SIZE))
    state, k = jnp.zeros((1, contract.POLICY_STATE_SIZE)), jnp.zeros((1,), jnp.int32)
    return dict(StudentPolicy(config, profile).init(key, depth, state, action, k)["params"])


def param_shapes(config: StudentConfig, profile: CameraProfile) -> dict:
    """Tree of jax.ShapeDtypeStruct: what `init_params` would give, without computing it. Traced once."""
    return init_params.eval_shape(jax.random.key(0), config, profile)


def sample_from_seen(
    params: dict,
    seen: Seen,
    state: Float[AnyArray, "B 9"],
    noise: Float[AnyArray, "B chunk 8"],
    config: StudentConfig,
    profile: CameraProfile,
    steps: int = 0,
) -> Float[jax.Array, "B chunk 8"]:
    """DDIM from (B, chunk, 8) standard normal noise to actions in [-1, 1]; steps 0 means the config's.

    Needs the parameters of HEAD_PARAMS alone.
    """
    policy = StudentPolicy(config, profile)
    cond = cast(jax.Array, policy.apply({"params": params}, seen, state, method="condition"))

    def predict(x: AnyArray, k: AnyArray) -> jax.Array:
        return cast(jax.Array, policy.apply({"params": params}, x, k, cond, method="denoise"))

    return diffusion.ddim_sample(predict, noise, noise_schedule(config), steps or config.head.ddim_steps)


def sample_actions(
    params: dict,
    depth_m: Float[AnyArray, "B 3 H W"],
    state: Float[AnyArray, "B 9"],
    noise: Float[AnyArray, "B chunk 8"],
    config: StudentConfig,
    profile: CameraProfile,
    steps: int = 0,
) -> Float[jax.Array, "B chunk 8"]:
    """The whole policy: (B, 3, H, W) metres, (B, 9), (B, chunk, 8) noise -> (B, chunk, 8) in [-1, 1]."""
    policy = StudentPolicy(config, profile)
    seen = policy.apply({"params": params}, depth_m, state, method="encode")
    return sample_from_seen(params, cast(Seen, seen), state, noise, config, profile, steps)
