"""What a Franka arm's errors mean, in one line each, and what to do about them."""

import re
from typing import Any

MEANINGS = {
    "joint_reflex": "it met something: a joint felt more torque than deploy.franka.contact_torque_nm",
    "cartesian_reflex": "it met something: the hand felt more than deploy.franka.contact_force_n",
    "joint_motion_generator_position_limits_violation": "the target lies beyond a joint's range",
    "joint_motion_generator_velocity_limits_violation": "the target asks for too much speed",
    "joint_position_limits_violation": "a joint is out of its range: move it back by hand",
    "communication_constraints_violation": "packets came late: use a realtime kernel and a wired network",
    "power_limit_violation": "the motion asks for too much power: lower deploy.franka.dynamics",
}
"""By the name in Franka's `Errors`. Any other name is reported as it is."""


NO_FRANKA = "no Franka"
"""What the line begins with that says that no arm answers."""


def one_line(error: BaseException) -> str:
    """The arm's own words without their statistics."""
    return " ".join(str(error).split("control_command_success_rate")[0].split())


def names(error: BaseException) -> list[str]:
    """Errors that the arm names as the reason why a motion ended: `["joint_reflex"]`."""
    listed = re.findall(r"\[([^\]]*)\]", str(error))  # a mode is quoted too, outside
    return [name for names in listed for name in re.findall(r'"(\w+)"', names)]


def describe(error: BaseException) -> str:
    """What happened, as a person beside the arm should hear it."""
    found = names(error)
    if not found:
        return one_line(error)
    return "; ".join(f"{name} ({MEANINGS[name]})" if name in MEANINGS else name for name in found)


def no_connection(franky: Any, host: str, model: str, error: BaseException) -> str:
    """Why no connection could be made, and what to do."""
    said = one_line(error)
    if isinstance(error, franky.IncompatibleVersionException):
        return (
            f"the {model!r} at {host!r} speaks another version of the protocol ({said}) than the installed "
            "franky: install franky's wheel for its robot server."
        )
    if isinstance(error, franky.RealtimeException):
        return f"{said}: install a realtime kernel, or set deploy.franka.kernel any and expect lost packets."
    return (
        f"{NO_FRANKA} at {host!r} ({said}): unlock the joints, activate FCI in Desk, end other programs that "
        "drive it, and check --host."
    )


def no_gripper(host: str, error: BaseException) -> str:
    """Why the arm answers and its hand does not, and what to do."""
    return (
        f"the arm at {host!r} answers, its gripper does not ({one_line(error)}): mount a Franka Hand, choose "
        "and initialise it as end effector in Desk, end other programs that use it."
    )
