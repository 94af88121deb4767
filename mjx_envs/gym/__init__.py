"""The grasping task in Gymnasium's registry: importing this package registers `ddgrasp/Pick-v0`.

`gymnasium.make("mjx_envs.gym:ddgrasp/Pick-v0")` imports it by itself. Needs `pip install 'ddgrasp[gym]'`.
"""

import gymnasium

ID = "ddgrasp/Pick-v0"

gymnasium.register(
    ID, entry_point="mjx_envs.gym.env:PickEnv", vector_entry_point="mjx_envs.gym.vector:PickVectorEnv"
)
