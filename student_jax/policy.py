"""The student: depth frames and joint state in, a chunk of actions out (paper III-C3).

`StudentPolicy(config, profile)` holds the networks; its methods are called through `policy.apply`:

    params = init_params(key, config, profile)
    seen = policy.apply({"params": params}, depth_m, state, crop_rc, method="encode")
    eps = policy.apply({"params": params}, noisy_action, k, seen.cond, method="denoise")
"""

from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from ddgrasp import contract
from ddgrasp.config import StudentConfig
from ddgrasp.contract import CameraProfile
from student_jax import diffusion
from student_jax.denoiser import Denoiser, StateStream
from student_jax.encoder import POSITION_CENTER_M, POSITION_SCALE_M, DepthEncoder
from student_jax.preprocess import crop_origin, prepare_depth

AUX_SIZE = 6
PARAMS_FILE = "params.msgpack"
"""Name of the parameter file in the student's artefact (`artifacts.save_params`)."""


class Aux(NamedTuple):
    """Privileged predictions, supervised in simulation only."""

    position: jax.Array
    """(B, 3) object position in network units; see `position_from_world` and `position_to_world`."""
    yaw: jax.Array
    """(B, 2) cosine and sine of k times the grasp yaw, k being the object's symmetry."""
    held_logit: jax.Array
    """(B,) logit of the object being in the hand."""


class Seen(NamedTuple):
    """What the policy makes of one observation."""

    cond: jax.Array
    """(B, D) condition of the denoiser; worth caching while only the denoiser trains."""
    aux: Aux


def position_from_world(position_m: jax.Array) -> jax.Array:
    """(..., 3) metres in the world to network units."""
    return (position_m - jnp.array(POSITION_CENTER_M)) / POSITION_SCALE_M


def position_to_world(position: jax.Array) -> jax.Array:
    """(..., 3) network units to metres in the world."""
    return position * POSITION_SCALE_M + jnp.array(POSITION_CENTER_M)


class StudentPolicy(nn.Module):
    """Encoder, auxiliary head, state stream and denoiser."""

    config: StudentConfig
    profile: CameraProfile

    def setup(self) -> None:
        self.encoder = DepthEncoder(self.config, self.profile)
        self.state_stream = StateStream(self.config)
        self.aux_hidden = nn.Dense(self.config.feature_size)
        self.aux_output = nn.Dense(AUX_SIZE)
        self.denoiser = Denoiser(self.config)

    def encode(self, depth_m: jax.Array, state: jax.Array, crop_rc: jax.Array | None = None) -> Seen:
        """(B, 3, H, W) metres, (B, 8), (B, 2) or None for the centred crop."""
        picture = prepare_depth(depth_m, crop_rc, self.profile, self.config)
        return self.encode_picture(picture, state, crop_rc)

    def encode_picture(self, picture: jax.Array, state: jax.Array, crop_rc: jax.Array | None = None) -> Seen:
        """As `encode`, from the output of `prepare_depth`."""
        features = self.encoder(picture, crop_origin(crop_rc, picture.shape[0], self.profile))
        joints = self.state_stream(state)
        hidden = nn.relu(self.aux_hidden(jnp.concatenate([features, joints], axis=-1)))
        raw = self.aux_output(hidden)
        shown = jax.lax.stop_gradient(raw) if self.config.aux_stop_gradient else raw
        parts = [features, joints] + ([shown] if self.config.aux_to_head else [])
        return Seen(jnp.concatenate(parts, axis=-1), Aux(raw[:, :3], raw[:, 3:5], raw[:, 5]))

    def denoise(self, noisy_action: jax.Array, k: jax.Array, cond: jax.Array) -> jax.Array:
        """(B, chunk, 8), (B,) int steps, (B, D) -> predicted noise (B, chunk, 8)."""
        return self.denoiser(noisy_action, k, cond)

    def __call__(
        self,
        depth_m: jax.Array,
        state: jax.Array,
        noisy_action: jax.Array,
        k: jax.Array,
        crop_rc: jax.Array | None = None,
    ) -> tuple[jax.Array, Aux]:
        """Predicted noise and auxiliary predictions: everything a training step needs."""
        seen = self.encode(depth_m, state, crop_rc)
        return self.denoise(noisy_action, k, seen.cond), seen.aux


def alpha_bar(config: StudentConfig) -> np.ndarray:
    """(K,) noise schedule of the action diffusion."""
    return diffusion.cosine_alpha_bar(config.diffusion_steps)


def init_params(key: jax.Array, config: StudentConfig, profile: CameraProfile) -> dict:
    """Fresh parameters (a dict of float32 arrays)."""
    depth = jnp.zeros((1, contract.DEPTH_FRAMES, profile.height_px, profile.width_px))
    action = jnp.zeros((1, config.chunk, contract.ACTION_SIZE))
    state, k = jnp.zeros((1, contract.STATE_SIZE)), jnp.zeros((1,), jnp.int32)
    init = jax.jit(StudentPolicy(config, profile).init)  # one program; op by op it takes many times longer
    return dict(init(key, depth, state, action, k)["params"])


def param_shapes(config: StudentConfig, profile: CameraProfile) -> dict:
    """Tree of jax.ShapeDtypeStruct: what `init_params` would give, without computing it."""
    return jax.eval_shape(lambda key: init_params(key, config, profile), jax.random.key(0))


def count_params(params: dict) -> int:
    """Number of scalars."""
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(params))


def sample_from_cond(
    params: dict,
    cond: jax.Array,
    noise: jax.Array,
    config: StudentConfig,
    profile: CameraProfile,
    steps: int = 0,
) -> jax.Array:
    """DDIM from (B, chunk, 8) standard normal noise to actions in [-1, 1]; steps 0 means the config's."""
    policy = StudentPolicy(config, profile)

    def predict(x: jax.Array, k: jax.Array) -> jax.Array:
        return cast(jax.Array, policy.apply({"params": params}, x, k, cond, method="denoise"))

    return diffusion.ddim_sample(predict, noise, alpha_bar(config), steps or config.ddim_steps)


def sample_actions(
    params: dict,
    depth_m: jax.Array,
    state: jax.Array,
    noise: jax.Array,
    config: StudentConfig,
    profile: CameraProfile,
    steps: int = 0,
    crop_rc: jax.Array | None = None,
) -> jax.Array:
    """The whole policy: (B, 3, H, W) metres, (B, 8), (B, chunk, 8) noise -> (B, chunk, 8) in [-1, 1]."""
    policy = StudentPolicy(config, profile)
    seen = cast(Seen, policy.apply({"params": params}, depth_m, state, crop_rc, method="encode"))
    return sample_from_cond(params, seen.cond, noise, config, profile, steps)
