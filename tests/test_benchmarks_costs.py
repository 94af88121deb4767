"""The cost model: calls of a run, times by hand, and that it prices a program."""

from dataclasses import replace

import pytest

from benchmarks import costs
from benchmarks.costs import BYTES_PER_S, TENSOR_FLOPS, VECTOR_FLOPS, Cost, Row
from benchmarks.programs import PROGRAMS
from ddgrasp.presets import PRESETS


def test_calls_of_the_paper_preset_by_hand():
    config = PRESETS["paper"]
    teacher = replace(config.teacher, total_steps=100_000_000, num_envs=8192)
    found = {(row.stage, row.program): row for row in costs.rows(replace(config, teacher=teacher))}
    assert found["teacher", "control step"].calls == pytest.approx(12207, abs=1)
    assert found["teacher", "control step"].loops == 20
    assert found["demos", "rendering: depth"].calls == 5 * 60
    assert found["ddg", "generator: train step"].calls == 8000
    assert found["student", "student: train step"].calls == 40_000 + 6 * 5000
    drawn = (1200 * 0.8 + 6 * 512 + 100) * 60 / 256
    assert found["student", "sampler: ddim"].calls == pytest.approx(drawn)


def test_of_a_demo_s_stretch_no_more_is_drawn_than_the_stretch_and_what_its_first_picture_shows():
    config = PRESETS["laptop"]
    training, head = config.student.training, config.student.head
    assert (config.demos.episodes, training.demo_stretch_steps, training.clean_share) == (1200, 12, 0.3)
    calls = {row.program: row.calls for row in costs.rows(config)}
    dagger = config.student.dagger.rounds * config.student.dagger.episodes * 60
    trials = config.evaluation.student_trials * 60
    assert calls["sampler: ddim"] == pytest.approx(
        (1200 * 0.7 * (12 + 2) + dagger + trials) / config.ddg.sampling.batch_size
    )
    kept = 1200 * (12 + 2 + head.chunk - 1)
    assert calls["student: features"] == pytest.approx((kept + dagger) / training.batch_size)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_row_is_a_program(name):
    assert {row.program for row in costs.rows(PRESETS[name])} <= PROGRAMS.keys()


def test_seconds_by_hand():
    cost = Cost(flops=2e12, bytes=1e9)
    row = Row("s", "p", calls=1000)
    assert cost.seconds(row, 0.4) == pytest.approx((2e15 / (0.4 * TENSOR_FLOPS), 1e12 / (0.4 * BYTES_PER_S)))
    slow = cost.seconds(replace(row, tensor=False), 0.4)[0]
    assert slow == pytest.approx(2e15 / (0.4 * VECTOR_FLOPS))


def test_a_matrix_product_per_sample_is_counted():
    """The head's training step: at least the products of forward and backward pass with its parameters."""
    config = PRESETS["debug"]
    cost = costs.price(config, Row("student", "student: head step", 1), compiled=False)
    twice = costs.price(config, Row("student", "student: head step", 1, loops=2), compiled=False)
    width, batch = config.student.head.width, config.student.head.batch_size
    assert cost.flops > 6 * batch * width * width
    assert twice.flops == 2 * cost.flops and cost.bytes > 0
