"""The spring that an arm follows by: how strong it is when, and what it gives way to.

Before an arm of plain values, which says what it feels; tests/test_deploy_fr3.py has one that really touches.
"""

import itertools
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from deploy.devices import franka_spring
from deploy.devices.franka_spring import DAMPING_S, FRICTION_NM, SOFT, WEIGHTS, FrankaSpring, touched

STIFFNESS = 400.0
STEP = np.full(7, 0.05)


class Motion:
    """What franky's tracking motion is told."""

    def __init__(self, stiffness, damping):
        self.gains, self.references = (stiffness, damping), []

    def set_gains(self, gains):
        self.gains = gains

    def set_reference(self, reference):
        self.references.append(reference)


FRANKY = SimpleNamespace(
    JointImpedanceTrackingMotion=Motion,
    JointImpedanceGains=lambda stiffness, damping: (stiffness, damping),
    TorqueStopMotion=SimpleNamespace,
    JointReference=lambda q_rad, speed_rad_s: (q_rad, speed_rad_s),
    Exception=type("FrankyException", (Exception,), {}),
)


class Arm:
    """Stands where it is, feels what it is told to feel, and keeps this machine's time."""

    def __init__(self):
        self.touches, self.lost, self.moved = 0.0, threading.Event(), None
        self.brakes = iter(())

    @property
    def state(self):
        if self.lost.is_set():
            raise RuntimeError("UDP receive: Timeout")
        force = self.touches * np.array([3.0, 0.0, 16.0, 0.0, 1.0, 0.0])
        return SimpleNamespace(
            q=np.zeros(7), dq=np.full(7, next(self.brakes, 0.0)), O_F_ext_hat_K=force,
            time=SimpleNamespace(to_sec=time.monotonic),
            joint_contact=np.zeros(7), cartesian_contact=(np.abs(force) > 15.0).astype(float),
            tau_ext_hat_filtered=np.array([0.0, -6.0, 0, 2.0, 0, 0, 0]) * self.touches,
        )  # fmt: skip

    def move(self, motion, asynchronous=False):
        self.moved = motion


@pytest.fixture
def arm():
    return Arm()


@pytest.fixture
def spring(arm):
    spring = FrankaSpring(FRANKY, arm, STIFFNESS)
    yield spring
    spring.release()


def braked(motion) -> bool:
    return not motion.references[-1][1].any()


def strength(motion) -> float:
    """Share of stiffness and damping that it has."""
    stiffness, damping = motion.gains
    np.testing.assert_allclose(damping, DAMPING_S * stiffness)
    return float((stiffness / (STIFFNESS * WEIGHTS)).mean())


def test_it_follows_about_the_middle_of_the_step_at_its_speed(spring, arm):
    spring.follow(STEP)
    q_rad, speed_rad_s = arm.moved.references[-1]
    np.testing.assert_allclose(q_rad, STEP / 2)
    np.testing.assert_allclose(speed_rad_s, STEP / 0.1)
    assert strength(arm.moved) == 1.0 and spring.felt()[0] == ""


@pytest.mark.parametrize("soft", [False, True])
def test_what_a_joint_lacks_of_its_step_is_asked_for_again_as_far_as_friction_goes(spring, arm, soft):
    def pull_nm() -> np.ndarray:
        """Beyond what the step itself asks for."""
        q_rad, speed_rad_s = arm.moved.references[-1]
        stiffness, damping = arm.moved.gains
        return stiffness * (q_rad - STEP / 2) + damping * (speed_rad_s - STEP / 0.1)

    spring.follow(STEP, soft)
    np.testing.assert_allclose(pull_nm(), 0.0, atol=1e-9)
    for _ in range(3):
        spring.follow(STEP, soft)
        np.testing.assert_allclose(pull_nm(), FRICTION_NM)
    spring.stay()
    spring.follow(STEP, soft)
    np.testing.assert_allclose(pull_nm(), 0.0, atol=1e-9, err_msg="nothing is owed to an arm that stood")
    spring.follow(STEP, soft)
    spring.follow(-STEP, soft)
    np.testing.assert_allclose(arm.moved.references[-1], [-STEP / 2, -STEP / 0.1], err_msg="against the step")


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("stiffness", [50.0, 100.0, 400.0, 3000.0])
def test_what_is_asked_for_again_is_no_more_than_the_default_stiffness_gives(arm, stiffness, soft):
    """Whatever the stiffness: the safety filter has been passed by then."""
    spring = FrankaSpring(FRANKY, arm, stiffness)
    for _ in range(4):
        spring.follow(STEP, soft)
    spring.release()
    q_rad, speed_rad_s = arm.moved.references[-1]
    friction_rad = 1.2 / (2.5 * stiffness * (SOFT if soft else 1.0))
    np.testing.assert_allclose(q_rad - STEP / 2, min(friction_rad, 3.6e-3), rtol=1e-9)
    np.testing.assert_allclose(speed_rad_s - STEP / 0.1, min(10 * friction_rad, 0.036), rtol=1e-9)


