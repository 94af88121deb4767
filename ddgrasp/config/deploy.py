"""The control loop on the robot side, and the devices it drives."""

from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

from ddgrasp.config.checks import Count, Range, Section, Text
from ddgrasp.contract import ARMS, PANDA
from ddgrasp.errors import UserError

StartNoise = Literal["zero", "normal"]
START_NOISES: tuple[StartNoise, ...] = get_args(StartNoise)
Robot = Literal["sim", "franka"]
Camera = Literal["stereo", "realsense", "replay", "rig", "rig-ideal"]
ArmName = Literal["fr3", "panda"]
Kernel = Literal["realtime", "any"]
ClockName = Literal["machine", "robot"]
ROBOTS: tuple[Robot, ...] = get_args(Robot)
CAMERAS: tuple[Camera, ...] = get_args(Camera)
_Coordinate = Annotated[float, Range(-2, 2)]
_Corner = tuple[_Coordinate, _Coordinate, _Coordinate]


@dataclass(frozen=True)
class FrankaConfig(Section, name="deploy.franka"):
    """A real Franka robot."""

    host: Text = "172.16.0.2"
    """Address of the robot's control unit."""
    model: ArmName = "fr3"
    """Which arm it is, fr3 or panda: its limits hold, and another one that answers is refused."""
    kernel: Kernel = "realtime"
    """What this machine must run: a realtime kernel, as an arm that keeps 1 kHz wants, or any."""
    dynamics: Annotated[float, Range(0, 1, above=True)] = 0.2
    """Share of the arm's speed limits that it may use: the safety filter lets no step ask for more."""
    start_dynamics: Annotated[float, Range(0, 0.3, above=True)] = 0.05
    """The same for the move to the start pose."""
    contact_torque_nm: Annotated[float, Range(1, 100)] = 20.0
    """Torque on any joint at which the arm stops itself."""
    contact_force_n: Annotated[float, Range(1, 100)] = 30.0
    """Force at the hand, in newtons, and torque, in newton metres, at which the arm stops itself."""
    give_way: Annotated[float, Range(0, 1, above=True)] = 0.5
    """At this share of contact_torque_nm or contact_force_n the arm brakes and stands until the next command.
    Where it comes down softly (below approach_below_m) it stands until one leads up or the contact has gone,
    so that it presses no harder. 1: not before it stops itself."""
    approach_m_s: Annotated[float, Range(0, 2, above=True)] = 0.06
    """How fast the hand may come down below `approach_below_m`. An arm that is stopped by what it lands on
    presses on it in proportion to the speed that it was to have."""
    approach_below_m: Annotated[float, Range(0, 2)] = 0.16
    """Height of the point between the finger pads below which that holds, and the arm has a third of its
    stiffness unless it goes up; 0 is nowhere. What is taller than 14 cm needs more."""
    stiffness_nm_rad: Annotated[float, Range(50, 3000)] = 400.0
    """Stiffness of joints 1 to 4, 0.4 of it at the wrist: a stiffer arm presses harder on what it touches."""
    load_kg: Annotated[float, Range(0, 3)] = 0.0
    """Mass that the arm carries beside its hand, between the fingers. What is grasped need not be known if it
    weighs less than what the arm gives way to, at the hand and on every joint: about 1 kg."""
    grip_force_n: Annotated[float, Range(0, 140, above=True)] = 20.0
    """Force of the gripper in newtons."""

    @property
    def speed_rad_s(self) -> tuple[float, ...]:
        """(7,) the speed that the joints may have: `dynamics` of the slower of this arm and a Panda, within
        whose limits franky plans whichever arm answers."""
        slower = map(min, ARMS[self.model].joint_velocity_rad_s, PANDA.joint_velocity_rad_s)
        return tuple(self.dynamics * limit for limit in slower)


@dataclass(frozen=True)
class RealSenseConfig(Section, name="deploy.realsense"):
    """A real RealSense camera."""

    serial: Text = ""
    """Serial number of the camera; empty takes the first one found."""


@dataclass(frozen=True)
class DeployConfig(Section, name="deploy"):
    """Control loop on the robot side."""

    noise: StartNoise = "zero"
    """Start of the reverse diffusion: zero (deterministic) or normal (seeded)."""
    execute_steps: Annotated[int, Range(0, 1000)] = 0
    """Actions played from a chunk before the network runs again; 0 takes the exported file's own."""
    retry: bool = True
    """A hand that has closed on nothing, or twice opened again, goes up and looks again; one that stands
    still, low and open, closes; one that feels a finger on something steps aside, closes and lifts; one that
    has held something for a second lifts it, and stays there (deploy/retry.py). Without it the policy alone
    acts."""
    stale_periods: Annotated[float, Range(0, 1000, above=True)] = 2.0
    """A new frame older than this many control periods makes the robot hold position; so does one that has
    been seen already, whatever its age."""
    acceleration_scale: Annotated[float, Range(0, 100, above=True)] = 2.0
    """Largest change between two steps, relative to Franka's acceleration limit. Targets lead the arm, so
    they may change faster than the arm itself; from 2.8 on, a full reversal of any joint passes."""
    workspace_lower_m: _Corner = (0.15, -0.45, 0.012)
    """Where the point between the finger pads may go, robot base frame; at 12 mm an upright hand's
    fingertips touch the table, the rig's; a Franka Hand's are 3 mm above it."""
    workspace_upper_m: _Corner = (0.80, 0.45, 0.80)
    """The box's other corner."""
    arm_lower_m: _Corner = (-0.55, -0.80, 0.0)
    """Where elbow, forearm, wrist, hand and open fingers may be: table and walls, robot base frame."""
    arm_upper_m: _Corner = (0.95, 0.80, 1.30)
    """That box's other corner."""
    realtime_trials: Count = 3
    """Trials on the machine's own clock, for time keeping (success comes from evaluation.rig_trials)."""
    workers: Annotated[int, Range(1, 1024)] = 2
    """Processes that run simulated-clock trials."""
    film_every: Annotated[int, Range(1, 10000)] = 6
    """Steps between two columns of a trial's film strip; a deployment with the stereo camera, which is drawn
    here, records these frames alone."""
    clock: ClockName = "machine"
    """Whose time the loop keeps: this machine's, or the robot's own (an arm that may be slower than real)."""
    franka: FrankaConfig = field(default_factory=FrankaConfig)
    realsense: RealSenseConfig = field(default_factory=RealSenseConfig)

    def check(self) -> None:
        """See `Section.check`."""
        for name, lower, upper in (
            ("workspace", self.workspace_lower_m, self.workspace_upper_m),
            ("arm", self.arm_lower_m, self.arm_upper_m),
        ):
            if any(low >= high for low, high in zip(lower, upper, strict=True)):
                raise UserError(
                    f"deploy.{name} is {lower} to {upper}; expected the lower corner below the upper one in "
                    "x, y and z."
                )