def test_a_soft_arm_that_touches_something_makes_no_step_that_heeds_it(spring, arm):
    arm.touches = 1.0
    told = len(arm.moved.references)
    spring.follow(STEP, soft=True)
    assert [speed.any() for _, speed in arm.moved.references[told:]] == [False] and spring.felt()[0]
    spring.follow(STEP)
    assert any(speed.any() for _, speed in arm.moved.references[told:]), "one that is not low moves"


def test_it_gives_way_to_a_contact_says_what_and_goes_on_with_the_next_step(spring, arm):
    spring.follow(STEP, soft=True)
    assert not braked(arm.moved)
    arm.touches = 1.0
    time.sleep(0.05)
    assert braked(arm.moved) and strength(arm.moved) == pytest.approx(SOFT), "as soft as it came"
    assert spring.felt()[0] == "16 N and 1 N m at the hand, 6 N m on joint 2" and spring.felt()[0] == ""
    arm.touches = 0.0
    spring.follow(STEP)
    time.sleep(0.05)
    assert not braked(arm.moved)


def test_it_says_what_pressed_on_it_hardest_since_it_was_asked(spring, arm):
    spring.follow(STEP)
    assert not spring.felt()[1].any()
    for arm.touches in (0.5, 1.0, 0.7, 0.0):
        time.sleep(0.05)
    met, felt_nm = spring.felt()
    assert met
    np.testing.assert_array_equal(felt_nm, [0.0, 6.0, 0, -2.0, 0, 0, 0], "on the arm: not what it does")
    assert spring.felt()[0] == "" and not spring.felt()[1].any()


def test_torques_that_are_no_numbers_are_told(spring, arm):
    arm.touches = np.nan
    time.sleep(0.05)
    arm.touches = 1.0
    time.sleep(0.05)
    assert np.isnan(spring.felt()[1]).any()


def test_a_contact_does_not_keep_a_hand_from_going_up(spring, arm):
    arm.touches = 1.0
    spring.follow(STEP, heeds=False)
    time.sleep(0.05)
    assert not braked(arm.moved) and spring.felt()[0] == ""


@pytest.mark.parametrize("stops", [FrankaSpring.stay, lambda spring: time.sleep(0.25)], ids=["hold", "late"])
def test_it_stands_with_all_of_its_strength(spring, arm, stops):
    spring.follow(STEP, soft=True)
    assert strength(arm.moved) == pytest.approx(SOFT)
    stops(spring)
    assert braked(arm.moved) and strength(arm.moved) == 1.0 and spring.felt()[0] == ""


def test_it_lets_go_of_an_arm_that_stands_for_as_short_as_may_be(arm):
    spring = FrankaSpring(FRANKY, arm, STIFFNESS)
    motion = arm.moved
    spring.follow(STEP)
    arm.brakes = iter([0.5, -0.1] * 10)
    spring.stop()
    assert braked(motion) and next(arm.brakes, "stood") == "stood"
    np.testing.assert_allclose(arm.moved.damping, DAMPING_S * STIFFNESS * WEIGHTS)
    assert arm.moved.max_duration <= 0.2


def test_the_watch_ends_with_the_connection(spring, arm):
    arm.lost.set()
    spring._watch.join(2.0)
    assert not spring._watch.is_alive()


def test_an_elbow_that_touches_something_is_felt_too(arm):
    """No force at the hand; the second joint's torque is above its threshold."""
    state = arm.state
    assert not touched(state)
    state.joint_contact = np.array([0.0, 1.0, 0, 0, 0, 0, 0])
    state.tau_ext_hat_filtered = np.array([0.0, -9.0, 0, 0, 0, 0, 0])
    assert touched(state) == "0 N and 0 N m at the hand, 9 N m on joint 2"


def test_an_arm_that_somebody_pushes_is_let_go_all_the_same(arm, monkeypatch):
    monkeypatch.setattr(franka_spring, "BRAKES_S", 0.05)
    spring = FrankaSpring(FRANKY, arm, STIFFNESS)
    arm.brakes = itertools.repeat(1.0)
    stopping = threading.Thread(target=spring.stop, daemon=True)
    stopping.start()
    stopping.join(5.0)
    moves, arm.brakes = stopping.is_alive(), iter(())
    assert not moves
